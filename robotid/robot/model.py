"""The robot: a kinematic tree with Pinocchio's dynamics and named standard parameters."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import LARGEST_SETTING, require_each, require_flag, require_kind
from robotid.base.tolerances import TINY
from robotid.base.typing import Array, frozen, real_numbers
from robotid.robot.constraints import Constraint, Contact, Loop, check_constraints
from robotid.robot.drive_term import DriveMotion, DriveTerm
from robotid.robot.drives import DRIVE_TERMS, TERMS
from robotid.robot.parameters import DYNAMICS, Coupling, ParameterLayout
from robotid.robot.tree import (
    LARGEST,
    SMALLEST_LENGTH,
    Joint,
    Tree,
    choose_joints,
    mimic_followers,
    read_tree,
)

GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2]
_STRONGEST = 100.0  # [m/s^2] with more, accelerations are negligible beside gravity


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot to identify.

    Joint coordinates q are one angle or length per joint, in the order of ``joints``; for a
    floating base they start with its pose [x y z qx qy qz qw], and v with its twist in the base
    frame. Continuous joints are angles here too; ``configurations`` returns Pinocchio's form.

    Attributes:
        tree: The URDF.
        pin_model: Pinocchio's model; bodies behind locked joints are lumped.
        layout: Names and order of the standard parameters.
        velocity_map: Matrix G with v_pinocchio = G v, shape (nv, n_rows): order of joints, mimic.
        position_offset: Constant part of the joint coordinates of mimic joints, shape (nv,).
        free_flyer: Whether the base floats.
        locked: Positions of the locked joints [rad or m].
        mimic: Treatment of mimic joints: "independent" or "coupled".
        reference: Standard parameters for torques in drive terms, for example the joint load
            torque, shape (p,); None: those of the URDF.
        dynamics: "full", or "static" for logs of poses and slow motion: velocities and
            accelerations are used for the sign of friction only.
        constraints: Contacts with the ground, and loops that close kinematic chains.
        assumed: Why the inertial of a body is not the URDF's, by its name; see
            ``with_assumed_inertials``.
    """

    tree: Tree
    pin_model: pin.Model
    layout: ParameterLayout
    velocity_map: Array
    position_offset: Array
    free_flyer: bool
    locked: Mapping[str, float]
    mimic: str
    reference: Array | None = None
    dynamics: str = "full"
    constraints: tuple[Constraint, ...] = ()
    assumed: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return (
            f"<RobotModel {self.name}: {len(self.joints)} joints, {listed(self.joints)}; "
            f"{len(self.layout.names)} standard parameters>"
        )

    @classmethod
    def from_urdf(
        cls,
        path: str | Path | Tree,
        *,
        joints: Sequence[str] | None = None,
        locked: Mapping[str, float] | None = None,
        free_flyer: bool = False,
        mimic: str = "independent",
        gravity: Sequence[float] = GRAVITY,
        terms: Sequence[str] = DRIVE_TERMS,
        couplings: Sequence[Coupling] = (),
        own_terms: Mapping[str, Sequence[DriveTerm]] | None = None,
        dynamics: str = "full",
        snap_angles: bool = False,
        constraints: Sequence[Constraint] = (),
        passive: Sequence[str] = (),
    ) -> "RobotModel":
        """Read a robot from a URDF. Meshes are not needed.

        Args:
            path: The URDF file, or its tree.
            joints: The joints that move, in the wanted order; if None all, in Pinocchio's order.
            locked: Positions of locked joints [rad or m], "*" that of all others; a joint that is
                neither in ``joints`` nor here is locked at 0, or follows the joint that it mimics.
            free_flyer: Whether the base floats; its six rows are the first ones.
            mimic: "independent" treats a mimic joint as a joint with its own torque; "coupled"
                moves it with the joint that it mimics, whose torque drives both.
            gravity: Gravity in the frame of the root link, shape (3,) [m/s^2].
            terms: Drive terms that are parameters, of armature, viscous, coulomb and offset.
            couplings: Drives that move several joints.
            own_terms: Further terms of single drives, by name of the joint or coupling.
            dynamics: "full"; or "static" for gravity, with drive terms that act at zero speed.
            snap_angles: Whether rounded angles of joint origins, as 3.1416, become exact multiples
                of pi/12; see ``exact_angle``.
            constraints: Contacts with the ground and closed loops; their forces are unknown.
            passive: Joints without a drive: their torque is 0, and they have no drive terms except
                those in ``own_terms``.

        Returns:
            The model.

        Raises:
            ModelError: If the URDF or a number is not usable, or a joint is not in the URDF.
            SettingsError: If a term or a coupling is unknown.
        """
        locked = {} if locked is None else locked
        own_terms = {} if own_terms is None else own_terms
        require_kind(path, (str, Path, Tree), "path", "the path of a URDF")
        require_kind(joints, (list, tuple, str, type(None)), "joints", "a list of names")
        require_kind(locked, Mapping, "locked", "a table of positions by joint")
        require_kind(own_terms, Mapping, "own_terms", "a table of terms by joint")
        for name in (*(joints or ()), *locked):
            require_kind(name, str, "one of joints or locked", "the name of a joint")
        require_each(terms, str, "terms", f"a list of some of {listed(DRIVE_TERMS)}")
        require_each(passive, str, "passive", "a list of names of joints")
        require_each(couplings, Coupling, "couplings", "a list of Coupling")
        for name, further in own_terms.items():
            require_each(further, DriveTerm, f"own_terms of {name!r}", "a list of drive terms")
        require_flag(free_flyer, "free_flyer")
        require_flag(snap_angles, "snap_angles")
        tree = path if isinstance(path, Tree) else read_tree(path)
        tree = tree.snapped() if snap_angles else tree
        check_constraints(constraints, tree.links, Path(tree.path).name, own_terms)
        for name, word, known in (
            ("mimic", mimic, ("independent", "coupled")),
            ("dynamics", dynamics, DYNAMICS),
        ):
            require_kind(word, str, name, f"one of {listed(known)}")
            if word not in known:
                raise ModelError(f"{name} is {word!r}, expected one of {listed(known)}")
        if dynamics == "static":
            terms, own_terms = _terms_at_rest(terms, own_terms, gravity)
        if not (tree.movable or free_flyer):
            raise ModelError(
                f"{Path(tree.path).name}: robot {tree.name!r} has no movable joint, so there is "
                "nothing to identify; a free body needs free_flyer=True"
            )
        followers = mimic_followers(tree) if mimic == "coupled" else {}
        full = _build(tree, free_flyer, gravity)
        first = 2 if free_flyer else 1  # Pinocchio's joint 0 is the world, 1 may be the base
        free = [name for name in list(full.names)[first:] if name not in followers]
        moving, positions = choose_joints(tree, free, joints, locked, followers)
        if not moving and not free_flyer:
            raise ModelError("all joints are locked, so there is nothing to identify; unlock one")
        reduced = _reduce(full, positions)
        G, shift = _velocity_map(reduced, moving, followers, free_flyer)
        child = {joint.name: joint.child for joint in tree.movable}
        prismatic = [joint for joint in tree.movable if joint.type == "prismatic"]
        layout = ParameterLayout(
            bodies=((tree.root,) if free_flyer else ())
            + tuple(child[name] for name in list(reduced.names)[first:]),
            joints=moving,
            terms=tuple(terms),
            couplings=tuple(couplings),
            prismatic=frozenset(joint.name for joint in prismatic),
            strokes={j.name: j.upper - j.lower for j in prismatic if j.has_limits},
            own={name: tuple(terms) for name, terms in own_terms.items() if terms},
            passive=frozenset(passive),
        )
        return cls(
            tree, reduced, layout, G, shift, free_flyer, positions, mimic,
            dynamics=dynamics, constraints=tuple(constraints),
        )  # fmt: skip

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of ``from_urdf`` that build this model from its tree, except couplings."""
        followers = {j.name for j in self.tree.movable if j.mimic and self.mimic == "coupled"}
        return {
            "joints": list(self.joints),
            "locked": {j: float(x) for j, x in self.locked.items() if j not in followers},
            "gravity": [float(g) for g in self.pin_model.gravity.linear],
            "free_flyer": self.free_flyer,
            "mimic": self.mimic,
            "dynamics": self.dynamics,
            "terms": list(self.layout.terms),
            "own_terms": {
                name: [term.to_dict() for term in terms] for name, terms in self.layout.own.items()
            },
        } | ({"passive": list(self.passive)} if self.passive else {})

    @property
    def is_static(self) -> bool:
        """Whether only poses at rest and slow motion are used."""
        return self.dynamics == "static"

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """The contacts with the ground, in the order of the constraints."""
        return tuple(x for x in self.constraints if isinstance(x, Contact))

    @property
    def loops(self) -> tuple[Loop, ...]:
        """The loops that close kinematic chains, in the order of the constraints."""
        return tuple(x for x in self.constraints if isinstance(x, Loop))

    @property
    def passive(self) -> tuple[str, ...]:
        """Names of the joints without a drive, in the order of q."""
        return tuple(joint for joint in self.joints if joint in self.layout.passive)

    @property
    def name(self) -> str:
        """Name of the robot in the URDF."""
        return self.tree.name

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that move, in the order of q."""
        return self.layout.joints

    @property
    def n_rows(self) -> int:
        """Rows of the regressor per sample: one per joint, and six of a floating base."""
        return int(self.velocity_map.shape[1])

    @property
    def row_names(self) -> tuple[str, ...]:
        """Names of the rows: base force and moment if the base floats, then the joints."""
        base = ("base.fx", "base.fy", "base.fz", "base.mx", "base.my", "base.mz")
        return (base if self.free_flyer else ()) + self.joints

    @property
    def row_units(self) -> tuple[str, ...]:
        """Unit of the torque in each row: N m, or N for forces and prismatic joints."""
        is_force = [n in self.layout.prismatic or n.startswith("base.f") for n in self.row_names]
        return tuple("N" if force else "N m" for force in is_force)

    @property
    def limits(self) -> tuple[Joint, ...]:
        """The moving joints as the URDF describes them, limits included, in the order of q."""
        by_name = {joint.name: joint for joint in self.tree.movable}
        return tuple(by_name[name] for name in self.joints)

    @property
    def length(self) -> float:
        """The longest distance between neighbouring joints [m]; 1 if all axes are within 1 cm."""
        placements = self.pin_model.jointPlacements[1:]
        longest = max(float(np.linalg.norm(placement.translation)) for placement in placements)
        return longest if longest > SMALLEST_LENGTH else 1.0

    @property
    def carried_by(self) -> Array:
        """Standard parameters for the joint load torques in drive terms, shape (p,)."""
        return self.standard_parameters() if self.reference is None else self.reference

    def standard_parameters(self) -> Array:
        """Return the URDF's standard parameters, (p,), SI units, with drive terms of 0."""
        return self._standard_parameters.copy()

    @cached_property
    def _standard_parameters(self) -> Array:
        inertial = [inertia.toDynamicParameters() for inertia in self.pin_model.inertias[1:]]
        return np.concatenate([*inertial, np.zeros(len(self.layout.drive_names))])

    def with_terms(self, own: Mapping[str, Sequence[DriveTerm]]) -> "RobotModel":
        """Return the same robot with other terms of single drives, and no reference.

        Args:
            own: The terms, by name of the joint or coupling.
        """
        require_kind(own, Mapping, "own", "a table of drive terms")
        by_drive = {
            name: tuple(require_each(terms, DriveTerm, f"own of {name!r}", "drive terms"))
            for name, terms in own.items()
            if terms
        }
        return replace(self, layout=replace(self.layout, own=by_drive), reference=None)

    def with_gravity(self, gravity: Array) -> "RobotModel":
        """Return the same robot under another gravity.

        Args:
            gravity: In the root link's frame, shape (3,) [m/s^2].
        """
        gravity = real_numbers(gravity, "gravity")
        if gravity.shape != (3,):
            raise DataError(f"gravity has shape {gravity.shape}, expected (3,)")
        pin_model = self.pin_model.copy()
        pin_model.gravity.linear = gravity
        return replace(self, pin_model=pin_model)

    def with_turned_axis(self, joint: str, rotation: Array, is_carried: bool) -> "RobotModel":
        """Return the same robot with another direction of a joint's axis.

        Args:
            joint: Its name.
            rotation: Of the axis, in the joint's frame, shape (3, 3).
            is_carried: Whether the links that it carries turn with its frame, as with another
                origin of the joint; else they stay at its position 0, as with another axis.
        """
        pin_model = pin.Model(self.pin_model)
        k, turn = pin_model.getJointId(joint), pin.SE3(rotation, np.zeros(3))
        pin_model.jointPlacements[k] = pin_model.jointPlacements[k] * turn
        if not is_carried:
            back = turn.inverse()
            pin_model.inertias[k] = back.act(pin_model.inertias[k])
            for child in pin_model.children[k]:
                pin_model.jointPlacements[child] = back * pin_model.jointPlacements[child]
        return replace(self, pin_model=pin_model)

    def with_reference(self, pi: Array) -> "RobotModel":
        """Return the same robot with another reference for the torques in drive terms.

        Args:
            pi: Standard parameters, shape (p,).
        """
        return replace(self, reference=pi)

    def with_parameters(self, pi: Array) -> "RobotModel":
        """Return the same robot with other inertial parameters.

        Args:
            pi: Standard parameters, shape (p,) or only the inertial ones, shape (10 bodies,).
        """
        pi, size = real_numbers(pi, "pi"), self.layout.n_inertial
        if pi.shape not in ((size,), (len(self.layout.names),)):
            raise DataError(f"pi has shape {pi.shape}, expected ({len(self.layout.names)},)")
        for i in np.flatnonzero(~(np.abs(pi[:size]) <= LARGEST_SETTING)).tolist():
            name, unit = self.layout.names[i], self.layout.units[i]
            raise DataError(
                f"{name} is {pi[i]:g} {unit}, expected a finite number below {LARGEST_SETTING:g}"
            )
        copy = pin.Model(self.pin_model)
        for i, values in enumerate(pi[:size].reshape(-1, 10)):
            copy.inertias[i + 1] = _inertia(values)
        return replace(self, pin_model=copy)

    def configurations(self, q: Array) -> Array:
        """Return Pinocchio's configurations (N, nq): a continuous joint is cosine and sine.

        Args:
            q: Joint coordinates, shape (N, n), or (N, 7 + n) with a floating base [rad, m].
        """
        base, q = 7 if self.free_flyer else 0, real_numbers(q, "q")
        wanted = base + len(self.joints)
        if q.ndim != 2 or q.shape[1] != wanted:
            raise DataError(f"q has shape {q.shape}, expected (N, {wanted})")
        if not (np.abs(q).max(initial=0.0) <= LARGEST):  # not NaN either
            row, column = np.argwhere(~(np.abs(q) <= LARGEST))[0].tolist()
            raise DataError(
                f"q[{row}, {column}] is {q[row, column]:g}, expected a number within +-{LARGEST:g}"
            )
        if self.free_flyer:
            sizes = np.linalg.norm(q[:, 3:7], axis=1)
            for row in np.flatnonzero(np.abs(sizes - 1.0) > TINY).tolist():
                raise DataError(
                    f"q[{row}, 3:7], the quaternion of the base, has length {sizes[row]:g}, "
                    "expected 1, in the order qx qy qz qw"
                )
        first = 6 if self.free_flyer else 0
        angles = q[:, base:] @ self.velocity_map[first:, first:].T + self.position_offset[first:]
        if self.pin_model.nq == self.pin_model.nv:
            return angles
        configuration = np.empty((len(q), self.pin_model.nq))
        configuration[:, :base] = q[:, :base]
        for joint in list(self.pin_model.joints)[2 if self.free_flyer else 1 :]:
            angle = angles[:, joint.idx_v - first]
            if joint.nq == 2:
                configuration[:, joint.idx_q] = np.cos(angle)
                configuration[:, joint.idx_q + 1] = np.sin(angle)
            else:
                configuration[:, joint.idx_q] = angle
        return configuration

    def require_fixed(self, what: str) -> None:
        """Refuse a robot whose base floats, or that has contacts or loops.

        Args:
            what: What needs a fixed base, as "motion design".
        """
        if self.free_flyer or self.constraints:
            fault = "the base floats" if self.free_flyer else "the robot has contacts or loops"
            raise DataError(f"{self.name}: {fault}; {what} needs a robot with a fixed base")

    @cached_property
    def support(self) -> Array:
        """Which parameters affect which row for some motion, shape (n_rows, p), bool."""
        pin_model = self.pin_model
        moves = np.zeros((pin_model.nv, pin_model.njoints), dtype=bool)  # which speeds, which body
        for body in range(1, pin_model.njoints):
            first = pin_model.idx_vs[body]
            moves[:, body] = moves[:, pin_model.parents[body]]
            moves[first : first + pin_model.nvs[body], body] = True
        inertial = np.repeat((self.velocity_map.T != 0) @ moves[:, 1:], 10, axis=1)
        drive = np.zeros((self.n_rows, len(self.layout.drive_names)), dtype=bool)
        drive[self.n_rows - len(self.joints) :] = self.layout.drive_loads != 0.0
        return frozen(np.hstack([inertial, drive]), np.bool_)


