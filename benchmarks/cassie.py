"""Cassie from its SDF: a biped with two loops per leg, whose springs and rods have no drive."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin

from robotid.robot.constraints import Contact, Loop
from robotid.robot.drives import TERMS, Spring
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SIDES = ("left", "right")
SPRINGS = {"knee-shin-joint": 1500.0, "tarsus-spring-joint": 1250.0}  # [N m/rad]
#: Joints of a leg without a drive.
PASSIVE = (
    *SPRINGS, "shin-tarsus-joint", "crank-rod-joint", "foot-op", "achilles-u", "achilles-w",
)  # fmt: skip
ARMATURE, DAMPING, LIGHT = 0.05, 0.5, 0.1  # of drives, and damping of springs


def _pose(element):
    text = None if element is None else element.findtext("pose")
    x = np.zeros(6) if text is None else np.array(text.split(), dtype=float)
    right = 0.5 * np.pi  # rounded in the file: the axes of a mechanism in a plane are parallel
    angles = np.where(np.isclose(np.abs(x[3:]), right, atol=1e-5), np.sign(x[3:]) * right, x[3:])
    return pin.SE3(pin.rpy.rpyToMatrix(*angles), x[:3])


def _numbers(values):
    return " ".join(f"{x:.12g}" for x in values)


def _origin(place):
    rpy = pin.rpy.matrixToRpy(place.rotation)
    return f'<origin xyz="{_numbers(place.translation)}" rpy="{_numbers(rpy)}"/>'


def _joint(name, kind, parent, child, place, axis="0 0 1"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'{_origin(place)}<axis xyz="{axis}"/>'
        '<limit lower="-4" upper="4" effort="300" velocity="20"/></joint>'
    )


def _link(name, inertial=None):
    if inertial is None:
        return f'<link name="{name}"/>'
    inertia = inertial.find("inertia")
    parts = " ".join(
        f'{x}="{inertia.findtext(x)}"' for x in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    return (
        f'<link name="{name}"><inertial>{_origin(_pose(inertial))}'
        f'<mass value="{inertial.findtext("mass")}"/><inertia {parts}/></inertial></link>'
    )


def _bend(name):
    """Return the turn of the zero position from the dead centre of crank and foot of the SDF."""
    turns = {"crank-joint": -1.5, "foot-op": -1.5, "crank-rod-joint": 1.5}
    turn = next((x for end, x in turns.items() if name.endswith(end)), 0.0)
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])), np.zeros(3))


_CROSS = (
    '<inertial><mass value="0.01"/>'
    '<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)


def urdf():
    """Return the open tree as the text of a URDF, with a link at each end of a loop and blade."""
    robots = next(p for p in example_urdf("go1.urdf").parents if p.name == "robots")
    sdf = robots / "cassie_description" / "robots" / "cassie_v2.sdf"
    top = ET.parse(sdf).getroot().find("model")
    links = {link.get("name"): _pose(link) for link in top.findall("link")}
    text = [_link(link.get("name"), link.find("inertial")) for link in top.findall("link")]
    for joint in top.findall("joint"):
        name, parent, child = joint.get("name"), joint.findtext("parent"), joint.findtext("child")
        place, side = links[child] * _pose(joint), name.partition("-")[0]
        if name.endswith(("achilles-spring-joint", "plantar-foot-joint")):
            for k, link in enumerate((parent, child)):  # a loop is opened here
                end = f"{name}-{k}"
                own = pin.SE3(np.eye(3), links[link].actInv(place.translation))
                text += [_link(end), _joint(f"{end}-mount", "fixed", link, end, own)]
        elif name.endswith("pitch-rod-joint"):  # a ball joint; its turn about the rod is not used
            rod, cross = parent, f"{side}-achilles-cross"
            own = links[child].inverse() * links[rod]
            text += [
                f'<link name="{cross}">{_CROSS}',
                _joint(f"{side}-achilles-u", "revolute", child, cross, own, "0 1 0"),
                _joint(f"{side}-achilles-w", "revolute", cross, rod, pin.SE3.Identity()),
            ]
        else:
            own = links[parent].inverse() * place * _bend(name)
            text.append(_joint(name, "revolute", parent, child, own))
    middle, along, below = np.array([[0.01, 0.045, 0.0], [0.768, -0.64, 0.0], [0.64, 0.768, 0.0]])
    for side in SIDES:
        for end, sign in (("toe", 1), ("heel", -1)):
            own = pin.SE3(np.eye(3), middle + 0.09 * sign * along + 0.0168 * below)
            name = f"{side}-{end}"
            text += [_link(name), _joint(f"{name}-mount", "fixed", f"{side}-foot", name, own)]
    return f"<robot name='cassie'>{''.join(text)}</robot>"


FEET = tuple(f"{side}-{end}" for side in SIDES for end in ("toe", "heel"))
LOOPS = tuple(
    Loop((f"{side}-{x}-0", f"{side}-{x}-1"), "point")
    for side in SIDES
    for x in ("achilles-spring-joint", "plantar-foot-joint")
)


def cassie(folder):
    """Return Cassie, whose pelvis has a measured wrench."""
    path = folder / "cassie.urdf"
    path.write_text(urdf())
    springs = {f"{s}-{x}": [TERMS["viscous"], Spring()] for s in SIDES for x in SPRINGS}
    return RobotModel.from_urdf(
        path, free_flyer=True, terms=("armature", "viscous"), own_terms=springs,
        passive=[f"{side}-{x}" for side in SIDES for x in PASSIVE],
        constraints=[
            *LOOPS, *(Contact(foot) for foot in FEET),
            Contact("pelvis", "surface", measured=Contact.components, always=True),
        ],
    )  # fmt: skip


def truth(model):
    """Return the parameters of the robot with its drives and springs."""
    pi, n = model.standard_parameters(), model.layout.n_inertial
    for k, name in enumerate(model.layout.names[n:], start=n):
        joint, _, term = name.rpartition(".")
        stiffness, light = SPRINGS.get(joint.partition("-")[2], 0.0), joint in model.passive
        pi[k] = {
            "armature": ARMATURE, "viscous": LIGHT if light else DAMPING, "spring": stiffness
        }[term]  # fmt: skip
    return pi
