"""Why each joint is predicted as it is: its torque in parts, and what its residual follows."""

from html import escape

from robotid.identification.pipeline import Identification
from robotid.identification.torque_split import JointTorque, joint_torques
from robotid.identification.why_pictures import why_charts
from robotid.pages.charts import Chart, chart_html
from robotid.pages.html import Cell, code, number, percent, table, text

__all__ = ["why_section"]

_POINTS = 400  # of a chart
_ALL_POINTS = 2400  # of one chart of every joint together
_STILL = 60  # of them, in print


def why_section(found: Identification) -> str:
    """Return the HTML of the section: a part for each joint, the worst first and open.

    Args:
        found: The identification.
    """
    torques = sorted(joint_torques(found), key=_missed, reverse=True)
    shown = ", ".join(torques[0].rows.recordings)
    kind = "kept apart" if torques[0].fitted is not None else "fitted, for none was kept apart"
    points = max(100, min(_POINTS, _ALL_POINTS // len(torques)))
    joints = "".join(
        _joint(torque, found.model.row_names.index(torque.joint), points, is_open=k == 0)
        for k, torque in enumerate(torques)
    )
    return (
        "<p>The torque of each joint, split into what it consists of, and what its residual "
        f"follows. Of the recordings {kind}: {escape(shown)}. A residual follows a quantity if its "
        "mean over bins of it, without a stretch of the recording, explains more of that stretch "
        f"than chance does.</p>\n{joints}"
    )


def _missed(torque: JointTorque) -> float:
    """Return the residual over the torque; of what does not move -1."""
    rms = torque.rms
    return rms["residual"] / rms["measured"] if rms["measured"] > 0 else -1.0


def _joint(torque: JointTorque, row: int, points: int, *, is_open: bool) -> str:
    summary = f"<strong>{code(torque.joint).html}</strong>: {escape(torque.sentence)}"
    body = ""
    if torque.used.any():
        charts = why_charts(torque, points=points)
        split = _chart(charts.pop("split"), "Torque in parts, stacked; shaded: rows not used")
        small = "".join(_chart(chart, _caption(torque, name)) for name, chart in charts.items())
        body = f'{_parts(torque)}{split}<div class="plots">\n{small}</div>\n'
    opened = " open" if is_open else ""
    return f'<details id="why-{row}"{opened}><summary>{summary}</summary>\n{body}</details>\n'


def _chart(chart: Chart, caption: str) -> str:
    return chart_html(chart, caption, points=2 * len(chart.x), still=_STILL)


def _caption(torque: JointTorque, name: str) -> str:
    if name == "power" and torque.power is not None:
        used = torque.power[torque.used]
        return f"Mechanical power: mean {used.mean():.3g} W, peak {abs(used).max():.3g} W".replace(
            "-", "−"
        )
    (dependence,) = (d for d in torque.follows if d.name == name)
    said = "too few stretches to tell"
    if dependence.is_sure:
        said = f"<strong>explains {percent(100 * (dependence.share or 0.0)).html} % of it</strong>"
    elif dependence.share is not None:
        said = "explains no more than chance"
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
