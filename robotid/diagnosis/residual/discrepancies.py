"""Readings of recordings and the URDF: offsets, scales, clocks, gravity, forces, joints' places.

Other masses cannot imitate any of these: each changes the predicted torque tau(q, v, a) in its own
way. To first order, in all joints together,

    tau_measured - tau = W delta + Z x + e,    Z = d tau / d x,

where W delta is the effect of other base parameters, and x the sizes of the difference, 0 if there
is none. A reading is an entry of ``readings``; ``Trials.accepted`` compares them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import compress

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import Option
from robotid.diagnosis.residual.log_differences import OtherLogs, unlike_log
from robotid.diagnosis.residual.misfit import Misfit, find_misfits
from robotid.diagnosis.residual.term_trials import Accepted, Sample, Trials, along, regressor
from robotid.dynamics.torque import (
    TorqueSlopes,
    body_slopes,
    drive_torque,
    force_slopes,
    inverse_dynamics,
    is_loaded,
    torque_rate,
)
from robotid.estimation.fitting.fitted import Fit
from robotid.robot.model import RobotModel

_SPLINES = 40  # largest number of B-splines in time ...
_BLOCKS = 3  # ... and blocks that are held out, of one of them
_Altered = tuple[RobotModel, Sequence[Trajectory]]


@dataclass(frozen=True)
class Reading:
    """Another reading of the recordings or the URDF."""

    code: str  # of its finding
    least: float  # smallest size that changes a result
    groups: Sequence[tuple[str, ...]]  # of joints that it is tried for; (): all of them together
    #: Derivative of the torques (N, n, c) by its c sizes; (n,) is 1 for the joints of a group.
    columns: Callable[[Array], Array]
    #: Robot and motions with sizes (c,), where torques are nonlinear in them.
    applied: Callable[[Array, Array], _Altered] | None = None
    changes: bool = False  # whether its sizes change in time
    is_positive: bool = False  # whether only a positive size is possible


def readings(model: RobotModel, pi: Array, sample: Sample) -> tuple[Reading, ...]:
    """Return the readings that are tried, an entry each."""
    of_motions = [body_slopes(model, pi, motion) for motion in sample.at]
    by = TorqueSlopes(*map(np.concatenate, zip(*of_motions, strict=True)))
    return *_of_recordings(model, pi, sample, by), *_of_robot(model, pi, sample, by)


def _of_recordings(
    model: RobotModel, pi: Array, sample: Sample, by: TorqueSlopes
) -> tuple[Reading, ...]:
    """Return the readings of positions, torques and time."""
    joints, at = model.joints, sample.at
    tau, of_drives = _torques(model, pi, at), _drives(model, pi, at)
    inertial = tau - of_drives - _torques(model, _bodies(model, pi), _still(at))
    of_bodies = (by.by_q, by.by_v, by.by_a)
    by_motion = [D + _drive_slopes(model, pi, at, x) for D, x in zip(of_bodies, "qva", strict=True)]
    q, v, a = (np.concatenate([getattr(m, key) for m in at]) for key in "qva")
    recorded = [*zip(sample.recordings, sample.taken, strict=True)]
    jerk = np.concatenate([torque_rate(x.trajectory.a, x.trajectory)[k] for x, k in recorded])
    direction = np.column_stack([motion.direction for motion in sample.motions])

    def changed(*motion: Array) -> Array:
        """Return the change of the torques with that of positions, velocities, accelerations."""
        parts = zip(by_motion, motion, strict=True)
        return np.asarray(sum(D @ x[..., None] for D, x in parts))

    def moved(scale: Array, shift: Array) -> Array:
        """Return the derivative of the torques for positions (1 + e scale) q + e shift by e."""
        return changed(scale * q + shift, scale * v, scale * a)

    def with_rates(motion: Trajectory) -> Array:
        """Return the torques of the bodies and two derivatives by time, (3, N, n)."""
        rates = [inverse_dynamics(model, _bodies(model, pi), motion)]
        for _ in range(2):
            rates.append(torque_rate(rates[-1], motion))
        return np.stack(rates)

    def offset(on: Array, x: Array) -> _Altered:
        return model, [replace(m, q=m.q + x * on) for m in at]

    late = -changed(v, a, jerk)  # (N, n, 1)
    load = np.concatenate([with_rates(x.trajectory)[:, k] for x, k in recorded], axis=1)
    load /= np.maximum(np.sqrt(np.mean(load[0] ** 2, axis=0)), decisions.NOTHING)
    side = np.tanh(load[0] / decisions.ZERO)  # of the gear that is loaded
    one, every = [(joint,) for joint in joints], [tuple[str, ...]()]
    mean, most = side[: sample.rows].mean(axis=0), 1 - 2 * decisions.SHARE_OF_ROWS
    both_sides = [x for x, is_both in zip(one, np.abs(mean) < most, strict=True) if is_both]
    driven = [(joint,) for joint, size in zip(joints, sample.torque, strict=True) if size]
    wrists = [joints[first:] for first in range(1, len(joints) - 1)]  # with drives of one type
    return (
        Reading("position_offset", 0.01, one, lambda on: moved(0 * on, on), offset),
        Reading("lost_motion", 0.005, one, lambda on: 0.5 * moved(0 * on, direction * on)),
        Reading("lost_motion:load", 0.005, both_sides, lambda on: 0.5 * moved(0 * on, side * on)),
        Reading(
            "joint_elasticity", 0.0, one,
            lambda on: -sum(D @ x[..., None] for D, x in zip(of_bodies, load * on, strict=True)),
            is_positive=True,
        ),
        Reading("angle_scale", 0.02, one + every, lambda on: moved(on, 0 * on)),
        Reading("torque_scale", 0.05, driven + wrists, lambda on: (tau * on)[..., None]),
        Reading("time_scale", 0.04, every, lambda on: inertial[..., None]),
        Reading("joint_delay", 0.003, one, lambda on: late * on[:, None]),
    )  # fmt: skip


def _of_robot(
    model: RobotModel, pi: Array, sample: Sample, by: TorqueSlopes
) -> tuple[Reading, ...]:
    """Return the readings of gravity, forces and the places of joints."""
    at, shape = sample.at, (len(by.by_q), len(model.joints), -1)
    down = np.array(model.pin_model.gravity.linear)
    g = float(np.linalg.norm(down))
    across = g * np.linalg.svd(down[None])[2][1:]  # (2, 3)

    def tilted(on: Array, x: Array) -> _Altered:
        other = down + x @ across  # by angles with these tangents
        return model.with_gravity(other * g / np.linalg.norm(other)), at

    def weighed(on: Array) -> Array:
        # of the URDF's masses: those of the fit may have adapted to a base that moves
        bodies, still = _bodies(model, model.standard_parameters()), _still(at)
        pulled = [_torques(model.with_gravity(axis), bodies, still) for axis in g * np.eye(3)]
        return np.stack(pulled, axis=2)

    one, every = [(joint,) for joint in model.joints], [tuple[str, ...]()]

    @cache
    def push() -> Array:
        return np.concatenate([force_slopes(model, motion) for motion in at])

    level = every if down.any() else []
    return (
        Reading("gravity", 0.025, level, lambda on: by.by_gravity @ across.T, tilted),
        Reading("moving_gravity", 0.025, level, lambda on: g * by.by_gravity, changes=True),
        Reading("moving_gravity", 0.025, level, weighed, changes=True),
        Reading("external_force", 0.0, every, lambda on: push()[..., :3]),
        Reading("external_force", 0.0, every, lambda on: push()[..., 3:]),
        Reading("external_force", 0.0, every, lambda on: push()[..., 3:], changes=True),
        Reading("joint_origin", 0.01, one, lambda on: by.by_origin[:, :, on > 0].reshape(shape)),
        Reading(
            "axis_direction:residual", 0.03, one,
            lambda on: by.by_axis[:, :, on > 0].reshape(shape),
        ),
        Reading(
            "axis_direction:residual", 0.03, [] if model.layout.prismatic else one,
            lambda on: _turned_alone(model, by, int(on.argmax())),
        ),
    )  # fmt: skip


def _turned_alone(model: RobotModel, by: TorqueSlopes, j: int) -> Array:
    """Return the derivative by turning a joint's axis, not what it carries, shape (N, n, 2)."""
    axes = {joint.name: joint.axis for joint in model.tree.joints}
    axis = np.array([axes[name] for name in model.joints])  # (n, 3)
    across = np.stack([np.linalg.svd([x])[2][1:] for x in axis])  # (n, 2, 3)
    engine, Z = model.pin_model, by.by_axis[:, :, j].copy()
    for k in (k for k in range(len(axis)) if engine.parents[k + 1] == j + 1):
        place = engine.jointPlacements[k + 1]  # it turns back about the origin of joint j
        back = across[j] @ place.rotation  # (2, 3), in the frame of joint k
        Z -= by.by_origin[:, :, k] @ np.cross(across[j], place.translation).T
        Z -= by.by_axis[:, :, k] @ across[k] @ back.T + by.by_q[:, :, k, None] * (back @ axis[k])
    return Z


