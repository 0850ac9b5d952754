"""Where a fit begins: typical sizes, first loops and unknowns, by their equations."""

import math
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from helpers.mujoco_plant import multisine, plant, recorded
from helpers.paths import URDF
from helpers.single_joint import slider

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.dynamics.torque import predict_instants
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import identify_loops, loop_findings
from robotid.identification.closed_loop.initial_values import (
    CLEAR,
    _Motion,
    find_encoders,
    fit_second_order,
    parallel_axes,
    typical_sizes,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.drives import Coulomb, Offset, Viscous
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def test_a_load_that_would_push_a_loop_the_wrong_way_does_not_count(rng):
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", gravity=(0.0, -9.81, 0.0))
    q, v, a = rng.uniform(-1.0, 1.0, (3, 60, 2))
    sign, zero = np.array([-1.0, 1.0]), np.array([0.3, -0.4])
    state = sign * q + zero, sign * v, sign * a
    torque = predict_instants(model, model.standard_parameters(), *state)
    sense, noise = np.tanh(v), 1e-3 * rng.standard_normal((60, 2))
    gives = sign * torque * [0.02, 0.05] + 0.1 * v - 0.2 * a + 0.3 * sense + 0.7 + noise
    for way, counts in (([1.0, 1.0], [1, 1]), ([1.0, -1.0], [1, 0]), ([-1.0, 1.0], [0, 1])):
        error = gives - (1.0 - np.array(way)) * sign * torque * [0.02, 0.05]
        motion = _Motion(q, v, a, error, sense)
        left, without = motion.left(model, sign, zero), motion.without
        for j in range(2):
            X = np.column_stack([np.ones(60), v[:, j], sense[:, j], a[:, j]])
            bare = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            X = np.column_stack([X, torque[:, j]])
            best = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            assert without[j] == pytest.approx(bare)
            assert left[j] == pytest.approx(best if counts[j] else bare)
            assert best < 0.5 * bare
        cost = motion.cost(model, sign, zero)
        assert cost == pytest.approx(60 * np.log(left).sum())


def test_an_initial_limit_is_the_friction_at_the_largest_speed_within_the_largest_torque(rng):
    model, t = RobotModel.from_urdf(URDF / "planar_2r.urdf"), np.arange(100) / 100.0
    q_ref, q = rng.uniform(-1.0, 1.0, (2, 100, 2))
    more = np.array([[0.5, 2.0], [1.0, 1.0]])
    log = Log(t, q, 0 * q, model.joints, q_ref=q_ref, has_torque=False, gain_factors=more)
    friction, one = {"viscous": np.array([2.0, 200.0]), "coulomb": np.array([1.0, 3.0])}, np.ones(2)
    plain = SimpleNamespace(
        loops=SimpleNamespace(kp=np.array([30.0, 20.0]), limit=np.inf), inertia=one, torque=one,
        shows_inertia=one > 0, friction=friction.__getitem__,
    )  # fmt: skip
    robot, windows, has_gain = SimpleNamespace(model=model), cut_windows(log, np.inf, 0.0), one > 0
    of_errors = 0.8 * plain.loops.kp * more[0] * np.abs(q_ref - q)[windows[0].counted].max(axis=0)
    for top, wanted in (
        ([0.0, 0.0], of_errors),
        ([0.5, 0.5], [2.0, of_errors[1]]),  # the second would need more than it ever gave
    ):
        found = typical_sizes(robot, plain, windows, has_gain, np.array(top), ["a", "b"])
        np.testing.assert_allclose(found.largest, wanted)


def test_the_limit_of_a_drive_that_bears_a_load_is_found_beyond_the_load(tmp_path, rng):
    rail, t = slider(tmp_path), np.arange(500) / 250.0
    q_ref = 0.2 * np.sign(np.sin(4.0 * t))[:, None]
    log = Log(t, 0 * q_ref, 0 * q_ref, ("j",), q_ref=q_ref, has_torque=False)
    robot, loops = ClosedLoopRobot(rail, step=4e-3), stated_loops(rail, LoopSettings(kp=50.0))
    terms, values = ((Viscous(), Coulomb(), Offset()),), np.array([3.0, 0.1, 8.0])
    drive = replace(
        loops, bodies=0 * loops.bodies, armature=np.array([0.3]), limit=np.array([10.0]),
        terms=terms, values=values,
    )  # fmt: skip
    [out] = robot.roll_out(drive, cut_windows(log, np.inf, 0.0))
    windows = cut_windows(replace(log, q=out.q), np.inf, 0.0)
    found = fit_second_order(robot, windows, loops, False, True).loops
    assert found.limit == pytest.approx(10.0, rel=1e-3)
    np.testing.assert_allclose(found.values, values, rtol=0.05)


AWAY = 0.5  # [rad] of the thigh's zero from the URDF's
SETTINGS = SimulationSettings(window=1.0, lead=0.3, bodies=0.0, step=4e-3)


@pytest.fixture(scope="module")
def leg():
    rng = np.random.default_rng(1)
    robot = plant("leg", rng, coulomb=0.01, viscous=0.01)
    return robot, recorded(robot, rng, duration=8.0, rate=250.0)[0]


@pytest.fixture(scope="module")
def moved(leg):
    """The log of a leg whose thigh reads 0 where the URDF is at 0.5 rad."""
    robot, log = leg
    away = np.array([0.0, AWAY, 0.0])
    return robot, replace(log, q=log.q - away, q_ref=log.q_ref - away)


def test_encoders_with_the_zeros_of_the_urdf_keep_them(leg):
    found = find_encoders(leg[0].model, [leg[1]])
    for values, wanted in ((found.zero, 0.0), (found.sign, 1.0), (found.gain, 0.0)):
        np.testing.assert_array_equal(values, wanted)
    assert (found.margin[:2] > CLEAR).all()
    assert 0.0 <= found.margin[2] < CLEAR, "the calf bears little"
    assert (found.explained[:2] > 0.3).all()
    # ... and none where the motion is too small to tell
    middle = leg[1].q.mean(axis=0)
    small = replace(leg[1], q=middle + 0.2 * (leg[1].q - middle))
    np.testing.assert_array_equal(find_encoders(leg[0].model, [small]).margin, 0.0)


def test_a_zero_is_found_to_the_grid_and_then_by_the_fit(moved):
    robot, log = moved
    first = find_encoders(robot.model, [log])
    np.testing.assert_array_equal(first.sign, 1.0)
    assert first.zero[1] == pytest.approx(AWAY, abs=np.deg2rad(15.0))
    assert (first.zero[[0, 2]] == 0.0).all()
    assert first.next_zero[1] == 0.0  # that of the URDF, so gain and margin are of the same two
    np.testing.assert_allclose(first.gain, [0.0, 1.0 - 1.0 / (1.0 + first.margin[1]), 0.0])
    loop = LoopSettings(**robot.gains, zeros="find")
    found = identify_loops(robot.model, [log], [], loop, SETTINGS, chooses=False)
    zero = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
    assert zero["FL_thigh_joint.zero"] == pytest.approx(AWAY, abs=0.03)
    [said] = [f for f in found.findings if f.code == "encoder"]
    assert said.where == "FL_thigh_joint"
    assert said.evidence["zero"] == pytest.approx(AWAY, abs=0.03)
    assert f"leaves {100 * said.evidence['margin']:.0f} % more" in said.message
    assert said.evidence["next_zero"] == 0.0, "that of the URDF"
    [kept] = [f for f in found.findings if f.code == "encoder_uncorrected"]
    assert kept.where == "FL_hip_joint"
    assert f"explains {100 * kept.evidence['explained']:.0f} %" in kept.message
    [open_] = [f for f in found.findings if f.code == "encoder_undetermined"]
    assert open_.where == "FL_calf_joint"
    [mirror] = [f for f in found.findings if f.code == "mirror_image"]
    assert mirror.where == "FL_thigh_joint, FL_calf_joint"


def test_parallel_axes_are_found_chain_by_chain(leg):
    assert parallel_axes(leg[0].model) == [("FL_thigh_joint", "FL_calf_joint")]
    arm = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"))
    assert parallel_axes(arm) == [("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")]


def test_an_encoder_that_counts_the_other_way_is_turned(leg):
    robot, log = leg
    turned = log.turned(np.array([1.0, -1.0, 1.0]))
    np.testing.assert_array_equal(turned.q[:, 1], -log.q[:, 1])
    np.testing.assert_array_equal(turned.q_ref[:, [0, 2]], log.q_ref[:, [0, 2]])
    sign = find_encoders(robot.model, [turned]).sign
    # a chain with parallel axes is its mirror image: thigh or calf
    assert sorted(sign[1:].tolist()) == [-1.0, 1.0]
    assert sign[0] == 1.0


MASS, LENGTH, KP, VISCOUS, COULOMB = 0.5, 0.1, 0.17, 0.03, 0.06
STEP, RATE = 1e-4, 100.0  # [s] of MuJoCo, [Hz] of the log
DELAY = 1.0 / RATE  # [s]
INERTIAL = f"""<inertial><origin xyz="0 0 -{LENGTH}"/><mass value="{MASS}"/>
<inertia ixx="2e-4" iyy="2e-4" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial>"""
SERVO = f"""<robot name="servo"><link name="base"/><link name="arm">{INERTIAL}</link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="5" velocity="20"/></joint></robot>"""
PLANT = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 1 0" armature="1e-3" damping="{VISCOUS}" frictionloss="{COULOMB}"
  solreffriction="2e-4 1" solimpfriction=".9999 .9999 .001 .5 2"/>
<inertial pos="0 0 -{LENGTH}" mass="{MASS}" diaginertia="2e-4 2e-4 2e-4"/></body></worldbody>
<actuator><position joint="j" kp="{KP}"/></actuator></mujoco>"""


def followed(seed, follow, duration):
    """Return the log of the servo: ``follow`` gives its positions by the commands (N,)."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * RATE)) / RATE
    q_ref = multisine(t, np.zeros(1), np.array([3.0]), rng, highest=2.0)
    q = np.array([*follow(q_ref[:, 0].tolist())])[:, None] + 1e-3 * rng.standard_normal(q_ref.shape)
    return Log(1000.0 + t, q, 0 * q, ("j",), q_ref=q_ref, has_torque=False)


def drooping(commands):
    """Yield positions in MuJoCo, where each command acts a row late."""
    robot = mujoco.MjModel.from_xml_string(PLANT)
    data = mujoco.MjData(robot)
    for command in (commands[0], *commands[:-1]):
        yield data.qpos[0]
        data.ctrl[0] = command
        mujoco.mj_step(robot, data, round(1 / RATE / STEP))


def pushed(commands, push=0.05, fade=0.15, step=2e-4):
    """Yield positions of a servo that compensates friction, at low speed by too much."""
    inertia, weight, q, v = 1.2e-3 + MASS * LENGTH**2, 9.81 * MASS * LENGTH, 0.0, 0.0
    for command in commands:
        yield q
        for _ in range(round(1 / RATE / step)):
            friction = COULOMB - (COULOMB + push) * math.exp(-abs(v) / fade)  # [N m]
            brake = VISCOUS * v + math.tanh(v / 0.01) * friction
            v += step * (KP * (command - q) - brake - weight * math.sin(q)) / inertia
            q += step * v


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("servo") / "servo.urdf"
    path.write_text(SERVO)
    return RobotModel.from_urdf(path)


def test_a_weak_gain_is_found_where_gravity_exceeds_the_drive(model):
    loop, settings = LoopSettings(), SimulationSettings()
    log = followed(2, drooping, 20.0)
    found = identify_loops(model, [log], [], loop, settings, chooses=False)
    assert (found.fitted[0].rmse < 0.01 * found.fitted[0].spread).all()
    values = dict(zip(found.fit.estimate.names, found.fit.estimate.theta, strict=True))
    wanted = {"j.kp": KP, "j.viscous": VISCOUS, "j.coulomb": COULOMB, "robot.delay": DELAY}
    for name, truth in wanted.items():
        assert values[name] == pytest.approx(truth, rel=0.05), name


def test_a_chosen_term_with_negative_friction_is_dropped_and_the_fit_goes_on(model):
    """Stribeck friction would lower the error, but be negative at rest."""
    found = identify_loops(
        model, [followed(2, pushed, 10.0)], [], LoopSettings(kp=KP), SimulationSettings()
    )
    [finding] = [f for f in found.findings if f.code.startswith("friction")]
    assert (finding.code, finding.severity, finding.where) == ("friction_dropped", "warning", "j")
    assert "rad, expected 0 or more. The term was dropped" in finding.message
    assert finding not in loop_findings(found, [replace(finding, code="end_stop")])  # its cause
    [tried] = [t for t in found.fit.tried if t.dropped]
    assert (tried.terms, tried.is_chosen) == (("stribeck",), False)
    assert [term.name for term in found.fit.loops.terms[0]] == ["viscous", "coulomb", "offset"]
