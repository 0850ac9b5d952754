"""robotid identify: identify a robot: JOB.toml, or URDF LOG [LOG ...]."""

import argparse
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import check_folder, folder_beside, remove_written, write_json
from robotid.base.findings import Finding
from robotid.base.settings import require_flag, require_kind
from robotid.base.text import columns, in_digits_of, terminal_width, wrapped
from robotid.base.typing import STAGES, ProgressCallback, ignore_progress, report_stage
from robotid.cli.console import (
    echo,
    print_causes,
    print_steps,
    print_verdict,
    progress_of,
    recordings_of,
    show_found,
)
from robotid.cli.job import (
    OUTPUT,
    Job,
    LogEntry,
    add_job,
    add_out,
    add_shown,
    add_work,
    job_file,
    job_from_flags,
    source_words,
)
from robotid.cli.logs import (
    Refused,
    examine_logs,
    locked_as_logged,
    needed_of,
    survey_logs,
    units_of_logs,
)
from robotid.cli.payload import check_payloads
from robotid.data.files.read import Readable
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.verdict.fit_findings import locked_findings
from robotid.diagnosis.verdict.verdict import check_ignored
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.friction_projection import project_friction
from robotid.estimation.fitting.estimator_settings import EstimatorSettings, SimulationSettings
from robotid.estimation.fitting.evaluation import Evaluated
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.work_plan import WorkPlan
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.pipeline import conclude, in_memory, logs_of, robot_of
from robotid.identification.result import Identification, TorqueIdentification
from robotid.identification.summary import (
    error_lines,
    friction_lines,
    left_out_lines,
    variation_lines,
)
from robotid.output.files.entries import build_result
from robotid.output.files.urdf import DYNAMICS_TERMS, write_urdf
from robotid.output.report.next_steps import Origin, next_steps
from robotid.output.report.report_content import write_report
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import AUTO, wanted_families
from robotid.robot.model import RobotModel
from robotid.robot.tree import read_tree

if TYPE_CHECKING:
    from robotid.output.viewer.replays import Replay


_log = logging.getLogger(__name__)
_NO_LOGS: tuple[Log, ...] = ()


