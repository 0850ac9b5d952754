"""The names of columns: words for a quantity before or after the name or number of a joint.

A name is a quantity and a joint in either order: ``q_elbow``, ``elbow_pos``, ``/elbow/effort``,
``desired_position.3``. Case and separators make no difference. All its words must be known.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

_QUANTITIES = {
    "q": ("q", "pos", "position", "positions", "angle"),
    "dq": ("dq", "qd", "qdot", "vel", "velocity", "velocities", "speed"),
    "ddq": ("ddq", "qdd", "acc", "accel", "acceleration"),
    "tau": ("tau", "effort", "efforts", "eff", "torque", "torques", "trq"),
    "current": ("current", "currents", "curr", "i"),
}
_COMMANDED = ("ref", "reference", "des", "desired", "cmd", "command", "commanded", "target",
              "goal", "setpoint")  # fmt: skip
_REFERENCES = {"q": "qref", "dq": "dqref", "tau": "tauref"}
#: Kinds of columns of a joint or, with "m", of a motor.
KINDS = tuple(f"{kind}{m}" for m in ("", "m") for kind in (*_QUANTITIES, *_REFERENCES.values()))
_KIND_OF = {word: kind for kind, words in _QUANTITIES.items() for word in words}
_KIND_OF |= {
    f"{word}{ref}": _REFERENCES[kind]
    for word, kind in _KIND_OF.items()
    for ref in _COMMANDED
    if kind in _REFERENCES
} | {f"{kind}m": f"{kind}m" for kind in KINDS}
_NO_MEANING = {"measured", "meas", "actual", "act", "state", "states", "field", "data", "joint",
               "joints", "rad", "deg", "nm"}  # fmt: skip
_CLOCKS = {("time",), ("t",), ("timestamp",), ("stamp",), ("header", "stamp")}
_NAME = re.compile(r"(.*?)name(\W*\d+\W*)")  # of a joint, in each row: field.name0
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+|[^\W\d_]+")


@dataclass(frozen=True)
class Reading:
    """The columns of the joints of a robot."""

    # names of the columns by kind and joint; more than one is ambiguous
    columns: Mapping[tuple[str, str], list[str]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # joints that are spelt otherwise in the file
    assumed: tuple[str, ...] = ()  # what was assumed of the order of numbered columns

    @property
    def positions(self) -> dict[str, str]:
        """The column of the position of each joint that has one."""
        return {joint: own[0] for (kind, joint), own in self.columns.items() if kind == "q"}


def read_names(
    names: Sequence[str],
    places: Mapping[str, str],
    effort: str = "torque",
    orders: Sequence[Sequence[str]] = (),
) -> Reading:
    """Return the columns of each joint."""
    joints = {label: place for place, label in places.items()}
    read = [(name, found) for name in names if (found := quantity_of(name, effort, joints))]
    if numbered := _numbered(read, joints, orders):
        return numbered
    columns: dict[tuple[str, str], list[str]] = {}
    spelt: dict[str, str] = {}
    for name, (kind, label) in read:
        if label in joints:
            columns.setdefault((kind, joints[label]), []).append(name)
            if label not in name:
                spelt[joints[label]] = name
    pairs = ", ".join(f"{name} is of joint {joint}" for joint, name in spelt.items())
    return Reading(columns, (f"spelt otherwise in the URDF: {pairs}",) * bool(spelt))


def _numbered(
    read: Sequence[tuple[str, tuple[str, str]]],
    joints: Collection[str],
    orders: Sequence[Sequence[str]],
) -> Reading | None:
    """Return columns whose joints have consecutive numbers, in the order of the joints.

    None if each has the name of a joint, or if the numbers are not as many as the joints.
    """
    labels: dict[str, list[str]] = {}  # names of joints in the file, by quantity
    for _, (kind, label) in read:
        labels.setdefault(kind, []).append(label)
    names = by_number(labels.get("q", []))
    order = next((by_number(order) for order in orders if len(order) == len(names)), ())
    numbers = _consecutive(names)
    if not order or not numbers or set(names) <= set(joints):
        return None
    joint_of = dict(zip(numbers, order, strict=True))
    kinds = [kind for kind, own in labels.items() if _consecutive(by_number(own)) == numbers]
    columns = {
        (kind, joint_of[_numbers(label)[0]]): [name]
        for name, (kind, label) in read
        if kind in kinds
    }
    pairs = ", ".join(f"{name} is {joint}" for name, joint in zip(names, order, strict=True))
    assumed = f"numbered columns are read in the order of the joints: {pairs}"
    return Reading(columns, assumed=(assumed,))


def _consecutive(names: Sequence[str]) -> list[int]:
    """Return the numbers of names that differ by consecutive ones alone; none of other names."""
    numbers = [_numbers(name) for name in names]
    if not _differ_by_number(names) or any(len(own) != 1 for own in numbers):
        return []
    plain = [own[0] for own in numbers]
    return plain if plain == list(range(plain[0], plain[0] + len(plain))) else []


def quantity_of(
    name: str, effort: str = "torque", joints: Iterable[str] = ()
) -> tuple[str, str] | None:
    """Return quantity and joint of a column, or None: "q_des_elbow" is qref of elbow."""
    for joint, rest in _around(name, sorted(joints, key=len, reverse=True)):
        if kind := _kind(rest, effort):
            return kind, joint
    spans = [match.span() for match in _WORD.finditer(name)]
    words = _words(name)
    others = [k for k, word in enumerate(words) if not _is_known(word)]
    if not others:
        return None
    if kind := _kind(words[: others[0]], effort):  # the quantity first
        return kind, name[spans[others[0]][0] :].rstrip(")]")
    if kind := _kind(words[others[-1] + 1 :], effort):
        return kind, name[: spans[others[-1]][1]]
    return None


def named_by_row(row: Mapping[str, object]) -> dict[str, str]:
    """New names of columns whose joint is a text in a row: field.position0 by field.name0."""
    found = {match: cell for x, cell in row.items() if (match := _NAME.fullmatch(x))}
    return {
        x: f"{x.removesuffix(match[2])}_{str(joint).strip()}"
        for match, joint in found.items()
        for x in row
        if x.startswith(match[1]) and x.endswith(match[2]) and is_quantity(x.removesuffix(match[2]))
    }


def is_quantity(name: str) -> bool:
    """Return whether a name is that of a quantity, of no joint."""
    return bool(_kind(_words(name), "torque"))


def is_clock(name: str) -> bool:
    """Return whether a column has time stamps: time, t, timestamp, stamp, header.stamp."""
    return tuple(word for word in _words(name) if word not in _NO_MEANING) in _CLOCKS


def is_commanded(name: str) -> bool:
    """Return whether a column has a word for a command, or for the error of following one."""
    ends = (*_COMMANDED, "demand", "err")
    return any(word.startswith(ends) or word.endswith(ends) for word in _words(name))


def _around(name: str, joints: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each joint that a name contains as spelt, then as its words, and the other words."""
    for joint in joints:
        at = name.find(joint) if joint else -1
        while at >= 0:
            yield joint, (*_words(name[:at]), *_words(name[at + len(joint) :]))
            at = name.find(joint, at + 1)
    words = _words(name)
    for joint in joints:
        own = tuple(word for word in _words(joint) if word != "joint")
        own = own if any(word.isalpha() for word in own) else _words(joint)
        for k in range(len(words) - len(own) + 1 if own else 0):
            if words[k : k + len(own)] == own:
                yield joint, (*words[:k], *words[k + len(own) :])


