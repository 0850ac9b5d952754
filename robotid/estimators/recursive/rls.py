"""Recursive least squares in square-root information form."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dtpqrt

from robotid._typing import Array
from robotid.estimators.batch import solve_factor
from robotid.estimators.estimator import Estimate, Weighing
from robotid.estimators.recursive.base import Filter, scaled_rows
from robotid.exceptions import DataError
from robotid.regressor.factors import Factors
from robotid.regressor.problem import Sample

__all__ = ["RLS", "RLSState"]

_BLOCK = 8  # columns that LAPACK reduces at a time
_TINY = 1e-12  # smallest noise, as a share of sigma: noise-free data have none


@dataclass(frozen=True, eq=False)
class RLSState:
    """What recursive least squares knows.

    Attributes:
        R: Upper triangular factor of the weighted rows [Y tau], shape (c + 1, c + 1).
        rows: Number of rows in it, forgotten ones taken off.
        steps: Number of samples taken.
    """

    R: Array
    rows: float
    steps: int


@dataclass(frozen=True, eq=False)
class RLS(Filter[RLSState]):
    """Recursive least squares with exponential forgetting.

    The state is the triangular factor R of all rows; a sample is folded in by QR:

        R <- triangle of [sqrt(forgetting) R; [Y tau] / sigma].

    Nothing is inverted before an estimate is asked for, so it cannot blow up, and it starts from
    no information at all: without forgetting the result is that of batch least squares. With
    forgetting, information that no motion renews would vanish (wind-up). So each step adds one
    row of the prior, parameter after parameter, which keeps the information of each between
    forgetting^c and 1 times that of the prior. What the data leave open has infinite variance.

    Attributes:
        sigma: Noise level of each joint, shape (n,) [N m or N]. Only the ratios matter: the
            common factor is estimated.
        forgetting: Weight of a sample relative to the next one, 0 < forgetting <= 1 [-].
        prior: Parameters kept where the data say nothing, shape (c,); None: 0, and ``fit`` refuses
            data that leave something open.
        prior_std: How far each may lie from its prior, shape (c,); None for no information.
        independent_share: Share of the rows that count as independent, 2 cutoff / rate.

    Raises:
        DataError: If a setting is out of its range, or forgetting < 1 comes without a prior.

    References:
        Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter IV.
    """

    sigma: Array
    forgetting: float = 1.0
    prior: Array | None = None
    prior_std: Array | None = None
    independent_share: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.forgetting <= 1:
            raise DataError(f"forgetting is {self.forgetting}, wanted above 0 and at most 1")
        if not (np.isfinite(self.sigma).all() and (self.sigma > 0).all()):
            raise DataError(f"sigma is {self.sigma}, wanted positive finite numbers")
        if self.prior_std is not None and self.prior is None:
            raise DataError("prior_std was given without the prior it is about")
        if self.forgetting < 1 and self.prior_std is None:
            raise DataError(
                "with forgetting, information that no motion renews vanishes; give prior and "
                "prior_std to hold it above theirs"
            )

    @property
    def weighing(self) -> Weighing:
        return "by joint" if self.forgetting == 1 else "by age"

    def init(self, c: int) -> RLSState:
        R = np.zeros((c + 1, c + 1), order="F")
        if self.prior is not None and self.prior_std is not None:
            R[:c, :c] = np.diag(1.0 / self.prior_std)
            R[:c, c] = self.prior / self.prior_std
        return RLSState(R, 0.0, 0)

    def update(self, state: RLSState, sample: Sample) -> RLSState:
        rows = scaled_rows(sample, self.sigma, len(state.R) - 1)  # (k, c + 1)
        if not len(rows):
            return state
        count = self.forgetting * state.rows + len(rows)
        if self.forgetting == 1:
            R = dtpqrt(0, min(_BLOCK, len(state.R)), state.R, rows)[0]
        else:
            root = np.sqrt(self.forgetting)
            rows = np.vstack([rows, self._prior_row(state)])
            R = dtpqrt(0, min(_BLOCK, len(state.R)), root * state.R, rows)[0]
        return RLSState(R, count, state.steps + 1)

    def estimate(self, state: RLSState, names: tuple[str, ...]) -> Estimate:
        c = len(names)
        factors = Factors((state.R,), (np.arange(c),), np.array([int(state.rows)]), names)
        start = np.zeros(c) if self.prior is None else self.prior
        solution = solve_factor(factors, np.ones(1), start)
        freedom = max(state.rows - solution.rank, 1.0)
        scale = max(abs(float(state.R[c, c])) / np.sqrt(freedom), _TINY)
        covariance = scale**2 / self.independent_share * solution.covariance
        message = (
            f"{state.steps} samples folded in, forgetting {self.forgetting:g}; noise "
            f"levels {scale:.3g} times those given"
        )
        return solution.estimate(names, covariance, scale * self.sigma, state.steps, message)

    def _rows_of(self, state: RLSState) -> int:
        # those that are forgotten have been seen all the same
        return int(state.rows) if self.forgetting == 1 else state.steps * len(self.sigma)

    def _prior_row(self, state: RLSState) -> Array:
        """Return a row of the prior that makes up for what c steps forget of one parameter."""
        c = len(state.R) - 1
        row = np.zeros(c + 1)
        if self.prior is not None and self.prior_std is not None:
            i = state.steps % c
            weight = np.sqrt(1.0 - self.forgetting**c) / self.prior_std[i]
            row[i], row[c] = weight, weight * self.prior[i]
        return row
