"""Initial values of the fit: a second-order model of each joint, and the zeros of encoders.

J a + d v + Fc sign(v) + c = kp (q_ref(t - delay) - q) + kd (v_ref - v), decoupled, within a torque
limit where one is fitted. Without a limit it is also a baseline of the fit with bodies.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from robotid.base.exceptions import NotConvergedError
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import zero_phase
from robotid.dynamics.rows import flatten
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Loops, Window
from robotid.dynamics.simulation.simulation_settings import PerJoint
from robotid.dynamics.torque import predict_instants
from robotid.estimation.estimators.estimator import WEAK_PRIOR
from robotid.estimation.estimators.output_error import OutputError
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import (
    LONGEST_DELAY,
    POSITIVE,
    FreeParameter,
    LoopSimulator,
    terms_of,
)
from robotid.robot.drives import TERMS, Viscous
from robotid.robot.mass_matrix import joint_mass_matrices
from robotid.robot.model import RobotModel

_FREQUENCIES = (6.0, 12.0, 24.0, 48.0, 96.0)  # natural frequencies that are tried [rad/s]
_DAMPINGS = (0.5, 1.5)  # damping ratios that are tried
_FRICTIONS = (0.05, 0.5)  # Coulomb friction that is tried, over the typical torque
_LIMITS = (0.6, 0.3, 0.15)  # torque limits that are tried, from the mean torque to the largest one
_DELAYS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)  # delays that are tried [s]
_FITTED = 16  # number of windows of the fit; the grid search has the first half as many
_SHOWS = 1e-3  # smallest identifiable inertia, over that of the fastest loop ...
_CLEAR = 2.0  # ... and over its standard error
_TERMS = (TERMS["viscous"], TERMS["coulomb"], TERMS["offset"])
_STEPS = 12  # of the fit
_SHARE = 0.5  # initial share of the bodies in a joint's inertia, where its gain is unknown
_ZERO_SPREAD = 0.3  # prior spread of an encoder's zero about its first estimate [rad or m]
_SMALLEST_BODY = 0.3  # smallest body inertia over the largest: small joints have gears, too
_POSES = 50  # number of poses at which the inertia of the bodies is computed
_LEAST = 0.05  # smallest initial armature and lower bound of a gain, over the typical size
_LIMITED = 0.8  # initial torque limit over the largest torque without a limit

#: Smallest relative increase of the squared error: by the URDF's zero and sign, for the best ones
#: to replace them; by the next best ones, for the best ones to be identified.
CLEAR = 0.2
#: Signs and zeros of encoders that are tried.
_TRIALS = np.array([(s, z) for s in (1.0, -1.0) for z in np.deg2rad(np.arange(-180, 180, 15))])
_SAMPLES = 400  # of all logs together
_SLOW, _FAST = 0.4, 4.0  # cut-offs of the slow motion and of the sign of friction [Hz]
_PERIODS = 30  # smallest number of cut-off periods in all logs together
_RANGE = 0.4  # smallest range of a joint whose zero is identified [rad]


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """The second-order model of every joint; arrays of shape (n,)."""

    loops: Loops  # its parameters as loops without bodies
    torque: Array  # typical torque of the loop, kp rms(q_ref - q) [N m or N]
    inertia_error: Array  # standard error of the inertia J [kg m^2 or kg]

    @property
    def shows_inertia(self) -> Array:
        """Whether the motion determines the inertia of each joint, shape (n,), bool."""
        found, fastest = self.loops.armature, self.loops.kp / _FREQUENCIES[-1] ** 2
        return np.asarray((found > _SHOWS * fastest) & (found > _CLEAR * self.inertia_error))

    @property
    def inertia(self) -> Array:
        """Inertia J of each joint [kg m^2 or kg]; if not determined, its standard error."""
        # within the inertias that are tried: with less, a common scale of torques is arbitrary
        found, kp = self.loops.armature, self.loops.kp
        fastest, slowest = (kp / w**2 for w in (_FREQUENCIES[-1], _FREQUENCIES[0]))
        possible = np.maximum(found, np.clip(self.inertia_error, fastest, slowest))
        return np.where(self.shows_inertia, found, possible)

    @property
    def time_constant(self) -> Array:
        """Time constant of each joint [s]: of its damping or its oscillation, the longer."""
        loops = self.loops
        damped = (loops.kd + self.friction("viscous")) / loops.kp
        return np.asarray(np.maximum(damped, np.sqrt(loops.armature / loops.kp)))

    def replaced(self, other: "SecondOrder", joints: Array) -> "SecondOrder":
        """Return the model with the values of another one for some joints: joints (n,)."""
        error = np.where(joints, other.inertia_error, self.inertia_error)
        loops = _loops_with(self.loops, other.loops, joints)
        return replace(self, loops=loops, inertia_error=error)

    def friction(self, name: str) -> Array:
        """Return the values of one friction term, shape (n,)."""
        which = [term.name for term in _TERMS].index(name)
        return np.asarray(self.loops.values[which :: len(_TERMS)])


def _loops_with(loops: Loops, other: Loops, joints: Array) -> Loops:
    """Return the loops with the second-order model of other loops for some joints: joints (n,)."""
    changed = {}
    for name in ("armature", "delay", "limit", "values"):
        mask = np.repeat(joints, len(_TERMS)) if name == "values" else joints
        changed[name] = np.where(mask, getattr(other, name), getattr(loops, name))
    return replace(loops, **changed)


def fit_second_order(
    robot: ClosedLoopRobot,
    windows: tuple[Window, ...],
    stated: Loops,
    finds_delay: bool,
    finds_limit: bool,
) -> SecondOrder:
    """Fit the second-order model to windows: a coarse grid for every joint, then least squares."""
    n = len(stated.kp)
    error = np.concatenate([_loop_error(w.log)[w.counted] for w in windows])
    torque = stated.kp * np.maximum(np.sqrt(np.mean(error**2, axis=0)), 1e-6)
    # a drive bears the load by gravity within its limit
    mean = stated.kp * error.mean(axis=0) * finds_limit
    bare = replace(
        stated, bodies=np.zeros_like(stated.bodies), zero=np.zeros(n), limit=np.full(n, np.inf),
        terms=(_TERMS,) * n, values=np.column_stack([np.zeros((n, 2)), mean]).reshape(-1),
    )  # fmt: skip
    least, largest = np.abs(mean), stated.kp * np.abs(error).max(axis=0)
    limits = [least + share * (largest - least) for share in _LIMITS]
    limits = limits if finds_limit else [bare.limit]
    start = _coarse(robot, windows[: _FITTED // 2], bare, torque, finds_delay, limits)
    free: list[FreeParameter] = []
    for j, joint in enumerate(robot.model.joints):
        J, T, F = float(start.armature[j]), float(start.delay[j]), float(start.limit[j])
        free.append(FreeParameter(f"{joint}.armature", "armature", (j,), J, 10 * J, TINY * J))
        for k, term in enumerate(_TERMS):
            value = float(start.values[len(_TERMS) * j + k])
            spread = 100 * torque[j] * (10.0 if term.name == "viscous" else 1.0)
            free.append(FreeParameter.of_term(joint, term, (j,), value, spread))
        if finds_delay:
            free.append(FreeParameter(f"{joint}.delay", "delay", (j,), T, LONGEST_DELAY, 0.0))
        if finds_limit:
            free.append(FreeParameter(f"{joint}.limit", "limit", (j,), F, 10 * F, TINY * F))
    some = windows[:: max(1, len(windows) // _FITTED)]
    simulator = LoopSimulator(robot, some, start, tuple(free))
    estimate = OutputError(whitens=False, steps=_STEPS).fit(simulator)
    is_inertia = [x.what == "armature" for x in free]  # joint by joint
    return SecondOrder(simulator.loops(estimate.theta), torque, estimate.std_error[is_inertia])


def _coarse(
    robot: ClosedLoopRobot,
    windows: tuple[Window, ...],
    bare: Loops,
    torque: Array,
    finds_delay: bool,
    limits: Sequence[Array],
) -> Loops:
    """Return the best of a grid for each joint: without bodies the joints are decoupled."""
    n, offset = len(bare.kp), bare.values[2 :: len(_TERMS)]
    best, found = np.full(n, np.inf), bare
    delays = np.array(_DELAYS) if finds_delay else np.zeros(1)
    first = float(delays[min(1, len(delays) - 1)])
    for w, z, f, limit in product(_FREQUENCIES, _DAMPINGS, _FRICTIONS, limits):
        J = bare.kp / w**2
        viscous = np.maximum(2 * z * w * J - bare.kd, 0.0)
        values = np.column_stack([viscous, f * torque, offset]).reshape(-1)
        delay = np.full(n, first) if finds_delay else bare.delay
        trial = replace(bare, armature=J, values=values, delay=delay, limit=limit)
        best, found = _better(robot, windows, trial, best, found)
    for every in delays if finds_delay else ():
        best, found = _better(robot, windows, replace(found, delay=np.full(n, every)), best, found)
    if not np.isfinite(best).all():
        rate = "" if bare.rate is None else f", and another rate than {bare.rate:g} Hz or none,"
        raise NotConvergedError(
            "no second-order model of the joints that was tried can be simulated. Set the "
            f"gains{rate} in [controller]",
            "no start",
        )
    return found


def _better(
    robot: ClosedLoopRobot, windows: tuple[Window, ...], trial: Loops, best: Array, found: Loops
) -> tuple[Array, Loops]:
    """Return the squared errors and loops of the joints: those of the trial where it is better."""
    try:
        outs = robot.roll_out(trial, windows)
    except NotConvergedError:
        return best, found  # this trial cannot be simulated; others can
    cost = sum(((out.window.log.q[out.window.counted] - out.q) ** 2).sum(axis=0) for out in outs)
    better = cost < best
    return np.where(better, cost, best), _loops_with(found, trial, better)


@dataclass(frozen=True, eq=False)
class TypicalSizes:
    """Typical sizes of each joint, for initial values and prior spreads; arrays of shape (n,)."""

    inertia: Array  # inertia of joint and rotor [kg m^2 or kg]
    bodies: Array  # part of the URDF's bodies in it [kg m^2 or kg]
    torque: Array  # torque [N m or N]
    #: Initial torque limit: somewhat less than the largest torque without a limit [N m or N].
    largest: Array
    speed: Array  # speed [rad/s or m/s]
    scale: Array  # torque relative to that of the second-order model [-]


def typical_sizes(
    robot: ClosedLoopRobot,
    plain: SecondOrder,
    windows: Sequence[Window],
    has_gain: Array,
    top: Array,
    groups: Sequence[str],
    factor: Array | float = 1.0,
) -> TypicalSizes:
    """Return typical sizes; where a gain is unknown, the inertia of bodies scales all torques."""
    # has_gain (n,), largest speeds top (n,), else 0 [rad/s or m/s], factor (n,) [-]
    model = robot.model
    bodies = _inertia(model, model.standard_parameters(), windows)
    measure = np.maximum(bodies, _SMALLEST_BODY * bodies.max()) / _SHARE
    scale = np.where(has_gain, 1.0, measure / plain.inertia)
    # joints of one gain have one scale: with others, friction may exceed the torque of a drive
    for group in dict.fromkeys(groups):
        own = (np.array(groups) == group) & ~has_gain
        shown = own & plain.shows_inertia
        if own.any():
            scale[own] = np.median(scale[shown if shown.any() else own])
    scale = np.where(has_gain, 1.0, factor * scale)
    # friction may hide the inertia in a second-order model
    inertia = np.maximum(plain.inertia * scale, bodies)
    error = np.concatenate([_loop_error(w.log)[w.counted] for w in windows])
    unlimited = _LIMITED * plain.loops.kp * np.abs(error).max(axis=0)
    unlimited = np.minimum(unlimited, plain.loops.limit)
    friction = plain.friction("viscous") * top + plain.friction("coulomb")
    largest = scale * np.where(top > 0.0, np.minimum(friction, unlimited), unlimited)
    return TypicalSizes(inertia, bodies, plain.torque * scale, largest, _speed(windows), scale)


def _loop_error(log: Log) -> Array:
    """Return the position error of a log times its factors of kp, (N, n) [rad or m]."""
    return np.asarray(log.gain_factors[0] * (log.q_ref - log.q))


def typical_sizes_of_torques(
    model: RobotModel, pi: Array, armature: Array, windows: Sequence[Window]
) -> TypicalSizes:
    """Return typical sizes from logged torques, without a closed loop."""
    # pi (p,), armature (n,) [kg m^2 or kg]
    tau = np.concatenate([w.log.tau[w.counted] for w in windows])
    torque = np.maximum(np.sqrt(np.mean(tau**2, axis=0)), 1e-6)
    inertia, one = _inertia(model, pi, windows), np.ones_like(armature)
    return TypicalSizes(inertia, inertia - armature, torque, np.inf * one, _speed(windows), one)


def _inertia(model: RobotModel, pi: Array, windows: Sequence[Window]) -> Array:
    """Return the typical diagonal of the joint-space mass matrix, shape (n,)."""
    q = np.concatenate([w.log.q[w.counted] for w in windows])
    M = joint_mass_matrices(model, pi, q[:: max(1, len(q) // _POSES)])
    return np.asarray(np.median(np.diagonal(M, axis1=1, axis2=2), axis=0))


def _speed(windows: Sequence[Window]) -> Array:
    """Return the typical speed of each joint, shape (n,)."""
    steps = [np.diff(w.log.q[w.counted], axis=0) / np.median(np.diff(w.log.t)) for w in windows]
    return np.asarray(np.maximum(np.sqrt(np.mean(np.concatenate(steps) ** 2, axis=0)), 1e-6))


def first_loops(
    model: RobotModel, stated: Loops, plain: SecondOrder, typical: TypicalSizes, finds_limit: Array
) -> Loops:
    """Return the initial loops of the fit: finds_limit (n,)."""
    friction = {name: plain.friction(name) * typical.scale for name in ("viscous", "coulomb")}
    none = np.zeros(len(typical.scale))
    terms = tuple(
        tuple(term for term in terms_of(model, joint) if not term.is_inertia)
        for joint in model.joints
    )
    values = [friction.get(t.name, none)[j] for j, own in enumerate(terms) for t in own]
    return replace(
        stated, kp=stated.kp * typical.scale,
        armature=np.maximum(typical.inertia - typical.bodies, _LEAST * typical.inertia),
        delay=plain.loops.delay, limit=np.where(finds_limit, typical.largest, stated.limit),
        terms=terms, values=np.array(values),
    )  # fmt: skip


def free_drive_parameters(
    model: RobotModel,
    loop: LoopSettings,
    groups: Sequence[str],
    base: Loops,
    typical: TypicalSizes,
    *,
    row: float,
    finds_kd: Array,
    finds_limit: Array,
) -> list[FreeParameter]:
    """Return the free parameters of drives and loops, with initial values from ``base``."""
    # row of the logs [s], finds_kd (n,), finds_limit (n,)
    members: dict[str, list[int]] = {}
    for j, group in enumerate(groups):
        members.setdefault(group, []).append(j)
    is_closed = np.full(len(groups), loop.kind != "torque")
    # each drive has its own limit; delays are mostly those of the bus and the controller
    alone = {joint: [j] for j, joint in enumerate(model.joints)}
    delayed = {"robot": [*range(len(groups))]} if loop.delays == "one" else members
    has_armature = np.full(len(groups), "armature" in model.layout.terms)
    closed_kp, closed_delay = (~is_stated(x, model) & is_closed for x in (loop.kp, loop.delay))
    # a command that is not held over a row, as between the ticks of a slow clock, acts earlier
    earliest = -row if loop.rate is None or loop.rate * row > 1.0 else 0.0
    found = []
    for what, sharing, is_free, spread in (
        ("armature", members, has_armature, typical.inertia),
        ("kp", members, closed_kp, base.kp / WEAK_PRIOR),
        ("kd", members, ~is_stated(loop.kd, model) & finds_kd, typical.torque / typical.speed),
        ("limit", alone, finds_limit, typical.torque),
        ("delay", delayed, closed_delay, np.full(len(groups), LONGEST_DELAY / WEAK_PRIOR)),
    ):
        for name, joints in sharing.items():
            sharers = [j for j in joints if is_free[j]]
            if sharers:
                initial = float(np.median(getattr(base, what)[sharers]))
                wide = WEAK_PRIOR * float(np.median(spread[sharers]))
                lowest = earliest if what == "delay" else _LEAST * initial * (what in POSITIVE)
                found.append(
                    FreeParameter(f"{name}.{what}", what, tuple(sharers), initial, wide, lowest)
                )
    for group, joints in members.items():
        for term in {t: None for j in joints for t in base.terms[j]}:
            having = [j for j in joints if term in base.terms[j]]
            # Coulomb friction and offset depend on wear and load, viscous friction on the type
            is_viscous = isinstance(term, Viscous)
            size = typical.torque / (typical.speed if is_viscous else 1.0)
            for owners in [having] if is_viscous else [[j] for j in having]:
                name = group if len(owners) > 1 else model.joints[owners[0]]
                initial = float(np.median([base.values[base.place(j, term)] for j in owners]))
                wide = WEAK_PRIOR * float(np.median(size[owners]))
                found.append(FreeParameter.of_term(name, term, tuple(owners), initial, wide))
    return found


def likeness(model: RobotModel) -> list[tuple[object, ...]]:
    """Return the properties in which equal joints agree: limits, mass and moments of the body."""
    bodies = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    return [
        (limit.type, f"{limit.effort:.3g}", f"{limit.velocity:.3g}", *(f"{x:.2g}" for x in sizes))
        for sizes, limit in zip(bodies[:, [0, 4, 6, 9]], model.limits, strict=True)
    ]


def is_stated(value: PerJoint | str | None, model: RobotModel) -> Array:
    """Return whether a number is given for each joint, shape (n,), bool."""
    named = value if isinstance(value, Mapping) else () if value is None else model.joints
    return np.isin(model.joints, list(named))


@dataclass(frozen=True, eq=False)
class Encoders:
    """Encoder zeros and signs relative to the URDF, q_urdf = sign q + zero; arrays of shape (n,).

    Gravity causes a position error, q_ref - q = tau / kp + friction, whose regression on the URDF's
    torques determines both. In fast motion, lags are larger than this effect. The common sign of
    joints with parallel axes is not identifiable: gravity causes the same errors with all reversed.
    """

    sign: Array  # 1, or -1 of an encoder with the opposite sign
    zero: Array  # position of the URDF where the encoder reads 0 [rad or m]
    #: Reduction of the squared position error by a zero and sign other than the URDF's, as share of
    #: the error with those of the URDF at all joints [-].
    gain: Array
    explained: Array  # share of the joint's own squared position error that gravity explains [-]
    #: Relative increase of the squared error by the next best zero or sign, outside the
    #: neighbourhood of the best [-]; 0 of prismatic joints and of joints that hardly move.
    margin: Array
    next_sign: Array  # of the next best ones
    next_zero: Array


def same_encoders(model: RobotModel) -> Encoders:
    """Return encoders with the URDF's zeros and signs."""
    one, none = np.ones(len(model.joints)), np.zeros(len(model.joints))
    return Encoders(one, none, none, none, none, one, none)


