"""The job: which robot, which logs, which settings; read from TOML with every key checked."""

import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robotid.commands.job_keys import KEYS, check_keys
from robotid.exceptions import SettingsError
from robotid.identification.settings import EstimatorSettings
from robotid.logs.data import Log
from robotid.logs.read import LogLayout, lay_out, read_log
from robotid.logs.settings import LogSource, LogUnits, SignalSettings
from robotid.logs.table import Table
from robotid.robot.model import GRAVITY, RobotModel
from robotid.robot.parameters import DRIVE_TERMS, Coupling

__all__ = ["Job", "LogEntry", "job_from_settings", "read_job"]

_FRICTION = {
    "none": (),
    "viscous": ("viscous",),
    "viscous+coulomb": ("viscous", "coulomb"),
}
_NUMBER = (int, float)


@dataclass(frozen=True)
class LogEntry:
    """One log of a job.

    Attributes:
        path: The file.
        start: Start of the window in the log's own time [s], or None.
        end: End of the window [s], or None.
    """

    path: Path
    start: float | None = None
    end: float | None = None


@dataclass(frozen=True)
class Job:
    """Everything that is needed to run an identification.

    Attributes:
        urdf: The URDF file.
        joints: Joints to identify, in order; None for all movable ones.
        locked: Positions of joints held still [rad or m].
        gravity: Gravity in the root link's frame [m/s^2].
        free_flyer: Whether the base floats.
        mimic: "independent" or "coupled".
        signals: How logs become trajectories.
        terms: Drive terms to identify.
        gains: Torque per current of joints logged as current [N m/A or N/A].
        couplings: Drives that turn with several joints.
        columns: Column names in the logs that differ from the standard ones.
        source: Which topic of the logs, names of joints in them, meaning of effort.
        units: Units of the logs, if not SI.
        estimator: The estimator and its settings.
        dynamics: Whether the written URDF's ``<dynamics>`` also get the identified friction.
        identification: Logs to fit.
        validation: Logs kept apart.
        ignore: Codes of the doctor's errors that the user knows better.
        rows_in_memory: Rows of all logs together above which they are read in pieces.
        workers: Processes that work on the pieces; None for one per core where that is long.
    """

    urdf: Path
    joints: tuple[str, ...] | None = None
    locked: Mapping[str, float] = field(default_factory=dict)
    gravity: tuple[float, ...] = GRAVITY
    free_flyer: bool = False
    mimic: str = "independent"
    signals: SignalSettings = field(default_factory=SignalSettings)
    terms: tuple[str, ...] = DRIVE_TERMS
    gains: Mapping[str, float] = field(default_factory=dict)
    couplings: tuple[Coupling, ...] = ()
    columns: Mapping[str, str] = field(default_factory=dict)
    source: LogSource = field(default_factory=LogSource)
    units: LogUnits = field(default_factory=LogUnits)
    estimator: EstimatorSettings = field(default_factory=EstimatorSettings)
    dynamics: bool = False
    identification: tuple[LogEntry, ...] = ()
    validation: tuple[LogEntry, ...] = ()
    ignore: tuple[str, ...] = ()
    rows_in_memory: int = 2**17
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.rows_in_memory < 1:
            raise SettingsError(
                f"reduction: rows_in_memory is {self.rows_in_memory}, wanted a positive number"
            )
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"reduction: workers is {self.workers}, wanted at least 1")
        if self.free_flyer:
            raise SettingsError(
                "free_flyer is true, but no log format that robotid reads has the pose and motion "
                "of a floating base; fix the base (free_flyer = false), or build the rows from "
                "your own Trajectory with RobotModel.from_urdf(..., free_flyer=True)"
            )

    def model(self) -> RobotModel:
        """Return the robot.

        Returns:
            The model with the job's joints, gravity and drive terms.

        Raises:
            ModelError: If the URDF cannot be used, or a joint is not in it.
        """
        return RobotModel.from_urdf(
            self.urdf,
            joints=self.joints,
            locked=self.locked,
            free_flyer=self.free_flyer,
            mimic=self.mimic,
            gravity=self.gravity,
            terms=self.terms,
            couplings=self.couplings,
        )

    def read(self, entry: LogEntry, model: RobotModel) -> Log:
        """Return one log of the job.

        Args:
            entry: Which log.
            model: The job's robot.

        Returns:
            The log, of the model's joints in its order.

        Raises:
            DataError: If the file cannot be used.
        """
        return read_log(entry.path, start=entry.start, end=entry.end, **self._reading(model))

    def lay_out(self, entry: LogEntry, model: RobotModel) -> tuple[LogLayout, Table]:
        """Return which columns of a log's file are read, before any is.

        Args:
            entry: Which log.
            model: The job's robot.

        Returns:
            The layout and the opened file.

        Raises:
            DataError: If the file cannot be used.
        """
        return lay_out(entry.path, **self._reading(model))

    def _reading(self, model: RobotModel) -> dict[str, Any]:
        return {
            "joints": model.joints,
            "gains": self.gains,
            "columns": self.columns,
            "units": self.units,
            "prismatic": tuple(model.layout.prismatic),
            "source": self.source,
        }

    def to_settings(self) -> dict[str, Any]:
        """Return the job as plain values, in the shape of the job file, paths made absolute."""
        signals = {
            key: getattr(self.signals, key)
            for key in KEYS["signals"]
            if getattr(self.signals, key) is not None
        }
        if self.signals.cutoff is None:
            signals["cutoff"] = False
        friction = next(
            name
            for name, terms in _FRICTION.items()
            if terms == tuple(t for t in self.terms if t in ("viscous", "coulomb"))
        )
        return {
            "urdf": str(self.urdf.resolve()),
            **({"joints": list(self.joints)} if self.joints is not None else {}),
            "locked": dict(self.locked),
            "gravity": list(self.gravity),
            "free_flyer": self.free_flyer,
            "mimic": self.mimic,
            "signals": signals,
            "model": {
                "armature": "armature" in self.terms,
                "friction": friction,
                "offset": "offset" in self.terms,
            },
            "torque": {"gains": dict(self.gains)},
            "columns": dict(self.columns),
            "log": {
                **({"topic": self.source.topic} if self.source.topic is not None else {}),
                "joints": dict(self.source.joints),
                "effort": self.source.effort,
                "stamp": self.source.stamp,
            },
            "units": {
                key: value
                for key, value in (("time", self.units.time), ("angle", self.units.angle))
                if value is not None
            },
            "coupling": [{"name": c.name, "ratios": dict(c.ratios)} for c in self.couplings],
            "estimator": self.estimator.to_dict(),
            "output": {"dynamics": self.dynamics},
            "identification": [_entry_settings(entry) for entry in self.identification],
            "validation": [_entry_settings(entry) for entry in self.validation],
            "doctor": {"ignore": list(self.ignore)},
            "reduction": {
                "rows_in_memory": self.rows_in_memory,
                **({"workers": self.workers} if self.workers is not None else {}),
            },
        }


