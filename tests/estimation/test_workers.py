"""Who works on pieces never shows in the result; what goes wrong is said by name."""

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.paths import ROOT
from helpers.piecework import marks, pieces_in, reduce_piece, workers_of

from robotid.base.cores import available_cores
from robotid.base.exceptions import (
    DataError,
    MissingDependencyError,
    NotConvergedError,
    RankDeficientError,
    SettingsError,
    WorkerError,
)
from robotid.estimation.work_plan import WorkPlan, choose_workers

# a busy disk is no error of a cluster
pytestmark = pytest.mark.filterwarnings("ignore:Creating scratch directories:UserWarning")


@pytest.fixture(scope="module")
def scheduler():
    """The address of a cluster with two workers, each a process of its own."""
    distributed = pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", silence_logs=50
        ) as cluster,
    ):
        yield cluster.scheduler_address


@pytest.fixture(params=["processes", "cluster"])
def plan(request):
    """A plan with two workers, whose progress is stored in ``plan.calls``."""
    calls = []
    at = request.getfixturevalue("scheduler") if request.param == "cluster" else None
    with WorkPlan(2, at, progress=lambda *call: calls.append(call)) as plan:
        plan.calls = calls
        yield plan


def serial(folder, count):
    return list(WorkPlan().map(reduce_piece, pieces_in(folder, count), "reducing"))


def same_bits(some, others):
    return [R.tobytes() for R in some] == [R.tobytes() for R in others]


