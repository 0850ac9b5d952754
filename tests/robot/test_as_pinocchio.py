"""Pinocchio's own model of a robot gives the torque that is predicted, drives included."""

import warnings

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import ROBOTS, motion, possible_parameters

from robotid.dynamics.prediction import predict_instants
from robotid.robot.drives import Cubic, LoadFriction
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel, pinocchio_model
from robotid.robot.parameters import Coupling

OWN = Coupling("bearing", (("elbow_joint", -2.0),))
GEARED = Coupling("elbow_joint", (("elbow_joint", -0.5),), replaces=True)
ONE_JOINT = {
    "bearings beside a drive": ("ur5_robot.urdf", {"couplings": (OWN,)}),
    "a drive that turns the other way": ("ur5_robot.urdf", {"couplings": (GEARED,)}),
    "no friction": ("ur5_robot.urdf", {"terms": ("armature",)}),
}


def torque_of(made, model, q, v, a):
    """Return rnea plus damping and dry friction, as pinocchio_model documents it."""
    data, G = made.createData(), model.velocity_map
    torque = np.empty_like(v)
    for out, q_k, v_k, a_k in zip(torque, model.configurations(q), v @ G.T, a @ G.T, strict=True):
        dry = np.where(v_k > 0, made.lowerDryFrictionLimit, made.upperDryFrictionLimit)
        out[:] = G.T @ (pin.rnea(made, data, q_k, v_k, a_k) + made.damping * v_k - dry)
    return torque


@pytest.mark.parametrize("case", [*ROBOTS, *ONE_JOINT])
def test_its_rnea_plus_friction_is_the_prediction(case, rng):
    path, options = {**ROBOTS, **ONE_JOINT}[case]
    model = RobotModel.from_urdf(example_urdf(path), **options)
    pi, m = possible_parameters(model, rng), motion(model, rng, 20)
    shared = [f"motor.{term}" for term in ("armature", "viscous", "coulomb")]
    if case != "coupled drives":
        shared = []
        made = pinocchio_model(model, pi)
    else:
        words = "has no field for motor.armature, motor.viscous, motor.coulomb: its torques"
        with pytest.warns(UserWarning, match=words):
            made = pinocchio_model(model, pi)
    expressed = np.where(np.isin(model.layout.names, shared), 0.0, pi)
    predicted = predict_instants(model, expressed, m.q, m.v, m.a)
    scale = np.abs(predicted).max()
    np.testing.assert_allclose(
        torque_of(made, model, m.q, m.v, m.a), predicted, rtol=0, atol=1e-12 * scale
    )
    bare = model.with_parameters(pi).pin_model  # whose RNEA alone was all there was
    still = np.zeros(model.pin_model.nv)
    off = pin.rnea(made, made.createData(), pin.neutral(made), still, still + 1.0)
    off -= pin.rnea(bare, bare.createData(), pin.neutral(bare), still, still + 1.0)
    np.testing.assert_allclose(off, made.armature, atol=1e-9)
    assert made.armature.any()


def test_what_it_has_no_place_for_is_named_if_it_is_not_zero(ur5):
    own = {"elbow_joint": (Cubic(),), "wrist_1_joint": (LoadFriction(),)}
    model = ur5.with_terms(own)
    pi = model.standard_parameters()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pinocchio_model(model, pi)
    pi[list(model.layout.names).index("wrist_1_joint.load")] = 0.05
    with pytest.warns(UserWarning, match=r"no field for wrist_1_joint\.load: its torques"):
        pinocchio_model(model, pi)
