"""The simulated robot: a plant with a controller that tracks a motion, and its log."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.data.log import Log, Trajectory
from robotid.dynamics.memory import remember
from robotid.dynamics.prediction import predict
from robotid.dynamics.simulation.motions import FloatingMotion, Motion
from robotid.dynamics.simulation.plant import Friction, RobotPlant
from robotid.dynamics.simulation.sensors import measure
from robotid.dynamics.simulation.simulation_settings import (
    Actuator,
    Controller,
    Noise,
    Payload,
    Simulation,
    by_joint,
)
from robotid.dynamics.simulation.stand import Stand, supported
from robotid.robot.bodies import link_transfer
from robotid.robot.drives import Lag
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_LONGEST_STEP = 2.5e-3  # largest step of the integration, at any rate of the log [s]
_ELASTIC_STEP = 0.3  # largest step, relative to 1 / w of the fastest elastic gear
_SHORTEST_STEP = 1e-6  # smallest step of the integration; a stiffer gear is refused [s]
_MOST = 2e7  # largest number of steps of a simulation: half an hour ...
_MOST_EACH = 100_000  # ... and between two samples
_CHUNK = 1024  # number of steps for which a motion is evaluated together
_LEAST_INERTIA = 0.02  # smallest inertia in the computation of PD gains [kg m^2 or kg]

# ROS34PW2, a Rosenbrock W-method: order 3 for any Jacobian approximation, L-stable
_GAMMA = 4.3586652150845900e-01
_ALPHA = np.zeros((4, 4))
_ALPHA[1, 0] = 8.7173304301691801e-01
_ALPHA[2, :2] = 8.4457060015369423e-01, -1.1299064236484185e-01
_ALPHA[3, 2] = 1.0
_BELOW = np.zeros((4, 4))
_BELOW[1, 0] = -8.7173304301691801e-01
_BELOW[2, :2] = -9.0338057013044082e-01, 5.4180672388095326e-02
_BELOW[3, :3] = 2.4212380706095346e-01, -1.2232505839045147e00, 5.4526025533510214e-01
_WEIGHTS = np.array([*_BELOW[3, :2], 1.5452602553351020e00, _GAMMA])
_STAGES = _ALPHA.sum(axis=1)  # times of the stages [steps]


@dataclass(frozen=True, eq=False)
class Run:
    """The exact motion of a robot; arrays of shape (N, n)."""

    t: Array  # shape (N,) [s]
    q: Array  # [rad or m]
    v: Array  # [rad/s or m/s]
    a: Array  # [rad/s^2 or m/s^2]
    tau: Array  # [N m or N]
    reference: Array  # reference position [rad or m]
    saturated: Array  # share of the time at the torque limit of each drive, shape (n,) [-]
    stand: Stand | None = None  # of a robot whose base floats


def simulate(
    model: RobotModel,
    pi: Array,
    motion: Motion,
    *,
    rate: float,
    duration: float,
    rng: np.random.Generator,
    noise: Noise | None = None,
    settings: Simulation | None = None,
) -> Log:
    """Return the log of a simulated robot that tracks a motion: pi (p,)."""
    chosen = settings or Simulation()
    sensors = chosen.sensors if noise is None else replace(chosen.sensors, noise=noise)
    run = follow(model, pi, motion, rate=rate, duration=duration, settings=chosen)
    return measure(run, sensors, model.joints, rng, delay=delay(model, pi, chosen))


def follow(
    model: RobotModel,
    pi: Array,
    motion: Motion,
    *,
    rate: float,
    duration: float,
    settings: Simulation,
    progress: ProgressCallback = ignore_progress,
) -> Run:
    """Return the exact motion of a robot that tracks a motion.

    The plant is ``RobotPlant`` with the parameters pi. An elastic gear has the motor angle th and
    the torque tau = k dead(th - q) + d (w - v); rotor and friction are then on the motor's side.
    The integrator is a Rosenbrock W-method of order 3, which is stable with stiction.

    References:
        Rang, Angermann (2005), New Rosenbrock W-methods of order 3 for partial differential
        algebraic equations of index 1.

    pi (p,).
    """
    _check_size(duration * rate, 1)
    t = np.arange(round(duration * rate) + 1) / rate
    loaded = carried(model, pi, settings.payload)
    deflection = settings.payload.start if settings.payload.mass > 0 else math.inf
    if not model.free_flyer:
        model.require_fixed("simulation")
    if settings.controller.kind == "perfect":
        return _perfect(model, pi, loaded, motion, t, deflection)
    if model.free_flyer:
        raise SettingsError(
            f"controller: kind is {settings.controller.kind}, wanted perfect: a robot whose base "
            "floats tracks the motion exactly. State --controller perfect"
        )
    loops = [_Loop(model, x, settings) for x in (pi, loaded)]
    steps = max(1, math.ceil(1.0 / rate / min(loop.longest_step for loop in loops) - 1e-9))
    _check_size(len(t), steps)
    h = 1.0 / rate / steps
    loop, *later = loops if deflection > 0 else loops[1:]
    measured = np.empty((len(t), 4, len(model.joints)))
    reference, limited = np.empty_like(measured[:, 0]), np.zeros(len(model.joints))
    y: Array | None = None
    for k, wanted in enumerate(_wanted(loop.controller, motion, len(t), steps, h)):
        if later and t[k] >= deflection - 1e-9 / rate:
            loop = later.pop()
        y = loop.start(*wanted[0, 0, :3]) if y is None else y
        F = loop.friction(y)
        f = loop.rate(y, wanted[0, 0], F)
        measured[k], reference[k] = loop.measured(y, f, wanted[0, 0]), wanted[0, 0, 0]
        limited += loop.is_limited(y, wanted[0, 0])
        if not np.isfinite(measured[k]).all():
            raise DataError(
                f"the simulation diverged at t = {t[k]:.3f} s. Use a slower motion, or lower gains "
                "or bandwidth of the controller"
            )
        if k % 1000 == 0:
            progress("simulating", round(t[k]), round(t[-1]), "s")
        if k + 1 < len(t):
            for i, stages in enumerate(wanted):
                F = F if i == 0 else loop.friction(y)
                f = f if i == 0 else loop.rate(y, stages[0], F)
                y = _advance(loop, y, stages, h, F, f)
    q, v, a, tau = measured.transpose(1, 0, 2)
    return Run(t, q, v, a, tau, reference, limited / len(t))


def _check_size(samples: float, steps: int) -> None:
    """Refuse simulations with too many steps for an hour of computation."""
    if samples * steps > _MOST or steps > _MOST_EACH:
        raise SettingsError(
            f"the simulation has {samples:.3g} samples of {steps} steps each, wanted at most "
            f"{_MOST:.0e} steps in total and {_MOST_EACH:.0e} per sample. Lower the rate or the "
            "duration (check the motion for gaps), or gains, bandwidth and stiffness"
        )


def _wanted(
    controller: "_Torque", motion: Motion, samples: int, steps: int, h: float
) -> Iterator[Array]:
    """Yield q, v, a and feed-forward torque of each sample, (steps, stages, 4, n)."""
    several = max(1, _CHUNK // steps)  # samples together
    for first in range(0, samples, several):
        count = min(several, samples - first)
        starts = h * np.arange(steps * first, steps * (first + count))
        times = (starts[:, None] + _STAGES * h).reshape(-1)
        q, v, a = motion.evaluate(times)
        grid = np.stack([q, v, a, controller.feedforward(q, v, a)], axis=1)
        yield from grid.reshape(count, steps, len(_STAGES), 4, -1)


def carried(model: RobotModel, pi: Array, payload: Payload) -> Array:
    """Return the parameters of a robot with a payload, shape (p,): pi (p,)."""
    if payload.mass == 0.0:
        return pi
    link = payload.link or model.layout.bodies[-1]
    body, transfer = link_transfer(model, link)
    if body < 0:
        raise SettingsError(f"payload: link {link!r} is fixed to the world. Name a moving link")
    m, c = payload.mass, np.array(payload.com)
    xx, xy, yy, xz, yz, zz = payload.inertia
    central = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    about_link = central + m * (c @ c * np.eye(3) - np.outer(c, c))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = about_link.tolist()
    own = np.array([m, *(m * c), xx, xy, yy, xz, yz, zz])
    if np.linalg.eigvalsh(pseudo_inertia(own)[0])[0] < -1e-9 * m:
        raise SettingsError(
            f"payload: inertia is {list(payload.inertia)}, which is physically inconsistent. Each "
            "principal moment must be 0 or more, and at most the sum of the other two"
        )
    found = pi.copy()
    found[10 * body : 10 * body + 10] += transfer @ own
    return found


def _perfect(
    model: RobotModel, pi: Array, loaded: Array, motion: Motion, t: Array, deflection: float
) -> Run:
    """Return the run of a robot that tracks exactly, by inverse dynamics."""
    q, v, a = motion.evaluate(t)
    none = np.zeros_like(v)
    segment = np.zeros(len(t), dtype=int)
    rows = Trajectory(t, q, v, a, none, model.joints, None, segment)
    torques = []
    for x in [pi] if loaded is pi else [pi, loaded]:
        robot = model.with_reference(x)
        torques += predict(robot, [x], remember(robot, rows))
    tau = np.where((t >= deflection)[:, None], torques[-1], torques[0])
    n = len(model.joints)
    if isinstance(motion, FloatingMotion):
        tau, stand = supported(model, motion, t, (q, v, a), tau)
        q, v, a = (x[:, x.shape[1] - n :] for x in (q, v, a))
        return Run(t, q, v, a, tau, q, np.zeros(n), stand)
    return Run(t, q, v, a, tau, q, np.zeros(n))


def delay(model: RobotModel, pi: Array, settings: Simulation) -> Array:
    """Return the delay of each logged torque by the terms of the drives, shape (n,) [s].

    pi (p,).
    """
    delays = np.zeros(len(model.joints))
    if settings.controller.kind == "perfect":  # its inverse dynamics include the delay
        return delays
    drives = pi[model.layout.n_inertial :]
    for (d, term), value in zip(model.layout.drive_parameters, drives, strict=True):
        if isinstance(term, Lag) and value:
            drive = model.layout.drives[d]
            if drive in model.layout.couplings or value < 0:
                raise SettingsError(
                    f"{drive.name}.lag is {value:g} s, wanted 0 or more, and of a drive of one "
                    "joint: a torque that several joints share has no delay of one joint"
                )
            delays[d] += value
    return delays


class _Loop:
    """The true robot and its controller as dy/dt = f(y, reference).

    y has q and v of the joints, th and w of the motors if gears are elastic, then the bristle
    deflections of presliding.
    """

    def __init__(self, model: RobotModel, pi: Array, settings: Simulation) -> None:
        self.plant = plant = RobotPlant(model, pi)
        mass = plant.mass_matrix(np.zeros(len(model.joints)))
        self.controller = _Torque(model, settings.controller, mass)
        self.limit = _limits(model, settings.actuator)
        self.has_limits, self.n = bool(np.isfinite(self.limit).any()), len(model.joints)
        self.is_at_motor = settings.sensors.side == "motor"
        self.gear = _Gear(plant, settings.actuator) if settings.actuator.is_elastic else None
        self.longest_step = self._longest_step()

    def start(self, q: Array, v: Array, a: Array) -> Array:
        """Return the initial state of a motion: gears under load, friction in steady sliding."""
        moving = [q, v]
        if self.gear is not None:
            load = self.plant.bodies_torque(q, v, a)
            moving += [q + self.gear.twist(load), v]
        _, deflection = self.plant.bristle_rate(v)
        return np.concatenate([*moving, deflection])

    def friction(self, y: Array) -> Friction:
        """Return the friction of a state."""
        _, _, motor, w, z = self._parts(y)
        return self.plant.friction(motor, w, z)

    def rate(self, y: Array, wanted: Array, F: Friction) -> Array:
        """Return dy/dt; ``wanted`` has q, v, a and the feed-forward torque, shape (4, n)."""
        q, v, motor, w, z = self._parts(y)
        u = self.torque(motor, w, wanted)
        if self.gear is None:
            moved = [v, self.plant.acceleration(q, v, u, F)]
        else:
            load = self.gear.torque(q, v, motor, w)
            a = self.plant.free_acceleration(q, v, load, rotors=False)
            spun = self.gear.rotors @ (u - load - self.plant.friction_torque(F, w, load))
            moved = [v, a, w, spun]
        if len(z):
            r, end = self.plant.bristle_rate(w)
            moved.append(r * (end - z))
        return np.concatenate(moved)

    def torque(self, q: Array, v: Array, wanted: Array) -> Array:
        """Return the torques of the drives."""
        u = self.controller.of(q, v, *wanted)
        return np.clip(u, -self.limit, self.limit) if self.has_limits else u

    def is_limited(self, y: Array, wanted: Array) -> Array | bool:
        """Return which drives are at their torque limit, shape (n,), bool."""
        if not self.has_limits:
            return False
        _, _, motor, w, _ = self._parts(y)
        limited: Array = np.abs(self.torque(motor, w, wanted)) >= self.limit
        return limited

    def measured(self, y: Array, f: Array, wanted: Array) -> Array:
        """Return q, v, a and tau on the side of the sensors, shape (4, n)."""
        q, v, motor, w, _ = self._parts(y)
        n = self.n
        if self.gear is None or not self.is_at_motor:
            load = None if self.gear is None else self.gear.torque(q, v, motor, w)
            return np.stack(
                [q, v, f[n : 2 * n], self.torque(q, v, wanted) if load is None else load]
            )
        return np.stack([motor, w, f[3 * n : 4 * n], self.torque(motor, w, wanted)])

    def damped(self, y: Array, h: float, F: Friction) -> Callable[[Array, Array], Array]:
        """Return (f, s) -> (1 - g h J)^-1 (f + h J s), with g of the method and J of friction.

        J uses the chord of friction over speed, F(w) / w, and the rate of presliding.
        """
        q, v, motor, w, z = self._parts(y)
        load = np.zeros(self.n)
        if self.plant.is_loaded:
            still = np.zeros(self.n)
            load = (
                self.plant.bodies_torque(q, v, still)
                if self.gear is None
                else self.gear.torque(q, v, motor, w)
            )
        r, _ = self.plant.bristle_rate(w) if len(z) else (z, z)
        B = h * self.plant.chord(F, w, load)  # (n, n)
        inertia = self.plant.mass_matrix(q) if self.gear is None else self.plant.armature
        inverse = np.linalg.inv(inertia + _GAMMA * B)
        keep, lose, n = inverse @ inertia, inverse @ B, self.n
        own = slice(n, 2 * n) if self.gear is None else slice(3 * n, 4 * n)

        def solve(f: Array, s: Array) -> Array:
            k = f.copy()
            k[own] = keep @ f[own] - lose @ s[own]
            if len(r):
                k[-len(r) :] = (f[-len(r) :] - h * r * s[-len(r) :]) / (1.0 + _GAMMA * h * r)
            return k

        return solve

    def _parts(self, y: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return q and v of the joints, q and v of the drives, and the bristle deflections."""
        n = self.n
        if self.gear is None:
            return y[:n], y[n : 2 * n], y[:n], y[n : 2 * n], y[2 * n :]
        return y[:n], y[n : 2 * n], y[2 * n : 3 * n], y[3 * n : 4 * n], y[4 * n :]

    def _longest_step(self) -> float:
        """Return the largest step that resolves the dynamics [s]."""
        if self.gear is None:
            return _LONGEST_STEP
        w = self.gear.fastest(self.plant.mass_matrix(np.zeros(self.n)) - self.plant.armature)
        step = min(_LONGEST_STEP, _ELASTIC_STEP / w)
        if step < _SHORTEST_STEP:
            raise SettingsError(
                f"actuator: the natural frequency of the elastic gears is {w / (2 * np.pi):.3g} "
                "Hz, too high to simulate. Lower stiffness or damping, or leave them out for rigid "
                "gears"
            )
        return step


