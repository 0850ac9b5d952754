"""The stages of a closed-loop identification: initial values, fit, friction terms, step size."""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import compress, product
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.base.findings import listed
from robotid.base.typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.units import is_trustworthy
from robotid.diagnosis.logs.command_channels import largest_speeds
from robotid.diagnosis.verdict.verdict import BEATEN, GOOD_POSITION, HARDLY
from robotid.dynamics.simulation.loops import (
    ClosedLoopRobot,
    Loops,
    Window,
    cut_windows,
    open_loops,
)
from robotid.dynamics.simulation.simulation_settings import by_joint
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import OutputError
from robotid.estimation.fitting.estimator_settings import EstimatorSettings, SimulationSettings
from robotid.identification.closed_loop.initial_values import (
    Encoders,
    SecondOrder,
    find_encoders,
    first_loops,
    fit_second_order,
    free_drive_parameters,
    free_zeros,
    is_stated,
    likeness,
    same_encoders,
    typical_sizes,
    typical_sizes_of_torques,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings, groups_of
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    GainScale,
    LoopSimulator,
    TorqueRows,
    Tried,
    candidates,
    choose,
    find_gains,
    free_body_parameters,
    gain_scale,
    impossible,
    measured_motion,
    with_terms,
)
from robotid.identification.closed_loop.position_errors import DRIFTS
from robotid.identification.pipeline import conclude, in_memory
from robotid.identification.result import TorqueIdentification
from robotid.robot.model import RobotModel

_log = logging.getLogger(__name__)

#: Largest change of a parameter by halving the steps [standard errors].
CHANGE = 0.2
#: The stages of a job's fit, from reading logs to writing files.
STAGES = (
    "reading logs", "fitting torques", "trying second-order models", "fitting loops",
    "trying friction terms", "testing", "writing",
)  # fmt: skip


