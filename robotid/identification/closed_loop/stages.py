"""The stages of a closed-loop identification: initial values, fit, friction terms, step size."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product

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
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.encoder_zeros import Encoders, find_encoders, same_encoders
from robotid.identification.closed_loop.further_parameters import (
    GainScale,
    Tried,
    candidates,
    choose,
    gain_scale,
    impossible,
)
from robotid.identification.closed_loop.initial_values import (
    SecondOrder,
    first_loops,
    fit_second_order,
    free_drive_parameters,
    free_zeros,
    is_stated,
    likeness,
    typical_sizes,
    typical_sizes_of_torques,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings, groups_of
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    LoopSimulator,
    TorqueRows,
    find_gains,
    free_body_parameters,
    measured_motion,
    with_terms,
)
from robotid.identification.closed_loop.position_errors import DRIFTS
from robotid.identification.pipeline import identify
from robotid.identification.result import TorqueIdentification
from robotid.robot.model import RobotModel

#: Largest change of a parameter by halving the steps [standard errors].
CHANGE = 0.2
#: The stages of a job's fit, from reading logs to writing files.
STAGES = (
    "reading logs", "fitting torques", "trying second-order models", "fitting loops",
    "trying friction terms", "testing", "writing",
)  # fmt: skip


_WHITE = 2.0  # cut-off of the whitening, relative to 1 / time constant of the loop
_SCALES = (1.0, 0.1, 10.0, 0.01, 1e3)  # of torques with unknown gains; at 1e3 bodies hardly count
_FEW = 12  # number of windows of the first fit
_SOME = 48  # number of windows of the fits before the last improvement of initial states
_STARTS = 3  # number of fits with improved initial states of the windows
_WINDOW, _LEAD = 2.5, 0.6  # default window and lead of closed-loop simulations [s]
_BOTH = 2.0  # variance factor: the noise of a torque is in its rows and in the simulation it drives
_FINEST = 16.0  # largest reduction of the step
_SETTLING = 4  # largest number of steps of parameters and initial states together
_RAISED = 1e-2  # largest increase of the mean log residual in such a step
_PASSES = 2  # of choosing terms and fitting again


@dataclass(frozen=True, eq=False)
class Fitted:
    """Result of the fit."""

    simulator: LoopSimulator  # the robot with its free parameters, and the windows
    estimate: Estimate  # the estimate of the free parameters
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
    task = _Task(model, logs, loop, settings, signals, progress)
    _check_settings(model, logs, loop, settings)
    initialise = _initialise_from_torque if loop.kind == "torque" else _initialise_from_commands
    initialised, theta = _best_start(initialise(task))
    simulator, estimator = initialised.simulator, initialised.estimator
    is_plain, every = initialised.linear is None, simulator.windows
    if is_plain:
        simulator = replace(simulator, windows=_few(every, _SOME))
    for left in reversed(range(_STARTS)):
        if not left and np.any(initialised.limited):
            simulator, theta = _with_limits_reached(initialised, simulator, theta)
        if not left and len(simulator.windows) < len(every):
            simulator = replace(simulator, windows=every).with_better_start(theta)
        simulator = simulator.with_better_start(theta)
        if simulator.lag is not None:
            outs = simulator.roll_out(theta, _few(simulator.windows))
            gains, is_last = (simulator.loops(theta), _free_gains(loop, model)), left == 0
            lag, _ = find_gains(outs, *gains, knows_delay=True, is_whole=not is_last)
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
    scale = None
    if initialised.linear is None and is_stated(loop.kp, model).all():
        scale = gain_scale(simulator, estimator, estimate)
    others = (initialised.encoders, tuple(tried), initialised.linear, scale)
    return Fitted(simulator, estimate, initialised.plain, *others)


@dataclass(frozen=True, eq=False)
class _Task:
    """What is fitted, and how."""

    model: RobotModel
    logs: Sequence[Log]
    loop: LoopSettings
    settings: SimulationSettings
    signals: SignalSettings | None
    progress: ProgressCallback

    def windows(self, logs: Sequence[Log], length: float, lead: float) -> tuple[Window, ...]:
        """Return the windows of logs, of the stated length and lead or these."""
        length = self.settings.window or length
        lead = lead if self.settings.lead is None else self.settings.lead
        return tuple(w for log in logs for w in cut_windows(log, length, lead))

    def from_rows(self, model: RobotModel) -> TorqueIdentification:
        """Return the identification from the torques alone, with the model's friction terms."""
        return identify(model, self.logs, signals=self.signals, friction="none", doctor=False)

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
    """Return the fit with the friction terms that held-out windows confirm, and those tried.

    It starts from a simulator, its parameters, and their estimate if the fit is complete; terms
    that were ``dropped`` are not offered again, by name of their first parameter.
    """
    simulator, theta, estimate = fitted
    tried: list[Tried] = []
    for _ in range(passes):
        report_stage(task.progress, "trying friction terms", STAGES)
        offered = [
            set_
            for set_ in candidates(simulator, initialised.torque)
            if set_[0].name not in simulator.names and set_[0].name not in dropped
        ]
        judged = choose(
            *_with(simulator, theta, offered), offered, replace(estimator, inflation=1.0)
        )
        tried = [*(t for t in tried if t.is_chosen), *judged]
        chosen = [set_ for set_, t in zip(offered, judged, strict=True) if t.is_chosen]
        if not chosen and estimate is not None:
            break
        report_stage(task.progress, "fitting loops", STAGES)
        simulator, theta = _with(simulator, theta, chosen)
        if simulator.torque is not None:
            from_rows = task.from_rows(with_terms(task.model, simulator.base))
            simulator = replace(simulator, torque=torque_rows(from_rows, initialised.share))
        estimate = estimator.fit(simulator, theta)
        theta = estimate.theta
    assert estimate is not None  # of a rough fit, the first pass makes it
    return simulator, estimate, [*tried, *dropped.values()]


