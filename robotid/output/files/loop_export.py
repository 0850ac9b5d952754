"""Entries of result.json that only an identification by simulation has."""

import dataclasses
import math
from typing import Any

import numpy as np

from robotid.base.files import finite, source_entry
from robotid.identification.closed_loop.loop_result import LoopIdentification
from robotid.identification.closed_loop.position_errors import (
    OpenLoop,
    position_metrics,
    position_units,
)
from robotid.output.files.samples import covariance_entry
from robotid.robot.model import RobotModel

_LOOP_TERMS = ("kp", "kd", "delay", "limit", "zero")


def loop_entries(found: LoopIdentification) -> dict[str, Any]:
    """Return the entries of result.json that only an identification by simulation has."""
    model, estimate = found.model, found.estimate
    runs = {"identification": found.fitted, "validation": found.validation}
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
        "loop_parameters": _loop_parameters(found),
        "covariance": _covariance(found),
        **({} if found.variation is None else {"variation": found.variation.to_dict()}),
        "validation": [
            {"log": run.log.path, "name": run.name, **position_metrics(model, (run,)).to_dict()}
            for run in found.validation
        ],
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
            **{role: [open_loop_entry(model, run) for run in own] for role, own in runs.items()},
        },
    }


def loop_inputs(found: LoopIdentification) -> list[dict[str, Any]]:
    """Return the logs that were read, for result.json."""
    every = {"identification": found.fitted, "validation": found.validation}
    return [
        {
            "role": role, **source_entry(log.path), "samples": len(log.t),
            "rate": 1.0 / float(np.median(np.diff(log.t))), "start": float(log.t[0]),
            "end": float(log.t[-1]), "rows_used": len(log.t), "segments": 1, "signals": {},
        }
        for role, runs in every.items() for log in (run.log for run in runs)
    ]  # fmt: skip


def _loop_parameters(found: LoopIdentification) -> list[dict[str, Any]]:
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


def _covariance(found: LoopIdentification) -> dict[str, Any]:
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


def _controller(found: LoopIdentification) -> dict[str, Any]:
    """Return kind, torque limits and sampling rate of the controller."""
    limits = dict(zip(found.model.joints, found.fit.loops.limit.tolist(), strict=True))
    stated = {joint: x for joint, x in limits.items() if math.isfinite(x)} or None
    return {"kind": found.loop.kind, "effort_limit": stated, "rate": found.loop.rate}


def open_loop_entry(model: RobotModel, run: OpenLoop) -> dict[str, Any]:
    """Return the simulated position errors on one log, by joint and by horizon.

    If the logged torque drives the robot, the errors of two baselines are included: constant speed,
    and the fit of torques alone.
    """
    units = position_units(model)
    return {
        "log": run.log.path,
        "start": float(run.log.t[0]),
        "end": float(run.log.t[-1]),
        "per_joint": {
            joint: {
                "rmse": float(run.rmse[j]),
                "unit": units[j],
                **{
                    f"{key}_rmse": None if x is None else float(x[j])
                    for key, x in run.baselines.items()
                },
            }
            for j, joint in enumerate(model.joints)
        },
        "horizons": {
            f"{h:g}": dict(zip(model.joints, map(float, errors), strict=True))
            for h, errors in run.horizons.items()
        },
    }
