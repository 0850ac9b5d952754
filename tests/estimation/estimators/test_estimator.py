"""What an estimate shows of itself, and what estimators say of themselves."""

import re
from dataclasses import replace

import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.estimation.estimators import OLS, RLS, TLS, WLS, Estimate, Kalman, NormalisedGradient
from robotid.estimation.estimators.estimator import require_rows

THETA, ERROR = np.array([1.5, -20.0, 0.25]), np.array([0.1, 3.0, np.inf])
ESTIMATE = Estimate(
    theta=THETA,
    covariance=np.diag(ERROR**2) + 0.01 * (1 - np.eye(3)),
    names=("a.m", "b.viscous", "c.offset"),
    sigma=np.ones(2),
    rank=2,
    condition=12.5,
    undetermined=("c.offset",),
    converged=True,
    n_iter=3,
    message="solved by hand",
)


def test_each_parameter_has_its_own_error():
    np.testing.assert_array_equal(ESTIMATE.std_error, ERROR)


def test_intervals_reach_students_quantile():
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


@pytest.mark.parametrize(
    ("estimator", "weighing"),
    [
        (OLS(), "alike"),
        (WLS(), "by joint"),
        (TLS(), "by joint"),
        (RLS(np.ones(2)), "by joint"),
        (RLS(np.ones(2), 0.9, np.zeros(3), np.ones(3)), "by age"),
        (Kalman(np.ones(2), np.zeros(3), np.ones(3)), "by age"),
        (NormalisedGradient(np.ones(2)), "by step"),
    ],
)
def test_an_estimator_says_how_its_rows_weigh(estimator, weighing):
    assert estimator.weighing == weighing


@pytest.mark.parametrize(("rows", "wanted"), [(57, 97), (41, 97)])
def test_too_few_rows_are_reported_with_ten_samples_per_parameter_over_the_joints(rows, wanted):
    """Of six joints: a sample has six rows."""
    text = (
        f"{rows} torque rows for 58 parameters: too few rows to fit; record at least {wanted} "
        "samples, or reduce min_velocity and trim"
    )
    with pytest.raises(DataError, match=f"^{re.escape(text)}$"):
        require_rows(rows, 58, 6)
    with pytest.raises(DataError, match=r"^0 torque rows for 58 parameters: no joint moves"):
        require_rows(0, 58, 6)
    require_rows(58, 58, 6)
