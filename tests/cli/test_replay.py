"""``robotid replay``: a log, results, a track and a ghost from files to one page."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.commanded_results import drive_entries, written_result
from helpers.mujoco_plant import plant, recorded
from helpers.paths import ROOT
from helpers.replay_data import leave_out_meshes, shown
from helpers.synthetic import exact_log, payload_log, truth

from robotid.base.exceptions import DataError
from robotid.base.files import write_json
from robotid.cli import main
from robotid.cli.replay import _of_joints, replay_identified
from robotid.data.files.read import open_table, write_columns, write_log
from robotid.data.signal_settings import LogSource
from robotid.identification.online import OnlineSettings
from robotid.identification.online import track as tracked
from robotid.output.files.result_file import load_result
from robotid.output.viewer.replays import Torques
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

URDF = str(example_urdf("ur5_robot.urdf"))


def of_boxes(urdf, path):
    """Write a URDF that shows boxes for all meshes but one: they take seconds to be thinned."""
    text = Path(urdf).read_text()
    first, *others = re.split(r"(?=<visual>)", text, maxsplit=2)[1:]
    head = text.partition("<visual>")[0]
    box = r'\g<1><box size="0.1 0.1 0.1"/>'
    others = [re.sub(r"(<visual>.*?)<mesh [^>]*/>", box, x, flags=re.DOTALL) for x in others]
    path.write_text("".join([head, first, *others]))
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A UR5, a log of one that its URDF does not describe, and what identify found in it."""
    folder = tmp_path_factory.mktemp("replay")
    urdf = of_boxes(URDF, folder / "ur5.urdf")
    model = RobotModel.from_urdf(urdf)
    rng = np.random.default_rng(0)
    log = exact_log(model, truth(model), rng, samples=1500, rate=100.0)
    write_log(log, folder / "log.csv")
    words = ["identify", urdf, str(folder / "log.csv"), "--out", str(folder / "out")]
    assert main([*words, "--estimator", "wls", "--no-report"]) == 0
    return folder


def run(folder, *words):
    target = folder / "page.html"
    code = main(["replay", str(folder / "ur5.urdf"), *map(str, words), "--html", str(target)])
    return code, shown(target.read_text(encoding="utf-8")) if code == 0 else None


def test_a_log_alone_plays_with_its_torques(folder, capsys):
    code, data = run(folder, folder / "log.csv")
    assert code == 0
    assert data["motion"]["t"][-1] == pytest.approx(14.99)
    assert data["torques"]["labels"] == ["measured"]
    assert data["masses"] == []
    assert data["notes"] == ["Motion: log.csv."]
    assert len(data["scene"]["meshes"]) > 0
    assert "page.html, " in capsys.readouterr().err


def test_a_result_predicts_and_shows_masses_before_and_after(folder):
    _, data = run(folder, folder / "log.csv", folder / "out")
    result = json.loads((folder / "out" / "result.json").read_text())
    stated = result["identification"]["per_joint"]
    assert data["torques"]["labels"] == ["measured", "identified", "URDF + drives", "URDF"]
    noise = [metrics["rmse"] for metrics in stated.values()]
    np.testing.assert_allclose(data["torques"]["scale"]["of"], noise, rtol=1e-6)
    measured, predicted, driven, _ = np.split(data["torques"]["values"], 4, axis=1)
    assert np.array_equal(np.isnan(driven), np.isnan(predicted))
    for j, metrics in enumerate(stated.values()):
        used = np.isfinite(driven[:, j])
        error = np.linalg.norm((measured - driven)[used, j]) / np.linalg.norm(measured[used, j])
        wanted = metrics["urdf_with_drives_relative_error_pct"]
        assert 100 * error == pytest.approx(wanted, rel=0.02)
    known = np.isfinite(predicted)
    assert known.mean() > 0.8
    # the motion is exact and the fit explains it, but for what the filter takes
    residual = (predicted - measured)[known]
    assert np.linalg.norm(residual) < 0.01 * np.linalg.norm(measured[known])
    value = {entry["name"]: entry["value"] for entry in result["standard_parameters"]}
    before, after = data["masses"]
    assert (before["label"], after["label"]) == ("URDF", "identified")
    for body in after["bodies"]:
        assert body["mass"] == pytest.approx(value[f"{body['name']}.m"])
    result["settings"]["validation"] = [{"log": "other.csv", "start": 3.0}, {"log": "log.csv"},
                                        {"log": "log.csv", "start": 5.0, "end": 9.0}]  # fmt: skip
    write_json(result, folder / "part.json")
    _, data = run(folder, folder / "log.csv", folder / "part.json")
    assert [(mark["t"], mark["kind"]) for mark in data["marks"]] == [(5.0, "validation")]


