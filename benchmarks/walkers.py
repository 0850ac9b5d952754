"""Bipeds that step in place: postures over the feet, and the torques that hold them."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pinocchio as pin
from helpers.legged import SETTLES, followed
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_banded

from robotid.robot.constraints import Contact, frame_id
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

_STEP = 1e-4  # [s] of the finite differences of the motion
_PLAN = 50.0  # [Hz] of postures; a cubic spline lies between them
_PERIOD = 5.0  # [s] of a step with each foot
_DRIVES = ("armature", "viscous")


def _corners(front, back, half, height):
    return [(x, y, height) for x in (front, back) for y in (half, -half)]


@dataclass(frozen=True, eq=False)
class Biped:
    """A biped with flat feet.

    Attributes:
        urdf: Its file of example-robot-data.
        feet: Corners of the feet by link, the left one first [m].
        crouch: Positions of joints in the first posture, by end of the name [rad].
        kp, kd: Gains [N m/rad, N m s/rad].
        armature, damping: Of each joint [kg m^2, N m s/rad].
        torque: Noise of the torques [N m].
    """

    urdf: str
    feet: dict
    crouch: dict
    kp: float
    kd: float
    armature: float
    damping: float
    torque: float

    @property
    def model(self):
        return RobotModel.from_urdf(
            example_urdf(self.urdf), free_flyer=True, terms=_DRIVES,
            constraints=[Contact(foot, "surface") for foot in self.feet],
        )  # fmt: skip

    def truth(self, model):
        """Return the parameters of the robot with its drives."""
        pi = model.standard_parameters()
        n = model.layout.n_inertial
        pi[n:] = [
            {"armature": self.armature, "viscous": self.damping}[name.rpartition(".")[2]]
            for name in model.layout.names[n:]
        ]
        return pi

    def log(self, model, rng, duration=20.0, **options):
        """Return the log of a robot that steps in place."""
        posture, motion = steps(self, model, rng, duration)
        return followed(
            model, self.feet, motion, rng, posture=posture, duration=duration, ground=0.005,
            kp=self.kp, kd=self.kd, armature=self.armature, damping=self.damping,
            torque=self.torque, **options,
        )  # fmt: skip


G1 = Biped(
    "g1_29dof_rev_1_0.urdf",
    {f"{x}_ankle_roll_link": _corners(0.12, -0.05, 0.03, -0.03) for x in ("left", "right")},
    {"hip_pitch_joint": -0.6, "knee_joint": 1.2, "ankle_pitch_joint": -0.6,
     "left_shoulder_roll_joint": 0.3, "right_shoulder_roll_joint": -0.3, "elbow_joint": 0.5},
    kp=1000.0, kd=10.0, armature=0.01, damping=0.5, torque=0.1,
)  # fmt: skip
TALOS = Biped(
    "talos_reduced.urdf",
    {f"{x}_sole_link": _corners(0.1, -0.1, 0.06, 0.0) for x in ("left", "right")},
    {"leg_left_3_joint": -0.6, "leg_left_4_joint": 1.2, "leg_left_5_joint": -0.6,
     "leg_right_3_joint": -0.6, "leg_right_4_joint": 1.2, "leg_right_5_joint": -0.6,
     "arm_left_2_joint": 0.4, "arm_right_2_joint": -0.4, "arm_left_4_joint": -0.8,
     "arm_right_4_joint": -0.8, "gripper_left_joint": -0.5, "gripper_right_joint": -0.5},
    kp=5000.0, kd=50.0, armature=0.1, damping=1.0, torque=0.3,
)  # fmt: skip
ICUB = Biped(
    "icub.urdf", {f"{x}_sole": _corners(0.1, -0.05, 0.025, 0.0) for x in "lr"},
    {"hip_pitch": 0.8, "knee": -1.6, "ankle_pitch": -0.8, "elbow": 0.8, "l_shoulder_roll": 0.5,
     "r_shoulder_roll": 0.5},
    kp=0.0, kd=0.0, armature=0.0, damping=0.0, torque=0.0,
)  # fmt: skip


def waves(rng, count, lowest, highest, tones=6):
    """Return sines that start at 0, values from times, shape (N, count), of size about 1."""
    f = rng.uniform(lowest, highest, (tones, count))
    size = rng.dirichlet(np.ones(tones), count).T
    return lambda t: np.sum(size * np.sin(2 * np.pi * f * t[:, None, None]), axis=1)


def _smooth(x):
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def shares(t):
    """Return the share of the weight that is wanted on the left foot, and lifts of both feet."""
    u = np.maximum(t, 0.0) % _PERIOD / _PERIOD
    share = 0.5 * (1 + _smooth(u / 0.1) - 2 * _smooth((u - 0.45) / 0.1) + _smooth((u - 0.9) / 0.1))
    lifts = [_smooth((u - x) / 0.1) - _smooth((u - x - 0.2) / 0.1) for x in (0.58, 0.12)]
    return share, np.array(lifts)  # of the left foot, of the right foot


def _pendulum(pressure, height):
    """Return the centre of mass c of a pendulum on a centre of pressure p, c - h/g c'' = p."""
    k = height / 9.81 * _PLAN**2
    bands = np.tile([[-k], [1 + 2 * k], [-k]], len(pressure))
    bands[0, 1], bands[1, [0, -1]], bands[2, -2] = 0.0, 1.0, 0.0  # c = p at the ends
    return solve_banded((1, 1), bands, pressure)


def planned(biped, model, rng, duration):
    """Return what ``steps`` plans: the posture, times, places (N, 7 + n), loads and lifts.

    The load is the share of the weight on the left foot, shape (N,); lifts are those of both feet,
    shape (2, N).
    """
    t = np.arange(-SETTLES - 2 / _PLAN, duration + 3 / _PLAN, 1 / _PLAN)
    body, late = _Posture(biped, model), np.maximum(t, 0.0)
    wave, other = waves(rng, 6, 0.1, 0.7), waves(rng, len(model.joints), 0.1, 0.9)
    ramp = _smooth(late / 2.0)[:, None]
    trunk = wave(late) * ramp * [0.015, 0.01, 0.05, 0.12, 0.12, 0.12]
    arms = other(late) * ramp * np.where(body.is_leg, 0.0, 0.5)
    swings = 0.3 * waves(rng, 6, 0.3, 1.5)(late) * [0.1, 0.1, 0.05, 0.5, 0.5, 0.5]
    share, lifts = shares(t)
    between = _pendulum(share, body.data.com[0][2])
    up = np.array([0.0, 0.0, 0.06, 0.0, 0.0, 0.0])
    places = []
    for k in range(len(t)):
        feet = [lift[k] * up + lift[k] ** 2 * swings[k] for lift in lifts]
        places.append(body.reach(trunk[k], arms[k], feet, between[k]))
    return body, t, np.array(places), share, lifts


def steps(biped, model, rng, duration):
    """Return the first posture, and positions and torques of joints from the time.

    The feet leave the ground in turn, and return. The centre of mass moves as an inverted pendulum
    on the centre of pressure, which shifts between the feet. The trunk moves up and down and turns,
    other joints follow sines. The torques are those of this motion.
    """
    body, t, places, share, _ = planned(biped, model, rng, duration)
    rates = [body.rate(*x) for x in pairwise(places)]
    torques = [
        body.torque(q, 0.5 * (v + w), (w - v) * _PLAN, own)
        for q, v, w, own in zip(places[1:], rates, rates[1:], share[1:], strict=False)
    ]
    at = CubicSpline(t[1:-1], np.hstack([places[1:-1, 7:], torques]))
    return places[2], lambda time: np.split(at(time), [len(model.joints)])


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


class _Posture:
    """Positions of a biped whose feet and trunk are at given places."""

    def __init__(self, biped, model):
        self.model, self.pin_model = model, model.pin_model
        self.data = self.pin_model.createData()
        self.ids = [frame_id(self.pin_model, foot) for foot in biped.feet]
        joints = {
            i
            for x in self.ids
            for i in self.pin_model.supports[self.pin_model.frames[x].parentJoint]
        }
        names = list(self.pin_model.names)
        self.is_leg = np.array([names.index(joint) in joints for joint in model.joints])
        self.middle = np.array(
            [next((x for end, x in biped.crouch.items() if joint.endswith(end)), 0.0)
             for joint in model.joints]
        )  # fmt: skip
        self.q = np.concatenate([[0, 0, 0, 0, 0, 0, 1.0], self.middle])
        self._update()
        corners = [x for x in biped.feet.values()]
        lowest = min(
            (self.data.oMf[i] * np.array(x))[2]
            for i, own in zip(self.ids, corners, strict=True)
            for x in own
        )
        self.q[2] = 1e-3 - lowest
        self._update()
        self.feet = [self.data.oMf[i].copy() for i in self.ids]
        self.centres = [x * np.mean(own, axis=0) for x, own in zip(self.feet, corners, strict=True)]
        self.height = self.q[2]
        self.free = np.concatenate([np.arange(6), 6 + np.flatnonzero(self.is_leg)])

    def _update(self):
        pin.computeJointJacobians(self.pin_model, self.data, self.q)
        pin.updateFramePlacements(self.pin_model, self.data)
        pin.centerOfMass(self.pin_model, self.data, self.q)

    def reach(self, trunk, arms, lifts, share):
        """Return a posture, shape (7 + n,), with a share of the weight on the left foot.

        Args:
            trunk: Displacement of the centre of mass in x and y, of the height, angles.
            arms: Displacement of the joints that are not of the legs.
            lifts: Displacements of the feet, each (6,).
            share: Place of the centre of mass from the right to the left foot.
        """
        self.q[7:] = np.where(self.is_leg, self.q[7:], self.middle + arms)
        wanted = [pin.SE3(pin.exp3(x[3:]) @ M.rotation, M.translation + x[:3])
                  for x, M in zip(lifts, self.feet, strict=True)]  # fmt: skip
        centre = (share * self.centres[0] + (1 - share) * self.centres[1])[:2] + trunk[:2]
        turn = pin.rpy.rpyToMatrix(*trunk[3:])
        for _ in range(20):
            self._update()
            J, error = self._jacobians(), []
            for i, M in zip(self.ids, wanted, strict=True):
                own = self.data.oMf[i]
                error += [M.translation - own.translation, pin.log3(M.rotation @ own.rotation.T)]
            error.append(centre - self.data.com[0][:2])
            J.append(pin.jacobianCenterOfMass(self.pin_model, self.data, self.q)[:2])
            R = self.data.oMi[1].rotation
            error += [[self.height + trunk[2] - self.q[2]], R.T @ pin.log3(turn @ R.T)]
            base = np.eye(6, self.pin_model.nv)
            J += [R[2:] @ base[:3], base[3:]]
            step = np.zeros(self.pin_model.nv)
            step[self.free] = np.linalg.solve(np.vstack(J)[:, self.free], np.concatenate(error))
            self.q = pin.integrate(self.pin_model, self.q, step)
            if np.abs(step).max() < 1e-7:
                return self.q.copy()
        raise AssertionError("no such posture")

    def rate(self, q, later):
        """Return the speeds from a posture to the next one of the plan."""
        return pin.difference(self.pin_model, q, later) * _PLAN

    def torque(self, q, v, a, share):
        """Return torques of the joints, shape (n,), with a share of the weight on the left foot."""
        tau = pin.rnea(self.pin_model, self.data, q, v, a)
        self.q = q
        self._update()
        J = np.vstack(self._jacobians())
        weights = np.repeat([share, 1 - share], 6) ** 0.5 + 1e-6
        force = weights * np.linalg.lstsq(J[:, :6].T * weights, tau[:6], rcond=None)[0]
        return (tau - J.T @ force)[6:]

    def _jacobians(self):
        axes = pin.LOCAL_WORLD_ALIGNED
        return [pin.getFrameJacobian(self.pin_model, self.data, i, axes) for i in self.ids]
