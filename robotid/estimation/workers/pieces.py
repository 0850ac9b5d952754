"""Pieces of long logs, and their processing by a worker, in any process and on any machine.

A piece is a fixed segment of rows of one log, for any number of workers. Its reduction does not
depend on the worker or on other pieces.
"""

import logging
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.base.exceptions import WorkerError
from robotid.dynamics.factors import Reduction


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


class Piece(Workload):
    """A segment of a log with its own reduction. Pieces can be pickled, and are small."""

    @abstractmethod
    def reduce(self, *, threads: int | None = None) -> Reduction:
        """Return the factors of the piece's base problem; of no samples if none are usable."""


#: Work on a piece, with the number of threads or None for any; can be pickled.
Work: TypeAlias = Callable[[Any, int | None], Any]

#: Result of a piece that ended its worker in every attempt, from the piece and the error.
Lost: TypeAlias = Callable[[Any, WorkerError], Any]


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a worker."""

    result: Any  # result of the piece
    messages: tuple[tuple[str, int, str], ...]  # logger, level and text of logged messages

    def log(self) -> None:
        """Log the messages of the worker in this process."""
        for name, level, text in self.messages:
            logging.getLogger(name).log(level, "%s", text)


class _Recorder(logging.Handler):
    """Stores records as plain text, which can be pickled."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.messages: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append((record.name, record.levelno, record.getMessage()))


def reduce_piece(piece: Piece, threads: int | None) -> Reduction:
    """Return the reduction of a piece."""
    return piece.reduce(threads=threads)


def run_task(work: Work, piece: Workload, level: int) -> Outcome:
    """Process a piece with one thread; return the result and the logged messages."""
    logger, recorder = logging.getLogger("robotid"), _Recorder(level)
    before = logger.level
    logger.addHandler(recorder)
    logger.setLevel(level)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            result = work(piece, 1)
    finally:
        logger.removeHandler(recorder)
        logger.setLevel(before)
    return Outcome(result, tuple(recorder.messages))
