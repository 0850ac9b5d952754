"""Where a fit begins: typical sizes, first loops and unknowns, by their equations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from helpers.paths import URDF

from robotid.data.log import Log
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.loops import cut_windows
from robotid.identification.closed_loop.encoder_zeros import _Motion, same_encoders
from robotid.identification.closed_loop.initial_values import (
    SecondOrder,
    first_loops,
    free_zeros,
    is_stated,
    typical_sizes,
    typical_sizes_of_torques,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.model import RobotModel

T = 3.0 + np.arange(400) / 200.0


@pytest.fixture(scope="module")
def planar():
    return RobotModel.from_urdf(URDF / "planar_2r.urdf")


def plain_model(
    model, armature, kp, kd=(1.0, 1.0), values=(0.4, 0.3, 0.1, 0.8, 0.6, -0.2), error=0.0
):
    """Return plain loops of two joints: viscous, Coulomb friction and offset of each."""
    loops = replace(
        stated_loops(model, LoopSettings()), armature=np.array(armature), kp=np.array(kp),
        kd=np.array(kd), values=np.array(values), delay=np.array([0.01, 0.02]),
    )  # fmt: skip
    return SecondOrder(None, np.zeros(0), loops, np.array([3.0, 5.0]), error)


@pytest.fixture(scope="module")
def logged(planar):
    """Two windows of a motion whose speeds are known, the errors largest in the second."""
    q = np.column_stack([0.5 * np.sin(6 * T), 0.7 * np.cos(4 * T)])
    q_ref = q + np.column_stack([0.02 * np.sin(T), -0.05 * (T - 3.0)])
    return cut_windows(Log(T, q, 7.0 * q, planar.joints, q_ref=q_ref), 1.0, 0.0)


def inertia_of(model, windows):
    """Return the median of the diagonal of Pinocchio's mass matrices, of every eighth pose."""
    q, data = np.concatenate([w.log.q[w.counted] for w in windows]), model.pin_model.createData()
    return np.median([np.diag(pin.crba(model.pin_model, data, x)) for x in q[::8]], axis=0)


def test_usual_sizes_are_measured_by_known_gains_or_by_the_bodies(planar, logged):
    bodies = inertia_of(planar, logged)
    plain = plain_model(planar, [3 * bodies[0], 0.4], [60.0, 1.0])
    found = typical_sizes(
        SimpleNamespace(model=planar), plain, logged, np.array([True, False]), np.array([2.0, 0.0]),
        planar.joints,
    )  # fmt: skip
    np.testing.assert_allclose(found.bodies, bodies)
    # of the second no gain is known: twice its bodies' inertia, or 0.3 of the first's, measures
    scale = np.array([1.0, 2 * max(bodies[1], 0.3 * bodies[0]) / 0.4])
    np.testing.assert_allclose(found.scale, scale)
    np.testing.assert_allclose(found.inertia, np.maximum([3 * bodies[0], 0.4 * scale[1]], bodies))
    np.testing.assert_allclose(found.torque, scale * [3.0, 5.0])
    error = np.abs(np.concatenate([w.log.q_ref[w.counted] - w.log.q[w.counted] for w in logged]))
    asked = 0.8 * np.array([60.0, 1.0]) * error.max(axis=0)
    taken = 0.4 * 2.0 + 0.3  # by friction at the largest speed of the first
    assert asked[0] < taken
    np.testing.assert_allclose(found.largest, scale * asked)
    quick = replace(plain, loops=replace(plain.loops, kp=np.array([600.0, 1.0])))
    own = typical_sizes(
        SimpleNamespace(model=planar), quick, logged, np.array([True, False]), np.array([2.0, 0.0]),
        planar.joints,
    )  # fmt: skip
    np.testing.assert_allclose(own.largest, scale * [taken, asked[1]])
    v = np.column_stack([3.0 * np.cos(6 * T), -2.8 * np.sin(4 * T)])
    np.testing.assert_allclose(found.speed, np.sqrt(np.mean(v**2, axis=0)), rtol=2e-3)


def test_usual_sizes_of_torques_are_those_of_rows_and_motors(planar, logged):
    pi = planar.standard_parameters()
    names = planar.layout.names
    armature = np.array([0.3, 0.7])
    for joint, x in zip(planar.joints, armature, strict=True):
        pi[names.index(f"{joint}.armature")] = x
    found = typical_sizes_of_torques(planar, pi, armature, logged)
    bodies = inertia_of(planar, logged)
    np.testing.assert_allclose(found.bodies, bodies)
    np.testing.assert_allclose(found.inertia, bodies + armature)
    q = np.concatenate([w.log.q[w.counted] for w in logged])
    np.testing.assert_allclose(found.torque, 7.0 * np.sqrt(np.mean(q**2, axis=0)))
    np.testing.assert_array_equal(found.largest, np.inf)
    np.testing.assert_array_equal(found.scale, 1.0)


