"""Checks of motions for their roles: excitation to fit, and no repetition to validate."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import RobotIdError
from robotid.base.findings import Finding, log_finding
from robotid.data.alike_motions import REPEATED, repeated_share
from robotid.data.log import Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import compress, merge
from robotid.dynamics.used_rows import base_problem, independent_share, row_mask
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
_RICHER = "a motion of all joints together, in both directions and as fast as permitted"
_LOST = "the excitation is good, but these parameters are not identifiable above the noise"


def check_repeated_motion(
    fitted: Sequence[Trajectory], validation: Trajectory, name: str
) -> Iterator[Finding]:
    """Yield a warning "repeated_motion" if a validation log repeats motion that is fitted."""
    share = repeated_share(fitted, validation)
    if share < REPEATED:
        return
    message = (
        f"{100 * share:.0f} % of this validation motion is in a fitted log, too: its torque "
        "prediction error is too optimistic; record another motion to validate with"
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
        message = f"the excitation was not checked: {error}"
        yield log_finding(name, "excitation", "warning", message)
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
    message = (
        f"the motion determines {known.rank} of {count} base parameters "
        f"(condition number {wls.condition:.3g} of the regressor, unit columns)"
    )
    is_poor = is_poorly_excited(wls, count)
    if known.groups:
        advice = f"record {_RICHER}" if is_poor else f"{_LOST}; a faster motion determines more"
        message += f": {known.described()}; {advice}"
    elif is_poor:
        left = 100 * known.shrinkage[-1]
        message += f". The standard error of the least determined one is {left:.2g} % of its prior"
        message += f" standard deviation; to determine it better, record {_RICHER}"
    else:
        message += "; no action needed"
    severity = "warning" if known.groups and is_poor else "note"
    return log_finding(name, "excitation", severity, message, **evidence)
