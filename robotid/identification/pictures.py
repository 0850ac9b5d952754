"""Charts of an identification: torques, residuals, friction, parameters, excitation."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robotid.base.typing import Array
from robotid.diagnosis.residual.residuals import autocorrelation, friction_split, spectrum
from robotid.dynamics.memory import drive_motion_along
from robotid.estimation.fitting.bands import QUANTILE, TorqueBand, friction_curve
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.output.pages.charts import Chart, Series, broken

if TYPE_CHECKING:
    from robotid.identification.result import Identification

_DOTS = 800  # of one friction chart
_LAGS = 400  # points of one autocorrelation
_LONGEST_LAG = 2.0  # [s]
_DWARFED = 4.0  # times the height of the measured torque above which the URDF's is hidden
_PIXELS = 500  # spans closer than one of these pixels are merged


def shown_evaluation(found: "Identification") -> Evaluation:
    """Return the recording to show: the first validation recording, or the first fitted one."""
    return (found.validation or found.fitted)[0]


def torque_charts(
    found: "Identification",
    evaluation: Evaluation,
    row: int,
    *,
    band: TorqueBand | None = None,
    link: str = "time",
) -> tuple[Chart, Chart]:
    """Return measured and predicted torque over the log's own time, and the residual.

    Where samples were not used, the background is shaded and only the measured torque is drawn: the
    sign of friction is not known there. No line is drawn across a gap of the recording.
    """
    motion, used = evaluation.recording.trajectory, evaluation.recording.mask[:, row].astype(bool)
    name, unit = found.model.row_names[row], found.model.row_units[row]
    band = found.band(evaluation) if band is None else band
    half = QUANTILE * np.interp(np.arange(len(motion.t)), band.samples, band.total[:, row])
    model, urdf = (
        np.where(used, evaluation.torques[key][:, row], np.nan) for key in ("estimate", "urdf")
    )
    t, tau, model, urdf, half = broken(
        motion.segment, motion.t, motion.tau[:, row], model, urdf, half
    )
    spans = unused_spans(t, np.isfinite(model))
    kind = "force" if unit == "N" else "torque"
    torque = Chart(
        f"{kind.capitalize()} of {name} over time: measured, identified, URDF",
        t,
        (
            Series("URDF", urdf, "urdf", is_weak=True, is_hidden=_dwarfs(urdf, tau, model)),
            Series("measured", tau, "text", is_weak=True),
            Series("identified, 95 % band", model, "predicted", half=half),
        ),
        "time [s]",
        f"{kind} [{unit}]",
        link,
        spans,
    )
    zero = np.where(np.isfinite(model), 0.0, np.nan)
    residual = Chart(
        f"Residual of {name} over time, measured minus identified",
        t,
        (
            Series("95 % band", zero, "residual", half=half, is_weak=True),
            Series("residual", tau - model, "residual"),
        ),
        "time [s]",
        f"residual [{unit}]",
        link,
        spans,
        height=90,
    )
    return torque, residual


def _dwarfs(y: Array, *others: Array) -> bool:
    """Whether a line would reduce the others, drawn with it, to a fraction of the height."""
    rest = np.concatenate(others)
    every = np.concatenate([rest, y])
    sizes = [np.ptp(x[np.isfinite(x)]) for x in (every, rest)]
    return bool(sizes[0] > _DWARFED * sizes[1])


def unused_spans(t: Array, used: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Return the time spans between used samples; those closer than a pixel are merged.

    t (N,) [s], used (N,).
    """
    edges = np.flatnonzero(np.diff(np.r_[True, used, True].astype(int))).reshape(-1, 2)
    pixel = float(t[-1] - t[0]) / _PIXELS if len(t) else 0.0
    spans: list[tuple[float, float]] = []
    for first, after in edges.tolist():
        start, end = float(t[max(first - 1, 0)]), float(t[min(after, len(t) - 1)])
        if spans and start - spans[-1][1] < pixel:
            spans[-1] = (spans[-1][0], end)
        else:
            spans.append((start, end))
    return tuple(spans)


