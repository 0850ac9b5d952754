"""Whether the mass matrix is positive definite wherever the joints can go."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.robot.model import RobotModel

__all__ = ["MassMatrixCheck", "carried_inertia", "check_mass_matrix", "joint_mass_matrices"]

POSES = 10_000


@dataclass(frozen=True)
class MassMatrixCheck:
    """The mass matrix over random poses.

    Attributes:
        poses: Number of poses.
        smallest_eigenvalue: The smallest one of them all [kg m^2, or kg].
        positive_share: Share of the poses where it is positive definite [-].
    """

    poses: int
    smallest_eigenvalue: float
    positive_share: float

    @property
    def is_positive(self) -> bool:
        """Whether it is positive definite at every pose."""
        return self.positive_share == 1.0


def check_mass_matrix(
    model: RobotModel, pi: Array, *, poses: int = POSES, seed: int = 0
) -> MassMatrixCheck:
    """Return whether the mass matrix, armatures included, is positive definite at random poses.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,).
        poses: Number of poses, uniform within the joints' limits; a joint without limits turns
            once around or slides by 1 m to either side.
        seed: Seed of the poses.

    Returns:
        What was found.
    """
    rng = np.random.default_rng(seed)
    bounds = np.array(
        [
            (joint.lower, joint.upper)
            if joint.has_limits
            else ((-1.0, 1.0) if joint.type == "prismatic" else (-np.pi, np.pi))
            for joint in model.limits
        ]
    )
    q = rng.uniform(bounds[:, 0], bounds[:, 1], (poses, len(bounds)))
    if model.free_flyer:  # where the base is changes nothing
        pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        q = np.hstack([np.tile(pose, (poses, 1)), q])
    smallest = np.linalg.eigvalsh(joint_mass_matrices(model, pi, q))[:, 0]
    return MassMatrixCheck(poses, float(smallest.min()), float((smallest > 0).mean()))


def joint_mass_matrices(model: RobotModel, pi: Array, q: Array) -> Array:
    """Return the mass matrix in the coordinates of the model's joints, armatures included.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,).
        q: Joint coordinates, shape (N, n), or (N, 7 + n) with a floating base [rad, m].

    Returns:
        Matrices, shape (N, n_rows, n_rows).
    """
    pin_model = model.with_parameters(pi).pin_model
    data, G = pin_model.createData(), model.velocity_map
    M = np.empty((len(q), pin_model.nv, pin_model.nv))
    for k, configuration in enumerate(model.configurations(q)):
        M[k] = pin.crba(pin_model, data, configuration, pin.Convention.LOCAL)
    upper = np.triu(M)
    full = upper + np.triu(M, 1).transpose(0, 2, 1)
    drives: Array = G.T @ full @ G + _armatures(model, pi)
    return drives


def _armatures(model: RobotModel, pi: Array) -> Array:
    """Return what the drives' inertias add, shape (n_rows, n_rows)."""
    added = np.zeros((model.n_rows, model.n_rows))
    first = model.n_rows - len(model.joints)
    ratios = {joint: {joint: 1.0} for joint in model.joints}
    ratios |= {coupling.name: dict(coupling.ratios) for coupling in model.layout.couplings}
    for name, value in zip(model.layout.names, pi, strict=True):
        owner, term = name.rsplit(".", 1)
        if term == "armature":
            w = np.zeros(model.n_rows)
            for joint, ratio in ratios[owner].items():
                w[first + model.joints.index(joint)] = ratio
            added += value * np.outer(w, w)
    return added


def carried_inertia(model: RobotModel) -> Array:
    """Return the inertia that each joint carries at the neutral posture.

    Args:
        model: The robot.

    Returns:
        Inertias, shape (n,), at least 0 [kg m^2, or kg].
    """
    pin_model = model.pin_model
    M = pin.crba(pin_model, pin_model.createData(), pin.neutral(pin_model))
    M = np.triu(M) + np.triu(M, 1).T
    G = model.velocity_map
    diagonal = np.diag(G.T @ M @ G)[model.n_rows - len(model.joints) :]
    return np.maximum(diagonal, 0.0)
