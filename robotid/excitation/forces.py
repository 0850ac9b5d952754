"""Forces of the ground on a robot on its feet, and their margins, with exact gradients.

Flat feet stand on their four corners: a wrench is within the contact wrench cone of a foot if it is
a sum of corner forces within friction cones. The forces are the smallest ones that cause the motion
of the base.

References:
    Caron, Pham, Nakamura (2015), Stability of surface contacts for humanoid robots.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.excitation.feet import Frame, Placed

__all__ = ["LOADED", "Ground", "projection"]

#: Vertical force that each point of contact must have, as a share of the mean one.
LOADED = 0.1
_ROUND = 1e-6  # of the mean vertical force: smaller tangential forces have no direction


@dataclass(frozen=True, eq=False)
class Ground:
    """Level ground with friction under k points of a robot whose base is its first six joints.

    Attributes:
        points: The points of contact.
        names: The link of each; the four corners of a flat foot follow each other.
        ratios: Speeds of the m bodies' joints per speed of each coordinate, shape (m, n).
        friction: Coefficient of friction that may be used [-].
        weight: Weight of the robot [N].
    """

    points: Sequence[Frame]
    names: Sequence[str]
    ratios: Array
    friction: float
    weight: float

    @property
    def mean(self) -> float:
        """Mean vertical force at a point [N]."""
        return self.weight / len(self.points)

    def jacobian(self, placed: Placed) -> Array:
        """Return the Jacobian of the points, shape (N, 3 k, n).

        Args:
            placed: Where everything is.
        """
        rows = np.concatenate([placed.levers(point) for point in self.points], axis=2)
        J: Array = rows.swapaxes(1, 2) @ self.ratios
        return J

    def forces(self, placed: Placed, torque: Array) -> tuple[Array, Array]:
        """Return the forces on the robot, shape (N, k, 3) [N], and the torques that remain, (N, n).

        f = J_b (J_b^T J_b)^-1 w_b, tau = w - J^T f; the first six are 0.

        Args:
            placed: Where everything is.
            torque: The torque w of the motion without forces, shape (N, n) [N m or N].
        """
        J = self.jacobian(placed)
        base = J[:, :, :6]
        f = (base @ np.linalg.solve(base.swapaxes(1, 2) @ base, torque[:, :6, None]))[..., 0]
        tau = torque - np.einsum("krj,kr->kj", J, f)
        return f.reshape(len(f), -1, 3), tau

    def margins(self, f: Array) -> Array:
        """Return margins of forces, over the mean vertical force, shape (2 k, N).

        Of each point f_z - 0.1 of the mean, then friction f_z - |f_t|.

        Args:
            f: The forces, shape (N, k, 3) [N].
        """
        upward, along = f[..., 2], self._along(f)
        found: Array = np.hstack(
            [upward / self.mean - LOADED, (self.friction * upward - along) / self.mean]
        )
        return found.T

    def smallest(self, f: Array, t: Array) -> dict[str, dict[str, Any]]:
        """Return the smallest margin to each constraint of the forces: its value, place and time.

        Args:
            f: The forces, shape (N, k, 3) [N].
            t: Times, shape (N,) [s].
        """
        upward = f[..., 2]
        used = np.linalg.norm(f[..., :2], axis=2) / np.maximum(upward, 1e-300)
        load = upward / self.mean - LOADED
        rub = 1.0 - np.where(upward > 0.0, used / self.friction, np.inf)
        least, most = float(upward.min()), float(used.max())
        found = {
            "vertical force": (load, f"{least:.3g} N, wanted {LOADED * self.mean:.3g} N or more"),
            "friction": (rub, f"{most:.2f}, wanted {self.friction:.2f} or less"),
        }
        margins = {name: self._place(*entry, t) for name, entry in found.items()}
        soles = [k for k in range(len(self.names)) if self.names.index(self.names[k]) == k]
        if len(soles) < len(self.names):
            margins["centre of pressure"] = self._pressure(upward, soles, t)
        return margins

    def _place(self, margin: Array, words: str, t: Array) -> dict[str, Any]:
        """Return the smallest of margins of points, shape (N, k)."""
        row, point = np.unravel_index(int(np.argmin(margin)), margin.shape)
        return {
            "margin": float(margin[row, point]),
            "where": self.names[int(point)],
            "time": float(t[row]),
            "words": words,
        }

    def _pressure(self, upward: Array, soles: Sequence[int], t: Array) -> dict[str, Any]:
        """Return the smallest margin of the centres of pressure of flat feet.

        It is the distance from the edge over half of the width.
        """
        best: dict[str, Any] = {"margin": np.inf}
        for first in soles:
            corners = upward[:, first : first + 4].reshape(-1, 2, 2)  # back and front, both sides
            if self.names.count(self.names[first]) != 4:
                continue
            total = np.maximum(corners.sum(axis=(1, 2)), 1e-300)
            far = self.points[first + 3].origin - self.points[first].origin
            sizes = np.abs(self.points[first].axes.T @ far)[:2]
            for share, size in zip(
                (corners[:, 1].sum(axis=1) / total, corners[:, :, 1].sum(axis=1) / total),
                sizes.tolist(),
                strict=True,
            ):
                margin = 1.0 - np.abs(2.0 * share - 1.0)
                k = int(np.argmin(margin))
                if margin[k] < best["margin"]:
                    words = f"{500 * size * margin[k]:.0f} mm from the edge"
                    best = {
                        "margin": float(margin[k]),
                        "where": self.names[first],
                        "time": float(t[k]),
                        "words": words,
                    }
        return best

    def _along(self, f: Array) -> Array:
        """Return the tangential forces, rounded off at 0, shape (N, k) [N]."""
        along: Array = np.sqrt(np.sum(f[..., :2] ** 2, axis=2) + (_ROUND * self.mean) ** 2)
        return along

    def pull(
        self, placed: Placed, torque: Array, by_torque: Array, by_margins: Array
    ) -> tuple[Array, Array]:
        """Return a gradient by q at a fixed torque w, and by w, shape (N, n) each.

        Args:
            placed: Where everything is.
            torque: w, shape (N, n) [N m or N].
            by_torque: The gradient by the torques that remain, shape (N, n).
            by_margins: The gradient by the margins, shape (2 k, N).
        """
        J = self.jacobian(placed)
        base = J[:, :, :6]
        inverse = np.linalg.inv(base.swapaxes(1, 2) @ base)
        mu = (inverse @ torque[:, :6, None])[..., 0]
        f = (base @ mu[..., None])[..., 0]
        by_f = self._margins_pulled(f.reshape(len(f), -1, 3), by_margins)
        by_f = by_f - np.einsum("krj,kj->kr", J, by_torque)
        nu = (inverse @ (base.swapaxes(1, 2) @ by_f[..., None]))[..., 0]
        by_J = -f[..., None] * by_torque[:, None]
        by_J[:, :, :6] += (by_f - (base @ nu[..., None])[..., 0])[..., None] * mu[:, None]
        by_J[:, :, :6] -= f[..., None] * nu[:, None]
        by_w = by_torque.copy()
        by_w[:, :6] += nu
        by_body = by_J @ self.ratios.T  # (N, 3 k, m)
        found = np.zeros(by_body.shape[::2])
        for k, point in enumerate(self.points):
            found += placed.pulled(point, by_body[:, 3 * k : 3 * k + 3].swapaxes(1, 2))
        return found @ self.ratios, by_w

    def _margins_pulled(self, f: Array, by_margins: Array) -> Array:
        """Return the gradient by the forces, shape (N, 3 k)."""
        upright, rubbing = np.split(by_margins.T / self.mean, 2, axis=1)
        by_f = np.empty_like(f)
        by_f[..., 2] = upright + self.friction * rubbing
        by_f[..., :2] = -(rubbing / self._along(f))[..., None] * f[..., :2]
        return by_f.reshape(len(f), -1)


def projection(J: Array) -> tuple[Array, Array]:
    """Return the projection P = I - A (A^T A)^-1 A^T with A = J^T, (N, n, n), and A (A^T A)^-1.

    Args:
        J: Jacobian of the feet, shape (N, r, n).
    """
    A = J.swapaxes(1, 2)
    back = A @ np.linalg.inv(J @ A)
    return np.eye(J.shape[2]) - back @ J, back
