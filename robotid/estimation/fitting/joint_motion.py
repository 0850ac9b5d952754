"""The motion of a joint along recordings: the arguments of its drive terms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.drive_columns import friction_directions
from robotid.estimation.fitting.evaluation import Recording
from robotid.robot.drives import DriveMotion
from robotid.robot.model import RobotModel


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Motion and load of a joint in N rows of the fitted recordings.

    Attributes:
        q: Positions, shape (N,) [rad or m].
        v: Speeds, shape (N,) [rad/s or m/s].
        a: Accelerations, shape (N,) [rad/s^2 or m/s^2].
        direction: Direction of friction: the sign of v, filtered as the torque, shape (N,) [-].
        load: Torque of the rigid bodies by the estimate, shape (N,) [N m or N].
        travelled: Distance since the last change of sign of v, shape (N,) [rad or m].
        time: Time since the start of the recording, over the longest duration, shape (N,) [-].
        passes: Cut-off frequency of the torque filter [Hz]; infinite without a filter.
        longest: The longest duration of a recording [s].
        others: Motion of the joints before and after it, by name.
        scale: Motion whose typical speeds, distances and loads scale columns; None: this one.
    """

    q: Array
    v: Array
    a: Array
    direction: Array
    load: Array
    travelled: Array
    time: Array
    passes: float = np.inf
    longest: float = 1.0
    others: dict[str, "JointMotion"] = field(default_factory=dict)
    scale: "JointMotion | None" = None

    @classmethod
    def steady(cls, motion: DriveMotion) -> "JointMotion":
        """Return the motion of a joint after long motion at constant speed, the others at rest.

        motion (N,).
        """
        none, far = np.zeros_like(motion.v), np.full_like(motion.v, np.inf)
        m = motion
        return cls(m.q, m.v, m.a, m.direction, m.load, travelled=far, time=none)

    def at(self, rows: slice) -> "JointMotion":
        """Return the motion in some of the rows, without the other joints."""
        q, v, a, direction, load = (
            x[rows] for x in (self.q, self.v, self.a, self.direction, self.load)
        )
        travelled, time = self.travelled[rows], self.time[rows]
        return JointMotion(q, v, a, direction, load, travelled, time, self.passes, self.longest)


def joint_motions(
    recordings: Sequence[Recording], rows: Sequence[Array], load: Array, model: RobotModel
) -> tuple[JointMotion, ...]:
    """Return the motion of each joint and its neighbours in some rows of recordings.

    load (N, n) [N m or N].
    """
    motions = [recording.trajectory for recording in recordings]
    passes = max(recording.signals.cutoff or np.inf for recording in recordings)
    longest = max(float(np.ptp(m.t)) for m in motions)

    def joined(of: Callable[[Trajectory], Array]) -> Array:
        return np.concatenate([of(m)[k] for m, k in zip(motions, rows, strict=True)])

    n = len(model.joints)  # the pose and twist of a floating base come before them
    q, v, a = (x[:, x.shape[1] - n :] for x in (joined(attrgetter(name)) for name in "qva"))
    signs = joined(partial(_directions, model))
    distance = joined(travelled)
    time = joined(lambda m: (m.t - m.t[0]) / (longest or 1.0))
    columns = zip(q.T, v.T, a.T, signs.T, load.T, distance.T, strict=True)
    alone = [
        JointMotion(q_j, v_j, a_j, sign, load_j, far, time, passes, longest or 1.0)
        for q_j, v_j, a_j, sign, load_j, far in columns
    ]
    neighbours = [[k for k in (j - 1, j + 1) if 0 <= k < len(alone)] for j in range(len(alone))]
    return tuple(
        replace(motion, others={model.joints[k]: alone[k] for k in near})
        for motion, near in zip(alone, neighbours, strict=True)
    )


def _directions(model: RobotModel, motion: Trajectory) -> Array:
    """Return the direction of the friction of each joint's own drive, shape (N, n)."""
    signs = friction_directions(model.layout, motion.v, motion.direction)[:, : len(model.joints)]
    v = motion.v[:, motion.v.shape[1] - len(model.joints) :]
    return signs if signs.shape[1] else np.sign(v)


def travelled(motion: Trajectory) -> Array:
    """Return the distance of each joint since its last reversal, shape (N, n) [rad or m]."""
    is_first = np.diff(motion.segment, prepend=motion.segment[0] - 1) != 0
    n = len(motion.joints)
    q, v = (x[:, x.shape[1] - n :] for x in (motion.q, motion.v))
    reverses = (np.diff(np.sign(v), axis=0, prepend=0.0) != 0) | is_first[:, None]
    last = np.maximum.accumulate(np.where(reverses, np.arange(len(reverses))[:, None], 0), axis=0)
    distance: Array = np.abs(q - np.take_along_axis(q, last, axis=0))
    return distance
