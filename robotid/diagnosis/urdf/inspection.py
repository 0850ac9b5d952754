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
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.urdf.inertials import (
    assumed_inertials,
    audit_links,
    impossible_inertial,
    negative_masses,
    rounded_angles,
)
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.dynamics.factors import triangle_of
from robotid.dynamics.torque import random_regressor
from robotid.robot.bodies import LinkPlace, link_places
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials
from robotid.robot.tree import MOVABLE, number_fault, numbers, parse_urdf, read_with_yourdfpy

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
    """Number and identifiability of a robot's parameters, for any motion."""

    standard: int  # standard inertial parameters, ten per body
    base_inertial: int  # base parameters of the inertias alone
    base: int  # the same with armature, viscous, Coulomb and offset of every joint
    rank: int  # of the regressor at random states; equal to ``base``
    condition: float  # condition number of the base regressor there, columns of length 1
    undetermined: tuple[str, ...]  # standard inertial parameters that never load a joint


@dataclass(frozen=True)
class Inspection:
    """The result of the audit of a URDF."""

    robot: str  # its name, "" if the file has none
    joints: tuple[str, ...]  # names of its movable joints
    structure: Structure | None  # None if no model can be built
    base_groups: tuple[str, ...]  # inertial base parameters as sums of standard parameters
    findings: tuple[Finding, ...]  # ``where`` is "link NAME", "joint NAME" or "file NAME"

    def to_dict(self) -> dict[str, Any]:
        """Return the inspection as plain values, as ``robotid inspect --json`` prints it."""
        structure = self.structure
        return {
            "robot": self.robot,
            "joints": list(self.joints),
            "structure": structure
            and vars(structure) | {"undetermined": [*structure.undetermined]},
            "base_groups": list(self.base_groups),
            "findings": [_plain(one) for one in self.findings],
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
        return Inspection("", (), None, (), (finding("unusable", subject=where, text=str(error)),))
    findings, name, model = [*_numbers(robot), *negative_masses(robot)], robot.get("name", ""), None
    try:
        model = RobotModel.from_urdf(path, free_flyer=free_flyer)
    except ModelError as error:
        fault = str(error).partition(": ")[2]  # behind the name of the file
        if not any(fault in one.message for one in findings):
            findings.append(finding("unusable", subject=where, text=str(error)))
    if name:
        is_named = any(one.code == "not_a_number" for one in findings)
        of_joints = _joint_findings(Path(path))
        findings += [x for x in of_joints if not (is_named and x.code == "yourdfpy_refuses")]
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
    findings += rounded_angles(model, full)
    structure = Structure(
        model.layout.n_inertial, len(inertial.K), len(full.K), len(full.K),
        _condition(model, full), inertial.unidentifiable,
    )  # fmt: skip
    return Inspection(model.name, model.joints, structure, inertial.expressions, tuple(findings))


def _condition(model: RobotModel, mapping: BaseMapping) -> float:
    columns = len(mapping.names)
    samples = 2 * columns // model.n_rows + 20
    W = random_regressor(model, samples, np.random.default_rng(0))[:, mapping.independent]
    R = triangle_of(W)
    sizes = np.linalg.svd(R / np.linalg.norm(R, axis=0), compute_uv=False)
    return float(sizes[0] / sizes[-1])


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
                    yield finding(
                        "not_a_number", subject=f"{kind} {name}", kind=kind, name=name,
                        fault=f"{part}{fault}",
                    )  # fmt: skip


def _joint_findings(path: Path) -> Iterator[Finding]:
    """Yield faults of limits, damping, friction and mimic, read with yourdfpy."""
    try:
        joints = read_with_yourdfpy(path).joints
    except ModelError as error:
        yield finding("yourdfpy_refuses", subject=f"file {path.name}", text=str(error))
        return
    names = {joint.name for joint in joints if joint.type in MOVABLE}
    for joint in joints:
        subject = f"joint {joint.name}"
        yield from _limit_findings(joint)
        for key in ("damping", "friction") if joint.dynamics is not None else ():
            text = getattr(joint.dynamics, key) or ""
            if (value := numbers(text, 1, math.inf)) and value[0] < 0:
                yield finding(
                    f"negative_{key}", subject=subject, name=joint.name, text=str(text),
                    **{key: value[0]},
                )  # fmt: skip
        if joint.mimic is not None:
            leader = joint.mimic.joint
            what = "unknown" if leader not in names or leader == joint.name else "independent"
            yield finding(
                "mimic_joint", subject=subject, name=joint.name, leader=leader, what=what,
                cure=what, severity="warning" if what == "unknown" else "note",
                multiplier=joint.mimic.multiplier or 0.0, offset=joint.mimic.offset or 0.0,
            )  # fmt: skip


def _limit_findings(joint: Any) -> Iterator[Finding]:  # noqa: ANN401
    """Yield a finding if a joint has no range, or limits of speed or torque that are 0."""
    lower, upper = (getattr(joint.limit, key, None) for key in ("lower", "upper"))
    has_range = joint.type not in ("revolute", "prismatic") or (lower or 0.0) < (upper or 0.0)
    ends = ("missing" if end is None else str(end) for end in (lower, upper))
    flags = {"velocity": "--max-velocity", "effort": "--max-torque"}
    zero = [key for key in flags if getattr(joint.limit, key, None) == 0.0]
    zero = zero if joint.type in MOVABLE else []
    if zero or not has_range:
        yield finding(
            "no_limits", subject=f"joint {joint.name}", joint=joint.name,
            range="none" if has_range else joint.type, lower=next(ends), upper=next(ends),
            zero="none" if not zero else "alone" if has_range else "also",
            limits=" and ".join(f"{key} 0" for key in zero),
            flags=" ".join(f"{flags[key]} {joint.name}=X" for key in zero),
        )  # fmt: skip


def _link_findings(model: RobotModel) -> Iterator[Finding]:
    """Yield faults of the inertials, and the bodies of several links."""
    inertials = model.tree.inertials
    by_body: dict[int, list[LinkPlace]] = {}
    for place in link_places(model):
        by_body.setdefault(place.body, []).append(place)
    for body, members in by_body.items():
        having = [place.link for place in members if place.link in inertials]
        for link in (place.link for place in members):
            if link in inertials:
                matters = body >= 0 and not any(inertials[name].mass > 0 for name in having)
                yield from impossible_inertial(link, inertials[link], matters)
            elif body >= 0 and (having or model.layout.bodies[body] not in model.assumed):
                what = "frame" if having else "body"
                yield finding(
                    "missing_inertial", subject=f"link {link}", what=what, cure=what, link=link,
                    severity="note" if having else "warning", others=listed(having),
                )  # fmt: skip
        lumped = [p.link for p in members if p.role == "fixed" and p.link in inertials]
        if lumped and body >= 0:
            link = model.layout.bodies[body]
            others = listed(lumped)
            yield finding("fixed_lumped", subject=f"link {link}", link=link, others=others)


def _plain(one: Finding) -> Mapping[str, Any]:
    kind, name = one.where.split(" ", 1)
    return {
        "code": one.code, "severity": one.severity, **({} if kind == "file" else {kind: name}),
        "message": one.message, "evidence": {key: float(x) for key, x in one.evidence.items()},
    }  # fmt: skip
