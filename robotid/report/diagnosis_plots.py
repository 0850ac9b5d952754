"""The report's plots of residuals, friction, drives and correlations: inline SVG."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.report.plots import INK, PREDICTED, RESIDUAL, STYLE, svg_element

__all__ = ["plot_correlation", "plot_drives", "plot_friction", "plot_residual", "plot_singular"]

_CELL = 11  # [px] of the correlation matrix
_STEPS = 8  # shades of each sign in it


def plot_residual(
    density: tuple[Array, Array],
    torque: tuple[Array, Array],
    correlation: Array,
    dt: float,
    *,
    cutoff: float | None,
    unit: str,
    title: str,
    key: str,
) -> str:
    """Return the amplitude spectrum of a residual beside its autocorrelation.

    Args:
        density: Frequencies [Hz] and power density of the residual [unit^2/Hz], shape (F,) each.
        torque: The same of the measured torque.
        correlation: Autocorrelation at lags 0, 1, ..., shape (L,).
        dt: Sample period [s].
        cutoff: Cut-off of the filter [Hz]; None if there is none.
        unit: Unit of the torque.
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    highest = np.inf if cutoff is None else 2.0 * cutoff
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 2.4))
        left, right = figure.subplots(1, 2)
        for (f, S), colour, label in ((torque, INK, "torque"), (density, RESIDUAL, "residual")):
            shown = (f > 0) & (f <= highest) & (S > 0)
            alpha = 0.6 if colour == INK else 1.0
            left.semilogy(
                f[shown], np.sqrt(S[shown]), color=colour, alpha=alpha, lw=1.0, label=label
            )
        if cutoff is not None:
            left.axvline(cutoff, color=INK, lw=0.6, ls=":")
        _plain(left)
        left.set(xlabel="frequency [Hz]", ylabel=f"density [{unit}/√Hz]")
        left.legend(loc="lower left", bbox_to_anchor=(0.0, 0.96), ncols=2, borderpad=0)
        right.plot(dt * np.arange(len(correlation)), correlation, color=RESIDUAL, lw=1.0)
        right.axhline(0.0, color=INK, lw=0.5)
        if cutoff is not None:
            right.axvline(1.0 / (2.0 * cutoff), color=INK, lw=0.6, ls=":")
        right.set(xlabel="lag [s]", ylabel="autocorrelation", ylim=(-1.05, 1.05))
        for axes in (left, right):
            axes.grid(visible=True)
            axes.margins(x=0.01)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.89, bottom=0.2, wspace=0.28)
        return svg_element(figure, title, key)


def plot_friction(
    v: Array, left: Array, friction: Array, *, units: tuple[str, str], title: str, key: str
) -> str:
    """Return the torque that inertia and gravity leave against speed, with the friction found.

    Args:
        v: Speed, shape (M,) [rad/s or m/s].
        left: Torque left, shape (M,) [N m or N].
        friction: Friction identified, shape (M,) [N m or N].
        units: Units of speed and torque.
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context({**STYLE, "path.simplify": False}):
        figure = Figure(figsize=(6.4, 2.4))
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
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.96), ncols=2, borderpad=0)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.89, bottom=0.2)
        return svg_element(figure, title, key)


def plot_drives(
    names: Sequence[str],
    prior: Array,
    value: Array,
    error: Array,
    spread: Array,
    *,
    label: str,
    title: str,
    key: str,
) -> str:
    """Return a plot of one drive term over the drives, with bands, the prior and its spread.

    Args:
        names: Names of the k drives.
        prior: Values before the fit, shape (k,).
        value: The identified ones, shape (k,).
        error: Their standard errors, shape (k,).
        spread: How far the prior may be wrong, shape (k,).
        label: The term and its unit.
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    y = np.arange(len(names))
    bars = np.where(np.isfinite(error), 2 * error, 0.0)
    height = 0.75 + 0.26 * len(names)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, height))
        axes = figure.subplots()
        axes.barh(y, 2 * spread, left=prior - spread, height=0.7, color=INK, alpha=0.1,
                  label="prior ± spread")  # fmt: skip
        axes.plot(prior, y, "|", color=INK, ms=8)
        axes.errorbar(
            value, y, xerr=bars, fmt="o", color=PREDICTED, ms=4, lw=1.2, capsize=2.5,
            label="identified, ±2 standard errors",
        )  # fmt: skip
        # a prior that says next to nothing must not press the values into a point
        low, high = np.min([value - bars, prior], axis=0), np.max([value + bars, prior], axis=0)
        margin = 0.08 * max(float(high.max() - low.min()), 1e-12)
        axes.set_xlim(float(low.min()) - margin, float(high.max()) + margin)
        axes.set_yticks(y, names)
        axes.set_xlabel(label)
        axes.invert_yaxis()
        axes.grid(visible=True, axis="x")
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, borderpad=0, handlelength=1.2
        )
        figure.subplots_adjust(left=0.3, right=0.98, top=1.0 - 0.24 / height, bottom=0.42 / height)
        return svg_element(figure, title, key)


def plot_singular(values: Array, rank: int, *, title: str, key: str) -> str:
    """Return a plot of singular values, those that the data do not determine in another colour.

    Args:
        values: The values, shape (b,), largest first [-].
        rank: How many the data determine.
        title: What the plot shows, for those who cannot see it.
        key: A word that no other plot on the page has.

    Returns:
        An ``<svg>`` element.
    """
    import matplotlib
    from matplotlib.figure import Figure

    number = np.arange(1, len(values) + 1)
    floor = float(values.max()) * 1e-17
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 2.2))
        axes = figure.subplots()
        axes.semilogy(number[:rank], values[:rank], "o", color=PREDICTED, ms=3)
        axes.semilogy(number[rank:], np.maximum(values[rank:], floor), "x", color=RESIDUAL, ms=4)
        _plain(axes)
        axes.set(xlabel="number of the direction", ylabel="singular value")
        axes.grid(visible=True)
        figure.subplots_adjust(left=0.11, right=0.99, top=0.96, bottom=0.21)
        return svg_element(figure, title, key)


def plot_correlation(correlation: Array, names: Sequence[str], *, title: str, key: str) -> str:
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


def _plain(axes: Any) -> None:  # noqa: ANN401
    """Write the decades of a logarithmic axis as plain numbers: the page has no formulas."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axes.get_ylim()
    few = np.log10(high / low) < 1.5
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _cells(step: NDArray[np.int_], shade: int, margin: int) -> str:
    rows, columns = np.nonzero(np.tril(step, -1) == shade)
    path = "".join(
        f"M{margin + _CELL * j} {_CELL * i}h{_CELL - 1}v{_CELL - 1}h-{_CELL - 1}z"
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    colour = "var(--predicted)" if shade > 0 else "var(--residual)"
    return f'<path d="{path}" fill="{colour}" fill-opacity="{abs(shade) / _STEPS:.3f}"/>'
