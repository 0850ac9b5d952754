"""robotid replay: play a log in the browser: robot, torques, identified parameters."""

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import check_file, read_json
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.cli.job import (
    JOB,
    ONLINE,
    Job,
    LogEntry,
    job_from_flags,
    refuse_log_flags,
    written_job,
)
from robotid.cli.logs import log_of_commands
from robotid.data.base_motion import BaseMotion
from robotid.data.files.read import open_table
from robotid.data.log import Log
from robotid.data.signal_settings import LogSource
from robotid.design.clearance import Clearance
from robotid.design.limits import LIMITS, Course, MotionLimits
from robotid.dynamics.prepared_logs import closed_log
from robotid.dynamics.torque import predict, predict_instants
from robotid.estimation.fitting.recorded import hold_log
from robotid.identification.result import TorqueIdentification
from robotid.output.files.result_file import (
    Result,
    load_result,
    stated_model,
    stated_urdf_with_drives,
)
from robotid.output.files.shape import check_shape, schema
from robotid.output.report.pictures import shown_evaluation
from robotid.output.viewer.replays import Bands, Mark, Replay, Torques, replay
from robotid.robot.model import RobotModel

#: Columns of the pose of a floating base in the world: position [m] and quaternion.
_BASE = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")
_PROJECTED = "Torques: the part that contact forces cannot cause."
#: Label of the torque of the URDF's bodies with identified drives.
_DRIVEN = "URDF + drives"


@dataclass(frozen=True)
class Findings:
    """Results of identifications and of a tracker, as read from their files."""

    results: Mapping[str, Result]  # by label
    track: Mapping[str, Any] | None = None  # content of a track.json
    folder: Path = Path()  # of the track.json and its history
    beside: Path = Path()  # folder of the first file

    def job(self, urdf: str | Path, log: str | Path) -> Job:
        """Return the job of the first of them, with another URDF and log."""
        contents = [*(result.content for result in self.results.values()), self.track]
        settings = next(content["settings"] for content in contents if content)
        job = written_job(settings, "settings of the result")
        parts = tuple(x for x in job.validation if x.path.resolve() == Path(log).resolve())
        fitted = (LogEntry(Path(log)),)
        return replace(job, urdf=Path(urdf), identification=fitted, validation=parts)


def read_findings(paths: Sequence[str | Path]) -> Findings:
    """Read results to show; the label of a result is the name of its folder."""
    results, tracks, beside = dict[str, Result](), list[tuple[Path, Mapping[str, Any]]](), [Path()]
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [path / x for x in ("result.json", "track.json") if (path / x).is_file()]
        if not files:
            raise DataError(f"{str(path)!r} has no result.json and no track.json")
        beside.append(files[0].parent)
        for file in files:
            content = read_json(file, "result")
            if isinstance(content, dict) and {"history", "changes"} <= set(content):
                check_shape(content, schema("track"), file.name)
                tracks.append((file.parent, content))
                continue
            name = file.resolve().parent.name if len(paths) > 1 else "identified"
            label = name if name not in results else f"{name} {len(results) + 1}"
            results[label] = load_result(file)
    if len(tracks) > 1:
        raise DataError(f"{len(tracks)} tracks are given, expected at most one")
    folder, track = tracks[0] if tracks else (Path(), None)
    return Findings(results, track, folder, beside[min(1, len(paths))])


