"""robotid export: write a result for other programs: urdf, mjcf, sdf, isaac, ranges."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file
from robotid.base.findings import listed
from robotid.cli.console import echo, show_found
from robotid.cli.flags import add_json
from robotid.output.files.exports import Written, formats, options_of, writers
from robotid.output.files.result_file import load_result


def export_result(
    path: str | Path, kind: str, target: str | Path, **options: float | str | None
) -> dict[str, Any]:
    """Write a result in another format.

    Friction terms that a format lacks are projected on those that it has, see
    ``project_friction``.
    """
    if kind not in formats():
        raise SettingsError(f"format is {kind!r}, wanted one of {listed(formats())}")
    stated = {name: value for name, value in options.items() if value is not None}
    having = options_of(formats())
    for name in stated:
        if kind not in having.get(name, {}):
            raise SettingsError(
                f"--{name.replace('_', '-')} is an option of {listed(having.get(name, {}))}, "
                f"not of {kind}; remove it"
            )
    result, module = load_result(path), writers()[kind]
    check_file(Path(target), result.files)
    written: Written = module.export(result, Path(target), **stated)
    return {
        "result": str(path), "format": kind, "files": [*map(str, written.files)],
        "not_stated": list(written.notes), "projected": dict(written.projected),
    }  # fmt: skip


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    words = {kind: form.words for kind, form in formats().items()}
    add("--format", required=True, choices=[*formats()], help=_by_format(words))
    add("--out", required=True, metavar="FILE", help="file to write")
    for name, having in options_of(formats()).items():
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
    chosen = {name: getattr(options, name) for name in options_of(formats())}
    done = export_result(options.result, options.format, options.out, **chosen)
    show_found(done, options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"written: {', '.join(done['files'])}")
    for note in done["not_stated"]:
        echo(f"  {note}", "  ")
