"""Results side by side: what is compared, what is refused, what is said to differ."""

import copy
import json
import math
import re
from html import escape

import numpy as np
import pytest
from helpers.pages import tables
from helpers.paths import ROOT, URDF
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.base.files import write_json
from robotid.cli import main
from robotid.data.files.read import write_log
from robotid.output.files.result_file import read_result
from robotid.output.pages.html import page
from robotid.output.report import comparison
from robotid.output.report.comparison import (
    compare_results,
    comparison_page,
    fleet_page,
    write_comparison,
)
from robotid.robot.model import RobotModel


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a.json and b.json: the same logs, fitted as ``consistent`` and as ``wls``."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("results")
    urdf = ROOT / "urdf" / "planar_2r.urdf"
    arm = RobotModel.from_urdf(urdf)
    for name in ("first", "second"):
        write_log(exact_log(arm, truth(arm), rng, samples=800, noise=0.1), path / f"{name}.csv")
    words = ["identify", str(urdf), str(path / "first.csv"), "--validate", str(path / "second.csv")]
    for name, estimator in (("a", "consistent"), ("b", "wls")):
        own = ["--estimator", estimator, "--out", str(path / name), "--no-report"]
        assert main([*words, *own]) == 0
        (path / f"{name}.json").write_bytes((path / name / "result.json").read_bytes())
    return path


@pytest.fixture
def changed(folder, tmp_path):
    """Return a function that writes b.json with a change and compares a.json with it."""

    def compare(change):
        result = copy.deepcopy(read_result(folder / "b.json"))
        change(result)
        write_json(result, tmp_path / "b.json")
        return compare_results([folder / "a.json", tmp_path / "b.json"])

    return compare


def test_another_recording_is_not_compared(changed):
    def other_log(result):
        result["inputs"][-1]["sha256"] = "0" * 64

    found = changed(other_log)
    assert found["validation"] == []
    assert "A was validated on second.csv, other results were not" in found["notes"][0]
    assert "the results have no common validation recording" in found["notes"][-1]
    assert [row["in"] for row in found["inputs"]][:2] == [[True, False], [False, True]]


def test_other_base_parameters_are_refused_by_name(changed):
    with pytest.raises(
        DataError, match=r"a\.json has 1 base parameters that .*b\.json does not have: "
    ):
        changed(lambda result: result["base_parameters"].pop())

    def other_sum(result):
        result["base_parameters"][0]["expression"] = "2 x"

    with pytest.raises(
        DataError, match=r"1 base parameters have other expressions in .* and 2 x; "
    ):
        changed(other_sum)


