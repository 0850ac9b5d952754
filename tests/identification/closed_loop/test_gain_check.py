"""Scales of gains that are concluded, and those that are not."""

import numpy as np
import pytest

from robotid.identification.closed_loop.further_parameters import GainScale, _last


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
