"""Which reading of the torques is reported, with whose figures."""

from types import SimpleNamespace

import numpy as np
import pytest

from robotid.diagnosis.logs import torque_checks as torques
from robotid.diagnosis.logs.hypotheses import Explanation

PROBE = SimpleNamespace(
    model=SimpleNamespace(joints=("a", "b", "c", "d")), gravity=np.array([0.0, 0.0, -9.81])
)
STATED = Explanation("stated", np.array([0.9, 0.6, 0.05, 0.5]))


def reading(kind, share, joints=(), values=()):
    best = Explanation(kind, np.array(share), joints, values)
    return torques._Reading(PROBE, STATED, best, "run.csv")


@pytest.mark.parametrize(
    ("kind", "key", "words"),
    [
        ("torque_sign", "unexplained_if_negated", "with the sign reversed"),
        ("unsigned_torque", "unexplained_with_signs", "with the signs of the model"),
    ],
)
def test_a_sign_is_reported_of_each_joint_that_it_explains(kind, key, words):
    reported = reading(kind, [0.1, 0.3, 0.04, 0.15], (0, 1, 3))
    found = list(torques._FINDINGS[kind](reported))
    assert [(f.code, f.where) for f in found] == [(kind, "run.csv: a"), (kind, "run.csv: d")]
    for finding, before, after in zip(found, (0.9, 0.5), (0.1, 0.15), strict=True):
        assert finding.evidence == {"unexplained": before, key: after}
        reported = (
            f"{100 * before:.0f} % of its variance is unexplained, {words} {100 * after:.2g} %"
        )
        assert reported in finding.message
    if kind == "torque_sign":  # of a torque that was explained before, the other sign is no news
        assert list(torques._sign(reading(kind, [0.9, 0.6, 0.01, 0.5], (2,)))) == []


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("torque_order", "tau_a is the torque of c, tau_c is the torque of a; "),
        ("position_order", "the position columns of a, c are exchanged"),
        ("joint_order", "all columns of a, c are exchanged"),
    ],
)
def test_exchanged_columns_are_reported_with_the_largest_shares(kind, words):
    values = (2.0, 1.0, 0.0, 3.0) if kind == "torque_order" else ()
    reported = reading(kind, [0.08, 0.01, 0.02, 0.03], (0, 2), values)
    (finding,) = torques._exchanged(reported)
    assert words.rstrip("; ") in finding.message
    assert "largest unexplained share of a torque decreases from 90 to 8 %" in finding.message
    assert (finding.code, finding.severity, finding.where) == (kind, "error", "run.csv: a, c")
    gain = np.sum(np.log(STATED.share + 1e-3)) - np.sum(np.log(reported.best.share + 1e-3))
    assert finding.evidence == pytest.approx(
        {"gain": gain, "unexplained": 0.9, "unexplained_so_read": 0.08}
    )
    assert list(torques._exchanged(reading(kind, [0.5, 0.4, 0.02, 0.3], (0, 2), values))) == []


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("joint_axis", "position and torque of d have the opposite sign: its axis is reversed"),
        ("position_sign", "the position of d has the opposite sign"),
        ("position_offset", "the zero position of d has an error of about -0.37 rad"),
    ],
)
def test_a_position_is_reported_with_the_torque_that_gains_most(kind, words):
    """Which is neither that of the joint nor the one explained worst."""
    reported = reading(kind, [0.85, 0.05, 0.04, 0.1], (3,), (-0.37,))
    (finding,) = torques._position(reported)
    assert finding.message.startswith(f"run.csv: {words}")
    assert "share of the torque of b then decreases from 60 to 5 %" in finding.message
    assert finding.where == "run.csv: d"
    assert list(torques._position(reading(kind, [0.9, 0.5, 0.04, 0.4], (3,), (-0.37,)))) == []


@pytest.mark.parametrize(("degrees", "severity"), [(40.0, "error"), (12.0, "warning"), (3.0, None)])
def test_gravity_is_reported_with_its_angle_and_vector(degrees, severity):
    angle = np.radians(degrees)
    g = 9.81 * np.array([np.sin(angle) * 0.6, np.sin(angle) * 0.8, -np.cos(angle)])
    reported = reading("gravity", [0.1, 0.05, 0.04, 0.1], (0, 1, 2, 3), tuple(g))
    found = list(torques._gravity(reported))
    assert [f.severity for f in found] == ([severity] if severity else [])
    for finding in found:
        shown = ", ".join(f"{x:.2f}" for x in g)
        assert f"gravity [{shown}] m/s^2 explains the torques best" in finding.message
        assert f"{degrees:.0f} degrees from the stated [0.00, 0.00, -9.81]" in finding.message
        wanted = {"angle_deg": degrees, "x": g[0], "y": g[1], "z": g[2], "gain": reported.gain}
        assert finding.evidence == pytest.approx(wanted)


def test_a_load_excuses_a_sign_if_it_explains_every_joint_named():
    best = Explanation("torque_sign", np.array([0.01, 0.03, 0.0, 0.5]), (0, 1))
    for share, is_excused in (
        ((0.15, 0.29), True),  # 12 (0.01 + 0.003), and 0.3
        ((0.16, 0.29), False),
        ((0.15, 0.31), False),
    ):
        loaded = Explanation("payload", np.array([*share, 0.9, 0.9]))
        assert torques._is_excused(best, loaded) is is_excused
    best = Explanation("gravity", np.array([0.01, 0.02]))
    for factor, is_excused in ((np.exp(1.2), True), (np.exp(1.3), False)):
        loaded = Explanation("payload", (best.share + 1e-3) * factor - 1e-3)
        assert torques._is_excused(best, loaded) is is_excused


def test_torques_that_are_not_explained_are_reported_one_by_one_or_as_most_of_all():
    found = list(torques._unexplained(PROBE, np.array([0.3, 0.1, 0.4, 0.2]), "run.csv"))
    assert [(f.where, f.evidence) for f in found] == [
        ("run.csv: a", {"share": 0.3}), ("run.csv: c", {"share": 0.4}),
    ]  # fmt: skip
    assert "40 % of the variance of c's torque" in found[1].message
    (most,) = torques._unexplained(PROBE, np.array([0.3, 0.1, 0.4, 0.9]), "run.csv")
    assert (most.where, most.evidence) == ("run.csv", {"joints": 3.0, "share": 0.35})
    assert "the torques of 3 of 4 joints" in most.message


def test_the_torque_of_a_joint_at_rest_is_not_unexplained(monkeypatch):
    """Joints a, c and d rest: their friction has any value between its bounds."""
    q = np.linspace(0.0, 1.0, 5)[:, None] * [0.0005, 0.5, 0.0, 0.0009] + 2.0
    probe = SimpleNamespace(model=PROBE.model, motion=SimpleNamespace(q=q))
    share = Explanation("payload", np.array([0.9, 0.4, 0.8, 0.7]))
    monkeypatch.setattr(torques, "counterbalance", lambda probe, name: (probe, ()))
    monkeypatch.setattr(torques, "explanations", lambda probe: (STATED, share, [STATED]))
    monkeypatch.setattr(torques, "check_loads", lambda *x: ())
    monkeypatch.setattr(torques, "check_unmounted_parts", lambda *x: ())
    (found,) = torques.check_torques(probe, "run.csv")
    assert (found.where, found.evidence) == ("run.csv: b", {"share": 0.4})
    assert share.share[0] == 0.9
