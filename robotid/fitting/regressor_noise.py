"""How far the steps of an encoder bias least squares: errors in the variables of the regressor.

A position that an encoder rounds has noisy derivatives, so the regressor W has noise E of its own,
which does not average out. Of H = W^T S^-1 W, D = E[E^T S^-1 E] is that noise, and least squares
find theta_ls = H^-1 (H - D) theta. Corrected, theta = theta_ls + (H - D)^-1 D theta_ls.

D is found by rounding once more. Rounding errors e of the same encoder on the same motion, its zero
elsewhere, are added to smoothed positions and go through the same filter, differences and
regressor; of +e and -e together what is linear in e cancels. With the scores s(theta) =
W^T S^-1 (tau - W theta):

    D theta = s(theta) - mean over e of [s_{+e}(theta) + s_{-e}(theta)] / 2

In the eigenvectors of D against H, whose eigenvalues x are the share of noise in what seems to be
known of a direction, the correction is by 1 / (1 - x); D is not known so well that directions of
nothing but noise could be corrected, so x counts up to a bound, and an error of D as an error. The
correction amplifies errors by as much; the bias is uneven over a log, so segments scatter more than
the errors do by about the same, and their scatter is taken as it is (coverages:
docs/explanation/intervals.md).

What is linear in e, [s_{+e} - s_{-e}] / 2, is the noise of the score that the encoder makes. Where
a motion is repeated so are its rounding errors, and segments of the log do not scatter as much as
their sum: the covariance of the score then grows by what the sum scatters more.

References:
    Carroll, Ruppert, Stefanski, Crainiceanu (2006), Measurement Error in Nonlinear Models, chapters
    5 (simulation extrapolation) and 7 (corrected scores).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.estimators.batch import solve_factor
from robotid.findings import Finding, listed
from robotid.fitting.recordings import Recordings
from robotid.fitting.survey import SurveyedLog, hold_log
from robotid.logs.data import Trajectory
from robotid.logs.filters import local_polynomial
from robotid.logs.measured_velocity import quantum
from robotid.logs.settings import SignalSettings
from robotid.regressor.factors import Factors, Reduction

if TYPE_CHECKING:
    from robotid.fitting.result import Fit

__all__ = [
    "RegressorNoise",
    "acceleration_noise",
    "encoder_findings",
    "find_regressor_noise",
    "rounding_errors",
    "smoothed",
    "without_noise",
]

_FEWEST, _MOST = 4, 6  # pairs of rounding errors
_SURE = 0.2  # standard errors by which the shift may be uncertain without more pairs
_WORST = 0.8  # share of noise in a direction from which it is corrected no further
_UNSURE = 0.1  # of a share of noise: its standard error
_MATTERS = 0.1  # standard errors by which parameters move, below which nothing is done
_NAMED, _WARNED = 0.5, 2.0  # standard errors of one parameter: a note, and a warning
_ALIKE = 0.1  # of the largest share of noise, from which a joint is named
_CUBIC = 5  # rows either way in which the motion is smoothed, at least
_JOINED = 4  # segments that are one, which is faster
_ROWS = 20_000  # of a log, in which the step of its positions is sought
_FREQUENCIES = 2048  # at which the noise of an acceleration is summed
_JOINTS = 4  # named in a finding


@dataclass(frozen=True, eq=False)
class RegressorNoise:
    """What the steps of the positions do to least squares.

    Attributes:
        steps: Largest step of each joint's position in the logs, shape (n,) [rad or m]; 0: none, or
            of no effect since velocities are measured.
        share: Root mean square of what they add to each acceleration, over its own, shape (n,) [-].
        shift: By how much they move base parameters, E[theta_ls] - theta, shape (b,).
        std_error: Standard errors of base parameters by residual and filter alone, without what the
            steps add to them, shape (b,); inf where the data leave them open.
        meat: Covariance of the score that the scatter of segments does not show, shape (b, b): of
            repeated rounding errors, and of the shift.
        is_corrected: Whether the estimate is corrected; otherwise its covariance has the shift.
    """

    steps: Array
    share: Array
    shift: Array
    std_error: Array
    meat: Array
    is_corrected: bool = True

    def uncorrected(self, information: Array) -> "RegressorNoise":
        """Return the same where the shift is not corrected, but counts as an error.

        Args:
            information: H = W^T S^-1 W of all rows, shape (b, b).
        """
        score = information @ self.shift
        return replace(self, meat=self.meat + np.outer(score, score), is_corrected=False)


def find_regressor_noise(
    recordings: Recordings, whole: Reduction, theta: Array, sigma: Array, level: Array
) -> RegressorNoise | None:
    """Return what the steps of the positions do to least squares; None if next to nothing.

    Args:
        recordings: The recordings. Of logs in files, the windows that are in memory stand for all.
        whole: What all of their rows come down to, base parameters.
        theta: Base parameters that least squares find in them, shape (b,).
        sigma: Noise level per joint that weighted the rows, shape (n_rows,) [N m or N].
        level: That of the residual, likewise.
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
    plain = _sums(near, [log.whole.trajectory for log in near.fitted], theta, weights)
    scale = float(factors.rows.sum() / plain.rows)  # all rows over those that are looked at
    bread = solve_factor(factors, sigma, theta).covariance
    variance = np.diag(bread @ factors.information((level * weights) ** 2) @ bread)
    error = np.sqrt(np.maximum(variance, 0.0) / recordings.share)
    error = np.where(error > 0, error, np.inf)  # inf: left open
    rng, pairs = np.random.default_rng(0), list[tuple[_Sums, _Sums]]()
    is_enough = False
    while not is_enough:
        pairs.append(_pair(near, steps, theta, weights, rng))
        pulls = np.array([plain.score - 0.5 * (one.score + two.score) for one, two in pairs])
        is_enough = _is_enough(scale * pulls @ bread / error)
    if len(pairs) < _FEWEST:
        return None
    D = np.mean([0.5 * (one.information + two.information) for one, two in pairs], axis=0)
    D, pull = scale * (D - plain.information), scale * pulls.mean(axis=0)
    root, move, unsure = without_noise(bread, D, pull)
    odd = np.array([0.5 * (one.segments - two.segments) @ root for one, two in pairs])  # (k, s, b)
    along = factors.information(weights) @ root  # what a move along each direction adds to s
    meat = (along * (scale * _repeated(odd) + unsure**2)) @ along.T
    meat = meat + scale**2 * np.cov(pulls.T) / len(pulls)
    shift = -root @ move
    return RegressorNoise(np.max(steps, axis=0), share, shift, error, meat)


