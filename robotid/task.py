"""What a worker does with one piece, in whichever process or on whichever machine it runs."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.pieces import Piece, Reduction

__all__ = ["Outcome", "Work", "reduce_piece", "run_task"]

#: What is done with a piece, given the number of threads or None for any; can be pickled.
Work: TypeAlias = Callable[[Any, int | None], Any]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a worker sends home.

    Attributes:
        result: What it made of its piece.
        messages: Logger, level and text of what was logged meanwhile.
    """

    result: Any
    messages: tuple[tuple[str, int, str], ...]

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
        threads: As of :meth:`robotid.pieces.Piece.reduce`.

    Returns:
        The reduction.

    Raises:
        DataError: If a row cannot be used.
    """
    return piece.reduce(threads=threads)


def run_task(work: Work, piece: Piece, level: int) -> Outcome:
    """Work on a piece with one thread, and keep what is logged.

    Args:
        work: What to do with the piece.
        piece: The piece.
        level: Level from which on messages are kept.

    Returns:
        What the work returns, with the messages.

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
