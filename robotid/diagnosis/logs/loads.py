"""Checks of the torques against the URDF's masses: scale, payload, mismatch, parts, other loads."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.special

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.hypotheses import FLOOR, compensated, own_share
from robotid.diagnosis.logs.torque_sample import Probe
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Reduction, compress_segments
from robotid.dynamics.prepared_logs import base_problem, row_mask
from robotid.dynamics.rows import keep_inertial_rows
from robotid.estimation.estimators.two_runs import payload_runs
from robotid.robot.drives import COUNTERBALANCE, drive_line, spring_family
from robotid.robot.model import RobotModel
from robotid.robot.prior import payload_spread, prior_spread

_SPREAD = 0.3  # prior standard deviation of a link's mass, relative to the URDF's
_PRECISION = 0.05  # of a torque, model errors included
_INDEPENDENT = 20.0  # number of independent instants of a log
_PER_SECOND = 3.0  # ... per second of a short one
_MASS, _MOMENT = 20.0, 10.0  # [kg], [kg m] prior standard deviations of a payload
_CONSTANT = 1e-6  # of the largest torque: a torque that varies less is not used
_EXPLAINED = 0.25  # largest unexplained share of a torque whose scale is checked
_WORSE = 0.25  # allowed increase of a torque's misfit over its own fit, in variances
_ALIKE = 1.6  # ratio below which two factors are equal: they lie on a grid of steps of 1.26
_GAIN = 20.0  # decrease of the misfit from which another torque scale is accepted
_OTHER_SCALE = 3.0  # a torque scale farther from 1 is no error of masses
_OTHER_UNIT = 30.0  # ... and a common scale of all torques farther from 1 is another unit, no gain
_CLEARER = 5.0  # decrease of the misfit by a counterbalance beyond that by another scale or mass
_FREE, _LEAST = 5.0, 0.1  # spread of a mass that is not taken from the URDF, its smallest factor
_SCALES = np.logspace(-3, 3, 61)
_LARGE = 0.08  # payload over the arm's mass that errors of the links do not explain
_FOLLOWED = 0.5  # ratio of unexplained shares with and without gravity, if a torque contains it
_LIFTS = 0.3  # of the largest gravity torque: a joint with less has no counterbalance
_CANCELS, _MOST_CANCELLED = 0.2, 1.6  # limits of the share of gravity that a counterbalance cancels
_MISMATCH = 7.5  # largest sum of squared errors of the links, in standard deviations
_P_VALUE = 3e-7  # of a log without another load, five standard errors
_NOTHING = 0.01  # of the arm's mass, the smallest change of load
_CLEARLY = 1.5  # least ratio of the misfit of other torque scales to that of a load
_ROWS = 2000  # of a motion: more are not independent after the filter
_SEGMENT = 0.4  # [s] longer than the correlation of noise
_SEGMENTS = 24


@dataclass(frozen=True, eq=False)
class LoadModel:
    """The whitened torques of each joint, projected orthogonally to the columns of its drive."""

    #: Triangular factor of the c free parameters and the torque of each joint, shape (n, c+1, c+1);
    #: 0 of joints that are ignored
    R: Array
    #: Prior mean of the free parameters: factors of the URDF's links, and m, mcx, mcy, mcz of a
    #: payload
    mean: Array
    spread: Array  # Prior standard deviation, shape (c,)
    expected: float  # Misfit of torques that fit as well as with separate parameters for each joint
    independent: float  # Number of independent torques

    def misfits(self, scales: Array) -> Array:
        """Return the misfits of scaled torques: chi-squares, prior included, shape (T,)."""
        R = np.asarray(np.linalg.qr(self._rows(scales), mode="r"))  # (T, c+1, c+1)
        chi: Array = R[:, -1, -1] ** 2
        return chi

    def fit(self, scale: Array) -> tuple[float, Array, Array]:
        """Fit with the torque columns multiplied by a scale, without negative masses of links."""
        from scipy.optimize import lsq_linear

        rows = self._rows(scale[None])[0]
        bounds = np.full(len(self.mean), -np.inf)
        bounds[:-4] = 0.0
        found = lsq_linear(rows[:, :-1], rows[:, -1], bounds=(bounds, np.inf), method="bvls")
        inverse = np.linalg.inv(np.linalg.qr(rows[:, :-1], mode="r"))
        error: Array = self.spread * np.linalg.norm(inverse, axis=1)
        return 2 * float(found.cost), self.spread * found.x, error

    def _rows(self, scales: Array) -> Array:
        """Return the rows of torques and prior, columns times the spread, (T, N, c+1)."""
        c, (T, n) = len(self.mean), scales.shape
        rows = self.R * np.append(self.spread, 1.0)
        rows = np.repeat(rows[None], T, axis=0)  # (T, n, c+1, c+1)
        rows[..., :-1] /= scales[:, :, None, None]
        prior = np.column_stack([np.eye(c), self.mean / self.spread])
        prior = np.repeat(prior[None], T, axis=0)
        return np.concatenate([rows.reshape(T, n * (c + 1), c + 1), prior], axis=1)


def load_model(probe: Probe, share: Array, level: Array | None = None) -> LoadModel:
    """Return the load model of a motion: share (n,), level (n,)."""
    N, n = probe.tau.shape
    duration = float(np.ptp(probe.motion.t[probe.rows]))
    independent = min(_INDEPENDENT, _PER_SECOND * duration)
    links, last = probe.loads(), probe.last_body
    bodies = links.shape[2]
    X = np.concatenate([links, last, probe.tau[:, :, None]], axis=2)
    level = probe.tau.std(axis=0) if level is None else level
    used = (level > _CONSTANT * np.abs(probe.tau).max()) & (share < _EXPLAINED)
    R = np.zeros((n, bodies + 5, bodies + 5))
    for j in np.flatnonzero(used).tolist():
        drive = np.delete(probe.drives[:, j], 4, axis=1)
        length = np.linalg.norm(drive, axis=0)
        U, s, _ = np.linalg.svd(drive / np.where(length > 0, length, 1.0), full_matrices=False)
        Q = U[:, s > 1e-6 * s[0]]
        left = X[:, j] - Q @ (Q.T @ X[:, j])
        sigma = np.sqrt(_PRECISION**2 + share[j]) * level[j]
        R[j] = np.linalg.qr(left * np.sqrt(independent / N) / sigma, mode="r")
    mean = np.append(np.ones(bodies), np.zeros(4))
    spread = np.append(np.full(bodies, _SPREAD), [_MASS, *[_MOMENT] * 3])
    expected = independent * float((share / (_PRECISION**2 + share))[used].sum())
    return LoadModel(R, mean, spread, expected, independent * float(used.sum()))


def check_loads(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield torques in another scale, a payload, a URDF of another robot.

    Another scale is accepted if the torques then fit with about the URDF's masses; else the URDF
    is of another robot.
    """
    model = load_model(probe, share)
    bodies = len(probe.model.layout.bodies)
    chi, theta, error = model.fit(np.ones(len(share)))
    if not _is_this_robot(model, chi, theta):
        scale = _torque_scales(model)
        other = np.flatnonzero(np.abs(np.log(scale)) > np.log(_OTHER_SCALE))
        if len(other) and _is_this_robot(model, *model.fit(scale)[:2]):
            yield from _scaled(probe, scale, _needed(model, scale, other), name)
            return
        if _holds_no_gravity(probe):
            yield finding("gravity_compensated", name)
            return
        if len(other) or _error_of_links(theta) > _MISMATCH:
            yield _mismatch(probe, theta[:bodies], name)
            return
    yield from _payload(probe, theta[bodies:], float(error[bodies]), name)


