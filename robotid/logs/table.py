"""What each file format gives: named columns, read whole or row by row."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.findings import listed

__all__ = ["Place", "RowReader", "Table", "choose", "prefixes"]

_PREFIXES = {
    "q": ("q_", "position_"),
    "dq": ("dq_", "velocity_", "qd_"),
    "ddq": ("ddq_", "acceleration_", "qdd_"),
    "tau": ("tau_", "effort_", "torque_"),
    "current": ("current_", "i_"),
}


@dataclass(frozen=True)
class Place:
    """Where in a file a row starts.

    Attributes:
        row: Number of the row.
        line: Number of its line, of a text file.
        offset: Bytes before it, of a text file.
    """

    row: int = 0
    line: int = 0
    offset: int = 0


class RowReader(ABC):
    """Reads rows of a file that need not fit into memory."""

    @abstractmethod
    def count(self) -> int:
        """Return about how many rows there are, without reading them."""

    @abstractmethod
    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        """Yield one column, a block of rows at a time.

        Args:
            name: The column.

        Yields:
            Its values, a missing one as NaN, and the place of the first.
        """

    @abstractmethod
    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        """Return some rows.

        Args:
            wanted: Names of the columns.
            first: First row.
            stop: Row after the last one.
            near: A place that ``scan`` told, at or before the first row.

        Returns:
            The columns by name, each of shape (stop - first,); a missing value is NaN.
        """


@dataclass(frozen=True)
class Table:
    """The columns of one file.

    Attributes:
        names: The columns, in the file's order.
        read: Returns some of them by name, each of shape (N,); a missing value is NaN.
        notes: What the reader should know.
        rows: Reads the file row by row; None if its format is only read whole.
    """

    names: list[str]
    read: Callable[[Sequence[str]], dict[str, Array]]
    notes: tuple[str, ...] = ()
    rows: RowReader | None = None


def prefixes(effort: str = "torque") -> dict[str, tuple[str, ...]]:
    """Return how columns start, by quantity: the standard prefix first, then its aliases.

    Args:
        effort: What effort is: "torque" or "current".

    Returns:
        The prefixes of q, dq, ddq, tau and current.
    """
    if effort == "torque":
        return dict(_PREFIXES)
    torque = tuple(prefix for prefix in _PREFIXES["tau"] if prefix != "effort_")
    return _PREFIXES | {"tau": torque, "current": (*_PREFIXES["current"], "effort_")}


def choose(where: str, found: Sequence[str], noun: str, listing: str) -> str:
    """Return the only one of several places, or refuse to guess.

    Args:
        where: Name of the file, for errors.
        found: The places that would do, at least one.
        noun: What they are, as "topics of ...".
        listing: What the file holds, for the error.

    Returns:
        The place.

    Raises:
        DataError: If there are several.
    """
    if len(found) == 1:
        return found[0]
    raise DataError(
        f"{where} holds {len(found)} {noun}: {listed(sorted(found))}; {listing}. State one: topic "
        "= "
        f'"{sorted(found)[0]}" (job file table [log], CLI --topic, Python '
        "source=LogSource(topic=...))"
    )
