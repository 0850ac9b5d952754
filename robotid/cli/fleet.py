"""robotid fleet: identify many robots from a table of units and logs."""

import argparse
import hashlib
import json
import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from robotid.base.cores import available_cores
from robotid.base.exceptions import DataError, RobotIdError, SettingsError
from robotid.base.files import (
    check_folder,
    dataset_of,
    folder_beside,
    read_json,
    write_json,
    write_text,
)
from robotid.base.findings import suggestion
from robotid.base.versions import __version__, code_versions
from robotid.cli.console import echo, progress_of, show_found
from robotid.cli.identify import identify_job
from robotid.cli.job import (
    Job,
    LogEntry,
    PayloadEntry,
    add_out,
    add_shown,
    add_work,
    read_job,
    stated_path,
)
from robotid.cli.logs import Refused
from robotid.data.files.parquet_files import read_text_table, write_rows
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.variation.groups import FEWEST_RUNS
from robotid.estimation.variation.variation import FALSE_ALARMS, between_units
from robotid.estimation.work_plan import Workload, WorkPlan
from robotid.output.files.entries import build_result
from robotid.output.report.comparison import fleet_page
from robotid.output.report.report_content import report_html

#: Columns of the table.
COLUMNS = {
    "unit": "name of the robot",
    "log": "its log",
    "urdf": "its URDF",
    "payload": "known mass on its last link [kg], which checks the scale of the torques",
    "job": "job file with the settings",
}
TABLE, CONTENT, PAGE = FILES = ("fleet.parquet", "fleet.json", "fleet.html")
#: Folder of the identified units.
UNITS = ".robotid-units"
_RESULTS: Mapping[str, type] = {
    "unit": str, "log": str, "status": str, "verdict": str, "reasons": str, "parameter": str,
    "value": float, "std_error": float, "spread": float, "parameter_unit": str, "error": str,
    "robot": str, "expression": str,
}  # fmt: skip


@dataclass(frozen=True)
class FleetUnit(Workload):
    """The work of one task."""

    unit: str
    logs: tuple[tuple[Path, float | None], ...]  # each with its known payload [kg]
    urdf: Path | None  # that of the job if None
    job: Path | None  # job file with the settings; its logs are not used

    @property
    def name(self) -> str:
        return f"unit {self.unit}"

    @property
    def samples(self) -> int:
        return len(self.logs)  # which the progress counts

    def stated(self) -> Job:
        job = Job(Path()) if self.job is None else read_job(self.job)
        if isinstance(job.estimator, SimulationSettings):
            raise SettingsError(
                "the estimator is 'simulation', expected one of torques, as 'consistent'; identify "
                "robots from commands with robotid identify"
            )
        fitted = tuple(LogEntry(path) for path, mass in self.logs if mass is None)
        checks = tuple(PayloadEntry(path, mass) for path, mass in self.logs if mass is not None)
        urdf = self.urdf or job.urdf
        return replace(job, urdf=urdf, identification=fitted, validation=(), payload_checks=checks)


#: Rows of a unit in the table of results; a missing value has no key.
UnitRows: TypeAlias = list[dict[str, Any]]


def read_fleet(
    path: str | Path, urdf: str | Path | None = None, job: str | Path | None = None
) -> list[FleetUnit]:
    """Return the units of a table, in the order of their first rows."""
    source, by_unit = Path(path), defaultdict[str, list[_Row]](list)
    names, rows = read_text_table(source)
    for name in ("unit", "log"):
        if name not in names:
            raise DataError(
                f"{source.name} has no column {name!r} ({COLUMNS[name]}); columns: "
                f"{', '.join(names)}{suggestion(name, names)}"
            )
    missing = [known for known in COLUMNS if known not in names]
    for name in names:
        if name not in COLUMNS and (near := suggestion(name, missing)):
            raise DataError(
                f"{source.name} has an unknown column {name!r}{near} Rename it; columns that are "
                "read: " + ", ".join(COLUMNS)
            )
    if not rows:
        raise DataError(f"{source.name} has no rows, expected one for each log")
    for number, cells in enumerate(rows, start=1):
        row = _Row(source, number, cells)
        for name in ("unit", "log"):
            if not cells[name]:
                words = f"no value, expected the {COLUMNS[name]}; fill it in, or remove the row"
                raise row.error(name, words)
        by_unit[cells["unit"]].append(row)
    return [_unit(name, of_unit, urdf, job) for name, of_unit in by_unit.items()]


