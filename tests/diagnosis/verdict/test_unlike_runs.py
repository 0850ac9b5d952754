"""Torques of validation logs that are a multiple of their prediction."""

from types import SimpleNamespace

import pytest

from robotid.base.findings import Finding
from robotid.diagnosis.verdict.verdict import Predictions
from robotid.output.report.next_steps import sentence_of

JOINTS = ("a", "b", "c")


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
