"""Optimal excitation trajectories within a robot's limits, by gradient-based optimisation.

The information about the base parameters of a motion q = Phi C is the sum of W^T W / sigma^2 over
its samples, in units of the prior deviations, plus 1, or plus the information of earlier runs. An
augmented Lagrangian enforces the limits: at each sample, (used share)^2 - 1 <= 0 of each limit, and
distances of at least the clearance.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.base.typing import Array
from robotid.design.clearance import SOFT, Clearance, Contact, Nearness
from robotid.design.information import MotionInformation, MotionRows, criterion
from robotid.design.limits import Course, MotionLimits, Postures
from robotid.design.previews import (
    CORRELATION,
    Run,
    assumed_noise,
    assumed_parameters,
    largest_gravity,
    largest_torques,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import Motion
from robotid.estimation.estimators.determination import base_spread
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

#: Share of limits reserved for the motion between the samples of a design.
SPARE = 0.003
_GROWTH = 3.0  # of the weight from one round to the next
_PER_PERIOD = 14  # samples of the grid within the shortest period of a basis
_POLISHED = 3  # times as many in the last rounds ...
_FINER = 15  # ... and in the final check of the limits
_ROUNDS = 14  # of the augmented Lagrangian
_STEPS = 20  # of L-BFGS in each
_WEIGHT = 3.0  # initial weight of the violations of all samples together
_LESS = 0.25  # share of a round's violation: the weight increases if the next violation exceeds it
# change of the criterion below which the finer grid is used, and largest excess of a limit before a
# converged design is scaled
_NEARLY = 1e-2
_SETTLED = 2e-3  # change of the criterion below which a design has converged
_LOSS = 0.02  # largest increase of the criterion when a motion is scaled to satisfy its limits
_TRIALS = 10  # shares of a motion tried for the largest that satisfies the limits ...
_SHARE = 1e-3  # ... to this accuracy, or as near to a limit
_TYPICAL = 0.3  # of the largest torque, speed and acceleration: about the RMS of a motion
_WIDEST = 0.25  # share of the base parameters in the criterion "widest"
_STARTED = 10  # random motions of which the best is a start


@dataclass(frozen=True)
class FourierBasis:
    """Sines and cosines of the first harmonics of 1 / duration, at rest at both ends.

    The first function is constant 1. Two of the 2 h coefficients of a joint are fixed by the ends:
    sum k s_k = 0 makes its velocity 0 there, and sum k^2 c_k = 0 its acceleration.

    References:
        Swevers et al. (1997), Optimal robot excitation and identification.
    """

    duration: float  # [s]
    harmonics: int = 5

    def __post_init__(self) -> None:
        if self.harmonics < 2:
            raise SettingsError(
                f"harmonics is {self.harmonics}, wanted 2 or more: one cannot start at rest"
            )

    @property
    def size(self) -> int:
        """Number of functions."""
        return 2 * self.harmonics - 1

    @property
    def shortest(self) -> float:
        """Shortest period [s]."""
        return self.duration / self.harmonics

    @cached_property
    def _free(self) -> Array:
        """The sums of sines and cosines that are at rest at the ends, shape (2 h, 2 h - 2)."""
        k, none = np.arange(1.0, self.harmonics + 1), np.zeros(self.harmonics)
        return np.asarray(scipy.linalg.null_space([np.r_[k, none], np.r_[none, k**2]]))

    def derivatives(self, t: Array, order: int) -> Array:
        """Return the functions and their derivatives, shape (order + 1, N, size): t (N,) [s]."""
        w = 2 * np.pi / self.duration * np.arange(1, self.harmonics + 1)
        turn = np.exp(1j * np.outer(t, w))
        out = np.empty((order + 1, len(t), self.size))
        for d in range(order + 1):
            waves = turn * (1j * w) ** d
            out[d, :, 0] = float(d == 0)
            out[d, :, 1:] = np.hstack([waves.imag, waves.real]) @ self._free
        return out


@dataclass(frozen=True, eq=False)
class DesignedMotion(Motion):
    """A motion q(t) = Phi(t) C."""

    basis: FourierBasis  # the functions Phi of time
    coefficients: Array  # C, shape (size, n) [rad or m]

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        q, v, a = self.basis.derivatives(t, 2) @ self.coefficients
        return q, v, a


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Multipliers of the limits at each sample, and of distances."""

    weight: float  # weight of the violations
    limits: Array | float = 0.0  # shape (6, N, n); 0 at first
    distances: Array | float = 0.0  # shape (pairs, N)

    def finer(self, times: int) -> "Multipliers":
        """Return the same on a finer grid."""
        limits, distances = _between(self.limits, times), _between(self.distances, times)
        return Multipliers(self.weight / times, limits, distances)

    def raised(self, used: Array, distance: Array | None, aim: Array) -> "Multipliers":
        """Return the slopes as the new multipliers."""
        distances = 0.0 if distance is None else self.of_distances(distance, aim)[1]
        return replace(self, limits=self.of_limits(used)[1], distances=distances)

    def of_limits(self, used: Array) -> tuple[float, Array]:
        """Return the cost of limits and its derivative by their violations, shape (6, N, n)."""
        return self._cost(used**2 / (1.0 - SPARE) ** 2 - 1.0, self.limits)

    def of_distances(self, distance: Array, aim: Array) -> tuple[float, Array]:
        """Return the cost of distances and its derivative by their deficits, shape (pairs, N)."""
        return self._cost((aim - distance) / SOFT, self.distances)

    def distance_without_cost(self, aim: Array) -> Array:
        """Return the distances from which there is no cost: aim (pairs, 1) [m]."""
        return aim + SOFT / self.weight * self.distances

    def _cost(self, over: Array, multipliers: Array | float) -> tuple[float, Array]:
        pushed = np.maximum(0.0, multipliers + self.weight * over)
        cost = float(np.sum(pushed**2 - np.square(multipliers))) / (2 * self.weight)
        return cost, pushed


