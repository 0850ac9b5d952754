import numpy as np
import pytest
from helpers.estimation import NOISE, Case, still_wrist

from robotid.base.exceptions import DataError, RankDeficientError
from robotid.dynamics.factors import Problem, compress
from robotid.estimation.estimators import OLS, TLS, WLS
from robotid.estimation.estimators.batch import mixed_tls, solve_factor


def test_wls_is_the_same_from_the_noise_levels_of_a_similar_fit(ur5, rng):
    problem = Case(ur5, rng, NOISE).problem
    plain = WLS().fit(problem)
    near = WLS(levels=1.001 * plain.sigma).fit(problem)
    assert near.n_iter < plain.n_iter
    for one, other in ((plain.theta, near.theta), (plain.sigma, near.sigma)):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-9)


def test_ols_is_plain_least_squares(ur5, rng):
    case = Case(ur5, rng, NOISE)
    W, tau, _ = (np.concatenate(x) for x in zip(*case.problem.blocks(), strict=True))
    expected = np.linalg.lstsq(W, tau, rcond=None)[0]
    np.testing.assert_allclose(OLS().fit(case.problem).theta, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("estimator", [OLS(), WLS()])
def test_what_the_data_do_not_excite_is_refused_by_name(ur5, rng, estimator):
    case = still_wrist(ur5, rng)
    with pytest.raises(RankDeficientError) as caught:
        estimator.fit(case.problem)
    assert "wrist_3_joint.viscous" in caught.value.undetermined
    assert "shoulder_pan_joint.viscous" not in caught.value.undetermined
    assert f"the data excite {caught.value.rank} of 58 base parameters" in str(caught.value)


@pytest.mark.parametrize("share", [1.0, 0.2])
def test_covariances_are_their_formulas(rng, share):
    Y = rng.standard_normal((40, 2, 3))
    tau = Y @ [1.0, -2.0, 0.5] + np.array([2.0, 0.1]) * rng.standard_normal((40, 2))
    block = (Y.reshape(-1, 3), tau.reshape(-1), np.ones(80))
    problem = Problem(lambda: iter([block]), ("a", "b", "c"), 2, np.ones((2, 3), dtype=bool))
    H = np.einsum("kji,kjl->jil", Y, Y)  # information of each joint

    ols = OLS(independent_share=share).fit(problem)
    bread = np.linalg.inv(H.sum(axis=0))
    meat = np.einsum("j,jil->il", ols.sigma**2, H)
    np.testing.assert_allclose(ols.covariance, bread @ meat @ bread / share, rtol=1e-9)

    wls = WLS(independent_share=share).fit(problem)
    inverse = np.linalg.inv(np.einsum("j,jil->il", wls.sigma**-2.0, H))
    # the noise levels that weighted the last fit are known to 1e-8
    np.testing.assert_allclose(wls.covariance, inverse / share, rtol=1e-6)
    # rows of a joint less the parameters that they determine
    spent = np.einsum("jil,li->j", H, inverse) / wls.sigma**2
    assert spent.sum() == pytest.approx(3.0)
    squares = ((tau - Y @ wls.theta) ** 2).sum(axis=0)
    np.testing.assert_allclose(wls.sigma, np.sqrt(squares / (40 - spent)), rtol=1e-6)


def problem(W, tau, names):
    blocks = [(W, tau, np.ones(len(tau)))]
    return Problem(lambda: iter(blocks), names, 1, np.ones((1, W.shape[1]), dtype=bool))


def test_one_column_is_demings_closed_form(rng):
    x = rng.standard_normal(200)
    y = 0.7 * x + 0.3 * rng.standard_normal(200)
    noise = 0.5  # of x, where that of y is 1
    xx, yy, xy = noise**-2 * (x @ x), y @ y, (x @ y) / noise
    slope = (yy - xx + np.sqrt((yy - xx) ** 2 + 4 * xy**2)) / (2 * xy)
    found = mixed_tls(np.column_stack([x, y]), np.array([noise]))
    assert found[0] == pytest.approx(slope / noise, rel=1e-10)


def test_without_noise_of_the_regressor_it_is_weighted_least_squares(rng):
    W = rng.standard_normal((300, 4))
    tau = W @ [1.0, -2.0, 0.5, 3.0] + 0.2 * rng.standard_normal(300)
    factors = compress(problem(W, tau, ("a", "b", "c", "d")))
    exact = TLS(regressor_noise=1e-7).fit(factors)
    np.testing.assert_allclose(exact.theta, WLS().fit(factors).theta, rtol=1e-9)


def test_it_undoes_the_bias_that_a_noisy_regressor_gives_least_squares(rng):
    clean = rng.standard_normal((20000, 3))
    clean[:, 2] = 1.0
    theta, share = np.array([2.0, -1.0, 0.5]), 0.3
    noisy = clean + share * rng.standard_normal(clean.shape) * [1, 1, 0]
    tau = clean @ theta + 0.5 * rng.standard_normal(len(clean))
    factors = compress(problem(noisy, tau, ("a", "b", "j.offset")))
    wls = WLS().fit(factors)
    found = TLS(regressor_noise=share / np.sqrt(1 + share**2)).fit(factors)
    assert np.abs(wls.theta - theta)[0] > 0.1
    np.testing.assert_allclose(found.theta, theta, atol=0.03)
    assert np.allclose(found.theta, theta, atol=5 * found.std_error)


def test_more_noise_than_the_residual_holds_is_refused(rng):
    W = rng.standard_normal((300, 2))
    tau = W @ [10.0, 3.0] + 0.01 * rng.standard_normal(300)
    with pytest.raises(DataError, match=r"regressor_noise = 0\.01 corresponds to"):
        TLS().fit(compress(problem(W, tau, ("a", "b"))))


def test_noise_that_is_not_stated_explains_at_most_half_of_the_residual(rng):
    W = rng.standard_normal((300, 2))
    for noise, share in ((0.01, 50.0), (1.0, 0.84)):  # 0.01^2 (10^2 + 3^2) of 1
        tau = W @ [10.0, 3.0] + noise * rng.standard_normal(300)
        found = TLS(regressor_noise=None).fit(compress(problem(W, tau, ("a", "b"))))
        assert float(found.message.split("; ")[1].split(" %")[0]) == pytest.approx(share, rel=0.5)
        np.testing.assert_allclose(found.theta, [10.0, 3.0], atol=4 * found.std_error.max())


def test_data_that_leave_parameters_open_are_refused(rng):
    W = rng.standard_normal((50, 2))
    W[:, 1] = 2 * W[:, 0]
    with pytest.raises(RankDeficientError):
        TLS().fit(compress(problem(W, W[:, 0].copy(), ("a", "b"))))


def test_noise_beyond_the_signal_has_no_single_solution():
    with pytest.raises(DataError, match="is not unique"):
        mixed_tls(np.eye(3), np.ones(2))


def test_what_rows_leave_open_stays_at_the_prior_by_the_size_of_the_columns(rng):
    W = rng.standard_normal((50, 4)) * [1.0, 30.0, 2.0, 0.1]
    W[:, 2] = W[:, 0] - 0.05 * W[:, 1]
    tau, prior = rng.standard_normal(50), np.array([0.3, -0.2, 1.0, 5.0])
    found = solve_factor(compress(problem(W, tau, tuple("abcd"))), np.ones(1), prior)
    scale = np.linalg.norm(W, axis=0)
    s = np.linalg.svd(W / scale, compute_uv=False)
    assert found.rank == 3
    assert found.condition == pytest.approx(s[0] / s[2])
    assert found.undetermined == ("a", "b", "c")
    inverse = np.linalg.pinv(W / scale, rcond=1e-9)
    np.testing.assert_allclose(found.theta, prior + inverse @ (tau - W @ prior) / scale)
    wanted = inverse @ inverse.T / np.outer(scale, scale)
    np.testing.assert_allclose(found.covariance, wanted, atol=1e-12 * wanted.max())


def test_parameters_that_are_barely_determined_need_no_prior():
    """Two pairs of columns whose difference is 3e-7 of a column, and 1e-7 is a rank too few."""

    def solved(apart):
        W = np.kron(np.eye(2), [[1.0, 1.0], [0.0, apart]])
        factors = compress(problem(W, W @ theta, tuple("abcd")))
        return solve_factor(factors, np.ones(1), None)

    theta = np.array([2.0, -1.0, 0.5, 3.0])
    found = solved(3e-7)
    assert (found.rank, found.undetermined) == (4, ())
    np.testing.assert_allclose(found.theta, theta, atol=1e-6)
    error = [np.hypot(1.0, 1.0 / 3e-7), 1.0 / 3e-7]
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), error * 2, rtol=1e-6)
    with pytest.raises(RankDeficientError):
        solved(1e-7)
