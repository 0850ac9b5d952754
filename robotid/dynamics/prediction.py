"""Torques predicted from parameter vectors, without the whole regressor in memory."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from robotid.base.arguments import real_numbers
from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.compiled import work_per_sample
from robotid.dynamics.constraint_rows import without_forces
from robotid.dynamics.drive_columns import friction_directions, trajectory_values
from robotid.dynamics.rows import BLOCK, COMPILED, InertialRows, TrajectoryRows, trajectory_rows
from robotid.dynamics.torque import joint_torque_regressor
from robotid.dynamics.torque_slopes import TorqueSlopes, position_slopes, torque_slopes
from robotid.robot.model import RobotModel

SlopesT = TypeVar("SlopesT", Array, TorqueSlopes)

_START = 5  # constant work of one call of inverse dynamics, as of work_per_sample


def predict(
    model: RobotModel,
    parameters: Sequence[Array],
    trajectory: Trajectory,
    *,
    compiled: bool | None = None,
) -> list[Array]:
    """Return the torque W theta, shape (N, n_rows) [N m, N], of each of several vectors.

    Along a motion with constraints it is the torque that constraint forces cannot cause, P W theta.

    It is computed by the rows of the regressor for all vectors together, or, if the rows are not
    compiled and the vectors are few, by inverse dynamics, once per vector.

    References:
        Luh, Walker, Paul (1980), On-Line Computational Scheme for Mechanical Manipulators.

    parameters (p,).
    """
    if trajectory.basis is None:
        return _unconstrained(model, parameters, trajectory, compiled)
    torques = _unconstrained(model, parameters, trajectory, compiled)
    return [without_forces(trajectory.basis, torque) for torque in torques]


def _unconstrained(
    model: RobotModel, parameters: Sequence[Array], trajectory: Trajectory, compiled: bool | None
) -> list[Array]:
    """Return the torques with those that constraint forces cause; see ``predict``."""
    source = trajectory_rows(model, trajectory, None, compiled)
    if source.inertial is not None:
        return _from_kept(source, source.inertial, np.column_stack(list(parameters)))
    few = len(parameters) * (_START + model.pin_model.nv) <= work_per_sample(model)
    if source.engine != COMPILED and few and all(_has_centres(model, pi) for pi in parameters):
        return [inverse_dynamics(model, pi, trajectory) for pi in parameters]
    return _from_rows(source, np.column_stack(list(parameters)))


def predict_instants(
    model: RobotModel,
    pi: Array,
    q: ArrayLike,
    v: ArrayLike | None = None,
    a: ArrayLike | None = None,
) -> Array:
    """Return the torques predicted from parameters at independent samples.

    Friction has the sign of the speed: at rest, where it can have any value within its limits, it
    counts as 0. Internal states of friction are at their steady value, under the torque of the
    bodies, and there is no delay. Velocities and accelerations of a robot whose ``dynamics`` is
    "static" affect only the sign of friction.

    pi (p,), q (n,) [rad, m], v (n_rows,) [rad/s, m/s] -> (n_rows,) [N m, N].
    """
    q = real_numbers(q, "q")
    wanted = (*q.shape[:-1], model.n_rows)
    width = len(model.joints) + 7 * model.free_flyer
    if q.ndim not in (1, 2) or q.shape[-1] != width:
        raise DataError(
            f"q has shape {q.shape}, wanted ({width},) or (N, {width}): "
            f"{'the pose of the base, then ' if model.free_flyer else ''}a column for each of "
            f"{listed(model.joints)}"
        )
    given = [
        np.zeros(wanted) if x is None else real_numbers(x, name) for name, x in (("v", v), ("a", a))
    ]
    for name, x in zip("va", given, strict=True):
        if x.shape != wanted:
            raise DataError(
                f"{name} has shape {x.shape}, wanted {wanted}, as q is {q.shape}: a column for "
                f"each of {listed(model.row_names)}"
            )
    q, v, a = (np.atleast_2d(x) for x in (q, *given))
    for name, x in (("q", q), ("v", v), ("a", a)):
        if not np.isfinite(x).all():
            row = int(np.argmin(np.isfinite(x).all(axis=1)))
            raise DataError(f"{name} is not finite in row {row}: {x[row].tolist()}")
    direction = friction_directions(model.layout, v, None)
    if model.is_static:
        v, a = np.zeros_like(v), np.zeros_like(a)
    return _rows_by_pi(model, pi, q, v, a, direction).reshape(wanted)


def rigid_parts(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> list[Array]:
    """Return gravity, inertia and velocity torques of the bodies, each (N, n_rows) [N m, N].

    They are g(q) = tau(q, 0, 0), M(q) a = tau(q, 0, a) - g(q) and C(q, v) v = tau(q, v, a) -
    tau(q, 0, a). Their sum is the torque of the bodies.

    pi (p,), q (N, n) [rad, m], v (N, n_rows) [rad/s, m/s], a (N, n_rows) [rad/s^2, m/s^2].
    """
    bodies = np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)
    rigid = _newton_euler if _has_centres(model, pi) else _rows_by_pi
    still = np.zeros_like(v)
    g, g_and_Ma, whole = (rigid(model, bodies, q, *x) for x in ((still, still), (still, a), (v, a)))
    return [g, g_and_Ma - g, whole - g_and_Ma]


def _rows_by_pi(
    model: RobotModel, pi: Array, q: Array, v: Array, a: Array, direction: Array | None = None
) -> Array:
    """Return Y pi at independent samples, shape (N, n_rows), by blocks."""
    torque = np.empty_like(v)
    for start in range(0, len(v), BLOCK):
        k = slice(start, start + BLOCK)
        signs = None if direction is None else direction[k]
        Y = joint_torque_regressor(model, q[k], v[k], a[k], signs)
        torque[k] = (Y @ pi).reshape(-1, model.n_rows)
    return torque


def _from_rows(source: TrajectoryRows, stacked: Array) -> list[Array]:
    """Return the rows times the columns of (p, k), k arrays of shape (N, n_rows)."""
    torques = np.empty((stacked.shape[1], source.samples, len(source.columns)))
    own = [stacked[columns] for columns in source.columns]
    start = 0
    for block in source.blocks(0, source.samples):
        part = slice(start, start + len(block[0]))
        for j, rows in enumerate(block):
            torques[:, part, j] = (rows[:, :-1] @ own[j]).T
        start = part.stop
    return list(torques)


def _from_kept(source: TrajectoryRows, inertial: InertialRows, stacked: Array) -> list[Array]:
    """Return the rows times the columns of (p, k), with the inertial columns in memory."""
    layout, n = source.model.layout, len(source.model.joints)
    torques, theta = inertial.torque(stacked), stacked[layout.n_inertial :]
    if theta.any():
        values = trajectory_values(layout, source.trajectory)  # (drive parameters, N)
        for torque, own in zip(torques, theta.T, strict=True):
            torque[:, source.model.n_rows - n :] += values.T @ (layout.drive_loads * own).T
    return list(torques)


def _has_centres(model: RobotModel, pi: Array) -> bool:
    """Return whether Pinocchio's (m, c, I about c) represents every body without loss of digits.

    Base parameters have first moments without a mass; a consistent body has |m c|^2 <= m tr I / 2.
    """
    bodies = pi[: model.layout.n_inertial].reshape(-1, 10)
    moments = np.sum(bodies[:, 1:4] ** 2, axis=1)
    return bool((moments <= bodies[:, 0] * bodies[:, [4, 6, 9]].sum(axis=1)).all())


def inverse_dynamics(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return the torque W pi by the recursive Newton-Euler algorithm and the drives' terms.

    For inconsistent bodies, as of ordinary least squares, it is the difference of the torques of
    two sets of consistent bodies.

    pi (p,) -> (N, n_rows) [N m, N].
    """
    m, added = trajectory, _consistent_addition(model, pi)
    torque = _newton_euler(model, pi + added, m.q, m.v, m.a)
    if added.any():
        torque -= _newton_euler(model, added, m.q, m.v, m.a)
    if pi[model.layout.n_inertial :].any():
        torque[:, model.n_rows - len(model.joints) :] += drive_torque(model, pi, m)
    return torque


