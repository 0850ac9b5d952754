"""The closed-form arm against Pinocchio, the printed definitions and the laws of mechanics."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import ModelError
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper.planar_2r import (
    PAPER_LINKS,
    PAPER_PARAMETERS,
    PARAMETER_NAMES,
    PlanarLinks,
    parameters,
    regressor,
    urdf_text,
)

URDF = Path(__file__).parents[2] / "urdf" / "planar_2r.urdf"
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


def velocity_vector(q, v, P, form="corrected"):
    """Return the centrifugal and Coriolis torques C(q, v, P) = G(q, v, 0) P."""
    return regressor(q, v, np.zeros(2), form=form) @ P


def program_motion(t, amplitude, duration):
    return ProgramMotion(amplitude, duration).evaluate(t)


def mass_matrix_rate(q, v, P, form):
    """Return dD/dt exactly: D is constant + A cos q2 + B sin q2, so dD/dq2 is a difference."""
    quarter = np.array([0.0, np.pi / 2])
    change = mass_matrix(q + quarter, P, form=form) - mass_matrix(q - quarter, P, form=form)
    return change / 2 * v[1]


def invented_power(q, v, P, form):
    """Return v^T C - v^T (dD/dt) v / 2, the power that no torque supplies; 0 for rigid bodies."""
    D_rate = mass_matrix_rate(q, v, P, form)
    return v @ velocity_vector(q, v, P, form=form) - v @ D_rate @ v / 2


def stacked_rank(rows):
    # a column that others span leaves rounding, about 1e-16 of the largest singular value
    return np.linalg.matrix_rank(np.vstack(rows), rtol=1e-10)


# --- corrected form against Pinocchio ---------------------------------------------------------


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


# --- D, C and G say the same ------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_mass_matrix_velocity_vector_and_regressor_agree(form):
    P = np.random.default_rng(1).normal(size=len(PARAMETER_NAMES[form]))
    for q, v, a in states(50):
        tau = mass_matrix(q, P, form=form) @ a + velocity_vector(q, v, P, form=form)
        np.testing.assert_allclose(regressor(q, v, a, form=form) @ P, tau, rtol=1e-12, atol=1e-10)


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


# --- the errata -------------------------------------------------------------------------------


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


# --- energy -----------------------------------------------------------------------------------


def test_printed_arm_invents_energy():
    p3, p4 = PAPER_PARAMETERS[2:4]
    for q, v, _ in states(50):
        v1, v2 = v
        expected = p4 * (v1**3 - v2**3) - p3 * v1 * v2 * (v1 - v2)
        invented = invented_power(q, v, PAPER_PARAMETERS, "printed")
        np.testing.assert_allclose(invented, np.sin(q[1]) * expected, rtol=1e-10, atol=1e-9)
    # more than any rounding: 6.7 W at 1 and 2 rad/s
    invented = invented_power(
        np.array([0.0, 1.0]), np.array([1.0, 2.0]), PAPER_PARAMETERS, "printed"
    )
    assert abs(invented) > 5.0


# --- rank -------------------------------------------------------------------------------------


def test_closed_form_columns_span_what_pinocchios_do():
    model = pin.buildModelFromXML(urdf_text())
    data = model.createData()
    both = [
        np.hstack([pin.computeJointTorqueRegressor(model, data, *state), regressor(*state)])
        for state in states(50)
    ]
    assert stacked_rank(both) == 4


# --- URDF -------------------------------------------------------------------------------------


@ARMS
def test_urdf_keeps_every_digit_and_moves_to_the_proximal_frames(links):
    robot = ET.fromstring(urdf_text(links))
    assert [link.get("name") for link in robot.iter("link")] == ["base_link", "link_1", "link_2"]
    assert [joint.get("name") for joint in robot.iter("joint")] == ["joint_1", "joint_2"]
    origins = [joint.find("origin").get("xyz").split() for joint in robot.iter("joint")]
    assert [float(xyz[0]) for xyz in origins] == [0.0, links.L1]
    coms = [
        list(map(float, com.get("xyz").split())) for com in robot.iterfind("link/inertial/origin")
    ]
    assert coms[0] == [links.L1 + links.xbar1, links.ybar1, 0.0]
    assert coms[1] == [links.L2 + links.xbar2, links.ybar2, 0.0]
    assert [float(mass.get("value")) for mass in robot.iter("mass")] == [links.m1, links.m2]
    assert [float(inertia.get("izz")) for inertia in robot.iter("inertia")] == list(links.central)


# --- program motion ---------------------------------------------------------------------------


def test_program_motion_has_the_coefficients_of_equation_28():
    A, T, t = np.array([0.7, 2.0]), 1.6, 0.45
    shape = 6 / T**5 * t**5 - 15 / T**4 * t**4 + 10 / T**3 * t**3
    np.testing.assert_allclose(program_motion(t, A, T)[0], A * shape, rtol=1e-14)


# --- errors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change", [{"L1": 0.0}, {"L2": np.inf}, {"m2": -1.0}, {"xbar1": np.nan}, {"Izz1": 2.5}]
)
def test_impossible_links_are_refused(change):
    with pytest.raises(
        ModelError, match=r"^lengths, masses and inertias .* of Pla.*wanted positive"
    ):
        replace(PAPER_LINKS, **change)
