"""Constraint forces eliminated from the rows, against Pinocchio's constraint dynamics."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.data.base_motion import BaseColumns
from robotid.data.log import Trajectory
from robotid.data.signal_settings import BaseSource
from robotid.dynamics.constraint_rows import (
    constrained,
    constraint_forces,
    constraint_jacobian,
    contact_links,
    force_basis,
    logged_base,
    without_forces,
)
from robotid.dynamics.factors import compress, compress_segments, merge
from robotid.dynamics.torque import build_problem, joint_torque_regressor, predict
from robotid.robot.constraints import Contact, Loop
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
LEGS = ("FL", "FR", "HL", "HR")


@pytest.fixture(scope="module")
def quadruped():
    """Return a quadruped whose joints are in another order, one foot a surface."""
    joints = [f"{leg}_{name}" for name in ("KFE", "HAA", "HFE") for leg in LEGS]
    contacts = [Contact(foot) for foot in FEET[:3]]
    contacts += [Contact(FEET[3], "surface", measured=("fz", "mx"), always=True)]
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), joints=joints, free_flyer=True, constraints=contacts,
        terms=("armature", "viscous"),
    )  # fmt: skip


def random_motion(model, rng, samples):
    """Return q, v and a of a robot whose base floats."""
    pose = rng.standard_normal((samples, 7))
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    n = len(model.joints)
    q = np.hstack([pose, rng.uniform(-1, 1, (samples, n))])
    return q, *rng.standard_normal((2, samples, 6 + n))


def trajectory(model, q, v, a, **more):
    values = {"tau": 0 * v, "rate": None, "segment": np.zeros(len(q), dtype=int)} | more
    return Trajectory(t=np.arange(float(len(q))), q=q, v=v, a=a, joints=model.joints, **values)


def moved(model, q, speed, step):
    """Return coordinates after a step at a speed."""
    start = model.configurations(q[None])[0]
    x = pin.integrate(model.pin_model, start, model.velocity_map @ speed * step)
    data = model.pin_model.createData()
    pin.framesForwardKinematics(model.pin_model, data, x)
    return data


def test_the_jacobian_is_the_velocity_of_the_feet(quadruped, rng):
    q, v, _ = random_motion(quadruped, rng, 3)
    flags = np.array([[1, 1, 0, 1], [0, 1, 1, 1], [1, 0, 1, 1]], dtype=bool)
    J = constraint_jacobian(quadruped, q, flags)
    assert J.shape == (3, 15, 18)
    for k in range(3):
        for i, foot in enumerate(FEET):
            frame = quadruped.pin_model.getFrameId(foot, pin.FrameType.BODY)
            before, after = (moved(quadruped, q[k], v[k], h).oMf[frame] for h in (-1e-6, 1e-6))
            own = J[k, 3 * i : 3 * i + 3] @ v[k]
            speed = (after.translation - before.translation) / 2e-6
            np.testing.assert_allclose(own, speed * flags[k, i], atol=1e-7)
        turned = pin.log3(after.rotation @ before.rotation.T) / 2e-6
        np.testing.assert_allclose(J[k, 12:] @ v[k], turned, atol=1e-7)


def test_the_force_on_a_round_foot_acts_below_its_frame(rng):
    """The velocity at the contact is that of the point of the foot which touches the ground."""
    contact = Contact(FEET[2], radius=0.03)
    options = {"free_flyer": True, "constraints": [contact], "terms": ()}
    model = RobotModel.from_urdf(example_urdf("solo12.urdf"), **options)
    q, v, _ = random_motion(model, rng, 1)
    (J,) = constraint_jacobian(model, q, np.ones((1, 1), dtype=bool))
    frame = model.pin_model.getFrameId(FEET[2], pin.FrameType.BODY)
    before, now, after = (moved(model, q[0], v[0], h).oMf[frame] for h in (-1e-6, 0.0, 1e-6))
    point = now.actInv(now.translation - np.array([0.0, 0.0, 0.03]))
    np.testing.assert_allclose(J @ v[0], (after.act(point) - before.act(point)) / 2e-6, atol=1e-7)


def test_a_wrench_with_the_axes_of_its_link(quadruped, rng):
    q, _, _ = random_motion(quadruped, rng, 2)
    flags = np.ones((2, 4), dtype=bool)
    contacts = ([replace(x, axes=y) for x in quadruped.constraints] for y in ("world", "link"))
    robots = (replace(quadruped, constraints=x) for x in contacts)
    world, own = (constraint_jacobian(robot, q, flags) for robot in robots)
    for k in range(2):
        data = moved(quadruped, q[k], np.zeros(18), 0.0)
        for i, foot in enumerate(FEET):
            R = data.oMf[quadruped.pin_model.getFrameId(foot, pin.FrameType.BODY)].rotation
            rows = slice(3 * i, 3 * i + 3)
            np.testing.assert_allclose(own[k, rows], R.T @ world[k, rows], atol=1e-12)
        np.testing.assert_allclose(own[k, 12:], R.T @ world[k, 12:], atol=1e-12)


def test_unknown_forces_have_no_effect_and_measured_ones_are_subtracted(
    quadruped, rng, monkeypatch
):
    q, v, a = random_motion(quadruped, rng, 7)
    flags = rng.random((7, 3)) < 0.7
    pi = quadruped.standard_parameters()
    pi[quadruped.layout.n_inertial :] = rng.uniform(0.1, 1.0, 24)
    rigid = (joint_torque_regressor(quadruped, q, v, a) @ pi).reshape(7, 18)
    touching = np.hstack([flags, np.ones((7, 1), dtype=bool)])
    J, f = constraint_jacobian(quadruped, q, touching), rng.standard_normal((7, 15))
    tau = rigid - np.einsum("kmj,km->kj", J, f)
    measured = [11, 12]  # fz and mx of the last foot
    known = {"contacts": flags, "wrenches": f[:, measured], "switching": np.arange(7) == 4}
    motion = trajectory(quadruped, q, v, a, tau=tau, **known)
    found, used = constrained(quadruped, motion, np.ones((7, 18), dtype=bool))
    (predicted,) = predict(quadruped, [pi], found)
    with pytest.raises(DataError, match="has contact flags of 4 contacts, expected 3, one for"):
        constrained(quadruped, replace(motion, contacts=touching), used)
    monkeypatch.setattr("robotid.dynamics.torque.BLOCK", 3)
    W = np.vstack([rows for rows, *_ in build_problem(quadruped, found).blocks()])
    np.testing.assert_allclose((W @ pi).reshape(7, 18), predicted, atol=1e-9)
    rest = np.arange(7) != 4
    np.testing.assert_allclose(found.tau[rest], predicted[rest], atol=1e-10)
    assert np.abs(found.tau).max() > 1.0
    own = tau + np.einsum("kmj,km->kj", J[:, measured], f[:, measured])
    np.testing.assert_allclose(found.loaded, own, atol=1e-12)
    assert not used[4].any()
    assert used[rest].all()
    bare = replace(motion, contacts=None, wrenches=None)
    _, used = constrained(replace(quadruped, constraints=()), bare, np.ones((7, 18), dtype=bool))
    np.testing.assert_array_equal(used, np.tile(rest[:, None], 18))
    unknown = np.linalg.matrix_rank(np.delete(J, measured, axis=1))
    np.testing.assert_allclose(np.sum(found.basis**2, axis=(1, 2))[[0, 1, 6]], unknown[[0, 1, 6]])


def test_forces_are_those_of_least_squares_over_the_rows_used(quadruped, rng):
    """Measured components are as measured; feet in the air have none."""
    q, v, a = random_motion(quadruped, rng, 3)
    flags = np.array([[1, 0, 1], [1, 1, 0], [0, 0, 1]], dtype=bool)
    torque, tau, projected = rng.normal(size=(3, 3, 18))
    wrenches = rng.normal(size=(3, 2))
    motion = trajectory(quadruped, q, v, a, tau=tau, contacts=flags, wrenches=wrenches)
    used = rng.random((3, 18)) < 0.8
    J = constraint_jacobian(quadruped, q, np.column_stack([flags, np.ones(3, dtype=bool)]))
    for own in (motion, replace(motion, basis=np.zeros((3, 18, 1)), tau=projected, loaded=tau)):
        found = constraint_forces(quadruped, own, torque, used)
        np.testing.assert_array_equal(found[:, [11, 12]], motion.wrenches)
        for k in range(3):
            A = np.delete(J[k], [11, 12], axis=0)[:, used[k]].T
            wanted = np.linalg.lstsq(A, (torque - tau)[k, used[k]], rcond=1e-10)[0]
            np.testing.assert_allclose(np.delete(found[k], [11, 12]), wanted, atol=1e-9)


def test_links_of_contacts_have_their_axes_and_turn_in_the_world(quadruped, rng):
    q, v, _ = random_motion(quadruped, rng, 2)
    rotation, turning = contact_links(quadruped, q)
    for k in range(2):
        before, now, after = (moved(quadruped, q[k], v[k], h) for h in (-1e-6, 0.0, 1e-6))
        for i, foot in enumerate(FEET):
            frame = quadruped.pin_model.getFrameId(foot, pin.FrameType.BODY)
            np.testing.assert_allclose(rotation[k, i], now.oMf[frame].rotation, atol=1e-12)
            w = pin.log3(after.oMf[frame].rotation @ before.oMf[frame].rotation.T) / 2e-6
            np.testing.assert_allclose(turning[k, i] @ v[k], w, atol=1e-7)


def test_without_torque_only_rows_of_the_base_are_used(quadruped, rng):
    q, v, a = random_motion(quadruped, rng, 2)
    air = {"contacts": np.zeros((2, 3), dtype=bool), "wrenches": np.zeros((2, 2))}
    motion = trajectory(quadruped, q, v, a, **air)
    found, used = constrained(quadruped, motion, np.ones((2, 18), dtype=bool), has_torque=False)
    assert used.tolist() == [[True] * 6 + [False] * 12] * 2
    assert not found.basis[:, 6:].any()  # a force on the base may not act through a joint
    ranks = [np.linalg.matrix_rank(basis) for basis in found.basis]
    assert ranks == [4, 4]  # fx, fy, my, mz


def test_rows_are_projected_and_counted(quadruped, rng):
    q, v, a = random_motion(quadruped, rng, 40)
    weight = rng.uniform(0.5, 2.0, (40, 18)) * (rng.random((40, 18)) < 0.9)
    weight[:, 9] = 0.0  # its torque is projected into other rows
    motion = trajectory(
        quadruped, q, v, a, tau=rng.standard_normal((40, 18)), contacts=rng.random((40, 3)) < 0.5,
        switching=np.zeros(40, dtype=bool), wrenches=rng.standard_normal((40, 2)),
    )  # fmt: skip
    found, used = constrained(quadruped, motion, np.ones((40, 18), dtype=bool))
    problem = build_problem(quadruped, found, used * weight)
    Y = joint_torque_regressor(quadruped, q, v, a).reshape(40, 18, -1)
    P = np.eye(18) - found.basis @ found.basis.swapaxes(1, 2)
    dense = np.concatenate([P @ Y, (P @ found.tau[..., None])], axis=2)
    dense *= np.sqrt(used * weight)[..., None]
    factors = compress(problem, threads=1)
    assert factors.is_projected
    assert [len(own) for own in factors.columns] == [0 if j == 9 else Y.shape[2] for j in range(18)]
    gram = np.einsum("kji,kjl->il", dense, dense)
    R = factors.weighted(np.ones(18))
    np.testing.assert_allclose(R.T @ R, gram, atol=1e-9 * np.abs(gram).max())
    assert all(own.is_projected for own in compress_segments(problem, 25))
    for j, R in enumerate(factors.R):
        rows = dense[:, j]
        np.testing.assert_allclose(R.T @ R, rows.T @ rows, atol=1e-9 * np.abs(rows).max() ** 2)
    left = np.einsum("kjj->kj", P)
    count = [left[(used * weight)[:, j] > 0, j].sum() for j in range(18)]
    assert factors.rows.tolist() == np.rint(count).astype(int).tolist()
    blocks = np.concatenate([W for W, _, _ in problem.blocks()]).reshape(40, 18, -1)
    np.testing.assert_allclose(blocks, P @ Y, atol=1e-12)
    both = merge([factors, factors.select(np.arange(len(factors.names)))])
    assert both.is_projected
    assert factors.select(np.arange(3)).is_projected
    level = both.noise_levels(np.zeros(len(both.names)), np.arange(18.0))
    tau = (dense[..., -1] ** 2).sum()
    np.testing.assert_allclose(level, np.sqrt(2 * tau / 153.0))  # 0 + 1 + ... + 17


def test_dependent_forces_are_counted_once(rng):
    """A link that touches at its frame and at that of a link fixed to it: six of twelve forces."""
    J = rng.standard_normal((2, 3, 6))
    both = np.concatenate([J, J[:, :2] + J[:, 1:]], axis=1)
    basis = force_basis(both, np.ones((2, 6), dtype=bool))
    np.testing.assert_allclose(np.sum(basis**2, axis=(1, 2)), 3.0)
    rows = rng.standard_normal((2, 6))
    left = without_forces(basis, rows)
    np.testing.assert_allclose(J @ left[..., None], 0.0, atol=1e-12)
    wanted = [x - A.T @ np.linalg.pinv(A.T) @ x for A, x in zip(J, rows, strict=True)]
    np.testing.assert_allclose(left, wanted, atol=1e-12)


def test_feet_that_press_against_each_other_do_not_hide_their_share_of_the_weight():
    """Horizontal forces of feet whose heights differ by a millimetre: one has hardly an effect."""
    feet = np.array([[0.01, 0.1, -0.6], [0.0, -0.1, -0.599]])
    moments = [pin.skew(x) for x in feet]
    whole = np.concatenate([np.hstack([np.eye(3), -m]) for m in moments])  # (6 forces, 6 rows)
    J = np.delete(whole, [2, 5], axis=0)[None]  # vertical forces are measured
    used = np.ones((1, 6), dtype=bool)
    share = whole[2] - whole[5]  # torque of weight that moves from foot to foot
    every, some = (force_basis(J, used, floats=x) for x in (False, True))
    assert [round(np.sum(B**2)) for B in (every, some)] == [4, 3]
    left = [np.linalg.norm(without_forces(B, share[None])) for B in (every, some)]
    assert left[0] < 0.01
    assert left[1] == pytest.approx(0.2 / np.sqrt(1 + 0.6**2), rel=0.01)  # seen from the ground
    # with rows of joints, each force has an effect of its own
    joints = np.concatenate([J, 0.1 * np.eye(4)[None]], axis=2)
    basis = force_basis(joints, np.ones((1, 10), dtype=bool), floats=True)
    assert round(np.sum(basis**2)) == 4


def test_contacts_state_what_logs_have(quadruped):
    wanted = BaseColumns(True, FEET[:3], ("fz HR_FOOT", "mx HR_FOOT"), "world", (None,) * 3)
    assert logged_base(quadruped, BaseSource(twist="world")) == wanted
    contacts = [Contact("FR_FOOT", always=True, threshold=2.0), Contact("HL_FOOT", threshold=7.0),
                Contact("FL_FOOT", axes="link", threshold=5.0)]  # fmt: skip
    found = logged_base(replace(quadruped, constraints=contacts))
    assert [found.local, found.contacts] == [("FL_FOOT",), ("HL_FOOT", "FL_FOOT")]
    assert found.thresholds == (7.0, 5.0)
    with pytest.raises(ModelError, match=r"imu in .base. is 'imu', which is not a link of solo"):
        logged_base(quadruped, BaseSource(imu="imu"))
    with pytest.raises(ModelError, match="'FL_FOOT', which moves relative to the root link 'base_"):
        logged_base(quadruped, BaseSource(imu="FL_FOOT"))
    frame = logged_base(quadruped, BaseSource(imu="base_link")).imu
    np.testing.assert_allclose(frame.quaternion, [0, 0, 0, 1])
    np.testing.assert_allclose(frame.gravity, [0, 0, -9.81])


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        (lambda: Contact("a", "line"), "'a': kind is 'line', expected one of point, surface"),
        (lambda: Contact("a", measured=("mx",)), "measured of the point contact 'a' has 'mx'"),
        (lambda: Contact("a", measured=("fx", "fx")), "some of fx, fy, fz, each once"),
        (lambda: Contact("a", radius=-0.1), "radius is -0.1, expected a length [m], at least 0"),
        (lambda: Contact("a", axes="foot"), "'a': axes is 'foot', expected one of world, link"),
        (lambda: Contact("a", threshold="x"), "'a': threshold is 'x', expected a force [N]"),
        (lambda: Contact("a", "surface", radius=0.1), "radius of the surface contact 'a' is 0.1"),
        (lambda: Contact("a", radius="2 cm"), "'a': radius is '2 cm', expected a length [m]"),
        (lambda: Loop(("a", "a")), "loop has the frames a, a, expected two links"),
        (lambda: Loop(("a", "b"), axis=(0, 0, 0)), "is (0, 0, 0), expected x, y, z"),
    ],
)
def test_wrong_constraints_are_refused(contact, message):
    with pytest.raises(SettingsError) as error:
        contact()
    assert message in str(error.value)


def test_a_contact_of_an_unknown_link_is_refused():
    urdf = example_urdf("solo12.urdf")
    words = r"'FL_FOTO', which is not a link of solo12.urdf.*'FL_FOOT'"
    with pytest.raises(ModelError, match=words):
        RobotModel.from_urdf(urdf, free_flyer=True, constraints=[Contact("FL_FOTO")])
    with pytest.raises(ModelError, match="the contact or loop at FL_FOOT is given twice"):
        RobotModel.from_urdf(urdf, constraints=[Contact("FL_FOOT"), Contact("FL_FOOT", "surface")])
