"""robotid fleet: identify many robots from a table of units and logs."""

import argparse
import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import (
    check_folder,
    dataset_of,
    folder_beside,
    read_json,
    write_json,
    write_text,
)
from robotid.base.versions import __version__, code_versions
from robotid.cli.console import echo, progress_of, show_found
from robotid.cli.flags import add_json, add_out, add_progress
from robotid.cli.identify import identify_job
from robotid.cli.job import Job, LogEntry, PayloadEntry, read_job, stated_path
from robotid.data.files.parquet_files import read_text_table, write_rows
from robotid.data.log import suggestion
from robotid.dynamics.factors import available_cores
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.variation.groups import FEWEST_RUNS
from robotid.estimation.variation.variation import FALSE_ALARMS, between_units
from robotid.estimation.work_plan import Workload, WorkPlan
from robotid.output.files.entries import build_result
from robotid.output.report.comparison import fleet_page

#: Columns of the table.
COLUMNS = {
    "unit": "name of the robot",
    "log": "its log",
    "urdf": "its URDF",
    "payload": "known mass on its last link [kg], which checks the scale of the torques",
    "job": "job file with the settings",
}
_FILES = ("fleet.parquet", "fleet.json", "fleet.html")
#: Folder of the identified units.
UNITS = ".robotid-units"
_RESULTS: Mapping[str, type] = {
    "unit": str, "log": str, "status": str, "verdict": str, "reasons": str, "parameter": str,
    "value": float, "std_error": float, "spread": float, "parameter_unit": str, "error": str,
    "robot": str, "expression": str,
}  # fmt: skip


@dataclass(frozen=True)
class FleetUnit(Workload):
    """A unit with its logs: the work of one task."""

    unit: str
    logs: tuple[tuple[Path, float | None], ...]  # each with its known payload [kg]
    urdf: Path | None  # that of the job if None
    job: Path | None  # job file with the settings; its logs are not used

    @property
    def name(self) -> str:
        """Name in messages."""
        return f"unit {self.unit}"

    @property
    def samples(self) -> int:
        """Number of its logs, which the progress counts."""
        return len(self.logs)

    def stated(self) -> Job:
        """Return the job of the unit."""
        job = Job(Path()) if self.job is None else read_job(self.job)
        if isinstance(job.estimator, SimulationSettings):
            raise SettingsError(
                "the estimator is 'simulation', wanted one of torques, as 'consistent'; identify "
                "robots from commands with robotid identify"
            )
        return replace(
            job,
            urdf=self.urdf or job.urdf,
            identification=tuple(LogEntry(path) for path, mass in self.logs if mass is None),
            validation=(),
            payload_checks=tuple(
                PayloadEntry(path, mass) for path, mass in self.logs if mass is not None
            ),
        )


#: Rows of a unit in the table of results; a missing value has no key.
UnitRows: TypeAlias = list[dict[str, Any]]


def read_fleet(
    path: str | Path, urdf: str | Path | None = None, job: str | Path | None = None
) -> list[FleetUnit]:
    """Return the units of a table, in the order of their first rows."""
    source = Path(path)
    names, rows = read_text_table(source)
    for name in ("unit", "log"):
        if name not in names:
            near = suggestion(name, names)
            raise DataError(
                f"{source.name} has no column {name!r} ({COLUMNS[name]}); columns: "
                f"{', '.join(names)}{near}"
            )
    for name in names:
        missing = [known for known in COLUMNS if known not in names]
        if name not in COLUMNS and (near := suggestion(name, missing)):
            raise DataError(
                f"{source.name} has an unknown column {name!r}{near} Rename it; columns that are "
                "read: " + ", ".join(COLUMNS)
            )
    if not rows:
        raise DataError(f"{source.name} has no rows, wanted one for each log")
    by_unit: dict[str, list[tuple[int, dict[str, str]]]] = {}
    for number, row in enumerate(rows, start=1):
        for name in ("unit", "log"):
            if not row[name]:
                raise DataError(
                    f"{source.name} row {number}, column {name!r}: no value, wanted the "
                    f"{COLUMNS[name]}; fill it in, or remove the row"
                )
        by_unit.setdefault(row["unit"], []).append((number, row))
    return [_unit(source, name, own, urdf, job) for name, own in by_unit.items()]


