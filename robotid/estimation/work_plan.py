"""Distribution of work on pieces to processes of this machine, or those of a Dask cluster.

Every piece has one BLAS thread, so that its result has the same bits in any process.
"""

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    wait,
)
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.base.cores import available_cores
from robotid.base.exceptions import MissingDependencyError, SettingsError, WorkerError
from robotid.base.typing import ProgressCallback, ignore_progress
from robotid.base.versions import code_versions

if TYPE_CHECKING:
    from distributed import Client

_log = logging.getLogger(__name__)

_WORTH_WORKERS = 500_000  # smallest number of samples for workers; their start takes about 1 s
#: Attempts to process a piece whose worker ends: by processes, and by a cluster after its own ones.
_ATTEMPTS = (3, 2)
# The pool's feeder thread may be the last owner of a semaphore. If the process ends between the
# calls that remove and unregister it, the resource tracker warns of a leak.
_FEEDER = "QueueFeederThread"
_PATIENCE = 5.0  # largest time to wait for this thread [s]
_ANSWER = 30.0  # ... for a worker of a cluster [s]


class Workload(Protocol):
    """A unit of work, such as a piece of a log; can be pickled."""

    @property
    def name(self) -> str:
        """Name in messages, such as ``run3.parquet rows 0-16384``."""

    @property
    def samples(self) -> int:
        """Approximate number of samples, for the progress."""


#: Work on a piece, with the number of threads or None for any; can be pickled.
Work: TypeAlias = Callable[[Any, int | None], Any]

#: Result of a piece that ended its worker in every attempt, from the piece and the error.
Lost: TypeAlias = Callable[[Any, WorkerError], Any]

#: A result, with logger, level and text of the messages that were logged meanwhile.
_Outcome: TypeAlias = tuple[Any, list[tuple[str, int, str]]]