def _is_this_robot(model: LoadModel, chi: float, theta: Array) -> bool:
    """Return whether torques fit well with masses of the links near the URDF's."""
    is_good = chi - model.expected < _WORSE * model.independent
    return is_good and _error_of_links(theta) < _MISMATCH


def _holds_no_gravity(probe: Probe) -> bool:
    """Return whether the torques fit the URDF if its gravity is added, and not as logged.

    Both tests use the level of the logged torques, and no load on the last link.
    """
    if not probe.gravity.any() or holds_gravity(probe):
        return False
    readings = [(probe, own_share(probe)), compensated(probe)]
    models = [load_model(reading, share, probe.tau.std(axis=0)) for reading, share in readings]
    ones = np.ones(probe.tau.shape[1])
    logged, corrected = (_is_this_robot(model, *model.fit(ones)[:2]) for model in models)
    return corrected and not logged


def holds_gravity(probe: Probe) -> bool:
    """Return whether the torque of a joint contains its gravity torque by the URDF."""
    with_gravity, without = own_share(probe), own_share(probe, np.zeros(3))
    followed = (with_gravity + FLOOR < _FOLLOWED * (without + FLOOR)) & (without < 1.0)
    return bool(followed.any())


def counterbalance(probe: Probe, name: str) -> tuple[Probe, tuple[Finding, ...]]:
    """Return a motion with its counterbalanced joint, if there is one, and the finding.

    A joint is counterbalanced if the torques do not fit the URDF's masses as they are, but fit with
    an additional torque, a cosine and a sine of its position, that opposes gravity. If a smaller
    mass of one link explains the torques as well, the finding is "link_mass".
    """
    if not probe.gravity.any():
        return probe, ()
    share, ones = own_share(probe, any_load=True), np.ones(len(probe.model.joints))
    whole = load_model(probe, share)
    if share.max() < _EXPLAINED and _is_this_robot(whole, *whole.fit(ones)[:2]):
        return probe, ()
    found: list[tuple[float, int, float, Probe]] = []
    for j in _lifting(probe):
        other = replace(probe, balanced=(j,))
        share = own_share(other, any_load=True)
        model = load_model(other, share)
        chi, theta, _ = model.fit(ones)
        cancelled = _cancelled(other, j, theta)
        if share.max() < _EXPLAINED and _is_this_robot(model, chi, theta) and cancelled > _CANCELS:
            found.append((chi, j, cancelled, other))
    if not found:
        return probe, ()
    chi, j, cancelled, other = min(found, key=lambda x: x[0])
    if not cancelled < _MOST_CANCELLED or _scaled_fit(whole) < chi + _CLEARER:
        return probe, ()
    return other, (_balanced(other, j, cancelled, _lighter(whole, chi), name),)


