"""The report's sections with plots, as HTML: residuals, friction, parameters, excitation."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.findings import listed
from robotid.identification.bands import REACH, FrictionCurve, friction_curve
from robotid.identification.drive_choice import DriveChoice
from robotid.identification.evaluation import Evaluation
from robotid.identification.information import Information, information
from robotid.identification.pipeline import Identification
from robotid.pages.html import code, figure, number, table, text
from robotid.regressor.memory import drive_motion_along
from robotid.report.residuals import autocorrelation, friction_split, spectrum
from robotid.report.svg import (
    INK,
    PREDICTED,
    RESIDUAL,
    drawing,
    legend,
    plain_decades,
    svg_element,
)

__all__ = ["body_figures", "drive_figures", "information_section", "residual_section"]

_DOTS = 1200  # of one friction plot
_LAGS = 400  # points of one autocorrelation
_LONGEST_LAG = 2.0  # [s]
_PAIRS = 15  # strongest correlations that are listed
_STRONG = 0.8  # a correlation worth naming
_CURVE = 60  # points of a friction curve on each side
_CELL = 11  # [px] of the correlation matrix
_STEPS = 8  # shades of each sign in it


def residual_section(found: Identification) -> str:
    """Return spectrum and autocorrelation of each joint's residual.

    Args:
        found: The identification.
    """
    evaluation = _shown(found)
    if found.model.is_static:
        return "<p>Stands and slow stretches are no signal that has a spectrum.</p>\n"
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
    terms = dict.fromkeys(term.name for _, term in layout.drive_parameters)
    bars = "".join(_drive_figure(found, term) for term in terms)
    choice = "".join(_choice(found, drive) for drive in found.drives)
    if choice:
        choice = (
            "<h3>Which friction the logs show</h3>\n<p>Beside viscous and Coulomb friction, for "
            "each joint: the error of stretches that were held out of the fit, and how likely they "
            f"gain that much by chance.</p>\n{choice}"
        )
    curves = ""
    is_static = found.model.is_static  # it knows no speeds
    if not is_static and not all(term.is_inertia for _, term in layout.drive_parameters):
        curves = (
            "<h3>Friction against speed</h3>\n<p>Torque that inertia, gravity and armature leave, "
            f"on {escape(_shown(found).recording.name)}, and the friction and offset identified. "
            "Dots that bend away from the blue ones ask for another friction model; what is beyond "
            "chance is among the warnings and notes. The line is the friction of steady motion, "
            "with the 95 % band of its parameters.</p>\n"
            f'<div class="plots">\n{_friction_figures(found)}</div>\n'
        )
    return f'{curves}{choice}<h3>Values</h3>\n<div class="plots">\n{bars}</div>\n'


def body_figures(found: Identification) -> str:
    """Return the inertial parameters of each body with error bars, beside the URDF's.

    Args:
        found: The identification.
    """
    figures = []
    for i, body in enumerate(found.model.layout.bodies):
        title = f"Parameters of {body} with error bars, beside the URDF's"
        svg = svg_element(_plot_body(found, i), title, f"body{i}")
        figures.append(figure(f"<strong>{escape(body)}</strong>", svg))
    return f'<div class="plots">\n{"".join(figures)}</div>\n'


def information_section(found: Identification) -> str:
    """Return how much the data say: singular values, shares, correlations.

    Args:
        found: The identification.
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
    plot = _plot_singular(said.singular_values, found.wls.rank)
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
    plot = _plot_residual(density, torque, correlation, step * dt, cutoff=cutoff, unit=unit)
    caption = f"<strong>{escape(name)}</strong>: correlation {falls}"
    return figure(caption, svg_element(plot, title, f"residual{row}"))


def _period(t: Array, segment: Array) -> float:
    """Return the median sample period within the stretches [s]."""
    return float(np.median(np.diff(t)[np.diff(segment) == 0]))


