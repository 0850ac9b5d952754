"""Error bars of the joints, the worst first, with the errors of other predictions."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

from robotid.base.findings import Finding, grouped, listed
from robotid.diagnosis.verdict.verdict import JointVerdict
from robotid.identification.summary import joint_reason
from robotid.output.pages.html import code, percent

_ROWS = 10  # joints that are visible without unfolding
_WIDEST = 150.0  # [%] end of the scale; larger errors end there, too


class Mark(NamedTuple):
    """Marker of another prediction.

    Attributes:
        words: Its name.
        path: Its SVG path about (0, 9).
        style: "fill" or "line".
    """

    words: str
    path: str
    style: str


@dataclass(frozen=True)
class Bar:
    """The error of one joint.

    Attributes:
        row: Number of the joint, part of the ids of the page.
        joint: Its name.
        error: Its error [%]; None if unknown.
        others: Errors of other predictions, by name [%].
        verdict: The verdict on it.
        link: Id of the target of its name.
        why: Id of its residual analysis; "" if there is none.
    """

    row: int
    joint: str
    error: float | None
    others: Mapping[str, float | None]
    verdict: JointVerdict
    link: str
    why: str = ""


def bars_html(
    title: str,
    note: str,
    bars: Sequence[Bar],
    marks: Mapping[str, Mark],
    limits: tuple[float, float],
) -> str:
    """Return a bar for each joint on a common square-root scale in percent."""
    common = _common(bars)
    named = {bar.joint for own in common for bar in own}
    rows = [_row(bar, marks, limits, is_named=bar.joint in named) for bar in bars]
    more = "".join(rows[_ROWS:])
    if more:
        words = f"{len(rows) - _ROWS} more joints with smaller errors"
        more = f"<details><summary>{words}</summary><ol>{more}</ol></details>\n"
    return (
        f'<h2 id="worst">{title}, worst joint first <span class="note">{note}</span></h2>\n'
        f'{_legend(marks, limits)}<ol class="bars">{"".join(rows[:_ROWS])}</ol>\n{more}'
        f"{''.join(map(_reason_of, common))}"
    )


def _common(bars: Sequence[Bar]) -> list[list[Bar]]:
    """Return the joints that have one reason, apart from its numbers, if they are several."""
    groups: dict[tuple[str, str], list[Bar]] = {}
    for bar in bars:
        if why := joint_reason(bar.joint, bar.verdict.reasons):
            groups.setdefault((bar.verdict.status, re.sub(r"[\d.]+", "", why)), []).append(bar)
    return [own for own in groups.values() if len(own) > 1]


def _reason_of(bars: Sequence[Bar]) -> str:
    """Return the common reason of joints, with the range of its numbers, and their names."""
    reasons = [
        Finding("", "note", bar.joint, joint_reason(bar.joint, bar.verdict.reasons)) for bar in bars
    ]
    (cause,) = grouped(reasons, [bar.joint for bar in bars])
    status, names = bars[0].verdict.status, listed(bar.joint for bar in bars)
    return (
        f'<p class="common {status.replace(" ", "-")}"><strong>{status}</strong>: {escape(names)}: '
        f"{escape('; '.join(cause.messages))}</p>\n"
    )


def _at(value: float) -> str:
    """Return the position of an error on the square-root scale."""
    return f"{100 * (min(value, _WIDEST) / _WIDEST) ** 0.5:.2f}%"


def _row(
    bar: Bar, marks: Mapping[str, Mark], limits: tuple[float, float], *, is_named: bool
) -> str:
    """Return the row of a joint with its own reason."""
    status, kind = bar.verdict.status, bar.verdict.status.replace(" ", "-")
    own = bar.verdict.reasons[-1:] if status == "good" else bar.verdict.reasons
    own = bar.verdict.reasons[1:] if is_named else own
    why, link, picture = joint_reason(bar.joint, own), "", ""
    if bar.error is not None:
        picture = _picture(bar, bar.error, marks, limits)
    if bar.why and why:  # else the link would stand alone on a line
        label = f"residual analysis of {escape(bar.joint)}"
        link = f' <a href="#{bar.why}" aria-label="{label}">analysis</a>'
    return (
        f'<li class="{kind}"><a class="code" href="#{bar.link}">{code(bar.joint).html}</a>'
        f'{picture}<span class="number">{percent(bar.error).html} %</span><strong>{status}</strong>'
        f'<span class="why">{escape(why)}{link}</span></li>\n'
    )


def _picture(bar: Bar, error: float, marks: Mapping[str, Mark], limits: tuple[float, float]) -> str:
    """Return the bar of a joint with the markers of other predictions."""
    shown = {key: x for key in marks if (x := bar.others.get(key)) is not None}
    figures = [f"{marks[key].words} {percent(value).html} %" for key, value in shown.items()]
    title = f"{bar.joint}: error {percent(error).html} %; for comparison {', '.join(figures)}"
    lines = "".join(f'<line x1="{_at(x)}" x2="{_at(x)}" y1="-2" y2="18"/>' for x in limits)
    others = "".join(
        f'<svg x="{_at(value)}" overflow="visible" aria-hidden="true">{_drawn(marks[key])}</svg>'
        for key, value in shown.items()
    )
    return (
        f'<svg class="bar" height="18" role="img" aria-labelledby="bar{bar.row}-title">'
        f'<title id="bar{bar.row}-title">{escape(title)}</title><g class="limits">{lines}</g>'
        f'<rect y="4" width="{_at(error)}" height="10"/>{others}</svg>'
    )


def _drawn(mark: Mark) -> str:
    return f'<path class="{mark.style}" d="{mark.path}"/>'


def _legend(marks: Mapping[str, Mark], limits: tuple[float, float]) -> str:
    keys = "".join(
        f'<span><svg width="10" height="18" viewBox="-5 0 10 18" aria-hidden="true">{_drawn(mark)}'
        f"</svg>{mark.words}</span>"
        for mark in marks.values()
    )
    good, poor = limits
    names = {good: f"{good:g} good", poor: f"{poor:g} usable", 100.0: "100", _WIDEST: "150 %"}
    ticks = sorted({1.0, 5.0, *names})
    scale = "".join(f'<span style="left: {_at(x)}">{names.get(x, f"{x:g}")}</span>' for x in ticks)
    return (
        f'<p class="legend">{keys}</p>\n<div class="scale" aria-hidden="true"><div>{scale}</div>'
        "</div>\n"
    )
