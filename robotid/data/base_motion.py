"""Motion of a floating base: pose, twist and acceleration of its link, or the values of an IMU."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.typing import Array, frozen, real_numbers

#: Names of the coordinates of a pose: position [m], and the orientation as a quaternion.
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")
#: Names of the components of a twist: linear [m/s] and angular velocity [rad/s].
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
#: Names of the components of its time derivative [m/s^2, rad/s^2].
ACCELERATION = ("ax", "ay", "az", "alx", "aly", "alz")
#: Names of the values of an IMU: orientation, angular velocity [rad/s], specific force [m/s^2].
IMU = ("qx", "qy", "qz", "qw", "wx", "wy", "wz", "ax", "ay", "az")
_WINDOW = 0.5  # [s] shortest rest in which the bias of the gyroscopes is estimated
GYROSCOPE_NOISE = 0.02  # [rad/s] largest standard deviation of a gyroscope at rest
_UNMOVED = 5e-3  # [rad or m] largest motion of a joint at rest
LEVEL = 2.0  # [s] in which the mean specific force is vertical
_BREAK = 0.1  # [s] a longer time step: the angular velocity in it is not known
_POSE_REMEDY = (
    "Record base_x, base_y, base_z [m] and the orientation base_qx, base_qy, base_qz, base_qw, or "
    "base_roll, base_pitch, base_yaw [rad]; or set the link of an IMU, imu in [base]"
)
_IMU_REMEDY = (
    "Record imu_wx, imu_wy, imu_wz [rad/s], imu_ax, imu_ay, imu_az [m/s^2], and the orientation "
    "imu_qx, imu_qy, imu_qz, imu_qw, or the base's orientation"
)
_UNIT = 1e-3  # tolerance of the norm of a logged quaternion
_BESIDE, _USUAL = 32, 75.0  # rows beside a step, and the percentile of their steps ...
_JUMPS = 15.0  # ... times which a step relative to those before and after it is a jump ...
_SMALLEST = (5e-3, 0.02)  # [m], [rad] ... if it is not below this
#: Median steps of time: a longer one is a gap, unless the filter is slower.
GAP_STEPS = 2.5


@dataclass(frozen=True, eq=False)
class ImuFrame:
    """Place of an IMU in the base link."""

    quaternion: Array  # orientation of the IMU in the base link, qx qy qz qw, shape (4,)
    lever: Array  # origin of the IMU in the base link, shape (3,) [m]
    gravity: Array  # gravity in the world, shape (3,) [m/s^2]
    bias: Array | None = None  # of the gyroscopes, base axes (3,) [rad/s]; None: estimate at rest
    offset: Array | None = None  # of the accelerometers, base axes (3,) [m/s^2]; None: 0

    @property
    def rotation(self) -> Array:
        """Axes of the IMU in the base link, shape (3, 3)."""
        x, y, z, w = self.quaternion
        S = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.asarray(np.eye(3) + 2.0 * (w * S + S @ S))


@dataclass(frozen=True, eq=False)
class ImuMotion:
    """Recorded values of an IMU with the axes of the base link."""

    # angular velocity without bias [rad/s], and acceleration minus gravity [m/s^2], shape (N, 6)
    values: Array
    frame: ImuFrame  # place of the IMU, with the bias that was subtracted

    def at(self, rows: slice) -> "ImuMotion":
        """Return some samples."""
        return replace(self, values=self.values[rows])


@dataclass(frozen=True, eq=False)
class BaseMotion:
    """Recorded motion of a floating base, sample by sample. The arrays are read-only."""

    # position in the world [m], 0 if not recorded, and orientation, x y z qx qy qz qw, (N, 7);
    # quaternions become normalised, with continuous signs
    pose: Array
    twist: Array | None = None  # linear [m/s] and angular velocity [rad/s], base axes, (N, 6)
    acceleration: Array | None = None  # time derivative of the twist, (N, 6) [m/s^2, rad/s^2]
    imu: ImuMotion | None = None  # determines angular velocity and acceleration
    link: str = ""  # whose pose it is; "": the root link, which alone has velocities

    def __post_init__(self) -> None:
        for name, width in (("pose", 7), ("twist", 6), ("acceleration", 6)):
            values = getattr(self, name)
            if values is not None or name == "pose":
                object.__setattr__(self, name, _checked(values, name, width))
        sizes = np.linalg.norm(self.pose[:, 3:], axis=1)
        if len(wrong := np.flatnonzero(np.abs(sizes - 1.0) > _UNIT)):
            raise DataError(
                f"the quaternion of the base has length {sizes[wrong[0]]:g} in row {wrong[0]}, "
                "expected 1, in the order qx qy qz qw"
            )
        pose = self.pose.copy()
        pose[:, 3:] *= continuous_signs(pose[:, 3:]) / sizes[:, None]
        object.__setattr__(self, "pose", frozen(pose))

    def at(self, rows: slice) -> "BaseMotion":
        """Return some samples."""
        imu = None if self.imu is None else self.imu.at(rows)
        arrays = {"pose": self.pose, "twist": self.twist, "acceleration": self.acceleration}
        some: dict[str, Any] = {name: x[rows] for name, x in arrays.items() if x is not None}
        return replace(self, imu=imu, **some)

    @property
    def has_position(self) -> bool:
        """Whether the position was recorded."""
        return bool(self.pose[:, :3].any())


@dataclass(frozen=True)
class BaseColumns:
    """The columns of a floating base (or of its IMU) and of contacts that are read from a file."""

    floats: bool = False  # whether the motion of a floating base is read
    contacts: tuple[str, ...] = ()  # links whose contacts are read, ``contact_<link>``, 1 or 0
    wrenches: tuple[str, ...] = ()  # as "fz l_sole", ``wrench_fz_l_sole``: torques may be missing
    twist: str = "base"  # axes of the velocities: "base" or "world"
    # of each contact the force from which it counts, None if its column is no force; empty: none is
    thresholds: tuple[float | None, ...] = ()
    local: tuple[str, ...] = ()  # links whose wrenches have their axes, not the world's
    imu: ImuFrame | None = None  # place of an IMU in the base
    link: str = ""  # whose pose is read, without velocities; "": the root link

    @property
    def needs_heading(self) -> bool:
        """Whether components of wrenches have horizontal axes of the world."""
        if self.imu is None:
            return False
        vertical = "f" + "xyz"[int(np.argmax(np.abs(self.imu.gravity)))]
        pairs = [name.split(" ", 1) for name in self.wrenches]
        return any(part != vertical and link not in self.local for part, link in pairs)

    def present(self, names: Collection[str]) -> "BaseColumns":
        """Return the same with only those contacts that a file has; the others may be found."""
        kept = [k for k, link in enumerate(self.contacts) if f"contact_{link}" in names]
        limits = self.thresholds or (None,) * len(self.contacts)
        return replace(
            self,
            contacts=tuple(self.contacts[k] for k in kept),
            thresholds=tuple(limits[k] for k in kept),
        )


def base_columns(
    where: str, names: Sequence[str], wanted: BaseColumns, columns: Mapping[str, str]
) -> dict[str, list[str]]:
    """Return the columns of a floating base and of contacts in a file, by kind."""
    names = [*names, *columns]
    by_kind = _columns_of_base(where, names, wanted) if wanted.floats else {}
    by_kind["contact"] = [f"contact_{link}" for link in wanted.present(names).contacts]
    by_kind["wrench"] = [f"wrench_{name.replace(' ', '_', 1)}" for name in wanted.wrenches]
    if missing := [name for name in by_kind["wrench"] if name not in names]:
        seen = [name for name in names if name.startswith("wrench_")]
        cells = [x for x in seen if x.startswith(tuple(f"{name}_" for name in missing))]
        sums = f"If {listed(cells)} are cells of a foot, add a column of their sum. "
        raise DataError(
            f"{where} has no column {listed(missing)}; columns of that kind found: {listed(seen)}. "
            f"{sums if cells else ''}Name the column in [columns], or remove the component from "
            "measured in [[contact]]",
            code="missing_column",
        )
    return {
        kind if kind in ("contact", "wrench") else f"base {kind}": [columns.get(x, x) for x in own]
        for kind, own in by_kind.items()
        if own
    }


def _columns_of_base(where: str, names: Sequence[str], wanted: BaseColumns) -> dict[str, list[str]]:
    """Return the columns of the motion of the base, by kind."""
    forms = {"pose": ("base", POSE), "angles": ("base", _ANGLES)}
    orientations = ["pose", "angles"]
    if wanted.imu is not None:
        forms |= {
            "imu quaternion": ("imu", IMU[:4]), "quaternion": ("base", POSE[3:]),
            "rpy": ("base", _ANGLES[3:]), "imu": ("imu", IMU[4:]),
        }  # fmt: skip
        orientations = [kind for kind in forms if kind != "imu"]
    elif not wanted.link:
        forms |= {"twist": ("base", TWIST), "acceleration": ("base", ACCELERATION)}
    of_kind = {kind: [f"{start}_{end}" for end in ends] for kind, (start, ends) in forms.items()}
    present = {kind: columns for kind, columns in of_kind.items() if set(columns) <= set(names)}
    used = next((kind for kind in orientations if kind in present), "")
    missing = [x for x in of_kind.get("imu", ()) if x not in names]
    needs_pose = wanted.imu is None or wanted.needs_heading or not wanted.imu.gravity.any()
    if not used and not missing and needs_pose:
        missing = [x for x in of_kind.get("imu quaternion", of_kind["pose"]) if x not in names]
    if missing:
        seen = [name for name in names if name.startswith(("base_", "imu_"))]
        what = "the pose of the floating base" if wanted.imu is None else "the IMU"
        raise DataError(
            f"{where} has no column {listed(missing)} of {what}; columns of the base found: "
            f"{listed(seen)}. {_POSE_REMEDY if wanted.imu is None else _IMU_REMEDY}",
            code="missing_column",
        )
    return {kind: x for kind, x in present.items() if kind == used or kind not in orientations}


def base_of(
    t: Array, q: Array, values: Mapping[str, Array], wanted: BaseColumns
) -> tuple[BaseMotion | None, str]:
    """Return the motion of the base from its columns (N, k), None without these, and a note."""
    pose, frame = _pose_of(values, wanted.imu), wanted.imu
    if pose is None and frame is not None and "base imu" in values:
        imu, note = motion_of_imu(t, q, _checked(values["base imu"], "IMU", 6), frame)
        quaternion = orientation_of_imu(t, imu.values, frame.gravity)
        note += "; the orientation is estimated from angular velocity and specific force"
        return BaseMotion(np.hstack([np.zeros((len(t), 3)), quaternion]), imu=imu), note
    if pose is None:
        return None, ""
    twist, acceleration = values.get("base twist"), values.get("base acceleration")
    link = "" if "base imu quaternion" in values else wanted.link  # its place is given by imu
    base = BaseMotion(pose, twist, acceleration, link=link)
    if frame is not None:
        imu, note = motion_of_imu(t, q, _checked(values["base imu"], "IMU", 6), frame)
        return replace(base, imu=imu), note
    if wanted.twist == "base" or base.twist is None:
        return base, ""
    quaternion = base.pose[:, 3:]
    parts = [in_base(quaternion, part) for part in (base.twist[:, :3], base.twist[:, 3:])]
    return replace(base, twist=np.hstack(parts)), ""


def _pose_of(values: Mapping[str, Array], frame: ImuFrame | None) -> Array | None:
    """Return the pose (N, 7) from its columns by kind; a position that is missing is 0."""
    if (pose := values.get("base pose")) is not None:
        return pose
    if (angles := values.get("base angles")) is not None:
        return np.hstack([angles[:, :3], quaternions_of_angles(_radians(angles[:, 3:]))])
    quaternion = values.get("base quaternion")
    if (own := values.get("base imu quaternion")) is not None and frame is not None:
        quaternion = _product(own, frame.quaternion[None] * [-1.0, -1.0, -1.0, 1.0])
    elif (angles := values.get("base rpy")) is not None:
        quaternion = quaternions_of_angles(_radians(angles))
    return None if quaternion is None else np.hstack([0.0 * quaternion[:, :3], quaternion])


def _radians(angles: Array) -> Array:
    """Return roll, pitch and yaw (N, 3); refuse those in degrees. Yaw may count full turns."""
    largest = float(np.abs(angles[:, :2]).max(initial=0.0))
    if largest > 2.0 * np.pi:
        raise DataError(
            f"base_roll and base_pitch are up to {largest:.4g}, expected at most pi: they look "
            "like degrees. Convert base_roll, base_pitch and base_yaw to rad",
            code="angle_unit",
        )
    return angles


def contacts_of(values: Array, wanted: BaseColumns, where: str) -> dict[str, Array]:
    """Return whether links touch the ground, by link, each of shape (N,), bool: values (N, k)."""
    links = wanted.contacts
    limits = np.array(wanted.thresholds or [None] * len(links), dtype=float)  # None becomes NaN
    values = np.where(np.isnan(limits), values, values > limits)
    for link, flags in zip(links, values.T, strict=True):
        wrong = np.flatnonzero((flags != 0.0) & (flags != 1.0))
        if len(wrong):
            raise DataError(
                f"{where}: contact_{link} is {flags[wrong[0]]:g} in row {wrong[0]}, expected 0 or "
                "1; if it is a force, set threshold in [[contact]]"
            )
    return {link: flags == 1.0 for link, flags in zip(links, values.T, strict=True)}


def table_of_base(
    base: BaseMotion | None, contacts: Mapping[str, Array], wrenches: Mapping[str, Array]
) -> dict[str, Array]:
    """Return the columns of a log with the motion of a base, contacts and wrenches, by name."""
    table: dict[str, Array] = {}
    for kind, ends in (("pose", POSE), ("twist", TWIST), ("acceleration", ACCELERATION)):
        values = getattr(base, kind, None)
        if values is not None:
            table |= {f"base_{end}": values[:, k] for k, end in enumerate(ends)}
    table |= {f"contact_{link}": flags.astype(float) for link, flags in contacts.items()}
    return table | {f"wrench_{x.replace(' ', '_', 1)}": values for x, values in wrenches.items()}


def base_state(
    t: Array,
    pose: Array,
    twist: Array | None,
    acceleration: Array | None,
    imu: ImuMotion | None = None,
) -> tuple[Array, Array, Array]:
    """Return pose (N, 7), twist (N, 6) and acceleration (N, 6) of a base as of Pinocchio.

    What was not recorded is differentiated: v = R^T dx/dt, w the vector part of 2 q* dq/dt.
    """
    quaternion = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    pose = np.hstack([pose[:, :3], quaternion])
    if twist is None:
        rate = np.gradient(pose, t, axis=0)
        w = 2.0 * vector_part(quaternion, rate[:, 3:])
        twist = np.hstack([in_base(quaternion, rate[:, :3]), w])
    if imu is not None:
        down = in_base(quaternion, imu.frame.gravity)
        twist, acceleration = inertial_state(t, twist[:, :3], down, imu.values, imu.frame)
    elif acceleration is None:
        acceleration = np.gradient(twist, t, axis=0)
    return pose, twist, acceleration


def pose_jumps(t: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Return the jumps of a pose (N, 7) from one row to the next: rows, lengths [m] and angles."""
    dt, sizes = np.diff(t), np.zeros((2, len(t)))
    if len(dt) < 3:
        return np.empty(0, dtype=int), np.empty(0), np.empty(0)
    is_regular = dt < GAP_STEPS * np.median(dt)
    is_regular = is_regular[1:-1] & is_regular[:-2] & is_regular[2:]
    for jumps, values, least in zip(
        sizes, (pose[:, :3], 2.0 * pose[:, 3:]), _SMALLEST, strict=True
    ):
        steps = np.diff(values, axis=0)
        size = np.linalg.norm(steps[1:-1] - 0.5 * (steps[:-2] + steps[2:]), axis=1)
        impact = np.linalg.norm(steps[2:] - steps[:-2], axis=1) > size  # a change of the speed
        for k in np.flatnonzero(is_regular & ~impact & (size > least)):
            beside = slice(max(k - _BESIDE, 0), k + _BESIDE + 1)
            usual = np.percentile(size[beside][is_regular[beside]], _USUAL)
            if size[k] > _JUMPS * usual and size[k] == size[max(k - 1, 0) : k + 2].max():
                jumps[k + 2] = size[k]
    rows = np.flatnonzero(sizes.any(axis=0))
    return rows, *sizes[:, rows]