_WHITE = 2.0  # cut-off of the whitening, relative to 1 / time constant of the loop
_SCALES = (1.0, 0.1, 10.0, 0.01, 1e3)  # of torques with unknown gains; at 1e3 bodies hardly count
_FEW = 12  # number of windows of the first fit; fits before the last one have four times as many
_STARTS = 3  # number of fits with improved initial states of the windows
_WINDOW, _LEAD = 2.5, 0.6  # default window and lead of closed-loop simulations [s]
_BOTH = 2.0  # of variances: the noise of a torque is in its rows and in the simulation it drives
_HALVINGS = 4  # largest number of halvings of the step, and of steps with initial states together
_RAISED = 1e-2  # largest increase of the mean log residual in such a step
_PASSES = 2  # of choosing terms and fitting again


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of the fit."""

    simulator: LoopSimulator  # the robot with its free parameters, and the windows
    estimate: Estimate
    #: The second-order model of each joint; None where the logged torque drives the robot.
    plain: SecondOrder | None
    encoders: Encoders  # zeros and signs of the encoders relative to the URDF's joints
    tried: tuple[Tried, ...]  # the friction terms that were tried, with their gains
    #: The identification from the torque rows alone, where the torque drives the robot.
    linear: TorqueIdentification | None = None
    #: Scale of the stated gains by bodies and torques; None where gains are fitted.
    scale: GainScale | None = None

    @property
    def loops(self) -> Loops:
        """Bodies, drives and loops at the estimate."""
        return self.simulator.loops(self.estimate.theta)


def fit_loops(
    model: RobotModel,
    logs: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    signals: SignalSettings | None = None,
    chooses: bool = True,
    progress: ProgressCallback = ignore_progress,
) -> Fitted:
    """Fit drives, loops and bodies to logs of commands and positions."""
    task = _Task(model, logs, loop, settings, signals or SignalSettings(), progress)
    _check_logs(logs, loop, settings)
    initialise = _initialise_from_torque if loop.kind == "torque" else _initialise_from_commands
    initialised, theta = _best_start(initialise(task))
    simulator, estimator = initialised.simulator, initialised.estimator
    is_plain, every = initialised.linear is None, simulator.windows
    if is_plain:
        simulator = replace(simulator, windows=_few(every, 4 * _FEW))
    if len(simulator.windows) < len(every):
        _log.warning(
            "%.0f s of logs are simulated in each step of the fit, which takes minutes: to be "
            "faster, select parts with start and end",
            sum(np.ptp(log.t) for log in logs),
        )
    for left in reversed(range(_STARTS)):
        if not left and np.any(initialised.limited):
            simulator, theta = _with_limits_reached(initialised, simulator, theta)
        if not left and len(simulator.windows) < len(every):
            simulator = replace(simulator, windows=every).with_better_start(theta)
        simulator = simulator.with_better_start(theta)
        if simulator.lag is not None:
            loops, is_free = simulator.loops(theta), _free_gains(loop, model)
            outs = simulator.robot.roll_out(loops, _few(simulator.windows))
            lag, _ = find_gains(outs, loops, is_free, knows_delay=True, is_whole=left > 0)
            simulator = replace(simulator, lag=lag)
        # one round is enough while the initial states or the terms still change
        is_rough = is_plain and (left > 0 or chooses)
        if is_rough:
            theta = replace(estimator, rounds=1).minimise(simulator, theta)
        else:
            estimate = estimator.fit(simulator, theta)
            theta = estimate.theta
        if left:
            theta = estimator.joint_step(simulator, theta)
        if initialised.linear is not None and simulator.torque is not None:
            estimator = replace(estimator, inflation=_BOTH * estimate.details["inflation"])
    fitted = (simulator, theta, None if is_rough else estimate)
    dropped: dict[str, Tried] = {}
    while True:
        simulator, estimate, tried = _with_chosen_terms(
            task, initialised, estimator, fitted, dropped, passes=_PASSES if chooses else 0
        )
        failing = impossible(simulator, estimate.theta, tried)
        try:
            if initialised.linear is None and not failing:
                simulator, estimate = refine_steps(simulator, estimator, estimate)
        except NotConvergedError as error:
            failing = {t: str(error) for t in tried if t.is_chosen}
            if not failing:
                raise
        if not failing:
            break
        for t, why in failing.items():
            dropped[f"{t.joint}.{t.terms[0]}"] = replace(t, is_chosen=False, dropped=why)
    is_scaled = initialised.linear is None and is_stated(loop.kp, model).all()
    scale = gain_scale(simulator, estimator, estimate) if is_scaled else None
    others = (initialised.encoders, tuple(tried), initialised.linear, scale)
    return Fitted(simulator, estimate, initialised.plain, *others)


def fit_one_log(fitted: Fitted, log: Log) -> Loops:
    """Return the loops with drives and gains, but no bodies, fitted to one log."""
    free = [x.what != "body" for x in fitted.simulator.free_parameters]
    drives = tuple(compress(fitted.simulator.free_parameters, free))
    windows = _few(cut_windows(log, _WINDOW, _LEAD))
    alone = replace(fitted.simulator, windows=windows, base=fitted.loops, free_parameters=drives)
    return alone.loops(OutputError(rounds=1).minimise(alone, fitted.estimate.theta[free]))


def fit_gains(
    simulator: LoopSimulator, loops: Loops, log: Log, joints: Array
) -> dict[int, dict[str, float]]:
    """Return the gains of joints (k,) fitted to one log, all else unchanged; {} if it fails."""
    # relative to those of the loops: the ratio of kp with its standard error, and of kd, 0 without
    # one; and the errors of simulated positions before and after [% of RMS motion]
    windows, own = _few(cut_windows(log, _WINDOW, _LEAD)), np.stack([loops.kp, loops.kd])[:, joints]
    pairs = [(what, int(j)) for what in ("kp", "kd") for j in joints]
    free = tuple(FreeParameter(f"{w} {j}", w, (j,), 0.0, np.inf, 0.0) for w, j in pairs)
    alone, errors = LoopSimulator(simulator.fine or simulator.robot, windows, loops, free), []
    for factor in 2.0 ** np.arange(-3, 4) if pairs else ():
        # if kd grows with the root of kp, the damping ratio stays the same
        start = (own * [[factor], [np.sqrt(factor)]]).reshape(-1)
        with suppress(NotConvergedError):
            errors.append((_errors_of(alone, alone.loops(start))[joints].sum(), start))
    if not errors:
        return {}
    estimate = OutputError(whitens=False).fit(alone, min(errors, key=lambda x: float(x[0]))[1])
    before, after = (_errors_of(alone, x)[joints] for x in (loops, alone.loops(estimate.theta)))
    k, names = len(joints), ("ratio", "kd_ratio", "std_error", "before", "after")
    ratios = np.divide(estimate.theta.reshape(2, k), own, where=own > 0.0, out=np.zeros_like(own))
    rows = np.array([*ratios, estimate.std_error[:k] / own[0], before, after]).T.tolist()
    return {j: dict(zip(names, row, strict=True)) for (_, j), row in zip(pairs, rows, strict=False)}


@dataclass(frozen=True, eq=False)
class _Task:
    """What is fitted, and how."""

    model: RobotModel
    logs: Sequence[Log]
    loop: LoopSettings
    settings: SimulationSettings
    signals: SignalSettings
    progress: ProgressCallback

    def windows(self, logs: Sequence[Log], length: float, lead: float) -> tuple[Window, ...]:
        """Return the windows of logs, of the stated length and lead or these."""
        length = self.settings.window or length
        lead = lead if self.settings.lead is None else self.settings.lead
        return tuple(w for log in logs for w in cut_windows(log, length, lead))

    def from_rows(self, model: RobotModel) -> TorqueIdentification:
        """Return the identification from the torques alone, with the model's friction terms."""
        recordings = in_memory(model, self.signals, self.logs)
        return conclude(recordings, EstimatorSettings(), friction="none")

    def bodies(self, robot: ClosedLoopRobot) -> list[FreeParameter]:
        """Return the free parameters of bodies."""
        spread = self.settings.bodies
        return free_body_parameters(robot, spread) if spread else []


