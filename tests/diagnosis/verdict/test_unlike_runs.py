"""Torques of validation logs that are a multiple of their prediction."""

from types import SimpleNamespace

import numpy as np
import pytest

from robotid.base.findings import Finding
from robotid.diagnosis.verdict import fit_findings
from robotid.diagnosis.verdict.evidence import Predictions
from robotid.diagnosis.verdict.fit_findings import rescaled_findings
from robotid.output.report.next_steps import sentence_of

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
    monkeypatch.setattr(fit_findings, "friction_shares", lambda fit: shares)
    model = SimpleNamespace(joints=JOINTS, row_names=JOINTS, constraints=constraints)
    fit = SimpleNamespace(model=model, validation=validation)
    return list(rescaled_findings(fit, loaded))


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
