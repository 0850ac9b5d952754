import re

import numpy as np
import pinocchio as pin
import pytest
import trimesh
from helpers.replay_data import leave_out_meshes, shown
from helpers.robots import mimicking

from robotid.base.exceptions import DataError
from robotid.output.viewer.replays import (
    Torques,
    _corners,
    ellipsoid,
    mass_marks,
    replay,
    residual_levels,
    robot_scene,
    thin,
)
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


@pytest.mark.parametrize(("shape", "size", "half"), [
    ("box", [0.2, 0.4, 0.6], [0.1, 0.2, 0.3]), ("sphere", [0.3], [0.3, 0.3, 0.3]),
    ("cylinder", [0.1, 0.8], [0.1, 0.4, 0.1]), ("mesh", [1], None),  # along y, as in the viewer
])  # fmt: skip
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


URDF = """<robot name="&lt;b&gt;x&lt;/b&gt;">
  <link name="base"/><link name="turner"/><link name="slider"/><link name="tip"/>
  <joint name="turn/1" type="continuous"><parent link="base"/><child link="turner"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="turner"/><child link="slider"/>
    <origin xyz="0.4 0 0" rpy="0.3 0 0"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" velocity="1" effort="9"/></joint>
  <joint name="mount" type="fixed"><parent link="slider"/><child link="tip"/>
    <origin xyz="0 0 0.2"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    path.write_text(URDF)
    return RobotModel.from_urdf(path)


@pytest.fixture(scope="module")
def motion():
    t = 5.0 + np.arange(201) / 100.0
    return t, np.column_stack([4.0 * (t - 5.0), 0.5 * (t - 5.0) ** 2 / 4])


@pytest.fixture(scope="module")
def page(arm, motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay")
    path = replay(arm, *motion).write(folder / "replay.html")
    assert path == folder / "replay.html"
    assert [p.name for p in folder.iterdir()] == ["replay.html"]
    return path.read_text(encoding="utf-8")


@pytest.fixture(autouse=True)
def unseen(monkeypatch):
    """What the robot looks like, which takes seconds to be thinned, is left out."""
    leave_out_meshes(monkeypatch)


def world_poses(nodes, moved):
    """Return the world pose of every node but the first, as the page's script poses them."""
    poses = [pin.SE3.Identity()]
    for node in nodes[1:]:
        rest = pin.SE3(pin.Quaternion(np.array(node["quaternion"])), np.array(node["position"]))
        axis, by = np.array(node["axis"]), float(moved[node["column"]])
        if node["kind"] == "revolute":
            rest = rest * pin.SE3(pin.exp3(axis * by), np.zeros(3))
        elif node["kind"] == "prismatic":
            rest = rest * pin.SE3(np.eye(3), axis * by)
        else:
            turn = pin.Quaternion(np.array(moved[3:7], dtype=float)).normalized()
            rest = pin.SE3(turn, np.array(moved[:3], dtype=float))
        poses.append(poses[node["parent"]] * rest)
    return poses[1:]


def test_the_page_fetches_nothing_and_cannot_be_injected(page):
    outside = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.DOTALL)
    assert set(re.findall(r'(?:src|href)="([^"]*)"', outside)) == {"data:,"}
    assert "connect-src" not in outside
    assert "default-src 'none'" in outside
    assert "<b>x</b>" not in page
    assert "<title>&lt;b&gt;x&lt;/b&gt;: replay</title>" in outside
    assert page.count("</script>") == 5
    assert shown(page)["title"] == "<b>x</b>"
    assert "MeshCat.Viewer" in page


def test_keyframes_have_the_true_times_at_the_rate(page):
    times = shown(page)["motion"]["t"]
    assert (times[0], times[-1]) == (0.0, pytest.approx(2.0))
    assert np.diff(times).max() <= 1 / 30 + 0.0101
    assert 55 <= len(times) <= 63


def test_every_keyframe_is_the_robot_s_pose(arm, motion, tmp_path, rng):
    t, joints = motion
    turn = 0.3 * joints[:, 0]
    base = np.column_stack([turn, -turn, turn**2, 0 * turn, np.sin(turn), 0 * turn, np.cos(turn)])
    floating = RobotModel.from_urdf(arm.tree.path, free_flyer=True)
    follows = mimicking(tmp_path, rng)  # joints that follow, with an offset
    for model, q in ((arm, joints), (follows, joints), (floating, np.hstack([base, joints]))):
        data = shown(replay(model, t, q).html)
        times, moved = data["motion"]["t"], data["motion"]["q"]
        pinned = model.pin_model.createData()
        for k in (0, 17, len(times) - 1):
            row = int(np.argmin(np.abs(t - t[0] - times[k])))
            pin.forwardKinematics(model.pin_model, pinned, model.configurations(q)[row])
            poses = world_poses(data["scene"]["nodes"], moved[k])
            for pose, true in zip(poses, list(pinned.oMi)[1:], strict=True):
                # keyframes are single precision
                np.testing.assert_allclose(pose.homogeneous, true.homogeneous, atol=1e-6)


