"""The job: robot, logs and settings, from TOML or from flags; every key is checked."""

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_path, read_toml
from robotid.base.findings import listed
from robotid.base.settings import (
    POSITIVE,
    Entries,
    Key,
    Range,
    Settings,
    check_keys,
    require_kind,
    setting,
    table_in,
)
from robotid.data.files.columns import Needs
from robotid.data.files.read import LogLayout, lay_out, read_log
from robotid.data.files.table import Table
from robotid.data.log import Log
from robotid.data.signal_settings import (
    BaseSource,
    LogSource,
    LogUnits,
    SignalSettings,
    Transmission,
    check_transmissions,
)
from robotid.dynamics.constraint_rows import logged_base
from robotid.estimation.fitting.estimator_settings import (
    ESTIMATORS,
    ConsistentSettings,
    EstimatorSettings,
    SimulationSettings,
)
from robotid.identification.closed_loop.loop_settings import LogGains, LoopSettings
from robotid.robot.constraints import Contact, Loop
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import AUTO, DRIVE_TERMS, FAMILIES, TERMS, term_from_dict
from robotid.robot.parameters import DYNAMICS, Coupling

if TYPE_CHECKING:
    from robotid.robot.model import RobotModel


_MODEL_KEYS: Mapping[str, tuple[type, ...]] = {
    "friction" if term.is_friction else name: (str,) if term.is_friction else (bool,)
    for name, term in TERMS.items()
}
_PLAIN = tuple(name for name, term in TERMS.items() if term.is_friction)
_FILE: Mapping[str, Any] = {"reads": (str,), "load": Path, "dump": lambda path: str(path.resolve())}


def _load_terms(table: Mapping[str, Any]) -> tuple[str, ...]:
    friction = table.get("friction", AUTO)
    names = {"none": [], AUTO: [*_PLAIN, AUTO]}.get(friction, friction.split("+"))
    known = [*_PLAIN, *FAMILIES]
    if friction != AUTO:
        for name in names:
            if name not in known:
                raise SettingsError(
                    f"friction is {friction!r}, expected auto, none, or some of {listed(known)}, "
                    "separated by +"
                )
    switched = [name for name in TERMS if name not in _PLAIN and table.get(name, True)]
    common = [name for name in TERMS if name in (*names, *switched)]
    return (*common, *(name for name in names if name not in TERMS))


def _dump_terms(terms: Sequence[str]) -> dict[str, str | bool]:
    friction = [term for term in terms if term in _PLAIN or term not in TERMS]
    named = AUTO if AUTO in friction else "+".join(friction) or "none"
    return {key: named if key == "friction" else key in terms for key in _MODEL_KEYS}


def _load_drives(table: Mapping[str, Sequence[Any]]) -> dict[str, tuple[str | DriveTerm, ...]]:
    return {joint: tuple(_load_term(joint, e) for e in entries) for joint, entries in table.items()}


def _load_term(joint: str, entry: Any) -> str | DriveTerm:  # noqa: ANN401
    if not isinstance(entry, str):
        try:
            return term_from_dict(entry)
        except SettingsError as error:
            raise SettingsError(f"drives.{joint}: {error}") from error
    if entry not in FAMILIES:
        wanted = f"some of {listed(FAMILIES)}, or a table with the shape of a term"
        raise SettingsError(f"drives.{joint} has {entry!r}, expected {wanted}")
    return entry


def _dump_drives(drives: Mapping[str, Sequence[str | DriveTerm]]) -> dict[str, list[Any]]:
    return {
        joint: [e if isinstance(e, str) else e.to_dict() for e in entries]
        for joint, entries in drives.items()
    }


@dataclass(frozen=True)
class LogEntry(Settings):
    """One log of a job."""

    path: Path = setting(MISSING, "the file", at="log", **_FILE)
    start: float | None = setting(None, "start of the window in the log's own time [s]")
    end: float | None = setting(None, "end of the window [s]")
    unit: str | None = setting(
        None, "name of the robot, if the logs are of several robots of one kind, as 'arm-07'"
    )
    controller: LogGains = setting(
        LogGains(), "gains that differ from [controller]",
        dump=lambda gains: gains.to_dict() or None,
    )  # fmt: skip