def continuous_signs(q: Array) -> Array:
    """Return the signs with which quaternions (N, 4) do not jump to their opposites, (N, 1)."""
    is_opposite = np.sum(q[1:] * q[:-1], axis=1) < 0
    return np.where(np.append(0, np.cumsum(is_opposite)) % 2, -1.0, 1.0)[:, None]


def in_base(quaternion: Array, vector: Array) -> Array:
    """Return vectors (N, 3) with the axes of the base, R^T x: quaternion (N, 4)."""
    u = np.cross(vector, quaternion[:, :3])
    return np.asarray(vector + 2.0 * (quaternion[:, 3:] * u + np.cross(u, quaternion[:, :3])))


def vector_part(p: Array, rate: Array) -> Array:
    """Return the vector part of the product p* r of quaternions x y z w, shape (N, 3)."""
    vector, scalar = p[:, :3], p[:, 3:]
    return np.asarray(scalar * rate[:, :3] - rate[:, 3:] * vector - np.cross(vector, rate[:, :3]))


def quaternions_of_angles(angles: Array) -> Array:
    """Return qx qy qz qw of roll, pitch, yaw (N, 3) [rad], R = Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles.T / 2), np.sin(angles.T / 2)
    return np.column_stack([
        sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy,
    ])  # fmt: skip


def _checked(values: ArrayLike, name: str, width: int) -> Array:
    array = real_numbers(values, f"{name} of the base")
    if array.ndim != 2 or array.shape[1] != width:
        raise DataError(f"{name} of the base has shape {array.shape}, expected (N, {width})")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise DataError(f"{name} of the base is not finite in row {row}")
    return array


def motion_of_imu(t: Array, q: Array, values: Array, frame: ImuFrame) -> tuple[ImuMotion, str]:
    """Return the motion of an IMU (N, 6) without its gyroscopes' bias, and a note on the bias."""
    turned = np.hstack([values[:, :3] @ frame.rotation.T, values[:, 3:] @ frame.rotation.T])
    bias, note = frame.bias, ""
    if bias is None:
        bias, note = bias_at_rest([(t, q, turned[:, :3])])
    turned[:, :3] -= bias
    return ImuMotion(turned, replace(frame, bias=bias)), note


