import copy
from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import exact_log, payload_log, truth

from robotid.base.exceptions import DataError
from robotid.identification.online import LiveSignals, OnlineIdentifier, OnlineSettings


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
        with pytest.raises(DataError, match="is not finite, so it was refused"):
            disturbed.update(log.t[k] + 1e-3, bad, log.tau[k])
    np.testing.assert_array_equal(disturbed.reading.theta, clean.reading.theta)
    with pytest.raises(DataError, match=r"update takes \(t, q, tau\) or .* found 4 values"):
        clean.update(9.0, log.q[0], log.q[0], log.q[0])
    with pytest.raises(DataError, match="t must increase"):
        clean.update(log.t[-1], log.q[0], log.q[0], log.q[0], log.tau[0])
    with pytest.raises(DataError, match="is not finite, so it was refused"):
        clean.update(9.0, log.q[0], bad, log.q[0], log.tau[0])
    with pytest.raises(DataError, match=r"wanted \(6,\) each"):
        clean.update(9.0, log.q[0], bad[:5], log.q[0], log.tau[0])
    with pytest.raises(DataError, match=r"q, tau have shapes \(6,\), \(5,\), wanted \(6,\) each"):
        clean.update(9.0, log.q[0], log.tau[0][:5])
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
