"""A replay from files: the log, what results predict of it, what a tracker saw, a ghost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from robotid._files import read_json
from robotid._typing import Array
from robotid.commands.job import Job, LogEntry, job_from_settings
from robotid.commands.logs import log_of_commands
from robotid.exceptions import DataError, SettingsError
from robotid.excitation.clearance import Clearance
from robotid.excitation.course import Course
from robotid.excitation.limits import LIMITS, MotionLimits
from robotid.export.result import Result, load_result, stated_model
from robotid.export.shape import FILE, NUMBER, TABLE, TEXT, check_shape
from robotid.findings import listed
from robotid.fitting.evaluation import predict
from robotid.fitting.survey import hold_log
from robotid.identification.result import Identification
from robotid.logs.data import Log
from robotid.logs.formats import open_table
from robotid.logs.settings import LogSource
from robotid.regressor.prediction import predict_instants
from robotid.robot.model import RobotModel
from robotid.viewer.replays import Bands, Mark, Replay, Torques, replay
from robotid.viewer.unexplained import find_unexplained

__all__ = ["Findings", "read_findings", "replay_files", "replay_identified", "stated_job"]


#: Columns that say where a floating base was: position [m] and turn in the world.
_BASE = ("base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw")

#: What is read of a track.json.
_TRACK = {
    "settings": TABLE,
    "history": FILE,
    "changes": [{"onset": NUMBER, "payload": {"mass": NUMBER, "std_error": NUMBER, "body": TEXT}}],
    "base_parameters": [{"name": TEXT, "unit": TEXT}],
}


@dataclass(frozen=True)
class Findings:
    """What identifications and a tracker found, as read from their files."""

    results: Mapping[str, Mapping[str, Any]]  # contents of result.json, by label
    commanded: Mapping[str, Result] = field(default_factory=dict)  # those of drives with gains
    track: Mapping[str, Any] | None = None  # content of a track.json
    folder: Path = Path()  # of the track.json, which its history is in

    @property
    def settings(self) -> Mapping[str, Any] | None:
        """The job that the first of them ran, None without any."""
        found = [content for content in (*self.results.values(), self.track) if content]
        return dict(found[0]["settings"]) if found else None


def read_findings(paths: Sequence[str | Path]) -> Findings:
    """Read results to show; a result is called by its folder.

    Args:
        paths: Each a result.json, a track.json, or a folder with one or both.

    Raises:
        DataError: If a file cannot be used, or there are two tracks.
    """
    results: dict[str, Mapping[str, Any]] = {}
    commanded: dict[str, Result] = {}
    tracks: list[tuple[Path, Mapping[str, Any]]] = []
    for path in map(Path, paths):
        files = [path]
        if path.is_dir():
            files = [path / name for name in ("result.json", "track.json")]
            files = [file for file in files if file.is_file()]
            if not files:
                raise DataError(f"there is no result.json or track.json in {str(path)!r}")
        for file in files:
            track = _track(file)
            if track is not None:
                tracks.append((file.parent, track))
                continue
            name = file.resolve().parent.name if len(paths) > 1 else "identified"
            label = name if name not in results else f"{name} {len(results) + 1}"
            loaded = load_result(file)
            results[label] = loaded.content
            if loaded.commanded:
                commanded[label] = loaded
    if len(tracks) > 1:
        raise DataError(f"{len(tracks)} tracks were given; a replay shows one")
    folder, content = tracks[0] if tracks else (Path(), None)
    return Findings(results, commanded, content, folder)


def stated_job(findings: Findings, urdf: str | Path, log: str | Path) -> Job:
    """Return the job whose results are shown, with a URDF and a log of its own.

    Args:
        findings: At least one result or track.
        urdf: The URDF to show.
        log: The log to play.

    Raises:
        SettingsError: If the settings in the file cannot be used, or there is none.
    """
    settings = findings.settings
    if settings is None:
        raise SettingsError("there is no result whose settings could be used")
    table = {key: value for key, value in settings.items() if value != {}}
    job = job_from_settings(table, "settings of the result", Path())
    return replace(job, urdf=Path(urdf), identification=(LogEntry(Path(log)),), validation=())


def replay_files(job: Job, findings: Findings, *, ghost: str | Path | None = None) -> Replay:
    """Return the replay of a log: the page, to be written.

    Args:
        job: The robot, its one log, and how logs are read.
        findings: What to show beside it.
        ghost: A second log, of a designed or a simulated motion, to show as a ghost.

    Raises:
        DataError: If a log or a result cannot be used.
        ModelError: If the URDF cannot be used, or a result is of another robot.
        SettingsError: If a setting does not fit.
    """
    model = job.model()
    (entry,) = job.identification
    if findings.commanded:
        return _replay_commanded(job, findings.commanded, ghost)
    is_motion = not job.lay_out(entry, model, needs="motion")[0].has_torque
    motion = job.read(entry, model, needs="motion" if is_motion else "torque")
    robots = {label: stated_model(r, model) for label, r in findings.results.items()}
    bodies = {label: robot.carried_by for label, robot in robots.items()}
    ghosts = {}
    if ghost is not None:
        shadow = job.read(LogEntry(Path(ghost)), model, needs="motion")
        ghosts[Path(ghost).name] = (shadow.t, shadow.q)
    torques, marks, notes = None, _payloads(findings.track), [f"Motion: {entry.path.name}."]
    if is_motion:
        used, said = _limits_used(job, motion, model)
        marks, notes = [*marks, *used], [*notes, *said]
    else:
        torques = replace(_torques(job, motion, model, robots), noise=_noise(findings, model))
        marks += _contacts(torques, model)
    n = model.layout.n_inertial  # the result's drives may have terms that the job's have not
    masses = {"URDF": model.standard_parameters(), **bodies} if bodies else {}
    masses = {label: pi[:n] for label, pi in masses.items()}
    shown, q = model, motion.q
    base = None if ghosts else _base_poses(job, entry, motion)
    if base is not None:  # the same robot, whose first body is the trunk
        shown, q = _afloat(job, model), np.hstack([base, q])
        trunk = shown.standard_parameters()[:10]
        masses = {label: np.r_[trunk, pi] for label, pi in masses.items()}
    return replay(
        shown,
        motion.t,
        q,
        torques=torques,
        masses=masses or None,
        ghosts=ghosts,
        bands=None if findings.track is None else _bands(findings.track, findings.folder),
        marks=marks,
        notes=notes,
    )


def replay_identified(identification: Identification) -> Replay:
    """Return the replay of an identification: its last recording, kept apart if there is one.

    Args:
        identification: What was found.

    Returns:
        The page: measured and predicted torque, masses before and after.
    """
    shown = (*identification.fitted, *identification.validation)[-1]
    motion = shown.recording.trajectory
    predicted = _sure(shown.torques["estimate"], shown.recording.mask)
    return replay(
        identification.model,
        motion.t,
        motion.q,
        torques=Torques(
            motion.t, motion.tau, {"identified": predicted}, identification.estimate.sigma
        ),
        masses={"URDF": identification.prior, "identified": identification.standard},
        notes=[f"Motion: {shown.recording.name}."],
    )


def _replay_commanded(job: Job, results: Mapping[str, Result], ghost: str | Path | None) -> Replay:
    """Return the replay of a log of commands: measured, commanded and simulated robot.

    Poses are those of the URDF's joints, whose zero need not be the encoders'.
    """
    (entry,) = job.identification
    first = next(iter(results.values()))
    model, zero = first.robot, np.array([drive.zero for drive in first.commanded])
    log = log_of_commands(job, entry, first)
    q_ref = np.asarray(log.q_ref)
    simulated = {label: result.follow_commands(log) for label, result in results.items()}
    names = ["simulated"] if len(simulated) == 1 else [f"simulated: {x}" for x in simulated]
    shown = dict(zip(names, simulated.values(), strict=True)) | {"commanded": q_ref}
    ghosts = {label: _known(log.t, q + zero) for label, q in shown.items()}
    if ghost is not None:
        other = job.read(LogEntry(Path(ghost)), model, needs="motion")
        ghosts[Path(ghost).name] = (other.t, other.q + zero)
    error = np.sqrt(np.mean((q_ref - log.q) ** 2, axis=0))
    left = np.sqrt(np.nanmean((shown[names[0]] - log.q) ** 2, axis=0))
    worst = [f"{model.joints[j]} {1e3 * left[j]:.2g}" for j in np.argsort(-left).tolist()]
    return replay(
        model,
        log.t,
        log.q + zero,
        torques=Torques(log.t, log.q, shown, error, "position"),
        ghosts=ghosts,
        notes=[
            f"Motion: {entry.path.name}, as measured; ghosts on its commands.",
            f"Position missed in open loop, rms [mrad or mm]: {listed(worst, 3)}.",
        ],
    )


def _known(t: Array, q: Array) -> tuple[Array, Array]:
    """Return the rows that are numbers."""
    rows = np.isfinite(q).all(axis=1)
    return t[rows], q[rows]


def _afloat(job: Job, model: RobotModel) -> RobotModel:
    """Return a job's robot with a base that moves."""
    return RobotModel.from_urdf(
        job.urdf,
        joints=model.joints,
        locked=job.locked,
        free_flyer=True,
        mimic=job.mimic,
        snap_angles=job.snap_angles,
    )


