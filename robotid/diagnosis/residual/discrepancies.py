"""Tests for recordings or URDFs that differ from what was stated: offsets, scales, clock, origins.

Other masses cannot imitate any of these: each changes the predicted torque tau(q, v, a) in its own
way. To first order, in all joints together,

    tau_measured - tau = W delta + Z x + e,    Z = d tau / d x,

where W delta is the effect of other base parameters. x is the size of the difference, with its
standard error. It is refitted with one segment of the recordings held out after the other
(``misfit``).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import Round, select
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
    Z: Array  # (N, n, c), torques of sizes of 1
    least: float  # smallest size that changes a result
    words: Mapping[str, str] = field(default_factory=dict)  # of its finding
    applied: _Applied | None = None  # robot and motions with sizes (c,), if torques are nonlinear

    def values(self, x: Array) -> dict[str, float | str]:
        """Return the values of the finding for sizes (c,)."""
        of_residual = {"what": "residual", "cure": "residual"}
        if self.code == "position_offset":
            return {"correction": -x[0], **of_residual, **self.words}
        if self.code == "gravity" and self.applied is not None:
            g = self.applied(x)[0].pin_model.gravity.linear
            return {"best": ", ".join(f"{value:.2f}" for value in g), **of_residual}
        if self.code in ("joint_origin", "lost_motion"):
            return {**self.words}
        values: dict[str, float | str] = {"factor": 1 + x[0], **self.words}
        if self.code == "time_scale":
            values["speed"] = np.sqrt(max(1 + x[0], 0.0))
        if self.code == "torque_scale":
            sense = "one" if len(self.joints) == 1 else "more" if x[0] > 0 else "less"
            values |= {"what": sense, "cure": sense}
        return values


@dataclass(frozen=True, eq=False)
class _Found:
    """An alteration that was found: its finding, and the samples corrected by it."""

    alteration: _Alteration
    finding: Finding
    corrected: Sample


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
    possible = list(_alterations(model, fit.standard, sample))
    altered_by = list(_found(fit, sample, possible))
    if misfits and altered_by:
        altered = np.concatenate([one.alteration.Z for one in altered_by], axis=2)
        lacking = _columns(misfits, sample)
        if _left(sample, altered) < _left(sample, lacking):
            alone = {(misfit.joint, misfit.term.code) for misfit in misfits}
            remaining = find_misfits(altered_by[0].corrected.with_columns(altered))
            misfits = tuple(m for m in remaining if (m.joint, m.term.code) in alone)
        else:
            among = {one.alteration for one in altered_by}
            retested = _found(fit, sample.with_columns(lacking), possible)
            altered_by = [one for one in retested if one.alteration in among]
    return misfits, tuple(one.finding for one in altered_by)


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
        unit = {"unit": "m" if joint in model.layout.prismatic else "rad"}
        Z = moved(np.zeros(n), only)
        yield _Alteration("position_offset", one, Z, 0.01, unit, partial(offset, j))
        backlash = 0.5 * Z * sample.motions[j].direction[:, None, None]
        yield _Alteration("lost_motion", one, backlash, 0.005, unit)
        scaled = moved(only, np.zeros(n))
        yield _Alteration("angle_scale", one, scaled, 0.02, {"named": f"q_{joint}"})
        if sample.torque[j]:  # a torque of 0 has no scale
            yield _Alteration("torque_scale", one, (tau * only)[..., None], 0.05)
    for first in range(1, n - 1):  # the drives of a wrist are of the same type
        Z = (tau * (np.arange(n) >= first))[..., None]
        yield _Alteration("torque_scale", model.joints[first:], Z, 0.05)
    every = {"named": "every position"}
    yield _Alteration("angle_scale", (), moved(np.ones(n), np.zeros(n)), 0.02, every)
    bodies = np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)
    still = [replace(m, v=0.0 * m.v, a=0.0 * m.a) for m in sample.at]
    inertial = tau - of_drives - _torques(model, bodies, still)
    yield _Alteration("time_scale", (), inertial[..., None], 0.04)
    down = np.array(model.pin_model.gravity.linear)
    if down.any():
        size, across = np.linalg.norm(down), np.linalg.svd(down[None])[2][1:]

        def tilted(x: Array) -> tuple[RobotModel, Sequence[Trajectory]]:
            """Return the robot with gravity rotated by angles with tangents x (2,)."""
            g = down + size * x @ across  # towards two directions perpendicular to gravity
            return model.with_gravity(g * size / np.linalg.norm(g)), sample.at

        Z = by_gravity @ (size * across).T
        yield _Alteration("gravity", (), Z, 0.05, applied=tilted)
    for j, joint in enumerate(model.joints):
        yield _Alteration("joint_origin", (joint,), by_origin[:, :, j], 0.01, {"named": joint})
    anywhere = by_origin.reshape(len(tau), n, -1)
    yield _Alteration("joint_origin", (), anywhere, 0.01, {"named": "a joint"})


def _torques(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of motions by standard parameters, shape (N, n)."""
    return np.concatenate([inverse_dynamics(model, pi, motion) for motion in at])


