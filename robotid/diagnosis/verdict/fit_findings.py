"""Findings about a fit: determination, outliers, optimum, bounds, logs and units that differ."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.tolerances import CONVERGED, TINY
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.residual.misfit import Misfit, misfit_finding
from robotid.diagnosis.urdf.inertials import DENSEST, audit_bodies
from robotid.diagnosis.verdict.verdict import BEATEN, NAMED, SMALL, is_harmless_cost
from robotid.estimation.estimators.consistent_fit import slabs
from robotid.estimation.fitting.estimator_settings import BoundedSettings, ConsistentSettings
from robotid.estimation.fitting.fitted import CLEARLY, Fit, Identified
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.estimation.variation.variation import UnlikeRun, Variation
from robotid.robot.bodies import (
    body_boxes,
    body_points,
    density_share,
    least_density,
    negligible_bodies,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_BIASED = 0.5  # shift of a parameter by encoder noise, in standard errors, that is reported
_USER_BOUNDS = ("mass ", "total_mass ", "centre_of_mass ")
_UNLIKELY = 0.05  # share of the bodies that the errors allow below which one is not possible


def fit_findings(
    fit: Fit, misfits: Sequence[Misfit] = (), on_misfit: Sequence[str] = (),
    discrepancies: Sequence[Finding] = (),
) -> Iterator[Finding]:  # fmt: skip
    """Yield the findings about a fit: undetermined parameters, outliers, costs of constraints."""
    if fit.model.is_static:
        yield _of_static(fit)
    determined = fit.determination
    if determined.groups:
        yield finding(
            "undetermined", subject="base_parameters", described=determined.described(),
            severity="warning" if fit.is_poorly_excited else "note", rank=determined.rank,
            base=len(determined.names),
        )  # fmt: skip
    yield from consistency_findings(fit)
    at_bound = np.array(fit.model.layout.names)[fit.at_bound].tolist()
    if at_bound:
        joints = list(dict.fromkeys(name.rpartition(".")[0] for name in at_bound))
        names = listed(at_bound, NAMED)
        yield finding("at_bound", "", joints, subject=", ".join(at_bound), names=names)
    for body in fit.estimate.details.get("relaxed", ()):
        yield finding("extent_contradicted", subject=f"link {body}", link=body)
    yield from (*_total_mass(fit), *_impossible_shapes(fit), *_dense_bodies(fit))
    if fit.outliers:
        yield _of_outliers(fit)
    yield from (misfit_finding(misfit, fit, on_misfit) for misfit in misfits)
    yield from (*_drive_findings(fit), *correlated_findings(fit))
    yield from (*discrepancies, *encoder_noise(fit))
    for e in fit.refitted:
        yield finding("validation_was_fitted", subject=e.recording.log.path, name=e.recording.name)
    yield from _costs(fit)


def _costs(fit: Fit) -> Iterator[Finding]:
    """Yield the joints whose torque error the constraints increase."""
    # A note if they add little, sqrt(error^2 - wls^2), unless stated; or if WLS predicts worse.
    wls, settings = fit.metrics("wls").per_joint, fit.estimator
    asked = ""  # the constraints that the user states
    if isinstance(settings, BoundedSettings) and any(settings.constraints.values()):
        keys = listed(key for key, value in settings.constraints.items() if value)
        asked = f"the constraints in [estimator] ({keys}), "
    for joint, measured in fit.metrics().per_joint.items():
        free = wls[joint]
        if measured.rmse <= CLEARLY * free.rmse:
            continue
        error, least = measured.relative_error_pct, free.relative_error_pct or 0.0
        is_little = error is not None and error**2 - least**2 < SMALL**2
        is_little = is_little and is_harmless_cost(error or 0.0, least) and not asked
        what = "overfitted" if joint in fit.overfitted else "costly"
        what = "little" if is_little else what
        yield finding(
            "constraint_costs", "", joint, severity="warning" if what == "costly" else "note",
            what=what, cure=what, asked=asked, unit=measured.unit,
            error_pct=error or 0.0, wls_error_pct=least, rmse=measured.rmse, wls_rmse=free.rmse,
        )  # fmt: skip


def _of_static(fit: Fit) -> Finding:
    """Return a note on the samples of a static model, and on joints without Coulomb friction."""
    layout, extents = fit.model.layout, [e.recording.extent for e in fit.fitted]
    motions = [(e.recording.trajectory, e.recording.mask) for e in fit.fitted]
    still = [
        drive.name
        for d, (drive, ratios) in enumerate(zip(layout.drives, layout.drive_ratios, strict=True))
        if not any(
            motion.direction is None or motion.direction[mask[:, ratios != 0].all(axis=1), d].any()
            for motion, mask in motions
        )
    ]
    return finding(
        "static", subject="standard_parameters", cure=bool(still), still=listed(still),
        rows=sum(x.samples for x in extents), samples=sum(x.smooth for x in extents),
    )  # fmt: skip


def _drive_findings(fit: Fit) -> Iterator[Finding]:
    """Yield delays that were selected as terms, and notes on motion outside the fitted range."""
    for choice in fit.drives:
        selected = [one for one in choice.tried if one.is_selected]
        for before, after in pairwise(selected):  # a late torque has the term -T d(tau)/dt
            explained = before.held_out_error_pct**2 - after.held_out_error_pct**2
            if after.families[-1] == "lag" and explained > (100 * decisions.AGREES) ** 2:
                k = fit.model.layout.names.index(f"{choice.joint}.lag")
                sizes = {"size": fit.standard[k], "std_error": fit.standard_error[k]}
                yield finding("joint_delay", "", choice.joint, explained=False, **sizes)
        guards = {term.guards for term in choice.terms if np.isfinite(term.data_range).all()} - {""}
        j = fit.model.joints.index(choice.joint)
        for evaluation in fit.validation:
            motion, mask = evaluation.recording.trajectory, evaluation.recording.mask
            for key in sorted(guards):
                x, (low, high) = getattr(motion, key)[mask[:, j], j], choice.data_range[key]
                x, low = (np.abs(x), 0.0) if key == "v" else (x, low)
                share = float(np.mean((x < low) | (x > high))) if len(x) else 0.0
                if share > decisions.SHARE_OF_ROWS:
                    yield finding(
                        "beyond_range", "", choice.joint, share_pct=100 * share, low=low, high=high,
                        what=key, name=evaluation.recording.name, families=listed(choice.families),
                    )  # fmt: skip


def correlated_findings(fit: Fit) -> Iterator[Finding]:
    """Yield notes on drives with parameters of which only the sum is determined."""
    names, pairs = fit.model.layout.names, correlated_parameters(fit)
    joints = list(dict.fromkeys(names[i].rpartition(".")[0] for i in pairs))
    for joint in joints:
        of_joint = [(i, *x) for i, x in pairs.items() if names[i].rpartition(".")[0] == joint]
        i, k, r = max(of_joint, key=lambda pair: abs(pair[2]))
        single = [
            f"{names[m].rpartition('.')[2]} {fit.standard[m]:.3g} +- {fit.standard_error[m]:.2g}"
            for m in sorted((i, k))
        ]
        curve, is_prismatic = fit.friction(joint), joint in fit.model.layout.prismatic
        force, speed = ("N", "m/s") if is_prismatic else ("N m", "rad/s")
        sums = " and ".join(
            f"{curve.torque[m]:.3g} +- {curve.std[m]:.2g} {force} at {curve.v[m]:.3g} {speed}"
            for m in (len(curve.v) // 2, -1)  # the slowest and the fastest
        )
        pair = " and ".join(single)
        yield finding("correlated_terms", "", joint, pair=pair, sums=sums, r=r)


def _correlations(C: Array, own: Sequence[int]) -> Array:
    """Return the correlations of parameters with each other, 0 of each with itself."""
    error = np.sqrt(np.diag(C)[own])
    return np.asarray(C[np.ix_(own, own)] / np.outer(error, error) - np.eye(len(own)))


def correlated_sets(C: Array, own: Sequence[int]) -> list[list[int]]:
    """Return the sets of parameters that strong correlations connect: C (p, p)."""
    groups = decisions.connected(np.abs(_correlations(C, own)) > decisions.CORRELATED)
    return [[own[k] for k in group] for group in groups]


def correlated_parameters(fit: Identified) -> dict[int, tuple[int, float]]:
    """Return drive parameters strongly correlated with another parameter of the same drive."""
    layout, C, at_bound = fit.model.layout, fit.standard_covariance, fit.at_bound
    pairs = {}
    drive_of = enumerate([d for d, _ in layout.drive_parameters], start=layout.n_inertial)
    used = [(k, drive) for k, drive in drive_of if C[k, k] > 0 and not at_bound[k]]
    for drive in range(len(layout.drives)):
        own = [k for k, of_drive in used if of_drive == drive]
        for i, row in zip(own, _correlations(C, own), strict=True):
            k = int(np.argmax(np.abs(row)))
            if abs(row[k]) > decisions.CORRELATED:
                pairs[i] = own[k], float(row[k])
    return pairs


def not_written(log_errors: Sequence[Finding], inconsistent: str = "") -> Iterator[Finding]:
    """Yield a warning that the URDF is not written, with the reason; nothing if it is written."""
    codes = listed(dict.fromkeys(error.code for error in log_errors))
    what = "codes" if log_errors else "inconsistent"
    if log_errors or inconsistent:
        words = {"what": what, "cure": what, "codes": codes, "estimator": inconsistent}
        yield finding("urdf_not_written", subject="urdf", **words)


def locked_findings(model: RobotModel, stated: Collection[str]) -> list[Finding]:
    """Return a warning about locked joints whose positions matter but were not given."""
    # A position matters on a chain with an identified joint; on a floating base all matter.
    relevant = set(model.locked) if model.free_flyer else _in_line(model)
    assumed = [name for name in model.locked if name not in stated and name in relevant]
    return [finding("locked_at_zero", "", assumed)] if assumed else []


def _in_line(model: RobotModel) -> set[str]:
    """Return the joints that carry an identified joint, or are carried by one."""
    carriers, identified = model.tree.carriers, set(model.joints)
    carrying = set[str]().union(*(carriers[name] for name in identified))
    # the position of a base changes no torque, only its orientation
    rotating = {joint.name for joint in model.tree.joints if joint.type != "prismatic"}
    return carrying & rotating | {
        name for name, above in carriers.items() if identified.intersection(above)
    }


def log_findings(logs: Sequence[Log]) -> Iterator[Finding]:
    """Yield what was noted and assumed of logs, each once, with the names of its logs."""
    logs_of: dict[tuple[str, str], list[str]] = {}
    for log in logs:
        noted = [("log_note", x) for x in log.notes] + [("log_assumption", x) for x in log.assumed]
        for key in noted:
            logs_of.setdefault(key, []).append(Path(log.path).name)
    for (code, text), names in logs_of.items():
        yield finding(code, ", ".join(names), text=text)


def consistency_findings(fit: Fit) -> Iterator[Finding]:
    """Yield findings about the consistency of a fit."""
    check = fit.mass_matrix
    if not check.is_positive:
        yield finding(
            "mass_matrix", subject="standard_parameters", share=1 - check.positive_share,
            cure=isinstance(fit.estimator, ConsistentSettings), poses=check.poses,
            smallest=check.smallest_eigenvalue,
        )  # fmt: skip
    active = fit.estimate.details.get("active", ())
    bounds = [name for name in active if name.startswith(_USER_BOUNDS)]
    if bounds:
        why, words = _contradiction(fit)
        own = fit.estimator.bounds  # those of the links' geometry are often active
        stated = {"total_mass all", *(f"mass {link}" for link in own.mass)}
        stated |= {f"centre_of_mass {link}" for link in own.com}
        is_warning = why != "harmless" and not stated.isdisjoint(bounds)
        yield finding(
            "active_bound", subject=", ".join(bounds), bounds=listed(bounds), why=why,
            severity="warning" if is_warning else "note", **words,
        )  # fmt: skip


def _total_mass(fit: Fit) -> Iterator[Finding]:
    """Yield an error if the total mass differs from the URDF's by more than a factor of 3."""
    size = fit.model.layout.n_inertial
    pi = np.array([fit.prior, fit.standard])
    before, after = pi[:, :size:10].sum(axis=1).tolist()
    is_open, far = fit.estimator.bounds.total is None and before > 0, decisions.NO_ERROR_OF_MASSES
    if is_open and not before / far <= after <= far * before:
        evidence = {"urdf": before, "identified": after, "far": far}
        yield finding("total_mass", subject="standard_parameters", **evidence)


