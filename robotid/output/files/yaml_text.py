"""YAML of plain values, without a YAML package."""

from collections.abc import Iterator, Mapping
from typing import Any

from robotid.base.text import yaml_name, yaml_plain

_WIDEST = 120  # characters of a table in one line


def yaml_text(table: Mapping[str, Any], head: str) -> str:
    """Return a table as YAML after a comment."""
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_lines(table, "")]) + "\n"


def _lines(value: Mapping[str, Any], indent: str) -> Iterator[str]:
    """Yield the lines of a table; a table without tables that fits a line has one line."""
    for key, entry in value.items():
        name = f"{indent}{yaml_plain(key)}:"
        if isinstance(entry, Mapping) and (
            any(isinstance(x, Mapping) for x in entry.values()) or len(_flow(entry)) > _WIDEST
        ):
            yield name
            yield from _lines(entry, indent + "  ")
        else:
            yield f"{name} {_flow(entry)}"


def _flow(entry: Any) -> str:  # noqa: ANN401
    """Return a number, a text, a list or a table in one line."""
    if isinstance(entry, Mapping):
        return "{" + ", ".join(f"{yaml_name(key)}: {_flow(x)}" for key, x in entry.items()) + "}"
    if isinstance(entry, list):
        return "[" + ", ".join(map(_flow, entry)) + "]"
    if isinstance(entry, float):  # YAML 1.1 reads 1e-05 as text, and 1.0e-05 as a number
        mantissa, e, exponent = f"{entry:.6g}".partition("e")
        return mantissa + (".0" if e and "." not in mantissa else "") + e + exponent
    return yaml_plain(entry)
