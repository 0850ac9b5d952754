"""Fewer triangles: surfaces of a robot light enough for a page, closed where they were."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.robot.meshes import Surface, joined

__all__ = ["thin"]

_CREASE = np.radians(30.0)  # faces that meet at a sharper angle than this show an edge
_WELD = 1e-6  # corners this near are one, over the size of the largest surface
_FIRST_CELL = 1 / 4000  # the same where there are far too many: those of one cell of a grid ...
_CHEAP = 0.5  # share of the edges that a pass may collapse
_RIM = 20.0  # weight of the rim of a surface over that of the surface
_FINE = 4  # ... until so many times too many triangles are left


def thin(solids: Sequence[Sequence[Surface]], most: int) -> list[list[Surface]]:
    """Return surfaces with so few triangles together: closed where they were, edges kept sharp.

    Edges are collapsed, those first that change the shape least; an edge that becomes a point
    opens no hole. The triangles of a surface turn the same way, outwards where it is closed, and
    each side of a sharp edge has a corner of its own.

    Args:
        solids: The surfaces of each file of a robot, all in one scale; those of one file are
            patches of one surface.
        most: Triangles that may be left of all of them.

    References:
        Garland, Heckbert (1997), Surface simplification using quadric error metrics.
    """
    patches = [surface for solid in solids for surface in solid]
    if not patches:
        return [[] for _ in solids]
    solid = np.repeat(np.arange(len(solids)), [len(s) for s in solids])  # of each patch
    whole = joined(patches)
    patch = np.repeat(np.arange(len(patches)), [len(s.faces) for s in patches])
    of_vertex = np.repeat(solid, [len(s.vertices) for s in patches])
    cell = _WELD * (float(np.ptp(whole.vertices, axis=0).max()) or 1.0)
    which, V = _cells(whole.vertices, of_vertex, cell)
    F, patch = _proper(which[whole.faces], patch)
    if not len(F):  # all triangles are flat
        return [[] for _ in solids]
    F = _oriented(V, F)
    of_vertex = np.rint(np.bincount(which, of_vertex) / np.bincount(which)).astype(int)
    Q = _quadrics(V, F, patch)
    cell *= _FIRST_CELL / _WELD
    while len(F) > _FINE * most:  # collapsing half a million would take too long
        which, V = _cells(V, of_vertex, cell)
        F, patch = _proper(which[F], patch)
        of_vertex = np.rint(np.bincount(which, of_vertex) / np.bincount(which)).astype(int)
        Q = np.column_stack([np.bincount(which, x) for x in Q.reshape(-1, 16).T])
        Q = Q.reshape(-1, 4, 4)
        V = _lowest(Q, V, np.full(len(V), cell))
        cell *= min(max(np.sqrt(len(F) / (_FINE * most)), 1.2), 2.0)
    V, F, patch = _collapsed(V, F, patch, Q, most)
    is_open = np.unique(solid[patch[_open_faces(F)]])
    left = [
        _creased(Surface(V, F[patch == k], p.rgba, solid[k] not in is_open))
        for k, p in enumerate(patches)
    ]
    return [[s for s, k in zip(left, solid, strict=True) if k == i] for i in range(len(solids))]


def _cells(V: Array, solid: Array, cell: float) -> tuple[Array, Array]:
    """Return the cell of its solid's grid that each corner lies in, and the mean of each cell."""
    keys = solid.astype(np.int64)
    for column in np.floor((V - V.min(axis=0)) / cell + 0.5).astype(np.int64).T:
        _, keys = np.unique(keys * (column.max() + 1) + column, return_inverse=True)
    count = np.bincount(keys)
    return keys, np.column_stack([np.bincount(keys, x) / count for x in V.T])


def _proper(F: Array, patch: Array) -> tuple[Array, Array]:
    """Return the triangles that are none of a line, one of those on the same three corners."""
    F, patch = (x[(np.roll(F, 1, axis=1) != F).all(axis=1)] for x in (F, patch))
    _, first = np.unique(_keys(np.sort(F, axis=1)), return_index=True)
    first.sort()
    return F[first], patch[first]


def _keys(rows: Array) -> Array:
    """Return one number for each row of indices."""
    n = np.int64(rows.max(initial=0) + 1)  # below 2 million, whose cube is a number yet
    key = rows[:, 0].astype(np.int64)
    for column in rows.T[1:]:
        key = key * n + column
    return key


def _edges(F: Array) -> tuple[Array, Array, Array]:
    """Return the sides (3 F, 2) of triangles, their faces, and whether they were turned to sort."""
    ends = np.stack([F, np.roll(F, -1, axis=1)], axis=2).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends = np.where(turned[:, None], ends[:, ::-1], ends)
    order = np.argsort(_keys(ends), kind="stable")
    return ends[order], order // 3, turned[order]


def _open_faces(F: Array) -> Array:
    """Return the triangles with a side that is not that of one other, which runs it backwards."""
    ends, face, turned = _edges(F)
    starts = np.flatnonzero(np.r_[True, (ends[1:] != ends[:-1]).any(axis=1)])
    sides = np.diff(np.r_[starts, len(ends)])
    senses = np.add.reduceat(turned.astype(int), starts)
    open_faces: Array = face[np.repeat((sides != 2) | (senses != 1), sides)]
    return open_faces


