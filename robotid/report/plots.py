"""The report's plots: figures of Matplotlib, in the report's style."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.identification.bands import REACH, TorqueBand
from robotid.identification.evaluation import Evaluation
from robotid.identification.pipeline import Identification
from robotid.report.svg import INK, PREDICTED, RESIDUAL, drawing, plain_decades

__all__ = [
    "correlation_map",
    "plot_body",
    "plot_drives",
    "plot_friction",
    "plot_residual",
    "plot_singular",
    "plot_torque",
    "stretches",
    "thin",
]

_CELL = 11  # [px] of the correlation matrix
_STEPS = 8  # shades of each sign in it


def plot_torque(
    evaluation: Evaluation, row: int, band: TorqueBand, *, unit: str, points: int = 2000
) -> Any:  # noqa: ANN401
    """Return a plot of measured against predicted torque, and of the residual below it.

    Lines are never joined across a gap of the recording. Where rows were not used, the ground is
    shaded and only the measured torque is drawn: the sign of friction is not known there.

    Args:
        evaluation: A recording with predictions.
        row: Number of the torque row.
        band: How far its predictions can be trusted; the residual's 95 % band is drawn.
        unit: Its unit.
        points: Longest line that is drawn; extremes are kept.

    Returns:
        A figure of Matplotlib.
    """
    trajectory = evaluation.recording.trajectory
    t, tau = trajectory.t, trajectory.tau[:, row]
    prediction = evaluation.torques["estimate"][:, row]
    used: NDArray[np.bool_] = evaluation.recording.mask[:, row].astype(bool)
    whole, kept = stretches(trajectory.segment), stretches(trajectory.segment, used)
    with drawing(3.3) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(5, 2))
        upper.plot(*thin(t, tau, whole, points), color=INK, alpha=0.6, lw=1.3, label="measured")
        upper.plot(*thin(t, prediction, kept, points), color=PREDICTED, lw=1.0, label="predicted")
        lower.plot(*thin(t, tau - prediction, kept, points), color=RESIDUAL, lw=0.8)
        lower.axhline(0.0, color=INK, lw=0.5)
        _draw_band(lower, t, whole, band, row)
        for axes in (upper, lower):
            _shade(axes, t, stretches(trajectory.segment, ~used))
            axes.grid(visible=True)
            axes.margins(x=0.01)
            axes.locator_params(axis="y", nbins=5)
        upper.set_ylabel(f"torque [{unit}]" if unit == "N m" else f"force [{unit}]")
        lower.set(xlabel="time [s]", ylabel=f"residual [{unit}]")
        _legend(upper, 0.98)
        figure.align_ylabels()
        figure.subplots_adjust(left=0.11, right=0.99, top=0.92, bottom=0.13, hspace=0.12)
    return figure


def plot_body(found: Identification, i: int) -> Any:  # noqa: ANN401
    """Return a plot of one body's parameters with error bars, beside those of the URDF.

    Each is drawn in units of the spread that its prior was assumed to have.

    Args:
        found: The identification.
        i: Number of the body.

    Returns:
        A figure of Matplotlib.
    """
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
        _legend(axes, 0.98)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.91, bottom=0.16)
    return figure


def plot_drives(found: Identification, part: NDArray[np.int_], label: str) -> Any:  # noqa: ANN401
    """Return a plot of one drive term over the drives, with bands, the prior and its spread.

    Args:
        found: The identification.
        part: Numbers of the k parameters, shape (k,).
        label: The term and its unit.

    Returns:
        A figure of Matplotlib.
    """
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


def plot_residual(
    density: tuple[Array, Array],
    torque: tuple[Array, Array],
    correlation: Array,
    dt: float,
    *,
    cutoff: float | None,
    unit: str,
) -> Any:  # noqa: ANN401
    """Return the amplitude spectrum of a residual beside its autocorrelation.

    Args:
        density: Frequencies [Hz] and power density of the residual [unit^2/Hz], shape (F,) each.
        torque: The same of the measured torque.
        correlation: Autocorrelation at lags 0, 1, ..., shape (L,).
        dt: Sample period [s].
        cutoff: Cut-off of the filter [Hz]; None if there is none.
        unit: Unit of the torque.

    Returns:
        A figure of Matplotlib.
    """
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
        _legend(left, 0.96)
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


def plot_friction(v: Array, left: Array, friction: Array, *, units: tuple[str, str]) -> Any:  # noqa: ANN401
    """Return the torque that inertia and gravity leave against speed, with the friction found.

    Args:
        v: Speed, shape (M,) [rad/s or m/s].
        left: Torque left, shape (M,) [N m or N].
        friction: Friction identified, shape (M,) [N m or N].
        units: Units of speed and torque.

    Returns:
        A figure of Matplotlib.
    """
    with drawing(2.4, simplify=False) as figure:
        axes = figure.subplots()
        # a path of dots is a tenth of the size of as many markers
        for y, colour, width, alpha, label in (
            (left, INK, 1.6, 0.4, "torque left"),
            (friction, PREDICTED, 2.2, 1.0, "friction and offset identified"),
        ):
            x = np.column_stack([v, v, np.full(len(v), np.nan)]).ravel()
            dots = np.column_stack([y, y, np.full(len(y), np.nan)]).ravel()
            axes.plot(x, dots, color=colour, alpha=alpha, lw=width, solid_capstyle="round")
            axes.plot([], [], "o", ms=width + 1, color=colour, alpha=alpha, label=label)
        axes.axhline(0.0, color=INK, lw=0.5)
        axes.set(xlabel=f"speed [{units[0]}]", ylabel=f"friction [{units[1]}]")
        axes.grid(visible=True)
        _legend(axes, 0.96)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.89, bottom=0.2)
    return figure


def plot_singular(values: Array, rank: int) -> Any:  # noqa: ANN401
    """Return a plot of singular values, those that the data do not determine in another colour.

    Args:
        values: The values, shape (b,), largest first [-].
        rank: How many the data determine.

    Returns:
        A figure of Matplotlib.
    """
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


def correlation_map(correlation: Array, names: Sequence[str], *, title: str, key: str) -> str:
    """Return a correlation matrix as a map of squares: its lower triangle, with names.

    Args:
        correlation: The matrix, shape (b, b); NaN is left empty.
        names: Names of the rows.
        title: What the map shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
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


