"""Distribution of work to workers, with progress and checkpoints."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, Self

from robotid.base.typing import ProgressCallback, ignore_progress
from robotid.dynamics.factors import Reduction, available_cores
from robotid.estimation.workers.checkpoint import Checkpoint
from robotid.estimation.workers.cluster import ClusterBackend
from robotid.estimation.workers.pieces import Lost, Piece, Work, Workload, reduce_piece
from robotid.estimation.workers.processes import (
    Backend,
    ProcessBackend,
    SerialBackend,
    require_workers,
)

_WORTH_WORKERS = 500_000  # smallest number of samples for workers; their start takes about 1 s

_log = logging.getLogger(__name__)


@dataclass
class WorkPlan:
    """Distribution of work on pieces; it never changes a result.

    As a context manager, it reuses its workers until the context ends.
    """

    workers: int | None = 1  # worker processes; None: one per core for long work
    scheduler: str | None = None  # address of a Dask scheduler, whose workers are used instead
    resume: bool = False  # whether an interrupted fleet continues from its checkpoint
    progress: ProgressCallback | None = None  # called with work, samples done, total, "samples"
    _reused: Backend | None = field(default=None, init=False, repr=False)
    _reuses: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.workers is not None:
            require_workers(self.workers)

    @property
    def is_asked_for(self) -> bool:
        """Whether settings differ from the defaults; short logs have no use for them."""
        return self.scheduler is not None or (self.workers or 1) > 1

    def __enter__(self) -> Self:
        self._reuses = True
        return self

    def __exit__(self, *_: object) -> None:
        self._reuses = False
        if self._reused is not None:
            self._reused.close()
            self._reused = None

    @contextmanager
    def _backend(self, pieces: Sequence[Workload]) -> Iterator[Backend]:
        """Yield the cluster, worker processes, or this process."""
        backend = self._reused or self._choose(pieces)
        if self._reuses and not isinstance(backend, SerialBackend):
            self._reused = backend
            yield backend
            return
        with backend:
            yield backend

    def _choose(self, pieces: Sequence[Workload]) -> Backend:
        if self.scheduler is not None:
            return ClusterBackend(self.scheduler)
        workers = choose_workers(pieces, self.workers)
        return ProcessBackend(workers) if workers > 1 else SerialBackend()

    def reduce(self, pieces: Sequence[Piece]) -> Iterator[Reduction]:
        """Yield one reduction per piece, in order, as ``map`` does; ``join`` combines them."""
        return self.map(reduce_piece, pieces, "reducing")

    def map(
        self,
        work: Work,
        pieces: Sequence[Workload],
        what: str,
        *,
        checkpoint: Checkpoint | None = None,
        counted: str = "samples",
        lost: Lost | None = None,
    ) -> Iterator[Any]:
        """Process every piece by the chosen workers; yields results as ``map_pieces`` does."""
        with self._backend(pieces) as backend:
            yield from map_pieces(
                work, pieces, what, backend=backend, progress=self.progress,
                checkpoint=checkpoint, counted=counted, lost=lost,
            )  # fmt: skip


def map_pieces(
    work: Work,
    pieces: Sequence[Workload],
    what: str,
    *,
    backend: Backend | None = None,
    progress: ProgressCallback | None = None,
    checkpoint: Checkpoint | None = None,
    counted: str = "samples",
    lost: Lost | None = None,
) -> Iterator[Any]:
    """Process every piece; only results that are ahead of their order are in memory."""
    chosen, report = backend or SerialBackend(), progress or ignore_progress
    stored = frozenset() if checkpoint is None else checkpoint.finished()
    missing = [(k, piece) for k, piece in enumerate(pieces) if k not in stored]
    total = sum(piece.samples for piece in pieces)
    done = total - sum(piece.samples for _, piece in missing)
    _log.info(
        "%s %d pieces, %d of them finished before, %d %s in total: %s",
        what, len(pieces), len(stored), total, counted, chosen.description,
    )  # fmt: skip
    report(what, done, total, counted)
    early: dict[int, Any] = {}
    left = len(missing)
    with _resumable(checkpoint), closing(chosen.run(work, missing, lost)) as finished:  # type: ignore[type-var]
        for k in range(len(pieces)):
            while k not in stored and k not in early:
                index, result = next(finished)
                early[index] = result
                if checkpoint is not None:
                    checkpoint.save(index, pieces[index].name, result)
                done += pieces[index].samples
                report(what, done, total, counted)
                left -= 1
                if not left:
                    next(finished, None)  # ends the iterator, so that the work is not cancelled
            yield early.pop(k) if checkpoint is None or k not in stored else checkpoint.load(k)


def choose_workers(pieces: Sequence[Workload], workers: int | None = None) -> int:
    """Return the number of worker processes, at most that of the pieces.

    It is the given number; else one per core if the work is long, otherwise 1.
    """
    if workers is None:
        is_long = sum(piece.samples for piece in pieces) >= _WORTH_WORKERS
        workers = available_cores() if is_long else 1
    return max(1, min(require_workers(workers), len(pieces)))


@contextmanager
def _resumable(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Add a note with the folder of the checkpoint to an error that stops the work."""
    try:
        yield
    except GeneratorExit:
        raise
    except BaseException as error:
        if checkpoint is not None and checkpoint.folder.is_dir():
            error.add_note(
                f"finished pieces are stored in {checkpoint.folder}. Continue with --resume"
            )
        raise
