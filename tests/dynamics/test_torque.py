import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import motion

from robotid.base.exceptions import DataError
from robotid.data.signal_settings import Transmission
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Sample, shuffled
from robotid.dynamics.torque import (
    InstantRegressor,
    build_problem,
    joint_torque_regressor,
    random_regressor,
)
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

ROBOTS = ["ur5_robot.urdf", "double_pendulum_continuous.urdf", "kinova.urdf", "tiago_no_hand.urdf",
          "borinot_flying_arm_2.urdf", "finger_edu.urdf"]  # fmt: skip


def states(model, rng, samples=5):
    m = motion(model, rng, samples)
    return m.q, m.v, m.a


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, {"free_flyer": x}) for name in ROBOTS for x in (False, True)),
     ("tiago.urdf", {"mimic": "coupled"}), ("panda.urdf", {"mimic": "coupled"})],
)  # fmt: skip
def test_columns_of_the_bodies_are_pinocchios_and_their_torque_is_inverse_dynamics(
    name, options, rng
):
    model = RobotModel.from_urdf(example_urdf(name), terms=(), **options)
    q, v, a = states(model, rng)
    engine, G, pi = model.pin_model, model.velocity_map, model.standard_parameters()
    data, Y = engine.createData(), joint_torque_regressor(model, q, v, a)
    rows = zip(model.configurations(q), v @ G.T, a @ G.T, strict=True)
    for Y_k, state in zip(Y.reshape(*v.shape, -1), rows, strict=True):
        columns = G.T @ pin.computeJointTorqueRegressor(engine, data, *state)
        np.testing.assert_allclose(Y_k, columns, atol=1e-12)
        torque = G.T @ pin.rnea(engine, data, *state)
        np.testing.assert_allclose(Y_k @ pi, torque, atol=1e-11 * np.abs(torque).max())


def test_a_coupled_drive_loads_every_joint_it_turns_with(ur5, rng):
    ratios = (("wrist_2_joint", 1.0), ("wrist_3_joint", 0.5))
    model = RobotModel.from_urdf(ur5.tree.path, couplings=(Coupling("motor", ratios),))
    q, v, a = states(model, rng, samples=4)
    Y = joint_torque_regressor(model, q, v, a).reshape(4, 6, -1)
    column = dict(zip(model.layout.names, np.moveaxis(Y, 2, 0), strict=True))
    w, dw = v[:, 4] + 0.5 * v[:, 5], a[:, 4] + 0.5 * a[:, 5]
    np.testing.assert_allclose(column["motor.armature"][:, 4], dw)
    np.testing.assert_allclose(column["motor.armature"][:, 5], 0.5 * dw)
    np.testing.assert_allclose(column["motor.coulomb"][:, 5], 0.5 * np.sign(w))
    # the power the drive takes is that of its own friction: tau . v = Fv w^2
    np.testing.assert_allclose(np.sum(column["motor.viscous"] * v, axis=1), w**2)


def test_drives_of_a_transmission_are_what_its_motors_take(ur5, rng):
    T = np.array([[120.0, 0.0], [80.0, -60.0]])  # motor speeds w_m = T v
    wrist = dict(joints=ur5.joints[4:], motors=("m5", "m6"))
    ((joint, ratios),) = Transmission(**wrist, matrix=T.tolist()).shared.items()
    motor = Coupling(joint, ratios, replaces=True)
    model = RobotModel.from_urdf(ur5.tree.path, couplings=(motor,))
    own, gear = rng.uniform(0.1, 1.0, (2, 4)), np.array([120.0, 80.0])  # at the motors
    pi = model.standard_parameters()
    # inertia and viscous friction are seen through the square of the gear ratio
    pi[-8:] = (own * gear[:, None] ** [2, 2, 1, 1]).ravel()
    wanted = tuple(f"{joint}.{term}" for joint in ur5.joints[4:] for term in model.layout.terms)
    assert model.layout.names[-8:] == wanted
    q, v, a = states(model, rng, samples=5)
    w, dw = v[:, 4:] @ T.T, a[:, 4:] @ T.T
    tau_m = own[:, 0] * dw + own[:, 1] * w + own[:, 2] * np.sign(w) + own[:, 3]
    bodies = np.where(np.arange(len(pi)) < len(pi) - 8, pi, 0.0)
    W = joint_torque_regressor(model, q, v, a)
    np.testing.assert_allclose((W @ (pi - bodies)).reshape(-1, 6)[:, 4:], tau_m @ T, rtol=1e-12)
    instant = InstantRegressor(model, np.arange(len(pi)))
    np.testing.assert_allclose(instant(q[0], v[0], a[0]), W[:6], atol=1e-12)
    # every offset and friction is told from the others, as without a transmission
    assert len(structural_mapping(model).K) == len(structural_mapping(ur5).K)


@pytest.mark.parametrize("free_flyer", [False, True])
def test_support_is_where_the_regressor_can_be_non_zero(free_flyer, rng):
    coupling = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", 0.5)))
    options = {"free_flyer": free_flyer, "couplings": (coupling,)}
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), **options)
    W = random_regressor(model, 30, rng).reshape(30, model.n_rows, -1)
    seen = np.abs(W).max(axis=0) > 1e-12
    assert not (seen & ~model.support).any()
    # and not much more: a body's ten columns are all allowed where one is seen
    assert model.support.sum() < 2 * seen.sum()


def test_a_problem_streams_the_regressor_in_blocks_as_often_as_wanted(ur5, rng):
    m = motion(ur5, rng, 1200)
    problem = build_problem(ur5, m)
    W = joint_torque_regressor(ur5, m.q, m.v, m.a)
    for _ in range(2):
        blocks = list(problem.blocks())
        assert len(blocks) == 3
        np.testing.assert_array_equal(np.vstack([block[0] for block in blocks]), W)
        tau = np.concatenate([block[1] for block in blocks])
        np.testing.assert_array_equal(tau, m.tau.reshape(-1))


def test_a_trajectory_of_other_joints_is_refused(ur5, panda, rng):
    with pytest.raises(DataError, match="has the joints shoulder_pan_joint, shoulder_lift"):
        build_problem(panda, motion(ur5, rng, 1200))
    with pytest.raises(DataError, match=r"weight has shape \(3,\), expected \(1200, 6\)"):
        build_problem(ur5, motion(ur5, rng, 1200), np.ones(3))
    with pytest.raises(DataError, match=r"v and a have shapes"):
        joint_torque_regressor(ur5, np.zeros((2, 6)), np.zeros((2, 5)), np.zeros((2, 6)))


def test_samples_are_shuffled_without_loss(rng):
    one = np.ones((1, 1))
    samples = [Sample(one, np.array([float(k)]), one[0]) for k in range(20_000)]
    found = [int(s.tau[0]) for s in shuffled(samples, rng)]
    assert sorted(found) == list(range(20_000))
    assert np.mean(np.abs(np.array(found) - np.arange(20_000))) > 1000
    # one of 8193 is drawn at a time: k draws leave each of the first as likely (1 - 1/8193)^k
    left = np.mean(np.array(found[4000:]) < 8192) * 16_000 / 8192
    assert left == pytest.approx((1 - 1 / 8193) ** 4000, abs=0.02)
