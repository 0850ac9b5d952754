"""Whether another zero, scale of angles, of time or of a torque would explain what a fit leaves.

Positions, velocities, accelerations and torques enter the equation of motion unlike masses do:
gravity knows angles and no time, the torque of every joint knows the masses beyond it. With the
torque f(q, v, a) of weighted least squares, a fault x adds its column to the base regressor:

    zero of joint j off by x   -df/dq_j
    angles times 1 + x         -(f_q q + f_v v + f_a a)
    time times 1 + x           f_v v + 2 f_a a
    torque j times 1 + x       f_j in the rows of joint j

A column of x, fitted together with the base parameters (their covariance before the data is the
prior's), is a fault if it is many standard errors large and if recordings that were kept apart
confirm it. One factor of all torques is in the span of the masses: no recording shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.findings import Finding
from robotid.identification.evaluation import Evaluation
from robotid.logs.data import Trajectory
from robotid.regressor.prediction import predict
from robotid.regressor.torque import joint_torque_regressor
from robotid.regressor.used_rows import independent_share

if TYPE_CHECKING:
    from robotid.identification.pipeline import Identification

__all__ = ["calibration_findings"]

_ROWS = 1500  # of the fitted recordings, and of those kept apart, that are compared
_STEP = 1e-4  # [rad, m or 1] of difference quotients
_CERTAIN = 8.0  # standard errors from which a fault is believed,
_CONFIRMED = 0.05  # if it explains this share of what is left of recordings kept apart
_LEAST = {"position_offset": 0.01, "angle_scale": 0.01, "time_scale": 0.01, "torque_scale": 0.05}
_TINY = 1e-12  # [N m or N] of an exact residual
_FREE = 10.0  # spreads before the data that base parameters may move by
_MOST = 4  # faults that are named
_SAID = {
    "time_scale": "the motion obeys gravity with time stamps divided by {factor:.3f}; check the "
    "unit and the rate of the clock",
    "angle_scale": "the motion obeys gravity with angles divided by {factor:.3f}; check the unit "
    "and the gear ratio of the positions",
    "position_offset": "the zero of {joint} is off by about {fault:.3f}; correct q_{joint}, or the "
    "joint's origin in the URDF",
    "torque_scale": "the torque of {joint} is {factor:.2f} x what the other torques imply; check "
    "its gain",
}


@dataclass(frozen=True)
class _Trial:
    """What a fault explains beside the base parameters and the faults before it."""

    size: float
    std_errors: float  # its size in them
    fitted: float  # squared residual that is left
    kept: float  # ... of the recordings kept apart


def calibration_findings(found: Identification) -> list[Finding]:
    """Return a warning for each fault of zeros or scales that explains what the fit leaves.

    Args:
        found: What was identified. Without a recording that was kept apart nothing is found.
    """
    kept = [e for e in found.validation if not e.is_refitted]
    if found.model.free_flyer or not kept:
        return []
    names = _names(found)
    b, size = len(found.base), len(found.base) + len(names)
    own, other = (_rows(found, some) for some in (found.fitted, kept))
    own = np.vstack([own, np.eye(size, size + 1)])  # 0 +- 1 before the data
    own, other = (np.asarray(np.linalg.qr(rows, mode="r")) for rows in (own, other))
    chosen: list[int] = []
    findings = []
    before = _try(own, other, b, [])
    while len(chosen) < _MOST:
        trials = {
            k: _try(own, other, b, [*chosen, k]) for k in range(len(names)) if k not in chosen
        }
        sure = {
            k: trial
            for k, trial in trials.items()
            if trial.std_errors > _CERTAIN
            and abs(trial.size) > _LEAST[names[k][0]]
            and trial.kept < (1.0 - _CONFIRMED) * before.kept
        }
        if not sure:
            break
        best = min(sure, key=lambda k: sure[k].fitted)
        share = 1.0 - sure[best].kept / before.kept
        findings.append(_finding(*names[best], sure[best].size, share))
        chosen.append(best)
        before = sure[best]
    return findings


def _finding(code: str, joint: str, fault: float, share: float) -> Finding:
    said = _SAID[code].format(joint=joint, fault=fault, factor=1.0 + fault)
    message = (
        f"{said}. So read, {100 * share:.0f} % of the squared residual of the recordings that were "
        "not fitted goes"
    )
    evidence = {"fault": fault, "share_pct": 100 * share}
    return Finding(code, "warning", joint or "recordings", message, evidence)


def _try(own: Array, other: Array, b: int, which: Sequence[int]) -> _Trial:
    """Fit b base parameters and some faults to triangular factors of [W F r]."""
    columns = [*range(b), *(b + k for k in which)]
    R = np.asarray(np.linalg.qr(own[:, [*columns, -1]], mode="r"))
    x = np.linalg.solve(R[:-1, :-1], R[:-1, -1])
    kept = float(np.sum((other[:, -1] - other[:, columns] @ x) ** 2))
    std_errors = abs(float(x[-1] * R[-2, -2]))
    return _Trial(float(x[-1]), std_errors, float(R[-1, -1] ** 2), kept)


def _names(found: Identification) -> list[tuple[str, str]]:
    """Return code and joint of each fault, in the order of its column."""
    joints = found.model.joints
    whole = [("time_scale", ""), ("angle_scale", "")]
    zeros = [("position_offset", joint) for joint in joints]
    return [*whole, *zeros, *(("torque_scale", joint) for joint in joints)]


def _rows(found: Identification, evaluations: Sequence[Evaluation]) -> Array:
    """Return rows [W F r] spread over recordings, over their usual residual, 0 if not used.

    W is the regressor of the base parameters over their spread before the data, F has the columns
    of the faults, r is what the result leaves.
    """
    model, mapping, metrics = found.model, found.mapping, found.metrics("wls").per_joint
    scale = [metrics[joint].rmse if joint in metrics else np.inf for joint in model.row_names]
    # over their spread before the data, C = U^T U, base parameters are of size 1
    U = _FREE * np.asarray(np.linalg.qr((mapping.K * found.prior_std).T, mode="r"))
    step = -(-sum(len(e.recording.trajectory.t) for e in evaluations) // _ROWS)
    parts = []
    for e in evaluations:
        motion = e.recording.trajectory.every(step)
        share = min(1.0, step * independent_share(e.recording.signals))
        weight = e.recording.mask[::step] * np.sqrt(share) / np.maximum(scale, _TINY)  # (N, n)
        Y = joint_torque_regressor(model, motion.q, motion.v, motion.a, motion.direction)
        Y = Y.reshape(*weight.shape, -1)[:, :, mapping.independent] @ U.T
        r = motion.tau - e.torques["wls"][::step]
        columns = np.concatenate([Y, _faults(found, motion), r[:, :, None]], axis=2)
        parts.append((weight[:, :, None] * columns).reshape(-1, columns.shape[2]))
    return np.vstack(parts)


def _faults(found: Identification, motion: Trajectory) -> Array:
    """Return the columns of the faults, shape (N, n, 2 + 2 n)."""
    model, n = found.model, len(found.model.joints)
    q, v, a = motion.q, motion.v, motion.a
    pi = found.mapping.to_standard(found.wls.theta, found.prior, found.prior_std)

    def f(q: Array, v: Array, a: Array) -> Array:
        return predict(model, [pi], replace(motion, q=q, v=v, a=a))[0]

    def slope(dq: Array, dv: Array, da: Array) -> Array:
        ahead, behind = (f(q + h * dq, v + h * dv, a + h * da) for h in (_STEP, -_STEP))
        return (ahead - behind) / (2 * _STEP)

    turns = np.array([joint not in model.layout.prismatic for joint in model.joints], dtype=float)
    still = np.zeros_like(q)
    time = slope(still, v, 2 * a)
    angles = -slope(turns * q, turns * v, turns * a)
    zeros = [-slope(still + row, still, still) for row in np.eye(n)]
    own = f(q, v, a)
    gains = [own * row for row in np.eye(n)]
    return np.stack([time, angles, *zeros, *gains], axis=2)
