"""Check of inertials against the geometry of a URDF: values that no body of that shape has."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from robotid.base.findings import Finding, listed
from robotid.base.typing import Array
from robotid.diagnosis.catalogue import finding
from robotid.robot.geometry import body_points, kinematic_lengths
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.tree import Inertial

_DENSEST, _LIGHTEST = 20_000.0, 10.0  # [kg/m^3] over the box: about solid tungsten, and foam
_MARGIN = 0.1  # of the box's diagonal, by which a centre of mass may lie outside
_LONGEST = 5.0**0.5  # ellipsoid of a body with half of its mass on each of two sides, over the box
_SLENDER = 1.6  # ellipsoid over the length that the kinematics give; a uniform rod has 1.29
_THIN = 0.01  # [m] least side of a box, so that thin sheets have a volume
_SMALL = 1e-3  # share of the robot's mass below which a fault of a body is only a note
_ROUND = tuple(10.0**k for k in range(-6, 3))  # inertias [kg m^2] and masses [kg] of templates
_ALIKE = 1e-9  # largest relative difference of inertials that are copies
_SIZE = 0.05  # largest relative difference of boxes of equal size


def audit_links(model: RobotModel) -> Iterator[Finding]:
    """Yield implausible inertials of a robot.

    A body is a moving link with all links that are fixed to it. The collision geometry is used,
    or the visual one; a body whose geometry cannot be read is not checked.
    """
    yield from _templates(model)
    points = body_points(model)
    yield from audit_bodies(model, model.standard_parameters(), points)
    yield from _copies(model, points)
    unread = [body for body in model.layout.bodies if body not in points]
    if unread and next(model.tree.robot.iter("mesh"), None) is not None:
        link = unread[0]
        yield finding("geometry_unread", subject=f"link {link}", link=link, bodies=len(unread))


def audit_bodies(model: RobotModel, pi: Array, points: Mapping[str, Array]) -> Iterator[Finding]:
    """Yield the bodies whose parameters are impossible in the box around their geometry.

    A body without geometry is compared with the length that the kinematics give it.
    """
    J = pseudo_inertia(pi[: model.layout.n_inertial])
    lengths = kinematic_lengths(model) if set(model.layout.bodies) - points.keys() else {}
    # the last bodies end beyond their joints
    inner = (
        {model.layout.bodies[i - 1] for i in model.pin_model.parents if i > 0} if lengths else ()
    )
    for body, J_i in zip(model.layout.bodies, J, strict=True):
        if not J_i[3, 3] > 0:
            continue
        is_note = J_i[3, 3] < _SMALL * np.abs(J[:, 3, 3]).sum()
        if body in points:
            faults = list(_against_geometry(body, J_i, points[body]))
            if faults:  # the collision geometry may be a stand-in
                everything = body_points(model, with_visual=True)
                faults = list(_against_geometry(body, J_i, everything.get(body, points[body])))
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
    if outside > _MARGIN * diagonal:
        yield finding(
            "com_outside", **of_link, what="box", centre=_metres(centre), low=_metres(low),
            high=_metres(high), outside=outside,
        )  # fmt: skip
    density = mass / float(np.prod(sides))
    if not _LIGHTEST <= density <= _DENSEST:
        yield finding(
            "density", **of_link, sides=_metres(sides), mass=mass, density=density,
            least=_LIGHTEST, most=_DENSEST,
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
    """Yield the parameters of a body without geometry that are impossible for its length [m].

    A body may be wide where its joints are close: warnings need more than the longest of all bodies
    allows.
    """
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
        if not (is_isotropic and np.isclose(ixx, _ROUND, rtol=_ALIKE).any()):
            continue
        if inertial.mass in (*_ROUND, 0.5) or not np.any(inertial.com):
            yield finding(
                "default_inertial", subject=f"link {link}", what="template", cure="template",
                link=link, mass=inertial.mass, moment=ixx,
            )  # fmt: skip


def _copies(model: RobotModel, points: dict[str, Array]) -> Iterator[Finding]:
    """Yield links with the same inertial as a link of another size."""
    inertials = model.tree.inertials
    owners = [body for body in model.layout.bodies if body in inertials and body in points]
    groups: list[list[str]] = []
    for link in owners:
        for group in groups:
            if _is_copy(inertials[link], inertials[group[0]]):
                group.append(link)
                break
        else:
            groups.append([link])
    for group in groups:
        boxes = np.sort([np.ptp(points[link], axis=0) for link in group], axis=1)
        if len(group) < 2 or not boxes.any() or inertials[group[0]].mass <= 0:
            continue
        spread = float(np.max(np.abs(boxes - boxes[0])) / np.max(boxes))
        if spread >= _SIZE:
            yield finding(
                "copied_inertial", subject=f"link {group[0]}", links=len(group), difference=spread,
                names=listed(group),
            )  # fmt: skip


def _is_copy(one: Inertial, other: Inertial) -> bool:
    a, b = (np.array([x.mass, *x.com, *x.inertia], dtype=float) for x in (one, other))
    return bool(np.allclose(a, b, rtol=_ALIKE, atol=1e-12))


def _metres(values: Array) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values.tolist()) + ")"
