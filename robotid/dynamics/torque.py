"""Torques: their regressor, predictions from parameter vectors, and derivatives.

Inertial columns are Pinocchio's; those of the drives follow them. Derivatives are Pinocchio's of
inverse dynamics: a joint of six axes at position 0 before each joint moves its origin and axis.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array, real_numbers
from robotid.data.log import Trajectory
from robotid.dynamics.constraint_rows import ProjectedRows, loop_basis, mixed_rows, without_forces
from robotid.dynamics.factors import Block, Problem, RowSource
from robotid.dynamics.rows import (
    BLOCK,
    BLOCK_SIZE,
    COMPILED,
    InertialRows,
    TrajectoryRows,
    drive_motion,
    drive_values,
    friction_directions,
    kept_rows,
    remembered,
    trajectory_rows,
    trajectory_values,
    work_per_sample,
    write_inertial,
)
from robotid.robot.closure import Chains
from robotid.robot.drive_term import DriveMotion
from robotid.robot.drives import TERMS, Lag
from robotid.robot.model import RobotModel

State: TypeAlias = tuple[Array, Array, Array]  # q, v, a

_DECADES = 3.0  # of speeds, at random states of a robot with nonlinear friction
_START = 5  # constant work of one call of inverse dynamics, as of work_per_sample


def joint_torque_regressor(
    model: RobotModel,
    q: Array,
    v: Array,
    a: Array,
    direction: Array | None = None,
    memory: Array | None = None,
) -> Array:
    """Return the regressor Y with tau = Y pi at each of N samples, shape (N n_rows, p).

    Ten columns of each body (Atkeson, An, Hollerbach 1986), then those of the drives. None:
    directions (N, c) are the signs of the speeds, internal states (N, m) steady ones.
    """
    wanted = (len(q), model.n_rows)
    if v.shape != wanted or a.shape != wanted:
        raise DataError(f"v and a have shapes {v.shape} and {a.shape}, expected {wanted}")
    for name, values in (("v", v), ("a", a)):
        if not np.isfinite(values).all():
            k, j = np.argwhere(~np.isfinite(values))[0]
            row = model.row_names[j]
            raise DataError(f"{name}[{k}] of {row} is {values[k, j]}, expected a finite number")
    Y = np.zeros((len(q), model.n_rows, len(model.layout.names)))
    write_inertial(model, q, v, a, Y)
    _write_drives(model, (q, v, a), direction, memory, Y)
    return Y.reshape(len(q) * model.n_rows, -1)


def trajectory_regressor(
    model: RobotModel,
    trajectory: Trajectory,
    samples: Array | slice = slice(None),
    data: pin.Data | None = None,
) -> Array:
    """Return the regressor of N samples of a trajectory, (N n_rows, p); constrained: P W."""
    m = trajectory.at(samples)
    Y = np.zeros((len(m.t), model.n_rows, len(model.layout.names)))
    if (stored := kept_rows(model, trajectory)) is None:
        write_inertial(model, m.q, m.v, m.a, Y, data)
    else:
        stored.write(samples, Y)
    _write_drives(model, (m.q, m.v, m.a), m.direction, m.memory, Y)
    Y = Y if m.basis is None else without_forces(m.basis, Y)
    return Y.reshape(len(m.t) * model.n_rows, -1)


class InstantRegressor:
    """Some columns (c,) of the regressor, one sample at a time, without repeated initialisation."""

    def __init__(self, model: RobotModel, columns: Array) -> None:
        if model.free_flyer:
            raise DataError("the base floats, expected a robot with a fixed base")
        model.require_fixed("recursive identification")
        self._model, self._data = model, model.pin_model.createData()
        self._columns = np.asarray(columns)
        G = model.velocity_map
        self._map = None if np.array_equal(G, np.eye(len(G))) else G
        self._is_plain = self._map is None and not model.position_offset.any()
        self._is_plain &= model.pin_model.nq == model.pin_model.nv
        layout = model.layout
        self._Y = np.zeros((model.n_rows, len(layout.names)))
        # place of each term that all joints have; other drives are written as for a trajectory
        count, joints = len(layout.terms), np.arange(len(layout.joints))
        self._terms = [
            (TERMS[name], layout.n_inertial + joints * count + k)
            for k, name in enumerate(layout.terms)
        ]
        self._is_uniform = not (layout.couplings or layout.own or layout.passive)

    def __call__(self, q: Array, v: Array, a: Array) -> Array:
        """Return the regressor of one sample, shape (n, c), as of ``joint_torque_regressor``."""
        model, layout, Y = self._model, self._model.layout, self._Y
        x = q if self._is_plain else model.configurations(q[None])[0]
        regressor, G = pin.computeJointTorqueRegressor, self._map
        w, dw = (v, a) if G is None else (G @ v, G @ a)
        inertial = regressor(model.pin_model, self._data, x, w, dw)
        Y[:, : layout.n_inertial] = inertial if G is None else G.T @ inertial
        if self._is_uniform:
            rows, still = np.arange(len(v)), np.zeros_like(v)
            motion = DriveMotion(q, v, a, np.sign(v), still, still)
            for term, place in self._terms:
                Y[rows, place] = term.column(motion)
            return Y[:, self._columns]
        _write_drives(model, (q[None], v[None], a[None]), None, None, Y[None])
        return Y[:, self._columns]


def build_problem(
    model: RobotModel,
    trajectory: Trajectory,
    weight: Array | None = None,
    *,
    compiled: bool | None = None,
) -> Problem:
    """Return the problem W pi = tau of a trajectory: blocks by Pinocchio, rows by either engine."""
    rows = trajectory_rows(model, trajectory, weight, compiled)
    weights, used = rows.weights, np.any(rows.weights, axis=0, keepdims=True).T
    rows = replace(rows, support=rows.support & used)
    source: RowSource = rows
    support = rows.support
    if trajectory.basis is not None:
        rows = trajectory_rows(model, trajectory, None, compiled)
        mixed = mixed_rows(trajectory.basis, weights)[:, None]
        rows = replace(rows, support=rows.support & mixed)
        source = ProjectedRows(rows, trajectory.basis, weights)
        support = rows.support.any(axis=0) & used
    samples = len(weights)
    length = max(1, min(BLOCK, BLOCK_SIZE // (model.n_rows * len(model.layout.names))))

    def stream() -> Iterator[Block]:
        data = model.pin_model.createData()
        for start in range(0, samples, length):
            part = slice(start, start + length)
            W = trajectory_regressor(model, trajectory, part, data)
            yield W, trajectory.tau[part].reshape(-1), weights[part].reshape(-1)

    is_projected = trajectory.basis is not None
    return Problem(stream, model.layout.names, model.n_rows, support, (source,), is_projected)


def random_regressor(model: RobotModel, samples: int, rng: np.random.Generator) -> Array:
    """Return the regressor at random states, (N n_rows, p); loops closed, without their forces."""
    n = len(model.joints)
    rate = np.sqrt(9.81 / model.length)  # [1/s]: gravity counts the same for finger and crane
    size = np.array([model.length if j.type == "prismatic" else np.pi for j in model.limits])
    q = rng.uniform(-1, 1, (samples, n)) * size
    unit = np.minimum(size, 1.0)  # [rad or m]
    v = rng.uniform(-1, 1, (samples, n)) * unit * rate
    if model.layout.own:  # terms that only slow motion excites
        v *= 10.0 ** rng.uniform(-_DECADES, 0.0, v.shape)
    a = rng.uniform(-1, 1, (samples, n)) * unit * rate**2
    if model.loops:
        chains = Chains(model)
        q, Z = chains.random_states(samples, rng)
        v, a = (np.einsum("kij,kj->ki", Z, x) for x in (v, a))
        a += chains.accelerations(q, v)
    if model.free_flyer:
        linear = np.repeat([model.length, 1.0], 3)
        quaternions = rng.standard_normal((samples, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        pose = np.column_stack([np.zeros((samples, 3)), quaternions])
        q = np.hstack([pose, q])
        v = np.hstack([rng.uniform(-1, 1, (samples, 6)) * linear * rate, v])
        a = np.hstack([rng.uniform(-1, 1, (samples, 6)) * linear * rate**2, a])
    count = len(model.layout.remembering)  # internal states and loads are random, too
    memory = rng.uniform(-1, 1, (samples, count)) if count else None
    signs = friction_directions(model.layout, v, None)
    if model.is_static:
        v, a = 0.0 * v, 0.0 * a
    W = joint_torque_regressor(model, q, v, a, signs, memory)
    if not model.loops:
        return W
    Y = W.reshape(samples, model.n_rows, -1)
    return without_forces(loop_basis(model, q), Y).reshape(W.shape)


def _write_drives(
    model: RobotModel, state: State, direction: Array | None, memory: Array | None, Y: Array
) -> None:
    """Write the drives' columns beside those of the bodies, (N, n_rows, p); no memory: steady."""
    layout, size, first = model.layout, model.layout.n_inertial, model.n_rows - len(model.joints)
    signs = friction_directions(layout, state[1], direction)
    if memory is None and layout.remembering:
        load = Y[:, first:, :size] @ model.carried_by[:size]
        memory = remembered(layout, drive_motion(layout, *state, signs, load))
    values = drive_values(layout, *state, signs, memory)
    np.multiply(layout.drive_loads, values.T[:, None], out=Y[:, first:, size:])


