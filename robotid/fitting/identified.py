"""A robot's parameters as they were identified: errors, intervals, and what determined them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid._typing import Array
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.friction_projection import DriveMoments, projected_pinocchio_model
from robotid.regressor.prediction import predict_instants
from robotid.robot.model import RobotModel

__all__ = ["FROM_DATA", "FROM_PRIOR", "SOURCES", "Identified", "sources_of"]

#: What may have determined a standard parameter.
SOURCES = ("data", "mixed", "prior", "bound")
FROM_DATA = 0.3  # a parameter whose spread the data shrink below this share is theirs
FROM_PRIOR = 0.9  # ... and above this share, the prior's


def sources_of(share: Array, is_prior: Array, is_bound: Array) -> tuple[str, ...]:
    """Return what determined each parameter, of ``SOURCES``.

    Args:
        share: Standard error over the spread assumed before the fit, shape (p,) [-].
        is_prior: Which keep the prior's value, shape (p,), bool.
        is_bound: Which of the others a bound holds, shape (p,), bool.
    """
    names = np.select([is_prior, is_bound, share < FROM_DATA], ["prior", "bound", "data"], "mixed")
    return tuple(names.tolist())


@dataclass(frozen=True, eq=False)
class Identified(ABC):
    """Standard and base parameters of a robot, whatever they were identified from.

    Attributes:
        model: The robot as the URDF describes it, with the drive terms that were identified.
        mapping: Standard to base parameters.
        prior: Standard parameters of the URDF, shape (p,).
        standard: Standard parameters, shape (p,).
        standard_covariance: Their covariance given the prior, shape (p, p).
        base: Base parameters, shape (b,).
        base_error: Their standard errors, shape (b,); inf where the data say nothing.
    """

    model: RobotModel
    mapping: BaseMapping
    prior: Array
    standard: Array
    standard_covariance: Array
    base: Array
    base_error: Array

    @property
    @abstractmethod
    def standard_error(self) -> Array:
        """Standard errors of the standard parameters, shape (p,); inf where there is none."""

    @property
    @abstractmethod
    def standard_quantile(self) -> Array:
        """How many standard errors the 95 % interval of each standard parameter reaches, (p,)."""

    @property
    @abstractmethod
    def base_quantile(self) -> Array:
        """How many standard errors the 95 % interval of each base parameter reaches, (b,)."""

    @property
    @abstractmethod
    def at_bound(self) -> Array:
        """Which standard parameters are where they are by a bound only, shape (p,), bool."""

    @property
    @abstractmethod
    def sources(self) -> tuple[str, ...]:
        """What determined each standard parameter, of ``SOURCES``."""

    @property
    @abstractmethod
    def undetermined(self) -> tuple[str, ...]:
        """Names of the parameters that the data leave open."""

    @property
    @abstractmethod
    def moments(self) -> Mapping[str, DriveMoments]:
        """What projects the friction of drives on simpler terms, by drive."""

    @property
    @abstractmethod
    def is_consistent(self) -> bool:
        """Whether the parameters are physically possible."""

    @property
    def standard_interval(self) -> Array:
        """95 % interval of each standard parameter, shape (p, 2); infinite where there is none.

        It reaches as far as ``standard_quantile`` says.
        """
        half = self.standard_quantile * self.standard_error
        return np.column_stack([self.standard - half, self.standard + half])

    @property
    def base_interval(self) -> Array:
        """95 % interval of each base parameter, shape (b, 2); infinite where it is open.

        It is open where the data say nothing, and where the parameter is at its bound.
        """
        half = self.base_quantile * self.base_error
        return np.column_stack([self.base - half, self.base + half])

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
        return projected_pinocchio_model(self.model, self.standard, self.moments)
