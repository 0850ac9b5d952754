"""result.json: the result of an identification, in a schema for other programs."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError, ModelError
from robotid.base.files import check_path, moved_file, read_json
from robotid.base.findings import listed, suggestion
from robotid.base.settings import require_kind
from robotid.base.tolerances import SLACK
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.diagnosis.verdict.scale_check import PayloadCheck, ScaleCheck, StatedMass
from robotid.dynamics.friction_projection import DriveMoments, projected_pinocchio_model
from robotid.dynamics.torque import predict_instants
from robotid.estimation.fitting.standard_errors import FrictionCurve
from robotid.estimation.variation.groups import RunSums
from robotid.estimation.variation.variation import between_covariance
from robotid.identification.parameter_table import parameter_table
from robotid.output.files.shape import check_shape, require_lengths, schema
from robotid.output.files.urdf import load_identified, terms_from_facts
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

if TYPE_CHECKING:
    from robotid.dynamics.simulation.loops import Loops
    from robotid.identification.closed_loop.position_errors import PositionEvaluation

SCHEMA_VERSION = 1
#: Parameters of a joint's controller, 0 if a result lacks them.
_OF_CONTROLLER = ("kd", "delay", "zero")
_OF_DRIVE = ("armature", "viscous", "coulomb", "offset")


@dataclass(frozen=True)
class CommandedDrive:
    """A joint whose drive has a position controller.

    The torque of the controller is tau = kp (q_ref(t - delay) - q) - kd v, within +-effort_limit.
    The torque on the bodies is tau - armature a - viscous v - coulomb sign(v) - offset. The
    encoder reads q = q_urdf - zero.
    """

    joint: str
    kp: float  # proportional gain [N m/rad or N/m]
    kd: float  # derivative gain [N m s/rad or N s/m]
    delay: float  # delay of the command, held from row to row [s]; negative: it is not held
    zero: float  # position of the URDF's joint at which the encoder reads 0 [rad or m]
    armature: float  # inertia of the rotor, reflected to the joint [kg m^2 or kg]
    viscous: float  # viscous friction [N m s/rad or N s/m]
    coulomb: float  # Coulomb friction [N m or N]
    offset: float  # constant torque [N m or N]
    effort_limit: float  # torque limit of the controller, inf if it has none [N m or N]


def commanded_drives(
    model: RobotModel, pi: Array, content: Mapping[str, Any], name: str
) -> tuple[CommandedDrive, ...]:
    """Return the drives of a result with gains, by joint; none without gains: pi (p,)."""
    stated = {entry["name"]: float(entry["value"]) for entry in content["drive_parameters"]}
    if not any(f"{joint}.kp" in stated for joint in model.joints):
        return ()
    missing = [joint for joint in model.joints if f"{joint}.kp" not in stated]
    if missing:
        raise DataError(
            f"{name} has gains of some joints, but no kp of {listed(missing)}; identify again with "
            "gains of all joints in [controller]"
        )
    for joint in model.joints:
        for term, wanted, is_right in (
            ("kp", "more than 0", stated[f"{joint}.kp"] > 0),
            ("kd", "0 or more", stated.get(f"{joint}.kd", 0.0) >= 0),
        ):
            if not is_right:
                value = stated[f"{joint}.{term}"]
                raise DataError(f"{name}: {joint}.{term} is {value:g}, expected {wanted}")
    controller = content.get("simulation", {}).get("controller", {})
    efforts = controller.get("effort_limit") or {}
    found = dict(zip(model.layout.names, pi.tolist(), strict=True))
    return tuple(
        CommandedDrive(
            joint,
            stated[f"{joint}.kp"],
            **{key: stated.get(f"{joint}.{key}", 0.0) for key in _OF_CONTROLLER},
            **{key: found.get(f"{joint}.{key}", 0.0) for key in _OF_DRIVE},
            effort_limit=stated.get(f"{joint}.limit") or efforts.get(joint, np.inf),
        )
        for joint in model.joints
    )


def loops_of(
    model: RobotModel, pi: Array, drives: Sequence[CommandedDrive], rate: float | None = None
) -> "Loops":
    """Return bodies, drives and controllers for simulation: pi (p,)."""
    from robotid.dynamics.simulation.loops import open_loops

    kp, kd, delay, zero, limit = (
        np.array([getattr(drive, key) for drive in drives])
        for key in ("kp", "kd", "delay", "zero", "effort_limit")
    )
    found = open_loops(model, pi)
    return replace(found, kp=kp, kd=kd, delay=delay, zero=zero, limit=limit, rate=rate)


def limit_of(drive: CommandedDrive, joint: Joint) -> float:
    """Return the torque limit of a drive; the URDF's where none was stated or found, else inf."""
    stated = joint.effort if joint.effort > 0 else np.inf
    return drive.effort_limit if np.isfinite(drive.effort_limit) else stated