def bias_at_rest(parts: Sequence[tuple[Array, Array, Array]]) -> tuple[Array, str]:
    """Return the mean angular velocity (3,) [rad/s] in all windows of rest, or 0, and a note."""
    means = []
    for t, q, w in parts:
        number = ((t - t[0]) / _WINDOW).astype(int)
        edges = np.searchsorted(number, np.arange(number[-1] + 1))  # the last window may be short
        means += [
            w[first:stop].mean(axis=0)
            for first, stop in pairwise(edges)
            if stop - first > 4
            and np.ptp(q[first:stop], axis=0).max(initial=0.0) < _UNMOVED
            and w[first:stop].std(axis=0).max() < GYROSCOPE_NOISE
        ]
    if not means:
        return np.zeros(3), (
            "the robot is never at rest for 0.5 s: the bias of the gyroscopes is not estimated; "
            "record 1 s at rest"
        )
    bias: Array = np.array(means).mean(axis=0)
    shown = ", ".join(f"{1e3 * x:+.2f}" for x in bias)
    return bias, (
        f"bias of the gyroscopes, estimated in {_WINDOW * len(means):g} s at rest and "
        f"subtracted: {shown} mrad/s"
    )


def orientation_of_imu(t: Array, values: Array, gravity: Array) -> Array:
    """Return qx qy qz qw (N, 4) of an IMU alone: integrated, levelled (Mahony 2008), heading 0."""
    parts = np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > _BREAK) + 1)
    return np.concatenate([_levelled(t[k], values[k], -gravity) for k in parts])


