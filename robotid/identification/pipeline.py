"""identify(): from a model and logs to parameters and how far they can be trusted."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid._settings import Settings, require_flag, require_kind
from robotid._typing import Array, ProgressCallback, ignore_progress, report_stage
from robotid.doctor.diagnosis import diagnose
from robotid.doctor.motions import is_poorly_excited
from robotid.doctor.urdf_inertials import impossible_inertials
from robotid.estimators import WLS, Consistent, Estimate
from robotid.estimators.determination import Determination, base_spread, determine
from robotid.estimators.estimator import Weighing
from robotid.exceptions import (
    DataError,
    ModelError,
    NotConvergedError,
    RankDeficientError,
    SettingsError,
)
from robotid.findings import Finding, listed
from robotid.identification.bands import (
    REACH,
    FrictionCurve,
    TorqueBand,
    expected_band,
    fitted_moments,
    recording_bands,
    usual_friction,
)
from robotid.identification.baselines import urdf_with_drives
from robotid.identification.discrepancies import explain_residual
from robotid.identification.drive_choice import DriveChoice, choose_drives, wanted_families
from robotid.identification.evaluation import Evaluation, evaluate_logs, hidden_joints, pool
from robotid.identification.findings import fit_findings, log_findings, unwritten
from robotid.identification.fitting import Known, consistent_fit, make_estimator
from robotid.identification.metrics import Metrics
from robotid.identification.misfit import (
    Misfit,
    counterbalanced,
    settled,
    take_sample,
    with_known_springs,
)
from robotid.identification.model_error import OpenTerm, settled_shapes, with_model_error
from robotid.identification.parameter_table import parameter_entries, parameter_table
from robotid.identification.pictures import friction_chart, shown_evaluation, torque_charts
from robotid.identification.recordings import Recordings
from robotid.identification.regressor_noise import RegressorNoise, find_regressor_noise
from robotid.identification.robust import Outlier, find_outliers, reweigh
from robotid.identification.settings import (
    BoundedSettings,
    EstimatorSettings,
    OLSSettings,
    RecursiveSettings,
    TLSSettings,
)
from robotid.identification.standard_errors import (
    Redraws,
    StandardErrors,
    measured_errors,
    standard_of,
    with_wls_errors,
)
from robotid.identification.summary import (
    identification_html,
    identification_line,
    identification_text,
)
from robotid.identification.survey import hold_log
from robotid.identification.torque_split import joint_torques
from robotid.identification.verdict import (
    Doubt,
    Verdict,
    alarming,
    check_ignored,
    doubts_of,
    judge,
    refuted,
)
from robotid.identification.why_pictures import why_charts
from robotid.identification.witness import Witness, call_witness
from robotid.logs.data import suggestion
from robotid.logs.read import Readable, read_logs
from robotid.logs.settings import SignalSettings
from robotid.pages.plots import Plot
from robotid.regressor.base_parameters import BaseMapping, structural_mapping
from robotid.regressor.factors import Factors, Reduction, join
from robotid.regressor.friction_projection import projected_pinocchio_model
from robotid.regressor.prediction import predict_instants
from robotid.robot.bodies import held_parameters
from robotid.robot.drives import AUTO
from robotid.robot.mass_matrix import MassMatrixCheck, check_mass_matrix
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.prior import prior_spread

__all__ = [
    "SOURCES",
    "Asked",
    "EstimatorSettings",
    "Identification",
    "conclude",
    "identify",
    "robot_of",
    "with_drives",
]

#: What may have determined a standard parameter.
SOURCES = ("data", "mixed", "prior", "bound")

_ROBOTS = (".urdf", ".xml", ".xacro")  # suffixes of files that describe robots
_FROM_DATA = 0.3  # a parameter whose spread the data shrink below this share is theirs
_KNOWN = 1e-300  # the spread of what was known exactly
_FROM_PRIOR = 0.9  # ... and above this share, the prior's, if it stayed there
_STAYED = 0.3  # spreads that such a parameter may have moved
_MOST_SHAPES = 2  # fits until shapes fit together with the terms of all joints
_MOST_LOADS = 20  # fits until the load of the gears is that of the bodies found
_DAMPED = 3  # of them, after which they go half way only
_SETTLED = 1e-3  # of the torque, by which they may still move it
_AT_BOUND = 1e-6  # of its spread: a drive term that small is at its bound of 0


@dataclass(frozen=True)
class Asked:
    """What an identification was asked for, beside robot, logs and estimator.

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


