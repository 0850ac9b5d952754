"""Terms that drive models lack: candidates, tests of the residual, and their findings."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import attrgetter

import numpy as np

from robotid.base.findings import Finding, listed, toml_key
from robotid.base.typing import Array
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.residual.term_trials import Sample, Trials
from robotid.estimation.fitting.drive_terms import JointMotion
from robotid.estimation.fitting.fitted import Fit
from robotid.robot.drive_term import DriveMotion, DriveTerm, Family
from robotid.robot.drives import FAMILIES, Harmonic, drive_line, has_turned

_RIPPLES = np.arange(5, 241)  # periods per revolution tested: 200 of a gear of 100 : 1
_PEAKS = 6  # of them are tested: those with the largest periodic residual
_STEEP = 2 * SignalSettings.order  # of the filter, which is applied in both directions
_WINDUP = (0.02, 0.1)  # of the RMS displacement since a reversal: decay of a deflection
_OF_POSITION = ("position_periodic", "spring", "position_offset")
_OF_FORCE = ("gravity", "moving_gravity", "external_force")
_OF_MASSES = ("current_for_torque", "urdf_mismatch")
_DIGITS = "0123456789"


@dataclass(frozen=True)
class Misfit:
    """A term that the model of a joint's drive lacks."""

    joint: str
    term: Candidate
    share: float  # of the joint's squared residual that it explains beyond those before it [-]
    p_value: float  # of that share [-]
    confirmed: float | None  # the same share on the validation logs; None without one
    size: float  # its parameter, or its RMS torque, see the units of the term
    std_error: float  # of the size
    unit: str  # of the size
    error: float  # residual of a fit without the term, over the torque [-]
    shift: Array  # (b,), change of the base parameters over their prior spread with it
    theta: Array  # (c,), parameters of its columns
    scale: JointMotion  # the motion that sets the scale of its columns
    entries: tuple[str | DriveTerm, ...] = ()  # of the joint in [drives] that add it
    #: Of a drift: change of the friction at the RMS speed [N m/min, N/min], and standard error.
    trend: tuple[float, float] = (math.nan, math.nan)

    def torque(self, motion: JointMotion) -> Array:
        """Return the torque of the term along a motion of the joint, shape (N,) [N m or N]."""
        return np.asarray(self.term.columns(replace(motion, scale=self.scale)) @ self.theta)

    @property
    def matters(self) -> bool:
        """Whether it is a warning."""
        explained = np.sqrt(self.share) * self.error
        is_denied = self.confirmed is not None and self.confirmed < decisions.CONFIRMED * self.share
        is_uncertain = is_denied or self.term.is_imitated
        return bool(
            self.share >= decisions.MISFIT_WARNS
            and explained >= decisions.MISFIT_MATTERS
            and not is_uncertain
        )


def find_misfits(sample: Sample | None) -> tuple[Misfit, ...]:
    """Return the terms that would explain a part of the residual of a fit, the largest first."""
    if sample is None:
        return ()
    misfits = [misfit for j in range(len(sample.joints)) for misfit in _of_joint(sample, j)]
    coupled = [(m.joint, m.term.coupled) for m in misfits]  # a coupled drive loads both joints
    return tuple(
        m for m in misfits
        if not m.term.coupled
        or m.share > decisions.ONE_SIDED or (m.term.coupled, m.joint) in coupled
    )  # fmt: skip


def clipped(sample: Sample | None) -> Iterator[Finding]:
    """Yield torques that stay at their largest value where a larger one is predicted, by log."""
    if sample is None or sample.weight.shape[1] > len(sample.joints):
        return
    tau, least = np.concatenate([motion.tau for motion in sample.at]), decisions.SHARE_OF_ROWS
    names = np.repeat([x.log.name for x in sample.recordings], [len(k) for k in sample.taken])
    for name, (j, joint) in product(dict.fromkeys(names.tolist()), enumerate(sample.joints)):
        used = (names == name) & (sample.weight[:, j] > 0.0)
        x, predicted = tau[used, j], tau[used, j] - sample.r[used, j] / sample.weight[used, j]
        for sign in (1.0, -1.0) if used.any() else ():
            limit = sign * np.quantile(sign * x, 1.0 - 0.5 * least)
            beyond = sign * (predicted - limit) > decisions.AGREES * np.std(x)
            if (share := float(np.mean(beyond))) > least:
                slope = np.polyfit(predicted[beyond], x[beyond], 1)[0]
                spread = np.std(x[beyond]) / np.std(predicted[beyond])
                if abs(slope) < decisions.ZERO and spread < decisions.BETTER**2:
                    yield finding("clipped", name, joint, limit=limit, share=share)


