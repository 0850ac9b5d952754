"""What result.json holds of an identification from commands."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robotid.commanded.errors import OpenLoop
from robotid.commanded.identify import Commanded
from robotid.export.commanded import (
    logged_motion,
)
from robotid.export.entries import SCHEMA_VERSION, finite, plain_moments, source_entry
from robotid.export.ranges import body_ranges
from robotid.regressor.base_parameters import BaseMapping, structural_mapping
from robotid.regressor.friction_projection import (
    DriveMoments,
    drive_moments,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.versions import __version__, versions

__all__ = ["build_commanded", "open_loop_entry"]

_MOVING = 0.05  # of a joint's largest speed, below which differences of positions are noise


def build_commanded(
    found: Commanded, settings: Mapping[str, Any], outputs: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Return the content of result.json of what was found from commands and positions.

    Args:
        found: What was found.
        settings: The job, in the shape of its file.
        outputs: Files written beside it, by kind.
    """
    model, layout, estimate = found.model, found.model.layout, found.fitted.estimate
    mapping, standard = structural_mapping(model), _commanded_standard(found)
    return {
        "schema_version": SCHEMA_VERSION,
        "robotid": __version__,
        "versions": versions(),
        "robot": model.name,
        "joints": list(model.joints),
        "settings": dict(settings),
        "inputs": [
            {"role": "urdf", **source_entry(model.tree.path)},
            *(_commanded_input(run, "identification") for run in found.errors),
            *(_commanded_input(run, "validation") for run in found.kept),
        ],
        "outputs": dict(outputs or {}),
        "structure": {
            "standard": layout.n_inertial,
            "base_inertial": len(structural_mapping(model, inertial_only=True).K),
            "base": len(mapping.K),
            "rank": estimate.rank,
            "condition": finite(estimate.condition),
            "undetermined": list(found.undetermined),
            "not_told_apart": [{"names": list(names)} for names in found.told_together],
        },
        "base_parameters": _commanded_base(found, mapping),
        "uncertainty": {
            "method": "scatter of the scores of stretches of the whitened residual",
            "inflation": estimate.details["inflation"],
        },
        "standard_parameters": standard[: layout.n_inertial],
        "drive_parameters": [*standard[layout.n_inertial :], *_loop_parameters(found)],
        "own_terms": model.options["own_terms"],
        "drive_moments": plain_moments(_commanded_moments(found)),
        "consistency": _commanded_bodies(found),
        "ranges": _commanded_ranges(found, [entry["source"] for entry in standard], mapping),
        "identification": {"per_joint": _commanded_joints(found, found.errors)},
        "validation": [
            {"log": run.log.path, "per_joint": _commanded_joints(found, (run,))}
            for run in found.kept
        ],
        "simulation": {
            "controller": _controller(found),
            "signs": dict(zip(model.joints, found.fitted.encoders.sign.tolist(), strict=True)),
            "fit": {
                "message": estimate.message,
                "converged": estimate.converged,
                "parameters": len(estimate.theta),
                "correlation": [float(rho) for rho in estimate.details["correlation"]],
            },
            "friction_tried": [dataclasses.asdict(tried) for tried in found.fitted.tried],
            "identification": [open_loop_entry(found.model, run) for run in found.errors],
            "validation": [open_loop_entry(found.model, run) for run in found.kept],
        },
        "warnings": [
            {"code": f.code, "severity": f.severity, "message": f.message, "where": f.where}
            for f in found.findings
        ],
        "verdict": found.verdict.to_dict(),
    }


def _commanded_moments(found: Commanded) -> dict[str, DriveMoments]:
    """Return what projects friction on simpler terms, from the positions of the fitted logs."""
    model = found.model.with_reference(found.standard)
    motions = [logged_motion(run.log) for run in found.errors] if model.layout.own else []
    moving = [np.abs(m.v) > _MOVING * np.abs(m.v).max(axis=0) for m in motions]
    return drive_moments(model, zip(motions, moving, strict=True))


def _commanded_standard(found: Commanded) -> list[dict[str, Any]]:
    """Return the entries of all standard parameters, drives last."""
    layout, prior = found.model.layout, found.model.standard_parameters()
    errors = np.sqrt(np.maximum(np.diag(found.standard_covariance), 0.0))
    reach = found.standard_reach.tolist()
    return [
        {
            "name": name,
            "value": float(found.standard[i]),
            "std_error": float(errors[i]) if errors[i] > 0 else None,
            "reach": reach[i] if errors[i] > 0 else None,
            "unit": layout.units[i],
            "prior": float(prior[i]),
            "source": _source_of(found, name, errors[i]),
        }
        for i, name in enumerate(layout.names)
    ]


def _commanded_base(found: Commanded, mapping: BaseMapping) -> list[dict[str, Any]]:
    spread = np.diag(mapping.K @ found.standard_covariance @ mapping.K.T)
    base = zip(
        mapping.base_names, mapping.expressions, mapping.to_base(found.standard),
        np.sqrt(np.maximum(spread, 0.0)), mapping.independent, strict=True,
    )  # fmt: skip
    return [
        {
            "name": name,
            "expression": expression,
            "value": float(value),
            "std_error": finite(error),
            "unit": found.model.layout.units[i],
        }
        for name, expression, value, error, i in base
    ]


