"""Inertial rows that are kept with a trajectory give what is computed without them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.robots import ROBOTS, motion, possible_parameters

from robotid.dynamics import rows
from robotid.dynamics.prediction import predict, remember
from robotid.dynamics.rows import keep_inertial_rows, kept_rows
from robotid.dynamics.torque import build_problem, trajectory_regressor
from robotid.robot.drives import LoadFriction
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

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
