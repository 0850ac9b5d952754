"""Findings about a fit: undetermined parameters, outliers, mass matrix, optimum, bounds."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.diagnosis.residual.decisions import TENFOLD
from robotid.diagnosis.residual.misfit import Misfit
from robotid.diagnosis.residual.misfit_findings import misfit_findings
from robotid.diagnosis.urdf.mesh_check import audit_bodies
from robotid.diagnosis.verdict.correlation import correlated_parameters
from robotid.diagnosis.verdict.evidence import is_harmless_cost
from robotid.estimation.estimators.consistent.body_constraints import slabs
from robotid.estimation.fitting.estimator_settings import BoundedSettings, ConsistentSettings
from robotid.estimation.fitting.fitted import Fit
from robotid.estimation.fitting.regressor_noise import encoder_findings
from robotid.robot.bodies import density_share, held_parameters, least_density, negligible_bodies
from robotid.robot.geometry import body_boxes, body_points
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_COSTS = 1.05  # residual over that of WLS above which bounds increase the torque error
_FAR = 3.0  # a total mass differs from the URDF's at most by this factor
_ROUNDING = 1e-6  # [m^2] tolerance of a body that touches its box
_NAMED = 5  # outliers that a finding names
_DIFFERS = 1.2  # residual of a consistent fit over that of WLS above which it is reported
_LITTLE = 5.0  # [%] ... as a note if the constraints add less to the torque error
_SHRUNK = 0.1  # of the URDF's smallest eigenvalue: below, a body is barely possible
_MUCH = 0.2  # ... if links on locked joints have more than this share of its mass
_USER_BOUNDS = ("mass ", "total_mass ", "centre_of_mass ")
_BEYOND = 0.02  # share of samples outside the fitted range of friction that is reported
_DENSEST = 12_000.0  # [kg/m^3] of a link: lead has 11,340
_UNLIKELY = 0.05  # share of the bodies that the errors allow below which one is not possible
_AT_BOUND = 1e-3  # relative difference of a mass from a stated bound that determines it
_VANISHED = 0.05  # share of a link's URDF mass below which the link has practically vanished


def fit_findings(
    fit: Fit,
    misfits: Sequence[Misfit] = (),
    on_misfit: Sequence[str] = (),
    discrepancies: Sequence[Finding] = (),
) -> list[Finding]:
    """Return the findings about a fit: undetermined parameters, outliers, costs of constraints."""
    findings = _static_findings(fit)
    determined = fit.determination
    if determined.groups:
        message = (
            f"the data determine {determined.rank} of {len(determined.names)} base parameters: "
            f"{determined.described()}. What is not determined keeps the URDF's values, because "
            "the data reduce its prior uncertainty by less than 10 %; record a richer motion"
        )
        severity = "warning" if fit.is_poorly_excited else "note"
        findings.append(Finding("undetermined", severity, "base_parameters", message))
    findings += consistency_findings(fit)
    findings += _bound_findings(fit)
    findings += _total_mass(fit)
    findings += _impossible_shapes(fit)
    findings += _dense_bodies(fit)
    findings += _outlier_findings(fit)
    findings += misfit_findings(fit, misfits, on_misfit)
    findings += [*_drive_findings(fit), *_correlated(fit)]
    findings += discrepancies
    findings += encoder_findings(fit.regressor_noise, fit.model, fit.mapping)
    for evaluation in fit.refitted:
        message = (
            f"the validation log {evaluation.recording.name} contains fitted samples: its "
            "error is that of the fit, not of a prediction; validate on another recording"
        )
        where = evaluation.recording.log.path
        findings.append(Finding("validation_was_fitted", "warning", where, message))
    return findings + _costs(fit)


def _costs(fit: Fit) -> list[Finding]:
    """Return the joints whose torque error the constraints increase.

    It is a note if they add little, sqrt(error^2 - wls^2) of the torque, the verdict does not count
    it, and the user states no constraint; and if WLS predicts unseen recordings worse.
    """
    findings, wls, asked = [], fit.metrics("wls").per_joint, _asked(fit)
    locked = _locked_links(fit)
    for joint, measured in fit.metrics().per_joint.items():
        free = wls[joint]
        if measured.rmse <= _DIFFERS * free.rmse:
            continue
        error, least = measured.relative_error_pct, free.relative_error_pct or 0.0
        own = f"{measured.rmse:.3g} {measured.unit}"
        message = f"{joint}: the residual is {own}, that of unconstrained WLS {free.rmse:.3g}"
        is_little = error is not None and error**2 - least**2 < _LITTLE**2
        is_little = is_little and is_harmless_cost(error or 0.0, least) and not (asked or locked)
        if is_little or joint in fit.overfitted:
            severity, more = "note", "" if is_little else ", which predicts unseen logs worse"
            message += f": {error or 0.0:.2g} % instead of {least:.2g} % of the torque{more}; "
            message += "no action needed"
        else:
            severity = "warning"
            message += (
                f": physics and data disagree; check {asked}{locked}the torque scale (gains), the "
                "drive model and the payload"
            )
        evidence = {"error_pct": error or 0.0, "wls_error_pct": least}
        findings.append(Finding("constraint_costs", severity, joint, message, evidence))
    return findings


def _static_findings(fit: Fit) -> list[Finding]:
    """Return a note on the samples of a static model, and on joints without Coulomb friction."""
    if not fit.model.is_static:
        return []
    recordings = [e.recording for e in fit.fitted]
    rows, samples = (
        sum(getattr(r.extent, key) for r in recordings) for key in ("samples", "smooth")
    )
    message = (
        f"the {rows} rows count as {samples} independent samples: poses at rest and slow segments "
        "of 0.25 s; inertias about the centres of mass keep the URDF's values"
    )
    if still := _drives_at_rest(fit):
        message += (
            f". Poses at rest do not determine the Coulomb friction of {listed(still)}: at rest it "
            "has any value between its bounds, and the intervals include it. Add slow motion of "
            "these joints, or set friction = 'none' in [model]; to halve its effect, approach each "
            "pose from both sides"
        )
    evidence = {"rows": float(rows), "samples": float(samples)}
    return [Finding("static", "note", "standard_parameters", message, evidence)]


def _drives_at_rest(fit: Fit) -> list[str]:
    """Return the names of drives whose friction has no direction in any used sample."""
    layout, still = fit.model.layout, []
    for d, (drive, ratios) in enumerate(zip(layout.drives, layout.drive_ratios, strict=True)):
        motions = [(e.recording.trajectory, e.recording.mask) for e in fit.fitted]
        shown = [
            motion.direction is None or motion.direction[mask[:, ratios != 0].all(axis=1), d].any()
            for motion, mask in motions
        ]
        still += [] if any(shown) else [drive.name]
    return still


def _drive_findings(fit: Fit) -> list[Finding]:
    """Return notes on friction shapes at their bounds, and on motion outside the fitted range."""
    findings, model = [], fit.model
    for choice in fit.drives:
        for shape in choice.shapes:
            if shape.is_at_bound:
                message = (
                    f"{choice.joint}: {shape.name} is {shape.value:.3g} {shape.unit}, the "
                    "bound of its search range: the motion does not determine where the curve "
                    "bends; record slower and faster motion of this joint"
                )
                findings.append(Finding("shape_at_bound", "note", choice.joint, message))
        guards = {term.guards for term in choice.terms if np.isfinite(term.data_range).all()} - {""}
        j = model.joints.index(choice.joint)
        for evaluation in fit.validation:
            motion, mask = evaluation.recording.trajectory, evaluation.recording.mask
            for key in sorted(guards):
                x, (low, high) = getattr(motion, key)[mask[:, j], j], choice.data_range[key]
                x, low = (np.abs(x), 0.0) if key == "v" else (x, low)
                share = float(np.mean((x < low) | (x > high))) if len(x) else 0.0
                if share > _BEYOND:
                    what = {"q": "positions", "v": "speeds"}[key]
                    message = (
                        f"{choice.joint}: {100 * share:.0f} % of the samples of "
                        f"{evaluation.recording.name} have {what} outside the fitted range of "
                        f"{low:.3g} to {high:.3g}; {listed(choice.families)} is constant there"
                    )
                    evidence = {"share_pct": 100 * share}
                    findings.append(
                        Finding("beyond_range", "note", choice.joint, message, evidence)
                    )
    return findings


def _correlated(found: Fit) -> list[Finding]:
    """Return a note on each drive with a pair of parameters of which only the sum is determined."""
    names, pairs, findings = found.model.layout.names, correlated_parameters(found), []
    for joint in dict.fromkeys(names[i].rpartition(".")[0] for i in pairs):
        own = [(i, *pair) for i, pair in pairs.items() if names[i].rpartition(".")[0] == joint]
        i, k, r = max(own, key=lambda pair: abs(pair[2]))
        single = [
            f"{names[m].rpartition('.')[2]} {found.standard[m]:.3g} +- "
            f"{found.standard_error[m]:.2g}"
            for m in sorted((i, k))
        ]
        curve = found.friction(joint)
        slowest = len(curve.v) // 2
        sums = [
            f"{curve.torque[m]:.3g} +- {curve.std[m]:.2g} at {curve.v[m]:.3g}"
            for m in (slowest, -1)
        ]
        speed = "m/s" if joint in found.model.layout.prismatic else "rad/s"
        message = (
            f"{joint}: {listed(single)} are strongly correlated (r = {r:.3f}): use their sum; "
            f"friction and offset are {' and '.join(sums)} {speed}"
        )
        findings.append(Finding("correlated_terms", "note", joint, message, {"r": r}))
    return [*findings, *_grown(found, {finding.where for finding in findings})]


def _grown(found: Fit, reported: Collection[str]) -> list[Finding]:
    """Return notes on terms that increase the standard error of another parameter tenfold."""
    findings = []
    for choice in found.drives:
        name = max(choice.grown, key=lambda name: choice.grown[name], default="")
        if choice.joint not in reported and choice.grown.get(name, 1.0) > TENFOLD:
            grown = choice.grown[name]
            message = (
                f"{choice.joint}: {listed(choice.families)} multiplies the standard error of "
                f"{name} by {grown:.0f}; the friction curve is more accurate than its terms"
            )
            evidence = {"grown": grown}
            findings.append(Finding("correlated_terms", "note", choice.joint, message, evidence))
    return findings


def not_written(log_errors: Sequence[Finding], inconsistent: str = "") -> list[Finding]:
    """Return a warning that the URDF is not written, with the reason; nothing if it is written."""
    if log_errors:
        codes = listed(dict.fromkeys(finding.code for finding in log_errors))
        message = (
            f"URDF not written: {codes} failed. Correct the cause; if a finding is wrong, add "
            "its code to ignore in [doctor]"
        )
    elif inconsistent:
        message = (
            f"URDF not written: the {inconsistent} estimate is not physically consistent; "
            "use the 'consistent' estimator"
        )
    else:
        return []
    return [Finding("urdf_not_written", "warning", "urdf", message)]


def locked_findings(model: RobotModel, stated: Collection[str]) -> list[Finding]:
    """Return a warning about locked joints whose positions matter but were not stated.

    A position matters if the locked joint is on a chain with an identified joint: the pose of the
    legs does not change the torques of an arm. On a floating base all positions matter.
    """
    relevant = set(model.locked) if model.free_flyer else _in_line(model)
    assumed = [name for name in model.locked if name not in stated and name in relevant]
    if not assumed:
        return []
    message = (
        f"the job neither identifies nor locks {listed(assumed)}. Their positions are assumed "
        "to be 0; state them with locked = { joint = position }, or confirm 0 for all "
        'others with locked = { "*" = 0.0 }'
    )
    return [Finding("locked_at_zero", "warning", ", ".join(assumed), message)]


def _in_line(model: RobotModel) -> set[str]:
    """Return the joints that carry an identified joint, or are carried by one."""
    above = {joint.child: joint for joint in model.tree.joints}
    carriers: dict[str, set[str]] = {}
    for joint in model.tree.joints:
        own, link = carriers.setdefault(joint.name, set()), joint.parent
        while link in above:
            own.add(above[link].name)
            link = above[link].parent
    identified = set(model.joints)
    carrying = set[str]().union(*(carriers[name] for name in identified))
    # the position of a base changes no torque, only its orientation
    rotating = {joint.name for joint in model.tree.joints if joint.type != "prismatic"}
    return carrying & rotating | {name for name, own in carriers.items() if own & identified}


def log_findings(logs: Sequence[Log]) -> list[Finding]:
    """Return what was noted and assumed of logs, each once, with the names of its logs."""
    logs_of: dict[tuple[str, str, str], list[str]] = {}
    for log in logs:
        for note in log.notes:
            logs_of.setdefault(("log_note", "note", note), []).append(Path(log.path).name)
        for text in log.assumed:
            logs_of.setdefault(("log_assumption", "warning", text), []).append(Path(log.path).name)
    return [
        Finding(code, severity, ", ".join(names), f"{', '.join(names)}: {text}")
        for (code, severity, text), names in logs_of.items()
    ]


def consistency_findings(fit: Fit) -> list[Finding]:
    """Return findings about the consistency of a fit."""
    findings = []
    check, details = fit.mass_matrix, fit.estimate.details
    if not check.is_positive:
        is_consistent = isinstance(fit.estimator, ConsistentSettings)
        advice = (
            "raise [estimator] prior_weight" if is_consistent else "use the 'consistent' estimator"
        )
        message = (
            f"the mass matrix is not positive definite at {100 * (1 - check.positive_share):.3g} % "
            f"of {check.poses} random poses (smallest eigenvalue {check.smallest_eigenvalue:.3g}): "
            f"a simulation with these parameters diverges; {advice}"
        )
        findings.append(Finding("mass_matrix", "warning", "standard_parameters", message))
    bounds = [name for name in details.get("active", ()) if name.startswith(_USER_BOUNDS)]
    if bounds:
        against = _contradiction(fit)
        why = (
            f"{against}; check these bounds, the torque scale (gains) and the payload"
            if against
            else "the URDF's values are outside them; the bounds do not increase the torque error"
        )
        is_stated = bool(_stated(fit).intersection(bounds))
        severity = "warning" if against and is_stated else "note"
        message = f"the bounds {listed(bounds)} are active: {why}"
        findings.append(Finding("active_bound", severity, ", ".join(bounds), message))
    return findings


def _total_mass(fit: Fit) -> list[Finding]:
    """Return an error if the total mass differs from the URDF's by more than a factor of 3."""
    size = fit.model.layout.n_inertial
    pi = np.array([fit.prior, fit.standard])
    before, after = pi[:, :size:10].sum(axis=1).tolist()
    if fit.estimator.bounds.total is not None:  # the user states it
        return []
    if not before > 0 or before / _FAR <= after <= _FAR * before:
        return []
    message = (
        f"the identified total mass is {after:.4g} kg, the URDF's is {before:.4g} kg; wanted: "
        f"within a factor of {_FAR:g}. Check the sign, the order and the unit of the torques, and "
        "the masses of the URDF; if the URDF's masses are wrong, ignore total_mass"
    )
    evidence = {"urdf": before, "identified": after}
    return [Finding("total_mass", "error", "standard_parameters", message, evidence)]


