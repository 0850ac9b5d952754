"""The plant moves as closed forms, the conservation of energy, and MuJoCo say."""

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from helpers.single_joint import FREE, Ask, one_joint, parameters, slider
from helpers.synthetic import truth
from scipy.special import ellipj, ellipk

from robotid.dynamics.simulation.simulation_settings import (
    Actuator,
    Controller,
    Sensors,
    Simulation,
)
from robotid.dynamics.simulation.simulator import follow
from robotid.output.files.mjcf import write_mjcf
from robotid.robot.drives import LuGre, Presliding
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

LOOSE = Simulation(actuator=Actuator(limits=FREE))
PD = Controller("pd", kp=200.0, kd=20.0)


def run(model, pi, motion, settings=LOOSE, *, rate=1000.0, duration=2.0):
    return follow(model, pi, motion, rate=rate, duration=duration, settings=settings)


def test_a_pendulum_swings_as_the_elliptic_functions_say(tmp_path):
    model = one_joint(tmp_path)
    found = run(model, parameters(model, armature=0.2), Ask((0.0,), first=(2.0,)), duration=1.2)
    inertia = 0.1 + 2.0 * 0.5**2 + 0.2
    w, m = np.sqrt(2.0 * 9.81 * 0.5 / inertia), np.sin(1.0) ** 2
    sn, _, _, _ = ellipj(ellipk(m) - w * found.t, m)
    np.testing.assert_allclose(found.q[:, 0], 2 * np.arcsin(np.sin(1.0) * sn), atol=1e-6)


def test_the_energy_of_an_arm_without_friction_stays(ur5):
    pi = ur5.standard_parameters()
    free = Actuator(limits=dict.fromkeys(ur5.joints, 1e-9))
    start = (0.3, -1.2, 1.0, 0.4, 0.9, 0.2)
    found = run(ur5, pi, Ask(start), Simulation(actuator=free), duration=1.0)
    robot = ur5.pin_model
    data = robot.createData()
    energy = [
        pin.computeKineticEnergy(robot, data, q, v) + pin.computePotentialEnergy(robot, data, q)
        for q, v in zip(found.q, found.v, strict=True)
    ]
    fell = np.ptp([pin.computePotentialEnergy(robot, data, q) for q in found.q])
    assert fell > 20.0  # J: it does fall
    assert np.ptp(energy) < 1e-4 * fell


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_coulomb_friction_stops_a_body_and_holds_it(tmp_path, rate):
    model = slider(tmp_path)
    pi = parameters(model, coulomb=3.0)
    found = run(model, pi, Ask((0.0,), speed=1.0), rate=rate, duration=1.2)
    way = 2.0 * 1.0**2 / (2 * 3.0)  # m v^2 / 2 F
    assert found.q[-1, 0] == pytest.approx(way, abs=0.01)
    rests = found.t > 2.0 / 3.0 + 0.05
    assert np.abs(found.v[rests]).max() < 1e-3  # it does not chatter
    assert np.ptp(found.q[rests]) < 1e-3


def test_friction_holds_an_arm_against_gravity(tmp_path):
    model = one_joint(tmp_path)
    pi = parameters(model, coulomb=12.0)  # over 2 kg 9.81 m/s^2 0.5 m
    found = run(model, pi, Ask((np.pi / 2,)), duration=1.0)
    assert np.abs(found.q - np.pi / 2).max() < 3e-4  # creeps by tanh, at 0.2 mm/s


def pulled(folder, term, force, viscous):
    """Return the run of a body of 0.5 kg that a force pulls from rest, held by its friction."""
    model = slider(folder, mass=0.5, own_terms={"j": (term,)}, effort=force)
    pi = parameters(model, viscous=viscous, **{term.name: 5.0})
    pull = Simulation(controller=PD, actuator=Actuator(effort=1.0))
    return run(model, pi, Ask((100.0,), first=(0.0,)), pull, rate=400.0, duration=2.0)


def test_presliding_gives_way_as_dahl_says(tmp_path):
    found = pulled(tmp_path, Presliding(displacement=0.01), 2.0, 60.0)
    assert found.q[-1, 0] == pytest.approx(-0.01 * np.log(1 - 2.0 / 5.0), rel=1e-3)
    assert found.saturated == pytest.approx(1.0, abs=2e-3)  # all but the first sample