def encoder_findings(fit: "Fit") -> list[Finding]:
    """Return a finding where the steps of encoders move inertial parameters.

    Args:
        fit: What was found.
    """
    noise, model = fit.regressor_noise, fit.model
    if noise is None:
        return []
    is_inertial = fit.mapping.K[:, : model.layout.n_inertial].any(axis=1)
    moved = np.where(is_inertial, np.abs(noise.shift) / noise.std_error, 0.0)
    worst = int(np.argmax(moved))
    if moved[worst] < _NAMED:
        return []
    coarse = np.flatnonzero(noise.share > _ALIKE * noise.share.max())
    names = [model.joints[j] for j in coarse]
    largest = int(coarse[np.argmax(noise.steps[coarse])])
    step, unit = float(noise.steps[largest]), "rad"
    resolution = f" ({np.log2(2 * np.pi / step):.1f} bits a turn)"
    if model.joints[largest] in model.layout.prismatic:
        unit, resolution = "m", ""
    effect = (
        "the estimate is corrected for it"
        if noise.is_corrected
        else "this estimator is not corrected for it, its standard errors count it"
    )
    message = (
        f"{listed(names, _JOINTS)}: the position has steps of up to {step:.3g} {unit}{resolution}, "
        f"which add noise of up to {100 * noise.share.max():.2g} % to the RMS acceleration. Noise "
        f"of the regressor moves {fit.mapping.base_names[worst]} by "
        f"{moved[worst]:.1f} standard errors; {effect}. A longer log does not reduce it: lower "
        "cutoff, move faster, log the velocity of the drive, or use a finer encoder"
    )
    evidence = {
        f"step_{name}": float(noise.steps[j]) for name, j in zip(names, coarse, strict=True)
    }
    evidence |= {"std_errors": float(moved[worst]), "share_pct": 100 * float(noise.share.max())}
    severity = "warning" if moved[worst] >= _WARNED else "note"
    return [Finding("encoder_noise", severity, listed(names), message, evidence)]


