"""The paper's figures, each for all three models."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.paper.errata import EnergyDrift
from robotid.paper.study import CASES, DURATION, PROGRAM, ModelStudy, RandomRuns
from robotid.paper.svg import INK, STYLE

# readable on white and on black
_COLOURS = ("#0b7fd1", "#d4622a", "#23985f", "#b08400", "#b5539c")
_STYLES = ("-", "--", ":")  # of models with coincident curves
_SHOWN = (1, 2, 5, 20, 100)  # iterations drawn in figure 4
_WIDTH, _DPI = 9.3, 150  # [inch, 1/inch] of every figure
_FONT = 8.5  # [pt]
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def paper_figures(
    studies: Sequence[ModelStudy], runs: Mapping[str, RandomRuns], drift: EnergyDrift
) -> dict[str, tuple[str, Any]]:
    """Return the caption and the Matplotlib figure of each figure, by the name of its file.

    References:
        Tzvetkova, figures 3 to 5.
    """
    return {
        "figure_3a": ("Figure 3(a). The program motion of link 1, (28)", _figure_3(0)),
        "figure_3b": ("Figure 3(b). The program motion of link 2, (28)", _figure_3(1)),
        "figure_4a": (
            "Figure 4(a). Control u1 (21) in successive iterations, and the program control",
            _figure_4(studies, 0),
        ),
        "figure_4b": (
            "Figure 4(b). Control u2 (21) in successive iterations, and the program control",
            _figure_4(studies, 1),
        ),
        "figure_5": (
            "Figure 5. The estimated parameters (24) over the iterations",
            _figure_5(studies),
        ),
        "convergence": (
            "Proximity function (23) and parameter error over the iterations",
            _convergence_figure(studies),
        ),
        "disturbance": (
            "Parameter error with disturbed torque and with noisy sensors",
            _disturbed_figure(studies),
        ),
        "trajectories": (
            "Iterations of random motions to a relative error of 10⁻³",
            _trajectories_figure(runs),
        ),
        "energy": ("Energy gained in free motion", _energy_figure(drift)),
    }


def _figure_3(joint: int) -> Any:  # noqa: ANN401
    """Draw the program motion (28) of one link."""
    t = np.linspace(0.0, DURATION, 201)
    parts = PROGRAM.evaluate(t)
    units = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]")
    figure, row = _figure(3, height=2.4)
    for axes, part, label, colour in zip(row, parts, units, _COLOURS, strict=False):
        axes.plot(t, part[:, joint], color=colour)
        axes.set(xlabel="time [s]", ylabel=label)
    return figure


def _figure_4(studies: Sequence[ModelStudy], joint: int) -> Any:  # noqa: ANN401
    """Draw the control (21) of one joint in successive iterations."""
    figure, rows = _grid(2, len(studies), height=4.4, share=True)
    for upper, lower, study in zip(*rows, studies, strict=True):
        stored = study.history.torques
        torques: Sequence[Array] = [] if stored is None else list(stored[:, :, 0, joint])
        for number, colour in zip(_SHOWN, _COLOURS, strict=True):
            if number <= len(torques):
                u = torques[number - 1]
                t = np.arange(len(u)) * DURATION / len(u)
                upper.plot(t, u, color=colour, lw=1.0, label=f"iteration {number}")
                lower.plot(t, u - torques[-1], color=colour, lw=1.0)
        t, control = study.program_control(201)
        upper.plot(t, control[:, joint], "--", color=INK, lw=1.2, label="program control")
        upper.set_title(study.name, fontsize=_FONT)
        lower.set_xlabel("time [s]")
    rows[0][0].set_ylabel(f"torque u{joint + 1} [N m]")
    rows[1][0].set_ylabel("minus the last iteration [N m]")
    _legend(figure, rows[0][0])
    return figure


def _figure_5(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Draw the estimated parameters (24) over the iterations."""
    figure, row = _figure(len(studies), height=3.2, share=True)
    colour = dict(zip(("p1", "p2", "p3", "p4", "p5"), _COLOURS, strict=True))
    for axes, study in zip(row, studies, strict=True):
        for i, name in enumerate(study.dynamics.names):
            axes.plot(study.history.estimates[:, 0, i], color=colour[name], lw=1.3, label=name)
            axes.axhline(study.P[i], color=colour[name], lw=0.8, ls=":")
        axes.set_xlabel("iteration")
        axes.set_title(study.name, fontsize=_FONT)
    row[0].set_ylabel("estimate [kg m²]; dotted: true")
    _legend(figure, row[0])
    return figure


