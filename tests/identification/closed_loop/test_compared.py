"""What is compared: positions, speeds, and torques of roll-outs with those of a log."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import assert_recovered, plant, recorded

from robotid.base.exceptions import DataError, SettingsError
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.identification.closed_loop import stages
from robotid.identification.closed_loop.from_commands import identify_loops, loop_findings
from robotid.identification.closed_loop.loop_settings import LoopSettings, groups_of
from robotid.identification.closed_loop.stages import fit_loops

KP, KD, DELAY, TORQUE = 80.0, 3.0, 0.0053, 0.05
LOOP = LoopSettings(kp=KP, kd=KD, delay=DELAY)


def settings(**changes):
    return SimulationSettings(
        **{"window": 1.0, "lead": 0.3, "bodies": 0.0, "torques": False} | changes
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


def test_gains_and_delay_are_found_from_positions_and_torques(leg):
    robot, rng = leg[0], np.random.default_rng(4)
    fast, _ = recorded(robot, rng, duration=2.0, torque=TORQUE, step=1e-4, highest=6.0)
    found = fitted((robot, fast), LoopSettings(), torques=True)
    assert found.simulator.knows_torques
    np.testing.assert_array_equal(found.simulator.lag, np.full(3, 3))
    assert {name.rpartition(".")[2] for name in found.estimate.names} > {"kp", "kd", "delay"}
    assert_recovered(found.estimate, robot.truth | {"robot.delay": DELAY}, 4.0, 0.2)


def test_speeds_that_are_better_than_positions_make_it_surer(leg):
    plain, both = fitted(leg), fitted(leg, velocities=True)
    assert len(plain.estimate.sigma) == 3
    np.testing.assert_allclose(both.estimate.sigma, 3 * [4e-4] + 3 * [0.002], rtol=0.06)
    names, estimate = plain.estimate.names, both.estimate
    assert estimate.names == names
    surer = estimate.std_error / plain.estimate.std_error
    assert np.median(surer[[not name.endswith("offset") for name in names]]) < 0.8
    for found in (plain, both):
        assert_recovered(found.estimate, leg[0].truth, 4.0, 0.2)


def test_the_time_of_a_long_fit_is_stated_before_it_begins(leg, monkeypatch, caplog):
    monkeypatch.setattr(stages, "_FEW", 1)  # long: more than eight windows
    fitted(leg, window=0.25, lead=0.05)
    assert "2 s of logs are simulated in each step of the fit, which takes minutes" in caplog.text


def test_velocities_that_are_not_those_of_the_positions_are_refused(leg):
    robot, log = leg
    late = replace(log, v=np.vstack([np.zeros((25, 3)), log.v[:-25]]))
    for own, words in ((replace(log, v=None), "no velocities. Record columns dq"),
                       (late, "velocities that are delayed")):  # fmt: skip
        with pytest.raises(DataError, match=f"velocities is true, but log has {words}"):
            fit_loops(robot.model, [own], LOOP, settings(velocities=True))


def test_torques_that_are_not_of_the_loop_are_named():
    """Of two joints: swapped, and of the motor before a gear of 1:50 where the gain is stated."""
    rng = np.random.default_rng(8)
    robot = plant("planar", rng)
    log, _ = recorded(robot, rng, duration=1.0, rate=250.0, torque=0.5, noise=1e-3)
    gains = LoopSettings(kp={"joint_1": 600.0, "joint_2": 250.0})

    def found(tau, loop):
        own, chosen = replace(log, tau=tau), settings(torques=True, step=4e-3)
        return identify_loops(robot.model, [own], [], loop, chosen, chooses=False)

    def missed(result):
        return {f.where: f for f in result.findings if f.code == "torque_mismatch"}

    before = missed(found(log.tau * [1.0, 0.02], gains))
    assert set(before) == {"joint_2"}, "not the other, whose torque is its loop's"
    assert before["joint_2"].evidence["missed_pct"] == pytest.approx(97.4, abs=0.5)  # 98, and noise
    assert "% of the larger" in before["joint_2"].message
    assert before["joint_2"].severity == "warning"
    swapped = found(log.tau[:, ::-1], LoopSettings())
    assert set(missed(swapped)) == {"joint_1", "joint_2"}
    theta = swapped.estimate.theta.copy()
    theta[[swapped.estimate.names.index(f"joint_{j}.kp") for j in (1, 2)]] = 60.0, 15.0
    estimate = replace(swapped.estimate, theta=theta)
    unequal = replace(swapped, fit=replace(swapped.fit, estimate=estimate))
    [finding] = [f for f in loop_findings(unequal, ()) if f.code == "unequal_gains"]
    assert (finding.where, finding.evidence) == ("joint_1, joint_2", {"lowest": 15, "highest": 60})


JOINTS = ("FL_hip_joint", "FL_calf_joint", "FR_hip_joint", "FR_calf_joint", "tail")


def test_joints_that_are_alike_share_a_group_named_by_their_words():
    found = groups_of(LoopSettings(), JOINTS, ["a", "b", "a", "b", "c"])
    assert found == ["hip", "calf", "hip", "calf", "tail"]
    legs = ("front_left_knee", "front_right_knee", "rear_left_knee")  # words of some are not theirs
    assert groups_of(LoopSettings(), legs, "kkk") == ["knee", "knee", "knee"]


def test_a_joint_of_two_groups_is_refused():
    loop = LoopSettings(groups={"front": ["tail"], "back": ["tail"]})
    with pytest.raises(SettingsError, match=r"joint 'tail' is in the groups front and back"):
        groups_of(loop, JOINTS, [1] * 5)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kp", 20.0), ("kd", {"tail": 1.0}), ("limit", "find"), ("delay", 0.01),
        ("gravity_compensation", True), ("zeros", "find"),
    ],
)  # fmt: skip
def test_a_logged_torque_closes_no_loop(name, value):
    with pytest.raises(SettingsError, match=rf"\[controller\] {name} is .*without a controller"):
        LoopSettings(kind="torque", **{name: value})
    assert LoopSettings(kind="pd", **{name: value}).kind == "pd"
