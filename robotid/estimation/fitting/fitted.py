"""The result of a fit: identified parameters, their intervals, predictions and bands."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.settings import is_number, require_kind
from robotid.base.tolerances import TINY
from robotid.base.typing import Array, real_numbers
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.dynamics.friction_projection import (
    DriveMoments,
    drive_moments,
    projected_pinocchio_model,
)
from robotid.dynamics.torque import drive_motion_along, predict_instants
from robotid.estimation.estimators import Estimate
from robotid.estimation.estimators.determination import Determination, is_poorly_excited
from robotid.estimation.fitting.drive_terms import DriveChoice, JointMotion, OpenTerm, open_torques
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import Evaluation, Metrics, pool
from robotid.estimation.fitting.regressor_noise import RegressorNoise
from robotid.estimation.fitting.robust import Outlier, find_outliers
from robotid.estimation.fitting.standard_errors import (
    QUANTILE,
    FrictionCurve,
    StandardErrors,
    TorqueBand,
    rms_error,
    torque_band,
)
from robotid.estimation.variation.groups import RunsOf, RunSums
from robotid.estimation.variation.variation import Variation, between_covariance
from robotid.robot.bodies import held_parameters
from robotid.robot.drive_term import DriveMotion
from robotid.robot.mass_matrix import MassMatrixCheck, check_mass_matrix
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

SOURCES = ("data", "mixed", "prior", "bound")  # of the value of a standard parameter
#: Standard error over prior standard deviation below which the source is the data (a change above
#: it does not come from the prior alone), and above which it is the prior.
FROM_DATA, FROM_PRIOR = 0.3, 0.9
CLEARLY = 1.2  # ratio of the errors of two fits above which one is clearly worse
_SPEEDS = 20  # points of a friction curve in each direction


def sources_of(share: Array, is_prior: Array, is_bound: Array) -> tuple[str, ...]:
    """Return the source of the value of each parameter, of ``SOURCES``; arguments (p,)."""
    names = np.select([is_prior, is_bound, share < FROM_DATA], ["prior", "bound", "data"], "mixed")
    return tuple(names.tolist())


@dataclass(frozen=True, eq=False)
class Identified(ABC):
    """Standard and base parameters of a robot, for every method of identification."""

    model: RobotModel  # the robot of the URDF, with the identified drive terms
    mapping: BaseMapping  # standard to base parameters
    prior: Array  # (p,), standard parameters of the URDF
    standard: Array  # (p,), standard parameters
    standard_covariance: Array  # (p, p), their covariance given the prior
    base: Array  # (b,), base parameters
    base_error: Array  # (b,), their standard errors; inf if not identifiable

    @property
    @abstractmethod
    def standard_error(self) -> Array: ...  # (p,), of the standard parameters; inf if there is none

    @property
    @abstractmethod
    def standard_quantile(self) -> Array: ...  # (p,), half-width of 95 % intervals [std errors]

    @property
    @abstractmethod
    def base_quantile(self) -> Array:
        """Half-width of each base parameter's 95 % interval in standard errors, shape (b,)."""

    @property
    @abstractmethod
    def at_bound(self) -> Array:
        """Which standard parameters are determined by a bound only, shape (p,), bool."""

    @property
    @abstractmethod
    def sources(self) -> tuple[str, ...]: ...  # of the value of each standard parameter

    @property
    @abstractmethod
    def undetermined(self) -> tuple[str, ...]: ...  # names of parameters that are not identifiable

    @property
    @abstractmethod
    def moments(self) -> Mapping[str, DriveMoments]: ...  # that project each drive's friction

    @property
    @abstractmethod
    def is_consistent(self) -> bool: ...  # physically

    @property
    def standard_interval(self) -> Array:
        """95 % interval of each standard parameter, shape (p, 2); infinite if there is none."""
        # of a consistent fit, none contains a negative mass, moment of inertia or friction
        half = self.standard_quantile * self.standard_error
        low = self.standard - half
        if self.is_consistent:
            is_size = [x.endswith((".m", ".Ixx", ".Iyy", ".Izz")) for x in self.model.layout.names]
            bounded = np.isfinite(half) & (is_size | self.model.layout.is_nonnegative())
            low = np.where(bounded, np.maximum(low, 0.0), low)
        return np.column_stack([low, self.standard + half])

    @property
    def base_interval(self) -> Array:
        """95 % interval of each base parameter, shape (b, 2); infinite if there is none."""
        half = self.base_quantile * self.base_error
        return np.column_stack([self.base - half, self.base + half])

    def predict(
        self, q: ArrayLike, v: ArrayLike | None = None, a: ArrayLike | None = None
    ) -> Array:
        """Return the torques of a motion by the identified bodies, drives and friction.

        Coulomb friction acts by the sign of the speed; at rest, where stiction can have any value
        up to its size, it is 0. Friction with an internal state (presliding) has its value after
        long motion in one direction. A delayed torque (lag) has its steady-state value.

        Args:
            q: Positions in the order of ``model.joints``, shape (n,) or (N, n) [rad, m].
            v: Velocities, likewise [rad/s, m/s]; None: at rest.
            a: Accelerations, likewise [rad/s^2, m/s^2]; None: 0.

        Returns:
            Torques, likewise [N m, N].

        Raises:
            DataError: If a shape is wrong, or a value is not finite.
        """
        return predict_instants(self.model, self.standard, q, v, a)

    def pinocchio_model(self) -> Any:  # noqa: ANN401
        """Return a ``pinocchio.Model`` with the identified inertias, armature and friction.

        ``damping`` is the viscous friction; ``lowerDryFrictionLimit`` = -Fc - offset and
        ``upperDryFrictionLimit`` = Fc - offset contain Coulomb friction and offset. ``rnea``
        computes inertias and armature only; the torque of moving joints is

        ``rnea(q, v, a) + damping v - where(v > 0, lowerDryFrictionLimit, upperDryFrictionLimit)``

        which equals ``predict``. Friction that depends on load, position, an internal state or,
        nonlinearly, on speed is projected on these terms by least squares over the fitted rows; a
        warning states the error. Drives coupled to several joints are not represented. Locked
        joints are part of their parent links. With mimic joints, or joints in another order than
        in the URDF, ``model.configurations(q)`` and ``model.velocity_map`` give Pinocchio's
        coordinates.
        """
        return projected_pinocchio_model(self.model, self.standard, self.moments)


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """Parameters of a robot fitted to recordings, without standard errors."""

    model: RobotModel  # the robot of the URDF
    mapping: BaseMapping  # standard to base parameters
    prior_std: Array  # (p,), prior standard deviations of the standard parameters
    standard: Array  # (p,), standard parameters
    fitted: tuple[Evaluation, ...]  # the fitted recordings
    validation: tuple[Evaluation, ...]  # the validation recordings
    drives: tuple[DriveChoice, ...] = ()  # friction terms of the joints, and those tried


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Identified, Solution):
    """Parameters of a robot fitted to recordings, without findings and verdict.

    Its recordings have the predictions "estimate" and "wls".
    """

    estimator: EstimatorSettings  # the estimator's settings
    estimate: Estimate  # result of the estimator: base parameters, or standard ones ("consistent")
    wls: Estimate  # weighted least squares on the same factors, base parameters
    urdf_with_drives: Array  # (p,), the prior with fitted drive terms
    errors: StandardErrors  # method and degrees of freedom of the standard errors
    factors: Factors  # triangular factors of the fitted rows, base parameters
    determination: Determination  # which base parameters the fitted rows determine
    open_terms: tuple[OpenTerm, ...] = ()  # uncertain terms, in the covariance
    repeated: Array | float = 0.0  # (p, p), covariance due to errors that the residual has
    regressor_noise: RegressorNoise | None = None  # of position quantisation; or negligible
    runs: tuple[RunsOf, ...] = ()  # information of three or more logs on varying parameters
    sums: RunSums | None = None  # sums over their rows from which it is computed
    left_out: Mapping[str, Metrics] = field(default_factory=dict)  # by log, of fits to the others
    variation: Variation | None = None  # variation of the drives' parameters between these logs
    _checked: list[tuple[Array, MassMatrixCheck]] = field(default_factory=list, repr=False)

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
            v: Speeds, shape (k,) [rad/s or m/s]; None: 20 in each direction, from the slowest to
                the fastest speed of the fitted rows.
            q: Position, for friction that depends on it [rad or m]; None: the median.
            load: Joint load torque, for friction that depends on it [N m or N]; None: its RMS in
                the fitted logs.

        Returns:
            The curve: ``v``, ``torque``, ``std``, ``half_width`` of the 95 % band, ``load``.

        Raises:
            DataError: If there is no such drive, or no speeds are given and the drive was at rest.
        """
        layout, d = self.model.layout, _drive_number(self, joint)
        ratios, n = layout.drive_ratios[d], len(self.model.joints)
        is_used = [e.recording.mask[:, -n:][:, ratios != 0.0].all(axis=1) for e in self.fitted]
        rows, motions = np.concatenate(is_used), [e.recording.trajectory for e in self.fitted]
        for name, value in (("q", q), ("load", load)):
            if not (value is None or is_number(value)):
                raise DataError(f"{name} is {str(value)[:60]!r}, expected a finite number or None")
        if v is None:
            speeds = np.abs(np.concatenate([m.v[:, -n:] for m in motions])[rows] @ ratios)
            if not speeds.any():
                raise DataError(
                    f"{joint} was at rest in the fitted logs, so the range of speeds is not known; "
                    "give the speeds: friction(joint, v)"
                )
            side = np.linspace(speeds.min(), speeds.max(), _SPEEDS)
            v = np.append(-side[::-1], side)
        if q is None:  # without the pose of the base
            positions = np.concatenate([m.q[:, -n:] for m in motions])[rows] @ ratios
            q = float(np.median(positions)) if len(positions) else 0.0
        if load is None:
            load = 0.0
            if any(term.name == "load" for term in layout.own.get(joint, ())):
                loads = [drive_motion_along(self.model, m).load[d] for m in motions]
                load = float(np.sqrt(np.mean(np.concatenate(loads)[rows] ** 2)))
        speeds = real_numbers(v, "v")
        if speeds.ndim != 1 or not np.isfinite(speeds).all():
            raise DataError(f"v has shape {speeds.shape}, expected finite speeds, shape (k,)")
        return friction_curve(self, joint, speeds, q=q, load=load)

    @cached_property
    def is_consistent(self) -> bool:
        """Whether bodies (without links on locked joints), drives and mass matrix are physical."""
        layout = self.model.layout
        J = pseudo_inertia(self.standard[: layout.n_inertial] - held_parameters(self.model))
        are_bodies = bool((np.linalg.eigvalsh(J) > 0).all())
        are_drives = bool((self.standard[layout.is_nonnegative()] >= 0).all())
        return are_bodies and are_drives and self.mass_matrix.is_positive

    @property
    def mass_matrix(self) -> MassMatrixCheck:
        """Check of the mass matrix of the standard parameters at random poses."""
        if not self._checked or self._checked[-1][0] is not self.standard:
            self._checked.append((self.standard, check_mass_matrix(self.model, self.standard)))
        return self._checked[-1][1]

    @cached_property
    def at_bound(self) -> Array:
        """Which drive terms are at their bound of 0 and have no standard error, shape (p,)."""
        is_bounded = bool(self.estimate.details.get("constraints"))
        is_zero = self.standard <= TINY * self.prior_std
        return np.asarray(self.model.layout.is_nonnegative() & is_zero & is_bounded)

    @property
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters given the prior, shape (p,); inf at bounds."""
        # noise-free data give a variance of rounding size, of either sign
        errors = np.sqrt(np.maximum(np.diag(self.standard_covariance), 0.0))
        return np.where(self.at_bound, np.inf, errors)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The source of the value of each standard parameter.

        * "data": the data; the standard error is below 30 % of the prior standard deviation;
        * "prior": the URDF; the data do not determine the parameter, and it changed by less than
          30 % of the prior standard deviation;
        * "bound": a bound of physical consistency, as a drive term at 0 or a body at its extent;
        * "mixed": data and URDF together, in sums with other parameters, or a setting of the user.
        """
        layout, unbounded = self.model.layout, self.errors.unbounded
        error = self.standard_error if unbounded is None else unbounded
        is_free = self.prior_std > 0.0
        of_fixed = np.where(error > 0.0, np.inf, 0.0)
        share = np.divide(error, self.prior_std, out=of_fixed, where=is_free)
        is_moved = np.abs(self.standard - self.prior) > FROM_DATA * self.prior_std
        details, masses = self.estimate.details, self.estimator.bounds.masses.items()
        fixed = [f"{link}.m" for link, mass in masses if np.ptp(mass) == 0]
        is_prior = layout.owned_by(details.get("pinned", ())) | np.isin(layout.names, fixed)
        is_prior |= (share > FROM_PRIOR) & ~is_moved
        bounded = [x.split(" ", 1)[1] for x in details.get("active", ()) if " " in x]
        is_bound = layout.owned_by(bounded) & is_moved & (share >= FROM_DATA)
        return sources_of(share, is_prior, self.at_bound | is_bound)

    @property
    def standard_quantile(self) -> Array:
        """Half-width of 95 % intervals, the largest of the base parameters, [std errors] (p,)."""
        quantile = np.where(self.mapping.K != 0.0, self.errors.quantile[:, None], QUANTILE)
        return np.asarray(quantile.max(axis=0))

    @property
    def base_quantile(self) -> Array:
        return self.errors.quantile

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Base parameters that the data do not determine by themselves."""
        return self.determination.undetermined

    @cached_property
    def moments(self) -> dict[str, DriveMoments]:
        """Moments that project drive friction on simpler terms, from the fitted rows, by drive."""
        rows = ((e.recording.trajectory, e.recording.mask) for e in self.fitted)
        return drive_moments(self.model, rows)

    def band(self, evaluation: Evaluation) -> TorqueBand:
        """Return the uncertainty band of the torques predicted for a recording.

        Args:
            evaluation: A recording; if it is not one of this fit, the band has the fit's noise,
                and the spread of the drives between three or more fitted logs.
        """
        require_kind(evaluation, Evaluation, "evaluation", "an evaluation of recordings")
        for known, band in zip((*self.fitted, *self.validation), self._bands, strict=True):
            if known is evaluation:
                return band
        return expected_band(self, evaluation, self.between)

    @cached_property
    def between(self) -> Array | None:
        """What another log adds to the parameters' covariance, (p, p); None for under 3 logs."""
        if self.variation is None:
            return None
        return between_covariance(self.variation.to_dict(), self.model.layout.names)

    @cached_property
    def _bands(self) -> tuple[TorqueBand, ...]:
        """The torque band of each recording from its residuals, fitted recordings first.

        They contain 95 % of the torques of all recordings of a kind, and those of validation cover
        further motions likewise (split conformal prediction, Lei et al. 2018,
        doi:10.1080/01621459.2017.1307116, with the parameters' part as the lower bound).
        """
        evaluations = (*self.fitted, *self.validation)
        is_fitted = [k < len(self.fitted) or e.is_refitted for k, e in enumerate(evaluations)]
        bands = [
            expected_band(self, e, None if is_own else self.between)
            for e, is_own in zip(evaluations, is_fitted, strict=True)
        ]
        noise = {}
        for kind in set(is_fitted):
            alike = [k for k, is_own in enumerate(is_fitted) if is_own == kind]
            parts = [bands[k] for k in alike], [evaluations[k] for k in alike]
            noise[kind] = _residual_noise(*parts)
        pairs = zip(bands, is_fitted, strict=True)
        return tuple(replace(band, noise=noise[kind]) for band, kind in pairs)

    @cached_property
    def outliers(self) -> tuple[Outlier, ...]:
        """Rows of the fitted recordings with very large residuals, the largest first."""
        return find_outliers(self.model, self.fitted, self.standard)

    def metrics(self, name: str = "estimate") -> Metrics:
        """Return the metrics over all fitted recordings.

        Args:
            name: "estimate" or "wls".

        Raises:
            SettingsError: If it is another name.
        """
        if not isinstance(name, str) or name not in ("estimate", "wls"):
            raise SettingsError(f"name is {name!r}, expected 'estimate' or 'wls'")
        return pool(self.model, self.fitted, name)

    @property
    def refitted(self) -> tuple[Evaluation, ...]:
        """Validation recordings that contain fitted rows: they do not test the prediction."""
        return tuple(e for e in self.validation if e.is_refitted)

    @property
    def _unseen(self) -> tuple[Evaluation, ...]:
        """Validation recordings without fitted rows."""
        return tuple(e for e in self.validation if not e.is_refitted)

    @property
    def is_poorly_excited(self) -> bool:
        """Whether parameters are not identifiable because of too little excitation, not noise."""
        return is_poorly_excited(self.wls, len(self.base))

    @property
    def predictions(self) -> dict[str, Metrics]:
        """Metrics of validation recordings without fitted rows, else of those left out, by name."""
        if not self.validation:
            return dict(self.left_out)
        return {e.name: e.metrics["estimate"] for e in self._unseen}

    @cached_property
    def overfitted(self) -> frozenset[str]:
        """Joints of which WLS predicts every unseen recording clearly worse than the estimate."""
        pairs = [[e.metrics[x].per_joint for x in ("estimate", "wls")] for e in self._unseen]
        return frozenset(
            joint
            for joint in (pairs[0][0] if pairs else ())
            if all(wls[joint].rmse > CLEARLY * estimate[joint].rmse for estimate, wls in pairs)
        )


