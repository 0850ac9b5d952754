"""Settings: keys, checks, help, pages and results derive from the fields that declare them."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from numbers import Real
from typing import Any, ClassVar, Self, TypeGuard, get_args, get_origin

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed, suggestion


@dataclass(frozen=True)
class Range:
    """The permitted values of a setting."""

    words: str  # description in errors
    holds: Callable[[Any], bool]


@dataclass(frozen=True)
class Entries:
    """A list or a table of a job file whose entries have one type."""

    outer: type  # list or dict
    inner: tuple[type, ...]  # types of each entry
    count: int | None = None  # number of entries; any number if None


def require_kind(value: object, kind: type | tuple[type, ...], name: str, wanted: str) -> None:
    """Refuse an argument of the wrong type."""
    if not isinstance(value, kind):
        raise SettingsError(f"{name} is {shown(value)} ({type(value).__name__}), expected {wanted}")


def require_each(
    values: object, kind: type | tuple[type, ...], name: str, wanted: str
) -> list[Any]:
    """Return the entries of an argument that is a list, or refuse the argument."""
    is_list = isinstance(values, Collection) and not isinstance(values, str | bytes | Mapping)
    entries = list(values) if is_list and getattr(values, "ndim", 1) == 1 else [None]  # type: ignore[call-overload]
    if not all(isinstance(entry, kind) for entry in entries):
        require_kind(values, (), name, wanted)
    return entries


def is_number(value: object) -> bool:
    """Return whether a value is a finite number of Python or NumPy; a boolean is not."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer larger than any float
        return False


def require_flag(value: object, name: str) -> None:
    """Refuse an argument that is not a boolean of Python or NumPy."""
    if type(value).__name__ not in ("bool", "bool_"):
        require_kind(value, bool, name, "True or False")


#: Settings and parameters are smaller, SI units: products of a few are finite.
LARGEST_SETTING = 1e30
#: Keys that are required in a table of a list of tables, if its schema has them.
REQUIRED = ("log", "name", "ratios", "joints", "matrix", "mass", "frame", "frames")
POSITIVE = Range("a positive number", lambda x: x > 0)
#: Of limits and noise, in any unit: their squares and ratios are finite.
SIZE = Range("1e-09 to 1e+12", lambda x: 1e-9 <= x <= 1e12)
NOT_NEGATIVE = Range("0 or a positive number", lambda x: x >= 0)


@dataclass(frozen=True)
class Key:
    """The description of a setting."""

    text: str  # meaning of the setting, with its unit
    among: Sequence[str] = ()  # permitted words
    within: Range | None = None  # range of its numbers
    at: str = ""  # its path in a job file, separated by dots; the field's name if empty
    # type in the job file: types, a table of keys, or [a table]; that of the annotation if None
    reads: Any = None
    load: Callable[[Any], Any] | None = None  # converts the entry of a job file to the value
    dump: Callable[[Any], Any] | None = None  # converts the value to the entry of result.json

    @property
    def words(self) -> str:
        """The meaning of the setting, with its permitted words if the text does not have them."""
        has_words = all(word in self.text for word in self.among)
        return self.text if has_words else f"{self.text}: {', '.join(self.among)}"


