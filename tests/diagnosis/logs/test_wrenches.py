"""Findings on measured forces of the ground: sign and unit."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.humans import FEET, PARTS, human_urdf, logged, walk, with_other_segments

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs.contacts import check_base, check_wrenches
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.prediction import predict
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel

SLOW = SignalSettings(cutoff=4.0)


@cache
def on_no_ground(urdf):
    return RobotModel.from_urdf(urdf, free_flyer=True, terms=())


def human(urdf):
    contacts = [Contact(foot, "surface", measured=PARTS, axes="link") for foot in FEET]
    return replace(on_no_ground(urdf), constraints=tuple(contacts))


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("human") / "human.urdf"
    path.write_text(human_urdf())
    return path


@pytest.fixture(scope="module")
def motion(urdf):
    """Return a walk of a human whose segments differ from those of the URDF by 15 %."""
    model, rng = human(urdf), np.random.default_rng(3)
    return walk(model, with_other_segments(model, rng), rng, duration=6.0, rate=60.0)


@pytest.fixture(scope="module")
def log(urdf, motion):
    return logged(human(urdf), motion, np.random.default_rng(4))


def found(model, log):
    return list(check_wrenches(model, log.name, process(log, SLOW)))


def parts(model, log):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(log, SLOW), np.ones((1, 2), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, log, factor=1.0):
    """Return the RMS force of W pi - factor J^T f of the base."""
    caused, torque = parts(model, log)
    return np.sqrt(np.mean(np.sum((torque - factor * caused)[:, :3] ** 2, axis=1)))


def scaled(log, factor):
    return replace(log, wrenches={x: factor * y for x, y in log.wrenches.items()})


def test_right_forces_have_no_finding_though_feet_move(urdf, log):
    assert not list(check_base(human(urdf), log, SLOW))


@pytest.mark.parametrize(
    ("size", "words", "factor"),
    [
        (-1.0, "their sign is reversed", -1.0),
        (1e-3, "another unit, kN", 1e3),
        (1 / 9.81, "another unit, kgf", 9.81),
        (0.2, "another unit. Correct", 5.0),
    ],
)
def test_a_fault_of_the_columns_is_named(urdf, log, size, words, factor):
    model, wrong = human(urdf), scaled(log, size)
    (finding,) = found(model, wrong)
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert words in finding.message
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.2 * 70 * 9.81  # what masses of the URDF leave
    assert finding.evidence["force"] == pytest.approx(unexplained(model, wrong))
    caused, left = (x[:, :6] for x in parts(model, wrong))
    if factor > 1.0:  # least squares of force and moment together
        factor = np.sum(caused * left) / np.sum(caused**2)
    assert finding.evidence["factor"] == pytest.approx(factor)
    assert finding.evidence["best"] == pytest.approx(unexplained(model, wrong, factor))


def test_vertical_forces_alone_show_their_sign(urdf, log):
    contacts = [Contact(foot, "point", ("fz",), always=True) for foot in FEET]
    model = replace(human(urdf), constraints=tuple(contacts))
    # the feet on the ground are level: their z is the world's
    vertical = replace(log, wrenches={f"fz {foot}": log.wrenches[f"fz {foot}"] for foot in FEET})
    assert not found(model, vertical)
    (finding,) = found(model, scaled(vertical, -1.0))
    assert "their sign is reversed" in finding.message
