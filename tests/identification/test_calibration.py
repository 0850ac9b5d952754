"""Faults of zeros and scales that masses can imitate in part, and are named all the same."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.identification.pipeline import identify

NOISE = 0.05 * np.array([4, 4, 2, 1, 1, 0.5])


def spoiled(ur5, spoil):
    logs = []
    for rng in np.random.default_rng(0).spawn(2):
        log = exact_log(ur5, truth(ur5), rng, samples=2000, rate=100.0, noise=NOISE)
        logs.append(spoil(replace(log, v=None, a=None)))
    return identify(ur5, logs[:1], validation=logs[1:], doctor=False, estimator="wls")


def elbow(x, change):
    x = x.copy()
    x[:, 2] = change(x[:, 2])
    return x


FAULTS = {
    "time_scale": (lambda log: replace(log, t=1.1 * log.t), "recordings", 0.1),
    "angle_scale": (lambda log: replace(log, q=1.1 * log.q), "recordings", 0.1),
    "position_offset": (
        lambda log: replace(log, q=elbow(log.q, lambda x: x + 0.1)), "elbow_joint", 0.1,
    ),
    "torque_scale": (
        lambda log: replace(log, tau=elbow(log.tau, lambda x: 1.5 * x)), "elbow_joint", 0.5,
    ),
}  # fmt: skip


@pytest.mark.parametrize("code", FAULTS)
def test_a_fault_is_named_with_its_size_and_leaves_a_doubt(ur5, code):
    spoil, where, size = FAULTS[code]
    found = spoiled(ur5, spoil)
    (finding,) = [f for f in found.findings if f.code in FAULTS][:1]
    assert (finding.code, finding.where, finding.severity) == (code, where, "warning")
    assert finding.evidence["fault"] == pytest.approx(size, rel=0.25)
    assert code in {doubt.code for doubt in found.doubts}
    assert found.verdict.status != "good"


def test_a_clean_recording_of_another_robot_has_none(ur5):
    found = spoiled(ur5, lambda log: log)
    assert not [f for f in found.findings if f.code in FAULTS]


def test_without_a_kept_recording_nothing_is_confirmed_nor_named(ur5):
    spoil = FAULTS["time_scale"][0]
    log = exact_log(ur5, truth(ur5), np.random.default_rng(0), samples=2000, rate=100.0, noise=0.1)
    found = identify(ur5, [spoil(replace(log, v=None, a=None))], doctor=False, estimator="wls")
    assert not [f for f in found.findings if f.code in FAULTS]
