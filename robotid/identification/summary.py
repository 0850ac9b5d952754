"""Summaries of results as lines of text."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from robotid.base.text import columns
from robotid.diagnosis.verdict.verdict import uses_line

#: Column heads of the errors of other predictions, by name: of torques, then of positions.
_BESIDE = {
    "urdf_with_drives": "URDF +\ndrives %",
    "wls": "least\nsquares %",
    "second_order": "2nd\norder %",
    "rows": "torques\nalone %",
    "urdf": "URDF\n%",
    "gravity_only": "gravity\nonly %",
    "command": "command\n%",
    "steady": "constant\nspeed %",
}
_SHOWN_SPREADS = ("coulomb", "viscous", "kp", "kd", "delay")


def error_lines(
    metrics: Mapping[str, Any], wls: Mapping[str, Any] | None = None, width: int | None = None
) -> list[str]:
    """Return the errors of each joint as lines of text."""
    others = {} if wls is None else wls["per_joint"]
    joints = {
        joint: {**m, "wls_relative_error_pct": others.get(joint, {}).get("relative_error_pct")}
        for joint, m in metrics["per_joint"].items()
    }
    keys = [f"{name}_relative_error_pct" for name in _BESIDE]
    shown = [key for key in keys if any(m.get(key) is not None for m in joints.values())]
    rows = []
    for joint, m in joints.items():
        rmse = f"{m['rmse']:#.3g}".rstrip(".")
        error, *plain = (cell(m.get(key)) for key in ("relative_error_pct", *shown))
        rows.append([joint + _mark(m), error, rmse, m["unit"], *plain])
    named = dict(zip(keys, _BESIDE.values(), strict=True))
    heads = ["joint\n", "error\n%", "rmse\n", "\n", *(named[key] for key in shown)]
    lines = columns(heads, rows, width=width, needed=4, left=(0, 3))
    return lines + (["  * worse than a constant"] if any(map(_mark, joints.values())) else [])


def _mark(metrics: Mapping[str, Any]) -> str:
    return "" if metrics["better_than_constant"] else " *"


def friction_lines(friction: Mapping[str, Any], *, has_errors: bool = True) -> list[str]:
    """Return the friction of joints besides viscous and Coulomb, and its effect, as text."""
    words = []
    for joint, choice in friction.items():
        if choice["families"]:
            selected = [step for step in choice["tried"] if step["is_selected"]]
            ends = (step["held_out_error_pct"] for step in (choice["tried"][0], selected[-1]))
            gain = " ({:.1f} -> {:.1f} %)".format(*ends) if has_errors else ""
            words.append(f"{joint} {' + '.join(choice['families'])}{gain}")
    title = f"further friction{' (held-out error)' * has_errors}"
    return [f"{title}: {', '.join(words)}"] if words else []


def left_out_lines(logs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the errors by joint of logs that a fit to the others predicts, as text."""
    errors: dict[str, list[float]] = {}
    for log in logs:
        for joint, metrics in log["per_joint"].items():
            if metrics["relative_error_pct"] is not None:
                errors.setdefault(joint, []).append(metrics["relative_error_pct"])
    if not errors:
        return []
    words = [f"{joint} {min(x):.1f} to {max(x):.1f} %" for joint, x in errors.items()]
    return [f"error of each of {len(logs)} logs, by a fit to the others: {', '.join(words)}"]


def variation_lines(variation: Mapping[str, Any] | None) -> list[str]:
    """Return the spread of friction between logs, and what one more log would add, as text."""
    if variation is None:
        return []
    shares: dict[str, list[float]] = {}
    for name, parameter in variation["parameters"].items():
        term = name.rpartition(".")[2]
        if term in _SHOWN_SPREADS and abs(parameter["mean"]) > parameter["std_error"]:
            shares.setdefault(term, []).append(100 * parameter["spread"] / abs(parameter["mean"]))
    if not shares:
        return []
    words = [f"{term} {min(x):.2g} to {max(x):.2g} %" for term, x in sorted(shares.items())]
    lines = [f"spread between {len(variation['logs'])} logs, by joint: {', '.join(words)}"]
    gains = {
        name: one_more_gain(parameter)
        for name, parameter in variation["parameters"].items()
        if "one_more" in parameter
    }
    if gains:
        member = "robot" if variation["units"] > 1 else "log"
        most = max(gains, key=lambda name: gains[name][1])
        error, width = (100 * median(x) for x in zip(*gains.values(), strict=True))
        lines.append(
            f"one more {member}: standard errors of the means {error:.2g} % smaller, intervals of "
            f"the next {member} {width:.2g} % narrower (medians; most: {most} "
            f"{100 * gains[most][1]:.2g} %)"
        )
    return lines


def one_more_gain(parameter: Mapping[str, Any]) -> tuple[float, float]:
    """Return the shares by which the error of a mean and a prediction interval would decrease."""
    error, width = (parameter["one_more"][key] for key in ("std_error", "interval_width"))
    low, high = parameter["next_interval"]
    return 1.0 - error / parameter["std_error"], 1.0 - width / (high - low)


def verdict_lines(verdict: Mapping[str, Any]) -> list[str]:
    """Return a verdict as text: status, reasons (a joint's as its line), other joints, uses."""
    by_cell: dict[str, list[str]] = {}
    cell_of = {name: verdict_cell(name, joint) for name, joint in verdict["per_joint"].items()}
    for name, words in cell_of.items():
        by_cell.setdefault(words, []).append(name)
    if list(by_cell) == ["good"]:
        by_cell = {} if verdict["status"] == "good" else {"good": ["every joint"]}
    cells = {words: f"  {', '.join(names)}: {words}" for words, names in by_cell.items()}
    firsts = {x: joint_reason(x, joint["reasons"]) for x, joint in verdict["per_joint"].items()}
    lines = []
    for reason in verdict["reasons"]:
        about, _, words = reason.partition(": ")
        named = set(about.split(", ")) & firsts.keys()
        same = [joint for joint in firsts if firsts[joint] == (words if named else reason)]
        is_first = same and named <= set(same)
        lines.append(cells.get(cell_of[same[0]], "") if is_first else f"  - {reason}")
    in_order = dict.fromkeys([*filter(None, lines), *cells.values()])
    uses = uses_line(verdict.get("use_for", {}))
    return [f"verdict: {verdict['status']}", *in_order, *([uses] if uses else [])]


def verdict_cell(joint: str, verdict: Mapping[str, Any]) -> str:
    """Return the verdict on a joint with its first reason, as in "usable, error 20 % on b.csv"."""
    status, why = verdict["status"], joint_reason(joint, verdict["reasons"])
    if status == "good" or not why:
        return str(status)
    return why if why.endswith(status) else f"{status}, {why}"


def joint_reason(joint: str, reasons: Sequence[str]) -> str:
    """Return the first reason of the verdict on a joint without its name; "" if there is none."""
    why = reasons[0] if reasons else ""
    about, _, words = why.partition(": ")
    return words if joint in about.split(", ") else why


def cell(value: float | None) -> str:
    """Return a percentage, or a dash."""
    return "-" if value is None else f"{value:.1f}" if value < 1000 else f"{value:.0f}"
