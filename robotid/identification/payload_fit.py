"""Payload identification from a run with and a run without it, and gains from a known mass."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import is_number, require_each, require_kind
from robotid.base.typing import Array
from robotid.data.files.read import Readable, read_logs
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.verdict.payload_check import PayloadCheck
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.constraint_rows import logged_base
from robotid.dynamics.factors import join
from robotid.estimation.estimators import Consistent, Constraints, Estimate
from robotid.estimation.estimators.segments import quantile
from robotid.estimation.estimators.two_runs import Compared, TwoRuns, payload_runs
from robotid.estimation.fitting.estimator_settings import ConsistentSettings
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.fitting.survey import hold_log
from robotid.identification.payload_estimate import Gain, PayloadFit, payload_of
from robotid.identification.pipeline import robot_of, with_drives
from robotid.robot.bodies import link_transfer, usual_links
from robotid.robot.closure import refuse_loops
from robotid.robot.drives import DriveTerm
from robotid.robot.families import AUTO, wanted_families
from robotid.robot.model import RobotModel
from robotid.robot.parameters import ParameterLayout
from robotid.robot.prior import payload_spread, prior_spread

_SIGNIFICANT = 3.0  # standard errors from which a mass differs from 0
_MASS = 0.3  # largest standard error of a determined mass, as a share of that mass,
_SMALL = 0.05  # ... or of this share of the robot's mass
_COM = 0.05  # ... of a determined centre of mass, as a share of the robot's length
_INERTIA = 0.3  # ... of a determined inertia about it, as a share of the mean principal moment
_SAME = 1e-3  # of the largest column of a link: below, motion does not determine a parameter
_MOST_LOADS = 20  # fits until the joint load torque is that of the identified bodies
_CONVERGED = 1e-4  # relative change of the parameters at convergence
_FREE = 1e-6  # weight of the prior in the fit that makes a payload consistent: none
_EXACT = 1e-6  # smallest standard error in that fit, as a share of a parameter's size


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
    for name, value, wanted in (
        ("links", links, "names of links"),
        ("unknown_gains", unknown_gains, "names of joints"),
    ):
        require_each(value, str, name, wanted)
    require_kind(masses, (Mapping, type(None)), "masses", "a table of masses [kg] by link")
    model = robot_of(model, logs)
    refuse_loops(model, "the identification of a payload")
    _check_gains(model, unknown_gains)
    settings, mapping = signals or SignalSettings(), structural_mapping(model)
    wanted_families(friction, model.joints)
    read = [
        read_logs(
            given,
            model.joints,
            prismatic=model.layout.prismatic,
            base=logged_base(model),
            passive=model.passive,
            robot=model.tree.movable,
        )
        for given in (logs, reference)
    ]
    loaded, without = (
        Recordings(model, mapping, [hold_log(model, log, settings) for log in some])
        for some in read
    )
    for what, runs in (("logs", loaded), ("reference", without)):
        if not runs.fitted:
            raise DataError(
                f"{what} has no log, wanted at least one: logs with the payload, and a reference "
                "without it"
            )
    links = tuple(links) or usual_links(model)

    def fitted(runs: Sequence[Recordings]) -> PayloadFit:
        return fit_payloads(*runs, links=links, masses=masses or {}, unknown_gains=unknown_gains)

    found = fitted((loaded, without))
    gain = np.array([found.gains[j].value if j in found.gains else 1.0 for j in model.joints])
    judged = without
    if found.gains:  # friction is a torque, not a current
        torques = [replace(log, tau=gain * log.tau) for log in read[1]]
        judged = replace(without, fitted=[hold_log(model, log, settings) for log in torques])
    own = own_friction(judged, friction)
    if own:
        loaded, without = (run.with_model(model.with_terms(own)) for run in (loaded, without))
        found = fitted((loaded, without))
    if masses and not unknown_gains:
        found = replace(found, checks=mass_checks(loaded, without, masses=masses, links=links))
    return found


def _check_gains(model: RobotModel, unknown: Sequence[str]) -> None:
    """Refuse unknown gains where constraint forces are eliminated, which mixes the rows."""
    if unknown and (model.free_flyer or model.constraints):
        raise SettingsError(
            f"unknown gains are stated for {listed(unknown)}; gains are identified for a robot "
            "with a fixed base, without contacts and loops. State them"
        )


def own_friction(
    reference: Recordings, friction: str | Mapping[str, str]
) -> Mapping[str, tuple[DriveTerm, ...]]:
    """Return the friction terms of a reference in addition to the model's, by drive."""
    wanted = wanted_families(friction, reference.model.joints)
    if all(names == () for names in wanted.values()):
        return {}
    return with_drives(reference, ConsistentSettings(draws=0), wanted).model.layout.own


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
        found = fit_payloads(loaded, reference, links=links or tuple(masses), masses={})
    except UndeterminedMassError:
        return {link: PayloadCheck(link, mass) for link, mass in masses.items()}
    checks = {}
    for link, mass in masses.items():
        own = found[link]
        low, high = own.mass_interval.tolist()
        checks[link] = PayloadCheck(link, mass, own.mass, own.mass_std_error, (low, high))
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
    refuse_loops(loaded.model, "the identification of a payload")
    _check_gains(loaded.model, unknown_gains)
    if not loaded.model.layout.remembering:
        return _fit(loaded, reference, links, masses, unknown_gains)
    # the unknown bodies load the gears
    bodies, before = loaded.model.standard_parameters(), np.inf
    payload = np.zeros_like(bodies)
    for _ in range(_MOST_LOADS):
        ground, other = (
            run.with_model(run.model.with_reference(pi))
            for run, pi in ((reference, bodies), (loaded, bodies + payload))
        )
        found = _fit(other, ground, links, masses, unknown_gains)
        size = float(np.linalg.norm(found.base))
        if abs(size - before) < _CONVERGED * size:
            return found
        bodies, payload = _loads(found, ground)
        before = size
    raise NotConvergedError(
        f"the joint load torque has not converged after {_MOST_LOADS} fits; use friction = "
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
        first,
        second,
        model.layout,
        loaded.mapping.K,
        model.standard_parameters(),
        prior_spread(model, whole.squares, whole.samples),
        (columns, known, np.tile(payload_spread(model), len(links))),
        share=min(loaded.share, reference.share),
        unknown=[model.joints.index(joint) for joint in unknown_gains],
    )
    found = runs.compare()
    x, C, freedom = _payload_parameters(found, known)
    for k, link in enumerate(links):
        _check_mass(model, link, x[10 * k], np.sqrt(C[10 * k, 10 * k]), link in masses)
    possible = _possible(model, links, x, C, masses)
    payloads = tuple(
        payload_of(model, link, possible[part], C[part, part], freedom[part])
        for k, link in enumerate(links)
        for part in [slice(10 * k, 10 * k + 10)]
    )
    b = len(runs.known)
    return PayloadFit(
        model,
        payloads,
        _gains(model, runs, found),
        loaded.mapping.base_names,
        found.theta[:b],
        np.sqrt(np.diag(found.covariance)[:b]),
        found.unexplained,
    )


