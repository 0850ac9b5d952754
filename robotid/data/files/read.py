"""Log files of every format: one row per sample and one column per quantity and joint.

Columns are `time` [s], and for each joint `q_<joint>` [rad or m], optionally `dq_<joint>` and
`ddq_<joint>`, and `tau_<joint>` [N m or N] or `current_<joint>` [A]. Commands are `qref_<joint>`,
optionally `dqref_<joint>` and `tauref_<joint>`. With a transmission, columns of the motors are
read instead, as `qm_<motor>` and `taum_<motor>` [N m]. ``column_names`` reads other spellings.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, get_args

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import (
    DATASET,
    check_file,
    check_path,
    dataset_of,
    missing_file,
    written_whole,
)
from robotid.base.findings import listed
from robotid.base.settings import require_each, require_kind
from robotid.base.typing import Array
from robotid.data.base_motion import BaseColumns, base_columns, base_of, contacts_of, table_of_base
from robotid.data.files.arrays import HDF5, MAT, NPZ
from robotid.data.files.bags import BAG
from robotid.data.files.columns import NOUNS, TORQUES, Finder, Needs, without_torque
from robotid.data.files.csv_files import CSV
from robotid.data.files.parquet_files import LEROBOT, PARQUET
from robotid.data.files.table import (
    Format,
    Frame,
    Table,
    is_frame,
    open_frame,
    with_even_stamps,
    with_standard_names,
    with_stated_names,
    with_time,
)
from robotid.data.log import COLUMNS, Log, require_finite, require_increasing
from robotid.data.signal_settings import (
    PER_SECOND,
    LogSource,
    LogUnits,
    Transmission,
    check_transmissions,
)
from robotid.data.units import STILL, check_units, turned
from robotid.robot.tree import Joint

#: A log, or a file or a DataFrame with the columns of a log.
Readable = Log | str | Path | Frame

#: All formats of files; BAG and LEROBOT are folders, too.
FORMATS = (CSV, PARQUET, NPZ, HDF5, MAT, BAG)
_READ = {suffix: form for form in FORMATS for suffix in form.suffixes}
_WRITTEN = {suffix: form.write for form in FORMATS for suffix in form.written if form.write}
_LONGEST_NAME = 1000  # characters of a column
_SI = LogUnits()
_WHOLE = LogSource()
_SPARSE = 0.02  # share of rows without a value from which a column has another rate
_BASE = BaseColumns()


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
    base: BaseColumns = _BASE,
    passive: Collection[str] = (),
    robot: Sequence[Joint] = (),
) -> Log:
    """Return the log in a file or a DataFrame, in SI units; its notes list ignored columns.

    Args:
        path: A .csv, .parquet, .npz, .h5, .hdf5, .mat, .mcap, .db3 or .bag file, the folder of
            a ROS 2 bag or of a LeRobot dataset, or a DataFrame of pandas or polars with the same
            columns.
        joints: Names of the required joints, in the required order.
        gains: Torque per current of joints whose current is read [N m/A or N/A], by joint; a
            current with a gain is preferred to a torque column.
        columns: Name in the file by standard name, as ``{"tau_elbow": "M2"}``, if they differ.
        start: First time stamp of the result, on the log's own clock [s].
        end: Last time stamp of the result [s].
        units: Units of the file, if not SI.
        prismatic: Names of prismatic joints; the others are revolute. Unknown names are ignored.
        source: The topic of a bag or group of a file, names of joints in it, quantity of effort.
        transmissions: The motors and gears, if the file has columns of motors.
        needs: Quantities that are required besides positions, as of ``lay_out``.
        base: Columns of a floating base and of contacts; none if not given.
        passive: Joints without a drive, which need no torque; without a position, they are not
            joints of the log.
        robot: All movable joints of the robot, in the order of the URDF: that of numbered columns.

    Raises:
        DataError: If a required column is missing, or the values look like other units.
        SettingsError: If gains, columns or the source have names that are not read.
        MissingDependencyError: If a package that reads the file is not installed.
    """
    require_kind(base, BaseColumns, "base", "a BaseColumns")
    require_each(passive, str, "passive", "names of joints")
    layout, table = lay_out(
        path, joints, gains=gains, columns=columns, units=units, prismatic=prismatic,
        source=source, transmissions=transmissions, needs=needs, base=base, passive=passive,
        robot=robot,
    )  # fmt: skip
    log = layout.to_log(table.read(layout.wanted))
    check_units(log, units, prismatic, layout.turning)
    return log if start is None and end is None else log.window(start, end)


def read_logs(
    given: Readable | Sequence[Readable],
    joints: Sequence[str],
    *,
    prismatic: Collection[str] = (),
    needs: Needs = "torque",
    base: BaseColumns = _BASE,
    passive: Collection[str] = (),
    robot: Sequence[Joint] = (),
) -> tuple[Log, ...]:
    """Return the logs of a user, one or several; files and DataFrames are read."""
    logs: list[Any]
    if isinstance(given, Log | str | Path | Mapping) or is_frame(given):
        logs = [given]
    elif isinstance(given, Iterable) and getattr(given, "ndim", None) != 0:
        logs = list(given)
    else:
        raise _no_log(given)
    return tuple(
        _of_joints(log, joints, "motion" if log.wrenches and needs == "torque" else needs, passive)
        if isinstance(log, Log)
        else read_log(
            log, joints, prismatic=prismatic, needs=needs, base=base, passive=passive, robot=robot
        )
        for log in logs
    )


def _of_joints(log: Log, joints: Sequence[str], needs: Needs, passive: Collection[str] = ()) -> Log:
    """Return a log with its columns in the order of some joints, with all required quantities."""
    joints = [joint for joint in joints if joint in log.joints or joint not in passive]
    if not log.has_torque and (needs == "torque" or (needs == "any" and log.q_ref is None)):
        given = 'with estimator="simulation", controller={"kp": N_M_PER_RAD}'
        raise DataError(f"{log.name} has no torque. {without_torque(log.q_ref is not None, given)}")
    if needs == "commands" and log.q_ref is None:
        raise DataError(
            f"{log.name} has no commanded positions; pass them as Log(..., q_ref=...), an array "
            "with the shape of q"
        )
    absent = [joint for joint in joints if joint not in log.joints]
    if absent:
        alike = {joint.lower(): joint for joint in absent}
        renamed = [alike.get(joint.lower(), joint) for joint in log.joints]
        pairs = [(x, y) for x, y in zip(log.joints, renamed, strict=True) if x != y]
        if pairs:
            logged, spelt = (listed(names) for names in zip(*pairs, strict=True))
            raise DataError(
                f"{log.name} has the joints {logged}, which are {spelt} in the model; rename them: "
                f"dataclasses.replace(log, joints={tuple(renamed)})"
            )
        locked = ", ".join(f"{joint!r}: 0.0" for joint in absent)
        raise DataError(
            f"{log.name} has the joints {listed(log.joints)}, but not {listed(absent)}, which the "
            "model has; record them, or if they were at rest, lock them at their positions: "
            f"RobotModel.from_urdf(..., locked={{{locked}}})"
        )
    return log if log.joints == tuple(joints) else log.select(joints)


def _no_log(thing: object) -> DataError:
    return DataError(
        f"a log is a {type(thing).__name__}, expected a robotid.Log, the path of a file, a "
        "DataFrame, or a list of these; for arrays use Log(t=t, q=q, tau=tau, joints=names)"
    )


@dataclass(frozen=True)
class LogLayout:
    """The columns of a file that are read, and their conversion to a log."""

    path: str
    joints: tuple[str, ...]  # in the required order
    columns: Mapping[str, Sequence[str]]  # names in the file of "time", "q", "tau", "dq", "ddq"
    factors: tuple[float, ...]  # from each torque column to a torque, by joint
    units: LogUnits  # of the file
    prismatic: tuple[str, ...]  # names of prismatic joints
    source: LogSource  # place of the log in the file
    notes: tuple[str, ...]  # for the user
    motors: Mapping[str, tuple[bool, ...]]  # by kind: which columns are of motors
    gears: tuple[Transmission, ...]  # of the motors
    has_torque: bool  # whether the file has a torque or a current of any of the joints
    base: BaseColumns = _BASE  # of a floating base and of contacts
    positions: Mapping[str, str] = field(default_factory=dict)  # likewise, of all joints in it
    assumed: tuple[str, ...] = ()  # of the columns, for the user
    turning: tuple[str, ...] = ()  # names of revolute joints whose rotation has no limits

    @property
    def wanted(self) -> list[str]:
        """Names of all columns to read."""
        return [name for names in self.columns.values() for name in names if name]

    def stamps(self, values: Array) -> Array:
        """Return time stamps in seconds, same shape."""
        return values / PER_SECOND[self.units.time or "s"]

    def to_log(self, table: Mapping[str, Array], first: int = 0) -> Log:
        """Return the log in SI units, from columns of the file."""
        nothing = np.zeros(len(table[self.columns["time"][0]]))  # torque of a passive joint
        values = {
            kind: np.stack([table[name] if name else nothing for name in names], axis=1)
            for kind, names in self.columns.items()
        }
        if "tau" in values:
            values["tau"] = values["tau"] * np.array(self.factors)
        for kind, is_motor in self.motors.items():
            if kind not in values:
                continue
            if kind not in TORQUES:
                values[kind] = self._to_si(kind, values[kind], is_motor)
            values[kind] = self._of_joints(kind, values[kind])
        t, where = self.stamps(values["time"][:, 0]), Path(self.path).name or "log"
        for kind, array in values.items():
            if kind in ("contact", "wrench") or kind.startswith("base "):
                _require_rate(array, self.columns[kind], where)
                require_finite(array, t, self.columns[kind], where, first)
        base, note = base_of(t, values["q"], values, self.base)
        flags = values.pop("contact", None)
        contacts = {} if flags is None else contacts_of(flags, self.base, where)
        forces = values.pop("wrench", np.empty((0, 0)))
        wrenches = dict(zip(self.base.wrenches, forces.T, strict=True))
        values = {kind: array for kind, array in values.items() if not kind.startswith("base ")}
        for kind, array in values.items():
            names = ["time"] if kind == "time" else [f"{kind}_{joint}" for joint in self.joints]
            require_finite(array, t, names, where, first)
            array.flags.writeable = False  # so that the log does not copy it
        require_increasing(t, where, first)
        notes = (*self.notes, note) if note else self.notes
        unstated = self.turning if self.units.angle is None else ()
        assumed = (*self.assumed, *turned(self.joints, values["q"], unstated))
        has_torque = "tau" in values
        if not has_torque:
            values["tau"] = np.zeros_like(values["q"])
        arrays = {name: values[kind] for kind, name in COLUMNS.items() if kind in values}
        return Log(
            t=t, joints=self.joints, path=self.path, notes=notes, assumed=assumed,
            has_torque=has_torque,
            base=base, contacts=contacts, wrenches=wrenches, **arrays,
        )  # fmt: skip

    def _to_si(self, kind: str, values: Array, is_motor: Sequence[bool]) -> Array:
        """Return positions or their derivatives in rad or m and s."""
        if self.units.angle != "deg" and not self.units.percent:
            return values
        is_angle = np.array(is_motor) | ~np.isin(self.joints, self.prismatic)
        scales = [
            self.units.scale(joint, is_angle=bool(own))
            for joint, own in zip(self.joints, is_angle, strict=True)
        ]
        first, scale = np.array(scales).T
        return np.asarray(first + scale * values if kind in ("q", "qref") else scale * values)

    def _of_joints(self, kind: str, values: Array) -> Array:
        """Return values of joints; those of motors are converted by their transmission."""
        if not any(self.motors[kind]):
            return values
        values = values.copy()
        for gear in self.gears:
            places = [self.joints.index(joint) for joint in gear.joints]
            if not self.motors[kind][places[0]]:
                continue
            own = values[:, places].T
            to_torque = gear.T.T * (gear.efficiency or 1.0)  # T^T diag(efficiency)
            moved = to_torque @ own if kind in TORQUES else np.linalg.solve(gear.T, own)
            if kind in ("q", "qref") and gear.offset:
                moved += np.array(gear.offset)[:, None]
            values[:, places] = moved.T
        return values


def _require_rate(values: Array, names: Sequence[str], where: str) -> None:
    """Refuse columns that have no value in many rows, as those of another rate."""
    share = np.isnan(values).mean(axis=0)
    if (share > _SPARSE).any():
        sparse = [name for name, own in zip(names, share, strict=True) if own > _SPARSE]
        raise DataError(
            f"{where}: {share.max():.0%} of the rows have no value of {listed(sparse)}, as of "
            "another rate than the joints'; interpolate at the time stamps of the joints, "
            "or keep the rows that have all values"
        )


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
    base: BaseColumns = _BASE,
    passive: Collection[str] = (),
    robot: Sequence[Joint] = (),
) -> tuple[LogLayout, Table]:
    """Return the layout of a log in a file, before its columns are read, and its open table."""
    require_kind(needs, str, "needs", f"one of {listed(get_args(Needs))}")
    if needs not in get_args(Needs):
        raise SettingsError(f"needs is {needs!r}, expected one of {listed(get_args(Needs))}")
    require_kind(joints, Sequence, "joints", "a list of at least one name")
    if isinstance(joints, str) or not joints or not all(isinstance(x, str) for x in joints):
        raise SettingsError(f"joints is {joints!r}, expected a list of at least one name")
    for name, value, kinds, wanted in (
        ("columns", columns, (Mapping, type(None)), "a table of names by column"),
        ("gains", gains, (Mapping, type(None)), "a table of numbers by joint"),
        ("units", units, LogUnits, "a LogUnits"),
        ("source", source, LogSource, "a LogSource"),
    ):
        require_kind(value, kinds, name, wanted)
    require_each(prismatic, str, "prismatic", "a list of names")
    require_each(transmissions, Transmission, "transmissions", "a list of Transmission")
    for key, name in (columns or {}).items():
        require_kind(key, str, "a key of columns", "the standard name of a column")
        require_kind(name, str, f"columns[{key!r}]", "the name of a column")
    where, opened = _opened(path, source)
    if opened.angle_unit and units.angle is None:
        raise DataError(f"{where}: {opened.angle_unit}", code="angle_unit")
    check_transmissions(transmissions, joints)
    stated = {key: opened.renamed.get(name, name) for key, name in (columns or {}).items()}
    of_base = base_columns(where, opened.names, base, stated)
    twist = opened.axes.get("twist", base.twist)
    base = replace(base.present([*opened.names, *stated]), twist=twist)
    notes = [*opened.notes, *_notes_of_sensors(where, opened, of_base, base)]
    of_joints = {x: y for x, y in stated.items() if y not in chain.from_iterable(of_base.values())}
    finder = Finder(
        where, opened.names, of_joints, tuple(joints), gains or {}, source, tuple(transmissions),
        needs, notes, {*chain.from_iterable(of_base.values()), *opened.sensors}, passive,
        tuple(robot), partial(_moves, opened, units, prismatic), units,
    )  # fmt: skip
    joints = [joint for joint in joints if joint not in passive or finder.has("q", joint)]
    finder = replace(finder, joints=tuple(joints))
    if base.wrenches and needs in ("torque", "any") and not any(map(finder.has_torque, joints)):
        finder = replace(finder, needs="motion")
    by_kind = finder.find_all() | of_base  # names of columns by kind
    layout = LogLayout(
        path=str(Path(path)) if isinstance(path, str | Path) else "",
        joints=tuple(joints),
        columns=by_kind,
        factors=finder.factors(by_kind.get("tau", [])),
        units=units,
        prismatic=tuple(prismatic),
        source=source,
        notes=tuple(finder.notes),
        motors={kind: finder.of_motors(kind) for kind in NOUNS},
        gears=finder.gears,
        has_torque=any(finder.has_torque(joint) for joint in joints),
        base=base,
        positions=finder.reading.positions,
        assumed=finder.reading.assumed,
        turning=tuple(joint.name for joint in robot if joint.turns_freely),
    )
    return layout, with_even_stamps(opened, by_kind["time"][0], source.stamp)


def _opened(path: str | Path | Frame, source: LogSource) -> tuple[str, Table]:
    """Return the name of a log and its open table."""
    if isinstance(path, str | Path):
        check_path(path)
        return Path(path).name, open_table(Path(path), source)
    if not is_frame(path):
        raise _no_log(path)
    table = with_stated_names(open_frame(path), "log", source.names)
    return "log", with_time(with_standard_names(table, "log", "DataFrames", source), source.rate)


def _moves(
    table: Table, units: LogUnits, prismatic: Collection[str], joint: str, column: str
) -> bool:
    """Return whether the position of a joint changes in its column."""
    values = units.scale(joint, is_angle=joint not in prismatic)[1] * table.read([column])[column]
    return bool(len(values) and np.ptp(values) > STILL)


def _notes_of_sensors(
    where: str, table: Table, columns: Mapping[str, Sequence[str]], base: BaseColumns
) -> list[str]:
    """Return a note on the columns of other topics; reject wrenches whose axes are not given."""
    forces = [name for name in columns.get("wrench", ()) if name in table.sensors]
    links = {name.partition(" ")[2] for name in base.wrenches} - {*base.local}
    if forces and links and table.axes.get("wrench") == "link":
        raise DataError(
            f"{where}: {listed(forces)} have the axes of their frames, but [[contact]] of "
            f"{listed(sorted(links))} has the axes of the world; set axes = 'link'"
        )
    used = [table.sensors[x] for own in columns.values() for x in own if x in table.sensors]
    if not used:
        return []
    return [f"interpolated at the stamps of the joints: {listed(list(dict.fromkeys(used)))}"]


def write_log(log: Log, path: str | Path) -> None:
    """Write a log with standard column names; reading it returns exactly the same numbers.

    A temporary file in the same folder is written and then renamed, so the file is always complete.

    Args:
        log: The log.
        path: A .csv, .parquet, .npz, .h5, .hdf5 or .mat file; an existing one is
            replaced only if robotid wrote it.

    Raises:
        DataError: If the suffix is another one, or a name is not valid in the format.
        MissingDependencyError: If a package that writes the format is not installed.
        SettingsError: If the file is that of the log, or another that robotid did not write.
    """
    require_kind(log, Log, "log", "a robotid.Log")
    require_kind(path, (str, Path), "path", "the path of a file")
    check_file(Path(path), [log.path])
    table = {"time": log.t}
    for kind, name in COLUMNS.items():
        values = getattr(log, name)
        if values is not None and (kind != "tau" or log.has_torque):
            table |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(log.joints)}
    table |= table_of_base(log.base, log.contacts, log.wrenches)
    write_columns(table, Path(path))


def open_table(path: Path, source: LogSource) -> Table:
    """Return the table in a file; faults of a column are reported when it is read."""
    if (dataset := dataset_of(path)) is not None:
        if source.topic not in (None, path.name):
            raise SettingsError(
                f"log.topic is {source.topic!r}, but the log is {path.name} of {dataset.name}; "
                "leave topic out"
            )
        path, source = dataset, replace(source, topic=path.name)
    form = _format_of(path)
    if source.command is not None and form is not BAG:
        raise SettingsError(
            f"log.command is {source.command!r}, the topic of a bag, but {path.name} is no bag; "
            "write the commands to columns, as qref_<joint>"
        )
    table = with_stated_names(form.open(path, source), path.name, source.names)
    if not form.topics:
        table = with_standard_names(table, path.name, f"{path.suffix} files", source)
    table = with_time(table, source.rate)
    for name in table.names:
        if len(name) > _LONGEST_NAME:
            raise DataError(
                f"{path.name}: a column has a name of {len(name)} characters, {name[:40]!r}..., "
                f"expected at most {_LONGEST_NAME}; rename it"
            )
    return table


def _format_of(path: Path) -> Format:
    """Return the format of a log that exists."""
    if path.is_dir():
        return LEROBOT if (path / DATASET).is_file() else BAG
    suffix = path.suffix.lower()
    if path.exists() and suffix not in _READ:
        raise DataError(
            f"{path.name}: the suffix is {suffix!r}, expected a log file of type "
            f"{_alternatives(list(_READ))}, or the folder of a ROS 2 bag or of a LeRobot dataset; "
            "convert it"
        )
    if not path.is_file():
        raise DataError(missing_file(path, "log file"))
    return _READ[suffix]


def write_columns(table: Mapping[str, Array], path: Path) -> None:
    """Write columns (N,) to a file, all or none; they are read exactly as written."""
    write = _WRITTEN[check_suffix(path)]
    with written_whole(path) as temporary:
        write(table, temporary)


def check_suffix(path: Path, what: str = "logs", *, also: Sequence[str] = ()) -> str:
    """Return the suffix of a file to write; used before its content is computed."""
    suffix = path.suffix.lower()
    if suffix not in _WRITTEN:
        found = f"not {suffix!r}" if suffix else "but the name has no extension"
        raise DataError(
            f"{path.name}: {what} are written as {_alternatives([*_WRITTEN, *also])} files, {found}"
        )
    return suffix


def _alternatives(words: list[str]) -> str:
    """Return words with commas, and "or" before the last."""
    return f"{', '.join(words[:-1])} or {words[-1]}"
