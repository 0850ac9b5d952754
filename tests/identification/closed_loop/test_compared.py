"""What is compared: positions, speeds, and torques of roll-outs with those of a log."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, recorded

from robotid.base.exceptions import DataError, SettingsError
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop.from_commands import identify_loops
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import fit_loops

KP, KD, DELAY, TORQUE = 80.0, 3.0, 0.0053, 0.05
LOOP = LoopSettings(kp=KP, kd=KD, delay=DELAY)
METHODS = {"output": "output error", "input": "input error", "direct": "direct input error"}


def settings(**changes):
    return SimulationSettings(
        **{"window": 1.0, "lead": 0.3, "bodies": 0.0, "torques": "error" in changes} | changes
    )


@pytest.fixture(scope="module")
def leg():
    """A leg whose loops are stiff for its commands, and a log with torques and speeds."""
    rng = np.random.default_rng(3)
    robot = plant("leg", rng, kp=KP, kd=KD, delay=DELAY)
    quiet = {"torque": TORQUE, "speed": 0.002, "noise": 4e-4, "step": 1e-4, "highest": 1.5}
    return robot, recorded(robot, rng, duration=2.5, **quiet)[0]


def fitted(leg, loop=LOOP, **changes):
    robot, log = leg
    return fit_loops(robot.model, [log], loop, settings(**changes), chooses=False)


@pytest.fixture(scope="module")
def methods(leg):
    return {error: fitted(leg, error=error, torques=error != "output") for error in METHODS}


@pytest.mark.parametrize("error", METHODS)
def test_the_drives_are_recovered_whatever_is_compared(leg, methods, error):
    truth, found = leg[0].truth, methods[error]
    estimate = found.estimate
    assert estimate.converged
    assert estimate.message.startswith(METHODS[error])
    if error != "output":
        np.testing.assert_array_equal(found.simulator.lag, np.full(3, 3))
        np.testing.assert_allclose(estimate.sigma, TORQUE, rtol=0.06)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std_error, strict=True):
        assert abs(value - truth[name]) < 4 * std, name
        if name.endswith(("armature", "viscous", "coulomb")):
            assert std < 0.2 * truth[name], name


def test_gains_and_delay_are_found_from_torques_of_roll_outs(leg):
    robot, rng = leg[0], np.random.default_rng(4)
    fast, _ = recorded(robot, rng, duration=2.0, torque=TORQUE, step=1e-4, highest=6.0)
    found = fitted((robot, fast), LoopSettings(), error="input")
    assert found.simulator.knows_torques
    estimate, gains = found.estimate, {"kp": KP, "kd": KD, "delay": DELAY}
    assert {name.rpartition(".")[2] for name in estimate.names} > set(gains)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std_error, strict=True):
        truth = gains.get(name.rpartition(".")[2], robot.truth.get(name))
        assert abs(value - truth) < 4 * std, name
        if truth:
            assert std < 0.2 * truth, name


def test_speeds_that_are_better_than_positions_make_it_surer(leg, methods):
    truth, plain, both = leg[0].truth, methods["output"], fitted(leg, velocities=True)
    assert len(plain.estimate.sigma) == 3
    np.testing.assert_allclose(both.estimate.sigma, 3 * [4e-4] + 3 * [0.002], rtol=0.06)
    names, estimate = plain.estimate.names, both.estimate
    assert estimate.names == names
    surer = estimate.std_error / plain.estimate.std_error
    is_fast = np.array([not name.endswith("offset") for name in names])
    assert np.median(surer[is_fast]) < 0.8
    for name, value, std in zip(names, estimate.theta, estimate.std_error, strict=True):
        assert abs(value - truth[name]) < 4 * std, name


def test_logs_without_what_is_compared_are_refused(leg):
    robot, log = leg
    bare = replace(log, v=None, tau=0 * log.tau, has_torque=False)
    for error in ("input", "direct"):
        with pytest.raises(DataError, match=rf"error = '{error}' compares torques, but log has no"):
            fit_loops(robot.model, [log, bare], LOOP, settings(error=error))
    with pytest.raises(
        DataError, match=r"velocities is true, but log has no velocities. Record columns dq"
    ):
        fit_loops(robot.model, [log, bare], LOOP, settings(velocities=True))
    late = replace(log, v=np.vstack([np.zeros((25, 3)), log.v[:-25]]))
    with pytest.raises(
        DataError, match=r"velocities is true, but log has velocities that are delayed"
    ):
        fit_loops(robot.model, [late], LOOP, settings(velocities=True))


@pytest.mark.parametrize(
    ("loop", "named"),
    [
        (LoopSettings(), "kp, kd, delay"),
        (LoopSettings(kp=KP, kd={"FL_hip_joint": KD}, delay=0.0), "kd"),
        (LoopSettings(kp=KP, kd=KD, delay=0.0, limit="find", zeros="find"), "limit, zeros"),
    ],
)
def test_a_controller_that_is_not_known_has_no_inverse_dynamics(leg, loop, named):
    with pytest.raises(
        SettingsError, match=rf"needs a known controller, but {named} would be fitted"
    ):
        fitted(leg, loop, error="direct")


def test_a_torque_that_drives_is_not_compared_with_itself(leg):
    with pytest.raises(SettingsError, match=r"has kind = 'torque', without a controller"):
        fitted(leg, LoopSettings(kind="torque"), error="input")


def test_torques_that_a_clock_holds_are_refused(leg):
    loop = replace(LOOP, rate=500.0)
    with pytest.raises(SettingsError, match=r"continuous time, but \[controller\] has rate = 500 "):
        fitted(leg, loop, error="input")


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(SettingsError, match=r"error = 'input' compares torques, but torques is f"):
        SimulationSettings(error="input", torques=False)
    with pytest.raises(SettingsError, match=r"'direct' compares torques, but velocities is true"):
        SimulationSettings(error="direct", velocities=True)


def test_a_loop_that_is_soft_for_the_direct_method_is_named():
    rng = np.random.default_rng(5)
    robot = plant("planar", rng, kp=100.0, kd=20.0, delay=0.0)
    log, _ = recorded(robot, rng, duration=1.0, rate=250.0, torque=0.05)
    loop = LoopSettings(kp=100.0, kd=20.0, delay=0.0)
    found = identify_loops(
        robot.model, [log], [], loop, settings(error="direct", step=4e-3), chooses=False
    )
    [soft] = [f for f in found.findings if f.code == "soft_loop"]
    assert soft.severity == "warning"
    assert soft.message.endswith("Set error = 'input'")
    assert soft.evidence["left"] > 0.5


def test_torques_that_are_not_of_the_loop_are_named():
    """Of two joints: swapped, and of the motor before a gear of 1:50 where the gain is stated."""
    rng = np.random.default_rng(8)
    robot = plant("planar", rng)
    log, _ = recorded(robot, rng, duration=1.0, rate=250.0, torque=0.5, noise=1e-3)
    gains = LoopSettings(kp={"joint_1": 600.0, "joint_2": 250.0})

    def missed(tau, loop):
        own = replace(log, tau=tau)
        found = identify_loops(
            robot.model, [own], [], loop, settings(torques=True, step=4e-3), chooses=False
        )
        return {f.where: f for f in found.findings if f.code == "torque_mismatch"}

    before = missed(log.tau * [1.0, 0.02], gains)
    assert set(before) == {"joint_2"}, "not the other, whose torque is its loop's"
    assert before["joint_2"].evidence["missed_pct"] == pytest.approx(98, abs=0.5)
    assert "differ by 98 % of the larger" in before["joint_2"].message
    assert before["joint_2"].severity == "warning"
    assert set(missed(log.tau[:, ::-1], LoopSettings())) == {"joint_1", "joint_2"}
