"""Identified parameters of a robot: standard errors, intervals, and the source of each value."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.friction_projection import DriveMoments, projected_pinocchio_model
from robotid.dynamics.prediction import predict_instants
from robotid.robot.model import RobotModel

#: The possible sources of the value of a standard parameter.
SOURCES = ("data", "mixed", "prior", "bound")
FROM_DATA = 0.3  # standard error over prior standard deviation below which the source is the data
FROM_PRIOR = 0.9  # ... and above which it is the prior


def sources_of(share: Array, is_prior: Array, is_bound: Array) -> tuple[str, ...]:
    """Return the source of the value of each parameter, of ``SOURCES``.

    share (p,) [-], is_prior (p,), is_bound (p,).
    """
    names = np.select([is_prior, is_bound, share < FROM_DATA], ["prior", "bound", "data"], "mixed")
    return tuple(names.tolist())


@dataclass(frozen=True, eq=False)
class Identified(ABC):
    """Standard and base parameters of a robot, for every method of identification.

    Attributes:
        model: The robot of the URDF, with the identified drive terms.
        mapping: Standard to base parameters.
        prior: Standard parameters of the URDF, shape (p,).
        standard: Standard parameters, shape (p,).
        standard_covariance: Their covariance given the prior, shape (p, p).
        base: Base parameters, shape (b,).
        base_error: Their standard errors, shape (b,); inf if not identifiable.
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
