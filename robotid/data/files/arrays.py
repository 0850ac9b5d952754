"""NPZ, HDF5 and MATLAB files, which contain arrays at paths, as tables of named columns."""

import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, MissingDependencyError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.files.column_names import is_quantity
from robotid.data.files.simulator_arrays import ARRAYS, with_simulator_arrays
from robotid.data.files.table import Table, WritableFormat, choose, parsing
from robotid.data.log import suggestion
from robotid.data.signal_settings import LogSource

_CLOCKS = ("time", "t")
_LISTS = ("joints", "joint_names")  # entries that name the columns of wide arrays
_MAT73 = b"MATLAB 7.3"  # first bytes of a MAT file in HDF5 format
_LARGEST_RATIO = 1032  # of the sizes before and after compression by deflate
_MAT_NAME = 63  # largest number of characters of a name in MATLAB


class NpzFormat(WritableFormat):
    """NPZ files, whose names may contain slashes; pickled objects are not read."""

    def open(self, path: Path, source: LogSource) -> Table:
        arrays: dict[str, Array] = {}
        with parsing(path, "NPZ"), zipfile.ZipFile(path) as file:
            for member in file.namelist():
                name = member.removesuffix(".npy")
                with file.open(member) as stream:
                    shape, dtype = _npy_header(stream)
                    _require_plausible_size(path, name, shape)
                if not dtype.hasobject:
                    with file.open(member) as stream:
                        arrays[name] = np.lib.format.read_array(stream)
        return _table_of_arrays(path, {n: _entry(a) for n, a in arrays.items()}, source)

    def write(self, table: Mapping[str, Array], path: Path) -> None:
        columns: dict[str, Any] = dict(table)
        with path.open("wb") as file:
            np.savez_compressed(file, **columns)


class Hdf5Format(WritableFormat):
    """HDF5 files, written with compression; only the required columns are loaded."""

    def open(self, path: Path, source: LogSource) -> Table:
        return _table_of_arrays(path, _datasets(path, is_matlab=False), source)

    def write(self, table: Mapping[str, Array], path: Path) -> None:
        h5py = _h5py("writing HDF5")
        # first in memory: HDF5 ends the process if the disk is full
        with h5py.File(path, "w", driver="core", backing_store=False) as file:
            for name, values in table.items():
                file.create_dataset(name, data=values, compression="gzip", shuffle=True)
            file.flush()
            path.write_bytes(file.id.get_file_image())


class MatFormat(WritableFormat):
    """MATLAB files of any version including v7.3; written as column vectors in version 7."""

    def open(self, path: Path, source: LogSource) -> Table:
        with path.open("rb") as file:
            is_hdf5 = file.read(len(_MAT73)) == _MAT73
        entries = _datasets(path, is_matlab=True) if is_hdf5 else _mat_variables(path)
        return _table_of_arrays(path, entries, source)

    def write(self, table: Mapping[str, Array], path: Path) -> None:
        from scipy.io import savemat

        for name in table:
            if not (name.isidentifier() and name.isascii() and len(name) <= _MAT_NAME):
                raise DataError(
                    f"{name!r} is not a valid name of a MATLAB variable (letters, digits and _, at "
                    f"most {_MAT_NAME} characters); write another format"
                )
        with path.open("wb") as file:
            savemat(file, dict(table), oned_as="column", do_compression=True)


@dataclass(frozen=True)
class _Entry:
    """One array of a file, loaded at its first use."""

    shape: tuple[int, ...]
    is_number: bool
    load: Callable[[], Any]


#: Place of a column: the path of an array and the index in it, None if the array is one column.
_Column: TypeAlias = tuple[str, int | None]


def _table_of_arrays(path: Path, entries: Mapping[str, _Entry], source: LogSource) -> Table:
    """Return the table in a file of arrays.

    A vector is a column of its own name. A matrix of N samples, along its longer side, is n
    columns ``q_<joint>`` in the order of an entry ``joints``, else ``q_0``, ``q_1``, ...
    """
    where = path.name
    group = _group(where, list(entries), source.topic)
    inside = {at[len(group) :]: at for at in entries if at.startswith(group)}
    lists = [(name, entries[inside[name]]) for name in _LISTS if name in inside]
    texts = [(name, entry) for name, entry in lists if not entry.is_number]
    joints = _joint_names(where, *texts[0]) if texts else []
    columns: dict[str, _Column] = {}
    for name, at in inside.items():
        if entries[at].is_number:
            _require_plausible_size(path, name, entries[at].shape)
            columns |= _columns_of(where, name, at, entries[at].shape, joints)
    table = Table(list(columns), partial(_read, where, entries, columns))
    return with_simulator_arrays(where, table, joints)


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


