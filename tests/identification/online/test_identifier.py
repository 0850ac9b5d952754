import copy
from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import exact_log, payload_log, truth

from robotid.base.exceptions import DataError
from robotid.identification.online import (
    ChangeDetector,
    Innovations,
    LiveSignals,
    OnlineIdentifier,
    OnlineSettings,
    load_spread,
    payload_of,
)


def run(identifier, log, start=0, end=None):
    for k in range(start, len(log.t) if end is None else end):
        identifier.update(log.t[k], log.q[k], log.tau[k])
    return identifier


@pytest.fixture(scope="module")
def picked_up(panda):
    """Return an identifier after its log, and its estimates by time before the load."""
    log, identifier = payload_log(panda, np.random.default_rng(0)), OnlineIdentifier(panda)
    before = {}
    for k in range(len(log.t)):
        run(identifier, log, k, k + 1)
        if 9.0 < log.t[k] < 10.5:
            before[identifier.reading.t] = identifier.reading.theta
    return before, identifier


def test_a_load_picked_up_at_ten_seconds_is_flagged_and_weighed(picked_up):
    before, identifier = picked_up
    assert len(identifier.changes) == 1
    (change,) = identifier.changes
    assert 10.0 < change.flagged < 10.3
    assert change.onset == pytest.approx(10.0, abs=0.05)
    [at] = [t for t, x in before.items() if (x == change.theta).all() and t < change.onset]
    assert 0.0 <= change.onset - identifier.delay - at < 0.12  # the last of each tenth of a second
    load = identifier.payload()
    assert load.mass == pytest.approx(2.0, abs=0.06)
    assert load.mass_std_error < 0.03
    assert load.parameters[3] / load.mass == pytest.approx(0.1, abs=0.01)  # 10 cm behind
    with pytest.raises(DataError, match="there is no change 1: 1 were flagged"):
        identifier.payload(1)


def test_what_the_data_leave_of_the_prior_is_the_mean_share_of_variances(picked_up):
    _, identifier = picked_up
    reading = identifier.reading
    share = reading.std_error**2 / identifier._prior_variance
    assert reading.excitation == pytest.approx(1.0 - np.minimum(share, 1.0).mean())
    # a walk of the parameters does not take away more than the prior gave
    lost = copy.copy(identifier)
    lost._state = replace(identifier._state, P=np.diag(identifier._prior_variance))
    lost._state.P[2, 2] *= 9.0
    assert lost.reading.excitation == pytest.approx(0.0)
    # after a change a load may have come, and all the rest may be off by a tenth of its spread
    size = identifier.model.layout.n_inertial
    KL = identifier.mapping.K[:, size - 10 : size] * identifier._load_spread
    wanted = np.sum(KL**2, axis=1) + 0.01 * identifier._prior_variance
    np.testing.assert_allclose(np.diag(identifier._reopening), wanted)
    # behind the filter two rows per period of the cut-off are independent
    s = identifier.settings
    step = max(1, int(s.rate / (12.0 * s.cutoff))) / s.rate
    assert identifier._share == pytest.approx(min(1.0, 2.0 * s.cutoff * step))


def test_smooth_motion_can_be_given_as_it_is(ur5, rng):
    noise = np.array([4.0, 2.0, 1.0, 0.3, 0.2, 0.1])
    log = exact_log(ur5, truth(ur5), rng, samples=2000, rate=50.0, noise=0.1 * noise)
    # a cut-off of 2 Hz would leave two of three filtered samples out; these are all taken
    identifier = OnlineIdentifier(ur5, OnlineSettings(rate=50.0, cutoff=2.0))
    for k in range(len(log.t)):
        identifier.update(log.t[k], log.q[k], log.v[k], log.a[k], log.tau[k])
    reading = identifier.reading
    assert identifier.delay == 0.0
    assert reading.t == log.t[-1]
    assert identifier.changes == ()
    assert identifier.estimate.n_iter == len(log.t)
    # each sample is a step of its own
    assert identifier._share == pytest.approx(2 * 2.0 / 50.0)
    assert identifier._kalman.walk == pytest.approx(1e-4 / np.sqrt(50.0))
    error = np.abs(reading.theta - identifier.mapping.to_base(truth(ur5))) / reading.std_error
    assert np.sqrt(np.mean(error**2)) < 1.5
    np.testing.assert_allclose(reading.sigma, 0.1 * noise, rtol=0.3)


