"""The keys that a job file may have, and the check that it has no others."""

import difflib
from collections.abc import Mapping
from typing import Any

from robotid.exceptions import SettingsError
from robotid.robot.drives import TERMS

__all__ = ["KEYS", "check_keys"]

_NUMBER = (int, float)

#: The keys of a job file: a type or types, a table of keys, or [a table] repeated.
KEYS: dict[str, Any] = {
    "urdf": str,
    "joints": list,
    "locked": dict,
    "gravity": list,
    "free_flyer": bool,
    "mimic": str,
    "signals": {
        "rate": _NUMBER,
        "cutoff": (*_NUMBER, bool),
        "order": int,
        "velocity": str,
        "acceleration": str,
        "trim": _NUMBER,
        "min_velocity": _NUMBER,
        "friction_band": _NUMBER,
        "max_gap": _NUMBER,
        "torque_delay": _NUMBER,
        "velocity_delay": _NUMBER,
    },
    "doctor": {"ignore": list},
    "model": {
        "friction" if term.is_friction else name: str if term.is_friction else bool
        for name, term in TERMS.items()
    },
    "torque": {"gains": dict},
    "columns": dict,
    "log": {"topic": str, "joints": dict, "effort": str, "stamp": str},
    "units": {"time": str, "angle": str},
    "coupling": [{"name": str, "ratios": dict}],
    "estimator": {
        "name": str,
        "margin": _NUMBER,
        "prior": str,
        "prior_weight": (*_NUMBER, str),
        "solver": str,
        "check": bool,
        "draws": int,
        "robust": str,
        "regressor_noise": _NUMBER,
        "starts": int,
        "constraints": {
            "mass": dict,
            "total_mass": (*_NUMBER, list),
            "com": dict,
            "com_within": str,
            "pinned": list,
        },
        "forgetting": _NUMBER,
        "walk": _NUMBER,
        "gate": (*_NUMBER, bool),
        "step": str,
        "metric": str,
        "average": bool,
        "passes": int,
        "seed": int,
        "step_size": _NUMBER,
        "physical": bool,
    },
    "output": {"dynamics": bool},
    "reduction": {"rows_in_memory": int, "workers": int},
    "identification": [{"log": str, "start": _NUMBER, "end": _NUMBER}],
    "validation": [{"log": str, "start": _NUMBER, "end": _NUMBER}],
}


def check_keys(
    table: Mapping[str, Any], schema: Mapping[str, Any], where: str, section: str = ""
) -> None:
    """Refuse keys that are not in the schema and values of another type.

    Args:
        table: What was given.
        schema: The known keys, as ``KEYS``.
        where: Name of its source, for errors.
        section: Table that it is in, with a dot at its end, for errors.

    Raises:
        SettingsError: If a key is unknown or missing, or its value has another type.
    """
    for key, value in table.items():
        at = f"{where}: {section}{key}"
        if key not in schema:
            near = difflib.get_close_matches(key, schema, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise SettingsError(f"{at} is not a known key{hint} Known: {sorted(schema)}")
        wanted = schema[key]
        if isinstance(wanted, dict):
            if not isinstance(value, Mapping):
                raise SettingsError(f"{at} is {value!r}, wanted a table [{section}{key}]")
            check_keys(value, wanted, where, f"{section}{key}.")
        elif isinstance(wanted, list):
            _check_array(value, wanted[0], where, f"{section}{key}")
        elif not isinstance(value, wanted) or (isinstance(value, bool) and not _takes_bool(wanted)):
            raise SettingsError(f"{at} is {value!r}, wanted {_type_name(wanted)}")


def _check_array(value: object, schema: Mapping[str, Any], where: str, name: str) -> None:
    if not isinstance(value, list) or not all(isinstance(item, Mapping) for item in value):
        raise SettingsError(f"{where}: {name} is {value!r}, wanted tables written as [[{name}]]")
    for item in value:
        check_keys(item, schema, where, f"{name}.")
        for required in ("log", "name", "ratios"):
            if required in schema and required not in item:
                raise SettingsError(f"{where}: a [[{name}]] has no key {required!r}")


def _takes_bool(wanted: object) -> bool:
    return wanted is bool or (isinstance(wanted, tuple) and bool in wanted)


def _type_name(wanted: type | tuple[type, ...]) -> str:
    names = {
        str: "text",
        bool: "true or false",
        list: "a list",
        dict: "a table",
        int: "a whole number",
    }
    if isinstance(wanted, tuple):
        others = {bool: "false", str: "text", list: "a list"}
        return " or ".join(["a number", *(others[kind] for kind in wanted if kind in others)])
    return names[wanted]