def _between(values: Array | float, times: int) -> Array | float:
    """Return multipliers of samples, axis 1, interpolated on as many times the intervals."""
    if isinstance(values, float):
        return values
    share = np.arange(times).reshape(-1, *[1] * (values.ndim - 2)) / times
    steps = np.diff(values, axis=1)[:, :, None]
    shape = len(values), times * (values.shape[1] - 1), *values.shape[2:]  # maybe of no pair
    between = (values[:, :-1, None] + share * steps).reshape(shape)
    return np.concatenate([between, values[:, -1:]], axis=1) / times


@dataclass(frozen=True, eq=False)
class Design:
    """A motion, its criterion and its use of the limits."""

    motion: Motion
    duration: float  # its length [s]
    intervals: int  # number of equal intervals between the samples at which its limits were checked
    objective: float  # its criterion, the smaller the better
    condition: float  # of the base problem, columns in units of the prior deviations
    used: Array  # (6, n), largest used share of each joint's limit; 0 where there is none
    contact: Contact | None = None  # where the smallest distance is; None if no pair comes near
    seconds: float = 0.0  # computing time [s]
    starts: int = 0  # number of completed starts
    is_converged: bool = False  # whether the best of them has converged


@dataclass(frozen=True, eq=False)
class State:
    """The state of a search."""

    feasible: Array  # coefficients of the best motion that satisfies the limits, shape (h, n)
    objective: float  # its criterion
    iterate: Array  # coefficients at which the search continues; they may violate limits
    multipliers: Multipliers  # those of the limits
    is_settled: bool = False  # whether the search has converged


