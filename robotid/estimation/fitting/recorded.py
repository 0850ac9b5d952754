"""The logs of an identification: their triangular factors and their samples."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.dynamics.factors import Factors, Reduction, compress_segments, join_segments
from robotid.dynamics.prepared_logs import base_problem, independent_share
from robotid.dynamics.problem import Block, Problem, concatenate
from robotid.dynamics.rows import keep_inertial_rows
from robotid.estimation.fitting.survey import ReducedPiece, SurveyedLog
from robotid.estimation.work_plan import WorkPlan
from robotid.robot.model import RobotModel

_SEGMENTS = 48  # of all logs in memory: enough to estimate the scatter of their scores
_CORRELATIONS = 10  # shortest segment, in correlation times of filtered noise
_SEGMENTS_IN_FILE = 64  # largest number of segments of a log in a file
_FACTORS = 2**26  # largest size of all their factors [bytes], with at least _FEW segments per log
_FEW = 8


@dataclass(frozen=True, eq=False)
class RepeatedErrors:
    """Effect of errors that repeat in every step on all rows."""

    root: Array  # (b, k), C of the covariance C C^T of W^T tau
    variance: float  # of a row's residual, on average [(N m)^2]
    points: float  # standard deviation of points of contact, the largest [m]
    bias: Array | None = None  # (3,), that of the accelerometers that was subtracted [m/s^2]
    bias_error: float = 0.0  # its standard error, root mean square of the axes [m/s^2]
    has_motion: bool = False  # whether errors of the motion of the base are counted

    @property
    def described(self) -> str:
        """Description of the errors."""
        points = f"points of contact uncertain by {self.points:.2g} m"
        parts = [points] if self.points > 0.0 else []
        if self.bias is not None:
            shown = ", ".join(f"{x:+.3f}" for x in self.bias)
            parts.append(
                f"bias of the accelerometers, estimated and subtracted: {shown} m/s^2, uncertain "
                f"by {self.bias_error:.2g} m/s^2"
            )
        if self.has_motion:
            parts.append("errors of the motion of the base that would cause the residual")
        return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class Recordings:
    """The logs of a fit, in memory or read in pieces from their files when needed."""

    model: RobotModel
    mapping: BaseMapping  # standard to base parameters
    fitted: Sequence[SurveyedLog]  # logs to fit
    validation: Sequence[SurveyedLog] = ()  # validation logs
    #: Processes that work on the pieces of logs in files; None: this process.
    plan: WorkPlan | None = None
    #: Weights of the rows of each log to fit, shapes (N, n_rows); 1 if None.
    weights: tuple[Array, ...] | None = None
    #: Effect of errors of points of contact and of an IMU; None without any.
    repeated: RepeatedErrors | None = None
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
    def pieces(self) -> list[ReducedPiece]:
        """The pieces of the logs to fit, in order."""
        return [ReducedPiece(piece, self.mapping) for log in self.fitted for piece in log.pieces]

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
            reduced = self._segments if is_cut else self._whole
            return tuple(tuple(reduced(k)) for k in range(len(self.fitted)))
        plan = self.plan or WorkPlan()
        found = plan.map(ReducedPiece.reduce, self.pieces, "reducing")
        reductions = []
        size = 8 * self.model.n_rows * (len(self.mapping.independent) + 1) ** 2 * len(self.fitted)
        most = max(_FEW, min(_SEGMENTS_IN_FILE, _FACTORS // size))
        for log in self.fitted:
            count = len(log.pieces)
            own = join_segments(islice(found, count), count, most)
            if not any(reduction.samples for reduction in own):
                raise log.too_short()
            reductions.append(tuple(own))
        return tuple(reductions)

    def problem(self, *, with_mass: bool = False) -> Problem:
        """Return the rows of the logs to fit, for estimators that read them in order of time."""
        if self.is_in_memory:
            motions = [log.whole.trajectory for log in self.fitted]
            return concatenate([self.problem_of(k, x, with_mass) for k, x in enumerate(motions)])

        def problems() -> Iterator[Problem]:
            for piece in (piece for log in self.fitted for piece in log.pieces):
                rows = piece.read()
                yield base_problem(
                    self.model, self.mapping, rows.trajectory, rows.mask, with_mass=with_mass
                )

        def stream() -> Iterator[Block]:
            return chain.from_iterable(problem.blocks() for problem in problems())

        def mass_stream() -> Iterator[Array]:
            for problem in problems():
                yield from problem.mass_stream() if problem.mass_stream is not None else ()

        support, is_projected = self.model.support, bool(self.model.constraints)
        if is_projected:  # every row has the columns of all
            support = np.broadcast_to(support.any(axis=0), support.shape)
        return Problem(
            stream,
            self.mapping.base_names,
            self.model.n_rows,
            support[:, self.mapping.independent],
            mass_stream if with_mass else None,
            is_projected=is_projected,
        )

    def segments(self, k: int, motion: Trajectory, joined: int = 1) -> tuple[Factors, ...]:
        """The factors of each segment of a log in memory, with the segments of ``reduce``."""
        return compress_segments(self.problem_of(k, motion), joined * self.segment_length(k))

    def problem_of(self, k: int, motion: Trajectory, with_mass: bool = False) -> Problem:
        """Return the weighted rows of a log in memory for a motion of the same length."""
        mask = self.fitted[k].whole.mask
        weight = mask if self.weights is None else mask * self.weights[k]
        return base_problem(self.model, self.mapping, motion, weight, with_mass=with_mass)

    def segment_length(self, k: int) -> int:
        """Return the samples of each segment of a log in memory."""
        samples, count = len(self.fitted[k].whole.trajectory.t), -(-_SEGMENTS // len(self.fitted))
        shortest = round(_CORRELATIONS / independent_share(self.fitted[k].signals))
        if self.model.is_static:  # means of segments, not filtered
            shortest = 1
        return max(-(-samples // count), shortest)

    def _segments(self, k: int) -> Iterator[Reduction]:
        """Yield the reduction of each segment of a log in memory."""
        motion, length = self.fitted[k].whole.trajectory, self.segment_length(k)
        for i, factors in enumerate(self.segments(k, motion)):
            part = motion.at(slice(i * length, (i + 1) * length))
            yield Reduction(factors, part.squares, len(part.t))

    def _whole(self, k: int) -> Iterator[Reduction]:
        """Yield the reduction of a log in memory."""
        motion = self.fitted[k].whole.trajectory
        yield Reduction.of(self.problem_of(k, motion), motion)