def _friction_figures(found: Identification) -> str:
    evaluation, model = _shown(found), found.model
    motion = evaluation.recording.trajectory
    left, friction = friction_split(model, evaluation, found.standard)
    loads = drive_motion_along(model, motion).load if model.layout.remembering else None
    figures = []
    for row, (name, unit) in enumerate(zip(model.row_names, model.row_units, strict=True)):
        rows = np.flatnonzero(evaluation.recording.mask[:, row])
        rows = rows[:: max(1, -(-len(rows) // _DOTS))]
        if not len(rows):
            figures.append(f"<p>{escape(name)}: no rows used.</p>\n")
            continue
        v, q = motion.v[rows, row], float(np.median(motion.q[rows, row]))
        units = ("m/s" if unit == "N" else "rad/s", unit)
        load = 0.0
        if loads is not None and any(x.name == "load" for x in model.layout.own.get(name, ())):
            load = float(np.sqrt(np.mean(loads[row, rows] ** 2)))
        side = np.linspace(np.abs(v).min(), np.abs(v).max(), _CURVE)
        curve = friction_curve(found, name, np.append(-side[::-1], side), q=q, load=load)
        plot = _plot_friction(v, left[rows, row], friction[rows, row], curve, units=units)
        title = f"Friction of {name} against speed, measured and identified"
        svg = svg_element(plot, title, f"friction{row}")
        figures.append(figure(f"<strong>{escape(name)}</strong>", svg))
    return "".join(figures)


def _choice(found: Identification, drive: DriveChoice) -> str:
    """Return what friction of a joint was tried, what was taken, and its shapes."""
    taken = " + ".join(drive.families) or "nothing more"
    shapes = [
        f"{shape.name} = {shape.value:.3g} ± {shape.std_error:.2g} {shape.unit}"
        + (" (at its bound)" if shape.is_at_bound else "")
        for shape in drive.shapes
    ]
    said = f"{drive.joint}: {taken}" + (f"; {listed(shapes)}" if shapes else "")
    rows = [
        [
            text(" + ".join(tried.families) or "viscous and Coulomb"),
            number(tried.held_out_error_pct, ".2f"),
            number(tried.chance, ".1e") if tried.families else text(""),
            text("taken" if tried.is_taken else ""),
        ]
        for tried in drive.tried
    ]
    headers = ["terms", "held-out error %", "chance", ""]
    return f"<details><summary>{escape(said)}</summary>{table(said, headers, rows)}</details>\n"


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
            figure(label, svg_element(_plot_drives(found, part, label), title, f"{term}{k}"))
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
    image = _correlation_map(said.correlation, names, title=title, key="correlation")
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


def _plot_body(found: Identification, i: int) -> Any:  # noqa: ANN401
    """Draw one body's parameters with bars, beside the URDF's, in units of the prior's spread."""
    part = np.arange(10 * i, 10 * i + 10)
    spread = found.prior_std[part]
    scale = np.where(spread > 0, spread, 1.0)
    y = np.arange(10)
    with drawing(2.7) as figure:
        axes = figure.subplots()
        axes.plot(found.prior[part] / scale, y - 0.18, "o", mfc="none", mec=INK, ms=4.5,
                  label="URDF")  # fmt: skip
        _draw_identified(axes, found, part, y + 0.18, scale)
        axes.set_yticks(y, [found.model.layout.names[k].rsplit(".", 1)[1] for k in part])
        axes.set_xlabel("value in units of the prior's assumed spread")
        axes.invert_yaxis()
        axes.grid(visible=True, axis="x")
        legend(axes, 0.98)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.91, bottom=0.16)
    return figure


def _plot_drives(found: Identification, part: NDArray[np.int_], label: str) -> Any:  # noqa: ANN401
    """Draw one term of k drives with bars, their prior and its spread; part has shape (k,)."""
    prior, value, spread = (x[part] for x in (found.prior, found.standard, found.prior_std))
    y, height = np.arange(len(part)), 0.75 + 0.26 * len(part)
    with drawing(height) as figure:
        axes = figure.subplots()
        axes.barh(y, 2 * spread, left=prior - spread, height=0.7, color=INK, alpha=0.1,
                  label="prior ± spread")  # fmt: skip
        axes.plot(prior, y, "|", color=INK, ms=8)
        bars = _draw_identified(axes, found, part, y)
        # a prior that says next to nothing must not press the values into a point
        low, high = np.min([value - bars, prior], axis=0), np.max([value + bars, prior], axis=0)
        margin = 0.08 * max(float(high.max() - low.min()), 1e-12)
        axes.set_xlim(float(low.min()) - margin, float(high.max()) + margin)
        axes.set_yticks(y, [found.model.layout.names[k].rsplit(".", 1)[0] for k in part])
        axes.set_xlabel(label)
        axes.invert_yaxis()
        axes.grid(visible=True, axis="x")
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0, handlelength=1.2
        )
        figure.subplots_adjust(left=0.3, right=0.98, top=1.0 - 0.24 / height, bottom=0.42 / height)
    return figure


def _plot_residual(
    density: tuple[Array, Array],
    torque: tuple[Array, Array],
    correlation: Array,
    dt: float,
    *,
    cutoff: float | None,
    unit: str,
) -> Any:  # noqa: ANN401
    """Draw amplitude spectra (frequencies [Hz], density [unit^2/Hz]) beside an autocorrelation."""
    highest = np.inf if cutoff is None else 2.0 * cutoff
    with drawing(2.4) as figure:
        left, right = figure.subplots(1, 2)
        for (f, S), colour, label in ((torque, INK, "torque"), (density, RESIDUAL, "residual")):
            shown = (f > 0) & (f <= highest) & (S > 0)
            alpha = 0.6 if colour == INK else 1.0
            left.semilogy(
                f[shown], np.sqrt(S[shown]), color=colour, alpha=alpha, lw=1.0, label=label
            )
        if cutoff is not None:
            left.axvline(cutoff, color=INK, lw=0.6, ls=":")
        plain_decades(left)
        left.set(xlabel="frequency [Hz]", ylabel=f"density [{unit}/√Hz]")
        legend(left, 0.96)
        right.plot(dt * np.arange(len(correlation)), correlation, color=RESIDUAL, lw=1.0)
        right.axhline(0.0, color=INK, lw=0.5)
        if cutoff is not None:
            right.axvline(1.0 / (2.0 * cutoff), color=INK, lw=0.6, ls=":")
        right.set(xlabel="lag [s]", ylabel="autocorrelation", ylim=(-1.05, 1.05))
        for axes in (left, right):
            axes.grid(visible=True)
            axes.margins(x=0.01)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.89, bottom=0.2, wspace=0.28)
    return figure


