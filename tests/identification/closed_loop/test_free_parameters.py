from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.mujoco_plant import LEG, multisine, plant, recorded

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, RollOut, Window, cut_windows
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    GainScale,
    LoopSimulator,
    _better_start,
    _gains,
    _last,
    candidates,
    drive_torques,
    find_gains,
    free_body_parameters,
    measured_motion,
)
from robotid.identification.closed_loop.stages import stated_loops
from robotid.output.files.result_file import loops_of
from robotid.robot.drives import Coulomb, LoadFriction, PositionCoulomb, Viscous
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia


@pytest.fixture(scope="module")
def simulator():
    """A leg whose upper joints share armature and viscous friction, its bodies free."""
    rng = np.random.default_rng(0)
    robot = plant("leg", rng)
    log, _ = recorded(robot, rng, duration=0.5, torque=0.1, speed=0.01)
    log = replace(log, gain_factors=np.array([[1.2, 0.9, 1.1], [0.8, 1.0, 1.3]]))
    looped = ClosedLoopRobot(robot.model)
    base = replace(
        stated_loops(robot.model, LoopSettings(kp=20.0, kd=1.5)),
        armature=np.full(3, 0.02), terms=((Viscous(), Coulomb()),) * 3,
        values=np.tile([0.1, 0.2], 3), delay=np.full(3, 0.0047),
    )  # fmt: skip
    free_parameters = (
        FreeParameter("calf.coulomb", "term", (2,), 0.2, 1.0, 0.0, term=Coulomb()),
        FreeParameter("upper.armature", "armature", (0, 1), 0.02, 1.0, 0.0),
        FreeParameter("upper.viscous", "term", (0, 1), 0.1, 1.0, 0.0, term=Viscous()),
        FreeParameter("delay", "delay", (0, 1, 2), 0.0047, 0.1, 0.0),
        *free_body_parameters(looped, 0.1),
        FreeParameter("hip.kp", "kp", (0,), 20.0, 100.0, 1.0),
    )
    return LoopSimulator(looped, cut_windows(log, 0.25, 0.0), base, free_parameters)


def limited(simulator):
    """The same with a largest torque, which is unknown as gains and zeros are."""
    limit = np.array([np.inf, 0.3, 0.3])
    free_parameters = (
        FreeParameter("lower.limit", "limit", (1, 2), 0.3, 3.0, 0.1),
        FreeParameter("lower.kd", "kd", (1, 2), 1.5, 1.0, 0.0),
        FreeParameter("calf.zero", "zero", (2,), 0.0, 0.3),
    )
    base = replace(simulator.base, limit=limit)
    free_parameters = simulator.free_parameters + free_parameters
    return replace(simulator, base=base, free_parameters=free_parameters)


def off(simulator, rng):
    """Parameters whose bodies are not the URDF's."""
    is_body = np.array([u.what == "body" for u in simulator.free_parameters])
    return simulator.prior + np.where(is_body, 0.05 * rng.standard_normal(len(is_body)), 0.0)


@pytest.mark.parametrize("compared", ["positions", "speeds", "all"])
def test_slopes_of_residuals_are_those_of_differences(simulator, rng, compared):
    if compared in ("speeds", "all"):
        simulator = replace(simulator, velocities=True)
    if compared == "all":
        simulator = replace(limited(simulator), lag=np.array([3, 2, 2.5]))
    theta = off(simulator, rng)
    found = simulator.residuals(theta, with_slopes=True)
    slopes = np.concatenate([r.slopes for r in found])  # of the outputs
    np.testing.assert_array_equal(found[0].columns, np.arange(len(theta)))
    assert slopes.shape[1] == {"speeds": 6, "all": 9}.get(compared, 3)
    plain = simulator.residuals(theta, with_slopes=False)
    for one, bare in zip(found, plain, strict=True):
        np.testing.assert_array_equal(one.e, bare.e)
        np.testing.assert_array_equal(one.joints, bare.joints)
    for k, name in enumerate(simulator.names):
        h, close, least = 1e-8 / max(np.abs(slopes[:, :3, k]).max(), 1e-4), 1e-5, 1e-6
        if compared == "all":  # a wider step, too wide for a limit's positions
            h, close, least = 3e-8 / max(np.abs(slopes[:, -3:, k]).max(), 1e-2), 1e-4, 1e-3
        step = h * np.eye(len(theta))[k]
        ends = [simulator.residuals(theta + s * step, with_slopes=False) for s in (1, -1)]
        before, after = (np.concatenate([r.e for r in end]) for end in ends)
        exact = -(before - after) / (2 * h)
        size = np.maximum(np.abs(exact).max(axis=0), least)
        size = np.repeat(size.reshape(-1, 3).max(axis=1), 3)  # of positions, speeds, torques
        assert (np.abs(slopes[..., k] - exact).max(axis=0) <= close * size).all(), name
    if compared == "all":
        both = zip(simulator.windows, plain, strict=True)
        logged = [w.log.tau[w.counted] - r.e[:, 6:] for w, r in both]
        given = np.concatenate(logged)
        at_limit = np.isclose(np.abs(given), 0.3)
        assert 0.02 < at_limit[:, 1:].mean() < 0.9, "drives are at their limit, and are not"


