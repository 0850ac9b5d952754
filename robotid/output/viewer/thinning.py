"""Mesh simplification for pages: closed surfaces stay closed, sharp edges stay sharp."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.robot.geometry import Surface, joined

_CREASE = np.radians(30.0)  # angle between two faces beyond which their edge is sharp
# whether rims are preserved, and growth rate of the error bound, until few enough remain
_ATTEMPTS = ((True, 3.0), (False, 3.0), (False, 7.0))


def thin(solids: Sequence[Sequence[Surface]], most: int) -> list[list[Surface]]:
    """Return surfaces with at most so many triangles in total; closed ones stay closed.

    fast-simplification collapses edges in the order of the change of shape; a collapsed edge opens
    no hole. The triangles of a surface have one orientation, outwards if it is closed. Each side of
    a sharp edge has its own corners.

    References:
        Garland, Heckbert (1997), Surface simplification using quadric error metrics.
    """
    share = most / max(sum(len(patch.faces) for solid in solids for patch in solid), 1)
    return [_thinned(solid, share) if solid else [] for solid in solids]


def _thinned(patches: Sequence[Surface], share: float) -> list[Surface]:
    import trimesh

    whole = joined(patches)
    size = float(np.ptp(whole.vertices, axis=0).max()) or 1.0
    patch = np.repeat(np.arange(len(patches)), [len(surface.faces) for surface in patches])
    mesh = trimesh.Trimesh(whole.vertices / size, whole.faces, process=False)
    mesh.merge_vertices()
    is_proper = mesh.unique_faces() & mesh.nondegenerate_faces()
    mesh.update_faces(is_proper)
    if not len(mesh.faces):
        return []
    faces, patch = _oriented(mesh), patch[is_proper]
    parts = [_simplified(mesh.vertices, faces[patch == k], share) for k in range(len(patches))]
    together: Any = trimesh.util.concatenate(parts)
    together.merge_vertices()
    is_closed = together.is_watertight and together.is_winding_consistent
    surfaces = []
    for part, surface in zip(parts, patches, strict=True):
        if len(part.faces):
            smooth = trimesh.graph.smooth_shade(part, angle=_CREASE, facet_minarea=None)
            vertices, triangles = size * smooth.vertices, np.asarray(smooth.faces)
            surfaces.append(Surface(vertices, triangles, surface.rgba, is_closed))
    return surfaces


def _simplified(V: Array, F: Array, share: float) -> Any:  # noqa: ANN401
    """Return a share of the triangles of a patch, as a mesh; its rim is kept if it can be.

    Otherwise, too many triangles would remain. The library's error bound assumes coordinates of
    about 1.
    """
    import fast_simplification
    import trimesh

    most = int(share * len(F))
    if len(F) > most:
        used, F = np.unique(F, return_inverse=True)
        V, F = np.ascontiguousarray(V[used]), F.reshape(-1, 3).astype(np.int32)
        for keeps_rims, step in _ATTEMPTS:
            places, faces = fast_simplification.simplify(
                V, F, target_count=most, preserve_border=keeps_rims, agg=step
            )
            if len(faces) <= most:
                break
        V, F = places, faces
    mesh = trimesh.Trimesh(V, F, process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
    return mesh


def _oriented(mesh: Any) -> Array:  # noqa: ANN401
    """Return the triangles with one orientation on each connected surface, outwards."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    F, (f, g), n = np.asarray(mesh.faces), mesh.face_adjacency.T, len(mesh.faces)
    first, second = mesh.face_adjacency_edges.T[:, :, None]
    forward = [((F[k] == first) & (np.roll(F[k], -1, axis=1) == second)).any(1) for k in (f, g)]
    opposed = forward[0] == forward[1]  # orientations of the neighbours
    # f is a face as it is, f + n its reverse
    rows, columns = np.r_[f, f + n], np.r_[g + n * opposed, g + n * ~opposed]
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    volume = np.linalg.det(mesh.triangles - mesh.vertices.mean(axis=0)) / 6
    sums = np.bincount(part, np.r_[volume, -volume])
    reverse = (part[:n] != part[n:]) & (sums[part[:n]] < sums[part[n:]])
    return np.where(reverse[:, None], F[:, ::-1], F)