def _is_within_box(fit: Fit, body: str, box: Array) -> bool:
    """Return whether a body's mass is in the box of the fit, wider than that of the geometry."""
    i = fit.model.layout.bodies.index(body)
    (J,) = pseudo_inertia(fit.standard[10 * i : 10 * i + 10])
    slack = np.einsum("ij,kji->k", J, slabs(box)) / J[3, 3]  # tr(J Q_k) / m
    centre = J[:3, 3] / J[3, 3]
    is_inside = (box[0] <= centre) & (centre <= box[1]) & (slack >= -_ROUNDING)
    return bool(is_inside.all())


def _impossible_shapes(fit: Fit) -> list[Finding]:
    """Return the identified bodies that are not possible in their geometry.

    As notes if the URDF's body is not possible either, or if the body is in the box of a fit with
    extents. Bodies of negligible mass are left out.
    """
    model, points = fit.model, body_points(fit.model)
    boxes, negligible = body_boxes(model), negligible_bodies(model)
    before = {(finding.code, finding.where) for finding in audit_bodies(model, fit.prior, points)}
    findings = []
    for finding in audit_bodies(model, fit.standard, points):
        body = finding.where.removeprefix("link ")
        if body in negligible:  # it keeps the URDF's values, and has no effect
            continue
        if (finding.code, finding.where) in before:
            message = f"{finding.message.partition(';')[0]}; the URDF has the same fault"
            finding = replace(finding, severity="note", message=message)
        elif _is_within_box(fit, body, boxes[body]):
            fault = finding.message.partition(";")[0]
            message = f"as identified, {fault}; it is within the margin of the fit"
            finding = replace(finding, severity="note", message=message)
        else:
            fault = finding.message.partition(";")[0]
            message = f"as identified, {fault}. {_remedy(fit, body)}"
            finding = replace(finding, message=message)
        findings.append(finding)
    return findings