def identify(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable] | None = None,
    *,
    validation: Readable | Sequence[Readable] = _NO_LOGS,
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
    controller: Mapping[str, Any] | None = None,
    friction: str | Mapping[str, str] = AUTO,
    doctor: bool = True,
    ignore: Sequence[str] = (),
    progress: ProgressCallback | None = None,
) -> Identification:
    """Identify a robot's parameters from motion logs, as the command line does.

    Args:
        model: The robot, or the path of its URDF with all joints free; or a job file, alone, which
            states logs and settings, and whose long logs are read in pieces.
        logs: Logs to fit, one or several: a ``Log`` with the model's joints, the path of a file, or
            a DataFrame with its columns. Files are read whole, as by ``read_log``.
        validation: Logs for validation, of the same types.
        signals: Settings of the signal processing; the defaults if None.
        estimator: Name or settings of the estimator. "simulation" simulates the robot on the
            commands, or on the torques, of the logs.
        controller: Known properties of the position controllers, the keys of ``[controller]`` of a
            job file; only for the estimator "simulation".
        friction: Terms in addition to viscous and Coulomb friction, as of ``wanted_families``;
            "auto" selects them. Simulation selects those of all joints, or of none.
        doctor: Whether the doctor checks the logs first; its findings count in the verdict.
        ignore: Codes of errors and warnings to ignore.
        progress: Called at the start of each stage with its name, the stages done, their number
            and "stages"; in between with a work, the units done, their number and their name.

    Returns:
        The identification; its evaluations are of torques, or by "simulation" of positions.

    Raises:
        DataError: If a log cannot be read, does not match the model or is too short.
        ModelError: If the model is neither a model nor the path of a usable URDF.
        RankDeficientError: If the estimator is "ols" or "wls" and the data do not determine all
            base parameters.
        NotConvergedError: If a solver fails, or the closed loop cannot be simulated.
        SettingsError: If a setting is out of range, or a code to ignore is unknown.
    """
    require_kind(progress, (Callable, type(None)), "progress", "a function")  # type: ignore[arg-type]
    if logs is None:
        job = job_file(model)
        if not (validation is _NO_LOGS and signals is None and controller is None and not ignore):
            raise SettingsError(
                f"{job.urdf.name} is identified by a job file, which has logs and settings; "
                "set validation, signals, controller and ignore there"
            )
        return identify_job(job, job.model(), WorkPlan(job.workers or 1, progress=progress))
    kinds = (str, EstimatorSettings)
    require_kind(estimator, kinds, "estimator", "a name or a robotid.EstimatorSettings")
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    require_flag(doctor, "doctor")
    check_ignored(ignore)
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    is_simulated = isinstance(choice, SimulationSettings)
    if controller is not None and not is_simulated:
        raise SettingsError(
            f"controller is given, but the estimator is {choice.name!r}, expected 'simulation'; "
            "remove controller, or set estimator='simulation'"
        )
    require_kind(controller, (Mapping, type(None)), "controller", "a table of its settings")
    loop, settings = LoopSettings.from_dict(controller or {}), signals or SignalSettings()
    report_stage(progress, "reading logs", _stages(choice))
    model = robot_of(model, logs)
    wanted = wanted_families(friction, model.joints).values()
    if is_simulated and (any(wanted) or len({names is None for names in wanted}) > 1):
        raise SettingsError(
            "friction is given by joint or with families; for simulation expected 'auto' or "
            "'viscous+coulomb'. Set terms in the model"
        )
    needs = needed_of(loop) if is_simulated else "torque"
    fitted, held_out = (logs_of(model, some, needs) for some in (logs, validation))
    if not fitted:
        raise DataError("no log was given; at least one is needed to identify anything")
    if isinstance(choice, SimulationSettings):
        from robotid.identification.closed_loop.from_commands import identify_loops

        return identify_loops(
            model, fitted, held_out, loop, choice, signals=settings, chooses=None in wanted,
            examined=diagnose(model, fitted, held_out, settings) if doctor else (), ignore=ignore,
            progress=progress or ignore_progress,
        )  # fmt: skip
    recordings = in_memory(model, settings, fitted, held_out)
    report_stage(progress, "checking logs")
    findings = diagnose(model, fitted, held_out, settings) if doctor else ()
    return conclude(recordings, choice, findings, ignore, friction=friction, progress=progress)


def run_job(
    job: Job, folder: str | Path, *, plan: WorkPlan | None = None, source: Sequence[str] = ()
) -> tuple[Identification, dict[str, Any]]:
    """Identify and write result.json, report and URDF; return the result and result.json."""
    plan, target, model = plan or WorkPlan(job.workers or 1), Path(folder), job.model()
    check_folder(target, ["result.json", *_names(model)])
    identification = identify_job(job, model, plan)
    report_stage(plan.progress, "writing", _stages(job.estimator))
    return _write(identification, _job_of(identification), target, source=source)


def save_result(
    identification: Identification, folder: str | Path, *, report: bool = True, replay: bool = False
) -> Path:
    """Write the files of ``robotid identify``: result.json, report, URDF with its sidecar.

    All files are first written to a temporary folder and moved when they are complete. An
    impossible result has no URDF. Logs in files are listed with their hashes. Gains, units and
    column names with which the logs were read in Python are not recorded.

    Args:
        identification: The identification.
        folder: Folder of the results; created if it is missing.
        report: Whether report.html is written.
        replay: Whether replay.html is written: the first validation log, or the first fitted log.

    Returns:
        Path of the result.json.

    Raises:
        DataError: If a replay is wanted of position-controlled drives whose logs are in memory.
        ModelError: If the URDF of the robot no longer exists.
        SettingsError: If the folder is a file, or is not writable.
    """
    wanted = "a robotid.Identification"
    require_kind(identification, Identification, "identification", wanted)
    require_kind(folder, (str, Path), "folder", "the path of a folder")
    require_flag(report, "report")
    require_flag(replay, "replay")
    target = Path(folder)
    check_folder(target, ["result.json", *_names(identification.model)])
    job = replace(_job_of(identification), report=report, replay=replay)
    _write(identification, job, target)
    return target / "result.json"


