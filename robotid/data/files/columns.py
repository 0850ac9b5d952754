"""Columns of a table: positions, velocities, torques and commands of the joints by their names."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed, quoted, toml_key
from robotid.base.settings import is_number
from robotid.data.files.column_names import KINDS, Reading, by_number, is_clock, read_names
from robotid.data.files.missing import NOUNS, SIZES, Missing
from robotid.data.log import repeated, suggestion
from robotid.data.signal_settings import LogSource
from robotid.data.transmission import Transmission
from robotid.robot.tree import Joint

#: Quantities that are read besides the positions, as of ``lay_out``.
Needs: TypeAlias = Literal["torque", "motion", "commands", "any"]

#: Kinds of columns with torques.
TORQUES = ("tau", "tauref")
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
    """Finds the columns of the wanted joints among the names in a file.

    Attributes:
        where: Name of the file.
        names: Names of its columns.
        columns: Names in the file by standard name, as the user stated them.
        joints: The wanted joints.
        gains: Gains of currents by joint.
        source: Place of the log in the file, and names of its joints.
        gears: Transmissions between motors and joints.
        needs: Quantities that are read besides the positions.
        notes: Notes for the user.
        seen: Columns that are read or named in a note.
        passive: Joints without a drive, which need no torque.
        robot: All movable joints of the robot, in the order of the URDF.
        moves: Returns whether the position of a joint, in a column, changes; None if unknown.
    """

    where: str
    names: list[str]
    columns: Mapping[str, str]
    joints: tuple[str, ...]
    gains: Mapping[str, float]
    source: LogSource
    gears: tuple[Transmission, ...]
    needs: Needs = "torque"
    notes: list[str] = field(default_factory=list)
    seen: set[str] = field(default_factory=set)
    passive: Collection[str] = ()
    robot: Sequence[Joint] = ()
    moves: Callable[[str, str], bool] | None = None

    def find_all(self) -> dict[str, list[str]]:
        """Return the columns to read: time, q, required quantities, complete optional ones."""
        self._check_arguments()
        self.notes.extend(self.reading.notes)
        found = {"time": [self._find("time", self._clocks()) or self._no_time()]}
        optional, wanted = ["dq", "ddq"], self._wanted()
        self._require(wanted)
        found["q"] = [column for _, column in self._each("q") if column]
        if "commands" in wanted:
            found["qref"] = [column for _, column in self._each("qref") if column]
            optional += ["dqref", "tauref"]
        if "torque" in wanted or ("commands" in wanted and self._is_torque_whole()):
            found["tau"] = [
                self._find_torque(self.joints[j], is_motor)
                for j, is_motor in enumerate(self.of_motors("tau"))
            ]
        found |= {kind: names for kind in optional if (names := self._find_optional(kind))}
        self._note_sizes()
        extra = [name for name in self.names if name not in self.seen]
        if extra:
            self.notes.append(f"columns ignored: {listed(extra)}")
        if twice := repeated([name for names in found.values() for name in names if name]):
            raise SettingsError(
                f"{self.where}: {listed(twice)} are read twice; correct columns in the job file"
            )
        return found

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
        return {
            joint: motor
            for gear in self.gears
            for joint, motor in zip(gear.joints, gear.names, strict=True)
        }

    def of_motors(self, kind: str) -> tuple[bool, ...]:
        """Return for which joints a quantity is read from the corresponding motor."""
        kinds = ("tau", "current") if kind == "tau" else (kind,)
        driven = set[str]()
        for gear in self.gears:
            at_motors, at_joints = (
                [found for name in names for k in kinds if (found := self._find_of(k + m, name))]
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

    def _each(self, kind: str) -> list[tuple[tuple[str, str], str | None]]:
        """Return the column of one quantity of each joint, or of its motor.

        Each entry starts with the kind, "q" or "qm", and the name of joint or motor.
        """
        places = [
            (f"{kind}m", self.motors[joint]) if is_motor else (kind, joint)
            for joint, is_motor in zip(self.joints, self.of_motors(kind), strict=True)
        ]
        return [(at, self._find_of(*at)) for at in places]

    def _check_arguments(self) -> None:
        """Reject repeated names in the file, and gains and columns of joints that are not read."""
        if twice := repeated([name for name in self.names if name]):
            raise DataError(
                f"{self.where} has more than one column {listed(twice)}; rename or remove one"
            )
        for joint, gain in self.gains.items():
            self._require_read(joint, "a gain is given for")
            if not (is_number(gain) and np.isfinite(gain)) or gain == 0:
                raise SettingsError(f"gain of {joint!r} is {gain}, wanted a number other than 0")
        for joint in self.source.joints:
            self._require_read(joint, "log.joints renames")
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
                    f"{self.where} has no column {name!r}, which is stated for {standard!r} in "
                    f"columns; columns found: {listed(self.names)}{suggestion(name, self.names)}"
                )

    def _check_names(self) -> None:
        """Reject repeated joints, and two joints, or two motors, with one name in the file."""
        if twice := repeated(self.joints):
            raise SettingsError(f"joints has {listed(twice)} more than once; name each joint once")
        for places in (self.joints, tuple(dict.fromkeys(self.motors.values()))):
            own: dict[str, str] = {}
            for place in places:
                other = own.setdefault(self._named(place), place)
                if other != place:
                    raise SettingsError(
                        f"{self.where}: joints {other} and {place} have the same name "
                        f"{self._named(place)!r} in the log; state another one in [log.joints], "
                        f"or by --rename {place}=NAME"
                    )

    def _require_read(self, joint: str, what: str) -> None:
        if joint not in (*self.joints, *self.motors.values()):
            raise SettingsError(
                f"{self.where}: {what} {joint!r}, which is not among the joints read: "
                f"{listed(self.joints)}{suggestion(str(joint), self.joints)}"
            )

    def _find(self, standard: str, aliases: Sequence[str]) -> str | None:
        """Return the column of one quantity, or None."""
        found = [x for x in aliases if x in self.names and x not in self.columns.values()]
        if standard in self.columns:
            found = [self.columns[standard]]
        if len(found) > 1:
            raise DataError(
                f"{self.where} has {found[0]!r} and {found[1]!r}, two names of the same quantity; "
                f"remove one, or state in the job file columns = {{ {toml_key(standard)} = "
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

    def _find_torque(self, joint: str, is_motor: bool) -> str:
        """Return the torque column of a joint or its motor, or its current column with a gain.

        It is empty for a passive joint.
        """
        if joint in self.passive:
            return ""
        m, joint = ("m", self.motors[joint]) if is_motor else ("", joint)
        tau, current = self._find_of(f"tau{m}", joint), self._find_of(f"current{m}", joint)
        has_gain = joint in self.gains
        if tau and current:
            used, unused = (current, tau) if has_gain else (tau, current)
            self.notes.append(
                f"{unused} ignored: {used} is read ({'a' if has_gain else 'no'} gain)"
            )
            return used
        if tau and has_gain:
            self.notes.append(f"the gain of {joint!r} is not used: {tau} is a torque")
        if current and not has_gain:
            raise self._no_gain(joint, current)
        return tau or current or ""

    def _wanted(self) -> set[str]:
        """Return which of torque and commands are required of every joint."""
        if self.needs != "any":
            return {self.needs}
        has_torque = any(self.has_torque(joint) for joint in self.joints)
        has_command = [self._has("qref", joint) for joint in self.joints]
        is_commanded = all(has_command) or (any(has_command) and not has_torque)
        wanted = {"commands"} if is_commanded else set[str]()
        return wanted | ({"torque"} if has_torque or not wanted else set())

    def _is_torque_whole(self) -> bool:
        """Return whether every joint has a torque, or a current with a gain; add a note if not."""
        without = []
        for joint, is_motor in zip(self.joints, self.of_motors("tau"), strict=True):
            m, name = ("m", self.motors[joint]) if is_motor else ("", joint)
            has_gain = name in self.gains
            has_torque = self._has(f"tau{m}", name) or (has_gain and self._has(f"current{m}", name))
            if not (has_torque or joint in self.passive):
                without.append(joint)
        if without and any(self.has_torque(joint) for joint in self.joints):
            self.notes.append(
                f"torques ignored: {listed(without)} have no torque, and no current with a gain"
            )
        return not without

    def _note_sizes(self) -> None:
        """Add a note on loads without sign, which are not used."""
        sizes = [name for name in self.names if name.startswith(SIZES) and name not in self.seen]
        self.seen.update(sizes)
        if sizes:
            self.notes.append(
                f"{listed(sizes)} ignored: the absolute value of a load does not determine the "
                "direction of the torque"
            )

    def _no_gain(self, joint: str, current: str) -> DataError:
        """Return the error of a current without a gain, with the missing columns of all joints."""
        without = [joint]
        if joint in self.joints:
            logged = [other for other in self.joints if self._has("current", other)]
            without = [x for x in logged if not self._has("tau", x) and x not in self.gains]
        has = f"joint {joint!r} has the current {current!r}"
        if len(without) > 1:
            has = f"joints {listed(without)} have currents"
        gains = ", ".join(f"{toml_key(name)} = ..." for name in without)
        flags = " ".join(f"--gain {name}=..." for name in without)
        absent = [x for x in self.joints if not (self._has("tau", x) or self._has("current", x))]
        also = ""
        if absent and joint in self.joints:
            locks = " ".join(f"--lock {name}=0" for name in absent)
            also = (
                f". No torque of {listed(absent)} was found; if at rest, lock them at their "
                f"positions, as with {locks}"
            )
        return DataError(
            f"{self.where}: {has} but no gain; state it in N m/A: {flags}, or in the job file "
            f"[torque] gains = {{ {gains} }}{also}. A payload of known mass determines unknown "
            "gains: robotid payload URDF LOADED --reference BARE --mass KG --gains",
            code="missing_gain",
        )

    def _find_optional(self, kind: str) -> list[str]:
        """Return the columns of an optional quantity; none if a joint does not have it."""
        found = self._each(kind)
        names = [name for _, name in found if name]
        without = [joint for (_, joint), name in found if not name]
        if names and without:
            self.notes.append(f"{listed(names)} ignored: {listed(without)} have no {NOUNS[kind]}")
        return [] if without else names

    def _clocks(self) -> list[str]:
        """Return the columns with time stamps: "time" or "t", else that of the measurement."""
        clocks = [name for name in self.names if is_clock(name)]
        plain = [name for name in clocks if name in ("time", "t")]
        return plain or [name for name in clocks if "header" in name.lower()] or clocks

    def _no_time(self) -> str:
        """Reject a log without a time column."""
        raise DataError(
            f"{self.where} has no column 'time'; columns found: {listed(self.names)}. Rename it, "
            'or state in the job file: columns = { time = "NAME" }, or without time stamps the '
            "rate of the rows [Hz]: log = { rate = 100 }",
            code="missing_column",
        )

    def _require(self, wanted: Collection[str]) -> None:
        """Reject a log without a required column of any joint."""
        kinds = ["q", *(["qref"] if "commands" in wanted else [])]
        absent = [at for kind in kinds for at, column in self._each(kind) if column is None]
        if "torque" in wanted:
            absent += [
                (f"tau{m}", name)
                for joint, is_motor in zip(self.joints, self.of_motors("tau"), strict=True)
                if joint not in self.passive
                for m, name in [("m", self.motors[joint]) if is_motor else ("", joint)]
                if not (self._has(f"tau{m}", name) or self._has(f"current{m}", name))
            ]
        if not absent:
            return
        has_no_gain = any(self._has("current", x) and x not in self.gains for x in self.joints)
        if has_no_gain and all(kind == "tau" for kind, _ in absent):
            return  # that error names these joints, too
        clock = self._find("time", self._clocks())
        found = {"time": clock} if clock else {}
        read = {*self.joints, *self.motors.values()}
        columns = self.reading.columns.items()
        found |= {f"{kind}_{x}": own for (kind, x), (own, *_) in columns if x in read}
        found |= self.columns
        of_others = {name for (_, x), own in columns if x not in read for name in own}
        names = [name for name in self.names if name not in of_others]
        missing = Missing(self.where, names, absent, self.joints, self.source, found)
        raise missing.error(self._remedy(absent))

    def _remedy(self, absent: Sequence[tuple[str, str]]) -> str:
        """Return what to do if no column is similar to a missing one."""
        if at_motors := [name for name in self.names if name.startswith(("qm_", "taum_"))]:
            return (
                f"For columns of motors, as {at_motors[0]}, state [[transmission]] with joints "
                "and matrix"
            )
        kind, joints = absent[0][0], [joint for _, joint in absent]
        if kind == "tau" and not any(map(self.has_torque, self.joints)):
            return without_torque(all(self._has("qref", other) for other in self.joints))
        if kind == "qref" and not any(self._has("qref", other) for other in self.joints):
            return "; ".join(["Record the commands of the controller", *self.notes])
        at_rest = [joint for joint in self.joints if joint in joints]
        if len(at_rest) == len(self.joints):
            return f"Record the {NOUNS[kind.removesuffix('m')]} of each joint"
        if leaders := {x.name: x.mimic[0] for x in self.robot if x.mimic and x.name in at_rest}:
            moved = ", ".join(f"{joint} mimics {leader}" for joint, leader in leaders.items())
            return (
                f"{moved}: a joint that moves with its leader needs no column; state mimic = "
                '"coupled" in the job file'
            )
        moving = []
        if kind == "tau" and (moves := self.moves) is not None:
            columns = {joint: self._find_of("q", joint) for joint in at_rest}
            moving = [joint for joint, column in columns.items() if column and moves(joint, column)]
        if moving:
            names = ", ".join(map(quoted, moving))
            return (
                f"If {listed(moving)}, which moves in the log, has no drive, state passive = "
                f"[{names}] in the job file; else record its torque"
            )
        locks = " ".join(f"--lock {joint}=0" for joint in at_rest)
        locked = ", ".join(f"{toml_key(joint)} = 0" for joint in at_rest)
        one = len(at_rest) == 1
        how = "was at rest, lock it at its position" if one else "were at rest, lock them there"
        return f"If {listed(at_rest)} {how}, as {locks}, or locked = {{ {locked} }} in the job file"

    def has_torque(self, joint: str) -> bool:
        """Return whether the file has a torque or a current of a joint."""
        return self._has("tau", joint) or self._has("current", joint)

    def has_position(self, joint: str) -> bool:
        """Return whether the file has the position of a joint."""
        return self._has("q", joint)

    def _has(self, kind: str, joint: str) -> bool:
        """Return whether the file has a quantity of a joint or of its motor."""
        return (
            f"{kind}_{joint}" in self.columns
            or (kind, joint) in self.reading.columns
            or (joint in self.motors and self._has(f"{kind}m", self.motors[joint]))
        )
