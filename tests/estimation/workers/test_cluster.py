"""A real Dask cluster with worker processes: the same bits, also when workers are killed."""

import os
from types import SimpleNamespace

import pytest
from helpers.piecework import (
    local_cluster,
    marks,
    pieces_in,
    reduce_all,
    reduced,
    same_bits,
    workers_of,
)

from robotid.base.exceptions import DataError, WorkerError
from robotid.dynamics.factors import join
from robotid.estimation.workers import cluster
from robotid.estimation.workers.cluster import ClusterBackend
from robotid.estimation.workers.pieces import Outcome, reduce_piece

distributed = pytest.importorskip("distributed")
# a busy disk is no error of a cluster
pytestmark = pytest.mark.filterwarnings("ignore:Creating scratch directories:UserWarning")


@pytest.fixture(scope="module")
def address():
    """The address of a cluster with two workers, each a process of its own."""
    with local_cluster() as cluster:
        yield cluster.scheduler_address


def test_a_cluster_reduces_to_the_same_bits(address, tmp_path, caplog):
    caplog.set_level("INFO", logger="robotid")
    pieces = pieces_in(tmp_path / "marks", 12, pause=0.02)
    calls = []
    with ClusterBackend(address) as backend:
        found = reduce_all(pieces, backend=backend, progress=lambda *call: calls.append(call))
    assert marks(tmp_path / "marks") == dict.fromkeys(range(12), 1)
    assert len(workers_of(tmp_path / "marks") - {os.getpid()}) == 2
    said = [text for name, _, text in caplog.record_tuples if name == "robotid.piecework"]
    assert sorted(said) == sorted(f"reduced random rows {k}" for k in range(12))
    serial = reduce_all(pieces)
    assert all(map(same_bits, found, serial))
    assert same_bits(join(found), join(serial))
    total = sum(piece.samples for piece in pieces)
    assert (calls[0][1], calls[-1][1]) == (0, total)


def test_a_worker_killed_in_the_middle_loses_nothing_and_counts_nothing_twice(address, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 12, pause=0.05, faults={5: "kill once"}.items())
    with ClusterBackend(address) as backend:
        found = reduce_all(pieces, backend=backend)
    assert len(reduced(pieces[5])) == 2
    assert join(found).samples == sum(piece.samples for piece in pieces)
    serial = reduce_all(pieces_in(tmp_path / "other", 12))
    assert all(map(same_bits, found, serial))
    assert same_bits(join(found), join(serial))


def test_an_error_of_the_data_comes_home_with_piece_and_host(address, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 4, faults={2: "data"}.items())
    with pytest.raises(DataError, match="row 7 is not finite") as caught:
        reduce_all(pieces, backend=ClusterBackend(address))
    assert caught.value.code == "not_finite"
    assert "while processing random rows 2" in caught.value.__notes__


def test_a_worker_that_cannot_read_says_so_with_host_and_path(address, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 2, faults={1: "missing"}.items())
    with pytest.raises(FileNotFoundError, match=r"/no/such/log\.csv") as caught:
        reduce_all(pieces, backend=ClusterBackend(address))
    host = reduced(pieces[1])[0].read_text()
    assert any(f"worker's host {host!r}" in note for note in caught.value.__notes__)
    assert any("under the same path" in note for note in caught.value.__notes__)


def test_workers_with_another_robotid_are_refused(address, tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "__version__", "99.0.0")
    with pytest.raises(WorkerError, match=r"workers must run robotid 99.0.0, but .* has 0\."):
        reduce_all(pieces_in(tmp_path / "marks", 2), backend=ClusterBackend(address))
    assert marks(tmp_path / "marks") == {}


