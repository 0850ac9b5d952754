"""What an identification asks of its logs: their factors, their samples, their predictions.

Logs in memory are one implementation, long logs read in pieces another.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from robotid._typing import Array
from robotid.identification.evaluation import Evaluation, Recording, evaluate, shares_rows
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import compress_stretches
from robotid.regressor.problem import Problem, concatenate
from robotid.regressor.reduction import Reduction
from robotid.regressor.torque import build_problem
from robotid.robot.model import RobotModel

__all__ = ["LoadedRecordings", "Recordings", "base_problem", "independent_share"]


_STRETCHES = 48  # of all logs together: enough to see how much their scores scatter
_CORRELATIONS = 10  # shortest stretch in correlation times of noise behind the filter


class Recordings(ABC):
    """The logs of an identification: those to fit, and those kept apart."""

    @property
    @abstractmethod
    def share(self) -> float:
        """Share of the fitted rows that count as independent [-]."""

    @abstractmethod
    def reduce(self, mapping: BaseMapping) -> tuple[Reduction, ...]:
        """Reduce the logs to fit.

        Args:
            mapping: Standard to base parameters.

        Returns:
            One reduction per stretch of a log, in order of time.

        Raises:
            DataError: If a row cannot be used.
        """

    @abstractmethod
    def problem(self, mapping: BaseMapping, *, with_mass: bool = False) -> Problem:
        """Return the rows of the logs to fit, for estimators that read them in order of time.

        Args:
            mapping: Standard to base parameters.
            with_mass: Whether each sample also carries the regressor of its mass matrix.

        Returns:
            The base problem.
        """

    @abstractmethod
    def evaluate(
        self, parameters: Mapping[str, Array], prior: Array
    ) -> tuple[tuple[Evaluation, ...], tuple[Evaluation, ...]]:
        """Return how well parameters predict every log.

        Args:
            parameters: Standard parameters by name, each of shape (p,).
            prior: Those of the URDF, shape (p,).

        Returns:
            Evaluations of the fitted logs, and of those kept apart.

        Raises:
            DataError: If no row of a log is used.
        """


@dataclass(frozen=True, eq=False)
class LoadedRecordings(Recordings):
    """Logs in memory.

    Attributes:
        model: The robot.
        fitted: Recordings to fit.
        kept: Recordings kept apart.
        weights: Weights of the rows of each recording to fit, shapes (N, n_rows); 1 if None.
    """

    model: RobotModel
    fitted: Sequence[Recording]
    kept: Sequence[Recording]
    weights: tuple[Array, ...] | None = None

    def _row_weights(self) -> list[Array]:
        masks = [recording.mask.astype(float) for recording in self.fitted]
        if self.weights is None:
            return masks
        return [mask * weight for mask, weight in zip(masks, self.weights, strict=True)]

    @property
    def share(self) -> float:
        """See ``Recordings.share``."""
        return min(independent_share(recording.signals) for recording in self.fitted)

    def reduce(self, mapping: BaseMapping) -> tuple[Reduction, ...]:
        """See ``Recordings.reduce``.

        Args:
            mapping: Standard to base parameters.

        Returns:
            One reduction per stretch, each longer than the correlation of filtered noise.
        """
        count = -(-_STRETCHES // len(self.fitted))
        reductions: list[Reduction] = []
        for recording, weight in zip(self.fitted, self._row_weights(), strict=True):
            motion = recording.trajectory
            shortest = round(_CORRELATIONS / independent_share(recording.signals))
            length = max(-(-len(motion.t) // count), shortest)
            problem = base_problem(self.model, mapping, motion, weight)
            for k, factors in enumerate(compress_stretches(problem, length)):
                part = motion.part(k * length, (k + 1) * length)
                reductions.append(Reduction(factors, part.squares, len(part.t)))
        return tuple(reductions)

    def problem(self, mapping: BaseMapping, *, with_mass: bool = False) -> Problem:
        """See ``Recordings.problem``.

        Args:
            mapping: Standard to base parameters.
            with_mass: Whether each sample also carries the regressor of its mass matrix.

        Returns:
            The base problem.
        """
        return concatenate(
            [
                base_problem(self.model, mapping, r.trajectory, weight, with_mass=with_mass)
                for r, weight in zip(self.fitted, self._row_weights(), strict=True)
            ]
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
        """
        fitted, kept = (
            [evaluate(self.model, r, parameters, prior) for r in recordings]
            for recordings in (self.fitted, self.kept)
        )
        again = [any(shares_rows(k.log, f.log) for f in self.fitted) for k in self.kept]
        return tuple(fitted), tuple(
            replace(evaluation, is_refitted=is_refitted)
            for evaluation, is_refitted in zip(kept, again, strict=True)
        )


def base_problem(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    weight: Array,
    *,
    with_mass: bool = False,
    compiled: bool | None = None,
) -> Problem:
    """Return the problem of a trajectory in base parameters.

    Args:
        model: The robot.
        mapping: Standard to base parameters.
        trajectory: N samples.
        weight: Weight of each row, shape (N, n_rows); or which rows are used, bool.
        with_mass: As of ``build_problem``.
        compiled: As of ``build_problem``.

    Returns:
        The problem.

    Raises:
        DataError: If the trajectory's joints are not the model's.
    """
    rows = weight.astype(float)
    problem = build_problem(model, trajectory, rows, with_mass=with_mass, compiled=compiled)
    return mapping.reduce(problem)


def independent_share(signals: SignalSettings) -> float:
    """Return the share of rows that are independent behind the filter: its band over Nyquist's.

    Args:
        signals: The settings, resolved.

    Returns:
        The share, at most 1.
    """
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)
