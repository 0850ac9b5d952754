"""robotid.identify by simulation: what run_job finds of the same logs, without files."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, torque_log

import robotid
from robotid.cli.identify import run_job
from robotid.cli.job import read_job
from robotid.identification.closed_loop.from_commands import PositionIdentification

SETTINGS = {"bodies": 0.0, "step": 4e-3, "torques": False}


@pytest.fixture(scope="module")
def arm():
    rng = np.random.default_rng(5)
    robot = plant("planar", rng, delay=0.0)
    logs = [torque_log(robot, rng, duration=d, noise=2e-5, torque=0.05) for d in (3.0, 2.0)]
    return robot.model, *logs


@pytest.fixture(scope="module")
def found(arm):
    model, log, kept = arm
    return robotid.identify(
        model, log, validation=kept, controller={"kind": "torque"}, doctor=False,
        friction="viscous+coulomb",
        estimator=robotid.EstimatorSettings("simulation", **SETTINGS),
    )  # fmt: skip


def test_it_finds_what_a_job_finds_of_the_same_logs(arm, found, tmp_path):
    model, *logs = arm
    for name, log in zip(("log", "kept"), logs, strict=True):
        robotid.write_log(log, tmp_path / f"{name}.csv")
    (tmp_path / "job.toml").write_text(
        f"urdf = '{model.tree.path}'\n[model]\nfriction = 'viscous+coulomb'\n"
        "[estimator]\nname = 'simulation'\nbodies = 0.0\nstep = 4e-3\ntorques = false\n"
        "[controller]\nkind = 'torque'\n[[identification]]\nlog = 'log.csv'\n"
        "[[validation]]\nlog = 'kept.csv'\n[output]\nreport = false\n"
    )
    again, _ = run_job(read_job(tmp_path / "job.toml"), tmp_path / "out")
    assert isinstance(found, PositionIdentification)
    np.testing.assert_allclose(found.standard, again.standard, rtol=1e-6, atol=1e-9)
    assert len(found.validation) == 1
    assert found.verdict.status == again.verdict.status
    alone = replace(again, stated=replace(again.stated, job=None))  # as if it came of these files
    saved = robotid.load_result(robotid.save_result(alone, tmp_path / "alone", report=False))
    for role, log in zip(("identification", "validation"), logs, strict=True):
        (entry,) = saved.content["settings"][role]
        assert (entry["start"], entry["end"]) == pytest.approx((log.t[0], log.t[-1]), abs=1e-6)
