"""What a worker does with a piece, and that what it needs and says can travel."""

import logging
import pickle

import numpy as np
import pytest
from helpers.piecework import pieces_in
from threadpoolctl import threadpool_info, threadpool_limits

from robotid.base.exceptions import (
    DataError,
    MissingDependencyError,
    NotConvergedError,
    RankDeficientError,
)
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.workers.pieces import Outcome, reduce_piece, run_task


def say(piece, threads):
    logger = logging.getLogger("robotid.estimation.workers")
    logger.info("%s by %s thread", piece.name, threads)
    logger.debug("too fine to be kept")
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_a_task_runs_with_one_thread_and_brings_home_what_was_logged(tmp_path, caplog):
    (piece,) = pieces_in(tmp_path / "marks", 1)
    logger = logging.getLogger("robotid")
    before = logger.level, list(logger.handlers)
    with threadpool_limits(limits=2, user_api="blas"):
        outcome = run_task(say, piece, logging.INFO)
    assert set(outcome.result) == {1}
    expected = ("robotid.estimation.workers", logging.INFO, "random rows 0 by 1 thread")
    assert outcome.messages == (expected,)
    assert (logger.level, logger.handlers) == before
    with caplog.at_level(logging.INFO):
        caplog.clear()
        outcome.log()
    assert caplog.record_tuples == [expected]


def test_messages_of_a_worker_keep_their_level(caplog):
    said = (("robotid.one", 30, "a % b"), ("robotid.two", 10, "c"))
    with caplog.at_level(10, logger="robotid"):
        Outcome(None, said).log()
    assert tuple(caplog.record_tuples) == said


def test_a_piece_is_reduced_with_the_threads_that_it_is_given(tmp_path):
    given = []

    class Asked:
        def reduce(self, *, threads):
            given.append(threads)

    reduce_piece(Asked(), 3)
    assert given == [3]


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


def test_a_model_survives_pickling_to_the_last_bit(panda, rng):
    again = pickle.loads(pickle.dumps(panda))
    state = [rng.standard_normal((3, 7)) for _ in range(3)]
    np.testing.assert_array_equal(
        joint_torque_regressor(again, *state), joint_torque_regressor(panda, *state)
    )
    np.testing.assert_array_equal(again.standard_parameters(), panda.standard_parameters())
    assert again.locked == panda.locked
    with pytest.raises(TypeError):
        again.locked["panda_joint1"] = 1.0
