"""Flags that commands share, and the job that a command line names or states."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import Entries, Settings, table_in
from robotid.cli.job import Job, job_from_settings, read_job


def number(word: str, flag: str, wanted: str = "a number", shown: str = "") -> float:
    """Return the number of a word."""
    try:
        return float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {shown or repr(word)}: wanted {wanted}") from error


def pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    """Return numbers by joint."""
    return {
        name: number(text, flag, "JOINT=NUMBER", repr(f"{name}={text}" if text else name))
        for name, text in _once(words, flag).items()
    }


def _once(words: Sequence[str], flag: str) -> dict[str, str]:
    """Return the texts of words like JOINT=TEXT by joint; refuse two of one joint."""
    texts: dict[str, str] = {}
    for word in words:
        name, _, value = word.partition("=")
        if texts.setdefault(name, value) != value:
            raise SettingsError(
                f"{flag} states {name} twice, as {texts[name]} and as {value}; state it once"
            )
    return texts


def _names(words: Sequence[str], flag: str) -> dict[str, str]:
    if wrong := [word for word in words if not all(word.partition("=")[::2])]:
        raise SettingsError(f"{flag} {wrong[0]!r}: wanted JOINT=NAME")
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
    """Flags that state settings; types, help and defaults come from the fields of the settings.

    Attributes:
        defaults: The default settings.
        keys: For each flag the key of the job file and the placeholder of its value in the help.
            A switch has its own help text in place of the placeholder, if it differs from that of
            the key. A flag with a list of permitted words has an empty placeholder.
        read: For flags whose value the type does not determine, the conversion of the words.
    """

    defaults: Settings
    keys: Mapping[str, tuple[str, str]]
    read: Mapping[str, Callable[[Any, str], Any]] = field(default_factory=dict)

    def add(self, parser: "argparse._ActionsContainer", wanted: Sequence[str] = ()) -> None:
        """Add flags."""
        settings = self.defaults
        schema, about, values = settings.schema(), settings.paths(), settings.to_dict()
        for flag in wanted or self.keys:
            at, shown = self.keys[flag]
            kinds, key, value = _in(schema, at), about[at], _in(values, at)
            words, about_flag = key.words, dict[str, Any](metavar=shown)
            if kinds == (bool,):
                words = shown or words
                about_flag = {"action": "store_const", "const": not flag.startswith("--no-")}
            elif not shown:
                words, about_flag = key.text, {"choices": key.among}
            elif _is_repeated(kinds):
                words += "; repeatable"
                about_flag["action"] = "append"
            elif flag not in self.read and bool not in kinds:
                about_flag["type"] = float if float in kinds else kinds[0]
            if type(value) in (int, float) and 0 < value < float("inf"):
                words += f"; default: {value:g}"
            parser.add_argument(flag, help=words.replace("%", "%%"), **about_flag)

    def given(self, options: argparse.Namespace) -> list[str]:
        """Return the flags that are given."""
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


def _in(table: Mapping[str, Any], at: str) -> Any:  # noqa: ANN401
    """Return the entry of nested tables at a dotted key, None if there is none."""
    found: Any = table
    for name in at.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    return found


def _is_repeated(kinds: Any) -> bool:  # noqa: ANN401
    """Return whether a setting has several entries, so that its flag may be repeated."""
    return kinds.count is None if isinstance(kinds, Entries) else dict in kinds


def _reader(kinds: Any) -> Callable[[Any, str], Any]:  # noqa: ANN401
    """Return the conversion from words to a setting of given types, as of ``Settings.schema``."""
    if isinstance(kinds, Entries):
        return pairs if kinds.outer is dict else _listed
    if dict in kinds:
        return _of_all_or_pairs
    if {bool, float} <= {*kinds}:
        return lambda word, flag: word != "false" and number(word, flag, "a number or false")
    return lambda value, _: value


def _listed(words: Sequence[str], _: str) -> list[str]:
    return [name for word in words for name in word.split(",")]


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
    for flag, (key, _) in JOB.keys.items()
    if flag in ("--rate", "--cutoff", "--min-velocity")
    or (flag in LOG and not key.startswith(("signals.", "doctor.")))
)
#: Flags of a bag or of foreign tables.
SOURCE = ("--topic", "--command-topic", "--effort", "--stamp")
#: Flags of the robot and of the units of a table.
ROBOT = ("--joints", "--lock", "--snap-angles", "--time-unit", "--angle-unit")
#: Flags of a motion without torques.
MOTION = tuple(
    flag
    for flag, (key, _) in JOB.keys.items()
    if flag in LOG and not key.startswith(("torque.", "doctor."))
    if flag not in ("--effort", "--torque-delay")
)
_VERBOSE = "print notes, too; print stages and choices with their reasons on stderr"


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add the folder to write to."""
    words = f"folder to write to; default: {folder}"
    parser.add_argument("--out", default=folder, metavar="DIR", help=words)


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the flag for JSON output."""
    parser.add_argument("--json", action="store_true", help=f"print {what}")


def add_verbose(parser: argparse.ArgumentParser, words: str = _VERBOSE) -> None:
    """Add the flag for more output."""
    parser.add_argument("--verbose", action="store_true", help=words)


def add_progress(parser: argparse.ArgumentParser) -> None:
    """Add the flag for progress in any case."""
    words = "show progress on stderr even if it is no terminal, or with --json"
    parser.add_argument("--progress", action="store_true", help=words)


def add_robot_and_log(parser: argparse.ArgumentParser) -> None:
    """Add a URDF and one log."""
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")


def add_job(
    parser: argparse.ArgumentParser, json_: str = "one JSON object", output: Sequence[str] = ()
) -> None:
    """Add a job file, or the flags in place of one."""
    parser.add_argument("source", metavar="JOB.toml | URDF")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    add_json(parser, json_)
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    words = "validation logs; repeatable"
    flags.add_argument("--validate", nargs="+", action="extend", metavar="LOG", help=words)
    JOB.add(flags, (*FIT, *LOG, *output))
    add_verbose(parser)


def job_from_flags(options: argparse.Namespace, *, needs_logs: bool = True) -> "Job":
    """Return the job that a command line names or states."""
    if Path(options.source).suffix == ".toml":
        given = _given(options)
        if options.logs or given:
            raise SettingsError(
                f"{options.source} is a job file; it states the logs and settings. Remove "
                f"{listed([*options.logs, *given])}, and state them in the job file"
            )
        return read_job(options.source)
    if not options.logs and needs_logs:
        kind = "motion" if hasattr(options, "given") else "log"  # of preview
        one = kind.upper()
        raise SettingsError(f"no {kind} is given; wanted URDF {one} [{one} ...], or JOB.toml")
    validation = getattr(options, "validate", None) or ()
    table = {
        "urdf": options.source,
        "identification": [{"log": log} for log in options.logs],
        "validation": [{"log": log} for log in validation],
        **JOB.stated(options),
    }
    return job_from_settings(table, "command line", Path())


def source_words(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a command line that determine the identification."""
    _, *rest = words
    source, shown = list[str](), ("--json", "--progress", "--verbose")
    for before, word in zip(words, rest, strict=False):
        if before != "--out" and word not in (*shown, "--out") and not word.startswith("--out="):
            source.append(word)
    return tuple(source)


def refuse_log_flags(options: argparse.Namespace, why: str) -> None:
    """Refuse the flags of the reading of logs."""
    if given := _given(options):
        raise SettingsError(f"{why}; remove {listed(given)}")


def _given(options: argparse.Namespace) -> list[str]:
    validate = ["--validate"] if getattr(options, "validate", None) is not None else []
    return validate + JOB.given(options)


def _name(flag: str) -> str:
    """Return the name of a flag in argparse."""
    return flag[2:].replace("-", "_")