def replay_files(job: Job, findings: Findings, *, ghost: str | Path | None = None) -> Replay:
    """Return the replay of a log, a page to write."""
    model = job.model()
    (entry,) = job.identification
    if commanded := {label: x for label, x in findings.results.items() if x.commanded}:
        return _replay_commanded(job, commanded, ghost, _marks(job, findings.track))
    is_motion = not job.lay_out(entry, model, needs="motion")[0].has_torque
    motion = closed_log(model, job.read(entry, model, needs="motion" if is_motion else "torque"))
    robots = {label: stated_model(x.content, model) for label, x in findings.results.items()}
    bodies = {label: robot.carried_by for label, robot in robots.items()}
    ghosts = {}
    if ghost is not None:
        shadow = closed_log(model, job.read(LogEntry(Path(ghost)), model, needs="motion"))
        ghosts[Path(ghost).name] = (shadow.t, shadow.q)
    torques, marks, notes = None, _marks(job, findings.track), [f"Motion: {entry.path.name}."]
    if is_motion:
        if not model.free_flyer:  # else the forces of the ground are part of the torques
            used, further = _limits_used(job, motion, model)
            marks, notes = [*marks, *used], [*notes, *further]
    else:
        torques = _torques(job, motion, model, robots, findings.results)
        torques = replace(torques, noise=_noise(findings, model))
        notes += [_PROJECTED] if model.constraints else []
    n = model.layout.n_inertial  # drives of the result may have further terms
    masses = {"URDF": model.standard_parameters(), **bodies} if bodies else {}
    masses = {label: pi[:n] for label, pi in masses.items()}
    shown, q = model, motion.q
    if motion.base is not None:
        q = np.hstack([motion.base.pose, q])
    base = None if ghosts or model.free_flyer else _base_poses(job, entry, motion)
    if base is not None:  # the same robot with the trunk as first body
        shown = RobotModel.from_urdf(
            job.urdf, joints=model.joints, locked=job.locked, free_flyer=True, mimic=job.mimic,
            snap_angles=job.snap_angles,
        )  # fmt: skip
        q = np.hstack([base, q])
        trunk = shown.standard_parameters()[:10]
        masses = {label: np.r_[trunk, pi] for label, pi in masses.items()}
    return replay(
        shown, motion.t, q, torques=torques, masses=masses or None, ghosts=ghosts,
        bands=None if findings.track is None else _bands(findings.track, findings.folder),
        marks=marks, notes=notes, log=entry.path.name,
    )  # fmt: skip


def replay_identified(identification: TorqueIdentification) -> Replay:
    """Return the replay of an identification: its first validation log, or its first fitted one."""
    shown, model = shown_evaluation(identification), identification.model
    motion, mask = shown.recording.trajectory, shown.recording.mask
    wanted = {"identified": "estimate", _DRIVEN: "urdf_with_drives"}
    if not model.layout.drive_names:
        del wanted[_DRIVEN]
    predicted = {label: _of_moving(shown.torques[key], mask) for label, key in wanted.items()}
    predicted["URDF"] = shown.torques["urdf"]
    sigma = identification.estimate.sigma[model.n_rows - len(model.joints) :]
    torques = _of_joints(Torques(motion.t, motion.tau, predicted, sigma), model)
    masses = {"URDF": identification.prior, "identified": identification.standard}
    notes = [f"Motion: {shown.recording.name}.", *([_PROJECTED] if model.constraints else [])]
    log = Path(shown.recording.log.path).name
    return replay(model, motion.t, motion.q, torques=torques, masses=masses, notes=notes, log=log)