def _still(at: Sequence[Trajectory]) -> list[Trajectory]:
    """Return motions at rest."""
    return [replace(m, v=0.0 * m.v, a=0.0 * m.a) for m in at]


def _bodies(model: RobotModel, pi: Array) -> Array:
    """Return standard parameters without drives, shape (p,)."""
    return np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)


def _drive_slopes(model: RobotModel, pi: Array, at: Sequence[Trajectory], key: str) -> Array:
    """Return the derivatives of the drives' torques by q, v or a of each joint, (N, n, n)."""
    # Drives of their own joints only: all joints are moved together.
    h, every, before = decisions.STEP, np.eye(len(model.joints)), _drives(model, pi, at)
    is_plain = np.array_equal(model.layout.drive_ratios, every) and not is_loaded(model)
    moves = every.sum(axis=0, keepdims=True) if is_plain else every
    ends = [[replace(m, **{key: getattr(m, key) + h * on}) for m in at] for on in moves]
    D = np.stack([(_drives(model, pi, end) - before) / h for end in ends], axis=2)
    return D * every if is_plain else D


def _torques(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of motions by standard parameters, shape (N, n)."""
    return np.concatenate([inverse_dynamics(model, pi, motion) for motion in at])


def _drives(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of drives in motions, shape (N, n)."""
    return np.concatenate([drive_torque(model, pi, motion) for motion in at])


@dataclass(frozen=True, eq=False)
class _Alteration:
    """A reading for a group of joints."""

    reading: Reading
    joints: tuple[str, ...]  # none: all of them
    on: Array  # (n,), 1 for them

    def values(self, x: Array, unit: str) -> dict[str, float | str]:
        """Return the values of the finding for sizes (c,)."""
        position = f"q_{self.joints[0]}" if self.joints else "every position"
        number = "one" if len(self.joints) == 1 else "more"
        residual: dict[str, float | str] = {"what": "residual", "cure": "residual"}
        factor: dict[str, float | str] = {"factor": 1 + x[0]}
        values: dict[str, dict[str, float | str]] = {
            "position_offset": {"correction": -x[0]},
            "angle_scale": factor | residual | {"named": position},
            "torque_scale": factor | {"what": number, "cure": number},
            "time_scale": factor | residual | {"speed": np.sqrt(max(1 + x[0], 0.0))},
            "external_force": {"what": "constant", "cure": "constant"},
        }
        more: dict[str, float | str] = {"named": ", ".join(self.joints) or "all joints"}
        more |= {"unit": unit} | values.get(self.reading.code, {})
        if (applied := self.reading.applied) is not None:
            more |= residual
            if self.reading.code == "gravity":
                g = applied(self.on, x)[0].pin_model.gravity.linear
                more["best"] = ", ".join(f"{value:.2f}" for value in g)
        return more


def explain_residual(
    fit: Fit, sample: Sample | None, *, is_one_robot: bool = True
) -> tuple[tuple[Misfit, ...], tuple[Finding, ...]]:
    """Return the terms that drive models lack, and differences of recordings or URDF."""
    # A spring and a position offset imitate each other: what explains more of the whole residual is
    # accepted first, and the other is tested again together with it.
    model = fit.model
    if sample is None or model.free_flyer or model.constraints or model.passive:
        return (), ()
    table = readings(model, fit.standard, sample)
    possible = alterations(model, [reading for reading in table if not reading.changes])
    misfits, explained = find_misfits(sample), sample
    altered_by = list(_accepted(model, sample, possible))
    if altered_by:
        altered = np.concatenate([possible[alteration] for alteration, *_ in altered_by], axis=2)
        explained = altered_by[0][2].with_columns(altered)
    unlike = unlike_log(sample) if is_one_robot else None
    every = explained.with_columns(_columns(misfits, sample)) if misfits else explained
    if unlike and unlike_log(every):  # no term or reading of all logs explains it
        separated, between = _between(model, sample, unlike[0])
        if between:
            misfits, others = explain_residual(fit, separated, is_one_robot=False)
            return misfits, (*between, *others)
    unlike = unlike_log(every, friction=True) if is_one_robot else None
    friction = () if unlike is None else (_friction(sample, *unlike),)
    changing = tuple(_changing(model, sample, [x for x in table if x.changes], possible))
    if changing:  # it imitates all other readings and terms
        return (), changing
    if misfits and altered_by:
        lacking = _columns(misfits, sample)
        if _left(sample, altered) < _left(sample, lacking):
            alone = {(misfit.joint, misfit.term.code) for misfit in misfits}
            misfits = tuple(m for m in find_misfits(explained) if (m.joint, m.term.code) in alone)
        else:
            among = {alteration for alteration, *_ in altered_by}
            retested = _accepted(model, sample.with_columns(lacking), possible)
            altered_by = [one for one in retested if one[0] in among]
    return misfits, (*(one for _, one, _ in altered_by), *friction)


def _friction(sample: Sample, others: OtherLogs, shares: Array) -> Finding:
    """Return the finding of a log with other friction, by the share of each joint's torque."""
    name = next(compress(sample.recordings, others.is_out)).log.name
    joints = list(compress(sample.joints, shares > decisions.MISFIT_MATTERS))
    figures = {"named": listed(joints), "change_pct": 100 * shares.max()}
    return finding("log_differs:friction", name, joints, also=False, **figures)


def _between(model: RobotModel, sample: Sample, others: OtherLogs) -> tuple[Sample, list[Finding]]:
    """Return samples with columns for what is different in one log, and its finding."""
    own, rows = others.left_out(sample)
    possible = alterations(model, [*_of_log(model, own, others)])
    before = float(Trials(own, np.empty((*own.r.shape, 0))).held_out.left([]).sum())
    noise = own.share * np.count_nonzero(own.weight)
    for alteration, difference, _ in _accepted(model, own, possible, own.recordings[0].log.name):
        left = (1.0 - 0.01 * difference.evidence["share_pct"]) * before - noise
        if left > decisions.BETTER**2 * (before - noise):
            break  # it is not clear
        columns = np.zeros((*sample.r.shape, possible[alteration].shape[2]))
        columns[rows] = possible[alteration]
        return sample.with_columns(columns), [difference]
    return sample, []


def _of_log(model: RobotModel, sample: Sample, others: OtherLogs) -> Iterator[Reading]:
    """Yield the readings of one log that differs from others: of its channels, a load, a robot."""
    for reading in readings(model, sample.standard, sample):
        if reading.code in ("position_offset", "torque_scale", "joint_delay", "gravity"):
            together = [()] * (reading.code in ("torque_scale", "joint_delay"))
            yield replace(reading, groups=[*reading.groups, *together])
    pi, at = sample.standard, sample.at
    friction = _drives(model, pi, [replace(m, a=0.0 * m.a) for m in at])
    inertial = _torques(model, pi, at) - friction - _torques(model, _bodies(model, pi), _still(at))
    yield Reading("time_scale", 0.04, [()], lambda on: inertial[..., None])
    last = slice(model.layout.n_inertial - 10, model.layout.n_inertial)
    load = np.concatenate([regressor(model, motion)[..., last] for motion in at])
    weight = np.where(sample.weight > 0.0, sample.weight, np.inf)[..., None]
    yield Reading("payload", 0.0, [()], lambda on: load)
    if others.is_out.count(False) > 1:  # they agree: it is no error of the model
        yield Reading("robot", 0.0, [()], lambda on: sample.W[..., : len(sample.U)] / weight)


def _columns(misfits: Sequence[Misfit], sample: Sample) -> Array:
    """Return the columns of terms that drive models lack, shape (N, n, c)."""
    places = [(m.term, sample.joints.index(m.joint)) for m in misfits]
    columns = [(term.columns(sample.motions[j]), j) for term, j in places]  # (N, k) each
    one = np.eye(len(sample.joints))
    return np.concatenate([one[j][:, None] * of_joint[:, None] for of_joint, j in columns], axis=2)


def _left(sample: Sample, Z: Array) -> float:
    """Return the squared residual of held-out segments with columns added."""
    left = Trials(sample, Z).held_out.left(list(range(Z.shape[2])))
    return float(left[: sample.fitted].sum())


def alterations(model: RobotModel, table: Sequence[Reading]) -> dict[_Alteration, Array]:
    """Return each reading for each of its groups of joints, and its columns (N, n, c)."""
    columns = {}
    for reading in table:
        for joints in reading.groups:
            on = np.isin(model.joints, joints or model.joints).astype(float)
            columns[_Alteration(reading, joints, on)] = reading.columns(on)
    return columns


def _changing(
    model: RobotModel, sample: Sample, in_time: Sequence[Reading],
    constant: Mapping[_Alteration, Array],
) -> Iterator[Finding]:  # fmt: skip
    """Yield gravity or a force that changes in time and explains most of a large residual."""
    # Segments do not predict others: blocks shorter than a spline are held out. Three directions
    # explain the torques of three joints by themselves.
    n = len(sample.joints)
    squares, driven = np.sum(sample.r[: sample.rows] ** 2, axis=0), sample.torque > 0
    error = float(np.sqrt(np.max(squares[driven] / sample.torque[driven], initial=0.0)))
    count = min(_SPLINES, sample.rows // (_BLOCKS * decisions.SHORTEST))
    rows = count * _BLOCKS * decisions.SHORTEST
    if n <= 3 or error < decisions.LEAST_TERM or count < decisions.SCATTERED:
        return
    from scipy.interpolate import BSpline  # takes long to import

    folded, order = sample.in_blocks(rows, decisions.SHORTEST)
    knots = np.pad(np.linspace(0.0, rows, count - 1), 2, "edge")
    B = BSpline.design_matrix(order, knots, 2).toarray()  # (rows, count), quadratic
    last = model.layout.n_inertial - 10  # place of mass and first moments of the last body
    load = np.concatenate([regressor(model, m)[..., last : last + 4] for m in sample.at])
    starts = np.arange(1, decisions.SEGMENTS) * rows // decisions.SEGMENTS
    since = {k: load[order] * (order >= k)[:, None, None] for k in starts.tolist()}
    trials, steps = Trials.of(folded, since)
    step = next(trials.accepted(steps, decisions.ALTERATION, lambda k: 0), None)
    if step is not None and _is_main(step):
        yield _grasped(sample, step)
        return
    if error < decisions.DIFFERS:
        return
    changing = alterations(model, in_time)
    splines = {
        (one, True): (Z[order, ..., None] * B[:, None, None]).reshape(rows, n, -1)
        for one, Z in changing.items()
    }
    before = (1 - decisions.DIFFERS) * _left(folded, np.empty((rows, n, 0)))
    if all(_left(folded, Z) > before for Z in splines.values()):
        return
    plain = {(one, False): Z[order] for one, Z in {**changing, **constant}.items()}
    trials, offered = Trials.of(folded, splines | plain)
    best = next(trials.accepted(offered, decisions.ALTERATION, lambda x: len(offered[x])), None)
    if best is None or not best.option[1] or not _is_main(best):
        return
    reading, share = best.option[0].reading, 100 * best.share
    x = B @ best.theta.reshape(-1, count).T  # (rows, 3)
    mean, variance = float(np.linalg.norm(x.mean(axis=0))), np.trace(best.covariance)
    size = float(np.linalg.norm(np.std(x, axis=0)))
    if size >= max(reading.least, mean):
        yield finding(
            reading.code, subject="all joints", severity="error", what="changes", cure="changes",
            explained=False, size=size, std_error=np.sqrt(variance / count), share_pct=share,
            angle=np.degrees(np.arctan(size)), error_pct=100 * error,
        )  # fmt: skip


def _is_main(accepted: Accepted[Option]) -> bool:
    """Return whether an option explains most of the residual, significantly."""
    return 100 * accepted.share >= decisions.MAIN and accepted.p_value <= decisions.P_VALUE


def _grasped(sample: Sample, step: Accepted[int]) -> Finding:
    """Return the finding of a load that the last link carries from a sample on."""
    t = np.concatenate([motion.t for motion in sample.at])
    names = np.repeat([x.log.name for x in sample.recordings], [len(m.t) for m in sample.at])
    mass, error = float(step.theta[0]), float(np.sqrt(step.covariance[0, 0]))
    return finding(
        "payload_step", subject="all joints", sense=mass > 0, mass=mass, std_error=error,
        name=str(names[step.option]), start=t[step.option], share_pct=100 * step.share,
    )  # fmt: skip


def _accepted(
    model: RobotModel, sample: Sample, possible: Mapping[_Alteration, Array], log: str = ""
) -> Iterator[tuple[_Alteration, Finding, Sample]]:
    """Yield the alterations that explain the residual, findings, and the corrected samples."""
    trials, offered = Trials.of(sample, possible)
    trials = replace(trials, ridge=TINY)  # masses explain nearly all of a gain of last joints
    sizes = trials.whole.parameters_each(offered)
    offered = {x: k for x, k in offered.items() if not x.reading.is_positive or sizes[x][0] > 0.0}
    rule = replace(decisions.ALTERATION, alike=decisions.AGREES) if log else decisions.ALTERATION
    # the simplest of those alike has the fewest sizes, then joints
    series = trials.accepted(offered, rule, lambda one: (len(offered[one]), len(one.joints)))
    for accepted in series:
        best, size, error = accepted.option, accepted.theta, np.sqrt(np.diag(accepted.covariance))
        least, needed = best.reading.least, _needed(accepted)
        significant = decisions.SIGNIFICANT * float(np.linalg.norm(error))
        is_small = float(np.linalg.norm(size)) < max(least * needed, significant)
        if not least:  # sizes of several units are judged by their torque
            torque = np.sum((sample.weight * (trials.Z[..., offered[best]] @ size)) ** 2, axis=0)
            is_small = bool((torque < decisions.MISFIT_MATTERS**2 * sample.torque).all())
        if is_small or np.isinf(needed):
            return
        corrected = sample
        if best.reading.applied is not None and len(accepted.columns) == len(size):
            applied = partial(best.reading.applied, best.on)
            size, error, corrected = _refined(applied, size, sample.standard, sample)
        if best.reading.code == "torque_scale" and not log:
            gain = 1.0 / (1.0 - size)  # the bodies fit tau, which is gain times (1 - size) tau
            size, error = gain - 1.0, gain**2 * error
        others = [(one.reading.code, one.joints) for one in accepted.others if one.joints]
        unit = "m" if model.layout.prismatic.intersection(best.joints) else "rad"
        norm, norm_error = float(np.linalg.norm(size)), float(np.linalg.norm(error))
        angle, angle_error = np.degrees(np.arctan([norm, norm_error]))
        if len(size) == 1 or best.reading.code == "payload":  # its mass
            norm, norm_error = float(size[0]), float(error[0])
        explained = finding(
            f"log_differs:{best.reading.code}" if log else best.reading.code, log, best.joints,
            subject="" if best.joints or log else "all joints", severity="warning", explained=True,
            also=bool(others), size=norm, std_error=norm_error, share_pct=100 * accepted.share,
            others=listed(f"{x.partition(':')[0]} of {', '.join(joints)}" for x, joints in others),
            angle=angle, angle_error=angle_error, **best.values(size, unit),
        )  # fmt: skip
        yield best, explained, corrected


def _needed(accepted: Accepted[_Alteration]) -> float:
    """Return the size that an alteration needs, over its least; inf if it is not significant."""
    share, confirmed = accepted.share, accepted.confirmed
    if accepted.p_value > decisions.P_VALUE:
        return np.inf
    is_confirmed = confirmed is None or confirmed > decisions.CONFIRMED * share
    if share >= decisions.LEAST_SHARE and is_confirmed:
        return 1.0
    is_weak = confirmed is not None and confirmed > share > decisions.WEAK
    return decisions.WEAK_SIZE if is_weak and accepted.p_value < decisions.WEAK_P_VALUE else np.inf


def _refined(
    applied: Callable[[Array], _Altered], x: Array, pi: Array, sample: Sample
) -> tuple[Array, Array, Sample]:
    """Return the sizes of an alteration, their standard errors, and the samples corrected by it."""
    # Torques are nonlinear over 0.1 rad: Gauss-Newton steps until the sizes converge.
    every, error = list(range(len(x))), np.full(len(x), np.inf)
    for _ in range(decisions.STEPS):
        model, at = applied(x)
        tau = _torques(model, pi, at)
        sample = along(sample, model, at, tau)
        beyond = [applied(x + decisions.STEP * axis) for axis in np.eye(len(x))]
        moved = [_torques(model, pi, at) for model, at in beyond]
        Z = (np.stack(moved, axis=-1) - tau[..., None]) / decisions.STEP
        step, covariance = Trials(sample, Z).whole.estimate(every, sample.fitted)
        x, error = x + step, np.sqrt(np.diag(covariance))
        if np.linalg.norm(step) < decisions.SETTLED * np.linalg.norm(error):
            break
    return x, error, sample
