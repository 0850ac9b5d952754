"""Expected standard errors of a motion before it is recorded.

The motion is processed like a log, with the torque that the model predicts: filter, used samples,
factors and base parameters are those of an identification. Only the noise must be assumed. Noise of
standard deviation s with correlation time T has the density S = s^2 T; for white noise T is one
sample. Behind the filter the residual has the variance s_j^2 <= S_j 2 B, with the bandwidth B of
the filter. The score of a joint, W_j^T (tau_j - W_j theta) / s_j^2, has the covariance
S_j r W_j^T W_j / s_j^4, with r samples per second, however few of them are independent: W_j is
slow, and slow noise passes the filter. With the bread (sum_j W_j^T W_j / s_j^2)^-1 this gives the
covariance of weighted least squares, and with the prior's information that of a consistent fit.

Where constraint forces are eliminated, W_j are the projected rows, which have one noise level s.
The noise e is in the torques of the joints, none in the rows of the base: the score is
sum_j (P W)_j^T e_j, and its covariance the sum above, without the base's rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import SIZE, is_number, require_kind
from robotid.base.typing import Array
from robotid.data.files.read import Readable
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import low_pass
from robotid.diagnosis.logs.check_logs import excitation_finding
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.dynamics.factors import Factors, compress, join, merge
from robotid.dynamics.prepared_logs import base_problem, independent_share
from robotid.dynamics.torque import predict, predict_instants
from robotid.estimation.estimators import Estimate
from robotid.estimation.estimators.batch import LEAST_NOISE, solve_factor
from robotid.estimation.estimators.determination import base_spread, determine
from robotid.estimation.estimators.estimator import FEWEST_SEGMENTS, LEAST_FREEDOM, scatter
from robotid.estimation.fitting.estimator_settings import (
    ConsistentSettings,
    EstimatorSettings,
    OLSSettings,
)
from robotid.estimation.fitting.evaluation import evaluate_logs
from robotid.estimation.fitting.fit import Known, consistent_fit, pinned_links
from robotid.estimation.fitting.fitted import expected_band
from robotid.estimation.fitting.recorded import Recordings, SurveyedLog, hold_log
from robotid.estimation.fitting.standard_errors import (
    StandardErrors,
    TorqueBand,
    about_prior,
    standard_of,
)
from robotid.identification.pipeline import logs_of
from robotid.identification.result import TorqueIdentification
from robotid.robot.closure import refuse_loops
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread, with_assumed_inertials

#: Assumed correlation time of noise [s].
CORRELATION = 0.1
_NOISE = 0.01  # assumed standard deviation of noise, as a share of the largest torque
_FRICTION = 0.05  # assumed Coulomb friction, and viscous at full speed, as such a share
_POSES = 200  # random poses at which gravity is evaluated
#: Smallest largest torque of a joint, as a share of that of all joints.
FAINTEST = 1e-3
#: Typical weight of a consistent fit's prior with "auto", and the plausible weight: the largest one
#: that held-out segments do not reject, for robots that differ from their URDF as much.
_WEIGHT = (10.0, 1.0)
_IMPULSE = 40.0  # periods of the filter after which its impulse response is 0


@dataclass(frozen=True, eq=False)
class TorqueNoise:
    """Noise of the torque of each joint."""

    std: Array  # (n,), standard deviation [N m or N]
    correlation: Array  # (n,), time over which it is correlated [s]; 0 for white noise
    origins: tuple[str, ...]  # "stated", "assumed", or "found" in an earlier run

    def last(self, count: int) -> "TorqueNoise":
        """Return the noise of the last rows, those of the joints."""
        return TorqueNoise(self.std[-count:], self.correlation[-count:], self.origins[-count:])

    def density(self, step: float) -> Array:
        """Return the density of each joint's noise at low frequency, shape (n,) [(N m)^2 s]."""
        return np.asarray(self.std**2 * np.maximum(self.correlation, step))


