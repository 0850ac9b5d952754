"""Charts of an identification: torques, residuals and their causes, friction, parameters."""

import numpy as np
from numpy.typing import NDArray

from robotid.base.exceptions import DataError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import require_kind
from robotid.base.typing import Array
from robotid.diagnosis.residual.joint_torques import Dependence, JointTorque, spread_rows
from robotid.dynamics.torque import drive_motion_along
from robotid.dynamics.torque_split import friction_split
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.fitted import friction_curve
from robotid.estimation.fitting.standard_errors import QUANTILE, TorqueBand
from robotid.identification.result import TorqueIdentification
from robotid.output.pages.html import Chart, Plot, Series, broken

_DWARFED = 4.0  # times the height of the measured torque above which the URDF's is hidden
_PIXELS = 500  # spans closer than one of these pixels are merged
_POINTS = 400  # of a chart of the residual analysis, or of friction
_TONES = {
    "gravity": "tone-1", "inertia": "tone-4", "Coriolis": "tone-7", "friction": "tone-3",
    "motor inertia": "tone-6", "offset": "tone-8", "spring": "tone-5", "ripple": "urdf",
    "delay": "quiet",
}  # fmt: skip


def plot_torques(
    identification: TorqueIdentification, *joints: str, recording: Evaluation | None = None
) -> Plot:
    """Return charts of measured and identified torque over time, and of the residual.

    Of all joints if none is named; of the recording in ``fitted`` or ``validation``, or of the
    first validation recording, or the first fitted one.
    """
    require_kind(
        recording, (Evaluation, type(None)), "recording", "one of fitted or validation, or none"
    )
    shown = shown_evaluation(identification) if recording is None else recording
    names = joints or identification.model.row_names
    rows, band = [_row_of(identification, joint) for joint in names], identification.band(shown)
    charts = []
    for name, row in zip(names, rows, strict=True):
        torque, residual = torque_charts(identification, shown, row, band=band)
        charts += [(torque, f"{name}: torque"), (residual, f"{name}: residual")]
    return Plot(f"Torques of {shown.name}", tuple(charts))


def plot_friction(identification: TorqueIdentification, *joints: str) -> Plot:
    """Return charts of friction against speed, measured and identified, with its band."""
    names = joints or identification.model.joints
    for name in names:
        _row_of(identification, name)
    charts = [(friction_chart(identification, name), name) for name in names]
    shown = tuple((x, f"{name}: friction and offset") for x, name in charts if x is not None)
    if not shown:
        raise DataError(f"{listed(names)}: no samples used, so there is no friction to show")
    return Plot(f"Friction of {listed(names)} against speed", shown)


def plot_why(identification: TorqueIdentification, joint: str) -> Plot:
    """Return charts of the parts of a joint's torque, and of its residual's dependences."""
    torque = identification.joint_torques[_row_of(identification, joint)]
    charts = why_charts(torque)
    about = {name: f"residual against {name}" for name in charts}
    about["split"] = torque.sentence
    shown = tuple((chart, f"{joint}: {about[name]}") for name, chart in charts.items())
    return Plot(f"Torque parts and residual of {joint}", shown)


def shown_evaluation(found: TorqueIdentification) -> Evaluation:
    """Return the recording to show: the first validation recording, or the first fitted one."""
    return (found.validation or found.fitted)[0]


def _row_of(identification: TorqueIdentification, joint: str) -> int:
    require_kind(joint, str, "joint", "the name of a joint")
    names = identification.model.row_names
    if joint not in names:
        raise DataError(
            f"joint {joint!r} is not among the identified joints: {listed(names)}"
            f"{suggestion(joint, names)}"
        )
    return names.index(joint)


