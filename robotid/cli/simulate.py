"""robotid simulate: simulate a log of a motion with a robot of known parameters."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file, file_sha256, write_json
from robotid.base.findings import listed
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.base.versions import __version__
from robotid.cli.console import echo, progress_of, show_found
from robotid.cli.job import (
    JOB,
    ROBOT,
    Flags,
    Job,
    LogEntry,
    add_shown,
    as_job,
    job_from_settings,
    read_job,
)
from robotid.data.files.read import check_suffix, write_log
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import SampledMotion
from robotid.dynamics.simulation.simulation_settings import Simulation, read_simulation
from robotid.dynamics.simulation.simulator import (
    Run,
    carried,
    delay,
    draw_parameters,
    follow,
    measure,
)
from robotid.output.files.result_file import SCHEMA_VERSION
from robotid.output.files.urdf import write_urdf
from robotid.robot.model import RobotModel

_HALF = 0.5  # of the commanded range: a joint that moves less does not follow


def simulate(
    robot: Job | str | Path,
    motion: str | Path,
    log: str | Path,
    settings: Simulation | None = None,
    *,
    urdf: str | Path | None = None,
    cutoff: float | None = None,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Simulate a robot that follows a motion; write its log and its true parameters.

    Args:
        robot: A URDF, all of whose joints move, or a job file.
        motion: The motion to follow: a table of time and positions.
        log: The log to write; the true parameters are in ``<log stem>.truth.json``.
        settings: Differences from the URDF, controller, actuators and sensors; none if None.
        urdf: File for the URDF of the true robot; none if None.
        cutoff: Cutoff frequency of the low-pass filter of a recorded motion [Hz]; None: no filter.
        progress: Called with the simulated seconds.

    Returns:
        The content of the file of the true parameters.

    Raises:
        DataError: If the motion or a file to write is not usable.
        ModelError: If the URDF is not usable.
        SettingsError: If a setting does not fit the robot or the motion.
    """
    settings, job, target = settings or Simulation(), as_job(robot), Path(log)
    truth = target.with_name(f"{target.stem}.truth.json")
    outputs = [path for path in (log, truth, urdf) if path]
    for path in outputs:
        check_file(Path(path), [motion, job.urdf])
    check_suffix(target)
    model = job.model()
    course = _motion(job, model, Path(motion), cutoff)
    duration = course.duration if settings.duration is None else settings.duration
    if duration > course.duration + 1e-9:
        raise SettingsError(
            f"duration is {duration:g} s, expected at most the {course.duration:g} s of the "
            "motion; reduce it, or give a longer motion"
        )
    rng = np.random.default_rng(settings.seed)
    pi = draw_parameters(model, settings.truth, rng)
    run = follow(
        model, pi, course, rate=settings.rate, duration=duration, settings=settings,
        progress=progress or ignore_progress,
    )  # fmt: skip
    measured = measure(run, settings.sensors, model.joints, rng, delay=delay(model, pi, settings))
    content = _truth(model, pi, settings, run, measured) | {
        "urdf": str(job.urdf),
        "motion": {"path": str(motion), "sha256": file_sha256(motion)},
        "outputs": [*map(str, outputs)],
    }
    if urdf:  # first: an impossible URDF is refused before any file is written
        write_urdf(model, pi, urdf, dynamics=True)
    write_log(measured, target)
    write_json(content | {"log_sha256": file_sha256(target)}, truth)
    return content


def _motion(job: Job, model: RobotModel, path: Path, cutoff: float | None) -> SampledMotion:
    """Return the motion of a table, filtered if it was recorded."""
    table = job.read(LogEntry(path), model, needs="motion")
    if cutoff is None:
        return SampledMotion(table.t, table.q, table.v, table.a)
    smooth = process(table, SignalSettings(cutoff=cutoff, velocity="differentiated", trim=0.0))
    return SampledMotion(smooth.t, smooth.q, smooth.v, smooth.a)


def _truth(
    model: RobotModel, pi: Array, settings: Simulation, run: Run, log: Log
) -> dict[str, Any]:
    """Return the true parameters and settings of the log, and the tracking errors."""
    layout, size, mapping = model.layout, model.layout.n_inertial, structural_mapping(model)
    base_units = [layout.units[i] for i in mapping.independent]

    def base(parameters: Array) -> list[dict[str, Any]]:
        return _rows(name=mapping.base_names, value=mapping.to_base(parameters), unit=base_units,
                     expression=mapping.expressions)  # fmt: skip

    prior = model.standard_parameters()[:size]
    error = run.q - run.reference
    bodies = _rows(name=layout.names[:size], value=pi[:size], unit=layout.units[:size], urdf=prior)
    drives = _rows(name=layout.names[size:], value=pi[size:], unit=layout.units[size:])
    following = _rows(
        joint=model.joints,
        rms=np.sqrt(np.mean(error**2, axis=0)), largest=np.abs(error).max(axis=0),
        range=np.ptp(run.q, axis=0), commanded=np.ptp(run.reference, axis=0),
        unit=["m" if joint in layout.prismatic else "rad" for joint in model.joints],
        at_limit=run.saturated,
    )  # fmt: skip
    content: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION, "robotid": __version__, "robot": model.name,
        "joints": list(model.joints), "settings": settings.to_dict(), "model": model.options,
        "samples": len(log.t), "duration": float(run.t[-1]), "standard_parameters": bodies,
        "drive_parameters": drives, "base_parameters": base(pi), "following": following,
    }  # fmt: skip
    if settings.payload.mass > 0:
        content["base_parameters_with_payload"] = base(carried(model, pi, settings.payload))
    return content


