"""Where the unknowns of loops and drives begin, and how far from there they may be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid._typing import Array
from robotid.closed_loop.free_parameters import FreeParameter
from robotid.closed_loop.second_order import SecondOrder
from robotid.closed_loop.settings import LoopSettings
from robotid.closed_loop.zeros import Encoders
from robotid.robot.drives import DriveTerm, Viscous
from robotid.robot.mass_matrix import joint_mass_matrices
from robotid.robot.model import RobotModel
from robotid.simulation.loops import ClosedLoopRobot, Loops, Window
from robotid.simulation.settings import PerJoint

__all__ = [
    "TypicalSizes",
    "first_loops",
    "free_drive_parameters",
    "free_zeros",
    "is_stated",
    "likeness",
    "typical_sizes",
    "typical_sizes_of_torques",
]

_WIDE = 10.0  # spreads of drives are so many times their typical size: they bind nothing
_SHARE = 0.5  # of the loop's inertia by which gains are unknown, that bodies have to begin with
_SLOWEST = 0.1  # [s] spread of a delay
_TURN = 0.3  # [rad or m] spread of an encoder's zero about where it was found
_LIGHTEST = 0.3  # of the largest such inertia: small joints have a motor behind a gear, too
_POSES = 50  # that the bodies' inertia is looked at in
_LEAST = 0.05  # of a typical size, that an inertia begins with, or a gain keeps
_LIMITED = 0.8  # of the largest torque that was asked for, that a limit begins with


@dataclass(frozen=True, eq=False)
class TypicalSizes:
    """Typical sizes, joint by joint: where unknowns begin, and how far from there they may be.

    Attributes:
        inertia: Of the whole loop, shape (n,) [kg m^2 or kg].
        bodies: Of the URDF's bodies in it, likewise.
        torque: Torques, shape (n,) [N m or N].
        largest: Torques that the loop asked for, somewhat less, likewise.
        speed: Speeds, shape (n,) [rad/s or m/s].
        scale: Torques over those of the plain model, shape (n,) [-].
    """

    inertia: Array
    bodies: Array
    torque: Array
    largest: Array
    speed: Array
    scale: Array


def typical_sizes(
    robot: ClosedLoopRobot,
    plain: SecondOrder,
    windows: Sequence[Window],
    has_gain: Array,
    top: Array,
) -> TypicalSizes:
    """Return typical sizes; where a gain is unknown, the bodies' inertia measures all torques.

    A joint at its largest speed, ``top`` if more than 0, gives what friction takes there.

    Args:
        robot: The robot, which can be simulated.
        plain: A plain loop of each joint.
        windows: Windows of the logs.
        has_gain: Joints whose gain is known, shape (n,), bool.
        top: Speeds of joints that run at their largest, else 0, shape (n,) [rad/s or m/s].
    """
    model = robot.model
    q = np.concatenate([w.log.q[w.counted] for w in windows])
    bodies = _inertia(model, model.standard_parameters(), windows)
    measure = np.maximum(bodies, _LIGHTEST * bodies.max()) / _SHARE
    scale = np.where(has_gain, 1.0, measure / plain.inertia)
    inertia = np.maximum(plain.inertia * scale, bodies)  # friction may hide it from a plain loop
    error = np.concatenate([w.log.q_ref[w.counted] for w in windows]) - q  # type: ignore[index]
    asked = _LIMITED * plain.loops.kp * np.abs(error).max(axis=0)
    taken = plain.friction("viscous") * top + plain.friction("coulomb")
    largest = scale * np.where(top > 0.0, np.minimum(taken, asked), asked)
    return TypicalSizes(inertia, bodies, plain.torque * scale, largest, _speed(windows), scale)


def typical_sizes_of_torques(
    model: RobotModel, pi: Array, armature: Array, windows: Sequence[Window]
) -> TypicalSizes:
    """Return typical sizes where torques are logged and no loop is closed.

    Args:
        model: The robot.
        pi: Standard parameters, shape (p,).
        armature: Inertia of the motors, shape (n,) [kg m^2 or kg].
        windows: Windows of the logs.
    """
    tau = np.concatenate([w.log.tau[w.counted] for w in windows])
    torque = np.maximum(np.sqrt(np.mean(tau**2, axis=0)), 1e-6)
    inertia, one = _inertia(model, pi, windows), np.ones(len(armature))
    return TypicalSizes(inertia, inertia - armature, torque, np.inf * one, _speed(windows), one)


def _inertia(model: RobotModel, pi: Array, windows: Sequence[Window]) -> Array:
    """Return the typical inertia that each joint moves, shape (n,)."""
    q = np.concatenate([w.log.q[w.counted] for w in windows])
    M = joint_mass_matrices(model, pi, q[:: max(1, len(q) // _POSES)])
    typical: Array = np.median(np.diagonal(M, axis1=1, axis2=2), axis=0)
    return typical


def _speed(windows: Sequence[Window]) -> Array:
    """Return the typical speed of each joint, shape (n,)."""
    steps = [np.diff(w.log.q[w.counted], axis=0) / _period(w) for w in windows]
    speed: Array = np.maximum(np.sqrt(np.mean(np.concatenate(steps) ** 2, axis=0)), 1e-6)
    return speed


def _period(window: Window) -> float:
    """Return the time between the rows of a window's log [s]."""
    return float(np.median(np.diff(window.log.t)))


