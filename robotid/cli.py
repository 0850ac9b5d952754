"""The command line: flags to arguments, results to text; nothing is computed here."""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from robotid.commands.console import (
    print_comparison,
    print_error,
    print_files,
    print_inspection,
    print_result,
    print_validation,
    shown_log,
)
from robotid.commands.flags import (
    add_job_flags,
    add_log_flags,
    add_progress_flags,
    add_source_flags,
    add_verbose_flag,
    add_work_flags,
    job_from_flags,
    refuse_log_flags,
    source_settings,
)
from robotid.commands.progress import terminal_progress
from robotid.exceptions import RobotIdError, SettingsError
from robotid.versions import __version__

if TYPE_CHECKING:
    from robotid.commands.job import Job

__all__ = ["main"]

_Run: TypeAlias = Callable[[argparse.Namespace], int | None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The words after ``robotid``; those of the process if None.

    Returns:
        Exit code: 0 done, 1 the data or the model do not allow it or the doctor found an error
        that is not ignored, 2 wrong usage, 130 Ctrl-C.
    """
    words = sys.argv[1:] if arguments is None else arguments
    options = _parser(words).parse_args(words)
    try:
        with shown_log(is_verbose=getattr(options, "verbose", False)):
            code: int | None = options.run(options)
    except SettingsError as error:
        print_error(error)
        return 2
    except (RobotIdError, OSError) as error:
        print_error(error)
        return 1
    except KeyboardInterrupt as error:
        print_error(error, "interrupted")
        return 130
    return code or 0


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of a command line, with the flags of its own command alone."""
    parser = argparse.ArgumentParser(
        prog="robotid",
        description="Identify a robot's inertial and drive parameters from its URDF and motion "
        "logs.",
    )
    parser.add_argument("--version", action="version", version=f"robotid {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    chosen = next((word for word in words if not word.startswith("-")), None)
    for name, (summary, add_flags, run) in _COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        command.set_defaults(run=run)
        if name == chosen:
            add_flags(command)
    return parser


def _add_out(parser: argparse.ArgumentParser, folder: str) -> None:
    parser.add_argument("--out", default=folder, metavar="DIR", help="folder to write to")


def _add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    parser.add_argument("--json", action="store_true", help=f"print {what}")


def _demo_flags(parser: argparse.ArgumentParser) -> None:
    _add_out(parser, "robotid-demo")


def _paper_flags(parser: argparse.ArgumentParser) -> None:
    _add_out(parser, "robotid-paper")
    _add_json(parser, "paper.json")
    parser.add_argument(
        "--quick", action="store_true", help="few iterations and motions: a try-out"
    )
    add_progress_flags(parser)


def _inspect_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("urdf", metavar="URDF")
    parser.add_argument("--free-flyer", action="store_true", help="the base floats")
    _add_json(parser)


def _identify_flags(parser: argparse.ArgumentParser) -> None:
    _doctor_flags(parser, "result.json")
    _add_out(parser, "robotid-out")
    add_work_flags(parser)
    add_progress_flags(parser)


def _doctor_flags(parser: argparse.ArgumentParser, json_: str = "one JSON object") -> None:
    parser.add_argument("source", metavar="JOB.toml | URDF")
    parser.add_argument("logs", nargs="*", metavar="LOG", help="logs to fit")
    _add_json(parser, json_)
    add_job_flags(parser)
    add_verbose_flag(parser)


def _track_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")
    _add_out(parser, "robotid-track")
    _add_json(parser, "track.json")
    add_log_flags(parser.add_argument_group("the log"))
    add_verbose_flag(parser)
    _add_serve_flags(parser, "show it in the browser while it runs, in true time")


def _replay_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="URDF")
    parser.add_argument("logs", nargs=1, metavar="LOG")
    parser.add_argument(
        "results", nargs="*", metavar="RESULT", help="result.json, track.json or their folder"
    )
    parser.add_argument("--html", metavar="FILE", help="page to write; default: replay.html")
    parser.add_argument("--ghost", metavar="LOG", help="second motion, shown as a ghost")
    _add_serve_flags(parser, "track the log again, in true time, and show it as it goes")
    add_log_flags(parser.add_argument_group("the log, unless a RESULT says it"))


def _validate_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", metavar="RESULT.json")
    parser.add_argument("logs", nargs="+", metavar="LOG")
    _add_json(parser)


def _compare_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("results", nargs="+", metavar="RESULT.json")
    parser.add_argument("--out", metavar="FILE.html", help="page to write")
    _add_json(parser)


def _convert_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="IN", help="a log of any format, or a bag's folder")
    parser.add_argument("out", metavar="OUT", help="file to write; its suffix says the format")
    parser.add_argument("--joints", metavar="A,B,...", help="joints to write; default: all")
    add_source_flags(parser)
    _add_json(parser)


