"""The command line: flags to arguments, results to text; nothing is computed here."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid import __version__
from robotid.exceptions import RobotIdError, SettingsError

if TYPE_CHECKING:
    from robotid.job import Job

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The words after ``robotid``; those of the process if None.

    Returns:
        Exit code: 0 done, 1 the data or the model do not allow it, 2 wrong usage.
    """
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except SettingsError as error:
        print(f"robotid: {error}", file=sys.stderr)
        return 2
    except (RobotIdError, OSError) as error:
        print(f"robotid: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="robotid",
        description="Identify a robot's inertial and drive parameters from its URDF and motion "
        "logs.",
    )
    parser.add_argument("--version", action="version", version=f"robotid {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="simulate a UR5, identify it, report: needs no input")
    demo.add_argument("--out", default="robotid-demo", metavar="DIR", help="folder to write to")
    demo.set_defaults(run=_demo)

    inspect = commands.add_parser("inspect", help="joints, parameters and faults of a URDF")
    inspect.add_argument("urdf", metavar="URDF")
    inspect.add_argument("--free-flyer", action="store_true", help="the base floats")
    inspect.add_argument("--json", action="store_true", help="print one JSON object")
    inspect.set_defaults(run=_inspect)

    identify = commands.add_parser(
        "identify", help="identify a robot: JOB.toml, or URDF LOG [LOG ...]"
    )
    identify.add_argument("source", metavar="JOB.toml | URDF")
    identify.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    identify.add_argument("--out", default="robotid-out", metavar="DIR", help="folder to write to")
    identify.add_argument("--json", action="store_true", help="print result.json")
    _add_job_flags(identify)
    identify.set_defaults(run=_identify)

    doctor = commands.add_parser(
        "doctor", help="what is wrong with logs: JOB.toml, or URDF LOG ..."
    )
    doctor.add_argument("source", metavar="JOB.toml | URDF")
    doctor.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    doctor.add_argument("--json", action="store_true", help="print one JSON object")
    _add_job_flags(doctor)
    doctor.set_defaults(run=_doctor)

    validate = commands.add_parser("validate", help="measure a result's prediction on other logs")
    validate.add_argument("result", metavar="RESULT.json")
    validate.add_argument("logs", nargs="+", metavar="LOG")
    validate.add_argument("--json", action="store_true", help="print one JSON object")
    validate.set_defaults(run=_validate)
    return parser


def _add_job_flags(parser: argparse.ArgumentParser) -> None:
    flags = parser.add_argument_group("instead of a job file, with URDF LOG [LOG ...]")
    flags.add_argument("--validate", nargs="+", default=[], metavar="LOG", help="logs kept apart")
    flags.add_argument("--joints", metavar="A,B,...", help="joints to identify, in order")
    flags.add_argument("--lock", action="append", default=[], metavar="JOINT=POSITION")
    flags.add_argument("--gain", action="append", default=[], metavar="JOINT=N_M_PER_A")
    flags.add_argument("--estimator", metavar="NAME", help="consistent (default), wls or ols")
    flags.add_argument("--rate", type=float, metavar="HZ", help="grid to resample to")
    flags.add_argument("--cutoff", metavar="HZ", help="of the low-pass filter, or false")
    flags.add_argument("--friction", metavar="MODEL", help="none, viscous or viscous+coulomb")
    flags.add_argument(
        "--ignore",
        action="append",
        default=[],
        metavar="CODE",
        help="error of the doctor that must not stop the identification",
    )
    flags.add_argument("--time-unit", metavar="UNIT", help="s, ms, us or ns")
    flags.add_argument("--angle-unit", metavar="UNIT", help="rad or deg")


def _demo(options: argparse.Namespace) -> None:
    from robotid.demo import run_demo

    print("simulating a UR5 whose masses, armature and friction its URDF does not know ...")
    identification, result, truth = run_demo(options.out)
    _print_result(result)
    error = identification.base - truth
    within = sum(abs(error) < 3 * identification.base_error)
    print(f"\n{within} of {len(truth)} base parameters lie within 3 standard errors of the truth")
    _print_files(options.out, [*result["outputs"].values(), "result.json", "replay.html"])


def _inspect(options: argparse.Namespace) -> None:
    from robotid.exceptions import ModelError
    from robotid.inspection import inspect_urdf

    inspection = inspect_urdf(options.urdf, free_flyer=options.free_flyer)
    content = inspection.to_dict()
    if options.json:
        print(json.dumps(content, allow_nan=False))
    else:
        _print_inspection(content)
    if content["structure"] is None:
        raise ModelError(f"no model can be built from {options.urdf}; see the findings")


def _identify(options: argparse.Namespace) -> None:
    from robotid.workflow import run_job

    _, result = run_job(_job(options), options.out)
    if options.json:
        print(json.dumps(result, allow_nan=False))
        return
    _print_result(result)
    _print_files(options.out, [*result["outputs"].values(), "result.json"])


def _doctor(options: argparse.Namespace) -> None:
    from robotid.doctor import examine, findings_to_dict

    content = findings_to_dict(examine(_job(options)))
    if options.json:
        print(json.dumps(content, allow_nan=False))
        return
    for severity in ("error", "warning", "note"):
        for finding in content["findings"]:
            if finding["severity"] == severity:
                print(f"{severity}: {finding['code']}: {finding['message']}")


def _validate(options: argparse.Namespace) -> None:
    from robotid.workflow import validate_result

    found = validate_result(options.result, options.logs)
    if options.json:
        print(json.dumps(found, allow_nan=False))
        return
    print(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        print(f"\n{recording['log']}")
        _print_table(recording["per_joint"], {})
    _print_verdict(found["verdict"])


def _job(options: argparse.Namespace) -> "Job":
    from robotid.job import job_from_settings, read_job

    if Path(options.source).suffix == ".toml":
        given = [name for name in _JOB_FLAGS if getattr(options, name)]
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
    units = {"time": options.time_unit, "angle": options.angle_unit}
    table["units"] = {key: value for key, value in units.items() if value}
    return job_from_settings(table, "command line", Path())


_JOB_FLAGS = (
    "validate", "joints", "lock", "gain", "estimator", "rate", "cutoff", "friction",
    "ignore", "time_unit", "angle_unit",
)  # fmt: skip


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


def _print_result(result: dict[str, Any]) -> None:
    structure = result["structure"]
    print(
        f"\n{result['robot']}: {len(result['joints'])} joints, {structure['base']} base parameters "
        f"({structure['base_inertial']} inertial), condition number {structure['condition']:.3g}, "
        f"total mass {result['consistency']['total_mass']:.2f} kg"
    )
    print("\nfitted recordings")
    _print_table(
        result["identification"]["per_joint"], result["wls"]["identification"]["per_joint"]
    )
    for ours, wls in zip(result["validation"], result["wls"]["validation"], strict=True):
        print(f"\nkept apart: {ours['log']}")
        _print_table(ours["per_joint"], wls["per_joint"])
    for warning in result["warnings"]:
        print(f"\n{warning['code']}: {warning['message']}")
    _print_verdict(result["verdict"])


def _print_table(per_joint: dict[str, Any], wls: dict[str, Any]) -> None:
    width = max(len(joint) for joint in per_joint)
    print(f"  {'joint':{width}}  error %   rmse        wls %   urdf %  gravity %")
    for joint, m in per_joint.items():
        other = wls.get(joint, {}).get("relative_error_pct")
        urdf, gravity = (m.get(f"{key}_relative_error_pct") for key in ("urdf", "gravity_only"))
        cells = [_cell(other), _cell(urdf), _cell(gravity, 9)]
        rmse = f"{m['rmse']:.3g} {m['unit']}"
        error = _cell(m["relative_error_pct"], 7)
        flag = "" if m.get("better_than_constant", True) else "  worse than a constant"
        print(f"  {joint:{width}}  {error}   {rmse:10}{cells[0]} {cells[1]}  {cells[2]}{flag}")


def _cell(value: float | None, width: int = 7) -> str:
    return f"{value:{width}.1f}" if value is not None else "-".rjust(width)


def _print_verdict(verdict: dict[str, Any]) -> None:
    print(f"\nverdict: {verdict['status']}")
    for reason in verdict["reasons"]:
        print(f"  - {reason}")


def _print_files(folder: str, names: Sequence[str]) -> None:
    print(f"\nwritten to {folder}:")
    for name in names:
        print(f"  {Path(folder) / name}")


def _print_inspection(content: dict[str, Any]) -> None:
    print(f"{content['robot']}: joints {', '.join(content['joints'])}")
    if content["structure"]:
        s = content["structure"]
        print(
            f"{s['standard']} standard inertial parameters, {s['base_inertial']} base; with drives "
            f"{s['base']}"
        )
        for group in content["base_groups"]:
            print(f"  {group}")
    for finding in content["findings"]:
        where = finding.get("link") or finding.get("joint") or ""
        print(f"{finding['severity']}: {finding['code']} {where}: {finding['message']}")
