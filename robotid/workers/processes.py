"""Work on pieces: in this process, in worker processes, or by another backend.

Every piece is worked on by itself with one BLAS thread, so what it comes down to has the same bits
wherever that is done; results come back in the order of the pieces.
"""

import logging
import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from itertools import islice
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Self

from threadpoolctl import threadpool_limits

from robotid._typing import ProgressCallback, ignore_progress
from robotid.exceptions import SettingsError, WorkerError
from robotid.regressor.factors import available_cores
from robotid.workers.checkpoint import Checkpoint
from robotid.workers.pieces import Piece, Reduction
from robotid.workers.task import Outcome, Work, Workload, reduce_piece, run_task

__all__ = [
    "Backend",
    "ProcessBackend",
    "SerialBackend",
    "choose_workers",
    "map_pieces",
    "reduce_pieces",
]

_WORTH_WORKERS = 500_000  # samples from which workers pay their start, about a second each

_log = logging.getLogger(__name__)


class Backend(ABC):
    """Where pieces are worked on; a context manager, which lets its workers go at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Let the workers go; the next work starts them anew."""

    @property
    @abstractmethod
    def description(self) -> str:
        """What messages call it, as ``2 worker processes``."""

    @abstractmethod
    def run(self, work: Work, pieces: Sequence[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
        """Do the same with each of some pieces; closing the iterator ends it.

        Args:
            work: What to do with a piece.
            pieces: Index and piece.

        Yields:
            Index and result of each piece once, in any order.

        Raises:
            DataError: If a row cannot be used.
            WorkerError: If a worker ends before its work.
        """


class SerialBackend(Backend):
    """Works on pieces one after the other in this process."""

    def close(self) -> None:
        """Do nothing; there are no workers."""

    @property
    def description(self) -> str:
        """What messages call it."""
        return "this process"

    def run(self, work: Work, pieces: Sequence[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
        """Work on pieces; see ``Backend.run``.

        Args:
            work: What to do with a piece.
            pieces: Index and piece.

        Yields:
            Index and result of each piece, in order.
        """
        for index, piece in pieces:
            with threadpool_limits(limits=1, user_api="blas"), _named(piece):
                result = work(piece, None)
            yield index, result


class ProcessBackend(Backend):
    """Works on pieces in worker processes, started anew, with one BLAS thread each.

    The workers wait for more work until ``close``; an error or the end of the process that
    started them, however it ends, ends them at once.

    Args:
        workers: Number of processes, at least 1.

    Raises:
        SettingsError: If it is less.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise SettingsError(f"workers is {workers}, wanted at least 1")
        self.workers = workers
        self._pool: ProcessPoolExecutor | None = None
        self._lifeline: tuple[Connection, Connection] | None = None

    @property
    def description(self) -> str:
        """What messages call it."""
        return f"{self.workers} worker processes, one BLAS thread each"

    def run(self, work: Work, pieces: Sequence[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
        """Work on pieces, at most two per worker under way; see ``Backend.run``.

        Args:
            work: What to do with a piece.
            pieces: Index and piece.

        Yields:
            Index and result of each piece, as they come.

        Raises:
            DataError: If a row cannot be used.
            WorkerError: If a worker ends before its work.
        """
        try:
            yield from _collect(self._pool or self._start(), work, pieces, 2 * self.workers)
        except BaseException:
            self._cut_lifeline()  # ends the workers in the middle of their work
            if self._pool is not None:
                # a worker may end in the middle of a result: without this end of the pipe, the pool
                # would wait for the rest for ever
                results: Any = self._pool
                results._result_queue._writer.close()
            self.close()
            raise

    def close(self) -> None:
        """Let the workers go; the next work starts them anew."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
        self._cut_lifeline()

    def _start(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        self._lifeline = context.Pipe(duplex=False)
        lifeline, _ = self._lifeline
        self._pool = ProcessPoolExecutor(self.workers, context, _start_worker, (lifeline,))
        return self._pool

    def _cut_lifeline(self) -> None:
        for end in reversed(self._lifeline or ()):
            end.close()
        self._lifeline = None


def reduce_pieces(
    pieces: Sequence[Piece],
    *,
    backend: Backend | None = None,
    checkpoint: Checkpoint | None = None,
    progress: ProgressCallback | None = None,
) -> Iterator[Reduction]:
    """Reduce pieces; the result has the same bits whatever the backend.

    Args:
        pieces: The pieces.
        backend: Where they are reduced; in this process if None.
        checkpoint: Where finished pieces are kept and, if resumed, taken from.
        progress: Called with ("reducing", samples done, samples in all, "samples").

    Yields:
        One reduction per piece, in order; ``join`` gives the whole.

    Raises:
        DataError: If a row cannot be used.
        WorkerError: If a worker ends before its work.
    """
    try:
        yield from map_pieces(
            reduce_piece,
            pieces,
            "reducing",
            backend=backend,
            progress=progress,
            checkpoint=checkpoint,
        )
    except GeneratorExit:
        raise
    except BaseException as error:
        if checkpoint is not None:
            error.add_note(f"finished pieces are kept in {checkpoint.folder}: --resume uses them")
        raise


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
        checkpoint: Where results are kept, if they are reductions, and taken from.

    Yields:
        One result per piece, in order.

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
    with closing(chosen.run(work, missing)) as finished:  # type: ignore[type-var]
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
    """Return how many worker processes to use.

    Args:
        pieces: The work.
        workers: What the user asked for, or None.

    Returns:
        The number asked for; else one per core where the work pays their start, otherwise 1; never
        more than there are pieces.

    Raises:
        SettingsError: If fewer than one is asked for.
    """
    if workers is not None and workers < 1:
        raise SettingsError(f"workers is {workers}, wanted at least 1")
    if workers is None:
        is_long = sum(piece.samples for piece in pieces) >= _WORTH_WORKERS
        workers = available_cores() if is_long else 1
    return max(1, min(workers, len(pieces)))


def _collect(
    pool: ProcessPoolExecutor, work: Work, pieces: Iterable[tuple[int, Workload]], most: int
) -> Iterator[tuple[int, Any]]:
    """Yield what the workers return, with at most so many pieces under way."""
    waiting, level = iter(pieces), _log.getEffectiveLevel()
    running: dict[Future[Outcome], tuple[int, Workload]] = {}
    finished: SimpleQueue[Future[Outcome] | None] = SimpleQueue()
    try:
        with _interrupts_to(lambda: finished.put(None)) as interrupt:
            while True:
                for index, piece in islice(waiting, most - len(running)):
                    with _unheard_interrupts():
                        future = pool.submit(run_task, work, piece, level)
                    running[future] = index, piece
                    future.add_done_callback(finished.put)
                if not running:
                    return
                done = finished.get()
                if done is None:
                    interrupt()
                    continue
                index, piece = running[done]
                with _named(piece):
                    outcome = done.result()
                del running[done]
                outcome.log()
                yield index, outcome.result
    except BrokenProcessPool as error:
        names = [piece.name for _, piece in running.values()]
        raise WorkerError(
            "a worker process ended in the middle of its work (killed from outside, short of "
            f"memory, or a script without the guard if __name__ == '__main__'); under way: {names}"
        ) from error


@contextmanager
def _named(piece: Workload) -> Iterator[None]:
    """Note on an error which piece it met."""
    try:
        yield
    except BrokenProcessPool:
        raise
    except Exception as error:
        error.add_note(f"while working on {piece.name}")
        raise


@contextmanager
def _interrupts_to(notify: Callable[[], None]) -> Iterator[Callable[[], None]]:
    """Let Ctrl-C call ``notify`` and nothing else, as long as the context lasts.

    In the middle of the pool's own functions it would leave locks that nobody opens. Yields what
    does what Ctrl-C was to do, to be called where that harms nothing.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield lambda: None
        return
    signal.signal(signal.SIGINT, lambda *_: notify())
    try:
        yield lambda: before(signal.SIGINT, None)
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _unheard_interrupts() -> Iterator[None]:
    """Hold Ctrl-C back; workers started meanwhile never see it: they end with this process."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(lifeline: Connection) -> None:
    """Set a worker up: one BLAS thread, deaf to Ctrl-C, gone when the lifeline is cut."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    try:
        lifeline.recv()
    finally:
        os._exit(1)
