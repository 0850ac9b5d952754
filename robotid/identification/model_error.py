"""Standard errors that include model errors: missing drive terms, and uncertain friction shapes.

A term with parameters theta that the model lacks, or that was nearly selected, changes the others
by -T theta, a bias: its square is added to their covariance. So is the error of a fitted shape:

    C += sum_terms (T theta) (T theta)^T + sum_joints T C_s T^T,  T = (W^T W + C_0^-1)^-1 W^T z

In a prediction changed parameters and missing torque partly cancel, W T theta - z theta: each term
is stored as an ``OpenTerm``.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robotid.base.tolerances import REMAINDER, TINY
from robotid.base.typing import Array
from robotid.diagnosis.decisions import GROWN, SETTLED, STEP
from robotid.diagnosis.residual.misfit import Misfit
from robotid.diagnosis.residual.term_trials import RIDGE, Sample, Trial, Trials, take_sample
from robotid.dynamics.torque import drive_motion_along
from robotid.estimation.fitting.drive_terms import DriveChoice, JointMotion, OpenTerm
from robotid.estimation.fitting.fitted import Fit, Solution
from robotid.robot.drive_term import DriveMotion, DriveTerm


def with_model_error(
    fit: Fit, sample: Sample | None, misfits: Sequence[Misfit]
) -> tuple[Fit, tuple[str, ...]]:
    """Return a fit whose standard errors include the errors of its drive model."""
    if sample is None:
        return fit, ()
    motions = _motions(fit, sample) if fit.drives else []
    fit = _wider(fit, sample, list(_of_shapes(fit, sample, motions)))
    fit = _wider(fit, sample, list(_of_undecided(fit, sample, motions)))
    torques = [partial(lambda m, _, alone: m.torque(alone), misfit) for misfit in misfits]
    lacking = [_Move(m.joint, m.shift, torque) for m, torque in zip(misfits, torques, strict=True)]
    wider = _wider(fit, sample, lacking)
    before, after = fit.standard_error, wider.standard_error
    drives = np.arange(len(before)) >= fit.model.layout.n_inertial
    grown = np.flatnonzero(drives & np.isfinite(before) & (after > GROWN * before))
    return wider, tuple(fit.mapping.names[i] for i in grown)


@dataclass(frozen=True, eq=False)
class _Move:
    """An uncertain part of a drive model, in the sample's units."""

    joint: str
    shift: Array  # of base parameters over their spread, (b,)
    torque: Callable[[DriveMotion, JointMotion], Array]  # (N,)


def _wider(fit: Fit, sample: Sample, moved: Sequence[_Move]) -> Fit:
    """Return a fit with the errors from further uncertain parts of its drive models."""
    if not moved:
        return fit
    X = sample.U.T @ np.column_stack([move.shift for move in moved])  # (b, m), base parameters
    spread = fit.prior_std
    least = TINY * float(spread[spread > 0].min())  # a fixed parameter hardly changes
    GX = fit.mapping.gain(np.maximum(spread, least)) @ X  # (p, m), standard parameters
    terms = [OpenTerm(x.joint, moves, x.torque) for x, moves in zip(moved, GX.T, strict=True)]
    return replace(
        fit,
        standard_covariance=fit.standard_covariance + GX @ GX.T,
        base_error=np.sqrt(fit.base_error**2 + np.sum(X**2, axis=1)),
        open_terms=(*fit.open_terms, *terms),
    )


def _of_shapes(fit: Fit, sample: Sample, motions: Sequence[DriveMotion]) -> Iterator[_Move]:
    """Yield the uncertain directions of shapes."""
    # The errors of a joint's shapes are correlated: C_s = L L^T, one direction per column of L.
    for choice in fit.drives:
        if choice.shapes:
            slopes = partial(_slopes, fit, choice)
            T = _trial(sample, choice, motions, slopes, REMAINDER).T[:, :-1]
            variance, axes = np.linalg.eigh(np.array(choice.shape_covariance))
            for axis in (axes * np.sqrt(np.maximum(variance, 0.0))).T:
                yield _Move(choice.joint, -(T @ axis), partial(_combined, slopes, axis))


def _combined(
    columns: Callable[[DriveMotion], Array], x: Array, motion: DriveMotion, alone: JointMotion
) -> Array:
    """Return the torque of the columns of a drive times parameters (c,), shape (N,)."""
    return np.asarray(columns(motion) @ x)


def _trial(
    sample: Sample, choice: DriveChoice, motions: Sequence[DriveMotion],
    columns: Callable[[DriveMotion], Array], ridge: float = RIDGE,
) -> Trial:  # fmt: skip
    """Return a trial of columns (N, c) of a joint's motions, with all that was fitted."""
    j, taken = sample.joints.index(choice.joint), zip(motions, sample.taken, strict=True)
    Z = np.concatenate([columns(motion.of(j))[rows] for motion, rows in taken])
    return Trials(sample.of_joint(j), Z[:, None], ridge).whole


def settled_shapes(fit: Solution) -> tuple[DriveChoice, ...] | None:
    """Return choices with shapes refitted now that all joints have their terms."""
    # One Gauss-Newton step: the step of a shape is the parameter of its column.
    sample = take_sample(fit, for_drives=True)
    if sample is None or not any(choice.shapes for choice in fit.drives):
        return None
    motions, drives, farthest = _motions(fit, sample), [], 0.0
    for choice in fit.drives:
        if choice.shapes:
            whole = _trial(sample, choice, motions, partial(_slopes, fit, choice), REMAINDER)
            step, covariance = whole.estimate(list(range(len(choice.shapes))), sample.fitted)
            moved = choice.moved(step, covariance)
            before, after = (np.array([s.value for s in c.shapes]) for c in (choice, moved))
            errors = np.sqrt(np.diag(covariance))
            farthest = max(farthest, float((np.abs(after - before) / errors).max()))
            choice = moved
        drives.append(choice)
    return tuple(drives) if farthest > SETTLED else None


def _of_undecided(fit: Fit, sample: Sample, motions: Sequence[DriveMotion]) -> Iterator[_Move]:
    """Yield the uncertain parts of terms that were nearly selected."""
    for choice in (choice for choice in fit.drives if choice.undecided):
        columns = partial(_columns, choice.undecided)
        whole = _trial(sample, choice, motions, columns)
        theta = whole.parameters(range(len(choice.undecided)))
        yield _Move(choice.joint, -whole.T[:, :-1] @ theta, partial(_combined, columns, theta))


def _columns(terms: Sequence[DriveTerm], motion: DriveMotion) -> Array:
    return np.column_stack([term.column(motion) for term in terms])  # (N, c)


def _motions(fit: Solution, sample: Sample) -> list[DriveMotion]:
    """Return the motion of the drives along each recording, see ``Sample.taken``."""
    model = fit.model.with_reference(fit.standard)
    return [drive_motion_along(model, x.trajectory) for x in sample.recordings]


def _slopes(fit: Solution, choice: DriveChoice, motion: DriveMotion) -> Array:
    """Return the derivatives of a drive's torque by its shapes, shape (N, k)."""
    parameters = dict(zip(fit.model.layout.names, fit.standard, strict=True))
    theta = np.array([parameters[f"{choice.joint}.{term.name}"] for term in choice.terms])
    stated = _columns(choice.terms, motion)
    return np.column_stack([
        (_columns(choice.altered(k, STEP), motion) - stated) @ theta / (shape.value * STEP)
        for k, shape in enumerate(choice.shapes)
    ])  # fmt: skip
