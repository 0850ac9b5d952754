"""Derivatives of the torque of bodies beside differences of Pinocchio's inverse dynamics."""

import numpy as np
import pinocchio as pin
import pytest
from helpers.synthetic import truth

from robotid.dynamics.torque_slopes import position_slopes, torque_slopes
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

ROBOTS = {
    "in another order": (
        "ur5_robot.urdf",
        {"joints": ["wrist_1_joint", "shoulder_lift_joint", "elbow_joint"],
         "locked": {"wrist_2_joint": 0.7}, "gravity": (1.0, -2.0, -9.0)},
    ),
    "fingers that slide together": (
        "panda.urdf",
        {"joints": ["panda_finger_joint1", "panda_joint6", "panda_joint4"], "mimic": "coupled"},
    ),
    "two legs": (
        "solo12.urdf",
        {"joints": ["HR_HFE", "FL_HAA", "FL_KFE"], "locked": {"FL_HFE": 0.4, "HR_HAA": -0.3}},
    ),
}  # fmt: skip
H = 1e-6


@pytest.fixture(params=ROBOTS)
def case(request):
    file, options = ROBOTS[request.param]
    model = RobotModel.from_urdf(example_urdf(file), **options)
    q, v, a = np.random.default_rng(3).uniform(-1.2, 1.2, (3, 4, len(model.joints)))
    return model, truth(model), q, v, a


def torque(model, pi, q, v, a, change=lambda engine: None):
    """Return the torques in the rows of the joints, of a robot that is changed first."""
    engine, G = model.with_parameters(pi).pin_model.copy(), model.velocity_map
    change(engine)
    data = engine.createData()
    rows = zip(model.configurations(q), v @ G.T, a @ G.T, strict=True)
    return np.array([G.T @ pin.rnea(engine, data, *row) for row in rows])


def test_slopes_are_those_of_differences_by_motion_and_gravity(case):
    model, pi, q, v, a = case
    found = torque_slopes(model, pi, q, v, a)
    n = len(model.joints)
    np.testing.assert_allclose(position_slopes(model, pi, q, v, a), found.by_q, atol=1e-10)
    assert [x.shape for x in found.arrays] == [(4, n, n)] * 3 + [(4, n, 3), (4, n, n, 3)]

    def close(slope, up, down):
        exact = (up - down) / (2 * H)
        np.testing.assert_allclose(slope, exact, atol=1e-6 * max(1.0, np.abs(exact).max()))

    for kind, slopes in enumerate((found.by_q, found.by_v, found.by_a)):
        for j in range(n):
            ends = []
            for side in (H, -H):
                x = [q.copy(), v.copy(), a.copy()]
                x[kind][:, j] += side
                ends.append(torque(model, pi, *x))
            close(slopes[:, :, j], *ends)
    for axis in np.eye(3):

        def pulled(side, axis=axis):
            def change(engine):
                engine.gravity.linear = engine.gravity.linear + side * axis

            return torque(model, pi, q, v, a, change)

        close(found.by_gravity @ axis, pulled(H), pulled(-H))


def test_slopes_by_the_origin_of_each_joint_are_those_of_differences(case):
    model, pi, q, v, a = case
    found = torque_slopes(model, pi, q, v, a).by_origin
    for j, joint in enumerate(model.joints):
        for k in range(3):

            def moved(side, joint=joint, k=k):
                def change(engine):
                    i = engine.getJointId(joint)
                    place = engine.jointPlacements[i].copy()
                    shift = np.zeros(3)
                    shift[k] = side
                    place.translation = place.translation + shift
                    engine.jointPlacements[i] = place

                return torque(model, pi, q, v, a, change)

            exact = (moved(H) - moved(-H)) / (2 * H)
            np.testing.assert_allclose(found[:, :, j, k], exact, atol=1e-6)
    assert np.abs(found).max() > 0.1


def test_the_difference_of_two_is_that_of_each(case):
    model, pi, q, v, a = case
    one, other = torque_slopes(model, pi, q, v, a), torque_slopes(model, 2 * pi, q, v, a)
    for x, y in zip((other - one).arrays, one.arrays, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-9)
