"""Content of result.json for an identification and for a preview."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from robotid.base.files import finite, source_entry
from robotid.base.settings import require_kind
from robotid.base.versions import __version__, versions
from robotid.data.signal_settings import Transmission
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.fitting.drive_terms import DriveChoice
from robotid.estimation.fitting.evaluation import LEFT_OUT, Evaluated, Evaluation
from robotid.estimation.fitting.fitted import SOURCES, Identified, next_errors
from robotid.estimation.fitting.standard_errors import QUANTILE, rms_error
from robotid.identification.parameter_table import parameter_entries
from robotid.identification.result import Identification, TorqueIdentification
from robotid.output.files.ranges import covariance_entry, parameter_ranges
from robotid.output.files.result_file import SCHEMA_VERSION
from robotid.robot.drives import TERMS
from robotid.robot.parameters import pseudo_inertia

if TYPE_CHECKING:
    from robotid.design.previews import Preview
    from robotid.identification.closed_loop.from_commands import PositionIdentification

_LOOP_TERMS = ("kp", "kd", "delay", "limit", "zero")
_EXTENT = ("samples", "rate", "start", "end", "rows_used", "segments")


def build_result(
    found: Identification, settings: Mapping[str, Any], outputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the content of result.json: plain values, all numbers finite."""
    require_kind(found, Identification, "identification", "a robotid.Identification")
    model, (bodies, drives) = found.model, parameter_entries(found)
    if isinstance(found, TorqueIdentification):
        own = _torque_entries(found, settings)
        beside = found.urdf_with_drives[len(bodies) :].tolist()
        drives = [x | {"with_urdf": value} for x, value in zip(drives, beside, strict=True)]
    else:
        own = loop_entries(cast("PositionIdentification", found))
    common = {
        "schema_version": SCHEMA_VERSION,
        "robotid": __version__,
        "versions": versions(),
        "robot": model.name,
        "joints": list(model.joints),
        "settings": dict(settings),
        "inputs": input_entries(found),
        "outputs": dict(outputs or {}),
        "structure": _structure(found) | own.pop("structure"),
        "base_parameters": _base_parameters(found),
        "standard_parameters": bodies,
        "drive_parameters": [*drives, *own.pop("loop_parameters", ())],
        "own_terms": model.options["own_terms"],
        "drive_moments": {name: moments.to_dict() for name, moments in found.moments.items()},
        "consistency": _consistency(found) | own.pop("consistency", {}),
        "identification": found.metrics().to_dict(),
        "validation": [e.to_dict() for e in found.validation],
        "warnings": [
            {"code": f.code, "severity": f.severity, "message": f.message, "where": f.where}
            for f in found.findings
        ],
        "verdict": found.verdict.to_dict(),
    }
    if found.has_urdf:
        common["ranges"] = parameter_ranges(found) | own.pop("ranges", {})
    return common | own


def _torque_entries(found: TorqueIdentification, settings: Mapping[str, Any]) -> dict[str, Any]:
    names, covariances = found.model.layout.names, {"covariance": found.standard_covariance}
    if np.any(found.repeated):
        covariances["torque_covariance"] = found.standard_covariance - found.repeated
    return {
        "structure": _determined(found),
        "uncertainty": {
            "method": found.errors.method,
            "segments": found.errors.segments,
            "inflation": found.errors.inflation,
        },
        **{key: covariance_entry(names, C, found.at_bound) for key, C in covariances.items()},
        "motors": _motors(found, settings),
        "friction": {drive.joint: _friction(found, drive) for drive in found.drives},
        "consistency": {
            "mass_matrix": asdict(found.mass_matrix),
            "fit": dict(found.estimate.details),
            "sources": {kind: found.sources.count(kind) for kind in SOURCES},
        },
        "validation": [e.to_dict() | {"band": _band(found, e)} for e in found.validation],
        "wls": {
            "base_values": found.wls.theta.tolist(),
            "base_std_errors": [finite(error) for error in found.wls.std_error],
            "identification": found.metrics("wls").to_dict(),
            "validation": [e.to_dict("wls") for e in found.validation],
        },
        "scale_check": found.scale_check.to_dict(),
        **_left_out(found),
        **_variation(found),
    }


