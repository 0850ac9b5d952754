"""The constraints of a consistent fit as a job states them, and as the estimator takes them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.estimators.consistent.constraints import Constraints
from robotid.exceptions import SettingsError

__all__ = ["ConstraintSettings"]

_SHAPES = ("none", "box", "hull")


@dataclass(frozen=True)
class ConstraintSettings:
    """Bounds beside physical consistency, by name of the link that a joint moves.

    Attributes:
        mass: Mass, or smallest and largest mass, of a link with all that is fixed to it [kg].
        total_mass: Mass, or bounds of it, of all links that move [kg].
        com: Corners [[x, y, z], [x, y, z]] of a box in the link's frame that holds the centre of
            mass [m].
        com_within: Where the other centres of mass are kept: "box" or "hull" of the link's own
            geometry in the URDF, where it has one and its meshes are found; or "none".
        pinned: Links that keep the URDF's values.
    """

    mass: Mapping[str, Any] = field(default_factory=dict)
    total_mass: float | Sequence[float] | None = None
    com: Mapping[str, Any] = field(default_factory=dict)
    com_within: str = "none"
    pinned: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, value in self.mass.items():
            _interval(value, f"mass of {name}")
        if self.total_mass is not None:
            _interval(self.total_mass, "total_mass")
        for name, value in self.com.items():
            _corners(value, name)
        if self.com_within not in _SHAPES:
            raise SettingsError(f"com_within is {self.com_within!r}, wanted one of {list(_SHAPES)}")

    def to_constraints(self, geometry: Mapping[str, tuple[Array, Array]]) -> Constraints:
        """Return the constraints as the estimator takes them.

        Args:
            geometry: Half-spaces A c <= b of the centres of mass from the URDF's geometry, by
                name of the body; boxes stated in ``com`` go before them.

        Returns:
            The constraints.
        """
        com = dict(geometry)
        for name, value in self.com.items():
            low, high = _corners(value, name)
            com[name] = (np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))
        total = self.total_mass
        return Constraints(
            mass={name: _interval(value, name) for name, value in self.mass.items()},
            total_mass=None if total is None else _interval(total, "total_mass"),
            com=com,
            pinned=tuple(self.pinned),
        )


def _interval(value: object, what: str) -> tuple[float, float]:
    """Return the bounds that a number, or a pair of them, states."""
    pair = [value, value] if _is_number(value) else value
    if not (isinstance(pair, Sequence) and len(pair) == 2 and all(map(_is_number, pair))):
        raise SettingsError(f"{what} is {value!r}, wanted a number or [smallest, largest] [kg]")
    low, high = float(pair[0]), float(pair[1])
    if not (np.isfinite(low) and np.isfinite(high)):
        raise SettingsError(
            f"{what} is [{low:g}, {high:g}] kg, wanted finite numbers; write a large one for no "
            "upper bound"
        )
    if not low <= high:
        raise SettingsError(
            f"{what} is [{low:g}, {high:g}] kg: the first is above the second; write the smaller "
            "one first"
        )
    return low, high


def _corners(value: object, name: str) -> Array:
    """Return the two corners of a box, shape (2, 3)."""
    try:
        corners = np.array(value, dtype=float)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.shape != (2, 3) or not np.isfinite(corners).all():
        raise SettingsError(f"com of {name} is {value!r}, wanted [[x, y, z], [x, y, z]] [m]")
    if (corners[0] > corners[1]).any():
        raise SettingsError(
            f"com of {name} is {value!r}: the first corner is above the second; write the smaller "
            "coordinates first"
        )
    return corners


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
