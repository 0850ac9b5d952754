"""The common form of all file formats: named columns, read as a whole or row by row."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from robotid.base.exceptions import DataError, RobotIdError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.signal_settings import LogSource


@dataclass(frozen=True)
class Place:
    """The start of a row in a file."""

    row: int = 0  # its number
    line: int = 0  # number of its line in a text file
    offset: int = 0  # bytes before it in a text file


class RowReader(ABC):
    """Reads rows of a file that need not fit into memory."""

    @abstractmethod
    def count(self) -> int:
        """Return the approximate number of rows, without reading them."""

    @abstractmethod
    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        """Yield one column, a block of rows at a time."""

    @abstractmethod
    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        """Return the columns of some rows by name, each (stop - first,); a missing value is NaN."""


@dataclass(frozen=True)
class Table:
    """The columns of one file."""

    names: list[str]  # in the order of the file
    read: Callable[[Sequence[str]], dict[str, Array]]  # returns columns by name, (N,); NaN: missing
    notes: tuple[str, ...] = ()  # for the user
    rows: RowReader | None = None  # reads row by row; None if the format is read as a whole
    renamed: Mapping[str, str] = field(default_factory=dict)  # names above by name in the file
    angle_unit: str = ""  # why the unit of angles must be stated; "" if it is known
    sensors: Mapping[str, str] = field(default_factory=dict)  # sources of interpolated columns
    axes: Mapping[str, str] = field(default_factory=dict)  # of "twist" and "wrench", if known

    def reader(self, wanted: Sequence[str]) -> RowReader:
        """Return the reader of the rows; of a format that is read as a whole, of wanted columns."""
        return self.rows or _WholeTable(self, wanted)


@dataclass(frozen=True, eq=False)
class _WholeTable(RowReader):
    """Rows of a file of a format that cannot be read in parts."""

    table: Table
    wanted: Sequence[str]

    def count(self) -> int:
        return len(next(iter(self._columns.values())))

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        yield self._columns[name], Place()

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        return {name: self._columns[name][first:stop] for name in wanted}

    @cached_property
    def _columns(self) -> dict[str, Array]:
        return self.table.read(self.wanted)


class Format(ABC):
    """Reader of one file format."""

    @abstractmethod
    def open(self, path: Path, source: LogSource) -> Table:
        """Return the table in a file; faults of a column are reported when it is read."""


class WritableFormat(Format):
    """A format that is also written."""

    @abstractmethod
    def write(self, table: Mapping[str, Array], path: Path) -> None:
        """Write columns to a file: table (N,)."""


def choose(where: str, found: Sequence[str], noun: str, listing: str) -> str:
    """Return the only one of the possible places of a log in a file."""
    if len(found) == 1:
        return found[0]
    names = sorted(found)
    raise DataError(
        f"{where} has {len(names)} {noun}: {listed(names)}; {listing}. State one: topic = "
        f'"{names[0]}" (job file table [log], CLI --topic, Python source=LogSource(topic=...))'
    )


@contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Convert the exceptions of a parser to a DataError."""
    try:
        yield
    except RobotIdError:
        raise
    except Exception as error:  # a parser of foreign bytes fails in many ways
        reason = f"{type(error).__name__}: {error}"[:200]
        raise DataError(f"{path.name}: broken {kind} file ({reason}); export it again") from error
