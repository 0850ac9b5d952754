"""Identification from logs larger than memory: one pass over the pieces reduces, one evaluates."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import chain, islice

import numpy as np

from robotid._typing import Array
from robotid.identification.evaluation import (
    Evaluation,
    Extent,
    Recording,
    conclude_sums,
    is_shared,
    predict_all,
    rows_in,
    sampled_every,
    torque_sums,
)
from robotid.identification.metrics import TorqueSums
from robotid.identification.recordings import Recordings, base_problem, independent_share
from robotid.identification.survey import LogPiece, LongLog
from robotid.logs.data import Trajectory
from robotid.logs.signals import turns_note
from robotid.logs.smoothing import too_short
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.problem import Block, Problem
from robotid.regressor.reduction import Reduction, join_stretches
from robotid.robot.model import RobotModel
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.plan import WorkPlan

__all__ = ["LongRecordings", "evaluate_long"]

_SHOWN = 10_000  # samples at the beginning, in the middle and at the end that are kept for plots
_STRETCHES = 64  # of each log whose factors are kept apart
_FACTORS = 2**26  # bytes of them all, if that leaves each log a few
_FEW = 8


@dataclass(frozen=True, eq=False)
class LongRecordings(Recordings):
    """Logs that are read in pieces, as often as needed.

    Attributes:
        model: The robot.
        fitted: Logs to fit.
        kept: Logs kept apart.
        plan: Who works on the pieces.
        checkpoint: Where reductions are kept until the run is complete.
    """

    model: RobotModel
    fitted: Sequence[LongLog]
    kept: Sequence[LongLog]
    plan: WorkPlan = field(default_factory=WorkPlan)
    checkpoint: Checkpoint | None = None

    @property
    def share(self) -> float:
        """See ``Recordings.share``."""
        return min(independent_share(log.header.signals) for log in self.fitted)

    def reduce(self, mapping: BaseMapping) -> tuple[Reduction, ...]:
        """See ``Recordings.reduce``.

        Args:
            mapping: Standard to base parameters; that which the logs were surveyed with.

        Returns:
            One reduction per stretch of neighbouring pieces of a log.

        Raises:
            DataError: If a row cannot be used, or no stretch of a log is long enough.
        """
        pieces = [piece for log in self.fitted for piece in log.pieces]
        found = iter(self.plan.reduce(pieces, checkpoint=self.checkpoint))
        reductions = []
        size = 8 * self.model.n_rows * (len(mapping.independent) + 1) ** 2 * len(self.fitted)
        most = max(_FEW, min(_STRETCHES, _FACTORS // size))
        for log in self.fitted:
            count = len(log.pieces)
            own = join_stretches(islice(found, count), count, most)
            if not any(reduction.samples for reduction in own):
                raise too_short(log.path, len(log.stretches), log.header.signals)
            reductions += own
        return tuple(reductions)

    def problem(self, mapping: BaseMapping, *, with_mass: bool = False) -> Problem:
        """See ``Recordings.problem``.

        Args:
            mapping: Standard to base parameters.
            with_mass: Whether each sample also carries the regressor of its mass matrix.

        Returns:
            The base problem, in blocks only: each pass reads the logs anew.
        """

        def problems() -> Iterator[Problem]:
            for piece in (piece for log in self.fitted for piece in log.pieces):
                _, motion, _ = piece.read()
                yield base_problem(
                    self.model, mapping, motion, piece.mask(motion), with_mass=with_mass
                )

        def stream() -> Iterator[Block]:
            return chain.from_iterable(problem.blocks() for problem in problems())

        def mass_stream() -> Iterator[Array]:
            for problem in problems():
                yield from problem.mass_stream() if problem.mass_stream is not None else ()

        return Problem(
            stream,
            mapping.base_names,
            self.model.n_rows,
            self.model.support()[:, mapping.independent],
            mass_stream if with_mass else None,
        )

    def evaluate(
        self, parameters: Mapping[str, Array], prior: Array
    ) -> tuple[tuple[Evaluation, ...], tuple[Evaluation, ...]]:
        """See ``Recordings.evaluate``.

        Args:
            parameters: Standard parameters by name, each of shape (p,).
            prior: Those of the URDF, shape (p,).

        Returns:
            Evaluations of the fitted logs, and of those kept apart.

        Raises:
            DataError: If no row of a log is used.
        """
        kept = _score_logs(self.kept, parameters, prior, self.plan)
        sampled = [score.sampled for score in kept]
        fitted = _score_logs(self.fitted, parameters, prior, self.plan, sampled)
        again = [any(is_shared(score.found[k]) for score in fitted) for k in range(len(kept))]
        return (
            tuple(_conclude(*x) for x in zip(self.fitted, fitted, strict=True)),
            tuple(
                _conclude(log, score, is_refitted=is_refitted)
                for log, score, is_refitted in zip(self.kept, kept, again, strict=True)
            ),
        )


def evaluate_long(
    log: LongLog,
    parameters: Mapping[str, Array],
    prior: Array,
    *,
    plan: WorkPlan | None = None,
) -> Evaluation:
    """Return how well parameters predict a log, piece by piece.

    Args:
        log: The log, surveyed with the model that predicts.
        parameters: Standard parameters by name, each of shape (p,).
        prior: Those of the URDF, shape (p,).
        plan: Who works on the pieces; this process if None.

    Returns:
        The evaluation; the torques are those of the stretches that are kept for plots.

    Raises:
        DataError: If no row of the log is used.
    """
    (score,) = _score_logs([log], parameters, prior, plan or WorkPlan())
    return _conclude(log, score)


@dataclass(frozen=True, eq=False)
class _Score:
    """What is known of a log, or of its pieces so far.

    Attributes:
        sums: What the metrics are made of, by name of the parameters.
        smooth: Samples.
        used: Torque rows used.
        segments: Numbers of the stretches that have samples.
        turned: Joints whose full turns were taken out, shape (n,), bool.
        shown: Motion, rows used and torques of a few stretches.
        sampled: Raw rows spread over the log, shape (m, 2 n).
        found: Which of the sampled rows of other logs are in this one, one array for each log.
    """

    sums: Mapping[str, TorqueSums]
    smooth: int
    used: int
    segments: frozenset[int]
    turned: Array
    shown: tuple[tuple[Trajectory, Array, Mapping[str, Array]], ...]
    sampled: Array
    found: tuple[Array, ...]

    def join(self, other: "_Score") -> "_Score":
        """Return what is known with the pieces that follow."""
        return _Score(
            sums={name: x.merge(other.sums[name]) for name, x in self.sums.items()},
            smooth=self.smooth + other.smooth,
            used=self.used + other.used,
            segments=self.segments | other.segments,
            turned=self.turned | other.turned,
            shown=self.shown + other.shown,
            sampled=np.concatenate([self.sampled, other.sampled]),
            found=tuple(one | two for one, two in zip(self.found, other.found, strict=True)),
        )


@dataclass(frozen=True, eq=False)
class _Part:
    """A piece, and what is kept of it: raw rows spread over it, and a stretch for plots."""

    piece: LogPiece
    sampled: slice
    shown: slice | None

    @property
    def name(self) -> str:
        return self.piece.name

    @property
    def samples(self) -> int:
        return self.piece.samples


def _score_logs(
    logs: Sequence[LongLog],
    parameters: Mapping[str, Array],
    prior: Array,
    plan: WorkPlan,
    sought: Sequence[Array] = (),
) -> list[_Score]:
    """Return what is known of each log; refuse one without samples."""
    parts = [_parts(log) for log in logs]
    work = partial(_score, parameters=parameters, prior=prior, sought=sought)
    found = plan.map(work, list(chain.from_iterable(parts)), "evaluating")
    scores = []
    for log, own in zip(logs, parts, strict=True):
        by_piece = [next(found) for _ in own]
        score = reduce(_Score.join, by_piece)
        if not score.smooth:
            raise too_short(log.path, len(log.stretches), log.header.signals)
        if not score.shown:  # of none of the chosen pieces is a sample left: draw another one
            filled = next(k for k, piece in enumerate(by_piece) if piece.smooth)
            again = work(replace(own[filled], shown=slice(_SHOWN)), None)
            score = replace(score, shown=again.shown)
        scores.append(score)
    return scores


def _parts(log: LongLog) -> list[_Part]:
    last = len(log.pieces) - 1
    shown = {0: slice(_SHOWN), (last + 1) // 2: slice(_SHOWN), last: slice(-_SHOWN, None)}
    every = sampled_every(log.stop - log.first)
    return [
        _Part(piece, slice((log.first - piece.first) % every, None, every), shown.get(k))
        for k, piece in enumerate(log.pieces)
    ]


def _score(
    whole: _Part,
    threads: int | None,
    *,
    parameters: Mapping[str, Array],
    prior: Array,
    sought: Sequence[Array],
) -> _Score:
    """Return what is known of a piece, with the torques of a part of it."""
    piece, part = whole.piece, whole.shown
    raw, motion, turned = piece.read()
    model, mask = piece.header.model, piece.mask(motion)
    names = [*parameters, "urdf", "gravity_only"]
    torques = {name: np.empty((0, model.n_rows)) for name in names}
    if len(motion.t):
        compiled = piece.header.is_compiled
        torques = predict_all(model, motion, parameters, prior, compiled=compiled)
    shown: tuple[tuple[Trajectory, Array, Mapping[str, Array]], ...] = ()
    if part is not None and len(motion.t):
        kept = {name: torque[part] for name, torque in torques.items()}
        shown = ((motion.part(*part.indices(len(motion.t))[:2]), mask[part], kept),)
    return _Score(
        sums=torque_sums(motion, mask, torques, list(parameters)),
        smooth=len(motion.t),
        used=int(mask.sum()),
        segments=frozenset(np.unique(motion.segment).tolist()),
        turned=turned,
        shown=shown,
        sampled=raw[whole.sampled],
        found=tuple(rows_in(sampled, raw) for sampled in sought),
    )


def _conclude(log: LongLog, score: _Score, *, is_refitted: bool = False) -> Evaluation:
    """Return the evaluation of a log."""
    header = log.header
    motions, masks, torques = zip(*score.shown, strict=True)
    segments, number = [], 0
    for motion in motions:  # what is shown never joins what is not beside it
        segments.append(motion.segment - motion.segment[0] + number)
        number = int(segments[-1][-1]) + 1
    joined = {
        key: np.concatenate([getattr(motion, key) for motion in motions])
        for key in ("t", "q", "v", "a", "tau", "direction")
        if getattr(motions[0], key) is not None
    }
    trajectory = replace(motions[0], **joined, segment=np.concatenate(segments))
    extent = Extent(
        samples=log.stop - log.first,
        rate=1.0 / log.step,
        start=log.start,
        end=log.end,
        smooth=score.smooth,
        rows_used=score.used,
        segments=len(score.segments),
    )
    names = [log.head.joints[j] for j in np.flatnonzero(score.turned)]
    head = log.head
    if names:
        head = replace(head, notes=(*head.notes, turns_note(names)))
    recording = Recording(head, header.signals, trajectory, np.concatenate(masks), extent)
    predicted = {name: np.concatenate([t[name] for t in torques]) for name in torques[0]}
    return conclude_sums(header.model, recording, predicted, score.sums, is_refitted=is_refitted)
