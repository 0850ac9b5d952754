"""Write an identified model as a URDF with a sidecar, and read the pair.

Only the inertials of the original file change; all other bytes are unchanged. The sidecar
``<name>.drive.json`` has the parameters that a URDF cannot state, as armature and friction of
coupled drives.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, ModelError
from robotid.base.files import check_folder, folder_beside, read_json
from robotid.base.findings import listed
from robotid.base.settings import require_kind
from robotid.base.tolerances import ROUNDING, TINY
from robotid.base.typing import Array
from robotid.base.versions import __version__
from robotid.dynamics.friction_projection import Projection
from robotid.dynamics.torque import random_regressor
from robotid.output.files import xml_splice
from robotid.output.files.shape import check_shape, schema
from robotid.output.files.xml_splice import Document, Edit
from robotid.robot.bodies import (
    LinkPlace,
    central_inertial,
    held_parameters,
    inertial_parameters,
    link_places,
)
from robotid.robot.constraints import Loop
from robotid.robot.drives import TERMS, term_from_dict
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia
from robotid.robot.tree import MOMENTS, Inertial

#: The drive terms of ``<dynamics>``.
DYNAMICS_TERMS = tuple(name for name, term in TERMS.items() if term.dynamics)
_SCHEMA_VERSION = 1
_STATES = 64  # random states at which the written file must give the same torque


def write_urdf(
    model: RobotModel, pi: Array, target: str | Path, *, dynamics: Projection | bool = False
) -> Path:
    """Write standard parameters into a copy of the model's URDF, and a sidecar beside it.

    The moving link of a body gets the inertial of the body. The inertials of links fixed to it are
    removed, because the body includes them. Links beyond locked joints are unchanged. Angles that
    the model has in exact form (``snap_angles``) are written in this form. Both files are read
    again, and must give the torque of pi, before they replace existing files.

    pi (p,); ``dynamics``: whether viscous and Coulomb friction are also written to ``<dynamics>``,
    those of pi or those of a projection, which the sidecar then states. Returns the path of the
    sidecar, ``<target stem>.drive.json``.
    """
    source, goal = Path(model.tree.path), Path(target)
    written = link_parameters(model, pi)
    _check_target(source, goal)
    original, places = source.read_bytes(), link_places(model)
    document = xml_splice.parse(original, source.name)
    stated = model.tree.inertials
    changed = {link: x for link, x in written.items() if not _is_as_stated(x, stated.get(link))}
    edits = _inertial_edits(document, changed, places) + _angle_edits(document, model)
    if isinstance(dynamics, Projection):
        edits += _dynamics_edits(document, dynamics.model, dynamics.pi)
    elif dynamics:
        edits += _dynamics_edits(document, model, pi)
    content = xml_splice.apply(document, edits)
    sidecar = goal.with_name(f"{goal.stem}.drive.json")
    of_source = source.with_name(f"{source.stem}.drive.json")
    check_folder(goal.parent, [goal.name, sidecar.name], [source, of_source])
    facts = {
        "schema_version": _SCHEMA_VERSION,
        "robotid": __version__,
        "robot": model.name,
        "urdf": goal.name,
        "urdf_sha256": _digest(content),
        "source": {"urdf": source.name, "sha256": _digest(original)},
        **_facts(model, pi, places),
    }
    if isinstance(dynamics, Projection) and dynamics.drives:
        facts["projected_dynamics"] = {drive.name: drive.to_dict() for drive in dynamics.drives}
    with folder_beside(goal.parent) as partial:
        (partial / goal.name).write_bytes(content)
        text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
        (partial / sidecar.name).write_text(text + "\n", encoding="utf-8")
        _check_torque(model, pi, partial / goal.name, partial / sidecar.name)
    return sidecar


def read_sidecar(path: str | Path) -> dict[str, Any]:
    """Return the content of the sidecar of a written URDF, schema_version 1."""
    source, content = Path(path), read_json(path, "drive parameters file")
    version = content.get("schema_version") if isinstance(content, dict) else None
    if version != _SCHEMA_VERSION:
        raise DataError(
            f"{source.name} has schema_version {version!r}, expected {_SCHEMA_VERSION} of a drive "
            "parameters file written by robotid"
        )
    check_shape(content, schema("sidecar"), source.name)
    return dict(content)


def load_identified(urdf: str | Path, sidecar: str | Path) -> tuple[RobotModel, Array]:
    """Return the model and the standard parameters, shape (p,), of a URDF with its sidecar."""
    facts, path = read_sidecar(sidecar), Path(urdf)
    if not path.is_file():
        raise ModelError(f"there is no URDF file {str(path)!r}")
    found = _digest(path.read_bytes())
    if found != facts["urdf_sha256"]:
        raise ModelError(
            f"{path.name} has changed since {Path(sidecar).name} was written: its SHA-256 starts "
            f"with {found[:12]}, expected {facts['urdf_sha256'][:12]}; restore the file, or write "
            "both again"
        )
    couplings = [
        Coupling(c["name"], tuple(c["ratios"].items()), c.get("replaces", False))
        for c in facts["couplings"]
    ]
    drives = {**facts["drives"], **{c["name"]: c for c in facts["couplings"]}}
    model = RobotModel.from_urdf(
        path,
        couplings=couplings,
        own_terms=terms_from_facts(facts.get("own_terms", {})),
        dynamics=facts.get("dynamics", "full"),
        passive=facts.get("passive", ()),
        constraints=[Loop.from_dict(table) for table in facts.get("loops", ())],
        **{
            key: facts[key]
            for key in ("joints", "locked", "free_flyer", "mimic", "gravity", "terms")
        },
    )
    values = [_drive_value(drives, name, Path(sidecar).name) for name in model.layout.drive_names]
    pi = np.array([*model.standard_parameters()[: model.layout.n_inertial], *values])
    return (model.with_reference(pi) if model.layout.remembering else model), pi


def terms_from_facts(tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the further terms of single drives, by name, from their plain values."""
    return {name: [term_from_dict(term) for term in terms] for name, terms in tables.items()}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _facts(model: RobotModel, pi: Array, places: Sequence[LinkPlace]) -> dict[str, Any]:
    layout, first = model.layout, model.layout.n_inertial
    units = dict(zip(layout.names[first:], layout.units[first:], strict=True))
    values: dict[str, dict[str, float]] = {drive.name: {} for drive in layout.drives}
    for (d, term), value in zip(layout.drive_parameters, pi[first:], strict=True):
        values[layout.drives[d].name][term.name] = float(value)
    own = [drive.name for drive in layout.drives if drive not in layout.couplings]
    return {
        **model.options,
        **({"loops": [loop.to_dict() for loop in model.loops]} if model.loops else {}),
        "drives": {name: values[name] for name in own},
        "couplings": [
            {"name": c.name, "ratios": {joint: float(ratio) for joint, ratio in c.ratios}}
            | ({"replaces": True} if c.replaces else {})
            | values[c.name]
            for c in layout.couplings
        ],
        "lumped": _lumped(model, places),
        "units": {"gravity": "m/s^2", "locked": "rad, or m if prismatic", "ratios": "-", **units},
    }


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
        raise DataError(f"{where}: {name} is {value!r}, expected a finite number")
    return float(value)


