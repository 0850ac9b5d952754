"""NPZ, HDF5 and MATLAB files as tables of columns, those of MuJoCo and Isaac Lab among them."""

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.data.base_motion import ACCELERATION, POSE, TWIST, in_base
from robotid.data.files.columns import is_quantity
from robotid.data.files.table import Format, Table, choose, load_package, parsing
from robotid.data.signal_settings import LogSource

_CLOCKS = ("time", "t")
_LISTS = ("joints", "joint_names")  # entries that name the columns of wide arrays
_MAT73 = b"MATLAB 7.3"  # first bytes of a MAT file in HDF5 format
_LARGEST_RATIO = 1032  # of the sizes before and after compression by deflate
_MAT_NAME = 63  # largest number of characters of a name in MATLAB
#: Arrays of simulators: quantity of the joints, and values of a free joint before them.
_SIMULATED = {
    "qpos": ("q", 7), "qvel": ("dq", 6), "qacc": ("ddq", 6), "qfrc_actuator": ("tau", 6),
    "joint_pos": ("q", 0), "joint_vel": ("dq", 0), "joint_acc": ("ddq", 0),
    "applied_torque": ("tau", 0),
}  # fmt: skip
_ROOTS = ("root_link_state_w", "root_state_w")
_OF_MASS = (
    "root_state_w has the velocity of the centre of mass, which is not used; export "
    "root_link_state_w to use it"
)


@dataclass(frozen=True)
class _Entry:
    """One array of a file, loaded at its first use."""

    shape: tuple[int, ...]
    is_number: bool
    load: Callable[[], Any]

    @property
    def width(self) -> int:
        """Number of its columns; samples are along its longer side. 0 if it has no columns."""
        if not self.is_number or len(self.shape) not in (1, 2):
            return 0
        return 1 if len(self.shape) == 1 else min(self.shape)

    def columns(self) -> Array:
        """Return its columns, shape (N, width)."""
        values = np.asarray(self.load())
        if values.size == max(values.shape):
            return values.reshape(-1, 1)
        return values if values.shape[0] >= values.shape[1] else values.T


#: Place of a column: an array, and the index in it.
_Column: TypeAlias = tuple[_Entry, int]


def _open_npz(path: Path, source: LogSource) -> Table:
    """Pickled objects are not read."""
    arrays: dict[str, Array] = {}
    with parsing(path, "NPZ"), zipfile.ZipFile(path) as file:
        for member in file.namelist():
            name = member.removesuffix(".npy")
            with file.open(member) as stream:
                version = np.lib.format.read_magic(stream)
                read = np.lib.format.read_array_header_1_0
                if version != (1, 0):
                    read = np.lib.format.read_array_header_2_0  # also of version 3
                shape, _, dtype = read(stream)
                _require_plausible_size(path, name, shape)
            if not dtype.hasobject:
                with file.open(member) as stream:
                    arrays[name] = np.lib.format.read_array(stream)
    return _table_of_arrays(path, {n: _entry(a) for n, a in arrays.items()}, source)


def _write_npz(table: Mapping[str, Array], path: Path) -> None:
    with path.open("wb") as file:
        np.savez_compressed(file, **dict[str, Any](table))


def _write_hdf5(table: Mapping[str, Array], path: Path) -> None:
    (h5py,) = load_package("writing HDF5", "hdf5", "h5py")
    # first in memory: HDF5 ends the process if the disk is full
    with h5py.File(path, "w", driver="core", backing_store=False) as file:
        for name, values in table.items():
            file.create_dataset(name, data=values, compression="gzip", shuffle=True)
        file.flush()
        path.write_bytes(file.id.get_file_image())


def _open_mat(path: Path, source: LogSource) -> Table:
    """Any version, including v7.3."""
    with path.open("rb") as file:
        is_hdf5 = file.read(len(_MAT73)) == _MAT73
    entries = _datasets(path, is_matlab=True) if is_hdf5 else _mat_variables(path)
    return _table_of_arrays(path, entries, source)


def _write_mat(table: Mapping[str, Array], path: Path) -> None:
    """Column vectors in version 7."""
    from scipy.io import savemat

    for name in table:
        if not (name.isidentifier() and name.isascii() and len(name) <= _MAT_NAME):
            raise DataError(
                f"{name!r} is not a valid name of a MATLAB variable (letters, digits and _, at "
                f"most {_MAT_NAME} characters); write another format"
            )
    with path.open("wb") as file:
        savemat(file, dict(table), oned_as="column", do_compression=True)


NPZ = Format((".npz",), _open_npz, _write_npz, written=(".npz",), topics="group")
HDF5 = Format(
    (".h5", ".hdf5"),
    lambda path, source: _table_of_arrays(path, _datasets(path, is_matlab=False), source),
    _write_hdf5, written=(".h5", ".hdf5"), topics="group",
)  # fmt: skip
MAT = Format((".mat",), _open_mat, _write_mat, written=(".mat",), topics="group")