def _dense_bodies(fit: Fit) -> list[Finding]:
    """Return the identified bodies whose inertia needs a density above that of any material.

    As notes if the errors of mass and inertia allow a body of a material and no stated mass
    determines it. Bodies that have this
    density in the URDF are left out, and all of a result that is not physically consistent, which
    is a reason of its own.
    """
    if not fit.is_consistent:
        return []
    findings, size = [], fit.model.layout.n_inertial
    before, after = (pi[:size].reshape(-1, 10) for pi in (fit.prior, fit.standard))
    for k, (body, was, now) in enumerate(zip(fit.model.layout.bodies, before, after, strict=True)):
        density = least_density(now)
        if density <= max(_DENSEST, least_density(was)):
            continue
        # at equal inertia the density is proportional to the mass to the power of 2.5
        excess = float(now[0]) * (1.0 - (_DENSEST / density) ** 0.4)
        needs = (
            f"needs a density of at least {float(f'{density:.2g}'):.0f} kg/m^3 (wanted: at most "
            f"{_DENSEST:g}, steel has 7900)"
            if np.isfinite(density)
            else "is that of a body without volume"
        )
        own = slice(10 * k, 10 * k + 10)
        covariance = fit.standard_covariance[own, own]
        share = density_share(now, covariance, _DENSEST, np.random.default_rng(0))
        severity, error = "warning", ""
        conclusion = "such a body is not possible"
        if share > _UNLIKELY and not _stated_of(fit, body):
            severity, error = "note", f" +- {1.96 * np.sqrt(covariance[0, 0]):.2g}"
            conclusion = (
                f"{100 * share:.0f} % of the bodies that these errors allow need less, so the data "
                "do not determine this link"
            )
        message = (
            f"as identified, the mass of {body} is {now[0]:.3g}{error} kg and its inertia {needs}: "
            f"{conclusion}. {_remedy(fit, body, excess)}"
        )
        evidence = {"mass": float(now[0]), "density": density}
        findings.append(Finding("dense_body", severity, f"link {body}", message, evidence))
    return findings


