"""From logs of commands and positions to drives, loops and bodies: the stages of the fit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.closed_loop.drive_torques import find_gains, measured_motion
from robotid.closed_loop.driven import identified_rows, torque_rows
from robotid.closed_loop.evaluation import DRIFTS
from robotid.closed_loop.free_parameters import (
    FreeParameter,
    LoopSimulator,
    free_body_parameters,
    with_terms,
)
from robotid.closed_loop.gain_check import GainScale, gain_scale
from robotid.closed_loop.initial_values import (
    first_loops,
    free_drive_parameters,
    free_zeros,
    is_stated,
    likeness,
    typical_sizes,
    typical_sizes_of_torques,
)
from robotid.closed_loop.second_order import SecondOrder, fit_second_order
from robotid.closed_loop.settings import LoopSettings, groups_of
from robotid.closed_loop.term_choice import Tried, candidates, choose
from robotid.closed_loop.zeros import Encoders, find_encoders, same_encoders
from robotid.doctor.command_channels import largest_speeds
from robotid.estimators.estimator import Estimate
from robotid.estimators.output_error import OutputError
from robotid.exceptions import DataError, SettingsError
from robotid.findings import listed
from robotid.fitting.settings import SimulationSettings
from robotid.identification.result import Identification
from robotid.logs.data import Log
from robotid.logs.measured_velocity import is_trustworthy
from robotid.logs.settings import SignalSettings
from robotid.robot.model import RobotModel
from robotid.simulation.loops import ClosedLoopRobot, Loops, Window, cut_windows, open_loops
from robotid.simulation.settings import by_joint

__all__ = ["STAGES", "Fitted", "fit_loops", "stated_loops"]

#: What the fit of a job does, from files to files.
STAGES = (
    "reading logs", "fitting torques", "trying plain loops", "fitting loops", "trying friction",
    "testing", "writing",
)  # fmt: skip


_NAMES = {"output": "output error", "input": "input error", "direct": "direct input error"}
_WHITE = 2.0  # whitening ends at so many times the rate at which a loop follows
_FEW = 12  # windows that are fitted first, of many
_STARTS = 3  # fits with better starts of the windows
_WINDOW, _LEAD = 2.5, 0.6  # [s] of what follows commands, if not stated
_BOTH = 2.0  # one torque's noise is in its rows and in what it drives: each counts by half
_MOVED = 0.2  # of a standard error, that halving the steps may move a parameter
_FINEST = 16.0  # times smaller steps at most
_SETTLING = 4  # steps of parameters and starts of windows together, at most ...
_RAISED = 1e-2  # ... none of which raises the logarithm of what remains by more than that
_PASSES = 2  # of choosing terms and fitting again


@dataclass(frozen=True, eq=False)
class Fitted:
    """What the fit found.

    Attributes:
        simulator: The robot with its unknowns, and the windows.
        estimate: The unknowns' values.
        plain: The plain model, joint by joint; None where the logged torque drives the robot.
        encoders: How encoders stand to the URDF's joints.
        tried: Which terms were tried, and what they gained.
        linear: What the rows of torque tell by themselves, where the torque drives the robot.
        scale: What bodies and torques show of stated gains; None where gains are found.
    """

    simulator: LoopSimulator
    estimate: Estimate
    plain: SecondOrder | None
    encoders: Encoders
    tried: tuple[Tried, ...]
    linear: Identification | None = None
    scale: GainScale | None = None

    @property
    def loops(self) -> Loops:
        """Bodies, drives and loops as they were found."""
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
    """Fit drives, loops and bodies to logs of commands and positions.

    Args:
        model: The robot; its drive terms are those that are found.
        logs: The logs, of its joints in its order, with commands.
        loop: What is known of the loops.
        settings: Windows, spread of bodies, whitening.
        signals: How the torques of logs become rows.
        chooses: Whether further friction terms are tried.
        progress: Told of the stages.

    Raises:
        DataError: If a log lacks what is to be compared.
        NotConvergedError: If nothing that is tried can be simulated.
        SettingsError: If a setting does not fit the robot.
    """
    _check_settings(model, logs, loop, settings)
    begin = _initialise_from_torque if loop.kind == "torque" else _initialise_from_commands
    initialised = begin(model, logs, loop, settings, signals, progress)
    simulator, estimator = initialised.simulator, initialised.estimator
    # the URDF's bodies first: with bodies that change, too, many scales suit nearly as well
    drives = [k for k, unknown in enumerate(simulator.free_parameters) if unknown.what != "body"]
    few = replace(
        simulator,
        windows=_few(simulator.windows),
        free_parameters=tuple(simulator.free_parameters[k] for k in drives),
    )
    theta = simulator.prior.copy()
    theta[drives] = replace(estimator, rounds=1).fit(few).theta
    simulator = replace(simulator, error=settings.error)
    is_plain = settings.error == "output" and initialised.linear is None
    for left in reversed(range(_STARTS)):
        simulator = simulator.with_better_start(theta)
        if simulator.behind is not None:
            outs = simulator.roll_out(theta, _few(simulator.windows))
            gains, is_last = (simulator.loops(theta), _open_gains(loop, model)), left == 0
            behind, _ = find_gains(outs, *gains, knows_delay=True, is_whole=not is_last)
            simulator = replace(simulator, behind=behind)
        # starts that are not yet the best deserve no more than one round
        rounds = 1 if left and is_plain else estimator.rounds
        estimate = replace(estimator, rounds=rounds).fit(simulator, theta, exact=simulator.exact)
        theta = estimator.joint_step(simulator, estimate.theta)
        if initialised.linear is not None and simulator.torque is not None:
            estimator = replace(estimator, inflation=_BOTH * estimate.details["inflation"])
    tried: list[Tried] = []
    for _ in range(_PASSES if chooses else 0):
        report_stage(progress, "trying friction", STAGES)
        offered = [
            set_
            for set_ in candidates(simulator, initialised.torque)
            if set_[0].name not in simulator.names
        ]
        wide, theta = _with(simulator, estimate.theta, offered)
        found = choose(wide, theta, offered, replace(estimator, inflation=1.0))
        tried = [*(t for t in tried if t.is_chosen), *found]
        taken = [set_ for set_, t in zip(offered, found, strict=True) if t.is_chosen]
        if not taken:
            break
        report_stage(progress, "fitting loops", STAGES)
        simulator, theta = _with(simulator, estimate.theta, taken)
        if simulator.torque is not None:
            own = with_terms(model, simulator.base)
            rows = torque_rows(identified_rows(own, logs, signals), initialised.share)
            simulator = replace(simulator, torque=rows)
        estimate = estimator.fit(simulator, theta, exact=simulator.exact)
    scale = None
    if initialised.linear is None:
        simulator, estimate = refine_steps(simulator, estimator, estimate)
        if is_stated(loop.kp, model).all() and simulator.error == "output":
            scale = gain_scale(simulator, estimator, estimate)
    chosen = (initialised.encoders, tuple(tried), initialised.linear, scale)
    return Fitted(simulator, estimate, initialised.plain, *chosen)


@dataclass(frozen=True, eq=False)
class _Initial:
    """What a fit begins with."""

    simulator: LoopSimulator
    estimator: OutputError
    torque: Array  # typical ones, shape (n,) [N m or N]
    encoders: Encoders
    plain: SecondOrder | None = None
    linear: Identification | None = None

    @property
    def share(self) -> float:
        """How often each row of torque is counted, in rows and roll-outs."""
        return 1.0 if self.linear is None else _BOTH


def _initialise_from_commands(
    model: RobotModel,
    logs: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    signals: SignalSettings | None,
    progress: ProgressCallback,
) -> _Initial:
    """Return loops on commands, begun with a plain loop of each joint."""
    robot = ClosedLoopRobot(model, step=settings.step)
    encoders = find_encoders(model, logs) if loop.zeros == "find" else same_encoders(model)
    logs = [log.turned(encoders.sign) for log in logs]
    length, lead = settings.window or _WINDOW, _LEAD if settings.lead is None else settings.lead
    windows = tuple(w for log in logs for w in cut_windows(log, length, lead))
    stated = replace(stated_loops(model, loop), zero=encoders.zero)
    weighs = settings.torques and all(log.has_torque for log in logs)
    has_gain, behind = is_stated(loop.kp, model), None
    if weighs and loop.rate is None:
        is_open = _open_gains(loop, model)
        moved = [measured_motion(window) for window in _few(windows)]
        behind, told = find_gains(
            moved, stated, is_open, knows_delay=loop.delay is not None, is_whole=True
        )
        has_gain, stated = has_gain | (told.kp != stated.kp), told
    report_stage(progress, "trying plain loops", STAGES)
    plain = fit_second_order(robot, windows, stated, finds_delay=loop.delay is None)
    groups = groups_of(loop, model.joints, likeness(model))
    top = _largest_speeds(model, loop, logs)
    typical = typical_sizes(robot, plain, windows, has_gain, top)
    finds_limit = (top > 0.0) | (loop.limit == "find")
    base = first_loops(model, stated, plain, typical, finds_limit)
    # positions alone tell the sum of kd and viscous friction
    tells_kd = weighs or all(log.v_ref is not None for log in logs)
    free_parameters = free_drive_parameters(
        model, loop, groups, base, typical, tells_kd=tells_kd, finds_limit=finds_limit
    )
    free_parameters += free_zeros(model, encoders) if loop.zeros == "find" else []
    free_parameters += free_body_parameters(robot, settings.bodies) if settings.bodies else []
    dt = max(float(np.median(np.diff(log.t))) for log in logs)
    most = np.tile(np.exp(-_WHITE * dt / plain.time_constant), 3)  # positions, speeds, torques
    estimator = OutputError(_NAMES[settings.error], settings.whiten, most, progress=progress)
    simulator = LoopSimulator(
        robot, windows, base, tuple(free_parameters), velocities=settings.velocities, behind=behind
    )
    report_stage(progress, "fitting loops", STAGES)
    if weighs and behind is None:
        rows = torque_rows(identified_rows(with_terms(model, base), logs, signals))
        simulator = replace(simulator, torque=rows)
    return _Initial(simulator, estimator, typical.torque, encoders, plain)


def _initialise_from_torque(
    model: RobotModel,
    logs: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    signals: SignalSettings | None,
    progress: ProgressCallback,
) -> _Initial:
    """Return a robot that the logged torque drives, begun with what its rows tell by themselves.

    Where these rows weigh, bodies change about what they tell; else about the URDF's, or stay.
    """
    report_stage(progress, "fitting torques", STAGES)
    found = identified_rows(model, logs, signals)
    linear = open_loops(model, found.standard)
    is_urdf = not (settings.torques and settings.bodies)
    base = replace(linear, bodies=stated_loops(model, loop).bodies) if is_urdf else linear
    robot = ClosedLoopRobot(model, step=settings.step)
    length, lead = settings.window or DRIFTS, settings.lead or 0.0
    windows = tuple(w for log in logs for w in cut_windows(log, length, lead))
    typical = typical_sizes_of_torques(model, found.standard, base.armature, windows)
    groups = groups_of(loop, model.joints, range(len(model.joints)))
    none = np.zeros(len(groups), dtype=bool)
    free_parameters = free_drive_parameters(
        model, loop, groups, base, typical, tells_kd=False, finds_limit=none
    )
    free_parameters += free_body_parameters(robot, settings.bodies) if settings.bodies else []
    simulator = LoopSimulator(
        robot, windows, base, tuple(free_parameters), velocities=settings.velocities
    )
    report_stage(progress, "fitting loops", STAGES)
    if settings.torques:
        simulator = replace(simulator, torque=torque_rows(found, _BOTH))
    estimator = OutputError(whitens=settings.whiten, frees=True, progress=progress)
    encoders = same_encoders(model)
    return _Initial(simulator, estimator, typical.torque, encoders, linear=found)


def refine_steps(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Fit roll-outs of smaller steps, where halving the step moves the estimate.

    Steps are halved until this moves no parameter by more than 0.2 standard errors. Derivatives
    stay those of the larger steps: they do not move where the fit ends. What halving the last step
    still moves counts in the covariance; as many steps as that follow would move as much again.

    Args:
        simulator: What simulates.
        estimator: The estimator.
        estimate: The estimate at the steps of ``simulator``.

    Raises:
        NotConvergedError: If a step has no solution.
    """
    model, theta = simulator.robot.model, estimate.theta
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    step = dt / np.ceil(dt / simulator.robot.step - 1e-9)
    finest, now = step / _FINEST, simulator
    while True:
        half = replace(simulator, fine=ClosedLoopRobot(model, step=0.5 * step, corrects=True))
        change, error = estimator.moved(now, half, theta)
        share = float(np.max(np.abs(change) / np.maximum(error, 1e-300), initial=0.0))
        if share <= _MOVED or 0.5 * step < finest:
            break
        step, now = 0.5 * step, half
    now, estimate = _settled(now, estimator, estimate)
    covariance = estimate.covariance + np.outer(change, change)
    details = {**estimate.details, "step": step, "halving": share}
    return now, replace(estimate, covariance=covariance, details=details)