def test_every_value_is_a_body_that_can_be(simulator, rng):
    is_body = np.array([u.what == "body" for u in simulator.free_parameters])
    for _ in range(20):
        theta = np.where(is_body, rng.standard_normal(len(is_body)), simulator.prior)
        bodies = simulator.loops(theta).bodies
        assert (np.linalg.eigvalsh(pseudo_inertia(bodies.reshape(-1)))[:, 0] > -1e-12).all()
    # the joints in another order than the bodies: the mass of the hip changes by exp(2 m)
    model = RobotModel.from_urdf(simulator.robot.model.tree.path, joints=LEG[1:] + LEG[:1])
    robot = ClosedLoopRobot(model)
    assert robot.joint_of_body == (2, 0, 1)
    free = free_body_parameters(robot, 0.1)
    turned = replace(simulator, robot=robot, free_parameters=tuple(free))
    ratio = turned.loops(np.array([0.1, *np.zeros(11)])).bodies[:, 0] / simulator.base.bodies[:, 0]
    np.testing.assert_allclose(ratio, [np.exp(0.2), 1.0, 1.0], rtol=1e-9)


@pytest.fixture(scope="module")
def told():
    """A planar arm whose commands act within the third row of 2 ms, its loops, and its log."""
    rng = np.random.default_rng(6)
    arm = plant("planar", rng, delay=0.0053)
    log, _ = recorded(arm, rng, duration=2.0, torque=0.3, step=5e-5)
    return arm, loops_of(arm.model, arm.parameters, arm.drives), log


def with_torques(outs, tau):
    """The same roll-outs beside a log with other torques."""
    return [replace(o, window=replace(o.window, log=replace(o.window.log, tau=tau))) for o in outs]


def test_the_row_whose_command_a_torque_follows_is_found(told):
    arm, loops, log = told
    outs = ClosedLoopRobot(arm.model).roll_out(loops, cut_windows(log, np.inf, 0.0))
    known, unknown = np.zeros((2, 2), dtype=bool), np.array([[False, True], [True, False]])
    for is_free in (known, unknown):
        lag, found = find_gains(outs, loops, is_free, knows_delay=True, is_whole=False)
        np.testing.assert_array_equal(lag, [3, 3])
        np.testing.assert_allclose(found.kp, loops.kp, rtol=5e-3)
        np.testing.assert_allclose(found.kd, loops.kd, rtol=2e-2)
        np.testing.assert_array_equal(found.kp[0], loops.kp[0])  # is stated
    noise = 0.3 * np.random.default_rng(7).standard_normal(log.tau.shape)
    for true, told_as, loud in (
        ([2.0, 4.0], [2.0, 4.0], 1.0),
        ([2.3, 3.8], [2.3, 3.8], 1.0),  # between two rows
        ([2.06, 3.95], [2.0, 4.0], 0.1),  # hardly
        ([2.3, 3.8], [2.0, 4.0], 30.0),  # as far as can be told
    ):
        tau = drive_torques(outs[0], loops, np.array(true)).limited + loud * noise
        lag, _ = find_gains(with_torques(outs, tau), loops, known, knows_delay=True, is_whole=False)
        np.testing.assert_allclose(lag, told_as, atol=0.05 if true == told_as else 0.0)


def test_torques_tell_gains_before_anything_is_fitted(told):
    _, loops, log = told
    moved = [measured_motion(window) for window in cut_windows(log, np.inf, 0.0)]
    open_ = replace(loops, kp=np.ones(2), kd=np.zeros(2), delay=np.zeros(2))
    is_free = np.ones((2, 2), dtype=bool)
    how = {"knows_delay": False, "is_whole": True}
    lag, found = find_gains(moved, open_, is_free, **how)
    np.testing.assert_array_equal(lag, [3, 3])
    np.testing.assert_allclose(found.kp, loops.kp, rtol=0.02)
    np.testing.assert_allclose(found.kd, loops.kd, rtol=0.05)
    _, found = find_gains(with_torques(moved, -log.tau), open_, is_free, **how)
    np.testing.assert_array_equal(found.kp, open_.kp)  # no gain that would drive it away
    np.testing.assert_array_equal(found.kd, open_.kd)
    largest = np.abs(log.tau).max(axis=0)
    for share in ([0.4, 2.0], [2.0, 0.4]):  # the samples at the limit of their own joint are none
        limit = share * largest
        at_limit = with_torques(moved, np.clip(log.tau, -limit, limit))
        _, found = find_gains(at_limit, replace(open_, limit=limit), is_free, **how)
        np.testing.assert_allclose(found.kp, loops.kp, rtol=0.02)


