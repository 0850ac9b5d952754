"""Initial values and prior spreads of free parameters, from a second-order model of each joint.

J a + d v + Fc sign(v) + c = kp (q_ref(t - delay) - q) + kd (v_ref - v), decoupled, within a torque
limit where one is fitted. Without a limit it is also a baseline of the fit with bodies.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Loops, Window
from robotid.dynamics.simulation.simulation_settings import PerJoint
from robotid.estimation.estimators.output_error import OutputError
from robotid.identification.closed_loop.encoder_zeros import Encoders
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import FreeParameter, LoopSimulator
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import TERMS, Viscous
from robotid.robot.mass_matrix import joint_mass_matrices
from robotid.robot.model import RobotModel

_FREQUENCIES = (6.0, 12.0, 24.0, 48.0, 96.0)  # natural frequencies that are tried [rad/s]
_DAMPINGS = (0.5, 1.5)  # damping ratios that are tried
_FRICTIONS = (0.05, 0.5)  # Coulomb friction that is tried, over the typical torque
_LIMITS = (0.6, 0.3, 0.15)  # torque limits that are tried, from the mean torque to the largest one
_DELAYS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)  # delays that are tried [s]
_TRIED = 8  # number of windows of the grid search
_FITTED = 16  # number of windows of the fit
_SHOWS = 1e-3  # smallest identifiable inertia, over that of the fastest loop ...
_CLEAR = 2.0  # ... and over its standard error
_LOWEST = 1e-6  # lower bound of the inertia, over its initial value
_TERMS = (TERMS["viscous"], TERMS["coulomb"], TERMS["offset"])
_STEPS = 12  # of the fit
_WIDE = 10.0  # prior spread of drive parameters over their typical size: a weak prior
_SHARE = 0.5  # initial share of the bodies in a joint's inertia, where its gain is unknown
_DELAY_SPREAD = 0.1  # prior spread of a delay [s]
_ZERO_SPREAD = 0.3  # prior spread of an encoder's zero about its first estimate [rad or m]
_SMALLEST_BODY = 0.3  # smallest body inertia over the largest: small joints have gears, too
_POSES = 50  # number of poses at which the inertia of the bodies is computed
_LEAST = 0.05  # smallest initial armature and lower bound of a gain, over the typical size
_LIMITED = 0.8  # initial torque limit over the largest torque without a limit


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """The second-order model of every joint; arrays of shape (n,)."""

    simulator: LoopSimulator
    theta: Array  # its parameters
    loops: Loops  # the parameters as loops without bodies
    torque: Array  # typical torque of the loop, kp rms(q_ref - q) [N m or N]
    inertia_error: Array | float = 0.0  # standard error of the inertia J [kg m^2 or kg]

    @property
    def shows_inertia(self) -> Array:
        """Whether the motion determines the inertia of each joint, shape (n,), bool."""
        found, fastest = self.loops.armature, self.loops.kp / _FREQUENCIES[-1] ** 2
        shows: Array = (found > _SHOWS * fastest) & (found > _CLEAR * self.inertia_error)
        return shows

    @property
    def inertia(self) -> Array:
        """Inertia J of each joint [kg m^2 or kg].

        Of a joint that does not determine it, the standard error is its size, within those of the
        loops that are tried: a smaller estimate would make a common scale of torques arbitrary.
        """
        found, kp = self.loops.armature, self.loops.kp
        fastest, slowest = (kp / w**2 for w in (_FREQUENCIES[-1], _FREQUENCIES[0]))
        possible = np.maximum(found, np.clip(self.inertia_error, fastest, slowest))
        return np.where(self.shows_inertia, found, possible)

    @property
    def time_constant(self) -> Array:
        """Time constant of each joint [s]: of its damping or its oscillation, the longer."""
        loops = self.loops
        damped = (loops.kd + self.friction("viscous")) / loops.kp
        slow: Array = np.maximum(damped, np.sqrt(loops.armature / loops.kp))
        return slow

    def replaced(self, other: "SecondOrder", joints: Array) -> "SecondOrder":
        """Return the model with the values of another one for some joints: joints (n,)."""
        each = np.repeat(joints, len(_TERMS))
        changed = {
            name: np.where(joints, getattr(other.loops, name), getattr(self.loops, name))
            for name in ("armature", "delay", "limit")
        }
        values = np.where(each, other.loops.values, self.loops.values)
        error = np.where(joints, other.inertia_error, self.inertia_error)
        loops = replace(self.loops, values=values, **changed)
        return replace(self, loops=loops, inertia_error=error)

    def friction(self, name: str) -> Array:
        """Return the values of one friction term, shape (n,)."""
        which = [term.name for term in _TERMS].index(name)
        found: Array = self.loops.values[which :: len(_TERMS)]
        return found


def fit_second_order(
    robot: ClosedLoopRobot,
    windows: tuple[Window, ...],
    stated: Loops,
    *,
    finds_delay: bool,
    finds_limit: bool = False,
) -> SecondOrder:
    """Fit the second-order model to windows: a coarse grid for every joint, then least squares."""
    n = len(stated.kp)
    error = np.concatenate([w.log.q_ref[w.counted] - w.log.q[w.counted] for w in windows])  # type: ignore[index]
    torque = stated.kp * np.maximum(np.sqrt(np.mean(error**2, axis=0)), 1e-6)
    mean = stated.kp * error.mean(axis=0)  # the load by gravity; a drive bears it within its limit
    bare = replace(
        stated,
        bodies=np.zeros_like(stated.bodies),
        zero=np.zeros(n),
        limit=np.full(n, np.inf),
        terms=(_TERMS,) * n,
        values=np.column_stack([np.zeros((n, 2)), mean]).reshape(-1),
    )
    least, largest = np.abs(mean), stated.kp * np.abs(error).max(axis=0)
    limits = [least + share * (largest - least) for share in _LIMITS]
    limits = limits if finds_limit else [bare.limit]
    start = _coarse(robot, windows[:_TRIED], bare, torque, finds_delay, limits)
    free_parameters = _free_parameters(robot, start, torque, finds_delay, finds_limit)
    some = windows[:: max(1, len(windows) // _FITTED)]
    simulator = LoopSimulator(robot, some, start, free_parameters)
    estimate = OutputError(whitens=False, steps=_STEPS).fit(simulator)
    is_inertia = [free.what == "armature" for free in free_parameters]  # joint by joint
    error = estimate.std_error[is_inertia]
    return SecondOrder(simulator, estimate.theta, simulator.loops(estimate.theta), torque, error)


def _free_parameters(
    robot: ClosedLoopRobot, start: Loops, torque: Array, finds_delay: bool, finds_limit: bool
) -> tuple[FreeParameter, ...]:
    """Return inertia, friction, offset, delay and limit of each joint as free parameters."""
    found = []
    for j, joint in enumerate(robot.model.joints):
        J = start.armature[j]
        found.append(FreeParameter(f"{joint}.armature", "armature", (j,), J, 10 * J, _LOWEST * J))
        for k, term in enumerate(_TERMS):
            value = float(start.values[len(_TERMS) * j + k])
            spread = 100 * torque[j] * (10.0 if term.name == "viscous" else 1.0)
            found.append(FreeParameter.of_term(joint, term, (j,), value, spread))
        if finds_delay:
            found.append(
                FreeParameter(f"{joint}.delay", "delay", (j,), float(start.delay[j]), 0.1, 0.0)
            )
        if finds_limit:
            F = float(start.limit[j])
            found.append(FreeParameter(f"{joint}.limit", "limit", (j,), F, 10 * F, _LOWEST * F))
    return tuple(found)


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
            "no second-order model of the joints that was tried can be simulated. State the "
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
    k = len(_TERMS)
    values = np.where(np.repeat(better, k), trial.values, found.values)
    return np.where(better, cost, best), replace(
        found,
        armature=np.where(better, trial.armature, found.armature),
        delay=np.where(better, trial.delay, found.delay),
        limit=np.where(better, trial.limit, found.limit),
        values=values,
    )


@dataclass(frozen=True, eq=False)
class TypicalSizes:
    """Typical sizes of each joint, for initial values and prior spreads; arrays of shape (n,)."""

    inertia: Array  # inertia of joint and rotor [kg m^2 or kg]
    bodies: Array  # part of the URDF's bodies in it [kg m^2 or kg]
    torque: Array  # torque [N m or N]
    #: Initial torque limit: somewhat less than the largest torque without a limit [N m or
    #: N].
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
    """Return typical sizes; where a gain is unknown, the inertia of bodies scales all torques.

    Joints of a group have one gain, and so one scale: the median of those whose motion determines
    their inertia. With scales of their own, the friction of one relative to their common gain would
    not be that of its motion: more than the drive can overcome, and its simulation never moves.

    At its largest speed, ``top`` if more than 0, the limit of a drive is the friction torque.

    has_gain (n,), top (n,) [rad/s or m/s], factor (n,) [-].
    """
    model = robot.model
    q = np.concatenate([w.log.q[w.counted] for w in windows])
    bodies = _inertia(model, model.standard_parameters(), windows)
    measure = np.maximum(bodies, _SMALLEST_BODY * bodies.max()) / _SHARE
    scale = np.where(has_gain, 1.0, measure / plain.inertia)
    for group in dict.fromkeys(groups):
        own = (np.array(groups) == group) & ~has_gain
        shown = own & plain.shows_inertia
        if own.any():
            scale[own] = np.median(scale[shown if shown.any() else own])
    scale = np.where(has_gain, 1.0, factor * scale)
    # friction may hide the inertia in a second-order model
    inertia = np.maximum(plain.inertia * scale, bodies)
    error = np.concatenate([w.log.q_ref[w.counted] for w in windows]) - q  # type: ignore[index]
    unlimited = _LIMITED * plain.loops.kp * np.abs(error).max(axis=0)
    unlimited = np.minimum(unlimited, plain.loops.limit)
    friction = plain.friction("viscous") * top + plain.friction("coulomb")
    largest = scale * np.where(top > 0.0, np.minimum(friction, unlimited), unlimited)
    return TypicalSizes(inertia, bodies, plain.torque * scale, largest, _speed(windows), scale)


def typical_sizes_of_torques(
    model: RobotModel, pi: Array, armature: Array, windows: Sequence[Window]
) -> TypicalSizes:
    """Return typical sizes from logged torques, without a closed loop."""
    # pi (p,), armature (n,) [kg m^2 or kg]
    tau = np.concatenate([w.log.tau[w.counted] for w in windows])
    torque = np.maximum(np.sqrt(np.mean(tau**2, axis=0)), 1e-6)
    inertia, one = _inertia(model, pi, windows), np.ones(len(armature))
    return TypicalSizes(inertia, inertia - armature, torque, np.inf * one, _speed(windows), one)


def _inertia(model: RobotModel, pi: Array, windows: Sequence[Window]) -> Array:
    """Return the typical diagonal of the joint-space mass matrix, shape (n,)."""
    q = np.concatenate([w.log.q[w.counted] for w in windows])
    M = joint_mass_matrices(model, pi, q[:: max(1, len(q) // _POSES)])
    typical: Array = np.median(np.diagonal(M, axis1=1, axis2=2), axis=0)
    return typical


def _speed(windows: Sequence[Window]) -> Array:
    """Return the typical speed of each joint, shape (n,)."""
    steps = [np.diff(w.log.q[w.counted], axis=0) / _period(w) for w in windows]
    speed: Array = np.maximum(np.sqrt(np.mean(np.concatenate(steps) ** 2, axis=0)), 1e-6)
    return speed


def _period(window: Window) -> float:
    """Return the time between the rows of a window's log [s]."""
    return float(np.median(np.diff(window.log.t)))


