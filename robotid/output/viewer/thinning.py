"""Mesh simplification for pages: closed surfaces stay closed."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.base.typing import Array
from robotid.robot.geometry import Surface, joined

_CREASE = np.radians(30.0)  # angle between two faces beyond which their edge is sharp
_WELD = 1e-6  # distance of corners that are merged, over the size of the largest surface
# whether rims are preserved, and growth rate of the error bound, until few enough remain
_ATTEMPTS = ((True, 3.0), (False, 3.0), (False, 7.0))
_GAP = 3.0  # distance between patches that are simplified together, over their size


def thin(solids: Sequence[Sequence[Surface]], most: int) -> list[list[Surface]]:
    """Return surfaces with at most so many triangles in total; closed ones stay closed.

    fast-simplification collapses edges in the order of the change of shape; a collapsed edge opens
    no hole. The triangles of a surface have one orientation, outwards if it is closed. Each side of
    a sharp edge has its own corners, so the edge stays sharp.

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
    size = float(np.ptp(whole.vertices, axis=0).max()) or 1.0
    which, V = _cells(whole.vertices, of_vertex, _WELD * size)
    F, patch = _proper(which[whole.faces], patch)
    if not len(F):  # all triangles are flat
        return [[] for _ in solids]
    F = _oriented(V, F)
    V, F, patch = _simplified(V / size, F, patch, most)
    of_vertex = np.zeros(len(V), dtype=int)
    of_vertex[F] = solid[patch][:, None]
    which, V = _cells(size * V, of_vertex, _WELD * size)
    F, patch = _proper(which[F], patch)
    is_open = np.unique(solid[patch[_open_faces(F)]])
    left = [
        _creased(Surface(V, F[patch == k], p.rgba, solid[k] not in is_open))
        for k, p in enumerate(patches)
    ]
    return [[s for s, k in zip(left, solid, strict=True) if k == i] for i in range(len(solids))]


def _cells(V: Array, solid: Array, cell: float) -> tuple[Array, Array]:
    """Return the cell of each corner in its solid's grid, and the mean of each cell."""
    keys = solid.astype(np.int64)
    for column in np.floor((V - V.min(axis=0)) / cell + 0.5).astype(np.int64).T:
        _, keys = np.unique(keys * (column.max() + 1) + column, return_inverse=True)
    count = np.bincount(keys)
    return keys, np.column_stack([np.bincount(keys, x) / count for x in V.T])


def _proper(F: Array, patch: Array) -> tuple[Array, Array]:
    """Return the triangles without degenerate ones and duplicates."""
    F, patch = (x[(np.roll(F, 1, axis=1) != F).all(axis=1)] for x in (F, patch))
    _, first = np.unique(_keys(np.sort(F, axis=1)), return_index=True)
    first.sort()
    return F[first], patch[first]


def _keys(rows: Array) -> Array:
    """Return one number for each row of indices."""
    n = np.int64(rows.max(initial=0) + 1)  # below 2 million, whose cube does not overflow
    key = rows[:, 0].astype(np.int64)
    for column in rows.T[1:]:
        key = key * n + column
    return key


def _edges(F: Array) -> tuple[Array, Array, Array]:
    """Return the edges (3 F, 2) of triangles, their faces, and whether their ends were swapped."""
    ends = np.stack([F, np.roll(F, -1, axis=1)], axis=2).reshape(-1, 2)
    swapped = ends[:, 0] > ends[:, 1]
    ends = np.where(swapped[:, None], ends[:, ::-1], ends)
    order = np.argsort(_keys(ends), kind="stable")
    return ends[order], order // 3, swapped[order]


def _open_faces(F: Array) -> Array:
    """Return the triangles with an edge that is not shared with one oppositely directed edge."""
    ends, face, swapped = _edges(F)
    starts = np.flatnonzero(np.r_[True, (ends[1:] != ends[:-1]).any(axis=1)])
    sides = np.diff(np.r_[starts, len(ends)])
    senses = np.add.reduceat(swapped.astype(int), starts)
    open_faces: Array = face[np.repeat((sides != 2) | (senses != 1), sides)]
    return open_faces


def _oriented(V: Array, F: Array) -> Array:
    """Return the triangles with one orientation on each connected surface, outwards."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends, face, swapped = _edges(F)
    same = (ends[1:] == ends[:-1]).all(axis=1)
    alone = ~np.r_[False, same[:-1]] & same & ~np.r_[same[1:], False]  # two faces, no third
    k = np.flatnonzero(alone)
    f, g = face[k], face[k + 1]
    opposed = swapped[k] == swapped[k + 1]  # orientations of the neighbours
    n = len(F)  # f is a face as it is, f + n its reverse
    rows, columns = np.r_[f, f + n], np.r_[g + n * opposed, g + n * ~opposed]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    corners = V[F] - V.mean(axis=0)
    volume = np.linalg.det(corners) / 6  # of the tetrahedron to the middle
    sums = np.bincount(part, np.r_[volume, -volume])
    reverse = (part[:n] != part[n:]) & (sums[part[:n]] < sums[part[n:]])
    return np.where(reverse[:, None], F[:, ::-1], F)


def _simplified(V: Array, F: Array, patch: Array, most: int) -> tuple[Array, Array, Array]:
    """Return corners, at most so many triangles, and their patches; no two share a corner.

    Rims of patches are preserved, so that neighbours still meet, unless too many triangles would
    remain. The library's error bound assumes coordinates of about 1.
    """
    import fast_simplification
    from scipy.spatial import cKDTree

    if len(F) <= most:
        return V, F, patch
    own, F = np.unique(F + len(V) * patch[:, None], return_inverse=True)  # corners of patches
    number, corner = np.divmod(own, len(V))
    gap = np.array([_GAP, 0.0, 0.0])
    V = V[corner] + number[:, None] * gap  # the library does not distinguish patches
    for keeps_rims, step in _ATTEMPTS:
        places, faces = fast_simplification.simplify(
            V, F.astype(np.int32), target_count=most, preserve_border=keeps_rims, agg=step
        )
        if len(faces) <= most:
            break
    nearest = cKDTree(V[F].mean(axis=1)).query(places[faces].mean(axis=1))[1]
    patch = patch[nearest]
    number = np.zeros(len(places), dtype=int)
    number[faces] = patch[:, None]
    return places - number[:, None] * gap, faces.astype(np.int64), patch


def _creased(surface: Surface) -> Surface:
    """Return a surface with separate corners for each side of a sharp edge."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    V, F = surface.vertices, surface.faces
    normal = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    corner = np.arange(3 * len(F)).reshape(-1, 3)  # corner k of face f is 3 f + k
    ends = np.stack([np.roll(F, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    pairs = np.stack([np.roll(corner, -k, axis=1) for k in (0, 1)], axis=2).reshape(-1, 2)
    swap = ends[:, 0] > ends[:, 1]
    ends[swap], pairs[swap] = ends[swap, ::-1], pairs[swap, ::-1]
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
