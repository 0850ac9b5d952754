import base64
import json
import os
import re

import numpy as np
import pinocchio as pin
import pytest
import umsgpack

from robotid.exceptions import DataError, SettingsError
from robotid.model import RobotModel
from robotid.visualization import write_replay

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
    path = write_replay(arm, *motion, folder / "replay.html")
    assert path == folder / "replay.html"
    assert [p.name for p in folder.iterdir()] == ["replay.html"]
    return path.read_text(encoding="utf-8")


def commands(html):
    packed = json.loads(re.search(r"const commands = (\[.*\]);", html)[1])
    return [umsgpack.unpackb(base64.b64decode(text)) for text in packed]


def world_poses(found, time_index):
    """Return the world pose of every animated node at a keyframe, the chain multiplied out."""
    (animation,) = [c for c in found if c["type"] == "set_animation"]
    poses = {}
    for clip in sorted(animation["animations"], key=lambda clip: len(clip["path"])):
        tracks = {t["name"]: [k["value"] for k in t["keys"]] for t in clip["clip"]["tracks"]}
        turn = pin.Quaternion(np.array(tracks[".quaternion"][time_index])).normalized()
        positions = tracks[".position"]
        position = np.array(positions[time_index if len(positions) > 1 else 0])
        parent = poses.get(clip["path"].rsplit("/", 1)[0], pin.SE3.Identity())
        poses[clip["path"]] = parent * pin.SE3(turn.toRotationMatrix(), position)
    return list(poses.values())


def test_the_page_fetches_nothing_and_cannot_be_injected(page):
    outside = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)=", page.split("MeshCat")[0])
    assert "src=" not in outside
    assert "href=" not in outside
    assert "http" not in outside
    assert "<b>x</b>" not in page
    assert "<title>&lt;b&gt;x&lt;/b&gt;: replay</title>" in outside
    assert page.count("</script>") == 2
    assert "MeshCat.Viewer" in page


def test_keyframes_have_the_true_times_at_the_rate(page):
    (animation,) = [c for c in commands(page) if c["type"] == "set_animation"]
    assert len(animation["animations"]) == 2
    for clip in animation["animations"]:
        assert clip["clip"]["fps"] == 1
        (turn,) = [t for t in clip["clip"]["tracks"] if t["name"] == ".quaternion"]
        times = np.array([key["time"] for key in turn["keys"]])
        assert (times[0], times[-1]) == (0.0, pytest.approx(2.0))
        assert np.diff(times).max() <= 1 / 30 + 0.0101
        assert 55 <= len(times) <= 63


def test_every_keyframe_is_the_robot_s_pose(arm, motion, page):
    t, q = motion
    found = commands(page)
    keys = found[-1]["animations"][0]["clip"]["tracks"][0]["keys"]
    data = arm.pin_model.createData()
    for k in (0, 17, len(keys) - 1):
        row = int(np.argmin(np.abs(t - t[0] - keys[k]["time"])))
        pin.forwardKinematics(arm.pin_model, data, arm.configurations(q)[row])
        for shown, true in zip(world_poses(found, k), list(data.oMi)[1:], strict=True):
            # keyframes are single precision
            np.testing.assert_allclose(shown.homogeneous, true.homogeneous, atol=1e-6)


def test_the_first_pose_is_set_without_the_animation(arm, motion, page):
    poses = [c for c in commands(page) if c["type"] == "set_transform" and "part" not in c["path"]]
    assert [c["path"] for c in poses] == [
        "/meshcat/robot/1 turn|1",
        "/meshcat/robot/1 turn|1/2 slide",
    ]
    data = arm.pin_model.createData()
    pin.forwardKinematics(arm.pin_model, data, arm.configurations(motion[1])[0])
    for command, M in zip(poses, list(data.liMi)[1:], strict=True):
        shown = np.array(command["matrix"]).reshape(4, 4).T
        np.testing.assert_allclose(shown, M.homogeneous, atol=1e-6)


def test_links_reach_from_joint_to_joint_and_to_the_tip(page):
    shapes = {c["path"]: c["object"]["geometries"][0] for c in commands(page) if "object" in c}
    tall = [shape["height"] for path, shape in shapes.items() if path.endswith("part 0")]
    np.testing.assert_allclose(tall, [0.3, 0.4, 0.2], atol=1e-6)


def test_a_floating_base_moves(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    model = RobotModel.from_urdf(path, free_flyer=True)
    t = np.linspace(0.0, 1.0, 11)
    q = np.zeros((11, 9))
    q[:, 0], q[:, 2] = t, 0.5
    q[:, 5:7] = np.column_stack([np.sin(t / 2), np.cos(t / 2)])
    page = write_replay(model, t, q, tmp_path / "r.html").read_text(encoding="utf-8")
    base = world_poses(commands(page), -1)[0]
    np.testing.assert_allclose(base.translation, [1.0, 0.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(pin.log3(base.rotation), [0.0, 0.0, 1.0], atol=1e-6)


def test_a_long_motion_of_seven_joints_stays_below_20_mb(panda, tmp_path):
    t = np.arange(200_000) / 100.0
    q = np.sin(t)[:, None] * np.ones(7)
    assert write_replay(panda, t, q, tmp_path / "r.html").stat().st_size < 20e6


def test_no_process_no_socket_and_no_output_is_left(arm, motion, tmp_path, capfd, monkeypatch):
    import subprocess

    import zmq

    def refuse(*_, **__):
        raise AssertionError("a server was started")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    monkeypatch.setattr(zmq.Context, "socket", refuse)
    write_replay(arm, *motion, tmp_path / "r.html")
    assert capfd.readouterr() == ("", "")


def test_a_failure_leaves_the_old_file_and_nothing_beside_it(arm, motion, tmp_path, monkeypatch):
    target = tmp_path / "r.html"
    target.write_text("old")

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        write_replay(arm, *motion, target)
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda t, q: (t[:5], q),
            r"t has shape \(5,\) and q \(201, 2\), wanted \(N,\) and \(N, n\)",
        ),
        (lambda t, q: (t[:1], q[:1]), "the motion has 1 samples, wanted at least 2 to play"),
        (lambda t, q: (t, q[:, :1]), r"q has shape \(201, 1\), wanted \(N, 2\)"),
        (lambda t, q: (t, q * np.nan), "t or q holds values that are not finite"),
        (lambda t, q: (np.r_[t[:9], t[8:-1]], q), r"t must increase, but t\[9\] = 5.08 s follows"),
    ],
)
def test_what_does_not_fit_is_refused(arm, motion, tmp_path, change, message):
    with pytest.raises(DataError, match=message):
        write_replay(arm, *change(*motion), tmp_path / "r.html")
    assert list(tmp_path.iterdir()) == []


def test_a_rate_that_is_not_positive_is_refused(arm, motion, tmp_path):
    with pytest.raises(SettingsError, match=r"rate is 0\.0, wanted a positive number"):
        write_replay(arm, *motion, tmp_path / "r.html", rate=0.0)


def test_a_missing_folder_is_named(arm, motion, tmp_path):
    with pytest.raises(DataError, match=r"there is no folder '.*nowhere' to write r\.html in"):
        write_replay(arm, *motion, tmp_path / "nowhere" / "r.html")
