"""The commands, job files and programs of tutorials and how-tos are right; the quick ones run."""

import argparse
import ast
import json
import re
import shlex
import textwrap
import tomllib
from importlib import import_module

import mujoco
import numpy as np
import pytest
from helpers.commanded_results import written_result
from helpers.mujoco_plant import plant, recorded
from helpers.paths import DOCS
from helpers.recorders import write_lerobot
from helpers.synthetic import exact_log, truth

import robotid
from robotid.cli import COMMANDS, main
from robotid.cli.job import job_from_settings
from robotid.data.files.read import write_log
from robotid.design.excitation import write_motion
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Simulation
from robotid.output.files.ranges import sample
from robotid.robot.examples import example_urdf

PAGES = sorted([*DOCS.glob("tutorials/*.md"), *DOCS.glob("how_to/*.md")])


def blocks(page, language):
    """Return the code of a page in a language; that of lists is moved to the margin."""
    text = (DOCS / page).read_text()
    found = re.findall(rf"^ *```{language}\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def commands(page):
    """Return the commands of a page as words, variables of the shell put in."""
    found, variables = [], {}
    for block in (*blocks(page, "bash"), *blocks(page, "sh")):
        for line in block.replace("\\\n", " ").splitlines():
            if set_to := re.fullmatch(r'([A-Z]+)="?([^"]*)"?', line):
                variables["$" + set_to[1]] = set_to[2]
            for name, value in variables.items():
                line = line.replace(name, value)
            if line.startswith("robotid "):
                found.append(shlex.split(line, comments=True)[1:])
    return found


def run(page, *numbers, **names):
    """Run Python blocks of a page, all if none is named, in one namespace."""
    code = blocks(page, "python")
    for number in numbers or range(len(code)):
        exec(compile(code[number], page, "exec"), names)
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_are_those_of_the_program(page):
    for name, *words in commands(page.relative_to(DOCS)):
        parser = argparse.ArgumentParser(prog=f"robotid {name}")
        assert name in COMMANDS
        import_module(f"robotid.cli.{name}").add_flags(parser)
        parser.parse_args(words)  # exits where it knows a flag or a choice not


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_of_settings_are_accepted(page, tmp_path):
    text = page.read_text()
    for mark, block in zip(
        re.findall(r"<!-- (\w+) -->\n *```toml", text), blocks(page, "toml"), strict=True
    ):
        table = tomllib.loads(block)
        if mark == "plant" or page.stem == "simulate":
            assert Simulation.from_dict({k: v for k, v in table.items() if k != "drives"})
        else:
            assert job_from_settings(table, "job.toml", tmp_path)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_programs_are_python(page):
    for block in blocks(page, "python"):
        ast.parse(block)


def test_currents_and_a_gripper(tmp_path, monkeypatch, panda, rng, capsys):
    monkeypatch.chdir(tmp_path)
    page = "tutorials/currents_and_gripper.md"
    (tmp_path / "robot.urdf").write_bytes(example_urdf("panda.urdf").read_bytes())
    for number in (1, 2):
        log = exact_log(panda, truth(panda), rng, samples=800, rate=100.0, noise=0.05)
        write_log(log, tmp_path / f"log{number}.csv")
    run(page)
    assert main(["doctor", "robot.urdf", "first.csv"]) == 1
    assert "missing_gain" in capsys.readouterr().out
    (job,) = blocks(page, "toml")
    assert job.count("panda_joint4 = 11.1") == 1  # of the command that makes it wrong
    (tmp_path / "job.toml").write_text(job)
    assert main(["doctor", "job.toml"]) == 0
    assert "error:" not in capsys.readouterr().out


def test_a_servo_arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = "tutorials/servo_arm.md"
    plant, job = blocks(page, "toml")
    (tmp_path / "servo.toml").write_text(plant)
    names = run(page, 0)
    for words in commands(page)[:2]:
        command = tmp_path / words[2]
        command.write_text("\n".join(command.read_text().splitlines()[:302]) + "\n")  # 1.5 s
        assert main(words) == 0
    run(page, 1, **names)
    log = robotid.read_log("first.csv", names["joints"], needs="commands")
    assert not log.has_torque
    assert log.q_ref.shape == log.q.shape == (299, 5)
    error = np.sqrt(np.mean((log.q_ref - log.q)[50:] ** 2))
    assert 0.03 < error < 0.5  # [rad]: they follow, and lag
    (tmp_path / "job.toml").write_text(job)
    assert main(["doctor", "job.toml"]) == 0


def test_the_truth_of_a_simulated_log(tmp_path, monkeypatch, identified, capsys):
    monkeypatch.chdir(tmp_path)
    robotid.save_result(identified, "result")
    names = json.loads((tmp_path / "result/result.json").read_text())["base_parameters"]
    true = identified.mapping.to_base(truth(identified.model))
    entries = [{"name": e["name"], "value": x} for e, x in zip(names, true, strict=True)]
    (tmp_path / "first_log.truth.json").write_text(json.dumps({"base_parameters": entries}))
    run("tutorials/excitation_to_result.md")
    share = re.match(r"(\d+)% of \d+ base parameters", capsys.readouterr().out)
    assert int(share[1]) > 80


def test_a_trajectory_for_ros_begins_where_the_robot_is_sent(tmp_path, monkeypatch, ur5, rng):
    monkeypatch.chdir(tmp_path)
    motion = random_fourier(ur5, rng, period=10.0)
    written = write_motion(motion, ur5.joints, 10.0, 20.0, tmp_path / "motion.yaml")
    assert written.stat().st_size < 100_000  # of an argument of Linux: 128 KiB
    run("how_to/ros2.md")
    names, points, position, velocity, end = (tmp_path / "start.yaml").read_text().splitlines()
    start = [float(x) for x in re.findall(r"-?\d+\.\d+", position)]
    np.testing.assert_allclose(start, motion.evaluate(np.zeros(1))[0][0], atol=1e-6)
    assert names.startswith("joint_names: [shoulder_pan_joint,")
    assert points == "points:"
    assert velocity.startswith("  velocities: [")
    assert end == "  time_from_start: {sec: 10, nanosec: 0}"


def test_a_dataset_of_lerobot(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = "how_to/lerobot.md"
    convert, second, *_ = commands(page)
    joints = [*convert[-1].split(","), "gripper"]
    t = np.arange(600)[:, None] / 100.0
    action = 20.0 * np.sin(2 * np.pi * (0.5 + 0.3 * np.arange(6)) * t)  # [deg]
    motors = [f"{joint}.pos" for joint in joints]
    names = {"observation.state": motors, "action": motors}
    write_lerobot(tmp_path / "dataset", {0: (action, action), 1: (action, action)}, names)
    for words in (convert, second):
        assert main(words) == 0
    (job,) = blocks(page, "toml")
    (tmp_path / "so101.urdf").write_bytes(example_urdf("so101.urdf").read_bytes())
    job = job_from_settings(tomllib.loads(job), "job.toml", tmp_path)
    log = job.read(job.identification[0], job.model(), needs="commands")
    np.testing.assert_allclose(log.q_ref, np.deg2rad(action[:, :5]), atol=1e-6)
    capsys.readouterr()


def test_a_result_in_mujoco(tmp_path, monkeypatch, identified, capsys):
    monkeypatch.chdir(tmp_path)
    robotid.save_result(identified, "result")
    export = commands("how_to/mujoco.md")[0]
    assert main(export) == 0
    capsys.readouterr()
    run("how_to/mujoco.md", 0)
    difference = np.array(re.findall(r"-?\d+\.\d*", capsys.readouterr().out), dtype=float)
    offsets = [x for n, x in zip(identified.model.layout.names, identified.standard, strict=True)
               if n.endswith(".offset")]  # fmt: skip
    np.testing.assert_allclose(difference, -np.array(offsets), atol=0.02)


def test_servos_in_mujoco(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    leg = plant("leg", np.random.default_rng(0), delay=0.008)
    written_result(leg, tmp_path / "result")
    log, _ = recorded(leg, np.random.default_rng(1), duration=2.0)
    write_log(log, tmp_path / "second.csv")
    assert main(commands("how_to/mujoco.md")[1]) == 0
    capsys.readouterr()
    run("how_to/mujoco.md", 1)
    errors = ast.literal_eval(capsys.readouterr().out)
    assert set(errors) == set(leg.model.joints)
    assert max(errors.values()) < 0.01  # [rad]


def test_draws_are_within_the_ranges(tmp_path, monkeypatch, identified, capsys):
    monkeypatch.chdir(tmp_path)
    robotid.save_result(identified, "result")
    assert main(commands("how_to/domain_randomisation.md")[0]) == 0
    names = run("how_to/domain_randomisation.md", 0)
    assert set(names["draw"]) == set(names["bodies"])
    assert all(mass > 0 for mass in names["draw"].values())
    for command in commands("how_to/domain_randomisation.md")[1:3]:
        assert main(command) == 0
    names = run("how_to/domain_randomisation.md", 1)
    samples, model, layout = names["samples"], names["model"], identified.model.layout
    names["set_sample"](model, 17)
    capsys.readouterr()
    assert samples["parameters"]["names"] == list(layout.names)
    result = robotid.load_result("result")
    pi = sample(result, 1000, np.random.default_rng(0))[1][17]
    data = mujoco.MjData(model)
    q, v, a = np.random.default_rng(3).uniform(-1.0, 1.0, (3, model.nv))
    data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
    mujoco.mj_inverse(model, data)
    wanted = predict_instants(result.robot, pi, q, v, a)
    offsets = [pi[layout.names.index(f"{joint}.offset")] for joint in layout.joints]
    np.testing.assert_allclose(data.qfrc_inverse, wanted - offsets, atol=0.05)