def free_zeros(model: RobotModel, encoders: Encoders) -> list[FreeParameter]:
    """Return free parameters for the encoder zeros that differ from the URDF's."""
    return [
        FreeParameter(
            f"{model.joints[j]}.zero", "zero", (int(j),), float(encoders.zero[j]), _ZERO_SPREAD
        )
        for j in np.flatnonzero(encoders.gain > 0)
    ]


def parallel_axes(model: RobotModel) -> list[tuple[str, ...]]:
    """Return the successive joints of each chain that have parallel axes."""
    tree = flatten(model)
    joined: dict[int, list[int]] = {}
    for body in range(len(tree.parents)):
        above, placement = int(tree.parents[body]), tree.joints[body]
        axis = placement[36:39]
        in_parent = (placement[:9] + placement[9:18]).reshape(3, 3).T @ axis  # constant there
        parallel = above >= 0 and abs(float(in_parent @ tree.joints[above][36:39])) > 1.0 - TINY
        joined[body] = joined[above] if parallel else []
        joined[body].append(int(tree.leaders[body]))
    chains = {id(chain): tuple(model.joints[j] for j in chain) for chain in joined.values()}
    return [chain for chain in chains.values() if len(chain) > 1]


def find_encoders(model: RobotModel, logs: Sequence[Log]) -> Encoders:
    """Find zeros and signs of encoders from the position errors that gravity causes."""
    length = sum(float(log.t[-1] - log.t[0]) for log in logs)
    cutoff = min(max(_SLOW, _PERIODS / length), _FAST)
    samples = [_smooth(log, max(_SAMPLES // len(logs), 50), cutoff) for log in logs]
    motion = _Motion(*(np.concatenate(parts) for parts in zip(*samples, strict=True)))
    N, n = motion.q.shape
    is_revolute = np.array([joint.type != "prismatic" for joint in model.limits])
    revolute = np.flatnonzero(is_revolute & (np.ptp(motion.q, axis=0) > _RANGE))
    free, near = [*revolute], np.cos(1.5 * (_TRIALS[1, 1] - _TRIALS[0, 1]))
    while True:
        sign, zero, gain, cost, costs = _descend(model, motion, revolute, free)
        margin, next_sign, next_zero = np.zeros(n), sign.copy(), zero.copy()
        for j in revolute:
            away = (_TRIALS[:, 0] != sign[j]) | (np.cos(_TRIALS[:, 1] - zero[j]) < near)
            k = int(np.argmin(np.where(away, costs[j], np.inf)))
            margin[j] = np.expm1((costs[j, k] - cost) / N)
            next_sign[j], next_zero[j] = _TRIALS[k]
        ambiguous = [j for j in free if gain[j] > 0 and margin[j] < CLEAR]
        if not ambiguous:
            break
        free = [j for j in free if j not in ambiguous]  # these have the URDF's values
    explained = 1.0 - motion.left(model, sign, zero) / motion.without
    return Encoders(sign, zero, gain, explained, margin, next_sign, next_zero)


def _descend(
    model: RobotModel, motion: "_Motion", revolute: Array, free: Sequence[int]
) -> tuple[Array, Array, Array, float, Array]:
    """Return sign, zero and gain of each joint, the least cost, and that of each joint's trials."""
    N, n = motion.q.shape
    sign, zero, gain = np.ones(n), np.zeros(n), np.zeros(n)
    first = cost = motion.cost(model, sign, zero)
    costs, moved = np.full((n, len(_TRIALS)), np.inf), True
    while moved:
        moved = False
        for j in revolute:
            for k, trial in enumerate(_TRIALS):
                trial_sign, trial_zero = sign.copy(), zero.copy()
                trial_sign[j], trial_zero[j] = trial
                costs[j, k] = motion.cost(model, trial_sign, trial_zero)
            k = int(np.argmin(costs[j]))
            if j in free and costs[j, k] < cost - np.log1p(CLEAR) * N:
                gain[j] += np.exp((cost - first) / N) - np.exp((costs[j, k] - first) / N)
                (sign[j], zero[j]), cost, moved = _TRIALS[k], float(costs[j, k]), True
    return sign, zero, gain, cost, costs


def _smooth(log: Log, count: int, cutoff: float) -> tuple[Array, ...]:
    """Return the slow motion at samples of a log: the arrays of ``_Motion``."""
    dt = float(np.median(np.diff(log.t)))

    def low_pass(x: Array, below: float) -> Array:
        order = 2  # both ends are extended by 3 (order + 1) rows, as SciPy's filtfilt does
        return zero_phase(x, order, min(below, 0.2 / dt), 1.0 / dt, 3 * (order + 1))

    v = np.gradient(low_pass(log.q, _FAST), dt, axis=0)
    direction = np.tanh(v / SignalSettings().min_velocity)  # friction reverses about this speed
    motion = (log.q, v, np.gradient(v, dt, axis=0), _loop_error(log), direction)
    rows = np.linspace(0, len(log.t) - 1, count).astype(int)
    return tuple(low_pass(x, cutoff)[rows] for x in motion)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Slow motion at N instants; arrays of shape (N, n)."""

    q: Array
    v: Array
    a: Array
    error: Array  # q_ref - q, times the log's factor of kp
    direction: Array  # of friction

    def cost(self, model: RobotModel, sign: Array, zero: Array) -> float:
        """Return N times the summed log of the squared residuals of the position errors."""
        left = np.maximum(self.left(model, sign, zero), 1e-300)
        return len(self.q) * float(np.log(left).sum())

    def left(self, model: RobotModel, sign: Array, zero: Array) -> Array:
        """Return the squared residual of each joint's errors, (n,), with compliances above 0."""
        q, v, a = (sign * x for x in (self.q, self.v, self.a))
        torque = sign * predict_instants(model, model.standard_parameters(), q + zero, v, a)
        left = self.without.copy()
        for j in range(len(sign)):
            x, with_torque = self._fit(j, torque[:, j : j + 1])
            if x[-1] >= 0:
                left[j] = with_torque
        return left

    @cached_property
    def without(self) -> Array:
        """Squared residual of each joint's errors without its torque, (n,)."""
        joints, none = range(self.q.shape[1]), np.zeros((len(self.q), 0))
        return np.array([self._fit(j, none)[1] for j in joints])

    def _fit(self, j: int, torque: Array) -> tuple[Array, float]:
        """Return coefficients and squared residual of a joint's errors: torque (N, 0 or 1)."""
        plain = [np.ones(len(self.q)), self.v[:, j], self.direction[:, j], self.a[:, j]]
        columns, e = np.column_stack([*plain, torque]), self.error[:, j]
        x = np.linalg.lstsq(columns, e, rcond=None)[0]
        return x, float(np.sum((e - columns @ x) ** 2))
