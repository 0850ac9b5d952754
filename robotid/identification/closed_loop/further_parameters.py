"""Further parameters judged to first order: friction terms, and the scale of the stated gains.

The residual is linear in a candidate: one roll-out with the sensitivities of all candidates gives
the residual of held-out windows after a fit to the other windows (cross-validation), and the scale
of the gains that bodies and torques indicate.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid.base.typing import Array
from robotid.diagnosis.decisions import SIMULATED_FAMILY, Round
from robotid.dynamics.simulation.loops import friction_at_rest
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import OutputError, is_at_bound, linearised
from robotid.identification.closed_loop.loop_simulator import (
    SIGNIFICANT,
    FreeParameter,
    LoopSimulator,
)
from robotid.robot.drive_term import ANYWHERE
from robotid.robot.drives import FAMILIES, LoadFriction, PositionCoulomb

_OFFERED = ("stribeck", "load", "position")  # candidate families
_FOLDS = 6
_SLOW = 0.3  # Stribeck speed of candidates, over the typical speed of the joint
_WIDE = 0.05  # smallest half-range of a position-dependent candidate [rad or m]

_log = logging.getLogger(__name__)
_LARGE = 0.05  # smallest relevant difference of a scale; missing friction terms cause smaller ones


@dataclass(frozen=True)
class Tried:
    """A candidate of a joint that was tried."""

    joint: str
    terms: tuple[str, ...]  # names of its terms
    gain: float  # reduction of the joint's squared residual in held-out windows [-]
    is_chosen: bool  # whether it is chosen
    dropped: str = ""  # why it was dropped after a fit with it, else empty


def candidates(simulator: LoopSimulator, torque: Array) -> list[tuple[FreeParameter, ...]]:
    """Return the candidate friction terms of each joint: torque (n,) [N m or N]."""
    model = simulator.robot.model
    measured = [w.log.q[w.counted] for w in simulator.windows]
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    q, v = (np.concatenate(x) for x in (measured, [np.gradient(x, dt, axis=0) for x in measured]))
    sets = []
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
            sets.append(tuple(free_parameters))
    return sets


def choose(
    simulator: LoopSimulator,
    theta: Array,
    offered: Sequence[tuple[FreeParameter, ...]],
    estimator: OutputError,
) -> list[Tried]:
    """Return which candidates lower the residual of held-out windows, greedily by joint."""
    joints = simulator.robot.model.joints
    if len(simulator.windows) == 1:
        _log.warning(
            "further friction terms are not tried: the logs have 1 window to fit, and "
            "cross-validation needs at least 2. Record a longer log, or set a shorter window in "
            "[estimator]"
        )
    place = {name: k for k, name in enumerate(simulator.names)}
    sets = [[place[free.name] for free in free_parameters] for free_parameters in offered]
    H, g, rows = _folds(simulator, theta, estimator)
    columns = sorted({*range(len(theta))}.difference(*sets))
    remaining, chosen = set(range(len(sets))), set[int]()
    gains: dict[int, float] = {}
    while remaining:
        left: dict[int, dict[int, Array]] = {}  # by joint, of each of its candidates
        for s, removed in _gains(H, g, columns, {s: sets[s] for s in remaining}).items():
            left.setdefault(offered[s][0].joints[0], {})[s] = -removed
        rounds = [Round(np.zeros(len(H)), of_joint, len(H), rows) for of_joint in left.values()]
        gains |= {s: round_.share(s) for round_ in rounds for s in round_.left}
        best = [s for s in (round_.best(SIMULATED_FAMILY) for round_ in rounds) if s is not None]
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
    """Return the weakest chosen term of each joint whose friction is negative, and the figures."""
    # such friction would drive the joint: no simulation that comes to rest there has a solution
    model, loops, why = simulator.robot.model, simulator.loops(theta), {}
    weakest = {t.joint: t for t in sorted(tried, key=lambda t: -t.gain) if t.is_chosen}
    for t in weakest.values():
        j = model.joints.index(t.joint)
        q = np.concatenate([w.log.q[w.counted, j] for w in simulator.windows])
        friction = friction_at_rest(loops, j, q)
        if (least := float(friction.min())) < 0.0:
            at = float(q[np.argmin(friction)])
            unit, force = ("m", "N") if t.joint in model.layout.prismatic else ("rad", "N m")
            why[t] = f"the friction at {at:.3g} {unit} is {least:.2g} {force}, wanted 0 or more"
    return why


def _folds(
    simulator: LoopSimulator, theta: Array, estimator: OutputError
) -> tuple[Array, Array, int]:
    """Return A'A, (K, c, c), and A'b, (K, c), of K folds with equal priors, and rows per joint."""
    count, rows = min(_FOLDS, len(simulator.windows)), 0
    known = 1.0 / simulator.prior_std**2 / count
    H = np.tile(np.diag(known), (count, 1, 1))
    g = np.tile(known * (simulator.prior - theta), (count, 1))
    parts = list(linearised(simulator, estimator.weights(simulator, theta), theta))
    of_window = len(parts) // len(simulator.windows)  # parts of the robot
    for k, (A, b, columns) in enumerate(parts):
        fold = (k // of_window) % count
        H[fold][np.ix_(columns, columns)] += A.T @ A
        g[fold][columns] += A.T @ b
        rows += len(b)
    return H, g, rows // len(simulator.robot.model.joints)


def _gains(H: Array, g: Array, columns: list[int], sets: dict[int, list[int]]) -> dict[int, Array]:
    """Return by how much each set of further columns lowers the squares of each held-out fold."""
    # all 0 if the other folds do not determine a parameter, as with short logs
    gains = {s: np.zeros(len(H)) for s in sets}
    base = np.array(columns)
    for k, (H_k, g_k) in enumerate(zip(H, g, strict=True)):
        H_f, g_f = H.sum(axis=0) - H_k, g.sum(axis=0) - g_k  # of the others
        try:
            factor = scipy.linalg.cho_factor(H_f[np.ix_(base, base)])
        except scipy.linalg.LinAlgError:  # not positive definite
            return {s: np.zeros(len(H)) for s in sets}
        move = scipy.linalg.cho_solve(factor, g_f[base])
        before = move @ H_k[np.ix_(base, base)] @ move - 2 * g_k[base] @ move
        for s, places in sets.items():
            further = np.array(places)
            B = H_f[np.ix_(base, further)]
            X = scipy.linalg.cho_solve(factor, B)
            S = H_f[np.ix_(further, further)] - B.T @ X
            y = np.linalg.lstsq(S, g_f[further] - B.T @ move, rcond=None)[0]
            both, step = np.append(base, further), np.concatenate([move - X @ y, y])
            gains[s][k] = before - step @ H_k[np.ix_(both, both)] @ step + 2 * g_k[both] @ step
    return gains


@dataclass(frozen=True, eq=False)
class GainScale:
    """Relative change of the gains that makes them consistent with bodies and torques [-]."""

    change: Array  # of each joint's gains, shape (n,)
    error: Array  # its standard errors, shape (n,); inf where it is not identifiable
    common: float  # of all gains by one factor
    common_error: float  # its standard error

    @property
    def is_wrong(self) -> bool:
        """Whether the common factor of all gains is not 1, and each joint is consistent with it."""
        error = np.hypot(self.error, self.common_error)
        agree = np.abs(self.change - self.common) <= SIGNIFICANT * error
        is_other = abs(self.common) > max(SIGNIFICANT * self.common_error, _LARGE)
        return bool(is_other and agree.all())


def gain_scale(simulator: LoopSimulator, estimator: OutputError, estimate: Estimate) -> GainScale:
    """Return the scale of the stated gains that bodies, and fitted torques, indicate.

    Drive parameters scale with the gains; weight and inertia of bodies do not. To first order: one
    Gauss-Newton step of gains and all free parameters.
    """
    n, c, gains = len(simulator.base.kp), len(estimate.theta), []
    for what in ("kp", "kd"):
        if any(free.what == what for free in simulator.free_parameters):
            continue  # it is fitted, so that it scales with the other one
        for j, value in enumerate(getattr(simulator.base, what).tolist()):
            gains.append(FreeParameter(f"{what} of {j} as stated", what, (j,), value, np.inf))
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
    [common], [common_error] = _last(together.T @ H @ together, together.T @ g, 1)
    spread = np.sqrt(inflation)
    return GainScale(change, spread * error, float(common), float(spread * common_error))


def _last(H: Array, g: Array, n: int) -> tuple[Array, Array]:
    """Return the last n entries of x, H x = g, and their errors; inf where H is singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, V = scipy.linalg.eigh(H * np.outer(scale, scale))
    regular = values > 1e-12 * values[-1]
    inverse = (V[:, regular] / values[regular]) @ V[:, regular].T
    x, variance = scale * (inverse @ (scale * g)), np.diag(inverse) * scale**2
    is_singular = (V[:, ~regular] ** 2).sum(axis=1) > 1e-6
    return x[-n:], np.where(is_singular, np.inf, np.sqrt(variance))[-n:]
