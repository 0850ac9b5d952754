"""A user who knows only the README comes from files to a verdict: commands and errors counted."""

import shutil
import sys
from contextlib import redirect_stderr
from io import StringIO

import pytest
from helpers.paths import ROOT
from helpers.replay_data import leave_out_meshes

from robotid.cli import main

sys.path.append(str(ROOT / "benchmarks"))
from bench_five_minutes import User, follows, reads, record


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The URDF and two logs of an arm with a gripper, currents and a coupled wrist."""
    folder = tmp_path_factory.mktemp("files")
    record(folder)
    return folder


@pytest.fixture
def user(files, tmp_path, monkeypatch):
    shutil.copytree(files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    leave_out_meshes(monkeypatch)

    class Quick(User):
        def run(self, words):
            with redirect_stderr(StringIO()) as said:
                return main(words), said.getvalue()

    return Quick(tmp_path)


def test_the_readme_alone_leads_to_a_verdict_in_four_commands_without_an_error(user):
    reads(user)
    assert user.errors == []
    assert [command.split()[1] for command in user.commands] == [
        "inspect", "doctor", "identify", "replay",
    ]  # fmt: skip
    result = user.result()
    assert result["verdict"]["status"] == "good"
    assert "motor_6.coulomb" in [entry["name"] for entry in result["drive_parameters"]]
    assert (user.folder / "result" / "replay.html").is_file()


def test_errors_and_findings_alone_lead_to_it_in_three_commands_with_one_error(user):
    follows(user)
    (error,) = user.errors
    assert "have currents but no gain" in error
    assert "lock them at their positions" in error
    assert len(user.commands) == 3
    assert user.result()["verdict"]["status"] == "good"
