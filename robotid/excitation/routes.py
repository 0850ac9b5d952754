"""Motions from place to place: slow sweeps that show friction, stands that show gravity."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.excitation.clearance import Contact
from robotid.excitation.design import Design, Designer
from robotid.simulation.motions import Motion

__all__ = ["Route", "design_stands", "design_sweeps"]

_RAMP = 0.25  # [s] in which a sweep reaches its speed
_SPEEDS = (0.03, 0.1, 0.3, 0.8)  # of sweeps, as shares of the joint's largest speed
_STROKE = 3.0  # [s] that a sweep lasts at most ...
_REACH = 0.8  # ... and share of the joint's range that it covers at most
_HOLD = 2.0  # [s] that a stand lasts
_BRISK = 0.5  # share of the largest speed at which the robot goes from stand to stand
_CANDIDATES = 400  # random postures among which stands are chosen ...
_LOOKED_AT = 20  # ... and those about which sweeps are thought of
_PLACES = 41  # of a joint's range at which it is asked whether it can go there
_TRIES = 8  # sweeps, each shorter by a fifth than the one before
_RATE = 100.0  # [Hz] of the instants at which limits are looked at


@dataclass(frozen=True, eq=False)
class Route(Motion):
    """A motion from place to place, straight in the joints, at rest at each for a while.

    On its way the speed rises smoothly, stays and falls: the way s of duration 1 has the speed
    V (10 x^3 - 15 x^4 + 6 x^5) with x = u / r while u < r, V = 1 / (1 - r) then, and the same back.

    Attributes:
        places: Shape (K, n) [rad or m].
        times: How long each of the ways takes, shape (K - 1,) [s].
        ramps: Share r of it in which the speed rises, shape (K - 1,), at most 0.5.
        holds: How long it rests at each place, shape (K,) [s].
    """

    places: Array
    times: Array
    ramps: Array
    holds: Array

    @cached_property
    def _starts(self) -> Array:
        """When each way begins, and the last ends, shape (K,) [s]."""
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
    """Return a motion in which joint after joint goes to and fro at steady speeds.

    Each joint sweeps about one posture, through it both ways, at each speed; the others rest.

    Args:
        designer: What is to be told, within which limits.
        rng: Source of the posture.
        speeds: Shares of each joint's largest speed.

    Raises:
        SettingsError: If no posture is found about which every joint can sweep.
    """
    postures = designer.postures.resting(rng, _CANDIDATES)[:_LOOKED_AT]
    rooms = [_room(designer, posture) for posture in postures]  # (n, 2) each
    best = int(np.argmax([(room.sum(axis=1) / designer.limits.sizes[0]).min() for room in rooms]))
    share = _REACH
    for _ in range(_TRIES):
        route = _sweeps(designer, postures[best], share * rooms[best], speeds)
        design = designer.examined(route, route.duration, _RATE)
        if _is_kept(design):
            return design
        share *= 0.8
    raise SettingsError(
        f"of {len(postures)} random postures there is none about which every joint can sweep: "
        f"{_why(design, designer)}; lower the share or the clearance"
    )


def _room(designer: Designer, posture: Array) -> Array:
    """Return how far each joint can go down and up from a posture, shape (n, 2) [rad or m]."""
    limits, n = designer.limits, len(posture)
    low, high = limits.middle - limits.sizes[0], limits.middle + limits.sizes[0]
    ways = np.linspace(low, high, _PLACES).T  # (n, places)
    q = np.repeat(posture[None], n * _PLACES, axis=0).reshape(n, _PLACES, n)
    q[np.arange(n), :, np.arange(n)] = ways
    is_kept = designer.postures.can_rest(q.reshape(-1, n)).reshape(n, _PLACES)
    room = np.zeros((n, 2))
    for j, (way, kept) in enumerate(zip(ways, is_kept, strict=True)):
        blocked = way[~kept]
        below, above = blocked[blocked < posture[j]], blocked[blocked > posture[j]]
        room[j, 0] = posture[j] - below.max(initial=low[j])
        room[j, 1] = above.min(initial=high[j]) - posture[j]
    return room


def _sweeps(designer: Designer, posture: Array, room: Array, speeds: Sequence[float]) -> Route:
    places, times, ramps = [posture], [], []
    for j, fastest in enumerate(designer.limits.sizes[1]):
        for share in speeds:
            speed = share * fastest
            down, up = np.minimum(room[j], speed * _STROKE / 2)
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
    """Return a motion that rests at postures whose gravity tells the most, one after the other.

    Postures are taken one by one from random ones, each that which adds the most to log det of the
    information of all so far; the next is the nearest of them.

    Args:
        designer: What is to be told, within which limits.
        rng: Source of the postures.
        count: How many stands.

    Raises:
        SettingsError: If there are too few postures, or no way between them is clear.

    References:
        Fedorov (1972), Theory of Optimal Experiments.
    """
    q = designer.postures.resting(rng, _CANDIDATES)
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
    """Return the motion from place to place; a place that cannot be reached clearly is left out."""
    kept = [places[0]]
    for place in places[1:]:
        leg = _legs(designer, np.array([kept[-1], place]))
        if _is_kept(designer.examined(leg, leg.duration, _RATE)):
            kept.append(place)
    if len(kept) < 2:
        raise SettingsError(
            "no posture can be reached from another one without a collision or beyond a limit; "
            "lower the share or the clearance"
        )
    route = _legs(designer, np.array(kept))
    return designer.examined(route, route.duration, _RATE)


def _legs(designer: Designer, places: Array) -> Route:
    """Return the motion from place to place, at rest for 2 s at each."""
    speed = _BRISK * designer.limits.sizes[1]
    times = 2.0 * np.abs(np.diff(places, axis=0) / speed).max(axis=1)
    times = np.maximum(times, 1.0)
    return Route(places, times, np.full(len(times), 0.5), np.full(len(places), _HOLD))


def _is_kept(design: Design) -> bool:
    is_clear = design.contact is None or design.contact.margin >= 0.0
    return bool(design.used.max() <= 1.0 and is_clear)


def _why(design: Design, designer: Designer) -> str:
    contact: Contact | None = design.contact
    if contact is not None:
        return str(contact)
    _, joint = np.unravel_index(int(np.argmax(design.used)), design.used.shape)
    return f"{designer.information.model.joints[joint]} needs {100 * design.used.max():.0f} %"
