"""Dependence of a residual on a quantity: its means in bins, and a cross-validated test.

Neighbouring samples are correlated, so whole segments are held out in turn: the means of the bins
in the other segments predict the one that is held out.
"""

from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.residual.decisions import DEPENDENCE_P_VALUE, DEPENDENCE_SHARE
from robotid.diagnosis.residual.selection import p_value

#: Smallest number of segments for a test.
FEWEST = 6

_BINS = 10  # of a quantity, with equal numbers of samples
_FEWEST_IN_BIN = 3  # segments from which the scatter of a bin's mean is determined


@dataclass(frozen=True, eq=False)
class Dependence:
    """Dependence of the residual of a joint on a quantity."""

    name: str  # "constant", "position", "speed", "acceleration", "load" or "time"
    unit: str  # Unit of the quantity
    centres: Array  # Mean of the quantity in each bin, shape (B,)
    means: Array  # Mean residual in each bin, shape (B,) [N m or N]
    #: Standard error of these means, from their scatter between segments, shape (B,); NaN in bins
    #: of fewer than three segments
    errors: Array
    #: Share of the residual's variance that the means of other segments explain; None if there are
    #: too few segments. A negative share means that they explain nothing
    share: float | None
    p_value: float  # p-value of that share [-]

    @property
    def is_significant(self) -> bool:
        """Whether the dependence is significant, and large enough to matter."""
        return (
            self.share is not None
            and self.share >= DEPENDENCE_SHARE
            and self.p_value < DEPENDENCE_P_VALUE
        )

    @property
    def where(self) -> float:
        """The value of the quantity where the mean residual differs from 0 most significantly."""
        significance = np.abs(self.means) / np.where(self.errors > 0, self.errors, np.inf)
        return float(self.centres[int(np.argmax(significance))])

    def at(self, x: Array) -> tuple[Array, Array]:
        """Return the mean residual and its standard error, linear between bins, shape (N,) each."""
        curves = (np.interp(x, self.centres, y, np.nan, np.nan) for y in (self.means, self.errors))
        mean, error = curves
        return mean, error


def follow(
    name: str, unit: str, x: Array, r: Array, bins: Array, segments: Array | None
) -> Dependence:
    """Return the dependence of a residual on a quantity.

    With N_kb samples and the sum S_kb of their residuals in segment k and bin b, the mean of a bin
    is m_b = sum_k S_kb / n_b. Its variance is sum_k (S_kb - N_kb m_b)^2 / n_b^2, for independent
    clusters (Liang, Zeger 1986). The squared residual of segment k after the means of the other
    segments is compared with that after their common mean; for a single bin, with that around 0.
    """
    n = np.bincount(bins).astype(float)
    centres, means = np.bincount(bins, x) / n, np.bincount(bins, r) / n
    if segments is None:
        return Dependence(name, unit, centres, means, np.full(len(n), np.nan), None, 1.0)
    segment = np.unique(segments, return_inverse=True)[1]
    K, B = int(segment.max()) + 1, len(n)
    cell = segment * B + bins
    N = np.bincount(cell, minlength=K * B).reshape(K, B).astype(float)  # samples of segment and bin
    S = np.bincount(cell, r, K * B).reshape(K, B)  # sums of their residuals
    Q = np.bincount(segment, r**2)
    present = (N > 0).sum(axis=0)
    scatter = np.sum((S - N * means) ** 2, axis=0) * present / np.maximum(present - 1, 1)
    errors = np.where(present >= _FEWEST_IN_BIN, np.sqrt(scatter) / n, np.nan)
    if K < FEWEST:
        return Dependence(name, unit, centres, means, errors, None, 1.0)
    N_other, S_other = n - N, S.sum(axis=0) - S  # of all segments but one
    plain = (S_other.sum(axis=1) / N_other.sum(axis=1))[:, None] * (B > 1)  # with a constant
    mean = np.where(N_other > 0, S_other / np.maximum(N_other, 1.0), plain)  # (K, B)
    before, after = (
        Q - 2 * np.sum(m * S, axis=1) + np.sum(m**2 * N, axis=1) for m in (plain, mean)
    )
    whole = float(before.sum())
    share = 1.0 - float(after.sum()) / whole if whole > 0 else 0.0  # 0 for a residual of 0
    return Dependence(name, unit, centres, means, errors, share, p_value(before, after, K))


def even_bins(x: Array) -> Array:
    """Return the bin of each value: ten bins with equal numbers of samples, also split at 0."""
    edges = np.unique(np.append(np.quantile(x, np.arange(1, _BINS) / _BINS), 0.0))
    return np.unique(np.searchsorted(edges, x, side="right"), return_inverse=True)[1]
