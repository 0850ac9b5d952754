"""Shared parts of running commands: progress, output, a live page."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from robotid.cli.console import Terminated, closed_output_ignored, terminal_progress
from robotid.cli.printing import print_files

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from robotid.base.typing import ProgressCallback
    from robotid.cli.work.job import Job


def progress_of(options: argparse.Namespace) -> "AbstractContextManager[ProgressCallback | None]":
    """Return the progress display that the flags of a command select."""
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
    """Print the result of a command and the files that it wrote, or the JSON alone."""
    with closed_output_ignored():
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
    """Show a log in the browser while an estimator runs over it, until it is interrupted."""
    from robotid.cli.work.track import serve_track

    def announce(url: str) -> None:
        print(f"live: {url}  (stop with Ctrl-C)", file=sys.stderr, flush=True)

    settings = {"port": options.serve, "speed": options.speed}
    try:
        serve_track(job, folder, **settings, announce=announce, finished=finished)
    except Terminated:
        raise
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