def pinocchio_model(model: RobotModel, pi: Array) -> pin.Model:
    """Return Pinocchio's model with inertias, armature, damping and dry friction of pi (p,).

    ``tau = rnea(q, v, a) + damping v - where(v > 0, lowerDryFrictionLimit, upperDryFrictionLimit)``
    is the predicted torque of moving joints, with the limits -Fc - offset and Fc - offset;
    ``RobotModel.configurations`` and ``velocity_map`` convert the identified joints to Pinocchio's.
    A warning names terms without such a field, which are omitted.
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


def _terms_at_rest(
    terms: Sequence[str], own_terms: Mapping[str, Sequence[DriveTerm]], gravity: Sequence[float]
) -> tuple[list[str], dict[str, list[DriveTerm]]]:
    """Return the drive terms that act at rest."""
    if not np.any(_gravity(gravity)):
        raise SettingsError(
            "dynamics is 'static', but gravity is 0, expected gravity that loads the joints"
        )
    common = [x for x in terms if x not in TERMS or _acts_at_rest(TERMS[x])]
    return common, {name: list(filter(_acts_at_rest, own)) for name, own in own_terms.items()}


def _acts_at_rest(term: DriveTerm) -> bool:
    """Return whether a term acts at the speed 0, in the direction of friction or without one."""
    still, one = np.zeros(2), np.array([0.5, 1.0])
    slow = DriveMotion(q=one, v=still, a=still, direction=one, load=one, rate=still)
    return bool(term.column(slow).any())


def _inertia(values: Array) -> pin.Inertia:
    """Return Pinocchio's inertia from ten parameters; without mass it has no centre of mass."""
    if values[0] != 0.0:
        return pin.Inertia.FromDynamicParameters(values)
    xx, xy, yy, xz, yz, zz = values[4:]
    massless = pin.Inertia.Zero()
    massless.inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])  # inconsistent ones too
    return massless


