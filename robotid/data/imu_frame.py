"""Motion of a floating base measured by an IMU: angular velocity and specific force."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from robotid.base.typing import Array

#: Names of the values of an IMU: orientation, angular velocity [rad/s], specific force [m/s^2].
IMU = ("qx", "qy", "qz", "qw", "wx", "wy", "wz", "ax", "ay", "az")
_WINDOW = 0.5  # [s] shortest rest in which the bias of the gyroscopes is estimated
_STILL = 0.02  # [rad/s] largest standard deviation of a gyroscope at rest
_UNMOVED = 5e-3  # [rad or m] largest motion of a joint at rest
_LEVEL = 2.0  # [s] in which the mean specific force is vertical; the mean is taken twice
_BREAK = 0.1  # [s] a longer time step: the angular velocity in it is not known


@dataclass(frozen=True, eq=False)
class ImuFrame:
    """Place of an IMU in the base link.

    Attributes:
        quaternion: Orientation of the IMU in the base link, qx qy qz qw, shape (4,).
        lever: Origin of the IMU in the base link, shape (3,) [m].
        gravity: Gravity in the world, shape (3,) [m/s^2].
        bias: Bias of the gyroscopes with the axes of the base, shape (3,) [rad/s]; None to
            estimate it at rest.
        offset: Bias of the accelerometers with the axes of the base, shape (3,) [m/s^2]; None: 0.
    """

    quaternion: Array
    lever: Array
    gravity: Array
    bias: Array | None = None
    offset: Array | None = None

    @property
    def rotation(self) -> Array:
        """Axes of the IMU in the base link, shape (3, 3)."""
        x, y, z, w = self.quaternion
        S = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation: Array = np.eye(3) + 2.0 * (w * S + S @ S)
        return rotation


@dataclass(frozen=True, eq=False)
class ImuMotion:
    """Recorded values of an IMU with the axes of the base link.

    Attributes:
        values: Angular velocity without bias [rad/s] and specific force, the acceleration minus
            gravity [m/s^2], shape (N, 6).
        frame: Place of the IMU, with the bias that was subtracted.
    """

    values: Array
    frame: ImuFrame

    def at(self, rows: slice) -> "ImuMotion":
        """Return some samples."""
        return replace(self, values=self.values[rows])


def motion_of_imu(t: Array, q: Array, values: Array, frame: ImuFrame) -> tuple[ImuMotion, str]:
    """Return the motion of an IMU without the bias of its gyroscopes, and a note on the bias.

    The bias is that of ``bias_at_rest``.

    t (N,) [s], q (N, n) [rad or m], values (N, 6).
    """
    turned = np.hstack([values[:, :3] @ frame.rotation.T, values[:, 3:] @ frame.rotation.T])
    bias, note = frame.bias, ""
    if bias is None:
        bias, note = bias_at_rest([(t, q, turned[:, :3])])
    turned[:, :3] -= bias
    return ImuMotion(turned, replace(frame, bias=bias)), note


def bias_at_rest(parts: Sequence[tuple[Array, Array, Array]]) -> tuple[Array, str]:
    """Return the bias of gyroscopes, shape (3,) [rad/s], and a note on it.

    It is the mean angular velocity in all windows of 0.5 s in which joints and gyroscopes are at
    rest; 0 without one.
    """
    means = []
    for t, q, w in parts:
        number = ((t - t[0]) / _WINDOW).astype(int)
        edges = np.searchsorted(number, np.arange(number[-1] + 1))  # the last window may be short
        means += [
            w[first:stop].mean(axis=0)
            for first, stop in pairwise(edges)
            if stop - first > 4
            and np.ptp(q[first:stop], axis=0).max(initial=0.0) < _UNMOVED
            and w[first:stop].std(axis=0).max() < _STILL
        ]
    if not means:
        return np.zeros(3), (
            "the robot is never at rest for 0.5 s: the bias of the gyroscopes is not estimated; "
            "record 1 s at rest"
        )
    bias: Array = np.array(means).mean(axis=0)
    shown = ", ".join(f"{1e3 * x:+.2f}" for x in bias)
    return bias, (
        f"bias of the gyroscopes, estimated in {_WINDOW * len(means):g} s at rest and "
        f"subtracted: {shown} mrad/s"
    )


def orientation_of_imu(t: Array, values: Array, gravity: Array) -> Array:
    """Return the orientation of a base from an IMU alone, qx qy qz qw, shape (N, 4).

    The angular velocity is integrated. With the axes that result, the mean specific force in some
    seconds is opposite to gravity, for the velocity of a robot hardly changes in them: this
    corrects the tilt. The heading starts at 0.

    References:
        Mahony, Hamel, Pflimlin (2008), Nonlinear Complementary Filters on the Special Orthogonal
        Group; here without delay, for the whole log is known.

    t (N,) [s], values (N, 6), gravity (3,) [m/s^2].
    """
    parts = np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > _BREAK) + 1)
    return np.concatenate([_levelled(t[k], values[k], -gravity) for k in parts])


def _levelled(t: Array, values: Array, up: Array) -> Array:
    """Return the orientation in a part of a log without gaps, shape (N, 4)."""
    w, f = values[:, :3], values[:, 3:]
    half = 0.25 * np.diff(t)[:, None] * (w[1:] + w[:-1])  # half of the turn between two samples
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    turns = np.hstack([half * np.sinc(angle / np.pi), np.cos(angle)])
    q, count = np.vstack([_between(_mean(t, f)[0], up), turns]), 1
    while count < len(q):  # each row is the product of so many rows up to it
        q[count:] = _product(q[:-count], q[count:])
        count *= 2
    x, s = q[:, :3], q[:, 3:]
    u = np.cross(x, f)
    return _product(_between(_mean(t, f + 2.0 * (s * u + np.cross(x, u))), up), q)


def _mean(t: Array, x: Array) -> Array:
    """Return the mean of values over some time around each sample, same shape, taken twice."""
    if len(t) < 2:
        return x
    first, last = (np.clip(t + side * _LEVEL / 2, t[0], t[-1]) for side in (-1, 1))
    for _ in range(2):
        areas = 0.5 * np.diff(t)[:, None] * (x[1:] + x[:-1])
        whole = np.vstack([np.zeros(x.shape[1]), np.cumsum(areas, axis=0)])
        ends = [np.stack([np.interp(at, t, y) for y in whole.T], axis=1) for at in (first, last)]
        x = (ends[1] - ends[0]) / (last - first)[:, None]
    return x


def _between(vector: Array, up: Array) -> Array:
    """Return the smallest rotations that turn vectors (..., 3) upwards, shape (..., 4)."""
    a = vector / np.linalg.norm(vector, axis=-1, keepdims=True).clip(1e-12)
    b = up / np.linalg.norm(up)
    q = np.concatenate([np.cross(a, b), 1.0 + (a @ b)[..., None]], axis=-1)
    size = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(size > 1e-6, q / size.clip(1e-12), np.append(np.roll(b, 1), 0.0))


def _product(p: Array, q: Array) -> Array:
    """Return the products of quaternions, shape (..., 4)."""
    x, y, v, w = p[..., :3], q[..., :3], p[..., 3:], q[..., 3:]
    vector = v * y + w * x + np.cross(x, y)
    scalar = v * w - np.sum(x * y, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def inertial_state(
    t: Array, velocity: Array, down: Array, values: Array, frame: ImuFrame
) -> tuple[Array, Array]:
    """Return twist (N, 6) and its time derivative (N, 6) of a base with an IMU, in base axes.

    With the lever r of the IMU, its specific force f without bias and gravity g, the specific
    force at the origin is f - alpha x r - w x (w x r), and dv/dt = that + g - w x v.

    t (N,) [s], velocity (N, 3) [m/s], down (N, 3) [m/s^2].
    """
    w, f, r = values[:, :3], values[:, 3:], frame.lever
    f = f if frame.offset is None else f - frame.offset
    alpha = np.gradient(w, t, axis=0)
    f = f - np.cross(alpha, r) - np.cross(w, np.cross(w, r))
    rate = np.hstack([f + down - np.cross(w, velocity), alpha])
    return np.hstack([velocity, w]), rate
