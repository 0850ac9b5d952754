"""The report's first screen: verdict, errors by joint, what was found, what to do next."""

from collections.abc import Mapping
from html import escape

from robotid.fitting.identified import SOURCES
from robotid.fitting.metrics import JointMetrics
from robotid.identification.result import Identification
from robotid.identification.summary import joint_reason
from robotid.judgement.verdict import GOOD, POOR, JointVerdict
from robotid.pages.html import code, facts_html, percent, steps_html, verdict_html
from robotid.report.advice import Origin, next_steps

__all__ = ["DETERMINED", "joint_errors", "summary_screen"]

#: In words, what determined a parameter.
DETERMINED = {
    "data": "motion",
    "mixed": "motion and prior",
    "prior": "prior",
    "bound": "at its bound",
}
_ROWS = 10  # joints whose errors are seen at once
_WIDEST = 150.0  # [%] at the end of the scale; what is beyond stands there
_TICKS = (1.0, 5.0, GOOD, POOR, 100.0, _WIDEST)  # [%] of the scale
#: Other predictions of the same torque, each with its mark: a path about (0, 9) and its style.
_OTHERS = {
    "wls": ("WLS", "M-5 -1h10l-5 6z", "fill"),
    "urdf_with_drives": ("URDF + drives", "M-5 19h10l-5 -6z", "fill"),
    "gravity_only": ("gravity only", "M-3 6l6 6m0 -6l-6 6", "line"),
    "urdf": ("URDF", "M0 0v18", "line"),
}


def summary_screen(found: Identification, origin: Origin, files: Mapping[str, str]) -> str:
    """Return the HTML of the first screen.

    Args:
        found: The identification.
        origin: Where it came from, for commands.
        files: Files beside the report, by what they are.
    """
    verdict = found.verdict
    steps = [(step.words, step.blocks) for step in next_steps(found, origin)]
    return (
        f"{verdict_html(found.model.name, verdict.status, verdict.reasons)}{_facts(found, files)}"
        f'<div class="halves">\n<div>{_bars(found)}</div>\n<div>{steps_html(steps)}</div>\n'
        "</div>\n"
    )


def joint_errors(found: Identification) -> dict[str, tuple[JointMetrics, float | None]]:
    """Return by joint how it is predicted on the kept recording where it is worst, and by WLS [%].

    Without a kept recording, how it is fitted.

    Args:
        found: The identification.

    Returns:
        The joints that move, the worst first.
    """
    kept = [e for e in found.validation if not e.is_refitted]
    pairs = [(e.metrics["estimate"], e.metrics["wls"]) for e in kept]
    errors: dict[str, tuple[JointMetrics, float | None]] = {}
    for metrics, wls in pairs or [(found.metrics(), found.metrics("wls"))]:
        for joint, measured in metrics.per_joint.items():
            if joint not in errors or _size(measured) > _size(errors[joint][0]):
                errors[joint] = measured, wls.per_joint[joint].relative_error_pct
    return dict(sorted(errors.items(), key=lambda item: -_size(item[1][0])))


def _size(measured: JointMetrics) -> float:
    value = measured.relative_error_pct
    return float("inf") if value is None else value


def _facts(found: Identification, files: Mapping[str, str]) -> str:
    before, after, _ = found.witness.masses
    change = f" ({100 * (after / before - 1):+.0f} %)".replace("-", "−") if before > 0 else ""
    counts = {kind: found.sources.count(kind) for kind in SOURCES}
    total = len(found.sources)
    shares = "".join(
        f'<i class="{kind}" style="flex: {count}"></i>' for kind, count in counts.items() if count
    )
    words = ", ".join(f"{count} {DETERMINED[kind]}" for kind, count in counts.items() if count)
    facts = {
        "Total mass": f"<strong>{before:.2f} → {after:.2f} kg</strong>{change}",
        "Base parameters determined": (
            f"<strong>{found.determination.rank} of {len(found.base)}</strong>, condition number "
            f"{found.wls.condition:.3g}"
        ),
        f"{total} parameters, determined by": f'<span class="shares">{shares}</span>{words}',
    }
    return facts_html(facts, files)


