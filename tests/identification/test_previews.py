"""What a preview expects is what many recordings with that noise show."""

import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
from helpers.fitting import identify
from helpers.synthetic import truth

from robotid.base.exceptions import SettingsError
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.design.previews import (
    Run,
    TorqueNoise,
    _band,
    _Information,
    assumed_noise,
    assumed_parameters,
    preview,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Factors, compress
from robotid.dynamics.prepared_logs import base_problem
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.torque import joint_torque_regressor, trajectory_regressor
from robotid.estimation.estimators.estimator import scatter
from robotid.estimation.fitting.recorded import hold_log
from robotid.output.files.entries import build_preview

STD = np.array([2.0, 3.0, 1.0, 0.3, 0.2, 0.1])  # [N m]
RATE, DURATION = 100.0, 12.0


def white(std=STD):
    return TorqueNoise(std, np.zeros(len(std)), ("stated",) * len(std))


def moved(model, rng, rate=RATE, period=DURATION):
    t = np.arange(round(DURATION * rate)) / rate
    q, v, a = random_fourier(model, rng, period=period).evaluate(t)
    return Log(t=t, q=q, tau=np.zeros_like(q), joints=model.joints), (q, v, a)


@pytest.fixture(scope="module")
def motion(ur5):
    return moved(ur5, np.random.default_rng(0))


@pytest.fixture(scope="module")
def recorded(ur5, motion):
    """The motion with the torques of another robot and noise."""
    log, state = motion
    torque = (joint_torque_regressor(ur5, *state) @ truth(ur5)).reshape(log.q.shape)
    noise = STD * np.random.default_rng(1).standard_normal(torque.shape)
    return replace(log, tau=torque + noise)


@pytest.fixture(scope="module")
def found(ur5, recorded):
    settings = SignalSettings(cutoff=15.0)
    return identify(ur5, [recorded], friction="none", estimator="wls", signals=settings)


@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_the_errors_expected_are_the_scatter_of_many_recordings(ur5, motion, colour):
    log, _ = motion
    time = 0.0 if colour == 0 else (1 + colour) / (1 - colour) / RATE
    noise = TorqueNoise(STD, np.full(6, time), ("stated",) * 6)
    ahead = preview(ur5, [log], noise=noise, estimator="wls")
    mapping, sigma = ahead.expected.mapping, ahead.expected.estimate.sigma
    rng, thetas = np.random.default_rng(2), []
    rows = hold_log(ur5, log, SignalSettings()).whole
    X = trajectory_regressor(ur5, rows.trajectory)[:, mapping.independent]
    weight = (rows.mask / sigma).ravel()
    least_squares = np.linalg.pinv(weight[:, None] * X)
    for _ in range(60):
        wild = rng.standard_normal((len(log.t) + 200, 6))
        wild = scipy.signal.lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], wild, axis=0)[200:]
        held = hold_log(ur5, replace(log, tau=STD * wild), SignalSettings())
        thetas.append(least_squares @ (weight * held.whole.trajectory.tau.ravel()))
    scatter = np.sqrt(np.mean(np.square(thetas), axis=0))
    ratio = ahead.base_error / scatter
    # a motion is not quite slow beside noise of 0.2 s, whose density falls from 1 Hz on
    assert np.median(ratio) == pytest.approx(1.0 if colour == 0 else 1.08, abs=0.06)
    assert ratio.min() > 0.7  # 60 runs tell a scatter to 9 %
    assert ratio.max() < 1.6


