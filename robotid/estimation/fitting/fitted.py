"""The result of a fit: identified parameters, standard errors, predictions."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.exceptions import SettingsError
from robotid.base.settings import require_kind
from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.dynamics.friction_projection import DriveMoments
from robotid.estimation.estimators import Estimate
from robotid.estimation.estimators.determination import Determination, is_poorly_excited
from robotid.estimation.fitting.bands import (
    QUANTILE,
    FrictionCurve,
    TorqueBand,
    expected_band,
    fitted_moments,
    recording_bands,
    typical_friction,
)
from robotid.estimation.fitting.estimator_settings import EstimatorSettings
from robotid.estimation.fitting.evaluation import Evaluation, pool
from robotid.estimation.fitting.identified import FROM_DATA, FROM_PRIOR, Identified, sources_of
from robotid.estimation.fitting.metrics import Metrics
from robotid.estimation.fitting.open_terms import OpenTerm
from robotid.estimation.fitting.regressor_noise import RegressorNoise
from robotid.estimation.fitting.robust import Outlier, find_outliers
from robotid.estimation.fitting.selected_drives import DriveChoice
from robotid.estimation.fitting.standard_errors import StandardErrors
from robotid.estimation.variation.groups import RunsOf, RunSums
from robotid.estimation.variation.variation import Variation, between_covariance
from robotid.robot.bodies import held_parameters
from robotid.robot.mass_matrix import MassMatrixCheck, check_mass_matrix
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_KNOWN = 1e-300  # smallest prior standard deviation, of fixed parameters
_STAYED = 0.3  # change in prior standard deviations up to which the source may be the prior
_WORSE = 1.2  # error of WLS over that of the estimate above which it is clearly worse
_AT_BOUND = 1e-6  # size of a drive term at its bound of 0, in prior standard deviations


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """Parameters of a robot fitted to recordings, without standard errors.

    Attributes:
        model: The robot of the URDF.
        mapping: Standard to base parameters.
        prior_std: Prior standard deviations of the standard parameters, shape (p,).
        standard: Standard parameters, shape (p,).
        fitted: The fitted recordings.
        validation: The validation recordings.
        drives: Friction of the joints in addition to viscous and Coulomb friction, and the terms
            that were tried.
    """

    model: RobotModel
    mapping: BaseMapping
    prior_std: Array
    standard: Array
    fitted: tuple[Evaluation, ...]
    validation: tuple[Evaluation, ...]
    drives: tuple[DriveChoice, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Fit(Identified, Solution):
    """Parameters of a robot fitted to recordings, without findings and verdict.

    Its recordings have the predictions "estimate" and "wls".

    Attributes:
        estimator: The estimator's settings.
        estimate: Result of the estimator: base parameters, or standard ones ("consistent").
        wls: Weighted least squares on the same factors, base parameters.
        urdf_with_drives: The prior with fitted drive terms, shape (p,).
        errors: Method and degrees of freedom of the standard errors.
        factors: Triangular factors of the fitted rows, base parameters.
        determination: Which base parameters the fitted rows determine.
        open_terms: Uncertainties of the drive models; ``standard_covariance`` includes them.
        regressor_noise: Effect of position quantisation on least squares; None: negligible.
        runs: Information of each of three or more fitted logs on parameters that may vary.
        sums: Sums over their rows from which it is computed.
        left_out: Without validation logs, metrics of each fitted log as a fit to the others
            predicts it, by its name.
        variation: Variation of the drives' parameters between these logs.
    """

    estimator: EstimatorSettings
    estimate: Estimate
    wls: Estimate
    urdf_with_drives: Array
    errors: StandardErrors
    factors: Factors
    determination: Determination
    open_terms: tuple[OpenTerm, ...] = ()
    regressor_noise: RegressorNoise | None = None
    runs: tuple[RunsOf, ...] = ()
    sums: RunSums | None = None
    left_out: Mapping[str, Metrics] = field(default_factory=dict)
    variation: Variation | None = None
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
