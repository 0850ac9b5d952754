"""The text of a URDF: checked XML, numbers, rounded angles."""

import logging
import math
import re
import xml.etree.ElementTree as ET
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import Any
from xml.parsers import expat

from robotid.base.exceptions import ModelError
from robotid.base.files import DEEPEST, LONGEST_PATH, missing_file

#: Largest absolute value of numbers, SI units: squares and products of them stay finite.
LARGEST = 1e9
_BLANKS = " \t\n\r\f\v"  # that separate numbers
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOST_BYTES = 2**26  # of a file; that of a robot with a thousand links has 2**20
_EXACT = 1e-7  # [rad] an angle within this of a multiple of pi/12 counts as exact
_NEAR = 2e-5  # [rad] one within this (0.001 degrees) counts as rounded, not as calibrated


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
            f"{path.name} has {size / 2**20:.0f} MiB, wanted a URDF of at most "
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
            f"{path.name} is not well-formed XML: {error}; wanted a URDF file"
        ) from error
    if robot.tag != "robot":
        raise ModelError(
            f"{path.name}: the top element is <{robot.tag[:LONGEST_PATH]}>, wanted <robot>"
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
    return f"{element.tag} {key} is {found}, wanted {amount}{bound}, written like 0.25 or 2.5e-1"


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
    """Return the multiple of pi/12 that an angle approximates, None if it is not a rounded one.

    The multiple, rounded or truncated to the angle's decimals (two for pi/2, else four), is equal
    to it, as 3.1415; or they are within 2e-5 rad. A calibrated angle, as 1.570912, is none.
    """
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


def write_exact_angles(robot: ET.Element) -> None:
    """Replace each rounded angle in the joints' origins by the exact one."""
    for origin in robot.iterfind("joint/origin"):
        words = origin.get("rpy", "").split()
        exact = [exact_angle(word) for word in words]
        if any(angle is not None for angle in exact):
            pairs = zip(words, exact, strict=True)
            origin.set("rpy", " ".join(word if x is None else repr(x) for word, x in pairs))


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
                f"{where}: elements are nested {depth} levels deep, wanted at most {DEEPEST}; a "
                "URDF needs six"
            )
    owners = chain([robot], *(o.iter() for tag in ("link", "joint") for o in robot.iterfind(tag)))
    for element, key, text in ((x, *item) for x in owners for item in x.items()):
        if len(text) > LONGEST_PATH:
            raise ModelError(
                f"{where}: <{element.tag[:80]}>: {key[:80]} has {len(text)} characters, wanted at "
                f"most {LONGEST_PATH}; it starts with {_shown(text)}"
            )
