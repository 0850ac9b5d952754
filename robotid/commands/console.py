"""Results, errors and progress as text on a terminal."""

import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from robotid.findings import listed

if TYPE_CHECKING:
    from rich.progress import TaskID

    from robotid._typing import ProgressCallback

__all__ = [
    "Terminated",
    "print_content",
    "print_error",
    "print_files",
    "shown_log",
    "terminal_progress",
    "terminations_raised",
    "unheard_in_silence",
]


_ENDS = tuple(getattr(signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n))


class Terminated(KeyboardInterrupt):
    """The process was told to end, by SIGTERM or SIGHUP: what Ctrl-C undoes is undone.

    Attributes:
        number: The signal.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(signal.Signals(number).name)


@contextmanager
def terminations_raised() -> Iterator[None]:
    """Raise ``Terminated`` at SIGTERM and SIGHUP while the context lasts; once, the next is late.

    A signal that is ignored stays so, as SIGHUP under nohup. Only the main thread hears signals:
    elsewhere nothing changes.
    """
    numbers = [number for number in _ENDS if signal.getsignal(number) is signal.SIG_DFL]
    if threading.current_thread() is not threading.main_thread():
        numbers = []

    def end(number: int, _: FrameType | None) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise Terminated(number)

    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def unheard_in_silence() -> Iterator[None]:
    """Say no more if nobody reads the standard output on, as before ``| head``: that is no error.

    Raises:
        OSError: If it cannot be written to for another reason, as a full disk.
    """
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except OSError as error:
        # what is left is not tried again at the end of the process
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise


def print_error(error: BaseException, words: str = "") -> None:
    """Print an error on the standard error stream, with what was noted on its way.

    Args:
        error: The error.
        words: What to say of it, if it does not say so itself.
    """
    notes = getattr(error, "__notes__", ())
    separator = "; " if words else "\n  "
    with suppress(BrokenPipeError):  # the exit code says it, too
        print("robotid:", separator.join([words or str(error), *notes]), file=sys.stderr)


@contextmanager
def shown_log(*, is_verbose: bool) -> Iterator[None]:
    """Show warnings of the logger "robotid" on the standard error stream while the context lasts.

    Args:
        is_verbose: Whether to show what is merely worth knowing, too.
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
            with suppress(BrokenPipeError):  # nobody reads on, and the work is worth ending
                print(f"robotid: {text}", file=sys.stderr)


def print_content(command: str, content: dict[str, Any]) -> None:
    """Print what a command found.

    Args:
        command: Its name.
        content: What it prints with ``--json``.
    """
    prints: Mapping[str, Callable[[dict[str, Any]], None]] = {
        "paper": _print_paper,
        "inspect": _print_inspection,
        "identify": _print_result,
        "track": _print_track,
        "doctor": _print_findings,
        "validate": _print_validation,
        "payload": _print_payload,
        "compare": _print_comparison,
        "export": _print_export,
        "convert": _print_conversion,
        "simulate": _print_simulation,
    }
    prints[command](content)


def print_files(folder: str, names: Sequence[str]) -> None:
    """Print which files were written.

    Args:
        folder: Where.
        names: Their names.
    """
    print(f"\nwritten to {folder}:")
    for name in names:
        print(f"  {Path(folder) / name}")


