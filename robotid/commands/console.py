"""Results as text on a terminal."""

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = [
    "print_comparison",
    "print_error",
    "print_files",
    "print_inspection",
    "print_result",
    "print_table",
    "print_verdict",
    "shown_log",
]


def print_error(error: BaseException, words: str = "") -> None:
    """Print an error on the standard error stream, with what was noted on its way.

    Args:
        error: The error.
        words: What to say of it, if it does not say so itself.
    """
    notes = getattr(error, "__notes__", ())
    separator = "; " if words else "\n  "
    print("robotid:", separator.join([words or str(error), *notes]), file=sys.stderr)


@contextmanager
def shown_log(*, is_verbose: bool) -> Iterator[None]:
    """Show warnings of the logger "robotid" on the standard error stream while the context lasts.

    Args:
        is_verbose: Whether to show what is merely worth knowing, too.

    Yields:
        Nothing.
    """
    logger, handler = logging.getLogger("robotid"), _EachOnce()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO if is_verbose else logging.WARNING)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


class _EachOnce(logging.Handler):
    """Prints a message where the standard error stream then is, once for all its figures.

    Each piece of a long log would say the same again of its own number of samples.
    """

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        words = re.sub(r"[0-9]+", "#", text)
        if words not in self._said:
            self._said.add(words)
            print(f"robotid: {text}", file=sys.stderr)


def print_result(result: dict[str, Any]) -> None:
    """Print what an identification found.

    Args:
        result: The content of result.json.
    """
    structure = result["structure"]
    print(
        f"\n{result['robot']}: {len(result['joints'])} joints, {structure['base']} base parameters "
        f"({structure['base_inertial']} inertial), condition number {structure['condition']:.3g}, "
        f"total mass {result['consistency']['total_mass']:.2f} kg"
    )
    print("\nfitted recordings")
    print_table(result["identification"]["per_joint"], result["wls"]["identification"]["per_joint"])
    for ours, wls in zip(result["validation"], result["wls"]["validation"], strict=True):
        print(f"\nkept apart: {ours['log']}")
        print_table(ours["per_joint"], wls["per_joint"])
    for warning in result["warnings"]:
        print(f"\n{warning['code']}: {warning['message']}")
    print_verdict(result["verdict"])


def print_table(per_joint: dict[str, Any], wls: dict[str, Any]) -> None:
    """Print the metrics of each joint.

    Args:
        per_joint: Metrics by joint, as in result.json.
        wls: Those of weighted least squares, or none.
    """
    width = max(len(joint) for joint in per_joint)
    print(f"  {'joint':{width}}  error %   rmse        wls %   urdf %  gravity %")
    for joint, m in per_joint.items():
        other = wls.get(joint, {}).get("relative_error_pct")
        urdf, gravity = (m.get(f"{key}_relative_error_pct") for key in ("urdf", "gravity_only"))
        cells = [_cell(other), _cell(urdf), _cell(gravity, 9)]
        rmse = f"{m['rmse']:.3g} {m['unit']}"
        error = _cell(m["relative_error_pct"], 7)
        flag = "" if m.get("better_than_constant", True) else "  worse than a constant"
        print(f"  {joint:{width}}  {error}   {rmse:10}{cells[0]} {cells[1]}  {cells[2]}{flag}")


def _cell(value: float | None, width: int = 7) -> str:
    return f"{value:{width}.1f}" if value is not None else "-".rjust(width)


def print_verdict(verdict: dict[str, Any]) -> None:
    """Print a verdict with its reasons.

    Args:
        verdict: Status and reasons, as in result.json.
    """
    print(f"\nverdict: {verdict['status']}")
    for reason in verdict["reasons"]:
        print(f"  - {reason}")
    joints = verdict["per_joint"]
    for status in dict.fromkeys(joint["status"] for joint in joints.values()):
        names = [name for name, joint in joints.items() if joint["status"] == status]
        print(f"  {status}: {', '.join(names)}")


def print_files(folder: str, names: Sequence[str]) -> None:
    """Print which files were written.

    Args:
        folder: Where.
        names: Their names.
    """
    print(f"\nwritten to {folder}:")
    for name in names:
        print(f"  {Path(folder) / name}")


def print_inspection(content: dict[str, Any]) -> None:
    """Print what a URDF holds.

    Args:
        content: What ``robotid inspect --json`` prints.
    """
    print(f"{content['robot']}: joints {', '.join(content['joints'])}")
    if content["structure"]:
        s = content["structure"]
        print(
            f"{s['standard']} standard inertial parameters, {s['base_inertial']} base; with drives "
            f"{s['base']}"
        )
        for group in content["base_groups"]:
            print(f"  {group}")
    for finding in content["findings"]:
        where = finding.get("link") or finding.get("joint") or ""
        print(f"{finding['severity']}: {finding['code']} {where}: {finding['message']}")


def print_comparison(content: dict[str, Any]) -> None:
    """Print several results side by side.

    Args:
        content: What ``robotid compare --json`` prints.
    """
    labels = [result["label"] for result in content["results"]]
    for result in content["results"]:
        verdict = result["verdict"]["status"]
        print(f"{result['label']}  {verdict:7} {result['estimator']:10} {result['path']}")
    for remark in content["remarks"]:
        print(f"  - {remark}")
    for entry in content["validation"]:
        print(f"\nkept apart: {entry['log']}, error %")
        _print_columns(entry["per_joint"], labels)
    alike = "" if content["fitted_alike"] else "; other recordings, not comparable"
    print(f"\nfitted recordings of each, error %{alike}")
    _print_columns(content["fitted"], labels)
    print("\nbase parameters; last columns: difference to A over the combined standard error")
    width = max(len(entry["name"]) for entry in content["base_parameters"])
    heads = [*labels, *[f"{label}-A" for label in labels[1:]]]
    print(f"  {'':{width}}" + "".join(f"{head:>10}" for head in heads))
    for entry in content["base_parameters"]:
        cells = "".join(f"{value:10.4g}" for value in entry["values"])
        cells += "".join(_cell(value, 10) for value in entry["differences"])
        print(f"  {entry['name']:{width}}{cells}")
    for key in ("settings", "versions"):
        for row in content[key]:
            print(f"{key}: {row['name']}: {' | '.join(value or '-' for value in row['values'])}")
    for row in content["inputs"]:
        if not all(row["in"]):
            read = ", ".join(label for label, has in zip(labels, row["in"], strict=True) if has)
            print(f"only {read} read {row['path']} ({row['role']})")


def _print_columns(per_joint: Sequence[dict[str, Any]], labels: Sequence[str]) -> None:
    width = max(len(entry["joint"]) for entry in per_joint)
    print(f"  {'joint':{width}}" + "".join(f"{label:>9}" for label in labels))
    for entry in per_joint:
        cells = "".join(_cell(value, 9) for value in entry["relative_error_pct"])
        print(f"  {entry['joint']:{width}}{cells}")
