"""Parts of the simulated loop by their closed forms: gears, gains, limits, what it carries."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import SettingsError
from robotid.dynamics.simulation.loops import _failed_at
from robotid.dynamics.simulation.simulation_settings import Actuator, Controller, Payload, Truth
from robotid.dynamics.simulation.simulator import _Gear, _limits, _Torque, carried
from robotid.dynamics.simulation.truth import draw_parameters
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

ROTORS = np.array([[0.5, 0.1], [0.1, 0.2]])  # [kg m^2]


@pytest.fixture
def gear():
    plant = SimpleNamespace(model=SimpleNamespace(joints=("a", "b")), armature=ROTORS)
    actuator = Actuator(
        stiffness={"a": 300.0, "b": 80.0},
        damping={"a": 2.0, "b": 0.5},
        backlash={"a": 0.04, "b": 0},
    )
    return _Gear(plant, actuator)


def test_a_gear_gives_what_winds_it_up_beyond_half_its_play(gear):
    q, v, w = np.array([0.3, -0.4]), np.array([0.7, 0.1]), np.array([1.2, -0.6])
    for twist, wound, touches in (((0.05, 0.01), (0.03, 0.01), 1), ((-0.03, 0), (-0.01, 0), 1),
                                  ((0.015, -0.02), (0.0, -0.02), 0)):  # fmt: skip
        damped = np.array([2.0 * touches, 0.5]) * (w - v)
        found = gear.torque(q, v, q + np.array(twist), w)
        np.testing.assert_allclose(found, np.array([300.0, 80.0]) * wound + damped, atol=1e-12)
    for tau in ([12.0, -3.0], [-7.0, 0.4]):
        twist = gear.twist(np.array(tau))
        np.testing.assert_allclose(twist, np.array(tau) / [300, 80] + [0.02 * np.sign(tau[0]), 0])
        np.testing.assert_allclose(gear.torque(q, v, q + twist, v), tau, atol=1e-9)


def test_the_fastest_rate_of_gears_counts_motors_and_bodies(gear):
    bodies = np.array([[3.0, 0.4], [0.4, 1.5]])
    lightest = np.diag(np.linalg.inv(ROTORS)) + np.diag(np.linalg.inv(bodies))
    rates = [np.sqrt(300.0 * lightest[0]), np.sqrt(80.0 * lightest[1])]
    assert gear.fastest(bodies) == pytest.approx(max(rates))
    gear.d = np.array([0.0, 40.0])  # so damped that it does not swing
    assert gear.fastest(bodies) == pytest.approx(40.0 * lightest[1])
    np.testing.assert_allclose(gear.rotors @ ROTORS, np.eye(2), atol=1e-12)


def test_gains_that_are_not_stated_suit_the_mass_matrix(ur5):
    mass = np.diag(np.arange(1.0, 7.0)) + 0.3
    elbow, lift = "elbow_joint", "shoulder_lift_joint"
    stated = Controller("pd", bandwidth=9.0, kp={elbow: 70.0}, kd={lift: 11.0})
    found = _Torque(ur5, stated, mass)
    inertia, j, k = np.diag(mass), ur5.joints.index(elbow), ur5.joints.index(lift)
    kp, kd = 81.0 * inertia, 18.0 * inertia
    kp[j], kd[k] = 70.0, 11.0
    np.testing.assert_allclose(found.kp, kp)
    np.testing.assert_allclose(found.kd, kd)
    q, v, q_r, v_r, ahead = np.random.default_rng(0).standard_normal((5, 6))
    wanted = ahead + kp * (q_r - q) + kd * (v_r - v)
    np.testing.assert_allclose(found.of(q, v, q_r, v_r, 0 * q, ahead), wanted)
    assert not found.feedforward(q[None], v[None], q_r[None]).any(), "no feed-forward was asked for"
    computed = _Torque(ur5, Controller("computed_torque", bandwidth=9.0), mass)
    asked = ahead + 81.0 * (q_r - q) + 18.0 * (v_r - v)
    robot = ur5.pin_model
    wanted = pin.rnea(robot, robot.createData(), q, v, asked)
    np.testing.assert_allclose(computed.of(q, v, q_r, v_r, ahead, 0 * q), wanted, atol=1e-9)


def test_limits_are_a_share_of_the_urdfs_but_where_stated(panda):
    effort = np.array([j.effort for j in panda.limits])
    assert len(set(effort)) > 1
    np.testing.assert_array_equal(_limits(panda, Actuator()), np.inf)
    stated = Actuator(effort=0.4, limits={"panda_joint3": 5.0})
    wanted = 0.4 * effort
    wanted[2] = 5.0
    np.testing.assert_allclose(_limits(panda, stated), wanted)
    read = [Actuator.from_dict({"effort": value}) for value in (0.4, False)]
    assert [x.effort for x in read] == [0.4, None]
    assert [x.to_dict()["effort"] for x in read] == [0.4, False]
    with pytest.raises(SettingsError, match=r"effort is true, wanted a factor .* or false for no"):
        Actuator.from_dict({"effort": True})
    free = RobotModel.from_urdf(example_urdf("double_pendulum_continuous.urdf"))
    no_limit = [j.effort <= 0 for j in free.limits]
    np.testing.assert_array_equal(np.isinf(_limits(free, Actuator(effort=0.4))), no_limit)


def test_a_payload_adds_what_pinocchio_says_of_its_body(ur5):
    turned = pin.rpy.rpyToMatrix(0.3, -0.7, 1.1)
    I = turned @ np.diag([0.03, 0.05, 0.06]) @ turned.T  # noqa: E741
    xx, xy, xz, yy, yz, zz = I[np.triu_indices(3)]
    load = Payload("forearm_link", 1.7, com=(0.1, -0.2, 0.05), inertia=(xx, xy, yy, xz, yz, zz))
    pi = np.arange(float(len(ur5.layout.names)))
    added = carried(ur5, pi, load) - pi
    body = ur5.layout.bodies.index("forearm_link")
    own = pin.Inertia(1.7, np.array(load.com), I).toDynamicParameters()
    np.testing.assert_allclose(added[10 * body : 10 * body + 10], own, atol=1e-12)
    assert np.count_nonzero(added) == 10
    np.testing.assert_array_equal(pi, np.arange(float(len(pi))))  # as it was
    assert carried(ur5, pi, Payload("forearm_link", 0.0)) is pi


def test_a_drive_of_several_joints_is_as_small_as_the_weakest(panda):
    for ratios in ((("panda_joint1", 1.0), ("panda_joint7", 2.0)),
                   (("panda_joint7", 2.0), ("panda_joint1", 1.0))):  # fmt: skip
        model = RobotModel.from_urdf(
            panda.tree.path, joints=panda.joints, couplings=(Coupling("motor", ratios),)
        )
        pi = draw_parameters(model, Truth(inertials=0.0), np.random.default_rng(3))
        drawn = dict(zip(model.layout.names, pi, strict=True))
        for d, term in model.layout.drive_parameters:
            drive = model.layout.drives[d].name
            weak = 12.0 / 50.0 if drive == "motor" or drive[-1] in "567" else 1.0
            low, high = (weak * x for x in term.typical)
            assert low <= drawn[f"{drive}.{term.name}"] <= high, drive


def test_a_failed_roll_out_is_named_by_row_window_and_joint_with_its_positions(rng):
    """Five rows of three joints in four windows at a time."""
    q, v = rng.standard_normal((2, 5, 3, 4))
    for wrong in (2e6, -2e6, np.nan, np.inf):
        fast = v.copy()
        fast[3, 1, 2] = fast[4, 0, 3] = wrong
        row, lane, joint, start = _failed_at(9, None, q, fast)
        assert (row, lane, joint) == (3, 2, 1)
        np.testing.assert_array_equal(start, q[0, :, 2])
    before, change = rng.standard_normal((2, 3, 4))
    for wrong in (-8.0, np.nan, np.inf):
        moved = change.copy()
        moved[2, 1] = wrong
        row, lane, joint, start = _failed_at(7, (before, moved), q, v)
        assert (row, lane, joint) == (7, 1, 2)
        np.testing.assert_array_equal(start, before[:, 1])
    before[:, 1] = np.nan, -3e6, 0.25
    np.testing.assert_array_equal(_failed_at(7, (before, moved), q, v)[3], [0.0, -1e6, 0.25])
