"""Greedy forward selection on held-out segments, used for all choices of terms.

Options compete to explain a residual. Each is fitted together with those selected before, with one
segment of the recordings held out after the other, and compared by the squared residual of the
held-out segments. An option is selected if it reduces it significantly and by enough; of options
that explain about the same the simplest is selected. Then the others compete again, until none
improves the fit. The caller decides what follows: a term is added, reported or left undecided.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.special import stdtr

from robotid.base.typing import Array

_STILL = 1e-9  # of the largest squared residual of a segment: below, the joint is at rest in it
_FEWEST = 3  # segments for a test
_NOTHING = 1e-300

Option = TypeVar("Option", bound=Hashable)


@dataclass(frozen=True)
class Rule:
    """Conditions for the selection of an option."""

    most: int  # Largest number of options selected
    share: float  # Smallest share of the squared residual of a selected option [-]
    p_value: float | None  # Largest p-value of a selected option [-]; None: it is not tested
    alike: float  # Share of the squared residual within which options count as equal [-]


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
        return self.gain(option) / max(self.whole, _NOTHING)

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
    """Return the p-value of a reduction of the squared residuals of segments [-].

    Student's test of the mean of their shares, each between -1 and 1, over the segments of fitted
    logs or over all, whichever p-value is smaller. Segments with the joint at rest do not count.
    """
    return min(_student(before[:k], after[:k]) for k in {fitted, len(before)})


def _student(before: Array, after: Array) -> float:
    """Return the p-value of the mean share; 1 for too few segments."""
    moves = before > _STILL * before.max(initial=0.0)
    if moves.sum() < _FEWEST:
        return 1.0
    gain = (before - after)[moves] / np.maximum(before, after)[moves]
    spread = max(float(np.std(gain, ddof=1)) / np.sqrt(len(gain)), _NOTHING)
    return float(stdtr(len(gain) - 1, -gain.mean() / spread))