def _check_parameters(model: RobotModel, pi: Array) -> None:
    require_kind(model, RobotModel, "model", "a robotid.RobotModel")
    wanted = (len(model.layout.names),)
    require_kind(pi, np.ndarray, "pi", f"an array of shape {wanted}")
    if pi.shape != wanted:
        raise DataError(f"pi has shape {pi.shape}, expected {wanted}")
    for name, value in zip(model.layout.names, pi, strict=True):
        if not math.isfinite(value):
            raise DataError(f"{name} is {value}, expected a finite number")


def _check_target(source: Path, target: Path) -> None:
    if not source.is_file():
        raise ModelError(f"the model's URDF {str(source)!r} no longer exists; restore it")
    if not target.parent.is_dir():
        raise ModelError(f"the folder {str(target.parent)!r} does not exist; create it")
    if target.is_dir():
        raise ModelError(f"the target {str(target)!r} is a folder, expected a file")
    if target.exists() and target.samefile(source):
        raise ModelError(f"the target {str(target)!r} is the original URDF; choose another name")


def link_parameters(model: RobotModel, pi: Array) -> dict[str, Array]:
    """Return the ten parameters of each moving link in its frame, without locked links: pi (p,)."""
    _check_parameters(model, pi)
    layout = model.layout
    advice = "identify with the estimator 'consistent', whose bodies and drives are possible"
    held = held_parameters(model)
    bodies, urdf = pi[: layout.n_inertial], model.standard_parameters()[: layout.n_inertial]
    moving = bodies - held
    least = [np.linalg.eigvalsh(pseudo_inertia(x))[:, 0] for x in (moving, bodies, urdf - held)]
    for k in np.flatnonzero(~(least[0] > 0))[:1]:
        others = f", without links beyond {listed(model.locked)}," if model.locked else ""
        todo = advice
        if not least[2][k] > 0:
            todo = "the URDF's own is impossible, too: correct it (robotid inspect)"
        elif least[1][k] > 0:  # what is taken off makes it impossible
            todo = (
                f"links beyond locked joints keep the URDF's inertials, {held[10 * k]:.3g} kg "
                f"of {bodies[10 * k]:.3g} kg; correct these, or identify the locked joints, too"
            )
        raise ModelError(
            f"link {layout.bodies[k]!r}{others} would be physically impossible: the smallest "
            f"eigenvalue of its pseudo-inertia is {least[0][k]:.3g}, expected > 0; {todo}"
        )
    for i in np.flatnonzero(layout.is_nonnegative() & (pi < 0)):
        raise ModelError(
            f"{layout.names[i]} is {pi[i]:.3g} {layout.units[i]}, expected 0 or more; {advice}"
        )
    return dict(zip(layout.bodies, moving.reshape(-1, 10), strict=True))


