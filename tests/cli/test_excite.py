import argparse
import io
import json
import re
from contextlib import redirect_stdout
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.cli import excite, main
from robotid.cli.excite import _designer, _expected
from robotid.cli.job import Job
from robotid.data.files.formats import open_table
from robotid.data.signal_settings import LogSource, SignalSettings
from robotid.design.clearance import Box
from robotid.design.design import Designer
from robotid.design.excitation_settings import MotionSettings
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
WORDS = [
    "excite", str(example_urdf("ur10_robot.urdf")), "--joints", ",".join(WRIST),
    "--duration", "4", "--harmonics", "2", "--starts", "1", "--seconds", "0.01",
]  # fmt: skip


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """What is printed of a motion with limits of its own, its columns and the page about it."""
    folder, printed = tmp_path_factory.mktemp("designed"), io.StringIO()
    stated = ["--share", "0.5", "--max-acceleration", "wrist_2_joint=3", "--floor", "-2"]
    stated += ["--points", "50", "--report", str(folder / "motion.html"), "--json"]
    with redirect_stdout(printed):
        assert main([*WORDS, "--out", str(folder / "motion.parquet"), *stated]) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["motion.html", "motion.parquet"]
    table = open_table(folder / "motion.parquet", LogSource())
    assert table.names[:2] == ["time", "q_wrist_1_joint"]
    return json.loads(printed.getvalue()), table.read(table.names), folder / "motion.html"


def test_a_motion_is_designed_written_and_told(designed):
    content, columns, _ = designed
    np.testing.assert_allclose(columns["time"], np.arange(201) / 50)
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=WRIST)
    speed = [np.abs(columns[f"dq_{j.name}"]).max() / (0.5 * j.velocity) for j in model.limits]
    assert max(speed) <= 1.0
    assert 1.0 - content["limits"]["velocity"]["margin"] == pytest.approx(max(speed), abs=0.01)
    assert content["limits"]["velocity"]["where"] == WRIST[int(np.argmax(speed))]
    assert np.abs(columns["ddq_wrist_2_joint"]).max() <= 3.0
    assert set(content["limits"]) == {
        "position", "velocity", "acceleration", "torque", "collision"
    }  # fmt: skip
    assert content["criterion"] == "D"
    assert content["feasible"] is True


