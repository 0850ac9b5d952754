import numpy as np
import pytest
from helpers.estimation import NOISE, Case, still_wrist

from robotid.estimators import OLS, WLS
from robotid.exceptions import RankDeficientError
from robotid.regressor.problem import Problem


def test_wls_beats_ols_where_joints_are_unequally_noisy(ur5, rng):
    kinds, errors = {"ols": OLS(), "wls": WLS()}, {"ols": [], "wls": []}
    for _ in range(10):
        case = Case(ur5, rng, NOISE)
        for name, errors_of in errors.items():
            estimate = kinds[name].fit(case.problem)
            errors_of.append(np.abs(estimate.theta - case.beta) / np.abs(estimate.std_error))
            if name == "wls":
                wrist = [i for i, n in enumerate(estimate.names) if n.startswith("wrist_3")]
                ols = OLS().fit(case.problem)
                assert estimate.std_error[wrist].sum() < ols.std_error[wrist].sum()
    assert np.mean(errors["wls"]) < 1.2  # errors are of the size that is stated


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


def test_with_a_prior_the_rest_is_kept(ur5, rng):
    case = still_wrist(ur5, rng)
    prior = case.mapping.to_base(ur5.standard_parameters())
    estimate = WLS(prior=prior).fit(case.problem)
    i = estimate.names.index("wrist_3_joint.viscous")
    assert estimate.theta[i] == pytest.approx(prior[i], abs=1e-12)
    assert np.isinf(estimate.std_error[i])
    assert estimate.rank < 58


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


@pytest.mark.parametrize("kind", [OLS, WLS])
def test_a_prior_says_nothing_where_the_data_determine_everything(ur5, rng, kind):
    case = Case(ur5, rng, NOISE)
    free, held = (kind(prior=prior).fit(case.problem) for prior in (None, case.beta + 3.0))
    np.testing.assert_allclose(held.theta, free.theta, rtol=1e-6, atol=1e-7)
