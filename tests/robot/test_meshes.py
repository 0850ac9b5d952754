import numpy as np
import pinocchio as pin
import pytest
import trimesh

from robotid.robot.examples import example_urdfs
from robotid.robot.meshes import Surface, find_mesh, read_shapes, read_surfaces, thin
from robotid.robot.model import RobotModel
from robotid.robot.urdf_text import parse_urdf
from robotid.viewer.scene import robot_scene

URDF = """<robot name="r">
  <material name="rust"><color rgba="0.5 0.2 0.1 1"/></material>
  <link name="base"><visual><geometry><box size="1 2 3"/></geometry>
    <material name="rust"/></visual></link>
  <link name="arm">
    <visual><origin xyz="1 2 3" rpy="0.1 -0.7 2.5"/><geometry>
      <mesh filename="package://my_robot/meshes/cube.stl" scale="0.5 0.5 0.5"/></geometry>
      <material name="own"><color rgba="0 1 0 1"/></material></visual>
    <visual><geometry><mesh filename="package://my_robot/meshes/cube.stl" scale="0.5 0.5 0.5"/>
      </geometry></visual>
    <visual><geometry><cylinder radius="0.1" length="0.4"/></geometry></visual>
    <visual><geometry><mesh filename="package://my_robot/meshes/lost.stl"/></geometry></visual>
    <visual><geometry><sphere radius="oops"/></geometry></visual>
  </link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="9"/></joint>
</robot>"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with a URDF in a folder of its own, beside one with a mesh."""
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    folder = tmp_path / "my_robot"
    (folder / "urdf").mkdir(parents=True)
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 1, 1)).export(folder / "meshes" / "cube.stl")
    (folder / "urdf" / "r.urdf").write_text(URDF)
    return folder


def test_visuals_are_read_with_their_poses_and_colours(package):
    box, mesh, plain, cylinder, lost, oops = read_shapes(parse_urdf(package / "urdf" / "r.urdf"))
    assert (box.link, box.kind, box.size) == ("base", "box", (1, 2, 3))
    assert box.rgba == (0.5, 0.2, 0.1, 1)
    assert (mesh.kind, mesh.size, mesh.rgba) == ("mesh", (0.5, 0.5, 0.5), (0, 1, 0, 1))
    np.testing.assert_allclose(mesh.placement[:3, :3], pin.rpy.rpyToMatrix(0.1, -0.7, 2.5))
    np.testing.assert_allclose(mesh.placement[:3, 3], [1, 2, 3])
    assert plain.rgba is None
    assert cylinder.size == (0.1, 0.4)
    assert lost.file.endswith("lost.stl")
    assert oops.kind == ""


def test_a_mesh_is_found_above_the_urdf_in_the_package_path_and_by_its_path(
    package, tmp_path, monkeypatch
):
    urdf, mesh = package / "urdf" / "r.urdf", package / "meshes" / "cube.stl"
    name = "package://my_robot/meshes/cube.stl"
    assert find_mesh(name, urdf) == mesh
    assert find_mesh("../meshes/cube.stl", urdf).samefile(mesh)
    assert find_mesh(str(mesh), urdf) == mesh
    assert find_mesh(f"file://{mesh}", urdf) == mesh
    assert find_mesh("package://my_robot/meshes/lost.stl", urdf) is None
    elsewhere = tmp_path / "elsewhere" / "x.urdf"
    elsewhere.parent.mkdir()
    assert find_mesh(name, elsewhere) == mesh  # the package is beside the folder
    renamed = package.rename(tmp_path / "my_robot-1.2")
    assert find_mesh(name, elsewhere) is None
    assert find_mesh(name, renamed / "urdf" / "r.urdf") == renamed / "meshes" / "cube.stl"
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{renamed}")
    assert find_mesh(name, elsewhere) == renamed / "meshes" / "cube.stl"


def test_every_mesh_of_the_example_robots_is_found_but_those_of_another_computer():
    lost = [
        visual.file
        for urdf in example_urdfs()
        for visual in read_shapes(parse_urdf(urdf))
        if visual.kind == "mesh" and find_mesh(visual.file, urdf) is None
    ]
    assert [file for file in lost if not file.startswith("file:///usr/Romeo")] == []


@pytest.mark.parametrize("suffix", ["stl", "dae", "obj", "ply"])
def test_formats_are_read(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((1, 2, 3)).export(path)
    (surface,) = read_surfaces(path)
    assert len(surface.faces) == 12
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [1, 2, 3])


def test_a_collada_file_in_centimetres_becomes_metres(tmp_path):
    path = tmp_path / "box.dae"
    trimesh.creation.box((100, 200, 300)).export(path)
    text = path.read_text()
    assert "<asset>" in text
    unit = '<unit name="centimeter" meter="0.01"/>'
    head, _, tail = text.partition("<asset>")
    path.write_text(f"{head}<asset>{unit}{tail}")
    (surface,) = read_surfaces(path)
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), [1, 2, 3])


def test_a_file_that_is_no_mesh_is_refused_by_name(tmp_path):
    (tmp_path / "bad.dae").write_text("nothing")
    with pytest.raises(ValueError, match=r"bad\.dae cannot be read"):
        read_surfaces(tmp_path / "bad.dae")


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


