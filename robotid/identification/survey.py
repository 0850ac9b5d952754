"""Logs larger than memory: surveyed once, then read and reduced in pieces.

The survey reads the time stamps of all rows and a few windows of the rest, and decides everything
automatic for the whole log. A piece is a fixed stretch of rows, read with rows around it.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.identification.evaluation import row_mask
from robotid.identification.recordings import base_problem
from robotid.logs.data import Log, Trajectory
from robotid.logs.formats import open_table
from robotid.logs.read import LogLayout
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import decide, unwrap, velocity_lag
from robotid.logs.smoothing import SPLINE, Stretch, filter_reach, process_stretches
from robotid.logs.table import Place, RowReader, Table
from robotid.logs.time_stamps import TimeStamps
from robotid.logs.units import check_reach, check_units
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.columns import friction_speeds
from robotid.regressor.reduction import Reduction
from robotid.regressor.rows import COMPILED, choose_engine
from robotid.robot.model import RobotModel
from robotid.workers.pieces import Piece

__all__ = ["PIECE", "LogPiece", "LongLog", "survey"]

#: Rows of a piece, if nothing else is said.
PIECE = 16384
_WINDOW = 20_000  # rows of each window that is looked at closely


@dataclass(frozen=True, eq=False)
class _Header:
    """What the pieces of a log have in common."""

    layout: LogLayout
    model: RobotModel
    mapping: BaseMapping
    signals: SignalSettings
    samples: int

    def read(self, first: int, stop: int, near: Place) -> Log:
        """Return rows of the file as a log in SI units, full turns left in."""
        layout = self.layout
        rows = _rows(open_table(Path(layout.path), layout.source), layout)
        log = layout.to_log(rows.read(layout.wanted, first, stop, near), first)
        check_reach(log, layout.units, layout.prismatic)
        return log

    @property
    def is_compiled(self) -> bool:
        """Whether the compiled path computes the rows: chosen for the log, not for each piece."""
        return choose_engine(self.model, self.samples, None) == COMPILED

    def unwrap(self, log: Log) -> Log:
        """Return the log without full turns."""
        return unwrap(log, np.array([joint.turns_freely for joint in self.model.limits]))


@dataclass(frozen=True, eq=False)
class LogPiece(Piece):
    """A stretch of rows of a log, with what is needed to read it and to smooth it as the whole.

    Attributes:
        header: What the pieces of the log have in common.
        first: Its first row.
        stop: The row after its last one.
        span: First row that is read with it, and the row after the last one.
        near: Where in the file the span starts, or a little before.
        stretches: The uninterrupted stretches that it has rows of.
    """

    header: _Header
    first: int
    stop: int
    span: tuple[int, int]
    near: Place
    stretches: tuple[Stretch, ...]

    @property
    def name(self) -> str:
        """What messages call it, as ``run3.parquet rows 0-16384``."""
        return f"{Path(self.header.layout.path).name} rows {self.first}-{self.stop}"

    @property
    def samples(self) -> int:
        """Number of its rows."""
        return self.stop - self.first

    def read(self) -> tuple[Array, Trajectory, Array]:
        """Return its raw rows, its smooth motion, and which joints' full turns were taken out.

        Returns:
            Positions and torques of its rows, shape (samples, 2 n); the trajectory, of no samples
            if none is left; and flags, shape (n,), bool.

        Raises:
            DataError: If a row cannot be used.
        """
        raw = self.header.read(*self.span, self.near)
        log = self.header.unwrap(raw)
        trajectory = process_stretches(
            log,
            self.stretches,
            self.header.signals,
            first=self.span[0],
            own=slice(self.first, self.stop),
            speeds=friction_speeds(self.header.model.layout),
        )
        rows = slice(self.first - self.span[0], self.stop - self.span[0])
        own = np.hstack([raw.q[rows], raw.tau[rows]])
        return own, trajectory, (log.q != raw.q).any(axis=0)

    def mask(self, trajectory: Trajectory) -> Array:
        """Return which rows of its motion are used.

        Args:
            trajectory: Its motion, N samples.

        Returns:
            Flags, shape (N, n_rows), bool.
        """
        return row_mask(self.header.model, trajectory, self.header.signals.min_velocity)

    def reduce(self, *, threads: int | None = None) -> Reduction:
        """Read the piece and reduce it; see ``Piece.reduce``.

        Args:
            threads: As of ``compress``.

        Returns:
            The reduction.

        Raises:
            DataError: If a row cannot be used.
        """
        _, trajectory, _ = self.read()
        header = self.header
        problem = base_problem(
            header.model,
            header.mapping,
            trajectory,
            self.mask(trajectory),
            compiled=header.is_compiled,
        )
        return Reduction.of(problem, trajectory, threads=threads)


@dataclass(frozen=True, eq=False)
class LongLog:
    """A log that is not held in memory, after its survey.

    Attributes:
        header: What its pieces have in common.
        first: Its first row in the file, of the window.
        stop: The row after its last one.
        start: Time stamp of its first row [s].
        end: Time stamp of its last row [s].
        step: Median time step [s].
        stretches: Its uninterrupted stretches.
        pieces: Its pieces, in order.
        windows: Stretches of rows that were looked at closely: the first, middle and last ones.
    """

    header: _Header
    first: int
    stop: int
    start: float
    end: float
    step: float
    stretches: tuple[Stretch, ...]
    pieces: tuple[LogPiece, ...]
    windows: tuple[Log, ...]

    @property
    def path(self) -> str:
        """The file."""
        return self.header.layout.path

    @property
    def head(self) -> Log:
        """The first rows, with the notes on the log."""
        log = self.windows[0]
        if len(self.windows) == 1:
            return log
        looks = ", ".join(f"{first}-{stop}" for first, stop in _close_looks(self.first, self.stop))
        note = f"too long to be in memory at once; the doctor looked at rows {looks} only"
        return replace(log, notes=(*log.notes, note))

    @property
    def looks(self) -> tuple[Log, ...]:
        """The windows as logs of their own, named by their rows if they are not all rows."""
        if len(self.windows) == 1:
            return self.windows
        ranges = _close_looks(self.first, self.stop)
        return tuple(
            replace(log, path=f"{log.path} rows {first}-{stop}", notes=())
            for log, (first, stop) in zip(self.windows, ranges, strict=True)
        )


def survey(
    layout: LogLayout,
    table: Table,
    model: RobotModel,
    mapping: BaseMapping,
    signals: SignalSettings,
    *,
    start: float | None = None,
    end: float | None = None,
    length: int = PIECE,
) -> LongLog:
    """Return a log ready to be read in pieces.

    Every time stamp is checked. Units, and how late the measured velocity is, are judged in the
    windows; what each piece reads is checked as it is read.

    Args:
        layout: Which columns of the file make up the log.
        table: The file, opened.
        model: The robot.
        mapping: Standard to base parameters.
        signals: How the log becomes a trajectory.
        start: First time stamp kept, on the log's own clock [s].
        end: Last time stamp kept [s].
        length: Rows per piece; a file that is only read whole is one piece.

    Returns:
        The log.

    Raises:
        DataError: If time does not increase, the window holds fewer than two rows, or units are
            suspect.
        SettingsError: If a setting does not fit the log.
    """
    rows = _rows(table, layout)
    places: list[Place] = []
    with TimeStamps(_stamps(rows, layout, places), Path(layout.path).name) as stamps:
        first, stop = _window(stamps, layout, start, end)
        step = stamps.median_step(first, stop)
        header = _Header(layout, model, mapping, signals, stop - first)
        windows = tuple(header.read(i, j, _near(places, i)) for i, j in _close_looks(first, stop))
        for window in windows:
            check_units(window, layout.units, layout.prismatic)
        resolved = decide(
            signals,
            step,
            layout.path,
            has_velocity="dq" in layout.columns,
            has_acceleration="ddq" in layout.columns,
            lag=lambda: float(np.median([velocity_lag(header.unwrap(w)) for w in windows])),
        )
        header = replace(header, signals=resolved)
        stretches = _stretches(stamps, first, stop, resolved)
        if table.rows is None:
            length = max(stop - first, 1)
        pieces = tuple(_cut(header, stamps, (first, stop), stretches, places, length))
        ends = stamps.at(first), stamps.at(stop - 1)
    return LongLog(header, first, stop, *ends, step, stretches, pieces, windows)


@dataclass(frozen=True, eq=False)
class _WholeTable(RowReader):
    """Rows of a file that is only read whole."""

    table: Table
    wanted: Sequence[str]

    def count(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self._columns.values())))

    def scan(self, name: str) -> Iterator[tuple[Array, Place]]:
        """Yield one column; see ``RowReader.scan``."""
        yield self._columns[name], Place()

    def read(self, wanted: Sequence[str], first: int, stop: int, near: Place) -> dict[str, Array]:
        """Return some rows; see ``RowReader.read``."""
        return {name: self._columns[name][first:stop] for name in wanted}

    @cached_property
    def _columns(self) -> dict[str, Array]:
        return self.table.read(self.wanted)


def _rows(table: Table, layout: LogLayout) -> RowReader:
    return _WholeTable(table, layout.wanted) if table.rows is None else table.rows


def _stamps(rows: RowReader, layout: LogLayout, places: list[Place]) -> Iterator[Array]:
    """Yield the time stamps in seconds, and note where the rows of each block are."""
    for values, place in rows.scan(layout.columns["time"][0]):
        places.append(place)
        yield layout.stamps(values)


def _near(places: Sequence[Place], row: int) -> Place:
    return places[max(bisect_right(places, row, key=lambda place: place.row) - 1, 0)]


def _window(
    stamps: TimeStamps, layout: LogLayout, start: float | None, end: float | None
) -> tuple[int, int]:
    """Return the rows from start to end; see ``Log.window``."""
    where = Path(layout.path).name
    if len(stamps) < 2:
        raise DataError(f"{where} has {len(stamps)} rows, wanted at least 2")
    first = 0 if start is None else stamps.search(start)
    stop = len(stamps) if end is None else stamps.search(float(np.nextafter(end, np.inf)))
    if stop - first < 2:
        low, high = stamps.at(0), stamps.at(len(stamps) - 1)
        raise DataError(
            f"{where}: {max(stop - first, 0)} rows lie between "
            f"{low if start is None else start:g} s and {high if end is None else end:g} s; "
            f"the log spans {low:g} s to {high:g} s. Choose start and end inside it"
        )
    return first, stop


def _close_looks(first: int, stop: int) -> list[tuple[int, int]]:
    """Return the first, middle and last rows; all, if they are few."""
    if stop - first <= 3 * _WINDOW:
        return [(first, stop)]
    middle = (first + stop - _WINDOW) // 2
    return [(row, row + _WINDOW) for row in (first, middle, stop - _WINDOW)]


def _stretches(
    stamps: TimeStamps, first: int, stop: int, signals: SignalSettings
) -> tuple[Stretch, ...]:
    """Return the stretches between gaps."""
    edges = [first]
    for row, t in stamps.blocks(first, stop):
        breaks = np.flatnonzero(np.diff(t) > (signals.max_gap or np.inf)) + 1
        edges += (row + breaks).tolist()
    return tuple(
        Stretch(i, j, stamps.at(i), stamps.at(j - 1), number)
        for number, (i, j) in enumerate(pairwise([*edges, stop]))
    )


def _cut(
    header: _Header,
    stamps: TimeStamps,
    window: tuple[int, int],
    stretches: Sequence[Stretch],
    places: Sequence[Place],
    length: int,
) -> Iterator[LogPiece]:
    """Yield pieces of so many rows each, and which rows are to be read with each."""
    reach = filter_reach(header.signals)
    begins = [stretch.first for stretch in stretches]
    for first in range(*window, length):
        stop = min(first + length, window[1])
        mine = stretches[bisect_right(begins, first) - 1 : bisect_right(begins, stop - 1)]
        before = stamps.search(stamps.at(first) - reach) - SPLINE
        after = stamps.search(stamps.at(stop - 1) + reach) + SPLINE
        span = max(before, mine[0].first), min(after, mine[-1].stop)
        if span[1] - span[0] < 2:  # a lonely row, with another one: a log has two
            low = max(span[0] - 1, window[0])
            span = low, low + 2
        yield LogPiece(header, first, stop, span, _near(places, span[0]), tuple(mine))
