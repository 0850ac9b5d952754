"""Arguments of public functions, checked against the annotations."""

import inspect
import re
import types
from collections.abc import Callable, Collection, Mapping
from functools import cache, wraps
from numbers import Integral, Real
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.settings import shown
from robotid.base.typing import Array

P = ParamSpec("P")
T = TypeVar("T")
_NUMBERS: Mapping[type, type] = {float: Real, int: Integral}
_WORDS: Mapping[type, str] = {
    str: "text", float: "a number", int: "a whole number", bool: "True or False",
    type(None): "None", np.ndarray: "an array of real numbers",
}  # fmt: skip


def checked(*names: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Return a decorator that refuses arguments whose types the annotations do not permit.

    A list for an array becomes an array.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        signature = inspect.signature(function)
        kinds = {
            name: each.annotation
            for name, each in signature.parameters.items()
            if each.annotation is not inspect.Parameter.empty and (not names or name in names)
        }

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            given = signature.bind(*args, **kwargs)
            for name, value in given.arguments.items():
                if name in kinds:
                    given.arguments[name] = _checked(value, kinds[name], name)
            return function(*given.args, **given.kwargs)

        return call

    return decorate


def check_fields(instance: object, *names: str) -> None:
    """Refuse fields of a dataclass whose types the annotations do not permit."""
    kinds = _annotations(type(instance))  # type: ignore[arg-type]
    for name in names:
        _checked(getattr(instance, name), kinds[name], f"{name} of {type(instance).__name__}")


def real_numbers(values: ArrayLike | None, name: str, *, hint: str = "") -> Array:
    """Return values as a read-only array of numbers; NaN where a masked array is masked."""
    if values is None:
        raise DataError(f"{name} is None, wanted an array{hint}")
    try:
        array: Array = np.ma.asanyarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError(f"numbers of kind {array.dtype.kind!r}")
        if np.ma.is_masked(array):
            return frozen(np.ma.filled(array.astype(np.float64), np.nan))
        return frozen(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            f"{name} is not an array of real numbers ({str(error)[:100]}); wanted an array of "
            "floats with rows of equal length"
        ) from error


def frozen(values: ArrayLike, dtype: type = np.float64) -> Array:
    """Return the values as a read-only array; copied unless they are read-only already."""
    array: Array = np.asarray(values, dtype=dtype)
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


@cache
def _annotations(kind: Any) -> dict[str, Any]:  # noqa: ANN401
    found: dict[str, Any] = {}
    for each in reversed(kind.__mro__):
        found |= inspect.get_annotations(each)
    return found


def _checked(value: Any, hint: Any, name: str) -> Any:  # noqa: ANN401
    """Return an argument, a list for an array as an array; refuse another type."""
    choices = _choices(hint)
    if any(get_origin(x) is np.ndarray for x in choices) and isinstance(value, list | tuple):
        try:
            value = np.asarray(value)
        except ValueError:  # rows of different lengths
            value = None
    if not any(_fits(value, choice) for choice in choices):
        wanted = " or ".join(dict.fromkeys(map(_words, choices)))
        raise SettingsError(f"{name} is {shown(value)}, a {type(value).__name__}, wanted {wanted}")
    return value


def _choices(hint: Any) -> list[Any]:  # noqa: ANN401
    """Return the alternatives of an annotation."""
    hint = getattr(get_origin(hint) or hint, "__value__", hint)  # of a type alias, as NDArray
    if get_origin(hint) in (Union, types.UnionType):
        return [x for part in get_args(hint) for x in _choices(part)]
    return [type(None) if hint is None else hint]


def _fits(value: Any, hint: Any) -> bool:  # noqa: ANN401
    """Return whether a value is of one alternative of an annotation, entries included."""
    if isinstance(hint, str):  # a class that is imported for type checks only
        names = {each.__name__ for each in type(value).__mro__}
        return bool(names & {*re.findall(r"\w+", hint)})
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    if origin is None:
        if isinstance(value, bool | np.bool_):
            return hint in (bool, object)
        return isinstance(value, _NUMBERS.get(hint, hint)) if isinstance(hint, type) else True
    if origin is Callable or (origin is not type and not isinstance(origin, type)):
        return callable(value)
    if not isinstance(value, origin) or (isinstance(value, str | bytes) and origin is not type):
        return False
    if isinstance(value, Mapping) and len(inner) == 2:
        pairs = [
            (each, kind) for pair in value.items() for each, kind in zip(pair, inner, strict=True)
        ]
    elif isinstance(value, Collection) and inner:
        pairs = [(each, inner[0]) for each in value]
    else:
        pairs = []
    return all(
        any(get_origin(x) is np.ndarray or _fits(each, x) for x in _choices(kind))
        for each, kind in pairs
    )  # arrays of a table are converted, and checked with their sizes


def _words(hint: Any) -> str:  # noqa: ANN401
    """Return an alternative of an annotation as words."""
    if isinstance(hint, str):
        return " or ".join(f"a {name}" for name in re.findall(r"\w+", hint))
    kind = get_origin(hint) or hint
    if kind is Literal:
        return "one of " + ", ".join(map(str, get_args(hint)))
    if kind is Callable or kind is getattr(types, "FunctionType", None):
        return "a function"
    name = getattr(kind, "__name__", str(kind))
    return _WORDS.get(kind, {"Mapping": "a table", "Sequence": "a list"}.get(name, f"a {name}"))
