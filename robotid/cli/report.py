"""robotid report: write the report of a result again from its inputs."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from robotid.base.exceptions import DataError
from robotid.base.files import check_file, file_sha256, log_exists
from robotid.base.findings import listed
from robotid.base.typing import ProgressCallback, report_stage
from robotid.base.versions import versions
from robotid.cli.console import progress_of, show_found
from robotid.cli.flags import add_json, add_progress, add_verbose
from robotid.cli.identify import identify_job
from robotid.cli.job import Job, written_job
from robotid.estimation.work_plan import WorkPlan
from robotid.identification.result import Identification
from robotid.output.files.result_file import load_result
from robotid.output.report.next_steps import Origin
from robotid.output.report.report_page import write_report

_SHARE = 1e-6  # permitted difference over a base parameter, for rounding ...
_PART = 0.01  # ... or over its standard error, for the tolerance of solvers


def rewrite_report(
    path: str | Path, target: str | Path | None = None, *, progress: ProgressCallback | None = None
) -> dict[str, Any]:
    """Write the report of a result again, in the form of this version of robotid."""
    loaded = load_result(path)
    content, folder = loaded.content, loaded.path.parent
    goal = folder / "report.html" if target is None else Path(target)
    check_file(goal, loaded.files)
    report_stage(progress, "reading logs")
    job = written_job(content["settings"], loaded.path.name)
    _check_inputs(job, content, loaded.path.name)
    found = identify_job(job, job.model(), WorkPlan(job.workers or 1, progress=progress))
    _require_same(found, content, loaded.path.name)
    report_stage(progress, "writing")
    is_beside = goal.resolve().parent == folder.resolve()
    names = {"result": loaded.path.name, **content["outputs"], "replay": "replay.html"}
    files = {
        what: name
        for what, name in names.items()
        if is_beside and what != "report" and (folder / name).is_file()
    }
    origin = Origin((), str(folder), "replay.html" if is_beside else "")
    write_report(found, goal, files=files, origin=origin)
    return {"result": str(loaded.path), "report": str(goal)}


def _check_inputs(job: Job, content: Mapping[str, Any], name: str) -> None:
    """Refuse inputs that differ from those of the result."""
    roles = {"urdf": [job.urdf]} | {
        role: [entry.path for entry in getattr(job, role)]
        for role in ("identification", "validation")
    }
    for role, paths in roles.items():
        stated = [entry for entry in content["inputs"] if entry["role"] == role]
        if not all(entry["path"] for entry in stated):
            raise DataError(
                f"{name} has a log in memory as input, which no longer exists; write the report "
                "in Python, with robotid.save_result"
            )
        if len(stated) != len(paths):
            raise DataError(
                f"{name} has {len(stated)} inputs of the role {role!r}, but its settings name "
                f"{len(paths)}: the file was edited. Identify again"
            )
        for path, entry in zip(paths, stated, strict=True):
            what = f"the {'URDF' if role == 'urdf' else 'log'} {str(path)!r}, an input of {name},"
            if not log_exists(path):
                raise DataError(f"{what} does not exist; restore it, or identify again")
            if file_sha256(path) != entry["sha256"]:
                raise DataError(
                    f"{what} has changed: its SHA-256 is not the stated one; restore the file, or "
                    "identify again"
                )


def _require_same(found: Identification, content: Mapping[str, Any], name: str) -> None:
    """Refuse a fit whose base parameters differ from those of the result."""
    stated = {entry["name"]: entry for entry in content["base_parameters"]}
    fitted = dict(zip(found.mapping.base_names, found.base.tolist(), strict=True))
    if lacking := sorted(stated.keys() ^ fitted.keys()):
        text = f"only one of the two has the parameters {listed(lacking, 5)}"
    else:
        pairs = [(stated[key], value) for key, value in fitted.items()]
        other = [
            f"{entry['name']} is {value:.6g}, {entry['value']:.6g} before"
            for entry, value in pairs
            if abs(value - entry["value"])
            > max(_SHARE * abs(entry["value"]), _PART * (entry["std_error"] or 0.0))
        ]
        if not other:
            return
        text = f"{len(other)} of {len(pairs)} base parameters differ: {listed(other, 3)}"
    now = {"robotid": content["robotid"], **content.get("versions", {})}
    changed = [f"{k} {now[k]} -> {v}" for k, v in versions().items() if now.get(k, v) != v]
    why = f"; changed versions: {listed(changed)}" if changed else ""
    raise DataError(
        f"the repeated fit differs from {name}: {text}{why}. No report is written; identify again "
        "to get result and report of one fit"
    )


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    add("result", metavar="RESULT", help="result.json or its folder")
    add("--out", metavar="FILE", help="page to write; default: report.html in the folder of RESULT")
    add_json(parser)
    add_verbose(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    with progress_of(options) as progress:
        report_stage(progress, "reading logs")

        written = rewrite_report(options.result, options.out, progress=progress)
    show_found(written, options, _show)


def _show(done: dict[str, Any]) -> None:
    print(f"written: {done['report']}")
