"""Standard errors that know what the drive model lacks, and what is open of its shapes.

A term that the drives have and the model lacks moves the other parameters, by -T theta if theta is
what it would be. That is no noise, and does not shrink with the length of the log: its square adds
to their covariance; so does that of a term which was nearly chosen. A shape that was found beside
them has an error of its own, and so do they:

    C += sum_terms (T theta) (T theta)^T + sum_joints T C_s T^T,  T = (W^T W + C_0^-1)^-1 W^T z
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.identification.misfit import Misfit, Sample, Trial, take_sample, trials
from robotid.regressor.memory import drive_motion_along
from robotid.robot.drives import DriveMotion

if TYPE_CHECKING:
    from robotid.identification.drive_choice import DriveChoice
    from robotid.identification.pipeline import Identification

__all__ = ["settled_shapes", "shape_slope", "with_model_error"]

_STEP = 1e-3  # relative, of a derivative
_ROUNDING = 1e-10  # share of a column that is rounding
_MOVES = 0.2  # standard errors by which a shape moves that is worth another fit
_PINNED = 1e-6  # of the smallest spread: that of a parameter that is known
_GROWN = 1.3  # times by which a standard error grows that stands on a misfit


def with_model_error(
    found: "Identification", sample: Sample | None, misfits: Sequence[Misfit]
) -> "Identification":
    """Return an identification whose errors count what its drive model lacks.

    Args:
        found: What was found.
        sample: Rows of its recordings; None if they are too few to judge by.
        misfits: Terms that the model of its drives lacks.
    """
    if sample is None:
        return found
    found = _with_shape_errors(found, sample)
    found = _wider(found, sample, list(_of_doubts(found, sample)))
    wider = _wider(found, sample, [misfit.shift for misfit in misfits])
    before, after = found.standard_error, wider.standard_error
    drives = np.arange(len(before)) >= found.model.layout.n_inertial
    grown = np.flatnonzero(drives & np.isfinite(before) & (after > _GROWN * before))
    names = tuple(found.mapping.names[i] for i in grown)
    return replace(wider, misfits=tuple(misfits), on_misfit=names)


def _wider(found: "Identification", sample: Sample, moved: Sequence[Array]) -> "Identification":
    """Return an identification with what moves base parameters over their spread, (b,) each."""
    if not moved:
        return found
    X = sample.U.T @ np.column_stack(moved)  # (b, m), base parameters
    GX = _gain(found) @ X
    return replace(
        found,
        standard_covariance=found.standard_covariance + GX @ GX.T,
        base_error=np.sqrt(found.base_error**2 + np.sum(X**2, axis=1)),
    )


def _gain(found: "Identification") -> Array:
    """Return how a change of base parameters spreads over the standard ones, shape (p, b)."""
    spread = found.prior_std
    least = _PINNED * float(spread[spread > 0].min())  # what is known exactly hardly moves
    return found.mapping.gain(np.maximum(spread, least))


def _with_shape_errors(found: "Identification", sample: Sample) -> "Identification":
    """Return an identification whose errors count those of shapes.

    Shapes of a joint err together: their covariance is C_s = L L^T, one move for each column of L.
    """
    if not any(choice.shapes for choice in found.drives):
        return found
    motions, drives, moved = _motions(found), [], []
    gain = _gain(found)
    for choice in found.drives:
        if choice.shapes:
            T = _shape_trial(found, choice, sample, motions).T[:, :-1]
            variance, axes = np.linalg.eigh(np.array(choice.shape_covariance))
            moved += list(-(T @ (axes * np.sqrt(np.maximum(variance, 0.0)))).T)
            choice = replace(choice, shape_moves=-gain @ sample.U.T @ T)
        drives.append(choice)
    return replace(_wider(found, sample, moved), drives=tuple(drives))


def _shape_trial(
    found: "Identification", choice: "DriveChoice", sample: Sample, motions: Sequence[DriveMotion]
) -> Trial:
    """Return a trial of the columns d(torque)/d(shape) of a joint, beside all that was fitted."""
    j = sample.joints.index(choice.joint)
    slopes = [
        np.column_stack(
            [shape_slope(found, choice, k, motion.of(j)) for k in range(len(choice.shapes))]
        )[rows]
        for motion, rows in zip(motions, sample.taken, strict=True)
    ]
    _, whole = trials(sample, slice(j, j + 1), np.concatenate(slopes)[:, None], _ROUNDING)
    return whole


def settled_shapes(found: "Identification") -> "tuple[DriveChoice, ...] | None":
    """Return choices with shapes that fit better now that all joints have their terms.

    One step of Gauss and Newton: what a shape should be moved by is the parameter of its column.

    Args:
        found: What was found with the shapes as they are.

    Returns:
        The choices; None if no shape moves by more than a part of its standard error.
    """
    sample = take_sample(found, is_steady=False)
    if sample is None or not any(choice.shapes for choice in found.drives):
        return None
    motions, drives, farthest = _motions(found), [], 0.0
    for choice in found.drives:
        if choice.shapes:
            whole = _shape_trial(found, choice, sample, motions)
            step, covariance = whole.estimate(list(range(len(choice.shapes))), sample.fitted)
            moved = choice.moved(step, covariance)
            before, after = (np.array([s.value for s in c.shapes]) for c in (choice, moved))
            errors = np.sqrt(np.diag(covariance))
            farthest = max(farthest, float((np.abs(after - before) / errors).max()))
            choice = moved
        drives.append(choice)
    return tuple(drives) if farthest > _MOVES else None


def _of_doubts(found: "Identification", sample: Sample) -> Iterator[Array]:
    """Yield by how much terms that were nearly taken would move base parameters, (b,) each."""
    if not any(choice.doubted for choice in found.drives):
        return
    motions = _motions(found)
    for choice in found.drives:
        if not choice.doubted:
            continue
        j = sample.joints.index(choice.joint)
        columns = [
            np.column_stack([term.column(motion.of(j)) for term in choice.doubted])[rows]
            for motion, rows in zip(motions, sample.taken, strict=True)
        ]
        _, whole = trials(sample, slice(j, j + 1), np.concatenate(columns)[:, None])
        yield -whole.T[:, :-1] @ whole.parameters(list(range(len(choice.doubted))))


def _motions(found: "Identification") -> list[DriveMotion]:
    """Return how the drives move along each recording, as ``Sample.taken`` counts them."""
    kept = [e for e in found.validation if not e.is_refitted]
    recordings = [e.recording for e in (*found.fitted, *kept)]
    return [drive_motion_along(found.model, x.trajectory) for x in recordings]


def shape_slope(
    found: "Identification", choice: "DriveChoice", which: int, motion: DriveMotion
) -> Array:
    """Return how the torque of a joint's drive changes with one of its shapes, shape (N,).

    Args:
        found: The identification.
        choice: The joint's terms.
        which: Which of its shapes.
        motion: How the drive moves, arrays of shape (N,).
    """
    layout = found.model.layout
    theta = dict(zip(layout.names, found.standard, strict=True))
    size = choice.shapes[which].value * _STEP
    change = np.zeros_like(motion.v)
    for term, other in zip(choice.terms, choice.altered(which, _STEP), strict=True):
        change += theta[f"{choice.joint}.{term.name}"] * (
            other.column(motion) - term.column(motion)
        )
    slope: Array = change / size
    return slope
