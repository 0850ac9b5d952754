from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.findings import Figures
from helpers.fitting import fit, identify
from helpers.synthetic import truth

from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.verdict.fit_findings import encoder_noise
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import join
from robotid.dynamics.simulation.motions import random_fourier
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.estimators import OLS, WLS
from robotid.estimation.fitting import regressor_noise
from robotid.estimation.fitting.recorded import Recordings, hold_log
from robotid.estimation.fitting.regressor_noise import (
    acceleration_noise,
    find_regressor_noise,
    rounding_errors,
    smoothed,
    without_noise,
)
from robotid.estimation.fitting.standard_errors import measured_errors

RATE, STEP = 200.0, 2 * np.pi / 2**11  # [Hz], [rad]
SIGNALS = SignalSettings(velocity="differentiated")


@pytest.fixture(scope="module")
def motion(planar):
    """Times, positions and exact torques of 24 s; no rounding error is like one before."""
    return exact(planar, period=8.00372)


def exact(model, period):
    t = np.arange(round(24 * RATE)) / RATE
    q, v, a = random_fourier(model, np.random.default_rng(3), period=period).evaluate(t)
    return t, q, (joint_torque_regressor(model, q, v, a) @ truth(model)).reshape(v.shape)


def recorded(model, motion, *, step=STEP, noise=0.01, seed=0, **more):
    """Return what encoders whose zeros lie anywhere, and noisy torque sensors log of a motion."""
    (t, q, tau), rng = motion, np.random.default_rng([5, seed])
    zero = rng.random(q.shape[1]) * step
    rounded = q if step == 0 else np.round((q + zero) / step) * step - zero
    noisy = tau + noise * np.std(tau, axis=0) * rng.standard_normal(tau.shape)
    return Log(t=t, q=rounded, tau=noisy, joints=model.joints, **more)


def fitted(model, *logs):
    """Return recordings, what they come down to, and weighted least squares on them."""
    held = [hold_log(model, log, SIGNALS) for log in logs]
    recordings = Recordings(model, structural_mapping(model), held)
    parts = recordings.reduce()
    whole = join(parts)
    return recordings, parts, whole, WLS(independent_share=recordings.share).fit(whole.factors)


def found_in(model, *logs):
    recordings, _, whole, wls = fitted(model, *logs)
    return find_regressor_noise(recordings, whole, wls.theta, wls.sigma, wls.sigma)


@pytest.mark.parametrize(("cutoff", "order"), [(8.0, 4), (20.0, 2), (None, 4)])
def test_noise_of_an_acceleration_is_that_of_noisy_positions_behind_the_filter(cutoff, order):
    rng, settings = np.random.default_rng(0), SignalSettings(rate=RATE, cutoff=cutoff, order=order)
    t = np.arange(20_000) / RATE
    noise = rng.standard_normal((len(t), 2))
    log = Log(t=t, q=noise, tau=noise, joints=("a", "b"))
    size = np.std(process(log, replace(settings, velocity="differentiated")).a)
    assert acceleration_noise(1 / RATE, settings) == pytest.approx(size, rel=0.03)


def test_rounding_errors_are_those_of_any_zero_of_the_encoder():
    t, rng = np.arange(8000) / RATE, np.random.default_rng(0)
    q = np.column_stack([np.sin(t), np.sin(1.3 * t), 0.4 * (t < 20)])
    steps = np.array([0.01, 0.0, 0.002])
    draws = [rounding_errors(q, steps, rng) for _ in range(40)]
    errors, true = draws[0], np.round(q[:, 0] / 0.01) * 0.01 - q[:, 0]
    assert (np.abs(errors).max(axis=0) <= 0.5 * steps * (1 + 1e-9)).all()
    assert np.std(errors[:, 0]) == pytest.approx(0.01 / np.sqrt(12), rel=0.05)
    # each is like the true one at some zero, all together are not
    assert abs(np.mean([np.corrcoef(e[:, 0], true)[0, 1] for e in draws])) < 0.1
    assert not errors[:, 1].any()
    assert np.ptp(errors[:4000, 2]) == 0.0  # at rest


def test_smoothed_positions_are_nearer_to_the_truth_and_at_most_a_step_from_what_was_read():
    t = np.arange(4000) / RATE
    q = np.column_stack([np.sin(t), np.sin(1.3 * t)])
    q[2000:, 0] += 1.0  # a gap
    rounded, steps = np.round(q / 0.01) * 0.01, np.array([0.01, 0.0])
    change = smoothed(rounded, steps, 51)
    assert np.std((rounded + change - q)[:1900, 0]) < 0.3 * 0.01 / np.sqrt(12)
    assert np.abs(change).max(axis=0).tolist() == pytest.approx([0.01, 0.0])


