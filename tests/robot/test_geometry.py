import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.hostile_urdfs import FILES

from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.output.viewer.replays import robot_scene
from robotid.robot.bodies import (
    body_boxes,
    body_points,
    find_mesh,
    kinematic_lengths,
    read_shapes,
    read_surfaces,
)
from robotid.robot.examples import example_urdfs
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.tree import parse_urdf

URDF = """<robot name="arm">
<link name="base"/>
<link name="one"><inertial><mass value="2"/><origin xyz="0 0 0.1"/>
<inertia ixx=".02" iyy=".02" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>{one}</link>
<link name="flange"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial>{flange}</link>
<joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="b" type="fixed"><parent link="one"/><child link="flange"/>
<origin xyz="0 0 1" rpy="0 1.5707963267948966 0"/></joint>
</robot>"""
BOX = '<collision><origin xyz="0 0 0.5"/><geometry><box size="0.2 0.4 1"/></geometry></collision>'
CYLINDER = '<visual><geometry><cylinder radius="0.1" length="0.6"/></geometry></visual>'
SPHERE = '<visual><geometry><sphere radius="0.3"/></geometry></visual>'
MESH = '<collision><geometry><mesh filename="{}" scale="0.5 1 1"/></geometry></collision>'


def arm(tmp_path, one="", flange=""):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.format(one=one, flange=flange))
    return RobotModel.from_urdf(path)


def extent(model):
    points = body_points(model)["one"]
    return points.min(axis=0), points.max(axis=0)


def test_shapes_of_links_that_are_fixed_to_each_other_make_one_body(tmp_path):
    low, high = extent(arm(tmp_path, BOX, CYLINDER))
    # the flange's cylinder lies along the body's x axis, one metre up
    np.testing.assert_allclose([low[0], high[0]], [-0.3, 0.3], atol=1e-12)
    np.testing.assert_allclose([low[1], high[1]], [-0.2, 0.2], atol=1e-12)
    assert low[2] == pytest.approx(0.0, abs=1e-12)
    assert 1.1 <= high[2] < 1.103  # a prism around the cylinder, which lies in it all around
    points = body_points(arm(tmp_path, CYLINDER, CYLINDER))["one"]
    turn = np.linspace(0.0, 2 * np.pi, 100)
    around = np.column_stack([np.cos(turn), np.sin(turn)])
    assert (around @ points[np.abs(points[:, 2]) < 0.4, :2].T).max(axis=1).min() >= 0.1 - 1e-12


@pytest.mark.parametrize(
    ("shape", "low", "high"),
    [
        ('<box size="0.2 0.4 1"/>', [0.9, -0.2, -0.5], [1.1, 0.2, 0.5]),
        ('<sphere radius="0.3"/>', [0.7, -0.3, -0.3], [1.3, 0.3, 0.3]),
        # a prism of 16 sides around it
        ('<cylinder radius="0.1" length="0.6"/>', [0.898, -0.102, -0.3], [1.102, 0.102, 0.3]),
    ],
)
def test_the_extent_of_a_shape_is_that_which_the_urdf_states(tmp_path, shape, low, high):
    own = f'<collision><origin xyz="1 0 0"/><geometry>{shape}</geometry></collision>'
    seen = '<visual><geometry><box size="9 9 9"/></geometry></visual>'
    flange = '<collision><origin xyz="1 0 1" rpy="0 0 0"/><geometry><box size="0 0 0"/>'
    model = arm(tmp_path, own + seen, flange + "</geometry></collision>")
    points = body_points(model)["one"][:-8]  # but for the flange's
    np.testing.assert_allclose(points.min(axis=0), low, atol=6e-4)
    np.testing.assert_allclose(points.max(axis=0), high, atol=6e-4)


def test_a_body_whose_link_has_mass_but_no_shape_is_not_bounded(tmp_path):
    assert body_points(arm(tmp_path, BOX)) == {}


