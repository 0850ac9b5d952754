"""NPZ, HDF5 and MATLAB files as tables of named columns; h5py is imported when it is needed."""

import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError, MissingDependencyError
from robotid.logs.array_tables import Entry, table_of_arrays
from robotid.logs.settings import LogSource
from robotid.logs.table import Table

__all__ = ["open_hdf5", "open_mat", "open_npz", "write_hdf5", "write_mat", "write_npz"]

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
    return table_of_arrays(path.name, {n: _entry(a) for n, a in arrays.items()}, source)


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
    return table_of_arrays(path.name, entries, source)


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
    return table_of_arrays(path.name, entries, source)


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


def _entry(array: Array) -> Entry:
    """Return an entry of an array in memory."""
    return Entry(array.shape, array.dtype.kind in "iuf", lambda: array)


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


def _datasets(file: Any, path: Path, *, is_matlab: bool) -> dict[str, Entry]:  # noqa: ANN401
    """Return the datasets of an open file by path; MATLAB's own bookkeeping is left out."""
    entries: dict[str, Entry] = {}

    def visit(name: str, item: Any) -> None:  # noqa: ANN401
        if not hasattr(item, "shape") or item.shape is None or name.startswith("#"):
            return
        shape = item.shape[::-1] if is_matlab else item.shape  # MATLAB stores columns first
        is_text = item.attrs.get("MATLAB_class") == b"char"
        entries[name] = Entry(
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


def _mat_variables(path: Path) -> dict[str, Entry]:
    """Return the variables of a MAT file before v7.3 by path, fields of structs among them."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    broken = (MatReadError, ValueError, TypeError, OSError, EOFError, NotImplementedError)
    with _told(path, "MATLAB", broken):
        variables = loadmat(path, simplify_cells=True)
    entries: dict[str, Entry] = {}

    def visit(prefix: str, content: Mapping[str, Any]) -> None:
        for name, value in content.items():
            if isinstance(value, dict):
                visit(f"{prefix}{name}/", value)
            elif not name.startswith("__"):
                entries[prefix + name] = _entry(np.asarray(value))

    visit("", variables)
    return entries