def setting(default: Any, text: str, **about: Any) -> Any:  # noqa: ANN401
    """Declare a setting, as a field of a ``Settings``."""
    metadata = {"key": Key(text, **about)}
    if isinstance(default, dict):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """A table of settings; its fields are checked at construction."""

    _table: ClassVar[str] = ""  # its name in errors

    def __init_subclass__(cls) -> None:
        own = {name: f.metadata["key"] for name, f in vars(cls).items() if isinstance(f, Field)}
        texts = {name: key.words.replace("; false", "; None") for name, key in own.items()}
        lines = [f"    {name}: {text[:1].upper()}{text[1:]}." for name, text in texts.items()]
        cls.__doc__ = "\n".join([f"{cls.__doc__}\n\nAttributes:", *lines])

    def __post_init__(self) -> None:
        for f, key, (*tables, last) in self.entries():
            where = ".".join(tables) or self._table
            _check_value(getattr(self, f.name), key, f"{where}: {last}" if where else last)

    @classmethod
    def entries(cls) -> list[tuple[Field[Any], Key, list[str]]]:
        """Return each field, its description, and its path in a job file."""
        about = [(f, f.metadata["key"]) for f in fields(cls)]
        return [(f, key, (key.at or f.name).split(".")) for f, key in about]

    @classmethod
    def schema(cls) -> dict[str, Any]:
        """Return the permitted keys of a job file: a type or types, a table, or [a table]."""
        schema: dict[str, Any] = {}
        for f, key, (*tables, last) in cls.entries():
            table_in(schema, tables)[last] = _read_type(f.type if key.reads is None else key.reads)
        return schema

    @classmethod
    def paths(cls) -> dict[str, Key]:
        """Return the description of each key; keys of inner tables have a dotted path."""
        found: dict[str, Key] = {}
        for f, key, path in cls.entries():
            inside = f.type.paths() if _is_table(f.type) else {"": key}
            found |= {".".join([*path, last]).strip("."): inner for last, inner in inside.items()}
        return found

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        """Return the settings of a table of a job file with keys and types of the ``schema``.

        Args:
            table: The table.
        """
        given = {}
        for f, key, (*tables, last) in cls.entries():
            inside = table
            for name in tables:
                inside = inside.get(name, {})
            if last in inside:
                given[f.name] = _load(inside[last], key, f.type)
        return cls(**given)

    def to_dict(self) -> dict[str, Any]:
        """Return all settings as plain values, in the form of the job file."""
        found: dict[str, Any] = {}
        for f, key, (*tables, last) in self.entries():
            inside, value = table_in(found, tables), getattr(self, f.name)
            plain = _plain(value) if key.dump is None else key.dump(value)
            if plain is not None:
                inside[last] = plain
        return found