def _add_serve_flags(parser: argparse.ArgumentParser, help_: str) -> None:
    parser.add_argument("--serve", nargs="?", const=0, type=int, metavar="PORT", help=help_)
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="of --serve; 0: as fast as it can"
    )


def _demo(options: argparse.Namespace) -> None:
    from robotid.commands.demo import run_demo

    print("simulating a UR5 whose masses, armature and friction its URDF does not know ...")
    identification, result, truth = run_demo(options.out)
    print_result(result)
    error = identification.base - truth
    within = sum(abs(error) < 3 * identification.base_error)
    print(f"\n{within} of {len(truth)} base parameters lie within 3 standard errors of the truth")
    print_files(options.out, [*result["outputs"].values(), "result.json", "replay.html"])


def _paper(options: argparse.Namespace) -> None:
    from robotid.paper.run import run_paper
    from robotid.paper.study import PaperSettings

    few = PaperSettings(iterations=5, longest=5, runs=5, patience=5)
    with terminal_progress(quiet=options.json, force=options.progress) as progress:
        result = run_paper(options.out, settings=few if options.quick else None, progress=progress)
    if options.json:
        print(json.dumps(result, allow_nan=False))
        return
    _print_paper(result)
    print(
        f"\nwritten to {options.out}: paper.html, paper.json, replay.html, figures as PNG and SVG"
    )


def _inspect(options: argparse.Namespace) -> None:
    from robotid.doctor.urdf import inspect_urdf
    from robotid.exceptions import ModelError

    inspection = inspect_urdf(options.urdf, free_flyer=options.free_flyer)
    content = inspection.to_dict()
    if options.json:
        print(json.dumps(content, allow_nan=False))
    else:
        print_inspection(content)
    if content["structure"] is None:
        raise ModelError(f"no model can be built from {options.urdf}; see the findings")


def _identify(options: argparse.Namespace) -> None:
    from robotid.commands.identify import run_job
    from robotid.workers.plan import WorkPlan

    job = job_from_flags(options)
    workers = job.workers if options.workers is None else options.workers
    with terminal_progress(quiet=options.json, force=options.progress) as progress:
        plan = WorkPlan(workers, options.scheduler, options.resume, progress)
        _, result = run_job(job, options.out, plan=plan)
    if options.json:
        print(json.dumps(result, allow_nan=False))
        return
    print_result(result)
    print_files(options.out, [*result["outputs"].values(), "result.json"])


def _track(options: argparse.Namespace) -> None:
    from robotid.commands.track import run_track

    job = job_from_flags(options)
    if options.serve is not None:
        _serve(job, options.out, options)
        return
    _print_track(run_track(job, options.out), options)


def _print_track(found: dict[str, Any], options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps(found, allow_nan=False))
        return
    converged = found["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    print(
        f"{found['robot']}: {found['samples']} samples, estimate {1e3 * found['delay']:.0f} ms "
        f"behind, {when}, excitation {found['excitation']:.2f}"
    )
    for change in found["changes"]:
        load = change["payload"]
        print(
            f"step change at {change['onset']:.2f} s, flagged at {change['flagged']:.2f} s; as a "
            f"load on {load['body']}: {load['mass']:.2f} +- {load['std_error']:.2f} kg"
        )
    for entry in found["base_parameters"]:
        print(f"  {entry['name']:32} {entry['value']:10.4g} +- {entry['std_error']:.2g}")
    print_files(options.out, [found["history"], "track.json"])


