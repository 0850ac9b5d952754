"""Logs of any length: surveyed once, then read in pieces. A log in memory is one piece.

The survey of a file reads the time stamps of all rows and a few windows of all columns, and
resolves automatic settings for the whole log. A piece is a fixed range of rows, read with some rows
before and after it.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.text import seconds
from robotid.base.typing import Array
from robotid.data.base_motion import bias_at_rest
from robotid.data.files.read import LogLayout, open_table
from robotid.data.files.table import Place, RowReader, Table
from robotid.data.log import Log, Trajectory, blocks_of, map_stamps, median_step
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import (
    SPLINE,
    Segment,
    decide,
    filter_reach,
    process_segments,
    too_short,
    unwrap,
)
from robotid.data.units import check_reach, check_units
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.constraint_rows import constrained, logged_base
from robotid.dynamics.factors import Reduction
from robotid.dynamics.prediction import is_loaded, remember
from robotid.dynamics.prepared_logs import (
    base_problem,
    closed_log,
    prefers_measured,
    row_mask,
    static_rows,
    with_contacts,
)
from robotid.dynamics.rows import COMPILED, choose_engine, friction_speeds
from robotid.estimation.work_plan import Workload
from robotid.robot.model import RobotModel

#: Default number of rows of a piece.
PIECE = 16384
_WINDOW = 20_000  # rows of each window that is checked


@dataclass(frozen=True, eq=False)
class _Header:
    """Data common to the pieces of a log; the source is the log itself if it is in memory."""

    model: RobotModel
    source: LogLayout | Log
    signals: SignalSettings
    samples: int

    def read(self, first: int, stop: int, near: Place) -> Log:
        """Return rows as a log in SI units, angles not unwrapped; for a log in memory, all rows."""
        if isinstance(self.source, Log):
            return self.source
        layout = self.source
        reader = open_table(Path(layout.path), layout.source).reader(layout.wanted)
        log = _log_of(layout, reader.read(layout.wanted, first, stop, near), first)
        return with_contacts(self.model, closed_log(self.model, log), self.signals)

    @property
    def is_compiled(self) -> bool | None:
        """Whether compiled code computes the rows of a file: chosen for the log, not by piece."""
        if isinstance(self.source, Log):
            return None  # chosen by the number of samples of its one piece
        return choose_engine(self.model, self.samples, None) == COMPILED


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a piece and their smoothed motion."""

    positions: Array  # (samples, n), as recorded, not unwrapped [rad or m]
    torques: Array  # (samples, n), as recorded [N m or N]
    trajectory: Trajectory  # smoothed motion; it may have no samples
    mask: Array  # (N, n_rows), bool: rows of the motion that are used
    turned: Array  # (n,), bool: joints whose position was unwrapped


@dataclass(frozen=True, eq=False)
class LogPiece:
    """A range of rows of a log, with the data for reading it and smoothing it as the whole log."""

    header: _Header  # data common to the pieces of the log
    first: int  # its first row
    stop: int  # the row after its last one
    span: tuple[int, int]  # first row that is read for it, and the row after the last one
    near: Place  # position in the file at the start of the span, or shortly before
    segments: tuple[Segment, ...]  # the uninterrupted segments that contain its rows
    given: Rows | None = None  # rows that were smoothed before, of a log in memory

    @property
    def name(self) -> str:
        """Name for messages, as ``run3.parquet rows 0-16384``."""
        return f"{Path(self.header.source.path).name} rows {self.first}-{self.stop}"

    @property
    def samples(self) -> int:
        """Number of rows."""
        return self.stop - self.first

    def read(self) -> Rows:
        """Return its rows and its smoothed motion; for a log in memory they are cached."""
        return self._cached if isinstance(self.header.source, Log) else self._read()

    @cached_property
    def _cached(self) -> Rows:
        return self.given or self._read()

    def _read(self) -> Rows:
        header = self.header
        raw = header.read(*self.span, self.near)
        log = _unwrap(header.model, raw)
        rows = slice(self.first - self.span[0], self.stop - self.span[0])
        if header.model.is_static:
            trajectory, mask = static_rows(header.model, log, header.signals)
        else:
            trajectory = process_segments(
                log,
                self.segments,
                header.signals,
                first=self.span[0],
                own=slice(self.first, self.stop),
                speeds=friction_speeds(header.model.layout),
            )
            mask = row_mask(header.model, trajectory, header.signals.min_velocity)
            trajectory, mask = constrained(
                header.model, trajectory, mask, has_torque=log.has_torque
            )
        trajectory = remember(header.model, trajectory)
        return Rows(raw.q[rows], raw.tau[rows], trajectory, mask, (log.q != raw.q).any(axis=0))


