"""The metrics of a prior, against finite differences and changes of frame."""

import numpy as np
import pytest
import scipy.stats

from robotid.estimation.estimators.consistent.penalties import (
    METRICS,
    make_penalty,
    pull_back_metric,
)
from robotid.robot.parameters import (
    ParameterLayout,
    inertial_from_pseudo_inertia,
    pseudo_inertia,
    pseudo_inertia_basis,
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


def penalty_of(metric, prior, std, held=None):
    return make_penalty(metric, LAYOUT, prior, std, np.zeros(20) if held is None else held)


def differences(function, pi, steps):
    return np.array(
        [(function(pi + h) - function(pi - h)) / (2 * h.max()) for h in np.diag(steps)]
    ).T


@pytest.mark.parametrize("metric", METRICS)
def test_gradient_and_hessian_are_those_of_finite_differences(metric, prior, std):
    penalty, pi = penalty_of(metric, prior, std), 1.0 * prior
    pi[[1, 5, 14, 20]] += 0.05 * std[[1, 5, 14, 20]]
    gradient, hessian = penalty.gradient(pi), penalty.hessian(pi)
    steps = 1e-5 * std
    np.testing.assert_allclose(
        gradient * std,
        differences(penalty.value, pi, steps) * std,
        atol=1e-6 * np.abs(gradient * std).max(),
    )
    units = np.outer(std, std)
    numeric = differences(penalty.gradient, pi, steps)
    np.testing.assert_allclose(
        hessian * units, numeric * units, atol=1e-6 * np.abs(hessian * units).max()
    )
    assert np.linalg.eigvalsh(hessian * units).min() > 0


@pytest.mark.parametrize("metric", METRICS)
def test_a_penalty_is_zero_at_its_prior_only(metric, prior, std):
    penalty = penalty_of(metric, prior, std)
    np.testing.assert_allclose(penalty.centre, prior, rtol=1e-13)
    assert penalty.value(prior) == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(penalty.gradient(prior) * std, 0.0, atol=1e-9)
    other = prior.copy()
    other[0] *= 1.1
    assert penalty.value(other) > 1e-3


def test_the_entropic_one_is_the_divergence_of_two_gaussians(prior, std):
    # -log det's Bregman divergence is twice the Kullback-Leibler divergence of N(0, J), N(0, P)
    penalty = penalty_of("entropic", prior, std)
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


def test_the_riemannian_metric_is_half_the_hessian_of_the_entropic_one_at_the_prior(prior, std):
    entropic, riemannian = (penalty_of(m, prior, std) for m in ("entropic", "riemannian"))
    np.testing.assert_allclose(
        riemannian.hessian(prior) * np.outer(std, std),
        entropic.hessian(prior) * np.outer(std, std),
        rtol=1e-12,
        atol=1e-12,
    )
    # g is the affine-invariant length tr((J^-1 dJ)^2)
    step = np.arange(10.0)
    J, dJ = pseudo_inertia(prior[:10])[0], np.tensordot(step, pseudo_inertia_basis(), 1)
    (g,) = pull_back_metric(J[None])
    ratio = np.linalg.solve(J, dJ)
    assert step @ g @ step == pytest.approx(np.trace(ratio @ ratio))


def moved(pi, H):
    """Return inertial parameters of two bodies in another frame and scale of length."""
    bodies = [inertial_from_pseudo_inertia(H @ J @ H.T) for J in pseudo_inertia(pi[:20])]
    return np.concatenate([*bodies, pi[20:]])


@pytest.mark.parametrize("metric", METRICS)
def test_only_the_euclidean_one_depends_on_the_frame(metric, prior, std, rng):
    H = np.eye(4)
    H[:3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    H[:3, 3] = [0.3, -0.2, 0.5]
    pi = prior.copy()
    pi[[0, 4, 12]] += 0.05 * std[[0, 4, 12]]
    here = penalty_of(metric, prior, std).value(pi)
    there = penalty_of(metric, moved(prior, H), std).value(moved(pi, H))
    if metric == "euclidean":
        assert abs(there - here) > 0.01 * here
    else:
        assert there == pytest.approx(here, rel=1e-9)


@pytest.mark.parametrize("metric", METRICS)
def test_the_penalty_has_no_units(metric, prior, std):
    # the same robot in millimetres and grams
    units = np.array([1e3, *[1e6] * 3, *[1e9] * 6])
    scale = np.concatenate([units, units, [1.0, 1.0]])
    pi = prior.copy()
    pi[[0, 4, 12]] += 0.05 * std[[0, 4, 12]]
    here = penalty_of(metric, prior, std).value(pi)
    there = penalty_of(metric, prior * scale, std * scale).value(pi * scale)
    assert there == pytest.approx(here, rel=1e-8)


@pytest.mark.parametrize("metric", ["entropic", "riemannian"])
def test_a_prior_without_mass_is_widened_to_a_hundredth_of_its_size(metric, prior, std):
    pi = prior.copy()
    pi[:10] = 0.0
    penalty = penalty_of(metric, pi, std)
    assert 0.0 < penalty.centre[0] <= 0.011 * std[0]
    np.testing.assert_allclose(penalty.centre[10:], pi[10:], rtol=1e-13)
    assert np.isfinite(penalty.hessian(penalty.centre)).all()


def test_the_held_share_of_a_body_is_no_part_of_the_distance(prior, std):
    held = np.zeros(20)
    held[:10] = 0.5 * prior[:10]
    pi = prior.copy()
    pi[0] *= 1.05
    free, with_held = (penalty_of("entropic", prior, std, h) for h in (None, held))
    # the rest is half as large, so that the same change is twice as much of it
    assert with_held.value(pi) > 3 * free.value(pi)
