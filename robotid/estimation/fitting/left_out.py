"""Prediction of each log by a fit to the others: the verdict without validation logs."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from robotid.base.exceptions import RankDeficientError
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.dynamics.factors import Factors, merge
from robotid.dynamics.prediction import predict
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.metrics import Metrics, TorqueSums
from robotid.robot.model import RobotModel

#: End of the name of a log that a fit to the others predicts.
LEFT_OUT = ", left out of the fit"

#: Smallest number of different motions of which each is predicted by the others.
FEWEST_LEFT_OUT = 3
#: Of the range of each joint: closer positions are equal.
NEAR = 0.02
#: Share of a motion that is in another one, from which it repeats that one.
REPEATED = 0.3
_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] after an instant, positions that are compared
_FEW = 60  # instants of each motion that are compared
_FITS = 10  # largest number of fits; more motions are left out together


def left_out_metrics(
    model: RobotModel,
    logs: Sequence[Sequence[Factors]],
    fitted: Sequence[Evaluation],
    fit: Callable[[Factors], tuple[Array, Array]],
) -> dict[str, Metrics]:
    """Return the metrics of each log as a fit to the others predicts it, by its name.

    Logs that repeat the motion of one another are left out together.

    fit (p,).
    """
    if any(e.recording.is_partial for e in fitted):
        return {}
    motions = alike_motions([e.recording.trajectory for e in fitted])
    if len(motions) < FEWEST_LEFT_OUT:
        return {}
    found = {}
    for first in range(min(_FITS, len(motions))):
        out = {k for motion in motions[first::_FITS] for k in motion}
        others = merge([part for k, log in enumerate(logs) if k not in out for part in log])
        try:
            pi, driven = fit(others)
        except RankDeficientError:  # of "ols" and "wls": not evaluated, which the verdict states
            continue
        for k in sorted(out):
            motion, mask = fitted[k].recording.trajectory, fitted[k].recording.mask
            torque, by_urdf = predict(model, [pi, driven], motion)
            torques = fitted[k].torques
            plain = {x: torques[x] for x in ("gravity_only", "urdf") if x in torques}
            plain["urdf_with_drives"] = by_urdf
            sums = TorqueSums.of(motion.tau, torque, mask, plain)
            name = f"{fitted[k].recording.name}{LEFT_OUT}"
            found[name] = sums.metrics(model.row_names, model.row_units)
    return found


def logs_that_test(names: Collection[str]) -> str:
    """Return what the logs are that test a prediction, as text."""
    is_left_out = bool(names) and all(name.endswith(LEFT_OUT) for name in names)
    return "logs left out of the fit in turn" if is_left_out else "validation logs"


def alike_motions(motions: Sequence[Trajectory]) -> list[list[int]]:
    """Return the motions in groups: one that repeats another one is in its group."""
    from scipy.spatial import cKDTree

    low, high = (np.array([f(x.q, axis=0) for x in motions]) for f in (np.min, np.max))
    size = np.maximum(high.max(axis=0) - low.min(axis=0), 1e-3)
    trees = [
        cKDTree(known) if len(known := moving_pieces(x, size, None)) else None for x in motions
    ]
    groups: list[list[int]] = []
    for k, motion in enumerate(motions):
        own, same = moving_pieces(motion, size, _FEW), list[list[int]]()
        for group in groups if len(own) else ():
            others = [tree for j in group if (tree := trees[j]) is not None]
            far = [x.query(own, p=np.inf, distance_upper_bound=NEAR)[0] for x in others]
            if any(np.mean(np.isfinite(distance)) >= REPEATED for distance in far):
                same.append(group)
        groups = [group for group in groups if group not in same]
        groups.append([*(j for group in same for j in group), k])
    return sorted(sorted(group) for group in groups)


def moving_pieces(motion: Trajectory, size: Array, count: int | None) -> Array:
    """Return positions at instants and up to a second after, over the size, where joints move."""
    step = float(np.median(np.diff(motion.t)))
    ahead = [round(s / step) for s in _AHEAD]
    last = len(motion.t) - ahead[-1]
    if last <= 0:
        return np.empty((0, len(_AHEAD) * len(size)))
    starts = np.arange(last)
    whole = motion.segment[starts] == motion.segment[starts + ahead[-1]]
    moved = np.abs(motion.q[starts + ahead[-1]] - motion.q[starts]) / size
    starts = starts[whole & (moved.max(axis=1) > 2 * NEAR)]
    if count is not None and len(starts) > count:
        starts = starts[np.linspace(0, len(starts) - 1, count).astype(int)]
    else:
        # instants so close that fast motion moves less than the bound between two of them
        starts = starts[:: max(1, round(0.005 / step))]
    return np.hstack([motion.q[starts + k] / size for k in ahead])
