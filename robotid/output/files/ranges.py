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
from robotid.estimation.variation.spread import (
    correlated_scores,
    possible_draws,
    root_of,
    scores_to_values,
)
from robotid.estimation.variation.variation import SCORES
from robotid.output.files.exports import Format, Option, Written, head_of, yaml_text
from robotid.output.files.result_file import Result, commanded_drives
from robotid.output.files.urdf import link_parameters
from robotid.robot.bodies import held_parameters, principal_moments
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia, pseudo_inertia_basis

_DIGITS = 9  # significant digits of the root in result.json
_MOST = 1_000_000
#: Drive terms of simulators, which replace the friction of drives with further terms.
SIMULATED = ("viscous", "coulomb", "offset")
_POSITIVE = ("kp", "limit")
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
    result: Result, target: Path, *, samples: int | None = None, seed: int | None = None
) -> Written:
    """Write the ranges that a result states, as YAML, and samples beside it, as JSON."""
    if samples is None and seed is not None:
        raise SettingsError("seed is an option of samples; set their number, samples, too")
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
    """Return the ranges of links and drives as plain values, to first order in the parameters."""
    layout, sources, quantile = found.model.layout, found.sources, found.standard_quantile
    variation = getattr(found, "variation", None)  # not of a result from commands
    between = {} if variation is None else {x.name: x.prediction for x in variation.parameters}
    drives: dict[str, dict[str, Any]] = {drive.name: {} for drive in layout.drives}
    for k, (d, drive_term) in enumerate(layout.drive_parameters, start=layout.n_inertial):
        name, drive = layout.names[k], layout.drives[d].name
        least = 0.0 if drive_term.is_nonnegative else -math.inf
        source = "bound" if found.at_bound[k] else sources[k]
        error, reach = found.standard_error[k], float(quantile[k])
        ends = _range(found.standard[k], error, source, reach, least)
        if name in between and source != "bound":
            ends = _of_logs(ends, between[name].ends, least)
        drives[drive][name.removeprefix(f"{drive}.")] = ends | {"unit": layout.units[k]}
    bodies = {}
    for i, (body, pi) in enumerate(link_parameters(found.model, found.standard).items()):
        part = slice(10 * i, 10 * i + 10)
        C = found.standard_covariance[part, part]
        bodies[body] = _body(pi, C, sources[part], float(quantile[part].max()))
    return {
        "robot": found.model.name,
        "confidence": 0.95,
        "bodies": bodies,
        "drives": drives,
        **projected_ranges(found),
        "undetermined": list(found.undetermined),
    }


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
            term: _range(value, error, "data", quantile, _least(term))
            for (term, value), error in zip(drive.values.items(), errors, strict=True)
            if error > 0
        }
    return {"projected_drives": ranges} if ranges else {}


