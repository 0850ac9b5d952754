"""Findings of terms that the model of a drive lacks, and what the user can write to add them."""

import json
from collections.abc import Sequence
from dataclasses import replace

from robotid.diagnosis.candidates import Candidate
from robotid.diagnosis.decisions import MAIN
from robotid.diagnosis.misfit import Misfit
from robotid.findings import Finding, listed, toml_key
from robotid.fitting.result import Fit
from robotid.robot.drives import COUNTERBALANCE, DriveTerm
from robotid.robot.families import drive_line, spring_family

__all__ = [
    "counterbalanced",
    "misfit_findings",
    "setting_of",
    "settled",
    "with_entries",
    "with_known_springs",
]

_OF_POSITION = ("position_periodic", "spring", "position_offset")
_OF_MASSES = ("counterbalance", "current_for_torque", "urdf_mismatch")
_SPRINGS = ("ripple", "spring")  # parts of the torque that follow the position
_DIGITS = "0123456789"


def misfit_findings(fit: Fit, misfits: Sequence[Misfit], on_misfit: Sequence[str]) -> list[Finding]:
    """Return a finding for each term that the model of a drive lacks.

    Args:
        fit: What was found.
        misfits: The terms.
        on_misfit: Names of the drive parameters whose errors grew by them.
    """
    return [_finding(misfit, fit, on_misfit) for misfit in misfits]


def setting_of(misfit: Misfit, fit: Fit) -> str:
    """Return what to write into a job file to add a term to the model; empty if nothing does.

    A line of [drives], which has what the joint's drive has already, or a table [[coupling]].

    Args:
        misfit: The term.
        fit: What was found without it.
    """
    joint, other = misfit.joint, misfit.term.coupled
    if other:
        ratios = f"{toml_key(joint)} = 1.0, {toml_key(other)} = {misfit.term.ratio}"
        return f"[[coupling]]\nname = {json.dumps(f'{joint}_{other}')}\nratios = {{ {ratios} }}"
    if not misfit.entries:
        return ""
    return f"[drives]\n{with_entries(fit, joint, misfit.entries)}"


def with_entries(fit: Fit, joint: str, entries: Sequence[str | DriveTerm]) -> str:
    """Return the line of a job's [drives] that adds entries to what a joint's drive has.

    Args:
        fit: What was found without them.
        joint: The joint.
        entries: Names of families, or terms.
    """
    (families, chosen), *_ = [
        *((c.families, c.terms) for c in fit.drives if c.joint == joint),
        ((), ()),
    ]
    stated = [t for t in fit.model.layout.own.get(joint, ()) if t not in chosen]
    kinds = {entry.rstrip(_DIGITS) for entry in entries if isinstance(entry, str)}
    others = [name for name in families if name.rstrip(_DIGITS) not in kinds]
    return drive_line(joint, *stated, *others, *entries)


def counterbalanced(found: Sequence[Finding], logs: Sequence[str]) -> dict[str, str]:
    """Return the family of the counterbalance of each joint that the fitted logs show one of.

    Args:
        found: What was found before the fit.
        logs: Names of the fitted logs.
    """
    joints = {}
    for finding in found:
        log, _, joint = finding.where.rpartition(": ")
        if finding.code == "counterbalance" and log in logs:
            joints[joint] = spring_family(finding.evidence["turned"], COUNTERBALANCE)
    return joints


def with_known_springs(found: Sequence[Finding], fit: Fit) -> list[Finding]:
    """Return what was found before a fit, a counterbalance that its model has as a note.

    Args:
        found: What was found before the fit.
        fit: The fit, whose drives have their terms.
    """
    own = fit.model.layout.own
    springs = {joint for joint, terms in own.items() if any(t.part in _SPRINGS for t in terms)}

    def as_known(finding: Finding) -> Finding:
        joint = finding.where.rpartition(": ")[2]
        if finding.code != "counterbalance" or joint not in springs:
            return finding
        names = listed(term.name for term in own[joint] if term.part in _SPRINGS)
        message = f"{finding.message.partition('. Add')[0]}. The model has it: {names} of {joint}"
        return replace(finding, severity="note", message=message)

    return [as_known(finding) for finding in found]


def settled(found: Sequence[Finding], of_fit: Sequence[Finding]) -> list[Finding]:
    """Return what was found before the fit and of the fit, without guesses that a term explains.

    The doctor knows no springs: a joint whose torque follows its position weighs wrong for him, or
    its torque fits nothing. The term that explains it is a warning then, however little is left.

    Args:
        found: What was found before the fit.
        of_fit: What was found of the fit.
    """
    kept, terms = list(found), []
    for term in of_fit:
        guesses = [f for f in kept if _explains(term, f)]
        kept = [f for f in kept if f not in guesses]
        if guesses:
            codes = listed(dict.fromkeys(f.code for f in guesses))
            message = f"{term.message}. It explains {codes}, and may have gone into masses in part"
            evidence = {**term.evidence, "replaces": float(len(guesses))}
            term = replace(term, severity="warning", message=message, evidence=evidence)
        terms.append(term)
    return kept + terms


def _explains(term: Finding, guess: Finding) -> bool:
    """Return whether a term that the fit found explains what was found before the fit."""
    if term.evidence.get("share_pct", 0.0) < MAIN:
        return False
    if guess.code == "unexplained_torque":
        return guess.where.rpartition(": ")[2] == term.where
    return guess.code in _OF_MASSES and term.code in _OF_POSITION


def _advice(term: Candidate, setting: str) -> str:
    """Return in words what the user can do about a term that the model lacks."""
    if not setting:
        return term.advice
    table, *lines = setting.split("\n")
    if term.coupled:
        size = "the size of the second from the data sheet"
        return f"Add {table} to the job with {' and '.join(lines)}, {size}"
    added = f"state {lines[0]} in {table} to add it to the model"
    return f"{term.advice}, or {added}" if term.advice else f"{added[0].upper()}{added[1:]}"


def _finding(misfit: Misfit, found: Fit, on_misfit: Sequence[str]) -> Finding:
    term, kept = misfit.term, misfit.confirmed
    wide = [name for name in on_misfit if name.startswith(f"{misfit.joint}.")]
    stands = f"; {listed(wide)} stand on this misfit, and their intervals count it" if wide else ""
    confirmed = "" if kept is None else f" ({100 * max(kept, 0.0):.0f} % on the validation logs)"
    done = _advice(term, setting_of(misfit, found))
    message = (
        f"{misfit.joint}: {term.meaning}: {misfit.size:.3g} +- {misfit.std_error:.2g} "
        f"{misfit.unit}. It would explain {100 * misfit.share:.0f} % of the squared residual"
        f"{confirmed}; the residual is {100 * misfit.error:.1f} % of the torque. "
        f"{done or 'No term of the model is like it'}{stands}"
    )
    evidence = {
        "share_pct": 100 * misfit.share,
        "error_pct": 100 * misfit.error,
        "size": misfit.size,
        "std_error": misfit.std_error,
        "p_value": misfit.p_value,
    }
    if kept is not None:
        evidence["validation_share_pct"] = 100 * kept
    severity = "warning" if misfit.matters else "note"
    return Finding(term.code, severity, misfit.joint, message, evidence)
