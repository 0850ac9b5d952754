"""The information of a motion's torques about the base parameters, and its gradient."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.rows import Tree, drive_motion, flatten, own_motion, tree_lanes, why_not
from robotid.robot.drive_term import DriveMotion, DriveTerm
from robotid.robot.model import RobotModel

#: The optimality criteria.
CRITERIA = ("D", "A", "E", "widest")
#: Of the finite differences of drive columns, in their argument's scale.
_STEP = np.finfo(float).eps ** (1 / 3)
_REVERSAL = 0.01  # [rad/s or m/s] speed over which the sign of friction changes


def fixed_tree(model: RobotModel) -> Tree:
    """Return a robot with a fixed base as arrays."""
    model.require_fixed("motion design")
    if (why := why_not(model)) is not None:
        raise SettingsError(f"{model.name}: no motion can be designed: {why}")
    return flatten(model)


class MotionRegressor:
    """Columns of the torque regressor of a robot's bodies along motions, and their gradient."""

    def __init__(self, model: RobotModel, columns: Array) -> None:
        self._tree = fixed_tree(model)
        self._shape = model.n_rows, len(columns)
        wanted = np.full((model.n_rows, model.layout.n_inertial), -1)
        is_inertial = columns < model.layout.n_inertial
        places = np.arange(model.n_rows * len(columns)).reshape(self._shape)
        wanted[:, columns[is_inertial]] = places[:, is_inertial]
        self._places = self._tree.places(wanted)
        self._work = self._tree.work_space()

    def __call__(self, q: Array, v: Array, a: Array) -> Array:
        """Return the columns at N samples, shape (n, b, N)."""
        N, lanes = len(q), tree_lanes()
        block = lanes.LANES
        out = np.zeros((self._shape[0] * self._shape[1], -(-N // block) * block))
        motion = own_motion(q, v, a)
        lanes.inertial_rows(self._tree, self._places, motion, self._work, out, (0, N))
        return out.reshape(*self._shape, -1)[..., :N]

    def pull(self, q: Array, v: Array, a: Array, weights: Array) -> Array:
        """Return the gradient of sum(weights * columns) by q, v and a, shape (3, N, n)."""
        by_column = np.array(weights.reshape(-1, len(q)), order="C")
        motion, out = own_motion(q, v, a), np.zeros((3, *q.shape))
        tree_lanes().pull_rows(self._tree, self._places, motion, by_column, self._work, out)
        return out


@dataclass(frozen=True, eq=False)
class Placements:
    """Poses of the m bodies of a robot at N samples, in the frame of its root link."""

    R: Array  # their rotations, shape (3, 3, m, N)
    p: Array  # the origins of their joints, shape (3, m, N) [m]

    @classmethod
    def along(cls, tree: Tree, q: Array) -> "Placements":
        """Return the poses of the bodies: q (N, n) [rad, m]."""
        R = np.empty((3, 3, len(tree.parents), len(q)))
        p = np.empty(R.shape[1:])
        tree_lanes().placements(tree, np.array(q, order="C"), tree.work_space(), R, p)
        return cls(R, p)


@dataclass(frozen=True, eq=False)
class MotionRows:
    """The regressor's base columns along a motion, and the quantities that their gradient needs."""

    W: Array  # row r, base column c at each of N samples, shape (n, b, N)
    motion: tuple[Array, Array, Array]  # q, v, a, shape (N, n) each
    load: Array  # torque of the bodies, (N, n)


@dataclass(frozen=True, eq=False)
class MotionInformation:
    """The rows W of the base problem along a motion, W beta = tau, and their gradient.

    Internal states of drives are steady, and the sign of friction is tanh(w / 0.01 rad/s).
    """

    model: RobotModel  # the robot, with a fixed base
    mapping: BaseMapping  # its base parameters
    beta: Array  # base parameters by which torques are computed, shape (b,)
    _regressor: MotionRegressor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        wanted = (len(self.mapping.independent),)
        if self.beta.shape != wanted:
            raise DataError(f"beta has shape {self.beta.shape}, expected {wanted}")
        regressor = MotionRegressor(self.model, self.mapping.independent)
        object.__setattr__(self, "_regressor", regressor)

    @cached_property
    def _drives(self) -> tuple[Array, Array]:
        """The columns of drive terms, and which drive parameter each is, shape (k,) each."""
        size = self.model.layout.n_inertial
        columns = np.flatnonzero(self.mapping.independent >= size)
        return columns, self.mapping.independent[columns] - size

    @cached_property
    def _terms(self) -> list[tuple[DriveTerm, list[int], list[int]]]:
        """Each term of the base drive parameters, which of those it has, and their drives."""
        by_term: dict[DriveTerm, tuple[list[int], list[int]]] = {}
        for k, parameter in enumerate(self._drives[1]):
            drive, term = self.model.layout.drive_parameters[parameter]
            places, drives = by_term.setdefault(term, ([], []))
            places.append(k)
            drives.append(drive)
        return [(term, *places) for term, places in by_term.items()]

    @cached_property
    def chains(self) -> Array:
        """Share of each joint (column) in each one's torque at rest, equal on a chain, (n, n)."""
        ratios = self.model.velocity_map != 0.0  # (m, n)
        chain = np.eye(len(ratios), dtype=bool)
        for i in range(len(ratios)):
            chain[i, [j - 1 for j in list(self.model.pin_model.supports[i + 1])[1:]]] = True
        linked = ratios.T.astype(int) @ (chain | chain.T) @ ratios > 0
        return np.asarray(linked / linked.sum(axis=1, keepdims=True))

    def rows(self, q: Array, v: Array, a: Array) -> MotionRows:
        """Return the rows along a motion of N samples."""
        W = self._regressor(q, v, a)
        load = (self.beta @ W).T  # drive columns are still 0
        columns, parameters = self._drives
        values = self._drive_values(self._drive_motion(q, v, a, load))
        W[:, columns] = self.model.layout.drive_loads[:, parameters, None] * values
        return MotionRows(W, (q, v, a), load)

    def _drive_motion(self, q: Array, v: Array, a: Array, load: Array) -> DriveMotion:
        """Return how the drives move, with smooth signs, arrays of shape (d, N)."""
        layout = self.model.layout
        motion = drive_motion(layout, q, v, a, v @ layout.drive_ratios.T, load)
        return self._with_signs(motion)

    def _with_signs(self, motion: DriveMotion) -> DriveMotion:
        """Return the motion of drives with the smooth signs of its speeds."""
        speeds = (motion.v.T / self.model.layout.drive_speeds).T
        return replace(motion, direction=np.tanh(speeds / _REVERSAL))

    def _drive_values(self, motion: DriveMotion) -> Array:
        """Return the factors of the base drive parameters, shape (k, N); of (d, ..., N), alike."""
        values = np.empty((len(self._drives[1]), *motion.v.shape[1:]))
        for term, places, drives in self._terms:
            values[places] = term.column(motion.of(drives))
        return values

    def torque(self, rows: MotionRows) -> Array:
        """Return the torque along the motion, shape (N, n) [N m or N]."""
        return np.asarray((self.beta @ rows.W).T)

    def pull(self, rows: MotionRows, weights: Array) -> tuple[Array, Array, Array]:
        """Return the gradient of sum(weights * W) by q, v and a, shape (N, n) each."""
        columns, parameters = self._drives
        loads = self.model.layout.drive_loads[:, parameters]
        by_value = np.einsum("rk,rkn->kn", loads, weights[:, columns])
        *direct, by_load = self._pull_drives(rows, by_value)
        entries = weights + by_load.T[:, None] * self.beta[:, None]
        bodies = self._regressor.pull(*rows.motion, entries)
        q, v, a = (x + y for x, y in zip(bodies, direct, strict=True))
        return q, v, a

    def _pull_drives(self, rows: MotionRows, weights: Array) -> list[Array]:
        """Return the gradient of sum(weights * values) by q, v, a and load, by differences."""
        layout, motion = self.model.layout, self._drive_motion(*rows.motion, rows.load)
        own = [layout.drive_parameters[k][0] for k in self._drives[1]]
        by_drive = np.zeros((len(layout.drives), len(own)))
        by_drive[own, np.arange(len(own))] = 1.0
        R = layout.drive_ratios
        share = R / np.sum(R**2, axis=1, keepdims=True).clip(min=1e-300)
        names = ("q", "v", "a", "load")
        steps = [_STEP * np.maximum(1.0, np.abs(getattr(motion, name))) for name in names]  # (d, N)
        beside = {}
        for k, (name, step) in enumerate(zip(names, steps, strict=True)):
            x = np.repeat(getattr(motion, name)[:, None], 2 * len(names), axis=1)  # (d, 8, N)
            x[:, 2 * k] += step
            x[:, 2 * k + 1] -= step
            beside[name] = x
        still = np.zeros_like(x)
        values = self._drive_values(self._with_signs(replace(motion, **beside, rate=still)))
        gradients = []
        for k, (name, step) in enumerate(zip(names, steps, strict=True)):
            slope = by_drive @ (weights * (values[:, 2 * k] - values[:, 2 * k + 1])) / (2 * step)
            gradients.append(slope.T @ (share if name == "load" else R))
        return gradients


def criterion(name: str, F: Array, widest: Array | None = None) -> tuple[float, Array]:
    """Return a criterion of information and its gradient: Pukelsheim (2006), chapter 6."""
    if name not in CRITERIA:
        raise SettingsError(f"criterion is {name!r}, expected one of {', '.join(CRITERIA)}")
    size = len(F)
    if name == "D":
        L, failed = scipy.linalg.lapack.dpotrf(F, lower=1)
        if not failed:
            inverse = scipy.linalg.lapack.dpotri(L, lower=1)[0]
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
            return -2.0 * float(np.log(np.diag(L)).mean()), -inverse / size
    values, vectors = np.linalg.eigh(F)
    values = np.maximum(values, values[-1] * np.finfo(float).eps)
    if name == "D":
        by_value = -1.0 / values / size
        return -float(np.log(values).mean()), (vectors * by_value) @ vectors.T
    if name == "A":
        total = float(np.sum(1.0 / values))
        by_value = -1.0 / values**2 / total
        return float(np.log(total / size)), (vectors * by_value) @ vectors.T
    if name == "widest":
        some = np.arange(size) if widest is None else widest
        C = (vectors[some] / values) @ vectors.T  # (k, b) of F^-1
        variance = C[np.arange(len(some)), some]
        return float(np.log(variance).mean()), -(C.T / variance) @ C / len(some)
    low = vectors[:, 0]
    return -float(np.log(values[0])), -np.outer(low, low) / values[0]