def assumed_noise(
    model: RobotModel,
    size: Array,
    stated: Mapping[str, float],
    correlation: float | None = None,
    earlier: TorqueNoise | None = None,
) -> TorqueNoise:
    """Return the noise of each joint: stated, of an earlier run, or 1 % of its largest torque."""
    for joint, value in stated.items():
        if joint not in model.joints:
            raise SettingsError(
                f"noise is given for {joint!r}, which is not among the joints "
                f"{listed(model.joints)}{suggestion(str(joint), model.joints)}"
            )
        if not (is_number(value) and SIZE.holds(value)):
            raise SettingsError(f"noise of {joint!r} is {value!r}, expected {SIZE.words}")
    if correlation is not None and not 0 <= correlation < np.inf:
        raise SettingsError(f"correlation is {correlation:g} s, expected 0 (white noise) or more")
    is_stated = np.isin(model.joints, list(stated))
    values = np.array([stated.get(joint, np.nan) for joint in model.joints])
    std = _NOISE * size if earlier is None else earlier.std
    time = np.full(len(size), CORRELATION) if earlier is None else earlier.correlation
    if correlation is not None:
        time = np.where(is_stated | (earlier is None), correlation, time)
    other = "assumed" if earlier is None else "found"
    origins = tuple("stated" if is_known else other for is_known in is_stated)
    return TorqueNoise(np.where(is_stated, values, std), time, origins)


def largest_gravity(model: RobotModel) -> Array:
    """Return the largest gravity torque of each joint over random poses, shape (n,)."""
    ranges = [(j.lower, j.upper) if j.has_limits else (-np.pi, np.pi) for j in model.limits]
    low, high = np.array(ranges).T
    q = np.random.default_rng(0).uniform(low, high, (_POSES, len(ranges)))
    return np.asarray(np.abs(predict_instants(model, model.standard_parameters(), q)).max(axis=0))


def largest_torques(model: RobotModel, peak: Array) -> Array:
    """Return the largest torque of each joint, (n,): the URDF's limit, or that of a motion."""
    peak = np.maximum(peak, FAINTEST * max(float(peak.max()), 1e-300))
    limit = np.array([joint.effort for joint in model.limits])
    return np.where(np.isfinite(limit) & (limit > 0), limit, peak)


def assumed_parameters(model: RobotModel, size: Array, fastest: Array) -> Array:
    """Return the URDF's bodies with friction of a typical size, shape (p,)."""
    pi = model.standard_parameters()
    for j, limits in enumerate(model.limits):
        speed = limits.velocity if 0 < limits.velocity < np.inf else max(float(fastest[j]), 1e-3)
        for term, value in (("coulomb", 1.0), ("viscous", 1.0 / speed)):
            name = f"{model.joints[j]}.{term}"
            if name in model.layout.names:
                pi[model.layout.names.index(name)] = _FRICTION * size[j] * value
    return pi


