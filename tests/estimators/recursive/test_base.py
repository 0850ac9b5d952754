"""Laws that every recursive estimator obeys. A new one joins by one line in RECURSIVE."""

from dataclasses import fields, replace

import numpy as np
import pytest
from estimators.test_all_estimators import NOISE, Case, consistent
from helpers.synthetic import truth

from robotid.estimators import (
    OLS,
    PRX,
    RLS,
    WLS,
    DescentState,
    Kalman,
    KalmanState,
    NormalisedGradient,
    RLSState,
    fold,
    load_state,
    save_state,
)
from robotid.estimators.recursive.descent import column_scale
from robotid.exceptions import DataError, RankDeficientError
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.factors import compress
from robotid.regressor.problem import Problem, Sample
from robotid.regressor.torque import build_problem, joint_torque_regressor, mass_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia


def random_states(model, rng, samples=1000):
    """Return a noise-free problem whose samples are independent, and its parameters."""
    n, mapping = len(model.joints), structural_mapping(model)
    q = rng.uniform(-np.pi, np.pi, (samples, n))
    v, a = rng.uniform(-2, 2, (samples, n)), rng.uniform(-5, 5, (samples, n))
    columns = mapping.independent
    W = joint_torque_regressor(model, q, v, a)[:, columns]
    beta = mapping.to_base(truth(model))
    block = (W, W @ beta, np.ones(len(W)))
    names = mapping.base_names
    mass = mass_regressor(model, q)[..., columns]
    support = model.support()[:, columns]
    return Problem(lambda: iter([block]), names, n, support, lambda: iter([mass])), beta


# estimators that see a problem of parameters beta without noise; and how near they must come
RECURSIVE = {
    "rls": (lambda beta, n, **o: RLS(np.ones(n), **o), 1e-9),
    # the covariance form keeps half the digits of P / sigma^2, which starts at 1e8 here
    "kalman": (lambda beta, n: Kalman(np.full(n, 1e-2), 0 * beta, 1e2 + 0 * beta, gate=None), 1e-6),
    "prx": (lambda beta, n, **o: PRX(np.ones(n), average=False, passes=10, rng=_rng(), **o), 1e-9),
    "prx rows": (
        lambda beta, n, **o: PRX(
            np.ones(n), metric="rows", average=False, passes=10, rng=_rng(), **o
        ),
        1e-9,
    ),
    "prx mass": (
        lambda beta, n, **o: PRX(
            np.ones(n), beta / 2, metric="mass", average=False, passes=10, rng=_rng(), **o
        ),
        1e-3,
    ),
    # one number for all rows: the rate is that of the worst column
    "gradient": (
        lambda beta, n, **o: NormalisedGradient(
            np.ones(n), average=False, passes=20, rng=_rng(), **o
        ),
        1e-4,
    ),
}
STATES = {RLS: RLSState, Kalman: KalmanState, PRX: DescentState, NormalisedGradient: DescentState}


def _rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def ur10_states():
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"))
    return random_states(model, np.random.default_rng(0))


@pytest.fixture(params=RECURSIVE.values(), ids=RECURSIVE)
def member(request):
    return request.param


def started(make, beta, n):
    estimator = make(beta, n)
    return estimator, estimator.init(len(beta))


def bits(state):
    return {f.name: np.asarray(getattr(state, f.name)).tobytes() for f in fields(state)}


def test_truth_is_recovered_without_noise(member, ur10_states):
    make, tolerance = member
    problem, beta = ur10_states
    theta = make(beta, 6).fit(problem).theta
    assert np.linalg.norm(theta - beta) < tolerance * np.linalg.norm(beta)