def _remedy(fit: Fit, body: str, excess: float = 0.0) -> str:
    """Return what to correct for an impossible body, and what remains valid."""
    cure = "Record motion about more axes, or pin it to the URDF"
    for stated, mass in _stated_of(fit, body).items():
        limit = f" (possible: up to about {mass - excess:.3g} kg)" if excess > 0 else ""
        cure = f"Check the stated {stated} of {mass:.4g} kg{limit}: weigh it, or remove it"
    use = "do not use mass, centre of mass and inertia of this link"
    return f"{cure}. The predicted torque may still be right; {use}"


def _stated_of(fit: Fit, body: str) -> dict[str, float]:
    """Return the mass that the user states and that determines a body's, by its name [kg]."""
    bounds, layout = fit.estimator.bounds, fit.model.layout
    masses = fit.standard[: layout.n_inertial : 10]
    stated, pair, mass = "total_mass", bounds.total, float(masses.sum())
    if body in bounds.masses:
        stated, pair = f"mass of {body}", bounds.masses[body]
        mass = float(masses[layout.bodies.index(body)])
    is_at = pair is not None and np.isclose(mass, pair, rtol=_AT_BOUND).any()
    return {stated: mass} if is_at else {}


def _bound_findings(fit: Fit) -> list[Finding]:
    """Return notes on drive terms at 0, and warnings about bodies outside their geometry."""
    findings, names = [], fit.model.layout.names
    at_bound = [name for name, is_at in zip(names, fit.at_bound, strict=True) if is_at]
    if at_bound:
        message = (
            f"{listed(at_bound, _NAMED)}: 0, at the bound, without a standard error. Without "
            "this bound the value is negative, which no drive has: the friction model lacks a "
            "term, or the motion does not distinguish these terms from others"
        )
        findings.append(Finding("at_bound", "note", ", ".join(at_bound), message))
    for body in fit.estimate.details.get("relaxed", ()):
        message = (
            f"{body}: the data contradict the box of its geometry: mass is outside. The fit "
            "ignored the box of this link. If a part is mounted there, add it to the URDF; "
            "otherwise check the URDF's geometry and the torque scale"
        )
        findings.append(Finding("extent_contradicted", "warning", f"link {body}", message))
    return findings


