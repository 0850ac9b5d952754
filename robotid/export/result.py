"""result.json: what an identification found, in the schema that other programs read."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid._files import check_path, file_sha256, read_json
from robotid._settings import Range, require_kind
from robotid._typing import Array
from robotid.commanded.errors import OpenLoop
from robotid.commanded.identify import Commanded
from robotid.exceptions import DataError, ModelError
from robotid.export.commanded import (
    CommandedDrive,
    commanded_drives,
    follow_commands,
    logged_motion,
)
from robotid.export.ranges import body_ranges, parameter_ranges
from robotid.export.shape import FILE, FLAG, MAYBE, NUMBER, TABLE, TEXT, check_shape
from robotid.export.urdf import load_identified, terms_from_facts
from robotid.findings import listed
from robotid.fitting.bands import REACH, FrictionCurve, fitted_moments, usual_friction
from robotid.fitting.drives import DriveChoice
from robotid.fitting.evaluation import Evaluation
from robotid.fitting.parameter_table import parameter_entries, parameter_table
from robotid.fitting.result import SOURCES
from robotid.identification.previews import Preview
from robotid.identification.result import Identification
from robotid.judgement.verdict import Doubt
from robotid.judgement.witness import Witness
from robotid.logs.data import Log, suggestion
from robotid.logs.transmission import Transmission
from robotid.regressor.base_parameters import BaseMapping, structural_mapping
from robotid.regressor.friction_projection import (
    DriveMoments,
    drive_moments,
    projected_pinocchio_model,
)
from robotid.regressor.prediction import predict_instants
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.versions import __version__, versions

__all__ = [
    "Result",
    "build_commanded",
    "build_preview",
    "build_result",
    "load_result",
    "open_loop_entry",
    "read_result",
    "recording_metrics",
    "stated_model",
    "stated_parameters",
    "stated_urdf_with_drives",
    "stated_witness",
]

SCHEMA_VERSION = 1
_STATUSES = ("good", "usable", "poor", "not evaluated")
_EXTENT = ("samples", "rate", "start", "end", "rows_used", "segments")
_MOVING = 0.05  # of a joint's largest speed, below which differences of positions are noise
_STATUS = Range("good, usable, poor or not evaluated", _STATUSES.__contains__)
_METRICS = {"per_joint": {...: {"relative_error_pct": MAYBE, "rmse": MAYBE, "unit": TEXT}}}
_PARAMETER = {"name": TEXT, "value": NUMBER, "unit": TEXT}
_RECORDING = {
    **dict.fromkeys(("start", "end", "rows_used"), NUMBER),
    "signals": TABLE,
}
#: What is read of a result.json.
_SHAPE = {
    "robotid": TEXT,
    "robot": TEXT,
    "joints": [TEXT],
    "versions?": {...: TEXT},
    "settings": {"estimator": {"name": TEXT}},
    "inputs": [{"role": TEXT, "path": TEXT, "sha256": (str, type(None))}],
    "outputs": {"urdf?": FILE, "sidecar?": FILE},
    "structure": {"base": NUMBER, "undetermined": [TEXT]},
    "witness?": {
        **{key: {...: NUMBER} for key in ("gravity", "gravity_error", "friction")},
        **{key: [NUMBER] for key in ("unexplained", "masses")},
        "scale": MAYBE,
        "factor": NUMBER,
        "is_stated": FLAG,
    },
    "consistency": {
        "is_consistent": FLAG,
        "fit?": {"prior?": {"weight": NUMBER, "plausible_weight?": NUMBER}},
    },
    "base_parameters": [{**_PARAMETER, "expression": TEXT, "std_error": MAYBE}],
    "standard_parameters": [_PARAMETER],
    "drive_parameters": [{**_PARAMETER, "with_urdf?": NUMBER}],
    "ranges?": {"robot": TEXT, "drives": {...: TABLE}},
    "simulation?": {"controller": {"kind": TEXT, "rate?": MAYBE}},
    "own_terms?": {...: [TABLE]},
    "drive_moments?": {...: {"terms": [TEXT], "products": [[NUMBER]], "torque": NUMBER}},
    "identification": _METRICS,
    "validation": [{"log": TEXT, **_METRICS}],
    "verdict": {
        "status": _STATUS,
        "reasons": [TEXT],
        "per_joint?": {...: {"status": _STATUS, "reasons": [TEXT]}},
        "alarms?": [TEXT],
        "doubts?": [{field.name: TEXT for field in dataclasses.fields(Doubt)}],
    },
}


def build_result(
    identification: Identification,
    settings: Mapping[str, Any],
    outputs: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Return the content of result.json, plain values only and all of them finite.

    Args:
        identification: What was found.
        settings: The job, in the shape of its file.
        outputs: Files written beside it, by kind.
    """
    model, size = identification.model, identification.model.layout.n_inertial
    bodies, drives = parameter_entries(identification)
    return {
        "schema_version": SCHEMA_VERSION,
        "robotid": __version__,
        "versions": versions(),
        "robot": model.name,
        "joints": list(model.joints),
        "settings": dict(settings),
        "inputs": _inputs(identification),
        "outputs": dict(outputs or {}),
        "structure": _structure(identification),
        "base_parameters": _base_parameters(identification),
        "uncertainty": {
            "method": identification.errors.method,
            "stretches": identification.errors.stretches,
            "inflation": identification.errors.inflation,
        },
        "standard_parameters": bodies,
        "drive_parameters": [
            entry | {"with_urdf": float(value)}
            for entry, value in zip(drives, identification.urdf_with_drives[size:], strict=True)
        ],
        "motors": _motors(identification, settings),
        "own_terms": model.options["own_terms"],
        "drive_moments": _plain(fitted_moments(identification)),
        "friction": {
            drive.joint: _friction(identification, drive) for drive in identification.drives
        },
        "consistency": _consistency(identification),
        **({"ranges": parameter_ranges(identification)} if identification.has_urdf else {}),
        "identification": identification.metrics().to_dict(),
        "validation": [
            recording_metrics(e, "estimate") | {"band": _band(identification, e)}
            for e in identification.validation
        ],
        "warnings": [
            {"code": f.code, "severity": f.severity, "message": f.message, "where": f.where}
            for f in identification.findings
        ],
        "wls": {
            "base_values": identification.wls.theta.tolist(),
            "base_std_errors": [_finite(error) for error in identification.wls.std_error],
            "identification": identification.metrics("wls").to_dict(),
            "validation": [recording_metrics(e, "wls") for e in identification.validation],
        },
        "witness": identification.witness.to_dict(),
        "verdict": identification.verdict.to_dict(),
    }


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
            {"role": "urdf", **_source(model.tree.path)},
            *(_commanded_input(run, "identification") for run in found.errors),
            *(_commanded_input(run, "validation") for run in found.kept),
        ],
        "outputs": dict(outputs or {}),
        "structure": {
            "standard": layout.n_inertial,
            "base_inertial": len(structural_mapping(model, inertial_only=True).K),
            "base": len(mapping.K),
            "rank": estimate.rank,
            "condition": _finite(estimate.condition),
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
        "drive_moments": _plain(_commanded_moments(found)),
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


def _plain(moments: Mapping[str, DriveMoments]) -> dict[str, Any]:
    return {name: of_drive.to_dict() for name, of_drive in moments.items()}


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
            "std_error": _finite(error),
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
        "role": role, **_source(log.path), "samples": len(log.t), "rate": 1.0 / dt,
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


def build_preview(preview: Preview) -> dict[str, Any]:
    """Return what a preview tells, plain values only and all of them finite.

    Args:
        preview: The preview.
    """
    found, noise = preview.expected, preview.noise
    bodies, drives = parameter_entries(found)
    kept = ("name", "expression", "std_error", "unit")
    base = [
        {key: entry[key] for key in kept} | {"plausible": float(spread)}
        for entry, spread in zip(_base_parameters(found), preview.plausible, strict=True)
    ]
    if preview.before is not None and preview.gain is not None:
        for entry, before, gain in zip(base, preview.before, preview.gain, strict=True):
            entry |= {"std_error_before": _finite(before), "gain": _finite(gain)}
    units = dict(zip(found.model.row_names, found.model.row_units, strict=True))
    return {
        "robot": found.model.name,
        "joints": list(found.model.joints),
        "estimator": found.estimator.name,
        "motions": [
            {"role": "motion", **_source(e.recording.log.path), **_extent(e)} for e in found.fitted
        ],
        "noise": {
            joint: {"std": float(std), "unit": units[joint], "correlation": float(time), "is": of}
            for joint, std, time, of in zip(
                found.model.joints, noise.std, noise.correlation, noise.origins, strict=True
            )
        },
        "structure": _structure(found),
        "undetermined": list(found.determination.undetermined),
        "words": preview.words,
        "base_parameters": base,
        "standard_parameters": [_without_value(entry) for entry in bodies],
        "drive_parameters": [_without_value(entry) for entry in drives],
        "torque": _expected_torque(preview),
    }


def recording_metrics(evaluation: Evaluation, name: str) -> dict[str, Any]:
    """Return the metrics of one recording as result.json has them.

    Args:
        evaluation: The recording.
        name: Which parameters predict.
    """
    recording = evaluation.recording
    return {"log": recording.log.path, "name": recording.name, **evaluation.metrics[name].to_dict()}


@dataclass(frozen=True, eq=False)
class Result:
    """What an identification wrote: a result.json, and the URDF and sidecar beside it.

    Attributes:
        path: The result.json.
        content: What it holds.
    """

    path: Path
    content: Mapping[str, Any]

    def __repr__(self) -> str:
        return (
            f"<Result of {self.content['robot']}: {self.content['structure']['base']} base "
            f"parameters by {self.content['settings']['estimator']['name']}, verdict "
            f"{self.verdict['status']}>"
        )

    @property
    def has_urdf(self) -> bool:
        """Whether the identified URDF was written: none is of a result that cannot be right."""
        return "urdf" in self.content["outputs"]

    @cached_property
    def identified(self) -> tuple[RobotModel, Array]:
        """The robot of the identified URDF with its sidecar, and its standard parameters."""
        if not self.has_urdf:
            raise DataError(
                f"{self.path.name} has no URDF, for its parameters are wrong or impossible: "
                f"{self.verdict['reasons'][0]}"
            )
        outputs, folder = self.content["outputs"], self.path.parent
        return load_identified(folder / outputs["urdf"], folder / outputs["sidecar"])

    @property
    def robot(self) -> RobotModel:
        """The robot as identified."""
        return self.identified[0]

    @property
    def parameters(self) -> Array:
        """Its standard parameters, shape (p,), SI units, in ``robot.layout.names`` order."""
        return self.identified[1]

    @cached_property
    def commanded(self) -> tuple[CommandedDrive, ...]:
        """The drives that follow position commands, joint by joint; none without gains."""
        if "simulation" not in self.content:
            return ()
        return commanded_drives(*self.identified, self.content, self.path.name)

    @property
    def rate(self) -> float | None:
        """Ticks per second of the controller of those drives [Hz]; None if it has no clock."""
        stated: float | None = self.content["simulation"]["controller"].get("rate")
        return stated

    def follow_commands(self, log: Log) -> Array:
        """Return the positions that the robot takes on the commands of a log, in open loop.

        Args:
            log: The log, of its joints in its order, with commands.

        Returns:
            Positions that encoders would read, shape (N, n) [rad or m].

        Raises:
            DataError: If the result has no gains of drives, or the log no commands.
            MissingDependencyError: If Numba is not installed.
        """
        if not self.commanded:
            raise DataError(f"{self.path.name} has no gains of drives: it cannot follow commands")
        if log.q_ref is None:
            raise DataError(f"{log.name} has no commands, columns qref_ of each joint")
        signs = self.content["simulation"].get("signs", {})
        sign = np.array([signs.get(joint, 1.0) for joint in log.joints])
        turned = log.turned(sign)
        return sign * follow_commands(*self.identified, self.commanded, turned, self.rate)

    def predict(
        self, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None
    ) -> Array:
        """Return the torques that the result predicts; see ``Identification.predict``.

        Args:
            q: Positions, shape (n,) or (N, n) [rad, m].
            v: Velocities, likewise [rad/s, m/s]; None: at rest.
            a: Accelerations, likewise [rad/s^2, m/s^2]; None: 0.

        Returns:
            Torques, likewise [N m, N].

        Raises:
            DataError: If a shape does not fit, or the result has no URDF.
        """
        return predict_instants(*self.identified, q, v, a)

    def friction(self, joint: str) -> FrictionCurve:
        """Return friction and offset of a joint against its speed, as it was in the fitted logs.

        Args:
            joint: The joint.

        Raises:
            DataError: If the result states none of it.
        """
        require_kind(joint, str, "joint", "the name of a joint")
        curves = {
            name: about["curve"]
            for name, about in self.content.get("friction", {}).items()
            if "curve" in about
        }
        if joint not in curves:
            raise DataError(
                f"{self.path.name} states no friction curve of {joint!r}; joints with one: "
                f"{listed(curves)}{suggestion(joint, curves)}"
            )
        curve = curves[joint]
        v, torque, std = (np.array(curve[key]) for key in ("v", "torque", "std_error"))
        return FrictionCurve(v, torque, std, curve["load"])

    def table(self) -> Any:  # noqa: ANN401
        """Return the parameters as a table; see ``Identification.table``."""
        return parameter_table(
            self.content["standard_parameters"], self.content["drive_parameters"]
        )

    @property
    def drive_moments(self) -> dict[str, DriveMoments]:
        """What projects friction on simpler terms, by drive that has terms of its own."""
        tables = self.content.get("drive_moments", {})
        return {name: DriveMoments.from_dict(table) for name, table in tables.items()}

    def pinocchio_model(self) -> Any:  # noqa: ANN401
        """Return Pinocchio's model of the robot; see ``Identification.pinocchio_model``.

        Raises:
            DataError: If the result has no URDF.
        """
        return projected_pinocchio_model(*self.identified, self.drive_moments)

    @property
    def verdict(self) -> Mapping[str, Any]:
        """How far to trust it: "status", "reasons" and "per_joint"."""
        verdict: Mapping[str, Any] = self.content["verdict"]
        return verdict

    @property
    def metrics(self) -> dict[str, Mapping[str, Any]]:
        """Metrics by joint: of the "fitted" rows, and of each log kept apart, by its file."""
        kept = {entry["log"]: entry["per_joint"] for entry in self.content["validation"]}
        return {"fitted": self.content["identification"]["per_joint"], **kept}


def load_result(path: str | Path) -> Result:
    """Load what an identification wrote.

    Args:
        path: A result.json, or its folder; the URDF beside it is read when it is asked for.

    Returns:
        The result: ``robot``, ``parameters``, ``verdict``, ``metrics``, and all of its content.

    Raises:
        DataError: If it is missing, no JSON, or of another schema.
    """
    require_kind(path, (str, Path), "path", "the path of a result.json or of its folder")
    check_path(path)
    source = Path(path)
    source = source / "result.json" if source.is_dir() else source
    return Result(source, read_result(source))


def read_result(path: str | Path) -> dict[str, Any]:
    """Read the content of a result.json.

    Args:
        path: The file.

    Raises:
        DataError: If it is missing, no JSON, or not of the schema of a result.
    """
    name, result = Path(path).name, read_json(path, "result")
    version = result.get("schema_version") if isinstance(result, dict) else None
    if version != SCHEMA_VERSION or "verdict" not in result:
        raise DataError(
            f"{name} has schema_version {version!r}, wanted {SCHEMA_VERSION} of a result "
            "written by 'robotid identify'"
        )
    check_shape(result, _SHAPE, name)
    recordings = [entry for entry in result["inputs"] if entry["role"] != "urdf"]
    check_shape(recordings, [_RECORDING], f"{name}.inputs")
    kept = [entry for entry in recordings if entry["role"] == "validation"]
    if len(kept) != len(result["validation"]):
        raise DataError(
            f"{name} has {len(kept)} recordings kept apart among its inputs and errors of "
            f"{len(result['validation'])}: it is not whole; identify again"
        )
    return dict(result)


def stated_witness(result: Mapping[str, Any]) -> Witness | None:
    """Return what speaks for the scale of a result, if it says so.

    Args:
        result: Content of a result.json.

    Raises:
        DataError: If figures of it are missing.
    """
    stated = result.get("witness")
    if stated is None:
        return None
    for name, size in (("unexplained", 2), ("masses", 3)):
        if len(stated[name]) != size:
            raise DataError(f"witness.{name} has {len(stated[name])} numbers, wanted {size}")
    return Witness(**{each.name: stated[each.name] for each in dataclasses.fields(Witness)})


def stated_urdf_with_drives(result: Mapping[str, Any], model: RobotModel) -> Array | None:
    """Return the URDF's bodies with the drives that fit best beside them, if a result states them.

    Args:
        result: Content of a result.json.
        model: The robot.

    Raises:
        DataError: If there are more or fewer of them than the robot has.
    """
    drives = [entry.get("with_urdf") for entry in result["drive_parameters"]]
    if None in drives:
        return None
    pi = model.standard_parameters()
    if len(drives) != len(pi) - model.layout.n_inertial:
        wanted = len(pi) - model.layout.n_inertial
        raise DataError(f"drive_parameters has {len(drives)} entries, the robot {wanted}")
    pi[model.layout.n_inertial :] = drives
    return pi


def stated_parameters(result: Mapping[str, Any], model: RobotModel) -> Array:
    """Return the standard parameters that a result states.

    Args:
        result: Content of a result.json.
        model: Its robot.

    Returns:
        Parameters, shape (p,), SI units, in ``layout.names`` order.

    Raises:
        ModelError: If a parameter of the robot is not in it.
    """
    stated = {
        entry["name"]: entry["value"]
        for entry in (*result["standard_parameters"], *result["drive_parameters"])
    }
    missing = [name for name in model.layout.names if name not in stated]
    if missing:
        raise ModelError(
            f"the result has no value of {listed(missing, 5)}: the URDF has changed since"
        )
    return np.array([stated[name] for name in model.layout.names])


def stated_model(result: Mapping[str, Any], model: RobotModel) -> RobotModel:
    """Return the robot with the friction that a result has found, loaded by its bodies.

    Args:
        result: Content of a result.json.
        model: Its robot, as its job describes it.

    Raises:
        ModelError: If a parameter of the robot is not in it.
        SettingsError: If a term of it is unknown.
    """
    found = model.with_terms(terms_from_facts(result.get("own_terms", {})))
    return found.with_reference(stated_parameters(result, found))


def _friction(found: Identification, drive: DriveChoice) -> dict[str, Any]:
    """Return what friction a joint has, and what was tried."""
    own = [term for term in found.model.layout.terms if TERMS[term].is_friction]
    told = drive.to_dict()
    return {
        "terms": [*own, *drive.families],
        **told,
        **_curve(found, drive.joint),
        "on_misfit": [name for name in found.on_misfit if name.startswith(f"{drive.joint}.")],
        "tried": [{"terms": [*own, *tried["families"]], **tried} for tried in told["tried"]],
    }


def _curve(found: Identification, joint: str) -> dict[str, Any]:
    """Return the friction of a joint against its speed; nothing of one that was never seen move."""
    row = found.model.row_names.index(joint)
    seen = [e.recording.trajectory.v[e.recording.mask[:, row], row] for e in found.fitted]
    if not np.any(np.concatenate(seen)):
        return {}
    return {"curve": usual_friction(found, joint).to_dict()}


def _structure(found: Identification) -> dict[str, Any]:
    """Return how many parameters there are, and which the data determine."""
    return {
        "standard": found.model.layout.n_inertial,
        "base_inertial": len(structural_mapping(found.model, inertial_only=True).K),
        "base": len(found.base),
        "rank": found.determination.rank,
        "condition": _finite(found.wls.condition),
        "undetermined": list(found.determination.undetermined),
        "poorly_excited": found.is_poorly_excited,
        "not_told_apart": found.determination.to_list(),
    }


def _without_value(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return a parameter's entry without what only data tell."""
    return {key: x for key, x in entry.items() if key not in ("value", "at_bound")}


def _expected_torque(preview: Preview) -> dict[str, dict[str, Any]]:
    """Return size and 95 % band of each joint's torque on the motions, root mean squares."""
    found, bands = preview.expected, preview.bands
    torque = np.vstack([e.recording.trajectory.tau for e in found.fitted])
    of_parameters = REACH * np.sqrt(np.mean(np.vstack([b.parameters for b in bands]) ** 2, axis=0))
    half = REACH * np.sqrt(np.mean(np.vstack([b.total for b in bands]) ** 2, axis=0))
    rms = np.sqrt(np.mean(torque**2, axis=0))
    model = found.model
    return {
        row: {
            "rms": float(rms[j]),
            "half_width": float(half[j]),
            "of_parameters": float(of_parameters[j]),
            "unit": model.row_units[j],
        }
        for j, row in enumerate(model.row_names)
    }


def _inputs(identification: Identification) -> list[dict[str, Any]]:
    inputs = [{"role": "urdf", **_source(identification.model.tree.path)}]
    for role, evaluations in (
        ("identification", identification.fitted),
        ("validation", identification.validation),
    ):
        for evaluation in evaluations:
            recording = evaluation.recording
            signals = {"signals": dataclasses.asdict(recording.signals)}
            source = _source(recording.log.path)
            inputs.append({"role": role, **source, **_extent(evaluation), **signals})
    return inputs


def _extent(evaluation: Evaluation) -> dict[str, Any]:
    return {key: getattr(evaluation.recording.extent, key) for key in _EXTENT}


def _source(path: str) -> dict[str, Any]:
    return {"path": str(path), "sha256": file_sha256(path) if path else None}


def _base_parameters(found: Identification) -> list[dict[str, Any]]:
    mapping, units = found.mapping, found.model.layout.units
    return [
        {
            "name": name,
            "expression": mapping.expressions[k],
            "value": float(found.base[k]),
            "std_error": _finite(found.base_error[k]),
            "interval_95": [_finite(end) for end in found.base_interval[k]],
            "unit": units[i],
        }
        for k, (name, i) in enumerate(zip(mapping.base_names, mapping.independent, strict=True))
    ]


def _motors(found: Identification, settings: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Return gear ratio and inertia at the motor, armature / ratio^2, of drives behind gears."""
    model, gears = found.model, dict[str, float]()
    for table in settings.get("transmission", ()):
        gears |= Transmission.from_dict(table).stated(model.tree.reductions).gears
    drives = [
        (model.layout.drives[d].name, value)
        for (d, term), value in zip(
            model.layout.drive_parameters, found.standard[model.layout.n_inertial :], strict=True
        )
        if term.is_inertia
    ]
    return {
        name: {"gear": gears[name], "inertia": float(value) / gears[name] ** 2}
        for name, value in drives
        if name in gears
    }


def _consistency(found: Identification) -> dict[str, Any]:
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
        "mass_matrix": dataclasses.asdict(found.mass_matrix),
        "fit": dict(found.estimate.details),
        "sources": {kind: found.sources.count(kind) for kind in SOURCES},
    }


def _band(identification: Identification, evaluation: Evaluation) -> dict[str, Any]:
    """Return the 95 % band of the predicted torque: its half width, and what lies in it."""
    recording, band = evaluation.recording, identification.band(evaluation)
    held = band.held(recording.trajectory.tau, evaluation.torques["estimate"], recording.mask)
    return {
        row: {
            "half_width": float(REACH * np.sqrt(np.mean(total**2))),
            "of_parameters": float(REACH * np.sqrt(np.mean(parameters**2))),
            "held_pct": _finite(100 * share),
        }
        for row, total, parameters, share in zip(
            identification.model.row_names, band.total.T, band.parameters.T, held, strict=True
        )
    }


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
