"""Segment masses of a human from motion and forces of the ground, without torques."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.humans import FEET, PARTS, human_urdf, logged, walk, with_other_segments

from robotid import identify
from robotid.data.base_motion import BaseMotion
from robotid.data.signal_settings import SignalSettings
from robotid.estimation.fitting.estimator_settings import ConsistentSettings
from robotid.robot.bodies import negligible_bodies
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel

LIMBS = ("T9T8", "Hip", "Knee", "Ankle")  # the others are locked


@pytest.fixture(scope="module")
def human(tmp_path_factory):
    path = tmp_path_factory.mktemp("human") / "human.urdf"
    path.write_text(human_urdf())
    contacts = [Contact(foot, "surface", PARTS, axes="link") for foot in FEET]
    every = RobotModel.from_urdf(path, free_flyer=True).joints
    joints = [x for x in every if any(limb in x for limb in LIMBS)]
    return RobotModel.from_urdf(
        path, joints=joints, free_flyer=True, terms=(), constraints=contacts
    )


@pytest.fixture(scope="module")
def found(human):
    """Return the true human and the result of a recording."""
    rng = np.random.default_rng(6)
    true = with_other_segments(human, rng)
    log = logged(human, walk(human, true, rng, duration=15.0, rate=60.0), rng)
    settings = ConsistentSettings(prior_weight=1.0)
    signals = SignalSettings(cutoff=4.0)
    return true, identify(human, log, estimator=settings, friction="none", signals=signals)


def test_masses_follow_from_forces_and_motion(human, found):
    true, result = found
    truth, layout = true.standard_parameters(), human.layout
    masses = np.arange(0, layout.n_inertial, 10)
    assert result.standard[masses].sum() == pytest.approx(truth[masses].sum(), rel=0.01)
    assert abs(truth[masses].sum() / human.standard_parameters()[masses].sum() - 1) > 0.02
    fake = layout.owned_by(negligible_bodies(human))
    urdf = human.standard_parameters()
    np.testing.assert_allclose(result.standard[fake], urdf[fake], atol=1e-18)
    real = [i for i in masses if not fake[i]]
    low, high = result.standard_interval[real].T
    assert np.mean((low <= truth[real]) & (truth[real] <= high)) > 0.75
    trunk = [layout.names[i] for i in real].index("T8.m")
    assert high[trunk] - low[trunk] < 0.5 * truth[real][trunk]  # the prior alone: 4 times of it
    assert set(result.metrics().per_joint) == set(human.row_names[:6])


def test_vertical_forces_of_a_walk_weigh_in_spite_of_drift(human):
    """Odometry drifts by 2 cm/s, quaternions change their signs, and feet leave the ground."""
    rng = np.random.default_rng(7)
    true = with_other_segments(human, rng)
    motion = walk(human, true, rng, duration=8.0, rate=50.0)
    whole = logged(human, motion, rng, plates=[pin.SE3.Identity()] * 2)
    pose = whole.base.pose.copy()
    pose[:, 0] += 0.02 * motion.t
    pose[:, 3:] *= rng.choice([-1.0, 1.0], len(pose))[:, None]
    force = {f"fz {foot}": whole.wrenches[f"fz {foot}"] for foot in FEET}
    flags = {foot: force[f"fz {foot}"] > 20.0 for foot in FEET}
    log = replace(whole, base=BaseMotion(pose), wrenches=force, contacts=flags)
    contacts = tuple(Contact(foot, "surface", ("fz",), threshold=20.0) for foot in FEET)
    settings = ConsistentSettings(prior_weight=1.0, draws=0)
    result = identify(
        replace(human, constraints=contacts), log, estimator=settings, friction="none",
        signals=SignalSettings(cutoff=5.0),
    )  # fmt: skip
    masses = slice(0, human.layout.n_inertial, 10)
    truth = true.standard_parameters()[masses].sum()
    assert result.standard[masses].sum() == pytest.approx(truth, rel=0.01)
    assert abs(truth / human.standard_parameters()[masses].sum() - 1) > 0.02
    assert not [x for x in result.findings if x.severity == "error"]
