"""Terms of a drive's torque that the model may lack: columns to test what a fit leaves against."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import numpy as np

from robotid._typing import Array
from robotid.fitting.joint_motion import JointMotion
from robotid.robot.drives import FAMILIES, DriveMotion, DriveTerm, Family, Harmonic

__all__ = ["CANDIDATES", "Candidate", "couplings", "ripples"]

_RIPPLES = np.arange(5, 241)  # times a turn that it may repeat beyond: 200 of a gear of 100 : 1
_PEAKS = 6  # of them are tried, those at which the residual is most periodic
_STEEP = 8  # twice the order of the filter, which runs both ways
_TURNS_OVER = 0.05  # of the typical speed, over which the sign of a coupling's speed turns
_WINDUP = (0.02, 0.1)  # of the typical way between two reversals, on which a torque is taken up
_TURNED = 0.05  # of the typical rigid torque, over which the side of a gear changes


@dataclass(frozen=True)
class Candidate:
    """A term that a drive's torque may have, linear in its parameters.

    Attributes:
        name: Its name.
        code: Code of the finding that says it is missing.
        columns: What its c parameters multiply in N rows, shape (N, c). Scales in it are those of
            the motion given, unless that names another.
        meaning: What it is, in words of a finding.
        advice: What the user can do beside adding it to the model; empty if nothing.
        families: Friction of a job that has it, see ``FAMILIES``; advised is the first for which
            the joint turned far enough.
        terms: Terms of a job's [drives] that are it, if no family is.
        units: Unit of the parameter of a revolute joint, and of one that slides; None: the size
            is the torque of the term, root mean square.
        turns: Whether only a revolute joint has it.
        coupled: The other joint of a coupling; empty for none.
        ratio: Its ratio beside 1 of the joint's own.
        tried: How many such terms it was selected from by the residual.
        is_imitated: Whether a drive that sticks at its reversals looks like it behind a filter: it
            is no more than a note then.
    """

    name: str
    code: str
    columns: Callable[[JointMotion], Array]
    meaning: str
    advice: str = ""
    units: tuple[str, str] | None = None
    turns: bool = False
    families: tuple[str, ...] = ()
    terms: tuple[DriveTerm, ...] = ()
    tried: int = 1
    coupled: str = ""
    ratio: float = 0.0
    is_imitated: bool = False


def _usual(m: JointMotion, of: Callable[[JointMotion], Array]) -> float:
    """Return the root mean square of a signal of the motion that scales, 1 if it is 0 there."""
    return float(np.sqrt(np.mean(of(m.scale or m) ** 2))) or 1.0


def _of_terms(m: JointMotion, family: Family) -> Array:
    """Return the columns of a family's terms, shape (N, c)."""
    motion = DriveMotion(m.q, m.v, m.a, m.direction, m.load, np.zeros_like(m.v))
    terms = family.tested_terms(_usual(m, attrgetter("v")))
    return np.column_stack([term.column(motion) for term in terms])


def _of_family(family: Family) -> Candidate:
    """Return the candidate of a family that what a fit leaves is tested for."""
    units = family.tested_terms(1.0)[0].units if family.has_size else None
    return Candidate(
        family.name, family.code, partial(_of_terms, family=family), family.meaning, family.advice,
        units=units, turns=family.needs > 0, families=(family.name, *family.instead),
        is_imitated=family.is_imitated,
    )  # fmt: skip


def _ripple(m: JointMotion, count: int) -> Array:
    """Return cosine and sine of many times the position, as the filter of torques passes them."""
    waves = np.array([np.cos(count * m.q), np.sin(count * m.q)])
    columns: Array = (_passed(m, np.array([count])) * waves).T
    return columns


def _passed(m: JointMotion, counts: Array) -> Array:
    """Return what the filter leaves of torques that repeat so often a turn, shape (k, N)."""
    turns = np.abs(m.v) / (2 * np.pi * m.passes)  # a second, over the filter's cut-off
    passed: Array = 1.0 / (1.0 + np.outer(counts.astype(float) ** _STEEP, turns**_STEEP))
    return passed


