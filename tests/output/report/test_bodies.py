"""Mass, centre of mass and inertia of all links: figures and sources."""

import numpy as np
import pytest
from helpers.pages import tables

from robotid.diagnosis.verdict.parameter_table import central_parameters
from robotid.output.pages.html import with_error
from robotid.output.report.tables import body_table
from robotid.robot.bodies import central_inertial


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


def test_each_cell_has_the_value_its_interval_and_the_urdfs(identified, central):
    rows = tables(body_table(identified))["Links"].rows
    assert [row[0] for row in rows] == list(identified.model.layout.bodies)
    for i, row in enumerate(rows):
        for k, cell in enumerate(row[1:]):
            value, half = with_error(central.values[i, k], central.half[i, k])
            before = with_error(central.urdf[i, k], central.half[i, k])[0].html
            assert cell == f"{value.html} ± {half.html}{before}"
