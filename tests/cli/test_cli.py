"""The command line as a user meets it: files in, files out, exit codes and messages."""

import io
import json
import os
import platform
import re
import subprocess
import sys
from contextlib import nullcontext, redirect_stderr, redirect_stdout
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import URDF as PLANAR
from helpers.replay_data import leave_out_meshes
from helpers.synthetic import exact_log, truth

from robotid.cli import main
from robotid.cli.demo import run_demo
from robotid.data.files.read import read_log, write_log
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.output.files.urdf import load_identified
from robotid.robot.drives import LoadFriction
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

URDF = str(example_urdf("ur5_robot.urdf"))
ARM = str(PLANAR / "planar_2r.urdf")
PLAIN = ("--friction", "viscous+coulomb", "--no-report")
NOISE = np.array([0.5, 0.5, 0.25, 0.1, 0.1, 0.05])  # [N m]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A folder with two motions of a UR5 that its URDF does not describe."""
    folder = tmp_path_factory.mktemp("logs")
    model = RobotModel.from_urdf(URDF)
    rng = np.random.default_rng(0)
    for name in ("fit", "keep"):
        log = exact_log(model, truth(model), rng, samples=1500, rate=100.0, noise=NOISE)
        write_log(log, folder / f"{name}.csv")
    return folder


@pytest.fixture(scope="module")
def identified(logs, tmp_path_factory):
    out = tmp_path_factory.mktemp("identified")
    words = ["identify", URDF, str(logs / "fit.csv"), "--validate", str(logs / "keep.csv")]
    assert main([*words, "--out", str(out)]) == 0
    return out


def test_identify_writes_everything_it_names(identified, capsys):
    names = sorted(path.name for path in identified.iterdir())
    assert names == [
        "report.html",
        "result.json",
        "ur5_robot.identified.drive.json",
        "ur5_robot.identified.urdf",
    ]
    result = json.loads((identified / "result.json").read_text())
    assert all((identified / name).is_file() for name in result["outputs"].values())


def test_result_json_has_the_promised_shape(identified, logs):
    result = json.loads((identified / "result.json").read_text())
    assert result["schema_version"] == 1
    assert result["robot"] == "ur5"
    assert result["structure"] == {
        "standard": 60,
        "base_inertial": 36,
        "base": 58,
        "rank": 58,
        "condition": pytest.approx(result["structure"]["condition"]),
        "poorly_excited": False,
        "undetermined": [],
        "indistinguishable": [],
    }
    assert len(result["base_parameters"]) == 58
    assert set(result["base_parameters"][0]) == {
        "name", "expression", "value", "std_error", "interval_95", "unit",
    }  # fmt: skip
    assert len(result["standard_parameters"]) == 60
    assert {p["source"] for p in result["standard_parameters"]} <= {"data", "mixed", "prior"}
    assert len(result["drive_parameters"]) == 24
    assert {p["source"] for p in result["drive_parameters"]} <= {"data", "mixed"}
    assert {p["prior"] for p in result["drive_parameters"]} == {0.0}
    assert result["consistency"]["is_consistent"] is True
    assert result["consistency"]["links"][0]["min_eigenvalue"] > 0
    joint = result["identification"]["per_joint"]["elbow_joint"]
    assert joint["unit"] == "N m"
    # 0.25 N m of noise behind 8 Hz of 50, and a little where friction changes sign
    assert 0.1 < joint["rmse"] < 0.15
    kept = result["validation"][0]
    assert kept["log"] == str(logs / "keep.csv")
    assert set(kept["per_joint"]["elbow_joint"]) == {
        "rmse", "unit", "relative_error_pct", "r2", "rows", "urdf_relative_error_pct",
        "gravity_only_relative_error_pct", "urdf_with_drives_relative_error_pct",
        "better_than_constant",
    }  # fmt: skip
    assert len(result["wls"]["base_values"]) == 58
    assert result["verdict"]["status"] == "good"
    roles = [entry["role"] for entry in result["inputs"]]
    assert roles == ["urdf", "identification", "validation"]
    assert len(result["inputs"][1]["sha256"]) == 64
    assert result["inputs"][1]["signals"]["velocity"] == "measured"


