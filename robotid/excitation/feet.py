"""Motions of a robot on its feet: joints that keep the feet in place, with exact gradients.

The base is six joints, so that q are ordinary joint coordinates x, y, z, yaw, pitch, roll and the
robot's own. Of them, x are free, and y(x) follow from the feet: g(x, y) = 0, J v = 0, J a + dJ/dt v
= 0, with the Jacobian J of the feet.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.excitation.along import Placements, fixed_tree
from robotid.findings import listed
from robotid.regressor.compiled import Tree
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.model import RobotModel

__all__ = ["Feet", "Frame", "Placed"]

_CLOSED = 1e-12  # [m, rad] error at which a foot counts as in place
_REACHED = 1e-9  # [m, rad] error above which a foot is not in place
_MOST = 25  # iterations of Newton's method
_LONGEST = 0.4  # [rad or m] step of a joint in one of them
_DAMPED = 1e-12  # added to J J^T, so that a stretched leg has an inverse
_STRETCHED = 1e-3  # smallest pivot of the feet's Jacobian relative to its largest
_CENTRED = 4  # steps of the base until the centre of mass is above the middle of the feet
_STEP = 1e-5  # of the finite difference along the velocity, in its scale


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a body.

    Attributes:
        body: Number of the body.
        origin: Its origin in the frame of the body, shape (3,) [m].
        axes: Its axes there, shape (3, 3).
    """

    body: int
    origin: Array
    axes: Array


@dataclass(frozen=True, eq=False)
class Placed:
    """Bodies and joints of a robot at N samples, with the axes of the world.

    Attributes:
        tree: The robot.
        poses: Poses of its m bodies.
    """

    tree: Tree
    poses: Placements

    @cached_property
    def axes(self) -> Array:
        """Directions of the joints, shape (N, m, 3)."""
        axes: Array = np.einsum("cdjk,jd->kjc", self.poses.R, self.tree.axes)
        return axes

    @cached_property
    def turning(self) -> Array:
        """The same, 0 for prismatic joints."""
        turning: Array = np.where(self.tree.prismatic[:, None], 0.0, self.axes)
        return turning

    def rotation(self, frame: Frame) -> Array:
        """Return the axes of a frame, shape (N, 3, 3).

        Args:
            frame: The frame.
        """
        rotation: Array = np.moveaxis(self.poses.R[:, :, frame.body], 2, 0) @ frame.axes
        return rotation

    def position(self, frame: Frame) -> Array:
        """Return the origin of a frame, shape (N, 3) [m].

        Args:
            frame: The frame.
        """
        R, p = self.poses.R[:, :, frame.body], self.poses.p[:, frame.body]
        position: Array = p.T + np.einsum("cdk,d->kc", R, frame.origin)
        return position

    def levers(self, frame: Frame) -> Array:
        """Return the velocity of a frame's origin per speed of each joint, shape (N, m, 3).

        Args:
            frame: The frame.
        """
        arms = self.position(frame)[:, None] - np.moveaxis(self.poses.p, 2, 0).swapaxes(1, 2)
        moved = np.where(self.tree.prismatic[:, None], self.axes, np.cross(self.axes, arms))
        levers: Array = moved * self.tree.is_below[frame.body][:, None]
        return levers

    def pulled(self, frame: Frame, moving: Array, turning: Array | None = None) -> Array:
        """Return the gradient of sum_i u_i . dp/dq_i + w_i . dr/dq_i by q, shape (N, m).

        p is the origin of the frame and r its rotation: the derivative of the Jacobian, applied.

        Args:
            frame: The frame.
            moving: u, shape (N, m, 3).
            turning: w, shape (N, m, 3); 0 if None.
        """
        below = self.tree.is_below.astype(float)  # [i, j]: j moves i
        strictly = below - np.eye(len(below))
        levers, axes = self.levers(frame), self.turning
        after = np.einsum("ij,kic->kjc", below, np.cross(levers, moving))
        before = np.einsum("ji,kic->kjc", strictly, np.cross(moving, axes))
        found: Array = np.einsum("kjc,kjc->kj", axes, after)
        found += np.einsum("kjc,kjc->kj", levers, before)
        if turning is not None:
            own = axes * self.tree.is_below[frame.body][:, None]
            later = np.einsum("ij,kic->kjc", strictly, np.cross(own, turning))
            found += np.einsum("kjc,kjc->kj", axes, later)
        return found


