"""Checks of a floating base and of contacts: pose, twist, IMU, measured forces, feet that move."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.base_motion import LEVEL, ImuFrame, base_state, in_base, pose_jumps
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import AGREES, BETTER, DIFFERS
from robotid.dynamics.constraint_rows import (
    constraint_jacobian,
    force_basis,
    touching,
    without_forces,
)
from robotid.dynamics.prepared_logs import closed_log, with_contacts
from robotid.dynamics.torque import predict
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.model import RobotModel

_MOST = 1000  # samples at which poses and forces are compared
_MOVES = 5e-3  # [m/s] speed of feet on the ground below which they are at rest
_SLIDES = 0.1  # [m/s] RMS speed of a foot in contact above which it is reported ...
_STANDS = 0.3  # ... if it is above this share of its speed without contact, or without rolling
_LOADED = 0.1  # of the largest measured force: a foot with more is on the ground
_ALIKE = (0.6, 1.6)  # factors of the forces that a wrong URDF explains
_FORCE_UNITS = {"kN": 1e3, "kgf": 9.81}
_SLOWER = 0.65  # ratio of speeds below which another pose explains the motion
_SIMPLER = 1.2  # factor by which each further change of a pose must reduce the speed ...
# [m/s or rad/s] ... plus this noise, the RMS value from which velocities are compared
_NOISE = 1e-3
_UNLIKE = 0.3  # of the motion or weight: difference of a wrong velocity or force
_DEGREES = np.pi / 180
_UNITS = {"linear": ("mm/s", 1e-3), "angular": ("deg/s", _DEGREES)}
_BACK = np.array([-1.0, -1.0, -1.0, 1.0])  # signs of the inverse quaternion
_ABOVE = 0.3  # vertical distance of base and feet over their distance, from which one is above
_ALONG = 0.8  # component of the unit vector from the feet to the base that may be the vertical
_STRIDE = 0.2  # [s] over which the acceleration of a base is averaged
_FASTEST = 30.0  # [m/s^2] RMS value of it above which the position is in mm
_IMU_MOVES = 0.1  # [rad/s] RMS from which angular velocities are compared
_TILT = 8.0  # [deg] largest angle of the mean specific force from the vertical


def check_base(model: RobotModel, log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield findings on the base and the contacts of one log."""
    imu = None if log.base is None else log.base.imu
    if wrong := list(check_unit(log)):
        yield from wrong
        return
    if imu is None:
        yield from check_pose(log)
    twist = check_twist(log, signals)
    if not model.contacts and imu is None:
        yield from twist
        return
    still = replace(signals, velocity="differentiated", acceleration="differentiated")
    try:
        log = closed_log(model, log)
        motion = process(log, still)
        wrong = list(check_order(model, log, motion))
        whole = log if wrong else with_contacts(model, log, signals)
        motion = process(whole, still)
    except DataError:  # too short, or no contacts: raised again when the log is read
        yield from twist
        return
    yield from wrong or twist
    if wrong:
        return
    for note in whole.notes[len(log.notes) :]:
        yield finding("log_note", log.name, text=note)
    flags = _flags(model, log, whole, motion.t)
    wrong = [] if imu is None else list(check_imu(whole, motion))
    yield from wrong
    is_turned = any(one.code in ("imu_axes", "base_orientation") for one in wrong)
    if not model.contacts or is_turned:
        return
    if not wrong:
        yield from check_wrenches(model, log.name, motion)
    yield from _check_feet(model, log, motion, flags)


def _flags(model: RobotModel, log: Log, whole: Log, t: Array) -> Array:
    """Return whether each contact of a log is in contact at times, shape (N, contacts), bool."""
    flags = np.ones((len(t), len(model.contacts)), dtype=bool)
    for k, contact in enumerate(model.contacts):
        if contact.is_measured:
            flags[:, k] = _loaded(contact, log, t)
        elif not contact.always and contact.frame in whole.contacts:
            flags[:, k] = _at(whole.contacts[contact.frame], whole, t)
    return flags


