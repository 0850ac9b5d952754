"""Checks of the pose of a floating base: jumps, unit, order of its quaternion, axes, twist."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, log_finding
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.base_motion import base_state, in_base, pose_jumps
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.slips import rms
from robotid.robot.constraints import link_positions
from robotid.robot.model import RobotModel

_MOVES = 5e-3  # [m/s] mean speed of feet on the ground below which no other pose is tried
_SLOWER = 0.65  # ratio of the speeds below which another pose is found ...
_BETTER = 0.5  # ... and of the differences below which another twist is
_SIMPLER = 1.2  # a pose with another change is preferred if it reduces the speed by this ...
_FLOOR = 1e-3  # [m/s] ... plus this
_MOST = 1000  # samples at which poses are compared
_TURNS_BY = 1e-3  # [m/s or rad/s] RMS from which velocities are compared
_UNLIKE, _SOME = 0.3, 0.05  # of the motion: difference of a wrong velocity, of one with a cause
_UNITS = {"linear": ("mm/s", 1e-3), "angular": ("deg/s", np.pi / 180)}
_BACK = np.array([-1.0, -1.0, -1.0, 1.0])  # signs of the inverse quaternion
_ABOVE = 0.3  # vertical distance of base and feet over their distance, from which one is above
_STRIDE = 0.2  # [s] over which the acceleration of a base is averaged against noise
_FASTEST = 30.0  # [m/s^2] RMS of this above which its position is in mm
_ALONG = 0.8  # component of the unit vector from the feet to the base that may be the vertical


def check_pose(log: Log) -> Iterator[Finding]:
    """Yield findings on the logged pose of a base: jumps from one row to the next."""
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
    """Yield a finding if the position of a base is in mm: it moves too fast, averaged over time."""
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


def check_twist(log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield a finding if the measured twist is not that of the pose, with the axes of the base.

    Both pass the filter of the motion. If another reading of the quaternion explains the twist, the
    quaternion is wrong.
    """
    base = log.base
    if base is None or base.twist is None or base.imu is not None:
        return
    own = replace(signals, velocity="measured", acceleration="differentiated")
    try:
        motion = process(replace(log, v=np.zeros_like(log.q)), own)  # that of joints has no effect
    except DataError:  # too short: raised again when the log is read
        return
    place, quaternion, twist = motion.q[:, :3], motion.q[:, 3:7], motion.v[:, :6]

    def of_pose(quaternion: Array) -> Array:
        return base_state(motion.t, np.hstack([place, quaternion]), None, None)[1]

    wanted, readings = of_pose(quaternion), orientation_readings(quaternion)
    parts = {"linear": slice(0, 3), "angular": slice(3, 6)}
    read = twist, _turned(quaternion, twist), _turned(quaternion * _BACK, twist)
    axes = {  # differences from the pose: as logged, of the world, of the base if turned before
        what: [rms((x - wanted)[:, part]) for x in read] for what, part in parts.items()
    }
    for what, part in parts.items():
        (off, in_world, turned), unit = axes[what], "m/s" if what == "linear" else "rad/s"
        size, (name, factor) = rms(wanted[:, part]), _UNITS[what]
        scaled = rms(factor * twist[:, part] - wanted[:, part])
        others = {x: rms(twist[:, part] - of_pose(q)[:, part]) for x, q in readings.items()}
        words = min(others, key=lambda x: others[x])
        best = min(in_world, turned, scaled, others[words])
        is_explained = best < _BETTER * off
        if size < _TURNS_BY or off < (_SOME if is_explained else _UNLIKE) * size:
            continue
        message = (
            f"the measured {what} velocity of the base differs by {off:.2g} {unit} from that of "
            f"its pose, {size:.2g} {unit} (RMS)"
        )
        evidence = {"off": off, "size": size, "off_world": in_world}
        if is_explained and best == others[words]:
            message += f"; with another quaternion by {best:.2g} {unit}: {words}"
            evidence = {"speed": off, "best": best}
            yield log_finding(log.name, "base_orientation", "error", message, **evidence)
            return
        other = next(x for x in parts if x != what)
        remedy = ". Check the columns base_vx to base_wz, or remove them"
        if is_explained and best == in_world:
            is_mixed = axes[other][0] < _BETTER * axes[other][1]
            remedy = (
                f"; read with the axes of the world it differs by {best:.2g} {unit}. State twist "
                "= 'world' in [base]"
            ) + is_mixed * f", and turn the {other} velocity, which has the axes of the base, too"
        elif is_explained and best == turned:
            remedy = (
                f"; it has the axes of the base, with which it differs by {best:.2g} {unit}. State "
                "twist = 'base' in [base]"
            )
        elif is_explained:
            remedy = f", by {best:.2g} {unit} if it is in {name}: convert it to {unit}"
        message += remedy
        yield log_finding(log.name, "base_twist", "error", message, **evidence)


