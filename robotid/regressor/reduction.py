"""What the rows of a stretch of a log come down to, and how stretches are joined."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Trajectory
from robotid.regressor.factors import Factors, compress, merge
from robotid.regressor.problem import Problem

__all__ = ["Reduction", "join", "join_stretches"]


@dataclass(frozen=True, eq=False)
class Reduction:
    """What the rows of a piece, or of many, come down to.

    Attributes:
        factors: Their triangular factors.
        squares: Sums of tau^2, v^2 and a^2 over all samples, used or not, shape (3, n_rows).
        samples: Number of these samples.
    """

    factors: Factors
    squares: Array
    samples: int

    @classmethod
    def of(
        cls, problem: Problem, trajectory: Trajectory, *, threads: int | None = None
    ) -> "Reduction":
        """Reduce the problem of one trajectory.

        Args:
            problem: The base problem of the trajectory, rows weighted.
            trajectory: The trajectory.
            threads: As of ``compress``.

        Raises:
            DataError: If a row is not finite.
        """
        return cls(compress(problem, threads=threads), trajectory.squares, len(trajectory.t))

    def to_arrays(self) -> dict[str, Array]:
        """Return the reduction as plain arrays by name, as for a checkpoint."""
        return {
            **{f"R_{j}": R for j, R in enumerate(self.factors.triangles)},
            **{f"columns_{j}": own for j, own in enumerate(self.factors.columns)},
            "rows": self.factors.rows,
            "names": np.array(self.factors.names),
            "squares": self.squares,
            "samples": np.array(self.samples),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, Array]) -> "Reduction":
        """Return the reduction that arrays hold, to the same bits; see ``to_arrays``.

        Args:
            arrays: The arrays by name.
        """
        rows, joints = arrays["rows"], range(len(arrays["rows"]))
        factors = Factors(
            tuple(np.asfortranarray(arrays[f"R_{j}"]) for j in joints),
            tuple(arrays[f"columns_{j}"] for j in joints),
            rows,
            tuple(arrays["names"].tolist()),
        )
        return cls(factors, arrays["squares"], int(arrays["samples"]))


def join(reductions: Sequence[Reduction]) -> Reduction:
    """Return what all the rows of several reductions come down to.

    Neighbours are joined, then their neighbours, and so on: the order never depends on timing.

    Args:
        reductions: At least one; all with the same columns and joints.

    Raises:
        DataError: If there is none, or their columns or joints differ.
    """
    if not reductions:
        raise DataError("no reduction was given; at least one log is needed")
    level = list(reductions)
    while len(level) > 1:
        level = [_join_neighbours(level[k : k + 2]) for k in range(0, len(level), 2)]
    return level[0]


def join_stretches(reductions: Iterable[Reduction], count: int, most: int) -> list[Reduction]:
    """Return the reductions of at most so many stretches of neighbouring pieces.

    They are joined as they come, so that no more are in memory.

    Args:
        reductions: One per piece, in order.
        count: Number of pieces, at least 1.
        most: Largest number of stretches, at least 1.

    Returns:
        One per stretch, in order; the last stretch may be shorter.

    Raises:
        DataError: If their columns or joints differ.
    """
    length = -(-count // most)
    stretches: list[Reduction] = []
    for k, reduction in enumerate(reductions):
        if k % length:
            stretches[-1] = join([stretches[-1], reduction])
        else:
            stretches.append(reduction)
    return stretches


def _join_neighbours(reductions: Sequence[Reduction]) -> Reduction:
    """Return what one or two reductions come down to."""
    if len(reductions) == 1:
        return reductions[0]
    return Reduction(
        merge([r.factors for r in reductions]),
        np.sum([r.squares for r in reductions], axis=0),
        sum(r.samples for r in reductions),
    )