def first_loops(
    model: RobotModel, stated: Loops, plain: SecondOrder, typical: TypicalSizes, finds_limit: Array
) -> Loops:
    """Return the initial loops of the fit: finds_limit (n,)."""
    friction = {name: plain.friction(name) * typical.scale for name in ("viscous", "coulomb")}
    none = np.zeros(len(typical.scale))
    terms = tuple(
        tuple(
            term
            for d, term in model.layout.drive_parameters
            if model.layout.drives[d].name == joint and not term.is_inertia
        )
        for joint in model.joints
    )
    values = [friction.get(t.name, none)[j] for j, own in enumerate(terms) for t in own]
    return replace(
        stated,
        kp=stated.kp * typical.scale,
        armature=np.maximum(typical.inertia - typical.bodies, _LEAST * typical.inertia),
        delay=plain.loops.delay,
        limit=np.where(finds_limit, typical.largest, stated.limit),
        terms=terms,
        values=np.array(values),
    )


def free_drive_parameters(
    model: RobotModel,
    loop: LoopSettings,
    groups: Sequence[str],
    base: Loops,
    typical: TypicalSizes,
    *,
    finds_kd: Array | bool,
    finds_limit: Array,
) -> list[FreeParameter]:
    """Return the free parameters of drives and loops, with initial values from ``base``."""
    # finds_kd (n,), finds_limit (n,)
    members: dict[str, list[int]] = {}
    for j, group in enumerate(groups):
        members.setdefault(group, []).append(j)
    is_closed = np.full(len(groups), loop.kind != "torque")
    # each drive has its own limit; delays are mostly those of the bus and the controller
    sharing: dict[str, dict[str, list[int]]] = {
        "limit": {joint: [j] for j, joint in enumerate(model.joints)}
    }
    if loop.delays == "one":
        sharing["delay"] = {"robot": [*range(len(groups))]}
    free = {
        "armature": np.full(len(groups), "armature" in model.layout.terms),
        "kp": ~is_stated(loop.kp, model) & is_closed,
        "kd": ~is_stated(loop.kd, model) & finds_kd,
        "limit": finds_limit,
        "delay": ~is_stated(loop.delay, model) & is_closed,
    }
    spread = {
        "armature": typical.inertia,
        "kp": base.kp / _WIDE,
        "kd": typical.torque / typical.speed,
        "limit": typical.torque,
        "delay": np.full(len(groups), _DELAY_SPREAD / _WIDE),
    }
    found = []
    for what, is_free in free.items():
        for name, joints in sharing.get(what, members).items():
            own = tuple(j for j in joints if is_free[j])
            if own:
                initial = float(np.median(getattr(base, what)[list(own)]))
                wide = _WIDE * float(np.median(spread[what][list(own)]))
                lowest = _LEAST * initial if what in ("kp", "limit") else 0.0
                found.append(FreeParameter(f"{name}.{what}", what, own, initial, wide, lowest))
    for group, joints in members.items():
        for term in {t: None for j in joints for t in base.terms[j]}:
            having = [j for j in joints if term in base.terms[j]]
            # Coulomb friction and offset depend on wear and load, viscous friction on the type
            for owners in [having] if isinstance(term, Viscous) else [[j] for j in having]:
                name = group if len(owners) > 1 else model.joints[owners[0]]
                found.append(_term(name, term, owners, base, typical))
    return found


