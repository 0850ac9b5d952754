"""What a motion will tell before it is recorded: the standard errors to be expected of it.

The motion goes the way of a log, with the torque that the model predicts for it: filter, rows used,
factors and base parameters are those of an identification. What is not known before is the noise.
One of standard deviation s, correlated over the time T, has the density S = s^2 T, white noise T =
one sample. Behind the filter it leaves a residual of variance s_j^2 <= S_j 2 B, B the filter's
band, but however few of the r rows a second are then independent, the score of a joint,
W_j^T (tau_j - W_j theta) / s_j^2, varies by S_j r W_j^T W_j / s_j^4: W_j is slow, and slow noise
passes the filter. With the bread (sum_j W_j^T W_j / s_j^2)^-1 that is the covariance of weighted
least squares, and with the prior's information that of a consistent fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid._settings import require_kind
from robotid._typing import Array
from robotid.doctor.motions import excitation_finding
from robotid.estimators import Estimate
from robotid.estimators.batch import solve_factor
from robotid.estimators.determination import base_spread, determine
from robotid.estimators.segments import FEWEST_SEGMENTS, scatter
from robotid.exceptions import DataError
from robotid.findings import listed
from robotid.fitting.bands import TorqueBand, expected_band
from robotid.fitting.estimators import Known, consistent_fit
from robotid.fitting.evaluation import evaluate_logs
from robotid.fitting.recordings import Recordings
from robotid.fitting.settings import ConsistentSettings, EstimatorSettings
from robotid.fitting.standard_errors import StandardErrors, about_prior, standard_of
from robotid.fitting.survey import SurveyedLog, hold_log
from robotid.identification.assumptions import (
    FAINTEST,
    TorqueNoise,
    assumed_noise,
    assumed_parameters,
    largest_torques,
)
from robotid.identification.result import Identification
from robotid.logs.read import Readable, read_logs
from robotid.logs.settings import SignalSettings
from robotid.logs.smoothing import low_pass
from robotid.regressor.base_parameters import BaseMapping, structural_mapping
from robotid.regressor.factors import Factors, compress, join, merge
from robotid.regressor.prediction import predict
from robotid.regressor.used_rows import base_problem, independent_share
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

__all__ = ["Preview", "Run", "preview", "preview_logs"]

#: The same of a consistent fit's prior where "auto" weighs it, and what is plausible beside that:
#: the heaviest weight that held-out segments do not reject, of robots as far from their URDF.
_WEIGHT = (10.0, 1.0)
_EXACT = 1e-9  # share of the largest residual that every joint has at least
_LEAST_FREE = 0.1  # share of a joint's rows that are left to tell its noise, at least
_IMPULSE = 40.0  # periods of the filter after which nothing is left of an impulse


@dataclass(frozen=True, eq=False)
class Run:
    """What was recorded and identified before.

    Attributes:
        segments: Factors of its segments, base parameters.
        standard: The parameters found, shape (p,).
        squares: As of ``Reduction``.
        samples: As of ``Reduction``.
        share: Share of its rows that count as independent [-].
        step: Time between two rows [s].
        weight: Weight of the prior that its fit chose, and the plausible one; None if it chose
            none.
    """

    segments: tuple[Factors, ...]
    standard: Array
    squares: Array
    samples: int
    share: float
    step: float
    weight: tuple[float, float] | None = None

    @classmethod
    def of(cls, recordings: Recordings, standard: Array, details: Mapping[str, Any]) -> "Run":
        """Return the run of logs that were identified before.

        Args:
            recordings: Its fitted logs, of the model with the friction found.
            standard: The parameters found, shape (p,).
            details: Those of its estimate.

        Raises:
            DataError: If a log cannot be used.
        """
        reductions = recordings.reduce()
        whole = join(reductions)
        segments = tuple(part.factors for part in reductions if part.factors.rows.any())
        step = float(np.mean([_row_step(log) for log in recordings.fitted]))
        prior = details.get("prior")
        weight = None if prior is None else (prior["weight"], prior.get("plausible_weight", 1.0))
        return cls(segments, standard, whole.squares, whole.samples, recordings.share, step, weight)

    @property
    def factors(self) -> Factors:
        """Those of all segments together."""
        return merge(self.segments)

    def noise(self, K: Array) -> TorqueNoise:
        """Return the noise that it shows: its residuals, correlated as their scores scatter.

        The score of a joint scatters otherwise in each direction; what it does to the parameters
        that the joint tells most of, in the geometric mean, stands for all.

        Args:
            K: Map to the base parameters, shape (b, p).
        """
        factors, beta = self.factors, K @ self.standard
        sigma = np.sqrt(factors.residual_squares(beta) / np.maximum(factors.rows, 1))
        sigma = np.maximum(sigma, _EXACT * max(float(sigma.max()), _EXACT))
        bread = solve_factor(factors, sigma, beta).covariance
        inflation = np.full(len(sigma), 1.0 / self.share)
        if len(self.segments) >= FEWEST_SEGMENTS:
            for j in np.flatnonzero(factors.rows):
                alone = np.where(np.arange(len(sigma)) == j, sigma, np.inf)
                own = np.diag(bread @ factors.information(alone**-2.0) @ bread)
                share = own / np.diag(bread)  # of each parameter's variance, by this joint
                told = share > FAINTEST
                scattered = np.diag(scatter(self.segments, beta, alone, bread).covariance)
                ratio = np.log(scattered[told] / own[told])
                inflation[j] = np.exp(np.average(ratio, weights=share[told]))
        spent = factors.leverages(bread) / sigma**2
        free = np.maximum(1.0 - spent / np.maximum(factors.rows, 1), _LEAST_FREE)
        # its density is sigma^2 inflation step, whatever its standard deviation is
        return TorqueNoise(
            sigma / np.sqrt(free), free * inflation * self.step, ("found",) * len(sigma)
        )

    def meat(self, K: Array, sigma: Array) -> Array:
        """Return the covariance of its score for rows so weighted, shape (b, b).

        Args:
            K: Map to the base parameters, shape (b, p).
            sigma: Noise level per joint, shape (n,) [N m or N].
        """
        factors, beta = self.factors, K @ self.standard
        if len(self.segments) < FEWEST_SEGMENTS:
            return factors.information(1.0 / sigma**2) / self.share
        bread = solve_factor(factors, sigma, beta).covariance
        return scatter(self.segments, beta, sigma, bread).meat


@dataclass(frozen=True, eq=False)
class Preview:
    """What motions will tell.

    Attributes:
        expected: The identification to be expected: it predicts their torque exactly, and has the
            standard errors, sources and bands that noise would leave it.
        noise: The noise of the torque.
        before: Standard errors of the base parameters by the run before alone, shape (b,), inf
            where it said nothing; None if there was none.
    """

    expected: Identification
    noise: TorqueNoise
    before: Array | None = None

    def __repr__(self) -> str:
        known, found = self.expected.determination, self.expected
        return (
            f"<Preview of {found.model.name}: {known.rank} of {len(known.names)} base parameters "
            f"determined by {len(found.fitted)} motions>"
        )

    @property
    def base_error(self) -> Array:
        """Standard errors of the base parameters, shape (b,); inf where nothing is said."""
        return self.expected.base_error

    @property
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters given the prior, shape (p,)."""
        return self.expected.standard_error

    @property
    def gain(self) -> Array | None:
        """Factor by which the base parameters' standard errors fall, shape (b,); None of no run."""
        if self.before is None:
            return None
        before, after = (np.minimum(x, self.plausible) for x in (self.before, self.base_error))
        gain: Array = before / after
        return gain

    @property
    def plausible(self) -> Array:
        """How far the base parameters may plausibly lie from the URDF's, shape (b,)."""
        return base_spread(self.expected.mapping.K, self.expected.prior_std)

    @property
    def bands(self) -> tuple[TorqueBand, ...]:
        """How far each motion's predicted torques could be trusted."""
        return tuple(expected_band(self.expected, e) for e in self.expected.fitted)

    @property
    def words(self) -> str:
        """What the motions determine, and what they leave open."""
        found = self.expected
        names = listed(dict.fromkeys(e.recording.log.name for e in found.fitted))
        return excitation_finding(found.wls, found.determination, names).message


