"""The one parse of a URDF, and what of it the dynamics need: links, inertials, joints.

Pinocchio's parser wants meshes' neighbours, limits and ``<dynamics>`` to be right, although the
dynamics never use them, and only prints what it misses. So the XML is read here, every fault that
matters is refused by name, and Pinocchio gets the kinematic tree alone.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from robotid.exceptions import ModelError
from robotid.findings import listed

__all__ = [
    "MOVABLE",
    "Inertial",
    "Joint",
    "Tree",
    "numbers",
    "parse_urdf",
    "read_tree",
    "read_with_yourdfpy",
]

#: The types of joint that have a degree of freedom.
MOVABLE = ("revolute", "continuous", "prismatic")
_ENDLESS = 200.0  # [rad or m] a stated range this wide is none: no cable winds 30 turns


@dataclass(frozen=True)
class Inertial:
    """The ``<inertial>`` of a link.

    Attributes:
        mass: Mass [kg].
        com: Centre of mass in the link frame [m].
        rpy: Roll, pitch, yaw of the frame that the inertia is stated in [rad].
        inertia: ixx ixy ixz iyy iyz izz about the centre of mass [kg m^2].
    """

    mass: float
    com: tuple[float, ...]
    rpy: tuple[float, ...]
    inertia: tuple[float, ...]


@dataclass(frozen=True)
class Joint:
    """One ``<joint>`` of a URDF.

    Attributes:
        name: Its name.
        type: fixed, revolute, continuous or prismatic.
        parent: Link it hangs on.
        child: Link it moves.
        lower: Lower position limit [rad or m], -inf if none is stated.
        upper: Upper position limit [rad or m], inf if none is stated.
        velocity: Velocity limit [rad/s or m/s], inf if none is stated.
        effort: Effort limit [N m or N], inf if none is stated.
        mimic: Name of the joint it mimics, multiplier [-], offset [rad or m]; or None.
    """

    name: str
    type: str
    parent: str
    child: str
    lower: float = -math.inf
    upper: float = math.inf
    velocity: float = math.inf
    effort: float = math.inf
    mimic: tuple[str, float, float] | None = None

    @property
    def is_movable(self) -> bool:
        """Whether the joint has a degree of freedom."""
        return self.type in MOVABLE

    @property
    def has_limits(self) -> bool:
        """Whether the URDF states a range of positions.

        lower = upper = 0 states none, and neither does a range that no joint has, as +-10000 rad.
        """
        return 0.0 < self.upper - self.lower < _ENDLESS

    @property
    def turns_freely(self) -> bool:
        """Whether the joint may turn without end, as far as the URDF says."""
        return self.type == "continuous" or (self.type == "revolute" and not self.has_limits)


@dataclass(frozen=True)
class Tree:
    """The kinematic tree of a URDF.

    Attributes:
        path: File it was read from.
        name: Name of the robot.
        root: Link that no joint moves.
        links: Names of the links, in the file's order.
        joints: The joints, in the file's order.
        inertials: The ``<inertial>`` of each link that has one, by its name.
        robot: The ``<robot>`` as parsed, for what the dynamics do not need.
    """

    path: str
    name: str
    root: str
    links: tuple[str, ...]
    joints: tuple[Joint, ...]
    inertials: Mapping[str, Inertial]
    robot: ET.Element = field(repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "inertials": dict(self.inertials)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, inertials=MappingProxyType(state["inertials"]))

    @property
    def movable(self) -> tuple[Joint, ...]:
        """The joints that have a degree of freedom, in the file's order."""
        return tuple(joint for joint in self.joints if joint.is_movable)

    @property
    def xml(self) -> str:
        """A URDF with nothing but the links, inertials and joints."""
        minimal = ET.Element("robot", name=self.name)
        minimal.extend(_copy(link, ("inertial",)) for link in self.robot.findall("link"))
        minimal.extend(_minimal_joint(joint) for joint in self.robot.findall("joint"))
        return ET.tostring(minimal, encoding="unicode")