def _of_joint(sample: Sample, j: int) -> Iterator[Misfit]:
    """Yield the terms that a joint's drive model lacks, one after the other."""
    motion, fitted = sample.motions[j], slice(sample.rows)
    weight, is_prismatic = sample.weight[fitted, j], bool(sample.is_prismatic[j])
    if not weight.any() or not sample.torque[j]:
        return  # of a torque of 0 there is no relative error
    periodic = ripples(motion.at(fitted), weight, sample.r[fitted, j])
    every = (*CANDIDATES, *couplings(motion), *periodic)
    columns = {
        candidate: candidate.columns(motion)[:, None]
        for candidate in every
        if not (candidate.revolute_only and is_prismatic)
    }
    trials, place = Trials.of(sample.of_joint(j), columns)
    squares = float(trials.held_out.left([])[: sample.fitted].sum())
    error = float(np.sqrt(squares / sample.torque[j]))
    angle = 0.0 if is_prismatic else float(np.ptp(motion.q[fitted]))
    for accepted in trials.accepted(
        place, decisions.MISFIT, lambda c: len(place[c]), attrgetter("tried"),
        lambda one, other: one.code == other.code,
    ):  # fmt: skip
        best, new, theta = accepted.option, place[accepted.option], accepted.theta
        S = trials.whole.S[new][:, new] / np.sum(weight**2)
        size, std_error = _size(best, theta, accepted.covariance, S)
        trend = (math.nan, math.nan)
        if best.code == "drift":
            speed = float(np.sqrt(np.mean(motion.v[fitted] ** 2)))
            per_minute = np.array([1.0, speed, 0.0]) * 60.0 / motion.longest  # direction, v and 1
            trend_error = float(np.sqrt(per_minute @ accepted.covariance @ per_minute))
            trend = float(per_minute @ theta), trend_error
        families = [name for name in best.families if has_turned(name, angle)]
        if np.sqrt(accepted.share) * error >= decisions.LEAST_TERM:
            yield Misfit(
                sample.joints[j], best, accepted.share, accepted.p_value, accepted.confirmed,
                size, std_error, (best.units or ("N m rms", "N rms"))[int(is_prismatic)], error,
                -trials.whole.T[: len(sample.U), new] @ theta, theta, motion,
                tuple(families[:1]) or best.terms, trend,
            )  # fmt: skip


def _size(term: Candidate, theta: Array, covariance: Array, S: Array) -> tuple[float, float]:
    """Return the size of a term and its standard error: a parameter, or its RMS torque."""
    if term.units is not None:
        return float(theta[0]), float(np.sqrt(covariance[0, 0]))
    # RMS torque that base parameters cannot explain: size^2 = theta^T S theta
    size, slope = float(np.sqrt(theta @ S @ theta)), S @ theta
    return size, float(np.sqrt(slope @ covariance @ slope)) / size


@dataclass(frozen=True)
class Candidate:
    """A term that a drive's torque may have, linear in its parameters."""

    name: str  # Its name
    code: str  # Code of the finding that reports it
    columns: Callable[[JointMotion], Array]  # (N, c), scaled by that motion or the one it names
    meaning: str  # Description of the term for a finding
    advice: str = ""  # Remedy other than adding it to the model; empty if none
    #: Unit of the parameter of a revolute and a prismatic joint; None: its size is an RMS torque.
    units: tuple[str, str] | None = None
    revolute_only: bool = False  # Whether only a revolute joint has it
    families: tuple[str, ...] = ()  # of ``FAMILIES`` that contain it, the best advice first
    #: Terms of a job's [drives] that are equal to it, if no family is
    terms: tuple[DriveTerm, ...] = ()
    tried: int = 1  # Number of such terms among which the residual selected it
    coupled: str = ""  # The other joint of a coupling; empty if none
    ratio: float = 0.0  # Ratio of the other joint; that of the joint itself is 1
    #: Whether stiction at reversals looks like it behind a filter: it is a note at most
    is_imitated: bool = False


def _rms(m: JointMotion, of: Callable[[JointMotion], Array]) -> float:
    """Return the RMS value of a signal of the motion that sets the scale; 1 if it is 0."""
    return float(np.sqrt(np.mean(of(m.scale or m) ** 2))) or 1.0


def _of_terms(m: JointMotion, family: Family) -> Array:
    """Return the columns of a family's terms, shape (N, c)."""
    motion = DriveMotion(m.q, m.v, m.a, m.direction, m.load, np.zeros_like(m.v))
    terms = family.tested_terms(_rms(m, attrgetter("v")))
    return np.column_stack([term.column(motion) for term in terms])


