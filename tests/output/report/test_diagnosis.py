"""What the report's appendix says in figures beside its charts."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pages import charts, tables

from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.verdict.scale_check import ScaleCheck
from robotid.output.pages.charts import Chart, Series
from robotid.output.report.errors import _notes
from robotid.output.report.information_section import information
from robotid.output.report.pictures import residual_charts
from robotid.output.report.plot_sections import (
    _choice,
    _correlation_map,
    _correlations,
    _residual_figures,
    friction_section,
    information_section,
)
from robotid.output.report.torque_section import _chain, _facts, _intro, _totals


def test_shares_of_the_data_are_those_of_all_and_of_the_weakest(identified):
    share = information(identified).data_share
    said = information_section(identified)
    assert (
        f"base parameters by {np.mean(np.round(100 * share)):.0f} % on average and the weakest by "
        f"{round(100 * share.min())} %,"
    ) in said
    assert share.min() < 0.9 * share.mean()


def test_the_map_of_correlations_has_squares_of_11_px_below_the_diagonal():
    """The longest name has 5 letters: 6 px each, with 4 for its number, and 12 px."""
    C = np.array([[1.0, 0.9, 0.9], [0.5, 1.0, 0.9], [-1.0, 0.02, 1.0]])
    html = _correlation_map(C, ["a", "b", "<long"], title="t", key="k")
    assert 'viewBox="0 0 103 55"' in html
    assert re.findall(r' d="(.*?)"', html) == ["M66 22h10v10h-10z", "M66 11h10v10h-10z"]
    labels = re.findall(r'<text x="(\d+)" y="(\d+)"[^>]*>(.*?)</text>', html)
    assert labels[:2] == [("60", "9", "a 1"), ("68", "9", "1")]
    assert labels[4:] == [("60", "31", "&lt;long 3"), ("90", "31", "3")]


def test_friction_of_more_joints_than_fit_is_folded_but_for_the_worst(identified, monkeypatch):
    joints = identified.model.row_names
    assert "<details" not in friction_section(identified, joints)
    monkeypatch.setattr("robotid.output.report.plot_sections._CURVES", 2)
    shown, folded = friction_section(identified, [joints[4], joints[1], *joints]).split("<details")
    titles = [[what["title"].split()[2] for what in charts(html)] for html in (shown, folded)]
    assert titles == [[joints[1], joints[4]], [joints[0], *joints[2:4], joints[5]]]
    assert "4 more joints with smaller errors" in folded


@pytest.mark.parametrize("row", [0, 3, 5])
def test_a_correlation_falls_where_its_chart_first_does(identified, row):
    html = _residual_figures(identified, row)
    _, correlation = charts(html)
    (series,) = [s for s in correlation["series"][:1]]
    first = correlation["x"][np.flatnonzero(np.abs(series["y"]) < 0.2)[0]]
    said = re.search(r"correlation falls below 0.2 after ([\d.e-]+) s", html)[1]
    assert float(said) == pytest.approx(first, rel=0.06)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([1.0, 0.4, -0.6, -0.3, 0.19, 0.5], "falls below 0.2 after 1 s"),
        ([1.0, -0.19, 0.6], "falls below 0.2 after 0.25 s"),
        ([1.0, -0.9, 0.8], "does not decay"),
    ],
)
def test_a_correlation_that_turns_negative_has_not_fallen(identified, monkeypatch, values, said):
    x = 0.25 * np.arange(len(values))
    spectrum, _ = residual_charts(identified, identified.validation[0], 1)
    series = (Series("residual", np.array(values), "residual"),)
    correlation = Chart("autocorrelation", x, series, "lag [s]", "correlation")
    monkeypatch.setattr(
        "robotid.output.report.plot_sections.residual_charts", lambda *_: (spectrum, correlation)
    )
    name = identified.model.row_names[1]
    assert f"<strong>{name}</strong>: correlation {said}<" in _residual_figures(identified, 1)


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
    html = _choice(None, drive)
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
    assert "<summary>two: no additional term</summary>" in _choice(None, none)


def test_all_strong_correlations_are_counted_and_the_strongest_listed():
    size = 8
    r = np.eye(size)
    pairs = [(i, j) for i in range(size) for j in range(i)]
    for k, (i, j) in enumerate(pairs):
        r[i, j] = r[j, i] = (-1) ** k * (0.995 - 0.01 * k)
    names = [f"p{k}" for k in range(size)]
    html = _correlations(SimpleNamespace(correlation=r), names)
    strong = sum(0.995 - 0.01 * k >= 0.8 for k in range(len(pairs)))
    assert strong == 20
    table = tables(html)["The strongest of 20 correlations of 0.8 and more"]
    assert table.rows == [
        [names[i], names[j], f"{r[i, j]:.3f}".replace("-", "−")] for i, j in pairs[:15]
    ]
    assert "Correlation of the errors of 8 base parameters; 20 pairs above 0.8" in html
    assert "full colour at ±1.</figcaption><svg" in html
    weak = _correlations(SimpleNamespace(correlation=0.5 * r), names)
    assert "No two errors are correlated by 0.8 or more." in weak


def test_totals_beside_a_verdict_are_in_percent_and_times():
    scale_check = SimpleNamespace(
        friction={"one": 0.256, "two": 0.044}, masses=(10.126, 12.374, 0.1),
        gravity={"one": 1.049, "two": 0.951},
    )  # fmt: skip
    assert _totals(SimpleNamespace(scale_check=scale_check)) == (
        "Total mass 10.13 -> 12.37 kg. Gravity torque relative to the URDF: one 1.05, two 0.95. "
        "Friction relative to the torque: one 26 %, two 4 %."
    )


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


@pytest.mark.parametrize(
    ("is_determined", "beside"), [(True, ""), (False, ", not determined by torque alone")]
)
def test_a_total_mass_that_torque_leaves_open_says_so(is_determined, beside):
    check = ScaleCheck(masses=(20.0, 23.0, 0.0), is_total_determined=is_determined)
    found = SimpleNamespace(
        scale_check=check,
        determination=SimpleNamespace(rank=4),
        base=np.zeros(5),
        wls=SimpleNamespace(condition=70.0),
    )
    facts = _facts(found)
    assert facts["Total mass"] == f"<strong>20.00 → 23.00 kg</strong> (+15 %){beside}"
    assert facts["Base parameters determined"].startswith("<strong>4 of 5</strong>")
    found.scale_check = replace(check, assumed=2)
    assert "<strong>20.00 assumed → 23.00 kg</strong>" + beside == _facts(found)["Total mass"]


def test_charts_of_a_long_recording_state_how_much_of_it_is_drawn():
    def run(name, count, whole):
        recording = SimpleNamespace(
            name=name, is_partial=count < whole, extent=SimpleNamespace(smooth=whole),
            trajectory=SimpleNamespace(t=np.zeros(count)),
        )  # fmt: skip
        return SimpleNamespace(recording=recording)

    shown, left = [run("<a>", 300, 4000), run("b", 500, 500)], [run("c", 5, 5), run("d", 6, 6)]
    html = _intro(SimpleNamespace(validation=(), between=None), shown, left)
    assert "&lt;a&gt; is long: 300 of its 4000 samples are drawn" in html
    assert "b is long" not in html
    assert "Not drawn, to limit the file size: c, d." in html
    assert "There is no validation log. The charts show the fitted logs." in html
    other = _intro(SimpleNamespace(validation=shown, between=None), shown[1:], [])
    assert "no validation log" not in other
    assert "Not drawn" not in other


def test_the_processing_of_signals_is_stated_in_words():
    assert _chain(SignalSettings(cutoff=7.5, order=4, rate=250.0, velocity="measured")) == (
        "zero-phase Butterworth low-pass, cut-off 7.5 Hz, order 4 run forward and backward, grid "
        "of 250 Hz, velocity measured"
    )
    assert _chain(SignalSettings(cutoff=None, velocity="differentiated")) == (
        "no filter, samples as recorded, velocity differentiated"
    )
