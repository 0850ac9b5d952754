"""The examples under docs/ run, their commands and job files are right, and what they say is so."""

import argparse
import ast
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import textwrap
import tomllib
from contextlib import nullcontext, redirect_stdout
from importlib import import_module
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
import pytest
from helpers.commanded_results import written_result
from helpers.corruptions import CASES
from helpers.mujoco_plant import plant, recorded
from helpers.paths import DOCS, ROOT
from helpers.recorders import write_lerobot
from helpers.replay_data import leave_out_meshes

import robotid
from robotid.cli import COMMANDS, main
from robotid.cli.job import Job, LogEntry, job_from_settings
from robotid.data.files.read import write_columns, write_log
from robotid.design.excitation import write_motion
from robotid.diagnosis.catalogue import entries
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulation_settings import Simulation
from robotid.dynamics.torque import predict_instants
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.output.files.ranges import sample
from robotid.robot import examples
from robotid.robot.drives import TERM_CLASSES, TERMS
from robotid.robot.examples import example_urdf
from robotid.robot.prior import REASONS

sys.path.append(str(ROOT / "benchmarks"))
from write_tables import FOLDER, MACHINE, digest, read

#: Drive parameters as the table of names has them, the first of those with a number.
PARAMETERS = {cls().name for cls in TERM_CLASSES.values()} | set(TERMS)
GUIDES = sorted([*DOCS.glob("tutorials/*.md"), *DOCS.glob("how_to/*.md")])


def blocks(page, language):
    """Return the code of a page in a language; that of lists is moved to the margin."""
    text = (DOCS / page).read_text()
    found = re.findall(rf"^ *```{language}\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def examples_of(page):
    """Return the settings of a page that are marked as an example."""
    text = (DOCS / page).read_text()
    found = re.findall(r"<!-- example -->\n```toml\n(.*?)```", text, re.DOTALL)
    return [tomllib.loads(block) for block in found]


def commands(page):
    """Return the commands of a page as words, variables of the shell put in."""
    lines = as_lines("".join([*blocks(page, "bash"), *blocks(page, "sh")]))
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("robotid ")]


def as_lines(block):
    """Return the lines of a block for a shell, variables put in."""
    found, variables = [], {}
    for line in block.replace("\\\n", " ").splitlines():
        if set_to := re.fullmatch(r'([A-Z]+)="?([^"]*)"?', line):
            variables["$" + set_to[1]] = set_to[2]
        for name, value in variables.items():
            line = line.replace(name, value)
        found.append(line)
    return found


def run(page, *numbers, **names):
    """Run Python blocks of a page, all if none is named, in one namespace."""
    code = blocks(page, "python")
    for number in numbers or range(len(code)):
        exec(compile(code[number], page, "exec"), names)
    return names


def test_the_page_of_the_job_file_is_what_the_settings_say(tmp_path):
    written = runpy.run_path(str(DOCS / "write_reference.py"))["pages"]()
    for name, text in written.items():
        assert (DOCS / "reference" / name).read_text() == text, "run python docs/write_reference.py"
    page = "".join(text for name, text in written.items() if name.startswith("job_"))
    for key in Job.paths().keys() - {"model"}:
        expected = ("ident", "valid", "transm", "payload_check", "coupling", "contact", "loop")
        assert f"| `{key.rpartition('.')[2]}` |" in page or key.startswith(expected)
    pages = [examples_of(f"reference/{name}") for name in written]
    (table,) = [table for tables in pages for table in tables]
    job = job_from_settings(table, "job_file.md", tmp_path)
    assert job.estimator == EstimatorSettings(
        robust="tukey",
        constraints={
            "mass": {"forearm": [1.0, 3.0], "wrist": 0.8},
            "com": {"forearm": [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.4]]},
            "pinned": ["base"],
        },
    )
    assert job.identification == (LogEntry(tmp_path / "first.csv", 0.5, 30.0),)


def test_the_job_of_commands_and_positions_is_accepted(tmp_path):
    tables = examples_of("reference/closed_loop.md")[:2]
    job, driven = (job_from_settings(table, "job.toml", tmp_path) for table in tables)
    assert job.estimator.name == "simulation"
    assert (job.controller.kp, job.controller.kd) == (20.0, 1.5)
    assert driven.controller.kind == "torque"
    page = (DOCS / "reference/closed_loop.md").read_text()
    unstated = page.partition("These keys of `[controller]`")[2].partition("- **Groups")[0]
    keys = re.findall(r"`(\w+)(?: = \"find\")?`", unstated)
    assert len(keys) > 4
    for key in keys:
        assert f"controller.{key}" in Job.paths(), key


