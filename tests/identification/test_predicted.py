"""What Python asks of a result: torques, friction curves, Pinocchio's model; found or loaded."""

import numpy as np
import pinocchio as pin
import pytest
from helpers.driven import ELBOW, LIFT, arm, driven, driven_log, found_in

from robotid.exceptions import DataError
from robotid.export.result import load_result
from robotid.identification.bands import REACH, friction_curve
from robotid.identification.settings import EstimatorSettings
from robotid.regressor.memory import drive_motion_along
from robotid.robot.drives import LoadFriction


@pytest.fixture(scope="module")
def found():
    """An arm whose elbow has friction that grows with its load, from 30 s of exact motion."""
    model, pi = driven(arm(), {ELBOW: (LoadFriction(),)}, {f"{ELBOW}.load": 0.07})
    log = driven_log(model, pi, 3, reach=1.5, noise=0.01)
    friction = {"*": "", ELBOW: "load"}
    return found_in(arm(), [log], friction=friction, estimator=EstimatorSettings(draws=0))


@pytest.fixture(scope="module")
def loaded(found, tmp_path_factory):
    return load_result(found.save(tmp_path_factory.mktemp("saved"), report=False))


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


def test_at_rest_gravity_and_offsets_are_left(found):
    names, pi = list(found.model.layout.names), found.standard
    q = np.array([0.3, -0.4, 0.5])
    robot = found.model.with_parameters(pi).pin_model
    gravity = pin.computeGeneralizedGravity(robot, robot.createData(), q)
    offsets = [pi[names.index(f"{joint}.offset")] for joint in found.model.joints]
    np.testing.assert_allclose(found.predict(q), gravity + offsets, atol=1e-12)


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
    np.testing.assert_allclose(curve.half_width, REACH * curve.std)
    asked = found.friction(ELBOW, [0.5, 1.0], load=2.0)
    own = friction_curve(found, ELBOW, np.array([0.5, 1.0]), load=2.0)
    np.testing.assert_array_equal(asked.torque, own.torque)
    again = loaded.friction(ELBOW)
    for name in ("v", "torque", "std", "load"):
        np.testing.assert_array_equal(getattr(again, name), getattr(curve, name))


def test_another_joint_is_refused_by_name(found, loaded):
    with pytest.raises(DataError, match=r"'elbow' is no drive of ur5.*; drives: shoulder_lift_joi"):
        found.friction("elbow")
    with pytest.raises(DataError, match="states no friction curve of 'elbow_joint '; joints with"):
        loaded.friction("elbow_joint ")


def test_pinocchios_model_lacks_what_it_says_and_nothing_else(found, loaded):
    motion, predicted = moving_rows(found)
    place = list(found.model.layout.names).index(f"{ELBOW}.load")
    plain = found.standard.copy()
    plain[place] = 0.0
    for result in (found, loaded):
        with pytest.warns(UserWarning, match=rf"no place for {ELBOW}\.load: torques") as caught:
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
        np.testing.assert_allclose(left[:, joints.index(ELBOW)], wanted, atol=1e-6)
        assert np.abs(wanted).max() > 0.5