def _term(
    owner: str, term: DriveTerm, joints: Sequence[int], base: Loops, typical: TypicalSizes
) -> FreeParameter:
    """Return the free parameter of a term of one joint, or of several that share it."""
    initial = float(np.median([base.values[base.place(j, term)] for j in joints]))
    size = typical.torque / (typical.speed if isinstance(term, Viscous) else 1.0)
    wide = _WIDE * float(np.median(size[list(joints)]))
    return FreeParameter.of_term(owner, term, tuple(joints), initial, wide)


def free_zeros(model: RobotModel, encoders: Encoders) -> list[FreeParameter]:
    """Return free parameters for the encoder zeros that differ from the URDF's."""
    return [
        FreeParameter(
            f"{model.joints[j]}.zero", "zero", (int(j),), float(encoders.zero[j]), _ZERO_SPREAD
        )
        for j in np.flatnonzero(encoders.gain > 0)
    ]


def likeness(model: RobotModel) -> list[tuple[object, ...]]:
    """Return the properties in which equal joints agree: limits, mass and moments of the body."""
    bodies = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    sizes = np.column_stack([bodies[:, 0], bodies[:, [4, 6, 9]]])
    found: list[tuple[object, ...]] = []
    for body, joint in zip(sizes, model.limits, strict=True):
        digits = tuple(f"{x:.2g}" for x in body)
        found.append((joint.type, f"{joint.effort:.3g}", f"{joint.velocity:.3g}", digits))
    return found


def is_stated(value: PerJoint | str | None, model: RobotModel) -> Array:
    """Return whether a number is stated for each joint, shape (n,), bool."""
    named = [
        value is not None and (not isinstance(value, Mapping) or joint in value)
        for joint in model.joints
    ]
    return np.array(named)