def _replay_commanded(
    job: Job, results: Mapping[str, Result], ghost: str | Path | None, marks: Sequence[Mark]
) -> Replay:
    """Return the replay of a log of commands: measured, commanded and simulated robot."""
    (entry,) = job.identification
    first = next(iter(results.values()))
    model, zero = first.robot, np.array([drive.zero for drive in first.commanded])
    log = log_of_commands(job, entry, first)
    q_ref = np.asarray(log.q_ref)
    simulated = {label: result.follow_commands(log) for label, result in results.items()}
    names = ["simulated"] if len(simulated) == 1 else [f"simulated: {x}" for x in simulated]
    shown = dict(zip(names, simulated.values(), strict=True)) | {"commanded": q_ref}
    known = {label: np.isfinite(q).all(axis=1) for label, q in shown.items()}
    ghosts = {label: (log.t[rows], shown[label][rows] + zero) for label, rows in known.items()}
    if ghost is not None:
        other = job.read(LogEntry(Path(ghost)), model, needs="motion")
        ghosts[Path(ghost).name] = (other.t, other.q + zero)
    lag = np.sqrt(np.mean((q_ref - log.q) ** 2, axis=0))
    error = np.sqrt(np.nanmean((shown[names[0]] - log.q) ** 2, axis=0))
    worst = [f"{model.joints[j]} {1e3 * error[j]:.2g}" for j in np.argsort(-error).tolist()]
    notes = [
        f"Motion: {entry.path.name}, as measured; ghosts: command and simulation.",
        f"Simulated position error, RMS [mrad or mm]: {listed(worst, 3)}.",
    ]
    torques, q, name = Torques(log.t, log.q, shown, lag, "position"), log.q + zero, entry.path.name
    return replay(
        model, log.t, q, torques=torques, ghosts=ghosts, marks=marks, notes=notes, log=name
    )


def _base_poses(job: Job, entry: LogEntry, log: Log) -> Array | None:
    """Return the poses of a floating base, (N, 7) as x y z qx qy qz qw; None without columns."""
    table = open_table(entry.path, job.source)
    time = next((name for name in ("time", "t") if name in table.names), None)
    if time is None or not {*_BASE} <= {*table.names}:
        return None
    columns = table.read([time, *_BASE])
    pose = np.column_stack([columns[name] for name in _BASE])
    known = np.isfinite(pose).all(axis=1)
    if not known.any():
        return None
    try:
        pose = BaseMotion(pose[known]).pose  # with continuous signs
    except DataError as error:
        remedy = "remove these columns for a fixed base"
        raise DataError(f"{entry.path.name}: {error}; {remedy}") from error
    t = columns[time][known]
    at = np.column_stack([np.interp(log.t, t, column) for column in pose.T])
    at[:, 3:] /= np.linalg.norm(at[:, 3:], axis=1, keepdims=True)
    return at


def _noise(findings: Findings, model: RobotModel) -> Array | None:
    """Return the RMS residual of each joint on the fitted logs of the first result."""
    first = next(iter(findings.results.values()), None)
    fitted = first.content["identification"]["per_joint"] if first else {}
    errors = [fitted.get(joint, {}).get("rmse") for joint in model.joints]
    return np.array(errors) if all(errors) else None


def _torques(
    job: Job, log: Log, model: RobotModel, robots: Mapping[str, RobotModel],
    results: Mapping[str, Result],
) -> Torques:  # fmt: skip
    """Return measured torques, and those predicted by each result and by the URDF."""
    torques, driven, motion = dict[str, Array](), dict[str, Array](), None
    for label, robot in robots.items():
        rows = hold_log(robot, log, job.signals).whole
        motion, pi = rows.trajectory, [robot.carried_by]
        if not driven and robot.layout.drive_names:
            beside = stated_urdf_with_drives(results[label].content, robot)
            pi += [] if beside is None else [beside]
        predicted = [_of_moving(torque, rows.mask) for torque in predict(robot, pi, motion)]
        torques[label] = predicted[0]
        driven |= dict(zip([_DRIVEN], predicted[1:], strict=False))
    if motion is None:
        return Torques(log.t, log.tau)
    alone = {"URDF": predict(model, [model.standard_parameters()], motion)[0]}
    return _of_joints(Torques(motion.t, motion.tau, torques | driven | alone), model)


def _of_joints(torques: Torques, model: RobotModel) -> Torques:
    """Return torques without the rows of a floating base."""
    first = model.n_rows - len(model.joints)
    predicted = {label: torque[:, first:] for label, torque in torques.predicted.items()}
    return replace(torques, measured=torques.measured[:, first:], predicted=predicted)


def _of_moving(torque: Array, mask: Array) -> Array:
    """Return a prediction without the rows of joints at rest: friction has no sign there."""
    return np.where(mask, torque, np.nan)


