"""Motions on the feet against Pinocchio, closed forms and finite differences."""

import re
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from helpers.walkers import TALOS

from robotid.exceptions import SettingsError
from robotid.excitation.basis import FourierBasis
from robotid.excitation.design import Designer
from robotid.excitation.limits import MotionLimits
from robotid.excitation.multipliers import Multipliers
from robotid.excitation.standing import BASE, standing
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.constraints import constraint_jacobian
from robotid.robot.constraints import Contact
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
POSTURE = {f"{foot[:2]}_{x}_joint": q for foot in FEET for x, q in (("thigh", 0.8), ("calf", -1.6))}
CROUCH = {
    f"leg_{side}_{k}_joint": x
    for side in ("left", "right")
    for k, x in ((3, -0.6), (4, 1.2), (5, -0.6))
}
SOLES = {foot: (-0.1, -0.06, 0.12, 0.05, -0.02) for foot in TALOS.feet}


def quadruped(**options):
    return RobotModel.from_urdf(
        example_urdf("go1.urdf"), free_flyer=True, constraints=[Contact(foot) for foot in FEET],
        terms=("armature", "viscous"), **options,
    )  # fmt: skip


@pytest.fixture(scope="module")
def stand():
    """Return Go1 on three feet."""
    return standing(quadruped(), posture=POSTURE, lifted=["FR_foot"], soles={}, friction=0.6)


def two_legs():
    joints = [joint for joint in TALOS.model.joints if joint.startswith(("leg", "torso"))]
    return RobotModel.from_urdf(
        example_urdf(TALOS.urdf), free_flyer=True, joints=joints, terms=("viscous",),
        constraints=[Contact(foot, "surface") for foot in TALOS.feet],
    )  # fmt: skip


@pytest.fixture(scope="module")
def biped():
    return standing(two_legs(), posture=CROUCH, soles=SOLES, friction=0.7)


def moved(stand, rng, count=3):
    """Return random motions of the free coordinates, shape (count, k) each."""
    size = (count, len(stand.feet.free))
    x = stand.feet.posture[stand.feet.free] + 0.05 * rng.standard_normal(size)
    return x, 0.5 * rng.standard_normal(size), 2.0 * rng.standard_normal(size)


def information(stand):
    mapping = structural_mapping(stand.robot)
    pi = stand.model.standard_parameters()
    pi[stand.model.layout.n_inertial :] = 0.1
    return stand.information(mapping, pi)


def floating(stand, motion):
    """Return Pinocchio's configurations, v and a of the robot whose base floats."""
    log = stand.log(motion, np.arange(len(motion[0])) / 100.0, "motion")
    q = stand.robot.configurations(np.hstack([log.base.pose, log.q]))
    return q, np.hstack([log.base.twist, log.v]), np.hstack([log.base.acceleration, log.a])


@pytest.mark.parametrize("robot", ["stand", "biped"])
def test_feet_stay_in_place_by_pinocchio(robot, request, rng):
    stand = request.getfixturevalue(robot)
    motion = stand.feet.along(*moved(stand, rng))
    q, v, a = floating(stand, motion[:3])
    model, data = stand.robot.pin_model, stand.robot.pin_model.createData()
    ids = [model.getFrameId(x.frame, pin.FrameType.BODY) for x in stand.feet.contacts]
    size, axes, places = 3 if robot == "stand" else 6, pin.LOCAL_WORLD_ALIGNED, []
    for state in zip(q, v, a, strict=True):
        pin.forwardKinematics(model, data, *state)
        pin.updateFramePlacements(model, data)
        places.append([data.oMf[i].copy() for i in ids])
        for i in ids:
            speed = pin.getFrameVelocity(model, data, i, axes).vector[:size]
            change = pin.getFrameClassicalAcceleration(model, data, i, axes).vector[:size]
            np.testing.assert_allclose(speed, 0.0, atol=1e-9)
            np.testing.assert_allclose(change, 0.0, atol=1e-8)
    for k, own in enumerate(zip(*places, strict=True)):
        for place in own:
            np.testing.assert_allclose(place.translation, own[0].translation, atol=1e-9)
            if size == 6:  # level, at the height of the sole
                np.testing.assert_allclose(place.rotation, own[0].rotation, atol=1e-9)
                np.testing.assert_allclose(place.rotation[2], [0.0, 0.0, 1.0], atol=1e-9)
        height = 0.0 if size == 3 else 0.02
        np.testing.assert_allclose(own[0].translation[2], height, atol=1e-9, err_msg=str(k))
    assert np.abs(v[:, :6]).max() > 0.1
    assert np.ptp(q[:, :3], axis=0).min() > 0.01


