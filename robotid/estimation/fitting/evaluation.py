"""Predicted torques of recordings and their errors; logs in files are processed in pieces."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from robotid.base.exceptions import DataError, RankDeficientError
from robotid.base.text import period
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory, alike_motions
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import turns_note
from robotid.dynamics.factors import Factors, merge
from robotid.dynamics.torque import predict
from robotid.estimation.fitting.recorded import LogPiece, SurveyedLog
from robotid.estimation.work_plan import WorkPlan
from robotid.robot.model import RobotModel

_SHOWN = 10_000  # samples at the start, in the middle and at the end that are stored for plots
_SAMPLED = 200  # rows spread over a log that are searched for in other logs
_SHARED = 0.02  # share of them that another log may contain: adjacent windows share a row
LEFT_OUT = ", left out of the fit"  # end of the name of a log that a fit to the others predicts
FEWEST_LEFT_OUT = 3  # smallest number of different motions of which each is predicted by the others
_FITS = 10  # largest number of fits; more motions are left out together


@dataclass(frozen=True)
class JointMetrics:
    """Prediction error of the torque or the position of one joint over the rows used."""

    rmse: float  # root mean square of the residual [unit]
    unit: str  # N m or rad; N or m for a prismatic joint
    #: 100 |tau - prediction| / |tau| [%]; 100 for a prediction of 0. For a position, relative to
    #: its motion about the mean. None if the measured signal is 0.
    relative_error_pct: float | None
    r2: float  # share of the variance that the prediction explains [-]
    rows: int  # number of rows used
    baselines: Mapping[str, float | None]  # relative_error_pct of other predictions, by name [%]
    better_than_constant: bool  # whether the residual is smaller than that of the mean

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as they are written to result.json."""
        content = dict(vars(self))
        baselines = content.pop("baselines").items()
        return content | {f"{name}_relative_error_pct": error for name, error in baselines}


@dataclass(frozen=True)
class Metrics:
    """Metrics of every joint of one recording."""

    per_joint: Mapping[str, JointMetrics]  # by name of the joint; joints without rows are not in it
    pooled_rmse: float  # root mean square of the residuals of all joints together [N m, N]

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> "Metrics":
        """Return metrics that were written to result.json."""
        per_joint, end = {}, "_relative_error_pct"
        for joint, values in content["per_joint"].items():
            own = {key: value for key, value in values.items() if not key.endswith(end)}
            baselines = {key.removesuffix(end): values[key] for key in values.keys() - own.keys()}
            per_joint[joint] = JointMetrics(**own, baselines=baselines)
        return cls(per_joint, content["pooled_rmse"])

    def to_dict(self) -> dict[str, Any]:
        """Return the metrics as they are written to result.json."""
        per_joint = {joint: m.to_dict() for joint, m in self.per_joint.items()}
        return {"per_joint": per_joint, "pooled_rmse": self.pooled_rmse}