def stated_ranges(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ranges of a result, including gains, delays and zeros of its drives."""
    empty = {"robot": content["robot"], "confidence": 0.95, "bodies": {}, "drives": {}}
    ranges = content.get("ranges", empty)
    between = content.get("variation", {}).get("parameters", {})
    drives: dict[str, dict[str, Any]] = {}
    for entry in content["drive_parameters"]:
        drive, _, term = entry["name"].rpartition(".")
        error = entry.get("std_error")
        reach = entry.get("quantile") or QUANTILE
        source = entry.get("source", "stated" if error is None else "data")
        source = "bound" if entry.get("at_bound") else str(source)
        ends = _range(
            entry["value"], math.inf if error is None else error, source, reach,
            _least(term), is_positive=term == "kp",
        ) | {"unit": entry["unit"]}  # fmt: skip
        ends = ranges["drives"].get(drive, {}).get(term, ends)
        if entry["name"] in between and "low" in ends and ends["source"] != "bound":
            ends = _of_logs(ends, between[entry["name"]]["next_interval"], _least(term))
        drives.setdefault(drive, {})[term] = ends
    return {"undetermined": content["structure"]["undetermined"], **ranges, "drives": drives}


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
    parts = [sources[:1], *([sources[0], source] for source in sources[1:4]), *[sources] * 6]
    origins = [part[0] if len(set(part)) == 1 else "mixed" for part in parts]
    x, y, z, w = Rotation.from_matrix(V).as_quat()
    mass, *rest = (
        _range(value, error, origin, quantile, is_positive=not 1 <= k <= 3)
        for k, (value, error, origin) in enumerate(zip(values, errors, origins, strict=True))
    )
    return {
        "mass": mass,
        "com": dict(zip("xyz", rest[:3], strict=True)),
        "principal_axes": [float(x) for x in (w, x, y, z)],
        "second_moments": dict(zip("xyz", rest[3:6], strict=True)),
        "principal_moments": dict(zip(("Ixx", "Iyy", "Izz"), rest[6:], strict=True)),
    }


def _range(
    value: float,
    error: float,
    source: str,
    quantile: float,
    least: float = -math.inf,
    *,
    is_positive: bool = False,
) -> dict[str, Any]:
    """Return the range of a value; without ends if its standard error is infinite."""
    nominal, half = max(float(value), least), quantile * float(error)  # a delay may be below 0
    if not math.isfinite(half):
        return {"nominal": nominal, "source": source}
    low = nominal * math.exp(-half / nominal) if is_positive else max(nominal - half, least)
    return {"nominal": nominal, "low": low, "high": nominal + half, "source": source}


def _of_logs(ends: Mapping[str, Any], interval: Sequence[float], least: float) -> dict[str, Any]:
    low, high = map(float, interval)
    return {**ends, "low": max(low, least), "high": high, "source": "logs"}


def _least(term: str) -> float:
    return 0.0 if term in _NOT_NEGATIVE or term == "kp" else -math.inf


def covariance_entry(names: Sequence[str], covariance: Array, is_fixed: Array) -> dict[str, Any]:
    """Return a covariance (p, p) for result.json, as its root; fixed parameters (p,) have none."""
    is_known = ~(is_fixed | is_fixed[:, None]) & np.isfinite(covariance)
    L = root_of(np.where(is_known, covariance, 0.0))
    root = [[float(f"{x:.{_DIGITS}g}") for x in np.trim_zeros(row, "b")] for row in L]
    return {"names": list(names), "root": root}


def write_samples(result: Result, target: Path, count: int, seed: int) -> None:
    """Write samples of the parameters of a result as JSON."""
    if not 1 <= count <= _MOST:
        raise SettingsError(f"samples is {count}, expected a whole number from 1 to {_MOST}")
    if seed < 0:
        raise SettingsError(f"seed is {seed}, expected a whole number, 0 or more")
    names, values = sample(result, count, np.random.default_rng(seed))
    model, pi = result.identified
    units = {entry["name"]: entry["unit"] for entry in result.content["drive_parameters"]}
    covariance = np.cov(values.T) if count > 1 else np.zeros((len(names),) * 2)
    content = {
        "robot": model.name,
        "samples": count,
        "seed": seed,
        "bodies": _bodies(model, values),
        "drives": _drives(model, names, values),
        "projected_drives": _projected(result, values),
        "parameters": {
            "names": names,
            "units": [*model.layout.units, *(units[name] for name in names[len(pi) :])],
            "nominal": [*pi.tolist(), *_nominal(result, names[len(pi) :])],
            "mean": values.mean(axis=0).tolist(),
            "covariance": covariance.tolist(),
        },
    }
    write_text(json.dumps(content, allow_nan=False) + "\n", target)


def sample(result: Result, count: int, rng: np.random.Generator) -> tuple[list[str], Array]:
    """Return samples (count, p) of all parameters from their joint distribution.

    Bodies are normal with the covariance of the fit, given that all are physically possible.
    Drive parameters with a spread between logs have the predictive distribution of the next log or
    robot. Their correlation is that of the error of the fit, with all its parameters, and that of
    their values in the logs, among each other.
    """
    model, pi = result.identified
    stated = result.content.get("covariance")
    if stated is None:
        raise DataError(
            f"{result.path.name} of an earlier version has no covariance; identify again"
        )
    names, size = list(stated["names"]), len(pi)
    root = np.zeros((len(names), len(names)))
    for row, values in zip(root, stated["root"], strict=True):
        row[: len(values)] = values
    root *= _quantile(result.content) / QUANTILE
    nominal = np.concatenate([pi, _nominal(result, names[size:])])
    between = _between(result.content)
    varies = np.array([name in between for name in names], dtype=bool)
    link_parameters(model, pi)  # raises if a link is impossible
    held, terms = held_parameters(model), [name.rpartition(".")[2] for name in names]
    is_positive = np.isin(terms, _POSITIVE) & (np.arange(len(names)) >= size)
    is_bounded = np.isin(terms, [*_NOT_NEGATIVE]) | is_positive
    is_bounded[:size] = model.layout.is_nonnegative()
    least = np.where(is_bounded, 0.0, -math.inf)
    is_bounded, is_positive = is_bounded & ~varies, is_positive & ~varies  # drawn anew below

    def is_possible(x: Array) -> Array:
        drawn = nominal + x
        signs = (drawn[:, is_bounded] >= 0.0).all(1) & (drawn[:, is_positive] > 0.0).all(1)
        J = pseudo_inertia((drawn[:, : model.layout.n_inertial] - held).reshape(-1))
        minors = [np.linalg.det(J[:, :k, :k]) > 0.0 for k in (1, 2, 3, 4)]  # Sylvester
        return np.asarray(signs & np.all(minors, axis=0).reshape(len(x), -1).all(1))

    if not is_possible(np.zeros((1, len(nominal)))).all():
        found = "kp or limit is 0, or a body is at its bound; state that value and identify again"
        raise DataError(f"{result.path.name}: no samples about an impossible estimate: {found}")
    x = possible_draws(root, is_possible, count, rng)
    drawn = nominal + x
    if varies.any():
        entries = [between[name] for name in names if name in between]
        error = np.sqrt((root[varies] ** 2).sum(axis=1))
        scores = x[:, varies] / np.where(error > 0.0, error, 1.0)
        # the rest of the error of the mean is due to the spread, and correlates as it does
        of_mean, total = np.array([entry["errors"] for entry in entries]).T
        share = np.minimum(np.minimum(error, of_mean) / total, 1.0) ** 2
        order = [entry["at"] for entry in entries]
        R = np.array(result.content["variation"]["correlation"])[np.ix_(order, order)]
        z = correlated_scores(scores, share, R, rng.standard_normal(scores.shape))
        for k, (i, entry) in enumerate(zip(np.flatnonzero(varies), entries, strict=True)):
            drawn[:, i] = scores_to_values(z[:, k], SCORES, entry["quantiles"], least[i])
    return names, drawn


def _between(content: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return quantiles of the next log, errors of the mean and of it, and number, by parameter."""
    between: dict[str, dict[str, Any]] = {}
    at_bound = {x["name"] for x in content["drive_parameters"] if x.get("at_bound")}
    for k, (name, entry) in enumerate(content.get("variation", {}).get("parameters", {}).items()):
        if name not in at_bound:
            low, high = entry["next_interval"]
            errors = entry["std_error"], (high - low) / (2.0 * QUANTILE)
            quantiles = np.array(entry["next_quantiles"])
            between[name] = {"quantiles": quantiles, "errors": errors, "at": k}
    return between


def _quantile(content: Mapping[str, Any]) -> float:
    """Return the typical half-width of an interval in standard errors."""
    entries = (*content["standard_parameters"], *content["drive_parameters"])
    own = [q for entry in entries if (q := entry.get("quantile")) and entry.get("std_error")]
    return float(np.median(own)) if own else QUANTILE


def _nominal(result: Result, names: list[str]) -> list[float]:
    stated = {entry["name"]: float(entry["value"]) for entry in result.content["drive_parameters"]}
    return [max(stated[x], 0.0) if x.endswith(".delay") else stated[x] for x in names]


def _bodies(model: RobotModel, values: Array) -> dict[str, Any]:
    """Return mass, centre of mass, and inertia about it along the link's axes, by link."""
    layout = model.layout
    bodies = values[:, : layout.n_inertial] - held_parameters(model)
    J = pseudo_inertia(bodies.reshape(-1)).reshape(len(values), -1, 4, 4)
    m = J[..., 3, 3]
    c = J[..., :3, 3] / m[..., None]
    about = J[..., :3, :3] - m[..., None, None] * c[..., :, None] * c[..., None, :]
    inertia = np.trace(about, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - about
    moments = inertia[..., (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
    return {
        body: {"mass": m[:, i].tolist(), "com": c[:, i].tolist(), "inertia": moments[:, i].tolist()}
        for i, body in enumerate(layout.bodies)
    }


def _drives(model: RobotModel, names: list[str], values: Array) -> dict[str, dict[str, Any]]:
    drives: dict[str, dict[str, Any]] = {}
    for k in range(model.layout.n_inertial, len(names)):
        drive, _, term = names[k].rpartition(".")
        drives.setdefault(drive, {})[term] = values[:, k].tolist()
    return drives


def _projected(result: Result, values: Array) -> dict[str, dict[str, Any]]:
    model, pi = result.identified
    drives = project_friction(model, pi, result.drive_moments, SIMULATED).drives
    return {
        drive.name: {
            term: (np.maximum(x, 0.0) if term != "offset" else x).tolist()
            for term, T in zip(drive.values, drive.transfer, strict=True)
            for x in [values[:, list(drive.own)] @ T]
        }
        for drive in drives
    }
