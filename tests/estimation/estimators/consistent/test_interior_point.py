"""The fit with the entropic prior against its conditions of optimality, Clarabel, and limits."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.exceptions import NotConvergedError
from robotid.dynamics.base_parameters import structural_mapping
from robotid.estimation.estimators import Consistent
from robotid.estimation.estimators.consistent.body_constraints import Constraints
from robotid.estimation.estimators.consistent.interior_point import _Direction, _Point, _System
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.robot.prior import prior_spread

ROBOTS = ("ur10_robot.urdf", "panda.urdf", "double_pendulum.urdf")


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
    fit = Consistent(model.layout, K, prior, std, metric="entropic", **settings)
    pi = possible(prior, fit.layout.n_inertial, std, rng)
    unit = np.linalg.norm(K * std, axis=1)
    R = 10.0 ** rng.uniform(-1.0, 3.0, (len(K), 1)) * rng.standard_normal((len(K), len(K))) / unit
    return fit, np.column_stack([R, R @ (K @ pi) + rng.standard_normal(len(K))])


def slope(fit, rows, weight, pi):
    """Return the gradient of half the objective, in units of the spread."""
    D = rows[:, :-1] @ fit.K
    data = D.T @ (D @ pi - rows[:, -1])
    return (data + 0.5 * weight * fit.penalty.gradient(pi)) * fit.prior_std


@pytest.mark.parametrize("file", ROBOTS)
@pytest.mark.parametrize("weight", [0.1, 1.0, 100.0])
def test_the_slope_is_held_by_the_inequalities_that_bind(file, weight, rng):
    fit, rows = random_fit(file, rng)
    found = fit.programme.minimise(rows, weight)
    cone, x = fit.programme.cone.linear, found.x / fit.prior_std
    slack, multipliers = cone.G @ x + cone.h, found.multipliers
    gradient = slope(fit, rows, weight, found.x)
    np.testing.assert_allclose(
        gradient,
        cone.G.T @ multipliers,
        atol=1e-7 * np.abs(slope(fit, rows, weight, fit.prior)).max(),
    )
    assert slack.min() > -1e-9
    assert multipliers.min() >= 0
    assert (multipliers * slack).max() < 1e-5  # of an objective of some hundreds
    assert np.isfinite(fit.penalty.value(found.x))


@pytest.mark.parametrize("file", ROBOTS)
@pytest.mark.parametrize("share", [None, (0.9, 0.9), (0.8, 0.9)])
def test_clarabel_would_not_go_on_from_it(file, share, rng):
    fit, rows = random_fit(file, rng)
    whole = fit.prior[: fit.layout.n_inertial : 10].sum()
    low, high = (0.0, np.inf) if share is None else (share[0] * whole, share[1] * whole)
    fit = replace(fit, constraints=Constraints(total_mass=(low, high)))
    found = fit.programme.minimise(rows, 1.0)
    again = fit.programme.expanded(rows, 1.0, found.x)
    spread = np.sqrt(np.diag(fit.programme.covariance(1.0, rows, found.x)))
    moved = np.abs(again.x - found.x) / np.maximum(spread, 1e-9 * fit.prior_std)
    assert moved.max() < 1e-5
    total = found.x[: fit.layout.n_inertial : 10].sum()
    assert low - 1e-9 <= total <= high + 1e-9


def test_what_equalities_hold_stays_and_the_rest_is_the_minimum_beside_it(rng):
    fit, rows = random_fit("ur10_robot.urdf", rng)
    body = fit.layout.bodies[2]
    fit = replace(
        fit, constraints=Constraints(pinned=(body,), mass={fit.layout.bodies[4]: (1.5, 1.5)})
    )
    found = fit.programme.minimise(rows, 1.0)
    np.testing.assert_allclose(found.x[20:30], fit.prior[20:30], atol=1e-9)
    assert found.x[40] == pytest.approx(1.5, abs=1e-9)
    held = fit.programme.space.fixed  # along all others the slope is that of the inequalities
    gradient = slope(fit, rows, 1.0, found.x) - fit.programme.cone.linear.G.T @ found.multipliers
    along = gradient - held @ (held.T @ gradient)
    assert np.abs(along).max() < 1e-7 * np.abs(slope(fit, rows, 1.0, fit.prior)).max()


def test_without_data_the_prior_is_found(rng):
    fit, rows = random_fit("panda.urdf", rng)
    found = fit.programme.minimise(0.0 * rows, 1.0)
    np.testing.assert_allclose(found.x, fit.penalty.centre, atol=1e-6)


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


def test_a_rough_fit_is_right_to_a_hundredth_of_a_spread(rng):
    fit, rows = random_fit("ur10_robot.urdf", rng)
    rough, exact = (fit.programme.minimise(rows, 1.0, is_exact=e) for e in (False, True))
    spread = np.sqrt(np.diag(fit.programme.covariance(1.0, rows, exact.x)))
    assert np.abs((rough.x - exact.x) / spread).max() < 0.1
    assert rough.n_iter < exact.n_iter


def test_a_share_that_is_held_is_left_to_the_bodies(rng):
    fit, rows = random_fit("double_pendulum.urdf", rng)
    held = np.zeros(fit.layout.n_inertial)
    held[:10] = 0.5 * fit.prior[:10]
    found = replace(fit, held=held).programme.minimise(rows, 1.0)
    rest = found.x[:10] - held[:10]
    assert rest[0] > 0
    gradient = slope(replace(fit, held=held), rows, 1.0, found.x)
    assert np.abs(gradient - fit.programme.cone.linear.G.T @ found.multipliers).max() < 1e-6 * (
        np.abs(slope(fit, rows, 1.0, fit.prior)).max()
    )


def test_bounds_that_contradict_each_other_are_named(rng):
    fit, rows = random_fit("ur10_robot.urdf", rng)
    far = fit.layout.bodies[2]
    apart = Constraints(
        com={far: (-np.eye(3)[:1], np.array([-5.0]))},
        extent={far: np.array([[-0.1] * 3, [0.1] * 3])},
    )
    fit = replace(fit, constraints=apart)
    with pytest.raises(NotConvergedError, match=r"no parameters meet all constraints .*extent"):
        fit.programme.minimise(rows, 1.0)


@pytest.mark.parametrize("together", [2**17, 1])
def test_data_sets_in_one_pass_are_fitted_as_one_by_one(together, rng, monkeypatch):
    monkeypatch.setattr(
        "robotid.estimation.estimators.consistent.cone_programme._TOGETHER", together
    )
    fit, rows = random_fit("ur10_robot.urdf", rng)
    body = fit.layout.bodies[4]
    fit = replace(fit, constraints=Constraints(mass={body: (1.5, 1.5)}))
    sets = np.array([size * rows for size in (1.0, 1e-3, 0.1)])
    alone = [fit.programme.minimise(own, 1.0) for own in sets]
    assert len({solution.n_iter for solution in alone}) > 1  # they settle at different steps
    for starts in (None, alone):
        every = fit.programme.minimise_each(sets, 0.3, starts=starts)
        for k, (own, found) in enumerate(zip(sets, every, strict=True)):
            start = None if starts is None else starts[k]
            expected = fit.programme.minimise(own, 0.3, start=start)
            assert found.n_iter == expected.n_iter
            np.testing.assert_allclose(
                found.x / fit.prior_std, expected.x / fit.prior_std, atol=1e-9
            )
            np.testing.assert_allclose(found.multipliers, expected.multipliers, atol=1e-6)


def test_a_step_that_is_short_is_taken_again_without_correction_and_nearer_to_the_path():
    """Two points, one body and one inequality; the first point's corrected step is short."""
    aims, of_step = [], iter([np.array([0.2, 0.27]), np.array([0.5, 2.0])])

    def step(size):
        x, body = np.full((2, 1), size), np.full((2, 1, 4, 4), size)
        return _Direction(x, x, body, body, x, x)

    def direction(t, mu, cross, pairs):
        aims.append(np.column_stack([t, mu, cross[:, 0, 2, 3], pairs]))
        return step(1.0)

    system = SimpleNamespace(
        point=_Point(np.array([[1.0], [2.0]]), np.zeros((2, 1, 4, 4)), *np.ones((2, 2, 1))),
        length=np.full((2, 1, 4), np.sqrt(5.0)),
        weight=1.0,
        R_inverse=np.full((2, 1, 4, 4), np.eye(4)),
        G=np.ones((2, 1, 1)),
        direction=direction,
        to_boundary=lambda step: next(of_step),
    )
    found = _System.corrected(system, step(2.0), np.array([0.9, 0.5]))
    # left = (1 - share)^3, at least 0.3 if short; t = 1 + 4 left; products of 16 and 4 by the trust
    np.testing.assert_allclose(
        aims[0], [[1.004, 0.001, 14.4, 3.6], [1.5, 0.125, 8.0, 2.0]], rtol=1e-12
    )
    np.testing.assert_allclose(aims[1], [[2.2, 0.3, 0.0, 0.0], [1.5, 0.125, 8.0, 2.0]], rtol=1e-12)
    assert len(aims) == 2
    np.testing.assert_allclose(found.x, [[1.0 + 0.4975], [3.0]], rtol=1e-12)  # 0.995 of the way
    np.testing.assert_allclose(found.multipliers, [[1.4975], [2.0]], rtol=1e-12)