class TorqueSlopes(NamedTuple):
    """Derivatives of the torque of the bodies at N samples, of a robot with n joints."""

    by_q: Array  # by the positions, shape (N, n, n)
    by_v: Array  # by the velocities, likewise
    by_a: Array  # by the accelerations, likewise: the mass matrix of the bodies
    by_gravity: Array  # by gravity, along the axes of the world, shape (N, n, 3)
    by_origin: Array  # by each joint's origin in the body before, (N, n, n, 3): torque, joint, axis
    by_axis: Array  # by turning each joint about the two directions across its axis, (N, n, n, 2)


def predict(
    model: RobotModel,
    parameters: Sequence[Array],
    trajectory: Trajectory,
    *,
    compiled: bool | None = None,
) -> list[Array]:
    """Return the torque W theta, (N, n_rows) [N m, N], of each vector; constrained: P W theta."""
    source = trajectory_rows(model, trajectory, None, compiled)
    stacked = np.column_stack(list(parameters))
    few = len(parameters) * (_START + model.pin_model.nv) <= work_per_sample(model)
    if source.inertial is not None:
        torques = _from_kept(source, source.inertial, stacked)
    elif source.engine != COMPILED and few and all(_has_centres(model, pi) for pi in parameters):
        # Luh, Walker, Paul (1980)
        torques = [inverse_dynamics(model, pi, trajectory) for pi in parameters]
    else:
        torques = _from_rows(source, stacked)
    if trajectory.basis is None:
        return torques
    return [without_forces(trajectory.basis, torque) for torque in torques]


