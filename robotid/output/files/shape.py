"""Schemas of the JSON files that are read, one per kind of file; checked before any use.

A schema is a type or a tuple of types, a ``Range`` of words, ``[schema]`` for the entries of a
list, ``[schema] * n`` for those of a list of n, ``{key: schema}`` for a table, where ``"key?"`` is
optional, or ``{...: schema}`` for a table whose keys are names. Other keys are ignored.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.settings import Range

TEXT, NUMBER, FLAG, TABLE = (str,), (int, float), (bool,), (dict,)
FILE = Range("the name of a file in the same folder", lambda x: Path(x).name == x and "\0" not in x)
MAYBE = (int, float, type(None))
_LARGEST = 1e100  # values of a robot are smaller; results of larger values may overflow
_NAMES = {str: "text", int: "a number", bool: "true or false", dict: "a table", list: "a list"}


def check_shape(value: Any, wanted: Any, at: str) -> None:  # noqa: ANN401
    """Refuse a value that does not match a schema."""
    if isinstance(wanted, Mapping):
        _check_type(value, (dict,), at)
        if ... in wanted:
            wanted = dict.fromkeys(value, wanted[...])
        for key, inner in wanted.items():
            name = key.removesuffix("?")
            if name in value:
                check_shape(value[name], inner, f"{at}.{name[:80]}")
            elif name == key:
                raise DataError(
                    f"{at} has no entry {name!r}: the file is incomplete. Write it again"
                )
    elif isinstance(wanted, list):
        _check_type(value, (list,), at)
        require_lengths(value, [len(wanted)] if len(wanted) > 1 else [], at)
        for k, entry in enumerate(value):
            check_shape(entry, wanted[0], f"{at}[{k}]")
    elif isinstance(wanted, Range):
        if not isinstance(value, str) or not wanted.holds(value):
            raise DataError(f"{at} is {_shown(value)}, wanted {wanted.words}")
    else:
        _check_type(value, wanted, at)


def require_lengths(value: Any, shape: Sequence[int], at: str) -> None:  # noqa: ANN401
    """Refuse nested lists of other lengths."""
    if shape and len(value) != shape[0]:
        raise DataError(f"{at} has {len(value)} entries, wanted {shape[0]}")
    for k, entry in enumerate(value if shape[1:] else ()):
        require_lengths(entry, shape[1:], f"{at}[{k}]")


def _check_type(value: object, kinds: tuple[type, ...], at: str) -> None:
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise DataError(f"{at} is {_shown(value)}, wanted {_NAMES[kinds[0]]}")
    if isinstance(value, int | float) and abs(value) > _LARGEST:
        raise DataError(f"{at} is {_shown(value)}, wanted a number of at most {_LARGEST:g}")


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
