"""What is worth a word about the physical side of a fit: mass matrix, solvers, active bounds."""

from robotid.findings import Finding
from robotid.identification.pipeline import Identification
from robotid.identification.settings import ConsistentSettings

__all__ = ["consistency_findings"]

_SAME_TORQUE = 1e-3  # two solvers that differ by more, relative to the torque, disagree
_SAME_OPTIMUM = 1e-3  # the same of the objectives of log-Cholesky and cone programme
_COSTS = 1.05  # residual over that of WLS from which bounds cost torque
_LIGHT = 0.05  # share of a link's mass below which next to nothing is left of it


def consistency_findings(identification: Identification) -> list[Finding]:
    """Return findings about the consistency of a fit.

    Args:
        identification: What was found.

    Returns:
        The findings, none if all is well.
    """
    findings = []
    check, details = identification.mass_matrix, identification.estimate.details
    if not check.is_positive:
        is_consistent = isinstance(identification.estimator, ConsistentSettings)
        advice = "raise [estimator] margin" if is_consistent else "use the 'consistent' estimator"
        message = (
            f"the mass matrix is not positive definite at {100 * (1 - check.positive_share):.3g} % "
            f"of {check.poses} random poses (smallest eigenvalue {check.smallest_eigenvalue:.3g}): "
            f"a simulation with these parameters is unstable; {advice}"
        )
        findings.append(Finding("mass_matrix", "warning", "standard_parameters", message))
    second = details.get("check")
    if second is not None and "torque_difference" not in second:
        message = (
            f"the second solver, {second['solver']}, did not solve the fit "
            f"(status: {second['status']}); the result is that of {details['solver']} alone"
        )
        findings.append(Finding("second_solver_failed", "warning", "estimator", message))
    elif second is not None and second["torque_difference"] > _SAME_TORQUE:
        message = (
            f"{details['solver']} and {second['solver']} differ by "
            f"{100 * second['torque_difference']:.2g} % of the torque (objective: "
            f"{100 * second['objective_difference']:.2g} %); trust the lower objective"
        )
        findings.append(Finding("solvers_differ", "warning", "estimator", message))
    bounds = [name for name in details.get("active", ()) if name.startswith(_USER_BOUNDS)]
    if bounds:
        against = _speaks_against(identification)
        message = (
            f"the bounds {bounds} bind: {against}; check these bounds, the torque scale (gains) "
            "and the payload"
            if against
            else f"the bounds {bounds} bind: the URDF's values lie beyond them, and the torque is "
            "explained as well as without"
        )
        is_stated = bool(_stated(identification).intersection(bounds))
        severity = "warning" if against and is_stated else "note"
        findings.append(Finding("bound_binds", severity, ", ".join(bounds), message))
    gap = min(details.get("gaps", [0.0]))
    if gap > _SAME_OPTIMUM:
        message = (
            f"log-Cholesky ended {100 * gap:.2g} % above the optimum of the cone programme; use "
            "the 'consistent' estimator, or more starts"
        )
        findings.append(Finding("optimum_gap", "warning", "estimator", message))
    return findings


_USER_BOUNDS = ("mass ", "total_mass ", "centre_of_mass ")


def _speaks_against(identification: Identification) -> str:
    """Return what data or masses say against bounds that bind, in words; empty if nothing."""
    ours, wls = identification.metrics().per_joint, identification.metrics("wls").per_joint
    costs = [joint for joint in ours if ours[joint].rmse > _COSTS * wls[joint].rmse]
    if costs:
        return f"the data push against them at {costs}"
    layout = identification.model.layout
    masses = identification.standard[: layout.n_inertial : 10]
    urdf = identification.model.standard_parameters()[: layout.n_inertial : 10]
    light = [
        f"{mass:.2g} of its {before:.3g} kg to {link}"
        for link, mass, before in zip(layout.bodies, masses, urdf, strict=True)
        if mass < _LIGHT * before
    ]
    return f"they leave {', '.join(light)}" if light else ""


def _stated(identification: Identification) -> set[str]:
    """Return the bounds that the user states; those of the links' geometry may well bind."""
    stated = identification.estimator.bounds
    return {
        "total_mass all",
        *(f"mass {link}" for link in stated.mass),
        *(f"centre_of_mass {link}" for link in stated.com),
    }