def expected_band(fit: Fit, evaluation: Evaluation, between: Array | None = None) -> TorqueBand:
    """Return the torque band of a recording by the noise level of the fit; between (p, p)."""
    K, recording = fit.mapping.K, evaluation.recording
    moves = np.array([term.moves for term in fit.open_terms]).reshape(-1, K.shape[1])
    C = fit.standard_covariance - fit.repeated - moves.T @ moves
    covariance = K @ (C if between is None else C + between) @ K.T

    def errors(rows: Array) -> list[tuple[Array, Array]]:
        model = fit.model.with_reference(fit.standard)
        torques = open_torques(model, fit.open_terms, recording, rows)
        return list(zip(moves @ K.T, torques, strict=True))

    sigma, basis = fit.estimate.sigma, recording.trajectory.basis
    if basis is not None:  # noise that unknown forces can cause is no part of the rows
        left, used = 1.0 - np.sum(basis**2, axis=2), recording.mask
        sigma = sigma * np.sqrt(np.sum(left, axis=0, where=used) / np.maximum(used.sum(axis=0), 1))
    return torque_band(fit.model, fit.mapping, recording.trajectory, covariance, sigma, errors)


def next_errors(fit: Fit) -> Array:
    """Return the expected RMS torque error of a log like the fitted ones, (n_rows,) [N m, N]."""
    return rms_error([expected_band(fit, evaluation, fit.between) for evaluation in fit.fitted])