def encoder_noise(fit: Fit) -> Iterator[Finding]:
    """Yield a finding if encoder quantisation biases inertial parameters."""
    noise, model = fit.regressor_noise, fit.model
    if noise is None:
        return
    is_inertial = fit.mapping.K[:, : model.layout.n_inertial].any(axis=1)
    moved = np.where(is_inertial, np.abs(noise.shift) / noise.std_error, 0.0)
    worst = int(np.argmax(moved))
    if moved[worst] < _BIASED:
        return
    coarse = np.flatnonzero(noise.share > decisions.LEAST_SHARE * noise.share.max())
    steps = {model.joints[j]: noise.steps[j] for j in coarse}
    coarsest = max(steps, key=lambda joint: steps[joint])
    is_prismatic = coarsest in model.layout.prismatic
    yield finding(
        "encoder_noise", subject=listed(steps), names=listed(steps, 4), step=steps[coarsest],
        severity="warning" if moved[worst] >= QUANTILE else "note", std_errors=moved[worst],
        unit="m" if is_prismatic else "rad", bits_of=not is_prismatic,
        bits=np.log2(2 * np.pi / steps[coarsest]), share_pct=100 * noise.share.max(),
        parameter=fit.mapping.base_names[worst], effect=noise.is_corrected,
        **{f"step_{joint}": step for joint, step in steps.items()},
    )  # fmt: skip