def _loads(found: PayloadFit, reference: Recordings) -> tuple[Array, Array]:
    """Return the standard parameters that load the gears, and the part of the payloads."""
    model = reference.model
    bodies = reference.mapping.to_standard(found.base, model.standard_parameters())
    added = np.zeros_like(bodies)
    for payload in found.payloads:
        body, transfer = link_transfer(model, payload.link)
        added[10 * body : 10 * body + 10] += transfer @ payload.parameters
    return bodies, added


def _payload_columns(model: RobotModel, K: Array, links: Sequence[str]) -> Array:
    """Return the columns from the ten parameters of each payload to base parameters, (b, 10 k)."""
    columns, bodies = [], dict[int, str]()
    for link in links:
        body, transfer = link_transfer(model, link)
        if body < 0:
            raise SettingsError(f"{link} does not move: no torque depends on its payload")
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
                f"a mass is stated for {link}, but the payloads are on {listed(links)}; add the "
                "link to these"
            )
        if not (is_number(mass) and 0 < mass < 1e6):
            raise SettingsError(
                f"the mass of the payload on {link} is {mass!r} kg, wanted more than 0 and less "
                "than 1e6"
            )
    unknown = [joint for joint in gains if joint not in model.joints]
    if unknown:
        raise SettingsError(
            f"unknown gains are stated for {listed(unknown)}, which are not identified joints; "
            f"joints: {listed(model.joints)}"
        )
    if len(gains) == len(model.joints) and not masses:
        raise SettingsError(
            "all gains are unknown and no mass is known: their scale is not determined; state "
            "the mass of the payload, or the gain of one joint that it loads"
        )


