import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import ROBOTS, WRIST, mimicking

from robotid.base.exceptions import DataError
from robotid.design.information import (
    CRITERIA,
    MotionInformation,
    MotionRegressor,
    Placements,
    criterion,
    fixed_tree,
)
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.rows import friction_speeds
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.drives import Lag, LoadFriction, Stribeck
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

OWN = {"own_terms": {"elbow_joint": [Stribeck(speed=0.3), LoadFriction(), Lag()],
                     "wrist_1_joint": [Lag()]}}  # fmt: skip
CASES = {
    "six turning joints": ROBOTS["six turning joints"],
    "coupled drives": ROBOTS["coupled drives"],
    "terms of their own": ("ur5_robot.urdf", OWN),
    "mimic joint coupled": ROBOTS["mimic joint coupled"],
    "a coupled drive that feels its load": (
        "ur5_robot.urdf", {"couplings": (WRIST,), "own_terms": {WRIST.name: [LoadFriction()]}}
    ),
}  # fmt: skip


@pytest.fixture(params=CASES)
def case(request):
    """A robot with random drive parameters, and the rows of its base problem."""
    rng = np.random.default_rng(3)
    file, options = CASES[request.param]
    model = RobotModel.from_urdf(example_urdf(file), **options)
    mapping, pi = structural_mapping(model), model.standard_parameters()
    size = model.layout.n_inertial
    pi[size:] = rng.uniform(0.1, 0.3, len(pi) - size)
    motion = rng.uniform(-2, 2, (3, 6, len(model.joints)))
    motion[1, 0] *= 0.005  # where signs change
    return model.with_reference(pi), mapping, pi, motion


def test_its_rows_and_torques_are_those_of_the_regressor(case):
    model, mapping, pi, (q, v, a) = case
    direction = np.tanh(v @ friction_speeds(model.layout).T / 0.01)
    Y = joint_torque_regressor(model, q, v, a, direction)
    information = MotionInformation(model, mapping, mapping.to_base(pi))
    rows = information.rows(q, v, a)
    expected = Y[:, mapping.independent].reshape(len(q), len(model.joints), -1)
    np.testing.assert_allclose(rows.W.transpose(2, 0, 1), expected, atol=1e-10)
    torque = (Y @ pi).reshape(len(q), -1)
    np.testing.assert_allclose(information.torque(rows), torque, rtol=1e-9, atol=1e-9)


def test_its_gradient_is_that_of_differences(case):
    model, mapping, pi, motion = case
    rng = np.random.default_rng(4)
    information = MotionInformation(model, mapping, mapping.to_base(pi))
    rows = information.rows(*motion)
    weights, d = rng.standard_normal(rows.W.shape), rng.standard_normal(motion.shape)

    def value(x):
        return np.sum(weights * information.rows(*x).W)

    h = 1e-7
    expected = (value(motion + h * d) - value(motion - h * d)) / (2 * h)
    found = sum(np.sum(g * y) for g, y in zip(information.pull(rows, weights), d, strict=True))
    assert found == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("name", CRITERIA)
def test_criteria_have_their_values_and_gradients(name, rng):
    A, D = rng.standard_normal((2, 7, 7))
    F, D = A @ A.T, D + D.T
    eigenvalues = np.linalg.eigvalsh(F)
    expected = {
        "D": -np.linalg.slogdet(F)[1] / 7,
        "A": np.log(np.trace(np.linalg.inv(F)) / 7),
        "E": -np.log(eigenvalues[0]),
        "widest": np.log(np.diag(np.linalg.inv(F))[[5, 2]]).mean(),
    }[name]
    some = np.array([5, 2])  # the parameters that were the widest
    value, gradient = criterion(name, F, some)
    assert value == pytest.approx(expected, rel=1e-9)
    h = 1e-6
    up, down = (criterion(name, F + s * h * D, some)[0] for s in (1, -1))
    slope = (up - down) / (2 * h)
    assert np.sum(gradient * D) == pytest.approx(slope, rel=1e-6)


