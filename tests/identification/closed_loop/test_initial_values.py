"""Where a fit begins: typical sizes, first loops and unknowns, by their equations."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import URDF
from helpers.single_joint import slider

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.dynamics.torque import predict_instants
from robotid.identification.closed_loop.initial_values import (
    SecondOrder,
    _Motion,
    fit_second_order,
    typical_sizes,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.stages import stated_loops
from robotid.robot.drives import Coulomb, Offset, Viscous
from robotid.robot.model import RobotModel


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


def test_an_initial_limit_is_the_friction_at_the_largest_speed_within_the_largest_torque(rng):
    model, t = RobotModel.from_urdf(URDF / "planar_2r.urdf"), np.arange(100) / 100.0
    q_ref, q = rng.uniform(-1.0, 1.0, (2, 100, 2))
    log = Log(t, q, 0 * q, model.joints, q_ref=q_ref, has_torque=False)
    friction, one = {"viscous": np.array([2.0, 200.0]), "coulomb": np.array([1.0, 3.0])}, np.ones(2)
    plain = SimpleNamespace(
        loops=SimpleNamespace(kp=np.array([30.0, 20.0]), limit=np.inf), inertia=one, torque=one,
        shows_inertia=one > 0, friction=friction.__getitem__,
    )  # fmt: skip
    windows, has_gain = cut_windows(log, np.inf, 0.0), one > 0
    of_errors = 0.8 * plain.loops.kp * np.abs(q_ref - q)[windows[0].counted].max(axis=0)
    for top, wanted in (
        ([0.0, 0.0], of_errors),
        ([0.5, 0.5], [2.0, of_errors[1]]),  # the second would need more than it ever gave
    ):
        found = typical_sizes(
            SimpleNamespace(model=model), plain, windows, has_gain, np.array(top), ["a", "b"]
        )
        np.testing.assert_allclose(found.largest, wanted)


def test_the_limit_of_a_drive_that_bears_a_load_is_found_beyond_the_load(tmp_path, rng):
    rail, t = slider(tmp_path), np.arange(500) / 250.0
    q_ref = 0.2 * np.sign(np.sin(4.0 * t))[:, None]
    log = Log(t, 0 * q_ref, 0 * q_ref, ("j",), q_ref=q_ref, has_torque=False)
    robot, loops = ClosedLoopRobot(rail, step=4e-3), stated_loops(rail, LoopSettings(kp=50.0))
    terms, values = ((Viscous(), Coulomb(), Offset()),), np.array([3.0, 0.1, 8.0])
    drive = replace(
        loops, bodies=0 * loops.bodies, armature=np.array([0.3]), limit=np.array([10.0]),
        terms=terms, values=values,
    )  # fmt: skip
    [out] = robot.roll_out(drive, cut_windows(log, np.inf, 0.0))
    windows = cut_windows(replace(log, q=out.q), np.inf, 0.0)
    found = fit_second_order(robot, windows, loops, False, True).loops
    assert found.limit == pytest.approx(10.0, rel=1e-3)
    np.testing.assert_allclose(found.values, values, rtol=0.05)


def test_the_model_of_some_joints_is_that_of_another_fit(rng):
    base = stated_loops(RobotModel.from_urdf(URDF / "planar_2r.urdf"), LoopSettings(kp=1.0))
    keys, terms = ("armature", "delay", "limit"), ((Viscous(), Coulomb(), Offset()),) * 2
    models = []
    for _ in range(2):
        drawn = {key: rng.random(2) for key in keys}
        loops = replace(base, terms=terms, values=rng.random(6), **drawn)
        models.append(SecondOrder(loops, rng.random(2), rng.random(2)))
    mixed, (one, other) = models[0].replaced(models[1], np.array([False, True])), models
    for key in (*keys, "values"):
        a, b, found = (getattr(x.loops, key) for x in (one, other, mixed))
        np.testing.assert_array_equal(found, np.append(a[: len(a) // 2], b[len(a) // 2 :]))
    np.testing.assert_array_equal(mixed.torque, one.torque)
    np.testing.assert_array_equal(
        mixed.inertia_error, [one.inertia_error[0], other.inertia_error[1]]
    )
