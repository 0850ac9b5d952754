"""Motion of a robot as arrays: `Log`, the recording, and `Trajectory`, the input of a fit."""

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import (
    LARGEST_SETTING,
    is_number,
    require_each,
    require_flag,
    require_kind,
)
from robotid.base.text import seconds
from robotid.base.typing import Array, frozen, real_numbers
from robotid.data.base_motion import POSE, BaseMotion

#: Attributes of a `Log` with one column per joint, by the prefix of these columns in files.
COLUMNS = {
    "q": "q",
    "dq": "v",
    "ddq": "a",
    "tau": "tau",
    "qref": "q_ref",
    "dqref": "v_ref",
    "tauref": "tau_ref",
}
_SHORTEST = 1e-12  # [s] smallest mean time step
_REQUIRED = ("q", "tau")
_NO_TORQUE = "; without torques, pass zeros and has_torque=False"
_BY_SAMPLE = (
    "t", "q", "v", "a", "tau", "segment", "direction", "memory", "contacts",
    "wrenches", "switching", "basis", "loaded",
)  # fmt: skip
_BLOCK = 2**17  # stamps processed together
#: Share of the instants of a motion in another one, from which it repeats that.
REPEATED = 0.3
_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] after an instant, positions that are compared
_NEAR = 0.02  # of the range of each joint: closer positions are equal
_INSTANTS = 300
_FEW = 60  # ... of each of many motions


