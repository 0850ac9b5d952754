"""Robots of all kinds of joints, and motions of them."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin

from robotid.data.log import Trajectory
from robotid.robot.bodies import held_parameters
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, inertial_from_pseudo_inertia, pseudo_inertia

WRIST = Coupling("motor", (("wrist_2_joint", 1.0), ("wrist_3_joint", -0.5)))
ROBOTS = {
    "six turning joints": ("ur5_robot.urdf", {}),
    "coupled drives": ("ur5_robot.urdf", {"couplings": (WRIST,)}),
    "locked joints, other order": (
        "ur5_robot.urdf",
        {"joints": ["wrist_2_joint", "elbow_joint"], "locked": {"wrist_1_joint": 0.7}},
    ),
    "other gravity": ("ur5_robot.urdf", {"gravity": (3.0, -5.0, 8.0)}),
    "gripper that slides": ("panda.urdf", {}),
    "mimic joint coupled": ("panda.urdf", {"mimic": "coupled"}),
    "continuous joints": ("double_pendulum_continuous.urdf", {}),
    "torso that slides": ("tiago_no_hand.urdf", {}),
    "unaligned axes": ("finger_edu.urdf", {}),
    "unaligned axes, floating": ("borinot_flying_arm_2.urdf", {"free_flyer": True}),
    "humanoid": ("talos_reduced.urdf", {}),
    "humanoid, floating": ("talos_reduced.urdf", {"free_flyer": True}),
}

LINK = (
    '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" '
    'ixz="0" iyz="0"/></inertial></link>'
)
JOINT = (
    '<joint name="j{i}" type="{kind}"><parent link="l{parent}"/><child link="l{i}"/>'
    '<axis xyz="{axis}"/><origin xyz="{xyz}" rpy="{rpy}"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)


def mimicking(folder, rng, **options):
    """Return a robot whose second and third joint follow the first, which carries the second."""
    mimic = '<mimic joint="j1" multiplier="{}" offset="0.3"/></joint>'
    parts, ends = [LINK.format("l0")], {2: mimic.format(-2.5), 3: mimic.format(-1)}
    for i, parent in ((1, 0), (2, 1), (3, 0), (4, 2)):
        text = {k: " ".join(map(str, rng.standard_normal(3))) for k in ("axis", "xyz", "rpy")}
        joint = JOINT.format(i=i, kind="revolute", parent=parent, **text)
        parts += [LINK.format(f"l{i}"), joint.replace("</joint>", ends.get(i, "</joint>"))]
    (folder / "tree.urdf").write_text(f'<robot name="tree">{"".join(parts)}</robot>')
    return RobotModel.from_urdf(folder / "tree.urdf", mimic="coupled", **options)


def motion(model, rng, samples, reach=3.0, direction=None):
    n = len(model.joints)
    q = rng.uniform(-reach, reach, (samples, n))
    v, a, tau = rng.uniform(-2, 2, (3, samples, model.n_rows))
    values = {"t": np.arange(samples) / 100, "v": v, "a": a, "tau": tau, "joints": model.joints}
    values |= {"direction": direction, "memory": None}
    if model.free_flyer:  # logs of a floating base are not read yet
        pose = np.array([pin.SE3ToXYZQUAT(pin.SE3.Random()) for _ in range(samples)])
        return SimpleNamespace(q=np.hstack([pose, q]), derived={}, basis=None, **values)
    return Trajectory(q=q, rate=100.0, segment=np.zeros(samples, dtype=int), **values)


def possible_parameters(model, rng):
    """Return parameters near the URDF's, every link possible, drives between 0.1 and 1."""
    held = held_parameters(model).reshape(-1, 10)
    pi = model.standard_parameters()
    inertial = pi[: model.layout.n_inertial].reshape(-1, 10)
    for body, values in enumerate(inertial):
        w, V = np.linalg.eigh(pseudo_inertia(values - held[body])[0])
        w = np.maximum(w, 1e-3) * rng.uniform(0.8, 1.2, 4)
        inertial[body] = inertial_from_pseudo_inertia(V @ np.diag(w) @ V.T) + held[body]
    pi[model.layout.n_inertial :] = rng.uniform(0.1, 1, len(pi) - model.layout.n_inertial)
    return pi
