"""Log files of every format: one row per sample and one column per quantity and joint.

Columns are `time` [s], and for each joint `q_<joint>` [rad or m], optionally `dq_<joint>` and
`ddq_<joint>`, and `tau_<joint>` [N m or N] or `current_<joint>` [A]; and what was commanded,
`qref_<joint>`, optionally `dqref_<joint>` and `tauref_<joint>`. Aliases are read, too. With a
transmission, `qm_<motor>`, `taum_<motor>` [N m] and the like of the motors stand for those.
"""

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from robotid._files import check_path
from robotid._settings import is_number, require_each, require_kind
from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError
from robotid.findings import listed
from robotid.logs.data import (
    COLUMNS,
    Log,
    repeated,
    require_finite,
    require_increasing,
    suggestion,
)
from robotid.logs.foreign_tables import Frame, is_frame, open_frame, with_own_names
from robotid.logs.formats import open_table, write_columns
from robotid.logs.settings import PER_SECOND, LogSource, LogUnits
from robotid.logs.table import Table, prefixes, quantity_of
from robotid.logs.transmission import Transmission, check_transmissions
from robotid.logs.units import check_units

__all__ = ["LogLayout", "Needs", "Readable", "lay_out", "read_log", "read_logs", "write_log"]

#: What is a log, or holds one: a file or a DataFrame with the columns of a log.
Readable = Log | str | Path | Frame

#: What a log is read for beside its positions, as of ``lay_out``.
Needs: TypeAlias = Literal["torque", "motion", "commands", "any"]

_NOUNS = {
    "q": "position",
    "dq": "velocity",
    "ddq": "acceleration",
    "tau": "torque or current",
    "qref": "commanded position",
    "dqref": "commanded velocity",
    "tauref": "commanded torque",
}
_TORQUES = ("tau", "tauref")
_SIZES = ("loadsize_", "load_size_")  # of loads without their sign, as bus servos give them
_SI = LogUnits()
_WHOLE = LogSource()


def read_log(
    path: str | Path | Frame,
    joints: Sequence[str],
    *,
    gains: Mapping[str, float] | None = None,
    columns: Mapping[str, str] | None = None,
    start: float | None = None,
    end: float | None = None,
    units: LogUnits = _SI,
    prismatic: Collection[str] = (),
    source: LogSource = _WHOLE,
    transmissions: Sequence[Transmission] = (),
    needs: Needs = "torque",
) -> Log:
    """Return the log in a file or a DataFrame, in SI units; its notes tell what was ignored.

    Args:
        path: A .csv, .parquet, .npz, .h5, .hdf5, .mat, .mcap, .db3 or .bag file, the folder of
            a ROS 2 bag or of a LeRobot dataset, or a DataFrame of pandas or polars with the same
            columns.
        joints: Names of the joints wanted, in the order wanted.
        gains: Torque per current of joints whose current is read [N m/A or N/A], by joint; a
            current with a gain is preferred to a torque column.
        columns: Name in the file by standard name, as ``{"tau_elbow": "M2"}``, where they differ.
        start: First time stamp kept, on the log's own clock [s].
        end: Last time stamp kept [s].
        units: Units of the file, if not SI.
        prismatic: Names of joints that slide; the others turn. Names that are not read are ignored.
        source: Which topic of a bag or group of a file, names of joints in it, meaning of effort.
        transmissions: The motors and gears, where the file has columns of motors.
        needs: What is wanted beside positions, as of ``lay_out``.

    Raises:
        DataError: If the file does not hold what is wanted, or looks like other units.
        SettingsError: If gains, columns or the source name what is not read.
        MissingDependencyError: If a package that reads the file is not installed.
    """
    layout, table = lay_out(
        path, joints, gains=gains, columns=columns, units=units, prismatic=prismatic,
        source=source, transmissions=transmissions, needs=needs,
    )  # fmt: skip
    log = layout.to_log(table.read(layout.wanted))
    check_units(log, units, prismatic)
    return log if start is None and end is None else log.window(start, end)


