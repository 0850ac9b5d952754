"""Checks of a floating base and of contacts: pose, twist, IMU, measured forces, feet that move."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding
from robotid.base.text import seconds
from robotid.base.tolerances import LEAST_DIVISOR
from robotid.base.typing import Array
from robotid.data.base_motion import (
    GYROSCOPE_NOISE,
    LEVEL,
    ImuFrame,
    base_state,
    in_base,
    pose_jumps,
)
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import (
    AGREES,
    BETTER,
    BEYOND_NOISE,
    DIFFERS,
    NO_ERROR_OF_MASSES,
    NOTHING,
    ROWS,
)
from robotid.dynamics.constraint_rows import constrained, constraint_jacobian
from robotid.dynamics.prepared_logs import closed_log, with_contacts
from robotid.dynamics.torque import predict
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.model import GRAVITY, RobotModel

_G = float(np.linalg.norm(GRAVITY))  # [m/s^2]
_REST = 5e-3  # [m/s or rad/s] speed of a foot or base at rest, and noise of compared velocities
_SLIDES = 0.1  # [m/s] RMS speed of a foot in contact above which it is reported
_STRIDE = 0.2  # [s] over which the acceleration of a base is averaged
_DEGREES = np.pi / 180
_UNITS = {"linear": ("m/s", "mm/s", 1e-3), "angular": ("rad/s", "deg/s", _DEGREES)}
_PARTS = {"linear": slice(0, 3), "angular": slice(3, 6)}  # of a twist
_BACK = np.array([-1.0, -1.0, -1.0, 1.0])  # signs of the inverse quaternion


def examine_base(
    model: RobotModel, log: Log, signals: SignalSettings
) -> tuple[list[Finding], Trajectory | None]:
    """Return findings on the base and contacts of one log, and its motion if that has no error."""
    imu = None if log.base is None else log.base.imu
    if wrong := list(check_unit(log)):
        return wrong, None
    findings = [] if imu is not None else list(check_pose(log))
    twist = list(check_twist(log, signals))
    if not model.contacts and imu is None:
        return findings + twist, None
    still = replace(signals, velocity="differentiated", acceleration="differentiated")
    try:
        log = closed_log(model, log)
        motion = process(log, still)
        wrong = list(check_order(model, log, motion))
        whole = log if wrong else with_contacts(model, log, signals)
        motion = process(whole, still)
    except DataError:  # too short, or no contacts: raised again when the log is read
        return findings + twist, None
    if wrong:
        return findings + wrong, None
    findings += twist
    findings += [finding("log_note", log.name, text=x) for x in whole.notes[len(log.notes) :]]
    findings += (wrong := [] if imu is None else list(check_imu(whole, motion)))
    is_turned = any(one.code in ("imu_axes", "base_orientation") for one in wrong)
    if not model.contacts or is_turned:
        return findings, None
    if not wrong:
        findings += check_wrenches(model, log.name, motion)
    findings += _check_feet(model, log, whole, motion)
    return findings, motion


def check_wrenches(model: RobotModel, log: str, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if measured forces have another sign or unit."""
    # W pi = J^T f in the rows of a floating base, less unknown forces, is clearly better fulfilled.
    if motion.wrenches is None or not any(x.measured for x in model.contacts):
        return
    motion = motion.every(max(1, len(motion.t) // ROWS))
    g = float(np.linalg.norm(model.pin_model.gravity.linear))
    weight = sum(x.mass for x in model.pin_model.inertias) * g
    of_base = np.broadcast_to(np.arange(model.n_rows) < 6, motion.v.shape)
    known, _ = constrained(model, replace(motion, tau=0.0 * motion.v), of_base)
    (torque,) = predict(model, [model.standard_parameters()], known)
    caused, left = known.tau[:, :6], torque[:, :6]
    factor = float(np.sum(caused * left)) / max(float(np.sum(caused**2)), NOTHING)
    factors = {"reversed": -1.0, "kN": 1e3, "kgf": _G, "unit": factor}
    errors = {what: rms((left - x * caused)[:, :3]) for what, x in factors.items()}
    stated = rms((left - caused)[:, :3])
    what = next((key for key, error in errors.items() if error < BETTER * stated), "")
    if what and stated > BETTER * weight:
        at = what if what == "reversed" else "unit"
        best, factor = errors[at], factors[at]
        yield finding("measured_wrench", log, what=what, force=stated, best=best, factor=factor)


def _check_feet(model: RobotModel, log: Log, whole: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield findings on the motion of each link in contact."""
    flags = np.ones((len(motion.t), len(model.contacts)), dtype=bool)
    rows = np.searchsorted(whole.t, motion.t + 1e-9, side="right").clip(1) - 1  # the last ones
    for k, contact in enumerate(model.contacts):
        if contact.is_measured:
            flags[:, k] = False
        elif not contact.always and contact.frame in whole.contacts:
            flags[:, k] = whole.contacts[contact.frame][rows]
    J, turn = _contact_jacobian(model, motion.q)
    velocity = np.einsum("kcij,kj->kci", J, motion.v)  # (N, contacts, 3) [m/s]
    has_ground = log.base is None or log.base.has_position
    if not has_ground:  # relative to the median of the links in contact, if there are two
        pairs = (flags.sum(axis=1) > 1)[:, None, None]
        standing = np.where(flags[..., None] | ~pairs, velocity, np.nan)
        velocity = (velocity - np.nanmedian(standing, axis=1)[:, None]) * pairs
    squares = np.sum(velocity**2, axis=2)
    for k, contact in enumerate(model.contacts):
        touches, link = flags[:, k], contact.frame
        if not (contact.always or link in log.contacts) or contact.is_measured:
            continue  # found from this motion, or not needed
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
        if _SLIDES < in_contact < np.inf and (in_contact > BETTER * apart or touches.all()):
            yield finding("moving_contact", log.name, subject=link, link=link, speed=in_contact)


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
    u, along = rolls[:, :2].ravel(), v[:, :2].ravel()
    u, along = u[u != 0.0], along[u != 0.0]
    if not len(u):
        return None
    # weighted median of v / roll: the smallest sum of |v - change roll|, samples that slip apart
    change = float(np.quantile(along / u, 0.5, weights=np.abs(u), method="inverted_cdf"))
    before, after = (
        float(np.median(np.linalg.norm(v[:, :2] - x * rolls[:, :2], axis=1))) for x in (0.0, change)
    )
    radius = stated + change
    if radius <= 0.0 or before < _REST or after > BETTER * before:
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
    if size >= NO_ERROR_OF_MASSES * _G:
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
    quaternion, twist = motion.q[:, 3:7], motion.v[:, :6]
    read = {"world": _turned(quaternion, twist), "base": _turned(quaternion * _BACK, twist)}
    read["unit"] = twist * np.repeat([factor for *_, factor in _UNITS.values()], 3)
    errors = _velocity_errors(motion, read)
    for what, other in zip(errors, reversed(errors), strict=True):
        size, off = errors[what]
        cause = _cause(size, off, _REST)
        if cause in orientation_readings(quaternion):
            yield _misread(log.name, what, cause, size, off)
            return
        unit, logged_unit, _ = _UNITS[what]
        others = errors[other][1]
        if cause:
            yield finding(
                "base_twist", log.name, cure=cause, off=off["logged"], size=size, what=what,
                mixed=cause == "world" and others["logged"] < BETTER * others["world"],
                other=other, unit=unit, logged_unit=logged_unit, off_world=off["world"],
                best=min(off.values()),
            )  # fmt: skip


def _velocity_errors(
    motion: Trajectory, read: dict[str, Array]
) -> dict[str, tuple[float, dict[str, float]]]:
    """Return the RMS velocity of the pose, and by reading how far the measured one is from it."""
    place, quaternion, twist = motion.q[:, :3], motion.q[:, 3:7], motion.v[:, :6]
    of_pose = {
        key: base_state(motion.t, np.hstack([place, q]), None, None)[1]
        for key, q in {"logged": quaternion, **orientation_readings(quaternion)}.items()
    }
    left = {key: twist - v for key, v in of_pose.items()}
    left |= {key: v - of_pose["logged"] for key, v in read.items()}
    return {
        what: (rms(of_pose["logged"][:, part]), {key: rms(x[:, part]) for key, x in left.items()})
        for what, part in _PARTS.items()
    }


def _cause(size: float, off: dict[str, float], noise: float) -> str:
    """Return the reading with which a velocity is that of the pose, or "unknown"; "": as logged."""
    # A velocity that is wrong does not agree with the pose better than with rest.
    best, cause = min((error, key) for key, error in off.items())
    is_explained = best < BETTER * off["logged"]
    if size < noise or off["logged"] < (AGREES if is_explained else BETTER) * size:
        return ""
    return cause if is_explained else "unknown"


def _misread(log: str, what: str, cause: str, size: float, off: dict[str, float]) -> Finding:
    """Return the finding that a measured velocity shows another reading of the quaternion."""
    return finding(
        "base_orientation", log, source="velocity", reading=cause, cure=cause, turn=False,
        what=what, unit=_UNITS[what][0], size=size, speed=off["logged"], best=off[cause],
    )  # fmt: skip


def _turned(quaternion: Array, twist: Array) -> Array:
    """Return twists (N, 6) with the axes of the base, from those of the world."""
    return np.hstack([in_base(quaternion, twist[:, :3]), in_base(quaternion, twist[:, 3:])])


def orientation_readings(quaternion: Array) -> dict[str, Array]:
    """Return a quaternion (N, 4) as it is if its columns are wrong, by what is wrong with them."""
    order = np.roll(quaternion, -1, axis=1)
    return {"order": order, "inverse": quaternion * _BACK, "both": order * _BACK}


def check_order(model: RobotModel, log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if feet on the ground hardly move with another reading of the quaternion."""
    # Each change of the pose must clearly reduce the speed. The base is above the feet, along any
    # axis of the world. A constant tilt moves no foot, and looks like a slope: it is not found.
    if log.base is None or not model.contacts or len(motion.t) < 3:
        return
    frames = [x.frame for x in model.contacts]
    p, q = motion.q[:, :3], motion.q[:, 3:7]
    off = link_positions(model.pin_model, model.configurations(motion.q), frames) - p[:, None]
    x = [in_base(q, off[:, k]) for k in range(len(frames))]  # places of the feet in the base
    gravity = np.asarray(model.pin_model.gravity.linear)
    g = float(np.linalg.norm(gravity)) or 1.0
    readings = list[tuple[float, str, float, Array | None, Array]]()
    for key, quaternion in {"": q, **orientation_readings(q)}.items():
        feet = np.stack([in_base(quaternion * _BACK, x_k) for x_k in x], axis=1)  # beside the base
        speed = _slowest(motion.t, feet + p[:, None], log.base.has_position)
        middle = -feet.mean(axis=1)
        length = np.linalg.norm(middle, axis=1, keepdims=True).clip(LEAST_DIVISOR)
        direction = (middle / length).mean(axis=0)
        up = _vertical(direction, -gravity / g)
        if up is None and key:
            continue
        up = None if up is None or up @ gravity <= -BETTER * g else up
        changes = bool(key) + (key == "both") + (up is not None)
        readings.append(((speed + _REST) / BETTER**changes, key, speed, up, direction))
    _, key, best, up, _ = min(readings, key=lambda reading: reading[0])
    _, _, speed, _, stated = readings[0]
    height, remedy = -float(stated @ gravity) / g, ""
    if up is not None:
        remedy = f"gravity = [{', '.join(f'{-g * x_k + 0.0:g}' for x_k in up)}]"
    if key:
        yield finding(
            "base_orientation", log.name, source="feet", reading=key, cure=key, speed=speed,
            best=best, side=height < 0.0, turn=bool(remedy), gravity=remedy,
        )  # fmt: skip
    elif up is not None:
        k = int(np.argmax(np.abs(up)))
        yield finding(
            "base_orientation", log.name, source="vertical", cure="vertical", turn=False,
            axis=("-" if up[k] < 0 else "") + "xyz"[k], gravity=remedy, height=height,
            best=float(up @ stated) / float(np.linalg.norm(stated)),
        )  # fmt: skip


def _slowest(t: Array, feet: Array, has_position: bool) -> float:
    """Return the mean speed of the slowest foot at each time [m/s]: feet (N, k, 3) [m]."""
    # It is on the ground, whatever its flags. Without position: of the slowest pair.
    v: Array = np.gradient(feet, t, axis=0)
    if not has_position:
        first, second = np.triu_indices(v.shape[1], 1)
        v = v[:, first] - v[:, second]
    slowest = np.linalg.norm(v, axis=2).min(axis=1, initial=np.inf)
    return float(slowest.mean()) if v.shape[1] else 0.0


def _vertical(direction: Array, up: Array) -> Array | None:
    """Return the stated vertical or the axis of the world along a direction; None without one."""
    # The mean direction of a base that rolls over is short: it has none.
    if direction @ up >= BETTER:
        return up
    axis = np.zeros(3)
    k = int(np.argmax(np.abs(direction)))
    axis[k] = np.sign(direction[k])
    return axis if np.linalg.norm(direction - axis) < BETTER else None


def rms(values: Array) -> float:
    """Return the root mean square of the lengths of vectors: values (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def check_imu(log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield findings on the IMU of one log."""
    if log.base is None or log.base.imu is None or motion.t[-1] - motion.t[0] < LEVEL:
        return
    read = {"unit": _DEGREES * motion.v[:, :6]}
    size, off = _velocity_errors(motion, read)["angular"]
    cause = _cause(size, off, BEYOND_NOISE * GYROSCOPE_NOISE)
    if cause in orientation_readings(motion.q[:, 3:7]):
        yield _misread(log.name, "angular", cause, size, off)
    elif cause:
        share, best = off["logged"] / size, min(off.values()) / size
        yield finding("imu_axes", log.name, off=share, best=best, cure=cause)
    yield from _check_gravity(log, log.base.imu.frame, motion)


def _check_gravity(log: Log, frame: ImuFrame, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if the mean specific force in the world is not opposite to gravity."""
    quaternion, v, a = motion.q[:, 3:7], motion.v, motion.a
    f = a[:, :3] + np.cross(v[:, 3:6], v[:, :3]) - in_base(quaternion, frame.gravity)
    g = float(np.linalg.norm(frame.gravity))
    mean, up = in_base(quaternion * _BACK, f).mean(axis=0) / g, -frame.gravity / g
    size = float(np.linalg.norm(mean))
    along = mean / max(size, LEAST_DIVISOR)
    read = {
        "right": mean, "units": g * mean, "subtracted": mean + up, "reversed": -mean,
        "scale": along, "axes": up,
    }  # fmt: skip
    cause = next(key for key, x in read.items() if np.linalg.norm(x - up) < DIFFERS)
    if cause != "right":
        angle = float(np.degrees(np.arccos(np.clip(along @ up, -1.0, 1.0))))
        yield finding("imu_gravity", log.name, cause_of=cause, angle=angle, size=g * size, wanted=g)
