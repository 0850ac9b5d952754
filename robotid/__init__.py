"""Identify a robot's inertial and drive parameters from a URDF and a motion log."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotid.base.exceptions import RobotIdError
    from robotid.base.versions import __version__
    from robotid.cli.identify import identify, run_job, save_result
    from robotid.cli.job import read_job
    from robotid.data.base_motion import BaseColumns, BaseMotion
    from robotid.data.files.read import read_log, write_log
    from robotid.data.log import Log, Trajectory
    from robotid.data.signal_settings import LogSource, LogUnits, SignalSettings
    from robotid.design.previews import preview
    from robotid.diagnosis.logs.check_logs import check_logs
    from robotid.diagnosis.urdf.inspection import inspect_urdf
    from robotid.estimation.fitting.estimator_settings import EstimatorSettings
    from robotid.identification.online.identifier import OnlineIdentifier
    from robotid.identification.payload_fit import identify_payload
    from robotid.identification.result import Identification
    from robotid.output.files.mjcf import write_mjcf
    from robotid.output.files.ranges import write_ranges
    from robotid.output.files.result_file import load_result
    from robotid.output.files.sdf import write_sdf
    from robotid.output.files.urdf import write_urdf
    from robotid.output.report.document import write_report
    from robotid.output.viewer.replays import replay
    from robotid.robot.constraints import Contact, Loop
    from robotid.robot.model import RobotModel
    from robotid.robot.parameters import Coupling

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
    "cli.identify": ["identify", "run_job", "save_result"],
    "cli.job": ["read_job"],
    "diagnosis.logs.check_logs": ["check_logs"],
    "diagnosis.urdf.inspection": ["inspect_urdf"],
    "base.exceptions": ["RobotIdError"],
    "output.files.mjcf": ["write_mjcf"],
    "output.files.ranges": ["write_ranges"],
    "output.files.result_file": ["load_result"],
    "output.files.sdf": ["write_sdf"],
    "output.files.urdf": ["write_urdf"],
    "estimation.fitting.estimator_settings": ["EstimatorSettings"],
    "identification.payload_fit": ["identify_payload"],
    "design.previews": ["preview"],
    "identification.result": ["Identification"],
    "data.base_motion": ["BaseColumns", "BaseMotion"],
    "data.log": ["Log", "Trajectory"],
    "data.files.read": ["read_log", "write_log"],
    "data.signal_settings": ["LogSource", "LogUnits", "SignalSettings"],
    "identification.online.identifier": ["OnlineIdentifier"],
    "output.report.document": ["write_report"],
    "robot.constraints": ["Contact", "Loop"],
    "robot.model": ["RobotModel"],
    "robot.parameters": ["Coupling"],
    "base.versions": ["__version__"],
    "output.viewer.replays": ["replay"],
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
