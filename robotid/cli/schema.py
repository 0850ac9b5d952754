"""robotid schema: print the JSON schema of job files, for editors."""

import argparse
import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

from robotid.base.settings import REQUIRED, Entries, Key, Settings
from robotid.cli.job import Job, LogEntry, PayloadEntry
from robotid.data.signal_settings import Transmission
from robotid.estimation.fitting.estimator_settings import ESTIMATORS, ConstraintSettings
from robotid.robot.constraints import Contact, Loop
from robotid.robot.parameters import Coupling

_DRAFT = "https://json-schema.org/draft/2020-12/schema"
_NAMES = {str: "string", datetime: "string", bool: "boolean", int: "integer", float: "number"}
_NAMES |= {list: "array", dict: "object"}
_TABLES: Mapping[str, type[Settings]] = {
    "identification": LogEntry,
    "validation": LogEntry,
    "payload_check": PayloadEntry,
    "transmission": Transmission,
    "coupling": Coupling,
    "contact": Contact,
    "loop": Loop,
    "estimator.constraints": ConstraintSettings,
}  # whose keys a job's own paths do not have


def job_schema() -> dict[str, Any]:
    """Return the JSON schema of a job file: every key, its types and its description."""
    keys = dict(Job.paths())
    for kind in ESTIMATORS.values():
        keys |= {f"estimator.{name}": key for name, key in kind.paths().items()}
    keys["estimator.name"] = Job.paths()["estimator.name"]
    for at, inside in _TABLES.items():
        keys |= {f"{at}.{name}": key for name, key in inside.paths().items()}
    table = _table(Job.schema(), keys, "")
    return {"$schema": _DRAFT, "title": "robotid job file", **table, "required": ["urdf"]}


def _table(schema: Mapping[str, Any], keys: Mapping[str, Key], at: str) -> dict[str, Any]:
    """Return the schema of a table whose name ends in a dot, or of the whole file."""
    properties = {name: _value(kind, keys, f"{at}{name}") for name, kind in schema.items()}
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _value(kind: Any, keys: Mapping[str, Key], at: str) -> dict[str, Any]:  # noqa: ANN401
    """Return the schema of what a key holds, as of ``Settings.schema``."""
    key = keys.get(at)
    about: dict[str, Any] = {} if key is None else {"description": key.words}
    if isinstance(kind, Mapping):
        return _table(kind, keys, f"{at}.") | about
    if isinstance(kind, list):
        required = [name for name in REQUIRED if name in kind[0]]
        return {"type": "array", "items": _table(kind[0], keys, f"{at}.") | {"required": required}}
    if isinstance(kind, Entries):
        inner = {"type": _types(kind.inner)}
        if kind.outer is dict:
            return {"type": "object", "additionalProperties": inner} | about
        count = {} if kind.count is None else {"minItems": kind.count, "maxItems": kind.count}
        return {"type": "array", "items": inner, **count} | about
    if key is not None and key.among and str in kind:
        others = [other for other in kind if other is not str]
        words: dict[str, Any] = {"enum": list(key.among)}
        return ({"anyOf": [words, {"type": _types(tuple(others))}]} if others else words) | about
    return {"type": _types(kind)} | about


def _types(kinds: tuple[type, ...]) -> list[str]:
    """Return the names that JSON schema has for types; its numbers may be whole."""
    kinds = tuple(kind for kind in kinds if not (kind is int and float in kinds))
    return list(dict.fromkeys(_NAMES[kind] for kind in kinds))


def add_flags(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "robotid schema > job.schema.json; the first line of the job file is then "
        "#:schema job.schema.json"
    )


def run(options: argparse.Namespace) -> None:
    print(json.dumps(job_schema(), indent=2))