def _build(tree: Tree, free_flyer: bool, gravity: Sequence[float]) -> pin.Model:
    acceleration = _gravity(gravity)
    root = (pin.JointModelFreeFlyer(),) if free_flyer else ()
    for name in [joint.name for joint in tree.movable]:
        if name == "universe" or (free_flyer and name == "root_joint"):
            raise ModelError(
                f"{Path(tree.path).name}: a joint is named {name!r}, which is reserved by "
                "Pinocchio; rename it"
            )
    try:
        model = pin.buildModelFromXML(tree.xml, *root)
    except (ValueError, RuntimeError) as error:
        raise ModelError(f"{Path(tree.path).name}: Pinocchio cannot read it: {error}") from error
    lost = [link for link in tree.links if not model.existBodyName(link)]
    lost += [joint.name for joint in tree.movable if not model.existJointName(joint.name)]
    mass = sum(inertia.mass for inertia in model.inertias)
    stated = sum(inertial.mass for inertial in tree.inertials.values())
    if lost or not math.isclose(mass, stated, rel_tol=1e-9):  # it omits what it cannot read
        raise ModelError(
            f"{Path(tree.path).name}: Pinocchio cannot read it: its model lacks {listed(lost)}, "
            f"and has {mass:g} kg, expected {stated:g} kg"
        )
    model.gravity.linear = acceleration
    return model


