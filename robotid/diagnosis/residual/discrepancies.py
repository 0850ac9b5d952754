"""Tests for recordings or URDFs that differ from what was stated: offsets, scales, clock, origins.

Other masses cannot imitate any of these: each changes the predicted torque tau(q, v, a) in its own
way. To first order, in all joints together,

    tau_measured - tau = W delta + Z x + e,    Z = d tau / d x,

where W delta is the effect of other base parameters. x is the size of the difference, with its
standard error. It is refitted with one segment of the recordings held out after the other
(``misfit``).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.residual.decisions import (
    ALTERATION,
    ALTERATION_P_VALUE,
    ALTERATION_SHARE,
    CONFIRMED,
    SIGNIFICANT,
    WEAK,
    WEAK_P_VALUE,
    WEAK_SIZE,
    Round,
    select,
)
from robotid.diagnosis.residual.misfit import Misfit, find_misfits
from robotid.diagnosis.residual.term_trials import Sample, Trials, along
from robotid.dynamics.prediction import body_slopes, drive_torque, inverse_dynamics
from robotid.estimation.fitting.fitted import Fit
from robotid.robot.model import RobotModel

_Applied = Callable[[Array], tuple[RobotModel, Sequence[Trajectory]]]

_STEP = 1e-5  # step of a finite difference [-, rad or m]
_STEPS = 5  # Gauss-Newton steps of a size


@dataclass(frozen=True, eq=False)
class _Alteration:
    """A possible difference from what was stated, with sizes x, 0 if there is none."""

    code: str
    joints: tuple[str, ...]  # none: all of them
    Z: Array  # torques of sizes of 1, shape (N, n, c)
    least: float  # smallest size that changes a result
    #: the values of the finding, for sizes (c,)
    values: Callable[[Array], dict[str, float | str]]
    applied: _Applied | None = None  # robot and motions with sizes (c,), if torques are nonlinear


@dataclass(frozen=True, eq=False)
class _Found:
    """An alteration that was found: its finding, and the samples corrected by it."""

    alteration: _Alteration
    finding: Finding
    there: Sample


def explain_residual(
    fit: Fit, sample: Sample | None
) -> tuple[tuple[Misfit, ...], tuple[Finding, ...]]:
    """Return the terms that drive models lack, and differences of recordings or URDF.

    A spring and a position offset imitate each other: what explains more of the residual of all
    joints together is accepted first, and the other hypotheses are tested again together with it.
    """
    model = fit.model
    if sample is None or model.free_flyer or model.constraints or model.passive:
        return (), ()
    misfits = find_misfits(sample)
    own = list(_alterations(model, fit.standard, sample))
    found = list(_found(fit, sample, own))
    if misfits and found:
        altered = np.concatenate([one.alteration.Z for one in found], axis=2)
        lacking = _columns(misfits, sample)
        if _left(sample, altered) < _left(sample, lacking):
            alone = {(misfit.joint, misfit.term.code) for misfit in misfits}
            remaining = find_misfits(found[0].there.with_columns(altered))
            misfits = tuple(m for m in remaining if (m.joint, m.term.code) in alone)
        else:
            among = {one.alteration for one in found}
            retested = _found(fit, sample.with_columns(lacking), own)
            found = [one for one in retested if one.alteration in among]
    return misfits, tuple(one.finding for one in found)


def _columns(misfits: Sequence[Misfit], sample: Sample) -> Array:
    """Return the columns of terms that drive models lack, shape (N, n, c)."""
    columns = []
    for misfit in misfits:
        j = sample.joints.index(misfit.joint)
        of_joint = misfit.term.columns(sample.motions[j])  # (N, k)
        only = np.eye(len(sample.joints))[j]
        columns.append(only[None, :, None] * of_joint[:, None, :])
    return np.concatenate(columns, axis=2)


def _left(sample: Sample, Z: Array) -> float:
    """Return the squared residual of held-out segments with columns added."""
    left = Trials(sample, Z).held_out.left(list(range(Z.shape[2])))
    return float(left[: sample.fitted].sum())


def _refined(applied: _Applied, x: Array, pi: Array, sample: Sample) -> tuple[Array, Array, Sample]:
    """Return the sizes of an alteration, their standard errors, and the samples corrected by it.

    Torques are nonlinear over a tenth of a radian: Gauss-Newton steps are repeated until the sizes
    converge.
    """
    every, error = list(range(len(x))), np.full(len(x), np.inf)
    for _ in range(_STEPS):
        model, at = applied(x)
        tau = _torques(model, pi, at)
        sample = along(sample, model, at, tau)
        beyond = [applied(x + _STEP * axis) for axis in np.eye(len(x))]
        moved = [_torques(model, pi, at) for model, at in beyond]
        Z = (np.stack(moved, axis=-1) - tau[..., None]) / _STEP
        step, covariance = Trials(sample, Z).whole.estimate(every, sample.fitted)
        x, error = x + step, np.sqrt(np.diag(covariance))
        if np.linalg.norm(step) < 0.1 * np.linalg.norm(error):
            break
    return x, error, sample


def _alterations(model: RobotModel, pi: Array, sample: Sample) -> Iterator[_Alteration]:
    """Yield the possible differences, with their effect on the torques of the sample."""
    n = len(model.joints)
    tau, of_drives = _torques(model, pi, sample.at), _drives(model, pi, sample.at)
    of_motions = [body_slopes(model, pi, motion) for motion in sample.at]
    *by_motion, by_gravity, by_origin = map(np.concatenate, zip(*of_motions, strict=True))
    q, v, a = (np.concatenate([getattr(m, key) for m in sample.at]) for key in "qva")

    def moved(scale: Array, shift: Array) -> Array:
        """Return the derivative of the torques for positions (1 + e scale) q + e shift by e."""
        factor = 1.0 + _STEP * scale
        change = [
            replace(m, q=factor * m.q + _STEP * shift, v=factor * m.v, a=factor * m.a)
            for m in sample.at
        ]
        Z: Array = (_drives(model, pi, change) - of_drives)[..., None] / _STEP
        for D, x in zip(by_motion, (scale * q + shift, scale * v, scale * a), strict=True):
            Z += D @ x[..., None]
        return Z

    def offset(joint: int, x: Array) -> tuple[RobotModel, Sequence[Trajectory]]:
        """Return the motions with x added to the position of a joint."""
        return model, [replace(m, q=m.q + x * np.eye(n)[joint]) for m in sample.at]

    for j, joint in enumerate(model.joints):
        only, one = np.eye(n)[j], (joint,)
        unit = "m" if joint in model.layout.prismatic else "rad"
        Z, zero = moved(np.zeros(n), only), partial(_zero, unit=unit)
        yield _Alteration("position_offset", one, Z, 0.01, zero, partial(offset, j))
        backlash = 0.5 * Z * sample.motions[j].direction[:, None, None]
        yield _Alteration("lost_motion", one, backlash, 0.005, partial(_named, unit=unit))
        scaled = partial(_factor, subject=f"q_{joint}")
        yield _Alteration("angle_scale", one, moved(only, np.zeros(n)), 0.02, scaled)
        if sample.torque[j]:  # a torque of 0 has no scale
            yield _Alteration("torque_scale", one, (tau * only)[..., None], 0.05, _gain)
    for first in range(1, n - 1):  # the drives of a wrist are of the same type
        Z = (tau * (np.arange(n) >= first))[..., None]
        yield _Alteration("torque_scale", model.joints[first:], Z, 0.05, _gains)
    every = partial(_factor, subject="every position")
    yield _Alteration("angle_scale", (), moved(np.ones(n), np.zeros(n)), 0.02, every)
    bodies = np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)
    still = [replace(m, v=0.0 * m.v, a=0.0 * m.a) for m in sample.at]
    inertial = tau - of_drives - _torques(model, bodies, still)
    yield _Alteration("time_scale", (), inertial[..., None], 0.04, _clock)
    down = np.array(model.pin_model.gravity.linear)
    if down.any():
        across = np.linalg.svd(down[None])[2][1:]  # two directions perpendicular to gravity

        def tilted(x: Array) -> tuple[RobotModel, Sequence[Trajectory]]:
            return model.with_gravity(_tilted(x, across, down)), sample.at

        def tilt(x: Array) -> dict[str, float | str]:
            best = ", ".join(f"{value:.2f}" for value in _tilted(x, across, down))
            return {"best": best, "what": "residual", "cure": "residual"}

        Z = by_gravity @ (np.linalg.norm(down) * across).T
        yield _Alteration("gravity", (), Z, 0.05, tilt, tilted)
    for j, joint in enumerate(model.joints):
        named = partial(_named, subject=joint)
        yield _Alteration("joint_origin", (joint,), by_origin[:, :, j], 0.01, named)
    anywhere = by_origin.reshape(len(tau), n, -1)
    yield _Alteration("joint_origin", (), anywhere, 0.01, partial(_named, subject="a joint"))


def _torques(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of motions by standard parameters, shape (N, n)."""
    return np.concatenate([inverse_dynamics(model, pi, motion) for motion in at])