def test_other_versions_of_libraries_are_named_by_worker_and_host(monkeypatch, caplog):
    here = {"robotid": "1.0", "numpy": "2.2", "scipy": "1.15"}
    monkeypatch.setattr(cluster, "code_versions", lambda: here)
    monkeypatch.setattr(cluster, "__version__", "1.0")

    def compare(*workers):
        """Workers are (host, versions), or an error; they are named 0, 1 and so on."""
        caplog.clear()
        own = [w if isinstance(w, Exception) else {"host": w[0], **w[1]} for w in workers]
        client = SimpleNamespace(run=lambda *_, on_error: dict(enumerate(own)))
        cluster._require_same_version("tcp://host:1", client)
        return [(x.levelname, x.getMessage()) for x in caplog.records]

    caplog.set_level("INFO")
    assert compare(("b", here), ("a", here), ("b", here)) == [("INFO", "3 workers on ['a', 'b']")]
    old = {**here, "numpy": "2.1", "scipy": "1.14"}
    assert compare(("b", here), ("a", old)) == [
        ("WARNING", "worker 1 on a has numpy 2.1 (here 2.2), scipy 1.14 (here 1.15): results may "
                    "differ by rounding from a run here"),
        ("INFO", "2 workers on ['a', 'b']"),
    ]  # fmt: skip
    with pytest.raises(
        WorkerError, match=r"workers must run robotid 1.0, but a \(1\) has 0.9. Ins"
    ):
        compare(("a", here), ("a", {**here, "robotid": "0.9"}))
    with pytest.raises(WorkerError, match=r"worker 1 of tcp://host:1 cannot run robotid 1.0 \(No"):
        compare(("a", here), ModuleNotFoundError("No module named 'robotid'"))


def allow_failures(address, number):
    with distributed.Client(address, set_as_default=False) as client:
        client.run_on_scheduler(
            lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", number)
        )


def test_a_piece_that_kills_every_worker_is_given_up_and_its_neighbours_are_done(address, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 5, faults={1: "kill"}.items())
    allow_failures(address, 0)  # its neighbours are suspected, too
    try:
        every = list(enumerate(pieces))
        found = dict(ClusterBackend(address).run(reduce_piece, every, lambda *lost: lost))
    finally:
        allow_failures(address, 3)
    piece, error = found.pop(1)
    assert piece.name == "random rows 1"
    assert isinstance(error, WorkerError)
    serial = reduce_all(pieces_in(tmp_path / "alone", 5))
    assert sorted(found) == [0, 2, 3, 4]
    assert all(same_bits(own, serial[k]) for k, own in found.items())


class Cluster:
    """A client of a cluster, two threads of which take the pieces in turn; some end all workers."""

    loop, status = None, "running"

    def __init__(self, killers):
        self.killers, self.running, self.killed = killers, [], []
        self.submitted, self.released, self.cancelled = [], [], []

    def nthreads(self):
        return {"one": 1, "two": 1}

    def submit(self, run, work, piece, level, version, *, key, pure):
        assert (run, work, pure) == (cluster._run, reduce_piece, False)
        name = key.split("-", 2)[2]
        self.submitted.append((name, [x.name for x in self.running]))
        future = SimpleNamespace(key=key, name=name, piece=piece, result=lambda timeout: of(future))
        future.release = lambda: self.released.append(name)
        self.running.append(future)

        def of(future):
            if future in self.killed:
                raise distributed.KilledWorker("task", None, 0)
            return Outcome(f"{future.piece.name} reduced", ())

        return future

    def cancel(self, futures):
        self.cancelled += [x.name for x in futures]

    def as_completed(self, loop):
        return self

    def add(self, future):
        assert future is self.running[-1]

    def has_ready(self):
        return True

    def __next__(self):
        under_way = self.running[:2]
        if any(x.piece.name in self.killers and x not in self.killed for x in under_way):
            self.killed += under_way
        return self.running.pop(0)


def test_pieces_whose_worker_ended_are_repeated_alone(monkeypatch):
    client, backend = Cluster(killers="b"), ClusterBackend("tcp://host:1")
    monkeypatch.setattr(distributed, "as_completed", client.as_completed)
    pieces = [SimpleNamespace(name=x) for x in "abcdefg"]
    results = backend._collect(client, reduce_piece, list(enumerate(pieces)), lambda *lost: lost)
    found = dict(results)
    assert client.submitted == [
        ("0", []), ("1", ["0"]), ("2", ["0", "1"]), ("3", ["0", "1", "2"]),
        ("0-alone", []), ("1-alone", []),
        ("4", []), ("5", ["4"]), ("6", ["4", "5"]),
    ]  # fmt: skip
    piece, error = found[1]
    assert piece is pieces[1]
    assert str(error).startswith("every worker of the cluster that processed b ended (killed, or")
    assert list(found) == [2, 3, 0, 1, 4, 5, 6]
    assert found[4] == "e reduced"
    assert client.released == ["0", "1", "2", "3", "0-alone", "1-alone", "4", "5", "6"]
    assert client.cancelled == []


