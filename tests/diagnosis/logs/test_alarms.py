"""The doctor raises no alarm that obeying would not answer."""

import numpy as np
import pytest
from helpers.corruptions import NOISE, clean_log, controlled_log, late, robot, table_of

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.simulation.simulator import simulate
from robotid.dynamics.simulation.truth import another_robot
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SIGNALS = SignalSettings()


def loud(findings):
    return [f.code for f in findings if f.severity != "note"]


def simulated(file, seed):
    """Return a robot and a clean log of another one like it at 30 Hz, a tool of 1.2 kg on it."""
    model = RobotModel.from_urdf(example_urdf(file))
    rng = np.random.default_rng(seed)
    pi = another_robot(model, rng)
    motion = random_fourier(model, rng, period=5.0)
    return model, simulate(model, pi, motion, rate=30.0, duration=10.0, rng=rng, noise=NOISE)


@pytest.mark.parametrize(("name", "duration"), [("ur5", 6.0), ("panda", 6.0)])
def test_a_short_clean_log_is_not_said_to_be_late(name, duration):
    log = controlled_log(name, 100, duration=duration)
    assert loud(diagnose(robot(name), [log], [], SIGNALS)) == []


def test_a_late_torque_of_a_short_log_is_found_and_what_it_takes_away_is_said(ur5):
    table = late("tau_", 0.03)(table_of(controlled_log("ur5", 102, duration=8.0)))
    q, v, tau = (
        np.column_stack([table[f"{kind}_{joint}"] for joint in ur5.joints])
        for kind in ("q", "dq", "tau")
    )
    log = Log(t=table["time"], q=q, v=v, tau=tau, joints=ur5.joints)
    (found,) = [f for f in diagnose(ur5, [log], [], SIGNALS) if f.code == "torque_delay"]
    assert found.severity == "warning"
    assert found.evidence["delay"] == pytest.approx(0.03, abs=3 * found.evidence["std_error"])
    # of segments that the delay was not found in, whose friction physics leaves too
    assert found.evidence["gain"] > 0.3


def test_a_clean_log_of_a_light_arm_at_30_hertz_raises_no_alarm():
    # 33 ms in two Runge-Kutta steps: the simulated log itself would be wrong
    model, log = simulated("talos_left_arm.urdf", 0)
    assert loud(diagnose(model, [log], [], SIGNALS)) == []


def test_a_load_is_not_taken_for_another_gravity():
    # 1.2 kg in the hand of an arm of 0.6 kg
    model = RobotModel.from_urdf(example_urdf("so101.urdf"))
    assert "gravity" not in loud(diagnose(model, [clean_log(model, 0)], [], SIGNALS))
