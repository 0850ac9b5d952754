"""The paper's figures: what each line holds."""

import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper.errata import EnergyDrift, energy_drift
from robotid.paper.paper_figures import _energy_figure, _trajectories_figure, paper_figures
from robotid.paper.study import MODELS, PaperSettings, paper_arm, random_runs, study_model
from robotid.paper.svg import INK, svg_element, svg_file


@pytest.fixture(scope="module")
def studies():
    return [study_model(name, PaperSettings(iterations=3, longest=1)) for name in MODELS]


@pytest.fixture(scope="module")
def figures(studies):
    rng = np.random.default_rng(0)
    runs = {name: random_runs(*paper_arm(name), 2, 1, rng) for name in MODELS}
    made = paper_figures(studies, runs, energy_drift(duration=0.1))
    return {name: figure for name, (_, figure) in made.items()}


def test_figure_3_is_the_program_of_its_joint(figures):
    t = np.linspace(0.0, 2.0, 201)
    parts = ProgramMotion(np.array([1.0, 1.5]), 2.0).evaluate(t)
    for joint in (0, 1):
        for axes, part in zip(figures[f"figure_3{'ab'[joint]}"].axes, parts, strict=True):
            wanted = np.column_stack([t, part[:, joint]])
            np.testing.assert_allclose(axes.lines[0].get_xydata(), wanted)


@pytest.mark.parametrize("joint", [0, 1])
def test_figure_4_is_the_control_of_its_joint_by_iterations(studies, figures, joint):
    axes = figures[f"figure_4{'ab'[joint]}"].axes
    for upper, lower, study in zip(axes[:3], axes[3:], studies, strict=True):
        u = study.history.torques[:, :, 0, joint]
        assert upper.get_title() == study.name
        for k, iteration in enumerate((1, 2)):
            np.testing.assert_array_equal(upper.lines[k].get_ydata(), u[iteration - 1])
            np.testing.assert_array_equal(lower.lines[k].get_ydata(), u[iteration - 1] - u[-1])
            assert upper.lines[k].get_label() == f"iteration {iteration}"
            for axes_of in (upper, lower):  # a hundred updates in two seconds, the first at 0
                times = axes_of.lines[k].get_xdata()
                np.testing.assert_allclose(times, 0.02 * np.arange(100), atol=1e-12)
        program = study.program_control(201)[1][:, joint]
        np.testing.assert_array_equal(upper.lines[-1].get_ydata(), program)


def test_figure_5_is_each_parameter_beside_its_true_value(studies, figures):
    for axes, study in zip(figures["figure_5"].axes, studies, strict=True):
        for i, name in enumerate(study.dynamics.names):
            estimate, true = axes.lines[2 * i : 2 * i + 2]
            assert estimate.get_label() == name
            np.testing.assert_array_equal(estimate.get_ydata(), study.history.estimates[:, 0, i])
            np.testing.assert_array_equal(true.get_ydata(), [study.P[i]] * 2)


def test_convergence_shows_prx_and_both_errors(studies, figures):
    left, right = figures["convergence"].axes
    for k, study in enumerate(studies):
        np.testing.assert_array_equal(left.lines[k].get_ydata(), study.history.prx[:, 0])
        np.testing.assert_array_equal(right.lines[2 * k].get_ydata(), study.errors())
        on_program = right.lines[2 * k + 1].get_ydata()
        np.testing.assert_array_equal(on_program, study.errors("on_program"))


def test_disturbed_errors_are_those_of_their_case(studies, figures):
    cases = ("clean", "disturbed", "noisy", "noisy_dead_zone")
    for axes, study in zip(figures["disturbance"].axes, studies, strict=True):
        for line, case in zip(axes.lines, cases, strict=True):
            np.testing.assert_array_equal(line.get_ydata(), study.errors(case))


