"""Why each joint is predicted as it is: its torque in parts, and what its residual follows."""

from html import escape

from robotid.diagnosis.decisions import DEPENDENCE_SHARE
from robotid.diagnosis.torque_split import JointTorque, joint_torques
from robotid.identification.result import Identification
from robotid.identification.why_pictures import why_charts
from robotid.pages.charts import Chart, chart_html
from robotid.pages.html import Cell, code, folded, number, percent, table, text

__all__ = ["why_section"]

_POINTS = 300  # of a chart
_ALL_POINTS = 1800  # of one chart of every joint together
_FEWEST_POINTS = 100
_STILL, _STILL_SPLIT = 30, 80  # of them, in print
_MOST = 12  # joints with all their charts; others have those that say something


def why_section(found: Identification) -> str:
    """Return the HTML of the section: a part for each joint, the worst first and open.

    Args:
        found: The identification.
    """
    torques = sorted(joint_torques(found), key=_missed, reverse=True)
    shown = ", ".join(torques[0].rows.recordings)
    kind = "kept apart" if torques[0].fitted is not None else "fitted, for none was kept apart"
    points = max(_FEWEST_POINTS, min(_POINTS, _ALL_POINTS // len(torques)))
    names = [e.recording.name for e in found.validation or found.fitted]
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
        "<p>The torque of each joint, split into what it consists of, and what its residual "
        f"follows. Of the recordings {kind}: {escape(shown)}. A residual follows a quantity if its "
        "mean over bins of it, without a segment of the recording, explains more of that segment "
        f"than chance does.</p>\n{joints}"
    )


def _missed(torque: JointTorque) -> float:
    """Return the residual over the torque; of what does not move -1."""
    rms = torque.rms
    return rms["residual"] / rms["measured"] if rms["measured"] > 0 else -1.0


def _joint(torque: JointTorque, link: str, points: int, *, is_full: bool) -> str:
    """Return table and charts of a joint, all or those alone that say what its residual follows."""
    if not torque.used.any():
        return ""
    charts = why_charts(torque, link=link, points=points)
    said = "Torque in parts, stacked; shaded: rows not used"
    split = _chart(charts.pop("split"), said, _STILL_SPLIT)
    sure = {d.name for d in torque.follows if d.is_significant}
    small = "".join(
        _chart(chart, _caption(torque, name))
        for name, chart in charts.items()
        if is_full or name in sure
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
    said = "explains nothing"
    if dependence.share is None:
        said = "too little was recorded to tell"
    elif dependence.is_significant:
        said = f"<strong>explains {share} % of its variance</strong>"
    elif dependence.share >= DEPENDENCE_SHARE:
        said = f"explains {share} %, perhaps by chance"
    return f"Residual against {name}: {said}"


def _parts(torque: JointTorque) -> str:
    """Return the table of what the torque consists of."""
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
    headers = ["part", f"rms {torque.unit}", "% of torque", "its terms, rms"]
    return table(
        f"{torque.joint}: what its torque consists of; parts may cancel", headers, cells, foot
    )


def _terms(torque: JointTorque, part: str) -> Cell:
    """Return the terms of a part that has more than one."""
    sizes = {name: torque.size(x) for name, x in torque.terms.get(part, {}).items()}
    if len(sizes) < 2:
        return Cell("")
    own = f"{torque.joint}."
    return Cell(", ".join(f"{escape(x.removeprefix(own))} {sizes[x]:.3g}" for x in sizes))
