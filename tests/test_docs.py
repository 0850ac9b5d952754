"""The examples under docs/ run, and what they say of their output is so."""

import re
import runpy
import tomllib

import pytest
from helpers.corruptions import CASES
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.commands.job import Job, LogEntry, job_from_settings
from robotid.identification.settings import EstimatorSettings
from robotid.logs.read import write_log
from robotid.robot.examples import example_urdf

DOCS, README = ROOT / "docs", ROOT / "README.md"


def run(name):
    """Run the Python blocks of a page one after the other, in one namespace."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / name).read_text(), re.DOTALL)
    assert blocks
    namespace = {}
    for block in blocks:
        exec(compile(block, name, "exec"), namespace)
    return blocks, namespace


def test_the_page_of_the_job_file_is_what_the_settings_say(tmp_path):
    page = (DOCS / "job_file.md").read_text()
    written = runpy.run_path(str(DOCS / "make_job_file.py"))["page"]()
    assert page == written, "run python docs/make_job_file.py"
    for key in Job.paths():
        assert f"| `{key.rpartition('.')[2]}` |" in page or key.startswith(("ident", "valid"))
    text = re.search(r"<!-- example -->\n```toml\n(.*?)```", page, re.DOTALL).group(1)
    job = job_from_settings(tomllib.loads(text), "job_file.md", tmp_path)
    assert job.estimator == EstimatorSettings(
        robust="tukey",
        constraints={
            "mass": {"forearm": [1.0, 3.0], "wrist": 0.8},
            "com": {"forearm": [[-0.1, -0.1, 0.0], [0.1, 0.1, 0.4]]},
            "pinned": ["base"],
        },
    )
    assert job.identification == (LogEntry(tmp_path / "first.csv", 0.5, 30.0),)


def test_own_robot(tmp_path, monkeypatch, ur5, rng, capsys):
    (tmp_path / "robot.urdf").write_bytes(example_urdf("ur5_robot.urdf").read_bytes())
    for name in ("first", "second"):
        log = exact_log(ur5, truth(ur5), rng, samples=1000, rate=100.0, noise=0.1)
        write_log(log, tmp_path / f"{name}.csv")
    monkeypatch.chdir(tmp_path)
    blocks, namespace = run("own_robot.md")
    assert len(blocks[0].strip().splitlines()) <= 10
    printed = capsys.readouterr().out
    assert "verdict good" in printed.splitlines()[0]
    assert "not fitted" in printed
    best = re.findall(r"^ *(\S+) \+- (\S+)  \S", printed, re.MULTILINE)
    assert len(best) == 5
    assert all(abs(float(value)) > 10 * float(error) for value, error in best)
    assert {"report.html", "identified.urdf"} <= {p.name for p in tmp_path.iterdir()}
    assert set(namespace["found"].sources) <= {"data", "mixed", "prior"}


def test_paper(capsys):
    _, namespace = run("paper.md")
    printed = capsys.readouterr().out
    assert printed.startswith("after 0 runs: relative error 0.500")
    errors = namespace["errors"]
    assert (errors[1:] < errors[:-1]).all()
    for name in ("disturbed", "noisy"):
        assert namespace[name][-1] < namespace[name][0]
    assert namespace["study"].one_shot_error < 1e-6


def test_online_tracker(capsys):
    _, namespace = run("online_tracker.md")
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
    page = (DOCS / "doctor.md").read_text()
    rows = re.findall(r"^\| (.+?) \| (.+?) \| (\d)/8 \| .+ \|$", page, re.MULTILINE)
    assert {name: codes for name, codes, _ in rows} == {
        name: ", ".join(case.codes) for name, case in CASES.items()
    }
    assert f"{sum(int(found) for *_, found in rows)} of {8 * len(CASES)}" in README.read_text()
