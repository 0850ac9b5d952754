"""Errors and progress on a terminal, and the end of a command after a signal."""

import errno
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TextIO

from robotid.base.text import terminal_width, tinted, wrapped

if TYPE_CHECKING:
    from rich.progress import TaskID

    from robotid.base.typing import ProgressCallback

_LAST_STREAM = 2  # the number of the standard error stream
_ENDS = tuple(getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n))


class Terminated(KeyboardInterrupt):
    """The process received SIGTERM or SIGHUP: it cleans up as after Ctrl-C.

    Attributes:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


def open_closed_streams() -> None:
    """Open a standard stream that is closed, as by ``2>&-``; text written to it is discarded.

    Otherwise the next file that is opened gets the number of the stream.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _LAST_STREAM:
        pass
    os.close(number)
    for name in ("stdout", "stderr"):
        if not _is_open(getattr(sys, name)):
            null = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - open until the end
            setattr(sys, name, null)


def _is_open(stream: TextIO | None) -> bool:
    """Return whether a stream is writable; a stream without a number is."""
    try:
        number = -1 if stream is None else stream.fileno()
    except (OSError, ValueError):  # it is in memory
        return True
    try:
        os.write(number, b"")
    except OSError as error:
        return error.errno != errno.EBADF
    return True


@contextmanager
def terminations_raised() -> Iterator[None]:
    """Raise ``Terminated`` at SIGTERM and SIGHUP in the context; later signals are ignored.

    A signal that is ignored already stays ignored, as SIGHUP under nohup. Only the main thread
    receives signals: the function has no effect in other threads.
    """
    numbers = [number for number in _ENDS if signal.getsignal(number) is signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():
        numbers = []

    def end(number: int, _: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise Terminated(number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def closed_output_ignored() -> Iterator[None]:
    """Discard further output if the reader of the standard output has closed it, as ``| head``."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except OSError as error:
        # the rest is not written again at the end of the process
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise


def print_error(error: BaseException, words: str = "") -> None:
    """Print an error on the standard error stream, with its notes."""
    notes = getattr(error, "__notes__", ())
    separator = "; " if words else "\n  "
    text = f"robotid: {separator.join([words or str(error), *notes])}"
    with suppress(BrokenPipeError):  # the exit code states the failure, too
        if sys.stderr.isatty():  # in a file, one line is easier to search
            text = wrapped(text, terminal_width(), "  ")
        print(tinted(text, "robotid:", "error", sys.stderr), file=sys.stderr)


@contextmanager
def shown_log(*, is_verbose: bool) -> Iterator[None]:
    """Show warnings of the logger "robotid" on the standard error stream in the context."""
    logger, handler = logging.getLogger("robotid"), _EachOnce()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO if is_verbose else logging.WARNING)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


class _EachOnce(logging.Handler):
    """Prints a message on the standard error stream once; its figures make no difference.

    Otherwise each piece of a long log repeats the message with its own number of samples.
    """

    def __init__(self) -> None:
        super().__init__()
        self._printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        words = re.sub(r"[0-9]+", "#", text)
        if words not in self._printed:
            self._printed.add(words)
            with suppress(BrokenPipeError):  # the work is completed without a reader
                print(f"robotid: {text}", file=sys.stderr)


@contextmanager
def terminal_progress(
    *, quiet: bool = False, force: bool = False, is_verbose: bool = False
) -> "Iterator[ProgressCallback | None]":
    """Show progress on the standard error stream in the context, if it is a terminal."""
    if force or not (quiet or not sys.stderr.isatty()):
        with _bars(force=force) as show:
            yield show
    else:
        yield _stage_lines() if is_verbose and not quiet else None


def _stage_lines() -> "ProgressCallback":
    """Return a function that prints a line at the start of each stage."""
    printed: list[str] = []

    def show(what: str, done: int, total: int, unit: str) -> None:
        if unit == "stages" and what not in printed:
            printed.append(what)
            with suppress(BrokenPipeError):  # the work is completed without a reader
                print(f"robotid: {done + 1}/{total} {what}", file=sys.stderr, flush=True)

    return show


@contextmanager
def _bars(*, force: bool) -> "Iterator[ProgressCallback]":
    """Show a bar of the stage and below it a bar of its work; both are removed at the end."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn
    from rich.progress import TimeElapsedColumn as Elapsed
    from rich.progress import TimeRemainingColumn as Remaining

    console = Console(stderr=True, force_terminal=True if force else None)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        Elapsed(),
        TextColumn("{task.fields[state]}"),
        Remaining(),
    )
    tasks: dict[str, TaskID] = {}
    first: dict[str, int] = {}
    stage = ""
    with Progress(*columns, console=console, transient=True) as bars:

        def show(what: str, done: int, total: int, unit: str) -> None:
            nonlocal stage
            if what not in tasks:
                for name in [name for name in tasks if unit == "stages" or name != stage]:
                    bars.remove_task(tasks.pop(name))
                words = f"    {what}" if stage else what
                if unit == "stages":
                    stage, words = what, f"{done + 1}/{total} {what}"
                tasks[what] = bars.add_task(words, total=None, state="")
                first[what] = done
            if unit != "stages":
                elapsed = next(t for t in bars.tasks if t.id == tasks[what]).elapsed or 0.0
                state = _share_and_rate(done, total, done - first[what], elapsed, unit)
                bars.update(tasks[what], completed=done, total=total, state=state)

        yield show


def _share_and_rate(done: int, total: int, made: int, elapsed: float, unit: str) -> str:
    """Return the share of the work that is done and its rate, as "50 %  1,200 samples/s"."""
    share = f"{100 * done / max(total, 1):3.0f} %"
    if not (made and elapsed > 0):
        return share
    rate = made / elapsed
    return f"{share}  {f'{rate:,.0f}' if rate >= 10 else f'{rate:.2g}'} {unit}/s"