def preview(
    model: RobotModel | str | Path,
    motions: Readable | Sequence[Readable],
    *,
    noise: TorqueNoise | Mapping[str, float] | None = None,
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
    given: Identification | None = None,
) -> Preview:
    """Return the standard errors to be expected of motions, before they are recorded.

    Args:
        model: The robot; or the path of its URDF, all of whose joints move. With a run before, the
            robot is that run's.
        motions: The motions: a ``Log``, whose torques are ignored, the path of a file with
            positions, a DataFrame, or several of these.
        noise: Standard deviation of the torque's noise by joint [N m or N], of those that it is
            known of, or all about it; as of ``assumed_noise`` for the others, or as a run before
            has it.
        signals: How logs become trajectories; those of the run before, or the defaults, if None.
        estimator: Name or settings of the estimator.
        given: A run that was identified before, which adds what it said.

    Raises:
        DataError: If a motion cannot be read, does not fit the model or is too short.
        SettingsError: If a setting is out of range, or a joint is unknown.
    """
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    require_kind(
        estimator, (str, EstimatorSettings), "estimator", "a name or a robotid.EstimatorSettings"
    )
    require_kind(
        noise, (TorqueNoise, Mapping, type(None)), "noise", "a TorqueNoise, or numbers by joint"
    )
    require_kind(given, (Identification, type(None)), "given", "a robotid.Identification, or none")
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    settings, run = signals or SignalSettings(), None
    model = model if isinstance(model, RobotModel) else RobotModel.from_urdf(model)
    if given is not None:
        model, settings = given.model, signals or given.asked.signals
        logs = [hold_log(model, e.recording.log, e.recording.signals) for e in given.fitted]
        recordings = Recordings(model, given.mapping, logs)
        run = Run.of(recordings, given.standard, given.estimate.details)
    read = read_logs(motions, model.joints, prismatic=model.layout.prismatic, needs="motion")
    held = [hold_log(model, motion, settings) for motion in read]
    return preview_logs(model, held, choice, noise=noise, run=run)