def _with_chosen_terms(
    task: _Task,
    initialised: "_Initial",
    estimator: OutputError,
    fitted: tuple[LoopSimulator, Array, Estimate | None],
    dropped: Mapping[str, Tried],
    *,
    passes: int,
) -> tuple[LoopSimulator, Estimate, list[Tried]]:
    """Return the fit with the terms that held-out windows confirm, without ``dropped`` ones."""
    simulator, theta, estimate = fitted  # no estimate of a rough fit
    tried: list[Tried] = []
    for _ in range(passes):
        report_stage(task.progress, "trying friction terms", STAGES)
        known = {*simulator.names, *dropped}
        offered = [x for x in candidates(simulator, initialised.torque) if x[0].name not in known]
        uninflated = replace(estimator, inflation=1.0)
        judged = choose(*_with(simulator, theta, offered), offered, uninflated)
        tried = [*(t for t in tried if t.is_chosen), *judged]
        chosen = [set_ for set_, t in zip(offered, judged, strict=True) if t.is_chosen]
        if not chosen and estimate is not None:
            break
        report_stage(task.progress, "fitting loops", STAGES)
        simulator, theta = _with(simulator, theta, chosen)
        if simulator.torque is not None:
            from_rows = task.from_rows(with_terms(task.model, simulator.base))
            inflation = 1.0 if initialised.linear is None else _BOTH
            simulator = replace(simulator, torque=torque_rows(from_rows, inflation))
        estimate = estimator.fit(simulator, theta)
        theta = estimate.theta
    assert estimate is not None  # of a rough fit, the first pass makes it
    return simulator, estimate, [*tried, *dropped.values()]