def test_a_motion_beyond_a_limit_is_not_called_feasible(tmp_path, capsys, monkeypatch):
    design = Designer.design

    def beyond(*given, **stated):
        found = design(*given, **stated)
        return replace(found, used=1.2 * found.used)

    monkeypatch.setattr(Designer, "design", beyond)
    words = [*WORDS, "--out", str(tmp_path / "motion.csv"), "--json", "--clearance", "none"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["feasible"] is False


def test_the_terminal_says_what_is_left_of_each_limit(tmp_path, capsys):
    assert main([*WORDS, "--out", str(tmp_path / "motion.yaml"), "--clearance", "none"]) == 0
    said = capsys.readouterr().out
    assert "a motion of 4 s for 3 joints, condition number" in said
    assert "collision" not in said
    assert "1 start in " in said
    assert "not converged: increase --seconds" in " ".join(said.split())
    assert said.endswith(f"\nwritten:\n  {tmp_path / 'motion.yaml'}\n")
    assert (tmp_path / "motion.yaml").read_text().startswith("joint_names: [wrist_1_joint, ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--clearance", "near"], "--clearance 'near': wanted metres, or none"),
        (["--box", "post=1,2,3"], "--box 'post=1,2,3': wanted NAME=x0,y0,z0,x1,y1,z1"),
        (["--duration", "-1"], "duration is -1.0, wanted 0.1 to 3600 s"),
        (["--max-jerk", "elbow=3"], "jerk is stated for 'elbow', which is not a moving joint"),
        (["--noise", "wrist_1_joint=-1"], "noise of 'wrist_1_joint' is -1, wanted 1e-09 to 1e+12"),
        (["--harmonics", "1"], "harmonics is 1, wanted 2 to 100"),
        (["--harmonics", "100000"], "harmonics is 100000, wanted 2 to 100"),
        (["--duration", "1e9"], "duration is 1000000000.0, wanted 0.1 to 3600 s"),
        (["--points", "1e9"], "points is 1000000000.0, wanted 0.1 to 100000 rows per second"),
        (["--seconds", "0"], "seconds is 0.0, wanted 0.001 or more s"),
        (["--seed", "-1"], "seed is -1, wanted 0 or a positive whole number"),
        (["--floor", "1e300"], "floor is 1e+300, wanted at most 1000 m"),
        (
            ["--max-jerk", "wrist_1_joint=1e300"],
            "jerk of 'wrist_1_joint' is 1e+300, wanted",
        ),
        (["--box", "post=0,0,0,1,1,nan"], "the lower and the upper corner [m], within 1000 m"),
        (["--criterion", "widest"], "criterion is widest, which needs an earlier result"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(tmp_path, capsys, words, message):
    at = WORDS.index(words[0]) if words[0] in WORDS else len(WORDS)
    own = [*WORDS[:at], *words, *WORDS[at + 2 :]]
    assert main([*own, "--out", str(tmp_path / "m.csv")]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_page_says_what_is_used_of_each_limit_and_draws_it(designed):
    content, columns, page = designed
    assert content["report"] == str(page)
    html = page.read_text()
    shown = {
        cells[0]: cells[1:]
        for row in re.findall(r"<tr>(.*?)</tr>", html)
        if (cells := re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row))
    }
    for name, unit in (("velocity", "rad/s"), ("acceleration", "rad/s²")):
        entry, cells = content["limits"][name], shown[name]
        assert float(cells[0]) == pytest.approx(100 * (1 - entry["margin"]), abs=0.06)
        assert cells[2].replace("<wbr>", "") == entry["where"]
        assert cells[5] == unit
        values = columns[{"velocity": "dq_", "acceleration": "ddq_"}[name] + entry["where"]]
        at = columns["time"][int(np.argmax(np.abs(values)))]
        assert float(cells[3]) == pytest.approx(at, abs=0.02)
    charts = [
        json.loads(text)
        for text in re.findall(r'<script type="application/json">(.*?)</script>', html)
    ]
    drawn = {chart["title"]: [s["label"] for s in chart["series"]] for chart in charts}
    assert drawn["acceleration of each joint relative to its limit"][2:] == ["wrist_2_joint"]
    assert drawn["acceleration of each joint"] == ["wrist_1_joint", "wrist_3_joint"]
    assert "floor and boxes" in drawn["distance of the two nearest hulls"]
    velocity = next(c for c in charts if c["title"].startswith("velocity"))
    assert velocity["link"] == "time"
    assert [velocity["series"][k]["y"]["low"] for k in (0, 1)] == [100.0, -100.0]
    assert "motion.parquet: the motion determines" in html


def test_a_page_that_cannot_be_written_is_refused_before_the_design(tmp_path, capsys):
    words = ["--out", str(tmp_path / "m.csv"), "--report", str(tmp_path / "none" / "m.html")]
    assert main([*WORDS, *words]) == 1
    assert f"{tmp_path / 'none'}" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_sweeps_say_what_they_use_of_jerk_and_refuse_what_is_too_little(tmp_path, capsys):
    words = [*WORDS, "--kind", "sweeps", "--clearance", "none", "--json"]
    words += ["--out", str(tmp_path / "m.csv"), "--points", "100", "--max-jerk"]
    assert main([*words, "wrist_2_joint=1000"]) == 0
    content = json.loads(capsys.readouterr().out)
    columns = open_table(tmp_path / "m.csv", LogSource()).read(["time", "ddq_wrist_2_joint"])
    jerk = np.gradient(columns["ddq_wrist_2_joint"], columns["time"])
    used = 1.0 - content["limits"]["jerk"]["margin"]
    assert used == pytest.approx(np.abs(jerk).max() / 1000, rel=0.05)
    assert content["seconds"] > 0.0
    (tmp_path / "m.csv").unlink()
    assert main([*words, "wrist_2_joint=20"]) == 2
    assert "wrist_2_joint needs " in (said := capsys.readouterr().err)
    assert f"{100 * used * 50:.0f} % of its jerk limit at " in said
    assert not list(tmp_path.iterdir())


def test_a_payload_is_found_by_a_motion_of_the_few_joints_that_show_it(tmp_path, capsys):
    robot, motion = str(example_urdf("ur10_robot.urdf")), str(tmp_path / "motion.parquet")
    words = ["--kind", "payload", "--mass", "2", "--com", "0.02,0.01,0.05", "--harmonics", "3",
             "--duration", "5", "--starts", "1", "--seconds", "0.5",
             "--clearance", "none"]  # fmt: skip
    page = ["--report", str(tmp_path / "motion.html")]
    assert main(["excite", robot, "--out", motion, "--json", *words, *page]) == 0
    told = json.loads(capsys.readouterr().out)["payload"]
    assert told["moving"] == WRIST
    columns = open_table(tmp_path / "motion.parquet", LogSource()).read(
        ["q_elbow_joint", "q_wrist_2_joint"]
    )
    assert np.ptp(columns["q_elbow_joint"]) == 0.0
    assert told["resting"]["elbow_joint"] == pytest.approx(columns["q_elbow_joint"][0])
    assert (
        "For a payload on wrist_3_link, wrist_1_joint, wrist_2_joint, wrist_3_joint move;"
        in (tmp_path / "motion.html").read_text()
    )
    plant = tmp_path / "plant.toml"
    plant.write_text(
        "[payload]\nmass = 2.0\ncom = [0.02, 0.01, 0.05]\n"
        "inertia = [0.02, 0.0, 0.025, 0.0, 0.0, 0.015]\n"
    )
    logs = [str(tmp_path / name) for name in ("loaded.parquet", "bare.parquet")]
    for log, own in zip(logs, (["--plant", str(plant)], []), strict=True):
        noisy = ["--rate", "200", "--torque-noise", "0.02", "--perturb", "0.1", "--seed", "3"]
        noisy += ["--controller", "perfect"]
        assert main(["simulate", robot, motion, "--out", log, *noisy, *own, "--json"]) == 0
    capsys.readouterr()
    assert main(["payload", robot, logs[0], "--reference", logs[1], "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["payloads"][0]
    low, high = found["mass_interval"]
    assert low < 2.0 < high < low + 0.6
    error = np.subtract(found["com"], [0.02, 0.01, 0.05])
    assert (np.abs(error) < 3 * np.array(found["com_std_error"])).all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--mass", "2"], "a payload or moving joints are stated, but kind is 'fourier'"),
        (
            ["--kind", "payload", "--moving", "elbow"],
            "elbow cannot move wrist_3_link, wanted joints that",
        ),
        (["--kind", "payload", "--mass", "-1"], "mass"),
        (["--kind", "payload", "--com", "1,2,3"], "--com '1,2,3': wanted three numbers"),
        (["--kind", "payload", "--mass", "1", "--com", "1,2"], "--com '1,2': wanted three"),
        (["--kind", "payload", "--link", "tool"], "link 'tool' is not in ur10_robot.urdf"),
    ],
)
def test_flags_of_a_payload_that_do_not_fit_are_refused(tmp_path, capsys, words, message):
    assert main([*WORDS, "--out", str(tmp_path / "m.csv"), *words]) == (
        1 if "--link" in words else 2
    )
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_after_a_result_a_motion_is_made_for_what_it_knows_the_least(tmp_path, capsys):
    motion, log, out = (str(tmp_path / name) for name in ("m.parquet", "log.parquet", "out"))
    words = [*WORDS, "--clearance", "none", "--out", motion]
    assert main([*words, "--json"]) == 0
    robot = [WORDS[1], WORDS[2], WORDS[3]]
    noisy = ["--rate", "100", "--torque-noise", "0.02", "--controller", "perfect"]
    assert main(["simulate", robot[0], motion, *robot[1:], "--out", log, *noisy, "--json"]) == 0
    plain = ["--estimator", "wls", "--friction", "viscous+coulomb", "--json"]
    assert main(["identify", robot[0], log, *robot[1:], "--out", out, *plain]) == 0
    capsys.readouterr()
    assert main([*words, "--given", out]) == 0
    assert "designed for the parameters with the widest intervals: " in " ".join(
        capsys.readouterr().out.split()
    )
    assert main([*words, "--given", out, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["criterion"] == "widest"
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    names = [entry["name"] for entry in result["base_parameters"]]
    assert len(content["widest"]) == round(len(names) / 4)
    assert set(content["widest"]) < set(names)
    assert main([*words, "--given", out, "--criterion", "A", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["criterion"] == "A"
    assert "widest" not in content


PAN_TILT = """<robot name="pan_tilt"><link name="base"/><link name="pan"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="tilt">
<inertial><origin xyz=".05 0 0"/><mass value="1"/>
<inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="revolute"><parent link="base"/><child link="pan"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="2" effort="10"/></joint>
<joint name="b" type="revolute"><parent link="pan"/><child link="tilt"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="2" effort="10"/></joint></robot>"""
SHAPE = '<collision><geometry><box size=".05 .05 .05"/></geometry></collision></link>'


@pytest.mark.parametrize("kind", ["fourier", "stands"])
def test_a_robot_without_links_to_keep_apart_moves_too(tmp_path, kind, capsys):
    """Neighbours touch, so of three links in a row only the first and the last could collide."""
    urdf, out = tmp_path / "pan_tilt.urdf", tmp_path / "motion.csv"
    urdf.write_text(PAN_TILT.replace("</link>", SHAPE))
    words = ["--duration", "2", "--seconds", "0.5", "--starts", "1", "--kind", kind]
    assert main(["excite", str(urdf), "--out", str(out), *words]) == 0
    assert "no pair of links or obstacles comes close" in " ".join(capsys.readouterr().out.split())
    q = np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:3]
    assert (np.ptp(q, axis=0) > 0.2).all()
    assert (np.abs(q) <= [2.0, 1.0]).all()


@pytest.fixture
def pan_tilt(tmp_path):
    urdf = tmp_path / "pan_tilt.urdf"
    urdf.write_text(PAN_TILT.replace("</link>", SHAPE))
    return urdf


def test_every_setting_reaches_what_designs(pan_tilt):
    each = {"a": 3.0, "b": 0.5}
    settings = MotionSettings(
        kind="bspline", duration=4.0, harmonics=3, criterion="E", share=0.5, clearance=0.1,
        floor=-0.25, acceleration=each, jerk={"a": 40.0, "b": 50.0}, power={"a": 6.0, "b": 7.0},
        noise={"a": 0.2, "b": 0.6}, seconds=1.0, boxes=(Box("post", (1, 1, 0), (2, 3, 4)),),
    )  # fmt: skip
    designer, run = _designer(Job(pan_tilt), settings, None)
    assert run is None
    assert designer.name == "E"
    np.testing.assert_allclose(
        designer.limits.sizes,
        # half the range, speed and effort of the URDF, and what is stated
        [[1.0, 0.5], [1.0, 1.0], [3.0, 0.5], [40.0, 50.0], [5.0, 5.0], [6.0, 7.0]],
    )
    assert (designer.basis.duration, designer.basis.pieces) == (4.0, 6)
    assert designer.noise[1] / designer.noise[0] == pytest.approx(9.0)  # variances
    clearance = designer.clearance
    assert clearance.least == 0.1
    post, floor = clearance._hulls[-2:]
    assert (post.name, floor.name) == ("post", "the floor")
    assert post.centre.tolist() == [1.5, 2.0, 2.0]
    assert post.half.tolist() == [0.5, 1.0, 2.0]
    assert floor.centre[2] + floor.half[2] == pytest.approx(-0.25)
    basis = _designer(
        Job(pan_tilt), MotionSettings(duration=4.0, harmonics=3, clearance=None), None
    )
    assert (basis[0].basis.duration, basis[0].basis.harmonics) == (4.0, 3)
    assert (basis[0].name, basis[0].clearance) == ("D", None)


def test_what_is_expected_of_a_motion_rests_on_the_noise_that_is_stated(pan_tilt, rng):
    model = RobotModel.from_urdf(pan_tilt)
    motion = random_fourier(model, rng, period=4.0)
    settings = MotionSettings(points=50.0, noise={"a": 0.2, "b": 0.6})
    job = Job(pan_tilt, signals=SignalSettings(cutoff=None, trim=0.0))
    design = SimpleNamespace(motion=motion, duration=3.995)  # it ends before the last row
    found = _expected(job, model, design, settings, None, "m.csv")
    assert found.noise.std.tolist() == [0.2, 0.6]
    (evaluation,) = found.expected.fitted
    trajectory = evaluation.recording.trajectory
    np.testing.assert_allclose(trajectory.t, np.arange(201) / 50.0)
    rows = motion.evaluate(np.minimum(trajectory.t, 3.995))
    for name, values in zip("qva", rows, strict=True):
        np.testing.assert_allclose(getattr(trajectory, name), values, atol=1e-12)
    assert evaluation.recording.log.path == "m.csv"
    assert found.before is None


def test_a_box_is_kept_away_from_and_a_seed_makes_the_same_motion_again(pan_tilt, capsys):
    """The tilting link is a cube of 5 cm that turns about its centre: a wall is 6 cm from it."""

    def designed(*words, seconds="60"):
        out = pan_tilt.with_name("motion.csv")
        quick = ["--duration", "2", "--seconds", seconds, "--starts", "1", "--points", "1000"]
        quick += ["--harmonics", "2"]
        command = ["excite", str(pan_tilt), "--out", str(out), *quick, "--json", *words]
        assert main(command) == 0
        return json.loads(capsys.readouterr().out)["limits"]["collision"], out.read_text()

    wall = ["--box", "post=5,5,5,6,6,6", "--box", "wall=0.06,-1,-1,0.2,1,1"]
    near, first = designed(*wall, "--seed", "3")
    assert near["where"] == "tilt and wall"
    assert near["kept"] == 0.02
    # the distance by hand: how far the farthest corner of the cube reaches, turned by b, then by a
    x, y, z = 0.025 * np.stack(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8, 1)
    a, b = np.loadtxt(first.splitlines(), delimiter=",", skiprows=1)[:, 1:3].T
    reach = (np.cos(a) * (np.cos(b) * x + np.sin(b) * z) - np.sin(a) * y).max(axis=0)
    apart = 0.06 - reach.max()
    assert apart - 0.001 <= near["margin"] + near["kept"] <= apart + 1e-6  # a bound to 1 mm
    assert 0.0 <= near["margin"] < 0.01
    # the first motion of the search
    made = [designed(*wall, "--seed", x, seconds="0.001")[1] for x in ("3", "3", "4")]
    assert made[0] == made[1] != made[2]


def test_a_motion_too_short_for_its_page_is_not_written_either(tmp_path, capsys):
    urdf, out, page = (tmp_path / name for name in ("pan_tilt.urdf", "motion.csv", "page.html"))
    urdf.write_text(PAN_TILT)
    words = ["--duration", "0.1", "--seconds", "0.1", "--starts", "1", "--clearance", "none"]
    words = ["excite", str(urdf), "--out", str(out), *words]
    assert main([*words, "--report", str(page)]) == 1
    assert "is long enough for the filter" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
    assert not page.exists()
    assert main(words) == 0
    assert out.exists()


def test_a_format_that_motions_are_not_written_in_is_refused_before_the_design(tmp_path, capsys):
    urdf = str(example_urdf("ur5_robot.urdf"))
    assert main(["excite", urdf, "--out", str(tmp_path / "motion.txt")]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "motion.txt: motions are written as .csv, .parquet, " in said
    assert ".yaml or .script files, not '.txt'" in said


def test_limits_that_the_urdf_states_as_zero_are_stated_by_flags(tmp_path):
    text = example_urdf("ur10_robot.urdf").read_text()
    zero = re.sub(r'effort="[^"]*"', 'effort="0"', text)
    (tmp_path / "zero.urdf").write_text(re.sub(r'velocity="[^"]*"', 'velocity="0"', zero))
    words = ["excite", str(tmp_path / "zero.urdf"), *WORDS[2:], "--clearance", "none"]
    words += ["--out", str(tmp_path / "motion.csv")]
    assert main(words) == 2
    for joint in WRIST:
        words += ["--max-velocity", f"{joint}=0.7", "--max-torque", f"{joint}=30"]
    assert main(words) == 0
    table = open_table(tmp_path / "motion.csv", LogSource())
    speeds = table.read([f"dq_{joint}" for joint in WRIST]).values()
    assert 0.3 < max(np.abs(speed).max() for speed in speeds) <= 0.7


def test_every_flag_states_its_setting():
    """Each with a value that is not the default, two where the flag is repeatable."""
    words = {
        "kind": "bspline", "duration": "4", "harmonics": "3", "criterion": "E", "share": "0.5",
        "clearance": "0.1", "floor": "-0.2", "seed": "7", "starts": "2", "seconds": "9",
        "points": "50",
    }  # fmt: skip
    line = [word for name, value in words.items() for word in (f"--{name}", value)]
    for flag in (
        "--max-velocity",
        "--max-torque",
        "--max-acceleration",
        "--max-jerk",
        "--max-power",
        "--noise",
    ):
        line += [flag, "one=3", flag, "two=0.5"]
    line += ["--box", "post=0,1,2,3,4,5", "--box", "wall=-1,0,0,0,1,1"]
    found = stated_by_flags(*line)
    each = {"one": 3.0, "two": 0.5}
    assert found == MotionSettings(
        kind="bspline", duration=4.0, harmonics=3, criterion="E", share=0.5, clearance=0.1,
        floor=-0.2, seed=7, starts=2, seconds=9.0, points=50.0,
        velocity=each, torque=each, acceleration=each, jerk=each, power=each, noise=each,
        boxes=(Box("post", (0, 1, 2), (3, 4, 5)), Box("wall", (-1, 0, 0), (0, 1, 1))),
    )  # fmt: skip
    load = ["--link", "wrist_3_link", "--mass", "2", "--com", "0.1,0,-0.2", "--moving", "one,two"]
    found = stated_by_flags("--kind", "payload", "--clearance", "none", *load)
    payload = Payload(link="wrist_3_link", mass=2.0, com=(0.1, 0.0, -0.2))
    assert (found.payload, found.moving, found.clearance) == (payload, ("one", "two"), None)
    assert stated_by_flags() == MotionSettings()


def stated_by_flags(*words):
    parser = argparse.ArgumentParser()
    excite.add_flags(parser)
    return excite.motion_settings(parser.parse_args(["arm.urdf", "--out", "m.csv", *words]))


def test_a_floating_base_and_a_robot_with_contacts_are_refused(tmp_path, capsys):
    for lines, found in (
        ("free_flyer = true", "the base floats"),
        ('[[contact]]\nframe = "FL_foot"', "the robot has contacts or loops"),
    ):
        job = tmp_path / "go1.toml"
        job.write_text(f"urdf = {json.dumps(str(example_urdf('go1.urdf')))}\n{lines}\n")
        assert main(["excite", str(job), "--out", str(tmp_path / "motion.csv")]) == 1
        said = " ".join(capsys.readouterr().err.split())
        assert f"{found}; motion design needs a robot with a fixed base" in said
