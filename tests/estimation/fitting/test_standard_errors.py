from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from robotid.base.exceptions import DataError
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors, merge
from robotid.estimation.estimators import WLS
from robotid.estimation.estimators.estimator import scatter
from robotid.estimation.fitting.standard_errors import measured_errors, standard_of, with_wls_errors

N, JOINTS, STRETCHES = 2400, 2, 40
SIGMA = np.array([2.0, 0.1])
TRUTH = np.array([1.0, -2.0, 0.5, 3.0])


@pytest.fixture(scope="module")
def W():
    rng = np.random.default_rng(0)
    slow = scipy.signal.lfilter([1.0], [1.0, -0.95], rng.standard_normal((N, JOINTS, 3)), axis=0)
    return np.concatenate([slow, np.ones((N, JOINTS, 1))], axis=2)


def noise(rng, colour):
    white = rng.standard_normal((N, JOINTS))
    coloured = scipy.signal.lfilter([np.sqrt(1 - colour**2)], [1.0, -colour], white, axis=0)
    return SIGMA * coloured


def segments(W, tau):
    """Return the factors of each segment, of all by one call."""
    rows = np.concatenate([W, tau[:, :, None]], axis=2).reshape(STRETCHES, -1, JOINTS, 5)
    triangles = np.linalg.qr(rows.transpose(0, 2, 1, 3), mode="r")  # (Segments, JOINTS, 5, 5)
    every, counts = (np.arange(4),) * JOINTS, np.full(JOINTS, N // STRETCHES)
    return [Factors(tuple(own), every, counts, tuple("abcd")) for own in triangles]


def fitted(W, tau, share=1.0, count=STRETCHES):
    """Return the factors of segments and of all, and least squares on them."""
    parts = segments(W, tau)[:count]
    whole = merge(parts)
    return parts, whole, WLS(independent_share=share).fit(whole)


def test_an_open_parameter_has_no_error_and_leaves_that_of_others(W):
    parts, whole, rough = fitted(W, W @ TRUTH + noise(np.random.default_rng(3), 0.5))
    plain, errors = measured_errors(rough, parts, whole, 1.0, np.eye(4), rough.sigma)
    np.testing.assert_allclose(errors.quantile, scipy.stats.t.ppf(0.975, errors.freedom))
    wanted = plain.covariance
    R = whole.weighted(rough.sigma)[:4, :4]
    bread = np.linalg.inv(R.T @ R)
    meat = scatter(parts, rough.theta, rough.sigma, bread).meat
    np.testing.assert_allclose(wanted, bread @ meat @ bread, rtol=1e-6, atol=1e-12)
    open_one = rough.covariance.copy()
    open_one[2, 2] = np.inf
    given = replace(rough, covariance=open_one)
    found = measured_errors(given, parts, whole, 1.0, np.eye(4), rough.sigma)[0].covariance
    others = wanted.copy()
    others[2, 2] = np.inf
    np.testing.assert_allclose(found, others, rtol=1e-9)


@pytest.mark.parametrize("rest", [1.0, 0.0])
def test_scores_scatter_as_the_matrices_of_their_rows_say(W, rest):
    """Of two joints and four columns, one of which a single segment has nearly, or quite alone."""
    W = W.copy()
    W[:60] *= [rest, rest, 30.0, rest]
    W[60:, :, 2] *= rest
    tau = W @ TRUTH + 2.0 * noise(np.random.default_rng(8), 0.9)
    sigma = np.array([1.5, 0.2])
    rows, y = (x / sigma[:, None] for x in (W, tau[:, :, None]))
    X, b = rows.reshape(STRETCHES, -1, 4), y.reshape(STRETCHES, -1)
    B = np.linalg.inv(np.einsum("sia,sib->ab", X, X))
    theta = B @ np.einsum("sia,si->a", X, b)
    meat, alone, left, expected, a = np.zeros((4, 4)), np.zeros((4, 4)), 0.0, 0.0, []
    for R, z in zip(X, b - X @ theta, strict=True):
        H = R @ B @ R.T
        leverage, V = np.linalg.eigh(H)
        gain = np.maximum(1.0 - leverage, 0.05) ** -0.5  # of no more leverage than 0.95
        A = (V * gain) @ V.T
        score = R.T @ A @ z
        meat += np.outer(score, score)
        left += (A @ z) @ H @ (A @ z)
        shown = A @ (np.eye(len(H)) - H) @ A  # of its own noise
        expected += np.trace(H @ shown)
        alone += R.T @ (np.eye(len(H)) - shown) @ R
        a.append(A @ R @ B)
    found = scatter(segments(W, tau), theta, sigma, B)
    assert found.inflation == pytest.approx(left / expected)
    assert found.inflation > 3.0
    np.testing.assert_allclose(found.meat, meat + left / expected * alone, rtol=1e-6)
    assert alone[2, 2] > 0.3 / B[2, 2]
    np.testing.assert_allclose(found.covariance, B @ found.meat @ B, rtol=1e-6)
    if not rest:
        assert found.freedom()[2] == 1.0
        prior = B + np.diag([0.0, 0.0, 0.0, 1e4])  # and a parameter that no row has
        prior[3, :3] = prior[:3, 3] = 0.0
        freedom = scatter(segments(W * [1, 1, 1, 0], tau), theta, sigma, prior).freedom()
        assert np.isinf(freedom).tolist() == [False, False, False, True]
    for k in range(4) if rest else (0, 1, 3):
        back = np.array([R.T @ x[:, k] for R, x in zip(X, a, strict=True)])
        gram = np.diag([x[:, k] @ x[:, k] for x in a]) - back @ B @ back.T
        wanted = np.trace(gram) ** 2 / np.sum(gram**2)
        assert found.freedom()[k] == pytest.approx(max(wanted, 1.0), rel=1e-6)


def test_few_stretches_keep_the_band_of_the_filter(W):
    tau = W @ TRUTH + noise(np.random.default_rng(0), 0.0)
    parts, whole, rough = fitted(W, tau, 0.2, 11)
    found, basis = measured_errors(rough, parts, whole, 0.2, np.eye(4), rough.sigma)
    np.testing.assert_array_equal(found.covariance, rough.covariance)
    assert basis.inflation == pytest.approx(5.0)
    assert "only 11 segments" in basis.method
    with pytest.raises(DataError, match="11 segments"):
        scatter(parts, rough.theta, rough.sigma, rough.covariance)


def test_few_segments_have_errors_that_repeat_in_every_row(W, rng):
    tau, share = W @ TRUTH + noise(np.random.default_rng(0), 0.0), 0.2
    parts, whole, rough = fitted(W, tau, share, 11)
    root = rng.standard_normal((4, 2))
    more = 1e6 * root @ root.T
    found, _ = measured_errors(rough, parts, whole, share, np.eye(4), rough.sigma, more=more)
    R = whole.weighted(rough.sigma)[:4, :4]
    H = share * R.T @ R  # information
    wanted = np.linalg.solve(H, np.linalg.solve(H, H + share**2 * more).T)
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-6, atol=1e-12)
    assert np.diag(wanted).max() > 1.5 * np.diag(rough.covariance).max()
    without = replace(rough, covariance=rough.covariance.copy())  # the third is not identifiable
    without.covariance[2], without.covariance[:, 2], without.covariance[2, 2] = 0.0, 0.0, np.inf
    found, _ = measured_errors(without, parts, whole, share, np.eye(4), rough.sigma, more=more)
    C = np.where(np.isinf(without.covariance), 0.0, without.covariance)
    wanted = without.covariance + share**2 * C @ more @ C
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-9)
    K, L = rng.standard_normal((4, 6)), np.diag(rng.uniform(1.0, 2.0, 6))
    prior = K.T @ H @ K + L  # of standard parameters, with a prior
    own = replace(rough, theta=np.zeros(6), covariance=np.linalg.inv(prior))
    found, _ = measured_errors(own, parts, whole, share, K, rough.sigma, more=more)
    wanted = own.covariance @ (prior + share**2 * K.T @ more @ K) @ own.covariance
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-6, atol=1e-9)


