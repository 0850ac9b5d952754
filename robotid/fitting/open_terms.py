"""What is open of the drives: terms that they may have, shapes; what predictions err by them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotid._typing import Array
from robotid.fitting.evaluation import Evaluation
from robotid.fitting.joint_motion import JointMotion, joint_motions
from robotid.regressor.memory import drive_motion_along
from robotid.robot.drives import DriveMotion

if TYPE_CHECKING:
    from robotid.fitting.result import Fit

__all__ = ["OpenTerm", "open_torques"]


@dataclass(frozen=True, eq=False)
class OpenTerm:
    """What is open of a joint's drive: a term that it may have, or a shape.

    Attributes:
        joint: The joint.
        moves: By how much it moves standard parameters, shape (p,).
        torque: Its own torque along a motion of the drive, which the joint's is given beside,
            shape (N,) [N m or N].
    """

    joint: str
    moves: Array
    torque: Callable[[DriveMotion, JointMotion], Array]


def open_torques(found: "Fit", evaluation: "Evaluation", rows: Array) -> list[Array]:
    """Return the torque of each open term of the drives along a recording.

    Args:
        found: What was found.
        evaluation: The recording.
        rows: Which of its samples, shape (k,), int.

    Returns:
        For each of ``open_terms`` its torque, shape (k, n_rows) [N m or N].
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
        torques.append(torque)
    return torques