@dataclass(frozen=True)
class PayloadEntry(Settings):
    """A log with a payload of known mass, which checks the scale of the torques."""

    path: Path = setting(MISSING, "the file, with the payload that the fitted logs lack",
                         at="log", **_FILE)  # fmt: skip
    mass: float = setting(
        MISSING, "known mass of the payload [kg]",
        within=Range("more than 0 and less than 1e6", lambda x: 0 < x < 1e6),
    )  # fmt: skip
    link: str = setting("", "link that carries it; default: the last moving link")
    start: float | None = setting(None, "start of the window in the log's own time [s]")
    end: float | None = setting(None, "end of the window [s]")


@dataclass(frozen=True)
class Job(Settings):
    """The robot, logs and settings of an identification."""

    urdf: Path = setting(MISSING, "the URDF file", **_FILE)
    joints: tuple[str, ...] | None = setting(
        None, "joints to identify, in order; default: all movable joints"
    )
    locked: Mapping[str, float] = setting(
        {}, 'positions of locked joints, "*" for all other joints [rad or m]'
    )
    gravity: tuple[float, float, float] = setting(
        (0.0, 0.0, -9.81), "gravity in the root link's frame [m/s^2]"
    )
    free_flyer: bool = setting(
        False, "whether the base floats; logs have its pose, base_x to base_qw"
    )
    mimic: str = setting(
        "independent", "independent, or coupled: a mimic joint moves with its leader"
    )
    snap_angles: bool = setting(
        False, "whether rounded angles of the URDF's joints, such as 3.1416, are replaced by the "
        "nearest multiple of pi/12",
    )  # fmt: skip
    signals: SignalSettings = setting(SignalSettings(), "signal processing of the logs")
    terms: tuple[str, ...] = setting(
        (*DRIVE_TERMS, AUTO), "drive terms to identify", at="model", reads=_MODEL_KEYS,
        load=_load_terms, dump=_dump_terms,
    )  # fmt: skip
    model_dynamics: str = setting(
        "full",
        "full; or static, for logs of poses and slow sweeps: masses, first moments, Coulomb "
        "friction and offsets are identified, the others keep the URDF's values",
        at="model.dynamics", among=DYNAMICS,
    )  # fmt: skip
    drives: Mapping[str, tuple[str | DriveTerm, ...]] = setting(
        {},
        "further friction of single joints, by joint: names of friction terms, whose shape is "
        "identified, or a term with its shape, such as { term = 'Harmonic', order = 101.0 }",
        reads=Entries(dict, (list,)), load=_load_drives, dump=_dump_drives,
    )  # fmt: skip
    gains: Mapping[str, float] = setting(
        {}, "torque per current of joints logged as current [N m/A or N/A]", at="torque.gains"
    )
    couplings: tuple[Coupling, ...] = setting(
        (),
        "drives that move several joints, each with a name and its ratios by joint [-]; with "
        "replaces = true it replaces the drive of the joint of that name",
        at="coupling",
    )
    transmissions: tuple[Transmission, ...] = setting(
        (), "motors and gears, where logs have columns of motors", at="transmission"
    )
    columns: Mapping[str, str] = setting(
        {}, "column names in the logs that differ from the standard ones"
    )
    source: LogSource = setting(LogSource(), "location of the signals in the log files", at="log")
    units: LogUnits = setting(LogUnits(), "units of the logs, if not SI")
    base: BaseSource = setting(BaseSource(), "motion of a floating base in the logs")
    contacts: tuple[Contact, ...] = setting((), "links that may touch the ground", at="contact")
    loops: tuple[Loop, ...] = setting(
        (), "connections of two links that close kinematic chains", at="loop"
    )
    passive: tuple[str, ...] = setting(
        (),
        "joints without a drive: their torque is 0 and needs no column; positions that logs lack "
        "are computed from the loops; no friction except the terms in [drives]",
    )
    estimator: EstimatorSettings = setting(ConsistentSettings(), "estimator and its settings")
    controller: LoopSettings = setting(
        LoopSettings(), "position controller of the drives, for the estimator 'simulation'",
        dump=lambda loop: None if loop == LoopSettings() else loop.to_dict(),
    )  # fmt: skip
    dynamics: bool = setting(
        False, "whether the identified friction is also written to <dynamics> of the URDF",
        at="output.dynamics",
    )  # fmt: skip
    report: bool = setting(True, "whether report.html is written", at="output.report")
    replay: bool = setting(
        False, "whether replay.html is written: the first validation log, or the first fitted log",
        at="output.replay",
    )  # fmt: skip
    identification: tuple[LogEntry, ...] = setting((), "logs to fit")
    validation: tuple[LogEntry, ...] = setting((), "validation logs")
    payload_checks: tuple[PayloadEntry, ...] = setting(
        (), "logs with a payload of known mass, which check the scale of the torques",
        at="payload_check",
    )  # fmt: skip
    ignore: tuple[str, ...] = setting(
        (), "codes of the doctor's findings to ignore", at="doctor.ignore"
    )
    rows_in_memory: int = setting(
        2**17, "total number of rows of all logs above which they are read in pieces",
        at="reduction.rows_in_memory", within=POSITIVE,
    )  # fmt: skip
    workers: int | None = setting(
        None, "worker processes for the pieces; default: one per core for long logs",
        at="reduction.workers", within=Range("1 to 1024", lambda x: 1 <= x <= 1024),
    )  # fmt: skip

    @classmethod
    def paths(cls) -> dict[str, Key]:
        """Return the description of each key, also of keys without a field of their own."""
        friction = Key(
            "auto: selected per joint by the error on held-out segments of the fitted logs "
            f"(default); none; or some of these, separated by +: {', '.join([*_PLAIN, *FAMILIES])}"
        )
        others = ", ".join(name for name in ESTIMATORS if name != "consistent")
        name = Key(f"estimator: consistent (default), {others}", among=tuple(ESTIMATORS))
        return super().paths() | {"model.friction": friction, "estimator.name": name}

    def __post_init__(self) -> None:
        super().__post_init__()
        check_transmissions(self.transmissions, self.joints)
        gains = [entry.controller for entry in (*self.identification, *self.validation)]
        is_stated = self.controller != LoopSettings() or any(x != LogGains() for x in gains)
        if is_stated and not isinstance(self.estimator, SimulationSettings):
            raise SettingsError(
                f"[controller] is given, but the estimator is {self.estimator.name!r}, expected "
                "'simulation'; set [estimator] name = 'simulation', or remove [controller]"
            )

    def model(self) -> "RobotModel":
        """Return the robot, with the job's joints, gravity and drive terms."""
        from robotid.robot.model import RobotModel
        from robotid.robot.prior import with_assumed_inertials

        gears = [gear for gear in self.transmissions if gear.matrix != "urdf"]
        motors = [  # that move several joints
            Coupling(*shared, replaces=True) for gear in gears for shared in gear.shared.items()
        ]
        own_terms = {
            joint: [entry for entry in entries if isinstance(entry, DriveTerm)]
            for joint, entries in self.drives.items()
        }
        model = RobotModel.from_urdf(
            self.urdf, joints=self.joints, locked=self.locked, free_flyer=self.free_flyer,
            mimic=self.mimic, gravity=self.gravity, own_terms=own_terms,
            terms=[term for term in self.terms if term in TERMS],
            couplings=(*self.couplings, *motors), dynamics=self.model_dynamics,
            snap_angles=self.snap_angles, constraints=(*self.contacts, *self.loops),
            passive=self.passive,
        )  # fmt: skip
        return with_assumed_inertials(model)

    def placed(self, model: "RobotModel") -> tuple[str, ...]:
        """Return the locked joints of the model whose position the job states."""
        if "*" in self.locked:
            return tuple(model.locked)
        leaders = {joint.name: joint.mimic[0] for joint in model.tree.movable if joint.mimic}
        return tuple(j for j in model.locked if {j, leaders.get(j)} & set(self.locked))

    @property
    def friction(self) -> dict[str, str]:
        """Friction in addition to viscous and Coulomb, by joint, "*" for the others; or "auto"."""
        everywhere = "+".join(term for term in self.terms if term not in TERMS)
        stated = {
            joint: "+".join(entry for entry in entries if isinstance(entry, str))
            for joint, entries in self.drives.items()
        }
        return {"*": everywhere, **stated}

    def read(self, entry: LogEntry, model: "RobotModel", *, needs: Needs = "torque") -> Log:
        """Return one log of the job, of the model's joints in its order."""
        stated = self._reading(model) | {"start": entry.start, "end": entry.end}
        log = read_log(entry.path, needs=needs, **stated)
        if entry.controller == LogGains():
            return log
        return replace(log, gain_factors=entry.controller.factors(self.controller, log.joints))

    def lay_out(
        self, entry: LogEntry, model: "RobotModel", *, needs: Needs = "torque"
    ) -> tuple[LogLayout, Table]:
        """Return the columns of a log to read, and the opened file; no column is read yet."""
        return lay_out(entry.path, needs=needs, **self._reading(model))

    def _reading(self, model: "RobotModel") -> dict[str, Any]:
        return {
            "joints": model.joints, "gains": self.gains, "columns": self.columns,
            "units": self.units, "prismatic": tuple(model.layout.prismatic), "source": self.source,
            "base": logged_base(model, self.base), "passive": model.passive,
            "robot": model.tree.movable,
            "transmissions": [gear.stated(model.tree.reductions) for gear in self.transmissions],
        }  # fmt: skip


