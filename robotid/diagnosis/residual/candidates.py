"""Candidate terms of a drive's torque that the model may lack, as columns to test a residual."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.robot.drive_term import DriveMotion, DriveTerm, Family
from robotid.robot.drives import FAMILIES, Harmonic

_RIPPLES = np.arange(5, 241)  # periods per revolution tested: 200 of a gear of 100 : 1
_PEAKS = 6  # of them are tested: those with the largest periodic residual
_STEEP = 8  # twice the order of the filter, which is applied in both directions
_REVERSES = 0.05  # of the RMS speed, over which the sign of a coupling's speed changes
_WINDUP = (0.02, 0.1)  # of the RMS displacement since a reversal: decay of a deflection
_LOADED = 0.05  # of the RMS rigid-body torque, over which the loaded side of a gear changes


@dataclass(frozen=True)
class Candidate:
    """A term that a drive's torque may have, linear in its parameters."""

    name: str  # Its name
    code: str  # Code of the finding that reports it
    #: Columns of its c parameters in N samples, shape (N, c). They are scaled by the motion given,
    #: unless that names another motion
    columns: Callable[[JointMotion], Array]
    meaning: str  # Description of the term for a finding
    advice: str = ""  # Remedy other than adding it to the model; empty if none
    #: Unit of the parameter of a revolute and of a prismatic joint; None: the size is the RMS
    #: torque of the term
    units: tuple[str, str] | None = None
    revolute_only: bool = False  # Whether only a revolute joint has it
    #: Friction families of a job that contain it, see ``FAMILIES``. The first one for which the
    #: joint moved far enough is advised
    families: tuple[str, ...] = ()
    #: Terms of a job's [drives] that are equal to it, if no family is
    terms: tuple[DriveTerm, ...] = ()
    tried: int = 1  # Number of such terms among which the residual selected it
    coupled: str = ""  # The other joint of a coupling; empty if none
    ratio: float = 0.0  # Ratio of the other joint; that of the joint itself is 1
    #: Whether stiction at reversals looks like it behind a filter: it is a note at most
    is_imitated: bool = False


def _rms(m: JointMotion, of: Callable[[JointMotion], Array]) -> float:
    """Return the RMS value of a signal of the motion that sets the scale; 1 if it is 0."""
    return float(np.sqrt(np.mean(of(m.scale or m) ** 2))) or 1.0


def _of_terms(m: JointMotion, family: Family) -> Array:
    """Return the columns of a family's terms, shape (N, c)."""
    motion = DriveMotion(m.q, m.v, m.a, m.direction, m.load, np.zeros_like(m.v))
    terms = family.tested_terms(_rms(m, attrgetter("v")))
    return np.column_stack([term.column(motion) for term in terms])


def _of_family(family: Family) -> Candidate:
    """Return the candidate of a family of drive terms."""
    units = family.tested_terms(1.0)[0].units if family.has_size else None
    return Candidate(
        family.name, family.code, partial(_of_terms, family=family), family.meaning, family.advice,
        units=units, revolute_only=family.needs > 0, families=(family.name, *family.instead),
        is_imitated=family.is_imitated,
    )  # fmt: skip


def _ripple(m: JointMotion, count: int) -> Array:
    """Return cosine and sine of a multiple of the position, after the filter of torques."""
    waves = np.array([np.cos(count * m.q), np.sin(count * m.q)])
    columns: Array = (_passed(m, np.array([count])) * waves).T
    return columns


def _passed(m: JointMotion, counts: Array) -> Array:
    """Return the filter's gain for torques with k periods per revolution, shape (k, N)."""
    rate = np.abs(m.v) / (2 * np.pi * m.passes)  # revolutions per second over the cut-off
    passed: Array = 1.0 / (1.0 + np.outer(counts.astype(float) ** _STEEP, rate**_STEEP))
    return passed


def ripples(m: JointMotion, weight: Array, r: Array) -> tuple[Candidate, ...]:
    """Return candidates of a torque periodic in the position, from the residual's spectrum."""
    first = np.exp(1j * m.q)
    wave = first ** _RIPPLES[0]  # e^(i count q)
    explained = np.zeros(len(_RIPPLES))
    for k, size in enumerate(weight * _passed(m, _RIPPLES)):
        if power := size @ size:
            explained[k] = np.abs((r * size) @ wave) ** 2 / power
        wave *= first
    counts = _RIPPLES[np.sort(np.argsort(-explained)[:_PEAKS])]
    return tuple(
        Candidate(
            f"ripple {count}", "position_periodic", partial(_ripple, count=count),
            f"a torque with {count} periods per revolution (gear teeth, motor poles, harmonic "
            "drive)",
            revolute_only=True,
            terms=(Harmonic(order=float(count)), Harmonic(order=float(count), is_sine=True)),
            tried=len(_RIPPLES),
        )
        for count in counts.tolist()
    )  # fmt: skip


def _windup(m: JointMotion) -> Array:
    displacement = m.travelled[:, None] / (np.array(_WINDUP) * _rms(m, attrgetter("travelled")))
    deflection = m.direction[:, None] * np.exp(-displacement)
    return np.column_stack([deflection, np.tanh(m.load / (_LOADED * _rms(m, attrgetter("load"))))])


def _drift(m: JointMotion) -> Array:
    drifting: Array = m.time[:, None] * np.column_stack([m.direction, m.v, np.ones_like(m.v)])
    return drifting


def _coupled(m: JointMotion, other: str, ratio: float) -> Array:
    """Return columns of a drive at the speed w = v + ratio v' of both joints, at the first."""

    def drive_speed(motion: JointMotion) -> Array:
        return motion.v + ratio * motion.others[other].v

    if other not in m.others:  # it is at rest
        none = np.zeros_like(m.v)
        return np.column_stack([none, none, np.tanh(m.v / (_REVERSES * _rms(m, drive_speed)))])
    partner, w = m.others[other], drive_speed(m)
    return np.column_stack([partner.a, partner.v, np.tanh(w / (_REVERSES * _rms(m, drive_speed)))])


#: The candidates of each joint, without couplings: Coulomb friction where the model lacks it, the
#: families of drive terms, and effects that no term models.
CANDIDATES = (
    Candidate(
        "coulomb", "friction_shape", lambda m: m.direction[:, None], "Coulomb friction",
        "Set friction = 'viscous+coulomb' in [model]",
    ),
    *(_of_family(family) for family in FAMILIES.values() if family.code),
    Candidate(
        "windup", "backlash", _windup,
        "a torque that changes after each reversal, or with the loaded side of the gear "
        "(backlash, windup)",
        "Increase min_velocity to exclude the reversals",
    ),
    Candidate(
        "drift", "drift", _drift,
        "friction or an offset that drifts with time (warm-up of the drive)",
        "Warm the robot up before recording, or cut the log with start",
    ),
)  # fmt: skip


def couplings(motion: JointMotion) -> tuple[Candidate, ...]:
    """Return candidates of a drive coupled to a joint and to the joint before or after it."""
    return tuple(
        Candidate(
            f"coupling {ratio:+g} {name}", "coupling",
            partial(_coupled, other=name, ratio=ratio),
            f"a drive that is coupled to {name}",
            coupled=name,
            ratio=ratio,
        )
        for name in motion.others
        for ratio in (1.0, -1.0)
    )  # fmt: skip