@dataclass(frozen=True, eq=False)
class Result:
    """A written identification: result.json, with URDF and sidecar in the same folder."""

    path: Path  # the result.json
    content: Mapping[str, Any]

    def __repr__(self) -> str:
        return (
            f"<Result of {self.content['robot']}: {self.content['structure']['base']} base "
            f"parameters by {self.content['settings']['estimator']['name']}, verdict "
            f"{self.verdict['status']}>"
        )

    @property
    def has_urdf(self) -> bool:
        """Whether the identified URDF was written; an impossible result has none."""
        return "urdf" in self.content["outputs"]

    @property
    def files(self) -> tuple[Path, ...]:
        """The result.json, its URDF and sidecar, and the inputs of the fit; not the report."""
        outputs = self.content["outputs"]
        beside = [self.path.with_name(outputs[x]) for x in ("urdf", "sidecar") if x in outputs]
        inputs = [Path(entry["path"]) for entry in self.content["inputs"] if entry["path"]]
        return (self.path, *beside, *inputs)

    @cached_property
    def identified(self) -> tuple[RobotModel, Array]:
        """The robot of the identified URDF with its sidecar, and its standard parameters."""
        if not self.has_urdf:
            raise DataError(
                f"{self.path.name} has no URDF, because its parameters are wrong or impossible: "
                f"{self.verdict['reasons'][0]}"
            )
        outputs, folder = self.content["outputs"], self.path.parent
        return load_identified(folder / outputs["urdf"], folder / outputs["sidecar"])

    @property
    def robot(self) -> RobotModel:
        """The identified robot."""
        return self.identified[0]

    @property
    def parameters(self) -> Array:
        """Its standard parameters, shape (p,), SI units, in ``robot.layout.names`` order."""
        return self.identified[1]

    @cached_property
    def commanded(self) -> tuple[CommandedDrive, ...]:
        """The drives with position controllers, in the order of the joints; none without gains."""
        if "simulation" not in self.content:
            return ()
        return commanded_drives(*self.identified, self.content, self.path.name)

    @property
    def rate(self) -> float | None:
        """Sampling rate of the controller of those drives [Hz]; None for continuous time."""
        controller: dict[str, float | None]
        controller = self.content.get("simulation", {"controller": {}})["controller"]
        return controller.get("rate")

    def follow_commands(self, log: Log) -> Array:
        """Return the encoder readings simulated on a log's commands, (N, n) [rad or m]."""
        if not self.commanded:
            raise DataError(
                f"{self.path.name} has no gains of drives, which a simulation on commands "
                "requires; identify from a log with commands"
            )
        if log.q_ref is None:
            raise DataError(f"{log.name} has no commands, columns qref_ of each joint; log them")
        return self._signs * self.open_loop(log, horizons=()).q

    def open_loop(
        self, log: Log, *, horizons: Sequence[float] | None = None
    ) -> "PositionEvaluation":
        """Return a log with the positions simulated for it, in the URDF's sense of the joints.

        The inputs are its commands; for a result without gains, its feed-forward torques. The
        horizons of errors [s] are those of result.json if None.
        """
        require_kind(log, Log, "log", "a robotid.Log")
        from robotid.dynamics.simulation.loops import ClosedLoopRobot, open_loops
        from robotid.identification.closed_loop.position_errors import HORIZONS, run_open_loop

        if "simulation" not in self.content:
            raise DataError(
                f"{self.path.name} is a result from torques, expected one of the estimator "
                "'simulation'; use predict(q, v, a)"
            )
        (model, pi), drives = self.identified, self.commanded
        loops = loops_of(model, pi, drives, self.rate) if drives else open_loops(model, pi)
        times = HORIZONS if horizons is None else horizons
        turned = log.turned(self._signs)
        return run_open_loop(ClosedLoopRobot(model), loops, turned, horizons=times)

    @property
    def _signs(self) -> Array:
        """Sense of each encoder against the URDF's, shape (n,): 1 or -1."""
        signs = self.content["simulation"].get("signs", {})
        return np.array([signs.get(joint, 1.0) for joint in self.robot.joints])

    def predict(
        self, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None
    ) -> Array:
        """Return the torques that the result predicts; see ``Identification.predict``."""
        return predict_instants(*self.identified, q, v, a)

    def friction(self, joint: str) -> FrictionCurve:
        """Return friction and offset of a joint over its speed, in the range of the fitted logs."""
        require_kind(joint, str, "joint", "the name of a joint")
        curves = {
            name: about["curve"]
            for name, about in self.content.get("friction", {}).items()
            if "curve" in about
        }
        if joint not in curves:
            raise DataError(
                f"{self.path.name} has no friction curve of {joint!r}; joints with a curve: "
                f"{listed(curves)}{suggestion(joint, curves)}"
            )
        v, torque, std = (np.array(curves[joint][key]) for key in ("v", "torque", "std_error"))
        return FrictionCurve(v, torque, std, curves[joint]["load"])

    def table(self) -> Any:  # noqa: ANN401
        """Return the parameters as a table; see ``Identification.table``."""
        return parameter_table(
            self.content["standard_parameters"], self.content["drive_parameters"]
        )

    @property
    def drive_moments(self) -> dict[str, DriveMoments]:
        """Moments for the projection of friction on simpler terms, of drives with further terms."""
        tables = self.content.get("drive_moments", {})
        return {name: DriveMoments.from_dict(table) for name, table in tables.items()}

    def pinocchio_model(self) -> Any:  # noqa: ANN401
        """Return Pinocchio's model of the robot; see ``Identification.pinocchio_model``."""
        return projected_pinocchio_model(*self.identified, self.drive_moments)

    @property
    def verdict(self) -> Mapping[str, Any]:
        """The verdict: "status", "reasons" and "per_joint"."""
        verdict: Mapping[str, Any] = self.content["verdict"]
        return verdict

    @property
    def metrics(self) -> dict[str, Mapping[str, Any]]:
        """Metrics by joint: for the "fitted" rows, and for each validation log, by its file."""
        logs = {entry["log"]: entry["per_joint"] for entry in self.content["validation"]}
        return {"fitted": self.content["identification"]["per_joint"], **logs}