def read_job(path: str | Path) -> Job:
    require_kind(path, (str, Path), "path", "the path of a job file")
    source = Path(path)
    return job_from_settings(read_toml(source, "job file"), source.name, source.parent, expand=True)


def job_file(model: object) -> Job:
    """Return the job of a file that is given in place of a robot and its logs."""
    if isinstance(model, str | Path) and Path(model).suffix == ".toml":
        return read_job(model)
    wanted = "the robot and its logs, or a job file (.toml) alone"
    raise SettingsError(f"no log is given, expected {wanted}")


def as_job(robot: Job | str | Path) -> Job:
    """Return the job of a robot: of a job file, or of a URDF all of whose joints move."""
    if isinstance(robot, Job):
        return robot
    require_kind(robot, (str, Path), "robot", "the path of a URDF or of a job file")
    return read_job(robot) if Path(robot).suffix == ".toml" else Job(Path(robot))


def job_from_settings(
    table: Mapping[str, Any], where: str, folder: Path, *, expand: bool = False
) -> Job:
    check_keys(table, Job.schema(), where)
    if "urdf" not in table:
        raise SettingsError(f"{where} has no key 'urdf'; name the robot's URDF file")

    def path(text: str) -> Path:
        return stated_path(text, where, folder, expand=expand)

    placed = dict(table, urdf=path(table["urdf"]))
    for key in ("identification", "validation", "payload_check"):
        placed[key] = [dict(entry, log=path(entry["log"])) for entry in table.get(key, [])]
    try:
        return Job.from_dict(placed)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def written_job(settings: Mapping[str, Any], where: str) -> Job:
    """Return the job whose settings a result states."""
    table = {key: value for key, value in settings.items() if value != {}}
    return job_from_settings(table, where, Path())


