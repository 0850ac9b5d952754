"""Laws that every estimator obeys. A new estimator joins by one line in ESTIMATORS."""

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.estimators import OLS, WLS, Consistent
from robotid.exceptions import DataError, NotConvergedError, RankDeficientError
from robotid.identification.prior import prior_spread
from robotid.logs.settings import SignalSettings
from robotid.logs.signals import process
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.factors import compress
from robotid.regressor.torque import build_problem
from robotid.robot.parameters import pseudo_inertia

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)


class Case:
    """A robot, its true parameters and a problem made of them."""

    def __init__(self, model, rng, noise=None, **options):
        self.model = model
        self.pi = truth(model)
        self.mapping = structural_mapping(model)
        self.beta = self.mapping.to_base(self.pi)
        log = exact_log(model, self.pi, rng, noise=noise, **options)
        self.trajectory = process(log, EXACT)
        self.problem = self.mapping.reduce(build_problem(model, self.trajectory))

    def base(self, estimate):
        theta = estimate.theta
        return theta if len(theta) == len(self.beta) else self.mapping.to_base(theta)

    def covariance(self, estimate):
        K = self.mapping.K
        same = len(estimate.theta) == len(self.beta)
        return estimate.covariance if same else K @ estimate.covariance @ K.T


def consistent(case, **options):
    prior = case.model.standard_parameters()
    spread = prior_spread(case.model, [case.trajectory])
    return Consistent(case.model.layout, case.mapping.K, prior, spread, **options)


ESTIMATORS = {
    "ols": lambda case: OLS(),
    "wls": lambda case: WLS(),
    "consistent": lambda case: consistent(case),
}
NOISE = np.array([4.0, 2.0, 1.0, 0.3, 0.2, 0.1])  # [N m]


@pytest.fixture(params=ESTIMATORS.values(), ids=ESTIMATORS)
def make(request):
    return request.param


def test_truth_is_recovered_without_noise(make, panda, rng):
    case = Case(panda, rng)
    beta = case.base(make(case).fit(case.problem))
    # 1e-8 relative: rounding of 4200 rows and, for the cone solver, its own tolerance
    assert np.linalg.norm(beta - case.beta) < 1e-8 * np.linalg.norm(case.beta)


def test_factors_and_problem_give_the_same_estimate(make, ur5, rng):
    case = Case(ur5, rng, NOISE)
    one = make(case).fit(case.problem)
    other = make(case).fit(compress(case.problem))
    np.testing.assert_array_equal(one.theta, other.theta)


def test_input_is_not_changed(make, ur5, rng):
    case = Case(ur5, rng, NOISE)
    factors = compress(case.problem)
    before = factors.R.copy()
    make(case).fit(factors)
    np.testing.assert_array_equal(factors.R, before)


def test_noise_level_of_each_joint_is_found(make, ur5, rng):
    case = Case(ur5, rng, NOISE, samples=3000)
    sigma = make(case).fit(case.problem).sigma
    # OLS lets the noise of the shoulder into the wrist's residual; the others weigh it down
    rtol = 0.2 if isinstance(make(case), OLS) else 0.05
    np.testing.assert_allclose(sigma, NOISE, rtol=rtol)


def test_fewer_rows_than_parameters_are_refused(make, ur5, rng):
    case = Case(ur5, rng, samples=9)
    with pytest.raises(DataError, match=r"54 torque rows for 58 parameters: too few rows to fit"):
        make(case).fit(case.problem)


def test_standard_errors_match_monte_carlo(make, ur5, rng):
    case = Case(ur5, rng, np.zeros(6), samples=400)
    estimates, stated = [], []
    for _ in range(60):
        noisy = NOISE * rng.standard_normal(case.trajectory.tau.shape)
        trajectory = exchange(case.trajectory, case.trajectory.tau + noisy)
        problem = case.mapping.reduce(build_problem(ur5, trajectory))
        estimate = make(case).fit(problem)
        estimates.append(case.base(estimate))
        stated.append(np.sqrt(np.diag(case.covariance(estimate))))
    ratio = np.mean(stated, axis=0) / np.std(estimates, axis=0, ddof=1)
    # 60 runs know a standard deviation to 9 %; constraints and prior only make the fit tighter
    assert 0.9 < np.median(ratio) < 1.6
    assert ratio.min() > 0.65


