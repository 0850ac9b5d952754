"""Entries of result.json that only an identification by simulation has."""

import dataclasses
import math
from typing import Any

import numpy as np

from robotid.base.files import finite
from robotid.identification.closed_loop.loop_result import PositionIdentification
from robotid.output.files.samples import covariance_entry

_LOOP_TERMS = ("kp", "kd", "delay", "limit", "zero")


def loop_entries(found: PositionIdentification) -> dict[str, Any]:
    """Return the entries of result.json that only an identification by simulation has."""
    model, estimate = found.model, found.estimate
    bodies = zip(found.mapping.base_names, found.mapping.independent, found.base_error, strict=True)
    unfitted = [
        name for name, i, error in bodies if i < model.layout.n_inertial and math.isinf(error)
    ]
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
            "friction_tried": [dataclasses.asdict(tried) for tried in found.fit.tried],
            "identification": [e.to_dict() for e in found.fitted],
        },
    }


def loop_parameters(found: PositionIdentification) -> list[dict[str, Any]]:
    """Return gains, delay, limit and zero of each joint; stated ones have no standard error."""
    if found.loop.kind == "torque":
        return []
    loops, estimate = found.fit.loops, found.fit.estimate
    errors = {
        (unknown.what, j): (
            float(error),
            float(quantile),
            "bound" if unknown.name in estimate.details["at_bound"] else "data",
        )
        for unknown, error, quantile in zip(
            found.fit.simulator.free_parameters, estimate.std_error, estimate.quantile, strict=True
        )
        for j in unknown.joints
    }
    entries = []
    for j, joint in enumerate(found.model.limits):
        force, length = ("N", "m") if joint.type == "prismatic" else ("N m", "rad")
        units = {
            "kp": f"{force}/{length}", "kd": f"{force} s/{length}", "delay": "s", "limit": force,
            "zero": length,
        }  # fmt: skip
        for what, unit in units.items():
            value = float(getattr(loops, what)[j])
            if math.isfinite(value):
                error, quantile, source = errors.get((what, j), (None, None, "stated"))
                entries.append(
                    {"name": f"{joint.name}.{what}", "value": value, "std_error": error,
                     "quantile": quantile,
                     "unit": unit, "source": source}
                )  # fmt: skip
    return entries


def _covariance(found: PositionIdentification) -> dict[str, Any]:
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


def _controller(found: PositionIdentification) -> dict[str, Any]:
    """Return kind, torque limits and sampling rate of the controller."""
    limits = dict(zip(found.model.joints, found.fit.loops.limit.tolist(), strict=True))
    stated = {joint: x for joint, x in limits.items() if math.isfinite(x)} or None
    return {"kind": found.loop.kind, "effort_limit": stated, "rate": found.loop.rate}
