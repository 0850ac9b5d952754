"""Motions from posture to posture: slow sweeps for friction, static postures for gravity."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.typing import Array
from robotid.design.clearance import POSES
from robotid.design.design import Design, Designer
from robotid.dynamics.simulation.motions import Motion

_RAMP = 0.25  # [s] until a sweep has its speed
_SPEEDS = (0.03, 0.1, 0.3, 0.8)  # of sweeps, as shares of the joint's largest speed
_STROKE = 3.0  # [s] largest duration of a sweep ...
_RANGE = 0.8  # ... and largest share of the joint's free range
_HOLD = 2.0  # [s] at each static posture
_BRISK = 0.5  # share of the largest speed between static postures
_SWEPT = 20  # random postures at which sweeps are tried
_PLACES = 41  # positions of a joint's range at which its free range is checked
_TRIES = 8  # sweeps, each shorter by a fifth than the one before
_RATE = 100.0  # [Hz] of the samples at which limits are checked


@dataclass(frozen=True, eq=False)
class Route(Motion):
    """A motion through postures, on straight lines in joint space, at rest at each posture.

    On a line the speed rises smoothly, is constant and falls: the path parameter s of duration 1
    has the speed V (10 x^3 - 15 x^4 + 6 x^5) with x = u / r while u < r, then V = 1 / (1 - r), and
    falls symmetrically.
    """

    places: Array  # the postures, shape (K, n) [rad or m]
    times: Array  # duration of each line, shape (K - 1,) [s]
    ramps: Array  # share r of it in which the speed rises, shape (K - 1,), at most 0.5
    holds: Array  # time at rest at each posture, shape (K,) [s]

    @cached_property
    def _starts(self) -> Array:
        """Start of each line, and end of the last one, shape (K,) [s]."""
        return np.cumsum(np.r_[self.holds[0], self.times[:-1] + self.holds[1:-1], self.times[-1]])

    @property
    def duration(self) -> float:
        """Its length [s]."""
        return float(self.holds.sum() + self.times.sum())

    def evaluate(self, t: Array) -> tuple[Array, Array, Array]:
        k = np.clip(np.searchsorted(self._starts, t, side="right") - 1, 0, len(self.times) - 1)
        T, r = self.times[k], self.ramps[k]
        u = np.clip((t - self._starts[k]) / T, 0.0, 1.0)
        V = 1.0 / (1.0 - r)
        mirrored = np.minimum(u, 1.0 - u)
        x = np.minimum(mirrored / r, 1.0)
        s = V * (r * (2.5 * x**4 - 3.0 * x**5 + x**6) + np.maximum(mirrored - r, 0.0))
        s = np.where(u <= 0.5, s, 1.0 - s)
        speed = V * (10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5)
        steep = np.where(mirrored < r, V / r * 30.0 * (x - x**2) ** 2, 0.0)
        steep = np.where(u <= 0.5, steep, -steep)
        way = self.places[k + 1] - self.places[k]
        return (
            self.places[k] + s[:, None] * way,
            (speed / T)[:, None] * way,
            (steep / T**2)[:, None] * way,
        )


def design_sweeps(
    designer: Designer, rng: np.random.Generator, speeds: Sequence[float] = _SPEEDS
) -> Design:
    """Return a motion in which each joint sweeps through one posture to and fro at each speed."""
    postures = designer.postures.resting(rng, POSES)[:_SWEPT]
    ranges = [_free_range(designer, posture) for posture in postures]  # (n, 2) each
    best = int(np.argmax([(free.sum(axis=1) / designer.limits.sizes[0]).min() for free in ranges]))
    share = _RANGE
    for _ in range(_TRIES):
        route = _sweeps(designer, postures[best], share * ranges[best], speeds)
        design = designer.examined(route, route.duration, _RATE)
        if _is_feasible(design):
            return design
        share *= 0.8
    raise SettingsError(
        f"about none of {len(postures)} random postures every joint can sweep: "
        f"{_why(design, designer)}; lower the share or the clearance"
    )


def _free_range(designer: Designer, posture: Array) -> Array:
    """Return each joint's free range below and above a posture, shape (n, 2) [rad or m]."""
    limits, n = designer.limits, len(posture)
    low, high = limits.middle - limits.sizes[0], limits.middle + limits.sizes[0]
    ways = np.linspace(low, high, _PLACES).T  # (n, places)
    q = np.repeat(posture[None], n * _PLACES, axis=0).reshape(n, _PLACES, n)
    q[np.arange(n), :, np.arange(n)] = ways
    are_free = designer.postures.can_rest(q.reshape(-1, n)).reshape(n, _PLACES)
    free = np.zeros((n, 2))
    for j, (way, is_free) in enumerate(zip(ways, are_free, strict=True)):
        blocked = way[~is_free]
        below, above = blocked[blocked < posture[j]], blocked[blocked > posture[j]]
        free[j, 0] = posture[j] - below.max(initial=low[j])
        free[j, 1] = above.min(initial=high[j]) - posture[j]
    return free