def stretches(segment: NDArray[Any], used: NDArray[np.bool_] | None = None) -> list[slice]:
    """Return the uninterrupted stretches of a recording.

    Args:
        segment: Number of the stretch of each row, shape (N,).
        used: Rows to keep, shape (N,), bool; all if None.

    Returns:
        Slices of neighbouring kept rows of one segment.
    """
    kept = np.ones(len(segment), dtype=bool) if used is None else used
    same = kept[1:] & kept[:-1] & (segment[1:] == segment[:-1])
    starts = np.flatnonzero(kept & ~np.r_[False, same])
    ends = np.flatnonzero(kept & ~np.r_[same, False]) + 1
    return [slice(start, end) for start, end in zip(starts.tolist(), ends.tolist(), strict=True)]


def thin(t: Array, y: Array, parts: Sequence[slice], points: int) -> tuple[Array, Array]:
    """Return a line with fewer points that keeps every extreme, NaN between its stretches.

    Args:
        t: Times, shape (N,) [s].
        y: Values, shape (N,).
        parts: Stretches to draw.
        points: About how many points to keep.

    Returns:
        Times and values, shape (M,); not thinned where there are fewer points than asked for.
    """
    total = sum(part.stop - part.start for part in parts)
    width = max(1, int(np.ceil(2 * total / points))) if total > points else 1
    times: list[Array] = []
    values: list[Array] = []
    for part in parts:
        rows = np.arange(part.start, part.stop)
        if width > 1:
            rows = _extremes(y[part], width) + part.start
        times += [t[rows], np.array([np.nan])]
        values += [y[rows], np.array([np.nan])]
    if not parts:
        return np.empty(0), np.empty(0)
    return np.concatenate(times[:-1]), np.concatenate(values[:-1])


def _extremes(y: Array, width: int) -> NDArray[np.int_]:
    """Return the rows of the smallest and largest value of each ``width`` rows, and the ends."""
    padded = np.pad(y, (0, -len(y) % width), mode="edge").reshape(-1, width)
    first = width * np.arange(len(padded))
    rows = np.r_[0, first + padded.argmin(axis=1), first + padded.argmax(axis=1), len(y) - 1]
    kept: NDArray[np.int_] = np.unique(np.minimum(rows, len(y) - 1))
    return kept


def _legend(axes: Any, height: float) -> None:  # noqa: ANN401
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, height), ncols=2, borderpad=0)


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


def _draw_band(
    axes: Any,  # noqa: ANN401
    t: Array,
    parts: Sequence[slice],
    band: TorqueBand,
    row: int,
) -> None:
    """Draw the 95 % band of a residual, stretch by stretch."""
    half = REACH * band.total[:, row]
    for part in parts:
        inside = (band.samples >= part.start) & (band.samples < part.stop)
        times = t[band.samples[inside]]
        axes.fill_between(times, -half[inside], half[inside], color=RESIDUAL, alpha=0.2, lw=0)


def _shade(axes: Any, t: Array, parts: Sequence[slice]) -> None:  # noqa: ANN401
    """Shade the times of the stretches; those closer than a pixel are drawn as one."""
    spans: list[list[float]] = []
    pixel = (t[-1] - t[0]) / 500
    for part in parts:
        start, end = float(t[part.start]), float(t[part.stop - 1])
        if spans and start - spans[-1][1] < pixel:
            spans[-1][1] = end
        else:
            spans.append([start, end])
    bars = [(start, max(end - start, pixel / 2)) for start, end in spans]
    axes.broken_barh(
        bars, (0.0, 1.0), transform=axes.get_xaxis_transform(), color=INK, alpha=0.09, lw=0
    )


def _cells(step: NDArray[np.int_], shade: int, margin: int) -> str:
    rows, columns = np.nonzero(np.tril(step, -1) == shade)
    path = "".join(
        f"M{margin + _CELL * j} {_CELL * i}h{_CELL - 1}v{_CELL - 1}h-{_CELL - 1}z"
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    colour = "var(--predicted)" if shade > 0 else "var(--residual)"
    return f'<path d="{path}" fill="{colour}" fill-opacity="{abs(shade) / _STEPS:.3f}"/>'