def _unit(
    source: Path,
    name: str,
    rows: Sequence[tuple[int, Mapping[str, str]]],
    urdf: str | Path | None,
    job: str | Path | None,
) -> FleetUnit:
    """Return a unit of the table from its rows."""
    first, stated = rows[0]
    for column in ("urdf", "job"):
        for number, row in rows:
            if row.get(column, "") != stated.get(column, ""):
                raise DataError(
                    f"{source.name} row {number}, column {column!r}: {row[column]!r}, but row "
                    f"{first} of the unit {name!r} has {stated[column]!r}; state the same for all "
                    "logs of a unit, or other names of units"
                )
    seen: dict[str, int] = {}
    logs = []
    for number, row in rows:
        if row["log"] in seen:
            raise DataError(
                f"{source.name} row {number}, column 'log': {row['log']!r} is in row "
                f"{seen[row['log']]}, too; remove one of the rows"
            )
        seen[row["log"]] = number
        mass = _mass(source, number, row.get("payload", ""))
        logs.append((_path(source, number, "log", row["log"]), mass))
    own_urdf, own_job = (
        _path(source, first, column, stated[column])
        if stated.get(column)
        else default and Path(default)
        for column, default in (("urdf", urdf), ("job", job))
    )
    if not (own_urdf or own_job):
        raise DataError(
            f"{source.name} row {first}, column 'urdf': the unit {name!r} has no URDF; fill it in, "
            "or state one for all units with --urdf"
        )
    return FleetUnit(name, tuple(logs), own_urdf or None, own_job or None)


def _path(source: Path, number: int, column: str, text: str) -> Path:
    """Return a path of a row, relative to the table, with $VARIABLES replaced as in job files."""
    try:
        return stated_path(
            text, f"{source.name} row {number}, column {column!r}", source.parent, expand=True
        )
    except SettingsError as error:
        raise DataError(str(error)) from error


def _mass(source: Path, number: int, text: str) -> float | None:
    """Return the payload of a row [kg]; None without one."""
    try:
        mass = float(text or 0.0)
    except ValueError:
        mass = float("nan")
    if not 0.0 <= mass < 1e6:
        raise DataError(
            f"{source.name} row {number}, column 'payload': {text!r}, wanted a mass in kg, 0 or "
            "empty for none"
        )
    return mass or None


def identify_unit(unit: FleetUnit, threads: int | None) -> UnitRows:
    """Identify a unit; a failure is a row of its result."""
    del threads
    refused: dict[Path, str] = {}
    rows: UnitRows = []
    try:
        job = unit.stated()
        found = identify_job(
            job, job.model(), WorkPlan(1),
            refuse=lambda entry, error: refused.update({entry.path: str(error)}),
        )  # fmt: skip
        result = build_result(found, job.to_dict())
        used = [e.path for e in job.identification if e.path not in refused]
        rows += _rows(unit.unit, used, result)
    except Exception as error:  # the fleet goes on: the error is in the table, with its type
        rows = [_failure(unit, error)]
    rows += [
        {"unit": unit.unit, "log": str(path), "status": "failed", "error": error}
        for path, error in refused.items()
    ]
    return rows


def _failure(unit: FleetUnit, error: Exception) -> dict[str, Any]:
    """Return the row of a unit that is not identified."""
    text = "; ".join([f"{type(error).__name__}: {error}", *getattr(error, "__notes__", [])])
    return {"unit": unit.unit, "status": "failed", "error": text}


