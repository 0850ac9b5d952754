"""The report's plot of torque over time, a figure of Matplotlib in the report's style."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotid._typing import Array
from robotid.identification.bands import REACH, TorqueBand
from robotid.identification.evaluation import Evaluation
from robotid.report.svg import INK, PREDICTED, RESIDUAL, drawing, legend

__all__ = [
    "plot_torque",
    "stretches",
    "thin",
]


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
        legend(upper, 0.98)
        figure.align_ylabels()
        figure.subplots_adjust(left=0.11, right=0.99, top=0.92, bottom=0.13, hspace=0.12)
    return figure


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
