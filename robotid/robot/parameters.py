"""Names and order of the standard parameters, pseudo-inertia, physical consistency."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from functools import cache, cached_property
from numbers import Real

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import (
    Entries,
    Settings,
    require_each,
    require_flag,
    require_kind,
    setting,
)
from robotid.base.typing import Array, frozen
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import DRIVE_TERMS, TERMS
from robotid.robot.tree import LARGEST

#: The identified dynamics: all, or those of poses at rest and slow motion.
DYNAMICS = ("full", "static")
#: Inertial parameters of one body in Pinocchio's order; inertia about the joint frame.
INERTIAL_TERMS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
#: The same ten in the paper's order (9).
PAPER_TERMS = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "mcx", "mcy", "mcz", "m")


@dataclass(frozen=True)
class Coupling(Settings):
    """A drive with w = sum_j ratio_j v_j: ``tau_j += ratio_j (Ia dw/dt + Fv w + Fc sign w)``."""

    name: str = setting(MISSING, "name of the drive, used in parameter names")
    ratios: tuple[tuple[str, float], ...] = setting(
        MISSING,
        "ratio by joint [-]; in Python, pairs",
        reads=Entries(dict, (int, float)),
        load=lambda table: tuple((joint, float(ratio)) for joint, ratio in table.items()),
        dump=dict,
    )
    replaces: bool = setting(
        False,
        "whether it replaces the own drive of the joint with its name, and has an offset then; if "
        "not, it is an additional drive",
        dump=lambda replaces: replaces or None,
    )

    def __post_init__(self) -> None:
        wanted = "pairs of a joint's name and a number"
        require_kind(self.name, str, "name", "the name of a coupling")
        require_flag(self.replaces, "replaces")
        for pair in require_each(self.ratios, (tuple, list), "ratios", wanted):
            is_pair = len(pair) == 2 and isinstance(pair[0], str) and isinstance(pair[1], Real)
            if not is_pair or isinstance(pair[1], bool):
                raise SettingsError(f"ratios of {self.name!r} has {pair!r}, expected {wanted}")


@dataclass(frozen=True)
class ParameterLayout:
    """The standard parameters: ten inertial ones per body, drive terms by joint, by coupling."""

    bodies: tuple[str, ...]  # one per movable joint, and one for a floating base
    joints: tuple[str, ...]  # those that move
    terms: tuple[str, ...] = DRIVE_TERMS  # the drive terms of all drives, in the order of ``TERMS``
    couplings: tuple[Coupling, ...] = ()  # drives that move several joints
    prismatic: frozenset[str] = frozenset()  # names of the prismatic joints
    strokes: Mapping[str, float] = field(default_factory=dict)  # their ranges, if limited [m]
    # further terms of single drives, by the drive's name; they follow the others
    own: Mapping[str, tuple[DriveTerm, ...]] = field(default_factory=dict)
    passive: frozenset[str] = frozenset()  # joints without a drive: they have ``own`` terms only

    def __post_init__(self) -> None:
        if unknown := [term for term in self.terms if term not in TERMS]:
            raise SettingsError(f"unknown drive terms {listed(unknown)}; known: {listed(TERMS)}")
        for coupling in self.couplings:
            named = [joint for joint, _ in coupling.ratios]
            named += [coupling.name] if coupling.replaces else []
            if missing := [joint for joint in named if joint not in self.joints]:
                raise SettingsError(
                    f"coupling {coupling.name!r} has the joints {listed(missing)}, expected joints "
                    f"that are identified: {listed(self.joints)}"
                )
            for joint, ratio in coupling.ratios:
                if not abs(ratio) <= LARGEST:
                    raise SettingsError(
                        f"coupling {coupling.name!r}: the ratio of joint {joint!r} is {ratio!r}, "
                        f"expected a number within +-{LARGEST:g} [-]"
                    )
            if not any(ratio for _, ratio in coupling.ratios):
                raise SettingsError(
                    f"coupling {coupling.name!r} moves no joint: its ratios are "
                    f"{dict(coupling.ratios)}, expected one that is not 0; set it, for example "
                    f"ratios = {{ {self.joints[0]} = 1.0 }}, or omit the coupling"
                )
            if sum(drive.name == coupling.name for drive in self.drives) > 1:
                raise SettingsError(
                    f"coupling {coupling.name!r} has the name of a joint or of another drive, "
                    "expected a unique name"
                )
        strange = sorted(self.passive - set(self.joints))
        strange += [c.name for c in self.couplings if c.replaces and c.name in self.passive]
        if strange:
            raise SettingsError(
                f"passive has {listed(strange)}, expected joints that are identified and have no "
                f"drive: some of {listed(self.joints)}"
            )
        drives = [drive.name for drive in self.drives]
        if unknown := [name for name in self.own if name not in drives]:
            raise SettingsError(
                f"terms are given for {listed(unknown)}, expected drives: {listed(drives)}"
            )
        names = self.drive_names
        if len(set(names)) < len(names):
            twice = sorted({name for name in names if names.count(name) > 1})
            raise SettingsError(f"{listed(twice)} is given twice for one drive; remove one")

    @property
    def n_inertial(self) -> int:
        """Number of inertial parameters, 10 per body."""
        return 10 * len(self.bodies)

    @cached_property
    def drives(self) -> tuple[Coupling, ...]:
        """The drives: one per joint (or the coupling that replaces it), then other couplings."""
        instead = {c.name: c for c in self.couplings if c.replaces}
        own = [instead.get(joint, Coupling(joint, ((joint, 1.0),))) for joint in self.joints]
        return (*own, *(coupling for coupling in self.couplings if not coupling.replaces))

    @cached_property
    def drive_ratios(self) -> Array:
        """Ratios of the d drives' speeds to those of the joints, w = ratios v, shape (d, n) [-]."""
        ratios = np.zeros((len(self.drives), len(self.joints)))
        for row, drive in zip(ratios, self.drives, strict=True):
            for joint, ratio in drive.ratios:
                row[self.joints.index(joint)] = ratio
        return frozen(ratios)

    @cached_property
    def drive_speeds(self) -> Array:
        """Speed of each of the d drives that is equivalent to 1 rad/s, (d,) [rad/s or m/s]."""
        # a prismatic joint crosses its stroke, or 1 m, in the time of a revolution
        joints = [
            self.strokes.get(joint, 1.0) / (2 * np.pi) if joint in self.prismatic else 1.0
            for joint in self.joints
        ]
        weight = np.abs(self.drive_ratios) + 1e-300  # also of a coupling without a ratio yet
        return np.asarray(weight @ np.array(joints) / weight.sum(axis=1))

    @cached_property
    def drive_parameters(self) -> tuple[tuple[int, DriveTerm], ...]:
        """Index in ``drives`` of each drive parameter, and its term."""
        beside = len(self.drives) - len(self.joints)
        shared = [() if joint in self.passive else self.terms for joint in self.joints]
        shared += [tuple(term for term in self.terms if TERMS[term].is_shared)] * beside
        return tuple(
            (d, term)
            for d, (drive, names) in enumerate(zip(self.drives, shared, strict=True))
            for term in (*map(TERMS.__getitem__, names), *self.own.get(drive.name, ()))
        )

    @cached_property
    def remembering(self) -> tuple[int, ...]:
        """Drive parameters of terms with internal state or load; see ``Trajectory.memory``."""
        return tuple(k for k, (_, term) in enumerate(self.drive_parameters) if term.has_state)

    @property
    def follows_direction(self) -> bool:
        """Whether a term depends on the direction of friction."""
        return any(term.follows_direction for _, term in self.drive_parameters)

    @cached_property
    def is_coupled(self) -> Array:
        """Which drive parameters are friction or inertia of a coupling, flags, shape (k,), bool."""
        owned = [(self.drives[d] in self.couplings, term) for d, term in self.drive_parameters]
        return np.array([is_shared and term.is_shared for is_shared, term in owned], dtype=bool)

    @cached_property
    def drive_loads(self) -> Array:
        """Ratio of each joint's row to the column of a drive parameter, shape (n, k) [-]."""
        return np.asarray(self.drive_ratios[[d for d, _ in self.drive_parameters]].T)

    @cached_property
    def drive_names(self) -> tuple[str, ...]:
        """Names of the drive parameters, for example ``"elbow.viscous"``."""
        return tuple(f"{self.drives[d].name}.{term.name}" for d, term in self.drive_parameters)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of all p parameters, for example ``"forearm.mcx"``, ``"elbow.viscous"``."""
        inertial = tuple(f"{body}.{term}" for body in self.bodies for term in INERTIAL_TERMS)
        return inertial + self.drive_names

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Unit of each of the p parameters."""
        inertial = ["kg", *["kg m"] * 3, *["kg m^2"] * 6] * len(self.bodies)
        drive = [term.units[self._is_linear(d)] for d, term in self.drive_parameters]
        return tuple(inertial + drive)

    def owned_by(self, owners: Sequence[str]) -> Array:
        """Return which parameters belong to some bodies or joints, flags, shape (p,), bool."""
        return np.isin([name.rsplit(".", 1)[0] for name in self.names], list(owners))

    def scales(self, length: float) -> Array:
        """Return the scales (p,), 1 kg length^k, with which columns are comparable."""
        inertial = [1.0, *[length] * 3, *[length**2] * 6] * len(self.bodies)
        rotary = [t.is_inertia and not self._is_linear(d) for d, t in self.drive_parameters]
        return np.append(inertial, np.where(rotary, length**2, 1.0))

    def preference(self) -> Array:
        """Return the preference of each parameter as the name of a base parameter, shape (p,)."""
        # groups are short then: on a UR they have 59 further coefficients, else 142
        inertial = [0.1, *[0.3] * 3, *[1.0] * 6] * len(self.bodies)
        return np.array(inertial + [term.preference for _, term in self.drive_parameters])

    def is_nonnegative(self) -> Array:
        """Return which parameters cannot be negative by physics, flags, shape (p,), bool."""
        drive = [term.is_nonnegative for _, term in self.drive_parameters]
        return np.array([False] * self.n_inertial + drive)

    def _is_linear(self, d: int) -> bool:
        return {joint for joint, _ in self.drives[d].ratios} <= self.prismatic


