"""Checks of motions for their roles, and of locked joints: excitation, repetition, positions."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import RobotIdError
from robotid.base.findings import Finding, toml_key
from robotid.base.typing import Array
from robotid.data.log import REPEATED, Trajectory, repeated_share
from robotid.data.signal_settings import LogUnits, SignalSettings
from robotid.diagnosis.catalogue import finding
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import compress, merge
from robotid.dynamics.prepared_logs import base_problem, independent_share, row_mask
from robotid.estimation.estimators import WLS, Estimate
from robotid.estimation.estimators.determination import (
    Determination,
    base_spread,
    determine,
    is_poorly_excited,
)
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

_ROWS = 5000  # of a log, from which its excitation is computed
#: Largest range of a locked joint, and largest difference from its stated position [rad or m].
STILL = 0.02
_FAR = 2 * np.pi  # number in a log above which a position may be a percentage


def check_repeated_motion(
    fitted: Sequence[Trajectory], validation: Trajectory, name: str
) -> Iterator[Finding]:
    """Yield a warning "repeated_motion" if a validation log repeats motion that is fitted."""
    share = repeated_share(fitted, validation)
    if share >= REPEATED:
        yield finding("repeated_motion", name, share=share)


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


def check_locked(
    model: RobotModel,
    positions: Mapping[str, Array],
    log: str,
    asked: Collection[str],
    units: LogUnits,
) -> Iterator[Finding]:
    """Yield an error "locked_position" per locked joint that moves or has another position."""
    prismatic = {joint.name for joint in model.tree.movable if joint.type == "prismatic"}
    for joint, q in positions.items():
        stated = model.locked[joint]
        middle, extent = float(np.median(q)), float(np.ptp(q))
        if extent <= STILL and abs(middle - stated) <= STILL:
            continue
        what = "moves" if extent > STILL else "stands"
        yield finding(
            "locked_position", log, joint, what=what, todo=what, default=joint in asked,
            unit="m" if joint in prismatic else "rad", stated=stated, median=middle, range=extent,
            setting=f"locked = {{ {joint} = {middle:.4g} }}", flag=f"--lock {joint}={middle:.4g}",
            percent=percent_hint(model, joint, middle, units),
        )  # fmt: skip


def percent_hint(model: RobotModel, name: str, position: float, units: LogUnits) -> str:
    """Return what to state if the position of a gripper is a percentage; "" if it cannot be one."""
    joint = next(joint for joint in model.tree.movable if joint.name == name)
    first, scale = units.scale(name, is_angle=joint.type != "prismatic")
    logged = (position - first) / scale
    moves = any(other.parent == joint.child for other in model.tree.movable)
    if name in units.percent or moves or not joint.has_limits or not _FAR < logged <= 100:
        return ""
    low, high = joint.lower, joint.upper
    unit = "m" if joint.type == "prismatic" else "rad"
    return (
        f". If {logged:.4g}, the number in the log, is a percentage, as of LeRobot's grippers, "
        f"state percent = {{ {toml_key(name)} = [{low:.4g}, {high:.4g}] }} in [units], the "
        f"positions at 0 and at 100 [{unit}]: it then is at "
        f"{low + (high - low) * logged / 100:.4g} {unit}"
    )
