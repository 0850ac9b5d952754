"""Flags that commands share, and the job that a command line names or describes."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid._settings import table_in
from robotid.exceptions import SettingsError
from robotid.findings import listed

if TYPE_CHECKING:
    from robotid.commands.job import Job


__all__ = [
    "FIT",
    "FLAGS",
    "LOG",
    "MOTION",
    "ONLINE",
    "OUTPUT",
    "ROBOT",
    "SOURCE",
    "add_job",
    "add_json",
    "add_out",
    "add_progress",
    "add_robot_and_log",
    "add_serve",
    "add_settings",
    "add_verbose",
    "job_from_flags",
    "pairs",
    "refuse_log_flags",
    "source_words",
    "stated_by",
]


def pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    """Return numbers by joint.

    Args:
        words: Words like JOINT=NUMBER.
        flag: The flag, for errors.
    """
    pairs = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            pairs[name] = float(number)
        except ValueError as error:
            raise SettingsError(f"{flag} {word!r}: wanted JOINT=NUMBER") from error
    return pairs


def _of_all_or_pairs(words: Sequence[str], flag: str) -> float | dict[str, float]:
    """Return one number for all joints, or numbers by joint."""
    if len(words) > 1 or "=" in words[0]:
        return pairs(words, flag)
    try:
        return float(words[0])
    except ValueError as error:
        raise SettingsError(f"{flag} {words[0]!r}: wanted NUMBER or JOINT=NUMBER") from error


def _cutoff(word: str, flag: str) -> float | bool:
    try:
        return False if word == "false" else float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {word!r}: wanted a frequency [Hz] or false") from error


#: Key of the job file that each flag states, and what argparse is told of it.
FLAGS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "--estimator": ("estimator.name", {"metavar": "NAME"}),
    "--kp": ("controller.kp", {"metavar": "[JOINT=]N_M_PER_RAD", "action": "append"}),
    "--kd": ("controller.kd", {"metavar": "[JOINT=]N_M_S_PER_RAD", "action": "append"}),
    "--joints": ("joints", {"metavar": "A,B,..."}),
    "--lock": ("locked", {"metavar": "JOINT=POSITION", "action": "append"}),
    "--snap-angles": ("snap_angles", {"action": "store_const", "const": True}),
    "--gain": ("torque.gains", {"metavar": "JOINT=N_M_PER_A", "action": "append"}),
    "--rate": ("signals.rate", {"metavar": "HZ", "type": float}),
    "--cutoff": ("signals.cutoff", {"metavar": "HZ"}),
    "--velocity": ("signals.velocity", {"metavar": "HOW"}),
    "--acceleration": ("signals.acceleration", {"metavar": "HOW"}),
    "--order": ("signals.order", {"metavar": "N", "type": int}),
    "--trim": ("signals.trim", {"metavar": "S", "type": float}),
    "--min-velocity": ("signals.min_velocity", {"metavar": "RAD_PER_S", "type": float}),
    "--friction-band": ("signals.friction_band", {"metavar": "RAD_PER_S", "type": float}),
    "--max-gap": ("signals.max_gap", {"metavar": "S", "type": float}),
    "--torque-delay": ("signals.torque_delay", {"metavar": "S", "type": float}),
    "--velocity-delay": ("signals.velocity_delay", {"metavar": "S", "type": float}),
    "--friction": ("model.friction", {"metavar": "MODEL"}),
    "--dynamics": ("output.dynamics", {"action": "store_const", "const": True}),
    "--no-report": (
        "output.report",
        {"action": "store_const", "const": False, "help": "write no report.html"},
    ),
    "--ignore": ("doctor.ignore", {"metavar": "CODE", "action": "append"}),
    "--time-unit": ("units.time", {"metavar": "UNIT"}),
    "--angle-unit": ("units.angle", {"metavar": "UNIT"}),
    "--topic": ("log.topic", {"metavar": "NAME"}),
    "--command-topic": ("log.command", {"metavar": "NAME"}),
    "--effort": ("log.effort", {"metavar": "MEANING"}),
    "--stamp": ("log.stamp", {"metavar": "CLOCK"}),
}
#: How the words of a flag become the value of its key, where they are not it themselves.
_READ: Mapping[str, Callable[[Any, str], Any]] = {
    "--joints": lambda word, _: word.split(","),
    "--lock": pairs,
    "--gain": pairs,
    "--kp": _of_all_or_pairs,
    "--kd": _of_all_or_pairs,
    "--cutoff": _cutoff,
}
#: Flags of the estimator.
FIT = ("--estimator", "--kp", "--kd")
#: Flags that say which robot it is and how its logs are read.
LOG = tuple(
    flag for flag, (key, _) in FLAGS.items() if flag not in FIT and not key.startswith("output.")
)
#: Flags of the files that "identify" writes.
OUTPUT = ("--dynamics", "--no-report")
#: Flags that a tracked or replayed log has a use for.
ONLINE = tuple(
    flag
    for flag, (key, _) in FLAGS.items()
    if flag in ("--rate", "--cutoff", "--min-velocity")
    or (flag in LOG and not key.startswith(("signals.", "doctor.")))
)
#: Flags of a bag or of foreign tables.
SOURCE = ("--topic", "--command-topic", "--effort", "--stamp")
#: Flags that say which robot it is, and how a table is read.
ROBOT = ("--joints", "--lock", "--snap-angles", "--time-unit", "--angle-unit")
#: Flags that a motion without torques has a use for.
MOTION = tuple(
    flag
    for flag, (key, _) in FLAGS.items()
    if flag in LOG and not key.startswith(("torque.", "doctor."))
    if flag not in ("--effort", "--torque-delay")
)
_VERBOSE = "print notes, too; say on stderr the stages, what is chosen, and why"


def add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add the folder to write to.

    Args:
        parser: The parser.
        folder: The default.
    """
    parser.add_argument("--out", default=folder, metavar="DIR", help="folder to write to")


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the flag that has JSON printed.

    Args:
        parser: The parser.
        what: What is printed.
    """
    parser.add_argument("--json", action="store_true", help=f"print {what}")


def add_verbose(parser: argparse.ArgumentParser, words: str = _VERBOSE) -> None:
    """Add the flag that has more printed.

    Args:
        parser: The parser.
        words: Its help.
    """
    parser.add_argument("--verbose", action="store_true", help=words)


def add_progress(parser: argparse.ArgumentParser) -> None:
    """Add the flag that shows progress in any case.

    Args:
        parser: The parser.
    """
    words = "show progress on stderr although it is no terminal, or beside --json"
    parser.add_argument("--progress", action="store_true", help=words)


def add_robot_and_log(parser: argparse.ArgumentParser) -> None:
    """Add a URDF and one log.

    Args:
        parser: The parser.
    """
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")


def add_serve(parser: argparse.ArgumentParser, words: str) -> None:
    """Add the flags of a live page.

    Args:
        parser: The parser.
        words: What is shown.
    """
    parser.add_argument("--serve", nargs="?", const=0, type=int, metavar="PORT", help=words)
    speed = "of --serve; 0: as fast as it can"
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help=speed)


def add_job(
    parser: argparse.ArgumentParser, json_: str = "one JSON object", output: Sequence[str] = ()
) -> None:
    """Add a job file, or the flags that say what it says.

    Args:
        parser: The parser.
        json_: What ``--json`` prints.
        output: Flags of files that are written.
    """
    from robotid.fitting.settings import ESTIMATORS

    parser.add_argument("source", metavar="JOB.toml | URDF")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    add_json(parser, json_)
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    flags.add_argument("--validate", nargs="+", metavar="LOG", help="logs kept apart")
    others = ", ".join(name for name in ESTIMATORS if name != "consistent")
    names = f"which estimator: consistent (default), {others}"
    flags.add_argument("--estimator", **FLAGS["--estimator"][1], help=names)
    add_settings(flags, (*FIT[1:], *LOG, *output))
    add_verbose(parser)


def add_settings(flags: "argparse._ActionsContainer", wanted: Sequence[str]) -> None:
    """Add flags of settings; their help is that of the keys of the job file.

    Args:
        flags: The parser, or a group of it.
        wanted: Which flags.
    """
    from robotid.commands.job import Job

    keys = Job.paths()
    for flag in wanted:
        at, about = FLAGS[flag]
        words = keys[at].words if at in keys else _friction_words()
        flags.add_argument(flag, **{"help": words, **about})


def _friction_words() -> str:
    from robotid.robot.drives import FAMILIES

    return (
        "auto (default: chosen by the logs), none, viscous, viscous+coulomb, or some of these "
        f"beside both, joined by +: {', '.join(FAMILIES)}"
    )


def job_from_flags(options: argparse.Namespace, *, needs_logs: bool = True) -> "Job":
    """Return the job that a command line names or describes.

    Args:
        options: The flags of the command.
        needs_logs: Whether it is of no use without a log.

    Raises:
        SettingsError: If a job file is given with flags, or a flag is not usable.
    """
    from robotid.commands.job import job_from_settings, read_job

    if Path(options.source).suffix == ".toml":
        given = _given(options)
        if options.logs or given:
            raise SettingsError(
                f"{options.source} is a job file, which states its logs and settings itself; "
                f"leave out {listed(options.logs or given)}"
            )
        return read_job(options.source)
    if not options.logs and needs_logs:
        kind = "motion" if hasattr(options, "given") else "log"  # of preview
        one = kind.upper()
        raise SettingsError(f"no {kind} was given; wanted URDF {one} [{one} ...], or JOB.toml")
    kept = getattr(options, "validate", None) or ()
    table = {
        "urdf": options.source,
        "identification": [{"log": log} for log in options.logs],
        "validation": [{"log": log} for log in kept],
        **stated_by(options, list(FLAGS)),
    }
    return job_from_settings(table, "command line", Path())


def source_words(words: Sequence[str]) -> tuple[str, ...]:
    """Return the words of a command line that say what is identified, and how.

    Args:
        words: The words after ``robotid``.

    Returns:
        Those after the name of the command but for ``--out`` and what is only shown.
    """
    _, *rest = words
    kept, shown = list[str](), ("--json", "--progress", "--verbose", "--resume")
    for before, word in zip(words, rest, strict=False):
        if before != "--out" and word not in (*shown, "--out") and not word.startswith("--out="):
            kept.append(word)
    return tuple(kept)


def refuse_log_flags(options: argparse.Namespace, why: str) -> None:
    """Refuse the flags that say how logs are read.

    Args:
        options: The flags of the command.
        why: What is in their place.

    Raises:
        SettingsError: If one is given.
    """
    if given := _given(options):
        raise SettingsError(f"{why}; leave out {listed(given)}")


def _given(options: argparse.Namespace) -> list[str]:
    flags = ["--validate", *FLAGS]
    return [flag for flag in flags if getattr(options, _name(flag), None) is not None]


def _name(flag: str) -> str:
    """Return what argparse calls a flag."""
    return flag[2:].replace("-", "_")


def stated_by(options: argparse.Namespace, flags: Sequence[str]) -> dict[str, Any]:
    """Return what flags state, as a table of a job file.

    Args:
        options: The flags given.
        flags: Which of them.
    """
    table: dict[str, Any] = {}
    for flag in flags:
        value = getattr(options, _name(flag), None)
        if value is None:
            continue
        *tables, key = FLAGS[flag][0].split(".")
        table_in(table, tables)[key] = _READ[flag](value, flag) if flag in _READ else value
    return table