@dataclass(frozen=True, eq=False)
class TorqueSums:
    """Sums from which the metrics of a prediction are computed; those of two recordings merge."""

    rows: Array  # (n,), number of rows used per joint, int
    mean: Array  # (n,), mean of the measured torque over them [N m, N]
    spread: Array  # (n,), sum of squared deviations of the torque from the mean
    torque: Array  # (n,), sum of squares of the torque
    residual: Array  # (n,), sum of squared residuals of the prediction
    baselines: Mapping[str, Array]  # (n,), sums of squared residuals of other predictions

    @classmethod
    def of(
        cls, tau: Array, prediction: Array, mask: Array, baselines: Mapping[str, Array]
    ) -> "TorqueSums":
        """Return the sums over the rows used; all arguments (N, n)."""
        rows = mask.sum(axis=0)
        mean = np.sum(tau, axis=0, where=mask) / np.maximum(rows, 1)

        def squares(values: Array) -> Array:
            return np.asarray(np.sum(values**2, axis=0, where=mask))

        others = {name: squares(tau - torque) for name, torque in baselines.items()}
        return cls(rows, mean, squares(tau - mean), squares(tau), squares(tau - prediction), others)

    def merge(self, other: "TorqueSums") -> "TorqueSums":
        """Return the sums over the rows of both (Chan, Golub, LeVeque, 1983, variance, (2.1))."""
        rows = self.rows + other.rows
        share = other.rows / np.maximum(rows, 1)
        step = other.mean - self.mean
        mean, between = self.mean + share * step, step**2 * self.rows * share
        baselines = {name: x + other.baselines[name] for name, x in self.baselines.items()}
        return TorqueSums(
            rows, mean, self.spread + other.spread + between, self.torque + other.torque,
            self.residual + other.residual, baselines,
        )  # fmt: skip

    def metrics(self, names: Sequence[str], units: Sequence[str]) -> Metrics:
        """Return the metrics computed from the sums."""
        if not self.rows.any():
            raise DataError(
                "the prediction error cannot be computed, 0 torque rows are used: no joint moves "
                "faster than min_velocity; lower min_velocity, or use a log with motion"
            )
        per_joint = {name: self._joint(j, units[j]) for j, name in enumerate(names) if self.rows[j]}
        return Metrics(per_joint, float(np.sqrt(self.residual.sum() / self.rows.sum())))

    def _joint(self, j: int, unit: str) -> JointMetrics:
        residual, spread = float(self.residual[j]), float(self.spread[j])
        return JointMetrics(
            rmse=float(np.sqrt(residual / self.rows[j])), unit=unit, rows=int(self.rows[j]),
            relative_error_pct=self._relative_error(j, residual),
            r2=1.0 - residual / spread if spread > 0 else 0.0,
            baselines={x: self._relative_error(j, float(s[j])) for x, s in self.baselines.items()},
            better_than_constant=residual < spread,
        )  # fmt: skip

    def _relative_error(self, j: int, residual: float) -> float | None:
        return 100.0 * float(np.sqrt(residual / self.torque[j])) if self.torque[j] > 0 else None


@dataclass(frozen=True)
class Extent:
    """Size of a log."""

    samples: int  # number of rows of the log
    rate: float  # median sampling rate [Hz]
    start: float  # first time stamp [s]
    end: float  # last time stamp [s]
    smooth: int  # number of samples of the smoothed trajectory
    rows_used: int  # number of torque rows used
    segments: int  # number of uninterrupted segments of the trajectory


@dataclass(frozen=True, eq=False)
class Recording:
    """A log processed for a model. Of a long log, only some segments are in memory."""

    log: Log  # the raw log, or its first rows
    signals: SignalSettings  # the settings of the processing, automatic settings resolved
    trajectory: Trajectory  # the smoothed motion or segments of it, N samples
    mask: Array  # (N, n_rows), rows used, bool
    extent: Extent  # size of the whole log

    @property
    def name(self) -> str:
        """Name of the log's file and its time range, as ``run3.parquet 5-7.4 s``."""
        file = Path(self.log.path).name or "log"
        return f"{file} {period(self.extent.start, self.extent.end)}"

    @property
    def is_partial(self) -> bool:
        """Whether only segments of the motion are in memory."""
        return len(self.trajectory.t) < self.extent.smooth


class Evaluated(Protocol):
    """A recording with predictions and their errors: of torques, or of simulated positions."""

    @property
    def log(self) -> Log: ...  # the log, or its first rows

    @property
    def extent(self) -> Extent: ...  # of the whole log

    @property
    def metrics(self) -> Mapping[str, Metrics]: ...  # over the whole log, by name of the parameters

    @property
    def name(self) -> str: ...  # name of the log's file and its time range

    def to_dict(self, name: str = "estimate") -> dict[str, Any]:
        """Return the log and its metrics as plain values, as result.json has them."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A recording with its predicted torques."""

    recording: Recording
    #: Predicted torques by name of the parameters, each of shape (N, n_rows) [N m, N]; they include
    #: the baselines "urdf", "gravity_only" and "urdf_with_drives".
    torques: Mapping[str, Array]
    #: Sums over the whole log from which the metrics are computed, by name of the parameters,
    #: without the baselines.
    sums: Mapping[str, TorqueSums]
    metrics: Mapping[str, Metrics]  # metrics over the whole log, likewise
    is_refitted: bool = False  # whether it is a validation recording that contains fitted rows

    @property
    def log(self) -> Log:
        return self.recording.log

    @property
    def extent(self) -> Extent:
        return self.recording.extent

    @property
    def name(self) -> str:
        return self.recording.name

    def to_dict(self, name: str = "estimate") -> dict[str, Any]:
        """Return the log and its metrics as plain values, as result.json has them."""
        return {"log": self.log.path, "name": self.name, **self.metrics[name].to_dict()}