def _names(model: RobotModel) -> tuple[str, str, str, str]:
    stem = Path(model.tree.path).stem
    return "report.html", "replay.html", f"{stem}.identified.urdf", f"{stem}.identified.drive.json"


def _write(
    identification: Identification, job: Job, target: Path, *, source: Sequence[str] = ()
) -> tuple[Identification, dict[str, Any]]:
    """Write all files of a result; return the identification with its report, and result.json."""
    model, pi, outputs = identification.model, identification.standard, dict[str, str]()
    names = report, replay, urdf, sidecar = _names(model)
    played = {"replay": replay} if job.replay else {}
    written = {"urdf": urdf, "sidecar": sidecar} if identification.has_urdf else {}
    target.mkdir(parents=True, exist_ok=True)
    with folder_beside(target) as partial:
        if job.report:
            identification = replace(identification, report=str(target / report))
            links = {"result": "result.json", **written, **played}
            origin = Origin(tuple(source), str(target), replay)
            write_report(identification, partial / report, files=links, origin=origin)
            outputs["report"] = report
        if written:
            moments = identification.moments if job.dynamics else {}
            dynamics = job.dynamics and project_friction(model, pi, moments, DYNAMICS_TERMS)
            write_urdf(model, pi, partial / urdf, dynamics=dynamics)
        outputs |= written | played
        result = build_result(identification, job.to_dict(), outputs=outputs)
        write_json(result, partial / "result.json")
        if job.replay:
            _replay_of(identification, job, partial).write(partial / replay)
    remove_written(target / name for name in sorted({*names} - set(outputs.values())))
    return identification, result


def _replay_of(identification: Identification, job: Job, folder: Path) -> "Replay":
    """Return the replay of a result that is written in a folder; its modules are imported here."""
    from robotid.cli.replay import read_findings, replay_files, replay_identified

    if isinstance(identification, TorqueIdentification):
        return replay_identified(identification)
    entries = (*job.validation, *job.identification)
    if not entries:
        raise DataError(
            "the logs are in memory, and a replay of position-controlled drives reads them from "
            "their files; write the logs with robotid.write_log and identify from these files"
        )
    findings = read_findings([folder])
    stated = findings.job(job.urdf, entries[0].path)
    return replay_files(replace(stated, identification=entries[:1]), findings)


def _job_of(identification: Identification) -> Job:
    """Return the job of an identification; one made in Python gets an equivalent job."""
    model, asked, options = (
        identification.model,
        identification.stated,
        identification.model.options,
    )
    if isinstance(asked.job, Job):
        return asked.job
    chosen, loop = {}, getattr(identification, "loop", LoopSettings())
    if isinstance(identification, TorqueIdentification):
        chosen = {drive.joint: drive for drive in identification.drives}
    wanted = wanted_families(asked.friction, model.joints)
    is_auto = all(names is None for names in wanted.values())
    drives: dict[str, tuple[str | DriveTerm, ...]] = {}
    for name in (drive.name for drive in model.layout.drives):
        choice, terms = chosen.get(name), model.layout.own.get(name, ())
        stated = [term for term in terms if choice is None or term not in choice.terms]
        families = (wanted.get(name) or ()) if choice is None else choice.families
        entries: list[str | DriveTerm] = [*(() if is_auto else families), *stated]
        if entries:
            drives[name] = tuple(entries)
    return Job(
        urdf=Path(model.tree.path), joints=model.joints, locked=options["locked"],
        gravity=tuple(options["gravity"]), mimic=model.mimic,
        snap_angles=read_tree(model.tree.path).joints != model.tree.joints, signals=asked.signals,
        terms=(*model.layout.terms, *([AUTO] if is_auto else [])), model_dynamics=model.dynamics,
        drives=drives, couplings=model.layout.couplings, contacts=model.contacts,
        loops=model.loops, passive=model.passive, estimator=identification.estimator,
        identification=_entries(identification.fitted),
        validation=_entries(identification.validation), ignore=asked.ignore, controller=loop,
    )  # fmt: skip


