"""An identified robot as a Pinocchio model, drives included."""

import warnings

import numpy as np
import pinocchio as pin

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.model import RobotModel


def pinocchio_model(model: RobotModel, pi: Array) -> pin.Model:
    """Return Pinocchio's model with inertias, armature, damping and dry friction of parameters.

    Bodies behind locked joints are part of the links before them. With q, v and a of the model,

    ``tau = rnea(q, v, a) + damping v - where(v > 0, lowerDryFrictionLimit, upperDryFrictionLimit)``

    is the predicted torque of moving joints: ``rnea`` includes the armature, and the dry friction
    of a joint that moves forwards is at its lower limit. Coulomb friction Fc and offset give the
    limits -Fc - offset and Fc - offset; at rest, dry friction is anywhere between them. With mimic
    joints or another order of joints, ``RobotModel.configurations`` and ``velocity_map`` convert
    the identified joints to Pinocchio's, and torques back.

    Terms without such a field are omitted, and a warning names them: friction and inertia of
    couplings, and friction that depends on load, position or an internal state or, other than
    linearly, on speed.

    pi (p,).
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
        # tau_j = r f(r v_j): a negative ratio changes the sign of the offset only
        share = {"coulomb": abs(ratio), "offset": ratio}.get(term.name, ratio**2)
        fields[term.name][made.joints[made.getJointId(joint)].idx_v] += share * value
    made.armature, made.damping = fields["armature"], fields["viscous"]
    made.lowerDryFrictionLimit = -fields["coulomb"] - fields["offset"]
    made.upperDryFrictionLimit = fields["coulomb"] - fields["offset"]
    if missing:
        warnings.warn(
            f"Pinocchio's model has no field for {listed(missing)}: its torques are without these "
            "terms; predict(q, v, a) includes them",
            stacklevel=4,
        )
    return made
