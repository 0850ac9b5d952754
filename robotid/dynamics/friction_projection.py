"""Projection of drive friction on the terms of simulators: viscous, Coulomb, spring, offset.

A drive's torque X x is replaced by Y z of the terms of a format, the nearest in least squares over
the rows of the logs. A result has the mean products of the columns of X and Y, without the logs.
"""

import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.torque import drive_motion_along
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import TERMS, Lag, LuGre, Presliding, Spring
from robotid.robot.model import RobotModel, pinocchio_model

#: The terms that friction is projected on. The offset is always one of them, so that it does not
#: become friction in a format without offset.
_SIMPLE: dict[str, DriveTerm] = {
    **{name: TERMS[name] for name in ("viscous", "coulomb", "offset")}, "spring": Spring()
}  # fmt: skip
_STATES = (Presliding.label, LuGre.label)  # terms with an internal state
_NEGLIGIBLE = 1e-4  # error of a projection over the torque of its drive


@dataclass(frozen=True, eq=False)
class DriveMoments:
    """Second moments of the terms of one drive over the rows of the logs."""

    terms: tuple[str, ...]  # the drive's, except inertia, then those of a simulator that it lacks
    products: Array  # mean products of their columns over the rows, shape (k, k)
    torque: float  # RMS torque of the rows in the drive's joints [N m or N]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for result.json."""
        products = self.products.tolist()
        return {"terms": list(self.terms), "products": products, "torque": self.torque}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> "DriveMoments":
        """Return the moments from plain values."""
        terms, products = tuple(table["terms"]), np.array(table["products"], dtype=float)
        if products.shape != (len(terms), len(terms)) or not np.isfinite(products).all():
            raise DataError(
                f"drive_moments: products have shape {products.shape}, expected a finite matrix "
                f"over the {len(terms)} terms; identify again"
            )
        return cls(terms, products, float(table["torque"]))

    def transfer(self, own: Sequence[str], onto: Sequence[str]) -> Array:
        """Return the linear map from a drive's parameters to those of its projection."""
        root = self._root()
        Y, X = (root[:, [self.terms.index(name) for name in names]] for names in (onto, own))
        return np.linalg.lstsq(Y, X, rcond=None)[0]

    def _root(self) -> Array:
        """Return M with M^T M the products, shape (k, k)."""
        values, vectors = np.linalg.eigh(self.products)
        floor = ROUNDING * max(float(values[-1]), 0.0)
        return np.asarray(np.sqrt(np.where(values > floor, values, 0.0))[:, None] * vectors.T)

    def rms(self, x: Mapping[str, float]) -> float:
        """Return the RMS torque of a sum of terms over the rows [N m or N]."""
        weights = np.array([x.get(name, 0.0) for name in self.terms])
        return float(np.linalg.norm(self._root() @ weights))


@dataclass(frozen=True, eq=False)
class ProjectedDrive:
    """A drive whose terms were projected."""

    name: str  # joint or coupling
    replaced: tuple[str, ...]  # the terms that the format lacks
    values: Mapping[str, float]  # parameters of the terms that the format has, by name
    transfer: Array  # map from the drive's m parameters to these; rows at a bound of 0 are 0
    own: tuple[int, ...]  # indices of the drive's m parameters in the layout of the robot
    error: float  # RMS error of the projection [N m or N]
    torque: float  # RMS torque of the drive's joints [N m or N]
    is_linear: bool = False  # whether its joints are prismatic

    def __str__(self) -> str:
        unit = {name: term.units[self.is_linear] for name, term in _SIMPLE.items()}
        stated = ", ".join(f"{term} {x:.4g} {unit[term]}" for term, x in self.values.items())
        share = f" ({100 * self.error / self.torque:.2g} % of its torque)" if self.torque else ""
        note = f"error {self.error:.3g} {unit['offset']} RMS{share}"
        if self.error <= _NEGLIGIBLE * self.torque:
            note = f"error below {100 * _NEGLIGIBLE:g} % of its torque"
        if states := [name for name in self.replaced if name in _STATES]:
            note += f"; {', '.join(states)} at steady value, without the transient after reversals"
        return f"{self.name}: {', '.join(self.replaced)} projected on {stated}; {note}"

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for sidecars."""
        numbers = {**self.values, "error": self.error, "torque": self.torque}
        return {"replaced": list(self.replaced), **numbers}


@dataclass(frozen=True, eq=False)
class Projection:
    """A robot whose drives have only the terms of a format."""

    model: RobotModel  # the robot
    pi: Array  # its standard parameters, shape (p,), SI units
    drives: tuple[ProjectedDrive, ...]  # those whose terms were projected


def drive_moments(
    model: RobotModel, recordings: Iterable[tuple[Trajectory, Array]]
) -> dict[str, DriveMoments]:
    """Return the moments of the drives with further terms, at steady internal states, by name."""
    layout, n = model.layout, len(model.joints)
    sums: dict[str, tuple[tuple[str, ...], Array, float, int]] = {}
    for trajectory, mask in recordings if layout.own else ():
        motion = replace(drive_motion_along(model, trajectory, has_rate=False), begins=None)
        for d, drive in enumerate(layout.drives):
            if drive.name not in layout.own:
                continue
            moved = layout.drive_ratios[d] != 0.0
            rows = mask[:, -n:][:, moved].all(axis=1)
            terms = {term.name: term for _, term in _own_terms(model, d)}
            terms |= {name: term for name, term in _SIMPLE.items() if name not in terms}
            columns = np.array([term.column(motion.of(d)) for term in terms.values()])
            names, X = tuple(terms), columns[:, rows]
            tau = trajectory.tau[:, -n:][rows][:, moved]
            _, products, total, count = sums.get(drive.name, (names, 0.0 * X @ X.T, 0.0, 0))
            total += float((tau**2).sum())
            sums[drive.name] = (names, products + X @ X.T, total, count + int(rows.sum()))
    return {
        name: DriveMoments(names, products / count, float(np.sqrt(total / count)))
        for name, (names, products, total, count) in sums.items()
        if count
    }


def _own_terms(model: RobotModel, d: int) -> list[tuple[int, DriveTerm]]:
    """Return indices and terms of a drive's parameters except inertia."""
    drives = enumerate(model.layout.drive_parameters, start=model.layout.n_inertial)
    return [(k, term) for k, (drive, term) in drives if drive == d and not term.is_inertia]


