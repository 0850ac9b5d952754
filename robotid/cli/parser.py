"""The parser of a command line: suggestions for misspelt words, and a short help with examples."""

import argparse
import difflib
from collections.abc import Sequence
from typing import Any, NoReturn


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

    def shorten_help(self, main_flags: Sequence[str], examples: Sequence[str]) -> None:
        """Show only the main flags and examples by ``--help``, and all flags by ``--help-all``."""
        self.main_flags, self.examples = main_flags, examples
        self.add_argument("--help-all", action=_HelpAll, help="show all flags and exit")

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse words; refuse a flag that a command does not have, with the nearest flag."""
        found, unknown = super().parse_known_args(args, namespace)
        flags = [word.partition("=")[0] for word in unknown if word.startswith("--")]
        if flags and self._subparsers is None:
            known = [flag for action in self._actions for flag in action.option_strings]
            near = difflib.get_close_matches(flags[0], known, n=1)
            hint = f"; did you mean {near[0]}?" if near else f"; see '{self.prog} --help'"
            self.error(f"{flags[0]} is unknown{hint}")
        if unknown and self._subparsers is None:
            self.error(
                f"{unknown[0]!r} is one word too many; a flag takes one word, as JOINT=NUMBER or "
                f"A,B; see '{self.prog} --help'"
            )
        return found, unknown

    def error(self, message: str) -> NoReturn:
        """Print the arguments and a message, and exit with code 2."""
        self.exit(2, f"{self._usage()}{self.prog}: error: {message}\n")

    def format_usage(self) -> str:
        """Return the usage; the short one lists the arguments only."""
        return self._usage() if self.main_flags else super().format_usage()

    def format_help(self) -> str:
        """Return the help: the main flags and examples if there are any, else all flags."""
        if not self.main_flags:
            return super().format_help()
        formatter = self._get_formatter()
        arguments = [action for action in self._actions if not action.option_strings]
        shown = ("--help-all", *self.main_flags)
        flags = [a for a in self._actions if {*shown} & {*a.option_strings}]
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
        if action.choices is None or value in action.choices:
            return
        known = [str(choice) for choice in action.choices]
        near = difflib.get_close_matches(str(value), known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        wanted = ", ".join(known)
        raise argparse.ArgumentError(action, f"{value!r} is unknown{hint} Known: {wanted}")


class _StoreOnce(argparse._StoreAction):
    """Store the value of a flag; refuse a second value."""

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
                self, f"stated twice, as {stored} and as {values}; state it once"
            )
        super().__call__(parser, namespace, values, option_string)


class _HelpAll(argparse.Action):
    """Print the help with all flags, and exit."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        if isinstance(parser, CommandParser):
            parser.main_flags = ()
        parser.print_help()
        parser.exit()
