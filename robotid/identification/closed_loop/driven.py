"""Robots driven by the logged torque: their input, and their linear identification.

With a logged torque, a simulation needs no command: the torque drives the robot in open loop from
the measured state (output error of a plant in open loop). Without feedback the simulation drifts,
so that windows are short and their initial states are fitted.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import unwrap
from robotid.identification.closed_loop.free_parameters import TorqueRows
from robotid.identification.pipeline import identify
from robotid.identification.result import Identification
from robotid.robot.model import RobotModel


def driven_log(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log whose feed-forward torque is the measured one.

    The feed-forward torque is constant between two rows: the mean of the two, which avoids a delay
    of half a row. The command is the measured position; its gain is 0.
    """
    if not log.has_torque:
        raise DataError(
            f"{log.name} has no torque, which [controller] kind = 'torque' needs as the input. "
            "Record columns tau_ of each joint, or set kind = 'pd' for a log of commands"
        )
    free = np.array([joint.turns_freely for joint in model.limits])
    log = unwrap(log, free)
    measured = np.column_stack(
        [np.interp(log.t + signals.torque_delay, log.t, own) for own in log.tau.T]
    )
    tau = np.vstack([0.5 * (measured[1:] + measured[:-1]), measured[-1:]])
    return replace(log, q_ref=log.q, v_ref=None, tau_ref=tau)


def identified_rows(
    model: RobotModel, logs: Sequence[Log], signals: SignalSettings | None
) -> Identification:
    """Return the identification from the torques of logs alone, with the model's friction terms."""
    return identify(model, logs, signals=signals, friction="none", doctor=False)


def torque_rows(found: Identification, inflation: float = 1.0) -> TorqueRows:
    """Return an identification's rows reduced to a triangular factor.

    The weights include the variance inflation by correlated rows, from the scatter of segments.
    """
    weight = found.wls.sigma * np.sqrt(inflation * max(found.errors.inflation, 1.0))
    return TorqueRows(found.model, found.factors.weighted(weight), found.mapping.K)
