"""Encoder zeros and signs relative to the URDF, identified from gravity.

The load causes a position error of a servo's loop, q_ref - q = tau / kp + friction. A regression of
the position errors on the URDF's torques therefore determines zero and sign of each encoder. It
uses the slow motion: in fast motion lags are larger than the effect of gravity, and friction, which
acts in both directions, averages to zero. The common sign of joints with parallel axes is not
identifiable: the position errors by gravity are the same with all signs reversed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.data.signals import zero_phase
from robotid.dynamics.compiled import flatten
from robotid.dynamics.prediction import predict_instants
from robotid.robot.model import RobotModel

#: Smallest relative increase of the squared error: by the URDF's zero and sign, for the best ones
#: to replace them; by the next best ones, for the best ones to be identified.
CLEAR = 0.2

#: Signs and zeros that are tried.
_TRIALS = np.array([(s, z) for s in (1.0, -1.0) for z in np.deg2rad(np.arange(-180, 180, 15))])
_SAMPLES = 400  # of all logs together
_PASSES = 4  # largest number of passes over the joints
_SLOW, _FAST = 0.4, 4.0  # cut-offs of the slow motion and of the sign of friction [Hz]
_PAD = 9  # rows by which the filter extends both ends
_PERIODS = 30  # smallest number of cut-off periods in all logs together
_RANGE = 0.4  # smallest range of a joint whose zero is identified [rad]
_SAME = 1.0 - 1e-6  # smallest cosine of parallel axes
_NEXT = np.deg2rad(15.5)  # zeros nearer to the best are not the next best [rad]
_STILL = 0.02  # speed over which friction reverses [rad/s or m/s]


@dataclass(frozen=True, eq=False)
class Encoders:
    """Encoder zeros and signs relative to the URDF, q_urdf = sign q + zero; arrays of shape (n,).

    Attributes:
        sign: 1, or -1 of an encoder with the opposite sign.
        zero: Position of the URDF where the encoder reads 0 [rad or m].
        gain: Reduction of the squared position error by a zero and sign other than the URDF's, as
            share of the error with those of the URDF at all joints [-].
        explained: Share of the joint's own squared position error that gravity explains [-].
        margin: Relative increase of the squared error by the next best zero or sign, outside the
            neighbourhood of the best [-]; 0 of prismatic joints and of joints that hardly move.
        next_sign, next_zero: The next best sign and zero.
    """

    sign: Array
    zero: Array
    gain: Array
    explained: Array
    margin: Array
    next_sign: Array
    next_zero: Array


def same_encoders(model: RobotModel) -> Encoders:
    """Return encoders with the URDF's zeros and signs."""
    n = len(model.joints)
    none = np.zeros(n)
    return Encoders(
        np.ones(n), none, none, explained=none, margin=none, next_sign=np.ones(n), next_zero=none
    )


def parallel_axes(model: RobotModel) -> list[tuple[str, ...]]:
    """Return the successive joints of each chain that have parallel axes."""
    tree = flatten(model)
    joined: dict[int, list[int]] = {}
    for body in range(len(tree.parents)):
        above, placement = int(tree.parents[body]), tree.joints[body]
        axis = placement[36:39]
        in_parent = (placement[:9] + placement[9:18]).reshape(3, 3).T @ axis  # constant there
        parallel = above >= 0 and abs(float(in_parent @ tree.joints[above][36:39])) > _SAME
        joined[body] = joined[above] if parallel else []
        joined[body].append(int(tree.leaders[body]))
    chains = {id(own): tuple(model.joints[j] for j in own) for own in joined.values()}
    return [own for own in chains.values() if len(own) > 1]


