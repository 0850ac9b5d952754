"""Audit of the inertials of a URDF: values that are impossible for any body."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.robot.bodies import link_places
from robotid.robot.model import RobotModel
from robotid.robot.prior import REASONS, assumed_masses
from robotid.robot.tree import Inertial
from robotid.robot.urdf_text import numbers

#: Findings that take the URDF's masses as evidence.
_OF_MASSES = (
    "current_for_torque", "joint_origin", "link_mass", "payload", "torque_scale", "total_mass",
    "unmounted_part", "urdf_mismatch",
)  # fmt: skip
_SLACK = 1e-9  # relative violation of the triangle inequality that is rounding


def negative_masses(robot: ET.Element) -> Iterator[Finding]:
    """Yield the negative masses of a file, from which no model can be built."""
    for link in robot.findall("link"):
        mass = link.find("inertial/mass")
        text = "" if mass is None else mass.get("value", "")
        for value in numbers(text, 1):  # a text that is no number is another finding
            if value < 0:
                name = link.get("name", "")
                message = (
                    f"link {name!r} has the mass {value:g} kg, wanted more than 0; correct the sign"
                )
                yield Finding("negative_mass", "error", f"link {name}", message, {"mass": value})


def assumed_inertials(model: RobotModel) -> list[Finding]:
    """Return a finding for each reason of the inertials that are assumed."""
    pi = model.standard_parameters()
    findings = []
    for code, reason in REASONS.items():
        bodies = [body for body in model.layout.bodies if model.assumed.get(body) == code]
        if not bodies:
            continue
        masses = [float(pi[10 * model.layout.bodies.index(body)]) for body in bodies]
        shape = "their stated masses in" if code == "not_positive_definite" else "the masses of"
        message = (
            f"the URDF has {reason}: {listed(bodies, 12)}. Assumed: {shape} uniform boxes of their "
            f"geometry or frames, {sum(masses):.3g} kg together. What the data do not determine "
            "keeps these values; write the inertials from CAD if you have them"
        )
        evidence = {"bodies": float(len(bodies)), "mass": sum(masses)}
        findings.append(Finding(code, "warning", f"link {bodies[0]}", message, evidence))
    return findings


def explained_by_assumed(model: RobotModel, finding: Finding) -> bool:
    """Return whether a finding compares the torque of a joint with inertials that are assumed."""
    if finding.code not in _OF_MASSES:
        return False
    named = finding.where.rpartition(": ")[2].split(", ")
    rows = [name in named for name in model.row_names]
    carried = model.support()[rows if any(rows) else slice(None)].any(axis=0)
    return bool((carried & model.layout.owned_by(assumed_masses(model))).any())


def impossible_inertials(model: RobotModel) -> list[Finding]:
    """Return the impossible inertials of links that are not assumed, as warnings on a fit."""
    inertials = model.tree.inertials
    effect = "; a consistent fit uses the nearest possible body instead"
    return [
        replace(finding, severity="warning", message=finding.message + effect)
        for place in link_places(model)
        if place.body >= 0 and place.link in inertials
        and model.layout.bodies[place.body] not in model.assumed
        for finding in impossible_inertial(place.link, inertials[place.link], matters=False)
        if finding.severity == "error"
    ]  # fmt: skip


def impossible_inertial(link: str, inertial: Inertial, matters: bool) -> Iterator[Finding]:
    """Yield the findings on an inertial that is impossible for any body."""
    at, mass = f"link {link}", inertial.mass
    if mass == 0:
        message = (
            f"link {link!r} has the mass 0 kg, wanted more than 0; write its mass, or remove the "
            "<inertial> if the link is only a frame"
        )
        yield Finding("zero_mass", "warning" if matters else "note", at, message)
    ixx, ixy, ixz, iyy, iyz, izz = inertial.inertia
    A, B, C = np.linalg.eigvalsh([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]).tolist()
    fault = _inertia_fault(A, B, C)
    if fault and (mass != 0 or any(inertial.inertia)):
        severity = "note" if fault.startswith("flat") else "error"
        evidence = {"smallest": A, "middle": B, "largest": C, "triangle": A + B - C}
        message = f"link {link!r}: {fault}"
        yield Finding("not_positive_definite", severity, at, message, evidence)


def _inertia_fault(A: float, B: float, C: float) -> str | None:
    """Return why a body with these principal moments of inertia is impossible, or None."""
    stated = f"principal moments of inertia {A:.4g}, {B:.4g}, {C:.4g} kg m^2"
    advice = (
        "use the inertia from CAD, about the centre of mass and in the stated frame. Until then "
        "that of a uniform box is assumed"
    )
    margin = A + B - C
    if min(A, 0.0) < -_SLACK * abs(C):
        return f"its {stated} are not all positive, wanted > 0 ({A:.4g} is not); {advice}"
    if margin < -_SLACK * abs(C):
        return (
            f"its {stated} violate the triangle inequality: the sum of the two smaller ones is "
            f"{A + B:.4g}, wanted more than {C:.4g}; {advice}"
        )
    if margin <= _SLACK * abs(C):
        return (
            f"flat or thin: of its {stated} the sum of the two smaller ones is not larger than the "
            "third, so the pseudo-inertia is singular; give the body some thickness"
        )
    return None
