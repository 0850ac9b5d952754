"""Audit of the inertials of a URDF: impossible, assumed, rounded ones, and against its geometry."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.tolerances import REMAINDER, SLACK
from robotid.base.typing import Array
from robotid.diagnosis.catalogue import finding
from robotid.diagnosis.decisions import AGREES, DIFFERS
from robotid.dynamics.base_parameters import BaseMapping, structural_mapping
from robotid.robot.bodies import body_points, kinematic_lengths, link_places
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.prior import FARTHEST, REASONS, assumed_masses, body_sizes
from robotid.robot.tree import Inertial, Tree, exact_angle, numbers

#: Findings that take the URDF's masses as evidence.
_OF_MASSES = (
    "current_for_torque", "joint_origin", "payload", "torque_scale", "total_mass", "urdf_mismatch",
)  # fmt: skip
DENSEST = 12_000.0  # [kg/m^3] of a link: lead has 11,340
_LIGHTEST = 10.0  # [kg/m^3] over the box: foam
_THIN = 0.01  # [m] least side of a box: thin sheets have a volume
_LONGEST = np.sqrt(5.0)  # ellipsoid of a body with its mass on two sides, over the box
_SLENDER = 1.6  # ellipsoid over the length that the kinematics give; a uniform rod has 1.29
_SMALL = 1e-3  # share of the robot's mass below which a fault of a body is only a note
_ROUND = tuple(10.0**k for k in range(-6, 3))  # inertias [kg m^2] and masses [kg] of templates


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
    """Return a finding for each reason of assumed inertials, and for joints far from links."""
    pi, findings = model.standard_parameters(), list(_far_origins(model))
    for code, reason in REASONS.items():
        bodies = [body for body in model.layout.bodies if model.assumed.get(body) == code]
        if bodies:
            mass = sum(float(pi[10 * model.layout.bodies.index(body)]) for body in bodies)
            one = finding(
                code, subject=f"link {bodies[0]}", severity="warning", what="assumed", mass=mass,
                cure="assumed", reason=reason, links=listed(bodies, 12), bodies=len(bodies),
            )  # fmt: skip
            findings.append(one)
    return findings


def _far_origins(model: RobotModel) -> Iterator[Finding]:
    """Yield an error if joints are far beyond the bodies that carry them, as in millimetres."""
    size = body_sizes(pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial]))
    engine = model.pin_model
    for joint, i, place in zip(engine.names, engine.parents, engine.jointPlacements, strict=True):
        distance = float(np.linalg.norm(place.translation))
        if i > 0 and distance > FARTHEST * max(size[i - 1], np.median(size)) > 0.0:
            yield finding("origin_units", "", joint, subject=f"joint {joint}", distance=distance)


def explained_by_assumed(model: RobotModel, one: Finding) -> bool:
    """Return whether a finding compares the torque of a joint with inertials that are assumed."""
    if one.code not in _OF_MASSES:
        return False
    rows = [name in one.joints for name in model.row_names]
    carried = model.support[rows if any(rows) else slice(None)].any(axis=0)
    return bool((carried & model.layout.owned_by(assumed_masses(model))).any())


def impossible_inertials(model: RobotModel) -> list[Finding]:
    """Return the impossible inertials of links that are not assumed, as warnings on a fit."""
    inertials = model.tree.inertials
    effect = "; a consistent fit uses the nearest possible body instead"
    return [
        one.reworded(severity="warning", remedy=one.remedy + effect)
        for place in link_places(model)
        if place.body >= 0 and place.link in inertials
        and model.layout.bodies[place.body] not in model.assumed
        for one in impossible_inertial(place.link, inertials[place.link], matters=False)
        if one.severity == "error"
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
        "negative": min(A, 0.0) < -SLACK * abs(C),
        "triangle": margin < -SLACK * abs(C),
        "flat": margin <= SLACK * abs(C),
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
    felt = set[str]()  # joints that move or carry a moving joint: their angles affect the dynamics
    if effect != "none":
        carriers = model.tree.carriers
        felt.update(*((joint.name, *carriers[joint.name]) for joint in model.tree.movable))
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


def _between(mapping: BaseMapping) -> int:
    """Return the number of pivots that are neither rounding errors nor large enough."""
    return int(np.sum(mapping.pivots > REMAINDER)) - len(mapping.K)


def _rounded(tree: Tree) -> dict[str, dict[str, float]]:
    """Return the rounded angles of each joint, as written, and the exact angles."""
    rounded: dict[str, dict[str, float]] = {}
    for joint in tree.robot.findall("joint"):
        origin = joint.find("origin")
        for word in origin.get("rpy", "").split() if origin is not None else []:
            if (angle := exact_angle(word)) is not None:
                rounded.setdefault(joint.get("name", ""), {})[word] = angle
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


def audit_links(model: RobotModel) -> Iterator[Finding]:
    """Yield implausible inertials of a robot."""
    # A body is a moving link with all links fixed to it; without readable geometry it is skipped.
    yield from _templates(model)
    points = body_points(model)
    yield from audit_bodies(model, model.standard_parameters(), points)
    yield from _copies(model, points)
    unread = [body for body in model.layout.bodies if body not in points]
    if unread and next(model.tree.robot.iter("mesh"), None) is not None:
        link = unread[0]
        yield finding("geometry_unread", subject=f"link {link}", link=link, bodies=len(unread))


def audit_bodies(model: RobotModel, pi: Array, points: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield the bodies whose parameters are impossible in the box around their geometry."""
    # A body without geometry is compared with the length that the kinematics give it.
    J = pseudo_inertia(pi[: model.layout.n_inertial])
    lengths = kinematic_lengths(model) if set(model.layout.bodies) - points.keys() else {}
    parents = [i for i in model.pin_model.parents if i > 0] if lengths else []
    inner = {model.layout.bodies[i - 1] for i in parents}  # the last ones end beyond their joints
    for body, J_i in zip(model.layout.bodies, J, strict=True):
        if not J_i[3, 3] > 0:
            continue
        is_note = J_i[3, 3] < _SMALL * np.abs(J[:, 3, 3]).sum()
        if body in points:
            faults = list(_against_geometry(body, J_i, points[body]))
            if faults:  # the collision geometry may be a stand-in
                everything = body_points(model, with_visual=True)
                faults = list(_against_geometry(body, J_i, everything.get(body, points[body])))
                is_note |= body not in everything  # its visual is a mesh that is not there
        else:
            faults = list(_against_kinematics(body, J_i, lengths.get(body, np.inf), model.length))
            is_note |= body not in inner
        for fault in faults:
            yield replace(fault, severity="note") if is_note else fault


