"""Flags of the command line: those that describe a job, those of the work, and the job itself."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.exceptions import SettingsError

if TYPE_CHECKING:
    from robotid.commands.job import Job

__all__ = [
    "add_job_flags",
    "add_log_flags",
    "add_progress_flags",
    "add_source_flags",
    "add_verbose_flag",
    "add_work_flags",
    "job_from_flags",
    "refuse_log_flags",
    "source_settings",
]


def _pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    pairs = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            pairs[name] = float(number)
        except ValueError as error:
            raise SettingsError(f"{flag} {word!r}: wanted JOINT=NUMBER") from error
    return pairs


def _cutoff(word: str, flag: str) -> float | bool:
    try:
        return False if word == "false" else float(word)
    except ValueError as error:
        raise SettingsError(f"{flag} {word!r}: wanted a frequency [Hz] or false") from error


#: Key of the job file that each flag states, and what argparse is told of it.
_FLAGS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "--estimator": ("estimator.name", {"metavar": "NAME"}),
    "--joints": ("joints", {"metavar": "A,B,..."}),
    "--lock": ("locked", {"metavar": "JOINT=POSITION", "action": "append"}),
    "--gain": ("torque.gains", {"metavar": "JOINT=N_M_PER_A", "action": "append"}),
    "--rate": ("signals.rate", {"metavar": "HZ", "type": float}),
    "--cutoff": ("signals.cutoff", {"metavar": "HZ"}),
    "--friction": (
        "model.friction",
        {"metavar": "MODEL", "help": "none, viscous or viscous+coulomb"},
    ),
    "--dynamics": ("output.dynamics", {"action": "store_const", "const": True}),
    "--ignore": ("doctor.ignore", {"metavar": "CODE", "action": "append"}),
    "--time-unit": ("units.time", {"metavar": "UNIT"}),
    "--angle-unit": ("units.angle", {"metavar": "UNIT"}),
    "--topic": ("log.topic", {"metavar": "NAME"}),
    "--effort": ("log.effort", {"metavar": "MEANING"}),
    "--stamp": ("log.stamp", {"metavar": "CLOCK"}),
}
#: How the words of a flag become the value of its key, where they are not it themselves.
_READ: Mapping[str, Callable[[Any, str], Any]] = {
    "--joints": lambda word, _: word.split(","),
    "--lock": _pairs,
    "--gain": _pairs,
    "--cutoff": _cutoff,
}
_SOURCE = ("--topic", "--effort", "--stamp")


def add_job_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say what a job file says, to a command that takes either.

    Args:
        parser: Parser of the command.
    """
    from robotid.identification.settings import ESTIMATORS

    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    flags.add_argument("--validate", nargs="+", metavar="LOG", help="logs kept apart")
    names = f"which estimator: consistent (default), {', '.join(ESTIMATORS)}"
    flags.add_argument("--estimator", **_FLAGS["--estimator"][1], help=names)
    add_log_flags(flags)


def add_log_flags(flags: "argparse._ArgumentGroup") -> None:
    """Add the flags that say how logs of a robot are read.

    Args:
        flags: Group that they go to.
    """
    _add(flags, [flag for flag in _FLAGS if flag != "--estimator"])


def add_source_flags(flags: "argparse._ActionsContainer") -> None:
    """Add the flags that say where in a log file the signals are.

    Args:
        flags: Parser or group that they go to.
    """
    _add(flags, _SOURCE)


def _add(flags: "argparse._ActionsContainer", wanted: Sequence[str]) -> None:
    """Add flags; what they are for is said by the keys of the job file."""
    from robotid.commands.job import Job

    keys = Job.paths()
    for flag in wanted:
        at, about = _FLAGS[flag]
        help_ = keys[at].words if at in keys else about["help"]
        flags.add_argument(flag, **(about | {"help": help_}))


def add_work_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say who reduces long logs; they never change a result.

    Args:
        parser: Parser of the command.
    """
    flags = parser.add_argument_group("long logs; the result has the same bits in any case")
    flags.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="worker processes; default: that of the job file, else one per core for long logs",
    )
    flags.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster, as tcp://host:8786"
    )
    flags.add_argument(
        "--resume", action="store_true", help="go on from where an interrupted run in --out ended"
    )


def add_progress_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flag that shows progress where it is not shown by itself.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "--progress",
        action="store_true",
        help="show progress on stderr although it is no terminal, or beside --json",
    )


def add_verbose_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag that shows what the library logs.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "--verbose", action="store_true", help="say on stderr what is chosen, and why"
    )


def source_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a ``LogSource`` that were given.

    Args:
        options: The flags, those of ``add_source_flags`` among them.

    Returns:
        The settings by name.
    """
    return dict(_stated(options, _SOURCE).get("log", {}))


def job_from_flags(options: argparse.Namespace) -> "Job":
    """Return the job that a command line names or describes.

    Args:
        options: The flags, those of ``add_job_flags`` among them.

    Returns:
        The job.

    Raises:
        SettingsError: If a job file is given with flags, or a flag is not usable.
    """
    from robotid.commands.job import job_from_settings, read_job

    if Path(options.source).suffix == ".toml":
        given = _given(options)
        if options.logs or given:
            raise SettingsError(
                f"{options.source} is a job file, which states its logs and settings itself; "
                f"leave out {options.logs or given}"
            )
        return read_job(options.source)
    if not options.logs:
        raise SettingsError("no log was given: robotid identify URDF LOG [LOG ...], or JOB.toml")
    kept = getattr(options, "validate", None) or ()
    table = {
        "urdf": options.source,
        "identification": [{"log": log} for log in options.logs],
        "validation": [{"log": log} for log in kept],
        **_stated(options, list(_FLAGS)),
    }
    return job_from_settings(table, "command line", Path())


def refuse_log_flags(options: argparse.Namespace, why: str) -> None:
    """Refuse the flags that say how logs are read.

    Args:
        options: The flags, those of ``add_log_flags`` among them.
        why: What is in their place.

    Raises:
        SettingsError: If one is given.
    """
    if given := _given(options):
        raise SettingsError(f"{why}; leave out {given}")


def _given(options: argparse.Namespace) -> list[str]:
    names = ["validate", *(flag[2:].replace("-", "_") for flag in _FLAGS)]
    return [name for name in names if getattr(options, name, None)]


def _stated(options: argparse.Namespace, flags: Sequence[str]) -> dict[str, Any]:
    """Return what flags state, as a table of a job file."""
    table: dict[str, Any] = {}
    for flag in flags:
        value = getattr(options, flag[2:].replace("-", "_"), None)
        if value is None:
            continue
        *tables, key = _FLAGS[flag][0].split(".")
        inside = table
        for name in tables:
            inside = inside.setdefault(name, {})
        inside[key] = _READ[flag](value, flag) if flag in _READ else value
    return table