def test_a_singular_matrix_has_the_determinant_of_rounding_errors():
    eps = 4.0 * np.finfo(float).eps  # of the largest eigenvalue
    value, gradient = criterion("D", np.diag([1.0, 0.0, 4.0]))
    assert value == pytest.approx(-np.log(4.0 * eps) / 3)
    np.testing.assert_allclose(gradient, np.diag([-1.0, -1.0 / eps, -0.25]) / 3)


def test_gravity_at_a_joint_is_shared_by_the_joints_of_its_chain():
    joints = ["torso_lift_joint", "arm_1_joint", "arm_2_joint", "head_1_joint"]
    model = RobotModel.from_urdf(example_urdf("tiago_no_hand.urdf"), joints=joints)
    mapping = structural_mapping(model)
    information = MotionInformation(model, mapping, mapping.to_base(model.standard_parameters()))
    with pytest.raises(DataError, match=rf"beta has shape \(2,\), expected \({len(mapping.K)},\)"):
        MotionInformation(model, mapping, np.zeros(2))
    linked = {"torso": "torso arm_1 arm_2 head", "arm_1": "torso arm_1 arm_2"}
    linked |= {"arm_2": "torso arm_1 arm_2", "head": "torso head"}
    short = [joint.replace("_joint", "").replace("_lift", "").replace("head_1", "head")
             for joint in model.joints]  # fmt: skip
    for name, row in zip(short, information.chains, strict=True):
        own = linked[name].split()
        np.testing.assert_allclose(row, [1 / len(own) if x in own else 0.0 for x in short])


FIXED = {name: spec for name, spec in ROBOTS.items() if not spec[1].get("free_flyer")}


@pytest.fixture(params=[*FIXED, "mimic joints at a ratio"])
def model(request, tmp_path):
    if request.param not in FIXED:
        return mimicking(tmp_path, np.random.default_rng(4), terms=[])
    file, options = FIXED[request.param]
    return RobotModel.from_urdf(example_urdf(file), terms=[], **{**options, "couplings": ()})


def some(model, rng):
    """A regressor of two thirds of the parameters, and a motion of more than a block of lanes."""
    size = model.layout.n_inertial
    kept = np.sort(rng.permutation(size)[: 2 * size // 3])
    return kept, MotionRegressor(model, kept), rng.uniform(-2, 2, (3, 70, len(model.joints)))


def test_its_columns_are_pinocchio_s(model):
    kept, regressor, (q, v, a) = some(model, np.random.default_rng(1))
    expected = joint_torque_regressor(model, q, v, a).reshape(70, model.n_rows, -1)[..., kept]
    found = np.moveaxis(regressor(q, v, a), -1, 0)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_its_gradient_is_that_of_differences_by_each_joint(model):
    rng = np.random.default_rng(2)
    kept, regressor, x = some(model, rng)
    weights = rng.standard_normal((model.n_rows, len(kept), 70))
    found = regressor.pull(*x, weights)
    h = 1e-6
    for kind in range(3):
        for joint in rng.permutation(len(model.joints))[:8]:
            up, down = x.copy(), x.copy()
            up[kind, :, joint] += h
            down[kind, :, joint] -= h
            change = np.sum(weights * (regressor(*up) - regressor(*down)), axis=(0, 1)) / (2 * h)
            bound = 2e-8 * max(1.0, np.abs(change).max())
            np.testing.assert_allclose(found[kind, :, joint], change, rtol=0, atol=bound)


def test_bodies_are_where_pinocchio_has_them(model):
    q = np.random.default_rng(3).uniform(-2, 2, (70, len(model.joints)))
    placed, data = Placements.along(fixed_tree(model), q), model.pin_model.createData()
    for n in (0, 63, 64, 69):
        pin.forwardKinematics(model.pin_model, data, model.configurations(q[n : n + 1])[0])
        for i, M in enumerate(list(data.oMi)[1:]):
            np.testing.assert_allclose(placed.R[:, :, i, n], M.rotation, atol=1e-13)
            np.testing.assert_allclose(placed.p[:, i, n], M.translation, atol=1e-13)
