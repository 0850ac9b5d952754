"""Findings of terms that a drive model lacks, and the entries of a job file that add them."""

import json
import math
from collections.abc import Mapping, Sequence

from robotid.base.findings import Finding, listed, toml_key
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.residual.candidates import Candidate
from robotid.diagnosis.residual.decisions import MAIN
from robotid.diagnosis.residual.misfit import Misfit
from robotid.estimation.fitting.fitted import Fit
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import COUNTERBALANCE, drive_line, spring_family

_OF_POSITION = ("position_periodic", "spring", "position_offset")
_BALANCES = ("counterbalance", "link_mass")
_OF_MASSES = (*_BALANCES, "current_for_torque", "urdf_mismatch")
_SPRINGS = ("ripple", "spring")  # parts of the torque that depend on the position
_DIGITS = "0123456789"


def misfit_findings(fit: Fit, misfits: Sequence[Misfit], on_misfit: Sequence[str]) -> list[Finding]:
    """Return a finding for each term that a drive model lacks."""
    return [_finding(misfit, fit, on_misfit) for misfit in misfits]


def setting_of(misfit: Misfit, fit: Fit) -> str:
    """Return the entry of a job file that adds a term to the model; empty if there is none.

    It is a line of [drives] that includes the present terms of the joint, or a table [[coupling]].
    """
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


def counterbalanced(found: Sequence[Finding], logs: Sequence[str]) -> dict[str, str]:
    """Return the family of the counterbalance of each joint with one in the fitted logs."""
    return {
        joint: spring_family(one.evidence["turned"], COUNTERBALANCE)
        for one in found
        for joint in one.joints
        if one.code in _BALANCES and one.log in logs
    }


def with_known_springs(
    found: Sequence[Finding], fit: Fit, wanted: Mapping[str, Sequence[str] | None]
) -> list[Finding]:
    """Return the findings before a fit; a counterbalance that its model includes becomes a note.

    A spring that a wrong mass would imitate becomes a note only if it was stated, not selected.
    """
    own = fit.model.layout.own
    springs = {joint for joint, terms in own.items() if any(t.part in _SPRINGS for t in terms)}
    auto = [c for c in fit.drives if wanted[c.joint] is None]
    selected = {c.joint for c in auto if any(t.part in _SPRINGS for t in c.terms)}
    known = {"counterbalance": springs, "link_mass": springs - selected}

    def as_known(one: Finding) -> Finding:
        joint = one.joints[0] if one.joints else ""
        if joint not in known.get(one.code, ()):
            return one
        names = listed(term.name for term in own[joint] if term.part in _SPRINGS)
        remedy = f". The model includes it: {names} of {{joint}}"
        return one.reworded(severity="note", remedy=remedy)

    return [as_known(one) for one in found]


def settled(found: Sequence[Finding], of_fit: Sequence[Finding]) -> list[Finding]:
    """Return the findings before and of the fit, without hypotheses that a term explains.

    The doctor's model has no springs: it attributes a torque that depends on the position to wrong
    masses, or to nothing. The term that explains it is then a warning, even if it is small.
    """
    rest, terms = list(found), []
    for term in of_fit:
        hypotheses = [f for f in rest if _explains(term, f)]
        rest = [f for f in rest if f not in hypotheses]
        if hypotheses:
            codes = listed(dict.fromkeys(f.code for f in hypotheses))
            term = term.reworded(
                severity="warning",
                remedy=f"{term.remedy}. It explains {codes} and may bias the masses",
                evidence={**term.evidence, "replaces": float(len(hypotheses))},
            )
        terms.append(term)
    return rest + terms


def _explains(term: Finding, hypothesis: Finding) -> bool:
    """Return whether a term of the fit explains a hypothesis from before the fit."""
    if term.evidence.get("share_pct", 0.0) < MAIN:
        return False
    if hypothesis.code == "unexplained_torque":
        return bool(hypothesis.joints) and hypothesis.joints == term.joints
    return hypothesis.code in _OF_MASSES and term.code in _OF_POSITION


def _advice(term: Candidate, setting: str) -> str:
    """Return the remedy for a term that the model lacks, as text."""
    if not setting:
        return term.advice
    table, *lines = setting.split("\n")
    if term.coupled:
        size = "with the second ratio from the data sheet"
        return f"Add {table} to the job: {' and '.join(lines)}, {size}"
    added = f"add it to the model with {lines[0]} in {table}"
    return f"{term.advice}, or {added}" if term.advice else f"{added[0].upper()}{added[1:]}"


def _finding(misfit: Misfit, found: Fit, on_misfit: Sequence[str]) -> Finding:
    term, validation = misfit.term, misfit.confirmed
    wide = [name for name in on_misfit if name.startswith(f"{misfit.joint}.")]
    figures = {
        "share_pct": 100 * misfit.share,
        "error_pct": 100 * misfit.error,
        "size": misfit.size,
        "std_error": misfit.std_error,
        "p_value": misfit.p_value,
    }
    change, error = misfit.trend
    drifts = not math.isnan(change)
    if drifts:
        figures |= {"trend": change, "trend_std_error": error}
    if validation is not None:
        percent = 100 * validation
        figures |= {"validation_share_pct": percent, "validated_pct": max(percent, 0.0)}
    cure = _advice(term, setting_of(misfit, found)) or "The model has no such term"
    return finding(
        term.code, "", misfit.joint, severity="warning" if misfit.matters else "note",
        meaning=term.meaning, unit=misfit.unit, trend_unit=misfit.unit.removesuffix(" rms"),
        change=drifts, sense=change < 0, confirmed=validation is not None, cure=cure,
        widened=bool(wide), wide=listed(wide), **figures,
    )  # fmt: skip
