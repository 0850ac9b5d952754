"""Checks of a floating base and of contacts: pose, twist, IMU, measured forces, feet that move."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.logs.base_pose import (
    check_imu,
    check_order,
    check_pose,
    check_twist,
    check_unit,
    rms,
)
from robotid.dynamics.constraint_rows import (
    constraint_jacobian,
    force_basis,
    touching,
    without_forces,
)
from robotid.dynamics.prediction import predict
from robotid.dynamics.prepared_logs import closed_log, with_contacts
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel

_SLIDES = 0.1  # [m/s] RMS speed of a foot in contact that is reported ...
_STANDS = 0.3  # ... if it is above this share of its speed without contact
_LOADED = 0.1  # of the largest measured force: a foot with more is on the ground
_ROLLS = 0.3  # median speed at the contact of a rolling foot, as a share of that of its frame ...
_CREEPS = 2e-3  # [m/s] ... if the frame is faster than this
_MOST = 400  # samples at which forces are examined
_BETTER = 0.5  # ratio of the residuals of the force below which another reading is found ...
_FORCE = 0.3  # ... of the weight: masses may be it
_ALIKE = (0.6, 1.6)  # factors of the forces that a wrong URDF explains
_UNITS = {"kN": 1e3, "kgf": 9.81}


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
    J, turn = _contact_jacobian(model, motion.q)
    wrong = []
    if imu is not None:
        wrong = list(check_imu(whole, motion))
        yield from wrong
        if any(one.code in ("imu_axes", "base_orientation") for one in wrong):
            return
    if not model.contacts:
        return
    if not wrong:
        yield from check_wrenches(model, log.name, motion)
    yield from _check_feet(model, log, motion, J, turn, flags)


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


def check_wrenches(model: RobotModel, log: str, motion: Trajectory) -> Iterator[Finding]:
    """Yield a finding if measured forces have another sign or unit.

    With the bodies of the URDF, W pi = J^T f in the rows of a floating base, less unknown forces.
    The factor of f with the smallest residual is -1, or another unit.
    """
    if motion.wrenches is None or not any(x.measured for x in model.contacts):
        return
    wrenches = motion.wrenches[:: max(1, len(motion.t) // _MOST)]
    motion = motion.every(max(1, len(motion.t) // _MOST))
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
    what = next((x for x, unit in _UNITS.items() if _ALIKE[0] < factor / unit < _ALIKE[1]), "unit")
    if abs(factor + 1.0) < 1.0 - _ALIKE[0]:
        factor, what = -1.0, "reversed"
    stated, best = (rms((left - x * caused)[:, :3]) for x in (1.0, factor))
    if stated > _FORCE * weight and best < _BETTER * stated:
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


def _check_feet(
    model: RobotModel, log: Log, motion: Trajectory, J: Array, turn: Array, flags: Array
) -> Iterator[Finding]:
    """Yield findings on the motion of each link in contact."""
    velocity = np.einsum("kcij,kj->kci", J, motion.v)  # (N, contacts, 3) [m/s]
    has_ground = log.base is None or log.base.has_position
    squares = np.sum((velocity if has_ground else _relative(velocity, flags)) ** 2, axis=2)
    for k, contact in enumerate(model.contacts):
        stated = (
            np.ones(len(log.t), dtype=bool) if contact.always else log.contacts.get(contact.frame)
        )
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
        in_contact, apart = (
            float(np.sqrt(squares[at, k].mean())) if at.any() else np.inf
            for at in (touches, ~touches)
        )
        if _SLIDES < in_contact < np.inf and (in_contact > _STANDS * apart or touches.all()):
            yield finding("moving_contact", log.name, subject=link, link=link, speed=in_contact)


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


def _radius(stated: float, v: Array, rolls: Array) -> tuple[float, float, float] | None:
    """Return the radius of a foot in contact that rolls as a ball of another one than stated.

    With it are the median speeds with the stated radius and with this one.
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
    radius = stated + change
    if radius <= 0.0 or before < _CREEPS or after > _ROLLS * before:
        return None
    return radius, before, after
