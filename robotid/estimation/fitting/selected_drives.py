"""The friction and other terms selected for the drive of a joint, and their shape parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.robot.drives import FAMILIES, DriveTerm, Family

_FARTHEST = 1.33  # largest factor by which a shape parameter changes in one step


@dataclass(frozen=True)
class Tried:
    """A set of drive terms that was tried for a joint.

    Attributes:
        families: Names of the families in addition to viscous and Coulomb friction.
        held_out_error_pct: Residual of the held-out segments, relative to the torque [%].
        p_value: p-value of the reduction of the held-out residual [-]; 1 without a reduction.
        is_selected: Whether it was selected.
    """

    families: tuple[str, ...]
    held_out_error_pct: float
    p_value: float
    is_selected: bool


@dataclass(frozen=True)
class FoundShape:
    """An identified shape parameter of a friction term.

    Attributes:
        name: Its name, as ``stribeck.speed``.
        value: Its value [unit].
        std_error: Its standard error [unit].
        unit: Its unit.
        is_at_bound: Whether it is at a bound of the search range.
    """

    name: str
    value: float
    std_error: float
    unit: str
    is_at_bound: bool


@dataclass(frozen=True)
class DriveChoice:
    """The terms selected for one joint's drive.

    Attributes:
        joint: The joint.
        families: Names of the families in addition to viscous and Coulomb friction.
        terms: The terms.
        tried: The sets of terms that were tried, step by step.
        shapes: The identified shape parameters.
        shape_covariance: Their covariance, row by row.
        sizes: Values of the shape parameters of each family.
        data_range: Ranges of position "q" and of absolute speed "v" in the fitted rows.
        grown: Factor by which the terms increase the standard errors of the drive's armature,
            viscous and Coulomb friction and offset, by name.
        undecided: Terms that reduce the held-out residual, but not significantly. They were not
            selected; the standard errors include the change that they would cause.
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
    undecided: tuple[DriveTerm, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the sets tried, the selected families and the shapes, as plain values."""
        return {
            "families": list(self.families),
            "shapes": [asdict(shape) for shape in self.shapes],
            "data_range": {key: list(pair) for key, pair in self.data_range.items()},
            "tried": [{**asdict(step), "families": list(step.families)} for step in self.tried],
        }

    def moved(self, step: Array, covariance: Array) -> "DriveChoice":
        """Return the choice with shapes changed by a step, within their bounds.

        No shape changes by more than a third.

        step (k,), covariance (k, k).
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
        """Return the terms with one of the shapes increased."""
        flat = [(at, k) for at, own in enumerate(self.sizes) for k in range(len(own))]
        sizes = [list(own) for own in self.sizes]
        at, k = flat[which]
        sizes[at][k] *= 1.0 + share
        every = zip(self.families, sizes, strict=True)
        return tuple(
            term for name, own in every for term in FAMILIES[name].make(self.data_range, *own)
        )


def with_shapes(families: Sequence[Family], flat: Array) -> list[tuple[Family, list[float]]]:
    """Return each family with its shapes, from one array of all shapes: flat (k,)."""
    sizes = iter(flat.tolist())
    return [(family, [next(sizes) for _ in family.shapes]) for family in families]
