"""Metrics of simulated positions: those of all logs together, in the unit of each joint."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.single_joint import slider

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.position_errors import (
    PositionEvaluation,
    pool_positions,
    run_open_loop,
)
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def run(joints, rmse, spread, moves, n=50, **baselines):
    """Return an open loop with the errors that are given, on a log of n samples."""
    q_ref = np.outer(np.linspace(0.0, 1.0, n), moves)
    log = Log(np.arange(n) / 100.0, q_ref, 0.0 * q_ref, joints, q_ref=q_ref, has_torque=False)
    others = {key: None if x is None else np.array(x) for key, x in baselines.items()}
    units = ("m",) if joints == ("j",) else ("rad",)
    return PositionEvaluation(log, units, q_ref, np.array(rmse), others, {}, np.array(spread))


@pytest.fixture(scope="module")
def arm():
    return RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=["elbow_joint"])


def test_logs_count_alike_and_errors_are_shares_of_the_motion(arm):
    one = run(arm.joints, [3e-3], [0.3], [1.0], n=50, command=[0.06], urdf=None)
    two = run(arm.joints, [4e-3], [0.4], [1.0], n=70, command=[0.08], urdf=[0.01])
    [(joint, found)] = pool_positions([one, two]).per_joint.items()
    assert (joint, found.unit, found.rows) == ("elbow_joint", "rad", 120)
    assert found.rmse == pytest.approx(np.sqrt((3e-3**2 + 4e-3**2) / 2))
    assert found.relative_error_pct == pytest.approx(1.0)
    assert found.r2 == pytest.approx(1.0 - 1e-4)
    assert found.better_than_constant
    assert found.baselines == {"command": pytest.approx(20.0), "urdf": None}
    assert pool_positions([one, two]).pooled_rmse == pytest.approx(found.rmse)
    off = pool_positions([replace(one, rmse=np.array([0.31]))]).per_joint[joint]
    assert (off.better_than_constant, off.r2 < 0) == (False, True)


def test_a_joint_that_no_log_moves_is_left_out_where_motion_is_wanted(arm):
    still = run(arm.joints, [3e-3], [1e-4], [0.0])
    moved = run(arm.joints, [4e-3], [0.4], [1.0])
    assert pool_positions([still], moving=True).per_joint == {}
    [found] = pool_positions([still, moved], moving=True).per_joint.values()
    assert found.relative_error_pct == pytest.approx(1.0)
    [both] = pool_positions([still, moved]).per_joint.values()
    assert both.relative_error_pct > 1.0
    aside = run(arm.joints, [3e-3], [1e-4], [0.0], command=[2e-3])
    [at_rest] = pool_positions([aside]).per_joint.values()
    assert (at_rest.relative_error_pct, at_rest.baselines) == (None, {"command": None})
    assert at_rest.rmse == pytest.approx(3e-3)
    driven = run(arm.joints, [3e-3], [1e-4], [0.0], steady=[0.1])
    assert len(pool_positions([driven], moving=True).per_joint) == 1, "by its torque"


def test_a_model_without_a_spring_holds_up_to_some_frequency(arm):
    """Of two masses and a spring only the sum is simulated: below the resonance it is right."""
    t = np.arange(4000) / 200.0
    f = np.fft.rfftfreq(len(t), 1 / 200.0)
    q_ref = 0.3 * np.sin(2 * np.pi * (0.1 * t + 0.1 * t**2))  # to 4.1 Hz
    rng, one = np.random.default_rng(0), run(arm.joints, [0.02], [0.2], [1.0])
    rigid, elastic = (1 - (f / x) ** 2 + 0.3j * f / x for x in (40.0, 6.0))
    q, simulated = (np.fft.irfft(np.fft.rfft(q_ref) / H) for H in (elastic, rigid))
    q += 1e-4 * rng.standard_normal(len(q))
    log = Log(t, q[:, None], 0 * q[:, None], arm.joints, q_ref=q_ref[:, None], has_torque=False)
    band = replace(one, log=log, q=simulated[:, None]).valid_band(0)
    assert band["frequency"] == pytest.approx(1.9, abs=0.4)  # (f / 6)^2 = 0.1
    assert band["below"] < 0.1 < 0.2 < band["above"]
    assert replace(one, log=log, q=0.97 * q[:, None]).valid_band(0) is None, "all alike"


def test_errors_are_of_samples_in_windows_and_the_spread_is_about_the_mean(tmp_path):
    """A body that follows a command about 3 m, its log with a gap and a sample by itself."""
    rail, rng = slider(tmp_path), np.random.default_rng(1)
    t = 5.0 + np.concatenate([np.arange(120), [150], 190 + np.arange(60)]) / 100
    q_ref = 3.0 + 0.2 * np.sin(5 * t)[:, None]
    q = q_ref + 0.02 * rng.standard_normal(q_ref.shape)
    log = Log(t, q, 0 * q, ("j",), q_ref=q_ref, has_torque=False)
    robot = ClosedLoopRobot(rail, step=2e-3)
    loops = stated_loops(rail, LoopSettings(kp=300.0, kd=40.0))
    soft = replace(loops, kp=np.array([50.0]))
    found = run_open_loop(robot, loops, log, {"urdf": soft}, horizons=(0.1, 0.5, 4.0, 9.0))
    assert np.isnan(found.q[120])

    def rms(loops, length):
        outs = robot.roll_out(loops, cut_windows(log, length, 0.0))
        missed = np.concatenate([log.q[o.window.counted] - o.q for o in outs])
        return np.sqrt(np.mean(missed**2, axis=0))

    np.testing.assert_allclose(found.rmse, rms(loops, np.inf))
    assert list(found.horizons) == [0.1, 0.5], "of the log's 2.5 s, which end at 7.5 s"
    for length, error in found.horizons.items():
        np.testing.assert_allclose(error, rms(loops, length))
    np.testing.assert_allclose(found.spread, np.sqrt(np.mean((q - q.mean()) ** 2)))
    assert list(found.baselines) == ["command", "urdf", "second_order"]
    np.testing.assert_allclose(found.baselines["command"], np.sqrt(np.mean((q_ref - q) ** 2)))
    np.testing.assert_allclose(found.baselines["urdf"], rms(soft, np.inf))
    assert found.baselines["second_order"] is None
    assert found.name == "log 5-7.49 s"
    assert (found.moves.tolist(), found.is_driven) == ([True], False)
