import numpy as np
import pytest

from robotid.simulation.plant import rk4


def swing(q, v, _):
    return -4.0 * q - 0.2 * v


def test_a_step_is_exact_for_a_force_that_is_quadratic_in_time():
    q0, v0, h = np.array([0.3, -1.0]), np.array([2.0, 0.5]), np.array([0.4, 0.8])
    q, v = rk4(lambda q, v, share: 6.0 * (share * h) ** 2, q0, v0, h)
    np.testing.assert_allclose(v, v0 + 2.0 * h**3, rtol=1e-14)
    np.testing.assert_allclose(q, q0 + v0 * h + 0.5 * h**4, rtol=1e-14)


def test_its_error_falls_with_the_fourth_power_of_the_step():
    def end(steps):
        q, v = np.array([1.0]), np.array([0.0])
        for _ in range(steps):
            q, v = rk4(swing, q, v, 2.0 / steps)
        return float(q[0])

    w = np.sqrt(4.0 - 0.01)
    exact = np.exp(-0.2) * (np.cos(2 * w) + 0.1 / w * np.sin(2 * w))
    assert (end(20) - exact) / (end(40) - exact) == pytest.approx(16.0, rel=0.1)


def test_a_known_acceleration_at_the_start_is_taken():
    q, v = np.array([0.3]), np.array([0.7])
    assert rk4(swing, q, v, 0.1, swing(q, v, 0.0)) == rk4(swing, q, v, 0.1)
    assert rk4(swing, q, v, 0.1, swing(q, v, 0.0) + 1.0) != rk4(swing, q, v, 0.1)
