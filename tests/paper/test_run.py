"""What a run of the paper's simulation writes: files, paper.json and, cell by cell, its page."""

import json
import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pages import chart, charts, number, tables

from robotid.paper import run as paper
from robotid.paper.run import run_paper
from robotid.paper.study import (
    CASES,
    MODELS,
    LoopSettings,
    PaperSettings,
    energy_drift,
    study_model,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS

FEW = PaperSettings(iterations=19, longest=1, runs=4, patience=2)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "energy_drift", lambda: energy_drift(duration=1.0))
        for module in ("run", "study"):
            patch.setattr(f"robotid.paper.{module}.LoopSettings", partial(LoopSettings, updates=20))
        return folder, run_paper(folder, settings=FEW)


def test_the_json_has_the_schema_of_the_design(written):
    folder, content = written
    found = json.loads((folder / "paper.json").read_text())
    assert found == content
    assert "clean" not in found, "it is that of the models"
    assert set(found["models"]) == {"printed", "corrected", "physical"}
    for name, model in found["models"].items():
        c = 4 if name == "physical" else 5
        assert len(model["P_true"]) == c
        assert np.shape(model["P_hat"]) == (20, c)
        assert len(model["relative_error"]) == 20
        assert len(model["prx_norm"]) == 19
        assert model["relative_error"][0] == 0.5
        np.testing.assert_allclose(np.array(model["P_hat"][0]) * 2, model["P_true"])
        assert model["NA"] is None  # PRX is not zero after so few iterations
    for erratum in found["errata"]:
        assert erratum["where"]
        assert erratum["max_torque_difference"] > 1.0
    for name in MODELS:
        runs = found["trajectories"][name]
        assert runs["runs"] == 4 == runs["converged"] + len(runs["failures"])
        assert runs["converged"] == len(runs["iterations"])
        assert all(failure["reason"] for failure in runs["failures"])
        for key in ("trajectories", "trajectories_on_program"):
            assert found[key][name]["most_iterations"] == 2 == min(FEW.patience, FEW.iterations)
        for case in ("on_program", "disturbed", "noisy", "noisy_dead_zone"):
            assert len(found[case][name]["relative_error"]) == 20
            assert found[case][name]["converged"] is False
            assert found[case][name]["reason"]


def test_the_page_is_whole_and_offline(written):
    html = (written[0] / "paper.html").read_text()
    names = {path.name for path in written[0].iterdir()}
    assert names == {"paper.json", "paper.html", "replay.html", "planar_2r.urdf"}
    assert html.count('<figure class="chart"') == 6 + 12 + 3 + 2 + 3 + 1
    assert "default-src 'none'" in html
    assert not re.search(r'(src|href)="(?!#)', html)
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    for said in ("Figure 3(a)", "Figure 4(b)", "Figure 5", "Errata", "NA (25)", "C122 = −h"):
        assert said in html