def test_a_nan_sample_is_refused_without_harm(member, ur10_states):
    problem, beta = ur10_states
    estimator, state = started(member[0], beta, 6)
    samples = list(problem.samples())
    state = fold(estimator, samples[:50], state)
    before = bits(state)
    for name in ("Y", "tau", "weight"):
        broken = getattr(samples[50], name).copy()
        broken.flat[1] = np.nan
        with pytest.raises(DataError, match="refused"):
            estimator.update(state, replace(samples[50], **{name: broken}))
    assert bits(state) == before
    after = estimator.update(state, samples[50])
    assert bits(state) == before
    assert bits(after) != before


def test_a_sample_of_another_shape_is_refused(member, ur10_states):
    problem, beta = ur10_states
    estimator, state = started(member[0], beta, 6)
    sample = next(problem.samples())
    with pytest.raises(DataError, match=r"the sample has Y \(6, 57\), .*wanted \(6, 58\)"):
        estimator.update(state, replace(sample, Y=sample.Y[:, 1:]))


def test_a_row_of_weight_zero_is_as_if_it_had_never_been(member, ur10_states):
    problem, beta = ur10_states
    estimator, state = started(member[0], beta, 6)
    sample = next(problem.samples())
    weight = np.array([1.0, 0, 1, 1, 0, 1])
    absurd = np.where(weight > 0, sample.tau, np.nan)
    theta = [
        estimator.estimate(
            estimator.update(state, replace(sample, tau=tau, weight=weight)), problem.names
        ).theta
        for tau in (sample.tau, absurd)
    ]
    np.testing.assert_array_equal(*theta)
    none = replace(sample, weight=np.zeros(6))
    still = estimator.estimate(estimator.update(state, none), problem.names)
    np.testing.assert_array_equal(still.theta, estimator.estimate(state, problem.names).theta)


def test_saved_and_resumed_gives_the_same_bits(member, ur10_states, tmp_path):
    problem, beta = ur10_states
    estimator, state = started(member[0], beta, 6)
    samples = list(problem.samples())[:300]
    unbroken = fold(estimator, samples, state)
    half = fold(estimator, samples[:150], state)
    save_state(half, tmp_path / "state.npz")
    read = load_state(tmp_path / "state.npz", STATES[type(estimator)])
    assert bits(read) == bits(half)
    assert bits(fold(estimator, samples[150:], read)) == bits(unbroken)


def test_factors_are_refused(member, ur5, rng):
    case = Case(ur5, rng, NOISE)
    with pytest.raises(DataError, match="a recursive estimator reads samples"):
        member[0](case.beta, 6).fit(compress(case.problem))


def test_fewer_rows_than_parameters_are_refused(member, ur5, rng):
    case = Case(ur5, rng, samples=9)
    case.problem = case.mapping.reduce(build_problem(ur5, case.trajectory, with_mass=True))
    with pytest.raises(DataError, match="54 torque rows for 58 parameters: too few rows to fit"):
        member[0](case.beta, 6).fit(case.problem)


def test_a_file_that_is_no_state_is_refused(tmp_path):
    with pytest.raises(DataError, match="there is no state"):
        load_state(tmp_path / "none.npz", RLSState)
    (tmp_path / "text.npz").write_text("not a state")
    with pytest.raises(DataError, match=r"text.npz is not a state"):
        load_state(tmp_path / "text.npz", RLSState)
    save_state(RLS(np.ones(2)).init(3), tmp_path / "rls.npz")
    with pytest.raises(DataError, match="holds a state 'RLSState', wanted 'KalmanState'"):
        load_state(tmp_path / "rls.npz", KalmanState)


@pytest.mark.parametrize("options", [{}, {"metric": "rows"}, {"metric": "mass"}])
def test_prx_never_moves_away_from_the_truth(ur10_states, options):
    problem, beta = ur10_states
    scale = column_scale(problem, np.ones(6))
    estimator = PRX(np.ones(6), scale=scale, average=False, **options)
    assert_monotone(estimator, problem, scale * beta)