@dataclass(frozen=True, eq=False)
class Identification:
    """Everything that an identification found.

    Attributes:
        model: The robot as the URDF describes it.
        mapping: Standard to base parameters.
        estimator: The estimator's settings.
        estimate: What the estimator returned: base parameters, or standard ones ("consistent").
        wls: Weighted least squares on the same factors, base parameters.
        prior: Standard parameters of the URDF, shape (p,).
        urdf_with_drives: The same with the drive terms that then fit best, shape (p,).
        prior_std: How far they may plausibly be wrong, shape (p,).
        standard: Standard parameters, shape (p,).
        standard_covariance: Their covariance given the prior, shape (p, p).
        base: Base parameters, shape (b,).
        base_error: Their standard errors, shape (b,); inf where the data say nothing.
        fitted: The recordings that were fitted, with predictions "estimate" and "wls".
        validation: The same of the recordings that were kept apart.
        errors: What the standard errors rest on.
        factors: What the fitted rows come down to, base parameters.
        determination: Which base parameters the fitted rows determine.
        findings: What the user should know of the robot, of the logs and of the fit.
        alarms: Faults of the recordings that make the result wrong, as the doctor found them.
        doubts: Why it may be wrong however well it predicts, as the doctor and the fit found.
        report: File of the report, if one was written with the result.
        drives: What friction its joints have beside viscous and Coulomb's, and what was tried.
        open_terms: What is open of its drives, which ``standard_covariance`` counts.
        misfits: Terms that the model of its drives still lacks.
        on_misfit: Names of drive parameters whose errors grew by these.
        asked: Signals, friction and findings to ignore, as they were asked for.
        regressor_noise: What the steps of the positions do to least squares; None: next to nothing.
    """

    model: RobotModel
    mapping: BaseMapping
    estimator: EstimatorSettings
    estimate: Estimate
    wls: Estimate
    prior: Array
    urdf_with_drives: Array
    prior_std: Array
    standard: Array
    standard_covariance: Array
    base: Array
    base_error: Array
    fitted: tuple[Evaluation, ...]
    validation: tuple[Evaluation, ...]
    errors: StandardErrors
    factors: Factors
    determination: Determination
    findings: tuple[Finding, ...] = ()
    alarms: tuple[str, ...] = ()
    doubts: tuple[Doubt, ...] = ()
    report: str = ""
    drives: tuple[DriveChoice, ...] = ()
    open_terms: tuple[OpenTerm, ...] = ()
    misfits: tuple[Misfit, ...] = ()
    on_misfit: tuple[str, ...] = ()
    asked: Asked = field(default_factory=Asked)
    regressor_noise: RegressorNoise | None = None
    _checked: list[tuple[Array, MassMatrixCheck]] = field(default_factory=list, repr=False)

    def __repr__(self) -> str:
        return identification_line(self)

    def _repr_html_(self) -> str:
        return identification_html(self)

    def summary(self) -> str:
        """Return verdict, reasons and errors by joint as text."""
        return identification_text(self)

    __str__ = summary

    def predict(
        self, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None
    ) -> Array:
        """Return the torques of motion, by the identified bodies, drives and chosen friction.

        Friction acts by the sign of the speed: at rest, where it holds any torque up to its size,
        it counts as 0. Drives whose friction has a memory (presliding) have moved one way for
        long, and a torque that comes late (lag) is told as of an instant at which it stays.

        Args:
            q: Positions in the order of ``model.joints``, shape (n,) or (N, n) [rad, m].
            v: Velocities, likewise [rad/s, m/s]; None: at rest.
            a: Accelerations, likewise [rad/s^2, m/s^2]; None: 0.

        Returns:
            Torques, likewise [N m, N].

        Raises:
            DataError: If a shape does not fit, or a value is not finite.
        """
        return predict_instants(self.model, self.standard, q, v, a)

    def friction(
        self,
        joint: str,
        v: ArrayLike | None = None,
        *,
        q: float | None = None,
        load: float | None = None,
    ) -> FrictionCurve:
        """Return friction and offset of a joint's drive against its speed, with their band.

        Args:
            joint: The joint, or the name of a coupling.
            v: Speeds, shape (k,) [rad/s or m/s]; None: 20 either way, from the slowest to the
                fastest of the fitted rows.
            q: Position, of which some friction depends [rad or m]; None: the median.
            load: Torque of the bodies that the gear carries, of which some friction depends
                [N m or N]; None: its root mean square in the fitted logs.

        Returns:
            The curve: ``v``, ``torque``, ``std``, ``half_width`` of the 95 % band, ``load``.

        Raises:
            DataError: If there is no such drive; or without speeds, if it stood still.
        """
        return usual_friction(self, joint, v, q=q, load=load)

    def table(self) -> Any:  # noqa: ANN401
        """Return the standard parameters as a table: a row for each, links first, then drives.

        Returns:
            A pandas DataFrame if pandas is installed, else a list of dictionaries. Columns:
            "part" (link or drive), "parameter", "urdf", "value", "std_error", "low" and "high"
            (95 % interval), "source" (as of ``sources``), "unit". A URDF has no value of drives
            that is used, and a parameter at its bound no standard error: None, or NaN in a
            DataFrame.
        """
        return parameter_table(*parameter_entries(self))

    def pinocchio_model(self) -> Any:  # noqa: ANN401
        """Return a ``pinocchio.Model`` with the identified inertias, armature and friction.

        ``damping`` has the viscous friction; ``lowerDryFrictionLimit`` and
        ``upperDryFrictionLimit``, -Fc - offset and Fc - offset, have Coulomb friction and offset.
        ``rnea`` knows of inertias and armature only; the torque of joints that move is

        ``rnea(q, v, a) + damping v - where(v > 0, lowerDryFrictionLimit, upperDryFrictionLimit)``

        which is that of ``predict``. Friction that depends on load, position, past or, other than
        linearly, on speed is projected on these terms, nearest over the fitted rows: a warning
        states the error. Drives that turn with several joints have no place. Locked joints are
        part of the links that carry them; with mimic joints, or joints in another order than the
        URDF's, ``model.configurations(q)`` and ``model.velocity_map`` lead to Pinocchio's
        coordinates.
        """
        return projected_pinocchio_model(self.model, self.standard, fitted_moments(self))

    def plot_torques(self, *joints: str, recording: Evaluation | None = None) -> Plot:
        """Return charts of measured and identified torque over time, and of the residual.

        Args:
            joints: The joints; all if none is named.
            recording: One of ``fitted`` or ``validation``; None: the first that was kept apart,
                or the first fitted without any.

        Returns:
            Charts that a notebook shows, and that ``.write("torques.html")`` keeps.

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
            Charts that a notebook shows, and that ``.write("friction.html")`` keeps.

        Raises:
            DataError: If there is no such joint, or none that moved.
        """
        names = [self.model.row_names[self._row(joint)] for joint in joints or self.model.joints]
        charts = [(friction_chart(self, name), f"{name}: friction and offset") for name in names]
        shown = tuple((chart, caption) for chart, caption in charts if chart is not None)
        if not shown:
            raise DataError(f"{listed(names)}: no rows used, so there is no friction to show")
        return Plot(f"Friction of {listed(names)} against speed", shown)

    def plot_why(self, joint: str) -> Plot:
        """Return charts of what a joint's torque consists of, and of what its residual follows.

        Args:
            joint: The joint.

        Returns:
            Charts that a notebook shows, and that ``.write("why.html")`` keeps.

        Raises:
            DataError: If there is no such joint.
        """
        torque = joint_torques(self)[self._row(joint)]
        charts = why_charts(torque)
        about = {name: f"residual against {name}" for name in charts}
        about |= {"split": torque.sentence, "power": "mechanical power"}
        shown = tuple((chart, f"{joint}: {about[name]}") for name, chart in charts.items())
        return Plot(f"Why {joint} is predicted as it is", shown)

    def _row(self, joint: str) -> int:
        """Return the number of a joint's torque row."""
        require_kind(joint, str, "joint", "the name of a joint")
        names = self.model.row_names
        if joint not in names:
            raise DataError(
                f"joint {joint!r} is not among those identified: {listed(names)}"
                f"{suggestion(joint, names)}"
            )
        return names.index(joint)

    def save(self, folder: str | Path, *, report: bool = True) -> Path:
        """Write what ``robotid identify`` writes: result.json, report, URDF with its sidecar.

        ``robotid.load_result(folder)``, ``robotid validate`` and ``robotid replay`` read it.
        Every file is made in a folder of its own first and put in place when all are complete.
        A result that cannot be right has no URDF. Logs in files are named, with their hashes;
        how their columns were read by hand (gains, units, names) is not known to it.

        Args:
            folder: Where to write; made if it is missing.
            report: Whether report.html is written.

        Returns:
            Path of the result.json.

        Raises:
            ModelError: If the URDF that the robot was read from is gone.
            SettingsError: If the folder is a file, or cannot be written to.
        """
        from robotid.commands.identify import save_result

        return save_result(self, folder, report=report)

    @property
    def is_consistent(self) -> bool:
        """Whether every body, every drive and the mass matrix are physically possible.

        A body must be so without its links on locked joints, which keep their own inertials; the
        mass matrix must be positive definite at random poses.
        """
        size = self.model.layout.n_inertial
        J = pseudo_inertia(self.standard[:size] - held_parameters(self.model))
        signs = self.standard[self.model.layout.is_nonnegative()]
        is_possible = bool((np.linalg.eigvalsh(J) > 0).all() and (signs >= 0).all())
        return is_possible and self.mass_matrix.is_positive

    @property
    def has_urdf(self) -> bool:
        """Whether a URDF may be written of it: it is possible, and no fault makes it wrong."""
        return self.is_consistent and not self.alarms

    @property
    def mass_matrix(self) -> MassMatrixCheck:
        """The mass matrix of the standard parameters over random poses; ``replace`` keeps it."""
        if not self._checked or self._checked[-1][0] is not self.standard:
            self._checked.append((self.standard, check_mass_matrix(self.model, self.standard)))
        return self._checked[-1][1]

    @property
    def at_bound(self) -> Array:
        """Which drive terms are 0 only since they cannot be negative, shape (p,).

        What they would be without that bound is hidden, so they have no standard error.
        """
        is_bounded = bool(self.estimate.details.get("constraints"))
        is_zero = self.standard <= _AT_BOUND * self.prior_std
        return np.asarray(self.model.layout.is_nonnegative() & is_zero & is_bounded)

    @property
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters, shape (p,), by the prior; inf at bounds."""
        # exact data leave a variance of rounding size, of either sign
        errors = np.sqrt(np.maximum(np.diag(self.standard_covariance), 0.0))
        return np.where(self.at_bound, np.inf, errors)

    @property
    def sources(self) -> tuple[str, ...]:
        """What determined each standard parameter.

        * "data": the motion, which shrinks its plausible spread below 30 %;
        * "prior": nothing, so that the URDF's value stands, within 30 % of that spread;
        * "bound": physics forbids the URDF's value or what the data ask for: a drive term at 0, a
          body held by its extent;
        * "mixed": data and URDF together, in sums with others; or a wish of the user.
        """
        layout, unbounded = self.model.layout, self.errors.unbounded
        after = self.standard_error if unbounded is None else unbounded  # a bound is no source
        share = after / np.maximum(self.prior_std, _KNOWN)
        moved = np.abs(self.standard - self.prior) > _STAYED * self.prior_std
        active = self.estimate.details.get("active", ())
        held = layout.owned_by([label.split(" ", 1)[1] for label in active if " " in label])
        masses = self.estimator.bounds.masses.items()
        known = [f"{link}.m" for link, mass in masses if np.ptp(mass) == 0]
        kept = layout.owned_by(self.estimate.details.get("pinned", ()))
        kept = kept | np.isin(layout.names, known) | ((share > _FROM_PRIOR) & ~moved)
        held = self.at_bound | (held & moved & (share >= _FROM_DATA))
        names = np.select([kept, held, share < _FROM_DATA], ["prior", "bound", "data"], "mixed")
        return tuple(names.tolist())

    @property
    def standard_reach(self) -> Array:
        """How many standard errors the 95 % interval of each standard parameter reaches, (p,).

        The quantile is that of the base parameter, of those it is part of, whose standard error has
        the fewest degrees of freedom.
        """
        own = np.where(self.mapping.K != 0.0, self.errors.reach[:, None], REACH)  # (b, p)
        reach: Array = own.max(axis=0)
        return reach

    @property
    def standard_interval(self) -> Array:
        """95 % interval of each standard parameter, shape (p, 2), by the prior; infinite at bounds.

        It reaches as far as ``standard_reach`` says.
        """
        half = self.standard_reach * self.standard_error
        return np.column_stack([self.standard - half, self.standard + half])

    @property
    def base_interval(self) -> Array:
        """95 % interval of each base parameter, shape (b, 2); infinite where it is open.

        It is open where the data say nothing, and where the parameter is at its bound.
        """
        half = self.errors.reach * self.base_error
        return np.column_stack([self.base - half, self.base + half])

    def band(self, evaluation: Evaluation) -> TorqueBand:
        """Return how far the torques predicted for a recording can be trusted.

        Args:
            evaluation: One of the recordings; of another one, the band has the fit's noise.
        """
        every = zip((*self.fitted, *self.validation), self._bands, strict=True)
        own = next((band for e, band in every if e is evaluation), None)
        return expected_band(self, evaluation) if own is None else own

    @cached_property
    def _bands(self) -> tuple[TorqueBand, ...]:
        return recording_bands(self)

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """Rows of the fitted recordings that the estimate does not explain, the worst first."""
        return find_outliers(self.model, self.fitted, self.standard)

    def metrics(self, name: str = "estimate") -> Metrics:
        """Return the metrics over all fitted recordings.

        Args:
            name: "estimate" or "wls".

        Raises:
            SettingsError: If it is neither.
        """
        if not isinstance(name, str) or name not in ("estimate", "wls"):
            raise SettingsError(f"name is {name!r}, wanted 'estimate' or 'wls'")
        return pool(self.model, self.fitted, name)

    @property
    def refitted(self) -> tuple[Evaluation, ...]:
        """Validation recordings that hold rows which were fitted: they show no prediction."""
        return tuple(e for e in self.validation if e.is_refitted)

    @property
    def is_poorly_excited(self) -> bool:
        """Whether the motion, not the noise, leaves parameters open that a richer one would not."""
        return is_poorly_excited(self.wls, len(self.base))

    @property
    def predictions(self) -> dict[str, Metrics]:
        """Metrics of each validation recording that shows a prediction, by its name."""
        kept = (e for e in self.validation if not e.is_refitted)
        return {e.recording.name: e.metrics["estimate"] for e in kept}

    @cached_property
    def witness(self) -> Witness:
        """Gravity and masses against the URDF's: what speaks for the scale but the sensors."""
        return call_witness(self)

    @cached_property
    def verdict(self) -> Verdict:
        """How far to trust the result."""
        return judge(
            self.metrics(),
            self.predictions,
            undetermined=self.determination.undetermined,
            is_poorly_excited=self.is_poorly_excited,
            is_consistent=self.is_consistent,
            joints=self.model.joints,
            alarms=self.alarms,
            doubts=self.doubts,
            refitted=[e.recording.name for e in self.refitted],
            witness=self.witness,
            is_static=self.model.is_static,
            hidden=hidden_joints(self.model, self.fitted),
        )