def test_the_correction_solves_without_the_noise_and_not_beyond_a_bound(rng):
    A, E = rng.standard_normal((2, 30, 4))
    H, pull = A.T @ A, rng.standard_normal(4)
    D = 0.05 * E.T @ E
    root, move, unsure = without_noise(np.linalg.inv(H), D, pull)
    np.testing.assert_allclose(root @ move, np.linalg.solve(H - D, pull), rtol=1e-9)
    x = np.diag(root.T @ D @ root)
    np.testing.assert_allclose(root.T @ D @ root, np.diag(x), atol=1e-12)
    # to first order what an error of a tenth of D does
    np.testing.assert_allclose(unsure, 0.1 * x / (1 - x) * move, rtol=1e-9)
    root, move, _ = without_noise(np.linalg.inv(H), 0.99 * H, pull)
    np.testing.assert_allclose(root @ move, 5.0 * np.linalg.solve(H, pull), rtol=1e-9)


@pytest.fixture(scope="module")
def runs(planar, motion):
    """Errors of least squares on many encoders' logs (k, b), and what is found of a few of them."""
    return many(planar, motion)


def many(model, motion, count=24, looked=6):
    beta, errors, few = structural_mapping(model).to_base(truth(model)), [], []
    for seed in range(count):
        recordings, parts, whole, wls = fitted(model, recorded(model, motion, seed=seed))
        errors.append(wls.theta - beta)
        if seed < looked:
            noise = find_regressor_noise(recordings, whole, wls.theta, wls.sigma, wls.sigma)
            fixed = wls, [part.factors for part in parts], whole.factors, recordings.share
            known, plain = (
                measured_errors(*fixed, np.eye(len(beta)), wls.sigma, more=x)[0].std_error
                for x in (noise.meat, None)
            )
            few.append((noise, known, plain))
    return np.array(errors), *(list(x) for x in zip(*few, strict=True))


def test_the_shift_is_what_many_encoders_move_least_squares_by(runs, planar, motion):
    errors, noises, _, _ = runs
    mean, scatter = errors.mean(axis=0), errors.std(axis=0)
    shift = np.array([noise.shift for noise in noises])
    uncertain = np.hypot(
        scatter / np.sqrt(len(errors)), shift.std(axis=0, ddof=1) / np.sqrt(len(shift))
    )
    assert np.abs(mean / scatter).max() > 2.0  # least squares are biased
    assert (np.abs(shift.mean(axis=0) - mean) < 3.5 * uncertain).all()
    worst = int(np.argmax(np.abs(mean) / scatter))
    assert shift[:, worst].mean() == pytest.approx(mean[worst], rel=0.15)
    rare = found_in(planar, recorded(planar, [x[::12] for x in motion]))  # most rows differ
    np.testing.assert_allclose([noises[0].steps, rare.steps], STEP)
    a, exact = (process(recorded(planar, motion, step=step), SIGNALS).a for step in (STEP, 0))
    share = np.std(a - exact, axis=0) / np.sqrt(np.mean(exact**2, axis=0))
    np.testing.assert_allclose(noises[0].share, share, rtol=0.2)  # rounding is nearly white noise


def test_intervals_hold_the_truth_behind_the_correction_and_not_without_it(runs):
    errors, noises, known, plain = runs
    shift = np.array([noise.shift for noise in noises])
    z = (errors[: len(shift)] - shift) / np.array(known)
    assert np.mean(np.abs(errors[: len(shift)] / np.array(plain)) > 2.0) > 0.25
    assert np.mean(np.abs(z) > 2.0) < 0.1
    assert np.median(np.array(known) / np.array(plain)) < 1.5  # nor do they grow out of bounds


def test_repeated_rounding_errors_count_as_often_as_they_are_repeated(planar):
    errors, _, known, plain = many(planar, exact(planar, period=3.0), looked=4)
    scatter = errors.std(axis=0)
    assert np.median(np.sqrt(np.mean(np.square(plain), axis=0)) / scatter) < 0.8
    ratio = np.sqrt(np.mean(np.square(known), axis=0)) / scatter
    assert 0.8 < np.median(ratio) < 1.5, ratio


@pytest.mark.parametrize("step", [2 * np.pi / 2**18, 0.0])
def test_fine_encoders_change_nothing_and_are_not_named(planar, motion, step):
    log = recorded(planar, motion, step=step)
    found = fit(planar, [log], signals=SIGNALS, estimator="wls")
    assert found.regressor_noise is None
    assert list(encoder_noise(found)) == []