@dataclass(frozen=True)
class _Row:
    source: Path
    number: int
    cells: Mapping[str, str]

    def error(self, column: str, words: str) -> DataError:
        return DataError(f"{self._where(column)}: {words}")

    def _where(self, column: str) -> str:
        return f"{self.source.name} row {self.number}, column {column!r}"

    def path(self, column: str) -> Path:
        """Return a path, relative to the table, with $VARIABLES replaced as in job files."""
        text, where = self.cells[column], self._where(column)
        try:
            return stated_path(text, where, self.source.parent, expand=True)
        except SettingsError as error:
            raise DataError(str(error)) from error

    @property
    def payload(self) -> float | None:
        """The payload [kg], None without one."""
        text = self.cells.get("payload", "")
        try:
            mass = float(text or 0.0)
        except ValueError:
            mass = float("nan")
        if not 0.0 <= mass < 1e6:
            raise self.error("payload", f"{text!r}, expected a mass in kg, 0 or empty for none")
        return mass or None


def _unit(
    name: str, rows: Sequence[_Row], urdf: str | Path | None, job: str | Path | None
) -> FleetUnit:
    first, seen = rows[0], dict[str, int]()
    for row in rows:
        for column in ("urdf", "job"):
            text, wanted = row.cells.get(column, ""), first.cells.get(column, "")
            if text != wanted:
                raise row.error(
                    column,
                    f"{text!r}, but row {first.number} of the unit {name!r} has {wanted!r}; set "
                    "the same for all logs of a unit, or other names of units",
                )
        log = row.cells["log"]
        if log in seen:
            raise row.error("log", f"{log!r} is in row {seen[log]}, too; remove one of the rows")
        seen[log] = row.number
    files = [
        first.path(column) if first.cells.get(column) else Path(path) if path else None
        for column, path in (("urdf", urdf), ("job", job))
    ]
    if not any(files):
        words = f"the unit {name!r} has no URDF; fill it in, or give one for all units with --urdf"
        raise first.error("urdf", words)
    logs = tuple((row.path("log"), row.payload) for row in rows)
    return FleetUnit(name, logs, *files)


def identify_unit(unit: FleetUnit, threads: int | None) -> tuple[UnitRows, str]:
    """Identify a unit: rows of its result, of which a failure is one, and its report or ""."""
    del threads
    refused: Refused = []
    rows, html = UnitRows(), ""
    try:
        job = unit.stated()
        identification = identify_job(job, job.model(), WorkPlan(1), refused=refused)
        result = build_result(identification, job.to_dict())
        paths = {entry.path for entry, _ in refused}
        used = [e.path for e in job.identification if e.path not in paths]
        rows += _rows(unit.unit, used, result)
        html = report_html(identification)
    except Exception as error:  # the fleet goes on: the error is in the table
        rows = [_failure(unit, error)]
    rows += [
        {"unit": unit.unit, "log": str(entry.path), "status": "failed", "error": str(error)}
        for entry, error in refused
    ]
    return rows, html


def _failure(unit: FleetUnit, error: Exception) -> dict[str, Any]:
    kind = "" if isinstance(error, RobotIdError) else f"{type(error).__name__}: "
    text = "; ".join([f"{kind}{error}", *getattr(error, "__notes__", [])])
    return {"unit": unit.unit, "status": "failed", "error": text}