def _outlier_findings(fit: Fit) -> list[Finding]:
    outliers = fit.outliers
    if not outliers:
        return []
    places = [
        f"{o.joint} at {o.t:.3f} s of {o.log}: measured {o.torque:.4g}, predicted "
        f"{o.predicted:.4g}, residual {o.size:.0f} times the typical one"
        for o in outliers[:_NAMED]
    ]
    more = f"; and {len(outliers) - _NAMED} more" if len(outliers) > _NAMED else ""
    advice = "check the recording there, cut it out, or set robust = 'tukey' in [estimator]"
    if fit.estimator.is_robust:
        advice = "the robust loss downweighted them"
    count = f"{len(outliers)} outlier{'s' if len(outliers) > 1 else ''}"
    found = f"{count} in the fitted logs: {'; '.join(places)}"
    evidence = {"places": float(len(outliers)), "largest": outliers[0].size}
    where, message = outliers[0].joint, f"{found}{more}; {advice}"
    return [Finding("outliers", "warning", where, message, evidence)]


def _asked(fit: Fit) -> str:
    """Return the constraints that the user states, as text; empty if none."""
    settings = fit.estimator
    if not isinstance(settings, BoundedSettings):
        return ""
    asked = [key for key, value in settings.constraints.items() if value]
    return f"the constraints in [estimator] ({listed(asked)}), " if asked else ""


