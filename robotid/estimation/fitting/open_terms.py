"""Uncertain terms and shapes of the drives, and the torque errors that they may cause."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotid.base.typing import Array
from robotid.dynamics.constraint_rows import without_forces
from robotid.dynamics.prediction import drive_motion_along
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.joint_motion import JointMotion, joint_motions
from robotid.robot.drives import DriveMotion

if TYPE_CHECKING:
    from robotid.estimation.fitting.fitted import Fit


@dataclass(frozen=True, eq=False)
class OpenTerm:
    """An uncertainty of a joint's drive model: an undecided term, or the error of a shape.

    Attributes:
        joint: The joint.
        moves: Change of the standard parameters that it causes, shape (p,).
        torque: Function of the motion of the drive and of the joint that returns its own torque,
            shape (N,) [N m or N].
    """

    joint: str
    moves: Array
    torque: Callable[[DriveMotion, JointMotion], Array]


def open_torques(found: "Fit", evaluation: "Evaluation", rows: Array) -> list[Array]:
    """Return the torque of each open term of the drives along a recording.

    rows (k,) -> (k, n_rows) [N m or N].
    """
    if not found.open_terms:
        return []
    model, recording = found.model.with_reference(found.standard), evaluation.recording
    joints, first = model.joints, model.n_rows - len(model.joints)
    drives = drive_motion_along(model, recording.trajectory)
    load, every = drives.load[: len(joints)].T, np.arange(len(recording.trajectory.t))
    alone = joint_motions([recording], [every], load, model)
    torques = []
    for term in found.open_terms:
        j, torque = joints.index(term.joint), np.zeros((len(rows), model.n_rows))
        torque[:, first + j] = term.torque(drives.of(j), alone[j])[rows]
        basis = recording.trajectory.basis
        torques.append(torque if basis is None else without_forces(basis[rows], torque))
    return torques