def test_iterations_are_counted_and_energies_are_in_percent():
    runs = {
        "one": SimpleNamespace(
            errors=np.ones((61, 7)), guess=np.ones((7, 5)), iterations=[3, 4, 59]
        ),
        "other": SimpleNamespace(errors=np.ones((91, 5)), guess=np.ones((5, 5)), iterations=[7, 8]),
    }
    t = np.linspace(0.0, 1.3, 5)
    drift = EnergyDrift(t, {"one": 0.03 * t, "other": -0.2 * t**2})
    counts = {1: 1, 2: 1, 29: 1}, {2: 2}
    titles = ("one: 3 of 7 converged", "other: 2 of 5 converged")
    for axes, most, title, count in zip(
        _trajectories_figure(runs).axes, (60, 90), titles, counts, strict=True
    ):
        bars = axes.patches
        edges = [bar.get_x() for bar in bars] + [bars[-1].get_x() + bars[-1].get_width()]
        np.testing.assert_allclose(edges, np.linspace(0, most, 31), atol=1e-9)
        heights = {k: bar.get_height() for k, bar in enumerate(bars) if bar.get_height()}
        assert heights == count
        assert axes.get_title() == title
        assert axes.title.get_fontsize() == axes.xaxis.label.get_fontsize() == 8.5
    (axes,) = _energy_figure(drift).axes
    for line, gained in zip(axes.lines, (3.0 * t, -20.0 * t**2), strict=True):
        np.testing.assert_allclose(line.get_xydata(), np.column_stack([t, gained]))
    assert [line.get_label() for line in axes.lines] == ["one", "other"]
    frame = axes.spines["left"].get_linewidth()
    assert all(frame <= 0.5 * line.get_linewidth() for line in axes.lines)
    assert axes.figure.get_size_inches().tolist() == [9.3, 2.8]


def test_an_svg_element_is_transparent_and_has_ids_of_its_own():
    drift = EnergyDrift(np.linspace(0.0, 1.0, 5), {"one": np.linspace(0.0, 0.1, 5)})
    file = svg_file(_energy_figure(drift))
    shown = svg_element(file, "one < two", "key")
    root = ElementTree.fromstring(shown)
    assert (root.tag, root.get("viewBox")) == ("svg", f"0 0 {9.3 * 72:g} {2.8 * 72:g}")
    assert root.get("width") is root.get("height") is None
    assert root.findtext("title") == "one < two"
    ids = {at.get("id") for at in root.iter() if at.get("id")}
    assert root.get("aria-labelledby") == "key-title"
    assert all(name.startswith("key-") for name in ids)
    used = re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', shown)
    assert used
    assert {a or b for a, b in used} <= ids
    # text and axes have the colour of the page's text, and nothing is behind them
    assert "currentColor" in shown
    assert not re.search(f"{INK}|#ffffff|xmlns|metadata", shown)
    # in the file, the white background is behind everything
    first, *others = re.findall(r'<path d="[^"]*?" style="fill: [^"]*"', file.replace("\n", ""))
    assert first == '<path d="M 0 201.6 L 669.6 201.6 L 669.6 0 L 0 0 z" style="fill: #ffffff"'
    assert not any("#ffffff" in other for other in others)


def test_axes_have_their_unit_lines_their_name_and_figures_their_size(figures):
    error, last, program = "|P̂ − P| / |P|", "minus the last iteration [N m]", "program control"
    third = ["position [rad]", "velocity [rad/s]", "acceleration [rad/s²]"]
    noisy = ["clean", "torque ±10 %", "noise", "noise, ε₂ = 1"]
    prx = ["largest entry of PRX [N m/s²]", f"{error}; thin: start on program"]
    estimates = ["estimate [kg m²]; dotted: true", "", ""]
    fourth = ["torque u2 [N m]", "", "", last, "", ""]
    for name, xlabel, ylabels, height, names in (
        ("figure_3b", "time [s]", third, 2.4, None),
        ("figure_4b", "time [s]", fourth, 4.4, ["iteration 1", "iteration 2", program]),
        ("figure_5", "iteration", estimates, 3.2, ["p1", "p2", "p3", "p4", "p5"]),
        ("convergence", "iteration", prx, 3.2, MODELS),
        ("disturbance", "iteration", [error, "", ""], 3.2, noisy),
        ("trajectories", "iterations to 10⁻³", ["random motions", "", ""], 2.8, None),
        ("energy", "time [s]", ["energy gained [%]"], 2.8, MODELS),
    ):
        figure, axes = figures[name], figures[name].axes
        assert [each.get_ylabel() for each in axes] == ylabels
        assert {each.get_xlabel() for each in axes[-3:]} == {xlabel}
        assert figure.get_size_inches().tolist() == [9.3, height]
        legends = [[text.get_text() for text in each.get_texts()] for each in figure.legends]
        assert legends == ([list(names)] if names else [])
    for axes in (*figures["convergence"].axes, *figures["disturbance"].axes):
        assert axes.yaxis.get_major_formatter()(1e-3, 0) == "10⁻³"
        assert axes.yaxis.get_minor_formatter()(3e-3, 0) == ""
