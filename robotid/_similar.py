"""Similar names: columns and joints of a log under names that differ from the wanted ones."""

import difflib
import re
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import TypeVar

__all__ = ["is_commanded", "similar_columns", "similar_joints"]

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
_COMMANDED = ("ref", "des", "cmd", "command", "target", "goal", "setpoint", "demand", "err")
_NO_MEANING = ("measured", "meas", "actual", "act", "state", "rad", "deg", "nm", "a", "n", "m")
_ALSO = {"q": ["pos", "angle"], "tau": ["trq", "force"], "current": ["curr", "amps"]}
_SHORT = 2  # letters of a prefix for which one other letter is another quantity, as iq and id
_LEAST = 0.6  # similarity of a misspelt word
_T = TypeVar("_T", bound=Hashable)


def is_commanded(name: str) -> bool:
    """Return whether a column has a word for a command, or for the error of following one.

    Args:
        name: The column.
    """
    return any(w.startswith(_COMMANDED) or w.endswith(_COMMANDED) for w in _words(name))


def similar_columns(
    absent: Sequence[tuple[str, str]], names: Collection[str], prefixes: Mapping[str, Sequence[str]]
) -> dict[tuple[str, str], str]:
    """Return misspelt columns by the quantity and joint that they may contain.

    A name is similar if its joint is the same and its quantity is misspelt, or the reverse; case
    and separators make no difference. No commanded quantity is similar to a measured one.

    Args:
        absent: Quantities and joints without a column; "tau" is also sought as "current".
        names: Names of the columns without another meaning.
        prefixes: Prefixes of columns by quantity.

    Returns:
        The columns, each once, by quantity and joint; the quantity is "current" for a current.
    """
    scores = []
    for kind, joint in absent:
        is_measured = kind.removesuffix("m") in ("q", "tau")
        kinds = (kind, kind.replace("tau", "current")) if kind.startswith("tau") else (kind,)
        for name in (x for x in names if not (is_measured and is_commanded(x))):
            score, best = max(
                (_likeness(name, (*prefixes[each], *_ALSO.get(each, ())), joint), each)
                for each in kinds
            )
            scores.append((score, (kind, joint), (best, joint), name))
    found = _matched((score, at, name) for score, at, _, name in scores)
    return {named: name for _, at, named, name in scores if found.get(at) == name}


def similar_joints(joints: Sequence[str], names: Sequence[str]) -> tuple[dict[str, str], set[str]]:
    """Return the names in a log that may be those of joints, and the joints paired by order.

    Args:
        joints: Names of joints without columns.
        names: Names in the log without a joint.
    """
    found = _matched(
        (_likeness_of_joints(joint, name), joint, name) for joint in joints for name in names
    )
    rest = [joint for joint in joints if joint not in found]
    left = [name for name in names if name not in found.values()]
    found |= zip(rest, left, strict=False)
    return {joint: found[joint] for joint in joints if joint in found}, {*rest[: len(left)]}


def _matched(scores: Iterable[tuple[float, _T, str]]) -> dict[_T, str]:
    """Return the best name of each key, most similar pairs first; each name is used once."""
    found: dict[_T, str] = {}
    for score, key, name in sorted(scores, key=lambda entry: -entry[0]):
        if score >= _LEAST and key not in found and name not in found.values():
            found[key] = name
    return found


def _likeness(name: str, starts: Sequence[str], joint: str) -> float:
    """Return the similarity of a column to that of a joint with one of some prefixes, 0 to 1."""
    words, own = _without_joint(_words(name)), _without_joint(_words(joint))
    size, best = len(own), 0.0
    sides = ((words[-size:], words[:-size]), (words[:size], words[size:]))
    quantities = [rest for has_joint, rest in sides if has_joint == own]
    for start in starts:
        first = _words(start)
        rest = tuple(word for word in words[len(first) :] if word in own or word not in _NO_MEANING)
        if words[: len(first)] == first and _letters(rest) == _letters(own):
            best = max(best, _ratio(own, rest))  # the quantity is right
        for rest in quantities:
            rest = tuple(word for word in rest if word not in _NO_MEANING)
            if len(rest) in (1, len(first)):
                is_short = len("".join(first)) <= _SHORT
                best = max(best, float(rest == first) if is_short else _ratio(first, rest))
    return best


def _likeness_of_joints(one: str, other: str) -> float:
    """Return the similarity of two names of joints, 0 to 1; the same numbers are similar."""
    pair = _words(one), _words(other)
    numbers = [[word for word in words if word.isdigit()] for words in pair]
    least = _LEAST if numbers[0] and numbers[0] == numbers[1] else 0.0
    return max(_ratio(*pair), _ratio(*map(_without_joint, pair)), least)


@lru_cache(maxsize=4096)
def _words(name: str) -> tuple[str, ...]:
    return tuple(word.lower() for word in _WORD.findall(name))


def _without_joint(words: tuple[str, ...]) -> tuple[str, ...]:
    """Return words without "joint", which has no meaning in the name of a joint."""
    return tuple(word for word in words if word != "joint") or words


def _letters(words: tuple[str, ...]) -> int:
    """Return the number of words that are no numbers: tau_ext_elbow is not tau_elbow."""
    return sum(word.isalpha() for word in words)


@lru_cache(maxsize=4096)
def _ratio(one: tuple[str, ...], other: tuple[str, ...]) -> float:
    """Return the similarity of words, 0 to 1; it is 0 if both have numbers, and other ones."""
    numbers = [[word for word in words if word.isdigit()] for words in (one, other)]
    if all(numbers) and numbers[0] != numbers[1]:
        return 0.0
    return difflib.SequenceMatcher(None, "".join(one), "".join(other), autojunk=False).ratio()
