"""The simulated robot: a plant by Pinocchio's forward dynamics, a controller, sensors, its log."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, ModelError, NotConvergedError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.tolerances import ROUNDING, SLACK
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.data.log import Log, Trajectory
from robotid.dynamics.simulation.motions import Motion
from robotid.dynamics.simulation.simulation_settings import (
    Actuator,
    Controller,
    Noise,
    Payload,
    PerJoint,
    Sensors,
    Simulation,
    Truth,
    by_joint,
)
from robotid.dynamics.torque import bodies_torque, predict, remember
from robotid.robot.bodies import link_transfer, parameters_about
from robotid.robot.drive_term import DIRECTED, LOADED, PLAIN, MemorylessTerm
from robotid.robot.drives import Bristles, Lag
from robotid.robot.mass_matrix import drive_inertia, rigid_mass_matrices
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia

_LONGEST_STEP = 2.5e-3  # largest step of the integration, at any rate of the log [s]
_ELASTIC_STEP = 0.3  # largest step, relative to 1 / w of the fastest elastic gear
_SHORTEST_STEP = 1e-6  # smallest step of the integration; a stiffer gear is refused [s]
_MOST = 2e7  # largest number of steps of a simulation: half an hour ...
_MOST_EACH = 100_000  # ... and between two samples
_TICK = 1e-6  # smallest step between time stamps [s]
_CHUNK = 1024  # number of steps for which a motion is evaluated together
_LEAST_INERTIA = 0.02  # smallest inertia in the computation of PD gains [kg m^2 or kg]
_ITERATIONS = 200  # of the fixed point of load and load-dependent friction
_SIGN_SPEED = 2e-4  # speed over which the plant's Coulomb friction reverses [rad/s or m/s]
_TYPICAL_EFFORT = 50.0  # effort limit of a drive with typical parameters [N m or N]

# ROS34PW2, a Rosenbrock W-method: order 3 for any Jacobian approximation, L-stable, stable with
# stiction (Rang, Angermann 2005, New Rosenbrock W-methods)
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
    saturated: Array  # share of the time at the torque limit of each drive, (n,) [-]


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
    """Return the exact motion of a plant that tracks a motion; friction is on the motor's side."""
    _check_size(duration * rate, 1)
    t = np.arange(round(duration * rate) + 1) / rate
    loaded = carried(model, pi, settings.payload)
    attached = settings.payload.start if settings.payload.mass > 0 else math.inf  # [s]
    model.require_fixed("simulation")
    if settings.controller.kind == "perfect":
        return _perfect(model, pi, loaded, motion, t, attached)
    loops = [_Loop(model, x, settings) for x in (pi, loaded)]
    steps = max(1, math.ceil(1.0 / rate / min(loop.longest_step for loop in loops) - 1e-9))
    _check_size(len(t), steps)
    h = 1.0 / rate / steps
    loop, *later = loops if attached > 0 else loops[1:]
    measured = np.empty((len(t), 4, len(model.joints)))
    reference, limited = np.empty_like(measured[:, 0]), np.zeros(len(model.joints))
    y = np.empty(0)
    for k, wanted in enumerate(_wanted(loop.controller, motion, len(t), steps, h)):
        if later and t[k] >= attached - 1e-9 / rate:
            loop = later.pop()
        y = y if k else loop.start(*wanted[0, 0, :3])
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
    """Refuse simulations with too many steps for half an hour of computation."""
    if samples * steps > _MOST or steps > _MOST_EACH:
        raise SettingsError(
            f"the simulation has {samples:.3g} samples of {steps} steps each, expected at most "
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
    xx, xy, yy, xz, yz, zz = payload.inertia
    central = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    added = parameters_about(payload.mass, np.array(payload.com), central)
    if np.linalg.eigvalsh(pseudo_inertia(added)[0])[0] < -1e-9 * payload.mass:
        raise SettingsError(
            f"payload: inertia is {list(payload.inertia)}, which is physically inconsistent. Each "
            "principal moment must be 0 or more, and at most the sum of the other two"
        )
    loaded = pi.copy()
    loaded[10 * body : 10 * body + 10] += transfer @ added
    return loaded


def _perfect(
    model: RobotModel, pi: Array, loaded: Array, motion: Motion, t: Array, attached: float
) -> Run:
    """Return the run of a robot that tracks exactly, by inverse dynamics."""
    q, v, a = motion.evaluate(t)
    none, segment = np.zeros_like(v), np.zeros(len(t), dtype=int)
    rows = Trajectory(t, q, v, a, none, model.joints, None, segment)
    torques = []
    for x in [pi] if loaded is pi else [pi, loaded]:
        robot = model.with_reference(x)
        torques += predict(robot, [x], remember(robot, rows))
    tau = np.where((t >= attached)[:, None], torques[-1], torques[0])
    return Run(t, q, v, a, tau, q, np.zeros(len(model.joints)))


def delay(model: RobotModel, pi: Array, settings: Simulation) -> Array:
    """Return the delay of each logged torque by the terms of the drives, shape (n,) [s]."""
    delays = np.zeros(len(model.joints))
    if settings.controller.kind == "perfect":  # its inverse dynamics include the delay
        return delays
    drives = pi[model.layout.n_inertial :]
    for (d, term), value in zip(model.layout.drive_parameters, drives, strict=True):
        if isinstance(term, Lag) and value:
            drive = model.layout.drives[d]
            if drive in model.layout.couplings or value < 0:
                raise SettingsError(
                    f"{drive.name}.lag is {value:g} s, expected 0 or more, and of a drive of one "
                    "joint: a torque that several joints share has no delay of one joint"
                )
            delays[d] += value
    return delays


@dataclass(frozen=True)
class _Group:
    """The k drives that have a common term."""

    term: Bristles | MemorylessTerm
    drives: Array | slice  # their indices
    theta: Array  # its parameters, shape (k,)
    states: slice  # their bristle states; empty without any
    kind: int  # PLAIN, DIRECTED or LOADED: its place in ``Friction``


class Friction(NamedTuple):
    """Friction torque of drives, ``(along + loaded |load|) sign(w) + rest``, all of shape (d,)."""

    rest: Array
    along: Array
    loaded: Array


class RobotPlant:
    """The plant M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u of a robot.

    sign(v) is tanh(v / 0.2 mm/s). Load-dependent friction uses the load of the same instant. The
    bristle deflection z is a state; not given: steady. A ``Lag`` is one of the measurement.
    """

    def __init__(self, model: RobotModel, pi: Array) -> None:
        model.require_fixed("simulation")
        if pi.shape != (len(model.layout.names),):
            raise DataError(f"pi has shape {pi.shape}, expected ({len(model.layout.names)},)")
        self.model, self.pi = model, pi
        self._bodies = model.with_parameters(pi)
        self._data = self._bodies.pin_model.createData()
        self.armature = drive_inertia(model.layout, pi)  # (n, n)
        self.ratios = model.layout.drive_ratios  # (d, n)
        self._share = self.ratios / np.sum(self.ratios**2, axis=1, keepdims=True).clip(min=1e-300)
        self._groups, self._linear = _grouped(model, pi)
        self.n_states = sum(g.states.stop - g.states.start for g in self._groups)
        self.is_loaded = any(group.kind == LOADED for group in self._groups)
        G, A, engine = model.velocity_map, self.armature, model.pin_model
        # Pinocchio's own joints, each with its own rotor: its ABA is sufficient
        has_own_rotors = np.array_equal(A, np.diag(A.diagonal()))
        self._is_plain = np.array_equal(G, np.eye(len(G))) and has_own_rotors
        self._is_angle = engine.nq == engine.nv and not model.position_offset.any()
        self._driven = pin.Model(self._bodies.pin_model)
        if self._is_plain:
            self._driven.armature = A.diagonal().copy()

    def mass_matrix(self, q: Array) -> Array:
        """Return D(q), the mass matrix with the drives' armature, shape (n, n)."""
        x = self._configuration(q)
        if self._is_plain:
            return np.array(pin.crba(self._driven, self._data, x))
        return np.asarray(rigid_mass_matrices(self._bodies, x[None], self._data)[0] + self.armature)

    def bodies_torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return the inverse dynamics of the bodies alone, shape (n,) [N m or N]."""
        G, x = self.model.velocity_map, self._configuration(q)
        return np.asarray(G.T @ pin.rnea(self._bodies.pin_model, self._data, x, G @ v, G @ a))

    def friction(self, q: Array, v: Array, z: Array | None = None) -> Friction:
        """Return the friction of the drives, without inertia and the sign of the speed."""
        angle, w = self.ratios @ q, self.ratios @ v
        parts = self._linear[:-1].copy()
        parts[PLAIN] += self._linear[-1] * w
        for group in self._groups:
            term, drives, theta = group.term, group.drives, group.theta
            if not isinstance(term, Bristles):
                parts[group.kind, drives] += theta * term.amplitude(angle[drives], w[drives])
            elif z is None:
                parts[group.kind, drives] += theta * term.level(w[drives])
            else:
                parts[PLAIN, drives] += theta * z[group.states]
        return Friction(*parts)

    def friction_torque(self, F: Friction, v: Array, load: Array) -> Array:
        """Return the friction torque of the drives under a load (n,), shape (n,) [N m or N]."""
        sign = np.tanh(self.ratios @ v / _SIGN_SPEED)
        return np.asarray(self.ratios.T @ (self._along(F, load) * sign + F.rest))

    def chord(self, F: Friction, v: Array, load: Array) -> Array:
        """Return the friction with the sign of the speed, divided by the speed, shape (n, n)."""
        x = np.maximum(np.abs(self.ratios @ v) / _SIGN_SPEED, 1e-6)  # tanh(x) / x is 1 at 0
        slope = np.maximum(self._along(F, load), 0.0) * np.tanh(x) / (x * _SIGN_SPEED)
        return np.asarray((self.ratios.T * slope) @ self.ratios)

    def _along(self, F: Friction, load: Array) -> Array:
        """Return the friction that has the sign of the speed, shape (d,)."""
        return F.along + F.loaded * np.abs(self._share @ load) if self.is_loaded else F.along

    def bristle_rate(self, v: Array) -> tuple[Array, Array]:
        """Return r [1/s] and g sign(w) of the bristle deflection, dz/dt = r (g sign(w) - z)."""
        w = self.ratios @ v
        rate, end = np.zeros((2, self.n_states))
        for group in self._groups:
            if isinstance(group.term, Bristles):
                speed = w[group.drives]
                level = group.term.level(speed)
                rate[group.states] = np.abs(speed) / (group.term.displacement * level)
                end[group.states] = np.sign(speed) * level
        return rate, end

    def acceleration(self, q: Array, v: Array, u: Array, F: Friction | None = None) -> Array:
        """Return the acceleration D(q)^-1 (u - C(q, v)), shape (n,) (Tzvetkova, (11))."""
        F = self.friction(q, v) if F is None else F
        sign = np.tanh(self.ratios @ v / _SIGN_SPEED)
        free = u - self.ratios.T @ (F.along * sign + F.rest)
        a = self.free_acceleration(q, v, free)
        return self._loaded(q, free, a, F.loaded * sign) if self.is_loaded else a

    def free_acceleration(self, q: Array, v: Array, tau: Array, *, rotors: bool = True) -> Array:
        """Return the acceleration of bodies and rotors without friction, shape (n,)."""
        x, G = self._configuration(q), self.model.velocity_map
        if self._is_plain:
            robot = self._driven if rotors else self._bodies.pin_model
            return np.array(pin.aba(robot, self._data, x, v, tau))
        D = rigid_mass_matrices(self._bodies, x[None], self._data)[0] + rotors * self.armature
        bias = G.T @ pin.nonLinearEffects(self._bodies.pin_model, self._data, x, G @ v)
        return np.linalg.solve(D, tau - bias)

    def _loaded(self, q: Array, free: Array, a: Array, coefficient: Array) -> Array:
        """Return the acceleration consistent with load-dependent friction, by iteration."""
        D = self.mass_matrix(q)
        per_load = np.linalg.solve(D, self.ratios.T * coefficient)  # acceleration per load, (n, d)
        load = bare = self._share @ (free - self.armature @ a)  # load of the drives without it
        slope = self._share @ (self.ratios.T * coefficient - self.armature @ per_load)
        if not np.isfinite(bare).all():  # the state has diverged
            return a
        for _ in range(_ITERATIONS):
            before, load = load, bare - slope @ np.abs(load)
            if np.abs(load - before).max() <= ROUNDING * (1.0 + np.abs(load).max()):
                return np.asarray(a - per_load @ np.abs(load))
        raise NotConvergedError(
            f"load-dependent friction does not converge in {_ITERATIONS} steps: its parameters are "
            "so large that the drives lock. Set smaller parameters",
            "max_iterations",
        )

    def _configuration(self, q: Array) -> Array:
        """Return Pinocchio's configuration, shape (nq,)."""
        if self._is_plain and self._is_angle:
            return q
        return np.asarray(self.model.configurations(q[None])[0])


def _grouped(model: RobotModel, pi: Array) -> tuple[list[_Group], Array]:
    """Return terms of drives, and ``Friction`` and damping of the linear ones, shape (4, d)."""
    layout, theta = model.layout, pi[model.layout.n_inertial :]
    terms: dict[Bristles | MemorylessTerm, list[int]] = {}
    for k, (_, term) in enumerate(layout.drive_parameters):
        if theta[k] != 0.0 and isinstance(term, Bristles | MemorylessTerm):
            terms.setdefault(term, []).append(k)
    groups, linear, states = [], np.zeros((4, len(layout.drives))), 0
    for term, numbers in terms.items():
        drives = [layout.drive_parameters[k][0] for k in numbers]
        is_all = drives == list(range(len(layout.drives)))
        first, states = states, states + len(numbers) * isinstance(term, Bristles)
        chosen = slice(None) if is_all else np.array(drives)
        kind = term.kind if isinstance(term, MemorylessTerm) else DIRECTED
        if isinstance(term, MemorylessTerm) and term.affine is not None:
            linear[-1 if term.affine == 1 else kind, chosen] += theta[numbers]
        else:
            groups.append(_Group(term, chosen, theta[numbers], slice(first, states), kind))
    return groups, linear


class _Loop:
    """The robot and its controller, dy/dt = f(y, reference); y: joints, motors, bristles."""

    def __init__(self, model: RobotModel, pi: Array, settings: Simulation) -> None:
        self.plant = plant = RobotPlant(model, pi)
        mass = plant.mass_matrix(np.zeros(len(model.joints)))
        self.controller = _Torque(model, settings.controller, mass)
        share = settings.actuator.effort or 0.0
        urdf = [share * max(joint.effort, 0.0) or np.inf for joint in model.limits]
        stated = settings.actuator.limits
        self.limit = by_joint(stated, model.joints, "actuator: limits", urdf)  # [N m or N]
        self.has_limits, self.n = bool(np.isfinite(self.limit).any()), len(model.joints)
        self.is_at_motor = settings.sensors.side == "motor"
        actuator = settings.actuator
        self.gear = None if actuator.stiffness is None else _Gear(plant, actuator)
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
        _, _, motor, w, _ = self._parts(y)
        return self.has_limits and np.abs(self.torque(motor, w, wanted)) >= self.limit

    def measured(self, y: Array, f: Array, wanted: Array) -> Array:
        """Return q, v, a and tau on the side of the sensors, shape (4, n)."""
        q, v, motor, w, _ = self._parts(y)
        if self.gear is not None and not self.is_at_motor:
            tau, side = self.gear.torque(q, v, motor, w), 0
        else:
            tau, q, v = self.torque(motor, w, wanted), motor, w
            side = 0 if self.gear is None else 2
        return np.stack([q, v, f[(side + 1) * self.n : (side + 2) * self.n], tau])

    def damped(self, y: Array, h: float, F: Friction) -> Callable[[Array, Array], Array]:
        """Return (f, s) -> (1 - g h J)^-1 (f + h J s), J of the chord F(w) / w and of bristles."""
        q, v, motor, w, z = self._parts(y)
        n, load = self.n, np.zeros(self.n)
        if self.plant.is_loaded and self.gear is None:
            load = self.plant.bodies_torque(q, v, np.zeros(n))
        elif self.gear is not None:
            load = self.gear.torque(q, v, motor, w)
        r, _ = self.plant.bristle_rate(w) if len(z) else (z, z)
        B = h * self.plant.chord(F, w, load)  # (n, n)
        inertia = self.plant.mass_matrix(q) if self.gear is None else self.plant.armature
        inverse = np.linalg.inv(inertia + _GAMMA * B)
        keep, lose = inverse @ inertia, inverse @ B
        speeds = slice(n, 2 * n) if self.gear is None else slice(3 * n, 4 * n)

        def solve(f: Array, s: Array) -> Array:
            k = f.copy()
            k[speeds] = keep @ f[speeds] - lose @ s[speeds]
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
    return y + h * (_WEIGHTS @ K)


class _Gear:
    """Springs with backlash between motors and joints, k dead(motor - q) + d (w - v)."""

    def __init__(self, plant: RobotPlant, actuator: Actuator) -> None:
        joints = plant.model.joints
        self.k = by_joint(actuator.stiffness, joints, "actuator: stiffness", np.inf)
        self.d = by_joint(actuator.damping, joints, "actuator: damping")
        self.play = by_joint(actuator.backlash, joints, "actuator: backlash") / 2
        if np.isinf(self.k).any():
            joint = joints[int(np.argmax(np.isinf(self.k)))]
            raise SettingsError(
                f"actuator: stiffness is not given for {joint!r}. Set it for every joint"
            )
        if np.linalg.eigvalsh(plant.armature)[0] <= 0.0:
            least = joints[int(np.argmin(plant.armature.diagonal()))]
            raise SettingsError(
                f"the motor of {least!r} has no armature, which an elastic gear needs. Set it in "
                f'[truth.values], for example "{least}.armature" = 0.1 [kg m^2]'
            )
        self.rotors = np.linalg.inv(plant.armature)

    def torque(self, q: Array, v: Array, motor: Array, w: Array) -> Array:
        """Return the torques of the gears on the joints, shape (n,)."""
        twist = motor - q
        deflection = twist - np.clip(twist, -self.play, self.play)
        is_engaged = np.abs(twist) >= self.play
        return np.asarray(self.k * deflection + self.d * (w - v) * is_engaged)

    def twist(self, tau: Array) -> Array:
        """Return the angle of the motor relative to the joint for a torque at rest."""
        return tau / self.k + self.play * np.sign(tau)

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
        default = inertia * self.w**2, 2 * inertia * self.w
        self.kp = by_joint(settings.kp, model.joints, "controller: kp", default[0])
        self.kd = by_joint(settings.kd, model.joints, "controller: kd", default[1])

    def feedforward(self, q: Array, v: Array, a: Array) -> Array:
        """Return the feed-forward torque along a motion, shape (N, n)."""
        if self.kind != "feedforward":
            return np.zeros_like(q)
        return bodies_torque(self.nominal.model, self.nominal.pi, q, v, a)

    def of(self, q: Array, v: Array, q_r: Array, v_r: Array, a_r: Array, forward: Array) -> Array:
        """Return the torque command of the drives, shape (n,)."""
        if self.kind == "computed_torque":
            w = self.w
            return self.nominal.bodies_torque(q, v, a_r + w**2 * (q_r - q) + 2 * w * (v_r - v))
        return np.asarray(forward + self.kp * (q_r - q) + self.kd * (v_r - v))


def measure(
    run: Run,
    sensors: Sensors,
    joints: tuple[str, ...],
    rng: np.random.Generator,
    *,
    delay: Array | float = 0.0,
) -> Log:
    """Return the log of a motion by sensors: delay (n,) [s], then noise, then rounding."""

    def of(value: PerJoint, name: str) -> Array:
        return by_joint(value, joints, f"sensors: {name}")

    noise, step, n = sensors.noise, sensors.step, len(joints)
    v = _delayed(run.t, run.v, np.full(n, sensors.velocity_delay))
    tau = _delayed(run.t, run.tau, sensors.torque_delay + delay * np.ones(n))
    share = of(noise.tau, "noise.tau") * np.sqrt(np.mean(tau**2, axis=0))
    level = np.hypot(share, of(noise.torque, "noise.torque"))
    signals = {
        "q": _noisy(run.q, of(noise.q, "noise.q"), rng),
        "v": _noisy(v, of(noise.v, "noise.v"), rng),
        "tau": _noisy(tau, level, rng),
    }
    q, v, tau = (_rounded(x, of(getattr(step, k), f"step.{k}")) for k, x in signals.items())
    logged = np.ones(len(run.t), dtype=bool)
    if sensors.dropped:
        logged = rng.random(len(logged)) >= sensors.dropped
        if logged.sum() < 2:
            raise DataError(
                f"{logged.sum()} of {len(logged)} samples remain, expected at least 2. Set a "
                "smaller dropped, or a longer duration"
            )
    t = run.t
    if sensors.jitter:
        spread = _TICK * np.arange(len(t))
        t = t + sensors.jitter * rng.standard_normal(len(t))
        t = np.maximum.accumulate(t - spread) + spread
    return Log(
        t=t[logged], q=q[logged], tau=tau[logged], joints=joints,
        v=v[logged] if sensors.velocity else None,
        a=run.a[logged] if sensors.acceleration else None,
    )  # fmt: skip


def _delayed(t: Array, values: Array, delay: Array) -> Array:
    """Return values delayed by joint; before the start, the first values."""
    if not delay.any():
        return values
    columns = [np.interp(t - d, t, x) for d, x in zip(delay, values.T, strict=True)]
    return np.column_stack(columns)


def _noisy(values: Array, level: Array, rng: np.random.Generator) -> Array:
    """Return values with white noise, its standard deviation given by joint."""
    if not level.any():
        return values
    return values + level * rng.standard_normal(values.shape)


def _rounded(values: Array, step: Array) -> Array:
    """Return values rounded to steps, for the joints that have one."""
    size = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.round(values / size) * size, values)


