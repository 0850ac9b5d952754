"""The result of a fit: identified parameters, their intervals, predictions and bands."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import is_number, require_kind
from robotid.base.typing import Array, real_numbers
from robotid.data.log import suggestion
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.dynamics.friction_projection import (
    DriveMoments,
    drive_moments,
    projected_pinocchio_model,
)
from robotid.dynamics.prediction import drive_motion_along, predict_instants
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

#: The possible sources of the value of a standard parameter.
SOURCES = ("data", "mixed", "prior", "bound")
FROM_DATA = 0.3  # standard error over prior standard deviation below which the source is the data
FROM_PRIOR = 0.9  # ... and above which it is the prior
_KNOWN = 1e-300  # smallest prior standard deviation, of fixed parameters
_STAYED = 0.3  # change in prior standard deviations up to which the source may be the prior
_WORSE = 1.2  # error of WLS over that of the estimate above which it is clearly worse
_AT_BOUND = 1e-6  # size of a drive term at its bound of 0, in prior standard deviations
_COVERAGE = 0.95
_SPEEDS = 20  # points of a friction curve in each direction


def sources_of(share: Array, is_prior: Array, is_bound: Array) -> tuple[str, ...]:
    """Return the source of the value of each parameter, of ``SOURCES``.

    share (p,) [-], is_prior (p,), is_bound (p,).
    """
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
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters, shape (p,); inf if there is none."""

    @property
    @abstractmethod
    def standard_quantile(self) -> Array:
        """Half-width of each standard parameter's 95 % interval in standard errors, shape (p,)."""

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
    def sources(self) -> tuple[str, ...]:
        """The source of the value of each standard parameter, of ``SOURCES``."""

    @property
    @abstractmethod
    def undetermined(self) -> tuple[str, ...]:
        """Names of the base parameters that are not identifiable."""

    @property
    @abstractmethod
    def moments(self) -> Mapping[str, DriveMoments]:
        """Moments that project the friction of each drive on simpler terms, by drive."""

    @property
    @abstractmethod
    def is_consistent(self) -> bool:
        """Whether the parameters are physically consistent."""

    @property
    def standard_interval(self) -> Array:
        """95 % interval of each standard parameter, shape (p, 2); infinite if there is none.

        Its half-width is ``standard_quantile`` standard errors.
        """
        half = self.standard_quantile * self.standard_error
        return np.column_stack([self.standard - half, self.standard + half])

    @property
    def base_interval(self) -> Array:
        """95 % interval of each base parameter, shape (b, 2).

        It is infinite if the parameter is not identifiable or is at its bound.
        """
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
    #: Friction of the joints in addition to viscous and Coulomb friction, and the terms that were
    #: tried.
    drives: tuple[DriveChoice, ...] = ()


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
    #: Uncertainties of the drive models; ``standard_covariance`` includes them.
    open_terms: tuple[OpenTerm, ...] = ()
    #: Effect of position quantisation on least squares; None: negligible.
    regressor_noise: RegressorNoise | None = None
    #: Information of each of three or more fitted logs on parameters that may vary.
    runs: tuple[RunsOf, ...] = ()
    sums: RunSums | None = None  # sums over their rows from which it is computed
    #: Without validation logs, metrics of each fitted log as a fit to the others predicts it, by
    #: its name.
    left_out: Mapping[str, Metrics] = field(default_factory=dict)
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
        return typical_friction(self, joint, v, q=q, load=load)

    @cached_property
    def is_consistent(self) -> bool:
        """Whether every body, every drive and the mass matrix are physically consistent.

        A body is checked without its links on locked joints, which keep their own inertials. The
        mass matrix must be positive definite at random poses.
        """
        size = self.model.layout.n_inertial
        J = pseudo_inertia(self.standard[:size] - held_parameters(self.model))
        signs = self.standard[self.model.layout.is_nonnegative()]
        is_possible = bool((np.linalg.eigvalsh(J) > 0).all() and (signs >= 0).all())
        return is_possible and self.mass_matrix.is_positive

    @property
    def mass_matrix(self) -> MassMatrixCheck:
        """Check of the mass matrix of the standard parameters at random poses."""
        if not self._checked or self._checked[-1][0] is not self.standard:
            self._checked.append((self.standard, check_mass_matrix(self.model, self.standard)))
        return self._checked[-1][1]

    @cached_property
    def at_bound(self) -> Array:
        """Which drive terms are at their bound of 0, shape (p,), bool.

        Their value without the bound is not known, so they have no standard error.
        """
        is_bounded = bool(self.estimate.details.get("constraints"))
        is_zero = self.standard <= _AT_BOUND * self.prior_std
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
        after = self.standard_error if unbounded is None else unbounded  # without bounds
        share = after / np.maximum(self.prior_std, _KNOWN)
        moved = np.abs(self.standard - self.prior) > _STAYED * self.prior_std
        active = self.estimate.details.get("active", ())
        is_bound = layout.owned_by([label.split(" ", 1)[1] for label in active if " " in label])
        masses = self.estimator.bounds.masses.items()
        fixed = [f"{link}.m" for link, mass in masses if np.ptp(mass) == 0]
        is_prior = layout.owned_by(self.estimate.details.get("pinned", ()))
        is_prior = is_prior | np.isin(layout.names, fixed) | ((share > FROM_PRIOR) & ~moved)
        is_bound = self.at_bound | (is_bound & moved & (share >= FROM_DATA))
        return sources_of(share, is_prior, is_bound)

    @property
    def standard_quantile(self) -> Array:
        """Half-width of each standard parameter's 95 % interval in standard errors, shape (p,).

        The quantile is that of the base parameter with the fewest degrees of freedom, among those
        that contain the parameter.
        """
        own = np.where(self.mapping.K != 0.0, self.errors.quantile[:, None], QUANTILE)  # (b, p)
        quantile: Array = own.max(axis=0)
        return quantile

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
        return fitted_moments(self)

    def band(self, evaluation: Evaluation) -> TorqueBand:
        """Return the uncertainty band of the torques predicted for a recording.

        Args:
            evaluation: A recording; if it is not one of this fit, the band has the fit's noise,
                and the spread of the drives between three or more fitted logs.
        """
        require_kind(evaluation, Evaluation, "evaluation", "an evaluation of recordings")
        every = zip((*self.fitted, *self.validation), self._bands, strict=True)
        own = next((band for e, band in every if e is evaluation), None)
        return expected_band(self, evaluation, self.between) if own is None else own

    @cached_property
    def between(self) -> Array | None:
        """Covariance of the standard parameters in another log, in addition to that of the fit.

        Shape (p, p); None for fewer than three fitted logs.
        """
        if self.variation is None:
            return None
        return between_covariance(self.variation.to_dict(), self.model.layout.names)

    @cached_property
    def _bands(self) -> tuple[TorqueBand, ...]:
        return recording_bands(self)

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
            raise SettingsError(f"name is {name!r}, wanted 'estimate' or 'wls'")
        return pool(self.model, self.fitted, name)

    @property
    def refitted(self) -> tuple[Evaluation, ...]:
        """Validation recordings that contain fitted rows: they do not test the prediction."""
        return tuple(e for e in self.validation if e.is_refitted)

    @property
    def is_poorly_excited(self) -> bool:
        """Whether parameters are not identifiable because of too little excitation, not noise."""
        return is_poorly_excited(self.wls, len(self.base))

    @property
    def predictions(self) -> dict[str, Metrics]:
        """Metrics of each validation recording without fitted rows, by its name.

        Without validation recordings, those of the fitted ones that are left out in turn.
        """
        if not self.validation:
            return dict(self.left_out)
        new = (e for e in self.validation if not e.is_refitted)
        return {e.name: e.metrics["estimate"] for e in new}

    @cached_property
    def overfitted(self) -> frozenset[str]:
        """Rows of which WLS predicts every unseen recording clearly worse than the estimate.

        A smaller residual of WLS on the fitted recordings then is no evidence against the estimate.
        """
        new = [e.metrics for e in self.validation if not e.is_refitted]
        pairs = [(x["estimate"].per_joint, x["wls"].per_joint) for x in new]
        return frozenset(
            joint
            for joint in (pairs[0][0] if pairs else ())
            if all(wls[joint].rmse > _WORSE * own[joint].rmse for own, wls in pairs)
        )


