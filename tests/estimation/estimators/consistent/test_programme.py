"""The entropic penalty, equalities and bounds of the convex programme of a consistent fit."""

import numpy as np
import pytest
import scipy.stats

from robotid.estimation.estimators.consistent.body_constraints import Bounds, Subspace
from robotid.estimation.estimators.consistent.consistent_fit import Entropic
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
)

LAYOUT = ParameterLayout(bodies=("one", "two"), joints=("a", "b"), terms=("viscous",))


@pytest.fixture
def prior(rng):
    """Two bodies of different size, and two drives."""
    half = rng.standard_normal((2, 4, 6))
    J = half @ half.transpose(0, 2, 1) * np.array([1.0, 0.01])[:, None, None]
    bodies = [inertial_from_pseudo_inertia(J_i) for J_i in J]
    return np.concatenate([*bodies, [0.3, 0.1]])


@pytest.fixture
def std(prior):
    spread = []
    for J in pseudo_inertia(prior[:20]):
        m, r = J[3, 3], np.sqrt(np.trace(J[:3, :3]) / J[3, 3])
        spread += [m, *[m * r] * 3, *[m * r**2] * 6]
    return np.array([*spread, 1.0, 2.0])


def penalty_of(prior, std, held=None):
    return Entropic.of(LAYOUT, prior, std, np.zeros(20) if held is None else held)


def differences(function, pi, steps):
    return np.array(
        [(function(pi + h) - function(pi - h)) / (2 * h.max()) for h in np.diag(steps)]
    ).T


def test_gradient_and_hessian_are_those_of_finite_differences(prior, std):
    penalty, pi = penalty_of(prior, std), 1.0 * prior
    pi[[1, 5, 14, 20]] += 0.05 * std[[1, 5, 14, 20]]
    gradient, hessian = penalty.gradient(pi), penalty.hessian(pi)
    steps, units = 1e-5 * std, np.outer(std, std)
    for exact, function, unit in (
        (gradient, penalty.value, std),
        (hessian, penalty.gradient, units),
    ):
        atol = 1e-6 * np.abs(exact * unit).max()
        numeric = differences(function, pi, steps)
        np.testing.assert_allclose(exact * unit, numeric * unit, atol=atol)
    assert np.linalg.eigvalsh(hessian * units).min() > 0


def test_it_is_the_divergence_of_two_gaussians(prior, std):
    # -log det's Bregman divergence is twice the Kullback-Leibler divergence of N(0, J), N(0, P)
    penalty = penalty_of(prior, std)
    pi = prior.copy()
    pi[:10] *= 1.3
    J, P = pseudo_inertia(pi[:10])[0], pseudo_inertia(prior[:10])[0]
    rng = np.random.default_rng(1)
    x = rng.multivariate_normal(np.zeros(4), J, 200_000)
    gap = scipy.stats.multivariate_normal(cov=J).logpdf(x)
    gap -= scipy.stats.multivariate_normal(cov=P).logpdf(x)
    assert penalty.value(pi) == pytest.approx(4 * gap.mean(), abs=5 * 4 * gap.std() / 447)
    pi[0] = -1.0
    assert penalty.value(pi) == np.inf


def moved(pi, H):
    """Return inertial parameters of two bodies in another frame and scale of length."""
    bodies = [inertial_from_pseudo_inertia(H @ J @ H.T) for J in pseudo_inertia(pi[:20])]
    return np.concatenate([*bodies, pi[20:]])


def test_it_depends_on_neither_frame_nor_units(prior, std, rng):
    H = np.eye(4)
    H[:3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    H[:3, 3] = [0.3, -0.2, 0.5]
    pi = prior.copy()
    pi[[0, 4, 12]] += 0.05 * std[[0, 4, 12]]
    here = penalty_of(prior, std).value(pi)
    assert penalty_of(moved(prior, H), std).value(moved(pi, H)) == pytest.approx(here, rel=1e-9)
    # the same robot in millimetres and grams
    units = np.array([1e3, *[1e6] * 3, *[1e9] * 6])
    scale = np.concatenate([units, units, [1.0, 1.0]])
    assert penalty_of(prior * scale, std * scale).value(pi * scale) == pytest.approx(here, rel=1e-8)


def test_a_prior_without_mass_is_widened_to_a_hundredth_of_its_size(prior, std):
    pi = prior.copy()
    pi[:10] = 0.0
    penalty = penalty_of(pi, std)
    assert 0.0 < penalty.centre[0] <= 0.011 * std[0]
    np.testing.assert_allclose(penalty.centre[10:], pi[10:], rtol=1e-13)
    assert np.isfinite(penalty.hessian(penalty.centre)).all()


def test_the_known_part_of_a_body_is_no_part_of_the_distance(prior, std):
    held = np.zeros(20)
    held[:10] = 0.5 * prior[:10]
    pi = prior.copy()
    pi[0] *= 1.05
    free, with_held = (penalty_of(prior, std, h) for h in (None, held))
    # the rest is half as large, so that the same change is twice as much of it
    assert with_held.value(pi) > 3 * free.value(pi)


def test_a_subspace_holds_what_the_equalities_say(rng):
    E = np.array([[1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    space = Subspace.of(E, np.array([6.0, 2.0, 2.0]))
    for y in rng.standard_normal((5, space.basis.shape[1])):
        np.testing.assert_allclose(E @ (space.origin + space.basis @ y), [6.0, 2.0, 2.0])
    assert space.basis.shape == (4, 2)
    whole = np.hstack([space.basis, space.fixed])
    np.testing.assert_allclose(whole.T @ whole, np.eye(4), atol=1e-14)


def test_a_bound_is_active_at_its_face_only():
    bounds = Bounds(np.array([[2.0, 0.0], [0.0, 1.0]]), np.array([-2.0, 0.0]), ("a", "b"))
    assert bounds.active(np.array([1.0, 5.0]), 1e-6) == ("a",)
