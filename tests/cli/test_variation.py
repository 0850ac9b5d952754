"""A job with four logs: spread and next log in result.json, ranges, report and terminal."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import JOINTS, arm, driven_log
from helpers.synthetic import truth

from robotid.base.exceptions import DataError, SettingsError
from robotid.cli import main
from robotid.cli.identify import run_job
from robotid.cli.job import LogEntry, job_from_settings
from robotid.cli.logs import survey_logs
from robotid.cli.preview import preview_job
from robotid.cli.validate import _show as show_validation
from robotid.cli.validate import validate
from robotid.data.files.read import write_log
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.variation.groups import runs_of, sums_of
from robotid.estimation.variation.spread import Mixture
from robotid.estimation.variation.variation import SCORES, vary
from robotid.output.files.ranges import parameter_ranges, stated_ranges
from robotid.robot.examples import example_urdf

COULOMB = "shoulder_lift_joint.coulomb"


def settings(folder, units=()):
    names = [f"run_{k}.csv" for k in range(4)]
    logs = [{"log": str(folder / name)} for name in names]
    for log, unit in zip(logs, units, strict=False):
        log["unit"] = unit
    return {
        "urdf": str(example_urdf("ur5_robot.urdf")), "joints": list(JOINTS),
        "locked": {"*": 0.0}, "identification": logs, "model": {"friction": "viscous+coulomb"},
    }  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    model, rng, where = arm(), np.random.default_rng(0), tmp_path_factory.mktemp("runs")
    k = model.layout.names.index(COULOMB)
    for run in range(4):
        pi = truth(model)
        pi[k] *= 1 + 0.1 * rng.normal()
        write_log(driven_log(model, pi, run, duration=6.0), where / f"run_{run}.csv")
    return where


@pytest.fixture(scope="module")
def result(folder):
    job = job_from_settings(settings(folder), "job.toml", folder)
    found, content = run_job(job, folder / "out")
    return found, json.loads(json.dumps(content))


def test_result_has_the_variation_of_each_drive_parameter(result, folder):
    found, content = result
    variation = content["variation"]
    assert variation["logs"] == [f"run_{k}.csv" for k in range(4)]
    assert variation["units"] == 1
    entry, own = variation["parameters"][COULOMB], found.variation.parameters
    each = next(x for x in own if x.name == COULOMB)
    assert entry["next_interval"] == each.prediction.ends.tolist()
    assert entry["spread_interval"] == each.prediction.spread_ends.tolist()
    assert (entry["mean"], entry["std_error"], entry["spread"]) == (
        each.prediction.mean, each.prediction.std_error, each.prediction.spread
    )  # fmt: skip
    assert entry["std_error_by_log"] == each.std_errors.tolist()
    assert entry["one_more"] == dict(
        zip(("std_error", "interval_width"), each.prediction.after, strict=True)
    )
    middle = each.prediction.mixture.quantiles(np.full(1, 0.5))[0]
    assert entry["next_quantiles"][7] == pytest.approx(middle)
    low, high = np.interp([-1.96, 1.96], SCORES, entry["next_quantiles"])
    assert [low, high] == pytest.approx(entry["next_interval"], rel=0.1)
    assert np.array(variation["correlation"]).shape == (len(own), len(own))
    assert [each["log"].split(" ")[0] for each in content["left_out"]] == variation["logs"]
    for each, metrics in zip(content["left_out"], found.left_out.values(), strict=True):
        measured = metrics.per_joint["elbow_joint"].rmse
        assert each["per_joint"]["elbow_joint"]["rmse"] == measured
    assert entry["unit"] == "N m"
    assert "spread_within_units" not in entry


def test_ranges_stay_possible_and_have_no_ends_at_a_bound(result):
    found, _ = result
    ends = np.array([-1.0, 5.0])
    normal = Mixture(np.ones(1), ends.mean(keepdims=True), np.array([np.ptp(ends) / 3.919928]))
    each = [replace(x, prediction=replace(x.prediction, mixture=normal))
            for x in found.variation.parameters]  # fmt: skip
    wide = replace(found, variation=replace(found.variation, parameters=tuple(each)))
    drives = parameter_ranges(wide)["drives"]["elbow_joint"]
    assert (drives["coulomb"]["low"], drives["coulomb"]["high"]) == (0.0, pytest.approx(5.0))
    assert (drives["offset"]["low"], drives["offset"]["high"]) == pytest.approx((-1.0, 5.0))
    standard = found.standard.copy()
    standard[found.model.layout.names.index("elbow_joint.coulomb")] = 0.0
    drives = parameter_ranges(replace(wide, standard=standard))["drives"]["elbow_joint"]
    assert drives["coulomb"] == {"nominal": 0.0, "source": "bound", "unit": "N m"}
    assert drives["viscous"]["source"] == "logs"


def spread_of(found, log, count=3000):
    """Return the RMS torque of drawn differences of the parameters, per joint."""
    rng, C = np.random.default_rng(0), found.standard_covariance + found.between
    w, V = np.linalg.eigh(C)
    x = rng.standard_normal((count, len(C))) @ (V * np.sqrt(w.clip(0))).T
    Y = joint_torque_regressor(found.model, log.q[::10], log.v[::10], log.a[::10])
    return np.sqrt(np.mean((Y @ x.T).reshape(-1, len(JOINTS), count) ** 2, axis=(0, 2)))


def test_validation_expects_the_error_of_the_next_log(result, folder, capsys):
    found, content = result
    log = driven_log(found.model, truth(found.model), 9, duration=6.0)
    write_log(log, folder / "next.csv")
    done = validate(folder / "out" / "result.json", [folder / "next.csv"])
    expected = done["validation"][0]["expected"]
    assert expected["with_spread"] is True
    noise = [content["identification"]["per_joint"][joint]["rmse"] for joint in JOINTS]
    wanted = np.hypot(spread_of(found, log), noise)
    assert [expected["per_joint"][joint]["rmse"] for joint in JOINTS] == pytest.approx(
        wanted, rel=0.05
    )
    assert all(0 <= x["within_95_pct"] <= 100 for x in expected["per_joint"].values())
    assert min(x["within_95_pct"] for x in expected["per_joint"].values()) > 60
    del expected["per_joint"]["elbow_joint"], expected["per_joint"]["wrist_1_joint"]
    expected["per_joint"]["shoulder_lift_joint"] = {"rmse": 1.234, "within_95_pct": 94.6}
    show_validation(done)
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "expected rmse by the fit and spread between logs (share of rows within 95 %): "
        "shoulder_lift_joint 1.23 (95 %)"
    ) in printed


def test_preview_adds_the_spread_between_logs(result, folder):
    found, _ = result
    log = driven_log(found.model, truth(found.model), 9, duration=6.0)
    write_log(log, folder / "next.csv")
    job = job_from_settings(
        {**settings(folder), "identification": [{"log": str(folder / "next.csv")}]}, "j", folder
    )
    given = folder / "out" / "result.json"
    wide = preview_job(job, str(given))["torque"]
    bare = json.loads(given.read_text())
    del bare["variation"]
    other = folder / "bare"
    other.mkdir()
    for file in given.parent.iterdir():
        if file.suffix in (".urdf", ".json"):
            (other / file.name).write_bytes(file.read_bytes())
    (other / "result.json").write_text(json.dumps(bare))
    narrow = preview_job(job, str(other))["torque"]
    K = found.mapping.K
    W = joint_torque_regressor(found.model, log.q, log.v, log.a)[:, found.mapping.independent]
    added = np.einsum("ij,jk,ik->i", W, K @ found.between @ K.T, W).reshape(-1, len(JOINTS))
    for j, joint in enumerate(JOINTS):
        squares = (wide[joint]["half_width"] ** 2 - narrow[joint]["half_width"] ** 2) / 1.96**2
        assert squares == pytest.approx(added[:, j].mean(), rel=0.1), joint


@pytest.mark.parametrize(
    ("places", "value"),
    [
        ((), 5),
        (("parameters",), []),
        (("parameters", COULOMB, "next_interval"), [1.0]),
        (("parameters", COULOMB, "next_quantiles", 0), 1e9),
        (("parameters", COULOMB, "std_error"), -1.0),
        (("parameters", "elbow.warmth"), {}),
        (("correlation", 0), [1.0]),
        (("correlation", 0, 0), -1.0),
        (("sums", "H", 0, 0), -1.0),
        (("sums", "h"), [[]]),
        (("sums", "scatter", 0), []),
        (("sums", "sigma"), []),
    ],
    ids=str,
)
def test_a_variation_that_was_changed_by_hand_is_refused(
    result, folder, tmp_path, places, value, capsys
):
    shutil.copytree(folder / "out", tmp_path / "out")
    path = tmp_path / "out" / "result.json"
    content = json.loads(path.read_text())
    *rest, last = ("variation", *places)
    table = content
    for key in rest:
        table = table[key]
    table[last] = value
    path.write_text(json.dumps(content))
    assert main(["validate", str(path), str(folder / "run_0.csv")]) == 1
    assert "variation" in capsys.readouterr().err


def changed_log(found, seed, **factors):
    """Return a log of a robot with changed drive parameters, in place of __ a point."""
    pi = truth(found.model)
    for name, factor in factors.items():
        pi[found.model.layout.names.index(name.replace("__", "."))] *= factor
    return driven_log(found.model, pi, seed, duration=6.0)


@pytest.fixture
def written(result, folder, tmp_path, monkeypatch):
    """A copy of the result, two new logs, and the fitted ones out of reach; no doctor."""
    monkeypatch.setattr("robotid.cli.validate.diagnose", lambda *_: [])
    found, _ = result
    for file in (folder / "out").glob("*.*"):
        if file.suffix in (".urdf", ".json"):
            shutil.copy(file, tmp_path)
    write_log(changed_log(found, 11, elbow_joint__coulomb=1.1), tmp_path / "more_0.csv")
    write_log(changed_log(found, 12, shoulder_lift_joint__coulomb=0.9), tmp_path / "more_1.csv")
    return tmp_path


def joined(found, names, folder, shift):
    """Return the variation of fitted and added logs about the fit, of one pass over each part."""
    job, sums = job_from_settings(settings(folder), "job.toml", folder), []
    for k, own in enumerate(names):
        (logs,) = survey_logs(job, found.model, [LogEntry(path) for path in own])
        cut = Recordings(found.model, found.mapping, logs).reduce_logs()
        segments = [[part.factors.without(shift * (k > 0)) for part in parts] for parts in cut]
        sums.append(sums_of(found.model, found.mapping, segments, found.standard, found.sums.sigma))
    H, h = (np.concatenate([getattr(each, key) for each in sums]) for key in "Hh")
    total = replace(sums[0], H=H, h=h, scatter=sum(each.scatter for each in sums))
    unit = np.zeros(len(h), int)
    groups = runs_of(found.model, found.mapping, found.standard, total, unit)
    return vary([path.name for some in names for path in some], groups).to_dict()


def test_logs_are_added_to_the_variation_without_the_others(result, folder, written):
    found, content = result
    names = [
        [folder / f"run_{k}.csv" for k in range(4)],
        *([written / f"more_{k}.csv"] for k in range(2)),
    ]
    assert "shift" not in content["variation"]["sums"]  # no positions are quantised
    shift = 0.01 * np.abs(found.base)
    wanted = joined(found, names, folder, shift)
    file, hidden = written / "result.json", folder / "hidden"
    before = json.loads(file.read_text())
    before["variation"]["sums"]["shift"] = shift.tolist()
    file.write_text(json.dumps(before))
    (folder / "run_2.csv").rename(hidden)
    try:
        for k in range(2):  # one after the other
            done = validate(file, [written / f"more_{k}.csv"], update=True)
    finally:
        hidden.rename(folder / "run_2.csv")
    after = json.loads(file.read_text())
    variation = after["variation"]
    assert variation["logs"] == [path.name for some in names for path in some] == wanted["logs"]
    for name, entry in wanted["parameters"].items():
        own = variation["parameters"][name]
        for key in ("mean", "std_error", "spread", "next_interval", "by_log", "std_error_by_log"):
            assert own[key] == pytest.approx(entry[key], rel=1e-6, abs=1e-9), (name, key)
    assert np.array(variation["correlation"]) == pytest.approx(np.array(wanted["correlation"]))
    assert done["variation"] == {k: x for k, x in variation.items() if k != "sums"}
    assert [x["path"] for x in variation["added"]] == [str(path) for (path,) in names[1:]]
    assert {k: x for k, x in after.items() if k != "variation"} == {
        k: x for k, x in before.items() if k != "variation"
    }
    ranges = stated_ranges(after)["drives"]["shoulder_lift_joint"]["coulomb"]
    assert ranges["high"] == variation["parameters"][COULOMB]["next_interval"][1]
    with pytest.raises(DataError, match=r"more_0.csv is .*more_0.csv, which result.json has alre"):
        validate(file, [written / "more_0.csv"], update=True)
    with pytest.raises(DataError, match=r"run_3.csv, which result.json has already; leave it out"):
        validate(file, [folder / "run_3.csv"], update=True)


def test_a_new_log_that_differs_is_named_with_its_cause(result, folder, written, capsys):
    found, _ = result
    log = changed_log(found, 13, shoulder_lift_joint__coulomb=5.0)
    write_log(log, written / "worn.csv")
    before = (written / "result.json").read_bytes()
    done = validate(written / "result.json", [written / "worn.csv", written / "more_0.csv"])
    assert (written / "result.json").read_bytes() == before
    (finding,) = done["findings"]
    assert finding["code"] == "unlike_run"
    assert finding["message"].startswith(f"worn.csv: {COULOMB} is ")
    assert "; 5 other logs predict " in finding["message"]
    true = truth(found.model)[found.model.layout.names.index(COULOMB)] * 5.0
    assert finding["evidence"]["value"] == pytest.approx(true, rel=0.1)
    assert {
        "code": "unlike_run",
        "joint": "",
        "message": "worn.csv: the log differs from the other logs",
        "effect": "usable",
    } in done["verdict"]["warnings"]
    show_validation(done)
    assert f"worn.csv: {COULOMB} is " in " ".join(capsys.readouterr().out.split())
    log = changed_log(found, 15)
    write_log(replace(log, q=log.q + np.array([0.0, 0.2, 0.0])), written / "slipped.csv")
    done = validate(written / "result.json", [written / "more_0.csv", written / "slipped.csv"])
    (finding,) = done["findings"]
    assert finding["message"].startswith("slipped.csv: the positions of elbow_joint differ by +0.")
    assert finding["evidence"]["value"] == pytest.approx(0.2, abs=0.05)  # first order
    content = json.loads(before)
    content["variation"]["sums"]["unit"] = ["a", "b", "c", "d"]  # of another robot
    (written / "result.json").write_text(json.dumps(content))
    done = validate(written / "result.json", [written / "worn.csv"])
    (finding,) = done["findings"]
    assert finding["message"].startswith(f"unit worn.csv: {COULOMB} is ")


def test_the_robot_of_added_logs_is_stated_if_that_of_others_is(written, capsys):
    file, log = written / "result.json", str(written / "more_0.csv")
    content = json.loads(file.read_text())
    sums = content["variation"]["sums"]
    assert sums["unit"] == [""] * 4
    sums["unit"] = ["a", "a", "b", "b"]
    for entry, unit in zip(content["settings"]["identification"], sums["unit"], strict=True):
        entry["unit"] = unit
    file.write_text(json.dumps(content))
    done = validate(file, [log])["variation"]  # of an unknown robot
    assert done["units"] == 3
    with pytest.raises(SettingsError, match=r"more_0.csv has no unit, but run_0.csv has unit = .a"):
        validate(file, [log], update=True)
    assert json.loads(file.read_text()) == content
    assert main(["validate", str(file), log, "--update", "--unit", "b"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "result.json counts these logs now: spread between 5 logs, by joint: coul" in printed
    variation = json.loads(file.read_text())["variation"]
    assert variation["units"] == 2
    assert variation["sums"]["unit"] == ["a", "a", "b", "b", "b"]


def test_results_without_sums_cannot_be_updated(written):
    file = written / "result.json"
    content = json.loads(file.read_text())
    del content["variation"]["sums"]
    file.write_text(json.dumps(content))
    assert "variation" not in validate(file, [written / "more_0.csv"])
    with pytest.raises(DataError, match="wanted a result of three or more logs with torques; id"):
        validate(file, [written / "more_0.csv"], update=True)
