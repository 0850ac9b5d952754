"""Two runs of one robot, without and with a load, for payloads and unknown drive gains.

Reference run   k_j i_j = W_j beta

Loaded run      k_j i_j = W_j (beta + c + D x)

The difference of the runs has a known part c and an unknown part x; an added body has the regressor
columns of its link. A current i_j of unknown gain k_j is the only noisy signal: i_j = W_j (...) /
k_j is solved by Gauss-Newton steps, with one column -W_j beta per gain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.base.tolerances import ROUNDING
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors, Reduction, merge, triangle_of
from robotid.estimation.estimators.estimator import (
    FEWEST_SEGMENTS,
    LEAST_FREEDOM,
    WEAK_PRIOR,
    at_least,
    sandwich,
    scatter,
)
from robotid.robot.parameters import ParameterLayout

_FLOOR = 1e-7  # smallest noise level over the torque, for noise-free data
_STEPS = 50
_SETTLED = 1e-9  # relative change of the gains at convergence
_LONGEST = 1.0  # largest step of the logarithm of a gain


@dataclass(frozen=True, eq=False)
class Compared:
    """Result of the comparison of two runs."""

    theta: Array  # (b + d,), beta and x, SI units
    gain: Array  # (n,), gain k of each joint's signal [N m/A]; 1 for a torque
    covariance: Array  # (b + d + u, ...), of beta, x and the logarithms of the unknown gains
    freedom: Array  # (b + d + u,), of their standard errors
    unexplained: Array  # (n,), residual of each joint over its torque [-]


@dataclass(frozen=True, eq=False)
class TwoRuns:
    """Factors of two runs, and the prior of their difference."""

    reference: tuple[Factors, ...]  # of the segments of the reference run, of b base parameters
    loaded: tuple[Factors, ...]  # of those of the loaded run
    D: Array  # (b, d), columns of the difference in base parameters
    known: Array  # (b,), known part c of the difference
    mean: Array  # (b + d,), prior mean of beta and x
    precision: Array  # (b + d, b + d), prior precision (inverse covariance), positive definite
    share: float  # of independent rows [-]
    unknown: Array  # (u,), int: joints whose gain is unknown

    def compare(self) -> Compared:
        """Fit both runs and the unknown gains together.

        Standard errors are from the scatter of the scores of segments and of joints, and at least
        those for a ``share`` of independent rows. For gains see Gautier, Briot (2014), Global
        identification of joint drive gains and dynamic parameters of robots, section 3 (total least
        squares).
        """
        size, u = len(self.mean), len(self.unknown)
        gain = self._first_gains()
        theta = self._minimum(self._both(gain), self._level(gain))[0]
        for _ in range(_STEPS if u else 1):
            at = theta if u else None
            solution, bread = self._minimum(self._both(gain, at), self._level(gain))
            theta, step = solution[:size], np.clip(solution[size:], -_LONGEST, _LONGEST)
            if not u or np.abs(step).max() < _SETTLED:
                break
            gain[self.unknown] *= np.exp(step)
        else:
            raise NotConvergedError(
                f"the gains have not converged: relative change {np.abs(step).max():.1e} after "
                f"{_STEPS} steps, expected less than {_SETTLED:g}; record motions with more "
                "excitation in both runs, or give some of the gains",
                "max_iterations",
            )
        covariance, freedom = self._errors(gain, at, solution, bread)
        squares = self._both(gain, at).residual_squares(solution)
        torque = np.maximum(np.abs(gain) * np.sqrt(self._logged.torque_squares()), 1e-300)
        return Compared(theta, gain, covariance, freedom, np.sqrt(squares) / torque)

    def _level(self, gain: Array) -> Array:
        """Return noise levels for rows treated as independent, shape (n,) [N m or N]."""
        return np.asarray(np.abs(gain) * self._noise / np.sqrt(self.share))

    @cached_property
    def _whole(self) -> tuple[Factors, Factors]:
        """Factors of the whole reference run, and of the whole loaded run."""
        return merge(self.reference), merge(self.loaded)

    @cached_property
    def _logged(self) -> Factors:
        """Factors of all rows of both runs together."""
        return merge(self._whole)

    @cached_property
    def _noise(self) -> Array:
        """Noise level of each joint's signal, above 0, from separate fits of the runs, (n,)."""
        # A joint that moves in few rows has its RMS signal, rows projected together one level.
        rows, separate = np.maximum(self._logged.rows, 1), [run.triangles for run in self._whole]
        squares: Array = np.sum([[R[-1, -1] ** 2 for R in run] for run in separate], axis=0)
        used = np.array([len(columns) for columns in self._logged.columns])
        torque = self._logged.torque_squares()
        if self._logged.is_projected:
            one = np.ones(len(rows))
            squares = sum(run.weighted(one)[-1, -1] ** 2 for run in self._whole) * one
            rows, used = max(self._logged.rows.sum(), 1) * one, len(self.known) * one
            torque = torque.sum() * one
        used = len(self._whole) * used
        freedom = np.maximum(rows - used / self.share, LEAST_FREEDOM * rows)
        signal = np.sqrt(torque / rows)
        is_seen = self._logged.is_projected | (self.share * rows > used)
        noise = np.where(is_seen, np.sqrt(squares / freedom), signal)
        noise = np.maximum(noise, _FLOOR * signal)
        return np.where(noise > 0, noise, 1.0)

    def _first_gains(self) -> Array:
        """Return initial gains, (n,): least squares of k i - W (beta + D x) = W c, with a bias."""
        gain = np.ones(len(self._logged.rows))
        if len(self.unknown):
            solution = self._minimum(self._both(gain, is_start=True), self._noise)[0]
            gain[self.unknown] = solution[len(self.mean) :]
        return gain

    def _both(self, gain: Array, at: Array | None = None, *, is_start: bool = False) -> Factors:
        """Return the factors of both runs with the columns of ``_extended``."""
        runs = enumerate(self._whole)
        return merge([self._extended(run, loaded, gain, at, is_start) for loaded, run in runs])

    def _extended(
        self, run: Factors, loaded: int, gain: Array, at: Array | None, is_start: bool = False
    ) -> Factors:
        """Return factors with the columns of beta, x and the gains: gain (n,), at (b + d,)."""
        S, c = np.hstack([np.eye(len(self.known)), loaded * self.D]), loaded * self.known
        unknown = self.unknown.tolist() if at is not None or is_start else []
        added = range(S.shape[1] - len(S) + len(unknown))
        triangles, columns = [], []
        for j, (R, base) in enumerate(zip(run.triangles, run.columns, strict=True)):
            used = np.flatnonzero(S[base].any(axis=0))
            W, known, torque = R[:, :-1] @ S[base], R[:, :-1] @ c[base], gain[j] * R[:, -1]
            rows = W[:, used]
            if j in unknown:
                used = np.append(used, S.shape[1] + unknown.index(j))
                column = -torque if at is None else -(W @ at + known)
                rows = np.column_stack([rows, column])
                torque = 0.0 * torque if at is None else torque
            triangles.append(triangle_of(np.column_stack([rows, torque - known])))
            columns.append(used)
        names = (*run.names, *map(str, added))
        return Factors(
            tuple(triangles), tuple(columns), run.rows, names, is_projected=run.is_projected
        )

    def _minimum(self, factors: Factors, sigma: Array) -> tuple[Array, Array]:
        """Return the minimum of rows and prior, and the inverse information."""
        rows, size = factors.weighted(sigma), len(self.mean)
        root = np.zeros((size, rows.shape[1]))
        root[:, :size] = scipy.linalg.cholesky(self.precision)
        root[:, -1] = root[:, :size] @ self.mean
        stacked = np.vstack([rows, root])
        scale = np.linalg.norm(stacked[:, :-1], axis=0)
        scale[scale == 0] = 1.0
        R = triangle_of(np.column_stack([stacked[:, :-1] / scale, stacked[:, -1]]))
        if len(self.unknown) and np.abs(np.diag(R)[:-1]).min() < ROUNDING:
            raise DataError(
                "an unknown gain is not identifiable: the current of a joint is 0 or constant, or "
                "it is not coupled to a joint of known gain or to the known mass; set the gain "
                "of this joint"
            )
        inverse = np.linalg.inv(R[:-1, :-1]) / scale[:, None]
        return inverse @ R[:-1, -1], inverse @ inverse.T

    def _errors(
        self, gain: Array, at: Array | None, solution: Array, bread: Array
    ) -> tuple[Array, Array]:
        """Return covariance and degrees of freedom, including the uncertainty of the prior."""
        # The scatter between segments has errors that vary with time, that between the joints of
        # each run constant ones, as of a gain or of friction. The larger standard error is used,
        # and at least that of independent noise.
        if len(self.reference) + len(self.loaded) < FEWEST_SEGMENTS:
            return bread, np.full(len(solution), np.inf)
        runs = list(enumerate((self.reference, self.loaded)))
        segments = [self._extended(f, loaded, gain, at) for loaded, run in runs for f in run]
        covariance, freedom = self._scattered(segments, gain, solution, bread)
        both = [self._extended(run, loaded, gain, at) for loaded, run in enumerate(self._whole)]
        joints = [_of_joint(run, j) for run in both for j in range(len(gain))]
        is_alone = not self._logged.is_projected  # else the rows of joints are mixed
        if is_alone and len(joints) >= FEWEST_SEGMENTS:
            other, few = self._scattered(joints, gain, solution, bread)
            freedom = np.where(np.diag(other) > np.diag(covariance), few, freedom)
            covariance = at_least(covariance, np.diag(other))
        return at_least(covariance, np.diag(bread)), freedom

    def _scattered(
        self, parts: Sequence[Factors], gain: Array, solution: Array, bread: Array
    ) -> tuple[Array, Array]:
        """Return covariance and degrees of freedom from the scores of parts of the rows."""
        scores = scatter(parts, solution, np.abs(gain) * self._noise, self.share * bread)
        meat, size = self.share**2 * scores.meat, len(self.mean)
        meat[:size, :size] += self.precision
        return sandwich(bread, meat), scores.freedom()