def identify(
    model: RobotModel | str | Path,
    logs: Readable | Sequence[Readable],
    *,
    validation: Readable | Sequence[Readable] = (),
    signals: SignalSettings | None = None,
    estimator: EstimatorSettings | str = "consistent",
    friction: str | Mapping[str, str] = AUTO,
    doctor: bool = True,
    ignore: Sequence[str] = (),
    progress: ProgressCallback | None = None,
) -> Identification:
    """Identify a robot's parameters from motion logs, as the command line does.

    Args:
        model: The robot; or the path of its URDF, all of whose joints move.
        logs: Recordings to fit: a ``Log`` that has the model's joints, the path of a file, a
            DataFrame with the columns of such a file, or several of these. Files are read whole,
            as by ``read_log``; ``robotid.run_job`` reads long ones in pieces.
        validation: Recordings kept apart to measure the prediction with, likewise.
        signals: How logs become trajectories; the defaults if None.
        estimator: Name or settings of the estimator.
        friction: What friction joints have beside viscous and Coulomb's, as of
            ``wanted_families``: "auto" has it chosen.
        doctor: Whether the doctor looks at the logs first; the verdict counts what it finds.
        ignore: Codes of errors and doubts that you know better.
        progress: Called as each of ``STAGES`` begins: its name, stages done, in all, "stages"; and
            in between with the name of a work, units done, in all, and what they are.

    Raises:
        DataError: If a log cannot be read, does not fit the model or is too short.
        ModelError: If the model is no model, nor the path of a URDF that can be used.
        RankDeficientError: If "ols" or "wls" is asked for and the data leave parameters open.
        NotConvergedError: If a solver fails.
        SettingsError: If a setting is out of range, or a code to ignore is unknown.
    """
    require_kind(signals, (SignalSettings, type(None)), "signals", "a robotid.SignalSettings")
    require_kind(
        estimator, (str, EstimatorSettings), "estimator", "a name or a robotid.EstimatorSettings"
    )
    require_flag(doctor, "doctor")
    check_ignored(ignore)
    choice = EstimatorSettings(estimator) if isinstance(estimator, str) else estimator
    settings = signals or SignalSettings()
    report_stage(progress, "reading logs")
    model = robot_of(model, logs)
    first, second = (
        read_logs(some, model.joints, prismatic=model.layout.prismatic)
        for some in (logs, validation)
    )
    if not first:
        raise DataError("no log was given; at least one is needed to identify anything")
    fitted, kept = ([hold_log(model, log, settings) for log in some] for some in (first, second))
    report_stage(progress, "checking logs")
    found = diagnose(model, first, second, settings) if doctor else ()
    recordings = Recordings(model, structural_mapping(model), fitted, kept)
    return conclude(recordings, choice, found, ignore, friction=friction, progress=progress)