@dataclass(frozen=True, eq=False)
class PieceTask(Workload):
    """A task on one piece of a log."""

    piece: LogPiece

    @property
    def name(self) -> str:
        return self.piece.name

    @property
    def samples(self) -> int:
        return self.piece.samples


@dataclass(frozen=True, eq=False)
class ReducedPiece(PieceTask):
    """The reduction of a piece to factors of base parameters."""

    mapping: BaseMapping

    def reduce(self, threads: int | None = None) -> Reduction:
        """Return the factors of the piece; of no samples if none are usable."""
        header, rows = self.piece.header, self.piece.read()
        motion, compiled = rows.trajectory, header.is_compiled
        problem = base_problem(header.model, self.mapping, motion, rows.mask, compiled=compiled)
        return Reduction.of(problem, motion, threads=threads)


@dataclass(frozen=True, eq=False)
class SurveyedLog:
    """A surveyed log, which can be read in pieces."""

    model: RobotModel
    #: The log if it is in memory, else the assignment of columns of its file.
    source: LogLayout | Log
    asked: SignalSettings  # settings of the processing to a trajectory, as given by the user
    stamps: Array  # (N,), time stamps of all rows of the file [s]
    first: int  # first row of the log in the file
    stop: int  # the row after the last one
    #: Ranges of rows that were checked: all rows, or the first, middle and last ones.
    windows: tuple[Log, ...]
    #: Positions of locked joints in the windows, if the file has them, by name [rad or m].
    locked: Mapping[str, Array] = field(default_factory=dict)
    length: int = PIECE  # rows per piece
    places: Sequence[Place] = (Place(),)  # positions in the file at which blocks of rows start
    unit: str = ""  # name of the robot, if there are several of one kind
    given: Rows | None = None  # its rows if it is in memory and they were smoothed before

    @property
    def path(self) -> str:
        """Path of the file; "" for a log made in memory."""
        return self.source.path

    @property
    def is_in_memory(self) -> bool:
        """Whether it is in memory."""
        return isinstance(self.source, Log)

    @property
    def head(self) -> Log:
        """The first rows of the log, with its notes."""
        log = self.windows[0]
        if len(self.windows) == 1:
            return log
        looks = ", ".join(f"{first}-{stop}" for first, stop in _close_looks(self.first, self.stop))
        note = f"the log is too long for the memory; the doctor checked rows {looks} only"
        assumed = dict.fromkeys(text for window in self.windows for text in window.assumed)
        return replace(log, notes=(*log.notes, note), assumed=tuple(assumed))

    @property
    def looks(self) -> tuple[Log, ...]:
        """The windows as separate logs, named by their rows if the log has more rows."""
        if len(self.windows) == 1:
            return self.windows
        ranges = _close_looks(self.first, self.stop)
        return tuple(
            replace(log, path=f"{log.path} rows {first}-{stop}", notes=(), assumed=())
            for log, (first, stop) in zip(self.windows, ranges, strict=True)
        )

    @cached_property
    def step(self) -> float:
        """Median time step [s]."""
        return median_step(self.stamps[self.first : self.stop])

    @cached_property
    def signals(self) -> SignalSettings:
        """Settings of the processing to a trajectory, automatic ones resolved for the whole log."""

        def is_trusted() -> bool:
            return prefers_measured(
                self.model, [_unwrap(self.model, log) for log in self.windows], self.asked
            )

        v, a = self.windows[0].v, self.windows[0].a
        return decide(
            self.asked,
            self.step,
            self.path or "log",
            has_velocity=v is not None,
            has_acceleration=a is not None,
            is_trusted=is_trusted,
        )

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        """Its uninterrupted segments."""
        edges = [self.first]
        for row, t in blocks_of(self.stamps[self.first : self.stop]):
            breaks = np.flatnonzero(np.diff(t) > (self.signals.max_gap or np.inf)) + 1
            edges += (self.first + row + breaks).tolist()
        return tuple(
            Segment(i, j, float(self.stamps[i]), float(self.stamps[j - 1]), number)
            for number, (i, j) in enumerate(pairwise([*edges, self.stop]))
        )

    def with_model(self, model: RobotModel) -> "SurveyedLog":
        """Return the log for a robot whose drives have other terms or another load."""
        before, given = self.model, None
        is_alike = np.array_equal(friction_speeds(model.layout), friction_speeds(before.layout))
        if self.is_in_memory and is_alike:
            rows = self.pieces[0].read()
            motion = rows.trajectory
            if model.layout != before.layout or is_loaded(model):
                motion = remember(model, motion.with_states(None))
            given = self._rows_of(model, replace(rows, trajectory=motion))
        return replace(self, model=model, asked=self.signals, given=given)

    def with_torque(self, tau: Array) -> "SurveyedLog":
        """Return a log in memory with other torques of its smoothed motion, shape (N, n_rows)."""
        rows = replace(self.whole, trajectory=replace(self.whole.trajectory, tau=tau))
        return replace(self, given=self._rows_of(self.model, rows))

    def _rows_of(self, model: RobotModel, rows: Rows) -> Rows:
        """Return rows with those used chosen again, now that they have torques of this robot.

        Static rows were chosen by their speeds already, those of a free base without its jumps and
        with the forces of its contacts.
        """
        if model.is_static or model.constraints or rows.trajectory.switching is not None:
            return rows
        mask = row_mask(model, rows.trajectory, self.signals.min_velocity)
        return replace(rows, mask=mask)

    def with_accelerometer_bias(self, bias: Array) -> "SurveyedLog":
        """Return the log with another bias of the accelerometers of its IMU: bias (3,) [m/s^2]."""

        def changed(log: Log) -> Log:
            if log.base is None or log.base.imu is None:
                return log
            imu = replace(log.base.imu, frame=replace(log.base.imu.frame, offset=bias))
            return replace(log, base=replace(log.base, imu=imu))

        source, windows = self.source, tuple(changed(log) for log in self.windows)
        if isinstance(source, Log):
            source = changed(source)
        elif source.base.imu is not None:
            frame = replace(source.base.imu, offset=bias)
            source = replace(source, base=replace(source.base, imu=frame))
        return replace(self, source=source, windows=windows, asked=self.signals, given=None)

    @property
    def whole(self) -> Rows:
        """All rows of a log in memory, and their smoothed motion."""
        (piece,) = self.pieces
        rows = piece.read()
        if not len(rows.trajectory.t):
            raise self.too_short()
        return rows

    def too_short(self) -> DataError:
        """Return the error for a log without a segment of sufficient length."""
        if self.model.is_static:
            return DataError(
                f"{self.path or 'log'}: no segment of 0.25 s is slow enough for "
                "dynamics = 'static'; record poses at rest for at least 1 s each, or slow motion "
                "at constant speed, or set dynamics = 'full'",
                code="too_short",
            )
        return too_short(self.path or "log", len(self.segments), self.signals)

    @cached_property
    def pieces(self) -> tuple[LogPiece, ...]:
        """Its pieces, in order, each with the rows that are read before and after it."""
        stamps, segments, window = self.stamps, self.segments, (self.first, self.stop)
        header = _Header(self.model, self.source, self.signals, self.stop - self.first)
        settling = filter_reach(self.signals)
        firsts, found = [segment.first for segment in segments], list[LogPiece]()
        for first in range(*window, self.length):
            stop = min(first + self.length, window[1])
            mine = segments[bisect_right(firsts, first) - 1 : bisect_right(firsts, stop - 1)]
            before = int(np.searchsorted(stamps, stamps[first] - settling)) - SPLINE
            after = int(np.searchsorted(stamps, stamps[stop - 1] + settling)) + SPLINE
            span = max(before, mine[0].first), min(after, mine[-1].stop)
            if span[1] - span[0] < 2:  # a single row: add one, a log needs two
                low = max(span[0] - 1, window[0])
                span = low, low + 2
            near = _near(self.places, span[0])
            found.append(LogPiece(header, first, stop, span, near, tuple(mine), self.given))
        return tuple(found)