@dataclass(frozen=True, eq=False)
class Run:
    """An earlier recording and its identification."""

    segments: tuple[Factors, ...]  # factors of its segments, for base parameters
    standard: Array  # the identified parameters, shape (p,)
    squares: Array  # as of ``Reduction``
    samples: int  # as of ``Reduction``
    share: float  # share of its samples that count as independent [-]
    step: float  # time between two samples [s]
    # weight of the prior that its fit selected, and the plausible one; None if it selected none
    weight: tuple[float, float] | None = None

    @classmethod
    def of(cls, recordings: Recordings, standard: Array, details: Mapping[str, Any]) -> "Run":
        """Return the run of logs that were identified earlier: standard (p,)."""
        reductions = recordings.reduce()
        whole = join(reductions)
        segments = tuple(part.factors for part in reductions if part.factors.rows.any())
        step = float(np.mean([_row_step(log) for log in recordings.fitted]))
        prior = details.get("prior")
        weight = None if prior is None else (prior["weight"], prior.get("plausible_weight", 1.0))
        return cls(segments, standard, whole.squares, whole.samples, recordings.share, step, weight)

    @property
    def factors(self) -> Factors:
        """Factors of all segments together."""
        return merge(self.segments)

    def noise(self, K: Array) -> TorqueNoise:
        """Return the noise of its residuals; the scatter of scores gives the correlation."""
        # the scatter of a joint's score depends on the direction: the geometric mean over the
        # parameters, weighted by the joint's share of their variance
        factors, beta = self.factors, K @ self.standard
        sigma = np.sqrt(factors.residual_squares(beta) / np.maximum(factors.rows, 1))
        sigma = np.maximum(sigma, LEAST_NOISE * max(float(sigma.max()), LEAST_NOISE))
        bread = solve_factor(factors, sigma, beta).covariance
        inflation = np.full(len(sigma), 1.0 / self.share)
        if len(self.segments) >= FEWEST_SEGMENTS:
            for j in np.flatnonzero(factors.rows):
                alone = np.where(np.arange(len(sigma)) == j, sigma, np.inf)
                own = np.diag(bread @ factors.information(alone**-2.0) @ bread)
                share = own / np.diag(bread)  # of each parameter's variance, by this joint
                counts = share > FAINTEST
                scattered = np.diag(scatter(self.segments, beta, alone, bread).covariance)
                ratio = np.log(scattered[counts] / own[counts])
                inflation[j] = np.exp(np.average(ratio, weights=share[counts]))
        effective = factors.leverages(bread) / sigma**2  # degrees of freedom
        free = np.maximum(1.0 - effective / np.maximum(factors.rows, 1), LEAST_FREEDOM)
        # its density is sigma^2 inflation step, whatever its standard deviation is
        return TorqueNoise(
            sigma / np.sqrt(free), free * inflation * self.step, ("found",) * len(sigma)
        )

    def meat(self, K: Array, sigma: Array) -> Array:
        """Return the covariance of its score for samples weighted by sigma^-2, shape (b, b)."""
        factors, beta = self.factors, K @ self.standard
        if len(self.segments) < FEWEST_SEGMENTS:
            return factors.information(1.0 / sigma**2) / self.share
        bread = solve_factor(factors, sigma, beta).covariance
        return scatter(self.segments, beta, sigma, bread).meat


@dataclass(frozen=True, eq=False)
class Preview:
    """Expected result of motions that are not recorded yet.

    The expected identification predicts their torque exactly, and has the standard errors, sources
    and bands that follow from the noise.
    """

    expected: TorqueIdentification
    noise: TorqueNoise  # noise of the torque
    # (b,), standard errors of the base parameters from the earlier run only, inf where it does not
    # determine one; None without an earlier run
    before: Array | None = None
    # as of ``Fit.between`` of an earlier result, of each motion, which widens the bands
    between: tuple[Array | None, ...] = ()

    def __repr__(self) -> str:
        determined, expected = self.expected.determination, self.expected
        return (
            f"<Preview of {expected.model.name}: {determined.rank} of {len(determined.names)} base "
            f"parameters determined by {len(expected.fitted)} motions>"
        )

    @property
    def base_error(self) -> Array:
        """Standard errors of the base parameters, shape (b,); inf where not determined."""
        return self.expected.base_error

    @property
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters given the prior, shape (p,)."""
        return self.expected.standard_error

    @property
    def gain(self) -> Array | None:
        """Factor by which the base standard errors decrease, shape (b,); None without a run."""
        if self.before is None:
            return None
        before, after = (np.minimum(x, self.plausible) for x in (self.before, self.base_error))
        return np.asarray(before / after)

    @property
    def plausible(self) -> Array:
        """Plausible difference of the base parameters from the URDF's, shape (b,)."""
        return base_spread(self.expected.mapping.K, self.expected.prior_std)

    @property
    def bands(self) -> tuple[TorqueBand, ...]:
        """Expected band of each motion's predicted torques."""
        expected = self.expected
        between = self.between or (None,) * len(expected.fitted)
        return tuple(map(expected_band, repeat(expected), expected.fitted, between))

    @property
    def words(self) -> str:
        """What the motions determine, and what they do not determine, as text."""
        expected = self.expected
        names = listed(dict.fromkeys(e.recording.log.name for e in expected.fitted))
        return excitation_finding(expected.wls, expected.determination, names).message