def _is_within_box(fit: Fit, body: str, box: Array) -> bool:
    """Return whether a body's mass is in the box of the fit, wider than that of the geometry."""
    i = fit.model.layout.bodies.index(body)
    (J,) = pseudo_inertia(fit.standard[10 * i : 10 * i + 10])
    slack = np.einsum("ij,kji->k", J, slabs(box)) / J[3, 3]  # tr(J Q_k) / m
    centre = J[:3, 3] / J[3, 3]
    is_inside = (box[0] <= centre) & (centre <= box[1]) & (slack >= -TINY)
    return bool(is_inside.all())


def _impossible_shapes(fit: Fit) -> Iterator[Finding]:
    """Yield the identified bodies that are not possible in their geometry."""
    # Notes if the URDF's is not either, or in the box of the fit; without negligible bodies.
    model, points = fit.model, body_points(fit.model)
    boxes, negligible = body_boxes(model), negligible_bodies(model)
    before = {(fault.code, fault.where) for fault in audit_bodies(model, fit.prior, points)}
    for fault in audit_bodies(model, fit.standard, points):
        body = fault.words["link"]
        if body in negligible:  # it keeps the URDF's values, and has no effect
            continue
        if (fault.code, fault.where) in before:
            yield fault.reworded(severity="note", remedy="; the URDF has the same fault")
            continue
        severity = fault.severity
        remedy = f". {_cure(fit, body)}. The predicted torque may still be right; do not use mass, "
        remedy += "centre of mass and inertia of this link"
        if _is_within_box(fit, body, boxes[body]):
            severity, remedy = "note", "; it is within the margin of the fit"
        text = f"as identified, {fault.fault}"
        yield fault.reworded(fault=text, severity=severity, remedy=remedy)


