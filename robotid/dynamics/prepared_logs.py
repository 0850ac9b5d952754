"""Logs as a robot needs them, completed by closed chains and contacts, and the rows that are used.

The force f of a contact that a log does not state is the least-squares solution of
J^T f = W pi - tau with the URDF's bodies. A link on the ground has a force upwards, is low and
hardly moves: values of two normal distributions, with and without contact, estimated from the log.

Measured and differentiated velocities are compared by the error of each joint's torque on every
other part of the log, predicted by a fit to the other parts.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin
from scipy.special import expit

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.text import seconds
from robotid.base.tolerances import CONVERGED, LEAST_DIVISOR, NOISE_FREE
from robotid.base.typing import Array
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, standing_motion
from robotid.data.units import coarse_velocities, is_timely, unlike_velocities
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.constraint_rows import constraint_jacobian, measured_rows
from robotid.dynamics.factors import Problem
from robotid.dynamics.rows import friction_directions, friction_speeds, sure_rows
from robotid.dynamics.torque import build_problem, joint_torque_regressor, predict
from robotid.robot.closure import Chains
from robotid.robot.constraints import Contact, frame_id, link_positions
from robotid.robot.model import RobotModel

_log = logging.getLogger(__name__)

_OPEN = 0.02  # largest error of a loop at logged positions, relative to the length of the robot
_COMPUTED = 1e-5  # ... at computed ones


def closed_log(model: RobotModel, log: Log) -> Log:
    """Return the log of all joints, passive ones from the loops, and the pose of the root link."""
    if model.passive or model.loops:
        log = _with_passive(model, log)
    if log.base is None or not log.base.link:
        return log
    pose = _root_poses(model, log.q, log.base.pose, log.base.link)
    if not log.base.has_position:
        pose[:, :3] = 0.0
    note = f"the pose of the base is computed from the pose of {log.base.link}"
    base = BaseMotion(pose, imu=log.base.imu)
    return replace(log, base=base, notes=(*log.notes, note))


def _with_passive(model: RobotModel, log: Log) -> Log:
    """Return the log with the positions of all joints, and no torque of passive ones."""
    absent = [joint for joint in model.joints if joint not in log.joints]
    missing = np.isin(model.joints, absent)
    q, tau = np.zeros((2, len(log.t), len(missing)))
    places = [log.joints.index(joint) for joint in model.joints if joint in log.joints]
    q[:, ~missing], tau[:, ~missing] = log.q[:, places], log.tau[:, places]
    tau[:, np.isin(model.joints, model.passive)] = 0.0
    if absent and not model.loops:
        raise DataError(
            f"{log.name} has no position of {listed(absent)}, and no loop determines it; log it, "
            "or add [[loop]]"
        )
    if model.loops:
        q = _closed(model, log, q, missing)
    if not absent:
        return replace(log, tau=tau)
    note = f"positions of {listed(absent)} are computed from the loops"
    optional = ((log.v, "velocities"), (log.a, "accelerations"), (log.q_ref, "commands"))
    if unused := [noun for values, noun in optional if values is not None]:
        note += f"; {listed(unused)} are not used, since these joints have none"
    return replace(
        log, joints=model.joints, q=q, tau=tau, v=None, a=None, q_ref=None, v_ref=None,
        tau_ref=None, gain_factors=np.ones((2, 1)), notes=(*log.notes, note),
    )  # fmt: skip


def _closed(model: RobotModel, log: Log, q: Array, missing: Array) -> Array:
    """Return positions at which the loops close; refuse those at which they do not."""
    chains = Chains(model)
    if missing.any():
        q = chains.closed(q, missing)
    gaps = chains.gaps(q)
    allowed = (_COMPUTED if missing.any() else _OPEN) * model.length
    is_open = ~(gaps.max(axis=1) <= allowed)
    if not is_open.any():
        return q
    k = int(np.argmax(is_open))
    loop, joints = int(gaps[k].argmax()), np.array(model.joints)[missing].tolist()
    what = f"no position of {listed(joints)} closes" if joints else "the positions do not close"
    raise DataError(
        f"{log.name}: {what} the loop {model.loops[loop].name} at t = {seconds(log.t[k])} s: "
        f"{gaps[k, loop]:.3g} m remain, expected at most {allowed:.2g} m. Correct the zero "
        "positions or signs of the logged joints, or the frames of the loop",
        code="open_loop",
    )


def _root_poses(model: RobotModel, q: Array, poses: Array, link: str) -> Array:
    """Return the poses of the root link from those of another link, x y z qx qy qz qw, (N, 7)."""
    pin_model, root = model.pin_model, np.empty_like(poses)
    data, frame = pin_model.createData(), frame_id(pin_model, link)
    still = np.hstack([np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(q), 1)), q])
    for k, q_k in enumerate(np.ascontiguousarray(model.configurations(still))):
        pin.forwardKinematics(pin_model, data, q_k)
        place = pin.updateFramePlacement(pin_model, data, frame)
        root[k] = pin.SE3ToXYZQUAT(pin.XYZQUATToSE3(poses[k]) * place.inverse())
    return root


_SURE = 0.98  # probability from which a sample is decided
_FEWEST = 0.5  # share of decided samples of a contact below which it is not found
_LOAD = 0.4  # of the mean force of all feet on the ground: initial limit of a contact
_SOME = 20  # samples without which a distribution is not estimated
_ROUNDS = 10
_WEIGHING = 3  # rounds in which the noise of each row is estimated, after that of groups of rows
_SCORINGS, _SAMPLES = 30, 500  # of the latter: rounds, samples
_WIDER = 30.0  # prior of the forces there: it must not explain residuals
_LEAST, _NEGLIGIBLE = 0.2, 1e-4  # smallest ratios of a variance to the one before, to the largest
_SLOWEST = 1e-3  # [m/s] speed below which speeds do not differ
_NARROW = (0.02, 2e-3, 0.1)  # smallest deviations: force over weight, height [m], decades of speed


def with_contacts(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log with all contacts of a robot; undecided samples of those found count as on."""
    flagged = [x.frame for x in model.contacts if not x.always]
    if all(frame in log.contacts for frame in flagged):
        return log
    t, frames, touches, _ = find_contacts(model, log, signals)
    flags, parts = dict(log.contacts), []
    for frame, p in zip(frames, touches.T, strict=True):
        on, off = (100.0 * float(np.mean(x > _SURE)) for x in (p, 1.0 - p))
        if on + off < 100.0 * _FEWEST:
            raise _unknown(log, [frame], f"{on + off:.0f} % of samples are decided")
        flags[frame] = ~(np.interp(log.t, t, p, left=1.0, right=1.0) < 1.0 - _SURE)
        undecided = 100.0 - on - off
        parts.append(f"{frame} {on:.0f} % in contact, {off:.0f} % not, {undecided:.0f} % undecided")
    note = (
        f"contacts found from torques and motion: {'; '.join(parts)}. Undecided samples count as "
        "contact"
    )
    return replace(
        log, contacts={frame: flags[frame] for frame in flagged}, notes=(*log.notes, note)
    )


