"""`simulate` writes a log and what it was made from; identify finds that again."""

import json
import re

import numpy as np
import pytest

from robotid.base.files import file_sha256
from robotid.cli import main
from robotid.cli.identify import identify
from robotid.data.files.read import read_log, write_columns
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.motions import SampledMotion, random_fourier
from robotid.output.files.urdf import load_identified
from robotid.robot.examples import example_urdf

URDF = str(example_urdf("ur5_robot.urdf"))
PLANT = """
seed = 3
rate = 200.0
[truth]
inertials = 0.2
values = { "elbow_joint.stribeck" = 3.0 }
[drives]
elbow_joint = [{ term = "Stribeck", speed = 0.2 }]
[controller]
kind = "pd"
kp = { shoulder_pan_joint = 900.0 }
[actuator]
effort = 0.5
[sensors]
noise = { tau = 0.01, q = 1e-5 }
"""


def write_motion(path, model, seed, *, derivatives=True, duration=8.0):
    t = np.arange(0.0, duration + 0.005, 0.01)
    found = random_fourier(model, np.random.default_rng(seed), period=8.0).evaluate(t)
    table = {"time": t + 100.0}
    for kind, values in zip(("q", "dq", "ddq")[: 3 if derivatives else 1], found, strict=False):
        table |= {f"{kind}_{joint}": values[:, j] for j, joint in enumerate(model.joints)}
    write_columns(table, path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, ur5):
    folder = tmp_path_factory.mktemp("simulate")
    write_motion(folder / "design.parquet", ur5, 1)
    (folder / "plant.toml").write_text(PLANT)
    return folder


def simulated(folder, *words, motion="design.parquet", out="log.parquet"):
    files = [URDF, str(folder / motion), "--out", str(folder / out)]
    code = main(["simulate", *files, *words])
    truth = folder / f"{out.partition('.')[0]}.truth.json"
    return code, json.loads(truth.read_text()) if truth.exists() else None


def by_name(entries):
    return {entry["name"]: entry["value"] for entry in entries}


def test_identify_finds_the_truth_that_stands_beside_the_log(folder, ur5, capsys):
    code, truth = simulated(folder, "--rate", "200", "--seed", "4", "--urdf", f"{folder}/true.urdf")
    assert code == 0
    said = capsys.readouterr().out
    assert "written" in said
    assert "the torques have no noise" in said
    log = read_log(folder / "log.parquet", ur5.joints)
    assert (len(log.t), truth["samples"], truth["duration"]) == (1601, 1601, 8.0)
    found = identify(ur5, [log], friction="viscous+coulomb", doctor=False)
    true = by_name(truth["base_parameters"])
    assert list(true) == list(found.mapping.base_names)
    beta = np.array(list(true.values()))
    assert np.linalg.norm(found.base - beta) < 0.01 * np.linalg.norm(beta)
    error = np.abs(found.base - beta) / found.base_error
    assert np.mean(error < 3) > 0.9
    # the URDF of the truth is the truth
    model, pi = load_identified(folder / "true.urdf", folder / "true.drive.json")
    values = by_name(truth["standard_parameters"] + truth["drive_parameters"])
    assert list(values) == list(model.layout.names)
    np.testing.assert_allclose(pi, list(values.values()), rtol=1e-9, atol=1e-12)
    text = (folder / "true.urdf").read_text()
    for joint in ur5.joints:
        (own,) = re.findall(rf'<joint name="{joint}".*?<dynamics (.*?)/>', text, re.DOTALL)
        viscous, coulomb = (values[f"{joint}.{term}"] for term in ("viscous", "coulomb"))
        assert own == f'damping="{viscous!r}" friction="{coulomb!r}"'
    assert truth["log_sha256"] == file_sha256(folder / "log.parquet")
    assert truth["motion"]["sha256"] == file_sha256(folder / "design.parquet")
    shipped = ur5.standard_parameters()[:60]
    assert [entry["urdf"] for entry in truth["standard_parameters"]] == shipped.tolist()