def read_logs(
    given: Readable | Sequence[Readable],
    joints: Sequence[str],
    *,
    prismatic: Collection[str] = (),
    needs: Needs = "torque",
) -> tuple[Log, ...]:
    """Return the logs that a user gives, one or several, each read if it is not a ``Log``.

    Args:
        given: A log that has these joints, a path, a DataFrame, or a sequence of these.
        joints: Names of the joints wanted, in the order wanted.
        prismatic: Names of joints that slide; the others turn.
        needs: What is wanted beside positions, as of ``lay_out``.

    Raises:
        DataError: If it is something else, or does not hold what is wanted.
    """
    logs: list[Any]
    if isinstance(given, Log | str | Path | Mapping) or is_frame(given):
        logs = [given]
    elif isinstance(given, Iterable) and getattr(given, "ndim", None) != 0:
        logs = list(given)
    else:
        raise _no_log(given)
    return tuple(
        _of_joints(log, joints, needs)
        if isinstance(log, Log)
        else read_log(log, joints, prismatic=prismatic, needs=needs)
        for log in logs
    )


def _of_joints(log: Log, joints: Sequence[str], needs: Needs) -> Log:
    """Return a log with its columns in the order of some joints, with all that is needed."""
    if not log.has_torque and (needs == "torque" or (needs == "any" and log.q_ref is None)):
        raise DataError(f"{log.name} has no torque. {_without_torque(log.q_ref is not None)}")
    if needs == "commands" and log.q_ref is None:
        raise DataError(
            f"{log.name} has no commanded positions; give them as Log(..., q_ref=...), an array "
            "like q"
        )
    absent = [joint for joint in joints if joint not in log.joints]
    if absent:
        alike = {joint.lower(): joint for joint in absent}
        renamed = [alike.get(joint.lower(), joint) for joint in log.joints]
        pairs = [(x, y) for x, y in zip(log.joints, renamed, strict=True) if x != y]
        if pairs:
            logged, spelt = (listed(names) for names in zip(*pairs, strict=True))
            raise DataError(
                f"{log.name} has the joints {logged}, which the model spells {spelt}; rename them: "
                f"dataclasses.replace(log, joints={tuple(renamed)})"
            )
        held = ", ".join(f"{joint!r}: 0.0" for joint in absent)
        raise DataError(
            f"{log.name} has the joints {listed(log.joints)}, but not {listed(absent)}, which the "
            "model has; record them, or if they stood still, lock them where they stood: "
            f"RobotModel.from_urdf(..., locked={{{held}}})"
        )
    return log if log.joints == tuple(joints) else log.select(joints)


def _without_torque(is_commanded: bool) -> str:
    """Return what a log without any torque can do."""
    begin = "Its commands are" if is_commanded else "Commanded positions, qref_<joint>, would be"
    return (
        f'{begin} enough for [estimator] name = "simulation" with a [controller] table; all other '
        "estimators need tau_<joint> or current_<joint>"
    )


def _no_log(thing: object) -> DataError:
    return DataError(
        f"a log is a {type(thing).__name__}, wanted a robotid.Log, the path of a file, a "
        "DataFrame, or a list of these; Log(t=t, q=q, tau=tau, joints=names) makes one of arrays"
    )