def test_joints_of_a_group_have_the_scale_of_those_that_show_their_inertia(planar, logged):
    """Friction over the gain stays that of the second-order model, for both joints."""
    bodies = inertia_of(planar, logged)
    measure = 2 * np.maximum(bodies, 0.3 * bodies.max())
    none = np.zeros(2, dtype=bool)

    def sizes(plain, groups, has_gain=none):
        robot = SimpleNamespace(model=planar)
        return typical_sizes(robot, plain, logged, has_gain, np.zeros(2), groups)

    hidden, shown = 1e-5, 0.02  # of 1 / 96**2 = 1.09e-4 and 1 / 6**2 = 0.028
    plain = plain_model(planar, [hidden, shown], [1.0, 1.0], error=np.array([2e-5, 5e-3]))
    for groups, scale in (
        (["both", "both"], [measure[1] / shown] * 2),
        (planar.joints, [measure[0] * 96**2, measure[1] / shown]),
    ):
        found = sizes(plain, groups)
        np.testing.assert_allclose(found.scale, scale)
        np.testing.assert_allclose(found.torque, np.array(scale) * [3.0, 5.0])
        wanted = np.maximum(np.array([1 / 96**2, shown]) * scale, bodies)
        np.testing.assert_allclose(found.inertia, wanted)
        first = first_loops(planar, stated_loops(planar, LoopSettings()), plain, found, none)
        friction = first.values.reshape(2, -1)[:, :2] / first.kp[:, None]
        np.testing.assert_allclose(friction, [[0.4, 0.3], [0.8, 0.6]])
    # neither shows its inertia: the median of both
    plain = plain_model(planar, [1e-9, 1e-9], [1.0, 1.0], error=np.array([2e-4, 1.0]))
    possible = [2e-4, 1 / 6**2]  # the standard error, at most the slowest loop that is tried
    scale = sizes(plain, ["a", "a"]).scale
    np.testing.assert_allclose(scale, np.mean(measure / possible))
    scale = sizes(plain, ["a", "a"], np.array([True, False])).scale
    np.testing.assert_allclose(scale, [1.0, measure[1] / possible[1]])


def test_a_number_states_all_joints_and_a_table_those_it_names(planar):
    a, b = planar.joints
    for value, wanted in ((3.0, [1, 1]), (None, [0, 0]), ({b: 1.0}, [0, 1]), ({a: 0.0}, [1, 0])):
        assert is_stated(value, planar).tolist() == [bool(x) for x in wanted]


def test_zeros_other_than_the_urdfs_are_free_about_their_first_estimates(planar):
    """With a standard deviation of 0.3 rad; a sign alone has a gain, too."""
    first = replace(same_encoders(planar), zero=np.array([0.4, -0.2]), gain=np.array([0.0, 0.7]))
    (found,) = free_zeros(planar, first)
    assert (found.name, found.what, found.joints) == (f"{planar.joints[1]}.zero", "zero", (1,))
    assert (found.prior, found.spread, found.lowest) == (-0.2, 0.3, -np.inf)
    both = free_zeros(planar, replace(first, gain=np.array([0.1, 0.7])))
    assert [(x.joints, x.prior) for x in both] == [((0,), 0.4), ((1,), -0.2)]


def test_a_load_that_would_push_a_loop_the_wrong_way_does_not_count(rng):
    model = RobotModel.from_urdf(URDF / "planar_2r.urdf", gravity=(0.0, -9.81, 0.0))
    q, v, a = rng.uniform(-1.0, 1.0, (3, 60, 2))
    sign, zero = np.array([-1.0, 1.0]), np.array([0.3, -0.4])
    torque = predict_instants(
        model, model.standard_parameters(), sign * q + zero, sign * v, sign * a
    )
    sense, noise = np.tanh(v), 1e-3 * rng.standard_normal((60, 2))
    gives = sign * torque * [0.02, 0.05] + 0.1 * v - 0.2 * a + 0.3 * sense + 0.7 + noise
    for way, counts in (([1.0, 1.0], [1, 1]), ([1.0, -1.0], [1, 0]), ([-1.0, 1.0], [0, 1])):
        error = gives - (1.0 - np.array(way)) * sign * torque * [0.02, 0.05]
        motion = _Motion(q, v, a, error, sense)
        left, without = motion.left(model, sign, zero), motion.without
        for j in range(2):
            X = np.column_stack([np.ones(60), v[:, j], sense[:, j], a[:, j]])
            bare = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            X = np.column_stack([X, torque[:, j]])
            best = np.linalg.lstsq(X, error[:, j], rcond=None)[1][0]
            assert without[j] == pytest.approx(bare)
            assert left[j] == pytest.approx(best if counts[j] else bare)
            assert best < 0.5 * bare
        cost = motion.cost(model, sign, zero)
        assert cost == pytest.approx(60 * np.log(left).sum())
