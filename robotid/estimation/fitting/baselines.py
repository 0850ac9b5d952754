"""The baseline of an identification: the URDF's bodies with drives fitted to the logs."""

import numpy as np

from robotid.base.typing import Array
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.factors import Factors
from robotid.robot.model import RobotModel


def urdf_with_drives(
    model: RobotModel, mapping: BaseMapping, factors: Factors, sigma: Array, spread: Array
) -> Array:
    """Return the URDF's inertial parameters with fitted drive terms, shape (p,).

    Weighted least squares of the drive terms d >= 0 (offsets of either sign) with the bodies' pi_I
    as in the URDF: min sum_j |R_j K_I pi_I + R_j K_D d - tau_j|^2 / sigma_j^2.

    sigma (n,) [N m or N], spread (p,).
    """
    from scipy.optimize import lsq_linear

    pi = model.standard_parameters()
    size = model.layout.n_inertial
    pi[size:] = 0.0
    if size == len(pi):
        return pi
    rows = factors.weighted(sigma)
    R, tau = rows[:, :-1], rows[:, -1]
    scale = spread[size:]
    lowest = np.where(model.layout.is_nonnegative()[size:], 0.0, -np.inf)
    X = R @ mapping.K[:, size:] * scale
    found = lsq_linear(X, tau - R @ mapping.to_base(pi), bounds=(lowest, np.inf), method="bvls")
    pi[size:] = scale * found.x
    return pi