def _against_geometry(body: str, J: Array, points: Array) -> Iterator[Finding]:
    """Yield the parameters of a body that are impossible in the box around its geometry."""
    of_link, mass = {"subject": f"link {body}", "link": body}, float(J[3, 3])
    low, high = points.min(axis=0), points.max(axis=0)
    sides = np.maximum(high - low, _THIN)
    diagonal = float(np.linalg.norm(sides))
    centre = J[:3, 3] / mass
    outside = float(np.linalg.norm(np.maximum(np.maximum(low - centre, centre - high), 0.0)))
    if outside > DIFFERS * diagonal:
        yield finding(
            "com_outside", **of_link, what="box", centre=_metres(centre), low=_metres(low),
            high=_metres(high), outside=outside,
        )  # fmt: skip
    density = mass / float(np.prod(sides))
    if not _LIGHTEST <= density <= DENSEST:
        yield finding(
            "density", **of_link, sides=_metres(sides), mass=mass, density=density,
            least=_LIGHTEST, most=DENSEST,
        )  # fmt: skip
    second = np.trace(J[:3, :3]) / mass - float(centre @ centre)  # mean square distance
    farthest = float(np.max(np.sum((points - centre) ** 2, axis=1))) ** 0.5
    gyration = max(float(second), 0.0) ** 0.5
    if gyration > farthest + 0.5 * _THIN:
        yield finding("gyration", **of_link, gyration=gyration, farthest=farthest)
        return
    variance = np.maximum(np.diag(J)[:3] / mass - centre**2, 0.0)  # (3,), of the mass [m^2]
    lengths = 2.0 * np.sqrt(5.0 * variance)  # (3,), of the equivalent ellipsoid [m]
    k = int(np.argmax(lengths / sides))
    if lengths[k] > _LONGEST * sides[k]:
        yield finding(
            "ellipsoid", **of_link, what="box", cure="box", axis="xyz"[k], length=lengths[k],
            side=sides[k], most=_LONGEST * sides[k],
        )  # fmt: skip


def _against_kinematics(body: str, J: Array, length: float, longest: float) -> Iterator[Finding]:
    """Yield the parameters of a body without geometry that are impossible for its length [m]."""
    # Wide bodies have close joints: warnings need more than the longest of all bodies allows.
    of_link, centre = {"subject": f"link {body}", "link": body}, J[:3, 3] / J[3, 3]
    distance = float(np.linalg.norm(centre))
    if distance > max(length, longest):
        yield finding(
            "com_outside", **of_link, what="joint", centre=_metres(centre), distance=distance,
            length=length, outside=distance - length,
        )  # fmt: skip
        return
    variance = np.linalg.eigvalsh(J[:3, :3] / J[3, 3] - np.outer(centre, centre))[-1]  # [m^2]
    ellipsoid = 2.0 * float(np.sqrt(5.0 * max(variance, 0.0)))
    if ellipsoid > _SLENDER * length:
        is_far = ellipsoid > _LONGEST * max(length, longest)
        yield finding(
            "ellipsoid", **of_link, severity="warning" if is_far else "note", what="joint",
            cure="joint", length=ellipsoid, side=length, most=_SLENDER * length,
        )  # fmt: skip


def _templates(model: RobotModel) -> Iterator[Finding]:
    """Yield inertials with the numbers of a template."""
    for link, inertial in model.tree.inertials.items():
        ixx, ixy, ixz, iyy, iyz, izz = inertial.inertia
        is_isotropic = ixx == iyy == izz and ixy == ixz == iyz == 0
        if not (is_isotropic and np.isclose(ixx, _ROUND, rtol=SLACK).any()):
            continue
        if inertial.mass in (*_ROUND, 0.5) or not np.any(inertial.com):
            yield finding(
                "default_inertial", subject=f"link {link}", what="template", cure="template",
                link=link, mass=inertial.mass, moment=ixx,
            )  # fmt: skip


def _copies(model: RobotModel, points: dict[str, Array]) -> Iterator[Finding]:
    """Yield links with the same inertial as a link of another size."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for link in (body for body in model.layout.bodies if body in points):
        if (inertial := model.tree.inertials.get(link)) is not None:
            values = (inertial.mass, *inertial.com, *inertial.inertia)
            groups.setdefault(values, []).append(link)
    for (mass, *_), group in groups.items():
        boxes = np.sort([np.ptp(points[link], axis=0) for link in group], axis=1)
        if len(group) < 2 or not boxes.any() or mass <= 0:
            continue
        spread = float(np.max(np.abs(boxes - boxes[0])) / np.max(boxes))
        if spread >= AGREES:
            yield finding(
                "copied_inertial", subject=f"link {group[0]}", links=len(group), difference=spread,
                names=listed(group),
            )  # fmt: skip


def _metres(values: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"