def preview_logs(
    model: RobotModel,
    motions: Sequence[SurveyedLog],
    choice: EstimatorSettings,
    *,
    noise: TorqueNoise | Mapping[str, float] | None = None,
    correlation: float | None = None,
    run: Run | None = None,
    like: Run | None = None,
) -> Preview:
    """Return the standard errors to be expected of motions that were read.

    Args:
        model: The robot, with the friction that a run before has found.
        motions: The motions, in memory.
        choice: Which estimator.
        noise: As of ``preview``.
        correlation: Time over which noise that is stated or assumed is correlated [s]; if None, as
            a run before has it, or 0.1 s.
        run: What was recorded before, if anything; it adds what it said.
        like: A run whose noise and parameters these motions have, too, without adding to them.

    Raises:
        DataError: As of ``preview``.
        SettingsError: As of ``preview``.
    """
    if not motions:
        raise DataError("no motion was given; at least one is needed to preview anything")
    mapping = structural_mapping(model)
    peak, fastest = _seen(model, motions)
    size = largest_torques(model, peak)
    known = run or like
    pi = assumed_parameters(model, size, fastest) if known is None else known.standard
    for motion in motions:
        _expect(motion, pi)
    if not isinstance(noise, TorqueNoise):
        found = None if known is None else known.noise(mapping.K)
        noise = assumed_noise(model, size, noise or {}, correlation, found)
    said = _Information.of(model, mapping, motions, noise)
    said = said if run is None else said.beside(run)
    prior, spread = model.standard_parameters(), prior_spread(model, said.squares, said.samples)
    ground = Known(model, mapping, prior, spread, said.share, said.sigma)
    weight = _WEIGHT if known is None or known.weight is None else known.weight
    estimate, wls = _errors(said, ground, choice, weight)
    expected = _expected(motions, pi, said, ground, choice, estimate, wls)
    before = None
    if run is not None:
        alone, _ = _errors(said.without_motions(), ground, choice, weight)
        before = _base_error(alone, mapping, prior, spread)
    return Preview(expected, noise, before)


