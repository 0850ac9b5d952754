"""What the report says of a fit's prior, bounds and mass matrix, and how far the data carry."""

from html import escape

from robotid.identification.pipeline import Identification

__all__ = ["consistency_notes"]

_METRICS = {
    "euclidean": "each parameter over its own spread (euclidean)",
    "riemannian": "the pull-back metric at the URDF's pseudo-inertias (riemannian)",
    "entropic": "the divergence of the pseudo-inertias (entropic)",
}
_CHOSEN = {
    "cv": "chosen by predicting stretches of the fitted logs from the others",
    "evidence": "chosen by the evidence of the fitted logs",
}


def consistency_notes(found: Identification) -> str:
    """Return paragraphs for the section on consistency.

    Args:
        found: The identification.

    Returns:
        HTML.
    """
    said = [_reach(found), _mass_matrix(found)]
    details = found.estimate.details
    if "prior" in details:
        prior = details["prior"]
        chosen = _CHOSEN.get(prior.get("chosen_by", ""), "as set")
        said.append(
            f"The distance from the URDF's values is measured by {_METRICS[prior['metric']]}; its "
            f"weight is {prior['weight']:.3g}, {chosen}."
        )
        active = ", ".join(details["active"])
        said.append(f"Constraints that bind: {active}." if active else "No constraint binds.")
        if details["pinned"]:
            said.append(f"Kept at the URDF's values: {', '.join(details['pinned'])}.")
    if "check" in details:
        check = details["check"]
        difference = check.get("torque_difference")
        said.append(
            f"Second opinion of {check['solver']}: {check['status']}"
            + ("." if difference is None else f"; torques differ by {100 * difference:.2g} %.")
        )
    if "gaps" in details:
        gaps = ", ".join(f"{gap:.1e}" for gap in details["gaps"])
        said.append(f"Gap of log-Cholesky to the cone programme, per start: {gaps}.")
    return "".join(f"<p>{escape(text)}</p>\n" for text in said)


def _reach(found: Identification) -> str:
    counts = {kind: found.sources.count(kind) for kind in ("data", "mixed", "prior")}
    carried = [
        body
        for body in found.model.layout.bodies
        if all(
            source == "prior"
            for name, source in zip(found.model.layout.names, found.sources, strict=True)
            if name.rsplit(".", 1)[0] == body
        )
    ]
    text = (
        f"How far the data carry: of {len(found.sources)} parameters {counts['data']} come from "
        f"the data, {counts['mixed']} from data and URDF together, {counts['prior']} from the URDF."
    )
    return text + (f" Nothing is known of {', '.join(carried)} but the URDF." if carried else "")


def _mass_matrix(found: Identification) -> str:
    check = found.mass_matrix
    where = "at every one" if check.is_positive else f"at {100 * check.positive_share:.3g} %"
    return (
        f"The mass matrix, armatures included, is positive definite {where} of {check.poses} "
        f"random poses (smallest eigenvalue {check.smallest_eigenvalue:.3g})."
    )