def test_what_drives_give_follows_commands_whole_or_broken_rows_late():
    """Kinds, limits and delays of two joints, beside the equation row by row."""
    rng = np.random.default_rng(2)
    q, v, q_ref, v_ref, tau_ref = rng.standard_normal((5, 9, 2))
    log = Log(5.0 + np.arange(9) / 100, q, 0 * q, ("a", "b"), q_ref=q_ref, v_ref=v_ref,
              tau_ref=tau_ref, has_torque=False, gain_factors=[[2.0, 0.5], [1.0, 3.0]])  # fmt: skip
    window = Window(log, 0, 2, 8)
    out = RollOut(window, q[2:8], v[2:8])
    kp, kd, limit = np.array([3.0, 5.0]), np.array([0.7, 0.2]), np.array([2.0, np.inf])
    loops = stated_loops(plant("planar", rng).model, LoopSettings())
    loops = replace(loops, kp=kp, kd=kd, limit=limit)
    for lag in ([0.0, 1.0], [2.25, 0.5], [4.0, 1.75]):
        found = drive_torques(out, loops, np.array(lag))
        for j, late in enumerate(lag):
            at = np.arange(2, 8) - late  # between two rows their mean, by how near they are

            def told(x, j=j, at=at):
                return np.interp(at, np.arange(9), x[:, j])

            more, harder = log.gain_factors[:, j]
            reach, rate = more * (told(q_ref) - q[2:8, j]), harder * (told(v_ref) - v[2:8, j])
            asked = kp[j] * reach + kd[j] * rate + told(tau_ref)
            np.testing.assert_allclose(found.position_error[:, j], reach)
            np.testing.assert_allclose(found.speed_error[:, j], rate)
            np.testing.assert_allclose(found.unlimited[:, j], asked)
            np.testing.assert_allclose(found.limited[:, j], np.clip(asked, -limit[j], limit[j]))


def noisy_windows(rng):
    """Return windows of a roll-out with noise, without a lead, and where they began in truth."""
    arm = plant("planar", rng, delay=0.006)
    t = np.arange(750) / 250.0
    q_ref = multisine(t, arm.middle, arm.reach, rng)
    log = Log(t, q_ref, 0 * q_ref, arm.model.joints, q_ref=q_ref, has_torque=False)
    robot = ClosedLoopRobot(arm.model, step=4e-3)
    loops = loops_of(arm.model, arm.parameters, arm.drives)
    [out] = robot.roll_out(loops, cut_windows(log, np.inf, 0.0))
    noisy = replace(log, q=out.q + 3e-4 * rng.standard_normal(out.q.shape))
    unknown = FreeParameter("delay", "delay", (0, 1), 0.006, 0.1)
    windows = cut_windows(noisy, 1.0, 0.0)
    truth = np.array([[out.q[w.start_row], out.v[w.start_row]] for w in windows])
    return LoopSimulator(robot, windows, loops, (unknown,)), truth


def test_starts_that_fit_are_nearer_to_the_truth_than_those_measured(rng):
    measured, truth = noisy_windows(rng)
    better = measured.with_better_start(measured.prior)
    before, after = (np.array([w.start for w in one.windows]) - truth for one in (measured, better))
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    left = np.concatenate([r.e for r in better.residuals(measured.prior, with_slopes=False)])
    assert np.sqrt(np.mean(left**2)) < 1.2 * 3e-4
    rows = [[(w.start_row, w.first, w.stop) for w in x.windows] for x in (measured, better)]
    assert rows[0] == rows[1]


