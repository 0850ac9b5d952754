"""The shape of JSON that is read back: one schema per kind of file, checked before anything else.

A schema is a type or a tuple of types, a ``Range`` of words, ``[schema]`` of a list's entries,
``{key: schema}`` of a table, where ``"key?"`` may be missing, or ``{...: schema}`` of a table whose
keys are names. Keys that a schema does not have are left alone.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotid._settings import Range
from robotid.exceptions import DataError

__all__ = ["FILE", "FLAG", "MAYBE", "NUMBER", "TABLE", "TEXT", "check_shape"]

TEXT, NUMBER, FLAG, TABLE = (str,), (int, float), (bool,), (dict,)
FILE = Range("the name of a file beside it", lambda x: Path(x).name == x and "\0" not in x)
MAYBE = (int, float, type(None))
_LARGEST = 1e100  # no figure of a robot is larger, and what is computed from it is still a number
_NAMES = {str: "text", int: "a number", bool: "true or false", dict: "a table", list: "a list"}


def check_shape(value: Any, wanted: Any, at: str) -> None:  # noqa: ANN401
    """Refuse a value that is not of a schema.

    Args:
        value: What JSON holds.
        wanted: The schema.
        at: What the value is called, for errors.

    Raises:
        DataError: If a key is missing, or a value is of another type or out of its range.
    """
    if isinstance(wanted, Mapping):
        _check_type(value, (dict,), at)
        if ... in wanted:
            wanted = dict.fromkeys(value, wanted[...])
        for key, inner in wanted.items():
            name = key.removesuffix("?")
            if name in value:
                check_shape(value[name], inner, f"{at}.{name[:80]}")
            elif name == key:
                raise DataError(f"{at} has no entry {name!r}: it is not whole; make it anew")
    elif isinstance(wanted, list):
        _check_type(value, (list,), at)
        for k, entry in enumerate(value):
            check_shape(entry, wanted[0], f"{at}[{k}]")
    elif isinstance(wanted, Range):
        if not isinstance(value, str) or not wanted.holds(value):
            raise DataError(f"{at} is {_shown(value)}, wanted {wanted.words}")
    else:
        _check_type(value, wanted, at)


def _check_type(value: object, kinds: tuple[type, ...], at: str) -> None:
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise DataError(f"{at} is {_shown(value)}, wanted {_NAMES[kinds[0]]}")
    if isinstance(value, int | float) and abs(value) > _LARGEST:
        raise DataError(f"{at} is {_shown(value)}, wanted a number of at most {_LARGEST:g}")


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