def _oriented(V: Array, F: Array) -> Array:
    """Return the triangles with one sense of turning on each connected surface, outwards."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends, face, turned = _edges(F)
    same = (ends[1:] == ends[:-1]).all(axis=1)
    alone = ~np.r_[False, same[:-1]] & same & ~np.r_[same[1:], False]  # two faces, no third
    k = np.flatnonzero(alone)
    f, g, odd = face[k], face[k + 1], turned[k] == turned[k + 1]  # neighbours turn an edge apart
    n = len(F)  # f stands for a face as it is, f + n for its reverse
    rows, columns = np.r_[f, f + n], np.r_[g + n * odd, g + n * ~odd]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    corners = V[F] - V.mean(axis=0)
    volume = np.linalg.det(corners) / 6  # of the tetrahedron to the middle
    sums = np.bincount(part, np.r_[volume, -volume])
    reverse = (part[:n] != part[n:]) & (sums[part[:n]] < sums[part[n:]])
    return np.where(reverse[:, None], F[:, ::-1], F)


def _collapsed(V: Array, F: Array, patch: Array, Q: Array, most: int) -> tuple[Array, Array, Array]:
    """Return corners and triangles after so many edges became points that few enough are left."""
    careful = True
    while len(F) > most:
        sides, face, _ = _edges(F)
        first = np.r_[True, (sides[1:] != sides[:-1]).any(axis=1)]
        ends = sides[first]
        place, cost = _best_places(V, Q, ends)
        chosen = _apart(len(V), F, ends, cost, (np.cumsum(first) - 1)[np.argsort(face)])
        if careful:
            chosen = chosen[_is_simple(len(V), ends, chosen)]
            chosen = chosen[~_folds(V, F, ends[chosen], place[chosen])]
            careful = len(chosen) > 0.002 * len(ends)  # or nothing is left that could be done well
        chosen = chosen[: (len(F) - most + 1) // 2]
        keep, drop = ends[chosen].T
        V, which = V.copy(), np.arange(len(V))
        V[keep], which[drop] = place[chosen], keep
        Q[keep] += Q[drop]
        F, patch = _proper(which[F], patch)
    return V, F, patch


def _apart(n: int, F: Array, ends: Array, cost: Array, sides: Array) -> Array:
    """Return the edges that cost less than all of the triangles at their ends, in order of cost.

    Args:
        n: Number of corners.
        F: Triangles, shape (F, 3).
        ends: Corners of each edge, shape (E, 2).
        cost: What each costs, shape (E,).
        sides: The edges of the triangles, three by three, shape (3 F,).
    """
    order = np.argsort(cost)
    rank = np.empty(len(ends), dtype=np.int64)
    rank[order] = np.arange(len(ends))
    lowest = rank[sides.reshape(-1, 3)].min(axis=1)  # of each triangle
    about = np.full(n, len(ends))
    np.minimum.at(about, F.ravel(), np.repeat(lowest, 3))
    taken = (about[ends] == rank[:, None]).all(axis=1) & (rank < _CHEAP * len(ends))
    apart: Array = order[taken[order]]
    return apart


def _is_simple(n: int, ends: Array, chosen: Array) -> Array:
    """Return which edges can be points without laying two triangles upon each other."""
    from scipy.sparse import coo_array

    both = np.vstack([ends, ends[:, ::-1]])
    near = coo_array((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(n, n)).tocsr()
    shared = near[ends[chosen, 0]].multiply(near[ends[chosen, 1]]).sum(axis=1)
    is_simple: Array = np.asarray(shared).ravel() <= 2  # the tips of its triangles
    owner = np.full(n, -1)
    owner[ends[chosen].ravel()] = np.repeat(np.arange(len(chosen)), 2)
    pairs = np.sort(owner[ends], axis=1)  # of chosen edges that another edge joins
    pairs = pairs[(pairs[:, 0] >= 0) & (pairs[:, 0] < pairs[:, 1])]
    _, first, count = np.unique(_keys(pairs), return_index=True, return_counts=True)
    is_simple[pairs[first[count > 1], 1]] = False  # two do: the dearer one waits
    return is_simple


def _quadrics(V: Array, F: Array, patch: Array) -> Array:
    """Return the quadric (4, 4) of each corner: squared distance to its triangles' planes."""
    from scipy.sparse import coo_array

    n = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])  # (F, 3), twice the area
    area = np.linalg.norm(n, axis=1)
    n /= np.maximum(area, 1e-30)[:, None]
    ends, face, _ = _edges(F)
    same = (ends[1:] == ends[:-1]).all(axis=1) & (patch[face[1:]] == patch[face[:-1]])
    rim = ~(np.r_[False, same] | np.r_[same, False])  # of a surface, or of a colour
    along = V[ends[rim, 1]] - V[ends[rim, 0]]
    across = np.cross(along, n[face[rim]])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    normals, weights = np.vstack([n, across]), np.r_[area, _RIM * (along**2).sum(axis=1)]
    on = np.r_[V[F[:, 0]], V[ends[rim, 0]]]
    plane = np.column_stack([normals, -(normals * on).sum(axis=1)])  # (P, 4)
    K = weights[:, None, None] * plane[:, :, None] * plane[:, None, :]
    rows = np.r_[F.T.ravel(), ends[rim].T.ravel()]
    columns = np.r_[np.tile(np.arange(len(F)), 3), np.tile(np.arange(len(F), len(K)), 2)]
    S = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(V), len(K)))
    Q: Array = (S.tocsr() @ K.reshape(-1, 16)).reshape(-1, 4, 4)
    return Q


