"""Results of identification by simulation, from commands and positions or logged torques."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.diagnosis.verdict.correlation import correlated_sets
from robotid.diagnosis.verdict.position_verdict import judge_positions
from robotid.diagnosis.verdict.verdict import Verdict
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import DriveMoments, drive_moments
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.fitting.bands import QUANTILE
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.fitting.identified import FROM_PRIOR, Identified, sources_of
from robotid.estimation.fitting.metrics import Metrics
from robotid.estimation.variation.variation import Variation
from robotid.identification.closed_loop.free_parameters import with_terms
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.position_errors import OpenLoop, position_metrics
from robotid.identification.closed_loop.stages import Fitted
from robotid.identification.result import StatedSettings
from robotid.identification.summary import identification_line
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

#: The limit of an identification from positions and stated gains.
STATED_SCALE = (
    "positions do not determine the scale: all drive and inertial parameters scale with kp as "
    "stated (kp stated 20 % too large makes all 20 % too large). Log a torque to check the scale"
)
_CAUTIONS = ("at_bound", "coarse_steps", "gains_contradicted")  # with these no result is good
_GAP = 3.0  # step in time above which no speed is computed [median steps]
_MOVING = 0.05  # smallest speed above the noise, relative to the largest speed of a joint


@dataclass(frozen=True, eq=False, repr=False)
class LoopIdentification(Identified):
    """Result of an identification by simulation.

    Attributes:
        loop: What is known of the loops.
        estimator: The estimator's settings.
        fit: The fit.
        fitted: The fitted logs, with their simulated positions.
        validation: The validation logs, with their simulated positions.
        findings: Findings of logs and fit.
        log_errors: Errors in the logs that invalidate the result, found by the doctor.
        report: File of the report, if one was written with the result.
        stated: Signal settings and ignored findings of the request.
        variation: Variation of the parameters of loops and drives between three or more fitted
            logs of commands.
    """

    loop: LoopSettings
    estimator: SimulationSettings
    fit: Fitted
    fitted: tuple[OpenLoop, ...]
    validation: tuple[OpenLoop, ...]
    findings: tuple[Finding, ...] = ()
    log_errors: tuple[str, ...] = ()
    report: str = ""
    stated: StatedSettings = field(default_factory=StatedSettings)
    variation: Variation | None = None

    def __repr__(self) -> str:
        return identification_line(self, self.estimator.name, self.verdict.status)

    @property
    def estimate(self) -> Estimate:
        """The estimate of the free parameters of loops, drives and bodies."""
        return self.fit.estimate

    @cached_property
    def _slopes(self) -> Array:
        """Derivatives of the standard parameters by the free ones, shape (p, c)."""
        return self.fit.simulator.standard(self.model, self.estimate.theta)[1]

    @property
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters, shape (p,); inf of those not fitted."""
        return _errors(self.standard_covariance)

    @cached_property
    def standard_quantile(self) -> Array:
        """Half-width of the 95 % interval of each standard parameter [standard errors], (p,).

        Of the free parameters that determine it, the one whose standard error has the fewest
        degrees of freedom gives the quantile.
        """
        own = np.where(self._slopes != 0.0, self.estimate.quantile, QUANTILE)
        quantile: Array = own.max(axis=1, initial=QUANTILE)
        return quantile

    @property
    def base_quantile(self) -> Array:
        quantile: Array = np.where(self.mapping.K != 0.0, self.standard_quantile, QUANTILE).max(
            axis=1
        )
        return quantile

    @property
    def at_bound(self) -> Array:
        return np.isin(self.model.layout.names, self.estimate.details["at_bound"])

    @cached_property
    def shrunk(self) -> Array:
        """Standard error of each free parameter over its prior spread, shape (c,) [-]."""
        share: Array = self.estimate.std_error / self.fit.simulator.prior_std
        return share

    @property
    def sources(self) -> tuple[str, ...]:
        """Source of each standard parameter; "mixed" for bodies and shared drive parameters."""
        own = dict(zip(self.fit.simulator.names, self.shrunk.tolist(), strict=True))
        share = np.array([own.get(name, np.nan) for name in self.model.layout.names])
        is_prior = np.isinf(self.standard_error) | ((share > FROM_PRIOR) & ~self.at_bound)
        return sources_of(share, is_prior, self.at_bound)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Free parameters that the logs do not determine, without those of bodies."""
        return tuple(
            free.name
            for free, share in zip(self.fit.simulator.free_parameters, self.shrunk, strict=True)
            if share > FROM_PRIOR and free.what != "body"
        )

    @property
    def correlated(self) -> tuple[tuple[str, ...], ...]:
        """Sets of strongly correlated free parameters of loops and drives."""
        free_parameters, C = self.fit.simulator.free_parameters, self.estimate.covariance
        own = [k for k, u in enumerate(free_parameters) if u.what != "body" and C[k, k] > 0]
        return tuple(
            tuple(free_parameters[k].name for k in each) for each in correlated_sets(C, own)
        )

    @property
    def moments(self) -> dict[str, DriveMoments]:
        """Moments that project the friction of drives on simpler terms, from the fitted logs."""
        model = self.model.with_reference(self.standard)
        motions = [logged_motion(run.log) for run in self.fitted] if model.layout.own else []
        moving = [np.abs(m.v) > _MOVING * np.abs(m.v).max(axis=0) for m in motions]
        return drive_moments(model, zip(motions, moving, strict=True))

    @property
    def is_consistent(self) -> bool:
        """Whether every body is physically consistent."""
        bodies = pseudo_inertia(self.standard[: self.model.layout.n_inertial])
        return bool((np.linalg.eigvalsh(bodies) >= 0).all())

    @property
    def has_urdf(self) -> bool:
        """Whether a URDF may be written: no fault of the logs makes it wrong."""
        return not self.log_errors

    @property
    def has_gains(self) -> bool:
        """Whether the position gain of every joint was stated."""
        return not any(free.what == "kp" for free in self.fit.simulator.free_parameters)

    @property
    def is_scaled_by_gain(self) -> bool:
        """Whether only the stated gains determine the scale: no torque was fitted."""
        simulator = self.fit.simulator
        return self.loop.kind != "torque" and self.has_gains and not simulator.knows_torques

    def metrics(self) -> Metrics:
        """Return the metrics of positions over all fitted logs."""
        return position_metrics(self.model, self.fitted)

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict on the result."""
        return judge_positions(
            position_metrics(self.model, self.validation or self.fitted, moving=True),
            self.model.joints,
            fitted=position_metrics(self.model, self.fitted, moving=True),
            is_validation=bool(self.validation),
            is_settled=self.estimate.converged,
            log_errors=self.log_errors,
            cautions=[f.message for f in self.findings if f.code in _CAUTIONS],
            scale=STATED_SCALE if self.is_scaled_by_gain else "",
            knows_torques=self.loop.kind == "torque" or self.fit.simulator.knows_torques,
        )


