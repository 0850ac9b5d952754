"""Processing of pieces: in this process, in worker processes, or by another backend.

Every piece is processed independently with one BLAS thread, so that its result has the same bits
with any backend, also if a worker process ends and its piece is repeated.
"""

import logging
import os
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Self

from threadpoolctl import threadpool_limits

from robotid.base.exceptions import SettingsError, WorkerError
from robotid.estimation.workers.pieces import Lost, Outcome, Work, Workload, run_task

if TYPE_CHECKING:
    from loky import ProcessPoolExecutor

_log = logging.getLogger(__name__)
_ATTEMPTS = 3  # to process a piece whose worker ends

# The pool's feeder thread may be the last owner of a semaphore. If the process ends between the
# calls that remove and unregister it, the resource tracker warns of a leak.
_FEEDER = "QueueFeederThread"
_PATIENCE = 5.0  # largest time to wait for this thread [s]


class Backend(ABC):
    """Executor of work on pieces; as a context manager it stops its workers at the end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Stop the workers; the next work starts new ones."""

    @property
    @abstractmethod
    def description(self) -> str:
        """Name in messages, such as ``2 worker processes``."""

    @abstractmethod
    def run(
        self, work: Work, pieces: Sequence[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Process pieces; closing the iterator ends the work."""


class SerialBackend(Backend):
    """Processes pieces one after the other in this process."""

    def close(self) -> None: ...

    @property
    def description(self) -> str:
        return "this process"

    def run(
        self, work: Work, pieces: Sequence[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        del lost  # the work ends with this process
        for index, piece in pieces:
            with threadpool_limits(limits=1, user_api="blas"), named(piece):
                result = work(piece, None)
            yield index, result


class ProcessBackend(Backend):
    """Processes pieces in new worker processes, with one BLAS thread each.

    The workers wait for more work until ``close``. An error, or any end of the process that started
    them, stops them immediately.
    """

    def __init__(self, workers: int) -> None:
        self.workers = require_workers(workers)
        self._pool: ProcessPoolExecutor | None = None
        self._other_threads: set[threading.Thread] = set()

    @property
    def description(self) -> str:
        return f"{self.workers} worker processes, one BLAS thread each"

    def run(
        self, work: Work, pieces: Sequence[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        try:
            yield from self._collect(work, pieces, lost)
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
            env={"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"},  # [bytes]; pieces limit the memory
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
        self, work: Work, pieces: Iterable[tuple[int, Workload]], lost: Lost | None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the results of the workers, with at most two submitted pieces per worker.

        If a worker ends, its pool is lost. The pieces under way are repeated in a new one, one
        after the other, so that the piece that ends its worker is known.
        """
        waiting, level = iter(pieces), _log.getEffectiveLevel()
        running: dict[Future[Outcome], tuple[int, Workload]] = {}
        finished: SimpleQueue[Future[Outcome]] = SimpleQueue()
        again, failures = deque[tuple[int, Workload]](), Counter[int]()

        def submit(index: int, piece: Workload) -> None:
            with _interrupts_deferred():
                pool = self._pool or self._start()
                future = pool.submit(run_task, work, piece, level)
                running[future] = index, piece
                future.add_done_callback(finished.put)

        while True:
            try:
                if again and not running:
                    submit(*again[0])
                    again.popleft()
                elif not again and not any(failures[index] for index, _ in running.values()):
                    for index, piece in islice(waiting, 2 * self.workers - len(running)):
                        again.append((index, piece))  # until it is submitted
                        submit(index, piece)
                        again.pop()
                if not running:
                    return
                done = finished.get()
                if done not in running:  # of a pool that was lost
                    continue
                index, piece = running[done]
                with named(piece):
                    outcome = done.result()
            except BrokenProcessPool as error:
                self._end(kill_workers=True)
                for future, (index, piece) in list(running.items()):
                    if future.done() and not future.cancelled() and not future.exception():
                        continue  # its result is used
                    del running[future]
                    failures[index] += 1
                    if failures[index] < _ATTEMPTS:
                        _log.warning("a worker process ended; %s is repeated", piece.name)
                        again.append((index, piece))
                        continue
                    failure = WorkerError(
                        f"a worker process ended during its work (killed, or out of memory), in "
                        f"each of {_ATTEMPTS} attempts. Unfinished piece: {piece.name}"
                    )
                    if lost is None:
                        raise failure from error
                    yield index, lost(piece, failure)
                continue
            del running[done]
            outcome.log()
            yield index, outcome.result


def require_workers(workers: int) -> int:
    """Return a number of workers, which must be at least 1."""
    if workers < 1:
        raise SettingsError(f"workers is {workers}, wanted at least 1")
    return workers


@contextmanager
def named(piece: Workload) -> Iterator[None]:
    """Add a note with the name of the piece to an error."""
    try:
        yield
    except Exception as error:
        error.add_note(f"while processing {piece.name}")
        raise


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Defer Ctrl-C, SIGTERM and SIGHUP until the context ends.

    During the pool's own functions they would leave locks closed. Workers started in the context
    ignore Ctrl-C.
    """
    received: list[int] = []
    names = [name for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in (signal.Signals[n] for n in names)}
    is_ours = threading.current_thread() is threading.main_thread()
    deferred = {
        number: handler for number, handler in before.items() if callable(handler) and is_ours
    }
    can_mask = hasattr(signal, "pthread_sigmask")
    for number in deferred:
        signal.signal(number, lambda number, _: received.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if can_mask else None
    try:
        yield
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in deferred.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


def _start_worker(parent: int) -> None:
    """Prepare a worker: it ignores Ctrl-C, and ends with the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.1)  # [s]
    os._exit(1)