def _levelled(t: Array, values: Array, up: Array) -> Array:
    """Return the orientation in a part of a log without gaps, shape (N, 4)."""
    w, f = values[:, :3], values[:, 3:]
    half = 0.25 * np.diff(t)[:, None] * (w[1:] + w[:-1])  # half of the turn between two samples
    angle = np.linalg.norm(half, axis=1, keepdims=True)
    turns = np.hstack([half * np.sinc(angle / np.pi), np.cos(angle)])
    q, count = np.vstack([_between(_mean(t, f)[0], up), turns]), 1
    while count < len(q):  # each row is the product of so many rows up to it
        q[count:] = _product(q[:-count], q[count:])
        count *= 2
    x, s = q[:, :3], q[:, 3:]
    u = np.cross(x, f)
    return _product(_between(_mean(t, f + 2.0 * (s * u + np.cross(x, u))), up), q)


def _mean(t: Array, x: Array) -> Array:
    """Return the mean of values over some time around each sample, same shape, taken twice."""
    if len(t) < 2:
        return x
    first, last = (np.clip(t + side * LEVEL / 2, t[0], t[-1]) for side in (-1, 1))
    for _ in range(2):
        areas = 0.5 * np.diff(t)[:, None] * (x[1:] + x[:-1])
        integral = np.vstack([np.zeros(x.shape[1]), np.cumsum(areas, axis=0)])
        ends = [np.stack([np.interp(at, t, y) for y in integral.T], axis=1) for at in (first, last)]
        x = (ends[1] - ends[0]) / (last - first)[:, None]
    return x


