"""identify_loops(): closed-loop identification of drives, loops and bodies from command logs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.findings import Finding
from robotid.base.typing import ProgressCallback, ignore_progress, report_stage
from robotid.data.log import Log
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import unwrap
from robotid.diagnosis.verdict.fit_findings import not_written, unlike_findings
from robotid.diagnosis.verdict.verdict import blocking
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.simulation.loops import Loops, open_loops
from robotid.estimation.fitting.estimator_settings import SimulationSettings
from robotid.estimation.variation.variation import vary
from robotid.identification.closed_loop.loop_findings import loop_findings
from robotid.identification.closed_loop.loop_result import (
    PositionIdentification,
    identified_loops,
    loop_runs,
)
from robotid.identification.closed_loop.loop_settings import LoopSettings
from robotid.identification.closed_loop.position_errors import run_open_loop
from robotid.identification.closed_loop.stages import STAGES, Fitted, fit_loops, stated_loops
from robotid.identification.result import StatedSettings
from robotid.robot.model import RobotModel


def identify_loops(
    model: RobotModel,
    logs: Sequence[Log],
    validation: Sequence[Log],
    loop: LoopSettings,
    settings: SimulationSettings,
    *,
    signals: SignalSettings | None = None,
    chooses: bool = True,
    examined: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    units: Sequence[str] = (),
    progress: ProgressCallback = ignore_progress,
) -> PositionIdentification:
    """Identify drives, loops and bodies from logs of commands and positions."""
    if not logs:
        raise DataError("no log was given. An identification needs at least one log")
    used = signals or SignalSettings()
    if loop.kind == "torque":
        logs, validation = (
            [driven_log(model, log, used) for log in part] for part in (logs, validation)
        )
    for log in (*logs, *validation):
        if log.q_ref is None:
            raise DataError(
                f"{log.name} has no commands, which the estimator 'simulation' needs. Record "
                "columns qref_ of each joint, or simulate from the logged torque: [controller] "
                "kind = 'torque'"
            )
    if loop.gravity_compensation:
        logs, validation = (
            [with_gravity(model, log) for log in part] for part in (logs, validation)
        )
    fitted = fit_loops(
        model, logs, loop, settings, signals=signals, chooses=chooses, progress=progress
    )
    report_stage(progress, "testing", STAGES)
    sign, simulator = fitted.encoders.sign, fitted.simulator
    robot = simulator.fine or simulator.robot  # with the steps of the fit
    runs = [
        [
            run_open_loop(
                robot, fitted.loops, log.turned(sign), _others(model, loop, fitted)
            )
            for log in part
        ]
        for part in (logs, validation)
    ]  # fmt: skip
    result = identified_loops(model, loop, settings, fitted, *map(tuple, runs))
    errors = blocking(examined, ignore)
    result = replace(
        result,
        log_errors=tuple(finding.message for finding in errors),
        stated=StatedSettings(used, ignore=tuple(ignore)),
        variation=vary(
            [log.name for log in logs],
            loop_runs(model, simulator, fitted.estimate, units),
            sorted(set(units)),
        ),
    )
    examined = [*examined, *unlike_findings(result.variation)]
    return replace(result, findings=(*loop_findings(result, examined), *not_written(errors)))


def _others(model: RobotModel, loop: LoopSettings, fitted: Fitted) -> dict[str, Loops]:
    """Return simpler models by name, for ``run_open_loop``.

    The URDF with the stated gains has no friction and no rotor inertia.
    """
    if fitted.linear is not None:
        driven, from_rows = fitted.linear.urdf_with_drives, fitted.linear.standard
        return {"urdf": open_loops(model, driven), "rows": open_loops(model, from_rows)}
    others = {} if fitted.plain is None else {"second_order": fitted.plain.loops}
    if loop.kp is not None and not any(u.what == "kp" for u in fitted.simulator.free_parameters):
        n, stated = len(model.joints), stated_loops(model, loop)
        bare = replace(stated, terms=((),) * n, values=np.zeros(0), armature=np.full(n, 1e-9))
        others["urdf"] = bare
    return others


def with_gravity(model: RobotModel, log: Log) -> Log:
    """Return a log with the URDF's gravity torque at the measured position added to tau_ref."""
    torque = predict_instants(model, model.standard_parameters(), log.q)
    fed = torque if log.tau_ref is None else log.tau_ref + torque
    return replace(log, tau_ref=fed)


def driven_log(model: RobotModel, log: Log, signals: SignalSettings) -> Log:
    """Return a log whose feed-forward torque is the measured one.

    The feed-forward torque is constant between two rows: the mean of the two, which avoids a delay
    of half a row. The command is the measured position; its gain is 0.
    """
    if not log.has_torque:
        raise DataError(
            f"{log.name} has no torque, which [controller] kind = 'torque' needs as the input. "
            "Record columns tau_ of each joint, or set kind = 'pd' for a log of commands"
        )
    free = np.array([joint.turns_freely for joint in model.limits])
    log = unwrap(log, free)
    measured = np.column_stack(
        [np.interp(log.t + signals.torque_delay, log.t, own) for own in log.tau.T]
    )
    tau = np.vstack([0.5 * (measured[1:] + measured[:-1]), measured[-1:]])
    return replace(log, q_ref=log.q, v_ref=None, tau_ref=tau)
