"""Equimomental ellipsoids: the solid of even density that moves as a body does."""

from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.robot.parameters import pseudo_inertia

__all__ = ["Ellipsoid", "ellipsoids"]


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The mass of a body as a solid.

    Attributes:
        mass: Mass [kg].
        com: Centre of mass in the body's frame, shape (3,) [m]; None without mass.
        semi_axes: Lengths of the semi-axes, shape (3,) [m]; None if no solid has this inertia.
        rotation: Directions of the axes as columns, a rotation, shape (3, 3).
        fault: Why there is no solid, in words; empty if there is one.
    """

    mass: float
    com: Array | None
    semi_axes: Array | None
    rotation: Array
    fault: str


def ellipsoids(pi: Array) -> tuple[Ellipsoid, ...]:
    """Return the equimomental ellipsoid of each body.

    The second moments about the centre of mass, Sigma_c = Sigma - m c c', are those of a solid
    ellipsoid of even density whose semi-axes have the lengths sqrt(5 s_i / m), s_i the
    eigenvalues of Sigma_c.

    Args:
        pi: Inertial parameters of the bodies, shape (10 bodies,), SI units.

    References:
        Wensing, Kim, Slotine (2018), Linear matrix inequalities for physically consistent
        inertial parameter identification, section IV.
    """
    return tuple(_ellipsoid(J) for J in pseudo_inertia(pi))


def _ellipsoid(J: Array) -> Ellipsoid:
    m = float(J[3, 3])
    if not m > 0:
        return Ellipsoid(m, None, None, np.eye(3), "no mass" if m == 0 else "negative mass")
    c = J[:3, 3] / m
    s, axes = np.linalg.eigh(J[:3, :3] - m * np.outer(c, c))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    rounding = 1e-12 * float(np.trace(J[:3, :3]))
    if s[0] < -rounding:
        return Ellipsoid(m, c, None, np.eye(3), "no solid has this inertia")
    return Ellipsoid(m, c, np.sqrt(5.0 * np.maximum(s, 0.0) / m), axes, "")