@pytest.fixture(scope="module")
def html(written):
    return (written[0] / "paper.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def shown(html):
    return tables(html)


def test_the_inertial_vector_is_in_the_papers_order(shown, written, html):
    folder, content = written
    assert "nearest to the initial values (half of the true ones) that have the four sums" in html
    vector = content["inertial_vector"]
    order = ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz", "m"]  # (9)
    assert vector["names"] == [f"{body}.{term}" for body in ("link_1", "link_2") for term in order]
    arm = RobotModel.from_urdf(folder / "planar_2r.urdf")
    urdf = [body.toDynamicParameters() for body in list(arm.pin_model.inertias)[1:]]
    back = [10 * i + order.index(term) for i in (0, 1) for term in INERTIAL_TERMS]
    true, found = (np.array(vector[key])[back] for key in ("true", "identified"))
    np.testing.assert_allclose(true, np.concatenate(urdf), atol=1e-14)
    rows = shown["Inertial vector (9)-(10), SI units"].rows
    assert [row[:2] for row in rows] == [
        [name, number(a)] for name, a in zip(vector["names"], vector["true"], strict=True)
    ]
    alone = [f"link_2.{term}" for term in ("Izz", "mcx", "mcy")]
    for (name, _, value, determined), b in zip(rows, vector["identified"], strict=True):
        assert value == number(b if name in alone else None, ".7g")
        is_in_sum = name in ("link_1.Izz", "link_2.m")
        words = "only link_1.Izz + link_2.m" if is_in_sum else "no"
        assert determined == ("yes" if name in alone else words)

    def four_sums(pi):
        """(27), from inertia about the joints: P of the physical arm, whose links are 1 m long."""
        (m2, x2, y2, *_), Izz1, Izz2 = pi[10:], pi[9], pi[19]
        return [Izz1 + m2, Izz2, x2, y2]

    np.testing.assert_allclose(four_sums(true), content["models"]["physical"]["P_true"])
    last = content["models"]["physical"]["P_hat"][-1]
    np.testing.assert_allclose(four_sums(found), last, rtol=1e-9)
    # what no torque shows stays at the first guess, half of the truth
    np.testing.assert_allclose(found[[4, 6, 14, 16]], true[[4, 6, 14, 16]] / 2)


def test_the_page_is_good_only_if_every_model_has_converged(written, shown):
    content = written[1]
    table = shown["Relative error |P̂ − P| / |P|"].rows
    for row, model in zip(table, content["models"].values(), strict=True):
        errors = [number(model["relative_error"][k], ".2g") for k in (0, 1, 10, -1)]
        assert row[1:5] == errors
    for last, status in (((5e-5, 5e-5, 9e-5), "good"), ((5e-5, 2e-4, 5e-5), "poor")):
        models = {
            name: {**model, "relative_error": [0.5, error]}
            for (name, model), error in zip(content["models"].items(), last, strict=True)
        }
        summary = paper._summary({**content, "models": models})
        assert f'class="verdict {status}"' in summary
        assert "trial</strong> with 19 iterations in place of 100 (--quick)" in summary
    settings = content["settings"] | {"iterations": 100}
    assert "trial" not in paper._summary({**content, "settings": settings})


def test_a_case_is_judged_at_its_end_by_a_tenth_and_by_the_mean_of_the_later_half(rng):
    P, count = np.array([3.0, -4.0]), len(CASES)
    errors = np.append(0.5 * 0.9 ** np.arange(20), 5e-5)
    estimates = P + rng.standard_normal((21, count, 2))
    history = SimpleNamespace(estimates=estimates, prx=np.ones((20, count)))
    study = SimpleNamespace(
        P=P, history=history, NA=None, dynamics=SimpleNamespace(names=("p1", "p2")),
        errors=lambda case="clean": errors,
    )  # fmt: skip
    assert paper._model(study)["converged"] is True
    for k, case in enumerate(CASES):
        found = paper._case(study, case)
        mean = estimates[-10:, k].mean(axis=0)  # of 21, five tenths of two each
        assert found["averaged"] == pytest.approx(np.hypot(*(mean - P)) / 5.0)
        assert found["last_tenth"] == pytest.approx((errors[-2] + errors[-1]) / 2)
        assert found["relative_error"] == errors.tolist()
        assert (found["converged"], found["reason"]) == (True, "converged")
        assert found["conditions"] == CASES[case].title
    errors = 2.0 * errors + 1e-6
    said = {case: paper._case(study, case) for case in ("on_program", "noisy")}
    assert not any(found["converged"] for found in (*said.values(), paper._model(study)))
    assert said["on_program"]["reason"].startswith("slow: every run follows the same curve")
    assert said["noisy"]["reason"].startswith("A disturbance v is part of the deviation")


@pytest.fixture(scope="module")
def studies():
    return [study_model(name, PaperSettings(iterations=3, longest=1)) for name in MODELS]


def close(drawn, wanted):
    """Assert that a series is the data, to what 16 bits tell apart."""
    np.testing.assert_allclose(drawn, wanted, atol=2e-5 * max(np.ptp(wanted), 1e-9))


def test_figure_4_is_the_control_of_its_joint_by_iterations(studies):
    html = paper._control_figures(studies)
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
    drawn = charts(paper._program_figures())
    t = np.linspace(0.0, 1.0, 201)  # over the duration of 2 s
    shape = 10 * t**3 - 15 * t**4 + 6 * t**5  # (28)
    rate, curvature = (30 * t**2 * (1 - t) ** 2 / 2, 60 * t * (1 - t) * (1 - 2 * t) / 4)
    parts = [amplitude * x for amplitude in (1.0, 1.5) for x in (shape, rate, curvature)]
    labels = [what["series"][0]["label"].split()[0] for what in drawn]
    assert labels == 2 * ["position", "velocity", "acceleration"]
    for what, wanted in zip(drawn, parts, strict=True):
        close(what["x"], 2.0 * t)
        close(what["series"][0]["y"], wanted)


def test_figure_5_is_each_parameter_beside_its_true_value(studies):
    html = paper._estimate_figures(studies)
    for study in studies:
        series = chart(html, f"Figure 5. {study.name}")["series"]
        count = len(study.dynamics.names)
        for i, name in enumerate(study.dynamics.names):
            assert [series[i]["label"], series[count + i]["label"]] == [name, f"{name}, true"]
            assert series[i]["tone"] == series[count + i]["tone"] == f"tone-{name[1:]}"
            close(series[i]["y"], study.history.estimates[:, 0, i])
            close(series[count + i]["y"], np.full(4, study.P[i]))


def test_errors_are_those_of_their_model_and_case(studies):
    html = paper._convergence_figures(studies)
    prx, errors = (chart(html, title)["series"] for title in ("Largest entry", "Parameter error"))
    for k, study in enumerate(studies):
        known = np.isfinite(prx[k]["y"])
        assert not known[0]  # before the first iteration there is none
        np.testing.assert_allclose(prx[k]["y"][known], study.history.prx[:, 0], rtol=1e-3)
        np.testing.assert_allclose(errors[k]["y"], study.errors(), rtol=1e-3)
        np.testing.assert_allclose(errors[3 + k]["y"], study.errors("on_program"), rtol=1e-3)
    html = paper._disturbed_figures(studies)
    for study in studies:
        series = chart(html, study.name)["series"]
        for line, case in zip(
            series, ("clean", "disturbed", "noisy", "noisy_dead_zone"), strict=True
        ):
            np.testing.assert_allclose(line["y"], study.errors(case), rtol=1e-3)
