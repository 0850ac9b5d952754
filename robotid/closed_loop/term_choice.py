"""Which terms a drive has beside viscous and Coulomb friction: those that other windows confirm.

The residual is linear in a term that is not there yet, to first order. So one roll-out with the
slopes of all candidates tells, for any of them, what a fit to some windows would make of others.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.closed_loop.unknowns import LoopSimulator, Unknown
from robotid.estimators.output_error import OutputError, linearised
from robotid.robot.drives import DriveTerm, LoadFriction, PositionCoulomb, Stribeck

__all__ = ["Tried", "candidates", "choose"]

_GAIN = 0.02  # of a joint's squared residual, by which a term must lower that of other windows
_FOLDS = 6
_FEWEST = 2  # windows: one is judged by what others were fitted to
_SLOW = 0.3  # of a joint's usual speed, over which Stribeck's hook fades
_WIDE = 0.05  # [rad or m] of motion from which friction can depend on the position

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Tried:
    """One candidate of a joint.

    Attributes:
        joint: The joint.
        terms: Names of its terms.
        gain: Share of the joint's squared residual in other windows that it takes away [-].
        is_chosen: Whether it is taken.
    """

    joint: str
    terms: tuple[str, ...]
    gain: float
    is_chosen: bool


def candidates(simulator: LoopSimulator, torque: Array) -> list[tuple[Unknown, ...]]:
    """Return what friction each joint may have beside viscous and Coulomb's.

    Args:
        simulator: The fit without them.
        torque: Usual torque of each joint, shape (n,), that sizes their spread [N m or N].
    """
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
        centre, seen = float((low + high) / 2), (float(low), float(high))
        half = (high - low) / 2
        sets: list[tuple[DriveTerm, ...]] = [(Stribeck(speed=_SLOW * speed),), (LoadFriction(),)]
        if half > _WIDE:
            sets.append(tuple(PositionCoulomb(order=k, centre=centre, seen=seen) for k in (1, 2)))
        for terms in sets:
            unknowns = []
            for term in terms:
                size = torque[j] if isinstance(term, LoadFriction) else 1.0
                if isinstance(term, PositionCoulomb):
                    size = half**term.order
                unknowns.append(
                    Unknown(
                        f"{joint}.{term.name}",
                        "term",
                        (j,),
                        0.0,
                        torque[j] / size,
                        0.0 if term.is_nonnegative else -np.inf,
                        term=term,
                    )
                )
            found.append(tuple(unknowns))
    return found


def choose(
    simulator: LoopSimulator,
    theta: Array,
    offered: Sequence[tuple[Unknown, ...]],
    estimator: OutputError,
) -> list[Tried]:
    """Return which candidates lower the residual of windows that they were not fitted to.

    Candidates are taken one after the other, the best of each joint in a pass.

    Args:
        simulator: The fit with all that is offered among its unknowns, at 0.
        theta: Its parameters, shape (c,).
        offered: The candidates.
        estimator: How residuals weigh.
    """
    joints = simulator.robot.model.joints
    if len(simulator.windows) < _FEWEST:
        _log.warning(
            "further friction is not tried: the logs have %d window to fit, wanted at least %d, to "
            "judge by one what another was fitted to; record longer, or shorten window in "
            "[estimator]",
            len(simulator.windows), _FEWEST,
        )  # fmt: skip
    place = {name: k for k, name in enumerate(simulator.names)}
    sets = [[place[unknown.name] for unknown in unknowns] for unknowns in offered]
    folds = _folds(simulator, theta, estimator)
    rows = sum(fold.rows for fold in folds)  # of one joint, whose noise level is 1
    spare = {k for places in sets for k in places}
    columns = [k for k in range(len(theta)) if k not in spare]
    open_sets, chosen = set(range(len(sets))), set[int]()
    gains: dict[int, float] = {}
    while open_sets:
        found = _gains(folds, columns, {s: sets[s] for s in open_sets})
        gains |= {s: gain / rows for s, gain in found.items()}
        best: dict[int, int] = {}
        for s in sorted(open_sets, key=lambda s: -gains[s]):
            if gains[s] > _GAIN:
                best.setdefault(offered[s][0].joints[0], s)
        if not best:
            break
        for s in best.values():
            columns += sets[s]
        chosen |= set(best.values())
        open_sets -= chosen
    return [
        Tried(
            joints[unknowns[0].joints[0]],
            tuple(unknown.term.name for unknown in unknowns if unknown.term is not None),
            gains[s],
            s in chosen,
        )
        for s, unknowns in enumerate(offered)
    ]


@dataclass(frozen=True, eq=False)
class _Fold:
    """The linearised problem of some windows: A'A, A'b and b'b, and rows of one joint."""

    H: Array  # (c, c)
    g: Array  # (c,)
    rows: int


def _folds(simulator: LoopSimulator, theta: Array, estimator: OutputError) -> list[_Fold]:
    """Return the problem cut into folds of windows, the prior shared among them."""
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
) -> dict[int, float]:
    """Return by how much each set of further columns lowers the squares of folds left out.

    0 of all if the other folds leave a parameter open, as those of short logs: then nothing shows
    what a term gains where it was not fitted.
    """
    gains = dict.fromkeys(sets, 0.0)
    H, g = sum(fold.H for fold in folds), sum(fold.g for fold in folds)
    base = np.array(columns)
    for fold in folds:
        H_f, g_f = H - fold.H, g - fold.g  # of the others
        try:
            factor = scipy.linalg.cho_factor(H_f[np.ix_(base, base)])
        except scipy.linalg.LinAlgError:  # not positive definite
            return dict.fromkeys(sets, 0.0)
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
            gains[s] -= float(change)
    return gains
