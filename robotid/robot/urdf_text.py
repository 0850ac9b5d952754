"""The text of a URDF: its XML within bounds, its numbers as urdfdom reads them, rounded angles.

Everything that takes a number from a URDF takes it from here, so that no text is a number for one
reader and nothing for another.
"""

import logging
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from decimal import Decimal
from itertools import chain
from pathlib import Path
from typing import Any

from robotid.exceptions import ModelError

__all__ = [
    "LARGEST",
    "exact_angle",
    "number_fault",
    "numbers",
    "parse_urdf",
    "read_numbers",
    "read_with_yourdfpy",
    "write_exact_angles",
]

#: Numbers beyond this are refused, SI units: squares and products of them stay finite.
LARGEST = 1e9
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_MOST_BYTES = 2**26  # of a file; a robot of a thousand links has 2**20
_DEEPEST = 100  # elements in elements; other readers of XML allow 256
_LONGEST = 4096  # characters of an attribute, as many as a path may have
_EXACT = 1e-7  # [rad] an angle nearer than this to a multiple of pi/12 is one
_NEAR = 2e-5  # [rad] one nearer than this is meant to be one: 0.001 degrees, nobody calibrates so


def parse_urdf(path: str | Path) -> ET.Element:
    """Return the ``<robot>`` of a URDF file, whatever is in it.

    Args:
        path: The URDF file.

    Raises:
        ModelError: If the file is missing or cannot be read, is no XML or another one, or is
            larger, more nested or has longer attributes than any robot needs.
    """
    path = Path(path)
    if path.suffix == ".xacro":
        raise ModelError(f"{path.name} is xacro, not URDF; expand it first: xacro {path.name}")
    try:
        if not path.is_file():  # folders, pipes and devices are not read
            raise ModelError(f"there is no URDF file {str(path)!r}")
        size, content = path.stat().st_size, b""
        if size <= _MOST_BYTES:
            content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{_shown(str(path))} cannot be read: {error.strerror}") from error
    if size > _MOST_BYTES:
        raise ModelError(
            f"{path.name} has {size / 2**20:.0f} MiB, wanted a URDF of at most "
            f"{_MOST_BYTES // 2**20} MiB; meshes and logs go into files of their own"
        )
    if b"<!ENTITY" in content:  # a few of them can stand for more than the memory holds
        raise ModelError(f"{path.name} declares entities, which other readers of URDFs do not know")
    try:
        robot = ET.fromstring(content)  # in one piece: in pieces a long name takes its square
    except (ET.ParseError, LookupError, ValueError) as error:  # the latter two: its encoding
        raise ModelError(f"{path.name} is not well-formed XML: {error}") from error
    if robot.tag != "robot":
        raise ModelError(
            f"{path.name}: the top element is <{robot.tag[:_LONGEST]}>, wanted <robot>"
        )
    _check_bounds(robot, path.name)
    return robot


def numbers(text: str, count: int, most: float = LARGEST) -> tuple[float, ...]:
    """Return the numbers of an attribute as urdfdom reads them, none if it does not hold them.

    Args:
        text: The attribute: decimal numbers with blanks between them; none behind a single one.
        count: How many it must hold.
        most: Their largest size.
    """
    words = [word for word in text.split(" ") if word]
    if len(words) != count or not all(map(_NUMBER.fullmatch, words)):
        return ()
    values = tuple(map(float, words))
    is_usable = all(math.isfinite(x) and abs(x) <= most for x in values)
    return values if is_usable and not (count == 1 and text.endswith(" ")) else ()


def number_fault(element: ET.Element, key: str) -> str | None:
    """Return what is wrong with an attribute that must hold numbers, None if nothing is.

    Args:
        element: The element.
        key: Name of its attribute.
    """
    text, (count, most) = element.get(key), _wanted(element, key)
    if text is not None and numbers(text, count, most):
        return None
    found = "missing" if text is None else _shown(text)
    kind = "finite number" if math.isinf(most) else "number"
    amount = f"one {kind}" if count == 1 else f"{count} {kind}s with blanks between them"
    bound = "" if math.isinf(most) else f" within +-{most:g}"
    return (
        f"{element.tag} {key} is {found}, wanted {amount}{bound}, written like 0.25 or 2.5e-1 and "
        "nothing else"
    )


def read_numbers(
    element: ET.Element | None, key: str, at: str, default: tuple[float, ...] = ()
) -> tuple[float, ...]:
    """Return the numbers of an attribute.

    Args:
        element: The element; None if the file has none.
        key: Name of its attribute.
        at: What has the element, for errors.
        default: What stands for an attribute that is not stated; it must be stated if empty.

    Raises:
        ModelError: If it is missing, or is not what urdfdom reads the same way.
    """
    if default and (element is None or element.get(key) is None):
        return default
    if element is None:
        raise ModelError(f"{at} has no element with {key}; add it")
    if fault := number_fault(element, key):
        raise ModelError(f"{at} {fault}")
    return numbers(element.get(key, ""), *_wanted(element, key))


def exact_angle(word: str) -> float | None:
    """Return the multiple of pi/12 that an angle is a rounded form of, None if it is of none.

    It is one if the multiple, rounded or cut to as many decimals as the word has, is the word:
    3.14, 3.1416 and 3.1415 for pi. Quarter turns need two decimals, other multiples four. So is
    what lies within 2e-5 rad, 3.14158. An angle that was calibrated, 1.570912, has more decimals
    than it shares with pi/2, and is none.

    Args:
        word: The angle as it is written [rad].
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
    """Put the exact angle in place of each rounded one in the joints' origins.

    Args:
        robot: Root element of a URDF, which is changed.
    """
    for origin in robot.iterfind("joint/origin"):
        words = origin.get("rpy", "").split()
        exact = [exact_angle(word) for word in words]
        if any(angle is not None for angle in exact):
            pairs = zip(words, exact, strict=True)
            origin.set("rpy", " ".join(word if x is None else repr(x) for word, x in pairs))


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

    logging.getLogger("yourdfpy").addHandler(logging.NullHandler())  # its remarks say nothing new
    try:
        return yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # it checks nothing by itself: a fault of the file is any of them
        fault = f"{type(error).__name__}: {error}"
        raise ModelError(f"yourdfpy cannot read {Path(path).name}: {fault}") from error


def _wanted(element: ET.Element, key: str) -> tuple[int, float]:
    """Return how many numbers an attribute holds, and their largest size."""
    # limits and damping do not reach the dynamics, and some exporters write 1e308 for "no limit"
    most = math.inf if element.tag in ("limit", "dynamics") else LARGEST
    return 3 if key in ("xyz", "rpy") else 1, most


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else f"{text[:77]}...")


def _check_bounds(robot: ET.Element, where: str) -> None:
    """Raise if elements are nested or attributes are long beyond any use."""
    level, depth = [robot], 0
    while level:
        level, depth = [child for element in level for child in element], depth + 1
        if depth > _DEEPEST:
            raise ModelError(
                f"{where}: elements are nested {depth} deep, wanted at most {_DEEPEST}; a URDF "
                "needs six"
            )
    for element, key, text in _attributes(robot):
        if len(text) > _LONGEST:
            raise ModelError(
                f"{where}: <{element.tag[:80]}>: {key[:80]} has {len(text)} characters, wanted at "
                f"most {_LONGEST}; it begins with {_shown(text)}"
            )


def _attributes(robot: ET.Element) -> Iterator[tuple[ET.Element, str, str]]:
    owners = chain([robot], *(o.iter() for tag in ("link", "joint") for o in robot.iterfind(tag)))
    return ((element, key, text) for element in owners for key, text in element.items())
