from dataclasses import replace

import numpy as np
from helpers.mujoco_plant import multisine, plant

from robotid.data.log import Log
from robotid.dynamics.simulation.loops import ClosedLoopRobot, RollOut, Window, cut_windows
from robotid.identification.closed_loop.loop_simulator import (
    FreeParameter,
    LoopSimulator,
    _better_start,
)
from robotid.output.files.result_file import loops_of

NOISE = 3e-4  # [rad]


def simulator(rng):
    """Return windows of a roll-out with noise, without a lead, and where they began in truth."""
    arm = plant("planar", rng, delay=0.006)
    pi, names = arm.model.standard_parameters(), arm.model.layout.names
    for drive in arm.drives:
        for term in ("armature", "viscous", "coulomb"):
            pi[names.index(f"{drive.joint}.{term}")] = getattr(drive, term)
    t = np.arange(750) / 250.0
    q_ref = multisine(t, arm.middle, arm.reach, rng)
    log = Log(t, q_ref, 0 * q_ref, arm.model.joints, q_ref=q_ref, has_torque=False)
    robot, loops = ClosedLoopRobot(arm.model, step=4e-3), loops_of(arm.model, pi, arm.drives)
    [out] = robot.roll_out(loops, cut_windows(log, np.inf, 0.0))
    noisy = replace(log, q=out.q + NOISE * rng.standard_normal(out.q.shape))
    unknown = FreeParameter("delay", "delay", (0, 1), 0.006, 0.1)
    windows = cut_windows(noisy, 1.0, 0.0)
    truth = np.array([[out.q[w.start_row], out.v[w.start_row]] for w in windows])
    return LoopSimulator(robot, windows, loops, (unknown,)), truth


def test_starts_that_fit_are_nearer_to_the_truth_than_those_measured(rng):
    measured, truth = simulator(rng)
    better = measured.with_better_start(measured.prior)
    before, after = (np.array([w.start for w in one.windows]) - truth for one in (measured, better))
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    left = np.concatenate([r.e for r in better.residuals(measured.prior, with_slopes=False)])
    assert np.sqrt(np.mean(left**2)) < 1.2 * NOISE
    assert [(w.start_row, w.first, w.stop) for w in better.windows] == [
        (w.start_row, w.first, w.stop) for w in measured.windows
    ]


def test_a_corrected_start_is_regularised_by_position_errors_and_the_typical_speed(rng):
    """Two parts of one and two joints; sensitivities are of positions, then of speeds."""
    t, n, sigma = 5.0 + 0.02 * np.arange(40), 3, np.array([0.01, 0.03, 0.002])
    q = np.cumsum(rng.normal(size=(40, n)), axis=0)
    window = Window(Log(t, q, 0 * q, ("a", "b", "c")), 5, 10, 30)
    parts = [(np.array([1]), np.array([1, 4])), (np.array([0, 2]), np.array([0, 2, 3, 5]))]
    slopes = tuple((*x, rng.normal(size=(20, len(x[0]), len(x[1])))) for x in parts)
    simulated = q[10:30] + 0.05 * rng.normal(size=(20, n))
    found = _better_start(RollOut(window, simulated, 0 * simulated, slopes), sigma).ravel()
    speed = np.sqrt(np.mean((np.diff(q, axis=0) / 0.02) ** 2, axis=0))
    prior = np.diag(np.concatenate([3.0 * sigma, speed]) ** -2.0)
    for joints, places, S in slopes:
        W = np.tile(sigma[joints] ** -2.0, 20)
        A, e = S.reshape(-1, len(places)), (q[10:30] - simulated)[:, joints].ravel()
        H = (A.T * W) @ A + prior[np.ix_(places, places)]
        np.testing.assert_allclose(found[places], np.linalg.solve(H, (A.T * W) @ e), rtol=1e-6)