def robot_of(model: RobotModel | str | Path, logs: object) -> RobotModel:
    """Return the robot that a user gives, read if it is the path of a URDF.

    Args:
        model: The robot; or the path of its URDF, all of whose joints move.
        logs: What is given as the logs, to see whether the two are swapped.

    Raises:
        ModelError: If it is no robot, or the two are swapped.
    """
    if isinstance(model, RobotModel):
        return model
    kind, is_robot = type(model).__name__, isinstance(logs, RobotModel)
    is_path = isinstance(model, str | Path)
    suffixes = [Path(x).suffix.lower() if isinstance(x, str | Path) else "" for x in (model, logs)]
    if is_robot or (suffixes[1] in _ROBOTS and suffixes[0] not in _ROBOTS):
        what = f"the file {Path(str(model)).name}" if is_path else f"a {kind}"
        raise ModelError(
            f"model is {what}, and the robot is given as the logs; wanted the robot first, then "
            "the logs: swap the two"
        )
    if not is_path:
        raise ModelError(f"model is a {kind}, wanted a RobotModel or the path of a URDF")
    return RobotModel.from_urdf(model)


def conclude(
    recordings: Recordings,
    choice: EstimatorSettings,
    found: Sequence[Finding] = (),
    ignore: Sequence[str] = (),
    *,
    friction: str | Mapping[str, str] = AUTO,
    progress: ProgressCallback | None = None,
) -> Identification:
    """Identify a robot's parameters from recordings, in memory or not, and judge the result.

    Args:
        recordings: The recordings.
        choice: Which estimator.
        found: What was found of them before, as by the doctor.
        ignore: Codes of findings that the verdict does not count.
        friction: As of ``identify``.
        progress: As of ``identify``.

    Raises:
        DataError: If a row of a log cannot be used.
        RankDeficientError, NotConvergedError: As of ``identify``.
    """
    model, is_robust = recordings.model, choice.is_robust
    wanted = wanted_families(friction, model.joints)
    if model.is_static and any(wanted.values()):
        raise SettingsError(
            "dynamics is 'static', which has friction 'none' or 'viscous+coulomb' (without the "
            "viscous), but more is stated; leave it out, or set dynamics = 'full'"
        )
    report_stage(progress, "fitting")
    with _explained(found):
        balanced = counterbalanced(found, [log.head.name for log in recordings.fitted])
        fit = with_drives(recordings, choice, wanted, balanced, progress=progress)
    report_stage(progress, "errors and intervals")
    sample = take_sample(fit)
    misfits, discrepancies = explain_residual(fit, sample)
    fit = with_model_error(fit, sample, misfits)
    # what the motion excites the fit tells from all rows: finding "undetermined"
    told = [f for f in found if f.severity != "note" and f.code != "excitation"]
    told = settled(with_known_springs(told, fit), fit_findings(fit, discrepancies))
    told = refuted(told, fit.predictions, fit.witness)
    alarms = alarming(told, ignore, is_robust=is_robust)
    heads = [log.head for log in (*recordings.fitted, *recordings.kept)]
    findings = [*log_findings(heads), *impossible_inertials(model), *told, *unwritten(fit, alarms)]
    counted = [finding for finding in findings if finding.code not in ignore]
    names = [Path(e.recording.log.path).name for e in fit.validation if not e.is_refitted]
    return replace(
        fit,
        findings=tuple(findings),
        alarms=tuple(finding.message for finding in alarms),
        doubts=doubts_of(counted, model.joints, names, is_robust=is_robust),
        asked=Asked(recordings.fitted[0].asked, friction, tuple(ignore)),
    )