def test_far_too_many_triangles_are_thinned_too_without_holes():
    ball = trimesh.creation.icosphere(subdivisions=6)  # 81,920 triangles
    ((thinned,),) = thin([[surface_of(ball)]], 2000)
    assert len(thinned.faces) <= 2000
    corners = thinned.vertices[thinned.faces]  # what is seen from the middle is the whole sphere
    r = np.linalg.norm(corners, axis=2)
    A, B, C = corners.transpose(1, 0, 2)
    below = r.prod(axis=1) + sum(
        (X * Y).sum(axis=1) * r[:, k] for X, Y, k in ((A, B, 2), (B, C, 0), (C, A, 1))
    )
    seen = 2 * np.arctan2(np.linalg.det(corners), below)  # van Oosterom and Strackee (1983)
    assert seen.sum() == pytest.approx(4 * np.pi, rel=0.01)
    assert np.abs(np.linalg.norm(thinned.vertices, axis=1) - 1).max() < 0.01


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


def test_sharp_edges_get_a_corner_for_each_side_and_smooth_ones_do_not():
    box, ball = trimesh.creation.box((1, 1, 1)), trimesh.creation.icosphere(subdivisions=3)
    (cube,), (sphere,) = thin([[surface_of(box)], [surface_of(ball)]], 10_000)
    assert len(cube.faces) == 12
    assert len(cube.vertices) == 24
    assert len(sphere.vertices) == len(ball.vertices)
    assert thin([[]], 100) == [[]]


def test_edges_stay_sharp_when_few_triangles_are_left():
    box = trimesh.creation.box((1, 2, 3)).subdivide_loop(0)
    for _ in range(5):
        box = box.subdivide()
    ((thinned,),) = thin([[surface_of(box)]], 100)
    assert len(thinned.faces) <= 100
    mesh = trimesh.Trimesh(thinned.vertices, thinned.faces)
    assert mesh.volume == pytest.approx(6.0, rel=1e-3)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [1, 2, 3], atol=1e-3)


def test_a_mesh_without_triangles_counts_as_not_found_and_the_body_gets_a_skeleton(package):
    (package / "meshes" / "cube.stl").write_text("nothing")
    urdf = package / "urdf" / "r.urdf"
    urdf.write_text(URDF.replace('<cylinder radius="0.1" length="0.4"/>', ""))
    scene = robot_scene(RobotModel.from_urdf(urdf))
    assert scene.notes[0].startswith("2 meshes not found or not readable")
    assert scene.content["meshes"] == []
    assert "#e07b1f" in [p["colour"] for p in scene.content["parts"] if p["node"] == 1]


def test_a_scene_holds_each_mesh_once_and_names_what_is_missing(package):
    model = RobotModel.from_urdf(package / "urdf" / "r.urdf")
    scene = robot_scene(model)
    assert len(scene.content["meshes"]) == 1
    parts = scene.content["parts"]
    assert [(p["node"], p["shape"]) for p in parts] == [
        (0, "box"), (1, "mesh"), (1, "mesh"), (1, "cylinder"),
    ]  # fmt: skip
    assert parts[0]["colour"] == "#80331a"
    assert parts[1]["colour"] == "#00ff00"
    assert len({p["size"][0] for p in parts[1:3]}) == 1
    (note,) = scene.notes
    assert note.startswith("1 meshes not found or not readable")
    assert "lost.stl" in note


def test_parts_sit_where_pinocchio_puts_the_visuals(package):
    """Pinocchio's own reading of the visuals is the oracle."""
    path = package / "urdf" / "r.urdf"
    hand = """
      <link name="hand"><visual><origin xyz="0.1 0.2 0.3" rpy="1 0.5 -0.3"/>
        <geometry><box size="1 1 1"/></geometry></visual></link>
      <joint name="mount" type="fixed"><parent link="arm"/><child link="hand"/>
        <origin xyz="3 2 1" rpy="-0.4 0.2 1.1"/></joint></robot>"""
    lost = '<visual><geometry><mesh filename="package://my_robot/meshes/lost.stl"/></geometry></visual>'
    wrong = '<visual><geometry><sphere radius="oops"/></geometry></visual>'
    path.write_text(URDF.replace(lost, "").replace(wrong, "").replace("</robot>", hand))
    full = pin.buildModelFromUrdf(str(path))
    shapes = pin.buildGeomFromUrdf(
        full, str(path), pin.VISUAL, package_dirs=[str(package.parent)]
    ).geometryObjects
    parts = robot_scene(RobotModel.from_urdf(path)).content["parts"]
    assert len(shapes) == len(parts) == 5
    for shape in shapes:
        wanted = shape.placement.homogeneous
        if "arm_2" in shape.name:  # the page's cylinder lies along y, that of a URDF along z
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 1, 0]), np.array([0.0, 0, 1]))
            wanted = wanted @ pin.SE3(turn, np.zeros(3)).homogeneous
        own = [p for p in parts if p["node"] == shape.parentJoint]
        own = [np.array(p["matrix"]).reshape(4, 4).T for p in own]
        assert any(np.allclose(M, wanted, atol=1e-9) for M in own), shape.name


def test_meshes_of_the_example_robots_are_found_from_anywhere(tmp_path):
    whole = "package://example-robot-data/robots/ur_description/meshes/ur5/visual/base.dae"
    for name in (whole, whole.replace("example-robot-data/robots/", "")):
        assert find_mesh(name, tmp_path / "x.urdf").name == "base.dae"
