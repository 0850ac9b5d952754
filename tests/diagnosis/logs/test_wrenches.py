"""Findings on measured forces of the ground: sign, unit, foot and axes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers.humans import FEET, PARTS, human_urdf, logged, walk, with_other_segments

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.diagnosis.logs import wrenches
from robotid.diagnosis.logs.contacts import check_base
from robotid.diagnosis.logs.wrenches import _Reading, check_wrenches
from robotid.dynamics.constraint_rows import constraint_jacobian
from robotid.dynamics.prediction import predict
from robotid.robot.constraints import Contact, link_positions
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
    return list(check_wrenches(model, log, process(log, SLOW)))


def parts(model, log):
    """Return J^T f and W pi, shape (N, n_rows)."""
    motion, whole = process(log, SLOW), np.ones((1, 2), dtype=bool)
    torque = predict(replace(model, constraints=()), [model.standard_parameters()], motion)[0]
    J = constraint_jacobian(model, motion.q, np.repeat(whole, len(motion.t), axis=0))
    return np.einsum("kmj,km->kj", J, motion.wrenches), torque


def unexplained(model, log):
    """Return the RMS force and moment of W pi - J^T f of the base."""
    caused, torque = parts(model, log)
    left = (torque - caused)[:, :6]
    return [np.sqrt(np.mean(np.sum(x**2, axis=1))) for x in (left[:, :3], left[:, 3:])]


def exchanged(log):
    names = {foot: other for foot, other in zip(FEET, FEET[::-1], strict=True)}
    wrenches = {x: log.wrenches[f"{x[:2]} {names[x[3:]]}"] for x in log.wrenches}
    return replace(log, wrenches=wrenches)


def scaled(log, factor):
    return replace(log, wrenches={x: factor * y for x, y in log.wrenches.items()})


def test_right_forces_have_no_finding_though_feet_move(urdf, log):
    assert not list(check_base(human(urdf), log, SLOW))


@pytest.mark.parametrize(
    ("change", "words", "factor"),
    [
        (lambda log: scaled(log, -1.0), ["their sign is reversed"], -1.0),
        (exchanged, ["those of LeftFoot, RightFoot are exchanged"], 1.0),
        (lambda log: scaled(exchanged(log), -1.0), ["are exchanged", "sign is reversed"], -1.0),
        (lambda log: scaled(log, 1e-3), ["another unit, kN"], 1e3),
        (lambda log: scaled(log, 1 / 9.81), ["another unit, kgf"], 9.81),
        (lambda log: scaled(log, 0.2), ["another unit. Correct"], 5.0),
    ],
)
def test_a_fault_of_the_columns_is_named(urdf, log, change, words, factor):
    (finding,) = found(human(urdf), change(log))
    assert (finding.code, finding.severity) == ("measured_wrench", "error")
    assert all(text in finding.message for text in words)
    assert ("exchanged" in finding.message) == ("are exchanged" in " ".join(words))
    assert finding.evidence["factor"] == pytest.approx(factor, rel=0.2)
    assert finding.evidence["best"] < 0.2 * 70 * 9.81  # what masses of the URDF leave
    force, moment = unexplained(human(urdf), change(log))
    assert finding.evidence["force"] == pytest.approx(force)
    shown = f"leave {force:.3g} N and {moment:.3g} N m (RMS) of the base unexplained, but only"
    assert shown in finding.message
    right, moment = unexplained(human(urdf), log)
    if factor > 1.0:  # least squares of force and moment together
        caused, left = (x[:, :6] for x in parts(human(urdf), change(log)))
        found_factor = np.sum(caused * left) / np.sum(caused**2)
        assert finding.evidence["factor"] == pytest.approx(found_factor)
        assert f"multiplied by about {found_factor:.2g}" in finding.message
    else:  # as logged, not multiplied by a fitted factor
        assert finding.evidence["factor"] == factor
        assert finding.evidence["best"] == pytest.approx(right)
        assert f"but only {right:.3g} N and {moment:.3g} N m if" in finding.message


def test_axes_in_which_the_vertical_force_is_unknown_explain_nothing(urdf, log):
    """Of feet whose z is level, fz with the axes of the link leaves all of the weight unknown."""
    contacts = [Contact(foot, "point", ("fz",), always=True) for foot in FEET]
    model = replace(human(urdf), constraints=tuple(contacts))
    values = {f"fz {foot}": -log.wrenches[f"fz {foot}"] for foot in FEET}
    toes = replace(log, wrenches=values)
    (finding,) = found(model, toes)
    assert "axes" not in finding.message


def test_vertical_forces_alone_show_their_sign_and_foot(urdf, log):
    contacts = [Contact(foot, "point", ("fz",), always=True) for foot in FEET]
    model = replace(human(urdf), constraints=tuple(contacts))
    # the feet on the ground are level: their z is the world's
    vertical = replace(log, wrenches={f"fz {foot}": log.wrenches[f"fz {foot}"] for foot in FEET})
    assert not found(model, vertical)
    (finding,) = found(model, scaled(vertical, -1.0))
    assert "their sign is reversed" in finding.message


@pytest.mark.parametrize(
    ("force", "moment", "is_better"),
    [
        (49.0, 10.0, True),  # half of a force that is not small
        (51.0, 10.0, False),
        (100.0, 4.9, True),  # half of a moment that is not small
        (119.0, 4.9, True),
        (121.0, 4.9, False),  # the force is worse by more than 1.2
        (49.0, 12.1, False),  # the moment is worse by more than 1.2, and not small
        (49.0, 11.9, True),
    ],
)
def test_a_better_reading_halves_one_residual_and_keeps_the_other(force, moment, is_better):
    def reading(force, moment):
        directions = np.tile([0.6, 0.0, 0.8, 0.0, -1.0, 0.0], (4, 1))
        return _Reading((), False, 1.0, directions * np.repeat([force, moment], 3), 200.0)

    stated = reading(100.0, 10.0)
    assert stated.sizes == pytest.approx((100.0, 10.0))
    assert reading(force, moment).is_better(stated, (90.0, 9.0)) is is_better
    small = reading(40.0, 4.0).is_better(stated, (101.0, 11.0))  # both are small already
    assert small is False
    assert reading(40.0, 15.0).is_better(stated, (90.0, 16.0)) is True  # a small moment may grow


def test_the_reading_with_the_smallest_force_and_moment_is_named(urdf, log, monkeypatch):
    """Shares of the weight, and of the weight at the distance of the feet; as stated 0.8 and 0.6.

    X exchanges the feet.
    """
    model, motion = human(urdf), process(log, SLOW)
    weight = 9.81 * sum(x.mass for x in model.pin_model.inertias)
    some = motion.every(max(1, len(motion.t) // 400))
    feet = link_positions(model.pin_model, model.configurations(some.q), FEET)
    apart = np.linalg.norm(feet - some.q[:, None, :3], axis=2)
    lever = np.sqrt(np.mean(apart**2)) + 1e-3

    def reading(name, force, moment, known):
        own = np.zeros((len(some.t), 6))
        own[:, 1], own[:, 5] = force * weight, moment * weight * lever
        return _Reading(tuple(name.split()), name == "X", 1.0, own, known * weight)

    for others, wanted in [
        ([("a", 0.45, 0.5, 1.0)], None),  # half of neither
        ([("a", 0.39, 0.5, 1.0), ("b", 0.45, 0.01, 1.0)], "b"),
        ([("a", 0.001, 0.05, 1.0), ("b", 0.004, 0.03, 1.0)], "b"),  # 0.011 0.06 and 0.014 0.04
        ([("a c", 0.2, 0.10, 1.0), ("b", 0.2, 0.115, 1.0)], "b"),  # 1.2 for a second change
        ([("a c", 0.2, 0.08, 1.0), ("b", 0.2, 0.115, 1.0)], "a and c"),
        ([("a", 0.2, 0.01, 0.49), ("b", 0.3, 0.2, 0.51)], "b"),  # most of the force is unknown
        ([("X", 0.1, 0.4, 1.0), ("b", 0.3, 0.4, 1.0)], "b"),  # the force does not show the foot
        ([("X", 0.1, 0.2, 1.0), ("b", 0.3, 0.4, 1.0)], "X"),
    ]:
        every = [reading(*own) for own in [("", 0.8, 0.6, 1.0), *others]]
        monkeypatch.setattr(wrenches, "_readings", lambda *_, every=every: every)
        finding = next(iter(check_wrenches(model, log, motion)), None)
        if wanted is None:
            assert finding is None or "only" not in finding.message
            continue
        best = next(x for x in every if " and ".join(x.changes) == wanted)
        assert f"if {wanted}. Correct the columns" in finding.message
        assert finding.evidence["force"] == pytest.approx(0.8 * weight)
        assert finding.evidence["best"] == pytest.approx(best.sizes[0])
        force, moment = best.sizes
        assert f"but only {force:.3g} N and {moment:.3g} N m if" in finding.message