def test_a_piece_that_kills_every_worker_is_named(monkeypatch):
    client, pieces = Cluster(killers="b"), [SimpleNamespace(name=x) for x in "abc"]
    monkeypatch.setattr(distributed, "as_completed", client.as_completed)
    results = ClusterBackend("tcp://host:1")._collect(
        client, reduce_piece, list(enumerate(pieces)), None
    )
    with pytest.raises(WorkerError, match="every worker of the cluster that processed b ended"):
        list(results)


@pytest.mark.parametrize(("status", "wanted"), [("running", ["1", "2", "3"]), ("closed", [])])
def test_pieces_under_way_are_cancelled_if_no_more_results_are_wanted(monkeypatch, status, wanted):
    client, pieces = Cluster(killers=""), [SimpleNamespace(name=x) for x in "abcdefg"]
    monkeypatch.setattr(distributed, "as_completed", client.as_completed)
    results = ClusterBackend("tcp://host:1")._collect(
        client, reduce_piece, list(enumerate(pieces)), None
    )
    assert next(results)[0] == 0
    client.status = status
    results.close()
    assert client.cancelled == wanted


def test_a_cluster_whose_workers_have_all_ended_is_not_waited_for(tmp_path):
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as alone:
        backend = ClusterBackend(alone.scheduler_address, patience=0.4)
        pieces = list(enumerate(pieces_in(tmp_path / "marks", 6, pause=0.5)))
        found = backend.run(reduce_piece, pieces)
        next(found)
        alone.scale(0)
        with pytest.raises(
            WorkerError, match=r"cluster \S+ has no workers any more; none has started within 0.4 s"
        ):
            list(found)
    assert backend._client is None


@pytest.mark.parametrize(
    ("notes", "workers", "wanted"),
    [(["on a host"], 1, TimeoutError), ([], 0, WorkerError), ([], 1, None)],
)
def test_a_timeout_of_a_piece_is_its_error_and_one_of_its_result_is_not(notes, workers, wanted):
    waited, late = [], TimeoutError("the file server does not answer")
    for note in notes:
        late.add_note(note)

    def result(timeout):
        waited.append(timeout)
        if len(waited) == 1:
            raise late
        return "result"

    client = SimpleNamespace(nthreads=lambda: dict.fromkeys(range(workers), 1))
    backend, future = ClusterBackend("tcp://host:1", patience=7.5), SimpleNamespace(result=result)
    if wanted is None:
        assert backend._outcome(client, future) == "result"
        assert waited == [7.5, 7.5]
        return
    with pytest.raises(wanted):
        backend._outcome(client, future)
    assert waited == [7.5]


def test_no_scheduler_is_said(tmp_path):
    backend = ClusterBackend("tcp://127.0.0.1:9", patience=0.2)
    with pytest.raises(WorkerError, match=r"no Dask scheduler answers at 'tcp://127.0.0.1:9'"):
        reduce_all(pieces_in(tmp_path / "marks", 2), backend=backend)


def test_the_patience_is_that_for_the_scheduler_and_for_its_first_worker(monkeypatch):
    waited = []

    class Client:
        def __init__(self, address, *, timeout, set_as_default):
            waited.append((address, timeout, set_as_default))

        def wait_for_workers(self, number, timeout):
            waited.append((number, timeout))
            raise TimeoutError

        def close(self):
            waited.append("closed")

    monkeypatch.setattr("distributed.Client", Client)
    with pytest.raises(WorkerError, match="the Dask scheduler tcp://host:1 has no workers"):
        ClusterBackend("tcp://host:1", patience=7.5)._connect()
    assert waited == [("tcp://host:1", 7.5, False), (1, 7.5), "closed"]
