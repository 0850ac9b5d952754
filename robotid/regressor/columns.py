"""What each row of the regressor consists of: drive columns, and the plan of a block of rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.robot.drives import TERMS, DriveMotion
from robotid.robot.parameters import ParameterLayout

__all__ = [
    "RowPlan",
    "drive_values",
    "friction_directions",
    "friction_speeds",
    "plan_rows",
    "sure_rows",
]


@dataclass(frozen=True)
class RowPlan:
    """Which columns a block of rows has and in which place, joint after joint.

    Attributes:
        inertial: Per row the inertial columns wanted, n arrays of shape (c_j,).
        places: Per row their places in the block, likewise.
        drives: Per row the place of each drive column, which drive parameter it is, and its ratio.
        torques: Per row the place of the torque, its last one.
        first: Place at which each row begins, and the end, shape (n + 1,), int.
    """

    inertial: tuple[Array, ...]
    places: tuple[Array, ...]
    drives: tuple[tuple[tuple[int, int, float], ...], ...]
    torques: tuple[int, ...]
    first: Array


def drive_values(
    layout: ParameterLayout,
    v: Array,
    a: Array,
    direction: Array,
    which: Sequence[int] | None = None,
) -> Array:
    """Return what drive parameters multiply, shape (k, N), by the speed w of their drives.

    Row j of the regressor holds them times ``layout.drive_loads[j]``.

    Args:
        layout: The standard parameters.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        a: Accelerations, shape (N, n_rows) [rad/s^2, m/s^2].
        direction: As of ``friction_directions``, shape (N, c).
        which: Which k of the drive parameters, in any order; all of them if None.
    """
    R = layout.drive_ratios
    first = v.shape[1] - R.shape[1]
    w, dw = R @ v[:, first:].T, R @ a[:, first:].T  # (d, N)
    signs = direction.T if direction.shape[1] else w
    wanted = range(len(layout.drive_parameters)) if which is None else which
    values = np.empty((len(wanted), len(v)))
    for x, k in zip(values, wanted, strict=True):
        d, term = layout.drive_parameters[k]
        x[:] = term.column(DriveMotion(w[d], dw[d], signs[d]))
    return values


def friction_speeds(layout: ParameterLayout) -> Array:
    """Return the speeds whose direction friction follows: those of joints, then of couplings.

    Args:
        layout: The standard parameters of a robot with n joints.

    Returns:
        Their ratios to the speeds of the joints, w = ratios v, shape (c, n), so that w is in rad/s
        whether a joint turns or slides (``drive_speeds``); c is the number of drives, or 0 if no
        term of the layout follows a direction.
    """
    is_followed = any(TERMS[name].follows_direction for name in layout.terms)
    ratios: Array = layout.drive_ratios / layout.drive_speeds[:, None]
    return ratios if is_followed else ratios[:0]


def sure_rows(layout: ParameterLayout, v: Array, least: float) -> Array:
    """Return where no drive with friction is too slow to tell its sign, shape (N, n_rows), bool.

    Args:
        layout: The standard parameters.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        least: Speed from which the sign is sure [rad/s]; ``drive_speeds`` times that of sliders.
    """
    ratios = friction_speeds(layout)
    first = v.shape[1] - ratios.shape[1]
    slow = np.abs(v[:, first:] @ ratios.T) < least  # (N, c)
    sure = np.ones(v.shape, dtype=bool)
    sure[:, first:] = ~(slow @ (ratios != 0.0))
    return sure


def friction_directions(layout: ParameterLayout, v: Array, direction: Array | None) -> Array:
    """Return the directions that friction follows, shape (N, c): those given, or the speeds' signs.

    Args:
        layout: The standard parameters.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        direction: Filtered signs of the speeds, shape (N, c), or None.

    Raises:
        DataError: If the shape of those given is another one.
    """
    speeds = friction_speeds(layout)
    if direction is None:
        signs: Array = np.sign(v[:, v.shape[1] - speeds.shape[1] :] @ speeds.T)
        return signs
    wanted = (len(v), len(speeds))
    if direction.shape != wanted:
        raise DataError(
            f"direction has shape {direction.shape}, wanted {wanted}: a column for each Coulomb "
            "parameter of the model; process the log with the speeds of this model"
        )
    return direction


def plan_rows(layout: ParameterLayout, columns: Sequence[Array]) -> RowPlan:
    """Return the plan of a block of rows: each row's columns in that order, then its torque.

    Args:
        layout: The standard parameters.
        columns: Which of the p standard parameters each row has, n arrays.
    """
    loads, size = layout.drive_loads, layout.n_inertial
    base = len(columns) - len(loads)  # rows of a floating base, which no drive loads
    first = np.concatenate([[0], np.cumsum([len(row) + 1 for row in columns])])
    inertial = [np.flatnonzero(row < size) for row in columns]
    return RowPlan(
        inertial=tuple(row[k] for row, k in zip(columns, inertial, strict=True)),
        places=tuple(start + k for start, k in zip(first[:-1], inertial, strict=True)),
        drives=tuple(
            tuple(
                (int(first[j]) + k, int(g) - size, float(loads[j - base, g - size]))
                for k, g in enumerate(row)
                if g >= size
            )
            for j, row in enumerate(columns)
        ),
        torques=tuple(int(end) - 1 for end in first[1:]),
        first=first,
    )