@dataclass(frozen=True, eq=False)
class Log:
    """A recording, sample by sample, in SI units. The arrays are read-only.

    Attributes:
        t: Time stamps, strictly increasing, shape (N,) [s].
        q: Joint positions, shape (N, n) [rad or m].
        tau: Joint torques, shape (N, n) [N m or N]; 0 if they were not recorded.
        joints: Names of the n joints, in the order of the columns.
        v: Measured velocities, shape (N, n) [rad/s or m/s], or None.
        a: Measured accelerations, shape (N, n) [rad/s^2 or m/s^2], or None.
        path: The file of the log; "" if it was created in memory.
        notes: Notes for the user, as columns that were ignored.
        assumed: What was assumed of the columns, as the order of numbered ones.
        q_ref: Commanded positions, shape (N, n) [rad or m], or None.
        v_ref: Commanded velocities, shape (N, n) [rad/s or m/s], or None.
        tau_ref: Commanded feed-forward torques, shape (N, n) [N m or N], or None.
        has_torque: Whether torques were recorded.
        base: Motion of the base of a robot whose base floats, or None.
        contacts: Whether links touch the ground, by link, each of shape (N,), bool.
        wrenches: Measured components of the wrenches of the ground, by name as "fz l_sole", each of
            shape (N,) [N or N m].
        gain_factors: Gains kp and kd of the drives in this log over those of their controller,
            positive, shape (2, n) [-]; 1 by default.
    """

    t: Array
    q: Array
    tau: Array
    joints: tuple[str, ...]
    v: Array | None = None
    a: Array | None = None
    path: str = ""
    notes: tuple[str, ...] = ()
    q_ref: Array | None = None
    v_ref: Array | None = None
    tau_ref: Array | None = None
    has_torque: bool = True
    base: BaseMotion | None = None
    contacts: Mapping[str, Array] = field(default_factory=dict)
    wrenches: Mapping[str, Array] = field(default_factory=dict)
    assumed: tuple[str, ...] = ()
    gain_factors: Array = field(default_factory=lambda: np.ones((2, 1)))

    def __post_init__(self) -> None:
        require_kind(self.path, (str, Path), "path", "the path of the log's file, or ''")
        require_flag(self.has_torque, "has_torque")
        require_each(self.notes, str, "notes", "a list of sentences")
        where = self.name
        _settle(self, where, {kind: getattr(self, name) for kind, name in COLUMNS.items()})
        if not self.has_torque and self.tau.any():
            raise DataError(
                f"{where}: has_torque is False, but tau is not 0; leave has_torque out, or pass "
                "zeros"
            )
        factors, shape = real_numbers(self.gain_factors, "gain_factors"), (2, len(self.joints))
        factors = factors if (factors != 1.0).any() else np.ones((2, 1))  # of any number of joints
        if factors.shape not in ((2, 1), shape) or not (factors > 0.0).all():
            stated = f"gain_factors is {factors.tolist()}, expected positive factors"
            raise DataError(f"{where}: {stated} of shape {shape}: kp and kd of each joint")
        object.__setattr__(self, "gain_factors", frozen(np.broadcast_to(factors, shape)))
        if len(self.t) < 2:
            raise DataError(f"{where} has {len(self.t)} rows, expected at least 2; record longer")
        require_increasing(self.t, where)
        require_kind(self.base, (BaseMotion, type(None)), "base", "a BaseMotion")
        if self.base is not None and len(self.base.pose) != len(self.t):
            raise DataError(
                f"{where}: the pose of the base has {len(self.base.pose)} rows, expected "
                f"{len(self.t)}, one for each time stamp"
            )
        for kind, dtype in (("contacts", np.bool_), ("wrenches", np.float64)):
            require_kind(getattr(self, kind), Mapping, kind, "a table of arrays by name")
            own = {
                name: frozen(real_numbers(x, f"{where}: {name!r} of {kind}"), dtype)
                for name, x in getattr(self, kind).items()
            }
            for name, values in own.items():
                if values.shape != self.t.shape:
                    raise DataError(
                        f"{where}: {name!r} of {kind} has shape {values.shape}, expected "
                        f"{self.t.shape}"
                    )
                require_finite(values[:, None], self.t, [f"{kind} {name}"], where)
            object.__setattr__(self, kind, own)

    @property
    def name(self) -> str:
        """Name of the file, "log" if there is none."""
        return Path(self.path).name or "log"

    def __repr__(self) -> str:
        return f"<Log {Path(self.path).name or 'in memory'}: {_extent(self)}>"

    def window(self, start: float | None = None, end: float | None = None) -> "Log":
        """Return the log from start to end, both included.

        Args:
            start: First time stamp, on the log's own clock [s]; None for the first row.
            end: Last time stamp [s]; None for the last row.

        Raises:
            DataError: If fewer than two rows lie in this window.
        """
        for name, limit in (("start", start), ("end", end)):
            is_end = isinstance(limit, float | np.floating) and bool(np.isinf(limit))
            if not (limit is None or is_end or is_number(limit)):
                raise DataError(f"{name} is {str(limit)[:60]!r}, expected a time [s], or None")
        within = slice(*rows_within(self.t, self.name, start, end))
        return replace(
            self,
            t=self.t[within],
            base=None if self.base is None else self.base.at(within),
            contacts={link: flags[within] for link, flags in self.contacts.items()},
            wrenches={name: values[within] for name, values in self.wrenches.items()},
            **{k: x[within] for k, x in self._arrays().items()},
        )

    def select(self, joints: Sequence[str]) -> "Log":
        """Return the log of some joints.

        Args:
            joints: Names of these joints, in the required order.

        Raises:
            DataError: If a joint is not in the log.
        """
        for name in require_each(joints, str, "joints", "a list of names"):
            if name not in self.joints:
                raise DataError(
                    f"joint {name!r} is not in {self.name}; joints: {listed(self.joints)}"
                    f"{suggestion(name, self.joints)}"
                )
        columns = [self.joints.index(name) for name in joints]
        chosen = {name: x[:, columns] for name, x in self._arrays().items()}
        factors = self.gain_factors[:, columns]
        return replace(self, joints=tuple(joints), gain_factors=factors, **chosen)

    def turned(self, sign: Array) -> "Log":
        """Return the log with the signs of some joints reversed.

        Args:
            sign: 1 or -1 of each joint, shape (n,).
        """
        sign = real_numbers(sign, "sign")
        if sign.shape != (len(self.joints),):
            raise DataError(f"sign has shape {sign.shape}, expected ({len(self.joints)},)")
        return replace(self, **{name: sign * x for name, x in self._arrays().items()})

    def _arrays(self) -> dict[str, Any]:
        """Return the existing arrays with one column per joint."""
        arrays = {name: getattr(self, name) for name in COLUMNS.values()}
        return {name: x for name, x in arrays.items() if x is not None}


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion that is smooth within each segment, in SI units. The arrays are read-only.

    Attributes:
        t: Time stamps, shape (N,) [s].
        q: Joint positions, shape (N, n) [rad or m]; of a floating base the pose before them,
            (N, 7 + n).
        v: Velocities, shape (N, n) [rad/s or m/s]; with the twist of the base, (N, 6 + n).
        a: Accelerations, likewise [rad/s^2 or m/s^2].
        tau: Torques, shape (N, n) [N m or N]; with the wrench of the base, 0, (N, 6 + n). With a
            basis, the torques without those of constraint forces.
        joints: Names of the n joints, in the order of the columns.
        rate: Rate of the uniform grid [Hz]; None if the rows are those of the log.
        segment: Number of the segment without gaps of each row, shape (N,), int.
        direction: Sign of each speed that determines Coulomb friction, filtered as the torque,
            shape (N, c) [-], in the order of ``friction_speeds``; None: the sign of the speed.
        memory: Regressor columns of drive parameters that depend on internal states, shape (N, m),
            in the order of ``ParameterLayout.remembering``; None if there are none.
        contacts: Which contacts may touch the ground, shape (N, k), bool; None without contacts.
        switching: Samples at which a contact changes and the acceleration jumps, or that a jump of
            the logged pose of the base reaches, shape (N,), bool; None without contacts and base.
        wrenches: Measured components of wrenches, shape (N, m) [N or N m]; None without any.
        basis: Basis of the torques of constraint forces, shape (N, n_rows, m), as of
            ``force_basis``; None without constraints.
        loaded: Torques with those of unknown constraint forces, shape (N, n_rows) [N m, N]; None
            without constraints.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    tau: Array
    joints: tuple[str, ...]
    rate: float | None
    segment: Array
    direction: Array | None = None
    memory: Array | None = None
    contacts: Array | None = None
    wrenches: Array | None = None
    switching: Array | None = None
    basis: Array | None = None
    loaded: Array | None = None

    def __post_init__(self) -> None:
        _settle(self, "trajectory", {"q": self.q, "v": self.v, "a": self.a, "tau": self.tau})
        try:
            segment = np.asarray(self.segment)
        except ValueError:  # rows of unequal length
            segment = np.asarray(None)
        if segment.shape != self.t.shape or segment.dtype.kind not in "iu":
            raise DataError(
                f"trajectory: segment is {segment.dtype} of shape {segment.shape}, expected "
                f"integers of shape {self.t.shape}"
            )
        object.__setattr__(self, "segment", frozen(segment, np.int_))
        if self.direction is not None:
            direction = frozen(self.direction)
            if direction.ndim != 2 or len(direction) != len(self.t):
                raise DataError(
                    f"trajectory: direction has shape {direction.shape}, expected ({len(self.t)}, "
                    "c): a column for each speed that determines Coulomb friction"
                )
            names = [f"direction {k}" for k in range(direction.shape[1])]
            require_finite(direction, self.t, names, "trajectory")
            object.__setattr__(self, "direction", direction)
        if self.rate is not None and not (is_number(self.rate) and self.rate > 0):
            raise DataError(f"trajectory: rate is {self.rate!r}, expected more than 0 or None")

    def __repr__(self) -> str:
        segments = len(np.unique(self.segment))
        return f"<Trajectory: {_extent(self, self.rate)}, in {segments} segments>"

    @cached_property
    def derived(self) -> dict[str, Any]:
        """Cache of values computed from this motion, by name."""
        return {}

    def with_states(self, memory: Array | None) -> "Trajectory":
        """Return the same motion with other internal states of drives, and the same cache.

        Args:
            memory: Columns of internal states, as of ``memory``.
        """
        same = copy(self)
        vars(same).update(memory=memory, derived=self.derived)
        return same

    @property
    def squares(self) -> Array:
        """Sums of tau^2, v^2 and a^2 over the samples, shape (3, n)."""
        return np.array([np.einsum("kj,kj->j", x, x) for x in (self.tau, self.v, self.a)])

    def every(self, step: int) -> "Trajectory":
        """Return every n-th sample, without a rate.

        Args:
            step: The number n.
        """
        if step < 1:
            raise SettingsError(f"step is {step}, expected 1 or more")
        if step == 1:
            return self
        thinned = self.at(slice(None, None, step))
        vars(thinned)["rate"] = None
        return thinned

    def at(self, rows: Array | slice) -> "Trajectory":
        """Return some samples, without new checks of their values.

        Args:
            rows: Their numbers.
        """
        require_kind(rows, (slice, np.ndarray, list), "rows", "a slice or an array of numbers")
        some = copy(self)
        vars(some).pop("derived", None)
        for name in _BY_SAMPLE:
            values = getattr(self, name)
            if values is not None:
                try:
                    vars(some)[name] = own = values[rows]
                except IndexError as error:
                    raise DataError(f"rows are not samples of the trajectory: {error}") from error
                own.flags.writeable = False
        return some


