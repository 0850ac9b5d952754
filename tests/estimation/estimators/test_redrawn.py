"""Standard errors where bounds bind: projections, closed forms, what the fit makes of them."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
from helpers.driven import arm
from helpers.estimation import EXACT
from helpers.synthetic import exact_log, truth

from robotid.data.signals import process
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.estimators import Consistent
from robotid.estimation.estimators.interior_point import nearest
from robotid.robot.prior import prior_spread


@pytest.fixture
def inside(rng):
    """A fit whose prior is so narrow and so far inside that no bound binds."""
    model = arm()
    trajectory = process(exact_log(model, truth(model), rng), EXACT)
    prior = model.standard_parameters()
    spread = 1e-3 * prior_spread(model, trajectory.squares, len(trajectory.t))
    prior[model.layout.n_inertial :] = 100.0 * spread[model.layout.n_inertial :]
    K = structural_mapping(model).K
    return Consistent(model.layout, K, prior, spread)


def information(fit, rng, strength):
    """Return rows that agree with the prior: |R (beta - K prior)|^2, R of some strength."""
    b = len(fit.K)
    unit = np.sqrt(np.sum((fit.K * fit.prior_std) ** 2, axis=1))
    R = strength * np.triu(rng.standard_normal((b, b)) + 3.0 * np.eye(b)) / unit
    return np.column_stack([R, R @ (fit.K @ fit.prior)])


def test_the_nearest_point_is_that_of_a_quadratic_programme(rng):
    # a thin cone, where many rows hold a point at once
    G, h = rng.standard_normal((30, 12)), np.full(30, -0.5)
    G[:, 0] = np.abs(G[:, 0]) + 1.0
    for point in 10.0 * rng.standard_normal((5, 12)):
        found = nearest(G, h, point)
        assert (G @ found + h).min() > -1e-10
        solution = scipy.optimize.minimize(
            lambda x, point=point: np.sum((x - point) ** 2), found + 0.1, method="SLSQP",
            constraints={"type": "ineq", "fun": lambda x: G @ x + h},
        )  # fmt: skip
        np.testing.assert_allclose(found, solution.x, atol=1e-4)
        apart = nearest(np.vstack([G, -G[:1]]), np.append(h, -0.5), point)
        assert apart == "infeasible"


@pytest.mark.parametrize(
    ("meat_over_bread", "pull", "weight"), [(1.0, 1.0, 1.0), (9.0, 0.25, 1.0), (2.0, 3.0, 16.0)]
)
def test_where_no_bound_binds_it_is_the_covariance(inside, rng, meat_over_bread, pull, weight):
    rows = information(inside, rng, 1.0)
    R = rows[:, :-1]
    meat = meat_over_bread * R.T @ R
    found, failures = inside.programme.redrawn(rows, weight, inside.prior, meat, pull, 3000, rng)
    assert failures == []
    L = 0.5 * weight * inside.programme.penalty.hessian(inside.prior)
    B = np.linalg.inv(inside.K.T @ R.T @ R @ inside.K + L)
    expected = B @ (inside.K.T @ meat @ inside.K + pull * L) @ B
    scale = np.sqrt(np.diag(expected))
    difference = (found.T @ found / len(found) - expected) / np.outer(scale, scale)
    assert np.abs(np.diag(difference)).max() < 0.12  # 3000 draws know a variance to 2.6 %
    assert np.sqrt(np.mean(difference**2)) < 0.03


def test_on_a_bound_half_of_the_fits_stay_there(inside, rng):
    # prior and data put a friction coefficient at its bound, and tell nothing else of it
    i = inside.layout.names.index("elbow_joint.viscous")
    prior = inside.prior.copy()
    prior[i] = 0.0
    fit = replace(inside, prior=prior, K=np.delete(inside.K, np.flatnonzero(inside.K[:, i]), 0))
    rows = information(fit, rng, 1.0)
    meat = rows[:, :-1].T @ rows[:, :-1]
    found, _ = fit.programme.redrawn(rows, 1.0, prior, meat, 1.0, 2000, rng)
    away = found[:, i] / fit.prior_std[i]
    assert away.min() > -2e-3
    assert np.mean(away < 2e-3) == pytest.approx(0.5, abs=0.04)
    assert np.mean(away**2) == pytest.approx(0.5, abs=0.06)  # E max(0, z)^2