def _table_of_arrays(path: Path, entries: Mapping[str, _Entry], source: LogSource) -> Table:
    """Return the table in a file of arrays: of a matrix the columns ``q_<joint>``, else ``q_0``."""
    where = path.name
    group = _group(where, list(entries), source.topic)
    inside = {at[len(group) :]: x for at, x in entries.items() if at.startswith(group)}
    texts = [name for name in _LISTS if name in inside and not inside[name].is_number]
    joints = _joint_names(where, texts[0], inside[texts[0]]) if texts else []
    for name, entry in inside.items():
        if entry.is_number:
            _require_plausible_size(path, name, entry.shape)
    known = () if any(x == "q" or x.startswith("q_") for x in inside) else (*_SIMULATED, *_ROOTS)
    simulated = {name: x for name, x in inside.items() if name in known and x.width > 1}
    columns: dict[str, _Column] = {}
    for name, entry in inside.items():
        if name not in simulated:
            columns |= _columns_of(where, name, entry, joints)
    for name in filter(_SIMULATED.__contains__, simulated):
        columns |= _joint_columns(where, name, simulated[name], joints)
    columns |= _base_columns(where, simulated, len(joints))
    is_of_mass = "root_state_w" in simulated and "root_link_state_w" not in simulated
    notes = (_OF_MASS,) if is_of_mass and simulated.get("qpos") is None else ()
    axes = {"twist": "base"} if simulated else {}
    return Table(list(columns), partial(_read, where, columns), notes, axes=axes)


def _group(where: str, paths: Sequence[str], topic: str | None) -> str:
    """Return the prefix of the paths in the group: "" or a name that ends with a slash."""
    parents = [path.rpartition("/") for path in paths]
    if topic is not None:
        group = topic.strip("/") + "/" if topic.strip("/") else ""
        if not any(path.startswith(group) for path in paths):
            known = sorted({head or "/" for head, _, _ in parents})
            raise DataError(
                f"{where} has no group {topic!r}; groups found: "
                f"{listed(known)}{suggestion(topic, known)}"
            )
        return group
    names = sorted({head or "/" for head, _, tail in parents if tail in _CLOCKS})
    if not names:
        return ""
    chosen = choose(where, names, "groups with a time", f"entries found: {listed(paths)}")
    return "" if chosen == "/" else chosen + "/"


def _require_plausible_size(path: Path, name: str, shape: tuple[int, ...]) -> None:
    """Reject an array that is too large for its file, before it is allocated."""
    size = path.stat().st_size
    if math.prod(shape) > _LARGEST_RATIO * size:
        raise DataError(
            f"{path.name}: {name} has the shape {shape}, which is too large for a file of {size} "
            "bytes; export it again"
        )


def _joint_names(where: str, list_name: str, entry: _Entry) -> list[str]:
    """Return the names in an array of text."""
    names = np.ravel(entry.load()).tolist()
    try:
        return [(n.decode() if isinstance(n, bytes) else str(n)).strip() for n in names]
    except UnicodeDecodeError as error:
        raise DataError(
            f"{where}: a name in {list_name} is not UTF-8 text: {error}; export it again"
        ) from error


def _columns_of(where: str, name: str, entry: _Entry, joints: Sequence[str]) -> dict[str, _Column]:
    """Return the columns of one array, by name."""
    is_wide = is_quantity(name.rpartition("/")[2]) and name not in _SIMULATED
    if entry.width == 1 and not is_wide:
        return {name: (entry, 0)}
    if joints and is_wide and len(joints) != entry.width > 0:
        raise DataError(
            f"{where}: {name} has the shape {entry.shape}, but the file names {len(joints)} "
            f"joints: {listed(joints)}; write one column per joint"
        )
    names = joints if len(joints) == entry.width else list(map(str, range(entry.width)))
    return {f"{name}_{names[j]}": (entry, j) for j in range(entry.width)}


def _joint_columns(
    where: str, name: str, entry: _Entry, joints: Sequence[str]
) -> dict[str, _Column]:
    """Return the columns of the joints in an array of a simulator."""
    kind, of_base = _SIMULATED[name]
    before = entry.width - len(joints) if joints else 0
    if before not in (0, of_base):
        raise DataError(
            f"{where}: {name} has {entry.width} columns, expected {len(joints)}, one for each "
            "joint that the file names" + f", or {of_base} more with a free joint" * bool(of_base)
        )
    ends = joints or list(map(str, range(entry.width)))
    return {f"{kind}_{end}": (entry, before + k) for k, end in enumerate(ends)}


