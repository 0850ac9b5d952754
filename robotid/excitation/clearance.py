"""How far the links of a moving robot keep from each other, from the floor and from boxes.

Every shape is replaced by its convex hull, which holds it. Distances between hulls come from coal;
a hull that a joint turns moves with the joint's screw, so that a distance has an exact gradient.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, SettingsError
from robotid.findings import listed
from robotid.regressor.along import Placements, fixed_tree
from robotid.robot.geometry import link_clouds
from robotid.robot.model import RobotModel
from robotid.simulation.motions import Motion

__all__ = ["Box", "Clearance", "Contact", "Nearness"]

_TRIED = 400  # random poses that say which links may meet at all
_APART = 0.05  # [m] links that stay so far apart at all of them are looked at in the end alone
_ALMOST_ALL = 0.95  # share of the poses
_TOUCH = 1e-3  # [m] hulls nearer than this touch
_ROOM = 5e-3  # [m] beyond the clearance: links that have no more are built near each other
_THINNEST = 1e-3  # [m] a flat shape is as thick
_FIRST = 0.05  # [s] the intervals that a motion is first looked at in ...
_SHORTEST = 1e-3  # [s] ... and the shortest that they are halved to
_SURE = 5e-4  # [m] by which a lower bound may be too low
_WIDE = 100.0  # [m] extent of the floor
_SPARE = 0.002  # [m] of distances, that a design leaves for what lies between its instants ...
_SPARE_ROOM = 0.25  # ... of the room that links have which are built near each other: at most that
_DATA_RANGE = 0.01  # [m] short of which margins are reckoned
_SIGNS = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1).T  # corners of a box, (8, 3)


@dataclass(frozen=True)
class Box:
    """A box at rest beside the robot, in the frame of the root link.

    Attributes:
        name: What it is called.
        low: Its lower corner [m].
        high: Its upper corner [m].
    """

    name: str
    low: tuple[float, float, float]
    high: tuple[float, float, float]


@dataclass(frozen=True)
class Contact:
    """Where two things come nearest.

    Attributes:
        first: Name of one.
        second: Name of the other.
        distance: Between their hulls, below 0 if they overlap [m].
        time: When [s].
        kept: Distance that is to be kept between them [m].
    """

    first: str
    second: str
    distance: float
    time: float
    kept: float = 0.0

    @property
    def margin(self) -> float:
        """How much farther apart they stay than they have to [m]."""
        return self.distance - self.kept

    def __str__(self) -> str:
        said = f"come to {1e3 * self.distance:.0f} mm" if self.distance > 0 else "overlap"
        return f"{self.first} and {self.second} {said} at {self.time:.2f} s"


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distances of pairs that are near each other along a motion.

    Attributes:
        distance: Shape (pairs, N) [m]; of what is farther than asked for, a lower bound.
        pairs: Pair of each of k distances that have a gradient, shape (k,).
        samples: Instant of each, shape (k,).
        gradient: Of each by the n joints, shape (k, n) [m/rad or 1].
    """

    distance: Array
    pairs: Array
    samples: Array
    gradient: Array


@dataclass(frozen=True, eq=False)
class _Hull:
    """A convex piece of a link, or of what is at rest (body -1), in the frame of its body."""

    name: str
    body: int
    centre: Array
    radius: float
    half: Array  # of the box around it, in that frame, shape (3,)
    corners: Array  # about the centre, shape (k, 3)
    shape: Any  # of coal, about the centre


