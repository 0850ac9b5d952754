"""Spectrum against brute force and closed form; friction against the truth."""

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.torque_split import friction_split, spectrum
from robotid.estimation.fitting.evaluation import evaluate_logs
from robotid.estimation.fitting.recorded import hold_log


def test_the_spectrum_s_integral_is_the_mean_square_of_the_rows_used(rng):
    x, segment = 3.0 * rng.standard_normal(30_000), np.repeat([0, 1], [20_000, 10_000])
    used = rng.random(len(x)) > 0.4
    for dt in (0.01, 0.002):
        f, S = spectrum(x, used, segment, dt, length=200 * dt)
        assert np.sum(S) * f[1] == pytest.approx(9.0, rel=0.03)
        # white: half the rate holds it evenly
        assert np.median(S) == pytest.approx(9.0 * 2 * dt, rel=0.1)


def test_the_spectrum_equals_that_of_scipy_where_no_row_is_left_out(rng):
    from scipy.signal import welch

    x = rng.standard_normal(1000)
    window = np.hanning(202)[1:-1]
    ours = spectrum(x, np.ones(1000, bool), np.zeros(1000), 0.01, length=2.0)
    theirs = welch(x, 100.0, window=window, noverlap=100, detrend=False)
    np.testing.assert_allclose(ours[0], theirs[0], atol=1e-12)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-10)


def test_a_window_never_crosses_a_gap():
    """Two halves of a sine whose phase turns by pi in the gap: the peak stays one line."""
    t = np.arange(2000) / 100.0
    x = np.sin(2 * np.pi * 5.0 * t) * np.where(t < 10.0, 1.0, -1.0)
    f, S = spectrum(x, np.ones(2000, bool), (t >= 10.0).astype(int), 0.01, length=4.0)
    assert f[np.argmax(S)] == pytest.approx(5.0)
    assert S[np.abs(f - 5.0) > 1.0].max() < 1e-4 * S.max()


def test_no_used_row_gives_no_spectrum():
    f, S = spectrum(np.ones(50), np.zeros(50, bool), np.zeros(50), 0.01)
    assert len(f) == len(S) == 0


def test_friction_is_the_torque_that_viscous_coulomb_and_offset_add(ur5, rng):
    pi = truth(ur5)
    log = hold_log(ur5, exact_log(ur5, pi, rng), SignalSettings(cutoff=None))
    ((evaluation,), ()) = evaluate_logs([log], (), {"estimate": pi}, ur5.standard_parameters())
    left, friction = friction_split(ur5, evaluation, pi)
    value = dict(zip(ur5.layout.names, pi, strict=True))
    v = evaluation.recording.trajectory.v
    for j, name in enumerate(ur5.joints):
        known = (
            value[f"{name}.viscous"] * v[:, j]
            + value[f"{name}.coulomb"] * np.sign(v[:, j])
            + value[f"{name}.offset"]
        )
        np.testing.assert_allclose(friction[:, j], known, atol=1e-9)
        np.testing.assert_allclose(left[:, j], known, atol=1e-9)
