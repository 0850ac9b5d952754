"""The only parser of URDFs: each fault raises an error; Pinocchio receives the tree alone."""

import copy
import logging
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

import numpy as np

from robotid.base.exceptions import ModelError
from robotid.base.files import DEEPEST, LONGEST_PATH, missing_file
from robotid.base.findings import listed, suggestion

#: Largest absolute value of numbers, SI units: squares and products of them stay finite.
LARGEST = 1e9
_BLANKS = " \t\n\r\f\v"  # that separate numbers
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOST_BYTES = 2**26  # of a file; that of a robot with a thousand links has 2**20
_EXACT = 1e-7  # [rad] an angle within this of a multiple of pi/12 counts as exact
_NEAR = 2e-5  # [rad] one within this (0.001 degrees) counts as rounded, not as calibrated
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

    @property
    def xml(self) -> str:
        """Its element in a URDF."""
        moments = " ".join(f'{key}="{x!r}"' for key, x in zip(MOMENTS, self.inertia, strict=True))
        return (
            f'<inertial>{_origin(self.com, self.rpy)}<mass value="{self.mass!r}"/>'
            f"<inertia {moments}/></inertial>"
        )


@dataclass(frozen=True)
class Joint:
    """One ``<joint>`` of a URDF."""

    name: str  # its name
    type: str  # fixed, revolute, continuous or prismatic
    parent: str  # parent link
    child: str  # child link
    lower: float = -math.inf  # lower position limit [rad or m], -inf if none is given
    upper: float = math.inf  # upper position limit [rad or m], inf if none is given
    velocity: float = math.inf  # velocity limit [rad/s or m/s], inf if none is given
    effort: float = math.inf  # effort limit [N m or N], inf if none is given
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
    def xml(self) -> str:
        """Its element in a URDF without limits, which Pinocchio requires and does not use."""
        motion = (
            f'<axis xyz="{" ".join(map(repr, self.axis))}"/>'
            '<limit lower="-1e9" upper="1e9" velocity="1e9" effort="1e9"/>'
        )
        return (
            f'<joint name={quoteattr(self.name)} type="{self.type}">{_origin(self.xyz, self.rpy)}'
            f"<parent link={quoteattr(self.parent)}/><child link={quoteattr(self.child)}/>"
            f"{motion if self.is_movable else ''}</joint>"
        )

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
                    f"{text!r}, expected a number"
                ) from error
        return found

    @property
    def carriers(self) -> dict[str, list[str]]:
        """Names of the joints that carry each joint, by its name."""
        arriving = {joint.child: joint for joint in self.joints}
        carriers = dict[str, list[str]]()
        for joint in self.joints:
            at, above = joint, carriers.setdefault(joint.name, [])
            while at.parent in arriving:
                at = arriving[at.parent]
                above.append(at.name)
        return carriers

    @property
    def xml(self) -> str:
        """A URDF with only the links, inertials and joints, with the numbers read here."""
        inertials = {link: inertial.xml for link, inertial in self.inertials.items()}
        links = [f"<link name={quoteattr(x)}>{inertials.get(x, '')}</link>" for x in self.links]
        joints = [joint.xml for joint in self.joints]
        return f"<robot name={quoteattr(self.name)}>{''.join([*links, *joints])}</robot>"

    def snapped(self) -> "Tree":
        """Return the same robot with exact angles for the rounded ones of its joints' origins."""
        robot = copy.deepcopy(self.robot)
        for origin in robot.iterfind("joint/origin[@rpy]"):
            words = origin.get("rpy", "").split()
            exact = [exact_angle(word) for word in words]
            pairs = zip(words, exact, strict=True)
            origin.set("rpy", " ".join(word if x is None else repr(x) for word, x in pairs))
        return _tree(robot, self.path)


def _origin(xyz: Sequence[float], rpy: Sequence[float]) -> str:
    return f'<origin xyz="{" ".join(map(repr, xyz))}" rpy="{" ".join(map(repr, rpy))}"/>'


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
            raise ModelError(f"{where}: two {kind}s are named {name!r}, expected unique names")
        named[name] = element
    return named


