"""Motion of a floating base: pose, twist and acceleration of its link."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.findings import listed

__all__ = [
    "POSE",
    "BaseColumns",
    "BaseMotion",
    "base_columns",
    "base_of",
    "base_state",
    "contacts_of",
    "in_base",
    "quaternions_of_angles",
    "table_of_base",
]

#: Names of the coordinates of a pose: position [m], and the orientation as a quaternion.
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")
_TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
_ACCELERATION = ("ax", "ay", "az", "alx", "aly", "alz")
_UNIT = 1e-3  # tolerance of the norm of a logged quaternion


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """Recorded motion of a floating base, sample by sample. The arrays are read-only.

    Attributes:
        pose: Position of the base link in the world [m] and its orientation as a quaternion,
            x y z qx qy qz qw, shape (N, 7). Quaternions are normalised, with continuous signs.
        twist: Linear [m/s] and angular velocity [rad/s] with the axes of the base link, shape
            (N, 6); None if it was not recorded.
        acceleration: Time derivative of the twist, shape (N, 6) [m/s^2, rad/s^2]; None if it was
            not recorded.

    Raises:
        DataError: If a shape is not the expected one, or a quaternion is not of length 1.
    """

    pose: Array
    twist: Array | None = None
    acceleration: Array | None = None

    def __post_init__(self) -> None:
        for name, width in (("pose", 7), ("twist", 6), ("acceleration", 6)):
            values = getattr(self, name)
            if values is not None:
                object.__setattr__(self, name, _checked(values, name, width))
        sizes = np.linalg.norm(self.pose[:, 3:], axis=1)
        if len(wrong := np.flatnonzero(np.abs(sizes - 1.0) > _UNIT)):
            raise DataError(
                f"the quaternion of the base has length {sizes[wrong[0]]:g} in row {wrong[0]}, "
                "wanted 1, in the order qx qy qz qw"
            )
        is_opposite = np.sum(self.pose[1:, 3:] * self.pose[:-1, 3:], axis=1) < 0
        signs = np.where(np.append(0, np.cumsum(is_opposite)) % 2, -1.0, 1.0)
        pose = self.pose.copy()
        pose[:, 3:] *= (signs / sizes)[:, None]
        pose.flags.writeable = False
        object.__setattr__(self, "pose", pose)

    def at(self, rows: slice) -> "BaseMotion":
        """Return some samples.

        Args:
            rows: Their numbers.
        """
        parts = {name: x[rows] for name, x in vars(self).items() if x is not None}
        return replace(self, **parts)


@dataclass(frozen=True)
class BaseColumns:
    """The columns of a floating base and of contacts that are read from a file.

    Attributes:
        floats: Whether the motion of a floating base is read: ``base_x`` to ``base_z`` [m] and
            ``base_qx`` to ``base_qw``, or ``base_roll``, ``base_pitch``, ``base_yaw`` [rad]; also
            velocities ``base_vx`` to ``base_wz`` and accelerations ``base_ax`` to ``base_alz``, if
            they are there.
        contacts: Links whose contacts are read from ``contact_<link>``, 1 or 0.
        wrenches: Components of wrenches, as "fz l_sole" from ``wrench_fz_l_sole``. With these, a
            log need not have torques.
        twist: Axes of the velocities: "base" or "world".
    """

    floats: bool = False
    contacts: tuple[str, ...] = ()
    wrenches: tuple[str, ...] = ()
    twist: str = "base"


def base_columns(
    where: str, names: Sequence[str], wanted: BaseColumns, columns: Mapping[str, str]
) -> dict[str, list[str]]:
    """Return the columns of a floating base and of contacts in a file, by kind.

    Args:
        where: Name of the file.
        names: Names of its columns.
        wanted: Which are read.
        columns: Names in the file by standard name, if they differ.

    Raises:
        DataError: If the pose of a floating base, or a contact, is missing.
    """
    found: dict[str, list[str]] = {}
    names = [*names, *columns]
    if wanted.floats:
        forms = {"pose": POSE, "angles": _ANGLES, "twist": _TWIST, "acceleration": _ACCELERATION}
        whole = {kind: [f"base_{end}" for end in ends] for kind, ends in forms.items()}
        found = {k: own for k, own in whole.items() if set(own) <= set(names)}
        if "pose" in found:
            found.pop("angles", None)
        elif "angles" not in found:
            seen = [name for name in names if name.startswith("base_")]
            missing = [name for name in whole["pose"] if name not in names]
            raise DataError(
                f"{where} has no column {listed(missing)} of the pose of the floating base; "
                f"columns of the base found: {listed(seen)}. Record base_x, base_y, base_z [m] and "
                "the orientation base_qx, base_qy, base_qz, base_qw, or base_roll, base_pitch, "
                "base_yaw [rad]",
                code="missing_column",
            )
    found["contact"] = [f"contact_{link}" for link in wanted.contacts]
    found["wrench"] = [f"wrench_{name.replace(' ', '_', 1)}" for name in wanted.wrenches]
    remedies = {
        "contact": "Record 1 while the link touches the ground, 0 otherwise; or state always = "
        "true in [[contact]]",
        "wrench": "Name the column in [columns], or remove the component from measured in "
        "[[contact]]",
    }
    for kind, remedy in remedies.items():
        if missing := [name for name in found[kind] if name not in names]:
            seen = [name for name in names if name.startswith(f"{kind}_")]
            raise DataError(
                f"{where} has no column {listed(missing)}; columns of that kind found: "
                f"{listed(seen)}. {remedy}",
                code="missing_column",
            )
    return {
        kind if kind in remedies else f"base {kind}": [columns.get(name, name) for name in own]
        for kind, own in found.items()
        if own
    }


def base_of(values: Mapping[str, Array], twist: str) -> BaseMotion | None:
    """Return the motion of the base from its columns, None without these.

    Args:
        values: Columns by kind, as of ``base_columns``, each of shape (N, k).
        twist: Axes of the velocities: "base" or "world".

    Raises:
        DataError: If a value is not finite, or a quaternion is not of length 1.
    """
    pose, angles = values.get("base pose"), values.get("base angles")
    if angles is not None:
        pose = np.hstack([angles[:, :3], quaternions_of_angles(angles[:, 3:])])
    if pose is None:
        return None
    base = BaseMotion(pose, values.get("base twist"), values.get("base acceleration"))
    if twist == "base" or base.twist is None:
        return base
    quaternion = base.pose[:, 3:]
    parts = [in_base(quaternion, part) for part in (base.twist[:, :3], base.twist[:, 3:])]
    return replace(base, twist=np.hstack(parts))


def contacts_of(values: Array, links: Sequence[str], where: str) -> dict[str, Array]:
    """Return whether links touch the ground, by link, each of shape (N,), bool.

    Args:
        values: Columns of 0 and 1, shape (N, k).
        links: The links.
        where: Name of the file.

    Raises:
        DataError: If a value is neither 0 nor 1.
    """
    for link, flags in zip(links, values.T, strict=True):
        wrong = np.flatnonzero((flags != 0.0) & (flags != 1.0))
        if len(wrong):
            raise DataError(
                f"{where}: contact_{link} is {flags[wrong[0]]:g} in row {wrong[0]}, wanted 0 or 1"
            )
    return {link: flags == 1.0 for link, flags in zip(links, values.T, strict=True)}


def table_of_base(
    base: BaseMotion | None, contacts: Mapping[str, Array], wrenches: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the columns of a log with the motion of a base, contacts and wrenches, by name.

    Args:
        base: The motion, or None.
        contacts: As of ``Log.contacts``.
        wrenches: As of ``Log.wrenches``.
    """
    table: dict[str, Array] = {}
    forms = {"pose": POSE, "twist": _TWIST, "acceleration": _ACCELERATION}
    for kind, ends in forms.items():
        values = getattr(base, kind, None)
        if values is not None:
            table |= {f"base_{end}": values[:, k] for k, end in enumerate(ends)}
    table |= {f"contact_{link}": flags.astype(float) for link, flags in contacts.items()}
    return table | {f"wrench_{x.replace(' ', '_', 1)}": values for x, values in wrenches.items()}