def _payload_parameters(found: Compared, known: Array) -> tuple[Array, Array, Array]:
    """Return all ten parameters of each payload, their covariance and degrees of freedom."""
    x, C = np.nan_to_num(known), np.zeros((len(known), len(known)))
    freedom, free = np.full(len(known), np.inf), np.flatnonzero(np.isnan(known))
    at = slice(len(found.theta) - len(free), len(found.theta))
    x[free], freedom[free] = found.theta[at], found.freedom[at]
    C[np.ix_(free, free)] = found.covariance[at, at]
    return x, C, freedom


def _check_mass(model: RobotModel, link: str, mass: float, error: float, is_known: bool) -> None:
    """Check that the motion determines the mass, and that the runs are not swapped."""
    if is_known:
        return
    arm = payload_spread(model)[0]
    if error > _MASS * max(abs(mass), _SMALL * arm):
        raise UndeterminedMassError(
            f"the motion does not determine the mass of the payload on {link}: {mass:.3g} +- "
            f"{error:.2g} kg; record poses and motions in which its gravity loads different "
            "joints, with and without the payload"
        )
    if mass < -_SIGNIFICANT * error:
        raise DataError(
            f"{link} carries {-mass:.3g} +- {error:.2g} kg less than in the reference: the "
            "reference contains the payload; swap the logs and the reference"
        )


def _possible(
    model: RobotModel, links: Sequence[str], x: Array, C: Array, masses: Mapping[str, float]
) -> Array:
    """Return the physically consistent parameters nearest to x in the metric of its covariance."""
    mass = np.maximum(np.abs(x[::10]), _SMALL * payload_spread(model)[0])
    radius = model.length
    unit = np.array([1.0, *[radius] * 3, *[radius**2] * 6])
    scale = (mass[:, None] * unit).reshape(-1)
    ball = mass[:, None] * np.array([1.0, 0, 0, 0, *radius**2 * np.array([1.0, 0, 1, 0, 0, 1])])
    stated = {link: (masses[link], masses[link]) for link in links if link in masses}
    count = len(x)
    fit = Consistent(
        layout=ParameterLayout(tuple(links), (), ()),
        K=np.eye(count),
        prior=ball.reshape(-1),
        prior_std=scale,
        prior_weight=_FREE,
        constraints=Constraints(mass=stated),
    )
    # a stated mass has no covariance; its constraint fixes it. Data without noise have almost none
    exact = np.diag(np.where(np.diag(C) == 0, scale, _EXACT * scale) ** 2)
    names = fit.layout.names
    start = Estimate(x, C + exact, names, np.ones(1), count, 1.0, (), True, 0, "two runs")
    return fit.project(start).theta


def _gains(model: RobotModel, runs: TwoRuns, found: Compared) -> dict[str, Gain]:
    first = len(found.theta)
    error = np.sqrt(np.diag(found.covariance)[first:])  # of the logarithm
    half_width = quantile(found.freedom[first:]) * error
    gains = {}
    for k, j in enumerate(runs.unknown):
        value = float(found.gain[j])
        ends = sorted((value * np.exp([-half_width[k], half_width[k]])).tolist())
        gains[model.joints[j]] = Gain(value, abs(value) * float(error[k]), (ends[0], ends[1]))
    return gains
