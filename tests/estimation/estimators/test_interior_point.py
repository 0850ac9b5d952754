"""The fit with the entropic prior against Clarabel, its conditions of optimality, and limits."""

from dataclasses import replace

import clarabel
import numpy as np
import pytest
from scipy import sparse

from robotid.base.exceptions import NotConvergedError
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.estimators import Consistent
from robotid.estimation.estimators.consistent_fit import Constraints
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import (
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
)
from robotid.robot.prior import prior_spread

ROBOTS = ("ur10_robot.urdf", "panda.urdf", "double_pendulum.urdf")
UPPER = [(i, j) for j in range(8) for i in range(j + 1)]  # of an 8 x 8 matrix, by columns
LOWER = [(i, j) for i in range(4) for j in range(i + 1)]


def possible(prior, size, std, rng):
    """Return parameters that are not the prior's, of possible bodies and drives."""
    half = np.linalg.cholesky(pseudo_inertia(prior[:size]) + 1e-6 * np.eye(4))
    turned = half @ (np.eye(4) + 0.2 * rng.standard_normal(half.shape))
    bodies = [inertial_from_pseudo_inertia(J) for J in turned @ turned.swapaxes(1, 2)]
    drives = prior[size:] + std[size:] * np.abs(rng.standard_normal(len(prior) - size))
    return np.concatenate([*bodies, drives * (rng.random(len(drives)) < 0.7)])


def random_fit(file, rng, **settings):
    """Return a fit to random data, of which some directions say little, and their rows."""
    model = RobotModel.from_urdf(example_urdf(file))
    K, prior = structural_mapping(model).K, model.standard_parameters()
    std = prior_spread(model, np.full((3, len(model.joints)), 300.0), 100)
    fit = Consistent(model.layout, K, prior, std, **settings)
    pi = possible(prior, fit.layout.n_inertial, std, rng)
    unit = np.linalg.norm(K * std, axis=1)
    R = 10.0 ** rng.uniform(-1.0, 3.0, (len(K), 1)) * rng.standard_normal((len(K), len(K))) / unit
    return fit, np.column_stack([R, R @ (K @ pi) + rng.standard_normal(len(K))])


def by_clarabel(fit, rows, weight, near, unit):
    """Return y of the minimum pi = near + unit y, stated as a cone programme."""
    # log det J is the largest sum t_i, t_i <= log Z_ii, of a lower triangle Z for which [[J, Z],
    # [Z^T, diag(Z_ii)]] is positive semidefinite. J is in units of that of near, and the columns of
    # unit meet the equalities.
    penalty, (p, n) = fit.programme.penalty, (unit.shape[1], len(fit.layout.bodies))
    count, basis = p + 14 * n, pseudo_inertia_basis()
    A, drives = rows[:, :-1] @ fit.K, slice(10 * n, None)
    D = np.sqrt(weight * penalty.precision)
    H, q = np.zeros((count, count)), np.zeros(count)
    for M, r in (
        (A @ unit, rows[:, -1] - A @ near),
        (D[:, None] * unit[drives], D * (penalty.centre - near)[drives]),
    ):
        H[:p, :p] += M.T @ M
        q[:p] -= M.T @ r
    bounds, G = fit.programme.bounds, fit.programme.bounds.G / fit.prior_std
    size, slack = np.linalg.norm(G @ unit, axis=1), G @ near + bounds.h
    nonnegative = clarabel.NonnegativeConeT(len(slack))
    parts = [(np.pad(G @ unit, ((0, 0), (0, 14 * n))) / size[:, None], slack / size, nonnegative)]
    for k, J in enumerate(pseudo_inertia(near[: 10 * n] - penalty.held)):
        first = p + 14 * k
        own = np.tensordot(unit[10 * k : 10 * k + 10].T, basis, 1)  # (p, 4, 4)
        q[:p] += weight * np.trace(np.linalg.solve(penalty.prior[k], own), axis1=1, axis2=2)
        q[first + 10 : first + 14] -= weight
        half = np.linalg.inv(np.linalg.cholesky(J))
        big, constant = np.zeros((count, 8, 8)), np.diag([1.0] * 4 + [0.0] * 4)
        big[:p, :4, :4] = half @ own @ half.T
        for m, (i, j) in enumerate(LOWER):
            big[first + m, i, 4 + j] = big[first + m, 4 + j, i] = 1.0
            big[first + m, 4 + i, 4 + i] = float(i == j)
        factor = np.array([1.0 if i == j else np.sqrt(2.0) for i, j in UPPER])
        entries = [(big[:, i, j], constant[i, j]) for i, j in UPPER]
        M, b = (np.array(x) for x in zip(*entries, strict=True))
        parts.append((M * factor[:, None], b * factor, clarabel.PSDTriangleConeT(8)))
        for i in range(4):
            M = np.zeros((3, count))
            M[0, first + 10 + i] = M[2, first + LOWER.index((i, i))] = 1.0
            parts.append((M, np.array([0.0, 1.0, 0.0]), clarabel.ExponentialConeT()))
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
    matrices, constants, cones = zip(*parts, strict=True)
    upper, rows = sparse.csc_matrix(np.triu(H)), sparse.csc_matrix(-np.vstack(matrices))
    solver = clarabel.DefaultSolver(upper, q, rows, np.concatenate(constants), cones, settings)
    return np.array(solver.solve().x)[:p]