def to_paper_order(pi: Array) -> Array:
    """Return inertial parameters (10 n,) in the order of the paper's vector (9), (10)."""
    order = [INERTIAL_TERMS.index(term) for term in PAPER_TERMS]
    return _by_body(pi)[:, order].reshape(-1)


@cache
def pseudo_inertia_basis() -> Array:
    """Return the ten symmetric matrices B_k with J(pi) = sum_k pi_k B_k, shape (10, 4, 4)."""
    basis = np.zeros((10, 4, 4))
    basis[0, 3, 3] = 1.0
    for axis in range(3):
        basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
    # Sigma = 1/2 tr(I) 1 - I: a second moment of mass about each axis
    for k, axis in ((4, 0), (6, 1), (9, 2)):
        basis[k, :3, :3] = 0.5 * np.eye(3)
        basis[k, axis, axis] = -0.5
    for k, (i, j) in ((5, (0, 1)), (7, (0, 2)), (8, (1, 2))):
        basis[k, i, j] = basis[k, j, i] = -1.0
    return frozen(basis)


def pseudo_inertia(pi: Array) -> Array:
    """Return J = [[Sigma, m c], [(m c)^T, m]] of n bodies, (n, 4, 4): Wensing 2018, (8)."""
    return np.asarray(np.einsum("nk,kij->nij", _by_body(pi), pseudo_inertia_basis()))


def inertial_from_pseudo_inertia(J: Array) -> Array:
    """Return the ten inertial parameters of bodies, (..., 10), from ``pseudo_inertia``'s J."""
    trace = np.trace(J[..., :3, :3], axis1=-2, axis2=-1)[..., None, None]
    inertia = trace * np.eye(3) - J[..., :3, :3]
    i, j = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)  # xx xy yy xz yz zz
    return np.concatenate([J[..., 3, 3, None], J[..., :3, 3], inertia[..., i, j]], axis=-1)


def _by_body(pi: Array | Sequence[float]) -> Array:
    values = np.asarray(pi, dtype=float)
    if values.ndim != 1 or values.size % 10:
        raise DataError(
            f"inertial parameters have shape {values.shape}, expected a vector of 10 per body"
        )
    return values.reshape(-1, 10)