def test_the_written_urdf_predicts_what_the_fit_predicts(identified, logs, capsys):
    result = json.loads((identified / "result.json").read_text())
    assert (
        main(["validate", str(identified / "result.json"), str(logs / "keep.csv"), "--json"]) == 0
    )
    again = json.loads(capsys.readouterr().out)
    assert again["predicted_with"] == "ur5_robot.identified.urdf"
    for joint, before in result["validation"][0]["per_joint"].items():
        after = again["validation"][0]["per_joint"][joint]
        assert after["rmse"] == pytest.approx(before["rmse"], rel=1e-6)
        assert after["urdf_relative_error_pct"] == pytest.approx(before["urdf_relative_error_pct"])


@pytest.mark.parametrize(
    ("place", "wrong", "said"),
    [
        (("base_parameters", 1, "value"), "x", "base_parameters[1].value is 'x', wanted"),
        (("inputs", 2, "path"), 3, "inputs[2].path is 3, wanted"),
        (("verdict", "reasons"), {}, "verdict.reasons is {}, wanted"),
        (
            ("friction", "elbow_joint", "data_range", "v"),
            [0.1, {}],
            "friction.elbow_joint.data_range.v[1] is {}, wanted",
        ),
        (
            ("friction", "elbow_joint", "data_range", "q"),
            [0.1],
            "friction.elbow_joint.data_range.q has 1 numbers, wanted 2: the smallest, the largest",
        ),
        (
            ("friction", "elbow_joint", "data_range", "q"),
            [0.1, 0.2, 0.3],
            "friction.elbow_joint.data_range.q has 3 numbers, wanted 2",
        ),
    ],
)
def test_a_result_that_was_changed_by_hand_is_refused_by_the_place(
    identified, logs, tmp_path, capsys, place, wrong, said
):
    result = json.loads((identified / "result.json").read_text())
    inside = result
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = wrong
    (tmp_path / "result.json").write_text(json.dumps(result))
    assert main(["validate", str(tmp_path / "result.json"), str(logs / "keep.csv")]) == 1
    assert said in capsys.readouterr().err


def test_the_written_urdf_holds_the_identified_masses(identified):
    result = json.loads((identified / "result.json").read_text())
    outputs = result["outputs"]
    model, pi = load_identified(identified / outputs["urdf"], identified / outputs["sidecar"])
    stated = {p["name"]: p["value"] for p in result["standard_parameters"]}
    stated |= {p["name"]: p["value"] for p in result["drive_parameters"]}
    np.testing.assert_allclose(
        pi, [stated[name] for name in model.layout.names], rtol=1e-9, atol=1e-12
    )


@pytest.fixture(scope="module")
def alone(arm_logs, tmp_path_factory):
    """What is printed of one log without another to validate on, and the folder written."""
    out, printed, said = tmp_path_factory.mktemp("alone"), io.StringIO(), io.StringIO()
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--out", str(out), "--json"]
    with redirect_stdout(printed), redirect_stderr(said):
        assert main([*words, "--dynamics", *PLAIN]) == 0
    assert said.getvalue() == ""
    return json.loads(printed.getvalue()), out


def test_friction_goes_into_the_urdf_where_asked(alone):
    result, out = alone
    value = {p["name"]: p["value"] for p in result["drive_parameters"]}
    text = (out / result["outputs"]["urdf"]).read_text()
    for joint in ("joint_1", "joint_2"):
        (own,) = re.findall(rf'<joint name="{joint}".*?<dynamics (.*?)/>', text, re.DOTALL)
        viscous, coulomb = (value[f"{joint}.{term}"] for term in ("viscous", "coulomb"))
        assert own == f'damping="{viscous!r}" friction="{coulomb!r}"'


def test_json_prints_one_object_and_nothing_else(alone):
    result, out = alone
    assert result == json.loads((out / "result.json").read_text())


def test_no_report_is_written_where_none_is_wanted(alone):
    result, out = alone
    assert set(result["outputs"]) == {"urdf", "sidecar"}
    written = {path.name for path in out.iterdir()}
    assert written == {"result.json", *result["outputs"].values()}


def test_without_validation_the_verdict_is_not_good(alone):
    result, _ = alone
    assert result["verdict"]["status"] == "usable"
    assert "no validation log given" in str(result["verdict"]["reasons"])


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


