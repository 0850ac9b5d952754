"""identify() for Python: from torques, or by simulation."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from robotid.base.arguments import checked
from robotid.base.exceptions import SettingsError
from robotid.base.settings import require_flag, require_kind
from robotid.base.typing import ProgressCallback, ignore_progress, report_stage
from robotid.data.files.read import Readable, read_logs
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.logs.check_logs import diagnose
from robotid.diagnosis.verdict.verdict import check_ignored
from robotid.estimation.fitting.estimator_settings import EstimatorSettings, SimulationSettings
from robotid.identification import pipeline
from robotid.identification.pipeline import robot_of
from robotid.identification.result import Identification, TorqueIdentification
from robotid.robot.families import AUTO, wanted_families
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.identification.closed_loop.loop_result import PositionIdentification


@overload
def identify(  # type: ignore[overload-overlap]
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable],
    *,
    estimator: Literal["simulation"] | SimulationSettings,
    validation: Readable | Sequence[Readable] = ...,
    signals: SignalSettings | None = ...,
    controller: Mapping[str, Any] | None = ...,
    friction: str | Mapping[str, str] = ...,
    doctor: bool = ...,
    ignore: Sequence[str] = ...,
    progress: ProgressCallback | None = ...,
) -> "PositionIdentification": ...


@overload
def identify(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable],
    *,
    estimator: str | EstimatorSettings = ...,
    validation: Readable | Sequence[Readable] = ...,
    signals: SignalSettings | None = ...,
    controller: Mapping[str, Any] | None = ...,
    friction: str | Mapping[str, str] = ...,
    doctor: bool = ...,
    ignore: Sequence[str] = ...,
    progress: ProgressCallback | None = ...,
) -> TorqueIdentification: ...


@checked("progress")
def identify(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable],
    *,
    validation: Readable | Sequence[Readable] = (),
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
    controller: Mapping[str, Any] | None = None,
    friction: str | Mapping[str, str] = AUTO,
    doctor: bool = True,
    ignore: Sequence[str] = (),
    progress: ProgressCallback | None = None,
) -> Identification:
    """Identify a robot's parameters from motion logs, as the command line does.

    Args:
        model: The robot, or the path of its URDF with all joints free.
        logs: Logs to fit: a ``Log`` with the model's joints, the path of a file, a DataFrame with
            the columns of such a file, or several of these. Files are read whole, as by
            ``read_log``; ``robotid.run_job`` reads long files in pieces.
        validation: Logs for validation, of the same types.
        signals: Settings of the signal processing; the defaults if None.
        estimator: Name or settings of the estimator. "simulation" simulates the robot on the
            commands, or on the torques, of the logs.
        controller: Known properties of the position controllers, with the keys of the table
            ``[controller]`` of a job file; only for the estimator "simulation".
        friction: Friction terms in addition to viscous and Coulomb friction, as of
            ``wanted_families``; "auto" selects them. Simulation selects those of all joints, or
            of none.
        doctor: Whether the doctor checks the logs first; its findings count in the verdict.
        ignore: Codes of errors and warnings to ignore.
        progress: Called at the start of each stage with its name, the stages done, their number
            and "stages"; in between with the name of a work, the units done, their number and
            their name.

    Returns:
        The identification; for the estimator "simulation" its
            evaluations are of positions, else of torques.

    Raises:
        DataError: If a log cannot be read, does not match the model or is too short.
        ModelError: If the model is neither a model nor the path of a usable URDF.
        RankDeficientError: If the estimator is "ols" or "wls" and the data do not determine all
            base parameters.
        NotConvergedError: If a solver fails, or the closed loop cannot be simulated.
        SettingsError: If a setting is out of range, or a code to ignore is unknown.
    """
    require_kind(
        estimator, (str, EstimatorSettings), "estimator", "a name or a robotid.EstimatorSettings"
    )
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    if not isinstance(choice, SimulationSettings):
        if controller is not None:
            raise SettingsError(
                f"controller is given, but the estimator is {choice.name!r}, wanted 'simulation'; "
                "remove controller, or set estimator='simulation'"
            )
        return pipeline.identify(
            model, logs, validation=validation, signals=signals, estimator=choice,
            friction=friction, doctor=doctor, ignore=ignore, progress=progress,
        )  # fmt: skip
    from robotid.identification.closed_loop.from_commands import identify_loops
    from robotid.identification.closed_loop.loop_settings import LoopSettings
    from robotid.identification.closed_loop.stages import STAGES

    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    require_kind(controller, (Mapping, type(None)), "controller", "a table of its settings")
    require_flag(doctor, "doctor")
    check_ignored(ignore)
    loop, settings = LoopSettings.from_dict(controller or {}), signals or SignalSettings()
    report_stage(progress, "reading logs", STAGES)
    model = robot_of(model, logs)
    wanted = wanted_families(friction, model.joints).values()
    if any(wanted) or len({names is None for names in wanted}) > 1:
        raise SettingsError(
            "friction is stated by joint or with families, but simulation selects the terms of all "
            "joints, or of none; wanted 'auto' or 'viscous+coulomb'. State terms in the model"
        )
    needs: Literal["torque", "commands"] = "torque" if loop.kind == "torque" else "commands"
    fitted, held_out = (
        read_logs(
            some,
            model.joints,
            prismatic=model.layout.prismatic,
            needs=needs,
            robot=model.tree.movable,
        )
        for some in (logs, validation)
    )
    return identify_loops(
        model, fitted, held_out, loop, choice, signals=settings, chooses=None in wanted,
        examined=diagnose(model, fitted, held_out, settings) if doctor else (), ignore=ignore,
        progress=progress or ignore_progress,
    )  # fmt: skip
