"""What Python asks of a result: torques, friction curves, Pinocchio's model; found or loaded."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from helpers.driven import ELBOW, LIFT, arm, driven, driven_log, found_in

from robotid.cli.export import export
from robotid.cli.identify import save_result
from robotid.dynamics.friction_projection import project_friction
from robotid.dynamics.torque import drive_motion_along
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.fitted import friction_curve
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.output.files.result_file import load_result
from robotid.robot.drives import LoadFriction


@pytest.fixture(scope="module")
def found():
    """An arm whose elbow has friction that grows with its load, from 30 s of exact motion."""
    model, pi = driven(arm(), {ELBOW: (LoadFriction(),)}, {f"{ELBOW}.load": 0.07})
    log = driven_log(model, pi, 3, reach=1.5, noise=0.01)
    friction = {"*": "", ELBOW: "load"}
    return found_in(arm(), [log], friction=friction, estimator=EstimatorSettings())


@pytest.fixture(scope="module")
def loaded(found, tmp_path_factory):
    return load_result(save_result(found, tmp_path_factory.mktemp("saved"), report=False))


def moving_rows(found):
    """Return motion and prediction of the fitted rows in which every joint moves."""
    (evaluation,) = found.fitted
    rows = np.flatnonzero(evaluation.recording.mask.all(axis=1))
    return evaluation.recording.trajectory.at(rows), evaluation.torques["estimate"][rows]


def test_torques_are_those_of_the_evaluation_with_the_chosen_friction(found, loaded):
    assert f"{ELBOW}.load" in found.model.layout.names
    motion, predicted = moving_rows(found)
    assert len(predicted) > 1000
    for result, tolerance in ((found, 1e-10), (loaded, 1e-6)):
        torque = result.predict(motion.q, motion.v, motion.a)
        np.testing.assert_allclose(torque, predicted, rtol=0, atol=tolerance)
        one = result.predict(motion.q[7], motion.v[7], motion.a[7])
        np.testing.assert_allclose(one, torque[7], rtol=0, atol=1e-12)


def test_a_friction_curve_is_that_of_the_speeds_fitted_under_the_usual_load(found, loaded):
    (evaluation,) = found.fitted
    j = found.model.joints.index(ELBOW)
    used = evaluation.recording.mask[:, j]
    speeds = np.abs(evaluation.recording.trajectory.v[used, j])
    carried = drive_motion_along(found.model, evaluation.recording.trajectory).load[j, used]
    curve = found.friction(ELBOW)
    assert (curve.v[-1], curve.v[20]) == (speeds.max(), speeds.min())
    assert curve.load == pytest.approx(np.sqrt(np.mean(carried**2)))
    value = dict(zip(found.model.layout.names, found.standard, strict=True))
    Fv, Fc, off, mu = (value[f"{ELBOW}.{x}"] for x in ("viscous", "coulomb", "offset", "load"))
    torque = Fv * curve.v + (Fc + mu * curve.load) * np.sign(curve.v) + off
    np.testing.assert_allclose(curve.torque, torque, rtol=1e-9)
    np.testing.assert_allclose(curve.half_width, QUANTILE * curve.std)
    asked = found.friction(ELBOW, [0.5, 1.0], load=2.0)
    own = friction_curve(found, ELBOW, np.array([0.5, 1.0]), load=2.0)
    np.testing.assert_array_equal(asked.torque, own.torque)
    again = loaded.friction(ELBOW)
    for name in ("v", "torque", "std", "load"):
        np.testing.assert_array_equal(getattr(again, name), getattr(curve, name))


def test_pinocchios_model_has_the_nearest_friction_and_says_so(found, loaded):
    motion, predicted = moving_rows(found)
    place = list(found.model.layout.names).index(f"{ELBOW}.load")
    plain = found.standard.copy()
    plain[place] = 0.0
    for result in (found, loaded):
        with pytest.warns(
            UserWarning, match=rf"{ELBOW}: load projected on viscous .* error"
        ) as caught:
            made = result.pinocchio_model()
        assert caught[0].filename == __file__
        data = made.createData()
        k = np.arange(0, len(predicted), 50)
        torque = np.array(
            [
                pin.rnea(made, data, *x)
                for x in zip(motion.q[k], motion.v[k], motion.a[k], strict=True)
            ]
        )
        dry = np.where(motion.v[k] > 0, made.lowerDryFrictionLimit, made.upperDryFrictionLimit)
        torque += made.damping * motion.v[k] - dry
        left = predicted[k] - torque
        joints = list(found.model.joints)
        others = [joints.index(LIFT), joints.index("wrist_1_joint")]
        np.testing.assert_allclose(left[:, others], 0.0, atol=1e-6)
        loads = drive_motion_along(found.model, motion).load[joints.index(ELBOW), k]
        sign = np.sign(motion.v[k, joints.index(ELBOW)])
        wanted = found.standard[place] * sign * np.abs(loads)
        (drive,) = project_friction(
            found.model, found.standard, loaded.drive_moments, ("viscous", "coulomb", "offset")
        ).drives
        names, speed = list(found.model.layout.names), motion.v[k, joints.index(ELBOW)]
        for term, column in (("viscous", speed), ("coulomb", sign), ("offset", 1.0)):
            before = found.standard[names.index(f"{ELBOW}.{term}")]
            wanted = wanted - (drive.values[term] - before) * column
        np.testing.assert_allclose(left[:, joints.index(ELBOW)], wanted, atol=1e-6)
        assert drive.values["coulomb"] > 1.2 * found.standard[names.index(f"{ELBOW}.coulomb")]
        assert np.sqrt(np.mean(wanted**2)) == pytest.approx(drive.error, rel=0.2)


def test_mujocos_inverse_dynamics_of_an_export_are_as_near_as_its_friction_can_be(
    found, loaded, tmp_path
):
    """Over the fitted rows: the prediction less the best viscous, Coulomb friction and offset."""
    done = export(loaded.path, "mjcf", tmp_path / "a.xml")
    stated = done["projected"][ELBOW]
    assert stated["replaced"] == ["load"]
    assert "load projected on viscous" in " ".join((tmp_path / "a.xml").read_text().split())
    robot = mujoco.MjModel.from_xml_path(str(tmp_path / "a.xml"))
    robot.opt.disableflags = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, j = mujoco.MjData(robot), found.model.joints.index(ELBOW)
    motion, predicted = moving_rows(found)
    torque = np.empty_like(predicted)
    for k in range(len(predicted)):
        data.qpos, data.qvel, data.qacc = motion.q[k], motion.v[k], motion.a[k]
        mujoco.mj_inverse(robot, data)
        data.ctrl = 0.0
        mujoco.mj_fwdActuation(robot, data)
        torque[k] = data.qfrc_inverse - data.qfrc_actuator
    left = predicted - torque
    others = [i for i in range(left.shape[1]) if i != j]
    np.testing.assert_allclose(left[:, others], 0.0, atol=1e-6)
    v = motion.v[:, j]
    A = np.column_stack([v, np.sign(v), np.ones_like(v)])
    best = left[:, j] - A @ np.linalg.lstsq(A, left[:, j], rcond=None)[0]
    assert np.linalg.norm(left[:, j]) <= 1.02 * np.linalg.norm(best)
    assert stated["error"] == pytest.approx(np.sqrt(np.mean(left[:, j] ** 2)), rel=0.1)
