"""Information of each log of commands about the loop and drive of each joint.

A fit of all logs gives parameters theta and whitened residuals b. Near theta they are b - A x: a
log with the rows A and b gives the information A'A and the score A'b about the difference x of its
parameters from theta. Parameters of other joints keep their values.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import segment_scores
from robotid.estimation.fitting.identified import FROM_PRIOR
from robotid.estimation.variation.groups import FEWEST_RUNS, Group, RunsOf, inflation_of
from robotid.estimation.variation.mixed_effects import Runs
from robotid.identification.closed_loop.free_parameters import FreeParameter, LoopSimulator
from robotid.robot.drives import TERMS
from robotid.robot.model import RobotModel

_CHANGE = 0.1  # plausible standard deviation of a parameter between logs, over its value
_LEAST = 0.01  # ... at least, over its prior standard deviation
_LEAST_INFORMATION = 1e-12


def loop_runs(
    model: RobotModel, simulator: LoopSimulator, estimate: Estimate, unit: Sequence[str] = ()
) -> tuple[RunsOf, ...]:
    """Return the information of each log about the parameters of each joint, or of shared ones."""
    logs = list(dict.fromkeys(id(window.log) for window in simulator.windows))
    if len(logs) < FEWEST_RUNS or simulator.torque is not None:
        return ()
    scores = []
    for log in logs:
        windows = tuple(window for window in simulator.windows if id(window.log) == log)
        scores.append(segment_scores(replace(simulator, windows=windows), estimate))
    _, units = np.unique(unit or [""] * len(logs), return_inverse=True)
    groups: dict[tuple[int, ...], list[int]] = {}
    is_prior = estimate.std_error > FROM_PRIOR * simulator.prior_std
    for k, free in enumerate(simulator.free_parameters):
        is_open = is_prior[k] or free.name in estimate.details["at_bound"]
        if free.what != "body" and not is_open:
            groups.setdefault(free.joints, []).append(k)
    found = []
    for places in groups.values():
        own = [(H[:, places][:, :, places], g[:, places]) for H, g in scores]
        H, h = (np.array([each[k].sum(axis=0) for each in own]) for k in (0, 1))
        if not H.any():
            continue
        members = [simulator.free_parameters[k] for k in places]
        centre = estimate.theta[places]
        spread = np.where(np.isfinite(simulator.prior_std), simulator.prior_std, 0.0)[places]
        scale = np.maximum(_CHANGE * np.abs(centre), _LEAST * spread)
        scale = np.maximum(scale, _LEAST_INFORMATION)
        group = Group(
            "drive",
            members[0].name.rpartition(".")[0],
            tuple(each.name for each in members),
            tuple(units_of(model, each) for each in members),
            np.zeros((0, len(members))),
            members[0].joints,
        )
        inflation = inflation_of(own)
        runs = Runs(H / inflation, h / inflation, units, scale)
        found.append(RunsOf(group, centre, runs, inflation))
    return tuple(found)


def units_of(model: RobotModel, free: FreeParameter) -> str:
    """Return the unit of a free parameter of a loop or drive."""
    is_linear = model.joints[free.joints[0]] in model.layout.prismatic
    if free.term is not None:
        return free.term.units[is_linear]
    if free.what == "armature":
        return TERMS["armature"].units[is_linear]
    force, length = ("N", "m") if is_linear else ("N m", "rad")
    return {
        "kp": f"{force}/{length}", "kd": f"{force} s/{length}", "delay": "s", "limit": force,
        "zero": length,
    }[free.what]  # fmt: skip
