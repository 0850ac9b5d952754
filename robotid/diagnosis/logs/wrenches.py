"""Check of measured forces of the ground: sign, unit, axes, place, and the foot that they act on.

With the bodies of the URDF, W pi = J^T f in the rows of a floating base. Each error of the columns
is a change of f or J, which is tried.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from robotid.base.findings import Finding, listed, log_finding
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.diagnosis.logs.slips import rms
from robotid.dynamics.constraint_rows import (
    constraint_jacobian,
    force_basis,
    touching,
    without_forces,
)
from robotid.dynamics.prediction import predict
from robotid.robot.constraints import Contact, link_positions
from robotid.robot.model import RobotModel

_MOST = 400  # samples that are examined
_BETTER = 0.5  # ratio of the residuals of force or moment below which another reading is found ...
_FORCE, _MOMENT = 0.3, 0.05  # ... of the weight, and of it at the feet's distance: masses may be it
_NO_WORSE = 1.2  # ... if that of the other one is not above this
_SIMPLER = 1.2  # ... and another change is not found unless it reduces the residual by this factor
_SMALL = 0.01  # residual of force or moment that is as good as none, relative to the weight
_ALIKE = (0.6, 1.6)  # factors of the forces that a wrong URDF explains
_UNITS = {", kN": 1e3, ", kgf": 9.81}
_MISSING = 0.5  # of the weight: residual of the force from which a reading explains nothing


@dataclass(frozen=True, eq=False)
class _Reading:
    """Residuals of the base rows with the forces read in one way."""

    changes: tuple[str, ...]  # what differs from the job file
    is_exchanged: bool  # whether the forces of two feet are exchanged
    factor: float  # of the forces
    residual: Array  # (N, 6) [N, N m]
    weight: float  # RMS of the force of the base that is not caused by unknown forces [N]

    @property
    def sizes(self) -> tuple[float, float]:
        """RMS of force [N] and moment [N m]."""
        force, moment = self.residual[:, :3], self.residual[:, 3:]
        return rms(force), rms(moment)

    def is_better(self, than: "_Reading", least: Sequence[float]) -> bool:
        """Whether its residual is clearly smaller, one of force or moment that is not small."""
        pairs = list(zip(self.sizes, than.sizes, least, strict=True))
        is_no_worse = all(x < max(_NO_WORSE * y, small) for x, y, small in pairs)
        return is_no_worse and any(y > small and x < _BETTER * y for x, y, small in pairs)


def check_wrenches(model: RobotModel, log: Log, motion: Trajectory) -> Iterator[Finding]:
    """Yield findings on the measured wrenches of one log."""
    measured = [x for x in model.contacts if x.measured]
    if motion.wrenches is None or not measured:
        return
    motion = motion.every(max(1, len(motion.t) // _MOST))
    (torque,) = predict(model, [model.standard_parameters()], motion)
    weight = sum(x.mass for x in model.pin_model.inertias) * float(
        np.linalg.norm(model.pin_model.gravity.linear)
    )
    feet = link_positions(
        model.pin_model, model.configurations(motion.q), [x.frame for x in measured]
    )
    lever = float(np.sqrt(np.mean(np.sum((feet - motion.q[:, None, :3]) ** 2, axis=2)))) + 1e-3

    def size(reading: _Reading) -> float:
        force, moment = reading.sizes
        parts = np.array([force / weight, moment / (weight * lever)])
        return float(_SIMPLER ** len(reading.changes) * np.prod(parts + _SMALL))

    readings = list(_readings(model, motion, torque[:, :6]))
    stated = readings[0]
    least = weight * _FORCE, weight * lever * _MOMENT
    better = [x for x in readings if x.is_better(stated, least)]
    better = [
        x for x in better if x.sizes[0] < _MISSING * weight and x.weight > _MISSING * stated.weight
    ]  # and not because all forces are unknown in them
    best = min(better, key=size, default=stated)
    remain = best.sizes[1] > _BETTER * stated.sizes[1] and best.sizes[0] < _BETTER * stated.sizes[0]
    if remain:  # the force alone does not show which foot it acts on
        best = min([x for x in better if not x.is_exchanged], key=size, default=best)
    if best is stated:
        return
    message = (
        f"with the bodies of the URDF, the measured forces of the ground leave {_size(stated)} "
        f"(RMS) of the base unexplained, but only {_size(best)} if {' and '.join(best.changes)}"
        ". Correct the columns wrench_..., or [[contact]]"
    )
    evidence = {"force": stated.sizes[0], "best": best.sizes[0], "factor": best.factor}
    yield log_finding(log.name, "measured_wrench", "error", message, **evidence)


def _size(reading: _Reading) -> str:
    force, moment = reading.sizes
    return f"{force:.3g} N and {moment:.3g} N m"


def _readings(model: RobotModel, motion: Trajectory, torque: Array) -> Iterator[_Reading]:
    """Yield the residuals of the base rows for each way to read the forces, as stated first."""
    if motion.wrenches is None:
        return
    edges = np.cumsum([0, *(len(x.measured) for x in model.contacts)])
    columns = [np.arange(*pair) for pair in pairwise(edges)]
    pairs: list[tuple[int, int] | None] = [None]
    for i, x in enumerate(model.contacts):
        for j, y in enumerate(model.contacts[:i]):
            if x.measured and (x.kind, x.measured) == (y.kind, y.measured):
                pairs.append((j, i))
    for words, other in _places(model):
        rows = _base_rows(other, motion)
        for pair in pairs:
            order, changes = list(columns), list(words)
            if pair is not None:
                i, j = pair
                order[i], order[j] = order[j], order[i]
                names = [model.contacts[k].frame for k in pair]
                changes.append(f"those of {listed(names)} are exchanged")
            wrenches = motion.wrenches[:, np.concatenate(order)]
            yield from _fitted(rows, torque, wrenches, (tuple(changes), pair is not None))


def _places(model: RobotModel) -> Iterator[tuple[tuple[str, ...], RobotModel]]:
    """Yield the robot with other axes of the measured forces, and what differs."""
    yield (), model
    for axes in ("link", "world"):
        contacts = tuple(
            replace(x, axes=axes) if isinstance(x, Contact) and x.measured else x
            for x in model.constraints
        )
        if contacts != model.constraints:
            words = (f"their axes are those of the {axes} (axes = '{axes}')",)
            yield words, replace(model, constraints=contacts)


def _fitted(
    rows: tuple[Array, Array],
    torque: Array,
    wrenches: Array,
    reading: tuple[tuple[str, ...], bool],
) -> Iterator[_Reading]:
    """Yield the residual, and that with a factor of the forces, if the URDF is not its cause.

    The rows are those of ``_base_rows``.
    """
    J, basis = rows
    caused = without_forces(basis, np.einsum("kmj,km->kj", J, wrenches))
    left = without_forces(basis, torque)
    square = float(np.sum(caused**2))
    factor = float(np.sum(caused * left)) / square if square > 0.0 else 1.0
    size = rms(left[:, :3])
    yield _Reading(*reading, 1.0, left - caused, size)
    if _ALIKE[0] <= factor <= _ALIKE[1]:
        return
    unit = next((name for name, x in _UNITS.items() if _ALIKE[0] < factor / x < _ALIKE[1]), "")
    words = f"they are multiplied by about {factor:.2g}: another unit{unit}"
    if abs(factor + 1.0) < 1.0 - _ALIKE[0]:
        factor, words = -1.0, "their sign is reversed (forces on the ground instead of on the feet)"
    changes, is_exchanged = reading
    yield _Reading((*changes, words), is_exchanged, factor, left - factor * caused, size)


def _base_rows(model: RobotModel, motion: Trajectory) -> tuple[Array, Array]:
    """Return the rows of the base per measured component, (N, m, 6), and of unknown forces."""
    J = constraint_jacobian(model, motion.q, touching(model, motion))[:, :, :6]
    known, first = list[int](), 0
    for x in model.constraints:
        if isinstance(x, Contact):
            known += [first + k for k in x.rows_measured]
        first += x.sizes[x.kind]
    used = np.ones((len(J), 6), dtype=bool)
    return J[:, known], force_basis(np.delete(J, known, axis=1), used, floats=True)
