"""A robot on its feet: motion, contact forces and torques against Pinocchio's."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.stands import stand

from robotid.base.exceptions import DataError, SettingsError
from robotid.dynamics.simulation.sensors import contact_forces
from robotid.dynamics.simulation.simulation_settings import Controller, Sensors, Simulation
from robotid.dynamics.simulation.simulator import follow, simulate
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
MIDDLE = np.tile([0.0, 0.8, -1.6], 4)
PERFECT = Simulation(controller=Controller(kind="perfect"))


@pytest.fixture(scope="module")
def robot():
    contacts = [Contact(foot, measured=("fz",) * (foot == FEET[0])) for foot in FEET]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, constraints=contacts, terms=()
    )


@pytest.fixture(scope="module")
def motion(robot):
    return stand(robot, MIDDLE, 0.25, np.random.default_rng(1), parts=2, length=1.0)


def test_the_torques_cause_the_motion_in_constrained_dynamics(robot, motion):
    pi = robot.standard_parameters()
    run = follow(robot, pi, motion, rate=10.0, duration=2.0, settings=PERFECT)
    model, contacts = robot.pin_model, motion.touching(run.t)
    q, v, a = motion.evaluate(run.t)
    for k in range(2, 19):
        if (contacts[k - 1] != contacts[k + 1]).any():  # the feet are not at rest there
            continue
        feet = [
            pin.RigidConstraintModel(
                pin.ContactType.CONTACT_3D, model, model.frames[i].parentJoint,
                model.frames[i].placement, pin.LOCAL_WORLD_ALIGNED,
            )
            for i in (model.getFrameId(foot, pin.FrameType.BODY) for foot in FEET)
        ]  # fmt: skip
        feet = [foot for foot, touches in zip(feet, contacts[k], strict=True) if touches]
        own = pin.StdVec_RigidConstraintData([foot.createData() for foot in feet])
        feet = pin.StdVec_RigidConstraintModel(feet)
        data = model.createData()
        pin.initConstraintDynamics(model, data, feet, own)
        tau = np.append(np.zeros(6), run.tau[k])
        found = pin.constraintDynamics(model, data, q[k], v[k], tau, feet, own)
        np.testing.assert_allclose(found, a[k], atol=1e-4 * (1.0 + np.abs(a[k]).max()))
    force = run.stand.wrenches["fz FL_FOOT"]
    assert force[contacts[:, 0]].min() > 1.0
    np.testing.assert_allclose(force[~contacts[:, 0]], 0.0, atol=1e-9)


def test_a_log_has_base_contacts_and_measured_forces(robot, motion):
    sensors = Sensors(velocity=False, dropped=0.2)
    log = simulate(
        robot, robot.standard_parameters(), motion, rate=50.0, duration=2.0,
        rng=np.random.default_rng(0), settings=replace(PERFECT, sensors=sensors),
    )  # fmt: skip
    assert 60 < len(log.t) < 101
    np.testing.assert_allclose(log.base.pose, motion.evaluate(log.t)[0][:, :7], atol=1e-12)
    assert log.base.twist is None
    assert tuple(log.contacts) == FEET
    assert [*log.wrenches] == ["fz FL_FOOT"]
    np.testing.assert_array_equal(np.transpose([*log.contacts.values()]), motion.touching(log.t))


def test_forces_are_the_smallest_that_cause_a_wrench(rng):
    J, w = rng.standard_normal((3, 9, 6)), rng.standard_normal((3, 6))
    f, left = contact_forces(J, w)
    np.testing.assert_allclose(left, 0.0, atol=1e-10)
    wanted = [np.linalg.lstsq(own.T, x, rcond=None)[0] for own, x in zip(J, w, strict=True)]
    np.testing.assert_allclose(f, wanted, atol=1e-10)


def test_what_a_stand_cannot_do_is_refused(robot, motion):
    pi, rng = robot.standard_parameters(), {"rate": 10.0, "duration": 1.0}
    flying = replace(motion, contacts=np.zeros_like(motion.contacts))
    with pytest.raises(DataError, match=r"forces at the contacts cannot cause .* t = "):
        follow(robot, pi, flying, settings=PERFECT, **rng)
    with pytest.raises(SettingsError, match="kind is feedforward, wanted perfect"):
        follow(robot, pi, motion, settings=Simulation(), **rng)
    fixed = RobotModel.from_urdf(example_urdf("solo12.urdf"), constraints=[Contact(FEET[0])])
    with pytest.raises(DataError, match="has contacts or loops; simulation needs a robot with"):
        follow(fixed, fixed.standard_parameters(), motion, settings=PERFECT, **rng)
    alone = RobotModel.from_urdf(example_urdf("solo12.urdf"), free_flyer=True, terms=())
    with pytest.raises(SettingsError, match="has no contacts"):
        follow(alone, pi, motion, settings=PERFECT, **rng)
