"""Greedy forward selection on segments that are held out: the one that all choices are made with.

Options compete to explain a residual. Each is fitted beside what was found without one segment of
the recordings after the other, and judged by the squared residual of that segment. An option is
found if it takes away a share of it that matters, beyond chance; of those that explain alike the
simplest is; then the others compete beside it, until nothing is left to gain. What becomes of an
option that is found is its owner's: a term is taken, reported or doubted.
"""

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from scipy.special import stdtr

from robotid._typing import Array

__all__ = ["Round", "Rule", "p_value", "select"]

_STILL = 1e-9  # of the squared residual of another segment: the joint is at rest in it
_FEWEST = 3  # segments that show chance
_NOTHING = 1e-300

Option = TypeVar("Option", bound=Hashable)


@dataclass(frozen=True)
class Rule:
    """What an option must show to be found.

    Attributes:
        most: Options that are found, at most.
        share: Share of the squared residual from which an option is found [-].
        p_value: p-value of an option that is found, at most [-]; None: it is not tested.
        alike: Share of the squared residual within which options explain alike [-].
    """

    most: int
    share: float
    p_value: float | None
    alike: float


@dataclass(frozen=True, eq=False)
class Round(Generic[Option]):
    """What options leave of segments that they were not fitted to, beside what was found.

    Attributes:
        before: Squared residual of each of K segments without any of them, shape (K,).
        left: The same with each option.
        fitted: How many segments are of fitted logs, the first ones; the others are validation.
        whole: Squared residual that shares are of.
        least: What an option must take away of the squared residual, whatever its share.
    """

    before: Array
    left: Mapping[Option, Array]
    fitted: int
    whole: float
    least: float = -np.inf

    def gain(self, option: Option) -> float:
        """Return what an option takes away of the squared residual of fitted logs.

        Args:
            option: The option.
        """
        return float((self.before - self.left[option])[: self.fitted].sum())

    def share(self, option: Option) -> float:
        """Return the share that an option takes away of fitted logs [-].

        Args:
            option: The option.
        """
        return self.gain(option) / max(self.whole, _NOTHING)

    def p_value(self, option: Option) -> float:
        """Return the p-value of what an option gains [-].

        Args:
            option: The option.
        """
        return p_value(self.before, self.left[option], self.fitted)

    def alike(self, rule: Rule, tried: Callable[[Option], int] = lambda option: 1) -> list[Option]:
        """Return the options that may be found and explain as much as the best of them.

        Args:
            rule: What they must show.
            tried: Of how many each is the best by the same data, which multiplies its p-value.
        """
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
        """Return the simplest of the options that explain as much as the best; None without one.

        Args:
            rule: What they must show.
            cost: How simple each is, smallest first; of equal ones the one that explains more wins.
            tried: As of ``alike``.
        """
        alike = self.alike(rule, tried)
        return min(alike, key=lambda option: (cost(option), -self.share(option)), default=None)


def select(
    offered: Callable[[], Round[Option]],
    rule: Rule,
    cost: Callable[[Option], Any] = lambda option: 0,
    tried: Callable[[Option], int] = lambda option: 1,
) -> Iterator[tuple[Round[Option], Option | None]]:
    """Yield each round with the option that is found in it, None in a last one without any.

    Args:
        offered: Returns the round of the options beside what was found before.
        rule: What they must show.
        cost: As of ``Round.best``.
        tried: As of ``Round.best``.
    """
    for _ in range(rule.most):
        this = offered()
        best = this.best(rule, cost, tried)
        yield this, best
        if best is None:
            return


def p_value(before: Array, after: Array, fitted: int) -> float:
    """Return how likely segments gain that much, in the mean of their shares, by chance [-].

    By Student's test of the shares, each between -1 and 1, of the segments of fitted logs or of
    all, whichever is surer; those in which the joint is at rest do not count.

    Args:
        before: Squared residual of each segment, shape (K,).
        after: The same with an option.
        fitted: How many of the segments are of fitted logs, the first ones.
    """
    return min(_student(before[:k], after[:k]) for k in {fitted, len(before)})


def _student(before: Array, after: Array) -> float:
    """Return the p-value of the mean share that segments gain; 1 of too few."""
    moves = before > _STILL * before.max(initial=0.0)
    if moves.sum() < _FEWEST:
        return 1.0
    gain = (before - after)[moves] / np.maximum(before, after)[moves]
    spread = max(float(np.std(gain, ddof=1)) / np.sqrt(len(gain)), _NOTHING)
    return float(stdtr(len(gain) - 1, -gain.mean() / spread))
