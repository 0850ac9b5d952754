"""Who reduces pieces never shows in the result; what goes wrong is said by name."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from helpers import piecework
from helpers.piecework import KeptReduction, marks, pieces_in, reduce_all, same_bits, workers_of

from robotid.base.exceptions import (
    DataError,
    SettingsError,
    WorkerError,
)
from robotid.dynamics.factors import available_cores, join
from robotid.estimation.workers.pieces import reduce_piece
from robotid.estimation.workers.plan import choose_workers
from robotid.estimation.workers.processes import ProcessBackend, _interrupts_deferred

SCRIPT = Path(__file__).parents[2] / "helpers" / "piecework.py"


@pytest.fixture(scope="module")
def one():
    """One worker process, which waits for the work of the next test."""
    with ProcessBackend(1) as backend:
        yield backend


@pytest.fixture(scope="module")
def two():
    """Two worker processes, which wait for the work of the next test."""
    with ProcessBackend(2) as backend:
        yield backend


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


def start(folder, workers, word):
    command = [sys.executable, SCRIPT, folder, str(workers), word]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


def start_and_hold(folder, workers):
    """Return a run of which five pieces are kept and every worker is in the middle of another."""
    run = start(folder, workers, "hold")
    assert eventually(lambda: len(kept(folder)) == 5)
    assert eventually(lambda: sum(seed >= 5 for seed in marks(folder / "marks")) == workers)
    return run


def kept(folder):
    return sorted((folder / ".robotid-checkpoint").glob("*.npz"))


def test_the_number_of_workers_does_not_show_in_the_bits(one, two, tmp_path, caplog):
    caplog.set_level("INFO", logger="robotid")
    pieces = pieces_in(tmp_path / "marks")
    calls = []
    serial = reduce_all(pieces, progress=lambda *call: calls.append(call))
    for backend in (one, two):
        found = reduce_all(pieces, backend=backend)
        assert all(map(same_bits, found, serial))
        assert same_bits(join(found), join(serial))
    assert marks(tmp_path / "marks") == dict.fromkeys(range(10), 3)
    said = [text for name, _, text in caplog.record_tuples if name == "robotid.piecework"]
    assert sorted(said) == sorted(f"reduced random rows {k}" for k in 3 * [*range(10)])
    assert os.getpid() in workers_of(tmp_path / "marks")
    total = sum(piece.samples for piece in pieces)
    assert calls[0] == ("reducing", 0, total, "samples")
    assert calls[-1] == ("reducing", total, total, "samples")
    assert len(calls) == 11


def test_two_workers_work_at_the_same_time(two, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 2, faults={0: "meet", 1: "meet"}.items())
    reduce_all(pieces, backend=two)


def test_few_pieces_are_under_way_at_a_time(one, tmp_path):
    taken = []

    def pieces():
        for k, piece in enumerate(pieces_in(tmp_path / "marks")):
            taken.append(k)
            yield k, piece

    for done, _ in enumerate(one.run(reduce_piece, pieces())):
        assert len(taken) == min(10, done + 2)


def test_workers_wait_for_more_work_and_end_when_they_are_let_go(tmp_path):
    pieces = pieces_in(tmp_path / "marks", 4)
    with ProcessBackend(1) as backend:
        once, again = (reduce_all(pieces, backend=backend) for _ in range(2))
        (worker,) = workers_of(tmp_path / "marks")
        assert is_running(worker)
    assert not is_running(worker)
    assert all(map(same_bits, once, again))


def test_reductions_come_back_in_the_order_of_the_pieces(two, tmp_path):
    pieces = pieces_in(tmp_path / "marks", 4)
    late = [type(pieces[0])(0, pieces[0].marks, pause=0.5), *pieces[1:]]
    found = reduce_all(late, backend=two)
    assert [r.samples for r in found] == [100, 101, 102, 103]


@pytest.mark.parametrize("backend", [None, ProcessBackend(1)])
def test_an_error_of_the_data_keeps_its_type_and_names_the_piece(tmp_path, backend):
    pieces = pieces_in(tmp_path / "marks", faults={3: "data"}.items())
    with pytest.raises(DataError, match="row 7 is not finite") as caught:
        reduce_all(pieces, backend=backend)
    assert caught.value.code == "not_finite"
    assert "while processing random rows 3" in caught.value.__notes__


def test_a_worker_that_is_killed_is_an_error_that_names_what_was_under_way(tmp_path):
    pieces = pieces_in(tmp_path / "marks", faults={2: "kill"}.items())
    with pytest.raises(WorkerError, match="worker process ended during its work") as caught:
        reduce_all(pieces, backend=ProcessBackend(2))
    assert "in each of 3 attempts. Unfinished piece: random rows 2" in str(caught.value)
    assert marks(tmp_path / "marks")[2] == 3
    assert eventually(lambda: not any(map(is_running, workers_of(tmp_path / "marks"))))


def test_a_piece_that_ends_every_worker_is_given_up_and_the_others_have_the_same_bits(tmp_path):
    pieces = pieces_in(tmp_path / "marks", 6, faults={1: "kill", 4: "kill once"}.items())
    with ProcessBackend(1) as backend:
        every = list(enumerate(pieces))
        found = dict(backend.run(reduce_piece, every, lambda piece, error: (piece.name, error)))
    name, error = found.pop(1)
    assert (name, type(error)) == ("random rows 1", WorkerError)
    attempts = marks(tmp_path / "marks")
    assert (attempts[1], attempts[4]) == (3, 2)
    serial = reduce_all(pieces_in(tmp_path / "alone", 6))
    assert sorted(found) == [0, 2, 3, 4, 5]
    assert all(same_bits(own, serial[k]) for k, own in found.items())


def test_what_stops_the_caller_ends_the_workers(tmp_path):
    def stop(what, done, total, unit):
        if done:
            raise KeyboardInterrupt

    pieces = pieces_in(tmp_path / "marks", 40, pause=0.1)
    with pytest.raises(KeyboardInterrupt):
        reduce_all(pieces, backend=ProcessBackend(2), progress=stop)
    done = len(marks(tmp_path / "marks"))
    assert done < 10
    assert not any(map(is_running, workers_of(tmp_path / "marks")))


def test_no_thread_of_the_pool_outlives_it(tmp_path, monkeypatch):
    others = set(threading.enumerate())  # of the pools of other tests

    def feeders():
        own = set(threading.enumerate()) - others
        return [thread for thread in own if thread.name == "QueueFeederThread"]

    class Slow(threading.Thread):  # its end takes longer than what is left of the process
        def run(self):
            super().run()
            if self.name == "QueueFeederThread":
                time.sleep(0.2)

    monkeypatch.setattr("threading.Thread", Slow)
    with ProcessBackend(1) as backend:
        reduce_all(pieces_in(tmp_path / "marks", 2), backend=backend)
        assert len(feeders()) == 1
    assert not feeders()


def killed(run):
    run.kill()
    run.communicate(timeout=60)


def interrupted_in_a_terminal(run):
    """Send Ctrl-C, which reaches the workers too; they say nothing."""
    os.killpg(run.pid, signal.SIGINT)
    error = run.communicate(timeout=60)[1]
    assert error.count("Traceback") == 1  # of the script
    assert "KeyboardInterrupt" in error
    assert error.strip().endswith(".robotid-checkpoint. Continue with --resume")


@pytest.mark.parametrize("end", [killed, interrupted_in_a_terminal])
def test_a_run_that_was_ended_resumes_to_the_same_bits(tmp_path, end):
    end(start_and_hold(tmp_path, 2))
    assert eventually(lambda: not any(map(is_running, workers_of(tmp_path / "marks"))))
    assert not (tmp_path / "joined.npz").exists()
    assert {int(path.stem[-6:]) for path in kept(tmp_path)} == set(range(5))
    before = marks(tmp_path / "marks")
    piecework.main(tmp_path, 1, "resume")
    after = marks(tmp_path / "marks")
    assert [seed for seed in sorted(after) if after[seed] > before.get(seed, 0)] == [5, 6, 7, 8, 9]
    with np.load(tmp_path / "joined.npz") as arrays:
        resumed = KeptReduction.from_arrays(arrays)
    assert same_bits(resumed, join(reduce_all(pieces_in(tmp_path / "other"))))
    assert not (tmp_path / ".robotid-checkpoint").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_during_the_pools_own_functions_is_raised_after_them(number):
    heard, before = [], signal.getsignal(number)

    def handler(number, _):
        heard.append(number)

    signal.signal(number, handler)
    try:
        with _interrupts_deferred():
            signal.raise_signal(number)
            time.sleep(0.01)
            assert heard == []
        assert heard == [number]
        assert signal.getsignal(number) is handler
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        with _interrupts_deferred():
            pass
        assert heard == [number]
        signal.signal(number, signal.SIG_IGN)  # as nohup does
        with _interrupts_deferred():
            signal.raise_signal(number)
        assert signal.getsignal(number) == signal.SIG_IGN
        masked = []

        def work():  # only the main thread may have handlers
            with _interrupts_deferred():
                masked.append(signal.pthread_sigmask(signal.SIG_BLOCK, []))

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        assert masked == [{signal.SIGINT}]
    finally:
        signal.signal(number, before)


def test_a_script_needs_no_guard(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys\nsys.path.insert(0, {str(SCRIPT.parents[1])!r})\n"
        "from helpers.piecework import pieces_in, reduce_all\n"
        "from robotid.estimation.workers.processes import ProcessBackend\n"
        "with ProcessBackend(1) as backend:\n"
        "    print(len(reduce_all(pieces_in('marks'), backend=backend)))\n"
    )
    run = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True)
    assert (run.stdout, run.stderr) == ("10\n", "")
    assert marks(tmp_path / "marks") == dict.fromkeys(range(10), 1)


def test_memory_that_a_worker_keeps_is_no_reason_to_replace_it(one):
    """Pieces limit the memory; loky would replace a worker that grows by 300 MB."""
    from loky import process_executor

    pool = one._pool or one._start()
    largest = pool.submit(getattr, process_executor, "_MAX_MEMORY_LEAK_SIZE")
    assert largest.result() == 10**15


def test_workers_default_to_the_cores_for_long_work_only(tmp_path):
    short = pieces_in(tmp_path / "marks")
    assert choose_workers(short) == 1
    assert choose_workers(short, 3) == 3
    assert choose_workers(short, 30) == 10
    assert choose_workers(short * 500) == available_cores()
    with pytest.raises(SettingsError, match="workers is 0, wanted at least 1"):
        choose_workers(short, 0)
    with pytest.raises(SettingsError, match="workers is 0, wanted at least 1"):
        ProcessBackend(0)
