"""Log-Cholesky against Pinocchio, finite differences and the cone programme."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.driven import arm
from helpers.estimation import EXACT, NOISE, Case, consistent
from helpers.fitting import identify
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import SettingsError
from robotid.dynamics.factors import compress
from robotid.estimation.estimators.consistent.body_constraints import Constraints
from robotid.estimation.estimators.consistent.log_cholesky import (
    LogCholesky,
    from_log_cholesky,
    log_cholesky_curvature,
    log_cholesky_jacobian,
    to_log_cholesky,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.robot.geometry import body_boxes
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia

LEVEL = NOISE[1:4]  # of the joints of the arm [N m]


def make_case(rng, noise):
    case = Case(arm(), rng, noise)
    return consistent(case), compress(case.problem)


@pytest.fixture(scope="module")
def case():
    """A fit at whose optimum constraints bind, and its factors."""
    return make_case(np.random.default_rng(0), 10 * LEVEL)


def test_it_is_pinocchios_parameterisation(rng):
    for z in 0.5 * rng.standard_normal((5, 10)):
        theirs = pin.LogCholeskyParameters(z)
        ours = inertial_from_pseudo_inertia(from_log_cholesky(z[None])[0])
        np.testing.assert_allclose(ours, theirs.toDynamicParameters(), rtol=1e-12, atol=1e-13)
        slopes = [inertial_from_pseudo_inertia(dJ) for dJ in log_cholesky_jacobian(z[None])[0]]
        np.testing.assert_allclose(
            np.array(slopes).T, theirs.calculateJacobian(), rtol=1e-11, atol=1e-12
        )
        np.testing.assert_allclose(to_log_cholesky(from_log_cholesky(z[None]))[0], z, atol=1e-10)


def test_curvature_is_that_of_finite_differences(rng):
    z, G = 0.5 * rng.standard_normal((1, 10)), rng.standard_normal((1, 4, 4))
    G = G + G.transpose(0, 2, 1)

    def slope(z):
        return np.einsum("nij,nkij->nk", G, log_cholesky_jacobian(z))[0]

    h = 1e-6
    numeric = [(slope(z + h * v) - slope(z - h * v)) / (2 * h) for v in np.eye(10)]
    np.testing.assert_allclose(log_cholesky_curvature(z, G)[0], numeric, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("metric", ["riemannian", "entropic"])
def test_gradient_and_hessian_of_the_fit_are_those_of_finite_differences(case, metric, rng):
    fit, factors = case
    fit = replace(fit, metric=metric, constraints=Constraints(extent=body_boxes(arm())))
    smooth, rows = LogCholesky(fit), fit.rows(factors, LEVEL)
    z = smooth._coordinates(fit.fit(factors).theta) + 0.2 * rng.standard_normal(len(fit.prior))
    # some extents are left, others not
    price, stiffness = np.linspace(0.0, 1e3, 9), 1e4
    assert 0 < ((smooth._extents @ smooth._parameters(z)[0]) < price / stiffness).sum() < 9
    slope, hessian = smooth.derivatives(rows, z, price, stiffness)
    h, numeric, bent = 1e-5, [], []
    for step in h * np.eye(len(z)):
        ends = [smooth.objective(rows, z + s, price, stiffness) for s in (step, -step)]
        numeric.append((ends[0] - ends[1]) / (2 * h))
        slopes = [smooth.derivatives(rows, z + s, price, stiffness)[0] for s in (step, -step)]
        bent.append((slopes[0] - slopes[1]) / (2 * h))
    np.testing.assert_allclose(slope, numeric, atol=1e-6 * np.abs(slope).max())
    np.testing.assert_allclose(hessian, bent, atol=1e-6 * np.abs(hessian).max())


@pytest.mark.parametrize("metric", ["euclidean", "riemannian", "entropic"])
def test_it_agrees_with_the_cone_programme_where_no_constraint_binds(rng, metric):
    fit, factors = make_case(rng, 1e-2 * LEVEL)
    # data and prior agree: all bodies are well inside
    fit = replace(fit, metric=metric, prior=truth(arm()))
    cone, smooth = fit.fit(factors), LogCholesky(fit).fit(factors)
    assert cone.details["active"] == []
    difference = (smooth.theta - cone.theta) / fit.prior_std
    assert np.abs(difference).max() < 1e-6
    assert abs(smooth.details["gaps"][0]) < 1e-9
    assert smooth.converged


def test_curvatures_of_any_size_are_settled_in_a_few_steps_of_limited_length(rng):
    """A parabola of curvatures 1e6 to 1e-4; a step changes no coordinate by more than four."""
    size = np.array([1e3, 1.0, 1e-2])
    root = rng.standard_normal((5, 3))
    H, least = size[:, None] * (root.T @ root) * size, np.array([0.5, -2.0, 9.0])
    visited = []

    def objective(rows, z, price, stiffness):
        assert (rows, price, stiffness) == ("rows", "price", "stiffness")
        visited.append(z)
        return 3.0 + 0.5 * float((z - least) @ H @ (z - least))

    def derivatives(rows, z, price, stiffness):
        return H @ (z - least), H

    fit = SimpleNamespace(objective=objective, derivatives=derivatives)
    z, steps, converged = LogCholesky._settle(fit, "rows", np.zeros(3), "price", "stiffness")
    np.testing.assert_allclose(z, least, atol=1e-4)
    assert converged
    assert 4 <= steps <= 8
    moves = np.abs(np.diff(visited, axis=0)).max(axis=1)
    np.testing.assert_allclose(moves[0], 4.0)
    assert moves.max() < 4.0 + 1e-9


def test_multipliers_are_updated_until_they_change_no_more():
    """Two parameters, one extent; the second round finds the multiplier of the first."""
    rounds, ends = [], [0.75, 2.0, 2.0, 2.0]

    def settle(rows, z, price, stiffness):
        rounds.append((z, price.tolist(), stiffness))
        return np.array([ends[len(rounds) - 1], 5.0]), 3, True

    fit = SimpleNamespace(
        fit_in_cone=SimpleNamespace(objective=lambda rows, pi: 7.0 + pi[1] - 5.0),
        _parameters=lambda z: (z, None),
        _extents=np.array([[1.0, -0.2]]),  # -0.25 after the first round, 1 after the second
        _settle=settle,
    )
    z, value, steps, converged = LogCholesky._descend(fit, "rows", np.array([0.0, 5.0]))
    assert (value, steps, converged) == (7.0, 9, True)
    assert z.tolist() == [2.0, 5.0]
    prices = [price for _, price, _ in rounds]
    np.testing.assert_allclose(prices, [[0.0], [17.5], [0.0]], rtol=1e-12)  # 70 * 0.25
    assert {stiffness for *_, stiffness in rounds} == {70.0}


def test_at_active_constraints_the_gap_is_stated_and_small(case):
    fit, factors = case
    cone, smooth = fit.fit(factors), LogCholesky(fit, starts=1).fit(factors)
    assert cone.details["active"]
    gaps = smooth.details["gaps"]
    assert len(gaps) == 2
    assert abs(gaps[0]) < 1e-6
    assert min(gaps) > -1e-6  # nothing lies below the optimum of a convex programme
    rows = fit.rows(factors, cone.sigma)
    ratio = fit.objective(rows, smooth.theta) / fit.objective(rows, cone.theta)
    assert ratio - 1.0 == pytest.approx(min(gaps), abs=1e-12)


def test_every_end_is_possible(case):
    fit, factors = case
    held = np.zeros(30)
    held[20:] = 0.5 * fit.prior[20:30]
    fit = replace(fit, held=held)
    estimate = LogCholesky(fit, starts=1, rng=np.random.default_rng(1)).fit(factors)
    slack = fit.programme.cone.slack(estimate.theta / fit.prior_std)
    assert slack.min() > -1e-12


def test_it_knows_no_further_constraints(case):
    bounds = Constraints(total_mass=(1.0, 2.0))
    with pytest.raises(SettingsError, match="'log_cholesky' supports only the constraints"):
        LogCholesky(replace(case[0], constraints=bounds))


def test_identify_takes_it_by_name(ur5, rng):
    forearm = RobotModel.from_urdf(ur5.tree.path, joints=ur5.joints[2:4])
    log = exact_log(forearm, truth(forearm), rng, noise=NOISE[2:4])
    settings = EstimatorSettings("log_cholesky", starts=2, seed=2)
    found = identify(forearm, [log], signals=EXACT, estimator=settings)
    other = identify(forearm, [log], signals=EXACT)
    assert found.is_consistent
    assert len(found.estimate.details["gaps"]) == 3
    np.testing.assert_allclose(found.base, other.base, atol=1e-5 * np.abs(other.base).max())


def test_a_fit_that_is_out_of_steps_has_not_converged(monkeypatch):
    monkeypatch.setattr("robotid.estimation.estimators.consistent.log_cholesky._STEPS", 0)
    flat = SimpleNamespace(objective=lambda *_: 1.0)
    assert LogCholesky._settle(flat, None, 5.0, None, 1.0) == (5.0, 0, False)
