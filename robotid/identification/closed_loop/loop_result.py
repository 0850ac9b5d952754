"""Identifications that predict positions, and the information of each of their logs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.diagnosis.catalogue import entries
from robotid.diagnosis.verdict.parameter_table import correlated_sets
from robotid.diagnosis.verdict.verdict import Verdict, judge_positions
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import DriveMoments, drive_moments
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import segment_scores
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.fitting.evaluation import Metrics
from robotid.estimation.fitting.fitted import FROM_PRIOR, sources_of
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.estimation.variation.groups import FEWEST_RUNS, Group, RunsOf, inflation_of
from robotid.estimation.variation.spread import Runs
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    LoopSimulator,
    with_terms,
)
from robotid.identification.closed_loop.position_errors import PositionEvaluation, pool_positions
from robotid.identification.closed_loop.stages import Fitted
from robotid.identification.result import Identification
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_CHANGE = 0.1  # plausible standard deviation of a parameter between logs, over its value
_LEAST = 0.01  # ... at least, over its prior standard deviation
_LEAST_INFORMATION = 1e-12
_CAUTIONS = ("at_bound", "coarse_steps", "gains_contradicted")  # with these no result is good
_GAP = 3.0  # step in time above which no speed is computed [median steps]
_MOVING = 0.05  # smallest speed above the noise, relative to the largest speed of a joint


def loop_runs(
    model: RobotModel, simulator: LoopSimulator, estimate: Estimate, unit: Sequence[str] = ()
) -> tuple[RunsOf, ...]:
    """Return the information of each log about the parameters of each joint, or of shared ones."""
    logs = list(dict.fromkeys(id(window.log) for window in simulator.windows))
    if len(logs) < FEWEST_RUNS or simulator.torque is not None:
        return ()
    scores = []
    for log in logs:
        windows = tuple(window for window in simulator.windows if id(window.log) == log)
        scores.append(segment_scores(replace(simulator, windows=windows), estimate))
    _, units = np.unique(unit or [""] * len(logs), return_inverse=True)
    groups: dict[tuple[int, ...], list[int]] = {}
    is_prior = estimate.std_error > FROM_PRIOR * simulator.prior_std
    for k, free in enumerate(simulator.free_parameters):
        is_open = is_prior[k] or free.name in estimate.details["at_bound"]
        if free.what != "body" and not is_open:
            groups.setdefault(free.joints, []).append(k)
    found = []
    for places in groups.values():
        own = [(H[:, places][:, :, places], g[:, places]) for H, g in scores]
        H, h = (np.array([each[k].sum(axis=0) for each in own]) for k in (0, 1))
        if not H.any():
            continue
        members = [simulator.free_parameters[k] for k in places]
        centre = estimate.theta[places]
        spread = np.where(np.isfinite(simulator.prior_std), simulator.prior_std, 0.0)[places]
        scale = np.maximum(_CHANGE * np.abs(centre), _LEAST * spread)
        scale = np.maximum(scale, _LEAST_INFORMATION)
        group = Group(
            "drive",
            members[0].name.rpartition(".")[0],
            tuple(each.name for each in members),
            tuple(units_of(model, each) for each in members),
            np.zeros((0, len(members))),
            members[0].joints,
        )
        inflation = inflation_of(own)
        runs = Runs(H / inflation, h / inflation, units, scale)
        found.append(RunsOf(group, centre, runs, inflation))
    return tuple(found)


def units_of(model: RobotModel, free: FreeParameter) -> str:
    """Return the unit of a free parameter of a loop or drive."""
    is_linear = model.joints[free.joints[0]] in model.layout.prismatic
    if free.term is not None:
        return free.term.units[is_linear]
    if free.what == "armature":
        return TERMS["armature"].units[is_linear]
    force, length = ("N", "m") if is_linear else ("N m", "rad")
    return {
        "kp": f"{force}/{length}", "kd": f"{force} s/{length}", "delay": "s", "limit": force,
        "zero": length,
    }[free.what]  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PositionIdentification(Identification):
    """Identification that predicts positions, by simulation from commands or torques."""

    loop: LoopSettings  # what is known of the loops
    estimator: SimulationSettings  # the estimator's settings
    fit: Fitted
    fitted: tuple[PositionEvaluation, ...]  # the fitted logs, with their simulated positions
    validation: tuple[
        PositionEvaluation, ...
    ]  # the validation logs, with their simulated positions

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
    def has_gains(self) -> bool:
        """Whether the robot has position controllers: no logged torque drives it."""
        return self.loop.kind != "torque"

    @property
    def has_stated_gains(self) -> bool:
        """Whether the position gain of every joint was stated."""
        return not any(free.what == "kp" for free in self.fit.simulator.free_parameters)

    @property
    def is_scaled_by_gain(self) -> bool:
        """Whether only the stated gains determine the scale: no torque was fitted."""
        simulator = self.fit.simulator
        return self.has_gains and self.has_stated_gains and not simulator.knows_torques

    def metrics(self, name: str = "estimate") -> Metrics:
        """Return the metrics of positions over all fitted logs."""
        if name != "estimate":
            raise SettingsError(f"name is {name!r}, wanted 'estimate'")
        return pool_positions(self.fitted)

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict on the result."""
        return judge_positions(
            pool_positions(self.validation or self.fitted, moving=True),
            self.model.joints,
            fitted=pool_positions(self.fitted, moving=True),
            is_validation=bool(self.validation),
            is_settled=self.estimate.converged,
            log_errors=self.log_errors,
            cautions=[f.message for f in self.findings if f.code in _CAUTIONS],
            scale=entries()["scale"]["what"]["gains"] if self.is_scaled_by_gain else "",
            knows_torques=self.loop.kind == "torque" or self.fit.simulator.knows_torques,
        )


def identified_loops(
    model: RobotModel,
    loop: LoopSettings,
    estimator: SimulationSettings,
    fit: Fitted,
    fitted: tuple[PositionEvaluation, ...],
    validation: tuple[PositionEvaluation, ...],
) -> PositionIdentification:
    """Return the result of a fit, without findings."""
    model = with_terms(model, fit.loops)
    standard, slopes = fit.simulator.standard(model, fit.estimate.theta)
    covariance, mapping = slopes @ fit.estimate.covariance @ slopes.T, structural_mapping(model)
    return PositionIdentification(
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
