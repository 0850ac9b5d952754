"""Terms of the drives: those selected, those uncertain, and the motion that they depend on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from itertools import chain
from operator import attrgetter
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.constraint_rows import without_forces
from robotid.dynamics.rows import friction_directions
from robotid.dynamics.torque import drive_motion_along
from robotid.estimation.fitting.evaluation import Recording
from robotid.robot.drive_term import DriveMotion, DriveTerm, Family
from robotid.robot.drives import FAMILIES
from robotid.robot.model import RobotModel

_FARTHEST = 1.33  # largest factor by which a shape parameter changes in one step


@dataclass(frozen=True)
class Tried:
    """A set of drive terms that was tried for a joint."""

    families: tuple[str, ...]  # names of the families in addition to viscous and Coulomb friction
    held_out_error_pct: float  # residual of the held-out segments, relative to the torque [%]
    p_value: float  # p-value of the reduction of the held-out residual [-]; 1 without a reduction
    is_selected: bool  # whether it was selected


@dataclass(frozen=True)
class FoundShape:
    """An identified shape parameter of a friction term."""

    name: str  # its name, as ``stribeck.speed``
    value: float  # its value [unit]
    std_error: float  # its standard error [unit]
    unit: str  # its unit
    is_at_bound: bool  # whether it is at a bound of the search range


@dataclass(frozen=True)
class DriveChoice:
    """The terms selected for one joint's drive."""

    joint: str
    families: tuple[str, ...]  # names of the families in addition to viscous and Coulomb friction
    terms: tuple[DriveTerm, ...]
    tried: tuple[Tried, ...] = ()  # the sets of terms that were tried, step by step
    shapes: tuple[FoundShape, ...] = ()  # the identified shape parameters
    shape_covariance: tuple[tuple[float, ...], ...] = ()  # their covariance, row by row
    sizes: tuple[tuple[float, ...], ...] = ()  # values of the shape parameters of each family
    data_range: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # "q", |"v"|
    undecided: tuple[DriveTerm, ...] = ()  # not significant; errors include their change

    def to_dict(self) -> dict[str, Any]:
        """Return the sets tried, the selected families and the shapes, as plain values."""
        return {
            "families": list(self.families),
            "shapes": [asdict(shape) for shape in self.shapes],
            "data_range": {key: list(pair) for key, pair in self.data_range.items()},
            "tried": [{**asdict(step), "families": list(step.families)} for step in self.tried],
        }

    def moved(self, step: Array, covariance: Array) -> "DriveChoice":
        """Return the choice with shapes changed by a step (k,), by at most a third, in bounds."""
        flat = np.array(list(chain.from_iterable(self.sizes)))
        families = [FAMILIES[name] for name in self.families]
        bounds = np.array([s.within(self.data_range) for family in families for s in family.shapes])
        near = np.clip(flat + step, flat / _FARTHEST, flat * _FARTHEST)
        sizes = np.clip(near, *bounds.T)
        chosen = with_shapes(families, sizes)
        shapes = zip(self.shapes, sizes.tolist(), np.sqrt(np.diag(covariance)), strict=True)
        return replace(
            self,
            terms=self._terms_of(chosen),
            shapes=tuple(replace(x, value=size, std_error=float(e)) for x, size, e in shapes),
            shape_covariance=tuple(tuple(row) for row in covariance.tolist()),
            sizes=tuple(tuple(of_family) for _, of_family in chosen),
        )

    def altered(self, which: int, share: float) -> tuple[DriveTerm, ...]:
        """Return the terms with one of the shapes increased."""
        flat = np.array(list(chain.from_iterable(self.sizes)))
        flat[which] *= 1.0 + share
        return self._terms_of(with_shapes([FAMILIES[name] for name in self.families], flat))

    def _terms_of(self, chosen: Sequence[tuple[Family, list[float]]]) -> tuple[DriveTerm, ...]:
        made = (family.make(self.data_range, *sizes) for family, sizes in chosen)
        return tuple(chain.from_iterable(made))