def drive_torque(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return the torque of the drives' terms, shape (N, n) [N m, N]: pi (p,)."""
    layout, theta = model.layout, pi[model.layout.n_inertial :]
    torque: Array = trajectory_values(layout, trajectory).T @ (layout.drive_loads * theta).T
    return torque


def body_slopes(model: RobotModel, pi: Array, trajectory: Trajectory) -> TorqueSlopes:
    """Return the derivatives of the bodies' torque by motion, gravity and origins of joints.

    pi (p,).
    """
    return _of_consistent(torque_slopes, model, pi, trajectory)


def body_slopes_by_position(model: RobotModel, pi: Array, trajectory: Trajectory) -> Array:
    """Return the derivatives of the bodies' torque by the positions, shape (N, n, n)."""
    return _of_consistent(position_slopes, model, pi, trajectory)


def _of_consistent(
    slopes: Callable[..., SlopesT], model: RobotModel, pi: Array, trajectory: Trajectory
) -> SlopesT:
    """Return derivatives for consistent bodies, or the difference of those of two sets of these."""
    added = _consistent_addition(model, pi)
    state = trajectory.q, trajectory.v, trajectory.a
    found = slopes(model, pi + added, *state)
    return found - slopes(model, added, *state) if added.any() else found


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


def _newton_euler(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> Array:
    """Return the torque of the bodies, shape (N, n_rows)."""
    G, pin_model = model.velocity_map, model.with_parameters(pi).pin_model
    data, torque = pin_model.createData(), np.empty((len(v), pin_model.nv))
    is_plain, is_moving = np.array_equal(G, np.eye(len(G))), v.any() or a.any()
    configurations = np.ascontiguousarray(model.configurations(q))
    if is_moving:
        rates, changes = (v, a) if is_plain else (v @ G.T, a @ G.T)
        instants = zip(torque, configurations, rates, changes, strict=True)
        for torque_k, q_k, v_k, a_k in instants:
            torque_k[:] = pin.rnea(pin_model, data, q_k, v_k, a_k)
    else:
        for torque_k, q_k in zip(torque, configurations, strict=True):
            torque_k[:] = pin.computeGeneralizedGravity(pin_model, data, q_k)
    return torque if is_plain else torque @ G  # tau = G^T tau_pinocchio