class Feet:
    """The feet of a robot on level ground, and the joints that follow from them.

    Args:
        model: The robot, whose base is its first six joints.
        contacts: The contacts on the ground during the whole motion.
        posture: Joint coordinates near the first posture, shape (n,) [rad or m]. The base is
            moved until the centre of mass is above the middle of the feet.
        middles: Middle of each foot's sole in the frame of its link, shape (3,) each [m].

    Attributes:
        model: The robot.
        contacts: The contacts.
        frames: Their frames.
        free: Coordinates that are chosen, shape (k,), int.
        led: Coordinates that follow, shape (n - k,), int.
        posture: Coordinates of a posture with the feet in place, shape (n,) [rad or m].

    Raises:
        SettingsError: If the legs cannot keep the feet in place about this posture.
    """

    def __init__(
        self,
        model: RobotModel,
        contacts: Sequence[Contact],
        posture: Array,
        middles: Sequence[Array],
    ) -> None:
        self.model, self.contacts = model, tuple(contacts)
        self._tree, self._ratios = fixed_tree(model), model.velocity_map
        self.frames = tuple(_frame(model, x.frame) for x in contacts)
        self._turns = [x.kind == "surface" for x in contacts]
        placed = self.placed(posture[None])
        self._places = np.array([placed.position(frame)[0] for frame in self.frames])
        self._axes = [_level(placed.rotation(frame)[0]) for frame in self.frames]
        arms = np.array([axes @ x for axes, x in zip(self._axes, middles, strict=True)])
        self._places[:, 2] = -arms[:, 2]
        middle = (self._places + arms).mean(axis=0)
        moves = np.any([self._tree.is_below[frame.body] for frame in self.frames], axis=0)
        legs = np.flatnonzero((moves @ (self._ratios != 0.0))[6:]) + 6
        J = self.jacobian(placed)[0]
        _, R, order = scipy.linalg.qr(J[:, legs], mode="economic", pivoting=True)
        pivots = np.abs(np.diag(R))
        if len(legs) < len(J) or pivots[-1] < _STRETCHED * pivots[0]:
            raise SettingsError(
                f"{listed([x.frame for x in contacts])} cannot remain in place in this posture: "
                f"{len(J)} conditions, of which the {len(legs)} joints of the legs satisfy "
                f"{int((pivots >= _STRETCHED * pivots[0]).sum())} independently. State a posture "
                "with bent knees (--posture JOINT=RAD), and contacts that are points for legs of "
                "three joints"
            )
        self.led = np.sort(legs[order[: len(J)]])
        self.free = np.setdiff1d(np.arange(model.n_rows), self.led)
        self.posture = posture
        for _ in range(_CENTRED):
            (self.posture,), (left,) = self.solved(self.posture[None, self.free])
            self.posture[:2] -= (self._centre(self.posture) - middle)[:2]
        (self.posture,), (left,) = self.solved(self.posture[None, self.free])
        if left > _REACHED:
            raise SettingsError(
                f"the feet are {1e3 * left:.0f} mm or mrad off level ground in this posture, and "
                "the legs cannot correct it; state another posture (--posture JOINT=RAD)"
            )

    def _centre(self, q: Array) -> Array:
        """Return the centre of mass of the URDF's bodies in a posture, shape (3,) [m]."""
        poses = self.placed(q[None]).poses
        bodies = self.model.standard_parameters()[: self.model.layout.n_inertial].reshape(-1, 10)
        moments = poses.p[..., 0] @ bodies[:, 0]
        moments += np.einsum("cdj,jd->c", poses.R[..., 0], bodies[:, 1:4])
        centre: Array = moments / bodies[:, 0].sum()
        return centre

    def placed(self, q: Array) -> Placed:
        """Return where everything is.

        Args:
            q: Coordinates, shape (N, n) [rad or m].
        """
        return Placed(self._tree, Placements.along(self._tree, q))

    def jacobian(self, placed: Placed) -> Array:
        """Return the Jacobian J of the feet, shape (N, r, n).

        Args:
            placed: Where everything is.
        """
        parts = []
        for frame, turns in zip(self.frames, self._turns, strict=True):
            parts.append(placed.levers(frame))
            if turns:
                parts.append(placed.turning * self._tree.is_below[frame.body][:, None])
        rows = np.concatenate(parts, axis=2) if parts else np.zeros((*placed.axes.shape[:2], 0))
        J: Array = rows.swapaxes(1, 2) @ self._ratios
        return J

    def error(self, placed: Placed) -> Array:
        """Return how far the feet are from their places, shape (N, r) [m, rad].

        Args:
            placed: Where everything is.
        """
        from scipy.spatial.transform import Rotation

        parts = []
        for frame, turns, place, axes in zip(
            self.frames, self._turns, self._places, self._axes, strict=True
        ):
            parts.append(placed.position(frame) - place)
            if turns:
                rotations = placed.rotation(frame) @ axes.T
                parts.append(Rotation.from_matrix(rotations).as_rotvec())
        return np.hstack(parts)

    def solved(self, x: Array) -> tuple[Array, Array]:
        """Return all coordinates, shape (N, n), and the largest error of the feet, (N,) [m, rad].

        Args:
            x: The free coordinates, shape (N, k) [rad or m].
        """
        q = np.tile(self.posture, (len(x), 1))
        q[:, self.free] = x
        left, largest = np.arange(len(x)), np.zeros(len(x))
        for _ in range(_MOST):
            placed = self.placed(q[left])
            error = self.error(placed)
            largest[left] = np.abs(error).max(axis=1)
            is_open = largest[left] > _CLOSED
            if not is_open.any():
                break
            J = self.jacobian(placed)[is_open][:, :, self.led]
            left = left[is_open]
            step = (_inverse(J) @ error[is_open][..., None])[..., 0]
            longest = np.abs(step).max(axis=1, keepdims=True)
            step *= np.minimum(1.0, _LONGEST / np.maximum(longest, 1e-300))
            q[np.ix_(left, self.led)] -= step
        return q, largest

    def along(self, x: Array, dx: Array, ddx: Array) -> tuple[Array, Array, Array, Array]:
        """Return q, v and a, shape (N, n) each, and the errors of the feet, (N,) [m, rad].

        Args:
            x: The free coordinates, shape (N, k) [rad or m].
            dx: Their velocities.
            ddx: Their accelerations.
        """
        q, error = self.solved(x)
        placed = self.placed(q)
        J = self.jacobian(placed)
        inverse, others = _inverse(J[:, :, self.led]), J[:, :, self.free]
        v, a = np.zeros_like(q), np.zeros_like(q)
        v[:, self.free], a[:, self.free] = dx, ddx
        v[:, self.led] = -(inverse @ (others @ dx[..., None]))[..., 0]
        drift = others @ ddx[..., None] + self.drift(placed, v)[..., None]
        a[:, self.led] = -(inverse @ drift)[..., 0]
        return q, v, a, error

    def drift(self, placed: Placed, v: Array) -> Array:
        """Return dJ/dt v, shape (N, r) [m/s^2, rad/s^2].

        Args:
            placed: Where everything is.
            v: Velocities, shape (N, n).
        """
        speeds = (v @ self._ratios.T)[..., None]  # (N, m, 1)
        below = self._tree.is_below.astype(float)
        turns = speeds * placed.turning
        own = np.einsum("ij,kjc->kic", below, turns)  # angular velocity of each body
        above = own - turns
        parts = []
        for frame, turning in zip(self.frames, self._turns, strict=True):
            moved = speeds * placed.levers(frame)
            parts.append(np.cross(own + above, moved).sum(axis=1))
            if turning:
                chain = self._tree.is_below[frame.body][:, None]
                parts.append((np.cross(above, turns) * chain).sum(axis=1))
        return np.hstack(parts)

    def pull(
        self, motion: tuple[Array, Array, Array], gradient: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Return a gradient by the free coordinates, their velocities and accelerations, (N, k).

        The adjoint: multipliers of J a + dJ/dt v = 0, J v = 0 and g = 0, one after another.

        Args:
            motion: q, v and a, shape (N, n) each.
            gradient: The gradient by q, v and a as if they were independent, likewise.
        """
        q, v, a = motion
        by_q, by_v, by_a = gradient
        placed = self.placed(q)
        J = self.jacobian(placed)
        back = -_inverse(J[:, :, self.led]).swapaxes(1, 2)  # (N, r, n - k)

        def multipliers(by: Array) -> Array:
            found: Array = (back @ by[:, self.led, None])[..., 0]
            return found

        of_a = multipliers(by_a)
        by_v = by_v + self._drift_pulled(placed, v, of_a)
        of_v = multipliers(by_v)
        by_q = by_q + self.jacobian_pulled(
            placed, of_a[..., None] * a[:, None] + of_v[..., None] * v[:, None]
        )
        size = _STEP / np.maximum(np.abs(v).max(axis=1, keepdims=True), _STEP)
        push = of_a[..., None] * v[:, None]
        ahead, behind = (
            self.jacobian_pulled(self.placed(q + sign * size * v), push) for sign in (1.0, -1.0)
        )
        by_q = by_q + (ahead - behind) / (2.0 * size)
        of_q = multipliers(by_q)
        free = [
            by[:, self.free] + np.einsum("krj,kr->kj", J[:, :, self.free], of)
            for by, of in ((by_q, of_q), (by_v, of_v), (by_a, of_a))
        ]
        return free[0], free[1], free[2]

    def jacobian_pulled(self, placed: Placed, weights: Array) -> Array:
        """Return the gradient of sum(weights * J) by q, shape (N, n).

        Args:
            placed: Where everything is.
            weights: Weight of each entry of J, shape (N, r, n).
        """
        by_body = weights @ self._ratios.T  # (N, r, m)
        found, first = np.zeros(by_body.shape[::2]), 0
        for frame, turns in zip(self.frames, self._turns, strict=True):
            moving = by_body[:, first : first + 3].swapaxes(1, 2)
            turning = by_body[:, first + 3 : first + 6].swapaxes(1, 2) if turns else None
            found += placed.pulled(frame, moving, turning)
            first += 6 if turns else 3
        by_q: Array = found @ self._ratios
        return by_q

    def _drift_pulled(self, placed: Placed, v: Array, weights: Array) -> Array:
        """Return the gradient of weights . dJ/dt v by v, shape (N, n)."""
        speeds = (v @ self._ratios.T)[..., None]
        below = self._tree.is_below.astype(float)
        turns = speeds * placed.turning
        own = np.einsum("ij,kjc->kic", below, turns)
        found, first = np.zeros(turns.shape[:2]), 0
        for frame, turning in zip(self.frames, self._turns, strict=True):
            lever, by = placed.levers(frame), weights[:, None, first : first + 3]
            moved = np.cross(speeds * lever, by)
            later = 2.0 * np.einsum("ij,kic->kjc", below, moved) - moved
            found += np.einsum("kjc,kjc->kj", np.cross(lever, by), 2.0 * own - turns)
            found += np.einsum("kjc,kjc->kj", placed.turning, later)
            first += 3
            if turning:
                axes = placed.turning * self._tree.is_below[frame.body][:, None]
                by = weights[:, None, first : first + 3]
                turned = np.cross(speeds * axes, by)
                later = np.einsum("ij,kic->kjc", below, turned) - turned
                found += np.einsum("kjc,kjc->kj", np.cross(axes, by), own - turns)
                found += np.einsum("kjc,kjc->kj", placed.turning, later)
                first += 3
        by_v: Array = found @ self._ratios
        return by_v


def _inverse(J: Array) -> Array:
    """Return J^T (J J^T + small)^-1 of square matrices, shape (N, r, r)."""
    transposed = J.swapaxes(1, 2)
    inverse: Array = transposed @ np.linalg.inv(J @ transposed + _DAMPED * np.eye(J.shape[1]))
    return inverse


def _frame(model: RobotModel, link: str) -> Frame:
    frame = model.pin_model.frames[frame_id(model.pin_model, link)]
    place = frame.placement
    if frame.parentJoint == 0:
        raise SettingsError(f"{Path(model.tree.path).name}: {link!r} does not move")
    return Frame(frame.parentJoint - 1, place.translation.copy(), place.rotation.copy())


def _level(axes: Array) -> Array:
    """Return the nearest axes with a vertical one, shape (3, 3)."""
    from scipy.spatial.transform import Rotation

    k = int(np.argmax(np.abs(axes[2])))  # the axis nearest to the vertical
    vertical = np.array([0.0, 0.0, np.sign(axes[2, k])])
    level: Array = Rotation.align_vectors(vertical, axes[:, k])[0].as_matrix() @ axes
    return level