def with_shapes(families: Sequence[Family], flat: Array) -> list[tuple[Family, list[float]]]:
    """Return each family with its shapes, from one array of all shapes: flat (k,)."""
    sizes = iter(flat.tolist())
    return [(family, [next(sizes) for _ in family.shapes]) for family in families]


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Motion and load of a joint in N rows of the fitted recordings."""

    q: Array  # (N,), positions [rad or m]
    v: Array  # (N,), speeds [rad/s or m/s]
    a: Array  # (N,), accelerations [rad/s^2 or m/s^2]
    direction: Array  # (N,), direction of friction: the sign of v, filtered as the torque [-]
    load: Array  # (N,), torque of the rigid bodies by the estimate [N m or N]
    travelled: Array  # (N,), distance since the last change of sign of v [rad or m]
    time: Array  # (N,), time since the start of the recording, over the longest duration [-]
    passes: float = np.inf  # cut-off frequency of the torque filter [Hz]; infinite without a filter
    longest: float = 1.0  # the longest duration of a recording [s]
    others: dict[str, "JointMotion"] = field(default_factory=dict)  # the joints before and after it
    scale: "JointMotion | None" = None  # motion whose typical values scale columns; None: this one

    @classmethod
    def steady(cls, motion: DriveMotion) -> "JointMotion":
        """Return the motion of a joint after long motion at constant speed, the others at rest."""
        none, far, m = np.zeros_like(motion.v), np.full_like(motion.v, np.inf), motion
        return cls(m.q, m.v, m.a, m.direction, m.load, travelled=far, time=none)

    def at(self, rows: slice | Array) -> "JointMotion":
        """Return the motion in some of the rows, without the other joints."""
        names = ("q", "v", "a", "direction", "load", "travelled", "time")
        some: dict[str, Any] = {name: getattr(self, name)[rows] for name in names}
        return replace(self, **some, others={}, scale=None)


def joint_motions(
    recordings: Sequence[Recording], rows: Sequence[Array], load: Array, model: RobotModel
) -> tuple[JointMotion, ...]:
    """Return the motion of each joint and its neighbours in some rows, with their load (N, n)."""
    motions = [recording.trajectory for recording in recordings]
    passes = max(recording.signals.cutoff or np.inf for recording in recordings)
    longest = max(float(np.ptp(m.t)) for m in motions) or 1.0
    n = len(model.joints)  # the pose and twist of a floating base come before them

    def joined(of: Callable[[Trajectory], Array]) -> Array:
        return np.concatenate([of(m)[k] for m, k in zip(motions, rows, strict=True)])

    q, v, a = (joined(attrgetter(name))[:, -n:] for name in "qva")
    signs, distance = joined(partial(_directions, model)), joined(travelled)
    time = joined(lambda m: (m.t - m.t[0]) / longest)
    columns = zip(q.T, v.T, a.T, signs.T, load.T, distance.T, strict=True)
    alone = [
        JointMotion(q_j, v_j, a_j, sign, load_j, far, time, passes, longest)
        for q_j, v_j, a_j, sign, load_j, far in columns
    ]
    return tuple(
        replace(motion, others={model.joints[k]: alone[k] for k in (j - 1, j + 1) if 0 <= k < n})
        for j, motion in enumerate(alone)
    )


def _directions(model: RobotModel, motion: Trajectory) -> Array:
    """Return the direction of the friction of each joint's own drive, shape (N, n)."""
    n = len(model.joints)
    signs = friction_directions(model.layout, motion.v, motion.direction)[:, :n]
    return signs if signs.shape[1] else np.sign(motion.v[:, -n:])


def travelled(motion: Trajectory) -> Array:
    """Return the distance of each joint since its last reversal, shape (N, n) [rad or m]."""
    is_first = np.diff(motion.segment, prepend=motion.segment[0] - 1) != 0
    q, v = (x[:, -len(motion.joints) :] for x in (motion.q, motion.v))
    reverses = (np.diff(np.sign(v), axis=0, prepend=0.0) != 0) | is_first[:, None]
    last = np.maximum.accumulate(np.where(reverses, np.arange(len(reverses))[:, None], 0), axis=0)
    return np.asarray(np.abs(q - np.take_along_axis(q, last, axis=0)))


@dataclass(frozen=True, eq=False)
class OpenTerm:
    """An uncertainty of a joint's drive model: an undecided term, or the error of a shape."""

    joint: str
    moves: Array  # (p,), change of the standard parameters that it causes
    torque: Callable[[DriveMotion, JointMotion], Array]  # (N,) [N m or N]


def open_torques(
    model: RobotModel, terms: Sequence[OpenTerm], recording: Recording, rows: Array
) -> list[Array]:
    """Return each open term's torque (k, n_rows), of a model with the bodies as reference."""
    if not terms:
        return []
    joints, first = model.joints, model.n_rows - len(model.joints)
    drives = drive_motion_along(model, recording.trajectory)
    load, every = drives.load[: len(joints)].T, np.arange(len(recording.trajectory.t))
    motions = joint_motions([recording], [every], load, model)
    torques = []
    for term in terms:
        j, torque = joints.index(term.joint), np.zeros((len(rows), model.n_rows))
        torque[:, first + j] = term.torque(drives.of(j), motions[j])[rows]
        basis = recording.trajectory.basis
        torques.append(torque if basis is None else without_forces(basis[rows], torque))
    return torques
