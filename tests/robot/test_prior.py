import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.robot.mass_matrix import carried_inertia
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia
from robotid.robot.prior import payload_spread, prior_spread


def test_a_massless_link_still_has_a_spread(rng, ur5):
    light = ur5.with_parameters(0 * ur5.standard_parameters())
    log = exact_log(ur5, truth(ur5), rng)
    trajectory = process(log, SignalSettings(cutoff=None, trim=0.0))
    assert (prior_spread(light, trajectory.squares, len(trajectory.t)) > 0).all()


def test_the_spread_is_what_the_docstring_says(ur5):
    rms = np.array([2.0, 3.0, 5.0])[:, None] * np.ones((3, 6))
    rms[0] *= np.arange(1, 7)  # each joint has its own torque
    squares, samples = 16 * rms**2, 16
    spread = dict(zip(ur5.layout.names, prior_spread(ur5, squares, samples), strict=True))
    inertial = ur5.tree.inertials["forearm_link"]
    mass, centre = inertial.mass, np.linalg.norm(ur5.standard_parameters()[21:24]) / inertial.mass
    J = pseudo_inertia(ur5.standard_parameters()[:60])[2]
    radius = centre + np.sqrt(np.trace(J[:3, :3]) / mass)
    assert spread["forearm_link.mcx"] == pytest.approx(mass * radius)
    assert spread["forearm_link.Ixx"] == pytest.approx(mass * radius**2)
    assert spread["elbow_joint.viscous"] == pytest.approx(6.0 / 3.0)
    assert spread["wrist_1_joint.coulomb"] == pytest.approx(8.0)
    carried = dict(zip(ur5.joints, carried_inertia(ur5), strict=True))
    heavy, light = "shoulder_lift_joint", "wrist_3_joint"
    assert carried[heavy] > 4.0 / 5.0
    assert carried[light] < 12.0 / 5.0
    assert spread[f"{heavy}.armature"] == pytest.approx(carried[heavy])
    assert spread[f"{light}.armature"] == pytest.approx(12.0 / 5.0)


def test_a_light_link_may_be_wrong_by_a_tenth_of_the_mean_mass(ur5):
    pi = ur5.standard_parameters()
    pi[20:30] *= 1e-6
    squares = np.ones((3, 6))
    spread = prior_spread(ur5.with_parameters(pi), squares, 1)
    assert spread[20] == pytest.approx(0.1 * pi[:60:10].mean(), rel=1e-6)


def test_the_spread_of_a_payload_is_the_robots_mass_at_its_length(ur5):
    mass, length = ur5.standard_parameters()[:60:10].sum(), ur5.length
    wanted = mass * np.array([1.0, *[length] * 3, *[length**2] * 6])
    assert abs(length - 1.0) > 0.05, "else its square is no other"
    np.testing.assert_allclose(payload_spread(ur5), wanted)
    light = ur5.with_parameters(0 * ur5.standard_parameters())
    np.testing.assert_allclose(payload_spread(light), 1e-3 * wanted / mass)


def test_the_spread_of_a_drive_of_several_joints_is_the_mean_of_theirs(ur5):
    ratios = (("wrist_2_joint", 1.0), ("elbow_joint", -2.0))
    model = RobotModel.from_urdf(ur5.tree.path, couplings=(Coupling("motor", ratios),))
    tau, v = np.arange(1.0, 7.0), 0.5 * np.arange(2.0, 8.0)
    squares = 9 * np.stack([tau, v, np.full(6, 3.0)]) ** 2
    spread = dict(zip(model.layout.names, prior_spread(model, squares, 9), strict=True))
    each = dict(zip(model.joints, tau / v, strict=True))
    assert spread["elbow_joint.viscous"] == pytest.approx(each["elbow_joint"])
    both = (each["elbow_joint"] + each["wrist_2_joint"]) / 2
    assert spread["motor.viscous"] == pytest.approx(both)
    assert spread["motor.coulomb"] == pytest.approx((3.0 + 5.0) / 2)