def find_contacts(
    model: RobotModel, log: Log, signals: SignalSettings
) -> tuple[Array, list[str], Array, Array]:
    """Return times (N,), unstated links, their probabilities of contact and forces (N, k) [N]."""
    wanted = [x for x in model.contacts if not x.always and x.frame not in log.contacts]
    if log.base is None or not log.has_torque:
        raise _unknown(log, [x.frame for x in wanted], "it has no torque or no motion of the base")
    if forced := [x.frame for x in wanted if x.measured]:
        raise DataError(
            f"{log.name} has no column contact_{forced[0]}, but a measured force there. Name the "
            "column of the force in [columns], and set threshold in [[contact]]",
            code="missing_column",
        )
    stated = {x.frame: x for x in model.contacts if x not in wanted}
    bare = replace(log, contacts={x: log.contacts[x] for x, y in stated.items() if not y.always})
    motion = process(bare, replace(signals, trim=0.0))
    if motion.contacts is None:
        motion = replace(motion, contacts=np.empty((len(motion.t), 0), dtype=bool))
    force, velocity = _forces(model, motion, wanted)
    mass = sum(inertia.mass for inertia in model.pin_model.inertias)
    load = np.linalg.norm(model.pin_model.gravity.linear) * mass
    frames, heights = [x.frame for x in wanted], None
    if log.base.has_position:
        positions = link_positions(model.pin_model, model.configurations(motion.q), frames)
        heights = positions @ _up(model)
    touches = _probabilities(force / load, heights, velocity, len(model.contacts))
    return motion.t, frames, touches, force