def _gravity(gravity: Sequence[float]) -> Array:
    try:
        acceleration = np.asarray(gravity, dtype=float)
    except (TypeError, ValueError, OverflowError):
        acceleration = np.full(3, math.nan)
    if acceleration.shape != (3,) or not (np.abs(acceleration) <= _STRONGEST).all():
        shown = listed(gravity) if isinstance(gravity, list | tuple) else repr(gravity)
        raise ModelError(
            f"gravity is {shown}, expected three finite numbers within +-{_STRONGEST:g} [m/s^2]"
        )
    return acceleration


def _reduce(model: pin.Model, positions: Mapping[str, float]) -> pin.Model:
    reference = pin.neutral(model)
    ids = [model.getJointId(name) for name in positions]
    for i, position in zip(ids, positions.values(), strict=True):
        joint = model.joints[i]
        value = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
        reference[joint.idx_q : joint.idx_q + joint.nq] = value
    return pin.buildReducedModel(model, sorted(ids), reference) if ids else model


def _velocity_map(
    model: pin.Model,
    moving: Sequence[str],
    followers: Mapping[str, tuple[str, float, float]],
    free_flyer: bool,
) -> tuple[Array, Array]:
    base = 6 if free_flyer else 0
    G = np.eye(model.nv, base + len(moving))
    G[base:] = 0.0
    shift = np.zeros(model.nv)
    for name, joint in list(zip(model.names, model.joints, strict=True))[2 if free_flyer else 1 :]:
        leader, ratio, offset = followers.get(name, (name, 1.0, 0.0))
        G[joint.idx_v, base + moving.index(leader)] = ratio
        shift[joint.idx_v] = offset
    return G, shift
