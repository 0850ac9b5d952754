"""The drive settings of a job: families in ``friction``, terms and families in [drives]."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed, toml_key
from robotid.base.settings import is_number, require_kind
from robotid.robot.drives import FAMILIES, TERM_CLASSES, DriveTerm

#: Value of ``friction`` with which the families of each joint are chosen.
AUTO = "auto"
_OF_MODEL = ("none", "viscous", "coulomb")  # allowed in ``friction``, and terms of the model
_SPARE = 1.1  # factor on the range that a family needs, from which it is advised


def spring_family(turned: float, *families: str) -> str:
    """Return the first spring family whose required range a joint covered."""
    return next((name for name in families if has_turned(name, turned)), "spring")


def has_turned(family: str, turned: float) -> bool:
    """Return whether a joint covered 1.1 times the range of positions that a family needs."""
    return _SPARE * FAMILIES[family].needs * 2 * np.pi <= turned


def drive_line(joint: str, *entries: str | DriveTerm) -> str:
    """Return the line of a job's [drives] with the families or terms of a joint."""
    return f"{toml_key(joint)} = [{', '.join(map(_toml_entry, entries))}]"


def _toml_entry(entry: str | DriveTerm) -> str:
    if isinstance(entry, str):
        return json.dumps(entry)
    table = {key: value for key, value in entry.to_dict().items() if key != "data_range"}
    return "{ " + ", ".join(f"{key} = {json.dumps(x)}" for key, x in table.items()) + " }"


def wanted_families(
    friction: str | Mapping[str, str], joints: Sequence[str]
) -> dict[str, tuple[str, ...] | None]:
    """Return the names of each joint's families; None where they are chosen from the data."""
    wanted_kind = "auto, names of families joined by +, or a table of these by joint"
    require_kind(friction, (str, Mapping), "friction", wanted_kind)
    for joint, names in friction.items() if isinstance(friction, Mapping) else ():
        require_kind(names, str, f"friction of {joint}", wanted_kind)
    stated = {"*": friction} if isinstance(friction, str) else {"*": AUTO, **friction}
    unknown_joints = [joint for joint in stated if joint not in (*joints, "*")]
    if unknown_joints:
        raise SettingsError(
            f"friction is stated for {listed(unknown_joints)}, wanted joints that are identified: "
            f"{listed(joints)}"
        )
    wanted: dict[str, tuple[str, ...] | None] = {}
    for joint in joints:
        names = stated.get(joint, stated["*"])
        own = [name for name in names.split("+") if name and name not in _OF_MODEL]
        unknown = [name for name in own if name not in FAMILIES]
        if names != AUTO and unknown:
            raise SettingsError(
                f"friction of {joint} has {listed(unknown)}, wanted auto, or some of "
                f"{listed(FAMILIES)}"
            )
        wanted[joint] = None if names == AUTO else tuple(own)
    return wanted


def term_from_dict(table: Mapping[str, Any]) -> DriveTerm:
    """Return a term from its plain values, as of ``DriveTerm.to_dict``."""
    if not isinstance(table, Mapping):
        raise SettingsError(
            f"a drive term is {table!r}, wanted a table, for example "
            "{ term = 'Stribeck', speed = 0.1 }"
        )
    kind = TERM_CLASSES.get(str(table.get("term")))
    if kind is None:
        raise SettingsError(f"term is {table.get('term')!r}, wanted one of {listed(TERM_CLASSES)}")
    known = {field.name: field.default for field in fields(kind)}
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "term":
            continue
        if key not in known:
            raise SettingsError(f"{kind.__name__} has no {key!r}; it has {listed(known)}")
        values[key] = _read_field(kind, key, value, known[key])
    return kind(**values)


def _read_field(kind: type[DriveTerm], key: str, value: object, default: object) -> object:
    if key == "data_range":
        if isinstance(value, Sequence) and len(value) == 2 and all(map(is_number, value)):
            return (float(value[0]), float(value[1]))
        raise SettingsError(f"{kind.__name__}: data_range is {value!r}, wanted [lowest, highest]")
    is_flag = isinstance(default, bool)
    if is_flag is not isinstance(value, bool) or not (is_flag or is_number(value)):
        wanted = "true or false" if is_flag else "a finite number"
        raise SettingsError(f"{kind.__name__}: {key} is {value!r}, wanted {wanted}")
    return type(default)(value)  # type: ignore[call-arg]