def _up(model: RobotModel) -> Array:
    """Return the direction against gravity, shape (3,)."""
    gravity = model.pin_model.gravity.linear
    return np.asarray(-gravity / np.linalg.norm(gravity))


def _unknown(log: Log, frames: Sequence[str], why: str) -> DataError:
    return DataError(
        f"{log.name} has no column of the contact of {listed(frames)}, and the contact cannot be "
        f"found from torques and motion: {why}. Record contact_{frames[0]} (1 in contact, else 0), "
        "the foot's force with threshold in [[contact]], or all torques and the base's pose; or "
        "set always = true",
        code="missing_column",
    )


def _forces(
    model: RobotModel, motion: Trajectory, wanted: Sequence[Contact]
) -> tuple[Array, Array]:
    """Return forces upwards (N, k) [N] and velocities (N, k, 3) [m/s] of links, all touching."""
    names = [x.frame for x in wanted]
    turned = [
        replace(x, axes="world") if isinstance(x, Contact) and x in wanted else x
        for x in model.constraints
    ]
    model = replace(model.with_terms({}), constraints=tuple(turned))
    flags = np.ones((len(motion.t), len(model.contacts)), dtype=bool)
    flags[:, [not (x.always or x.frame in names) for x in model.contacts]] = motion.contacts
    J = constraint_jacobian(model, motion.q, flags)
    (torque,) = predict(model, [model.standard_parameters()], motion)
    b, known = torque - motion.tau, measured_rows(model)
    firsts = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)])
    pairs = zip(model.constraints, firsts, strict=False)
    starts = [first for x, first in pairs if isinstance(x, Contact) and x.frame in names]
    if motion.wrenches is not None:
        b -= np.einsum("kmj,km->kj", J[:, known], motion.wrenches)
    speeds = np.einsum("kij,kj->ki", J, motion.v)
    velocity = np.stack([speeds[:, i : i + 3] for i in starts], axis=1)
    J[:, known] = 0.0
    size = np.sqrt(np.mean(torque[:, :3] ** 2)) + 1e-9  # of any force, so that f is determined
    sigma = _noise_of_groups(J, b, size)
    for _ in range(_WEIGHING):
        A = J / sigma
        N = A @ A.swapaxes(1, 2) + np.eye(J.shape[1]) / size**2
        f = np.linalg.solve(N, A @ (b / sigma)[..., None])[..., 0]
        left = 1.0 - np.einsum("kmj,kmj->kj", A, np.linalg.solve(N, A))  # 1 - leverage
        residual = b - np.einsum("kmj,km->kj", J, f)
        sigma = np.sqrt(np.mean(residual**2, axis=0) / np.mean(left, axis=0).clip(0.01)) + 1e-6
    return np.stack([f[:, i : i + 3] @ _up(model) for i in starts], axis=1), velocity


