"""The terms of a drive's torque: one entry each, and the rest of the package loops over them.

A term adds ``parameter * column`` to the torque of a drive. To add one, enter it in ``TERMS``: its
regressor, prior spread, plant, sidecar, tables and job key follow.
"""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from robotid._typing import Array

__all__ = ["DRIVE_TERMS", "TERMS", "DriveMotion", "DriveTerm", "friction_models"]


@dataclass(frozen=True, slots=True)
class DriveMotion:
    """How drives move; all arrays of one shape.

    Attributes:
        v: Speeds w [rad/s or m/s].
        a: Their changes dw/dt [rad/s^2 or m/s^2].
        direction: Which way friction acts: the signs of w, or what stands for them [-].
    """

    v: Array
    a: Array
    direction: Array


@dataclass(frozen=True)
class DriveTerm:
    """One term of a drive's torque, linear in its parameter.

    Attributes:
        name: Its name in parameters, as ``"elbow.viscous"``.
        column: What the parameter multiplies, element by element; module-level, to be pickled.
        units: Unit of the parameter for a drive that turns, and for one that slides.
        is_nonnegative: Whether the parameter cannot be negative by physics.
        is_shared: Whether a drive that turns with several joints has it too.
        is_inertia: Whether it multiplies the acceleration and so adds to the mass matrix.
        is_friction: Whether a job's ``friction`` chooses it; if not, it has a switch of its own.
        follows_direction: Whether its column holds the direction of friction.
        is_default: Whether it is identified unless told otherwise.
        preference: How much it is favoured as the name of a base parameter [-].
        usual: From where to where it usually lies, for simulated robots.
        dynamics: Attribute of the URDF's ``<dynamics>`` that states it, or None.
    """

    name: str
    column: Callable[[DriveMotion], Array]
    units: tuple[str, str]
    is_nonnegative: bool = True
    is_shared: bool = True
    is_inertia: bool = False
    is_friction: bool = False
    follows_direction: bool = False
    is_default: bool = True
    preference: float = 1.0
    usual: tuple[float, float] = (-0.3, 0.3)
    dynamics: str | None = None


def _ones(motion: DriveMotion) -> Array:
    return np.ones_like(motion.v)


#: All terms by name, in the order of the parameters.
TERMS: dict[str, DriveTerm] = {
    term.name: term
    for term in (
        DriveTerm(
            "armature", attrgetter("a"), ("kg m^2", "kg"), is_inertia=True, preference=0.3,
            usual=(0.1, 0.5),
        ),
        DriveTerm(
            "viscous", attrgetter("v"), ("N m s/rad", "N s/m"), is_friction=True,
            usual=(0.5, 4.0), dynamics="damping",
        ),
        DriveTerm(
            "coulomb", attrgetter("direction"), ("N m", "N"), is_friction=True,
            follows_direction=True, usual=(0.5, 5.0), dynamics="friction",
        ),
        DriveTerm("offset", _ones, ("N m", "N"), is_nonnegative=False, is_shared=False),
    )
}  # fmt: skip
#: Names of the terms that are identified unless told otherwise.
DRIVE_TERMS = tuple(name for name, term in TERMS.items() if term.is_default)


def friction_models() -> dict[str, tuple[str, ...]]:
    """Return the terms by choice of a job's ``friction``: none, viscous, viscous+coulomb."""
    names = [name for name, term in TERMS.items() if term.is_friction]
    choices = [tuple(names[:count]) for count in range(len(names) + 1)]
    return {"+".join(terms) or "none": terms for terms in choices}
