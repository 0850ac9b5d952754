import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import ROBOTS, mimicking

from robotid.design.information import MotionRegressor, Placements, fixed_tree
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

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
