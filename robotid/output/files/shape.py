"""Schemas of the JSON files that are read, one per kind of file; checked before any use.

A schema is plain JSON: the name of a kind ("text", "number or null", "good, usable, poor"),
``[schema]`` for the entries of a list, ``[schema, n]`` for those of a list of n, ``{key: schema}``
for a table, where ``"key?"`` is optional, or ``{"*": schema}`` for a table whose keys are names.
Other keys are ignored.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.settings import shown

_ASSETS = Path(__file__).parent / "assets"
_LARGEST = 1e100  # values of a robot are smaller; results of larger values may overflow
_KINDS: dict[str, tuple[type, ...]] = {
    "text": (str,), "text or null": (str, type(None)), "number": (int, float), "flag": (bool,),
    "number or null": (int, float, type(None)), "table": (dict,), "list": (list,),
}  # fmt: skip
_WORDS = {
    "number": "a number", "number or null": "a number", "flag": "true or false",
    "table": "a table", "list": "a list", "text or null": "text",
}  # fmt: skip


@cache
def schema(name: str) -> Any:  # noqa: ANN401
    """Return a schema of the folder assets."""
    return json.loads((_ASSETS / f"{name}.json").read_text(encoding="utf-8"))


def check_shape(value: Any, wanted: Any, at: str) -> None:  # noqa: ANN401
    """Refuse a value that does not match a schema."""
    if isinstance(wanted, Mapping):
        _check_kind(value, "table", at)
        if "*" in wanted:
            wanted = dict.fromkeys(value, wanted["*"])
        for key, inner in wanted.items():
            name = key.removesuffix("?")
            if name in value:
                check_shape(value[name], inner, f"{at}.{name[:80]}")
            elif name == key:
                raise DataError(
                    f"{at} has no entry {name!r}: the file is incomplete. Write it again"
                )
    elif isinstance(wanted, list):
        _check_kind(value, "list", at)
        require_lengths(value, wanted[1:], at)
        for k, entry in enumerate(value):
            check_shape(entry, wanted[0], f"{at}[{k}]")
    elif wanted == "file":
        if not isinstance(value, str) or Path(value).name != value or "\0" in value:
            raise DataError(f"{at} is {shown(value)}, expected a file name in the same folder")
    elif wanted in _KINDS:
        _check_kind(value, wanted, at)
    elif value not in wanted.split(", "):
        raise DataError(f"{at} is {shown(value)}, expected one of {wanted}")


def require_lengths(value: Any, shape: Sequence[int], at: str) -> None:  # noqa: ANN401
    """Refuse nested lists of other lengths."""
    if shape and len(value) != shape[0]:
        raise DataError(f"{at} has {len(value)} entries, expected {shape[0]}")
    for k, entry in enumerate(value if shape[1:] else ()):
        require_lengths(entry, shape[1:], f"{at}[{k}]")


def _check_kind(value: object, kind: str, at: str) -> None:
    kinds = _KINDS[kind]
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise DataError(f"{at} is {shown(value)}, expected {_WORDS.get(kind, kind)}")
    if isinstance(value, int | float) and abs(value) > _LARGEST:
        raise DataError(f"{at} is {shown(value)}, expected a number of at most {_LARGEST:g}")
