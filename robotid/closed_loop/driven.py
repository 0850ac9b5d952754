"""Robots that the torque of a log drives: what they hear, and what the linear half finds first.

Where the torque itself is logged, no command is needed to roll a robot out: the logged torque
drives it, open loop, from where the log was (output error of a plant in open loop). It drifts, for
nothing brings it back, so that windows are short and their starts are found.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.closed_loop.free_parameters import TorqueRows
from robotid.exceptions import DataError
from robotid.identification.pipeline import identify
from robotid.identification.result import Identification
from robotid.logs.data import Log
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import unwrap
from robotid.robot.model import RobotModel

__all__ = ["driven_log", "identified_rows", "torque_rows"]


def driven_log(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log whose fed-forward torque is the one that was measured.

    What is fed forward holds from one row to the next: there it is the mean of the two rows, so
    that it is not half a row late. The command is the measured position, which no gain multiplies.

    Args:
        model: The robot.
        log: The log, of its joints in its order.
        signals: How late its torque is.

    Raises:
        DataError: If the log has no torque, or a joint with limits jumps by a full turn.
    """
    if not log.has_torque:
        raise DataError(
            f"{log.name} has no torque, which drives the robot where [controller] has kind = "
            "'torque'; record columns tau_ of each joint, or set kind = 'pd' for a log of commands"
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
    """Return what the torques of logs tell by themselves, with the model's own friction.

    Args:
        model: The robot.
        logs: The logs, with torques.
        signals: How they become trajectories.
    """
    return identify(model, logs, signals=signals, friction="none", doctor=False)


def torque_rows(found: Identification, inflation: float = 1.0) -> TorqueRows:
    """Return what an identification's rows come down to.

    Their weight is that of rows as independent as the scatter of segments shows them to be.

    Args:
        found: The identification.
        inflation: By how much larger their variance counts beside.
    """
    weight = found.wls.sigma * np.sqrt(inflation * max(found.errors.inflation, 1.0))
    return TorqueRows(found.model, found.factors.weighted(weight), found.mapping.K)
