"""Residual analysis: torque components of each joint, and quantities that its residual follows."""

from html import escape

from robotid.diagnosis.residual.decisions import DEPENDENCE_SHARE
from robotid.diagnosis.residual.torque_split import JointTorque
from robotid.identification.result import TorqueIdentification
from robotid.output.pages.charts import Chart, chart_html
from robotid.output.pages.html import Cell, code, folded, number, percent, table, text
from robotid.output.report.pictures import why_charts

_POINTS = 300  # of a chart
_ALL_POINTS = 1800  # of one chart, summed over the joints
_FEWEST_POINTS = 100
_STILL, _STILL_SPLIT = 30, 80  # points in print
_MOST = 12  # joints with all charts; others have charts of significant dependences only


def why_section(found: TorqueIdentification) -> str:
    """Return the HTML of the section: a part for each joint, the worst joint first and open."""
    torques = sorted(found.joint_torques, key=_error, reverse=True)
    shown = ", ".join(torques[0].rows.recordings)
    kind = "Validation logs" if torques[0].fitted is not None else "Fitted logs, without validation"
    points = max(_FEWEST_POINTS, min(_POINTS, _ALL_POINTS // len(torques)))
    names = [e.name for e in found.validation or found.fitted]
    first = torques[0].rows.recordings[0]
    link = f"recording {names.index(first)}" if first in names else "fitted"  # as torques_section
    joints = "".join(
        folded(
            f"why-{found.model.row_names.index(torque.joint)}",
            f"<strong>{code(torque.joint).html}</strong>: {escape(torque.sentence)}",
            _joint(torque, link, points, is_full=k < _MOST),
            is_open=k == 0,
        )
        for k, torque in enumerate(torques)
    )
    return (
        "<p>The torque of each joint as sum of its components, and the quantities that its "
        f"residual follows. {kind}: {escape(shown)}. A residual follows a quantity if the mean "
        "residual in bins of this quantity, computed without a segment of the recording, explains "
        f"a significant share of the residual in that segment.</p>\n{joints}"
    )


def _error(torque: JointTorque) -> float:
    """Return the RMS residual over the RMS torque; -1 if there is no torque."""
    rms = torque.rms
    return rms["residual"] / rms["measured"] if rms["measured"] > 0 else -1.0


def _joint(torque: JointTorque, link: str, points: int, *, is_full: bool) -> str:
    """Return table and charts of a joint: all charts, or those of significant dependences."""
    if not torque.used.any():
        return ""
    charts = why_charts(torque, link=link, points=points)
    caption = "Torque components, stacked; shaded: samples not used"
    split = _chart(charts.pop("split"), caption, _STILL_SPLIT)
    significant = {d.name for d in torque.follows if d.is_significant}
    small = "".join(
        _chart(chart, _caption(torque, name))
        for name, chart in charts.items()
        if is_full or name in significant
    )
    return f'{_parts(torque)}{split}<div class="plots">\n{small}</div>\n'


def _chart(chart: Chart, caption: str, still: int = _STILL) -> str:
    return chart_html(chart, caption, points=2 * len(chart.x), still=still)


def _caption(torque: JointTorque, name: str) -> str:
    if name == "power" and torque.power is not None:
        used = torque.power[torque.used]
        return f"Mechanical power: mean {used.mean():.3g} W, peak {abs(used).max():.3g} W".replace(
            "-", "−"
        )
    (dependence,) = (d for d in torque.follows if d.name == name)
    share = percent(100 * (dependence.share or 0.0)).html
    result = "no dependence"
    if dependence.share is None:
        result = "too few samples"
    elif dependence.is_significant:
        result = f"<strong>explains {share} % of the variance</strong>"
    elif dependence.share >= DEPENDENCE_SHARE:
        result = f"explains {share} % of the variance, not significant"
    return f"Residual against {name}: {result}"


def _parts(torque: JointTorque) -> str:
    """Return the table of torque components."""
    rms = torque.rms
    whole, parts = rms["measured"], torque.present
    cells = [
        [
            text(name),
            number(rms[name], ".3g"),
            percent(100 * rms[name] / whole if whole else None),
            _terms(torque, name),
        ]
        for name in (*sorted(parts, key=lambda name: -rms[name]), "residual")
    ]
    foot = [text("measured"), number(whole, ".3g"), percent(100.0), Cell("")]
    headers = ["component", f"RMS {torque.unit}", "% of torque", "terms, RMS"]
    return table(f"{torque.joint}: torque components, which may cancel", headers, cells, foot)


def _terms(torque: JointTorque, part: str) -> Cell:
    """Return the terms of a component that has more than one."""
    sizes = {name: torque.size(x) for name, x in torque.terms.get(part, {}).items()}
    if len(sizes) < 2:
        return Cell("")
    own = f"{torque.joint}."
    return Cell(", ".join(f"{escape(x.removeprefix(own))} {sizes[x]:.3g}" for x in sizes))
