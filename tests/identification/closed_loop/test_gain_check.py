"""Scales of gains that are concluded, and those that are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.crane import identified_crane

from robotid.identification.closed_loop.further_parameters import GainScale, _last, gain_scale


@pytest.mark.parametrize(
    ("change", "common", "is_wrong"),
    [
        ((-0.2, -0.18), -0.19, True),
        ((0.2, 0.18), 0.19, True),
        ((-0.03, -0.03), -0.03, False),  # small
        ((-0.2, 0.6), -0.19, False),  # one joint shows another
    ],
)
def test_gains_are_wrong_where_all_joints_show_it(change, common, is_wrong):
    scale = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.006)
    assert scale.is_wrong is is_wrong
    unsure = GainScale(np.array(change), np.array([0.05, 0.05]), common, 0.07)
    assert not unsure.is_wrong


def test_the_last_unknowns_are_those_of_the_inverse(rng):
    A = rng.standard_normal((9, 5)) * [1.0, 1e3, 1.0, 1e-2, 10.0]
    H, x = A.T @ A, np.arange(1.0, 6.0)
    found, error = _last(H, H @ x, 2)
    np.testing.assert_allclose(found, x[3:], rtol=1e-8)
    np.testing.assert_allclose(error, np.sqrt(np.diag(np.linalg.inv(H)))[3:], rtol=1e-8)
    A[:, 4] = A[:, 0]  # the last is not distinguishable from the first, that before it is
    _, error = _last(A.T @ A, A.T @ A @ x, 2)
    left = np.linalg.inv(A[:, :4].T @ A[:, :4])
    assert error[0] == pytest.approx(np.sqrt(left[3, 3]), rel=1e-8)
    assert error[1] == np.inf


def test_scales_are_one_step_of_gains_beside_all_that_was_found(tmp_path, rng):
    """Of a normal matrix that is given: the gains of a joint change together, or all of them."""
    found = identified_crane(tmp_path)
    simulator, c, n = found.fit.simulator, len(found.estimate.theta), 2
    theta = found.estimate.theta.copy()
    theta[3] = simulator.bounds[0, 3]  # at its bound, which no step moves
    A = rng.standard_normal((40, c + 2 * n))
    H, g = A.T @ A, rng.standard_normal(c + 2 * n)
    asked = []

    def normal(wide, weights, at, *, frees):
        asked.append((wide.names[c:], weights, at, frees))
        return H, g

    estimator = SimpleNamespace(normal=normal, weights=lambda wide, at: ("weights of", at.tolist()))
    kp, kd = simulator.base.kp, simulator.base.kd
    for inflation, factor in ((4.0, 2.0), (0.5, 1.0)):
        estimate = replace(
            found.estimate, theta=theta, details={**found.estimate.details, "inflation": inflation}
        )
        scale = gain_scale(simulator, estimator, estimate)
        free = np.eye(c + 2 * n)[:, [k for k in range(c) if k != 3]]
        each = np.zeros((c + 2 * n, n))
        for j in range(n):
            each[c + j, j], each[c + n + j, j] = kp[j], kd[j]
        for own, change, error in (
            (each, scale.change, scale.error),
            (each.sum(axis=1, keepdims=True), [scale.common], [scale.common_error]),
        ):
            T = np.hstack([free, own])
            C = np.linalg.inv(T.T @ H @ T)
            k = own.shape[1]
            np.testing.assert_allclose(change, (C @ T.T @ g)[-k:], rtol=1e-6)
            np.testing.assert_allclose(error, factor * np.sqrt(np.diag(C)[-k:]), rtol=1e-6)
    names, weights, at, frees = asked[0]
    joints = simulator.robot.model.joints
    assert names == tuple(f"{j}.{what} as stated" for what in ("kp", "kd") for j in joints)
    np.testing.assert_array_equal(at, [*theta, *kp, *kd])
    assert weights == ("weights of", at.tolist())
    assert frees