def stated_path(text: str, where: str, folder: Path, *, expand: bool) -> Path:
    try:
        check_path(text)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    expanded = os.path.expandvars(text) if expand else text
    if expand and "$" in expanded:
        raise SettingsError(f"{where}: path {text!r} names an environment variable that is not set")
    return folder / expanded


def number(word: str, flag: str, wanted: str, shown: str = "") -> float:
    try:
        return float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {shown or repr(word)}: expected {wanted}") from error


def pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    return {
        name: number(text, flag, "JOINT=NUMBER", repr(f"{name}={text}" if text else name))
        for name, text in _once(words, flag).items()
    }


def _once(words: Sequence[str], flag: str) -> dict[str, str]:
    """Return the texts of words like JOINT=TEXT by joint; refuse two of one joint."""
    texts = dict[str, str]()
    for word in words:
        name, _, value = word.partition("=")
        if texts.setdefault(name, value) != value:
            raise SettingsError(
                f"{flag} has {name} twice, as {texts[name]} and as {value}; give it once"
            )
    return texts


def _names(words: Sequence[str], flag: str) -> dict[str, str]:
    if wrong := [word for word in words if not all(word.partition("=")[::2])]:
        raise SettingsError(f"{flag} {wrong[0]!r}: expected JOINT=NAME")
    return _once(words, flag)


def _of_all_or_pairs(words: Sequence[str], flag: str) -> float | dict[str, float]:
    """Return one number for all joints, or numbers by joint."""
    if len(words) > 1 or "=" in words[0]:
        return pairs(words, flag)
    return number(words[0], flag, "NUMBER or JOINT=NUMBER")


def _payload_check(word: str, flag: str) -> list[dict[str, Any]]:
    """Return the log with a payload, and its known mass [kg]."""
    log, _, mass = word.rpartition("=")
    return [{"log": log, "mass": number(mass, flag, "LOG=KG", repr(word))}]