def _check_base(model: RobotModel, log: Log) -> None:
    """Refuse a log without the motion of a floating base, or without a contact of the model."""
    wanted = logged_base(model)
    if wanted.floats and log.base is None:
        raise DataError(
            f"{log.name} has no pose of the floating base; read it with "
            "base=BaseColumns(floats=True), or pass Log(..., base=BaseMotion(pose))"
        )
    for kind in ("contacts", "wrenches"):
        found, names = tuple(getattr(log, kind)), getattr(wanted, kind)
        stated = tuple(x for x in names if x in found)  # contacts without flags are found
        if found != (stated if kind == "contacts" else names):
            raise DataError(
                f"{log.name} has the {kind} {listed(found)}, wanted those of the model, "
                f"{listed(names)}, in this order; pass Log(..., {kind}={{...}})"
            )


def hold_log(
    model: RobotModel, log: Log, signals: SignalSettings, locked: Mapping[str, Array] | None = None
) -> SurveyedLog:
    """Return a log in memory as one piece; errors of its data are raised when it is read."""
    count = len(log.t)
    _check_base(model, log)
    log = with_contacts(model, closed_log(model, log), signals)
    if model.is_static:  # means of segments replace filters
        signals = replace(
            signals, cutoff=None, rate=None, velocity="differentiated",
            acceleration="differentiated",
        )  # fmt: skip
    return SurveyedLog(model, log, signals, log.t, 0, count, (log,), locked or {}, count)


