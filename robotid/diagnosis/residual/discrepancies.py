"""Readings of recordings and the URDF: offsets, scales, a clock, gravity, origins of joints.

Other masses cannot imitate any of these: each changes the predicted torque tau(q, v, a) in its own
way. To first order, in all joints together,

    tau_measured - tau = W delta + Z x + e,    Z = d tau / d x,

where W delta is the effect of other base parameters, and x the sizes of the difference, 0 if there
is none. A reading is an entry of ``readings``; ``Trials.accepted`` compares them.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.residual.misfit import Misfit, find_misfits
from robotid.diagnosis.residual.term_trials import Accepted, Sample, Trials, along
from robotid.dynamics.torque import body_slopes, drive_torque, inverse_dynamics
from robotid.estimation.fitting.fitted import Fit
from robotid.robot.model import RobotModel

_STEP = 1e-5  # step of a finite difference [-, rad or m]
_STEPS = 5  # Gauss-Newton steps of a size
_Altered = tuple[RobotModel, Sequence[Trajectory]]


@dataclass(frozen=True)
class Reading:
    """Another reading of the recordings or the URDF."""

    code: str  # of its finding
    least: float  # smallest size that changes a result
    groups: Sequence[tuple[str, ...]]  # of joints that it is tried for; (): all of them together
    #: Derivative of the torques (N, n, c) by its c sizes; (n,) is 1 for the joints of a group.
    columns: Callable[[Array], Array]
    #: Robot and motions with sizes (c,), where torques are nonlinear in them.
    applied: Callable[[Array, Array], _Altered] | None = None


def readings(model: RobotModel, pi: Array, sample: Sample) -> tuple[Reading, ...]:
    """Return the readings that are tried, an entry each."""
    n, joints, at = len(model.joints), model.joints, sample.at
    tau, of_drives = _torques(model, pi, at), _drives(model, pi, at)
    bodies = np.where(np.arange(len(pi)) < model.layout.n_inertial, pi, 0.0)
    still = [replace(m, v=0.0 * m.v, a=0.0 * m.a) for m in at]
    inertial = tau - of_drives - _torques(model, bodies, still)
    of_motions = [body_slopes(model, pi, motion) for motion in at]
    *by_motion, by_gravity, by_origin = map(np.concatenate, zip(*of_motions, strict=True))
    q, v, a = (np.concatenate([getattr(m, key) for m in at]) for key in "qva")
    direction = np.column_stack([motion.direction for motion in sample.motions])
    down = np.array(model.pin_model.gravity.linear)
    across = np.linalg.norm(down) * np.linalg.svd(down[None])[2][1:]  # (2, 3)

    def moved(scale: Array, shift: Array) -> Array:
        """Return the derivative of the torques for positions (1 + e scale) q + e shift by e."""
        factor = 1.0 + _STEP * scale
        change = [
            replace(m, q=factor * m.q + _STEP * shift, v=factor * m.v, a=factor * m.a) for m in at
        ]
        Z: Array = (_drives(model, pi, change) - of_drives)[..., None] / _STEP
        for D, x in zip(by_motion, (scale * q + shift, scale * v, scale * a), strict=True):
            Z += D @ x[..., None]
        return Z

    def offset(on: Array, x: Array) -> _Altered:
        return model, [replace(m, q=m.q + x * on) for m in at]

    def tilted(on: Array, x: Array) -> _Altered:
        g = down + x @ across  # by angles with these tangents
        return model.with_gravity(g * np.linalg.norm(down) / np.linalg.norm(g)), at

    one, every = [(joint,) for joint in joints], [tuple[str, ...]()]
    level = every if down.any() else []
    driven = [(joint,) for joint, size in zip(joints, sample.torque, strict=True) if size]
    wrists = [joints[first:] for first in range(1, n - 1)]  # whose drives are of the same type
    return (
        Reading("position_offset", 0.01, one, lambda on: moved(0 * on, on), offset),
        Reading(
            "lost_motion", 0.005, one,
            lambda on: 0.5 * moved(0 * on, on) * (direction @ on)[:, None, None],
        ),
        Reading("angle_scale", 0.02, one + every, lambda on: moved(on, 0 * on)),
        Reading("torque_scale", 0.05, driven + wrists, lambda on: (tau * on)[..., None]),
        Reading("time_scale", 0.04, every, lambda on: inertial[..., None]),
        Reading("gravity", 0.05, level, lambda on: by_gravity @ across.T, tilted),
        Reading(
            "joint_origin", 0.01, one + every,
            lambda on: by_origin[:, :, on > 0].reshape(*tau.shape, -1),
        ),
    )  # fmt: skip


def _torques(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of motions by standard parameters, shape (N, n)."""
    return np.concatenate([inverse_dynamics(model, pi, motion) for motion in at])


