import numpy as np
import pytest
from helpers.paths import URDF
from helpers.robots import ROBOTS

from robotid.exceptions import DataError
from robotid.regressor.adjoint import MotionRegressor
from robotid.regressor.torque import joint_torque_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FIXED = {name: spec for name, spec in ROBOTS.items() if not spec[1].get("free_flyer")}


@pytest.fixture(params=FIXED)
def model(request):
    file, options = FIXED[request.param]
    return RobotModel.from_urdf(example_urdf(file), terms=[], **{**options, "couplings": ()})


def states(model, rng, samples=5):
    q, v, a = rng.uniform(-2, 2, (3, samples, len(model.joints)))
    G = model.velocity_map
    return q, v, a, (q @ G.T + model.position_offset, v @ G.T, a @ G.T)


def test_its_rows_are_pinocchio_s(model):
    q, v, a, motion = states(model, np.random.default_rng(1))
    regressor = MotionRegressor(model)
    places, bodies = regressor.pairs
    G = model.velocity_map
    Y = np.zeros((len(q), len(G), model.layout.n_inertial))
    for row, place, body in zip(regressor(*motion).rows, places, bodies, strict=True):
        Y[:, place, 10 * body : 10 * body + 10] = row.T
    expected = joint_torque_regressor(model, q, v, a).reshape(len(q), len(model.joints), -1)
    np.testing.assert_allclose(np.einsum("ja,njp->nap", G, Y), expected, atol=1e-12)


def test_its_gradient_is_that_of_differences(model):
    rng = np.random.default_rng(2)
    *_, motion = states(model, rng)
    regressor, x = MotionRegressor(model), np.array(motion)
    state = regressor(*x)
    weights, d = rng.standard_normal(state.rows.shape), rng.standard_normal(x.shape)

    def value(x):
        return np.sum(weights * regressor(*x).rows)

    h = 1e-6
    expected = (value(x + h * d) - value(x - h * d)) / (2 * h)
    found = sum(np.sum(g * y) for g, y in zip(regressor.pull(state, weights), d, strict=True))
    scale = np.abs(weights).sum() * 1e-9
    assert found == pytest.approx(expected, rel=1e-7, abs=scale)


def test_a_floating_base_is_refused():
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", free_flyer=True)
    with pytest.raises(DataError, match="the base floats"):
        MotionRegressor(model)


def test_the_compiled_way_gives_the_same_rows_and_gradient(model):
    pytest.importorskip("numba")
    rng = np.random.default_rng(3)
    *_, motion = states(model, rng, samples=7)
    plain, fast = MotionRegressor(model), MotionRegressor(model, is_fast=True)
    one, other = plain(*motion), fast(*motion)
    np.testing.assert_allclose(other.rows, one.rows, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(other.p, one.p, atol=1e-12)
    weights = rng.standard_normal(one.rows.shape)
    expected = plain.pull(one, weights)
    size = np.abs(np.array(expected)).max()
    np.testing.assert_allclose(fast.pull(other, weights), expected, rtol=1e-9, atol=1e-12 * size)