def test_printed_prx_never_moves_away_from_the_truth(ur10_states):
    problem, beta = ur10_states
    # half the truth, as in the paper: D(q, P^) starts positive definite
    estimator = PRX(np.ones(6), prior=beta / 2, step="printed", average=False)
    distance = assert_monotone(estimator, problem, beta)
    assert distance[-1] < distance[0]
    assert distance[-1] > 0.3 * distance[0]  # on six joints it hardly moves


def assert_monotone(estimator, problem, truth):
    state = estimator.init(len(truth))
    distance = [np.linalg.norm(state.x - truth)]
    for sample in problem.samples():
        state = estimator.update(state, sample)
        distance.append(np.linalg.norm(state.x - truth))
    growth = np.diff(distance) / distance[0]
    assert growth.max() < 1e-12  # rounding of 58 products
    return distance


def test_exact_prx_needs_two_passes_where_the_printed_step_stands_still(ur10_states):
    problem, beta = ur10_states
    start = 1.3 * beta

    def miss(**options):
        estimator = PRX(np.ones(6), prior=start, average=False, passes=2, rng=_rng(), **options)
        return np.linalg.norm(estimator.fit(problem).theta - beta) / np.linalg.norm(beta)

    assert miss() < 1e-6
    assert miss(metric="rows") < 1e-8
    assert miss(step="printed") > 0.1


def test_prx_says_what_it_lacks_and_refuses_settings(ur10_states):
    problem, _ = ur10_states
    sample = replace(next(problem.samples()), mass_regressor=None)
    for options in ({"step": "printed"}, {"metric": "mass"}):
        estimator = PRX(np.ones(6), **options)
        with pytest.raises(DataError, match=r"PRX needs the mass regressor of each sample; build"):
            estimator.update(estimator.init(58), sample)
    with pytest.raises(DataError, match="step is 'wrong', wanted 'exact' or 'printed'"):
        PRX(np.ones(6), step="wrong")
    with pytest.raises(DataError, match="passes is 0"):
        PRX(np.ones(6), passes=0)
    with pytest.raises(DataError, match="step_size is 2"):
        NormalisedGradient(np.ones(6), step_size=2.0)


def test_prx_stays_within_omega(ur10_states):
    problem, beta = ur10_states
    estimator = PRX(np.ones(6), prior=0 * beta, bounds=1.0, average=False)
    state = fold(estimator, problem.samples(), estimator.init(58))
    assert np.linalg.norm(state.x) == pytest.approx(1.0)


def test_averaging_takes_the_noise_out_of_prx(ur10_states, rng):
    problem, beta = ur10_states
    ((W, tau, weight),) = problem.blocks()
    noisy = tau + rng.standard_normal(len(tau))
    data = replace(problem, stream=lambda: iter([(W, noisy, weight)]))
    best = np.linalg.lstsq(W, noisy, rcond=None)[0]

    def residual(average):
        fit = PRX(np.ones(6), average=average, passes=6, rng=_rng()).fit(data)
        return np.linalg.norm(W @ (fit.theta - best)) / np.linalg.norm(W @ (beta - best)), fit

    last, _ = residual(False)
    mean, fit = residual(True)
    assert last > 2.0  # each iterate fits its own sample
    assert mean < 1.0  # nearer to least squares than that is to the truth
    assert np.isinf(fit.std_error).all()
    assert "does not know its covariance" in fit.message


def test_prx_stops_when_the_gradient_is_zero(ur10_states):
    problem, _ = ur10_states
    fit = PRX(np.ones(6), average=False, passes=30, rng=_rng(), eps1=1e-7).fit(problem)
    assert fit.converged
    assert fit.n_iter < 30_000
    short = PRX(np.ones(6), average=False, passes=1, rng=_rng()).fit(problem)
    assert not short.converged


def test_rls_without_forgetting_is_ols_after_the_last_sample(ur5, rng):
    case = Case(ur5, rng, NOISE)
    ours, ols = RLS(np.ones(6)).fit(case.problem), OLS().fit(case.problem)
    np.testing.assert_allclose(ours.theta, ols.theta, rtol=1e-9, atol=1e-11)


