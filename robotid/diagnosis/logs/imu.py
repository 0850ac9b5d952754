"""Checks of an IMU on a floating base: axes, units, and gravity in the specific force."""

from collections.abc import Iterator

import numpy as np

from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.data.base_motion import ImuFrame, base_state, in_base
from robotid.data.log import Log, Trajectory
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.base_pose import orientation_readings, rms

_UNLIKE = 0.3  # of the motion: an angular velocity that differs by more is wrong
_BETTER = 0.5  # ... and has other axes if these reduce the difference below this share
_MOVES = 0.1  # [rad/s] RMS from which angular velocities are compared
_TILT = 8.0  # [deg] largest angle between the mean specific force and the vertical
_SIZE = 0.1  # largest relative error of its size
_SHORTEST = 2.0  # [s] in which the mean acceleration of a robot is small
_DEGREES = np.pi / 180
_DRAWN = 1e-4  # weight of the stated axes, relative to the data
_ALONG = 0.25  # largest difference of an axis from one of the link, of length 1


def check_imu(log: Log, motion: Trajectory, legs: tuple[Array, Array]) -> Iterator[Finding]:
    """Yield findings on the IMU of one log: legs (N, m, 3)."""
    if log.base is None or log.base.imu is None or motion.t[-1] - motion.t[0] < _SHORTEST:
        return
    frame, w = log.base.imu.frame, motion.v[:, 3:6]
    turned = np.broadcast_to(np.eye(3), (len(w), 3, 3))
    own = base_state(motion.t, motion.q[:, :7], None, None)[1][:, 3:]
    found = list(_check_orientation(log, motion, own))
    found = found or list(_check_axes(log, frame, w, turned, -own, "orientation"))
    yield from found or _check_axes(log, frame, w, *legs, "links")
    yield from _check_gravity(log, frame, motion)


def _check_orientation(log: Log, motion: Trajectory, own: Array) -> Iterator[Finding]:
    """Yield a finding if the gyroscopes agree with another reading of the quaternion only.

    ``own`` is the angular velocity by the quaternion as logged, shape (N, 3) [rad/s].
    """
    w, place = motion.v[:, 3:6], motion.q[:, :3]
    now, size = rms(w - own), rms(own)
    if rms(w) < _MOVES or now <= _UNLIKE * size:
        return
    readings = {
        key: rms(w - base_state(motion.t, np.hstack([place, q]), None, None)[1][:, 3:])
        for key, q in orientation_readings(motion.q[:, 3:7]).items()
    }
    key = min(readings, key=lambda x: readings[x])
    if readings[key] <= _UNLIKE * size:
        yield finding(
            "base_orientation", log.name, source="imu", reading=key, cure=key, turn=False,
            speed=now, best=readings[key],
        )  # fmt: skip


def _check_axes(
    log: Log, frame: ImuFrame, w: Array, D: Array, d: Array, source: str
) -> Iterator[Finding]:
    """Yield a finding if D w + d is 0 with other axes or another unit of w only."""

    def off(w: Array) -> float:
        return float(np.sqrt(np.mean(np.sum((np.einsum("kij,kj->ki", D, w) + d) ** 2, axis=1))))

    size, now = off(0.0 * w), off(w)
    if rms(w) < _MOVES or now <= _UNLIKE * size:
        return
    M = _turn(w, D, d)
    best, degrees = off(w @ M.T), off(_DEGREES * w)
    cure: dict[str, float | str] = {"cure": "unknown"}
    if best < _BETTER * now:
        cure = _named(M, frame.rotation)
    elif degrees < _BETTER * now:
        best, cure = degrees, {"cure": "degrees"}
    elif source == "links":  # feet that slip
        return
    yield finding("imu_axes", log.name, source=source, off=now / size, best=best / size, **cure)


def _turn(w: Array, D: Array, d: Array) -> Array:
    """Return the rotation M, shape (3, 3), for which D M w + d is smallest.

    Directions without motion do not turn: the solution is drawn to 1 with a small weight.
    """
    G = np.einsum("kia,kic,kb,ke->abce", D, D, w, w, optimize=True).reshape(9, 9)
    g = -np.einsum("kia,ki,kb->ab", D, d, w, optimize=True).ravel()
    weight = _DRAWN * np.trace(G)
    M = np.linalg.solve(G + weight * np.eye(9), g + weight * np.eye(3).ravel()).reshape(3, 3)
    U, _, V = np.linalg.svd(M)
    turn: Array = U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V
    return turn


def _named(M: Array, Q: Array) -> dict[str, float | str]:
    """Return what a rotation M of measured vectors means, for an IMU with the axes Q."""
    own = Q.T @ M @ Q
    whole = np.rint(own)
    if np.abs(own - whole).max() < _ALONG:
        rows = np.abs(whole).argmax(axis=0)
        names = [("-" if whole[i, k] < 0 else "") + "xyz"[i] for k, i in enumerate(rows)]
        return {"cure": "axes", "axes": ", ".join(names)}
    angle = np.degrees(np.arccos(np.clip((np.trace(M) - 1.0) / 2.0, -1.0, 1.0)))
    return {"cure": "turned", "angle": angle}


def _check_gravity(log: Log, frame: ImuFrame, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the mean specific force in the world is not opposite to gravity."""
    quaternion, v, a = motion.q[:, 3:7], motion.v, motion.a
    f = a[:, :3] + np.cross(v[:, 3:6], v[:, :3]) - in_base(quaternion, frame.gravity)
    back = quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    mean = in_base(back, f).mean(axis=0)
    g = float(np.linalg.norm(frame.gravity))
    size = float(np.linalg.norm(mean))
    cosine = -float(mean @ frame.gravity) / max(g * size, 1e-12)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if angle < _TILT and abs(size / g - 1.0) < _SIZE:
        return
    causes = {
        "units": abs(size - 1.0) < _SIZE,
        "subtracted": size < 0.5 * g,
        "reversed": angle > 180.0 - _TILT,
        "scale": angle < _TILT,
        "axes": True,
    }
    cause = next(key for key, holds in causes.items() if holds)
    yield finding("imu_gravity", log.name, cause_of=cause, angle=angle, size=size, wanted=g)