def _bands(track: Mapping[str, Any], folder: Path) -> Bands:
    table = open_table(folder / track["history"], LogSource())
    names, units = zip(*((x["name"], x["unit"]) for x in track["base_parameters"]), strict=True)
    errors = [f"{name}.std_error" for name in names]
    wanted = ["time", *names, *errors]
    if missing := [name for name in wanted if name not in table.names]:
        raise DataError(f"{track['history']} has no column {missing[0]!r}; run robotid track again")
    columns = table.read(wanted)
    theta, std_error = (np.column_stack([columns[x] for x in some]) for some in (names, errors))
    return Bands(columns["time"], list(names), list(units), theta, std_error)


def _marks(job: Job, track: Mapping[str, Any] | None) -> list[Mark]:
    """Return marks at the validated parts of the log, and at the payloads of a track."""
    words = "payload {mass:.2f} ± {std_error:.2f} kg on {body}"
    changes = [] if track is None else track["changes"]
    parts = [x.start for x in job.validation if x.start is not None]
    marks = [Mark(start, "start of the validated part", "validation") for start in parts]
    return marks + [Mark(x["onset"], words.format(**x["payload"]), "payload") for x in changes]


def _limits_used(job: Job, motion: Log, model: RobotModel) -> tuple[list[Mark], list[str]]:
    """Return marks at the smallest margin to each limit and at the smallest distance, and notes."""
    try:
        limits = MotionLimits.of_model(model, share=1.0)
    except SettingsError as error:
        return [], [f"The motion has no torques. Limits are not marked: {error}."]
    v = np.gradient(motion.q, motion.t, axis=0) if motion.v is None else motion.v
    a = np.gradient(v, motion.t, axis=0) if motion.a is None else motion.a
    torque = predict_instants(model, model.standard_parameters(), motion.q, v, a)
    marks, notes = [], ["The motion has no torques. Marks: largest use of each limit of the URDF."]
    course = Course.of_motion(motion.t, (motion.q, v, a, torque), limits)
    for kind, used in zip(LIMITS, course.largest, strict=True):
        joint = int(np.argmax(used))
        if used[joint] > 0:
            name = model.joints[joint]
            label = f"{name} at {100 * used[joint]:.0f} % of its {kind} limit"
            marks.append(Mark(course.peak(kind, joint), label, "note", name))
    try:
        near = replace(course, clearance=Clearance(model)).nearest
    except DataError as error:
        return marks, [*notes, f"Collisions are not checked: {error}."]
    if near is not None:
        gap = f"smallest distance {1e3 * near.distance:.0f} mm"
        text = gap if near.distance > 0 else "convex hulls overlap"
        marks.append(Mark(near.time, f"{near.first} and {near.second}: {text}"))
    return marks, notes


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="URDF")
    add("logs", nargs=1, metavar="LOG")
    results = "result.json, track.json or their folder"
    add("results", nargs="*", metavar="RESULT", help=results)
    add("--html", metavar="FILE", help="page to write; default: replay.html beside the RESULT")
    add("--ghost", metavar="LOG", help="second motion, shown as a ghost")
    JOB.add(parser.add_argument_group("the log, unless a RESULT is given"), ONLINE)


def run(options: argparse.Namespace) -> None:
    if options.source.endswith(".toml"):
        raise SettingsError(f"{options.source} is a job file, expected URDF LOG [RESULT ...]")
    findings = read_findings(options.results)
    if options.results:
        refuse_log_flags(options, "a RESULT has the settings of its logs")
        job = findings.job(options.source, options.logs[0])
    else:
        job = job_from_flags(options)
    page_file = Path(options.html or findings.beside / "replay.html")
    check_file(page_file, [options.source, *options.logs, *options.results])
    target = replay_files(job, findings, ghost=options.ghost).write(page_file)
    print(f"written: {target}, {target.stat().st_size / 1e6:.1f} MB", file=sys.stderr)