@dataclass(frozen=True)
class LogLayout:
    """Which columns of a file make up a log, and how."""

    path: str
    joints: tuple[str, ...]  # in the order wanted
    columns: Mapping[str, Sequence[str]]  # names in the file of "time", "q", "tau", "dq", "ddq"
    factors: tuple[float, ...]  # what makes each torque column a torque, by joint
    units: LogUnits  # of the file
    prismatic: tuple[str, ...]  # names of joints that slide
    source: LogSource  # where in the file
    notes: tuple[str, ...]  # what the reader should know
    motors: Mapping[str, tuple[bool, ...]]  # by kind: which columns are a motor's
    gears: tuple[Transmission, ...]  # of the motors
    has_torque: bool  # whether the file has a torque or a current of any of the joints

    @property
    def wanted(self) -> list[str]:
        """Names of all columns to read."""
        return [name for names in self.columns.values() for name in names]

    def stamps(self, values: Array) -> Array:
        """Return time stamps in seconds, same shape.

        Args:
            values: The time column.
        """
        return values / PER_SECOND[self.units.time or "s"]

    def to_log(self, table: Mapping[str, Array], first: int = 0) -> Log:
        """Return the log that columns of the file make up, in SI units.

        Args:
            table: The wanted columns by name.
            first: Number in the file of their first row.

        Raises:
            DataError: If a value is not finite, or time does not increase.
        """
        values = {
            kind: np.stack([table[name] for name in names], axis=1)
            for kind, names in self.columns.items()
        }
        slides = np.isin(self.joints, self.prismatic)
        if "tau" in values:
            values["tau"] = values["tau"] * np.array(self.factors)
        for kind, is_motor in self.motors.items():
            if kind not in values:
                continue
            if self.units.angle == "deg" and kind not in _TORQUES:
                is_length = slides & ~np.array(is_motor)
                values[kind] = values[kind] * np.where(is_length, 1.0, np.pi / 180)
            values[kind] = self._of_joints(kind, values[kind])
        t, where = self.stamps(values["time"][:, 0]), Path(self.path).name or "log"
        for kind, array in values.items():
            names = ["time"] if kind == "time" else [f"{kind}_{joint}" for joint in self.joints]
            require_finite(array, t, names, where, first)
            array.flags.writeable = False  # so that the log need not copy it
        require_increasing(t, where, first)
        has_torque = "tau" in values
        if not has_torque:
            values["tau"] = np.zeros_like(values["q"])
        arrays = {name: values[kind] for kind, name in COLUMNS.items() if kind in values}
        return Log(
            t=t, joints=self.joints, path=self.path, notes=self.notes, has_torque=has_torque,
            **arrays,
        )  # fmt: skip

    def _of_joints(self, kind: str, values: Array) -> Array:
        """Return values of joints: those of motors, in their places, through their gears."""
        if not any(self.motors[kind]):
            return values
        values = values.copy()
        for gear in self.gears:
            places = [self.joints.index(joint) for joint in gear.joints]
            if not self.motors[kind][places[0]]:
                continue
            own = values[:, places].T
            moved = gear.to_torque @ own if kind in _TORQUES else np.linalg.solve(gear.T, own)
            if kind in ("q", "qref") and gear.offset:
                moved += np.array(gear.offset)[:, None]
            values[:, places] = moved.T
        return values