def test_a_mesh_is_found_beside_the_urdf_and_scaled(tmp_path):
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box([1.0, 2.0, 3.0]).export(tmp_path / "meshes" / "part.stl")
    for name in ("meshes/part.stl", f"package://{tmp_path.name}/meshes/part.stl"):
        low, high = extent(arm(tmp_path, MESH.format(name), SPHERE.replace("0.3", "0.01")))
        np.testing.assert_allclose(high[:2], [0.25, 1.0], atol=1e-6)
        np.testing.assert_allclose(low, [-0.25, -1.0, -1.5], atol=1e-6)
    assert body_points(arm(tmp_path, MESH.format("lost.stl"), SPHERE)) == {}
    assert body_points(arm(tmp_path, BOX + MESH.format("lost.stl"), SPHERE)) == {}


def test_the_box_of_a_body_holds_its_geometry_or_its_frames_and_the_urdfs_own_body(tmp_path):
    # BOX, and the cylinder of the flange: 0.6 x 0.4 x 1.1 m, grown by 5 % of its diagonal; the
    # URDF's own body, 2 kg 0.1 m up and 1 kg in the flange, reaches further down
    grown = 0.05 * np.linalg.norm([0.6, 0.4, 1.1])
    own = 0.4 - np.sqrt(3 * (2 * 0.3**2 + 0.015 + 1 * 0.6**2 + 0.005) / 3)  # [kg m^2] over 3 kg
    low, high = body_boxes(arm(tmp_path, BOX, CYLINDER))["one"]
    np.testing.assert_allclose(low, [-0.3 - grown, -0.2 - grown, own], atol=2e-3)
    np.testing.assert_allclose(high, np.array([0.3, 0.2, 1.1]) + grown, atol=3e-3)
    # frames alone: the flange is 1 m up
    low, high = body_boxes(arm(tmp_path))["one"]
    np.testing.assert_allclose([low, high], [[-0.35, -0.35, -0.35], [0.35, 0.35, 1.35]], atol=1e-9)
    # a joint at the frame of its body: one metre, the length of the robot, is grown by a tenth
    text = (tmp_path / "arm.urdf").read_text().replace('type="fixed"', 'type="continuous"')
    (tmp_path / "two.urdf").write_text(text.replace(".01", ".002"))
    box = body_boxes(RobotModel.from_urdf(tmp_path / "two.urdf"))["flange"]
    np.testing.assert_allclose(box, np.outer([-0.1, 0.1], np.ones(3)), atol=1e-9)
    # a heavy flange's own body reaches beyond the sphere that is drawn: 3 sigma^2 about the centre
    small = arm(tmp_path, SPHERE, '<visual><geometry><sphere radius="0.01"/></geometry></visual>')
    (J,) = pseudo_inertia(small.standard_parameters()[:10])
    centre = J[2, 3] / J[3, 3]
    reach = np.sqrt(3.0 * (J[2, 2] / J[3, 3] - centre**2))
    assert body_boxes(small)["one"][1][2] == pytest.approx(centre + reach, abs=1e-9)
    assert centre + reach > 1.01 + 0.05 * 1.5


def test_the_kinematic_length_of_a_body_is_that_between_its_frames_or_to_the_joint_before(tmp_path):
    assert kinematic_lengths(arm(tmp_path)) == {"one": 1.0}  # the flange; no way along the joints
    joint = (
        '<link name="{1}"><inertial><mass value="1"/><inertia ixx=".01" iyy=".01" izz=".01" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{1}" type="{3}"><parent '
        'link="{0}"/><child link="{1}"/><origin xyz="0 {2} 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="{4}" effort="1" velocity="1"/></joint>'
    )
    path = tmp_path / "chain.urdf"

    def lengths(kind, upper):
        steps = [("base", "a", 0.0, "revolute", 1), ("a", "b", 2.0, "revolute", 1)]
        steps += [("b", "c", 0.5, kind, upper), ("c", "d", 0.1, "revolute", 1)]
        joints = "".join(joint.format(*step) for step in steps)
        path.write_text(f'<robot name="r"><link name="base"/>{joints}</robot>')
        return kinematic_lengths(RobotModel.from_urdf(path))

    housings = 0.1 * 2.6
    expected = {"a": 2.0, "b": 2.0, "c": 0.5, "d": 0.1}
    expected = {body: length + housings for body, length in expected.items()}
    assert lengths("revolute", 1) == pytest.approx(expected)
    # the travel of 3 m is beside both bodies of the prismatic joint
    travel = expected | {body: expected[body] + 3.0 for body in "bc"}
    assert lengths("prismatic", 2) == pytest.approx(travel)
    assert lengths("prismatic", -1).keys() == {"a", "d"}  # without limits


