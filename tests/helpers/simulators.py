"""Robots that simulators are given, and what Pinocchio says of their dynamics."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pinocchio as pin

from helpers.paths import URDF
from helpers.robots import WRIST, possible_parameters
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

#: Robots of each kind of joint that a format must state.
SIMULATED = {
    "planar": ("planar_2r.urdf", {}),
    "arm": ("ur10_robot.urdf", {"gravity": (1.0, -2.0, -9.0)}),
    "coupled drives": ("ur10_robot.urdf", {"couplings": (WRIST,)}),
    "shared motor": (
        "ur10_robot.urdf", {"couplings": (replace(WRIST, name="wrist_3_joint", replaces=True),)}
    ),
    "fingers that slide": ("panda.urdf", {"mimic": "coupled"}),
    "continuous joints": ("double_pendulum_continuous.urdf", {}),
    "locked in the middle": (
        "tiago_no_hand.urdf",
        {"joints": ["arm_2_joint", "arm_4_joint"],
         "locked": {"arm_3_joint": 0.7, "arm_1_joint": 1.0, "torso_lift_joint": 0.2}},
    ),
    "quadruped, floating": ("solo12.urdf", {"free_flyer": True}),
    "humanoid, floating": ("talos_reduced.urdf", {"free_flyer": True}),
}  # fmt: skip


def simulated(name):
    """Return one of these robots and possible parameters of it."""
    file, options = SIMULATED[name]
    path = URDF / file
    model = RobotModel.from_urdf(path if path.is_file() else example_urdf(file), **options)
    return model, possible_parameters(model, np.random.default_rng(3))


def states(model, pi, count):
    """Yield random states of the tree: M has the drives' armature, forces their viscous part."""
    robot, rng = model.with_parameters(pi).pin_model, np.random.default_rng(5)
    data, first = robot.createData(), 6 if model.free_flyer else 0
    names = list(robot.names)[2 if first else 1 :]
    joints = [robot.joints[robot.getJointId(name)] for name in names]
    values = dict(zip(model.layout.names, pi, strict=True))
    for _ in range(count):
        v, a = rng.uniform(-2, 2, (2, robot.nv))
        q = pin.neutral(robot)
        if first:
            q[:7] = pin.SE3ToXYZQUAT(pin.SE3.Random())
        angles = rng.uniform(-3, 3, len(names))
        for joint, x in zip(joints, angles, strict=True):
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                [x] if joint.nq == 1 else [np.cos(x), np.sin(x)]
            )
        M = np.array(pin.crba(robot, data, q))
        M = np.triu(M) + np.triu(M, 1).T
        tau = np.array(pin.rnea(robot, data, q, v, a))
        for drive in model.layout.drives:
            w = np.zeros(robot.nv)
            for joint, ratio in drive.ratios:
                w[robot.joints[robot.getJointId(joint)].idx_v] = ratio
            M += values[f"{drive.name}.armature"] * np.outer(w, w)
            tau += w * values[f"{drive.name}.armature"] * (w @ a)
            tau += w * values[f"{drive.name}.viscous"] * (w @ v)
        columns = {name: joint.idx_v for name, joint in zip(names, joints, strict=True)}
        yield SimpleNamespace(
            q=q, angles=dict(zip(names, angles, strict=True)), v=v, a=a, M=M, tau=tau,
            columns=columns,
        )  # fmt: skip
