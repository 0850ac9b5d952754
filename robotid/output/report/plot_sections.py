"""The report's sections with plots, as HTML: residuals, friction, parameters, excitation."""

from collections.abc import Sequence
from dataclasses import replace
from html import escape

import numpy as np
from numpy.typing import NDArray

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.diagnosis.residual.residuals import friction_split
from robotid.estimation.fitting.selected_drives import DriveChoice
from robotid.identification.result import TorqueIdentification
from robotid.output.pages.charts import Chart, chart_html
from robotid.output.pages.html import code, figure, folded, number, table, text
from robotid.output.report.information_section import Information, information
from robotid.output.report.pictures import (
    friction_chart,
    parameter_charts,
    residual_charts,
    shown_evaluation,
    singular_chart,
)

_PAIRS = 15  # strongest correlations that are listed
_STRONG = 0.8  # smallest correlation that is listed
_CELL = 11  # [px] of the correlation matrix
_STEPS = 8  # shades of each sign in it
_STILL = 100  # points of a friction chart in print
_LOW = 130  # [px] height of a friction chart
_NARROW = 300  # [px] width of its static picture
_CURVES = 8  # friction charts that are not folded


def residual_section(found: TorqueIdentification) -> str:
    """Return spectrum and autocorrelation of each joint's residual."""
    if found.model.is_static:
        return "<p>Static poses and slow segments have no spectrum.</p>\n"
    figures = "".join(_residual_figures(found, row) for row in range(found.model.n_rows))
    name = escape(shown_evaluation(found).name)
    return (
        f"<p>Samples of {name} that are used. Left: spectra of residual and torque. A peak is a "
        "vibration or a ripple that the model does not contain. The dotted line is the filter's "
        "cut-off. Right: autocorrelation of the residual. Filtered noise falls to zero within the "
        "dotted time, 1/(2 cut-off). A slower decay indicates an effect of the motion that the "
        "model does not contain.</p>\n"
        f'<div class="plots">\n{figures}</div>\n'
    )


def friction_section(found: TorqueIdentification, worst: Sequence[str]) -> str:
    """Return friction against speed of each joint, measured and identified."""
    names, layout = found.model.row_names, found.model.layout
    if found.model.is_static or all(term.is_inertia for _, term in layout.drive_parameters):
        return ""
    first = names if len(names) <= _CURVES else [n for n in names if n in worst[:_CURVES]]
    figures = _friction_figures(found)
    shown = "".join(figures[name] for name in first)
    rest = "".join(figures[name] for name in names if name not in first)
    if rest:
        rest = f'<div class="plots small">\n{rest}</div>\n'
        count = len(names) - len(first)
        rest = folded("friction-more", f"{count} more joints with smaller errors", rest)
    log = escape(shown_evaluation(found).name)
    return (
        f"<p>Measured: torque minus inertia, gravity and armature, on {log}. Identified: friction "
        "and offset. Line: the friction at constant speed, with the 95 % band of its parameters. "
        "If the measured dots deviate systematically from the identified ones, the friction has "
        "another curve; significant deviations are findings.</p>\n"
        f'<div class="plots small">\n{shown}</div>\n{rest}'
    )


def drive_figures(found: TorqueIdentification) -> str:
    """Return the selection of friction terms and bars of the drive parameters."""
    layout = found.model.layout
    if not layout.drive_names:
        return ""
    terms = dict.fromkeys(term.name for _, term in layout.drive_parameters)
    bars = "".join(map(_parameter_figure, parameter_charts(found, tuple(terms))))
    choice = "".join(_choice(found, drive) for drive in found.drives)
    if choice:
        choice = (
            "<h3>Selection of friction terms</h3>\n<p>Terms in addition to viscous and Coulomb "
            "friction, for each joint: the error on held-out segments, and the p-value of its "
            f"decrease.</p>\n{choice}"
        )
    return f'{choice}<h3>Values</h3>\n<div class="plots">\n{bars}</div>\n'


def information_section(found: TorqueIdentification) -> str:
    """Return the information in the data: singular values, shares, correlations."""
    info, names = information(found), found.mapping.base_names
    shares = np.round(100 * info.data_share).astype(int)
    weak = [
        [code(names[i]), number(float(info.data_share[i]) * 100, ".1f")]
        for i in np.argsort(info.data_share, kind="stable")
        if info.data_share[i] < 0.99
    ]
    known = (
        table(
            "Base parameters that the data determine by less than 99 %, the weakest first",
            ["parameter", "share of data %"],
            weak,
        )
        if weak
        else "<p>The data determine every base parameter by 99 % or more.</p>\n"
    )
    singular = singular_chart(info.singular_values, found.wls.rank)
    return (
        f"<p>Condition number {found.wls.condition:.3g} (regressor, unit columns); singular values "
        f"from {info.singular_values[0]:.3g} to {info.singular_values[-1]:.2g}. The data determine "
        f"the base parameters by {shares.mean():.0f} % on average and the weakest by "
        f"{shares.min()} %, the URDF determines the rest: S²/(S² + s²) with the prior's "
        "spread S and the standard error s of WLS.</p>\n"
        f"{chart_html(singular, singular.title)}{known}" + _correlations(info, names)
    )


