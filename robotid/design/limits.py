"""The limits of a robot's motion, the use that a motion makes of them, and postures within them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.design.clearance import POSES, SOFT, Clearance, Contact
from robotid.design.information import MotionInformation
from robotid.robot.model import RobotModel

#: The limited quantities, in the order of ``MotionLimits.sizes``.
LIMITS = ("position", "velocity", "acceleration", "jerk", "torque", "power")
_FREE = np.pi  # [rad] half the range of a continuous joint
_AT_ONCE = 10  # random postures tried at a time for one that the robot can hold
_REPAIRS = 300  # joints that are redrawn of a posture that violates a limit, one after another
_SAMPLES = 1000  # samples at which distances are computed
_FEW = 20  # samples by which the changing distances are found ...
_STILL = 1e-4  # [m] ... those that change by more than this
_WITHIN = 0.02  # [m] distances that are computed first; then up to twice as far, and so on


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """The limits of each of n joints; inf where there is none."""

    middle: Array  # middle of the positions allowed, shape (n,) [rad or m]
    # half the range of positions, and the largest velocity, acceleration, jerk, torque and power
    sizes: Array  # (6, n), SI units

    @classmethod
    def of_model(
        cls,
        model: RobotModel,
        *,
        share: float = 0.9,
        velocity: float | Mapping[str, float] = np.inf,
        torque: float | Mapping[str, float] = np.inf,
        acceleration: float | Mapping[str, float] = np.inf,
        jerk: float | Mapping[str, float] = np.inf,
        power: float | Mapping[str, float] = np.inf,
    ) -> "MotionLimits":
        """Return the limits stated in a URDF, and those stated in addition."""
        if not 0 < share <= 1:
            raise SettingsError(f"share is {share}, expected more than 0 and at most 1")
        fastest = np.array([j.velocity if j.velocity > 0 else np.inf for j in model.limits])
        fastest = np.minimum(share * fastest, _each(model, velocity, "velocity"))
        missing = []
        for joint, limit in zip(model.limits, fastest, strict=True):
            is_bounded = joint.has_limits or joint.type == "continuous"
            lacks = ["position"] * (not is_bounded) + ["velocity"] * bool(limit == np.inf)
            missing += [f"{joint.name} ({' and '.join(lacks)})"] if lacks else []
        if missing:
            raise SettingsError(
                f"{Path(model.tree.path).name} has no limit of {listed(missing)}; add <limit lower "
                'upper velocity effort>, set type="continuous" if a revolute joint has no position '
                "limit, give a missing velocity as --max-velocity JOINT=X, or lock the joints"
            )
        middle = [(j.lower + j.upper) / 2 if j.has_limits else 0.0 for j in model.limits]
        half = [(j.upper - j.lower) / 2 if j.has_limits else _FREE for j in model.limits]
        effort = [j.effort if j.effort > 0 else np.inf for j in model.limits]
        sizes = [
            share * np.array(half),
            fastest,
            _each(model, acceleration, "acceleration"),
            _each(model, jerk, "jerk"),
            np.minimum(share * np.array(effort), _each(model, torque, "torque")),
            _each(model, power, "power"),
        ]
        return cls(np.array(middle), np.array(sizes))

    def used(self, q: Array, v: Array, a: Array, jerk: Array, torque: Array) -> Array:
        """Return a motion's quantities divided by their limits, signed, shape (6, N, n)."""
        values = np.array([q - self.middle, v, a, jerk, torque, torque * v])
        return values / self.sizes[:, None]


def _each(model: RobotModel, stated: float | Mapping[str, float], what: str) -> Array:
    by_name = stated if isinstance(stated, Mapping) else dict.fromkeys(model.joints, stated)
    for name, value in by_name.items():
        if name not in model.joints:
            raise SettingsError(
                f"{what} is given for {name!r}, which is not a moving joint; moving joints: "
                f"{listed(model.joints)}"
            )
        if not value > 0:
            raise SettingsError(f"{what} of {name} is {value:g}, expected a positive number")
    return np.array([by_name.get(name, np.inf) for name in model.joints], dtype=float)