def _of_joint(factors: Factors, joint: int) -> Factors:
    """Return the factors with the rows of one joint only."""
    triangles = tuple(R if j == joint else 0.0 * R for j, R in enumerate(factors.triangles))
    rows = np.where(np.arange(len(factors.rows)) == joint, factors.rows, 0)
    return replace(factors, triangles=triangles, rows=rows)


def payload_runs(
    reference: Sequence[Reduction], loaded: Sequence[Reduction], layout: ParameterLayout, K: Array,
    urdf: Array, spread: Array, payloads: tuple[Array, Array, Array], *, share: float,
    unknown: Sequence[int] = (),
) -> TwoRuns:  # fmt: skip
    """Return the comparison of a run without and a run with payloads.

    Friction and offsets differ, as they change with load and temperature, inertias do not. Payloads
    are columns (b, c), known values (c,), NaN for unknown ones, and their spread (c,).
    """
    columns, known, size = payloads
    changing = [not term.is_inertia for _, term in layout.drive_parameters]
    drives = layout.n_inertial + np.flatnonzero(changing)
    free = np.isnan(known)
    KS = K * (WEAK_PRIOR * spread)
    sizes = np.linalg.norm(KS, axis=1)
    alike = KS / sizes[:, None]  # base parameters in units of their spread
    about_urdf = np.linalg.inv(alike @ alike.T) / np.outer(sizes, sizes)
    change = WEAK_PRIOR * np.append(spread[drives], size[free])
    return TwoRuns(
        tuple(reduction.factors for reduction in reference),
        tuple(reduction.factors for reduction in loaded),
        np.hstack([K[:, drives], columns[:, free]]),
        columns @ np.nan_to_num(known),
        np.append(K @ urdf, np.zeros(len(change))),
        scipy.linalg.block_diag(0.5 * (about_urdf + about_urdf.T), np.diag(change**-2.0)),
        share,
        np.array(unknown, dtype=int),
    )
