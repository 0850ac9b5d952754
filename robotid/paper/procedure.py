"""The closed-loop procedure: a robot follows a program while its parameters are identified.

One iteration is one run of the program motion. At each of its updates the control (21) is computed
from the estimate, the plant moves, and the estimate is updated by the deviation (24). R runs are
computed together, one row each.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper.equations import (
    Bounds,
    LinearDynamics,
    Plant,
    Sign,
    mass_matrix,
    one_shot,
    proximity,
    recursive_update,
    reference_acceleration,
    rk4,
    smallest_eigenvalue,
)

_DIVERGED = 1e3  # [rad or m; per s] deviation from the program beyond which a run is stopped


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the procedure; alpha, beta and eps2 may differ from run to run, shape (R,)."""

    alpha: float | Array = 20.0  # gain of the velocity in (15) [1/s]
    beta: float | Array = 100.0  # gain of the position in (15) [1/s^2]
    iterations: int = 100  # largest number of runs of the motion
    updates: int = 100  # updates per run; the torque is constant between them (zero-order hold)
    substeps: int = 1  # Runge-Kutta steps per update; stiff friction needs several
    # ``"recursive"``, (24) at each update, or ``"one_shot"``, (18) after each run
    method: Literal["recursive", "one_shot"] = "recursive"
    sign: Sign = "corrected"  # sign in (23); with the printed one the procedure never stops
    # acceleration of the regressor in (23): ``"measured"``, or ``"reference"``, q_* (15), as
    # printed in (22). Then Psi P^ = u by (21): with the corrected sign PRX is zero for any
    # estimate, so that the estimate never changes
    prx_acceleration: Literal["measured", "reference"] = "measured"
    eps1: float = 1e-9  # if no entry of PRX is larger, it counts as zero [N m / s^2]
    eps2: float | Array = 1e-12  # if |Psi|^2 is not above it, there is no update [1/s^4]
    bounds: Bounds | None = None  # Omega of (8), or None

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "eps1", "eps2", "iterations", "updates", "substeps"):
            value = getattr(self, name)
            if not np.all((np.asarray(value) > 0) & (np.asarray(value) < np.inf)):
                raise SettingsError(f"{name} is {value}, wanted a positive number")
        if self.method not in ("recursive", "one_shot"):
            raise SettingsError(f"method is {self.method!r}, wanted 'recursive' or 'one_shot'")
        if self.prx_acceleration not in ("measured", "reference"):
            raise SettingsError(
                f"prx_acceleration is {self.prx_acceleration!r}, wanted 'measured' or 'reference'"
            )


@dataclass(frozen=True)
class Influences:
    """Disturbance of the plant and noise of its sensors.

    Attributes:
        torque: v(t) of (11), from the times, shape (R,), and the control, shape (R, n), to
            torques, shape (R, n); computed once per update and constant in between. None for none.
        q, v, a: Standard deviations of white noise on positions [rad or m], velocities and
            accelerations; each a number or an array that broadcasts to (R, n).
        rng: Random generator of the noise; required if there is any.
    """

    torque: Callable[[Array, Array], Array] | None = None
    q: float | Array = 0.0
    v: float | Array = 0.0
    a: float | Array = 0.0
    rng: np.random.Generator | None = None

    def __post_init__(self) -> None:
        if self.rng is None and any(np.any(np.asarray(x) != 0) for x in (self.q, self.v, self.a)):
            raise SettingsError("sensor noise is stated, but rng is None, wanted a generator")


@dataclass(frozen=True)
class History:
    """The course of R runs over L iterations."""

    estimates: Array  # P^ before the first iteration and after each, shape (L + 1, R, c)
    prx: Array  # largest entry of PRX (23) during each iteration, shape (L, R) [N m / s^2]
    tracking: Array  # largest distance from the program in each iteration, shape (L, R) [rad or m]
    # the first iteration in which PRX was zero throughout (25), after which the estimate is
    # constant; 0 if there was none, shape (R,)
    NA: NDArray[np.int_]
    # the iteration in which the robot diverged from its program, 0 if it did not, shape (R,). Its
    # estimate is constant afterwards
    diverged: NDArray[np.int_]
    # number of updates omitted since D(q, P^) was not positive definite, shape (R,)
    skipped: NDArray[np.int_]
    # control u (21), shape (L, updates, R, n) [N m or N], if requested
    torques: Array | None = field(default=None, repr=False)

    def relative_error(self, P: Array) -> Array:
        """Return |P^ - P| / |P| before the first iteration and after each: P (c,) -> (L + 1, R)."""
        error: Array = np.linalg.norm(self.estimates - P, axis=-1) / np.linalg.norm(P)
        return error


