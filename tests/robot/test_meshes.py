import numpy as np
import pinocchio as pin
import pytest
import trimesh

from robotid.output.viewer.scene import robot_scene
from robotid.robot.examples import example_urdfs
from robotid.robot.geometry import find_mesh, read_shapes, read_surfaces
from robotid.robot.model import RobotModel
from robotid.robot.urdf_text import parse_urdf

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


def test_a_scene_holds_each_mesh_once_and_names_what_is_missing(package):
    model = RobotModel.from_urdf(package / "urdf" / "r.urdf")
    shown = robot_scene(model)
    assert len(shown.content["meshes"]) == 1
    parts = shown.content["parts"]
    assert [(p["node"], p["shape"]) for p in parts] == [
        (0, "box"), (1, "mesh"), (1, "mesh"), (1, "cylinder"),
    ]  # fmt: skip
    assert parts[0]["colour"] == "#80331a"
    assert parts[1]["colour"] == "#00ff00"
    assert len({p["size"][0] for p in parts[1:3]}) == 1
    (note,) = shown.notes
    assert note.startswith("1 meshes were not found or are not readable")
    assert "lost.stl" in note
    second = '<visual><geometry><mesh filename="other.stl"/></geometry></visual><visual>'
    text = URDF.replace("<visual><geometry><sphere", f"{second}<geometry><sphere")
    (package / "urdf" / "r.urdf").write_text(text)
    (note,) = robot_scene(RobotModel.from_urdf(package / "urdf" / "r.urdf")).notes
    lost = "package://my_robot/meshes/lost.stl"
    assert note == f"2 meshes were not found or are not readable, for example {lost}"


def test_meshes_of_the_example_robots_are_found_from_anywhere(tmp_path):
    whole = "package://example-robot-data/robots/ur_description/meshes/ur5/visual/base.dae"
    for name in (whole, whole.replace("example-robot-data/robots/", "")):
        assert find_mesh(name, tmp_path / "x.urdf").name == "base.dae"