def _settled(
    simulator: LoopSimulator, estimator: OutputError, estimate: Estimate
) -> tuple[LoopSimulator, Estimate]:
    """Return the estimate beside which the starts of windows fit best, and these windows.

    Starts and steps of both together take turns until a step moves no parameter by more than 0.2
    standard errors. Where such a step raises what remains, as it may from far away, or where
    derivatives are not exact, it is a fit from the best starts.

    Args:
        simulator: What simulates.
        estimator: The estimator.
        estimate: The estimate of earlier starts, or of larger steps.
    """
    if simulator.exact is not None:
        simulator = simulator.with_better_start(estimate.theta)
        return simulator, estimator.fit(simulator, estimate.theta, exact=simulator.exact)
    level, first = np.inf, estimate.theta
    for _ in range(_SETTLING):
        initialised = simulator.with_better_start(estimate.theta)
        found = estimator.settle(initialised, estimate)
        before, level = level, float(np.mean(np.log(found.sigma)))
        if level > before + _RAISED:
            simulator = simulator.with_better_start(first)
            return simulator, estimator.fit(simulator, first)
        change = np.abs(found.theta - estimate.theta)
        simulator, estimate = initialised, found
        if (change <= _MOVED * found.std_error).all():
            break
    return simulator, estimate


def _check_settings(
    model: RobotModel, logs: Sequence[Log], loop: LoopSettings, settings: SimulationSettings
) -> None:
    """Refuse logs without what is to be compared, and unknown loops where they must be known."""
    error = f"estimator: error = {settings.error!r}"
    for log in logs:
        if settings.velocities and (log.v is None or not is_trustworthy(log)):
            found = "none" if log.v is None else "late or coarse ones, or not its positions' own"
            raise DataError(
                f"estimator: velocities is true, but {log.name} has {found}; record columns dq_ "
                "of each joint, or leave velocities out"
            )
        if settings.error != "output" and not log.has_torque:
            raise DataError(
                f"{error} compares torques, but {log.name} has none; record columns tau_ of each "
                "joint, or set error = 'output'"
            )
    if settings.error != "output" and loop.kind == "torque":
        raise SettingsError(
            f"{error} compares torques with those of a loop, but [controller] has kind = 'torque', "
            "where the logged one drives; leave error out, or state the loop, kind = 'pd'"
        )
    if settings.error != "output" and loop.rate is not None:
        raise SettingsError(
            f"{error} takes torques that follow at once, but [controller] has rate = "
            f"{loop.rate:g}, at which they are held; leave rate out, or set error = 'output'"
        )
    if settings.error != "direct":
        return
    unknown = [
        key for key in ("kp", "kd", "delay") if not is_stated(getattr(loop, key), model).all()
    ]
    finds_limit = loop.limit == "find" or bool(_largest_speeds(model, loop, logs).any())
    unknown += ["limit"] * finds_limit + ["zeros"] * (loop.zeros == "find")
    if unknown:
        raise SettingsError(
            f"{error} needs a controller that is known, whose {listed(unknown)} would be found; "
            "state them of each joint in [controller] (delay = 0 if there is none), or set "
            "error = 'input'"
        )