def test_measured_velocities_have_no_noise_of_the_positions(planar, motion):
    t, q, _ = motion
    v = np.gradient(q, t, axis=0)
    log = recorded(planar, motion, v=v)
    held = hold_log(planar, log, SignalSettings(velocity="measured"))
    recordings = replace(fitted(planar, log)[0], fitted=[held])
    whole = join(recordings.reduce())
    wls = WLS().fit(whole.factors)
    assert find_regressor_noise(recordings, whole, wls.theta, wls.sigma, wls.sigma) is None


def test_an_estimator_that_reads_samples_counts_the_shift_as_an_error(planar, motion):
    log = recorded(planar, motion)
    wls = fit(planar, [log], estimator="wls", signals=SIGNALS)
    rls = identify(planar, [log], estimator="rls", signals=SIGNALS)
    noise = rls.regressor_noise
    assert not noise.is_corrected
    np.testing.assert_allclose(rls.base - noise.shift, wls.base, rtol=1e-3, atol=1e-4)
    assert (rls.base_error >= 0.95 * np.abs(noise.shift)).all()
    score = rls.factors.information(rls.wls.sigma**-2.0) @ noise.shift
    wanted = wls.regressor_noise.meat + np.outer(score, score)
    np.testing.assert_allclose(noise.meat, wanted, rtol=1e-6, atol=1e-9 * np.abs(wanted).max())
    (finding,) = [f for f in rls.findings if f.code == "encoder_noise"]
    assert "its standard errors include it" in finding.message


def test_ordinary_least_squares_are_corrected_by_their_own_weights(planar, motion):
    log = recorded(planar, motion)
    recordings, _, whole, _ = fitted(planar, log)
    found = fit(planar, [log], estimator="ols", signals=SIGNALS)
    plain = OLS(independent_share=recordings.share).fit(whole.factors)
    np.testing.assert_allclose(found.base, plain.theta - found.regressor_noise.shift, rtol=1e-6)
    np.testing.assert_allclose(found.regressor_noise.std_error, plain.std_error, rtol=0.05)
    beta = found.mapping.to_base(truth(planar))
    assert np.mean(np.abs(plain.theta - beta) > 2.5 * found.base_error) > 0.15
    assert (np.abs(found.base - beta) < 2.5 * found.base_error).all()


def test_total_least_squares_have_a_correction_of_their_own(planar, motion):
    log = recorded(planar, motion)
    found = fit(planar, [log], estimator="tls", signals=SIGNALS)
    assert found.regressor_noise is None


@pytest.mark.parametrize(
    ("steps", "shift", "severity", "coarsest"),
    [
        ((0.001, 0.9, 0.003, 0.002), -1.5, "warning", "0.003 rad (11.0 bits per revolution)"),
        ((0.001, 0.9, 0.003, 0.04), 0.75, "note", "0.04 m"),
        ((0.001, 0.9, 0.003, 0.04), 0.3, None, ""),
    ],
)
def test_a_finding_names_the_joints_of_coarse_steps_and_the_worst_inertial_sum(
    steps, shift, severity, coarsest
):
    K = np.array([[0.0, 0.0, 1.0], [1.0, 0.5, 0.0], [0.0, 2.0, 1.0]])  # the first is of a drive
    noise = regressor_noise.RegressorNoise(
        steps=np.array(steps), share=np.array([0.4, 0.03, 0.05, 0.2]),
        shift=np.array([90.0, 0.2, shift]), std_error=np.array([1.0, 0.5, 0.75]), meat=np.eye(3),
    )  # fmt: skip
    layout = SimpleNamespace(n_inertial=2, prismatic={"d"})
    model = SimpleNamespace(joints=tuple("abcd"), layout=layout)
    mapping = SimpleNamespace(K=K, base_names=("x", "y", "z"))
    fit_of = SimpleNamespace(regressor_noise=noise, model=model, mapping=mapping)
    found = list(encoder_noise(fit_of))
    assert len(found) == (severity is not None)
    if not found:
        return
    (finding,) = found
    assert (finding.severity, finding.where) == (severity, "a, c, d")
    size, text = abs(shift) / 0.75, finding.message
    assert text.startswith(f"a, c, d: the position is quantised in steps of up to {coarsest}. ")
    assert f"40 % of the RMS acceleration and shifts z by {size:.1f} standard errors" in text
    of_joints = {"step_a": steps[0], "step_c": steps[2], "step_d": steps[3]}
    assert Figures(finding) == pytest.approx(of_joints | {"std_errors": size, "share_pct": 40})
