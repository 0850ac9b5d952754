from dataclasses import replace

import numpy as np
from helpers.estimation import NOISE, Case

from robotid.estimators import RLS, WLS, Kalman, fold
from robotid.regressor.torque import build_problem, joint_torque_regressor


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
