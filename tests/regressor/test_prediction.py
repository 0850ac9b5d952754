"""Predicted torques against the regressor times the parameters."""

import numpy as np
import pytest
from helpers.robots import ROBOTS, motion

from robotid.exceptions import DataError
from robotid.regressor import prediction
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.columns import friction_speeds
from robotid.regressor.compiled import is_installed
from robotid.regressor.prediction import predict
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def vectors(model, rng):
    """Return a possible robot with drives, a heavier one, and base parameters alone."""
    drives = len(model.layout.drive_names)
    possible = model.standard_parameters()
    possible[model.layout.n_inertial :] = rng.uniform(0.1, 1.0, drives)
    mapping = structural_mapping(model)
    base_only = np.zeros(len(possible))
    base_only[mapping.independent] = rng.standard_normal(len(mapping.independent))
    return possible, 1.3 * possible, base_only


def assert_is_regressor_times(model, parameters, trajectory, **options):
    W = joint_torque_regressor(
        model, trajectory.q, trajectory.v, trajectory.a, trajectory.direction
    )
    for torque, pi in zip(
        predict(model, parameters, trajectory, **options), parameters, strict=True
    ):
        expected = (W @ pi).reshape(torque.shape)
        np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("case", ROBOTS)
def test_predicted_torque_is_the_regressor_times_the_parameters(case, rng):
    path, options = ROBOTS[case]
    model = RobotModel.from_urdf(example_urdf(path), **options)
    direction = rng.uniform(-1.2, 1.2, (70, len(friction_speeds(model.layout))))
    trajectory = motion(model, rng, 70, direction=direction)
    possible, heavier, base_only = vectors(model, rng)
    assert_is_regressor_times(model, [possible], trajectory, compiled=False)  # inverse dynamics
    assert_is_regressor_times(model, [possible, heavier, base_only], trajectory, compiled=False)
    if is_installed():
        assert_is_regressor_times(model, [possible, base_only], trajectory, compiled=True)


def test_inverse_dynamics_takes_few_possible_robots_and_rows_the_rest(panda, rng, monkeypatch):
    calls = []
    real = prediction._inverse_dynamics
    monkeypatch.setattr(
        prediction, "_inverse_dynamics", lambda *args: calls.append(args) or real(*args)
    )
    trajectory = motion(panda, rng, 5)
    possible, heavier, base_only = vectors(panda, rng)
    predict(panda, [possible, heavier, possible], trajectory)
    assert len(calls) == 3
    predict(panda, [possible] * 4, trajectory)
    predict(panda, [possible, base_only], trajectory)
    assert len(calls) == 3


@pytest.mark.parametrize("mass", [0.0, -0.5, 1e-9])
def test_bodies_that_are_none_keep_their_digits(mass, ur5, rng):
    trajectory = motion(ur5, rng, 20)
    pi = ur5.standard_parameters()
    pi[10:20] = [mass, 0.3, -0.2, 0.5, 0.1, 0.0, 0.2, 0.0, 0.0, 0.1]
    assert_is_regressor_times(ur5, [pi], trajectory, compiled=False)
    pi[11:14] = 0.0
    assert_is_regressor_times(ur5, [pi], trajectory, compiled=False)


def test_other_joints_are_refused(ur5, panda, rng):
    with pytest.raises(DataError, match="the trajectory has the joints"):
        predict(ur5, [ur5.standard_parameters()], motion(panda, rng, 5))
