import numpy as np
import pinocchio as pin
import pytest

from robotid.robot.bodies import (
    LinkPlace,
    central_inertial,
    held_parameters,
    least_density,
    link_places,
    principal_moments,
)
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel


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
      <inertial><origin xyz="0.1 0 0" rpy="0 0 1.5707963267948966"/><mass value="2"/>
      <inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="2.5"/></inertial></link>
      <joint name="j" type="continuous"><parent link="base"/><child link="arm"/></joint></robot>""")
    place = link_places(RobotModel.from_urdf(tmp_path / "r.urdf"))[1]
    # turned by 90 degrees about z, then moved by 0.1 m along x: 2 * 0.01 about y and z
    expected = [2, 0.2, 0, 0, 2, 0, 1.02, 0, 0, 2.52]
    np.testing.assert_allclose(place.parameters, expected, atol=1e-12)


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