def load_result(path: str | Path) -> Result:
    """Load a written identification.

    Args:
        path: A result.json, or its folder. The URDF in that folder is read at its first use.

    Returns:
        The result: ``robot``, ``parameters``, ``verdict``, ``metrics``, and its whole content.

    Raises:
        DataError: If it is missing, not JSON, or of another schema.
    """
    require_kind(path, (str, Path), "path", "the path of a result.json or of its folder")
    check_path(path)
    source = Path(path)
    source = source / "result.json" if source.is_dir() else source
    return Result(source, read_result(source))


def _with_moved_inputs(result: dict[str, Any], path: Path) -> dict[str, Any]:
    payloads = result.get("scale_check", {}).get("payloads", [])
    known = [(x["path"], x["sha256"]) for x in result["inputs"]]
    known += [(x["log"], x["sha256"]) for x in payloads]
    hashes: dict[str, set[str]] = {}
    for text, sha256 in known:
        if sha256:
            hashes.setdefault(Path(text).name, set()).add(sha256)

    def present(table: Mapping[str, Any], key: str) -> dict[str, Any]:
        old = table.get(key)
        if not isinstance(old, str) or Path(old).name not in hashes:
            return dict(table)
        return {**table, key: str(moved_file(Path(old), path, hashes[Path(old).name]))}

    settings = present(result["settings"], "urdf")
    for group in ("identification", "validation", "payload_check"):
        if isinstance(entries := settings.get(group), list):
            settings[group] = [present(x, "log") if isinstance(x, dict) else x for x in entries]
    inputs = [present(entry, "path") for entry in result["inputs"]]
    return {**result, "settings": settings, "inputs": inputs}


def read_result(path: str | Path) -> dict[str, Any]:
    """Read the content of a result.json; inputs in a moved folder have their present paths."""
    name, result = Path(path).name, read_json(path, "result")
    version = result.get("schema_version") if isinstance(result, dict) else None
    if version != SCHEMA_VERSION or "verdict" not in result:
        raise DataError(
            f"{name} has schema_version {version!r}, expected {SCHEMA_VERSION} of a result "
            "written by 'robotid identify'"
        )
    check_shape(result, schema("result"), name)
    for k, entry in enumerate(result["inputs"]):
        if entry["role"] != "urdf":
            check_shape(entry, schema("recording"), f"{name}.inputs[{k}]")
    validation = [entry for entry in result["inputs"] if entry["role"] == "validation"]
    if len(validation) != len(result["validation"]):
        raise DataError(
            f"{name} has {len(validation)} validation recordings among its inputs, but errors of "
            f"{len(result['validation'])}: the file is incomplete. Identify again"
        )
    if "variation" in result:
        _check_variation(result, f"{name}.variation")
    return _with_moved_inputs(result, Path(path))


