"""The paper's page, cell by cell, against paper.json; its figures against the studies."""

import numpy as np
import pytest
from helpers.pages import number, tables

from robotid.paper.run import run_paper
from robotid.paper.study import CASES, PaperSettings
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS

MODELS = ("printed", "corrected", "physical")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("paper")


@pytest.fixture(scope="module")
def content(folder):
    return run_paper(folder, settings=PaperSettings(iterations=20, longest=3, runs=4, patience=5))


@pytest.fixture(scope="module")
def html(folder, content):
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
    assert table.column("at the end") != table.column("started on program")


def test_parameters_at_the_end(shown, content):
    for name in MODELS:
        model = content["models"][name]
        last = model["P_hat"][-1]
        assert shown[f"{name}: parameters at the end [kg m²]"].rows == [
            [p, number(true), number(found, ".7g"), number(found - true, ".1e")]
            for p, true, found in zip(model["names"], model["P_true"], last, strict=True)
        ]


def test_the_inertial_vector_is_in_the_papers_order(shown, content, folder):
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
        ("trajectories", "up to 0.05 rad beside the program"),
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
        rows = shown[f"Runs that did not converge{tail}; each one is in paper.json"].rows
        for name, found in content[key].items():
            counted = [row for row in rows if row[0] == name]
            assert sum(int(row[2]) for row in counted) == len(found["failures"])
            errors = [f["relative_error"] for f in found["failures"]]
            if len(counted) == 1:
                median, most = float(np.median(errors)), max(errors)
                assert counted[0][3:] == [number(median, ".2g"), number(most, ".2g")]


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
    assert dict(shown["Settings"].rows) == {k: str(v) for k, v in content["settings"].items()}


def test_the_verdict_is_that_of_the_last_iteration(html, content):
    box = html.split('<div class="verdict ')[1].split("</div>")[0]
    last = [content["models"][name]["relative_error"][-1] for name in MODELS]
    assert box.startswith("good" if max(last) <= 1e-4 else "poor")
    assert "After <strong>20 iterations</strong>" in box
    for name, error in zip(MODELS, last, strict=True):
        on = content["on_program"][name]["relative_error"][-1]
        assert (
            f"<li>{name}: relative error {number(error, '.2g')}, or {number(on, '.2g')} where"
            in box
        )


def test_the_summary_says_what_the_start_beside_the_program_does(html, content):
    last = {name: content["models"][name]["relative_error"][-1] for name in MODELS}
    gains = [content["on_program"][n]["relative_error"][-1] / last[n] for n in MODELS]
    assert f"leave an error {min(gains):.2g} to {max(gains):.2g} times as large" in html
    assert "starts, 1 degree beside its program" in html