def _drives(model: RobotModel, pi: Array, at: Sequence[Trajectory]) -> Array:
    """Return the torques of drives in motions, shape (N, n)."""
    return np.concatenate([drive_torque(model, pi, motion) for motion in at])


@dataclass(frozen=True, eq=False)
class _Alteration:
    """A reading for a group of joints."""

    reading: Reading
    joints: tuple[str, ...]  # none: all of them
    on: Array  # (n,), 1 for them

    def values(self, x: Array, unit: str) -> dict[str, float | str]:
        """Return the values of the finding for sizes (c,)."""
        joint, is_one = "".join(self.joints[:1]), len(self.joints) == 1
        sense = "one" if is_one else "more" if x[0] > 0 else "less"
        values: dict[str, dict[str, float | str]] = {
            "position_offset": {"correction": -x[0], "unit": unit},
            "lost_motion": {"unit": unit},
            "angle_scale": {
                "factor": 1 + x[0],
                "named": f"q_{joint}" if joint else "every position",
            },
            "torque_scale": {"factor": 1 + x[0], "what": sense, "cure": sense},
            "time_scale": {
                "factor": 1 + x[0],
                "speed": np.sqrt(max(1 + x[0], 0.0)),
                "what": "residual",
                "cure": "residual",
            },
            "joint_origin": {"named": joint or "a joint"},
        }
        more, applied = values.get(self.reading.code, {}), self.reading.applied
        if applied is not None:
            more |= {"what": "residual", "cure": "residual"}
            if self.reading.code == "gravity":
                g = applied(self.on, x)[0].pin_model.gravity.linear
                more["best"] = ", ".join(f"{value:.2f}" for value in g)
        return more


def explain_residual(
    fit: Fit, sample: Sample | None
) -> tuple[tuple[Misfit, ...], tuple[Finding, ...]]:
    """Return the terms that drive models lack, and differences of recordings or URDF."""
    # A spring and a position offset imitate each other: what explains more of the whole residual is
    # accepted first, and the other is tested again together with it.
    model = fit.model
    if sample is None or model.free_flyer or model.constraints or model.passive:
        return (), ()
    misfits = find_misfits(sample)
    possible = alterations(model, fit.standard, sample)
    altered_by = list(_accepted(fit, sample, possible))
    if misfits and altered_by:
        altered = np.concatenate([possible[alteration] for alteration, *_ in altered_by], axis=2)
        lacking = _columns(misfits, sample)
        if _left(sample, altered) < _left(sample, lacking):
            alone = {(misfit.joint, misfit.term.code) for misfit in misfits}
            remaining = find_misfits(altered_by[0][2].with_columns(altered))
            misfits = tuple(m for m in remaining if (m.joint, m.term.code) in alone)
        else:
            among = {alteration for alteration, *_ in altered_by}
            retested = _accepted(fit, sample.with_columns(lacking), possible)
            altered_by = [one for one in retested if one[0] in among]
    return misfits, tuple(one for _, one, _ in altered_by)


