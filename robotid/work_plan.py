"""Who works on the pieces of long logs, what is shown of it, and what is kept if it is cut off."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robotid.checkpoint import Checkpoint
from robotid.cluster import ClusterBackend
from robotid.pieces import Piece, Reduction
from robotid.progress import ProgressCallback
from robotid.reduction import (
    Backend,
    ProcessBackend,
    SerialBackend,
    choose_workers,
    map_pieces,
    reduce_pieces,
)
from robotid.task import Work

__all__ = ["WorkPlan", "file_identity"]


@dataclass(frozen=True)
class WorkPlan:
    """How work on pieces is done; it never changes a result.

    Attributes:
        workers: Worker processes; None for one per core where the work is long.
        scheduler: Address of a Dask scheduler, whose workers are used instead.
        resume: Whether an interrupted run goes on from its checkpoint.
        progress: Called with the work, samples done, samples in all and their name.
    """

    workers: int | None = 1
    scheduler: str | None = None
    resume: bool = False
    progress: ProgressCallback | None = None

    @property
    def is_asked_for(self) -> bool:
        """Whether anything but the default was asked for, which short logs have no use of."""
        return self.resume or self.scheduler is not None or (self.workers or 1) > 1

    def backend(self, pieces: Sequence[Piece]) -> Backend:
        """Return what works on pieces.

        Args:
            pieces: The pieces.

        Returns:
            The cluster, worker processes, or this process.

        Raises:
            SettingsError: If fewer than one worker is asked for.
        """
        if self.scheduler is not None:
            return ClusterBackend(self.scheduler)
        workers = choose_workers(pieces, self.workers)
        return ProcessBackend(workers) if workers > 1 else SerialBackend()

    def reduce(
        self, pieces: Sequence[Piece], *, checkpoint: Checkpoint | None = None
    ) -> tuple[Reduction, ...]:
        """Reduce pieces; see :func:`robotid.reduction.reduce_pieces`.

        Args:
            pieces: The pieces.
            checkpoint: Where finished pieces are kept.

        Returns:
            One reduction per piece, in order.

        Raises:
            DataError: If a row cannot be used.
            WorkerError: If a worker ends before its work.
        """
        return reduce_pieces(
            pieces, backend=self.backend(pieces), checkpoint=checkpoint, progress=self.progress
        )

    def map(self, work: Work, pieces: Sequence[Piece], what: str) -> tuple[Any, ...]:
        """Do the same with every piece; see :func:`robotid.reduction.map_pieces`.

        Args:
            work: What to do with a piece.
            pieces: The pieces.
            what: What the work is called.

        Returns:
            One result per piece, in order.

        Raises:
            DataError: If a row cannot be used.
            WorkerError: If a worker ends before its work.
        """
        return map_pieces(work, pieces, what, backend=self.backend(pieces), progress=self.progress)


def file_identity(path: str | Path) -> dict[str, Any]:
    """Return what tells a file, or a folder of files, from others and from what it was before.

    Args:
        path: The file, or a folder as of a bag.

    Returns:
        Paths, sizes [bytes] and times of change [ns].

    Raises:
        OSError: If it does not exist.
    """
    whole = Path(path).resolve()
    files = sorted(p for p in whole.rglob("*") if p.is_file()) if whole.is_dir() else [whole]
    return {
        str(file): {"size": (about := file.stat()).st_size, "changed": about.st_mtime_ns}
        for file in files
    }