def _base_poses(job: Job, entry: LogEntry, log: Log) -> Array | None:
    """Return where a floating base was, shape (N, 7) as x y z qx qy qz qw; None if unsaid."""
    table = open_table(entry.path, job.source)
    time = [name for name in ("time", "t") if name in table.names]
    if not time or not {*_BASE} <= {*table.names}:
        return None
    columns = table.read([time[0], *_BASE])
    pose = np.column_stack([columns[name] for name in _BASE])
    known = np.isfinite(pose).all(axis=1)
    length = np.linalg.norm(pose[:, 3:], axis=1)
    if not known.any() or np.abs(length[known] - 1.0).max() > 0.01:
        raise DataError(
            f"{entry.path.name}: {_BASE[3]} to {_BASE[6]} must be the four numbers of a turn, "
            "whose squares add up to 1; leave these columns out to hold the base fixed"
        )
    pose = pose[known]
    turns = (pose[1:, 3:] * pose[:-1, 3:]).sum(axis=1) < 0  # a turn has two quaternions
    pose[1:, 3:] *= np.where(np.cumsum(turns) % 2, -1.0, 1.0)[:, None]
    t = columns[time[0]][known]
    at = np.column_stack([np.interp(log.t, t, column) for column in pose.T])
    at[:, 3:] /= np.linalg.norm(at[:, 3:], axis=1, keepdims=True)
    return at


