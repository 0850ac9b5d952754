"""Where a fit begins: typical sizes, first loops and unknowns, by their equations."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.paths import URDF

from robotid.data.log import Log
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.loops import cut_windows
from robotid.identification.closed_loop.initial_values import _Motion, typical_sizes
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