def _lifting(probe: Probe) -> list[int]:
    """Return the revolute joints that the URDF's gravity loads, sorted by decreasing load."""
    load = np.abs((probe.loads() - probe.loads(np.zeros(3))).sum(axis=2)).mean(axis=0)  # (n,)
    is_lifting = load > _LIFTS * load.max()
    is_lifting &= ~np.isin(probe.model.joints, list(probe.model.layout.prismatic))
    return [int(j) for j in np.argsort(-load) if is_lifting[j]]


def _cancelled(probe: Probe, j: int, theta: Array) -> float:
    """Return the share of a joint's gravity that its counterbalance cancels by the fit [-]."""
    Y = np.concatenate([probe.loads()[:, j], probe.last_body[:, j]], axis=1)
    swing = probe.swing(j)
    X = np.hstack([probe.drives[:, j, :4], swing])
    size = np.linalg.norm(X, axis=0)
    x = np.linalg.lstsq(X / size, probe.tau[:, j] - Y @ theta)[0] / size
    gravity = (probe.loads() - probe.loads(np.zeros(3)))[:, j].sum(axis=1)
    gravity, own = (y - y.mean() for y in (gravity, swing @ x[4:]))  # the offset is unknown
    return -float(gravity @ own) / float(gravity @ gravity)


def _scaled_fit(model: LoadModel) -> float:
    """Return the misfit with torques in other scales, if the URDF's masses then fit, else inf."""
    scale = _torque_scales(model)
    chi, theta, _ = model.fit(scale)
    is_other = np.abs(np.log(scale)).max() > np.log(_OTHER_SCALE)
    return chi if is_other and _is_this_robot(model, chi, theta) else np.inf


def _lighter(model: LoadModel, chi: float) -> tuple[float, int, float] | None:
    """The misfit, number and factor of a link whose mass explains torques as well as a term."""
    ones, found = np.ones(len(model.R)), []
    for k in range(len(model.mean) - 4):
        spread = model.spread.copy()
        spread[k] = _FREE
        left, theta, _ = replace(model, spread=spread).fit(ones)
        if left < chi + _CLEARER and _error_of_links(np.delete(theta, k)) < _MISMATCH:
            found.append((left, k, float(theta[k])))
    best = min(found, default=None)
    return best if best is not None and _LEAST < best[2] < 1.0 else None