def _rows(unit: str, logs: Sequence[Path], result: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a result: base parameters of the unit, drive parameters of its logs."""
    verdict, between = result["verdict"], result.get("variation") or {"parameters": {}}
    common = {"unit": unit, "status": "done"}
    of_unit = {"verdict": verdict["status"], "reasons": "; ".join(verdict["reasons"])}
    for entry in result["base_parameters"]:
        own = between["parameters"].get(entry["name"])
        mean = own and {"value": own["mean"], "std_error": own["std_error"],
                        "spread": own["spread"]}  # fmt: skip
        plain = {"value": entry["value"], "std_error": entry["std_error"]}
        yield {
            **common, **of_unit, "parameter": entry["name"], "parameter_unit": entry["unit"],
            **(mean or plain), "robot": result["robot"], "expression": entry["expression"],
        }  # fmt: skip
    for k, path in enumerate(logs if between["parameters"] else ()):
        for name, own in between["parameters"].items():
            yield {
                **common, "log": str(path), "parameter": name, "parameter_unit": own["unit"],
                "value": own["by_log"][k], "std_error": own["std_error_by_log"][k],
            }  # fmt: skip


def run_fleet(
    units: Sequence[FleetUnit],
    folder: str | Path,
    *,
    plan: WorkPlan | None = None,
    resume: bool = False,
) -> dict[str, Any]:
    """Identify all units; write fleet.parquet, fleet.json and fleet.html when all are finished."""
    chosen, target = plan or WorkPlan(1), Path(folder)
    check_folder(target, _FILES)
    if not resume:
        shutil.rmtree(target / UNITS, ignore_errors=True)
    (target / UNITS).mkdir(parents=True, exist_ok=True)
    stored = {unit.unit: target / UNITS / f"{_key(unit)}.json" for unit in units}
    missing = [unit for unit in units if not stored[unit.unit].exists()]
    failed: dict[str, UnitRows] = {}
    with chosen:
        for k, rows in chosen.as_finished(
            identify_unit, missing, "identifying", counted="logs",
            lost=lambda unit, error: [_failure(unit, error)],
        ):  # fmt: skip
            if any(row["status"] == "failed" for row in rows):
                failed[missing[k].unit] = rows
            else:
                write_text(json.dumps(rows, allow_nan=False), stored[missing[k].unit])
        with folder_beside(target) as partial:
            gathered = _Gathered()

            def results() -> Iterator[Mapping[str, Any]]:  # one after the other: not all in memory
                for unit in units:
                    rows = failed.get(unit.unit) or read_json(stored[unit.unit], "unit's result")
                    gathered.add(rows)
                    yield from rows

            write_rows(partial / "fleet.parquet", results(), _RESULTS)
            outputs = {"table": _FILES[0], "page": _FILES[2]}
            content = {"robotid": __version__, "versions": code_versions(), "outputs": outputs}
            content |= gathered.content(units)
            write_json(content, partial / "fleet.json")
            write_text(fleet_page(content), partial / "fleet.html")
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
        self._values: dict[tuple[str, str, str, str], list[tuple[str, float, float]]] = {}
        self._failures: list[dict[str, str]] = []
        self._verdicts: dict[str, int] = {}

    def add(self, rows: UnitRows) -> None:
        """Add the result of a unit."""
        for row in rows:
            if row["status"] == "failed":
                shown = {"unit": row["unit"], "log": row.get("log", ""), "error": row["error"]}
                self._failures.append(shown)
            elif "log" not in row and row.get("std_error"):
                key = row["robot"], row["parameter"], row["expression"], row["parameter_unit"]
                own = row["unit"], row["value"], row["std_error"]
                self._values.setdefault(key, []).append(own)
        verdict = next((row["verdict"] for row in rows if row.get("verdict")), None)
        if verdict is not None:
            self._verdicts[verdict] = self._verdicts.get(verdict, 0) + 1

    def content(self, units: Sequence[FleetUnit]) -> dict[str, Any]:
        """Return the content of fleet.json."""
        several = {key: own for key, own in self._values.items() if len(own) >= FEWEST_RUNS}
        n_tests = sum(map(len, several.values()))
        parameters, unlike = [], []
        for (robot, name, expression, unit), own in several.items():
            values, errors = (np.array([each[k] for each in own]) for k in (1, 2))
            found = between_units(values, errors, FALSE_ALARMS / n_tests)
            if found is None:
                continue
            prediction, different = found
            parameters.append(
                {
                    "robot": robot, "name": name, "expression": expression, "unit": unit,
                    "units": len(own), "mean": prediction.mean, "std_error": prediction.std_error,
                    "spread": prediction.spread, "spread_interval": prediction.spread_ends.tolist(),
                    "next_interval": prediction.ends.tolist(), "values": values.tolist(),
                }
            )  # fmt: skip
            unlike += [
                {
                    "unit": own[k][0], "parameter": name, "value": own[k][1],
                    "std_error": own[k][2], "parameter_unit": unit,
                    "others": prediction.ends.tolist(), "probability": probability,
                }
                for k, probability in different
            ]  # fmt: skip
        return {
            "units": len(units),
            "logs": sum(len(unit.logs) for unit in units),
            "done": sum(self._verdicts.values()),
            "verdicts": self._verdicts,
            "failures": self._failures,
            "parameters": parameters,
            "unlike": sorted(unlike, key=lambda each: each["probability"]),
        }


_SHOWN = 10  # failures and units that differ


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    add = parser.add_argument
    words = "table, .csv or .parquet, with columns unit, log, and optionally urdf, payload, job"
    add("table", metavar="TABLE", help=words)
    add("--urdf", metavar="FILE", help="URDF of the units whose rows have none")
    add("--job", metavar="JOB.toml", help="settings of the units whose rows have no job")
    add_out(parser, "robotid-fleet")
    group = parser.add_mutually_exclusive_group()
    words = "worker processes; default: one per core"
    group.add_argument("--workers", type=int, metavar="N", help=words)
    words = "address of a Dask cluster, as tcp://host:8786"
    group.add_argument("--scheduler", metavar="ADDRESS", help=words)
    words = "keep the units of --out that were identified and whose inputs have not changed"
    add("--resume", action="store_true", help=words)
    add_json(parser)
    add_progress(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    with progress_of(options) as progress:
        units = read_fleet(options.table, options.urdf, options.job)
        workers = available_cores() if options.workers is None else options.workers
        plan = WorkPlan(workers, options.scheduler, progress)
        content = run_fleet(units, options.out, plan=plan, resume=options.resume)
    show_found(content, options, _show, ["fleet.parquet", "fleet.html", "fleet.json"])
    return 0 if content["done"] else 1


def _show(content: Mapping[str, Any]) -> None:
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in content["verdicts"].items())
    shown = f" ({verdicts})" if verdicts else ""
    echo(f"{content['done']} of {content['units']} units identified{shown}, {content['logs']} logs")
    failures, unlike = content["failures"], content["unlike"]
    for each in failures[:_SHOWN]:
        echo(f"failed: {each['unit']}{': ' * bool(each['log'])}{each['log']}: {each['error']}",
             "  ")  # fmt: skip
    for each in unlike[:_SHOWN]:
        low, high = (f"{x:.3g}" for x in each["others"])
        echo(
            f"differs: {each['unit']}: {each['parameter']} is {each['value']:.4g} +- "
            f"{each['std_error']:.2g} {each['parameter_unit']}; the other units predict {low} to "
            f"{high}", "  ",
        )  # fmt: skip
    more = max(len(failures) - _SHOWN, 0) + max(len(unlike) - _SHOWN, 0)
    if more:
        echo(f"{more} more failures or differences: fleet.html")
