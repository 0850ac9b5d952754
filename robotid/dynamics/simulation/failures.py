"""Why a closed-loop simulation has no solution: friction, gains, or the rate of a controller."""

from typing import TYPE_CHECKING

import numpy as np

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.robot.drive_term import DIRECTED, MemorylessTerm
from robotid.robot.mass_matrix import rigid_mass_matrices
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.dynamics.simulation.loops import Loops


def why_no_solution(
    model: RobotModel, loops: "Loops", joints: Array, q: Array, last: int, step: float
) -> str:
    """Return why the joints of a part have no roll-out beyond their positions.

    joints (k,), q (k,) [rad or m].
    """
    M = _mass_matrix(model, loops, joints, q)
    if loops.rate is not None:
        return _slow_rate(loops, loops.rate, [model.joints[j] for j in joints], joints, M)
    for j, angle in zip(joints, q, strict=True):
        if why := _wrong_friction(model, loops, j, angle):
            return why
    name, kp, inertia = model.joints[joints[last]], float(loops.kp[joints[last]]), M[last, last]
    return (
        f"the simulation of {name} has no solution in steps of {step:g} s: its gain kp is {kp:.3g} "
        f"and its inertia {inertia:.3g}, wanted kp below {inertia / step**2:.3g} (inertia / "
        "step^2) and friction that opposes motion. State gains in [controller] that are closer to "
        "those of the drive, or a smaller step in [estimator]"
    )


def _wrong_friction(model: RobotModel, loops: "Loops", j: int, angle: float) -> str:
    """Return which friction of a joint makes its motion impossible or ambiguous; else ""."""
    name = model.joints[j]
    for term in loops.terms[j]:
        value, wanted = float(loops.values[loops.place(j, term)]), ""
        if term.is_nonnegative and value < 0.0:
            wanted = "0 or more"
        elif value > term.highest:
            wanted = f"at most {term.highest:g}"
        if wanted:
            return (
                f"the simulation of {name} has no solution: {name}.{term.name} is {value:.3g}, "
                f"wanted {wanted}. Set other friction terms of {name} in [drives]"
            )
    at_rest = float(friction_at_rest(loops, j, np.array([angle]))[0])
    if at_rest >= 0.0:
        return ""
    unit, force = ("m", "N") if model.limits[j].type == "prismatic" else ("rad", "N m")
    return (
        f"the simulation of {name} has no solution: its Coulomb friction is {at_rest:.3g} {force} "
        f"at {angle:.3g} {unit}, wanted 0 or more. Set other friction terms of {name} in [drives]"
    )


def friction_at_rest(loops: "Loops", j: int, q: Array) -> Array:
    """Return the friction of a joint without load that opposes the start of a motion, shape (N,).

    q (N,) [rad or m].
    """
    friction = np.zeros(len(q))
    for term in loops.terms[j]:
        if isinstance(term, MemorylessTerm) and term.kind == DIRECTED:
            friction += loops.values[loops.place(j, term)] * term.amplitude(q, np.zeros(len(q)))
    return friction


def _slow_rate(loops: "Loops", rate: float, names: list[str], joints: Array, M: Array) -> str:
    """Return the least rate of a discrete-time controller with inertias M, shape (k, k)."""
    kp, kd = loops.kp[joints], loops.kd[joints]
    least = 0.5 * np.linalg.eigvals(np.linalg.solve(M, np.diag(kd))).real.max()
    least = max([least, *(0.5 * kp[kd > 0] / kd[kd > 0])])
    return (
        f"the simulation of {listed(names)} is unstable: the controller's rate of {rate:g} Hz is "
        f"too low. Gains kp {listed(f'{x:.3g}' for x in kp)} and kd "
        f"{listed(f'{x:.3g}' for x in kd)} need about {least:.3g} Hz with these inertias. "
        "State the sampling rate of the drives' controllers in [controller], or leave it out"
    )


def _mass_matrix(model: RobotModel, loops: "Loops", joints: Array, q: Array) -> Array:
    """Return the mass matrix of joints at their positions, with armature, shape (k, k)."""
    pi = model.standard_parameters()
    pi[: model.layout.n_inertial] = loops.bodies.reshape(-1)
    bodies, every = model.with_parameters(pi), loops.zero.copy()
    every[joints] += q
    (M,) = rigid_mass_matrices(bodies, bodies.configurations(every[None]))
    own: Array = (M + np.diag(loops.armature))[np.ix_(joints, joints)]
    return own
