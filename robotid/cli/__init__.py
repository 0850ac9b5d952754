"""The command line: one file a command, with its settings, its work and what it prints."""

import argparse
import atexit
import ctypes
import gc
import io
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from robotid.base.exceptions import RobotIdError, SettingsError
from robotid.base.versions import __version__
from robotid.cli.console import (
    Terminated,
    closed_output_ignored,
    open_closed_streams,
    print_error,
    shown_log,
    terminations_raised,
)
from robotid.cli.parser import CommandParser

__all__ = ["COMMANDS", "main"]

# Objects made between two garbage collections. A command makes many, and almost no cycles.
_OBJECTS = 500_000
# Threads of BLAS, one each if the environment does not state them: matrices are small, and waiting
# threads use processor time.
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
# Parameters of glibc's mallopt. Only freed memory above these sizes, of one array and in total,
# goes back to the system. Without them, new pages for every array cost a tenth of a run.
_MMAP_THRESHOLD, _LARGE = -3, 2**25  # [bytes], the maximum that glibc accepts
_TRIM_THRESHOLD, _SPARE = -1, 2**26  # [bytes]

_FIRST_LINE = re.compile(r'"""robotid ([a-z]+): (.+)\."""')


def _commands() -> dict[str, str]:
    """Return the help line of each command by name: the first line of its file, unimported."""
    commands = {}
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py")):
        with path.open(encoding="utf-8") as file:
            first = _FIRST_LINE.match(file.readline())
        if first:
            commands[first[1]] = first[2]
    return commands


#: The help line of each command by name. A command is a module with add_flags and run; one with
#: many flags also has MAIN_FLAGS and EXAMPLES, for its short help.
COMMANDS = _commands()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line."""
    code = 0
    gc.set_threshold(_OBJECTS)
    atexit.register(gc.freeze)  # no search for cycles in all that the end of the process frees
    for variable in _THREADS:  # before numpy is imported
        os.environ.setdefault(variable, "1")
    open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # its encoding may lack characters of a name
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with closed_output_ignored():
            code = _run(sys.argv[1:] if arguments is None else arguments)
    except OSError as error:  # the standard output is not writable
        print_error(error)
        return 1
    return code


def _run(words: Sequence[str]) -> int:
    """Run a command line, print its error if it fails, and return its exit code."""
    _complete()
    options = _parser(words).parse_args(words, argparse.Namespace(words=words))
    _keep_pages()
    try:
        with terminations_raised(), shown_log(is_verbose=getattr(options, "verbose", False)):
            code: int | None = options.run(options)
    except BrokenPipeError:
        raise
    except SettingsError as error:
        print_error(error)
        return 2
    except (RobotIdError, OSError) as error:
        print_error(error)
        return 1
    except MemoryError as error:
        remedy = "not enough memory; lower rates, shorten logs, or lock joints"
        print_error(error, f"{remedy} ({error})" if str(error) else remedy)
        return 1
    except KeyboardInterrupt as error:
        print_error(error, "interrupted")
        return 128 + error.number if isinstance(error, Terminated) else 130
    return code or 0


def _keep_pages() -> None:
    """Reuse the memory of small arrays instead of returning it, where the C library is glibc."""
    if sys.platform != "linux":
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, _LARGE)
        set_option(_TRIM_THRESHOLD, _SPARE)


def _complete() -> None:
    """Print the possible completions and exit, if a shell asks for them through argcomplete."""
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        line = os.environ.get("COMP_LINE", "")
        argcomplete.autocomplete(_parser(line.split()[1:]))


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of a command line; it has one command if the line starts with a command."""
    parser = CommandParser(
        prog="robotid",
        description="Identify a robot's inertial and drive parameters from its URDF and motion "
        "logs.",
    )
    parser.add_argument("--version", action="version", version=f"robotid {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    first = [word for word in words[:1] if word in COMMANDS]
    chosen = next((word for word in words if not word.startswith("-")), None)
    for name in first or COMMANDS:
        command = commands.add_parser(name, help=COMMANDS[name])
        if name == chosen:
            module = import_module(f"robotid.cli.{name}")
            command.set_defaults(run=module.run)
            module.add_flags(command)
            if hasattr(module, "MAIN_FLAGS"):
                command.shorten_help(module.MAIN_FLAGS, module.EXAMPLES)
    return parser