def _best_start(initial: "_Initial") -> tuple["_Initial", Array]:
    """Return the initial values with the best first fit, and its parameters, shape (c,).

    Others are tried where the error of a joint is larger than that of a good fit and hardly smaller
    than that of its second-order model: other scales of the torques, and torque limits. Each group
    of joints with one gain takes its best. A fit that cannot be simulated is no candidate.
    """
    if initial.vary is None or initial.plain is None:
        return initial, _with_bodies_of_urdf(initial.simulator, initial.estimator)
    n, groups = len(initial.torque), np.array(initial.groups)
    factor, limited, best = np.ones(n), np.zeros(n, dtype=bool), np.full(n, np.inf)
    fits, failures = [], []
    second_order = _errors_of(initial.simulator, initial.plain.loops)
    for has_limit, scale in product((False, True), initial.scales):
        try:
            fits.append(_first_fit(initial.vary(np.full(n, scale), np.full(n, has_limit))))
        except NotConvergedError as failure:
            failures.append(failure)
            continue
        error = fits[-1][2]
        for members in (groups == group for group in dict.fromkeys(initial.groups)):
            if np.mean(error[members] / best[members]) < 1.0 / BEATEN:
                factor[members], limited[members], best[members] = scale, has_limit, error[members]
        if not ((best > GOOD_POSITION) & (best > HARDLY * second_order)).any():
            break
    if not fits:
        raise failures[0]
    chosen = next((fit for fit in fits if fit[0].starts_as(factor, limited)), None)
    if chosen is None:  # several groups, each from its best
        with suppress(NotConvergedError):
            chosen = _first_fit(initial.vary(factor, limited))
    initialised, theta, _ = chosen or min(fits, key=lambda fit: float(fit[2].max()))
    return initialised, theta


