"""Keys of result.json that had other names before version 0.2.

For one minor version they are written under both names and read under either name.
"""

from collections.abc import Iterator, Mapping
from typing import Any

from robotid.findings import current_code

__all__ = ["from_former_keys", "with_former_keys"]

#: Path of each key, "*" for any key or entry on the way, and the former name of its last part.
FORMER: Mapping[str, str] = {
    "scale_check": "witness",
    "structure.indistinguishable": "not_told_apart",
    "uncertainty.segments": "stretches",
    "inputs.*.segments": "stretches",
    "verdict.log_errors": "alarms",
    "verdict.warnings": "doubts",
    "friction.*.data_range": "seen",
    "friction.*.tried.*.p_value": "chance",
    "friction.*.tried.*.is_selected": "is_taken",
    "own_terms.*.*.data_range": "seen",
    "validation.*.band.*.coverage_pct": "held_pct",
    "standard_parameters.*.quantile": "reach",
    "drive_parameters.*.quantile": "reach",
}


def with_former_keys(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of result.json with each renamed key also under its former name.

    Args:
        content: The content, with current names.
    """
    result: dict[str, Any] = _copied(content)
    for path, former in FORMER.items():
        *parts, name = path.split(".")
        for table in _tables(result, parts):
            if name in table:
                table[former] = table[name]
    return result


def from_former_keys(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a result.json with current names only.

    Args:
        content: The content as read: with current names, former names, or both.
    """
    result: dict[str, Any] = _copied(content)
    for path, former in FORMER.items():
        *parts, name = path.split(".")
        for table in _tables(result, parts):
            if former in table:
                table.setdefault(name, table.pop(former))
                table.pop(former, None)
    for finding in _tables(result, ["warnings", "*"]):
        if isinstance(finding.get("code"), str):
            finding["code"] = current_code(finding["code"])
    return result


def _tables(content: Any, path: list[str]) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    """Yield the tables at a path."""
    if not path:
        if isinstance(content, dict):
            yield content
        return
    first, rest = path[0], path[1:]
    if first == "*":
        values = content.values() if isinstance(content, dict) else content
        inside = list(values) if isinstance(content, (dict, list)) else []
    else:
        inside = [content[first]] if isinstance(content, dict) and first in content else []
    for each in inside:
        yield from _tables(each, rest)


def _copied(content: Any) -> Any:  # noqa: ANN401
    """Return a copy of tables and lists, so that the caller's are not changed."""
    if isinstance(content, Mapping):
        return {key: _copied(value) for key, value in content.items()}
    return [_copied(value) for value in content] if isinstance(content, list) else content