def _replay(options: argparse.Namespace) -> None:
    from robotid.commands.replay import read_findings, replay_files, stated_job

    findings = read_findings(options.results)
    if findings.settings is None:
        job = job_from_flags(options)
    else:
        refuse_log_flags(options, "a RESULT says how its logs are read")
        job = stated_job(findings, options.source, options.logs[0])
    if options.html or options.serve is None:
        page = replay_files(job, findings, ghost=options.ghost)
        target = page.write(options.html or "replay.html")
        print(f"written: {target}, {target.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
    if options.serve is not None:
        _serve(job, None, options)


def _serve(job: "Job", folder: str | None, options: argparse.Namespace) -> None:
    from robotid.commands.track import serve_track

    def announce(url: str) -> None:
        print(f"live: {url}  (Ctrl-C ends it)", file=sys.stderr, flush=True)

    def finished(found: dict[str, Any]) -> None:
        if folder is not None:
            _print_track(found, options)
            sys.stdout.flush()

    settings = {"port": options.serve, "speed": options.speed}
    try:
        serve_track(job, folder, **settings, announce=announce, finished=finished)
    except KeyboardInterrupt:
        print("\nended", file=sys.stderr)


def _doctor(options: argparse.Namespace) -> int:
    from robotid.commands.doctor import examine
    from robotid.doctor.diagnosis import alarming, findings_to_dict

    job = job_from_flags(options)
    findings = examine(job)
    content = findings_to_dict(findings)
    code = 1 if alarming(findings, job.ignore) else 0
    if options.json:
        print(json.dumps(content, allow_nan=False))
        return code
    for severity in ("error", "warning", "note"):
        for finding in content["findings"]:
            if finding["severity"] == severity:
                print(f"{severity}: {finding['code']}: {finding['message']}")
    return code


def _validate(options: argparse.Namespace) -> None:
    from robotid.commands.validate import validate_result

    found = validate_result(options.result, options.logs)
    if options.json:
        print(json.dumps(found, allow_nan=False))
        return
    print_validation(found)


def _compare(options: argparse.Namespace) -> None:
    from robotid.report.comparison import compare_results, write_comparison

    if options.out:
        content = write_comparison(options.results, options.out)
    else:
        content = compare_results(options.results)
    if options.json:
        print(json.dumps(content, allow_nan=False))
        return
    print_comparison(content)
    if options.out:
        print(f"\nwritten to {options.out}")


def _convert(options: argparse.Namespace) -> None:
    from dataclasses import asdict

    from robotid.commands.convert import convert
    from robotid.logs.settings import LogSource

    joints = options.joints.split(",") if options.joints else None
    source = LogSource(**source_settings(options))
    done = convert(options.log, options.out, joints=joints, source=source)
    if options.json:
        print(json.dumps(asdict(done)))
        return
    print(f"{done.path}: {done.samples} samples of {len(done.joints)} joints")
    print(f"  columns {', '.join(done.columns)}")
    if done.ignored:
        print(f"  not of a joint, left out: {', '.join(done.ignored)}")


def _print_paper(result: dict[str, Any]) -> None:
    columns = {"disturbed": "disturbed", "noisy": "noisy", "on_program": "on program"}
    print("relative error of the parameters; the last three columns at the end")
    print("  model       start   after 1   at end   " + "  ".join(columns.values()) + "   NA")
    for name, model in result["models"].items():
        errors = model["relative_error"]
        ends = [result[case][name]["relative_error"][-1] for case in columns]
        cells = [errors[0], errors[1], errors[-1], *ends]
        print(f"  {name:10}" + "".join(f"{cell:9.2g}" for cell in cells) + f"   {model['NA']}")
    print("\nrandom motions that converged to 1e-3")
    for name, found in result["trajectories"].items():
        print(f"  {name:10} {found['converged']} of {found['runs']}")


#: What each command is for, what adds its flags, and what runs it.
_COMMANDS: Mapping[str, tuple[str, Callable[[argparse.ArgumentParser], None], _Run]] = {
    "demo": ("simulate a UR5, identify it, report: needs no input", _demo_flags, _demo),
    "paper": ("the paper's simulation: figures, tables, numbers", _paper_flags, _paper),
    "inspect": ("joints, parameters and faults of a URDF", _inspect_flags, _inspect),
    "identify": (
        "identify a robot: JOB.toml, or URDF LOG [LOG ...]",
        _identify_flags,
        _identify,
    ),
    "track": ("run over a log as if live: history, step changes", _track_flags, _track),
    "replay": (
        "play a log in the browser: robot, torques, what was identified",
        _replay_flags,
        _replay,
    ),
    "doctor": ("what is wrong with logs: JOB.toml, or URDF LOG ...", _doctor_flags, _doctor),
    "validate": ("measure a result's prediction on other logs", _validate_flags, _validate),
    "compare": ("several results side by side", _compare_flags, _compare),
    "convert": (
        "write a log as CSV, Parquet, NPZ, HDF5 or MAT, with standard column names",
        _convert_flags,
        _convert,
    ),
}
