"""A job with four logs: spread and next log in result.json, ranges, report and terminal."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.driven import JOINTS, arm, driven_log
from helpers.synthetic import truth

from robotid.cli.identify import run_job
from robotid.cli.job import LogEntry, job_from_settings
from robotid.cli.logs import survey_logs
from robotid.cli.validate import _show as show_validation
from robotid.cli.validate import validate
from robotid.data.files.read import write_log
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.regressor_noise import RegressorNoise
from robotid.estimation.variation.groups import runs_of, sums_of
from robotid.estimation.variation.variation import SCORES, vary
from robotid.output.files.entries import build_result
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
        "output": {"report": False},
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
    wanted = dict(zip(("std_error", "interval_width"), each.prediction.after, strict=True))
    assert entry["one_more"] == wanted
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
        "expected rmse [N m or N] by the fit and spread between logs (rows within 95 %): "
        "shoulder_lift_joint 1.23 (95 %)"
    ) in printed


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
    write_log(changed_log(found, 11, elbow_joint__coulomb=3.0), tmp_path / "more_0.csv")
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


def test_new_logs_are_compared_with_the_fitted_ones_without_reading_these(result, folder, written):
    found, content = result
    new = [written / f"more_{k}.csv" for k in range(2)]
    assert "shift" not in content["variation"]["sums"]  # no positions are quantised
    shift = 0.01 * np.abs(found.base)
    wanted = joined(found, [[folder / f"run_{k}.csv" for k in range(4)], new], folder, shift)
    file = written / "result.json"
    b = len(shift)
    noise = RegressorNoise(np.zeros(3), np.zeros(3), shift, np.ones(b), np.eye(b))
    counted, corrected = (
        build_result(replace(found, regressor_noise=x), settings(folder))["variation"]
        for x in (noise.uncorrected(np.eye(b)), noise)
    )
    assert "shift" not in counted["sums"]
    file.write_text(json.dumps(json.loads(file.read_text()) | {"variation": corrected}))
    before, hidden = file.read_bytes(), folder / "hidden"
    (folder / "run_2.csv").rename(hidden)
    try:
        done = validate(file, new)
    finally:
        hidden.rename(folder / "run_2.csv")
    variation = done["variation"]
    unlike = {(x["where"].split(":")[0], x["code"]) for x in done["findings"]}
    assert unlike == {("more_0.csv", "unlike_run")}
    assert variation["logs"] == [f"run_{k}.csv" for k in range(4)] + ["more_0.csv", "more_1.csv"]
    for name, entry in wanted["parameters"].items():
        own = variation["parameters"][name]
        for key in ("mean", "std_error", "spread", "next_interval", "by_log", "std_error_by_log"):
            assert own[key] == pytest.approx(entry[key], rel=1e-6, abs=1e-9), (name, key)
    assert np.array(variation["correlation"]) == pytest.approx(np.array(wanted["correlation"]))
    assert [x["path"] for x in variation["added"]] == [str(path) for path in new]
    assert file.read_bytes() == before
