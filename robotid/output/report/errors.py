"""Torque or position errors of the joints: as bars, and as a table of each recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple

from robotid.diagnosis.verdict.verdict import GOOD, GOOD_POSITION, POOR, POOR_POSITION
from robotid.estimation.fitting.evaluation import Metrics
from robotid.identification.result import Identification
from robotid.identification.summary import joint_reason, verdict_cell
from robotid.output.pages.html import block, code, listing, percent, text

VISIBLE = 10  # joints that are visible without unfolding
_WIDEST = 150.0  # [%] end of the scale; larger errors end there, too
_COLUMNS = (
    ("joint", "code", "joint"), ("error %", "%", "relative_error_pct"),
    ("verdict", "text", "verdict"), ("RMSE", ".3g", "rmse"), ("unit", "text", "unit"),
    ("R²", ".3f", "r2"), ("samples", "d", "rows"),
)  # fmt: skip
_UNKNOWN = {"status": "not evaluated", "reasons": ()}


class Mark(NamedTuple):
    """Marker of another prediction: its name, its SVG path about (0, 9), "fill" or "line"."""

    words: str
    path: str
    style: str

    @property
    def svg(self) -> str:
        """The path in the style."""
        return f'<path class="{self.style}" d="{self.path}"/>'


@dataclass(frozen=True)
class Quantity:
    """The predicted quantity, and the baselines of its error."""

    title: str  # name of its error
    share: str  # definition of the error, as a formula
    limits: tuple[float, float]  # largest error that is good, and largest that is usable [%]
    marks: Mapping[str, Mark]  # markers of the baselines, by name
    scale: float = 1.0  # unit of the errors shown, in units of the quantity
    prefix: str = ""  # prefix of that unit


TORQUE = Quantity(
    "Torque prediction error",
    "100 |τ − prediction| / |τ|",
    (GOOD, POOR),
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
    (GOOD_POSITION, POOR_POSITION),
    {
        "second_order": Mark("2nd-order model", "M-5 -1h10l-5 6z", "fill"),
        "rows": Mark("torque fit", "M-5 19h10l-5 -6z", "fill"),
        "urdf": Mark("URDF", "M0 0v18", "line"),
        "command": Mark("command", "M-3 6l6 6m0 -6l-6 6", "line"),
        "steady": Mark("constant speed", "M-3 9h6", "line"),
    },
    scale=1e-3,
    prefix="m",
)


@dataclass(frozen=True)
class Errors:
    """The errors of the joints on one recording, or on several together."""

    name: str
    # metrics of each joint that has samples, as in result.json; WLS is a baseline
    joints: Mapping[str, Mapping[str, Any]]
    is_fitted: bool = False  # whether the recording was fitted

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
        for joint, plain in ({} if wls is None else wls.per_joint).items():
            content[joint]["wls_relative_error_pct"] = plain.relative_error_pct
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
    worst = worst_errors(recordings)
    # the only validation recording need not be named
    is_alone = len(recordings) == 1 and not recordings[0].is_fitted
    alone = f" on {recordings[0].name}" if is_alone else ""
    items = []
    for joint in [*worst, *(joint for joint in verdicts if joint not in worst)]:
        verdict, row, link, picture = verdicts.get(joint, _UNKNOWN), rows.index(joint), "", ""
        status = verdict["status"]
        reasons = [reason.replace(alone, "") for reason in verdict["reasons"]]
        why = joint_reason(joint, reasons[-1:] if status == "good" else reasons)
        error = _share(worst[joint]) if joint in worst else None
        if error is not None:
            picture = _picture(quantity, row, joint, error, worst[joint])
            if has_why and why:  # else the link would stand alone on a line
                link = block("report.analysis", row=row, joint=escape(joint))
        items.append(
            block(
                "report.bar", kind=status.replace(" ", "-"), row=row, joint=code(joint).html,
                picture=picture, error=percent(error).html, status=status, why=escape(why) + link,
            )
        )  # fmt: skip
    more = "".join(items[VISIBLE:])
    if more:
        words = f"{len(items) - VISIBLE} more joints with smaller errors"
        more = f"<details><summary>{words}</summary><ol>{more}</ol></details>\n"
    fitted = "fitted samples, without validation log"
    return block(
        "report.bars",
        title=quantity.title,
        share=quantity.share,
        kind=fitted if recordings[0].is_fitted else "not fitted",
        legend=_legend(quantity, {key for m in worst.values() for key in _others(quantity, m)}),
        bars="".join(items[:VISIBLE]),
        more=more,
    )


def _others(quantity: Quantity, measured: Mapping[str, Any]) -> dict[str, float]:
    errors = {key: measured.get(f"{key}_relative_error_pct") for key in quantity.marks}
    return {key: error for key, error in errors.items() if error is not None}


def _at(value: float) -> str:
    """Return the position of an error on the square-root scale."""
    return f"{100 * (min(value, _WIDEST) / _WIDEST) ** 0.5:.2f}%"


def _picture(
    quantity: Quantity, row: int, joint: str, error: float, measured: Mapping[str, Any]
) -> str:
    others, words = "", []
    for key, value in _others(quantity, measured).items():
        mark = quantity.marks[key]
        others += f'<svg x="{_at(value)}" overflow="visible" aria-hidden="true">{mark.svg}</svg>'
        words.append(f"{mark.words} {percent(value).html} %")
    places = map(_at, quantity.limits)
    lines = "".join(f'<line x1="{x}" x2="{x}" y1="-2" y2="18"/>' for x in places)
    title = escape(f"{joint}: error {percent(error).html} %; for comparison {', '.join(words)}")
    figures = {"lines": lines, "width": _at(error), "others": others}
    return block("report.picture", row=row, title=title, **figures)


def _legend(quantity: Quantity, known: set[str]) -> str:
    keys = "".join(
        f'<span><svg width="10" height="18" viewBox="-5 0 10 18" aria-hidden="true">{mark.svg}'
        f"</svg>{mark.words}</span>"
        for key, mark in quantity.marks.items()
        if key in known
    )
    good, poor = quantity.limits
    names = {good: f"{good:g} good", poor: f"{poor:g} usable", 100.0: "100", _WIDEST: "150 %"}
    ticks = sorted({1.0, 5.0, *names})
    scale = "".join(f'<span style="left: {_at(x)}">{names.get(x, f"{x:g}")}</span>' for x in ticks)
    return (
        f'<p class="legend">{keys}</p>\n<div class="scale" aria-hidden="true"><div>{scale}</div>'
        "</div>\n"
    )


def error_table(
    quantity: Quantity,
    errors: Errors,
    rows: Sequence[str],
    verdicts: Mapping[str, Mapping[str, Any]],
) -> str:
    """Return the table of the errors on a recording."""
    others = {f"{key}_relative_error_pct": mark.words for key, mark in quantity.marks.items()}
    known = [key for key in others if any(m.get(key) is not None for m in errors.joints.values())]
    entries = []
    for joint in rows:
        measured, status = errors.joints.get(joint), "–"
        if joint in verdicts:
            status = verdict_cell(joint, verdicts[joint])
        entry: dict[str, Any] = {"joint": joint, "verdict": f"{status}; no samples used"}
        if measured is not None:
            notes = [note for note in _notes(measured) if note not in status]
            is_flagged = bool(notes) or status.startswith("poor")
            entry |= dict(measured) | {
                "verdict": text("; ".join([status, *notes]), flag=is_flagged),
                "rmse": measured["rmse"] / quantity.scale,
                "unit": f"{quantity.prefix}{measured['unit']}",
            }
        entries.append(entry)
    columns = [*_COLUMNS, *((f"{others[key]} %", "%", key) for key in known)]
    return listing(errors.caption, columns, entries, is_data=True)


def _notes(measured: Mapping[str, Any]) -> list[str]:
    notes = [] if measured.get("better_than_constant", True) else ["worse than a constant"]
    error, urdf = measured["relative_error_pct"], measured.get("urdf_relative_error_pct")
    if error is not None and urdf is not None and error > urdf:
        notes.append("worse than the URDF")
    return notes
