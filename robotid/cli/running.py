"""What the commands share as they run: progress, what is shown, a live page."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotid.cli.console import Terminated, terminal_progress, unheard_in_silence
from robotid.cli.printing import print_files

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from robotid._typing import ProgressCallback
    from robotid.commands.job import Job

__all__ = ["progress_of", "serve", "show_found"]


def progress_of(options: argparse.Namespace) -> "AbstractContextManager[ProgressCallback | None]":
    """Return the progress that the flags of a command ask for.

    Args:
        options: The flags.
    """
    return terminal_progress(
        quiet=options.json,
        force=getattr(options, "progress", False),
        is_verbose=getattr(options, "verbose", False),
    )


def show_found(
    content: dict[str, Any],
    options: argparse.Namespace,
    show: Callable[[dict[str, Any]], None],
    files: Sequence[str] = (),
) -> None:
    """Print what a command found and which files it wrote, or its JSON alone.

    Args:
        content: What was found.
        options: The flags of the command.
        show: Prints it as text.
        files: Names of the files in the folder ``--out``.
    """
    with unheard_in_silence():
        if options.json:
            print(json.dumps(content, allow_nan=False))
            return
        show(content)
        if files:
            print_files(options.out, files)


def serve(
    job: "Job",
    folder: str | None,
    options: argparse.Namespace,
    finished: Callable[[dict[str, Any]], None],
) -> None:
    """Show a log in the browser while an estimator runs over it, until it is interrupted.

    Args:
        job: The robot and its log.
        folder: Where to write what was found; None: nowhere.
        options: The flags of the command.
        finished: Called with what was found at the end of the log.
    """
    from robotid.commands.track import serve_track

    def announce(url: str) -> None:
        print(f"live: {url}  (Ctrl-C ends it)", file=sys.stderr, flush=True)

    settings = {"port": options.serve, "speed": options.speed}
    try:
        serve_track(job, folder, **settings, announce=announce, finished=finished)
    except Terminated:
        raise
    except KeyboardInterrupt:
        print("\nended", file=sys.stderr)