def _best_start(initial: "_Initial") -> tuple["_Initial", Array]:
    """Return the initial values with the best first fit, and its parameters, shape (c,)."""
    # Other scales of torques are tried if an error is large and hardly smaller than that of the
    # second-order model; limits if it is large, and taken if it is then clearly smaller: they also
    # fit what is no limit. Each group of joints with one gain takes its best.
    if initial.vary is None or initial.plain is None:
        return _first_fit(initial)[:2]
    n, groups, fits = len(initial.torque), np.array(initial.groups), []
    factor, limited, best = np.ones(n), np.zeros(n, dtype=bool), np.full(n, np.inf)
    second_order = _errors_of(initial.simulator, initial.plain.loops)
    for scale, has_limit in initial.starts:
        try:
            fits.append(_first_fit(initial.vary(np.full(n, scale), np.full(n, has_limit))))
        except NotConvergedError as exception:
            failure = exception
            continue
        error = fits[-1][2]
        enough = HARDLY if has_limit else 1.0 / BEATEN
        for members in (groups == group for group in set(initial.groups)):
            if np.mean(error[members] / best[members]) < enough:
                factor[members], limited[members], best[members] = scale, has_limit, error[members]
        may_limit = not has_limit and (scale, True) in initial.starts
        if not ((best > GOOD_POSITION) & (may_limit | (best > HARDLY * second_order))).any():
            break
    if not fits:
        raise failure
    fits.sort(key=lambda fit: float(fit[2].max()))
    chosen = [x for x in fits if (x[0].factor == factor).all() and (x[0].limited == limited).all()]
    if not chosen:  # several groups, each from its best
        with suppress(NotConvergedError):
            chosen = [_first_fit(initial.vary(factor, limited))]
    initialised, theta, _ = (chosen or fits)[0]
    return initialised, theta


def _with_limits_reached(
    initial: "_Initial", simulator: LoopSimulator, theta: Array
) -> tuple[LoopSimulator, Array]:
    """Return the simulator without limits that were not asked for and do not change the motion."""
    loops = simulator.loops(theta)
    unlimited = replace(loops, limit=np.where(initial.limited, np.inf, loops.limit))
    matters = _errors_of(simulator, unlimited) > BEATEN * _errors_of(simulator, loops)
    if initial.vary is None or (matters | ~initial.limited).all():
        return simulator, theta
    other = initial.vary(initial.factor, initial.limited & matters).simulator
    values = dict(zip(simulator.names, theta.tolist(), strict=True))
    for name in {*simulator.names}.difference(other.names):
        if name.endswith(".kd"):
            values[name.removesuffix("kd") + "viscous"] += values[name]
    common = tuple(free for free in simulator.free_parameters if free.name in other.names)
    base = replace(simulator.base, limit=other.base.limit)
    simulator = replace(simulator, base=base, free_parameters=common)
    return simulator, np.array([values[name] for name in simulator.names])


def _first_fit(initial: "_Initial") -> tuple["_Initial", Array, Array]:
    """Return initial values, parameters of a first fit of the drives to few windows, its errors."""
    # with free bodies, many scales have nearly the same residual
    simulator = initial.simulator
    drives = tuple(free for free in simulator.free_parameters if free.what != "body")
    few = replace(simulator, windows=_few(simulator.windows), free_parameters=drives)
    theta = simulator.prior.copy()
    theta[np.isin(simulator.names, few.names)] = replace(initial.estimator, rounds=1).minimise(few)
    return initial, theta, _errors_of(simulator, simulator.loops(theta))


def _errors_of(simulator: LoopSimulator, loops: Loops) -> Array:
    """Return errors of simulated positions in few windows, (n,) [% of RMS motion]; 1 % at rest."""
    outs = simulator.robot.roll_out(loops, _few(simulator.windows))
    q, q_ref = (
        np.concatenate([getattr(out.window.log, name)[out.window.counted] for out in outs])
        for name in ("q", "q_ref")
    )
    error = q - np.concatenate([out.q for out in outs])
    share: Array = 100.0 * np.sqrt(np.mean(error**2, axis=0)) / np.maximum(q.std(axis=0), 1e-12)
    return np.where(np.ptp(q_ref, axis=0) > 0.0, share, 1.0)


