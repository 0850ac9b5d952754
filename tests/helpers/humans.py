"""Humans in motion capture on two force plates: URDFs of segments, and a plant by plain RNEA."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.interpolate import CubicSpline

from helpers.walkers import shares, waves
from robotid.data.base_motion import BaseMotion
from robotid.data.log import Log

MASS = 70.0  # [kg]
FEET = ("LeftFoot", "RightFoot")
PARTS = ("fx", "fy", "fz", "mx", "my", "mz")
_FAKE = (1e-4, 3e-4)  # mass [kg] and inertia [kg m^2] between the axes of a spherical joint
_PLAN = 50.0  # [Hz] of postures; a cubic spline lies between them
_STEP = 1e-4  # [s] of the finite differences of the motion
_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}

# segment, parent, share of the mass, size [m], joint, its place [m], its axes, those of 66 joints
_MIDDLE = (
    ("Pelvis", "", 0.122, (0.2, 0.3, 0.1), "", (0, 0, 0), "", ""),
    ("L5", "Pelvis", 0.06, (0.18, 0.26, 0.1), "jL5S1", (0, 0, 0.06), "xy", "xyz"),
    ("L3", "L5", 0.06, (0.18, 0.26, 0.1), "jL4L3", (0, 0, 0.1), "xy", "xyz"),
    ("T12", "L3", 0.06, (0.18, 0.26, 0.1), "jL1T12", (0, 0, 0.1), "xy", "xyz"),
    ("T8", "T12", 0.16, (0.2, 0.3, 0.2), "jT9T8", (0, 0, 0.1), "xyz", "xyz"),
    ("Neck", "T8", 0.02, (0.05, 0.1), "jT1C7", (0, 0, 0.2), "xyz", "xyz"),
    ("Head", "Neck", 0.06, (0.16, 0.16, 0.24), "jC1Head", (0, 0, 0.1), "xy", "xyz"),
)
_SIDE = (
    ("Shoulder", "T8", 0.02, (0.08, 0.15, 0.08), "jC7Shoulder", (0, 0.03, 0.16), "x", "xyz"),
    ("UpperArm", "Shoulder", 0.028, (0.045, 0.3), "jShoulder", (0, 0.15, 0), "xyz", "xyz"),
    ("ForeArm", "UpperArm", 0.016, (0.038, 0.26), "jElbow", (0, 0, -0.3), "yz", "xyz"),
    ("Hand", "ForeArm", 0.006, (0.04, 0.08, 0.17), "jWrist", (0, 0, -0.26), "xz", "xyz"),
    ("UpperLeg", "Pelvis", 0.105, (0.08, 0.42), "jHip", (0, 0.09, -0.04), "xyz", "xyz"),
    ("LowerLeg", "UpperLeg", 0.042, (0.05, 0.41), "jKnee", (0, 0, -0.42), "yz", "xyz"),
    ("Foot", "LowerLeg", 0.011, (0.2, 0.09, 0.08), "jAnkle", (0, 0, -0.41), "xyz", "xyz"),
    ("Toe", "Foot", 0.001, (0.06, 0.09, 0.03), "jBallFoot", (0.14, 0, -0.04), "y", "xyz"),
)  # fmt: skip
_DOWN = ("UpperArm", "ForeArm", "Hand", "UpperLeg", "LowerLeg")  # ... their centres are below
_LEG = ("jHip_rotx", "jHip_roty", "jHip_rotz", "jKnee_roty", "jAnkle_rotx", "jAnkle_roty")


def segments(full=False):
    """Return name, parent, mass [kg], size, joint, place and axes of each segment of a body.

    Args:
        full: Whether each joint has three axes, 66 in all; else 48.
    """
    found = [(*x[:6], x[6 + full]) for x in _MIDDLE]
    for side, sign in (("Right", -1), ("Left", 1)):
        for name, parent, share, size, joint, (x, y, z), *axes in _SIDE:
            above = parent if parent in ("T8", "Pelvis") else side + parent
            place = (x, sign * y, z)
            found.append(
                (side + name, above, share, size, f"j{side}{joint[1:]}", place, axes[full])
            )
    return [(name, above, share * MASS, *rest) for name, above, share, *rest in found]


def human_urdf(full=False):
    """Return the URDF of a human: boxes and cylinders, fake links, no limits of effort or speed.

    Args:
        full: As of ``segments``.
    """
    text = ['<robot name="human">']
    for name, above, mass, size, joint, place, axes in segments(full):
        centre = (0, 0, 0) if name == "Pelvis" else (0, 0, size[-1] / 2)
        if name.removeprefix("Left").removeprefix("Right") in _DOWN:
            centre = (0, 0, -size[-1] / 2)
        elif name.endswith(("Foot", "Toe")):
            centre = (size[0] / 2 - 0.05, 0, -0.04)
        text.append(_link(name, mass, size, centre))
        for k, axis in enumerate(axes):
            is_last = k == len(axes) - 1
            child = name if is_last else f"{name}_f{k + 1}"
            parent, xyz = (above, place) if k == 0 else (f"{name}_f{k}", (0, 0, 0))
            text.append(
                f'<joint name="{joint}_rot{axis}" type="revolute"><origin xyz="{_text(xyz)}"/>'
                f'<parent link="{parent}"/><child link="{child}"/><axis xyz="{_AXES[axis]}"/>'
                '<limit lower="-3.1" upper="3.1" effort="0" velocity="0"/></joint>'
            )
            if not is_last:
                m, i = _FAKE
                text.append(
                    f'<link name="{child}"><inertial><mass value="{m}"/><inertia ixx="{i}" ixy="0" '
                    f'ixz="0" iyy="{i}" iyz="0" izz="{i}"/></inertial></link>'
                )
    return "\n".join([*text, "</robot>"])


def _text(values):
    return " ".join(f"{x:.9g}" for x in values)


def _link(name, mass, size, centre):
    """Return a link whose mass is spread evenly in a box of three sizes, or an upright cylinder."""
    if len(size) == 2:
        r, h = size
        shape = f'<cylinder radius="{r}" length="{h}"/>'
        xx, yy, zz = (3 * r * r + h * h) / 12, (3 * r * r + h * h) / 12, r * r / 2
    else:
        x, y, z = size
        shape = f'<box size="{_text(size)}"/>'
        xx, yy, zz = (y * y + z * z) / 12, (x * x + z * z) / 12, (x * x + y * y) / 12
    origin = f'<origin xyz="{_text(centre)}"/>'
    body = "".join(
        f"<{kind}>{origin}<geometry>{shape}</geometry></{kind}>" for kind in ("visual", "collision")
    )
    return (
        f'<link name="{name}"><inertial>{origin}<mass value="{mass:.9g}"/><inertia '
        f'ixx="{mass * xx:.9g}" ixy="0" ixz="0" iyy="{mass * yy:.9g}" iyz="0" '
        f'izz="{mass * zz:.9g}"/></inertial>{body}</link>'
    )


def with_other_segments(model, rng, size=0.15):
    """Return a human whose segments have other masses; fake links are as in the URDF.

    Args:
        model: The human of the URDF.
        rng: Source of the differences.
        size: Their standard deviation, relative; left and right have the same ones.
    """
    pi = model.standard_parameters().reshape(-1, 10).copy()
    names = [name.removeprefix("Left").removeprefix("Right") for name in model.layout.bodies]
    scale = {name: np.exp(size * rng.standard_normal()) for name in dict.fromkeys(names)}
    real = np.array(["_f" not in name for name in names])
    pi[real] *= np.array([scale[name] for name in names])[real, None]
    return model.with_parameters(pi.ravel())


@dataclass(frozen=True, eq=False)
class Walk:
    """A motion without noise, and the wrenches of the ground on both feet.

    Attributes:
        t: Times, shape (N,) [s].
        q: Pose of the base and positions of joints, shape (N, 7 + n).
        wrenches: On each foot at the origin of the world, with its axes, shape (N, 2, 6).
        feet: Placements of the feet, shape (N, 2), objects.
    """

    t: np.ndarray
    q: np.ndarray
    wrenches: np.ndarray
    feet: np.ndarray


def walk(model, true, rng, duration=20.0, rate=100.0, pace=1.0):
    """Return the motion of a human who steps in place, sways, squats and moves arms and trunk.

    Args:
        model: The human of the URDF, with legs as of ``human_urdf``.
        true: The human who moves.
        rng: Source of the motion.
        duration: Length [s].
        rate: Rows per second [Hz].
        pace: Speed of the motion, relative.
    """
    robot = true.pin_model
    plan = np.arange(-0.2, duration + 0.2, 1 / _PLAN)
    postures = _postures(model, plan, rng, pace)
    base, joints = CubicSpline(plan, postures[:, :6]), CubicSpline(plan, postures[:, 6:])
    t = np.arange(0.0, duration, 1 / rate)

    def q_at(t):
        pose = base(t)
        turn = [pin.Quaternion(pin.rpy.rpyToMatrix(x)).coeffs() for x in pose[:, 3:]]
        return np.hstack([pose[:, :3], turn, joints(t)])

    left = shares(pace * t)[0]
    total, feet = forces(robot, q_at, t, FEET)
    return Walk(t, q_at(t), np.stack([left, 1 - left], axis=1)[:, :, None] * total[:, None], feet)


def forces(robot, q_at, t, frames):
    """Return the wrench that moves a robot, and the placements of frames, by plain RNEA.

    Args:
        robot: Its Pinocchio model.
        q_at: Pose of the base and positions of joints, shape (N, 7 + n), from times.
        t: Times, shape (N,) [s].
        frames: Names of the frames.

    Returns:
        The wrench at the origin of the world, shape (N, 6), and placements, shape (N, k), objects.
    """
    data = robot.createData()
    ids = [robot.getFrameId(name) for name in frames]
    total, places = np.empty((len(t), 6)), np.empty((len(t), len(ids)), dtype=object)
    before, now, after = q_at(t - _STEP), q_at(t), q_at(t + _STEP)
    for k in range(len(t)):
        first = pin.difference(robot, before[k], now[k]) / _STEP
        last = pin.difference(robot, now[k], after[k]) / _STEP
        tau = pin.rnea(robot, data, now[k], (first + last) / 2, (last - first) / _STEP)
        pin.framesForwardKinematics(robot, data, now[k])
        total[k] = data.oMi[1].act(pin.Force(tau[:6])).vector
        places[k] = [data.oMf[i].copy() for i in ids]
    return total, places


def _postures(model, t, rng, pace):
    """Return x y z, roll pitch yaw of the pelvis and positions of joints, shape (N, 6 + n)."""
    robot, names = model.pin_model, list(model.joints)
    left, lifts = shares(pace * t)
    sway = 0.12 * (left - 0.5)
    size = np.array([0.03, 0.02, 0.03, 0.06, 0.08, 0.1])
    pelvis = size * waves(rng, 6, 0.1, 0.7 * pace)(t)
    pelvis[:, 1] += sway
    pelvis[:, 2] += 0.85
    reach = np.full(len(names), 0.15)
    reach[[("Shoulder_" in x) or ("Elbow" in x) for x in names]] = 0.7
    joints = reach * waves(rng, len(names), 0.1, 1.2 * pace)(t)
    for side, sign, lift in zip(("Left", "Right"), (1, -1), lifts, strict=True):
        columns = [names.index(f"j{side}{x[1:]}") for x in _LEG]
        rest = [
            k for k, x in enumerate(names)
            if x.startswith((f"j{side}Hip", f"j{side}Knee", f"j{side}Ankle", f"j{side}Ball"))
            and k not in columns
        ]  # fmt: skip
        joints[:, rest] = 0.0
        ground = np.array([0.0, sign * 0.11, 0.08])
        goals = ground + np.outer(lift, [0.08, 0.0, 0.15])
        swings = 0.3 * lift[:, None] * waves(rng, 3, 0.2, 0.8)(t)
        _stand(robot, f"{side}Foot", pelvis, joints, columns, goals, swings)
    return np.hstack([pelvis, joints])


def _stand(robot, foot, pelvis, joints, columns, goals, swings):
    """Set joints of a leg so that the foot is at its place, by Newton's method."""
    data, frame = robot.createData(), robot.getFrameId(foot)
    guess = np.array([0.0, -0.4, 0.0, 0.8, 0.0, -0.4])
    for k, pose in enumerate(pelvis):
        turn = pin.Quaternion(pin.rpy.rpyToMatrix(pose[3:])).coeffs()
        goal = pin.SE3(pin.rpy.rpyToMatrix(swings[k]), goals[k])
        for _ in range(20):
            joints[k, columns] = guess
            q = np.concatenate([pose[:3], turn, joints[k]])
            pin.framesForwardKinematics(robot, data, q)
            error = pin.log6(data.oMf[frame].actInv(goal)).vector
            if np.abs(error).max() < 1e-10:
                break
            J = pin.computeFrameJacobian(robot, data, q, frame)[:, 6 + np.array(columns)]
            guess = guess + np.linalg.solve(J, error)
        else:
            raise AssertionError(f"the {foot} does not come to its place in posture {k}")