def _bars(found: Identification) -> str:
    errors, verdicts = joint_errors(found), found.verdict.joints
    alone = "" if len(found.predictions) != 1 else f" on {next(iter(found.predictions))}"
    still = {joint: None for joint in verdicts if joint not in errors}
    rows = [
        _row(found.model.row_names.index(joint), joint, errors.get(joint), verdicts[joint], alone)
        for joint in [*errors, *still]
    ]
    kind = "not fitted" if found.predictions else "fitted rows, for no recording was kept apart"
    more = "".join(rows[_ROWS:])
    if more:
        title = f"{len(rows) - _ROWS} more joints, which are predicted better"
        more = f"<details><summary>{title}</summary><ol>{more}</ol></details>\n"
    return (
        '<h2 id="worst">Torque missed, worst joint first <span class="note">100 |τ − prediction| / '
        f"|τ|, {kind}</span></h2>\n{_legend()}"
        f'<ol class="bars">{"".join(rows[:_ROWS])}</ol>\n{more}'
    )


def _at(value: float) -> str:
    """Return where an error stands on the scale, whose root is linear."""
    return f"{100 * (min(value, _WIDEST) / _WIDEST) ** 0.5:.2f}%"


def _row(
    row: int,
    joint: str,
    measured: tuple[JointMetrics, float | None] | None,
    verdict: JointVerdict,
    alone: str,
) -> str:
    """Return the row of a joint; the one recording that was kept apart need not be named."""
    status, kind = verdict.status, verdict.status.replace(" ", "-")
    picture, said, link = "", percent(None), ""
    why = joint_reason(joint, verdict.reasons)
    why = why.replace(alone, "") if alone else why
    if measured is not None:
        metrics, wls = measured
        said = percent(metrics.relative_error_pct)
        picture = _picture(row, joint, metrics, wls)
        link = f' <a href="#why-{row}" aria-label="why, of {escape(joint)}">why</a>'
    return (
        f'<li class="{kind}"><a class="code" href="#torque-{row}">{code(joint).html}</a>'
        f'{picture}<span class="number">{said.html} %</span><strong>{status}</strong>'
        f'<span class="why">{escape(why)}{link}</span></li>\n'
    )


def _picture(row: int, joint: str, measured: JointMetrics, wls: float | None) -> str:
    """Return the bar of a joint with the marks of the other predictions."""
    others = {"wls": wls, **measured.baselines}
    shown = {key: others[key] for key in _OTHERS if others.get(key) is not None}
    figures = [f"{_OTHERS[key][0]} {percent(value).html} %" for key, value in shown.items()]
    error = percent(measured.relative_error_pct).html
    title = f"{joint}: {error} % missed; by comparison {', '.join(figures)}"
    lines = "".join(f'<line x1="{_at(x)}" x2="{_at(x)}" y1="-2" y2="18"/>' for x in (GOOD, POOR))
    marks = "".join(
        f'<svg x="{_at(value)}" overflow="visible" aria-hidden="true">{_mark(key)}</svg>'
        for key, value in shown.items()
        if value is not None
    )
    width = _at(_size(measured))
    return (
        f'<svg class="bar" height="18" role="img" aria-labelledby="bar{row}-title">'
        f'<title id="bar{row}-title">{escape(title)}</title><g class="limits">{lines}</g>'
        f'<rect y="4" width="{width}" height="10"/>{marks}</svg>'
    )


def _mark(key: str) -> str:
    _, path, style = _OTHERS[key]
    return f'<path class="{style}" d="{path}"/>'


def _legend() -> str:
    keys = "".join(
        f'<span><svg width="10" height="18" viewBox="-5 0 10 18" aria-hidden="true">{_mark(key)}'
        f"</svg>{words}</span>"
        for key, (words, _, _) in _OTHERS.items()
    )
    names = {GOOD: f"{GOOD:g} good", POOR: f"{POOR:g} usable", 100.0: "100", _WIDEST: "150 %"}
    scale = "".join(f'<span style="left: {_at(x)}">{names.get(x, f"{x:g}")}</span>' for x in _TICKS)
    return (
        f'<p class="legend">{keys}</p>\n<div class="scale" aria-hidden="true"><div>{scale}</div>'
        "</div>\n"
    )
