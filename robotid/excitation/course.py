"""How a motion uses a robot's limits over time, and how near it comes to a collision."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid._typing import Array
from robotid.excitation.clearance import Clearance, Contact
from robotid.excitation.design import Design, Designer
from robotid.excitation.limits import LIMITS, MotionLimits

__all__ = ["Course"]

_MOST = 1000  # at which distances are looked at
_LOOKED_AT = 20  # instants that say which distances change ...
_STILL = 1e-4  # [m] ... by more than this
_WITHIN = 0.02  # [m] distances that are looked at first; then twice as far, and so on


@dataclass(frozen=True, eq=False)
class Course:
    """A motion at N instants, and what it uses of each limit.

    Attributes:
        t: Times, shape (N,) [s].
        values: Position, velocity, acceleration, jerk, torque and power, shape (6, N, n), SI units.
        limits: What the robot may do.
        clearance: What keeps it from collisions; None: they are not looked at.
    """

    t: Array
    values: Array
    limits: MotionLimits
    clearance: Clearance | None = None

    @classmethod
    def of_design(cls, designer: Designer, design: Design) -> "Course":
        """Return the course of a designed motion at the instants at which its limits were checked.

        The torque is the one that its design assumes.

        Args:
            designer: What it was designed for.
            design: The motion.
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
        """Return the course of a motion that is known at some instants; its jerk by differences.

        Args:
            t: Times, shape (N,) [s].
            motion: Positions, velocities, accelerations and torques, shape (N, n) each, SI units.
            limits: What the robot may do.
            clearance: What keeps it from collisions.
        """
        q, v, a, torque = motion
        jerk = np.gradient(a, t, axis=0)
        return cls(t, np.array([q, v, a, jerk, torque, torque * v]), limits, clearance)

    @cached_property
    def used(self) -> Array:
        """Share that is used of each limit, signed, shape (6, N, n); 0 where there is none."""
        return self.limits.used(*self.values[:5])

    @property
    def largest(self) -> Array:
        """Largest share that is used of each limit, by joint, shape (6, n)."""
        largest: Array = np.abs(self.used).max(axis=1)
        return largest

    def peak(self, kind: str, joint: int) -> float:
        """Return when a joint uses the most of a limit [s].

        Args:
            kind: Which, of ``LIMITS``.
            joint: Number of the joint.
        """
        return float(self.t[np.argmax(np.abs(self.used[LIMITS.index(kind), :, joint]))])

    @cached_property
    def thinned(self) -> "Course":
        """The same at no more than 1,000 instants, to look at distances."""
        rows = slice(None, None, -(-len(self.t) // _MOST))
        return replace(self, t=self.t[rows], values=self.values[:, rows])

    def nearness(self, chosen: Array) -> tuple[Array, Array]:
        """Return the least distance at each instant, and the pair that it is of, shape (N,) each.

        Args:
            chosen: Which pairs of the clearance are looked at, shape (pairs,), bool.

        Returns:
            Distances [m], inf without any pair, and numbers of pairs. Distances within which
            something is are exact, so the least of them is the least of all.
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
        """Return which pairs of a clearance the motion moves against each other, (pairs,), bool.

        Args:
            clearance: The pairs; one of bodies that turn about their own axis keeps its distance.
        """
        few = np.unique(np.linspace(0, len(self.t) - 1, _LOOKED_AT).astype(int))
        placed = clearance.placed(self.values[0][few])
        change: Array = np.ptp(
            clearance.near(placed, np.inf, clearance.everything).distance, axis=1
        )
        return change > _STILL

    @cached_property
    def nearest(self) -> Contact | None:
        """Where what the motion moves has the least margin of distance; None if there is none."""
        if self.clearance is None:
            return None
        few, kept = self.thinned, self.clearance.kept
        changes, found = few.changes(self.clearance), []
        for own in np.unique(kept[changes]).tolist():
            distance, pairs = few.nearness(changes & (kept == own))
            k = int(np.argmin(distance))
            names = self.clearance.named[int(pairs[k])]
            found.append(Contact(*names, float(distance[k]), float(few.t[k]), own))
        return min(found, key=lambda contact: contact.margin, default=None)
