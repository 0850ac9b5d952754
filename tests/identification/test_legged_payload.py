"""A robot on its feet: a payload on its trunk, and the expected errors of a planned motion."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.stands import recorded, stand

from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.design.previews import preview
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.dynamics.simulation.simulator import carried
from robotid.dynamics.torque import joint_torque_regressor
from robotid.identification.payload_fit import identify_payload
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

RAW = SignalSettings(cutoff=None, velocity="measured", acceleration="measured")
PACK = Payload("base_link", 0.4, (0.05, 0.02, 0.06), (1e-3, 0, 1e-3, 0, 0, 1e-3))
FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


@pytest.fixture(scope="module")
def robot():
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=("viscous",),
        constraints=[Contact(foot) for foot in FEET],
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs(robot):
    """Return the log with the payload, and that without it."""
    found = []
    for seed, payload in enumerate((PACK, Payload())):
        rng = np.random.default_rng(seed)
        motion = stand(robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, length=1.0)
        pi = carried(robot, robot.standard_parameters(), payload)
        found.append(recorded(robot, pi, motion, rng, rate=80.0, duration=3.0))
    return found


def test_the_payload_of_the_trunk_is_found(robot, runs):
    fit = identify_payload(robot, *runs, signals=RAW, friction="none")
    (payload,) = fit.payloads
    assert payload.link == "base_link"  # the base floats: it is the default
    assert payload.mass == pytest.approx(0.4, abs=3 * payload.mass_std_error)
    assert 1e-4 < payload.mass_std_error < 0.01
    assert (np.abs(payload.com - PACK.com) < 4 * payload.com_std_error).all()
    assert payload.com_std_error.max() < 0.02
    assert fit.unexplained.max() < 0.1


@pytest.fixture(scope="module")
def planned(robot):
    motion = stand(
        robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, np.random.default_rng(5), parts=5, length=1.0,
        rate=60.0,
    )  # fmt: skip
    t = np.arange(300) / 60.0
    q, v, a = motion.evaluate(t)
    flags = motion.touching(t).T
    log = Log(
        t, q[:, 7:], 0.0 * q[:, 7:], robot.joints, v[:, 6:], a[:, 6:], has_torque=False,
        base=BaseMotion(q[:, :7], v[:, :6], a[:, :6]),
        contacts=dict(zip(FEET, flags, strict=True)),
    )  # fmt: skip
    return robot, log


def test_the_errors_are_those_of_least_squares_with_noise_in_the_joints(planned):
    model, log = planned
    size = np.linspace(0.01, 0.05, 12)
    found = preview(
        model, log, noise=dict(zip(model.joints, size, strict=True)), signals=RAW, estimator="wls"
    )
    found_white = preview(model, log, noise=replace(found.noise, correlation=np.zeros(12)),
                          signals=RAW, estimator="wls")  # fmt: skip
    np.testing.assert_allclose(found.base_error, found_white.base_error * np.sqrt(0.1 * 60.0))
    recording = found.expected.fitted[0].recording
    motion, rows = recording.trajectory, recording.mask.all(axis=1)
    q, v, a = motion.q, motion.v, motion.a
    K, independent = found.expected.mapping.K, found.expected.mapping.independent
    W = joint_torque_regressor(model, q, v, a).reshape(len(q), 18, -1)[rows][..., independent]
    J = constraint_jacobian(model, q, motion.contacts)[rows]
    P = np.eye(18) - np.linalg.pinv(J) @ J
    projected = (P @ W).reshape(-1, len(K))
    bread = np.linalg.inv(projected.T @ projected)
    score = (P @ W)[:, 6:].swapaxes(1, 2) * size @ (size[:, None] * (P @ W)[:, 6:])
    wanted = np.sqrt(np.diag(bread @ score.sum(axis=0) @ bread))
    np.testing.assert_allclose(found_white.base_error, wanted, rtol=1e-5)
    level = np.einsum("kjj,j->", P[:, 6:, 6:], size**2) / np.trace(P, axis1=1, axis2=2).sum()
    np.testing.assert_allclose(found.expected.estimate.sigma, np.sqrt(level), rtol=0.01)
