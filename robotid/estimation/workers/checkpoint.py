"""Checkpoints: finished pieces of long work, stored until it is complete."""

import errno
import hashlib
import json
import logging
import os
import shutil
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.files import written_whole
from robotid.base.typing import Array
from robotid.estimation.workers.pieces import Workload

FOLDER = ".robotid-checkpoint"

_SHOWN = 5  # largest number of differences that a message names

_log = logging.getLogger(__name__)


class _Lock:
    """An exclusive lock of a folder for one run; it ends with the process.

    Without locks in the system or the file system (Windows, some network drives) there is none.
    """

    def __init__(self, folder: Path) -> None:
        try:
            import fcntl
        except ImportError:  # not a POSIX system
            self.release: Callable[[], object] = lambda: None
            return
        descriptor = os.open(folder, os.O_RDONLY)
        self.release = weakref.finalize(self, os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_free = folder.exists() and os.path.samestat(os.fstat(descriptor), folder.stat())
        except OSError as error:
            is_free = error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
        if not is_free:
            self.release()
            raise DataError(
                f"another run is using the checkpoint {folder}. Wait for its end, or write to "
                "another folder",
                "checkpoint",
            )


class _Stored(Protocol):
    """A result that arrays can represent, bit by bit."""

    def to_arrays(self) -> dict[str, Array]: ...

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> Any: ...  # noqa: ANN401


@dataclass(frozen=True)
class Checkpoint:
    """A folder with a file per finished piece, for one set of inputs.

    Only one run has it open, until it is released or removed.
    """

    folder: Path
    key: str  # SHA-256 of all inputs of the results, in hexadecimal
    lock: _Lock
    kind: type[_Stored]  # of the results

    @classmethod
    def open(
        cls,
        parent: str | Path,
        inputs: Mapping[str, Any],
        pieces: Sequence[Workload],
        kind: type[_Stored],
        *,
        resume: bool = False,
    ) -> "Checkpoint":
        """Open the checkpoint of work on pieces; an old one is replaced unless it is resumed."""
        folder = Path(parent) / FOLDER
        stated = {**inputs, "pieces": [piece.name for piece in pieces]}
        text = json.dumps(stated, sort_keys=True, indent=1)
        folder.mkdir(parents=True, exist_ok=True)
        key = hashlib.sha256(text.encode()).hexdigest()
        found = cls(folder, key, _Lock(folder), kind)
        with released_on_error(found):
            found._prepare(text, resume=resume)
        return found

    def _prepare(self, text: str, *, resume: bool) -> None:
        """Check the inputs of an interrupted run, if it is resumed, or empty the folder."""
        stated = self.folder / "inputs.json"
        if stated.is_file() and resume:
            self._require_same(json.loads(text))
            return
        if stated.is_file():
            _log.warning(
                "%s has an unfinished run. It is replaced, since --resume is not set", self.folder
            )
        elif resume:
            _log.warning("%s does not exist: no run to resume, a new one starts", self.folder)
        for old in self.folder.iterdir():
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old)
            else:
                old.unlink()
        with written_whole(stated) as beside:
            beside.write_text(text)

    def finished(self) -> frozenset[int]:
        """Return the indices of the finished pieces."""
        found = self.folder.glob(f"piece-{'[0-9]' * 6}.npz")
        return frozenset(int(path.stem.split("-")[1]) for path in found)

    def load(self, index: int) -> Any:  # noqa: ANN401
        """Return a stored result, with the same bits."""
        path = self._path(index)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                content = dict(arrays)
        except Exception as error:  # a damaged archive raises various exceptions
            raise DataError(
                f"{path} cannot be read ({error}). Delete it; its piece is then worked on again",
                "checkpoint",
            ) from error
        if str(content.pop("key")) != self.key:
            raise DataError(f"{path} is of a run with other inputs. Delete it", "checkpoint")
        return self.kind.from_arrays(content)

    def save(self, index: int, name: str, result: _Stored) -> None:
        """Store the result of a piece; the file is written completely or not at all."""
        content: dict[str, Any] = result.to_arrays()
        content |= {"key": self.key, "piece": name}
        with written_whole(self._path(index)) as beside, beside.open("wb") as file:
            np.savez(file, **content)
            file.flush()
            os.fsync(file.fileno())

    def remove(self) -> None:
        """Remove the folder, after the run is complete."""
        shutil.rmtree(self.folder)
        self.release()

    def release(self) -> None:
        """Release the lock, so that another run can open it."""
        self.lock.release()

    def _path(self, index: int) -> Path:
        return self.folder / f"piece-{index:06d}.npz"

    def _require_same(self, stated: Mapping[str, Any]) -> None:
        path = self.folder / "inputs.json"
        try:
            before = json.loads(path.read_text())
        except ValueError as error:
            raise DataError(f"{path} is not valid JSON: {error}. Run without --resume") from error
        differences = list(_differences(before, stated))
        if differences:
            more = len(differences) - _SHOWN
            tail = f", and {more} more" if more > 0 else ""
            raise DataError(
                f"{self.folder} is the checkpoint of other inputs: "
                f"{'; '.join(differences[:_SHOWN])}{tail}. Restore the inputs, or start a new run "
                "without --resume",
                "checkpoint",
            )


@contextmanager
def released_on_error(checkpoint: Checkpoint) -> Iterator[None]:
    """Release a checkpoint if the work in the context fails, so that it can be resumed."""
    try:
        yield
    except BaseException:
        checkpoint.release()
        raise


def _differences(old: object, new: object, name: str = "") -> Iterator[str]:
    """Yield the differences of two trees of plain values as text."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            yield from _differences(old.get(key), new.get(key), f"{name}.{key}" if name else key)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from _differences(one, other, f"{name}[{k}]")
    elif old != new:
        yield f"{name} was {_short(old)}, is {_short(new)}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