def evaluate_logs(
    fitted: Sequence[SurveyedLog],
    validation: Sequence[SurveyedLog],
    parameters: Mapping[str, Array],
    prior: Array | None,
    driven: Array | None = None,
    *,
    plan: WorkPlan | None = None,
) -> tuple[tuple[Evaluation, ...], tuple[Evaluation, ...]]:
    """Return the torques that parameters (p,) predict for logs, and their metrics.

    The URDF's parameters, ``prior``, and with fitted drives, ``driven``, are the baselines.
    """
    work = partial(_score, parameters=parameters, prior=prior, driven=driven)
    new = _score_logs(validation, work, plan)
    sought = [np.concatenate([score.sampled for score in scores]) for scores in new]
    old = _score_logs(fitted, partial(work, sought=sought), plan)
    is_refitted = [
        any(_is_shared(np.any([score.found[k] for score in scores], axis=0)) for scores in old)
        for k in range(len(new))
    ]
    return (
        tuple(map(_evaluation_of, fitted, old)),
        tuple(map(_evaluation_of, validation, new, is_refitted)),
    )


def shares_rows(one: Log, other: Log) -> bool:
    """Return whether two logs contain the same recorded rows, whatever the names of their files."""
    rows, others = (np.hstack([log.q, log.tau]) for log in (one, other))
    return _is_shared(_rows_in(rows[:: _sampled_every(len(rows))], others))


def pool(model: RobotModel, evaluations: Sequence[Evaluation], name: str) -> Metrics:
    """Return the metrics over several recordings together."""
    together = reduce(TorqueSums.merge, [evaluation.sums[name] for evaluation in evaluations])
    return together.metrics(model.row_names, model.row_units)


def hidden_joints(model: RobotModel, evaluations: Sequence[Evaluation]) -> tuple[str, ...]:
    """Return the joints of a static model whose gravity torque is less than their residual."""
    if not model.is_static or not evaluations:
        return ()
    metrics = pool(model, evaluations, "estimate").per_joint
    torque = np.vstack([e.torques["estimate"] for e in evaluations])
    used = np.vstack([e.recording.mask for e in evaluations])
    hidden = tuple(
        row
        for j, row in enumerate(model.row_names)
        if row in metrics and np.std(torque[used[:, j], j]) <= metrics[row].rmse
    )
    return hidden if len(hidden) < len(metrics) else ()


@dataclass(frozen=True, eq=False)
class _Score:
    """Result of a piece of a log."""

    sums: Mapping[str, TorqueSums]  # from which the metrics are computed, by parameters
    smooth: int  # samples
    used: int  # torque rows used
    segments: frozenset[int]  # numbers of the segments that have samples
    turned: Array  # (n,), bool: joints whose position was unwrapped
    shown: tuple[Trajectory, Array, Mapping[str, Array]] | None  # motion, rows used, torques
    sampled: Array  # (m, 2 n), recorded rows spread over the log
    found: tuple[Array, ...]  # which of the sampled rows of each other log are in this one


def _score_logs(
    logs: Sequence[SurveyedLog], work: "partial[_Score]", plan: WorkPlan | None
) -> list[list[_Score]]:
    """Return the results of the pieces of each log; raise an error for a log without samples."""
    pieces = [piece for log in logs for piece in log.pieces]
    results = (
        (work(x, None) for x in pieces) if plan is None else plan.map(work, pieces, "evaluating")
    )
    scores = []
    for log in logs:
        by_piece = list(islice(results, len(log.pieces)))
        filled = [k for k, score in enumerate(by_piece) if score.smooth]
        if not filled:
            raise log.too_short()
        if not any(score.shown for score in by_piece):  # the chosen pieces have no samples
            k = filled[0]
            by_piece[k] = work(log.pieces[k], None, shown_rows=slice(_SHOWN))
        scores.append(by_piece)
    return scores


