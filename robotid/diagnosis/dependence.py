"""How a residual follows a quantity: its mean in bins, and what that explains beyond chance.

Segments of the rows are left out in turn, for neighbouring rows know of each other: the means of
the bins in the other segments predict the one that is left out.
"""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.diagnosis.decisions import DEPENDENCE_P_VALUE, DEPENDENCE_SHARE
from robotid.diagnosis.selection import p_value

__all__ = ["FEWEST", "Dependence", "even_bins", "follow"]

#: Segments to judge by, at least.
FEWEST = 6

_BINS = 10  # of a quantity, each of as many rows
_SEEN_IN = 3  # segments, from which the scatter of a bin's mean is told


@dataclass(frozen=True, eq=False)
class Dependence:
    """How the residual of a joint follows a quantity.

    Attributes:
        name: "constant", "position", "speed", "acceleration", "load" or "time".
        unit: Unit of the quantity.
        centres: Mean of the quantity in each bin, shape (B,).
        means: Mean residual there, shape (B,) [N m or N].
        errors: Standard error of that by its scatter from segment to segment, shape (B,); NaN in
            bins of fewer than three segments.
        share: Share of the residual's variance that the means of other segments explain; None if
            there are too few segments to tell. Below 0 they explain nothing.
        p_value: How likely that is by chance [-].
    """

    name: str
    unit: str
    centres: Array
    means: Array
    errors: Array
    share: float | None
    p_value: float

    @property
    def is_sure(self) -> bool:
        """Whether the residual follows the quantity beyond chance, and by enough to matter."""
        return (
            self.share is not None
            and self.share >= DEPENDENCE_SHARE
            and self.p_value < DEPENDENCE_P_VALUE
        )

    @property
    def where(self) -> float:
        """Where the mean residual is off by the most standard errors."""
        sure = np.abs(self.means) / np.where(self.errors > 0, self.errors, np.inf)
        return float(self.centres[int(np.argmax(sure))])

    def at(self, x: Array) -> tuple[Array, Array]:
        """Return the mean residual and its standard error, linear between bins, shape (N,) each.

        Args:
            x: Values of the quantity, shape (N,); NaN comes back outside of the bins.
        """
        curves = (np.interp(x, self.centres, y, np.nan, np.nan) for y in (self.means, self.errors))
        mean, error = curves
        return mean, error


def follow(
    name: str, unit: str, x: Array, r: Array, bins: Array, segments: Array | None
) -> Dependence:
    """Return how a residual follows a quantity.

    With N_kb rows and the sum S_kb of their residuals in segment k and bin b, the mean of a bin is
    m_b = sum_k S_kb / n_b, its variance sum_k (S_kb - N_kb m_b)^2 / n_b^2, as of clusters that know
    nothing of each other (Liang, Zeger 1986). What the means without segment k leave of it is
    compared with what their common mean leaves; of a single bin, with its square.

    Args:
        name: Name of the quantity.
        unit: Its unit.
        x: Its values in the rows, shape (N,).
        r: The residual, shape (N,).
        bins: Which bin each row is in, shape (N,), int, from 0 on without gaps.
        segments: Which segment each row is in, shape (N,), int; None if they are too short.
    """
    n = np.bincount(bins).astype(float)
    centres, means = np.bincount(bins, x) / n, np.bincount(bins, r) / n
    if segments is None:
        return Dependence(name, unit, centres, means, np.full(len(n), np.nan), None, 1.0)
    segment = np.unique(segments, return_inverse=True)[1]
    K, B = int(segment.max()) + 1, len(n)
    cell = segment * B + bins
    N = np.bincount(cell, minlength=K * B).reshape(K, B).astype(float)  # rows of segment and bin
    S = np.bincount(cell, r, K * B).reshape(K, B)  # and sums of their residuals
    Q = np.bincount(segment, r**2)
    present = (N > 0).sum(axis=0)
    scatter = np.sum((S - N * means) ** 2, axis=0) * present / np.maximum(present - 1, 1)
    errors = np.where(present >= _SEEN_IN, np.sqrt(scatter) / n, np.nan)
    if K < FEWEST:
        return Dependence(name, unit, centres, means, errors, None, 1.0)
    N_other, S_other = n - N, S.sum(axis=0) - S  # of all segments but one
    plain = (S_other.sum(axis=1) / N_other.sum(axis=1))[:, None] * (B > 1)  # beside a constant
    mean = np.where(N_other > 0, S_other / np.maximum(N_other, 1.0), plain)  # (K, B)
    before, after = (
        Q - 2 * np.sum(m * S, axis=1) + np.sum(m**2 * N, axis=1) for m in (plain, mean)
    )
    whole = float(before.sum())
    share = 1.0 - float(after.sum()) / whole if whole > 0 else 0.0  # of a residual of 0 nothing
    return Dependence(name, unit, centres, means, errors, share, p_value(before, after, K))


def even_bins(x: Array) -> Array:
    """Return which bin each value is in, of ten bins with as many rows each that are cut at 0.

    Args:
        x: Values of a quantity, shape (N,).

    Returns:
        Numbers of the bins, each of which has a row, shape (N,), int.
    """
    edges = np.unique(np.append(np.quantile(x, np.arange(1, _BINS) / _BINS), 0.0))
    return np.unique(np.searchsorted(edges, x, side="right"), return_inverse=True)[1]
