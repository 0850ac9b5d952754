"""Ranges for domain randomisation: the interval of each parameter, and its source.

A body is described by its mass, its centre, and its second moments of mass about the centre along
fixed axes. Any positive values give a possible body, so each may be drawn independently.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import write_text
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.dynamics.friction_projection import project_friction
from robotid.estimation.fitting.fitted import Identified
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.output.files.commanded import commanded_drives
from robotid.output.files.exports import Format, Option, Written, head_of, yaml_text
from robotid.output.files.result_file import Result
from robotid.output.files.samples import SIMULATED, write_samples
from robotid.output.files.urdf import link_parameters
from robotid.robot.bodies import principal_moments
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia_basis

#: Parameters of drives that cannot be negative.
_NOT_NEGATIVE = {"kd", "delay", *(name for name, term in TERMS.items() if term.is_nonnegative)}
FORMAT = Format(
    "ranges",
    "YAML of 95 % intervals, for domain randomisation",
    "_ranges.yaml",
    use_of_gains="Randomise the drives within their intervals.",
    options={
        "samples": Option(
            "also FILE.samples.json with N samples of the joint distribution", "N", int
        ),
        "seed": Option("seed of these samples, default 0", "K", int),
    },
)


def export(
    result: Result,
    target: Path,
    *,
    samples: int | None = None,
    seed: int | None = None,
) -> Written:
    """Write the ranges that a result states, as YAML, and samples beside it, as JSON."""
    if samples is None and seed is not None:
        raise SettingsError("seed is an option of samples; state their number, samples, too")
    model, pi = result.identified  # raises for a result without URDF
    has_gains = bool(commanded_drives(model, pi, result.content, result.path.name))
    if "ranges" not in result.content and not has_gains:
        raise DataError(f"{result.path.name} of an earlier version has no ranges; identify again")
    files = [target]
    if samples is not None:
        files.append(target.with_suffix(".samples.json"))
        write_samples(result, files[1], samples, seed or 0)
    write_text(ranges_text(stated_ranges(result.content)), target)
    return Written(files, (), {})


def parameter_ranges(found: Identified) -> dict[str, Any]:
    """Return the ranges of the parameters of links and drives, as plain values.

    The intervals of centre and moments are first-order functions of those of the parameters.
    """
    layout, sources = found.model.layout, found.sources
    errors, covariance = found.standard_error, found.standard_covariance
    quantile = found.standard_quantile
    variation = getattr(found, "variation", None)  # not of a result from commands
    between = {} if variation is None else {each.name: each for each in variation.parameters}
    drives: dict[str, dict[str, Any]] = {drive.name: {} for drive in layout.drives}
    for k, (d, term) in enumerate(layout.drive_parameters, start=layout.n_inertial):
        name, least = layout.drives[d].name, 0.0 if term.is_nonnegative else -math.inf
        source = "bound" if found.at_bound[k] else sources[k]
        found_range = _range(
            found.standard[k], errors[k], source, least=least, quantile=float(quantile[k])
        )
        if layout.names[k] in between and source != "bound":
            low, high = between[layout.names[k]].prediction.ends
            found_range |= {"low": max(float(low), least), "high": float(high), "source": "logs"}
        term_name = layout.names[k].removeprefix(f"{name}.")
        drives[name][term_name] = found_range | {"unit": layout.units[k]}
    return {
        "robot": found.model.name,
        "confidence": 0.95,
        "bodies": body_ranges(found.model, found.standard, covariance, sources, quantile),
        "drives": drives,
        **projected_ranges(found),
        "undetermined": list(found.undetermined),
    }


def body_ranges(
    model: RobotModel, standard: Array, covariance: Array, sources: Sequence[str], quantile: Array
) -> dict[str, dict[str, Any]]:
    """Return the ranges of links; a link that was not identified has no ends.

    standard (p,), covariance (p, p), quantile (p,).
    """
    own, bodies = link_parameters(model, standard), {}
    for i, body in enumerate(model.layout.bodies):
        part = slice(10 * i, 10 * i + 10)
        bodies[body] = _body(
            own[body], covariance[part, part], sources[part], float(quantile[part].max())
        )
    return bodies


def projected_ranges(found: Identified) -> dict[str, Any]:
    """The ranges of projected friction, as in exports for MuJoCo, of drives with more terms."""
    moments = found.moments if found.model.layout.own else {}
    drives = project_friction(found.model, found.standard, moments, SIMULATED).drives
    ranges: dict[str, dict[str, Any]] = {}
    for drive in drives:
        C = found.standard_covariance[np.ix_(drive.own, drive.own)]
        errors = np.sqrt(np.maximum(np.diag(drive.transfer @ C @ drive.transfer.T), 0.0))
        quantile = float(found.standard_quantile[list(drive.own)].max())
        ranges[drive.name] = {
            term: _range(
                value,
                error,
                "data",
                quantile=quantile,
                least=0.0 if term in _NOT_NEGATIVE else -math.inf,
            )
            for (term, value), error in zip(drive.values.items(), errors, strict=True)
            if error > 0
        }
    return {"projected_drives": ranges} if ranges else {}


def stated_ranges(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ranges of a result, including gains, delays and zeros of its drives."""
    drives: dict[str, dict[str, Any]] = {}
    for entry in content["drive_parameters"]:
        drive, _, term = entry["name"].rpartition(".")
        error = entry.get("std_error")
        ends = _range(
            entry["value"],
            math.inf if error is None else error,
            source_of(entry),
            is_positive=term == "kp",
            quantile=entry.get("quantile") or QUANTILE,
            least=0.0 if term in _NOT_NEGATIVE else -math.inf,
        )
        drives.setdefault(drive, {})[term] = ends | {"unit": entry["unit"]}
    empty = {"robot": content["robot"], "confidence": 0.95, "bodies": {}, "drives": {}}
    ranges = content.get("ranges", empty)
    merged = {drive: terms | ranges["drives"].get(drive, {}) for drive, terms in drives.items()}
    for name, entry in content.get("variation", {}).get("parameters", {}).items():
        drive, _, term = name.rpartition(".")
        own = merged.get(drive, {}).get(term)
        if own is not None and "low" in own and own["source"] != "bound":
            low, high = entry["next_interval"]
            least = 0.0 if term in _NOT_NEGATIVE or term == "kp" else -math.inf
            of_logs = {"low": max(low, least), "high": high, "source": "logs"}
            merged[drive][term] = own | of_logs
    return {"undetermined": content["structure"]["undetermined"], **ranges, "drives": merged}