def rows_within(
    t: Array, name: str, start: float | None = None, end: float | None = None
) -> tuple[int, int]:
    """Return the first row from start to end [s] and the row after the last, both included."""
    first = 0 if start is None else int(np.searchsorted(t, start))
    stop = len(t) if end is None else int(np.searchsorted(t, end, side="right"))
    if stop - first < 2:
        low, high = t[0] if start is None else start, t[-1] if end is None else end
        raise DataError(
            f"{name}: {max(stop - first, 0)} rows lie between {seconds(low)} s and {seconds(high)} "
            f"s; the log spans {seconds(t[0])} s to {seconds(t[-1])} s. Choose start and end "
            "inside it"
        )
    return first, stop


def repeated(names: Sequence[str]) -> list[str]:
    """Return the names that occur more than once, each once, sorted."""
    return sorted(name for name, count in Counter(names).items() if count > 1)


def _settle(owner: Log | Trajectory, where: str, arrays: dict[str, Array | None]) -> None:
    """Check joints, shapes and values of the arrays, and replace them by read-only ones."""
    joints = _names(owner.joints, where)
    if twice := repeated(joints):
        raise DataError(f"{where}: joints contains {listed(twice)} twice; name each joint once")
    t = real_numbers(owner.t, f"{where}: t")
    if t.ndim != 1:
        raise DataError(f"{where}: t has shape {t.shape}, expected (N,)")
    require_finite(t[:, None], t, ["time"], where)
    settled = {"t": t}
    for name, values in arrays.items():
        if values is None and name not in _REQUIRED:
            continue
        array = real_numbers(values, f"{where}: {name}", hint=_NO_TORQUE if name == "tau" else "")
        base = _base_width(owner, name)
        if array.shape != (len(t), base + len(joints)):
            raise DataError(
                f"{where}: {name} has shape {array.shape}, expected {(len(t), len(joints))}: a row "
                f"for each time stamp, a column for each of the joints {listed(joints)}"
            )
        names = [f"{name}_{x}" for x in (*(f"base {k}" for k in range(base)), *joints)]
        require_finite(array, t, names, where)
        settled[COLUMNS.get(name, name)] = array
    for name, array in settled.items():
        object.__setattr__(owner, name, array)
    object.__setattr__(owner, "joints", joints)