@contextmanager
def _explained(found: Sequence[Finding]) -> Iterator[None]:
    """Add what the doctor found to the error of a fit that fails."""
    try:
        yield
    except (DataError, NotConvergedError, RankDeficientError) as error:
        for finding in found:
            if finding.severity != "note" and finding.message != str(error):
                error.add_note(f"doctor: {finding.severity}: {finding.code}: {finding.message}")
        raise


def with_drives(
    recordings: Recordings,
    choice: EstimatorSettings,
    wanted: Mapping[str, Sequence[str] | None],
    balanced: Mapping[str, str] | None = None,
    *,
    progress: ProgressCallback | None = None,
) -> Identification:
    """Identify a robot's parameters, and the friction of its joints that the logs show.

    Args:
        recordings: The recordings.
        choice: Which estimator.
        wanted: Friction of each joint, as of ``wanted_families``.
        balanced: As of ``choose_drives``.
        progress: Called with "fits", those done, those in all as far as is known, and "fits".

    Raises:
        DataError, RankDeficientError, NotConvergedError: As of ``identify``.
    """
    report = progress or ignore_progress
    report("fits", 0, 1, "fits")
    fit = _fitted(recordings, choice)
    drives = choose_drives(fit, wanted, balanced)
    if not any(drive.terms for drive in drives):
        return replace(fit, drives=drives)
    rough = _rough(choice)
    most = _MOST_SHAPES if any(drive.shapes for drive in drives) else 0
    for done in range(most):
        report("fits", 1 + done, 2 + most, "fits")
        found = _fitted(_with_own(recordings, fit, drives), rough, is_last=False)
        moved = settled_shapes(replace(found, drives=drives))
        if moved is None:
            break
        drives = moved
    report("fits", 1 + most, 2 + most, "fits")
    return replace(_fitted(_with_own(recordings, fit, drives), choice), drives=drives)