def _columns(misfits: Sequence[Misfit], sample: Sample) -> Array:
    """Return the columns of terms that drive models lack, shape (N, n, c)."""
    places = [(m.term, sample.joints.index(m.joint)) for m in misfits]
    columns = [(term.columns(sample.motions[j]), j) for term, j in places]  # (N, k) each
    one = np.eye(len(sample.joints))
    return np.concatenate([one[j][:, None] * of_joint[:, None] for of_joint, j in columns], axis=2)


def _left(sample: Sample, Z: Array) -> float:
    """Return the squared residual of held-out segments with columns added."""
    left = Trials(sample, Z).held_out.left(list(range(Z.shape[2])))
    return float(left[: sample.fitted].sum())


def alterations(model: RobotModel, pi: Array, sample: Sample) -> dict[_Alteration, Array]:
    """Return each reading for each of its groups of joints, and its columns (N, n, c)."""
    columns = {}
    for reading in readings(model, pi, sample):
        for joints in reading.groups:
            on = np.isin(model.joints, joints or model.joints).astype(float)
            columns[_Alteration(reading, joints, on)] = reading.columns(on)
    return columns


def _accepted(
    fit: Fit, sample: Sample, possible: Mapping[_Alteration, Array]
) -> Iterator[tuple[_Alteration, Finding, Sample]]:
    """Yield the alterations that explain the residual, findings, and the corrected samples."""
    trials, offered = Trials.of(sample, possible)

    def complexity(one: _Alteration) -> tuple[int, int]:
        return len(offered[one]), len(one.joints)  # number of sizes, and of joints named

    for accepted in trials.accepted(offered, decisions.ALTERATION, complexity):
        best, size, error = accepted.option, accepted.theta, np.sqrt(np.diag(accepted.covariance))
        least = best.reading.least * _needed(accepted)
        if np.linalg.norm(size) < max(least, decisions.SIGNIFICANT * float(np.linalg.norm(error))):
            return
        corrected = sample
        if best.reading.applied is not None and len(accepted.columns) == len(size):
            applied = partial(best.reading.applied, best.on)
            size, error, corrected = _refined(applied, size, fit.standard, sample)
        others = [one for one in accepted.others if one.joints]
        unit = "m" if fit.model.layout.prismatic.intersection(best.joints) else "rad"
        norm, norm_error = float(np.linalg.norm(size)), float(np.linalg.norm(error))
        angle, angle_error = np.degrees(np.arctan([norm, norm_error]))
        explained = finding(
            best.reading.code, "", best.joints, subject="" if best.joints else "all joints",
            severity="warning", explained=True, also=bool(others),
            others=listed(f"{one.reading.code} of {', '.join(one.joints)}" for one in others),
            size=float(size[0] if len(size) == 1 else norm), share_pct=100 * accepted.share,
            std_error=norm_error, angle=angle, angle_error=angle_error, **best.values(size, unit),
        )  # fmt: skip
        yield best, explained, corrected


def _needed(accepted: Accepted[_Alteration]) -> float:
    """Return the size that an alteration needs, over its least; inf if it is not significant."""
    share, confirmed = accepted.share, accepted.confirmed
    if accepted.p_value > decisions.P_VALUE:
        return np.inf
    if share >= decisions.LEAST_SHARE:
        is_confirmed = confirmed is None or confirmed > decisions.CONFIRMED * share
        return 1.0 if is_confirmed else np.inf
    is_weak = confirmed is not None and confirmed > share > decisions.WEAK
    is_weak = is_weak and accepted.p_value < decisions.WEAK_P_VALUE
    return decisions.WEAK_SIZE if is_weak else np.inf


def _refined(
    applied: Callable[[Array], _Altered], x: Array, pi: Array, sample: Sample
) -> tuple[Array, Array, Sample]:
    """Return the sizes of an alteration, their standard errors, and the samples corrected by it."""
    # Torques are nonlinear over 0.1 rad: Gauss-Newton steps until the sizes converge.
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