def ranges_text(ranges: Mapping[str, Any]) -> str:
    """Return ranges as YAML, with an explanation in the head."""
    head = head_of("ranges", robot=json.dumps(ranges["robot"]), version=__version__)
    return yaml_text(ranges, head)


def _body(pi: Array, covariance: Array, sources: Sequence[str], quantile: float) -> dict[str, Any]:
    """Return the ranges of a link from ten parameters, shape (10,), and covariance (10, 10)."""
    m, c = pi[0], pi[1:4] / pi[0]
    moments, V = principal_moments(pi)
    # moments = diag(P J P^T) with J linear in pi; the effect of c on them is of second order
    P = V.T @ np.column_stack([np.eye(3), -c])  # (3, 4)
    d_moments = np.einsum("ka,iab,kb->ki", P, pseudo_inertia_basis(), P)
    d_com = (np.eye(10)[1:4] - np.outer(c, np.eye(10)[0])) / m
    d_inertia = d_moments.sum(axis=0) - d_moments
    values = np.array([m, *c, *moments, *(moments.sum() - moments)])  # (10,)
    D = np.vstack([np.eye(10)[:1], d_com, d_moments, d_inertia])  # (10, 10), d values / d pi
    errors = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", D, covariance, D), 0.0))
    errors = errors if covariance.any() else np.full(len(errors), math.inf)
    origins = [sources[0], *(_joint_source([sources[0], sources[k]]) for k in (1, 2, 3))]
    origins += [_joint_source(sources)] * 6
    x, y, z, w = Rotation.from_matrix(V).as_quat()
    mass, *rest = (
        _range(value, error, origin, is_positive=not 1 <= k <= 3, quantile=quantile)
        for k, (value, error, origin) in enumerate(zip(values, errors, origins, strict=True))
    )
    return {
        "mass": mass,
        "com": dict(zip("xyz", rest[:3], strict=True)),
        "principal_axes": [float(x) for x in (w, x, y, z)],
        "second_moments": dict(zip("xyz", rest[3:6], strict=True)),
        "principal_moments": dict(zip(("Ixx", "Iyy", "Izz"), rest[6:], strict=True)),
    }


def _joint_source(sources: Sequence[str]) -> str:
    """Return the source of a function of several parameters."""
    return sources[0] if len(set(sources)) == 1 else "mixed"


def source_of(entry: Mapping[str, Any]) -> str:
    """Return the source of a parameter of a result, also for results that do not state it."""
    found = "stated" if entry.get("std_error") is None else "data"
    return "bound" if entry.get("at_bound") else str(entry.get("source", found))


def _range(
    value: float,
    error: float,
    source: str,
    *,
    is_positive: bool = False,
    least: float = -math.inf,
    quantile: float = QUANTILE,
) -> dict[str, Any]:
    """Return the range of a value; without ends if its standard error is infinite."""
    nominal, half = float(value), quantile * float(error)
    if not math.isfinite(half):
        return {"nominal": nominal, "source": source}
    low = nominal * math.exp(-half / nominal) if is_positive else max(nominal - half, least)
    return {"nominal": nominal, "low": low, "high": nominal + half, "source": source}