def test_the_urdf_with_drives_is_rnea_and_drive_terms(identified, monkeypatch):
    leave_out_meshes(monkeypatch)
    data = shown(replay_identified(identified).html)
    torques, (evaluation, *_) = data["torques"], identified.validation
    assert torques["labels"] == ["measured", "identified", "URDF + drives", "URDF"]
    assert data["log"] == Path(evaluation.recording.log.path).name
    motion, model = evaluation.recording.trajectory, identified.model
    pi = dict(zip(model.layout.names, identified.urdf_with_drives, strict=True))
    real = np.isfinite(torques["values"][:, 0])  # without the row of a gap
    values = torques["values"][real]
    rows = np.abs(torques["t"][real, None] + motion.t[0] - motion.t).argmin(axis=1)
    robot = pin.buildModelFromUrdf(str(model.tree.path))
    of_pin = robot.createData()
    bodies = [pin.rnea(robot, of_pin, motion.q[k], motion.v[k], motion.a[k]) for k in rows]
    for j, joint in ((1, model.joints[1]), (4, model.joints[4])):
        v, a = motion.v[rows, j], motion.a[rows, j]
        drive = pi[f"{joint}.armature"] * a + pi[f"{joint}.viscous"] * v
        drive += pi[f"{joint}.coulomb"] * motion.direction[rows, j] + pi[f"{joint}.offset"]
        assert np.std(drive) > 0.1
        found, used = values[:, 12 + j], evaluation.recording.mask[rows, j]
        np.testing.assert_array_equal(np.isfinite(found), used)
        wanted = (np.array(bodies)[:, j] + drive)[used]
        np.testing.assert_allclose(found[used], wanted, atol=np.ptp(wanted) / 60_000)


def test_a_track_gives_parameters_over_time_and_marks_the_load(panda, tmp_path, capsys):
    log = payload_log(panda, np.random.default_rng(0), duration=12.0, at=10.0, rate=100.0)
    write_log(log, tmp_path / "log.csv")
    urdf = of_boxes(panda.tree.path, tmp_path / "panda.urdf")
    joints = ",".join(panda.joints)
    words = [urdf, str(tmp_path / "log.csv")]
    assert main(["track", *words, "--joints", joints, "--out", str(tmp_path / "track")]) == 0
    page = tmp_path / "page.html"
    assert main(["replay", *words, str(tmp_path / "track"), "--html", str(page)]) == 0
    data = shown(page.read_text(encoding="utf-8"))
    track = json.loads((tmp_path / "track" / "track.json").read_text())
    (mark,) = data["marks"]
    assert mark["kind"] == "payload"
    assert mark["t"] == pytest.approx(10.0, abs=0.05)
    assert mark["label"].endswith("kg on panda_link7")
    entries = track["base_parameters"]
    assert data["bands"]["names"] == [entry["name"] for entry in entries]
    wanted = [e["value"] for e in entries] + [e["std_error"] for e in entries]
    np.testing.assert_allclose(data["bands"]["values"][-1], wanted, rtol=1e-6)


def test_a_track_has_converged_at_the_first_of_its_rows_that_say_so(tmp_path, capsys):
    urdf, out = ROOT / "urdf" / "planar_2r.urdf", tmp_path / "track"
    arm, rng = RobotModel.from_urdf(urdf), np.random.default_rng(0)
    log = exact_log(arm, truth(arm), rng, samples=1500, noise=1.0)
    write_log(log, tmp_path / "log.csv")
    words = ["--cutoff", "6", "--rate", "80", "--min-velocity", "0.3", "--out", str(out)]
    assert main(["track", str(urdf), str(tmp_path / "log.csv"), *words]) == 0
    track = json.loads((out / "track.json").read_text())
    said = " ".join(capsys.readouterr().out.split())
    assert f"samples, delay of the estimate {1e3 * track['delay']:.0f} ms, " in said
    assert f" ms, converged at {track['converged_at']:.2f} s, excitation " in said
    settings = OnlineSettings(rate=80.0, cutoff=6.0, min_velocity=0.3)
    same = tracked(arm, log, settings).identifier.reading.theta
    values = [entry["value"] for entry in track["base_parameters"]]
    np.testing.assert_allclose(values, same, rtol=1e-6)
    history = open_table(out / track["history"], LogSource()).read(["time", "converged"])
    first, *later = history["time"][history["converged"] > 0]
    assert track["converged_at"] == first > history["time"][0]
    assert later