def torque_charts(
    found: TorqueIdentification,
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
    torques = [evaluation.torques[key][:, row] for key in ("estimate", "urdf")]
    lines = motion.tau[:, row], *(np.where(used, x, np.nan) for x in torques), half
    t, tau, model, urdf, half = broken(motion.segment, motion.t, *lines)
    spans = unused_spans(t, np.isfinite(model))
    kind = "force" if unit == "N" else "torque"
    title = f"{kind.capitalize()} of {name} over time: measured, identified, URDF"
    above = (
        Series("URDF", urdf, "urdf", is_weak=True, is_hidden=_dwarfs(urdf, tau, model)),
        Series("measured", tau, "text", is_weak=True),
        Series("identified, 95 % band", model, "predicted", half=half),
    )
    torque = Chart(title, t, above, "time [s]", f"{kind} [{unit}]", link, spans)
    title = f"Residual of {name} over time, measured minus identified"
    zero = np.where(np.isfinite(model), 0.0, np.nan)
    below = (
        Series("95 % band", zero, "residual", half=half, is_weak=True),
        Series("residual", tau - model, "residual"),
    )
    residual = Chart(title, t, below, "time [s]", f"residual [{unit}]", link, spans, height=90)
    return torque, residual


def _dwarfs(y: Array, *others: Array) -> bool:
    """Whether a line would reduce the others, drawn with it, to a fraction of the height."""
    rest = np.concatenate(others)
    every = np.concatenate([rest, y])
    sizes = [np.ptp(x[np.isfinite(x)]) for x in (every, rest)]
    return bool(sizes[0] > _DWARFED * sizes[1])


def unused_spans(t: Array, used: NDArray[np.bool_]) -> tuple[tuple[float, float], ...]:
    """Return the time spans between used samples (N,); those closer than a pixel are merged."""
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


def friction_chart(
    found: TorqueIdentification, joint: str, *, split: tuple[Array, Array] | None = None
) -> Chart | None:
    """Return friction against speed: measured, identified, and at constant speed."""
    evaluation, model = shown_evaluation(found), found.model
    motion, row = evaluation.recording.trajectory, model.row_names.index(joint)
    left, friction = split or friction_split(model, motion, found.standard)
    rows = np.flatnonzero(evaluation.recording.mask[:, row])
    rows = rows[:: max(1, -(-len(rows) // _POINTS))]
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
    title = f"Friction of {joint} against speed, measured and identified"
    series = (
        Series("measured", left, "text", "dots", is_weak=True),
        Series("identified", friction, "predicted", "dots"),
        Series(f"steady{under}, 95 % band", steady, "residual", half=QUANTILE * std),
    )
    speed = "speed [m/s]" if unit == "N" else "speed [rad/s]"
    return Chart(title, v, series, speed, f"friction [{unit}]", height=130)


def why_charts(torque: JointTorque, *, link: str = "time") -> dict[str, Chart]:
    """Return the stacked parts of a torque, "split", and its residual against each quantity."""
    charts = {"split": _split(torque, link)}
    for dependence in torque.follows:
        if dependence.name in (*torque.quantities, "time"):
            charts[dependence.name] = _residual(torque, dependence, link)
    return charts


def _split(torque: JointTorque, link: str) -> Chart:
    rows = np.flatnonzero(torque.rows.recording == 0)
    k = rows[spread_rows(len(rows), _POINTS)]
    parts = {name: torque.parts[name][k] for name in torque.present}
    values = [*parts.values(), torque.residual[k], torque.tau[k]]
    t, *values = broken(torque.rows.segment[k], torque.rows.t[k], *values)
    *stacked, residual, tau = values
    areas = [Series(name, y, _TONES[name], "area") for name, y in zip(parts, stacked, strict=True)]
    lines = [Series("residual", residual, "residual", "area"), Series("measured", tau, "text")]
    title = f"Torque of {torque.joint} over time, the sum of {', '.join(parts)} and residual"
    spans, unit = unused_spans(torque.rows.t[k], torque.used[k]), f"torque [{torque.unit}]"
    return Chart(title, t, (*areas, *lines), "time [s]", unit, link, spans, height=240)


def _residual(torque: JointTorque, dependence: Dependence, link: str) -> Chart:
    name, unit = dependence.name, dependence.unit
    x = torque.rows.time if name == "time" else torque.quantities[name][1]
    rows = np.flatnonzero(torque.used)
    rows = rows[np.argsort(x[rows])]
    k = rows[spread_rows(len(rows), _POINTS)]
    mean, error = dependence.at(x[k])
    is_one = name == "time" and len(torque.rows.recordings) == 1
    residual, less = torque.against_time if name == "time" else (torque.residual, "")
    what = f"Residual of {torque.joint}{f' minus its mean over {less}' if less else ''}"
    series = (
        Series("residual", residual[k], "residual", "dots", is_weak=True),
        Series("mean", mean, "text", half=QUANTILE * error),
    )
    return Chart(
        f"{what} against {name}, with its mean and 95 % interval", x[k], series,
        f"{name} [{unit}]", f"residual [{torque.unit}]", link if is_one else "", height=120,
    )  # fmt: skip
