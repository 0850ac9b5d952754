"""Identify a robot's inertial and drive parameters from a URDF and a motion log."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotid.base_parameters import BaseMapping
    from robotid.data import Log, Trajectory
    from robotid.estimators import OLS, WLS, Consistent, Estimate, Estimator
    from robotid.exceptions import DataError, ModelError, RobotIdError
    from robotid.identification import EstimatorSettings, Identification, identify
    from robotid.job import read_job
    from robotid.log_files import read_log, write_log
    from robotid.log_source import LogSource
    from robotid.model import RobotModel
    from robotid.parameters import Coupling
    from robotid.replay_job import replay_identified
    from robotid.report import write_report
    from robotid.signals import SignalSettings
    from robotid.units import LogUnits
    from robotid.urdf import write_urdf
    from robotid.visualization import replay

__version__ = "0.1.0"

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
    "base_parameters": ["BaseMapping"],
    "data": ["Log", "Trajectory"],
    "estimators": ["OLS", "WLS", "Consistent", "Estimate", "Estimator"],
    "exceptions": ["DataError", "ModelError", "RobotIdError"],
    "identification": ["EstimatorSettings", "Identification", "identify"],
    "job": ["read_job"],
    "log_files": ["read_log", "write_log"],
    "log_source": ["LogSource"],
    "model": ["RobotModel"],
    "parameters": ["Coupling"],
    "replay_job": ["replay_identified"],
    "report": ["write_report"],
    "signals": ["SignalSettings"],
    "units": ["LogUnits"],
    "urdf": ["write_urdf"],
    "visualization": ["replay"],
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name when it is first used: ``robotid --help`` needs none of them."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"robotid.{home}"), name)
    raise AttributeError(f"module 'robotid' has no attribute {name!r}")