def random_torque(
    share: float | Array, rng: np.random.Generator
) -> Callable[[Array, Array], Array]:
    """Return a disturbance v(t), uniform within a share of the control at every update.

    References:
        Tzvetkova, (2) and (11).
    """

    def torque(t: Array, u: Array) -> Array:
        disturbance: Array = share * u * rng.uniform(-1.0, 1.0, u.shape)
        return disturbance

    return torque


def run_procedure(
    dynamics: LinearDynamics,
    plant: Plant,
    motion: ProgramMotion,
    P0: Array,
    *,
    settings: LoopSettings | None = None,
    offset: Array | float = 0.0,
    influences: Influences | None = None,
    keep_torques: bool = False,
    progress: Callable[[int], None] | None = None,
) -> History:
    """Run the closed-loop procedure from initial values.

    Each iteration starts at rest at the start of the program, or at an offset from it.

    References:
        Tzvetkova, (14)-(25).

    P0 (R, c), offset (n,).
    """
    if P0.ndim != 2 or P0.shape[1] != len(dynamics.names):
        raise DataError(f"P0 has shape {P0.shape}, wanted (R, {len(dynamics.names)})")
    loop = _Loop(
        dynamics, plant, motion, settings or LoopSettings(), influences or Influences(), P0, offset
    )
    for number in range(1, loop.settings.iterations + 1):
        loop.iterate(number, keep_torques)
        if progress is not None:
            progress(number)
        if not loop.active.any():
            break
    return loop.history()