def _residual_noise(bands: Sequence[TorqueBand], evaluations: Sequence[Evaluation]) -> Array:
    """Return the noise with which bands contain 95 % of the torques, shape (n_rows,) [N m, N]."""
    noise, parts = bands[0].noise.copy(), []
    for band, e in zip(bands, evaluations, strict=True):
        residual = (e.recording.trajectory.tau - e.torques["estimate"])[band.samples]
        needed = (residual / QUANTILE) ** 2 - band.parameters**2
        parts.append(np.where(e.recording.mask[band.samples], needed, np.nan))
    variance = np.concatenate(parts)
    for j in np.flatnonzero(np.isfinite(variance).any(axis=0)):
        noise[j] = np.sqrt(max(np.nanquantile(variance[:, j], 0.95), 0.0))
    return noise


def friction_curve(
    fit: Fit, joint: str, v: Array, *, q: float = 0.0, load: float = 0.0
) -> FrictionCurve:
    """Return friction and offset against the speed v (k,), after long motion in one direction."""
    layout, d = fit.model.layout, _drive_number(fit, joint)
    none = np.zeros_like(v)
    motion = DriveMotion(q + none, v, none, np.sign(v), load + none, none)
    drive_terms = enumerate(layout.drive_parameters, start=layout.n_inertial)
    terms = {k: x for k, (drive, x) in drive_terms if drive == d and not x.is_inertia}
    places = list(terms)
    X = np.array([term.column(motion) for term in terms.values()]).reshape(len(terms), len(v)).T
    moves = np.array([term.moves[places] for term in fit.open_terms]).reshape(-1, len(places))
    C = fit.standard_covariance[np.ix_(places, places)] - moves.T @ moves
    variance = np.einsum("ij,jk,ik->i", X, C, X)
    for term, moved in zip(fit.open_terms, moves @ X.T, strict=True):
        if term.joint == joint:  # the term's own torque adds to the change of the parameters
            moved = moved + term.torque(motion, JointMotion.steady(motion))
        variance += moved**2
    return FrictionCurve(v, X @ fit.standard[places], np.sqrt(np.maximum(variance, 0.0)), load)


def _drive_number(fit: Fit, joint: str) -> int:
    require_kind(joint, str, "joint", "the name of a joint or of a coupling")
    names = [drive.name for drive in fit.model.layout.drives]
    if joint not in names:
        raise DataError(
            f"{joint!r} is no drive of {fit.model.name}; drives: {listed(names)}"
            f"{suggestion(joint, names)}"
        )
    return names.index(joint)