def _left_out(found: TorqueIdentification) -> dict[str, Any]:
    """Return the metrics of each log as a fit to the others predicts it."""
    logs = [{"log": name.removesuffix(LEFT_OUT), **metrics.to_dict()}
            for name, metrics in found.left_out.items()]  # fmt: skip
    return {"left_out": logs} if logs else {}


def _variation(found: TorqueIdentification) -> dict[str, Any]:
    """Return the variation between three or more logs, the next one's torque error, and sums."""
    if found.variation is None or found.sums is None:
        return {}
    rows = zip(found.model.row_names, next_errors(found).tolist(), strict=True)
    content = found.variation.to_dict() | {"next_torque_rmse": dict(rows)}
    noise = found.regressor_noise
    units = [found.variation.unit_names[k] for k in found.variation.of_runs]
    sums = found.sums.to_dict() | {"unit": units}
    if noise is not None and noise.is_corrected:
        sums["shift"] = noise.shift.tolist()
    return {"variation": content | {"sums": sums}}


def build_preview(preview: "Preview") -> dict[str, Any]:
    """Return the content of a preview: plain values, all numbers finite."""
    found, noise = preview.expected, preview.noise
    bodies, drives = (
        [{key: x for key, x in entry.items() if key not in ("value", "at_bound")} for entry in part]
        for part in parameter_entries(found)
    )
    keys = ("name", "expression", "std_error", "unit")
    base = [
        {key: entry[key] for key in keys} | {"plausible": float(spread)}
        for entry, spread in zip(_base_parameters(found), preview.plausible, strict=True)
    ]
    if preview.before is not None and preview.gain is not None:
        for entry, before, gain in zip(base, preview.before, preview.gain, strict=True):
            entry |= {"std_error_before": finite(before), "gain": finite(gain)}
    units = dict(zip(found.model.row_names, found.model.row_units, strict=True))
    return {
        "robot": found.model.name,
        "joints": list(found.model.joints),
        "estimator": found.estimator.name,
        "motions": [
            {"role": "motion", **source_entry(e.recording.log.path), **_extent(e)}
            for e in found.fitted
        ],
        "noise": {
            joint: {"std": float(std), "unit": units[joint], "correlation": float(time), "is": of}
            for joint, std, time, of in zip(
                found.model.joints, noise.std, noise.correlation, noise.origins, strict=True
            )
        },
        "structure": _structure(found) | _determined(found),
        "undetermined": list(found.determination.undetermined),
        "words": preview.words,
        "base_parameters": base,
        "standard_parameters": bodies,
        "drive_parameters": drives,
        "torque": _expected_torque(preview),
    }


def _friction(found: TorqueIdentification, drive: DriveChoice) -> dict[str, Any]:
    own = [term for term in found.model.layout.terms if TERMS[term].is_friction]
    choice, row = drive.to_dict(), found.model.row_names.index(drive.joint)
    runs = [e.recording for e in found.fitted]
    moves = any(run.trajectory.v[run.mask[:, row], row].any() for run in runs)
    return {
        "terms": [*own, *drive.families],
        **choice,
        **({"curve": found.friction(drive.joint).to_dict()} if moves else {}),
        "on_misfit": [name for name in found.on_misfit if name.startswith(f"{drive.joint}.")],
        "tried": [{"terms": [*own, *tried["families"]], **tried} for tried in choice["tried"]],
    }


def _structure(found: Identified) -> dict[str, Any]:
    return {
        "standard": found.model.layout.n_inertial,
        "base_inertial": len(structural_mapping(found.model, inertial_only=True).K),
        "base": len(found.base),
        "undetermined": list(found.undetermined),
    }


