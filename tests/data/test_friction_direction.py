"""Coulomb friction behind the filter: its column is the sign of the speed, filtered as torque."""

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth
from scipy.signal import butter, sosfiltfilt

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import _acting, acting_directions, process
from robotid.dynamics.rows import friction_speeds
from robotid.dynamics.torque import build_problem, joint_torque_regressor
from robotid.estimation.fitting.recorded import hold_log
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling

MOTOR = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -0.5)))
ROBOTS = {"plain": {}, "coupled drive": {"couplings": (MOTOR,)}}


@pytest.fixture(params=ROBOTS)
def robot(request):
    return RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), **ROBOTS[request.param])


def filtered(x, cutoff, rate, order=4):
    """Return columns behind the filter: an oracle that shares no code with the package."""
    sos = butter(order, cutoff, fs=rate, output="sos")
    return sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, int(2 * rate / cutoff)))


def test_the_coulomb_column_is_the_filtered_sign(robot):
    rate, cutoff, trim = 200.0, 8.0, 0.5
    pi = np.where([name.endswith(".coulomb") for name in robot.layout.names], truth(robot), 0.0)
    log = exact_log(robot, pi, np.random.default_rng(2), samples=3000, rate=rate)
    motion = hold_log(robot, log, SignalSettings(cutoff=cutoff, trim=trim)).whole.trajectory
    kept = np.round(motion.t * rate).astype(int)
    w = log.v @ friction_speeds(robot.layout).T
    expected = filtered(np.sign(filtered(w, cutoff, rate)), cutoff, rate)[kept]
    np.testing.assert_allclose(motion.direction, expected, rtol=0, atol=1e-9)
    # and what it is good for: the torque of Coulomb friction alone, filtered, is the written row
    W = joint_torque_regressor(robot, motion.q, motion.v, motion.a, motion.direction)
    torque = filtered((joint_torque_regressor(robot, log.q, log.v, log.a) @ pi).reshape(-1, 6),
                      cutoff, rate)[kept]  # fmt: skip
    np.testing.assert_allclose((W @ pi).reshape(-1, 6), torque, atol=1e-6 * np.abs(torque).max())
    (rows, tau, _), *_ = build_problem(robot, motion).blocks()
    np.testing.assert_allclose(rows @ pi, tau, atol=1e-6 * np.abs(torque).max())


def test_the_sign_is_filtered_before_rows_are_left_out(ur5):
    pi = truth(ur5)
    log = exact_log(ur5, pi, np.random.default_rng(3), samples=4000, rate=400.0)
    speeds = friction_speeds(ur5.layout)
    fine = process(log, SignalSettings(cutoff=8.0), speeds)
    coarse = process(log, SignalSettings(cutoff=8.0, rate=40.0), speeds)
    same = np.searchsorted(fine.t, coarse.t[1:] - 1e-6)
    np.testing.assert_allclose(fine.t[same], coarse.t[1:], atol=1e-9)
    np.testing.assert_allclose(coarse.direction[1:], fine.direction[same], atol=1e-9)


# --- which way friction acts ----------------------------------------------------------------------

T = np.linspace(-1.0, 1.0, 401)
BAND = 0.02  # [rad/s]


def acting(w, band=BAND, longest=1.0):
    return acting_directions(T, w[:, None], band, longest)[:, 0]


@pytest.mark.parametrize("slope", [0.03, 0.5, 20.0])
def test_a_speed_that_passes_through_zero_has_a_sharp_sign(slope):
    w = slope * (T - 0.1237)
    np.testing.assert_array_equal(acting(w), np.sign(w))


@pytest.mark.parametrize("depth", [-0.015, 0.0, 0.005, 0.015])
def test_a_short_way_back_keeps_its_sign(depth):
    w = 2.0 * T**2 - depth
    expected = np.where(np.abs(w) < 1e-9, 0.0, np.sign(w))
    np.testing.assert_array_equal(acting(w), expected)


@pytest.mark.parametrize("after", [1.0, -1.0])
def test_friction_of_a_drive_that_sticks_goes_from_one_sign_to_the_other(after):
    ringing = 0.004 * np.sin(40 * T)
    w = np.where(T < -0.2, -(T + 0.2), np.where(T > 0.2, after * (T - 0.2), ringing))
    start, end = -0.2 - BAND, 0.2 + BAND  # where the speed is in the band
    expected = np.interp(T, [start, end], [1.0, after])
    np.testing.assert_allclose(acting(w), expected, atol=1e-6)
    np.testing.assert_array_equal(acting(w, longest=0.4), acting(w, band=0.0))
    assert np.count_nonzero(np.diff(np.sign(acting(w, band=0.0)))) > 3  # as the ringing has it


@pytest.mark.parametrize(("cutoff", "is_stuck"), [(4.0, True), (6.0, False)])
def test_stiction_lasts_eight_periods_of_the_filter_at_most(cutoff, is_stuck):
    t = np.arange(0.0, 4.0, 0.005)
    q = np.column_stack([np.where(t < 1.2, -(t - 1.2), np.maximum(t - 2.8, 0.0))])
    w = np.gradient(q, t, axis=0)  # -1, 0 for 1.6 s, and 1 rad/s
    settings = SignalSettings(cutoff=cutoff, min_velocity=BAND)
    found = _acting(t, w, settings)[(t > 1.3) & (t < 2.7), 0]
    wanted = (t[(t > 1.3) & (t < 2.7)] - 2.0) / 0.8
    np.testing.assert_allclose(found, wanted if is_stuck else 0.0, atol=0.01)


def test_rest_has_no_direction():
    w = np.where(np.abs(T) < 0.8, 1e-12 * np.cos(50 * T), T)
    np.testing.assert_array_equal(acting(w)[np.abs(T) < 0.8], 0.0)


@pytest.mark.parametrize(("before", "after", "factor"), [(1, -1, 2.0), (-1, 1, 2.0), (1, 1, 4.0)])
@pytest.mark.parametrize(("enters", "leaves"), [(4.0, 0.5), (0.5, 4.0)])  # [rad/s^2]
def test_a_drive_sticks_that_is_slow_for_longer_than_its_slopes_say(
    before, after, factor, enters, leaves
):
    least, dt = factor * BAND * (1 / enters + 1 / leaves), 1e-4
    for share, sticks in ((1.03, True), (0.97, False)):
        slow = share * least
        t = 7.0 + np.arange(0.0, slow + 0.2, dt)
        in_, out = 7.1, 7.1 + slow
        way_in = before * np.maximum(BAND - enters * (t - in_), BAND - 3 * enters * dt)
        way_out = after * np.maximum(BAND + leaves * (t - out), BAND - 3 * leaves * dt)
        w = np.where(t < in_ + slow / 2, way_in, way_out)
        found = acting_directions(t, w[:, None], BAND, longest=2.0)[:, 0]
        stuck = np.interp(t, [in_, out], [before, after])
        np.testing.assert_allclose(
            found, stuck if sticks else np.sign(w), atol=1e-6 if share < 1 else 2e-3
        )
        sharp = acting_directions(t, w[:, None], BAND, longest=0.99 * slow)[:, 0]
        np.testing.assert_array_equal(sharp, np.sign(w))