def _score(
    piece: LogPiece, threads: int | None, *, parameters: Mapping[str, Array], prior: Array | None,
    driven: Array | None, sought: Sequence[Array] = (), shown_rows: slice | None = None,
) -> _Score:  # fmt: skip
    """Return the result of a piece, with the torques of the rows that are shown."""
    rows, model = piece.read(), piece.model
    motion, mask = rows.trajectory, rows.mask
    of_urdf = {"urdf": prior, "urdf_with_drives": driven}
    moving = {name: pi for name, pi in of_urdf.items() if pi is not None}
    torques = _predict_all(model, motion, {**parameters, **moving}, prior, piece.is_compiled)
    baselines = {x: torques[x] for x in ("gravity_only", *moving) if x in torques}
    shown, shown_rows = None, shown_rows or _shown_rows(piece)
    if shown_rows is not None and len(motion.t):
        start, stop, _ = shown_rows.indices(len(motion.t))
        stored = {name: torque[start:stop] for name, torque in torques.items()}
        # the whole motion is used as it is, with its cached properties
        is_whole = stop - start == len(motion.t)
        shown = motion if is_whole else motion.at(slice(start, stop)), mask[start:stop], stored
    recorded = np.hstack([rows.positions, rows.torques])
    measured = mask & [name not in model.passive for name in model.row_names]
    first, stop = piece.log_rows
    every = _sampled_every(stop - first)
    return _Score(
        sums={x: TorqueSums.of(motion.tau, torques[x], measured, baselines) for x in parameters},
        smooth=len(motion.t), used=int(mask.sum()), turned=rows.turned, shown=shown,
        segments=frozenset(np.unique(motion.segment).tolist()),
        sampled=recorded[(first - piece.first) % every :: every],
        found=tuple(_rows_in(sampled, recorded) for sampled in sought),
    )  # fmt: skip


