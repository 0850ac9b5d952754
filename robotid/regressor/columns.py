"""What each row of the regressor consists of: drive columns, and the plan of a block of rows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Trajectory
from robotid.robot.drives import DriveMotion
from robotid.robot.parameters import ParameterLayout

__all__ = [
    "RowPlan",
    "drive_motion",
    "drive_values",
    "friction_directions",
    "friction_speeds",
    "instant_state",
    "plan_rows",
    "remembered",
    "sure_rows",
    "trajectory_values",
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
    q: Array,
    v: Array,
    a: Array,
    direction: Array,
    memory: Array | None = None,
) -> Array:
    """Return what drive parameters multiply, shape (k, N), by the speed w of their drives.

    Row j of the regressor holds them times ``layout.drive_loads[j]``.

    Args:
        layout: The standard parameters.
        q: Joint coordinates, shape (N, n) or (N, 7 + n) [rad, m]; those of the joints come last.
        v: Velocities, shape (N, n_rows) [rad/s, m/s]; those of the joints come last.
        a: Accelerations, shape (N, n_rows) [rad/s^2, m/s^2].
        direction: As of ``friction_directions``, shape (N, c).
        memory: As of ``Trajectory.memory``, shape (N, m); None if the layout has none.

    Raises:
        DataError: If a shape of direction or memory is another one.
    """
    motion = drive_motion(layout, q, v, a, direction)
    kept = np.empty((len(v), 0)) if memory is None else memory
    if kept.shape != (len(v), len(layout.remembering)):
        raise DataError(
            f"memory has shape {kept.shape}, wanted {(len(v), len(layout.remembering))}: a column "
            "for each drive parameter that remembers; give the trajectory to remember() first"
        )
    place = {k: m for m, k in enumerate(layout.remembering)}
    values = np.empty((len(layout.drive_parameters), len(v)))
    for k, (x, (d, term)) in enumerate(zip(values, layout.drive_parameters, strict=True)):
        x[:] = kept[:, place[k]] if k in place else term.column(motion.of(d))
    return values


def trajectory_values(
    layout: ParameterLayout, motion: Trajectory, part: slice = slice(None)
) -> Array:
    """Return what drive parameters multiply along a trajectory, shape (k, N); see ``drive_values``.

    Args:
        layout: The standard parameters.
        motion: The trajectory.
        part: Which N samples of it.
    """
    direction, memory = (None if x is None else x[part] for x in (motion.direction, motion.memory))
    signs = friction_directions(layout, motion.v[part], direction)
    state = motion.q[part], motion.v[part], motion.a[part]
    return drive_values(layout, *state, signs, memory)


def drive_motion(
    layout: ParameterLayout,
    q: Array,
    v: Array,
    a: Array,
    direction: Array,
    load: Array | None = None,
    rate: Array | None = None,
    begins: Array | None = None,
) -> DriveMotion:
    """Return how drives move and what loads them, arrays of shape (d, N).

    Args:
        layout: The standard parameters.
        q: Joint coordinates, as of ``drive_values``.
        v: Velocities, as of ``drive_values``.
        a: Accelerations, as of ``drive_values``.
        direction: As of ``friction_directions``, shape (N, c).
        load: Torque of the rigid bodies in the rows of the joints, shape (N, n) [N m, N]; None: 0.
        rate: Change of the whole torque in them, shape (N, n) [N m/s, N/s]; None: 0.
        begins: Where a segment begins, shape (N,), bool; None: the instants do not follow another.
    """
    R = layout.drive_ratios
    n = R.shape[1]
    w = R @ v[:, v.shape[1] - n :].T
    still = np.broadcast_to(0.0, w.shape)
    share = R / np.sum(R**2, axis=1, keepdims=True).clip(min=1e-300)  # a drive's part of the load
    return DriveMotion(
        q=R @ q[:, q.shape[1] - n :].T,
        v=w,
        a=R @ a[:, a.shape[1] - n :].T,
        direction=direction.T if direction.shape[1] else w,
        load=still if load is None else share @ load.T,
        rate=still if rate is None else share @ rate.T,
        begins=begins,
    )


def instant_state(
    layout: ParameterLayout, q: Array, v: Array, a: Array, direction: Array | None, load: Array
) -> Array:
    """Return what drives remember at instants that do not follow each other, shape (N, m).

    Their drives have slid for long, and their torque does not change.

    Args:
        layout: The standard parameters.
        q: Joint coordinates, as of ``drive_values``.
        v: Velocities, as of ``drive_values``.
        a: Accelerations, as of ``drive_values``.
        direction: As of ``friction_directions``, shape (N, c), or None.
        load: Torque of the rigid bodies in the rows of the joints, shape (N, n) [N m, N].
    """
    signs = friction_directions(layout, v, direction)
    return remembered(layout, drive_motion(layout, q, v, a, signs, load))


def remembered(layout: ParameterLayout, motion: DriveMotion) -> Array:
    """Return what drive parameters multiply that an instant alone does not show, shape (N, m).

    Args:
        layout: The standard parameters.
        motion: How the d drives move, arrays of shape (d, N).
    """
    own = [layout.drive_parameters[k] for k in layout.remembering]
    return np.column_stack([term.column(motion.of(d)) for d, term in own])


def friction_speeds(layout: ParameterLayout) -> Array:
    """Return the speeds whose direction friction follows: those of joints, then of couplings.

    Args:
        layout: The standard parameters of a robot with n joints.

    Returns:
        Their ratios to the speeds of the joints, w = ratios v, shape (c, n), so that w is in rad/s
        whether a joint turns or slides (``drive_speeds``); c is the number of drives, or 0 if no
        term of the layout follows a direction.
    """
    ratios: Array = layout.drive_ratios / layout.drive_speeds[:, None]
    return ratios if layout.follows_direction else ratios[:0]


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