def test_lugre_holds_by_its_hook_what_it_drags_at_speed(tmp_path):
    term = LuGre(displacement=0.01, speed=0.5, excess=0.5)  # x (1 + excess) = 7.5 N holds
    held = pulled(tmp_path, term, 5.5, 60.0)
    assert held.q[-1, 0] == pytest.approx(-0.015 * np.log(1 - 5.5 / 7.5), rel=0.01)
    v = 0.0
    for _ in range(50):
        v = (20.0 - 5.0 * (1 + 0.5 * np.exp(-((v / 0.5) ** 2)))) / 40.0
    assert pulled(tmp_path, term, 20.0, 40.0).v[-1, 0] == pytest.approx(v, rel=1e-3)


def test_an_elastic_gear_swings_at_its_frequency(tmp_path):
    model = slider(tmp_path)
    gear = Actuator(limits=FREE, stiffness=800.0)
    pi = parameters(model, armature=0.5)
    # at the start the gear is wound up by the acceleration that the motion asks for
    found = run(model, pi, Ask((0.0,), rise=4.0), Simulation(actuator=gear), duration=1.0)
    w = np.sqrt(800.0 * (1 / 0.5 + 1 / 2.0))
    wound = 2.0 * 4.0 / 800.0  # motor before the body
    centre = 0.5 * wound / 2.5  # of mass, which stays
    motor = centre + wound * 2.0 / 2.5 * np.cos(w * found.t)
    np.testing.assert_allclose(found.q[:, 0], motor, atol=2e-3 * wound)
    swings = w**2 * (centre - motor)  # acceleration of the motor, not of the body
    np.testing.assert_allclose(found.a[:, 0], swings, atol=5e-3 * np.abs(swings).max())


def test_a_gear_with_play_hangs_by_its_stiffness(tmp_path):
    model = one_joint(tmp_path)
    pi = parameters(model, armature=0.3, viscous=1.0)
    gear = Actuator(stiffness=500.0, damping=20.0, backlash=0.02)
    motor, joint = (
        run(model, pi, Ask((1.0,)),
            Simulation(controller=PD, actuator=gear, sensors=Sensors(side=side)), rate=500.0)
        for side in ("motor", "joint")
    )  # fmt: skip
    load = 2.0 * 9.81 * 0.5 * np.sin(joint.q[-1, 0])  # what holds the pendulum
    assert joint.tau[-1, 0] == pytest.approx(load, rel=1e-3)
    assert motor.tau[-1, 0] == pytest.approx(load, rel=1e-3)
    assert motor.q[-1, 0] - joint.q[-1, 0] == pytest.approx(load / 500.0 + 0.01, rel=1e-3)
    # the servo is on the motor's side
    assert motor.tau[-1, 0] == pytest.approx(200.0 * (1.0 - motor.q[-1, 0]), rel=1e-3)


def test_an_arm_moves_as_mujocos(tmp_path):
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))
    pi = truth(model)
    pi[[name.endswith(".offset") for name in model.layout.names]] = 0.0
    first = np.array([0.0, -1.2, 1.2, -1.0, 1.0, 0.0])
    to = first + np.array([0.5, -0.4, 0.5, -0.5, 0.4, 0.6])
    kp, kd = np.array([900.0, 900, 500, 150, 100, 60]), np.array([90.0, 90, 50, 15, 10, 6])
    by_joint = [dict(zip(model.joints, x.tolist(), strict=True)) for x in (kp, kd)]
    pd = Simulation(controller=Controller("pd", kp=by_joint[0], kd=by_joint[1]))
    ours = run(model, pi, Ask(tuple(to), first=tuple(first)), pd, duration=1.0)

    write_mjcf(model, pi, tmp_path / "arm.xml")
    spec = mujoco.MjSpec.from_file(str(tmp_path / "arm.xml"))
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    for joint, p, d in zip(model.joints, kp, kd, strict=True):
        servo = spec.add_actuator(name=f"servo {joint}", target=joint)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=p, kv=d)
    spec.option.timestep = 2e-4
    robot = spec.compile()
    robot.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    robot.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    robot.dof_solimp[:] = [0.999, 0.9999, 0.001, 0.5, 2]  # friction as hard as it may be
    data = mujoco.MjData(robot)
    # the step of the reference is within the first of ours
    data.qpos[:], data.qvel[:], data.ctrl[:] = ours.q[1], ours.v[1], to
    theirs = []
    for _ in range(1000):
        theirs.append(data.qpos.copy())
        mujoco.mj_step(robot, data, 5)
    theirs = np.array(theirs)
    assert np.abs(theirs[-1] - first).min() > 0.2  # every joint goes some way
    np.testing.assert_allclose(ours.q[1:], theirs, atol=5e-4)
