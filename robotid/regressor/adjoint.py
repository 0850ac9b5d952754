"""The torque regressor of many instants at once, and the gradient of whatever is made of it.

All quantities are spatial ones about the origin of the world, with the instants on the last axis.
The screw of joint j is s_j, its bodies' velocity and acceleration

    V_i = sum s_j v_j,    A_i = sum s_j a_j + V_j x s_j v_j - g    over the joints j that carry i,

and row j of body i is the body's regressor, seen from its own frame, along the screw of joint j
there. The gradient goes the same way back (reverse mode, by hand): a body that a joint turns by
d xi takes every screw behind the joint along, d s = d xi x s.

References:
    Featherstone (2008), Rigid Body Dynamics Algorithms, chapter 2; Atkeson, An, Hollerbach (1986),
    Estimation of Inertial Parameters of Manipulator Loads and Links.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.regressor.compiled import joint_constants
from robotid.robot.model import RobotModel

__all__ = ["MotionRegressor", "Poses", "RegressorState"]

_Spatial: TypeAlias = tuple[Array, Array]  # linear and angular part, or force and moment
#: Where xx, xy, yy, xz, yz, zz of an inertia stand in its matrix.
_ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Poses:
    """Where the m bodies of a robot are at N instants, in the frame of its root link.

    Attributes:
        R: Their rotations, shape (3, 3, m, N).
        p: The origins of their joints, shape (3, m, N) [m].
        screw: Linear and angular part of the joints' screws, shape (3, m, N) each.
    """

    R: Array
    p: Array
    screw: _Spatial


@dataclass(frozen=True, eq=False)
class RegressorState(Poses):
    """What a regressor was made of, kept for its gradient. Axes: component, body or pair, instant.

    Attributes:
        rows: Row j of body i for each pair (j, i), shape (pairs, 10, N).
    """

    v: Array  # (m, N)
    a: Array
    velocity: _Spatial
    acceleration: _Spatial
    own_velocity: _Spatial  # in the body's frame
    own_acceleration: _Spatial
    seen: _Spatial  # the screw of j from the frame of i, (3, pairs, N)
    rows: Array


class MotionRegressor:
    """Rows of the torque regressor of a robot's bodies along motions, and their gradient.

    Args:
        model: The robot, with a fixed base.
        is_fast: Whether the compiled way is taken, which needs the extra ``fast`` and half a
            second to start; the figures are the same to rounding.

    Attributes:
        places: Pinocchio's velocity that moves each of the m bodies, shape (m,).
        slides: Which of them slide, shape (m,), bool.

    Raises:
        DataError: If the base floats.
    """

    def __init__(self, model: RobotModel, *, is_fast: bool = False) -> None:
        if model.free_flyer:
            raise DataError("the base floats; motions are designed for robots with a fixed base")
        tree = model.pin_model
        self._is_fast = is_fast
        self._parents = np.array([int(tree.parents[i]) - 1 for i in range(1, tree.njoints)])
        joints = [tree.joints[i] for i in range(1, tree.njoints)]
        self._constants = np.array([joint_constants(tree, i) for i in range(1, tree.njoints)])
        slide, turn = self._constants[:, 33:36], self._constants[:, 36:]  # axes, in own frames
        self.slides = np.any(slide, axis=1)
        self._axes = np.where(self.slides[:, None], slide, turn)
        self.places = np.array([joint.idx_v for joint in joints])
        self._gravity = np.array(tree.gravity.linear)
        size = len(joints)
        carried = np.zeros((size, size))  # [i, j]: joint j carries body i
        for i in range(size):
            carried[i, [j - 1 for j in list(tree.supports[i + 1])[1:]]] = 1.0
        self._carried = carried
        self._bodies, self._joints = np.nonzero(carried)  # of each pair

    @cached_property
    def pairs(self) -> tuple[Array, Array]:
        """Which Pinocchio velocity loads which body: columns of v, and bodies, shape (pairs,)."""
        return self.places[self._joints], self._bodies

    @cached_property
    def _carriers(self) -> Array:
        """Body, and joint that carries it, of each pair, shape (2, pairs)."""
        return np.array([self._bodies, self._joints])

    def __call__(self, q: Array, v: Array, a: Array) -> RegressorState:
        """Return the regressor at N instants.

        Args:
            q: Angles or lengths of the m joints of Pinocchio's model, shape (N, m) [rad, m].
            v: Their velocities, shape (N, m) [rad/s, m/s].
            a: Their accelerations, shape (N, m) [rad/s^2, m/s^2].
        """
        v, a = v.T[self.places], a.T[self.places]
        if self._is_fast:
            return self._state_fast(q.T[self.places], v, a)
        poses = self.poses(q)
        R, p, screw = poses.R, poses.p, poses.screw
        linear, angular = screw
        velocity = self._summed((linear * v, angular * v))
        turned = _motion_cross(velocity, screw)
        acceleration = self._summed((linear * a + turned[0] * v, angular * a + turned[1] * v))
        acceleration = (acceleration[0] - self._gravity[:, None, None], acceleration[1])
        own_velocity = _into(R, p, velocity)
        own_acceleration = _into(R, p, acceleration)
        i, j = self._bodies, self._joints
        seen = _into(R[:, :, i], p[:, i], (linear[:, j], angular[:, j]))
        rows = self._rows(own_velocity, own_acceleration, seen)
        return RegressorState(
            R, p, screw, v, a, velocity, acceleration, own_velocity, own_acceleration, seen, rows
        )

    def _state_fast(self, q: Array, v: Array, a: Array) -> RegressorState:
        """Return the regressor by compiled code, the joints in the order of the bodies."""
        from robotid.regressor.adjoint_lanes import rows_along  # imports Numba

        tree = self._parents, self._constants, self.slides, self._gravity
        q, v, a = (np.array(x, order="C") for x in (q, v, a))
        R, p, screw, *rest = rows_along(*tree, self._carriers, q, v, a)
        return RegressorState(R, p, screw, v, a, *rest)

    def poses(self, q: Array) -> Poses:
        """Return where the bodies are at N instants.

        Args:
            q: Angles or lengths of the m joints of Pinocchio's model, shape (N, m) [rad, m].
        """
        angle = q.T[self.places]
        size, N = angle.shape
        R, p = np.empty((3, 3, size, N)), np.empty((3, size, N))
        cosine, sine = np.cos(angle), np.sin(angle)
        for i, (joint, parent) in enumerate(zip(self._constants, self._parents, strict=True)):
            constant, even, odd = joint[:27].reshape(3, 3, 3).swapaxes(1, 2)[..., None]
            own = constant + even * cosine[i] + odd * sine[i]
            place = joint[27:30, None] + joint[30:33, None] * angle[i]
            if parent < 0:
                R[:, :, i], p[:, i] = own, place
            else:
                above = R[:, :, parent]
                R[:, :, i] = np.einsum("abn,bcn->acn", above, own)
                p[:, i] = p[:, parent] + np.einsum("abn,bn->an", above, place)
        axis = np.einsum("cdjn,jd->cjn", R, self._axes)
        slides = self.slides[:, None]
        linear = np.where(slides, axis, _cross(p, axis))
        return Poses(R, p, (linear, np.where(slides, 0.0, axis)))

    def _summed(self, each: _Spatial) -> _Spatial:
        """Return the sums over the joints that carry each body."""
        linear, angular = each
        return self._carried @ linear, self._carried @ angular

    def _gathered(self, each: _Spatial) -> _Spatial:
        """Return the sums over the bodies that each joint carries."""
        linear, angular = each
        return self._carried.T @ linear, self._carried.T @ angular

    def _rows(
        self,
        velocity: _Spatial,
        acceleration: _Spatial,
        seen: _Spatial,
    ) -> Array:
        i = self._bodies
        u, e = seen
        w, dw = velocity[1][:, i], acceleration[1][:, i]
        d = (acceleration[0] + _cross(velocity[1], velocity[0]))[:, i]
        rows = np.empty((u.shape[1], 10, u.shape[2]))
        rows[:, 0] = _dot(u, d)
        first = _cross(u, dw) + w * _dot(w, u) - u * _dot(w, w) + _cross(d, e)
        rows[:, 1:4] = first.swapaxes(0, 1)
        f = _cross(e, w)
        for k, (x, y) in enumerate(_ENTRIES):
            rows[:, 4 + k] = e[x] * dw[y] + f[x] * w[y]
            if x != y:
                rows[:, 4 + k] += e[y] * dw[x] + f[y] * w[x]
        return rows

    def pull(self, state: RegressorState, weights: Array) -> tuple[Array, Array, Array]:
        """Return the gradient of sum(weights * state.rows) by q, v and a, shape (N, m) each.

        Args:
            state: The regressor.
            weights: What each entry counts, shape (pairs, 10, N).
        """
        if self._is_fast:
            return self._placed(self._pull_fast(state, weights))
        i, j, size = self._bodies, self._joints, len(self._parents)
        to_u, to_e, to_d, to_dw, to_w = self._pull_rows(state, weights)
        # the acceleration of the origin is d = a + w x v
        vl, w = state.own_velocity
        to_w = to_w + _cross(vl, to_d)
        g_A = _out(state.R, state.p, (to_d, to_dw))
        g_V = _out(state.R, state.p, (_cross(to_d, w), to_w))
        g_seen = _out(state.R[:, :, i], state.p[:, i], (to_u, to_e))
        s = state.screw
        turn = _add(_adjoint(state.velocity, g_V), _adjoint(state.acceleration, g_A))
        by_pair = _adjoint((s[0][:, j], s[1][:, j]), g_seen)
        turn = _add(turn, (_by(i, by_pair[0], size), _by(i, by_pair[1], size)))
        g_s = (_by(j, g_seen[0], size), _by(j, g_seen[1], size))
        S_A = self._gathered(g_A)
        g_a = _pair(s, S_A)
        c = _motion_cross(state.velocity, s)
        g_v = _pair(c, S_A)
        bent = _adjoint(state.velocity, S_A)
        g_s = tuple(g + state.a * x + state.v * y for g, x, y in zip(g_s, S_A, bent, strict=True))
        back = _adjoint(s, S_A)
        S_V = self._gathered((g_V[0] - state.v * back[0], g_V[1] - state.v * back[1]))
        g_v = g_v + _pair(s, S_V)
        g_s = (g_s[0] + state.v * S_V[0], g_s[1] + state.v * S_V[1])
        own = _adjoint(s, g_s)
        total = self._gathered((turn[0] - own[0], turn[1] - own[1]))
        return self._placed(np.array([_pair(s, total), g_v, g_a]))

    def _pull_fast(self, state: RegressorState, weights: Array) -> Array:
        """Return the gradient by compiled code, shape (3, m, N)."""
        from robotid.regressor.adjoint_lanes import gradient_along  # imports Numba

        gradient: Array = gradient_along(
            self._parents, self._carriers, state.v, state.a, state.R, state.p, state.screw,
            state.velocity, state.acceleration, state.own_velocity, state.own_acceleration,
            state.seen, weights,
        )  # fmt: skip
        return gradient

    def _placed(self, gradient: Array) -> tuple[Array, Array, Array]:
        """Return gradients by q, v and a, (3, m, N), in the order of the velocities, (N, m)."""
        placed = np.empty_like(gradient)
        placed[:, self.places] = gradient
        by_q, by_v, by_a = placed.swapaxes(1, 2)
        return by_q, by_v, by_a

    def _pull_rows(self, state: RegressorState, weights: Array) -> tuple[Array, ...]:
        i, size = self._bodies, len(self._parents)
        u, e = state.seen
        w, dw = state.own_velocity[1][:, i], state.own_acceleration[1][:, i]
        d = (state.own_acceleration[0] + _cross(state.own_velocity[1], state.own_velocity[0]))[:, i]
        m, h = weights[:, 0], weights[:, 1:4].swapaxes(0, 1)
        inertia = weights[:, 4:]
        Mdw, Mw, Me, f = (_times(inertia, x) for x in (dw, w, e, _cross(e, w)))
        wh, wu = _dot(w, h), _dot(w, u)
        to_u = m * d + _cross(dw, h) + w * wh - h * _dot(w, w)
        to_e = _cross(h, d) + Mdw + _cross(w, Mw)
        to_d = m * u + _cross(e, h)
        to_dw = _cross(h, u) + Me
        to_w = wu * h + wh * u - 2.0 * w * _dot(h, u) + _cross(Mw, e) + f
        return to_u, to_e, *(_by(i, x, size) for x in (to_d, to_dw, to_w))


def _by(index: Array, values: Array, size: int) -> Array:
    """Return sums of values over the pairs of each index, shape (3, size, N)."""
    chosen = np.zeros((size, len(index)))
    chosen[index, np.arange(len(index))] = 1.0
    summed: Array = chosen @ values
    return summed


def _cross(x: Array, y: Array) -> Array:
    """Return x x y along the first axis; np.cross takes three times as long."""
    out = np.empty(np.broadcast_shapes(x.shape, y.shape))
    for k, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(x[a], y[b], out=out[k])
        out[k] -= x[b] * y[a]
    return out


def _dot(x: Array, y: Array) -> Array:
    product: Array = x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    return product


def _pair(x: _Spatial, y: _Spatial) -> Array:
    return _dot(x[0], y[0]) + _dot(x[1], y[1])


def _add(x: _Spatial, y: _Spatial) -> _Spatial:
    return x[0] + y[0], x[1] + y[1]


def _into(R: Array, p: Array, x: _Spatial) -> _Spatial:
    """Return motions of the world as bodies see them: X^-1 x."""
    linear, angular = x
    return _turned_back(R, linear + _cross(angular, p)), _turned_back(R, angular)


def _out(R: Array, p: Array, g: _Spatial) -> _Spatial:
    """Return forces on bodies as the world sees them: X^-T g."""
    linear = _turned(R, g[0])
    return linear, _turned(R, g[1]) + _cross(p, linear)


def _turned(R: Array, x: Array) -> Array:
    """Return R x, the components first."""
    out: Array = R[:, 0] * x[0] + R[:, 1] * x[1] + R[:, 2] * x[2]
    return out


def _turned_back(R: Array, x: Array) -> Array:
    """Return R^T x, the components first."""
    out: Array = R[0] * x[0] + R[1] * x[1] + R[2] * x[2]
    return out


def _motion_cross(x: _Spatial, y: _Spatial) -> _Spatial:
    """Return the spatial cross product of motions, x x y."""
    return _cross(x[1], y[0]) + _cross(x[0], y[1]), _cross(x[1], y[1])


def _adjoint(y: _Spatial, g: _Spatial) -> _Spatial:
    """Return g^T (y x) as a force: what g . (y x z) is by z."""
    return _cross(g[0], y[1]), _cross(g[0], y[0]) + _cross(g[1], y[1])


def _times(inertia: Array, x: Array) -> Array:
    """Return M x of symmetric matrices, given as (pairs, 6, N): xx, xy, yy, xz, yz, zz."""
    xx, xy, yy, xz, yz, zz = inertia.swapaxes(0, 1)
    return np.stack(
        [
            xx * x[0] + xy * x[1] + xz * x[2],
            xy * x[0] + yy * x[1] + yz * x[2],
            xz * x[0] + yz * x[1] + zz * x[2],
        ]
    )