def _rows(unit: str, logs: Sequence[Path], result: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a result: base parameters of the unit, drive parameters of its logs."""
    verdict, between = result["verdict"], result.get("variation") or {"parameters": {}}
    common = {"unit": unit, "status": "done"}
    of_unit = {"verdict": verdict["status"], "reasons": "\n".join(verdict["reasons"])}
    for entry in result["base_parameters"]:
        varied = between["parameters"].get(entry["name"])
        figures = {"value": entry["value"], "std_error": entry["std_error"]}
        if varied:
            figures = {"value": varied["mean"]} | {x: varied[x] for x in ("std_error", "spread")}
        yield {
            **common, **of_unit, "parameter": entry["name"], "parameter_unit": entry["unit"],
            **figures, "robot": result["robot"], "expression": entry["expression"],
        }  # fmt: skip
    for k, path in enumerate(logs if between["parameters"] else ()):
        for name, varied in between["parameters"].items():
            yield {
                **common, "log": str(path), "parameter": name, "parameter_unit": varied["unit"],
                "value": varied["by_log"][k], "std_error": varied["std_error_by_log"][k],
            }  # fmt: skip


def run_fleet(
    units: Sequence[FleetUnit], folder: str | Path, *, plan: WorkPlan, resume: bool = False
) -> dict[str, Any]:
    """Identify all units; write fleet.parquet, fleet.json and fleet.html when all are finished."""
    target = Path(folder)
    check_folder(target, FILES)
    if not resume:
        shutil.rmtree(target / UNITS, ignore_errors=True)
    (target / UNITS).mkdir(parents=True, exist_ok=True)
    stored = {unit.unit: target / UNITS / f"{_key(unit)}.json" for unit in units}
    missing = [unit for unit in units if not stored[unit.unit].exists()]
    failed: dict[str, UnitRows] = {}
    with plan:
        for k, (rows, html) in plan.as_finished(
            identify_unit, missing, "identifying", counted="logs",
            lost=lambda unit, error: ([_failure(unit, error)], ""),
        ):  # fmt: skip
            if html:
                write_text(html, stored[missing[k].unit].with_suffix(".html"))
            if any(row["status"] == "failed" for row in rows):
                failed[missing[k].unit] = rows
            else:
                write_text(json.dumps(rows, allow_nan=False), stored[missing[k].unit])
        with folder_beside(target) as partial:
            gathered = _Gathered()

            def results() -> Iterator[Mapping[str, Any]]:  # one after the other: not all in memory
                for unit in units:
                    rows = failed.get(unit.unit) or read_json(stored[unit.unit], "unit's result")
                    report = stored[unit.unit].with_suffix(".html")
                    gathered.add(rows, f"{UNITS}/{report.name}" if report.exists() else "")
                    yield from rows

            write_rows(partial / TABLE, results(), _RESULTS)
            outputs = {"table": TABLE, "page": PAGE}
            content = {"robotid": __version__, "versions": code_versions(), "outputs": outputs}
            content |= gathered.content(units)
            write_json(content, partial / CONTENT)
            write_text(fleet_page(content), partial / PAGE)
    return content


def _key(unit: FleetUnit) -> str:
    """Return a hash of a unit and of all inputs of its result."""
    files = [path for path, _ in unit.logs] + [x for x in (unit.urdf, unit.job) if x]
    states = [
        [str(file), file.stat().st_size, file.stat().st_mtime_ns]
        for path in files
        for place in [(dataset_of(path) or path).resolve()]
        for file in (sorted(place.rglob("*")) if place.is_dir() else [place])
        if file.is_file()
    ]
    stated = [unit.unit, [mass for _, mass in unit.logs], str(unit.urdf), str(unit.job)]
    return hashlib.sha256(json.dumps([code_versions(), states, stated]).encode()).hexdigest()


class _Gathered:
    """What the page and the variation between units need of all results."""

    def __init__(self) -> None:
        # by robot, parameter, expression and unit of the parameter: the estimates of the units
        self._values = defaultdict[tuple[str, ...], list[tuple[str, float, float]]](list)
        self._failures: list[dict[str, str]] = []
        self._verdicts = Counter[str]()
        self._units: list[dict[str, str]] = []

    def add(self, rows: UnitRows, report: str) -> None:
        for row in rows:
            if row["status"] == "failed":
                shown = {"unit": row["unit"], "log": row.get("log", ""), "error": row["error"]}
                self._failures.append(shown)
            elif "log" not in row and row.get("std_error"):
                key = row["robot"], row["parameter"], row["expression"], row["parameter_unit"]
                self._values[key].append((row["unit"], row["value"], row["std_error"]))
        judged = next((row for row in rows if row.get("verdict")), {})
        verdict, texts = judged.get("verdict", "failed"), [row.get("error") for row in rows]
        first = judged.get("reasons", "").splitlines()[:1]  # the report has all
        reason = "; ".join(filter(None, [*texts, *first]))
        unit = {"unit": rows[0]["unit"], "verdict": verdict, "reason": reason, "report": report}
        self._units.append(unit)
        self._verdicts.update([verdict] * bool(judged))

    def content(self, units: Sequence[FleetUnit]) -> dict[str, Any]:
        several = {key: rows for key, rows in self._values.items() if len(rows) >= FEWEST_RUNS}
        n_tests = sum(map(len, several.values()))
        parameters, unlike = [], []
        for (robot, name, expression, unit), estimates in several.items():
            names, values, errors = zip(*estimates, strict=True)
            varied = between_units(np.array(values), np.array(errors), FALSE_ALARMS / n_tests)
            if varied is None:
                continue
            prediction, different = varied
            ends = prediction.ends.tolist()
            parameters.append({
                "robot": robot, "name": name, "expression": expression, "unit": unit,
                "units": len(values), "mean": prediction.mean, "std_error": prediction.std_error,
                "spread": prediction.spread, "spread_interval": prediction.spread_ends.tolist(),
                "next_interval": ends, "values": list(values),
            })  # fmt: skip
            unlike += [
                {
                    "unit": names[k], "parameter": name, "value": values[k], "std_error": errors[k],
                    "parameter_unit": unit, "others": ends, "probability": probability,
                }
                for k, probability in different
            ]  # fmt: skip
        return {
            "units": len(units), "logs": sum(len(unit.logs) for unit in units),
            "done": sum(self._verdicts.values()), "verdicts": dict(self._verdicts),
            "results": self._units, "failures": self._failures, "parameters": parameters,
            "unlike": sorted(unlike, key=lambda entry: entry["probability"]),
        }  # fmt: skip


_SHOWN = 10  # failures and units that differ


def add_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    words = "table, .csv or .parquet, with columns unit, log, and optionally urdf, payload, job"
    add("table", metavar="TABLE", help=words)
    add("--urdf", metavar="FILE", help="URDF of the units whose rows have none")
    add("--job", metavar="JOB.toml", help="settings of the units whose rows have no job")
    add_out(parser, "robotid-fleet")
    add_work(parser.add_mutually_exclusive_group(), "one per core")
    words = "keep the units of --out that were identified and whose inputs have not changed"
    add("--resume", action="store_true", help=words)
    add_shown(parser, "json", "progress")


def run(options: argparse.Namespace) -> int:
    with progress_of(options) as progress:
        units = read_fleet(options.table, options.urdf, options.job)
        workers = available_cores() if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, progress)
        content = run_fleet(units, options.out, plan=plan, resume=options.resume)
    show_found(content, options, _show, [TABLE, PAGE, CONTENT], options.out)
    return 0 if content["done"] else 1


def _show(content: Mapping[str, Any]) -> None:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in content["verdicts"].items())
    shown = f" ({verdicts})" if verdicts else ""
    echo(f"{content['done']} of {content['units']} units identified{shown}, {content['logs']} logs")
    failures, unlike = content["failures"], content["unlike"]
    for failure in failures[:_SHOWN]:
        place = ": ".join(filter(None, (failure["unit"], failure["log"])))
        echo(f"failed: {place}: {failure['error']}", "  ")
    for entry in unlike[:_SHOWN]:
        low, high = (f"{x:.3g}" for x in entry["others"])
        estimate = f"{entry['value']:.4g} +- {entry['std_error']:.2g} {entry['parameter_unit']}"
        others = f"the other units predict {low} to {high}"
        echo(f"differs: {entry['unit']}: {entry['parameter']} is {estimate}; {others}", "  ")
    if more := len(failures[_SHOWN:]) + len(unlike[_SHOWN:]):
        echo(f"{more} more failures or differences: fleet.html")