def predict_instants(
    model: RobotModel,
    pi: Array,
    q: ArrayLike,
    v: ArrayLike | None = None,
    a: ArrayLike | None = None,
) -> Array:
    """Return the torques at independent samples, (n_rows,) or (N, n_rows) [N m, N].

    Friction is 0 at rest. Internal states have their steady value under the torque of the bodies,
    and there is no delay. Of a static robot, v affects only the sign of friction.
    """
    q = real_numbers(q, "q")
    wanted = (*q.shape[:-1], model.n_rows)
    width = len(model.joints) + 7 * model.free_flyer
    if q.ndim not in (1, 2) or q.shape[-1] != width:
        raise DataError(
            f"q has shape {q.shape}, expected ({width},) or (N, {width}): "
            f"{'the pose of the base, then ' if model.free_flyer else ''}a column for each of "
            f"{listed(model.joints)}"
        )
    given = {"q": q}
    for name, x in (("v", v), ("a", a)):
        given[name] = np.zeros(wanted) if x is None else real_numbers(x, name)
        if given[name].shape != wanted:
            raise DataError(
                f"{name} has shape {given[name].shape}, expected {wanted}, as q is {q.shape}: a "
                f"column for each of {listed(model.row_names)}"
            )
    q, v, a = map(np.atleast_2d, given.values())
    for name, x in zip("qva", (q, v, a), strict=True):
        if not np.isfinite(x).all():
            row = int(np.argmin(np.isfinite(x).all(axis=1)))
            raise DataError(f"{name} is not finite in row {row}: {x[row].tolist()}")
    direction = friction_directions(model.layout, v, None)
    if model.is_static:
        v, a = np.zeros_like(v), np.zeros_like(a)
    torque = np.empty_like(v)
    for start in range(0, len(v), BLOCK):
        k = slice(start, start + BLOCK)
        Y = joint_torque_regressor(model, q[k], v[k], a[k], direction[k])
        torque[k] = (Y @ pi).reshape(-1, model.n_rows)
    return torque.reshape(wanted)


