"""Optimal excitation trajectories within a robot's limits, and motions from posture to posture.

The information about the base parameters of a motion q = Phi C is the sum of W^T W / sigma^2 over
its samples, in units of the prior deviations, plus 1, or plus the information of earlier runs. An
augmented Lagrangian enforces the limits: at each sample, (used share)^2 - 1 <= 0 of each limit, and
distances of at least the clearance.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.base.typing import Array
from robotid.design.clearance import POSES, SOFT, Clearance, Contact, Nearness
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

_RAMP = 0.25  # [s] until a sweep has its speed
_SPEEDS = (0.03, 0.1, 0.3, 0.8)  # of sweeps, as shares of the joint's largest speed
_STROKE = 3.0  # [s] largest duration of a sweep ...
_RANGE = 0.8  # ... and largest share of the joint's free range
_HOLD = 2.0  # [s] at each static posture
_BRISK = 0.5  # share of the largest speed between static postures
_SWEPT = 20  # random postures at which sweeps are tried
_PLACES = 41  # positions of a joint's range at which its free range is checked
_TRIES = 8  # sweeps, each shorter by a fifth than the one before
_RATE = 100.0  # [Hz] of the samples at which limits are checked


@dataclass(frozen=True)
class FourierBasis:
    """Sines and cosines of the first harmonics of 1 / duration (Swevers 1997), at rest at the ends.

    The first function is constant 1. Two of the 2 h coefficients of a joint are fixed by the ends:
    sum k s_k = 0 makes its velocity 0 there, and sum k^2 c_k = 0 its acceleration.
    """

    duration: float  # [s]
    harmonics: int = 5

    def __post_init__(self) -> None:
        if self.harmonics < 2:
            raise SettingsError(
                f"harmonics is {self.harmonics}, expected 2 or more: one cannot start at rest"
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
    known: Array  # prior information, shape (b, b), in units of the spread
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
        known = np.eye(len(spread))
        if run is not None:
            earlier = run.factors.information(run.step / density)
            known += spread[:, None] * earlier * spread
        information = MotionInformation(model, mapping, mapping.to_base(pi))
        return cls(information, limits, basis, density, spread, known, name, clearance)

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
        designs: list[Design] = []
        fine, finest = (replace(self, finer=k * self.finer) for k in (_POLISHED, _FINER))

        def is_over() -> bool:
            return best < np.inf and time.monotonic() - began > seconds

        def follow(designer: Designer, state: State, settled: float) -> State:
            nonlocal best
            for state in designer._search(state, settled, is_over):  # noqa: B020
                best = min(best, state.objective)
                if progress is not None:
                    progress(len(followed), best)
            return state

        def polished(state: State) -> Design:
            feasible = fine._feasible(state.feasible, 1.0 - SPARE)
            multipliers = state.multipliers.finer(_POLISHED)
            initial = State(feasible, fine._objective(feasible), state.iterate, multipliers)
            state = follow(fine, initial, _SETTLED)
            return replace(finest.checked(state.feasible), is_converged=state.is_settled)

        while len(followed) < starts and not is_over():
            random = [self.random(rng) for _ in range(_STARTED)]
            objective, k = min((self._objective(C), k) for k, C in enumerate(random))
            multipliers = Multipliers(_WEIGHT / self._functions.shape[1])
            followed.append(
                follow(self, State(random[k], objective, random[k], multipliers), _NEARLY)
            )
            before = min((state.objective for state in followed[:-1]), default=np.inf)
            is_better = followed[-1].objective < before - _NEARLY
            # with limited time each better start is polished: more time gives no worse motion
            if seconds < np.inf and is_better and not (designs and is_over()):
                designs.append(polished(followed[-1]))
        if not designs:
            designs.append(polished(min(followed, key=lambda state: state.objective)))
        chosen = min(designs, key=lambda design: design.objective)
        return replace(chosen, seconds=time.monotonic() - began, starts=len(followed))

    def checked(self, C: Array) -> Design:
        """Return a motion, scaled down until it satisfies all limits, also between the samples."""
        C, contact = self._clear(self._feasible(C, 1.0))
        used, _, rows = self._constraints(C)
        information = self.matrix(rows)
        motion = DesignedMotion(self.basis, C)
        return self._assessed(motion, self.basis.duration, information, used, contact)

    def examined(self, motion: Motion, duration: float, rate: float) -> Design:
        """Return the criterion of any motion, and its use of the limits other than jerk."""
        count = round(duration * rate)
        q, v, a = motion.evaluate(np.linspace(0.0, duration, count + 1))
        rows = self.information.rows(q, v, a)
        used = self.limits.used(q, v, a, 0.0 * a, self.information.torque(rows))
        around = self.clearance
        contact = None if around is None else around.nearest(motion, duration)
        return self._assessed(motion, duration, self.matrix(rows, duration / count), used, contact)

    def course(self, design: Design) -> Course:
        """Return the course of a design where its limits were checked, with its assumed torque."""
        t = np.linspace(0.0, design.duration, design.intervals + 1)
        q, v, a = design.motion.evaluate(t)
        torque = self.information.torque(self.information.rows(q, v, a))
        return Course.of_motion(t, (q, v, a, torque), self.limits, self.clearance)

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
            motion=motion, duration=duration, intervals=used.shape[1] - 1,
            objective=self.judged(information)[0],
            condition=float(np.sqrt(high / low)) if low > 0 else np.inf,
            used=np.abs(used).max(axis=1), contact=contact,
        )  # fmt: skip

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
            f"{1e3 * (contact.margin if contact else 0.0):.2g} mm, expected 0 or more; raise the "
            "clearance or try another seed",
            "max_iterations",
        )

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

    def matrix(self, rows: MotionRows, step: float | None = None) -> Array:
        """Return the information of a motion plus the prior's, in units of the spread, (b, b)."""
        n, b, N = rows.W.shape
        scaled = rows.W * self._scale(step or self._step)
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
        return self.clearance.near(self.clearance.placed(rows.motion[0]), within)

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
                    scaled, (state.iterate / unit).reshape(-1), jac=True, method="L-BFGS-B",
                    options={"maxiter": _STEPS, "maxcor": 20},
                )  # fmt: skip
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