def _drives(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of drives in motions, shape (N, n)."""
    return np.concatenate([drive_torque(model, pi, motion) for motion in at])


def _found(fit: Fit, sample: Sample, possible: Sequence[_Alteration]) -> Iterator[_Found]:
    """Yield the alterations that explain the residual, each together with those found before."""
    Z = np.concatenate([alteration.Z for alteration in possible], axis=2)
    ends = np.cumsum([alteration.Z.shape[2] for alteration in possible]).tolist()
    untried = {
        a: list(range(end - a.Z.shape[2], end)) for a, end in zip(possible, ends, strict=True)
    }
    trials = Trials(sample, Z)
    held_out, whole = trials.held_out, trials.whole
    chosen: list[int] = []
    total = before = held_out.left([])
    of_fitted, of_validation = (float(part.sum()) for part in np.split(total, [sample.fitted]))

    def offered() -> Round[_Alteration]:
        left = held_out.left_each({one: [*chosen, *which] for one, which in untried.items()})
        return Round(before, left, sample.fitted, of_fitted)

    def complexity(one: _Alteration) -> tuple[int, int]:
        return one.Z.shape[2], len(one.joints)  # number of sizes, and of joints named

    for this, best in select(offered, decisions.ALTERATION, complexity):
        if best is None:
            return
        gain = float((before - this.left[best])[sample.fitted :].sum())
        confirmed = gain / max(of_validation, decisions.NOTHING)
        share, by_p_value = this.share(best), this.p_value(best)
        has_validation, is_weak = len(total) > sample.fitted, share < decisions.LEAST_SHARE
        is_confirmed = not has_validation or confirmed > decisions.CONFIRMED * share
        if is_weak:
            is_confirmed = (
                has_validation
                and confirmed > share > decisions.WEAK
                and by_p_value < decisions.WEAK_P_VALUE
            )
        if by_p_value > decisions.P_VALUE or not is_confirmed:
            return
        which = untried.pop(best)
        chosen, before = [*chosen, *which], this.left[best]
        sizes, covariance = whole.estimate(chosen, sample.fitted)
        size, error = (x[-len(which) :] for x in (sizes, np.sqrt(np.diag(covariance))))
        least = best.least * (decisions.WEAK_SIZE if is_weak else 1.0)
        if np.linalg.norm(size) < max(least, decisions.SIGNIFICANT * float(np.linalg.norm(error))):
            return
        corrected = sample
        if best.applied is not None and len(chosen) == len(which):
            size, error, corrected = _refined(best.applied, size, fit.standard, sample)
        others = [one for one in this.alike(decisions.ALTERATION) if one is not best and one.joints]
        alike = listed(f"{one.code} of {', '.join(one.joints)}" for one in others)
        norm, norm_error = float(np.linalg.norm(size)), float(np.linalg.norm(error))
        angle, angle_error = np.degrees(np.arctan([norm, norm_error]))
        explained = finding(
            best.code, "", best.joints, subject="" if best.joints else "all joints",
            severity="warning", explained=True, also=bool(others), others=alike,
            size=float(size[0] if len(size) == 1 else norm), share_pct=100 * share,
            std_error=norm_error, angle=angle, angle_error=angle_error, **best.values(size),
        )  # fmt: skip
        yield _Found(best, explained, corrected)