def expected_band(found: Fit, evaluation: Evaluation, between: Array | None = None) -> TorqueBand:
    """Return the torque band of a recording by the fit's noise level, not by its own residual.

    between (p, p).
    """
    K, motion = found.mapping.K, evaluation.recording.trajectory
    moves = np.array([term.moves for term in found.open_terms]).reshape(-1, K.shape[1])
    C = found.standard_covariance - moves.T @ moves
    covariance = K @ (C if between is None else C + between) @ K.T

    def torques(rows: Array) -> list[Array]:
        model = found.model.with_reference(found.standard)
        return open_torques(model, found.open_terms, evaluation.recording, rows)

    def errors(rows: Array) -> list[tuple[Array, Array]]:
        return list(zip(moves @ K.T, torques(rows), strict=True))

    sigma = found.estimate.sigma
    return torque_band(found.model, found.mapping, motion, covariance, sigma, errors)


def next_errors(found: Fit) -> Array:
    """Return the expected RMS torque error of the next log, shape (n_rows,) [N m, N].

    Its motion is like that of the fitted logs, and its drives vary like theirs.
    """
    bands = [expected_band(found, evaluation, found.between) for evaluation in found.fitted]
    return rms_error(bands)


def recording_bands(found: Fit) -> tuple[TorqueBand, ...]:
    """Return the torque band of each recording from its residuals, fitted recordings first.

    The noise part is chosen so that the bands contain 95 % of the torques of all recordings of the
    same kind, fitted or validation. For validation recordings it is the prediction error on new
    motion, and the band covers further motions as it covers these (split conformal prediction, Lei
    et al. 2018, doi:10.1080/01621459.2017.1307116, with the parameters' part as the lower bound).
    """
    evaluations = (*found.fitted, *found.validation)
    is_fitted = [k < len(found.fitted) or e.is_refitted for k, e in enumerate(evaluations)]
    bands = [
        expected_band(found, evaluation, None if is_own else found.between)
        for evaluation, is_own in zip(evaluations, is_fitted, strict=True)
    ]
    own: dict[bool, list[tuple[TorqueBand, Evaluation]]] = {True: [], False: []}
    for kind, band, evaluation in zip(is_fitted, bands, evaluations, strict=True):
        own[kind].append((band, evaluation))
    noise = {kind: _residual_noise(pairs) for kind, pairs in own.items() if pairs}
    pairs = zip(bands, is_fitted, strict=True)
    return tuple(replace(band, noise=noise[kind]) for band, kind in pairs)


