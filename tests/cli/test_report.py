"""``robotid report``: the page of a result again, from the same inputs or not at all."""

import json

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.cli.identify import run_job
from robotid.cli.job import Job, LogEntry
from robotid.data.files.read import write_log
from robotid.robot.model import RobotModel

URDF = ROOT / "urdf" / "planar_2r.urdf"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("report")
    model, rng = RobotModel.from_urdf(URDF), np.random.default_rng(0)
    for name in ("fit", "keep"):
        log = exact_log(model, truth(model), rng, samples=800, rate=100.0, noise=0.1)
        write_log(log, tmp_path / f"{name}.csv")
    (tmp_path / "arm.urdf").write_bytes(URDF.read_bytes())
    fit, keep = (LogEntry(tmp_path / f"{name}.csv") for name in ("fit", "keep"))
    terms = ("viscous", "coulomb")
    job = Job(tmp_path / "arm.urdf", terms=terms, identification=(fit,), validation=(keep,))
    run_job(job, tmp_path / "out")
    return tmp_path / "out"


@pytest.fixture
def out(made):
    """A folder with a result, in the one of its logs; it is as it was for the next test."""
    files = {path: path.read_bytes() for path in made.parent.rglob("*") if path.is_file()}
    yield made
    for path, content in files.items():
        if not path.exists() or path.read_bytes() != content:
            path.write_bytes(content)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_page_is_the_one_that_identify_wrote_and_nothing_else_is(out, capsys, monkeypatch):
    before = contents(out)
    (out / "report.html").unlink()
    monkeypatch.chdir(out.parent.parent)  # the result names its inputs in full
    assert main(["report", str(out)]) == 0
    assert contents(out) == before
    assert capsys.readouterr().out == f"written: {out / 'report.html'}\n"
    page = out.parent / "page.html"
    assert main(["report", str(out / "result.json"), "--out", str(page), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["report"] == str(page)
    assert b'href="result.json"' in before["report.html"]
    assert b'href="result.json"' not in page.read_bytes(), "it lies elsewhere"
    assert contents(out) == before


@pytest.mark.parametrize(("name", "what"), [("fit.csv", "log"), ("arm.urdf", "URDF")])
def test_an_input_that_was_changed_or_is_gone_is_named(out, capsys, name, what):
    path, before = out.parent / name, contents(out)
    path.write_bytes(path.read_bytes() + b"\n")
    assert main(["report", str(out)]) == 1
    said = capsys.readouterr().err
    assert f"the {what} '{path}', an input of result.json, has changed" in said
    path.unlink()
    assert main(["report", str(out)]) == 1
    assert f"the {what} '{path}', an input of result.json, does not exist" in (
        capsys.readouterr().err
    )
    assert contents(out) == before


def test_a_result_that_the_fit_does_not_give_again_has_no_page(out, capsys):
    path = out / "result.json"
    content = json.loads(path.read_text())
    entry = content["base_parameters"][1]
    true = entry["value"]
    entry["value"] = true + 0.02 * entry["std_error"]
    content["versions"]["numpy"] = "1.0"
    path.write_text(json.dumps(content))
    before = contents(out)
    assert main(["report", str(out)]) == 1
    said = capsys.readouterr().err
    count = len(content["base_parameters"])
    assert f"1 of {count} base parameters differ: {entry['name']} is {true:.6g}, " in said
    assert "changed versions: numpy 1.0 -> " in said
    assert contents(out) == before
    entry["value"] = true + 0.005 * entry["std_error"]  # as solvers round
    path.write_text(json.dumps(content))
    assert main(["report", str(out)]) == 0


def test_a_report_does_not_replace_what_it_is_made_of(out, capsys):
    before = contents(out)
    for target in ("result.json", "arm.identified.urdf"):
        assert main(["report", str(out), "--out", str(out / target)]) == 2
        assert "is an input and is not replaced" in capsys.readouterr().err
    assert contents(out) == before
