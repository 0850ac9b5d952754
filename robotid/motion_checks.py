"""Are the motions of several logs fit for their roles: rich to fit, new to validate with."""

from collections.abc import Iterator, Sequence

import numpy as np

from robotid._typing import Array
from robotid.base_parameters import BaseMapping
from robotid.data import Trajectory
from robotid.estimators import WLS
from robotid.exceptions import RobotIdError
from robotid.factors import compress, merge
from robotid.probe import Probe
from robotid.regressor import build_problem
from robotid.verdict import Finding

__all__ = ["check_excitation", "check_repeated_motion"]

_AHEAD = (0.0, 0.25, 0.5, 0.75, 1.0)  # [s] positions compared: the same now and in a second
_NEAR = 0.02  # of the range of each joint
_SHARE = 0.3  # of the validation motion that has been seen before
_INSTANTS = 300


def check_repeated_motion(
    fitted: Sequence[Trajectory], kept: Trajectory, name: str
) -> Iterator[Finding]:
    """Yield whether a validation log repeats motion that is fitted, whoever recorded it when.

    Args:
        fitted: Smooth motions that are fitted.
        kept: Smooth motion that is kept apart.
        name: What its log is called.

    Yields:
        At most one warning "repeated_motion".
    """
    from scipy.spatial import cKDTree

    size = np.maximum(np.ptp(kept.q, axis=0), 1e-3)
    seen = _stretches(kept, size, _INSTANTS)
    if len(seen) == 0:
        return
    share = 0.0
    for motion in fitted:
        known = _stretches(motion, size, None)
        if len(known):
            distance, _ = cKDTree(known).query(seen, p=np.inf, distance_upper_bound=_NEAR)
            share = max(share, float(np.mean(np.isfinite(distance))))
    if share < _SHARE:
        return
    message = (
        f"{name}: {100 * share:.0f} % of this motion is in a fitted log, too: its score shows how "
        "well the fit repeats itself, not how it predicts; record another motion to validate with"
    )
    yield Finding("repeated_motion", "warning", name, message, {"share": share})


def check_excitation(mapping: BaseMapping, probes: Sequence[Probe], name: str) -> Iterator[Finding]:
    """Yield which base parameters the fitted motions leave open.

    Args:
        mapping: The structural base parameters.
        probes: The fitted motions.
        name: What the logs are called.

    Yields:
        One "excitation": a warning if some are left open, else a note.
    """
    problems = [build_problem(p.model, _at_rows(p)) for p in probes]
    try:
        factors = merge([compress(mapping.reduce(problem)) for problem in problems])
        prior = mapping.to_base(probes[0].model.standard_parameters())
        found = WLS(prior=prior).fit(factors)
    except RobotIdError:
        return
    evidence = {"rank": float(found.rank), "base": float(len(mapping.K))}
    if np.isfinite(found.condition):
        evidence["condition"] = float(found.condition)
    left = list(found.undetermined)
    message = (
        f"{name}: the motion excites {found.rank} of {len(mapping.K)} base parameters (condition "
        f"number {found.condition:.3g})"
    )
    message += (
        f"; it leaves open {left}: record a richer motion, of all joints together and as fast as "
        "they may"
        if left
        else "; nothing needs doing"
    )
    yield Finding("excitation", "warning" if left else "note", name, message, evidence)


def _at_rows(probe: Probe) -> Trajectory:
    m, rows = probe.motion, probe.rows
    return Trajectory(
        t=m.t[rows], q=probe.q, v=probe.v, a=probe.a, tau=probe.tau, joints=m.joints, rate=None,
        segment=m.segment[rows],
    )  # fmt: skip


def _stretches(motion: Trajectory, size: Array, count: int | None) -> Array:
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
