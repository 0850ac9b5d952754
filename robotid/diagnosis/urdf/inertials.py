"""Audit of the inertials of a URDF: impossible, negative, assumed and rounded ones."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.diagnosis.catalogue import finding
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.robot.bodies import link_places
from robotid.robot.model import RobotModel
from robotid.robot.prior import REASONS, assumed_masses
from robotid.robot.tree import Inertial, Joint, Tree
from robotid.robot.urdf_text import exact_angle, numbers

#: Findings that take the URDF's masses as evidence.
_OF_MASSES = (
    "current_for_torque", "joint_origin", "link_mass", "payload", "torque_scale", "total_mass",
    "urdf_mismatch",
)  # fmt: skip
_SLACK = 1e-9  # relative violation of the triangle inequality that is rounding
_NOISE = 1e-10  # smaller pivots, over the largest, are rounding errors


def negative_masses(robot: ET.Element) -> Iterator[Finding]:
    """Yield the negative masses of a file, from which no model can be built."""
    for element in robot.findall("link"):
        mass = element.find("inertial/mass")
        text = "" if mass is None else mass.get("value", "")
        for value in numbers(text, 1):  # a text that is no number is another finding
            if value < 0:
                link = element.get("name", "")
                yield finding("negative_mass", subject=f"link {link}", link=link, mass=value)


def assumed_inertials(model: RobotModel) -> list[Finding]:
    """Return a finding for each reason of the inertials that are assumed."""
    pi, findings = model.standard_parameters(), []
    for code, reason in REASONS.items():
        bodies = [body for body in model.layout.bodies if model.assumed.get(body) == code]
        if bodies:
            mass = sum(float(pi[10 * model.layout.bodies.index(body)]) for body in bodies)
            findings.append(
                finding(
                    code,
                    subject=f"link {bodies[0]}",
                    severity="warning",
                    what="assumed",
                    cure="assumed",
                    reason=reason,
                    links=listed(bodies, 12),
                    bodies=len(bodies),
                    mass=mass,
                )
            )
    return findings


def explained_by_assumed(model: RobotModel, found: Finding) -> bool:
    """Return whether a finding compares the torque of a joint with inertials that are assumed."""
    if found.code not in _OF_MASSES:
        return False
    rows = [name in found.joints for name in model.row_names]
    carried = model.support[rows if any(rows) else slice(None)].any(axis=0)
    return bool((carried & model.layout.owned_by(assumed_masses(model))).any())


def impossible_inertials(model: RobotModel) -> list[Finding]:
    """Return the impossible inertials of links that are not assumed, as warnings on a fit."""
    inertials = model.tree.inertials
    effect = "; a consistent fit uses the nearest possible body instead"
    return [
        found.reworded(severity="warning", remedy=found.remedy + effect)
        for place in link_places(model)
        if place.body >= 0 and place.link in inertials
        and model.layout.bodies[place.body] not in model.assumed
        for found in impossible_inertial(place.link, inertials[place.link], matters=False)
        if found.severity == "error"
    ]  # fmt: skip


def impossible_inertial(link: str, inertial: Inertial, matters: bool) -> Iterator[Finding]:
    """Yield the findings on an inertial that is impossible for any body."""
    about = f"link {link}"
    if inertial.mass == 0:
        severity = "warning" if matters else "note"
        yield finding("zero_mass", subject=about, severity=severity, link=link)
    ixx, ixy, ixz, iyy, iyz, izz = inertial.inertia
    A, B, C = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]).tolist()
    margin = A + B - C
    faults = {
        "negative": min(A, 0.0) < -_SLACK * abs(C),
        "triangle": margin < -_SLACK * abs(C),
        "flat": margin <= _SLACK * abs(C),
    }
    what = next((key for key, holds in faults.items() if holds), "")
    if what and (inertial.mass != 0 or any(inertial.inertia)):
        yield finding(
            "not_positive_definite", subject=about, severity="note" if what == "flat" else "error",
            what=what, cure="flat" if what == "flat" else "stated", link=link,
            moments=f"{A:.4g}, {B:.4g}, {C:.4g}", smallest=A, middle=B, largest=C,
            triangle=margin, sum=A + B,
        )  # fmt: skip


def rounded_angles(model: RobotModel, mapping: BaseMapping) -> Iterator[Finding]:
    """Yield the angles of joints that a URDF rounds (3.1416 for pi)."""
    rounded = _rounded(model.tree)
    effect, figures = _effect(model, mapping) if rounded else ("none", {})
    felt = _carrying(model.tree) if effect != "none" else set()
    for is_felt in (True, False):
        joints = {name: exact for name, exact in rounded.items() if (name in felt) == is_felt}
        if not joints:
            continue
        exact = {word: angle for angles in joints.values() for word, angle in angles.items()}
        file = f"file {Path(model.tree.path).name}"
        yield finding(
            "rounded_rpy", subject=f"joint {next(iter(joints))}" if len(joints) == 1 else file,
            severity="warning" if is_felt and effect == "more" else "note",
            what="one" if len(joints) == 1 else "several", names=listed(joints),
            wanted=listed(f"{angle!r} for {word}" for word, angle in exact.items()),
            effect=effect if is_felt else "none", felt=float(is_felt),
            largest_error=max(abs(float(word) - angle) for word, angle in exact.items()), **figures,
        )  # fmt: skip


def weak_parameters(model: RobotModel, mapping: BaseMapping) -> Iterator[Finding]:
    """Yield a warning if parameters are at the limit between identifiable and unidentifiable."""
    if weak := _between(mapping):
        file = Path(model.tree.path).name
        yield finding(
            "weak_parameters", subject=f"file {file}", file=file, faint=weak, base=len(mapping.K),
            joints=len(model.joints),
        )  # fmt: skip


def _between(mapping: BaseMapping) -> int:
    """Return the number of pivots that are neither rounding errors nor large enough."""
    return int(np.sum(mapping.pivots > _NOISE)) - len(mapping.K)


def _rounded(tree: Tree) -> dict[str, dict[str, float]]:
    """Return the rounded angles of each joint, as written, and the exact angles."""
    rounded = {}
    for joint in tree.robot.findall("joint"):
        origin = joint.find("origin")
        words = origin.get("rpy", "").split() if origin is not None else []
        exact = {word: angle for word in words if (angle := exact_angle(word)) is not None}
        if exact:
            rounded[joint.get("name", "")] = exact
    return rounded


def _effect(model: RobotModel, mapping: BaseMapping) -> tuple[str, dict[str, float]]:
    """Return whether the rounding adds base parameters: "more", "seeming" or "none"."""
    options = {
        **model.options, "couplings": model.layout.couplings, "constraints": model.constraints
    }  # fmt: skip
    meant = structural_mapping(RobotModel.from_urdf(model.tree, **options, snap_angles=True))
    seeming = _between(mapping) - _between(meant)
    if len(mapping.K) > len(meant.K):
        return "more", {"with_rounding": len(mapping.K), "meant": len(meant.K)}
    return ("seeming", {"seeming": seeming}) if seeming > 0 else ("none", {})


def _carrying(tree: Tree) -> set[str]:
    """Return the joints that move or carry a moving joint: their angles affect the dynamics."""
    arriving = {joint.child: joint for joint in tree.joints}
    carrying: set[str] = set()
    for joint in tree.movable:
        at: Joint | None = joint
        while at is not None and at.name not in carrying:
            carrying.add(at.name)
            at = arriving.get(at.parent)
    return carrying
