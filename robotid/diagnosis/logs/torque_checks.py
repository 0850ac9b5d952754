"""Checks of the torques against the model: signs, columns, gravity, positions, masses and loads."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.special

from robotid.base.findings import Finding, listed
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.data.units import STATIC
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import BEYOND_NOISE, NO_ERROR_OF_MASSES, ROWS, SIGNIFICANT
from robotid.diagnosis.logs.hypotheses import (
    CERTAIN,
    FLOOR,
    HINT,
    MUCH_BETTER,
    Explanation,
    Probe,
    compensated,
    explanations,
    own_share,
)
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Reduction, compress_segments
from robotid.dynamics.prepared_logs import base_problem, row_mask
from robotid.dynamics.rows import keep_inertial_rows
from robotid.estimation.estimators.two_runs import payload_runs
from robotid.robot.model import RobotModel
from robotid.robot.prior import payload_spread, prior_spread

_UNEXPLAINED = 0.25  # unexplained share of a torque's variance that is reported, not accepted
_WRONG = 0.5  # largest unexplained share of a torque with the right sign, or over that without
# gravity, if the torque contains gravity
_TILT, _WRONG_TILT = 5.0, 30.0  # [deg] angles of gravity from the stated one: warning and error
_SPREAD = 0.3  # prior standard deviation of a link's mass, relative to the URDF's
_PRECISION = 0.05  # of a torque, model errors included
_INDEPENDENT, _PER_SECOND = 20.0, 3.0  # independent instants of a log, per second of a short one
_MASS, _MOMENT = 20.0, 10.0  # [kg], [kg m] prior standard deviations of a payload
_WORSE = 0.25  # allowed increase of a torque's misfit over its own fit, in variances
_OTHER_UNIT = 30.0  # a common scale of all torques farther from 1 is another unit, no gain
_SCALES = np.logspace(-3, 3, 61)
_ALIKE = _SCALES[2] / _SCALES[0]  # ratio below which two factors on this grid are equal
_LARGE = 0.08  # payload over the arm's mass that errors of the links do not explain
_MISMATCH = 7.5  # largest sum of squared errors of the links, in standard deviations
_NOTHING = 0.01  # of the arm's mass, the smallest change of load
_CLEARLY = 1.5  # least ratio of the misfit of other torque scales to that of a load
_SEGMENT, _SEGMENTS = 0.4, 24  # [s] longer than the correlation of noise; most of them


@dataclass(frozen=True)
class _Reading:
    """The reading of a log that explains its torques best, and the stated one."""

    probe: Probe
    stated: Explanation
    best: Explanation
    log: str

    @property
    def gain(self) -> float:
        return self.stated.misfit - self.best.misfit

    @property
    def is_certain(self) -> bool:
        is_explained = float(np.median(self.best.share)) < _UNEXPLAINED
        return is_explained and self.gain > CERTAIN

    @property
    def joints(self) -> list[str]:
        return [self.probe.model.joints[j] for j in self.best.joints]


def check_torques(probe: Probe, name: str) -> Iterator[Finding]:
    """Yield the faults of signs, columns, gravity or URDF that keep the torques from fitting."""
    # Only the best reading is reported; if it is the stated one, the URDF's masses are checked.
    stated, loaded, others = explanations(probe)
    best = min(others, key=lambda e: e.misfit)
    if best.kind not in _SIGNS and loaded.misfit < best.misfit:
        best = stated  # a load explains the torques better
    make = _FINDINGS.get(best.kind)
    findings = list(make(_Reading(probe, stated, best, name))) if make else []
    for one in findings:
        # a fault that a load on the last link explains as well is only a warning
        yield replace(one, severity="warning") if _is_excused(best, loaded) else one
    if not findings:
        yield from _check_loads(probe, loaded.share, name)
        # the friction of a joint at rest has any value: nothing contradicts its torque
        still = np.ptp(probe.motion.q, axis=0) < STATIC
        yield from _unexplained(probe, np.where(still, 0.0, loaded.share), name)


def _sign(reading: _Reading) -> Iterator[Finding]:
    code = reading.best.kind
    for j, joint in zip(reading.best.joints, reading.joints, strict=True):
        before, after = reading.stated.share[j], reading.best.share[j]
        figures = {"unexplained": before, "unexplained_if_negated": after}
        if code == "unsigned_torque":
            figures = {"unexplained": before, "unexplained_with_signs": after}
        if after <= _UNEXPLAINED and (before >= _WRONG or code == "unsigned_torque"):
            yield finding(code, reading.log, joint, kind="one", cure="one", **figures)


def _moved(reading: _Reading) -> Iterator[Finding]:
    """Yield the error that columns contain other quantities than stated."""
    if not reading.is_certain:
        return
    before, best, joints = reading.stated.share, reading.best, reading.probe.model.joints
    words: dict[str, float | str] = {}
    if best.kind == "torque_order":
        pairs = [(joints[j], joints[int(best.values[j])]) for j in best.joints]
        words["owners"] = ", ".join(f"tau_{a} is the torque of {b}" for a, b in pairs)
    elif best.kind not in ("joint_order", "position_order"):
        worst = int(np.argmax(before - best.share))
        words = {"worst": joints[worst], "before": before[worst], "after": best.share[worst]}
        words |= {"what": "log", "cure": "log"} | dict(zip(["offset"], best.values, strict=False))
    yield finding(
        best.kind, reading.log, reading.joints, gain=reading.gain, unexplained=before.max(),
        unexplained_so_read=best.share.max(), **words,
    )  # fmt: skip


def _gravity(reading: _Reading) -> Iterator[Finding]:
    g, believed, gain = np.array(reading.best.values), reading.probe.gravity, reading.gain
    size = float(np.linalg.norm(believed))
    if not g.any():
        if size > 0 and reading.is_certain and not _holds_gravity(reading.probe):
            yield finding("gravity_compensated", reading.log, gain=gain)
        return
    cosine = float(g @ believed) / (float(np.linalg.norm(g)) * size) if size > 0 else 0.0
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    is_wrong = angle > _WRONG_TILT and reading.is_certain
    if not is_wrong and (angle < _TILT or gain < HINT):
        return
    best, stated = (", ".join(f"{x:.2f}" for x in vector) for vector in (g, believed))
    evidence = {"angle_deg": angle, "x": g[0], "y": g[1], "z": g[2], "gain": gain}
    yield finding(
        "gravity", reading.log, severity="error" if is_wrong else "warning", what="log",
        cure="log", best=best, stated=stated, **evidence,
    )  # fmt: skip


_SIGNS = ("torque_sign", "unsigned_torque")
_MOVED = ("torque_order", "joint_order", "position_order", "joint_axis", "position_sign",
          "position_offset")  # fmt: skip
_FINDINGS: dict[str, Callable[[_Reading], Iterator[Finding]]] = {
    **dict.fromkeys(_SIGNS, _sign), "gravity": _gravity,
    **dict.fromkeys(_MOVED, _moved),
}  # fmt: skip


def _is_excused(best: Explanation, loaded: Explanation) -> bool:
    if best.kind in _SIGNS:
        j = list(best.joints)
        enough = np.minimum(_UNEXPLAINED, MUCH_BETTER * (best.share[j] + FLOOR))
        return bool((loaded.share[j] < enough).all())
    return loaded.misfit - best.misfit < CERTAIN


def _unexplained(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield torques with a large unexplained share; one finding if these are most of them."""
    code, bad = "unexplained_torque", np.flatnonzero(share > _UNEXPLAINED)
    if 2 * len(bad) > len(share):
        middle = float(np.median(share))
        yield finding(code, name, what="robot", joints=len(bad), of=len(share), share=middle)
        return
    for j in bad:
        yield finding(code, name, probe.model.joints[j], what="joint", share=share[j])