def _joint(element: ET.Element, links: dict[str, ET.Element], where: str) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    at = f"{where}: joint {name!r}"
    if kind not in (*MOVABLE, "fixed"):
        raise ModelError(
            f"{at} has type {kind!r}, expected fixed, revolute, continuous or prismatic (for a "
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
        raise ModelError(f"{at}: axis xyz is zero, expected a direction")
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
        raise ModelError(f"{at} origin has quat_xyzw, expected rpy; convert it to rpy angles")
    none = (0.0, 0.0, 0.0)
    return read_numbers(origin, "xyz", at, none), read_numbers(origin, "rpy", at, none)


def _root(links: tuple[str, ...], joints: tuple[Joint, ...], where: str) -> str:
    """Return the root link, after checking that all others are connected to it."""
    children: dict[str, list[str]] = {link: [] for link in links}
    moved: set[str] = set()
    for joint in joints:
        if joint.child in moved:
            raise ModelError(
                f"{where}: link {joint.child!r} is the child of two joints, expected one; open the "
                "closed kinematic chain"
            )
        moved.add(joint.child)
        children[joint.parent].append(joint.child)
    level = roots = [link for link in links if link not in moved]
    if len(roots) != 1:
        raise ModelError(f"{where}: the root links are {listed(roots, 9)}, expected exactly one")
    reached, depth = set(roots), 0
    while level:
        level = [child for link in level for child in children[link]]
        reached.update(level)
        depth += 1
        if depth > _DEEPEST:
            raise ModelError(
                f"{where}: a chain has more than {_DEEPEST} joints in series, expected at most "
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
        raise ModelError(f"{at} mass is {value:g} kg, expected more than 0; correct the sign")
    if 0 < value < _LIGHTEST:
        raise ModelError(f"{at} mass is {value:g} kg, expected 0 or at least {_LIGHTEST:g}")
    moments = tuple(read_numbers(inertia, key, at)[0] for key in MOMENTS)
    return Inertial(value, com, rpy, moments)


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
            "locked has '*' (all joints that are not named), but joints is not given; list the "
            "joints to identify in joints"
        )
    moving = tuple(name for name in free if name not in locked) if joints is None else tuple(joints)
    both = [name for name in moving if name in locked]
    if both:
        raise ModelError(f"joints {listed(both)} are in both joints and locked; remove them in one")
    if len(set(moving)) != len(moving):
        raise ModelError(f"joints is {listed(moving)}, expected each name once")
    if len(moving) > _MOST_JOINTS:
        raise ModelError(
            f"{Path(tree.path).name}: {len(moving)} joints move, expected at most {_MOST_JOINTS}; "
            "list the joints to identify in joints, or lock others"
        )
    for name, position in locked.items():
        is_number = isinstance(position, int | float | np.number)
        if not is_number or not abs(position) <= LARGEST:
            raise ModelError(
                f"joint {name!r} is locked at {position!r}, expected a number within +-{LARGEST:g} "
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
            raise ModelError(
                f"joint {name!r} is not in {Path(tree.path).name}; joints: {listed(known)}"
                f"{suggestion(name, known)}"
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
                    f"joint {joint.name!r} mimics {leader!r}, expected another movable joint that "
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
                f"offset of {offset:g}, expected numbers within +-{LARGEST:g}; correct the <mimic>"
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


def parse_urdf(path: str | Path) -> ET.Element:
    """Return the ``<robot>`` of a URDF file, without checking its content."""
    path = Path(path)
    if path.suffix == ".xacro":
        raise ModelError(f"{path.name} is xacro, not URDF; expand it first: xacro {path.name}")
    try:
        if not path.is_file():  # folders, pipes and devices are not read
            raise ModelError(missing_file(path, "URDF file"))
        size, content = path.stat().st_size, b""
        if size <= _MOST_BYTES:
            content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{_shown(str(path))} cannot be read: {error.strerror}") from error
    if size > _MOST_BYTES:
        raise ModelError(
            f"{path.name} has {size / 2**20:.0f} MiB, expected a URDF of at most "
            f"{_MOST_BYTES // 2**20} MiB; move meshes and logs to separate files"
        )
    if b"<!ENTITY" in content:  # a few of them can expand beyond the memory
        raise ModelError(
            f"{path.name} declares XML entities, which other URDF parsers do not support; replace "
            "them by their text"
        )
    try:
        robot = _parsed(content)
    except (expat.ExpatError, LookupError, ValueError) as error:  # the latter two: its encoding
        raise ModelError(
            f"{path.name} is not well-formed XML: {error}; expected a URDF file"
        ) from error
    if robot.tag != "robot":
        raise ModelError(
            f"{path.name}: the top element is <{robot.tag[:LONGEST_PATH]}>, expected <robot>; "
            "convert it to URDF"
        )
    _check_bounds(robot, path.name)
    return robot


def _parsed(content: bytes) -> ET.Element:
    """Return the top element; prefixes of names, as sensor:camera, need no declaration."""
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    parser.Parse(content, True)  # as a whole: in parts a long name takes quadratic time
    return builder.close()


def numbers(text: str, count: int, most: float = LARGEST) -> tuple[float, ...]:
    """Return the numbers of an attribute, none if it is not valid."""
    words = re.findall(f"[^{_BLANKS}]+", text)
    if len(words) != count or not all(map(_NUMBER.fullmatch, words)):
        return ()
    values = tuple(map(float, words))
    is_usable = all(math.isfinite(x) and abs(x) <= most for x in values)
    return values if is_usable else ()


def number_fault(element: ET.Element, key: str) -> str | None:
    """Return the fault of an attribute that must be numbers, None if there is none."""
    text, (count, most) = element.get(key), _wanted(element, key)
    if text is not None and numbers(text, count, most):
        return None
    found = "missing" if text is None else _shown(text)
    kind = "finite number" if math.isinf(most) else "number"
    amount = f"one {kind}" if count == 1 else f"{count} {kind}s separated by blanks"
    bound = "" if math.isinf(most) else f" within +-{most:g}"
    return f"{element.tag} {key} is {found}, expected {amount}{bound}, written like 0.25 or 2.5e-1"


def read_numbers(
    element: ET.Element | None, key: str, at: str, default: tuple[float, ...] = ()
) -> tuple[float, ...]:
    """Return the numbers of an attribute."""
    if default and (element is None or element.get(key) is None):
        return default
    if element is None:
        raise ModelError(f"{at} has no element with {key}; add it")
    if fault := number_fault(element, key):
        raise ModelError(f"{at} {fault}")
    return numbers(element.get(key, ""), *_wanted(element, key))


def exact_angle(word: str) -> float | None:
    """Return the multiple of pi/12 of a rounded angle, as 3.1415; None of another, as 1.570912."""
    values = numbers(word, 1)
    twelfths = round(values[0] / (math.pi / 12)) if values else 0
    if twelfths == 0:
        return None
    exact = twelfths / 12 * math.pi
    exponent = Decimal(word.strip()).normalize().as_tuple().exponent
    decimals = -exponent if isinstance(exponent, int) else 0
    unit, gap = 10.0**-decimals, abs(exact) - abs(values[0])
    is_rounded = -0.5 * unit <= gap < unit and decimals >= (2 if twelfths % 6 == 0 else 4)
    return exact if abs(gap) > _EXACT and (is_rounded or abs(gap) < _NEAR) else None


def read_with_yourdfpy(path: str | Path) -> Any:  # noqa: ANN401
    """Read a URDF with yourdfpy, a reader independent of this package's."""
    import yourdfpy

    logging.getLogger("yourdfpy").addHandler(logging.NullHandler())  # its messages are not needed
    try:
        return yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # it checks nothing, so a faulty file raises errors of any kind
        fault = f"{type(error).__name__}: {error}"
        raise ModelError(f"yourdfpy cannot read {Path(path).name}: {fault}") from error


def _wanted(element: ET.Element, key: str) -> tuple[int, float]:
    """Return the number of an attribute's numbers, and their largest absolute value."""
    # limits and damping do not affect the dynamics; some exporters write 1e308 for "no limit"
    most = math.inf if element.tag in ("limit", "dynamics") else LARGEST
    return 3 if key in ("xyz", "rpy") else 1, most


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:77]}...")


def _check_bounds(robot: ET.Element, where: str) -> None:
    """Raise if elements are nested too deep or attributes are too long."""
    level, depth = [robot], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
        if depth > DEEPEST:
            raise ModelError(
                f"{where}: elements are nested {depth} levels deep, expected at most {DEEPEST}; a "
                "URDF needs six"
            )
    owners = chain([robot], *(o.iter() for tag in ("link", "joint") for o in robot.iterfind(tag)))
    for element, key, text in ((x, *item) for x in owners for item in x.items()):
        if len(text) > LONGEST_PATH:
            raise ModelError(
                f"{where}: <{element.tag[:80]}>: {key[:80]} has {len(text)} characters, expected "
                f"at most {LONGEST_PATH}; it starts with {_shown(text)}"
            )
