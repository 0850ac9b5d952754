"""A servo of weak gain that droops under gravity, and logs that ask for impossible friction."""

import mujoco
import numpy as np
import pytest
from helpers.mujoco_plant import multisine

from robotid.data.log import Log
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.robot.model import RobotModel

MASS, LENGTH, KP, VISCOUS, COULOMB, DELAY = 0.5, 0.1, 0.17, 0.03, 0.06, 0.01
STEP, RATE = 1e-4, 100.0  # [s] of MuJoCo, [Hz] of the log
INERTIAL = f"""<inertial><origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="2e-4" iyy="2e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="servo"><link name="base"/><link name="arm">{INERTIAL}</link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="5" velocity="20"/></joint></robot>"""
PLANT = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="1e-3" damping="{VISCOUS}" frictionloss="{COULOMB}"
  solreffriction="2e-4 1" solimpfriction=".9999 .9999 .001 .5 2"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="2e-4 2e-4 2e-4"/></body></worldbody>
<actuator><motor joint="j"/></actuator></mujoco>"""


def drooping(seed, duration=20.0, shake=0.0):
    """Return the log of the servo; its stand turns by ``shake`` [rad] at 2.2 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE
    q_ref = multisine(t, np.zeros(1), np.array([3.0]), rng, highest=2.0)
    robot = mujoco.MjModel.from_xml_string(PLANT)
    data, q, every, lag = mujoco.MjData(robot), [], round(1 / RATE / STEP), round(DELAY / STEP)
    command = np.repeat(q_ref[:, 0], every)
    for k in range(len(command)):
        if k % every == 0:
            q.append(data.qpos[0])
        tilt = shake * np.sin(2 * np.pi * 2.2 * k * STEP)
        robot.opt.gravity[:] = 9.81 * np.sin(tilt), 0.0, -9.81 * np.cos(tilt)
        data.ctrl[0] = KP * (command[max(k - lag, 0)] - data.qpos[0])
        mujoco.mj_step(robot, data)
    q = np.array(q)[:, None] + 1e-3 * rng.standard_normal(q_ref.shape)
    return Log(1000.0 + t, q, 0 * q, ("j",), q_ref=q_ref, has_torque=False)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("servo") / "servo.urdf"
    path.write_text(URDF)
    return RobotModel.from_urdf(path)


def test_a_weak_gain_is_found_where_gravity_exceeds_the_drive(model):
    loop, settings = LoopSettings(), SimulationSettings()
    found = identify_loops(model, [drooping(2)], [], loop, settings, chooses=False)
    assert (found.fitted[0].rmse < 0.01 * found.fitted[0].spread).all()
    values = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
    wanted = {"j.kp": KP, "j.viscous": VISCOUS, "j.coulomb": COULOMB, "robot.delay": DELAY}
    for name, truth in wanted.items():
        assert values[name] == pytest.approx(truth, rel=0.05), name


def test_a_chosen_term_with_negative_friction_is_dropped_and_the_fit_goes_on(model):
    """On a stand that swings, Stribeck friction would lower the error, but be negative at rest."""
    log = drooping(1, shake=0.2)
    found = identify_loops(model, [log], [], LoopSettings(kp=KP), SimulationSettings())
    [finding] = [f for f in found.findings if f.code.startswith("friction")]
    assert (finding.code, finding.severity, finding.where) == ("friction_dropped", "warning", "j")
    assert "N m, wanted 0 or more. The term was dropped" in finding.message
    [tried] = [t for t in found.fit.tried if t.dropped]
    assert (tried.terms, tried.is_chosen) == (("stribeck",), False)
    assert [term.name for term in found.fit.loops.terms[0]] == ["viscous", "coulomb", "offset"]