def _base_width(owner: Log | Trajectory, name: str) -> int:
    """Return the columns of an array before those of the joints: 7 or 6 of a floating base."""
    floats = isinstance(owner, Trajectory) and np.ndim(owner.q) == 2
    if not floats or np.shape(owner.q)[1] != len(tuple(owner.joints)) + len(POSE):
        return 0
    return len(POSE) if name == "q" else 6


def _names(joints: object, where: str) -> tuple[str, ...]:
    """Return the names of joints as a tuple."""
    names = joints.tolist() if isinstance(joints, np.ndarray) else joints
    is_list = isinstance(names, Iterable) and not isinstance(names, str | Mapping)
    labels: tuple[Any, ...] = tuple(names) if is_list else ()  # type: ignore[arg-type]
    if not labels or not all(isinstance(name, str) for name in labels):
        raise DataError(f"{where}: joints is {joints!r}, expected at least one name in a tuple")
    return labels


def require_finite(
    values: Array, t: Array, names: Sequence[str], where: str, first: int = 0
) -> None:
    """Reject NaN, infinite values and values beyond 1e30; the error names the first: t (N,) [s]."""
    is_fine = np.abs(values) <= LARGEST_SETTING  # False for NaN, too
    if is_fine.all():
        return
    row, column = (int(i) for i in np.argwhere(~is_fine)[0])
    value = values[row, column]
    found = "NaN" if np.isnan(value) else f"{value:g}" if np.isfinite(value) else str(value)
    what = ", which is implausibly large," if np.isfinite(value) else ""
    at = f" (t = {seconds(t[row])} s)" if np.isfinite(t[row]) else ""
    raise DataError(
        f"{where}: {names[column]} is {found}{what} at row {first + row}{at}; remove such rows or "
        "correct the recording",
        code="not_finite",
    )


