"""Parameters that may vary between runs, and the information of each run on them.

Groups of the drive terms, of the gain of each joint's torque signal, and of a payload on the last
link are columns B in base parameters, and rows: the torque of a run is W (theta + B x) with theta
of the fit to all runs. The zero of a position has rows only: derivatives of the torque. One group
is estimated with the others at theta.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np

from robotid.base.tolerances import LEAST_DIVISOR, SINGULAR
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.estimation.variation.spread import Runs
from robotid.robot.model import RobotModel

FEWEST_RUNS = 3  # smallest number of runs whose scatter is estimated
_DRIVE = 0.1  # plausible standard deviation of a drive term, over the drive's torque
_GAIN = 0.02  # ... of a gain
_MASS = 0.01  # ... of the mass on the last link, over the mass of the robot
_REACH = 0.1  # [m] ... of its centre of mass
_ZERO = {"rad": 0.005, "m": 0.001}  # ... of the zero of a position
_LEVER = 0.01  # ... and its torque over that of its joint, at least
_PAYLOAD = ("m", "mcx", "mcy", "mcz")
_SMALLEST = 0.01  # torque of a drive over that of its largest term below which this share counts


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters that vary together."""

    kind: str  # "drive", "gain", "payload" or "zero"
    name: str  # name of the drive, joint or link
    parameters: tuple[str, ...]  # their names, q items
    units: tuple[str, ...]  # their units, q items
    columns: Array  # (b, q), B; 0 for a zero
    rows: tuple[int, ...]  # the joints whose torque they change, indices


@dataclass(frozen=True, eq=False)
class RunsOf:
    """The runs' information about the deviation of a group from the fit."""

    group: Group
    centre: Array  # (q,), its values in the fit: 0 for a payload, 1 for a gain
    runs: Runs  # information about x, coloured noise included
    inflation: float  # variance of coloured noise over that of independent rows [-]