@dataclass(frozen=True, eq=False)
class _Information:
    """What recordings say, or will."""

    factors: Factors
    sigma: Array  # (n,), noise level of each joint behind the filter [N m or N]
    levels: tuple[tuple[Factors, Array], ...]  # of motions to come: noise that counts per row, (n,)
    run: Run | None  # what was recorded before
    squares: Array  # as of Reduction
    samples: int
    share: float  # share of their rows that count as independent [-]

    @classmethod
    def of(
        cls,
        model: RobotModel,
        mapping: BaseMapping,
        motions: Sequence[SurveyedLog],
        noise: TorqueNoise,
    ) -> "_Information":
        """Return what motions will say, whose torque is expected."""
        levels, residuals = [], []
        for log in motions:
            part = compress(base_problem(model, mapping, log.whole.trajectory, log.whole.mask))
            density = noise.density(_white_step(log))
            levels.append((part, density / _row_step(log)))
            residuals.append(np.minimum(noise.std**2, density * _band(log)))
        rows = np.array([part.rows for part, _ in levels])
        mean = np.average(residuals, axis=0, weights=rows + 1e-9)
        return cls(
            merge([part for part, _ in levels]),
            np.sqrt(mean),
            tuple(levels),
            None,
            np.sum([log.whole.trajectory.squares for log in motions], axis=0),
            sum(len(log.whole.trajectory.t) for log in motions),
            min(independent_share(log.signals) for log in motions),
        )

    def beside(self, run: Run) -> "_Information":
        """Return what a run before and these say together."""
        return replace(
            self,
            factors=merge([run.factors, self.factors]),
            run=run,
            squares=run.squares + self.squares,
            samples=run.samples + self.samples,
            share=min(run.share, self.share),
        )

    def without_motions(self) -> "_Information":
        """Return what the run before says alone, rows weighted as they are."""
        if self.run is None:
            return self
        return replace(self, factors=self.run.factors, levels=(), share=self.run.share)

    def meat(self, K: Array, sigma: Array) -> Array:
        """Return the covariance of the score of all rows weighted by sigma^-2, shape (b, b)."""
        meat = np.zeros((len(K), len(K))) if self.run is None else self.run.meat(K, sigma)
        for part, level in self.levels:
            meat = meat + part.information(level / sigma**4)
        return meat


def _white_step(log: SurveyedLog) -> float:
    """Return the time between two rows of independent noise, if it is white [s]."""
    return log.step if log.signals.cutoff is not None else max(log.step, _row_step(log))


def _row_step(log: SurveyedLog) -> float:
    """Return the time between two rows of a log's trajectory [s]; 1 of stands, which are apart."""
    if log.model.is_static:
        return 1.0
    rate = log.signals.rate
    return log.step if rate is None else 1.0 / rate


def _band(log: SurveyedLog) -> float:
    """Return the bandwidth of a log's filter for noise, both signs of frequency [Hz]."""
    cutoff, rate = log.signals.cutoff, 1.0 / log.step
    if cutoff is None:
        return np.inf
    half = int(_IMPULSE * rate / cutoff)
    impulse = np.zeros(2 * half + 1)
    impulse[half] = 1.0
    return float(rate * np.sum(low_pass(impulse, rate, log.signals) ** 2))


def _seen(model: RobotModel, motions: Sequence[SurveyedLog]) -> tuple[Array, Array]:
    """Return the largest torque and speed of each joint in motions, by the URDF's bodies, (n,)."""
    bodies = model.standard_parameters()
    moved = [np.abs(predict(model, [bodies], log.whole.trajectory)[0]) for log in motions]
    peak = np.max([torque.max(axis=0) for torque in moved], axis=0)
    return peak, np.max([np.abs(log.whole.trajectory.v).max(axis=0) for log in motions], axis=0)


