"""What the report's appendix says in figures beside its charts."""

from types import SimpleNamespace

import pytest
from helpers.pages import tables

from robotid.output.report.errors import _notes
from robotid.output.report.torque_report import (
    _choice,
)


def test_what_was_tried_of_a_joint_stands_with_error_chance_and_shape():
    tried = [
        SimpleNamespace(families=(), held_out_error_pct=4.5678, p_value=None, is_selected=False),
        SimpleNamespace(
            families=("tanh",), held_out_error_pct=3.4, p_value=2e-4, is_selected=False
        ),
        SimpleNamespace(
            families=("tanh", "load"), held_out_error_pct=2.25, p_value=0.031, is_selected=True
        ),
    ]
    shapes = [
        SimpleNamespace(name="speed", value=0.12345, std_error=0.0067, unit="rad/s",
                        is_at_bound=False),
        SimpleNamespace(name="order", value=2.0, std_error=0.5, unit="", is_at_bound=True),
    ]  # fmt: skip
    drive = SimpleNamespace(joint="one", families=("tanh", "load"), shapes=shapes, tried=tried)
    html = _choice(drive)
    said = "one: tanh + load; speed = 0.123 ± 0.0067 rad/s, order = 2 ± 0.5  (at its bound)"
    ((caption, table),) = tables(html).items()
    assert caption == said
    assert f"<summary>{said}</summary>" in html
    assert table.headers == ["terms", "held-out error %", "p-value", ""]
    assert table.rows == [
        ["viscous and Coulomb", "4.57", "", ""], ["tanh", "3.40", "2.0e−04", ""],
        ["tanh + load", "2.25", "3.1e−02", "selected"],
    ]  # fmt: skip
    none = SimpleNamespace(joint="two", families=(), shapes=(), tried=tried[:1])
    assert "<summary>two: no additional term</summary>" in _choice(none)


@pytest.mark.parametrize(
    ("error", "urdf", "better", "wanted"),
    [
        (5.0, 6.0, True, []), (6.0, 5.0, True, ["worse than the URDF"]),
        (5.0, 6.0, False, ["worse than a constant"]), (None, 5.0, True, []), (5.0, None, True, []),
        (9.0, 5.0, False, ["worse than a constant", "worse than the URDF"]),
    ],
)  # fmt: skip
def test_a_joint_is_remarked_where_a_simpler_prediction_is_better(error, urdf, better, wanted):
    own = {"better_than_constant": better, "relative_error_pct": error}
    own["urdf_relative_error_pct"] = urdf
    assert _notes(own) == wanted
