"""The drive columns of the regressor, and the plan of a block of rows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.robot.drive_term import DriveMotion
from robotid.robot.parameters import ParameterLayout


class RowPlan(NamedTuple):
    """The columns of a block of rows and their places, joint by joint."""

    inertial: list[Array]  # per row its inertial columns, n arrays of shape (c_j,)
    places: list[Array]  # per row their places in the block, likewise
    drive_places: Array  # places of the E drive columns, shape (E,), int
    drive_numbers: Array  # their drive parameters, shape (E,), int
    ratios: Array  # their ratios, shape (E, 1)
    torques: Array  # per row the place of the torque, the last one of the row, shape (n,), int
    first: Array  # first place of each row, and the end, shape (n + 1,), int


def drive_values(
    layout: ParameterLayout,
    q: Array,
    v: Array,
    a: Array,
    direction: Array,
    memory: Array | None = None,
) -> Array:
    """Return the columns of drive parameters, shape (k, N), at the speed w of their drives.

    Row j of the regressor has them times ``layout.drive_loads[j]``. memory (N, m).
    """
    motion = drive_motion(layout, q, v, a, direction)
    states, wanted = np.empty((len(v), 0)) if memory is None else memory, layout.remembering
    if states.shape != (len(v), len(wanted)):
        raise DataError(
            f"memory has shape {states.shape}, wanted {(len(v), len(wanted))}: a column for each "
            "drive parameter with internal state or load; call remember() with the trajectory first"
        )
    values = np.empty((len(layout.drive_parameters), len(v)))
    for k, (d, term) in enumerate(layout.drive_parameters):
        if k not in wanted:
            values[k] = term.column(motion.of(d))
    values[list(wanted)] = states.T
    return values


def trajectory_values(
    layout: ParameterLayout, motion: Trajectory, part: slice = slice(None)
) -> Array:
    """Return the columns of drive parameters along a trajectory, (k, N); see ``drive_values``."""
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
    """Return the motion and load of drives, arrays of shape (d, N): load and rate (N, n)."""
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
    """Return the columns with internal state or load at independent samples, shape (N, m).

    Internal states are at their steady value, and the torque is constant.
    """
    signs = friction_directions(layout, v, direction)
    return remembered(layout, drive_motion(layout, q, v, a, signs, load))


def remembered(layout: ParameterLayout, motion: DriveMotion) -> Array:
    """Return the columns of drive parameters with internal state or load, shape (N, m)."""
    own = [layout.drive_parameters[k] for k in layout.remembering]
    return np.column_stack([term.column(motion.of(d)) for d, term in own])


def friction_speeds(layout: ParameterLayout) -> Array:
    """Return the speeds (c, n) whose sign is the direction of friction: joints, then couplings."""
    ratios: Array = layout.drive_ratios / layout.drive_speeds[:, None]
    return ratios if layout.follows_direction else ratios[:0]


def sure_rows(layout: ParameterLayout, v: Array, least: float) -> Array:
    """Return the rows in which the sign of friction is certain, shape (N, n_rows), bool."""
    ratios = friction_speeds(layout)
    first = v.shape[1] - ratios.shape[1]
    slow = np.abs(v[:, first:] @ ratios.T) < least  # (N, c)
    certain = np.ones(v.shape, dtype=bool)
    certain[:, first:] = ~(slow @ (ratios != 0.0))
    return certain


def friction_directions(layout: ParameterLayout, v: Array, direction: Array | None) -> Array:
    """Return the directions of friction, shape (N, c): those given, or the signs of the speeds."""
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
    """Return the plan of a block of rows: each row's columns in that order, then its torque."""
    loads, size = layout.drive_loads, layout.n_inertial
    base = len(columns) - len(loads)  # rows of a floating base, without drives
    first = np.concatenate([[0], np.cumsum([len(row) + 1 for row in columns])])
    inertial = [np.flatnonzero(row < size) for row in columns]
    drives = [
        (first[j] + k, g - size, loads[j - base, g - size])
        for j, row in enumerate(columns)
        for k, g in enumerate(row)
        if g >= size
    ]
    places, numbers, ratios = np.array(drives).reshape(-1, 3).T
    return RowPlan(
        [row[k] for row, k in zip(columns, inertial, strict=True)],
        [start + k for start, k in zip(first, inertial, strict=False)],
        places.astype(int), numbers.astype(int), ratios[:, None], first[1:] - 1, first,
    )  # fmt: skip
