"""Who works on the pieces of long logs, what is shown of it, and what is kept if it is cut off."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from robotid.checkpoint import Checkpoint
from robotid.cluster import ClusterBackend
from robotid.exceptions import SettingsError
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
from robotid.task import Work, Workload

__all__ = ["WorkPlan"]


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

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise SettingsError(f"workers is {self.workers}, wanted at least 1")

    @property
    def is_asked_for(self) -> bool:
        """Whether anything but the default was asked for, which short logs have no use of."""
        return self.resume or self.scheduler is not None or (self.workers or 1) > 1

    def backend(self, pieces: Sequence[Workload]) -> Backend:
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

    def map(self, work: Work, pieces: Sequence[Workload], what: str) -> tuple[Any, ...]:
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
