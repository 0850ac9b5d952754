"""The report's sections that look behind the errors: residuals, friction, excitation."""

from collections.abc import Sequence
from html import escape

import numpy as np

from robotid._html import code, figure, number, table
from robotid._typing import Array
from robotid.identification.evaluation import Evaluation
from robotid.identification.information import Information, information
from robotid.identification.pipeline import Identification
from robotid.report.plots import (
    correlation_map,
    plot_drives,
    plot_friction,
    plot_residual,
    plot_singular,
)
from robotid.report.residuals import autocorrelation, friction_split, spectrum
from robotid.report.svg import svg_element

__all__ = [
    "drive_figures",
    "information_section",
    "residual_section",
]

_DOTS = 1200  # of one friction plot
_LAGS = 400  # points of one autocorrelation
_LONGEST_LAG = 2.0  # [s]
_PAIRS = 15  # strongest correlations that are listed
_STRONG = 0.8  # a correlation worth naming


def residual_section(found: Identification) -> str:
    """Return spectrum and autocorrelation of each joint's residual.

    Args:
        found: The identification.

    Returns:
        HTML.
    """
    evaluation = _shown(found)
    figures = "".join(
        _residual_figure(evaluation, row, name, unit)
        for row, (name, unit) in enumerate(
            zip(found.model.row_names, found.model.row_units, strict=True)
        )
    )
    return (
        f"<p>Of {escape(evaluation.recording.name)}, rows used. Left: the residual's spectrum "
        "under that of the torque; a peak is a vibration or a ripple that the model lacks. Right: "
        "its autocorrelation; noise behind the filter falls to zero within the dotted time, "
        "1/(2 cut-off). What stays longer is motion that the model does not explain. The dotted "
        "frequency is the cut-off.</p>\n"
        f'<div class="plots">\n{figures}</div>\n'
    )


def drive_figures(found: Identification) -> str:
    """Return the friction curves of the joints and bars of the drive parameters.

    Args:
        found: The identification.

    Returns:
        HTML; nothing if no drive parameter was identified.
    """
    layout = found.model.layout
    if not layout.drive_names:
        return ""
    bars = "".join(_drive_figure(found, term) for term in layout.terms)
    curves = ""
    if not all(term.is_inertia for _, term in layout.drive_parameters):
        curves = (
            "<h3>Friction against speed</h3>\n<p>Torque that inertia, gravity and armature leave, "
            f"on {escape(_shown(found).recording.name)}, and the friction and offset identified. "
            "Dots that bend away from the blue ones ask for another friction model.</p>\n"
            f'<div class="plots">\n{_friction_figures(found)}</div>\n'
        )
    return f'{curves}<h3>Values</h3>\n<div class="plots">\n{bars}</div>\n'


def information_section(found: Identification) -> str:
    """Return how much the data say: singular values, shares, correlations.

    Args:
        found: The identification.

    Returns:
        HTML.
    """
    said, names = information(found), found.mapping.base_names
    shares = np.round(100 * said.data_share).astype(int)
    weak = [
        [code(names[i]), number(float(said.data_share[i]) * 100, ".1f")]
        for i in np.argsort(said.data_share, kind="stable")
        if said.data_share[i] < 0.99
    ]
    known = (
        table(
            "Base parameters that the data settle by less than 99 %, the weakest first",
            ["parameter", "share of the data %"],
            weak,
        )
        if weak
        else "<p>The data settle every base parameter by 99 % or more.</p>\n"
    )
    title = "Singular values of the regressor, columns scaled to unit norm"
    plot = plot_singular(said.singular_values, found.wls.rank)
    singular = svg_element(plot, title, "singular")
    return (
        f"<p>Condition number {found.wls.condition:.3g}; singular values from "
        f"{said.singular_values[0]:.3g} to {said.singular_values[-1]:.2g}. Of what is known about "
        f"the base parameters the data give {shares.mean():.0f} % in the mean and {shares.min()} "
        "% of the weakest, the URDF the rest: S²/(S² + s²) with the spread S assumed before the "
        "fit and the standard error s of WLS.</p>\n"
        f"{figure(title, singular, single=True)}{known}" + _correlations(said, names)
    )


