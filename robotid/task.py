"""What a worker does with one piece, in whichever process or on whichever machine it runs."""

import logging
from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from robotid.pieces import Piece, Reduction

__all__ = ["Outcome", "run_task"]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a worker sends home.

    Attributes:
        reduction: The reduction of its piece.
        messages: Logger, level and text of what was logged meanwhile.
    """

    reduction: Reduction
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


def run_task(piece: Piece, level: int) -> Outcome:
    """Reduce a piece with one thread, and keep what is logged.

    Args:
        piece: The piece.
        level: Level from which on messages are kept.

    Returns:
        The reduction, with the messages.

    Raises:
        DataError: If a row cannot be used.
    """
    logger, memory = logging.getLogger("robotid"), _Memory(level)
    before = logger.level
    logger.addHandler(memory)
    logger.setLevel(level)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            reduction = piece.reduce(threads=1)
    finally:
        logger.removeHandler(memory)
        logger.setLevel(before)
    return Outcome(reduction, tuple(memory.messages))
