"""The sidecar of a written URDF: drives, couplings and how the model was built, in JSON."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, ModelError
from robotid.robot.bodies import LinkPlace
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

__all__ = ["SCHEMA_VERSION", "digest", "load_identified", "read_sidecar", "sidecar_facts"]

SCHEMA_VERSION = 1
_ENTRIES = {
    "urdf_sha256": str, "joints": list, "locked": dict, "gravity": list, "free_flyer": bool,
    "mimic": str, "terms": list, "drives": dict, "couplings": list, "lumped": dict,
}  # fmt: skip


def sidecar_facts(model: RobotModel, pi: Array, places: Sequence[LinkPlace]) -> dict[str, Any]:
    """Return what a URDF has no place for: how the model is built from it, and the drives.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units.
        places: Where each link of the URDF sits in the model.

    Returns:
        Plain values with joints, locked positions, gravity, drives, couplings, lumped links and
        units.
    """
    layout, first = model.layout, model.layout.n_inertial
    values = dict(zip(layout.names, map(float, pi), strict=True))
    units = dict(zip(layout.names[first:], layout.units[first:], strict=True))
    followers = {j.name for j in model.tree.movable if j.mimic and model.mimic == "coupled"}
    return {
        "joints": list(model.joints),
        "locked": {j: float(x) for j, x in model.locked.items() if j not in followers},
        "gravity": [float(g) for g in model.pin_model.gravity.linear],
        "free_flyer": model.free_flyer,
        "mimic": model.mimic,
        "terms": list(layout.terms),
        "drives": {j: {t: values[f"{j}.{t}"] for t in layout.terms} for j in layout.joints},
        "couplings": [
            {"name": c.name, "ratios": {joint: float(ratio) for joint, ratio in c.ratios}}
            | {term: values[f"{c.name}.{term}"] for term in layout.coupling_terms}
            for c in layout.couplings
        ],
        "lumped": _lumped(model, places),
        "units": {"gravity": "m/s^2", "locked": "rad, or m if it slides", "ratios": "-", **units},
    }


def read_sidecar(path: str | Path) -> dict[str, Any]:
    """Read the sidecar of a written URDF.

    Args:
        path: The ``.drive.json`` file.

    Returns:
        Its content, schema_version 1.

    Raises:
        DataError: If it is missing, no JSON, of another schema, or lacks an entry.
    """
    source = Path(path)
    if not source.is_file():
        raise DataError(f"there is no sidecar {str(source)!r}; it is written beside the URDF")
    try:
        content = json.loads(source.read_text(encoding="utf-8"))
    except ValueError as error:
        raise DataError(f"{source.name} is not JSON: {error}") from error
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != SCHEMA_VERSION:
        raise DataError(
            f"{source.name} has schema_version {version!r}, wanted {SCHEMA_VERSION}: the sidecar "
            "that write_urdf puts beside a URDF"
        )
    wrong = [key for key, kind in _ENTRIES.items() if not isinstance(content.get(key), kind)]
    if wrong:
        raise DataError(f"{source.name} lacks the entries {wrong}; write it again with write_urdf")
    return dict(content)


def load_identified(urdf: str | Path, sidecar: str | Path) -> tuple[RobotModel, Array]:
    """Return the model and the parameters of a URDF written with its sidecar.

    Args:
        urdf: The written URDF.
        sidecar: Its ``.drive.json``.

    Returns:
        The model, and its standard parameters with the drive terms, shape (p,).

    Raises:
        DataError: If the sidecar cannot be used.
        ModelError: If the URDF is missing, is not the one the sidecar was written with, or does
            not hold the joints that the sidecar names.
    """
    facts, path = read_sidecar(sidecar), Path(urdf)
    if not path.is_file():
        raise ModelError(f"there is no URDF file {str(path)!r}")
    found = digest(path.read_bytes())
    if found != facts["urdf_sha256"]:
        raise ModelError(
            f"{path.name} has changed since {Path(sidecar).name} was written: its sha256 is "
            f"{found[:12]}..., wanted {facts['urdf_sha256'][:12]}...; restore the file, or write "
            "both again"
        )
    try:
        couplings = [Coupling(c["name"], tuple(c["ratios"].items())) for c in facts["couplings"]]
        drives = {**facts["drives"], **{c["name"]: c for c in facts["couplings"]}}
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{Path(sidecar).name}: a coupling lacks {error}") from error
    model = RobotModel.from_urdf(
        path,
        couplings=couplings,
        **{
            key: facts[key]
            for key in ("joints", "locked", "free_flyer", "mimic", "gravity", "terms")
        },
    )
    values = [_drive_value(drives, name, Path(sidecar).name) for name in model.layout.drive_names]
    return model, np.array([*model.standard_parameters()[: model.layout.n_inertial], *values])


def digest(content: bytes) -> str:
    """Return the SHA-256 of some bytes, in hexadecimal.

    Args:
        content: The bytes.

    Returns:
        64 hexadecimal digits.
    """
    return hashlib.sha256(content).hexdigest()


def _lumped(model: RobotModel, places: Sequence[LinkPlace]) -> dict[str, list[str]]:
    lumped: dict[str, list[str]] = {}
    for place in places:
        if place.is_lumped and place.link in model.tree.inertials:
            lumped.setdefault(model.layout.bodies[place.body], []).append(place.link)
    return lumped


def _drive_value(drives: Mapping[str, Any], name: str, where: str) -> float:
    owner, term = name.rsplit(".", 1)
    entry = drives.get(owner)
    value = entry.get(term) if isinstance(entry, dict) else None
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise DataError(f"{where}: {name} is {value!r}, wanted a finite number")
    return float(value)
