"""Further parameters judged to first order: friction terms, and the scale of the stated gains.

The residual is linear in a candidate: one roll-out with the sensitivities of all candidates gives
the residual of held-out windows after a fit to the other windows (cross-validation), and the scale
of the gains that bodies and torques indicate.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid.base.typing import Array
from robotid.diagnosis.decisions import SIMULATED_FAMILY, Round
from robotid.dynamics.simulation.loops import friction_at_rest
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import OutputError, is_at_bound, linearised
from robotid.identification.closed_loop.loop_simulator import FreeParameter, LoopSimulator
from robotid.robot.drive_term import ANYWHERE
from robotid.robot.drives import FAMILIES, LoadFriction, PositionCoulomb

_OFFERED = ("stribeck", "load", "position")  # candidate families
_FOLDS = 6
_FEWEST = 2  # smallest number of windows for a cross-validation
_SLOW = 0.3  # Stribeck speed of candidates, over the typical speed of the joint
_POSITIONS = 201  # at which the sign of the friction is checked
_WIDE = 0.05  # smallest half-range of a position-dependent candidate [rad or m]

_log = logging.getLogger(__name__)
_GAINS = ("kp", "kd")
_DIFFERS = 3.0  # smallest significant difference of a scale [standard errors]
_LARGE = 0.05  # smallest relevant difference of a scale; missing friction terms cause smaller ones


@dataclass(frozen=True)
class Tried:
    """A candidate of a joint that was tried."""

    joint: str  # the joint
    terms: tuple[str, ...]  # names of its terms
    gain: float  # reduction of the joint's squared residual in held-out windows [-]
    is_chosen: bool  # whether it is chosen
    dropped: str = ""  # why it was dropped after a fit with it, else empty


def candidates(simulator: LoopSimulator, torque: Array) -> list[tuple[FreeParameter, ...]]:
    """Return the candidate friction terms of each joint: torque (n,) [N m or N]."""
    model = simulator.robot.model
    q = np.concatenate([w.log.q[w.counted] for w in simulator.windows])
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    v = np.abs(
        np.concatenate([np.gradient(w.log.q[w.counted], dt, axis=0) for w in simulator.windows])
    )
    found = []
    for j, joint in enumerate(model.joints):
        low, high, speed = q[:, j].min(), q[:, j].max(), float(np.sqrt(np.mean(v[:, j] ** 2)))
        if speed <= 0.0:
            continue
        data_range, half = {"q": (float(low), float(high)), "v": ANYWHERE}, (high - low) / 2
        for family in map(FAMILIES.__getitem__, _OFFERED):
            terms = family.make(data_range, *[_SLOW * speed for _ in family.shapes])
            if half <= _WIDE and any(term.guards == "q" for term in terms):
                continue
            free_parameters = []
            for term in terms:
                size = half**term.order if isinstance(term, PositionCoulomb) else 1.0
                spread = 1.0 if isinstance(term, LoadFriction) else torque[j] / size
                free_parameters.append(FreeParameter.of_term(joint, term, (j,), 0.0, spread))
            found.append(tuple(free_parameters))
    return found


def choose(
    simulator: LoopSimulator,
    theta: Array,
    offered: Sequence[tuple[FreeParameter, ...]],
    estimator: OutputError,
) -> list[Tried]:
    """Return which candidates lower the residual of held-out windows.

    Selection is greedy: each pass adds the best candidate of each joint.

    theta (c,).
    """
    joints = simulator.robot.model.joints
    if len(simulator.windows) < _FEWEST:
        _log.warning(
            "further friction terms are not tried: the logs have %d window to fit, and "
            "cross-validation needs at least %d. Record a longer log, or set a shorter window in "
            "[estimator]",
            len(simulator.windows), _FEWEST,
        )  # fmt: skip
    place = {name: k for k, name in enumerate(simulator.names)}
    sets = [[place[free.name] for free in free_parameters] for free_parameters in offered]
    folds = _folds(simulator, theta, estimator)
    rows = sum(fold.rows for fold in folds)  # of one joint, with unit noise
    candidate_columns = {k for places in sets for k in places}
    columns = [k for k in range(len(theta)) if k not in candidate_columns]
    remaining, chosen = set(range(len(sets))), set[int]()
    gains: dict[int, float] = {}
    while remaining:
        removed = _gains(folds, columns, {s: sets[s] for s in remaining})
        rounds = _by_joint(offered, removed, rows)
        gains |= {s: this.share(s) for this in rounds for s in this.left}
        best = [s for this in rounds for s in [this.best(SIMULATED_FAMILY)] if s is not None]
        if not best:
            break
        for s in sorted(best, key=lambda s: -gains[s]):
            columns += sets[s]
        chosen |= set(best)
        remaining -= chosen
    return [
        Tried(
            joints[free_parameters[0].joints[0]],
            tuple(free.term.name for free in free_parameters if free.term is not None),
            gains[s],
            s in chosen,
        )
        for s, free_parameters in enumerate(offered)
    ]


def impossible(simulator: LoopSimulator, theta: Array, tried: Sequence[Tried]) -> dict[Tried, str]:
    """Return the weakest chosen term of each joint whose friction is negative, and the figures.

    Negative friction at some position would drive the joint: no simulation that comes to rest there
    has a solution. Beyond the range of the data, terms of the position are constant.
    """
    # theta (c,)
    weakest = {t.joint: t for t in sorted(tried, key=lambda t: -t.gain) if t.is_chosen}
    found = {}
    for t in weakest.values():
        model, loops = simulator.robot.model, simulator.loops(theta)
        j = model.joints.index(t.joint)
        own = np.concatenate([w.log.q[w.counted, j] for w in simulator.windows])
        q = np.linspace(own.min(), own.max(), _POSITIONS)
        friction = friction_at_rest(loops, j, q)
        if (least := float(friction.min())) < 0.0:
            at = float(q[np.argmin(friction)])
            unit, force = ("m", "N") if t.joint in model.layout.prismatic else ("rad", "N m")
            found[t] = f"the friction at {at:.3g} {unit} is {least:.2g} {force}, wanted 0 or more"
    return found


def _by_joint(
    offered: Sequence[tuple[FreeParameter, ...]], removed: Mapping[int, Array], rows: int
) -> list[Round[int]]:
    """Return the selection round of each joint's candidates, by their gain in each fold."""
    joints: dict[int, dict[int, Array]] = {}
    for s, gain in removed.items():
        joints.setdefault(offered[s][0].joints[0], {})[s] = -gain
    folds = max(map(len, removed.values()))
    return [Round(np.zeros(folds), left, folds, rows) for left in joints.values()]