def _determined(found: TorqueIdentification) -> dict[str, Any]:
    """Return the number of base parameters that torques determine, and indistinguishable ones."""
    return {
        "rank": found.determination.rank,
        "condition": finite(found.wls.condition),
        "poorly_excited": found.is_poorly_excited,
        "indistinguishable": found.determination.to_list(),
    }


def _expected_torque(preview: "Preview") -> dict[str, dict[str, Any]]:
    """Return RMS torque and RMS half width of the 95 % band of each joint on the motions."""
    found, bands, model = preview.expected, preview.bands, preview.expected.model
    tau = np.vstack([e.recording.trajectory.tau for e in found.fitted])
    rms, half = np.sqrt(np.mean(tau**2, axis=0)), QUANTILE * rms_error(bands)
    of_parameters = QUANTILE * rms_error([replace(x, noise=0.0 * x.noise) for x in bands])
    return {
        row: {
            "rms": float(rms[j]),
            "half_width": float(half[j]),
            "of_parameters": float(of_parameters[j]),
            "unit": model.row_units[j],
        }
        for j, row in enumerate(model.row_names)
        if row in model.joints
    }


def input_entries(found: Identification) -> list[dict[str, Any]]:
    """Return the files that were read, for result.json, the URDF first."""
    inputs = [{"role": "urdf", **source_entry(found.model.tree.path)}]
    for role, evaluations in (("identification", found.fitted), ("validation", found.validation)):
        for e in evaluations:
            signals = asdict(e.recording.signals) if isinstance(e, Evaluation) else {}
            source = source_entry(e.log.path)
            inputs.append({"role": role, **source, **_extent(e), "signals": signals})
    return inputs


def _extent(evaluation: Evaluated) -> dict[str, Any]:
    return {key: getattr(evaluation.extent, key) for key in _EXTENT}


def _base_parameters(found: Identified) -> list[dict[str, Any]]:
    mapping, units = found.mapping, found.model.layout.units
    return [
        {
            "name": name,
            "expression": mapping.expressions[k],
            "value": float(found.base[k]),
            "std_error": finite(found.base_error[k]),
            "interval_95": [finite(end) for end in found.base_interval[k]],
            "unit": units[i],
        }
        for k, (name, i) in enumerate(zip(mapping.base_names, mapping.independent, strict=True))
    ]


def _motors(
    found: TorqueIdentification, settings: Mapping[str, Any]
) -> dict[str, dict[str, float]]:
    """Return gear ratio and motor inertia, armature / ratio^2, of geared drives."""
    model, gears = found.model, dict[str, float]()
    for table in settings.get("transmission", ()):
        gears |= Transmission.from_dict(table).stated(model.tree.reductions).gears
    values = found.standard[model.layout.n_inertial :]
    return {
        name: {"gear": gears[name], "inertia": float(value) / gears[name] ** 2}
        for (d, term), value in zip(model.layout.drive_parameters, values, strict=True)
        if term.is_inertia and (name := model.layout.drives[d].name) in gears
    }


def _consistency(found: Identified) -> dict[str, Any]:
    layout = found.model.layout
    J = pseudo_inertia(found.standard[: layout.n_inertial])
    smallest = np.linalg.eigvalsh(J)[:, 0]
    return {
        "is_consistent": found.is_consistent,
        "links": [
            {"name": body, "mass": float(J[i, 3, 3]), "min_eigenvalue": float(smallest[i])}
            for i, body in enumerate(layout.bodies)
        ],
        "total_mass": float(J[:, 3, 3].sum()),
    }


def _band(found: TorqueIdentification, evaluation: Evaluation) -> dict[str, Any]:
    run, band = evaluation.recording, found.band(evaluation)
    covered = band.coverage(run.trajectory.tau, evaluation.torques["estimate"], run.mask)
    return {
        row: {
            "half_width": float(QUANTILE * np.sqrt(np.mean(total**2))),
            "of_parameters": float(QUANTILE * np.sqrt(np.mean(parameters**2))),
            "coverage_pct": finite(100 * share),
        }
        for row, total, parameters, share in zip(
            found.model.row_names, band.total.T, band.parameters.T, covered, strict=True
        )
    }


