"""Online identification over a recorded log, sample by sample."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.identification.online.identifier import OnlineIdentifier
from robotid.identification.online.online_settings import OnlineSettings, Reading
from robotid.robot.model import RobotModel

Observer = Callable[[int, OnlineIdentifier], None]

_ROWS = 20.0  # rate of the rows of the history [Hz]


@dataclass(frozen=True, eq=False)
class Track:
    """The history of an online identification.

    Attributes:
        identifier: The identifier after the last sample.
        t: Times of the newest sample, shape (N,) [s].
        theta: Base parameters, shape (N, b).
        std_error: Their standard errors, shape (N, b).
        excitation: Reduction of the prior variance, shape (N,) [-].
        converged: Whether the estimate has converged, shape (N,), bool.
    """

    identifier: OnlineIdentifier
    t: Array
    theta: Array
    std_error: Array
    excitation: Array
    converged: Array

    def columns(self) -> dict[str, Array]:
        """Return the columns of the history, (N,) each: time, base parameters, standard errors."""
        table = {"time": self.t}
        for i, name in enumerate(self.identifier.names):
            table[name] = self.theta[:, i]
            table[f"{name}.std_error"] = self.std_error[:, i]
        return table | {"excitation": self.excitation, "converged": self.converged.astype(float)}


def track(
    model: RobotModel, log: Log, settings: OnlineSettings, *, observer: Observer | None = None
) -> Track:
    """Run an online identification over a log, sample by sample."""
    identifier = OnlineIdentifier(model, settings)
    times: list[float] = []
    readings: list[Reading] = []
    for k, t in enumerate(log.t.tolist()):
        identifier.update(t, log.q[k], log.tau[k])
        if observer is not None:
            observer(k, identifier)
        is_due = not times or t > times[-1] + 0.999 / _ROWS
        if identifier.is_ready and (is_due or k == len(log.t) - 1):
            times.append(t)
            readings.append(identifier.reading)
    if not readings:
        raise DataError(
            f"{log.path or 'log'}: the robot moves for less than the warm-up of "
            f"{settings.warmup:g} s, so there is no estimate. Use a longer log with motion"
        )
    keys = ("theta", "std_error", "excitation", "converged")
    history = {key: np.array([getattr(reading, key) for reading in readings]) for key in keys}
    return Track(identifier, np.array(times), **history)
