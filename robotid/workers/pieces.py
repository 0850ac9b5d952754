"""Pieces of long logs, and what a worker does with one, in whichever process or machine it runs.

A piece is a fixed segment of rows of one log, whatever the number of workers: what it comes down
to never depends on who reduces it, nor on what else is reduced beside it.
"""

import logging
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.regressor.factors import Reduction

__all__ = ["Outcome", "Piece", "Work", "Workload", "reduce_piece", "run_task"]


class Workload(Protocol):
    """Something to work on, as a piece of a log; can be pickled."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What messages call it, as ``run3.parquet rows 0-16384``."""

    @property
    @abstractmethod
    def samples(self) -> int:
        """About how many samples it has, for progress."""


class Piece(Workload):
    """A segment of a log that is reduced by itself. Pieces can be pickled, and are small."""

    @abstractmethod
    def reduce(self, *, threads: int | None = None) -> Reduction:
        """Return the factors of the piece's base problem, of no samples if none of it is left.

        Args:
            threads: As of ``compress``; they do not change the result.

        Raises:
            DataError: If a row cannot be used.
        """


#: What is done with a piece, given the number of threads or None for any; can be pickled.
Work: TypeAlias = Callable[[Any, int | None], Any]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a worker sends home."""

    result: Any  # what it made of its piece
    messages: tuple[tuple[str, int, str], ...]  # logger, level, text of what was logged meanwhile

    def log(self) -> None:
        """Log in this process what the worker had to say."""
        for name, level, text in self.messages:
            logging.getLogger(name).log(level, "%s", text)


class _Memory(logging.Handler):
    """Keeps records as plain text, which can be sent anywhere."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self.messages: list[tuple[str, int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append((record.name, record.levelno, record.getMessage()))


def reduce_piece(piece: Piece, threads: int | None) -> Reduction:
    """Return what a piece comes down to.

    Args:
        piece: The piece.
        threads: As of ``Piece.reduce``.

    Raises:
        DataError: If a row cannot be used.
    """
    return piece.reduce(threads=threads)


def run_task(work: Work, piece: Workload, level: int) -> Outcome:
    """Work on a piece with one thread; return the result and what was logged.

    Args:
        work: What to do with the piece.
        piece: The piece.
        level: Level from which on messages are kept.

    Raises:
        DataError: If a row cannot be used.
    """
    logger, memory = logging.getLogger("robotid"), _Memory(level)
    before = logger.level
    logger.addHandler(memory)
    logger.setLevel(level)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            result = work(piece, 1)
    finally:
        logger.removeHandler(memory)
        logger.setLevel(before)
    return Outcome(result, tuple(memory.messages))