def _entries(evaluations: Sequence[Evaluated]) -> tuple[LogEntry, ...]:
    """Return the windows of the logs that are in files."""
    files = [(Path(e.log.path), e.extent) for e in evaluations if e.log.path]
    return tuple(LogEntry(path, extent.start, extent.end) for path, extent in files)


def identify_job(
    job: Job, model: RobotModel, plan: WorkPlan, *, refused: Refused | None = None
) -> Identification:
    """Identify from a job's logs; nothing is written."""
    check_ignored(job.ignore)
    report_stage(plan.progress, "reading logs", _stages(job.estimator))
    groups = job.identification, job.validation
    if isinstance(job.estimator, SimulationSettings):
        from robotid.identification.closed_loop.from_commands import identify_loops

        needs = needed_of(job.controller)
        logs, held_out = ([job.read(x, model, needs=needs) for x in entries] for entries in groups)
        identification = identify_loops(
            model, logs, held_out, job.controller, job.estimator, signals=job.signals,
            chooses=AUTO in job.terms, examined=diagnose(model, logs, held_out, job.signals),
            ignore=job.ignore, units=units_of_logs(job.identification),
            progress=plan.progress or ignore_progress,
        )  # fmt: skip
        return replace(identification, stated=replace(identification.stated, job=job))
    fitted, validation = survey_logs(job, model, *groups, refused=refused)
    if not fitted:
        which = "no log is usable" if job.identification else "no log is given"
        raise DataError(f"{which}, expected at least one to identify from")
    report_stage(plan.progress, "checking logs")
    job, model, fitted, validation, notes = locked_as_logged(job, model, fitted, validation)
    locked = locked_findings(model, job.placed(model))
    findings = [*locked, *examine_logs(job, model, fitted, validation)]
    recordings = Recordings(model, structural_mapping(model), fitted, validation)
    if not recordings.is_in_memory:
        recordings = replace(recordings, plan=plan)
    elif plan.scheduler is not None or (plan.workers or 1) > 1:  # not the defaults
        _log.warning(
            "the logs have at most %d rows and are read whole: workers and scheduler have no "
            "effect. Reduce rows_in_memory in [reduction] to read the logs in pieces",
            job.rows_in_memory,
        )
    with plan:
        concluded = conclude(
            recordings, job.estimator, findings, job.ignore, friction=job.friction,
            progress=plan.progress,
        )  # fmt: skip
    checks = check_payloads(job, concluded.model, fitted)
    stated, noted = replace(concluded.stated, job=job), (*notes, *concluded.findings)
    return replace(concluded, stated=stated, findings=noted, payload_checks=checks)


def _stages(choice: EstimatorSettings) -> Sequence[str]:
    """Return the stages of a job; the modules of a simulation are imported only for one."""
    if not isinstance(choice, SimulationSettings):
        return STAGES
    from robotid.identification.closed_loop import stages

    return stages.STAGES


MAIN_FLAGS = (
    "--validate", "--out", "--estimator", "--friction", "--gain", "--joints", "--lock", "--cutoff",
    "--verbose", "--json",
)  # fmt: skip
EXAMPLES = (
    "robotid identify robot.urdf first.csv --validate second.csv --out result",
    "robotid identify job.toml --out result",
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    add_job(parser, OUTPUT)
    add_out(parser, "robotid-out")
    flags = parser.add_argument_group("long logs; performance only")
    add_work(flags, "as in the job file, or one per core for long logs")
    add_shown(parser, "verbose", "progress", json="print result.json")


def run(options: argparse.Namespace) -> int:
    with progress_of(options) as progress:
        report_stage(progress, "reading logs")  # before what takes the first second: its modules
        job = job_from_flags(options)
        workers = job.workers if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, progress=progress)
        source = source_words(options.words)
        identification, result = run_job(job, options.out, plan=plan, source=source)
    show = partial(show_result, findings=identification.findings, is_verbose=options.verbose)
    show_found(result, options, show, [*result["outputs"].values(), "result.json"], options.out)
    if not options.json:
        print_steps(next_steps(identification, Origin(source, options.out)))
    return 1 if result["verdict"]["log_errors"] else 0


