"""The command line: one file a command, with its settings, its work and what it prints.

A command is a module with ``add_flags(parser)`` and ``run(options)``, which returns the exit code,
or None for 0. One with many flags also has MAIN_FLAGS and EXAMPLES, for its short help.
"""

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
from typing import Any, NoReturn

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


#: The help line of each command by name: the first line of its file, which is not imported.
COMMANDS = {
    first[1]: first[2]
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py"))
    if (first := _FIRST_LINE.match(path.read_text(encoding="utf-8")))
}


def main(arguments: Sequence[str] | None = None) -> int:
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
    if "_ARGCOMPLETE" in os.environ:  # a shell asks for completions
        import argcomplete

        argcomplete.autocomplete(_parser(os.environ.get("COMP_LINE", "").split()[1:]))
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
        size = f" ({error})" if str(error) else ""
        print_error(error, f"not enough memory; lower rates, shorten logs, or lock joints{size}")
        return 1
    except KeyboardInterrupt as error:
        print_error(error, "interrupted")
        return 128 + error.number if isinstance(error, Terminated) else 130
    return code or 0


def _keep_pages() -> None:
    """Reuse the memory of small arrays instead of returning it, where the C library is glibc."""
    if sys.platform != "linux":
        return
    if set_option := getattr(ctypes.CDLL(None), "mallopt", None):
        set_option(_MMAP_THRESHOLD, _LARGE)
        set_option(_TRIM_THRESHOLD, _SPARE)


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
                command.add_argument("--help-all", action="help", help="show all flags and exit")
                if "--help-all" not in words:
                    command.main_flags, command.examples = module.MAIN_FLAGS, module.EXAMPLES
    return parser


class CommandParser(argparse.ArgumentParser):
    """A parser that suggests the nearest choice, and whose help may show its main flags only.

    A flag with one value is refused if it occurs twice.
    """

    main_flags: Sequence[str] = ()  # of the short help; all flags if empty
    examples: Sequence[str] = ()  # command lines at its end

    def __init__(self, *words: Any, **settings: Any) -> None:  # noqa: ANN401
        super().__init__(*words, **settings)
        for name in (None, "store"):
            self.register("action", name, _StoreOnce)

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse words; refuse a flag that a command does not have, with the nearest flag."""
        from robotid.base.findings import suggestion

        options, unknown = super().parse_known_args(args, namespace)
        if not unknown or self._subparsers is not None:
            return options, unknown
        flags = [word.partition("=")[0] for word in unknown if word.startswith("--")]
        hint = f"; see '{self.prog} --help'"
        if not flags:
            words = "is one word too many; a flag takes one word, as JOINT=NUMBER or A,B"
            self.error(f"{unknown[0]!r} {words}{hint}")
        known = [flag for action in self._actions for flag in action.option_strings]
        self.error(f"{flags[0]} is unknown{suggestion(flags[0], known) or hint}")

    def error(self, message: str) -> NoReturn:
        """Print the arguments and a message, and exit with code 2."""
        self.exit(2, f"{self._usage()}{self.prog}: error: {message}\n")

    def format_help(self) -> str:
        """Return the help: the main flags and examples if there are any, else all flags."""
        if not self.main_flags:
            return super().format_help()
        formatter, shown = self._get_formatter(), {"--help-all", *self.main_flags}
        arguments = [action for action in self._actions if not action.option_strings]
        flags = [action for action in self._actions if shown & {*action.option_strings}]
        for title, actions in (("arguments", arguments), ("main flags", flags)):
            formatter.start_section(title)
            formatter.add_arguments(actions)
            formatter.end_section()
        examples = "\n".join(f"  {line}" for line in self.examples)
        return f"{self._usage()}\n{formatter.format_help()}\nexamples:\n{examples}\n"

    def _usage(self) -> str:
        arguments = []
        for action in self._actions:
            if not action.option_strings:
                name = str(action.metavar or action.dest)
                arguments.append(f"[{name} ...]" if action.nargs == "*" else name)
            elif action.required:
                arguments.append(f"{action.option_strings[0]} {action.metavar}")
        return f"usage: {self.prog} {' '.join(arguments)} [flags]\n"

    def _check_value(self, action: argparse.Action, value: Any) -> None:  # noqa: ANN401
        """Refuse a word that is not among the choices of an argument, with the nearest choice."""
        from robotid.base.findings import suggestion

        if action.choices is None or value in action.choices:
            return
        known = [str(choice) for choice in action.choices]
        hint, wanted = suggestion(str(value), known) or ".", ", ".join(known)
        raise argparse.ArgumentError(action, f"{value!r} is unknown{hint} Known: {wanted}")


class _StoreOnce(argparse._StoreAction):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,  # noqa: ANN401
        option_string: str | None = None,
    ) -> None:
        stored = getattr(namespace, self.dest, None)
        if self.option_strings and stored is not None and stored is not self.default:
            raise argparse.ArgumentError(
                self, f"given twice, as {stored} and as {values}; give it once"
            )
        super().__call__(parser, namespace, values, option_string)