def _shown(found: Identification) -> Evaluation:
    """Return the recording that is looked into: the first one that was not fitted."""
    return (found.validation or found.fitted)[0]


def _residual_figure(e: Evaluation, row: int, name: str, unit: str) -> str:
    trajectory, used = e.recording.trajectory, e.recording.mask[:, row].astype(bool)
    residual = trajectory.tau[:, row] - e.torques["estimate"][:, row]
    dt = _period(trajectory.t, trajectory.segment)
    density = spectrum(residual, used, trajectory.segment, dt)
    if not len(density[0]):
        return f"<p>{escape(name)}: no rows used.</p>\n"
    torque = spectrum(trajectory.tau[:, row], used, trajectory.segment, dt)
    lags = max(1, min(int(_LONGEST_LAG / dt), len(residual) // 2))
    step = max(1, lags // _LAGS)
    correlation = autocorrelation(residual, used, trajectory.segment, lags)[::step]
    inside = np.flatnonzero(np.abs(correlation) < 0.2)
    falls = f"falls below 0.2 after {step * dt * inside[0]:.2g} s" if len(inside) else "stays high"
    title = f"Spectrum and autocorrelation of the residual of {name}, which {falls}"
    cutoff = e.recording.signals.cutoff
    plot = plot_residual(density, torque, correlation, step * dt, cutoff=cutoff, unit=unit)
    caption = f"<strong>{escape(name)}</strong>: correlation {falls}"
    return figure(caption, svg_element(plot, title, f"residual{row}"))


def _period(t: Array, segment: Array) -> float:
    """Return the median sample period within the stretches [s]."""
    return float(np.median(np.diff(t)[np.diff(segment) == 0]))


def _friction_figures(found: Identification) -> str:
    evaluation, model = _shown(found), found.model
    left, friction = friction_split(model, evaluation, found.standard)
    figures = []
    for row, (name, unit) in enumerate(zip(model.row_names, model.row_units, strict=True)):
        rows = np.flatnonzero(evaluation.recording.mask[:, row])
        rows = rows[:: max(1, -(-len(rows) // _DOTS))]
        if not len(rows):
            figures.append(f"<p>{escape(name)}: no rows used.</p>\n")
            continue
        v = evaluation.recording.trajectory.v[rows, row]
        units = ("m/s" if unit == "N" else "rad/s", unit)
        plot = plot_friction(v, left[rows, row], friction[rows, row], units=units)
        title = f"Friction of {name} against speed, measured and identified"
        svg = svg_element(plot, title, f"friction{row}")
        figures.append(figure(f"<strong>{escape(name)}</strong>", svg))
    return "".join(figures)


def _drive_figure(found: Identification, term: str) -> str:
    """Return the bars of one drive term; drives of another unit have bars of their own."""
    layout = found.model.layout
    figures = []
    chosen = [i for i, name in enumerate(layout.names) if name.endswith(f".{term}")]
    for k, unit in enumerate(dict.fromkeys(layout.units[i] for i in chosen)):
        part = np.array([i for i in chosen if layout.units[i] == unit])
        label = f"{term} [{unit}]"
        title = f"{term} of each drive with error bars, beside the value before the fit"
        figures.append(
            figure(label, svg_element(plot_drives(found, part, label), title, f"{term}{k}"))
        )
    return "".join(figures)


def _correlations(said: Information, names: Sequence[str]) -> str:
    r = np.where(np.isfinite(said.correlation), said.correlation, 0.0)
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
    image = correlation_map(said.correlation, names, title=title, key="correlation")
    caption = "Blue: errors rise together; orange: one rises as the other falls; full colour at 1."
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
        "<h3>Correlation of errors</h3>\n<p>Two parameters whose errors are correlated near ±1 are "
        "known as a sum or a difference only: the motion does not tell them apart.</p>\n"
        f"{listed}{figure(caption, image)}"
    )
