"""What logs of commands tell about loops and drives: MuJoCo simulates legs that differ by log."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.mujoco_plant import plant, recorded

from robotid.dynamics.simulation.loops import ClosedLoopRobot, cut_windows
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import segment_scores
from robotid.identification.closed_loop.from_commands import loop_runs
from robotid.identification.closed_loop.loop_simulator import FreeParameter, LoopSimulator
from robotid.output.files.result_file import loops_of
from robotid.robot.drives import Coulomb

NOISE = 1e-4  # [rad]


@pytest.fixture(scope="module")
def leg():
    """Four logs of a leg; the third has a larger kp at the hip and friction at the calf."""
    rng = np.random.default_rng(0)
    robot = plant("leg", rng, delay=0.006)
    hip, thigh, calf = robot.drives
    changed = (replace(hip, kp=1.03 * hip.kp), thigh, replace(calf, coulomb=1.2 * calf.coulomb))
    logs = [
        recorded(replace(robot, drives=changed) if k == 2 else robot, rng, duration=1.5,
                 noise=NOISE)[0]
        for k in range(4)
    ]  # fmt: skip
    names, pi = robot.model.layout.names, robot.model.standard_parameters()
    for name, value in robot.truth.items():
        if name in names:
            pi[names.index(name)] = value
    free = (
        FreeParameter("calf.coulomb", "term", (2,), calf.coulomb, 1.0, 0.0, term=Coulomb()),
        FreeParameter("hip.kp", "kp", (0,), hip.kp, np.inf, 1.0),
        FreeParameter("hip.delay", "delay", (0,), 0.006, 0.1, 0.0),
    )
    windows = [window for log in logs for window in cut_windows(log, 0.5, 0.1)]
    base = loops_of(robot.model, pi, robot.drives)
    simulator = LoopSimulator(ClosedLoopRobot(robot.model), tuple(windows), base, free)
    estimate = Estimate(
        theta=simulator.prior, covariance=1e-6 * np.eye(3), names=simulator.names,
        sigma=np.full(3, NOISE), rank=3, condition=1.0, undetermined=(), converged=True, n_iter=1,
        message="", prior_std=simulator.prior_std,
        details={"correlation": np.zeros(3), "at_bound": ()},
    )  # fmt: skip
    return robot, simulator, estimate


def test_each_log_tells_its_own_gains_and_friction(leg):
    robot, simulator, estimate = leg
    calf, hip = loop_runs(robot.model, simulator, estimate)
    assert calf.group.parameters == ("calf.coulomb",)
    assert hip.group.parameters == ("hip.kp", "hip.delay")
    assert hip.group.units == ("N m/rad", "s")
    assert hip.runs.unit.tolist() == [0, 0, 0, 0]

    def values(found):
        return np.array([np.linalg.solve(*pair) for pair in zip(found.runs.H, found.runs.h,
                                                               strict=True)])  # fmt: skip

    coulomb = values(calf)[:, 0] / calf.centre[0]
    assert coulomb == pytest.approx([0.0, 0.0, 0.2, 0.0], abs=0.04)
    kp = values(hip)[:, 0] / hip.centre[0]
    assert kp == pytest.approx([0.0, 0.0, 0.03, 0.0], abs=0.006)
    assert np.abs(values(hip)[:, 1]).max() < 3e-4  # [s]
    assert hip.runs.scale == pytest.approx([0.1 * hip.centre[0], 1e-3])
    own = tuple(w for w in simulator.windows if w.log is simulator.windows[-1].log)
    each = [segment_scores(replace(simulator, windows=(w,)), estimate) for w in own]
    H, g = (sum(x[k].sum(axis=0) for x in each) for k in (0, 1))  # of all windows of the last log
    assert hip.runs.H[3] * hip.inflation == pytest.approx(H[1:, 1:], rel=1e-6)
    assert hip.runs.h[3] * hip.inflation == pytest.approx(g[1:], rel=1e-6)
    # another noise level: another information, the same inflated one
    louder = loop_runs(robot.model, simulator, replace(estimate, sigma=2.0 * estimate.sigma))
    assert louder[1].inflation == pytest.approx(hip.inflation / 4)
    assert pytest.approx(hip.runs.H) == louder[1].runs.H


def test_robots_bounds_and_two_logs(leg):
    robot, simulator, estimate = leg
    bound = replace(estimate, details={**estimate.details, "at_bound": ("hip.delay",)})
    _, hip = loop_runs(robot.model, simulator, bound, ["b", "b", "a", "a"])
    assert hip.group.parameters == ("hip.kp",)
    assert hip.runs.unit.tolist() == [1, 1, 0, 0]
    logs = list(dict.fromkeys(window.log for window in simulator.windows))[:2]
    two = replace(simulator, windows=tuple(w for w in simulator.windows if w.log in logs))
    assert loop_runs(robot.model, two, estimate) == ()
