"""The only parser of URDFs: each fault raises an error; Pinocchio receives the tree alone."""

import copy
import difflib
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robotid.base.exceptions import ModelError
from robotid.base.findings import listed
from robotid.robot.urdf_text import LARGEST, parse_urdf, read_numbers, write_exact_angles

#: The types of joint that have a degree of freedom.
MOVABLE = ("revolute", "continuous", "prismatic")
#: Smallest distance of axes, and side of a body [m]: URDFs have 0.05 m or more, or 0.5 mm.
SMALLEST_LENGTH = 0.01
_ENDLESS = 200.0  # [rad or m] range that counts as no limit: no cable allows 30 revolutions
#: Attributes of an ``<inertia>``, in the order of ``Inertial.inertia``.
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_LIGHTEST = 1e-15  # [kg] smallest mass of a link that has one: quotients stay finite
_DEEPEST = 500  # joints from the root to a link; Pinocchio uses recursion
_WORLD = "world"  # the parent link that need not be in the file
_MOST_JOINTS = 300  # memory grows with their square, time with their cube: 2 GiB, 75 s


@dataclass(frozen=True)
class Inertial:
    """The ``<inertial>`` of a link."""

    mass: float  # [kg]
    com: tuple[float, ...]  # centre of mass in the link frame [m]
    rpy: tuple[float, ...]  # roll, pitch, yaw of the frame of the inertia [rad]
    inertia: tuple[float, ...]  # ixx ixy ixz iyy iyz izz about the centre of mass [kg m^2]


@dataclass(frozen=True)
class Joint:
    """One ``<joint>`` of a URDF."""

    name: str  # its name
    type: str  # fixed, revolute, continuous or prismatic
    parent: str  # parent link
    child: str  # child link
    lower: float = -math.inf  # lower position limit [rad or m], -inf if none is stated
    upper: float = math.inf  # upper position limit [rad or m], inf if none is stated
    velocity: float = math.inf  # velocity limit [rad/s or m/s], inf if none is stated
    effort: float = math.inf  # effort limit [N m or N], inf if none is stated
    # name of the joint that it mimics, multiplier [-], offset [rad or m]; or None
    mimic: tuple[str, float, float] | None = None
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)  # origin in the parent's frame [m]
    rpy: tuple[float, ...] = (0.0, 0.0, 0.0)  # roll, pitch, yaw there [rad]
    axis: tuple[float, ...] = (1.0, 0.0, 0.0)  # direction of the joint axis, of any length

    @property
    def is_movable(self) -> bool:
        """Whether the joint has a degree of freedom."""
        return self.type in MOVABLE

    @property
    def has_limits(self) -> bool:
        """Whether the URDF states a range of positions; 0 and 200 rad or more count as none."""
        return 0.0 < self.upper - self.lower < _ENDLESS

    @property
    def turns_freely(self) -> bool:
        """Whether the URDF states no limits of the rotation."""
        return self.type == "continuous" or (self.type == "revolute" and not self.has_limits)


@dataclass(frozen=True)
class Tree:
    """The kinematic tree of a URDF."""

    path: str  # file it was read from
    name: str  # name of the robot
    root: str  # link that no joint moves
    links: tuple[str, ...]  # names of the links, in the file's order
    joints: tuple[Joint, ...]  # the joints, in the file's order
    inertials: Mapping[str, Inertial]  # the ``<inertial>`` of each link that has one, by its name
    # the parsed ``<robot>``, for elements that the dynamics do not need
    robot: ET.Element = field(repr=False, compare=False)

    @property
    def movable(self) -> tuple[Joint, ...]:
        """The joints that have a degree of freedom, in the file's order."""
        return tuple(joint for joint in self.joints if joint.is_movable)

    @property
    def reductions(self) -> dict[str, float]:
        """Gear ratios of the ``<transmission>`` of one joint and one actuator, by joint."""
        found = {}
        for element in self.robot.findall("transmission"):
            joints, actuators = element.findall("joint"), element.findall("actuator")
            texts = {(x.text or "").strip() for x in element.iter("mechanicalReduction")}
            if not len(joints) == len(actuators) == len(texts) == 1:
                continue
            name, (text,) = joints[0].get("name", ""), texts
            try:
                found[name] = float(text)
            except ValueError as error:
                raise ModelError(
                    f"{Path(self.path).name}: the mechanicalReduction of joint {name!r} is "
                    f"{text!r}, wanted a number"
                ) from error
        return found

    @property
    def xml(self) -> str:
        """A URDF with only the links, inertials and joints, with the numbers read here."""
        minimal = ET.Element("robot", name=self.name)
        for link in self.links:
            element = ET.SubElement(minimal, "link", name=link)
            if link in self.inertials:
                _add_inertial(element, self.inertials[link])
        for joint in self.joints:
            _add_joint(minimal, joint)
        return ET.tostring(minimal, encoding="unicode")

    def snapped(self) -> "Tree":
        """Return the same robot with exact angles for the rounded ones of its joints' origins."""
        robot = copy.deepcopy(self.robot)
        write_exact_angles(robot)
        return _tree(robot, self.path)


