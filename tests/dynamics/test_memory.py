"""How drives move along a trajectory: segment by segment, under the load of the bodies."""

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import motion

from robotid.data.log import Trajectory
from robotid.dynamics.torque import drive_motion_along, is_loaded, remember
from robotid.robot.drives import Lag, LoadFriction, Presliding
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

JOINTS = ("shoulder_lift_joint", "elbow_joint", "wrist_1_joint")


def motion_of(t, segment):
    w, phase = np.array([1.3, 2.1, 3.4]), np.array([0.2, 1.0, -0.5])
    x = np.outer(t, w) + phase
    q, v, a = np.sin(x), w * np.cos(x), -(w**2) * np.sin(x)
    return Trajectory(t, q, v, a, 0 * q, JOINTS, None, segment)


def test_drives_are_loaded_by_the_bodies_and_their_stretches_begin_anew():
    model = RobotModel.from_urdf(
        example_urdf("ur5_robot.urdf"), joints=JOINTS, own_terms={JOINTS[1]: (LoadFriction(),)}
    )
    pi = model.standard_parameters()
    drives = dict(zip(model.layout.names, range(len(pi)), strict=True))
    for name, x in (("armature", 0.4), ("viscous", 2.0), ("coulomb", 1.5), ("load", 0.3)):
        pi[drives[f"{JOINTS[1]}.{name}"]] = x
    model = model.with_reference(pi)
    t = 4.0 + np.concatenate([np.arange(400), 900 + np.arange(300), [2000]]) / 500
    motion = motion_of(t, np.repeat([2, 7, 8], [400, 300, 1]))
    found = drive_motion_along(model, motion)
    assert np.flatnonzero(found.begins).tolist() == [0, 400, 700]
    assert not found.rate[:, 700].any(), "one sample shows no change"
    engine, data = model.with_parameters(pi).pin_model, model.pin_model.createData()
    rows = zip(model.configurations(motion.q), motion.v, motion.a, strict=True)
    load = np.array([pin.rnea(engine, data, *row) for row in rows])
    np.testing.assert_allclose(found.load, load.T, atol=1e-9)
    v, a = motion.v[:, 1], motion.a[:, 1]
    friction = 0.4 * a + 2.0 * v + np.sign(v) * (1.5 + 0.3 * np.abs(load[:, 1]))
    whole = load.copy()
    whole[:, 1] += friction
    for part in (slice(0, 400), slice(400, 700)):
        rate = np.gradient(whole[part], t[part], axis=0)
        np.testing.assert_allclose(found.rate[:, part], rate.T, atol=1e-6)


@pytest.mark.parametrize(
    ("terms", "depends"),
    [((Presliding(),), False), ((LoadFriction(),), True), ((Lag(), Presliding()), True)],
)
def test_bristles_alone_remember_the_same_whatever_the_bodies_weigh(ur5, rng, terms, depends):
    model = ur5.with_terms(dict(zip(ur5.joints[1:], [(term,) for term in terms], strict=False)))
    assert is_loaded(model) is depends
    trajectory, pi = motion(model, rng, 50), model.standard_parameters()
    light, heavy = (remember(model.with_reference(x * pi), trajectory).memory for x in (1.0, 2.0))
    assert np.array_equal(light, heavy) is not depends


def test_motions_that_were_kept_are_not_those_of_another_reference(ur5, rng):
    model = ur5.with_terms({JOINTS[1]: (LoadFriction(), Lag())})
    m = motion(ur5, rng, samples=40)
    pi = model.standard_parameters()
    pi[model.layout.n_inertial :] = 0.5
    factors = np.where(np.arange(len(pi)) < model.layout.n_inertial, 2, 3)
    heavier = model.with_reference(factors * pi)
    first, again = (drive_motion_along(model.with_reference(pi), m) for _ in range(2))
    assert first is again
    other = drive_motion_along(heavier, m)
    np.testing.assert_allclose(other.load, 2 * first.load)
    alone = drive_motion_along(heavier, motion(ur5, np.random.default_rng(1), samples=40))
    assert not np.allclose(alone.load, other.load), "of another trajectory"
    assert not drive_motion_along(heavier, m, has_rate=False).rate.any()
    assert drive_motion_along(heavier, m).rate.any()
