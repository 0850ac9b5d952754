"""The errors of the package; each has its data as attributes and states the remedy."""

from collections.abc import Sequence
from typing import Any


class RobotIdError(Exception):
    """Base class of all errors of robotid; they can be sent between processes."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).__new__, (type(self), *self.args), vars(self)  # not by its __init__


class ModelError(RobotIdError, ValueError):
    """The URDF, or the model built from it, is not usable for the request."""


class DataError(RobotIdError, ValueError):
    """A log or an array lacks required data or has invalid data."""

    def __init__(self, message: str, code: str = "unusable_log") -> None:
        self.code = code  # a fixed word for the fault
        super().__init__(message)


class SettingsError(RobotIdError, ValueError):
    """A setting is unknown, of the wrong type or out of its range."""


class RankDeficientError(RobotIdError):
    """The data do not determine every parameter."""

    def __init__(self, rank: int, undetermined: Sequence[str], total: int, words: str = "") -> None:
        self.rank = rank  # number of parameters that the data determine
        self.undetermined = tuple(undetermined)  # names of the others
        self.total = total  # number of parameters
        super().__init__(
            f"the data excite {rank} of {total} base parameters; undetermined: "
            f"{', '.join(self.undetermined)}{f' ({words})' if words else ''}. Record a motion with "
            "more excitation, or use the estimator 'consistent', which keeps the URDF's values"
        )


class NotConvergedError(RobotIdError):
    """An iteration or a solver stopped without a solution."""

    def __init__(self, message: str, status: str) -> None:
        self.status = status  # of the solver
        super().__init__(f"{message} (status: {status})")


class WorkerError(RobotIdError):
    """A worker process or a cluster failed."""


class MissingDependencyError(RobotIdError, ImportError):
    """An optional package is not installed."""

    def __init__(self, purpose: str, package: str, extra: str) -> None:
        self.package = package  # that is missing
        super().__init__(
            f"{purpose} needs {package}, which is not installed: pip install '.[{extra}]' in a "
            f"checkout of robotid, or pip install 'robotid[{extra}]' where an index has it"
        )