def _residual_noise(own: Sequence[tuple[TorqueBand, Evaluation]]) -> Array:
    """Return the noise with which bands contain 95 % of the torques, shape (n_rows,) [N m, N]."""
    noise = own[0][0].noise.copy()
    rows = []
    for band, e in own:
        residual = e.recording.trajectory.tau - e.torques["estimate"]
        rows.append((band.parameters, residual[band.samples], e.recording.mask[band.samples]))
    std, residual, mask = (np.concatenate(part) for part in zip(*rows, strict=True))
    needed = (residual / QUANTILE) ** 2 - std**2
    for j, used in enumerate(mask.T.astype(bool)):
        if used.any():
            noise[j] = np.sqrt(max(np.quantile(needed[used, j], _COVERAGE), 0.0))
    return noise


def typical_friction(
    found: Fit,
    joint: str,
    v: ArrayLike | None = None,
    *,
    q: float | None = None,
    load: float | None = None,
) -> FrictionCurve:
    """Return friction and offset of a drive under the conditions of the fitted logs.

    See ``friction_curve``.

    v (k,) [rad/s or m/s].
    """
    layout, d = found.model.layout, _drive_number(found, joint)
    ratios, first = layout.drive_ratios[d], found.model.n_rows - len(found.model.joints)
    rows = [e.recording.mask[:, first:][:, ratios != 0.0].all(axis=1) for e in found.fitted]
    motions = [e.recording.trajectory for e in found.fitted]
    for name, value in (("q", q), ("load", load)):
        if not (value is None or is_number(value)):
            raise DataError(f"{name} is {str(value)[:60]!r}, wanted a finite number or None")
    if v is None:
        used = zip(motions, rows, strict=True)
        speeds = np.concatenate([np.abs(m.v[is_used, first:] @ ratios) for m, is_used in used])
        if not speeds.any():
            raise DataError(
                f"{joint} was at rest in the fitted logs, so the range of speeds is not known; "
                "state the speeds: friction(joint, v)"
            )
        side = np.linspace(speeds.min(), speeds.max(), _SPEEDS)
        v = np.append(-side[::-1], side)
    if q is None:
        angles = [m.q[:, m.q.shape[1] - len(ratios) :] for m in motions]  # without the base's pose
        positions = [x[is_used] @ ratios for x, is_used in zip(angles, rows, strict=True)]
        q = float(np.median(np.concatenate(positions))) if np.any(np.concatenate(rows)) else 0.0
    if load is None:
        load = 0.0
        if any(term.name == "load" for term in layout.own.get(joint, ())):
            loads = [drive_motion_along(found.model, m).load[d] for m in motions]
            load = float(np.sqrt(np.mean(np.concatenate(loads)[np.concatenate(rows)] ** 2)))
    speeds = real_numbers(v, "v")
    if speeds.ndim != 1 or not np.isfinite(speeds).all():
        raise DataError(f"v has shape {speeds.shape}, wanted finite speeds, shape (k,)")
    return friction_curve(found, joint, speeds, q=q, load=load)


