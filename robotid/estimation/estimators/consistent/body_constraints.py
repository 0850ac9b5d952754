"""Constraints on bodies beyond physical consistency: mass, centre of mass, extent, pinned links."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.parameters import ParameterLayout, pseudo_inertia, pseudo_inertia_basis

_SIGN_MARGIN = 1e-9  # lower bound of drive terms over their scale, as rounding must not negate them
_OPEN = (0.0, np.inf)  # [kg]
_ROUNDING = 1e-9  # [kg], [m]: tolerance for a pinned body outside its bounds


@dataclass(frozen=True, eq=False)
class Bounds:
    """The points x with G x + h >= 0."""

    G: Array  # (k, p)
    h: Array  # (k,)
    labels: tuple[str, ...]  # family and owner of each row, as "mass forearm"

    def active(self, x: Array, tolerance: float) -> tuple[str, ...]:
        """Return the labels of the rows that are active at x (p,)."""
        return tuple(self.labels[k] for k in np.flatnonzero(self.G @ x + self.h < tolerance))


@dataclass(frozen=True, eq=False)
class Subspace:
    """The subspace x = origin + basis y of the points that meet equalities."""

    origin: Array  # (p,), a point that meets them
    basis: Array  # (p, r), free directions, orthonormal

    @classmethod
    def of(cls, E: Array, e: Array) -> "Subspace":
        """Return the points with E x = e, in the least squares sense: E (k, p), e (k,)."""
        p = E.shape[1]
        if not len(E):
            return cls(np.zeros(p), np.eye(p))
        is_free = ~E.any(axis=0)
        inner = scipy.linalg.null_space(E[:, ~is_free])
        basis = np.zeros((p, is_free.sum() + inner.shape[1]))
        basis[is_free, : is_free.sum()] = np.eye(is_free.sum())
        basis[~is_free, is_free.sum() :] = inner
        return cls(np.linalg.lstsq(E, e, rcond=None)[0], basis)

    @cached_property
    def fixed(self) -> Array:
        """Fixed directions, shape (p, p - r), orthonormal."""
        p, r = self.basis.shape
        return np.asarray(np.zeros((p, 0)) if r == p else scipy.linalg.null_space(self.basis.T))


@dataclass(frozen=True, eq=False)
class Constraints:
    """Bounds in addition to physical consistency, by name of the body that a joint moves."""

    mass: dict[str, tuple[float, float]] = field(default_factory=dict)  # smallest, largest [kg]
    total_mass: tuple[float, float] | None = None  # of all bodies together [kg]
    #: Half-spaces A c <= b that contain the centre of mass c of a body in its own frame: A of shape
    #: (k, 3), unit rows, and b of shape (k,) [m].
    com: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    pinned: tuple[str, ...] = ()  # bodies that keep the prior's values
    #: Box that contains all mass of a body: lower and upper corner in its own frame, shape (2, 3)
    #: [m]; see ``slabs``.
    extent: dict[str, Array] = field(default_factory=dict)
    relaxed: tuple[str, ...] = ()  # bodies whose extent was removed: the data contradict it

    def without_extent(self, bodies: Iterable[str]) -> "Constraints":
        """Return the same constraints without the extents of some bodies."""
        relaxed = tuple(body for body in self.extent if body in set(bodies))
        others = {body: box for body, box in self.extent.items() if body not in relaxed}
        return replace(self, extent=others, relaxed=(*self.relaxed, *relaxed))

    def check(self, layout: ParameterLayout, prior: Array, held: Array) -> None:
        """Refuse unknown bodies and bounds that contradict each other, before the solver runs.

        prior (p,), held (10 bodies,).
        """
        known = {*self.mass, *self.com, *self.extent, *self.pinned}
        unknown = sorted(known - set(layout.bodies))
        if unknown:
            raise SettingsError(
                f"constraints name {unknown}, which are not bodies of the model, wanted names of "
                f"{listed(layout.bodies)}; links connected by fixed joints are part of the body "
                "that a joint moves"
            )
        values = prior[: layout.n_inertial].reshape(-1, 10)
        parts = held.reshape(-1, 10)
        for body, bounds in self.mass.items():
            _check_range(f"mass of {body}", *bounds)
            part = parts[layout.bodies.index(body), 0]
            if bounds[1] < part:
                raise SettingsError(
                    f"mass of {body} is at most {bounds[1]:g} kg by its bound, but its links on "
                    f"locked joints alone have {part:g} kg; increase the bound"
                )
        for body in self.pinned:
            i = layout.bodies.index(body)
            self._check_pinned(body, values[i], parts[i])
        if self.total_mass is not None:
            self._check_total(self.total_mass, dict(zip(layout.bodies, values[:, 0], strict=True)))

    def bounds(self, layout: ParameterLayout, scale: Array) -> Bounds:
        """Return signs of drives and ranges as rows of x = pi / scale, without pinned bodies."""
        p = len(layout.names)
        signs = np.flatnonzero(layout.is_nonnegative())
        labels = [f"drive_signs {layout.names[i]}" for i in signs]
        G, h = [np.eye(p)[signs]], [np.full(len(signs), -_SIGN_MARGIN)]
        for row, constant, label in self._ranges(layout):
            norm = np.linalg.norm(row * scale)
            G.append((row * scale / norm)[None])
            h.append(np.array([constant / norm]))
            labels.append(label)
        return Bounds(np.vstack(G), np.concatenate(h), tuple(labels))

    def equalities(self, layout: ParameterLayout, prior: Array) -> tuple[Array, Array]:
        """Return the equalities E pi = e (k,): pinned bodies, and masses given as one value."""
        p = len(layout.names)
        pinned = np.flatnonzero(np.repeat(np.isin(layout.bodies, self.pinned), 10))
        E, e = [np.eye(p)[pinned]], [prior[pinned]]
        for row, (low, high), _ in self._masses(layout):
            if low == high:
                E.append(row[None])
                e.append(np.array([low]))
        return np.vstack(E), np.concatenate(e)

    def _masses(self, layout: ParameterLayout) -> Iterator[tuple[Array, tuple[float, float], str]]:
        """Yield the rows of masses, (p,), with their bounds and labels."""
        for body, bounds in self.mass.items():
            if body not in self.pinned:
                yield _row(layout, body, np.eye(10)[0]), bounds, f"mass {body}"
        if self.total_mass is not None:
            row = np.zeros(len(layout.names))
            row[: layout.n_inertial : 10] = 1.0
            yield row, self.total_mass, "total_mass all"

    def _ranges(self, layout: ParameterLayout) -> Iterator[tuple[Array, float, str]]:
        """Yield c (p,), c0 and label of each row c pi + c0 >= 0 of a bound that is a range."""
        for row, (low, high), label in self._masses(layout):
            for sign, bound in ((1.0, low), (-1.0, high)):
                if low != high and np.isfinite(bound):
                    yield sign * row, -sign * bound, label
        for body, (A, b) in self.com.items():
            for normal, distance in zip(A, b, strict=True):
                if body not in self.pinned:
                    c = np.concatenate([[distance], -normal, np.zeros(6)])
                    yield _row(layout, body, c), 0.0, f"centre_of_mass {body}"
        for body, box in self.extent.items():
            if body not in self.pinned:
                for c in np.einsum("kij,mij->mk", pseudo_inertia_basis(), slabs(box)):
                    yield _row(layout, body, c), 0.0, f"extent {body}"

    def _check_pinned(self, body: str, values: Array, held: Array) -> None:
        (J,) = pseudo_inertia(values - held)
        if np.linalg.eigvalsh(J)[0] <= 0:
            raise SettingsError(
                f"{body} is pinned, but its inertial in the URDF is not physically consistent; "
                "correct it, or remove the link from 'pinned'"
            )
        low, high = self.mass.get(body, _OPEN)
        if not low - _ROUNDING <= values[0] <= high + _ROUNDING:
            raise SettingsError(
                f"{body} is pinned at the URDF's {values[0]:g} kg, outside its bounds "
                f"[{low:g}, {high:g}] kg; remove the link from 'pinned' or from 'mass'"
            )
        if body in self.com:
            A, b = self.com[body]
            centre = values[1:4] / values[0]
            beyond = float((A @ centre - b).max())
            if beyond > _ROUNDING:
                raise SettingsError(
                    f"{body} is pinned, but the URDF's centre of mass "
                    f"{np.round(centre, 4).tolist()} m is {1e3 * beyond:.1f} mm outside its "
                    "bounds; remove the link from 'pinned' or widen the bounds"
                )

    def _check_total(self, total: tuple[float, float], masses: dict[str, float]) -> None:
        low, high = total
        _check_range("total_mass", low, high)
        bounds = [
            (mass, mass) if body in self.pinned else self.mass.get(body, _OPEN)
            for body, mass in masses.items()
        ]
        least, most = np.sum(bounds, axis=0)
        if high < least - _ROUNDING or low > most + _ROUNDING:
            raise SettingsError(
                f"total_mass is bounded by [{low:g}, {high:g}] kg, but the bounds of the bodies "
                f"and pinned masses allow [{least:g}, {most:g}] kg; correct the bounds"
            )


def slabs(box: Array) -> Array:
    """Return the matrices Q_k, shape (3, 4, 4), with tr(J Q_k) >= 0 for all mass inside a box.

    Every mass element with x_k between the corners l and u has (x_k - l_k) (u_k - x_k) >= 0; the
    integral over the body is tr(J Q_k) (Wensing, Kim, Slotine, 2018, Linear Matrix Inequalities for
    Physically Consistent Inertial Parameter Identification, (12), its ellipsoid being a slab).
    """
    Q = np.zeros((3, 4, 4))
    for k, (low, high) in enumerate(box.T.tolist()):
        Q[k, k, k] = -1.0
        Q[k, k, 3] = Q[k, 3, k] = 0.5 * (low + high)
        Q[k, 3, 3] = -low * high
    return Q


def _row(layout: ParameterLayout, body: str, c: Array) -> Array:
    """Return coefficients of all parameters, (p,), from those of one body, (10,)."""
    row = np.zeros(len(layout.names))
    first = 10 * layout.bodies.index(body)
    row[first : first + 10] = c
    return row


def _check_range(what: str, low: float, high: float) -> None:
    if not low <= high:
        raise SettingsError(
            f"{what} is bounded by [{low:g}, {high:g}] kg: the first value is larger than the "
            "second; write the smaller one first"
        )
    if high <= 0:
        raise SettingsError(f"{what} is bounded by {high:g} kg, wanted a positive bound")
