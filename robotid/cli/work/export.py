"""Export of a written result to the formats of other programs."""

from importlib import import_module
from pathlib import Path
from typing import Any

from robotid.base.exceptions import SettingsError
from robotid.base.files import check_file
from robotid.base.findings import listed
from robotid.output.files.export_formats import FORMATS, options_of
from robotid.output.files.exported import Written
from robotid.output.files.result_file import load_result


def export_result(
    path: str | Path, kind: str, target: str | Path, **options: float | str | None
) -> dict[str, Any]:
    """Write a result in another format.

    Friction terms that a format lacks are projected on those that it has, see
    ``project_friction``.
    """
    if kind not in FORMATS:
        raise SettingsError(f"format is {kind!r}, wanted one of {listed(FORMATS)}")
    stated = {name: value for name, value in options.items() if value is not None}
    having = options_of(FORMATS)
    for name in stated:
        if kind not in having.get(name, {}):
            raise SettingsError(
                f"--{name.replace('_', '-')} is an option of {listed(having.get(name, {}))}, "
                f"not of {kind}; remove it"
            )
    result, module = load_result(path), import_module(f"robotid.output.files.{kind}")
    check_file(Path(target), result.files)
    written: Written = module.export(result, Path(target), **stated)
    return {
        "result": str(path), "format": kind, "files": [*map(str, written.files)],
        "not_stated": list(written.notes), "projected": dict(written.projected),
    }  # fmt: skip
