"""Distances between the links of a moving robot, and to the floor and to boxes.

Every shape is replaced by its convex hull, which contains it. Distances between hulls are computed
by coal, where spheres and boxes around them do not show that they are apart. A hull moves with the
screws of the joints before it, so a distance has an exact gradient.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.design.information import Placements, fixed_tree
from robotid.dynamics.simulation.motions import Motion
from robotid.robot.bodies import link_clouds
from robotid.robot.model import RobotModel

#: Distance whose violation has the cost of a whole limit of the motion [m]; links that are farther
#: apart in all random poses are checked in the end only.
SOFT = 0.05
#: Random poses by which the pairs of links that may meet are found, and postures are chosen.
POSES = 400
_ALMOST_ALL = 0.95  # share of the poses
# [m] hulls at a smaller distance touch; thickness of a flat shape; twice the error of lower bounds
_TOUCH = 1e-3
_CLOSE = 5e-3  # [m] beyond the clearance: links within it are close by design
_FIRST = 0.05  # [s] the first intervals in which a motion is checked ...
_SHORTEST = 1e-3  # [s] ... and the shortest
_WIDE = 100.0  # [m] extent of the floor
_SPARE = 0.002  # [m] reserve of distances for the motion between samples ...
_EXACT = 0.01  # [m] ... and margin below which distances are exact, but both at most ...
_SLACK = 0.25  # ... this share of the slack of links that are close by design


@dataclass(frozen=True)
class Box:
    """A box at rest beside the robot, in the frame of the root link."""

    name: str
    low: tuple[float, float, float]  # its lower corner [m]
    high: tuple[float, float, float]  # its upper corner [m]


@dataclass(frozen=True)
class Contact:
    """The smallest distance between two shapes."""

    first: str  # name of one
    second: str  # name of the other
    distance: float  # between their hulls, below 0 if they overlap [m]
    time: float  # time [s]
    required: float = 0.0  # required distance between them [m]

    @property
    def margin(self) -> float:
        """Distance minus the required one [m]."""
        return self.distance - self.required

    def __str__(self) -> str:
        is_clear = self.distance > 0
        words = f"approach to {1e3 * self.distance:.0f} mm" if is_clear else "overlap"
        return f"{self.first} and {self.second} {words} at {self.time:.2f} s"


@dataclass(frozen=True, eq=False)
class Nearness:
    """Distances of near pairs along a motion."""

    distance: Array  # shape (pairs, N) [m]; a lower bound beyond the distance asked for
    pairs: Array  # (k,), pair of each distance that has a gradient
    samples: Array  # (k,), sample of each
    gradient: Array  # (k, n), of each by the joints [m/rad or 1]


@dataclass(frozen=True, eq=False)
class _Hull:
    """A convex piece of a link, or of a fixed shape (body -1), in the frame of its body."""

    name: str
    body: int
    centre: Array
    radius: float
    half: Array  # of the box around it, in that frame, shape (3,)
    shape: Any  # of coal, about the centre


class Clearance:
    """The distances of a robot's links to each other, to the floor and to obstacles.

    Links joined by a joint are not checked, nor two links whose hulls touch at zero position and in
    95 % of random poses. Of two links that are nearer than the clearance in 95 % of the poses, but
    do not always touch, half their median distance is required.
    """

    pairs: Array  # (pairs, 2), numbers of the two hulls of each pair
    likely: Array  # (pairs,), bool, which may meet within the limits
    required: Array  # (pairs,), required distance [m]
    slack: Array  # (pairs,), median distance beyond it of those close by design [m]; inf of others
    unread: list[str]  # links of which a shape cannot be read: they are not checked
    made_to: list[str]  # links in contact by design, by two, with their smallest distance
    built_near: list[str]  # links that are close by design, by two, with the required distance

    def __init__(
        self,
        model: RobotModel,
        *,
        least: float = 0.02,
        floor: float | None = None,
        boxes: Sequence[Box] = (),
    ) -> None:
        import coal

        if not least >= 0:
            raise SettingsError(f"clearance is {least}, expected 0 m or more")
        self.least, self._model, self._tree = least, model, fixed_tree(model)
        self._ratios = model.velocity_map  # of joints by body, (m, n)
        clouds, self.unread = link_clouds(model)
        if not clouds:
            raise DataError(
                f"{model.tree.path} has no shape that can be read, so collisions cannot be "
                "checked; give it collision geometry, or omit the check (--clearance none)"
            )
        self._hulls = [_hull(name, body, points) for name, body, points in clouds]
        self._hulls += [_hull(box.name, -1, _corners(box)) for box in boxes]
        if floor is not None:
            below = Box("the floor", (-_WIDE, -_WIDE, floor - _WIDE), (_WIDE, _WIDE, floor))
            self._hulls.append(_hull(below.name, -1, _corners(below)))
        self._request = coal.DistanceRequest(True, True)
        self._bodies = np.array([hull.body for hull in self._hulls])
        self._middles = np.array([hull.centre for hull in self._hulls])
        is_below = self._tree.is_below
        # which joints move which body, (m + 1, m), bool; the last row is at rest
        self._supports = np.vstack([is_below, np.zeros(len(is_below), dtype=bool)])
        self.pairs = self._possible_pairs()
        self._classify(np.random.default_rng(0))

    def _possible_pairs(self) -> Array:
        """Return pairs that can move against each other: not links that a joint joins."""
        tree, hulls = self._model.pin_model, self._hulls
        joined = {(int(tree.parents[i]) - 1, i - 1) for i in range(1, tree.njoints)}
        pairs = []
        for i, j in combinations(range(len(hulls)), 2):
            a, b = sorted((hulls[i].body, hulls[j].body))
            is_link = hulls[j].name in self._model.tree.links
            if a != b and not (is_link and (a, b) in joined):
                pairs.append((i, j))
        return np.array(pairs, dtype=int).reshape(-1, 2)

    def _classify(self, rng: np.random.Generator) -> None:
        """Find by random poses which pairs may meet, are in contact, or are close by design."""
        low = [j.lower if j.has_limits else -np.pi for j in self._model.limits]
        high = [j.upper if j.has_limits else np.pi for j in self._model.limits]
        q = np.vstack([np.clip(0.0, low, high), rng.uniform(low, high, (POSES, len(low)))])
        distance = self.near(self.placed(q), self.least + SOFT, self.everything).distance
        is_link = np.array([hull.name in self._model.tree.links for hull in self._hulls])
        are_links = np.all(is_link[self.pairs], axis=1)
        touch = np.less(distance, _TOUCH)
        always = are_links & touch[:, 0] & (touch.mean(axis=1) > _ALMOST_ALL)
        self.made_to = self._listed(always, distance.min(axis=1))
        self.pairs, distance, touch = self.pairs[~always], distance[~always], touch[~always]
        near = (distance < self.least + _CLOSE).mean(axis=1) > _ALMOST_ALL
        near &= are_links[~always] & ~touch.all(axis=1)
        self.required, self.slack = np.full(len(near), self.least), np.full(len(near), np.inf)
        for k in np.flatnonzero(near):
            median = float(np.median(distance[k, ~touch[k]]))
            self.required[k] = min(self.least, median / 2)
            self.slack[k] = median - self.required[k]
        self.built_near = self._listed(near, self.required)
        distant = self.required + np.minimum(SOFT, self.slack / 2)
        self.likely = distance.min(axis=1, initial=np.inf) < distant

    def _listed(self, chosen: Array, distance: Array) -> list[str]:
        """Return the links of pairs and their smallest distances as text, each two once."""
        least: dict[tuple[str, str], float] = {}
        for k in np.flatnonzero(chosen).tolist():
            names = self.named[k]
            least[names] = min(least.get(names, np.inf), float(distance[k]))
        return [
            f"{a} and {b} ({'overlap by ' * (d < 0)}{abs(1e3 * d):.0f} mm)"
            for (a, b), d in least.items()
        ]

    @cached_property
    def movers(self) -> Array:
        """Which joints move the hulls of each pair against each other, shape (pairs, n), bool."""
        return np.asarray((self._levers > 0.0) @ np.abs(self._ratios) > 0.0)

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
        """Reserve of the distances for the motion between samples, shape (pairs, 1) [m]."""
        return np.minimum(_SPARE, _SLACK * self.slack)[:, None]

    def margins(self, placed: Placements, spare: float) -> Array:
        """Return margins of distances, shape (pairs, N) [m]; a lower bound of those over 1 cm."""
        required = self.required[:, None] + spare * self.spare
        exact = np.minimum(_EXACT, _SLACK * self.slack)[:, None]
        return self.near(placed, required + exact).distance - required

    def placed(self, q: Array) -> Placements:
        """Return the poses of the bodies: q (N, n) [rad or m]."""
        return Placements.along(self._tree, q)

    def near(
        self, placed: Placements, within: float | Array, chosen: Array | None = None
    ) -> Nearness:
        """Return the distances of pairs along a motion, exact where they are near."""
        import coal

        chosen = self.likely if chosen is None else chosen
        bound = self._apart(placed, chosen)
        limit = np.broadcast_to(within, bound.shape)
        pairs, samples = np.nonzero(bound < limit)
        hulls = self.pairs[pairs].T  # (2, k)
        centres, rotations = self._poses(placed, hulls, samples)
        by_boxes = self._between_boxes(hulls, centres, rotations)
        bound[pairs, samples] = np.maximum(bound[pairs, samples], by_boxes)
        is_near = bound[pairs, samples] < limit[pairs, samples]
        pairs, samples = pairs[is_near], samples[is_near]
        shapes = [[self._hulls[k].shape for k in side] for side in hulls[:, is_near].tolist()]
        both = zip(*shapes, *rotations[:, is_near], *centres[:, is_near], strict=True)
        first, other, result = coal.Transform3s(), coal.Transform3s(), coal.DistanceResult()
        exact, (*points, normals) = np.empty(len(pairs)), np.empty((3, len(pairs), 3))
        for k, (A, B, R_A, R_B, p_A, p_B) in enumerate(both):
            first.setTransform(R_A, p_A)
            other.setTransform(R_B, p_B)
            result.clear()
            exact[k] = coal.distance(A, first, B, other, self._request, result)
            points[0][k], points[1][k] = result.getNearestPoint1(), result.getNearestPoint2()
            normals[k] = result.normal
        bound[pairs, samples] = exact
        gradient = self._gradient(placed, pairs, samples, points, normals)
        return Nearness(bound, pairs, samples, gradient)

    def nearest(self, motion: Motion, duration: float) -> Contact | None:
        """Return the smallest margin of a motion to a collision, at all times.

        Intervals are halved until, by the largest motion within one, no margin is 0.5 mm below the
        smallest one elsewhere (Schwarzer, Saha, Latombe 2005, Adaptive dynamic collision checking).
        """
        smallest, required = SOFT, self.required[:, None]  # smallest: margin so far
        lowest, nearest = smallest, None
        h = duration / max(2, round(duration / _FIRST)) / 2
        middles = np.arange(h, duration, 2 * h)
        a = motion.evaluate(np.linspace(0.0, duration, 40 * len(middles)))[2]
        fastest = 1.05 * np.abs(a @ self._ratios.T).max(axis=0)
        while len(middles):
            q, v, _ = motion.evaluate(middles)
            way = np.abs(v @ self._ratios.T) * h + fastest * h**2 / 2  # of each joint, (N, m)
            moved = self._levers @ way.T  # (pairs, N)
            near = self.near(self.placed(q), required + smallest + moved, self.everything)
            exact = near.distance[near.pairs, near.samples] - self.required[near.pairs]
            if exact.min(initial=np.inf) < smallest:
                k = int(np.argmin(exact))
                smallest = float(exact[k])
                nearest = int(near.pairs[k]), float(middles[near.samples[k]])
            bound = near.distance - required - moved
            is_open = (bound < smallest - _TOUCH / 2).any(axis=0) & (2 * h > _SHORTEST)
            lowest = min(lowest, float(bound[:, ~is_open].min(initial=np.inf)))
            h /= 2
            middles = np.sort(np.r_[middles[is_open] - h, middles[is_open] + h])
        if nearest is None:
            return None
        pair, time = nearest
        least = float(self.required[pair])
        return Contact(*self.named[pair], min(lowest, smallest) + least, time, least)

    @cached_property
    def _levers(self) -> Array:
        """Largest relative motion of a pair's hulls per motion of each joint, (pairs, m)."""
        tree, prismatic = self._model.pin_model, self._tree.prismatic
        lengths = np.linalg.norm([M.translation for M in tree.jointPlacements], axis=1)[1:]
        travel = {joint.name: max(-joint.lower, joint.upper) for joint in self._model.limits}
        for i in np.flatnonzero(prismatic).tolist():
            lengths[i] += min(travel.get(tree.names[i + 1], _WIDE), _WIDE)
        out = np.zeros((len(self.pairs), len(prismatic)))
        for k, (one, other) in enumerate(self.pairs.tolist()):
            two = self._hulls[one], self._hulls[other]
            between = self._supports[two[0].body] ^ self._supports[two[1].body]
            for hull in two:
                lever, body = float(np.linalg.norm(hull.centre)) + hull.radius, hull.body
                while body >= 0 and between[body]:
                    out[k, body] += 1.0 if prismatic[body] else lever
                    lever += lengths[body]
                    body = int(tree.parents[body + 1]) - 1
        return out

    def _apart(self, placed: Placements, chosen: Array) -> Array:
        """Return the distances of the spheres around chosen pairs, (pairs, N); inf of others."""
        bodies, middles = self._bodies, self._middles
        radii = np.array([hull.radius for hull in self._hulls])
        turned = np.einsum("cdhn,hd->chn", placed.R[:, :, bodies], middles)
        is_fixed = (bodies < 0)[:, None]
        centres = np.where(is_fixed, middles.T[:, :, None], turned + placed.p[:, bodies])
        first, second = self.pairs[chosen].T
        bound = np.full((len(self.pairs), placed.p.shape[2]), np.inf)
        between = np.linalg.norm(centres[:, second] - centres[:, first], axis=0)
        bound[chosen] = between - (radii[first] + radii[second])[:, None]
        return bound

    def _between_boxes(self, hulls: Array, centres: Array, rotations: Array) -> Array:
        """Return the largest gaps of k pairs of boxes along one of their sides, (k,) [m]."""
        half = np.array([hull.half for hull in self._hulls])[hulls]  # (2, k, 3)
        sides = np.concatenate([*rotations], axis=2).swapaxes(1, 2)  # (k, 6, 3)
        reach = np.abs(sides @ rotations) @ half[..., None]  # (2, k, 6, 1)
        gaps = np.abs(sides @ (centres[1] - centres[0])[..., None]) - reach.sum(axis=0)
        return np.asarray(gaps.max(axis=(1, 2), initial=-np.inf))

    def _poses(self, placed: Placements, hulls: Array, samples: Array) -> tuple[Array, Array]:
        """Return centres (2, k, 3) and rotations (2, k, 3, 3) of hulls (2, k) at samples (k,)."""
        bodies, middles = self._bodies[hulls], self._middles[hulls]
        rotations = np.moveaxis(placed.R[:, :, bodies, samples], (0, 1), (2, 3))
        centres = np.moveaxis(placed.p[:, bodies, samples], 0, 2)
        centres = centres + (rotations @ middles[..., None])[..., 0]
        is_fixed = (bodies < 0)[..., None]
        rotations = np.where(is_fixed[..., None], np.eye(3), rotations)
        return np.where(is_fixed, middles, centres), np.ascontiguousarray(rotations)

    def _gradient(
        self, placed: Placements, pairs: Array, samples: Array, points: list[Array], normals: Array
    ) -> Array:
        """Return distances' derivatives by each joint: normal . (velocity of nearest points)."""
        prismatic = self._tree.prismatic[:, None]
        axes = np.einsum("cdjk,jd->kjc", placed.R[..., samples], self._tree.axes)  # in the world
        origins = placed.p[..., samples].T  # (k, m, 3)
        bodies = self._bodies[self.pairs[pairs]]  # (k, 2)
        out = np.zeros(axes.shape[:2])
        for side, sign in ((0, -1.0), (1, 1.0)):
            levers = np.cross(axes, points[side][:, None] - origins)
            along = np.einsum("kjc,kc->kj", np.where(prismatic, axes, levers), normals)
            out += sign * np.where(self._supports[bodies[:, side]], along, 0.0)
        return np.asarray(out @ self._ratios)