def _convergence_figure(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Draw PRX (23) and the parameter error over the iterations."""
    figure, (left, right) = _figure(2, height=3.2)
    for study, colour, style in zip(studies, _COLOURS, _STYLES, strict=False):
        numbers = np.arange(1, len(study.history.prx) + 1)
        prx = study.history.prx[:, 0]
        left.semilogy(numbers, prx, style, color=colour, lw=1.6, label=study.name)
        right.semilogy(study.errors(), style, color=colour, lw=1.6)
        right.semilogy(study.errors("on_program"), style, color=colour, lw=0.8)
    left.set(xlabel="iteration", ylabel="largest entry of PRX [N m/s²]")
    right.set(xlabel="iteration", ylabel="|P̂ − P| / |P|; thin: start on program")
    for axes in (left, right):
        _label_decades(axes)
    _legend(figure, left)
    return figure


def _disturbed_figure(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Draw the parameter error under disturbance and noise."""
    figure, row = _figure(len(studies), height=3.2, share=True)
    shown = {"clean": "clean", "disturbed": "torque ±10 %", "noisy": "noise"}
    shown["noisy_dead_zone"] = "noise, ε₂ = 1"
    for axes, study in zip(row, studies, strict=True):
        for (case, label), colour in zip(shown.items(), _COLOURS, strict=False):
            if case in CASES:
                axes.semilogy(study.errors(case), color=colour, lw=1.1, label=label)
        axes.set_xlabel("iteration")
        axes.set_title(study.name, fontsize=_FONT)
        _label_decades(axes)
    row[0].set_ylabel("|P̂ − P| / |P|")
    _legend(figure, row[0])
    return figure


def _trajectories_figure(runs: Mapping[str, RandomRuns]) -> Any:  # noqa: ANN401
    """Draw the numbers of iterations of the random motions."""
    figure, row = _figure(len(runs), height=2.8, share=True)
    for axes, (name, found), colour in zip(row, runs.items(), _COLOURS, strict=False):
        most, count = len(found.errors) - 1, len(found.guess)
        axes.hist(found.iterations, bins=np.linspace(0, most, 31), color=colour)
        axes.set_xlabel("iterations to 10⁻³")
        axes.set_title(f"{name}: {len(found.iterations)} of {count} converged", fontsize=_FONT)
    row[0].set_ylabel("random motions")
    return figure


def _energy_figure(drift: EnergyDrift) -> Any:  # noqa: ANN401
    """Draw the energy gained by each model in free motion."""
    figure, (axes,) = _figure(1, height=2.8)
    for (name, gained), colour in zip(drift.gained.items(), _COLOURS, strict=False):
        axes.plot(drift.t, 100 * gained, color=colour, lw=1.2, label=name)
    axes.set(xlabel="time [s]", ylabel="energy gained [%]")
    _legend(figure, axes)
    return figure


def _figure(columns: int, *, height: float, share: bool = False) -> tuple[Any, Any]:
    """Return a figure and its axes side by side."""
    figure, rows = _grid(1, columns, height=height, share=share)
    return figure, rows[0]


def _grid(lines: int, columns: int, *, height: float, share: bool = False) -> tuple[Any, Any]:
    """Return a figure and its axes, line by line; the axes of a line may share their scale."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
        sharey: Any = "row" if share else False
        rows = figure.subplots(lines, columns, squeeze=False, sharey=sharey)
        for axes in rows.flat:
            axes.grid(visible=True)
        return figure, rows


def _legend(figure: Any, axes: Any) -> None:  # noqa: ANN401
    handles, labels = axes.get_legend_handles_labels()
    place = {"loc": "outside upper left", "ncols": len(labels)}
    figure.legend(handles, labels, frameon=False, fontsize=_FONT, labelcolor=INK, **place)


def _label_decades(axes: Any) -> None:  # noqa: ANN401
    """Write the decades as 10⁻³: Matplotlib's own labels need its math parser, which is off."""
    axes.yaxis.set_major_formatter(_power)
    axes.yaxis.set_minor_formatter("")


def _power(value: float, _: int) -> str:
    return "10" + str(round(np.log10(value))).translate(_RAISED)
