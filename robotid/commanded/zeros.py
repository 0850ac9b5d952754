"""Where encoders have their zeros, and which way they count: what gravity says of it.

A servo's position loop is held off its command by the torque of its load, q_ref - q = tau / kp +
friction. So the error of the loops, regressed on the URDF's torques, tells at which angles and in
which sense the URDF's joints stand where the encoders read what they do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal

from robotid._typing import Array
from robotid.logs.data import Log
from robotid.regressor.prediction import predict_instants
from robotid.robot.model import RobotModel

__all__ = ["Encoders", "find_encoders", "same_encoders"]

_ANGLES = np.deg2rad(np.arange(-180.0, 180.0, 15.0))  # zeros that are tried
_SAMPLES = 400  # of all logs together
_SWEEPS = 4  # over the joints, until none moves any more
_CUTOFF = 4.0  # [Hz] of the motion that is looked at
_GAIN = 0.05  # of the squared error: what a joint must gain to leave the URDF's zero
_SIGN_GAIN = 0.1  # ... and its sense


@dataclass(frozen=True, eq=False)
class Encoders:
    """How encoders stand to the URDF's joints, q_urdf = sign q + zero; arrays of shape (n,).

    Attributes:
        sign: 1, or -1 of an encoder that counts the other way.
        zero: Position of the URDF where the encoder reads 0 [rad or m].
        gain: Share of the loops' squared error that leaving the URDF's zero and sense explains.
    """

    sign: Array
    zero: Array
    gain: Array


def same_encoders(model: RobotModel) -> Encoders:
    """Return encoders with the URDF's zeros and senses.

    Args:
        model: The robot.
    """
    n = len(model.joints)
    return Encoders(np.ones(n), np.zeros(n), np.zeros(n))


def find_encoders(model: RobotModel, logs: Sequence[Log]) -> Encoders:
    """Find zeros and senses of encoders from how gravity holds loops off their commands.

    Args:
        model: The robot.
        logs: Logs with commands, of its joints in its order.
    """
    samples = [_smooth(log, max(_SAMPLES // len(logs), 50)) for log in logs]
    q, v, a, error = (np.concatenate(parts) for parts in zip(*samples, strict=True))
    turns = np.array([joint.type != "prismatic" for joint in model.limits])
    n = len(model.joints)
    sign, zero, gain = np.ones(n), np.zeros(n), np.zeros(n)
    cost = _cost(model, q, v, a, error, sign, zero)
    for _ in range(_SWEEPS):
        moved = False
        for j in np.flatnonzero(turns):
            trials = [(s, z) for s in (1.0, -1.0) for z in _ANGLES]
            best, found = cost, (sign[j], zero[j])
            for s, z in trials:
                trial_sign, trial_zero = sign.copy(), zero.copy()
                trial_sign[j], trial_zero[j] = s, z
                value = _cost(model, q, v, a, error, trial_sign, trial_zero)
                least = _SIGN_GAIN if s != sign[j] else _GAIN
                if value < best and value < cost + np.log1p(-least) * len(q):
                    best, found = value, (s, z)
            if best < cost:
                gain[j] += 1.0 - np.exp((best - cost) / len(q))
                (sign[j], zero[j]), cost, moved = found, best, True
        if not moved:
            break
    return Encoders(sign, zero, gain)


def _smooth(log: Log, count: int) -> tuple[Array, Array, Array, Array]:
    """Return position, speed, acceleration and error of the loop at some samples of a log."""
    dt = float(np.median(np.diff(log.t)))
    sos = scipy.signal.butter(2, min(_CUTOFF, 0.2 / dt), fs=1.0 / dt, output="sos")
    q = scipy.signal.sosfiltfilt(sos, log.q, axis=0)
    error = scipy.signal.sosfiltfilt(sos, log.q_ref - log.q, axis=0)
    v = np.gradient(q, dt, axis=0)
    a = np.gradient(v, dt, axis=0)
    rows = np.linspace(0, len(q) - 1, count).astype(int)
    return q[rows], v[rows], a[rows], error[rows]


def _cost(
    model: RobotModel, q: Array, v: Array, a: Array, error: Array, sign: Array, zero: Array
) -> float:
    """Return N times the log of what torques, friction and a constant leave of the loops' errors.

    A joint whose loop would give way to the load does not count the load.
    """
    at, rate, change = (sign * x for x in (q, v, a))
    torque = predict_instants(model, model.standard_parameters(), at + zero, rate, change)
    total = 0.0
    for j in range(q.shape[1]):
        e = sign[j] * error[:, j]
        plain = np.column_stack(
            [np.ones_like(e), rate[:, j], np.tanh(rate[:, j] / 0.02), change[:, j]]
        )
        columns = np.column_stack([torque[:, j], plain])
        x, left = _fit(columns, e)
        if x[0] < 0:
            _, left = _fit(plain, e)
        total += len(e) * float(np.log(max(left, 1e-300)))
    return total


def _fit(columns: Array, e: Array) -> tuple[Array, float]:
    x = np.linalg.lstsq(columns, e, rcond=None)[0]
    return x, float(np.sum((e - columns @ x) ** 2))