def read_tree(path: str | Path) -> Tree:
    """Read the kinematic tree of a URDF file."""
    return _tree(parse_urdf(path), str(path))


def _tree(robot: ET.Element, path: str) -> Tree:
    where, name = Path(path).name, robot.get("name")
    if not name:
        raise ModelError(
            f'{where}: <robot> has no name; write <robot name="..."> in its first line'
        )
    links = _unique(robot.findall("link"), "link", where)
    elements = _unique(robot.findall("joint"), "joint", where)
    parents = {tag.get("link") for tag in robot.iterfind("joint/parent")}
    if _WORLD in parents and _WORLD not in links:  # Drake and yourdfpy do not require it
        links = {_WORLD: ET.Element("link", name=_WORLD), **links}
    joints = tuple(_joint(element, links, where) for element in elements.values())
    root = _root(tuple(links), joints, where)
    inertials = {
        link: _inertial(inertial, f"{where}: link {link!r}: inertial")
        for link, element in links.items()
        if (inertial := element.find("inertial")) is not None
    }
    return Tree(path, name, root, tuple(links), joints, inertials, robot)


def _unique(elements: list[ET.Element], kind: str, where: str) -> dict[str, ET.Element]:
    named: dict[str, ET.Element] = {}
    for element in elements:
        name = element.get("name")
        if not name:
            raise ModelError(f"{where}: a <{kind}> has no name; give it one")
        if name in named:
            raise ModelError(f"{where}: two {kind}s are named {name!r}, wanted unique names")
        named[name] = element
    return named


def _joint(element: ET.Element, links: dict[str, ET.Element], where: str) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    at = f"{where}: joint {name!r}"
    if kind not in (*MOVABLE, "fixed"):
        raise ModelError(
            f"{at} has type {kind!r}, wanted fixed, revolute, continuous or prismatic (for a "
            "floating base use free_flyer=True, not a joint)"
        )
    ends = {}
    for end in ("parent", "child"):
        tag = element.find(end)
        ends[end] = tag.get("link", "") if tag is not None else ""
        if ends[end] not in links:
            raise ModelError(f"{at} has the {end} link {ends[end]!r}, which is not in the file")
    xyz, rpy = _pose(element, f"{at}:")
    if kind == "fixed":
        return Joint(name, kind, ends["parent"], ends["child"], xyz=xyz, rpy=rpy)
    axis, limit = element.find("axis"), element.find("limit")
    direction = (1.0, 0.0, 0.0) if axis is None else read_numbers(axis, "xyz", f"{at}:")
    if math.hypot(*direction) < 1e-9:
        raise ModelError(f"{at}: axis xyz is zero, wanted a direction")
    keys = ("velocity", "effort") + (("lower", "upper") if kind != "continuous" else ())
    bounds = {
        key: read_numbers(limit, key, f"{at}:")[0]
        for key in keys
        if limit is not None and limit.get(key) is not None
    }
    mimic, leader = None, element.find("mimic")
    if leader is not None:
        (multiplier,) = read_numbers(leader, "multiplier", f"{at}:", (1.0,))
        (offset,) = read_numbers(leader, "offset", f"{at}:", (0.0,))
        mimic = leader.get("joint", ""), multiplier, offset
    return Joint(
        name, kind, ends["parent"], ends["child"], **bounds,
        mimic=mimic, xyz=xyz, rpy=rpy, axis=direction,
    )  # fmt: skip


