"""Audit of a URDF without logs: its joints, its identifiable parameters and its faults."""

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import ModelError
from robotid.base.findings import Finding, listed
from robotid.base.settings import require_flag, require_kind
from robotid.diagnosis.urdf.inertials import assumed_inertials, impossible_inertial, negative_masses
from robotid.diagnosis.urdf.mesh_check import audit_links
from robotid.diagnosis.urdf.rounding import rounded_angles, weak_parameters
from robotid.dynamics.base_parameters import (
    BaseMapping,
    independent_factors,
    structural_mapping,
)
from robotid.dynamics.torque import random_regressor
from robotid.robot.bodies import LinkPlace, link_places
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials
from robotid.robot.tree import MOVABLE
from robotid.robot.urdf_text import number_fault, numbers, parse_urdf, read_with_yourdfpy

# the attributes that hold numbers, by the element they are in
_NUMBERS = {
    ("link", "inertial/mass"): ("value",),
    ("link", "inertial/origin"): ("xyz", "rpy"),
    ("link", "inertial/inertia"): ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    ("joint", "origin"): ("xyz", "rpy"),
    ("joint", "axis"): ("xyz",),
    ("joint", "limit"): ("lower", "upper", "velocity", "effort"),
    ("joint", "mimic"): ("multiplier", "offset"),
    ("joint", "dynamics"): ("damping", "friction"),
}


@dataclass(frozen=True)
class Structure:
    """Number and identifiability of a robot's parameters, for any motion.

    Attributes:
        standard: Number of standard inertial parameters, ten per body.
        base_inertial: Number of base parameters of the inertias alone.
        base: The same with armature, viscous, Coulomb and offset of every joint.
        rank: Rank of the regressor at random states; equal to ``base``.
        condition: Condition number of the base regressor there, columns of length 1.
        undetermined: Standard inertial parameters that load no joint in any motion.
    """

    standard: int
    base_inertial: int
    base: int
    rank: int
    condition: float
    undetermined: tuple[str, ...]