def _of_family(family: Family) -> Candidate:
    """Return the candidate of a family of drive terms."""
    units = family.tested_terms(1.0)[0].units if family.has_size else None
    return Candidate(
        family.name, family.code, partial(_of_terms, family=family), family.meaning, family.advice,
        units=units, revolute_only=family.needs > 0, families=(family.name, *family.instead),
        is_imitated=family.is_imitated,
    )  # fmt: skip


def _ripple(m: JointMotion, count: int) -> Array:
    """Return cosine and sine of a multiple of the position, after the filter of torques."""
    waves = np.array([np.cos(count * m.q), np.sin(count * m.q)])
    return np.asarray((_passed(m, np.array([count])) * waves).T)


def _passed(m: JointMotion, counts: Array) -> Array:
    """Return the filter's gain for torques with k periods per revolution, shape (k, N)."""
    rate = np.abs(m.v) / (2 * np.pi * m.passes)  # revolutions per second over the cut-off
    return np.asarray(1.0 / (1.0 + np.outer(counts.astype(float) ** _STEEP, rate**_STEEP)))


def ripples(m: JointMotion, weight: Array, r: Array) -> tuple[Candidate, ...]:
    """Return candidates of a torque periodic in the position, from the residual's spectrum."""
    first = np.exp(1j * m.q)
    wave = first ** _RIPPLES[0]  # e^(i count q)
    explained = np.zeros(len(_RIPPLES))
    for k, size in enumerate(weight * _passed(m, _RIPPLES)):
        if power := size @ size:
            explained[k] = np.abs((r * size) @ wave) ** 2 / power
        wave *= first
    counts = _RIPPLES[np.sort(np.argsort(-explained)[:_PEAKS])]
    return tuple(
        Candidate(
            f"ripple {count}", "position_periodic", partial(_ripple, count=count),
            f"a torque with {count} periods per revolution (gear teeth, motor poles, harmonic "
            "drive)",
            revolute_only=True,
            terms=(Harmonic(order=float(count)), Harmonic(order=float(count), is_sine=True)),
            tried=len(_RIPPLES),
        )
        for count in counts.tolist()
    )  # fmt: skip


def _sense(m: JointMotion, of: Callable[[JointMotion], Array]) -> Array:
    """Return the sign of a signal, shape (N,), continuous where it is about 0."""
    return np.asarray(np.tanh(of(m) / (decisions.ZERO * _rms(m, of))))


def _windup(m: JointMotion) -> Array:
    displacement = m.travelled[:, None] / (np.array(_WINDUP) * _rms(m, attrgetter("travelled")))
    deflection = m.direction[:, None] * np.exp(-displacement)
    return np.column_stack([deflection, _sense(m, attrgetter("load"))])


def _coupled(m: JointMotion, other: str, ratio: float) -> Array:
    """Return columns of a drive at the speed w = v + ratio v' of both joints, at the first."""
    speed = _sense(m, lambda x: x.v + ratio * x.others[other].v if other in x.others else x.v)
    partner, rest = m.others.get(other), np.zeros_like(m.v)
    own = (rest, rest) if partner is None else (partner.a, partner.v)
    return np.column_stack([*own, speed])


#: The candidates of each joint, without couplings and ripples, an entry each.
CANDIDATES = (
    Candidate(
        "coulomb", "friction_shape", lambda m: m.direction[:, None], "Coulomb friction",
        "Set friction = 'viscous+coulomb' in [model]",
    ),
    *(_of_family(family) for family in FAMILIES.values() if family.code),
    Candidate(
        "windup", "backlash", _windup,
        "a torque that changes after each reversal, or with the loaded side of the gear "
        "(backlash, windup)",
        "Increase min_velocity to exclude the reversals",
    ),
    Candidate(
        "drift", "drift",
        lambda m: m.time[:, None] * np.column_stack([m.direction, m.v, np.ones_like(m.v)]),
        "friction or an offset that drifts with time (warm-up of the drive)",
        "Warm the robot up before recording, or cut the log with start",
    ),
)  # fmt: skip


def couplings(motion: JointMotion) -> tuple[Candidate, ...]:
    """Return candidates of a drive coupled to a joint and to the joint before or after it."""
    return tuple(
        Candidate(
            f"coupling {ratio:+g} {name}", "coupling",
            partial(_coupled, other=name, ratio=ratio),
            f"a drive that is coupled to {name}",
            coupled=name,
            ratio=ratio,
        )
        for name in motion.others
        for ratio in (1.0, -1.0)
    )  # fmt: skip