def _with_own(
    recordings: Recordings, fit: Identification, drives: Sequence[DriveChoice]
) -> Recordings:
    """Return recordings of the robot whose drives have the terms chosen, loaded as a fit says."""
    plain, own = recordings.model, {drive.joint: drive.terms for drive in drives}
    model = plain.with_terms(
        {d.name: (*plain.layout.own.get(d.name, ()), *own.get(d.name, ()))
         for d in plain.layout.drives}
    )  # fmt: skip
    known = dict(zip(fit.mapping.names, fit.standard, strict=True))
    start = np.array([known.get(name, 0.0) for name in model.layout.names])
    return recordings.with_model(model.with_reference(start))


def _rough(choice: EstimatorSettings) -> EstimatorSettings:
    """Return the estimator without what takes long and moves an estimate little."""
    if not isinstance(choice, BoundedSettings):
        return choice
    weight = 1.0 if isinstance(choice.prior_weight, str) else choice.prior_weight
    return replace(choice, prior_weight=weight, draws=0)


def _fitted(
    recordings: Recordings, choice: EstimatorSettings, *, is_last: bool = True
) -> Identification:
    """Identify a robot's parameters from recordings; in between with the noise of the regressor."""
    recordings = _under_own_load(recordings, choice)
    model, mapping = recordings.model, recordings.mapping
    ground = _ground(recordings, choice)
    if is_last:
        ground = _without_regressor_noise(ground, choice)
    prior, spread = ground.before.pi, ground.before.spread
    estimate, wls, errors = _measured(ground, choice)
    standard, covariance = standard_of(estimate, mapping, prior, spread)
    base_variance = np.einsum("bi,ij,bj->b", mapping.K, covariance, mapping.K)
    if model.layout.remembering:  # what is written predicts the torque by its own load
        model = model.with_reference(standard)
        recordings = recordings.with_model(model)
    candidates = {"estimate": standard, "wls": mapping.to_standard(wls.theta, prior, spread)}
    sigma = ground.before.sigma
    driven = urdf_with_drives(model, mapping, ground.factors, sigma, ground.before.spread)
    fitted, kept = evaluate_logs(
        recordings.fitted, recordings.kept, candidates, prior, driven, plan=recordings.plan
    )
    is_base = estimate.names == mapping.base_names
    base_error = estimate.std_error if is_base else np.sqrt(np.maximum(base_variance, 0.0))
    found = Identification(
        model=model,
        mapping=mapping,
        estimator=choice,
        estimate=estimate,
        wls=wls,
        prior=prior,
        urdf_with_drives=driven,
        prior_std=spread if estimate.prior_std is None else estimate.prior_std,
        standard=standard,
        standard_covariance=covariance,
        base=mapping.to_base(standard),
        base_error=base_error,
        fitted=fitted,
        validation=kept,
        errors=errors,
        factors=ground.factors,
        determination=ground.determination,
        regressor_noise=ground.noise,
    )
    hidden = (mapping.K[:, ~found.at_bound] == 0).all(axis=1)  # nothing but terms at their bounds
    return replace(found, base_error=np.where(hidden, np.inf, base_error))


