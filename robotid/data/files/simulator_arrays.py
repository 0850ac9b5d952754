"""Arrays of MuJoCo and Isaac Lab as columns: generalised coordinates and states of the root."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array
from robotid.data.base_motion import ACCELERATION, POSE, TWIST, in_base
from robotid.data.files.table import Table

#: Prefixes of columns by array with one value per joint; before these, MuJoCo's has the base's.
ARRAYS = {
    "qpos": "q", "qvel": "dq", "qacc": "ddq", "qfrc_actuator": "tau",
    "joint_pos": "q", "joint_vel": "dq", "joint_acc": "ddq", "applied_torque": "tau",
}  # fmt: skip
_BASE = {"qpos": 7, "qvel": 6, "qacc": 6, "qfrc_actuator": 6}  # values of the base
_ROOT = 13  # values of a root state: position, quaternion, linear and angular velocity
_OF_MASS = (
    "root_state_w has the velocity of the centre of mass, which is not used; export "
    "root_link_state_w to use it"
)


@dataclass(frozen=True)
class _Derived:
    """Columns that follow from others."""

    sources: tuple[str, ...]
    targets: tuple[str, ...]
    values: Callable[[Array], Array]  # (N, sources) -> (N, targets)


def with_simulator_arrays(where: str, table: Table, joints: Sequence[str]) -> Table:
    """Return a table in which arrays of MuJoCo and Isaac Lab are standard columns.

    MuJoCo: ``qpos``, ``qvel``, ``qacc`` and ``qfrc_actuator``, of joints or of a free joint and
    joints. Isaac Lab: ``joint_pos``, ``joint_vel``, ``joint_acc``, ``applied_torque``, and
    ``root_link_state_w`` or ``root_state_w``, with w first in the quaternion. The velocities of the
    base get the axes of the base. A table without such arrays is not changed.
    """
    widths = {name: _width(table.names, name, joints) for name in (*ARRAYS, *_ROOTS)}
    widths = {name: width for name, width in widths.items() if width}
    if not widths or any(name.startswith("q_") for name in table.names):
        return table
    derived = [_of_joints(where, name, width, joints) for name, width in widths.items()
               if name in ARRAYS]  # fmt: skip
    notes = table.notes
    if widths.get("qpos") == len(joints) + 7 and joints:
        derived.append(_of_free_joint(widths))
    elif root := next((name for name in _ROOTS if name in widths), ""):
        if widths[root] != _ROOT:
            raise DataError(f"{where}: {root} has {widths[root]} columns, wanted {_ROOT}")
        sources = tuple(f"{root}_{k}" for k in range(_ROOT))
        derived.append(_ROOTS[root](sources))
        notes = (*notes, _OF_MASS) if root == "root_state_w" else notes
    starts = tuple(f"{name}_" for name in widths)
    hidden = {name for name in table.names if name.startswith(starts)}
    return _with(replace(table, notes=notes, axes={"twist": "base"}), derived, hidden)


def _with(table: Table, derived: Sequence[_Derived], hidden: Collection[str]) -> Table:
    """Return a table with derived columns in place of hidden ones."""
    of = {name: x for x in derived for name in x.targets}
    kept = [name for name in table.names if name not in hidden and name not in of]

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        used = list({id(of[name]): of[name] for name in wanted if name in of}.values())
        sources = dict.fromkeys(
            [*(x for x in wanted if x not in of), *(x for one in used for x in one.sources)]
        )
        columns = table.read(list(sources))
        for one in used:
            values = one.values(np.column_stack([columns[name] for name in one.sources]))
            columns |= dict(zip(one.targets, values.T, strict=True))
        return {name: columns[name] for name in wanted}

    return replace(table, names=[*kept, *of], read=read)


def _width(names: Sequence[str], array: str, joints: Sequence[str]) -> int:
    """Return the number of columns of an array, 0 if there is none."""
    ends = {name.removeprefix(f"{array}_") for name in names if name.startswith(f"{array}_")}
    numbers = {str(k) for k in range(len(ends))}
    return len(ends) if ends and ends in (numbers, set(joints)) else 0


def _of_joints(where: str, name: str, width: int, joints: Sequence[str]) -> _Derived:
    """Return the columns of the joints in an array."""
    before = width - len(joints) if joints else 0
    if before not in (0, _BASE.get(name, 0)):
        raise DataError(
            f"{where}: {name} has {width} columns, wanted {len(joints)}, one for each joint that "
            "the file names"
            + (f", or {_BASE[name]} more with a free joint" if name in _BASE else "")
        )
    ends = list(joints) if joints else [str(k) for k in range(width)]
    is_numbered = before > 0 or not joints
    sources = [f"{name}_{before + k if is_numbered else end}" for k, end in enumerate(ends)]
    return _Derived(
        tuple(sources), tuple(f"{ARRAYS[name]}_{end}" for end in ends), lambda values: values
    )


def _pose(values: Array) -> Array:
    """Return x y z qx qy qz qw from position and quaternion with w first."""
    return values[:, [0, 1, 2, 4, 5, 6, 3]]


def _of_free_joint(widths: dict[str, int]) -> _Derived:
    """Return the motion of MuJoCo's free joint, whose angular velocity has the base's axes.

    The rate of the linear velocity v of the base is R^T dv/dt - w x v with the axes of the base.
    """
    sources = [f"qpos_{k}" for k in range(7)]
    targets = [f"base_{end}" for end in POSE]
    if "qvel" not in widths:
        return _Derived(tuple(sources), tuple(targets), _pose)
    sources += [f"qvel_{k}" for k in range(6)]
    targets += [f"base_{end}" for end in TWIST]
    if "qacc" in widths:
        sources += [f"qacc_{k}" for k in range(6)]
        targets += [f"base_{end}" for end in ACCELERATION]

    def values(state: Array) -> Array:
        pose, w = _pose(state), state[:, 10:13]
        v = in_base(pose[:, 3:], state[:, 7:10])
        parts = [pose, v, w]
        if "qacc" in widths:
            rate = in_base(pose[:, 3:], state[:, 13:16]) - np.cross(w, v)
            parts += [rate, state[:, 16:]]
        return np.hstack(parts)

    return _Derived(tuple(sources), tuple(targets), values)


def _of_link(sources: tuple[str, ...]) -> _Derived:
    """Return pose and twist of the link of the root, whose velocities have the world's axes."""

    def values(state: Array) -> Array:
        pose = _pose(state)
        velocities = [in_base(pose[:, 3:], state[:, k : k + 3]) for k in (7, 10)]
        return np.hstack([pose, *velocities])

    return _Derived(sources, tuple(f"base_{end}" for end in (*POSE, *TWIST)), values)


def _of_root(sources: tuple[str, ...]) -> _Derived:
    """Return the pose of the root; its velocity is that of the centre of mass."""
    return _Derived(sources, tuple(f"base_{end}" for end in POSE), _pose)


_ROOTS = {"root_link_state_w": _of_link, "root_state_w": _of_root}