@dataclass(frozen=True, eq=False)
class _Initial:
    """The initial values of a fit."""

    simulator: LoopSimulator
    estimator: OutputError
    torque: Array  # typical torques, shape (n,) [N m or N]
    encoders: Encoders
    plain: SecondOrder | None = None
    linear: TorqueIdentification | None = None
    groups: tuple[str, ...] = ()  # of joints with one gain
    #: Scales of the torques from which fits may start, and whether torque limits are fitted.
    starts: tuple[tuple[float, bool], ...] = ((1.0, False),)
    factor: Array = field(default_factory=lambda: np.ones(1))  # of the scale of torques, (n,)
    #: Whether a limit is fitted that was not asked for, shape (n,), bool.
    limited: Array = field(default_factory=lambda: np.zeros(1, dtype=bool))
    #: Returns other initial values by scales, shape (n,), and by which torque limits are fitted.
    vary: "Callable[[Array, Array], _Initial] | None" = None


def _initialise_from_commands(task: _Task) -> _Initial:
    """Return closed loops on commands, initialised with a second-order model of each joint."""
    model, loop, settings = task.model, task.loop, task.settings
    robot = ClosedLoopRobot(model, step=settings.step)
    encoders = find_encoders(model, task.logs) if loop.zeros == "find" else same_encoders(model)
    logs = [log.turned(encoders.sign) for log in task.logs]
    task = replace(task, logs=logs)
    windows = task.windows(logs, _WINDOW, _LEAD)
    stated = replace(stated_loops(model, loop), zero=encoders.zero)
    uses_torques = settings.torques and all(log.has_torque for log in logs)
    has_gain, lag = is_stated(loop.kp, model), None
    if uses_torques and loop.rate is None:
        is_free = _free_gains(loop, model)
        moved = [measured_motion(window) for window in _few(windows)]
        lag, matched = find_gains(
            moved, stated, is_free, knows_delay=loop.delay is not None, is_whole=True
        )
        has_gain, stated = has_gain | (matched.kp != stated.kp), matched
    report_stage(task.progress, "trying second-order models", STAGES)
    second_order = cache(partial(fit_second_order, robot, windows, stated, loop.delay is None))
    plain, groups = second_order(False), groups_of(loop, model.joints, likeness(model))
    saturated = [largest_speeds(log) for log in logs]
    # speed of the joints that run at their largest one, 0 of others
    top = np.array([max(x.get(joint, 0.0) for x in saturated) for joint in model.joints])
    may_limit = ~is_stated(None if loop.limit == "find" else loop.limit, model)
    top, may_limit = np.where(may_limit, top, 0.0), may_limit & (loop.limit != "find")
    # positions alone determine kd + viscous friction, except at a limit or if kd differs by log
    differs = np.ptp([log.gain_factors[1] for log in logs], axis=0) > 0.0
    finds_kd = differs | uses_torques | all(log.v_ref is not None for log in logs)
    dt = max(float(np.median(np.diff(log.t))) for log in logs)
    most = np.tile(np.exp(-_WHITE * dt / plain.time_constant), 3)  # positions, speeds, torques
    estimator = OutputError(most=most, progress=task.progress)
    scales = (1.0,) if has_gain.all() else _SCALES
    starts = tuple(product(scales, (False, True) if may_limit.any() else (False,)))

    def vary(factor: Array, limited: Array) -> _Initial:
        limited = limited & may_limit
        from_limit = limited | (loop.limit == "find")
        start = plain.replaced(second_order(True), from_limit) if from_limit.any() else plain
        typical = typical_sizes(robot, start, windows, has_gain, top, groups, factor)
        finds_limit = (top > 0.0) | from_limit
        base = first_loops(model, stated, start, typical, finds_limit)
        by_limit = finds_limit | np.isfinite(stated.limit)
        free_parameters = free_drive_parameters(
            model, loop, groups, base, typical, row=dt,
            finds_kd=finds_kd | by_limit, finds_limit=finds_limit,
        )  # fmt: skip
        free_parameters += free_zeros(model, encoders) if loop.zeros == "find" else []
        free_parameters += task.bodies(robot)
        simulator = LoopSimulator(
            robot, windows, base, tuple(free_parameters), velocities=settings.velocities, lag=lag
        )
        if uses_torques and lag is None:
            from_rows = task.from_rows(with_terms(model, base))
            simulator = replace(simulator, torque=torque_rows(from_rows))
        return _Initial(
            simulator, estimator, typical.torque, encoders, plain,
            groups=tuple(groups), starts=starts, factor=factor, limited=limited, vary=vary,
        )  # fmt: skip

    report_stage(task.progress, "fitting loops", STAGES)
    return vary(np.ones(len(top)), np.zeros(len(top), dtype=bool))


