"""The README is true: its quick starts run, its commands are those of CI."""

import re
import tomllib
from pathlib import Path

import pytest
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.commands.job import job_from_settings
from robotid.logs.read import write_log
from robotid.robot.examples import example_urdf

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()


def block(marker):
    """Return the code under an HTML comment."""
    found = re.search(rf"<!-- {marker} -->\n```\w+\n(.*?)```", README, re.DOTALL)
    assert found, f"the README has no block {marker!r}"
    return found.group(1)


@pytest.fixture
def folder(tmp_path, monkeypatch, ur5, rng):
    """A folder with robot.urdf, first.csv and second.csv, as the quick starts expect."""
    (tmp_path / "robot.urdf").write_bytes(example_urdf("ur5_robot.urdf").read_bytes())
    for name in ("first", "second"):
        log = exact_log(ur5, truth(ur5), rng, samples=1500, rate=100.0, noise=0.1)
        write_log(log, tmp_path / f"{name}.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_python_quick_start_runs_and_has_ten_lines(folder, capsys):
    code = block("python quick start")
    assert len(code.strip().splitlines()) <= 11
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed.startswith("good")
    assert "elbow_joint" in printed
    assert (folder / "identified.urdf").is_file()
    assert (folder / "report.html").is_file()


def test_the_command_line_quick_start_runs(folder, capsys):
    for line in block("cli quick start").strip().splitlines():
        program, *words = line.split()
        assert program == "robotid"
        assert main(words) == 0, line
    assert "verdict: good" in capsys.readouterr().out
    assert (folder / "result" / "robot.identified.urdf").is_file()


def test_the_job_file_of_the_readme_is_accepted(folder):
    text = re.search(r"```toml\n(.*?)```", README, re.DOTALL).group(1)
    commented = re.sub(
        r"^# (joints|rate|topic|\[\[coupling|name = \"motor|ratios)", r"\1", text, flags=re.M
    )
    for version in (text, commented):
        job = job_from_settings(tomllib.loads(version), "README.md", folder)
        assert job.signals.min_velocity == 0.02
        assert job.estimator.name == "consistent"


def test_each_command_is_one_line_with_venv_and_pip():
    for marker in ("demo command", "test command"):
        (line,) = block(marker).strip().splitlines()
        assert line.startswith("python3 -m venv .venv && .venv/bin/pip install")


def test_ci_runs_the_test_command_of_the_readme():
    script = (ROOT / ".ci" / "run").read_text()
    assert "<!-- test command -->" in script
    assert "README.md" in script


def test_changelog_has_a_place_for_what_is_new():
    text = (ROOT / "CHANGELOG.md").read_text()
    assert "## [Unreleased]" in text
    assert "### Added" in text
