import numpy as np
import pinocchio as pin
import pytest
from helpers.base_dynamics import BaseDynamics
from helpers.synthetic import truth

from robotid.base.exceptions import RankDeficientError
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.simulation.simulator import RobotPlant
from robotid.paper import planar_2r
from robotid.paper.equations import (
    LinearPlant,
    PlanarDynamics,
    mass_matrix,
    one_shot,
    proximity,
    recursive_update,
    reference_acceleration,
    rk4,
    torque,
)


@pytest.fixture(scope="module")
def arm(ur5):
    return BaseDynamics(ur5, structural_mapping(ur5))


def states(rng, count, n):
    return rng.uniform(-np.pi, np.pi, (count, n)), *rng.uniform(-3, 3, (2, count, n))


def test_mass_matrix_from_base_parameters_is_pinocchios_crba(arm, ur5, rng):
    pi = ur5.standard_parameters()
    q, _, _ = states(rng, 10, 6)
    data = ur5.pin_model.createData()
    for D, q_k in zip(mass_matrix(arm, q, arm.mapping.to_base(pi)), q, strict=True):
        M = pin.crba(ur5.pin_model, data, q_k)
        np.testing.assert_allclose(D, np.triu(M) + np.triu(M, 1).T, atol=1e-12)


def test_a_linear_plant_moves_as_the_robot_does(arm, ur5, rng):
    pi = truth(ur5)
    q, v, u = states(rng, 10, 6)
    v += 0.5 * np.sign(v)  # away from 0, where the plant's friction is smooth
    ours = LinearPlant(arm, arm.mapping.to_base(pi)).acceleration(q, v, 20 * u)
    # wrist inertias of 0.1 kg m^2 multiply rounding of 50 N m
    plant = RobotPlant(ur5, pi)
    theirs = [plant.acceleration(*state) for state in zip(q, v, 20 * u, strict=True)]
    np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def test_acceleration_solves_the_dynamics(rng):
    dynamics, P = PlanarDynamics("printed"), planar_2r.PAPER_PARAMETERS
    q, v, u = states(rng, 20, 2)
    a = LinearPlant(dynamics, P).acceleration(q, v, u)
    np.testing.assert_allclose(torque(dynamics, q, v, a, P), u, atol=1e-12)


# --- control, proximity, update ---------------------------------------------------------------


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
    np.testing.assert_allclose(a - q_star, eta, atol=1e-12)


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
    with pytest.raises(RankDeficientError, match=r"excite 3 of 4 .* undetermined: b, d\."):
        one_shot(G, G, np.ones(4), "abcd")


def swing(q, v, _):
    return -4.0 * q - 0.2 * v


def test_its_error_falls_with_the_fourth_power_of_the_step():
    def end(steps):
        q, v = np.array([1.0]), np.array([0.0])
        for _ in range(steps):
            q, v = rk4(swing, q, v, 2.0 / steps)
        return float(q[0])

    w = np.sqrt(4.0 - 0.01)
    exact = np.exp(-0.2) * (np.cos(2 * w) + 0.1 / w * np.sin(2 * w))
    assert (end(20) - exact) / (end(40) - exact) == pytest.approx(16.0, rel=0.1)