@pytest.mark.parametrize("file", ROBOTS)
@pytest.mark.parametrize("weight", [0.1, 1.0, 100.0])
@pytest.mark.parametrize("bounded", [False, True])
def test_the_minimum_is_that_of_clarabel(file, weight, bounded, rng):
    fit, rows = random_fit(file, rng)
    if bounded:
        size, body = fit.layout.n_inertial, fit.layout.bodies[-1]
        total, m = fit.prior[:size:10].sum(), fit.prior[size - 10]
        held = np.concatenate([0.4 * fit.prior[:10], np.zeros(size - 10)])
        bounds = Constraints(total_mass=(0.8 * total, 0.9 * total), mass={body: (1.1 * m, 1.1 * m)})
        fit = replace(fit, constraints=bounds, held=held)
    found = fit.programme.minimise(rows, weight)
    covariance = fit.programme.covariance(weight, rows, found.x)
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-18 * fit.prior_std**2))
    # Clarabel is exact in units of the spread; it does not start at our minimum
    values, axes = np.linalg.eigh(covariance / np.outer(spread, spread))
    unit = spread[:, None] * (axes * np.sqrt(np.maximum(values, 0.0)))[:, values > 1e-12]
    away = 0.1 * rng.standard_normal(unit.shape[1]) / np.sqrt(unit.shape[1])
    y = by_clarabel(fit, rows, weight, found.x + unit @ away, unit)
    assert np.abs(unit @ (y + away) / spread).max() < 1e-6
    assert bounded == any(
        "mass" in label for label in fit.programme.bounds.active(found.x / fit.prior_std, 1e-5)
    )


def slope(fit, rows, weight, pi):
    """Return the gradient of half the objective, in units of the spread."""
    D = rows[:, :-1] @ fit.K
    data = D.T @ (D @ pi - rows[:, -1])
    return (data + 0.5 * weight * fit.programme.penalty.gradient(pi)) * fit.prior_std


@pytest.mark.parametrize("file", ROBOTS)
def test_the_slope_is_held_by_what_binds(file, rng):
    fit, rows = random_fit(file, rng)
    first, second = fit.layout.bodies[:2]
    held = np.zeros(fit.layout.n_inertial)
    held[10:20] = 0.1 * fit.prior[10:20]
    bounds = Constraints(pinned=(first,), mass={second: (1.5, 1.5)})
    fit = replace(fit, constraints=bounds, held=held)
    found = fit.programme.minimise(rows, 1.0)
    np.testing.assert_allclose(found.x[:10], fit.prior[:10], atol=1e-9)
    assert found.x[10] == pytest.approx(1.5, abs=1e-9)
    bounds, fixed = fit.programme.bounds, fit.programme.space.fixed
    slack = bounds.G @ (found.x / fit.prior_std) + bounds.h
    gradient = slope(fit, rows, 1.0, found.x) - bounds.G.T @ found.multipliers
    along = gradient - fixed @ (fixed.T @ gradient)
    assert np.abs(along).max() < 1e-7 * np.abs(slope(fit, rows, 1.0, fit.prior)).max()
    assert slack.min() > -1e-9
    assert found.multipliers.min() >= 0
    assert (found.multipliers * slack).max() < 1e-5  # of an objective of some hundreds
    assert np.isfinite(fit.programme.penalty.value(found.x))


@pytest.mark.parametrize(("weight", "most"), [(10.0, 9), (1.0, 7), (0.1, 5)])
def test_a_start_near_the_minimum_saves_steps_and_changes_nothing(weight, most, rng):
    fit, rows = random_fit("panda.urdf", rng)
    cold = fit.programme.minimise(rows, 0.1)
    near = fit.programme.minimise(rows, weight)
    warm = fit.programme.minimise(rows, 0.1, start=near)
    np.testing.assert_allclose(warm.x / fit.prior_std, cold.x / fit.prior_std, atol=1e-7)
    # as many as it takes today: wrong corrections and starts find the minimum, too, but later
    assert cold.n_iter <= 15
    assert warm.n_iter <= most


def test_bounds_that_contradict_each_other_are_no_fit(rng):
    fit, rows = random_fit("ur10_robot.urdf", rng)
    far = fit.layout.bodies[2]
    apart = Constraints(
        com={far: (-np.eye(3)[:1], np.array([-5.0]))},
        extent={far: np.array([[-0.1] * 3, [0.1] * 3])},
    )
    text = r"not converged after .* widen the bounds in \[estimator.constraints\]"
    with pytest.raises(NotConvergedError, match=text) as caught:
        replace(fit, constraints=apart).programme.minimise(rows, 1.0)
    assert caught.value.status == "max_iterations"


def test_data_sets_in_one_pass_are_fitted_as_one_by_one(rng):
    fit, rows = random_fit("ur10_robot.urdf", rng)
    body = fit.layout.bodies[4]
    fit = replace(fit, constraints=Constraints(mass={body: (1.5, 1.5)}))
    sets = np.array([size * rows for size in (1.0, 1e-3, 0.1, *np.geomspace(0.1, 1.0, 50))])
    alone = [fit.programme.minimise(own, 1.0) for own in sets]
    assert len({solution.n_iter for solution in alone}) > 1  # they settle at different steps
    for starts in (None, alone):
        every = fit.programme.minimise_each(sets, 0.3, starts=starts)
        for k in range(5):
            start = None if starts is None else starts[k]
            expected = fit.programme.minimise(sets[k], 0.3, start=start)
            assert every[k].n_iter == expected.n_iter
            wanted = expected.x / fit.prior_std
            np.testing.assert_allclose(every[k].x / fit.prior_std, wanted, atol=1e-9)
            np.testing.assert_allclose(every[k].multipliers, expected.multipliers, atol=1e-6)