def preview(
    model: RobotModel | str | Path,
    motions: Readable | Sequence[Readable],
    *,
    noise: TorqueNoise | Mapping[str, float] | None = None,
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
    given: TorqueIdentification | None = None,
) -> Preview:
    """Return the expected standard errors of motions before they are recorded.

    Args:
        model: The robot; or the path of its URDF, all of whose joints move. With an earlier
            run, the robot is that of the run.
        motions: The motions: a ``Log``, whose torques are ignored, the path of a file with
            positions, a DataFrame, or several of these.
        noise: Standard deviation of the torque's noise [N m or N], by joint for those where it is
            known, or a ``TorqueNoise``; for the others that of the earlier run, or that of
            ``assumed_noise``.
        signals: How logs become trajectories; those of the earlier run, or the defaults, if None.
        estimator: Name or settings of the estimator.
        given: An earlier identification, whose information is added.

    Raises:
        DataError: If a motion cannot be read, does not fit the model or is too short, or the base
            floats without contacts.
        SettingsError: If a setting is out of range, or a joint is unknown.
    """
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    none, numbers = type(None), "a TorqueNoise, or numbers by joint"
    of_estimator = "a name or a robotid.EstimatorSettings"
    require_kind(estimator, (str, EstimatorSettings), "estimator", of_estimator)
    require_kind(noise, (TorqueNoise, Mapping, none), "noise", numbers)
    require_kind(given, (TorqueIdentification, none), "given", "a robotid.Identification, or none")
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    settings, run = signals or SignalSettings(), None
    model = model if isinstance(model, RobotModel) else RobotModel.from_urdf(model)
    model = with_assumed_inertials(model)
    if given is not None:
        model, settings = given.model, signals or given.stated.signals
        logs = [hold_log(model, e.recording.log, e.recording.signals) for e in given.fitted]
        recordings = Recordings(model, given.mapping, logs)
        run = Run.of(recordings, given.standard, given.estimate.details)
    read = logs_of(model, motions, "motion")
    in_memory = [hold_log(model, motion, settings) for motion in read]
    ahead = preview_logs(model, in_memory, choice, noise=noise, run=run)
    return ahead if given is None else replace(ahead, between=(given.between,) * len(in_memory))


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
    """Return the expected standard errors of motions that were read."""
    if not motions:
        raise DataError("no motion was given; at least one is needed to preview anything")
    refuse_loops(model, "a preview")
    if model.free_flyer and not model.contacts:
        raise DataError(
            f"{model.name}: the base floats without contacts; a preview needs [[contact]], or a "
            "robot with a fixed base"
        )
    mapping = structural_mapping(model)
    motions = [  # with torques: rows of joints without them would not be used
        hold_log(x.model, replace(x.source, has_torque=True), x.asked, x.locked)
        if x.model.constraints and isinstance(x.source, Log)
        else x
        for x in motions
    ]
    peak, fastest = _largest(model, motions)
    size = largest_torques(model, peak)
    earlier = run or like
    pi = assumed_parameters(model, size, fastest) if earlier is None else earlier.standard
    motions = [x.with_torque(predict(model, [pi], x.whole.trajectory)[0]) for x in motions]
    if not isinstance(noise, TorqueNoise):
        known = None if earlier is None else earlier.noise(mapping.K).last(len(model.joints))
        noise = assumed_noise(model, size, noise or {}, correlation, known)
    information = _Information.of(model, mapping, motions, noise)
    information = information if run is None else information.added_to(run)
    prior = model.standard_parameters()
    spread = prior_spread(model, information.squares, information.samples)
    ground = Known(model, mapping, prior, spread, information.share, information.sigma)
    weight = _WEIGHT if earlier is None or earlier.weight is None else earlier.weight
    estimate, wls = _errors(information, ground, choice, weight)
    expected = _expected(motions, pi, information, ground, choice, estimate, wls)
    before = None
    if run is not None:
        alone, _ = _errors(information.without_motions(), ground, choice, weight)
        before = _base_error(alone, mapping, prior, spread)
    return Preview(expected, noise, before)


