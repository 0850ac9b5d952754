"""Flags of the command line that say how work is done and shown; they never change a result."""

import argparse

__all__ = ["add_progress_flags", "add_verbose_flag", "add_work_flags"]


def add_work_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say who reduces long logs.

    Args:
        parser: Parser of the command.
    """
    flags = parser.add_argument_group("long logs; the result has the same bits in any case")
    flags.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="worker processes; default: that of the job file, else one per core for long logs",
    )
    flags.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster, as tcp://host:8786"
    )
    flags.add_argument(
        "--resume", action="store_true", help="go on from where an interrupted run in --out ended"
    )


def add_progress_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flag that shows progress where it is not shown by itself.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "--progress",
        action="store_true",
        help="show progress on stderr although it is no terminal, or beside --json",
    )


def add_verbose_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag that shows what the library logs.

    Args:
        parser: Parser of the command.
    """
    parser.add_argument(
        "--verbose", action="store_true", help="say on stderr what is chosen, and why"
    )
