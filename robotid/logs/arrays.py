"""NPZ, HDF5 and MATLAB files, arrays under paths, as tables of named columns."""

import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError
from robotid.findings import listed
from robotid.logs.data import suggestion
from robotid.logs.settings import LogSource
from robotid.logs.table import Table, choose, prefixes

__all__ = ["open_hdf5", "open_mat", "open_npz", "write_hdf5", "write_mat", "write_npz"]

_CLOCKS = ("time", "t")
_LISTS = ("joints", "joint_names")  # entries that name the columns of wide arrays
_WIDE = {prefix[:-1] for kinds in prefixes().values() for prefix in kinds}  # q, position, ...
_MAT73 = b"MATLAB 7.3"  # how a MAT file starts that is HDF5 inside
_MAT_NAME = 63  # characters that MATLAB allows in a name


def open_npz(path: Path, source: LogSource) -> Table:
    """Return the table in an NPZ file; pickled objects are not read.

    Args:
        path: The file.
        source: Which group, if names hold slashes.

    Returns:
        The table.

    Raises:
        DataError: If the file is broken, or the group is missing or one of several.
    """
    arrays: dict[str, Array] = {}
    broken = (OSError, EOFError, zlib.error, zipfile.BadZipFile)
    with _told(path, "NPZ", broken), zipfile.ZipFile(path), np.load(path) as file:
        for name in file.files:
            with suppress(ValueError):  # of pickled objects
                arrays[name] = np.asarray(file[name])
    return _table_of_arrays(path.name, {n: _entry(a) for n, a in arrays.items()}, source)


def open_hdf5(path: Path, source: LogSource) -> Table:
    """Return the table in an HDF5 file; only the columns that are read are loaded.

    Args:
        path: The file.
        source: Which group.

    Returns:
        The table.

    Raises:
        DataError: If the file is broken, or the group is missing or one of several.
        MissingDependencyError: If h5py is not installed.
    """
    with _open_hdf5(path) as file:
        entries = _datasets(file, path, is_matlab=False)
    return _table_of_arrays(path.name, entries, source)


def open_mat(path: Path, source: LogSource) -> Table:
    """Return the table in a MATLAB file of any version, v7.3 among them.

    Args:
        path: The file.
        source: Which struct.

    Returns:
        The table.

    Raises:
        DataError: If the file is broken, or the struct is missing or one of several.
        MissingDependencyError: If the file is v7.3 and h5py is not installed.
    """
    with path.open("rb") as file:
        is_hdf5 = file.read(len(_MAT73)) == _MAT73
    if is_hdf5:
        with _open_hdf5(path) as file:
            entries = _datasets(file, path, is_matlab=True)
    else:
        entries = _mat_variables(path)
    return _table_of_arrays(path.name, entries, source)


