import numpy as np
import pytest

from robotid.exceptions import DataError, RankDeficientError, SettingsError
from robotid.paper.formulas import (
    Bounds,
    deviation,
    one_shot,
    proximity,
    recursive_update,
    reference_acceleration,
)


def test_proximity_is_the_gradient_of_the_criterion(rng):
    Psi, P, u, h = rng.normal(size=(2, 5)), rng.normal(size=5), rng.normal(size=2), 1e-6

    def J(P):  # (3)
        return 0.5 * np.sum((u - Psi @ P) ** 2)

    slopes = [(J(P + h * e) - J(P - h * e)) / (2 * h) for e in np.eye(5)]
    # J is quadratic: central differences are exact but for rounding, 1e-16 / h
    np.testing.assert_allclose(proximity(Psi, P, u), slopes, atol=1e-8)


def test_only_the_corrected_proximity_vanishes_at_the_truth(rng):
    Psi, P = rng.normal(size=(3, 2, 5)), rng.normal(size=(3, 5))
    u = np.einsum("rnc,rc->rn", Psi, P)
    np.testing.assert_allclose(proximity(Psi, P, u), 0.0, atol=1e-14)
    printed = proximity(Psi, P, u, sign="printed")
    np.testing.assert_allclose(printed, 2 * np.einsum("rnc,rn->rc", Psi, u), rtol=1e-13)
    assert np.abs(printed).max() > 1.0


def test_deviation_and_reference_are_equations_15_and_20(rng):
    q, v, a, q_pr, v_pr, a_pr = rng.normal(size=(6, 4))
    q_star = reference_acceleration(q, v, (q_pr, v_pr, a_pr), np.array(20.0), np.array(100.0))
    np.testing.assert_allclose(q_star, a_pr - 20 * (v - v_pr) - 100 * (q - q_pr))
    eta = a - a_pr + 20 * (v - v_pr) + 100 * (q - q_pr)
    np.testing.assert_allclose(deviation(a, q_star), eta, atol=1e-12)


def test_an_update_is_equation_24(rng):
    P, Psi, eta = rng.normal(size=5), rng.normal(size=(2, 5)), rng.normal(size=2)
    wanted = P - 1.7 / np.trace(Psi @ Psi.T) * Psi.T @ eta
    found = recursive_update(P, Psi, eta, np.array(1.7), np.array(True))
    np.testing.assert_allclose(found, wanted, rtol=1e-13)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"is_open": np.array(False)}, "PRX is zero"),
        ({"eps2": 1e9}, "the sample is small"),
        ({"sigma": np.array(-0.1)}, "D is not positive definite"),
    ],
)
def test_an_update_is_left_out_where(change, why, rng):
    P, Psi, eta = rng.normal(size=5), rng.normal(size=(2, 5)), rng.normal(size=2)
    arguments = {"sigma": np.array(1.0), "is_open": np.array(True), **change}
    found = recursive_update(P, Psi, eta, **arguments)
    np.testing.assert_array_equal(found, P, err_msg=why)


def test_one_shot_finds_the_truth_from_any_guess(rng):
    G, P, P_hat = rng.normal(size=(40, 5)), rng.normal(size=5), rng.normal(size=5)
    # G_* with G P = G_* P^: any matrix, moved along P^ so that the torques agree
    G_star = rng.normal(size=(40, 5))
    G_star += np.outer(G @ P - G_star @ P_hat, P_hat) / (P_hat @ P_hat)
    np.testing.assert_allclose(one_shot(G, G_star, P_hat, "abcde"), P, rtol=1e-12)


def test_one_shot_names_what_the_motion_leaves_open(rng):
    G = rng.normal(size=(40, 4))
    G[:, 3] = 2 * G[:, 1]
    with pytest.raises(RankDeficientError, match=r"excite 3 of 4 .* undetermined: \['b', 'd'\]"):
        one_shot(G, G, np.ones(4), "abcd")


def test_bounds_project_onto_their_box():
    bounds = Bounds(np.array([0.0, -1.0]), np.array([2.0, np.inf]))
    found = bounds.project(np.array([[3.0, -5.0], [1.0, 7.0]]))
    np.testing.assert_array_equal(found, [[2.0, -1.0], [1.0, 7.0]])


def test_bounds_that_hold_nothing_are_refused():
    with pytest.raises(DataError, match=r"^bounds of parameter 1 are 2.0 to 1.0: an empty set$"):
        Bounds(np.array([0.0, 2.0]), np.array([1.0, 1.0]))
    with pytest.raises(
        DataError, match=r"^bounds have shapes \(2,\) and \(3,\), wanted one \(c,\)"
    ):
        Bounds(np.zeros(2), np.ones(3))


def test_an_unknown_sign_is_named():
    with pytest.raises(SettingsError, match=r"^sign is 'plus', wanted 'corrected' or 'printed'$"):
        proximity(np.ones((2, 3)), np.ones(3), np.ones(2), sign="plus")
