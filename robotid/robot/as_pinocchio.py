"""An identified robot as a model of Pinocchio's own, drives included."""

import warnings

import numpy as np
import pinocchio as pin

from robotid._typing import Array
from robotid.findings import listed
from robotid.robot.model import RobotModel

__all__ = ["pinocchio_model"]


def pinocchio_model(model: RobotModel, pi: Array) -> pin.Model:
    """Return Pinocchio's model with inertias, armature, damping and dry friction of parameters.

    Locked joints are part of the links that carry them. With q, v and a of Pinocchio's model,

    ``tau = rnea(q, v, a) + damping v - where(v > 0, lowerDryFrictionLimit, upperDryFrictionLimit)``

    is the torque that the parameters predict of joints that move: ``rnea`` has the armature, and
    the dry friction of a joint that moves forwards is at its lower limit. Coulomb friction Fc and
    offset make the limits -Fc - offset and Fc - offset; a joint at rest holds what lies between.
    With mimic joints or another order of joints, ``RobotModel.configurations`` and
    ``velocity_map`` lead from the joints identified to Pinocchio's, and torques back.

    What is beyond these fields is left out, and a warning names it: drives that turn with several
    joints, whose friction and inertia load them all, and friction that depends on load, position,
    past or, other than linearly, on speed.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,), SI units, in ``layout.names`` order.

    Returns:
        A model of its own; what its URDF states of friction and damping is replaced.

    Raises:
        DataError: If pi has another length, or a value that is no finite number below 1e30.
    """
    layout, made = model.layout, pin.Model(model.with_parameters(pi).pin_model)
    fields = {term: np.zeros(made.nv) for term in ("armature", "viscous", "coulomb", "offset")}
    missing = []
    parameters = zip(
        layout.drive_parameters, layout.drive_names, pi[layout.n_inertial :], strict=True
    )
    for (d, term), name, value in parameters:
        ratios = [(joint, ratio) for joint, ratio in layout.drives[d].ratios if ratio != 0.0]
        if term.name not in fields or len(ratios) != 1:
            missing += [name] if value != 0.0 and ratios else []
            continue
        ((joint, ratio),) = ratios
        # tau_j = r f(r v_j): a turn the other way round changes the sign of the offset alone
        share = {"coulomb": abs(ratio), "offset": ratio}.get(term.name, ratio**2)
        fields[term.name][made.joints[made.getJointId(joint)].idx_v] += share * value
    made.armature, made.damping = fields["armature"], fields["viscous"]
    made.lowerDryFrictionLimit = -fields["coulomb"] - fields["offset"]
    made.upperDryFrictionLimit = fields["coulomb"] - fields["offset"]
    if missing:
        warnings.warn(
            f"Pinocchio's model has no place for {listed(missing)}: torques from it are without "
            "them; predict(q, v, a) has them",
            stacklevel=4,
        )
    return made