def _check_variation(result: Mapping[str, Any], at: str) -> None:
    """Refuse a variation whose lists do not fit its logs and parameters, or the result's."""
    stated = result["variation"]
    k, m = len(stated["logs"]), len(stated["parameters"])
    require_lengths(stated["correlation"], [m, m], f"{at}.correlation")
    known = [entry["name"] for entry in result["drive_parameters"]]
    for name, entry in stated["parameters"].items():
        own = f"{at}.parameters.{name[:80]}"
        if name not in known:
            raise DataError(f"{own} is not among the drive parameters of the result")
        is_rising = [(np.diff(entry[x]) > 0).all() for x in ("next_interval", "next_quantiles")]
        if not all(is_rising) or min(entry["std_error"], entry["spread"]) < 0:
            raise DataError(f"{own} has a negative standard error, or an interval without width")
    _check_definite([stated["correlation"]], f"{at}.correlation")
    if sums := stated.get("sums"):
        size = len(sums["h"][0]) if sums["h"] else 0
        for key, shape in (("h", [k, size]), ("H", [k, size * (size + 1) // 2]), ("unit", [k])):
            require_lengths(sums[key], shape, f"{at}.sums.{key}")
        _check_definite(RunSums.from_dict(sums).H, f"{at}.sums.H", least=-SLACK)


def _check_definite(matrices: ArrayLike, at: str, least: float = 0.0) -> None:
    """Refuse symmetric matrices with an eigenvalue below a multiple of the largest one."""
    of_each = np.linalg.eigvalsh(np.array(matrices, dtype=float))
    if of_each.size and (of_each[:, 0] <= least * of_each[:, -1]).any():
        raise DataError(f"{at} is not a positive definite matrix")


def stated_scale_check(result: Mapping[str, Any]) -> ScaleCheck | None:
    """Return the scale check of a result, if it has one."""
    stated = result.get("scale_check")
    if stated is None:
        return None
    facts = {x.name: stated[x.name] for x in dataclasses.fields(ScaleCheck) if x.name in stated}
    facts |= {"common": tuple(stated["common"])} if "common" in stated else {}
    facts["payloads"] = tuple(map(PayloadCheck.from_dict, stated.get("payloads", [])))
    if stated["is_stated"]:  # an earlier version did not test whether torque determines it
        mass = stated.get("stated")
        facts["stated"] = StatedMass(()) if mass is None else StatedMass.from_dict(mass)
    return ScaleCheck(**facts)


def stated_urdf_with_drives(result: Mapping[str, Any], model: RobotModel) -> Array | None:
    """Return the URDF's bodies with the drives fitted to them, if a result states them."""
    drives = [entry.get("with_urdf") for entry in result["drive_parameters"]]
    if None in drives:
        return None
    require_lengths(drives, [len(model.layout.drive_names)], "drive_parameters")
    return np.append(model.standard_parameters()[: model.layout.n_inertial], drives)


def stated_parameters(result: Mapping[str, Any], model: RobotModel) -> Array:
    """Return the standard parameters that a result states: -> (p,)."""
    stated = {
        entry["name"]: entry["value"]
        for entry in (*result["standard_parameters"], *result["drive_parameters"])
    }
    missing = [name for name in model.layout.names if name not in stated]
    if missing:
        raise ModelError(
            f"the result has no value of {listed(missing, 5)}: the URDF has changed; identify again"
        )
    return np.array([stated[name] for name in model.layout.names])


def stated_covariance(result: Mapping[str, Any], names: Sequence[str]) -> Array | None:
    """Return the covariance of parameters in torques; None if an earlier version wrote it."""
    if "covariance" not in result:
        return None
    stated = result.get("torque_covariance", result["covariance"])
    require_lengths(stated["root"], [len(stated["names"])], "covariance.root")
    rows = dict(zip(stated["names"], stated["root"], strict=True))
    root = np.zeros((len(names), max(map(len, rows.values()), default=0)))
    for row, name in zip(root, names, strict=True):
        row[: len(rows.get(name, ()))] = rows.get(name, ())
    return root @ root.T


def stated_between(result: Mapping[str, Any], model: RobotModel) -> Array | None:
    """The covariance of a robot's parameters in another log, in addition to that of the fit."""
    variation = result.get("variation")
    if variation is None or "correlation" not in variation:
        return None
    return between_covariance(variation, model.layout.names)


def stated_model(result: Mapping[str, Any], model: RobotModel) -> RobotModel:
    """Return the robot with the friction terms and parameters of a result."""
    found = model.with_terms(terms_from_facts(result.get("own_terms", {})))
    return found.with_reference(stated_parameters(result, found))
