"""Identify a robot's inertial and drive parameters from a URDF and a motion log."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from robotid.base.exceptions import RobotIdError
    from robotid.base.versions import __version__
    from robotid.cli.compare import compare
    from robotid.cli.doctor import doctor
    from robotid.cli.excite import excite
    from robotid.cli.export import export
    from robotid.cli.identify import identify, save_result
    from robotid.cli.simulate import simulate
    from robotid.cli.validate import validate
    from robotid.data.files.read import read_log, write_log
    from robotid.data.log import Log, Trajectory
    from robotid.data.signal_settings import SignalSettings
    from robotid.design.previews import preview
    from robotid.diagnosis.urdf.inspection import inspect_urdf as inspect
    from robotid.estimation.fitting.estimator_settings import EstimatorSettings
    from robotid.identification.online import OnlineIdentifier
    from robotid.identification.payload_fit import identify_payload as payload
    from robotid.identification.result import Identification
    from robotid.output.files.result_file import load_result
    from robotid.output.viewer.replays import replay
    from robotid.robot.model import RobotModel

#: The public names, the verbs first: a verb is named as its command.
_PLACES = {
    "identify": "cli.identify.identify",
    "doctor": "cli.doctor.doctor",
    "inspect": "diagnosis.urdf.inspection.inspect_urdf",
    "excite": "cli.excite.excite",
    "preview": "design.previews.preview",
    "simulate": "cli.simulate.simulate",
    "payload": "identification.payload_fit.identify_payload",
    "validate": "cli.validate.validate",
    "compare": "cli.compare.compare",
    "replay": "output.viewer.replays.replay",
    "export": "cli.export.export",
    "load_result": "output.files.result_file.load_result",
    "save_result": "cli.identify.save_result",
    "read_log": "data.files.read.read_log",
    "write_log": "data.files.read.write_log",
    "RobotModel": "robot.model.RobotModel",
    "Log": "data.log.Log",
    "Trajectory": "data.log.Trajectory",
    "Identification": "identification.result.Identification",
    "OnlineIdentifier": "identification.online.OnlineIdentifier",
    "EstimatorSettings": "estimation.fitting.estimator_settings.EstimatorSettings",
    "SignalSettings": "data.signal_settings.SignalSettings",
    "RobotIdError": "base.exceptions.RobotIdError",
    "__version__": "base.versions.__version__",
}

__all__ = [  # noqa: RUF022 - the verbs first
    "identify", "doctor", "inspect", "excite", "preview", "simulate", "payload", "validate",
    "compare", "replay", "export", "load_result", "save_result", "read_log", "write_log",
    "RobotModel", "Log", "Trajectory", "Identification", "OnlineIdentifier", "EstimatorSettings",
    "SignalSettings", "RobotIdError", "__version__",
]  # fmt: skip


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name at its first use, because ``robotid --help`` needs none of them."""
    if name not in _PLACES:
        raise AttributeError(f"module 'robotid' has no attribute {name!r}")
    module, _, last = _PLACES[name].rpartition(".")
    return getattr(import_module(f"robotid.{module}"), last)


def __dir__() -> list[str]:
    """Return the public names only, for any loaded packages."""
    return __all__
