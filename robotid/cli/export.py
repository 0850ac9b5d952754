"""robotid export: write a result in the formats that other programs read."""

import argparse
from collections.abc import Mapping
from typing import Any

from robotid.cli.flags import add_json
from robotid.cli.printing import echo
from robotid.cli.running import show_found
from robotid.output.files.export_formats import FORMATS, options_of

SUMMARY = f"write a result for other programs: {', '.join(FORMATS)}"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    words = {kind: form.words for kind, form in FORMATS.items()}
    add("--format", required=True, choices=[*FORMATS], help=_by_format(words))
    add("--out", required=True, metavar="FILE", help="file to write")
    for name, having in options_of(FORMATS).items():
        words = {kind: option.words for kind, option in having.items()}
        first = next(iter(having.values()))
        about: dict[str, Any] = {"type": first.kind, "metavar": first.metavar}
        if first.among:
            about = {"choices": first.among}
        add(f"--{name.replace('_', '-')}", help=_by_format(words), **about)
    add_json(parser)


def _by_format(words: Mapping[str, str]) -> str:
    """Return the help text of a flag, format by format."""
    return "; ".join(f"{kind}: {text}" for kind, text in words.items()).replace("%", "%%")


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from robotid.cli.work.export import export_result

    chosen = {name: getattr(options, name) for name in options_of(FORMATS)}
    done = export_result(options.result, options.format, options.out, **chosen)
    show_found(done, options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"written: {', '.join(done['files'])}")
    for note in done["not_stated"]:
        echo(f"  {note}", "  ")