@dataclass(frozen=True, eq=False)
class RunSums:
    """Sums over the rows of k runs, to which those of new runs are added.

    The rows are A = W B of the Q parameters of all groups, the zeros last, and residuals r = tau -
    W theta, over the noise level of their joint.
    """

    H: Array  # (k, Q, Q), A^T A of each run; the blocks of the groups are used
    h: Array  # (k, Q), A^T r of each run, each group over its own joints
    scatter: Array  # (g, 2), of each group: of scores about each run's estimate, and expected
    sigma: Array  # (n,), noise level per joint [N m or N]

    def joined(self, new: "RunSums") -> "RunSums":
        """Return the sums of these runs and of new ones."""
        H, h = np.concatenate([self.H, new.H]), np.concatenate([self.h, new.h])
        return RunSums(H, h, self.scatter + new.scatter, self.sigma)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them: of H, the upper triangle, row by row."""
        upper = np.triu_indices(self.H.shape[1])
        return {
            "H": self.H[:, *upper].tolist(),
            "h": self.h.tolist(),
            "scatter": self.scatter.tolist(),
            "sigma": self.sigma.tolist(),
        }

    @classmethod
    def from_dict(cls, stated: Mapping[str, Any]) -> "RunSums":
        """Return the sums from plain values; see ``to_dict``."""
        h = np.array(stated["h"])
        H = np.zeros((*h.shape, h.shape[1]))
        rows, columns = np.triu_indices(h.shape[1])
        H[:, rows, columns] = H[:, columns, rows] = stated["H"]
        return cls(H, h, np.array(stated["scatter"]), np.array(stated["sigma"]))


def sums_of(
    model: RobotModel, mapping: BaseMapping, segments: Sequence[Sequence[Factors]],
    standard: Array, sigma: Array,
) -> RunSums:  # fmt: skip
    """Return the sums of runs over all groups of parameters: standard (p,), sigma (n,)."""
    theta, groups = mapping.to_base(standard), [g for g, _ in groups_at(model, mapping, standard)]
    products = [_products(run, groups, theta, sigma) for run in segments]
    scatter = [_scatter([(H[:, x, x], g[:, x]) for H, g in products]) for x in _places(groups)]
    H, h = (np.array([x.sum(axis=0) for x in parts]) for parts in zip(*products, strict=True))
    return RunSums(H, h, np.array(scatter), sigma)


def with_zeros(sums: RunSums, parts: Sequence[Array]) -> RunSums:
    """Return sums with those over the rows D of z zeros: D^2, D r by segment, (2, s, z) a run."""
    H, h, scatter = sums.H.copy(), sums.h.copy(), sums.scatter.copy()
    for j in range(-parts[0].shape[2], 0):
        H[:, j, j], h[:, j] = np.array([part[:, :, j].sum(axis=1) for part in parts]).T
        scatter[j] = _scatter([(D_D[:, j, None, None], D_r[:, j, None]) for D_D, D_r in parts])
    return RunSums(H, h, scatter, sums.sigma)


def runs_of(
    model: RobotModel, mapping: BaseMapping, standard: Array, sums: RunSums, unit: Array
) -> tuple[RunsOf, ...]:
    """Return the information of each run on each group of parameters: unit (k,)."""
    every = groups_at(model, mapping, standard)
    places = _places([group for group, _ in every])
    squares = np.einsum("kqq->q", sums.H)
    of_gains = {group.name: squares[place].item()
                for (group, _), place in zip(every, places, strict=True)
                if group.kind == "gain"}  # fmt: skip
    runs = []
    for (group, centre), place, scatter in zip(every, places, sums.scatter, strict=True):
        H, h, inflation = sums.H[:, place, place], sums.h[:, place], _ratio(*scatter)
        if not H.any():  # no run has effects
            continue
        if group.kind == "zero":
            like_gain = np.sqrt(of_gains[group.name] / squares[place])
            scale = np.maximum(_ZERO[group.units[0]], _LEVER * like_gain)
        else:
            scale = _scale(group, centre, H.sum(axis=0), model, standard)
        information = Runs(H / inflation, h / inflation, unit, scale)
        runs.append(RunsOf(group, centre, information, inflation))
    return tuple(runs)


def _places(groups: Sequence[Group]) -> list[slice]:
    """Return the places of the parameters of each group among those of all."""
    ends = np.cumsum([group.columns.shape[1] for group in groups]).tolist()
    return [slice(end - g.columns.shape[1], end) for g, end in zip(groups, ends, strict=True)]


def groups_at(
    model: RobotModel, mapping: BaseMapping, standard: Array
) -> list[tuple[Group, Array]]:
    """Return the groups and their values in the fit: standard (p,)."""
    layout, base, theta = model.layout, mapping.base_names, mapping.to_base(standard)
    rows, eye, groups = tuple(range(model.n_rows)), np.eye(len(base)), []
    unit_of = dict(zip(layout.names, layout.units, strict=True))
    place_of = {name: k for k, name in enumerate(layout.names)}
    for drive in layout.drives:
        is_own = [x.rpartition(".")[0] == drive.name and x in layout.drive_names for x in base]
        if any(is_own):
            terms = tuple(compress(base, is_own))
            units = tuple(unit_of[name] for name in terms)
            group = Group("drive", drive.name, terms, units, eye[:, is_own], rows)
            groups.append((group, standard[[place_of[name] for name in terms]]))
    if not model.constraints:  # rows of one joint each
        first = model.n_rows - len(layout.joints)
        for j, joint in enumerate(layout.joints, start=first):
            gain = Group("gain", joint, (f"{joint}.gain",), ("-",), theta[:, None], (j,))
            groups.append((gain, np.ones(1)))
    link = layout.bodies[-1]
    names = tuple(f"{link}.{term}" for term in _PAYLOAD)
    columns = mapping.K[:, [place_of[name] for name in names]]
    payload = Group("payload", link, names, tuple(unit_of[n] for n in names), columns, rows)
    groups.append((payload, np.zeros(len(names))))
    if not (model.constraints or model.free_flyer):
        for joint in layout.joints:
            unit = "m" if joint in layout.prismatic else "rad"
            zero = Group("zero", joint, (f"{joint}.zero",), (unit,), 0.0 * theta[:, None], rows)
            groups.append((zero, np.zeros(1)))
    return groups


def _products(
    segments: Sequence[Factors], groups: Sequence[Group], theta: Array, sigma: Array
) -> tuple[Array, Array]:
    """Return A^T A (s, Q, Q) and A^T r (s, Q): A = W B in a group's rows, r = tau - W theta."""
    B, sizes = np.hstack([x.columns for x in groups]), [x.columns.shape[1] for x in groups]
    acts = [np.repeat([j in group.rows for group in groups], sizes) for j in range(len(sigma))]
    H, g = np.zeros((len(segments), B.shape[1], B.shape[1])), np.zeros((len(segments), B.shape[1]))
    for k, segment in enumerate(segments):
        for j, level in enumerate(sigma):
            R, columns = segment.triangles[j] / level, segment.columns[j]
            A = R[:, :-1] @ (B[columns] * acts[j])
            H[k] += A.T @ A
            g[k] += A.T @ (R[:, -1] - R[:, :-1] @ theta[columns])
    return H, g


def inflation_of(runs: Sequence[tuple[Array, Array]]) -> float:
    """Return the variance of scores about each run's estimate over that of independent rows.

    It is common to all runs, as one alone has too few segments; with one segment each it is 1.
    """
    return _ratio(*_scatter(runs))


def _ratio(scatter: float, expected: float) -> float:
    return max(scatter / expected, LEAST_DIVISOR) if expected > LEAST_DIVISOR else 1.0


def _scatter(runs: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Return the scatter of the scores of segments, and the one of independent rows."""
    scatter, expected = 0.0, 0.0
    for H, g in runs:
        bread = np.linalg.pinv(H.sum(axis=0), rcond=SINGULAR, hermitian=True)
        scores = g - H @ (bread @ g.sum(axis=0))
        scatter += float(np.einsum("si,ij,sj->", scores, bread, scores))
        leverage = H @ bread
        expected += float(np.einsum("sii->", leverage) - np.einsum("sij,sji->", leverage, leverage))
    return scatter, expected


def _scale(group: Group, centre: Array, H: Array, model: RobotModel, standard: Array) -> Array:
    """Return plausible standard deviations of a group, (q,): of drives, a tenth of the torque."""
    if group.kind == "gain":
        return np.array([_GAIN])
    if group.kind == "payload":
        mass = _MASS * float(standard[: model.layout.n_inertial : 10].sum())
        return mass * np.array([1.0, _REACH, _REACH, _REACH])
    norms = np.sqrt(np.maximum(np.diag(H), LEAST_DIVISOR))
    torque = np.sqrt(max(float(centre @ H @ centre), 0.0))
    return np.asarray(_DRIVE * np.maximum(torque, _SMALLEST * norms.max()) / norms)
