"""A written result is loaded as what it was."""

import shutil

import numpy as np
import pinocchio as pin
import pytest

import robotid
from robotid.base.exceptions import DataError


@pytest.fixture(scope="module")
def written(identified, tmp_path_factory):
    """The folder of a result, and the identification that wrote it."""
    folder = tmp_path_factory.mktemp("result") / "out"
    robotid.save_result(identified, folder)
    return folder, identified


def test_a_result_has_the_robot_its_parameters_verdict_and_metrics(written):
    folder, found = written
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


def test_it_predicts_inverse_dynamics_and_friction_at_instants(written):
    folder, found = written
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


def test_a_result_without_a_urdf_says_why_there_is_no_robot(written, tmp_path):
    path = shutil.copy(written[0] / "result.json", tmp_path)
    result = robotid.load_result(path)
    del result.content["outputs"]["urdf"]
    assert result.verdict["status"]
    with pytest.raises(DataError, match=r"result.json has no URDF, because its parameters are"):
        _ = result.robot
