"""Coulomb friction behind the filter: its column is the sign of the speed, filtered as torque."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.fitting import fit
from helpers.synthetic import exact_log, truth
from scipy.signal import butter, sosfiltfilt

from robotid.base.exceptions import DataError
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import _acting, acting_directions, process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.drive_columns import friction_directions, friction_speeds
from robotid.dynamics.factors import join
from robotid.dynamics.torque import build_problem, joint_torque_regressor
from robotid.estimation.estimators import WLS
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.standard_errors import torque_band
from robotid.estimation.fitting.survey import hold_log
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


def coulomb_errors(model, recordings, pi):
    """Return the errors of the Coulomb parameters of weighted least squares over their values."""
    mapping = structural_mapping(model)
    found = WLS().fit(join(Recordings(model, mapping, recordings).reduce()).factors)
    chosen = [k for k, name in enumerate(mapping.base_names) if name.endswith(".coulomb")]
    assert len(chosen) == len(friction_speeds(model.layout))
    true = mapping.to_base(pi)[chosen]
    return np.abs(found.theta[chosen] / true - 1.0)


def test_coulomb_friction_is_found_again_behind_the_filter(robot):
    pi = truth(robot)
    log = exact_log(robot, pi, np.random.default_rng(1), samples=4000, rate=200.0)
    recording, bare = (hold_log(robot, log, SignalSettings()) for _ in range(2))
    rows = recording.whole
    without = replace(rows, trajectory=replace(rows.trajectory, direction=None))
    bare.pieces[0].__dict__["_cached"] = without  # as if it had been read so
    found, before = (coulomb_errors(robot, [r], pi) for r in (recording, bare))
    assert before.max() > 2e-3
    # left is what one sample more or less of a sign makes where a smooth speed is next to zero
    assert found.max() < 5e-3 * before.max()


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


def test_without_filter_speeds_or_friction_the_sign_is_the_speeds_own(ur5):
    log = exact_log(ur5, truth(ur5), np.random.default_rng(4), samples=300)
    assert process(log, SignalSettings()).direction is None
    assert hold_log(ur5, log, SignalSettings()).whole.trajectory.direction.shape[1] == 6
    assert hold_log(ur5, log, SignalSettings(cutoff=None)).whole.trajectory.direction is None
    viscous = RobotModel.from_urdf(ur5.tree.path, terms=("viscous",))
    assert friction_speeds(viscous.layout).shape == (0, 6)
    assert hold_log(viscous, log, SignalSettings()).whole.trajectory.direction is None


def test_speeds_of_joints_come_before_those_of_couplings():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=(MOTOR,))
    expected = np.vstack([np.eye(6), [0, 0, 0, 0, 1.0, -0.5]])
    np.testing.assert_array_equal(friction_speeds(model.layout), expected)
    v = np.array([[1.0, -2.0, 0.0, 3.0, 0.25, 1.0]])
    signs = [[1.0, -1.0, 0.0, 1.0, 1.0, 1.0, -1.0]]
    np.testing.assert_array_equal(friction_directions(model.layout, v, None), signs)
    floating = np.hstack([[[9.0] * 6], v])  # the joints' speeds are the last ones
    np.testing.assert_array_equal(friction_directions(model.layout, floating, None), signs)


def test_each_coulomb_column_holds_its_own_direction(rng):
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=(MOTOR,))
    q, v, a = rng.uniform(-1, 1, (3, 5, 6))
    direction = rng.uniform(-1, 1, (5, 7))
    Y = joint_torque_regressor(model, q, v, a, direction).reshape(5, 6, -1)
    plain = joint_torque_regressor(model, q, v, a).reshape(5, 6, -1)
    for k, name in enumerate(model.layout.names):
        owner, term = name.rsplit(".", 1)
        expected = plain[:, :, k]
        if term == "coulomb":
            expected = np.zeros((5, 6))
            if owner == "motor":
                expected[:, 4], expected[:, 5] = direction[:, 6], -0.5 * direction[:, 6]
            else:
                j = model.joints.index(owner)
                expected[:, j] = direction[:, j]
        np.testing.assert_array_equal(Y[:, :, k], expected)


def test_directions_of_another_model_are_refused(ur5):
    log = exact_log(ur5, truth(ur5), np.random.default_rng(5), samples=300)
    motion = process(log, SignalSettings(), np.eye(6)[:4])
    with pytest.raises(DataError, match=r"direction has shape \(\d+, 4\), wanted \(\d+, 6\)"):
        list(build_problem(ur5, motion).blocks())


@pytest.mark.parametrize(
    "direction", [np.zeros(300), np.zeros((299, 6)), np.full((300, 6), np.nan)]
)
def test_a_trajectory_refuses_directions_that_do_not_fit(direction, ur5):
    log = exact_log(ur5, truth(ur5), np.random.default_rng(5), samples=300)
    arrays = {"t": log.t, "q": log.q, "v": log.v, "a": log.a, "tau": log.tau, "joints": log.joints}
    with pytest.raises(DataError, match="trajectory: direction"):
        Trajectory(**arrays, rate=None, segment=np.zeros(300, dtype=int), direction=direction)


def test_a_part_of_a_trajectory_keeps_its_directions(ur5):
    log = exact_log(ur5, truth(ur5), np.random.default_rng(5), samples=300)
    motion = hold_log(ur5, log, SignalSettings()).whole.trajectory
    np.testing.assert_array_equal(motion.part(20, 50).direction, motion.direction[20:50])
    with pytest.raises(ValueError, match="read-only"):
        motion.direction[0] = 1.0


@pytest.mark.parametrize("cutoff", [8.0, None])
def test_friction_that_needs_some_speed_to_be_full_is_found_again(ur5, cutoff):
    pi = truth(ur5)
    band = 0.1  # [rad/s]
    log = exact_log(ur5, pi, np.random.default_rng(1), samples=4000, rate=200.0)
    step = pi[[name.endswith(".coulomb") for name in ur5.layout.names]]
    smooth = step * (np.clip(log.v / band, -1.0, 1.0) - np.sign(log.v))
    log = replace(log, tau=log.tau + smooth)
    told, untold = (
        coulomb_errors(ur5, [hold_log(ur5, log, settings)], pi).max()
        for settings in (
            SignalSettings(cutoff=cutoff, friction_band=band, min_velocity=0.0),
            SignalSettings(cutoff=cutoff, min_velocity=0.0),
        )
    )
    assert untold > 5e-3
    assert told < 0.1 * untold


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


def test_a_robot_that_sticks_is_predicted_as_well_as_its_noise_allows(ur5):
    """The drive of one joint holds for 0.3 s at each reversal; its torque goes over linearly."""
    rate = 200.0
    t = np.arange(0.0, 20.0, 1 / rate)
    phase = t % 2.0
    hold, n = 0.3, len(t)
    # speed of the joint: half sines of both signs with pauses between them
    way = (phase % 1.0) / (1.0 - hold)
    v1 = np.where(way < 1.0, np.sin(np.pi * np.minimum(way, 1.0)), 0.0)
    v1 = np.where(phase < 1.0, v1, -v1)
    side = np.where(phase < 1.0, 1.0, -1.0)
    friction = np.where(way < 1.0, side, side * (1.0 - 2.0 * (phase % 1.0 - 1.0 + hold) / hold))
    v = np.zeros((n, 6))
    v[:, 0] = v1
    q = np.cumsum(v, axis=0) / rate
    a = np.gradient(v, t, axis=0)
    tau = np.zeros((n, 6))
    tau[:, 0] = 3.0 * friction
    log = Log(t=t, q=q, tau=tau, joints=ur5.joints, v=v, a=a)
    motion = hold_log(ur5, log, SignalSettings()).whole.trajectory
    moving = np.abs(motion.v[:, 0]) >= 0.02
    left = np.abs(motion.tau[:, 0] - 3.0 * motion.direction[:, 0])[moving]
    plain = filtered(np.sign(filtered(v[:, :1], 8.0, rate)), 8.0, rate)[:, 0]
    start = np.searchsorted(t, motion.t[0])
    sharp = np.abs(motion.tau[:, 0] - 3.0 * plain[start : start + len(motion.t)])[moving]
    assert np.sqrt(np.mean(left**2)) < 0.5 * np.sqrt(np.mean(sharp**2))


def test_estimates_from_filtered_logs_scatter_as_their_standard_errors_say(ur5):
    """Coulomb, viscous and armature of clean logs were off by 1.5 to 2.5 standard errors."""
    pi, deviations = truth(ur5), []
    for seed in range(3):
        log = exact_log(ur5, pi, np.random.default_rng(seed), samples=3000, rate=200.0)
        noise = 0.01 * np.random.default_rng(10 + seed).standard_normal(log.tau.shape)
        found = fit(ur5, [replace(log, tau=log.tau + noise)], estimator="wls")
        names = found.mapping.base_names
        drives = [name.endswith((".coulomb", ".viscous", ".armature")) for name in names]
        z = (found.base - found.mapping.to_base(pi)) / found.base_error
        deviations.append(z[drives])
    assert 0.7 < np.sqrt(np.mean(np.square(deviations))) < 1.3


def test_the_band_of_a_prediction_follows_the_filtered_sign(ur5):
    log = exact_log(ur5, truth(ur5), np.random.default_rng(6), samples=400)
    motion = hold_log(ur5, log, SignalSettings()).whole.trajectory
    mapping = structural_mapping(ur5)
    C = np.diag([float(name == "elbow_joint.coulomb") for name in mapping.base_names])
    band = torque_band(ur5, mapping, motion, C, np.zeros(6))
    expected = np.abs(motion.direction[band.samples])
    np.testing.assert_allclose(band.parameters[:, 2], expected[:, 2], atol=1e-12)
    assert np.abs(expected[:, 2] - 1.0).max() > 0.2


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
