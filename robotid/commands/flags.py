"""Flags of the command line that describe a job, and the job that they describe."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.exceptions import SettingsError

if TYPE_CHECKING:
    from robotid.commands.job import Job

__all__ = [
    "add_job_flags",
    "add_log_flags",
    "add_source_flags",
    "job_from_flags",
    "refuse_log_flags",
    "source_settings",
]


def add_job_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say what a job file says, to a command that takes either.

    Args:
        parser: Parser of the command.
    """
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    flags.add_argument("--validate", nargs="+", default=[], metavar="LOG", help="logs kept apart")
    names = "consistent (default), log_cholesky, wls, ols, tls, rls, kalman, prx or gradient"
    flags.add_argument("--estimator", metavar="NAME", help=names)
    add_log_flags(flags)


def add_log_flags(flags: "argparse._ArgumentGroup") -> None:
    """Add the flags that say how logs of a robot are read.

    Args:
        flags: Group that they go to.
    """
    flags.add_argument("--joints", metavar="A,B,...", help="joints to identify, in order")
    flags.add_argument("--lock", action="append", default=[], metavar="JOINT=POSITION")
    flags.add_argument("--gain", action="append", default=[], metavar="JOINT=N_M_PER_A")
    flags.add_argument("--rate", type=float, metavar="HZ", help="grid to resample to")
    flags.add_argument("--cutoff", metavar="HZ", help="of the low-pass filter, or false")
    flags.add_argument("--friction", metavar="MODEL", help="none, viscous or viscous+coulomb")
    flags.add_argument(
        "--dynamics", action="store_true", help="write friction into the URDF's <dynamics> too"
    )
    flags.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="CODE",
        help="error of the doctor that you know better",
    )
    flags.add_argument("--time-unit", metavar="UNIT", help="s, ms, us or ns")
    flags.add_argument("--angle-unit", metavar="UNIT", help="rad or deg")
    add_source_flags(flags)


def add_source_flags(flags: "argparse._ActionsContainer") -> None:
    """Add the flags that say where in a log file the signals are.

    Args:
        flags: Parser or group that they go to.
    """
    flags.add_argument("--topic", metavar="NAME", help="topic of a bag, or group of a file")
    flags.add_argument("--effort", metavar="MEANING", help="torque (default) or current")
    flags.add_argument("--stamp", metavar="CLOCK", help="of a bag: header (default) or log")


def source_settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a ``LogSource`` that were given.

    Args:
        options: The flags, those of ``add_source_flags`` among them.

    Returns:
        The settings by name.
    """
    given = {name: getattr(options, name) for name in ("topic", "effort", "stamp")}
    return {name: value for name, value in given.items() if value is not None}


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
    table: dict[str, Any] = {
        "urdf": options.source,
        "identification": [{"log": log} for log in options.logs],
        "validation": [{"log": log} for log in options.validate],
        "locked": _pairs(options.lock, "--lock"),
        "torque": {"gains": _pairs(options.gain, "--gain")},
        "signals": {},
        "units": {},
        "doctor": {"ignore": options.ignore},
    }
    if options.joints:
        table["joints"] = options.joints.split(",")
    if options.estimator:
        table["estimator"] = {"name": options.estimator}
    if options.friction:
        table["model"] = {"friction": options.friction}
    if options.rate is not None:
        table["signals"]["rate"] = options.rate
    if options.cutoff is not None:
        table["signals"]["cutoff"] = _cutoff(options.cutoff)
    if options.dynamics:
        table["output"] = {"dynamics": True}
    table["log"] = source_settings(options)
    units = {"time": options.time_unit, "angle": options.angle_unit}
    table["units"] = {key: value for key, value in units.items() if value}
    return job_from_settings(table, "command line", Path())


_JOB_FLAGS = (
    "validate", "joints", "lock", "gain", "estimator", "rate", "cutoff", "friction",
    "time_unit", "angle_unit", "dynamics", "topic", "effort", "stamp", "ignore",
)  # fmt: skip


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
    return [name for name in _JOB_FLAGS if getattr(options, name)]


def _pairs(words: Sequence[str], flag: str) -> dict[str, float]:
    pairs = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            pairs[name] = float(number)
        except ValueError as error:
            raise SettingsError(f"{flag} {word!r}: wanted JOINT=NUMBER") from error
    return pairs


def _cutoff(word: str) -> float | bool:
    try:
        return False if word == "false" else float(word)
    except ValueError as error:
        raise SettingsError(f"--cutoff {word!r}: wanted a frequency [Hz] or false") from error