def survey_log(
    layout: LogLayout,
    table: Table,
    model: RobotModel,
    signals: SignalSettings,
    window: tuple[float | None, float | None] = (None, None),
    *,
    length: int | None = PIECE,
) -> SurveyedLog:
    """Return a surveyed log of a file.

    Every time stamp is checked. Units and the delay of the measured velocity are checked in the
    windows; the values of each piece are checked when it is read.
    """
    locked = {x: layout.positions[x] for x in model.locked if x in layout.positions}
    wanted = list(dict.fromkeys([*layout.wanted, *locked.values()]))
    if length is None:
        columns = table.read(wanted)
        log = layout.to_log(columns)
        check_units(log, layout.units, layout.prismatic, layout.turning)
        used = log if window == (None, None) else log.window(*window)
        inside = slice(*np.searchsorted(log.t, [used.t[0], np.nextafter(used.t[-1], np.inf)]))
        positions = _positions(locked, [columns], layout, model, inside)
        return hold_log(model, used, signals, positions)
    reader, places, where = table.reader(wanted), list[Place](), Path(layout.path).name
    stamps = map_stamps(_stamps(reader, layout, places), where)
    first, stop = _window(stamps, where, *window)
    ranges = _close_looks(first, stop)
    found = [reader.read(wanted, i, j, _near(places, i)) for i, j in ranges]
    windows = tuple(_log_of(layout, x, i) for x, (i, _) in zip(found, ranges, strict=True))
    layout, windows = _with_one_bias(layout, windows)
    for log in windows:
        check_units(log, layout.units, layout.prismatic, layout.turning)
    positions = _positions(locked, found, layout, model)
    if table.rows is None:
        length = max(stop - first, 1)
    windows = tuple(with_contacts(model, closed_log(model, log), signals) for log in windows)
    return SurveyedLog(
        model, layout, signals, stamps, first, stop, windows, positions, length, places
    )