@dataclass(frozen=True)
class Flags:
    """Flags that state settings; types, help and defaults come from the fields of the settings."""

    defaults: Settings
    # for each flag the key of the job file and the placeholder of its value in the help, empty for
    # a list of permitted words; of a switch, the help where it differs from that of the key
    keys: Mapping[str, tuple[str, str]]
    # the conversion of words whose type does not determine it
    read: Mapping[str, Callable[[Any, str], Any]] = field(default_factory=dict)

    def add(self, parser: "argparse._ActionsContainer", wanted: Sequence[str] = ()) -> None:
        settings = self.defaults
        schema, about, values = settings.schema(), settings.paths(), settings.to_dict()
        for flag in wanted or self.keys:
            at, shown = self.keys[flag]
            kinds, key, value = _in(schema, at), about[at], _in(values, at)
            words, about_flag = key.words, dict[str, Any](metavar=shown)
            is_repeated = kinds.count is None if isinstance(kinds, Entries) else dict in kinds
            if kinds == (bool,):
                words = shown or words
                about_flag = {"action": "store_const", "const": not flag.startswith("--no-")}
            elif not shown:
                words, about_flag = key.text, {"choices": key.among}
            elif is_repeated:
                words += "; repeatable"
                about_flag["action"] = "append"
            elif flag not in self.read and bool not in kinds:
                about_flag["type"] = float if float in kinds else kinds[0]
            if type(value) in (int, float) and 0 < value < float("inf"):
                words += f"; default: {value:g}"
            parser.add_argument(flag, help=words.replace("%", "%%"), **about_flag)

    def given(self, options: argparse.Namespace) -> list[str]:
        return [flag for flag in self.keys if getattr(options, _name(flag), None) is not None]

    def stated(self, options: argparse.Namespace, wanted: Sequence[str] = ()) -> dict[str, Any]:
        """Return the settings that flags state, as a table of a job file."""
        schema, table = self.defaults.schema(), dict[str, Any]()
        for flag in self.given(options):
            if wanted and flag not in wanted:
                continue
            at, value = self.keys[flag][0], getattr(options, _name(flag))
            *tables, key = at.split(".")
            read = self.read.get(flag) or _reader(_in(schema, at))
            table_in(table, tables)[key] = read(value, flag)
        return table


def _in(table: Any, at: str) -> Any:  # noqa: ANN401
    """Return the entry of nested tables at a dotted key, None if there is none."""
    for name in at.split("."):
        table = table.get(name) if isinstance(table, Mapping) else None
    return table


def _reader(kinds: Any) -> Callable[[Any, str], Any]:  # noqa: ANN401
    """Return the conversion from words to a setting of given types, as of ``Settings.schema``."""
    if isinstance(kinds, Entries):
        return pairs if kinds.outer is dict else lambda words, _: ",".join(words).split(",")
    if dict in kinds:
        return _of_all_or_pairs
    if {bool, float} <= {*kinds}:
        return lambda word, flag: word != "false" and number(word, flag, "a number or false")
    return lambda value, _: value


