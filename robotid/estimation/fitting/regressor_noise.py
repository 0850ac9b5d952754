"""Bias of least squares due to encoder quantisation: errors in the variables of the regressor.

The derivatives of a quantised position are noisy, and so is the regressor W: H = W^T S^-1 W
contains D = E[E^T S^-1 E] of its noise E, and least squares gives theta_ls = H^-1 (H - D) theta.
The corrected estimate is theta = theta_ls + (H - D)^-1 D theta_ls. D is estimated by rounding
errors e of the same encoder with a random zero, added to smoothed positions. Terms linear in e
cancel in the mean of +e and -e; with the scores s(theta) = W^T S^-1 (tau - W theta):

    D theta = s(theta) - mean over e of [s_{+e}(theta) + s_{-e}(theta)] / 2

The eigenvalues x of D relative to H are the shares of noise in the information along the
eigenvectors, where the correction is a factor of 1 / (1 - x), which amplifies errors likewise. x is
limited by a bound, and the error of D counts as an error of the estimate (coverages:
docs/explanation/intervals.md). The part linear in e, [s_{+e} - s_{-e}] / 2, is the noise of the
score due to the encoder. If a motion repeats, so do its rounding errors, and segments scatter less
than their sum: the difference is added to the covariance of the score. Carroll, Ruppert, Stefanski,
Crainiceanu (2006), Measurement Error in Nonlinear Models, chapters 5 (simulation extrapolation) and
7 (corrected scores).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.typing import Array
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import local_polynomial
from robotid.data.units import quantum
from robotid.dynamics.factors import Reduction
from robotid.estimation.estimators.batch import solve_factor
from robotid.estimation.fitting.recorded import WINDOW, Recordings, SurveyedLog, hold_log

_FEWEST, _MOST = 4, 6  # pairs of rounding errors
_PRECISE = 0.2  # uncertainty of the shift in standard errors at which no more pairs are drawn
_WORST = 0.8  # largest share of noise in a direction that is corrected
_SHARE_ERROR = 0.1  # relative standard error of a share of noise
_MATTERS = 0.1  # shift of the parameters in standard errors below which nothing is corrected
_CUBIC = 5  # smallest number of rows on each side for smoothing
_JOINED = 4  # segments that are joined into one, for speed
_FREQUENCIES = 2048  # frequencies at which the noise of an acceleration is summed


@dataclass(frozen=True, eq=False)
class RegressorNoise:
    """Effect of position quantisation on least squares."""

    steps: Array  # (n,), quantisation of positions [rad or m]; 0: none, or velocities are measured
    share: Array  # (n,), RMS of the quantisation noise of each acceleration over its RMS [-]
    shift: Array  # (b,), bias of the base parameters, E[theta_ls] - theta
    std_error: Array  # (b,), of base parameters without the quantisation; inf: not identifiable
    meat: Array  # (b, b), of the score: repeated rounding errors and the shift, without scatter
    is_corrected: bool = True  # if the estimate is not corrected, its covariance has the shift

    def uncorrected(self, information: Array) -> "RegressorNoise":
        """Return the same with the shift counted as an error instead: information (b, b)."""
        score = information @ self.shift
        return replace(self, meat=self.meat + np.outer(score, score), is_corrected=False)


def find_regressor_noise(
    recordings: Recordings, whole: Reduction, theta: Array, sigma: Array, level: Array
) -> RegressorNoise | None:
    """Return the effect of position quantisation on least squares; None if it is negligible.

    theta (b,), of weights by sigma (n_rows,) [N m or N], of rows of the noise level (n_rows,).
    """
    model, factors, weights = recordings.model, whole.factors, 1.0 / sigma**2
    if model.is_static or model.free_flyer:
        return None
    near = _in_memory(recordings)
    if not near.fitted:
        return None
    steps = [_steps(log) for log in near.fitted]
    share = _share(near.fitted, steps, whole)
    size = np.sqrt(recordings.share * theta @ factors.information(1.0 / level**2) @ theta)
    if share.max() ** 2 * size < _MATTERS:
        return None
    near = _without_steps(near, steps)
    plain = _sums(near, near.fitted, theta, weights)
    scale = float(factors.rows.sum() / plain.rows)  # all rows over those in memory
    bread = solve_factor(factors, sigma, theta).covariance
    variance = np.diag(bread @ factors.information((level * weights) ** 2) @ bread)
    error = np.sqrt(np.maximum(variance, 0.0) / recordings.share)
    error = np.where(error > 0, error, np.inf)  # inf: not identifiable
    rng, pairs = np.random.default_rng(0), list[tuple[_Sums, _Sums]]()
    is_enough = False
    while not is_enough:
        logs = zip(near.fitted, steps, strict=True)
        errors = [rounding_errors(log.head.q, step, rng) for log, step in logs]
        more, less = (
            _sums(near, list(map(_shifted, near.fitted, changes)), theta, weights)
            for changes in (errors, [-e for e in errors])
        )
        pairs.append((more, less))
        draws = np.array([plain.score - 0.5 * (one.score + two.score) for one, two in pairs])
        is_enough = _is_enough(scale * draws @ bread / error)
    if len(pairs) < _FEWEST:
        return None
    D = np.mean([0.5 * (one.information + two.information) for one, two in pairs], axis=0)
    D, D_theta = scale * (D - plain.information), scale * draws.mean(axis=0)
    root, move, error_of_move = without_noise(bread, D, D_theta)
    linear = np.array([0.5 * (one.segments - two.segments) @ root for one, two in pairs])
    # segments with the same rounding errors do not scatter, but their errors add up
    repeated = np.mean(linear.sum(axis=1) ** 2 - (linear**2).sum(axis=1), axis=0)  # (b,)
    along = factors.information(weights) @ root  # change of the score per move along a direction
    meat = (along * (scale * np.maximum(repeated, 0.0) + error_of_move**2)) @ along.T
    meat = meat + scale**2 * np.cov(draws.T) / len(draws)
    return RegressorNoise(np.max(steps, axis=0), share, -root @ move, error, meat)


def smoothed(q: Array, steps: Array, width: int) -> Array:
    """Return the change, at most one step, of positions q (N, n) to a cubic around each sample."""
    rows = (len(q) - 1) // 2 * 2 + 1
    smooth = local_polynomial(q, min(width, rows), min(3, rows - 1))
    return np.asarray(np.clip(smooth - q, -steps, steps))


def rounding_errors(q: Array, steps: Array, rng: np.random.Generator) -> Array:
    """Return rounding errors of encoders with random zeros at positions q, shape (N, n)."""
    count = q / np.where(steps > 0, steps, 1.0) + rng.random(q.shape[1])
    return np.asarray((np.round(count) - count) * steps)


def without_noise(bread: Array, D: Array, D_theta: Array) -> tuple[Array, Array, Array]:
    """Return directions (b, b) with H and D diagonal, the move (H - D)^-1 D theta and its error."""
    size, axes = np.linalg.eigh(bread)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    x, rotation = np.linalg.eigh(root.T @ D @ root)
    root, x = root @ rotation, np.clip(x, 0.0, _WORST)
    move = root.T @ D_theta / (1.0 - x)
    return root, move, move * _SHARE_ERROR * x / (1.0 - x)


def acceleration_noise(step: float, signals: SignalSettings) -> float:
    """Return the RMS acceleration due to white position noise of RMS 1 [1/s^2].

    Its filters are Butterworth's, forward and backward, 1 / (1 + (tan(pi f step) / tan(pi cutoff
    step))^(2 order)), and two central differences, (sin(2 pi f step) / step)^2.
    """
    f = (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES * step)
    gain = (np.sin(2 * np.pi * f * step) / step) ** 2
    if signals.cutoff is not None:
        ratio = np.tan(np.pi * f * step) / np.tan(np.pi * signals.cutoff * step)
        gain = gain / (1.0 + ratio ** (2 * signals.order))
    return float(np.sqrt(np.mean(gain**2)))


@dataclass(frozen=True, eq=False)
class _Sums:
    """Score and information of the rows of logs for some motion."""

    segments: Array  # (s, b), score W^T S^-1 (tau - W theta) of each segment
    information: Array  # (b, b), W^T S^-1 W of all rows
    rows: int

    @property
    def score(self) -> Array:
        """Score of all rows, shape (b,)."""
        return np.asarray(self.segments.sum(axis=0))


def _is_enough(moves: Array) -> bool:
    """Return whether the shift of the parameters by pairs (k, b) is precise, or negligible."""
    count = len(moves)
    if count < _FEWEST:
        return bool((np.abs(moves.mean(axis=0)) < _MATTERS).all())
    return count >= _MOST or bool((moves.std(axis=0, ddof=1) <= _PRECISE * np.sqrt(count)).all())


def _sums(near: Recordings, logs: Sequence[SurveyedLog], theta: Array, weights: Array) -> _Sums:
    """Return the sums over the rows of the logs in memory, for the motions of other ones."""
    motions = [log.whole.trajectory for log in logs]
    parts = [part for k, motion in enumerate(motions) for part in near.segments(k, motion, _JOINED)]
    information = np.sum([part.information(weights) for part in parts], axis=0)
    rows = sum(int(part.rows.sum()) for part in parts)
    return _Sums(np.array([part.score(theta, weights) for part in parts]), information, rows)


def _shifted(log: SurveyedLog, change: Array) -> SurveyedLog:
    """Return a log in memory with changed positions, smoothed in the same way."""
    source = replace(log.head, q=log.head.q + change)
    return replace(log, source=source, windows=(source,), asked=log.signals, given=None)


def _without_steps(near: Recordings, steps: Sequence[Array]) -> Recordings:
    """Return logs with smoothed positions, so that added rounding errors are alone."""
    logs = []
    for log, step in zip(near.fitted, steps, strict=True):
        period = 1.0 / ((log.signals.cutoff or np.inf) * log.step)  # [rows], of the filter
        width = 2 * max(_CUBIC, round(period)) + 1
        is_prismatic = np.isin(log.model.joints, list(log.model.layout.prismatic))
        q = np.where(is_prismatic, log.head.q, np.unwrap(log.head.q, axis=0))
        logs.append(_shifted(log, smoothed(q, step, width)))
    return replace(near, fitted=logs, validation=())


def _in_memory(recordings: Recordings) -> Recordings:
    """Return the fitted logs in memory; for logs in files, their windows in memory."""
    logs = recordings.fitted
    if all(log.is_in_memory for log in logs):
        return recordings
    windows = [hold_log(log.model, look, log.signals) for log in logs for look in log.looks]
    usable = [log for log in windows if len(log.pieces[0].read().trajectory.t)]
    return replace(recordings, fitted=usable, validation=(), plan=None)


def _steps(log: SurveyedLog) -> Array:
    """Return the quantisation steps of a log's positions, (n,); 0 if velocities are measured."""
    if log.signals.velocity == "measured":
        return np.zeros(len(log.model.joints))
    return np.array([quantum(x, repeats=False) for x in log.head.q[:WINDOW].T])


def _share(logs: Sequence[SurveyedLog], steps: Sequence[Array], whole: Reduction) -> Array:
    """Return the quantisation noise of each acceleration over its RMS, at most 1, shape (n,)."""
    gains = [acceleration_noise(log.step, log.signals) for log in logs]
    noise = np.max(np.array(gains)[:, None] * steps / np.sqrt(12.0), axis=0)
    rms = np.sqrt(whole.squares[2] / max(whole.samples, 1))
    share = np.divide(noise, rms, out=np.zeros_like(noise), where=rms > 0)
    return np.asarray(np.minimum(share, 1.0))
