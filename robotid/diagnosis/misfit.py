"""What the drive model lacks: the residual of a fit against terms that drives may have."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from robotid._typing import Array
from robotid.diagnosis.candidates import CANDIDATES, Candidate, couplings, ripples
from robotid.diagnosis.decisions import (
    CONFIRMED,
    MISFIT,
    MISFIT_MATTERS,
    MISFIT_SEEN,
    MISFIT_WARNS,
    ONE_SIDED,
)
from robotid.diagnosis.sample import Sample, Trial, Trials
from robotid.diagnosis.selection import Round, select
from robotid.fitting.joint_motion import JointMotion
from robotid.robot.drives import DriveTerm
from robotid.robot.families import has_turned

__all__ = ["Misfit", "find_misfits"]


@dataclass(frozen=True)
class Misfit:
    """A term that the model of a joint's drive lacks.

    Attributes:
        joint: The joint.
        term: The term.
        share: Share of the joint's squared residual that it explains in segments that were left
            out of the fit, beyond the terms found before it [-].
        p_value: How likely that is without such a term [-].
        confirmed: The same share of the validation recordings; None without one.
        size: Its parameter, or the root mean square of its torque, as the term's units say.
        std_error: Standard error of the size.
        unit: Unit of the size.
        error: Residual that base parameters leave without the term, over the torque [-].
        shift: By how much it would move base parameters over their spread, shape (b,).
        theta: The parameters of its columns, shape (c,).
        scale: The motion that scales its columns.
        entries: What a job's [drives] says of the joint to add it; none if nothing does.
    """

    joint: str
    term: Candidate
    share: float
    p_value: float
    confirmed: float | None
    size: float
    std_error: float
    unit: str
    error: float
    shift: Array
    theta: Array
    scale: JointMotion
    entries: tuple[str | DriveTerm, ...] = ()

    def torque(self, motion: JointMotion) -> Array:
        """Return the torque of the term along a motion of the joint, shape (N,) [N m or N].

        Args:
            motion: The motion, N rows.
        """
        torque: Array = self.term.columns(replace(motion, scale=self.scale)) @ self.theta
        return torque

    @property
    def matters(self) -> bool:
        """Whether it is a warning."""
        explained = np.sqrt(self.share) * self.error
        is_denied = self.confirmed is not None and self.confirmed < CONFIRMED * self.share
        is_doubted = is_denied or self.term.is_imitated
        return bool(self.share >= MISFIT_WARNS and explained >= MISFIT_MATTERS and not is_doubted)


def find_misfits(sample: "Sample | None") -> tuple[Misfit, ...]:
    """Return the terms that would explain a part of what the fit leaves, the largest first.

    Args:
        sample: Rows of the recordings; None if they are too few to judge by.
    """
    if sample is None:
        return ()
    found = [misfit for j in range(len(sample.joints)) for misfit in _of_joint(sample, j)]
    coupled = [(m.joint, m.term.coupled) for m in found]
    # a drive that turns with two joints loads both
    return tuple(
        m for m in found
        if not m.term.coupled or m.share > ONE_SIDED or (m.term.coupled, m.joint) in coupled
    )  # fmt: skip


def _of_joint(sample: Sample, j: int) -> Iterator[Misfit]:
    """Yield the terms that a joint's drive lacks, one after the other."""
    motion = sample.motions[j]
    if not sample.weight[: sample.rows, j].any():
        return
    fitted = slice(sample.rows)
    periodic = ripples(motion.at(fitted), sample.weight[fitted, j], sample.r[fitted, j])
    every = (*CANDIDATES, *couplings(motion), *periodic)
    own = [c for c in every if not (c.turns and sample.slides[j])]
    columns = [candidate.columns(motion) for candidate in own]
    ends = np.cumsum([x.shape[1] for x in columns]).tolist()
    place = {
        candidate: list(range(end - x.shape[1], end))
        for candidate, x, end in zip(own, columns, ends, strict=True)
    }
    trials = Trials(sample.of_joint(j), np.hstack(columns)[:, None])
    apart, whole = trials.apart, trials.whole
    chosen: list[int] = []
    total = before = apart.left([])
    squares = float(total[: sample.fitted].sum())
    error = float(np.sqrt(squares / sample.torque[j]))

    def offered() -> Round[Candidate]:
        left = apart.left_each({c: [*chosen, *place[c]] for c in own})
        return Round(before, left, sample.fitted, squares)

    found = select(offered, MISFIT, lambda c: len(place[c]), attrgetter("tried"))
    for this, best in found:
        if best is None:
            return
        share, new = this.share(best), place[best]
        size, std_error, unit = _size(sample, j, best, whole, chosen, new)
        theta = whole.parameters([*chosen, *new])[len(chosen) :]
        kept = [whole.left(which)[sample.fitted :].sum() for which in ([], chosen, [*chosen, *new])]
        if np.sqrt(share) * error >= MISFIT_SEEN:
            yield Misfit(
                joint=sample.joints[j],
                term=best,
                share=share,
                p_value=this.p_value(best),
                confirmed=float((kept[1] - kept[2]) / kept[0]) if kept[0] > 0 else None,
                size=size,
                std_error=std_error,
                unit=unit,
                error=error,
                shift=-whole.T[: len(sample.U), new] @ theta,
                theta=theta,
                scale=motion,
                entries=_entries(sample, j, best),
            )
        chosen += new
        before, own = this.left[best], [c for c in own if c.code != best.code]


def _entries(sample: Sample, j: int, term: Candidate) -> tuple[str | DriveTerm, ...]:
    """Return what a job's [drives] says of a joint to add a term to it; none if nothing does."""
    turned = 0.0 if sample.slides[j] else float(np.ptp(sample.motions[j].q[: sample.rows]))
    families = [name for name in term.families if has_turned(name, turned)]
    return tuple(families[:1]) or term.terms


def _size(
    sample: Sample, j: int, term: Candidate, whole: Trial, before: list[int], new: list[int]
) -> tuple[float, float, str]:
    """Return the size of a term beside those found before, its standard error and unit."""
    theta, covariance = whole.estimate([*before, *new], sample.fitted)
    own = slice(len(before), None)
    theta, covariance, S = theta[own], covariance[own, own], whole.S[new][:, new]
    if term.units is not None:
        error = float(np.sqrt(covariance[0, 0]))
        return float(theta[0]), error, term.units[int(sample.slides[j])]
    # root mean square of the torque that base parameters cannot explain: size^2 = theta^T S theta
    S = S / np.sum(sample.weight[: sample.rows, j] ** 2)
    size, slope = float(np.sqrt(theta @ S @ theta)), S @ theta
    error = float(np.sqrt(slope @ covariance @ slope)) / size
    return size, error, ("N m rms", "N rms")[int(sample.slides[j])]
