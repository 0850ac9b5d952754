"""identify_loops(): closed-loop identification from command logs, its result and its findings."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.base.findings import Finding, by_severity, grouped, listed, quoted
from robotid.base.tolerances import LEAST_DIVISOR
from robotid.base.typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import unwrap
from robotid.diagnosis.catalogue import codes_with, entries, finding
from robotid.diagnosis.decisions import BETTER
from robotid.diagnosis.verdict.fit_findings import correlated_sets, not_written, unlike_findings
from robotid.diagnosis.verdict.verdict import (
    GOOD,
    GOOD_POSITION,
    NAMED,
    Verdict,
    blocking,
    judge_positions,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import DriveMoments, drive_moments
from robotid.dynamics.simulation.loops import LOOP_GAP, Loops, open_loops
from robotid.dynamics.simulation.simulation_settings import by_joint
from robotid.dynamics.torque import predict_instants
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import segment_scores
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.fitting.evaluation import Metrics
from robotid.estimation.fitting.fitted import FROM_PRIOR, sources_of
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.estimation.variation.groups import FEWEST_RUNS, Group, RunsOf, inflation_of
from robotid.estimation.variation.spread import Runs
from robotid.estimation.variation.variation import PLAUSIBLE, vary
from robotid.identification.closed_loop.initial_values import CLEAR, parallel_axes
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import (
    POSITIVE,
    FreeParameter,
    LoopSimulator,
    with_terms,
)
from robotid.identification.closed_loop.position_errors import (
    PositionEvaluation,
    pool_positions,
    run_open_loop,
)
from robotid.identification.closed_loop.stages import (
    CHANGE,
    STAGES,
    Fitted,
    fit_gains,
    fit_loops,
    fit_one_log,
    stated_loops,
)
from robotid.identification.result import Identification, StatedSettings
from robotid.robot.drives import TERMS, Spring
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_LEAST = 0.01  # plausible change between logs, at least, over the prior standard deviation
#: With these no result is good.
_CAUTIONS = (
    "at_bound", "coarse_steps", "end_stop", "gains_contradicted", "not_followed", "other_gains",
    "position_offset",
)  # fmt: skip
_MOVING = 0.05  # smallest speed above the noise, relative to the largest speed of a joint
_MISMATCH = 0.5  # largest relative error of a torque that the loop of its joint gives
_KNOWN = 0.1  # standard error of a known delay, relative to the range found from one response
#: Figures of a log's gains relative to the fit; that of kd is 0 where the fit has none.
_GAINS = {"kp": "ratio", "kd": "kd_ratio"}
_UNEQUAL = 3.0  # ratio of the gains of equal drives from which on they are reported


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class PositionIdentification(Identification):
    """Identification that predicts positions, by simulation from commands or torques."""

    loop: LoopSettings  # what is known of the loops
    estimator: SimulationSettings
    fit: Fitted
    fitted: tuple[PositionEvaluation, ...]  # logs with their simulated positions
    validation: tuple[PositionEvaluation, ...]

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
        """Half-width of the 95 % interval of each standard parameter [standard errors], (p,)."""
        # that of the free parameter with the fewest degrees of freedom of those that determine it
        return _largest_quantile(self._slopes, self.estimate.quantile)

    @property
    def base_quantile(self) -> Array:
        return _largest_quantile(self.mapping.K, self.standard_quantile)

    @property
    def at_bound(self) -> Array:
        return np.isin(self.model.layout.names, self.estimate.details["at_bound"])

    @cached_property
    def shrunk(self) -> Array:
        """Standard error of each free parameter over its prior spread, shape (c,) [-]."""
        return np.asarray(self.estimate.std_error / self.fit.simulator.prior_std)

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
        free, C = self.fit.simulator.free_parameters, self.estimate.covariance
        drives = [k for k, x in enumerate(free) if x.what != "body" and C[k, k] > 0]
        return tuple(tuple(free[k].name for k in set_) for set_ in correlated_sets(C, drives))

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
            raise SettingsError(f"name is {name!r}, expected 'estimate'")
        return pool_positions(self.fitted)

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict on the result."""
        return judge_positions(
            pool_positions(self.validation or self.fitted, moving=True), self.model.joints,
            fitted=pool_positions(self.fitted, moving=True), is_validation=bool(self.validation),
            is_settled=self.estimate.converged, log_errors=self.log_errors,
            cautions=[f.message for f in self.findings if f.code in _CAUTIONS],
            scale=entries()["scale"]["what"]["gains"] if self.is_scaled_by_gain else "",
            knows_torques=self.loop.kind == "torque" or self.fit.simulator.knows_torques,
        )  # fmt: skip