@dataclass(frozen=True, eq=False)
class Route(Motion):
    """A motion through postures, on straight lines in joint space, at rest at each posture.

    On a line the speed rises smoothly, is constant and falls: the path parameter s of duration 1
    has the speed V (10 x^3 - 15 x^4 + 6 x^5) with x = u / r while u < r, then V = 1 / (1 - r), and
    falls symmetrically.
    """

    places: Array  # the postures, shape (K, n) [rad or m]
    times: Array  # duration of each line, shape (K - 1,) [s]
    ramps: Array  # share r of it in which the speed rises, shape (K - 1,), at most 0.5
    holds: Array  # time at rest at each posture, shape (K,) [s]

    @cached_property
    def _starts(self) -> Array:
        """Start of each line, and end of the last one, shape (K,) [s]."""
        return np.cumsum(np.r_[self.holds[0], self.times[:-1] + self.holds[1:-1], self.times[-1]])

    @property
    def duration(self) -> float:
        """Its length [s]."""
        return float(self.holds.sum() + self.times.sum())

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        k = np.clip(np.searchsorted(self._starts, t, side="right") - 1, 0, len(self.times) - 1)
        T, r = self.times[k], self.ramps[k]
        u = np.clip((t - self._starts[k]) / T, 0.0, 1.0)
        V = 1.0 / (1.0 - r)
        mirrored = np.minimum(u, 1.0 - u)
        x = np.minimum(mirrored / r, 1.0)
        s = V * (r * (2.5 * x**4 - 3.0 * x**5 + x**6) + np.maximum(mirrored - r, 0.0))
        s = np.where(u <= 0.5, s, 1.0 - s)
        speed = V * (10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5)
        steep = np.where(mirrored < r, V / r * 30.0 * (x - x**2) ** 2, 0.0)
        steep = np.where(u <= 0.5, steep, -steep)
        way = self.places[k + 1] - self.places[k]
        return (
            self.places[k] + s[:, None] * way,
            (speed / T)[:, None] * way,
            (steep / T**2)[:, None] * way,
        )


def design_sweeps(
    designer: Designer, rng: np.random.Generator, speeds: Sequence[float] = _SPEEDS
) -> Design:
    """Return a motion in which each joint sweeps through one posture to and fro at each speed."""
    postures = designer.postures.resting(rng, POSES)[:_SWEPT]
    ranges = [_free_range(designer, posture) for posture in postures]  # (n, 2) each
    best = int(np.argmax([(free.sum(axis=1) / designer.limits.sizes[0]).min() for free in ranges]))
    share = _RANGE
    for _ in range(_TRIES):
        route = _sweeps(designer, postures[best], share * ranges[best], speeds)
        design = designer.examined(route, route.duration, _RATE)
        if _is_feasible(design):
            return design
        share *= 0.8
    raise SettingsError(
        f"about none of {len(postures)} random postures every joint can sweep: "
        f"{_why(design, designer)}; lower the share or the clearance"
    )


