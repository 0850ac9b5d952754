"""Multipliers of the augmented Lagrangian that enforces the limits of a designed motion.

References:
    Nocedal, Wright (2006), Numerical Optimization, section 17.4.
"""

from dataclasses import dataclass, replace

import numpy as np

from robotid.base.typing import Array

#: Share of limits reserved for the motion between the samples of a design.
SPARE = 0.003
#: Distance whose violation has the cost of a whole limit [m].
SOFT = 0.05
_GROWTH = 3.0  # of the weight from one round to the next


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Multipliers of the limits at each sample, and of distances.

    Attributes:
        weight: Weight of the violations.
        limits: Shape (6, N, n); 0 at first.
        distances: Shape (pairs, N).
    """

    weight: float
    limits: Array | float = 0.0
    distances: Array | float = 0.0

    def finer(self, times: int) -> "Multipliers":
        """Return the same on a finer grid."""
        limits, distances = _between(self.limits, times), _between(self.distances, times)
        return Multipliers(self.weight / times, limits, distances)

    def increased(self) -> "Multipliers":
        """Return the same with a larger weight."""
        return replace(self, weight=_GROWTH * self.weight)

    def raised(self, used: Array, distance: Array | None, aim: Array) -> "Multipliers":
        """Return the slopes as the new multipliers.

        used (6, N, n), distance (pairs, N) [m], aim (pairs, 1) [m].
        """
        distances = 0.0 if distance is None else self.of_distances(distance, aim)[1]
        return replace(self, limits=self.of_limits(used)[1], distances=distances)

    def of_limits(self, used: Array) -> tuple[float, Array]:
        """Return the cost of limits and its derivative by their violations, shape (6, N, n).

        used (6, N, n).
        """
        return self._cost(used**2 / (1.0 - SPARE) ** 2 - 1.0, self.limits)

    def of_distances(self, distance: Array, aim: Array) -> tuple[float, Array]:
        """Return the cost of distances and its derivative by their deficits, shape (pairs, N).

        distance (pairs, N) [m], aim (pairs, 1) [m].
        """
        return self._cost((aim - distance) / SOFT, self.distances)

    def distance_without_cost(self, aim: Array) -> Array:
        """Return the distances from which there is no cost, shape (pairs, N) or (pairs, 1) [m].

        aim (pairs, 1) [m].
        """
        return aim + SOFT / self.weight * self.distances

    def _cost(self, over: Array, multipliers: Array | float) -> tuple[float, Array]:
        pushed = np.maximum(0.0, multipliers + self.weight * over)
        cost = float(np.sum(pushed**2 - np.square(multipliers))) / (2 * self.weight)
        return cost, pushed


def _between(values: Array | float, times: int) -> Array | float:
    """Return multipliers of samples, axis 1, interpolated on as many times the intervals."""
    if isinstance(values, float):
        return values
    share = np.arange(times).reshape(-1, *[1] * (values.ndim - 2)) / times
    steps = np.diff(values, axis=1)[:, :, None]
    shape = len(values), times * (values.shape[1] - 1), *values.shape[2:]  # maybe of no pair
    between = (values[:, :-1, None] + share * steps).reshape(shape)
    fine: Array = np.concatenate([between, values[:, -1:]], axis=1) / times
    return fine
