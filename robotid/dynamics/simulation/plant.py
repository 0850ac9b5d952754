"""The simulated plant: forward dynamics by Pinocchio, with drive terms that no URDF has."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.base.typing import Array
from robotid.robot.drives import Bristles, Coulomb, DriveTerm, MemorylessTerm, Offset, Viscous
from robotid.robot.mass_matrix import drive_inertia, rigid_mass_matrices
from robotid.robot.model import RobotModel

_ITERATIONS = 200  # of the fixed point of load and load-dependent friction
_SETTLED = 1e-12  # relative change of the load at convergence
_SIMPLE = (Coulomb, Viscous, Offset)
_SIGN_SPEED = 2e-4  # speed over which the plant's Coulomb friction reverses [rad/s or m/s]


@dataclass(frozen=True)
class _Group:
    """Drives that have a common term."""

    term: Bristles | MemorylessTerm
    drives: Array | slice  # their k indices
    theta: Array  # its parameters, shape (k,)
    states: slice  # their bristle states; empty without any

    def torque(self, angle: Array, w: Array) -> Array:
        """Return the torque of the term, for positive direction and unit load, shape (k,)."""
        speed = w[self.drives]
        if isinstance(self.term, Bristles):
            return self.theta * self.term.level(speed)
        return self.theta * self.term.amplitude(angle[self.drives], speed)


@dataclass(frozen=True)
class Friction:
    """Friction torque of drives, ``(along + loaded |load|) sign(w) + rest``, all of shape (d,)."""

    along: Array
    rest: Array
    loaded: Array


class RobotPlant:
    """The plant M(q) a + b(q, v) + Ia a + Fv v + Fc sign(v) + off = u of a robot.

    The drives have the terms of the model. sign(v) is tanh(v / 0.2 mm/s), so that it can be
    integrated. Drives that couple several joints load all of them. Load-dependent friction uses the
    load of the same instant. The bristle deflection z of presliding is a state of the plant with
    the rate of ``bristle_rate``; if it is not given, sliding is steady. A delay of the torque
    (``Lag``) is one of the measurement, not of the plant.

    pi (p,).
    """

    def __init__(self, model: RobotModel, pi: Array) -> None:
        if model.free_flyer:
            raise DataError("the base floats; forward dynamics need a robot with a fixed base")
        model.require_fixed("simulation")
        if pi.shape != (len(model.layout.names),):
            raise DataError(f"pi has shape {pi.shape}, wanted ({len(model.layout.names)},)")
        self.model, self.pi = model, pi
        self._bodies = model.with_parameters(pi)
        self._data = self._bodies.pin_model.createData()
        self.armature = drive_inertia(model.layout, pi)  # (n, n)
        self.ratios = model.layout.drive_ratios  # (d, n)
        self._share = self.ratios / np.sum(self.ratios**2, axis=1, keepdims=True).clip(min=1e-300)
        self._simple, self._groups = _grouped(model, pi)
        self.n_states = sum(g.states.stop - g.states.start for g in self._groups)
        self.is_loaded = any(_is_loaded(g.term) for g in self._groups)
        G, A = model.velocity_map, self.armature
        # Pinocchio's own joints, each with its own rotor: its ABA is sufficient
        self._is_plain = np.array_equal(G, np.eye(len(G))) and np.array_equal(
            A, np.diag(A.diagonal())
        )
        self._is_angle = (
            model.pin_model.nq == model.pin_model.nv and not model.position_offset.any()
        )
        self._driven = pin.Model(self._bodies.pin_model)
        if self._is_plain:
            self._driven.armature = A.diagonal().copy()

    def mass_matrix(self, q: Array) -> Array:
        """Return D(q), the mass matrix with the drives' armature, shape (n, n).

        q (n,) [rad or m].
        """
        if self._is_plain:
            mass: Array = pin.crba(self._driven, self._data, self._configuration(q))
            return mass.copy()
        x = self.model.configurations(q[None])
        mass = rigid_mass_matrices(self._bodies, x, self._data)[0] + self.armature
        return mass

    def bias(self, q: Array, v: Array) -> Array:
        """Return C(q, v), Coriolis, centrifugal, gravity and friction torque, (n,) [N m or N].

        q (n,) [rad or m], v (n,) [rad/s or m/s].
        """
        rigid = self.bodies_torque(q, v, 0.0 * v)
        return rigid + self.friction_torque(self.friction(q, v), v, rigid)

    def bodies_torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return the inverse dynamics of the bodies alone, shape (n,) [N m or N].

        q (n,) [rad or m], v (n,) [rad/s or m/s], a (n,) [rad/s^2 or m/s^2].
        """
        G, x = self.model.velocity_map, self._configuration(q)
        rigid: Array = G.T @ pin.rnea(self._bodies.pin_model, self._data, x, G @ v, G @ a)
        return rigid

    def friction(self, q: Array, v: Array, z: Array | None = None) -> Friction:
        """Return the friction of the drives, without inertia and the sign of the speed.

        q (n,) [rad or m], v (n,) [rad/s or m/s], z (n_states,) [-].
        """
        angle, w = self.ratios @ q, self.ratios @ v
        coulomb, viscous, offset = self._simple
        along, rest, loaded = coulomb.copy(), viscous * w + offset, np.zeros(len(w))
        for group in self._groups:
            term = group.term
            if z is not None and isinstance(term, Bristles):
                rest[group.drives] += group.theta * z[group.states]
            elif _is_loaded(term):
                loaded[group.drives] += group.torque(angle, w)
            elif term.follows_direction:
                along[group.drives] += group.torque(angle, w)
            else:
                rest[group.drives] += group.torque(angle, w)
        return Friction(along, rest, loaded)

    def friction_torque(self, F: Friction, v: Array, load: Array) -> Array:
        """Return the friction torque of the drives, shape (n,) [N m or N].

        v (n,) [rad/s or m/s], load (n,) [N m or N].
        """
        along = F.along + F.loaded * np.abs(self._share @ load) if self.is_loaded else F.along
        torque: Array = self.ratios.T @ (along * np.tanh(self.ratios @ v / _SIGN_SPEED) + F.rest)
        return torque

    def chord(self, F: Friction, v: Array, load: Array) -> Array:
        """Return the friction with the sign of the speed, divided by the speed, shape (n, n).

        v (n,) [rad/s or m/s], load (n,) [N m or N].
        """
        along = F.along + F.loaded * np.abs(self._share @ load) if self.is_loaded else F.along
        x = np.maximum(np.abs(self.ratios @ v) / _SIGN_SPEED, 1e-6)  # tanh(x) / x is 1 at 0
        slope = np.maximum(along, 0.0) * np.tanh(x) / (x * _SIGN_SPEED)
        over: Array = (self.ratios.T * slope) @ self.ratios
        return over

    def bristle_rate(self, v: Array) -> tuple[Array, Array]:
        """Return r [1/s] and g sign(w) of the bristle deflection, dz/dt = r (g sign(w) - z).

        v (n,) [rad/s or m/s].
        """
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
        """Return the acceleration D(q)^-1 (u - C(q, v)) of a torque, shape as q.

        References:
            Tzvetkova, (11).

        q (n,) [rad or m].
        """
        if q.ndim == 2:
            return np.stack([self.acceleration(*one) for one in zip(q, v, u, strict=True)])
        F = self.friction(q, v) if F is None else F
        sign = np.tanh(self.ratios @ v / _SIGN_SPEED)
        free = u - self.ratios.T @ (F.along * sign + F.rest)
        a = self.free_acceleration(q, v, free)
        return self._loaded(q, free, a, F.loaded * sign) if self.is_loaded else a

    def free_acceleration(self, q: Array, v: Array, tau: Array, *, rotors: bool = True) -> Array:
        """Return the acceleration of bodies and rotors without friction, shape (n,).

        q (n,) [rad or m], v (n,) [rad/s or m/s], tau (n,) [N m or N].
        """
        x, G = self._configuration(q), self.model.velocity_map
        if self._is_plain:
            robot = self._driven if rotors else self._bodies.pin_model
            a: Array = pin.aba(robot, self._data, x, v, tau)
            return a.copy()
        D = rigid_mass_matrices(self._bodies, x[None], self._data)[0] + rotors * self.armature
        bias = G.T @ pin.nonLinearEffects(self._bodies.pin_model, self._data, x, G @ v)
        return np.linalg.solve(D, tau - bias)

    def _loaded(self, q: Array, free: Array, a: Array, coefficient: Array) -> Array:
        """Return the acceleration consistent with load-dependent friction, by iteration."""
        D = self.mass_matrix(q)
        per_load = np.linalg.solve(D, self.ratios.T * coefficient)  # acceleration per load, (n, d)
        bare = self._share @ (free - self.armature @ a)  # load of the drives without it
        slope = self._share @ (self.ratios.T * coefficient - self.armature @ per_load)
        load = bare
        if not np.isfinite(bare).all():  # the state has diverged
            return a
        for _ in range(_ITERATIONS):
            before, load = load, bare - slope @ np.abs(load)
            if np.abs(load - before).max() <= _SETTLED * (1.0 + np.abs(load).max()):
                settled: Array = a - per_load @ np.abs(load)
                return settled
        raise NotConvergedError(
            f"load-dependent friction does not converge in {_ITERATIONS} steps: its parameters are "
            "so large that the drives lock. Set smaller parameters",
            "max_iterations",
        )

    def _configuration(self, q: Array) -> Array:
        """Return Pinocchio's configuration, shape (nq,)."""
        if self._is_plain and self._is_angle:
            return q
        x: Array = self.model.configurations(q[None])[0]
        return x