def test_a_filter_that_forgets_keeps_its_own_covariance_grown_by_the_inflation(W):
    share = 0.25  # the covariance of the fit takes a quarter of the rows to be independent
    parts, whole, own = fitted(W, W @ TRUTH + noise(np.random.default_rng(4), 0.9), share)
    found, errors = measured_errors(own, parts, whole, share, np.eye(4), own.sigma, is_filter=True)
    _, plain = measured_errors(own, parts, whole, share, np.eye(4), own.sigma)
    assert errors.inflation == pytest.approx(plain.inflation, rel=1e-6)
    assert errors.inflation > 5
    np.testing.assert_allclose(found.covariance, own.covariance * share * errors.inflation)


def test_a_gradient_method_ends_beside_the_minimum_and_says_so(W):
    _, _, wls = fitted(W, W @ TRUTH + noise(np.random.default_rng(5), 0.0))
    away = np.array([0.1, 0.0, -0.2, 0.3])
    rough = replace(wls, theta=wls.theta + away, covariance=np.zeros((4, 4)))
    found = with_wls_errors(rough, wls)
    np.testing.assert_allclose(found.covariance, wls.covariance + np.outer(away, away))
    np.testing.assert_array_equal(found.theta, rough.theta)
    assert "plus the distance to WLS" in found.message


