"""The paper's figures, each for all three models."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.paper_errata import EnergyDrift
from robotid.paper_simulation import AMPLITUDE, CASES, DURATION, ModelStudy
from robotid.paper_trajectories import RandomRuns
from robotid.program import ProgramMotion
from robotid.report_plots import INK, STYLE

__all__ = [
    "convergence_figure",
    "disturbed_figure",
    "energy_figure",
    "figure_3",
    "figure_4",
    "figure_5",
    "trajectories_figure",
]

# readable on white and on black
_COLOURS = ("#0b7fd1", "#d4622a", "#23985f", "#b08400", "#b5539c")
_SHOWN = (1, 2, 5, 20, 100)  # iterations drawn in figure 4


def figure_3(joint: int) -> Any:  # noqa: ANN401
    """Return figure 3(a) or 3(b), the program motion of one link.

    Args:
        joint: Number of the joint, 0 or 1.

    Returns:
        A figure of Matplotlib.

    References:
        Tzvetkova, (28).
    """
    t = np.linspace(0.0, DURATION, 201)
    parts = ProgramMotion(np.array(AMPLITUDE), DURATION).evaluate(t)
    units = ("position [rad]", "velocity [rad/s]", "acceleration [rad/s²]")
    figure, row = _figure(3, height=2.4)
    for axes, part, label, colour in zip(row, parts, units, _COLOURS, strict=False):
        axes.plot(t, part[:, joint], color=colour)
        axes.set(xlabel="time [s]", ylabel=label)
    return figure


def figure_4(studies: Sequence[ModelStudy], joint: int) -> Any:  # noqa: ANN401
    """Return figure 4(a) or 4(b), the control of one joint in successive iterations.

    Args:
        studies: The models.
        joint: Number of the joint, 0 or 1.

    Returns:
        A figure of Matplotlib.

    References:
        Tzvetkova, (21).
    """
    figure, row = _figure(len(studies), height=3.0, share=True)
    for axes, study in zip(row, studies, strict=True):
        kept = study.history.torques
        torques: Sequence[Array] = [] if kept is None else list(kept)
        for number, colour in zip(_SHOWN, _COLOURS, strict=True):
            if number <= len(torques):
                u = torques[number - 1][:, 0, joint]
                t = np.arange(len(u)) * DURATION / len(u)
                axes.plot(t, u, color=colour, lw=1.0, label=f"iteration {number}")
        axes.plot(*_control(study, joint), "--", color=INK, lw=1.2, label="program control")
        axes.set(xlabel="time [s]", title=study.name)
    row[0].set_ylabel(f"torque u{joint + 1} [N m]")
    _legend(figure, row[0])
    return figure


def figure_5(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Return figure 5, the estimated parameters over the iterations.

    Args:
        studies: The models.

    Returns:
        A figure of Matplotlib.

    References:
        Tzvetkova, (24).
    """
    figure, row = _figure(len(studies), height=3.2, share=True)
    colour = dict(zip(("p1", "p2", "p3", "p4", "p5"), _COLOURS, strict=True))
    for axes, study in zip(row, studies, strict=True):
        for i, name in enumerate(study.dynamics.names):
            axes.plot(study.history.estimates[:, 0, i], color=colour[name], lw=1.3, label=name)
            axes.axhline(study.P[i], color=colour[name], lw=0.8, ls=":")
        axes.set(xlabel="iteration", title=study.name)
    row[0].set_ylabel("estimate [kg m²]; dotted: true")
    _legend(figure, row[0])
    return figure


def convergence_figure(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Return PRX and the parameter error over the iterations.

    Args:
        studies: The models.

    Returns:
        A figure of Matplotlib.

    References:
        Tzvetkova, (23).
    """
    figure, (left, right) = _figure(2, height=3.2)
    for study, colour in zip(studies, _COLOURS, strict=False):
        numbers = np.arange(1, len(study.history.prx) + 1)
        left.semilogy(numbers, study.history.prx[:, 0], color=colour, lw=1.3, label=study.name)
        right.semilogy(study.errors(), color=colour, lw=1.3)
        right.semilogy(study.errors("on_program"), "--", color=colour, lw=1.0)
    left.set(xlabel="iteration", ylabel="largest entry of PRX [N m/s²]")
    right.set(xlabel="iteration", ylabel="|P̂ − P| / |P|; dashed: start on program")
    _legend(figure, left)
    return figure


def disturbed_figure(studies: Sequence[ModelStudy]) -> Any:  # noqa: ANN401
    """Return the parameter error under disturbance and noise.

    Args:
        studies: The models.

    Returns:
        A figure of Matplotlib.
    """
    figure, row = _figure(len(studies), height=3.2, share=True)
    shown = {"clean": "clean", "disturbed": "torque ±10 %", "noisy": "noise"}
    shown["noisy_dead_zone"] = "noise, ε₂ = 1"
    for axes, study in zip(row, studies, strict=True):
        for (case, label), colour in zip(shown.items(), _COLOURS, strict=False):
            if case in CASES:
                axes.semilogy(study.errors(case), color=colour, lw=1.1, label=label)
        axes.set(xlabel="iteration", title=study.name)
    row[0].set_ylabel("|P̂ − P| / |P|")
    _legend(figure, row[0])
    return figure


def trajectories_figure(runs: Mapping[str, RandomRuns]) -> Any:  # noqa: ANN401
    """Return how many iterations the random motions took.

    Args:
        runs: Random motions of each model.

    Returns:
        A figure of Matplotlib.
    """
    figure, row = _figure(len(runs), height=2.8, share=True)
    for axes, (name, found), colour in zip(row, runs.items(), _COLOURS, strict=False):
        most, count = len(found.errors) - 1, len(found.guess)
        axes.hist(found.iterations, bins=np.linspace(0, most, 31), color=colour)
        left = count - len(found.iterations)
        axes.set(xlabel="iterations to 10⁻³", title=f"{name}: {count - left} of {count} converged")
    row[0].set_ylabel("random motions")
    return figure


def energy_figure(drift: EnergyDrift) -> Any:  # noqa: ANN401
    """Return the energy that each model gains in free motion.

    Args:
        drift: Energies over time.

    Returns:
        A figure of Matplotlib.
    """
    figure, (axes,) = _figure(1, height=2.8)
    for name, colour in zip(drift.energy, _COLOURS, strict=False):
        axes.plot(drift.t, 100 * drift.relative(name), color=colour, lw=1.2, label=name)
    axes.set(xlabel="time [s]", ylabel="energy gained [%]")
    _legend(figure, axes)
    return figure


def _control(study: ModelStudy, joint: int) -> tuple[Any, Any]:
    t, u = study.program_control(201)
    return t, u[:, joint]


def _figure(columns: int, *, height: float, share: bool = False) -> tuple[Any, Any]:
    """Return a figure and its axes side by side."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(3.1 * max(columns, 2), height), layout="constrained")
        row = figure.subplots(1, columns, squeeze=False, sharey=share)[0]
        for axes in row:
            axes.grid(visible=True)
        return figure, row


def _legend(figure: Any, axes: Any) -> None:  # noqa: ANN401
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=len(labels), frameon=False)
