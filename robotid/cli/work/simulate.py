"""A simulated log of a motion, with a file of the true parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file, file_sha256, write_json
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.base.versions import __version__
from robotid.cli.work.job import Job, LogEntry
from robotid.data.files.read import write_log
from robotid.data.files.table_files import check_suffix
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import FloatingMotion, SampledMotion
from robotid.dynamics.simulation.sensors import Run, measure
from robotid.dynamics.simulation.simulation_settings import Simulation
from robotid.dynamics.simulation.simulator import carried, delay, follow
from robotid.dynamics.simulation.truth import draw_parameters
from robotid.output.files.urdf import write_urdf
from robotid.robot.model import RobotModel

_SCHEMA_VERSION = 1


@dataclass(frozen=True)
class SimulatedFiles:
    """The files that a simulation reads and writes.

    Attributes:
        motion: The motion to follow: a table of time and positions.
        log: The log to write; the true parameters are in ``<log stem>.truth.json``.
        urdf: File for the URDF of the true robot, or None.
        cutoff: Cutoff frequency of the low-pass filter of a recorded motion [Hz]; None: no filter.
    """

    motion: Path
    log: Path
    urdf: Path | None = None
    cutoff: float | None = None

    @property
    def truth(self) -> Path:
        """The file of the true parameters."""
        return self.log.with_name(f"{self.log.stem}.truth.json")


def simulate_log(
    job: Job,
    files: SimulatedFiles,
    settings: Simulation,
    *,
    progress: ProgressCallback | None = None,
) -> dict[str, Any]:
    """Simulate a robot that follows a motion; write its log and its true parameters.

    Args:
        job: The robot: its URDF, its joints and the terms of its drives.
        files: The files to read and write.
        settings: Differences from the URDF, controller, actuators and sensors.
        progress: Called with the simulated seconds.

    Returns:
        The content of the file of the true parameters.

    Raises:
        DataError: If a file is not usable, or the simulation diverges.
        ModelError: If the URDF is not usable.
        SettingsError: If a setting does not fit the robot or the motion.
    """
    for path in (files.log, files.truth, *([files.urdf] if files.urdf else [])):
        check_file(path, [files.motion, job.urdf])
    check_suffix(files.log)
    model = job.model()
    motion = _motion(job, model, files)
    duration = motion.duration if settings.duration is None else settings.duration
    if duration > motion.duration + 1e-9:
        raise SettingsError(
            f"duration is {duration:g} s, wanted at most the {motion.duration:g} s of the motion; "
            "reduce it, or give a longer motion"
        )
    rng = np.random.default_rng(settings.seed)
    pi = draw_parameters(model, settings.truth, rng)
    run = follow(
        model, pi, motion, rate=settings.rate, duration=duration, settings=settings,
        progress=progress or ignore_progress,
    )  # fmt: skip
    log = measure(run, settings.sensors, model.joints, rng, delay=delay(model, pi, settings))
    content = _truth(model, pi, settings, run, log) | {
        "urdf": str(job.urdf),
        "motion": {"path": str(files.motion), "sha256": file_sha256(files.motion)},
        "outputs": [str(path) for path in (files.log, files.truth, files.urdf) if path],
    }
    if files.urdf:  # an impossible URDF is refused before any file is written
        with TemporaryDirectory(prefix="robotid-") as folder:
            write_urdf(model, pi, Path(folder, files.urdf.name), dynamics=True)
    write_log(log, files.log)
    if files.urdf:
        write_urdf(model, pi, files.urdf, dynamics=True)
    write_json(content | {"log_sha256": file_sha256(files.log)}, files.truth)
    return content


def _motion(job: Job, model: RobotModel, files: SimulatedFiles) -> SampledMotion | FloatingMotion:
    table = job.read(LogEntry(files.motion), model, needs="motion")
    if table.base is not None:
        flags = [
            np.ones(len(table.t), dtype=bool) if x.always else table.contacts[x.frame]
            for x in model.contacts
        ]
        touching = np.reshape(flags, (len(flags), len(table.t))).T
        t, pose, q = table.t, table.base.pose, table.q
        if files.cutoff is not None:
            signals = SignalSettings(cutoff=files.cutoff, velocity="differentiated", trim=0.0)
            smooth = process(table, signals)
            t, pose, q = smooth.t, smooth.q[:, :7], smooth.q[:, 7:]
            touching = touching[np.clip(np.searchsorted(table.t, t), 0, len(table.t) - 1)]
        return FloatingMotion(t, pose, q, touching)
    if files.cutoff is None:
        return SampledMotion(table.t, table.q, table.v, table.a)
    smooth = process(
        table, SignalSettings(cutoff=files.cutoff, velocity="differentiated", trim=0.0)
    )
    return SampledMotion(smooth.t, smooth.q, smooth.v, smooth.a)


def _truth(
    model: RobotModel, pi: Array, settings: Simulation, run: Run, log: Log
) -> dict[str, Any]:
    """Return the true parameters and settings of the log, and the tracking errors."""
    layout, size = model.layout, model.layout.n_inertial
    urdf = model.standard_parameters()
    mapping = structural_mapping(model)
    units = [layout.units[i] for i in mapping.independent]

    def base(parameters: Array) -> list[dict[str, Any]]:
        entries = _entries(mapping.base_names, units, mapping.to_base(parameters))
        words = zip(entries, mapping.expressions, strict=True)
        return [entry | {"expression": expression} for entry, expression in words]

    loaded = carried(model, pi, settings.payload)
    standard = _entries(layout.names, layout.units, pi)
    for entry, value in zip(standard[:size], urdf.tolist(), strict=False):
        entry["urdf"] = value
    error = run.q - run.reference
    content: dict[str, Any] = {
        "schema_version": _SCHEMA_VERSION,
        "robotid": __version__,
        "robot": model.name,
        "joints": list(model.joints),
        "settings": settings.to_dict(),
        "model": model.options,
        "samples": len(log.t),
        "duration": float(run.t[-1]),
        "standard_parameters": standard[:size],
        "drive_parameters": standard[size:],
        "base_parameters": base(pi),
        "following": [
            {
                "joint": joint,
                "rms": rms,
                "largest": largest,
                "range": moved,
                "commanded": commanded,
                "unit": unit,
                "at_limit": share,
            }
            for joint, rms, largest, moved, commanded, unit, share in zip(
                model.joints,
                np.sqrt(np.mean(error**2, axis=0)).tolist(),
                np.abs(error).max(axis=0).tolist(),
                np.ptp(run.q, axis=0).tolist(),
                np.ptp(run.reference, axis=0).tolist(),
                ["m" if joint in layout.prismatic else "rad" for joint in model.joints],
                run.saturated.tolist(),
                strict=True,
            )
        ],
    }
    if settings.payload.mass > 0:
        content["base_parameters_with_payload"] = base(loaded)
    return content


def _entries(names: Sequence[str], units: Sequence[str], values: Array) -> list[dict[str, Any]]:
    return [
        {"name": name, "value": value, "unit": unit}
        for name, unit, value in zip(names, units, values.tolist(), strict=True)
    ]
