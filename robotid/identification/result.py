"""An identification: parameters with the errors of their predictions, findings and a verdict."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from robotid.base.findings import Finding
from robotid.base.settings import Settings
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.joint_torques import JointTorque, joint_torques
from robotid.diagnosis.residual.misfit import Misfit
from robotid.diagnosis.verdict.scale_check import PayloadCheck, ScaleCheck, check_scale
from robotid.diagnosis.verdict.verdict import (
    Determined,
    Predictions,
    Verdict,
    VerdictWarning,
    judge,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import Evaluated, Evaluation, Metrics, hidden_joints
from robotid.estimation.fitting.fit import pinned_joints
from robotid.estimation.fitting.fitted import Fit, Identified
from robotid.estimation.variation.variation import Variation
from robotid.identification.parameter_table import parameter_entries, parameter_table
from robotid.identification.summary import (
    error_lines,
    friction_lines,
    variation_lines,
    verdict_lines,
)
from robotid.robot.drives import AUTO


@dataclass(frozen=True)
class StatedSettings:
    """Settings of an identification other than robot, logs and estimator."""

    signals: SignalSettings = field(default_factory=SignalSettings)  # how logs become trajectories
    friction: str | Mapping[str, str] = AUTO  # as of ``identify``
    ignore: tuple[str, ...] = ()  # as of ``identify``
    job: Settings | None = None  # the job that was run; None if there was none


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Identification(Identified):
    """Identified parameters, the errors of their predictions, findings and a verdict.

    Predictions are torques, or positions simulated from commands or torques: the metrics of each
    evaluation state the unit of its error.

    Attributes:
        estimator: The estimator's settings.
        fitted: The fitted recordings, with predictions and their errors.
        validation: The validation recordings, likewise.
        findings: Findings about the robot, the logs and the fit.
        log_errors: Faults of the recordings that make the result wrong, found by the doctor.
        report: File of the report, if one was written with the result.
        stated: Signals, friction and findings to ignore, as stated, and the job.
        variation: Variation of the drives' parameters between the fitted logs.
    """

    estimator: EstimatorSettings
    fitted: tuple[Evaluated, ...]
    validation: tuple[Evaluated, ...]
    findings: tuple[Finding, ...] = ()
    log_errors: tuple[str, ...] = ()
    report: str = ""
    stated: StatedSettings = field(default_factory=StatedSettings)
    variation: Variation | None = None

    def __repr__(self) -> str:
        return (
            f"<Identification of {self.model.name}: {len(self.base)} base parameters by "
            f"{self.estimator.name}, verdict {self.verdict.status}>"
        )

    @property
    def has_urdf(self) -> bool:
        """Whether a URDF may be written: no fault of the logs makes it wrong."""
        return not self.log_errors

    @property
    def has_gains(self) -> bool:
        """Whether it has gains of position controllers."""
        return False

    @cached_property
    @abstractmethod
    def verdict(self) -> Verdict:
        """The verdict on the result, with reasons."""

    @abstractmethod
    def metrics(self, name: str = "estimate") -> Metrics:
        """Return the metrics over all fitted recordings.

        Args:
            name: "estimate"; of torques also "wls".
        """

    def beside(self, evaluation: Evaluated | None = None) -> Metrics | None:
        """Return the metrics of WLS, None if there are none.

        Args:
            evaluation: A recording; None: all fitted ones together.
        """
        return None

    def _friction_lines(self) -> list[str]:
        """Return the selected friction terms as text."""
        return []

    def summary(self) -> str:
        """Return verdict, reasons and errors by joint as text."""
        lines = [repr(self)[1:-1], *verdict_lines(self.verdict.to_dict())[1:]]
        compared: list[tuple[str, Metrics, Evaluated | None]] = [
            (f"{e.name}: not fitted", e.metrics["estimate"], e) for e in self.validation
        ]
        for caption, metrics, evaluation in [*compared, ("fitted rows", self.metrics(), None)]:
            wls = self.beside(evaluation)
            beside = None if wls is None else wls.to_dict()
            lines += [caption, *error_lines(metrics.to_dict(), beside)]
        lines += self._friction_lines()
        lines += variation_lines(None if self.variation is None else self.variation.to_dict())
        if self.report:
            lines.append(f"report: {self.report}")
        return "\n".join(lines)

    __str__ = summary

    def table(self) -> Any:  # noqa: ANN401
        """Return the standard parameters as a table: a row for each, links first, then drives.

        Returns:
            A pandas DataFrame if pandas is installed, else a list of dictionaries. Columns:
            "part" (link or drive), "parameter", "urdf", "value", "std_error", "low" and "high"
            (95 % interval), "source" (as of ``sources``), "unit". Missing values are None, or NaN
            in a DataFrame: "urdf" of drives, "std_error" of a parameter at its bound.
        """
        return parameter_table(*parameter_entries(self))


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class TorqueIdentification(Identification, Fit):
    """Identification that predicts torques."""

    fitted: tuple[Evaluation, ...]
    validation: tuple[Evaluation, ...]
    warnings: tuple[VerdictWarning, ...] = ()  # why it may be wrong although it predicts well
    misfits: tuple[Misfit, ...] = ()  # terms that its drive models lack
    on_misfit: tuple[str, ...] = ()  # names of drive parameters whose errors increased for these
    scale: ScaleCheck | None = None  # scale check without payloads, as computed; None: not yet
    payload_checks: tuple[PayloadCheck, ...] = ()  # that with the narrowest interval first

    metrics = Fit.metrics

    def beside(self, evaluation: Evaluated | None = None) -> Metrics:
        return self.metrics("wls") if evaluation is None else evaluation.metrics["wls"]

    def _friction_lines(self) -> list[str]:
        return friction_lines({drive.joint: drive.to_dict() for drive in self.drives})

    @cached_property
    def joint_torques(self) -> tuple[JointTorque, ...]:
        """Torque of each row, its parts, and what its residual depends on."""
        return joint_torques(self)

    @property
    def has_urdf(self) -> bool:
        """Whether a URDF may be written: it is consistent, and no fault makes it wrong."""
        return self.is_consistent and not self.log_errors

    @property
    def scale_check(self) -> ScaleCheck:
        """Scale check: identified gravity and masses against the URDF's."""
        scale = check_scale(self) if self.scale is None else self.scale
        return replace(scale, payloads=self.payload_checks)

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on the result, with reasons."""
        model, recordings = self.model, [e.recording for e in (*self.fitted, *self.validation)]
        driven = tuple(x for x in model.joints if x not in model.passive)
        has_torque = any(recording.log.has_torque for recording in recordings)
        predictions = Predictions(
            self.metrics(), self.predictions, driven if has_torque else (),
            refitted=[e.name for e in self.refitted], hidden=hidden_joints(model, self.fitted),
            pinned=pinned_joints(self.estimator.bounds, model),
        )  # fmt: skip
        sources = list(zip(model.layout.names, self.sources, strict=True))
        by_prior = [name for name, x in sources[model.layout.n_inertial :] if x == "prior"]
        determined = Determined(
            self.determination.undetermined, self.is_consistent, self.is_poorly_excited,
            model.is_static, [name for name in by_prior if name not in self.undetermined],
        )  # fmt: skip
        return judge(
            predictions, determined, log_errors=self.log_errors, warnings=self.warnings,
            scale_check=self.scale_check, cause_of=self.residual_cause,
        )  # fmt: skip

    def residual_cause(self, joint: str) -> tuple[str, str]:
        """Return the cause of a joint's residual, and what to do; empty if it is not known."""
        # not of long logs, of which only parts are in memory, and not of projected rows, whose
        # torques are not those of joints
        recordings = [e.recording for e in (*self.fitted, *self.validation)]
        if self.model.constraints or any(x.is_partial for x in recordings):
            return "", ""
        return self.joint_torques[self.model.row_names.index(joint)].cause
