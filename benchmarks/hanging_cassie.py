"""Cassie on a gantry: its motion, recorded in MuJoCo."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
from cassie import ARMATURE, DAMPING, FEET, LIGHT, PASSIVE, SIDES, SPRINGS
from helpers.legged import followed, multisine

from robotid.robot.closure import Chains

#: Joints of a leg without a drive, but with an encoder.
LOGGED = ("knee-shin-joint", "shin-tarsus-joint")
HEIGHT = 1.0  # [m] of the pelvis
STIFF, SLOW = np.repeat([2000.0, 400.0], 3), np.repeat([200.0, 40.0], 3)  # of what holds it
MIDDLE = {"pitch-op": 0.19, "knee-op": -0.23, "crank-joint": 0.3}
REACH = {"roll-op": 0.3, "yaw-op": 0.3, "pitch-op": 0.5, "knee-op": 0.5, "crank-joint": 0.6}


def is_logged(joint):
    """Return whether a joint has an encoder."""
    name = joint.partition("-")[2]
    return name not in PASSIVE or name in LOGGED


def hanging(model, rng, duration=20.0, **options):
    """Return the log of a Cassie that a measured wrench holds, whose feet touch the ground."""
    middle, reach = (
        np.array([next((x for end, x in of.items() if j.endswith(end)), 0.0) for j in model.joints])
        for of in (MIDDLE, REACH)
    )
    unknown = np.array([name in model.passive for name in model.joints])
    unknown &= [not name.endswith("knee-shin-joint") for name in model.joints]
    unknown &= [not name.endswith("tarsus-spring-joint") for name in model.joints]
    posture = Chains(model).closed(middle[None], unknown)[0]
    swing = multisine(np.zeros(6), np.array([0.1, 0.1, 0.15, 0.3, 0.3, 0.3]), rng)

    def gantry(t, pose, speeds):
        wanted = swing(t)[0]
        R = pin.Quaternion(*np.array(pose)[3:7]).matrix()
        off = pin.log3(pin.rpy.rpyToMatrix(*wanted[3:]) @ R.T)
        gap = np.append((*wanted[:2], wanted[2] + HEIGHT) - pose[:3], off)
        return STIFF * gap - SLOW * np.append(speeds[:3], R @ speeds[3:])

    springs = {
        f"{side}-{joint}": (stiffness, LIGHT)
        for side in SIDES
        for joint, stiffness in SPRINGS.items()
    }
    whole = followed(
        model, FEET, multisine(middle, reach, rng), rng, posture=posture, duration=duration,
        kp=300.0, kd=5.0, armature=ARMATURE, damping=DAMPING, torque=0.05, height=HEIGHT,
        springs=springs, gantry=gantry, ground=0.01, **options,
    )  # fmt: skip
    own = [k for k, joint in enumerate(model.joints) if is_logged(joint)]
    return replace(
        whole, joints=tuple(model.joints[k] for k in own), q=whole.q[:, own], tau=whole.tau[:, own]
    )