def _is_known(word: str) -> bool:
    return word in _KIND_OF or word in _COMMANDED or word in _NO_MEANING


def _kind(words: tuple[str, ...], effort: str) -> str | None:
    """Return the quantity of words that are all known; a command without one is a position."""
    kinds = [_KIND_OF[word] for word in words if word in _KIND_OF]
    refs = sum(word in _COMMANDED for word in words)
    if not all(map(_is_known, words)) or len(kinds) > 1 or refs > 1 or not (kinds or refs):
        return None
    (kind,) = kinds or ["q"]
    if effort == "current" and any(word.startswith("eff") for word in words):
        kind = "current"
    return (_REFERENCES.get(kind) if refs else kind) or None


def by_number(names: Sequence[str]) -> Sequence[str]:
    """Names in the order of their numbers if they differ by these alone, else as they are."""
    return sorted(names, key=_numbers) if _differ_by_number(names) else names


def _differ_by_number(names: Sequence[str]) -> bool:
    """Return whether names have the same words but for their numbers."""
    return len({tuple("" if x.isdigit() else x for x in _words(name)) for name in names}) == 1


def _numbers(name: str) -> list[int]:
    return [int(word) for word in _words(name) if word.isdigit()]


@lru_cache(maxsize=4096)
def _words(name: str) -> tuple[str, ...]:
    return tuple(word.lower() for word in _WORD.findall(name))