@dataclass(frozen=True, eq=False)
class _Fold:
    """The normal equations of some windows, A'A and A'b, and the number of rows of one joint."""

    H: Array  # (c, c)
    g: Array  # (c,)
    rows: int


def _folds(simulator: LoopSimulator, theta: Array, estimator: OutputError) -> list[_Fold]:
    """Return the problem split into folds of windows, with the prior split equally."""
    count = min(_FOLDS, len(simulator.windows))
    known = 1.0 / simulator.prior_std**2 / count
    H = np.tile(np.diag(known), (count, 1, 1))
    g, rows = np.tile(known * (simulator.prior - theta), (count, 1)), [0] * count
    parts = list(linearised(simulator, estimator.weights(simulator, theta), theta))
    each = len(parts) // len(simulator.windows)  # parts of the robot
    for k, (A, b, columns) in enumerate(parts):
        fold = (k // each) % count
        H[fold][np.ix_(columns, columns)] += A.T @ A
        g[fold][columns] += A.T @ b
        rows[fold] += len(b)
    n = len(simulator.robot.model.joints)
    return [_Fold(*fold) for fold in zip(H, g, (size // n for size in rows), strict=True)]


def _gains(
    folds: Sequence[_Fold], columns: list[int], sets: dict[int, list[int]]
) -> dict[int, Array]:
    """Return by how much each set of further columns lowers the squares of each held-out fold.

    All are 0 if the other folds do not determine a parameter, as with short logs: then there is no
    cross-validation.
    """
    gains = {s: np.zeros(len(folds)) for s in sets}
    H, g = sum(fold.H for fold in folds), sum(fold.g for fold in folds)
    base = np.array(columns)
    for k, fold in enumerate(folds):
        H_f, g_f = H - fold.H, g - fold.g  # of the others
        try:
            factor = scipy.linalg.cho_factor(H_f[np.ix_(base, base)])
        except scipy.linalg.LinAlgError:  # not positive definite
            return {s: np.zeros(len(folds)) for s in sets}
        move = scipy.linalg.cho_solve(factor, g_f[base])
        slope = fold.H[np.ix_(base, base)] @ move - fold.g[base]
        for s, own in sets.items():
            further = np.array(own)
            B = H_f[np.ix_(base, further)]
            X = scipy.linalg.cho_solve(factor, B)
            S = H_f[np.ix_(further, further)] - B.T @ X
            y = np.linalg.lstsq(S, g_f[further] - B.T @ move, rcond=None)[0]
            d = -X @ y
            change = 2 * slope @ d + d @ fold.H[np.ix_(base, base)] @ d
            across = fold.H[np.ix_(further, base)] @ (move + d) - fold.g[further]
            change += 2 * y @ across + y @ fold.H[np.ix_(further, further)] @ y
            gains[s][k] = -float(change)
    return gains


@dataclass(frozen=True, eq=False)
class GainScale:
    """Relative change of the gains that makes them consistent with bodies and torques."""

    change: Array  # relative change of each joint's gains, shape (n,) [-]
    error: Array  # standard errors of ``change``, shape (n,); inf where it is not identifiable
    common: float  # relative change of all gains by one factor [-]
    common_error: float  # standard error of ``common``

    @property
    def is_wrong(self) -> bool:
        """Whether the common factor of all gains is not 1, and every joint is consistent with it.

        Different factors indicate another model error, so that the gains are not questioned.
        """
        agree = np.abs(self.change - self.common) <= _DIFFERS * np.hypot(
            self.error, self.common_error
        )
        is_other = abs(self.common) > max(_DIFFERS * self.common_error, _LARGE)
        return bool(is_other and agree.all())


def gain_scale(simulator: LoopSimulator, estimator: OutputError, estimate: Estimate) -> GainScale:
    """Return the scale of the stated gains that bodies, and fitted torques, indicate.

    All drive parameters scale with the gains; weight and inertia of the bodies do not, within their
    prior. The scale is of first order: one Gauss-Newton step of gains and all free parameters.
    """
    n, c = len(simulator.base.kp), len(estimate.theta)
    gains = tuple(_stated_gains(simulator))
    wide = replace(simulator, free_parameters=(*simulator.free_parameters, *gains))
    theta = np.concatenate([estimate.theta, [gain.prior for gain in gains]])
    H, g = estimator.normal(wide, estimator.weights(wide, theta), theta, frees=True)
    T = np.zeros((len(theta), c + n))  # from free parameters and joint scales to all parameters
    T[:c, :c] = np.eye(c)
    for k, gain in enumerate(gains, start=c):
        T[k, c + gain.joints[0]] = gain.prior
    free = np.concatenate([~is_at_bound(simulator, estimate.theta), np.ones(n, dtype=bool)])
    T = T[:, free]
    inflation = max(float(estimate.details["inflation"]), 1.0)
    change, error = _last(T.T @ H @ T, T.T @ g, n)
    together = np.column_stack([T[:, :-n], T[:, -n:].sum(axis=1)])
    common, own = _last(together.T @ H @ together, together.T @ g, 1)
    spread = np.sqrt(inflation)
    return GainScale(change, spread * error, float(common[0]), float(spread * own[0]))


def _stated_gains(simulator: LoopSimulator) -> Iterator[FreeParameter]:
    """Yield the gains of all joints as free parameters without a prior."""
    for what in _GAINS:
        if any(free.what == what for free in simulator.free_parameters):
            continue  # it is fitted, so that it scales with the other one
        for j, value in enumerate(getattr(simulator.base, what).tolist()):
            joint = simulator.robot.model.joints[j]
            yield FreeParameter(f"{joint}.{what} as stated", what, (j,), value, np.inf)


def _last(H: Array, g: Array, n: int) -> tuple[Array, Array]:
    """Return the last n entries of x, H x = g, and their errors; inf where H is singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, V = scipy.linalg.eigh(H * np.outer(scale, scale))
    regular = values > 1e-12 * values[-1]
    inverse = (V[:, regular] / values[regular]) @ V[:, regular].T
    x, variance = scale * (inverse @ (scale * g)), np.diag(inverse) * scale**2
    is_singular = (V[:, ~regular] ** 2).sum(axis=1) > 1e-6
    return x[-n:], np.where(is_singular, np.inf, np.sqrt(variance))[-n:]