def smoothed(q: Array, steps: Array, width: int) -> Array:
    """Return what brings rounded positions near to what they were before, shape (N, n).

    A cubic through the rows around each, at most a step away.

    Args:
        q: Positions, without full turns, shape (N, n) [rad or m].
        steps: Steps of the encoders, shape (n,) [rad or m]; 0: none.
        width: Rows in which the motion is taken to be a cubic, odd.
    """
    rows = (len(q) - 1) // 2 * 2 + 1
    smooth = local_polynomial(q, min(width, rows), min(3, rows - 1))
    change: Array = np.clip(smooth - q, -steps, steps)
    return change


def rounding_errors(q: Array, steps: Array, rng: np.random.Generator) -> Array:
    """Return errors of encoders whose zeros lie anywhere, shape (N, n).

    Args:
        q: Positions before they are rounded, shape (N, n) [rad or m].
        steps: Steps of the encoders, shape (n,) [rad or m]; 0: none.
        rng: Source of the zeros.
    """
    count = q / np.where(steps > 0, steps, 1.0) + rng.random(q.shape[1])
    errors: Array = (np.round(count) - count) * steps
    return errors


def without_noise(bread: Array, D: Array, pull: Array) -> tuple[Array, Array, Array]:
    """Return (H - D)^-1 (D theta) in directions in which noise and information do not mix.

    Args:
        bread: Inverse of the information H, shape (b, b); 0 of what it leaves open.
        D: Noise of H, shape (b, b).
        pull: D theta, shape (b,).

    Returns:
        The directions, columns X with X X^T = H^-1 and X^T D X diagonal, shape (b, b); how far to
        go along each, as if at most 80 % of its information were noise; and how uncertain that is
        by what is not known of D, shape (b,) each.
    """
    size, axes = np.linalg.eigh(bread)
    root = axes * np.sqrt(np.maximum(size, 0.0))
    x, turn = np.linalg.eigh(root.T @ D @ root)
    root, x = root @ turn, np.clip(x, 0.0, _WORST)
    move = root.T @ pull / (1.0 - x)
    return root, move, move * _UNSURE * x / (1.0 - x)


def acceleration_noise(step: float, signals: SignalSettings) -> float:
    """Return the acceleration's root mean square of white noise of 1 on the positions [1/s^2].

    Behind the digital Butterworth filter, forward and backward, and two central differences:

    1 / (1 + (tan(pi f step) / tan(pi cutoff step))^(2 order)) and (sin(2 pi f step) / step)^2.

    Args:
        step: Time step of the rows [s].
        signals: The settings, resolved.
    """
    f = (np.arange(_FREQUENCIES) + 0.5) / (2 * _FREQUENCIES * step)
    gain = (np.sin(2 * np.pi * f * step) / step) ** 2
    if signals.cutoff is not None:
        ratio = np.tan(np.pi * f * step) / np.tan(np.pi * signals.cutoff * step)
        gain = gain / (1.0 + ratio ** (2 * signals.order))
    return float(np.sqrt(np.mean(gain**2)))


@dataclass(frozen=True, eq=False)
class _Sums:
    """What the rows of logs on some motion sum up to."""

    segments: Array  # (s, b), score W^T S^-1 (tau - W theta) of each segment
    information: Array  # (b, b), W^T S^-1 W of all rows
    rows: int

    @property
    def score(self) -> Array:
        """That of all rows, shape (b,)."""
        total: Array = self.segments.sum(axis=0)
        return total


def _is_enough(moves: Array) -> bool:
    """Return whether draws show by how much parameters move, or that it is next to nothing.

    Args:
        moves: What each of k draws says, in standard errors, shape (k, b).
    """
    count = len(moves)
    if count < _FEWEST:
        return bool((np.abs(moves.mean(axis=0)) < _MATTERS).all())
    return count >= _MOST or bool((moves.std(axis=0, ddof=1) <= _SURE * np.sqrt(count)).all())


