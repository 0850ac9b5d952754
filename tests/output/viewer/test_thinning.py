import numpy as np
import pytest
import trimesh

from robotid.output.viewer.scene import thin
from robotid.robot.geometry import Surface


def surface_of(mesh, rgba=None):
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), rgba)


def welded(surfaces):
    """Return surfaces as one mesh whose equal corners are one."""
    return trimesh.util.concatenate([
        trimesh.Trimesh(s.vertices, s.faces, process=False) for s in surfaces
    ]).process(merge_norm=True, merge_tex=True)  # fmt: skip


def test_thinned_surfaces_stay_near_and_have_few_triangles():
    ball = trimesh.creation.icosphere(subdivisions=5)  # 20,480 triangles, radius 1
    ((thinned,),) = thin([[surface_of(ball)]], 3000)
    assert 2900 < len(thinned.faces) <= 3000
    radius = np.linalg.norm(thinned.vertices, axis=1)
    assert radius.max() < 1.003
    assert radius.min() > 0.997
    assert set(np.unique(thinned.faces)) <= set(range(len(thinned.vertices)))


def test_what_is_closed_stays_closed_whatever_its_colours():
    """A ring of two colours that meet along a wave, thinned to a quarter."""
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=120, minor_sections=60)
    left = ring.triangles_center[:, 0] < 0.1 * np.sin(5 * ring.triangles_center[:, 1])
    halves = [surface_of(ring.submesh([np.flatnonzero(side)])[0]) for side in (left, ~left)]
    (thinned,) = thin([halves], 3700)
    assert sum(len(s.faces) for s in thinned) <= 3700
    whole = welded(thinned)
    assert whole.is_watertight
    assert whole.volume == pytest.approx(ring.volume, rel=0.02)
    assert all(s.is_closed for s in thinned)
    # each colour keeps its half
    assert whole.area == pytest.approx(ring.area, rel=0.02)
    areas = [trimesh.Trimesh(s.vertices, s.faces).area for s in (*thinned, *halves)]
    assert areas[:2] == pytest.approx(areas[2:], rel=0.03)


def test_triangles_are_turned_alike_and_outwards(rng):
    ball = trimesh.creation.icosphere(subdivisions=3)
    faces = ball.faces.copy()
    turned = rng.random(len(faces)) < 0.5
    faces[turned] = faces[turned, ::-1]
    away = Surface(ball.vertices + 3.0, faces, None)
    inside_out = Surface(np.asarray(ball.vertices), ball.faces[:, ::-1], None)
    for (solid,) in thin([[away], [inside_out]], 10_000):
        mesh = trimesh.Trimesh(solid.vertices, solid.faces)
        assert mesh.is_winding_consistent
        assert mesh.volume == pytest.approx(ball.volume)
        assert solid.is_closed


def test_a_sheet_keeps_its_rim_and_is_not_called_closed():
    x, y = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 2, 40), indexing="ij")
    k = np.arange(1600).reshape(40, 40)
    a, b, c, d = (k[i : 39 + i, j : 39 + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    sheet = Surface(np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces, None)
    ((thinned,),) = thin([[sheet]], 200)
    assert trimesh.Trimesh(thinned.vertices, thinned.faces).area == pytest.approx(2.0, rel=1e-3)
    assert not thinned.is_closed
    ((thinned,),) = thin([[sheet]], 60)  # its rim alone has 156 sides
    assert 50 < len(thinned.faces) <= 60


def test_sharp_edges_get_a_corner_for_each_side_and_smooth_ones_do_not():
    box, ball = trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(subdivisions=3)
    (cube,), (sphere,) = thin([[surface_of(box)], [surface_of(ball)]], 10_000)
    assert len(cube.faces) == 12
    assert len(cube.vertices) == 24
    assert len(sphere.vertices) == len(ball.vertices)
    assert thin([[]], 100) == [[]]