def identify_loops(
    model: RobotModel,
    logs: Sequence[Log],
    validation: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    signals: SignalSettings | None = None,
    chooses: bool = True,
    examined: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    units: Sequence[str] = (),
    progress: ProgressCallback = ignore_progress,
) -> PositionIdentification:
    """Identify drives, loops and bodies from logs of commands and positions."""
    if not logs:
        raise DataError("no log was given. An identification needs at least one log")
    used = signals or SignalSettings()
    if loop.kind == "torque":
        logs, validation = (
            [driven_log(model, log, used) for log in part] for part in (logs, validation)
        )
    if loop.gravity_compensation:
        logs, validation = (
            [with_gravity(model, log) for log in part] for part in (logs, validation)
        )
    fitted = fit_loops(
        model, logs, loop, settings, signals=signals, chooses=chooses, progress=progress
    )
    report_stage(progress, "testing", STAGES)
    sign, simulator = fitted.encoders.sign, fitted.simulator
    robot = simulator.fine or simulator.robot  # with the steps of the fit
    others = _others(model, loop, fitted)
    runs = [
        [run_open_loop(robot, fitted.loops, log.turned(sign), others) for log in part]
        for part in (logs, validation)
    ]
    errors = blocking(examined, ignore)
    of_logs = loop_runs(model, simulator, fitted.estimate, units)
    extended = with_terms(model, fitted.loops)
    standard, slopes = simulator.standard(extended, fitted.estimate.theta)
    covariance = slopes @ fitted.estimate.covariance @ slopes.T
    mapping = structural_mapping(extended)
    result = PositionIdentification(
        model=extended, mapping=mapping, prior=extended.standard_parameters(), standard=standard,
        standard_covariance=covariance, base=mapping.to_base(standard),
        base_error=_errors(mapping.K @ covariance @ mapping.K.T), loop=loop, estimator=settings,
        fit=fitted, fitted=tuple(runs[0]), validation=tuple(runs[1]),
        log_errors=tuple(m for cause in grouped(errors) for m in cause.messages),
        stated=StatedSettings(used, ignore=tuple(ignore)),
        variation=vary([log.name for log in logs], of_logs, sorted(set(units))),
    )  # fmt: skip
    examined = [*examined, *unlike_findings(result.variation)]
    return replace(result, findings=(*loop_findings(result, examined), *not_written(errors)))


def _others(model: RobotModel, loop: LoopSettings, fitted: Fitted) -> dict[str, Loops]:
    """Return simpler models by name; the URDF's has stated gains, no friction, no rotor inertia."""
    if fitted.linear is not None:
        driven, from_rows = fitted.linear.urdf_with_drives, fitted.linear.standard
        return {"urdf": open_loops(model, driven), "rows": open_loops(model, from_rows)}
    others = {} if fitted.plain is None else {"second_order": fitted.plain.loops}
    if loop.kp is not None and not any(u.what == "kp" for u in fitted.simulator.free_parameters):
        n, stated = len(model.joints), stated_loops(model, loop)
        bare = replace(stated, terms=((),) * n, values=np.zeros(0), armature=np.full(n, 1e-9))
        others["urdf"] = bare
    return others


