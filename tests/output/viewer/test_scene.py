import numpy as np
import pinocchio as pin
import pytest
import trimesh

from robotid.output.viewer.replays import _corners, ellipsoid, mass_marks, robot_scene, thin
from robotid.robot.bodies import Surface
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia


def test_the_ellipsoid_of_a_solid_ellipsoid_is_itself(rng):
    for _ in range(20):
        a = np.sort(rng.uniform(0.02, 0.5, 3))
        M = pin.SE3.Random()
        body = M.act(pin.Inertia.FromEllipsoid(3.7, *a))
        found = ellipsoid(pseudo_inertia(body.toDynamicParameters())[0])
        assert found["mass"] == pytest.approx(3.7)
        np.testing.assert_allclose(found["com"], M.translation, atol=1e-12)
        np.testing.assert_allclose(found["semi_axes"], a, rtol=1e-9)
        axes = pin.Quaternion(np.array(found["quaternion"])).matrix()
        # the axes agree but for their signs
        np.testing.assert_allclose(np.abs(axes.T @ M.rotation), np.eye(3), atol=1e-7)


def test_each_mass_hangs_on_the_node_of_its_body(ur5):
    marks = mass_marks(ur5, ur5.standard_parameters(), "URDF")["bodies"]
    assert [(x["name"], x["node"]) for x in marks] == [
        (body, ur5.pin_model.frames[ur5.pin_model.getFrameId(body)].parentJoint)
        for body in ur5.layout.bodies
    ]


@pytest.mark.parametrize(
    ("shape", "size", "half"),
    [
        ("box", [0.2, 0.4, 0.6], [0.1, 0.2, 0.3]),
        ("sphere", [0.3], [0.3, 0.3, 0.3]),
        ("cylinder", [0.1, 0.8], [0.1, 0.4, 0.1]),  # along y, as the viewer has them
        ("mesh", [1], None),
    ],
)
def test_the_box_about_a_part_is_where_the_part_is(shape, size, half):
    M = pin.SE3.Random().homogeneous
    boxes = [np.zeros((2, 3)), np.array([[-0.1, 0.2, 0.3], [0.4, 0.5, 0.9]])]
    part = {"shape": shape, "size": size, "matrix": M.T.ravel().tolist()}
    found = _corners(part, boxes)
    own = (found - M[:3, 3]) @ M[:3, :3]  # in the part's own frame
    low, high = boxes[1] if half is None else (-np.array(half), np.array(half))
    np.testing.assert_allclose(own.min(axis=0), low, atol=1e-12)
    np.testing.assert_allclose(own.max(axis=0), high, atol=1e-12)
    assert len(np.unique(own.round(9), axis=0)) == 8


def test_shapes_are_placed_as_in_the_urdf_and_cylinders_along_its_z(tmp_path):
    shapes = (
        '<box size="1 2 3"/>',
        '<sphere radius="0.2"/>',
        '<cylinder radius="0.1" length="0.5"/>',
    )
    visual = (
        '<visual><origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><geometry>{}</geometry></visual>'
    )
    (tmp_path / "shapes.urdf").write_text(
        '<robot name="s"><link name="base"/><link name="a">'
        f"{''.join(visual.format(shape) for shape in shapes)}</link>"
        '<link name="carrier"/><joint name="f" type="fixed"><parent link="carrier"/>'
        '<child link="a"/><origin xyz="0.3 0 0.1" rpy="0 0.7 0.2"/></joint>'
        '<joint name="j" type="revolute"><parent link="base"/><child link="carrier"/>'
        '<axis xyz="0 0 1"/><limit effort="1" velocity="1"/></joint></robot>'
    )
    scene = robot_scene(RobotModel.from_urdf(tmp_path / "shapes.urdf"))
    parts = {part["shape"]: part for part in scene.content["parts"] if part["node"] == 1}
    fixed = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.7, 0.2), np.array([0.3, 0.0, 0.1]))
    visual = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.5, 0.6), np.array([0.1, 0.2, 0.3]))
    wanted = (fixed * visual).homogeneous
    found = {name: np.array(part["matrix"]).reshape(4, 4).T for name, part in parts.items()}
    for name, size in (("box", [1, 2, 3]), ("sphere", [0.2]), ("cylinder", [0.1, 0.5])):
        assert parts[name]["size"] == size
        np.testing.assert_allclose(found[name][:, 3], wanted[:, 3])
    np.testing.assert_allclose(found["box"], wanted, atol=1e-12)
    np.testing.assert_allclose(found["sphere"], wanted, atol=1e-12)
    np.testing.assert_allclose(found["cylinder"][:3, 1], wanted[:3, 2], atol=1e-12)
    assert np.linalg.det(found["cylinder"]) == pytest.approx(1.0)


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