@dataclass(frozen=True)
class Inspection:
    """The result of the audit of a URDF.

    Attributes:
        robot: Name of the robot, "" if the file has none.
        joints: Names of its movable joints.
        structure: Its parameters; None if no model can be built.
        base_groups: The inertial base parameters as sums of standard parameters.
        findings: The findings; ``where`` is "link NAME", "joint NAME" or "file NAME".
    """

    robot: str
    joints: tuple[str, ...]
    structure: Structure | None
    base_groups: tuple[str, ...]
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as plain values, as ``robotid inspect --json`` prints it."""
        found = self.structure
        return {
            "robot": self.robot,
            "joints": list(self.joints),
            "structure": found and vars(found) | {"undetermined": list(found.undetermined)},
            "base_groups": list(self.base_groups),
            "findings": [_plain(finding) for finding in self.findings],
        }


def inspect_urdf(path: str | Path, *, free_flyer: bool = False) -> Inspection:
    """Audit a URDF file.

    Args:
        path: The URDF file. Meshes are not needed.
        free_flyer: Whether the base floats.

    Returns:
        The inspection. A file from which no model can be built gives a finding, not an exception.
    """
    require_kind(path, (str, Path), "path", "the path of a URDF")
    require_flag(free_flyer, "free_flyer")
    where = f"file {Path(path).name}"
    try:
        robot = parse_urdf(path)
    except ModelError as error:
        return Inspection("", (), None, (), (Finding("unusable", "error", where, str(error)),))
    findings, name, model = [*_numbers(robot), *negative_masses(robot)], robot.get("name", ""), None
    try:
        model = RobotModel.from_urdf(path, free_flyer=free_flyer)
    except ModelError as error:
        findings.append(Finding("unusable", "error", where, str(error)))
    if name:
        findings += _joint_findings(Path(path))
    if model is None:
        movable = [j.get("name", "") for j in robot.findall("joint") if j.get("type") in MOVABLE]
        return Inspection(name, tuple(movable), None, (), tuple(findings))
    full, inertial = structural_mapping(model), structural_mapping(model, inertial_only=True)
    assumed = with_assumed_inertials(model)
    # impossible inertials are named link by link
    findings += [x for x in assumed_inertials(assumed) if x.code != "not_positive_definite"]
    findings += _link_findings(assumed)
    named = {f"link {body}" for body in assumed.assumed}  # as one finding for all
    findings += [
        x for x in audit_links(model) if x.code != "default_inertial" or x.where not in named
    ]
    rounded = list(rounded_angles(model, full))
    findings += rounded
    if not any(finding.evidence["felt"] for finding in rounded):
        findings += weak_parameters(model, full)
    structure = Structure(
        standard=model.layout.n_inertial,
        base_inertial=len(inertial.K),
        base=len(full.K),
        rank=len(full.K),
        condition=_condition(model, full),
        undetermined=inertial.unidentifiable,
    )
    return Inspection(model.name, model.joints, structure, inertial.expressions, tuple(findings))


def _condition(model: RobotModel, mapping: BaseMapping) -> float:
    columns = len(mapping.names)
    samples = 2 * columns // model.n_rows + 20
    W = random_regressor(model, samples, np.random.default_rng(0))[:, mapping.independent]
    sizes = [
        np.linalg.svd(R / np.linalg.norm(R, axis=0), compute_uv=False)
        for _, R in independent_factors(W, model.n_rows)
    ]
    return float(max(s[0] for s in sizes) / min(s[-1] for s in sizes))


def _numbers(robot: ET.Element) -> Iterator[Finding]:
    """Yield a finding for each attribute that should hold numbers and does not."""
    for (kind, inside), keys in _NUMBERS.items():
        for owner in robot.findall(kind):
            element = owner.find(inside)
            if element is None:
                continue
            name, part = owner.get("name", ""), inside.removesuffix(element.tag).replace("/", " ")
            for key in keys:
                fault = number_fault(element, key) if key in element.attrib else None
                if fault is not None:
                    message = f"{kind} {name!r}: {part}{fault}; write the true value"
                    yield Finding("not_a_number", "error", f"{kind} {name}", message)


def _joint_findings(path: Path) -> Iterator[Finding]:
    """Yield faults of limits, damping, friction and mimic, read with yourdfpy."""
    try:
        joints = read_with_yourdfpy(path).joints
    except ModelError as error:
        message = f"{error}; limits, damping, friction and mimic of its joints were not checked"
        yield Finding("yourdfpy_refuses", "warning", f"file {path.name}", message)
        return
    names = {joint.name for joint in joints if joint.type in MOVABLE}
    for joint in joints:
        if faults := [*_no_range(joint), *_zero_limits(joint)]:
            yield Finding("no_limits", "warning", f"joint {joint.name}", ". ".join(faults))
        for key in ("damping", "friction") if joint.dynamics is not None else ():
            yield from _negative(joint, key, getattr(joint.dynamics, key))
        if joint.mimic is not None:
            yield _mimic(joint, names)


def _no_range(joint: Any) -> Iterator[str]:  # noqa: ANN401
    lower, upper = (getattr(joint.limit, key, None) for key in ("lower", "upper"))
    if joint.type in ("revolute", "prismatic") and (lower or 0.0) >= (upper or 0.0):
        yield (
            f"joint {joint.name!r} is {joint.type}, but its limits are lower {lower}, upper "
            f'{upper}, wanted lower < upper; write <limit lower="..." upper="..."/>, '
            + ('or type="continuous" if it has no limits' if joint.type == "revolute" else "in m")
        )


def _zero_limits(joint: Any) -> Iterator[str]:  # noqa: ANN401
    flags = {"velocity": "--max-velocity", "effort": "--max-torque"}
    zero = [key for key in flags if getattr(joint.limit, key, None) == 0.0]
    if joint.type in MOVABLE and zero:
        yield (
            f"joint {joint.name!r} has limits {' and '.join(f'{key} 0' for key in zero)}, wanted "
            "more than 0; they count as not stated. Write those of the drive, or state them for "
            f"robotid excite: {' '.join(f'{flags[key]} {joint.name}=X' for key in zero)}"
        )


def _negative(joint: Any, key: str, text: str | None) -> Iterator[Finding]:  # noqa: ANN401
    value = numbers(text or "", 1, math.inf)
    if not value or value[0] >= 0:
        return
    is_refused = key == "friction"
    harm = "Pinocchio rejects the file" if is_refused else "it adds energy in simulators"
    message = (
        f"joint {joint.name!r} has {key} {text}, wanted 0 or more; robotid does not use it, but "
        f"{harm}: correct the sign"
    )
    yield Finding(f"negative_{key}", "warning", f"joint {joint.name}", message, {key: value[0]})


def _mimic(joint: Any, names: set[str]) -> Finding:  # noqa: ANN401
    leader = joint.mimic.joint
    if leader not in names or leader == joint.name:
        message = (
            f"joint {joint.name!r} mimics {leader!r}, which is not another movable joint of the "
            "file; name the leading joint, or remove the <mimic>"
        )
        return Finding("mimic_joint", "warning", f"joint {joint.name}", message)
    message = (
        f"joint {joint.name!r} mimics {leader!r} (multiplier {joint.mimic.multiplier:g}, offset "
        f"{joint.mimic.offset:g}) but is treated as an independent joint; use mimic = 'coupled' if "
        f"the drive of {leader!r} moves both"
    )
    return Finding("mimic_joint", "note", f"joint {joint.name}", message)


def _link_findings(model: RobotModel) -> Iterator[Finding]:
    """Yield faults of the inertials, and the bodies of several links."""
    inertials = model.tree.inertials
    by_body: dict[int, list[LinkPlace]] = {}
    for place in link_places(model):
        by_body.setdefault(place.body, []).append(place)
    for body, members in by_body.items():
        having = [place.link for place in members if place.link in inertials]
        for place in members:
            if place.link in inertials:
                matters = body >= 0 and not any(inertials[link].mass > 0 for link in having)
                yield from impossible_inertial(place.link, inertials[place.link], matters)
            elif body >= 0 and (having or model.layout.bodies[body] not in model.assumed):
                yield _missing(place.link, having)
        lumped = [p.link for p in members if p.role == "fixed" and p.link in inertials]
        if lumped and body >= 0:
            moved = model.layout.bodies[body]
            message = (
                f"link {moved!r} is one body with {listed(lumped)}, attached by fixed joints: "
                "their sum is identified and written to this link of the URDF; no action needed"
            )
            yield Finding("fixed_lumped", "note", f"link {moved}", message)


def _missing(link: str, having: list[str]) -> Finding:
    if having:
        message = (
            f"link {link!r} moves but has no <inertial>, wanted one. The mass of its body is in "
            f"{listed(having)}; no action needed if the link is only a frame"
        )
        return Finding("missing_inertial", "note", f"link {link}", message)
    message = (
        f"link {link!r} moves but has no <inertial>, nor has any link attached to it, wanted one. "
        "Its body is massless; add estimates of mass, centre of mass and inertia"
    )
    return Finding("missing_inertial", "warning", f"link {link}", message)


def _plain(finding: Finding) -> Mapping[str, Any]:
    kind, name = finding.where.split(" ", 1)
    place = {} if kind == "file" else {kind: name}
    return {
        "code": finding.code,
        "severity": finding.severity,
        **place,
        "message": finding.message,
        "evidence": {key: float(value) for key, value in finding.evidence.items()},
    }