def require_increasing(t: Array, where: str, first: int = 0) -> None:
    """Reject stamps that repeat, decrease, or have tiny steps; names the first: t (N,) [s]."""
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back) == 0:
        step = float(t[-1] - t[0]) / (len(t) - 1) if len(t) > 1 else np.inf
        if step >= _SHORTEST:
            return
        raise DataError(
            f"{where}: {len(t)} rows lie within {float(t[-1] - t[0]):.3g} s, so the mean time step "
            f"is {step:.3g} s, expected at least {_SHORTEST:g} s; correct the time stamps or their "
            "unit",
            code="time_unit",
        )
    k = int(back[0]) + 1
    row, now, before = first + k, _stamp(t[k]), _stamp(t[k - 1])
    if t[k] == t[k - 1]:
        raise DataError(
            f"{where}: t must increase, but t[{row}] = {now} s is a duplicate time stamp, "
            f"the same as t[{row - 1}]; keep one row of each stamp",
            code="duplicate_stamp",
        )
    raise DataError(
        f"{where}: t must increase, but t[{row}] = {now} s follows t[{row - 1}] = {before} s; "
        "sort the rows, or correct the recording",
        code="stamp_order",
    )


def _stamp(t: float) -> str:
    """Return a time stamp with three decimals, or with more if it has more."""
    return f"{t:.3f}" if round(t, 3) == t else f"{t:.13g}"


def _extent(motion: Log | Trajectory, rate: float | None = None) -> str:
    """Return a text with the joints, the duration and the rate of a motion."""
    t, joints = motion.t, motion.joints
    if rate is None:
        rate = 1.0 / float(np.median(np.diff(t))) if len(t) > 1 else np.nan
    return (
        f"{len(t)} samples of {len(joints)} joints ({', '.join(joints)}) over "
        f"{t[-1] - t[0] if len(t) else 0.0:.6g} s at {rate:.4g} Hz"
    )


