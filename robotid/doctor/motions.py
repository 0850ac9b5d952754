"""Are the motions of several logs fit for their roles: rich to fit, new to validate with."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robotid._typing import Array
from robotid.estimators import WLS, Estimate
from robotid.estimators.determination import Determination, base_spread, determine
from robotid.exceptions import RobotIdError
from robotid.findings import Finding, log_finding
from robotid.logs.data import Trajectory
from robotid.logs.settings import SignalSettings
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import compress, merge
from robotid.regressor.used_rows import base_problem, independent_share, row_mask
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

__all__ = [
    "check_excitation",
    "check_repeated_motion",
    "excitation_finding",
    "is_poorly_excited",
]

_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] positions compared: the same now and in a second
_NEAR = 0.02  # of the range of each joint
_SHARE = 0.3  # of the validation motion that has been seen before
_INSTANTS = 300
_ROWS = 5000  # of a log, that tell what its motion determines
_ILL_CONDITIONED = 1e3  # condition number of unit columns above which a motion could be better
_RICHER = "a richer motion, of all joints together, back and forth and as fast as they may,"
_LOST = "the motion is rich, but this hardly loads a joint and is lost in the noise"


def check_repeated_motion(
    fitted: Sequence[Trajectory], kept: Trajectory, name: str
) -> Iterator[Finding]:
    """Yield a warning "repeated_motion" if a validation log repeats motion that is fitted.

    Args:
        fitted: Smooth motions that are fitted.
        kept: Smooth motion that is kept apart.
        name: What its log is called.
    """
    from scipy.spatial import cKDTree

    size = np.maximum(np.ptp(kept.q, axis=0), 1e-3)
    seen = _segments(kept, size, _INSTANTS)
    share = 0.0
    for known in [_segments(motion, size, None) for motion in fitted if len(seen)]:
        if len(known):
            distance, _ = cKDTree(known).query(seen, p=np.inf, distance_upper_bound=_NEAR)
            share = max(share, float(np.mean(np.isfinite(distance))))
    if share < _SHARE:
        return
    message = (
        f"{100 * share:.0f} % of this motion is in a fitted log, too: its score shows how well the "
        "fit repeats itself, not how it predicts; record another motion to validate with"
    )
    yield log_finding(name, "repeated_motion", "warning", message, share=share)


def check_excitation(
    model: RobotModel,
    mapping: BaseMapping,
    motions: Sequence[Trajectory],
    signals: SignalSettings,
    name: str,
) -> Iterator[Finding]:
    """Yield which base parameters the fitted motions determine, by ``determine``.

    Of long logs a share of the rows stands for all.

    Args:
        model: The robot.
        mapping: Its structural base parameters.
        motions: Smooth motions that are fitted.
        signals: How the job smooths, and which rows it leaves out.
        name: What the logs are called.

    Yields:
        One "excitation": a warning if the motion leaves some open, a note if they are lost in the
        noise of a rich one or all are determined.
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
        message = f"which parameters the motion determines cannot be told: {error}"
        yield log_finding(name, "excitation", "warning", message)
        return
    share = step * min(independent_share(replace(signals, rate=m.rate)) for m in motions)
    squares = np.sum([motion.squares for motion in thinned], axis=0)
    spread = prior_spread(model, squares, sum(len(motion.t) for motion in thinned))
    rows = factors.weighted(found.sigma / np.sqrt(share))[:, :-1]
    known = determine(mapping.base_names, rows, base_spread(mapping.K, spread))
    yield excitation_finding(found, known, name)


def excitation_finding(wls: Estimate, known: Determination, name: str) -> Finding:
    """Return which base parameters a motion determines, in words.

    Args:
        wls: Weighted least squares on the motion.
        known: What it determines.
        name: What its logs are called.
    """
    count = len(known.names)
    evidence = {"rank": known.rank, "base": count, "weakest": known.shrinkage[-1]}
    if np.isfinite(wls.condition):
        evidence["condition"] = wls.condition
    message = (
        f"the motion determines {known.rank} of {count} base parameters "
        f"(condition number {wls.condition:.3g})"
    )
    is_poor = is_poorly_excited(wls, count)
    if known.groups:
        advice = f"record {_RICHER[:-1]}" if is_poor else f"{_LOST}: faster motion would show more"
        message += f": {known.described()}; {advice}"
    elif is_poor:
        left = 100 * known.shrinkage[-1]
        message += f"; the least known sum keeps {left:.2g} % of its plausible spread: {_RICHER}"
        message += " would tell more"
    else:
        message += "; nothing needs doing"
    severity = "warning" if known.groups and is_poor else "note"
    return log_finding(name, "excitation", severity, message, **evidence)


def is_poorly_excited(wls: Estimate, count: int) -> bool:
    """Return whether it is the motion, not the noise, that leaves base parameters open.

    Args:
        wls: Weighted least squares on the motion.
        count: Number of base parameters.
    """
    return wls.rank < count or wls.condition > _ILL_CONDITIONED


def _segments(motion: Trajectory, size: Array, count: int | None) -> Array:
    """Return the positions now and a little later, in units of the size, where something moves."""
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
        # fast motion must not slip between two instants: it moves less than the bound per step
        starts = starts[:: max(1, round(0.005 / step))]
    return np.hstack([motion.q[starts + k] / size for k in ahead])
