"""Parts of result.json that stored ones do not show, and results that are read back."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

import robotid
from robotid.base.exceptions import DataError, ModelError
from robotid.base.findings import Finding
from robotid.output.files.entries import _covariance, build_result, loop_entries
from robotid.output.files.result_file import read_result, stated_parameters

FINDINGS = [Finding("late", "warning", "a.csv", "late by 4 ms"), Finding("b", "note", "c", "d")]


@pytest.fixture(scope="module")
def result(identified):
    settings = {"estimator": {"name": "consistent"}}
    found = replace(identified, findings=FINDINGS)
    return build_result(found, settings, {"report": "report.html"})


def test_drives_behind_gears_have_their_inertia_at_the_motor(identified):
    gears = {"joints": list(identified.model.joints[:2]), "matrix": [-100.0, 50.0]}
    motors = build_result(identified, {"transmission": [gears]})["motors"]
    armature = dict(zip(identified.model.layout.names, identified.standard, strict=True))
    wanted = {
        joint: {"gear": ratio, "inertia": pytest.approx(armature[f"{joint}.armature"] / ratio**2)}
        for joint, ratio in zip(gears["joints"], gears["matrix"], strict=True)
    }
    assert motors == wanted
    each = [{"joints": [j], "matrix": [g["gear"]]} for j, g in wanted.items()]
    assert build_result(identified, {"transmission": each})["motors"] == wanted, "in two tables"


def test_inputs_tell_the_hashes_of_their_files(result, identified):
    paths = [identified.model.tree.path]
    paths += [e.log.path for e in (*identified.fitted, *identified.validation)]
    wanted = [(str(x), hashlib.sha256(Path(x).read_bytes()).hexdigest()) for x in paths]
    assert [(entry["path"], entry["sha256"]) for entry in result["inputs"]] == wanted


def test_results_that_are_not_whole_are_refused(result, identified, tmp_path):
    path = tmp_path / "result.json"
    with pytest.raises(DataError, match=r"^there is no result '.*result\.json'$"):
        read_result(path)
    path.write_text("no")
    with pytest.raises(DataError, match=r"^result\.json is not JSON: "):
        read_result(path)

    def with_base(value):
        return {**result, "structure": {**result["structure"], "base": value}}

    *others, last = result["inputs"]
    assert len(others) == 3
    large = r"\.structure\.base is -1.*, expected a number of at most 1e\+100$"
    text, endless = {**last, "rows_used": "x"}, {k: v for k, v in last.items() if k != "end"}
    for changed, words in (
        ({**result, "schema_version": 2}, r" has schema_version 2, expected 1 of a"),
        ({k: v for k, v in result.items() if k != "inputs"},
         r" has no entry 'inputs': the file is incomplete"),
        ({**result, "verdict": []}, r"\.verdict is \[\], expected a table"),
        ({**result, "verdict": 5}, r"\.verdict is 5, expected a table"),
        (with_base(-1.01e100), large), (with_base(-(10**101)), large),
        ({**result, "inputs": [*others, text]},
         r"\.inputs\[3\]\.rows_used is 'x', expected a number"),
        ({**result, "inputs": [*others, endless]}, r"\.inputs\[3\] has no entry 'end': the"),
    ):  # fmt: skip
        path.write_text(json.dumps(changed))
        with pytest.raises(DataError, match=rf"^result\.json{words}"):
            read_result(path)
    path.write_text(json.dumps(with_base(-1e100)))
    assert read_result(path)["structure"]["base"] == -1e100
    short = {**result, "drive_parameters": result["drive_parameters"][1:]}
    with pytest.raises(ModelError, match=r"^the result has no value of shoulder_pan_joint\.arm"):
        stated_parameters(short, identified.model)


@pytest.fixture(scope="module")
def loaded_from(identified, tmp_path_factory):
    """The folder of a result, and the identification that wrote it."""
    folder = tmp_path_factory.mktemp("result") / "out"
    robotid.save_result(identified, folder)
    return folder, identified


def test_a_result_has_the_robot_its_parameters_verdict_and_metrics(loaded_from):
    folder, found = loaded_from
    for path in (folder, folder / "result.json"):
        result = robotid.load_result(path)
        assert result.robot.joints == found.model.joints
        np.testing.assert_allclose(result.parameters, found.standard, rtol=1e-9, atol=1e-12)
        assert result.verdict == found.verdict.to_dict()
    fitted, kept = result.metrics.values()
    for joint, measured in found.metrics().per_joint.items():
        assert fitted[joint]["rmse"] == pytest.approx(measured.rmse, rel=1e-12)
    for joint, measured in found.validation[0].metrics["estimate"].per_joint.items():
        assert kept[joint]["relative_error_pct"] == pytest.approx(measured.relative_error_pct)
    assert list(result.metrics)[1].endswith("kept.csv")
    assert repr(result) == (
        f"<Result of {found.model.name}: {len(found.base)} base parameters by consistent, verdict "
        f"{found.verdict.status}>"
    )


def test_it_predicts_inverse_dynamics_and_friction_at_instants(loaded_from):
    folder, found = loaded_from
    result, n = robotid.load_result(folder), len(found.model.joints)
    q, v, a = np.random.default_rng(1).uniform(-2, 2, (3, 5, n))
    robot = found.model.with_parameters(found.standard).pin_model
    data = robot.createData()
    values = dict(zip(found.model.layout.names, found.standard, strict=True))
    Ia, Fv, Fc, offset = (
        np.array([values[f"{joint}.{term}"] for joint in found.model.joints])
        for term in ("armature", "viscous", "coulomb", "offset")
    )

    def torque(q, v, a):
        rigid = np.array([pin.rnea(robot, data, *state) for state in zip(q, v, a, strict=True)])
        return rigid + Ia * a + Fv * v + Fc * np.sign(v) + offset

    wanted = torque(q, v, a)
    np.testing.assert_allclose(result.predict(q, v, a), wanted, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(result.predict(q[1], v[1], a[1]), wanted[1], rtol=1e-8, atol=1e-9)
    still = np.zeros_like(v)
    np.testing.assert_allclose(result.predict(q, v), torque(q, v, still), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(result.predict(q), torque(q, still, still), rtol=1e-8, atol=1e-9)


def test_a_result_without_a_urdf_says_why_there_is_no_robot(loaded_from, tmp_path):
    path = shutil.copy(loaded_from[0] / "result.json", tmp_path)
    result = robotid.load_result(path)
    del result.content["outputs"]["urdf"]
    assert result.verdict["status"]
    with pytest.raises(DataError, match=r"result.json has no URDF, because its parameters are"):
        _ = result.robot


def test_bodies_that_no_log_determines_are_named_as_undetermined(crane):
    undetermined = loop_entries(crane)["ranges"]["undetermined"]  # boom.Izz is fitted
    assert undetermined == ["boom.mcx", "boom.mcy", *crane.undetermined]


def test_the_covariance_is_that_of_the_free_parameters_that_are_not_at_a_bound(rng):
    """Free: a gain, the delay of both joints, an armature and a zero, which is at its bound."""
    slopes, A = rng.standard_normal((3, 4)), rng.standard_normal((4, 4))
    free = [("kp", (0,)), ("delay", (0, 1)), ("armature", (1,)), ("zero", (1,))]
    names = ["a.kp", "delay", "b.armature", "b.zero"]
    estimate = SimpleNamespace(
        theta=np.zeros(4), covariance=A @ A.T, details={"at_bound": ("b.zero",)}
    )
    simulator = SimpleNamespace(
        names=names, standard=lambda model, theta: (None, slopes),
        free_parameters=[SimpleNamespace(what=what, joints=joints) for what, joints in free],
    )  # fmt: skip
    model = SimpleNamespace(layout=SimpleNamespace(names=("x", "y", "z")), joints=("a", "b"))
    fit = SimpleNamespace(simulator=simulator)
    entry = _covariance(SimpleNamespace(fit=fit, estimate=estimate, model=model))
    assert entry["names"] == ["x", "y", "z", "a.kp", "a.delay", "b.delay", "b.zero"]
    S = np.vstack([slopes, np.eye(4)[[0, 1, 1, 3]]])[:, :3]
    L = np.array([[*row, *[0.0] * (7 - len(row))] for row in entry["root"]])
    np.testing.assert_allclose(L @ L.T, S @ (A @ A.T)[:3, :3] @ S.T, atol=1e-6)
