"""Robust fits by iteratively reweighted least squares, and the detection of outliers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.factors import join
from robotid.dynamics.torque import predict
from robotid.estimation.estimators import WLS
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.recorded import Recordings
from robotid.robot.drive_term import DriveMotion
from robotid.robot.model import RobotModel

#: Losses with a bounded influence of each row, and their tuning constants in standard deviations,
#: for an efficiency of 95 % under normal noise.
LOSSES = {"huber": 1.345, "tukey": 4.685}
_MAD = 1.4826  # standard deviations of normal noise per median absolute deviation
_TOLERANCE = 1e-3  # change of the parameters in standard errors that ends the iteration
_MAX_ITERATIONS = 50
_OUTLIER = 12.0  # smallest residual of an outlier in standard deviations
_MATTERS = 0.1  # ... and relative to the joint's RMS torque
_NEAR = 0.5  # [s] rows closer than this are one outlier: the filter spreads it


@dataclass(frozen=True)
class Outlier:
    """A row, or rows close to each other, with a very large residual."""

    log: str  # the file
    joint: str
    t: float  # time of the row with the largest residual [s]
    torque: float  # filtered torque of that row [N m or N]
    predicted: float  # predicted torque [N m or N]
    size: float  # their difference over the joint's typical residual [-]
    rows: int  # number of rows


def loss_weight(loss: str, r: Array) -> Array:
    """Return the weights psi(r) / r of rows in the equivalent least squares problem, 0 to 1.

    Huber (1964), Robust estimation of a location parameter; Beaton, Tukey (1974), The fitting of
    power series.
    """
    size, bound = np.abs(r), LOSSES[loss]
    if loss == "huber":
        return np.asarray(bound / np.maximum(size, bound))
    return np.asarray(np.maximum(1.0 - (size / bound) ** 2, 0.0) ** 2)


def loss_slope(loss: str, r: Array) -> Array:
    """Return psi'(r), the derivative of the loss's influence function, at most 1."""
    u = (r / LOSSES[loss]) ** 2
    return np.where(u < 1.0, 1.0 if loss == "huber" else (1.0 - u) * (1.0 - 5.0 * u), 0.0)


def reweigh(recordings: Recordings, loss: str, prior: Array) -> tuple[Recordings, float]:
    """Downweight rows with large residuals until the fit converges: prior (p,).

    The scale of each joint's residual is its median absolute deviation. "tukey", which gives
    outliers a weight of 0, starts from the result of "huber", whose minimum is unique.
    """
    if not recordings.is_in_memory:
        raise SettingsError(
            f"robust = {loss!r} needs all rows in memory, for several passes; increase "
            "rows_in_memory in [reduction], shorten the log with start and end, or set "
            "robust = 'none'"
        )
    mapping, weighted = recordings.mapping, recordings
    wls = WLS(prior=mapping.to_base(prior))
    for stage in ("huber",) if loss == "huber" else ("huber", "tukey"):
        before = None
        for _ in range(_MAX_ITERATIONS):
            fit = wls.fit(join(weighted.reduce(is_cut=False)).factors)
            if before is not None:
                moved = np.abs(fit.theta - before) / np.maximum(fit.std_error, 1e-300)
                if moved.max() < _TOLERANCE:
                    break
            before = fit.theta
            residuals = _scaled_residuals(recordings, mapping.to_standard(fit.theta, prior))
            weighted = replace(recordings, weights=tuple(loss_weight(stage, r) for r in residuals))
        else:
            raise NotConvergedError(
                f"the weights of the {stage} loss have not converged after {_MAX_ITERATIONS} "
                "passes; check whether the logs are of different robots, or set robust = 'none'",
                "max_iterations",
            )
    used = np.concatenate([log.whole.mask.ravel() for log in recordings.fitted])
    scaled = np.concatenate([r.ravel() for r in residuals])[used]
    weight = loss_weight(loss, scaled)
    slope = float(loss_slope(loss, scaled).mean())  # >= 0.03: half of the rows are below 0.7
    return weighted, float(weight.mean()) / slope


def find_outliers(
    model: RobotModel, evaluations: Sequence[Evaluation], standard: Array
) -> tuple[Outlier, ...]:
    """Return the rows with very large residuals, the largest first: standard (p,).

    Near a reversal, within 1 / cutoff [s] of the filtered motion, an error of the step of Coulomb
    friction is accepted: during stiction it can have any value between its bounds.
    """
    outliers: list[Outlier] = []
    step = _friction_step(model, standard)
    for e in evaluations:
        motion, mask, prediction = e.recording.trajectory, e.recording.mask, e.torques["estimate"]
        error = np.abs(motion.tau - prediction)
        near = 1.0 / (e.recording.signals.cutoff or np.inf)  # [s]
        reverses = (np.abs(motion.v) <= near * np.abs(motion.a)) | _is_reversed(motion, near)
        excess = error - np.where(reverses, step, 0.0)
        rms = np.sqrt(np.mean(motion.tau**2, axis=0))
        matters = (excess >= _MATTERS * rms) & (rms > 0.0)  # a passive joint has no torque
        sizes = np.where(matters, excess / _scales([error], [mask]), 0.0)
        log = Path(e.recording.log.path).name or "log"
        for j, joint in enumerate(model.row_names):
            rows = np.flatnonzero((sizes[:, j] >= _OUTLIER) & mask[:, j])
            edges = np.flatnonzero(np.diff(motion.t[rows]) > _NEAR) + 1
            for close in np.split(rows, edges) if len(rows) else ():
                k = close[np.argmax(sizes[close, j])]
                tau, wanted, size = (float(x[k, j]) for x in (motion.tau, prediction, sizes))
                t = float(motion.t[k])
                outliers.append(Outlier(log, joint, t, tau, wanted, size, len(close)))
    return tuple(sorted(outliers, key=lambda outlier: -outlier.size))


def _is_reversed(motion: Trajectory, near: float) -> Array:
    """Return whether each velocity changes its sign within a time, before or after a sample."""
    t, is_near = motion.t, np.zeros(motion.v.shape, dtype=bool)
    within = (np.diff(motion.segment) == 0)[:, None]
    for j, changes in enumerate((within & (motion.v[1:] * motion.v[:-1] < 0.0)).T):
        before, after = t[:-1][changes], t[1:][changes]  # times of the samples around the change
        started = np.searchsorted(before, t + near, side="right")
        is_near[:, j] = started > np.searchsorted(after, t - near)
    return is_near


def _friction_step(model: RobotModel, standard: Array) -> Array:
    """Return the change of torque at a reversal of each joint, shape (n_rows,) [N m or N]."""
    layout, still, step = model.layout, np.zeros(1), np.zeros(model.n_rows)
    forth, back = (
        DriveMotion(still, still, still, sign * np.ones(1), still, still) for sign in (1.0, -1.0)
    )
    change = [(x.column(forth) - x.column(back)).item() for _, x in layout.drive_parameters]
    theta = standard[layout.n_inertial :]
    step[model.n_rows - len(model.joints) :] = np.abs(layout.drive_loads * theta) @ np.abs(change)
    return step


def _scaled_residuals(recordings: Recordings, standard: Array) -> list[Array]:
    """Return the residuals of each recording in standard deviations of each joint's residual."""
    rows = [log.whole for log in recordings.fitted]
    motions = [r.trajectory for r in rows]
    residuals = [m.tau - predict(recordings.model, [standard], m)[0] for m in motions]
    scales = _scales(residuals, [r.mask for r in rows])
    return [residual / scales for residual in residuals]


def _scales(residuals: Sequence[Array], masks: Sequence[Array]) -> Array:
    """Return the scale of each joint's residual from its median absolute value, (n_rows,)."""
    size, mask = np.abs(np.concatenate(residuals)), np.concatenate(masks)
    scales = [
        _MAD * float(np.median(column[used])) if used.any() else np.inf
        for column, used in zip(size.T, mask.T, strict=True)
    ]
    # residuals of rounding size, of noise-free data, contain no outliers
    return np.maximum(scales, max(1e-9 * float(size.max()), 1e-300))