def _largest_speeds(model: RobotModel, loop: LoopSettings, logs: Sequence[Log]) -> Array:
    """Return the largest speed of joints that run at it, and whose limit is not stated; or 0."""
    speed = np.zeros(len(model.joints))
    for log in logs:
        found = largest_speeds(log)
        speed = np.maximum(speed, [found.get(joint, 0.0) for joint in model.joints])
    is_open = ~is_stated(None if loop.limit == "find" else loop.limit, model)
    return np.where(is_open, speed, 0.0)


def stated_loops(model: RobotModel, loop: LoopSettings) -> Loops:
    """Return what is stated of loops, with the URDF's bodies; a gain of the position counts as 1.

    Args:
        model: The robot.
        loop: What is known of the loops.

    Raises:
        SettingsError: If a joint is named that is not there.
    """
    n, joints = len(model.joints), model.joints
    limit = None if isinstance(loop.limit, str) else loop.limit  # it is to be found
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


def _few(windows: Sequence[Window]) -> tuple[Window, ...]:
    """Return some of many windows."""
    return tuple(windows[:: max(1, len(windows) // _FEW)])


def _open_gains(loop: LoopSettings, model: RobotModel) -> Array:
    """Return for which joints gains of position and of speed are to be found, (2, n), bool."""
    return ~np.stack([is_stated(gain, model) for gain in (loop.kp, loop.kd)])


def _with(
    simulator: LoopSimulator, theta: Array, sets: Sequence[tuple[FreeParameter, ...]]
) -> tuple[LoopSimulator, Array]:
    """Return the simulator with further terms, which are 0, and its parameters."""
    further = [unknown for free_parameters in sets for unknown in free_parameters]
    loops = simulator.base
    terms = [list(own) for own in loops.terms]
    for unknown in further:
        if unknown.term is not None:
            terms[unknown.joints[0]].append(unknown.term)
    values = [
        loops.values[loops.place(j, term)] if term in loops.terms[j] else 0.0
        for j, own in enumerate(terms)
        for term in own
    ]
    base = replace(loops, terms=tuple(map(tuple, terms)), values=np.array(values))
    wide = replace(simulator, base=base, free_parameters=(*simulator.free_parameters, *further))
    return wide, np.concatenate([theta, np.zeros(len(further))])