def project_friction(
    model: RobotModel, pi: Array, moments: Mapping[str, DriveMoments], onto: Collection[str]
) -> Projection:
    """Return a robot whose drives have only the terms of a format and inertia, by least squares."""
    layout, projected = model.layout, []
    for d, drive in enumerate(layout.drives):
        simple = (*_SIMPLE, Lag.label)  # a delay is not friction: it is omitted and named
        names = [term.name for k, term in _own_terms(model, d) if pi[k] != 0.0]
        excess = [name for name in names if name not in simple]
        excess += [name for name in names if name == "spring" not in onto]
        if excess:
            if drive.name not in moments:
                raise DataError(
                    f"{drive.name} has {', '.join(excess)}, but the result of an earlier version "
                    "has no drive_moments, which the projection on simpler friction needs; "
                    "identify again"
                )
            projected.append(_projected(model, d, pi, moments[drive.name], excess, onto))
    if not projected:
        return Projection(model, pi, ())
    return Projection(*_simplified(model, pi, projected), tuple(projected))


def projected_pinocchio_model(
    model: RobotModel, pi: Array, moments: Mapping[str, DriveMoments]
) -> Any:  # noqa: ANN401
    """Return ``pinocchio_model`` of a robot with projected friction; a warning names its drives."""
    projection = project_friction(model, pi, moments, ("viscous", "coulomb", "offset"))
    if projection.drives:
        changes = "; ".join(str(drive) for drive in projection.drives)
        warnings.warn(
            f"Pinocchio's model has only viscous and Coulomb friction and an offset: {changes}; "
            "predict(q, v, a) includes all terms",
            stacklevel=3,
        )
    return pinocchio_model(projection.model, projection.pi)


def _projected(
    model: RobotModel,
    d: int,
    pi: Array,
    moments: DriveMoments,
    excess: Sequence[str],
    onto: Collection[str],
) -> ProjectedDrive:
    """Return one drive with the terms of a format."""
    own = _own_terms(model, d)
    names, x = [term.name for _, term in own], pi[[k for k, _ in own]]
    has_spring = any(term.part in ("spring", "ripple") for _, term in own)
    usable = {*names, "spring"} if has_spring else {*names}
    bounded = [name for name in _SIMPLE if name in onto and name in usable and name != "offset"]
    least, transfers = np.inf, dict[str, Array]()
    for free in chain.from_iterable(combinations(bounded, k) for k in range(len(bounded) + 1)):
        onto_free = (*free, "offset")  # the others are at their bound of 0
        T = moments.transfer(names, onto_free)
        left = Counter(dict(zip(names, x.tolist(), strict=True)))
        left.subtract(dict(zip(onto_free, (T @ x).tolist(), strict=True)))
        error = moments.rms(left)
        if ((T @ x)[:-1] >= 0).all() and error < least:
            least, transfers = error, dict(zip(onto_free, T, strict=True))
    stated = [name for name in _SIMPLE if name in bounded or (name in onto and name in names)]
    drive, none = model.layout.drives[d], np.zeros(len(names))
    transfer = np.array([transfers.get(name, none) for name in stated]).reshape(-1, len(names))
    return ProjectedDrive(
        drive.name, tuple(excess), dict(zip(stated, (transfer @ x).tolist(), strict=True)),
        transfer, tuple(k for k, _ in own), error=least, torque=moments.torque,
        is_linear={joint for joint, _ in drive.ratios} <= model.layout.prismatic,
    )  # fmt: skip


def _simplified(
    model: RobotModel, pi: Array, projected: Sequence[ProjectedDrive]
) -> tuple[RobotModel, Array]:
    """Return the robot without the projected terms, and its parameters."""
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    changed = {drive.name: drive.values for drive in projected}
    replaced = {drive.name: (*drive.replaced, "spring") for drive in projected}
    own = {
        name: tuple(term for term in terms if term.name not in replaced.get(name, ()))
        + ((Spring(),) if "spring" in changed.get(name, {}) else ())
        for name, terms in model.layout.own.items()
    }
    simple = model.with_terms(own)
    for name, terms in changed.items():
        values |= {f"{name}.{term}": value for term, value in terms.items()}
    return simple, np.array([values.get(name, 0.0) for name in simple.layout.names])