def test_a_bad_sample_is_refused_without_harm(ur5, rng):
    log = exact_log(ur5, truth(ur5), rng, samples=600, rate=200.0)
    clean, disturbed = OnlineIdentifier(ur5), OnlineIdentifier(ur5)
    run(clean, log)
    bad = np.full(6, np.nan)
    for k in range(len(log.t)):
        disturbed.update(log.t[k], log.q[k], log.tau[k])
        with pytest.raises(DataError, match="is not finite; leave it out"):
            disturbed.update(log.t[k] + 1e-3, bad, log.tau[k])
    np.testing.assert_array_equal(disturbed.reading.theta, clean.reading.theta)
    with pytest.raises(DataError, match=r"update takes \(t, q, tau\) or .* found 4 values"):
        clean.update(9.0, log.q[0], log.q[0], log.q[0])
    with pytest.raises(DataError, match="t must increase"):
        clean.update(log.t[-1], log.q[0], log.q[0], log.q[0], log.tau[0])
    with pytest.raises(DataError, match="is not finite; leave it out"):
        clean.update(9.0, log.q[0], bad, log.q[0], log.tau[0])
    with pytest.raises(DataError, match=r"expected \(6,\) each"):
        clean.update(9.0, log.q[0], bad[:5], log.q[0], log.tau[0])
    with pytest.raises(DataError, match="t must increase"):
        clean.update(log.t[-1], log.q[0], log.tau[0])


def test_before_the_robot_has_moved_there_is_no_estimate(ur5):
    identifier = OnlineIdentifier(ur5)
    for k in range(400):
        identifier.update(k / 200.0, np.zeros(6), np.ones(6))
    assert not identifier.is_ready
    with pytest.raises(
        DataError, match=r"the robot has moved for 0\.00 s, and the warm-up needs 1 s of motion"
    ):
        _ = identifier.reading
    with pytest.raises(DataError, match="there is no change -1: 0 were flagged"):
        identifier.payload()
    # of two hundred instants a second every other one is a step; one joint that moves is enough
    signals, seen = LiveSignals(6, 200.0, 8.0, np.zeros(6, dtype=bool)), 0
    identifier = OnlineIdentifier(ur5)
    for k in range(140):
        q = np.append(np.zeros(5), k / 200.0)
        seen += len(list(signals.push(k / 200.0, q, np.ones(6))))
        identifier.update(k / 200.0, q, np.ones(6))
    assert seen > 80
    with pytest.raises(DataError, match=rf"moved for {seen // 2 / 100:.2f} s, and the warm-up"):
        _ = identifier.reading
    # the instants of the warm-up are processed as if their own samples had just come
    steps, identifier._step = [], lambda instant, now: steps.append(now - instant[0])
    for k in range(140, 300):
        identifier.update(k / 200.0, np.append(np.zeros(5), k / 200.0), np.ones(6))
    assert len(steps) > 100
    np.testing.assert_allclose(steps, identifier.delay, atol=1e-9)


FIXED = np.array([False])


def instants_of(signals, t, q, tau):
    found = [i for k in range(len(t)) for i in signals.push(t[k], q[k], tau[k])]
    return [np.array(x) for x in zip(*found, strict=True)]


def test_the_delay_is_as_stated_and_the_same_for_motion_and_torque():
    w = 2 * np.pi  # [rad/s]
    t = np.arange(3000) * 1e-3
    signals = LiveSignals(1, 1000.0, 8.0, FIXED)
    at, q, v, a, tau = instants_of(signals, t, np.sin(w * t)[:, None], np.cos(2 * w * t)[:, None])
    # 1 and 2 Hz of 8 Hz: the amplitude is 0.5 and 2 % low, the phase is right to 1 ms
    np.testing.assert_allclose(q[:, 0], np.sin(w * at), atol=0.006)
    np.testing.assert_allclose(v[:, 0], w * np.cos(w * at), atol=0.006 * w)
    np.testing.assert_allclose(a[-1000:, 0], -(w**2) * np.sin(w * at[-1000:]), atol=0.006 * w**2)
    np.testing.assert_allclose(tau[:, 0], np.cos(2 * w * at), atol=0.025)