def _turned(quaternion: Array, twist: Array) -> Array:
    """Return twists (N, 6) with the axes of the base, from those of the world."""
    return np.hstack([in_base(quaternion, twist[:, :3]), in_base(quaternion, twist[:, 3:])])


def orientation_readings(quaternion: Array) -> dict[str, Array]:
    """Return a quaternion (N, 4) as it is if its columns are wrong, by what is wrong with them.

    quaternion (N, 4).
    """
    order, inverse = np.roll(quaternion, -1, axis=1), "the orientation of the world in the base"
    return {
        "its order is qw qx qy qz: state base_qw = 'base_qx', base_qx = 'base_qy', base_qy = "
        "'base_qz' and base_qz = 'base_qw' in [columns]": order,
        f"it is {inverse}: reverse the signs of base_qx, base_qy and base_qz": quaternion * _BACK,
        f"its order is qw qx qy qz, and it is {inverse}: reverse the signs of base_qy, base_qz and "
        "base_qw, and correct the order in [columns]": order * _BACK,
    }


@dataclass(frozen=True, eq=False)
class _Feet:
    """Contacts and base at n samples, to try other poses of the base."""

    t: Array  # (N,) [s], times of all samples
    every: int  # of them is one of the n
    x: Array  # (n, k, 3), places of the contacts in the base [m]
    dx: Array  # (n, k, 3), their time derivative [m/s]
    dp: Array | None  # (n, 3), velocity of the base [m/s]; None if its place was not recorded

    def turned(self, quaternion: Array) -> tuple[Array, Array]:
        """Return the orientation (n, 3, 3) of quaternions (N, 4), and its time derivative."""
        R = np.stack([in_base(quaternion, axis) for axis in np.eye(3)], axis=1)
        return R[:: self.every], np.gradient(R, self.t, axis=0)[:: self.every]

    def speed(self, pose: tuple[Array, Array], body: Array, world: Array) -> float:
        """Return the mean speed of the slowest contact of each sample [m/s].

        Without a place of the base it is that of the slowest pair, relative to each other.

        body (3, 3), world (3, 3).
        """
        R, dR = (x @ body for x in pose)
        v = self.x @ dR.swapaxes(1, 2) + self.dx @ R.swapaxes(1, 2)  # (n, k, 3)
        if self.dp is not None:
            v += (self.dp @ world.T)[:, None]
        else:
            first, second = np.triu_indices(v.shape[1], 1)
            v = v[:, first] - v[:, second]
        slowest = np.linalg.norm(v, axis=2).min(axis=1, initial=np.inf)
        return float(slowest.mean()) if v.shape[1] else 0.0

    def upwards(self, R: Array) -> Array:
        """Return the mean unit vector from the contacts to the base, shape (3,)."""
        x = self.x / np.linalg.norm(self.x, axis=2, keepdims=True).clip(1e-9)
        up: Array = -(x @ R.swapaxes(1, 2)).mean(axis=(0, 1))
        return up


