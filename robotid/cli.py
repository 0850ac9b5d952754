"""The command line: flags to arguments, results to text; nothing is computed here."""

import argparse
import io
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from robotid._files import check_file
from robotid.commands.console import (
    Terminated,
    open_closed_streams,
    print_error,
    shown_log,
    terminal_progress,
    terminations_raised,
    unheard_in_silence,
)
from robotid.commands.flags import (
    add_flags,
    job_from_flags,
    motion_settings,
    refuse_log_flags,
    simulation_from_flags,
    source_settings,
    source_words,
    stated_noise,
)
from robotid.commands.printing import print_content, print_files, print_steps, say
from robotid.exceptions import RobotIdError, SettingsError
from robotid.versions import __version__

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from robotid._typing import ProgressCallback
    from robotid.commands.job import Job

__all__ = ["main"]

_Run: TypeAlias = Callable[[argparse.Namespace], int | None]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: The words after ``robotid``; those of the process if None.

    Returns:
        Exit code: 0 done, 1 the data or the model do not allow it or the doctor found an error
        that is not ignored, 2 wrong usage, 129 SIGHUP, 130 Ctrl-C, 143 SIGTERM.
    """
    code = 0
    open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # whose encoding may lack what a name has
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with unheard_in_silence():
            code = _run(sys.argv[1:] if arguments is None else arguments)
    except OSError as error:  # the standard output cannot be written to
        print_error(error)
        return 1
    return code


def _run(words: Sequence[str]) -> int:
    """Run a command line, tell what stops it, and return its exit code."""
    options = _parser(words).parse_args(words, argparse.Namespace(words=words))
    try:
        with terminations_raised(), shown_log(is_verbose=getattr(options, "verbose", False)):
            code: int | None = options.run(options)
    except BrokenPipeError:
        raise
    except SettingsError as error:
        print_error(error)
        return 2
    except (RobotIdError, OSError) as error:
        print_error(error)
        return 1
    except MemoryError as error:
        remedy = "not enough memory; lower rates, shorten logs, or lock joints"
        print_error(error, f"{remedy} ({error})" if str(error) else remedy)
        return 1
    except KeyboardInterrupt as error:
        print_error(error, "interrupted")
        return 128 + error.number if isinstance(error, Terminated) else 130
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
    for name, (summary, run) in _COMMANDS.items():
        command = commands.add_parser(name, help=summary)
        command.set_defaults(run=run)
        if name == chosen:
            add_flags(command, name)
    return parser


def _show(
    content: dict[str, Any], options: argparse.Namespace, command: str, files: Sequence[str] = ()
) -> None:
    """Print what a command found and which files it wrote, or its JSON alone."""
    with unheard_in_silence():
        if options.json:
            print(json.dumps(content, allow_nan=False))
            return
        shown = {"is_verbose": options.verbose} if hasattr(options, "verbose") else {}
        if hasattr(options, "base"):
            shown["with_base"] = options.base
        print_content(command, content, **shown)
        if files:
            print_files(options.out, files)


def _demo(options: argparse.Namespace) -> None:
    from robotid.commands.demo import run_demo

    say("simulating a UR5 whose masses, armature and friction its URDF does not know ...")
    with terminal_progress() as progress:
        identification, result, truth = run_demo(options.out, progress=progress)
    print_content("identify", result)
    error = identification.base - truth
    within = sum(abs(error) < 3 * identification.base_error)
    say(f"\n{within} of {len(truth)} base parameters lie within 3 standard errors of the truth")
    print_files(options.out, [*result["outputs"].values(), "result.json", "replay.html"])


def _paper(options: argparse.Namespace) -> None:
    from robotid.paper.run import run_paper
    from robotid.paper.study import PaperSettings

    few = PaperSettings(iterations=5, longest=5, runs=5, patience=5)
    with _progress(options) as progress:
        result = run_paper(options.out, settings=few if options.quick else None, progress=progress)
    _show(result, options, "paper")
    if not options.json:
        files = "paper.html, paper.json, replay.html, figures as PNG and SVG"
        print(f"\nwritten to {options.out}: {files}")


def _inspect(options: argparse.Namespace) -> None:
    from robotid.doctor.urdf import inspect_urdf
    from robotid.exceptions import ModelError

    content = inspect_urdf(options.urdf, free_flyer=options.free_flyer).to_dict()
    if not (content["robot"] or options.json):
        raise ModelError(content["findings"][0]["message"])
    _show(content, options, "inspect")
    if content["structure"] is None:
        raise ModelError(f"no model can be built from {options.urdf}; see the findings")


def _progress(options: argparse.Namespace) -> "AbstractContextManager[ProgressCallback | None]":
    """Return the progress that the flags of a command ask for."""
    return terminal_progress(
        quiet=options.json,
        force=getattr(options, "progress", False),
        is_verbose=getattr(options, "verbose", False),
    )


def _identify(options: argparse.Namespace) -> int:
    from robotid._typing import report_stage

    with _progress(options) as progress:
        report_stage(progress, "reading logs")  # before what takes the first second: its modules
        from robotid.commands.identify import run_job
        from robotid.identification.result import Identification
        from robotid.report.advice import Origin, next_steps
        from robotid.workers.plan import WorkPlan

        job = job_from_flags(options)
        workers = job.workers if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, options.resume, progress)
        source = source_words(options.words)
        found, result = run_job(job, options.out, plan=plan, source=source)
    _show(result, options, "identify", [*result["outputs"].values(), "result.json"])
    if isinstance(found, Identification) and not options.json:
        print_steps(next_steps(found, Origin(source, options.out)))
    return 1 if result["verdict"]["alarms"] else 0


def _track(options: argparse.Namespace) -> None:
    from robotid.commands.track import run_track

    job = job_from_flags(options)
    if options.serve is not None:
        _serve(job, options.out, options)
        return
    _show_track(run_track(job, options.out), options)


def _show_track(found: dict[str, Any], options: argparse.Namespace) -> None:
    _show(found, options, "track", [found["history"], "track.json"])


def _replay(options: argparse.Namespace) -> None:
    from robotid.commands.replay import read_findings, replay_files, stated_job

    findings = read_findings(options.results)
    if findings.settings is None:
        job = job_from_flags(options)
    else:
        refuse_log_flags(options, "a RESULT says how its logs are read")
        job = stated_job(findings, options.source, options.logs[0])
    if options.html or options.serve is None:
        check_file(Path(options.html or "replay.html"))
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
            _show_track(found, options)
            sys.stdout.flush()

    settings = {"port": options.serve, "speed": options.speed}
    try:
        serve_track(job, folder, **settings, announce=announce, finished=finished)
    except Terminated:
        raise
    except KeyboardInterrupt:
        print("\nended", file=sys.stderr)


def _doctor(options: argparse.Namespace) -> int:
    from robotid.commands.logs import examine
    from robotid.doctor.diagnosis import findings_to_dict
    from robotid.judgement.verdict import alarming

    with _progress(options) as progress:
        job = job_from_flags(options)
        model = job.model()
        findings = examine(job, model, progress=progress)
    content = findings_to_dict(findings) | {"joints": list(model.joints)}
    _show(content, options, "doctor")
    return 1 if alarming(findings, job.ignore) else 0


def _excite(options: argparse.Namespace) -> None:
    from robotid.commands.excite import design_motion

    options.logs = []
    job = job_from_flags(options, needs_logs=False)
    with terminal_progress(quiet=options.json, force=options.progress) as progress:
        settings = motion_settings(options)
        found = design_motion(
            job, settings, options.out,
            given=options.given, report=options.report, progress=progress,
        )  # fmt: skip
    _show(found, options, "excite")
    if options.report and not options.json:
        print(f"\nwritten to {options.report}")


def _preview(options: argparse.Namespace) -> None:
    from robotid.commands.preview import preview_job

    if options.given:
        refuse_log_flags(options, "a RESULT says how its logs are read")
    stated = {"noise": stated_noise(options), "correlation": options.correlation}
    _show(preview_job(job_from_flags(options), options.given, **stated), options, "preview")


def _validate(options: argparse.Namespace) -> None:
    from robotid.commands.validate import validate_result

    _show(validate_result(options.result, options.logs), options, "validate")


def _payload(options: argparse.Namespace) -> None:
    from robotid.commands.payload import is_result, measure_payload

    if any(map(is_result, options.reference)):
        refuse_log_flags(options, "a RESULT says how its logs are read")
    with _progress(options) as progress:
        found = measure_payload(
            job_from_flags(options),
            options.reference,
            links=options.link,
            masses=options.mass,
            find_gains=options.gains,
            progress=progress,
        )
    _show(found, options, "payload")


def _report(options: argparse.Namespace) -> None:
    from robotid._typing import report_stage

    with _progress(options) as progress:
        report_stage(progress, "reading logs")
        from robotid.commands.report import rewrite_report

        written = rewrite_report(options.result, options.out, progress=progress)
    _show(written, options, "report")


def _compare(options: argparse.Namespace) -> None:
    from robotid.report.comparison import compare_results, write_comparison

    if options.out:
        content = write_comparison(options.results, options.out)
    else:
        content = compare_results(options.results)
    _show(content, options, "compare")
    if options.out and not options.json:
        print(f"\nwritten to {options.out}")


def _export(options: argparse.Namespace) -> None:
    from robotid.commands.export import export_result

    chosen = {key: getattr(options, key) for key in ("step", "delay")}
    done = export_result(options.result, options.format, options.out, **chosen)
    _show(done, options, "export")


def _simulate(options: argparse.Namespace) -> None:
    from robotid.commands.simulate import SimulatedFiles, simulate_log

    job, settings = simulation_from_flags(options)
    urdf = Path(options.urdf) if options.urdf else None
    files = SimulatedFiles(Path(options.motion), Path(options.out), urdf, options.cutoff)
    with terminal_progress(quiet=options.json) as progress:
        content = simulate_log(job, files, settings, progress=progress)
    _show(content, options, "simulate")
    if not options.json:
        print_files("", content["outputs"])


def _convert(options: argparse.Namespace) -> None:
    from dataclasses import asdict

    from robotid.commands.convert import convert
    from robotid.logs.settings import LogSource

    joints = options.joints.split(",") if options.joints else None
    source = LogSource(**source_settings(options))
    done = convert(options.log, options.out, joints=joints, source=source)
    _show(asdict(done), options, "convert")


#: What each command is for, and what runs it.
_COMMANDS: Mapping[str, tuple[str, _Run]] = {
    "demo": ("simulate a UR5, identify it, report: needs no input", _demo),
    "paper": ("the paper's simulation: figures, tables, numbers", _paper),
    "inspect": ("joints, parameters and faults of a URDF", _inspect),
    "identify": ("identify a robot: JOB.toml, or URDF LOG [LOG ...]", _identify),
    "track": ("run over a log as if live: history, step changes", _track),
    "excite": ("design the motion to record, within the robot's limits", _excite),
    "preview": ("what a motion will tell, before it is recorded", _preview),
    "replay": ("play a log in the browser: robot, torques, what was identified", _replay),
    "doctor": ("what is wrong with logs: JOB.toml, or URDF LOG ...", _doctor),
    "validate": ("measure a result's prediction on other logs", _validate),
    "payload": ("what hangs on a link: a log with it against one without", _payload),
    "report": ("write the report of a result again, from its inputs", _report),
    "compare": ("several results side by side", _compare),
    "export": (
        "write a result as URDF, MJCF, SDF, Isaac Lab's actuators or ranges for randomisation",
        _export,
    ),
    "simulate": ("a log of a motion by a robot whose truth is known", _simulate),
    "convert": (
        "write a log as CSV, Parquet, NPZ, HDF5 or MAT, with standard column names",
        _convert,
    ),
}