def draw_parameters(model: RobotModel, settings: Truth, rng: np.random.Generator) -> Array:
    """Return the true standard parameters of a robot near the model, shape (p,)."""
    layout = model.layout
    pi = model.standard_parameters()
    pi[: layout.n_inertial] = perturbed_bodies(model, settings.inertials, rng)
    has_drives = settings.drives == "usual"
    effort = {joint.name: joint.effort for joint in model.limits}
    for i, (d, term) in enumerate(layout.drive_parameters, start=layout.n_inertial):
        drawn = rng.uniform(*term.typical)
        shares = [x / _TYPICAL_EFFORT for j, _ in layout.drives[d].ratios if (x := effort[j]) > 0]
        is_share = isinstance(term, MemorylessTerm) and term.is_loaded
        size = 1.0 if is_share or term.is_measured else min([1.0, *shares])
        pi[i] = has_drives * size * drawn
    for name, value in settings.values.items():
        if name not in layout.names:
            raise SettingsError(
                f"truth: values: {name!r} is not a parameter of {model.name}"
                f"{suggestion(name, layout.names)} Known: {listed(layout.names, 12)}"
            )
        pi[layout.names.index(name)] = value
    _check(model, pi)
    return pi


def perturbed_bodies(model: RobotModel, size: float, rng: np.random.Generator) -> Array:
    """Return inertial parameters of bodies near the model's, shape (10 bodies,).

    J' = J^1/2 exp(S) J^1/2 of each body; S is symmetric, with ten independent normal coordinates in
    the metric d^2 = 1/2 tr(log(J^-1 J')^2) (Wensing, Kim, Slotine 2018; Lee, Park 2018, (13)).
    """
    bodies = model.standard_parameters()[: model.layout.n_inertial]
    if size == 0.0:
        return bodies
    perturbed = []
    for name, J in zip(model.layout.bodies, pseudo_inertia(bodies), strict=True):
        values, axes = np.linalg.eigh(J)
        if values[0] < -SLACK * max(values[-1], 0.0) or values[-1] < 0:
            raise ModelError(
                f"body {name!r} of the URDF: the smallest eigenvalue of its pseudo-inertia is "
                f"{values[0]:.3g}, expected 0 or more. Correct it, or set inertials = 0 in [truth]"
            )
        root = axes * np.sqrt(np.maximum(values, 0.0)) @ axes.T
        S = np.zeros((4, 4))
        S[np.triu_indices(4, 1)] = rng.standard_normal(6)
        S = S + S.T + np.diag(np.sqrt(2.0) * rng.standard_normal(4))  # 1/2 tr(S^2): ten squares
        values, axes = np.linalg.eigh(size * S)
        factor = axes * np.exp(values) @ axes.T  # exp(size S)
        perturbed.append(inertial_from_pseudo_inertia(root @ factor @ root))
    return np.concatenate(perturbed)


