"""The closed-loop procedure: a robot follows a program while its parameters are being found.

One iteration is one run of the program motion. At each of its updates the control (21) is computed
from the estimate, the plant moves, and the estimate follows its deviation (24). Many runs go at
once: R is their number, one row each.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.paper.dynamics import LinearDynamics, Plant, mass_matrix, smallest_eigenvalue
from robotid.paper.formulas import (
    deviation,
    one_shot,
    proximity,
    recursive_update,
    reference_acceleration,
)
from robotid.paper.procedure import History, Influences, LoopSettings
from robotid.simulation.motions import ProgramMotion

__all__ = ["run_procedure"]

_RUNAWAY = 1e3  # [rad or m] from the program, or 1e3 times a second: the run is given up


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
    """Run the closed-loop procedure from a first guess.

    Each iteration starts at rest at the start of the program, or at an offset from it.

    Args:
        dynamics: The model whose parameters are looked for.
        plant: The true robot.
        motion: The program (28), one for all runs or one each.
        P0: First guess of the parameters, shape (R, c).
        settings: Gains, numbers of iterations and updates, bounds; the defaults if None.
        offset: Where the robot starts, from the start of the program, shape (n,) or (R, n).
        influences: Disturbance and noise; none if None.
        keep_torques: Whether the history keeps the control.
        progress: Called with the number of each iteration that is done.

    Returns:
        The history.

    Raises:
        DataError: If P0 does not fit the dynamics.
        RankDeficientError: If the method is one-shot and the motion leaves parameters open.

    References:
        Tzvetkova, (14)-(25).
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
    """The state of all runs, and what is remembered of them."""

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
        self.start = self.program(np.zeros(R))[0] + np.broadcast_to(offset, (R, n))
        self.P = P0 if settings.bounds is None else settings.bounds.project(P0)
        self.active = np.ones(R, dtype=bool)
        self.NA, self.lost, self.skipped = (np.zeros(R, dtype=int) for _ in range(3))
        self.estimates: list[Array] = [self.P]
        self.prx: list[Array] = []
        self.tracking: list[Array] = []
        self.torques: list[Array] = []

    def program(self, t: Array) -> tuple[Array, Array, Array]:
        """Return q_pr, v_pr, a_pr, each of shape (R, n), at one time per run."""
        return self.motion.evaluate(t)

    def iterate(self, number: int, keep_torques: bool) -> None:
        """Run the motion once, updating along it."""
        R, n = self.start.shape
        q, v = self.start, np.zeros((R, n))
        largest, distance = np.zeros(R), np.zeros(R)
        torques, samples = [], []
        for k in range(self.settings.updates):
            t = k * self.dt
            q_pr = self.program(t)
            q, v = self._hold_lost(number, q, v, q_pr)
            distance = np.maximum(distance, np.abs(q - q_pr[0]).max(axis=1))
            q_seen = self.influences.sense(q, self.influences.q)
            v_seen = self.influences.sense(v, self.influences.v)
            q_star = reference_acceleration(q_seen, v_seen, q_pr, self.alpha, self.beta)  # (15)
            Psi = self.dynamics.regressor(q_seen, v_seen, q_star)  # (R, n, c), (22)
            u = np.einsum("rnc,rc->rn", Psi, self.P)  # (21)
            applied = u if self.influences.torque is None else u + self.influences.torque(t, u)
            a = self.plant.acceleration(q, v, applied)
            a_seen = self.influences.sense(a, self.influences.a)
            G = self.dynamics.regressor(q_seen, v_seen, a_seen)  # (12)
            prx = np.abs(proximity(G, self.P, u, sign=self.settings.sign)).max(axis=1)  # (23)
            largest = np.maximum(largest, prx)
            if self.settings.method == "recursive":
                self._update(q_seen, Psi, deviation(a_seen, q_star), prx > self.settings.eps1)
            else:
                samples.append((G, Psi))
            if keep_torques:
                torques.append(u)
            q, v = self._advance(q, v, a, applied)
        if samples:
            self._update_once(samples)
        self._remember(number, largest, distance, torques)

    def _update(self, q: Array, Psi: Array, eta: Array, is_open: NDArray[np.bool_]) -> None:
        """Do (24), then (8)."""
        sigma = smallest_eigenvalue(mass_matrix(self.dynamics, q, self.P))
        self.skipped = self.skipped + (self.active & (sigma <= 0.0))
        is_open = is_open & self.active
        P = recursive_update(self.P, Psi, eta, sigma, is_open, eps2=self.settings.eps2)
        self.P = self._bounded(P)

    def _update_once(self, samples: list[tuple[Array, Array]]) -> None:
        """Do (18) with the samples of one run, then (8)."""
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
        """Return the state one update later: Runge-Kutta of order 4, the torque held."""
        h = (self.dt / self.settings.substeps)[:, None]
        move = self.plant.acceleration
        for step in range(self.settings.substeps):
            a1 = a if step == 0 else move(q, v, u)
            v2 = v + h / 2 * a1
            a2 = move(q + h / 2 * v, v2, u)
            v3 = v + h / 2 * a2
            a3 = move(q + h / 2 * v2, v3, u)
            v4 = v + h * a3
            a4 = move(q + h * v3, v4, u)
            q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
            v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return q, v

    def _hold_lost(
        self, number: int, q: Array, v: Array, program: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        """Put robots that ran away, and those that are done, back on their program."""
        away = np.maximum(np.abs(q - program[0]), np.abs(v - program[1])).max(axis=1)
        is_lost = ~(away < _RUNAWAY)  # NaN is lost too
        self.lost = np.where(is_lost & self.active, number, self.lost)
        self.active = self.active & ~is_lost
        gone = is_lost | (self.lost > 0)
        if not gone.any():
            return q, v
        return np.where(gone[:, None], program[0], q), np.where(gone[:, None], program[1], v)

    def _remember(self, number: int, largest: Array, distance: Array, torques: list[Array]) -> None:
        is_zero = self.active & (largest <= self.settings.eps1)
        self.NA = np.where(is_zero, number, self.NA)  # (25)
        self.active = self.active & ~is_zero
        self.estimates.append(self.P)
        self.prx.append(largest)
        self.tracking.append(distance)
        if torques:
            self.torques.append(np.stack(torques))

    def history(self) -> History:
        """Return what is remembered."""
        return History(
            estimates=np.stack(self.estimates),
            prx=np.stack(self.prx),
            tracking=np.stack(self.tracking),
            NA=self.NA,
            lost=self.lost,
            skipped=self.skipped,
            torques=np.stack(self.torques) if self.torques else None,
        )


def _column(gain: float | Array) -> Array:
    """Return a gain that multiplies arrays of shape (R, n)."""
    array = np.asarray(gain, dtype=float)
    return array[:, None] if array.ndim == 1 else array