def test_a_seed_gives_the_same_bytes_and_another_seed_others(folder):
    logs = []
    for seed, out in (("7", "a.csv"), ("7", "b.csv"), ("8", "c.csv")):
        words = ["--rate", "50", "--torque-noise", "0.02", "--duration", "1"]
        simulated(folder, "--seed", seed, *words, out=out)
        logs.append((folder / out).read_bytes())
    assert logs[0] == logs[1] != logs[2]


def test_a_file_states_the_plant_and_flags_stand_over_it(folder, capsys):
    words = ["--plant", f"{folder}/plant.toml", "--json", "--duration", "2", "--seed", "5"]
    code, truth = simulated(folder, *words, out="stated.csv")
    assert code == 0
    assert json.loads(capsys.readouterr().out)["settings"] == truth["settings"]
    stated = truth["settings"]
    assert (stated["seed"], stated["rate"], stated["duration"]) == (5, 200.0, 2.0)
    assert stated["controller"]["kp"] == {"shoulder_pan_joint": 900.0}
    assert (stated["truth"]["inertials"], stated["actuator"]["effort"]) == (0.2, 0.5)
    assert by_name(truth["drive_parameters"])["elbow_joint.stribeck"] == 3.0
    own = truth["model"]["own_terms"]["elbow_joint"]
    assert own == [{"term": "Stribeck", "speed": 0.2}]
    assert truth["following"][1]["rms"] > 0.01  # PD alone sags


def test_a_motion_of_positions_alone_is_splined_and_a_recorded_one_smoothed(folder, ur5):
    write_motion(folder / "plain.csv", ur5, 1, derivatives=False)
    words = ["--rate", "100", "--controller", "perfect", "--duration", "5", "--perturb", "0"]
    logs = []
    for motion, out in (("design.parquet", "x.csv"), ("plain.csv", "y.csv")):
        assert simulated(folder, *words, motion=motion, out=out)[0] == 0
        logs.append(read_log(folder / out, ur5.joints))
    inside = slice(20, -20)  # a spline bends at its ends
    np.testing.assert_allclose(logs[1].tau[inside], logs[0].tau[inside], atol=2e-3)
    rough = write_motion(folder / "rough.csv", ur5, 1, derivatives=False)
    table = np.loadtxt(rough, delimiter=",", skiprows=1)
    table[:, 1:] += 1e-4 * np.random.default_rng(0).standard_normal(table[:, 1:].shape)
    header = rough.read_text().partition("\n")[0]
    np.savetxt(rough, table, delimiter=",", header=header, comments="")
    simulated(folder, *words, "--cutoff", "5", motion="rough.csv", out="z.csv")
    smooth = read_log(folder / "z.csv", ur5.joints)
    error = np.sqrt(np.mean((smooth.tau - logs[0].tau)[inside] ** 2))
    assert error < 0.03 * np.sqrt(np.mean(logs[0].tau ** 2))


ERRORS = {
    "duration is 9 s, expected at most the 8 s of the motion": ["--duration", "9"],
    "logs are written as .csv": ["--out", "log.txt"],
    "controller: kind is 'pid', expected one of feedforward, pd": ["--controller", "pid"],
    "there is no file of a plant": ["--plant", "nowhere.toml"],
}


@pytest.mark.parametrize("message", ERRORS)
def test_errors_say_what_to_do_and_nothing_is_written(folder, message, capsys):
    words = ERRORS[message]
    files = [URDF, str(folder / "design.parquet"), "--out", str(folder / "never.csv")]
    if words[0] == "--out":
        files, words = files[:3], [str(folder / words[1])]
    assert main(["simulate", *files, *words]) in (1, 2)
    assert message in capsys.readouterr().err
    assert not list(folder.glob("never*"))


