"""Checks of the motion of a floating base and of contacts: axes of the twist, flags, gravity."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.doctor.found_contacts import with_contacts
from robotid.exceptions import DataError
from robotid.findings import Finding, log_finding
from robotid.logs.base import base_state, in_base
from robotid.logs.data import Log, Trajectory
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.regressor.constraints import constraint_jacobian
from robotid.robot.model import RobotModel

__all__ = ["check_base"]

_UNLIKE = 0.3  # of the motion: a measured velocity that differs by more is wrong
_BETTER = 0.5  # ... and is of other axes if these reduce the difference below this share
_MOVES = 1e-3  # [m/s or rad/s] RMS from which velocities are compared
_LONGEST = 0.15  # [s] delay of contact flags that is searched for
_DELAYED = 0.5  # ratio of squared speeds of the foot below which a delay is found
_SLIDES = 0.1  # [m/s] RMS speed of a foot in contact that is reported ...
_STANDS = 0.3  # ... if it is above this share of its speed without contact
_FEWEST = 5  # changes of a contact without which a delay is not examined


def check_base(model: RobotModel, log: Log, signals: SignalSettings) -> Iterator[Finding]:
    """Yield findings on the base and the contacts of one log.

    Args:
        model: The robot, whose base floats.
        log: The log.
        signals: How the log becomes a trajectory.
    """
    if log.base is not None and log.base.twist is not None:
        yield from _check_axes(log)
    if not model.contacts:
        return
    still = replace(signals, velocity="differentiated", acceleration="differentiated")
    try:
        found = with_contacts(model, log, signals)
        motion = process(found, still)
    except DataError:  # too short, or no contacts: raised again when the log is read
        return
    for note in found.notes[len(log.notes) :]:
        yield log_finding(log.name, "log_note", "note", note)
    log = found
    every = np.ones((len(motion.t), len(model.contacts)), dtype=bool)
    J, first = constraint_jacobian(model, motion.q, every), 0
    for contact in model.contacts:
        v = np.einsum("kij,kj->ki", J[:, first : first + 3], motion.v)  # of the link [m/s]
        first += contact.sizes[contact.kind]
        flags = np.ones(len(log.t), dtype=bool)
        if not contact.always and contact.frame in log.contacts:
            flags = log.contacts[contact.frame]
        yield from _check_flags(contact.frame, log, flags, motion, np.sum(v**2, axis=1))


def _check_axes(log: Log) -> Iterator[Finding]:
    """Yield a finding if the measured twist is not that of the pose, with the axes of the base."""
    base = log.base
    if base is None or base.twist is None:
        return
    _, own, _ = base_state(log.t, base.pose, None, None)
    quaternion = base.pose[:, 3:]
    for part, unit in ((slice(0, 3), "m/s"), (slice(3, 6), "rad/s")):
        measured, wanted = base.twist[:, part], own[:, part]
        size = _rms(wanted)
        off = _rms(measured - wanted)
        if size < _MOVES or off < _UNLIKE * size:
            continue
        what = "linear" if unit == "m/s" else "angular"
        turned = _rms(in_base(quaternion, measured) - wanted)
        message = (
            f"the measured {what} velocity of the base differs by {off:.2g} {unit} from that of "
            f"its pose, {size:.2g} {unit} (RMS)"
        )
        if turned < _BETTER * off:
            message += (
                f"; read with the axes of the world it differs by {turned:.2g} {unit}. State twist "
                "= 'world' in [base]"
            )
        else:
            message += ". Check the columns base_vx to base_wz, or remove them"
        evidence = {"off": off, "size": size, "off_world": turned}
        yield log_finding(log.name, "base_twist", "error", message, **evidence)


def _check_flags(
    link: str, log: Log, flags: Array, motion: Trajectory, squares: Array
) -> Iterator[Finding]:
    """Yield findings on one contact: its flags have a delay, or the link moves in contact.

    Args:
        link: The link.
        log: The log.
        flags: Whether it touches the ground, by row of the log.
        motion: The smoothed motion.
        squares: Square of the link's speed along it, shape (N,) [m^2/s^2].
    """
    step = float(np.median(np.diff(motion.t)))

    def mean_square(delay: float) -> float:
        """Return the mean square speed in contact if the flags have a delay [s]."""
        k = np.searchsorted(log.t, motion.t + delay + 1e-9, side="right") - 1
        touching = flags[k.clip(0, len(flags) - 1)]
        return float(squares[touching].mean()) if touching.any() else np.inf

    now = mean_square(0.0)
    changes = int(np.count_nonzero(np.diff(flags.astype(int))))
    if changes >= _FEWEST:
        reach = int(_LONGEST / step)
        delays = step * np.arange(-reach, reach + 1)
        found = np.array([mean_square(delay) for delay in delays])
        best = float(delays[np.argmin(found)])
        if found.min() < _DELAYED * now and abs(best) > 1.5 * step:
            message = (
                f"the flags of the contact {link} are delayed by {best:+.3f} s: with this shift "
                f"its speed in contact is {np.sqrt(found.min()):.2g} m/s instead of "
                f"{np.sqrt(now):.2g} m/s (RMS). Correct the column contact_{link}"
            )
            yield log_finding(log.name, "contact_delay", "warning", message, delay=best)
            return
    own = np.sqrt(now)
    swings = ~flags[(np.searchsorted(log.t, motion.t + 1e-9, side="right") - 1).clip(0)]
    other = np.sqrt(squares[swings].mean()) if swings.any() else np.inf
    if np.isfinite(own) and own > _SLIDES and (own > _STANDS * other or not swings.any()):
        message = (
            f"the link {link} moves at {own:.2g} m/s (RMS) while it is in contact: it slips, its "
            "flags are wrong, or its frame is not at the contact. The force is still eliminated if "
            f"it acts at the origin of {link}"
        )
        yield log_finding(log.name, "moving_contact", "warning", message, speed=own)


def _rms(values: Array) -> float:
    """Return the root mean square of the lengths of vectors (N, 3)."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))
