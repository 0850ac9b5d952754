"""Work on pieces: in this process, in worker processes, or by another backend.

Every piece is worked on by itself with one BLAS thread, so what it comes down to has the same bits
wherever that is done.
"""

import logging
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Self

from threadpoolctl import threadpool_limits

from robotid.exceptions import SettingsError, WorkerError
from robotid.workers.pieces import Outcome, Work, Workload, run_task

if TYPE_CHECKING:
    from loky import ProcessPoolExecutor

__all__ = ["Backend", "ProcessBackend", "SerialBackend", "named", "require_workers"]

_log = logging.getLogger(__name__)

# The pool's thread that feeds its workers may be the last to hold a semaphore. Where the process
# ends between its two calls, remove and unregister, the tracker of resources tells of a leak.
_FEEDER = "QueueFeederThread"
_PATIENCE = 5.0  # [s] that it is waited for


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

    def close(self) -> None: ...

    @property
    def description(self) -> str:
        return "this process"

    def run(self, work: Work, pieces: Sequence[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
        for index, piece in pieces:
            with threadpool_limits(limits=1, user_api="blas"), named(piece):
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
        self.workers = require_workers(workers)
        self._pool: ProcessPoolExecutor | None = None
        self._other_threads: set[threading.Thread] = set()

    @property
    def description(self) -> str:
        return f"{self.workers} worker processes, one BLAS thread each"

    def run(self, work: Work, pieces: Sequence[tuple[int, Workload]]) -> Iterator[tuple[int, Any]]:
        try:
            yield from self._collect(work, pieces)
        except BaseException:
            self._end(kill_workers=True)
            raise

    def close(self) -> None:
        self._end(kill_workers=False)

    def _start(self) -> "ProcessPoolExecutor":
        from loky import ProcessPoolExecutor

        self._other_threads = set(threading.enumerate())
        self._pool = ProcessPoolExecutor(
            self.workers,
            initializer=_start_worker,
            initargs=(os.getpid(),),
            env={"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"},  # [bytes]: pieces bound the memory
        )
        return self._pool

    def _end(self, *, kill_workers: bool) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=True, kill_workers=kill_workers)
            for thread in set(threading.enumerate()) - self._other_threads:
                if thread.name == _FEEDER:
                    thread.join(_PATIENCE)

    def _collect(
        self, work: Work, pieces: Iterable[tuple[int, Workload]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield what the workers return, with at most two pieces per worker under way."""
        waiting, level = iter(pieces), _log.getEffectiveLevel()
        running: dict[Future[Outcome], tuple[int, Workload]] = {}
        finished: SimpleQueue[Future[Outcome]] = SimpleQueue()
        try:
            while True:
                for index, piece in islice(waiting, 2 * self.workers - len(running)):
                    with _interrupts_held():
                        pool = self._pool or self._start()
                        future = pool.submit(run_task, work, piece, level)
                        running[future] = index, piece
                        future.add_done_callback(finished.put)
                if not running:
                    return
                done = finished.get()
                index, piece = running[done]
                with named(piece):
                    outcome = done.result()
                del running[done]
                outcome.log()
                yield index, outcome.result
        except BrokenProcessPool as error:
            names = [piece.name for _, piece in running.values()]
            raise WorkerError(
                "a worker process ended in the middle of its work (killed from outside, or short "
                f"of memory); under way: {names}"
            ) from error


def require_workers(workers: int) -> int:
    """Return a number of workers, which must be at least 1.

    Args:
        workers: The number.

    Raises:
        SettingsError: If it is less.
    """
    if workers < 1:
        raise SettingsError(f"workers is {workers}, wanted at least 1")
    return workers


@contextmanager
def named(piece: Workload) -> Iterator[None]:
    """Note on an error which piece it met.

    Args:
        piece: The piece that is worked on.
    """
    try:
        yield
    except Exception as error:
        error.add_note(f"while working on {piece.name}")
        raise


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back until the context ends.

    In the middle of the pool's own functions they would leave locks that nobody opens. Workers
    started meanwhile never hear Ctrl-C.
    """
    heard: list[int] = []
    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in (signal.Signals[n] for n in names)}
    is_ours = threading.current_thread() is threading.main_thread()
    held = {number: handler for number, handler in before.items() if callable(handler) and is_ours}
    can_mask = hasattr(signal, "pthread_sigmask")
    for number in held:
        signal.signal(number, lambda number, _: heard.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if can_mask else None
    try:
        yield
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in held.items():
            signal.signal(number, handler)
        if heard:
            signal.raise_signal(heard[0])


def _start_worker(parent: int) -> None:
    """Set a worker up: deaf to Ctrl-C, gone when the process that started it is."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.1)  # [s]
    os._exit(1)