def _drives(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of drives in motions, shape (N, n)."""
    return np.concatenate([drive_torque(model, pi, motion) for motion in at])


def _tilted(x: Array, across: Array, down: Array) -> Array:
    """Return gravity rotated towards two perpendicular axes, by tangents x of angles (2,)."""
    size = np.linalg.norm(down)
    tilted = down + size * x @ across
    return np.asarray(tilted * size / np.linalg.norm(tilted))


def _found(fit: Fit, sample: Sample, own: Sequence[_Alteration]) -> Iterator[_Found]:
    """Yield the alterations that explain the residual, each together with those found before."""
    Z = np.concatenate([alteration.Z for alteration in own], axis=2)
    ends = np.cumsum([alteration.Z.shape[2] for alteration in own]).tolist()
    place = [list(range(end - a.Z.shape[2], end)) for a, end in zip(own, ends, strict=True)]
    trials = Trials(sample, Z)
    held_out, whole = trials.held_out, trials.whole
    chosen: list[int] = []
    total = before = held_out.left([])
    of_fitted, of_validation = (float(part.sum()) for part in np.split(total, [sample.fitted]))
    untried = dict(zip(own, place, strict=True))

    def offered() -> Round[_Alteration]:
        left = held_out.left_each({one: [*chosen, *which] for one, which in untried.items()})
        return Round(before, left, sample.fitted, of_fitted)

    for this, best in select(offered, ALTERATION, _complexity):
        if best is None:
            return
        gain = float((before - this.left[best])[sample.fitted :].sum())
        confirmed = gain / max(of_validation, 1e-300)
        share, by_p_value = this.share(best), this.p_value(best)
        has_validation, is_weak = len(total) > sample.fitted, share < ALTERATION_SHARE
        is_confirmed = not has_validation or confirmed > CONFIRMED * share
        if is_weak:
            is_confirmed = has_validation and confirmed > share > WEAK and by_p_value < WEAK_P_VALUE
        if by_p_value > ALTERATION_P_VALUE or not is_confirmed:
            return
        which = untried.pop(best)
        chosen, before = [*chosen, *which], this.left[best]
        sizes, covariance = whole.estimate(chosen, sample.fitted)
        size, error = (x[-len(which) :] for x in (sizes, np.sqrt(np.diag(covariance))))
        least = best.least * (WEAK_SIZE if is_weak else 1.0)
        if np.linalg.norm(size) < max(least, SIGNIFICANT * float(np.linalg.norm(error))):
            return
        there = sample
        if best.applied is not None and len(chosen) == len(which):
            size, error, there = _refined(best.applied, size, fit.standard, sample)
        others = [one for one in this.alike(ALTERATION) if one is not best]
        yield _Found(best, _finding(best, size, error, share, others), there)


def _complexity(one: _Alteration) -> tuple[int, int]:
    """Return the number of sizes of an alteration, and the number of joints it names."""
    return one.Z.shape[2], len(one.joints)


def _finding(
    found: _Alteration, size: Array, error: Array, share: float, alike: Sequence[_Alteration]
) -> Finding:
    others = [f"{one.code} of {', '.join(one.joints)}" for one in alike if one.joints]
    tangents = np.degrees(np.arctan([np.linalg.norm(size), np.linalg.norm(error)]))
    values = found.values(size)
    values = {"named" if key == "subject" else key: value for key, value in values.items()}
    return finding(
        found.code, "", found.joints, subject="" if found.joints else "all joints",
        severity="warning", explained=True, also=bool(others), others=listed(others),
        size=float(size[0] if len(size) == 1 else np.linalg.norm(size)), share_pct=100 * share,
        std_error=float(np.linalg.norm(error)), angle=tangents[0], angle_error=tangents[1],
        **values,
    )  # fmt: skip


def _zero(x: Array, unit: str) -> dict[str, float | str]:
    return {"correction": -x[0], "unit": unit, "what": "residual", "cure": "residual"}


def _named(x: Array, **words: str) -> dict[str, float | str]:
    return {**words}


def _factor(x: Array, subject: str) -> dict[str, float | str]:
    return {"factor": 1 + x[0], "subject": subject}


def _gain(x: Array) -> dict[str, float | str]:
    return {"factor": 1 + x[0], "what": "one", "cure": "one"}


def _gains(x: Array) -> dict[str, float | str]:
    sense = "more" if x[0] > 0 else "less"
    return {"factor": 1 + x[0], "what": sense, "cure": sense}


def _clock(x: Array) -> dict[str, float | str]:
    return {"factor": 1 + x[0], "speed": np.sqrt(max(1 + x[0], 0.0))}
