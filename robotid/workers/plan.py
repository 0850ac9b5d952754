"""Who works on the pieces of long logs, what is shown of it, and what is kept if it is cut off."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, Self

from robotid._typing import ProgressCallback, ignore_progress
from robotid.regressor.factors import Reduction, available_cores
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.cluster import ClusterBackend
from robotid.workers.pieces import Piece, Work, Workload, reduce_piece
from robotid.workers.processes import Backend, ProcessBackend, SerialBackend, require_workers

__all__ = ["WorkPlan", "choose_workers", "map_pieces"]

_WORTH_WORKERS = 500_000  # samples from which workers pay their start, about a second each

_log = logging.getLogger(__name__)


@dataclass
class WorkPlan:
    """How work on pieces is done; it never changes a result.

    As a context manager, it keeps its workers for more work until the context ends.
    """

    workers: int | None = 1  # worker processes; None for one per core where the work is long
    scheduler: str | None = None  # address of a Dask scheduler, whose workers are used instead
    resume: bool = False  # whether an interrupted run goes on from its checkpoint
    progress: ProgressCallback | None = None  # gets the work, samples done, in all, their name
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
        """Yield one reduction per piece, in order, as of ``map``; ``join`` gives the whole.

        Args:
            pieces: The pieces.
            checkpoint: As of ``map_pieces``.
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
        """Do the same with every piece by the workers chosen; yields as ``map_pieces``.

        Args:
            work: What to do with a piece.
            pieces: The pieces.
            what: What the work is called.
            checkpoint: As of ``map_pieces``.
        """
        with self._backend(pieces) as backend:
            yield from map_pieces(
                work, pieces, what, backend=backend, progress=self.progress, checkpoint=checkpoint
            )


def map_pieces(
    work: Work,
    pieces: Sequence[Workload],
    what: str,
    *,
    backend: Backend | None = None,
    progress: ProgressCallback | None = None,
    checkpoint: Checkpoint | None = None,
) -> Iterator[Any]:
    """Do the same with every piece; no more results are in memory than are ahead of their turn.

    Args:
        work: What to do with a piece.
        pieces: The pieces.
        what: What the work is called.
        backend: Where it is done; in this process if None.
        progress: Called with (what, samples done, samples in all, "samples").
        checkpoint: Where results are kept, if they are reductions, and, if resumed, taken from.

    Yields:
        One result per piece, in order, with the same bits whatever the backend.

    Raises:
        DataError: If a row cannot be used.
        WorkerError: If a worker ends before its work.
    """
    chosen, report = backend or SerialBackend(), progress or ignore_progress
    kept = frozenset() if checkpoint is None else checkpoint.finished()
    missing = [(k, piece) for k, piece in enumerate(pieces) if k not in kept]
    total = sum(piece.samples for piece in pieces)
    done = total - sum(piece.samples for _, piece in missing)
    _log.info(
        "%s %d pieces, %d of them kept from before, %d samples in all: %s",
        what, len(pieces), len(kept), total, chosen.description,
    )  # fmt: skip
    report(what, done, total, "samples")
    early: dict[int, Any] = {}
    left = len(missing)
    with _resumable(checkpoint), closing(chosen.run(work, missing)) as finished:  # type: ignore[type-var]
        for k in range(len(pieces)):
            while k not in kept and k not in early:
                index, result = next(finished)
                early[index] = result
                if checkpoint is not None:
                    checkpoint.save(index, pieces[index].name, result)
                done += pieces[index].samples
                report(what, done, total, "samples")
                left -= 1
                if not left:
                    next(finished, None)  # there is none: the work ends, and is not broken off
            yield early.pop(k) if checkpoint is None or k not in kept else checkpoint.load(k)


def choose_workers(pieces: Sequence[Workload], workers: int | None = None) -> int:
    """Return how many worker processes to use, never more than there are pieces.

    That is the number asked for; else one per core where the work pays their start, otherwise 1.

    Args:
        pieces: The work.
        workers: What the user asked for, or None.

    Raises:
        SettingsError: If fewer than one is asked for.
    """
    if workers is None:
        is_long = sum(piece.samples for piece in pieces) >= _WORTH_WORKERS
        workers = available_cores() if is_long else 1
    return max(1, min(require_workers(workers), len(pieces)))


@contextmanager
def _resumable(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Note on what stops the work where finished pieces are kept."""
    try:
        yield
    except GeneratorExit:
        raise
    except BaseException as error:
        if checkpoint is not None and checkpoint.folder.is_dir():
            error.add_note(f"finished pieces are kept in {checkpoint.folder}: --resume uses them")
        raise
