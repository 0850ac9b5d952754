"""Parts of torques: gravity, inertia, velocity torques, and the torques of the drives.

tau = g(q) + M(q) a + C(q, v) v + friction + motor inertia + offset + ...
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.rows import drive_values, friction_directions
from robotid.dynamics.torque import predict, rigid_parts
from robotid.robot.model import RobotModel

_RIGID = ("gravity", "inertia", "Coriolis")


@dataclass(frozen=True, eq=False)
class TorqueSplit:
    """Parts of torques: "gravity", "inertia", "Coriolis", then of drives by ``DriveTerm.part``."""

    parts: Mapping[str, Array]  # each of shape (N, n_rows) [N m, N]
    names: tuple[str, ...]  # of the k drive parameters
    kinds: tuple[str, ...]  # part that each of them belongs to
    terms: Array  # (k, N), torque of each of them at its drive [N m, N]
    loads: Array  # (n_rows, k), ratio of each row to the drive of each parameter [-]

    @cached_property
    def load(self) -> Array:
        """The torque of the bodies, shape (N, n_rows) [N m, N]."""
        return np.asarray(sum(self.parts[name] for name in _RIGID if name in self.parts))

    def terms_of(self, row: int) -> dict[str, dict[str, Array]]:
        """Return the torque (N,) of each drive parameter in a row, by part and name."""
        terms: dict[str, dict[str, Array]] = {}
        for k in np.flatnonzero(self.loads[row]):
            of_kind = terms.setdefault(self.kinds[k], {})
            of_kind[self.names[k]] = self.loads[row, k] * self.terms[k]
        return terms


def split_torque(
    model: RobotModel, pi: Array, q: Array, v: Array, a: Array,
    direction: Array | None = None, memory: Array | None = None,
) -> TorqueSplit:  # fmt: skip
    """Return the parts of the torques that parameters predict."""
    layout, first = model.layout, model.n_rows - len(model.joints)
    parts = dict(zip(_RIGID, rigid_parts(model, pi, q, v, a), strict=True))
    if model.is_static:  # it has no torques of motion
        parts = {"gravity": parts["gravity"]}
    signs = friction_directions(layout, v, direction)
    terms = pi[layout.n_inertial :, None] * drive_values(layout, q, v, a, signs, memory)  # (k, N)
    loads = np.vstack([np.zeros((first, len(terms))), layout.drive_loads])  # (n_rows, k)
    kinds = tuple(term.part for _, term in layout.drive_parameters)
    for kind in dict.fromkeys(kinds):
        own = [k for k, other in enumerate(kinds) if other == kind]
        parts[kind] = terms[own].T @ loads[:, own].T  # (N, n_rows)
    return TorqueSplit(parts, layout.drive_names, kinds, terms, loads)


def friction_split(model: RobotModel, trajectory: Trajectory, pi: Array) -> tuple[Array, Array]:
    """Return tau - Y pi, with pi without friction and offset, and the torque of these."""
    layout = model.layout
    is_drive_inertia = [term.is_inertia for _, term in layout.drive_parameters]
    stiff = np.array([True] * layout.n_inertial + is_drive_inertia)
    moved, whole = predict(model, [np.where(stiff, pi, 0.0), pi], trajectory)
    return trajectory.tau - moved, whole - moved
