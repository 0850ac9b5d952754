"""Bars of the errors of joints, the worst first, beside those of other predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple

from robotid.identification.summary import joint_reason
from robotid.judgement.verdict import JointVerdict
from robotid.pages.html import code, percent

__all__ = ["Bar", "Mark", "bars_html"]

_ROWS = 10  # joints whose errors are seen at once
_WIDEST = 150.0  # [%] at the end of the scale; what is beyond stands there


class Mark(NamedTuple):
    """How another prediction is marked.

    Attributes:
        words: What it is called.
        path: Its path about (0, 9).
        style: "fill" or "line".
    """

    words: str
    path: str
    style: str


@dataclass(frozen=True)
class Bar:
    """The error of one joint.

    Attributes:
        row: Number of the joint, which ids of the page are made of.
        joint: Its name.
        error: Its error [%]; None if it is not known.
        others: Errors of other predictions, by name [%].
        verdict: The verdict on it.
        link: Id of what its name leads to.
        why: Id of what says more; "" if nothing does.
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
    """Return a bar for each joint on one scale of percent, whose root is linear.

    Args:
        title: What is missed.
        note: What it is a share of, HTML.
        bars: The joints, the worst first.
        marks: How other predictions are marked, by name.
        limits: Largest error that is good, and largest that is usable [%].
    """
    rows = [_row(bar, marks, limits) for bar in bars]
    more = "".join(rows[_ROWS:])
    if more:
        words = f"{len(rows) - _ROWS} more joints, which are predicted better"
        more = f"<details><summary>{words}</summary><ol>{more}</ol></details>\n"
    return (
        f'<h2 id="worst">{title}, worst joint first <span class="note">{note}</span></h2>\n'
        f'{_legend(marks, limits)}<ol class="bars">{"".join(rows[:_ROWS])}</ol>\n{more}'
    )


def _at(value: float) -> str:
    """Return where an error stands on the scale, whose root is linear."""
    return f"{100 * (min(value, _WIDEST) / _WIDEST) ** 0.5:.2f}%"


def _row(bar: Bar, marks: Mapping[str, Mark], limits: tuple[float, float]) -> str:
    status, kind = bar.verdict.status, bar.verdict.status.replace(" ", "-")
    why, link, picture = joint_reason(bar.joint, bar.verdict.reasons), "", ""
    if bar.error is not None:
        picture = _picture(bar, bar.error, marks, limits)
    if bar.why:
        link = f' <a href="#{bar.why}" aria-label="why, of {escape(bar.joint)}">why</a>'
    return (
        f'<li class="{kind}"><a class="code" href="#{bar.link}">{code(bar.joint).html}</a>'
        f'{picture}<span class="number">{percent(bar.error).html} %</span><strong>{status}</strong>'
        f'<span class="why">{escape(why)}{link}</span></li>\n'
    )


def _picture(bar: Bar, error: float, marks: Mapping[str, Mark], limits: tuple[float, float]) -> str:
    """Return the bar of a joint with the marks of the other predictions."""
    shown = {key: x for key in marks if (x := bar.others.get(key)) is not None}
    figures = [f"{marks[key].words} {percent(value).html} %" for key, value in shown.items()]
    title = f"{bar.joint}: {percent(error).html} % missed; by comparison {', '.join(figures)}"
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
