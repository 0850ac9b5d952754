import numpy as np
import pytest

from robotid.design.clearance import _FIRST, Box, Clearance
from robotid.dynamics.simulation.motions import ProgramMotion, random_fourier
from robotid.robot.model import RobotModel

# a slider that carries a ball past a post: distances are known by hand
SLIDER = """
<robot name="slider">
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="car"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial></link>
  <link name="ball"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial>
    <collision><origin xyz="0 0.5 0"/><geometry><box size="0.1 0.1 0.1"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="car"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="2" effort="100"/></joint>
  <joint name="turn" type="revolute"><parent link="car"/><child link="ball"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="2" effort="100"/></joint>
</robot>"""


@pytest.fixture
def slider(tmp_path):
    (tmp_path / "slider.urdf").write_text(SLIDER)
    return RobotModel.from_urdf(tmp_path / "slider.urdf")


def distances(clearance, q):
    return clearance.near(clearance.placed(np.atleast_2d(q)), 10.0, clearance.everything)


def test_distances_are_those_of_the_boxes(slider):
    post = Box("post", (0.3, 0.4, -0.2), (0.4, 0.6, 0.2))
    clearance = Clearance(slider, boxes=[post])
    near = distances(clearance, [[0.0, 0.0], [-0.2, 0.0], [0.33, 0.0]])
    # from the ball's face at x + 0.05 to the post's at 0.3; the base is 0.4 from the ball
    (ball_post,) = (k for k, p in enumerate(clearance.named) if p == ("ball", "post"))
    np.testing.assert_allclose(near.distance[ball_post, :2], [0.25, 0.45], atol=1e-6)
    assert near.distance[ball_post, 2] < 0
    (base_ball,) = (k for k, p in enumerate(clearance.named) if p == ("base", "ball"))
    assert near.distance[base_ball, 0] == pytest.approx(0.4, abs=1e-6)


def test_what_stands_beside_a_robot_may_meet_its_first_link_but_the_base_may_not(panda):
    post = Box("post", (0.2, -0.1, 0.0), (0.3, 0.1, 0.5))
    pairs = Clearance(panda, boxes=[post]).named
    assert ("panda_link1", "post") in pairs
    assert not {("panda_link0", "panda_link1"), ("panda_link0", "post")} & set(pairs)


def test_spheres_and_boxes_are_never_farther_apart_than_what_is_in_them(panda):
    clearance, rng = Clearance(panda, floor=-0.05), np.random.default_rng(6)
    q = rng.uniform(-1.5, 1.5, (40, len(panda.joints)))
    exact = distances(clearance, q).distance
    near = clearance.near(clearance.placed(q), 0.05, clearance.everything)
    assert (near.distance <= exact + 1e-6).all()
    is_near = exact < 0.05
    assert is_near.any()
    np.testing.assert_allclose(near.distance[is_near], exact[is_near], atol=1e-9)
    assert len(near.pairs) < 1.5 * is_near.sum()  # few of the others need an exact distance


def test_gradients_of_distances_are_those_of_differences(panda):
    clearance, rng = Clearance(panda, floor=-0.05), np.random.default_rng(5)
    low, high = np.array([(j.lower, j.upper) for j in panda.limits]).T
    q, d, h = rng.uniform(low, high, (20, 7)), rng.standard_normal(7), 1e-6
    near = clearance.near(clearance.placed(q), 0.2)
    up, down = (clearance.near(clearance.placed(q + s * h * d), 0.3).distance for s in (1, -1))
    at = near.pairs, near.samples
    slope = (up[at] - down[at]) / (2 * h)
    assert len(slope) > 50
    np.testing.assert_allclose(near.gradient @ d, slope, atol=1e-4)