def residual_charts(
    found: "Identification", evaluation: Evaluation, row: int
) -> tuple[Chart, Chart] | None:
    """Return spectrum and autocorrelation of a joint's residual; None if no sample was used."""
    motion, used = evaluation.recording.trajectory, evaluation.recording.mask[:, row].astype(bool)
    name, unit = found.model.row_names[row], found.model.row_units[row]
    residual = motion.tau[:, row] - evaluation.torques["estimate"][:, row]
    dt = float(np.median(np.diff(motion.t)[np.diff(motion.segment) == 0]))
    f, density = spectrum(residual, used, motion.segment, dt)
    if not len(f):
        return None
    torque = spectrum(motion.tau[:, row], used, motion.segment, dt)[1]
    cutoff = evaluation.recording.signals.cutoff
    shown = (f > 0) & (f <= (np.inf if cutoff is None else 2.0 * cutoff))
    lags = max(1, min(int(_LONGEST_LAG / dt), len(residual) // 2))
    step = max(1, lags // _LAGS)
    r = autocorrelation(residual, used, motion.segment, lags)[::step]
    return (
        Chart(
            f"Spectrum of torque and residual of {name}",
            f[shown],
            (
                Series("torque", np.sqrt(torque[shown]), "text", is_weak=True),
                Series("residual", np.sqrt(density[shown]), "residual"),
            ),
            "frequency [Hz]",
            f"density [{unit}/√Hz]",
            marks=() if cutoff is None else (cutoff,),
            logarithmic="y",
        ),
        Chart(
            f"Autocorrelation of the residual of {name}",
            step * dt * np.arange(len(r)),
            (Series("residual", r, "residual"),),
            "lag [s]",
            "autocorrelation [-]",
            marks=() if cutoff is None else (1.0 / (2.0 * cutoff),),
        ),
    )


def friction_chart(
    found: "Identification", joint: str, *, split: tuple[Array, Array] | None = None
) -> Chart | None:
    """Return friction against speed: measured, identified, and at constant speed."""
    evaluation, model = shown_evaluation(found), found.model
    motion, row = evaluation.recording.trajectory, model.row_names.index(joint)
    left, friction = split or friction_split(model, evaluation, found.standard)
    rows = np.flatnonzero(evaluation.recording.mask[:, row])
    rows = rows[:: max(1, -(-len(rows) // _DOTS))]
    is_driven = joint in model.joints and joint not in model.passive
    has_friction = is_driven or joint in model.layout.own
    if not has_friction or not len(rows):
        return None
    rows = rows[np.argsort(motion.v[rows, row], kind="stable")]
    load = 0.0
    if any(x.name == "load" for x in model.layout.own.get(joint, ())):
        drive = [own.name for own in model.layout.drives].index(joint)
        loads = drive_motion_along(model, motion).load[drive]
        load = float(np.sqrt(np.mean(loads[rows] ** 2)))
    v, unit = motion.v[rows, row], model.row_units[row]
    q = float(np.median(motion.q[rows, row - model.n_rows]))  # from the end: a pose has 7 entries
    curve = friction_curve(found, joint, v, q=q, load=load)
    # Coulomb friction jumps where the motion reverses: no line crosses it
    v, left, friction, steady, std = broken(
        np.sign(v), v, left[rows, row], friction[rows, row], curve.torque, curve.std
    )
    under = f" at a load of {load:.3g} {unit}" if load else ""
    return Chart(
        f"Friction of {joint} against speed, measured and identified",
        v,
        (
            Series("measured", left, "text", "dots", is_weak=True),
            Series("identified", friction, "predicted", "dots"),
            Series(f"steady{under}, 95 % band", steady, "residual", half=QUANTILE * std),
        ),
        "speed [m/s]" if unit == "N" else "speed [rad/s]",
        f"friction [{unit}]",
    )


def parameter_charts(found: "Identification", terms: Sequence[str]) -> tuple[Chart, ...]:
    """Return charts of each term of all drives, with the value before the fit."""
    layout = found.model.layout
    owners, ends = zip(*(name.rsplit(".", 1) for name in layout.names), strict=True)
    error = np.where(np.isfinite(found.standard_error), 2 * found.standard_error, np.nan)
    charts = []
    for term in terms:
        chosen = [i for i, end in enumerate(ends) if end == term]
        for unit in dict.fromkeys(layout.units[i] for i in chosen):
            part = np.array([i for i in chosen if layout.units[i] == unit])
            series = [
                Series(
                    "identified ± 2 s.e.", found.standard[part], "predicted", "bars", error[part]
                )
            ]
            if found.prior[part].any():
                series.insert(
                    0, Series("before the fit", found.prior[part], "urdf", "bars", is_weak=True)
                )
            charts.append(
                Chart(
                    f"{term} of each drive, before the fit and identified with two standard errors",
                    np.arange(len(part), dtype=float),
                    tuple(series),
                    "",
                    f"{term} [{unit}]",
                    height=140,
                    x_names=tuple(owners[i] for i in part),
                )
            )
    return tuple(charts)


def singular_chart(values: Array, rank: int) -> Chart:
    """Return the singular values of a regressor, largest first: values (b,) [-]."""
    number = np.arange(1, len(values) + 1)
    values = np.maximum(values, float(values.max()) * 1e-17)
    series = [Series("determined", np.where(number <= rank, values, np.nan), "predicted", "dots")]
    if rank < len(values):
        series.append(
            Series("not determined", np.where(number > rank, values, np.nan), "residual", "dots")
        )
    return Chart(
        "Singular values of the regressor, columns scaled to unit norm",
        number.astype(float),
        tuple(series),
        "number of the direction",
        "singular value [-]",
        logarithmic="y",
    )
