import numpy as np
import pinocchio as pin
import pytest
from helpers.synthetic import exact_log, truth

from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process
from robotid.robot.bodies import (
    LinkPlace,
    central_inertial,
    held_parameters,
    least_density,
    link_places,
    principal_moments,
)
from robotid.robot.examples import example_urdf
from robotid.robot.mass_matrix import carried_inertia
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia
from robotid.robot.prior import payload_spread, prior_spread


@pytest.mark.parametrize("free_flyer", [False, True])
@pytest.mark.parametrize("name", ["panda.urdf", "talos_reduced.urdf", "tiago_no_hand.urdf"])
def test_the_links_of_a_body_add_up_to_it(name, free_flyer):
    model = RobotModel.from_urdf(example_urdf(name), free_flyer=free_flyer)
    total = np.zeros((len(model.layout.bodies) + 1, 10))
    for place in link_places(model):
        total[place.body] += place.parameters
    expected = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    np.testing.assert_allclose(total[:-1], expected, atol=1e-9)


def test_the_inertia_of_a_link_is_moved_from_its_turned_frame(tmp_path):
    (tmp_path / "r.urdf").write_text("""<robot name="r"><link name="base"/><link name="arm">
      <inertial><origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.7 1.2"/><mass value="2"/>
      <inertia ixx="1" ixy="0.1" ixz="-0.2" iyy="2" iyz="0.3" izz="2.5"/></inertial></link>
      <joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>""")
    place = link_places(RobotModel.from_urdf(tmp_path / "r.urdf"))[1]
    at = pin.SE3(pin.rpy.rpyToMatrix(0.4, -0.7, 1.2), np.array([0.1, -0.2, 0.3]))
    moments = np.array([[1.0, 0.1, -0.2], [0.1, 2.0, 0.3], [-0.2, 0.3, 2.5]])
    moved = at.act(pin.Inertia(2.0, np.zeros(3), moments))
    np.testing.assert_allclose(place.parameters, moved.toDynamicParameters(), atol=1e-12)


def test_links_behind_a_locked_joint_are_held(panda):
    role = {place.link: place.role for place in link_places(panda)}
    assert role["panda_link7"] == "moved"
    assert role["panda_hand"] == "fixed"
    assert role["panda_leftfinger"] == "held"
    fingers = RobotModel.from_urdf(panda.tree.path).tree.inertials["panda_leftfinger"].mass
    held = held_parameters(panda).reshape(-1, 10)
    assert held[-1, 0] == pytest.approx(2 * fingers)
    assert not held[:-1].any()


@pytest.mark.parametrize(
    ("body", "role", "is_lumped"),
    [(0, "fixed", True), (3, "fixed", True), (-1, "fixed", False), (0, "moved", False),
     (3, "held", False)],
)  # fmt: skip
def test_the_mass_of_links_fixed_to_moved_ones_is_lumped(body, role, is_lumped):
    assert LinkPlace("tool", body, role, np.zeros(10)).is_lumped is is_lumped


def test_the_least_density_of_a_body_is_that_of_its_ellipsoid():
    m, a = 3.0, np.array([0.1, 0.2, 0.05])  # [kg], [m] semi-axes
    x, y, z = m * a**2 / 5.0
    c = np.array([0.3, -0.1, 0.2])
    inertia = np.diag([y + z, z + x, x + y]) + m * (c @ c * np.eye(3) - np.outer(c, c))
    Ixx, Ixy, Ixz, Iyy, Iyz, Izz = inertia[np.triu_indices(3)]
    pi = np.array([m, *(m * c), Ixx, Ixy, Iyy, Ixz, Iyz, Izz])
    assert least_density(pi) == pytest.approx(m / (4.0 / 3.0 * np.pi * a.prod()))
    assert least_density(np.zeros(10)) == 0.0
    assert least_density(np.array([1.0, *np.zeros(9)])) == np.inf


def test_principal_moments_are_those_of_a_turned_body():
    moments = np.array([0.02, 0.05, 0.11])  # second moments of mass along its axes
    turns = np.random.default_rng(0).uniform(-3.0, 3.0, (12, 3))  # axes as found are of either hand
    for order, turn in zip(4 * ([0, 1, 2], [2, 0, 1], [1, 0, 2]), turns, strict=True):
        turned = pin.rpy.rpyToMatrix(*turn)
        own = moments[order]
        I = turned @ np.diag(own.sum() - own) @ turned.T  # noqa: E741
        c, m = np.array([0.2, -0.3, 0.1]), 2.5
        found, axes = principal_moments(pin.Inertia(m, c, I).toDynamicParameters())
        np.testing.assert_allclose(found, moments, atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        S = turned @ np.diag(own) @ turned.T
        np.testing.assert_allclose(axes @ np.diag(found) @ axes.T, S, atol=1e-12)
        stated = central_inertial(pin.Inertia(m, c, I).toDynamicParameters())
        assert (stated.mass, stated.rpy) == (pytest.approx(m), (0.0, 0.0, 0.0))
        np.testing.assert_allclose(stated.com, c)
        np.testing.assert_allclose(stated.inertia, I[np.triu_indices(3)], atol=1e-12)


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