def ripples(m: JointMotion, weight: Array, r: Array) -> tuple[Candidate, ...]:
    """Return candidates of a torque that repeats many times a turn, from the residual's spectrum.

    Args:
        m: The joint's motion, N rows.
        weight: What torques of the rows are multiplied by, 0 where they are not used, shape (N,).
        r: The residual, likewise multiplied, shape (N,).
    """
    turn = np.exp(1j * m.q)
    turned = turn ** _RIPPLES[0]  # e^(i count q)
    explained = np.zeros(len(_RIPPLES))
    for k, size in enumerate(weight * _passed(m, _RIPPLES)):
        if power := size @ size:
            explained[k] = np.abs((r * size) @ turned) ** 2 / power
        turned *= turn
    counts = _RIPPLES[np.sort(np.argsort(-explained)[:_PEAKS])]
    return tuple(
        Candidate(
            f"ripple {count}", "position_periodic", partial(_ripple, count=count),
            f"a torque that repeats {count} times a turn (teeth of a gear, poles of a motor, "
            "a harmonic drive)",
            turns=True,
            terms=(Harmonic(order=float(count)), Harmonic(order=float(count), is_sine=True)),
            tried=len(_RIPPLES),
        )
        for count in counts.tolist()
    )  # fmt: skip


def _windup(m: JointMotion) -> Array:
    way = m.travelled[:, None] / (np.array(_WINDUP) * _usual(m, attrgetter("travelled")))
    deflection = m.direction[:, None] * np.exp(-way)
    return np.column_stack(
        [deflection, np.tanh(m.load / (_TURNED * _usual(m, attrgetter("load"))))]
    )


def _drift(m: JointMotion) -> Array:
    drifting: Array = m.time[:, None] * np.column_stack([m.direction, m.v, np.ones_like(m.v)])
    return drifting


def _coupled(m: JointMotion, other: str, ratio: float) -> Array:
    """Return what a drive that turns with both joints, w = v + ratio v', adds to the first."""

    def turned(motion: JointMotion) -> Array:
        return motion.v + ratio * motion.others[other].v

    if other not in m.others:  # it is at rest
        none = np.zeros_like(m.v)
        return np.column_stack([none, none, np.tanh(m.v / (_TURNS_OVER * _usual(m, turned)))])
    beside, w = m.others[other], turned(m)
    return np.column_stack([beside.a, beside.v, np.tanh(w / (_TURNS_OVER * _usual(m, turned)))])


#: The candidates of each joint, those of couplings aside: Coulomb friction where it is left out,
#: the families of drive terms, and what no term is like.
CANDIDATES = (
    Candidate(
        "coulomb", "friction_shape", lambda m: m.direction[:, None], "Coulomb friction",
        "Set friction = 'viscous+coulomb' in [model]",
    ),
    *(_of_family(family) for family in FAMILIES.values() if family.code),
    Candidate(
        "windup", "backlash", _windup,
        "a torque that changes after each reversal, or with the side of the gear that is loaded "
        "(backlash, windup)",
        "Raise min_velocity to leave the reversals out",
    ),
    Candidate(
        "drift", "drift", _drift,
        "friction or an offset that drifts with time (a drive that warms up)",
        "Warm the robot up before recording, or cut the log with start",
    ),
)  # fmt: skip


def couplings(motion: JointMotion) -> tuple[Candidate, ...]:
    """Return candidates of a drive that turns with a joint and with the one before or after it.

    Args:
        motion: The joint's motion.
    """
    return tuple(
        Candidate(
            f"coupling {ratio:+g} {name}", "coupling",
            partial(_coupled, other=name, ratio=ratio),
            f"a drive that turns with {name}, too",
            coupled=name,
            ratio=ratio,
        )
        for name in motion.others
        for ratio in (1.0, -1.0)
    )  # fmt: skip