@dataclass(frozen=True, eq=False)
class LoadModel:
    """The whitened torques of each joint, projected orthogonally to the columns of its drive."""

    # The c free parameters are factors of the URDF's links, and m, mcx, mcy, mcz of a payload.

    R: Array  # (n, c+1, c+1), triangular factors of columns and torque; 0 of joints not used
    mean: Array  # (c,), prior mean
    spread: Array  # (c,), prior standard deviation
    expected: float  # Misfit of torques that fit as well as with separate parameters for each joint
    independent: float  # Number of independent torques

    def misfits(self, scales: Array) -> Array:
        """Return the misfits of scaled torques: chi-squares, prior included, shape (T,)."""
        R = np.asarray(np.linalg.qr(self._rows(scales), mode="r"))  # (T, c+1, c+1)
        return np.asarray(R[:, -1, -1] ** 2)

    def fit(self, scale: Array) -> tuple[float, Array, Array]:
        """Fit with the torque columns multiplied by a scale, without negative masses of links."""
        from scipy.optimize import lsq_linear

        rows = self._rows(scale[None])[0]
        bounds = np.full(len(self.mean), -np.inf)
        bounds[:-4] = 0.0
        solution = lsq_linear(rows[:, :-1], rows[:, -1], bounds=(bounds, np.inf), method="bvls")
        inverse = np.linalg.inv(np.linalg.qr(rows[:, :-1], mode="r"))
        error: Array = self.spread * np.linalg.norm(inverse, axis=1)
        return 2 * float(solution.cost), self.spread * solution.x, error

    def is_this_robot(self, scale: Array) -> bool:
        """Return whether scaled torques fit well with masses of the links near the URDF's."""
        chi, theta, _ = self.fit(scale)
        is_good = chi - self.expected < _WORSE * self.independent
        return is_good and _error_of_links(theta) < _MISMATCH

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
    links = probe.loads()
    bodies = links.shape[2]
    X = np.concatenate([links, probe.last_body, probe.tau[:, :, None]], axis=2)
    level = probe.tau.std(axis=0) if level is None else level
    used = (level > TINY * np.abs(probe.tau).max()) & (share < _UNEXPLAINED)
    R = np.zeros((n, bodies + 5, bodies + 5))
    for j in np.flatnonzero(used).tolist():
        drive = np.delete(probe.drives[:, j], 4, axis=1)
        length = np.linalg.norm(drive, axis=0)
        U, s, _ = np.linalg.svd(drive / np.where(length > 0, length, 1.0), full_matrices=False)
        Q = U[:, s > TINY * s[0]]
        left = X[:, j] - Q @ (Q.T @ X[:, j])
        sigma = np.sqrt(_PRECISION**2 + share[j]) * level[j]
        R[j] = np.linalg.qr(left * np.sqrt(independent / N) / sigma, mode="r")
    mean = np.append(np.ones(bodies), np.zeros(4))
    spread = np.append(np.full(bodies, _SPREAD), [_MASS, *[_MOMENT] * 3])
    expected = independent * float((share / (_PRECISION**2 + share))[used].sum())
    return LoadModel(R, mean, spread, expected, independent * float(used.sum()))


