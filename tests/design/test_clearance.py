import numpy as np
import pytest

from robotid.design.clearance import _FIRST, Box, Clearance
from robotid.dynamics.simulation.motions import ProgramMotion, random_fourier
from robotid.robot.model import RobotModel

MASS = """<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>
</inertial>"""


def robot(folder, links, joints):
    """Return a robot of links (name, size of a box or "", its place) and joints in a chain."""
    words = []
    for name, size, place in links:
        box = f'<origin xyz="{place}"/><geometry><box size="{size}"/></geometry>'
        box = f"<collision>{box}</collision>" if size else ""
        words.append(f'<link name="{name}">{MASS if words else ""}{box}</link>')
    for (parent, *_), (child, *_), (kind, axis, reach, height) in zip(
        links[:-1], links[1:], joints, strict=True
    ):
        words.append(
            f'<joint name="{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            f'<limit lower="-{reach}" upper="{reach}" velocity="2" effort="100"/></joint>'
        )
    (folder / "robot.urdf").write_text(f'<robot name="robot">{"".join(words)}</robot>')
    return RobotModel.from_urdf(folder / "robot.urdf")


@pytest.fixture
def slider(tmp_path):
    """A slider that carries a ball past a post: distances are known by hand."""
    cube = "0.1 0.1 0.1"
    links = [("base", cube, "0 0 0"), ("car", "", ""), ("ball", cube, "0 0.5 0")]
    joints = [("prismatic", "1 0 0", 1, 0), ("revolute", "0 0 1", 3, 0)]
    return robot(tmp_path, links, joints)


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


def test_links_that_are_built_near_each_other_are_watched_and_those_that_touch_are_named(tmp_path):
    # a plate that tilts 15 mm above the base: nearer than the clearance in every pose, and its edge
    # hits the base if it tilts far; a pin of the plate goes through the base
    links = [
        ("base", "0.1 0.1 0.1", "0 0 0"), ("axle", "", ""), ("plate", "0.1 0.1 0.02", "0 0 0.01"),
        ("pin", "0.02 0.02 0.2", "0 0 0"),
    ]  # fmt: skip
    joints = [("revolute", "0 0 1", 1, 0), ("revolute", "1 0 0", 0.35, 0.065),
              ("revolute", "0 0 1", 1, 0)]  # fmt: skip
    clearance = Clearance(robot(tmp_path, links, joints), least=0.02)
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
            x, v = -0.1 + 0.2 * np.cos(w * t), -0.2 * w * np.sin(w * t)
            a = -0.2 * w**2 * np.cos(w * t)
            return tuple(np.column_stack([y, none]) for y in (x, v, a))

    contact = clearance.nearest(Swing(), 20 * h)
    assert {contact.first, contact.second} == {"ball", "post"}
    assert contact.distance < 0.0
    assert min(abs(contact.time - 2 * h * k) for k in range(11)) < 0.35 * h
