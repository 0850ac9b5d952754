import re
from dataclasses import replace

import numpy as np
import pytest

from robotid.design.basis import FourierBasis
from robotid.design.design import Designer, Multipliers
from robotid.design.information import Aim
from robotid.design.limits import MotionLimits
from robotid.design.payload_motion import design_payload
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.bodies import link_transfer
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

WRIST = ("wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
LOAD = Payload(link="tool0", mass=3.0, com=(0.0, 0.0, 0.1))
RNG = np.random.default_rng


def designer_of(file, **options):
    model = RobotModel.from_urdf(example_urdf(file), **options)
    return Designer.of_model(model, FourierBasis(5.0, 3), MotionLimits.of_model(model))


@pytest.fixture(scope="module")
def designer():
    return designer_of("ur10_robot.urdf")


@pytest.fixture(scope="module")
def found(designer):
    return design_payload(designer, RNG(0), LOAD, starts=1, seconds=2.0)


def test_the_information_about_some_unknowns_is_that_with_the_others_unknown(rng):
    A, T = rng.standard_normal((9, 5)), rng.standard_normal((5, 7))
    own, L = Aim(T, 3).information(A.T @ A)
    covariance = np.linalg.inv(T.T @ A.T @ A @ T + np.eye(7))
    np.testing.assert_allclose(own, np.linalg.inv(covariance[4:, 4:]))
    change = 1e-6 * (B := rng.standard_normal((5, 5))) + 1e-6 * B.T
    up, down = (Aim(T, 3).information(A.T @ A + s * change)[0] for s in (1, -1))
    np.testing.assert_allclose(L.T @ change @ L, (up - down) / 2, atol=1e-12)


@pytest.mark.parametrize("name", ["D", "A", "E"])
def test_the_gradient_of_a_motion_for_a_payload_is_that_of_differences(designer, rng, name):
    moving = np.isin(designer.information.model.joints, WRIST)
    aim = Aim(rng.standard_normal((len(designer.spread), 14)), 10)
    limited = replace(designer, aim=aim, moving=moving, name=name)
    C = limited.random(rng)
    np.testing.assert_array_equal(C[1:, ~moving], 0.0)
    D = rng.standard_normal(C.shape)
    D[1:, ~moving] = 0.0
    h, multipliers = 1e-6, Multipliers(0.2)
    up, down = (limited._lagrangian(C + s * h * D, multipliers)[0] for s in (1, -1))
    gradient = limited._lagrangian(C, multipliers)[1]
    np.testing.assert_array_equal(gradient[1:, ~moving], 0.0)
    slope = np.sum(gradient * D)
    assert slope == pytest.approx((up - down) / (2 * h), rel=1e-4)


def test_the_fewest_joints_before_the_link_move_and_the_others_rest(designer, found):
    assert found.moving == WRIST
    q = found.design.motion.evaluate(np.linspace(0.0, 5.0, 101))[0]
    assert np.ptp(q[:, :3], axis=0).max() == 0.0
    assert (np.ptp(q[:, 3:], axis=0) > 0.5).all()
    assert found.determination.rank == 10
    # an axis shows nothing of mass on it; two that meet turn about one point
    fewer = dict.fromkeys(found.fewer)
    assert list(fewer) == [WRIST[-1:], WRIST[-2:]]
    assert found.fewer[WRIST[-2:]].described() == "tool0.m is not identifiable"
    assert "With wrist_2_joint, wrist_3_joint alone: tool0.m is not" in " ".join(found.described())
    still = designer.information.model.joints[:3]
    assert found.described()[0] == (
        f"For a payload on tool0, {', '.join(WRIST)} move; {', '.join(still)} rest. Record the "
        "motion twice: with the payload and without it."
    )
    resting = found.to_dict()["resting"]
    assert resting == pytest.approx(dict(zip(still, q[0, :3].tolist(), strict=True)))


def test_the_limits_are_kept_with_the_payload_and_without_it(designer, found):
    q, v, a = found.design.motion.evaluate(np.linspace(0.0, 5.0, 2001))
    model, mapping = designer.information.model, designer.information.mapping
    W = joint_torque_regressor(model, q, v, a, np.tanh(v / 0.01))[:, mapping.independent]
    body, transfer = link_transfer(model, "tool0")
    x = np.array([3.0, 0.0, 0.0, 0.3, 0.03, 0.0, 0.03, 0.0, 0.0, 0.0])  # a point at 0.1 m
    beta = designer.information.beta
    loaded = beta + mapping.K[:, 10 * body : 10 * body + 10] @ transfer @ x
    torque = [(W @ b).reshape(q.shape) for b in (beta, loaded)]
    assert np.abs(torque / designer.limits.sizes[4]).max() <= 1.001
    used = np.abs(torque[1] / designer.limits.sizes[4]).max(axis=0)
    np.testing.assert_allclose(found.design.used[4], used, atol=2e-3)


def test_standard_errors_are_those_of_both_runs_fitted_at_once(designer, found):
    rate = 200.0
    q, v, a = found.design.motion.evaluate(np.arange(1001) / rate)
    model, mapping = designer.information.model, designer.information.mapping
    W = joint_torque_regressor(model, q, v, a, np.tanh(v / 0.01))[:, mapping.independent]
    W = W.reshape(1001, 6, -1)[:, 3:].reshape(3003, -1)  # the wrist alone moves
    W /= np.tile(np.sqrt(rate * designer.noise[3:]), 1001)[:, None]
    body, transfer = link_transfer(model, "tool0")
    own = W @ mapping.K[:, 10 * body : 10 * body + 10] @ transfer
    changing = ("viscous", "coulomb", "offset")  # not the motors' inertia
    drives = W @ mapping.K[:, [name.endswith(changing) for name in mapping.names]]
    none = np.zeros_like
    both = np.block([[W, none(drives), none(own)], [W, drives, own]])
    size = np.maximum(np.linalg.norm(both, axis=0), 1e-12)
    information = (both / size).T @ (both / size) + 1e-10 * np.eye(len(size))
    error = np.sqrt(np.diag(np.linalg.inv(information))[-10:]) / size[-10:]
    np.testing.assert_allclose(found.std_error, error, rtol=0.05)
    mass, centre, inertia = error[0], error[1:4].max(), error[4:].max()
    [said] = [x for x in found.described() if x.startswith("Expected standard errors")]
    numbers = [float(x) for x in re.findall(r" ([\d.e-]+) kg", said)]
    np.testing.assert_allclose(numbers, [mass, centre, inertia], rtol=0.12)  # of two digits