def logged(
    model, motion, rng, *, plates=None, noise=(5e-4, 2e-3, 1.0, 0.05), frames=FEET
):  # fmt: skip
    """Return the log of a motion, without torques.

    Args:
        model: The human.
        motion: The motion.
        rng: Source of the noise.
        plates: Placement of the force plate of each foot, whose origin and axes the wrenches have;
            None: those of the foot, as of shoes.
        noise: Standard deviations of positions [m], angles [rad], forces [N] and moments [N m].
        frames: The feet.
    """
    position, angle, force, moment = noise
    q = motion.q + angle * rng.standard_normal(motion.q.shape)
    q[:, :3] = motion.q[:, :3] + position * rng.standard_normal((len(q), 3))
    turns = angle * rng.standard_normal((len(q), 3))
    for k, turn in enumerate(turns):
        q[k, 3:7] = (pin.Quaternion(motion.q[k, 3:7]) * pin.Quaternion(pin.exp3(turn))).coeffs()
    wrenches = {}
    for i, foot in enumerate(frames):
        own = np.array([
            (motion.feet[k, i] if plates is None else plates[i]).actInv(pin.Force(f)).vector
            for k, f in enumerate(motion.wrenches[:, i])
        ])  # fmt: skip
        own += rng.standard_normal(own.shape) * np.repeat([force, moment], 3)
        wrenches |= {f"{part} {foot}": own[:, k] for k, part in enumerate(PARTS)}
    return Log(
        motion.t, q[:, 7:], np.zeros_like(q[:, 7:]), model.joints, has_torque=False,
        base=BaseMotion(q[:, :7]), wrenches=wrenches,
    )  # fmt: skip