def fitted_moments(found: Fit) -> dict[str, DriveMoments]:
    """Return the moments that project drive friction on simpler terms, from the fitted rows."""
    rows = ((e.recording.trajectory, e.recording.mask) for e in found.fitted)
    return drive_moments(found.model, rows)


def friction_curve(
    found: Fit, joint: str, v: Array, *, q: float = 0.0, load: float = 0.0
) -> FrictionCurve:
    """Return friction and offset of a drive against its speed, with the band of its parameters.

    Friction terms with an internal state have their value after long motion in one direction.

    v (k,) [rad/s or m/s].
    """
    layout, d = found.model.layout, _drive_number(found, joint)
    none = np.zeros_like(v)
    motion = DriveMotion(q + none, v, none, np.sign(v), load + none, none)
    own = [
        (k, term)
        for k, (drive, term) in enumerate(layout.drive_parameters, start=layout.n_inertial)
        if drive == d and not term.is_inertia
    ]
    X = np.column_stack([none, *(term.column(motion) for _, term in own)])[:, 1:]
    k = [k for k, _ in own]
    moves = np.array([term.moves[k] for term in found.open_terms]).reshape(-1, len(k))
    C = found.standard_covariance[np.ix_(k, k)] - moves.T @ moves
    variance = np.einsum("ij,jk,ik->i", X, C, X)
    for term, moved in zip(found.open_terms, moves @ X.T, strict=True):
        if term.joint == joint:  # the term's own torque adds to the change of the parameters
            moved = moved + term.torque(motion, JointMotion.steady(motion))
        variance += moved**2
    return FrictionCurve(v, X @ found.standard[k], np.sqrt(np.maximum(variance, 0.0)), load)


def _drive_number(found: Fit, joint: str) -> int:
    require_kind(joint, str, "joint", "the name of a joint or of a coupling")
    names = [drive.name for drive in found.model.layout.drives]
    if joint not in names:
        raise DataError(
            f"{joint!r} is no drive of {found.model.name}; drives: {listed(names)}"
            f"{suggestion(joint, names)}"
        )
    return names.index(joint)