def _expect(log: SurveyedLog, pi: Array) -> None:
    """Give a motion the torque that parameters predict, behind its filter."""
    rows = log.whole
    (torque,) = predict(log.model, [pi], rows.trajectory)
    (piece,) = log.pieces
    piece.take(replace(rows, trajectory=replace(rows.trajectory, tau=torque)), log.model)


def _errors(
    said: _Information, known: Known, choice: EstimatorSettings, usual: tuple[float, float]
) -> tuple[Estimate, Estimate]:
    """Return the estimate and that of WLS to be expected, both at the prior.

    The bounds of a consistent fit are left out, for which of them bind is not known before the
    data; nor is the weight of its prior, and the plausible one, unless it is stated: the typical.
    """
    factors, K = said.factors, known.mapping.K
    plain, alike = (
        _least_squares(said, known, sigma) for sigma in (said.sigma, np.ones_like(said.sigma))
    )
    if not isinstance(choice, ConsistentSettings):
        return (alike if choice.has_equal_weights else plain), plain
    stated = choice.prior_weight
    weight, plausible = usual if isinstance(stated, str) else (stated, 1.0)
    bounds = {**choice.constraints, "extent": "none"}
    settings = replace(choice, prior_weight=weight, constraints=bounds)
    fit = replace(consistent_fit(settings, known), plausible_weight=plausible)
    C = fit.programme.covariance(weight, fit.rows(factors, said.sigma))
    R, meat = factors.weighted(said.sigma)[:-1, :-1], said.meat(K, said.sigma)
    covariance = about_prior(C, K, said.share**2 * meat, R, said.share, fit.weight_ratio)
    estimate = replace(
        plain, theta=known.pi, covariance=covariance, names=known.mapping.names,
        prior_std=fit.spread_before,
    )  # fmt: skip
    return estimate, plain


def _least_squares(said: _Information, known: Known, sigma: Array) -> Estimate:
    """Return least squares of rows weighted by sigma^-2, at the prior."""
    solution = solve_factor(said.factors, sigma, known.beta)
    bread = solution.covariance
    covariance = bread @ said.meat(known.mapping.K, sigma) @ bread
    found = solution.estimate(said.factors.names, covariance, said.sigma, 0, "expected")
    return replace(found, theta=known.beta)


def _expected(
    motions: Sequence[SurveyedLog],
    pi: Array,
    said: _Information,
    known: Known,
    choice: EstimatorSettings,
    estimate: Estimate,
    wls: Estimate,
) -> Identification:
    """Return the identification to be expected."""
    model, mapping = known.model, known.mapping
    standard = known.pi if said.run is None else pi
    rows = said.factors.weighted(said.sigma / np.sqrt(said.share))[:, :-1]
    before = base_spread(mapping.K, known.spread, model.layout.owned_by(choice.bounds.pinned))
    fitted, _ = evaluate_logs(motions, (), {"estimate": pi, "wls": pi}, known.pi)
    inflation = np.mean([level / said.sigma**2 for _, level in said.levels])
    errors = StandardErrors("noise expected", 0, float(inflation), np.full(len(mapping.K), np.inf))
    return Identification(
        model=model,
        mapping=mapping,
        estimator=choice,
        estimate=estimate,
        wls=wls,
        prior=known.pi,
        urdf_with_drives=pi,
        prior_std=known.spread if estimate.prior_std is None else estimate.prior_std,
        standard=standard,
        standard_covariance=standard_of(estimate, mapping, known.pi, known.spread)[1],
        base=mapping.to_base(standard),
        base_error=_base_error(estimate, mapping, known.pi, known.spread),
        fitted=fitted,
        validation=(),
        errors=errors,
        factors=said.factors,
        determination=determine(said.factors.names, rows, before),
    )


def _base_error(estimate: Estimate, mapping: BaseMapping, prior: Array, spread: Array) -> Array:
    """Return the standard errors of the base parameters, shape (b,); inf where nothing is said."""
    if estimate.names == mapping.base_names:
        return estimate.std_error
    _, covariance = standard_of(estimate, mapping, prior, spread)
    variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
