"""Figures of the report's tables that no stored page shows, or that are worked out again."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.pages import tables

from robotid.estimation.variation.spread import Mixture, Prediction
from robotid.estimation.variation.variation import UnlikeRun, Variation, VaryingParameter
from robotid.identification.parameter_table import central_parameters
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_content import torque_report
from robotid.output.report.tables import variation_section
from robotid.robot.bodies import central_inertial


def test_a_drive_parameter_that_stands_on_a_misfit_says_so(identified):
    found = replace(identified, on_misfit=("elbow_joint.coulomb",))
    rows = tables(torque_report(found, Origin()).parameters)["Parameters of links and drives"].rows
    marked = [row[:2] for row in rows if row[8].endswith(", model misfit")]
    assert marked == [["elbow_joint", "coulomb"]]
    for row in rows:  # each to the digit of its error
        if row[4] != "–" and "e" not in "".join(row[3:7]):
            assert len({len(cell.partition(".")[2]) for cell in row[3:7]}) == 1, row
    held = [row[:2] for row in rows if row[8] == "at its bound" and row[4] == "–"]
    assert held == [["elbow_joint", "viscous"]]


@pytest.fixture(scope="module")
def central(identified):
    return central_parameters(identified)


def test_values_are_those_about_the_centre_of_mass(identified, central):
    for i in (1, 4):
        for pi, row in ((identified.prior, central.urdf), (identified.standard, central.values)):
            m, c, _, (xx, xy, xz, yy, yz, zz) = (lambda x: (x.mass, x.com, x.rpy, x.inertia))(
                central_inertial(pi[10 * i : 10 * i + 10])
            )
            np.testing.assert_allclose(row[i], [m, *c, xx, yy, zz, xy, xz, yz], atol=1e-12)


@pytest.mark.parametrize("i", [1, 5])
def test_intervals_contain_those_of_sampled_parameters(identified, central, i):
    own = slice(10 * i, 10 * i + 10)
    pi, C = identified.standard[own], 1e-8 * identified.standard_covariance[own, own]
    rng = np.random.default_rng(0)
    drawn = rng.multivariate_normal(pi, C, 4000, method="eigh")
    m, c = drawn[:, 0], drawn[:, 1:4] / drawn[:, :1]
    yy = drawn[:, 6] - m * (c[:, 0] ** 2 + c[:, 2] ** 2)
    xz = drawn[:, 7] + m * c[:, 0] * c[:, 2]
    quantile = identified.standard_quantile[own].max()
    wanted = quantile * np.column_stack([m, c, yy, xz]).std(axis=0) * 1e4
    np.testing.assert_allclose(central.half[i][[0, 1, 2, 3, 5, 8]], wanted, rtol=0.05)


def parameter(name, unit, values, std_errors, *, mean, error, spread, ends, after):
    std = np.array([np.ptp(ends) / (2 * 1.959964)])  # of one normal distribution
    mixture = Mixture(np.ones(1), np.array([np.mean(ends)]), std)
    found = Prediction(mean, error, spread, np.array([0.0, 9.0]), mixture, after)
    return VaryingParameter(name, unit, found, np.array(values), np.array(std_errors))


@pytest.fixture
def variation():
    coulomb = parameter(
        "one.coulomb", "N m", [4.1, 3.7, 6.0], [0.12, 0.02, 0.3], mean=4.212, error=0.25,
        spread=0.8765, ends=(2.0, 7.5), after=(0.2, 4.4),
    )  # fmt: skip
    viscous = parameter(
        "two.viscous", "N m s/rad", [-1.0, 9.0, 3.0], [0.1, 0.2, 0.3], mean=3.0, error=2.0,
        spread=4.0, ends=(0.5, 5.5), after=(1.9, 4.95),
    )  # fmt: skip
    unlike = UnlikeRun(2, "drive", "one", "one.coulomb", "N m", 6.0, 0.3, np.array([3.0, 5.0]), 0.0)
    return Variation(("a.csv", "<b>.csv", "c.csv"), 1, (coulomb, viscous), (unlike,))


def test_each_parameter_has_its_figures_and_what_one_more_log_would_change(variation):
    page = variation_section(variation, {"one": "1.23 N m", "two": "0.4 N m"})
    (caption, table), *others = tables(page).items()
    assert not others
    expected = "Drive parameters in 3 logs; low to high: 95 % of the next log of this robot"
    assert caption == expected
    rows = table.rows
    assert rows[0] == [
        "one.coulomb", "4.10 ± 0.12", "3.700 ± 0.020", "6.00 ± 0.30", "4.21", "0.25", "0.88",
        "2.00", "7.50", "N m", "80", "80",
    ]  # fmt: skip
    assert rows[1][4:7] == ["3.0", "2.0", "4.0"]
    assert rows[1][-2:] == ["95", "99"]
    bold = "<strong>6.00 ± 0.30</strong>"
    assert page.count(bold) == page.count(f'<td class="number" data-value="6">{bold}') == 1
    next_error = (
        "RMS torque error of the next log, on motions like these: one 1.23 N m, two 0.4 N m"
    )
    assert f"Expected {next_error}" in page
    robots = variation_section(replace(variation, units=3), {})
    assert "95 % of the next robot (after 3)</caption>" in robots
    assert "standard deviation between robots (spread)" in robots
    assert "Expected RMS" not in robots
    assert variation_section(None, {}) == ""