def first_loops(
    model: RobotModel, stated: Loops, plain: SecondOrder, typical: TypicalSizes, finds_limit: Array
) -> Loops:
    """Return the loops that the fit begins with.

    Args:
        model: The robot.
        stated: What is stated of the loops.
        plain: A plain loop of each joint.
        typical: Typical sizes.
        finds_limit: Joints whose limit is to be found, shape (n,), bool.
    """
    friction = {name: plain.friction(name) * typical.scale for name in ("viscous", "coulomb")}
    none = np.zeros(len(typical.scale))
    terms = tuple(
        tuple(
            term
            for d, term in model.layout.drive_parameters
            if model.layout.drives[d].name == joint and not term.is_inertia
        )
        for joint in model.joints
    )
    values = [friction.get(t.name, none)[j] for j, own in enumerate(terms) for t in own]
    return replace(
        stated,
        kp=stated.kp * typical.scale,
        armature=np.maximum(typical.inertia - typical.bodies, _LEAST * typical.inertia),
        delay=plain.loops.delay,
        limit=np.where(finds_limit, typical.largest, stated.limit),
        terms=terms,
        values=np.array(values),
    )


def free_drive_parameters(
    model: RobotModel,
    loop: LoopSettings,
    groups: Sequence[str],
    base: Loops,
    typical: TypicalSizes,
    *,
    tells_kd: bool,
    finds_limit: Array,
) -> list[FreeParameter]:
    """Return what is unknown of drives and loops, beginning with what the loops have.

    Args:
        model: The robot.
        loop: What is known of the loops.
        groups: Name of the group of each joint.
        base: The loops that the fit begins with.
        typical: Typical sizes.
        tells_kd: Whether the logs can show gains of the speed.
        finds_limit: Joints whose limit is to be found, shape (n,), bool.
    """
    members: dict[str, list[int]] = {}
    for j, group in enumerate(groups):
        members.setdefault(group, []).append(j)
    is_closed = np.full(len(groups), loop.kind != "torque")
    # a limit is a setting of each drive, a delay mostly the bus's and the controller's
    sharing: dict[str, dict[str, list[int]]] = {
        "limit": {joint: [j] for j, joint in enumerate(model.joints)}
    }
    if loop.delays == "one":
        sharing["delay"] = {"robot": [*range(len(groups))]}
    open_ = {
        "armature": np.full(len(groups), "armature" in model.layout.terms),
        "kp": ~is_stated(loop.kp, model) & is_closed,
        "kd": ~is_stated(loop.kd, model) & tells_kd,
        "limit": finds_limit,
        "delay": ~is_stated(loop.delay, model) & is_closed,
    }
    spread = {
        "armature": typical.inertia,
        "kp": base.kp / _WIDE,
        "kd": typical.torque / typical.speed,
        "limit": typical.torque,
        "delay": np.full(len(groups), _SLOWEST / _WIDE),
    }
    found = []
    for what, is_open in open_.items():
        for name, joints in sharing.get(what, members).items():
            own = tuple(j for j in joints if is_open[j])
            if own:
                begin = float(np.median(getattr(base, what)[list(own)]))
                wide = _WIDE * float(np.median(spread[what][list(own)]))
                lowest = _LEAST * begin if what in ("kp", "limit") else 0.0
                found.append(FreeParameter(f"{name}.{what}", what, own, begin, wide, lowest))
    for group, joints in members.items():
        for term in {t: None for j in joints for t in base.terms[j]}:
            having = [j for j in joints if term in base.terms[j]]
            # what wears and what leans differ from drive to drive, grease and motor do not
            for owners in [having] if isinstance(term, Viscous) else [[j] for j in having]:
                name = group if len(owners) > 1 else model.joints[owners[0]]
                found.append(_term(name, term, owners, base, typical))
    return found


def _term(
    owner: str, term: DriveTerm, joints: Sequence[int], base: Loops, typical: TypicalSizes
) -> FreeParameter:
    """Return the unknown of a term of one joint, or of several that share it."""
    begin = float(np.median([base.values[base.place(j, term)] for j in joints]))
    size = typical.torque / (typical.speed if isinstance(term, Viscous) else 1.0)
    wide = _WIDE * float(np.median(size[list(joints)]))
    lowest = 0.0 if term.is_nonnegative else -np.inf
    return FreeParameter(
        f"{owner}.{term.name}", "term", tuple(joints), begin, wide, lowest, term=term
    )


def free_zeros(model: RobotModel, encoders: Encoders) -> list[FreeParameter]:
    """Return the zeros of encoders that are not the URDF's, near where they were found.

    Args:
        model: The robot.
        encoders: Signs and zeros of the encoders.
    """
    return [
        FreeParameter(f"{model.joints[j]}.zero", "zero", (int(j),), float(encoders.zero[j]), _TURN)
        for j in np.flatnonzero(encoders.gain > 0)
    ]


def likeness(model: RobotModel) -> list[tuple[object, ...]]:
    """Return what makes joints alike: their limits, and mass and moments of their bodies.

    Args:
        model: The robot.
    """
    bodies = model.standard_parameters()[: model.layout.n_inertial].reshape(-1, 10)
    sizes = np.column_stack([bodies[:, 0], bodies[:, [4, 6, 9]]])
    found: list[tuple[object, ...]] = []
    for body, joint in zip(sizes, model.limits, strict=True):
        digits = tuple(f"{x:.2g}" for x in body)
        found.append((joint.type, f"{joint.effort:.3g}", f"{joint.velocity:.3g}", digits))
    return found


def is_stated(value: PerJoint | str | None, model: RobotModel) -> Array:
    """Return for which joints a number is stated, shape (n,), bool.

    Args:
        value: A number, or numbers by joint.
        model: The robot.
    """
    named = [
        value is not None and (not isinstance(value, Mapping) or joint in value)
        for joint in model.joints
    ]
    return np.array(named)
