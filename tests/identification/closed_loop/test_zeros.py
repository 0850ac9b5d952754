from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, recorded

from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import identify_loops
from robotid.identification.closed_loop.initial_values import CLEAR, find_encoders, parallel_axes
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

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
    np.testing.assert_array_equal(found.zero, 0.0)
    np.testing.assert_array_equal(found.sign, 1.0)
    np.testing.assert_array_equal(found.gain, 0.0)
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
    drives = robot.drives
    loop = LoopSettings(
        kp={d.joint: d.kp for d in drives}, kd={d.joint: d.kd for d in drives}, zeros="find"
    )
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