def base_state(
    t: Array, pose: Array, twist: Array | None, acceleration: Array | None
) -> tuple[Array, Array, Array]:
    """Return pose (N, 7), twist (N, 6) and acceleration (N, 6) of a base as of Pinocchio.

    What was not recorded is differentiated: with the axes R of the base, v = R^T dx/dt and
    w = 2 (q* dq/dt), the vector part of the product of quaternions.

    Args:
        t: Time stamps, shape (N,) [s].
        pose: Smoothed pose, shape (N, 7) [m, -]; the quaternions need not be of length 1.
        twist: Smoothed twist, shape (N, 6); None to differentiate the pose.
        acceleration: Smoothed acceleration, shape (N, 6); None to differentiate the twist.
    """
    quaternion = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    pose = np.hstack([pose[:, :3], quaternion])
    if twist is None:
        rate = np.gradient(pose, t, axis=0)
        vector, scalar = quaternion[:, :3], quaternion[:, 3:]
        w = 2.0 * (scalar * rate[:, 3:6] - rate[:, 6:] * vector - np.cross(vector, rate[:, 3:6]))
        twist = np.hstack([in_base(quaternion, rate[:, :3]), w])
    if acceleration is None:
        acceleration = np.gradient(twist, t, axis=0)
    return pose, twist, acceleration


def in_base(quaternion: Array, vector: Array) -> Array:
    """Return vectors with the axes of the base, R^T x, shape (N, 3).

    Args:
        quaternion: Orientation of the base, qx qy qz qw, shape (N, 4).
        vector: Vectors with the axes of the world, shape (N, 3), or one, shape (3,).
    """
    u = np.cross(vector, quaternion[:, :3])
    turned: Array = vector + 2.0 * (quaternion[:, 3:] * u + np.cross(u, quaternion[:, :3]))
    return turned


def quaternions_of_angles(angles: Array) -> Array:
    """Return qx qy qz qw of roll, pitch and yaw, R = Rz(yaw) Ry(pitch) Rx(roll), shape (N, 4).

    Args:
        angles: Roll, pitch and yaw, shape (N, 3) [rad].
    """
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T / 2), np.sin(angles.T / 2)
    return np.column_stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ]
    )


def _checked(values: ArrayLike, name: str, width: int) -> Array:
    array: Array = np.array(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != width:
        raise DataError(f"{name} of the base has shape {array.shape}, wanted (N, {width})")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise DataError(f"{name} of the base is not finite in row {row}")
    array.flags.writeable = False
    return array