@contextmanager
def terminal_progress(
    *, quiet: bool = False, force: bool = False
) -> "Iterator[ProgressCallback | None]":
    """Show progress on the standard error stream while the context lasts, if it is a terminal.

    Args:
        quiet: Show none even on a terminal, as beside JSON.
        force: Show it in any case.

    Yields:
        What to call with the name of the work, units done, units in all and their name; None if
        nothing is shown. A new name begins a new bar.
    """
    if not force and (quiet or not sys.stderr.isatty()):
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True, force_terminal=True if force else None)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %  {task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    tasks: dict[str, TaskID] = {}
    first: dict[str, int] = {}
    with Progress(*columns, console=console, transient=True) as bars:

        def show(what: str, done: int, total: int, unit: str) -> None:
            if what not in tasks:
                for finished in tasks.values():
                    bars.remove_task(finished)
                tasks.clear()
                tasks[what] = bars.add_task(what, total=total, completed=done, rate="")
                first[what] = done
            task = bars.tasks[0]
            elapsed = task.elapsed or 0.0
            made = done - first[what]
            rate = made / elapsed if elapsed > 0 else 0.0
            words = f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            bars.update(
                tasks[what], completed=done, total=total, rate=f"{words} {unit}/s" if made else ""
            )

        yield show


def _print_result(result: dict[str, Any]) -> None:
    from robotid.identification.summary import error_lines, friction_lines, verdict_lines

    structure, wls = result["structure"], result["wls"]
    before, after, _ = result["witness"]["masses"]
    print(
        f"\n{result['robot']}: {len(result['joints'])} joints, {structure['base']} base parameters "
        f"({structure['base_inertial']} inertial), condition number {structure['condition']:.3g}, "
        f"total mass {before:.2f} -> {after:.2f} kg"
    )
    _print_lines("fitted recordings", *error_lines(result["identification"], wls["identification"]))
    for ours, theirs in zip(result["validation"], wls["validation"], strict=True):
        _print_lines(f"kept apart: {ours['log']}", *error_lines(ours, theirs))
    _print_lines(*friction_lines(result["friction"]))
    for warning in result["warnings"]:
        _print_lines(f"{warning['code']}: {warning['message']}")
    _print_lines(*verdict_lines(result["verdict"]))


def _print_validation(found: dict[str, Any]) -> None:
    from robotid.identification.summary import error_lines, verdict_lines

    print(f"predicted with {found['predicted_with']}")
    for recording in found["validation"]:
        _print_lines(recording["log"], *error_lines(recording))
    _print_lines(*verdict_lines(found["verdict"]))


def _print_lines(*lines: str) -> None:
    print("\n" + "\n".join(lines))


def _print_inspection(content: dict[str, Any]) -> None:
    print(f"{content['robot']}: joints {listed(content['joints'])}")
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


def _print_comparison(content: dict[str, Any]) -> None:
    from robotid.identification.summary import cell

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
    width = max((len(entry["name"]) for entry in content["base_parameters"]), default=0)
    heads = [*labels, *[f"{label}-A" for label in labels[1:]]]
    print(f"  {'':{width}}" + "".join(f"{head:>10}" for head in heads))
    for entry in content["base_parameters"]:
        values = entry["values"]
        cells = "".join("-".rjust(10) if x is None else f"{x:10.4g}" for x in values)
        cells += "".join(cell(value, 10) for value in entry["differences"])
        print(f"  {entry['name']:{width}}{cells}")
    for key in ("settings", "versions"):
        for row in content[key]:
            print(f"{key}: {row['name']}: {' | '.join(value or '-' for value in row['values'])}")
    for row in content["inputs"]:
        if not all(row["in"]):
            read = ", ".join(label for label, has in zip(labels, row["in"], strict=True) if has)
            print(f"only {read} read {row['path']} ({row['role']})")


def _print_columns(per_joint: Sequence[dict[str, Any]], labels: Sequence[str]) -> None:
    from robotid.identification.summary import cell

    width = max((len(entry["joint"]) for entry in per_joint), default=0)
    print(f"  {'joint':{width}}" + "".join(f"{label:>9}" for label in labels))
    for entry in per_joint:
        cells = "".join(cell(value, 9) for value in entry["relative_error_pct"])
        print(f"  {entry['joint']:{width}}{cells}")


def _print_track(found: dict[str, Any]) -> None:
    converged = found["converged_at"]
    when = "not converged" if converged is None else f"converged at {converged:.2f} s"
    print(
        f"{found['robot']}: {found['samples']} samples, estimate {1e3 * found['delay']:.0f} ms "
        f"behind, {when}, excitation {found['excitation']:.2f}"
    )
    for change in found["changes"]:
        load = change["payload"]
        print(
            f"step change at {change['onset']:.2f} s, flagged at {change['flagged']:.2f} s; as a "
            f"load on {load['body']}: {load['mass']:.2f} +- {load['std_error']:.2f} kg"
        )
    for entry in found["base_parameters"]:
        print(f"  {entry['name']:32} {entry['value']:10.4g} +- {entry['std_error']:.2g}")


def _print_findings(content: dict[str, Any]) -> None:
    for severity in ("error", "warning", "note"):
        for finding in content["findings"]:
            if finding["severity"] == severity:
                print(f"{severity}: {finding['code']}: {finding['message']}")


def _print_payload(content: dict[str, Any]) -> None:
    for found in content["payloads"]:
        link, mass = found["link"], found["mass"]
        known = not found["mass_std_error"]
        low, high = found["mass_interval"]
        print(f"payload on {link}")
        print(
            f"  mass {mass:.4f} kg"
            + (", stated" if known else f" (95 % interval {low:.4f} to {high:.4f})")
        )
        if found["com"] is not None:
            pairs = zip("xyz", found["com"], found["com_std_error"], strict=True)
            words = ", ".join(f"{axis} {x:.4f} +- {error:.2g}" for axis, x, error in pairs)
            print(f"  centre of mass in the frame of {link} [m]: {words}")
        if found["inertia"] is not None:
            about = {"its centre of mass": "inertia", f"the origin of {link}": "inertia_at_link"}
            for where, key in about.items():
                words = ", ".join(
                    f"I{'xyz'[i]}{'xyz'[j]} {found[key][i][j]:.4g}"
                    for i in range(3)
                    for j in range(i, 3)
                )
                print(f"  inertia about {where}, axes of {link} [kg m^2]: {words}")
            largest = max(max(row) for row in found["inertia_std_error"])
            print(f"    standard errors up to {largest:.2g} kg m^2")
        for name, reason in found["reasons"].items():
            print(f"  {'centre of mass' if name == 'com' else name}: not determined; {reason}")
    errors = content["relative_error_pct"].items()
    print("torque left unexplained: " + ", ".join(f"{j} {e:.2g} %" for j, e in errors))
    if "gains" in content:
        print("\n[torque.gains]")
        for joint, gain in content["gains"].items():
            low, high = gain["interval"]
            print(f"{joint} = {gain['gain']:.4g}  # 95 % interval {low:.4g} to {high:.4g}")


def _print_export(done: dict[str, Any]) -> None:
    print(f"written: {', '.join(done['files'])}")
    for note in done["not_stated"]:
        print(f"  {note}")


def _print_conversion(done: dict[str, Any]) -> None:
    print(f"{done['path']}: {done['samples']} samples of {len(done['joints'])} joints")
    print(f"  columns {', '.join(done['columns'])}")
    if done["ignored"]:
        print(f"  not of a joint, left out: {', '.join(done['ignored'])}")


def _print_paper(result: dict[str, Any]) -> None:
    columns = {"disturbed": "disturbed", "noisy": "noisy", "on_program": "on program"}
    print("relative error of the parameters; the last three columns at the end")
    print("  model       start   after 1   at end   " + "  ".join(columns.values()) + "   NA")
    for name, model in result["models"].items():
        errors = model["relative_error"]
        ends = [result[case][name]["relative_error"][-1] for case in columns]
        cells = [errors[0], errors[1], errors[-1], *ends]
        print(f"  {name:10}" + "".join(f"{cell:9.2g}" for cell in cells) + f"   {model['NA']}")
    print("\nrandom motions that converged to 1e-3")
    for name, found in result["trajectories"].items():
        print(f"  {name:10} {found['converged']} of {found['runs']}")


def _print_simulation(content: dict[str, Any]) -> None:
    print(
        f"{content['robot']}: {content['samples']} samples over {content['duration']:g} s, seed "
        f"{content['settings']['seed']}"
    )
    width = max(len(joint) for joint in content["joints"])
    print(f"\n{'error of the position':{width}}  rms, largest")
    for joint in content["following"]:
        line = f"{joint['joint']:{width}}  {joint['rms']:.2g}, {joint['largest']:.2g}"
        line += f" {joint['unit']}"
        if joint["at_limit"] > 0:
            line += f"; at its effort limit for {100 * joint['at_limit']:.2g} % of the time"
        print(line)