def rigid_parts(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> list[Array]:
    """Return gravity, inertia and velocity torques g, M a, C v of the bodies, (N, n_rows) each."""
    still = np.zeros_like(v)
    states = ((still, still), (still, a), (v, a))
    g, g_and_Ma, total = (bodies_torque(model, pi, q, *x) for x in states)
    return [g, g_and_Ma - g, total - g_and_Ma]


def _from_rows(source: TrajectoryRows, stacked: Array) -> list[Array]:
    """Return the rows times the columns of (p, k), k arrays of shape (N, n_rows)."""
    torques = np.empty((stacked.shape[1], source.samples, len(source.columns)))
    factors = [stacked[columns] for columns in source.columns]
    start = 0
    for block in source.blocks(0, source.samples):
        part = slice(start, start + len(block[0]))
        for j, rows in enumerate(block):
            torques[:, part, j] = (rows[:, :-1] @ factors[j]).T
        start = part.stop
    return list(torques)


def _from_kept(source: TrajectoryRows, inertial: InertialRows, stacked: Array) -> list[Array]:
    """Return the rows times the columns of (p, k), with the inertial columns in memory."""
    layout, n = source.model.layout, len(source.model.joints)
    torques, theta = inertial.torque(stacked), stacked[layout.n_inertial :]
    if theta.any():
        values = trajectory_values(layout, source.trajectory)  # (drive parameters, N)
        for torque, theta_k in zip(torques, theta.T, strict=True):
            torque[:, source.model.n_rows - n :] += values.T @ (layout.drive_loads * theta_k).T
    return list(torques)


def _has_centres(model: RobotModel, pi: Array) -> bool:
    """Return whether Pinocchio's (m, c, I) keeps the digits; consistent: |m c|^2 <= m tr I / 2."""
    bodies = pi[: model.layout.n_inertial].reshape(-1, 10)
    moments = np.sum(bodies[:, 1:4] ** 2, axis=1)
    return bool((moments <= bodies[:, 0] * bodies[:, [4, 6, 9]].sum(axis=1)).all())


def inverse_dynamics(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return the torque W pi by the recursive Newton-Euler algorithm and the drives' terms."""
    torque = bodies_torque(model, pi, trajectory.q, trajectory.v, trajectory.a)
    if pi[model.layout.n_inertial :].any():
        torque[:, model.n_rows - len(model.joints) :] += drive_torque(model, pi, trajectory)
    return torque


def bodies_torque(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> Array:
    """Return the torque of bodies, of inconsistent ones as a difference, shape (N, n_rows)."""
    return _of_consistent(_newton_euler, model, pi, q, v, a)[0]


def drive_torque(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return the torque of the drives' terms, shape (N, n) [N m, N]: pi (p,)."""
    layout, theta = model.layout, pi[model.layout.n_inertial :]
    return np.asarray(trajectory_values(layout, trajectory).T @ (layout.drive_loads * theta).T)


def body_slopes(model: RobotModel, pi: Array, trajectory: Trajectory) -> TorqueSlopes:
    """Return the derivatives of the bodies' torque by motion, gravity and origins of joints."""
    state = trajectory.q, trajectory.v, trajectory.a
    return TorqueSlopes(*_of_consistent(_torque_slopes, model, pi, *state))


def force_slopes(model: RobotModel, trajectory: Trajectory) -> Array:
    """Return the derivatives of the torques by forces (3,) on the last joint and tip, (N, n, 6)."""
    engine, G = model.pin_model, model.velocity_map
    frames = [k for k, frame in enumerate(engine.frames) if frame.parentJoint == engine.njoints - 1]
    tip = max(frames, key=lambda k: np.linalg.norm(engine.frames[k].placement.translation))
    slopes, data = np.empty((len(trajectory.q), len(G), 6)), engine.createData()
    for D, q in zip(slopes, model.configurations(trajectory.q), strict=True):
        for k, frame in enumerate((frames[0], tip)):
            J = pin.computeFrameJacobian(engine, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
            D[:, 3 * k : 3 * k + 3] = -J[:3].T
    return np.asarray(G.T @ slopes)


def body_slopes_by_position(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return ``body_slopes`` by the positions alone, (N, n, n), several times as fast."""
    return _of_consistent(_position_slopes, model, pi, trajectory.q, trajectory.v, trajectory.a)[0]


def _of_consistent(
    linear: Callable[..., Sequence[Array]], model: RobotModel, pi: Array, *state: Array
) -> Sequence[Array]:
    """Return values that are linear in the bodies, or their difference for two consistent sets."""
    added = _consistent_addition(model, pi)
    total = linear(model, pi + added, *state)
    if not added.any():
        return total
    return [x - y for x, y in zip(total, linear(model, added, *state), strict=True)]


def _consistent_addition(model: RobotModel, pi: Array) -> Array:
    """Return bodies whose sum with those of pi is physically consistent, shape (p,)."""
    added = np.zeros_like(pi)
    if _has_centres(model, pi):
        return added
    bodies, more = (x[: model.layout.n_inertial].reshape(-1, 10) for x in (pi, added))
    moment = np.linalg.norm(bodies[:, 1:4], axis=1)
    more[:, 0] = np.abs(bodies[:, 0]) + moment / model.length
    size = np.abs(bodies[:, 4:]).max(axis=1) + moment * model.length
    more[:, [4, 6, 9]] = size[:, None]
    return added


def _newton_euler(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> tuple[Array]:
    """Return the torque of consistent bodies, shape (N, n_rows)."""
    G, pin_model = model.velocity_map, model.with_parameters(pi).pin_model
    data, torque = pin_model.createData(), np.empty((len(v), pin_model.nv))
    is_plain = np.array_equal(G, np.eye(len(G)))
    configurations = np.ascontiguousarray(model.configurations(q))
    if v.any() or a.any():
        rates, changes = (v, a) if is_plain else (v @ G.T, a @ G.T)
        instants = zip(torque, configurations, rates, changes, strict=True)
        for torque_k, q_k, v_k, a_k in instants:
            torque_k[:] = pin.rnea(pin_model, data, q_k, v_k, a_k)
    else:
        for torque_k, q_k in zip(torque, configurations, strict=True):
            torque_k[:] = pin.computeGeneralizedGravity(pin_model, data, q_k)
    return (torque if is_plain else torque @ G,)  # tau = G^T tau_pinocchio


def _position_slopes(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> tuple[Array]:
    """Return the derivatives of the bodies' torque by the positions, shape (N, n, n)."""
    pin_model, G = model.with_parameters(pi).pin_model, model.velocity_map
    slopes, data = np.empty((len(q), pin_model.nv, pin_model.nv)), pin_model.createData()
    states = zip(model.configurations(q), v @ G.T, a @ G.T, strict=True)
    for D, state in zip(slopes, states, strict=True):
        D[:] = pin.computeRNEADerivatives(pin_model, data, *state)[0]
    return (G.T @ slopes @ G,)


def _torque_slopes(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> tuple[Array, ...]:
    """Return the arrays of ``TorqueSlopes`` (Carpentier, Mansard 2018, Analytical Derivatives)."""
    plain, G = model.with_parameters(pi).pin_model, model.velocity_map
    extended, joints = _with_movable_origins(plain)
    rows = np.array([extended.joints[k].idx_v for k in joints])  # rows of the robot's own joints
    before = np.array([extended.joints[k - 1].idx_v for k in joints])  # and of their places
    first_q = [(extended.joints[k].idx_q, plain.joints[i].idx_q, plain.joints[i].nq)
               for i, k in enumerate(joints, start=1)]  # fmt: skip
    configurations = np.tile(pin.neutral(extended), (len(q), 1))
    known = model.configurations(q)
    for to, here, size in first_q:
        configurations[:, to : to + size] = known[:, here : here + size]
    velocities, accelerations = np.zeros((2, len(v), extended.nv))
    velocities[:, rows], accelerations[:, rows] = v @ G.T, a @ G.T
    slopes = np.empty((3, len(q), len(rows), extended.nv))
    derive, data = pin.computeRNEADerivatives, extended.createData()
    states = zip(configurations, velocities, accelerations, strict=True)
    for D_q, D_v, D_a, state in zip(*slopes, states, strict=True):
        by_q, by_v, by_a = derive(extended, data, *state)
        by_q.take(rows, 0, D_q, "clip")  # without bound checks
        by_v.take(rows, 0, D_v, "clip")
        by_a.take(rows, 0, D_a, "clip")
    D: Array = G.T @ slopes  # tau = G^T tau_pinocchio
    by_q, by_v, by_a = D[..., rows] @ G
    leaders = np.array([plain.getJointId(name) - 1 for name in model.joints])
    first = before[leaders][:, None]
    rotations = np.array([plain.jointPlacements[i + 1].rotation for i in range(len(before))])
    by_origin = np.einsum("Nnjk,jik->Nnji", D[0][..., first + range(3)], rotations[leaders])
    roots = [i for i in range(len(before)) if plain.parents[i + 1] == 0]
    falling = [D[2][..., before[i] + np.arange(3)] @ rotations[i].T for i in roots]
    axes = {joint.name: joint.axis for joint in model.tree.joints}
    across = np.stack([np.linalg.svd([axes[x]])[2][1:] for x in model.joints])  # (n, 2, 3)
    by_axis = np.einsum("Nnjk,jik->Nnji", D[0][..., first + range(3, 6)], across)
    # gravity acts as an acceleration of the base in the opposite direction
    return by_q, by_v, by_a, -sum(falling), by_origin, by_axis


def _with_movable_origins(model: pin.Model) -> tuple[pin.Model, list[int]]:
    """Return a robot with a 6-axis joint before each joint, and its own joints in it."""
    extended, joints = pin.Model(), [0]
    extended.gravity = model.gravity
    for i in range(1, model.njoints):
        place, name = model.jointPlacements[i], model.names[i]
        parent = joints[model.parents[i]]
        free = extended.addJoint(parent, pin.JointModelFreeFlyer(), place, f"{name} place")
        joints.append(extended.addJoint(free, model.joints[i], pin.SE3.Identity(), name))
        extended.appendBodyToJoint(joints[-1], model.inertias[i], pin.SE3.Identity())
    return extended, joints[1:]


def is_loaded(model: RobotModel) -> bool:
    """Return whether columns depend on the torque of a robot's reference; bristles' do not."""
    return any(term.needs_load for _, term in model.layout.drive_parameters)


def remember(model: RobotModel, trajectory: Trajectory) -> Trajectory:
    """Return a trajectory with the columns of drive terms with internal state or load."""
    if not model.layout.remembering:
        return trajectory
    is_lagging = any(isinstance(term, Lag) for _, term in model.layout.drive_parameters)
    motion = drive_motion_along(model, trajectory, has_rate=is_lagging)
    return trajectory.with_states(remembered(model.layout, motion))


def drive_motion_along(
    model: RobotModel, trajectory: Trajectory, *, has_rate: bool = True
) -> DriveMotion:
    """Return motion, load (of bodies) and rate (of all torques) of the drives, (d, N), cached."""
    key, known = (model.pin_model, model.layout, has_rate), trajectory.derived.get("drive motion")
    if known is None or known[0] != key or not np.array_equal(known[1], model.carried_by):
        moved = _drive_motion(model, trajectory, has_rate)
        trajectory.derived["drive motion"] = known = key, model.carried_by, moved
    motion: DriveMotion = known[2]
    return motion


def _load_torque(model: RobotModel, trajectory: Trajectory) -> Array:
    """Return the bodies' torque by the model's reference, once, (N, n_rows) [N m, N]."""
    pi = model.carried_by[: model.layout.n_inertial]
    known = trajectory.derived.get("load torque")
    if known is None or known[0] is not model.pin_model or not np.array_equal(known[1], pi):
        plain = model.with_terms({})
        bodies = np.zeros(len(plain.layout.names))
        bodies[: len(pi)] = pi
        (load,) = predict(plain, [bodies], trajectory)
        trajectory.derived["load torque"] = known = model.pin_model, pi, load
    return known[2]


def _drive_motion(model: RobotModel, trajectory: Trajectory, has_rate: bool) -> DriveMotion:
    """Return the motion and load of drives as of ``drive_motion_along``."""
    layout, m = model.layout, trajectory.with_states(None)  # that of another reference, if any
    first = model.n_rows - len(model.joints)
    signs = friction_directions(layout, m.v, m.direction)
    begins = np.diff(m.segment, prepend=m.segment[:1] - 1) != 0
    load = _load_torque(model, m)[:, first:]
    motion = drive_motion(layout, m.q, m.v, m.a, signs, load, None, begins)
    if not has_rate:
        return motion
    if layout.remembering:
        m = m.with_states(remembered(layout, motion))
    rate = torque_rate(load + drive_torque(model, model.carried_by, m), m)
    return drive_motion(layout, m.q, m.v, m.a, signs, load, rate, begins)


def torque_rate(torque: Array, motion: Trajectory) -> Array:
    """Return the change of torques within each segment, shape (N, n) [N m/s, N/s]."""
    rate = np.zeros_like(torque)
    edges = np.flatnonzero(np.diff(motion.segment)) + 1
    for part in np.split(np.arange(len(motion.t)), edges):
        if len(part) > 1:
            rate[part] = np.gradient(torque[part], motion.t[part], axis=0)
    return rate