class _Loop:
    """The state and the history of all runs."""

    def __init__(
        self,
        dynamics: LinearDynamics,
        plant: Plant,
        motion: ProgramMotion,
        settings: LoopSettings,
        influences: Influences,
        P0: Array,
        offset: Array | float,
    ) -> None:
        R, n = len(P0), dynamics.n_joints
        self.dynamics, self.plant, self.motion = dynamics, plant, motion
        self.settings, self.influences = settings, influences
        self.alpha = _column(settings.alpha)
        self.beta = _column(settings.beta)
        self.dt = np.broadcast_to(np.asarray(motion.duration) / settings.updates, (R,))  # [s]
        self.start = motion.evaluate(np.zeros(R))[0] + np.broadcast_to(offset, (R, n))
        self.P = P0 if settings.bounds is None else settings.bounds.project(P0)
        self.active = np.ones(R, dtype=bool)
        self.NA, self.diverged, self.skipped = (np.zeros(R, dtype=int) for _ in range(3))
        self.estimates: list[Array] = [self.P]
        self.prx: list[Array] = []
        self.tracking: list[Array] = []
        self.torques: list[Array] = []

    def iterate(self, number: int, keep_torques: bool) -> None:
        """Run the motion once, with its updates."""
        R, n = self.start.shape
        q, v = self.start, np.zeros((R, n))
        largest, distance = np.zeros(R), np.zeros(R)
        torques, samples = [], []
        for k in range(self.settings.updates):
            t = k * self.dt
            q_pr = self.motion.evaluate(t)
            q, v = self._reset_diverged(number, q, v, q_pr)
            distance = np.maximum(distance, np.abs(q - q_pr[0]).max(axis=1))
            q_seen = self._sensed(q, self.influences.q)
            v_seen = self._sensed(v, self.influences.v)
            q_star = reference_acceleration(q_seen, v_seen, q_pr, self.alpha, self.beta)  # (15)
            Psi = self.dynamics.regressor(q_seen, v_seen, q_star)  # (R, n, c), (22)
            u = np.einsum("rnc,rc->rn", Psi, self.P)  # (21)
            applied = u if self.influences.torque is None else u + self.influences.torque(t, u)
            a = self.plant.acceleration(q, v, applied)
            a_seen = self._sensed(a, self.influences.a)
            G = self.dynamics.regressor(q_seen, v_seen, a_seen)  # (12)
            moved = G if self.settings.prx_acceleration == "measured" else Psi
            prx = np.abs(proximity(moved, self.P, u, sign=self.settings.sign)).max(axis=1)  # (23)
            largest = np.maximum(largest, prx)
            if self.settings.method == "recursive":
                eta = a_seen - q_star  # (20), the deviation of the real from the program motion
                self._update(q_seen, Psi, eta, prx > self.settings.eps1)
            else:
                samples.append((G, Psi))
            if keep_torques:
                torques.append(u)
            q, v = self._advance(q, v, a, applied)
        if samples:
            self._update_once(samples)
        self._store(number, largest, distance, torques)

    def _sensed(self, value: Array, level: float | Array) -> Array:
        """Return a measured value, with white noise of a standard deviation."""
        rng = self.influences.rng
        if rng is None or not np.any(np.asarray(level) != 0):
            return value
        noisy: Array = value + level * rng.standard_normal(value.shape)
        return noisy

    def _update(self, q: Array, Psi: Array, eta: Array, is_open: NDArray[np.bool_]) -> None:
        """Apply (24), then (8)."""
        sigma = smallest_eigenvalue(mass_matrix(self.dynamics, q, self.P))
        self.skipped = self.skipped + (self.active & (sigma <= 0.0))
        is_open = is_open & self.active
        P = recursive_update(self.P, Psi, eta, sigma, is_open, eps2=self.settings.eps2)
        self.P = self._bounded(P)

    def _update_once(self, samples: list[tuple[Array, Array]]) -> None:
        """Apply (18) to the samples of one run, then (8)."""
        G, G_star = (np.stack(part, axis=1) for part in zip(*samples, strict=True))
        c, P = self.P.shape[1], self.P.copy()
        for r in np.flatnonzero(self.active):
            stacked, names = (G[r].reshape(-1, c), G_star[r].reshape(-1, c)), self.dynamics.names
            P[r] = one_shot(*stacked, self.P[r], names)
        self.P = self._bounded(P)

    def _bounded(self, P: Array) -> Array:
        bounds = self.settings.bounds
        return P if bounds is None else np.where(self.active[:, None], bounds.project(P), P)

    def _advance(self, q: Array, v: Array, a: Array, u: Array) -> tuple[Array, Array]:
        """Return the state one update later: Runge-Kutta of order 4 with constant torque."""
        h = (self.dt / self.settings.substeps)[:, None]
        for step in range(self.settings.substeps):
            q, v = rk4(
                lambda q, v, _: self.plant.acceleration(q, v, u), q, v, h, a if step == 0 else None
            )
        return q, v

    def _reset_diverged(
        self, number: int, q: Array, v: Array, program: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        """Reset robots that have diverged to their program."""
        deviation = np.maximum(np.abs(q - program[0]), np.abs(v - program[1])).max(axis=1)
        diverges = ~(deviation < _DIVERGED)  # also with NaN
        self.diverged = np.where(diverges & self.active, number, self.diverged)
        self.active = self.active & ~diverges
        has_diverged = diverges | (self.diverged > 0)
        if not has_diverged.any():
            return q, v
        reset = has_diverged[:, None]
        return np.where(reset, program[0], q), np.where(reset, program[1], v)

    def _store(self, number: int, largest: Array, distance: Array, torques: list[Array]) -> None:
        is_zero = self.active & (largest <= self.settings.eps1)
        self.NA = np.where(is_zero, number, self.NA)  # (25)
        self.active = self.active & ~is_zero
        self.estimates.append(self.P)
        self.prx.append(largest)
        self.tracking.append(distance)
        if torques:
            self.torques.append(np.stack(torques))

    def history(self) -> History:
        """Return the history of the runs."""
        return History(
            estimates=np.stack(self.estimates),
            prx=np.stack(self.prx),
            tracking=np.stack(self.tracking),
            NA=self.NA,
            diverged=self.diverged,
            skipped=self.skipped,
            torques=np.stack(self.torques) if self.torques else None,
        )


def _column(gain: float | Array) -> Array:
    """Return a gain as a factor of arrays of shape (R, n)."""
    array = np.asarray(gain, dtype=float)
    return array[:, None] if array.ndim == 1 else array