def map_stamps(blocks: Iterable[Array], where: str) -> Array:
    """Time stamps of a log, shape (N,) [s], in a file that exists as long as the array."""
    count, last = 0, np.empty(0)
    with tempfile.TemporaryFile() as file:
        for block in blocks:
            require_finite(block[:, None], block, ["time"], where, count)
            require_increasing(np.append(last, block), where, count - len(last))
            np.ascontiguousarray(block, dtype=np.float64).tofile(file)
            count, last = count + len(block), block[-1:]
        file.flush()
        return np.memmap(file, np.float64, "r", shape=(count,)) if count else last


def blocks_of(t: Array) -> Iterator[tuple[int, Array]]:
    """Yield time stamps in blocks; each block shares a stamp with the block before: t (N,) [s]."""
    for row in range(0, len(t) - 1, _BLOCK):
        yield row, t[row : row + _BLOCK + 1]


def median_step(t: Array) -> float:
    """Return the median time step [s] of stamps (N,); those of a long log are sorted in a file."""
    if len(t) <= _BLOCK:
        return float(np.median(np.diff(t)))
    with tempfile.TemporaryFile() as file:
        steps = np.memmap(file, np.float64, "w+", shape=(len(t) - 1,))
        for row, block in blocks_of(t):
            steps[row : row + len(block) - 1] = np.diff(block)
        return float(np.median(steps, overwrite_input=True))


def repeated_share(fitted: Sequence[Trajectory], validation: Trajectory) -> float:
    """Return the largest share of a motion that is in one of others."""
    size = np.maximum(np.ptp(validation.q, axis=0), 1e-3)
    instants = _segments(validation, size, _INSTANTS)
    return max((_share(instants, _segments_tree(motion, size)) for motion in fitted), default=0.0)


def alike_motions(motions: Sequence[Trajectory]) -> list[list[int]]:
    """Return the motions in groups: one that repeats another one is in its group."""
    low, high = (np.array([f(x.q, axis=0) for x in motions]) for f in (np.min, np.max))
    size = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-3)
    trees = [_segments_tree(motion, size) for motion in motions]
    groups: list[list[int]] = []
    for k, motion in enumerate(motions):
        instants = _segments(motion, size, _FEW)
        same = [x for x in groups if any(_share(instants, trees[j]) >= REPEATED for j in x)]
        groups = [group for group in groups if group not in same]
        groups.append([*(j for group in same for j in group), k])
    return sorted(sorted(group) for group in groups)


def _segments_tree(motion: Trajectory, size: Array) -> Any:  # noqa: ANN401
    """Return the tree of all segments of a motion; None without any."""
    from scipy.spatial import cKDTree

    segments = _segments(motion, size, None)
    return cKDTree(segments) if len(segments) else None


def _share(instants: Array, tree: Any) -> float:  # noqa: ANN401
    """Return the share of instants that are near one of a tree."""
    if tree is None or not len(instants):
        return 0.0
    distance, _ = tree.query(instants, p=np.inf, distance_upper_bound=_NEAR)
    return float(np.mean(np.isfinite(distance)))


def _segments(motion: Trajectory, size: Array, count: int | None) -> Array:
    """Return positions at instants and up to a second after, over the size, where joints move."""
    step = float(np.median(np.diff(motion.t)))
    ahead = [round(s / step) for s in _AHEAD]
    last = len(motion.t) - ahead[-1]
    if last <= 0:
        return np.empty((0, len(_AHEAD) * len(size)))
    starts = np.arange(last)
    is_unbroken = motion.segment[starts] == motion.segment[starts + ahead[-1]]
    moved = np.abs(motion.q[starts + ahead[-1]] - motion.q[starts]) / size
    starts = starts[is_unbroken & (moved.max(axis=1) > 2 * _NEAR)]
    if count is not None and len(starts) > count:
        starts = starts[np.linspace(0, len(starts) - 1, count).astype(int)]
    else:
        # instants so close that fast motion moves less than the bound between two of them
        starts = starts[:: max(1, round(0.005 / step))]
    return np.hstack([motion.q[starts + k] / size for k in ahead])
