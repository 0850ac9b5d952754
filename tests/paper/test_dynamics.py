import numpy as np
import pinocchio as pin
import pytest
from helpers.base_dynamics import BaseDynamics
from helpers.synthetic import truth

from robotid.exceptions import DataError
from robotid.paper import planar_2r
from robotid.paper.dynamics import (
    LinearPlant,
    PlanarDynamics,
    mass_matrix,
    smallest_eigenvalue,
    torque,
)
from robotid.regressor.base_parameters import structural_mapping
from robotid.robot.model import RobotModel
from robotid.simulation.plant import RobotPlant


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


def test_armature_counts_and_friction_does_not(arm, ur5, rng):
    pi = truth(ur5)  # all drive terms are there
    q, _, _ = states(rng, 5, 6)
    plant = RobotPlant(ur5, pi)
    for D, q_k in zip(mass_matrix(arm, q, arm.mapping.to_base(pi)), q, strict=True):
        np.testing.assert_allclose(D, plant.mass_matrix(q_k), atol=1e-11)


def test_a_linear_plant_moves_as_the_robot_does(arm, ur5, rng):
    pi = truth(ur5)
    q, v, u = states(rng, 10, 6)
    v += 0.5 * np.sign(v)  # away from 0, where the plant's friction is smooth
    ours = LinearPlant(arm, arm.mapping.to_base(pi)).acceleration(q, v, 20 * u)
    # wrist inertias of 0.1 kg m^2 multiply rounding of 50 N m
    np.testing.assert_allclose(ours, RobotPlant(ur5, pi).acceleration(q, v, 20 * u), rtol=1e-9)


@pytest.mark.parametrize("form", list(planar_2r.PARAMETER_NAMES))
def test_planar_dynamics_are_those_of_the_closed_form(form, rng):
    dynamics = PlanarDynamics(form)
    P = rng.normal(size=len(dynamics.names))
    q, v, a = states(rng, 20, 2)
    D, u = mass_matrix(dynamics, q, P), torque(dynamics, q, v, a, P)
    for k in range(20):
        column = [planar_2r.regressor(q[k], 0 * e, e, form=form) @ P for e in np.eye(2)]
        np.testing.assert_allclose(D[k].T, column, atol=1e-13)
        one = planar_2r.regressor(q[k], v[k], a[k], form=form) @ P
        np.testing.assert_allclose(u[k], one, atol=1e-12)


def test_each_run_may_have_its_own_parameters(rng):
    dynamics, P = PlanarDynamics(), rng.normal(size=(3, 4))
    q, v, a = states(rng, 3, 2)
    together = torque(dynamics, q, v, a, P), mass_matrix(dynamics, q, P)
    for r in range(3):
        one = slice(r, r + 1)
        alone = torque(dynamics, q[one], v[one], a[one], P[r]), mass_matrix(dynamics, q[one], P[r])
        np.testing.assert_allclose(together[0][one], alone[0], atol=1e-13)
        np.testing.assert_allclose(together[1][one], alone[1], atol=1e-13)


def test_acceleration_solves_the_dynamics(rng):
    dynamics, P = PlanarDynamics("printed"), planar_2r.PAPER_PARAMETERS
    q, v, u = states(rng, 20, 2)
    a = LinearPlant(dynamics, P).acceleration(q, v, u)
    np.testing.assert_allclose(torque(dynamics, q, v, a, P), u, atol=1e-12)


def test_smallest_eigenvalue_is_that_of_each_matrix():
    D = np.array([np.diag([3.0, 2.0]), [[2.0, 1.0], [1.0, 2.0]]])
    np.testing.assert_allclose(smallest_eigenvalue(D), [2.0, 1.0], rtol=1e-14)


def test_a_floating_base_is_refused(ur5):
    floating = RobotModel.from_urdf(ur5.tree.path, free_flyer=True, terms=())
    with pytest.raises(DataError, match=r"^a robot with a floating base cannot be simulated"):
        RobotPlant(floating, floating.standard_parameters())


def test_plant_parameters_of_another_length_are_named(ur5):
    with pytest.raises(DataError, match=r"^pi has shape \(60,\), wanted \(84,\)$"):
        RobotPlant(ur5, ur5.standard_parameters()[:60])