#: Flags of the keys of a job file.
JOB = Flags(
    Job(Path()),
    {
        "--estimator": ("estimator.name", "NAME"),
        "--kp": ("controller.kp", "[JOINT=]N_M_PER_RAD"),
        "--kd": ("controller.kd", "[JOINT=]N_M_S_PER_RAD"),
        "--payload-check": ("payload_check", "LOG=KG"),
        "--joints": ("joints", "A,B,..."),
        "--lock": ("locked", "JOINT=POSITION"),
        "--snap-angles": ("snap_angles", ""),
        "--gain": ("torque.gains", "JOINT=N_M_PER_A"),
        "--rate": ("signals.rate", "HZ"),
        "--cutoff": ("signals.cutoff", "HZ"),
        "--velocity": ("signals.velocity", "HOW"),
        "--acceleration": ("signals.acceleration", "HOW"),
        "--order": ("signals.order", "N"),
        "--trim": ("signals.trim", "S"),
        "--min-velocity": ("signals.min_velocity", "RAD_PER_S"),
        "--friction-band": ("signals.friction_band", "RAD_PER_S"),
        "--max-gap": ("signals.max_gap", "S"),
        "--torque-delay": ("signals.torque_delay", "S"),
        "--velocity-delay": ("signals.velocity_delay", "S"),
        "--friction": ("model.friction", "MODEL"),
        "--dynamics": ("output.dynamics", ""),
        "--no-report": ("output.report", "write no report.html"),
        "--replay": ("output.replay", "also write replay.html: the first validation log"),
        "--ignore": ("doctor.ignore", "CODE"),
        "--time-unit": ("units.time", "UNIT"),
        "--angle-unit": ("units.angle", "UNIT"),
        "--topic": ("log.topic", "NAME"),
        "--command-topic": ("log.command", "NAME"),
        "--rename": ("log.joints", "JOINT=NAME"),
        "--effort": ("log.effort", "MEANING"),
        "--stamp": ("log.stamp", "CLOCK"),
    },
    {"--rename": _names, "--payload-check": _payload_check},
)
#: Flags of the estimator.
FIT = ("--estimator", "--kp", "--kd", "--payload-check")
#: Flags of the robot and of the reading of its logs.
LOG = tuple(
    flag for flag, (key, _) in JOB.keys.items() if flag not in FIT and not key.startswith("output.")
)
#: Flags of the files that "identify" writes.
OUTPUT = ("--dynamics", "--no-report", "--replay")
#: Flags of a tracked or replayed log.
ONLINE = tuple(
    flag
    for flag in LOG
    if flag in ("--rate", "--cutoff", "--min-velocity")
    or not JOB.keys[flag][0].startswith(("signals.", "doctor."))
)
#: Flags of a bag or of foreign tables.
SOURCE = ("--topic", "--command-topic", "--effort", "--stamp")
#: Flags of the robot and of the units of a table.
ROBOT = ("--joints", "--lock", "--snap-angles", "--time-unit", "--angle-unit")
#: Flags of a motion without torques.
MOTION = tuple(
    flag for flag in LOG if flag not in ("--gain", "--ignore", "--effort", "--torque-delay")
)
_SHOWN = {
    "json": "print one JSON object",
    "verbose": "print notes, too; print stages and choices with their reasons on stderr",
    "progress": "show progress on stderr even if it is no terminal, or with --json",
}


def add_shown(parser: argparse.ArgumentParser, *names: str, **words: str) -> None:
    """Add switches of what is shown, with other words than the standard ones."""
    for name in (*names, *words):
        parser.add_argument(f"--{name}", action="store_true", help=words.get(name, _SHOWN[name]))


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    words = f"folder to write to; default: {folder}"
    parser.add_argument("--out", default=folder, metavar="DIR", help=words)


def add_work(parser: "argparse._ActionsContainer", default: str) -> None:
    words = f"worker processes; default: {default}"
    parser.add_argument("--workers", type=int, metavar="N", help=words)
    words = "address of a Dask cluster, as tcp://host:8786"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=words)


def add_job(parser: argparse.ArgumentParser, output: Sequence[str] = ()) -> None:
    """Add a job file, or the flags in place of one."""
    parser.add_argument("source", metavar="JOB.toml | URDF")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    words = "validation logs; repeatable"
    flags.add_argument("--validate", nargs="+", action="extend", metavar="LOG", help=words)
    JOB.add(flags, (*FIT, *LOG, *output))


def job_from_flags(options: argparse.Namespace) -> Job:
    """Return the job that a command line names or states."""
    logs = getattr(options, "logs", ())  # a command that designs a motion needs none
    if Path(options.source).suffix == ".toml":
        if given := [*logs, *_given(options)]:
            raise SettingsError(
                f"{options.source} is a job file; it has the logs and settings. Remove "
                f"{listed(given)}, and set them in the job file"
            )
        return read_job(options.source)
    if logs == []:
        kind = "motion" if hasattr(options, "given") else "log"  # of preview
        one = kind.upper()
        raise SettingsError(f"no {kind} is given; expected URDF {one} [{one} ...], or JOB.toml")
    table = {"urdf": options.source, "identification": [{"log": log} for log in logs]}
    table["validation"] = [{"log": log} for log in getattr(options, "validate", None) or ()]
    return job_from_settings(table | JOB.stated(options), "command line", Path())


def source_words(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a command line that determine the identification."""
    others = ("--json", "--progress", "--verbose", "--out")
    return tuple(
        word
        for before, word in pairwise(words)
        if before != "--out" and word not in others and not word.startswith("--out=")
    )


def refuse_log_flags(options: argparse.Namespace, why: str) -> None:
    if given := _given(options):
        raise SettingsError(f"{why}; remove {listed(given)}")


def _given(options: argparse.Namespace) -> list[str]:
    validate = ["--validate"] if getattr(options, "validate", None) is not None else []
    return validate + JOB.given(options)


def _name(flag: str) -> str:
    return flag[2:].replace("-", "_")  # in argparse