def test_uneven_time_stamps_are_put_on_the_grid(rng):
    t = np.arange(3000) * 1e-3 + rng.uniform(-4e-4, 4e-4, 3000)
    signals = LiveSignals(1, 1000.0, 8.0, FIXED)
    at, q, *_ = instants_of(signals, t, np.sin(6 * t)[:, None], np.zeros((3000, 1)))
    np.testing.assert_allclose(np.diff(at), 1e-3, rtol=1e-9)
    np.testing.assert_allclose(q[:, 0], np.sin(6 * at), atol=0.006)


def test_nothing_is_filtered_across_a_gap():
    t = np.concatenate([np.arange(1000), 3000 + np.arange(1000)]) * 1e-3
    q = np.where(t < 2, 1.0, 2.0)[:, None]
    at, found, v, *_ = instants_of(LiveSignals(1, 1000.0, 8.0, FIXED), t, q, 0 * q)
    assert not ((at > 1.0) & (at < 3.0)).any()
    np.testing.assert_allclose(v, 0.0, atol=1e-8)
    np.testing.assert_allclose(found[:, 0], np.where(at < 2, 1.0, 2.0), atol=1e-9)


@pytest.mark.parametrize(
    ("rate", "cutoff", "longest"),
    [(1000.0, 8.0, 0.25 / 8.0), (100.0, 20.0, 2.5 / 100.0)],  # of a period, of the samples
)
def test_a_pause_is_a_gap_from_a_quarter_period_or_two_and_a_half_samples_on(rate, cutoff, longest):
    for pause, is_gap in ((0.9 * longest, False), (1.1 * longest, True)):
        t = np.arange(800) / rate
        t[400:] += pause - 1 / rate
        signals = LiveSignals(1, rate, cutoff, FIXED)
        at, *_ = instants_of(signals, t, 0.5 + t[:, None], t[:, None])
        assert (np.diff(at).max() > 1.5 / rate) == is_gap


def test_full_turns_are_taken_out_of_joints_that_turn_freely():
    t = np.arange(2000) * 1e-3
    wrapped = (np.pi + 4 * t) % (2 * np.pi) - np.pi
    _, _, v, *_ = instants_of(
        LiveSignals(1, 1000.0, 8.0, np.array([True])), t, wrapped[:, None], 0 * t[:, None]
    )
    np.testing.assert_allclose(v[500:], 4.0, atol=0.01)
    # and of no others
    both, alone = (
        instants_of(LiveSignals(len(turns), 1000.0, 8.0, np.array(turns)), t, q, 0 * q)
        for turns, q in (
            ([True, False], np.column_stack(2 * [wrapped])),
            ([False], wrapped[:, None]),
        )
    )
    np.testing.assert_allclose(both[2][:, 0], v[:, 0], atol=1e-9)
    np.testing.assert_allclose(both[2][:, 1], alone[2][:, 0], atol=1e-9)
    assert np.abs(alone[2]).max() > 50.0


def test_noise_alone_is_no_change_and_a_shift_is_flagged_where_it_began(rng):
    detector = ChangeDetector(3, 40.0)
    for k in range(20_000):
        assert detector.push(k * 0.1, rng.standard_normal(3) ** 2, 1.0) is None
    flagged = None
    for k in range(20_000, 20_100):
        e = rng.standard_normal(3) + np.array([0.0, 4.0, 0.0])
        flagged = detector.push(k * 0.1, e**2, 1.0)
        if flagged is not None:
            break
    assert flagged == pytest.approx(2000.0, abs=0.3)
    assert k - 20_000 < 10
    np.testing.assert_array_equal(detector.evidence, 0.0)


def innovations(n=1, model_error=0.0):
    return Innovations(np.full(n, 10.0), 0.01, model_error, ChangeDetector(n, 40.0))