def write_npz(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as a compressed NPZ file.

    Args:
        table: Arrays of shape (N,) by name.
        path: The file.
    """
    columns: dict[str, Any] = dict(table)
    with path.open("wb") as file:
        np.savez_compressed(file, **columns)


def write_hdf5(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as compressed datasets of an HDF5 file.

    Args:
        table: Arrays of shape (N,) by name.
        path: The file.

    Raises:
        MissingDependencyError: If h5py is not installed.
    """
    with _h5py("writing HDF5").File(path, "w") as file:
        for name, values in table.items():
            file.create_dataset(name, data=values, compression="gzip", shuffle=True)


def write_mat(table: Mapping[str, Array], path: Path) -> None:
    """Write columns as column vectors of a MATLAB file of version 7.

    Args:
        table: Arrays of shape (N,) by name.
        path: The file.

    Raises:
        DataError: If a name cannot be a variable in MATLAB.
    """
    from scipy.io import savemat

    for name in table:
        if not (name.isidentifier() and name.isascii() and len(name) <= _MAT_NAME):
            raise DataError(
                f"MATLAB has no variable called {name!r} (letters, digits and _, at most "
                f"{_MAT_NAME}); write another format"
            )
    with path.open("wb") as file:
        savemat(file, dict(table), oned_as="column", do_compression=True)


@dataclass(frozen=True)
class _Entry:
    """One array of a file.

    Attributes:
        shape: Its shape.
        is_number: Whether it holds real numbers.
        load: Returns the array.
    """

    shape: tuple[int, ...]
    is_number: bool
    load: Callable[[], Any]


@dataclass(frozen=True)
class _Column:
    """One column of an array; ``index`` None if the array is one."""

    path: str
    index: int | None = None


def _table_of_arrays(where: str, entries: Mapping[str, _Entry], source: LogSource) -> Table:
    """Return the table in a file of arrays.

    A vector is a column of its own name. A matrix of N samples, along its longer side, is n
    columns ``q_<joint>`` in the order of an entry ``joints``, else ``q_0``, ``q_1``, ...

    Args:
        where: Name of the file, for errors.
        entries: The arrays by path, as "arm/q_elbow".
        source: Which group of them.

    Returns:
        The table.

    Raises:
        DataError: If the group is not in the file, or could be one of several.
    """
    group = _group(where, list(entries), source.topic)
    inside = {path[len(group) :]: path for path in entries if path.startswith(group)}
    lists = [entries[inside[name]] for name in _LISTS if name in inside]
    joints = next((_joint_names(entry) for entry in lists if not entry.is_number), [])
    columns: dict[str, _Column] = {}
    for name, path in inside.items():
        if entries[path].is_number:
            columns |= _columns_of(where, name, path, entries[path].shape, joints)

    def read(wanted: Sequence[str]) -> dict[str, Array]:
        return _read(where, entries, {name: columns[name] for name in wanted})

    return Table(list(columns), read)


def _group(where: str, paths: Sequence[str], topic: str | None) -> str:
    """Return what the paths of the group start with: "" or a name with a slash behind it."""
    parents = {path: path.rpartition("/") for path in paths}
    groups = sorted({head + slash for head, slash, _ in parents.values()})
    if topic is not None:
        group = topic.strip("/") + "/" if topic.strip("/") else ""
        if not any(path.startswith(group) for path in paths):
            known = [name.rstrip("/") or "/" for name in groups]
            raise DataError(
                f"{where} has no group {topic!r}; groups found: "
                f"{listed(known)}{suggestion(topic, known)}"
            )
        return group
    timed = {head + slash for head, slash, tail in parents.values() if tail in _CLOCKS}
    if not timed:
        return ""
    names = sorted(name.rstrip("/") or "/" for name in timed)
    chosen = choose(where, names, "groups with a time", f"entries found: {listed(paths)}")
    return "" if chosen == "/" else chosen + "/"


def _joint_names(entry: _Entry) -> list[str]:
    """Return the names in an array of text."""
    return [
        (name.decode() if isinstance(name, bytes) else str(name)).strip()
        for name in np.ravel(entry.load()).tolist()
    ]


def _columns_of(
    where: str, name: str, path: str, shape: tuple[int, ...], joints: Sequence[str]
) -> dict[str, _Column]:
    """Return the columns that one array holds, by name."""
    slim = len(shape) == 1 or (len(shape) == 2 and 1 in shape)
    is_wide = name.rpartition("/")[2] in _WIDE and name not in _CLOCKS
    if len(shape) not in (1, 2) or (len(shape) == 2 and 0 in shape):
        return {}
    if slim and not is_wide:
        return {name: _Column(path)}
    count = 1 if slim else min(shape)
    if joints and is_wide and len(joints) != count:
        raise DataError(
            f"{where}: {name} has shape {shape}, but the file names {len(joints)} joints: "
            f"{listed(joints)}; give each joint one column"
        )
    names = joints if joints and len(joints) == count else [str(j) for j in range(count)]
    return {f"{name}_{names[j]}": _Column(path, j) for j in range(count)}


def _read(
    where: str, entries: Mapping[str, _Entry], columns: Mapping[str, _Column]
) -> dict[str, Array]:
    """Return columns; each array is loaded once, and all must be of one length."""
    loaded = {path: np.asarray(entries[path].load()) for path in _paths(columns)}
    table: dict[str, Array] = {}
    for name, column in columns.items():
        values = loaded[column.path]
        if column.index is None or values.size == max(values.shape):
            values = values.ravel()
        else:
            rows = values if values.shape[0] >= values.shape[1] else values.T
            values = rows[:, column.index]
        table[name] = values.astype(np.float64)
    first = next(iter(table))
    for name, values in table.items():
        if len(values) != len(table[first]):
            raise DataError(
                f"{where}: {name} has {len(values)} samples, {first} has {len(table[first])}; "
                "a row needs both"
            )
    if not len(table[first]):
        raise DataError(f"{where} has columns but no rows; record at least 2")
    return table


def _paths(columns: Mapping[str, _Column]) -> list[str]:
    """Return the paths of the arrays that columns are in, each once."""
    return list(dict.fromkeys(column.path for column in columns.values()))


def _entry(array: Array) -> _Entry:
    """Return an entry of an array in memory."""
    return _Entry(array.shape, array.dtype.kind in "iuf", lambda: array)


@contextmanager
def _told(path: Path, kind: str, errors: tuple[type[Exception], ...]) -> Iterator[None]:
    """Tell in our words what a reader says of a broken file."""
    try:
        yield
    except errors as error:
        raise DataError(f"{path.name}: broken {kind} file ({error}); export it again") from error


def _h5py(purpose: str) -> ModuleType:
    """Return h5py."""
    try:
        import h5py
    except ImportError as error:
        raise MissingDependencyError(purpose, "h5py", "hdf5") from error
    package: ModuleType = h5py
    return package


@contextmanager
def _open_hdf5(path: Path) -> Iterator[Any]:
    """Open an HDF5 file."""
    h5py = _h5py("reading HDF5 and MATLAB v7.3")
    with _told(path, "HDF5", (OSError, RuntimeError)), h5py.File(path, "r") as file:
        yield file


def _datasets(file: Any, path: Path, *, is_matlab: bool) -> dict[str, _Entry]:  # noqa: ANN401
    """Return the datasets of an open file by path; MATLAB's own bookkeeping is left out."""
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

    file.visititems(visit)
    return entries


def _load_dataset(path: Path, name: str, *, is_matlab: bool) -> Any:  # noqa: ANN401
    """Return one dataset; characters and cell arrays of MATLAB as a list of texts."""
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
    """Return the variables of a MAT file before v7.3 by path, fields of structs among them."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    broken = (MatReadError, ValueError, TypeError, OSError, EOFError, NotImplementedError)
    with _told(path, "MATLAB", broken):
        variables = loadmat(path, simplify_cells=True)
    entries: dict[str, _Entry] = {}

    def visit(prefix: str, content: Mapping[str, Any]) -> None:
        for name, value in content.items():
            if isinstance(value, dict):
                visit(f"{prefix}{name}/", value)
            elif not name.startswith("__"):
                entries[prefix + name] = _entry(np.asarray(value))

    visit("", variables)
    return entries
