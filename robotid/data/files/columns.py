"""Columns of the joints in a table: positions, velocities, torques and commands, by their names.

A name is a quantity and a joint in either order: ``q_elbow``, ``elbow_pos``, ``/elbow/effort``,
``desired_position.3``. Case and separators make no difference. All its words must be known.
"""

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain
from typing import Literal, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed, quoted, suggestion, toml_key
from robotid.base.settings import is_number
from robotid.data.log import repeated
from robotid.data.signal_settings import PER_SECOND, LogSource, LogUnits, Transmission
from robotid.robot.tree import Joint

_QUANTITIES = {
    "q": ("q", "pos", "position", "positions", "angle"),
    "dq": ("dq", "qd", "qdot", "vel", "velocity", "velocities", "speed"),
    "ddq": ("ddq", "qdd", "acc", "accel", "acceleration"),
    "tau": ("tau", "effort", "efforts", "eff", "torque", "torques", "trq"),
    "current": ("current", "currents", "curr", "i"),
}
_COMMANDED = ("ref", "reference", "des", "desired", "cmd", "command", "commanded", "target",
              "goal", "setpoint", "action")  # fmt: skip
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
               "joints", "observation", "rad", "deg", "nm"}  # fmt: skip
_CLOCKS = {("time",), ("t",), ("timestamp",), ("stamp",), ("header", "stamp")}
_NAME = re.compile(r"(.*?)name(\W*\d+\W*)")  # of a joint, in each row: field.name0
_UNIT = re.compile(r"\s*[\[(](m?rad|deg|m?m|k?N ?m?|m?A)(/s(\^?2)?)?[\])]$")  # behind a name
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
    read = [(name, quantity) for name in names if (quantity := quantity_of(name, effort, joints))]
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
    """Return columns of joints with as many consecutive numbers and no names, in their order."""
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
    name = _UNIT.sub("", name)
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
    joints = {match: cell for x, cell in row.items() if (match := _NAME.fullmatch(x))}
    return {
        x: f"{x.removesuffix(match[2])}_{str(joint).strip()}"
        for match, joint in joints.items()
        for x in row
        if x.startswith(match[1]) and x.endswith(match[2]) and is_quantity(x.removesuffix(match[2]))
    }


def is_quantity(name: str) -> bool:
    """Return whether a name is that of a quantity, of no joint."""
    return bool(_kind(_words(name), "torque"))


def is_clock(name: str) -> bool:
    """Return whether a column has time stamps: time, t, timestamp, stamp, header.stamp, t [s]."""
    words = [word for word in _words(name) if word not in _NO_MEANING]
    return tuple(words) in _CLOCKS or clock_unit(name) == "s"


def clock_unit(name: str) -> str | None:
    """Return the unit at the end of the name of a column with time stamps, as of "time_ms"."""
    words = [word for word in _words(name) if word not in _NO_MEANING]
    return words[-1] if tuple(words[:-1]) in _CLOCKS and words[-1] in PER_SECOND else None


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


#: Quantities that are read besides the positions, as of ``lay_out``.
Needs: TypeAlias = Literal["torque", "motion", "commands", "any"]

#: Nouns for the columns of each kind.
NOUNS = {
    "q": "position",
    "dq": "velocity",
    "ddq": "acceleration",
    "tau": "torque or current",
    "qref": "commanded position",
    "dqref": "commanded velocity",
    "tauref": "commanded torque",
}
#: Kinds of columns with torques.
TORQUES = ("tau", "tauref")
_SIZES = ("loadsize_", "load_size_")  # absolute values of loads, as bus servos report them
_OF_JOINTS = (*NOUNS, "current")  # kinds that are not of motors
_SHOWN = 6  # names in a list
_SIMULATION = (  # from commands, on the command line and in a job file
    "by --estimator simulation --kp N_M_PER_RAD or in the job file; without kp, the masses of the "
    """URDF determine the scale
[estimator]
name = "simulation"

[controller]
kp = N_M_PER_RAD  # position gain, if you know it"""
)