def _commanded_ranges(
    found: Commanded, sources: Sequence[str], mapping: BaseMapping
) -> dict[str, Any]:
    """Return the ranges of the links; those of drives and loops follow from their parameters."""
    covariance, size = found.standard_covariance, found.model.layout.n_inertial
    spread = np.diag(mapping.K @ covariance @ mapping.K.T)
    kept = zip(mapping.base_names, mapping.independent, spread, strict=True)
    return {
        "robot": found.model.name,
        "confidence": 0.95,
        "bodies": body_ranges(
            found.model, found.standard, covariance, sources, found.standard_reach
        ),
        "drives": {},
        "undetermined": [
            *(name for name, i, variance in kept if i < size and not variance > 0),
            *found.undetermined,
        ],
    }


def _commanded_bodies(found: Commanded) -> dict[str, Any]:
    """Return whether the bodies can be, and their masses."""
    layout = found.model.layout
    bodies = pseudo_inertia(found.standard[: layout.n_inertial])
    smallest = np.linalg.eigvalsh(bodies)[:, 0]
    return {
        "is_consistent": bool((smallest >= 0).all()),
        "links": [
            {"name": body, "mass": float(J[3, 3]), "min_eigenvalue": float(low)}
            for body, J, low in zip(layout.bodies, bodies, smallest, strict=True)
        ],
        "total_mass": float(bodies[:, 3, 3].sum()),
    }


def _commanded_joints(found: Commanded, runs: Sequence[OpenLoop]) -> dict[str, Any]:
    joints = enumerate(found.model.joints)
    return {joint: _commanded_joint(found, runs, j) for j, joint in joints}


def _source_of(found: Commanded, name: str, error: float) -> str:
    """Return what determined a parameter: "data", "mixed", "prior", or "bound"."""
    if not error > 0:
        return "prior"
    if name in found.fitted.estimate.details["at_bound"]:
        return "bound"
    share = dict(zip(found.fitted.simulator.names, found.shrunk, strict=True)).get(name)
    if share is None:  # of a body, or of drives that share it
        return "mixed"
    return "data" if share < 0.3 else "mixed" if share < 0.9 else "prior"


def _commanded_input(run: OpenLoop, role: str) -> dict[str, Any]:
    log, dt = run.log, float(np.median(np.diff(run.log.t)))
    return {
        "role": role, **source_entry(log.path), "samples": len(log.t), "rate": 1.0 / dt,
        "start": float(log.t[0]), "end": float(log.t[-1]), "rows_used": len(log.t), "segments": 1,
        "signals": {},
    }  # fmt: skip


def _loop_parameters(found: Commanded) -> list[dict[str, Any]]:
    """Return gains, delay, limit and zero of each joint, those that were stated without error."""
    if found.loop.kind == "torque":
        return []
    loops, estimate = found.fitted.loops, found.fitted.estimate
    errors = {
        (unknown.what, j): (float(error), float(reach))
        for unknown, error, reach in zip(
            found.fitted.simulator.unknowns, estimate.std_error, estimate.reach, strict=True
        )
        for j in unknown.joints
    }
    entries = []
    for j, joint in enumerate(found.model.limits):
        force, way = ("N", "m") if joint.type == "prismatic" else ("N m", "rad")
        units = {
            "kp": f"{force}/{way}", "kd": f"{force} s/{way}", "delay": "s", "limit": force,
            "zero": way,
        }  # fmt: skip
        for what, unit in units.items():
            value = float(getattr(loops, what)[j])
            if math.isfinite(value):
                error, reach = errors.get((what, j), (None, None))
                entries.append(
                    {"name": f"{joint.name}.{what}", "value": value, "std_error": error,
                     "reach": reach,
                     "unit": unit, "source": "stated" if error is None else "data"}
                )  # fmt: skip
    return entries


def _controller(found: Commanded) -> dict[str, Any]:
    """Return what was stated of the controller beside gains and delay."""
    limits = dict(zip(found.model.joints, found.fitted.loops.limit.tolist(), strict=True))
    stated = {joint: x for joint, x in limits.items() if math.isfinite(x)} or None
    return {"kind": found.loop.kind, "effort_limit": stated, "rate": found.loop.rate}


def _unit_of(found: Commanded, j: int) -> str:
    return "m" if found.model.limits[j].type == "prismatic" else "rad"


def _commanded_joint(found: Commanded, runs: Sequence[OpenLoop], j: int) -> dict[str, Any]:
    """Return how far the open loop of a joint runs from logs: no torque was there to compare."""
    rmse = float(np.sqrt(np.mean([run.rmse[j] ** 2 for run in runs])))
    size = float(np.sqrt(np.mean([run.spread[j] ** 2 for run in runs])))
    share = 100 * rmse / size if size > 0 else None
    return {"relative_error_pct": share, "rmse": rmse, "unit": _unit_of(found, j)}


def open_loop_entry(model: RobotModel, run: OpenLoop) -> dict[str, Any]:
    """Return the errors of open loops on one log, joint by joint and by horizon.

    What goes on at its speed, and what the torques tell by themselves, stand there where the logged
    torque drives the robot.

    Args:
        model: The robot.
        run: The open loops beside the log.
    """
    others = {
        "command_rmse": run.command, "urdf_rmse": run.urdf, "second_order_rmse": run.second_order
    }  # fmt: skip
    if run.steady is not None:
        others |= {"rows_rmse": run.rows, "steady_rmse": run.steady}
    return {
        "log": run.log.path,
        "start": float(run.log.t[0]),
        "end": float(run.log.t[-1]),
        "per_joint": {
            joint.name: {
                "rmse": float(run.rmse[j]),
                "unit": "m" if joint.type == "prismatic" else "rad",
                **{key: None if x is None else float(x[j]) for key, x in others.items()},
            }
            for j, joint in enumerate(model.limits)
        },
        "horizons": {
            f"{h:g}": dict(zip(model.joints, map(float, errors), strict=True))
            for h, errors in run.horizons.items()
        },
    }
