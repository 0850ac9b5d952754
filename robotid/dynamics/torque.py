"""Regressor of joint torques: RobotModel + Trajectory -> Problem.

Pinocchio computes the inertial columns; the drive columns follow them.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.constraint_rows import ProjectedRows, loop_basis, mixed_rows, without_forces
from robotid.dynamics.factors import Block, Problem, RowSource
from robotid.dynamics.rows import (
    BLOCK,
    BLOCK_SIZE,
    drive_motion,
    drive_values,
    friction_directions,
    inertial_rows,
    kept_rows,
    remembered,
    trajectory_rows,
)
from robotid.robot.closure import Chains
from robotid.robot.drive_term import DriveMotion
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel

_DECADES = 3.0  # of speeds, at random states of a robot with nonlinear friction


def joint_torque_regressor(
    model: RobotModel,
    q: Array,
    v: Array,
    a: Array,
    direction: Array | None = None,
    memory: Array | None = None,
) -> Array:
    """Return the regressor Y with tau = Y pi at each of N samples, shape (N n_rows, p).

    Ten inertial columns of each body (Atkeson, An, Hollerbach 1986), then those of the drives:
    ``tau_j = Ia a_j + Fv v_j + Fc sign(v_j) + off``. v and a (N, n_rows); None: directions (N, c)
    are the signs of the speeds, internal states (N, m) steady ones.
    """
    wanted = (len(q), model.n_rows)
    if v.shape != wanted or a.shape != wanted:
        raise DataError(f"v and a have shapes {v.shape} and {a.shape}, wanted {wanted}")
    for name, values in (("v", v), ("a", a)):
        if not np.isfinite(values).all():
            k, j = np.argwhere(~np.isfinite(values))[0]
            row = model.row_names[j]
            raise DataError(f"{name}[{k}] of {row} is {values[k, j]}, wanted a finite number")
    Y = np.zeros((len(q), model.n_rows, len(model.layout.names)))
    inertial_rows(model, q, v, a).write(slice(None), Y)
    _write_drives(model, q, v, a, direction, memory, Y)
    return Y.reshape(len(q) * model.n_rows, -1)


def trajectory_regressor(
    model: RobotModel, trajectory: Trajectory, samples: Array | None = None
) -> Array:
    """Return the regressor of N samples of a trajectory, with stored inertial columns if any."""
    m = trajectory if samples is None else trajectory.at(samples)
    if (stored := kept_rows(model, trajectory)) is None:
        return joint_torque_regressor(model, m.q, m.v, m.a, m.direction, m.memory)
    Y = np.zeros((len(m.t), model.n_rows, len(model.layout.names)))
    stored.write(slice(None) if samples is None else samples, Y)
    _write_drives(model, m.q, m.v, m.a, m.direction, m.memory, Y)
    return Y.reshape(len(m.t) * model.n_rows, -1)


class InstantRegressor:
    """Some columns (c,) of the regressor, one sample at a time, without repeated initialisation."""

    def __init__(self, model: RobotModel, columns: Array) -> None:
        if model.free_flyer:
            raise DataError("the base floats, wanted a robot with a fixed base")
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
        _write_drives(model, q[None], v[None], a[None], None, None, Y[None])
        return Y[:, self._columns]


def build_problem(
    model: RobotModel,
    trajectory: Trajectory,
    weight: Array | None = None,
    *,
    compiled: bool | None = None,
) -> Problem:
    """Return the problem W pi = tau of a trajectory: blocks by Pinocchio, rows by either engine."""
    own = trajectory_rows(model, trajectory, weight, compiled)
    weights, used = own.weights, np.any(own.weights, axis=0, keepdims=True).T
    own = replace(own, support=own.support & used)
    source: RowSource = own
    support = own.support
    if trajectory.basis is not None:
        own = trajectory_rows(model, trajectory, None, compiled)
        mixed = mixed_rows(trajectory.basis, weights)[:, None]
        own = replace(own, support=own.support & mixed)
        source = ProjectedRows(own, trajectory.basis, weights)
        support = own.support.any(axis=0) & used
    samples = len(weights)
    length = max(1, min(BLOCK, BLOCK_SIZE // (model.n_rows * len(model.layout.names))))

    def stream() -> Iterator[Block]:
        m = trajectory
        for start in range(0, samples, length):
            part = slice(start, start + length)
            known = (None if x is None else x[part] for x in (m.direction, m.memory))
            W = joint_torque_regressor(model, m.q[part], m.v[part], m.a[part], *known)
            if m.basis is not None:
                Y = W.reshape(-1, model.n_rows, W.shape[1])
                W = without_forces(m.basis[part], Y).reshape(W.shape)
            yield W, trajectory.tau[part].reshape(-1), weights[part].reshape(-1)

    is_projected = trajectory.basis is not None
    return Problem(stream, model.layout.names, model.n_rows, support, (source,), is_projected)


def random_regressor(model: RobotModel, samples: int, rng: np.random.Generator) -> Array:
    """Return the regressor at random states, shape (N n_rows, p), for structural properties.

    With speeds sqrt(g / length) and accelerations g / length, gravity over inertia is the same for
    a finger and a crane. Loops are closed, and their forces eliminated.
    """
    n = len(model.joints)
    rate = np.sqrt(9.81 / model.length)  # [1/s]
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
    model: RobotModel,
    q: Array,
    v: Array,
    a: Array,
    direction: Array | None,
    memory: Array | None,
    Y: Array,
) -> None:
    """Write the drives' columns beside those of the bodies, (N, n_rows, p); no memory: steady."""
    layout, size, first = model.layout, model.layout.n_inertial, model.n_rows - len(model.joints)
    signs = friction_directions(layout, v, direction)
    if memory is None and layout.remembering:
        load = Y[:, first:, :size] @ model.carried_by[:size]
        memory = remembered(layout, drive_motion(layout, q, v, a, signs, load))
    values = drive_values(layout, q, v, a, signs, memory)
    np.multiply(layout.drive_loads, values.T[:, None], out=Y[:, first:, size:])