def _npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any]]:  # noqa: ANN401
    """Return shape and type of an array in NumPy's format."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0
    if version != (1, 0):
        read = np.lib.format.read_array_header_2_0  # also of version 3, except its encoding
    shape, _, dtype = read(stream)
    return shape, dtype


def _joint_names(where: str, list_name: str, entry: _Entry) -> list[str]:
    """Return the names in an array of text."""
    names = np.ravel(entry.load()).tolist()
    try:
        return [(n.decode() if isinstance(n, bytes) else str(n)).strip() for n in names]
    except UnicodeDecodeError as error:
        raise DataError(
            f"{where}: a name in {list_name} is not UTF-8 text: {error}; export it again"
        ) from error


def _columns_of(
    where: str, name: str, path: str, shape: tuple[int, ...], joints: Sequence[str]
) -> dict[str, _Column]:
    """Return the columns of one array, by name."""
    slim = len(shape) == 1 or (len(shape) == 2 and 1 in shape)
    is_wide = is_quantity(name.rpartition("/")[2]) and name not in ARRAYS
    if len(shape) not in (1, 2) or (len(shape) == 2 and 0 in shape):
        return {}
    if slim and not is_wide:
        return {name: (path, None)}
    count = 1 if slim else min(shape)
    if joints and is_wide and len(joints) != count:
        raise DataError(
            f"{where}: {name} has the shape {shape}, but the file names {len(joints)} joints: "
            f"{listed(joints)}; write one column per joint"
        )
    names = joints if joints and len(joints) == count else [str(j) for j in range(count)]
    return {f"{name}_{names[j]}": (path, j) for j in range(count)}


def _read(
    where: str,
    entries: Mapping[str, _Entry],
    columns: Mapping[str, _Column],
    wanted: Sequence[str],
) -> dict[str, Array]:
    """Return columns; each array is loaded once, and all must have the same length."""
    chosen = {name: columns[name] for name in wanted}
    loaded = {path: np.asarray(entries[path].load()) for path in {p for p, _ in chosen.values()}}
    table: dict[str, Array] = {}
    for name, (path, index) in chosen.items():
        values = loaded[path]
        if index is None or values.size == max(values.shape):
            values = values.ravel()
        else:
            values = (values if values.shape[0] >= values.shape[1] else values.T)[:, index]
        table[name] = values.astype(np.float64)
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


def _h5py(purpose: str) -> ModuleType:
    try:
        import h5py
    except ImportError as error:
        raise MissingDependencyError(purpose, "h5py", "hdf5") from error
    package: ModuleType = h5py
    return package


@contextmanager
def _open_hdf5(path: Path) -> Iterator[Any]:
    h5py = _h5py("reading HDF5 and MATLAB v7.3")
    with parsing(path, "HDF5"), h5py.File(path, "r") as file:
        yield file


def _datasets(path: Path, *, is_matlab: bool) -> dict[str, _Entry]:
    """Return the datasets of a file by path, without MATLAB's internal ones."""
    entries: dict[str, _Entry] = {}

    def visit(name: str, item: Any) -> None:  # noqa: ANN401
        if not hasattr(item, "shape") or item.shape is None or name.startswith("#"):
            return
        shape = item.shape[::-1] if is_matlab else item.shape  # MATLAB stores columns first
        is_text = item.attrs.get("MATLAB_class") == b"char"
        entries[name] = _Entry(
            shape,
            item.dtype.kind in "iuf" and not is_text,
            lambda: _load_dataset(path, name, is_matlab=is_matlab),
        )

    with _open_hdf5(path) as file:
        file.visititems(visit)
    return entries


def _load_dataset(path: Path, name: str, *, is_matlab: bool) -> Any:  # noqa: ANN401
    """Return one dataset; characters and cell arrays of MATLAB become a list of texts."""
    with _open_hdf5(path) as file:
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