def read_job(path: str | Path) -> Job:
    """Read a job file.

    Args:
        path: The TOML file; paths in it are relative to it, and ``$NAME`` in them is filled in
            from the environment.

    Returns:
        The job.

    Raises:
        SettingsError: If the file is missing, is no TOML, or a key or a value is wrong.
    """
    source = Path(path)
    if not source.is_file():
        raise SettingsError(f"there is no job file {str(source)!r}")
    try:
        table = tomllib.loads(source.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{source.name} is not valid TOML: {error}") from error
    return job_from_settings(table, source.name, source.parent)


def job_from_settings(table: Mapping[str, Any], where: str, folder: Path) -> Job:
    """Return the job that a table describes.

    Args:
        table: The keys of a job file.
        where: Name of its source, for errors.
        folder: Folder that paths in it are relative to.

    Returns:
        The job.

    Raises:
        SettingsError: If a key or a value is wrong.
    """
    check_keys(table, KEYS, where)
    if "urdf" not in table:
        raise SettingsError(f"{where} has no key 'urdf'; name the robot's URDF file")
    model = table.get("model", {})
    friction = model.get("friction", "viscous+coulomb")
    if friction not in _FRICTION:
        raise SettingsError(f"{where}: friction is {friction!r}, wanted one of {list(_FRICTION)}")
    wanted = {
        "armature": model.get("armature", True),
        "offset": model.get("offset", True),
        **dict.fromkeys(_FRICTION[friction], True),
    }
    joints = table.get("joints")
    entries = {
        key: tuple(
            LogEntry(_path(entry["log"], where, folder), entry.get("start"), entry.get("end"))
            for entry in table.get(key, [])
        )
        for key in ("identification", "validation")
    }
    try:
        return Job(
            urdf=_path(table["urdf"], where, folder),
            joints=tuple(joints) if joints is not None else None,
            locked=_numbers(table.get("locked", {}), where, "locked"),
            gravity=tuple(table.get("gravity", GRAVITY)),
            free_flyer=table.get("free_flyer", False),
            mimic=table.get("mimic", "independent"),
            signals=_signals(table.get("signals", {})),
            terms=tuple(term for term in DRIVE_TERMS if wanted.get(term)),
            gains=_numbers(table.get("torque", {}).get("gains", {}), where, "gains"),
            couplings=tuple(
                Coupling(c["name"], tuple(_numbers(c["ratios"], where, "ratios").items()))
                for c in table.get("coupling", [])
            ),
            columns=table.get("columns", {}),
            source=LogSource(**table.get("log", {})),
            units=LogUnits(**table.get("units", {})),
            estimator=EstimatorSettings(**table.get("estimator", {})),
            dynamics=table.get("output", {}).get("dynamics", False),
            ignore=tuple(table.get("doctor", {}).get("ignore", ())),
            rows_in_memory=table.get("reduction", {}).get("rows_in_memory", 2**17),
            workers=table.get("reduction", {}).get("workers"),
            **entries,
        )
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error


def _path(text: str, where: str, folder: Path) -> Path:
    """Return a path relative to a folder, with $VARIABLES of the environment filled in."""
    expanded = os.path.expandvars(text)
    if "$" in expanded:
        raise SettingsError(f"{where}: path {text!r} names an environment variable that is not set")
    return folder / expanded


def _signals(table: Mapping[str, Any]) -> SignalSettings:
    settings = dict(table)
    if isinstance(settings.get("cutoff"), bool):
        if settings["cutoff"]:
            raise SettingsError("cutoff is true, wanted a frequency [Hz], or false for no filter")
        settings["cutoff"] = None
    return SignalSettings(**settings)


def _numbers(table: Mapping[str, Any], where: str, name: str) -> dict[str, float]:
    for key, value in table.items():
        if isinstance(value, bool) or not isinstance(value, _NUMBER):
            raise SettingsError(f"{where}: {name}.{key} is {value!r}, wanted a number")
    return {key: float(value) for key, value in table.items()}


def _entry_settings(entry: LogEntry) -> dict[str, Any]:
    window = {"start": entry.start, "end": entry.end}
    return {"log": str(entry.path.resolve()), **{k: v for k, v in window.items() if v is not None}}