def test_rls_with_the_noise_levels_of_wls_is_wls(ur5, rng):
    case = Case(ur5, rng, NOISE)
    wls = WLS().fit(case.problem)
    ours = RLS(wls.sigma).fit(case.problem)
    np.testing.assert_allclose(ours.theta, wls.theta, rtol=1e-7, atol=1e-9)  # WLS iterates to 1e-8
    np.testing.assert_allclose(ours.std_error, wls.std_error, rtol=0.01)
    np.testing.assert_allclose(ours.sigma, wls.sigma, rtol=0.01)


def test_a_filter_that_never_walks_is_wls(ur5, rng):
    case = Case(ur5, rng, NOISE, samples=2000)
    wls = WLS().fit(case.problem)
    ours = Kalman(wls.sigma, 0 * case.beta, 1e3 + 0 * case.beta, gate=None).fit(case.problem)
    assert np.max(np.abs(ours.theta - wls.theta) / wls.std_error) < 0.01
    np.testing.assert_allclose(ours.std_error, wls.std_error, rtol=0.01)
    np.testing.assert_allclose(ours.sigma, NOISE, rtol=0.05)


def test_the_gate_turns_outliers_away_and_counts_them(ur5, rng):
    case = Case(ur5, rng, 0.1 * NOISE)
    tau = np.array(case.trajectory.tau)
    tau[100::50, 2] += 300.0
    spoiled = replace(case.trajectory, tau=tau)
    problem = case.mapping.reduce(build_problem(ur5, spoiled))

    def fit(gate):
        prior = case.mapping.to_base(ur5.standard_parameters())
        filtered = Kalman(0.1 * NOISE, prior, 5.0 + np.abs(prior), gate=gate)
        state = fold(filtered, problem.samples(), filtered.init(len(prior)))
        error = np.linalg.norm(state.theta - case.beta) / np.linalg.norm(case.beta)
        return error, state

    open_error, _ = fit(None)
    error, state = fit(1 - 1e-7)
    assert error < 0.2 * open_error
    np.testing.assert_array_equal(state.gated, [0, 0, 10, 0, 0, 0])


def test_a_gate_does_not_shut_a_joint_out_for_good(ur5, rng):
    case = Case(ur5, rng, samples=200)
    # the prior is far too sure of itself, so at first every row looks like an outlier
    far = Kalman(0.1 * NOISE, case.beta + 5.0, 1e-3 + 0 * case.beta)
    state = fold(far, case.problem.samples(), far.init(len(case.beta)))
    assert (state.gated >= 50).any()
    assert (state.rows > 0).all()


def test_a_walking_filter_follows_a_change_and_a_still_one_does_not(ur5, rng):
    case = Case(ur5, rng, 0.1 * NOISE, samples=2000)
    other = 1.2 * case.pi
    tau = np.array(case.trajectory.tau)
    t = case.trajectory
    tau[1000:] += (joint_torque_regressor(ur5, t.q, t.v, t.a) @ (other - case.pi)).reshape(-1, 6)[
        1000:
    ]
    problem = case.mapping.reduce(build_problem(ur5, replace(t, tau=tau)))
    target = case.mapping.to_base(other)

    def miss(estimator):
        return np.linalg.norm(estimator.fit(problem).theta - target) / np.linalg.norm(target)

    prior, std = case.beta, np.full(len(case.beta), 5.0)
    still = miss(Kalman(0.1 * NOISE, prior, std, gate=None))
    assert miss(Kalman(0.1 * NOISE, prior, std, walk=1e-3, gate=None)) < 0.2 * still
    assert miss(RLS(NOISE, 0.99, prior, std)) < 0.05 * still