def read_tree(path: str | Path) -> Tree:
    """Read the kinematic tree of a URDF file.

    Args:
        path: The URDF file. Meshes are not looked for.

    Raises:
        ModelError: If the file is missing, is no URDF, is no tree, has no movable joint, or if a
            number that the dynamics use is missing, not a number or not finite.
    """
    source = Path(path)
    robot = parse_urdf(source)
    where = source.name
    name = robot.get("name")
    if not name:
        raise ModelError(
            f'{where}: <robot> has no name; write <robot name="..."> in its first line'
        )
    links = _unique(robot.findall("link"), "link", where)
    elements = _unique(robot.findall("joint"), "joint", where)
    joints = tuple(_joint(element, links, where) for element in elements.values())
    if not any(joint.is_movable for joint in joints):
        raise ModelError(
            f"{where}: robot {name!r} has no movable joint, so there is nothing to identify"
        )
    root = _root(tuple(links), joints, where)
    inertials = {
        link: _inertial(inertial, f"{where}: link {link!r}: inertial")
        for link, element in links.items()
        if (inertial := element.find("inertial")) is not None
    }
    return Tree(str(source), name, root, tuple(links), joints, MappingProxyType(inertials), robot)


def parse_urdf(path: str | Path) -> ET.Element:
    """Return the ``<robot>`` of a URDF file, whatever is in it.

    Args:
        path: The URDF file.

    Raises:
        ModelError: If the file is missing, or is no XML or another one.
    """
    path = Path(path)
    if not path.is_file():
        raise ModelError(f"there is no URDF file {str(path)!r}")
    if path.suffix == ".xacro":
        raise ModelError(f"{path.name} is xacro, not URDF; expand it first: xacro {path.name}")
    try:
        robot = ET.parse(path).getroot()
    except (ET.ParseError, LookupError, ValueError) as error:  # the latter two: its encoding
        raise ModelError(f"{path.name} is not well-formed XML: {error}") from error
    if robot.tag != "robot":
        raise ModelError(f"{path.name}: the top element is <{robot.tag}>, wanted <robot>")
    return robot


def _unique(elements: list[ET.Element], kind: str, where: str) -> dict[str, ET.Element]:
    named: dict[str, ET.Element] = {}
    for element in elements:
        name = element.get("name")
        if not name:
            raise ModelError(f"{where}: a <{kind}> has no name; give it one")
        if name in named:
            raise ModelError(f"{where}: two {kind}s are named {name!r}; names must be unique")
        named[name] = element
    return named


def _joint(element: ET.Element, links: dict[str, ET.Element], where: str) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    at = f"{where}: joint {name!r}"
    if kind not in (*MOVABLE, "fixed"):
        raise ModelError(
            f"{at} has type {kind!r}; robotid handles fixed, revolute, continuous and prismatic "
            "joints (a floating base is asked for with free_flyer=True, not with a joint)"
        )
    ends = {}
    for end in ("parent", "child"):
        tag = element.find(end)
        ends[end] = tag.get("link", "") if tag is not None else ""
        if ends[end] not in links:
            raise ModelError(f"{at} has the {end} link {ends[end]!r}, which the file does not hold")
    origin, axis = element.find("origin"), element.find("axis")
    if origin is not None:
        for key in ("xyz", "rpy"):
            _numbers(origin.get(key, "0 0 0"), 3, f"{at}: origin {key}")
    if axis is not None and kind != "fixed":
        direction = _numbers(axis.get("xyz", "1 0 0"), 3, f"{at}: axis xyz")
        if math.hypot(*direction) < 1e-9:
            raise ModelError(f"{at}: axis xyz is zero; give it a direction")
    limit, mimic = element.find("limit"), element.find("mimic")
    bounds = {}
    if limit is not None and kind != "fixed":
        keys = ("velocity", "effort") + (("lower", "upper") if kind != "continuous" else ())
        for key in keys:
            if (text := limit.get(key)) is not None:
                (bounds[key],) = _numbers(text, 1, f"{at}: limit {key}")
    return Joint(name, kind, ends["parent"], ends["child"], **bounds, mimic=_mimic(mimic, at))