def exchange(trajectory, tau):
    from dataclasses import replace

    return replace(trajectory, tau=tau)


def test_wls_beats_ols_where_joints_are_unequally_noisy(ur5, rng):
    errors = {"ols": [], "wls": []}
    for _ in range(10):
        case = Case(ur5, rng, NOISE)
        for name, errors_of in errors.items():
            estimate = ESTIMATORS[name](case).fit(case.problem)
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


def still_wrist(model, rng):
    case = Case(model, rng, NOISE)
    v = np.array(case.trajectory.v)
    v[:, 5] = 0.0
    a = np.array(case.trajectory.a)
    a[:, 5] = 0.0
    q = np.array(case.trajectory.q)
    q[:, 5] = 0.3
    from dataclasses import replace

    case.trajectory = replace(case.trajectory, q=q, v=v, a=a)
    case.problem = case.mapping.reduce(build_problem(model, case.trajectory))
    return case


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


def test_consistent_fit_names_what_it_took_from_the_prior(ur5, rng):
    case = still_wrist(ur5, rng)
    assert "wrist_3_joint.viscous" in consistent(case).fit(case.problem).undetermined


def test_consistent_fit_is_physical_where_least_squares_is_not(ur5, rng):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    free = case.mapping.to_standard(WLS().fit(case.problem).theta, ur5.standard_parameters())
    assert np.linalg.eigvalsh(pseudo_inertia(free[:60])).min() < 0
    estimate = consistent(case).fit(case.problem)
    assert np.linalg.eigvalsh(pseudo_inertia(estimate.theta[:60])).min() > 0
    assert (estimate.theta[ur5.layout.is_nonnegative()] >= 0).all()


def test_consistent_fit_agrees_with_wls_where_physics_does_not_bind(ur5, rng):
    case = Case(ur5, rng, 0.01 * NOISE, samples=2000)
    wls, ours = WLS().fit(case.problem), consistent(case).fit(case.problem)
    difference = np.abs(case.base(ours) - wls.theta) / wls.std_error
    assert difference.max() < 1.0


def test_the_held_share_of_a_body_is_respected(ur5, rng):
    case = Case(ur5, rng, NOISE)
    held = np.zeros(60)
    # the last link is known to carry a 5 kg part, more than it has: the rest must stay possible
    held[50:] = [5.0, 0, 0, 0, 0.05, 0, 0.05, 0, 0, 0.05]
    estimate = consistent(case, held=held).fit(case.problem)
    rest = pseudo_inertia(estimate.theta[:60] - held)
    assert np.linalg.eigvalsh(rest).min() > 0
    assert estimate.theta[50] > 5.0


def test_a_solver_that_fails_says_so(ur5, rng):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    with pytest.raises(NotConvergedError, match="was not solved by Clarabel") as caught:
        consistent(case, max_iterations=1).fit(case.problem)
    assert caught.value.status == "MaxIterations"


def test_a_prior_that_is_not_finite_is_refused(ur5, rng):
    case = Case(ur5, rng, NOISE)
    with pytest.raises(DataError, match="prior and held must be finite"):
        consistent(case, held=np.full(60, np.nan))


def test_fewer_independent_rows_widen_the_errors(make, ur5, rng):
    case = Case(ur5, rng, NOISE)
    estimator = make(case)
    from dataclasses import replace

    wide = replace(estimator, independent_share=0.25).fit(case.problem)
    narrow = estimator.fit(case.problem)
    ratio = np.sqrt(np.diag(case.covariance(wide)) / np.diag(case.covariance(narrow)))
    # the consistent fit also finds the noise larger: fewer rows are left to tell it
    assert 1.5 < np.median(ratio) <= (2.1 if isinstance(estimator, Consistent) else 2.0001)
