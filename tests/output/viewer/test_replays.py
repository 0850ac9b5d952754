import re

import numpy as np
import pinocchio as pin
import pytest
from helpers.replay_data import leave_out_meshes, shown

from robotid.base.exceptions import DataError
from robotid.output.viewer.replays import Torques, replay, residual_levels
from robotid.robot.model import RobotModel

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


def test_every_keyframe_is_the_robot_s_pose(arm, motion, page):
    t, q = motion
    data = shown(page)
    times, moved = data["motion"]["t"], data["motion"]["q"]
    pinned = arm.pin_model.createData()
    for k in (0, 17, len(times) - 1):
        row = int(np.argmin(np.abs(t - t[0] - times[k])))
        pin.forwardKinematics(arm.pin_model, pinned, arm.configurations(q)[row])
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
    assert [(j["unit"], j["node"]) for j in data["joints"]] == [("N m", 1), ("N", 2)]
    (hole,) = np.flatnonzero(np.isnan(data["values"][:, 0]))
    assert 1.0 < data["t"][hole] < 2.0


def test_every_series_is_that_of_its_joint_and_of_who_says_so(identified):
    """Measured and predicted torques of six joints, no two alike, at the times of the log."""
    evaluation = identified.validation[0]
    trajectory, model = evaluation.recording.trajectory, identified.model
    ours = {"identified": evaluation.torques["estimate"], "URDF": evaluation.torques["urdf"]}
    torques = Torques(trajectory.t, trajectory.tau, ours)
    page = replay(model, trajectory.t, trajectory.q, torques=torques)
    data = shown(page.html)
    found = data["torques"]
    assert found["labels"] == ["measured", "identified", "URDF"]
    assert [joint["name"] for joint in found["joints"]] == list(model.joints)
    assert found["values"].shape[1] == 18
    real = ~np.isnan(found["values"][:, 0])
    rows = np.abs(found["t"][real, None] + trajectory.t[0] - trajectory.t).argmin(axis=1)
    np.testing.assert_allclose(found["t"][real], (trajectory.t - trajectory.t[0])[rows], atol=1e-5)
    series = (trajectory.tau, ours["identified"], ours["URDF"])
    for k, wanted in enumerate(series):
        for j in range(6):
            shown_as = found["values"][real, 6 * k + j]
            step = np.ptp(wanted[:, j]) / 65_534
            np.testing.assert_allclose(shown_as, wanted[rows, j], atol=0.51 * step + 1e-9)
    moved = data["motion"]
    rows = np.abs(moved["t"][:, None] + trajectory.t[0] - trajectory.t).argmin(axis=1)
    np.testing.assert_allclose(moved["q"], trajectory.q[rows], atol=1e-5)


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
            np.testing.assert_allclose(
                mean, np.sqrt(np.mean((q - other) ** 2, axis=0)) / of, rtol=0.05
            )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t, q: (t[:5], q),
            r"t has shape \(5,\) and q \(201, 2\), wanted \(N,\) and \(N, n\)",
        ),
        (lambda t, q: (t[:1], q[:1]), "the motion has 1 samples, wanted at least 2 to play"),
        (lambda t, q: (t, q[:, :1]), r"q has shape \(201, 1\), wanted \(N, 2\)"),
        (lambda t, q: (t, q * np.nan), "t or q has values that are not finite"),
        (lambda t, q: (np.r_[t[:9], t[8:-1]], q), r"t must increase, but t\[9\] = 5.08 s follows"),
    ],
)
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
