"""Lower bounds of the distances between hulls along a motion, compiled by Numba.

Imported only where a motion is designed. For any direction, the gap of two hulls along it is a
lower bound of their distance. The directions are, in this order: the sides of the boxes around the
hulls, the best direction of the last call, and those of Frank and Wolfe's iteration to the point of
B - A nearest to 0. The iteration ends where a bound suffices, or where that point shows that the
distance is smaller than asked for.

References:
    Gilbert, Johnson, Keerthi (1988), A fast procedure for computing the distance between complex
    objects in three-dimensional space.
"""

import numpy as np

from robotid.dynamics.kernels.lanes import compiled

_STEPS = 20  # largest number of iterations


@compiled
def _farthest(points, first, last, x, y, z):
    """Return the farthest of some points along a direction."""
    best, most = first, -np.inf
    for k in range(first, last):
        extent = x * points[k, 0] + y * points[k, 1] + z * points[k, 2]
        if extent > most:
            best, most = k, extent
    return best


@compiled
def _support(hull, n, R, centres, bodies, points, starts, x, y, z):
    """Return the farthest point of a hull along a direction of the world."""
    body, first, last = bodies[hull], starts[hull], starts[hull + 1]
    if body < 0:
        k = _farthest(points, first, last, x, y, z)
        a, b, c = points[k, 0], points[k, 1], points[k, 2]
    else:
        k = _farthest(
            points, first, last,
            R[0, 0, body, n] * x + R[1, 0, body, n] * y + R[2, 0, body, n] * z,
            R[0, 1, body, n] * x + R[1, 1, body, n] * y + R[2, 1, body, n] * z,
            R[0, 2, body, n] * x + R[1, 2, body, n] * y + R[2, 2, body, n] * z,
        )  # fmt: skip
        u, v, w = points[k, 0], points[k, 1], points[k, 2]
        a = R[0, 0, body, n] * u + R[0, 1, body, n] * v + R[0, 2, body, n] * w
        b = R[1, 0, body, n] * u + R[1, 1, body, n] * v + R[1, 2, body, n] * w
        c = R[2, 0, body, n] * u + R[2, 1, body, n] * v + R[2, 2, body, n] * w
    return a + centres[0, hull, n], b + centres[1, hull, n], c + centres[2, hull, n]


@compiled
def _side(hull, c, n, R, bodies):
    """Return the direction of side c of the box around a hull."""
    body = bodies[hull]
    if body < 0:
        return 1.0 * (c == 0), 1.0 * (c == 1), 1.0 * (c == 2)
    return R[0, c, body, n], R[1, c, body, n], R[2, c, body, n]


@compiled
def _boxes(i, j, n, bound, R, centres, bodies, half):
    """Return a lower bound by the projections of the boxes on their sides' directions."""
    x = centres[0, j, n] - centres[0, i, n]
    y = centres[1, j, n] - centres[1, i, n]
    z = centres[2, j, n] - centres[2, i, n]
    for own in (i, j):
        for c in range(3):
            u, v, w = _side(own, c, n, R, bodies)
            gap = abs(u * x + v * y + w * z)
            for hull in (i, j):
                for d in range(3):
                    a, b, e = _side(hull, d, n, R, bodies)
                    gap -= half[hull, d] * abs(u * a + v * b + w * e)
            bound = max(bound, gap)
    return bound


@compiled
def _along(i, j, n, x, y, z, R, centres, bodies, points, starts):
    """Return the lowest point of B - A along a direction."""
    a = _support(i, n, R, centres, bodies, points, starts, x, y, z)
    b = _support(j, n, R, centres, bodies, points, starts, -x, -y, -z)
    return b[0] - a[0], b[1] - a[1], b[2] - a[2]


@compiled
def _bound(i, j, n, enough, bound, hint, R, centres, bodies, points, starts):
    """Return a lower bound of the distance of two hulls at one sample, at least ``bound``.

    ``hint`` is the first direction tried; it is replaced by the best one.
    """
    hulls = R, centres, bodies, points, starts
    if hint[0] != 0.0 or hint[1] != 0.0 or hint[2] != 0.0:
        w = _along(i, j, n, hint[0], hint[1], hint[2], *hulls)
        bound = max(bound, w[0] * hint[0] + w[1] * hint[1] + w[2] * hint[2])
        if bound >= enough:
            return bound
    x = centres[0, j, n] - centres[0, i, n]
    y = centres[1, j, n] - centres[1, i, n]
    z = centres[2, j, n] - centres[2, i, n]
    for _ in range(_STEPS):
        size = np.sqrt(x * x + y * y + z * z)
        if size < 1e-9:
            return bound
        u, v, t = x / size, y / size, z / size
        w = _along(i, j, n, u, v, t, *hulls)
        gap = w[0] * u + w[1] * v + w[2] * t
        if gap > bound:
            bound = gap
            hint[0], hint[1], hint[2] = u, v, t
        dx, dy, dz = w[0] - x, w[1] - y, w[2] - z
        step = dx * dx + dy * dy + dz * dz
        if bound >= enough or step < 1e-18:
            return bound
        share = min(max(-(x * dx + y * dy + z * dz) / step, 0.0), 1.0)
        x, y, z = x + share * dx, y + share * dy, z + share * dz
        if x * x + y * y + z * z < enough * enough:  # a point of B - A: no bound will suffice
            return bound
    return bound


@compiled
def _centres(R, p, bodies, middles):
    """Return the middles of hulls in the world, shape (3, h, N)."""
    N = p.shape[2]
    centres = np.empty((3, len(bodies), N))
    for h in range(len(bodies)):
        i, x, y, z = bodies[h], middles[h, 0], middles[h, 1], middles[h, 2]
        for c in range(3):
            for n in range(N):
                centres[c, h, n] = middles[h, c]
                if i >= 0:
                    turned = R[c, 0, i, n] * x + R[c, 1, i, n] * y + R[c, 2, i, n] * z
                    centres[c, h, n] = p[c, i, n] + turned
    return centres


@compiled
def lower_bounds(
    chosen, pairs, enough, hints, out, R, p, bodies, middles, radii, half, points, starts
):
    """Write lower bounds of the distances of pairs of hulls [m].

    pairs (pairs, 2), enough (pairs, N) [m], hints (pairs, N, 3), out (pairs, N), R (3, 3, m,
    N), p (3, m, N) [m], bodies (h,), middles (h, 3) [m], radii (h,) [m], half (h, 3) [m],
    points (k, 3) [m], starts (h + 1,).
    """
    centres = _centres(R, p, bodies, middles)
    for k in chosen:
        i, j = pairs[k, 0], pairs[k, 1]
        for n in range(p.shape[2]):
            x = centres[0, j, n] - centres[0, i, n]
            y = centres[1, j, n] - centres[1, i, n]
            z = centres[2, j, n] - centres[2, i, n]
            gap = np.sqrt(x * x + y * y + z * z) - radii[i] - radii[j]
            if gap < enough[k, n]:
                gap = _boxes(i, j, n, gap, R, centres, bodies, half)
            if gap < enough[k, n]:
                gap = _bound(
                    i, j, n, enough[k, n], gap, hints[k, n], R, centres, bodies, points, starts
                )  # fmt: skip
            out[k, n] = gap