def check_order(model: RobotModel, log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if feet on the ground hardly move with another reading of the base's pose.

    The slowest foot of each sample is taken to be on the ground, whatever its flags. Tried are
    other orders of the quaternion, its inverse, other axes of the base, and of its position; the
    base must be above the feet. Without position the feet hardly move relative to each other, and
    only quaternions are tried: other axes are those of its IMU. A world with another vertical axis
    is found, too: the base is above the feet along it. A tilt that is constant moves no foot, and
    is not found: it looks like a slope.
    """
    if log.base is None or not model.contacts or len(motion.t) < 3:
        return
    frames = [x.frame for x in model.contacts]
    places = link_positions(model.pin_model, model.configurations(motion.q), frames)
    q, p = motion.q[:, 3:7], motion.q[:, :3]
    off = places - p[:, None]
    x = np.stack([in_base(q, off[:, k]) for k in range(len(frames))], axis=1)
    every = max(1, len(q) // _MOST)
    dx, dp = (np.gradient(y, motion.t, axis=0)[::every] for y in (x, p))
    feet = _Feet(motion.t, every, x[::every], dx, dp if log.base.has_position else None)
    yield from _check_readings(model, log, feet, q)


def _check_readings(model: RobotModel, log: Log, feet: _Feet, q: Array) -> Iterator[Finding]:
    """Yield the finding of ``check_order`` for feet and the logged quaternion (N, 4)."""
    one = np.eye(3)
    stated, gravity = feet.turned(q), np.asarray(model.pin_model.gravity.linear)
    size = float(np.linalg.norm(gravity))
    up = -gravity / size if size else np.zeros(3)
    mean = feet.upwards(stated[0])
    speed, height = feet.speed(stated, one, one), float(mean @ up)
    is_moving = speed >= _MOVES
    if not is_moving and height > -_ABOVE:
        if height < _ABOVE:
            yield from _check_vertical(log, mean, gravity)
        return
    found: list[tuple[float, float, str]] = []  # size, speed, words
    for words, quaternion in {"": q, **orientation_readings(q)}.items():
        pose = feet.turned(quaternion)
        for body, world in _axes() if is_moving and feet.dp is not None else [(one, one)]:
            own, direction = feet.speed(pose, body, world), feet.upwards(pose[0] @ body)
            changes = [words] if words else []
            changes += [_named_body(body)] if (body != one).any() else []
            changes += [_named_world(world)] if (world != one).any() else []
            is_above, is_slow = direction @ up >= _ABOVE, is_moving and own < _SLOWER * speed
            is_turned_back = height < -_ABOVE and is_above and own < speed + _MOVES
            remedy = _vertical(direction, gravity)
            if not changes or not (is_slow or (is_turned_back and changes == [words])):
                continue
            if not is_above and remedy is None:
                continue
            if not is_above:
                changes.append(f"the vertical of the world is another axis: state {remedy}")
            found.append(((own + _FLOOR) * _SIMPLER ** len(changes), own, "; ".join(changes)))
    if found:
        _, own, words = min(found, key=lambda x: x[0])
        message = (
            f"with the pose of the base as logged, the feet on the ground move at {speed:.2g} m/s "
            f"(mean) {'above' if height < -_ABOVE else 'below'} the base, else at {own:.2g} m/s "
            f"below it: {words}"
        )
        evidence = {"speed": speed, "best": own}
        yield log_finding(log.name, "base_orientation", "error", message, **evidence)
    elif height < _ABOVE:
        yield from _check_vertical(log, mean, gravity)


def _axes() -> Iterator[tuple[Array, Array]]:
    """Yield axes of the base, and of its position, one of both changed to others of the 48."""
    one = np.eye(3)
    yield one, one
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = one[list(order)] * np.array(signs)
        if np.array_equal(turn, one):
            continue
        yield turn, one
        yield one, turn


def _named_body(body: Array) -> str:
    """Return what axes of the base in the log mean."""
    words = f"the axes x, y, z of the base in the log are {', '.join(_names(body))} of its link"
    if np.linalg.det(body) < 0.0:
        return f"{words}, left-handed: convert position and orientation to right-handed axes"
    return f"{words}: add a link with these axes to the URDF, and state it as link in [base]"


def _named_world(world: Array) -> str:
    """Return what axes of the position mean."""
    signed = [name.replace("x", "base_x").replace("y", "base_y").replace("z", "base_z")
              for name in _names(world)]  # fmt: skip
    return (
        "the position has other axes than the orientation: replace base_x, base_y, base_z by "
        f"{', '.join(signed)}"
    )


def _names(turn: Array) -> list[str]:
    """Return the signed axis of each row."""
    columns = np.abs(turn).argmax(axis=1)
    return [("-" if turn[i, k] < 0 else "") + "xyz"[k] for i, k in enumerate(columns)]


def _vertical(direction: Array, gravity: Array) -> str | None:
    """Return the setting of gravity along the axis of a direction upwards; None if it has none.

    The mean direction of a base that rolls over is short: it has none.
    """
    k = int(np.argmax(np.abs(direction)))
    if np.abs(direction[k]) < max(_ABOVE, _ALONG * float(np.linalg.norm(direction))):
        return None
    wanted = [0.0, 0.0, 0.0]
    wanted[k] = -float(np.copysign(np.linalg.norm(gravity), direction[k]))
    return f"gravity = [{', '.join(f'{x:g}' for x in wanted)}]"


def _check_vertical(log: Log, mean: Array, gravity: Array) -> Iterator[Finding]:
    """Yield a finding if the base is above its feet along another axis of the world."""
    remedy = _vertical(mean, gravity)
    if remedy is None:
        return
    mean = mean / np.linalg.norm(mean)
    k = int(np.argmax(np.abs(mean)))
    axis = ("-" if mean[k] < 0 else "") + "xyz"[k]
    message = (
        "the feet are not below the base, which is above them along "
        f"{axis} of the world. If that axis is the vertical, state {remedy} at the top of the job "
        "file, and measured forces with the same axes; else check base_qx to base_qw"
    )
    up = -gravity / np.linalg.norm(gravity).clip(1e-9)
    evidence = {"height": float(mean @ up), "best": abs(mean[k])}
    yield log_finding(log.name, "base_orientation", "error", message, **evidence)
