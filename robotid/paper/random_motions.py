"""Numerous trajectories: the procedure from random guesses, along random motions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.paper.dynamics import LinearDynamics, LinearPlant
from robotid.paper.procedure import History, LoopSettings, run_procedure
from robotid.simulation.motions import ProgramMotion

__all__ = ["TOLERANCE", "RandomRuns", "random_runs"]

TOLERANCE = 1e-3  # [-] relative error at which a run has converged
_STALLED = 1e-3  # [-] a smaller share of the error lost over ten iterations is none


@dataclass(frozen=True)
class RandomRuns:
    """R random motions, and what became of the estimate on each.

    Attributes:
        amplitude: Of each motion (28), shape (R, n) [rad].
        duration: Of each motion, shape (R,) [s].
        gain: Bandwidth w of the control, alpha = 2 w and beta = w^2, shape (R,) [1/s].
        guess: First guess, shape (R, c).
        offset: Where the robot starts, from its program, shape (R, n) [rad].
        errors: Relative error before the first iteration and after each, shape (L + 1, R).
        history: What happened.
    """

    amplitude: Array
    duration: Array
    gain: Array
    guess: Array
    offset: Array
    errors: Array
    history: History

    @property
    def has_converged(self) -> NDArray[np.bool_]:
        """Whether each run reached ``TOLERANCE``, shape (R,)."""
        return np.asarray((self.errors < TOLERANCE).any(axis=0))

    @property
    def iterations(self) -> list[int]:
        """Iterations that each converged run took."""
        first = (self.errors < TOLERANCE).argmax(axis=0)
        return [int(k) for k in first[self.has_converged]]

    def failures(self) -> list[dict[str, Any]]:
        """Return each run that did not converge, and why.

        Returns:
            Number of the run, reason, final error, and what the run was.
        """
        return [self._failure(int(r)) for r in np.flatnonzero(~self.has_converged)]

    def to_dict(self) -> dict[str, Any]:
        """Return the part of paper.json.

        Returns:
            Runs, converged, iterations of those, failures, and the tolerance.
        """
        return {
            "runs": len(self.guess),
            "converged": int(self.has_converged.sum()),
            "tolerance": TOLERANCE,
            "most_iterations": len(self.errors) - 1,
            "iterations": self.iterations,
            "failures": self.failures(),
        }

    def _failure(self, r: int) -> dict[str, Any]:
        return {
            "run": r,
            "reason": self._reason(r),
            "relative_error": float(self.errors[-1, r]),
            "amplitude": self.amplitude[r].tolist(),
            "duration": float(self.duration[r]),
            "gain": float(self.gain[r]),
            "guess": self.guess[r].tolist(),
            "offset": self.offset[r].tolist(),
        }

    def _reason(self, r: int) -> str:
        if self.history.lost[r]:
            return f"the robot ran away from its program in iteration {self.history.lost[r]}"
        reason = _course(self.errors[:, r])
        if skipped := self.history.skipped[r]:
            reason += f"; {skipped} updates were left out, as D(q, P^) was not positive definite"
        return reason


def random_runs(
    dynamics: LinearDynamics,
    P: Array,
    runs: int,
    iterations: int,
    rng: np.random.Generator,
    *,
    reach: float = 0.05,
    progress: Callable[[int], None] | None = None,
) -> RandomRuns:
    """Run the procedure on random motions, first guesses, gains and starts.

    Each joint moves by 0.5 to 2 rad either way in 1 to 3 s; each parameter is guessed at 0.3 to
    1.7 times its value; the bandwidth is 5 to 20 1/s.

    Args:
        dynamics: The model.
        P: Its true parameters, shape (c,).
        runs: Number R of motions.
        iterations: Most iterations of each.
        rng: Source of all that is random.
        reach: How far beside the program the robot may start [rad].
        progress: Called with the number of each iteration that is done.
    """
    n = dynamics.n_joints
    amplitude = rng.uniform(0.5, 2.0, (runs, n)) * rng.choice([-1.0, 1.0], (runs, n))
    duration, gain = rng.uniform(1.0, 3.0, runs), rng.uniform(5.0, 20.0, runs)
    guess = P * rng.uniform(0.3, 1.7, (runs, len(P)))
    offset = reach * rng.uniform(-1.0, 1.0, (runs, n))
    history = run_procedure(
        dynamics,
        LinearPlant(dynamics, P),
        ProgramMotion(amplitude, duration),
        guess,
        settings=LoopSettings(alpha=2 * gain, beta=gain**2, iterations=iterations),
        offset=offset,
        progress=progress,
    )
    errors = history.relative_error(P)
    return RandomRuns(amplitude, duration, gain, guess, offset, errors, history)


def _course(error: Array) -> str:
    """Return why an error, shape (L + 1,), is not small at its end."""
    count = len(error) - 1
    lost = 1.0 - error[-1] / error[max(0, count - 10)]
    if error[-1] > error[0]:
        return f"the error grew, from {error[0]:.2g} to {error[-1]:.2g}"
    if lost < _STALLED:
        return f"stalled: the motion excites too little; an error of {error[-1]:.2g} is left"
    return (
        f"slow: an error of {error[-1]:.2g} is left after {count} iterations and falls by "
        f"{100 * lost:.2g} % in ten"
    )