def _noise_of_groups(J: Array, b: Array, size: float) -> Array:
    """Return the noise level of rows (n_rows,), of three groups, by restricted likelihood."""
    # Maximum by Fisher scoring: Searle, Casella, McCulloch (1992), Variance Components, 8.3.
    step, n = max(1, len(b) // _SAMPLES), b.shape[1]
    J, b, weak = J[::step], b[::step], np.eye(J.shape[1]) / (_WIDER * size) ** 2
    group = np.repeat([0, 1, 2], [3, 3, n - 6])
    member = 1.0 * (group == np.unique(group)[:, None])  # (groups, n)
    variance = np.full(len(member), np.mean(b**2) + LEAST_DIVISOR)
    largest = np.mean(b**2, axis=0).max()
    for _ in range(_SCORINGS):
        inverse = 1.0 / (variance @ member)
        A = J * inverse
        N = A @ J.swapaxes(1, 2) + weak
        P = np.diag(inverse) - A.swapaxes(1, 2) @ np.linalg.solve(N, A)  # (N, n, n)
        left = member @ np.mean(np.einsum("kij,kj->ki", P, b) ** 2, axis=0)
        curvature = member @ np.mean(P**2, axis=0) @ member.T
        scored = np.linalg.lstsq(curvature, left, rcond=None)[0]  # contacts may explain a group
        before, variance = variance, np.clip(scored, _LEAST * variance, largest + LEAST_DIVISOR)
        variance = np.maximum(variance, _NEGLIGIBLE * variance.max()) + LEAST_DIVISOR
        if np.abs(np.log(variance / before)).max() < CONVERGED:
            break
    return np.asarray(np.sqrt(variance @ member))


def _probabilities(force: Array, heights: Array | None, velocity: Array, feet: int) -> Array:
    """Return the probabilities of contact, shape (N, k), by values of this shape."""
    p = 1.0 * (force > _LOAD / feet)
    for _ in range(_ROUNDS):
        if min(p.sum(), (1.0 - p).sum()) < _SOME:  # all or none touch: the force alone decides
            return np.asarray(expit((force - 0.25 * _LOAD / feet) / _NARROW[0]))
        moving = velocity
        if heights is None:
            ground = np.einsum("ki,kij->kj", p, velocity) / (p.sum(axis=1)[:, None] + 1e-9)
            moving = velocity - ground[:, None]
        speeds = np.log10(np.linalg.norm(moving, axis=2) + _SLOWEST)
        odds = np.full_like(p, np.log(p.mean() / (1.0 - p.mean())))
        for x, narrow in zip((force, heights, speeds), _NARROW, strict=True):
            if x is not None:
                odds += _evidence(x, p, narrow, 0.0 if x is force else None)
        p = expit(odds)
    return p


def _evidence(x: Array, p: Array, narrow: float, off: float | None) -> Array:
    """Return the logarithm of the ratio of the densities of a value with and without contact."""
    on, is_fixed = float(np.average(x, weights=p)), off is not None
    off = float(np.average(x, weights=1.0 - p)) if off is None else off
    a = max(float(np.sqrt(np.average((x - on) ** 2, weights=p))), narrow)
    b = np.sqrt(np.average((x - off) ** 2, weights=1.0 - p))
    if is_fixed:  # its tails are links in contact
        b = min(b, _spread(x - off, 1.0 - p))
    b = max(float(b), narrow)
    y = np.clip(x, min(on, off), max(on, off))  # values beyond both are no further evidence
    return np.asarray((((y - off) / b) ** 2 - ((y - on) / a) ** 2) / 2 - np.log(a / b))


def _spread(x: Array, weights: Array) -> float:
    """Return the standard deviation of a normal distribution with the median of |x|."""
    order = np.argsort(np.abs(x), axis=None)
    total = np.cumsum(weights.ravel()[order])
    middle = order[np.searchsorted(total, 0.5 * total[-1])]
    return 1.4826 * float(np.abs(x.ravel()[middle]))


_MOVES = 2e-3  # [rad/s] mean speed of a segment of a slow log from which its sign is certain
_NEGLECTED = 0.02  # largest inertial torque that is neglected, over gravity's torque on a link
_ROWS = 1000  # largest number of samples of a log that are used
_PARTS = 8  # of the log, every other one fitted
_BETTER = 0.85  # ratio of the errors below which the difference is significant
_FEW = 3.0  # smallest number of rows per column for a joint
_DEPENDENT = 1e-3  # relative singular value below which columns are dependent


def row_mask(model: RobotModel, trajectory: Trajectory, min_velocity: float) -> Array:
    """Return the used rows, (N, n_rows): the sign of friction is certain, the torque not dead."""
    used, tau = sure_rows(model.layout, trajectory.v, min_velocity), trajectory.tau
    if tau.any():
        driven = np.isin(model.row_names, sorted({*model.joints} - {*model.passive}))
        is_dead = np.ptp(tau, axis=0) <= NOISE_FREE * np.abs(tau).max(axis=0)
        used[:, driven & is_dead] = False
    return used


def static_rows(model: RobotModel, log: Log, signals: SignalSettings) -> tuple[Trajectory, Array]:
    """Return the samples of a log for a static model: rest phases and slow segments, one each."""
    layout, n = model.layout, len(model.joints)
    unit, least = layout.drive_speeds[:n], min(signals.min_velocity, _MOVES)
    # inertial over gravity torque of a link of length l: a l / g and v^2 l / g
    largest = _NEGLECTED * float(np.linalg.norm(model.pin_model.gravity.linear)) / model.length
    size = np.where(np.isin(model.joints, list(layout.prismatic)), model.length, 1.0)
    motion, at_rest = standing_motion(
        log, signals.max_gap or np.inf, least * unit, np.sqrt(largest) * size, largest * size
    )
    moves = sure_rows(layout, motion.v, least)
    # at rest, friction is anywhere within its limits: it is left out, and part of the residual
    used = moves | (at_rest[:, None] & (moves.sum(axis=0) <= at_rest.sum()))
    signs, still = friction_directions(layout, motion.v, None), np.zeros_like(motion.v)
    return replace(motion, v=still, direction=signs if signs.shape[1] else None), used


def base_problem(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    weight: Array,
    *,
    compiled: bool | None = None,
) -> Problem:
    """Return the problem of a trajectory in base parameters: weight (N, n_rows)."""
    rows = weight.astype(float)
    return mapping.reduce(build_problem(model, trajectory, rows, compiled=compiled))


def independent_share(signals: SignalSettings) -> float:
    """The share of independent rows after the filter: its band over the Nyquist frequency."""
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)