def _advance(loop: _Loop, y: Array, wanted: Array, h: float, F: Friction, f: Array) -> Array:
    """Return the state one step later: wanted (4, 4, n)."""
    solve = loop.damped(y, h, F)
    K = np.zeros((4, len(y)))
    K[0] = solve(f, K[0])
    for i in range(1, 4):
        x = y + h * (_ALPHA[i] @ K)
        K[i] = solve(loop.rate(x, wanted[i], loop.friction(x)), _BELOW[i] @ K)
    after: Array = y + h * (_WEIGHTS @ K)
    return after


class _Gear:
    """Springs with backlash between motors and joints."""

    def __init__(self, plant: RobotPlant, actuator: Actuator) -> None:
        joints = plant.model.joints
        self.k = by_joint(actuator.stiffness, joints, "actuator: stiffness", np.inf)
        self.d = by_joint(actuator.damping, joints, "actuator: damping")
        self.play = by_joint(actuator.backlash, joints, "actuator: backlash") / 2
        if np.isinf(self.k).any():
            joint = joints[int(np.argmax(np.isinf(self.k)))]
            raise SettingsError(
                f"actuator: stiffness is not stated for {joint!r}. State it for every joint"
            )
        if np.linalg.eigvalsh(plant.armature)[0] <= 0.0:
            least = joints[int(np.argmin(plant.armature.diagonal()))]
            raise SettingsError(
                f"the motor of {least!r} has no armature, which an elastic gear needs. State it in "
                f'[truth.values], for example "{least}.armature" = 0.1 [kg m^2]'
            )
        self.rotors = np.linalg.inv(plant.armature)

    def torque(self, q: Array, v: Array, motor: Array, w: Array) -> Array:
        """Return the torques of the gears on the joints, shape (n,)."""
        twist = motor - q
        deflection = twist - np.clip(twist, -self.play, self.play)
        is_engaged = np.abs(twist) >= self.play
        tau: Array = self.k * deflection + self.d * (w - v) * is_engaged
        return tau

    def twist(self, tau: Array) -> Array:
        """Return the angle of the motor relative to the joint for a torque at rest."""
        twist: Array = tau / self.k + self.play * np.sign(tau)
        return twist

    def fastest(self, bodies: Array) -> float:
        """Return the largest natural frequency or damping rate of the gears [1/s]."""
        inverse = self.rotors.diagonal() + np.linalg.inv(bodies).diagonal()
        return float(np.max(np.maximum(np.sqrt(self.k * inverse), self.d * inverse)))


