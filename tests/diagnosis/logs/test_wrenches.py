"""Findings on measured forces of the ground: sign and unit."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.legged import with_other_bodies
from helpers.stands import recorded, stand

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.base_checks import check_base, check_wrenches
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.torque import predict
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

SLOW = SignalSettings(cutoff=4.0)
FEET, PARTS = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), ("fx", "fy", "fz")


@pytest.fixture(scope="module")
def robot():
    contacts = [Contact(foot, measured=PARTS) for foot in FEET]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(), constraints=contacts
    )


@pytest.fixture(scope="module")
def log(robot):
    """Return a log with forces of a robot on its feet whose bodies differ from the URDF's."""
    rng = np.random.default_rng(3)
    other = with_other_bodies(robot, rng)
    motion = stand(robot, np.tile([0.0, 0.8, -1.6], 4), 0.25, rng, parts=2)
    return recorded(
        other, other.standard_parameters(), motion, rng, rate=80.0, duration=6.0,
        acceleration=False,
    )  # fmt: skip


def found(model, log):
    return list(check_wrenches(model, log.name, process(log, SLOW)))


def parts(model, log):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(log, SLOW), np.ones((1, len(FEET)), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, log, factor=1.0):
    """Return the RMS force of W pi - factor J^T f of the base."""
    caused, torque = parts(model, log)
    return np.sqrt(np.mean(np.sum((torque - factor * caused)[:, :3] ** 2, axis=1)))


def scaled(log, factor):
    return replace(log, wrenches={x: factor * y for x, y in log.wrenches.items()})


def test_right_forces_have_no_finding(robot, log):
    assert not list(check_base(robot, log, SLOW))


@pytest.mark.parametrize(
    ("size", "words", "factor"),
    [
        (-1.0, "their sign is reversed", -1.0),
        (1e-3, "another unit, kN", 1e3),
        (1 / 9.81, "another unit, kgf", 9.81),
        (0.2, "another unit. Correct", 5.0),
    ],
)
def test_a_fault_of_the_columns_is_named(robot, log, size, words, factor):
    wrong = scaled(log, size)
    (finding,) = found(robot, wrong)
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert words in finding.message
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.3 * 2.5 * 9.81  # what masses of the URDF leave
    assert finding.evidence["force"] == pytest.approx(unexplained(robot, wrong))
    caused, left = (x[:, :6] for x in parts(robot, wrong))
    if factor > 1.0:  # least squares of force and moment together
        factor = np.sum(caused * left) / np.sum(caused**2)
    assert finding.evidence["factor"] == pytest.approx(factor)
    assert finding.evidence["best"] == pytest.approx(unexplained(robot, wrong, factor))


def test_vertical_forces_alone_show_their_sign(robot, log):
    contacts = [Contact(foot, "point", ("fz",)) for foot in FEET]
    model = replace(robot, constraints=tuple(contacts))
    vertical = replace(log, wrenches={f"fz {foot}": log.wrenches[f"fz {foot}"] for foot in FEET})
    assert not found(model, vertical)
    (finding,) = found(model, scaled(vertical, -1.0))
    assert "their sign is reversed" in finding.message