def test_the_prior_makes_the_sandwich_of_its_formula(W):
    # B (K^T M K + L) B with B = (K^T H K + L)^-1, computed from the rows themselves
    rng, share = np.random.default_rng(6), 0.25
    parts, whole, wls = fitted(W, W @ TRUTH + noise(rng, 0.0))
    K = np.hstack([np.eye(4), rng.standard_normal((4, 2))])
    L = np.diag(np.arange(1.0, 7.0))
    rows = W.reshape(-1, 4) / np.tile(wls.sigma, N)[:, None]
    B = np.linalg.inv(share * K.T @ rows.T @ rows @ K + L)
    theta = np.linalg.lstsq(K, wls.theta, rcond=None)[0]
    estimate = replace(wls, theta=theta, covariance=B, names=tuple("abcdef"))
    found, _ = measured_errors(estimate, parts, whole, share, K, wls.sigma)
    meat = scatter(parts, K @ theta, wls.sigma, share * K @ B @ K.T).meat
    wanted = B @ (share**2 * K.T @ meat @ K + L) @ B
    np.testing.assert_allclose(found.covariance, wanted, rtol=1e-6, atol=1e-12)


def test_what_is_scattered_beside_the_rows_adds_to_the_meat(W):
    """Of a filter, of least squares and of a fit with a prior."""
    share, more = 0.25, np.diag([3.0, 1.0, 0.0, 2.0])
    parts, whole, wls = fitted(W, W @ TRUTH + noise(np.random.default_rng(7), 0.0), share)
    for is_filter, bread in ((True, share * wls.covariance), (False, share * wls.covariance)):
        plain, wide = (
            measured_errors(
                wls, parts, whole, share, np.eye(4), wls.sigma, is_filter=is_filter, more=x
            )[0].covariance
            for x in (None, more)
        )
        np.testing.assert_allclose(wide - plain, bread @ more @ bread, atol=1e-9 * wide.max())
    K = np.hstack([np.eye(4), np.ones((4, 1))])
    L = np.eye(5)
    R = whole.weighted(wls.sigma)[:4, :4]
    B = np.linalg.inv(share * K.T @ R.T @ R @ K + L)
    fit = replace(wls, theta=np.append(wls.theta, 0.0), covariance=B, names=tuple("abcde"))
    plain, wide = (
        measured_errors(fit, parts, whole, share, K, wls.sigma, more=x)[0].covariance
        for x in (None, more)
    )
    BK = B @ K.T
    np.testing.assert_allclose(wide - plain, share**2 * BK @ more @ BK.T, atol=1e-9 * wide.max())