def _dense_bodies(fit: Fit) -> Iterator[Finding]:
    """Yield the identified bodies whose inertia needs a density above that of any material."""
    # A note if the errors of mass and inertia allow a material, and no stated mass determines it.
    # Bodies as dense in the URDF are left out.
    if not fit.is_consistent:
        return
    size = fit.model.layout.n_inertial
    before, after = (pi[:size].reshape(-1, 10) for pi in (fit.prior, fit.standard))
    for k, (body, was, now) in enumerate(zip(fit.model.layout.bodies, before, after, strict=True)):
        density = least_density(now)
        if density <= max(DENSEST, least_density(was)):
            continue
        rows = slice(10 * k, 10 * k + 10)
        covariance = fit.standard_covariance[rows, rows]
        share = density_share(now, covariance, DENSEST, np.random.default_rng(0))
        is_open = share > _UNLIKELY and not _stated_of(fit, body)
        is_finite = bool(np.isfinite(density))
        yield finding(
            "dense_body", subject=f"link {body}", severity="note" if is_open else "warning",
            link=body, error=is_open, needs="finite" if is_finite else "none",
            conclusion=is_open, cure=_cure(fit, body), mass=now[0], density=density,
            rounded=float(f"{density:.2g}") if is_finite else 0.0, densest=DENSEST,
            share=share, half_width=QUANTILE * np.sqrt(covariance[0, 0]),
        )  # fmt: skip