def _balanced(
    probe: Probe, j: int, cancelled: float, lighter: tuple[float, int, float] | None, name: str
) -> Finding:
    joint, extent = probe.model.joints[j], float(np.ptp(probe.motion.q[:, j]))
    line = f"{drive_line(joint, spring_family(extent, COUNTERBALANCE))} in [drives]"
    evidence = {"cancelled_pct": 100 * cancelled, "turned": extent}
    if lighter is None:
        return finding("counterbalance", name, joint, setting=line, **evidence)
    _, k, factor = lighter
    evidence |= {"mass": float(probe.model.standard_parameters()[10 * k]), "factor": factor}
    link = probe.model.layout.bodies[k]
    return finding("link_mass", name, joint, setting=line, link=link, **evidence)


def _error_of_links(theta: Array) -> float:
    return float(np.sum(((theta[:-4] - 1.0) / _SPREAD) ** 2))


def _torque_scales(model: LoadModel) -> Array:
    """Return the factors of the torque columns that reduce the misfit significantly, else 1."""
    n = len(model.R)
    common = np.repeat(_SCALES[:, None], n, axis=1)
    chi = model.misfits(np.vstack([np.ones(n), common]))
    best = int(np.argmin(chi[1:]))
    starts = [np.ones(n)]
    if abs(np.log(_SCALES[best])) > np.log(_OTHER_SCALE) and chi[0] - chi[1 + best] > _GAIN:
        starts.append(common[best])
    found = np.array([_descended(model, start) for start in starts])
    scale = found[int(np.argmin(model.misfits(found)))]
    return np.where(model.R.any(axis=(1, 2)), scale, 1.0)


def _descended(model: LoadModel, scale: Array) -> Array:
    """Return the factors after a coordinate descent from initial ones."""
    n = len(scale)
    for _ in range(n):
        trials = np.repeat(scale[None], n * len(_SCALES), axis=0)
        trials[np.arange(len(trials)), np.repeat(np.arange(n), len(_SCALES))] = np.tile(_SCALES, n)
        chi = model.misfits(np.vstack([scale, trials]))
        if chi[0] - chi[1:].min() < _GAIN:
            break
        scale = trials[int(np.argmin(chi[1:]))]
    return scale


def _needed(model: LoadModel, scale: Array, other: Array) -> Array:
    """Return the joints whose other scale is needed to fit the torques; all if all are scaled."""
    if len(other) == len(scale):
        return other
    smallest = scale.copy()
    for j in other:
        without = smallest.copy()
        without[j] = 1.0
        if _is_this_robot(model, *model.fit(without)[:2]):
            smallest = without
    needed: Array = other[smallest[other] != 1.0]
    return needed


def _scaled(probe: Probe, scale: Array, other: Array, name: str) -> Iterator[Finding]:
    joints, factors = [probe.model.joints[j] for j in other], scale[other].tolist()
    code = "current_for_torque"
    if len(other) > 1 and np.ptp(np.log(factors)) < np.log(_ALIKE):
        factor = float(np.exp(np.log(factors).mean()))
        is_all = len(other) == len(scale)
        is_unit = is_all and abs(np.log(factor)) > np.log(_OTHER_UNIT)
        yield finding(
            code, name, () if is_all else joints, severity="error" if is_unit else "warning",
            factor=factor, joints=len(other), joint=listed(joints),
        )  # fmt: skip
        return
    for joint, factor in zip(joints, factors, strict=True):
        yield finding(code, name, joint, factor=factor)


def _mismatch(probe: Probe, factors: Array, name: str) -> Finding:
    found = dict(zip(probe.model.layout.bodies, factors.tolist(), strict=True))
    words = ", ".join(f"{link} {factor:.2g}" for link, factor in found.items())
    return finding("urdf_mismatch", name, factors=words, **found)