def lay_out(
    path: str | Path | Frame,
    joints: Sequence[str],
    *,
    gains: Mapping[str, float] | None = None,
    columns: Mapping[str, str] | None = None,
    units: LogUnits = _SI,
    prismatic: Collection[str] = (),
    source: LogSource = _WHOLE,
    transmissions: Sequence[Transmission] = (),
    needs: Needs = "torque",
) -> tuple[LogLayout, Table]:
    """Return which columns of a file make up a log, before any is read, and its opened table.

    Args:
        path: The file, or a DataFrame.
        joints: Names of the joints wanted, in the order wanted.
        gains: As of ``read_log``.
        columns: As of ``read_log``.
        units: As of ``read_log``.
        prismatic: As of ``read_log``.
        source: As of ``read_log``.
        transmissions: As of ``read_log``.
        needs: What is wanted beside positions: "torque", of every joint; "motion", nothing;
            "commands", a commanded position of every joint, and torques and further commands if
            every joint has them; "any", torques or commands, and both if every joint has them.
            What is not wanted is ignored; torques not read are 0.

    Raises:
        DataError: If the file does not hold what is wanted.
        SettingsError: If gains, columns or the source name what is not read.
        MissingDependencyError: If a package that reads the file is not installed.
    """
    require_kind(needs, str, "needs", f"one of {listed(get_args(Needs))}")
    if needs not in get_args(Needs):
        raise SettingsError(f"needs is {needs!r}, wanted one of {listed(get_args(Needs))}")
    require_kind(joints, Sequence, "joints", "a list of at least one name")
    if isinstance(joints, str) or not joints or not all(isinstance(x, str) for x in joints):
        raise SettingsError(f"joints is {joints!r}, wanted a list of at least one name")
    for name, value, kinds, wanted in (
        ("columns", columns, (Mapping, type(None)), "a table of names by column"),
        ("gains", gains, (Mapping, type(None)), "a table of numbers by joint"),
        ("units", units, LogUnits, "a robotid.LogUnits"),
        ("source", source, LogSource, "a robotid.LogSource"),
    ):
        require_kind(value, kinds, name, wanted)
    require_each(prismatic, str, "prismatic", "a list of names")
    require_each(transmissions, Transmission, "transmissions", "a list of Transmission")
    for key, name in (columns or {}).items():
        require_kind(key, str, "a key of columns", "the standard name of a column")
        require_kind(name, str, f"columns[{key!r}]", "the name of a column")
    if isinstance(path, str | Path):
        check_path(path)
        where, opened = Path(path).name, open_table(Path(path), source)
    elif is_frame(path):
        where, opened = "log", with_own_names(open_frame(path), "log", "DataFrames", source)
    else:
        raise _no_log(path)
    if opened.angle_unit and units.angle is None:
        raise DataError(f"{where}: {opened.angle_unit}", code="angle_unit")
    check_transmissions(transmissions, joints)
    gears = tuple(transmissions)
    stated = {key: opened.renamed.get(name, name) for key, name in (columns or {}).items()}
    finder = _Finder(
        where, opened.names, stated, tuple(joints), gains or {}, source, gears, needs,
        [*opened.notes],
    )  # fmt: skip
    found = finder.find_all()  # names of columns by kind
    layout = LogLayout(
        path=str(Path(path)) if isinstance(path, str | Path) else "",
        joints=tuple(joints),
        columns=found,
        factors=finder.factors(found.get("tau", [])),
        units=units,
        prismatic=tuple(prismatic),
        source=source,
        notes=tuple(finder.notes),
        motors={kind: finder.of_motors(kind) for kind in _NOUNS},
        gears=gears,
        has_torque=any(finder.has_torque(joint) for joint in joints),
    )
    return layout, opened


def write_log(log: Log, path: str | Path) -> None:
    """Write a log with standard column names; reading it gives the same numbers, to the last bit.

    The file is written beside its final place and then moved there: it is never half-written.

    Args:
        log: The log.
        path: A .csv, .parquet, .npz, .h5, .hdf5 or .mat file; one that exists is replaced.

    Raises:
        DataError: If the file name ends otherwise, or the format cannot hold a name.
        MissingDependencyError: If a package that writes the format is not installed.
        OSError: If the folder cannot be written to.
    """
    require_kind(log, Log, "log", "a robotid.Log")
    require_kind(path, (str, Path), "path", "the path of a file")
    table = {"time": log.t}
    for kind, name in COLUMNS.items():
        values = getattr(log, name)
        if values is not None and (kind != "tau" or log.has_torque):
            table |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(log.joints)}
    write_columns(table, Path(path))


