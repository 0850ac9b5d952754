"""The terms that the drive of a joint was found to have, and their shapes."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.robot.drives import FAMILIES, DriveTerm, Family

__all__ = ["DriveChoice", "FoundShape", "Tried", "with_shapes"]

_FARTHEST = 1.33  # times that a shape grows or shrinks at once


@dataclass(frozen=True)
class Tried:
    """Terms of a joint that were tried.

    Attributes:
        families: Names of what was tried beside viscous and Coulomb friction.
        held_out_error_pct: Residual of held-out segments over the torque [%].
        p_value: How likely held-out segments gain that much by chance [-]; 1 without a gain.
        is_selected: Whether it was taken.
    """

    families: tuple[str, ...]
    held_out_error_pct: float
    p_value: float
    is_selected: bool


@dataclass(frozen=True)
class FoundShape:
    """A shape that was found.

    Attributes:
        name: Which one, as ``stribeck.speed``.
        value: Its value.
        std_error: Its standard error.
        unit: Its unit.
        is_at_bound: Whether it is at the end of the range that it was sought in.
    """

    name: str
    value: float
    std_error: float
    unit: str
    is_at_bound: bool


@dataclass(frozen=True)
class DriveChoice:
    """The terms of one joint's drive.

    Attributes:
        joint: The joint.
        families: Names of what it has beside viscous and Coulomb friction.
        terms: The terms themselves.
        tried: What was tried, step by step.
        shapes: The shapes that were found.
        shape_covariance: Their covariance, row by row.
        sizes: Shapes of each family.
        data_range: Ranges of position "q" and of the size of speed "v" that the fit has seen.
        grown: How many times larger the terms make the standard errors of the drive's armature,
            viscous and Coulomb friction and offset, by name.
        doubted: Terms that held-out segments favour, but not beyond chance: they were not taken,
            and errors count what they would move.
    """

    joint: str
    families: tuple[str, ...]
    terms: tuple[DriveTerm, ...]
    tried: tuple[Tried, ...] = ()
    shapes: tuple[FoundShape, ...] = ()
    shape_covariance: tuple[tuple[float, ...], ...] = ()
    sizes: tuple[tuple[float, ...], ...] = ()
    data_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    grown: Mapping[str, float] = field(default_factory=dict)
    doubted: tuple[DriveTerm, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return what was tried, taken and found, as plain values."""
        return {
            "families": list(self.families),
            "shapes": [asdict(shape) for shape in self.shapes],
            "data_range": {key: list(pair) for key, pair in self.data_range.items()},
            "tried": [{**asdict(step), "families": list(step.families)} for step in self.tried],
        }

    def moved(self, step: Array, covariance: Array) -> "DriveChoice":
        """Return the choice with shapes moved, within their bounds and by a third at most.

        Args:
            step: By how much, shape (k,).
            covariance: Of the shapes there, shape (k, k).
        """
        flat = np.array([size for own in self.sizes for size in own])
        families = [FAMILIES[name] for name in self.families]
        bounds = np.array([s.within(self.data_range) for family in families for s in family.shapes])
        near = np.clip(flat + step, flat / _FARTHEST, flat * _FARTHEST)
        sizes = np.clip(near, *bounds.T)
        chosen = with_shapes(families, sizes)
        shapes = zip(self.shapes, sizes, np.sqrt(np.diag(covariance)), strict=True)
        return replace(
            self,
            terms=tuple(t for family, own in chosen for t in family.make(self.data_range, *own)),
            shapes=tuple(
                replace(shape, value=float(size), std_error=float(error))
                for shape, size, error in shapes
            ),
            shape_covariance=tuple(tuple(row) for row in covariance.tolist()),
            sizes=tuple(tuple(own) for _, own in chosen),
        )

    def altered(self, which: int, share: float) -> tuple[DriveTerm, ...]:
        """Return the terms with one of the shapes larger by a share.

        Args:
            which: Which of ``shapes``.
            share: The share [-].
        """
        flat = [(at, k) for at, own in enumerate(self.sizes) for k in range(len(own))]
        sizes = [list(own) for own in self.sizes]
        at, k = flat[which]
        sizes[at][k] *= 1.0 + share
        every = zip(self.families, sizes, strict=True)
        return tuple(
            term for name, own in every for term in FAMILIES[name].make(self.data_range, *own)
        )


def with_shapes(families: Sequence[Family], flat: Array) -> list[tuple[Family, list[float]]]:
    """Return families with their shapes, of all in a row.

    Args:
        families: The families.
        flat: Shapes of one after the other, shape (k,).
    """
    sizes = iter(flat.tolist())
    return [(family, [next(sizes) for _ in family.shapes]) for family in families]
