"""Parameters that may vary between runs, and the information of each run on them.

The drive terms of each drive, the gain of each joint's torque signal, and a payload on the last
link are three kinds of groups with the same form: columns B in base parameters, and the rows that
they act on. The torque of a run is W (theta + B x) with theta of the fit to all runs and x of the
group in this run. One group is estimated with the others
at theta.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from robotid._typing import Array
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import Factors
from robotid.robot.model import RobotModel
from robotid.variation.mixed_effects import Runs

__all__ = ["FEWEST_RUNS", "Covariate", "Group", "RunsOf", "inflation_of", "runs_of"]

#: Smallest number of runs whose scatter is estimated.
FEWEST_RUNS = 3
_DRIVE = 0.1  # plausible standard deviation of a drive term, over the drive's torque
_GAIN = 0.02  # ... of a gain
_MASS = 0.01  # ... of the mass on the last link, over the mass of the robot
_REACH = 0.1  # [m] ... of its centre of mass
_PAYLOAD = ("m", "mcx", "mcy", "mcz")
_SMALLEST = 0.01  # torque of a drive over that of its largest term below which this share counts
_RANK = 1e-9  # eigenvalue over the largest below which a run does not determine a direction
_LEAST = 1e-12  # smallest information and inflation
_NO_COVARIATES: Mapping[str, Sequence["Covariate"]] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Group:
    """Parameters that vary together.

    Attributes:
        kind: "drive", "gain" or "payload".
        name: Name of the drive, joint or link.
        parameters: Their names, q items.
        units: Their units, q items.
        columns: B, shape (b, q).
        rows: The joints whose torque they change, indices.
    """

    kind: str
    name: str
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    columns: Array
    rows: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Covariate:
    """A quantity of the runs that may have an effect on the parameters of a drive.

    Attributes:
        name: "temperature" or "time".
        unit: Its unit, "degC" or "h".
        values: Its value in each run, shape (k,).
    """

    name: str
    unit: str
    values: Array


@dataclass(frozen=True, eq=False)
class RunsOf:
    """The runs' information about the deviation of a group from the fit.

    Attributes:
        group: The group.
        centre: Its values in the fit, shape (q,): 0 for a payload, 1 for a gain.
        runs: Information about x, coloured noise included.
        inflation: Variance of coloured noise over that of independent rows [-].
        covariates: Quantities of the runs that may have an effect on the parameters.
        slopes: Sizes of the slopes of the runs.
        across: Rows of the group in A^T A with A = W B of all Q parameters of all groups, in their
            order, shape (k, q, Q); None: the other groups are independent of it.
    """

    group: Group
    centre: Array
    runs: Runs
    inflation: float
    covariates: tuple[Covariate, ...] = ()
    slopes: tuple[float, ...] = ()
    across: Array | None = None


def runs_of(
    model: RobotModel,
    mapping: BaseMapping,
    segments: Sequence[Sequence[Factors]],
    standard: Array,
    sigma: Array,
    unit: Array,
    covariates: Mapping[str, Sequence[Covariate]] = _NO_COVARIATES,
) -> tuple[RunsOf, ...]:
    """Return the information of each run on each group of parameters.

    Args:
        model: The robot.
        mapping: Standard to base parameters.
        segments: Factors of the segments of each run, base parameters; k items.
        standard: Standard parameters fitted to all runs, shape (p,).
        sigma: Noise level per joint, shape (n,) [N m or N].
        unit: Index of the robot of each run, shape (k,), int, from 0.
        covariates: Quantities of the runs by drive.
    """
    theta = mapping.to_base(standard)
    found = []
    for group, centre in _groups(model, mapping, standard):
        own = [_products(run, group, theta, sigma) for run in segments]
        H, h = (np.array([each[k].sum(axis=0) for each in own]) for k in (0, 1))
        if not H.any():  # no run has any effect of these parameters
            continue
        scale, inflation = _scale(group, centre, H.sum(axis=0), model, standard), inflation_of(own)
        runs = Runs(H / inflation, h / inflation, unit, scale)
        of_drive = covariates.get(group.name, ()) if group.kind == "drive" else ()
        found.append(RunsOf(group, centre, runs, inflation, tuple(of_drive)))
    across, end = _across(segments, [each.group for each in found], sigma), 0
    for k, each in enumerate(found):
        start, end = end, end + len(each.centre)
        found[k] = replace(each, across=across[:, start:end])
    return tuple(found)


def _groups(model: RobotModel, mapping: BaseMapping, standard: Array) -> list[tuple[Group, Array]]:
    """Return the groups and their values in the fit."""
    layout, base = model.layout, mapping.base_names
    rows = tuple(range(model.n_rows))
    eye, found = np.eye(len(base)), []
    units = dict(zip(layout.names, layout.units, strict=True))
    places = {name: k for k, name in enumerate(layout.names)}
    for drive in layout.drives:
        own = [k for k, name in enumerate(base) if name.rpartition(".")[0] == drive.name
               and name in layout.drive_names]  # fmt: skip
        if own:
            names = tuple(base[k] for k in own)
            own_units = tuple(units[name] for name in names)
            group = Group("drive", drive.name, names, own_units, eye[:, own], rows)
            found.append((group, standard[[places[n] for n in names]]))
    theta = mapping.to_base(standard)
    if not model.constraints:  # rows of one joint each
        first = model.n_rows - len(layout.joints)
        for j, joint in enumerate(layout.joints, start=first):
            gain = Group("gain", joint, (f"{joint}.gain",), ("-",), theta[:, None], (j,))
            found.append((gain, np.ones(1)))
    link = layout.bodies[-1]
    names = tuple(f"{link}.{term}" for term in _PAYLOAD)
    columns = mapping.K[:, [places[name] for name in names]]
    payload = Group("payload", link, names, tuple(units[n] for n in names), columns, rows)
    return [*found, (payload, np.zeros(len(names)))]


def _products(
    segments: Sequence[Factors], group: Group, theta: Array, sigma: Array
) -> tuple[Array, Array]:
    """Return A^T A (s, q, q) and A^T r (s, q) of each segment with A = W B, r = tau - W theta.

    Rows are divided by the noise level of their joint.
    """
    q = group.columns.shape[1]
    H, g = np.zeros((len(segments), q, q)), np.zeros((len(segments), q))
    for k, segment in enumerate(segments):
        for j in group.rows:
            R, own = segment.triangles[j] / sigma[j], segment.columns[j]
            A = R[:, :-1] @ group.columns[own]
            H[k] += A.T @ A
            g[k] += A.T @ (R[:, -1] - R[:, :-1] @ theta[own])
    return H, g


def _across(segments: Sequence[Sequence[Factors]], groups: Sequence[Group], sigma: Array) -> Array:
    """Return A^T A of each run with A = W B of the Q parameters of all groups, (k, Q, Q)."""
    B = np.hstack([group.columns for group in groups]) if groups else np.zeros((0, 0))
    acts = np.array([j in g.rows for j in range(len(sigma)) for g in groups]).reshape(
        len(sigma), -1
    )
    acts = np.repeat(acts, [group.columns.shape[1] for group in groups], axis=1)
    found = np.zeros((len(segments), B.shape[1], B.shape[1]))
    for k, run in enumerate(segments):
        for segment in run:
            for j in range(len(sigma)):
                own = segment.columns[j]
                A = segment.triangles[j][:, :-1] @ (B[own] * acts[j]) / sigma[j]
                found[k] += A.T @ A
    return found


def inflation_of(runs: Sequence[tuple[Array, Array]]) -> float:
    """Return the variance of the scores of segments about each run's estimate.

    It is relative to that of independent rows of the stated noise level, and common to all runs: a
    run alone has too few segments.

    Args:
        runs: Of each run, A^T A (s, q, q) and A^T r (s, q) of its s segments.
    """
    scatter, expected = 0.0, 0.0
    for H, g in runs:
        bread = np.linalg.pinv(H.sum(axis=0), rcond=_RANK, hermitian=True)
        scores = g - H @ (bread @ g.sum(axis=0))
        scatter += float(np.einsum("si,ij,sj->", scores, bread, scores))
        leverage = H @ bread
        expected += float(np.einsum("sii->", leverage) - np.einsum("sij,sji->", leverage, leverage))
    return max(scatter / expected, _LEAST) if expected > _LEAST else 1.0


def _scale(group: Group, centre: Array, H: Array, model: RobotModel, standard: Array) -> Array:
    """Return the plausible standard deviation of each parameter of a group, shape (q,).

    Terms of a drive may change its torque by a tenth.
    """
    if group.kind == "gain":
        return np.array([_GAIN])
    if group.kind == "payload":
        mass = _MASS * float(standard[: model.layout.n_inertial : 10].sum())
        return mass * np.array([1.0, _REACH, _REACH, _REACH])
    norms = np.sqrt(np.maximum(np.diag(H), _LEAST))
    torque = np.sqrt(max(float(centre @ H @ centre), 0.0))
    least = _SMALLEST * np.abs(norms).max()
    scale: Array = _DRIVE * np.maximum(torque, least) / norms
    return scale
