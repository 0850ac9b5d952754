"""Each law of a drive's torque beside its equation, and its derivative beside differences."""

import numpy as np
import pytest

from robotid.robot.drive_term import linear
from robotid.robot.drives import TERM_CLASSES, Bristles

#: Law, what shapes it, its equation, and its kinks, between which it has a derivative.
LAWS = {
    "linear": (linear, (), lambda z: z, ()),
    "asymmetric": ("Asymmetric", (), lambda z: np.sqrt(z * z), (0.0,)),
    "cubic": ("Cubic", (), lambda z: z**3, ()),
    "tanh": ("Tanh", (0.3,), lambda z: 1 - 2 / (np.exp(2 * z / 0.3) + 1), ()),
    "stribeck": (
        "Stribeck", (0.4, 0.5), lambda z: np.exp(-np.clip(abs(z), 0.5, 9.0) / 0.4),
        (-0.5, 0.0, 0.5),
    ),
    "power": ("Power", (1.7,), lambda z: np.exp(1.7 * np.log(abs(z) + 1e-300)), (0.0,)),
    "rise": (
        "Ramp", (0.2, 0.9), lambda z: np.interp(abs(z), [0.2, 0.9], [0, 1]),
        (-0.9, -0.2, 0.0, 0.2, 0.9),
    ),
    "order 0": ("PositionCoulomb", (0.0, 0.3), lambda z: 1.0 + 0 * z, ()),
    "order 1": ("PositionCoulomb", (1.0, 0.3), lambda z: z - 0.3, ()),
    "order 3": (
        "PositionCoulomb", (3.0, 0.3), lambda z: z**3 - 0.9 * z**2 + 0.27 * z - 0.027, ()
    ),
    "cosine": ("Harmonic", (2.5, 0.0), lambda z: np.sin(np.pi / 2 - 2.5 * z), ()),
    "sine": ("Harmonic", (2.5, 1.0), lambda z: np.cos(np.pi / 2 - 2.5 * z), ()),
    "hat": (
        "Hat", (-0.7, 0.1, 1.1), lambda z: np.interp(z, [-0.7, 0.1, 1.1], [0, 1, 0]),
        (-0.7, 0.1, 1.1),
    ),
}  # fmt: skip
H = 1e-6


@pytest.mark.parametrize("name", LAWS)
def test_a_law_is_its_equation_and_its_derivative_that_of_differences(name):
    own, x, equation, kinks = LAWS[name]
    kind = TERM_CLASSES.get(own)
    law = own if kind is None else kind.speed_law or kind.position_law
    z = np.linspace(-1.93, 1.87, 77)
    z = z[np.all([abs(z - k) > 1e-3 for k in kinks], axis=0)] if kinks else z
    y, slope = law(z, *x)
    np.testing.assert_allclose(y + 0 * z, equation(z), atol=1e-12)
    exact = (equation(z + H) - equation(z - H)) / (2 * H)
    np.testing.assert_allclose(slope + 0 * z, exact, atol=1e-8)
    for one in (-1.3, 0.61):  # of single numbers, as it is compiled
        np.testing.assert_allclose(law(one, *x)[0], equation(np.array(one)), atol=1e-12)


def test_a_lever_is_the_derivative_of_its_springs_energy():
    """A spring of stiffness 1 between an arm of 0.5 m and a point 1.2 m away."""
    z = np.linspace(-3.0, 3.0, 41)

    def energy(z):
        ends = [0.5 * np.cos(z - 0.2) - 1.2, 0.5 * np.sin(z - 0.2)]
        return 0.5 * (np.hypot(*ends) - 0.3) ** 2

    y, slope = TERM_CLASSES["Counterbalance"].position_law(z, 0.5, 1.2, 0.2, 0.3)
    h = 1e-4
    np.testing.assert_allclose(y, (energy(z + h) - energy(z - h)) / (2 * h), atol=1e-8)
    np.testing.assert_allclose(
        slope, (energy(z + h) - 2 * energy(z) + energy(z - h)) / h**2, atol=1e-6
    )


def test_a_lever_that_is_not_described_hangs_at_the_zero_position():
    """Arms of 0.1 and 0.5 m, a spring without length at rest: tau = k a b sin q."""
    z = np.array([-2.0, 0.0, 0.7])
    term = TERM_CLASSES["Counterbalance"]()
    y, slope = term.position_law(z, term.arm, term.base, term.angle, term.rest)
    np.testing.assert_allclose(y, 0.05 * np.sin(z), atol=1e-15)
    np.testing.assert_allclose(slope, 0.05 * np.cos(z))


def test_bristles_keep_what_the_solution_of_their_equation_keeps():
    s_0, w, c = 0.03, 0.4, 0.6
    v = np.array([0.0, 0.1, -0.3, 1.2, -2.0])
    way = np.array([0.0, 0.02, -0.05, 0.004, 0.1])
    g, slope, kept = Bristles.law((s_0, w, c), way, v)

    def level(v):
        return 1.0 + c * np.exp(-(v**2) / w**2)

    np.testing.assert_allclose(g, level(v))
    np.testing.assert_allclose(slope, (level(v + H) - level(v - H)) / (2 * H), atol=1e-8)
    for first in (-0.7, 1.4):  # dz/ds = 1 - z / g, by a fine Runge-Kutta scheme
        z, n = np.full(5, first), 400
        for _ in range(n):
            h = np.abs(way) / s_0 / n
            k1 = 1 - z / g
            k2 = 1 - (z + h / 2 * k1) / g
            z = z + h * (1 - (z + h / 2 * k2) / g)
        np.testing.assert_allclose(g + (first - g) * kept, z, atol=1e-5)
