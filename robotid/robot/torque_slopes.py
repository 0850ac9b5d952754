"""How the torque of the bodies changes with the motion, gravity, and where the joints lie.

Derivatives of inverse dynamics by Pinocchio. Before each joint the robot gets three that slide and
stand at 0: what they would do is what another origin of the joint does.
"""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.robot.model import RobotModel

__all__ = ["TorqueSlopes", "torque_slopes"]


@dataclass(frozen=True, eq=False)
class TorqueSlopes:
    """Derivatives of the torque of the bodies at N instants, of a robot with n joints.

    Attributes:
        by_q: By the positions, shape (N, n, n).
        by_v: By the velocities, likewise.
        by_a: By the accelerations, likewise: the mass matrix of the bodies.
        by_gravity: By gravity, along the axes of the world, shape (N, n, 3).
        by_origin: By where each joint lies in the frame of the body before, shape (N, n, n, 3):
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


def torque_slopes(model: RobotModel, pi: Array, q: Array, v: Array, a: Array) -> TorqueSlopes:
    """Return how the torque of bodies changes with the motion, gravity and origins of joints.

    Args:
        model: The robot, with a fixed base.
        pi: Standard parameters, shape (p,), of bodies that can be.
        q: Joint coordinates, shape (N, n) [rad, m].
        v: Velocities, shape (N, n) [rad/s, m/s].
        a: Accelerations, shape (N, n) [rad/s^2, m/s^2].

    Raises:
        DataError: If pi or q does not fit the model.

    References:
        Carpentier, Mansard (2018), Analytical Derivatives of Rigid Body Dynamics Algorithms.
    """
    plain, G = model.with_parameters(pi).pin_model, model.velocity_map
    sliding, joints = _with_sliding_origins(plain)
    own = np.array([sliding.joints[k].idx_v for k in joints])  # rows of the robot's own joints
    before = np.array([sliding.joints[k - 1].idx_v for k in joints])  # and of their origins
    first_q = [(sliding.joints[k].idx_q, plain.joints[i].idx_q, plain.joints[i].nq)
               for i, k in enumerate(joints, start=1)]  # fmt: skip
    configurations = np.zeros((len(q), sliding.nq))
    known = model.configurations(q)
    for to, here, size in first_q:
        configurations[:, to : to + size] = known[:, here : here + size]
    rates, changes = np.zeros((2, len(v), sliding.nv))
    rates[:, own], changes[:, own] = v @ G.T, a @ G.T
    slopes = np.empty((3, len(q), len(own), sliding.nv))
    derive, data = pin.computeRNEADerivatives, sliding.createData()
    states = zip(configurations, rates, changes, strict=True)
    for D_q, D_v, D_a, state in zip(*slopes, states, strict=True):
        by_q, by_v, by_a = derive(sliding, data, *state)
        D_q[:], D_v[:], D_a[:] = by_q[own], by_v[own], by_a[own]
    D: Array = G.T @ slopes  # tau = G^T tau_pinocchio
    by_q, by_v, by_a = D[..., own] @ G
    leaders = np.array([plain.getJointId(name) - 1 for name in model.joints])
    axes = before[leaders][:, None] + np.arange(3)
    roots = before[[plain.parents[i] == 0 for i in range(1, plain.njoints)]]
    falling = sum(D[2][..., root : root + 3] for root in roots)  # as the base is accelerated
    return TorqueSlopes(by_q, by_v, by_a, -falling, D[0][..., axes])


def _with_sliding_origins(model: pin.Model) -> tuple[pin.Model, list[int]]:
    """Return a robot whose joints each slide along three axes first, and its own joints in it."""
    sliding, joints = pin.Model(), [0]
    sliding.gravity = model.gravity
    for i in range(1, model.njoints):
        place, name = model.jointPlacements[i], model.names[i]
        there = pin.SE3(np.eye(3), place.translation)
        origin = sliding.addJoint(
            joints[model.parents[i]], pin.JointModelTranslation(), there, f"{name} origin"
        )
        turned = pin.SE3(place.rotation, np.zeros(3))
        joints.append(sliding.addJoint(origin, model.joints[i], turned, name))
        sliding.appendBodyToJoint(joints[-1], model.inertias[i], pin.SE3.Identity())
    return sliding, joints[1:]