def _mimic(element: ET.Element | None, at: str) -> tuple[str, float, float] | None:
    if element is None:
        return None
    multiplier, offset = (
        _numbers(element.get(key, default), 1, f"{at}: mimic {key}")[0]
        for key, default in (("multiplier", "1"), ("offset", "0"))
    )
    return element.get("joint", ""), multiplier, offset


def _root(links: tuple[str, ...], joints: tuple[Joint, ...], where: str) -> str:
    parent: dict[str, str] = {}
    for joint in joints:
        if joint.child in parent:
            raise ModelError(
                f"{where}: link {joint.child!r} is the child of two joints; a URDF is a tree, so "
                "closed chains must be opened"
            )
        parent[joint.child] = joint.parent
    roots = [link for link in links if link not in parent]
    if len(roots) != 1:
        raise ModelError(f"{where}: a URDF has one root link, but this one has {listed(roots)}")
    return roots[0]


def _inertial(inertial: ET.Element, at: str) -> Inertial:
    mass, inertia, origin = (inertial.find(tag) for tag in ("mass", "inertia", "origin"))
    if mass is None or inertia is None:
        raise ModelError(f"{at} needs both <mass> and <inertia>; add the missing one")
    pose = origin.attrib if origin is not None else {}
    com, rpy = (_numbers(pose.get(key, "0 0 0"), 3, f"{at} origin {key}") for key in ("xyz", "rpy"))
    moments = [
        _numbers(inertia.get(key, "0"), 1, f"{at} {key}")[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ]
    (value,) = _numbers(mass.get("value", ""), 1, f"{at} mass")
    if value < 0:
        raise ModelError(f"{at} mass is {value:g} kg, wanted more than 0; correct the sign")
    return Inertial(value, com, rpy, tuple(moments))


def numbers(text: str) -> tuple[float, ...]:
    """Return the numbers of an attribute, none if a word is no finite number.

    Args:
        text: The attribute, numbers with blanks between them.
    """
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        return ()
    return values if all(map(math.isfinite, values)) else ()


def _numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    values = numbers(text)
    if len(values) != count:
        raise ModelError(f"{what} is {text!r}, wanted {count} finite number(s)")
    return values


def _copy(element: ET.Element, children: tuple[str, ...]) -> ET.Element:
    copy = ET.Element(element.tag, element.attrib)
    copy.extend(child for tag in children if (child := element.find(tag)) is not None)
    return copy


def _minimal_joint(element: ET.Element) -> ET.Element:
    copy = _copy(element, ("origin", "parent", "child", "axis"))
    if element.get("type") in MOVABLE:
        # the parser demands limits; the dynamics do not use them, `Joint` keeps the stated ones
        ET.SubElement(copy, "limit", lower="-1e9", upper="1e9", velocity="1e9", effort="1e9")
    return copy


def read_with_yourdfpy(path: str | Path) -> Any:  # noqa: ANN401
    """Read a URDF with yourdfpy, a reader that shares no line with this package's.

    Args:
        path: The URDF file. Meshes are not loaded.

    Returns:
        yourdfpy's ``Robot``: its damping and friction are text, and None what is not stated.

    Raises:
        ModelError: If yourdfpy cannot read the file.
    """
    import yourdfpy

    try:
        return yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    # it checks nothing by itself, so a fault of the file comes out as one of these
    except (AttributeError, IndexError, KeyError, SyntaxError, TypeError, ValueError) as error:
        fault = f"{type(error).__name__}: {error}"
        raise ModelError(f"yourdfpy cannot read {Path(path).name}: {fault}") from error
