"""Inertial rows that are kept with a trajectory give what is computed without them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.robots import ROBOTS, motion, possible_parameters

from robotid.dynamics import rows
from robotid.dynamics.rows import (
    drive_motion,
    friction_speeds,
    keep_inertial_rows,
    kept_rows,
    sure_rows,
)
from robotid.dynamics.torque import build_problem, predict, remember, trajectory_regressor
from robotid.robot.drives import LoadFriction
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, ParameterLayout

SAMPLES = 300  # more than two blocks


def blocks(model, trajectory, weight, part, segment=90):
    """Return the rows of some samples, row of the robot by row, of every block."""
    (source,) = build_problem(model, trajectory, weight, compiled=False).sources
    found = [list(map(np.copy, block)) for block in source.blocks(*part, segment)]
    ends = np.cumsum([len(block[0]) for block in found]).tolist()
    assert {*range(segment, part[1] - part[0], segment)} < {*ends}  # no block has two segments
    return [np.concatenate(own) for own in zip(*found, strict=True)]


@pytest.mark.parametrize("name", ["mimic joint coupled", "torso that slides", "humanoid"])
def test_rows_and_predictions_are_those_without_what_is_kept(name, rng, monkeypatch):
    monkeypatch.setattr(rows, "_LOADED", 1)  # block that a writer takes at once
    monkeypatch.setattr(rows, "BLOCK", 128)
    urdf, options = ROBOTS[name]
    model = RobotModel.from_urdf(example_urdf(urdf), **options)
    fresh, kept = (motion(model, np.random.default_rng(1), SAMPLES) for _ in range(2))
    keep_inertial_rows(model, kept)
    assert kept_rows(model, fresh) is None
    assert kept_rows(model, kept) is not None
    weight = rng.uniform(0.5, 2.0, (SAMPLES, model.n_rows))
    pairs = [blocks(model, m, weight, (100, 280)) for m in (fresh, kept)]
    for wanted, found in zip(*pairs, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())
    vectors = [possible_parameters(model, rng) for _ in range(2)]
    vectors[1][model.layout.n_inertial :] = 0.0
    for wanted, found in zip(*(predict(model, vectors, m) for m in (fresh, kept)), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())
    whole, every = (trajectory_regressor(model, m) for m in (fresh, kept))
    np.testing.assert_allclose(every, whole, atol=1e-12 * np.abs(whole).max())
    some = np.array([280, 3, 128])  # of samples that are taken out
    wanted = whole.reshape(SAMPLES, model.n_rows, -1)[some].reshape(-1, whole.shape[1])
    for m in (fresh, kept):
        found = trajectory_regressor(model, m, some)
        np.testing.assert_allclose(found, wanted, atol=1e-12 * np.abs(whole).max())


def test_what_is_kept_is_of_one_robot_and_goes_with_its_motion_alone(ur5, rng, monkeypatch):
    trajectory = motion(ur5, rng, 40)
    keep_inertial_rows(ur5, trajectory)
    own = kept_rows(ur5, trajectory)
    loaded = ur5.with_terms({ur5.joints[1]: (LoadFriction(),)})
    loaded = loaded.with_reference(np.ones(len(loaded.layout.names)))
    assert kept_rows(loaded, remember(loaded, trajectory)) is own  # its bodies are the same
    other = RobotModel.from_urdf(ur5.tree.path, gravity=(0.0, 0.0, 3.0))
    assert kept_rows(other, trajectory) is None
    assert kept_rows(ur5, replace(trajectory, q=trajectory.q + 0.1)) is None
    assert kept_rows(ur5, trajectory.at(slice(0, 20))) is None
    keep_inertial_rows(other, trajectory)  # those of the last robot stay
    assert kept_rows(ur5, trajectory) is None
    monkeypatch.setattr(rows, "_MOST_BYTES", 8 * 40 * 209)  # bytes; a UR5 has 210 columns
    large = motion(ur5, rng, 40)
    keep_inertial_rows(ur5, large)
    assert kept_rows(ur5, large) is None


RATIOS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [2.0, 0, -0.5]])  # drives over joints


def layout(terms=("viscous", "coulomb"), **options):
    return ParameterLayout(
        joints=("a", "b", "c"),
        bodies=("one", "two", "three"),
        terms=terms,
        couplings=(Coupling("motor", (("a", 2.0), ("c", -0.5))),),
        **options,
    )


@pytest.mark.parametrize("first", [0, 6])  # rows of a floating base
def test_drives_move_with_their_joints_and_bear_their_part_of_the_load(rng, first):
    v, a = rng.standard_normal((2, 8, first + 3))
    q = rng.standard_normal((8, first + 3 + (first > 0)))
    load, rate = rng.standard_normal((2, 8, 3))
    direction, begins = rng.uniform(-1, 1, (8, 4)), np.arange(8) == 0
    found = drive_motion(layout(), q, v, a, direction, load, rate, begins)
    for own, x in ((found.q, q), (found.v, v), (found.a, a)):
        np.testing.assert_allclose(own, RATIOS @ x[:, -3:].T, atol=1e-14)
    # the torque of a drive that alone bears a load nearest to this one: R^T x = load
    for d, row in enumerate(RATIOS):
        for own, x in ((found.load, load), (found.rate, rate)):
            nearest = np.linalg.lstsq(row[:, None], x.T, rcond=None)[0][0]
            np.testing.assert_allclose(own[d], nearest, atol=1e-14)
    np.testing.assert_array_equal(found.direction, direction.T)
    np.testing.assert_array_equal(found.begins, begins)
    bare = drive_motion(layout(), q, v, a, np.empty((8, 0)))
    np.testing.assert_array_equal(bare.direction, bare.v)
    assert not bare.load.any()
    assert not bare.rate.any()
    assert bare.begins is None


def test_a_row_is_sure_where_every_drive_that_loads_it_is_fast():
    v = np.array([
        [1.0, 1.0, 1.0], [0.04, 1.0, 1.0], [1.0, -0.04, 1.0], [0.11, 0.2, 0.4], [-0.2, 0.06, -0.72],
    ])  # fmt: skip  # of the last two, 2 a - c / 2 is 0.02 and -0.04
    wanted = [
        [True] * 3, [False, True, True], [True, False, True], [False, True, False],
        [False, True, False],
    ]  # fmt: skip
    np.testing.assert_array_equal(sure_rows(layout(), v, 0.05), wanted)
    floating = np.hstack([np.zeros((5, 6)), v])
    found = sure_rows(layout(), floating, 0.05)
    assert found[:, :6].all(), "no drive loads the base"
    np.testing.assert_array_equal(found[:, 6:], wanted)
    assert sure_rows(layout(terms=("viscous",)), v, 0.05).all()


def test_speeds_of_sliders_count_by_their_stroke():
    sliding = layout(prismatic=frozenset({"c"}), strokes={"c": 0.8})
    c = 0.8 / (2 * np.pi)  # [m/s] that counts as 1 rad/s
    motor = (2.0 + 0.5 * c) / 2.5
    np.testing.assert_allclose(sliding.drive_speeds, [1.0, 1.0, c, motor])
    wanted = RATIOS / np.array([[1.0], [1.0], [c], [motor]])
    np.testing.assert_allclose(friction_speeds(sliding), wanted)
    unknown = layout(prismatic=frozenset({"c"}))
    np.testing.assert_allclose(unknown.drive_speeds[2], 1.0 / (2 * np.pi))