def test_standard_parameters_are_the_prior_moved_by_the_least_to_the_base_parameters(W, rng):
    _, _, wls = fitted(W, W @ TRUTH + noise(rng, 0.0))
    K, spread = np.hstack([np.eye(4), rng.standard_normal((4, 2))]), np.arange(1.0, 7.0)
    mapping = BaseMapping(K, np.arange(4), tuple("abcdef"), np.ones(6))
    prior, before = rng.standard_normal(6), np.diag(spread**2)
    pi, C = standard_of(wls, mapping, prior, spread)
    G = before @ K.T @ np.linalg.inv(K @ before @ K.T)
    np.testing.assert_allclose(pi, prior + G @ (wls.theta - K @ prior))
    np.testing.assert_allclose(K @ C @ K.T, wls.covariance, atol=1e-12)
    left = before - G @ K @ before
    np.testing.assert_allclose(C, left + G @ wls.covariance @ G.T, atol=1e-12)
    # a base parameter that the data leave open is as wide as the prior has it
    variance = np.diag(np.where(np.arange(4) == 1, np.inf, np.diag(wls.covariance)))
    _, C = standard_of(replace(wls, covariance=variance), mapping, prior, spread)
    after = np.diag(K @ C @ K.T)
    assert after[1] == pytest.approx((K @ before @ K.T)[1, 1])
    assert after[0] == pytest.approx(wls.covariance[0, 0])


@pytest.mark.parametrize("count", [40, 11])
def test_with_active_bounds_errors_are_those_of_resampled_fits(W, rng, count):
    share, given, distances = 0.25, [], rng.standard_normal((60, 6))
    parts, whole, wls = fitted(W, W @ TRUTH + noise(rng, 0.9), share, count)
    K = np.hstack([np.eye(4), rng.standard_normal((4, 2))])
    R = whole.weighted(wls.sigma)[:4, :4]
    C = np.linalg.inv(share * K.T @ R.T @ R @ K + np.diag(np.arange(1.0, 7.0)))
    theta = np.linalg.lstsq(K, wls.theta, rcond=None)[0]
    estimate = replace(
        wls, theta=theta, covariance=C, names=tuple("abcdef"), details={"active": ("x y",)}
    )
    solved = [distances, ["slow", "other"]]

    def redrawn(*arguments):
        given.append(arguments)
        return solved

    fit = SimpleNamespace(
        rows=lambda factors, sigma: (factors, sigma), prior_weight=2.5, weight_ratio=1.5,
        programme=SimpleNamespace(redrawn=redrawn),
    )  # fmt: skip
    every = (estimate, parts, whole, share, K, wls.sigma)
    plain, without = measured_errors(*every)
    found, errors = measured_errors(*every, bounded=fit)
    (rows, weight, pi, meat, ratio, draws, _), *_ = given
    assert rows == (whole, wls.sigma)
    assert (weight, ratio, draws) == (2.5, 1.5, 64)
    np.testing.assert_array_equal(pi, theta)
    wanted = share * R.T @ R
    if count == 40:
        wanted = share**2 * scatter(parts, K @ theta, wls.sigma, share * K @ C @ K.T).meat
    np.testing.assert_allclose(meat, wanted, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, distances.T @ distances / 60, rtol=1e-12)
    np.testing.assert_allclose(1 / errors.freedom, 1 / without.freedom + 1 / 60, rtol=1e-12)
    np.testing.assert_array_equal(errors.unbounded, plain.std_error)
    assert errors.method == (
        f"{without.method}; bounds are active: 60 fits to resampled data and prior "
        "(2 more not solved: slow)"
    )
    solved[:] = distances[:7], ["slow", "other", "other"]
    found, errors = measured_errors(*every, bounded=fit)
    assert "active bounds are neglected, only 7 of 64 fits" in errors.method
    np.testing.assert_array_equal(found.covariance, plain.covariance)
    assert errors.unbounded is without.unbounded is None
    if count == 11:
        wide = measured_errors(*every, weight_ratio=3.0)[0]
        L = np.diag(np.arange(1.0, 7.0))
        expected = C @ (share * K.T @ R.T @ R @ K + 3.0 * L) @ C
        np.testing.assert_allclose(wide.covariance, expected, atol=1e-9)