def test_forgetting_does_not_wind_up_where_nothing_moves():
    # one sample over and over: with forgetting 0.95 the rest would be forgotten after a second
    rng, c = np.random.default_rng(0), 12
    prior, std = np.arange(1.0, c + 1), np.full(c, 2.0)
    estimator = RLS(np.ones(2), 0.95, prior, std)
    state = estimator.init(c)
    Y = np.zeros((2, c))
    Y[:, :2] = [[1.0, 0.5], [0.0, 1.0]]
    truth = np.array([3.0, -1.0])
    for _ in range(100_000):
        tau = Y[:, :2] @ truth + 1e-3 * rng.standard_normal(2)
        state = estimator.update(state, Sample(Y, tau, np.ones(2)))
    assert np.isfinite(state.R).all()
    smallest = np.linalg.svd(state.R[:c, :c], compute_uv=False)[-1]
    assert smallest > 0.5 * 0.95 ** (c / 2) / 2.0  # the floor, forgetting^(c/2) / prior_std
    estimate = estimator.estimate(state, tuple("abcdefghijkl"))
    np.testing.assert_allclose(estimate.theta[:2], truth, atol=0.05)
    np.testing.assert_allclose(estimate.theta[2:], prior[2:], atol=1e-9)
    # and the first jump that comes is taken calmly
    jump = estimator.update(state, Sample(np.ones((2, c)), np.full(2, prior.sum()), np.ones(2)))
    assert np.abs(estimator.estimate(jump, tuple("abcdefghijkl")).theta).max() < 50


def test_what_rls_was_not_shown_is_refused_by_name_or_keeps_its_prior():
    rng, names = np.random.default_rng(0), ("a", "b", "c")
    W = rng.standard_normal((40, 3))
    W[:, 2] = 0.0
    block = (W, W @ [1.0, 2.0, 3.0], np.ones(40))
    problem = Problem(lambda: iter([block]), names, 2, np.ones((2, 3), dtype=bool))
    with pytest.raises(RankDeficientError, match="undetermined"):
        RLS(np.ones(2)).fit(problem)
    kept = RLS(np.ones(2), prior=np.full(3, 7.0)).fit(problem)
    np.testing.assert_allclose(kept.theta, [1.0, 2.0, 7.0])
    assert kept.undetermined == ("c",)
    assert np.isinf(kept.std_error[2])
    with pytest.raises(DataError, match="give prior and prior_std"):
        RLS(np.ones(2), 0.99)
    with pytest.raises(DataError, match="forgetting is 0"):
        RLS(np.ones(2), 0.0)


@pytest.mark.parametrize("kind", ["rls", "kalman"])
def test_the_running_estimate_can_be_made_physical(ur5, rng, kind):
    case = Case(ur5, rng, 40 * NOISE, samples=200)
    prior = case.mapping.to_base(ur5.standard_parameters())
    sigma = 40 * NOISE
    estimator = RLS(sigma) if kind == "rls" else Kalman(sigma, prior, 50 + 0 * prior, gate=None)
    state = fold(estimator, case.problem.samples(), estimator.init(len(prior)))
    running = estimator.estimate(state, case.problem.names)
    free = case.mapping.to_standard(running.theta, ur5.standard_parameters())
    assert np.linalg.eigvalsh(pseudo_inertia(free[:60])).min() < 0
    projected = consistent(case).project(running)
    assert np.linalg.eigvalsh(pseudo_inertia(projected.theta[:60])).min() > 0
    assert "made physically possible" in projected.message


def test_projection_is_the_consistent_fit_of_the_same_data(ur5, rng):
    case = Case(ur5, rng, 4 * NOISE)
    wls = WLS().fit(case.problem)
    fit = consistent(case).fit(case.problem)
    projected = consistent(case).project(wls)
    distance = np.abs(case.base(projected) - case.base(fit)) / wls.std_error
    assert distance.max() < 1e-3
    nothing = PRX(np.ones(6)).estimate(PRX(np.ones(6)).init(58), case.problem.names)
    with pytest.raises(DataError, match="an estimate without a covariance cannot be projected"):
        consistent(case).project(nothing)