def _residual_figures(found: TorqueIdentification, row: int) -> str:
    name = escape(found.model.row_names[row])
    charts = residual_charts(found, shown_evaluation(found), row)
    if charts is None:
        return f"<p>{name}: no samples used.</p>\n"
    of_noise, r = charts[1].x, charts[1].series[0].y
    inside = np.flatnonzero(np.abs(r) < 0.2)
    falls = (
        f"falls below 0.2 after {of_noise[inside[0]]:.2g} s" if len(inside) else "does not decay"
    )
    captions = f"<strong>{name}</strong>: spectrum", f"<strong>{name}</strong>: correlation {falls}"
    return "".join(chart_html(*each) for each in zip(charts, captions, strict=True))


def _friction_figures(found: TorqueIdentification) -> dict[str, str]:
    """Return the friction chart of each joint."""
    split = friction_split(found.model, shown_evaluation(found), found.standard)
    figures = {}
    for joint in found.model.row_names:
        chart = friction_chart(found, joint, split=split)
        if chart is None:
            is_driven = joint in found.model.joints and joint not in found.model.passive
            why = "no samples used" if is_driven else "no drive"
            figures[joint] = f"<p>{escape(joint)}: {why}.</p>\n"
        else:
            caption = f"<strong>{escape(joint)}</strong>"
            drawn = replace(chart, height=_LOW, width=_NARROW)
            figures[joint] = chart_html(drawn, caption, still=_STILL)
    return figures


def _parameter_figure(chart: Chart) -> str:
    return chart_html(chart, f"<strong>{escape(chart.y_label.partition(' [')[0])}</strong>")


def _choice(found: TorqueIdentification, drive: DriveChoice) -> str:
    """Return the candidate friction terms of a joint, the selection, and its shape parameters."""
    selected = " + ".join(drive.families) or "no additional term"
    shapes = [
        f"{shape.name} = {shape.value:.3g} ± {shape.std_error:.2g} {shape.unit}"
        + (" (at its bound)" if shape.is_at_bound else "")
        for shape in drive.shapes
    ]
    title = f"{drive.joint}: {selected}" + (f"; {listed(shapes)}" if shapes else "")
    rows = [
        [
            text(" + ".join(tried.families) or "viscous and Coulomb"),
            number(tried.held_out_error_pct, ".2f"),
            number(tried.p_value, ".1e") if tried.families else text(""),
            text("selected" if tried.is_selected else ""),
        ]
        for tried in drive.tried
    ]
    headers = ["terms", "held-out error %", "p-value", ""]
    return f"<details><summary>{escape(title)}</summary>{table(title, headers, rows)}</details>\n"


def _correlations(info: Information, names: Sequence[str]) -> str:
    r = np.where(np.isfinite(info.correlation), info.correlation, 0.0)
    lower = np.abs(np.tril(r, -1))
    order = np.argsort(-lower, axis=None, kind="stable")[:_PAIRS]
    pairs = [(int(i), int(j)) for i, j in zip(*np.unravel_index(order, r.shape), strict=True)]
    rows = [
        [code(names[i]), code(names[j]), number(float(r[i, j]), ".3f")]
        for i, j in pairs
        if lower[i, j] >= _STRONG
    ]
    strong = int((lower >= _STRONG).sum())
    title = f"Correlation of the errors of {len(names)} base parameters; {strong} pairs above 0.8"
    image = _correlation_map(info.correlation, names, title=title, key="correlation")
    caption = "Blue: positive; orange: negative; full colour at ±1."
    listed = (
        table(
            f"The strongest of {strong} correlations of {_STRONG:g} and more",
            ["parameter", "and", "correlation"],
            rows,
        )
        if rows
        else f"<p>No two errors are correlated by {_STRONG:g} or more.</p>\n"
    )
    return (
        "<h3>Correlation of errors</h3>\n<p>The data determine only the sum or the difference of "
        "two parameters whose errors have a correlation near ±1.</p>\n"
        f"{listed}{figure(caption, image)}"
    )


def _correlation_map(correlation: Array, names: Sequence[str], *, title: str, key: str) -> str:
    """Return the lower triangle of a correlation matrix as a map of squares, with names."""
    size = len(names)
    margin = 12 + 6 * (max(len(name) for name in names) + 4)
    width, height = margin + _CELL * size + 4, _CELL * (size + 2)
    step = np.rint(np.where(np.isfinite(correlation), correlation, 0.0) * _STEPS).astype(int)
    parts = [
        _cells(step, shade, margin)
        for shade in range(-_STEPS, _STEPS + 1)
        if shade and bool((np.tril(step, -1) == shade).any())
    ]
    labels = "".join(
        f'<text x="{margin - 6}" y="{_CELL * (i + 1) - 2}" text-anchor="end">{escape(name)} '
        f"{i + 1}</text>"
        f'<text x="{margin + _CELL * i + 2}" y="{_CELL * (i + 1) - 2}">{i + 1}</text>'
        for i, name in enumerate(names)
    )
    return (
        f'<svg class="map" viewBox="0 0 {width} {height}" role="img" '
        f'aria-labelledby="{key}-title" style="min-width: {width}px; max-width: {width}px">'
        f'<title id="{key}-title">{escape(title)}</title>'
        f'<g fill="currentColor" font-size="9" stroke="none">{labels}</g>{"".join(parts)}</svg>'
    )


def _cells(step: NDArray[np.int_], shade: int, margin: int) -> str:
    rows, columns = np.nonzero(np.tril(step, -1) == shade)
    path = "".join(
        f"M{margin + _CELL * j} {_CELL * i}h{_CELL - 1}v{_CELL - 1}h-{_CELL - 1}z"
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    colour = "var(--predicted)" if shade > 0 else "var(--residual)"
    return f'<path d="{path}" fill="{colour}" fill-opacity="{abs(shade) / _STEPS:.3f}"/>'