def _inertial_edits(
    document: Document, written: Mapping[str, Array], places: Sequence[LinkPlace]
) -> list[Edit]:
    removed = {place.link for place in places if place.is_lumped}
    edits = []
    for link in document.root.find_all("link"):
        name, inertials = link.attributes.get("name", ""), link.find_all("inertial")
        if name in removed:
            edits += [xml_splice.remove(document, inertial) for inertial in inertials]
        elif name in written and inertials:
            edits.append(xml_splice.replace(document, inertials[0], _inertial(written[name])))
        elif name in written:
            edits.append(xml_splice.insert(document, link, _inertial(written[name])))
    return edits


def _angle_edits(document: Document, model: RobotModel) -> list[Edit]:
    """Return the edits of joint angles that the model has in exact form."""
    used = {j.get("name"): j.find("origin") for j in model.tree.robot.findall("joint")}
    edits: list[Edit] = []
    for joint in document.root.find_all("joint"):
        origin = used.get(joint.attributes.get("name", ""))
        rpy = "" if origin is None else origin.get("rpy", "")
        for element in joint.find_all("origin")[:1]:
            if element.attributes.get("rpy", "") != rpy:
                edits += xml_splice.set_attributes(document, element, {"rpy": rpy})
    return edits


def _is_as_stated(parameters: Array, stated: Inertial | None) -> bool:
    if stated is None:
        return False
    before = inertial_parameters(stated)
    return bool(np.allclose(parameters, before, rtol=ROUNDING, atol=ROUNDING * before[0]))


def _inertial(parameters: Array) -> list[str]:
    body = central_inertial(parameters)
    size = np.sqrt(np.trace(pseudo_inertia(parameters)[0][:3, :3]) / body.mass)  # [m]
    com = np.where(np.abs(body.com) > ROUNDING * size, body.com, 0.0)
    least = ROUNDING * body.mass * size**2
    inertia = np.where(np.abs(body.inertia) > least, body.inertia, 0.0)
    moments = _attributes(zip(MOMENTS, inertia.tolist(), strict=True))
    return [
        "<inertial>",
        f'<origin xyz="{numbers_text(com)}" rpy="0 0 0"/>',
        f'<mass value="{numbers_text([body.mass])}"/>',
        f"<inertia {moments}/>",
        "</inertial>",
    ]


def numbers_text(values: Iterable[float]) -> str:
    """Return numbers as the value of an XML attribute, exact to the last bit."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # no "-0.0"


def _dynamics_edits(document: Document, model: RobotModel, pi: Array) -> list[Edit]:
    attributes = {name: term.dynamics for name, term in TERMS.items() if term.dynamics}
    values = dict(zip(model.layout.names, pi, strict=True))
    shared = {coupling.name for coupling in model.layout.couplings}  # they load other joints, too
    edits: list[Edit] = []
    for joint in document.root.find_all("joint"):
        name, found = joint.attributes.get("name", ""), joint.find_all("dynamics")
        if name not in model.joints or name in shared:
            continue
        names = {f"{name}.{term}": attribute for term, attribute in attributes.items()}
        new = {names[key]: values[key] for key in names if key in values}
        if new and found:
            texts = {key: numbers_text([value]) for key, value in new.items()}
            edits += xml_splice.set_attributes(document, found[0], texts)
        elif new:
            line = f"<dynamics {_attributes(new.items())}/>"
            edits.append(xml_splice.insert(document, joint, [line]))
    return edits


def _attributes(values: Iterable[tuple[str, float]]) -> str:
    return " ".join(f'{key}="{numbers_text([value])}"' for key, value in values)


def _check_torque(model: RobotModel, pi: Array, urdf: Path, sidecar: Path) -> None:
    """Raise if the files do not give the torque of pi in every row."""
    loaded, read_back = load_identified(urdf, sidecar)
    if loaded.layout != model.layout:
        raise ModelError(
            f"{urdf.name} is not written: in the test reading, it has other bodies or joints"
        )
    wanted, found = (
        (random_regressor(robot, _STATES, np.random.default_rng(0)) @ x).reshape(_STATES, -1)
        for robot, x in (
            (replace(model, constraints=()), pi),
            (replace(loaded, constraints=()), read_back),
        )
    )
    difference = np.linalg.norm(found - wanted, axis=0)  # (n_rows,)
    off = np.flatnonzero(difference > TINY * np.linalg.norm(wanted, axis=0))
    if off.size:
        rows = listed(model.row_names[i] for i in off)
        words = f"{urdf.name} is not written: read back, it has another torque at {rows}"
        raise ModelError(f"{words}. If {model.tree.path} has changed, read the model again")