def prefers_measured(model: RobotModel, logs: Sequence[Log], settings: SignalSettings) -> bool:
    """Return whether velocity = "auto" uses the measured velocities of a log."""
    if any(coarse_velocities(log) or unlike_velocities(log) for log in logs):
        return False
    errors = np.concatenate([_errors(model, log, settings) for log in logs])
    is_known = np.isfinite(errors).all(axis=1)
    if not is_known.any():  # too little motion to compare
        return all(is_timely(log, settings.velocity_delay) for log in logs)
    ratio = float(np.median(errors[is_known, 1] / errors[is_known, 0]))
    is_better = ratio > _BETTER
    _log.info(
        "%s: velocity = 'auto' uses %s velocities: the torque prediction error on held-out "
        "segments with differentiated velocities is %.2f times that with measured velocities",
        logs[0].name, "measured" if is_better else "differentiated", ratio,
    )  # fmt: skip
    return is_better


def _errors(model: RobotModel, log: Log, settings: SignalSettings) -> Array:
    """Return torque prediction errors by both velocities, (n, 2); NaN with too little motion."""
    unknown = np.full((len(model.joints), 2), np.nan)
    if not log.has_torque or model.free_flyer or model.constraints:
        return unknown
    sources = [replace(settings, velocity=x) for x in ("measured", "differentiated")]
    try:
        motions = [process(log, chosen, friction_speeds(model.layout)) for chosen in sources]
    except DataError:  # too short: the error is raised again when the log is read
        return unknown
    mask = np.all([row_mask(model, x, settings.min_velocity) for x in motions], axis=0)
    every = -(-len(mask) // _ROWS)
    return np.stack([_held_out_error(model, x, mask, every) for x in motions], axis=1)


def _held_out_error(model: RobotModel, motion: Trajectory, mask: Array, every: int) -> Array:
    """Return the norm of each torque's prediction error in the parts not fitted, shape (n,)."""
    rows = slice(None, None, every)
    state = motion.q[rows], motion.v[rows], motion.a[rows]
    direction = None if motion.direction is None else motion.direction[rows]
    Y = joint_torque_regressor(model, *state, direction)
    Y = Y.reshape(len(state[0]), len(model.joints), -1)
    part = np.arange(len(Y)) * _PARTS // len(Y) % 2
    error = np.full(len(model.joints), np.nan)
    for j, support in enumerate(model.support):
        W, tau, used = Y[:, j, support], motion.tau[rows, j], mask[rows, j]
        even, odd = used & (part == 0), used & (part == 1)
        if min(even.sum(), odd.sum()) < _FEW * W.shape[1] or not tau.any():
            continue  # too few rows, or no torques
        squares, parts = 0.0, [(W[rows_of], tau[rows_of]) for rows_of in (even, odd)]
        for (A, known), (B, unknown) in (parts, parts[::-1]):
            size = np.linalg.norm(A, axis=0)
            size[size == 0] = 1.0
            theta = np.linalg.lstsq(A / size, known, rcond=_DEPENDENT)[0]
            squares += float(np.sum((unknown - B @ (theta / size)) ** 2))
        error[j] = np.sqrt(squares) + NOISE_FREE * np.linalg.norm(tau)
    return error