def test_the_other_quaternion_of_a_pose_moves_no_base(arm):
    floating = RobotModel.from_urdf(arm.tree.path, free_flyer=True)
    t, turn = np.arange(90) / 30.0, np.linspace(0.0, 1.0, 90)
    base = (turn, turn**2, -turn, 0 * turn, 0 * turn, np.sin(turn), np.cos(turn))
    q = np.column_stack([*base, turn, turn])
    other = q.copy()
    other[20:61, 3:7] *= -1.0
    one, two = (shown(replay(floating, t, x).html)["motion"]["q"] for x in (q, other))
    np.testing.assert_allclose(two, one, atol=1e-6)


def test_torques_are_plotted_with_gaps_and_the_units_of_their_joints(arm, motion):
    t, q = motion
    t = np.where(t > 6.0, t + 1.0, t)
    data = shown(replay(arm, t, q, torques=Torques(t, q + 1.0, {"fit": q})).html)["torques"]
    joints = [(j["name"], j["unit"], j["node"]) for j in data["joints"]]
    assert joints == [("turn/1", "N m", 1), ("slide", "N", 2)]
    (hole,) = np.flatnonzero(np.isnan(data["values"][:, 0]))
    assert 1.0 < data["t"][hole] < 2.0


def test_the_strip_is_of_the_first_prediction_over_what_it_is_compared_to(arm, motion):
    t, q = motion
    rng = np.random.default_rng(5)
    first, other = (q + scale * rng.normal(size=q.shape) for scale in (0.3, 2.0))
    first[:50, 1] = np.nan
    ours = {"first": first, "other": other}
    noise = np.array([0.2, 0.5])
    for quantity, stated, of, full in (
        ("torque", noise, noise, 6.0),
        ("torque", None, np.sqrt(np.mean(q**2, axis=0)), 0.5),
        ("position", noise, noise, 0.25),
    ):
        data = shown(replay(arm, t, q, torques=Torques(t, q, ours, stated, quantity)).html)
        scale, strip = data["torques"]["scale"], data["torques"]["strips"][0]
        np.testing.assert_allclose(scale["of"], of)
        assert scale["full"] == full
        edges = np.linspace(t[0], t[-1], len(strip) + 1)
        which = np.minimum(np.searchsorted(edges, t, side="right") - 1, len(strip) - 1)
        assert len(strip) == 201 // 4
        for b in range(0, len(strip), 7):
            left = ((q - first) / of)[which == b]
            for j in range(2):
                known = left[np.isfinite(left[:, j]), j]
                wanted = 100 * np.sqrt(np.mean(known**2)) if len(known) else 65_534
                assert strip[b, j] == pytest.approx(wanted, abs=0.51)
        others = data["torques"]["strips"][1:]  # a switch shows them, of torques
        assert len(others) == (quantity == "torque")
        for strip in others:
            mean = np.sqrt(np.mean((strip / 100.0) ** 2, axis=0))
            expected = np.sqrt(np.mean((q - other) ** 2, axis=0)) / of
            np.testing.assert_allclose(mean, expected, rtol=0.05)


@pytest.mark.parametrize(("change", "message"), [
    (lambda t, q: (t[:5], q), r"t has shape \(5,\) and q \(201, 2\), expected \(N,\) and \(N, n\)"),
    (lambda t, q: (t[:1], q[:1]), "the motion has 1 samples, expected at least 2 to play"),
    (lambda t, q: (t, q[:, :1]), r"q has shape \(201, 1\), expected \(N, 2\)"),
    (lambda t, q: (t, q * np.nan), "t or q has values that are not finite"),
    (lambda t, q: (np.r_[t[:9], t[8:-1]], q), r"t must increase, but t\[9\] = 5.08 s follows"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(arm, motion, tmp_path, change, message):
    with pytest.raises(DataError, match=message):
        replay(arm, *change(*motion)).write(tmp_path / "r.html")
    assert list(tmp_path.iterdir()) == []


def test_levels_are_root_mean_squares_and_say_where_there_is_nothing():
    t = np.r_[0.1, 0.3, 0.6, 0.9, 1.2, 3.0]
    residual = np.array([[3.0, 1], [4.0, np.nan], [-1, np.nan], [1, np.nan], [2, -5], [7, 0]])
    levels = residual_levels(np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0]), t, residual)
    wanted = [[np.sqrt(12.5), 1], [1, -1], [2, 5], [np.nan, np.nan], [7, 0]]
    np.testing.assert_allclose(levels, wanted)
