"""The share of a motion that was seen before; how well motions determine parameters."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.paths import ROOT
from helpers.synthetic import exact_log, truth

from robotid.data.log import REPEATED, Trajectory, repeated_share
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.check_logs import check_excitation
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

EXACT = SignalSettings(cutoff=None, trim=0.0, min_velocity=0.0)


@pytest.fixture(scope="module")
def planar():
    return RobotModel.from_urdf(ROOT / "urdf" / "planar_2r.urdf")


@pytest.fixture(scope="module")
def motions(planar):
    """Motions of 10 s at 100 Hz, one quicker than the other."""
    rng = np.random.default_rng(1)
    logs = [
        exact_log(planar, truth(planar), rng, samples=n, rate=100.0, noise=[0.2, 0.05])
        for n in (1000, 1000, 600)
    ]
    return [process(log, EXACT) for log in logs]


def joined(first, second):
    """Return the rows of two motions as segments of one."""
    later = second.t - second.t[0] + first.t[-1] + 5.0
    arrays = {k: np.vstack([getattr(first, k), getattr(second, k)]) for k in ("q", "v", "a", "tau")}
    segment = np.repeat([0, 1], [len(first.t), len(second.t)])
    t = np.append(first.t, later)
    return Trajectory(t=t, joints=first.joints, rate=None, segment=segment, **arrays)


def test_the_share_that_repeats_is_that_of_the_log_that_has_most_of_it(motions):
    first, second, other = motions
    kept = joined(first.at(slice(100, 600)), other)
    # rows that go on for a second, 400 of the first segment and 500 of the second, and move in it
    moved = [np.abs(part[100:] - part[:-100]) / np.ptp(kept.q, axis=0) > 0.04
             for part in np.split(kept.q, [500])]  # fmt: skip
    old, new = (part.any(axis=1).sum() for part in moved)
    assert old == 400
    for fitted in ([first, second], [second, first]):
        assert repeated_share(fitted, kept) == pytest.approx(old / (old + new), abs=0.005)
    assert repeated_share([second], kept) == 0.0
    # 150 of 650 are less than three tenths
    assert repeated_share([first], joined(first.at(slice(0, 250)), other)) < REPEATED


def test_excitation_is_that_of_the_weighted_rows_of_all_motions(planar, motions):
    mapping, two = structural_mapping(planar), motions[1:]
    (found,) = check_excitation(planar, mapping, two, EXACT, "one, other")
    Y = np.concatenate([joint_torque_regressor(planar, m.q, m.v, m.a) for m in two])
    W = Y[:, mapping.independent].reshape(-1, 2, len(mapping.K))
    tau, sigma = np.concatenate([m.tau for m in two]), np.ones(2)
    for _ in range(30):
        rows = (W / sigma[:, None]).reshape(-1, W.shape[2])
        beta = np.linalg.lstsq(rows, (tau / sigma).ravel(), rcond=None)[0]
        sigma = np.sqrt(np.mean((tau - W @ beta) ** 2, axis=0))
    rows = (W / sigma[:, None]).reshape(-1, W.shape[2])
    condition = np.linalg.cond(rows / np.linalg.norm(rows, axis=0))
    assert found.evidence["condition"] == pytest.approx(condition, rel=2e-3)
    # of the plausible spread of base parameters, what the rows leave of its largest sum
    spread = prior_spread(planar, sum(m.squares for m in two), sum(len(m.t) for m in two))
    L = np.linalg.cholesky(mapping.K @ np.diag(spread**2) @ mapping.K.T)
    weakest = 1.0 / np.sqrt(1.0 + np.linalg.eigvalsh((rows @ L).T @ rows @ L)[0])
    assert found.evidence["weakest"] == pytest.approx(weakest, rel=2e-3)
    b = len(mapping.K)
    assert (found.evidence["rank"], found.evidence["base"]) == (b, b)
    assert found.severity == "note"
    assert found.message.startswith(f"one, other: the motion determines {b} of {b} base parameters")
    assert (
        f"(condition number {found.evidence['condition']:.3g} of the regressor, unit columns); no "
        "action needed" in found.message
    )


def test_the_excitation_by_a_joint_at_rest_is_checked_too(planar, motions):
    """The rows determine fewer sums than there are base parameters."""
    still = {name: getattr(motions[2], name) * [1.0, 0.0] for name in ("q", "v", "a")}
    mapping, motion = structural_mapping(planar), replace(motions[2], **still)
    (found,) = check_excitation(planar, mapping, [motion], EXACT, "one")
    Y = joint_torque_regressor(planar, motion.q, motion.v, motion.a)[:, mapping.independent]
    b = len(mapping.K)
    assert (found.evidence["rank"], found.evidence["base"]) == (np.linalg.matrix_rank(Y), b)
    assert found.evidence["rank"] < b
    assert found.severity == "warning"
    assert found.message.startswith("one: the motion determines 7 of 11 base parameters")