def _pose(element: ET.Element, at: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return xyz and rpy of an element's origin."""
    origin = element.find("origin")
    if origin is not None and origin.get("quat_xyzw") is not None:
        raise ModelError(f"{at} origin has quat_xyzw, wanted rpy; convert it to rpy angles")
    none = (0.0, 0.0, 0.0)
    return read_numbers(origin, "xyz", at, none), read_numbers(origin, "rpy", at, none)


def _root(links: tuple[str, ...], joints: tuple[Joint, ...], where: str) -> str:
    """Return the root link, after checking that all others are connected to it."""
    children: dict[str, list[str]] = {link: [] for link in links}
    moved: set[str] = set()
    for joint in joints:
        if joint.child in moved:
            raise ModelError(
                f"{where}: link {joint.child!r} is the child of two joints, wanted one; open the "
                "closed kinematic chain"
            )
        moved.add(joint.child)
        children[joint.parent].append(joint.child)
    level = roots = [link for link in links if link not in moved]
    if len(roots) != 1:
        raise ModelError(f"{where}: the root links are {listed(roots, 9)}, wanted exactly one")
    reached, depth = set(roots), 0
    while level:
        level = [child for link in level for child in children[link]]
        reached.update(level)
        depth += 1
        if depth > _DEEPEST:
            raise ModelError(
                f"{where}: a chain has more than {_DEEPEST} joints in series, wanted at most "
                f"{_DEEPEST}"
            )
    if circle := [link for link in links if link not in reached]:
        raise ModelError(
            f"{where}: the links {listed(circle, 9)} form a closed loop that is not connected to "
            f"the root link {roots[0]!r}; correct the parent of one of their joints"
        )
    return roots[0]


def _inertial(inertial: ET.Element, at: str) -> Inertial:
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        raise ModelError(f"{at} needs both <mass> and <inertia>; add the missing one")
    com, rpy = _pose(inertial, at)
    (value,) = read_numbers(mass, "value", at)
    if value < 0:
        raise ModelError(f"{at} mass is {value:g} kg, wanted more than 0; correct the sign")
    if 0 < value < _LIGHTEST:
        raise ModelError(f"{at} mass is {value:g} kg, wanted 0 or at least {_LIGHTEST:g}")
    moments = tuple(read_numbers(inertia, key, at)[0] for key in MOMENTS)
    return Inertial(value, com, rpy, moments)


def _text(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))


def _add_inertial(link: ET.Element, inertial: Inertial) -> None:
    element = ET.SubElement(link, "inertial")
    ET.SubElement(element, "origin", xyz=_text(inertial.com), rpy=_text(inertial.rpy))
    ET.SubElement(element, "mass", value=repr(inertial.mass))
    moments = dict(zip(MOMENTS, map(repr, inertial.inertia), strict=True))
    ET.SubElement(element, "inertia", moments)


def _add_joint(robot: ET.Element, joint: Joint) -> None:
    element = ET.SubElement(robot, "joint", name=joint.name, type=joint.type)
    ET.SubElement(element, "origin", xyz=_text(joint.xyz), rpy=_text(joint.rpy))
    ET.SubElement(element, "parent", link=joint.parent)
    ET.SubElement(element, "child", link=joint.child)
    if joint.is_movable:
        ET.SubElement(element, "axis", xyz=_text(joint.axis))
        # the parser requires limits; the dynamics do not use them, `Joint` has the stated ones
        ET.SubElement(element, "limit", lower="-1e9", upper="1e9", velocity="1e9", effort="1e9")