def _free_range(designer: Designer, posture: Array) -> Array:
    """Return each joint's free range below and above a posture, shape (n, 2) [rad or m]."""
    limits, n = designer.limits, len(posture)
    low, high = limits.middle - limits.sizes[0], limits.middle + limits.sizes[0]
    ways = np.linspace(low, high, _PLACES).T  # (n, places)
    q = np.repeat(posture[None], n * _PLACES, axis=0).reshape(n, _PLACES, n)
    q[np.arange(n), :, np.arange(n)] = ways
    are_free = designer.postures.can_rest(q.reshape(-1, n)).reshape(n, _PLACES)
    free = np.zeros((n, 2))
    for j, (way, is_free) in enumerate(zip(ways, are_free, strict=True)):
        blocked = way[~is_free]
        below, above = blocked[blocked < posture[j]], blocked[blocked > posture[j]]
        free[j, 0] = posture[j] - below.max(initial=low[j])
        free[j, 1] = above.min(initial=high[j]) - posture[j]
    return free


def _sweeps(designer: Designer, posture: Array, free: Array, speeds: Sequence[float]) -> Route:
    places, times, ramps = [posture], [], []
    for j, fastest in enumerate(designer.limits.sizes[1]):
        for share in speeds:
            speed = share * fastest
            down, up = np.minimum(free[j], speed * _STROKE / 2)
            for to in (up, -down, 0.0):
                place = posture.copy()
                place[j] += to
                cruise = abs(place[j] - places[-1][j]) / speed
                places.append(place)
                times.append(cruise + _RAMP)
                ramps.append(min(_RAMP / (cruise + _RAMP), 0.5))
    holds = np.full(len(places), _RAMP)
    return Route(np.array(places), np.array(times), np.array(ramps), holds)


def design_stands(designer: Designer, rng: np.random.Generator, count: int = 20) -> Design:
    """Return a motion that rests at postures whose gravity torques give the most information."""
    # one by one, each adds the most to log det (Fedorov 1972, Theory of Optimal Experiments)
    q = designer.postures.resting(rng, POSES)
    still = np.zeros_like(q)
    rows = designer.information.rows(q, still, still)
    scale = np.sqrt(_HOLD / designer.noise)[:, None] * designer.spread
    A = np.einsum("rb,rbk->krb", scale, rows.W)  # rows of each posture in units of the spread
    known, left = designer.known.copy(), list(range(len(q)))
    chosen: list[int] = []
    while left and len(chosen) < count:
        inside = np.linalg.solve(known, A[left].swapaxes(1, 2))
        gain = np.linalg.slogdet(np.eye(A.shape[1]) + A[left] @ inside)[1]
        best = left[int(np.argmax(gain))]
        known += A[best].T @ A[best]
        left.remove(best)
        chosen.append(best)
    order = [chosen.pop(0)]
    while chosen:
        near = min(chosen, key=lambda k: float(np.abs(q[k] - q[order[-1]]).max()))
        chosen.remove(near)
        order.append(near)
    return _visited(designer, q[order])


def _visited(designer: Designer, places: Array) -> Design:
    """Return the motion through postures, except those on whose line a limit is violated."""
    visited = [places[0]]
    for place in places[1:]:
        leg = _legs(designer, np.array([visited[-1], place]))
        if _is_feasible(designer.examined(leg, leg.duration, _RATE)):
            visited.append(place)
    if len(visited) < 2:
        raise SettingsError(
            "every line between two postures has a collision or exceeds a limit; lower the share "
            "or the clearance"
        )
    route = _legs(designer, np.array(visited))
    return designer.examined(route, route.duration, _RATE)


def _legs(designer: Designer, places: Array) -> Route:
    """Return the motion through postures, at rest for 2 s at each."""
    speed = _BRISK * designer.limits.sizes[1]
    times = 2.0 * np.abs(np.diff(places, axis=0) / speed).max(axis=1)
    times = np.maximum(times, 1.0)
    return Route(places, times, np.full(len(times), 0.5), np.full(len(places), _HOLD))


def _is_feasible(design: Design) -> bool:
    is_clear = design.contact is None or design.contact.margin >= 0.0
    return bool(design.used.max() <= 1.0 and is_clear)


def _why(design: Design, designer: Designer) -> str:
    if design.contact is not None:
        return str(design.contact)
    _, joint = np.unravel_index(int(np.argmax(design.used)), design.used.shape)
    return f"{designer.information.model.joints[joint]} needs {100 * design.used.max():.0f} %"
