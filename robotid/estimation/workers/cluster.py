"""Processing of pieces by the workers of a Dask cluster."""

import logging
import socket
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any
from uuid import uuid4

from robotid.base.exceptions import MissingDependencyError, WorkerError
from robotid.base.versions import __version__, code_versions
from robotid.estimation.workers.pieces import Lost, Outcome, Work, Workload, run_task
from robotid.estimation.workers.processes import Backend, named

if TYPE_CHECKING:
    from distributed import Client, Future, as_completed

_log = logging.getLogger(__name__)
_POLL = 0.01  # [s] between two looks for a finished piece
_LOOK = 1.0  # [s] between two looks for workers


class ClusterBackend(Backend):
    """Processes pieces on a Dask cluster; results are returned as they are finished.

    Every worker must be able to read the logs under the same path. If a worker ends, another one
    repeats its piece; each result is used once, by the index of its piece. At most two pieces per
    thread of the cluster are submitted. It raises ``WorkerError`` without a cluster, with workers
    of another version of robotid, if every worker that processes a piece ends, and if no worker is
    left.
    """

    def __init__(self, address: str, *, patience: float = 30.0) -> None:
        self.address, self.patience = address, patience
        self._client: Client | None = None

    @property
    def description(self) -> str:
        return f"the Dask cluster {self.address}, one BLAS thread per piece"

    def run(
        self, work: Work, pieces: Sequence[tuple[int, Workload]], lost: Lost | None = None
    ) -> Iterator[tuple[int, Any]]:
        try:
            if self._client is None:
                self._client = self._connect()
                _require_same_version(self.address, self._client)
            yield from self._collect(self._client, work, pieces, lost)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        if self._client is not None:
            self._client.close(timeout=5)
            self._client = None

    def _connect(self) -> "Client":
        try:
            from distributed import Client
        except ImportError as error:
            raise MissingDependencyError("--scheduler", "distributed", "cluster") from error
        try:
            client = Client(self.address, timeout=self.patience, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise WorkerError(
                f"no Dask scheduler answers at {self.address!r} ({error}). Start one with "
                "'dask scheduler' and give its address"
            ) from error
        try:
            client.wait_for_workers(1, timeout=self.patience)
        except TimeoutError as error:
            client.close()
            raise WorkerError(
                f"the Dask scheduler {self.address} has no workers. Start workers with "
                f"'dask worker {self.address}'"
            ) from error
        return client

    def _collect(
        self,
        client: "Client",
        work: Work,
        pieces: Sequence[tuple[int, Workload]],
        lost: Lost | None,
    ) -> Iterator[tuple[int, Any]]:
        from distributed import CancelledError, KilledWorker, as_completed

        waiting, level = iter(pieces), _log.getEffectiveLevel()
        run = uuid4().hex
        running: dict[object, tuple[int, Workload, Future[Any]]] = {}
        suspects, again = set[int](), deque[tuple[int, Workload]]()
        results = as_completed(loop=client.loop)

        def submit(index: int, piece: Workload) -> None:
            key = f"robotid-{run}-{index}" + "-alone" * (index in suspects)
            future = client.submit(_run, work, piece, level, __version__, key=key, pure=False)
            running[future.key] = index, piece, future
            results.add(future)

        try:
            while True:
                most = 2 * max(1, sum(client.nthreads().values()))
                is_alone = bool(again)
                if again and not running:
                    submit(*again.popleft())
                for index, piece in islice(waiting, 0 if is_alone else max(0, most - len(running))):
                    submit(index, piece)
                if not running:
                    return
                future = self._next(client, results)
                index, piece, _ = running[future.key]
                try:
                    with named(piece):
                        outcome = self._outcome(client, future)
                except KilledWorker as error:
                    del running[future.key]
                    future.release()
                    if index not in suspects:  # or its neighbour: each of them is tried alone
                        suspects.add(index)
                        again.append((index, piece))
                        continue
                    failure = WorkerError(
                        f"every worker of the cluster that processed {piece.name} ended (killed, "
                        "or out of memory)"
                    )
                    if lost is None:
                        raise failure from error
                    yield index, lost(piece, failure)
                    continue
                except CancelledError as error:
                    raise WorkerError(
                        f"the connection to the cluster {self.address} ended while it processed "
                        f"{piece.name}"
                    ) from error
                del running[future.key]
                future.release()
                outcome.log()
                yield index, outcome.result
        finally:
            if running and client.status == "running":
                client.cancel([future for _, _, future in running.values()])

    def _next(self, client: "Client", results: "as_completed") -> "Future[Any]":
        """Wait for a finished piece, and for workers if there are none, no longer than patience."""
        looked = seen = time.monotonic()
        while not results.has_ready():
            time.sleep(_POLL)
            now = time.monotonic()
            if now - looked < min(_LOOK, self.patience):
                continue
            looked = now
            if client.nthreads():
                seen = time.monotonic()
            elif now - seen > self.patience:
                raise self._no_workers()
        return next(results)

    def _outcome(self, client: "Client", future: "Future[Any]") -> Outcome:
        """Return what a finished piece gave; if its worker has ended, another one repeats it."""
        while True:
            try:
                found: Outcome = future.result(timeout=self.patience)
                return found
            except TimeoutError as error:
                if getattr(error, "__notes__", ()):  # of the piece itself
                    raise
                if not client.nthreads():
                    raise self._no_workers() from error

    def _no_workers(self) -> WorkerError:
        return WorkerError(
            f"the cluster {self.address} has no workers any more; none has started within "
            f"{self.patience:.3g} s. Start workers with 'dask worker {self.address}' and repeat "
            "the command"
        )


def _run(work: Work, piece: Workload, level: int, wanted: str) -> Outcome:
    """Process a piece on a worker; an error gets a note with the name of the host."""
    if __version__ != wanted:  # a worker that joined after the start
        raise WorkerError(_wrong_version({socket.gethostname(): __version__}, wanted))
    try:
        return run_task(work, piece, level)
    except Exception as error:
        error.add_note(
            f"on the worker's host {socket.gethostname()!r}. Logs must be readable there under the "
            "same path"
        )
        raise


def _about() -> dict[str, str]:
    return {"host": socket.gethostname(), **code_versions()}


def _require_same_version(address: str, client: "Client") -> None:
    """Refuse workers with another version of robotid; warn of other versions of libraries."""
    here = code_versions()
    workers: Mapping[str, Any] = client.run(_about, on_error="return")
    broken = {name: about for name, about in workers.items() if isinstance(about, BaseException)}
    if broken:
        name, error = next(iter(broken.items()))
        raise WorkerError(
            f"the worker {name} of {address} cannot run robotid {__version__} ({error}). Install "
            "the same version there"
        )
    others = {
        f"{about['host']} ({name})": about["robotid"]
        for name, about in workers.items()
        if about["robotid"] != __version__
    }
    if others:
        raise WorkerError(_wrong_version(others, __version__))
    for name, about in workers.items():
        differs = [key for key in here if about[key] != here[key]]
        if differs:
            found = ", ".join(f"{key} {about[key]} (here {here[key]})" for key in differs)
            _log.warning(
                "worker %s on %s has %s: results may differ by rounding from a run here",
                name, about["host"], found,
            )  # fmt: skip
    _log.info("%d workers on %s", len(workers), sorted({a["host"] for a in workers.values()}))


def _wrong_version(found: Mapping[str, str], wanted: str) -> str:
    listed = ", ".join(f"{name} has {other}" for name, other in found.items())
    return f"workers must run robotid {wanted}, but {listed}. Install the same version on all hosts"
