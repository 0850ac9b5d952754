"""A fit: what an estimator found of a robot, its errors, and how well it predicts."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from robotid._typing import Array
from robotid.doctor.motions import is_poorly_excited
from robotid.estimators import Estimate
from robotid.estimators.determination import Determination
from robotid.exceptions import SettingsError
from robotid.fitting.bands import (
    QUANTILE,
    FrictionCurve,
    TorqueBand,
    expected_band,
    fitted_moments,
    recording_bands,
    typical_friction,
)
from robotid.fitting.drives import DriveChoice
from robotid.fitting.evaluation import Evaluation, pool
from robotid.fitting.identified import FROM_DATA, FROM_PRIOR, Identified, sources_of
from robotid.fitting.metrics import Metrics
from robotid.fitting.open_terms import OpenTerm
from robotid.fitting.regressor_noise import RegressorNoise
from robotid.fitting.robust import Outlier, find_outliers
from robotid.fitting.settings import EstimatorSettings
from robotid.fitting.standard_errors import StandardErrors
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.factors import Factors
from robotid.regressor.friction_projection import DriveMoments
from robotid.robot.bodies import held_parameters
from robotid.robot.mass_matrix import MassMatrixCheck, check_mass_matrix
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

__all__ = ["Fit", "Solution"]

_KNOWN = 1e-300  # the spread of what was known exactly
_STAYED = 0.3  # spreads that a parameter of the prior may have moved
_AT_BOUND = 1e-6  # of its spread: a drive term that small is at its bound of 0


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution:
    """A robot's parameters as fitted to recordings, before their errors are known.

    Attributes:
        model: The robot as the URDF describes it.
        mapping: Standard to base parameters.
        prior_std: How far parameters may plausibly be wrong before the data, shape (p,).
        standard: Standard parameters, shape (p,).
        fitted: The recordings that were fitted.
        validation: Those that were kept apart.
        drives: What friction its joints have beside viscous and Coulomb's, and what was tried.
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
    """A robot's parameters as fitted to recordings, before anything is concluded of them.

    Its recordings have predictions "estimate" and "wls".

    Attributes:
        estimator: The estimator's settings.
        estimate: What the estimator returned: base parameters, or standard ones ("consistent").
        wls: Weighted least squares on the same factors, base parameters.
        urdf_with_drives: The prior with the drive terms that then fit best, shape (p,).
        errors: What the standard errors depend on.
        factors: What the fitted rows come down to, base parameters.
        determination: Which base parameters the fitted rows determine.
        open_terms: What is open of its drives, which ``standard_covariance`` counts.
        regressor_noise: What the steps of the positions do to least squares; None: next to nothing.
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
            v: Speeds, shape (k,) [rad/s or m/s]; None: 20 either way, from the slowest to the
                fastest of the fitted rows.
            q: Position, of which some friction depends [rad or m]; None: the median.
            load: Torque of the bodies that the gear carries, of which some friction depends
                [N m or N]; None: its root mean square in the fitted logs.

        Returns:
            The curve: ``v``, ``torque``, ``std``, ``half_width`` of the 95 % band, ``load``.

        Raises:
            DataError: If there is no such drive; or without speeds, if it was at rest.
        """
        return typical_friction(self, joint, v, q=q, load=load)

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
        kept = kept | np.isin(layout.names, known) | ((share > FROM_PRIOR) & ~moved)
        held = self.at_bound | (held & moved & (share >= FROM_DATA))
        return sources_of(share, kept, held)

    @property
    def standard_quantile(self) -> Array:
        """How many standard errors the 95 % interval of each standard parameter reaches, (p,).

        The quantile is that of the base parameter, of those it is part of, whose standard error has
        the fewest degrees of freedom.
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

    @property
    def moments(self) -> dict[str, DriveMoments]:
        """What projects the friction of drives on simpler terms, from the fitted rows."""
        return fitted_moments(self)

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
