"""Two runs of one robot that differ by what loads only one of them, or by gains nobody knows.

Reference run   k_j i_j = W_j beta
Loaded run      k_j i_j = W_j (beta + c + D x)

with what is known of the difference in c, and what is not in x. W D needs no rows of its own: a
body that is added has the columns of the link that it hangs on. A current i_j of unknown gain k_j
is the only thing with noise, so it stands alone, i_j = W_j (...) / k_j: bilinear, solved by
Gauss-Newton, whose step is one more column -W_j beta per gain. All of it runs on triangular
factors, and all errors come from one covariance, that of the gains included.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators.segments import FEWEST_SEGMENTS, at_least, sandwich, scatter
from robotid.exceptions import DataError, NotConvergedError
from robotid.regressor.factors import Factors, Reduction, merge, triangle_of
from robotid.robot.parameters import ParameterLayout

__all__ = ["Compared", "TwoRuns", "payload_runs"]

_WIDE = 10.0  # plausible spreads about the URDF's values within which all is sought
_FLOOR = 1e-7  # smallest noise level, as a share of the torque: noise-free data have none
_LEAST_FREEDOM = 0.1  # share of the rows that are left to tell the noise
_SINGULAR = 1e-12  # pivots of unit columns below this tell nothing
_STEPS = 50
_SETTLED = 1e-9  # relative change of the gains
_LONGEST = 1.0  # step of the logarithm of a gain


@dataclass(frozen=True, eq=False)
class Compared:
    """What two runs tell.

    Attributes:
        theta: beta and x, shape (b + d,), SI units.
        gain: Gain k of each joint's signal, shape (n,) [N m/A]; 1 of a torque.
        covariance: Covariance of beta, x and the logarithms of the u unknown gains,
            shape (b + d + u, b + d + u).
        freedom: Degrees of freedom of their standard errors, shape (b + d + u,).
        unexplained: Share of each joint's torque that is left, shape (n,) [-].
    """

    theta: Array
    gain: Array
    covariance: Array
    freedom: Array
    unexplained: Array


@dataclass(frozen=True, eq=False)
class TwoRuns:
    """Factors of two runs and what is known of their difference.

    Attributes:
        reference: Factors of the segments of the reference run, of b base parameters.
        loaded: Those of the loaded run.
        D: Columns of the difference in base parameters, shape (b, d).
        known: Known part c of the difference, shape (b,).
        mean: Plausible value of beta and x before the data, shape (b + d,).
        precision: Its inverse covariance, shape (b + d, b + d), positive definite.
        share: Share of the rows that count as independent [-].
        unknown: Joints whose gain is unknown, shape (u,), int.
    """

    reference: tuple[Factors, ...]
    loaded: tuple[Factors, ...]
    D: Array
    known: Array
    mean: Array
    precision: Array
    share: float
    unknown: Array

    def compare(self, *, by_joint: bool = True) -> Compared:
        """Fit both runs at once, and the unknown gains with them.

        Standard errors come from the scatter of the scores of segments and of joints, and are at
        least those of rows that are independent by ``share``; of fewer than 12 segments, they are
        these.

        Args:
            by_joint: Whether errors count what the joints of each run disagree about, too.

        Raises:
            NotConvergedError: If the gains do not settle.

        References:
            Gautier, Briot (2014), Global identification of joint drive gains and dynamic parameters
            of robots, Journal of Dynamic Systems, Measurement, and Control 136, section 3, whose
            total least squares this replaces.
        """
        size, u = len(self.mean), len(self.unknown)
        gain = self._first_gains()
        theta = self.alike(gain)[0]
        for _ in range(_STEPS if u else 1):
            at = theta if u else None
            solution, bread = self._minimum(self._both(gain, at), self._level(gain))
            theta, step = solution[:size], np.clip(solution[size:], -_LONGEST, _LONGEST)
            if not u or np.abs(step).max() < _SETTLED:
                break
            gain[self.unknown] *= np.exp(step)
        else:
            raise NotConvergedError(
                f"the gains still change by {np.abs(step).max():.1e} after {_STEPS} steps; record "
                "richer motions of both runs, or state some of the gains",
                "max_iterations",
            )
        covariance, freedom = self._errors(gain, at, solution, bread, by_joint)
        squares = self._both(gain, at).residual_squares(solution)
        torque = np.maximum(np.abs(gain) * np.sqrt(self._logged.torque_squares()), 1e-300)
        return Compared(theta, gain, covariance, freedom, np.sqrt(squares) / torque)

    def alike(self, gain: Array | None = None) -> tuple[Array, Array]:
        """Return beta and x as all rows that are independent by ``share`` have them.

        Args:
            gain: Gains, shape (n,); None: 1.

        Returns:
            beta and x, shape (b + d,), and their covariance, whose variances are at most those of
            ``compare``.
        """
        gain = np.ones(len(self._logged.rows)) if gain is None else gain
        return self._minimum(self._both(gain), self._level(gain))

    def held_together(self, theta: Array) -> Array:
        """Return what the runs leave together over what each joint leaves by itself, shape (n,).

        Args:
            theta: beta and x, shape (b + d,), of runs without unknown gains.

        Returns:
            Ratios of sums of squares, at least 1: far more where the runs differ by something else.
        """
        b = len(self.known)
        without, loaded = self._whole
        other = theta[:b] + self.known + self.D @ theta[b:]
        together = without.residual_squares(theta[:b]) + loaded.residual_squares(other)
        ratio: Array = together / np.maximum(self._own_squares, 1e-300)
        return ratio

    def held_by_scales(self, kept: int) -> Array:
        """Return the same if not x, but another scale of torques makes the loaded run another one.

        Args:
            kept: Number of the first unknowns of x that may differ nevertheless.

        Returns:
            The ratios with one scale of all torques, or with one of each, whichever are less.
        """
        (without, loaded), size = self._whole, len(self.known)
        one = np.ones(len(without.rows))
        beta = self._minimum(self._extended(without, 0, one, None), self._level(one))[0][:size]
        explained = np.column_stack([self.D[:, :kept], beta])
        end = size + kept
        unsure = scipy.linalg.block_diag(self.precision[:end, :end], 1.0)
        scaled = replace(self, D=explained, mean=np.append(self.mean[:end], 0.0), precision=unsure)
        left = without.residual_squares(beta)
        for j, (R, own) in enumerate(zip(loaded.triangles, loaded.columns, strict=True)):
            A = R[:, :-1] @ explained[own]
            left[j] += np.sum((R[:, -1] - A @ np.linalg.lstsq(A, R[:, -1], rcond=None)[0]) ** 2)
        of_each: Array = left / np.maximum(self._own_squares, 1e-300)
        return min(scaled.held_together(scaled.compare().theta), of_each, key=np.mean)

    def _level(self, gain: Array) -> Array:
        """Return noise levels that make all rows count as independent, shape (n,) [N m or N]."""
        level: Array = np.abs(gain) * self._noise / np.sqrt(self.share)
        return level

    @cached_property
    def _whole(self) -> tuple[Factors, Factors]:
        """Factors of all of the reference, and of all of the loaded run."""
        return merge(self.reference), merge(self.loaded)

    @cached_property
    def _logged(self) -> Factors:
        """Factors of all rows as if the runs were one."""
        return merge(self._whole)

    @cached_property
    def _own_squares(self) -> Array:
        """Squares that the parameters of each joint's own, in each run, would leave, shape (n,)."""
        own: Array = np.sum(
            [[R[-1, -1] ** 2 for R in run.triangles] for run in self._whole], axis=0
        )
        return own

    @cached_property
    def _noise(self) -> Array:
        """Noise of each joint's signal, shape (n,), never quite zero.

        A joint that rests but for a few rows leaves nothing, whatever its noise: all of its signal
        counts as noise then.
        """
        rows = np.maximum(self._logged.rows, 1)
        spent = len(self._whole) * np.array([len(own) for own in self._logged.columns])
        freedom = np.maximum(rows - spent / self.share, _LEAST_FREEDOM * rows)
        signal = np.sqrt(self._logged.torque_squares() / rows)
        left = np.where(self.share * rows > spent, np.sqrt(self._own_squares / freedom), signal)
        noise: Array = np.maximum(left, _FLOOR * signal)
        return np.where(noise > 0, noise, 1.0)

    def _first_gains(self) -> Array:
        """Return gains to start from, shape (n,): least squares of k i - W (beta + D x) = W c.

        Noise of the currents pulls them towards 0 a little.
        """
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
        """Return factors with the columns of beta, x and the unknown gains.

        Args:
            run: Factors of rows of one run, base parameters.
            loaded: 1 of the loaded run, 0 of the reference.
            gain: Gains, shape (n,).
            at: Parameters beta and x that the gains' columns -W (beta + c + D x) are taken at,
                shape (b + d,); None for no such columns.
            is_start: Whether the gains' columns are -i instead.
        """
        S, c = np.hstack([np.eye(len(self.known)), loaded * self.D]), loaded * self.known
        unknown = self.unknown.tolist() if at is not None or is_start else []
        added = range(S.shape[1] - len(S) + len(unknown))
        triangles, columns = [], []
        for j, (R, own) in enumerate(zip(run.triangles, run.columns, strict=True)):
            kept = np.flatnonzero(S[own].any(axis=0))
            W, known, torque = R[:, :-1] @ S[own], R[:, :-1] @ c[own], gain[j] * R[:, -1]
            rows = W[:, kept]
            if j in unknown:
                kept = np.append(kept, S.shape[1] + unknown.index(j))
                column = -torque if at is None else -(W @ at + known)
                rows = np.column_stack([rows, column])
                torque = 0.0 * torque if at is None else torque
            triangles.append(triangle_of(np.column_stack([rows, torque - known])))
            columns.append(kept)
        names = (*run.names, *map(str, added))
        return Factors(tuple(triangles), tuple(columns), run.rows, names)

    def _minimum(self, whole: Factors, sigma: Array) -> tuple[Array, Array]:
        """Return the minimum with the prior beside the rows, and the inverse information."""
        rows, size = whole.weighted(sigma), len(self.mean)
        root = np.zeros((size, rows.shape[1]))
        root[:, :size] = scipy.linalg.cholesky(self.precision)
        root[:, -1] = root[:, :size] @ self.mean
        stacked = np.vstack([rows, root])
        scale = np.linalg.norm(stacked[:, :-1], axis=0)
        scale[scale == 0] = 1.0
        R = triangle_of(np.column_stack([stacked[:, :-1] / scale, stacked[:, -1]]))
        if len(self.unknown) and np.abs(np.diag(R)[:-1]).min() < _SINGULAR:
            raise DataError(
                "the runs do not tell every unknown gain: a joint's current is 0 or constant, or "
                "nothing ties it to a joint of known gain or to the known mass; state its gain"
            )
        inverse = np.linalg.inv(R[:-1, :-1]) / scale[:, None]
        return inverse @ R[:-1, -1], inverse @ inverse.T

    def _errors(
        self, gain: Array, at: Array | None, solution: Array, bread: Array, by_joint: bool
    ) -> tuple[Array, Array]:
        """Return covariance and degrees of freedom; the prior adds its own uncertainty.

        Scores are compared segment by segment, which shows what changes with time, and joint by
        joint of each run, which shows what does not: a gain, friction of the day. Of a parameter
        the larger error counts. Few parts scatter less than they should by chance: it is never
        less than noise would make it.
        """
        if len(self.reference) + len(self.loaded) < FEWEST_SEGMENTS:
            return bread, np.full(len(solution), np.inf)
        runs = list(enumerate((self.reference, self.loaded)))
        segments = [self._extended(f, loaded, gain, at) for loaded, run in runs for f in run]
        covariance, freedom = self._scattered(segments, gain, solution, bread)
        whole = [self._extended(run, loaded, gain, at) for loaded, run in enumerate(self._whole)]
        joints = [_of_joint(run, j) for run in whole for j in range(len(gain))]
        if by_joint and len(joints) >= FEWEST_SEGMENTS:
            other, few = self._scattered(joints, gain, solution, bread)
            freedom = np.where(np.diag(other) > np.diag(covariance), few, freedom)
            covariance = at_least(covariance, np.diag(other))
        return at_least(covariance, np.diag(bread)), freedom

    def _scattered(
        self, parts: Sequence[Factors], gain: Array, solution: Array, bread: Array
    ) -> tuple[Array, Array]:
        """Return covariance and degrees of freedom by the scores of some parts of the rows."""
        apart, size = self.share * bread, len(self.mean)
        found = scatter(parts, solution, np.abs(gain) * self._noise, apart)
        meat = self.share**2 * found.meat
        meat[:size, :size] += self.precision
        return sandwich(bread, meat), replace(found, bread=apart).freedom()