def test_the_page_on_simulation_says_what_the_settings_say_and_runs(tmp_path, monkeypatch, ur5):
    page = (DOCS / "how_to/simulate.md").read_text()
    t = np.arange(0.0, 4.001, 0.01)
    q = random_fourier(ur5, np.random.default_rng(1), period=4.0).evaluate(t)[0]
    columns = {f"q_{joint}": q[:, j] for j, joint in enumerate(ur5.joints)}
    write_columns({"time": t, **columns}, tmp_path / "motion.parquet")
    (tmp_path / "robot.urdf").write_bytes(example_urdf("ur5_robot.urdf").read_bytes())
    toml = re.search(r"<!-- example -->\n```toml\n(.*?)```", page, re.DOTALL).group(1)
    (tmp_path / "plant.toml").write_text(toml)
    monkeypatch.chdir(tmp_path)
    words = "simulate robot.urdf motion.parquet --out plant.csv --plant plant.toml --duration 0.1"
    assert main([*words.split(), "--rate", "100"]) == 0
    line = re.search(r"robotid (simulate .*)", page).group(1)
    assert main(line.replace("--rate 500", "--rate 100").split()) == 0
    namespace = run("how_to/simulate.md")
    error = np.abs(namespace["found"].base - namespace["beta"]) / namespace["found"].base_error
    assert np.mean(error < 3) > 0.9