class _Torque:
    """The controller, with the bodies of the URDF and gains for the true mass matrix."""

    def __init__(self, model: RobotModel, settings: Controller, mass: Array) -> None:
        self.kind, self.w = settings.kind, settings.bandwidth
        self.nominal = RobotPlant(model, model.standard_parameters())
        inertia = np.maximum(mass.diagonal(), _LEAST_INERTIA)
        stated = [
            by_joint(x, model.joints, f"controller: {name}", np.nan)
            for name, x in (("kp", settings.kp), ("kd", settings.kd))
        ]
        default = inertia * self.w**2, 2 * inertia * self.w
        self.kp, self.kd = (
            np.where(np.isnan(x), y, x) for x, y in zip(stated, default, strict=True)
        )

    def feedforward(self, q: Array, v: Array, a: Array) -> Array:
        """Return the feed-forward torque along a motion, shape (N, n)."""
        if self.kind != "feedforward":
            return np.zeros_like(q)
        return np.stack([self.nominal.bodies_torque(*one) for one in zip(q, v, a, strict=True)])

    def of(self, q: Array, v: Array, q_r: Array, v_r: Array, a_r: Array, forward: Array) -> Array:
        """Return the torque command of the drives, shape (n,)."""
        if self.kind == "computed_torque":
            w = self.w
            return self.nominal.bodies_torque(q, v, a_r + w**2 * (q_r - q) + 2 * w * (v_r - v))
        u: Array = forward + self.kp * (q_r - q) + self.kd * (v_r - v)
        return u


def _limits(model: RobotModel, actuator: Actuator) -> Array:
    """Return the torque limit of each drive, shape (n,) [N m or N]; infinite without a limit."""
    stated = by_joint(actuator.limits, model.joints, "actuator: limits", np.nan)
    share = actuator.effort
    urdf = [share * j.effort if share and j.effort > 0 else np.inf for j in model.limits]
    return np.where(np.isnan(stated), urdf, stated)