@dataclass(frozen=True, eq=False)
class Designer:
    """Optimises a motion for the information about the parameters."""

    information: MotionInformation  # the rows of the base problem, and their gradient
    limits: MotionLimits  # the robot's limits
    basis: FourierBasis  # basis functions of the motion
    noise: Array  # (n,), density: variance times its correlation time [(N m)^2 s or N^2 s]
    spread: Array  # prior deviations of the base parameters, shape (b,)
    given: Array | None = None  # prior information, shape (b, b), in units of the spread; 1 if None
    name: str = "D"  # the criterion, as of ``criterion``
    clearance: Clearance | None = None  # the distances to collisions; None: they are not checked
    finer: int = 1  # number of samples of the grid relative to a coarse one

    @classmethod
    def of_model(
        cls,
        model: RobotModel,
        basis: FourierBasis,
        limits: MotionLimits,
        *,
        name: str = "D",
        clearance: Clearance | None = None,
        noise: Mapping[str, float] | None = None,
        run: Run | None = None,
    ) -> "Designer":
        """Return a designer with the assumptions of a preview on friction and noise."""
        mapping = structural_mapping(model)
        size, speed = largest_torques(model, largest_gravity(model)), limits.sizes[1]
        pi = assumed_parameters(model, size, speed) if run is None else run.standard
        found = None if run is None else run.noise(mapping.K)
        density = assumed_noise(model, size, noise or {}, CORRELATION, found).density(0.0)
        typical = _TYPICAL * np.array([size, speed, speed * 2 * np.pi / basis.shortest])
        spread = base_spread(mapping.K, prior_spread(model, typical**2, 1))
        given = None
        if run is not None:
            earlier = run.factors.information(run.step / density)
            given = np.eye(len(spread)) + spread[:, None] * earlier * spread
        information = MotionInformation(model, mapping, mapping.to_base(pi))
        return cls(information, limits, basis, density, spread, given, name, clearance)

    @cached_property
    def _functions(self) -> Array:
        """The basis functions and three derivatives on the grid, shape (4, N, h)."""
        count = self.finer * round(_PER_PERIOD * self.basis.duration / self.basis.shortest)
        return self.basis.derivatives(np.linspace(0.0, self.basis.duration, count + 1), 3)

    def design(
        self,
        rng: np.random.Generator,
        *,
        starts: int = 3,
        seconds: float = np.inf,
        progress: Callable[[int, float], None] | None = None,
    ) -> Design:
        """Return the best motion, checked on a grid 15 times as fine as the first one."""
        began, best = time.monotonic(), np.inf
        followed: list[State] = []

        def is_over() -> bool:
            return best < np.inf and time.monotonic() - began > seconds

        def follow(designer: Designer, state: State, settled: float) -> State:
            nonlocal best
            for state in designer._search(state, settled, is_over):  # noqa: B020
                best = min(best, state.objective)
                if progress is not None:
                    progress(len(followed), best)
            return state

        while len(followed) < starts and not is_over():
            random = [self.random(rng) for _ in range(_STARTED)]
            objective, k = min((self._objective(C), k) for k, C in enumerate(random))
            multipliers = Multipliers(_WEIGHT / self._functions.shape[1])
            initial = State(random[k], objective, random[k], multipliers)
            followed.append(follow(self, initial, _NEARLY))
        chosen = min(followed, key=lambda state: state.objective)
        fine, best = replace(self, finer=_POLISHED * self.finer), np.inf
        feasible = fine._feasible(chosen.feasible, 1.0 - SPARE)
        multipliers = chosen.multipliers.finer(_POLISHED)
        initial = State(feasible, fine._objective(feasible), chosen.iterate, multipliers)
        polished = follow(fine, initial, _SETTLED)
        return replace(
            replace(self, finer=_FINER * self.finer).checked(polished.feasible),
            seconds=time.monotonic() - began,
            starts=len(followed),
            is_converged=polished.is_settled,
        )

    def checked(self, C: Array) -> Design:
        """Return a motion, scaled down until it satisfies all limits, also between the samples."""
        C, contact = self._clear(self._feasible(C, 1.0))
        used, _, rows = self._constraints(C)
        information = self.matrix(rows)
        motion = DesignedMotion(self.basis, C)
        return self._assessed(motion, self.basis.duration, information, used, contact)

    def examined(self, motion: Motion, duration: float, rate: float) -> Design:
        """Return the criterion of any motion, and its use of the limits other than jerk."""
        used, information = self.used_and_informed(motion, duration, rate)
        contact = None
        if self.clearance is not None:
            contact = self.clearance.nearest(motion, duration)
        return self._assessed(motion, duration, information, used, contact)

    def course(self, design: Design) -> Course:
        """Return the course of a design where its limits were checked, with its assumed torque."""
        t = np.linspace(0.0, design.duration, design.intervals + 1)
        q, v, a = design.motion.evaluate(t)
        torque = self.information.torque(self.information.rows(q, v, a))
        return Course.of_motion(t, (q, v, a, torque), self.limits, self.clearance)

    def used_and_informed(
        self, motion: Motion, duration: float, rate: float
    ) -> tuple[Array, Array]:
        """Return a motion's use of limits but jerk, (6, N, n), and its information, (b, b)."""
        count = round(duration * rate)
        q, v, a = motion.evaluate(np.linspace(0.0, duration, count + 1))
        rows = self.information.rows(q, v, a)
        used = self.limits.used(q, v, a, 0.0 * a, self.information.torque(rows))
        return used, self._informed(rows, duration / count)

    def _assessed(
        self,
        motion: Motion,
        duration: float,
        information: Array,
        used: Array,
        contact: Contact | None,
    ) -> Design:
        own = information - self.known
        low, *_, high = np.linalg.eigvalsh(own)
        return Design(
            motion=motion,
            duration=duration,
            intervals=used.shape[1] - 1,
            objective=self.judged(information)[0],
            condition=float(np.sqrt(high / low)) if low > 0 else np.inf,
            used=np.abs(used).max(axis=1),
            contact=contact,
        )

    def _clear(self, C: Array) -> tuple[Array, Contact | None]:
        """Return a motion scaled down until it is clear between samples too, and its contact."""
        if self.clearance is None:
            return C, None
        for k in range(_TRIALS):
            contact = self.clearance.nearest(DesignedMotion(self.basis, C), self.basis.duration)
            if contact is None or contact.margin >= 0.0:
                return C, contact
            C = _scaled(C, max(1.0 - 0.01 * 2.0**k, 0.5))
        raise NotConvergedError(
            f"between the samples of the design {contact}, margin "
            f"{1e3 * (contact.margin if contact else 0.0):.2g} mm, wanted 0 or more; raise the "
            "clearance or try another seed",
            "max_iterations",
        )

    @property
    def known(self) -> Array:
        """Prior information, in units of the spread, shape (b, b)."""
        return np.eye(len(self.spread)) if self.given is None else self.given

    @cached_property
    def widest(self) -> Array:
        """The quarter of the base parameters with the largest prior variance, shape (k,)."""
        variance = np.diag(np.linalg.inv(self.known))
        return np.argsort(variance, kind="stable")[-max(1, round(_WIDEST * len(variance))) :]

    def judged(self, F: Array) -> tuple[float, Array]:
        """Return the criterion of information about the base parameters, and its gradient."""
        return criterion(self.name, F, self.widest)

    def _scale(self, step: float) -> Array:
        """Return the factor of rows with which their squares are information, (n, b, 1)."""
        return np.asarray(np.sqrt(step / self.noise)[:, None, None] * self.spread[:, None])

    @cached_property
    def _step(self) -> float:
        """Time between two samples of the grid [s]."""
        return self.basis.duration / float(self._functions.shape[1] - 1)

    def matrix(self, rows: MotionRows) -> Array:
        """Return the information of a motion plus the prior's, in units of the spread, (b, b)."""
        return self._informed(rows, self._step)

    def _informed(self, rows: MotionRows, step: float) -> Array:
        n, b, N = rows.W.shape
        scaled = rows.W * self._scale(step)
        flat = scaled.swapaxes(0, 1).reshape(b, n * N)
        return np.asarray(flat @ flat.T + self.known)

    def _followed(self, C: Array) -> tuple[MotionRows, Array, Array]:
        """Return rows, torques (N, n) and used shares of limits (6, N, n) of a motion."""
        *state, jerk = self._functions @ C
        rows = self.information.rows(*state)
        q, v, a = rows.motion
        torque = self.information.torque(rows)
        return rows, torque, self.limits.used(q, v, a, jerk, torque)

    def _constraints(self, C: Array, spare: float = 0.0) -> tuple[Array, float, MotionRows]:
        """Return used shares of limits (6, N, n), the smallest margin of distances and rows."""
        rows, _, used = self._followed(C)
        if self.clearance is None:
            return used, np.inf, rows
        placed = self.clearance.placed(rows.motion[0])
        return used, float(self.clearance.margins(placed, spare).min(initial=np.inf)), rows

    def _near(self, rows: MotionRows, multipliers: Multipliers) -> Nearness | None:
        """Return the distances of near pairs; None if they are not checked."""
        if self.clearance is None:
            return None
        within = multipliers.distance_without_cost(self._required)
        placed = self.clearance.placed(rows.motion[0])
        return self.clearance.near(placed, within)

    def _objective(self, C: Array) -> float:
        """Return the criterion of a motion."""
        *state, _ = self._functions @ C
        return self.judged(self.matrix(self.information.rows(*state)))[0]

    def _lagrangian(self, C: Array, multipliers: Multipliers) -> tuple[float, Array]:
        """Return augmented Lagrangian and its gradient, (h, n); Nocedal, Wright (2006), 17.4."""
        D, (rows, torque, used) = self._functions, self._followed(C)
        value, by_F = self.judged(self.matrix(rows))
        cost, pushed = multipliers.of_limits(used)
        value += cost
        by_value = pushed * 2.0 * used / (1.0 - SPARE) ** 2 / self.limits.sizes[:, None]
        by_q, by_v, by_a, by_jerk, by_torque, by_power = by_value
        by_v = by_v + by_power * torque
        by_torque = by_torque + by_power * rows.motion[1]
        near = self._near(rows, multipliers)
        if near is not None:
            too_near, pushed = multipliers.of_distances(near.distance, self._required)
            value += too_near
            along = -pushed[near.pairs, near.samples, None] / SOFT * near.gradient
            np.add.at(by_q, near.samples, along)
        scale = self._scale(self._step)
        by_W = 2.0 * scale * (by_F @ (scale * rows.W))
        entries = by_W + self.information.beta[:, None] * by_torque.T[:, None]
        by_rows = self.information.pull(rows, entries)
        by_state = (*(x + y for x, y in zip(by_rows, (by_q, by_v, by_a), strict=True)), by_jerk)
        gradient: Array = sum(functions.T @ g for functions, g in zip(D, by_state, strict=True))
        return value, gradient

    @property
    def _required(self) -> Array:
        """Distances that the search requires, shape (pairs, 1) [m]."""
        if self.clearance is None:
            return np.zeros((0, 1))
        return self.clearance.required[:, None] + 2.0 * self.clearance.spare

    @cached_property
    def postures(self) -> Postures:
        """The postures that the robot can hold."""
        return Postures(self.information, self.limits, self.clearance)

    def random(self, rng: np.random.Generator) -> Array:
        """Return the coefficients of a random motion that satisfies the limits, shape (h, n)."""
        unit = self.limits.sizes[0]
        C = rng.standard_normal((self.basis.size, len(unit))) * unit
        C[0] = self.postures.one(rng)
        return self._feasible(C, 1.0 - SPARE)

    def _feasible(self, C: Array, most: float) -> Array:
        """Return the largest feasible share of a motion, (h, n): each joint, then all alike."""
        limits = self.limits
        free = most * limits.sizes[0] - np.abs(C[0] - limits.middle)
        moving = np.abs(self._functions[:, :, 1:] @ C[1:]).max(axis=1)  # (4, n)
        bounds = np.vstack([np.maximum(free, 1e-9), most * limits.sizes[1:4]])
        C = _scaled(C, 1.0 / np.maximum(1.0, (moving / bounds).max(axis=0)))
        return self._towards(_scaled(C, 0.0), C, most)

    def _towards(self, feasible: Array, C: Array, most: float) -> Array:
        """Return the farthest feasible motion on the line to another motion, shape (h, n)."""
        way, low, high, share = C - feasible, 0.0, 1.0, 1.0
        under, over = -1.0, np.inf  # violations of the limits at both
        for _ in range(_TRIALS):
            used, margin, _ = self._constraints(feasible + share * way, 1.0)
            violation = max(float(np.abs(used).max()) / most - 1.0, -margin / SOFT)
            if violation <= 0.0:
                low, under, over = share, violation, over / 2
            else:
                high, over, under = share, violation, under / 2
            if low == 1.0 or high - low < _SHARE or (low > 0.0 and under > -_SHARE):
                break
            share = low + (high - low) * np.clip(under / (under - over), 0.02, 0.98)
        return feasible + low * way

    def _search(self, state: State, settled: float, is_over: Callable[[], bool]) -> Iterator[State]:
        """Yield the state of a search, at first and after each round, until it has converged."""
        from scipy.optimize import minimize

        unit = self.limits.sizes[0]
        before = np.inf  # violation of the limits

        def scaled(x: Array) -> tuple[float, Array]:
            if is_over():
                raise _OutOfTime
            value, gradient = self._lagrangian(x.reshape(-1, len(unit)) * unit, state.multipliers)
            return value, (gradient * unit).reshape(-1)

        yield state
        for _ in range(_ROUNDS):
            try:
                found = minimize(
                    scaled,
                    (state.iterate / unit).reshape(-1),
                    jac=True,
                    method="L-BFGS-B",
                    options={"maxiter": _STEPS, "maxcor": 20},
                )
            except _OutOfTime:
                return
            state, violation = self._updated(state, found.x.reshape(-1, len(unit)) * unit, settled)
            if violation > _LESS * before:
                heavier = _GROWTH * state.multipliers.weight
                state = replace(state, multipliers=replace(state.multipliers, weight=heavier))
            before = violation
            yield state
            if state.is_settled:
                return

    def _updated(self, state: State, C: Array, settled: float) -> tuple[State, float]:
        """Return the state of a search after a round, and the violation of the limits."""
        used, margin, rows = self._constraints(C)
        near = self._near(rows, state.multipliers)
        feasible = self._feasible(C, 1.0 - SPARE)
        objective = self._objective(feasible)
        if objective > state.objective - settled:
            mixed = self._towards(state.feasible, C, 1.0 - SPARE)
            objective, feasible = min(
                [(objective, feasible), (self._objective(mixed), mixed)], key=lambda pair: pair[0]
            )
        gain = state.objective - objective
        outside = self.judged(self.matrix(rows))[0]
        is_near = (
            np.abs(used).max() < 1.0 + _NEARLY and margin >= 0.0 and objective - outside < _LOSS
        )
        is_stalled = not is_near and gain < _LOSS  # restart from the feasible motion
        if gain < 0.0:
            feasible, objective = state.feasible, state.objective
        violation = max(float(np.abs(used).max()) - 1.0 + SPARE, -margin / SOFT, 0.0)
        distance = None if near is None else near.distance
        multipliers = state.multipliers.raised(used, distance, self._required)
        iterate = feasible if is_stalled else C
        is_settled = bool(is_near and gain < settled)
        return State(feasible, objective, iterate, multipliers, is_settled), violation


class _OutOfTime(Exception):
    """The limit of the computing time is reached."""


def _scaled(C: Array, share: float | Array) -> Array:
    """Return a motion with its deviation from the middle scaled, shape (h, n)."""
    return np.vstack([C[:1], C[1:] * share])
