"""Finished pieces of a long reduction, kept beside its results until it is complete."""

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
from typing import Any

import numpy as np

from robotid._files import written_whole
from robotid.exceptions import DataError
from robotid.regressor.factors import Reduction
from robotid.workers.pieces import Piece

__all__ = ["FOLDER", "Checkpoint", "released_on_error"]

FOLDER = ".robotid-checkpoint"

_SHOWN = 5  # differences that a message names

_log = logging.getLogger(__name__)


class _Lock:
    """The right of one run alone to work in a folder; a process that ends gives it back.

    Where the system or the file system has no locks (Windows, some network drives) there is none.

    Args:
        folder: The folder; it must exist.

    Raises:
        DataError: If another run has it.
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
                f"another run works in {folder} now, wanted a checkpoint of this run alone; wait "
                "for its end, or write to another folder",
                "checkpoint",
            )


@dataclass(frozen=True)
class Checkpoint:
    """A folder with a file per finished piece, each for one set of inputs only.

    Only one run at a time has it open, until it is released or removed.
    """

    folder: Path
    key: str  # SHA-256 of all that determines the reductions, in hexadecimal
    lock: _Lock

    @classmethod
    def open(
        cls,
        parent: str | Path,
        inputs: Mapping[str, Any],
        pieces: Sequence[Piece],
        *,
        resume: bool = False,
    ) -> "Checkpoint":
        """Open the checkpoint of a reduction; an old one is replaced unless it is resumed.

        Args:
            parent: Folder of the results; made if it is missing.
            inputs: All that determines the reductions, as values that JSON can hold.
            pieces: The pieces.
            resume: Whether finished pieces of an interrupted run are used.

        Raises:
            DataError: If the one to resume is of other inputs or cannot be read, or another run
                works in the folder.
        """
        folder = Path(parent) / FOLDER
        stated = {**inputs, "pieces": [piece.name for piece in pieces]}
        text = json.dumps(stated, sort_keys=True, indent=1)
        folder.mkdir(parents=True, exist_ok=True)
        key = hashlib.sha256(text.encode()).hexdigest()
        found = cls(folder, key, _Lock(folder))
        with released_on_error(found):
            found._begin(text, resume=resume)
        return found

    def _begin(self, text: str, *, resume: bool) -> None:
        """Keep what an interrupted run finished, if it is resumed, or empty the folder."""
        stated = self.folder / "inputs.json"
        if stated.is_file() and resume:
            self._require_same(json.loads(text))
            return
        if stated.is_file():
            _log.warning("%s holds an unfinished run, which is replaced (no --resume)", self.folder)
        elif resume:
            _log.warning("%s does not exist: nothing to resume, starting anew", self.folder)
        for old in self.folder.iterdir():
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old)
            else:
                old.unlink()
        with written_whole(stated) as beside:
            beside.write_text(text)

    def finished(self) -> frozenset[int]:
        """Return the indices of the pieces whose reductions are kept."""
        found = self.folder.glob(f"piece-{'[0-9]' * 6}.npz")
        return frozenset(int(path.stem.split("-")[1]) for path in found)

    def load(self, index: int) -> Reduction:
        """Return a reduction that is kept, to the same bits.

        Args:
            index: Which piece.

        Raises:
            DataError: If the file cannot be read or belongs to other inputs.
        """
        path = self._path(index)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                content = dict(arrays)
        except Exception as error:  # a broken archive fails in many ways
            raise DataError(
                f"{path} cannot be read ({error}); delete it, its piece is reduced again",
                "checkpoint",
            ) from error
        if str(content.pop("key")) != self.key:
            raise DataError(f"{path} belongs to other inputs; delete it", "checkpoint")
        return Reduction.from_arrays(content)

    def save(self, index: int, name: str, reduction: Reduction) -> None:
        """Keep the reduction of a piece; the file is there as a whole or not at all.

        Args:
            index: Which piece.
            name: Name of the piece.
            reduction: What it came down to.
        """
        content: dict[str, Any] = reduction.to_arrays()
        content |= {"key": self.key, "piece": name}
        with written_whole(self._path(index)) as beside, beside.open("wb") as file:
            np.savez(file, **content)
            file.flush()
            os.fsync(file.fileno())

    def remove(self) -> None:
        """Remove the folder, as when the run is complete."""
        shutil.rmtree(self.folder)
        self.release()

    def release(self) -> None:
        """Let another run have it."""
        self.lock.release()

    def _path(self, index: int) -> Path:
        return self.folder / f"piece-{index:06d}.npz"

    def _require_same(self, stated: Mapping[str, Any]) -> None:
        path = self.folder / "inputs.json"
        try:
            kept = json.loads(path.read_text())
        except ValueError as error:
            raise DataError(f"{path} is no JSON: {error}; run without --resume") from error
        differences = list(_differences(kept, stated))
        if differences:
            more = len(differences) - _SHOWN
            tail = f", and {more} more" if more > 0 else ""
            raise DataError(
                f"{self.folder} is the checkpoint of other inputs: "
                f"{'; '.join(differences[:_SHOWN])}{tail}. Restore them, or run without --resume "
                "to start anew",
                "checkpoint",
            )


@contextmanager
def released_on_error(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Release a checkpoint if the work in the context fails; a later run may resume it then.

    Args:
        checkpoint: The checkpoint, if there is one.
    """
    try:
        yield
    except BaseException:
        if checkpoint is not None:
            checkpoint.release()
        raise


def _differences(kept: object, now: object, name: str = "") -> Iterator[str]:
    """Yield in words where two trees of plain values differ."""
    if isinstance(kept, dict) and isinstance(now, dict):
        for key in sorted(kept.keys() | now.keys()):
            yield from _differences(kept.get(key), now.get(key), f"{name}.{key}" if name else key)
    elif isinstance(kept, list) and isinstance(now, list) and len(kept) == len(now):
        for k, (one, other) in enumerate(zip(kept, now, strict=True)):
            yield from _differences(one, other, f"{name}[{k}]")
    elif kept != now:
        yield f"{name} was {_short(kept)}, is {_short(now)}"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