def setting_of(misfit: Misfit, fit: Fit) -> str:
    """Return the entry of a job file that adds a term to the model; empty if there is none."""
    joint, other = misfit.joint, misfit.term.coupled
    if other:
        ratios = f"{toml_key(joint)} = 1.0, {toml_key(other)} = {misfit.term.ratio}"
        return f"[[coupling]]\nname = {json.dumps(f'{joint}_{other}')}\nratios = {{ {ratios} }}"
    if not misfit.entries:
        return ""
    return f"[drives]\n{with_entries(fit, joint, misfit.entries)}"


def with_entries(fit: Fit, joint: str, entries: Sequence[str | DriveTerm]) -> str:
    """Return the line of a job's [drives] that adds entries to the present ones of a joint."""
    (families, chosen), *_ = [
        *((c.families, c.terms) for c in fit.drives if c.joint == joint),
        ((), ()),
    ]
    stated = [t for t in fit.model.layout.own.get(joint, ()) if t not in chosen]
    kinds = {entry.rstrip(_DIGITS) for entry in entries if isinstance(entry, str)}
    others = [name for name in families if name.rstrip(_DIGITS) not in kinds]
    return drive_line(joint, *stated, *others, *entries)


def settled(before: Sequence[Finding], of_fit: Sequence[Finding]) -> list[Finding]:
    """Return the findings before and of the fit, without hypotheses that a term explains."""
    # The doctor attributes a torque that depends on the position to wrong masses. The term that
    # explains it is then a warning, even if it is small.
    rest, terms = list(before), []
    for term in of_fit:
        hypotheses = [f for f in rest if _explains(term, f)]
        rest = [f for f in rest if f not in hypotheses]
        if hypotheses:
            codes = listed(dict.fromkeys(f.code for f in hypotheses))
            term = term.reworded(
                severity=max("warning", term.severity, key=("note", "warning", "error").index),
                remedy=f"{term.remedy}. It explains {codes} and may bias the masses",
                evidence={**term.evidence, "replaces": float(len(hypotheses))},
            )
        terms.append(term)
    return rest + terms


def _explains(term: Finding, hypothesis: Finding) -> bool:
    """Return whether a term of the fit explains a hypothesis from before the fit."""
    shares = [term.evidence.get(key, np.inf) for key in ("share_pct", "validation_share_pct")]
    if "share_pct" not in term.evidence or min(shares) < decisions.MAIN:
        return False
    if hypothesis.code in ("unexplained_torque", "torque_delay"):
        return not term.joints or hypothesis.joints == term.joints
    if hypothesis.code in _OF_MASSES and "gain" not in hypothesis.evidence:  # no certain reading
        return term.code in (*_OF_POSITION, *_OF_FORCE)
    is_uncertain = hypothesis.code == "gravity" and hypothesis.severity != "error"
    return is_uncertain and term.code in _OF_FORCE


def _advice(term: Candidate, setting: str) -> str:
    """Return the remedy for a term that the model lacks, as text."""
    if not setting:
        return term.advice
    table, *lines = setting.split("\n")
    if term.coupled:
        added = f"Add {table} to the job: {' and '.join(lines)}"
        return f"{added}, with the second ratio from the data sheet"
    added = f"add it to the model with {lines[0]} in {table}"
    return f"{term.advice}, or {added}" if term.advice else f"{added[0].upper()}{added[1:]}"


def misfit_finding(misfit: Misfit, fit: Fit, on_misfit: Sequence[str]) -> Finding:
    """Return the finding for a term that a drive model lacks."""
    term, validation = misfit.term, misfit.confirmed
    wide = [name for name in on_misfit if name.startswith(f"{misfit.joint}.")]
    figures = {
        "share_pct": 100 * misfit.share, "error_pct": 100 * misfit.error, "size": misfit.size,
        "std_error": misfit.std_error, "p_value": misfit.p_value,
    }  # fmt: skip
    change, error = misfit.trend
    drifts = not math.isnan(change)
    if drifts:
        figures |= {"trend": change, "trend_std_error": error}
    if validation is not None:
        percent = 100 * validation
        figures |= {"validation_share_pct": percent, "validated_pct": max(percent, 0.0)}
    cure = _advice(term, setting_of(misfit, fit)) or "The model has no such term"
    return finding(
        term.code, "", misfit.joint, severity="warning" if misfit.matters else "note",
        meaning=term.meaning, unit=misfit.unit, trend_unit=misfit.unit.removesuffix(" rms"),
        change=drifts, sense=change < 0, confirmed=validation is not None, cure=cure,
        widened=bool(wide), wide=listed(wide), **figures,
    )  # fmt: skip
