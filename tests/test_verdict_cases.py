"""The simulator and the faults of the table of verdicts are what they are said to be."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.paths import ROOT

from robotid import doctor
from robotid.cli.job import Job
from robotid.data.files.read import write_columns
from robotid.dynamics.torque import joint_torque_regressor

sys.path.append(str(ROOT / "benchmarks"))
from verdict_cases import CASES, ROBOTS, build, coupling, make, move, periodic, stribeck


@pytest.mark.parametrize("name", ["ur5", "kinova j2s6", "tiago", "planar 2R"])
def test_the_simulated_torque_is_linear_in_the_true_parameters(name):
    arm = build(ROBOTS[name], (0, 2))
    run = move(arm.model, np.random.default_rng(3), 100.0, 2.0)
    run = replace(run, v=np.where(np.abs(run.v) < 0.02, 0.02, run.v))  # where tanh is the sign
    W = joint_torque_regressor(arm.model, run.q, run.v, run.a)
    expected = (W @ arm.pi).reshape(run.q.shape)
    np.testing.assert_allclose(arm.rigid(run) + arm.drives(run), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("fault", [stribeck, periodic, coupling])
def test_a_fault_of_the_plant_is_the_same_in_every_recording(fault):
    """Where two recordings pass the same state, the fault adds the same torque."""
    arm = build(ROBOTS["planar 2R"], (0, 2))
    run = move(arm.model, np.random.default_rng(3), 100.0, 8.0)
    part = replace(run, **{x: getattr(run, x)[300:500] for x in ("t", "q", "v", "a", "tau")})
    whole, piece = (fault(one, arm).tau - one.tau for one in (run, part))
    assert np.abs(whole).max() > 0
    np.testing.assert_allclose(piece, whole[300:500], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("robot", "key", "joint", "zero"),
    [("ur5", 3871452414, "elbow_joint", 0.3), ("ur5", 3871452414, "wrist_1_joint", 0.3),
     ("panda", 3305610995, "panda_joint4", -0.2), ("panda", 3305610995, "panda_joint4", 0.0)],
)  # fmt: skip
def test_zeros_beside_errors_of_masses_and_of_parallel_axes_are_named(
    robot, key, joint, zero, tmp_path
):
    of = ROBOTS[robot]
    made = make(of, CASES["clean, no dq"], (0, key, 2470987132), tmp_path)
    made.fitted[f"q_{joint}"] += zero
    write_columns(made.fitted, path := tmp_path / "run.csv")
    model = Job(of.path, joints=of.joints, locked=made.arm.model.locked).model()
    found = [f for f in doctor(model, path) if f.severity != "note"]
    assert [(f.code, f.joints) for f in found] == [("position_offset", (joint,))] * bool(zero)