def _hull(name: str, body: int, points: Array) -> _Hull:
    """Return the convex hull of points; a flat one as the box around it."""
    import coal
    from scipy.spatial import ConvexHull

    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    about = points - centre
    radius = float(np.linalg.norm(about, axis=1).max())
    extent = np.ptp(about, axis=0)  # the centre is the middle of it
    is_flat = np.linalg.matrix_rank(about, tol=_TOUCH) < 3
    if is_flat or (len(points) == 8 and np.allclose(np.abs(about), extent / 2)):
        extent, radius = np.maximum(extent, _TOUCH), radius + is_flat * _TOUCH
        return _Hull(name, body, centre, radius, extent / 2, coal.Box(*extent))
    corners = np.unique(np.round(about, 6), axis=0)
    corners = corners[ConvexHull(corners).vertices]
    listed_ones = coal.StdVec_Vec3s()
    for corner in corners:
        listed_ones.append(corner)
    shape = coal.ConvexBase.convexHull(listed_ones, False, "Qt")
    return _Hull(name, body, centre, radius, extent / 2, shape)


def _corners(box: Box) -> Array:
    low, high = np.array(box.low), np.array(box.high)
    if not (low < high).all():
        raise SettingsError(
            f"box {box.name!r} reaches from {listed(map(str, box.low))} to "
            f"{listed(map(str, box.high))}, expected a low corner below the high one in x, y and z"
        )
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