def _rows(**columns: Any) -> list[dict[str, Any]]:  # noqa: ANN401
    plain = [x.tolist() if isinstance(x, np.ndarray) else x for x in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*plain, strict=True)]


#: Flags of the keys of a plant's file.
_PLANT = Flags(
    Simulation(),
    {
        "--seed": ("seed", "N"),
        "--rate": ("rate", "HZ"),
        "--duration": ("duration", "S"),
        "--perturb": ("truth.inertials", "SIZE"),
        "--controller": ("controller.kind", "KIND"),
        "--torque-noise": ("sensors.noise.tau", "[JOINT=]SHARE"),
        "--limits": ("actuator.effort", "TIMES"),
        "--payload": ("payload.mass", "KG"),
    },
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("source", metavar="JOB.toml | URDF")
    add("motion", metavar="MOTION", help="table of time and q_<joint>, as a log or a design")
    words = "log to write; the true parameters are written next to it"
    add("--out", required=True, metavar="LOG", help=words)
    add("--urdf", metavar="FILE", help="file for the URDF of the true robot")
    words = "TOML file of the true robot, its controller, actuators, sensors and payload"
    add("--plant", metavar="FILE", help=words)
    words = "cutoff frequency of the low-pass filter of a recorded MOTION"
    add("--cutoff", type=float, metavar="HZ", help=words)
    add_shown(parser, "json")
    _PLANT.add(parser.add_argument_group("these take precedence over --plant"))
    JOB.add(parser.add_argument_group("the robot"), ROBOT)


def run(options: argparse.Namespace) -> None:
    job, settings = simulation_from_flags(options)
    with progress_of(options) as progress:
        content = simulate(
            job, options.motion, options.out, settings,
            urdf=options.urdf, cutoff=options.cutoff, progress=progress,
        )  # fmt: skip
    show_found(content, options, _show, content["outputs"])


def simulation_from_flags(options: argparse.Namespace) -> tuple[Job, Simulation]:
    settings, drives = read_simulation(options.plant, _PLANT.stated(options))
    for joint, entries in drives.items():
        if named := [entry for entry in entries if isinstance(entry, str)]:
            raise SettingsError(
                f"{options.plant}: drives.{joint} has {named[0]!r}, expected a term with its "
                "shape, as { term = 'Stribeck', speed = 0.1 }"
            )
    if Path(options.source).suffix == ".toml":
        if drives:
            raise SettingsError(f"{options.plant} has drives; set them in {options.source}")
        if given := [flag for flag in JOB.given(options) if flag in ROBOT]:
            raise SettingsError(f"{options.source} is a job file; set {listed(given)} in it")
        return read_job(options.source), settings
    if options.plant:  # errors of its drives then name this file
        job_from_settings({"urdf": options.source, "drives": drives}, options.plant, Path())
    table = {"urdf": options.source, "drives": drives, **JOB.stated(options, ROBOT)}
    return job_from_settings(table, "command line", Path()), settings


def _show(content: dict[str, Any]) -> None:
    print(
        f"{content['robot']}: {content['samples']} samples over {content['duration']:g} s, seed "
        f"{content['settings']['seed']}"
    )
    noise = content["settings"].get("sensors", {}).get("noise", {})
    if not any(noise.get(kind) for kind in ("tau", "torque")):
        echo(
            "the torques have no noise: a recorded log gives larger errors of parameters. Add "
            "noise with --torque-noise 0.02, a share of the torque"
        )
    width = max(map(len, ("position error", *content["joints"])))
    print(f"\n{'position error':{width}}  rms, largest")
    for joint in content["following"]:
        name, unit = joint["joint"], joint["unit"]
        print(f"{name:{width}}  {joint['rms']:.2g}, {joint['largest']:.2g} {unit}", end="")
        share = 100 * joint["at_limit"]
        print(f"; at the effort limit for {share:.2g} % of the time" if share > 0 else "")
        if joint["range"] < _HALF * joint["commanded"]:
            moves = f"moves {joint['range']:.2g} {unit}, expected {joint['commanded']:.2g} {unit}"
            values = f'[truth] values = {{ "{name}.coulomb" = 0 }}'
            echo(
                f"  warning: {name} {moves}. If its friction stops it, set it in the "
                f"file of --plant: {values}, or larger gains under [controller]", "  ", "warning",
            )  # fmt: skip