@pytest.fixture
def follow(tmp_path, monkeypatch, capsys):
    """Do what a page says, block by block, as a user in an empty folder; return what it printed."""
    # Trajectories are designed with a brief search, so figures may differ from those of the page.
    monkeypatch.chdir(tmp_path)
    leave_out_meshes(monkeypatch)
    paths = {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    number = r"[\\d.e-]+(?:\\s+to\\s+[\\d.e-]+)?"
    saved = re.compile(r"[Ss]ave (?:this|it) as `([\w.]+)`")

    def follow(page, brief="--seconds 0.5"):
        text, end, printed, namespace = (DOCS / page).read_text(), 0, "", {}
        found = list(re.finditer(r"^ *```(\w+)\n(.*?)^ *```$", text, re.DOTALL | re.MULTILINE))
        for at, nearest in zip(found, [*found[1:], None], strict=True):
            language, block = at[1], textwrap.dedent(at[2])
            for name in saved.findall(text[end : at.start()])[-1:]:
                Path(name).write_text(block)
            end = at.end()
            if language == "python":
                exec(compile(block, page, "exec"), namespace)
            is_error = bool(nearest) and nearest[2].lstrip().startswith("error:")
            for line in as_lines(block) if language == "bash" else ():
                if line.startswith("robotid "):
                    search = f"excite --starts 1 --points 20 {brief}"
                    words = shlex.split(line.replace("--starts 1 ", "").replace("excite", search))
                    assert (main(words[1:]) == 1) == is_error, line
                else:
                    subprocess.run(["bash", "-ec", line], env=os.environ | paths, check=True)
            printed += capsys.readouterr().out
            for line in block.splitlines() if language == "text" else ():
                pattern = re.sub(r"\d+(\\\.\d+)?(e\\-\d+)?", number, re.escape(line.strip()))
                pattern = re.sub(r"(\\ )+", r"\\s+", pattern).replace(r"\.\.\.", "(?s:.*)")
                assert re.search(pattern, printed), line
        return printed

    return follow


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The folder that ``robotid demo`` writes, what it prints and the stages that it shows."""
    folder, printed, stages = tmp_path_factory.mktemp("demo") / "robotid-demo", StringIO(), []
    shown = nullcontext(lambda *stage: stages.append(stage))
    with pytest.MonkeyPatch.context() as patched, redirect_stdout(printed):
        leave_out_meshes(patched)
        patched.setattr("robotid.cli.demo.progress_of", lambda options: shown)
        assert main(["demo", "--out", str(folder)]) == 0
    return folder, printed.getvalue(), stages


def test_demo_runs_from_nothing_and_finds_the_truth(demo):
    out, printed, stages = demo
    assert stages, "the stages of the identification are shown"
    assert "verdict: good" in printed
    assert "of 58 base parameters lie within 3 standard errors of the truth" in printed
    count = int(printed.split(" of 58 base")[0].split()[-1])
    assert count >= 55  # 58 intervals of 99.7 % and a little model error of the friction's edge
    assert (out / "replay.html").stat().st_size > 100_000
    links = re.findall(r'<a href="([^"#]+)"', (out / "report.html").read_text(encoding="utf-8"))
    assert len(set(links)) == 4
    assert {name for name in links if (out / name).is_file()} == set(links)
    assert f"written to {out}: report.html, " in " ".join(printed.split())
    assert len(printed.splitlines()) <= 40, "one screen"
    assert "payload of known mass" not in printed, "the scale of simulated torques is known"


def test_the_first_tutorial_runs_as_written(follow):
    printed = follow("tutorials/first_arm.md")
    assert "verdict: good" in printed
    assert "verdict good" in printed  # in Python
    best = re.findall(r"^ *(\S+) \+- (\S+)  \S", printed, re.MULTILINE)
    assert len(best) == 6
    assert all(abs(float(value)) > 10 * float(error) for value, error in best)
    written = {path.name for path in Path("result").iterdir()}
    assert {"report.html", "robot.identified.urdf", "result.json", "replay.html"} <= written


def test_currents_and_a_gripper(follow):
    printed = follow("tutorials/currents_and_gripper.md", "--seconds 60 --clearance none")
    assert re.findall("verdict: (.*)", printed) == ["good", "usable"]
    factors = re.search(r"much better if multiplied by (\S+) to (\S+):", printed).groups()
    assert [float(x) for x in factors] == pytest.approx([11.1 / 14.9] * 2, abs=0.02)


def test_from_excitation_to_a_result(follow):
    assert "verdict: good" in follow("tutorials/excitation_to_result.md")


def test_a_payload_of_two_logs(follow):
    printed = follow("tutorials/payload.md", "--seconds 60")
    found = re.search(r"mass (\S+) kg \(95 % interval (\S+) to ([^)]+)\)", printed).groups()
    mass, low, high = map(float, found)
    assert 1.98 < low < mass < high < 2.02
    assert low < 2.0 < high


def test_a_table_with_any_column_names_is_imported(follow, demo):
    Path("robotid-demo").symlink_to(demo[0])
    printed = follow("how_to/import_table.md")
    assert "verdict: good" in printed
    assert "Identification of z1_description: 58 base parameters" in printed  # of arrays


def test_gravity_is_compensated_without_the_offset(follow, demo):
    Path("robotid-demo").symlink_to(demo[0])
    numbers = re.findall(r"\[([^]']+)\]", follow("how_to/gravity_compensation.md"))
    holding, gravity, pinocchios = (np.array(line.split(), dtype=float) for line in numbers)
    np.testing.assert_allclose(gravity, pinocchios, atol=1e-9)
    drives = json.loads(next(demo[0].glob("*.drive.json")).read_text())["drives"]
    offset = [drive["offset"] for drive in drives.values()]
    np.testing.assert_allclose(holding - gravity, offset, atol=1e-6)


def test_a_drive_at_its_limit_is_found(follow):
    assert "at the effort limit" in follow("how_to/saturation.md", "--seconds 60")


def test_the_notebook_of_first_steps_runs_and_shows_what_it_says(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # what robots look like takes seconds to be thinned
    text = example_urdf("ur5_robot.urdf").read_text()
    (tmp_path / "ur5.urdf").write_text(re.sub("(?s)<visual>.*?</visual>", "", text))
    monkeypatch.setattr(examples, "example_urdf", lambda _: tmp_path / "ur5.urdf")
    notebook = json.loads((DOCS / "tutorials/first_steps.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in cells)
    namespace, shown = {}, []
    for cell in cells:
        *steps, last = ast.parse("".join(cell["source"])).body
        is_value = isinstance(last, ast.Expr)
        steps = steps if is_value else [*steps, last]
        exec(compile(ast.Module(steps, []), cell["id"], "exec"), namespace)
        if is_value:
            shown.append(eval(compile(ast.Expression(last.value), cell["id"], "eval"), namespace))
    found, true = namespace["found"], namespace["truth"]
    assert found.verdict.status == "good"
    base = found.mapping.to_base(true)
    assert np.median(np.abs(found.base - base) / found.base_error) < 2.0
    numbers = re.findall(r"\[(.*?)\]", capsys.readouterr().out)
    ours, pinocchios, truths = (np.array(line.split(), dtype=float) for line in numbers[:3])
    np.testing.assert_array_equal(ours, pinocchios)
    np.testing.assert_allclose(ours, truths, atol=0.1)
    rich = [thing for thing in shown if hasattr(thing, "_repr_html_")]
    assert len(rich) == 4  # the table of the identification and three plots
    assert all("<table" in x._repr_html_() or "<iframe" in x._repr_html_() for x in rich)
    assert repr(shown[-1]).startswith("<Result of ur5: 58 base parameters")
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"ur5.urdf", "first.csv", "replay.html", "result"}


def test_paper(capsys):
    namespace = run("explanation/paper.md")
    printed = capsys.readouterr().out
    assert printed.startswith("after 0 runs: relative error 0.500")
    errors = namespace["errors"]
    assert (errors[1:] < errors[:-1]).all()
    for name in ("disturbed", "noisy"):
        assert namespace[name][-1] < namespace[name][0]
    assert namespace["study"].one_shot_error < 1e-6


def test_online_tracker(capsys):
    namespace = run("how_to/online.md")
    printed = capsys.readouterr().out
    shares = [float(x) for x in re.findall(r"excitation (\S+),", printed)]
    assert shares[:5] == sorted(shares[:5])  # before the load
    assert "converged: True" not in printed
    (change,) = namespace["tracker"].changes
    assert change.onset == pytest.approx(10.0, abs=0.1)
    assert change.onset <= change.flagged < 10.5
    mass, error = map(float, re.search(r"load: (\S+) \+- (\S+) kg", printed).groups())
    assert abs(mass - 2.0) < 4 * error < 1.0


def test_doctor_lists_every_corruption_and_none_other():
    rows = {name: codes for name, codes, *_ in read("doctor")[1:]}
    assert rows == {name: ", ".join(case.codes) for name, case in CASES.items()}


def codes_of_findings():
    """Return the codes that the catalogue and the code give to findings, unread logs included."""
    source = "\n".join(path.read_text() for path in (ROOT / "robotid").rglob("*.py"))
    codes = {*entries(), *REASONS, *re.findall(r'\bcode ?= ?"([a-z_]+)"', source)}
    return {code for code in codes if ":" not in code}  # with it: a sentence of a finding


def test_each_finding_has_its_line():
    shown = [
        code
        for page in (DOCS / "reference/findings").glob("*.md")
        for code in re.findall(
            r"^\| `([a-z_]+)`\{#\1\} (?:note|warning|error) \| \S", page.read_text(), re.M
        )
    ]
    assert len(shown) == len(set(shown)), "a code has two lines"
    assert codes_of_findings() == set(shown)
    index = (DOCS / "reference/findings/index.md").read_text()
    assert sorted(re.findall(r"\[`(\w+)`\]\(\w+\.md#\1\)", index)) == sorted(shown)


def test_the_page_of_result_files_lists_every_key_of_them():
    page = (DOCS / "reference/result_files.md").read_text()
    listed = {
        title: set(
            re.findall(r"`(\w+)`", " ".join(re.findall(r"^\| (.*?) \|", part, re.MULTILINE)))
        )
        for title, _, part in (x.partition("\n") for x in page.split("\n## "))
    }
    stored = [json.loads(path.read_text()) for path in (ROOT / "tests/figures").glob("*.json")]
    results = [run["result.json"] for run in stored if "result.json" in run]
    keys = {key for result in results for key in result}
    keys |= {"robotid", "versions", "variation", "left_out"}
    assert listed["Keys of result.json"] == keys
    parameters = [x for result in results for x in result["drive_parameters"]]
    assert listed["Keys of a parameter"] == {key for x in parameters for key in x}
    sides = {key for run in stored for key in run.get("sidecar", {})} - {"schema_version", "robot"}
    assert sides
    assert sides <= listed["Keys of the drive parameters file"] | {"robotid"}


def test_the_drives_of_the_page_on_friction_are_accepted(tmp_path):
    (table,) = examples_of("explanation/friction.md")
    table |= {"urdf": "robot.urdf", "joints": ["shoulder", "elbow", "lift"]}
    job = job_from_settings(table, "job.toml", tmp_path)
    assert sorted(job.drives) == ["elbow", "lift", "shoulder"]


def pages():
    return sorted(page for page in DOCS.rglob("*.md") if page.parent.name != "skill")


@pytest.mark.parametrize("row", read("tables")[1:], ids=lambda row: row[0])
def test_tables_of_benchmarks_are_as_these_wrote_them(row):
    name, command, version, machine, _, written = row
    again = f"write it anew: python benchmarks/write_tables.py {name}"
    assert (ROOT / re.search(r"\w+/\S+\.py", command)[0]).is_file()
    assert re.fullmatch(r"\d+\.\d+\.\d+", version), f"no version of {name}; {again}"
    assert MACHINE.fullmatch(machine), f"no machine of {name}; {again}"
    assert written == digest(name), f"{name}.csv has other figures; {again}"


def test_the_page_of_evidence_has_the_figures_of_every_table():
    listed = {name: notes for name, _, _, _, notes, _ in read("tables")[1:]}
    assert listed.keys() | {"tables"} == {path.stem for path in FOLDER.glob("*.csv")}
    page, number = (FOLDER / "index.md").read_text(), r"\d+(?:[.,]\d+)*"
    assert listed.keys() <= set(re.findall(r"\[(\w+)\]\(\1\.csv\)", page))
    for figures, links in re.findall(r"^\|.* \| (.*?) \| (\[.*\.csv\).*) \|$", page, re.MULTILINE):
        tables = [listed[name] + str(read(name)) for name in re.findall(r"\[(\w+)\]", links)]
        known = re.findall(number, " ".join(tables))
        assert set(re.findall(number, figures)) <= set(known), f"{figures} is not in {links}"


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\((?!http)([^)#]+)", page.read_text())
    places = [(page.parent / link).resolve() for link in links]
    written = {DOCS / f"reference/commands/{name}.md" for name in COMMANDS}  # as the site is built
    assert not [place for place in places if not place.is_file() and place not in written]


def test_no_page_is_left_out_of_the_site():
    config = (ROOT / ".mkdocs.yml").read_text()
    listed = set(re.findall(r"- (?:[\w ]+: )?([\w/]+\.md)", config))
    written = {f"reference/commands/{name}.md" for name in COMMANDS}  # as the site is built
    written.add("tutorials/first_steps.md")  # of the notebook
    assert {page.relative_to(DOCS).as_posix() for page in pages()} | written == listed


def test_the_architecture_names_every_package():
    rooms = {p.parent.name for p in (ROOT / "robotid").glob("*/__init__.py")} | {"cli"}
    text = (DOCS / "explanation/architecture.md").read_text()
    assert rooms == set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    figure = (DOCS / "pictures" / "packages.svg").read_text()
    assert not [room for room in rooms if figure.count(f">{room}<") != 1]


def test_every_drive_parameter_is_in_the_table_of_names():
    page = (DOCS / "reference/symbols.md").read_text()
    assert len(PARAMETERS) > 15
    assert [name for name in sorted(PARAMETERS) if f"`{name}`" not in page] == []


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_commands_are_those_of_the_program(page):
    for name, *words in commands(page.relative_to(DOCS)):
        parser = argparse.ArgumentParser(prog=f"robotid {name}")
        assert name in COMMANDS
        import_module(f"robotid.cli.{name}").add_flags(parser)
        parser.parse_args(words)  # exits where it knows a flag or a choice not


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
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


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_programs_are_python(page):
    for block in blocks(page, "python"):
        ast.parse(block)


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
    assert main(commands("how_to/exports.md")[0]) == 0
    capsys.readouterr()
    run("how_to/exports.md", 0)
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
    assert main(commands("how_to/exports.md")[1]) == 0
    capsys.readouterr()
    run("how_to/exports.md", 1)
    errors = ast.literal_eval(capsys.readouterr().out)
    assert set(errors) == set(leg.model.joints)
    assert max(errors.values()) < 0.01  # [rad]


def test_draws_are_within_the_ranges(tmp_path, monkeypatch, identified, capsys):
    monkeypatch.chdir(tmp_path)
    robotid.save_result(identified, "result")
    ranges, *samples = commands("how_to/exports.md")[3:6]
    assert main(ranges) == 0
    names = run("how_to/exports.md", 4)
    assert set(names["draw"]) == set(names["bodies"])
    assert all(mass > 0 for mass in names["draw"].values())
    for command in samples:
        assert main(command) == 0
    names = run("how_to/exports.md", 5)
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