def _under_own_load(recordings: Recordings, choice: EstimatorSettings) -> Recordings:
    """Return recordings whose drives are loaded by the bodies that the fit to them gives.

    Least squares are iterated until their torque is the load; the estimator takes the last step.
    """
    model, mapping = recordings.model, recordings.mapping
    if not model.layout.remembering:
        return recordings
    choice = _rough(choice)
    for step in range(_MOST_LOADS):
        ground = _ground(recordings, choice)
        before = ground.before
        standard, _ = standard_of(ground.rough, mapping, before.pi, before.spread)
        moved = standard - recordings.model.carried_by
        if step >= _DAMPED:  # friction that takes a large share of the load may overshoot
            standard = standard - 0.5 * moved
        recordings = recordings.with_model(model.with_reference(standard))
        loads = [_size_of(ground, x) for x in (moved, standard)]
        if (loads[0] <= _SETTLED * loads[1]).all():
            estimator = make_estimator(choice, model, mapping, before)
            if estimator.reads == "factors":
                estimate = estimator.fit(ground.factors)
                standard, _ = standard_of(estimate, mapping, before.pi, before.spread)
            return recordings.with_model(model.with_reference(standard))
    raise NotConvergedError(
        f"the load of the gears still changes after {_MOST_LOADS} fits; use friction = "
        "'viscous+coulomb', or record motion that determines more",
        "max_iterations",
    )


def _size_of(ground: "_Ground", pi: Array) -> Array:
    """Return the root mean square of the torque of parameters in each row, shape (n_rows,)."""
    factors, mapping = ground.factors, ground.recordings.mapping
    beta = mapping.to_base(pi)
    rows = zip(factors.triangles, factors.columns, strict=True)
    return np.array([float(np.linalg.norm(R[:, :-1] @ beta[own])) for R, own in rows])


@dataclass(frozen=True, eq=False)
class _Ground:
    """What every estimator stands on."""

    recordings: Recordings  # their rows weighted if a robust loss was asked for
    whole: Reduction  # what all fitted rows come down to, base parameters
    before: Known  # without them, and how they are cut into stretches
    rough: Estimate  # weighted least squares on them
    determination: Determination  # which base parameters they determine
    grown: float  # by how much a robust loss widens the covariance [-]
    noise: RegressorNoise | None = None  # what the steps of the positions do

    @property
    def factors(self) -> Factors:
        """The factors of all fitted rows."""
        return self.whole.factors