@dataclass(frozen=True, eq=False)
class Postures:
    """Random postures, and those of them that satisfy limits and distances at rest."""

    information: MotionInformation  # the rows of the robot's base problem, which give its torque
    limits: MotionLimits  # the robot's limits
    clearance: Clearance | None = None  # the distances to collisions; None: they are not checked

    def resting(self, rng: np.random.Generator, tried: int = POSES) -> Array:
        """Return the random postures that satisfy limits and distances at rest, shape (k, n)."""
        q = self._drawn(rng, tried)
        possible = q[self.can_rest(q)]
        if not len(possible):
            possible = self._repaired(q[:_AT_ONCE], rng)
        if not len(possible):
            raise SettingsError(self._why_not(*self._at_rest(q)))
        return possible

    def _repaired(self, q: Array, rng: np.random.Generator) -> Array:
        """Return the postures that satisfy all limits after joints with violations are redrawn."""
        q, broken = q.copy(), self._broken_by_joint(q)
        for _ in range(_REPAIRS):
            total = broken.sum(axis=1)
            if not total.all():
                break
            share = broken.cumsum(axis=1) / total[:, None]
            joint = (share < rng.uniform(size=(len(q), 1))).sum(axis=1)
            other, rows = q.copy(), np.arange(len(q))
            other[rows, joint] = self._drawn(rng, len(q))[rows, joint]
            now = self._broken_by_joint(other)
            is_better = now.sum(axis=1) <= total
            q[is_better], broken[is_better] = other[is_better], now[is_better]
        return np.asarray(q[self.can_rest(q)])

    def _broken_by_joint(self, q: Array) -> Array:
        """Return each joint's share in the violations of postures, shape (N, n)."""
        used, margins = self._at_rest(q)
        violation = np.maximum(used - 1.0, 0.0).sum(axis=0) @ self.information.chains
        if self.clearance is not None:
            movers = self.clearance.movers
            movers = movers / np.maximum(movers.sum(axis=1, keepdims=True), 1)
            violation += np.maximum(-margins.T, 0.0) / SOFT @ movers
        return np.asarray(violation)

    def one(self, rng: np.random.Generator) -> Array:
        """Return the first of ``resting``, which are tried a few at a time, shape (n,)."""
        for _ in range(POSES // _AT_ONCE):
            q = self._drawn(rng, _AT_ONCE)
            possible = q[self.can_rest(q)]
            if len(possible):
                return np.asarray(possible[0])
        return np.asarray(self.resting(rng)[0])

    def _drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Return random postures, shape (count, n) [rad or m]."""
        share = rng.uniform(-0.8, 0.8, (count, len(self.limits.middle)))
        share[:, self.limits.sizes[0] > 2.0] *= 0.6
        return np.asarray(self.limits.middle + share * self.limits.sizes[0])

    def can_rest(self, q: Array) -> Array:
        """Return whether postures (N, n) satisfy limits and distances at rest, (N,), bool."""
        used, margins = self._at_rest(q)
        return np.asarray((used.max(axis=(0, 2)) <= 1.0) & (margins >= 0.0).all(axis=0))

    def _at_rest(self, q: Array) -> tuple[Array, Array]:
        """Return used shares of limits (6, N, n), and margins with reserve (pairs, N) [m]."""
        still = np.zeros_like(q)
        rows = self.information.rows(q, still, still)
        used = np.abs(self.limits.used(q, still, still, still, self.information.torque(rows)))
        if self.clearance is None:
            return used, np.zeros((0, len(q)))
        return used, self.clearance.margins(self.clearance.placed(q), 1.0)

    def _why_not(self, used: Array, margins: Array) -> str:
        """Return what rules out all postures: one limit or distance, or several together."""
        broken = sorted(self._broken(used, margins), key=lambda entry: -entry[0])
        tried = f"none of {used.shape[1]} random postures is feasible at rest"
        share, alone, _ = broken[0]
        if share == 1.0:
            return f"{tried}: {alone}"
        most = [f"{words} in {100 * share:.0f} %" for share, _, words in broken]
        return (
            f"{tried}: each violates a limit or a distance. Most frequent: {listed(most, 3)}. "
            "Narrow the position limits of these joints, lock joints, lower the clearance, or omit "
            "the collision check (--clearance none)"
        )

    def _broken(self, used: Array, margins: Array) -> list[tuple[float, str, str]]:
        """Return each violated limit and distance: its share of the postures, and two wordings."""
        found, names = [], self.information.model.joints
        for kind, joint in np.argwhere((used > 1.0).any(axis=1)).tolist():
            own = used[kind, :, joint]
            needed = 100.0 * own.min()  # in few digits however large it is
            share = f"{needed:.0f}" if needed < 1e6 else f"{needed:.2g}"
            least = (
                f"{names[joint]} needs at least {share} % of its {LIMITS[kind]} "
                "limit; set the robot's actual limits, or its actual payload"
            )
            some = f"{names[joint]} needs more than its {LIMITS[kind]} limit"
            found.append((float(np.mean(own > 1.0)), least, some))
        if self.clearance is None:
            return found
        for pair in np.flatnonzero((margins < 0.0).any(axis=1)).tolist():
            two = " and ".join(self.clearance.named[pair])
            wanted = float(self.clearance.required[pair] + self.clearance.spare[pair, 0])
            most = (
                f"the distance of {two} is {1e3 * (margins[pair].max() + wanted):.1f} mm at most, "
                f"expected {1e3 * wanted:.1f} mm; lower the clearance, or move the floor and the "
                "boxes"
            )
            some = f"{two} are nearer than {1e3 * wanted:.1f} mm"
            found.append((float(np.mean(margins[pair] < 0.0)), most, some))
        return found


@dataclass(frozen=True, eq=False)
class Course:
    """A motion at N samples, and its use of each limit."""

    t: Array  # times, shape (N,) [s]
    values: Array  # (6, N, n), SI units: position, velocity, acceleration, jerk, torque, power
    limits: MotionLimits  # the robot's limits
    clearance: Clearance | None = None  # the distances to collisions; None: they are not checked

    @classmethod
    def of_motion(
        cls,
        t: Array,
        motion: tuple[Array, Array, Array, Array],
        limits: MotionLimits,
        clearance: Clearance | None = None,
    ) -> "Course":
        """Return the course of a sampled motion; its jerk by finite differences."""
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
        return np.asarray(np.abs(self.used).max(axis=1))

    def peak(self, kind: str, joint: int) -> float:
        """Return the time of a joint's largest use of a limit [s]."""
        return float(self.t[np.argmax(np.abs(self.used[LIMITS.index(kind), :, joint]))])

    @cached_property
    def thinned(self) -> "Course":
        """The same at no more than 1,000 samples, for the distances."""
        rows = slice(None, None, -(-len(self.t) // _SAMPLES))
        return replace(self, t=self.t[rows], values=self.values[:, rows])

    def nearness(self, chosen: Array) -> tuple[Array, Array]:
        """Return the smallest distance at each sample, and its pair, shape (N,) each."""
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
        distance = clearance.near(placed, np.inf, clearance.everything).distance
        return np.asarray(np.ptp(distance, axis=1) > _STILL)

    @cached_property
    def nearest(self) -> Contact | None:
        """The smallest margin of the changing distances; None if no distance changes."""
        if self.clearance is None:
            return None
        few, required = self.thinned, self.clearance.required
        changes, contacts = few.changes(self.clearance), []
        for least in np.unique(required[changes]).tolist():
            distance, pairs = few.nearness(changes & (required == least))
            k = int(np.argmin(distance))
            names = self.clearance.named[int(pairs[k])]
            contacts.append(Contact(*names, float(distance[k]), float(few.t[k]), least))
        return min(contacts, key=lambda contact: contact.margin, default=None)