def identified_loops(
    model: RobotModel,
    loop: LoopSettings,
    estimator: SimulationSettings,
    fit: Fitted,
    fitted: tuple[OpenLoop, ...],
    validation: tuple[OpenLoop, ...],
) -> LoopIdentification:
    """Return the result of a fit, without findings."""
    model = with_terms(model, fit.loops)
    standard, slopes = fit.simulator.standard(model, fit.estimate.theta)
    covariance, mapping = slopes @ fit.estimate.covariance @ slopes.T, structural_mapping(model)
    return LoopIdentification(
        model=model,
        mapping=mapping,
        prior=model.standard_parameters(),
        standard=standard,
        standard_covariance=covariance,
        base=mapping.to_base(standard),
        base_error=_errors(mapping.K @ covariance @ mapping.K.T),
        loop=loop,
        estimator=estimator,
        fit=fit,
        fitted=fitted,
        validation=validation,
    )


def _errors(covariance: Array) -> Array:
    """Return standard errors; inf of entries without a variance."""
    variance = np.diag(covariance)
    return np.where(variance > 0.0, np.sqrt(np.maximum(variance, 0.0)), np.inf)


def logged_motion(log: Log) -> Trajectory:
    """Return the motion of a log of commands: positions and their numerical derivatives."""
    still = np.zeros_like(log.q)
    dt = np.diff(log.t)
    gaps = dt > _GAP * np.median(dt)
    segment = np.append(0, np.cumsum(gaps))
    v = still.copy()
    for k in range(segment[-1] + 1):
        rows = np.flatnonzero(segment == k)
        if len(rows) > 1:
            v[rows] = np.gradient(log.q[rows], log.t[rows], axis=0)
    return Trajectory(log.t, log.q, v, still, still, log.joints, None, segment)
