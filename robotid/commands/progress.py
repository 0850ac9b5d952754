"""Progress of long work on a terminal: how far, how fast, how long it will still take."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from robotid._typing import ProgressCallback

__all__ = ["terminal_progress"]


@contextmanager
def terminal_progress(
    *, quiet: bool = False, force: bool = False
) -> Iterator[ProgressCallback | None]:
    """Show progress on the standard error stream while the context lasts, if it is a terminal.

    Args:
        quiet: Show none even on a terminal, as beside JSON.
        force: Show it in any case.

    Yields:
        What to call with the name of the work, units done, units in all and their name; None if
        nothing is shown. A new name begins a new bar.
    """
    if not force and (quiet or not sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, force_terminal=True if force else None)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %  {task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    first: dict[str, int] = {}
    with Progress(*columns, console=console, transient=True) as bars:

        def show(what: str, done: int, total: int, unit: str) -> None:
            if what not in tasks:
                for finished in tasks.values():
                    bars.remove_task(finished)
                tasks.clear()
                tasks[what] = bars.add_task(what, total=total, completed=done, rate="")
                first[what] = done
            task = bars.tasks[0]
            elapsed = task.elapsed or 0.0
            made = done - first[what]
            rate = made / elapsed if elapsed > 0 else 0.0
            words = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            bars.update(
                tasks[what], completed=done, total=total, rate=f"{words} {unit}/s" if made else ""
            )

        yield show
