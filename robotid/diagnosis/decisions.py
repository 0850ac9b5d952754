"""Decisions: how options are selected on held-out segments, and the thresholds of this package.

Options compete to explain a residual, each fitted together with those selected before, by the
squared residual of segments that are held out in turn. One is selected if it reduces it
significantly and by enough, the simplest of those that explain about the same; then the others
compete again. Groups of thresholds name the benchmark of their correct and false detections.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.special import stdtr

from robotid.base.tolerances import REMAINDER
from robotid.base.typing import Array


@dataclass(frozen=True)
class Rule:
    """Conditions for the selection of an option."""

    most: int  # Largest number of options selected
    share: float  # Smallest share of the squared residual of a selected option [-]
    p_value: float | None  # Largest p-value of a selected option [-]; None: it is not tested
    #: Share of the squared residual within which options count as equal.
    alike: float = 0.02


# Families selected for a joint's drive: benchmarks/bench_friction.py
# The same p-value decides whether least squares predicts better than bodies bound to the prior.
FAMILY_P_VALUE = 0.01
FAMILY = Rule(most=4, share=0.05, p_value=FAMILY_P_VALUE)
# Families selected from simulated positions, one of each at most, by the share of a joint's squared
# residual in held-out windows with unit noise: benchmarks/bench_commands.py
SIMULATED_FAMILY = Rule(most=3, share=0.02, p_value=None, alike=0.0)
#: Size over the torque above which a term is no effect of the filter on velocity signs.
LEAST_TERM = 0.006
UNDECIDED_P_VALUE = 0.25  # p-value below which a family not selected is undecided: intervals widen
TENFOLD = 10.0  # Factor on a standard error above which a family is badly conditioned
AT_BOUND = 0.02  # Distance of a shape at a bound from it, of the logarithm of its range
#: Share of the squared residual that an option must explain, and the largest p-value of that share.
LEAST_SHARE = 0.1
P_VALUE = 3e-4
# Terms that a drive model lacks: benchmarks/bench_misfit.py
MISFIT = Rule(most=3, share=LEAST_SHARE, p_value=P_VALUE)
MISFIT_WARNS = 0.25  # Share of the squared residual above which a term is a warning
MISFIT_MATTERS = 0.02  # Size over the torque above which a term is a warning
ONE_SIDED = 0.6  # Share above which a coupling needs no confirmation by the other joint
CONFIRMED = 0.25  # Part of the share that validation logs must confirm, if there are any
MAIN = 50.0  # [%] of the squared residual that a term explains that replaces a hypothesis
GROWN = 1.3  # Factor on a standard error above which a misfit affects a parameter
# Recordings or URDF that differ: benchmarks/bench_verdict.py. Only the best hypothesis is tested.
ALTERATION = Rule(most=3, share=-float("inf"), p_value=None)
#: A smaller share counts if validation logs confirm it, its p-value is tiny and its size is large.
WEAK = 0.03
WEAK_P_VALUE = 1e-5
WEAK_SIZE = 2.0
SIGNIFICANT = 5.0  # Standard errors that its size must differ from 0
SEGMENTS = 16  # Largest number of segments that are held out in turn
SHORTEST = 10  # Smallest number of independent samples of one
FEWEST = 6  # Smallest number of segments for a test
OUTLIER = 12.0  # Typical residuals above which a sample is excluded
BEYOND_NOISE = 3.0  # Standard errors, or deviations, beyond which a value is no noise
SHARE_OF_ROWS = 0.02  # Share of the rows from which a fault of single rows is reported
ROWS = 2000  # Instants of a motion that are used: more are not independent after the filter
STEP = 1e-3  # Step of a derivative by a size, relative to a shape
STEPS = 5  # Largest number of Gauss-Newton steps of sizes
SETTLED = 0.2  # Step over its standard error below which sizes have converged
#: Strong correlation: if one were known, the other's error would be sqrt(1 - r^2) = 0.31 times.
CORRELATED = 0.95
MOST = 0.8  # Share of rows, of power, or of a torque from which it is most of it
ZERO = 0.05  # Share of its largest or usual value below which a quantity is about 0
#: Relative difference up to which two values agree: as a mass or a gravity torque confirms the
#: torque scale; and from which one is reported, or a standard error is too large to use a value.
AGREES = 0.05
DIFFERS = 2 * AGREES
#: Factor beyond which a torque, a mass or a motion is no error of the URDF's masses or limits.
NO_ERROR_OF_MASSES = 3.0
BETTER = 0.5  # Ratio of two residuals below which the first explanation is clearly the better one
SCATTERED = 3  # Segments from which a scatter is determined
#: Share of a torque that is noise even in an exact log, and of what dependent columns leave.
EXACT = 1e-5
NOTHING = 1e-300  # A sum of squares that is 0, as a divisor
Option = TypeVar("Option", bound=Hashable)


@dataclass(frozen=True, eq=False)
class Round(Generic[Option]):
    """Squared residuals of held-out segments with each option, together with those selected."""

    before: Array  # Squared residual of each of K segments without any option, shape (K,)
    left: Mapping[Option, Array]  # Squared residuals with each option, shape (K,)
    fitted: int  # Number of segments of fitted logs, which come first; the others are validation
    whole: float  # Squared residual to which shares refer
    least: float = -np.inf  # Smallest reduction of the squared residual, whatever its share

    def gain(self, option: Option) -> float:
        """Return the reduction of the squared residual of fitted logs by an option."""
        return float((self.before - self.left[option])[: self.fitted].sum())

    def share(self, option: Option) -> float:
        """Return the share of the squared residual of fitted logs that an option removes [-]."""
        return self.gain(option) / max(self.whole, NOTHING)

    def p_value(self, option: Option) -> float:
        """Return the p-value of the reduction by an option [-]."""
        return p_value(self.before, self.left[option], self.fitted)

    def alike(self, rule: Rule, tried: Callable[[Option], int] = lambda option: 1) -> list[Option]:
        """Return the options that may be selected and explain as much as the best of them."""
        shares = {
            option: share
            for option in self.left
            for share in [self.share(option)]
            if share > rule.share
            and self.gain(option) > self.least
            and (rule.p_value is None or tried(option) * self.p_value(option) < rule.p_value)
        }
        largest = max(shares.values(), default=0.0)
        return [option for option, share in shares.items() if share >= largest - rule.alike]

    def best(
        self,
        rule: Rule,
        cost: Callable[[Option], Any] = lambda option: 0,
        tried: Callable[[Option], int] = lambda option: 1,
    ) -> Option | None:
        """Return the simplest of the options that explain as much as the best; None without one."""
        alike = self.alike(rule, tried)
        return min(alike, key=lambda option: (cost(option), -self.share(option)), default=None)


def select(
    offered: Callable[[], Round[Option]],
    rule: Rule,
    cost: Callable[[Option], Any] = lambda option: 0,
    tried: Callable[[Option], int] = lambda option: 1,
) -> Iterator[tuple[Round[Option], Option | None]]:
    """Yield each round with the option selected in it; None in a last round without one."""
    for _ in range(rule.most):
        this = offered()
        best = this.best(rule, cost, tried)
        yield this, best
        if best is None:
            return


def p_value(before: Array, after: Array, fitted: int) -> float:
    """Return the p-value of a reduction of the squared residuals of segments [-]."""
    # Student's test of the mean share, in [-1, 1], over fitted segments or all: the smaller one.
    return min(_student(before[:k], after[:k]) for k in {fitted, len(before)})


def _student(before: Array, after: Array) -> float:
    """Return the p-value of the mean share; 1 for too few segments."""
    moves = before > REMAINDER * before.max(initial=0.0)
    if moves.sum() < SCATTERED:
        return 1.0
    gain = (before - after)[moves] / np.maximum(before, after)[moves]
    spread = max(float(np.std(gain, ddof=1)) / np.sqrt(len(gain)), NOTHING)
    return float(stdtr(len(gain) - 1, -gain.mean() / spread))


def connected(is_alike: Array) -> list[list[int]]:
    """Return the groups of several indices that a symmetric relation connects: (n, n)."""
    from scipy.sparse.csgraph import connected_components

    count, label = connected_components(is_alike)
    groups = [np.flatnonzero(label == k).tolist() for k in range(count)]
    return [group for group in groups if len(group) > 1]