def test_the_command_prints_a_table_or_one_json_object_and_writes_the_page(
    folder, tmp_path, capsys
):
    paths = [str(folder / "a.json"), str(folder / "b.json")]
    page = tmp_path / "compare.html"
    assert main(["compare", *paths, "--out", str(page)]) == 0
    assert not re.search(r'(src|href)="\w+:', page.read_text(encoding="utf-8"))
    capsys.readouterr()
    assert [p.name for p in tmp_path.iterdir()] == ["compare.html"]
    assert main(["compare", *paths, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == compare_results(paths)
    assert main(["compare", paths[0]]) == 1
    assert "at least two results" in capsys.readouterr().err


def test_parameters_far_apart_stand_first_and_are_counted(folder, tmp_path):
    a, b = (copy.deepcopy(read_result(folder / f"{name}.json")) for name in "ab")
    last = b["base_parameters"][-1]
    last["value"] -= 40 * math.hypot(last["std_error"], a["base_parameters"][-1]["std_error"])
    write_json(b, tmp_path / "b.json")
    write_comparison([folder / "a.json", tmp_path / "b.json"], tmp_path / "c.html")
    html = (tmp_path / "c.html").read_text(encoding="utf-8")
    table = tables(html)["Base parameters ± standard errors"]
    assert table.rows[0][0] == last["name"]
    far = sum(abs(float(row[1].replace("−", "-"))) > 3.0 for row in table.rows)
    assert f"{far} of {len(table.rows)} parameters differ from A by more than 3 combined" in html
    assert "error = 100 |τ − prediction| / |τ| over" in html
    content = compare_results([folder / "a.json", tmp_path / "b.json"])
    positions = [entry | {"unit": "rad"} for entry in content["fitted"]]
    html = comparison_page(content | {"fitted": positions})
    assert "error = 100 |q − simulated| / |motion| over" in html


def test_results_and_logs_of_one_name_are_told_apart_by_the_shortest_path(folder, tmp_path):
    result = read_result(folder / "a.json")
    places = [tmp_path / day / "out" / "result.json" for day in ("monday", "tuesday")]
    places.append(tmp_path / "wls" / "result.json")
    for k, place in enumerate(places):
        place.parent.mkdir(parents=True)
        own = copy.deepcopy(result)
        own["validation"][0]["log"] = f"/data/{'ab'[k > 0]}/run.csv"
        own["inputs"][-1] |= {"path": f"/data/{'ab'[k > 0]}/run.csv", "sha256": str(k > 0)}
        write_json(own, place)
    found = compare_results(places)
    assert [x["name"] for x in found["results"]] == ["monday/out", "tuesday/out", "wls"]
    assert "A was validated on a, other results were not" in found["notes"][0]
    assert "B was validated on b, other" in found["notes"][1]
    write_comparison(places, tmp_path / "c.html")
    html = (tmp_path / "c.html").read_text(encoding="utf-8")
    for label, name in zip("ABC", ("monday/out", "tuesday/out", "wls"), strict=True):
        assert f"<p>{label} {name}: <strong>" in html
    assert [x["name"] for x in compare_results(places[:2])["results"]] == ["monday", "tuesday"]


def test_units_that_failed_stand_before_those_that_differ():
    verdicts = {"a": "good", "b": "usable", "c": "usable", "d": "failed"}
    results = [{"unit": unit, "verdict": verdict, "reason": "why", "report": f"{unit}.html"}
               for unit, verdict in verdicts.items()]  # fmt: skip
    unlike = {"unit": "c", "parameter": "x", "value": 1.0, "std_error": 0.1, "others": (2.0, 3.0)}
    content = {"failures": [], "unlike": [unlike | {"parameter_unit": "kg"}], "parameters": [],
               "results": results, "done": 3, "units": 4, "logs": 4, "verdicts": {}}  # fmt: skip
    assert tables(fleet_page(content))["Units, the worst first"].rows == [
        ["d", "failed", "why", "report"],
        ["c", "usable", "differs from the other units in x; why", "report"],
        ["b", "usable", "why", "report"], ["a", "good", "why", "report"],
    ]  # fmt: skip


MARKUP = "<script>alert(1)<!--'\""


@pytest.fixture(scope="module")
def marked(tmp_path_factory):
    """Two results of a robot whose names are all markup, of files and folders that are, too."""
    folder = tmp_path_factory.mktemp("markup")
    text = (URDF / "planar_2r.urdf").read_text()
    for name in ("planar_2r", "link_1", "link_2", "joint_1", "joint_2"):
        text = text.replace(f'"{name}"', f'"{escape(MARKUP + name)}"')
    urdf = folder / f"{MARKUP}.urdf"
    urdf.write_text(text)
    model, rng = RobotModel.from_urdf(urdf), np.random.default_rng(0)
    assert model.joints == (f"{MARKUP}joint_1", f"{MARKUP}joint_2")
    for name in ("fit", "keep"):
        log = exact_log(model, truth(model), rng, samples=1000, rate=100.0, noise=0.1)
        write_log(log, folder / f"{MARKUP}{name}.parquet")
    logs = [str(folder / f"{MARKUP}{name}.parquet") for name in ("fit", "keep")]
    for estimator in ("consistent", "wls"):
        words = ["identify", str(urdf), logs[0], "--validate", logs[1], "--estimator", estimator]
        assert main([*words, "--out", str(folder / f"<b>{estimator}")]) == 0
    results = [str(folder / f"<b>{name}") for name in ("consistent", "wls")]
    assert main(["compare", *results, "--out", str(folder / "compare.html")]) == 0
    words = ["replay", str(urdf), logs[0], *results, "--ghost", logs[1]]
    assert main([*words, "--html", str(folder / "replay.html")]) == 0
    return folder


def test_no_name_becomes_markup(marked):
    pages = sorted(marked.rglob("*.html"))
    assert len(pages) == 4
    for made in pages:
        text = made.read_text(encoding="utf-8")
        assert "alert(1)" in text
        assert "<script>alert" not in text, made.name
        assert "<b>" not in text.partition("<body>")[2].partition("<script")[0], made.name


def test_a_status_of_another_program_is_refused_and_escaped(marked, tmp_path):
    result = json.loads((marked / "<b>wls" / "result.json").read_text())
    result["verdict"]["status"] = 'good"><script>alert(1)</script>'
    path = tmp_path / "result.json"
    path.write_text(json.dumps(result))
    with pytest.raises(DataError, match=r"verdict.status is .*, expected one of good, usable"):
        read_result(path)
    shown = {"label": "A", "name": "", "path": "", "estimator": "", "verdict": result["verdict"]}
    assert "<script>alert" not in page("", comparison._verdict(shown), {})
