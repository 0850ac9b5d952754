"""Misfit of the drive models: tests the residual of a fit for terms that drives may have."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.residual.candidates import CANDIDATES, Candidate, couplings, ripples
from robotid.diagnosis.residual.decisions import (
    CONFIRMED,
    MISFIT,
    MISFIT_MATTERS,
    MISFIT_REPORTED,
    MISFIT_WARNS,
    ONE_SIDED,
)
from robotid.diagnosis.residual.selection import Round, select
from robotid.diagnosis.residual.term_trials import Sample, Trial, Trials
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import has_turned


@dataclass(frozen=True)
class Misfit:
    """A term that the model of a joint's drive lacks.

    Attributes:
        joint: The joint.
        term: The term.
        share: Share of the joint's squared residual in held-out segments that it explains beyond
            the terms found before it [-].
        p_value: p-value of that share [-].
        confirmed: The same share on the validation logs; None without one.
        size: Its parameter, or its RMS torque, see the units of the term.
        std_error: Standard error of the size.
        unit: Unit of the size.
        error: Residual of a fit without the term, over the torque [-].
        shift: Change of the base parameters over their prior spread with it, shape (b,).
        theta: The parameters of its columns, shape (c,).
        scale: The motion that sets the scale of its columns.
        entries: Entries of the joint in a job's [drives] that add it; none if there are none.
        trend: Change of the friction at the RMS speed per minute, and its standard error [N m/min
            or N/min], of a drift with time; NaN of other terms.
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
    trend: tuple[float, float] = (math.nan, math.nan)

    def torque(self, motion: JointMotion) -> Array:
        """Return the torque of the term along a motion of the joint, shape (N,) [N m or N]."""
        torque: Array = self.term.columns(replace(motion, scale=self.scale)) @ self.theta
        return torque

    @property
    def matters(self) -> bool:
        """Whether it is a warning."""
        explained = np.sqrt(self.share) * self.error
        is_denied = self.confirmed is not None and self.confirmed < CONFIRMED * self.share
        is_uncertain = is_denied or self.term.is_imitated
        return bool(self.share >= MISFIT_WARNS and explained >= MISFIT_MATTERS and not is_uncertain)


def find_misfits(sample: "Sample | None") -> tuple[Misfit, ...]:
    """Return the terms that would explain a part of the residual of a fit, the largest first."""
    if sample is None:
        return ()
    found = [misfit for j in range(len(sample.joints)) for misfit in _of_joint(sample, j)]
    coupled = [(m.joint, m.term.coupled) for m in found]
    # a coupled drive loads both joints
    return tuple(
        m for m in found
        if not m.term.coupled or m.share > ONE_SIDED or (m.term.coupled, m.joint) in coupled
    )  # fmt: skip


def _of_joint(sample: Sample, j: int) -> Iterator[Misfit]:
    """Yield the terms that a joint's drive model lacks, one after the other."""
    motion = sample.motions[j]
    if not sample.weight[: sample.rows, j].any() or not sample.torque[j]:
        return  # of a torque of 0 there is no relative error
    fitted = slice(sample.rows)
    periodic = ripples(motion.at(fitted), sample.weight[fitted, j], sample.r[fitted, j])
    every = (*CANDIDATES, *couplings(motion), *periodic)
    own = [c for c in every if not (c.revolute_only and sample.is_prismatic[j])]
    columns = [candidate.columns(motion) for candidate in own]
    ends = np.cumsum([x.shape[1] for x in columns]).tolist()
    place = {
        candidate: list(range(end - x.shape[1], end))
        for candidate, x, end in zip(own, columns, ends, strict=True)
    }
    trials = Trials(sample.of_joint(j), np.hstack(columns)[:, None])
    held_out, whole = trials.held_out, trials.whole
    chosen: list[int] = []
    total = before = held_out.left([])
    squares = float(total[: sample.fitted].sum())
    error = float(np.sqrt(squares / sample.torque[j]))

    def offered() -> Round[Candidate]:
        left = held_out.left_each({c: [*chosen, *place[c]] for c in own})
        return Round(before, left, sample.fitted, squares)

    found = select(offered, MISFIT, lambda c: len(place[c]), attrgetter("tried"))
    for this, best in found:
        if best is None:
            return
        share, new = this.share(best), place[best]
        size, std_error, unit = _size(sample, j, best, whole, chosen, new)
        theta = whole.parameters([*chosen, *new])[len(chosen) :]
        unfitted = [
            whole.left(which)[sample.fitted :].sum() for which in ([], chosen, [*chosen, *new])
        ]
        if np.sqrt(share) * error >= MISFIT_REPORTED:
            yield Misfit(
                joint=sample.joints[j],
                term=best,
                share=share,
                p_value=this.p_value(best),
                confirmed=float((unfitted[1] - unfitted[2]) / unfitted[0])
                if unfitted[0] > 0
                else None,
                size=size,
                std_error=std_error,
                unit=unit,
                error=error,
                shift=-whole.T[: len(sample.U), new] @ theta,
                theta=theta,
                scale=motion,
                entries=_entries(sample, j, best),
                trend=_trend(sample, j, best, whole, chosen, new),
            )
        chosen += new
        before, own = this.left[best], [c for c in own if c.code != best.code]


def _entries(sample: Sample, j: int, term: Candidate) -> tuple[str | DriveTerm, ...]:
    """Return the entries of a joint in a job's [drives] that add a term; none if there are none."""
    angle = 0.0 if sample.is_prismatic[j] else float(np.ptp(sample.motions[j].q[: sample.rows]))
    families = [name for name in term.families if has_turned(name, angle)]
    return tuple(families[:1]) or term.terms


def _trend(
    sample: Sample, j: int, term: Candidate, whole: Trial, before: list[int], new: list[int]
) -> tuple[float, float]:
    """Return the change of the friction at the RMS speed per minute, of a drift, and its error."""
    if term.code != "drift":
        return math.nan, math.nan
    theta, covariance = whole.estimate([*before, *new], sample.fitted)
    own, motion = slice(len(before), None), sample.motions[j].at(slice(sample.rows))
    speed = float(np.sqrt(np.mean(motion.v**2)))
    per_minute = np.array([1.0, speed, 0.0]) * 60.0 / motion.longest  # of direction, v and 1
    error = float(np.sqrt(per_minute @ covariance[own, own] @ per_minute))
    return float(per_minute @ theta[own]), error


def _size(
    sample: Sample, j: int, term: Candidate, whole: Trial, before: list[int], new: list[int]
) -> tuple[float, float, str]:
    """Return the size of a term fitted with those found before, its standard error and unit."""
    theta, covariance = whole.estimate([*before, *new], sample.fitted)
    own = slice(len(before), None)
    theta, covariance, S = theta[own], covariance[own, own], whole.S[new][:, new]
    if term.units is not None:
        error = float(np.sqrt(covariance[0, 0]))
        return float(theta[0]), error, term.units[int(sample.is_prismatic[j])]
    # RMS torque that base parameters cannot explain: size^2 = theta^T S theta
    S = S / np.sum(sample.weight[: sample.rows, j] ** 2)
    size, slope = float(np.sqrt(theta @ S @ theta)), S @ theta
    error = float(np.sqrt(slope @ covariance @ slope)) / size
    return size, error, ("N m rms", "N rms")[int(sample.is_prismatic[j])]
