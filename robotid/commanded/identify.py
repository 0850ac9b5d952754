"""identify_commands(): from a model and logs of commands to drives, loops, bodies and trust."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pinocchio as pin

from robotid._typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.commanded.errors import OpenLoop, run_open_loop
from robotid.commanded.fit import STAGES, Fitted, fit_loops, stated_loops
from robotid.commanded.settings import LoopSettings
from robotid.exceptions import DataError
from robotid.findings import Finding, by_severity, listed
from robotid.identification.settings import SimulationSettings
from robotid.identification.verdict import JointVerdict, Verdict
from robotid.logs.data import Log
from robotid.robot.model import RobotModel
from robotid.simulation.loops import Loops

__all__ = ["Commanded", "identify_commands"]

#: Share of its motion that the open loop of a joint misses on logs kept apart: well, not usable.
GOOD, POOR = 0.05, 0.3
_BEATEN = 1.05  # a plainer model that misses this many times less is better
_FROM_DATA = 0.3  # a parameter whose spread the data shrink below this share is theirs
_FROM_PRIOR = 0.9  # ... above this share, what was assumed of it
_TOGETHER = 0.98  # correlation from which two parameters are told together only
_NAMED = 8  # parameters that a sentence names
_STEP = 1e-6  # of an unknown, over which parameters are differentiated


@dataclass(frozen=True, eq=False)
class Commanded:
    """What was found from commands and positions.

    Attributes:
        model: The robot, with the friction terms that were found.
        loop: What was stated of the loops.
        settings: The estimator's.
        fitted: The fit.
        errors: Open loops on the fitted logs.
        kept: Open loops on logs kept apart.
        findings: What the user should know.
    """

    model: RobotModel
    loop: LoopSettings
    settings: SimulationSettings
    fitted: Fitted
    errors: tuple[OpenLoop, ...]
    kept: tuple[OpenLoop, ...]
    findings: tuple[Finding, ...]

    @cached_property
    def standard(self) -> Array:
        """Standard parameters of the model, shape (p,)."""
        return _standard(self.model, self.fitted.loops)

    @cached_property
    def standard_covariance(self) -> Array:
        """Their covariance, shape (p, p); 0 of what was not to be found."""
        estimate, simulator = self.fitted.estimate, self.fitted.simulator
        columns = []
        for k, value in enumerate(estimate.theta):
            up, down = estimate.theta.copy(), estimate.theta.copy()
            step = _STEP * max(1.0, abs(value))
            up[k], down[k] = value + step, value - step
            ends = [_standard(self.model, simulator.loops(theta)) for theta in (up, down)]
            columns.append((ends[0] - ends[1]) / (2 * step))
        S = np.array(columns).T  # (p, c)
        covariance: Array = S @ estimate.covariance @ S.T
        return covariance

    @cached_property
    def shrunk(self) -> Array:
        """How far the data shrink what each unknown may be, shape (c,): 1 not at all [-]."""
        estimate = self.fitted.estimate
        share: Array = estimate.std_error / self.fitted.simulator.prior_std
        return share

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Unknowns that the logs say nothing of, bodies left out."""
        return tuple(
            unknown.name
            for unknown, share in zip(self.fitted.simulator.unknowns, self.shrunk, strict=True)
            if share > _FROM_PRIOR and unknown.what != "body"
        )

    @property
    def told_together(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of unknowns of loops that are told together only, and their correlation."""
        return tuple(_pairs(self.fitted))

    @property
    def has_gains(self) -> bool:
        """Whether the gains of the position were stated, of every joint."""
        return not any(unknown.what == "kp" for unknown in self.fitted.simulator.unknowns)

    @cached_property
    def verdict(self) -> Verdict:
        """How far to trust it."""
        return _judge(self)


def identify_commands(
    model: RobotModel,
    logs: Sequence[Log],
    kept: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    chooses: bool = True,
    progress: ProgressCallback = ignore_progress,
) -> Commanded:
    """Identify drives, loops and bodies from logs of commands and positions.

    Args:
        model: The robot.
        logs: Logs to fit, of its joints in its order, with commands.
        kept: Logs kept apart.
        loop: What is known of the loops.
        settings: The estimator's.
        chooses: Whether further friction is tried.
        progress: Told of the stages.

    Raises:
        DataError: If there is no log, or one has no commands.
        MissingDependencyError: If Numba is not installed.
        NotConvergedError: If it cannot be rolled out.
        SettingsError: If a setting does not fit the robot.
    """
    if not logs:
        raise DataError("no log was given; at least one is needed to identify anything")
    for log in (*logs, *kept):
        if log.q_ref is None:
            raise DataError(
                f"{log.name} has no commands, which the estimator 'simulation' follows; record "
                "columns qref_ of each joint, or identify from torques with another estimator"
            )
    if loop.gravity_compensation:
        logs, kept = ([_with_gravity(model, log) for log in part] for part in (logs, kept))
    fitted = fit_loops(model, logs, loop, settings, chooses=chooses, progress=progress)
    report_stage(progress, "testing", STAGES)
    stated = stated_loops(model, loop)
    has_gains = loop.kp is not None and not any(u.what == "kp" for u in fitted.simulator.unknowns)
    urdf = _urdf(model, stated) if has_gains else None
    runs = [[run_open_loop(log, fitted, urdf) for log in part] for part in (logs, kept)]
    found = Commanded(
        model=_with_terms(model, fitted.loops),
        loop=loop,
        settings=settings,
        fitted=fitted,
        errors=tuple(runs[0]),
        kept=tuple(runs[1]),
        findings=(),
    )
    return replace(found, findings=by_severity(_findings(found)))


def _standard(model: RobotModel, loops: Loops) -> Array:
    """Return the standard parameters of loops, shape (p,)."""
    drives = []
    for d, term in model.layout.drive_parameters:
        j = model.joints.index(model.layout.drives[d].name)
        drives.append(
            float(loops.armature[j] if term.is_inertia else loops.values[loops.place(j, term)])
        )
    return np.concatenate([loops.bodies.reshape(-1), drives])


def _with_terms(model: RobotModel, loops: Loops) -> RobotModel:
    """Return the model with the terms of loops that it has not yet."""
    own = {
        joint: [
            *model.layout.own.get(joint, ()),
            *(t for t in terms if t not in _has(model, joint)),
        ]
        for joint, terms in zip(model.joints, loops.terms, strict=True)
    }
    return RobotModel.from_urdf(
        model.tree, **{**model.options, "own_terms": {k: v for k, v in own.items() if v}}
    )


def _has(model: RobotModel, joint: str) -> list[object]:
    """Return the terms that the model has of a joint."""
    layout = model.layout
    return [term for d, term in layout.drive_parameters if layout.drives[d].name == joint]


def _urdf(model: RobotModel, stated: Loops) -> Loops:
    """Return the URDF with the stated gains: no friction, and a rotor that weighs nothing."""
    n = len(model.joints)
    return replace(stated, terms=((),) * n, values=np.zeros(0), armature=np.full(n, 1e-9))


def _with_gravity(model: RobotModel, log: Log) -> Log:
    """Return a log whose fed-forward torque has that of gravity by the URDF, as measured."""
    data = model.pin_model.createData()
    G = model.velocity_map
    configurations = model.configurations(log.q)
    torque = np.array(
        [pin.computeGeneralizedGravity(model.pin_model, data, q) @ G for q in configurations]
    )
    fed = torque if log.tau_ref is None else log.tau_ref + torque
    return replace(log, tau_ref=fed)


def _pairs(fitted: Fitted) -> Iterator[tuple[str, str, float]]:
    """Yield pairs of unknowns of loops whose errors go together."""
    unknowns, errors = fitted.simulator.unknowns, fitted.estimate.std_error
    own = [k for k, u in enumerate(unknowns) if u.what != "body" and errors[k] > 0]
    covariance = fitted.estimate.covariance
    for a, k in enumerate(own):
        for m in own[a + 1 :]:
            correlation = float(covariance[k, m] / (errors[k] * errors[m]))
            if abs(correlation) > _TOGETHER:
                yield unknowns[k].name, unknowns[m].name, correlation


def _findings(found: Commanded) -> Iterator[Finding]:
    """Yield what the user should know of the fit."""
    estimate = found.fitted.estimate
    if not estimate.converged:
        yield Finding(
            "not_settled",
            "warning",
            "fit",
            f"the fit has not settled after {estimate.n_iter} steps: its parameters may still "
            "move; state what you know of the loop in [controller], or use shorter windows",
        )
    if not found.has_gains:
        yield Finding(
            "scale",
            "warning",
            "controller",
            "commands and positions tell gains, friction and inertia up to one factor; it rests "
            "on the masses of the URDF and on gravity. What is sure are ratios, as kp over "
            "armature; state kp in [controller], or log a torque, to tell them apart",
        )
    at_zero = [
        name
        for name in estimate.details["at_bound"]
        if name.rpartition(".")[2] not in ("kp", "limit")
    ]
    if at_zero:
        yield Finding(
            "at_bound",
            "note",
            listed(at_zero, _NAMED),
            f"{listed(at_zero, _NAMED)} came out as 0, the least that can be: the motion shows "
            "none, or another parameter has taken it",
        )
    if "delay" in at_zero:
        yield Finding(
            "no_delay",
            "warning",
            "delay",
            "the delay came out as 0: commands and positions may not be of one clock, or the "
            "motion is too slow to show it; command a faster one",
        )
    for first, second, correlation in found.told_together:
        yield Finding(
            "told_together",
            "note",
            f"{first}, {second}",
            f"{first} and {second} are told together only (correlation {correlation:.2f})",
            {"correlation": correlation},
        )
    if found.undetermined:
        names = listed(found.undetermined, _NAMED)
        yield Finding(
            "undetermined",
            "warning",
            names,
            f"the logs say nothing of {names}: they keep what was assumed; command a motion that "
            "needs them",
        )
    chosen = [t for t in found.fitted.tried if t.is_chosen]
    for t in chosen:
        terms = " and ".join(t.terms)
        yield Finding(
            "friction_found",
            "note",
            t.joint,
            f"{t.joint}: {terms} lowers the squared error of windows that it was not fitted to by "
            f"{100 * t.gain:.0f} %",
            {"gain_pct": 100 * t.gain},
        )


def _judge(found: Commanded) -> Verdict:
    """Return the verdict: by the open loop on kept logs, and by plainer models on the same."""
    joints = found.model.joints
    shown = found.kept or found.errors
    by_joint = {
        joint: _judge_joint(joint, j, shown, bool(found.kept)) for j, joint in enumerate(joints)
    }
    rank = {"poor": 0, "not evaluated": 1, "usable": 2, "good": 3}
    status = min((v.status for v in by_joint.values()), key=rank.__getitem__)
    reasons = [
        reason
        for verdict in sorted(by_joint.values(), key=lambda v: rank[v.status])
        if verdict.status != "good"
        for reason in verdict.reasons
    ]
    if not found.fitted.estimate.converged:
        reasons.insert(0, "the fit has not settled")
        status = min(status, "usable", key=rank.__getitem__)
    if not found.kept:
        reasons.insert(0, "no log was kept apart: nothing tests the open loop; add [[validation]]")
    if status == "good":
        worst = max(float((run.rmse / run.spread).max()) for run in shown)
        reasons = [
            f"open loops miss at most {100 * worst:.2g} % of the motion of any joint on logs kept "
            "apart, and less than the plainer models"
        ]
    return Verdict(status, tuple(reasons), by_joint)


def _judge_joint(joint: str, j: int, runs: Sequence[OpenLoop], is_kept: bool) -> JointVerdict:
    """Return the verdict on one joint, by its worst log."""
    share = max(float(run.rmse[j] / max(run.spread[j], 1e-12)) for run in runs)
    said = f"{joint}: the open loop misses {100 * share:.2g} % of its motion"
    beaten = [
        name
        for name, others in (
            ("the command itself", [run.command for run in runs]),
            ("the plain model of second order", [run.second_order for run in runs]),
            ("the URDF with the stated gains", [run.urdf for run in runs]),
        )
        if all(other is not None for other in others)
        and _mean(run.rmse[j] for run in runs)
        > _BEATEN * _mean(other[j] for other in others if other is not None)
    ]
    if beaten:
        said += f"; {listed(beaten)} misses less"
    if not is_kept:
        return JointVerdict("not evaluated", (said,))
    if share > POOR or "the command itself" in beaten:
        return JointVerdict("poor", (said,))
    if share > GOOD or beaten:
        return JointVerdict("usable", (said,))
    return JointVerdict("good", (said,))


def _mean(values: Iterator[float]) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(list(values)))))
