"""Closed kinematic chains: positions at which loops close, and random states of a closed tree."""

import numpy as np
import pinocchio as pin
from scipy.linalg import qr

from robotid.base.exceptions import DataError, ModelError
from robotid.base.findings import listed
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.robot.constraints import frame_id
from robotid.robot.model import RobotModel

_MOST = 30  # iterations of Newton's method
# square root of the rounding error: the step with which Newton's method ends [rad, m], as the error
# is about its square; and the share of the largest singular value below which loops are dependent
_PRECISE = np.sqrt(np.finfo(float).eps)
_DEAD = 1e-4  # positions that loops determine, relative to the length of the robot
_PATH = 25  # steps from the zero position to the first one
_STEP = 0.25  # [rad, or robot lengths] standard deviation of a step of the random walk
_APART = 4  # steps of the walk between two states


def refuse_loops(model: RobotModel, what: str) -> None:
    """Refuse a robot with loops or passive joints."""
    if model.loops or model.passive:
        found = "loops" if model.loops else "passive joints"
        raise DataError(
            f"{model.name} has {found}; {what} needs a robot without loops and passive joints"
        )


class Chains:
    """The loops of a robot as equations of its n joint coordinates; the base has no effect."""

    def __init__(self, model: RobotModel) -> None:
        self._model, self._data = model, model.pin_model.createData()
        self._first = model.n_rows - len(model.joints)
        self._ids = [[frame_id(model.pin_model, x) for x in loop.frames] for loop in model.loops]
        sizes = [loop.sizes[loop.kind] for loop in model.loops]
        self._loop = np.repeat(np.arange(len(sizes)), sizes)
        is_angle = np.concatenate([np.arange(size) >= 3 for size in sizes])
        self._unit = np.where(is_angle, model.length, 1.0)  # from rad to m
        self._is_long = np.isin(model.joints, list(model.layout.prismatic))

    def gaps(self, q: Array) -> Array:
        """Return the error of each loop at q (N, n), (N, loops) [m]; angles times the length."""
        errors = np.array([self._equations(x)[0] for x in q]).reshape(len(q), -1)
        first = np.flatnonzero(np.diff(self._loop, prepend=-1))
        return np.sqrt(np.add.reduceat(errors**2, first, axis=1))

    def closed(self, q: Array, unknown: Array) -> Array:
        """Return closed positions q (N, n) with the unknown ones (n,), constant once open."""
        x, closed = self._assembled(), q.copy()  # how the chains are assembled
        singular = np.linalg.svd(self._equations(x)[1][:, unknown], compute_uv=False)
        if np.sum(singular > _DEAD * self._model.length) < unknown.sum():
            names = listed([self._model.joints[j] for j in np.flatnonzero(unknown)])
            raise ModelError(
                f"the loops do not determine the positions of {names} near the zero position; log "
                "them. If it is a dead centre, shift the zero position of a joint in the URDF"
            )
        for known in np.linspace(x[~unknown], q[0, ~unknown], _PATH + 1)[1:]:
            x[~unknown] = known
            x = self._newton(x, unknown)
        for k, q_k in enumerate(q):
            x[~unknown] = q_k[~unknown]
            closed[k] = x = self._newton(x, unknown)
            if not self.is_closed(x):
                closed[k:] = x
                break
        return closed

    def is_closed(self, x: Array) -> bool:
        """Return whether the loops close at coordinates to the accuracy of the computation."""
        return bool(self.gaps(x[None]).max() <= TINY * self._model.length)

    def random_states(self, samples: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Return random closed coordinates (N, n) of this assembly, projectors Z (N, n, n) on v."""
        n = len(self._model.joints)
        every, size = np.ones(n, dtype=bool), np.where(self._is_long, self._model.length, 1.0)
        q, Z = np.empty((samples, n)), np.empty((samples, n, n))
        x = self._assembled()
        J = self._equations(x)[1]
        squares = self._squares(J)
        sides = _sides(J, squares)
        for k in range(samples):
            for _ in range(_APART):
                step = _permitted(J) @ (rng.standard_normal(n) * _STEP)
                other = self._newton(x + size * step, every)
                J_other = self._equations(other)[1]
                if _sides(J_other, squares) == sides:
                    x, J = other, J_other
            q[k], Z[k] = x, _permitted(J)
        return q, Z

    def _squares(self, J: Array) -> list[tuple[Array, Array]]:
        """Return rows and columns of square, regular parts of J: of each loop, and of all."""
        groups = [np.flatnonzero(self._loop == k) for k in range(len(self._ids))]
        squares = []
        for rows in [*groups, np.arange(len(J))]:
            R, columns = qr(J[rows], mode="r", pivoting=True)
            size = np.abs(np.diag(R))
            columns = columns[: np.sum(size > TINY * size[0])]
            chosen = qr(J[np.ix_(rows, columns)].T, mode="r", pivoting=True)[1]
            squares.append((rows[chosen[: len(columns)]], columns))
        return squares

    def accelerations(self, q: Array, v: Array) -> Array:
        """Return the smallest accelerations (N, n) that keep closed loops closed."""
        states = zip(q, v, strict=True)
        return np.array([_least(self._equations(q)[1], self._drift(q, v)) for q, v in states])

    def _assembled(self) -> Array:
        """Return the closed position that is nearest to 0, shape (n,)."""
        n = len(self._model.joints)
        x = self._newton(np.zeros(n), np.ones(n, dtype=bool))
        if not self.is_closed(x):
            gaps = self.gaps(x[None])[0]
            worst = self._model.loops[gaps.argmax()]
            raise ModelError(
                f"loop {worst.name} ({worst.kind}) does not close near the zero position: "
                f"{gaps.max():.3g} m remain; correct its frames, its kind or its axis"
            )
        return x

    def _newton(self, x: Array, unknown: Array) -> Array:
        x = x.copy()
        for _ in range(_MOST):
            error, J = self._equations(x)
            step = _least(J[:, unknown], error)
            x[unknown] += step
            if np.linalg.norm(step) <= _PRECISE * (1.0 + np.linalg.norm(x)):
                break
        return x

    def _equations(self, x: Array) -> tuple[Array, Array]:
        """Return the errors of the loops, shape (m,) [m], and their Jacobian, shape (m, n)."""
        pin_model, data, axes = self._model.pin_model, self._data, pin.LOCAL_WORLD_ALIGNED
        pin.computeJointJacobians(pin_model, data, self._configuration(x))
        pin.updateFramePlacements(pin_model, data)
        errors, rows = [], []
        for loop, ids in zip(self._model.loops, self._ids, strict=True):
            jacobians = [pin.getFrameJacobian(pin_model, data, i, axes) for i in ids]
            places = [data.oMf[i] for i in ids]
            errors.append(loop.error(places))
            rows.append(loop.rows(jacobians, places[0]))
        J = np.vstack(rows) @ self._model.velocity_map[:, self._first :]
        return self._unit * np.concatenate(errors), self._unit[:, None] * J

    def _drift(self, x: Array, v: Array) -> Array:
        """Return dJ/dt v, shape (m,)."""
        pin_model, data, axes = self._model.pin_model, self._data, pin.LOCAL_WORLD_ALIGNED
        w = self._model.velocity_map[:, self._first :] @ v
        pin.forwardKinematics(pin_model, data, self._configuration(x), w, 0.0 * w)
        pin.updateFramePlacements(pin_model, data)
        drift = []
        for loop, ids in zip(self._model.loops, self._ids, strict=True):
            accelerations = [
                pin.getFrameClassicalAcceleration(pin_model, data, i, axes).vector for i in ids
            ]
            speeds = [pin.getFrameVelocity(pin_model, data, i, axes).angular for i in ids]
            drift.append(loop.drift(accelerations, speeds, data.oMf[ids[0]].rotation))
        return np.asarray(self._unit * np.concatenate(drift))

    def _configuration(self, x: Array) -> Array:
        pose = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0] if self._model.free_flyer else []
        (configuration,) = self._model.configurations(np.append(pose, x)[None])
        return np.ascontiguousarray(configuration)


def _least(J: Array, error: Array) -> Array:
    """Return the smallest x with J x = -error."""
    return np.asarray(-np.linalg.lstsq(J, error, rcond=_PRECISE)[0])


def _sides(J: Array, squares: list[tuple[Array, Array]]) -> list[float]:
    """Return the signs of the determinants of square parts of J; they change at dead centres."""
    return [float(np.linalg.slogdet(J[np.ix_(*square)])[0]) for square in squares]


def _permitted(J: Array) -> Array:
    """Return the projector on the speeds with J v = 0, shape (n, n)."""
    _, s, Vt = np.linalg.svd(J)
    rank = int(np.sum(s > _PRECISE * s.max(initial=1e-300)))
    return np.asarray(Vt[rank:].T @ Vt[rank:])
