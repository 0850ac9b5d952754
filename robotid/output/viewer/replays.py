"""Replay of a motion: the robot in Meshcat's viewer, with torques and parameters, as one page.

Meshcat's own export needs a server process. Here the page contains the viewer and its data, so
no process, socket or port is needed.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import pinocchio as pin

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.files import write_text
from robotid.base.settings import is_number, require_each, require_kind
from robotid.base.typing import Array, real_numbers
from robotid.output.pages.html import asset, packed, scaffold, script_json, stepped
from robotid.output.viewer.scene import coordinates, mass_marks, robot_scene
from robotid.robot.model import RobotModel

_ASSETS = Path(__file__).parent / "assets"
_SCRIPTS = (
    *("data", "scene", "masses", "arcs", "strip", "choice", "plots"),
    *("clock", "picking", "controls", "embed", "start"),
)
_NUMBERS = 500_000  # of a motion, or of all plots: about 3 MB
_BINS = 480  # columns of the heat strip
_PLOT_RATE = 50.0  # [Hz] points of a plot per second
_DATA_RANGE = 100  # poses that determine the camera's view
_GAP = 0.25  # [s] a longer time without samples is a gap ...
_TIMES = 5.0  # ... if it is this multiple of the typical one


@dataclass(frozen=True, eq=False)
class Torques:
    """Torques to plot with a motion, or positions of position-controlled drives."""

    t: Array  # (N,), times on the clock of the motion [s]
    measured: Array  # (N, n) [N m or N]
    # predicted torques by the name of the model, (N, n) each, NaN where there is no prediction;
    # arcs, links and the heat strip show the residual of the first, until another is selected
    predicted: Mapping[str, Array] = field(default_factory=dict)
    # scale of the residuals, (n,): the RMS residual of each joint on the fitted logs of the first
    # model, the RMS torque if None; of positions, the RMS error of the command
    noise: Array | None = None
    quantity: str = "torque"  # or "position", whose units are the joints' [rad or m]


@dataclass(frozen=True, eq=False)
class Bands:
    """Parameters over time, from a recursive estimator."""

    t: Array  # (K,), times on the clock of the motion [s]
    names: Sequence[str]  # of the b parameters, as ``forearm.mcx``
    units: Sequence[str]
    theta: Array  # (K, b), values
    std_error: Array  # (K, b)


@dataclass(frozen=True)
class Mark:
    """An event on the time line."""

    t: float  # on the clock of the motion [s]
    label: str
    kind: str = "note"  # "payload", "gap" or "note"
    joint: str = ""  # the affected joint, if any


@dataclass(frozen=True, eq=False)
class Replay:
    """A page that plays a motion; a notebook shows it as the value of a cell."""

    data: Mapping[str, Any]  # content of the page, in plain values

    @cached_property
    def html(self) -> str:
        """The page."""
        return page(self.data)

    def write(self, target: str | Path) -> Path:
        """Write the page."""
        return write_text(self.html, target)

    def _repr_html_(self) -> str:
        # its scripts have no access to the notebook
        return (
            f'<iframe title="{escape(self.data["title"])}: replay" sandbox="allow-scripts" '
            f'srcdoc="{escape(self.html)}" style="width: 100%; height: 620px; border: 0"></iframe>'
        )


def replay(
    model: RobotModel,
    t: Array,
    q: Array,
    *,
    torques: Torques | None = None,
    masses: Mapping[str, Array] | None = None,
    ghosts: Mapping[str, tuple[Array, Array]] | None = None,
    bands: Bands | None = None,
    marks: Sequence[Mark] = (),
    notes: Sequence[str] = (),
    log: str = "",
    rate: float = 30.0,
) -> Replay:
    """Return a page that plays a motion in real time, in three dimensions.

    Args:
        model: The robot; the meshes of its URDF are shown if they are found.
        t: Times, shape (N,), strictly increasing [s].
        q: Joint coordinates, shape (N, n), or (N, 7 + n) with a floating base [rad, m].
        torques: Torques to plot, and to draw as arcs around the joints.
        masses: Standard parameters by label, shape (p,) each: centres of mass and equimomental
            ellipsoids of the links, as ``{"URDF": prior, "identified": pi}``.
        ghosts: Times and joint coordinates of other motions by their labels, shown as ghosts that
            start with the first motion.
        bands: Parameters over time to plot.
        marks: Events to mark.
        notes: Sentences for the head of the page.
        log: Name of the recording's file; a report of this recording shares its clock.
        rate: Largest number of keyframes per second [Hz]; fewer for long motions, to limit the
            page's size.

    Returns:
        The page.

    Raises:
        DataError: If times and values are inconsistent with each other or with the model.
        SettingsError: If the rate is not positive.
    """
    require_kind(model, RobotModel, "model", "a robotid.RobotModel")
    for name, value, kind, wanted in (
        ("torques", torques, Torques, "Torques"), ("bands", bands, Bands, "Bands"),
        ("masses", masses, Mapping, "a table of standard parameters by label"),
        ("ghosts", ghosts, Mapping, "a table of motions (t, q) by label"),
    ):  # fmt: skip
        require_kind(value, (kind, type(None)), name, wanted)
    require_each(marks, Mark, "marks", "a list of marks")
    require_each(notes, str, "notes", "a list of sentences")
    require_kind(log, str, "log", "the name of a file")
    for label, pi in (masses or {}).items():
        _check_masses(model, label, pi)
    _check(t, q, rate)
    others = dict(ghosts or {})
    for label, path in others.items():
        require_each([label], str, "the label of a ghost", "text")
        if len(require_each(path, np.ndarray, f"ghost {label!r}", "two arrays, t and q")) != 2:
            raise SettingsError(f"ghost {label!r} has {len(path)} arrays, wanted two, t and q")
        _check(*path, rate)
    gaps = [Mark(float(t[k]), f"gap of {t[k + 1] - t[k]:.2f} s", "gap") for k in _gaps(t)]
    scene = robot_scene(model)
    motions = [q, *(path for _, path in others.values())]
    data = {
        "title": model.name,
        "scene": scene.content,
        "start": float(t[0]),
        "log": log,
        "motion": _moved(model, t, q, rate),
        "ghosts": [{"label": x, **_moved(model, *path, rate)} for x, path in others.items()],
        "masses": [mass_marks(model, pi, label) for label, pi in (masses or {}).items()],
        "torques": None if torques is None else _torque_data(model, torques, t),
        "bands": None if bands is None else _band_data(bands, float(t[0])),
        "marks": [vars(mark) for mark in sorted((*marks, *gaps), key=lambda mark: mark.t)],
        "notes": [*notes, *_fixed_base(model), *(f"{note}." for note in scene.notes)],
        "view": _view(model, scene.corners, motions),
    }
    return Replay(data)


def _check_masses(model: RobotModel, label: str, pi: Array) -> None:
    """Refuse labelled values that are not standard parameters, all or the inertial ones."""
    require_kind(label, str, "the label of masses", "text")
    require_kind(pi, np.ndarray, f"masses of {label!r}", "an array of standard parameters")
    sizes = model.layout.n_inertial, len(model.layout.names)
    values = real_numbers(pi, f"masses of {label!r}")
    if values.shape not in [(size,) for size in sizes] or not np.isfinite(values).all():
        raise DataError(
            f"masses of {label!r} have shape {values.shape}, wanted {sizes[0]} or {sizes[1]} "
            "finite numbers, as of model.standard_parameters()"
        )


def _check(t: Array, q: Array, rate: float) -> None:
    for name, values in (("t", t), ("q", q)):
        require_kind(values, np.ndarray, name, "an array of numbers")
        if values.dtype.kind not in "biuf":
            raise DataError(f"{name} is an array of {values.dtype}, wanted numbers")
    if not (is_number(rate) and rate > 0):
        raise SettingsError(f"rate is {rate!r}, wanted a positive number of keyframes per second")
    if t.ndim != 1 or q.ndim != 2 or len(t) != len(q):
        raise DataError(f"t has shape {t.shape} and q {q.shape}, wanted (N,) and (N, n)")
    if len(t) < 2:
        raise DataError(f"the motion has {len(t)} samples, wanted at least 2 to play")
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise DataError("t or q has values that are not finite; exclude those samples")
    reversed_rows = np.flatnonzero(np.diff(t) <= 0)
    if len(reversed_rows):
        k = int(reversed_rows[0])
        raise DataError(
            f"t must increase, but t[{k + 1}] = {t[k + 1]:.15g} s follows t[{k}] = {t[k]:.15g} s"
        )


def _keyframes(t: Array, rate: float, most: int) -> Array:
    """Return the samples to show: the last before each tick of the rate, and the last one."""
    ticks = np.linspace(t[0], t[-1], min(int((t[-1] - t[0]) * rate) + 2, max(most, 2)))
    return np.unique(np.searchsorted(t, ticks, side="right") - 1)


def _gaps(t: Array) -> list[int]:
    steps = np.diff(t)
    return np.flatnonzero((steps > _GAP) & (steps > _TIMES * np.median(steps))).tolist()


def _moved(model: RobotModel, t: Array, q: Array, rate: float) -> dict[str, Any]:
    """Return times from 0 and the displacement of each joint, at the keyframes."""
    model.configurations(q)  # refuses a wrong width of q
    q = q.copy()
    base = 7 if model.free_flyer else 0
    free = [base + j for j, joint in enumerate(model.limits) if joint.turns_freely]
    q[:, free] = np.unwrap(q[:, free], axis=0)
    if base:  # a quaternion and its negative are one pose, but not between keyframes
        turn = (q[1:, 3:7] * q[:-1, 3:7]).sum(axis=1) < 0
        q[1:, 3:7] *= np.where(np.cumsum(turn) % 2, -1.0, 1.0)[:, None]
    rows = _keyframes(t, rate, _NUMBERS // q.shape[1])
    return {"t": packed(t[rows] - t[0]), "q": packed(coordinates(model, q[rows]))}


def _fixed_base(model: RobotModel) -> list[str]:
    """Return a note for a trunk with several limbs whose motion is unknown."""
    limbs = sum(int(parent) == 0 for parent in list(model.pin_model.parents)[1:])
    if limbs <= 1 or model.free_flyer:
        return []
    return ["The base is drawn as fixed: the log has no pose of the base."]


def _torque_data(model: RobotModel, torques: Torques, t: Array) -> dict[str, Any]:
    series = [torques.measured, *torques.predicted.values()]
    labels, wanted = ["measured", *torques.predicted], (len(torques.t), len(model.joints))
    for label, values in zip(labels, series, strict=True):
        if values.shape != wanted:
            raise DataError(f"torques {label!r} have shape {values.shape}, wanted {wanted}")
    rms = np.sqrt(np.nanmean(torques.measured**2, axis=0))
    noise = rms if torques.noise is None else np.asarray(torques.noise, dtype=float)
    if noise.shape != wanted[1:]:
        raise DataError(f"noise has shape {noise.shape}, wanted {wanted[1:]}")
    units = model.row_units[-len(model.joints) :]
    full, unit = (0.5, "RMS torque") if torques.noise is None else (6.0, "RMS noise")
    if torques.quantity == "position":
        full, unit = 0.25, "RMS command error"
        units = tuple("m" if joint in model.layout.prismatic else "rad" for joint in model.joints)
    scale = {"of": np.where(noise > 0, noise, 1.0).tolist(), "full": full, "unit": unit}
    edges = np.linspace(t[0], t[-1], min(_BINS, max(len(torques.t) // 4, 1)) + 1)
    switched = series[1:] if torques.quantity == "torque" else series[1:2]
    levels = [residual_levels(edges, torques.t, series[0] - other) for other in switched]
    strips = [packed(_coded(level, np.array(scale["of"])), "<u2") for level in levels]
    times, values = _plotted(torques.t - t[0], np.hstack(series))
    return {
        "quantity": torques.quantity,
        "joints": [
            {"name": name, "unit": unit, "node": int(model.pin_model.getJointId(name))}
            for name, unit in zip(model.joints, units, strict=True)
        ],
        "labels": labels,
        "scale": scale,
        "strips": strips,
        "t": packed(times),
        "values": stepped(values),
    }


def _coded(levels: Array, of: Array) -> Array:
    """Return residuals in hundredths of their scale; 65,534: not used, 65,535: a gap."""
    hundredths = np.minimum(np.round(100 * levels / of), 60_000)
    return np.where(np.isnan(levels), 65_535, np.where(levels < 0, 65_534, hundredths))


def _band_data(bands: Bands, start: float) -> dict[str, Any]:
    t, values = _plotted(bands.t - start, np.hstack([bands.theta, bands.std_error]))
    return {"names": list(bands.names), "units": list(bands.units), "t": packed(t),
            "values": packed(values)}  # fmt: skip


def _plotted(t: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples of a plot, with a row of NaN in each gap."""
    rows = _keyframes(t, _PLOT_RATE, _NUMBERS // max(values.shape[1], 1))
    holes = np.array(_gaps(t), dtype=int)
    rows = np.unique(np.r_[rows, holes, holes + 1])
    after = np.searchsorted(rows, holes) + 1
    times = np.insert(t[rows], after, (t[holes] + t[holes + 1]) / 2)
    return times, np.insert(values[rows], after, np.nan, axis=0)


def _view(model: RobotModel, corners: Sequence[Array], motions: Sequence[Array]) -> dict[str, Any]:
    """Return the outermost points of a motion, relative to a floating base, and a ground grid."""
    data = model.pin_model.createData()
    points, lowest, first = [], np.inf, int(model.free_flyer)  # without the world's corner
    for q in motions:
        rows = np.unique(np.linspace(0, len(q) - 1, _DATA_RANGE).astype(int))
        for configuration in model.configurations(q[rows]):
            pin.forwardKinematics(model.pin_model, data, configuration)
            base = configuration[:3] if model.free_flyer else np.zeros(3)
            for M, own in zip(list(data.oMi)[first:], corners[first:], strict=True):
                places = own @ M.rotation.T + M.translation
                lowest = min(lowest, float(places[:, 2].min()))
                points.append(places - base)
    places = np.vstack(points)
    towards = np.array([d for d in itertools.product((-1, 0, 1), repeat=3) if any(d)], dtype=float)
    outermost = places[np.unique((places @ towards.T).argmax(axis=0))]
    radius = float(np.linalg.norm(np.ptp(places, axis=0)) / 2) or 0.1
    # the camera is 2.8 radii away; the grid of 40 by 40 cells ends before it
    decade = 10.0 ** math.floor(math.log10(radius / 8.0))
    cell = max(step for step in (decade, 2.0 * decade, 5.0 * decade) if step <= radius / 8.0)
    # the ground is at 0, or below a robot that extends below 0
    ground = lowest if lowest < -0.1 * radius else 0.0
    return {"points": outermost.tolist(), "radius": radius, "cell": cell, "ground": ground}


def residual_levels(edges: Array, t: Array, residual: Array) -> Array:
    """Return the RMS (B, n) of residuals (N, n) at t (N,) between edges (B + 1,) of time."""
    bins = len(edges) - 1
    which = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, bins - 1)
    samples = np.bincount(which, minlength=bins)
    levels = np.full((bins, residual.shape[1]), np.nan)
    for j, known in enumerate(np.isfinite(residual).T):
        count = np.bincount(which[known], minlength=bins)
        square = np.bincount(which[known], residual[known, j] ** 2, minlength=bins)
        levels[:, j] = np.where(samples > 0, -1.0, np.nan)
        levels[count > 0, j] = np.sqrt(square[count > 0] / count[count > 0])
    return levels


def page(data: Mapping[str, Any]) -> str:
    """Return the page of a replay. It loads nothing."""
    title = f"{data['title']}: replay"
    policy = "; script-src 'unsafe-inline'; img-src data: blob:"
    style = f"{asset('uPlot.min.css')}\n/*tones*/{asset('charts.css')}{_asset('replay.css')}"
    body = Template(_asset("replay.html")).substitute(
        title=escape(title),
        notes=" ".join(f"<p>{escape(note)}</p>" for note in data["notes"]),
        data=script_json(data),
        viewer=_viewer(),
        uplot=asset("uPlot.iife.min.js"),
        charts=asset("charts.js"),
        script=_script(),
    )
    head = f'<link rel="icon" href="data:,">\n<style>{style}</style>\n'
    return scaffold(title, head, body, policy=policy)


@cache
def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


@cache
def _script() -> str:
    """Return the sections of the page's script as one script in its own scope."""
    sections = "".join(_asset(f"{name}.js") for name in _SCRIPTS)
    return f'"use strict";\n(() => {{\n{sections}}})();\n'


@cache
def _viewer() -> str:
    import meshcat

    viewer = Path(meshcat.viewer_assets_path()) / "dist" / "main.min.js"
    return viewer.read_text(encoding="utf-8")
