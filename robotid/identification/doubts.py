"""Which findings make a result doubtful, however well it predicts the torque."""

from collections.abc import Iterator, Sequence

from robotid.findings import Finding
from robotid.identification.verdict import Doubt

__all__ = ["DOUBTFUL", "doubts_of", "is_outvoted"]

_WRONG = 2.0  # a fit that misses this many times what WLS misses ...
_HARMLESS = 1.0  # [%] ... is doubtful, but not below this share of the torque
#: Warnings that make a result doubtful, in words that a verdict can hold. A word in braces is a
#: figure of the evidence.
_WORDS = {
    "bound_binds": "the data, or the masses that it leaves, speak against a stated bound",
    "clipped": "the torque is clipped at a limit",
    "constant_torque": "the torque never changes: the channel is dead",
    "constraint_costs": "{error_pct:.1f} % of the torque is missed where it was fitted, "
    "{wls_error_pct:.1f} % without constraints: physics and data disagree",
    "current_for_torque": "the torque fits the URDF in another scale only: if it is a current or "
    "in another unit, masses and inertias are wrong in the same proportion",
    "gravity": "the direction of gravity may be stated wrongly",
    "joint_axis": "the joint's axis may be reversed",
    "joint_order": "the columns may be those of another joint",
    "mass_matrix": "the mass matrix is not positive definite everywhere",
    "position_offset": "the zero of the position may be off",
    "position_order": "the position may be that of another joint",
    "position_sign": "the position may have the opposite sign",
    "solvers_differ": "two solvers found different parameters",
    "torque_delay": "the torque is late against the position by {delay:.3f} s",
    "torque_order": "the torque may be that of another joint",
    "torque_sign": "the torque may have the opposite sign",
    "unexplained_torque": "much of the torque fits neither gravity, inertia nor friction",
    "urdf_mismatch": "the torques do not fit the URDF's masses: it may be of another robot, or "
    "lack a load",
}
#: Codes of the warnings that make a result doubtful.
DOUBTFUL = (*_WORDS, "repeated_motion")
_REPEATED = "the motion kept apart is in a fitted log, too, so no prediction was tested"


def doubts_of(
    findings: Sequence[Finding],
    joints: Sequence[str],
    kept: Sequence[str] = (),
    *,
    is_robust: bool = False,
) -> tuple[Doubt, ...]:
    """Return the doubts that findings raise, each once.

    Args:
        findings: What the doctor and the fit found; notes and errors raise no doubt.
        joints: The model's joints. A finding whose place names some is about these only.
        kept: Names of the recordings kept apart, one each.
        is_robust: Whether a robust loss was set.
    """
    outvoted = {_place(f) for f in findings if is_robust and is_outvoted(f)}
    found = []
    for finding in findings:
        if finding.severity != "warning" or finding.code not in _WORDS or _is_harmless(finding):
            continue
        # spikes that a robust fit leaves out are what physics could not explain
        if finding.code == "unexplained_torque" and finding.where in outvoted:
            continue
        found += list(_doubts(finding, joints))
    repeated = {f.where for f in findings if f.code == "repeated_motion"}
    if kept and repeated.issuperset(kept):
        found.append(Doubt("repeated_motion", "", _REPEATED))
    return tuple(dict.fromkeys(found))


def is_outvoted(finding: Finding) -> bool:
    """Return whether a robust loss makes a finding harmless: jumps of the torque.

    Args:
        finding: The finding.

    Returns:
        Whether it is about rows of the torque only; a position that jumps spoils the regressor.
    """
    return finding.code == "spikes" and finding.where.rsplit(": ", 1)[-1].startswith("tau_")


def _doubts(finding: Finding, joints: Sequence[str]) -> Iterator[Doubt]:
    message = _WORDS[finding.code].format(**finding.evidence)
    log, _, last = finding.where.rpartition(": ")
    named = [joint for joint in last.split(", ") if joint in joints]
    for joint in named:
        yield Doubt(finding.code, joint, message)
    if not named:
        where = "" if finding.where in _OF_THE_FIT else f"{log or last}: "
        yield Doubt(finding.code, "", f"{where}{message}")


def _is_harmless(finding: Finding) -> bool:
    """Return whether constraints cost so little that the torque is predicted well all the same."""
    if finding.code != "constraint_costs":
        return False
    error, wls = finding.evidence["error_pct"], finding.evidence["wls_error_pct"]
    return error < max(_WRONG * wls, _HARMLESS)


def _place(finding: Finding) -> str:
    """Return the place of jumps of a torque as other findings call it: log and joint."""
    return finding.where.replace(": tau_", ": ")


_OF_THE_FIT = ("estimator", "standard_parameters")
