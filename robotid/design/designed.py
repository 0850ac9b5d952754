"""A designed motion, and the state of the search for it."""

from dataclasses import dataclass

from robotid.base.typing import Array
from robotid.design.clearance import Contact
from robotid.design.multipliers import Multipliers
from robotid.dynamics.simulation.motions import Motion


@dataclass(frozen=True, eq=False)
class Design:
    """A motion, its criterion and its use of the limits.

    Attributes:
        motion: The motion.
        duration: Its length [s].
        intervals: Number of equal intervals between the samples at which its limits were checked.
        objective: Its criterion, the smaller the better.
        condition: Condition number of the base problem, columns in units of the prior deviations.
        used: Largest used share of each limit, by joint, shape (6, n); 0 where there is no limit.
        contact: Where the smallest distance is; None if no pair comes near.
        seconds: Computing time [s].
        starts: Number of completed starts.
        is_converged: Whether the best of them has converged.
        history: Computing time [s] and criterion of each better motion.
    """

    motion: Motion
    duration: float
    intervals: int
    objective: float
    condition: float
    used: Array
    contact: Contact | None = None
    seconds: float = 0.0
    starts: int = 0
    is_converged: bool = False
    history: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class State:
    """The state of a search.

    Attributes:
        feasible: Coefficients of the best motion that satisfies the limits, shape (h, n).
        objective: Its criterion.
        iterate: Coefficients at which the search continues; they may violate limits.
        multipliers: Those of the limits.
        is_settled: Whether the search has converged.
    """

    feasible: Array
    objective: float
    iterate: Array
    multipliers: Multipliers
    is_settled: bool = False
