"""The alias that every array in the package is annotated with; shapes stand in docstrings."""

from typing import Any, TypeAlias

from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]

__all__ = ["Array"]