def test_torques_of_a_floating_base_are_not_those_of_its_joints():
    model = RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True)
    rows = np.arange(18.0) + np.zeros((3, 1))
    torques = _of_joints(Torques(np.arange(3.0), rows, {"identified": -rows}), model)
    np.testing.assert_array_equal(torques.measured, rows[:, 6:])
    np.testing.assert_array_equal(torques.predicted["identified"], -rows[:, 6:])


def test_a_base_is_where_the_log_says_or_said_to_be_held(tmp_path, capsys):
    urdf = example_urdf("solo12.urdf")
    model = RobotModel.from_urdf(urdf)
    t = np.arange(300) / 100.0
    q = 0.2 * np.sin(t[:, None] + np.arange(12))
    yaw = 3.0 * t  # more than one turn
    base = np.column_stack(
        [0.5 * t, -0.2 * t, 0.3 + 0 * t, 0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)]
    )
    base[150:, 3:] *= -1  # the same turns
    names = ["base_x", "base_y", "base_z", "base_qx", "base_qy", "base_qz", "base_qw"]

    def play(table, header):
        path = tmp_path / "log.csv"
        np.savetxt(path, table, delimiter=",", header=",".join(header), comments="")
        code = main(["replay", str(urdf), str(path), "--html", str(tmp_path / "r.html")])
        return shown((tmp_path / "r.html").read_text(encoding="utf-8")) if code == 0 else None

    columns = ["time", *(f"q_{j}" for j in model.joints), *(f"tau_{j}" for j in model.joints)]
    rows = np.column_stack([t, q, 0.1 * q])
    held = play(rows, columns)
    assert "The base is drawn as fixed: the log has no pose of the base." in held["notes"]
    told = base.copy()
    told[149] = np.nan  # between two signs of one turn
    data = play(np.column_stack([rows, told]), [*columns, *names])
    assert not any("drawn as fixed" in note for note in data["notes"])
    assert data["torques"]["labels"] == ["measured"]
    assert [joint["node"] for joint in data["torques"]["joints"]] == list(range(2, 14))
    times, moved = data["motion"]["t"], data["motion"]["q"]
    row = np.abs(times[:, None] - t).argmin(axis=1)
    np.testing.assert_allclose(moved[:, :3], base[row, :3], atol=1e-6)
    np.testing.assert_allclose(moved[:, 7:], q[row], atol=1e-6)
    overlap = np.abs((moved[:, 3:7] * base[row, 3:]).sum(axis=1))
    np.testing.assert_allclose(overlap, 1.0, atol=1e-6)
    assert np.linalg.norm(np.diff(moved[:, 3:7], axis=0), axis=1).max() < 0.1
    capsys.readouterr()
    base[:, 3:] *= 0.5
    assert play(np.column_stack([rows, base]), [*columns, *names]) is None
    words = "log.csv: the quaternion of the base has length 0.5 in row 0, expected 1"
    assert words in capsys.readouterr().err
    assert main(["replay", "job.toml", "result"]) == 2
    assert "job.toml is a job file, expected URDF LOG [RESULT ...]" in capsys.readouterr().err