@dataclass(frozen=True, eq=False)
class _Information:
    """Information in recordings, made or planned."""

    factors: Factors
    sigma: Array  # (n_rows,), noise level of each row behind the filter [N m or N]
    levels: tuple[tuple[Factors, Array], ...]  # of planned motions: density per sample, (n_rows,)
    run: Run | None  # an earlier recording
    squares: Array  # as of ``Reduction``
    samples: int
    share: float  # share of their samples that count as independent [-]

    @classmethod
    def of(
        cls,
        model: RobotModel,
        mapping: BaseMapping,
        motions: Sequence[SurveyedLog],
        noise: TorqueNoise,
    ) -> "_Information":
        """Return the information of planned motions with predicted torque."""
        levels, residuals = [], []
        for log in motions:
            part = compress(base_problem(model, mapping, log.whole.trajectory, log.whole.mask))
            # time between two samples of independent noise, if it is white
            is_filtered = log.signals.cutoff is not None
            step = log.step if is_filtered else max(log.step, _row_step(log))
            density = noise.density(step)
            residual = np.minimum(noise.std**2, density * _band(log))
            no_noise = np.zeros(model.n_rows - len(density))  # in the rows of the base
            levels.append((part, np.append(no_noise, density) / _row_step(log)))
            residuals.append(np.append(no_noise, residual))
        rows = np.array([part.rows for part, _ in levels]) + 1e-9
        mean = np.average(residuals, axis=0, weights=rows)
        if model.constraints:
            mean = np.full(len(mean), np.average(residuals, weights=rows))
        return cls(
            merge([part for part, _ in levels]), np.sqrt(mean), tuple(levels), None,
            np.sum([log.whole.trajectory.squares for log in motions], axis=0),
            sum(len(log.whole.trajectory.t) for log in motions),
            min(independent_share(log.signals) for log in motions),
        )  # fmt: skip

    def added_to(self, run: Run) -> "_Information":
        """Return the information of an earlier run and of these motions together."""
        return replace(
            self, factors=merge([run.factors, self.factors]), run=run,
            squares=run.squares + self.squares, samples=run.samples + self.samples,
            share=min(run.share, self.share),
        )  # fmt: skip

    def without_motions(self) -> "_Information":
        """Return the information of the earlier run only, with the same weights."""
        if self.run is None:
            return self
        return replace(self, factors=self.run.factors, levels=(), share=self.run.share)

    def meat(self, K: Array, sigma: Array) -> Array:
        """Return the covariance of the score of samples weighted by sigma^-2, shape (b, b)."""
        meat = np.zeros((len(K), len(K))) if self.run is None else self.run.meat(K, sigma)
        for part, level in self.levels:
            meat = meat + part.information(level / sigma**4)
        return meat


def _row_step(log: SurveyedLog) -> float:
    """Return the time between two samples of a trajectory [s]; 1 s for poses at rest."""
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


def _largest(model: RobotModel, motions: Sequence[SurveyedLog]) -> tuple[Array, Array]:
    """Return the largest torque (URDF's bodies) and speed of each joint in motions, (n,)."""
    bodies = model.standard_parameters()
    trajectories = [log.whole.trajectory for log in motions]
    torques = [np.abs(predict(model, [bodies], t)[0]).max(axis=0) for t in trajectories]
    fastest = np.max([np.abs(t.v).max(axis=0) for t in trajectories], axis=0)
    peak = np.max(torques, axis=0)
    first = model.n_rows - len(model.joints)
    return peak[first:], fastest[first:]


