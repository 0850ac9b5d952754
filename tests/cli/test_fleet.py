"""A fleet: the table, results of units, failures, resumed runs with the same bits, the page."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pyarrow.parquet
import pytest
from helpers.pages import tables
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import DataError
from robotid.cli import fleet, main
from robotid.cli.fleet import FleetUnit, read_fleet, run_fleet
from robotid.data.files.read import write_log
from robotid.estimation.variation.variation import between_units
from robotid.estimation.work_plan import WorkPlan
from robotid.robot.model import RobotModel

URDF = ROOT / "urdf" / "planar_2r.urdf"
FILES = ("fleet.parquet", "fleet.json", "fleet.html")


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """A table of four units, with three logs, one, one, and one that is missing."""
    folder, rng = tmp_path_factory.mktemp("fleet"), np.random.default_rng(0)
    model, lines = RobotModel.from_urdf(URDF), ["unit,log,urdf,site"]
    k = model.layout.names.index("joint_2.coulomb")
    for unit, count in (("a", 3), ("b", 1), ("c", 1)):
        for run in range(count):
            pi = truth(model)
            pi[k] *= 1.0 + 0.1 * rng.normal()
            log = exact_log(model, pi, rng, samples=250, noise=0.1)
            write_log(replace(log, t=log.t + 50.0), folder / f"{unit}{run}.csv")
            lines.append(f"{unit},{unit}{run}.csv,{URDF},north")
    lines += [f"a,lost.csv,{URDF},north", f"d,none.csv,{URDF},"]
    (folder / "fleet.csv").write_text("\n".join(lines) + "\n")
    return folder / "fleet.csv"


@pytest.fixture(scope="module")
def done(table, tmp_path_factory):
    folder = tmp_path_factory.mktemp("done")
    return folder, run_fleet(read_fleet(table), folder, plan=WorkPlan())


def rows_of(folder, **wanted):
    every = pyarrow.parquet.read_table(folder / "fleet.parquet").to_pylist()
    return [row for row in every if all(row[key] == value for key, value in wanted.items())]


def identified(table, folder, *names):
    """Return the logs of some names, and their result by the command line."""
    logs = [str(table.parent / f"{name}.csv") for name in names]
    assert main(["identify", str(URDF), *logs, "--out", str(folder), "--no-report"]) == 0
    return logs, json.loads((folder / "result.json").read_text())


def test_a_unit_has_the_result_of_identify(table, done, tmp_path):
    _, result = identified(table, tmp_path, "b0")
    rows = rows_of(done[0], unit="b", status="done")
    expected = {e["name"]: (e["value"], e["std_error"]) for e in result["base_parameters"]}
    assert {row["parameter"]: (row["value"], row["std_error"]) for row in rows} == expected
    assert {row["verdict"] for row in rows} == {result["verdict"]["status"]}
    assert {row["log"] for row in rows} == {None}


def test_a_unit_of_three_logs_has_mean_spread_and_the_values_of_its_logs(table, done, tmp_path):
    logs, result = identified(table, tmp_path, "a0", "a1", "a2")
    for name, varied in result["variation"]["parameters"].items():
        rows = {row["log"]: row for row in rows_of(done[0], unit="a", parameter=name)}
        figures = [rows[None][key] for key in ("value", "std_error", "spread")]
        assert figures == [varied[key] for key in ("mean", "std_error", "spread")]
        assert [rows[log]["value"] for log in logs] == varied["by_log"]
        assert [rows[log]["std_error"] for log in logs] == varied["std_error_by_log"]


def test_a_failure_is_a_row_and_the_others_are_identified(done, table):
    folder, content = done
    assert (content["units"], content["logs"], content["done"]) == (4, 7, 3)
    (lost,) = rows_of(folder, log=str(table.parent / "lost.csv"))
    assert (lost["unit"], lost["status"], lost["value"]) == ("a", "failed", None)
    assert "there is no log file" in lost["error"]
    unit, log = rows_of(folder, unit="d")
    assert unit["error"].startswith("no log is usable")
    assert "none.csv" in log["error"]
    html = (folder / "fleet.html").read_text()
    page = tables(html)
    found = page["Units, the worst first"].rows
    assert [row[:2] for row in found] == [
        ["d", "failed"], ["b", "usable"], ["c", "usable"], ["a", "good"]
    ]  # fmt: skip
    assert found[3][2].startswith("there is no log file")
    reports = re.findall(r'<a href="(.*?)">report</a>', html)
    heads = [re.search("<title>(.*?)</title>", (folder / x).read_text())[1] for x in reports]
    assert heads == 3 * ["planar_2r: identified parameters"]
    assert [x["unit"] for x in content["failures"]] == ["a", "d", "d"]
    assert sum(content["verdicts"].values()) == 3


def test_units_with_the_same_inputs_are_kept_and_new_logs_added(table, done, tmp_path, monkeypatch):
    units, first, repeated = read_fleet(table), fleet.identify_unit, []
    monkeypatch.setattr(
        fleet, "identify_unit", lambda unit, threads: repeated.append(unit.unit) or first(unit, 1)
    )
    shutil.copytree(done[0], tmp_path / "own")
    same = run_fleet(units, tmp_path / "own", plan=WorkPlan(), resume=True)
    assert same == done[1]
    assert repeated == ["a", "d"]  # with a failure
    for name in FILES:
        assert (tmp_path / "own" / name).read_bytes() == (done[0] / name).read_bytes()
    repeated.clear()
    extra = replace(units[2], logs=(*units[2].logs, units[1].logs[0]))
    changed = run_fleet([units[1], extra], tmp_path / "own", plan=WorkPlan(), resume=True)
    assert repeated == ["c"]
    assert changed["logs"] == 3
    run_fleet([units[1], extra], tmp_path / "whole", plan=WorkPlan())
    for name in FILES:
        assert (tmp_path / "own" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_unit_is_identified_again_if_an_input_changes(table, tmp_path, monkeypatch):
    repeated, robot, job = [], tmp_path / "robot.urdf", tmp_path / "job.toml"
    robot.write_text(URDF.read_text())
    job.write_text('urdf = "robot.urdf"\n')
    log, other = (table.parent / name for name in ("b0.csv", "c0.csv"))
    unit = FleetUnit("u", ((log, None), (other, 1.0)), robot, job)

    def is_repeated(unit):
        repeated.clear()
        run_fleet([unit], tmp_path / "out", plan=WorkPlan(), resume=True)
        return bool(repeated)

    rows = [{"unit": "u", "status": "done", "verdict": "good"}], ""
    monkeypatch.setattr(fleet, "identify_unit", lambda unit, _: repeated.append(unit) or rows)
    assert [is_repeated(unit), is_repeated(unit)] == [True, False]
    assert is_repeated(replace(unit, logs=((log, None), (other, 2.0))))
    for file in (robot, job):
        file.write_text(f"{file.read_text()}\n")
        assert [is_repeated(unit), is_repeated(unit)] == [True, False]
    monkeypatch.setattr(fleet, "code_versions", lambda: {"numpy": "0.1"})
    assert is_repeated(unit)


def test_rows_state_urdf_job_and_payload(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("log,unit,payload,job\nx.csv,one,,own.toml\ny.csv,two,2.5,\nz.csv,two,0,\n")
    one, two = read_fleet(path, "arm.urdf", "all.toml")
    assert (one.unit, one.job, one.logs) == (
        "one", tmp_path / "own.toml", ((tmp_path / "x.csv", None),)
    )  # fmt: skip
    assert two.logs == ((tmp_path / "y.csv", 2.5), (tmp_path / "z.csv", None))
    assert (str(two.urdf), str(two.job)) == ("arm.urdf", "all.toml")
    job = replace(two, job=None).stated()
    assert [entry.path.name for entry in job.identification] == ["z.csv"]
    assert [(entry.path.name, entry.mass) for entry in job.payload_checks] == [("y.csv", 2.5)]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("unit,logs\na,x\n", r"has no column 'log' \(its log\); columns: unit, logs\. Did you mean "
         "'logs'"),
        ("unit,log,payloads\na,x,1\n", "unknown column 'payloads'. Did you mean 'payload'"),
        ("unit,log\n", "has no rows"),
        ("unit,log\na,x\n,y\n", "row 2, column 'unit': no value, expected the name of the robot"),
        ("unit,log,urdf\na,x,1.urdf\na,y,2.urdf\n", "row 2, column 'urdf': '2.urdf', but row 1 of "
         "the unit 'a' has '1.urdf'"),
        ("unit,log,urdf\na,x,1.urdf\na,x,1.urdf\n", "row 2, column 'log': 'x' is in row 1"),
        ("unit,log\na,x\n", "row 1, column 'urdf': the unit 'a' has no URDF"),
        ("unit,log,payload,urdf\na,x,heavy,u\n", "row 1, column 'payload': 'heavy', expected a"),
        ("unit,log,payload,urdf\na,x,-1,u\n", "row 1, column 'payload': '-1', expected a mass"),
    ],
)  # fmt: skip
def test_a_bad_table_is_refused_with_row_column_and_value(tmp_path, text, said):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(DataError, match=said):
        read_fleet(path)


def test_the_command_prints_what_failed_and_takes_a_parquet_table(table, tmp_path, capsys):
    rows = {"unit": ["d"], "log": ["none.csv"], "payload": [None], "urdf": [str(URDF)]}
    pyarrow.parquet.write_table(pyarrow.table(rows), tmp_path / "t.parquet")
    words = ["fleet", str(tmp_path / "t.parquet"), "--out", str(tmp_path / "out"), "--workers", "1"]
    assert main(words) == 1
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.startswith("0 of 1 units identified, 1 logs failed: d: no log is")
    assert main([*words, "--json"]) == 1
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((tmp_path / "out" / "fleet.json").read_text())
    assert content["failures"][1]["log"] == str(tmp_path / "none.csv")


def test_units_are_compared_by_parameter(done):
    folder, content = done
    count = sum(entry["units"] for entry in content["parameters"])
    for entry in content["parameters"]:
        rows = [row for row in rows_of(folder, parameter=entry["name"]) if row["verdict"]]
        values, errors = (np.array([row[key] for row in rows]) for key in ("value", "std_error"))
        assert (entry["units"], entry["values"]) == (3, values.tolist())
        prediction, different = between_units(values, errors, 0.02 / count)
        figures = entry["mean"], entry["std_error"], entry["spread"]
        assert figures == (prediction.mean, prediction.std_error, prediction.spread)
        assert entry["next_interval"] == prediction.ends.tolist()
        unlike = [x for x in content["unlike"] if x["parameter"] == entry["name"]]
        assert sorted(x["unit"] for x in unlike) == [rows[k]["unit"] for k, _ in different]
    assert content["parameters"]