def another_robot(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return parameters (p,) of a robot with other masses (10 to 30 %), a tool, and friction."""
    size = model.layout.n_inertial
    pi = model.standard_parameters()
    by_body = pi[:size].reshape(-1, 10)
    change = rng.uniform(0.1, 0.3, len(by_body)) * rng.choice([-1, 1], len(by_body))
    by_body *= 1 + change[:, None]
    tool = 1.2, np.array([0.0, 0.1, 0.0]), 1e-3 * np.eye(3)  # [kg], [m], [kg m^2]
    by_body[-1] += parameters_about(*tool)
    for i, (_, term) in enumerate(model.layout.drive_parameters, start=size):
        pi[i] = rng.uniform(*term.typical)
    return pi


def _check(model: RobotModel, pi: Array) -> None:
    """Refuse physically inconsistent parameters of bodies and drives."""
    layout = model.layout
    bodies = pseudo_inertia(pi[: layout.n_inertial])
    for name, J in zip(layout.bodies, bodies, strict=True):
        values = np.linalg.eigvalsh(J)
        if values[0] < -SLACK * max(values[-1], 0.0):
            raise SettingsError(
                f"truth: body {name!r}: the smallest eigenvalue of its pseudo-inertia is "
                f"{values[0]:.3g}, expected 0 or more. Set other values, or inertials = 0.1"
            )
    for i in np.flatnonzero(layout.is_nonnegative() & (pi < 0)):
        raise SettingsError(
            f"truth: {layout.names[i]} is {pi[i]:g} {layout.units[i]}, expected 0 or more"
        )
