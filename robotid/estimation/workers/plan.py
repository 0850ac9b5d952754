"""Distribution of work to workers, with progress."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Self

from robotid.base.typing import ProgressCallback, ignore_progress
from robotid.dynamics.factors import available_cores
from robotid.estimation.workers.pools import (
    Lost,
    Pool,
    Work,
    Workload,
    noted,
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
    progress: ProgressCallback | None = None  # called with work, samples done, total, "samples"
    _pool: Pool | None = field(default=None, init=False, repr=False)
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
        self._close()

    def map(self, work: Work, pieces: Sequence[Workload], what: str) -> Iterator[Any]:
        """Process every piece and yield the results in order, in memory only if they are early."""
        early: dict[int, Any] = {}
        following = 0
        for index, result in self.as_finished(work, pieces, what):
            early[index] = result
            while following in early:
                yield early.pop(following)
                following += 1

    def as_finished(
        self,
        work: Work,
        pieces: Sequence[Workload],
        what: str,
        *,
        counted: str = "samples",
        lost: Lost | None = None,
    ) -> Iterator[tuple[int, Any]]:
        """Process every piece; yield index and result of each as it is finished."""
        report, done = self.progress or ignore_progress, 0
        total = sum(piece.samples for piece in pieces)
        pool = self._pool or self._choose(pieces)
        how = "this process" if pool is None else pool.description
        _log.info("%s %d pieces, %d %s in total: %s", what, len(pieces), total, counted, how)
        report(what, done, total, counted)
        every = enumerate(pieces)
        results = _here(work, every) if pool is None else pool.run(work, every, lost)
        self._pool = pool
        try:
            with closing(results):  # type: ignore[type-var]
                for left in reversed(range(len(pieces))):
                    index, result = next(results)
                    if not left:
                        next(results, None)  # ends the iterator: closing it would stop the workers
                    done += pieces[index].samples
                    report(what, done, total, counted)
                    yield index, result
        finally:
            if not self._reuses:
                self._close()

    def _choose(self, pieces: Sequence[Workload]) -> Pool | None:
        """Return the cluster, worker processes, or None for this process."""
        if self.scheduler is not None:
            return Pool(scheduler=self.scheduler)
        workers = choose_workers(pieces, self.workers)
        return Pool(workers) if workers > 1 else None

    def _close(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.close()


def choose_workers(pieces: Sequence[Workload], workers: int | None = None) -> int:
    """Return the number of worker processes, at most that of the pieces.

    It is the given number; else one per core if the work is long, otherwise 1.
    """
    if workers is None:
        is_long = sum(piece.samples for piece in pieces) >= _WORTH_WORKERS
        workers = available_cores() if is_long else 1
    return max(1, min(require_workers(workers), len(pieces)))


def _here(work: Work, pieces: Iterator[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
    """Process the pieces one after the other in this process."""
    for index, piece in pieces:
        with noted(f"while processing {piece.name}"):
            result = work(piece, None)
        yield index, result
