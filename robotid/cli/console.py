"""What commands print: results, findings, errors, progress; and their end after a signal."""

import argparse
import json
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from robotid.base.text import command_lines, period, terminal_width, tinted, wrapped

if TYPE_CHECKING:
    from robotid.base.findings import Finding
    from robotid.base.typing import ProgressCallback
    from robotid.output.report.next_steps import Step

SHOWN = 12  # base parameters in a table without --verbose, so that the output fits a screen
_LAST_STREAM = 2  # the number of the standard error stream
_ENDS = tuple(getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n))


def echo(text: str, indent: str = "", tone: str = "") -> None:
    """Print text in lines that fit the terminal."""
    print(tinted(wrapped(text, terminal_width(), indent), tone, tone, sys.stdout))


def print_files(names: Sequence[str], folder: str = "") -> None:
    print(f"\nwritten{folder and f' to {folder}'}: {', '.join(names)}")


def print_steps(steps: "Sequence[Step]") -> None:
    """Print the next steps, each with its commands on separate lines, for copying."""
    print("\nnext steps:")
    for number, step in enumerate(steps, start=1):
        echo(f"  {number}. {step.words}", "   ")
        for block in step.blocks:
            lines = block.split("\n")
            if sys.stdout.isatty() and len(lines) == 1 and block.startswith("robotid "):
                lines = command_lines(block, terminal_width() - 7)
            print("\n".join(f"       {line}" for line in lines))


def print_causes(
    findings: "Sequence[Finding]",
    joints: Sequence[str],
    *,
    is_verbose: bool,
    worst: str = "",
    printed: Sequence[str] = (),
    none: str = "no findings",
) -> None:
    from robotid.base.findings import grouped, tally

    causes, how = grouped(findings, joints), "" if is_verbose else " (--verbose)"
    for cause in causes if is_verbose else [c for c in causes if c.severity != "note"]:
        for message in cause.messages:
            if message not in printed:
                echo(f"{cause.severity}: {cause.code}: {message}", "  ", cause.severity)
    if summary := tally(causes, worst, how) or none:
        echo(summary)


def recordings_of(inputs: Sequence[Mapping[str, Any]], role: str) -> list[str]:
    """Return the file of each recording of a role, with its path if names occur more than once."""
    paths = {Path(entry["path"]) for entry in inputs}
    names = [path.name for path in paths]
    files = {str(path): path.name if names.count(path.name) == 1 else str(path) for path in paths}
    entries = [entry for entry in inputs if entry["role"] == role]
    return [window_name(files[str(Path(entry["path"]))] or "log", entry) for entry in entries]


def window_name(name: str, entry: Mapping[str, Any]) -> str:
    return f"{name} {period(entry['start'], entry['end'])}"


def print_verdict(verdict: Mapping[str, Any]) -> None:
    from robotid.identification.summary import verdict_lines

    first, *others = verdict_lines(verdict)
    echo(f"\n{first}", tone=verdict["status"])
    for line in others:
        status = line.partition(": ")[2].partition(":")[0]
        echo(line, "  ", "" if line.startswith("  - ") else status)


def show_found(
    content: dict[str, Any],
    options: argparse.Namespace,
    show: Callable[[dict[str, Any]], None],
    files: Sequence[str] = (),
    folder: str = "",
) -> None:
    """Print the result of a command and the files that it wrote, or the JSON alone."""
    with closed_output_ignored():
        if options.json:
            print(json.dumps(content, allow_nan=False))
            return
        show(content)
        if files:
            print_files(files, folder)


class Terminated(KeyboardInterrupt):
    """The process received SIGTERM or SIGHUP: it cleans up as after Ctrl-C."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


def open_closed_streams() -> None:
    """Open a standard stream that is closed, as by ``2>&-``; text written to it is discarded."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= _LAST_STREAM:
        pass
    os.close(number)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            null = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - open until the end
            setattr(sys, name, null)


@contextmanager
def terminations_raised() -> Iterator[None]:
    """Raise ``Terminated`` at SIGTERM and SIGHUP in the context; later signals are ignored."""
    is_main = threading.current_thread() is threading.main_thread()
    numbers = [x for x in _ENDS if is_main and signal.getsignal(x) is signal.SIG_DFL]

    def end(number: int, _: FrameType | None) -> None:
        for later in numbers:
            signal.signal(later, signal.SIG_IGN)
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
    """Show warnings of the logger "robotid" on the standard error stream.

    A message that differs in figures only is printed once: pieces of a long log repeat it.
    """
    logger, handler, printed = logging.getLogger("robotid"), logging.StreamHandler(), set[str]()

    def is_new(record: logging.LogRecord) -> bool:
        words = re.sub(r"[0-9]+", "#", record.getMessage())
        is_first = words not in printed
        printed.add(words)
        return is_first

    handler.setFormatter(logging.Formatter("robotid: %(message)s"))
    handler.addFilter(is_new)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO if is_verbose else logging.WARNING)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


@contextmanager
def progress_of(options: argparse.Namespace) -> "Iterator[ProgressCallback | None]":
    """Show progress on the standard error stream, if it is a terminal or a flag asks for it."""
    is_forced, is_verbose = (getattr(options, x, False) for x in ("progress", "verbose"))
    is_quiet = getattr(options, "json", False)
    if is_forced or (sys.stderr.isatty() and not is_quiet):
        with _bars(force=is_forced) as show:
            yield show
    else:
        yield _stage_lines() if is_verbose and not is_quiet else None


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
    """Show the stage and a bar of its work; both are removed at the end."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True, force_terminal=True if force else None)
    with Progress(console=console, transient=True) as bars:
        stage, work = bars.add_task("", total=None), bars.add_task("", visible=False)
        current = ""

        def show(what: str, done: int, total: int, unit: str) -> None:
            nonlocal current
            if unit == "stages":
                bars.update(stage, description=f"{done + 1}/{total} {what}")
                bars.update(work, visible=False)
                bars.refresh()
            elif what == current:
                bars.update(work, completed=done, total=total, visible=True)
            else:
                current = what
                label = f"    {what} [{unit}]"
                bars.reset(work, description=label, completed=done, total=total, visible=True)

        yield show