def _check_loads(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield torques in another scale, a payload, a URDF of another robot."""
    # Another scale must fit with about the URDF's masses; else the URDF is of another robot.
    model, ones = load_model(probe, share), np.ones(len(share))
    bodies = len(probe.model.layout.bodies)
    _, theta, error = model.fit(ones)
    if not model.is_this_robot(ones):
        scale = _torque_scales(model)
        other = np.flatnonzero(np.abs(np.log(scale)) > np.log(NO_ERROR_OF_MASSES))
        if len(other) and model.is_this_robot(scale):
            yield from _scaled(probe, scale, _needed(model, scale, other), name)
            return
        if _holds_no_gravity(probe):
            yield finding("gravity_compensated", name)
            return
        if len(other) or _error_of_links(theta) > _MISMATCH:
            factors = dict(zip(probe.model.layout.bodies, theta[:bodies].tolist(), strict=True))
            words = ", ".join(f"{link} {factor:.2g}" for link, factor in factors.items())
            yield finding("urdf_mismatch", name, factors=words, **factors)
            return
    yield from _payload(probe, theta[bodies:], float(error[bodies]), name)


def _holds_no_gravity(probe: Probe) -> bool:
    """Return whether the torques fit the URDF if its gravity is added, and not as logged."""
    # Both tests use the level of the logged torques, and no load on the last link.
    if not probe.gravity.any() or _holds_gravity(probe):
        return False
    level, ones = probe.tau.std(axis=0), np.ones(probe.tau.shape[1])
    readings = (probe, own_share(probe)), compensated(probe)
    logged, corrected = (load_model(*x, level).is_this_robot(ones) for x in readings)
    return corrected and not logged


def _holds_gravity(probe: Probe) -> bool:
    """Return whether the torque of a joint contains its gravity torque by the URDF."""
    share, without = own_share(probe), own_share(probe, np.zeros(3))
    return bool(((share + FLOOR < _WRONG * (without + FLOOR)) & (without < 1.0)).any())


def _error_of_links(theta: Array) -> float:
    return float(np.sum(((theta[:-4] - 1.0) / _SPREAD) ** 2))


def _torque_scales(model: LoadModel) -> Array:
    """Return the factors of the torque columns that reduce the misfit significantly, else 1."""
    # In rounds: all torques by a factor that no errors of masses explain, or one torque more.
    n, scale = len(model.R), np.ones(len(model.R))
    common = _SCALES[np.abs(np.log(_SCALES)) > np.log(NO_ERROR_OF_MASSES)]
    for _ in range(n):
        one = np.where(np.eye(n, dtype=bool)[:, None], _SCALES[:, None], scale).reshape(-1, n)
        trials = np.vstack([scale, np.repeat(common[:, None], n, axis=1), one])
        chi = model.misfits(trials)
        if chi[0] - chi.min() < SIGNIFICANT**2:
            break
        scale = trials[int(np.argmin(chi))]
    return np.where(model.R.any(axis=(1, 2)), scale, 1.0)


def _needed(model: LoadModel, scale: Array, other: Array) -> Array:
    """Return the joints whose other scale is needed to fit the torques; all if all are scaled."""
    if len(other) == len(scale):
        return other
    smallest = scale.copy()
    for j in other:
        without = np.where(np.arange(len(scale)) == j, 1.0, smallest)
        if model.is_this_robot(without):
            smallest = without
    return np.asarray(other[smallest[other] != 1.0])


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


def _payload(probe: Probe, load: Array, error: float, name: str) -> Iterator[Finding]:
    mass = float(load[0])
    arm = float(probe.model.standard_parameters()[: probe.model.layout.n_inertial : 10].sum())
    if abs(mass) < BEYOND_NOISE * error:
        return
    link = probe.model.layout.bodies[-1]
    yield finding(
        "payload", name, subject=link, link=link, sense=mass > 0, cure=mass > 0,
        severity="warning" if abs(mass) - 2 * error > _LARGE * arm else "note",
        mass=mass, std_error=error, mcx=load[1], mcy=load[2], mcz=load[3],
    )  # fmt: skip


def reductions_of(
    model: RobotModel, mapping: BaseMapping, motions: Sequence[Trajectory], min_velocity: float
) -> Iterator[Reduction]:
    """Yield the reduced least-squares problem of each segment of motions, in order."""
    for motion in motions:
        thin = motion.every(max(1, len(motion.t) // ROWS))
        keep_inertial_rows(model, thin)  # used for the excitation, too
        count = int(np.clip(np.ptp(thin.t) / _SEGMENT, 1, _SEGMENTS))
        length = -(-len(thin.t) // count)
        problem = base_problem(
            model, mapping, thin, row_mask(model, thin, min_velocity), compiled=False
        )
        for i, factors in enumerate(compress_segments(problem, length)):
            part = thin.at(slice(i * length, (i + 1) * length))
            yield Reduction(factors, part.squares, len(part.t))


def check_payload_change(
    model: RobotModel, mapping: BaseMapping, fitted: Sequence[Reduction],
    validation: Sequence[Reduction], independent: float, name: str,
) -> Iterator[Finding]:  # fmt: skip
    """Yield a warning if a validation log has another load than the fitted ones."""
    # Both logs are fitted together, with a load in the last link of the validation log only.
    layout, every = model.layout, (*fitted, *validation)
    squares, samples = sum(r.squares for r in every), sum(r.samples for r in every)
    size = payload_spread(model)
    last = mapping.K[:, layout.n_inertial - 10 : layout.n_inertial]
    runs = payload_runs(
        fitted, validation, layout, mapping.K, model.standard_parameters(),
        prior_spread(model, np.asarray(squares), samples), (last, np.full(10, np.nan), size),
        share=min(1.0, independent / samples),
    )  # fmt: skip
    theta, covariance = runs.alike()
    least = SIGNIFICANT * float(np.sqrt(covariance[-10, -10]))
    if abs(theta[-10]) <= max(least, _NOTHING * size[0]):
        return  # standard errors with changes over time are not smaller
    # the load is tested with errors that include changes over time; torque scales are tried below
    changed = runs.compare(by_joint=False)
    mass, error = float(changed.theta[-10]), float(np.sqrt(changed.covariance[-10, -10]))
    p_value = scipy.special.ndtr(-SIGNIFICANT)
    half_width = -float(scipy.special.stdtrit(changed.freedom[-10], p_value)) * error
    if not max(half_width, _NOTHING * size[0]) < abs(mass) < size[0]:
        return
    left = runs.residual_ratios(changed.theta) - 1.0
    by_scales = runs.residual_ratios_by_scales(runs.D.shape[1] - 10) - 1.0
    if _CLEARLY * left.mean() > by_scales.mean():
        return  # the logs differ by another effect
    link = layout.bodies[-1]
    yield finding(
        "payload_change", name, subject=link, link=link, sense=mass > 0, mass=mass, std_error=error
    )
