"""`robotid preview`: from positions to what they will tell, and to what they told."""

import json
import re

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.cli.identify import run_job
from robotid.cli.job import job_from_settings
from robotid.data.files.read import write_columns, write_log
from robotid.robot.examples import example_urdf

NOISE = np.array([2.0, 3.0, 1.0, 0.3, 0.2, 0.1])  # [N m]
ARM = str(example_urdf("ur5_robot.urdf"))


@pytest.fixture(scope="module")
def files(ur5, tmp_path_factory):
    """A log and its result, and the same and another motion without torques."""
    folder = tmp_path_factory.mktemp("preview")
    for seed, name in enumerate(("log", "other")):
        rng = np.random.default_rng(seed)
        log = exact_log(ur5, truth(ur5), rng, samples=1200, rate=100.0, noise=NOISE)
        write_log(log, folder / f"{name}.csv")
        columns = {f"q_{joint}": log.q[:, j] for j, joint in enumerate(ur5.joints)}
        write_columns({"time": log.t} | columns, folder / f"{name}_motion.csv")
    table = {
        "urdf": ARM,
        "identification": [{"log": "log.csv"}],
        "estimator": {"name": "wls"},
        "model": {"friction": "viscous+coulomb"},
    }
    run_job(job_from_settings(table, "job.toml", folder), folder / "out")
    return folder


def asked(capsys, *words, code=0):
    assert main(["preview", ARM, *map(str, words)]) == code
    printed = capsys.readouterr()
    return printed.out if code == 0 else printed.err


def base(content, key="std_error"):
    return {entry["name"]: entry[key] for entry in content["base_parameters"]}


def test_a_motion_without_torques_is_previewed(files, ur5, capsys):
    words = [f"--noise={j}={s}" for j, s in zip(ur5.joints, NOISE, strict=True)]
    plain = json.loads(asked(capsys, files / "log_motion.csv", "--json", *words[1:]))
    assert plain["noise"]["elbow_joint"] == {
        "std": 1.0, "unit": "N m", "correlation": 0.1, "is": "stated",
    }  # fmt: skip
    assert plain["noise"]["shoulder_pan_joint"]["std"] == pytest.approx(1.5)
    assert plain["noise"]["shoulder_pan_joint"]["is"] == "assumed"
    assert plain["undetermined"] == plain["structure"]["undetermined"]
    for entry in plain["base_parameters"]:
        assert 0 < entry["std_error"] <= entry["plausible"] * 1.001
        assert entry["name"] in entry["expression"]
    assert {e["source"] for e in plain["standard_parameters"]} <= {"data", "mixed", "prior"}
    for torque in plain["torque"].values():
        assert 0 < torque["of_parameters"] < torque["half_width"]
    whole = json.loads(asked(capsys, files / "log.csv", "--velocity", "differentiated",
                             "--acceleration", "differentiated", "--json", *words[1:]))  # fmt: skip
    assert base(whole) == base(plain)  # its torques are ignored
    white = json.loads(asked(capsys, files / "log_motion.csv", "--correlation", "0", "--json"))
    slow = json.loads(asked(capsys, files / "log_motion.csv", "--json"))
    assert sum(base(white).values()) < sum(base(slow).values())
    motions = [files / "log_motion.csv", files / "other_motion.csv"]
    both = json.loads(asked(capsys, *motions, "--json"))
    assert [motion["path"] for motion in both["motions"]] == list(map(str, motions))


def test_a_run_before_says_what_gains_most(files, capsys):
    words = [files / "other_motion.csv", "--given", files / "out"]
    content = json.loads(asked(capsys, *words, "--json"))
    assert content["estimator"] == "wls"
    assert {noise["is"] for noise in content["noise"].values()} == {"found"}
    before, after, gain = (base(content, k) for k in ("std_error_before", "std_error", "gain"))
    for name, factor in gain.items():
        assert factor >= 1.0
        assert factor <= before[name] / after[name] * 1.001
    assert max(gain.values()) > 1.3
    text = asked(capsys, *words)
    head, *rows = text.partition("spread\n")[2].splitlines()
    assert head.split() == ["+-", "left", "before", "gain"]
    for row, entry in zip(rows, content["base_parameters"], strict=False):
        left = 100 * min(entry["std_error"] / entry["plausible"], 1)
        figures = (f"{entry[key]:.2g}" for key in ("std_error_before", "gain"))
        assert re.split(r" {2,}", row)[-3:] == [f"{left:.0f} %", *figures]
    assert "assumed" not in text


def test_what_was_achieved_stands_beside_what_was_expected(files, capsys):
    words = [files / "log.csv", "--given", files / "out"]
    content = json.loads(asked(capsys, *words, "--json"))
    result = json.loads((files / "out" / "result.json").read_text())
    achieved = base(content, "achieved_std_error")
    assert achieved == {e["name"]: e["std_error"] for e in result["base_parameters"]}
    ratio, expected = base(content, "ratio"), base(content)
    for name, value in ratio.items():
        assert value == pytest.approx(achieved[name] / expected[name])
    assert content["achieved"]["count"] == len(ratio)
    assert content["achieved"]["median"] == pytest.approx(1.0, abs=0.2)
    assert content["achieved"]["median"] == pytest.approx(np.median([*ratio.values()]))
    tenths = np.quantile([*ratio.values()], [0.1, 0.9])
    assert content["achieved"]["range_80"] == pytest.approx(tenths)
    for joint, noise in content["noise"].items():
        assert noise["achieved"] == result["identification"]["per_joint"][joint]["rmse"]
        assert noise["achieved"] == pytest.approx(noise["std"], rel=0.1)
    assert "times the expected ones" in " ".join(asked(capsys, *words).split())


def test_wrong_words_are_answered(files, capsys):
    motion = files / "log_motion.csv"
    error = asked(capsys, motion, "--noise", "elbow=1", code=2)
    assert "Did you mean 'elbow_joint'" in error
    assert "wanted JOINT=NUMBER" in asked(capsys, motion, "--noise", "elbow_joint", code=2)
    error = asked(capsys, motion, "--given", files / "out", "--cutoff", "5", code=2)
    assert "a RESULT states how its logs are read" in error
    write_columns({"time": np.arange(9.0), "q_a": np.zeros(9)}, files / "other_robot.csv")
    error = asked(capsys, files / "other_robot.csv", code=1)
    assert '# q_shoulder_pan_joint = "NAME"' in error
    assert "tau" not in error
