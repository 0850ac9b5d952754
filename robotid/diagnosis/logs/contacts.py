"""Checks of a floating base and of contacts: pose, twist, flags, gravity, forces."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.special import stdtrit

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, listed, log_finding
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.base_pose import check_order, check_pose, check_twist, check_unit
from robotid.diagnosis.logs.imu import check_imu
from robotid.diagnosis.logs.slips import check_slip, without_zeros
from robotid.diagnosis.logs.wrenches import check_wrenches
from robotid.dynamics.completed_logs import closed_log, with_contacts
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel

_LONGEST = 0.15  # [s] delay of contact flags that is searched for
_NEAR = 0.075  # [s] distance of a change of motion from the delay of most changes
_STOPS = 1e-3  # of the largest speed: smaller ones are alike
_SLOWER = 0.5  # median speed in contact over that without, from which no delay can be seen
_OF_MEDIAN = 1.858  # standard error of a median, times sqrt(n), over the median deviation (normal)
_CERTAIN = 0.975  # probability that the scatter of a delay is below its bound
_SLIDES = 0.1  # [m/s] RMS speed of a foot in contact that is reported ...
_STANDS = 0.3  # ... if it is above this share of its speed without contact
_LOADED = 0.1  # of the largest measured force: a foot with more is on the ground
_FEWEST = 2  # lift-offs, and touch-downs, without which a delay is not examined
_ROLLS = 0.3  # median speed at the contact of a rolling foot, as a share of that of its frame ...
_ALIKE = 1.1  # ratio of two radii that are stated as one
_CREEPS = 2e-3  # [m/s] ... if the frame is faster than this


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
        yield log_finding(log.name, "log_note", "note", note)
    flags = _flags(model, log, whole, motion.t)
    J, turn = _contact_jacobian(model, motion.q)
    wrong = []
    if imu is not None:
        wrong = list(check_imu(whole, motion, _of_pairs(J, flags, motion.v)))
        yield from wrong
        if any(finding.code in ("imu_axes", "base_orientation") for finding in wrong):
            return
    if not model.contacts:
        return
    if not wrong:
        yield from check_wrenches(model, log, motion)
    yield from _check_feet(model, log, motion, J, turn, flags, signals)


def _flags(model: RobotModel, log: Log, whole: Log, t: Array) -> Array:
    """Return whether each contact of a log is in contact at times, shape (N, contacts), bool.

    ``whole`` is the log with the contacts that were found.
    """
    flags = np.ones((len(t), len(model.contacts)), dtype=bool)
    for k, contact in enumerate(model.contacts):
        if contact.is_measured:
            flags[:, k] = _loaded(contact, log, t)
        elif not contact.always and contact.frame in whole.contacts:
            flags[:, k] = _at(whole.contacts[contact.frame], whole, t)
    return flags


def _check_feet(
    model: RobotModel, log: Log, motion: Trajectory, J: Array, turn: Array, flags: Array,
    signals: SignalSettings,
) -> Iterator[Finding]:  # fmt: skip
    """Yield findings on the motion of each link in contact."""
    velocity = np.einsum("kcij,kj->kci", J, motion.v)  # (N, contacts, 3) [m/s]
    relative = _relative(velocity, flags)
    has_ground = log.base is None or log.base.has_position
    squares = np.sum((velocity if has_ground else relative) ** 2, axis=2)
    named: dict[int, list[Finding]] = {}
    trusted = flags.copy()  # without those that have a delay
    rolling: list[tuple[float, str, float, float]] = []
    for k, contact in enumerate(model.contacts):
        own = log.contacts.get(contact.frame)
        if contact.always:
            own = np.ones(len(log.t), dtype=bool)
        if own is None or contact.is_measured:  # found from this motion, or not needed
            continue
        named[k] = list(
            _check_flags(contact.frame, log, own, motion, squares[:, k], signals, has_ground)
        )
        is_delayed = "contact_delay" in [finding.code for finding in named[k]]
        trusted[:, k] &= not is_delayed
        if contact.kind == "point" and has_ground and not is_delayed:
            w = np.einsum("kij,kj->ki", turn[:, k], motion.v)
            rolls = np.column_stack([w[:, 1], -w[:, 0], 0.0 * w[:, 2]])  # v / radius
            touching = _at(own, log, motion.t)
            if found_radius := _radius(contact, velocity[touching, k], rolls[touching]):
                rolling.append(found_radius)
                del named[k]
    relative, is_alone = _relative(velocity, trusted), trusted.sum(axis=1) < 2
    drift = np.zeros(3)  # of the pose of the base, that of all feet most of the time
    if trusted.any():
        drift = np.median(velocity[trusted], axis=0)
    for k, found in named.items():
        ways = [relative[:, k]]
        if has_ground:  # of 2 feet, each moves by a half
            apart = 2.0 * relative[:, k]
            apart[is_alone] = velocity[is_alone, k] - drift
            ways = [apart, velocity[:, k]]
        frame = model.contacts[k].frame
        ways = [without_zeros(motion.t, way, J[:, k], flags[:, k]) for way in ways]
        yield from found or check_slip(frame, log, flags[:, k], motion.t, ways, signals)
    yield from _rolling(log.name, sorted(rolling))


def _at(flags: Array, log: Log, t: Array) -> Array:
    """Return flags at other times: those of the last row."""
    rows = np.searchsorted(log.t, t + 1e-9, side="right") - 1
    at: Array = flags[rows.clip(0, len(flags) - 1)]
    return at


def _loaded(contact: Contact, log: Log, t: Array) -> Array:
    """Return whether the measured force of a contact is not small, shape (N,), bool."""
    forces = [part for part in contact.measured if part.startswith("f")]
    parts = [log.wrenches[f"{part} {contact.frame}"] for part in forces]
    size = np.linalg.norm(parts, axis=0)
    return _at(size > _LOADED * size.max(), log, t)


def _relative(velocity: Array, flags: Array) -> Array:
    """Return velocities (N, k, 3) relative to the median of the links in contact.

    They are 0 where fewer than two links are in contact.
    """
    standing = np.where(flags[..., None], velocity, np.nan)
    standing[flags.sum(axis=1) < 2] = 0.0
    relative: Array = velocity - np.nanmedian(standing, axis=1)[:, None]
    relative[flags.sum(axis=1) < 2] = 0.0
    return relative


def _of_pairs(J: Array, flags: Array, v: Array) -> tuple[Array, Array]:
    """Return D and d of the relative velocities D w + d of pairs of links in contact.

    J (N, k, 3, n_rows), flags (N, k), v (N, n_rows).
    """
    D, d = np.zeros((len(J), 0, 3)), np.zeros((len(J), 0))
    for i, j in combinations(range(J.shape[1]), 2):
        both = flags[:, i] & flags[:, j]
        own = (J[:, i] - J[:, j]) * both[:, None, None]
        D = np.concatenate([D, own[..., 3:6]], axis=1)
        d = np.concatenate([d, np.einsum("kij,kj->ki", own[..., 6:], v[:, 6:])], axis=1)
    return D, d


def _contact_jacobian(model: RobotModel, q: Array) -> tuple[Array, Array]:
    """Return the Jacobians (N, k, 3, n_rows) of the k points of contact, and of their links' turn.

    Their axes are those of the world.
    """
    surfaces = tuple(Contact(contact.frame, "surface") for contact in model.contacts)
    every = np.ones((len(q), len(surfaces)), dtype=bool)
    J = constraint_jacobian(replace(model, constraints=surfaces), q, every)
    J = J.reshape(len(q), len(surfaces), 6, model.n_rows)
    radius = np.array([contact.radius for contact in model.contacts])[:, None]
    J[:, :, 0] -= radius * J[:, :, 4]  # v + w x (0, 0, -radius)
    J[:, :, 1] += radius * J[:, :, 3]
    return J[:, :, :3], J[:, :, 3:]


def _check_flags(
    link: str,
    log: Log,
    flags: Array,
    motion: Trajectory,
    squares: Array,
    signals: SignalSettings,
    has_ground: bool,
) -> Iterator[Finding]:
    """Yield findings on one contact: its flags have a delay, or the link moves in contact.

    squares (N,) [m^2/s^2].
    """

    def mean_square(delay: float) -> float:
        """Return the mean square speed in contact if the flags have a delay [s]."""
        touching = _at(flags, log, motion.t + delay)
        return float(squares[touching].mean()) if touching.any() else np.inf

    now = mean_square(0.0)
    if has_ground:
        spread = 1.0 / signals.cutoff if signals.cutoff else 0.0
        found = flag_delay(motion.t, _at(flags, log, motion.t), np.sqrt(squares), spread)
        if found is not None:
            delay, error = found
            message = (
                f"the flags of the contact {link} are delayed by {delay:+.3f} +- {error:.3f} s: "
                f"with this shift its speed in contact is {np.sqrt(mean_square(delay)):.2g} m/s "
                f"instead of {np.sqrt(now):.2g} m/s (RMS). Correct the column contact_{link}"
            )
            evidence = {"delay": delay, "error": error}
            yield log_finding(log.name, "contact_delay", "warning", message, **evidence)
            return
    own = np.sqrt(now)
    swings = ~_at(flags, log, motion.t)
    other = np.sqrt(squares[swings].mean()) if swings.any() else np.inf
    if np.isfinite(own) and own > _SLIDES and (own > _STANDS * other or not swings.any()):
        message = (
            f"the link {link} moves at {own:.2g} m/s (RMS) while it is in contact: it slips, its "
            "flags are wrong, or its frame is not at the contact. The force is still eliminated if "
            f"it acts at the origin of {link}"
        )
        yield log_finding(log.name, "moving_contact", "warning", message, speed=own)


def flag_delay(t: Array, flags: Array, speed: Array, spread: float) -> tuple[float, float] | None:
    """Return the delay of a contact's flags behind its motion, and its error; None without one.

    The flags are shifted to where the link is slowest in contact. Near each of their changes it
    then starts or stops to move: its speed crosses the geometric mean of its median speeds with
    and without contact. A delay is the same at both. What has opposite signs at lift-offs and
    touch-downs, or differs from step to step, is no delay: a slow lift-off, a slip. So the delay
    is the mean of the two medians, half of their difference is its error, and that of the scatter
    is added, and half the spread of the filter: rows of that time beside a contact have no force
    anyway. A link sliding at more than half of its speed in the air shows no delay.

    t (N,) [s], flags (N,), speed (N,) [m/s].
    """
    step = float(np.median(np.diff(t)))
    width = 2 * round(spread / step) + 1
    share = np.convolve(flags, np.ones(width), mode="same")
    flags = share > 0.5 * np.convolve(np.ones(len(flags)), np.ones(width), mode="same")
    if flags.all() or not flags.any():
        return None
    shift = _best_shift(flags, speed, int(_LONGEST / step))
    flags = flags[(np.arange(len(flags)) + shift).clip(0, len(flags) - 1)]
    edges = 1 + np.flatnonzero(np.diff(flags.astype(int)))
    slow, fast = np.median(speed[flags]), np.median(speed[~flags])
    if slow > _SLOWER * fast:
        return None
    level = np.sqrt(slow * fast)
    is_still, near = speed <= level, int(_NEAR / step)
    delays: tuple[list[float], list[float]] = ([], [])  # at lift-offs, at touch-downs
    for before, i, after in zip([0, *edges], edges, [*edges[1:], len(t)], strict=False):
        first, stop = max(i - near, (before + i) // 2), min(i + near, (i + after + 1) // 2)
        wrong = np.where(is_still[first:stop] == flags[i], 1, -1)  # ... before the change
        sums = np.cumsum(wrong)
        k = int(np.argmin(sums))
        if sums[k] < 0 and sums[-1] > sums[k]:
            delays[int(flags[i])].append(shift * step + float(t[i] - t[first + k + 1]))
    if min(map(len, delays)) < _FEWEST:
        return None
    middles = [float(np.median(own)) for own in delays]
    off = np.concatenate([np.array(x) - y for x, y in zip(delays, middles, strict=True)])
    scatter = max(_OF_MEDIAN * float(np.median(np.abs(off))), step)  # robust: some slip
    bound = float(stdtrit(len(off) - 2, _CERTAIN)) * scatter / np.sqrt(len(off))
    delay, error = 0.5 * sum(middles), 0.5 * (abs(middles[1] - middles[0]) + spread) + bound
    return (delay, error) if abs(delay) > error + 1.5 * step else None


def _best_shift(flags: Array, speed: Array, reach: int) -> int:
    """Return the delay of flags with the smallest sum of log(speed / mean) in contact [rows].

    flags (N,), speed (N,) [m/s].
    """
    size = np.log(np.maximum(speed, _STOPS * speed.max()))
    total = np.concatenate([[0.0], np.cumsum(size - size.mean())])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    delays = np.arange(-reach, reach + 1)
    bounds = (edges[:, None] - delays).clip(0, len(flags)).reshape(-1, 2, len(delays))
    sums = (total[bounds[:, 1]] - total[bounds[:, 0]]).sum(axis=0)
    return int(delays[np.argmin(sums)])


def _radius(contact: Contact, v: Array, rolls: Array) -> tuple[float, str, float, float] | None:
    """Return the radius of a foot in contact that rolls as a ball of another one than stated.

    v (N, 3) [m/s], rolls (N, 3) [1/s].
    """
    pace = np.linalg.norm(rolls, axis=1)
    if not np.any(pace > 0.0):
        return None
    # weighted median of v / roll: the smallest sum of |v - change roll|, samples that slip apart
    u, along = rolls[:, :2].ravel(), v[:, :2].ravel()
    ratio = along[u != 0.0] / u[u != 0.0]
    order = np.argsort(ratio)
    weight = np.cumsum(np.abs(u[u != 0.0])[order])
    change = float(ratio[order][np.searchsorted(weight, 0.5 * weight[-1])])
    before, after = (
        float(np.median(np.linalg.norm(v[:, :2] - x * rolls[:, :2], axis=1))) for x in (0.0, change)
    )
    radius = contact.radius + change
    if radius <= 0.0 or before < _CREEPS or after > _ROLLS * before:
        return None
    return radius, contact.frame, before, after


def _rolling(log: str, feet: Sequence[tuple[float, str, float, float]]) -> Iterator[Finding]:
    """Yield a finding for the feet of about one radius."""
    while feet:
        alike = [foot for foot in feet if foot[0] < _ALIKE * feet[0][0]]
        feet = feet[len(alike) :]
        radius = float(np.median([foot[0] for foot in alike]))
        before, after = max(foot[2] for foot in alike), max(foot[3] for foot in alike)
        links, most = listed(sorted(foot[1] for foot in alike)), "at most "
        who = f"the links {links} roll on the ground as balls"
        if len(alike) == 1:
            who, most = f"the link {links} rolls on the ground as a ball", ""
        message = (
            f"{who} of radius {radius:.4f} m: with it the median speed at the contact is "
            f"{most}{after:.2g} m/s, with the stated radius {most}{before:.2g} m/s. State radius = "
            f"{radius:.4f} in [[contact]]"
        )
        figures = {"radius": radius, "before": before, "after": after}
        yield log_finding(log, "rolling_contact", "warning", message, **figures)
