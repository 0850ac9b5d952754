"""The mass matrix, and whether it is positive definite over the joints' ranges."""

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from robotid.base.typing import Array
from robotid.robot.closure import Chains
from robotid.robot.model import RobotModel
from robotid.robot.parameters import ParameterLayout

POSES = 10_000
_BLOCK = 200  # poses whose mass matrices are in memory together; all of a robot with loops


@dataclass(frozen=True)
class MassMatrixCheck:
    """The mass matrix over random poses."""

    poses: int  # number of them
    smallest_eigenvalue: float  # of all poses [kg m^2, or kg]
    positive_share: float  # of the poses where it is positive definite [-]

    @property
    def is_positive(self) -> bool:
        """Whether it is positive definite at every pose."""
        return self.positive_share == 1.0


def check_mass_matrix(
    model: RobotModel, pi: Array, *, poses: int = POSES, seed: int = 0
) -> MassMatrixCheck:
    """Return whether the mass matrix, armatures included, is positive definite at random poses."""
    rng = np.random.default_rng(seed)
    if model.loops and not model.free_flyer:
        q, Z = Chains(model).random_states(min(poses, _BLOCK), rng)
        M = joint_mass_matrices(model, pi, q)
        size = np.trace(M, axis1=1, axis2=2)[:, None, None]
        M = Z @ M @ Z + np.abs(size) * (np.eye(M.shape[-1]) - Z)
        least = np.linalg.eigvalsh(M)[:, 0]
        return MassMatrixCheck(len(q), float(least.min()), float((least > 0).mean()))
    free = [1.0 if joint.type == "prismatic" else np.pi for joint in model.limits]
    lower = [j.lower if j.has_limits else -x for j, x in zip(model.limits, free, strict=True)]
    upper = [j.upper if j.has_limits else x for j, x in zip(model.limits, free, strict=True)]
    q = rng.uniform(lower, upper, (poses, len(free)))
    if model.free_flyer:  # the pose of the base has no effect
        q = np.hstack([np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (poses, 1)), q])
    smallest, positive = np.inf, 0
    for first in range(0, poses, _BLOCK):
        M = joint_mass_matrices(model, pi, q[first : first + _BLOCK])
        if first and _are_above(M, max(smallest, 0.0)):
            positive += len(M)
            continue
        least = np.linalg.eigvalsh(M)[:, 0]
        smallest, positive = min(smallest, float(least.min())), positive + int((least > 0).sum())
    return MassMatrixCheck(poses, smallest, positive / poses)


def _are_above(M: Array, least: float) -> bool:
    """Return whether all eigenvalues of all matrices exceed a bound, without computing them."""
    try:
        np.linalg.cholesky(M - least * np.eye(M.shape[-1]))
    except np.linalg.LinAlgError:
        return False
    return True


def joint_mass_matrices(model: RobotModel, pi: Array, q: Array) -> Array:
    """Return the mass matrices at q (N, n), armatures included, shape (N, n_rows, n_rows)."""
    M = rigid_mass_matrices(model.with_parameters(pi), model.configurations(q))
    first = model.n_rows - len(model.joints)
    M[:, first:, first:] += drive_inertia(model.layout, pi)
    return M


def rigid_mass_matrices(
    model: RobotModel, configurations: Array, data: pin.Data | None = None
) -> Array:
    """Return the mass matrices without drives at configurations (N, nq), (N, n_rows, n_rows)."""
    data = model.pin_model.createData() if data is None else data
    M = np.empty((len(configurations), model.pin_model.nv, model.pin_model.nv))
    for M_k, configuration in zip(M, configurations, strict=True):
        M_k[:] = pin.crba(model.pin_model, data, configuration)
    G = model.velocity_map
    return M if np.array_equal(G, np.eye(len(G))) else np.asarray(G.T @ M @ G)


def drive_inertia(layout: ParameterLayout, pi: Array) -> Array:
    """Return the drives' share of the mass matrix of the joints, (n, n) [kg m^2, or kg]."""
    Ia = pi[layout.n_inertial :] * [term.is_inertia for _, term in layout.drive_parameters]
    return np.asarray((layout.drive_loads * Ia) @ layout.drive_loads.T)


def carried_inertia(model: RobotModel) -> Array:
    """Return the diagonal of the bodies' mass matrix at the neutral pose, (n,) [kg m^2, or kg]."""
    (M,) = rigid_mass_matrices(model, pin.neutral(model.pin_model)[None])
    return np.maximum(np.diag(M)[model.n_rows - len(model.joints) :], 0.0)
