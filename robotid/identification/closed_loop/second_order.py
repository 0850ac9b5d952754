"""The second-order model of each commanded joint, decoupled, with Coulomb friction.

J a + d v + Fc sign(v) + c = kp (q_ref(t - delay) - q) + kd (v_ref - v), within a torque limit where
one is fitted. It gives the initial values of the fit with bodies; without a limit, its baseline.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from robotid.base.exceptions import NotConvergedError
from robotid.base.typing import Array
from robotid.dynamics.simulation.loops import ClosedLoopRobot, Loops, Window
from robotid.estimation.estimators.output_error import OutputError
from robotid.identification.closed_loop.free_parameters import FreeParameter, LoopSimulator
from robotid.robot.drives import TERMS

_FREQUENCIES = (6.0, 12.0, 24.0, 48.0, 96.0)  # natural frequencies that are tried [rad/s]
_DAMPINGS = (0.5, 1.5)  # damping ratios that are tried
_FRICTIONS = (0.05, 0.5)  # Coulomb friction that is tried, over the typical torque
_LIMITS = (0.6, 0.3, 0.15)  # torque limits that are tried, over the largest torque without a limit
_DELAYS = (0.0, 0.005, 0.01, 0.02, 0.04, 0.08)  # delays that are tried [s]
_TRIED = 8  # number of windows of the grid search
_FITTED = 16  # number of windows of the fit
_SHOWS = 1e-3  # smallest identifiable inertia, over that of the fastest loop ...
_CLEAR = 2.0  # ... and over its standard error
_LEAST = 1e-6  # lower bound of the inertia, over its initial value
_TERMS = (TERMS["viscous"], TERMS["coulomb"], TERMS["offset"])
_STEPS = 12  # of the fit


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """The second-order model of every joint; arrays of shape (n,).

    Attributes:
        simulator: Its simulator.
        theta: Its parameters.
        loops: The parameters as loops without bodies.
        torque: Typical torque of the loop, kp rms(q_ref - q) [N m or N].
        inertia_error: Standard error of the inertia J [kg m^2 or kg].
    """

    simulator: LoopSimulator
    theta: Array
    loops: Loops
    torque: Array
    inertia_error: Array | float = 0.0

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
    bare = replace(
        stated,
        bodies=np.zeros_like(stated.bodies),
        zero=np.zeros(n),
        limit=np.full(n, np.inf),
        terms=(_TERMS,) * n,
        values=np.zeros(n * len(_TERMS)),
    )
    largest = stated.kp * np.abs(error).max(axis=0)
    limits = [share * largest for share in _LIMITS] if finds_limit else [bare.limit]
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
        found.append(FreeParameter(f"{joint}.armature", "armature", (j,), J, 10 * J, _LEAST * J))
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
            found.append(FreeParameter(f"{joint}.limit", "limit", (j,), F, 10 * F, _LEAST * F))
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
    n = len(bare.kp)
    best, found = np.full(n, np.inf), bare
    delays = np.array(_DELAYS) if finds_delay else np.zeros(1)
    first = float(delays[min(1, len(delays) - 1)])
    for w, z, f, limit in product(_FREQUENCIES, _DAMPINGS, _FRICTIONS, limits):
        J = bare.kp / w**2
        viscous = np.maximum(2 * z * w * J - bare.kd, 0.0)
        values = np.column_stack([viscous, f * torque, np.zeros(n)]).reshape(-1)
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
