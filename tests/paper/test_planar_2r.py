"""The closed-form arm against Pinocchio, the printed definitions and the laws of mechanics."""

import numpy as np
import pinocchio as pin
import pytest

from robotid.paper.planar_2r import (
    PAPER_LINKS,
    PARAMETER_NAMES,
    PlanarLinks,
    parameters,
    regressor,
    urdf_text,
)

FORMS = tuple(PARAMETER_NAMES)
#: Another possible arm, every field unlike the others, so that no term can hide behind a 0 or 1.
OTHER_LINKS = PlanarLinks(0.7, 0.4, 3.0, -0.3, 0.05, 0.9, 2.0, -0.15, -0.08, 0.3)
ARMS = pytest.mark.parametrize("links", [PAPER_LINKS, OTHER_LINKS], ids=["paper", "other"])


def states(n):
    """Yield n random states: q in +-pi rad, v in +-10 rad/s, a in +-20 rad/s^2."""
    rng = np.random.default_rng(0)
    for _ in range(n):
        yield tuple(rng.uniform(-bound, bound, 2) for bound in (np.pi, 10.0, 20.0))


def mass_matrix(q, P, form="corrected"):
    """Return D(q, P), with the columns G(q, 0, e_j) P."""
    return np.stack([regressor(q, 0 * e, e, form=form) @ P for e in np.eye(2)], axis=1)


@ARMS
@pytest.mark.parametrize("form", ["corrected", "corrected_five"])
def test_corrected_torque_equals_pinocchio(links, form):
    model = pin.buildModelFromXML(urdf_text(links))
    data = model.createData()
    P = parameters(links, form=form)
    for q, v, a in states(200):
        tau = pin.rnea(model, data, q, v, a)
        error = np.linalg.norm(regressor(q, v, a, form=form) @ P - tau)
        # rounding of terms of up to 1e4 N m in links of about 1 m
        assert error <= 1e-12 * np.linalg.norm(tau)


@ARMS
@pytest.mark.parametrize("form", FORMS)
def test_mass_matrix_is_that_of_equation_26(links, form):
    L1, L2, m1, m2 = links.L1, links.L2, links.m1, links.m2
    m1x, m2x, m2y = m1 * links.xbar1, m2 * links.xbar2, m2 * links.ybar2
    for q, _, _ in states(20):
        c2, s2 = np.cos(q[1]), np.sin(q[1])
        D22 = links.Izz2 + L2**2 * m2 + 2 * L2 * m2x
        D12 = links.Izz2 + (c2 * L1 * L2 + L2**2) * m2
        D12 += (c2 * L1 + 2 * L2) * m2x - L1 * s2 * m2y
        D11 = links.Izz1 + L1**2 * m1 + 2 * L1 * m1x + links.Izz2
        D11 += (2 * c2 * L1 * L2 + L1**2 + L2**2) * m2
        D11 += (2 * c2 * L1 + 2 * L2) * m2x - 2 * L1 * s2 * m2y
        D = mass_matrix(q, parameters(links, form=form), form=form)
        np.testing.assert_allclose(D, [[D11, D12], [D12, D22]], rtol=1e-13, atol=1e-13)


@ARMS
def test_printed_p4_takes_ybar_where_column_4_needs_xbar(links):
    printed = parameters(links, form="printed")
    mended = parameters(links, form="corrected_five")
    difference = links.L1 * links.m2 * (links.ybar2 - links.xbar2)
    np.testing.assert_allclose(printed - mended, [0, 0, 0, difference, 0], atol=1e-15)
    np.testing.assert_array_equal(mended[[0, 1, 2, 4]], parameters(links))


def test_printed_regressor_is_wrong_in_both_rows_of_column_4_only():
    for q, v, a in states(50):
        wrong = regressor(q, v, a, form="printed") - regressor(q, v, a, form="corrected_five")
        expected = np.zeros((2, 5))
        expected[:, 3] = np.sin(q[1]) * (v @ v) * np.array([1.0, -1.0])
        np.testing.assert_allclose(wrong, expected, atol=1e-12)