def _grouped(model: RobotModel, pi: Array) -> tuple[Array, tuple[_Group, ...]]:
    """Return the friction terms of the drives, without inertia and terms of the measurement.

    First Coulomb friction, viscous friction and offset of each drive, shape (3, d), which depend
    only on the speed; then the others.
    """
    theta, simple = pi[model.layout.n_inertial :], np.zeros((3, len(model.layout.drives)))
    terms: dict[Bristles | MemorylessTerm, list[int]] = {}
    for k, (d, term) in enumerate(model.layout.drive_parameters):
        if type(term) in _SIMPLE:
            simple[_SIMPLE.index(type(term)), d] += theta[k]
        elif theta[k] != 0.0 and isinstance(term, Bristles | MemorylessTerm):
            terms.setdefault(term, []).append(k)
    groups, states = [], 0
    for term, numbers in terms.items():
        drives = [model.layout.drive_parameters[k][0] for k in numbers]
        is_all = drives == list(range(len(model.layout.drives)))
        more = len(numbers) if isinstance(term, Bristles) else 0
        groups.append(
            _Group(
                term,
                slice(None) if is_all else np.array(drives),
                theta[numbers],
                slice(states, states + more),
            )
        )
        states += more
    return simple, tuple(groups)


def _is_loaded(term: DriveTerm) -> bool:
    return isinstance(term, MemorylessTerm) and term.is_loaded


def rk4(
    acceleration: Callable[[Array, Array, float], Array],
    q: Array,
    v: Array,
    h: float | Array,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """Return positions and velocities one step later, by the Runge-Kutta method of order 4."""
    a1 = acceleration(q, v, 0.0) if a is None else a
    v2 = v + h / 2 * a1
    a2 = acceleration(q + h / 2 * v, v2, 0.5)
    v3 = v + h / 2 * a2
    a3 = acceleration(q + h / 2 * v2, v3, 0.5)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4, 1.0)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