class Clearance:
    """What keeps a robot from hitting itself and what stands around it.

    Links that a joint joins are not looked at. Of other links the hulls of two may touch where the
    robot stands at zero and in 95 % of random poses: they are made to, and left alone. Links that
    are built near each other, without room for the clearance in 95 % of the poses, but that come
    apart, are watched at half the distance that they usually have.

    Args:
        model: The robot, with a fixed base.
        least: Distance that is to be kept [m].
        floor: Height below which nothing that moves may go, in the frame of the root link [m].
        boxes: What stands around the robot.
        seed: Of the random poses that say which links may meet.

    Attributes:
        pairs: Numbers of the two hulls of each pair.
        likely: Which pairs may meet within the limits, shape (pairs,), bool.
        kept: Distance that each pair is to keep, shape (pairs,) [m].
        room: How much more than that pairs that are built near each other usually have, shape
            (pairs,) [m]; inf of the others.
        unread: Links of which a shape cannot be read: nothing keeps them from hitting anything.
        made_to: Links that are made to touch and left alone, by two, with their least distance.
        built_near: Links that are built near each other, by two, with the distance they keep.

    Raises:
        DataError: If no link has a shape that can be read, or the base floats.
        SettingsError: If a number is not usable, or a joint is of a kind that is not compiled.
    """

    def __init__(
        self,
        model: RobotModel,
        *,
        least: float = 0.02,
        floor: float | None = None,
        boxes: Sequence[Box] = (),
        seed: int = 0,
    ) -> None:
        import coal

        if not least >= 0:
            raise SettingsError(f"clearance is {least}, wanted 0 m or more")
        self.least, self._model, self._tree = least, model, fixed_tree(model)
        self._ratios = model.velocity_map  # of joints by body, (m, n)
        clouds, self.unread = link_clouds(model)
        if not clouds:
            raise DataError(
                f"{model.tree.path} has no shape that can be read, so nothing is known of "
                "collisions; give it collision geometry, or design without clearance"
            )
        self._hulls = [_hull(name, body, points) for name, body, points in clouds]
        self._hulls += [_hull(box.name, -1, _corners(box)) for box in boxes]
        if floor is not None:
            below = Box("the floor", (-_WIDE, -_WIDE, floor - _WIDE), (_WIDE, _WIDE, floor))
            self._hulls.append(_hull(below.name, -1, _corners(below)))
        self._request = coal.DistanceRequest(True, True)
        self.pairs = self._possible_pairs()
        self._sort_out(np.random.default_rng(seed))

    def _possible_pairs(self) -> Array:
        """Return pairs that can move against each other: not links that a joint joins."""
        tree, hulls = self._model.pin_model, self._hulls
        joined = {(int(tree.parents[i]) - 1, i - 1) for i in range(1, tree.njoints)}
        found = []
        for i, j in combinations(range(len(hulls)), 2):
            a, b = sorted((hulls[i].body, hulls[j].body))
            is_link = hulls[j].name in self._model.tree.links
            if a != b and not (is_link and (a, b) in joined):
                found.append((i, j))
        return np.array(found, dtype=int).reshape(-1, 2)

    def _sort_out(self, rng: np.random.Generator) -> None:
        """Find by random poses which pairs may meet, are made to, or are built near each other."""
        low = [j.lower if j.has_limits else -np.pi for j in self._model.limits]
        high = [j.upper if j.has_limits else np.pi for j in self._model.limits]
        q = np.vstack([np.clip(0.0, low, high), rng.uniform(low, high, (_TRIED, len(low)))])
        distance = self.near(self.placed(q), self.least + _APART, self.everything).distance
        is_link = np.array([hull.name in self._model.tree.links for hull in self._hulls])
        are_links = np.all(is_link[self.pairs], axis=1)
        touch = np.less(distance, _TOUCH)
        always = are_links & touch[:, 0] & (touch.mean(axis=1) > _ALMOST_ALL)
        self.made_to = self._listed(always, distance.min(axis=1))
        self.pairs, distance, touch = self.pairs[~always], distance[~always], touch[~always]
        near = (distance < self.least + _ROOM).mean(axis=1) > _ALMOST_ALL
        near &= are_links[~always] & ~touch.all(axis=1)
        self.kept, self.room = np.full(len(near), self.least), np.full(len(near), np.inf)
        for k in np.flatnonzero(near):
            usual = float(np.median(distance[k, ~touch[k]]))
            self.kept[k] = min(self.least, usual / 2)
            self.room[k] = usual - self.kept[k]
        self.built_near = self._listed(near, self.kept)
        apart = self.kept + np.minimum(_APART, self.room / 2)
        self.likely = distance.min(axis=1, initial=np.inf) < apart

    def _listed(self, chosen: Array, distance: Array) -> list[str]:
        """Return the links of pairs and their least distances, in words, each two once."""
        least: dict[tuple[str, str], float] = {}
        for k in np.flatnonzero(chosen).tolist():
            names = self.named[k]
            least[names] = min(least.get(names, np.inf), float(distance[k]))
        return [
            f"{a} and {b} ({'overlap by ' * (d < 0)}{abs(1e3 * d):.0f} mm)"
            for (a, b), d in least.items()
        ]

    @cached_property
    def _supports(self) -> Array:
        """Which joints move which body, shape (m + 1, m), bool; the last row is at rest."""
        is_below = self._tree.is_below
        return np.vstack([is_below, np.zeros(len(is_below), dtype=bool)])

    @cached_property
    def movers(self) -> Array:
        """Which joints move the hulls of each pair against each other, shape (pairs, n), bool."""
        moved: Array = (self._levers > 0.0) @ np.abs(self._ratios) > 0.0
        return moved

    @property
    def everything(self) -> Array:
        """All pairs, as ``near`` takes them, shape (pairs,), bool."""
        return np.ones(len(self.pairs), dtype=bool)

    @property
    def named(self) -> list[tuple[str, str]]:
        """The names of each pair."""
        return [(self._hulls[i].name, self._hulls[j].name) for i, j in self.pairs.tolist()]

    @property
    def spare(self) -> Array:
        """What is left of distances for what lies between instants, shape (pairs, 1) [m]."""
        spare: Array = np.minimum(_SPARE, _SPARE_ROOM * self.room)[:, None]
        return spare

    def margins(self, placed: Placements, spare: float, *, hints: Array | None = None) -> Array:
        """Return margins of distances, shape (pairs, N) [m]; a lower bound of those over 1 cm.

        Args:
            placed: Where the bodies are at N instants.
            spare: How many times what distances spare is taken off the margin.
            hints: As of ``near``.
        """
        kept = self.kept[:, None] + spare * self.spare
        seen = np.minimum(_DATA_RANGE, self.room[:, None] / 4)
        return self.near(placed, kept + seen, hints=hints).distance - kept

    def placed(self, q: Array) -> Placements:
        """Return where the bodies are.

        Args:
            q: Joint coordinates, shape (N, n) [rad or m].
        """
        return Placements.along(self._tree, q)

    def near(
        self,
        placed: Placements,
        within: float | Array,
        chosen: Array | None = None,
        hints: Array | None = None,
    ) -> Nearness:
        """Return the distances of pairs along a motion, exact where they are near.

        Args:
            placed: Where the bodies are at N instants.
            within: Distance from which a lower bound will do, one, or one per pair and instant,
                shape (pairs, N) or one that broadcasts to it [m].
            chosen: Which pairs to look at, shape (pairs,), bool; those that may meet if None.
            hints: Directions that parted the hulls before, shape (pairs, N, 3), 0 at first; the
                better they are, the faster it goes. Those found are written to it.
        """
        import coal

        from robotid.excitation.gap_lanes import lower_bounds  # imports Numba

        chosen = self.likely if chosen is None else chosen
        bound = np.full((len(self.pairs), placed.p.shape[2]), np.inf)
        limit = np.broadcast_to(within, bound.shape)
        hints = np.zeros((*bound.shape, 3)) if hints is None else hints
        numbers, enough = np.flatnonzero(chosen), np.array(limit, order="C")
        lower_bounds(numbers, self.pairs, enough, hints, bound, placed.R, placed.p, *self._corners)
        pairs, samples = np.nonzero(bound < limit)
        hulls = self.pairs[pairs].T  # (2, k)
        centres, turns = self._stands(placed, hulls.ravel(), np.tile(samples, 2))
        shapes = [self._hulls[k].shape for k in hulls.ravel().tolist()]
        poses = [coal.Transform3s(R, x) for R, x in zip(turns, centres, strict=True)]
        count, result, exact = len(pairs), coal.DistanceResult(), np.empty(len(pairs))
        scale_check, normals = np.empty((2, count, 3)), np.empty((count, 3))
        for k in range(count):
            one, other = (shapes[k], poses[k]), (shapes[count + k], poses[count + k])
            result.clear()
            exact[k] = coal.distance(*one, *other, self._request, result)
            scale_check[:, k] = result.getNearestPoint1(), result.getNearestPoint2()
            normals[k] = result.normal
        bound[pairs, samples], hints[pairs, samples] = exact, normals
        gradient = self._gradient(placed, pairs, samples, scale_check, normals)
        return Nearness(bound, pairs, samples, gradient)

    def nearest(self, motion: Motion, duration: float) -> Contact | None:
        """Return where a motion has the least margin to a collision, between any samples, too.

        An interval of time is halved until no two hulls can come nearer within it, by what the
        joints between them can still move them, than by 1 mm what has been seen elsewhere.

        Args:
            motion: The motion.
            duration: Its length [s].

        Returns:
            The pair with the least margin, by a lower bound of its distance; None if all of them
            keep 5 cm more than they have to.

        References:
            Schwarzer, Saha, Latombe (2005), Adaptive dynamic collision checking for robots.
        """
        seen, kept = _APART, self.kept[:, None]  # seen: the least margin so far
        lowest, nearest = seen, None
        h = duration / max(2, round(duration / _FIRST)) / 2
        middles = np.arange(h, duration, 2 * h)
        a = motion.evaluate(np.linspace(0.0, duration, 40 * len(middles)))[2]
        fastest = 1.05 * np.abs(a @ self._ratios.T).max(axis=0)
        while len(middles):
            q, v, _ = motion.evaluate(middles)
            way = np.abs(v @ self._ratios.T) * h + fastest * h**2 / 2  # of each joint, (N, m)
            moved = self._levers @ way.T  # (pairs, N)
            near = self.near(self.placed(q), kept + seen + moved, self.everything)
            exact = near.distance[near.pairs, near.samples] - self.kept[near.pairs]
            if exact.min(initial=np.inf) < seen:
                k = int(np.argmin(exact))
                seen = float(exact[k])
                nearest = int(near.pairs[k]), float(middles[near.samples[k]])
            bound = near.distance - kept - moved
            is_open = (bound < seen - _SURE).any(axis=0) & (2 * h > _SHORTEST)
            lowest = min(lowest, float(bound[:, ~is_open].min(initial=np.inf)))
            h /= 2
            middles = np.sort(np.r_[middles[is_open] - h, middles[is_open] + h])
        if nearest is None:
            return None
        pair, time = nearest
        own = float(self.kept[pair])
        return Contact(*self.named[pair], min(lowest, seen) + own, time, own)

    @cached_property
    def _levers(self) -> Array:
        """How far each joint moves the hulls of a pair against each other at most, (pairs, m)."""
        tree, slides = self._model.pin_model, self._tree.slides
        lengths = np.linalg.norm([M.translation for M in tree.jointPlacements], axis=1)[1:]
        travel = {joint.name: max(-joint.lower, joint.upper) for joint in self._model.limits}
        for i in np.flatnonzero(slides).tolist():
            lengths[i] += min(travel.get(tree.names[i + 1], _WIDE), _WIDE)
        out = np.zeros((len(self.pairs), len(slides)))
        for k, (one, other) in enumerate(self.pairs.tolist()):
            two = self._hulls[one], self._hulls[other]
            apart = self._supports[two[0].body] ^ self._supports[two[1].body]
            for hull in two:
                reach, body = float(np.linalg.norm(hull.centre)) + hull.radius, hull.body
                while body >= 0 and apart[body]:
                    out[k, body] += 1.0 if slides[body] else reach
                    reach += lengths[body]
                    body = int(tree.parents[body + 1]) - 1
        return out

    @cached_property
    def _corners(self) -> tuple[Array, ...]:
        """The hulls as ``lower_bounds`` takes them."""
        hulls = self._hulls
        starts = np.cumsum([0, *(len(hull.corners) for hull in hulls)])
        of_each = zip(*[(h.body, h.centre, h.radius, h.half) for h in hulls], strict=True)
        points = np.vstack([hull.corners for hull in hulls])
        return *map(np.array, of_each), points, starts

    def _stands(self, placed: Placements, hulls: Array, samples: Array) -> tuple[Array, Array]:
        """Return where centres of k hulls are at k instants, (k, 3), and how they are turned."""
        bodies = np.array([hull.body for hull in self._hulls])[hulls]
        middles = np.array([hull.centre for hull in self._hulls])[hulls]
        turns = np.moveaxis(placed.R[:, :, bodies, samples], -1, 0)  # (k, 3, 3)
        centres = placed.p[:, bodies, samples].T + (turns @ middles[..., None])[..., 0]
        stands = bodies < 0
        turns = np.where(stands[:, None, None], np.eye(3), turns)
        return np.where(stands[:, None], middles, centres), np.ascontiguousarray(turns)

    def _gradient(
        self, placed: Placements, pairs: Array, samples: Array, scale_check: Array, normals: Array
    ) -> Array:
        """Return what distances change by with each joint: normal . (velocity of the points)."""
        slides = self._tree.slides[:, None]
        axes = np.einsum("cdjk,jd->kjc", placed.R[..., samples], self._tree.axes)  # in the world
        origins = placed.p[..., samples].T  # (k, m, 3)
        bodies = np.array([hull.body for hull in self._hulls])[self.pairs[pairs]]  # (k, 2)
        out = np.zeros(axes.shape[:2])
        for side, sign in ((0, -1.0), (1, 1.0)):
            levers = np.cross(axes, scale_check[side][:, None] - origins)
            along = np.einsum("kjc,kc->kj", np.where(slides, axes, levers), normals)
            out += sign * np.where(self._supports[bodies[:, side]], along, 0.0)
        by_joint: Array = out @ self._ratios
        return by_joint


