"""What a run of the paper's simulation writes: files, paper.json and, cell by cell, its page."""

import json
import math
import re
import xml.etree.ElementTree as ET
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.pages import number, tables
from matplotlib.figure import Figure

from robotid.cli import main
from robotid.paper import paper_page as page
from robotid.paper import run as paper
from robotid.paper import study
from robotid.paper.errata import EnergyDrift, energy_drift
from robotid.paper.procedure import LoopSettings
from robotid.paper.run import run_paper
from robotid.paper.study import CASES, MODELS, PROGRAM, PaperSettings, paper_arm
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS

FIGURES = ["figure_3a", "figure_3b", "figure_4a", "figure_4b", "figure_5", "convergence"]
FIGURES += ["disturbance", "trajectories", "energy"]
FEW = PaperSettings(iterations=19, longest=1, runs=4, patience=2)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "energy_drift", lambda: energy_drift(duration=1.0))
        for module in (paper, study):
            patch.setattr(module, "LoopSettings", partial(LoopSettings, updates=20))
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


def test_every_number_is_finite(written):
    def numbers(value):
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list):
            return [x for part in value for x in numbers(part)]
        return [value] if isinstance(value, float) else []

    assert len(numbers(written[1])) > 100
    assert all(math.isfinite(x) for x in numbers(written[1]))