def _with_one_bias(
    layout: LogLayout, windows: tuple[Log, ...]
) -> tuple[LogLayout, tuple[Log, ...]]:
    """Return layout and windows with the bias of the gyroscopes at rest in all windows together."""
    own = [(log.base, log.base.imu) for log in windows if log.base and log.base.imu]
    if layout.base.imu is None or layout.base.imu.bias is not None or not own:
        return layout, windows
    parts = [
        (log.t, log.q, imu.values[:, :3] + imu.frame.bias)
        for log, (_, imu) in zip(windows, own, strict=True)
    ]
    bias, note = bias_at_rest(parts)
    frame, changed = replace(own[0][1].frame, bias=bias), []
    for part, log, (moved, imu) in zip(parts, windows, own, strict=True):
        values = np.hstack([part[2] - bias, imu.values[:, 3:]])
        base = replace(moved, imu=replace(imu, values=values, frame=frame))
        before = bias_at_rest([part])[1]
        notes = tuple(note if x == before else x for x in log.notes)
        changed.append(replace(log, base=base, notes=notes))
    return replace(layout, base=replace(layout.base, imu=frame)), tuple(changed)


def _log_of(layout: LogLayout, columns: Mapping[str, Array], first: int) -> Log:
    """Return rows of a file as a log in SI units, angles not unwrapped."""
    log = layout.to_log(columns, first)
    check_reach(log, layout.units, layout.prismatic, layout.turning)
    return log


def _unwrap(model: RobotModel, log: Log) -> Log:
    """Return the log with unwrapped angles."""
    return unwrap(log, np.array([joint.turns_freely for joint in model.limits]))


def _stamps(rows: RowReader, layout: LogLayout, places: list[Place]) -> Iterator[Array]:
    """Yield the time stamps in seconds, and store the place of each block of rows."""
    for values, place in rows.scan(layout.columns["time"][0]):
        places.append(place)
        yield layout.stamps(values)


def _near(places: Sequence[Place], row: int) -> Place:
    return places[max(bisect_right(places, row, key=lambda place: place.row) - 1, 0)]


def _window(stamps: Array, where: str, start: float | None, end: float | None) -> tuple[int, int]:
    """Return the rows from start to end; see ``Log.window``."""
    count = len(stamps)
    if count < 2:
        raise DataError(f"{where} has {count} rows, wanted at least 2")
    first = 0 if start is None else int(np.searchsorted(stamps, start))
    stop = count if end is None else int(np.searchsorted(stamps, end, side="right"))
    if stop - first < 2:
        low, high = stamps[0], stamps[-1]
        raise DataError(
            f"{where}: {max(stop - first, 0)} rows lie between "
            f"{seconds(low if start is None else start)} s and "
            f"{seconds(high if end is None else end)} s; the log spans {seconds(low)} s to "
            f"{seconds(high)} s. Choose start and end inside it"
        )
    return first, stop


def _close_looks(first: int, stop: int) -> list[tuple[int, int]]:
    """Return the ranges of the first, middle and last rows; one range if the log is short."""
    if stop - first <= 3 * _WINDOW:
        return [(first, stop)]
    middle = (first + stop - _WINDOW) // 2
    return [(row, row + _WINDOW) for row in (first, middle, stop - _WINDOW)]


def _positions(
    names: Mapping[str, str],
    windows: Sequence[Mapping[str, Array]],
    layout: LogLayout,
    model: RobotModel,
    inside: slice = slice(None),
) -> dict[str, Array]:
    """Return the positions of locked joints in the rows read, by joint [rad or m]."""
    revolute = {joint.name for joint in model.tree.movable if joint.type != "prismatic"}
    positions = {}
    for joint, column in names.items():
        q = np.concatenate([columns[column] for columns in windows])[inside]
        q = q[np.isfinite(q)]
        first, scale = layout.units.scale(joint, is_angle=joint in revolute)
        if len(q):
            positions[joint] = first + scale * q
    return positions