def _initialise_from_torque(task: _Task) -> _Initial:
    """Return a robot driven by the logged torque, initialised from the torque rows alone."""
    model, loop, settings = task.model, task.loop, task.settings
    report_stage(task.progress, "fitting torques", STAGES)
    from_rows = task.from_rows(model)
    base = open_loops(model, from_rows.standard)
    if not (settings.torques and settings.bodies):  # these rows determine no bodies of the fit
        base = replace(base, bodies=stated_loops(model, loop).bodies)
    robot = ClosedLoopRobot(model, step=settings.step)
    windows = task.windows(task.logs, DRIFTS, 0.0)
    typical = typical_sizes_of_torques(model, from_rows.standard, base.armature, windows)
    groups = groups_of(loop, model.joints, range(len(model.joints)))
    none = np.zeros(len(groups), dtype=bool)
    free_parameters = free_drive_parameters(
        model, loop, groups, base, typical, row=0.0, finds_kd=none, finds_limit=none
    )
    simulator = LoopSimulator(
        robot, windows, base, (*free_parameters, *task.bodies(robot)),
        torque=torque_rows(from_rows, _BOTH) if settings.torques else None,
        velocities=settings.velocities,
    )  # fmt: skip
    report_stage(task.progress, "fitting loops", STAGES)
    estimator, encoders = OutputError(frees=True, progress=task.progress), same_encoders(model)
    return _Initial(simulator, estimator, typical.torque, encoders, linear=from_rows)


