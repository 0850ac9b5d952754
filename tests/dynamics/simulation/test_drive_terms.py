"""Every registered term is one thing in the regressor, the plant and the compiled roll-outs."""

import numpy as np
import pytest
from helpers.paths import URDF

from robotid.dynamics.simulation.loop_lanes import (
    coded_term,
    deflection,
    direction,
    initial_deflection,
    term,
)
from robotid.dynamics.simulation.simulator import RobotPlant
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot import drives
from robotid.robot.drive_term import LOADED, DriveTerm, MemorylessTerm
from robotid.robot.model import RobotModel

OWN = (
    drives.Asymmetric(), drives.LoadFriction(), drives.Cubic(data_range=(0.0, 1.5)),
    drives.Stribeck(speed=0.3, data_range=(0.2, 1.5)), drives.Power(exponent=0.4),
    drives.Tanh(speed=0.4, data_range=(0.0, 1.5)), drives.Ramp(low=0.1, high=0.9),
    drives.Harmonic(order=2.0), drives.Harmonic(order=3.0, is_sine=True),
    drives.PositionCoulomb(order=0), drives.Spring(data_range=(-0.6, 0.9)),
    drives.PositionCoulomb(order=2, centre=0.3, data_range=(-0.6, 0.9)),
    drives.Hat(at=0.4, before=-0.3, after=0.9),
    drives.Counterbalance(arm=0.2, base=0.6, angle=0.4, rest=0.3),
)  # fmt: skip
MEMORYLESS = (*(t for t in drives.TERMS.values() if not t.is_inertia), *OWN)
LASTING = (
    drives.Presliding(displacement=0.05),
    drives.LuGre(displacement=0.05, speed=0.3, excess=0.6),
)
#: Positions and speeds of two joints: of either sign, off the centre, within ranges and beyond.
STATES = [
    ((0.43, -0.27), (0.7, -0.35)), ((-0.51, 0.77), (-1.2, 0.05)), ((0.81, -1.1), (2.2, -1.9)),
    ((0.1, 0.6), (-0.12, 0.5)),
]  # fmt: skip
H = 1e-6


def registered(kind=DriveTerm):
    return {x for sub in kind.__subclasses__() for x in (sub, *registered(sub))}


def with_term(own):
    """Return the planar arm, whose joints have one term of these sizes, and its parameters."""
    is_plain = own.name in drives.TERMS
    model = RobotModel.from_urdf(
        URDF / "planar_2r.urdf", terms=(own.name,) if is_plain else (),
        own_terms={} if is_plain else dict.fromkeys(("joint_1", "joint_2"), (own,)),
    )  # fmt: skip
    pi = model.standard_parameters()
    pi[model.layout.n_inertial :] = 0.3, 0.2
    return model.with_reference(pi), pi


def compiled_term(own, q, v):
    codes, shapes = (np.array([part]) for part in coded_term(own))
    return term(codes, shapes, 0, q, v, *direction(v))


def test_every_registered_term_is_walked_over():
    walked = {type(own) for own in (*MEMORYLESS, *LASTING)}
    own = {kind for kind in registered() if kind.__module__.startswith("robotid.")}
    assert own - walked == {MemorylessTerm, drives.Bristles, drives.Armature, drives.Lag}


@pytest.mark.parametrize("own", MEMORYLESS, ids=lambda own: own.name)
@pytest.mark.parametrize(("q", "v"), STATES)
def test_regressor_plant_and_roll_out_have_one_torque(own, q, v):
    model, pi = with_term(own)
    q, v, theta = np.array(q), np.array(v), pi[-2:]
    plant, size = RobotPlant(model, pi), model.layout.n_inertial
    Y = joint_torque_regressor(model, q[None], v[None], 0 * v[None])
    load = Y[:, :size] @ pi[:size]
    code, _ = coded_term(own)
    kernel = np.array([compiled_term(own, *state)[0] for state in zip(q, v, strict=True)])
    kernel *= theta * (np.abs(load) if code[2] == LOADED else 1.0)
    # their signs differ below 0.1 rad/s by less than 1e-7
    np.testing.assert_allclose(Y[:, size:] @ theta, kernel, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(
        plant.friction_torque(plant.friction(q, v), v, load), kernel, rtol=1e-7, atol=1e-10
    )
    assert np.abs(kernel).max() > 1e-4


@pytest.mark.parametrize("own", MEMORYLESS, ids=lambda own: own.name)
@pytest.mark.parametrize("q", [0.43, -0.27, 1.31, -1.1])
@pytest.mark.parametrize("v", [0.7, -0.35, 2.2, -1.9, 4e-6, 0.0])
def test_the_slopes_of_a_compiled_term_are_those_of_differences(own, q, v):
    _, by_speed, by_position = compiled_term(own, q, v)
    h = 1e-9 if abs(v) < 1e-5 else H  # friction turns over 1e-5 rad/s
    if not (v == 0.0 and isinstance(own, drives.Asymmetric | drives.Power)):  # they bend there
        slope = (compiled_term(own, q, v + h)[0] - compiled_term(own, q, v - h)[0]) / (2 * h)
        np.testing.assert_allclose(by_speed, slope, rtol=1e-5, atol=1e-7)
    slope = (compiled_term(own, q + H, v)[0] - compiled_term(own, q - H, v)[0]) / (2 * H)
    np.testing.assert_allclose(by_position, slope, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("own", LASTING, ids=lambda own: own.name)
@pytest.mark.parametrize("v", [0.7, -0.35, 0.04])
def test_what_bristles_take_up_is_one_in_regressor_plant_and_roll_out(own, v):
    model, pi = with_term(own)
    q, speeds, theta = np.array([0.4, -0.3]), np.array([v, -v]), pi[-2:]
    plant, size = RobotPlant(model, pi), model.layout.n_inertial
    _, x = coded_term(own)
    long = theta * [
        initial_deflection(np.array(x), w, 1e9)[0] for w in speeds
    ]  # it has moved for long
    Y = joint_torque_regressor(model, q[None], speeds[None], 0 * q[None])
    np.testing.assert_allclose(Y[:, size:] @ theta, long, atol=1e-12)
    friction = plant.friction(q, speeds)
    np.testing.assert_allclose(plant.friction_torque(friction, speeds, 0 * q), long, atol=1e-12)
    rate, end = plant.bristle_rate(speeds)
    x, z, span = np.array(x), 0.3, 0.01
    after, by_speed, by_before = deflection(x, z, v, span)
    assert after == pytest.approx(end[0] + (z - end[0]) * np.exp(-rate[0] * span), rel=1e-12)
    faster, slower = (deflection(x, z, w, span)[0] for w in (v + H, v - H))
    assert by_speed == pytest.approx((faster - slower) / (2 * H), rel=1e-6)
    more, less = (deflection(x, y, v, span)[0] for y in (z + H, z - H))
    assert by_before == pytest.approx((more - less) / (2 * H), rel=1e-6)
    (_, by_v), h = initial_deflection(x, v, 0.1), 1e-7
    slope = (initial_deflection(x, v + h, 0.1)[0] - initial_deflection(x, v - h, 0.1)[0]) / (2 * h)
    assert by_v == pytest.approx(slope, rel=1e-5)