def _best_places(V: Array, Q: Array, ends: Array) -> tuple[Array, Array]:
    """Return where each edge becomes a point, shape (E, 3), and the quadric there."""
    q = Q[ends[:, 0]] + Q[ends[:, 1]]
    one, other = V[ends[:, 0]], V[ends[:, 1]]
    length = np.linalg.norm(other - one, axis=1)
    place = _lowest(q, (one + other) / 2, length)
    x = np.column_stack([place, np.ones(len(place))])
    cost = np.einsum("ei,eij,ej->e", x, q, x)
    # on a plane all cost nothing: short edges first, and not all those side by side
    spread = 1.0 + (0.618034 * np.arange(len(ends))) % 1.0
    size = q[:, 0, 0] + q[:, 1, 1] + q[:, 2, 2]
    return place, np.maximum(cost, 0.0) + 1e-8 * size * length**2 * spread


def _lowest(Q: Array, near: Array, far: Array) -> Array:
    """Return the places of the least quadrics, shape (E, 3), those not too far from others."""
    (a, b, c, g), (_, d, e, h), (_, _, f, k), _ = np.ascontiguousarray(Q.transpose(1, 2, 0))
    x, y, z = np.ascontiguousarray(near.T)
    ridge = 1e-6 * (a + d + f + 1e-30)  # along a plane they stay where they are
    slope = a * x + b * y + c * z + g, b * x + d * y + e * z + h, c * x + e * y + f * z + k
    step = _solved((a + ridge, b, c, d + ridge, e, f + ridge), slope)
    long = np.sqrt(sum(s * s for s in step)) / np.maximum(far, 1e-30)
    places: Array = near - np.column_stack(step) / np.maximum(long, 1.0)[:, None]
    return places


def _solved(A: Sequence[Array], s: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return A^-1 s for many A = L D L^T, positive definite, as xx xy xz yy yz zz."""
    a, b, c, d, e, f = A
    p, q = b / a, c / a
    d, e, f = d - p * b, e - q * b, f - q * c
    r = e / d
    y, z = s[1] - p * s[0], s[2] - q * s[0]
    z = (z - r * y) / (f - r * e)
    y = y / d - r * z
    return s[0] / a - p * y - q * z, y, z


def _folds(V: Array, F: Array, ends: Array, place: Array) -> Array:
    """Return which collapses would turn a triangle over."""
    moved, edge, which = V.copy(), np.full(len(V), -1), np.arange(len(V))
    moved[ends.ravel()] = np.repeat(place, 2, axis=0)
    edge[ends.ravel()] = np.repeat(np.arange(len(ends)), 2)
    which[ends[:, 1]] = ends[:, 0]
    left = F[(edge[F] >= 0).any(axis=1)]  # what moves
    left = left[(which[left] != np.roll(which[left], 1, axis=1)).all(axis=1)]
    before, after = (
        np.cross(P[left[:, 1]] - P[left[:, 0]], P[left[:, 2]] - P[left[:, 0]]) for P in (V, moved)
    )
    sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    over = (before * after).sum(axis=1) < 0.2 * sizes
    guilty = edge[left[over]].ravel()
    folds = np.zeros(len(ends), dtype=bool)
    folds[guilty[guilty >= 0]] = True
    return folds


def _creased(surface: Surface) -> Surface:
    """Return a surface that has a corner for each side of a sharp edge, so that it shows."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    V, F = surface.vertices, surface.faces
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    corner = np.arange(3 * len(F)).reshape(-1, 3)  # corner k of face f is 3 f + k
    ends = np.stack([np.roll(F, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    pairs = np.stack([np.roll(corner, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends[turned], pairs[turned] = ends[turned, ::-1], pairs[turned, ::-1]
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, pairs = ends[order], pairs[order]
    meets = (ends[1:] == ends[:-1]).all(axis=1)  # two faces on one edge
    one, other = pairs[:-1][meets], pairs[1:][meets]
    smooth = (normal[one[:, 0] // 3] * normal[other[:, 0] // 3]).sum(axis=1) > np.cos(_CREASE)
    rows, columns = one[smooth].ravel(), other[smooth].ravel()
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(3 * len(F), 3 * len(F)))
    count, which = connected_components(graph, directed=False)
    vertices = np.empty((count, 3))
    vertices[which] = V[F.ravel()]
    return replace(surface, vertices=vertices, faces=which.reshape(-1, 3))
