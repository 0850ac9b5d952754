"""Derivatives of the bodies' torque by the motion, gravity, and the origins of the joints.

They are Pinocchio's derivatives of inverse dynamics. Three prismatic joints at position 0 are added
before each joint: their displacements are those of the joint's origin.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid.base.typing import Array
from robotid.robot.model import RobotModel


@dataclass(frozen=True, eq=False)
class TorqueSlopes:
    """Derivatives of the torque of the bodies at N samples, of a robot with n joints.

    Attributes:
        by_q: By the positions, shape (N, n, n).
        by_v: By the velocities, likewise.
        by_a: By the accelerations, likewise: the mass matrix of the bodies.
        by_gravity: By gravity, along the axes of the world, shape (N, n, 3).
        by_origin: By the origin of each joint in the frame of the body before, shape (N, n, n, 3):
            torque, joint, axis.
    """

    by_q: Array
    by_v: Array
    by_a: Array
    by_gravity: Array
    by_origin: Array

    def __sub__(self, other: "TorqueSlopes") -> "TorqueSlopes":
        """Return the derivatives of the difference of two torques of the same robot."""
        return TorqueSlopes(*(x - y for x, y in zip(self.arrays, other.arrays, strict=True)))

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All of them, in order."""
        return self.by_q, self.by_v, self.by_a, self.by_gravity, self.by_origin


def position_slopes(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> Array:
    """Return the derivatives of the bodies' torque by the positions, shape (N, n, n).

    ``torque_slopes`` computes other derivatives, too, and takes several times as long.
    """
    own, G = model.with_parameters(pi).pin_model, model.velocity_map
    found, data = np.empty((len(q), own.nv, own.nv)), own.createData()
    states = zip(model.configurations(q), v @ G.T, a @ G.T, strict=True)
    for D, state in zip(found, states, strict=True):
        D[:] = pin.computeRNEADerivatives(own, data, *state)[0]
    by_q: Array = G.T @ found @ G
    return by_q


def torque_slopes(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> TorqueSlopes:
    """Return the derivatives of the bodies' torque by motion, gravity and origins of joints.

    References:
        Carpentier, Mansard (2018), Analytical Derivatives of Rigid Body Dynamics Algorithms.

    pi (p,), q (N, n) [rad, m], v (N, n) [rad/s, m/s], a (N, n) [rad/s^2, m/s^2].
    """
    plain, G = model.with_parameters(pi).pin_model, model.velocity_map
    extended, joints = _with_movable_origins(plain)
    own = np.array([extended.joints[k].idx_v for k in joints])  # rows of the robot's own joints
    before = np.array([extended.joints[k - 1].idx_v for k in joints])  # and of their origins
    first_q = [(extended.joints[k].idx_q, plain.joints[i].idx_q, plain.joints[i].nq)
               for i, k in enumerate(joints, start=1)]  # fmt: skip
    configurations = np.zeros((len(q), extended.nq))
    known = model.configurations(q)
    for to, here, size in first_q:
        configurations[:, to : to + size] = known[:, here : here + size]
    velocities, accelerations = np.zeros((2, len(v), extended.nv))
    velocities[:, own], accelerations[:, own] = v @ G.T, a @ G.T
    slopes = np.empty((3, len(q), len(own), extended.nv))
    derive, data = pin.computeRNEADerivatives, extended.createData()
    states = zip(configurations, velocities, accelerations, strict=True)
    for D_q, D_v, D_a, state in zip(*slopes, states, strict=True):
        by_q, by_v, by_a = derive(extended, data, *state)
        by_q.take(own, 0, D_q, "clip")  # without bound checks
        by_v.take(own, 0, D_v, "clip")
        by_a.take(own, 0, D_a, "clip")
    D: Array = G.T @ slopes  # tau = G^T tau_pinocchio
    by_q, by_v, by_a = D[..., own] @ G
    leaders = np.array([plain.getJointId(name) - 1 for name in model.joints])
    axes = before[leaders][:, None] + np.arange(3)
    roots = before[[plain.parents[i] == 0 for i in range(1, plain.njoints)]]
    falling = sum(D[2][..., root : root + 3] for root in roots)  # as the base is accelerated
    return TorqueSlopes(by_q, by_v, by_a, -falling, D[0][..., axes])


def _with_movable_origins(model: pin.Model) -> tuple[pin.Model, list[int]]:
    """Return a robot with a 3-axis prismatic joint before each joint, and its own joints in it."""
    extended, joints = pin.Model(), [0]
    extended.gravity = model.gravity
    for i in range(1, model.njoints):
        place, name = model.jointPlacements[i], model.names[i]
        there = pin.SE3(np.eye(3), place.translation)
        origin = extended.addJoint(
            joints[model.parents[i]], pin.JointModelTranslation(), there, f"{name} origin"
        )
        rotated = pin.SE3(place.rotation, np.zeros(3))
        joints.append(extended.addJoint(origin, model.joints[i], rotated, name))
        extended.appendBodyToJoint(joints[-1], model.inertias[i], pin.SE3.Identity())
    return extended, joints[1:]