def _hull(name: str, body: int, points: Array) -> _Hull:
    """Return the convex hull of points; a flat one as the box around it."""
    import coal
    from scipy.spatial import ConvexHull

    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    about = points - centre
    radius = float(np.linalg.norm(about, axis=1).max())
    extent = np.ptp(about, axis=0)  # the centre is the middle of it
    is_flat = np.linalg.matrix_rank(about, tol=_THINNEST) < 3
    if is_flat or (len(points) == 8 and np.allclose(np.abs(about), extent / 2)):
        extent, radius = np.maximum(extent, _THINNEST), radius + is_flat * _THINNEST
        corners = _SIGNS * extent / 2
        return _Hull(name, body, centre, radius, extent / 2, corners, coal.Box(*extent))
    corners = np.unique(np.round(about, 6), axis=0)
    corners = corners[ConvexHull(corners).vertices]
    listed_ones = coal.StdVec_Vec3s()
    for corner in corners:
        listed_ones.append(corner)
    shape = coal.ConvexBase.convexHull(listed_ones, False, "Qt")
    return _Hull(name, body, centre, radius, extent / 2, corners, shape)


def _corners(box: Box) -> Array:
    low, high = np.array(box.low), np.array(box.high)
    if not (low < high).all():
        raise SettingsError(
            f"box {box.name!r} reaches from {listed(map(str, box.low))} to "
            f"{listed(map(str, box.high))}, wanted a low corner below the high one in x, y and z"
        )
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