def show_result(
    result: dict[str, Any], findings: Sequence[Finding], *, is_verbose: bool = False
) -> None:
    width, wls, verdict = terminal_width(), result.get("wls"), result["verdict"]
    echo(f"\n{result['robot']}: {len(result['joints'])} joints, {_structure_words(result)}")
    roles = ("identification", "validation")
    fitted, validation = (recordings_of(result["inputs"], role) for role in roles)
    if is_verbose or not validation:
        echo(f"\nfitted: {', '.join(fitted)}", "  ")
        errors = error_lines(result["identification"], wls and wls["identification"], width)
        print("\n".join(errors))
    for k, (name, ours) in enumerate(zip(validation, result["validation"], strict=True)):
        echo(f"\nnot fitted: {name}", "  ")
        print("\n".join(error_lines(ours, wls and wls["validation"][k], width)))
    if lines := _drive_lines(result, is_verbose=is_verbose):
        print("\n" + "\n".join(wrapped(line, width, "  ") for line in lines))
    print()
    print_causes(
        findings, result["joints"], is_verbose=is_verbose, printed=verdict["reasons"],
        worst="" if verdict["status"] == "good" else _worst(result),
    )  # fmt: skip
    print_verdict(verdict)


def _structure_words(result: Mapping[str, Any]) -> str:
    """Return the number of parameters and their conditioning, as text."""
    if "simulation" in result:
        from robotid.identification.closed_loop.position_errors import DRIFTS  # imports numpy

        fit, kind = (result["simulation"][key] for key in ("fit", "controller"))
        over = f" over {DRIFTS:g} s" if kind["kind"] == "torque" else ""
        free = f"{fit['parameters']} free parameters"
        return f"{free}; {fit['message']}; errors are position errors{over}"
    structure, (before, after, _) = result["structure"], result["scale_check"]["masses"]
    assumed = " assumed" if result["scale_check"].get("assumed") else ""
    return (
        f"{structure['base']} base parameters, condition number {structure['condition']:.3g}, "
        f"total mass {before:.2f}{assumed} -> {after:.2f} kg"
    )


def _drive_lines(result: Mapping[str, Any], *, is_verbose: bool) -> list[str]:
    """Return the friction terms, or the parameters of drives and controllers of a simulation."""
    varied = variation_lines(result.get("variation"))
    if "simulation" not in result:
        left_out = left_out_lines(result.get("left_out", ()))
        return [*friction_lines(result["friction"], has_errors=is_verbose), *left_out, *varied]
    fitted = [entry for entry in result["drive_parameters"] if entry["std_error"] is not None]
    if is_verbose:
        rows = []
        for entry in fitted:
            half = "at bound" if entry["source"] == "bound" else f"{entry['std_error']:.2g}"
            rows.append((entry["name"], f"{entry['value']:.4g}", half, entry["unit"]))
        return columns(("parameter", "value", "+-", "unit"), rows) + varied
    drives: dict[str, dict[str, str]] = {}
    for entry in fitted:
        owner, _, term = entry["name"].rpartition(".")
        value, _ = in_digits_of(entry["value"], entry["std_error"])
        drives.setdefault(owner, {})[f"{term}\n{entry['unit']}"] = value
    heads = dict.fromkeys(head for values in drives.values() for head in values)
    table = [[drive, *(values.get(x, "-") for x in heads)] for drive, values in drives.items()]
    return columns(["drive\n", *heads], table, width=terminal_width(), needed=2) + varied


def _worst(result: Mapping[str, Any]) -> str:
    """Return the joint with the largest prediction error, and that error."""
    errors = [
        (m["relative_error_pct"], joint)
        for metrics in result["validation"] or [result["identification"]]
        for joint, m in metrics["per_joint"].items()
        if m["relative_error_pct"] is not None
    ]
    error, joint = max(errors, default=(0.0, ""))
    kind = "position" if "simulation" in result else "torque"
    return joint and f"{joint}, {kind} error {error:.1f} %"