def test_a_robot_that_cannot_be_a_urdf_leaves_no_file(folder, capsys):
    """A part of a link that was drawn as a whole with what is locked to it may be impossible."""
    words = ["--controller", "perfect", "--perturb", "5", "--lock", "elbow_joint=0.5"]
    code, _ = simulated(folder, *words, "--urdf", f"{folder}/never.urdf", out="never.csv")
    assert code == 1
    assert "would be physically impossible" in " ".join(capsys.readouterr().err.split())
    assert not list(folder.glob("never*"))


def test_a_limit_and_a_load_do_what_they_say_and_the_truth_states_it(arm, tmp_path, capsys):
    """A load at the origin of the last link: by hand, three times its mass in the columns."""
    write_motion(tmp_path / "motion.csv", arm, 3, duration=4.0)
    words = ["--controller", "pd", "--rate", "100", "--seed", "3", "--duration", "3"]
    words += ["--limits", "0.02", "--payload", "3", "--perturb", "0.2"]
    files = [arm.tree.path, str(tmp_path / "motion.csv"), "--out", str(tmp_path / "log.csv")]
    assert main(["simulate", *files, *words]) == 0
    truth = json.loads((tmp_path / "log.truth.json").read_text())
    log = read_log(tmp_path / "log.csv", arm.joints)
    assert len(log.t) == 301
    most = 0.02 * np.array([joint.effort for joint in arm.limits])
    held = np.isclose(np.abs(log.tau), most, rtol=1e-9)
    assert (np.abs(log.tau) <= most * (1 + 1e-9)).all()
    assert held.any()
    motion = read_log(tmp_path / "motion.csv", arm.joints, needs="motion")
    q_ref = SampledMotion(motion.t, motion.q, motion.v, motion.a).evaluate(log.t)[0]
    error = np.abs(log.q - q_ref)
    assert ((log.q - q_ref).max(axis=0) < error.max(axis=0)).any()  # the largest is a lag
    said = capsys.readouterr().out
    for j, entry in enumerate(truth["following"]):
        is_slow = entry["range"] < 0.5 * entry["commanded"]
        assert (f"warning: {arm.joints[j]} moves {entry['range']:.2g}" in said) == is_slow
        assert entry["joint"] == arm.joints[j]
        assert entry["unit"] == "rad"
        assert entry["rms"] == pytest.approx(np.sqrt(np.mean(error[:, j] ** 2)), rel=1e-6)
        assert entry["largest"] == pytest.approx(error[:, j].max(), rel=1e-6)
        assert entry["at_limit"] == pytest.approx(held[:, j].mean(), abs=0.05)
    mapping = structural_mapping(arm)
    load = np.zeros(len(arm.layout.names))
    load[arm.layout.names.index("link_2.m")] = 3.0
    bare, loaded = (
        np.array([entry["value"] for entry in truth[key]])
        for key in ("base_parameters", "base_parameters_with_payload")
    )
    np.testing.assert_allclose(loaded - bare, mapping.to_base(load), atol=1e-9)


def test_the_torque_of_a_drive_with_a_lag_is_logged_later(arm, tmp_path):
    write_motion(tmp_path / "motion.csv", arm, 3, duration=2.0)
    files = [arm.tree.path, str(tmp_path / "motion.csv"), "--out", str(tmp_path / "log.csv")]
    plant, torques = tmp_path / "plant.toml", []
    for lag in (0.0, 0.02):  # [s], of 200 Hz
        values = f'[truth]\nvalues = {{ "joint_2.lag" = {lag} }}\n'
        plant.write_text(f'{values}[drives]\njoint_2 = [{{ term = "Lag" }}]\n')
        words = ["--plant", str(plant), "--rate", "200", "--controller", "pd"]
        assert main(["simulate", *files, *words]) == 0
        torques.append(read_log(tmp_path / "log.csv", arm.joints).tau)
    np.testing.assert_array_equal(torques[1][:, 0], torques[0][:, 0])
    np.testing.assert_allclose(torques[1][4:, 1], torques[0][:-4, 1], atol=1e-9)
