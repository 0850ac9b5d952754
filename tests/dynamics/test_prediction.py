"""Predicted torques against the regressor times the parameters, slopes against differences."""

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import ROBOTS, motion
from helpers.synthetic import truth

from robotid.base.exceptions import DataError
from robotid.data.log import Trajectory
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.rows import friction_speeds
from robotid.dynamics.torque import (
    body_slopes,
    body_slopes_by_position,
    force_slopes,
    joint_torque_regressor,
    predict,
    predict_instants,
)
from robotid.robot.drives import Lag, LoadFriction, Presliding, Stribeck
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
    m, torques = trajectory, predict(model, parameters, trajectory, **options)
    W = joint_torque_regressor(model, m.q, m.v, m.a, m.direction)
    for torque, pi in zip(torques, parameters, strict=True):
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
    assert_is_regressor_times(model, [possible, base_only], trajectory, compiled=True)


@pytest.mark.parametrize("mass", [0.0, -0.5, 1e-9])
def test_bodies_that_are_none_keep_their_digits(mass, ur5, rng):
    trajectory = motion(ur5, rng, 20)
    pi = ur5.standard_parameters()
    pi[10:20] = [mass, 0.3, -0.2, 0.5, 0.1, 0.0, 0.2, 0.0, 0.0, 0.1]
    assert_is_regressor_times(ur5, [pi], trajectory, compiled=False)
    pi[11:14] = 0.0
    assert_is_regressor_times(ur5, [pi], trajectory, compiled=False)


def test_an_instant_is_predicted_as_by_inverse_dynamics_and_the_formulas_of_friction(ur5, rng):
    terms = (LoadFriction(), Stribeck(speed=0.2), Presliding(), Lag())
    model = ur5.with_terms({"elbow_joint": terms})
    pi = model.standard_parameters()
    values = dict(zip(model.layout.drive_names, rng.uniform(0.1, 0.4, 30), strict=False))
    pi[model.layout.n_inertial :] = list(values.values())
    m, j = motion(ur5, rng, 40), ur5.joints.index("elbow_joint")
    rigid = predict(ur5, [ur5.standard_parameters()], m)[0]
    expected = rigid.copy()
    for k, joint in enumerate(ur5.joints):
        Ia, Fv, Fc, off = (
            values[f"{joint}.{term}"] for term in ("armature", "viscous", "coulomb", "offset")
        )
        expected[:, k] += Ia * m.a[:, k] + Fv * m.v[:, k] + Fc * np.sign(m.v[:, k]) + off
    mu, hook, slide = (values[f"elbow_joint.{x}"] for x in ("load", "stribeck", "presliding"))
    sign = np.sign(m.v[:, j])  # it has slid for long, and its torque does not change: no lag
    expected[:, j] += sign * (mu * np.abs(rigid[:, j]) + slide)
    expected[:, j] += hook * sign * np.exp(-np.abs(m.v[:, j]) / 0.2)
    torque = predict_instants(model, pi, m.q, m.v, m.a)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    one = predict_instants(model, pi, m.q[3].tolist(), m.v[3], m.a[3])
    assert one.shape == (6,)
    np.testing.assert_array_equal(one, predict_instants(model, pi, m.q[3:4], m.v[3:4], m.a[3:4])[0])
    at_rest = predict_instants(ur5, ur5.standard_parameters(), m.q)
    still = predict_instants(ur5, ur5.standard_parameters(), m.q, 0 * m.v, 0 * m.a)
    np.testing.assert_array_equal(at_rest, still)
    many = np.tile(m.q, (20, 1))  # more than are computed at once
    last = predict_instants(ur5, ur5.standard_parameters(), many)[-40:]
    np.testing.assert_array_equal(last, at_rest)


def test_a_static_robot_is_predicted_by_gravity_and_the_sign_of_friction(rng):
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), dynamics="static")
    pi, m = model.standard_parameters(), motion(model, rng, 10)
    pi[model.layout.n_inertial :] = 0.5
    fast = predict_instants(model, pi, m.q, m.v, m.a)
    slow = predict_instants(model, pi, m.q, 1e-3 * m.v)
    np.testing.assert_array_equal(fast, slow)
    rest = predict_instants(model, pi, m.q)
    np.testing.assert_allclose(fast - rest, 0.5 * np.sign(m.v), atol=1e-12)


def test_instants_of_another_shape_are_refused(ur5):
    pi = ur5.standard_parameters()
    with pytest.raises(DataError, match=r"v has shape \(5,\), expected \(6,\), as q is \(6,\): a"):
        predict_instants(ur5, pi, np.zeros(6), np.zeros(5))
    with pytest.raises(DataError, match=r"q has shape \(5,\), expected \(6,\) or \(N, 6\)"):
        predict_instants(ur5, pi, np.zeros(5), np.zeros(6))
    with pytest.raises(DataError, match=r"q has shape \(1, 2, 6\), expected \(6,\) or \(N, 6\)"):
        predict_instants(ur5, pi, np.zeros((1, 2, 6)))