def loop_entries(found: "PositionIdentification") -> dict[str, Any]:
    """Return the entries of result.json that only an identification by simulation has."""
    model, estimate = found.model, found.estimate
    bodies = zip(found.mapping.base_names, found.mapping.independent, found.base_error, strict=True)
    first = model.layout.n_inertial  # of drives
    unfitted = [name for name, i, error in bodies if i < first and math.isinf(error)]
    return {
        "structure": {
            "rank": estimate.rank,
            "condition": finite(estimate.condition),
            "indistinguishable": [{"names": list(names)} for names in found.correlated],
        },
        "uncertainty": {
            "method": "scatter of the scores of segments of the whitened residual",
            "inflation": estimate.details["inflation"],
        },
        "ranges": {"undetermined": [*unfitted, *found.undetermined]},
        "loop_parameters": loop_parameters(found),
        "covariance": _covariance(found),
        **({} if found.variation is None else {"variation": found.variation.to_dict()}),
        "simulation": {
            "controller": _controller(found),
            "signs": dict(zip(model.joints, found.fit.encoders.sign.tolist(), strict=True)),
            "fit": {
                "message": estimate.message,
                "converged": estimate.converged,
                "parameters": len(estimate.theta),
                "correlation": [float(rho) for rho in estimate.details["correlation"]],
            },
            "friction_tried": [asdict(tried) for tried in found.fit.tried],
            "identification": [e.to_dict() for e in found.fitted],
        },
    }


def loop_parameters(found: "PositionIdentification") -> list[dict[str, Any]]:
    """Return gains, delay, limit and zero of each joint; stated ones have no standard error."""
    if found.loop.kind == "torque":
        return []
    loops, estimate = found.fit.loops, found.fit.estimate
    free, errors, entries = found.fit.simulator.free_parameters, {}, []
    for parameter, error, quantile in zip(free, estimate.std_error, estimate.quantile, strict=True):
        source = "bound" if parameter.name in estimate.details["at_bound"] else "data"
        for j in parameter.joints:
            errors[parameter.what, j] = float(error), float(quantile), source
    for j, joint in enumerate(found.model.limits):
        force, length = ("N", "m") if joint.type == "prismatic" else ("N m", "rad")
        units = {
            "kp": f"{force}/{length}", "kd": f"{force} s/{length}", "delay": "s", "limit": force,
            "zero": length,
        }  # fmt: skip
        for what, unit in units.items():
            value = float(getattr(loops, what)[j])
            if math.isfinite(value):
                std_error, reach, source = errors.get((what, j), (None, None, "stated"))
                entries.append(
                    {"name": f"{joint.name}.{what}", "value": value, "std_error": std_error,
                     "quantile": reach, "unit": unit, "source": source}
                )  # fmt: skip
    return entries


def _covariance(found: "PositionIdentification") -> dict[str, Any]:
    """Return the root of the covariance of standard parameters, then gains, delays and zeros."""
    simulator, estimate, model = found.fit.simulator, found.estimate, found.model
    names, slopes = list(model.layout.names), [simulator.standard(model, estimate.theta)[1]]
    free = simulator.free_parameters
    for k, parameter in enumerate(free):
        if parameter.what in _LOOP_TERMS:
            names += [f"{model.joints[j]}.{parameter.what}" for j in parameter.joints]
            slopes += [np.eye(len(free))[k : k + 1]] * len(parameter.joints)
    S = np.vstack(slopes) * ~np.isin(simulator.names, estimate.details["at_bound"])
    C = S @ estimate.covariance @ S.T
    return covariance_entry(names, C, np.zeros(len(names), dtype=bool))


def _controller(found: "PositionIdentification") -> dict[str, Any]:
    limits = dict(zip(found.model.joints, found.fit.loops.limit.tolist(), strict=True))
    stated = {joint: x for joint, x in limits.items() if math.isfinite(x)} or None
    return {"kind": found.loop.kind, "effort_limit": stated, "rate": found.loop.rate}