def _sums(near: Recordings, motions: Sequence[Trajectory], theta: Array, weights: Array) -> _Sums:
    """Return what the rows sum up to if the logs in memory had moved so."""
    segments, rows = list[Array](), 0
    information = np.zeros((len(theta), len(theta)))
    for k, motion in enumerate(motions):
        factors: Factors
        for factors in near.segments(k, motion, _JOINED):
            segments.append(factors.score(theta, weights))
            information += factors.information(weights)
            rows += int(factors.rows.sum())
    return _Sums(np.array(segments), information, rows)


def _pair(
    near: Recordings,
    steps: Sequence[Array],
    theta: Array,
    weights: Array,
    rng: np.random.Generator,
) -> tuple[_Sums, _Sums]:
    """Return what the rows sum up to with rounding errors added, and subtracted."""
    logs = zip(near.fitted, steps, strict=True)
    errors = [rounding_errors(log.head.q, own, rng) for log, own in logs]

    def summed(sign: float) -> _Sums:
        pairs = zip(near.fitted, errors, strict=True)
        motions = [_shifted(log, sign * e).whole.trajectory for log, e in pairs]
        return _sums(near, motions, theta, weights)

    return summed(1.0), summed(-1.0)


def _shifted(log: SurveyedLog, change: Array) -> SurveyedLog:
    """Return a log in memory with other positions, smoothed alike."""
    source = replace(log.head, q=log.head.q + change)
    return replace(log, source=source, windows=(source,), asked=log.signals)


def _without_steps(near: Recordings, steps: Sequence[Array]) -> Recordings:
    """Return logs in memory with positions about as they were before they were rounded.

    Errors that are added are then not multiplied by those that the positions had.
    """
    logs = []
    for log, own in zip(near.fitted, steps, strict=True):
        period = 1.0 / ((log.signals.cutoff or np.inf) * log.step)  # [rows], of the filter
        width = 2 * max(_CUBIC, round(period)) + 1
        slides = np.isin(log.model.joints, list(log.model.layout.prismatic))
        q = np.where(slides, log.head.q, np.unwrap(log.head.q, axis=0))
        logs.append(_shifted(log, smoothed(q, own, width)))
    return replace(near, fitted=logs, kept=())


def _repeated(odd: Array) -> Array:
    """Return the variance of the score along each direction that segments do not show, shape (b,).

    Segments that have the same rounding errors do not scatter, but add up.

    Args:
        odd: What is linear in k draws of the errors of the score of s segments along b directions,
            shape (k, s, b).
    """
    total, scattered = odd.sum(axis=1) ** 2, (odd**2).sum(axis=1)
    more: Array = np.maximum(np.mean(total - scattered, axis=0), 0.0)
    return more


def _in_memory(recordings: Recordings) -> Recordings:
    """Return the fitted logs in memory; of those in files the windows that were looked at."""
    if all(log.is_held for log in recordings.fitted):
        return recordings
    windows = [
        hold_log(log.model, window, log.signals)
        for log in recordings.fitted
        for window in log.looks
    ]
    usable = [log for log in windows if len(log.pieces[0].read().trajectory.t)]
    return replace(recordings, fitted=usable, kept=(), plan=None, checkpoint=None)


def _steps(log: SurveyedLog) -> Array:
    """Return the steps of the positions of a log in memory, shape (n,); 0 if they do not matter.

    They do not where velocities are measured.
    """
    if log.signals.velocity == "measured":
        return np.zeros(len(log.model.joints))
    return np.array([quantum(x, repeats=False) for x in log.head.q[:_ROWS].T])


def _share(logs: Sequence[SurveyedLog], steps: Sequence[Array], whole: Reduction) -> Array:
    """Return what steps add to each acceleration over its own size, at most 1, shape (n,)."""
    noise = [
        own / np.sqrt(12.0) * acceleration_noise(log.step, log.signals)
        for log, own in zip(logs, steps, strict=True)
    ]
    own = np.sqrt(whole.squares[2] / max(whole.samples, 1))
    largest = np.max(noise, axis=0)
    share: Array = np.where(own > 0, largest / np.where(own > 0, own, 1.0), 0.0)
    return np.minimum(share, 1.0)