def _between(vector: Array, up: Array) -> Array:
    """Return the smallest rotations that turn vectors (..., 3) upwards, shape (..., 4)."""
    a = vector / np.linalg.norm(vector, axis=-1, keepdims=True).clip(1e-12)
    b = up / np.linalg.norm(up)
    q = np.concatenate([np.cross(a, b), 1.0 + (a @ b)[..., None]], axis=-1)
    size = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(size > 1e-6, q / size.clip(1e-12), np.append(np.roll(b, 1), 0.0))


def _product(p: Array, q: Array) -> Array:
    """Return the products of quaternions, shape (..., 4)."""
    x, y, v, w = p[..., :3], q[..., :3], p[..., 3:], q[..., 3:]
    vector = v * y + w * x + np.cross(x, y)
    scalar = v * w - np.sum(x * y, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def inertial_state(
    t: Array, velocity: Array, down: Array, values: Array, frame: ImuFrame
) -> tuple[Array, Array]:
    """Return twist and its time derivative (N, 6) from the specific force f at the lever r."""
    w, f, r = values[:, :3], values[:, 3:], frame.lever
    f = f if frame.offset is None else f - frame.offset
    alpha = np.gradient(w, t, axis=0)
    f = f - np.cross(alpha, r) - np.cross(w, np.cross(w, r))
    # dv/dt = f - alpha x r - w x (w x r) + g - w x v
    rate = np.hstack([f + down - np.cross(w, velocity), alpha])
    return np.hstack([velocity, w]), rate