def _with_limits_reached(
    initial: "_Initial", simulator: LoopSimulator, theta: Array
) -> tuple[LoopSimulator, Array]:
    """Return the simulator without limits that were not asked for and do not change the motion.

    A speed gain that only a limit distinguishes from viscous friction is part of it without.
    """
    loops = simulator.loops(theta)
    unlimited = replace(loops, limit=np.where(initial.limited, np.inf, loops.limit))
    matters = _errors_of(simulator, unlimited) > BEATEN * _errors_of(simulator, loops)
    if initial.vary is None or (matters | ~initial.limited).all():
        return simulator, theta
    other = initial.vary(initial.factor, initial.limited & matters).simulator
    values = dict(zip(simulator.names, theta.tolist(), strict=True))
    for name in {*simulator.names}.difference(other.names):
        owner, _, what = name.rpartition(".")
        if what == "kd":
            values[f"{owner}.viscous"] += values[name]
    kept = tuple(free for free in simulator.free_parameters if free.name in other.names)
    base = replace(simulator.base, limit=other.base.limit)
    simulator = replace(simulator, base=base, free_parameters=kept)
    return simulator, np.array([values[name] for name in simulator.names])


def _first_fit(initial: "_Initial") -> tuple["_Initial", Array, Array]:
    """Return initial values, the parameters of a first fit, and its errors of positions."""
    theta = _with_bodies_of_urdf(initial.simulator, initial.estimator)
    return initial, theta, _errors_of(initial.simulator, initial.simulator.loops(theta))


def _errors_of(simulator: LoopSimulator, loops: Loops) -> Array:
    """Return the errors of simulated positions in few windows, shape (n,) [% of RMS motion].

    The error of joints that are not commanded to move is 1 %.
    """
    outs = simulator.robot.roll_out(loops, _few(simulator.windows))
    q, q_ref = (
        np.concatenate([getattr(out.window.log, name)[out.window.counted] for out in outs])
        for name in ("q", "q_ref")
    )
    error = q - np.concatenate([out.q for out in outs])
    share: Array = 100.0 * np.sqrt(np.mean(error**2, axis=0)) / np.maximum(q.std(axis=0), 1e-12)
    return np.where(np.ptp(q_ref, axis=0) > 0.0, share, 1.0)


def _with_bodies_of_urdf(simulator: LoopSimulator, estimator: OutputError) -> Array:
    """Return the parameters of a first fit of the drives alone to few windows, shape (c,).

    With free bodies, many scales have nearly the same residual.
    """
    drives = [k for k, free in enumerate(simulator.free_parameters) if free.what != "body"]
    few = replace(
        simulator,
        windows=_few(simulator.windows),
        free_parameters=tuple(simulator.free_parameters[k] for k in drives),
    )
    theta = simulator.prior.copy()
    theta[drives] = replace(estimator, rounds=1).minimise(few)
    return theta


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
    scales: tuple[float, ...] = (1.0,)  # of the torques, from which fits may start
    factor: Array = field(default_factory=lambda: np.ones(1))  # of the scale of torques, (n,)
    #: Whether a limit is fitted that was not asked for, shape (n,), bool.
    limited: Array = field(default_factory=lambda: np.zeros(1, dtype=bool))
    #: Returns other initial values by scales, shape (n,), and by which torque limits are fitted.
    vary: "Callable[[Array, Array], _Initial] | None" = None

    def starts_as(self, factor: Array, limited: Array) -> bool:
        """Return whether these are its scales and its joints with limits."""
        return bool((self.factor == factor).all() and (self.limited == limited).all())

    @property
    def share(self) -> float:
        """Factor of the variance of torque rows: 2 where roll-outs use the same torques."""
        return 1.0 if self.linear is None else _BOTH


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
    second_order = cache(
        lambda finds_limit: fit_second_order(
            robot, windows, stated, finds_delay=loop.delay is None, finds_limit=finds_limit
        )
    )
    plain, groups = second_order(False), groups_of(loop, model.joints, likeness(model))
    top = _largest_speeds(model, loop, logs)
    # positions alone determine only the sum of kd and viscous friction, except at a torque limit
    finds_kd = uses_torques or all(log.v_ref is not None for log in logs)
    dt = max(float(np.median(np.diff(log.t))) for log in logs)
    most = np.tile(np.exp(-_WHITE * dt / plain.time_constant), 3)  # positions, speeds, torques
    estimator = OutputError(most=most, progress=task.progress)
    may_limit = ~is_stated(loop.limit, model) & (loop.limit != "find")
    scales = (1.0,) if has_gain.all() else _SCALES

    def vary(factor: Array, limited: Array) -> _Initial:
        limited = limited & may_limit
        from_limit = limited | (loop.limit == "find")
        start = plain.replaced(second_order(True), from_limit) if from_limit.any() else plain
        typical = typical_sizes(robot, start, windows, has_gain, top, groups, factor)
        finds_limit = (top > 0.0) | from_limit
        base = first_loops(model, stated, start, typical, finds_limit)
        by_limit = finds_limit | np.isfinite(stated.limit)
        free_parameters = free_drive_parameters(
            model, loop, groups, base, typical,
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
            groups=tuple(groups), scales=scales, factor=factor, limited=limited, vary=vary,
        )  # fmt: skip

    report_stage(task.progress, "fitting loops", STAGES)
    n = len(model.joints)
    return vary(np.ones(n), np.zeros(n, dtype=bool))


