"""What each row of the regressor consists of: drive columns, and the plan of a block of rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.robot.drives import TERMS, DriveMotion, DriveTerm
from robotid.robot.parameters import ParameterLayout

__all__ = [
    "DriveColumn",
    "RowPlan",
    "drive_columns",
    "friction_directions",
    "friction_speeds",
    "plan_rows",
    "sure_rows",
]


@dataclass(frozen=True)
class DriveColumn:
    """One drive parameter: row r of the regressor holds ratio_r f(w), w = sum_r ratio_r v_r.

    Attributes:
        term: Which f.
        ratios: Ratio by row [-]; a drive of one joint has a single row and ratio 1.
        number: Which of the directions the drive follows; None if f follows none.
    """

    term: DriveTerm
    ratios: dict[int, float]
    number: int | None = None

    def values(self, v: Array, a: Array, direction: Array) -> Array:
        """Return f(w) at each instant.

        Args:
            v: Velocities, shape (N, n_rows) [rad/s, m/s].
            a: Accelerations, shape (N, n_rows) [rad/s^2, m/s^2].
            direction: Signs of the speeds, shape (N, c), as of ``friction_directions``.

        Returns:
            Values, shape (N,).
        """
        w = self.speed(v)
        signs = w if self.number is None else direction[:, self.number]
        return self.term.column(DriveMotion(w, self.speed(a), signs))

    def speed(self, v: Array) -> Array:
        """Return w = sum_r ratio_r v_r, shape (N,).

        Args:
            v: Velocities or accelerations, shape (N, n_rows).
        """
        rows = list(self.ratios)
        if len(rows) == 1 and self.ratios[rows[0]] == 1.0:
            own: Array = v[:, rows[0]]
            return own
        w: Array = v[:, rows] @ np.array(list(self.ratios.values()))
        return w


@dataclass(frozen=True)
class RowPlan:
    """Which columns a block of rows has and in which place, joint after joint.

    Attributes:
        inertial: Per row the inertial columns wanted, n arrays of shape (c_j,).
        places: Per row their places in the block, likewise.
        drives: Per row pairs of place and drive column.
        torques: Per row the place of the torque, its last one.
        first: Place at which each row begins, and the end, shape (n + 1,), int.
    """

    inertial: tuple[Array, ...]
    places: tuple[Array, ...]
    drives: tuple[tuple[tuple[int, DriveColumn], ...], ...]
    torques: tuple[int, ...]
    first: Array


def drive_columns(layout: ParameterLayout, n_rows: int) -> tuple[DriveColumn, ...]:
    """Return the drive columns of a robot.

    Args:
        layout: Its standard parameters.
        n_rows: Rows of its regressor per sample; those of the joints come last.

    Returns:
        One per name in ``layout.drive_names``, in that order.
    """
    first = n_rows - len(layout.joints)
    rows = {joint: first + j for j, joint in enumerate(layout.joints)}
    ratios = [{rows[joint]: ratio for joint, ratio in drive.ratios} for drive in layout.drives]
    return tuple(
        DriveColumn(term, ratios[d], d if term.follows_direction else None)
        for d, term in layout.drive_parameters
    )


def friction_speeds(layout: ParameterLayout) -> Array:
    """Return the speeds whose direction friction follows: those of joints, then of couplings.

    Args:
        layout: The standard parameters of a robot with n joints.

    Returns:
        Their ratios to the speeds of the joints, w = ratios v, shape (c, n) [-]; c is the number of
        drives, or 0 if no term of the layout follows a direction.
    """
    is_followed = any(TERMS[name].follows_direction for name in layout.terms)
    return layout.drive_ratios if is_followed else layout.drive_ratios[:0]


def sure_rows(layout: ParameterLayout, v: Array, least: float) -> Array:
    """Return which rows are sure: those where no drive with friction is too slow to tell its sign.

    Args:
        layout: The standard parameters.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        least: Speed from which the sign is sure [rad/s or m/s].

    Returns:
        Flags, shape (N, n_rows), bool.
    """
    ratios = friction_speeds(layout)
    first = v.shape[1] - ratios.shape[1]
    slow = np.abs(v[:, first:] @ ratios.T) < least  # (N, c)
    sure = np.ones(v.shape, dtype=bool)
    sure[:, first:] = ~(slow @ (ratios != 0.0))
    return sure


def friction_directions(layout: ParameterLayout, v: Array, direction: Array | None) -> Array:
    """Return the directions that friction follows: those given, or else the signs of the speeds.

    Args:
        layout: The standard parameters.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        direction: Filtered signs of the speeds, shape (N, c), or None.

    Returns:
        Directions, shape (N, c) [-].

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
    """Return the plan of a block of rows.

    Args:
        layout: The standard parameters.
        columns: Which of the p standard parameters each row has, n arrays.

    Returns:
        The plan: each row's columns in that order, then its torque.
    """
    drives = drive_columns(layout, len(columns))
    size = layout.n_inertial
    first = np.concatenate([[0], np.cumsum([len(row) + 1 for row in columns])])
    inertial = [np.flatnonzero(row < size) for row in columns]
    return RowPlan(
        inertial=tuple(row[k] for row, k in zip(columns, inertial, strict=True)),
        places=tuple(start + k for start, k in zip(first[:-1], inertial, strict=True)),
        drives=tuple(
            tuple((int(start) + k, drives[g - size]) for k, g in enumerate(row) if g >= size)
            for start, row in zip(first[:-1], columns, strict=True)
        ),
        torques=tuple(int(end) - 1 for end in first[1:]),
        first=first,
    )
