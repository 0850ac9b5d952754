"""Long logs on the command line: workers, cluster, Ctrl-C; always the same result."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.data.files.read import write_log
from robotid.robot.model import RobotModel

URDF = str(ROOT / "urdf" / "planar_2r.urdf")
HELD = ROOT / "tests" / "helpers" / "held.py"


def write_job(folder, rows_in_memory, *tables):
    job = folder / "job.toml"
    lines = [f'urdf = "{URDF}"', *tables, "[output]", "report = false"]
    lines += ["[reduction]", f"rows_in_memory = {rows_in_memory}"]
    lines += ["[[identification]]", 'log = "fit.csv"', "[[validation]]", 'log = "keep.csv"']
    job.write_text("\n".join(lines))
    return str(job)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder with two motions of an arm, the first of many pieces."""
    folder = tmp_path_factory.mktemp("logs")
    model, rng = RobotModel.from_urdf(URDF), np.random.default_rng(0)
    for name, samples in (("fit", 2_000), ("keep", 600)):
        log = exact_log(model, truth(model), rng, samples=samples, rate=100.0, noise=0.1)
        write_log(log, folder / f"{name}.csv")
    return folder


@pytest.fixture(scope="module")
def job(logs):
    """A job file that cuts the log into eight pieces."""
    return write_job(logs, 1024)


@pytest.fixture(scope="module")
def expected(job, tmp_path_factory):
    """The result of a run in one process."""
    out = tmp_path_factory.mktemp("serial")
    assert main(["identify", job, "--workers", "1", "--out", str(out)]) == 0
    return (out / "result.json").read_text()


def test_two_workers_of_the_job_give_the_same_result_to_the_last_bit(
    job, expected, tmp_path, capsys
):
    two = Path(job).with_name("two.toml")
    two.write_text(Path(job).read_text().replace("[reduction]", "[reduction]\nworkers = 2"))
    words = ["identify", str(two), "--out", str(tmp_path), "--verbose", "--json"]
    assert main(words) == 0
    found = json.loads((tmp_path / "result.json").read_text())
    shown = capsys.readouterr()
    assert json.loads(shown.out) == found
    assert found["settings"]["reduction"].pop("workers") == 2
    assert found == json.loads(expected)
    assert "reducing 8 pieces" in shown.err
    assert "2000 samples in total: 2 worker processes, one BLAS thread each" in shown.err
    assert "regressor" not in shown.err
    assert "%" not in shown.err  # progress is for terminals


def children(pid):
    """Return the processes that another one started, and they in turn."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it ended meanwhile
            own, state, parent = re.fullmatch(
                r"(\d+) \(.*\) (\w) (\d+) .*", stat.read_text().strip()
            ).groups()
            found += [int(own), *children(own)] if parent == str(pid) and state != "Z" else []
    return found


def cut_off(job, out, number, workers, ended=None):
    """Start the command line, send it a signal once three pieces are finished; code and stderr."""
    # The processes that it had started are added to ``ended``.
    mark = out.with_name("three pieces are finished")
    command = [sys.executable, HELD, mark, "3", "identify", job, "--out", out, "--workers", workers]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not mark.exists():
        assert run.poll() is None, run.stderr.read()
        time.sleep(0.01)
    if ended is not None:
        ended += children(run.pid)
    (os.killpg if number == signal.SIGINT else os.kill)(run.pid, number)
    _, error = run.communicate(timeout=60)
    return run.returncode, error


@pytest.mark.parametrize(
    ("number", "code", "count"),
    [(signal.SIGINT, 130, 1), (signal.SIGTERM, 143, 2), (signal.SIGHUP, 129, 1)],
)
def test_a_signal_ends_a_run_with_one_line_and_without_files(job, tmp_path, number, code, count):
    out, workers = tmp_path / "out", []
    found, error = cut_off(job, out, number, str(count), workers)
    assert found == code
    assert error == "robotid: interrupted\n"
    assert not out.exists()
    assert len(workers) >= (count if count > 1 else 0)
    end = time.monotonic() + 10
    while alive := [pid for pid in workers if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < end, alive
        time.sleep(0.02)


def test_an_address_where_nobody_listens_is_said(job, tmp_path, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("robotid.estimation.work_plan._ANSWER", 0.2)
    words = ["identify", job, "--out", str(tmp_path), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(words) == 1
    assert "workers answers at 'tcp://127.0.0.1:9'" in capsys.readouterr().err
