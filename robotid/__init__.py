"""Identify a robot's inertial and drive parameters from a URDF and a motion log."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotid.commands.job import read_job
    from robotid.commands.replay import replay_identified
    from robotid.estimators import OLS, WLS, Consistent, Estimate, Estimator
    from robotid.exceptions import DataError, ModelError, RobotIdError
    from robotid.export.urdf import write_urdf
    from robotid.identification.pipeline import EstimatorSettings, Identification, identify
    from robotid.logs.data import Log, Trajectory
    from robotid.logs.read import read_log, write_log
    from robotid.logs.settings import LogSource, LogUnits, SignalSettings
    from robotid.regressor.base_parameters import BaseMapping
    from robotid.report.document import write_report
    from robotid.robot.model import RobotModel
    from robotid.robot.parameters import Coupling
    from robotid.versions import __version__
    from robotid.viewer.replays import replay

__all__ = [
    "OLS",
    "WLS",
    "BaseMapping",
    "Consistent",
    "Coupling",
    "DataError",
    "Estimate",
    "Estimator",
    "EstimatorSettings",
    "Identification",
    "Log",
    "LogSource",
    "LogUnits",
    "ModelError",
    "RobotIdError",
    "RobotModel",
    "SignalSettings",
    "Trajectory",
    "__version__",
    "identify",
    "read_job",
    "read_log",
    "replay",
    "replay_identified",
    "write_log",
    "write_report",
    "write_urdf",
]

_HOMES = {
    "regressor.base_parameters": ["BaseMapping"],
    "logs.data": ["Log", "Trajectory"],
    "estimators": ["OLS", "WLS", "Consistent", "Estimate", "Estimator"],
    "exceptions": ["DataError", "ModelError", "RobotIdError"],
    "identification.pipeline": ["EstimatorSettings", "Identification", "identify"],
    "commands.job": ["read_job"],
    "logs.read": ["read_log", "write_log"],
    "logs.table": ["LogSource"],
    "robot.model": ["RobotModel"],
    "robot.parameters": ["Coupling"],
    "commands.replay": ["replay_identified"],
    "report.document": ["write_report"],
    "logs.signals": ["SignalSettings"],
    "logs.units": ["LogUnits"],
    "export.urdf": ["write_urdf"],
    "versions": ["__version__"],
    "viewer.replays": ["replay"],
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name when it is first used: ``robotid --help`` needs none of them."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"robotid.{home}"), name)
    raise AttributeError(f"module 'robotid' has no attribute {name!r}")