def _sweeps(designer: Designer, posture: Array, free: Array, speeds: Sequence[float]) -> Route:
    places, times, ramps = [posture], [], []
    for j, fastest in enumerate(designer.limits.sizes[1]):
        for share in speeds:
            speed = share * fastest
            down, up = np.minimum(free[j], speed * _STROKE / 2)
            for to in (up, -down, 0.0):
                place = posture.copy()
                place[j] += to
                cruise = abs(place[j] - places[-1][j]) / speed
                places.append(place)
                times.append(cruise + _RAMP)
                ramps.append(min(_RAMP / (cruise + _RAMP), 0.5))
    holds = np.full(len(places), _RAMP)
    return Route(np.array(places), np.array(times), np.array(ramps), holds)


def design_stands(designer: Designer, rng: np.random.Generator, count: int = 20) -> Design:
    """Return a motion that rests at postures whose gravity torques give the most information."""
    # one by one, each adds the most to log det (Fedorov 1972, Theory of Optimal Experiments)
    q = designer.postures.resting(rng, POSES)
    still = np.zeros_like(q)
    rows = designer.information.rows(q, still, still)
    scale = np.sqrt(_HOLD / designer.noise)[:, None] * designer.spread
    A = np.einsum("rb,rbk->krb", scale, rows.W)  # rows of each posture in units of the spread
    known, left = designer.known.copy(), list(range(len(q)))
    chosen: list[int] = []
    while left and len(chosen) < count:
        inside = np.linalg.solve(known, A[left].swapaxes(1, 2))
        gain = np.linalg.slogdet(np.eye(A.shape[1]) + A[left] @ inside)[1]
        best = left[int(np.argmax(gain))]
        known += A[best].T @ A[best]
        left.remove(best)
        chosen.append(best)
    order = [chosen.pop(0)]
    while chosen:
        near = min(chosen, key=lambda k: float(np.abs(q[k] - q[order[-1]]).max()))
        chosen.remove(near)
        order.append(near)
    return _visited(designer, q[order])


def _visited(designer: Designer, places: Array) -> Design:
    """Return the motion through postures, except those on whose line a limit is violated."""
    visited = [places[0]]
    for place in places[1:]:
        leg = _legs(designer, np.array([visited[-1], place]))
        if _is_feasible(designer.examined(leg, leg.duration, _RATE)):
            visited.append(place)
    if len(visited) < 2:
        raise SettingsError(
            "every line between two postures has a collision or exceeds a limit; lower the share "
            "or the clearance"
        )
    route = _legs(designer, np.array(visited))
    return designer.examined(route, route.duration, _RATE)


def _legs(designer: Designer, places: Array) -> Route:
    """Return the motion through postures, at rest for 2 s at each."""
    speed = _BRISK * designer.limits.sizes[1]
    times = 2.0 * np.abs(np.diff(places, axis=0) / speed).max(axis=1)
    times = np.maximum(times, 1.0)
    return Route(places, times, np.full(len(times), 0.5), np.full(len(places), _HOLD))


def _is_feasible(design: Design) -> bool:
    is_clear = design.contact is None or design.contact.margin >= 0.0
    return bool(design.used.max() <= 1.0 and is_clear)


def _why(design: Design, designer: Designer) -> str:
    if design.contact is not None:
        return str(design.contact)
    _, joint = np.unravel_index(int(np.argmax(design.used)), design.used.shape)
    return f"{designer.information.model.joints[joint]} needs {100 * design.used.max():.0f} %"
