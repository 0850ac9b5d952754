"""How a command ends that cannot go on: outputs in the way, readers that leave, full disks."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.paths import ROOT

from robotid.cli import main

URDF = str(ROOT / "urdf" / "planar_2r.urdf")
OUTPUTS = [
    *("result.json", "report.html"),
    *("planar_2r.identified.urdf", "planar_2r.identified.drive.json"),
]


@pytest.fixture(scope="module")
def log(arm_logs):
    return str(arm_logs / "fit.csv")


@pytest.fixture(scope="module")
def made(log, tmp_path_factory):
    """What is written from the log."""
    folder = tmp_path_factory.mktemp("made")
    assert main(["identify", URDF, log, "--friction", "viscous", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_folder_in_the_place_of_an_output_is_refused_before_the_work(
    log, made, tmp_path, capsys, monkeypatch, name
):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert sorted(before) == sorted(OUTPUTS)
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    monkeypatch.setattr("robotid.cli.identify.identify_job", None)  # is not come to
    assert main(["identify", URDF, log, "--out", str(tmp_path), "--cutoff", "5"]) == 2
    assert f"{name}' is a folder, expected a file" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir() if p.is_file()} == {
        other: content for other, content in before.items() if other != name
    }


def test_a_page_that_cannot_be_written_is_refused_before_the_work(log, tmp_path, capsys):
    assert main(["replay", "none.urdf", log, "--html", str(tmp_path)]) == 2
    assert main(["compare", "none.json", "none.json", "--out", str(tmp_path)]) == 2
    assert main(["convert", "none.csv", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("is a folder, expected a file") == 3


def robotid(*words, **where):
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "robotid", *words], stderr=subprocess.PIPE, text=True, **where
    )


@pytest.mark.parametrize(
    ("words", "code"),
    [(["--help"], 0), (["inspect", URDF, "--json"], 0), (["doctor", URDF, "{zeros}"], 1)],
    ids=["help", "json", "doctor"],
)
def test_a_reader_that_leaves_is_no_error_and_hides_none(log, tmp_path, words, code):
    zeros = tmp_path / "zeros.csv"
    text = Path(log).read_text().splitlines()
    zeros.write_text("\n".join([text[0], *text[1:400], *text[300:]]))  # time goes back
    read, write = os.pipe()
    os.close(read)
    run = robotid(*[word.format(zeros=zeros) for word in words], stdout=write)
    os.close(write)
    assert (run.returncode, run.stderr) == (code, "")


def test_a_standard_output_that_is_full_is_said():
    with open("/dev/full", "w") as full:
        run = robotid("inspect", URDF, stdout=full)
    assert (run.returncode, run.stderr) == (1, "robotid: [Errno 28] No space left on device\n")


@pytest.mark.parametrize("command", ["doctor", "validate", "compare", "replay"])
def test_pipes_and_folders_are_no_input(log, tmp_path, capsys, command):
    os.mkfifo(tmp_path / "pipe.json")
    os.mkfifo(tmp_path / "pipe.toml")
    pipe = str(tmp_path / "pipe.json")
    words = {
        "doctor": [str(tmp_path / "pipe.toml")],
        "validate": [pipe, log],
        "compare": [pipe, pipe],
        "replay": [URDF, log, pipe],
    }
    assert main([command, *words[command]]) in (1, 2)
    assert "is a pipe or a device, expected a" in capsys.readouterr().err
