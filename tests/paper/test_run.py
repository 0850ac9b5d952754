"""The paper's simulation: what it writes, what it says of itself, the errata and the energy."""

import json
import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from matplotlib.figure import Figure

from robotid.cli import main
from robotid.exceptions import SettingsError
from robotid.paper import run as paper
from robotid.paper.equations import torque
from robotid.paper.errata import energy_drift, errata
from robotid.paper.planar_2r import PAPER_PARAMETERS
from robotid.paper.run import run_paper
from robotid.paper.study import (
    DURATION,
    MODELS,
    PROGRAM,
    PaperSettings,
    paper_arm,
    random_runs,
    study_model,
)

FIGURES = ["figure_3a", "figure_3b", "figure_4a", "figure_4b", "figure_5", "convergence"]
FIGURES += ["disturbance", "trajectories", "energy"]
FEW = PaperSettings(iterations=3, longest=4, runs=4, patience=2)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper") / "out"
    return folder, run_paper(folder, settings=FEW)


def test_the_json_has_the_schema_of_the_design(written):
    folder, content = written
    found = json.loads((folder / "paper.json").read_text())
    assert found == content
    assert set(found["models"]) == {"printed", "corrected", "physical"}
    for name, model in found["models"].items():
        c = 4 if name == "physical" else 5
        assert len(model["P_true"]) == c
        assert np.shape(model["P_hat"]) == (4, c)
        assert len(model["relative_error"]) == 4
        assert len(model["prx_norm"]) == 3
        assert model["relative_error"][0] == 0.5
        np.testing.assert_allclose(np.array(model["P_hat"][0]) * 2, model["P_true"])
        assert model["NA"] is None  # PRX is not zero after three iterations
    for erratum in found["errata"]:
        assert erratum["where"]
        assert erratum["max_torque_difference"] > 1.0
    for name in MODELS:
        runs = found["trajectories"][name]
        assert runs["runs"] == 4 == runs["converged"] + len(runs["failures"])
        assert runs["converged"] == len(runs["iterations"])
        assert all(failure["reason"] for failure in runs["failures"])
        for case in ("on_program", "disturbed", "noisy", "noisy_dead_zone"):
            assert len(found[case][name]["relative_error"]) == 4
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
    monkeypatch.setattr(paper, "paper_figures", lambda *_: {"figure_3a": ("3", Figure())})
    with pytest.raises(OSError, match="disk full"):
        run_paper(tmp_path, settings=PaperSettings(iterations=1, longest=1, runs=1, patience=1))
    assert list(tmp_path.iterdir()) == []


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


# --- the parts --------------------------------------------------------------------------------


def test_the_physical_arm_has_four_parameters_and_the_others_the_papers_five():
    for name in ("printed", "corrected"):
        np.testing.assert_array_equal(paper_arm(name)[1], PAPER_PARAMETERS)
    np.testing.assert_allclose(paper_arm("physical")[1], [22, 5, 3, 0.1], rtol=1e-14)
    with pytest.raises(SettingsError, match=r"^model is 'other', wanted one of printed, corrected"):
        paper_arm("other")


def test_one_shot_needs_one_run_and_disturbance_shows():
    study = study_model("physical", PaperSettings(iterations=2, longest=1))
    assert study.one_shot_error < 1e-12
    assert study.errors("disturbed")[1] != study.errors()[1]
    assert study.errors("noisy")[1] != study.errors()[1]
    assert study.errors("on_program")[1] > study.errors()[1]


def test_the_errata_make_the_torques_differ_as_worked_out_by_hand():
    found = {e.where: e for e in errata(np.random.default_rng(0))}
    assert len(found) == 5
    # h = 3 s2 + 0.1 c2 <= 3.002: C122 and C112 together miss 2 h v2 (v1 + v2) <= 3.002 * 400
    assert 1000 < found["(26)"].max_torque_difference < 3.002 * 400
    # column 4 is off by s2 (v1^2 + v2^2) <= 200, times p3 = 3
    assert 500 < found["G, column 4"].max_torque_difference < 600
    # p4 of (27) is 2 instead of 3, times s2 v^2 <= 100
    assert 95 < found["(27), p4"].max_torque_difference < 100
    # D a = u - C with u = (D q_* + C) / 2: G P^ - u = D (a - q_*) / 2 = -(D q_* + C) / 4
    t = np.linspace(0, DURATION, 401)
    program = torque(*paper_arm("physical")[:1], *PROGRAM.evaluate(t), paper_arm("physical")[1])
    unseen = found["(23) with Ψ of (22), residual at P̂ = P / 2"]
    wanted = np.abs(program).max() / 4
    np.testing.assert_allclose(unseen.max_torque_difference_on_program, wanted, rtol=1e-12)
    for erratum in found.values():
        assert 1.0 < erratum.max_torque_difference_on_program < erratum.max_torque_difference


def test_only_the_physical_arm_keeps_its_energy():
    drift = energy_drift(duration=4.0, dt=4e-3)
    assert np.abs(drift.gained["physical"]).max() < 1e-9  # error of the integration
    assert np.abs(drift.gained["printed"]).max() > 0.2
    assert np.abs(drift.gained["corrected"]).max() > 0.1  # p3 != p4


def test_random_runs_tell_every_failure(rng):
    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 8, 12, rng)
    content = runs.to_dict()
    assert 0 < content["converged"] < 8
    for failure in content["failures"]:
        assert runs.errors[:, failure["run"]].min() >= 1e-3
        assert re.match(r"slow: an error of .* is left after 12 iterations", failure["reason"])
    for number, r in zip(runs.iterations, np.flatnonzero(runs.has_converged), strict=True):
        assert runs.errors[number, r] < 1e-3 <= runs.errors[number - 1, r]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"lost": 3}, "the robot ran away from its program in iteration 3"),
        (
            {"skipped": 7},
            "slow: an error of 0.4 is left after 1 iterations and falls by 20 % in ten; 7 updates "
            "were left out, as D(q, P^) was not positive definite",
        ),
        ({"errors": [0.5, 0.6]}, "the error grew, from 0.5 to 0.6"),
        ({"errors": [0.5, 0.5]}, "stalled: the motion excites too little; an error of 0.5 is left"),
    ],
)
def test_each_kind_of_failure_has_its_reason(change, reason, rng):
    from dataclasses import replace

    dynamics, P = paper_arm("physical")
    runs = random_runs(dynamics, P, 1, 1, rng)
    errors = np.array(change.pop("errors", [0.5, 0.4]))[:, None]
    history = replace(runs.history, **{key: np.array([x]) for key, x in change.items()})
    found = replace(runs, errors=errors, history=history).failures
    assert [failure["reason"] for failure in found] == [reason]


@pytest.mark.parametrize("name", ["iterations", "longest", "runs", "patience"])
def test_settings_below_one_are_named(name):
    with pytest.raises(SettingsError, match=f"^{name} is 0, wanted 1 or more$"):
        PaperSettings(**{name: 0})
