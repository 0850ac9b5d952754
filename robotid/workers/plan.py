"""Who works on the pieces of long logs, what is shown of it, and what is kept if it is cut off."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Self

from robotid._typing import ProgressCallback
from robotid.regressor.factors import Reduction
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.cluster import ClusterBackend
from robotid.workers.pieces import Piece, Work, Workload, reduce_piece
from robotid.workers.processes import (
    Backend,
    ProcessBackend,
    SerialBackend,
    choose_workers,
    map_pieces,
    require_workers,
)

__all__ = ["WorkPlan"]


@dataclass
class WorkPlan:
    """How work on pieces is done; it never changes a result.

    As a context manager, it keeps its workers for more work until the context ends.

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
    _kept: Backend | None = field(default=None, init=False, repr=False)
    _keeps: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.workers is not None:
            require_workers(self.workers)

    @property
    def is_asked_for(self) -> bool:
        """Whether anything but the default was asked for, which short logs have no use of."""
        return self.resume or self.scheduler is not None or (self.workers or 1) > 1

    def __enter__(self) -> Self:
        self._keeps = True
        return self

    def __exit__(self, *_: object) -> None:
        self._keeps = False
        if self._kept is not None:
            self._kept.close()
            self._kept = None

    @contextmanager
    def _backend(self, pieces: Sequence[Workload]) -> Iterator[Backend]:
        """Yield the cluster, worker processes, or this process."""
        backend = self._kept or self._choose(pieces)
        if self._keeps and not isinstance(backend, SerialBackend):
            self._kept = backend
            yield backend
            return
        with backend:
            yield backend

    def _choose(self, pieces: Sequence[Workload]) -> Backend:
        if self.scheduler is not None:
            return ClusterBackend(self.scheduler)
        workers = choose_workers(pieces, self.workers)
        return ProcessBackend(workers) if workers > 1 else SerialBackend()

    def reduce(
        self, pieces: Sequence[Piece], *, checkpoint: Checkpoint | None = None
    ) -> Iterator[Reduction]:
        """Reduce pieces; ``join`` gives the whole.

        Args:
            pieces: The pieces.
            checkpoint: Where finished pieces are kept and, if resumed, taken from.

        Returns:
            One reduction per piece, in order; errors as of ``map``.
        """
        return self.map(reduce_piece, pieces, "reducing", checkpoint=checkpoint)

    def map(
        self,
        work: Work,
        pieces: Sequence[Workload],
        what: str,
        *,
        checkpoint: Checkpoint | None = None,
    ) -> Iterator[Any]:
        """Do the same with every piece; see ``map_pieces``.

        Args:
            work: What to do with a piece.
            pieces: The pieces.
            what: What the work is called.
            checkpoint: Where results are kept, if they are reductions, and taken from.

        Yields:
            One result per piece, in order.

        Raises:
            DataError: If a row cannot be used.
            WorkerError: If a worker ends before its work.
        """
        with self._backend(pieces) as backend:
            yield from map_pieces(
                work, pieces, what, backend=backend, progress=self.progress, checkpoint=checkpoint
            )
