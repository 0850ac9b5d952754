import re

import numpy as np
import pytest

from robotid.base.exceptions import DataError, SettingsError
from robotid.dynamics.simulation.motions import (
    FourierTrajectory,
    ProgramMotion,
    SampledMotion,
    random_fourier,
)
from robotid.robot.model import RobotModel


def test_a_motion_of_seven_joints_has_the_coefficients_of_equation_28():
    A, q0, T, t = np.arange(1.0, 8.0), np.full(7, 0.3), 1.6, 0.45
    shape = 6 / T**5 * t**5 - 15 / T**4 * t**4 + 10 / T**3 * t**3
    np.testing.assert_allclose(ProgramMotion(A, T, q0).evaluate(t)[0], q0 + A * shape, rtol=1e-14)


WAVES = np.random.default_rng(0).standard_normal((2, 3, 3))


@pytest.mark.parametrize(
    "motion",
    [ProgramMotion(np.array([1.0, -2.0, 0.5]), 1.7), FourierTrajectory(np.ones(3), *WAVES, 4.0)],
)
def test_derivatives_match_finite_differences(motion):
    t, h = np.linspace(0.1, 1.6, 31), 1e-5
    q, v, a = motion.evaluate(t)
    (q0, v0, _), (q1, v1, _) = motion.evaluate(t - h), motion.evaluate(t + h)
    # rounding 1e-16 / h and truncation h^2 are both near 1e-10 of the Fourier motion's 100 rad/s^3
    np.testing.assert_allclose((q1 - q0) / (2 * h), v, atol=1e-8)
    np.testing.assert_allclose((v1 - v0) / (2 * h), a, atol=1e-7)
    if isinstance(motion, FourierTrajectory):
        np.testing.assert_allclose(motion.evaluate(t + 4.0)[0], q, atol=1e-12)


def test_many_motions_at_once_are_the_motions_one_by_one(rng):
    A, T, t = rng.normal(size=(4, 3)), rng.uniform(1, 3, 4), rng.uniform(0, 1, 4)
    together = ProgramMotion(A, T).evaluate(t)
    for r in range(4):
        alone = ProgramMotion(A[r], T[r]).evaluate(t[r])
        for many, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(many[r], one)


@pytest.mark.parametrize("knows_more", [False, True])
def test_a_motion_through_samples_begins_with_the_first(knows_more):
    """Polynomials of order 5 are what both kinds of curve between samples are made of."""
    C = np.array([[0.3, -1.0, 0.5, 0.8, -0.6, 0.1], [1.0, 0.2, 0.0, -0.4, 0.3, -0.2]]).T  # (6, 2)

    def true(t):
        q, v, a = (
            np.stack([np.polyval(np.polyder(c[::-1], k), t) for c in C.T], axis=1) for k in range(3)
        )
        return q, v, a

    t = np.linspace(0.0, 1.5, 12) ** 1.1
    q, v, a = true(t)
    motion = SampledMotion(t + 7.0, q, v, a) if knows_more else SampledMotion(t + 7.0, q)
    assert motion.duration == pytest.approx(t[-1])
    between = np.linspace(0.0, t[-1], 40)
    for found, exact in zip(motion.evaluate(between), true(between), strict=True):
        np.testing.assert_allclose(found, exact, atol=1e-9)


ERRORS = {
    "amplitude has shape (), expected (n,) or (R, n), finite": (DataError, (np.array(1.0), 1.0)),
    "duration has shape (3,), expected () or (4,)": (DataError, (np.ones((4, 2)), np.ones(3))),
    "duration is 0.0, expected a positive number": (SettingsError, (np.ones(2), 0.0)),
}


@pytest.mark.parametrize("message", ERRORS)
def test_what_cannot_be_a_motion_is_named(message):
    error, arguments = ERRORS[message]
    with pytest.raises(error, match=f"^{re.escape(message)}$"):
        ProgramMotion(*arguments)


LIMITS = """<robot name="three"><link name="base"/>{bodies}
<joint name="near" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
<limit lower="-0.5" upper="2.0" effort="1" velocity="0.7"/></joint>
<joint name="free" type="continuous"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/></joint>
<joint name="rail" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
<limit lower="-0.2" upper="1.0" effort="1" velocity="{fast}"/></joint></robot>"""
BODY = """<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
ixz="0" iyz="0"/></inertial></link>"""


@pytest.mark.parametrize(
    ("period", "fast", "bounds"),
    [
        (500.0, 2.0, [0.9 * 1.25, 1.2, 0.15]),  # long: nine tenths of the room, at most 1.2 or 0.15
        (0.01, 2.0, [0.9 * 0.7, 1.5, 0.3]),  # short: nine tenths of the speed, at most 1.5 or 0.3
        (0.01, 0.2, [0.9 * 0.7, 1.5, 0.9 * 0.2]),
    ],
)
def test_a_random_motion_is_as_large_as_it_may(tmp_path, rng, period, fast, bounds):
    path = tmp_path / "three.urdf"
    path.write_text(LIMITS.format(bodies="".join(map(BODY.format, "abc")), fast=fast))
    motion = random_fourier(RobotModel.from_urdf(path), rng, period=period)
    mean = np.array([0.75, 0.0, 0.4])
    np.testing.assert_allclose(motion.q0, mean)
    assert (motion.period, motion.sine.shape) == (period, (5, 3))
    q, v, _ = motion.evaluate(np.linspace(0.0, period, 1000))
    found = np.abs(q - mean if period > 1 else v).max(axis=0)
    np.testing.assert_allclose(found, bounds, rtol=1e-9)