def without_torque(is_commanded: bool, remedy: str = _SIMULATION) -> str:
    """Return the remedy for a log without torques."""
    if is_commanded:
        return (
            "All estimators but the simulation need tau_<joint> or current_<joint>. The log has "
            f"commanded positions: identify the drives from them, {remedy}"
        )
    return (
        "Record tau_<joint> or current_<joint>. Commanded positions, qref_<joint>, are enough for "
        'the estimator "simulation"'
    )


@dataclass(frozen=True)
class Finder:
    """Finds the columns of the wanted joints among the names in a file."""

    where: str  # name of the file
    names: list[str]  # of its columns
    columns: Mapping[str, str]  # names in the file by standard name, as the user stated them
    joints: tuple[str, ...]  # the wanted ones
    gains: Mapping[str, float]  # of currents, by joint
    source: LogSource
    gears: tuple[Transmission, ...]
    needs: Needs = "torque"
    notes: list[str] = field(default_factory=list)  # for the user
    seen: set[str] = field(default_factory=set)  # columns that are read or named in a note
    passive: Collection[str] = ()  # joints without a drive, which need no torque
    robot: Sequence[Joint] = ()  # all movable joints, in the order of the URDF
    moves: Callable[[str, str], bool] | None = None  # whether a joint moves, by its column
    units: LogUnits = field(default_factory=LogUnits)

    def find_all(self) -> dict[str, list[str]]:
        """Return the columns to read: time, q, required quantities, complete optional ones."""
        self._check_arguments()
        self.notes.extend(self.reading.notes)
        optional, wanted = ["dq", "ddq"], self._wanted()
        chosen = {"time": [self._require(wanted)]}
        chosen["q"] = list(filter(None, map(self._find_of, *self._places("q"))))
        if "commands" in wanted:
            chosen["qref"] = list(filter(None, map(self._find_of, *self._places("qref"))))
            optional += ["dqref", "tauref"]
        if "torque" in wanted or ("commands" in wanted and self._has_all_torques()):
            places = zip(self.joints, *self._places("tau"), strict=True)
            chosen["tau"] = ["" if joint in self.passive else self._find_torque(kind, name)
                            for joint, kind, name in places]  # fmt: skip
        chosen |= {kind: names for kind in optional if (names := self._find_optional(kind))}
        sizes = [name for name in self.names if name.startswith(_SIZES) and name not in self.seen]
        if sizes:
            self.notes.append(
                f"{listed(sizes)} ignored: the absolute value of a load does not determine the "
                "direction of the torque"
            )
        extra = [name for name in self.names if name not in {*self.seen, *sizes}]
        if extra:
            self.notes.append(f"columns ignored: {listed(extra)}")
        if twice := repeated([name for names in chosen.values() for name in names if name]):
            raise SettingsError(
                f"{self.where}: {listed(twice)} are read twice; correct columns in the job file"
            )
        return chosen

    def factors(self, torques: Sequence[str]) -> tuple[float, ...]:
        """Return the factor that converts each of n columns to a torque: a current's gain, or 1."""
        currents = {
            self._find_of(kind, name): name
            for kind, names in (("current", self.joints), ("currentm", self.motors.values()))
            for name in names
        }
        return tuple(float(self.gains[currents[n]]) if n in currents else 1.0 for n in torques)

    @cached_property
    def reading(self) -> Reading:
        """The columns of all joints and motors of the robot, by their names."""
        every = [joint.name for joint in self.robot]
        leaders = [joint.name for joint in self.robot if joint.mimic is None]
        places = dict.fromkeys([*self.joints, *every, *self.motors.values()])
        names = [x for x in self.names if x not in {*self.columns.values(), *self.seen}]
        named = {place: self._named(place) for place in places}
        in_file = [joint for joint in every if joint in self.joints] or list(self.joints)
        is_clear = in_file == list(self.joints) or by_number(in_file) == by_number(self.joints)
        orders = (self.joints, leaders, every) if is_clear and not self.source.joints else ()
        return read_names(names, named, self.source.effort, orders)

    @property
    def motors(self) -> dict[str, str]:
        """The motor that corresponds to each joint that has one, by joint."""
        pairs = (zip(gear.joints, gear.names, strict=True) for gear in self.gears)
        return dict(chain.from_iterable(pairs))

    def of_motors(self, kind: str) -> tuple[bool, ...]:
        """Return for which joints a quantity is read from the corresponding motor."""
        kinds = ("tau", "current") if kind == "tau" else (kind,)
        driven = set[str]()
        for gear in self.gears:
            at_motors, at_joints = (
                [column for name in names for k in kinds if (column := self._find_of(k + m, name))]
                for m, names in (("m", gear.names), ("", gear.joints))
            )
            if at_motors and at_joints:
                raise DataError(
                    f"{self.where} has {at_motors[0]!r} of a motor and {at_joints[0]!r} of a joint "
                    f"that it drives, two {NOUNS[kind].partition(' ')[0]} columns of one "
                    "transmission; remove the columns of the motors or of the joints, or the "
                    "[[transmission]]"
                )
            driven.update(gear.joints if at_motors else ())
        return tuple(joint in driven for joint in self.joints)

    def has_torque(self, joint: str) -> bool:
        """Return whether the file has a torque or a current of a joint."""
        return self.has("tau", joint) or self.has("current", joint)

    def _places(self, kind: str) -> tuple[list[str], list[str]]:
        """Return the kinds and names of the columns of each joint: its own, or its motor's."""
        is_motor = self.of_motors(kind)
        names = [self.motors[x] if m else x for x, m in zip(self.joints, is_motor, strict=True)]
        return [kind + "m" * m for m in is_motor], names

    def _check_arguments(self) -> None:
        """Reject repeated names in the file, and gains and columns of joints that are not read."""
        if twice := repeated([name for name in self.names if name]):
            raise DataError(
                f"{self.where} has more than one column {listed(twice)}; rename or remove one"
            )
        stated = dict.fromkeys(self.gains, "a gain is given for")
        stated |= dict.fromkeys(self.source.joints, "log.joints renames")
        for joint, what in stated.items():
            if joint not in (*self.joints, *self.motors.values()):
                raise SettingsError(
                    f"{self.where}: {what} {joint!r}, which is not among the joints read: "
                    f"{listed(self.joints)}{suggestion(str(joint), self.joints)}"
                )
        for joint, gain in self.gains.items():
            if not (is_number(gain) and np.isfinite(gain)) or gain == 0:
                raise SettingsError(f"gain of {joint!r} is {gain}, expected a number other than 0")
        self._check_names()
        names = dict.fromkeys([*self.joints, *self.motors.values()])
        known = ["time", *(f"{kind}_{name}" for kind in KINDS for name in names)]
        for standard, name in self.columns.items():
            if standard not in known:
                raise SettingsError(
                    f"columns: {standard!r} is not a standard name of a column, as 'time' or "
                    f"'tau_{self.joints[0]}'{suggestion(standard, known)}"
                )
            if name not in self.names:
                raise DataError(
                    f"{self.where} has no column {name!r}, which is given for {standard!r} in "
                    f"columns; columns found: {listed(self.names)}{suggestion(name, self.names)}"
                )

    def _check_names(self) -> None:
        """Reject repeated joints, and two joints, or two motors, with one name in the file."""
        if twice := repeated(self.joints):
            raise SettingsError(f"joints has {listed(twice)} more than once; name each joint once")
        for places in (self.joints, tuple(dict.fromkeys(self.motors.values()))):
            by_name: dict[str, str] = {}
            for place in places:
                other = by_name.setdefault(self._named(place), place)
                if other != place:
                    raise SettingsError(
                        f"{self.where}: joints {other} and {place} have the same name "
                        f"{self._named(place)!r} in the log; set another one in [log.joints], "
                        f"or by --rename {place}=NAME"
                    )

    def _find(self, standard: str, aliases: Sequence[str]) -> str | None:
        """Return the column of one quantity, or None."""
        found = [x for x in aliases if x in self.names and x not in self.columns.values()]
        if standard in self.columns:
            found = [self.columns[standard]]
        if len(found) > 1:
            raise DataError(
                f"{self.where} has {found[0]!r} and {found[1]!r}, two names of the same quantity; "
                f"remove one, or set in the job file columns = {{ {toml_key(standard)} = "
                f"{quoted(found[0])} }}"
            )
        self.seen.update(found)
        return found[0] if found else None

    def _find_of(self, kind: str, joint: str) -> str | None:
        """Return the column of one quantity of one joint, or None."""
        return self._find(f"{kind}_{joint}", self.reading.columns.get((kind, joint), ()))

    def _named(self, joint: str) -> str:
        """Return the name of a joint in the file."""
        return self.source.joints.get(joint, joint)

    def _find_torque(self, kind: str, name: str) -> str:
        """Return the torque column of a joint or motor, or its current column with a gain."""
        tau, current = self._find_of(kind, name), self._find_of(f"current{kind[3:]}", name)
        has_gain = name in self.gains
        if tau and current:
            used, unused = (current, tau) if has_gain else (tau, current)
            self.notes.append(
                f"{unused} ignored: {used} is read ({'a' if has_gain else 'no'} gain)"
            )
            return used
        if tau and has_gain:
            self.notes.append(f"the gain of {name!r} is not used: {tau} is a torque")
        if current and not has_gain:
            raise self._no_gain(name, current)
        return tau or current or ""

    def _wanted(self) -> set[str]:
        """Return which of torque and commands are required of every joint."""
        if self.needs != "any":
            return {self.needs}
        has_torque = any(map(self.has_torque, self.joints))
        has_command = [self.has("qref", joint) for joint in self.joints]
        is_commanded = all(has_command) or (any(has_command) and not has_torque)
        wanted = {"commands"} if is_commanded else set[str]()
        return wanted | ({"torque"} if has_torque or not wanted else set())

    def _has_all_torques(self) -> bool:
        """Return whether every joint has a torque, or a current with a gain; add a note if not."""
        without = [
            joint
            for joint, kind, name in zip(self.joints, *self._places("tau"), strict=True)
            if joint not in self.passive and not self.has(kind, name)
            and not (name in self.gains and self.has(f"current{kind[3:]}", name))
        ]  # fmt: skip
        if without and any(map(self.has_torque, self.joints)):
            self.notes.append(
                f"torques ignored: {listed(without)} have no torque, and no current with a gain"
            )
        return not without

    def _no_gain(self, joint: str, current: str) -> DataError:
        """Return the error of a current without a gain, with the missing columns of all joints."""
        without, absent = [joint], list[str]()
        if joint in self.joints:
            logged = [other for other in self.joints if self.has("current", other)]
            without = [x for x in logged if not self.has("tau", x) and x not in self.gains]
            absent = [x for x in self.joints if not self.has_torque(x)]
        has = f"joint {joint!r} has the current {current!r}"
        if len(without) > 1:
            has = f"joints {listed(without)} have currents"
        flags = " ".join(f"--gain {name}=..." for name in without)
        locks = " ".join(f"--lock {name}=0" for name in absent)
        also = (
            f". No torque of {listed(absent)} was found; if at rest, lock them at their "
            f"positions, as with {locks}"
        )
        return DataError(
            f"{self.where}: {has} but no gain; set it in N m/A: {flags}, or in the job file "
            f"[torque] gains{also if absent else ''}. A payload of known mass determines unknown "
            "gains: robotid payload URDF LOADED --reference BARE --mass KG --gains",
            code="missing_gain",
        )

    def _find_optional(self, kind: str) -> list[str]:
        """Return the columns of an optional quantity; none if a joint does not have it."""
        kinds, joints = self._places(kind)
        columns = list(map(self._find_of, kinds, joints))
        names = [name for name in columns if name]
        without = [joint for joint, name in zip(joints, columns, strict=True) if not name]
        if names and without:
            self.notes.append(f"{listed(names)} ignored: {listed(without)} have no {NOUNS[kind]}")
        return [] if without else names

    def _clocks(self) -> list[str]:
        """Return the columns with time stamps: "time" or "t", else that of the measurement."""
        clocks = [x for x in self.names if is_clock(x) or clock_unit(x) == (self.units.time or "s")]
        plain = [name for name in clocks if name in ("time", "t")]
        return plain or [name for name in clocks if "header" in name.lower()] or clocks

    def has(self, kind: str, joint: str) -> bool:
        """Return whether the file has a quantity of a joint or of its motor."""
        if f"{kind}_{joint}" in self.columns or (kind, joint) in self.reading.columns:
            return True
        is_driven = kind in _OF_JOINTS and joint in self.motors
        return is_driven and self.has(f"{kind}m", self.motors[joint])

    # --- a log that lacks required columns --------------------------------------------------------

    def _require(self, wanted: Collection[str]) -> str:
        """Return the column of time stamps; reject a log without it or any joint's columns."""
        absent = [
            place
            for kind in ("q", *(["qref"] if "commands" in wanted else []))
            for place in zip(*self._places(kind), strict=True)
            if self._find_of(*place) is None
        ]
        if "torque" in wanted:
            absent += [
                (kind, name)
                for joint, kind, name in zip(self.joints, *self._places("tau"), strict=True)
                if joint not in self.passive
                and not (self.has(kind, name) or self.has(f"current{kind[3:]}", name))
            ]
        has_no_gain = any(self.has("current", x) and x not in self.gains for x in self.joints)
        clock = self._find("time", self._clocks())
        if clock and (not absent or (has_no_gain and all(kind == "tau" for kind, _ in absent))):
            return clock  # the error of a missing gain names these joints, too
        read = {*self.joints, *self.motors.values()}
        columns = self.reading.columns.items()
        likely = next(filter(clock_unit, self.names), None)
        recognised = {"time": name} if (name := clock or likely) else {}
        recognised |= {f"{kind}_{x}": own for (kind, x), (own, *_) in columns if x in read}
        recognised |= self.columns
        of_others = {name for (_, x), own in columns if x not in read for name in own}
        names = [name for name in self.names if name not in of_others]
        raise self._missing(names, absent, recognised)

    def _missing(
        self, names: Sequence[str], absent: Sequence[tuple[str, str]], recognised: Mapping[str, str]
    ) -> DataError:
        """Return the error of absent quantities and joints: what was found, a table to complete."""
        has_time = self._find("time", self._clocks()) is not None
        of_joints = [f"{kind}_{self._named(place)}" for kind, place in absent]
        sought = of_joints if has_time else ["time", *of_joints]
        sizes = [name for name in names if name.startswith(_SIZES)]
        left = [x for x in names if x not in {*recognised.values(), *sizes}]
        nouns = dict.fromkeys(NOUNS[kind.removesuffix("m")] for kind, _ in absent)
        ends = tuple(kind.replace("tau", t) + "_" for kind, _ in absent for t in ("tau", "current"))
        of_kind = [column for key, column in recognised.items() if key.startswith(ends or "")]
        references = tuple(f"{kind.removesuffix('ref')}ref_" for kind, _ in absent)
        read = [x for key, x in recognised.items() if key.startswith(references)]
        commanded = [x for x in names if is_commanded(x) and x in {*left, *read}]
        others = [name for name in left if name not in commanded]
        named = f"column{'s' * (len(sought) > 1)} {listed(map(repr, sought), _SHOWN)}"
        found = f"{' and '.join(nouns)} columns found: {listed(of_kind, _SHOWN)}".strip()
        nothing = f"no {' or '.join(nouns)} columns were recognised"
        text = f"{self.where} has no {named}; {found if of_kind else nothing}."
        for label, some in (
            ("Commanded, not measured", [name for name in commanded if name not in of_kind]),
            ("Loads without sign, which are no torques", sizes),
            ("Other columns", others),
        ):
            text += f" {label}: {listed(some, _SHOWN)}." if some else ""
        by_order, remedy = self._by_order(left, absent), self._remedy(absent)
        if has_time and not (by_order or others):
            return DataError(f"{text} {remedy}", code="missing_column")
        lines = [f"{toml_key(key)} = {quoted(x)}" for key, x in recognised.items()]
        lines += [f"{toml_key(key)} = {quoted(x)}  # by order" for key, x in by_order.items()]
        open_keys = ["time"] * ("time" not in recognised) + [*map("_".join, absent)]
        lines += [f'# {toml_key(key)} = "NAME"' for key in open_keys if key not in by_order]
        if by_order:
            remedy += (
                ". This table pairs joints with other names by order: check each line, an exchange "
                "of joints gives wrong parameters"
            )
        return DataError(
            f"{text} {remedy}. If the log has other names for them, set these in the job file:\n"
            + "\n".join(["[columns]", *lines, *self._units_by_name({**recognised, **by_order})]),
            code="missing_column",
        )

    def _units_by_name(self, columns: Mapping[str, str]) -> list[str]:
        """Return the table of units that the names of columns have and nothing states, as lines."""
        angle = "deg" if any("deg" in _words(name) for name in columns.values()) else None
        units = {"time": clock_unit(columns.get("time", "")), "angle": angle}
        lines = [f"{k} = {quoted(x)}" for k, x in units.items() if x and not getattr(self.units, k)]
        return ["[units]  # by the names", *lines] if lines else []

    def _by_order(self, names: Sequence[str], absent: Sequence[tuple[str, str]]) -> dict[str, str]:
        """Return the columns of joints with other names by standard name, in their order."""
        read = [(name, quantity_of(name, self.source.effort)) for name in names]
        known = [(name, *quantity) for name, quantity in read if quantity]
        without = by_number([joint for joint in self.joints if ("q", joint) in absent])
        labels = by_number([label for _, kind, label in known if kind == "q"])
        if not without or len(labels) != len(without):
            return {}
        joint_of = dict(zip(labels, without, strict=True))
        return {
            f"{kind}_{joint_of[label]}": name for name, kind, label in known if label in joint_of
        }

    def _remedy(self, absent: Sequence[tuple[str, str]]) -> str:
        """Return what to do if no column is similar to a missing one."""
        if not absent:
            return "Without time stamps, give the rate of the rows [Hz]: log = { rate = 100 }"
        if at_motors := [name for name in self.names if name.startswith(("qm_", "taum_"))]:
            return f"For columns of motors, as {at_motors[0]}, add [[transmission]], with a matrix"
        kind, joints = absent[0][0], [joint for _, joint in absent]
        if kind == "tau" and not any(map(self.has_torque, self.joints)):
            return without_torque(all(self.has("qref", other) for other in self.joints))
        if kind == "qref" and not any(self.has("qref", other) for other in self.joints):
            return "; ".join(["Record the commands of the controller", *self.notes])
        at_rest = [joint for joint in self.joints if joint in joints]
        if len(at_rest) == len(self.joints):
            return f"Record the {NOUNS[kind.removesuffix('m')]} of each joint"
        leaders = {x.name: x.mimic[0] for x in self.robot if x.mimic and x.name in at_rest}
        if moved := ", ".join(f"{x} mimics {y}" for x, y in leaders.items() if y not in at_rest):
            return (
                f"{moved}: a joint that moves with its leader needs no column; set mimic = "
                '"coupled" in the job file'
            )
        moving = []
        if kind == "tau" and (moves := self.moves) is not None:
            columns = {joint: self._find_of("q", joint) for joint in at_rest}
            moving = [joint for joint, column in columns.items() if column and moves(joint, column)]
        if moving:
            return (
                f"If {listed(moving)}, which moves in the log, has no drive, set passive = "
                f"[{', '.join(map(quoted, moving))}] in the job file; else record its torque"
            )
        names, one = listed(at_rest), len(at_rest) == 1
        locks = " ".join(f"--lock {joint}=0" for joint in at_rest)
        locked = ", ".join(f"{toml_key(joint)} = 0" for joint in at_rest)
        if len(at_rest) > _SHOWN:
            names, locked = f"the other {len(at_rest)} joints", '"*" = 0'
            logged = ",".join(joint for joint in self.joints if joint not in joints)
            locks = f'--joints {logged} --lock "*=0"'
        how = "was at rest, lock it at its position" if one else "were at rest, lock them there"
        return f"If {names} {how}, as {locks}, or locked = {{ {locked} }} in the job file"
