"""identify(): from a model and logs to parameters and how far they can be trusted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.base_parameters import BaseMapping, base_mapping
from robotid.data import Log
from robotid.estimator_settings import (
    ESTIMATORS,
    RECURSIVE,
    EstimatorSettings,
    Prior,
    consistent_fit,
    make_estimator,
)
from robotid.estimators import WLS, Estimate
from robotid.exceptions import DataError
from robotid.factors import Factors, compress, merge
from robotid.lumping import held_parameters
from robotid.metrics import Metrics
from robotid.model import RobotModel
from robotid.parameters import pseudo_inertia
from robotid.prior import prior_spread
from robotid.problem import Problem, concatenate
from robotid.regressor import build_problem, random_regressor
from robotid.signals import SignalSettings
from robotid.summaries import identification_html, identification_line, identification_text
from robotid.validation import Evaluation, Recording, evaluate, pool, prepare, shares_rows
from robotid.verdict import Verdict, judge

__all__ = ["ESTIMATORS", "EstimatorSettings", "Identification", "identify", "structural_mapping"]

_FROM_DATA = 0.3  # a parameter whose spread the data shrink below this share is theirs
_FROM_PRIOR = 0.9  # ... and above this share, the prior's


@dataclass(frozen=True, eq=False)
class Identification:
    """Everything that an identification found.

    Attributes:
        model: The robot as the URDF describes it.
        mapping: Standard to base parameters.
        estimator: The estimator's settings.
        estimate: What the estimator returned: base parameters, or standard ones ("consistent").
        wls: Weighted least squares on the same factors, base parameters.
        prior: Standard parameters of the URDF, shape (p,).
        prior_std: How far they may plausibly be wrong, shape (p,).
        standard: Standard parameters, shape (p,).
        standard_error: Their standard errors given the prior, shape (p,).
        base: Base parameters, shape (b,).
        base_error: Their standard errors, shape (b,); inf where the data say nothing.
        identification: The recordings that were fitted, with predictions "estimate" and "wls".
        validation: The same of the recordings that were kept apart.
        alarms: Faults of the recordings that make the result wrong, as the doctor found them.
        report: File of the report, if one was written with the result.
    """

    model: RobotModel
    mapping: BaseMapping
    estimator: EstimatorSettings
    estimate: Estimate
    wls: Estimate
    prior: Array
    prior_std: Array
    standard: Array
    standard_error: Array
    base: Array
    base_error: Array
    identification: tuple[Evaluation, ...]
    validation: tuple[Evaluation, ...]
    alarms: tuple[str, ...] = ()
    report: str = ""

    def __repr__(self) -> str:
        return identification_line(self)

    def _repr_html_(self) -> str:
        return identification_html(self)

    def summary(self) -> str:
        """Return verdict, reasons and errors by joint as text."""
        return identification_text(self)

    __str__ = summary

    @property
    def is_consistent(self) -> bool:
        """Whether every body and drive of the standard parameters is physically possible.

        A body must be so without its links on locked joints, which keep their own inertials.
        """
        size = self.model.layout.n_inertial
        J = pseudo_inertia(self.standard[:size] - held_parameters(self.model))
        signs = self.standard[self.model.layout.is_nonnegative()]
        return bool((np.linalg.eigvalsh(J) > 0).all() and (signs >= 0).all())

    @property
    def sources(self) -> tuple[str, ...]:
        """Where each standard parameter comes from: "data", "mixed" or "prior"."""
        share = self.standard_error / self.prior_std
        names = np.where(
            share < _FROM_DATA, "data", np.where(share > _FROM_PRIOR, "prior", "mixed")
        )
        return tuple(names.tolist())

    def metrics(self, name: str = "estimate") -> Metrics:
        """Return the metrics over all fitted recordings.

        Args:
            name: "estimate" or "wls".

        Returns:
            The metrics.
        """
        return pool(self.model, self.identification, name)

    @property
    def refitted(self) -> tuple[Evaluation, ...]:
        """Validation recordings that hold rows which were fitted: they show no prediction."""
        fitted = [evaluation.recording.log for evaluation in self.identification]
        return tuple(
            e for e in self.validation if any(shares_rows(e.recording.log, log) for log in fitted)
        )

    @property
    def verdict(self) -> Verdict:
        """How far to trust the result."""
        refitted = self.refitted
        kept = [e for e in self.validation if e not in refitted]
        return judge(
            self.metrics(),
            {e.recording.name: e.metrics["estimate"] for e in kept},
            undetermined=self.estimate.undetermined,
            is_consistent=self.is_consistent,
            alarms=self.alarms,
        )


def identify(
    model: RobotModel,
    logs: Sequence[Log],
    *,
    validation: Sequence[Log] = (),
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
) -> Identification:
    """Identify a robot's parameters from motion logs.

    Args:
        model: The robot, from its URDF.
        logs: Recordings to fit; their joints must be the model's, in its order.
        validation: Recordings kept apart to measure the prediction with.
        signals: How logs become trajectories; the defaults if None.
        estimator: Name or settings of the estimator.

    Returns:
        The identification.

    Raises:
        DataError: If a log does not fit the model or is too short.
        RankDeficientError: If "ols" or "wls" is asked for and the data leave parameters open.
        NotConvergedError: If a solver fails.
        SettingsError: If a setting is out of range.
    """
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    settings = signals or SignalSettings()
    if not logs:
        raise DataError("no log was given; at least one is needed to identify anything")
    fitted = [prepare(model, log, settings) for log in logs]
    kept = [prepare(model, log, settings) for log in validation]
    mapping = structural_mapping(model)
    factors = merge([compress(_problem(model, mapping, recording)) for recording in fitted])
    share = min(_independent_share(recording) for recording in fitted)
    prior = model.standard_parameters()
    spread = prior_spread(model, [recording.trajectory for recording in fitted])
    wls = WLS(prior=mapping.to_base(prior), independent_share=share).fit(factors)
    before = Prior(prior, spread, share, wls.sigma)
    estimate = _run(choice, model, mapping, before, fitted, factors, wls)
    standard, covariance = _standard(estimate, mapping, prior, spread)
    base_variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
    wls_standard = mapping.to_standard(wls.theta, prior, spread)
    candidates = {"estimate": standard, "wls": wls_standard}
    is_base = estimate.names == mapping.base_names
    return Identification(
        model=model,
        mapping=mapping,
        estimator=choice,
        estimate=estimate,
        wls=wls,
        prior=prior,
        prior_std=spread,
        standard=standard,
        standard_error=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        base=mapping.to_base(standard),
        # exact data leave a variance of rounding size, of either sign
        base_error=estimate.std_error if is_base else np.sqrt(np.maximum(base_variance, 0.0)),
        identification=tuple(evaluate(model, r, candidates, prior) for r in fitted),
        validation=tuple(evaluate(model, r, candidates, prior) for r in kept),
    )


def structural_mapping(model: RobotModel, *, inertial_only: bool = False) -> BaseMapping:
    """Return the base parameters that any motion of a robot can show.

    Args:
        model: The robot.
        inertial_only: Whether to leave the drive terms out.

    Returns:
        The mapping; always the same for the same robot.
    """
    columns = model.layout.n_inertial if inertial_only else len(model.layout.names)
    samples = 2 * columns // model.n_rows + 20
    W = random_regressor(model, samples, np.random.default_rng(0))
    return base_mapping(
        W[:, :columns],
        model.layout.names[:columns],
        scales=model.layout.scales(model.length)[:columns],
        preference=model.layout.preference()[:columns],
    )


def _run(
    choice: EstimatorSettings,
    model: RobotModel,
    mapping: BaseMapping,
    prior: Prior,
    recordings: Sequence[Recording],
    factors: Factors,
    wls: Estimate,
) -> Estimate:
    """Return the estimate: batch estimators read the factors, recursive ones the samples."""
    estimator = make_estimator(choice, model, mapping, prior)
    if choice.name not in RECURSIVE:
        return estimator.fit(factors)
    problems = [_problem(model, mapping, r, choice.needs_mass) for r in recordings]
    estimate = estimator.fit(concatenate(problems))
    if choice.name in ("prx", "gradient"):
        estimate = _with_spread(estimate, wls)
    if not choice.physical:
        return estimate
    return consistent_fit(choice, model, mapping, prior).project(estimate)


def _problem(
    model: RobotModel, mapping: BaseMapping, recording: Recording, with_mass: bool = False
) -> Problem:
    weight = recording.mask.astype(float)
    return mapping.reduce(build_problem(model, recording.trajectory, weight, with_mass=with_mass))


def _with_spread(estimate: Estimate, wls: Estimate) -> Estimate:
    """Return a gradient method's estimate with the covariance that the factors know.

    It ends beside the minimum of least squares: its mean square error is the covariance of that
    minimum plus the square of the distance to it, which is measured.
    """
    distance = estimate.theta - wls.theta
    covariance = wls.covariance + np.outer(distance, distance)
    reason = "standard errors are those of wls plus the distance to it"
    return replace(
        estimate,
        covariance=covariance,
        rank=wls.rank,
        condition=wls.condition,
        undetermined=wls.undetermined,
        message=estimate.message.split("; a gradient method")[0] + f"; {reason}",
    )


def _independent_share(recording: Recording) -> float:
    """Return the share of rows that are independent behind the filter: its band over Nyquist's."""
    signals = recording.signals
    if signals.cutoff is None or signals.rate is None:
        return 1.0
    return min(1.0, 2.0 * signals.cutoff / signals.rate)


def _standard(
    estimate: Estimate, mapping: BaseMapping, prior: Array, spread: Array
) -> tuple[Array, Array]:
    """Return the standard parameters and their covariance, prior included."""
    if estimate.names == mapping.names:
        return estimate.theta, estimate.covariance
    G, K = mapping.gain(spread), mapping.K
    before = np.diag(spread**2)
    # what the data leave open (infinite variance) stays as wide as the prior has it
    base = np.where(np.isfinite(estimate.covariance), estimate.covariance, K @ before @ K.T)
    covariance = before - G @ K @ before + G @ base @ G.T
    return mapping.to_standard(estimate.theta, prior, spread), covariance