def _errors(
    information: _Information, known: Known, choice: EstimatorSettings, typical: tuple[float, float]
) -> tuple[Estimate, Estimate]:
    """Return the expected estimate and that of WLS, both at the prior, without active bounds."""
    # the weight of the prior, unless it is given, and the plausible weight are the typical ones
    factors, K = information.factors, known.mapping.K
    plain, alike = (
        _least_squares(information, known, sigma)
        for sigma in (information.sigma, np.ones_like(information.sigma))
    )
    if not isinstance(choice, ConsistentSettings):
        return (alike if isinstance(choice, OLSSettings) else plain), plain
    stated = choice.prior_weight
    weight, plausible = typical if isinstance(stated, str) else (stated, 1.0)
    bounds = {**choice.constraints, "extent": "none"}
    settings = replace(choice, prior_weight=weight, constraints=bounds)
    fit = replace(consistent_fit(settings, known), plausible_weight=plausible)
    C = fit.programme.covariance(weight, fit.rows(factors, information.sigma))
    R, meat = factors.weighted(information.sigma)[:-1, :-1], information.meat(K, information.sigma)
    covariance = about_prior(
        C, K, information.share**2 * meat, R, information.share, fit.weight_ratio
    )
    estimate = replace(
        plain, theta=known.pi, covariance=covariance, names=known.mapping.names,
        prior_std=fit.spread_before,
    )  # fmt: skip
    return estimate, plain


def _least_squares(information: _Information, known: Known, sigma: Array) -> Estimate:
    """Return least squares of samples weighted by sigma^-2, at the prior."""
    solution = solve_factor(information.factors, sigma, known.beta)
    bread = solution.covariance
    covariance = bread @ information.meat(known.mapping.K, sigma) @ bread
    least_squares = solution.estimate(
        information.factors.names, covariance, information.sigma, 0, "expected"
    )
    return replace(least_squares, theta=known.beta)


def _expected(
    motions: Sequence[SurveyedLog],
    pi: Array,
    information: _Information,
    known: Known,
    choice: EstimatorSettings,
    estimate: Estimate,
    wls: Estimate,
) -> TorqueIdentification:
    """Return the expected identification."""
    model, mapping = known.model, known.mapping
    standard = known.pi if information.run is None else pi
    rows = information.factors.weighted(information.sigma / np.sqrt(information.share))[:, :-1]
    pinned = model.layout.owned_by(pinned_links(choice.bounds, model))
    before = base_spread(mapping.K, known.spread, pinned)
    fitted, _ = evaluate_logs(motions, (), {"estimate": pi, "wls": pi}, known.pi)
    inflation = np.mean([level / information.sigma**2 for _, level in information.levels])
    errors = StandardErrors("noise expected", 0, float(inflation), np.full(len(mapping.K), np.inf))
    return TorqueIdentification(
        model=model, mapping=mapping, estimator=choice, estimate=estimate, wls=wls, prior=known.pi,
        prior_std=known.spread if estimate.prior_std is None else estimate.prior_std,
        urdf_with_drives=pi, standard=standard,
        standard_covariance=standard_of(estimate, mapping, known.pi, known.spread)[1],
        base=mapping.to_base(standard),
        base_error=_base_error(estimate, mapping, known.pi, known.spread),
        fitted=fitted, validation=(), errors=errors, factors=information.factors,
        determination=determine(information.factors.names, rows, before),
    )  # fmt: skip


def _base_error(estimate: Estimate, mapping: BaseMapping, prior: Array, spread: Array) -> Array:
    """Return the standard errors of the base parameters, shape (b,); inf if not determined."""
    if estimate.names == mapping.base_names:
        return estimate.std_error
    _, covariance = standard_of(estimate, mapping, prior, spread)
    variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