def _noise(findings: Findings, model: RobotModel) -> Array | None:
    """Return the residual's rms of each joint where the first result was identified."""
    for result in findings.results.values():
        fitted = result["identification"]["per_joint"]
        if all(fitted.get(joint, {}).get("rmse") for joint in model.joints):
            return np.array([fitted[joint]["rmse"] for joint in model.joints])
        break
    return None


def _track(path: Path) -> Mapping[str, Any] | None:
    """Return the content of a track.json; None if the file is another one."""
    content = read_json(path, "result")
    if not (isinstance(content, dict) and {"history", "changes"} <= set(content)):
        return None
    check_shape(content, _TRACK, path.name)
    return content


def _torques(job: Job, log: Log, model: RobotModel, robots: Mapping[str, RobotModel]) -> Torques:
    """Return measured torques, and those of robots loaded by their own parameters."""
    shown, motion = {}, None
    for label, robot in robots.items():
        rows = hold_log(robot, log, job.signals).whole
        motion = rows.trajectory
        shown[label] = _sure(predict(robot, [robot.carried_by], motion)[0], rows.mask)
    if motion is not None:
        shown["URDF"] = predict(model, [model.standard_parameters()], motion)[0]
    return Torques(log.t, log.tau) if motion is None else Torques(motion.t, motion.tau, shown)


