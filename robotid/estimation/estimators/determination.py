"""Identifiability of base parameters: individually, only in sums with others, or not at all.

One criterion everywhere: the data reduce the standard deviation of an identifiable direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import RankDeficientError
from robotid.base.typing import Array
from robotid.estimation.estimators.estimator import Estimate

PRIOR_LED = 0.9  # ratio of the spreads after and before the data above which a direction is weak
_LED_IN_PART = 0.3  # share of a parameter's spread in weak directions that makes it a group member
_COUPLED = 0.5  # ... or its coefficient relative to another member, in units of the spreads
_JOINED = 0.05  # relative coefficient below which a term is not printed, in units of the spreads
_TERM = 1e-3  # ... and below which it is not a term of the sum
_TIE = 0.95  # coefficients above this share of the largest are equal to it: the first one leads
_TERMS = 4  # largest number of printed terms of a sum
_NAMED = 5  # largest number of printed parameters of a group; half as many sums and groups
_ILL_CONDITIONED = 1e3  # condition number of unit columns above which a motion is poor


@dataclass(frozen=True)
class Combination:
    """A sum of base parameters that is identifiable, while its terms are not."""

    names: tuple[str, ...]  # of the terms, in the order of the base parameters
    coefficients: tuple[float, ...]  # SI units; that of the leading term is 1
    shares: tuple[float, ...]  # in units of the spreads [-]; the largest is that of the leading one

    def __str__(self) -> str:
        shares = np.abs(self.shares)
        leading = self.coefficients.index(1.0)
        order = [i for i in np.argsort(-shares, kind="stable") if i != leading]
        terms = [i for i in order if shares[i] > _JOINED * shares[leading]]
        text = self.names[leading]
        for i in terms[: _TERMS - 1]:
            sign = "-" if self.coefficients[i] < 0 else "+"
            size = f"{abs(self.coefficients[i]):.3g}"
            text += f" {sign} {self.names[i]}" if size == "1" else f" {sign} {size} {self.names[i]}"
        return text + (" + ..." if len(terms) >= _TERMS else "")


@dataclass(frozen=True)
class Group:
    """Base parameters that cannot be distinguished from the data."""

    names: tuple[str, ...]
    combinations: tuple[Combination, ...]  # their identifiable sums, fewer than names

    def __str__(self) -> str:
        if not self.combinations:
            return f"{_and(self.names)} {'is' if len(self.names) == 1 else 'are'} not identifiable"
        count = len(self.combinations)
        if len(self.names) > _NAMED or count > _NAMED // 2:
            return (
                f"the {len(self.names)} parameters {self.names[0]} ... {self.names[-1]} are "
                f"identifiable only in {count} sum{'s' * (count > 1)}, as {self.combinations[0]}"
            )
        sums = _and([str(combination) for combination in self.combinations])
        return f"{_and(self.names)} are identifiable only as {sums}"


@dataclass(frozen=True, eq=False)
class Determination:
    """Identifiability of the base parameters from data."""

    names: tuple[str, ...]  # of the b base parameters
    spread: Array  # (b,), prior standard deviation; 0 for known ones
    shrinkage: Array  # (b,), spread after over before data, of orthogonal directions; 0: known
    weak: Array  # (b, b - rank), the weak directions, in units of the spread, orthonormal
    groups: tuple[Group, ...]

    @property
    def rank(self) -> int:
        """Number of directions that the data determine."""
        return len(self.names) - int(self.weak.shape[1])

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the base parameters that are not identifiable individually, in their order."""
        grouped = {name for group in self.groups for name in group.names}
        return tuple(name for name in self.names if name in grouped)

    @property
    def merged(self) -> tuple[Group, ...]:
        """The groups; those without an identifiable sum are merged into the last one."""
        sums = tuple(group for group in self.groups if group.combinations)
        alone = [name for group in self.groups if not group.combinations for name in group.names]
        return (*sums, Group(tuple(alone), ())) if alone else sums

    def described(self) -> str:
        """Return a description of the groups, as "a and b are identifiable only as a + b"."""
        sums = [str(group) for group in self.merged if group.combinations]
        texts = sums[: _NAMED // 2]
        more = len(sums) - len(texts)
        if more:
            texts.append(f"{more} more group{'s' * (more > 1)} of this kind")
        return "; ".join(texts + [str(group) for group in self.merged if not group.combinations])

    def refusal(self, error: RankDeficientError) -> RankDeficientError:
        """Return the error of least squares with the groups of this criterion."""
        if not self.groups:
            return error
        return RankDeficientError(self.rank, self.undetermined, len(self.names), self.described())

    def to_list(self) -> list[dict[str, Any]]:
        """Return the groups as plain values, as they are written to result.json."""

        def plain(c: Combination) -> dict[str, Any]:
            return {"text": str(c), "terms": dict(zip(c.names, c.coefficients, strict=True))}

        return [
            {"parameters": list(group.names), "determined": [plain(c) for c in group.combinations]}
            for group in self.groups
        ]


def base_spread(K: Array, spread: Array, known: Sequence[bool] | Array = ()) -> Array:
    """Return the prior standard deviation of each base parameter, (b,); 0 if known (p,)."""
    free = spread * ~np.asarray(known, dtype=bool) if len(known) else spread
    return np.asarray(np.linalg.norm(K * free, axis=1))


def determine(names: Sequence[str], rows: Array, spread: Array) -> Determination:
    """Return which directions rows A (k, b) identify, and the groups of parameters of the rest.

    In units of the prior spread (b,), A has singular values s_i: along their right singular vectors
    the spread is reduced to 1 / sqrt(1 + s_i^2). Directions V_w that are hardly reduced, solved for
    as many base parameters f, give x_p = V_p V_f^-1 x_f: each x_p - V_p V_f^-1 x_f is identifiable.
    """
    free = np.flatnonzero(spread > 0)
    weak, shrinkage = np.zeros((len(spread), 0)), np.zeros(len(spread))
    if len(free):
        _, s, Vt = np.linalg.svd(rows[:, free] * spread[free])
        s = np.append(s, np.zeros(len(free) - len(s)))
        after = 1.0 / np.sqrt(1.0 + s**2)
        open_ones = after > PRIOR_LED
        weak = np.zeros((len(spread), int(open_ones.sum())))
        weak[free] = Vt[open_ones].T
        shrinkage[len(spread) - len(free) :] = after
    groups = _groups(tuple(names), weak, spread)
    return Determination(tuple(names), spread, shrinkage, weak, groups)


def is_poorly_excited(wls: Estimate, count: int) -> bool:
    """Return whether the motion, not the noise, leaves base parameters undetermined."""
    return wls.rank < count or wls.condition > _ILL_CONDITIONED


def _groups(names: tuple[str, ...], weak: Array, spread: Array) -> tuple[Group, ...]:
    """Return the groups of base parameters that are coupled along the weak directions."""
    count = weak.shape[1]
    if not count:
        return ()
    order = scipy.linalg.qr(weak.T, mode="r", pivoting=True)[1]
    chosen, others = order[:count], np.sort(order[count:])
    moved = np.linalg.solve(weak[chosen].T, weak[others].T).T  # V_p V_f^-1
    share = np.linalg.norm(weak[others], axis=1)
    is_open = (share > _LED_IN_PART) | (np.abs(moved) > _COUPLED).any(axis=1)
    others, moved = others[is_open], moved[is_open]
    label = np.append(np.arange(count), np.zeros(len(others), dtype=int))
    for k, row in enumerate(moved):
        joined = np.abs(row) > _JOINED
        joined[np.argmax(np.abs(row))] = True
        met = np.unique(label[:count][joined])
        label[np.isin(label, met)] = met[0]
        label[count + k] = met[0]
    places = np.append(chosen, others)
    groups = []
    for one in np.unique(label[np.argsort(places)]):
        members = np.sort(places[label == one])
        sums = [
            _combination(names, spread, [int(p), *chosen], [1.0, *-row])
            for p, row, group in zip(others, moved, label[count:], strict=True)
            if group == one
        ]
        groups.append(Group(tuple(names[i] for i in members), tuple(sums)))
    return tuple(sorted(groups, key=lambda group: names.index(group.names[0])))


def _combination(
    names: tuple[str, ...], spread: Array, places: Sequence[int], scaled: Sequence[float]
) -> Combination:
    """Return a sum in SI units, from one in units of the spread."""
    terms = sorted((p, c) for p, c in zip(places, scaled, strict=True) if abs(c) > _TERM)
    shares = np.array([c for _, c in terms])
    leading = int(np.argmax(np.abs(shares) >= _TIE * np.abs(shares).max()))
    shares /= shares[leading]
    physical = shares * spread[terms[leading][0]] / spread[[p for p, _ in terms]]
    physical[leading] = 1.0
    chosen = tuple(names[p] for p, _ in terms)
    return Combination(chosen, tuple(physical.tolist()), tuple(shares.tolist()))


def _and(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