def _initialise_from_torque(task: _Task) -> _Initial:
    """Return a robot driven by the logged torque, initialised from the torque rows alone.

    Where the fit uses these rows, the prior of the bodies is their estimate from the rows; else
    that of the URDF.
    """
    model, loop, settings = task.model, task.loop, task.settings
    report_stage(task.progress, "fitting torques", STAGES)
    from_rows = task.from_rows(model)
    linear = open_loops(model, from_rows.standard)
    is_urdf = not (settings.torques and settings.bodies)
    base = replace(linear, bodies=stated_loops(model, loop).bodies) if is_urdf else linear
    robot = ClosedLoopRobot(model, step=settings.step)
    windows = task.windows(task.logs, DRIFTS, 0.0)
    typical = typical_sizes_of_torques(model, from_rows.standard, base.armature, windows)
    groups = groups_of(loop, model.joints, range(len(model.joints)))
    none = np.zeros(len(groups), dtype=bool)
    free_parameters = free_drive_parameters(
        model, loop, groups, base, typical, finds_kd=False, finds_limit=none
    )
    free_parameters += task.bodies(robot)
    simulator = LoopSimulator(
        robot, windows, base, tuple(free_parameters), velocities=settings.velocities
    )
    report_stage(task.progress, "fitting loops", STAGES)
    if settings.torques:
        simulator = replace(simulator, torque=torque_rows(from_rows, _BOTH))
    estimator = OutputError(frees=True, progress=task.progress)
    encoders = same_encoders(model)
    return _Initial(simulator, estimator, typical.torque, encoders, linear=from_rows)


