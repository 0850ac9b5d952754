"""An identification: a fit with findings and a verdict."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from robotid.base.arguments import checked
from robotid.base.exceptions import DataError
from robotid.base.findings import Finding, listed
from robotid.base.settings import Settings, require_kind
from robotid.data.log import suggestion
from robotid.data.signal_settings import SignalSettings
from robotid.diagnosis.residual.misfit import Misfit
from robotid.diagnosis.residual.torque_split import JointTorque, joint_torques
from robotid.diagnosis.verdict.evidence import Determined, Predictions
from robotid.diagnosis.verdict.parameter_table import parameter_entries, parameter_table
from robotid.diagnosis.verdict.payload_check import PayloadCheck
from robotid.diagnosis.verdict.scale_check import ScaleCheck, check_scale
from robotid.diagnosis.verdict.verdict import Verdict, VerdictWarning, judge
from robotid.estimation.fitting.evaluation import Evaluation, hidden_joints
from robotid.estimation.fitting.fitted import Fit
from robotid.identification.pictures import friction_chart, shown_evaluation, torque_charts
from robotid.identification.summary import (
    identification_html,
    identification_line,
    identification_text,
)
from robotid.identification.why_pictures import why_charts
from robotid.output.pages.plots import Plot
from robotid.robot.families import AUTO


@dataclass(frozen=True)
class Asked:
    """Settings of an identification other than robot, logs and estimator.

    Attributes:
        signals: How logs become trajectories.
        friction: As of ``identify``.
        ignore: As of ``identify``.
        job: The job that was run; None if there was none.
    """

    signals: SignalSettings = field(default_factory=SignalSettings)
    friction: str | Mapping[str, str] = AUTO
    ignore: tuple[str, ...] = ()
    job: Settings | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Fit):
    """Complete result of an identification.

    Attributes:
        findings: Findings about the robot, the logs and the fit.
        log_errors: Faults of the recordings that make the result wrong, found by the doctor.
        warnings: Why it may be wrong although it predicts well, from the doctor and the fit.
        report: File of the report, if one was written with the result.
        misfits: Terms that its drive models lack.
        on_misfit: Names of drive parameters whose errors increased for these.
        asked: Stated signals, friction and findings to ignore.
        payload_checks: Checks of the torque scale with payloads of known mass, that with the
            narrowest interval first.
    """

    findings: tuple[Finding, ...] = ()
    log_errors: tuple[str, ...] = ()
    warnings: tuple[VerdictWarning, ...] = ()
    report: str = ""
    misfits: tuple[Misfit, ...] = ()
    on_misfit: tuple[str, ...] = ()
    asked: Asked = field(default_factory=Asked)
    payload_checks: tuple[PayloadCheck, ...] = ()

    def __repr__(self) -> str:
        return identification_line(self, self.estimator.name, self.verdict.status)

    def _repr_html_(self) -> str:
        return identification_html(self)

    def summary(self) -> str:
        """Return verdict, reasons and errors by joint as text."""
        return identification_text(self)

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

    def plot_torques(self, *joints: str, recording: Evaluation | None = None) -> Plot:
        """Return charts of measured and identified torque over time, and of the residual.

        Args:
            joints: The joints; all if none is named.
            recording: One of ``fitted`` or ``validation``; None: the first validation recording,
                or the first fitted one.

        Returns:
            Charts that a notebook shows and ``.write("torques.html")`` saves.

        Raises:
            DataError: If there is no such joint.
        """
        require_kind(
            recording, (Evaluation, type(None)), "recording", "one of fitted or validation, or none"
        )
        shown = shown_evaluation(self) if recording is None else recording
        band, rows = (
            self.band(shown),
            [self._row(joint) for joint in joints or self.model.row_names],
        )
        charts = []
        for row in rows:
            torque, residual = torque_charts(self, shown, row, band=band)
            name = self.model.row_names[row]
            charts += [(torque, f"{name}: torque"), (residual, f"{name}: residual")]
        return Plot(f"Torques of {shown.recording.name}", tuple(charts))

    def plot_friction(self, *joints: str) -> Plot:
        """Return charts of friction against speed, measured and identified, with its band.

        Args:
            joints: The joints; all if none is named.

        Returns:
            Charts that a notebook shows and ``.write("friction.html")`` saves.

        Raises:
            DataError: If there is no such joint, or none that moved.
        """
        names = [self.model.row_names[self._row(joint)] for joint in joints or self.model.joints]
        charts = [(friction_chart(self, name), f"{name}: friction and offset") for name in names]
        shown = tuple((chart, caption) for chart, caption in charts if chart is not None)
        if not shown:
            raise DataError(f"{listed(names)}: no samples used, so there is no friction to show")
        return Plot(f"Friction of {listed(names)} against speed", shown)

    def plot_why(self, joint: str) -> Plot:
        """Return charts of the parts of a joint's torque, and of its residual's dependences.

        Args:
            joint: The joint.

        Returns:
            Charts that a notebook shows and ``.write("why.html")`` saves.

        Raises:
            DataError: If there is no such joint.
        """
        torque = self.joint_torques[self._row(joint)]
        charts = why_charts(torque)
        about = {name: f"residual against {name}" for name in charts}
        about |= {"split": torque.sentence, "power": "mechanical power"}
        shown = tuple((chart, f"{joint}: {about[name]}") for name, chart in charts.items())
        return Plot(f"Torque parts and residual of {joint}", shown)

    def _cause_of(self, joint: str) -> str:
        """Return the cause of a joint's residual, as a sentence."""
        return self.joint_torques[self._row(joint)].sentence

    def _row(self, joint: str) -> int:
        """Return the index of a joint's torque row."""
        require_kind(joint, str, "joint", "the name of a joint")
        names = self.model.row_names
        if joint not in names:
            raise DataError(
                f"joint {joint!r} is not among the identified joints: {listed(names)}"
                f"{suggestion(joint, names)}"
            )
        return names.index(joint)

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
        return replace(self._scale, payloads=self.payload_checks)

    @cached_property
    def _scale(self) -> ScaleCheck:
        return check_scale(self)

    @checked()
    def with_scale_of(self, fit: "Identification") -> "Identification":
        """Return the result with the scale check of the same fit, which is not computed again.

        Args:
            fit: A result of the same fit, with other findings or payload checks.
        """
        same = copy(self)
        vars(same)["_scale"] = fit._scale
        return same

    @property
    def _uncertain_drives(self) -> list[str]:
        """The drive parameters that the prior determines, without those of undetermined sums."""
        drives = list(zip(self.model.layout.names, self.sources, strict=True))
        drives = drives[self.model.layout.n_inertial :]
        return [n for n, source in drives if source == "prior" and n not in self.undetermined]

    @cached_property
    def verdict(self) -> Verdict:
        """Verdict on the result, with reasons."""
        logs = [e.recording.log for e in (*self.fitted, *self.validation)]
        driven = tuple(x for x in self.model.joints if x not in self.model.passive)
        predictions = Predictions(
            self.metrics(),
            self.predictions,
            driven if any(log.has_torque for log in logs) else (),
            refitted=[e.recording.name for e in self.refitted],
            hidden=hidden_joints(self.model, self.fitted),
        )
        determined = Determined(
            self.determination.undetermined,
            self.is_consistent,
            self.is_poorly_excited,
            self.model.is_static,
            self._uncertain_drives,
        )
        # not of long logs, of which only parts are in memory, and not of projected rows, whose
        # torques are not those of joints
        has_cause = not (
            self.model.constraints
            or any(e.recording.is_partial for e in (*self.fitted, *self.validation))
        )
        return judge(
            predictions,
            determined,
            log_errors=self.log_errors,
            warnings=self.warnings,
            scale_check=self.scale_check,
            cause_of=self._cause_of if has_cause else None,
        )
