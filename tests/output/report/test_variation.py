"""The section on the variation of drive parameters between logs: figures and places of marks."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.pages import tables

from robotid.estimation.variation.spread import Mixture, Prediction
from robotid.estimation.variation.variation import UnlikeRun, Variation, VaryingParameter
from robotid.output.report.tables import variation_section


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
    html = variation_section(variation, {"one": "1.23 N m", "two": "0.4 N m"})
    (caption, table), *others = tables(html).items()
    assert not others
    assert caption == (
        "Drive parameters in 3 logs; low to high: 95 % of the next log of this robot"
    )
    rows = table.rows
    assert rows[0] == [
        "one.coulomb", "4.10 ± 0.12", "3.700 ± 0.020", "6.00 ± 0.30", "4.21", "0.25", "0.88",
        "2.00", "7.50", "N m", "80", "80",
    ]  # fmt: skip
    assert rows[1][4:7] == ["3.0", "2.0", "4.0"]
    assert rows[1][-2:] == ["95", "99"]
    assert (
        html.count("<strong>6.00 ± 0.30</strong>")
        == html.count('<td class="number" data-value="6"><strong>')
        == 1
    )
    assert (
        "Expected RMS torque error of the next log, on motions like these: one 1.23 N m, two "
        in (html)
    )
    robots = variation_section(replace(variation, units=3), {})
    assert "95 % of the next robot (after 3)</caption>" in robots
    assert "standard deviation between robots (spread)" in robots
    assert "Expected RMS" not in robots
    assert variation_section(None, {}) == ""
