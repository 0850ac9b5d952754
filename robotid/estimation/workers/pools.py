"""Workers of pieces: processes of this machine, or those of a Dask cluster.

Every piece is processed independently with one BLAS thread, so that its result has the same bits in
any process, also if a worker ends and its piece is repeated.
"""

import logging
import os
import signal
import socket
import threading
import time
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import contextmanager
from itertools import islice
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.base.exceptions import MissingDependencyError, SettingsError, WorkerError
from robotid.base.findings import listed
from robotid.base.versions import code_versions

if TYPE_CHECKING:
    from distributed import Client

_log = logging.getLogger(__name__)

# The pool's feeder thread may be the last owner of a semaphore. If the process ends between the
# calls that remove and unregister it, the resource tracker warns of a leak.
_FEEDER = "QueueFeederThread"
_PATIENCE = 5.0  # largest time to wait for this thread [s]

_ABSENT = 4.0  # times the patience after which a cluster without workers ends the work
#: Attempts to process a piece whose worker ends: by processes, and by a cluster after its own ones.
_ATTEMPTS = (3, 2)


class Workload(Protocol):
    """A unit of work, such as a piece of a log; can be pickled."""

    @property
    @abstractmethod
    def name(self) -> str:
        """Name in messages, such as ``run3.parquet rows 0-16384``."""

    @property
    @abstractmethod
    def samples(self) -> int:
        """Approximate number of samples, for the progress."""


#: Work on a piece, with the number of threads or None for any; can be pickled.
Work: TypeAlias = Callable[[Any, int | None], Any]

#: Result of a piece that ended its worker in every attempt, from the piece and the error.
Lost: TypeAlias = Callable[[Any, WorkerError], Any]

#: A result, with logger, level and text of the messages that were logged meanwhile.
_Outcome: TypeAlias = tuple[Any, list[tuple[str, int, str]]]