def test_what_lies_between_samples_is_found(slider):
    # the ball passes a thin post in 30 ms, between samples that are all clear of it
    post = Box("post", (0.0, 0.4, -0.2), (0.001, 0.6, 0.2))
    clearance = Clearance(slider, boxes=[post])
    motion = ProgramMotion(np.array([1.8, 0.0]), 0.3, np.array([-0.9, 0.0]))
    coarse = clearance.near(
        clearance.placed(motion.evaluate(np.linspace(0.0, 0.3, 6))[0]), 0.0, clearance.everything
    )
    assert coarse.distance.min() > 0.0
    contact = clearance.nearest(motion, 0.3)
    assert {contact.first, contact.second} == {"ball", "post"}
    assert contact.distance < 0
    assert contact.time == pytest.approx(0.15, abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_place_is_a_lower_bound_within_a_millimetre(panda, seed):
    clearance = Clearance(panda, floor=-0.05)
    motion = random_fourier(panda, np.random.default_rng(seed))
    contact = clearance.nearest(motion, 3.0)
    q = motion.evaluate(np.linspace(0.0, 3.0, 3001))[0]
    dense = clearance.near(clearance.placed(q), 0.07, clearance.everything).distance.min(axis=1)
    margins = dense - clearance.required
    assert margins.min() - 2e-3 < contact.margin <= margins.min()
    pair = clearance.named.index((contact.first, contact.second))
    assert margins[pair] < margins.min() + 1e-4  # it is that pair, not one that has a lower bound


# a plate that tilts 15 mm above the base: nearer than the clearance in every pose, and its edge
# hits the base if it tilts far; a pin of the plate goes through the base
TILTED = """
<robot name="tilted">
  <link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
  <link name="axle"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial></link>
  <link name="plate"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial>
    <collision><origin xyz="0 0 0.01"/><geometry><box size="0.1 0.1 0.02"/></geometry></collision>
  </link>
  <link name="pin"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
    iyz="0"/></inertial>
    <collision><geometry><box size="0.02 0.02 0.2"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="axle"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2" effort="100"/></joint>
  <joint name="tilt" type="revolute"><parent link="axle"/><child link="plate"/>
    <origin xyz="0 0 0.065"/>
    <axis xyz="1 0 0"/><limit lower="-0.35" upper="0.35" velocity="2" effort="100"/></joint>
  <joint name="spin" type="revolute"><parent link="plate"/><child link="pin"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2" effort="100"/></joint>
</robot>"""


def test_links_that_are_built_near_each_other_are_watched_and_those_that_touch_are_named(tmp_path):
    (tmp_path / "tilted.urdf").write_text(TILTED)
    clearance = Clearance(RobotModel.from_urdf(tmp_path / "tilted.urdf"), least=0.02)
    # the pin's end is 35 + 50 mm deep in the base, 30 + 30 mm from its sides
    (touching,) = clearance.made_to
    assert touching.startswith("base and pin (overlap by ")
    assert int(touching.split()[-2]) == pytest.approx(60, abs=6)
    assert clearance.named == [("base", "plate")]
    tilts = np.random.default_rng(1).uniform(-0.35, 0.35, 2000)
    apart = 0.015 - 0.05 * np.sin(np.abs(tilts))
    usual = np.median(apart[apart > 1e-3])
    assert clearance.required == pytest.approx(usual / 2, abs=5e-4)
    assert clearance.slack == pytest.approx(usual / 2, abs=5e-4)
    assert clearance.built_near == [f"base and plate ({1e3 * clearance.required[0]:.0f} mm)"]
    assert clearance.likely.all()
    bare, reserved = (clearance.margins(clearance.placed(np.zeros((1, 3))), x) for x in (0.0, 1.0))
    np.testing.assert_allclose(bare - reserved, np.minimum(0.002, clearance.slack[:, None] / 4))
    far, less = (
        clearance.nearest(ProgramMotion(np.array([0.0, speed, 0.0]), 2.0, np.zeros(3)), 2.0)
        for speed in (0.3, 0.1)
    )
    assert {far.first, far.second} == {"base", "plate"}
    assert far.margin < 0.0 < less.margin
    assert far.required == clearance.required[0]


def test_a_motion_that_swings_between_the_first_samples_is_followed_by_its_acceleration(slider):
    clearance = Clearance(slider, boxes=[Box("post", (0.0, 0.4, -0.2), (0.1, 0.6, 0.2))])
    h = 0.5 * _FIRST  # the first instants that are looked at are its odd multiples

    class Swing:
        """A motion that is at rest at these instants, 0.25 m from the post, and in it between."""

        def evaluate(self, t):
            w, none = np.pi / h, np.zeros_like(t)
            x, v, a = (
                -0.1 + 0.2 * np.cos(w * t),
                -0.2 * w * np.sin(w * t),
                -0.2 * w**2 * np.cos(w * t),
            )
            return tuple(np.column_stack([y, none]) for y in (x, v, a))

    contact = clearance.nearest(Swing(), 20 * h)
    assert {contact.first, contact.second} == {"ball", "post"}
    assert contact.distance < 0.0
    assert min(abs(contact.time - 2 * h * k) for k in range(11)) < 0.35 * h
