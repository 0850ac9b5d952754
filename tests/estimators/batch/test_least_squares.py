import numpy as np
import pytest
from helpers.estimation import NOISE, Case, still_wrist

from robotid.estimators import OLS, WLS
from robotid.exceptions import RankDeficientError


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