def test_a_row_that_is_not_used_teaches_nothing():
    monitor = innovations(2)
    before = monitor.variance.copy()
    e = np.array([100.0, 0.01])
    monitor.push(0.0, e, e, e, np.zeros(2), np.array([False, True]), 1.0)
    assert monitor.variance[0] == before[0]
    assert monitor.variance[1] < before[1]
    assert np.isinf(monitor.ratio[0])
    # one row that is open is enough not to have converged
    assert monitor.ratio[1] == 0.0
    assert not monitor.is_converged
    monitor.push(0.01, e, e, e, np.zeros(2), np.array([True, False]), 1.0)
    assert monitor.is_converged


@pytest.mark.parametrize(("model_error", "is_flagged"), [(0.0, True), (0.1, False)])
def test_what_a_model_may_miss_is_no_change(model_error, is_flagged):
    monitor, used = innovations(model_error=model_error), np.array([True])
    flagged, tau = False, np.array([10.0])
    for k in range(500):
        monitor.push(0.01 * k, tau, 0.1 * np.ones(1), 0.1 * np.ones(1), np.zeros(1), used, 0.2)
    for k in range(500, 700):
        e = np.ones(1)  # a tenth of the torque
        flagged |= monitor.push(0.01 * k, tau, e, e, np.zeros(1), used, 0.2) is not None
    assert flagged is is_flagged


def test_the_noise_and_what_the_parameters_leave_open_are_their_recursions(rng):
    rms, dt, memory, model_error = np.array([10.0, 3.0]), 0.05, 5.0, 0.2
    detector = ChangeDetector(2, 1e9)
    monitor = Innovations(rms, dt, model_error, detector)
    variance, torque, seen = 0.01 * rms**2, rms**2, np.full(2, 20.0)
    open_, evidence = np.full(2, np.inf), np.zeros(2)
    for k in range(160):
        used = rng.uniform(size=2) < 0.8
        tau, e, residual = rng.standard_normal((3, 2)) * [[8.0, 2.0]]
        doubt = rng.uniform(0.0, 0.45, 2) * variance
        for j in range(2):
            expected = doubt[j] + variance[j] + model_error**2 * torque[j]
            if used[j] and open_[j] < 0.25:
                more = 0.3 * (min(e[j] ** 2 / expected, 25.0) - 4.0)
                evidence[j] = max(evidence[j] + more, 0.0)
        monitor.push(dt * k, tau, e, residual, doubt, used, 0.3)
        for j in np.flatnonzero(used):
            product = np.clip(e[j] * residual[j], 0.0, 9.0 * (doubt[j] + variance[j]))
            ratio = doubt[j] / variance[j]
            seen[j] = min(seen[j] + 1.0, memory / dt)
            torque[j] += (tau[j] ** 2 - torque[j]) / seen[j]
            variance[j] += (product - variance[j]) / seen[j]
            open_[j] = ratio if np.isinf(open_[j]) else open_[j] + dt * (ratio - open_[j])
        np.testing.assert_allclose(monitor.variance, variance)
        np.testing.assert_allclose(monitor.ratio, open_)
        np.testing.assert_allclose(detector.evidence, evidence)
        assert monitor.is_converged == (open_ < 0.25).all()
    assert evidence.max() > 0.0
    assert monitor.is_converged
    monitor.forget_convergence()
    assert not monitor.is_converged


def test_a_load_is_the_generalised_least_squares_of_its_change_about_none(rng):
    columns, root = rng.standard_normal((30, 10)), rng.standard_normal((30, 30))
    C, spread = 0.1 * root @ root.T, np.linspace(0.5, 3.0, 10)
    change = rng.standard_normal(30)
    found = payload_of(change, C, columns, spread)
    H = np.diag(spread**-2.0) + columns.T @ np.linalg.solve(C, columns)
    wanted = np.linalg.solve(H, columns.T @ np.linalg.solve(C, change))
    np.testing.assert_allclose(found.parameters, wanted)
    np.testing.assert_allclose(found.std_error, np.sqrt(np.diag(np.linalg.inv(H))))
    bodies = np.concatenate([[4.0, *[1.0] * 9], [2.0, 0.2, 0.6, 0.1, *[1.0] * 6]])
    np.testing.assert_allclose(load_spread(bodies), 3.0 * np.repeat([1.0, 0.6, 0.36], [1, 3, 6]))