def _plot_friction(
    v: Array,
    left: Array,
    friction: Array,
    curve: FrictionCurve,
    *,
    units: tuple[str, str],
) -> Any:  # noqa: ANN401
    """Draw the torque that inertia and gravity leave, the friction found, (M,) each, its curve."""
    with drawing(2.4, simplify=False) as figure:
        axes = figure.subplots()
        # a path of dots is a tenth of the size of as many markers
        for y, colour, width, alpha, label in (
            (left, INK, 1.6, 0.4, "torque left"),
            (friction, PREDICTED, 2.2, 1.0, "identified"),
        ):
            x = np.column_stack([v, v, np.full(len(v), np.nan)]).ravel()
            dots = np.column_stack([y, y, np.full(len(y), np.nan)]).ravel()
            axes.plot(x, dots, color=colour, alpha=alpha, lw=width, solid_capstyle="round")
            axes.plot([], [], "o", ms=width + 1, color=colour, alpha=alpha, label=label)
        load = f" at {curve.load:.3g} {units[1]} of load" if curve.load else ""
        label = f"steady{load}, 95 % band"
        for half in (curve.v < 0, curve.v > 0):
            low, high = (curve.torque[half] + s * REACH * curve.std[half] for s in (-1.0, 1.0))
            axes.fill_between(curve.v[half], low, high, color=RESIDUAL, alpha=0.3, lw=0.0)
            axes.plot(curve.v[half], curve.torque[half], color=RESIDUAL, lw=1.0)
        axes.plot([], [], color=RESIDUAL, lw=1.0, label=label)
        axes.axhline(0.0, color=INK, lw=0.5)
        axes.set(xlabel=f"speed [{units[0]}]", ylabel=f"friction [{units[1]}]")
        axes.grid(visible=True)
        legend(axes, 0.96)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.89, bottom=0.2)
    return figure


def _plot_singular(values: Array, rank: int) -> Any:  # noqa: ANN401
    """Draw singular values, largest first; those that the data leave open in another colour."""
    number = np.arange(1, len(values) + 1)
    floor = float(values.max()) * 1e-17
    with drawing(2.2) as figure:
        axes = figure.subplots()
        axes.semilogy(number[:rank], values[:rank], "o", color=PREDICTED, ms=3)
        axes.semilogy(number[rank:], np.maximum(values[rank:], floor), "x", color=RESIDUAL, ms=4)
        plain_decades(axes)
        axes.set(xlabel="number of the direction", ylabel="singular value")
        axes.grid(visible=True)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.96, bottom=0.21)
    return figure


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


def _draw_identified(
    axes: Any,  # noqa: ANN401
    found: Identification,
    part: NDArray[np.int_],
    y: Array,
    scale: Array | float = 1.0,
) -> Array:
    """Draw the identified values at heights y, with bars of two standard errors; return these."""
    error = found.standard_error[part]
    bars: Array = np.where(np.isfinite(error), 2 * error, 0.0) / scale
    axes.errorbar(
        found.standard[part] / scale, y, xerr=bars, fmt="o", color=PREDICTED, ms=4, lw=1.2,
        capsize=2.5, label="identified, ±2 standard errors",
    )  # fmt: skip
    return bars


def _cells(step: NDArray[np.int_], shade: int, margin: int) -> str:
    rows, columns = np.nonzero(np.tril(step, -1) == shade)
    path = "".join(
        f"M{margin + _CELL * j} {_CELL * i}h{_CELL - 1}v{_CELL - 1}h-{_CELL - 1}z"
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    colour = "var(--predicted)" if shade > 0 else "var(--residual)"
    return f'<path d="{path}" fill="{colour}" fill-opacity="{abs(shade) / _STEPS:.3f}"/>'