@pytest.mark.parametrize("robot", ["stand", "biped"])
def test_forces_and_torques_satisfy_pinocchios_dynamics(robot, request, rng):
    stand = request.getfixturevalue(robot)
    info = information(stand)
    rows = info.rows(*moved(stand, rng))
    f, tau = info.forces(rows), info.torque(rows)
    q, v, a = floating(stand, rows.motion)
    model, data = stand.robot.pin_model, stand.robot.pin_model.createData()
    layout = stand.robot.layout
    drives = np.zeros_like(tau[:, 6:])
    for k, name in enumerate(layout.names[layout.n_inertial :]):
        joint, _, term = name.rpartition(".")
        j = layout.joints.index(joint)
        drives[:, j] += 0.1 * (a if term == "armature" else v)[:, 6 + j]
        assert k >= 0
    corners = [(0, 0, 0)] if robot == "stand" else [
        (x, y, -0.02) for x in (-0.1, 0.12) for y in (-0.06, 0.05)
    ]  # fmt: skip
    for k in range(len(q)):
        left = pin.rnea(model, data, q[k], v[k], a[k])
        left[6:] += drives[k]
        pin.computeJointJacobians(model, data, q[k])
        point = 0
        for contact in stand.feet.contacts:
            i = model.getFrameId(contact.frame, pin.FrameType.BODY)
            J = pin.getFrameJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED)
            place = pin.updateFramePlacement(model, data, i)
            for corner in corners:
                arm = place.rotation @ np.array(corner, dtype=float)
                left -= (J[:3] - pin.skew(arm) @ J[3:]).T @ f[k, point]
                point += 1
        np.testing.assert_allclose(left[:6], 0.0, atol=1e-9)
        np.testing.assert_allclose(tau[k, 6:], left[6:], atol=1e-9)
        np.testing.assert_allclose(tau[k, :6], 0.0, atol=1e-9)
        assert f.shape[1] == point