def test_a_motion_without_torques_plays_and_marks_where_it_uses_the_most_of_limits(folder):
    model = RobotModel.from_urdf(URDF)
    t = np.arange(401) / 100.0
    table = {"time": t}
    for j, joint in enumerate(model.joints):
        size = {"elbow_joint": 1.5, "wrist_1_joint": 0.4}.get(joint, 0.1)
        table[f"q_{joint}"] = -0.5 * (j == 1) + size * np.sin(np.pi * t / 4 * (1.3 + j)) ** 2
    write_columns(table, folder / "motion.csv")
    code, data = run(folder, folder / "motion.csv")
    assert code == 0
    assert data["torques"] is None
    marks = {mark["label"].split(" limit")[0].split()[-1]: mark for mark in data["marks"]}
    q, elbow = table["q_elbow_joint"], model.limits[2]
    share = 100 * q.max() / elbow.upper  # its range is even about 0
    said = f"elbow_joint at {share:.0f} % of its position limit"
    assert marks["position"]["label"] == said
    assert q[round(100 * marks["position"]["t"])] == pytest.approx(q.max(), abs=1e-6)
    speed = np.abs(np.gradient(q, t))
    share = 100 * speed.max() / elbow.velocity
    assert f"{share:.0f} % of its velocity" in marks["velocity"]["label"]
    assert marks["velocity"]["joint"] == "elbow_joint"
    assert speed[round(100 * marks["velocity"]["t"])] == pytest.approx(speed.max(), abs=1e-6)
    assert marks["torque"]["joint"] == "shoulder_lift_joint"  # which carries the arm
    (nearest,) = (mark for mark in data["marks"] if "smallest distance" in mark["label"])
    found = re.fullmatch(r"\w+ and \w+: smallest distance (\d+) mm", nearest["label"])
    assert 1 < int(found[1]) < 50
    assert data["notes"][1].startswith("The motion has no torques")


def test_drives_that_follow_commands_are_played_with_their_ghosts(tmp_path):
    """Poses are the URDF's, plots what the encoders read."""
    rng = np.random.default_rng(0)
    arm = plant("planar", rng, zero=0.1)
    log, _ = recorded(arm, rng, duration=3.0, rate=200.0, noise=0.0)
    write_log(log, tmp_path / "log.csv")
    urdf = str(arm.model.tree.path)
    out = written_result(
        arm, tmp_path / "out",
        settings={"urdf": urdf, "estimator": {"name": "wls"}, "identification": [{"log": "l"}]},
    )  # fmt: skip
    words = ["replay", urdf, str(tmp_path / "log.csv"), str(out), "--html"]
    ghost = ["--ghost", str(tmp_path / "log.csv")]
    assert main([*words, str(tmp_path / "page.html"), *ghost]) == 0
    data = shown((tmp_path / "page.html").read_text(encoding="utf-8"))
    again = data["ghosts"].pop()
    assert again["label"] == "log.csv"
    np.testing.assert_allclose(again["q"], data["motion"]["q"], atol=1e-6)
    assert data["torques"]["quantity"] == "position"
    assert data["torques"]["labels"] == ["measured", "simulated", "commanded"]
    assert [joint["unit"] for joint in data["torques"]["joints"]] == ["rad", "rad"]
    assert [ghost["label"] for ghost in data["ghosts"]] == ["simulated", "commanded"]
    simulated, commanded = (ghost["q"] for ghost in data["ghosts"])
    assert np.abs(simulated - data["motion"]["q"]).max() < 2e-3  # MuJoCo's robot is the true one
    assert np.abs(commanded - data["motion"]["q"]).max() > 0.1
    np.testing.assert_allclose(commanded[0], log.q_ref[0] + 0.1, atol=1e-6)
    error = np.sqrt(np.mean((log.q_ref - log.q) ** 2, axis=0))
    np.testing.assert_allclose(data["torques"]["scale"]["of"], error, rtol=1e-6)
    assert data["torques"]["scale"]["unit"] == "RMS command error"
    assert data["notes"][0] == "Motion: log.csv, as measured; ghosts: command and simulation."
    left = 1e3 * np.sqrt(np.nanmean((load_result(out).follow_commands(log) - log.q) ** 2, axis=0))
    worst = ", ".join(f"{arm.model.joints[j]} {left[j]:.2g}" for j in np.argsort(left)[::-1])
    assert data["notes"][1] == f"Simulated position error, RMS [mrad or mm]: {worst}."

    bare = [e for e in drive_entries(arm) if not e["name"].endswith((".kp", ".kd"))]
    other = load_result(written_result(arm, tmp_path / "bare", drive_parameters=bare))
    with pytest.raises(DataError, match="has no gains of drives, which a simulation"):
        other.follow_commands(log)
    with pytest.raises(DataError, match="log has no commands, columns qref_ of each joint"):
        load_result(out).follow_commands(replace(log, q_ref=None))
