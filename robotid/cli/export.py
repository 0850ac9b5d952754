"""robotid export: write a result for other programs: urdf, mjcf, sdf, isaac, ranges."""

import argparse
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file
from robotid.base.findings import listed
from robotid.cli.console import echo, show_found
from robotid.cli.identify import save_result
from robotid.cli.job import add_shown
from robotid.identification.result import Identification
from robotid.output.files.exports import formats, options_of, writers
from robotid.output.files.result_file import load_result


def export(
    result: Identification | str | Path,
    format: str,
    target: str | Path,
    **options: float | str | None,
) -> dict[str, Any]:
    """Write a result in a format of other programs.

    Friction terms that the format lacks are projected on those that it has.

    Args:
        result: An identification; or its result.json or the folder of it.
        format: "urdf", "mjcf", "sdf", "isaac" or "ranges".
        target: The file to write.
        options: Options of the format, as the flags of ``robotid export``.

    Returns:
        The files, what they do not state ("not_stated"), and the projected terms ("projected").

    Raises:
        DataError: If the result lacks what the format states.
        ModelError: If a link or a drive would be physically impossible.
        SettingsError: If the format, an option or the target is not usable.
    """
    if format not in formats():
        raise SettingsError(f"format is {format!r}, expected one of {listed(formats())}")
    stated = {name: value for name, value in options.items() if value is not None}
    having = options_of(formats())
    for name in stated:
        if format not in having.get(name, {}):
            raise SettingsError(
                f"--{name.replace('_', '-')} is an option of {listed(having.get(name, {}))}, "
                f"not of {format}; remove it"
            )
    with TemporaryDirectory(prefix="robotid-") as folder:
        if isinstance(result, Identification):
            result = save_result(result, folder, report=False)
        loaded = load_result(result)
        check_file(Path(target), loaded.files)
        written = writers()[format].export(loaded, Path(target), **stated)
    return {
        "result": str(result), "format": format, "files": [*map(str, written.files)],
        "not_stated": list(written.notes), "projected": dict(written.projected),
    }  # fmt: skip


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    words = {kind: form.words for kind, form in formats().items()}
    add("--format", required=True, choices=[*formats()], help=_by_format(words))
    add("--out", required=True, metavar="FILE", help="file to write")
    for name, having in options_of(formats()).items():
        words = {kind: option.words for kind, option in having.items()}
        first = next(iter(having.values()))
        about: dict[str, Any] = {"choices": first.among}
        if not first.among:
            about = {"type": first.kind, "metavar": first.metavar}
        add(f"--{name.replace('_', '-')}", help=_by_format(words), **about)
    more = "print the projection of each friction term and what the format lacks"
    add_shown(parser, "json", verbose=more)


def _by_format(words: Mapping[str, str]) -> str:
    return "; ".join(f"{kind}: {text}" for kind, text in words.items()).replace("%", "%%")


def run(options: argparse.Namespace) -> None:
    chosen = {name: getattr(options, name) for name in options_of(formats())}
    content = export(options.result, options.format, options.out, **chosen)
    show_found(content, options, partial(_show, is_verbose=options.verbose))


def _show(content: dict[str, Any], *, is_verbose: bool) -> None:
    print(f"written: {', '.join(content['files'])}")
    notes = content["not_stated"]
    for note in notes if is_verbose else notes[:1]:  # the first: what the format drops
        echo(f"  {note}", "  ")
    if len(notes) > 1 and not is_verbose:
        print(f"{len(notes) - 1} more note{'s' * (len(notes) > 2)} on this format (--verbose)")
