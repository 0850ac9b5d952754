"""Checks of motions for their roles: excitation to fit, and no repetition to validate."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import RobotIdError
from robotid.base.findings import Finding
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.catalogue import finding
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import compress, merge
from robotid.dynamics.used_rows import base_problem, independent_share, row_mask
from robotid.estimation.estimators import WLS, Estimate
from robotid.estimation.estimators.determination import Determination, base_spread, determine
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] after an instant, positions that are compared
_NEAR = 0.02  # of the range of each joint: closer positions are equal
_SHARE = 0.3  # of the validation motion that is in a fitted log, too
_INSTANTS = 300
_FEW = 60  # ... of each of many motions
_ROWS = 5000  # of a log, from which its excitation is computed
_ILL_CONDITIONED = 1e3  # condition number of unit columns above which a motion is poor


def check_repeated_motion(
    fitted: Sequence[Trajectory], validation: Trajectory, name: str
) -> Iterator[Finding]:
    """Yield a warning "repeated_motion" if a validation log repeats motion that is fitted."""
    from scipy.spatial import cKDTree

    size = np.maximum(np.ptp(validation.q, axis=0), 1e-3)
    own = _segments(validation, size, _INSTANTS)
    share = 0.0
    for known in [_segments(motion, size, None) for motion in fitted if len(own)]:
        if len(known):
            distance, _ = cKDTree(known).query(own, p=np.inf, distance_upper_bound=_NEAR)
            share = max(share, float(np.mean(np.isfinite(distance))))
    if share >= _SHARE:
        yield finding("repeated_motion", name, share=share)


def alike_motions(motions: Sequence[Trajectory]) -> list[list[int]]:
    """Return the motions in groups: one that repeats another one is in its group."""
    from scipy.spatial import cKDTree

    low, high = (np.array([f(x.q, axis=0) for x in motions]) for f in (np.min, np.max))
    size = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-3)
    trees = [cKDTree(known) if len(known := _segments(x, size, None)) else None for x in motions]
    groups: list[list[int]] = []
    for k, motion in enumerate(motions):
        own, same = _segments(motion, size, _FEW), list[list[int]]()
        for group in groups if len(own) else ():
            others = [tree for j in group if (tree := trees[j]) is not None]
            far = [x.query(own, p=np.inf, distance_upper_bound=_NEAR)[0] for x in others]
            if any(np.mean(np.isfinite(distance)) >= _SHARE for distance in far):
                same.append(group)
        groups = [group for group in groups if group not in same]
        groups.append([*(j for group in same for j in group), k])
    return sorted(sorted(group) for group in groups)


def check_excitation(
    model: RobotModel,
    mapping: BaseMapping,
    motions: Sequence[Trajectory],
    signals: SignalSettings,
    name: str,
) -> Iterator[Finding]:
    """Yield which base parameters the fitted motions determine, by ``determine``.

    Of long logs every n-th row is used.
    """
    prior, step = model.standard_parameters(), -(-max(len(m.t) for m in motions) // _ROWS)
    thinned = [motion.every(step) for motion in motions]
    try:
        masks = [row_mask(model, m, signals.min_velocity) for m in thinned]
        problems = (
            base_problem(model, mapping, *pair) for pair in zip(thinned, masks, strict=True)
        )
        factors = merge([compress(problem) for problem in problems])
        found = WLS(prior=mapping.to_base(prior)).fit(factors)
    except RobotIdError as error:
        yield finding(
            "excitation", name, severity="warning", what="unchecked", todo="unchecked",
            text=str(error),
        )  # fmt: skip
        return
    share = step * min(independent_share(replace(signals, rate=m.rate)) for m in motions)
    squares = np.sum([motion.squares for motion in thinned], axis=0)
    spread = prior_spread(model, squares, sum(len(motion.t) for motion in thinned))
    rows = factors.weighted(found.sigma / np.sqrt(share))[:, :-1]
    known = determine(mapping.base_names, rows, base_spread(mapping.K, spread))
    yield excitation_finding(found, known, name)


def excitation_finding(wls: Estimate, known: Determination, name: str) -> Finding:
    """Return the finding on which base parameters a motion determines."""
    count = len(known.names)
    evidence = {"rank": known.rank, "base": count, "weakest": known.shrinkage[-1]}
    if np.isfinite(wls.condition):
        evidence["condition"] = wls.condition
    is_poor = is_poorly_excited(wls, count)
    todo = "poor" if is_poor else "lost"
    if not known.groups:
        todo = "weak" if is_poor else "good"
    return finding(
        "excitation", name, severity="warning" if todo == "poor" else "note", what="rank",
        todo=todo, described=known.described() if known.groups else "",
        condition_number=f"{wls.condition:.3g}", **evidence,
    )  # fmt: skip


def is_poorly_excited(wls: Estimate, count: int) -> bool:
    """Return whether the motion, not the noise, leaves base parameters undetermined."""
    return wls.rank < count or wls.condition > _ILL_CONDITIONED


def _segments(motion: Trajectory, size: Array, count: int | None) -> Array:
    """Return positions at instants and up to a second after, over the size, where joints move."""
    step = float(np.median(np.diff(motion.t)))
    ahead = [round(s / step) for s in _AHEAD]
    last = len(motion.t) - ahead[-1]
    if last <= 0:
        return np.empty((0, len(_AHEAD) * len(size)))
    starts = np.arange(last)
    whole = motion.segment[starts] == motion.segment[starts + ahead[-1]]
    moved = np.abs(motion.q[starts + ahead[-1]] - motion.q[starts]) / size
    starts = starts[whole & (moved.max(axis=1) > 2 * _NEAR)]
    if count is not None and len(starts) > count:
        starts = starts[np.linspace(0, len(starts) - 1, count).astype(int)]
    else:
        # instants so close that fast motion moves less than the bound between two of them
        starts = starts[:: max(1, round(0.005 / step))]
    return np.hstack([motion.q[starts + k] / size for k in ahead])