BROKEN = {
    "box without size": "<collision><geometry><box/></geometry></collision>",
    "nothing": "<collision><geometry/></collision>",
    "unknown shape": '<collision><geometry><capsule radius="1"/></geometry></collision>',
    "size of text": '<collision><geometry><box size="1 1 1_0"/></geometry></collision>',
    "garbage": MESH.format("garbage.stl"),
    "counts": MESH.format("counts.ply"),
    "no mesh": MESH.format("arm.urdf"),
    "folder": MESH.format("folder.stl"),
    "nowhere": MESH.format("nan.stl"),
}


@pytest.mark.parametrize("shape", BROKEN.values(), ids=BROKEN)
def test_geometry_that_cannot_be_read_bounds_nothing_and_is_named(tmp_path, shape):
    (tmp_path / "garbage.stl").write_bytes(b"\xff\x00solid")
    (tmp_path / "counts.ply").write_bytes(FILES["counts.ply"])
    (tmp_path / "nan.stl").write_bytes(FILES["nan.stl"])
    (tmp_path / "folder.stl").mkdir()
    model = arm(tmp_path, one=shape, flange=BOX)
    assert body_points(model) == {}

    codes = {finding.code for finding in inspect_urdf(model.tree.path).findings}
    assert ("geometry_unread" in codes) == ("mesh" in shape)


def test_boxes_without_extent_have_no_size_to_compare(tmp_path):
    point = '<collision><geometry><box size="0 0 0"/></geometry></collision>'
    path = tmp_path / "arm.urdf"
    text = URDF.format(one=point, flange=point).replace('type="fixed"', 'type="continuous"')
    one, flange = (text.split("<inertial>")[k].split("</inertial>")[0] for k in (1, 2))
    path.write_text(text.replace(flange, one))
    codes = {finding.code for finding in inspect_urdf(path).findings}
    assert "copied_inertial" not in codes


# --- shapes and meshes ---------------------------------------------------------------------------

PACKAGED = """<robot name="r">
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
    """A package with a PACKAGED in a folder of its own, beside one with a mesh."""
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    folder = tmp_path / "my_robot"
    (folder / "urdf").mkdir(parents=True)
    (folder / "meshes").mkdir()
    trimesh.creation.box((1, 1, 1)).export(folder / "meshes" / "cube.stl")
    (folder / "urdf" / "r.urdf").write_text(PACKAGED)
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
    text = PACKAGED.replace("<visual><geometry><sphere", f"{second}<geometry><sphere")
    (package / "urdf" / "r.urdf").write_text(text)
    (note,) = robot_scene(RobotModel.from_urdf(package / "urdf" / "r.urdf")).notes
    lost = "package://my_robot/meshes/lost.stl"
    assert note == f"2 meshes were not found or are not readable, for example {lost}"


def test_meshes_of_the_example_robots_are_found_from_anywhere(tmp_path):
    whole = "package://example-robot-data/robots/ur_description/meshes/ur5/visual/base.dae"
    for name in (whole, whole.replace("example-robot-data/robots/", "")):
        assert find_mesh(name, tmp_path / "x.urdf").name == "base.dae"