def _payload(probe: Probe, load: Array, error: float, name: str) -> Iterator[Finding]:
    mass = float(load[0])
    arm = float(probe.model.standard_parameters()[: probe.model.layout.n_inertial : 10].sum())
    if abs(mass) < 3 * error:
        return
    link = probe.model.layout.bodies[-1]
    evidence = {"mass": mass, "std_error": error, "mcx": load[1], "mcy": load[2], "mcz": load[3]}
    severity = "warning" if abs(mass) - 2 * error > _LARGE * arm else "note"
    yield finding(
        "payload",
        name,
        subject=link,
        severity=severity,
        link=link,
        sense=mass > 0,
        cure=mass > 0,
        **evidence,
    )


@dataclass(frozen=True, eq=False)
class Segments:
    """Motions of a robot, and the reduced least-squares problems of their segments."""

    model: RobotModel  # The robot
    mapping: BaseMapping  # Standard to base parameters
    motions: Sequence[Trajectory]  # The motions
    min_velocity: float  # Lower bound on the speed of the rows that are used

    @property
    def seconds(self) -> float:
        """Total duration [s]."""
        return sum(float(np.ptp(motion.t)) for motion in self.motions)

    @cached_property
    def reductions(self) -> tuple[Reduction, ...]:
        """The reduced problem of each segment, in order."""
        return tuple(part for motion in self.motions for part in self._of(motion))

    def _of(self, motion: Trajectory) -> Iterator[Reduction]:
        thin = motion.every(max(1, len(motion.t) // _ROWS))
        keep_inertial_rows(self.model, thin)  # used for the excitation, too
        count = int(np.clip(np.ptp(thin.t) / _SEGMENT, 1, _SEGMENTS))
        length = -(-len(thin.t) // count)
        rows = row_mask(self.model, thin, self.min_velocity)
        problem = base_problem(self.model, self.mapping, thin, rows, compiled=False)
        for i, factors in enumerate(compress_segments(problem, length)):
            part = thin.at(slice(i * length, (i + 1) * length))
            yield Reduction(factors, part.squares, len(part.t))


def check_payload_change(
    fitted: Segments, validation: Segments, signals: SignalSettings, name: str
) -> Iterator[Finding]:
    """Yield a warning "payload_change" if a validation log has another load than the fitted ones.

    Both are fitted together, with free parameters of all links and a load in the last link of the
    validation log only. The load is reported if the same robot with it fits both.
    """
    model, mapping = fitted.model, fitted.mapping
    first, second, layout = fitted.reductions, validation.reductions, model.layout
    every = (*first, *second)
    squares, samples = sum(r.squares for r in every), sum(r.samples for r in every)
    size = payload_spread(model)
    last = mapping.K[:, layout.n_inertial - 10 : layout.n_inertial]
    seconds = fitted.seconds + validation.seconds
    runs = payload_runs(
        first,
        second,
        layout,
        mapping.K,
        model.standard_parameters(),
        prior_spread(model, np.asarray(squares), samples),
        (last, np.full(10, np.nan), size),
        share=min(1.0, 2.0 * (signals.cutoff or np.inf) * seconds / samples),
    )
    theta, covariance = runs.alike()
    least = -float(scipy.special.ndtri(_P_VALUE)) * float(np.sqrt(covariance[-10, -10]))
    if abs(theta[-10]) <= max(least, _NOTHING * size[0]):
        return  # standard errors with changes over time are not smaller
    # the load is tested with errors that include changes over time; torque scales are tried below
    found = runs.compare(by_joint=False)
    mass, error = float(found.theta[-10]), float(np.sqrt(found.covariance[-10, -10]))
    half_width = -float(scipy.special.stdtrit(found.freedom[-10], _P_VALUE)) * error
    if not max(half_width, _NOTHING * size[0]) < abs(mass) < size[0]:
        return
    left = runs.residual_ratios(found.theta) - 1.0
    by_scales = runs.residual_ratios_by_scales(runs.D.shape[1] - 10) - 1.0
    if _CLEARLY * left.mean() > by_scales.mean():
        return  # the logs differ by another effect
    link = layout.bodies[-1]
    yield finding(
        "payload_change", name, subject=link, link=link, sense=mass > 0, mass=mass, std_error=error
    )