def _of_joint(factors: Factors, joint: int) -> Factors:
    """Return the rows of one joint alone."""
    triangles = [R if j == joint else 0.0 * R for j, R in enumerate(factors.triangles)]
    rows = np.where(np.arange(len(factors.rows)) == joint, factors.rows, 0)
    return replace(factors, triangles=tuple(triangles), rows=rows)


def payload_runs(
    reference: Sequence[Reduction],
    loaded: Sequence[Reduction],
    layout: ParameterLayout,
    K: Array,
    urdf: Array,
    spread: Array,
    payloads: tuple[Array, Array, Array],
    *,
    share: float,
    unknown: Sequence[int] = (),
) -> TwoRuns:
    """Return two runs of which the loaded one carries payloads.

    They share the robot's inertias, not friction and offsets of the drives, which change with load
    and temperature.

    Args:
        reference: The segments of the run without payloads.
        loaded: Those of the run with them.
        layout: The robot's standard parameters.
        K: Map to the base parameters, shape (b, p).
        urdf: Standard parameters of the URDF, shape (p,).
        spread: How far they may plausibly be wrong, shape (p,).
        payloads: What the parameters of the payloads add to the base parameters, shape (b, c);
            the parameters that are known, NaN where not, shape (c,); and how large each may be,
            shape (c,).
        share: Share of the rows that count as independent [-].
        unknown: Joints whose torque is a current of unknown gain.
    """
    columns, known, size = payloads
    changing = [not term.is_inertia for _, term in layout.drive_parameters]
    drives = layout.n_inertial + np.flatnonzero(changing)
    free = np.isnan(known)
    KS = K * (_WIDE * spread)
    sizes = np.linalg.norm(KS, axis=1)
    alike = KS / sizes[:, None]  # base parameters in units of their spread
    about_urdf = np.linalg.inv(alike @ alike.T) / np.outer(sizes, sizes)
    change = _WIDE * np.append(spread[drives], size[free])
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