def test_motions_of_two_lengths_and_filters_tell_as_much_as_their_rows(model, rng):
    mapping = structural_mapping(model)
    logs = [moved(model, rng, period=period)[0] for period in (12.0, 7.0)]
    settings = SignalSettings(cutoff=5.0), SignalSettings(cutoff=20.0)
    held = [hold_log(model, log, s) for log, s in zip(logs, settings, strict=True)]
    held[1] = hold_log(model, logs[1].window(0.0, 4.0), settings[1])
    noise = TorqueNoise(STD[:3], np.array([0.0, 0.02, 0.5]), ("stated",) * 3)
    said = _Information.of(model, mapping, held, noise)
    density = STD[:3] ** 2 * np.maximum(noise.correlation, 1 / RATE)
    residuals, rows, meat = [], [], np.zeros((len(mapping.K), len(mapping.K)))
    for log in held:
        part = compress(base_problem(model, mapping, log.whole.trajectory, log.whole.mask))
        residuals.append(np.minimum(STD[:3] ** 2, density * _band(log)))
        rows.append(part.rows)
    sigma = np.sqrt(np.average(residuals, axis=0, weights=rows))
    np.testing.assert_allclose(said.sigma, sigma, rtol=1e-9)
    assert residuals[0][0] < residuals[1][0]  # a lower cut-off leaves less of white noise
    assert _band(held[1]) == pytest.approx(4 * _band(held[0]), rel=0.02)
    for log in held:
        t = log.whole.trajectory
        X = trajectory_regressor(model, t)[:, mapping.independent].reshape(len(t.t), 3, -1)
        weight = log.whole.mask * density * RATE / sigma**4
        meat += np.einsum("nj,nja,njb->ab", weight, X, X)
    np.testing.assert_allclose(said.meat(mapping.K, sigma), meat, rtol=1e-7, atol=1e-9)
    assert said.samples == sum(len(log.whole.trajectory.t) for log in held)
    assert said.share == pytest.approx(2 * 5.0 / RATE)
    np.testing.assert_allclose(said.squares, sum(log.whole.trajectory.squares for log in held))
    run = Run((said.factors,), np.zeros(len(mapping.names)), 2 * said.squares, 7, 0.01, 0.01)
    both = said.added_to(run)
    assert (both.samples, both.share) == (said.samples + 7, 0.01)
    np.testing.assert_allclose(both.squares, 3 * said.squares)
    np.testing.assert_array_equal(both.factors.rows, 2 * said.factors.rows)
    alone = replace(both, share=1.0).without_motions()
    assert (alone.share, alone.levels) == (0.01, ())
    np.testing.assert_array_equal(alone.factors.rows, said.factors.rows)


def test_bands_of_torques_are_root_mean_squares_over_all_motions(ur5):
    logs = [moved(ur5, np.random.default_rng(seed))[0] for seed in (4, 5)]
    logs[1] = logs[1].window(end=3.0)  # 12 s and 3 s
    found = preview(ur5, logs, noise=white(), estimator="wls")
    mapping, covariance = found.expected.mapping, found.expected.wls.covariance
    variance, torque = [], []
    for e, band in zip(found.expected.fitted, found.bands, strict=True):
        one = e.recording.trajectory.at(band.samples)
        W = joint_torque_regressor(ur5, one.q, one.v, one.a, one.direction)
        W = W[:, mapping.independent]
        variance.append(np.sum(W @ covariance * W, axis=1).reshape(-1, 6))
        torque.append(e.recording.trajectory.tau)
    size = np.sqrt(np.mean(np.concatenate(variance), axis=0))
    rms = np.sqrt(np.mean(np.concatenate(torque) ** 2, axis=0))
    whole = np.hypot(size, found.expected.estimate.sigma)
    for j, told in enumerate(build_preview(found)["torque"].values()):
        assert told["of_parameters"] == pytest.approx(1.96 * size[j], rel=1e-4)
        assert told["half_width"] == pytest.approx(1.96 * whole[j], rel=1e-4)
        assert told["rms"] == pytest.approx(rms[j])


def test_a_run_before_adds_what_it_said_and_its_noise(ur5, motion, found):
    log = motion[0]
    ahead = preview(ur5, [log], given=found, estimator="wls")
    rows, before = (x.fitted[0].recording for x in (ahead.expected, found))
    np.testing.assert_array_equal(rows.mask, before.mask)  # the settings of the run
    np.testing.assert_allclose(rows.trajectory.a, before.trajectory.a, rtol=1e-9)
    assert set(ahead.noise.origins) == {"found"}
    density = np.sqrt(ahead.noise.density(0.0) * RATE)
    np.testing.assert_allclose(density, STD, rtol=0.35)  # 48 segments
    np.testing.assert_allclose(ahead.before, found.wls.std_error, rtol=0.1)
    # as much again: the errors fall by about a root of 2
    assert np.median(ahead.gain) == pytest.approx(np.sqrt(2.0), abs=0.1)
    other = moved(ur5, np.random.default_rng(5))[0]
    assert (preview(ur5, [other], given=found, estimator="wls").gain >= 1.0).all()
    same = {"noise": ahead.noise, "estimator": "wls", "signals": found.stated.signals}
    alone = preview(ur5, [log], **same).base_error
    together = 1.0 / np.sqrt(ahead.before**-2 + alone**-2)
    np.testing.assert_allclose(ahead.base_error, together, rtol=0.25)


