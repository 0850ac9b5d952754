"""What a worker does with one piece, in whichever process or on whichever machine it runs."""

import logging
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Protocol, TypeAlias

from threadpoolctl import threadpool_limits

from robotid.versions import __version__
from robotid.workers.pieces import Piece, Reduction

__all__ = ["Outcome", "Work", "Workload", "reduce_piece", "run_task", "versions"]


class Workload(Protocol):
    """Something to work on, as a piece of a log; can be pickled."""

    @property
    def name(self) -> str:
        """What messages call it."""

    @property
    def samples(self) -> int:
        """About how many samples it has, for progress."""


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
        threads: As of ``Piece.reduce``.

    Returns:
        The reduction.

    Raises:
        DataError: If a row cannot be used.
    """
    return piece.reduce(threads=threads)


def run_task(work: Work, piece: Workload, level: int) -> Outcome:
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


def versions() -> dict[str, str]:
    """Return the versions that decide what work on a piece gives, to the last bit.

    Returns:
        Version by name of the package; "none" if it is not installed.
    """
    found = {"robotid": __version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "pin", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found
