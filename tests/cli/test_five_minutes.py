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


@pytest.fixture(scope="module")
def done():
    """What both users do alike: exit code, what was said and the results, by the command."""
    return {}


@pytest.fixture
def user(files, done, tmp_path, monkeypatch):
    for file in files.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.chdir(tmp_path)
    leave_out_meshes(monkeypatch)

    class Quick(User):
        def run(self, words):
            if (key := (*words, (tmp_path / words[1]).read_text())) in done:
                code, said, folder = done[key]
                shutil.copytree(folder, tmp_path / "result", dirs_exist_ok=True)
                return code, said
            with redirect_stderr(StringIO()) as said:
                code = main(words)
            done[key] = code, said.getvalue(), tmp_path / "result"
            return code, said.getvalue()

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