def refine_steps(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Fit roll-outs of smaller steps, where halving the step changes the estimate.

    Steps are halved until this changes no parameter by more than 0.2 standard errors. Derivatives
    stay those of the larger steps: they do not change the minimum. The change by the last halving
    is added to the covariance, since all further halvings together would change as much again.
    """
    model, theta = simulator.robot.model, estimate.theta
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    step = dt / np.ceil(dt / simulator.robot.step - 1e-9)
    finest, now = step / _FINEST, simulator
    while True:
        half = replace(simulator, fine=ClosedLoopRobot(model, step=0.5 * step, corrects=True))
        change, error = estimator.moved(now, half, theta)
        share = float(np.max(np.abs(change) / np.maximum(error, 1e-300), initial=0.0))
        if share <= CHANGE or 0.5 * step < finest:
            break
        step, now = 0.5 * step, half
    now, estimate = _settled(now, estimator, estimate)
    covariance = estimate.covariance + np.outer(change, change)
    details = {**estimate.details, "step": step, "halving": share}
    return now, replace(estimate, covariance=covariance, details=details)


def _settled(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Return the estimate with the best initial states of the windows, and these windows.

    Fits of the initial states and joint steps of states and parameters alternate, until a step
    changes no parameter by more than 0.2 standard errors. Joints that stick may make the steps
    alternate without end: the change by the last one is then added to the covariance. If such a
    step raises the residual or cannot be simulated, as may happen far from the minimum, the
    parameters are fitted from the best initial states.
    """
    level, first = np.inf, estimate.theta
    for _ in range(_SETTLING):
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


def _check_settings(
    model: RobotModel, logs: Sequence[Log], loop: LoopSettings, settings: SimulationSettings
) -> None:
    """Refuse logs without a compared signal."""
    if loop.kind != "torque" and not any(map(_has_motion, logs)):
        raise DataError(
            f"{listed(sorted({log.name for log in logs}))}: the commands of all joints are "
            "constant, wanted commands that move at least one joint. Record a motion, or check the "
            "columns of the commands"
        )
    for log in logs:
        if settings.velocities and (log.v is None or not is_trustworthy(log)):
            lack = (
                "has no velocities"
                if log.v is None
                else "has velocities that are delayed, coarse, or inconsistent with the positions"
            )
            raise DataError(
                f"estimator: velocities is true, but {log.name} {lack}. Record columns dq_ of "
                "each joint, or leave velocities out"
            )


def _has_motion(log: Log) -> bool:
    """Return whether a log commands a joint to move, by position, speed or torque."""
    given = [x for x in (log.q_ref, log.v_ref, log.tau_ref) if x is not None]
    return any(bool((np.ptp(x, axis=0) > 0).any()) for x in given)


def _largest_speeds(model: RobotModel, loop: LoopSettings, logs: Sequence[Log]) -> Array:
    """Return the speed of joints that run at their largest speed without a stated limit; else 0."""
    speed = np.zeros(len(model.joints))
    for log in logs:
        saturated = largest_speeds(log)
        speed = np.maximum(speed, [saturated.get(joint, 0.0) for joint in model.joints])
    is_free = ~is_stated(None if loop.limit == "find" else loop.limit, model)
    return np.where(is_free, speed, 0.0)


def stated_loops(model: RobotModel, loop: LoopSettings) -> Loops:
    """Return the loops as stated, with the URDF's bodies; kp is 1 where it is not stated."""
    n, joints = len(model.joints), model.joints
    limit = None if isinstance(loop.limit, str) else loop.limit  # "find": fitted
    bodies = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    return Loops(
        bodies=bodies,
        armature=np.zeros(n),
        kp=by_joint(loop.kp, joints, "controller: kp", 1.0),
        kd=by_joint(loop.kd, joints, "controller: kd", 0.0),
        limit=by_joint(limit, joints, "controller: limit", np.inf),
        delay=by_joint(loop.delay, joints, "controller: delay", 0.0),
        zero=np.zeros(n),
        terms=((),) * n,
        values=np.zeros(0),
        rate=loop.rate,
    )


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
    further = [free for free_parameters in sets for free in free_parameters]
    loops = simulator.base
    terms = [list(joint_terms) for joint_terms in loops.terms]
    for free in further:
        if free.term is not None:
            terms[free.joints[0]].append(free.term)
    values = [
        loops.values[loops.place(j, term)] if term in loops.terms[j] else 0.0
        for j, joint_terms in enumerate(terms)
        for term in joint_terms
    ]
    base = replace(loops, terms=tuple(map(tuple, terms)), values=np.array(values))
    wide = replace(simulator, base=base, free_parameters=(*simulator.free_parameters, *further))
    return wide, np.concatenate([theta, np.zeros(len(further))])


def torque_rows(from_torques: TorqueIdentification, inflation: float = 1.0) -> TorqueRows:
    """Return an identification's rows reduced to a triangular factor.

    The weights include the variance inflation by correlated rows, from the scatter of segments.
    """
    weight = from_torques.wls.sigma * np.sqrt(inflation * max(from_torques.errors.inflation, 1.0))
    return TorqueRows(
        from_torques.model, from_torques.factors.weighted(weight), from_torques.mapping.K
    )
