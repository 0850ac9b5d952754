from dataclasses import replace

import numpy as np
import pytest
from helpers.fitting import identify
from helpers.synthetic import exact_log, truth

from robotid.export.entries import build_result
from robotid.fitting.bands import TorqueBand, expected_band, recording_bands, torque_band
from robotid.fitting.settings import EstimatorSettings
from robotid.logs.settings import SignalSettings
from robotid.regressor.torque import joint_torque_regressor

NOISE = np.array([2.0, 2.0, 1.0, 0.3, 0.3, 0.1])


@pytest.fixture(scope="module", params=["wls", "consistent"])
def found(request, ur5):
    rng = np.random.default_rng(3)
    pi = truth(ur5)
    fitted = exact_log(ur5, pi, rng, samples=1500, noise=NOISE)
    kept = exact_log(ur5, pi, rng, samples=1200, noise=NOISE)
    settings = SignalSettings(cutoff=None, trim=0.0)
    estimator = EstimatorSettings(request.param)
    return identify(ur5, [fitted], validation=[kept], signals=settings, estimator=estimator), pi


def test_a_band_is_the_spread_of_predictions_of_parameters_drawn_from_the_covariance(ur5, found):
    identification, _ = found
    (evaluation,) = identification.validation
    motion = evaluation.recording.trajectory
    K = identification.mapping.K
    C = K @ identification.standard_covariance @ K.T
    band = torque_band(ur5, identification.mapping, motion, C, np.zeros(6))
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(np.zeros(len(C)), C, size=4000, method="svd")
    k = band.samples[[10, 200]]
    W = joint_torque_regressor(ur5, motion.q[k], motion.v[k], motion.a[k])
    spread = (W[:, identification.mapping.independent] @ drawn.T).std(axis=1).reshape(2, 6)
    np.testing.assert_allclose(band.parameters[[10, 200]], spread, rtol=0.06)


def test_bands_hold_95_percent_of_the_torques_of_a_new_motion(found):
    identification, _ = found
    (evaluation,) = identification.validation
    recording, band = evaluation.recording, identification.band(evaluation)
    share = band.held(recording.trajectory.tau, evaluation.torques["estimate"], recording.mask)
    assert ((share > 0.91) & (share < 0.99)).all(), share
    np.testing.assert_allclose(band.noise, NOISE, rtol=0.1)


def test_the_noise_of_a_band_is_what_recordings_of_its_kind_leave(ur5):
    """Kept rows that miss by more than fitted ones widen their own bands, joint by joint."""
    rng, pi = np.random.default_rng(4), truth(ur5)
    logs = [exact_log(ur5, pi, rng, samples=600, noise=NOISE) for _ in range(3)]
    worse = [
        replace(log, tau=log.tau + rng.normal(0, [0, 4.0, 0, 0, 0, 0], log.tau.shape))
        for log in logs[1:]
    ]
    settings = SignalSettings(cutoff=None, trim=0.0)
    found = identify(ur5, logs[:1], validation=worse, signals=settings, estimator="wls")
    fitted, *kept = (found.band(e) for e in (*found.fitted, *found.validation))
    np.testing.assert_array_equal(kept[0].noise, kept[1].noise)
    assert fitted.noise[1] == pytest.approx(NOISE[1], rel=0.15)
    assert kept[0].noise[1] == pytest.approx(np.hypot(NOISE[1], 4.0), rel=0.1)
    assert kept[0].noise[2] == pytest.approx(NOISE[2], rel=0.15)
    for e in found.validation:
        recording = e.recording
        share = found.band(e).held(recording.trajectory.tau, e.torques["estimate"], recording.mask)
        assert ((share > 0.93) & (share < 0.97)).all(), share
    np.testing.assert_array_equal(expected_band(found, found.fitted[0]).noise, found.estimate.sigma)


def test_a_validation_log_that_was_fitted_has_the_noise_of_the_fitted_ones(found):
    identification, _ = found
    (kept,) = identification.validation
    again = replace(identification, validation=(replace(kept, is_refitted=True),))
    bands = recording_bands(again)
    np.testing.assert_array_equal(bands[0].noise, bands[1].noise)
    for j in range(6):  # the least that holds 95 % of the rows of both
        needed = []
        for band, e in zip(bands, (*again.fitted, kept), strict=True):
            k = band.samples
            residual = (e.recording.trajectory.tau - e.torques["estimate"])[k, j]
            used = e.recording.mask[k, j].astype(bool)
            needed.append(((residual / 1.96) ** 2 - band.parameters[:, j] ** 2)[used])
        wanted = np.sqrt(np.quantile(np.concatenate(needed), 0.95))
        assert bands[0].noise[j] == pytest.approx(wanted)
    apart = recording_bands(identification)
    assert (apart[0].noise != apart[1].noise).all()


def test_intervals_hold_the_truth(found):
    identification, pi = found
    low, high = identification.base_interval.T
    beta = identification.mapping.to_base(pi)
    assert np.mean((low <= beta) & (beta <= high)) > 0.85
    assert np.mean((low <= beta) & (beta <= high)) < 1.0


def test_result_json_states_bands_intervals_and_method(found):
    identification, _ = found
    result = build_result(identification, {})
    assert result["uncertainty"]["stretches"] in (47, 48)
    assert 0.5 < result["uncertainty"]["inflation"] < 2
    band = result["validation"][0]["band"]["elbow_joint"]
    assert band["half_width"] == pytest.approx(1.96 * 1.0, rel=0.15)
    assert 0 < band["of_parameters"] < band["half_width"]
    assert 91 < band["held_pct"] < 99
    low, high = result["base_parameters"][0]["interval_95"]
    assert low < result["base_parameters"][0]["value"] < high


def test_a_row_on_the_edge_of_the_band_lies_in_it():
    band = TorqueBand(np.arange(3), np.zeros((3, 1)), np.ones(1))
    edge = 1.96 * np.array([[1.0 + 1e-12], [1.0 + 1e-6], [0.5]])
    assert band.held(edge, np.zeros((3, 1)), np.ones((3, 1), bool)) == pytest.approx(2 / 3)


def test_rows_that_are_not_used_do_not_count():
    band = TorqueBand(np.array([0, 2]), np.zeros((2, 2)), np.ones(2))
    tau = np.array([[0.0, 9.0], [50.0, 50.0], [9.0, 9.0]])
    mask = np.array([[True, False], [True, True], [True, False]])
    share = band.held(tau, np.zeros((3, 2)), mask)
    assert share[0] == 0.5
    assert np.isnan(share[1])