def _base_columns(where: str, arrays: Mapping[str, _Entry], joints: int) -> dict[str, _Column]:
    """Return the columns of a floating base in arrays of a simulator."""
    # MuJoCo's v has the world's axes, w the base's; Isaac Lab's both have the world's
    root = next((name for name in _ROOTS if name in arrays), "")
    if joints and "qpos" in arrays and arrays["qpos"].width == joints + 7:
        names = [name for name in ("qpos", "qvel", "qacc") if name in arrays]
        names = names if "qvel" in names else ["qpos"]
        kinds = (POSE, TWIST, ACCELERATION)[: len(names)]
    elif root:
        wanted = len((*POSE, *TWIST))
        if arrays[root].width != wanted:
            raise DataError(f"{where}: {root} has {arrays[root].width} columns, expected {wanted}")
        names, kinds = [root], (POSE, TWIST) if root == "root_link_state_w" else (POSE,)
    else:
        return {}

    def load() -> Array:
        states = [arrays[name].columns() for name in names]
        pose = states[0][:, [0, 1, 2, 4, 5, 6, 3]]  # the quaternion starts with w
        parts, quaternion = [pose], pose[:, 3:]
        if root in names:
            parts += [in_base(quaternion, states[0][:, k : k + 3]) for k in (7, 10)]
        elif len(states) > 1:
            v, w = in_base(quaternion, states[1][:, :3]), states[1][:, 3:6]
            parts += [v, w]
            for rates in states[2:]:
                dv = in_base(quaternion, rates[:, :3]) - np.cross(w, v)
                parts += [dv, rates[:, 3:6]]
        return np.hstack(parts)

    ends = [end for kind in kinds for end in kind]
    entry = _Entry((len(ends) + 1, len(ends)), True, load)
    return {f"base_{end}": (entry, k) for k, end in enumerate(ends)}


def _read(where: str, columns: Mapping[str, _Column], wanted: Sequence[str]) -> dict[str, Array]:
    """Return columns; each array is loaded once, and all must have the same length."""
    chosen = {name: columns[name] for name in wanted}
    entries = {id(entry): entry for entry, _ in chosen.values()}
    loaded = {key: entry.columns() for key, entry in entries.items()}
    table = {
        name: loaded[id(entry)][:, index].astype(np.float64)
        for name, (entry, index) in chosen.items()
    }
    first = next(iter(table))
    for name, values in table.items():
        if len(values) != len(table[first]):
            raise DataError(
                f"{where}: {name} has {len(values)} samples, {first} has {len(table[first])}; "
                "record the same number of samples"
            )
    if not len(table[first]):
        raise DataError(f"{where} has columns but no rows; record at least 2")
    return table


def _entry(array: Array) -> _Entry:
    """Return the entry of an array in memory."""
    return _Entry(array.shape, array.dtype.kind in "iuf", lambda: array)


@contextmanager
def _hdf5_file(path: Path) -> Iterator[Any]:
    (h5py,) = load_package("reading HDF5 and MATLAB v7.3", "hdf5", "h5py")
    with parsing(path, "HDF5"), h5py.File(path, "r") as file:
        yield file


def _datasets(path: Path, *, is_matlab: bool) -> dict[str, _Entry]:
    """Return the datasets of a file by path, without MATLAB's internal ones."""
    entries: dict[str, _Entry] = {}

    def visit(name: str, item: Any) -> None:  # noqa: ANN401
        if hasattr(item, "shape") and item.shape is not None and not name.startswith("#"):
            shape = item.shape[::-1] if is_matlab else item.shape  # MATLAB stores columns first
            is_text = item.attrs.get("MATLAB_class") == b"char"
            is_number = item.dtype.kind in "iuf" and not is_text
            entries[name] = _Entry(shape, is_number, partial(_dataset, path, name, is_matlab))

    with _hdf5_file(path) as file:
        file.visititems(visit)
    return entries


def _dataset(path: Path, name: str, is_matlab: bool) -> Any:  # noqa: ANN401
    """Return one dataset; characters and cell arrays of MATLAB become a list of texts."""
    with _hdf5_file(path) as file:
        dataset = file[name]
        if not is_matlab:
            return dataset[()]
        if dataset.dtype.kind == "O":  # references to arrays of characters
            return ["".join(map(chr, np.ravel(file[r][()]))) for r in np.ravel(dataset[()])]
        if dataset.attrs.get("MATLAB_class") == b"char":
            return ["".join(map(chr, row)) for row in dataset[()].T]
        return dataset[()].T


def _mat_variables(path: Path) -> dict[str, _Entry]:
    """Return the variables of a MAT file before v7.3 by path, including fields of structs."""
    from scipy.io import loadmat, whosmat

    with parsing(path, "MATLAB"):
        for name, shape, kind in whosmat(path):
            if kind != "sparse":
                _require_plausible_size(path, name, shape)
        variables = loadmat(path, simplify_cells=True)
    entries: dict[str, _Entry] = {}

    def visit(prefix: str, content: Mapping[str, Any]) -> None:
        for name, value in content.items():
            if isinstance(value, dict):
                visit(f"{prefix}{name}/", value)
            elif not name.startswith("__"):
                with suppress(ValueError):  # cells of several shapes are no array
                    entries[prefix + name] = _entry(np.asarray(value))

    visit("", variables)
    return entries
