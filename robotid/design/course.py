"""A motion's use of the robot's limits over time, and its distances to collisions."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.design.clearance import Clearance, Contact
from robotid.design.design import Design, Designer
from robotid.design.limits import LIMITS, MotionLimits

_MOST = 1000  # samples at which distances are computed
_FEW = 20  # samples by which the changing distances are found ...
_STILL = 1e-4  # [m] ... those that change by more than this
_WITHIN = 0.02  # [m] distances that are computed first; then up to twice as far, and so on


@dataclass(frozen=True, eq=False)
class Course:
    """A motion at N samples, and its use of each limit."""

    t: Array  # times, shape (N,) [s]
    #: Position, velocity, acceleration, jerk, torque and power, shape (6, N, n), SI units.
    values: Array
    limits: MotionLimits  # the robot's limits
    clearance: Clearance | None = None  # the distances to collisions; None: they are not checked

    @classmethod
    def of_design(cls, designer: Designer, design: Design) -> "Course":
        """Return the course of a designed motion at the samples at which its limits were checked.

        The torque is the one that its design assumes.
        """
        t = np.linspace(0.0, design.duration, design.intervals + 1)
        q, v, a = design.motion.evaluate(t)
        torque = designer.information.torque(designer.information.rows(q, v, a))
        return cls.of_motion(t, (q, v, a, torque), designer.limits, designer.clearance)

    @classmethod
    def of_motion(
        cls,
        t: Array,
        motion: tuple[Array, Array, Array, Array],
        limits: MotionLimits,
        clearance: Clearance | None = None,
    ) -> "Course":
        """Return the course of a sampled motion; its jerk by finite differences.

        t (N,) [s], motion (N, n).
        """
        q, v, a, torque = motion
        jerk = np.gradient(a, t, axis=0)
        return cls(t, np.array([q, v, a, jerk, torque, torque * v]), limits, clearance)

    @cached_property
    def used(self) -> Array:
        """Used share of each limit, signed, shape (6, N, n); 0 where there is no limit."""
        return self.limits.used(*self.values[:5])

    @property
    def largest(self) -> Array:
        """Largest used share of each limit, by joint, shape (6, n)."""
        largest: Array = np.abs(self.used).max(axis=1)
        return largest

    def peak(self, kind: str, joint: int) -> float:
        """Return the time of a joint's largest use of a limit [s]."""
        return float(self.t[np.argmax(np.abs(self.used[LIMITS.index(kind), :, joint]))])

    @cached_property
    def thinned(self) -> "Course":
        """The same at no more than 1,000 samples, for the distances."""
        rows = slice(None, None, -(-len(self.t) // _MOST))
        return replace(self, t=self.t[rows], values=self.values[:, rows])

    def nearness(self, chosen: Array) -> tuple[Array, Array]:
        """Return the smallest distance at each sample, and its pair, shape (N,) each.

        chosen (pairs,).
        """
        distance, pairs = np.full(len(self.t), np.inf), np.zeros(len(self.t), dtype=int)
        left = np.arange(len(self.t) if chosen.any() else 0)
        within = _WITHIN
        while self.clearance is not None and len(left):
            placed = self.clearance.placed(self.values[0][left])
            near = self.clearance.near(placed, within, chosen).distance  # (pairs, left)
            least = near.min(axis=0)
            is_known = least < within
            distance[left[is_known]] = least[is_known]
            pairs[left[is_known]] = near.argmin(axis=0)[is_known]
            left, within = left[~is_known], 2 * within
        return distance, pairs

    def changes(self, clearance: Clearance) -> Array:
        """Return which pairs of a clearance change their distance in the motion, (pairs,), bool."""
        few = np.unique(np.linspace(0, len(self.t) - 1, _FEW).astype(int))
        placed = clearance.placed(self.values[0][few])
        change: Array = np.ptp(
            clearance.near(placed, np.inf, clearance.everything).distance, axis=1
        )
        return change > _STILL

    @cached_property
    def nearest(self) -> Contact | None:
        """The smallest margin of the changing distances; None if no distance changes."""
        if self.clearance is None:
            return None
        few, required = self.thinned, self.clearance.required
        changes, found = few.changes(self.clearance), []
        for own in np.unique(required[changes]).tolist():
            distance, pairs = few.nearness(changes & (required == own))
            k = int(np.argmin(distance))
            names = self.clearance.named[int(pairs[k])]
            found.append(Contact(*names, float(distance[k]), float(few.t[k]), own))
        return min(found, key=lambda contact: contact.margin, default=None)
