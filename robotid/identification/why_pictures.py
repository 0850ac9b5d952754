"""Charts of the parts of a joint's torque, of its power, and of its residual's dependences."""

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.residual.dependence import Dependence
from robotid.diagnosis.residual.torque_split import JointTorque, spread_rows
from robotid.estimation.fitting.bands import QUANTILE
from robotid.identification.pictures import unused_spans
from robotid.output.pages.charts import Chart, Series, broken

_POINTS = 600  # of a chart
_TONES = {
    "gravity": "tone-1",
    "inertia": "tone-4",
    "Coriolis": "tone-7",
    "friction": "tone-3",
    "motor inertia": "tone-6",
    "offset": "tone-8",
    "spring": "tone-5",
    "ripple": "urdf",
    "delay": "quiet",
}


def why_charts(
    torque: JointTorque, *, link: str = "time", points: int = _POINTS
) -> dict[str, Chart]:
    """Return the charts of a joint by name.

    They are "split", the parts of the torque stacked over time; one for each quantity that the
    residual may depend on, by its name; and "power", if there is a speed. Charts over time show the
    first recording.
    """
    charts = {"split": _split(torque, link, points)}
    for dependence in torque.follows:
        if dependence.name in (*torque.quantities, "time"):
            charts[dependence.name] = _residual(torque, dependence, link, points)
    if torque.power is not None:
        charts["power"] = _power(torque, torque.power, link, points)
    return charts


def _split(torque: JointTorque, link: str, points: int) -> Chart:
    k = _first(torque, points)
    parts = {name: torque.parts[name][k] for name in torque.present}
    lines = [*parts.values(), torque.residual[k], torque.tau[k]]
    t, *lines = broken(torque.rows.segment[k], torque.rows.t[k], *lines)
    *stacked, residual, tau = lines
    areas = [Series(name, y, _TONES[name], "area") for name, y in zip(parts, stacked, strict=True)]
    return Chart(
        title=f"Torque of {torque.joint} over time, the sum of {', '.join(parts)} and residual",
        x=t,
        series=(
            *areas,
            Series("residual", residual, "residual", "area"),
            Series("measured", tau, "text"),
        ),
        x_label="time [s]",
        y_label=f"torque [{torque.unit}]",
        link=link,
        spans=unused_spans(torque.rows.t[k], torque.used[k]),
        height=240,
    )


def _power(torque: JointTorque, power: Array, link: str, points: int) -> Chart:
    k = _first(torque, points)
    speed = torque.quantities["speed"][1]
    dissipated = torque.parts.get("friction", np.zeros_like(speed)) * speed
    t, whole, heat = broken(torque.rows.segment[k], torque.rows.t[k], power[k], dissipated[k])
    return Chart(
        title=f"Mechanical power of {torque.joint} over time, and that of its friction",
        x=t,
        series=(Series("into friction", heat, "tone-3"), Series("torque × speed", whole, "text")),
        x_label="time [s]",
        y_label="power [W]",
        link=link,
        height=120,
    )


def _residual(torque: JointTorque, dependence: Dependence, link: str, points: int) -> Chart:
    name, unit = dependence.name, dependence.unit
    x = torque.rows.time if name == "time" else torque.quantities[name][1]
    rows = np.flatnonzero(torque.used)
    rows = rows[np.argsort(x[rows])]
    k = rows[spread_rows(len(rows), points)]
    mean, error = dependence.at(x[k])
    is_one = name == "time" and len(torque.rows.recordings) == 1
    residual, less = torque.against_time if name == "time" else (torque.residual, "")
    explained = f" minus its mean over {less}" if less else ""
    return Chart(
        title=f"Residual of {torque.joint}{explained} against {name}, with its mean and 95 % "
        "interval",
        x=x[k],
        series=(
            Series("residual", residual[k], "residual", "dots", is_weak=True),
            Series("mean", mean, "text", half=QUANTILE * error),
        ),
        x_label=f"{name} [{unit}]",
        y_label=f"residual [{torque.unit}]",
        link=link if is_one else "",
        height=120,
    )


def _first(torque: JointTorque, points: int) -> Array:
    """Return samples spread evenly over the first recording."""
    own = np.flatnonzero(torque.rows.recording == 0)
    return own[spread_rows(len(own), points)]
