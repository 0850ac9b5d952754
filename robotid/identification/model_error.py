"""Standard errors that know what the drive model lacks, and what it has been told of its shapes.

A term that the drives have and the model lacks moves the other parameters, by -T theta if theta is
what it would be. That is no noise, and does not shrink with the length of the log: its square adds
to their covariance. A shape that was found beside them has an error of its own, and so do they:

    C += sum_terms (T theta) (T theta)^T + sum_shapes T var(s) T^T,  T = (W^T W + C_0^-1)^-1 W^T z
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.identification.misfit import Misfit, Sample, trials
from robotid.regressor.memory import drive_motion_along
from robotid.robot.drives import DriveMotion

if TYPE_CHECKING:
    from robotid.identification.drive_choice import DriveChoice
    from robotid.identification.pipeline import Identification

__all__ = ["with_model_error"]

_STEP = 1e-3  # relative, of a derivative
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
    found = _wider(found, sample, list(_of_shapes(found, sample)))
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
    GX = found.mapping.gain(found.prior_std) @ X
    return replace(
        found,
        standard_covariance=found.standard_covariance + GX @ GX.T,
        base_error=np.sqrt(found.base_error**2 + np.sum(X**2, axis=1)),
    )


def _of_shapes(found: "Identification", sample: Sample) -> Iterator[Array]:
    """Yield by how much an error of each shape moves base parameters over their spread, (b,)."""
    if not any(choice.shapes for choice in found.drives):
        return
    kept = [e for e in found.validation if not e.is_refitted]
    recordings = [e.recording for e in (*found.fitted, *kept)]
    motions = [drive_motion_along(found.model, x.trajectory) for x in recordings]
    for choice in found.drives:
        j = sample.joints.index(choice.joint)
        for k, shape in enumerate(choice.shapes):
            slopes = [
                _slope(found, choice, k, motion.of(j))[rows]
                for motion, rows in zip(motions, sample.taken, strict=True)
            ]
            g = np.concatenate(slopes)[:, None, None]
            _, whole = trials(sample, slice(j, j + 1), g)
            yield -shape.std_error * whole.T[:, 0]


def _slope(
    found: "Identification", choice: "DriveChoice", which: int, motion: DriveMotion
) -> Array:
    """Return how the torque of a joint's drive changes with one of its shapes, shape (N,)."""
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