def find_encoders(model: RobotModel, logs: Sequence[Log]) -> Encoders:
    """Find zeros and signs of encoders from the position errors that gravity causes."""
    length = sum(float(log.t[-1] - log.t[0]) for log in logs)
    cutoff = min(max(_SLOW, _PERIODS / length), _FAST)
    samples = [_smooth(log, max(_SAMPLES // len(logs), 50), cutoff) for log in logs]
    motion = _Motion(*(np.concatenate(parts) for parts in zip(*samples, strict=True)))
    n = len(model.joints)
    revolute = np.flatnonzero(
        np.array([joint.type != "prismatic" for joint in model.limits])
        & (np.ptp(motion.q, axis=0) > _RANGE)
    )
    free = [*revolute]
    while True:
        sign, zero, gain, cost, costs = _descend(model, motion, revolute, free)
        margin, next_sign, next_zero = np.zeros(n), sign.copy(), zero.copy()
        for j in revolute:
            away = (_TRIALS[:, 0] != sign[j]) | (np.cos(_TRIALS[:, 1] - zero[j]) < np.cos(_NEXT))
            k = int(np.argmin(np.where(away, costs[j], np.inf)))
            margin[j] = np.expm1((costs[j, k] - cost) / len(motion.q))
            next_sign[j], next_zero[j] = _TRIALS[k]
        ambiguous = [j for j in free if gain[j] > 0 and margin[j] < CLEAR]
        if not ambiguous:
            break
        free = [j for j in free if j not in ambiguous]  # these have the URDF's values
    left, without = motion.left(model, sign, zero), motion.without
    return Encoders(sign, zero, gain, 1.0 - left / without, margin, next_sign, next_zero)


def _descend(
    model: RobotModel, motion: "_Motion", revolute: Array, free: Sequence[int]
) -> tuple[Array, Array, Array, float, Array]:
    """Return the best sign and zero of each free joint, the gain, and the costs.

    The last two are the least cost, and the cost of each trial of each revolute joint.
    """
    N, n = motion.q.shape
    sign, zero, gain = np.ones(n), np.zeros(n), np.zeros(n)
    first = cost = motion.cost(model, sign, zero)
    costs = np.full((n, len(_TRIALS)), np.inf)
    for _ in range(_PASSES):
        moved = False
        for j in revolute:
            for k, (s, z) in enumerate(_TRIALS):
                trial_sign, trial_zero = sign.copy(), zero.copy()
                trial_sign[j], trial_zero[j] = s, z
                costs[j, k] = motion.cost(model, trial_sign, trial_zero)
            k = int(np.argmin(costs[j]))
            if j in free and costs[j, k] < cost - np.log1p(CLEAR) * N:
                gain[j] += np.exp((cost - first) / N) - np.exp((costs[j, k] - first) / N)
                (sign[j], zero[j]), cost, moved = _TRIALS[k], float(costs[j, k]), True
        if not moved:
            break
    return sign, zero, gain, cost, costs


def _smooth(log: Log, count: int, cutoff: float) -> tuple[Array, ...]:
    """Return the slow motion at samples of a log: the arrays of ``_Motion``."""
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
    error: Array  # q_ref - q
    direction: Array  # of friction

    def cost(self, model: RobotModel, sign: Array, zero: Array) -> float:
        """Return N times the summed log of the squared residuals of the position errors."""
        left = np.maximum(self.left(model, sign, zero), 1e-300)
        return len(self.q) * float(np.log(left).sum())

    def left(self, model: RobotModel, sign: Array, zero: Array) -> Array:
        """Return the squared residual of each joint's errors, (n,).

        The torque is left out where its coefficient, the compliance of the loop, is negative.
        """
        q, v, a = (sign * x for x in (self.q, self.v, self.a))
        torque = predict_instants(model, model.standard_parameters(), q + zero, v, a)
        left = self.without.copy()
        for j, own in enumerate(sign):
            x, with_torque = _fit(
                np.column_stack([own * torque[:, j], self._plain(j)]), self.error[:, j]
            )
            if x[0] >= 0:
                left[j] = with_torque
        return left

    @cached_property
    def without(self) -> Array:
        """Squared residual of each joint's errors without its torque, (n,)."""
        joints = range(self.q.shape[1])
        return np.array([_fit(self._plain(j), self.error[:, j])[1] for j in joints])

    def _plain(self, j: int) -> Array:
        """Return the columns of a joint without its torque, (N, 4)."""
        return np.column_stack(
            [np.ones(len(self.q)), self.v[:, j], self.direction[:, j], self.a[:, j]]
        )


def _fit(columns: Array, e: Array) -> tuple[Array, float]:
    x = np.linalg.lstsq(columns, e, rcond=None)[0]
    return x, float(np.sum((e - columns @ x) ** 2))
