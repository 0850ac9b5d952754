"""The command line as a user meets it: files in, files out, exit codes and messages."""

import json
import re

import numpy as np
import pytest
from helpers.paths import URDF as PLANAR
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.data.files.read import read_log, write_log
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor

ARM = str(PLANAR / "planar_2r.urdf")
PLAIN = ("--friction", "viscous+coulomb", "--no-report")


def test_the_written_urdf_predicts_what_the_fit_predicts(arm_logs, tmp_path, capsys):
    fit, keep = (str(arm_logs / f"{name}.csv") for name in ("fit", "keep"))
    words = ["identify", ARM, fit, "--validate", keep, "--no-report", "--out", str(tmp_path)]
    assert main(words) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    capsys.readouterr()
    assert main(["validate", str(tmp_path / "result.json"), keep, "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["predicted_with"] == "planar_2r.identified.urdf"
    for joint, before in result["validation"][0]["per_joint"].items():
        after = again["validation"][0]["per_joint"][joint]
        assert after.keys() == before.keys()
        assert after.pop("unit") == before.pop("unit")
        assert after == pytest.approx(before, rel=1e-6)


def test_json_is_the_result_alone_and_friction_goes_into_the_urdf(arm_logs, tmp_path, capsys):
    """Of one log without another to validate on, without a report."""
    out = tmp_path / "out"
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--out", str(out), "--json"]
    assert main([*words, "--dynamics", *PLAIN]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    result = json.loads(printed.out)
    assert result == json.loads((out / "result.json").read_text())
    assert set(result["outputs"]) == {"urdf", "sidecar"}
    written = {path.name for path in out.iterdir()}
    assert written == {"result.json", *result["outputs"].values()}
    value = {p["name"]: p["value"] for p in result["drive_parameters"]}
    text = (out / result["outputs"]["urdf"]).read_text()
    for joint in ("joint_1", "joint_2"):
        (own,) = re.findall(rf'<joint name="{joint}".*?<dynamics (.*?)/>', text, re.DOTALL)
        viscous, coulomb = (value[f"{joint}.{term}"] for term in ("viscous", "coulomb"))
        assert own == f'damping="{viscous!r}" friction="{coulomb!r}"'


def test_wls_result_without_a_urdf_can_be_validated(arm, arm_logs, tmp_path, capsys):
    # noise as large as the torque on few rows: unconstrained parameters that cannot be
    out = tmp_path / "out"
    noisy = exact_log(arm, truth(arm), np.random.default_rng(1), noise=50.0, samples=200)
    write_log(noisy, tmp_path / "noisy.csv")
    words = ["identify", ARM, str(tmp_path / "noisy.csv"), "--estimator", "wls", *PLAIN]
    assert main([*words, "--out", str(out), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "urdf" not in result["outputs"]
    assert "urdf_not_written" in [warning["code"] for warning in result["warnings"]]
    keep = arm_logs / "keep.csv"
    assert main(["validate", str(out / "result.json"), str(keep), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert "result.json" in again["predicted_with"]
    # the error of the base parameters, predicted by hand; the filter takes next to nothing
    log, mapping = read_log(keep, arm.joints), structural_mapping(arm)
    inside = (log.t > 0.5) & (log.t < log.t[-1] - 0.5)
    W = joint_torque_regressor(arm, log.q[inside], log.v[inside], log.a[inside])
    beta = np.array([entry["value"] for entry in result["base_parameters"]])
    error = (log.tau[inside].ravel() - W[:, mapping.independent] @ beta).reshape(-1, 2)
    wanted = np.linalg.norm(error, axis=0) / np.linalg.norm(log.tau[inside], axis=0)
    found = [again["validation"][0]["per_joint"][j]["relative_error_pct"] for j in arm.joints]
    assert found == pytest.approx(100 * wanted, rel=0.1)


WRONG_USE = {
    "unknown estimator": (["--estimator", "magic"], 2, "estimator is 'magic'"),
    "bad gain": (["--gain", "elbow"], 2, "expected JOINT=NUMBER"),
    "bad cutoff": (["--cutoff", "no"], 2, "expected a number or false"),
    "unknown joint": (["--joints", "elbow"], 1, "joint 'elbow' is not in planar_2r.urdf"),
    "cutoff beyond half the rate": (["--cutoff", "80"], 2, "not below half the rate"),
    "unknown unit": (["--time-unit", "min"], 2, "time is 'min', expected one of"),
}


@pytest.mark.parametrize(("flags", "code", "message"), WRONG_USE.values(), ids=WRONG_USE)
def test_wrong_use_has_its_exit_code_and_message(arm_logs, tmp_path, capsys, flags, code, message):
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--out", str(tmp_path / "out"), *flags]
    assert main(words) == code
    assert message in capsys.readouterr().err