def _sure(torque: Array, mask: Array) -> Array:
    """Return a prediction without the rows of joints at rest: friction has no sign."""
    return np.where(mask, torque, np.nan)


def _bands(track: Mapping[str, Any], folder: Path) -> Bands:
    table = open_table(folder / track["history"], LogSource())
    entries = track["base_parameters"]
    names = [entry["name"] for entry in entries]
    errors = [f"{name}.std_error" for name in names]
    wanted = ["time", *names, *errors]
    missing = [name for name in wanted if name not in table.names]
    if missing:
        raise DataError(f"{track['history']} has no column {missing[0]!r}; track the log again")
    columns = table.read(wanted)
    return Bands(
        t=columns["time"],
        names=names,
        units=[entry["unit"] for entry in entries],
        theta=np.column_stack([columns[name] for name in names]),
        std_error=np.column_stack([columns[name] for name in errors]),
    )


def _payloads(track: Mapping[str, Any] | None) -> list[Mark]:
    marks = []
    for change in [] if track is None else track["changes"]:
        load = change["payload"]
        label = f"payload {load['mass']:.2f} ± {load['std_error']:.2f} kg on {load['body']}"
        marks.append(Mark(change["onset"], label, "payload"))
    return marks


def _limits_used(job: Job, motion: Log, model: RobotModel) -> tuple[list[Mark], list[str]]:
    """Return marks where a motion uses the most of each limit and is nearest to a collision.

    Beside them what cannot be marked, and why: the URDF may state no limits, or have no shapes.
    """
    v = np.gradient(motion.q, motion.t, axis=0) if motion.v is None else motion.v
    a = np.gradient(v, motion.t, axis=0) if motion.a is None else motion.a
    torque = predict_instants(model, model.standard_parameters(), motion.q, v, a)
    marks, notes = [], ["It has no torques; the most that it uses of the URDF's limits is marked."]
    try:
        limits = MotionLimits.of_model(model, share=1.0)
    except SettingsError as error:
        return [], [f"It has no torques. Limits are not marked: {error}."]
    course = Course.of_motion(motion.t, (motion.q, v, a, torque), limits)
    for kind, used in zip(LIMITS, course.largest, strict=True):
        joint = int(np.argmax(used))
        if used[joint] > 0:
            name = model.joints[joint]
            label = f"{name} at {100 * used[joint]:.0f} % of its {kind} limit"
            marks.append(Mark(course.peak(kind, joint), label, "note", name))
    try:
        course = replace(course, clearance=Clearance(model))
    except DataError as error:
        return marks, [*notes, f"Collisions are not looked at: {error}."]
    if course.nearest is not None:
        near = course.nearest
        apart = f"are nearest, {1e3 * near.distance:.0f} mm"
        said = apart if near.distance > 0 else "overlap, as convex hulls"
        marks.append(Mark(near.time, f"{near.first} and {near.second} {said}"))
    return marks, notes


def _contacts(torques: Torques, model: RobotModel) -> list[Mark]:
    """Return marks where the first result does not explain the torque."""
    if not torques.predicted:
        return []
    predicted = next(iter(torques.predicted.values()))
    units = dict(zip(model.joints, model.row_units, strict=True))
    marks = []
    for found in find_unexplained(torques.t, torques.measured, predicted, model.joints):
        size = f"{found.residual:.2g} {units[found.joint]} on average"
        label = f"unexplained torque, most at {found.joint} ({size}, for "
        label += f"{found.end - found.start:.1f} s): contact or load?"
        marks.append(Mark(found.start, label, "contact", found.joint))
    return marks
