"""The page of the paper's simulation: what each line of its figures holds."""

import numpy as np
import pytest
from helpers.pages import chart, charts

from robotid.paper import run as page
from robotid.paper.study import MODELS, PaperSettings, study_model


@pytest.fixture(scope="module")
def studies():
    return [study_model(name, PaperSettings(iterations=3, longest=1)) for name in MODELS]


def close(drawn, wanted):
    """Assert that a series is the data, to what 16 bits tell apart."""
    np.testing.assert_allclose(drawn, wanted, atol=2e-5 * max(np.ptp(wanted), 1e-9))


def test_figure_4_is_the_control_of_its_joint_by_iterations(studies):
    html = page._control_figures(studies)
    for study in studies:
        for joint in (0, 1):
            u = study.history.torques[:, :, joint]
            title = f"Figure 4({'ab'[joint]}). {study.name}: control u{joint + 1} (21)"
            upper, lower = [what for what in charts(html) if what["title"].startswith(title)]
            close(upper["x"], 0.02 * np.arange(100))
            assert [s["label"] for s in upper["series"][:2]] == ["iteration 1", "iteration 2"]
            for k in (0, 1):
                close(upper["series"][k]["y"], u[k])
                close(lower["series"][k]["y"], u[k] - u[-1])
            _, program = study.program_control(101)
            close(upper["series"][-1]["y"], program[:-1, joint])


def test_figure_3_is_the_program_motion_of_its_joint():
    drawn = charts(page._program_figures())
    t = np.linspace(0.0, 1.0, 201)  # over the duration of 2 s
    shape = 10 * t**3 - 15 * t**4 + 6 * t**5  # (28)
    rate, curvature = (30 * t**2 * (1 - t) ** 2 / 2, 60 * t * (1 - t) * (1 - 2 * t) / 4)
    parts = [amplitude * x for amplitude in (1.0, 1.5) for x in (shape, rate, curvature)]
    for what, wanted in zip(drawn, parts, strict=True):
        close(what["x"], 2.0 * t)
        close(what["series"][0]["y"], wanted)


def test_figure_5_is_each_parameter_beside_its_true_value(studies):
    html = page._estimate_figures(studies)
    for study in studies:
        series = chart(html, f"Figure 5. {study.name}")["series"]
        count = len(study.dynamics.names)
        for i, name in enumerate(study.dynamics.names):
            assert [series[i]["label"], series[count + i]["label"]] == [name, f"{name}, true"]
            close(series[i]["y"], study.history.estimates[:, 0, i])
            close(series[count + i]["y"], np.full(4, study.P[i]))


def test_errors_are_those_of_their_model_and_case(studies):
    html = page._convergence_figures(studies)
    prx, errors = (chart(html, title)["series"] for title in ("Largest entry", "Parameter error"))
    for k, study in enumerate(studies):
        known = np.isfinite(prx[k]["y"])
        assert not known[0]  # before the first iteration there is none
        np.testing.assert_allclose(prx[k]["y"][known], study.history.prx[:, 0], rtol=1e-3)
        np.testing.assert_allclose(errors[k]["y"], study.errors(), rtol=1e-3)
        np.testing.assert_allclose(errors[3 + k]["y"], study.errors("on_program"), rtol=1e-3)
    html = page._disturbed_figures(studies)
    for study in studies:
        series = chart(html, study.name)["series"]
        for line, case in zip(
            series, ("clean", "disturbed", "noisy", "noisy_dead_zone"), strict=True
        ):
            np.testing.assert_allclose(line["y"], study.errors(case), rtol=1e-3)