def test_the_figures_are_there_as_png_and_svg_and_nothing_else(written):
    folder, _ = written
    wanted = {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    others = {"paper.json", "paper.html", "replay.html", "planar_2r.urdf"}
    assert {path.name for path in folder.iterdir()} == wanted | others
    for name in FIGURES:
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert ET.parse(folder / f"{name}.svg").getroot().tag.endswith("svg")


def test_the_page_is_whole_and_offline(written):
    html = (written[0] / "paper.html").read_text()
    assert html.count("<figure ") == html.count("<svg") == len(FIGURES)
    assert "mathdefault" not in html
    # the policy lets nothing in; no address but those of namespaces may stand there
    assert "default-src 'none'" in html
    assert not re.search(r'(src|href)="(?!#)', html)
    ids = re.findall(r'\bid="([^"]*)"', html)
    assert len(ids) == len(set(ids))
    for said in ("Figure 3(a)", "Figure 4(b)", "Figure 5", "Errata", "NA (25)", "C122 = −h"):
        assert said in html


def test_a_failure_leaves_no_half_written_file(tmp_path, monkeypatch):
    def fail(content, figures):
        raise OSError("disk full")

    monkeypatch.setattr(paper, "paper_page", fail)
    monkeypatch.setattr(paper, "energy_drift", lambda: energy_drift(duration=0.1))
    monkeypatch.setattr(study, "LoopSettings", partial(LoopSettings, updates=20))
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    monkeypatch.setattr(paper, "paper_figures", lambda *_: {"figure_3a": ("3", figure)})
    with pytest.raises(OSError, match="disk full"):
        run_paper(tmp_path, settings=PaperSettings(iterations=1, longest=1, runs=1, patience=1))
    assert list(tmp_path.iterdir()) == []
    box = axes.get_tightbbox().transformed(figure.transFigure.inverted())
    sides = [box.x0, box.y0, box.x1, box.y1]
    np.testing.assert_allclose(sides, [0, 0, 1, 1], atol=0.02, err_msg="not laid out")


def test_the_command_prints_what_was_reached(tmp_path, capsys, monkeypatch, written):
    asked = {}

    def remember(folder, **options):
        asked.update(options, folder=folder)
        return written[1]

    monkeypatch.setattr(paper, "run_paper", remember)
    assert main(["paper", "--quick", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert err == ""  # progress is for terminals
    assert "printed" in out
    assert asked["folder"] == str(tmp_path)
    assert asked["settings"].runs < 100 <= PaperSettings().runs
    assert main(["paper", "--json", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out) == written[1]
    assert asked["settings"] is None


# --- the page ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(written):
    return written[0]


@pytest.fixture(scope="module")
def content(written):
    return written[1]


@pytest.fixture(scope="module")
def html(folder):
    return (folder / "paper.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def shown(html):
    return tables(html)


def test_errors_over_the_iterations(shown, content):
    table = shown["Relative error |P̂ − P| / |P|"]
    wanted = []
    for name in MODELS:
        model = content["models"][name]
        errors = [model["relative_error"][k] for k in (0, 1, 10, -1)]
        errors.append(content["on_program"][name]["relative_error"][-1])
        cells = [number(error, ".2g") for error in errors]
        wanted.append(
            [name, *cells, number(model["NA"], "d"), number(content["one_shot"][name], ".2g")]
        )
    assert table.rows == wanted
    assert table.column("at the end") != table.column("start on program")


def test_parameters_at_the_end(shown, content):
    for name in MODELS:
        model = content["models"][name]
        last = model["P_hat"][-1]
        assert shown[f"{name}: parameters at the end [kg m²]"].rows == [
            [p, number(true), number(found, ".7g"), number(found - true, ".1e")]
            for p, true, found in zip(model["names"], model["P_true"], last, strict=True)
        ]


def test_the_inertial_vector_is_in_the_papers_order(shown, content, folder, html):
    assert "nearest to the initial values (half of the true ones) that have the four sums" in html
    vector = content["inertial_vector"]
    order = ["Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz", "m"]  # (9)
    assert vector["names"] == [f"{body}.{term}" for body in ("link_1", "link_2") for term in order]
    arm = RobotModel.from_urdf(folder / "planar_2r.urdf")
    urdf = [body.toDynamicParameters() for body in list(arm.pin_model.inertias)[1:]]
    back = [10 * i + order.index(term) for i in (0, 1) for term in INERTIAL_TERMS]
    true, found = (np.array(vector[key])[back] for key in ("true", "identified"))
    np.testing.assert_allclose(true, np.concatenate(urdf), atol=1e-14)
    assert shown["Inertial vector (9)-(10), SI units"].rows == [
        [name, number(a), number(b, ".7g")]
        for name, a, b in zip(vector["names"], vector["true"], vector["identified"], strict=True)
    ]

    def four_sums(pi):
        """(27), from inertia about the joints: P of the physical arm, whose links are 1 m long."""
        (m2, x2, y2, *_), Izz1, Izz2 = pi[10:], pi[9], pi[19]
        return [Izz1 + m2, Izz2, x2, y2]

    np.testing.assert_allclose(four_sums(true), content["models"]["physical"]["P_true"])
    last = content["models"]["physical"]["P_hat"][-1]
    np.testing.assert_allclose(four_sums(found), last, rtol=1e-9)
    # what no torque shows stays at the first guess, half of the truth
    np.testing.assert_allclose(found[[4, 6, 14, 16]], true[[4, 6, 14, 16]] / 2)


def test_disturbed_cases(shown, content):
    table = shown["Relative error at the end"]
    wanted = []
    for case in ("disturbed", "noisy", "noisy_dead_zone"):
        for name, entry in content[case].items():
            errors = entry["relative_error"][-1], entry["last_tenth"], entry["averaged"]
            said = "yes" if entry["converged"] else "no"
            wanted.append([name, CASES[case].title, *[number(x, ".2g") for x in errors], said])
    assert table.rows == wanted
    assert table.column("at the end") != table.column("mean of last tenth")


def test_random_motions(shown, content):
    rows = shown["Iterations to a relative error of 10⁻³"].rows
    parts = [(content[key], start) for key, start in (
        ("trajectories", "up to 0.05 rad off the program"),
        ("trajectories_on_program", "on the program"),
    )]  # fmt: skip
    wanted = []
    for part, start in parts:
        for name, found in part.items():
            taken = found["iterations"] or [float("nan")]
            spread = [number(float(np.percentile(taken, p)), ".0f") for p in (0, 50, 90, 100)]
            counts = [str(found["runs"]), str(found["converged"])]
            wanted.append([name, start, *counts, *spread, str(found["most_iterations"])])
    assert rows == wanted


def test_runs_that_failed_are_counted_by_reason(shown, content):
    for key, tail in (("trajectories", ""), ("trajectories_on_program", ", start on the program")):
        rows = shown[f"Runs without convergence{tail}; all are listed in paper.json"].rows
        for name, found in content[key].items():
            counted = [row for row in rows if row[0] == name]
            assert sum(int(row[2]) for row in counted) == len(found["failures"])
            errors = [f["relative_error"] for f in found["failures"]]
            if len(counted) == 1:
                median, most = float(np.median(errors)), max(errors)
                assert counted[0][3:] == [number(median, ".2g"), number(most, ".2g")]


def test_many_motions_have_quantiles_and_failures_their_median():
    taken = [3, 4, 6, 9, 13, 20, 31, 40, 47, 90, 120]
    failures = [
        {"reason": reason, "relative_error": error}
        for reason, error in (
            ("slow: the error is 0.1", 0.1), ("slow: the error is 0.4", 0.4),
            ("the robot diverged from its program in iteration 3", 7.0),
            ("slow: the error is 0.2", 0.2), ("the error increased: from 0.5 to 0.6", 0.6),
            ("the robot diverged from its program in iteration 9", 2.0),
        )
    ]  # fmt: skip
    one = {"runs": 17, "converged": 11, "iterations": taken, "failures": failures}
    none = {"runs": 2, "converged": 0, "iterations": [], "failures": failures[:1]}
    content = {
        "trajectories": {"a": {**one, "most_iterations": 150}},
        "trajectories_on_program": {"b": {**none, "most_iterations": 9}},
    }
    shown = tables(page._trajectories(content))
    assert shown["Iterations to a relative error of 10⁻³"].rows == [
        ["a", "up to 0.05 rad off the program", "17", "11", "3", "20", "90", "120", "150"],
        ["b", "on the program", "2", "0", "–", "–", "–", "–", "9"],
    ]
    title = "Runs without convergence{}; all are listed in paper.json"
    assert shown[title.format("")].rows == [
        ["a", "slow", "3", "0.2", "0.4"],
        ["a", "the robot diverged from its program", "2", "4.5", "7"],
        ["a", "the error increased", "1", "0.6", "0.6"],
    ]
    on_program = shown[title.format(", start on the program")]
    assert on_program.rows == [["b", "slow", "1", "0.1", "0.1"]]


def test_a_case_is_judged_at_its_end_by_a_tenth_and_by_the_mean_of_the_later_half(rng):
    P, count = np.array([3.0, -4.0]), len(CASES)
    errors = np.append(0.5 * 0.9 ** np.arange(20), 5e-5)
    estimates = P + rng.standard_normal((21, count, 2))
    study = SimpleNamespace(
        P=P, history=SimpleNamespace(estimates=estimates), errors=lambda case: errors
    )
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
    assert not any(found["converged"] for found in said.values())
    assert said["on_program"]["reason"].startswith("slow: every run follows the same curve")
    assert said["noisy"]["reason"].startswith("A disturbance v is part of the deviation")


def test_energy_that_is_lost_is_no_less_than_energy_that_is_gained():
    drift = EnergyDrift(np.array([0.0, 0.5, 1.5]), {"a": np.array([0.0, -0.3, 0.1])})
    content = paper._content(FEW, [], {}, {}, drift)
    assert content["energy_drift"] == {"duration": 1.5, "max_relative": {"a": 0.3}}


def test_errata_energy_and_settings(shown, content):
    assert shown["Errata"].rows == [
        [e["where"], e["printed"], e["corrected"], number(e["max_torque_difference"], ".1f"),
         number(e["max_torque_difference_on_program"], ".1f")]
        for e in content["errata"]
    ]  # fmt: skip
    drift = content["energy_drift"]["max_relative"]
    assert shown["Largest change of energy"].rows == [
        [name, number(100 * value, ".3g")] for name, value in drift.items()
    ]
    settings = content["settings"]
    written = {k.split(" [")[0]: value for k, value in shown["Settings"].rows}
    assert len(written) == len(settings)
    assert "1, 1.5" in written.values()
    for key, value in settings.items():
        name = key.removesuffix("_rad").removesuffix("_s").replace("_", " ")
        cells = written[name].split(", ")
        for cell, x in zip(cells, value if isinstance(value, list) else [value], strict=True):
            assert cell == (str(x) if isinstance(x, bool | str) else f"{x:.4g}")


def test_settings_are_written_each_under_its_name():
    drift = EnergyDrift(np.array([0.0, 1.0]), {"a": np.array([0.0, 0.1])})
    settings = PaperSettings(iterations=19, longest=31, runs=4, patience=2, seed=23)
    found = paper._content(settings, [], {}, {}, drift)["settings"]
    assert found == {
        "iterations": 19, "updates_per_iteration": 100, "amplitude_rad": [1.0, 1.5],
        "duration_s": 2.0, "alpha": 20.0, "beta": 100.0, "first_guess": "P / 2",
        "start_beside_program_rad": [np.pi / 180, 0.0], "most_iterations_until_PRX_is_zero": 31,
        "random_motions": 4, "seed": 23,
    }  # fmt: skip


def test_random_motions_differ_by_model_and_by_start(monkeypatch):
    made_of, reported = [], []

    def runs(dynamics, P, count, most, rng, *, largest_offset, progress):
        made_of.append((dynamics.form, len(P), count, most, largest_offset, rng.uniform()))
        progress(7)
        return len(made_of)

    monkeypatch.setattr(paper, "random_runs", runs)
    settings = PaperSettings(runs=4, seed=5)
    for where, largest in (("beside", 0.05), ("on", 0.0)):
        made = paper._trajectories(
            settings, where, largest, 31, lambda *parts: reported.append(parts)
        )
        assert list(made) == list(MODELS)
    assert len({first for *_, first in made_of}) == 6
    for k, (*given, first) in enumerate(made_of):
        wanted = paper_arm(list(MODELS)[k % 3])
        assert given == [wanted[0].form, len(wanted[1]), 4, 31, 0.05 if k < 3 else 0.0]
        assert first == np.random.default_rng([5, k % 3, int(k < 3)]).uniform()
        what = f"{list(MODELS)[k % 3]}, 4 motions from {('beside', 'on')[k // 3]} the program"
        assert reported[k] == (what, 7, 31, "iterations")


def test_the_verdict_is_that_of_the_last_iteration(html, content):
    box = html.split('<div class="verdict ')[1].split("</div>")[0]
    last = [content["models"][name]["relative_error"][-1] for name in MODELS]
    assert box.startswith("good" if max(last) <= 1e-4 else "poor")
    assert "After <strong>19 iterations</strong>" in box
    for name, error in zip(MODELS, last, strict=True):
        on = content["on_program"][name]["relative_error"][-1]
        assert (
            f"<li>{name}: relative error {number(error, '.2g')}; with a start on the program "
            f"instead of one degree off it: {number(on, '.2g')}</li>" in box
        )


def test_the_verdict_is_good_if_all_models_are(content):
    for last, status in (((1e-5, 9e-5, 1e-4), "good"), ((1e-5, 2e-4, 1e-5), "poor")):
        models = {
            name: {**content["models"][name], "relative_error": [0.5, error]}
            for name, error in zip(MODELS, last, strict=True)
        }
        box = page._summary({**content, "models": models}).split('<div class="verdict ')[1]
        assert box.startswith(status)
        assert "After <strong>1 iterations</strong>" in box


def test_the_summary_says_what_the_start_beside_the_program_does(html, content):
    last = {name: content["models"][name]["relative_error"][-1] for name in MODELS}
    gains = [content["on_program"][n]["relative_error"][-1] / last[n] for n in MODELS]
    assert f"iterations is {min(gains):.2g} to {max(gains):.2g} times as large" in html
    assert "start, 1 degree off the program" in html


def test_a_model_is_written_from_its_clean_case_and_judged_at_its_end(rng):
    estimates, prx = rng.standard_normal((3, 5, 2)), rng.random((2, 5))
    study = SimpleNamespace(
        dynamics=SimpleNamespace(names=("p", "q")), P=np.array([3.0, -4.0]), NA=31,
        history=SimpleNamespace(estimates=estimates, prx=prx),
        errors=lambda: np.array([0.5, 9e-5, 2e-4]),
    )  # fmt: skip
    assert paper._model(study) == {
        "names": ["p", "q"], "P_true": [3.0, -4.0], "P_hat": estimates[:, 0].tolist(),
        "relative_error": [0.5, 9e-5, 2e-4], "prx_norm": prx[:, 0].tolist(), "NA": 31,
        "converged": False,
    }  # fmt: skip
    study.errors = lambda: np.array([0.5, 2e-4, 1e-4])
    assert paper._model(study)["converged"]


def test_the_replay_has_the_torques_of_first_and_last_estimate(monkeypatch, rng):
    given = {}

    def replay(arm, t, q, *, torques, notes):
        given.update(t=t, q=q, torques=torques)
        return SimpleNamespace(write=lambda target: given.update(target=target))

    monkeypatch.setattr(paper, "replay", replay)
    dynamics, P = paper_arm("physical")
    estimates = P * rng.uniform(0.5, 2.0, (7, 2, 4))
    study = SimpleNamespace(P=P, history=SimpleNamespace(estimates=estimates))
    paper._write_replay(None, study, "there")
    t = np.linspace(0.0, 2.0, 241)
    q, v, a = PROGRAM.evaluate(t)
    np.testing.assert_array_equal(given["q"], q)
    measured, predicted = given["torques"].measured, given["torques"].predicted
    G = dynamics.regressor(q, v, a)
    np.testing.assert_allclose(measured, G @ P, atol=1e-9)
    assert list(predicted) == ["initial values", "after 6 iterations"]
    for found, k in zip(predicted.values(), (0, 6), strict=True):
        np.testing.assert_allclose(found, G @ estimates[k, 0], atol=1e-9)
    assert given["target"] == "there"
