"""Torque or position errors of the joints: as bars, and as a table of each recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robotid.diagnosis.verdict import evidence
from robotid.diagnosis.verdict import position_verdict as positions
from robotid.diagnosis.verdict.verdict import JointVerdict
from robotid.estimation.fitting.metrics import Metrics
from robotid.identification.result import Identification
from robotid.identification.summary import verdict_cell
from robotid.output.pages.html import code, number, percent, table, text
from robotid.output.report.bars import Bar, Mark, bars_html

_SMALL = 1e-3  # [rad or m] unit of position errors


@dataclass(frozen=True)
class Quantity:
    """The predicted quantity, and the baselines of its error.

    Attributes:
        title: Name of its error.
        share: Definition of the error, as a formula.
        limits: Largest error that is good, and largest that is usable [%].
        marks: Markers of the baselines, by name.
        scale: Unit of the errors shown, in units of the quantity.
        prefix: Prefix of that unit.
    """

    title: str
    share: str
    limits: tuple[float, float]
    marks: Mapping[str, Mark]
    scale: float = 1.0
    prefix: str = ""


TORQUE = Quantity(
    "Torque prediction error",
    "100 |τ − prediction| / |τ|",
    (evidence.GOOD, evidence.POOR),
    {
        "wls": Mark("WLS", "M-5 -1h10l-5 6z", "fill"),
        "urdf_with_drives": Mark("URDF + drives", "M-5 19h10l-5 -6z", "fill"),
        "gravity_only": Mark("gravity only", "M-3 6l6 6m0 -6l-6 6", "line"),
        "urdf": Mark("URDF", "M0 0v18", "line"),
    },
)
POSITION = Quantity(
    "Simulated position error",
    "100 |q − simulated| / |motion|",
    (positions.GOOD, positions.POOR),
    {
        "second_order": Mark("2nd-order model", "M-5 -1h10l-5 6z", "fill"),
        "rows": Mark("torque fit", "M-5 19h10l-5 -6z", "fill"),
        "urdf": Mark("URDF", "M0 0v18", "line"),
        "command": Mark("command", "M-3 6l6 6m0 -6l-6 6", "line"),
        "steady": Mark("constant speed", "M-3 9h6", "line"),
    },
    _SMALL,
    "m",
)


@dataclass(frozen=True)
class Errors:
    """The errors of the joints on one recording, or on several together.

    Attributes:
        name: The recording.
        joints: Metrics of each joint that has samples, as in result.json; WLS is a baseline.
        is_fitted: Whether the recording was fitted.
    """

    name: str
    joints: Mapping[str, Mapping[str, Any]]
    is_fitted: bool = False

    @property
    def caption(self) -> str:
        """The recording, and whether it was fitted."""
        if self.is_fitted and not self.name:
            return "All fitted samples together"
        return f"{self.name}: {'fitted' if self.is_fitted else 'not fitted'}"


def errors_of(found: Identification) -> tuple[Errors, ...]:
    """Return the errors on the validation recordings, then on all fitted ones together."""

    def joints(metrics: Metrics, wls: Metrics | None) -> dict[str, Any]:
        content: dict[str, Any] = metrics.to_dict()["per_joint"]
        for joint in content if wls is not None else ():
            content[joint]["wls_relative_error_pct"] = wls.per_joint[joint].relative_error_pct
        return content

    name = found.fitted[0].name if len(found.fitted) == 1 else ""
    return (
        *(Errors(e.name, joints(e.metrics["estimate"], found.beside(e))) for e in found.validation),
        Errors(name, joints(found.metrics(), found.beside()), is_fitted=True),
    )


def worst_errors(recordings: Sequence[Errors]) -> dict[str, Mapping[str, Any]]:
    """Return the metrics of each joint on its worst recording, the worst joint first."""
    worst: dict[str, Mapping[str, Any]] = {}
    for errors in recordings:
        for joint, measured in errors.joints.items():
            if joint not in worst or _share(measured) > _share(worst[joint]):
                worst[joint] = measured
    return dict(sorted(worst.items(), key=lambda item: -_share(item[1])))


def _share(measured: Mapping[str, Any]) -> float:
    """Return a joint's error [%]; inf without measurement."""
    error = measured.get("relative_error_pct")
    return float("inf") if error is None else float(error)


def error_bars(
    quantity: Quantity,
    recordings: Sequence[Errors],
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
    *,
    has_why: bool = False,
) -> str:
    """Return the errors of the joints on their worst recordings as bars, the worst joint first."""
    worst, bars = worst_errors(recordings), []
    # the only validation recording need not be named
    is_alone = len(recordings) == 1 and not recordings[0].is_fitted
    alone = f" on {recordings[0].name}" if is_alone else ""
    for joint in [*worst, *(joint for joint in verdicts if joint not in worst)]:
        measured, row = worst.get(joint, {}), rows.index(joint)
        own = verdicts.get(joint, {"status": "not evaluated", "reasons": ()})
        reasons = tuple(reason.replace(alone, "") if alone else reason for reason in own["reasons"])
        others = {key: measured.get(f"{key}_relative_error_pct") for key in quantity.marks}
        error = _share(measured) if measured else None
        why = f"why-{row}" if has_why and measured else ""
        of_joint = JointVerdict(own["status"], reasons)
        bars.append(Bar(row, joint, error, others, of_joint, f"joint-{row}", why))
    known = {key for bar in bars for key, error in bar.others.items() if error is not None}
    marks = {key: mark for key, mark in quantity.marks.items() if key in known}
    kind = "fitted samples, without validation log"
    kind = kind if recordings[0].is_fitted else "not fitted"
    return bars_html(quantity.title, f"{quantity.share}, {kind}", bars, marks, quantity.limits)


def error_table(
    quantity: Quantity,
    errors: Errors,
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
) -> str:
    """Return the table of the errors on a recording."""
    keys = {f"{key}_relative_error_pct": mark.words for key, mark in quantity.marks.items()}
    shown = [key for key in keys if any(m.get(key) is not None for m in errors.joints.values())]
    headers = ["joint", "error %", "verdict", "RMSE", "unit", "R²", "samples"]
    headers += [f"{keys[key]} %" for key in shown]
    cells = []
    for name in rows:
        m, status = errors.joints.get(name), "–"
        if name in verdicts:
            status = verdict_cell(name, verdicts[name])
        if m is None:
            dashes = [number(None)] * (3 + len(shown))
            nothing = text(f"{status}; no samples used")
            cells.append([code(name), number(None), nothing, number(None), text(""), *dashes[1:]])
            continue
        verdict = "; ".join([status, *(note for note in _notes(m) if note not in status)])
        cells.append(
            [
                code(name),
                percent(m["relative_error_pct"]),
                text(verdict, flag=verdict != status or status.startswith("poor")),
                number(m["rmse"] / quantity.scale, ".3g"),
                text(f"{quantity.prefix}{m['unit']}"),
                number(m.get("r2"), ".3f"),
                number(m.get("rows"), "d"),
                *(percent(m.get(key)) for key in shown),
            ]
        )
    return table(errors.caption, headers, cells, is_data=True)


def _notes(measured: Mapping[str, Any]) -> list[str]:
    notes = [] if measured.get("better_than_constant", True) else ["worse than a constant"]
    error, urdf = measured["relative_error_pct"], measured.get("urdf_relative_error_pct")
    if error is not None and urdf is not None and error > urdf:
        notes.append("worse than the URDF")
    return notes
