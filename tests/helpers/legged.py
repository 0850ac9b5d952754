"""Robots on legs in MuJoCo: a plant with ground contacts that shares no code with the method."""

import mujoco
import numpy as np
import pinocchio as pin

from robotid.logs.base import BaseMotion
from robotid.logs.data import Log
from robotid.logs.imu import ImuFrame, motion_of_imu
from robotid.robot.constraints import frame_id
from robotid.robot.parameters import pseudo_inertia

_HOLD = 10  # steps during which a torque is held
_RADIUS = 1e-3  # [m] of the feet: contacts are at the origin of the foot's link


def spec_of(model, feet, *, step, armature=0.0, damping=0.0, friction=0.8, imu=None):
    """Return a MuJoCo model of a robot whose base floats, with small spheres as feet on a plane.

    Args:
        model: The robot; its tree is written as a URDF with a floating joint.
        feet: Links that touch the ground.
        step: Of MuJoCo [s].
        armature: Of each joint [kg m^2].
        damping: Of each joint [N m s/rad].
        friction: Coefficient of the feet.
        imu: Placement of an IMU in the base, or None.
    """
    pin_model, names = model.pin_model, list(model.pin_model.names)
    spec, bodies = mujoco.MjSpec(), {}
    for i in range(1, pin_model.njoints):
        parent, place = pin_model.parents[i], pin_model.jointPlacements[i]
        above = spec.worldbody if parent == 0 else bodies[parent]
        inertia = pin_model.inertias[i]
        xx, xy, yy, xz, yz, zz = inertia.toDynamicParameters()[4:] - _steiner(inertia)
        bodies[i] = above.add_body(
            name=names[i], pos=place.translation, quat=_wxyz(place.rotation),
            mass=inertia.mass, ipos=inertia.lever, fullinertia=[xx, yy, zz, xy, xz, yz],
            explicitinertial=True,
        )  # fmt: skip
        if i == 1:
            bodies[i].add_freejoint()
            continue
        axis = pin.computeJointJacobian(
            pin_model, pin_model.createData(), pin.neutral(pin_model), i
        )
        bodies[i].add_joint(
            name=names[i], type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis[3:, pin_model.joints[i].idx_v], armature=armature, damping=[damping, 0, 0],
        )  # fmt: skip
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], friction=[friction, 0, 0], condim=3,
        solref=[0.02, 1.0],
    )  # fmt: skip
    for foot in feet:
        frame = model.pin_model.frames[frame_id(model.pin_model, foot)]
        bodies[frame.parentJoint].add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_RADIUS, 0, 0],
            pos=frame.placement.translation, name=foot, condim=3, mass=0.0,
            friction=[friction, 0, 0], solref=[0.02, 1.0],
        )  # fmt: skip
    if imu is not None:
        site = bodies[1].add_site(name="imu", pos=imu.translation, quat=_wxyz(imu.rotation))
        for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name)
    for name in model.joints:
        motor = spec.add_actuator(name=name, target=name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    return spec.compile()


def _wxyz(rotation):
    return np.roll(pin.Quaternion(rotation).coeffs(), 1)


def _steiner(inertia):
    """Return what the distance of the centre of mass adds to xx, xy, yy, xz, yz and zz."""
    x, y, z = inertia.lever
    m = inertia.mass
    return m * np.array([y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y])


def recorded(
    model, feet, middle, reach, rng, *, duration=20.0, rate=500.0, step=1e-4, kp=40.0, kd=1.0,
    torque=0.02, bits=18, armature=0.0, damping=0.0, height=None, highest=1.2, force=False,
    imu=None,
):  # fmt: skip
    """Return the log of a robot whose joints follow multi-sines while its feet are on the ground.

    Args:
        model: The robot, whose bodies are those of its URDF.
        feet: Links that touch the ground.
        middle: Posture in which it stands, shape (n,) [rad].
        reach: Amplitude of the motion, shape (n,) [rad].
        rng: Source of the motion and of noise.
        duration: Length [s].
        rate: Rows per second [Hz].
        step: Of MuJoCo [s].
        kp: Gain of the position [N m/rad].
        kd: Gain of the speed [N m s/rad].
        torque: Standard deviation of the logged torques [N m].
        bits: Of the joints' encoders, per turn.
        armature: Of each joint [kg m^2].
        damping: Of each joint [N m s/rad].
        height: Of the base at the start [m].
        highest: Highest frequency of the motion [Hz].
        force: Whether the feet's forces are logged, in the world's axes.
        imu: Placement of an IMU in the base, whose filtered values are logged; or None.
    """
    mj = spec_of(model, feet, step=step, armature=armature, damping=damping, imu=imu)
    data = mujoco.MjData(mj)
    joints = [mj.joint(name) for name in model.joints]
    qpos = np.array([joint.qposadr[0] for joint in joints])
    qvel = np.array([joint.dofadr[0] for joint in joints])
    data.qpos[qpos] = middle
    data.qpos[2] = 1.0 if height is None else height
    mujoco.mj_forward(mj, data)
    spheres = [mj.geom(foot).id for foot in feet]
    if height is None:  # the lowest foot touches the ground
        data.qpos[2] += _RADIUS - min(data.geom_xpos[i][2] for i in spheres)
    n, tones = len(joints), np.arange(1, 13)
    f = np.linspace(0.1, highest, len(tones))
    phase = rng.uniform(0, 2 * np.pi, (n, len(tones)))
    size = rng.dirichlet(np.ones(len(tones)), n)
    period, settles = round(1 / (rate * step)), 1.0
    rows, touches = [], np.zeros(len(feet))
    means, sensed = [], np.zeros(mj.nsensordata)
    for k in range(round((duration + settles) / step)):
        t = k * step - settles
        if k % _HOLD == 0:
            ramp = np.clip(1.0 + t / settles, 0.0, 1.0)
            wave = np.sum(size * np.sin(2 * np.pi * f * max(t, 0.0) + phase), axis=1)
            start = np.sum(size * np.sin(phase), axis=1)
            target = middle + reach * (wave if t > 0 else ramp * start)
            command = kp * (target - data.qpos[qpos]) - kd * data.qvel[qvel]
            before, data.ctrl[:] = data.ctrl.copy(), command
        if k % period == 0 and t >= 0:
            wrench = np.zeros((len(feet), 3))
            mujoco.mj_forward(mj, data)
            for c in range(data.ncon):
                contact, own = data.contact[c], np.zeros(6)
                foot = next((i for i, g in enumerate(spheres) if g in contact.geom), None)
                if foot is None or contact.efc_address < 0:
                    continue
                mujoco.mj_contactForce(mj, data, c, own)
                sign = 1.0 if contact.geom[1] == spheres[foot] else -1.0
                wrench[foot] += sign * contact.frame.reshape(3, 3).T @ own[:3]
            half = 0.5 * (before + data.ctrl)
            rows.append(np.concatenate([[t], data.qpos, half, touches, wrench.ravel()]))
            touches[:] = 0.0
            means.append(sensed / period)
        if k % period == 0:
            sensed[:] = 0.0
        mujoco.mj_step(mj, data)
        sensed += data.sensordata
        if k % _HOLD == 0 and data.ncon:  # at any time since the last row
            acting = data.contact.geom[data.contact.efc_address >= 0]
            touches[np.isin(spheres, acting)] = 1.0
    rows = np.array(rows)
    t, q = rows[:, 0], rows[:, 1 + qpos]
    resolution = 2 * np.pi / 2**bits
    q = np.round(q / resolution) * resolution
    pose = rows[:, [1, 2, 3, 5, 6, 7, 4]]
    first = 1 + mj.nq
    tau = rows[:, first : first + n] + torque * rng.standard_normal((len(t), n))
    flags = rows[:, first + n : first + n + len(feet)] > 0
    count = first + n + len(feet)
    forces = rows[:, count : count + 3 * len(feet)].reshape(len(t), -1, 3)
    measured = None
    if imu is not None:
        still = ImuFrame(
            pin.Quaternion(imu.rotation).coeffs(), imu.translation, mj.opt.gravity, np.zeros(3)
        )
        means = np.array([*means, sensed / period])  # of the periods before and after each row
        measured, _ = motion_of_imu(t, q, 0.5 * (means[:-1] + means[1:]), still)
    wrenches = {}
    if force:
        parts = ("fx", "fy", "fz")
        wrenches = {
            f"{part} {foot}": forces[:, i, k]
            for i, foot in enumerate(feet)
            for k, part in enumerate(parts)
        }
    return Log(
        t, q, tau, model.joints, base=BaseMotion(pose, imu=measured),
        contacts={foot: flags[:, i] for i, foot in enumerate(feet)}, wrenches=wrenches,
    )  # fmt: skip


def with_other_bodies(model, rng, size=0.08):
    """Return a robot whose bodies differ from those of a URDF, physically consistent.

    Args:
        model: The robot.
        rng: Source of the differences.
        size: Their relative size.
    """
    pi = model.standard_parameters()[: model.layout.n_inertial]
    bodies = []
    for J in pseudo_inertia(pi):
        A = np.eye(4) + size * rng.standard_normal((4, 4)) * np.array([1, 1, 1, 0])[:, None]
        A[3, 3] = np.sqrt(rng.uniform(0.75, 1.25))
        J = A @ J @ A.T
        trace = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
        bodies.append(
            [J[3, 3], *J[:3, 3], trace[0, 0], trace[0, 1], trace[1, 1], trace[0, 2], trace[1, 2],
             trace[2, 2]]
        )  # fmt: skip
    return model.with_parameters(np.concatenate(bodies))