@dataclass(frozen=True)
class _Finder:
    """Finds the columns of the wanted joints among the names in a file."""

    where: str
    names: list[str]
    columns: Mapping[str, str]
    joints: tuple[str, ...]
    gains: Mapping[str, float]
    source: LogSource
    gears: tuple[Transmission, ...]
    needs: Needs = "torque"
    notes: list[str] = field(default_factory=list)
    seen: set[str] = field(default_factory=set)  # read, or named in a note of their own

    def find_all(self) -> dict[str, list[str]]:
        """Return the names of the columns to read: of time, q, what is needed, what is complete."""
        self._check_arguments()
        found = {
            "time": [self._find("time", ["time", "t"]) or self._missing("time", "")],
            "q": [column or self._missing(*at) for at, column in self._each("q")],
        }
        optional, wanted = ["dq", "ddq"], self._wanted()
        if "commands" in wanted:
            found["qref"] = self._find_commands()
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
        if twice := repeated([name for names in found.values() for name in names]):
            raise SettingsError(
                f"{self.where}: {listed(twice)} are read twice; correct columns={{...}}"
            )
        return found

    def factors(self, torques: Sequence[str]) -> tuple[float, ...]:
        """Return what makes each of n columns a torque: a current's gain, or 1."""
        currents = {
            self._find_of(kind, name): name
            for kind, names in (("current", self.joints), ("currentm", self.motors.values()))
            for name in names
        }
        return tuple(float(self.gains[currents[n]]) if n in currents else 1.0 for n in torques)

    @property
    def motors(self) -> dict[str, str]:
        """The motor in the place of each joint that has one, by joint."""
        return {
            joint: motor
            for gear in self.gears
            for joint, motor in zip(gear.joints, gear.names, strict=True)
        }

    def of_motors(self, kind: str) -> tuple[bool, ...]:
        """Return of which joints a quantity is read at the motor in their place.

        Args:
            kind: "q", "dq", "ddq" or "tau".

        Raises:
            DataError: If joints of one transmission have it at the motors and at the joints.
        """
        kinds = ("tau", "current") if kind == "tau" else (kind,)
        turned = set[str]()
        for gear in self.gears:
            at_motors, at_joints = (
                [found for name in names for k in kinds if (found := self._find_of(k + m, name))]
                for m, names in (("m", gear.names), ("", gear.joints))
            )
            if at_motors and at_joints:
                raise DataError(
                    f"{self.where} has {at_motors[0]!r} of a motor and {at_joints[0]!r} of a joint "
                    f"that it drives, two {_NOUNS[kind].partition(' ')[0]} columns of one "
                    "transmission; remove one side, or the [[transmission]] that reads the motors"
                )
            turned.update(gear.joints if at_motors else ())
        return tuple(joint in turned for joint in self.joints)

    def _each(self, kind: str) -> list[tuple[tuple[str, str], str | None]]:
        """Return the column of one quantity of each joint, or of the motor in its place.

        Each behind its kind, "q" or "qm", and the name of joint or motor.
        """
        places = [
            (f"{kind}m", self.motors[joint]) if is_motor else (kind, joint)
            for joint, is_motor in zip(self.joints, self.of_motors(kind), strict=True)
        ]
        return [(at, self._find_of(*at)) for at in places]

    def _check_arguments(self) -> None:
        """Refuse names twice in the file, and gains and columns of what is not read."""
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
        names = dict.fromkeys([*self.joints, *self.motors.values()])
        known = ["time", *(f"{kind}_{name}" for kind in prefixes() for name in names)]
        for standard, name in self.columns.items():
            if standard not in known:
                raise SettingsError(
                    f"columns: {standard!r} is not the standard name of a column that is read, "
                    f"as 'time' or 'tau_{self.joints[0]}'{suggestion(standard, known)}"
                )
            if name not in self.names:
                raise DataError(
                    f"{self.where} has no column {name!r}, which columns gives for {standard!r}; "
                    f"columns found: {listed(self.names)}{suggestion(name, self.names)}"
                )

    def _require_read(self, joint: str, what: str) -> None:
        if joint not in (*self.joints, *self.motors.values()):
            raise SettingsError(
                f"{self.where}: {what} {joint!r}, which is not among the joints read: "
                f"{listed(self.joints)}{suggestion(str(joint), self.joints)}"
            )

    def _find(self, standard: str, aliases: Sequence[str]) -> str | None:
        """Return the column of one quantity, or None."""
        found = [a for a in aliases if a in self.names and a not in self.columns.values()]
        if standard in self.columns:
            found = [self.columns[standard]]
        if len(found) > 1:
            raise DataError(
                f"{self.where} has {found[0]!r} and {found[1]!r}, two names of the same quantity; "
                f"remove one, or pass columns={{{standard!r}: ...}}"
            )
        self.seen.update(found)
        return found[0] if found else None

    def _find_of(self, kind: str, joint: str) -> str | None:
        """Return the column of one quantity of one joint, or None."""
        named, starts = self._named(joint), prefixes(self.source.effort)[kind]
        return self._find(f"{kind}_{joint}", [prefix + named for prefix in starts])

    def _named(self, joint: str) -> str:
        """Return the name of a joint in the file."""
        return self.source.joints.get(joint, joint)

    def _find_torque(self, joint: str, is_motor: bool) -> str:
        """Return the column of a joint's or its motor's torque, or current if that has a gain."""
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
        return tau or current or self._missing(f"tau{m}", joint)

    def _wanted(self) -> set[str]:
        """Return which of torque and commands must be there, of every joint."""
        if self.needs != "any":
            return {self.needs}
        has_torque = any(self.has_torque(joint) for joint in self.joints)
        told = [self._has("qref", joint) for joint in self.joints]
        wanted = {"commands"} if all(told) or (any(told) and not has_torque) else set[str]()
        return wanted | ({"torque"} if has_torque or not wanted else set())

    def _is_torque_whole(self) -> bool:
        """Return whether every joint has a torque, or a current with its gain; note it if few."""
        without = []
        for joint, is_motor in zip(self.joints, self.of_motors("tau"), strict=True):
            m, name = ("m", self.motors[joint]) if is_motor else ("", joint)
            has_gain = name in self.gains
            if not (self._has(f"tau{m}", name) or (has_gain and self._has(f"current{m}", name))):
                without.append(joint)
        if without and any(self.has_torque(joint) for joint in self.joints):
            self.notes.append(
                f"torques ignored: {listed(without)} have none, nor a current with a gain"
            )
        return not without

    def _find_commands(self) -> list[str]:
        """Return the columns of the commanded position of every joint."""
        found = self._each("qref")
        without = [joint for (_, joint), column in found if column is None]
        if not without:
            return [column for _, column in found if column]
        known = [name for name in self.names if (quantity_of(name) or ("",))[0] == "qref"]
        if len(without) == len(found):
            raise DataError(
                f"{self.where} has no commanded position, as 'qref_{self.joints[0]}', of any joint "
                f"read; columns of commanded positions found: {listed(known)}. Record what the "
                "controller was told, rename the columns, or pass columns={'qref_<joint>': ...}"
                + "".join(f"; {note}" for note in self.notes),
                code="missing_column",
            )
        raise DataError(
            f"{self.where} has commanded positions, but none of {listed(without)}: no column "
            f"'qref_{self._named(without[0])}'; found: {listed(known)}. Record or rename what is "
            "missing, pass columns={'qref_<joint>': ...}, or lock joints that stood still",
            code="missing_column",
        )

    def _note_sizes(self) -> None:
        """Note loads without their sign, which nothing reads."""
        sizes = [name for name in self.names if name.startswith(_SIZES) and name not in self.seen]
        self.seen.update(sizes)
        if sizes:
            self.notes.append(
                f"{listed(sizes)} ignored: the size of a load without its sign is no torque; it "
                "does not tell a drive that pushes from one that brakes"
            )

    def _no_gain(self, joint: str, current: str) -> DataError:
        """Return the error of a current without a gain, with all that the others lack, too."""
        without = [joint]
        if joint in self.joints:
            logged = [other for other in self.joints if self._has("current", other)]
            without = [x for x in logged if not self._has("tau", x) and x not in self.gains]
        has = f"joint {joint!r} has the current {current!r}"
        if len(without) > 1:
            has = f"joints {listed(without)} have currents"
        more = ", ..." if len(without) > 1 else ""
        flags = " ".join(f"--gain {name}=..." for name in without)
        absent = [x for x in self.joints if not (self._has("tau", x) or self._has("current", x))]
        also = ""
        if absent and joint in self.joints:
            locks = " ".join(f"--lock {name}=0" for name in absent)
            also = (
                f". There is no torque of {listed(absent)} either; if they stood still, lock them "
                f"where they stood, as with {locks}"
            )
        return DataError(
            f"{self.where}: {has} but no gain; give it in N m/A: "
            f"gains={{{without[0]!r}: ...{more}}} (job file table [torque], key gains; CLI "
            f"{flags}){also}",
            code="missing_gain",
        )

    def _find_optional(self, kind: str) -> list[str]:
        """Return the columns of a quantity that every joint has; none if some joint lacks it."""
        found = self._each(kind)
        names = [name for _, name in found if name]
        without = [joint for (_, joint), name in found if not name]
        if names and without:
            self.notes.append(f"{listed(names)} ignored: {listed(without)} have no {_NOUNS[kind]}")
        return [] if without else names

    def _missing(self, kind: str, joint: str) -> str:
        """Refuse a file without a column, naming those of its kind and the nearest."""
        standard = f"{kind}_{joint}" if joint else kind
        noun = f"{_NOUNS[kind.removesuffix('m')]} columns" if joint else "columns"
        kinds, named = (kind, "current") if kind == "tau" else (kind,), self._named(joint)
        others = {self._named(other) for other in self.joints}
        found, ends = [], {}  # columns; and by the joint that they name, if it is not another's
        for name in self.names:
            quantity, end = quantity_of(name, self.source.effort) or ("", name)
            if quantity in kinds or not joint:
                found.append(name)
                if end not in others:
                    ends[end] = name
        nearest = difflib.get_close_matches(named or kind, ends, n=1)
        near = repr(ends[nearest[0]]) if nearest else "..."
        hint = f"Did you mean {near}? " if nearest else ""
        sought = f"{kind}_{named}" if joint else kind
        stood = ""
        if joint in self.joints and kind in _NOUNS:
            stood = f"; if {joint!r} stood still, leave it out of joints and lock it"
            stood += self._how_to_lock()
        if at_motors := [name for name in self.names if name.startswith(f"{kind}m_")]:
            stood = (
                f". Columns of motors, as {at_motors[0]}, need the gears: [[transmission]] with "
                "joints and matrix"
            )
        if kind == "tau" and not any(self.has_torque(other) for other in self.joints):
            is_commanded = all(self._has("qref", other) for other in self.joints)
            stood = f". {_without_torque(is_commanded)}"
        raise DataError(
            f"{self.where} has no column {sought!r}; {noun} found: {listed(found)}. {hint}"
            f"Rename it, or pass columns={{{standard!r}: {near}}}{stood}",
            code="missing_column",
        )

    def _how_to_lock(self) -> str:
        """Return the flags that leave out the joints whose columns are missing, "" if all are."""
        logged = [joint for joint in self.joints if self._is_logged(joint)]
        absent = [joint for joint in self.joints if joint not in logged]
        if not logged:
            return ""
        locks = " ".join(f"--lock {joint}=0" for joint in absent)
        held = ", ".join(f"{joint!r}: 0" for joint in absent)
        return (
            f" where it stood, as with --joints {','.join(logged)} {locks}; in Python "
            f"RobotModel.from_urdf(..., locked={{{held}}})"
        )

    def _is_logged(self, joint: str) -> bool:
        """Return whether the file has what is needed of a joint."""
        wanted = self._wanted()
        return (
            self._has("q", joint)
            and ("torque" not in wanted or self.has_torque(joint))
            and ("commands" not in wanted or self._has("qref", joint))
        )

    def has_torque(self, joint: str) -> bool:
        """Return whether the file has a torque or a current of a joint."""
        return self._has("tau", joint) or self._has("current", joint)

    def _has(self, kind: str, joint: str) -> bool:
        """Return whether the file has a quantity of a joint, or of the motor in its place."""
        names = (prefix + self._named(joint) for prefix in prefixes(self.source.effort)[kind])
        return (
            f"{kind}_{joint}" in self.columns
            or any(name in self.names for name in names)
            or (joint in self.motors and self._has(f"{kind}m", self.motors[joint]))
        )