def test_a_log_validated_on_itself_is_named(arm_logs, tmp_path, capsys):
    log = str(arm_logs / "fit.csv")
    words = ["identify", ARM, log, "--validate", log, "--out", str(tmp_path), "--json"]
    assert main([*words, *PLAIN]) == 0
    result = json.loads(capsys.readouterr().out)
    assert "validation_was_fitted" in [warning["code"] for warning in result["warnings"]]
    assert result["verdict"]["status"] != "good"


def test_joints_left_to_stand_at_zero_are_named(tmp_path, capsys):
    model = RobotModel.from_urdf(ARM, joints=["joint_1"])
    write_log(exact_log(model, truth(model), np.random.default_rng(0)), tmp_path / "log.csv")
    words = ["identify", ARM, str(tmp_path / "log.csv"), "--joints", "joint_1"]
    words += ["--estimator", "wls", *PLAIN, "--out", str(tmp_path / "out"), "--json"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    (warning,) = [w for w in result["warnings"] if w["code"] == "locked_at_zero"]
    assert "joint_2" in warning["message"]
    assert main([*words, "--lock", "joint_2=0.0"]) == 0
    codes = [w["code"] for w in json.loads(capsys.readouterr().out)["warnings"]]
    assert "locked_at_zero" not in codes


def spoil(logs, tmp_path, change):
    """Write fit.csv with one thing wrong and return its path."""
    path = tmp_path / "bad.csv"
    path.write_text("\n".join(change((logs / "fit.csv").read_text().splitlines())) + "\n")
    return path


def cell(lines, row, name, value):
    column = lines[0].split(",").index(name)
    words = lines[row].split(",")
    words[column] = value
    return [*lines[:row], ",".join(words), *lines[row + 1 :]]


def scaled(lines, prefix, factor):
    head = lines[0].split(",")
    columns = [i for i, name in enumerate(head) if name.startswith(prefix)]
    body = []
    for line in lines[1:]:
        words = line.split(",")
        for i in columns:
            words[i] = repr(float(words[i]) * factor)
        body.append(",".join(words))
    return [lines[0], *body]


def without(lines, name):
    column = lines[0].split(",").index(name)
    return [",".join(w for i, w in enumerate(line.split(",")) if i != column) for line in lines]


def degrees(lines):
    factor = 180 / np.pi
    return scaled(scaled(scaled(lines, "q_", factor), "dq_", factor), "ddq_", factor)


TAU, Q = "tau_joint_2", "q_joint_2"
# fmt: off
BAD_LOGS = {
    "NaN torque": (lambda x: cell(x, 18, TAU, "nan"), "tau_joint_2 is NaN at row 17"),
    "NaN position": (lambda x: cell(x, 5, Q, "nan"), "q_joint_2 is NaN at row 4"),
    "text": (lambda x: cell(x, 5, Q, "off"), Q),
    "degrees": (lambda x: degrees(x), "degrees"),
    "milliseconds": (lambda x: scaled(x, "time", 1000), "milliseconds"),
    "two stamps swapped": (lambda x: [*x[:9], x[10], x[9], *x[11:]], "t must increase"),
    "duplicate stamp": (lambda x: [*x[:9], x[8], *x[9:]], "duplicate time stamp"),
    "too few rows": (lambda x: x[:45], "too few rows"),
    "missing torque column": (lambda x: without(x, TAU), "joint_2"),
    "header only": (lambda x: x[:1], "row"),
    "velocity of opposite sign": (lambda x: scaled(x, "dq_", -1), "sign"),
}
# fmt: on


@pytest.mark.parametrize(("change", "message"), BAD_LOGS.values(), ids=BAD_LOGS)
def test_a_bad_log_is_refused_by_name_and_nothing_is_written(
    arm_logs, tmp_path, capsys, change, message
):
    path = spoil(arm_logs, tmp_path, change)
    out = tmp_path / "out"
    assert main(["identify", ARM, str(path), "--out", str(out)]) == 1
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.out == ""
    assert not out.exists()


def test_a_stated_unit_overrides_the_suspicion(arm_logs, tmp_path, capsys):
    path = spoil(arm_logs, tmp_path, lambda lines: degrees(lines))
    words = ["identify", ARM, str(path), "--out", str(tmp_path / "out"), "--json"]
    words += ["--estimator", "wls", *PLAIN]
    assert main([*words, "--angle-unit", "deg"]) == 0
    base = json.loads(capsys.readouterr().out)["base_parameters"]
    assert main(["identify", ARM, str(arm_logs / "fit.csv"), *words[3:]]) == 0
    expected = json.loads(capsys.readouterr().out)["base_parameters"]
    values = ([p["value"] for p in base], [p["value"] for p in expected])
    np.testing.assert_allclose(*values, rtol=0, atol=1e-6)


WRONG_USE = {
    "unknown estimator": (["--estimator", "magic"], 2, "estimator is 'magic'"),
    "bad gain": (["--gain", "elbow"], 2, "wanted JOINT=NUMBER"),
    "bad cutoff": (["--cutoff", "no"], 2, "wanted a number or false"),
    "unknown joint": (["--joints", "elbow"], 1, "joint 'elbow' is not in planar_2r.urdf"),
    "cutoff beyond half the rate": (["--cutoff", "80"], 2, "not below half the rate"),
    "unknown unit": (["--time-unit", "min"], 2, "time is 'min', wanted one of"),
}


@pytest.mark.parametrize(("flags", "code", "message"), WRONG_USE.values(), ids=WRONG_USE)
def test_wrong_use_has_its_exit_code_and_message(arm_logs, tmp_path, capsys, flags, code, message):
    words = ["identify", ARM, str(arm_logs / "fit.csv"), "--out", str(tmp_path / "out"), *flags]
    assert main(words) == code
    assert message in capsys.readouterr().err


def test_a_job_file_states_its_logs_itself(arm_logs, tmp_path, capsys):
    job = tmp_path / "job.toml"
    job.write_text(
        f'urdf = "{ARM}"\n[[identification]]\nlog = "{arm_logs / "fit.csv"}"\n'
        f'[[validation]]\nlog = "{arm_logs / "keep.csv"}"\n[output]\nreport = false\n'
    )
    assert main(["identify", str(job), "--out", str(tmp_path / "out")]) == 0
    assert "verdict: good" in capsys.readouterr().out
    assert main(["identify", str(job), "a.csv", "--cutoff", "5", "--lock", "a=0"]) == 2
    assert capsys.readouterr().err.endswith(
        "is a job file; it states the logs and settings. Remove a.csv, --lock, --cutoff, and state "
        "in the job file: log in [[identification]], locked at the top, cutoff in [signals]\n"
    )


def test_rounded_angles_are_named_and_snapped_where_asked(tmp_path, rng, capsys):
    source = tmp_path / "arm.urdf"
    text = example_urdf("xarm7.urdf").read_text().replace("1.5708", "1.57")
    source.write_text(re.sub(r"(?s)<(visual|collision)>.*?</\1>", "", text))
    model = RobotModel.from_urdf(source, snap_angles=True)
    pi = truth(model)
    write_log(exact_log(model, pi, rng, samples=400), tmp_path / "log.csv")
    words = [
        "identify",
        str(source),
        str(tmp_path / "log.csv"),
        "--estimator",
        "wls",
        "--json",
        *PLAIN,
    ]
    # the directions that rounding adds carry WLS away, to links that weigh less than nothing
    assert main([*words, "--out", str(tmp_path / "plain")]) == 1
    plain = json.loads(capsys.readouterr().out)
    assert "total_mass" in {f["code"] for f in plain["warnings"]}
    (finding,) = [f for f in plain["warnings"] if f["code"] == "rounded_rpy"]
    assert "--snap-angles" in finding["message"]
    assert main([*words, "--out", str(tmp_path / "snapped"), "--snap-angles"]) == 0
    snapped = json.loads(capsys.readouterr().out)
    assert "rounded_rpy" not in {f["code"] for f in snapped["warnings"]}
    assert snapped["settings"]["snap_angles"] is True
    assert snapped["structure"]["base"] == len(structural_mapping(model).K)
    assert plain["structure"]["base"] > snapped["structure"]["base"]


def test_no_log_is_wrong_usage(capsys):
    assert main(["identify", URDF]) == 2
    assert "no log is given" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["identfy"])