def test_a_corrected_start_is_regularised_by_position_errors_and_the_typical_speed(rng):
    """Two parts of one and two joints; sensitivities are of positions, then of speeds."""
    t, n, sigma = 5.0 + 0.02 * np.arange(40), 3, np.array([0.01, 0.03, 0.002])
    q = np.cumsum(rng.normal(size=(40, n)), axis=0)
    window = Window(Log(t, q, 0 * q, ("a", "b", "c")), 5, 10, 30)
    parts = [(np.array([1]), np.array([1, 4])), (np.array([0, 2]), np.array([0, 2, 3, 5]))]
    slopes = tuple((*x, rng.normal(size=(20, len(x[0]), len(x[1])))) for x in parts)
    simulated = q[10:30] + 0.05 * rng.normal(size=(20, n))
    found = _better_start(RollOut(window, simulated, 0 * simulated, slopes), sigma).ravel()
    speed = np.sqrt(np.mean((np.diff(q, axis=0) / 0.02) ** 2, axis=0))
    prior = np.diag(np.concatenate([3.0 * sigma, speed]) ** -2.0)
    for joints, places, S in slopes:
        W = np.tile(sigma[joints] ** -2.0, 20)
        A, e = S.reshape(-1, len(places)), (q[10:30] - simulated)[:, joints].ravel()
        H = (A.T * W) @ A + prior[np.ix_(places, places)]
        np.testing.assert_allclose(found[places], np.linalg.solve(H, (A.T * W) @ e), rtol=1e-6)


def test_gains_are_those_of_fits_to_the_other_folds(rng):
    parts = [(rng.standard_normal((rows, 5)), rng.standard_normal(rows)) for rows in (12, 9, 15)]
    H, g = (np.array(x) for x in zip(*((A.T @ A, A.T @ b) for A, b in parts), strict=True))
    sets = {7: [1], 9: [4, 3]}
    least = np.full(5, -np.inf)
    found = _gains(H, g, [0, 2], sets, least)
    least[1] = np.inf
    bounded = _gains(H, g, [0, 2], sets, least)
    assert not bounded[7].any(), "every step is beyond the bound"
    np.testing.assert_array_equal(bounded[9], found[9])
    least[1], least[3] = -np.inf, np.inf  # of the second column of a set
    assert not _gains(H, g, [0, 2], sets, least)[9].any()
    for k, (A, b) in enumerate(parts):
        others = [part for i, part in enumerate(parts) if i != k]
        A_f, b_f = (np.concatenate(x) for x in zip(*others, strict=True))

        def left(columns, A=A, b=b, A_f=A_f, b_f=b_f):
            fitted = np.linalg.lstsq(A_f[:, columns], b_f, rcond=None)[0]
            return np.sum((A[:, columns] @ fitted - b) ** 2)

        for s, own in sets.items():
            assert found[s][k] == pytest.approx(left([0, 2]) - left([0, 2, *own]), rel=1e-9)


def test_terms_are_scaled_by_half_the_range_of_a_joint_and_need_some_of_it(rng):
    model, t = plant("planar", rng).model, np.arange(200) / 100.0
    q = 0.3 + np.outer(np.cos(np.pi * t / 2), [0.4, 0.04])  # the second moves by less than 0.05
    log = Log(t, q, 0 * q, model.joints, q_ref=q, has_torque=False)
    robot = SimpleNamespace(model=model)
    simulator = SimpleNamespace(robot=robot, windows=cut_windows(log, 1.0, 0.0))
    offered = [free for set_ in candidates(simulator, np.array([2.0, 3.0])) for free in set_]
    by_position = [free for free in offered if isinstance(free.term, PositionCoulomb)]
    assert [free.joints for free in by_position] == [(0,), (0,)]
    by_order = [2.0 / (np.ptp(q[:, 0]) / 2) ** order for order in (1, 2)]
    assert [free.spread for free in by_position] == pytest.approx(by_order)
    assert {free.spread for free in offered if isinstance(free.term, LoadFriction)} == {1.0}


@pytest.mark.parametrize(
    ("change", "common", "is_wrong"),
    [
        ((-0.2, -0.18), -0.19, True),
        ((0.2, 0.18), 0.19, True),
        ((-0.03, -0.03), -0.03, False),  # small
        ((-0.2, 0.6), -0.19, False),  # one joint shows another
    ],
)
def test_gains_are_wrong_where_all_joints_show_it(change, common, is_wrong):
    scale = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.006)
    assert scale.is_wrong is is_wrong
    unsure = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.07)
    assert not unsure.is_wrong


def test_the_last_unknowns_are_those_of_the_inverse(rng):
    A = rng.standard_normal((9, 5)) * [1.0, 1e3, 1.0, 1e-2, 10.0]
    H, x = A.T @ A, np.arange(1.0, 6.0)
    found, error = _last(H, H @ x, 2)
    np.testing.assert_allclose(found, x[3:], rtol=1e-8)
    np.testing.assert_allclose(error, np.sqrt(np.diag(np.linalg.inv(H)))[3:], rtol=1e-8)
    A[:, 4] = A[:, 0]  # the last is not distinguishable from the first, that before it is
    _, error = _last(A.T @ A, A.T @ A @ x, 2)
    left = np.linalg.inv(A[:, :4].T @ A[:, :4])
    assert error[0] == pytest.approx(np.sqrt(left[3, 3]), rel=1e-8)
    assert error[1] == np.inf
