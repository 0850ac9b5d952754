"""Postures in which a robot can rest: within its limits, and clear of what it may hit."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.excitation.clearance import Clearance
from robotid.excitation.information import MotionInformation
from robotid.excitation.limits import LIMITS, MotionLimits
from robotid.excitation.multipliers import SOFT
from robotid.findings import listed

__all__ = ["Postures"]

_TRIED = 200  # random postures until one is found that the robot can rest in ...
_AT_ONCE = 10  # ... so many at a time
_REPAIRS = 300  # joints that are redrawn of a posture that breaks a limit, one after another


@dataclass(frozen=True, eq=False)
class Postures:
    """Random postures, and those of them that keep limits and distances at rest.

    Attributes:
        information: The rows of the robot's base problem, which give its torque.
        limits: What the robot may do.
        clearance: What keeps it from collisions; None: they are not looked at.
    """

    information: MotionInformation
    limits: MotionLimits
    clearance: Clearance | None = None

    def resting(self, rng: np.random.Generator, tried: int = _TRIED) -> Array:
        """Return those of random postures that keep limits and distances at rest, shape (k, n).

        Args:
            rng: Source of the postures.
            tried: How many are tried.

        Raises:
            SettingsError: If none of them does.
        """
        q = self._drawn(rng, tried)
        kept: Array = q[self.can_rest(q)]
        if not len(kept):
            kept = self._repaired(q[:_AT_ONCE], rng)
        if not len(kept):
            raise SettingsError(self._why_not(*self._at_rest(q)))
        return kept

    def _repaired(self, q: Array, rng: np.random.Generator) -> Array:
        """Return the postures that keep all limits once joints of what they broke are redrawn.

        Of each posture one such joint is redrawn at a time; what breaks more is not kept. Robots of
        many joints have postures at rest, but one in a million random ones is one.

        Args:
            q: Postures, shape (N, n) [rad or m].
            rng: Source of the joints and of their positions.

        References:
            Selman, Kautz, Cohen (1994), Noise strategies for improving local search.
        """
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
            is_kept = now.sum(axis=1) <= total
            q[is_kept], broken[is_kept] = other[is_kept], now[is_kept]
        kept: Array = q[self.can_rest(q)]
        return kept

    def _broken_by_joint(self, q: Array) -> Array:
        """Return how much of what postures break each joint has part in, shape (N, n)."""
        used, margins = self._at_rest(q)
        found = np.maximum(used - 1.0, 0.0).sum(axis=0) @ self.information.chains
        if self.clearance is not None:
            movers = self.clearance.movers
            movers = movers / np.maximum(movers.sum(axis=1, keepdims=True), 1)
            found += np.maximum(-margins.T, 0.0) / SOFT @ movers
        by_joint: Array = found
        return by_joint

    def one(self, rng: np.random.Generator) -> Array:
        """Return the first of ``resting``, which are tried a few at a time, shape (n,).

        Args:
            rng: Source of the postures.

        Raises:
            SettingsError: If none of them is one.
        """
        for _ in range(_TRIED // _AT_ONCE):
            q = self._drawn(rng, _AT_ONCE)
            kept: Array = q[self.can_rest(q)]
            if len(kept):
                break
        else:
            kept = self.resting(rng)
        first: Array = kept[0]
        return first

    def _drawn(self, rng: np.random.Generator, count: int) -> Array:
        """Return random postures, shape (count, n) [rad or m]."""
        reach = rng.uniform(-0.8, 0.8, (count, len(self.limits.middle)))
        reach[:, self.limits.sizes[0] > 2.0] *= 0.6
        q: Array = self.limits.middle + reach * self.limits.sizes[0]
        return q

    def can_rest(self, q: Array) -> Array:
        """Return whether postures keep limits and distances at rest, shape (N,), bool.

        Args:
            q: Postures, shape (N, n) [rad or m].
        """
        used, margins = self._at_rest(q)
        is_clear = (margins >= 0.0).all(axis=0)
        can: Array = (used.max(axis=(0, 2)) <= 1.0) & is_clear
        return can

    def _at_rest(self, q: Array) -> tuple[Array, Array]:
        """Return shares of limits that postures use, (6, N, n), and margins, (pairs, N) [m]."""
        still = np.zeros_like(q)
        rows = self.information.rows(q, still, still)
        used = np.abs(self.limits.used(q, still, still, still, self.information.torque(rows)))
        return used, self._margins(q)

    def _margins(self, q: Array) -> Array:
        """Return margins of distances with what a design spares, shape (pairs, N) [m]."""
        if self.clearance is None:
            return np.zeros((0, len(q)))
        return self.clearance.margins(self.clearance.placed(q), 1.0)

    def _why_not(self, used: Array, margins: Array) -> str:
        """Return what leaves no posture: a limit or a distance alone, or several together."""
        broken = sorted(self._broken(used, margins), key=lambda entry: -entry[0])
        tried = f"of {used.shape[1]} random postures none can be held at rest"
        share, alone, _ = broken[0]
        if share == 1.0:
            return f"{tried}: {alone}"
        most = [f"{words} in {100 * share:.0f} %" for share, _, words in broken]
        return (
            f"{tried}: each breaks a limit or a distance, though none of them breaks all. Most "
            f"often {listed(most, 3)}; narrow the limits of these joints, lock joints that need "
            "not move, lower the clearance, or --clearance none to leave collisions unlooked at"
        )

    def _broken(self, used: Array, margins: Array) -> list[tuple[float, str, str]]:
        """Return each limit and distance that postures break: their share, and two wordings."""
        found, names = [], self.information.model.joints
        for kind, joint in np.argwhere((used > 1.0).any(axis=1)).tolist():
            own = used[kind, :, joint]
            least = (
                f"{names[joint]} needs {_percent(own.min())} % of its {LIMITS[kind]} limit at the "
                "least; state the limits that the robot has, or the load that it carries"
            )
            some = f"{names[joint]} needs more than its {LIMITS[kind]} limit"
            found.append((float(np.mean(own > 1.0)), least, some))
        if self.clearance is None:
            return found
        for pair in np.flatnonzero((margins < 0.0).any(axis=1)).tolist():
            two = " and ".join(self.clearance.named[pair])
            wanted = float(self.clearance.kept[pair] + self.clearance.spare[pair, 0])
            most = (
                f"in the best of them {two} are {1e3 * (margins[pair].max() + wanted):.1f} mm "
                f"apart, wanted {1e3 * wanted:.1f} mm; lower the clearance, or move the floor and "
                "the boxes"
            )
            some = f"{two} are nearer than {1e3 * wanted:.1f} mm"
            found.append((float(np.mean(margins[pair] < 0.0)), most, some))
        return found


def _percent(share: float) -> str:
    """Return a share in per cent, in few digits however large it is."""
    return f"{100 * share:.0f}" if share < 1e4 else f"{100 * share:.2g}"