def test_inspect_prints_what_a_urdf_holds(capsys):
    assert main(["inspect", URDF, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["robot"] == "ur5"
    assert content["structure"]["base_inertial"] == 36
    assert len(content["base_groups"]) == 36
    assert main(["inspect", URDF]) == 0
    assert "36 base" in capsys.readouterr().out
    assert main(["inspect", str(example_urdf("solo12.urdf")), "--free-flyer", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["structure"]["base_inertial"] == 94


def test_inspect_of_an_unusable_urdf_says_why(capsys, tmp_path):
    assert main(["inspect", str(example_urdf("ur3.urdf")), "--json"]) == 1
    printed = capsys.readouterr()
    assert json.loads(printed.out)["structure"] is None
    assert "does not give a valid model; see the findings" in printed.err


def test_demo_runs_from_nothing_and_finds_the_truth(tmp_path, capsys, monkeypatch):
    out, stages = tmp_path / "demo", []
    monkeypatch.setattr("robotid.cli.demo._PERIOD", 7.0)
    leave_out_meshes(monkeypatch)
    shown = nullcontext(lambda *stage: stages.append(stage))
    monkeypatch.setattr("robotid.cli.demo.terminal_progress", lambda: shown)
    assert main(["demo", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert stages, "the stages of the identification are shown"
    assert "verdict: good" in printed
    assert "of 58 base parameters lie within 3 standard errors of the truth" in printed
    count = int(printed.split(" of 58 base")[0].split()[-1])
    assert count >= 55  # 58 intervals of 99.7 % and a little model error of the friction's edge
    assert (out / "replay.html").stat().st_size > 100_000
    links = re.findall(r'<a href="([^"#]+)"', (out / "report.html").read_text(encoding="utf-8"))
    assert len(set(links)) == 4
    assert {name for name in links if (out / name).is_file()} == set(links)
    assert str(out / "report.html") in printed


def test_a_term_that_the_demo_finds_and_did_not_simulate_is_truly_0(tmp_path, monkeypatch):
    """As the friction of a drive that seems to grow with its load."""
    monkeypatch.setattr("robotid.cli.demo._PERIOD", 0.25)
    whole = RobotModel.from_urdf(example_urdf("z1.urdf"), locked={"jointGripper": 0.0})
    bases = []
    for model in (whole, whole.with_terms({"joint2": (LoadFriction(),)})):
        found = SimpleNamespace(model=model, mapping=structural_mapping(model))
        monkeypatch.setattr("robotid.cli.demo.run_job", lambda *_, found=found, **__: (found, {}))
        *_, true = run_demo(tmp_path / "demo")
        bases.append(dict(zip(found.mapping.base_names, true, strict=True)))
    plain, more = bases
    assert more == pytest.approx(plain | {"joint2.load": 0.0})


def test_nothing_stays_behind_when_a_run_fails_late(arm_logs, tmp_path, monkeypatch):
    import robotid.cli.identify

    def broken(*_args, **_options):
        raise OSError("disk full")

    monkeypatch.setattr(robotid.cli.identify, "write_json", broken)
    out = tmp_path / "out"
    words = [
        "identify",
        ARM,
        str(arm_logs / "fit.csv"),
        "--out",
        str(out),
        "--estimator",
        "wls",
        *PLAIN,
    ]
    assert main(words) == 1
    assert list(out.iterdir()) == []


def test_a_result_can_be_validated_from_any_folder(arm_logs, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(arm_logs)
    out = tmp_path / "out"
    words = ["identify", ARM, "fit.csv", "--out", str(out), "--estimator", "wls", *PLAIN]
    assert main(words) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["validate", "out/result.json", str(arm_logs / "keep.csv")]) == 0
    assert "predicted with" in capsys.readouterr().out


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries have no mallopt")
def test_the_pages_of_freed_arrays_are_kept_for_the_next_ones():
    code = """
import resource
import numpy as np
from robotid.cli import main

def made_anew():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        arrays = [np.ones(10**6) for _ in range(3)]  # 8 MB each
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

main(["schema"])
made_anew()
print(made_anew())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) < 1000  # pages: 60,000 are in all of them


@pytest.mark.parametrize("stated", ["", "3"])
def test_blas_has_one_thread_unless_the_environment_states_another_number(stated):
    code = (
        "import os, sys; from robotid.cli import main\n"
        "try: main(['--version'])\n"
        "except SystemExit: pass\n"
        "print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    )
    own = {k: x for k, x in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    own |= {"OPENBLAS_NUM_THREADS": stated} if stated else {}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=own)
    assert done.stdout.splitlines()[-1] == f"False {stated or '1'}"
