"""The compiled tree beside Pinocchio: inverse dynamics, mass matrix and derivatives."""

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import JOINT

from robotid.dynamics.kernels import lanes, tree_lanes
from robotid.dynamics.kernels.lanes import LANES
from robotid.dynamics.rows import flatten
from robotid.robot.model import RobotModel

LINK = (
    '<link name="l{i}"><inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass}"/>'
    '<inertia ixx="1.3" iyy="1.1" izz="0.9" ixy="0.2" ixz="-0.1" iyz="0.15"/></inertial></link>'
)
# a tree that branches twice, of revolute and prismatic joints, all axes tilted
PARENTS = (0, 1, 2, 2, 1, 5, 0)
KINDS = ("revolute", "prismatic", "revolute", "continuous", "prismatic", "revolute", "prismatic")
ZERO = 0.3  # where the encoders have theirs


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    rng = np.random.default_rng(0)

    def text():
        keys = ("axis", "xyz", "rpy")
        return {k: " ".join(map(str, rng.uniform(-1, 1, 3))) for k in keys}

    parts = ['<link name="l0"/>']
    for i, (parent, kind) in enumerate(zip(PARENTS, KINDS, strict=True), start=1):
        parts.append(LINK.format(i=i, mass=rng.uniform(1, 3), **text()))
        parts.append(JOINT.format(i=i, kind=kind, parent=parent, **text()))
    path = tmp_path_factory.mktemp("tree") / "tree.urdf"
    path.write_text(f'<robot name="tree">{"".join(parts)}</robot>')
    return RobotModel.from_urdf(path, terms=[], gravity=(3.0, -5.0, 8.0))


@pytest.fixture(scope="module")
def found(model):
    """States of all lanes, and what the kernels write of them, each (LANES, ...)."""
    tree, n = flatten(model), len(PARENTS)
    bodies = model.standard_parameters().reshape(n, 10)
    q, v, a = np.random.default_rng(1).uniform(-2, 2, (3, LANES, n))
    first = (n + 1) * tree_lanes.BODY
    at_q, at_v, at_a, tau, column = (first + k * n for k in range(5))
    M = first + 5 * n
    by_q, by_v = M + n * n, M + 2 * n * n
    work = lanes.work_space(by_v + n * n)
    entries = work.reshape(-1, LANES)
    entries[tree_lanes.ACCELERATION : tree_lanes.ACCELERATION + 3] = -tree.gravity[:, None]
    entries[at_q:tau] = np.vstack([q.T - ZERO, v.T, a.T])
    for i in range(n):
        own = (i + 1) * tree_lanes.BODY
        tree_lanes.place(work, own, tree.joints[i], at_q + i, ZERO)
    tree_lanes.inverse_dynamics(work, tree, bodies, at_v, at_a, tau)
    tree_lanes.mass_matrix(work, tree, bodies, M)
    tree_lanes.derivatives(work, tree, bodies, at_v, by_q)
    columns = []
    for body in range(n):
        change = np.cos(np.arange(10.0))
        entries[column : column + n] = 0.0
        tree_lanes.inertial_column(work, tree, change, body, column)
        columns.append(entries[column : column + n].T.copy())
    square = [entries[k : k + n * n].T.reshape(LANES, n, n) for k in (M, by_q, by_v)]
    return (q, v, a), entries[tau : tau + n].T, square, np.array(columns)


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def states(model, found):
    data, (q, v, a) = model.pin_model.createData(), found[0]
    yield from enumerate(
        (data, x, v_k, a_k) for x, v_k, a_k in zip(model.configurations(q), v, a, strict=True)
    )


def test_inverse_dynamics_are_pinocchio_s(model, found):
    for k, (data, *state) in states(model, found):
        assert_close(found[1][k], pin.rnea(model.pin_model, data, *state))


def test_the_mass_matrix_is_pinocchio_s(model, found):
    for k, (data, x, *_) in states(model, found):
        assert_close(found[2][0][k], pin.crba(model.pin_model, data, x))


def test_derivatives_by_positions_and_speeds_are_pinocchio_s(model, found):
    for k, (data, *state) in states(model, found):
        by_q, by_v, _ = pin.computeRNEADerivatives(model.pin_model, data, *state)
        assert_close(found[2][1][k], by_q)
        assert_close(found[2][2][k], by_v)


def test_a_change_of_a_body_makes_the_torques_of_its_columns(model, found):
    for k, (data, *state) in states(model, found):
        Y = pin.computeJointTorqueRegressor(model.pin_model, data, *state)
        expected = Y.reshape(len(PARENTS), -1, 10) @ np.cos(np.arange(10.0))
        assert_close(found[3][:, k].T, expected)
