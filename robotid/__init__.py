"""Identify a robot's inertial and drive parameters from a URDF and a motion log."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotid.commands.identify import run_job, save_result
    from robotid.commands.in_memory import identify
    from robotid.commands.job import read_job
    from robotid.doctor.diagnosis import check_logs
    from robotid.exceptions import RobotIdError
    from robotid.export.mjcf import write_mjcf
    from robotid.export.ranges import write_ranges
    from robotid.export.result import load_result
    from robotid.export.sdf import write_sdf
    from robotid.export.urdf import write_urdf
    from robotid.fitting.settings import EstimatorSettings
    from robotid.identification.payload_fit import identify_payload
    from robotid.identification.previews import preview
    from robotid.identification.result import Identification
    from robotid.log_files.read import read_log, write_log
    from robotid.logs.base import BaseColumns, BaseMotion
    from robotid.logs.data import Log, Trajectory
    from robotid.logs.settings import LogSource, LogUnits, SignalSettings
    from robotid.online.identifier import OnlineIdentifier
    from robotid.report.document import write_report
    from robotid.robot.constraints import Contact, Loop
    from robotid.robot.model import RobotModel
    from robotid.robot.parameters import Coupling
    from robotid.urdf_audit.inspection import inspect_urdf
    from robotid.versions import __version__
    from robotid.viewer.replays import replay

__all__ = [
    "BaseColumns",
    "BaseMotion",
    "Contact",
    "Coupling",
    "EstimatorSettings",
    "Identification",
    "Log",
    "LogSource",
    "LogUnits",
    "Loop",
    "OnlineIdentifier",
    "RobotIdError",
    "RobotModel",
    "SignalSettings",
    "Trajectory",
    "__version__",
    "check_logs",
    "identify",
    "identify_payload",
    "inspect_urdf",
    "load_result",
    "preview",
    "read_job",
    "read_log",
    "replay",
    "run_job",
    "save_result",
    "write_log",
    "write_mjcf",
    "write_ranges",
    "write_report",
    "write_sdf",
    "write_urdf",
]

_MODULES = {
    "commands.identify": ["run_job", "save_result"],
    "commands.in_memory": ["identify"],
    "commands.job": ["read_job"],
    "doctor.diagnosis": ["check_logs"],
    "urdf_audit.inspection": ["inspect_urdf"],
    "exceptions": ["RobotIdError"],
    "export.mjcf": ["write_mjcf"],
    "export.ranges": ["write_ranges"],
    "export.result": ["load_result"],
    "export.sdf": ["write_sdf"],
    "export.urdf": ["write_urdf"],
    "fitting.settings": ["EstimatorSettings"],
    "identification.payload_fit": ["identify_payload"],
    "identification.previews": ["preview"],
    "identification.result": ["Identification"],
    "logs.base": ["BaseColumns", "BaseMotion"],
    "logs.data": ["Log", "Trajectory"],
    "log_files.read": ["read_log", "write_log"],
    "logs.settings": ["LogSource", "LogUnits", "SignalSettings"],
    "online.identifier": ["OnlineIdentifier"],
    "report.document": ["write_report"],
    "robot.constraints": ["Contact", "Loop"],
    "robot.model": ["RobotModel"],
    "robot.parameters": ["Coupling"],
    "versions": ["__version__"],
    "viewer.replays": ["replay"],
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use, because ``robotid --help`` needs none of them."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"robotid.{module}"), name)
    raise AttributeError(f"module 'robotid' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the public names only, for any loaded packages."""
    return __all__