def table_in(table: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return an inner table; it is created if it is missing."""
    for name in names:
        table = table.setdefault(name, {})
    return table


def check_keys(
    table: Mapping[str, Any], schema: Mapping[str, Any], where: str, section: str = ""
) -> None:
    """Refuse keys that are not in the schema and values of the wrong type."""
    for key, value in table.items():
        at = f"{where}: {section}{key}"
        if key not in schema:
            raise SettingsError(
                f"{shown(at)[1:-1]} is not a known key{suggestion(key, schema) or '.'} "
                f"Known: {listed(sorted(schema))}"
            )
        wanted = schema[key]
        if isinstance(wanted, dict):
            if not isinstance(value, Mapping):
                raise SettingsError(f"{at} is {shown(value)}, expected a table [{section}{key}]")
            check_keys(value, wanted, where, f"{section}{key}.")
        elif isinstance(wanted, list):
            _check_array(value, wanted[0], where, f"{section}{key}")
        elif isinstance(wanted, Entries):
            _check_entries(value, wanted, at)
        else:
            _check_type(value, wanted, at)


def _check_array(value: object, schema: Mapping[str, Any], where: str, name: str) -> None:
    if not isinstance(value, list) or not all(isinstance(item, Mapping) for item in value):
        raise SettingsError(
            f"{where}: {name} is {shown(value)}, expected tables written as [[{name}]]"
        )
    for item in value:
        check_keys(item, schema, where, f"{name}.")
        for required in REQUIRED:
            if required in schema and required not in item:
                raise SettingsError(f"{where}: a [[{name}]] has no key {required!r}")


def _check_entries(value: object, wanted: Entries, at: str) -> None:
    if wanted.count is not None and not isinstance(value, wanted.outer):
        kind = "numbers" if float in wanted.inner else "entries"
        raise SettingsError(f"{at} is {shown(value)}, expected a list of {wanted.count} {kind}")
    _check_type(value, (wanted.outer,), at)
    if isinstance(value, Mapping):
        for name, entry in value.items():
            _check_type(entry, wanted.inner, f"{at}.{name}")
    elif isinstance(value, list):
        if wanted.count is not None and len(value) != wanted.count:
            raise SettingsError(f"{at} has {len(value)} entries, expected {wanted.count}")
        for k, entry in enumerate(value):
            _check_type(entry, wanted.inner, f"{at}[{k}]")


def _check_type(value: object, kinds: tuple[type, ...], at: str) -> None:
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise SettingsError(f"{at} is {shown(value)}, expected {_type_name(kinds)}")
    if isinstance(value, int | float) and not abs(value) <= LARGEST_SETTING:  # NaN, too
        raise SettingsError(f"{at} is {shown(value)}, expected a number between -1e30 and 1e30")


def shown(value: object) -> str:
    """Return a value as text of one line, for a message."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python does not print integers of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:60]}...{text[-17:]}"


def _check_value(value: Any, key: Key, name: str) -> None:  # noqa: ANN401
    if value is None or not (key.among or key.within):
        return
    is_word = isinstance(value, str)
    words = [] if key.within is None else [key.within.words]
    words += [f"one of {listed(key.among)}"] if key.among and (is_word or not words) else []
    try:
        is_number = bool(key.within and not is_word and key.within.holds(value))
    except (TypeError, ValueError):  # of a value for which the check is not made
        is_number = False
    if not (is_number or (is_word and value in key.among)):
        raise SettingsError(f"{name} is {shown(value)}, expected {' or '.join(words)}")


_NUMBER = (int, float)
_WORDS = {str: "text", bool: "true or false", list: "a list", dict: "a table"}
_ALSO = {bool: "false", str: "text", list: "a list"}


def _type_name(kinds: tuple[type, ...]) -> str:
    if float not in kinds:
        return "a whole number" if int in kinds else _WORDS[kinds[0]]
    return " or ".join(["a number", *(_ALSO[kind] for kind in kinds if kind in _ALSO)])


def _is_table(kind: Any) -> TypeGuard[type[Settings]]:  # noqa: ANN401
    return isinstance(kind, type) and issubclass(kind, Settings)


def _read_type(kind: Any) -> Any:  # noqa: ANN401
    """Return the type in a job file for the annotation of a field."""
    if isinstance(kind, dict | list | tuple | Entries):
        return kind.copy() if isinstance(kind, dict) else kind  # other fields may add keys
    if _is_table(kind):
        return kind.schema()
    origin, inner = get_origin(kind), get_args(kind)
    if origin is not None and issubclass(origin, Mapping):
        return (dict,) if inner[1] is Any else Entries(dict, _read_type(inner[1]))
    if origin is not None and issubclass(origin, Sequence):
        if _is_table(inner[0]):
            return [inner[0].schema()]
        count = len(inner) if origin is tuple and inner[-1] is not ... else None
        return Entries(list, _read_type(inner[0]), count)
    if inner:
        kinds = [_read_type(one) for one in inner if one is not type(None)]
        return kinds[0] if len(kinds) == 1 else tuple(t for one in kinds for t in one)
    return _NUMBER if kind is float else (kind,)


def _load(value: Any, key: Key, kind: Any) -> Any:  # noqa: ANN401
    if key.load is not None:
        return key.load(value)
    if _is_table(kind):
        return kind.from_dict(value)
    if isinstance(value, list):
        inner = get_args(kind)[0]
        return tuple(inner.from_dict(item) if _is_table(inner) else item for item in value)
    if isinstance(value, Mapping) and get_args(kind) == (str, float):
        return {entry: float(number) for entry, number in value.items()}
    return value


def _plain(value: Any) -> Any:  # noqa: ANN401
    """Return a value for TOML and JSON."""
    if isinstance(value, Settings):
        return value.to_dict()
    if isinstance(value, Mapping):
        return dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
