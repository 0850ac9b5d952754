import logging

import numpy as np
import pytest
from helpers.robots import JOINT, LINK, ROBOTS, mimicking, motion

from robotid.base.exceptions import DataError
from robotid.dynamics import factors, rows
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import compress
from robotid.dynamics.rows import COMPILED, TrajectoryRows, friction_speeds
from robotid.dynamics.torque import build_problem, joint_torque_regressor, predict
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


def source(model, trajectory, engine=COMPILED, weights=None):
    weights = np.ones(trajectory.v.shape) if weights is None else weights
    kept = np.arange(len(model.layout.names))
    return TrajectoryRows(model, trajectory, weights, model.support, kept, engine)


def stacked(source, start=0, stop=None):
    stop = source.samples if stop is None else stop
    blocks = [[rows.copy() for rows in block] for block in source.blocks(start, stop)]
    return [np.vstack(parts) for parts in zip(*blocks, strict=True)]


def assert_is_pinocchio(model, trajectory):
    W = joint_torque_regressor(
        model, trajectory.q, trajectory.v, trajectory.a, trajectory.direction
    )
    W = W.reshape(len(trajectory.t), model.n_rows, -1)
    for engine in (COMPILED, "Pinocchio"):
        found = source(model, trajectory, engine)
        for j, (columns, rows_j) in enumerate(zip(found.columns, stacked(found), strict=True)):
            expected = np.column_stack([W[:, j, columns], trajectory.tau[:, j]])
            # a body's ten columns share their rounding: relative to the largest of the row
            bound = 1e-12 * np.abs(expected).max(axis=1, keepdims=True)
            assert (np.abs(rows_j - expected) <= bound).all()
            np.testing.assert_allclose(
                rows_j @ (pi := np.cos(np.arange(len(columns) + 1))),
                expected @ pi,
                atol=1e-11 * np.abs(expected).max(),
            )


@pytest.mark.parametrize("case", ROBOTS)
def test_compiled_rows_are_pinocchios(case, rng):
    name, options = ROBOTS[case]
    model = RobotModel.from_urdf(example_urdf(name), **options)
    assert rows.why_not(model) is None
    assert_is_pinocchio(model, motion(model, rng, 150))  # two groups of lanes and a part
    direction = rng.uniform(-1.2, 1.2, (150, len(friction_speeds(model.layout))))
    assert_is_pinocchio(model, motion(model, rng, 150, direction=direction))


@pytest.mark.parametrize("seed", range(4))
def test_compiled_rows_are_pinocchios_on_random_trees(seed, tmp_path):
    rng = np.random.default_rng(seed)
    parts = [LINK.format("l0")]
    for i in range(1, 8):
        text = {k: " ".join(map(str, rng.standard_normal(3))) for k in ("axis", "xyz", "rpy")}
        kind = rng.choice(["revolute", "prismatic", "continuous"])
        parts += [
            LINK.format(f"l{i}"),
            JOINT.format(i=i, kind=kind, parent=rng.integers(i), **text),
        ]
    path = tmp_path / "tree.urdf"
    path.write_text(f'<robot name="tree">{"".join(parts)}</robot>')
    model = RobotModel.from_urdf(path, free_flyer=bool(seed % 2))
    assert_is_pinocchio(model, motion(model, rng, 64))


def test_a_mimic_joint_follows_at_its_ratio_above_and_beside_its_leader(tmp_path, rng):
    model = mimicking(tmp_path, rng)
    assert model.joints == ("j1", "j4")
    assert_is_pinocchio(model, m := motion(model, rng, 64))
    pi = model.standard_parameters()
    W = joint_torque_regressor(model, m.q, m.v, m.a, m.direction)
    np.testing.assert_allclose((W @ pi).reshape(-1, 2), predict(model, [pi], m)[0], atol=1e-9)


@pytest.mark.parametrize("reach", [1e-9, 1.0, 1e3, 1e5])
def test_small_and_large_angles_keep_their_digits(reach, ur5, rng):
    assert_is_pinocchio(ur5, motion(ur5, rng, 100, reach))


@pytest.fixture
def long_log(panda, monkeypatch):
    """Three parts, the last one short, weights of a mask."""
    monkeypatch.setattr(factors, "_PART", 2048)
    rng = np.random.default_rng(1)
    trajectory = motion(panda, rng, 2 * 2048 + 777)
    return trajectory, rng.choice([0.0, 1.0, 4.0], trajectory.v.shape)


def test_factors_do_not_depend_on_the_number_of_threads(panda, long_log):
    problem = structural_mapping(panda).reduce(build_problem(panda, *long_log, compiled=True))
    one, two, three = (compress(problem, threads=threads) for threads in (1, 2, 3))
    np.testing.assert_array_equal(one.R, two.R)
    np.testing.assert_array_equal(one.R, three.R)
    np.testing.assert_array_equal(one.R, compress(problem).R)


@pytest.mark.parametrize("flag", [True, False])
def test_a_row_that_is_not_finite_is_refused_on_both_paths(flag, ur5, rng):
    weights = np.ones((200, 6))
    weights[17, 3] = np.nan
    with pytest.raises(DataError, match="a row that is not finite"):
        compress(build_problem(ur5, motion(ur5, rng, 200), weights, compiled=flag))


def test_the_path_is_chosen_by_the_length_of_the_log_and_said(ur5, rng, monkeypatch, caplog):
    trajectory = motion(ur5, rng, 200)
    with caplog.at_level(logging.INFO, logger="robotid"):
        assert build_problem(ur5, trajectory).sources[0].engine == "Pinocchio"
        monkeypatch.setattr(rows, "LONG_ENOUGH", 200 * rows.work_per_sample(ur5))
        with monkeypatch.context() as without:
            without.setattr(rows, "why_not", lambda model: "no compiler")
            assert build_problem(ur5, trajectory).sources[0].engine == "Pinocchio (no compiler)"
    assert caplog.messages == ["ur5: regressor of 200 samples: Pinocchio (no compiler)"]
    assert build_problem(ur5, trajectory).sources[0].engine == COMPILED
    assert build_problem(ur5, trajectory, compiled=False).sources[0].engine == "Pinocchio"