def _cure(fit: Fit, body: str) -> str:
    """Return what to correct for an impossible body."""
    cure = "Record motion about more axes, or pin it to the URDF"
    for stated, mass in _stated_of(fit, body).items():
        cure = f"Check the given {stated} of {mass:.4g} kg: weigh it, or remove it"
    return cure


def _stated_of(fit: Fit, body: str) -> dict[str, float]:
    """Return the mass that the user states and that determines a body's, by its name [kg]."""
    bounds, layout = fit.estimator.bounds, fit.model.layout
    masses = fit.standard[: layout.n_inertial : 10]
    stated, pair, mass = "total_mass", bounds.total, float(masses.sum())
    if body in bounds.masses:
        stated, pair = f"mass of {body}", bounds.masses[body]
        mass = float(masses[layout.bodies.index(body)])
    is_at = pair is not None and np.isclose(mass, pair, rtol=CONVERGED).any()
    return {stated: mass} if is_at else {}


def _of_outliers(fit: Fit) -> Finding:
    outliers, more = fit.outliers, len(fit.outliers) - NAMED
    units = dict(zip(fit.model.row_names, fit.model.row_units, strict=True))
    places = "; ".join(
        f"{o.joint} at {o.t:.3f} s of {o.log}: measured {o.torque:.4g}, predicted "
        f"{o.predicted:.4g} {units[o.joint]}, residual {o.size:.0f} times the typical one"
        for o in outliers[:NAMED]
    ) + f"; and {more} more" * (more > 0)
    return finding(
        "outliers", "", outliers[0].joint, where=places, cure=fit.estimator.is_robust,
        severity="note" if fit.estimator.is_robust else "warning",
        count=f"{len(outliers)} outlier{'s' * (len(outliers) > 1)}", places=len(outliers),
        largest=outliers[0].size,
    )  # fmt: skip


def _contradiction(fit: Fit) -> tuple[str, dict[str, str]]:
    """Return whether data ("costs") or masses ("vanished") contradict active bounds."""
    ours, wls = (fit.metrics(name).per_joint for name in ("estimate", "wls"))
    costs = [joint for joint in ours if ours[joint].rmse > BEATEN * wls[joint].rmse]
    if costs:
        return "costs", {"costs": listed(costs)}
    layout, urdf = fit.model.layout, fit.model.standard_parameters()
    masses, before = (pi[: layout.n_inertial : 10] for pi in (fit.standard, urdf))
    vanished = [
        f"{layout.bodies[k]} has {masses[k]:.2g} of its {before[k]:.3g} kg"
        for k in np.flatnonzero(masses < decisions.ZERO * before)
    ]
    return ("vanished", {"vanished": ", ".join(vanished)}) if vanished else ("harmless", {})


def unlike_findings(variation: Variation | None) -> Iterator[Finding]:
    """Yield a finding for each unit and log that differs from what the others predict."""
    if variation is None:
        return
    for unlike in variation.unlike_units:
        name = f"unit {variation.unit_names[unlike.run]}"
        yield _unlike(name, unlike, variation.units - 1, "other units")
    for unlike in variation.unlike:
        yield _unlike(variation.runs[unlike.run], unlike, len(variation.runs) - 1, "other logs")


def _unlike(name: str, unlike: UnlikeRun, others: int, rest: str) -> Finding:
    """Return the finding about a log or a unit, with the prediction of the others."""
    code = "unlike_unit" if rest == "other units" else "unlike_run"
    (low, high), kind = (float(end) for end in unlike.ends), unlike.kind
    sign = "+" if kind == "zero" else ""
    size = f"{unlike.value:{sign}.3g} +- {unlike.std_error:.2g}"
    span = f"{low:.3g} to {high:.3g} {unlike.unit}"
    if kind == "gain":
        size = f"{100 * (unlike.value - 1):+.3g} +- {100 * unlike.std_error:.2g} %"
        span = f"{100 * (low - 1):+.3g} to {100 * (high - 1):+.3g} %"
    return finding(
        code, subject=name, name=name, what=kind, cure=kind, others=f"{others} {rest}", rest=rest,
        parameter=unlike.where if kind in ("zero", "gain") else unlike.name, unit=unlike.unit,
        size=size, range=span, value=unlike.value, std_error=unlike.std_error, low=low, high=high,
        probability=unlike.probability,
    )  # fmt: skip
