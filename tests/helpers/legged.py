"""Robots on legs in MuJoCo: a plant with ground contacts that shares no code with the method."""

from dataclasses import replace

import mujoco
import numpy as np
import pinocchio as pin

from robotid.data.base_motion import BaseMotion, ImuFrame, motion_of_imu
from robotid.data.log import Log
from robotid.robot.constraints import Contact, frame_id
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia

_HOLD = 10  # steps during which a torque is held
_RADIUS = 1e-3  # [m] of the feet: contacts are at the origin of the foot's link, or at its corners
SETTLES = 1.0  # [s] from the first posture to the start of the log
SOLO_FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")


def solo_on_points():
    """Return Solo12 on its four feet, as points."""
    return RobotModel.from_urdf(
        example_urdf("solo12.urdf"), free_flyer=True, terms=(),
        constraints=[Contact(foot) for foot in SOLO_FEET],
    )  # fmt: skip


def spec_of(
    model, feet, *, step, armature=0.0, damping=0.0, friction=0.8, ground=0.02, springs=(), imu=None
):  # fmt: skip
    """Return a MuJoCo model of a robot whose base floats, with small spheres as feet on a plane."""
    # Feet are links that touch the ground, or the points of each that do, (k, 3) [m]; ground its
    # time constant [s]; springs stiffness and damping by passive joint; imu its placement in the
    # base. Loops of the robot are ``connect`` constraints.
    pin_model, names = model.pin_model, list(model.pin_model.names)
    spec, bodies = mujoco.MjSpec(), {}
    for i in range(1, pin_model.njoints):
        parent, place = pin_model.parents[i], pin_model.jointPlacements[i]
        above = spec.worldbody if parent == 0 else bodies[parent]
        inertia = pin_model.inertias[i]
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.inertia
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
        drive = {"armature": armature, "damping": [damping, 0, 0]}
        bodies[i].add_joint(
            name=names[i], type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis[3:, pin_model.joints[i].idx_v],
            **(drive if names[i] not in model.passive else {}),
            **({} if names[i] not in springs else _spring(*springs[names[i]], step)),
        )  # fmt: skip
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], friction=[friction, 0, 0], condim=3,
        solref=[ground, 1.0],
    )  # fmt: skip
    for foot, points in _points(feet).items():
        frame = pin_model.frames[frame_id(pin_model, foot)]
        for k, point in enumerate(points):
            bodies[frame.parentJoint].add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[_RADIUS, 0, 0],
                pos=frame.placement.act(np.array(point)), name=f"{foot} {k}", condim=3, mass=0.0,
                friction=[friction, 0, 0], solref=[ground, 1.0],
            )  # fmt: skip
    for loop in model.loops:
        for link in loop.frames:
            frame = pin_model.frames[frame_id(pin_model, link)]
            bodies[frame.parentJoint].add_site(name=link, pos=frame.placement.translation)
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE,
            name1=loop.frames[0], name2=loop.frames[1], solref=[2 * step, 1.0],
            solimp=[0.9999, 0.9999, 0.001, 0.5, 2.0],
        )  # fmt: skip
    if imu is not None:
        site = bodies[1].add_site(name="imu", pos=imu.translation, quat=_wxyz(imu.rotation))
        for kind in (mujoco.mjtSensor.mjSENS_GYRO, mujoco.mjtSensor.mjSENS_ACCELEROMETER):
            spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name)
    for name in model.joints:
        if name not in model.passive:
            motor = spec.add_actuator(name=name, target=name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
    return spec.compile()


def _spring(stiffness, damping, step):
    """Return a spring in a step whose force acts half a step early, as a negative damping does."""
    return {"stiffness": [stiffness, 0, 0], "damping": [damping + 0.5 * step * stiffness, 0, 0]}


def _points(feet):
    """Return the points that touch the ground by link."""
    return dict(feet) if hasattr(feet, "keys") else {foot: [(0.0, 0.0, 0.0)] for foot in feet}


def _wxyz(rotation):
    return np.roll(pin.Quaternion(rotation).coeffs(), 1)


def multisine(middle, reach, rng, highest=1.2):
    """Return a motion of joints about a posture, positions from the time, below a frequency."""
    tones = np.arange(1, 13)
    f = np.linspace(0.1, highest, len(tones))
    phase = rng.uniform(0, 2 * np.pi, (len(middle), len(tones)))
    size = rng.dirichlet(np.ones(len(tones)), len(middle))

    def wanted(t):
        wave = np.sum(size * np.sin(2 * np.pi * f * max(t, 0.0) + phase), axis=1)
        start = np.sum(size * np.sin(phase), axis=1)
        ramp = np.clip(1.0 + t / SETTLES, 0.0, 1.0)
        return middle + reach * (wave if t > 0 else ramp * start), 0.0

    return wanted


def recorded(model, feet, middle, reach, rng, *, highest=1.2, **options):
    """Return the log of a robot on the ground whose joints follow multi-sines."""
    motion = multisine(middle, reach, rng, highest)
    return followed(model, feet, motion, rng, **{"posture": middle, **options})


def followed(
    model, feet, motion, rng, *, posture, duration=20.0, rate=500.0, step=1e-4, kp=40.0, kd=1.0,
    torque=0.02, bits=18, armature=0.0, damping=0.0, height=None, force=False, ground=0.02,
    gantry=None, springs=(), friction=0.8, imu=None,
):  # fmt: skip
    """Return the log of a robot on the ground whose joints follow a motion."""
    # The motion gives positions [rad] and torques [N m] from the time, from -1 s on; posture is
    # that at -1 s, (n,) or (7 + n,) with the pose of the base, whose height [m] can be given.
    # Torque is the noise of the logged torques, bits those of the encoders; force tells whether
    # forces of the feet are logged in the world's axes. A gantry holds the base: its wrench at the
    # origin from the time, the pose (7,) and the speeds (6,) is logged, as are filtered values of
    # an imu.
    mj = spec_of(
        model, feet, step=step, armature=armature, damping=damping, ground=ground, springs=springs,
        friction=friction, imu=imu,
    )  # fmt: skip
    data, feet = mujoco.MjData(mj), _points(feet)
    joints = [mj.joint(name) for name in model.joints]
    qpos = np.array([joint.qposadr[0] for joint in joints])
    qvel = np.array([joint.dofadr[0] for joint in joints])
    driven = np.array([name not in model.passive for name in model.joints])
    _place(mj, data, qpos, posture, 1.0 if height is None else height)
    geoms = [mj.geom(i).name.rpartition(" ")[0] for i in range(mj.ngeom)]
    foot_of = np.array([[*feet, ""].index(name) for name in geoms])  # the last one is the plane
    if height is None:  # the lowest foot touches the ground
        data.qpos[2] += _RADIUS - data.geom_xpos[foot_of < len(feet), 2].min()
    period = round(1 / (rate * step))
    rows, touches, ctrl = [], np.zeros(len(feet) + 1), np.zeros(len(joints) + 6)
    means, sensed = [], np.zeros(mj.nsensordata)
    for k in range(0, round((duration + SETTLES) / step), _HOLD):
        t = k * step - SETTLES
        wanted, ahead = motion(t)
        command = kp * (wanted - data.qpos[qpos]) - kd * data.qvel[qvel] + ahead
        held = np.zeros(6) if gantry is None else gantry(t, data.qpos[:7], data.qvel[:6])
        before, ctrl = ctrl, np.append(np.where(driven, command, 0.0), held)
        data.ctrl[:] = ctrl[:-6][driven]
        data.xfrc_applied[1] = held
        data.xfrc_applied[1, 3:] += np.cross(data.qpos[:3] - data.xipos[1], held[:3])
        if k % period == 0 and t >= 0:
            mujoco.mj_forward(mj, data)
            forces = _forces(mj, data, foot_of)
            row = [[t], data.qpos, 0.5 * (before + ctrl), touches[:-1], forces.ravel()]
            rows.append(np.concatenate(row))
            touches[:] = 0.0
            means.append(sensed / period)
        if k % period == 0:
            sensed[:] = 0.0
        for _ in range(1 if imu is None else _HOLD):
            mujoco.mj_step(mj, data, _HOLD if imu is None else 1)
            sensed += data.sensordata
        if data.ncon:  # at any time since the last row
            acting = data.contact.geom[data.contact.efc_address >= 0]
            touches[foot_of[acting]] = 1.0
    log = _logged(model, list(feet), mj, qpos, np.array(rows), rng, torque, bits, force)
    if imu is not None:
        still = ImuFrame(
            pin.Quaternion(imu.rotation).coeffs(), imu.translation, mj.opt.gravity, np.zeros(3)
        )
        means = np.array([*means, sensed / period])  # of the periods before and after each row
        measured, _ = motion_of_imu(log.t, log.q, 0.5 * (means[:-1] + means[1:]), still)
        log = replace(log, base=replace(log.base, imu=measured))
    if gantry is None:
        return log
    wrench = np.array(rows)[:, 1 + mj.nq + len(joints) :][:, :6]
    names = (f"{part} {model.tree.root}" for part in Contact.components)
    return replace(log, wrenches=log.wrenches | dict(zip(names, wrench.T, strict=True)))


def _place(mj, data, qpos, posture, height):
    """Put a robot at a posture, its base upright at a height or at its stated pose."""
    if len(posture) > len(qpos):
        data.qpos[:7] = np.array(posture)[[0, 1, 2, 6, 3, 4, 5]]
    else:
        data.qpos[2] = height
    data.qpos[qpos] = posture[-len(qpos) :]
    mujoco.mj_forward(mj, data)


def _forces(mj, data, foot_of):
    """Return the force of the ground on each foot with the axes of the world, shape (k, 3) [N]."""
    forces, own = np.zeros((foot_of.max() + 1, 3)), np.zeros(6)
    for c in range(data.ncon):
        contact = data.contact[c]
        if contact.efc_address >= 0:
            mujoco.mj_contactForce(mj, data, c, own)
            force = contact.frame.reshape(3, 3).T @ own[:3]  # on the second geom
            forces[foot_of[contact.geom]] += np.outer([-1.0, 1.0], force)
    return forces[:-1]


def _logged(model, feet, mj, qpos, rows, rng, torque, bits, force):
    """Return the log of rows of t, qpos, torques, flags and forces, with noise."""
    n = len(model.joints)
    t, q = rows[:, 0], rows[:, 1 + qpos]
    resolution = 2 * np.pi / 2**bits
    q = np.round(q / resolution) * resolution
    pose = rows[:, [1, 2, 3, 5, 6, 7, 4]]
    first = 1 + mj.nq
    tau = rows[:, first : first + n] + torque * rng.standard_normal((len(t), n))
    flags, forces = np.split(rows[:, first + n + 6 :], [len(feet)], axis=1)
    flags, forces = flags > 0, forces.reshape(len(t), -1, 3)
    wrenches = {
        f"{part} {foot}": forces[:, i, k]
        for i, foot in enumerate(feet if force else ())
        for k, part in enumerate(("fx", "fy", "fz"))
    }
    return Log(
        t, q, tau, model.joints, base=BaseMotion(pose),
        contacts={foot: flags[:, i] for i, foot in enumerate(feet)}, wrenches=wrenches,
    )  # fmt: skip


def with_other_bodies(model, rng, size=0.08):
    """Return a robot whose bodies differ from those of a URDF, physically consistent."""
    # Masses differ by up to 25 %. Each body is stretched and sheared, and its mass displaced, by a
    # share of the distance of its centre of mass plus its radius of gyration.
    pi = model.standard_parameters()[: model.layout.n_inertial]
    bodies = []
    for J in pseudo_inertia(pi):
        A = np.eye(4) + size * rng.standard_normal((4, 4)) * np.array([1, 1, 1, 0])[:, None]
        mass, centre = J[3, 3], J[:3, 3] / J[3, 3]
        A[:3, 3] *= np.linalg.norm(centre) + np.sqrt(np.trace(J[:3, :3]) / mass)
        A[3, 3] = np.sqrt(rng.uniform(0.75, 1.25))
        bodies.append(inertial_from_pseudo_inertia(A @ J @ A.T))
    return model.with_parameters(np.concatenate(bodies))