SLOPED = {
    "in another order": ("ur5_robot.urdf",
        {"joints": ["wrist_1_joint", "shoulder_lift_joint", "elbow_joint"],
         "locked": {"wrist_2_joint": 0.7}, "gravity": (1.0, -2.0, -9.0)}),
    "fingers that slide together": ("panda.urdf",
        {"joints": ["panda_finger_joint1", "panda_joint6", "panda_joint4"], "mimic": "coupled"}),
    "two legs": ("solo12.urdf",
        {"joints": ["HR_HFE", "FL_HAA", "FL_KFE"], "locked": {"FL_HFE": 0.4, "HR_HAA": -0.3}}),
}  # fmt: skip
H = 1e-6


@pytest.fixture(params=SLOPED)
def case(request):
    file, options = SLOPED[request.param]
    model = RobotModel.from_urdf(example_urdf(file), **options)
    q, v, a = np.random.default_rng(3).uniform(-1.2, 1.2, (3, 4, len(model.joints)))
    rows = Trajectory(
        np.arange(4.0), q, v, a, np.zeros_like(q), model.joints, None, np.zeros(4, dtype=int)
    )
    return model, truth(model), rows


def torque(model, pi, q, v, a, change=lambda engine: None):
    """Return the torques in the rows of the joints, of a robot that is changed first."""
    engine, G = model.with_parameters(pi).pin_model.copy(), model.velocity_map
    change(engine)
    data = engine.createData()
    rows = zip(model.configurations(q), v @ G.T, a @ G.T, strict=True)
    return np.array([G.T @ pin.rnea(engine, data, *row) for row in rows])


def test_slopes_are_those_of_differences_by_motion_and_gravity(case):
    model, pi, m = case
    q, v, a = m.q, m.v, m.a
    found = body_slopes(model, pi, m)
    n = len(model.joints)
    np.testing.assert_allclose(body_slopes_by_position(model, pi, m), found.by_q, atol=1e-10)
    shapes = [(4, n, n)] * 3 + [(4, n, 3), (4, n, n, 3), (4, n, n, 2)]
    assert [x.shape for x in found] == shapes

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


def across(model, joint):
    """Return the two directions across the axis that the URDF states for a joint."""
    (axis,) = (x.axis for x in model.tree.joints if x.name == joint)
    return np.linalg.svd([axis])[2][1:]


@pytest.mark.parametrize("kind", ["origin", "axis"])
def test_slopes_by_the_place_of_each_joint_are_those_of_differences(case, kind):
    model, pi, m = case
    q, v, a = m.q, m.v, m.a
    found = getattr(body_slopes(model, pi, m), f"by_{kind}")
    for j, joint in enumerate(model.joints):
        directions = np.eye(3) if kind == "origin" else across(model, joint)
        for k, direction in enumerate(directions):

            def moved(side, joint=joint, direction=direction):
                def change(engine):
                    i = engine.getJointId(joint)
                    place, shift = engine.jointPlacements[i].copy(), side * direction
                    if kind == "origin":
                        place.translation = place.translation + shift
                    else:
                        place.rotation = place.rotation @ pin.exp3(shift)
                    engine.jointPlacements[i] = place

                return torque(model, pi, q, v, a, change)

            exact = (moved(H) - moved(-H)) / (2 * H)
            np.testing.assert_allclose(found[:, :, j, k], exact, atol=1e-6)
    assert np.abs(found).max() > (0.1 if kind == "origin" else 0.01)


def test_the_slopes_by_forces_on_joint_and_tip_are_those_of_the_virtual_work(case):
    model, pi, m = case
    engine, G = model.with_parameters(pi).pin_model, model.velocity_map
    last, data = engine.njoints - 1, engine.createData()
    frames = [k for k, x in enumerate(engine.frames) if x.parentJoint == last]
    tip = max(frames, key=lambda k: np.linalg.norm(engine.frames[k].placement.translation))
    found = force_slopes(model, m)
    for by_force, q in zip(found, model.configurations(m.q), strict=True):
        for j, push in enumerate(H * G.T):
            ends = []
            for side in (push, -push):
                pin.framesForwardKinematics(engine, data, pin.integrate(engine, q, side))
                ends.append(np.append(data.oMi[last].translation, data.oMf[tip].translation))
            np.testing.assert_allclose(by_force[j], -(ends[0] - ends[1]) / (2 * H), atol=1e-7)


def test_slopes_are_linear_in_bodies_that_may_be_none(ur5, rng):
    m, pi = motion(ur5, rng, 3), ur5.standard_parameters()
    none = np.zeros_like(pi)
    none[10:20] = [-0.5, 0.3, -0.2, 0.5, 0.1, 0.0, 0.2, 0.0, 0.0, 0.1]
    found, parts = body_slopes(ur5, pi + none, m), (body_slopes(ur5, x, m) for x in (pi, none))
    for slope, one, other in zip(found, *parts, strict=True):
        np.testing.assert_allclose(slope, one + other, atol=1e-9)