def check_wrenches(model: RobotModel, log: str, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if measured forces have another sign or unit."""
    # W pi = J^T f in the rows of a floating base, less unknown forces; the best factor is not 1.
    if motion.wrenches is None or not any(x.measured for x in model.contacts):
        return
    every = max(1, len(motion.t) // _MOST)
    wrenches, motion = motion.wrenches[::every], motion.every(every)
    (torque,) = predict(model, [model.standard_parameters()], motion)
    g = float(np.linalg.norm(model.pin_model.gravity.linear))
    weight = sum(x.mass for x in model.pin_model.inertias) * g
    J, basis = _base_rows(model, motion)
    caused = without_forces(basis, np.einsum("kmj,km->kj", J, wrenches))
    left = without_forces(basis, torque[:, :6])
    square = float(np.sum(caused**2))
    factor = float(np.sum(caused * left)) / square if square > 0.0 else 1.0
    if _ALIKE[0] <= factor <= _ALIKE[1]:
        return
    units = (x for x, unit in _FORCE_UNITS.items() if _ALIKE[0] < factor / unit < _ALIKE[1])
    what = next(units, "unit")
    if abs(factor + 1.0) < 1.0 - _ALIKE[0]:
        factor, what = -1.0, "reversed"
    stated, best = (rms((left - x * caused)[:, :3]) for x in (1.0, factor))
    if stated > _UNLIKE * weight and best < BETTER * stated:
        yield finding("measured_wrench", log, what=what, force=stated, best=best, factor=factor)


def _base_rows(model: RobotModel, motion: Trajectory) -> tuple[Array, Array]:
    """Return the rows of the base per measured component, (N, m, 6), and of unknown forces."""
    J = constraint_jacobian(model, motion.q, touching(model, motion))[:, :, :6]
    known, first = list[int](), 0
    for x in model.constraints:
        if isinstance(x, Contact):
            known += [first + k for k in x.rows_measured]
        first += x.sizes[x.kind]
    used = np.ones((len(J), 6), dtype=bool)
    return J[:, known], force_basis(np.delete(J, known, axis=1), used, floats=True)


def _check_feet(model: RobotModel, log: Log, motion: Trajectory, flags: Array) -> Iterator[Finding]:
    """Yield findings on the motion of each link in contact."""
    J, turn = _contact_jacobian(model, motion.q)
    velocity = np.einsum("kcij,kj->kci", J, motion.v)  # (N, contacts, 3) [m/s]
    has_ground = log.base is None or log.base.has_position
    if not has_ground:  # relative to the median of the links in contact, if there are two
        pairs = (flags.sum(axis=1) > 1)[:, None, None]
        standing = np.where(flags[..., None] | ~pairs, velocity, np.nan)
        velocity = (velocity - np.nanmedian(standing, axis=1)[:, None]) * pairs
    squares = np.sum(velocity**2, axis=2)
    for k, contact in enumerate(model.contacts):
        always = np.ones(len(log.t), dtype=bool)
        stated = always if contact.always else log.contacts.get(contact.frame)
        if stated is None or contact.is_measured:  # found from this motion, or not needed
            continue
        touches, link = _at(stated, log, motion.t), contact.frame
        if contact.kind == "point" and has_ground:
            w = np.einsum("kij,kj->ki", turn[:, k], motion.v)
            rolls = np.column_stack([w[:, 1], -w[:, 0], 0.0 * w[:, 2]])  # v / radius
            if rolling := _radius(contact.radius, velocity[touches, k], rolls[touches]):
                radius, before, after = rolling
                yield finding(
                    "rolling_contact", log.name, subject=link, link=link, radius=radius,
                    before=before, after=after,
                )  # fmt: skip
                continue
        both = (squares[at, k] for at in (touches, ~touches))
        in_contact, apart = (float(np.sqrt(x.mean())) if len(x) else np.inf for x in both)
        if _SLIDES < in_contact < np.inf and (in_contact > _STANDS * apart or touches.all()):
            yield finding("moving_contact", log.name, subject=link, link=link, speed=in_contact)


def _at(flags: Array, log: Log, t: Array) -> Array:
    """Return flags at other times: those of the last row."""
    rows = np.searchsorted(log.t, t + 1e-9, side="right") - 1
    return np.asarray(flags[rows.clip(0, len(flags) - 1)])


def _loaded(contact: Contact, log: Log, t: Array) -> Array:
    """Return whether the measured force of a contact is not small, shape (N,), bool."""
    forces = [part for part in contact.measured if part.startswith("f")]
    parts = [log.wrenches[f"{part} {contact.frame}"] for part in forces]
    size = np.linalg.norm(parts, axis=0)
    return _at(size > _LOADED * size.max(), log, t)


def _contact_jacobian(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return Jacobians (N, k, 3, n_rows) of k points of contact and of their links' turn, world."""
    surfaces = tuple(Contact(contact.frame, "surface") for contact in model.contacts)
    every = np.ones((len(q), len(surfaces)), dtype=bool)
    J = constraint_jacobian(replace(model, constraints=surfaces), q, every)
    J = J.reshape(len(q), len(surfaces), 6, model.n_rows)
    radius = np.array([contact.radius for contact in model.contacts])[:, None]
    J[:, :, 0] -= radius * J[:, :, 4]  # v + w x (0, 0, -radius)
    J[:, :, 1] += radius * J[:, :, 3]
    return J[:, :, :3], J[:, :, 3:]


def _radius(stated: float, v: Array, rolls: Array) -> tuple[float, float, float] | None:
    """Return the radius of a foot in contact that rolls as a ball of another one than stated."""
    # With the median speeds with the stated radius and with it.
    if not rolls.any():
        return None
    # weighted median of v / roll: the smallest sum of |v - change roll|, samples that slip apart
    u, along = rolls[:, :2].ravel(), v[:, :2].ravel()
    u, along = u[u != 0.0], along[u != 0.0]
    ratio = along / u
    order = np.argsort(ratio)
    weight = np.cumsum(np.abs(u)[order])
    change = float(ratio[order][np.searchsorted(weight, 0.5 * weight[-1])])
    before, after = (
        float(np.median(np.linalg.norm(v[:, :2] - x * rolls[:, :2], axis=1))) for x in (0.0, change)
    )
    radius = stated + change
    if radius <= 0.0 or before < _MOVES or after > _STANDS * before:
        return None
    return radius, before, after


def check_pose(log: Log) -> Iterator[Finding]:
    """Yield findings on the logged pose of a base: jumps from one row to the next."""
    if log.base is None:
        return
    rows, *sizes = pose_jumps(log.t, log.base.pose)
    for size, unit in zip(sizes, ("m", "rad"), strict=True):
        if size.any():
            times, jumps = log.t[rows[size > 0.0]], size[size > 0.0]
            yield finding(
                "base_jump", log.name, jumps=len(jumps), times=len(jumps) > 1, unit=unit,
                when=seconds(times[0]), first_size=jumps[0], size=jumps.max(), first=times[0],
            )  # fmt: skip


def check_unit(log: Log) -> Iterator[Finding]:
    """Yield a finding if the position of a base is in mm: it moves too fast, averaged over time."""
    if log.base is None or not log.base.has_position:
        return
    t = np.arange(log.t[0], log.t[-1], _STRIDE)
    x = np.stack([np.interp(t, log.t, column) for column in log.base.pose[:, :3].T], axis=1)
    if len(t) < 3:
        return
    size = rms(np.diff(x, n=2, axis=0) / _STRIDE**2)
    if size >= _FASTEST:
        yield finding("base_unit", log.name, acceleration=size, stride=_STRIDE, if_mm=1e-3 * size)


def check_twist(log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield a finding if the measured twist is not that of the pose, with the axes of the base."""
    # Both are filtered alike; another reading of the quaternion may explain the twist.
    base = log.base
    if base is None or base.twist is None or base.imu is not None:
        return
    settings = replace(signals, velocity="measured", acceleration="differentiated")
    try:  # the velocity of joints has no effect
        motion = process(replace(log, v=np.zeros_like(log.q)), settings)
    except DataError:  # too short: raised again when the log is read
        return
    place, quaternion, twist = motion.q[:, :3], motion.q[:, 3:7], motion.v[:, :6]

    def of_pose(quaternion: Array) -> Array:
        return base_state(motion.t, np.hstack([place, quaternion]), None, None)[1]

    wanted = of_pose(quaternion)
    readings = {key: of_pose(q) for key, q in orientation_readings(quaternion).items()}
    read = {"logged": twist, "world": _turned(quaternion, twist)}
    read |= {"base": _turned(quaternion * _BACK, twist)}
    parts = {"linear": slice(0, 3), "angular": slice(3, 6)}
    axes = {
        what: {key: rms((x - wanted)[:, part]) for key, x in read.items()}
        for what, part in parts.items()
    }
    for (what, part), other in zip(parts.items(), ("angular", "linear"), strict=True):
        unit, (logged_unit, factor) = "m/s" if what == "linear" else "rad/s", _UNITS[what]
        size, off = rms(wanted[:, part]), axes[what]["logged"]
        causes = {key: axes[what][key] for key in ("world", "base")}
        causes["unit"] = rms(factor * twist[:, part] - wanted[:, part])
        turned = {key: rms((twist - x)[:, part]) for key, x in readings.items()}
        best, cause = min((left, key) for key, left in (causes | turned).items())
        is_explained = best < BETTER * off
        if size < _NOISE or off < (AGREES if is_explained else _UNLIKE) * size:
            continue
        figures: dict[str, Any] = {"size": size, "best": best, "what": what, "unit": unit}
        if is_explained and cause in turned:
            yield finding(
                "base_orientation", log.name, source="twist", reading=cause, cure=cause, turn=False,
                speed=off, **figures,
            )  # fmt: skip
            return
        yield finding(
            "base_twist", log.name, cure=cause if is_explained else "unknown", off=off,
            mixed=is_explained and cause == "world"
            and axes[other]["logged"] < BETTER * axes[other]["world"],
            other=other, logged_unit=logged_unit, off_world=axes[what]["world"], **figures,
        )  # fmt: skip


def _turned(quaternion: Array, twist: Array) -> Array:
    """Return twists (N, 6) with the axes of the base, from those of the world."""
    return np.hstack([in_base(quaternion, twist[:, :3]), in_base(quaternion, twist[:, 3:])])


def orientation_readings(quaternion: Array) -> dict[str, Array]:
    """Return a quaternion (N, 4) as it is if its columns are wrong, by what is wrong with them."""
    order = np.roll(quaternion, -1, axis=1)
    return {"order": order, "inverse": quaternion * _BACK, "both": order * _BACK}


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

    def speed(self, pose: tuple[Array, Array]) -> float:
        """Return the mean speed of the slowest contact of each sample [m/s]."""
        # Without a place of the base it is that of the slowest pair, relative to each other.
        R, dR = pose
        v = self.x @ dR.swapaxes(1, 2) + self.dx @ R.swapaxes(1, 2)  # (n, k, 3)
        if self.dp is not None:
            v += self.dp[:, None]
        else:
            first, second = np.triu_indices(v.shape[1], 1)
            v = v[:, first] - v[:, second]
        slowest = np.linalg.norm(v, axis=2).min(axis=1, initial=np.inf)
        return float(slowest.mean()) if v.shape[1] else 0.0

    def upwards(self, R: Array) -> Array:
        """Return the mean unit vector from the contacts to the base, shape (3,)."""
        x = self.x / np.linalg.norm(self.x, axis=2, keepdims=True).clip(1e-9)
        return np.asarray(-(x @ R.swapaxes(1, 2)).mean(axis=(0, 1)))


def check_order(model: RobotModel, log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if feet on the ground hardly move with another reading of the quaternion."""
    # The slowest foot of each sample is on the ground, whatever its flags; without position, feet
    # hardly move relative to each other. The base is above the feet, along any axis of the world. A
    # constant tilt moves no foot, and looks like a slope: it is not found.
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
    gravity = np.asarray(model.pin_model.gravity.linear)
    up, stated = -gravity / (float(np.linalg.norm(gravity)) or 1.0), feet.turned(q)
    mean, speed = feet.upwards(stated[0]), feet.speed(stated)
    height, is_moving = float(mean @ up), speed >= _MOVES
    slower: list[tuple[float, float, str, str]] = []  # rank, speed, reading, gravity
    tried = orientation_readings(q) if is_moving or height <= -_ABOVE else {}
    for key, quaternion in tried.items():
        pose = feet.turned(quaternion)
        moves, direction = feet.speed(pose), feet.upwards(pose[0])
        is_above, is_slow = direction @ up >= _ABOVE, is_moving and moves < _SLOWER * speed
        is_turned_back = height < -_ABOVE and is_above and moves < speed + _MOVES
        remedy = "" if is_above else _vertical(direction, gravity)
        if (is_slow or is_turned_back) and remedy is not None:
            changes = (key == "both") + bool(remedy)
            slower.append(((moves + _NOISE) * _SIMPLER**changes, moves, key, remedy))
    if slower:
        _, best, key, remedy = min(slower, key=lambda x: x[0])
        yield finding(
            "base_orientation", log.name, source="feet", reading=key, cure=key, speed=speed,
            best=best, side=height < -_ABOVE, turn=bool(remedy), gravity=remedy,
        )  # fmt: skip
    elif height < _ABOVE and (remedy := _vertical(mean, gravity)) is not None:
        mean = mean / np.linalg.norm(mean)
        k = int(np.argmax(np.abs(mean)))
        yield finding(
            "base_orientation", log.name, source="vertical", cure="vertical", turn=False,
            axis=("-" if mean[k] < 0 else "") + "xyz"[k], gravity=remedy, height=float(mean @ up),
            best=abs(mean[k]),
        )  # fmt: skip


def _vertical(direction: Array, gravity: Array) -> str | None:
    """Return the setting of gravity along the axis of a direction upwards; None without one."""
    # The mean direction of a base that rolls over is short: it has none.
    k = int(np.argmax(np.abs(direction)))
    if np.abs(direction[k]) < max(_ABOVE, _ALONG * float(np.linalg.norm(direction))):
        return None
    wanted = [0.0, 0.0, 0.0]
    wanted[k] = -float(np.copysign(np.linalg.norm(gravity), direction[k]))
    return f"gravity = [{', '.join(f'{x:g}' for x in wanted)}]"


def rms(values: Array) -> float:
    """Return the root mean square of the lengths of vectors: values (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def check_imu(log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield findings on the IMU of one log."""
    if log.base is None or log.base.imu is None or motion.t[-1] - motion.t[0] < LEVEL:
        return
    yield from _check_gyroscopes(log, motion)
    yield from _check_gravity(log, log.base.imu.frame, motion)


def _check_gyroscopes(log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the angular velocity is not that of the orientation."""
    w, place, quaternion = motion.v[:, 3:6], motion.q[:, :3], motion.q[:, 3:7]

    def off(x: Array, q: Array = quaternion) -> float:
        return rms(x - base_state(motion.t, np.hstack([place, q]), None, None)[1][:, 3:])

    now, size = off(w), off(0.0 * w)
    if rms(w) < _IMU_MOVES or now <= _UNLIKE * size:
        return
    readings = {key: off(w, q) for key, q in orientation_readings(quaternion).items()}
    key, degrees = min(readings, key=lambda x: readings[x]), off(_DEGREES * w)
    if readings[key] <= _UNLIKE * size:
        yield finding(
            "base_orientation", log.name, source="imu", reading=key, cure=key, turn=False,
            speed=now, best=readings[key],
        )  # fmt: skip
        return
    cure = "degrees" if degrees < BETTER * now else "unknown"
    yield finding("imu_axes", log.name, off=now / size, best=min(degrees, now) / size, cure=cure)


def _check_gravity(log: Log, frame: ImuFrame, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the mean specific force in the world is not opposite to gravity."""
    quaternion, v, a = motion.q[:, 3:7], motion.v, motion.a
    f = a[:, :3] + np.cross(v[:, 3:6], v[:, :3]) - in_base(quaternion, frame.gravity)
    mean = in_base(quaternion * _BACK, f).mean(axis=0)
    g = float(np.linalg.norm(frame.gravity))
    size = float(np.linalg.norm(mean))
    cosine = -float(mean @ frame.gravity) / max(g * size, 1e-12)
    angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    if angle < _TILT and abs(size / g - 1.0) < DIFFERS:
        return
    causes = {
        "units": abs(size - 1.0) < DIFFERS,
        "subtracted": size < 0.5 * g,
        "reversed": angle > 180.0 - _TILT,
        "scale": angle < _TILT,
        "axes": True,
    }
    cause = next(key for key, holds in causes.items() if holds)
    yield finding("imu_gravity", log.name, cause_of=cause, angle=angle, size=size, wanted=g)