def _shown_rows(piece: LogPiece) -> slice | None:
    """Return the samples for plots: all in memory, else some of first, middle and last piece."""
    k, count = piece.number
    if isinstance(piece.source, Log):
        return slice(None)
    if k == count - 1:
        return slice(-_SHOWN, None)
    return slice(_SHOWN) if k in (0, count // 2) else None


def _predict_all(
    model: RobotModel, trajectory: Trajectory, parameters: Mapping[str, Array],
    prior: Array | None, compiled: bool | None,
) -> dict[str, Array]:  # fmt: skip
    """Return the torques by each set of parameters and by the URDF's gravity, (N, n_rows) each."""
    names = [*parameters] if prior is None else [*parameters, "gravity_only"]
    if not len(trajectory.t) or not names:
        return {name: np.empty((0, model.n_rows)) for name in names}
    torques = predict(model, [*parameters.values()], trajectory, compiled=compiled)
    if prior is not None:
        inertial = np.where(np.arange(len(prior)) < model.layout.n_inertial, prior, 0.0)
        still = np.zeros_like(trajectory.v)
        at_rest = replace(trajectory, v=still, a=still, direction=None)  # without drive torques
        torques += predict(model, [inertial], at_rest, compiled=compiled)
    return dict(zip(names, torques, strict=True))


def _evaluation_of(
    log: SurveyedLog, scores: Sequence[_Score], is_refitted: bool = False
) -> Evaluation:
    """Return the evaluation of a log from the results of its pieces."""
    shown = [score.shown for score in scores if score.shown is not None]
    motions, masks, torques = zip(*shown, strict=True)
    start, end = (float(log.stamps[k]) for k in (log.first, log.stop - 1))
    extent = Extent(
        log.stop - log.first, 1.0 / log.step, start, end,
        smooth=sum(score.smooth for score in scores),
        rows_used=sum(score.used for score in scores),
        segments=len(frozenset.union(*(score.segments for score in scores))),
    )  # fmt: skip
    head, model = log.head, log.model
    turned = np.any([score.turned for score in scores], axis=0)
    if turned.any():
        note = turns_note([head.joints[j] for j in np.flatnonzero(turned)])
        head = replace(head, notes=(*head.notes, note))
    recording = Recording(head, log.signals, _joined(motions), np.concatenate(masks), extent)
    predicted = {name: np.concatenate([t[name] for t in torques]) for name in torques[0]}
    sums = {x: reduce(TorqueSums.merge, [s.sums[x] for s in scores]) for x in scores[0].sums}
    metrics = {x: total.metrics(model.row_names, model.row_units) for x, total in sums.items()}
    return Evaluation(recording, predicted, sums, metrics, is_refitted)


def _joined(motions: Sequence[Trajectory]) -> Trajectory:
    """Return the motions as one trajectory, each with segments of its own."""
    if len(motions) == 1:
        return motions[0]
    segments, number = [], 0
    for motion in motions:
        segments.append(np.unique(motion.segment, return_inverse=True)[1] + number)
        number = int(segments[-1][-1]) + 1
    joined: dict[str, Any] = {
        key: np.concatenate([getattr(motion, key) for motion in motions])
        for key in ("t", "q", "v", "a", "tau", "direction", "memory")
        if getattr(motions[0], key) is not None
    }
    return replace(motions[0], **joined, segment=np.concatenate(segments))


def _sampled_every(rows: int) -> int:
    """Return the step between sampled rows of a log."""
    return max(1, rows // _SAMPLED)


def _rows_in(sampled: Array, rows: Array) -> Array:
    """Return which sampled rows (m, 2 n) of positions and torques are among rows, shape (m,)."""
    is_in = np.isin(sampled[:, 0], rows[:, 0])
    likely = rows[np.isin(rows[:, 0], sampled[is_in, 0])]
    for k in np.flatnonzero(is_in):  # a row at rest occurs more than once
        is_in[k] = (likely == sampled[k]).all(axis=1).sum() == 1
    return is_in


def _is_shared(is_in: Array) -> bool:
    """Return whether enough sampled rows are in another log to call it the same recording."""
    return int(is_in.sum()) > max(1, _SHARED * len(is_in))


def left_out_metrics(
    model: RobotModel,
    logs: Sequence[Sequence[Factors]],
    fitted: Sequence[Evaluation],
    fit: Callable[[Factors], tuple[Array, Array]],
) -> dict[str, Metrics]:
    """Return the metrics of each log as a fit to the others predicts it, by its name.

    Logs that repeat a motion are left out together. A fit returns the parameters (p,), and those of
    the URDF with drives.
    """
    if any(e.recording.is_partial for e in fitted):
        return {}
    motions = alike_motions([e.recording.trajectory for e in fitted])
    if len(motions) < FEWEST_LEFT_OUT:
        return {}
    metrics = {}
    for first in range(min(_FITS, len(motions))):
        out = {k for motion in motions[first::_FITS] for k in motion}
        others = merge([part for k, log in enumerate(logs) if k not in out for part in log])
        try:
            pi, driven = fit(others)
        except RankDeficientError:  # of "ols" and "wls": not evaluated, which the verdict states
            continue
        for k in sorted(out):
            recording, torques = fitted[k].recording, fitted[k].torques
            motion = recording.trajectory
            torque, by_urdf = predict(model, [pi, driven], motion)
            baselines = {x: torques[x] for x in ("gravity_only", "urdf") if x in torques}
            baselines["urdf_with_drives"] = by_urdf
            sums = TorqueSums.of(motion.tau, torque, recording.mask, baselines)
            metrics[recording.name + LEFT_OUT] = sums.metrics(model.row_names, model.row_units)
    return metrics


def logs_that_test(names: Collection[str]) -> str:
    """Return what the logs are that test a prediction, as text."""
    is_left_out = bool(names) and all(name.endswith(LEFT_OUT) for name in names)
    return "logs left out of the fit in turn" if is_left_out else "validation logs"
