"""Payloads of links from a run with and a run without them, and gains from a known mass."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import is_number, require_each, require_kind
from robotid.base.typing import Array
from robotid.data.files.read import Readable
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.decisions import BEYOND_NOISE
from robotid.diagnosis.verdict.scale_check import PayloadCheck
from robotid.dynamics.factors import join
from robotid.estimation.estimators import Consistent, Constraints, Estimate
from robotid.estimation.estimators.estimator import quantile
from robotid.estimation.estimators.two_runs import Compared, TwoRuns, payload_runs
from robotid.estimation.fitting.estimator_settings import ConsistentSettings
from robotid.estimation.fitting.fit import MOST_LOADS
from robotid.estimation.fitting.recorded import Recordings
from robotid.identification.parameter_table import about_com
from robotid.identification.pipeline import in_memory, logs_of, robot_of, with_drives
from robotid.robot.bodies import link_transfer, parameters_about, usual_links
from robotid.robot.closure import refuse_loops
from robotid.robot.drive_term import DriveTerm
from robotid.robot.drives import AUTO, wanted_families
from robotid.robot.model import RobotModel
from robotid.robot.parameters import ParameterLayout
from robotid.robot.prior import payload_spread, prior_spread

_DETERMINED = 0.3  # largest standard error of a determined mass or inertia, as a share of it
_SMALL = 0.05  # ... of a determined centre of mass over the robot's length; a small mass over its
_SAME = 1e-3  # of the largest column of a link: below, motion does not determine a parameter
_CONVERGED = 1e-4  # relative change of the parameters at convergence
_NONE = 1e-6  # weight of the prior in the fit that makes a payload consistent, and its least error
_PACKED = ((0, 1, 3), (1, 2, 4), (3, 4, 5))  # places of a matrix among xx xy yy xz yz zz


@dataclass(frozen=True, eq=False)
class Payload:
    """Payload of a link, in the frame of the link."""

    link: str
    mass: float  # [kg]
    mass_std_error: float  # [kg]; 0 if the mass was stated
    mass_interval: Array  # 95 % interval of it, shape (2,) [kg]
    com: Array  # centre of mass, shape (3,) [m]
    com_std_error: Array  # its standard errors, shape (3,) [m]
    inertia: Array  # about the centre of mass, axes of the link, shape (3, 3) [kg m^2]
    inertia_std_error: Array  # its standard errors, shape (3, 3) [kg m^2]
    reasons: Mapping[str, str]  # why some of "com" and "inertia" are not determined, by name

    @property
    def determined(self) -> tuple[str, ...]:
        """Those of "mass", "com" and "inertia" that the motion determines."""
        return tuple(name for name in ("mass", "com", "inertia") if name not in self.reasons)

    @property
    def inertia_at_link(self) -> Array:
        """Inertia about the origin of the link's frame, shape (3, 3) [kg m^2]."""
        return np.asarray(self.parameters[4:][(_PACKED,)])

    @property
    def parameters(self) -> Array:
        """The ten inertial parameters in the link's frame, shape (10,)."""
        return parameters_about(self.mass, self.com, self.inertia)

    def lines(self) -> list[str]:
        """Return mass, centre of mass and inertia as text, or why they are not determined."""
        low, high = self.mass_interval.tolist()
        known = "known" if self.mass_std_error == 0 else f"95 %: [{low:.4g}, {high:.4g}]"
        lines = [f"{self.link}: {self.mass:.4g} +- {self.mass_std_error:.2g} kg, {known}"]
        diagonals = np.diag(self.inertia), np.diag(self.inertia_std_error)
        for key, words, unit, values, errors in (
            ("com", "centre of mass", "m", self.com, self.com_std_error),
            ("inertia", "inertia about it, diagonal", "kg m^2", *diagonals),
        ):
            pairs = zip(values.tolist(), errors.tolist(), strict=True)
            figures = ", ".join(f"{x:.3g} +- {error:.2g}" for x, error in pairs)
            lines.append(f"  {words}: {self.reasons.get(key, f'{figures} {unit}')}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, None for what is not determined."""
        names = ("com", "com_std_error", "inertia", "inertia_std_error")
        shown = {x: x.removesuffix("_std_error") in self.determined for x in names}
        return {
            "link": self.link,
            "mass": self.mass,
            "mass_std_error": self.mass_std_error,
            "mass_interval": self.mass_interval.tolist(),
            **{name: getattr(self, name).tolist() if shown[name] else None for name in names},
            **({"inertia_at_link": self.inertia_at_link.tolist()} if shown["inertia"] else {}),
            "determined": list(self.determined),
            "reasons": dict(self.reasons),
        }


@dataclass(frozen=True)
class Gain:
    """Torque per current of a joint [N m/A or N/A]."""

    value: float
    std_error: float
    interval: tuple[float, float]  # 95 %


@dataclass(frozen=True, eq=False)
class PayloadFit:
    """Identified payloads, and gains identified from a known payload."""

    model: RobotModel
    payloads: tuple[Payload, ...]  # one per link
    gains: Mapping[str, Gain]  # identified gains, by joint
    names: tuple[str, ...]  # names of the base parameters of the robot without payloads
    base: Array  # base parameters, shape (b,), SI units
    base_error: Array  # their standard errors, (b,), including the uncertainty of the gains
    unexplained: Array  # relative torque error of each joint, shape (n,) [-]
    #: Known masses against those that torque alone determines, by link.
    checks: Mapping[str, PayloadCheck] = field(default_factory=dict)

    def __str__(self) -> str:
        every = [line for payload in self.payloads for line in payload.lines()]
        every += [check.message for check in self.checks.values()]
        every += [
            f"gain of {joint}: {gain.value:.4g} +- {gain.std_error:.2g} "
            f"[{gain.interval[0]:.4g}, {gain.interval[1]:.4g}]"
            for joint, gain in self.gains.items()
        ]
        left = zip(self.model.row_names, 100 * self.unexplained, strict=True)
        every.append(f"torque error [%]: {', '.join(f'{j} {x:.1f}' for j, x in left)}")
        return "\n".join(every)

    def __repr__(self) -> str:
        every = (f"{p.link} {p.mass:.4g} +- {p.mass_std_error:.2g} kg" for p in self.payloads)
        return f"<PayloadFit of {self.model.name}: {', '.join(every)}>"

    def __getitem__(self, link: str) -> Payload:
        return next(payload for payload in self.payloads if payload.link == link)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as ``robotid payload --json`` prints them."""
        content: dict[str, Any] = {
            "robot": self.model.name,
            "payloads": [payload.to_dict() for payload in self.payloads],
            "mass_checks": [check.to_dict() for check in self.checks.values()],
            "relative_error_pct": dict(
                zip(self.model.row_names, (100 * self.unexplained).tolist(), strict=True)
            ),
        }
        if self.gains:
            rows = zip(self.names, self.base.tolist(), self.base_error.tolist(), strict=True)
            content["gains"] = {
                j: {"gain": g.value, "std_error": g.std_error, "interval": list(g.interval)}
                for j, g in self.gains.items()
            }
            content["base_parameters"] = [
                {"name": name, "value": value, "std_error": error} for name, value, error in rows
            ]
        return content


def payload_of(model: RobotModel, link: str, x: Array, C: Array, freedom: Array) -> Payload:
    """Return a payload from its ten parameters; first-order errors of derived quantities."""
    shown, J = about_com(x)
    errors = np.sqrt(np.maximum(np.diag(J @ C @ J.T), 0.0))
    mass, error, t = float(x[0]), float(np.sqrt(C[0, 0])), float(quantile(freedom[:1])[0])
    com, com_error = shown[1:4], errors[1:4]
    inertia, inertia_error = shown[4:][(_PACKED,)], errors[4:][(_PACKED,)]
    moment, largest = float(np.trace(inertia)) / 3, float(inertia_error.max())
    reasons = {}
    if com_error.max() > _SMALL * model.length:
        reasons["com"] = (
            f"its standard error of {com_error.max():.2g} m is too large; record poses of {link} "
            "about all axes"
        )
    if largest > _DETERMINED * moment:
        reasons["inertia"] = (
            f"{link} rotates too little: an inertia about the centre of mass of about "
            f"{moment:.2g} kg m^2 would have a standard error of {largest:.2g}; record fast motion "
            "of the joints next to it, about all axes"
        )
    if error > 0 and mass < BEYOND_NOISE * error:
        words = f"the payload on {link} does not differ significantly from 0 kg"
        reasons = dict.fromkeys(("com", "inertia"), words)
    interval = np.array([mass - t * error, mass + t * error])
    return Payload(link, mass, error, interval, com, com_error, inertia, inertia_error, reasons)


class UndeterminedMassError(DataError):
    """The motion does not determine the mass of a payload."""


def identify_payload(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable],
    reference: Readable | Sequence[Readable],
    *,
    links: Sequence[str] = (),
    masses: Mapping[str, float] | None = None,
    unknown_gains: Sequence[str] = (),
    signals: SignalSettings | None = None,
    friction: str | Mapping[str, str] = AUTO,
) -> PayloadFit:
    """Identify the payloads of links from logs with and logs without them.

    Both runs are fitted together. They share all parameters except the ten of each payload and the
    friction and offsets of the drives, which change with load and temperature.

    Args:
        model: The robot; or the path of its URDF, all of whose joints move.
        logs: Recordings with the payloads: a ``Log``, the path of a file, a DataFrame, or several.
        reference: Recordings without them, in the same forms; what both have belongs to the robot.
        links: Links with the payloads, which may be fixed to a moving link; if empty, the last
            moving link, or the base if it floats.
        masses: Known masses, by link [kg].
        unknown_gains: Joints whose ``tau`` in the logs is a current of unknown gain. A known mass,
            or a joint with a known gain, sets their scale.
        signals: How logs become trajectories; the defaults if None.
        friction: Friction in addition to the model's, as of ``identify``; "auto" selects it on the
            reference.

    Returns:
        The payloads with intervals, physically consistent, and the gains.

    Raises:
        DataError: If a log cannot be used, or the motion does not determine a mass.
        ModelError: If the model is no robot, or a link is not in the URDF.
        SettingsError: If links or gains do not fit the robot.
        NotConvergedError: If a solver fails.
    """
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    require_each(links, str, "links", "names of links")
    require_each(unknown_gains, str, "unknown_gains", "names of joints")
    require_kind(masses, (Mapping, type(None)), "masses", "a table of masses [kg] by link")
    model = robot_of(model, logs)
    settings = signals or SignalSettings()
    wanted_families(friction, model.joints)
    read = [logs_of(model, given) for given in (logs, reference)]
    loaded, without = (in_memory(model, settings, some) for some in read)
    for what, runs in (("logs", loaded), ("reference", without)):
        if not runs.fitted:
            raise DataError(
                f"{what} has no log, expected at least one: logs with the payload, and a reference "
                "without it"
            )

    def rescaled(gains: Mapping[str, float]) -> Recordings:
        factor = np.array([gains.get(joint, 1.0) for joint in model.joints])
        return in_memory(model, settings, [replace(log, tau=factor * log.tau) for log in read[1]])

    return fit_with_friction(
        loaded, without, friction, rescaled, links=tuple(links) or usual_links(model),
        masses=masses or {}, unknown_gains=unknown_gains,
    )  # fmt: skip


def fit_with_friction(
    loaded: Recordings,
    reference: Recordings,
    friction: str | Mapping[str, str],
    rescaled: Callable[[Mapping[str, float]], Recordings],
    *,
    links: Sequence[str],
    masses: Mapping[str, float],
    unknown_gains: Sequence[str] = (),
) -> PayloadFit:
    """Identify payloads with the friction that the reference shows, and check known masses."""
    # friction is a torque, not a current: ``rescaled`` returns the reference with identified gains
    fitted = partial(fit_payloads, links=links, masses=masses, unknown_gains=unknown_gains)
    fit = fitted(loaded, reference)
    gains = {joint: gain.value for joint, gain in fit.gains.items()}
    wanted = wanted_families(friction, reference.model.joints)
    own: Mapping[str, tuple[DriveTerm, ...]] = {}
    if any(names != () for names in wanted.values()):
        judged = rescaled(gains) if gains else reference
        own = with_drives(judged, ConsistentSettings(), wanted).model.layout.own
    if own:
        model = reference.model.with_terms(own)
        loaded, reference = (run.with_model(model) for run in (loaded, reference))
        fit = fitted(loaded, reference)
    if masses and not unknown_gains:
        fit = replace(fit, checks=mass_checks(loaded, reference, masses=masses, links=links))
    return fit


def mass_checks(
    loaded: Recordings,
    reference: Recordings,
    *,
    masses: Mapping[str, float],
    links: Sequence[str] = (),
) -> dict[str, PayloadCheck]:
    """Return known masses of payloads against those that torque alone determines, by link."""
    _check_known(loaded.model, links or tuple(masses), masses, ())
    try:
        free = fit_payloads(loaded, reference, links=links or tuple(masses), masses={})
    except UndeterminedMassError:
        return {link: PayloadCheck(link, mass) for link, mass in masses.items()}
    checks = {}
    for link, mass in masses.items():
        payload = free[link]
        low, high = payload.mass_interval.tolist()
        checks[link] = PayloadCheck(link, mass, payload.mass, payload.mass_std_error, (low, high))
    return checks


def fit_payloads(
    loaded: Recordings,
    reference: Recordings,
    *,
    links: Sequence[str],
    masses: Mapping[str, float],
    unknown_gains: Sequence[str] = (),
) -> PayloadFit:
    """Identify payloads from recordings, in memory or not; see ``identify_payload``."""
    model = loaded.model
    refuse_loops(model, "the identification of a payload")
    if unknown_gains and (model.free_flyer or model.constraints):  # constraints mix the rows
        raise SettingsError(
            f"unknown gains are given for {listed(unknown_gains)}; gains are identified for a "
            "robot with a fixed base, without contacts and loops. Set them"
        )
    if not loaded.model.layout.remembering:
        return _fit(loaded, reference, links, masses, unknown_gains)
    # the unknown bodies load the gears
    bodies, before = model.standard_parameters(), np.inf
    added = np.zeros_like(bodies)
    for _ in range(MOST_LOADS):
        ground, other = (
            run.with_model(run.model.with_reference(pi))
            for run, pi in ((reference, bodies), (loaded, bodies + added))
        )
        fit = _fit(other, ground, links, masses, unknown_gains)
        size = float(np.linalg.norm(fit.base))
        if abs(size - before) < _CONVERGED * size:
            return fit
        before = size
        bodies = ground.mapping.to_standard(fit.base, ground.model.standard_parameters())
        added = np.zeros_like(bodies)
        for payload in fit.payloads:
            body, transfer = link_transfer(ground.model, payload.link)
            added[10 * body : 10 * body + 10] += transfer @ payload.parameters
    raise NotConvergedError(
        f"the joint load torque has not converged after {MOST_LOADS} fits; use friction = "
        "'viscous+coulomb', or record a richer motion",
        "max_iterations",
    )


def _fit(
    loaded: Recordings,
    reference: Recordings,
    links: Sequence[str],
    masses: Mapping[str, float],
    unknown_gains: Sequence[str],
) -> PayloadFit:
    """Fit two runs with the joint load torques of their models."""
    model = loaded.model
    columns = _payload_columns(model, loaded.mapping.K, links)
    _check_known(model, links, masses, unknown_gains)
    known = np.full(10 * len(links), np.nan)
    known[[10 * links.index(link) for link in masses]] = list(masses.values())
    first, second = reference.reduce(), loaded.reduce()
    whole = join([*first, *second])
    runs = payload_runs(
        first, second, model.layout, loaded.mapping.K, model.standard_parameters(),
        prior_spread(model, whole.squares, whole.samples),
        (columns, known, np.tile(payload_spread(model), len(links))),
        share=min(loaded.share, reference.share),
        unknown=[model.joints.index(joint) for joint in unknown_gains],
    )  # fmt: skip
    compared = runs.compare()
    x, C, freedom = _payload_parameters(compared, known)
    for k, link in enumerate(links):
        _check_mass(model, link, x[10 * k], np.sqrt(C[10 * k, 10 * k]), link in masses)
    possible = _possible(model, links, x, C, masses)
    payloads = tuple(
        payload_of(model, link, possible[part], C[part, part], freedom[part])
        for k, link in enumerate(links)
        for part in [slice(10 * k, 10 * k + 10)]
    )
    b = len(runs.known)
    base_error = np.sqrt(np.diag(compared.covariance)[:b])
    return PayloadFit(
        model, payloads, _gains(model, runs, compared), loaded.mapping.base_names,
        compared.theta[:b], base_error, compared.unexplained,
    )  # fmt: skip


def _payload_columns(model: RobotModel, K: Array, links: Sequence[str]) -> Array:
    """Return the columns from the ten parameters of each payload to base parameters, (b, 10 k)."""
    columns, bodies = [], dict[int, str]()
    for link in links:
        body, transfer = link_transfer(model, link)
        if body < 0:
            raise SettingsError(
                f"{link} does not move, so no torque depends on its payload; name a moving link"
            )
        if body in bodies:
            raise SettingsError(
                f"{bodies[body]} and {link} belong to one moving body, {model.layout.bodies[body]}:"
                " torques do not distinguish their payloads; name one of them"
            )
        bodies[body] = link
        own = K[:, 10 * body : 10 * body + 10] @ transfer
        if np.abs(own[:, 0]).max(initial=0.0) < _SAME * np.abs(own).max(initial=1e-300):
            raise UndeterminedMassError(
                f"no motion determines the mass of the payload on {link}: no joint lifts or "
                "accelerates it; measure it with a scale"
            )
        columns.append(own)
    return np.hstack(columns)


def _check_known(
    model: RobotModel, links: Sequence[str], masses: Mapping[str, float], gains: Sequence[str]
) -> None:
    for link, mass in masses.items():
        if link not in links:
            raise SettingsError(
                f"a mass is given for {link}, but the payloads are on {listed(links)}; add the "
                "link to these"
            )
        if not (is_number(mass) and 0 < mass < 1e6):
            raise SettingsError(
                f"the mass of the payload on {link} is {mass!r} kg, expected more than 0 and less "
                "than 1e6"
            )
    unknown = [joint for joint in gains if joint not in model.joints]
    if unknown:
        raise SettingsError(
            f"unknown gains are given for {listed(unknown)}, which are not identified joints; "
            f"joints: {listed(model.joints)}"
        )
    if len(gains) == len(model.joints) and not masses:
        raise SettingsError(
            "all gains are unknown and no mass is known: their scale is not determined; set "
            "the mass of the payload, or the gain of one joint that it loads"
        )


def _payload_parameters(compared: Compared, known: Array) -> tuple[Array, Array, Array]:
    """Return all ten parameters of each payload, their covariance and degrees of freedom."""
    x, C = np.nan_to_num(known), np.zeros((len(known), len(known)))
    freedom, free = np.full(len(known), np.inf), np.flatnonzero(np.isnan(known))
    at = slice(len(compared.theta) - len(free), len(compared.theta))
    x[free], freedom[free] = compared.theta[at], compared.freedom[at]
    C[np.ix_(free, free)] = compared.covariance[at, at]
    return x, C, freedom


def _check_mass(model: RobotModel, link: str, mass: float, error: float, is_known: bool) -> None:
    """Check that the motion determines the mass, and that the runs are not swapped."""
    if is_known:
        return
    arm = payload_spread(model)[0]
    if error > _DETERMINED * max(abs(mass), _SMALL * arm):
        raise UndeterminedMassError(
            f"the motion does not determine the mass of the payload on {link}: {mass:.3g} +- "
            f"{error:.2g} kg; record poses and motions in which its gravity loads different "
            "joints, with and without the payload"
        )
    if mass < -BEYOND_NOISE * error:
        raise DataError(
            f"{link} carries {-mass:.3g} +- {error:.2g} kg less than in the reference: the "
            "reference contains the payload; swap the logs and the reference"
        )


def _possible(
    model: RobotModel, links: Sequence[str], x: Array, C: Array, masses: Mapping[str, float]
) -> Array:
    """Return the physically consistent parameters nearest to x in the metric of its covariance."""
    spread, r = payload_spread(model), model.length
    mass = np.maximum(np.abs(x[::10]), _SMALL * spread[0])[:, None]
    scale = (mass * spread / spread[0]).reshape(-1)
    ball = mass * [1.0, 0.0, 0.0, 0.0, r**2, 0.0, r**2, 0.0, 0.0, r**2]
    stated = {link: (masses[link], masses[link]) for link in links if link in masses}
    fit = Consistent(
        layout=ParameterLayout(tuple(links), (), ()), K=np.eye(len(x)), prior=ball.reshape(-1),
        prior_std=scale, prior_weight=_NONE, constraints=Constraints(mass=stated),
    )  # fmt: skip
    # a stated mass has no covariance; its constraint fixes it. Data without noise have almost none
    exact = np.diag(np.where(np.diag(C) == 0, scale, _NONE * scale) ** 2)
    names, rank = fit.layout.names, len(x)
    start = Estimate(x, C + exact, names, np.ones(1), rank, 1.0, (), True, 0, "two runs")
    return fit.project(start).theta


def _gains(model: RobotModel, runs: TwoRuns, compared: Compared) -> dict[str, Gain]:
    first, gains = len(compared.theta), {}
    errors = np.sqrt(np.diag(compared.covariance)[first:])  # of the logarithms
    half_widths = quantile(compared.freedom[first:]) * errors
    for j, error, half in zip(runs.unknown, errors.tolist(), half_widths.tolist(), strict=True):
        value = float(compared.gain[j])
        low, high = sorted([value * np.exp(-half), value * np.exp(half)])
        gains[model.joints[j]] = Gain(value, abs(value) * error, (low, high))
    return gains