class Pool:
    """Worker processes, or those of a Dask cluster.

    They start with the first work, wait for more until ``close``, and end with the process that
    started them. The workers of a cluster must be able to read the logs under the same path.
    """

    def __init__(
        self, workers: int = 1, scheduler: str | None = None, patience: float = 30.0
    ) -> None:
        self.workers, self.scheduler = require_workers(workers), scheduler
        self.patience = patience  # largest time to wait for a cluster [s]
        self._executor: Executor | None = None
        self._client: Client | None = None

    @property
    def description(self) -> str:
        """Name in messages, such as ``2 worker processes``."""
        if self.scheduler is None:
            return f"{self.workers} worker processes, one BLAS thread each"
        return f"the Dask cluster {self.scheduler}, one BLAS thread per piece"

    def close(self, *, is_urgent: bool = False) -> None:
        """Stop the workers, without waiting if it is urgent; the next work starts new ones."""
        executor, client = self._executor, self._client
        self._executor = self._client = None
        if client is not None:
            client.close(timeout=5)
        elif executor is not None:
            executor.shutdown(wait=True, kill_workers=is_urgent)  # type: ignore[call-arg]
            for thread in threading.enumerate():
                if thread.name == _FEEDER:
                    thread.join(_PATIENCE)

    def run(
        self, work: Work, pieces: Iterable[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Yield the results of pieces with their indices; closing the iterator ends the work."""
        try:
            yield from self._collect(work, iter(pieces), lost)
        except BaseException:
            self.close(is_urgent=True)
            raise

    def _collect(
        self, work: Work, waiting: Iterator[tuple[int, Workload]], lost: Lost | None
    ) -> Iterator[tuple[int, Any]]:
        """Yield results, with at most two submitted pieces per worker.

        If a worker ends, the pieces under way are repeated one after the other, so that the piece
        that ends its worker is known.
        """
        running: dict[Future[_Outcome], tuple[int, Workload]] = {}
        finished = SimpleQueue[Future[_Outcome]]()
        again, failures = deque[tuple[int, Workload]](), Counter[int]()
        while True:
            following: Iterable[tuple[int, Workload]] = ()
            if again:
                following = () if running else [again.popleft()]
            elif not any(failures[index] for index, _ in running.values()):
                following = islice(waiting, max(0, 2 * max(1, self._count()) - len(running)))
            for index, piece in following:
                with _interrupts_deferred():
                    future = self._submit(work, piece)
                    running[future] = index, piece
                    future.add_done_callback(finished.put)
            if not running:
                return
            future = self._next(finished)
            index, piece = running.pop(future)
            try:
                result, messages = future.result()
            except CancelledError as error:
                raise WorkerError(
                    f"the connection ended while {piece.name} was processed"
                ) from error
            except Exception as error:
                if not _is_of_worker(error):
                    raise
                if self.scheduler is None:
                    self.close(is_urgent=True)
                failures[index] += 1
                attempts = _ATTEMPTS[self.scheduler is not None]
                if failures[index] < attempts:
                    _log.warning("a worker ended; %s is repeated", piece.name)
                    again.append((index, piece))
                    continue
                failure = WorkerError(
                    f"a worker ended during its work (killed, or out of memory), in each of "
                    f"{attempts} attempts. Unfinished piece: {piece.name}"
                )
                if lost is None:
                    raise failure from error
                result, messages = lost(piece, failure), []
            for name, level, text in messages:
                logging.getLogger(name).log(level, "%s", text)
            yield index, result

    def _next(self, finished: "SimpleQueue[Future[_Outcome]]") -> "Future[_Outcome]":
        """Wait for a finished piece, while there are workers."""
        while True:
            try:
                return finished.get(timeout=_ABSENT * self.patience)
            except Empty:
                if not self._count():
                    raise WorkerError(
                        f"the cluster {self.scheduler} has no workers any more. Start workers with "
                        f"'dask worker {self.scheduler}' and repeat the command"
                    ) from None

    def _count(self) -> int:
        """Return the number of workers."""
        self._started()
        return self.workers if self._client is None else sum(self._client.nthreads().values())

    def _submit(self, work: Work, piece: Workload) -> "Future[_Outcome]":
        level = _log.getEffectiveLevel()
        try:
            return self._started().submit(run_task, work, piece, level)
        except BrokenExecutor:  # a worker ended while it waited for work
            self.close(is_urgent=True)
            return self._started().submit(run_task, work, piece, level)

    def _started(self) -> Executor:
        """Return the executor, which is started at its first use."""
        if self._executor is not None:
            return self._executor
        if self.scheduler is not None:
            self._client = _connect(self.scheduler, self.patience)
            self._executor = self._client.get_executor(pure=False)
            return self._executor
        from loky import ProcessPoolExecutor

        self._executor = ProcessPoolExecutor(
            self.workers,
            initializer=_start_worker,
            initargs=(os.getpid(),),
            env={"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"},  # [bytes]; pieces limit the memory
        )
        return self._executor


def require_workers(workers: int) -> int:
    """Return a number of workers, which must be at least 1."""
    if workers < 1:
        raise SettingsError(f"workers is {workers}, wanted at least 1")
    return workers


def _connect(address: str, patience: float) -> "Client":
    """Return a client of a cluster with workers, all of this version of robotid."""
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingDependencyError("--scheduler", "distributed", "cluster") from error
    client = None
    try:
        client = Client(address, timeout=patience, set_as_default=False)
        client.wait_for_workers(1, timeout=patience)
    except (OSError, TimeoutError, ValueError) as error:
        if client is not None:
            client.close()
        raise WorkerError(
            f"no Dask scheduler with workers answers at {address!r} ({error}). Start them with "
            f"'dask scheduler' and 'dask worker {address}'"
        ) from error
    here = code_versions()
    for worker, versions in client.run(code_versions).items():
        differs = sorted(key for key, version in here.items() if versions[key] != version)
        if "robotid" in differs:
            client.close()
            raise WorkerError(
                f"workers must run robotid {here['robotid']}, but {worker} has "
                f"{versions['robotid']}. Install the same version on all hosts"
            )
        if differs:
            text = "worker %s has other versions of %s: results may differ by rounding"
            _log.warning(text, worker, listed(differs))
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


def _is_of_worker(error: Exception) -> bool:
    """Return whether an error says that a worker ended."""
    return isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"  # Dask's


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