def is_running(pid):
    """Return whether a process lives; one that only waits to be reaped does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def eventually(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def test_workers_give_the_same_bits_in_order_with_messages_and_progress(plan, tmp_path, caplog):
    caplog.set_level("INFO", logger="robotid")
    folder = tmp_path / "marks"
    pieces = pieces_in(folder, 12, faults={0: "meet", 1: "meet"})
    for _ in range(2):  # the workers of an open plan wait for more work
        found = list(plan.map(reduce_piece, pieces, "reducing"))
        assert same_bits(found, serial(tmp_path / "serial", 12))
    assert marks(folder) == dict.fromkeys(range(12), 2)
    assert len(workers_of(folder) - {os.getpid()}) == 2
    assert all(path.read_text() == "1" for path in folder.iterdir())  # thread
    messages = [text for name, _, text in caplog.record_tuples if name == "robotid.piecework"]
    assert sorted(messages) == sorted(4 * [f"reduced random rows {k}" for k in range(12)])
    total = sum(piece.samples for piece in pieces)
    assert plan.calls[0] == ("reducing", 0, total, "samples")
    assert plan.calls[12] == ("reducing", total, total, "samples")
    assert len(plan.calls) == 26


def test_results_are_in_the_order_of_the_pieces_or_as_they_are_finished(tmp_path):
    pieces = [*pieces_in(tmp_path / "slow", 1, pause=1.0), *pieces_in(tmp_path / "fast", 3)]
    with WorkPlan(2) as plan:
        shapes = [R.shape for R in plan.map(reduce_piece, pieces, "reducing")]
        order = [k for k, _ in plan.as_finished(reduce_piece, pieces, "reducing")]
    assert shapes == [(100, 300), (100, 300), (101, 300), (102, 300)]
    assert order[-1] == 0


def test_few_pieces_are_under_way_at_a_time(tmp_path):
    taken = []

    def pieces():
        for k, piece in enumerate(pieces_in(tmp_path / "marks")):
            taken.append(k)
            yield k, piece

    plan = WorkPlan(2)
    for done, _ in enumerate(plan.run(reduce_piece, pieces())):
        assert len(taken) == min(10, done + 4)
    workers = workers_of(tmp_path / "marks")
    assert all(map(is_running, workers))
    plan.close()
    assert not any(map(is_running, workers))


def test_an_error_of_the_data_keeps_its_type_and_names_the_piece(plan, tmp_path):
    pieces = pieces_in(tmp_path / "marks", faults={3: "data"})
    for one in (plan, WorkPlan()):
        with pytest.raises(DataError, match="row 7 is not finite") as caught:
            list(one.map(reduce_piece, pieces, "reducing"))
        assert caught.value.code == "not_finite"
        assert caught.value.__notes__[-1].startswith("while processing random rows 3")


def test_a_piece_that_ends_every_worker_is_given_up_and_the_others_have_the_same_bits(
    plan, tmp_path
):
    # the cluster gives up a piece after two attempts, also if its neighbour ended the first one
    faults = {1: "kill"} | ({3: "kill once"} if plan.scheduler is None else {})
    pieces = pieces_in(tmp_path / "marks", 4, faults=faults)
    found = dict(
        plan.as_finished(
            reduce_piece, pieces, "reducing", lost=lambda piece, error: (piece.name, error)
        )
    )
    name, error = found.pop(1)
    assert (name, type(error)) == ("random rows 1", WorkerError)
    assert "Unfinished piece: random rows 1" in str(error)
    attempts = marks(tmp_path / "marks")
    if plan.scheduler is None:
        assert (attempts[1], attempts[3]) == (3, 2)
    others = serial(tmp_path / "alone", 4)
    assert same_bits([found[k] for k in sorted(found)], [others[k] for k in (0, 2, 3)])
    if plan.scheduler is None:
        return
    with pytest.raises(WorkerError, match="Unfinished piece: random rows 0"):
        list(plan.map(reduce_piece, pieces_in(tmp_path / "last", 1, faults={0: "kill"}), "more"))


def test_what_stops_the_caller_ends_the_workers(tmp_path):
    def stop(what, done, total, unit):
        if done:
            raise KeyboardInterrupt

    pieces = pieces_in(tmp_path / "marks", 40, pause=0.1)
    with pytest.raises(KeyboardInterrupt):
        list(WorkPlan(2, progress=stop).map(reduce_piece, pieces, "reducing"))
    assert len(marks(tmp_path / "marks")) < 10
    assert eventually(lambda: not any(map(is_running, workers_of(tmp_path / "marks"))))


def test_a_script_needs_no_guard_and_its_workers_end_with_it(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"import os, sys\nsys.path.insert(0, {str(ROOT / 'tests')!r})\n"
        "from helpers.piecework import pieces_in, reduce_piece\n"
        "from robotid.estimation.work_plan import WorkPlan\n"
        "with WorkPlan(2) as plan:\n"
        "    print(len(list(plan.map(reduce_piece, pieces_in('marks'), 'reducing'))), flush=True)\n"
        "    os.kill(os.getpid(), int(sys.argv[1]))\n"
    )
    for number, code in ((0, 0), (9, -9)):
        run = subprocess.run(
            [sys.executable, script, str(number)], cwd=tmp_path, capture_output=True, text=True,
        )  # fmt: skip
        assert (run.returncode, run.stdout) == (code, "10\n")
        if not code:
            assert run.stderr == ""
        assert eventually(lambda: not any(map(is_running, workers_of(tmp_path / "marks"))))
    assert marks(tmp_path / "marks") == dict.fromkeys(range(10), 2)


def test_workers_with_another_robotid_are_refused(scheduler, tmp_path, monkeypatch):
    from distributed import Client

    with Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=120)  # those of tests before are started again
    monkeypatch.setattr("robotid.base.versions.__version__", "99.0.0")
    with pytest.raises(WorkerError, match=r"workers must run robotid 99.0.0, but .* has 0\."):
        list(WorkPlan(2, scheduler).map(reduce_piece, pieces_in(tmp_path / "marks", 2), "reducing"))
    assert marks(tmp_path / "marks") == {}


def test_workers_default_to_the_cores_for_long_work_only(tmp_path):
    short = pieces_in(tmp_path / "marks")
    assert choose_workers(short) == 1
    assert choose_workers(short, 3) == 3
    assert choose_workers(short, 30) == 10
    assert choose_workers(short * 500) == available_cores()
    for wrong in (lambda: choose_workers(short, 0), lambda: WorkPlan(0)):
        with pytest.raises(SettingsError, match="workers is 0, expected at least 1"):
            wrong()


@pytest.mark.parametrize(
    "error",
    [
        DataError("no", "gap"),
        RankDeficientError(3, ["a.m"], 4),
        NotConvergedError("no", "stalled"),
        MissingDependencyError("reading", "pyarrow", "parquet"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_travel_between_processes_with_their_facts(error):
    error.add_note("while reducing a")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)
