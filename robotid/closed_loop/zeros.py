"""Where encoders have their zeros, and which way they count: what gravity says of it.

A servo's position loop is held off its command by the torque of its load, q_ref - q = tau / kp +
friction. So the error of the loops, regressed on the URDF's torques, tells at which angles and in
which sense the URDF's joints stand where the encoders read what they do. What is slow tells it: in
fast motion lags outweigh gravity, and friction, on either side in turn, has a mean of none.
Joints with parallel axes cannot be told from their mirror image: gravity holds both off alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.logs.data import Log
from robotid.logs.filters import zero_phase
from robotid.regressor.compiled import flatten
from robotid.regressor.prediction import predict_instants
from robotid.robot.model import RobotModel

__all__ = ["CLEAR", "Encoders", "find_encoders", "parallel_axes", "same_encoders"]

#: Squared error that another zero or sense must leave, over the best's, less 1: the URDF's for the
#: best to be taken, the next best for it to be known.
CLEAR = 0.2

#: Senses and zeros that are tried.
_TRIALS = np.array([(s, z) for s in (1.0, -1.0) for z in np.deg2rad(np.arange(-180, 180, 15))])
_SAMPLES = 400  # of all logs together
_SWEEPS = 4  # over the joints, until none moves any more
_SLOW, _FAST = 0.4, 4.0  # [Hz] of the motion that is looked at, and of its friction's sense
_PAD = 9  # rows by which both ends are continued
_PERIODS = 30  # of the slowest motion that all logs together should have
_RANGE = 0.4  # [rad] of slow motion that shows how a torque turns; over less it is a straight line
_SAME = 1.0 - 1e-6  # cosine of axes that are parallel
_NEXT = np.deg2rad(15.5)  # of the best, within which a zero is no other
_STILL = 0.02  # [rad/s or m/s] over which friction turns


@dataclass(frozen=True, eq=False)
class Encoders:
    """How encoders stand to the URDF's joints, q_urdf = sign q + zero; arrays of shape (n,).

    Attributes:
        sign: 1, or -1 of an encoder that counts the other way.
        zero: Position of the URDF where the encoder reads 0 [rad or m].
        gain: Share of the loops' squared error that leaving the URDF's zero and sense explains.
        explained: Share of the joint's own squared error that gravity explains.
        margin: Squared error of the next best zero or sense, beyond the best's neighbours, over
            that of the best, less 1; 0 of a prismatic joint, or hardly moves.
        next_sign, next_zero: That next best.
    """

    sign: Array
    zero: Array
    gain: Array
    explained: Array
    margin: Array
    next_sign: Array
    next_zero: Array


def same_encoders(model: RobotModel) -> Encoders:
    """Return encoders with the URDF's zeros and senses.

    Args:
        model: The robot.
    """
    n = len(model.joints)
    none = np.zeros(n)
    return Encoders(
        np.ones(n), none, none, explained=none, margin=none, next_sign=np.ones(n), next_zero=none
    )


def parallel_axes(model: RobotModel) -> list[tuple[str, ...]]:
    """Return the joints of each chain that turn about parallel axes, one after the other.

    Args:
        model: The robot.
    """
    tree = flatten(model)
    joined: dict[int, list[int]] = {}
    for body in range(len(tree.parents)):
        above, placement = int(tree.parents[body]), tree.joints[body]
        turn = placement[36:39]
        in_parent = (placement[:9] + placement[9:18]).reshape(3, 3).T @ turn  # it stays there
        parallel = above >= 0 and abs(float(in_parent @ tree.joints[above][36:39])) > _SAME
        joined[body] = joined[above] if parallel else []
        joined[body].append(int(tree.leaders[body]))
    chains = {id(own): tuple(model.joints[j] for j in own) for own in joined.values()}
    return [own for own in chains.values() if len(own) > 1]


def find_encoders(model: RobotModel, logs: Sequence[Log]) -> Encoders:
    """Find zeros and senses of encoders from how gravity holds loops off their commands.

    Args:
        model: The robot.
        logs: Logs with commands, of its joints in its order.
    """
    length = sum(float(log.t[-1] - log.t[0]) for log in logs)
    cutoff = min(max(_SLOW, _PERIODS / length), _FAST)
    samples = [_smooth(log, max(_SAMPLES // len(logs), 50), cutoff) for log in logs]
    motion = _Motion(*(np.concatenate(parts) for parts in zip(*samples, strict=True)))
    n = len(model.joints)
    turns = np.flatnonzero(
        np.array([joint.type != "prismatic" for joint in model.limits])
        & (np.ptp(motion.q, axis=0) > _RANGE)
    )
    free = [*turns]
    while True:
        sign, zero, gain, cost, costs = _descend(model, motion, turns, free)
        margin, next_sign, next_zero = np.zeros(n), sign.copy(), zero.copy()
        for j in turns:
            away = (_TRIALS[:, 0] != sign[j]) | (np.cos(_TRIALS[:, 1] - zero[j]) < np.cos(_NEXT))
            k = int(np.argmin(np.where(away, costs[j], np.inf)))
            margin[j] = np.expm1((costs[j, k] - cost) / len(motion.q))
            next_sign[j], next_zero[j] = _TRIALS[k]
        open_ = [j for j in free if gain[j] > 0 and margin[j] < CLEAR]
        if not open_:
            break
        free = [j for j in free if j not in open_]  # what others do as well stays the URDF's
    left, without = motion.left(model, sign, zero)
    return Encoders(sign, zero, gain, 1.0 - left / without, margin, next_sign, next_zero)


def _descend(
    model: RobotModel, motion: "_Motion", turns: Array, free: Sequence[int]
) -> tuple[Array, Array, Array, float, Array]:
    """Return sign, zero and gain of the best zeros of joints that are free, and the costs.

    The last two are the cost, and that of each trial of each revolute joint.
    """
    N, n = motion.q.shape
    sign, zero, gain = np.ones(n), np.zeros(n), np.zeros(n)
    cost, costs = motion.cost(model, sign, zero), np.full((n, len(_TRIALS)), np.inf)
    for _ in range(_SWEEPS):
        moved = False
        for j in turns:
            for k, (s, z) in enumerate(_TRIALS):
                trial_sign, trial_zero = sign.copy(), zero.copy()
                trial_sign[j], trial_zero[j] = s, z
                costs[j, k] = motion.cost(model, trial_sign, trial_zero)
            k = int(np.argmin(costs[j]))
            if j in free and costs[j, k] < cost - np.log1p(CLEAR) * N:
                gain[j] += 1.0 - np.exp((costs[j, k] - cost) / N)
                (sign[j], zero[j]), cost, moved = _TRIALS[k], float(costs[j, k]), True
        if not moved:
            break
    return sign, zero, gain, cost, costs


def _smooth(log: Log, count: int, cutoff: float) -> tuple[Array, ...]:
    """Return the slow motion at some samples of a log: the arrays of ``_Motion``."""
    dt = float(np.median(np.diff(log.t)))

    def low_pass(x: Array, below: float) -> Array:
        return zero_phase(x, 2, min(below, 0.2 / dt), 1.0 / dt, _PAD)

    v = np.gradient(low_pass(log.q, _FAST), dt, axis=0)
    smooth = [
        low_pass(x, cutoff)
        for x in (log.q, v, np.gradient(v, dt, axis=0), log.q_ref - log.q, np.tanh(v / _STILL))
    ]
    rows = np.linspace(0, len(log.t) - 1, count).astype(int)
    return tuple(x[rows] for x in smooth)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Slow motion at N instants; arrays of shape (N, n)."""

    q: Array
    v: Array
    a: Array
    error: Array  # of the loops
    sense: Array  # of friction

    def cost(self, model: RobotModel, sign: Array, zero: Array) -> float:
        """Return N times the log of what torques, friction and a constant leave of the errors."""
        left = np.maximum(self.left(model, sign, zero)[0], 1e-300)
        return len(self.q) * float(np.log(left).sum())

    def left(self, model: RobotModel, sign: Array, zero: Array) -> tuple[Array, Array]:
        """Return the squares left of each joint's errors, with its torque and without, (n,).

        A joint whose loop would give way to the load does not count the load.
        """
        q, v, a = (sign * x for x in (self.q, self.v, self.a))
        torque = predict_instants(model, model.standard_parameters(), q + zero, v, a)
        left, without = np.empty((2, len(sign)))
        for j, own in enumerate(sign):
            plain = np.column_stack([np.ones(len(q)), self.v[:, j], self.sense[:, j], self.a[:, j]])
            _, without[j] = _fit(plain, self.error[:, j])
            x, left[j] = _fit(np.column_stack([own * torque[:, j], plain]), self.error[:, j])
            if x[0] < 0:
                left[j] = without[j]
        return left, without


def _fit(columns: Array, e: Array) -> tuple[Array, float]:
    x = np.linalg.lstsq(columns, e, rcond=None)[0]
    return x, float(np.sum((e - columns @ x) ** 2))
