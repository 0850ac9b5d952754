"""The prior: the URDF's parameters and their plausible deviations."""

import numpy as np

from robotid.base.typing import Array
from robotid.robot.drives import DriveMotion
from robotid.robot.mass_matrix import carried_inertia
from robotid.robot.model import RobotModel
from robotid.robot.parameters import pseudo_inertia

_SMALLEST_MASS = 0.1  # of the mean mass: deviation of a link's mass even if its URDF states 0
_SMALLEST_RADIUS = 0.1  # of the robot's length: the same for a link's size
_POSITIONS = 16  # of a revolution at which terms that depend on the position are evaluated
_FAINTEST = 1e-6  # smallest RMS of a column


def prior_spread(model: RobotModel, squares: Array, samples: int) -> Array:
    """Return the prior standard deviation of each standard parameter, shape (p,).

    That of a body is its own size: its mass m, m r and m r^2, with r the distance of the centre of
    mass plus the radius of gyration. That of a drive term is the value with which it alone would
    have the RMS of the measured torque: rms(tau) over the RMS of its column; for an armature at
    least the inertia of the bodies about its joint.

    squares (3, n_rows).
    """
    rms = np.sqrt(squares / max(samples, 1))
    return np.concatenate([_inertial_spread(model), _drive_spread(model, rms)])


def payload_spread(model: RobotModel) -> Array:
    """Return the prior standard deviations of a payload's parameters, shape (10,).

    They are those of the robot's mass at the distance of its longest link.
    """
    masses = model.standard_parameters()[: model.layout.n_inertial : 10]
    mass, radius = max(float(np.abs(masses).sum()), 1e-3), model.length
    return mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])


def _inertial_spread(model: RobotModel) -> Array:
    size = model.layout.n_inertial
    J = pseudo_inertia(model.standard_parameters()[:size])
    mean = max(float(np.mean(J[:, 3, 3])), 1e-6)
    mass = np.maximum(np.abs(J[:, 3, 3]), _SMALLEST_MASS * mean)
    gyration = np.sqrt(np.abs(np.trace(J[:, :3, :3], axis1=1, axis2=2)) / mass)
    radius = np.linalg.norm(J[:, :3, 3], axis=1) / mass + gyration
    radius = np.maximum(radius, _SMALLEST_RADIUS * model.length)
    one = np.ones(len(mass))
    spread: Array = mass[:, None] * np.column_stack([one, *[radius] * 3, *[radius**2] * 6])
    return spread.reshape(-1)


def _drive_spread(model: RobotModel, rms: Array) -> Array:
    first = model.n_rows - len(model.joints)
    tau, v, a = (_positive(row[first:]) for row in rms)
    carried = carried_inertia(model)
    q = np.linspace(-np.pi, np.pi, _POSITIONS, endpoint=False)[:, None] + 0.0 * v
    typical = DriveMotion(
        q, v + 0.0 * q, a + 0.0 * q, np.ones_like(q), tau + 0.0 * q, tau * a / v + 0.0 * q
    )
    spread = []
    for d, term in model.layout.drive_parameters:
        size = np.sqrt(np.mean(term.column(typical) ** 2, axis=0))
        alone = tau / np.maximum(size, _FAINTEST)
        rows = [model.joints.index(joint) for joint, _ in model.layout.drives[d].ratios]
        spread.append((np.maximum(carried, alone) if term.is_inertia else alone)[rows].mean())
    return np.array(spread)


def _positive(rms: Array) -> Array:
    """Return the root mean square of each column, never 0."""
    return np.maximum(rms, 1e-3 * rms.max() if rms.max() > 0 else 1.0)