@dataclass
class WorkPlan:
    """Distribution of work on pieces: in this process, worker processes or a Dask cluster.

    It never changes a result. As a context manager, it reuses its workers until the context ends.
    The workers of a cluster must be able to read the logs under the same path.
    """

    workers: int | None = 1  # worker processes; None: one per core for long work
    scheduler: str | None = None  # address of a Dask scheduler, whose workers are used instead
    progress: ProgressCallback | None = None  # called with work, samples done, total, "samples"
    _size: int = field(default=1, init=False, repr=False)  # number of worker processes
    _executor: Executor | None = field(default=None, init=False, repr=False)
    _client: "Client | None" = field(default=None, init=False, repr=False)
    _older: set[threading.Thread] = field(default_factory=set, init=False, repr=False)
    _reuses: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.workers is not None:
            self._size = require_workers(self.workers)

    def __enter__(self) -> Self:
        self._reuses = True
        return self

    def __exit__(self, *_: object) -> None:
        self._reuses = False
        self.close()

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
        self, work: Work, pieces: Sequence[Workload], what: str, *, counted: str = "samples",
        lost: Lost | None = None,
    ) -> Iterator[tuple[int, Any]]:  # fmt: skip
        """Process every piece; yield index and result of each as it is finished."""
        report, done = self.progress or ignore_progress, 0
        total = sum(piece.samples for piece in pieces)
        if self._executor is None:
            self._size = choose_workers(pieces, self.workers)
        is_here = self.scheduler is None and self._size == 1
        how = f"{self._size} worker processes, one BLAS thread each"
        if self.scheduler is not None:
            how = f"the Dask cluster {self.scheduler}, one BLAS thread per piece"
        how = "this process" if is_here else how
        _log.info("%s %d pieces, %d %s in total: %s", what, len(pieces), total, counted, how)
        report(what, done, total, counted)
        every = enumerate(pieces)
        results = _here(work, every) if is_here else self.run(work, every, lost)
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
                self.close()

    def close(self, *, is_urgent: bool = False) -> None:
        """Stop the workers, without waiting if it is urgent; the next work starts new ones."""
        executor, client = self._executor, self._client
        self._executor = self._client = None
        if client is not None:
            client.close(timeout=5)
        elif executor is not None:
            executor.shutdown(wait=True, kill_workers=is_urgent)  # type: ignore[call-arg]
            for thread in {*threading.enumerate()} - self._older:
                if thread.name == _FEEDER:
                    thread.join(_PATIENCE)

    def run(
        self, work: Work, pieces: Iterable[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the results of pieces with their indices; closing the iterator ends the work.

        At most two pieces per worker are submitted. If a worker ends, the pieces under way are
        repeated one by one, so that the piece that ends its worker is known.
        """
        waiting = iter(pieces)
        running: dict[Future[_Outcome], tuple[int, Workload]] = {}
        try:
            while True:
                free = max(0, 2 * max(1, self._count()) - len(running))
                for index, piece in islice(waiting, free):
                    with _interrupts_deferred():
                        running[self._submit(work, piece)] = index, piece
                if not running:
                    return
                future = self._finished(running)
                index, piece = running.pop(future)
                result, messages = self._outcome(future, work, piece, lost)
                for name, level, text in messages:
                    logging.getLogger(name).log(level, "%s", text)
                yield index, result
        except BaseException:
            self.close(is_urgent=True)
            raise

    def _outcome(
        self, future: Future[_Outcome], work: Work, piece: Workload, lost: Lost | None
    ) -> _Outcome:
        """Return a finished piece, repeated alone while its worker ends, or what replaces it."""
        attempts = _ATTEMPTS[self.scheduler is not None]
        for left in reversed(range(attempts)):
            try:
                return future.result()
            except CancelledError as again:
                raise WorkerError(
                    f"the connection ended while {piece.name} was processed"
                ) from again
            except Exception as again:
                if not (
                    isinstance(again, BrokenExecutor) or type(again).__name__ == "KilledWorker"
                ):
                    raise  # not the end of a worker, of processes or of Dask
                error = again
            if left:
                _log.warning("a worker ended; %s is repeated", piece.name)
                future = self._finished([self._submit(work, piece)])
        failure = WorkerError(
            f"a worker ended during its work (killed, or out of memory), in each of {attempts} "
            f"attempts. Unfinished piece: {piece.name}"
        )
        if lost is None:
            raise failure from error
        return lost(piece, failure), []

    def _finished(self, running: Iterable[Future[_Outcome]]) -> Future[_Outcome]:
        """Wait for a finished piece, while there are workers."""
        while True:
            finished = wait(running, _ANSWER, FIRST_COMPLETED).done
            if finished:
                return finished.pop()
            if not self._count():
                raise WorkerError(
                    f"the cluster {self.scheduler} has no workers any more. Start workers with "
                    f"'dask worker {self.scheduler}' and repeat the command"
                )

    def _count(self) -> int:
        """Return the number of workers."""
        self._started()
        return self._size if self._client is None else sum(self._client.nthreads().values())

    def _submit(self, work: Work, piece: Workload) -> "Future[_Outcome]":
        level = _log.getEffectiveLevel()
        try:
            return self._started().submit(run_task, work, piece, level)
        except BrokenExecutor:  # a worker ended; the feeder of its pool may not end
            self._older = {*threading.enumerate()}
            self.close(is_urgent=True)
            return self._started().submit(run_task, work, piece, level)

    def _started(self) -> Executor:
        """Return the executor, which is started at its first use."""
        if self._executor is not None:
            return self._executor
        if self.scheduler is not None:
            self._client = _connect(self.scheduler)
            self._executor = self._client.get_executor(pure=False)
            return self._executor
        from loky import ProcessPoolExecutor

        self._older = {*threading.enumerate()}
        self._executor = ProcessPoolExecutor(
            self._size,
            initializer=_start_worker,
            initargs=(os.getpid(),),
            env={"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"},  # [bytes]; pieces limit the memory
        )
        return self._executor


def require_workers(workers: int) -> int:
    """Return a number of workers, which must be at least 1."""
    if workers < 1:
        raise SettingsError(f"workers is {workers}, expected at least 1")
    return workers


def _connect(address: str) -> "Client":
    """Return a client of a cluster with workers, all of this version of robotid."""
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingDependencyError("--scheduler", "distributed", "cluster") from error
    client = None
    try:
        client = Client(address, timeout=_ANSWER, set_as_default=False)
        client.wait_for_workers(1, timeout=_ANSWER)
    except (OSError, TimeoutError, ValueError) as error:
        if client is not None:
            client.close()
        raise WorkerError(
            f"no Dask scheduler with workers answers at {address!r} ({error}). Start them with "
            f"'dask scheduler' and 'dask worker {address}'"
        ) from error
    here = code_versions()["robotid"]
    for worker, versions in client.run(code_versions).items():
        if versions["robotid"] != here:
            client.close()
            raise WorkerError(
                f"workers must run robotid {here}, but {worker} has {versions['robotid']}. Install "
                "the same version on all hosts"
            )
    return client


class _Recorder(logging.Handler):
    """Stores records as plain text, which can be pickled."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.messages: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append((record.name, record.levelno, record.getMessage()))


def run_task(work: Work, piece: Workload, level: int) -> _Outcome:
    """Process a piece with one thread; return the result and the logged messages."""
    logger, recorder = logging.getLogger("robotid"), _Recorder(level)
    before = logger.level
    logger.addHandler(recorder)
    logger.setLevel(level)
    try:
        with noted(f"while processing {piece.name} on host {socket.gethostname()!r}"):
            return work(piece, 1), recorder.messages
    finally:
        logger.removeHandler(recorder)
        logger.setLevel(before)


@contextmanager
def noted(note: str) -> Iterator[None]:
    """Limit BLAS to one thread, and add a note to an error."""
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    except Exception as error:
        error.add_note(note)
        raise


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Defer signals until the context ends: in the pool's functions they leave locks closed."""
    received: list[int] = []
    handlers: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None and callable(signal.getsignal(number)):
                handlers[number] = signal.signal(number, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
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


def choose_workers(pieces: Sequence[Workload], workers: int | None = None) -> int:
    """Return the number of worker processes: as given, else the cores for long work."""
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
