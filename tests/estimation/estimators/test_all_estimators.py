"""Laws that every estimator obeys, and what an estimate and the scatter of segments state."""

from dataclasses import fields, replace

import numpy as np
import pytest
from helpers.estimation import ESTIMATORS, NOISE, Case, RandomStates

from robotid.base.exceptions import DataError
from robotid.dynamics.factors import compress
from robotid.estimation.estimators import RLS, Estimate, Kalman, fold
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

BATCH = ("ols", "wls", "tls", "consistent")
RECURSIVE = tuple(name for name in ESTIMATORS if name not in BATCH)


def makers(names):
    return pytest.mark.parametrize("make", [ESTIMATORS[name][0] for name in names], ids=names)


@pytest.fixture(scope="module")
def states():
    joints = ["shoulder_lift_joint", "elbow_joint", "wrist_2_joint"]
    model = RobotModel.from_urdf(example_urdf("ur10_robot.urdf"), joints=joints)
    return RandomStates(model, np.random.default_rng(0), samples=600)


@pytest.mark.parametrize(("make", "tolerance"), ESTIMATORS.values(), ids=ESTIMATORS)
def test_truth_is_recovered_without_noise(make, tolerance, states):
    theta = states.base(make(states).fit(states.problem))
    assert np.linalg.norm(theta - states.beta) < tolerance * np.linalg.norm(states.beta)


@makers(BATCH)
def test_factors_and_problem_give_the_same_estimate_and_are_not_changed(make, ur5, rng):
    case = Case(ur5, rng, NOISE)
    factors = compress(case.problem)
    before = factors.R.copy()
    np.testing.assert_array_equal(make(case).fit(case.problem).theta, make(case).fit(factors).theta)
    np.testing.assert_array_equal(factors.R, before)


@makers(ESTIMATORS)
def test_fewer_rows_than_parameters_are_refused(make, ur5, rng):
    case = Case(ur5, rng, samples=9)
    with pytest.raises(DataError, match=r"54 torque rows for 58 parameters: too few rows to fit"):
        make(case).fit(case.problem)


def started(make, case):
    estimator = make(case)
    return estimator, estimator.init(len(case.beta))


def bits(state):
    return {f.name: np.asarray(getattr(state, f.name)).tobytes() for f in fields(state)}


@makers(RECURSIVE)
def test_a_nan_sample_is_refused_without_harm(make, states):
    problem = states.problem
    estimator, state = started(make, states)
    samples = list(problem.samples())
    state = fold(estimator, samples[:50], state)
    before = bits(state)
    for name in ("Y", "tau", "weight"):
        broken = getattr(samples[50], name).copy()
        broken.flat[1] = np.nan
        with pytest.raises(DataError, match="not finite"):
            estimator.update(state, replace(samples[50], **{name: broken}))
    assert bits(state) == before
    after = estimator.update(state, samples[50])
    assert bits(state) == before
    assert bits(after) != before


@makers(RECURSIVE)
def test_a_sample_of_another_shape_is_refused(make, states):
    problem = states.problem
    estimator, state = started(make, states)
    sample = next(problem.samples())
    with pytest.raises(DataError, match=r"the sample has Y \(3, 22\), .*expected \(3, 23\)"):
        estimator.update(state, replace(sample, Y=sample.Y[:, 1:]))


@makers(RECURSIVE)
def test_a_row_of_weight_zero_is_as_if_it_had_never_been(make, states):
    problem = states.problem
    estimator, state = started(make, states)
    sample = next(problem.samples())
    weight = np.array([1.0, 0, 1])
    absurd = np.where(weight > 0, sample.tau, np.nan)
    theta = [
        estimator.estimate(
            estimator.update(state, replace(sample, tau=tau, weight=weight)), problem.names
        ).theta
        for tau in (sample.tau, absurd)
    ]
    np.testing.assert_array_equal(*theta)
    none = replace(sample, weight=np.zeros(3))
    still = estimator.estimate(estimator.update(state, none), problem.names)
    np.testing.assert_array_equal(still.theta, estimator.estimate(state, problem.names).theta)


THETA, ERROR = np.array([1.5, -20.0, 0.25]), np.array([0.1, 3.0, np.inf])
ESTIMATE = Estimate(
    theta=THETA, covariance=np.diag(ERROR**2) + 0.01 * (1 - np.eye(3)), rank=2, condition=12.5,
    names=("a.m", "b.viscous", "c.offset"), sigma=np.ones(2), undetermined=("c.offset",),
    converged=True, n_iter=3, message="solved by hand",
)  # fmt: skip


def test_each_parameter_has_its_own_error_and_students_quantile():
    np.testing.assert_array_equal(ESTIMATE.std_error, ERROR)
    np.testing.assert_allclose(ESTIMATE.quantile, 1.959964, rtol=1e-6)
    few = replace(ESTIMATE, details={"freedom": np.array([12.0, 4.0, np.inf])})
    np.testing.assert_allclose(few.quantile, [2.178813, 2.776445, 1.959964], rtol=1e-6)


def test_text_states_value_and_error_of_each_parameter():
    head, message, *rows = str(ESTIMATE).splitlines()
    assert head == "Estimate: 3 parameters, rank 2, condition 12.5, converged"
    assert message == "solved by hand"
    assert [row.split() for row in rows] == [
        ["a.m", "1.5", "+-", "0.1"],
        ["b.viscous", "-20", "+-", "3"],
        ["c.offset", "0.25", "+-", "inf"],
    ]
    assert repr(ESTIMATE) == f"<{head}>"


def test_rows_of_a_filter_that_forgets_or_gates_weigh_by_age():
    prior = np.zeros(3), np.ones(3)
    assert Kalman(np.ones(2), *prior).weighing == RLS(np.ones(2), 0.9, *prior).weighing == "by age"
    assert RLS(np.ones(2)).weighing == "by joint"
