import argparse
import json

import numpy as np
import pytest

from robotid.cli import excite, main
from robotid.design.clearance import Box
from robotid.design.excitation import MotionSettings
from robotid.robot.examples import example_urdf

WRIST = ["wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
WORDS = [
    "excite", str(example_urdf("ur10_robot.urdf")), "--joints", ",".join(WRIST),
    "--duration", "4", "--harmonics", "2", "--starts", "1", "--seconds", "0.01",
]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--clearance", "none", "--floor", "0"], "clearance is none, expected metres: a floor or"),
        (["--clearance", "near"], "--clearance 'near': expected metres, or none"),
        (["--box", "post=1,2,3"], "--box 'post=1,2,3': expected NAME=x0,y0,z0,x1,y1,z1"),
        (["--duration", "-1"], "duration is -1.0, expected 0.1 to 3600 s"),
        (["--max-jerk", "elbow=3"], "jerk is given for 'elbow', which is not a moving joint"),
        (["--noise", "wrist_1_joint=-1"], "of 'wrist_1_joint' is -1, expected 1e-09 to 1e+12"),
        (["--harmonics", "1"], "harmonics is 1, expected 2 to 100"),
        (["--harmonics", "100000"], "harmonics is 100000, expected 2 to 100"),
        (["--duration", "1e9"], "duration is 1000000000.0, expected 0.1 to 3600 s"),
        (["--points", "1e9"], "points is 1000000000.0, expected 0.1 to 100000 rows per second"),
        (["--seconds", "0"], "seconds is 0.0, expected 0.001 or more s"),
        (["--seed", "-1"], "seed is -1, expected 0 or a positive whole number"),
        (["--floor", "1e300"], "floor is 1e+300, expected at most 1000 m"),
        (["--max-jerk", "wrist_1_joint=1e300"], "jerk of 'wrist_1_joint' is 1e+300, expected"),
        (["--box", "post=0,0,0,1,1,nan"], "the lower and the upper corner [m], within 1000 m"),
        (["--criterion", "widest"], "criterion is widest, which needs an earlier result"),
        (["--kind", "sweeps", "--max-jerk", "wrist_1_joint=100"], "needs 211 % of its jerk limit"),
    ],
)
def test_bad_flags_are_refused_before_anything_is_written(tmp_path, capsys, words, message):
    at = WORDS.index(words[0]) if words[0] in WORDS else len(WORDS)
    own = [*WORDS[:at], *words, *WORDS[at + 2 :]]
    assert main([*own, "--out", str(tmp_path / "m.csv")]) == 2
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
    said = " ".join(capsys.readouterr().out.split())
    assert "designed for the parameters with the widest intervals: " in said
    assert " collision not checked (--clearance none) written: " in said
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


@pytest.fixture
def pan_tilt(tmp_path):
    urdf = tmp_path / "pan_tilt.urdf"
    urdf.write_text(PAN_TILT.replace("</link>", SHAPE))
    return urdf


def test_a_box_is_kept_away_from_and_a_seed_makes_the_same_motion_again(pan_tilt, capsys):
    """The tilting link is a cube of 5 cm that turns about its centre: a wall is 6 cm from it."""

    def designed(*words, seconds="60"):
        out = pan_tilt.with_name("motion.csv")
        quick = ["--duration", "2", "--seconds", seconds, "--starts", "1", "--points", "1000"]
        quick += ["--harmonics", "2"]
        command = ["excite", str(pan_tilt), "--out", str(out), *quick, "--json", *words]
        assert main(command) == 0
        return json.loads(capsys.readouterr().out), out.read_text()

    wall = ["--box", "post=5,5,5,6,6,6", "--box", "wall=0.06,-1,-1,0.2,1,1"]
    content, first = designed(*wall, "--seed", "3")
    near = content["limits"]["collision"]
    assert near["where"] == "tilt and wall"
    assert near["kept"] == 0.02
    words = f"{1e3 * near['margin']:5.1f} mm above the clearance of 20 mm, tilt and wall at "
    assert excite._margin("collision", near) == f"{words}{near['time']:.2f} s"
    # the distance by hand: how far the farthest corner of the cube reaches, turned by b, then by a
    x, y, z = 0.025 * np.stack(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8, 1)
    a, b = np.loadtxt(first.splitlines(), delimiter=",", skiprows=1)[:, 1:3].T
    reach = (np.cos(a) * (np.cos(b) * x + np.sin(b) * z) - np.sin(a) * y).max(axis=0)
    apart = 0.06 - reach.max()
    assert apart - 0.001 <= near["margin"] + near["kept"] <= apart + 1e-6  # a bound to 1 mm
    assert 0.0 <= near["margin"] < 0.01
    # the first motion of the search
    made = [designed(*wall, "--seed", x, seconds="0.001") for x in ("3", "3", "4")]
    assert made[0][1] == made[1][1] != made[2][1]
    noisy, _ = designed(*wall, "--seed", "3", "--noise", "a=5", seconds="0.001")
    assert noisy["objective"] != made[0][0]["objective"]
    low, _ = designed("--floor", "-0.07", seconds="0.001")
    assert "floor" in low["limits"]["collision"]["where"]


def test_a_missing_position_range_has_a_remedy_that_works(pan_tilt, capsys):
    text = pan_tilt.read_text().replace('lower="-1" upper="1" ', "")
    command = ["excite", str(pan_tilt), "--out", str(pan_tilt.with_name("m.csv")), "--seconds=0.01"]
    for kind, code in (("revolute", 2), ("continuous", 0)):
        pan_tilt.write_text(text.replace('"b" type="revolute"', f'"b" type="{kind}"'))
        assert main(command) == code
    wanted = 'no limit of b (position); add <limit lower upper velocity effort>, set type="contin'
    assert wanted in capsys.readouterr().err


def test_a_format_that_motions_are_not_written_in_is_refused_before_the_design(tmp_path, capsys):
    urdf = str(example_urdf("ur5_robot.urdf"))
    assert main(["excite", urdf, "--out", str(tmp_path / "motion.txt")]) == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "motion.txt: motions are written as .csv, .parquet, " in said
    assert ".yaml or .script files, not '.txt'" in said


def test_every_flag_states_its_setting():
    """Each with a value that is not the default, two where the flag is repeatable."""
    stated = {
        "kind": "sweeps", "duration": 4.0, "harmonics": 3, "criterion": "E", "share": 0.5,
        "clearance": 0.1, "floor": -0.2, "seed": 7, "starts": 2, "seconds": 9.0, "points": 50.0,
    }  # fmt: skip
    line = [f"--{name}={value}" for name, value in stated.items()]
    limits = ("velocity", "torque", "acceleration", "jerk", "power")
    for flag in (*[f"--max-{x}" for x in limits], "--noise"):
        line += [flag, "one=3", flag, "two=0.5"]
    line += ["--box", "post=0,1,2,3,4,5", "--box", "wall=-1,0,0,0,1,1"]
    stated |= {x: {"one": 3.0, "two": 0.5} for x in (*limits, "noise")}
    boxes = (Box("post", (0, 1, 2), (3, 4, 5)), Box("wall", (-1, 0, 0), (0, 1, 1)))
    assert stated_by_flags(*line) == MotionSettings(**stated, boxes=boxes)
    assert stated_by_flags("--clearance", "none").clearance is None
    assert stated_by_flags() == MotionSettings()


def stated_by_flags(*words):
    parser = argparse.ArgumentParser()
    excite.add_flags(parser)
    options = parser.parse_args(["arm.urdf", "--out", "m.csv", *words])
    return MotionSettings.from_dict(excite.MOTION.stated(options))


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