def test_rows_are_those_of_identification_up_to_the_axes_of_the_base(stand, rng):
    info = information(stand)
    rows = info.rows(*moved(stand, rng))
    q, _, _ = floating(stand, rows.motion)
    flags = np.array([[x in stand.feet.contacts for x in stand.robot.contacts]] * len(q))
    J = constraint_jacobian(stand.robot, q, flags)
    kept = [k for k in range(12) if flags[0, k // 3]]
    own = stand.feet.jacobian(rows.support.placed)
    np.testing.assert_allclose(own[:, :, 6:], J[:, kept, 6:], atol=1e-9)
    left = np.einsum("krj,jbk->rbk", own, rows.W)
    np.testing.assert_allclose(left, 0.0, atol=1e-9)
    # the projection leaves out forces of the feet only
    whole = np.moveaxis(rows.W, 2, 0) @ info.beta
    np.testing.assert_allclose(whole, _projected(own, info.torque(rows)), atol=1e-8)


def _projected(J, torque):
    return np.array(
        [w - A.T @ np.linalg.lstsq(A.T, w, rcond=None)[0] for A, w in zip(J, torque, strict=True)]
    )


@pytest.mark.parametrize("robot", ["stand", "biped"])
def test_gradients_are_those_of_finite_differences(robot, request, rng):
    stand = request.getfixturevalue(robot)
    info, state = information(stand), moved(stand, rng, 2)
    rows = info.rows(*state)
    by_W, by_torque = rng.standard_normal(rows.W.shape), rng.standard_normal(rows.motion[0].shape)
    by_motion = tuple(rng.standard_normal(by_torque.shape) for _ in range(3))
    by_margins = rng.standard_normal((info.constraints, 2))

    def value(*state):
        rows = info.rows(*state)
        total = np.sum(rows.W * by_W) + np.sum(info.torque(rows) * by_torque)
        total += sum(np.sum(x * y) for x, y in zip(rows.motion, by_motion, strict=True))
        return total + np.sum(info.margins(rows) * by_margins)

    gradient, h = info.gradient(rows, by_W, by_torque, by_motion, by_margins), 1e-6
    for k in range(3):
        way = rng.standard_normal(state[k].shape)
        ahead, behind = (
            value(*[x + sign * h * way if i == k else x for i, x in enumerate(state)])
            for sign in (1.0, -1.0)
        )
        scale = np.linalg.norm(gradient[k])
        np.testing.assert_allclose(
            np.sum(gradient[k] * way), (ahead - behind) / (2 * h), atol=1e-6 * scale
        )


def test_the_lagrangian_of_a_stand_has_its_own_gradient(stand, rng):
    designer = Designer.of_model(
        stand.model,
        FourierBasis(4.0, 2),
        MotionLimits.of_model(stand.model, share=0.8),
        stand=stand,
    )
    C = designer.random(rng)
    C[1:] *= 1.4  # beyond limits and cones
    multipliers = Multipliers(0.1)
    _, gradient = designer._lagrangian(C, multipliers)
    way = rng.standard_normal(C.shape)
    ahead, behind = (designer._lagrangian(C + x * way, multipliers)[0] for x in (1e-6, -1e-6))
    np.testing.assert_allclose(np.sum(gradient * way), (ahead - behind) / 2e-6, rtol=1e-4)
    used, margin, _ = designer._constraints(C)
    assert margin < 0.0 or np.abs(used).max() > 1.0
    feasible = designer.checked(C)
    assert feasible.used.max() <= 1.0
    rows = designer.along(*feasible.motion.evaluate(np.linspace(0.0, 4.0, 200)))
    assert designer.information.margins(rows).min() >= 0.0


def test_loads_of_a_stand_on_a_slope_are_those_of_statics():
    slope, g = 0.2, 9.81
    robot = quadruped(gravity=(g * np.sin(slope), 0.0, -g * np.cos(slope)))
    stand = standing(robot, posture=POSTURE, soles={}, friction=np.tan(slope))
    info, x = (
        information(stand),
        stand.feet.posture[None, stand.feet.free] + [[0.01, 0.02, 0.0, 0.0, 0.0, 0.0]],
    )
    rows = info.rows(x, 0.0 * x, 0.0 * x)
    (f,) = info.forces(rows)
    q, _, _ = floating(stand, [np.repeat(z, 2, axis=0) for z in rows.motion])
    model, data = robot.pin_model, robot.pin_model.createData()
    centre = pin.centerOfMass(model, data, q[0])
    pin.framesForwardKinematics(model, data, q[0])
    feet = np.array(
        [data.oMf[model.getFrameId(foot, pin.FrameType.BODY)].translation for foot in FEET]
    )
    half = (feet - feet.mean(axis=0))[0, :2]
    along = centre[0] - feet[:, 0].mean() + centre[2] * np.tan(slope)  # centre of pressure
    beside = centre[1] - feet[:, 1].mean()
    normal = stand.ground.weight * np.cos(slope) / 4.0
    assert stand.ground.weight == pytest.approx(pin.computeTotalMass(model) * g, rel=1e-12)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    wanted = normal * (1.0 + signs @ (np.array([along, beside]) / half))
    np.testing.assert_allclose(f[:, 2], wanted, rtol=1e-9)
    # the yaw moment of weight beside the middle turns the tangential forces
    np.testing.assert_allclose(f[:, 0].sum(), -4.0 * normal * np.tan(slope), rtol=1e-9)
    margins = info.margins(rows)[:, 0]
    np.testing.assert_allclose(margins[:4], wanted / stand.ground.mean - 0.1, rtol=1e-9)
    rubbing = np.tan(slope) * wanted - np.linalg.norm(f[:, :2], axis=1)
    np.testing.assert_allclose(margins[4:8], rubbing / stand.ground.mean, atol=1e-6)
    assert margins[4:8].sum() == pytest.approx(0.0, abs=0.02)  # together just at the cone
    assert margins[8] == 1.0


def test_the_first_centre_of_mass_is_above_the_middle_of_the_soles(biped):
    """The soles reach farther to the front, 0.12 m, than to the back, 0.1 m."""
    q = np.tile(biped.feet.posture, (2, 1))
    placed = biped.feet.placed(q)
    points = np.array([placed.position(point)[0] for point in biped.ground.points])
    own, *_ = floating(biped, (q, 0.0 * q, 0.0 * q))
    centre = pin.centerOfMass(biped.robot.pin_model, biped.robot.pin_model.createData(), own[0])
    np.testing.assert_allclose(centre[:2], points.mean(axis=0)[:2], atol=1e-3)


def test_the_centre_of_pressure_of_flat_feet_is_below_the_centre_of_mass(biped):
    info = information(biped)
    x = np.repeat(biped.feet.posture[None, biped.feet.free], 3, axis=0)
    x[1:, :2] += [[0.04, 0.0], [0.0, 0.05]]
    rows = info.rows(x, 0.0 * x, 0.0 * x)
    f = info.forces(rows)
    q, _, _ = floating(biped, rows.motion)
    data, placed = biped.robot.pin_model.createData(), rows.support.placed
    points = np.array([placed.position(point) for point in biped.ground.points])
    for k in range(3):
        centre = pin.centerOfMass(biped.robot.pin_model, data, q[k])
        pressure = f[k, :, 2] @ points[:, k] / f[k, :, 2].sum()
        np.testing.assert_allclose(pressure[:2], centre[:2], atol=1e-9)
    found = biped.ground.smallest(f, np.array([0.0, 1.0, 2.0]))
    assert set(found) == {"vertical force", "friction", "centre of pressure"}
    corners = f[:, :, 2].reshape(3, 2, 2, 2)  # both feet; back and front; right and left
    share = corners[:, :, 1].sum(axis=2) / corners.sum(axis=(2, 3))
    side = corners[:, :, :, 1].sum(axis=2) / corners.sum(axis=(2, 3))
    margins = 1.0 - np.abs(2.0 * np.stack([share, side]) - 1.0)
    entry = found["centre of pressure"]
    assert entry["margin"] == pytest.approx(margins.min())
    assert entry["margin"] < 0.7
    assert entry["time"] == 1.0 + (np.argmin(margins.min(axis=(0, 2))) == 2)
    edge = 1e3 * entry["margin"] * (0.11 if margins[0].min() < margins[1].min() else 0.055)
    assert entry["words"] == f"{edge:.0f} mm from the edge"
    load = found["vertical force"]
    least, mean = f[..., 2].min(), biped.ground.weight / 8.0
    assert load["margin"] == pytest.approx(least / mean - 0.1)
    assert load["words"] == f"{least:.3g} N, wanted {0.1 * mean:.3g} N or more"
    pushed = f + np.array([3.0, -7.0, 0.0]) * np.arange(1.0, 9.0)[:, None]
    friction = replace(biped.ground, friction=0.7).smallest(pushed, np.array([4.0, 5.0, 6.0]))
    used = np.hypot(pushed[..., 0], pushed[..., 1]) / pushed[..., 2]
    row, point = np.unravel_index(used.argmax(), used.shape)
    assert friction["friction"] == {
        "margin": pytest.approx(1.0 - used.max() / 0.7), "where": biped.ground.names[point],
        "time": 4.0 + row, "words": f"{used.max():.2f}, wanted 0.70 or less",
    }  # fmt: skip


def test_a_squat_is_a_motion_of_base_and_joints(stand):
    rng, t = np.random.default_rng(3), np.array([0.5, 1.0, 1.7])
    designer = Designer.of_model(
        stand.model, FourierBasis(4.0, 2), MotionLimits.of_model(stand.model), stand=stand
    )
    motion, h = designer.checked(designer.random(rng)).motion, 1e-5
    log, before, after = (stand.log(motion.evaluate(t + x), t + x, "motion") for x in (0.0, -h, h))
    model = stand.robot.pin_model
    for k in range(len(t)):
        q = [np.r_[x.base.pose[k], x.q[k]] for x in (before, after)]
        found = pin.difference(model, *q) / (2 * h)
        np.testing.assert_allclose(np.r_[log.base.twist[k], log.v[k]], found, atol=1e-7)
    for name in ("twist", "acceleration"):
        assert np.abs(getattr(log.base, name)).min(axis=0).max() > 1e-3
    change = (after.base.twist - before.base.twist) / (2 * h)
    np.testing.assert_allclose(log.base.acceleration, change, atol=1e-6)
    assert not log.contacts["FR_foot"].any()
    assert log.contacts["RL_foot"].all()
    assert stand.model.joints[:6] == BASE


def test_what_cannot_stand_is_refused():
    model, usual = quadruped(), {"posture": POSTURE, "soles": {}, "friction": 0.5}

    def refused(words, robot=model, **stated):
        with pytest.raises(SettingsError, match=re.escape(words)):
            standing(robot, **usual | stated)

    refused("lifted is stated for 'FL_fot', wanted one of FL_foot", lifted=["FL_fot"])
    refused("2 points of contact are on the ground (RL_foot, RR_foot)", lifted=FEET[:2])
    bent = POSTURE | {"FL_calf_joint": 0.5}
    refused("posture of FL_calf_joint is 0.5, wanted -2.818 to -0.888", posture=bent)
    rolling = replace(model, constraints=(Contact(FEET[0], radius=0.02), *model.constraints[1:]))
    refused("FL_foot has the radius 0.02 m: feet that roll", rolling)
    flat = replace(model, constraints=tuple(Contact(foot, "surface") for foot in FEET))
    refused("FL_foot is a surface of unknown size", flat)
    soles = {foot: (-0.1, -0.1, 0.1, 0.1, 0.0) for foot in FEET}
    refused("24 conditions, of which the 12 joints of the legs satisfy 12", flat, soles=soles)


@pytest.mark.parametrize(("width", "is_refused"), [(9e-4, True), (1.1e-3, False)])
def test_a_robot_does_not_stand_on_a_line(width, is_refused):
    own, other = TALOS.feet
    stated = {"posture": CROUCH, "lifted": [other], "friction": 0.7,
              "soles": {own: (-0.1, -0.06, 0.12, -0.06 + width, -0.02)}}  # fmt: skip
    if not is_refused:
        assert len(standing(two_legs(), **stated).ground.points) == 4
        return
    with pytest.raises(SettingsError, match=f"^the points of contact of {own} are on a line, on"):
        standing(two_legs(), **stated)


def test_noise_of_the_joints_is_spread_over_the_rows_of_base_and_joints(stand):
    joints = stand.robot.joints
    std = np.linspace(0.5, 2.0, len(joints))
    designer = Designer.of_model(
        stand.model, FourierBasis(4.0, 2), MotionLimits.of_model(stand.model), stand=stand,
        noise=dict(zip(joints, std.tolist(), strict=True)), correlation=0.2,
    )  # fmt: skip
    wanted = 0.2 * np.sum(std**2) / (6 + len(joints))  # the base has no sensors
    np.testing.assert_allclose(designer.noise, np.full(6 + len(joints), wanted))