def choose_joints(
    tree: Tree,
    free: Sequence[str],
    joints: Sequence[str] | None,
    locked: Mapping[str, float],
    followers: Mapping[str, tuple[str, float, float]],
) -> tuple[tuple[str, ...], dict[str, float]]:
    """Return the joints that move, in order, and the positions of those that do not [rad or m]."""
    _check_joints(tree, [*(joints or ()), *(name for name in locked if name != "*")], followers)
    if joints is None and "*" in locked:
        raise ModelError(
            "locked has '*' (all joints that are not named), but joints is not stated; list the "
            "joints to identify in joints"
        )
    moving = tuple(name for name in free if name not in locked) if joints is None else tuple(joints)
    both = [name for name in moving if name in locked]
    if both:
        raise ModelError(f"joints {listed(both)} are in both joints and locked; remove them in one")
    if len(set(moving)) != len(moving):
        raise ModelError(f"joints is {listed(moving)}, wanted each name once")
    if len(moving) > _MOST_JOINTS:
        raise ModelError(
            f"{Path(tree.path).name}: {len(moving)} joints move, wanted at most {_MOST_JOINTS}; "
            "list the joints to identify in joints, or lock others"
        )
    for name, position in locked.items():
        is_number = isinstance(position, int | float | np.number)
        if not is_number or not abs(position) <= LARGEST:
            raise ModelError(
                f"joint {name!r} is locked at {position!r}, wanted a number within +-{LARGEST:g} "
                "[rad or m]"
            )
    others = locked.get("*", 0.0)
    positions = {name: float(locked.get(name, others)) for name in free if name not in moving}
    _check_mimic(tree, moving, positions, followers)
    beside = {j.name: j.mimic for j in tree.movable if j.mimic and j.name not in locked}
    for name, (leader, ratio, offset) in {**beside, **followers}.items():
        if leader in positions:
            positions[name] = ratio * positions[leader] + offset
    return moving, positions


def _check_joints(tree: Tree, names: Sequence[str], followers: Mapping[str, object]) -> None:
    known = [joint.name for joint in tree.movable]
    for name in names:
        if name in followers:
            raise ModelError(
                f"joint {name!r} mimics another joint and moves with it (mimic = 'coupled'); omit "
                "it, or use mimic = 'independent'"
            )
        if name not in known:
            if any(joint.name == name for joint in tree.joints):
                raise ModelError(
                    f"joint {name!r} is fixed in {Path(tree.path).name}: it cannot move"
                )
            near = difflib.get_close_matches(name, known, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise ModelError(
                f"joint {name!r} is not in {Path(tree.path).name}; joints: {listed(known)}.{hint}"
            )


def mimic_followers(tree: Tree) -> dict[str, tuple[str, float, float]]:
    """Return each mimic joint with its leading joint, ratio and offset; chains are resolved."""
    by_name = {joint.name: joint for joint in tree.movable}
    resolved = {}
    for joint in tree.movable:
        if joint.mimic is None:
            continue
        leader, ratio, offset = joint.mimic
        seen = {joint.name}
        while True:
            if leader not in by_name or leader in seen:
                raise ModelError(
                    f"joint {joint.name!r} mimics {leader!r}, wanted another movable joint that "
                    "does not mimic it in turn; correct the <mimic>, or use mimic = 'independent'"
                )
            up = by_name[leader].mimic
            if up is None:
                break
            seen.add(leader)
            leader, ratio, offset = up[0], ratio * up[1], ratio * up[2] + offset
        if not max(abs(ratio), abs(offset)) <= LARGEST:
            raise ModelError(
                f"joint {joint.name!r} mimics {leader!r} with a total multiplier of {ratio:g} and "
                f"offset of {offset:g}, wanted numbers within +-{LARGEST:g}; correct the <mimic>"
            )
        resolved[joint.name] = (leader, ratio, offset)
    return resolved


def _check_mimic(
    tree: Tree, moving: Sequence[str], locked: Mapping[str, float], followers: Mapping[str, object]
) -> None:
    for joint in tree.movable:
        if joint.mimic is None or joint.name in followers:
            continue
        leader = joint.mimic[0]
        if (joint.name in locked) != (leader in locked) and leader in (*moving, *locked):
            raise ModelError(
                f"joint {joint.name!r} mimics {leader!r}, but only one of them is locked; list "
                "both in joints, or lock both, or use mimic = 'coupled'"
            )