def refine_steps(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Fit roll-outs of smaller steps, halved until a parameter changes by 0.2 standard errors."""
    # Derivatives stay those of the larger steps: they do not change the minimum. All further
    # halvings together would change as much as the last one, which is added to the covariance.
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    step, now = dt / np.ceil(dt / simulator.robot.step - 1e-9), simulator
    for halvings in range(_HALVINGS + 1):
        fine = ClosedLoopRobot(simulator.robot.model, step=0.5 * step, corrects=True)
        half = replace(simulator, fine=fine)
        change, error = estimator.moved(now, half, estimate.theta)
        share = float(np.max(np.abs(change) / np.maximum(error, 1e-300), initial=0.0))
        if share <= CHANGE or halvings == _HALVINGS:
            break
        step, now = 0.5 * step, half
    now, estimate = _settled(now, estimator, estimate)
    covariance = estimate.covariance + np.outer(change, change)
    details = {**estimate.details, "step": step, "halving": share}
    return now, replace(estimate, covariance=covariance, details=details)


def _settled(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Return the estimate with the best initial states of the windows, and these windows."""
    # Fits of the initial states and joint steps alternate; joints that stick may do so without end,
    # and the last change is added to the covariance. Far from the minimum a step may fail.
    level, first = np.inf, estimate.theta
    for _ in range(_HALVINGS):
        try:
            initialised = simulator.with_better_start(estimate.theta)
            settled = estimator.settle(initialised, estimate)
        except NotConvergedError:
            settled = None
        before, level = level, np.inf if settled is None else float(np.mean(np.log(settled.sigma)))
        if settled is None or level > before + _RAISED:
            simulator = simulator.with_better_start(first)
            return simulator, estimator.fit(simulator, first)
        change = settled.theta - estimate.theta
        simulator, estimate = initialised, settled
        if (np.abs(change) <= CHANGE * settled.std_error).all():
            return simulator, estimate
    return simulator, replace(estimate, covariance=estimate.covariance + np.outer(change, change))


def _check_logs(logs: Sequence[Log], loop: LoopSettings, settings: SimulationSettings) -> None:
    """Refuse logs without a compared signal."""
    commands = [x for log in logs for x in (log.q_ref, log.v_ref, log.tau_ref) if x is not None]
    if loop.kind != "torque" and not any(np.ptp(x, axis=0).any() for x in commands):
        raise DataError(
            f"{listed(sorted({log.name for log in logs}))}: the commands of all joints are "
            "constant, expected commands that move at least one joint. Record a motion, or check "
            "the columns of the commands"
        )
    for log in logs if settings.velocities else ():
        if log.v is None or not is_trustworthy(log):
            lack = "velocities that are delayed, coarse, or inconsistent with the positions"
            raise DataError(
                f"estimator: velocities is true, but {log.name} has "
                f"{'no velocities' if log.v is None else lack}. Record columns dq_ of each joint, "
                "or leave velocities out"
            )


def stated_loops(model: RobotModel, loop: LoopSettings) -> Loops:
    """Return the loops as stated, with the URDF's bodies; kp is 1 where it is not given."""
    n, stated = len(model.joints), dict[str, Any]()
    for name, default in (("kp", 1.0), ("kd", 0.0), ("limit", np.inf), ("delay", 0.0)):
        value = getattr(loop, name)
        given = None if value == "find" else value
        stated[name] = by_joint(given, model.joints, f"controller: {name}", default)
    bodies = open_loops(model, model.standard_parameters())
    bare = replace(bodies, armature=np.zeros(n), terms=((),) * n, values=np.zeros(0))
    return replace(bare, rate=loop.rate, **stated)


def _few(windows: Sequence[Window], count: int = _FEW) -> tuple[Window, ...]:
    """Return some of many windows, at least ``count``."""
    return tuple(windows[:: max(1, len(windows) // count)])


def _free_gains(loop: LoopSettings, model: RobotModel) -> Array:
    """Return for which joints position and speed gains are fitted, shape (2, n), bool."""
    return ~np.stack([is_stated(gain, model) for gain in (loop.kp, loop.kd)])


def _with(
    simulator: LoopSimulator, theta: Array, sets: Sequence[tuple[FreeParameter, ...]]
) -> tuple[LoopSimulator, Array]:
    """Return the simulator with further terms at 0, and its parameters."""
    further, loops = [free for free_parameters in sets for free in free_parameters], simulator.base
    terms = [
        (*joint_terms, *(free.term for free in further if free.joints == (j,) and free.term))
        for j, joint_terms in enumerate(loops.terms)
    ]
    values = [
        loops.values[loops.place(j, term)] if term in loops.terms[j] else 0.0
        for j, joint_terms in enumerate(terms)
        for term in joint_terms
    ]
    base = replace(loops, terms=tuple(terms), values=np.array(values))
    wide = replace(simulator, base=base, free_parameters=(*simulator.free_parameters, *further))
    return wide, np.concatenate([theta, np.zeros(len(further))])


def torque_rows(from_torques: TorqueIdentification, inflation: float = 1.0) -> TorqueRows:
    """Return an identification's rows as a triangular factor, weighted by their scatter."""
    weight = from_torques.wls.sigma * np.sqrt(inflation * max(from_torques.errors.inflation, 1.0))
    return TorqueRows(
        from_torques.model, from_torques.factors.weighted(weight), from_torques.mapping.K
    )