def with_gravity(model: RobotModel, log: Log) -> Log:
    """Return a log with the URDF's gravity torque at the measured position added to tau_ref."""
    torque = predict_instants(model, model.standard_parameters(), log.q)
    return replace(log, tau_ref=torque if log.tau_ref is None else log.tau_ref + torque)


def driven_log(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log whose feed-forward torque is the measured one, and its position the command."""
    # constant between two rows: the mean of the two, which avoids a delay of half a row
    log = unwrap(log, np.array([joint.turns_freely for joint in model.limits]))
    measured = np.column_stack(
        [np.interp(log.t + signals.torque_delay, log.t, tau) for tau in log.tau.T]
    )
    tau = np.vstack([0.5 * (measured[1:] + measured[:-1]), measured[-1:]])
    return replace(log, q_ref=log.q, v_ref=None, tau_ref=tau)


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
    runs_of = []
    for places in groups.values():
        group_scores = [(H[:, places][:, :, places], g[:, places]) for H, g in scores]
        H, h = (np.array([pair[k].sum(axis=0) for pair in group_scores]) for k in (0, 1))
        if not H.any():
            continue
        members = [simulator.free_parameters[k] for k in places]
        centre, spread = estimate.theta[places], simulator.prior_std[places]
        spread = np.where(np.isfinite(spread), spread, 0.0)
        scale = np.maximum(PLAUSIBLE * np.abs(centre), np.maximum(_LEAST * spread, LEAST_DIVISOR))
        group = Group(
            "drive", members[0].name.rpartition(".")[0], tuple(free.name for free in members),
            tuple(units_of(model, free) for free in members), np.zeros((0, len(members))),
            members[0].joints,
        )  # fmt: skip
        inflation = inflation_of(group_scores)
        runs = Runs(H / inflation, h / inflation, units, scale)
        runs_of.append(RunsOf(group, centre, runs, inflation))
    return tuple(runs_of)


def units_of(model: RobotModel, free: FreeParameter) -> str:
    """Return the unit of a free parameter of a loop or drive."""
    is_linear = model.joints[free.joints[0]] in model.layout.prismatic
    like = {"kp": Spring(), "kd": TERMS["viscous"], "limit": TERMS["coulomb"]}
    term = free.term or like.get(free.what) or TERMS.get(free.what)
    if term is not None:
        return term.units[is_linear]
    return {"delay": "s"}.get(free.what, "m" if is_linear else "rad")


def _largest_quantile(slopes: Array, quantile: Array) -> Array:
    """Return the largest quantile of the parameters on which each quantity depends."""
    return np.asarray(np.where(slopes != 0.0, quantile, QUANTILE).max(axis=1, initial=QUANTILE))


def _errors(covariance: Array) -> Array:
    """Return standard errors; inf of entries without a variance."""
    variance = np.diag(covariance)
    return np.where(variance > 0.0, np.sqrt(np.maximum(variance, 0.0)), np.inf)


def logged_motion(log: Log) -> Trajectory:
    """Return the motion of a log of commands: positions and their numerical derivatives."""
    dt, v, still = np.diff(log.t), np.zeros_like(log.q), np.zeros_like(log.q)
    segment = np.append(0, np.cumsum(dt > LOOP_GAP * np.median(dt)))
    for rows in (segment == k for k in range(segment[-1] + 1)):
        if rows.sum() > 1:
            v[rows] = np.gradient(log.q[rows], log.t[rows], axis=0)
    return Trajectory(log.t, log.q, v, still, still, log.joints, None, segment)


def loop_findings(
    result: PositionIdentification, examined: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Return the findings of logs and fit, the most severe first."""
    # Bodies connect the joints: a cause that the logs show explains what the fit finds of others.
    settled, found = [_settled_delay(one, result) for one in examined], list[Finding]()
    causes = [one for one in settled if one.code in codes_with("names_cause")]
    drives = [one for one in _of_drives(result) if not causes or one.code != "position_offset"]
    causes += (one for one in drives if one.code in codes_with("names_cause"))
    if result.has_gains and all(one.severity == "note" for one in causes):
        with suppress(NotConvergedError, DataError):  # a log that cannot be simulated, or is short
            found.extend(_other_gains(result))
        found.extend([] if causes or found else _valid_bands(result))
    of_fit = _of_fit(result, is_explained=bool(causes or found))
    return by_severity([*settled, *drives, *of_fit, *found])


def _of_fit(result: PositionIdentification, *, is_explained: bool) -> Iterator[Finding]:
    """Yield the findings of the fit; ``is_explained``: others name a cause."""
    estimate = result.estimate
    if not estimate.converged:
        yield finding("not_settled", subject="fit", steps=estimate.n_iter)
    if not result.has_stated_gains and not result.fit.simulator.knows_torques:
        yield finding("scale", subject="controller", what="urdf")
    mismatch = result.fit.simulator.torque_mismatch(estimate.theta)
    for joint, share in zip(result.model.joints, mismatch.tolist(), strict=True):
        if share > _MISMATCH:
            yield finding("torque_mismatch", "", joint, missed_pct=100 * share)
    if result.is_scaled_by_gain:
        yield finding("scale", severity="note", subject="controller", what="gains")
    scale, factor = result.fit.scale, 1.0
    if scale is not None and scale.is_wrong:  # bodies or torques indicate other gains
        factor += scale.common
        kp = zip(result.model.joints, (factor * result.fit.loops.kp).tolist(), strict=True)
        yield finding(
            "gains_contradicted", subject="controller", what=result.fit.simulator.knows_torques,
            agreeing=listed([f"{joint} = {value:.3g}" for joint, value in kp], NAMED),
            scale=factor, std_error=scale.common_error,
        )  # fmt: skip
    if (halving := float(estimate.details.get("halving", 0.0))) > 1.0:
        step = float(estimate.details["step"])
        yield finding("coarse_steps", subject="fit", halving=halving, step=step, limit=CHANGE)
    yield from _at_bound(result, is_explained=is_explained)
    for together in result.correlated:
        yield _named("correlated_terms:commands", together)
    if names := result.undetermined:
        has_gains = any(name.endswith((".kp", ".kd")) for name in names)
        yield _named("undetermined:commands", names, cure=has_gains)
    moves = np.any([run.moves for run in result.fitted], axis=0)
    friction = [x for x in result.fit.simulator.free_parameters if x.what == "term"]
    at_rest = [x.name for x in friction if not moves[list(x.joints)].any()]
    if left := [name for name in at_rest if name not in names]:
        yield _named("undetermined:rest", left)
    yield from _unequal_gains(result)
    yield from _encoder_findings(result)
    for tried in result.fit.tried:
        figures: Any = {"terms": " and ".join(tried.terms), "gain_pct": min(100 * tried.gain, 100)}
        if tried.dropped and not is_explained:
            yield finding("friction_dropped", "", tried.joint, **figures, dropped=tried.dropped)
        elif tried.is_chosen:
            yield finding("friction_found", "", tried.joint, **figures)


def _named(code: str, names: Sequence[str], **values: Any) -> Finding:  # noqa: ANN401
    """Return a finding about parameters."""
    words = listed(names, NAMED)
    return finding(code, subject=words, names=words, **values)


def _settled_delay(examined: Finding, result: PositionIdentification) -> Finding:
    """Return a finding of the logs; "slow_command" is a note if the fit determines the delay."""
    if examined.code != "slow_command":
        return examined
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    errors = estimate.std_error[[free.what == "delay" for free in free_parameters]].tolist()
    is_at_bound = any(name.endswith("delay") for name in estimate.details["at_bound"])
    error = max(errors, default=0.0)
    if is_at_bound or error > _KNOWN * examined.evidence["longest"]:
        return examined
    what, figures = "fitted" if errors else "stated", {**examined.evidence, "std_error": error}
    return finding("slow_command:known", examined.log, examined.joints, what=what, **figures)


def _at_bound(result: PositionIdentification, *, is_explained: bool) -> Iterator[Finding]:
    """Yield which parameters are estimated at a bound, and what to do about it."""
    estimate, free_parameters = result.estimate, result.fit.simulator.free_parameters
    values = zip(free_parameters, estimate.theta.tolist(), strict=True)
    if largest := {free.name: free.highest for free, value in values if value >= free.highest}:
        yield _named("at_bound:largest", [f"{name} = {x:g}" for name, x in largest.items()])
    others = [x for x in free_parameters if x.name in {*estimate.details["at_bound"]} - {*largest}]
    least = [f"{x.name} = {x.lowest:.3g}" for x in others if x.what in POSITIVE]
    if at_zero := [x.name for x in others if x.what not in (*POSITIVE, "delay")]:
        stated = [x for x in ("kp", "kd", "delay") if getattr(result.loop, x) is not None]
        gains = [name for name in stated if name != "delay"]
        is_wrong = bool(stated) and not is_explained
        words = {"stated": " or ".join(stated), "own": " and ".join(gains)}
        todo = {"gains": is_wrong and bool(gains), "late": "delay" in stated}
        yield _named("at_bound:zero", at_zero, wrong=is_wrong, **words, **todo)
    if least:
        yield _named("at_bound:least", least)


def _unequal_gains(result: PositionIdentification) -> Iterator[Finding]:
    """Yield which joints with equal limits in the URDF have gains that differ, fitted alone."""
    free = [x for x in result.fit.simulator.free_parameters if x.what == "kp"]
    alike: dict[tuple[str, float, float], list[int]] = {}
    for j in (x.joints[0] for x in free if len(x.joints) == 1):
        limit = result.model.limits[j]
        alike.setdefault((limit.type, limit.effort, limit.velocity), []).append(j)
    for (_, effort, _), joints in alike.items():
        kp = result.fit.loops.kp[joints]
        if kp.max() > _UNEQUAL * kp.min() > 0 and np.isfinite(effort):
            names = [result.model.joints[j] for j in joints]
            ends, group = {"lowest": kp.min(), "highest": kp.max()}, listed(map(quoted, names))
            yield finding("unequal_gains", "", names, **ends, group=group)


def _other_gains(result: PositionIdentification) -> Iterator[Finding]:
    """Yield logs with other gains than the fit, of joints whose simulated positions are wrong."""
    errors, fit = np.max([_relative_errors(run) for run in result.fitted], axis=0), result.fit
    loops, runs, others, least = fit.loops, result.validation, "the fit", errors / BETTER
    if len(result.fitted) > 1 and errors.max() > GOOD:  # the logs may contradict each other
        first, *rest = result.fitted
        loops, others, least = fit_one_log(fit, first.log), first.log.name, 0.0 * errors
        runs = (*rest, *runs)
    for run in runs:
        joints = np.flatnonzero(_relative_errors(run) > np.maximum(least, GOOD_POSITION))
        found: dict[int, dict[str, float]] = {}
        for j, figures in fit_gains(fit.simulator, loops, run.log, joints).items():
            # the motion with a missing friction term may have a gain that differs by some 30 %
            ratio = max(figures["ratio"], LEAST_DIVISOR)
            change, error = abs(np.log(ratio)), figures["std_error"] / ratio
            if figures["after"] < BETTER * figures["before"] and change > BETTER + 2 * error:
                found[j] = figures
        gains = _stated_gains(result, run.log, found)
        for j, figures in found.items():
            joint = result.model.joints[j]
            yield finding("other_gains", run.log.name, joint, others=others, gains=gains, **figures)


def _stated_gains(
    result: PositionIdentification, log: Log, found: Mapping[int, Mapping[str, float]]
) -> str:
    """Return the entry of a job file that states the gains found for joints in a log."""
    joints, entries = result.model.joints, list[str]()
    for factors, (name, key) in zip(log.gain_factors, _GAINS.items(), strict=True):
        own = factors * by_joint(getattr(result.loop, name), joints, f"controller: {name}", 1.0)
        entries += [
            f"{name}.{joints[j]} = {x[key] * own[j]:.3g}" for j, x in found.items() if x[key]
        ]
    return f"controller = {{ {', '.join(entries)} }}"


def _valid_bands(result: PositionIdentification) -> Iterator[Finding]:
    """Yield up to which frequency the model predicts a joint whose position error is not small."""
    for run in result.validation or result.fitted:
        for j in np.flatnonzero(_relative_errors(run) > GOOD_POSITION).tolist():
            if (band := run.valid_band(j)) and 100.0 * band["below"] < GOOD_POSITION:
                yield finding("model_bandwidth", run.log.name, result.model.joints[j], **band)


def _relative_errors(run: PositionEvaluation) -> Array:
    """Return the errors of simulated positions, shape (n,) [% of the RMS motion]; 0 at rest."""
    return 100.0 * np.divide(run.rmse, run.spread, where=run.moves, out=np.zeros(len(run.rmse)))


def _of_drives(result: PositionIdentification) -> Iterator[Finding]:
    """Yield what limits, delays and offsets of the drives say, and which joints share a drive."""
    model, estimate, free = result.model, result.estimate, result.fit.simulator.free_parameters
    away = [run.log.q_ref - run.log.q for run in result.fitted if run.log.q_ref is not None]
    for x, value, error in zip(free, estimate.theta, estimate.std_error, strict=True):
        joint, is_bound = model.joints[x.joints[0]], x.name in estimate.details["at_bound"]
        figures: Any = {"std_error": error, "unit": units_of(model, x)}
        if x.what == "limit" and not is_bound:
            severity = "note" if result.loop.limit == "find" else "warning"
            yield finding("limit", "", joint, severity=severity, limit=value, **figures)
        elif x.what == "delay" and (is_bound or value < -QUANTILE * error):
            code = "no_delay" if is_bound else "no_delay:early"
            yield finding(code, subject=x.name, delay=value)
        elif x.what == "armature" and len(x.joints) > 1 and not result.loop.groups:
            yield finding("shared_drives", "", [model.joints[j] for j in x.joints])
        elif x.term == TERMS["offset"] and result.has_gains:
            kp = float(result.fit.loops.kp[x.joints[0]])
            if abs(value) > np.sqrt(np.mean((kp * np.vstack(away)[:, x.joints] - value) ** 2)):
                figures |= {"torque": value, "offset": value / kp}
                length = "m" if joint in model.layout.prismatic else "rad"
                yield finding("position_offset:commands", "", joint, length=length, **figures)


def _encoder_findings(result: PositionIdentification) -> Iterator[Finding]:
    """Yield zero and sign of each encoder relative to the URDF, with the evidence for them."""
    if result.loop.zeros != "find":
        return
    encoders, undetermined = result.fit.encoders, []
    for j, joint in enumerate(result.model.joints):
        figures = {key: values[j] for key, values in vars(encoders).items()}
        figures["zero"] = result.fit.loops.zero[j]
        other = bool(encoders.next_sign[j] != encoders.sign[j])
        if encoders.gain[j] > 0:
            sense = bool(encoders.sign[j] < 0)
            yield finding("encoder", "", joint, sense=sense, other=other, **figures)
        elif encoders.margin[j] > CLEAR:
            yield finding("encoder_uncorrected", "", joint, other=other, **figures)
        else:
            undetermined.append(j)
    if undetermined:
        names = [result.model.joints[j] for j in undetermined]
        margin = max(0.0, *encoders.margin[undetermined])
        yield finding("encoder_undetermined", "", names, margin=margin)
    for chain in parallel_axes(result.model):
        yield finding("mirror_image", "", chain)
