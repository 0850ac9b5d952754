"""Checks of the pose of a floating base: jumps, and the order of its quaternion."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robotid._text import seconds
from robotid._typing import Array
from robotid.findings import Finding, log_finding
from robotid.logs.base import BaseMotion, pose_jumps
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.robot.constraints import link_positions
from robotid.robot.model import RobotModel

__all__ = ["check_order", "check_pose", "check_unit"]

_MOVES = 0.02  # [m/s] RMS speed of feet in contact below which no other order is tried
_BETTER = 0.5  # ratio of the speeds below which another order is found
_ABOVE = 0.3  # vertical distance of base and feet over their distance, from which one is above
_STRIDE = 0.2  # [s] over which the acceleration of a base is averaged against noise
_FASTEST = 30.0  # [m/s^2] RMS of this above which its position is in mm
_ALONG = 0.8  # component of the unit vector from the feet to the base that may be the vertical


def check_pose(log: Log) -> Iterator[Finding]:
    """Yield findings on the logged pose of a base: jumps from one row to the next.

    Args:
        log: The log, with a base.
    """
    if log.base is None:
        return
    rows, *sizes = pose_jumps(log.t, log.base.pose)
    for size, unit in zip(sizes, ("m", "rad"), strict=True):
        if not size.any():
            continue
        times, own = log.t[rows[size > 0.0]], size[size > 0.0]
        message = (
            f"the pose of the base jumps {len(own)} time{'s' * (len(own) > 1)}, first at t = "
            f"{seconds(times[0])} s by {own[0]:.2g} {unit}: a marker or tag was found again, or "
            "odometry was corrected. Rows whose smoothed motion contains a jump are left out. If "
            "that leaves too few, correct base_x to base_qw, or use an IMU"
        )
        evidence = {"jumps": float(len(own)), "size": float(own.max()), "first": float(times[0])}
        yield log_finding(log.name, "base_jump", "warning", message, **evidence)


def check_unit(log: Log) -> Iterator[Finding]:
    """Yield a finding if the position of a base is in mm: it moves too fast, averaged over time.

    Args:
        log: The log, with a base.
    """
    if log.base is None or not log.base.has_position:
        return
    t = np.arange(log.t[0], log.t[-1], _STRIDE)
    x = np.stack([np.interp(t, log.t, own) for own in log.base.pose[:, :3].T], axis=1)
    if len(t) < 3:
        return
    second = np.diff(x, n=2, axis=0) / _STRIDE**2
    size = float(np.sqrt(np.mean(np.sum(second**2, axis=1))))
    if size < _FASTEST:
        return
    message = (
        f"the acceleration of the base is {size:.3g} m/s^2 (RMS over {_STRIDE:g} s), more than "
        f"that of jumps. If base_x, base_y and base_z are in mm, it is {1e-3 * size:.2g} m/s^2: "
        "convert them to m. Else correct them"
    )
    yield log_finding(log.name, "base_unit", "error", message, acceleration=size)


def check_order(
    model: RobotModel, log: Log, signals: SignalSettings, motion: Trajectory, flags: Array
) -> Iterator[Finding]:
    """Yield a finding if the quaternion of the base has another order, or is that of the inverse.

    The feet in contact then hardly move, and are not above the base. A world with another vertical
    axis is found, too: the base is above the feet along it.

    Args:
        model: The robot, with contacts.
        log: The log.
        signals: How the log becomes a trajectory.
        motion: Its smoothed motion.
        flags: Which contacts touch the ground, shape (N, k), bool.
    """
    if log.base is None or not log.base.has_position or not flags.any():
        return
    speed, height = _of_feet(model, motion, flags)
    q = log.base.pose[:, 3:]
    is_wrong = speed >= _MOVES or height >= _ABOVE
    readings = {
        "its order is qw qx qy qz: state base_qw = 'base_qx', base_qx = 'base_qy', base_qy = "
        "'base_qz' and base_qz = 'base_qw' in [columns]": np.roll(q, -1, axis=1),
        "it is the orientation of the world in the base: reverse the signs of base_qx, base_qy and "
        "base_qz": q * np.array([-1.0, -1.0, -1.0, 1.0]),
    }
    for words, quaternion in readings.items() if is_wrong else ():
        base = BaseMotion(np.hstack([log.base.pose[:, :3], quaternion]))
        own, above = _of_feet(model, process(replace(log, base=base), signals), flags)
        if above < _ABOVE and (own < _BETTER * speed or height > _ABOVE):
            message = (
                f"with the quaternion of the base as logged, the feet in contact move at "
                f"{speed:.2g} m/s (RMS) {'above' if height > _ABOVE else 'below'} the base, else "
                f"at {own:.2g} m/s below it: {words}"
            )
            evidence = {"speed": speed, "best": own}
            yield log_finding(log.name, "base_orientation", "error", message, **evidence)
            return
    if height > -_ABOVE:
        yield from _check_vertical(model, log, motion)


def _check_vertical(model: RobotModel, log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the base is above its feet along another axis of the world."""
    mean = -_offsets(model, motion).mean(axis=(0, 1))
    mean /= np.linalg.norm(mean).clip(1e-9)
    k = int(np.argmax(np.abs(mean)))
    if abs(mean[k]) < _ALONG:
        return
    stated: Array = model.pin_model.gravity.linear
    gravity = [0.0, 0.0, 0.0]
    gravity[k] = -float(np.copysign(np.linalg.norm(stated), mean[k]))
    axis = ("-" if mean[k] < 0 else "") + "xyz"[k]
    message = (
        "the feet are not below the base, which is above them along "
        f"{axis} of the world. If that axis is the vertical, state gravity = "
        f"[{', '.join(f'{x:g}' for x in gravity)}] at the top of the job file, and measured "
        "forces with the same axes; else check base_qx to base_qw"
    )
    evidence = {"height": float(mean @ -stated / np.linalg.norm(stated)), "best": abs(mean[k])}
    yield log_finding(log.name, "base_orientation", "error", message, **evidence)


def _offsets(model: RobotModel, motion: Trajectory) -> Array:
    """Return the vectors from the base to the links in contact in the world, (N, k, 3) [m]."""
    frames = [x.frame for x in model.contacts]
    feet = link_positions(model.pin_model, model.configurations(motion.q), frames)
    off: Array = feet - motion.q[:, None, :3]
    return off


def _of_feet(model: RobotModel, motion: Trajectory, flags: Array) -> tuple[float, float]:
    """Return RMS speed [m/s] of feet in contact, and mean height above the base per distance."""
    off = _offsets(model, motion)
    feet = off + motion.q[:, None, :3]
    speeds = np.linalg.norm(np.gradient(feet, motion.t, axis=0), axis=2)
    gravity: Array = model.pin_model.gravity.linear
    heights = off @ (-gravity / np.linalg.norm(gravity)) / np.linalg.norm(off, axis=2).clip(1e-9)
    return float(np.sqrt(np.mean(speeds[flags] ** 2))), float(heights.mean())