def test_noise_is_stated_or_a_hundredth_of_the_largest_torque(ur5):
    size = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
    noise = assumed_noise(ur5, size, {"elbow_joint": 0.7})
    np.testing.assert_allclose(noise.std, [1.5, 1.5, 0.7, 0.28, 0.28, 0.28])
    np.testing.assert_array_equal(noise.correlation, 0.1)
    assert noise.origins[2] == "stated"
    assert set(noise.origins) == {"stated", "assumed"}
    before = TorqueNoise(STD, np.full(6, 0.3), ("found",) * 6)
    slow = assumed_noise(ur5, size, {"elbow_joint": 0.7}, 0.03)
    np.testing.assert_array_equal(slow.correlation, 0.03)  # of what is assumed, too
    told = assumed_noise(ur5, size, {"elbow_joint": 0.7}, 0.0, before)
    np.testing.assert_allclose(told.std, [2.0, 3.0, 0.7, 0.3, 0.2, 0.1])
    np.testing.assert_array_equal(told.correlation, [0.3, 0.3, 0.0, 0.3, 0.3, 0.3])
    with pytest.raises(SettingsError, match="Did you mean 'elbow_joint'"):
        assumed_noise(ur5, size, {"elbow": 0.7})
    for value in (-1.0, 1e160, 1e-300):
        with pytest.raises(SettingsError, match=re.escape(f"is {value}, expected 1e-09")):
            assumed_noise(ur5, size, {"elbow_joint": value})
    with pytest.raises(SettingsError, match="correlation is -1 s"):
        assumed_noise(ur5, size, {}, -1.0)


def test_assumed_friction_is_a_twentieth_of_the_torque_at_the_speed_of_each_joint(model):
    unlimited = tuple(replace(joint, velocity=np.inf) for joint in model.tree.joints)
    model = replace(model, tree=replace(model.tree, joints=unlimited))
    pi = dict(zip(model.layout.names, assumed_parameters(model, STD[:3], STD[3:]), strict=True))
    for joint, size, fastest in zip(model.joints, STD[:3], STD[3:], strict=True):
        assert pi[f"{joint}.coulomb"] == pytest.approx(0.05 * size)
        assert pi[f"{joint}.viscous"] == pytest.approx(0.05 * size / fastest)


def test_noise_of_a_long_run_has_the_scatter_of_each_joint_s_own_scores(rng):
    """Of 14 segments of two joints, the second of which is coloured; weights by its variance."""
    W = rng.standard_normal((14, 2, 1, 3)) + 0.5 * rng.standard_normal((14, 2, 25, 3))
    W *= [1.0, 3.0, 0.5]
    pi = np.array([0.4, -1.1, 2.0])
    e = rng.standard_normal((14, 2, 25)) * [[0.5], [2.0]]
    e[:, 1] += 1.5 * rng.standard_normal((14, 1))
    rows = np.concatenate([W, (W @ pi + e)[..., None]], axis=3)
    every, names = (np.arange(3),) * 2, ("a", "b", "c")
    segments = tuple(
        Factors(tuple(np.linalg.qr(own, mode="r")), every, np.array([25, 25]), names)
        for own in rows
    )
    run = Run(segments, pi, np.zeros((3, 2)), 350, 0.2, 0.03)
    K = np.eye(3)
    found = run.noise(K)
    sigma = np.sqrt(np.mean(e**2, axis=(0, 2)))
    X = [W[:, j].reshape(-1, 3) / sigma[j] for j in (0, 1)]
    bread = np.linalg.inv(X[0].T @ X[0] + X[1].T @ X[1])
    free, inflation = np.empty(2), np.empty(2)
    for j in (0, 1):
        alone = np.where(np.arange(2) == j, sigma, np.inf)
        own = np.diag(bread @ X[j].T @ X[j] @ bread)
        ratio = np.diag(scatter(segments, pi, alone, bread).covariance) / own
        weight = own / np.diag(bread)
        inflation[j] = np.prod(ratio ** (weight / weight.sum()))
        free[j] = 1 - np.trace(X[j] @ bread @ X[j].T) / 350
    assert inflation[1] > 3 * inflation[0]
    np.testing.assert_allclose(found.std, sigma / np.sqrt(free), rtol=1e-9)
    np.testing.assert_allclose(found.correlation, free * inflation * 0.03, rtol=1e-9)
    level = np.array([0.7, 1.3])
    X = [W[:, j].reshape(-1, 3) / level[j] for j in (0, 1)]
    B = np.linalg.inv(X[0].T @ X[0] + X[1].T @ X[1])
    np.testing.assert_allclose(run.meat(K, level), scatter(segments, pi, level, B).meat, rtol=1e-9)
    short = replace(run, segments=segments[:11])
    X = [W[:11, j].reshape(-1, 3) / level[j] for j in (0, 1)]
    np.testing.assert_allclose(short.meat(K, level), (X[0].T @ X[0] + X[1].T @ X[1]) / 0.2)
