"""The logs of a fit, of any length: surveyed once, read in pieces, and reduced to factors.

The survey of a file reads all time stamps and a few windows of all columns, and resolves automatic
settings. A piece is a fixed range of rows; a log in memory is one piece.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, islice, pairwise
from pathlib import Path

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.base_motion import bias_at_rest
from robotid.data.files.read import LogLayout, open_table
from robotid.data.files.table import Place, RowReader, Table
from robotid.data.log import Log, Trajectory, blocks_of, map_stamps, median_step, rows_within
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
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.dynamics.constraint_rows import constrained, logged_base
from robotid.dynamics.factors import (
    Block,
    Factors,
    Problem,
    Reduction,
    compress,
    compress_segments,
    concatenate,
    join_segments,
)
from robotid.dynamics.prepared_logs import (
    base_problem,
    closed_log,
    independent_share,
    prefers_measured,
    row_mask,
    static_rows,
    with_contacts,
)
from robotid.dynamics.rows import COMPILED, choose_engine, friction_speeds, keep_inertial_rows
from robotid.dynamics.torque import is_loaded, remember
from robotid.estimation.estimators.estimator import SEGMENTS
from robotid.estimation.work_plan import WorkPlan
from robotid.robot.model import RobotModel

PIECE = 16384  # default number of rows of a piece
WINDOW = 20_000  # rows of each window that is checked
_CORRELATIONS = 10  # shortest segment, in correlation times of filtered noise
_SEGMENTS_IN_FILE = 64  # largest number of segments of a log in a file
_FACTORS = 2**26  # largest size of all their factors [bytes], with at least _FEW segments per log
_FEW = 8


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

    model: RobotModel
    source: LogLayout | Log  # the log itself if it is in memory
    signals: SignalSettings
    log_rows: tuple[int, int]  # the first row of the log, and the row after its last one
    number: tuple[int, int]  # its number, from 0, and the number of pieces of the log
    first: int  # its first row
    stop: int  # the row after its last one
    span: tuple[int, int]  # first row that is read for it, and the row after the last one
    near: Place  # position in the file at the start of the span, or shortly before
    segments: tuple[Segment, ...]  # the uninterrupted segments that contain its rows
    given: Rows | None = None  # rows that were smoothed before, of a log in memory

    @property
    def name(self) -> str:
        """Name for messages, as ``run3.parquet rows 0-16384``."""
        return f"{Path(self.source.path).name} rows {self.first}-{self.stop}"

    @property
    def samples(self) -> int:
        """Number of rows."""
        return self.stop - self.first

    @property
    def is_compiled(self) -> bool | None:
        """Whether compiled code computes the rows of a file: chosen for the log, not by piece."""
        if isinstance(self.source, Log):
            return None  # chosen by the number of samples of its one piece
        first, stop = self.log_rows
        return choose_engine(self.model, stop - first, None) == COMPILED

    def read(self) -> Rows:
        """Return its rows and its smoothed motion; for a log in memory they are cached."""
        return self._cached if isinstance(self.source, Log) else self._read()

    @cached_property
    def _cached(self) -> Rows:
        return self.given or self._read()

    def _recorded(self) -> Log:
        """Return the rows of the span in SI units, angles not unwrapped; in memory, all rows."""
        if isinstance(self.source, Log):
            return self.source
        layout = self.source
        reader = open_table(Path(layout.path), layout.source).reader(layout.wanted)
        log = layout.to_log(reader.read(layout.wanted, *self.span, self.near), self.span[0])
        check_reach(log, layout.units, layout.prismatic, layout.turning)
        return with_contacts(self.model, closed_log(self.model, log), self.signals)

    def _read(self) -> Rows:
        model, signals, raw = self.model, self.signals, self._recorded()
        log, first = _unwrap(model, raw), self.span[0]
        if model.is_static:
            trajectory, mask = static_rows(model, log, signals)
        else:
            own, speeds = slice(self.first, self.stop), friction_speeds(model.layout)
            trajectory = process_segments(
                log, self.segments, signals, first=first, own=own, speeds=speeds
            )
            mask = row_mask(model, trajectory, signals.min_velocity)
            trajectory, mask = constrained(model, trajectory, mask, has_torque=log.has_torque)
        rows = slice(self.first - first, self.stop - first)
        turned = (log.q != raw.q).any(axis=0)
        return Rows(raw.q[rows], raw.tau[rows], remember(model, trajectory), mask, turned)


def reduce_piece(piece: LogPiece, threads: int | None = None, *, mapping: BaseMapping) -> Reduction:
    """Return the factors of a piece in base parameters; of no samples if none are usable."""
    rows = piece.read()
    motion = rows.trajectory
    problem = base_problem(piece.model, mapping, motion, rows.mask, compiled=piece.is_compiled)
    return Reduction(compress(problem, threads=threads), motion.squares, len(motion.t))


@dataclass(frozen=True, eq=False)
class SurveyedLog:
    """A surveyed log, which can be read in pieces."""

    model: RobotModel
    source: LogLayout | Log  # the log if it is in memory, else the columns of its file
    asked: SignalSettings  # settings of the processing to a trajectory, as given by the user
    stamps: Array  # (N,), time stamps of all rows of the file [s]
    first: int  # first row of the log in the file
    stop: int  # the row after the last one
    windows: tuple[Log, ...]  # rows that were checked: all, or the first, middle and last ones
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
        return isinstance(self.source, Log)

    @property
    def head(self) -> Log:
        """The first rows of the log, with its notes."""
        log = self.windows[0]
        if len(self.windows) == 1:
            return log
        rows = ", ".join(f"{first}-{stop}" for first, stop in _close_looks(self.first, self.stop))
        note = f"the log is too long for the memory; the doctor checked rows {rows} only"
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
        first = self.windows[0]

        def is_trusted() -> bool:
            windows = [_unwrap(self.model, log) for log in self.windows]
            return prefers_measured(self.model, windows, self.asked)

        return decide(
            self.asked, self.step, self.path or "log",
            has_velocity=first.v is not None, has_acceleration=first.a is not None,
            is_trusted=is_trusted,
        )  # fmt: skip

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
        layout, given = self.model.layout, None
        is_alike = np.array_equal(friction_speeds(model.layout), friction_speeds(layout))
        if self.is_in_memory and is_alike:
            rows = self.pieces[0].read()
            motion = rows.trajectory
            if model.layout != layout or is_loaded(model):
                motion = remember(model, motion.with_states(None))
            given = self._rows_of(model, replace(rows, trajectory=motion))
        return replace(self, model=model, asked=self.signals, given=given)

    def with_torque(self, tau: Array) -> "SurveyedLog":
        """Return a log in memory with other torques of its smoothed motion, shape (N, n_rows)."""
        rows = replace(self.whole, trajectory=replace(self.whole.trajectory, tau=tau))
        return replace(self, given=self._rows_of(self.model, rows))

    def _rows_of(self, model: RobotModel, rows: Rows) -> Rows:
        """Return rows with those used chosen again, not of static robots and free bases."""
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
        stamps, segments, log_rows = self.stamps, self.segments, (self.first, self.stop)
        settling, starts = filter_reach(self.signals), [segment.first for segment in segments]
        pieces, firsts = list[LogPiece](), range(*log_rows, self.length)
        for number, first in enumerate(firsts):
            stop = min(first + self.length, self.stop)
            within = segments[bisect_right(starts, first) - 1 : bisect_right(starts, stop - 1)]
            before = int(np.searchsorted(stamps, stamps[first] - settling)) - SPLINE
            after = int(np.searchsorted(stamps, stamps[stop - 1] + settling)) + SPLINE
            span = max(before, within[0].first), min(after, within[-1].stop)
            if span[1] - span[0] < 2:  # a single row: add one, a log needs two
                low = max(span[0] - 1, self.first)
                span = low, low + 2
            pieces.append(LogPiece(
                self.model, self.source, self.signals, log_rows, (number, len(firsts)), first, stop,
                span, _near(self.places, span[0]), tuple(within), self.given,
            ))  # fmt: skip
        return tuple(pieces)


def _check_base(model: RobotModel, log: Log) -> None:
    """Refuse a log without the motion of a floating base, or without a contact of the model."""
    wanted = logged_base(model)
    if wanted.floats and log.base is None:
        raise DataError(
            f"{log.name} has no pose of the floating base; read it with "
            "base=BaseColumns(floats=True), or pass Log(..., base=BaseMotion(pose))"
        )
    for kind in ("contacts", "wrenches"):
        logged, names = tuple(getattr(log, kind)), getattr(wanted, kind)
        stated = tuple(x for x in names if x in logged)  # contacts without flags are found
        if logged != (stated if kind == "contacts" else names):
            raise DataError(
                f"{log.name} has the {kind} {listed(logged)}, expected the model's, "
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
    """Return a surveyed log of a file, with every time stamp and units in windows checked."""
    locked = {x: layout.positions[x] for x in model.locked if x in layout.positions}
    wanted = list(dict.fromkeys([*layout.wanted, *locked.values()]))
    if length is None:
        whole = table.read(wanted)
        log = layout.to_log(whole)
        check_units(log, layout.units, layout.prismatic, layout.turning)
        used = log if window == (None, None) else log.window(*window)
        inside = slice(*rows_within(log.t, log.name, *window))
        positions = _positions(locked, [whole], layout, model, inside)
        return hold_log(model, used, signals, positions)
    reader, places, where = table.reader(wanted), list[Place](), Path(layout.path).name
    stamps = map_stamps(_stamps(reader, layout, places), where)
    if len(stamps) < 2:
        raise DataError(f"{where} has {len(stamps)} rows, expected at least 2")
    first, stop = rows_within(stamps, where, *window)
    ranges = _close_looks(first, stop)
    columns = [reader.read(wanted, i, j, _near(places, i)) for i, j in ranges]
    windows = tuple(layout.to_log(x, i) for x, (i, _) in zip(columns, ranges, strict=True))
    layout, windows = _with_one_bias(layout, windows)
    for log in windows:
        check_units(log, layout.units, layout.prismatic, layout.turning)
    positions = _positions(locked, columns, layout, model)
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
    bases = [(log.base, log.base.imu) for log in windows if log.base and log.base.imu]
    if layout.base.imu is None or layout.base.imu.bias is not None or not bases:
        return layout, windows
    parts = [
        (log.t, log.q, imu.values[:, :3] + imu.frame.bias)
        for log, (_, imu) in zip(windows, bases, strict=True)
    ]
    bias, note = bias_at_rest(parts)
    frame, changed = replace(bases[0][1].frame, bias=bias), []
    for part, log, (base, imu) in zip(parts, windows, bases, strict=True):
        values = np.hstack([part[2] - bias, imu.values[:, 3:]])
        imu = replace(imu, values=values, frame=frame)
        note_of_window = bias_at_rest([part])[1]
        notes = tuple(note if x == note_of_window else x for x in log.notes)
        changed.append(replace(log, base=replace(base, imu=imu), notes=notes))
    return replace(layout, base=replace(layout.base, imu=frame)), tuple(changed)


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


def _close_looks(first: int, stop: int) -> list[tuple[int, int]]:
    """Return the ranges of the first, middle and last rows; one range if the log is short."""
    if stop - first <= 3 * WINDOW:
        return [(first, stop)]
    middle = (first + stop - WINDOW) // 2
    return [(row, row + WINDOW) for row in (first, middle, stop - WINDOW)]


def _positions(
    names: Mapping[str, str], windows: Sequence[Mapping[str, Array]], layout: LogLayout,
    model: RobotModel, inside: slice = slice(None),
) -> dict[str, Array]:  # fmt: skip
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


@dataclass(frozen=True, eq=False)
class RepeatedErrors:
    """Effect of errors that repeat in every step on all rows."""

    root: Array  # (b, k), C of the covariance C C^T of W^T tau
    variance: float  # of a row's residual, on average [(N m)^2]
    points: float  # standard deviation of points of contact, the largest [m]
    bias: Array | None = None  # (3,), that of the accelerometers that was subtracted [m/s^2]
    bias_error: float = 0.0  # its standard error, root mean square of the axes [m/s^2]

    @property
    def described(self) -> str:
        """Description of the errors."""
        parts = []
        if self.points > 0.0:
            parts.append(f"points of contact uncertain by {self.points:.2g} m")
        if self.bias is not None:
            shown = ", ".join(f"{x:+.3f}" for x in self.bias)
            parts.append(
                f"bias of the accelerometers, estimated and subtracted: {shown} m/s^2, uncertain "
                f"by {self.bias_error:.2g} m/s^2"
            )
        return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class Recordings:
    """The logs of a fit, in memory or read in pieces from their files when needed."""

    model: RobotModel
    mapping: BaseMapping  # standard to base parameters
    fitted: Sequence[SurveyedLog]  # logs to fit
    validation: Sequence[SurveyedLog] = ()  # validation logs
    plan: WorkPlan | None = None  # processes for the pieces of logs in files; None: this process
    weights: tuple[Array, ...] | None = None  # of rows by log, (N, n_rows); or 1
    repeated: RepeatedErrors | None = None  # of points of contact and of an IMU
    #: (n,), noise levels of an earlier fit, from which the next one starts.
    levels: Array | None = None

    @property
    def is_in_memory(self) -> bool:
        """Whether all logs are in memory."""
        return all(log.is_in_memory for log in (*self.fitted, *self.validation))

    @property
    def share(self) -> float:
        """Share of independent rows among the fitted rows [-]."""
        return min(independent_share(log.signals) for log in self.fitted)

    @property
    def pieces(self) -> list[LogPiece]:
        """The pieces of the logs to fit, in order."""
        return [piece for log in self.fitted for piece in log.pieces]

    def with_model(self, model: RobotModel) -> "Recordings":
        """Return the same logs for a robot whose drives have other terms or another load."""
        is_same = model.layout == self.model.layout
        plain = None if self.model.layout.own else self.mapping
        return replace(
            self,
            model=model,
            mapping=self.mapping if is_same else structural_mapping(model, plain=plain),
            fitted=[log.with_model(model) for log in self.fitted],
            validation=[log.with_model(model) for log in self.validation],
        )

    def reduce(self, *, is_cut: bool = True) -> tuple[Reduction, ...]:
        """Return the reductions of all logs to fit, in one sequence."""
        return tuple(chain.from_iterable(self.reduce_logs(is_cut=is_cut)))

    def reduce_logs(self, *, is_cut: bool = True) -> tuple[tuple[Reduction, ...], ...]:
        """Reduce the logs to fit."""
        if self.is_in_memory:
            for log in (*self.fitted, *self.validation):  # raises errors before any fit
                keep_inertial_rows(self.model, log.whole.trajectory)
            motions = enumerate(log.whole.trajectory for log in self.fitted)
            if not is_cut:
                factors = ((compress(self.problem_of(k, motion)), motion) for k, motion in motions)
                return tuple((Reduction(R, m.squares, len(m.t)),) for R, m in factors)
            return tuple(tuple(self._segments(k, motion)) for k, motion in motions)
        work = partial(reduce_piece, mapping=self.mapping)
        by_piece = (self.plan or WorkPlan()).map(work, self.pieces, "reducing")
        size = 8 * self.model.n_rows * (len(self.mapping.independent) + 1) ** 2 * len(self.fitted)
        most = max(_FEW, min(_SEGMENTS_IN_FILE, _FACTORS // size))
        reductions = []
        for log in self.fitted:
            count = len(log.pieces)
            segments = join_segments(islice(by_piece, count), count, most)
            if not any(reduction.samples for reduction in segments):
                raise log.too_short()
            reductions.append(tuple(segments))
        return tuple(reductions)

    def problem(self) -> Problem:
        """Return the rows of the logs to fit, for estimators that read them in order of time."""
        model, mapping = self.model, self.mapping
        if self.is_in_memory:
            motions = [log.whole.trajectory for log in self.fitted]
            return concatenate([self.problem_of(k, motion) for k, motion in enumerate(motions)])

        def stream() -> Iterator[Block]:
            for rows in (piece.read() for piece in self.pieces):
                yield from base_problem(model, mapping, rows.trajectory, rows.mask).blocks()

        support, is_projected = model.support, bool(model.constraints)
        if is_projected:  # every row has the columns of all
            support = np.broadcast_to(support.any(axis=0), support.shape)
        names, support = mapping.base_names, support[:, mapping.independent]
        return Problem(stream, names, model.n_rows, support, is_projected=is_projected)

    def segments(self, k: int, motion: Trajectory, joined: int = 1) -> tuple[Factors, ...]:
        """The factors of each segment of a log in memory, with the segments of ``reduce``."""
        return compress_segments(self.problem_of(k, motion), joined * self.segment_length(k))

    def problem_of(self, k: int, motion: Trajectory) -> Problem:
        """Return the weighted rows of a log in memory for a motion of the same length."""
        mask = self.fitted[k].whole.mask
        weight = mask if self.weights is None else mask * self.weights[k]
        return base_problem(self.model, self.mapping, motion, weight)

    def segment_length(self, k: int) -> int:
        """Return the samples of each segment of a log in memory."""
        samples, count = len(self.fitted[k].whole.trajectory.t), -(-SEGMENTS // len(self.fitted))
        shortest = round(_CORRELATIONS / independent_share(self.fitted[k].signals))
        if self.model.is_static:  # means of segments, not filtered
            shortest = 1
        return max(-(-samples // count), shortest)

    def _segments(self, k: int, motion: Trajectory) -> Iterator[Reduction]:
        """Yield the reduction of each segment of a log in memory."""
        length = self.segment_length(k)
        for i, factors in enumerate(self.segments(k, motion)):
            part = motion.at(slice(i * length, (i + 1) * length))
            yield Reduction(factors, part.squares, len(part.t))