def _ground(recordings: Recordings, choice: EstimatorSettings) -> _Ground:
    """Reduce the rows, with a robust loss reweighted, to what every estimator stands on."""
    model, mapping = recordings.model, recordings.mapping
    prior = model.standard_parameters()
    reductions, grown = recordings.reduce(), 1.0
    if choice.is_robust:
        recordings, reductions, understated = reweigh(recordings, reductions, choice.loss, prior)
        grown = understated**2
    reduction = join(reductions)
    stretches = tuple(part.factors for part in reductions if part.factors.rows.any())
    factors, share = reduction.factors, recordings.share
    spread = prior_spread(model, reduction.squares, reduction.samples)
    rough = WLS(prior=mapping.to_base(prior), independent_share=share).fit(factors)
    before = Known(prior, spread, share, rough.sigma, stretches)
    known = model.layout.owned_by(choice.bounds.pinned)
    rows = factors.weighted(rough.sigma / np.sqrt(share))[:, :-1]
    determination = determine(factors.names, rows, base_spread(mapping.K, spread, known))
    return _Ground(recordings, reduction, before, rough, determination, grown)


def _without_regressor_noise(ground: _Ground, choice: EstimatorSettings) -> _Ground:
    """Return the ground without the bias that the steps of the positions make.

    The torque loses what least squares find of it by that bias, W shift, so that every fit to the
    factors finds as much less. Estimators that read samples keep the bias as an error. Total least
    squares have a correction of their own.
    """
    if isinstance(choice, TLSSettings):
        return ground
    level, theta = ground.rough.sigma, ground.rough.theta
    sigma = np.ones_like(level) if isinstance(choice, OLSSettings) else level
    noise = find_regressor_noise(ground.recordings, ground.whole, theta, sigma, level)
    if noise is None:
        return ground
    if isinstance(choice, RecursiveSettings):
        noise = noise.uncorrected(ground.factors.information(1.0 / sigma**2))
        return replace(ground, noise=noise)
    stretches = tuple(part.without(noise.shift) for part in ground.before.stretches)
    return replace(
        ground,
        whole=replace(ground.whole, factors=ground.factors.without(noise.shift)),
        before=replace(ground.before, stretches=stretches),
        rough=replace(ground.rough, theta=theta - noise.shift),
        noise=noise,
    )


def _measured(
    ground: _Ground, choice: EstimatorSettings
) -> tuple[Estimate, Estimate, StandardErrors]:
    """Return the estimate and that of WLS with measured standard errors, and their ground."""
    factors, rough, mapping = ground.factors, ground.rough, ground.recordings.mapping
    try:
        estimate, fit, weighing = _run(choice, ground)
    except RankDeficientError as error:
        raise ground.determination.refusal(error) from error
    stretches, share, K = ground.before.stretches, ground.before.share, mapping.K
    more = None if ground.noise is None else ground.noise.meat
    of_wls = more if weighing != "alike" else None  # which is of other weights
    wls, errors = measured_errors(rough, stretches, factors, share, K, rough.sigma, more=of_wls)
    if weighing == "by step" and fit is None:
        estimate = with_wls_errors(estimate, wls)
    else:
        sigma = np.ones_like(rough.sigma) if weighing == "alike" else rough.sigma
        if estimate.names == mapping.names:
            sigma = estimate.sigma
        redraws, pull = None, 1.0  # of what no bound can bind
        if fit is not None and isinstance(choice, BoundedSettings):
            redraws, pull = Redraws(fit, choice.draws, np.random.default_rng(0)), fit.pull
        is_filter = weighing == "by age"
        estimate, errors = measured_errors(
            estimate, stretches, factors, share, K, sigma,
            is_filter=is_filter, pull=pull, redraws=redraws, more=more,
        )  # fmt: skip
    if ground.grown != 1.0:
        estimate = replace(estimate, covariance=ground.grown * estimate.covariance)
        wls = replace(wls, covariance=ground.grown * wls.covariance)
    return estimate, wls, errors


def _run(
    choice: EstimatorSettings, ground: _Ground
) -> tuple[Estimate, Consistent | None, Weighing]:
    """Return the estimate, what made it physically consistent if it is, and how rows weighed."""
    recordings, before = ground.recordings, ground.before
    model, mapping = recordings.model, recordings.mapping
    estimator = make_estimator(choice, model, mapping, before)
    if model.is_static and estimator.needs_mass:
        raise SettingsError(
            f"the estimator {choice.name!r} needs the mass matrix, which dynamics = 'static' does "
            "not identify; choose another one, or dynamics = 'full'"
        )
    if estimator.reads == "factors":
        return estimator.fit(ground.factors), estimator.in_cone, estimator.weighing
    estimate = estimator.fit(recordings.problem(with_mass=estimator.needs_mass))
    if not (isinstance(choice, RecursiveSettings) and choice.physical):
        return estimate, None, estimator.weighing
    if estimator.weighing == "by step":
        estimate = with_wls_errors(estimate, ground.rough)
    fit = consistent_fit(choice, model, mapping, before)
    return fit.project(estimate), fit, estimator.weighing