def _locked_links(fit: Fit) -> str:
    """Return the bodies that links on locked joints make barely possible, as text; empty if none.

    Such links keep the URDF's inertials: the moved link takes all their errors.
    """
    model, size = fit.model, fit.model.layout.n_inertial
    held, found = held_parameters(model), fit.standard[:size]
    own, before = (
        np.linalg.eigvalsh(pseudo_inertia(pi[:size] - held))[:, 0]
        for pi in (found, model.standard_parameters())
    )
    links = [
        f"the URDF's inertials of the links on locked joints, {held[10 * k]:.3g} kg of the "
        f"{found[10 * k]:.3g} kg of {model.layout.bodies[k]} (identify their joints, too, if they "
        "are wrong), "
        for k in np.flatnonzero((own < _SHRUNK * before) & (held[::10] > _MUCH * found[::10]))
    ]
    return "".join(links)


def _contradiction(fit: Fit) -> str:
    """Return how data or masses contradict active bounds, as text; empty if they do not."""
    ours, wls = (fit.metrics(name).per_joint for name in ("estimate", "wls"))
    costs = [joint for joint in ours if ours[joint].rmse > _COSTS * wls[joint].rmse]
    if costs:
        return f"they increase the torque error of {listed(costs)}"
    layout = fit.model.layout
    masses = fit.standard[: layout.n_inertial : 10]
    urdf = fit.model.standard_parameters()[: layout.n_inertial : 10]
    vanished = [
        f"{link} has {mass:.2g} of its {before:.3g} kg"
        for link, mass, before in zip(layout.bodies, masses, urdf, strict=True)
        if mass < _VANISHED * before
    ]
    return f"with them {', '.join(vanished)}" if vanished else ""


def _stated(fit: Fit) -> set[str]:
    """Return the bounds that the user states; those of the links' geometry are often active."""
    stated = fit.estimator.bounds
    return {
        "total_mass all",
        *(f"mass {link}" for link in stated.mass),
        *(f"centre_of_mass {link}" for link in stated.com),
    }
