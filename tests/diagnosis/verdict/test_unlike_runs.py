"""Torques of validation logs that are a multiple of their prediction."""

from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.findings import Finding
from robotid.diagnosis.verdict import unlike_runs
from robotid.diagnosis.verdict.evidence import Predictions
from robotid.diagnosis.verdict.unlike_runs import rescaled_findings
from robotid.diagnosis.verdict.verdict import warnings_of
from robotid.output.report.steps import sentence_of

JOINTS = ("a", "b", "c")


def evaluation(path, tau, own, mask, *, is_refitted=False):
    error = 100 * np.sqrt(np.sum((tau - own) ** 2 * mask, 0) / np.sum(tau**2 * mask, 0))
    per_joint = {
        j: SimpleNamespace(relative_error_pct=x, rmse=1.0)
        for j, x in zip(JOINTS, error, strict=True)
    }
    return SimpleNamespace(
        recording=SimpleNamespace(
            trajectory=SimpleNamespace(tau=tau),
            mask=mask,
            is_partial=False,
            log=SimpleNamespace(path=path),
        ),
        torques={"estimate": own},
        metrics={"estimate": SimpleNamespace(per_joint=per_joint)},
        is_refitted=is_refitted,
    )


def said(validation, monkeypatch, *, constraints=(), loaded=()):
    shares = dict(zip(JOINTS, (0.2, 0.9, 0.2), strict=True))
    monkeypatch.setattr(unlike_runs, "friction_shares", lambda fit: shares)
    model = SimpleNamespace(joints=JOINTS, row_names=JOINTS, constraints=constraints)
    fit = SimpleNamespace(model=model, validation=validation)
    return list(rescaled_findings(fit, loaded))


def test_a_gain_that_differs_between_logs_is_named_with_its_factor(rng, monkeypatch):
    """Joint a 1.25 times, b 0.7 times, c wrong by as much in another way; one log is alike."""
    own = rng.standard_normal((2, 400, 3))
    tau = own[0] * [1.25, 0.7, 1.0] + [0.0, 0.0, 0.25]
    mask = np.ones((400, 3), dtype=bool)
    mask[350:] = False
    tau[350:] = 50.0  # not used
    logs = [
        evaluation("/x/alike.csv", own[1] + 0.01 * rng.standard_normal((400, 3)), own[1], mask),
        evaluation("/x/kept.csv", tau, own[0], mask),
    ]
    first, second = said(logs, monkeypatch)
    assert (first.code, first.severity) == ("gain_change", "warning")
    assert (first.where, second.where) == ("kept.csv: a", "kept.csv: b")
    assert first.evidence == pytest.approx({"factor": 1.25, "share_pct": 100.0})
    assert second.evidence == pytest.approx({"factor": 0.7, "share_pct": 100.0})
    assert "the torque of a is 1.25 times the predicted one" in first.message
    assert "its gain differs" in first.message
    assert "its gain, or its friction (90 % of it), differs" in second.message
    warnings = warnings_of([first, second], JOINTS)
    assert [w.joint for w in warnings] == ["a", "b"]
    assert "is 0.70 times the predicted one" in warnings[1].message
    assert said(logs, monkeypatch, loaded={"kept.csv"}) == []
    assert said(logs, monkeypatch, constraints=("foot",)) == []
    logs[1].recording.is_partial = True  # the whole log may have another factor
    assert said(logs, monkeypatch) == []
    logs[1].recording.is_partial, logs[1].is_refitted = False, True
    assert said(logs, monkeypatch) == []


def test_the_share_of_the_squared_error_is_that_of_the_best_factor(rng, monkeypatch):
    own, noise = rng.standard_normal((2, 4000, 3))
    tau = 1.3 * own + 0.1 * noise
    (a, *_) = said([evaluation("k.csv", tau, own, own < np.inf)], monkeypatch)
    factor = np.polyfit(own[:, 0], tau[:, 0], 1)[0]  # with an offset, which is nearly 0
    assert a.evidence["factor"] == pytest.approx(factor, abs=1e-3)
    left = 0.1**2 / (0.3**2 + 0.1**2)
    assert a.evidence["share_pct"] == pytest.approx(100 * (1 - left), abs=1.0)
    assert (
        said([evaluation("k.csv", 1.3 * own + 0.3 * noise, own, own < np.inf)], monkeypatch) == []
    )


def test_bodies_are_not_blamed_for_another_gain():
    beaten = SimpleNamespace(relative_error_pct=20.0, baselines={"urdf_with_drives": 12.0})
    metrics = SimpleNamespace(per_joint={"a": beaten, "b": beaten})
    predictions = Predictions(SimpleNamespace(per_joint={}), {"k.csv": metrics}, JOINTS)
    (reason,) = predictions.better_by_urdf({"a"})
    assert "predicts b better" in reason
    assert predictions.better_by_urdf({"a", "b"}) == []


@pytest.mark.parametrize(
    ("message", "wanted"),
    [
        ("first_2.csv: a load", "first_2.csv: a load"),
        ("a.csv, b.csv: it", "a.csv, b.csv: it"),
        ("the torque", "The torque"),
    ],
)
def test_the_name_of_a_file_keeps_its_letters(message, wanted):
    assert sentence_of(Finding("x", "warning", "y", message).message) == wanted
