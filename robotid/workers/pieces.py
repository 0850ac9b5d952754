"""Long logs as pieces: each comes down to its factors, by itself, in any process, in any order.

A piece is a fixed stretch of rows of one log, whatever the number of workers: what it comes down
to never depends on who reduces it, nor on what else is reduced beside it.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.logs.data import Trajectory
from robotid.regressor.factors import Factors, compress, merge
from robotid.regressor.problem import Problem

__all__ = ["Piece", "Reduction", "join", "join_stretches"]


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

        Returns:
            The reduction.

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
        """Return the reduction that arrays hold; see ``to_arrays``.

        Args:
            arrays: The arrays by name.

        Returns:
            The reduction, to the same bits.
        """
        rows, joints = arrays["rows"], range(len(arrays["rows"]))
        factors = Factors(
            tuple(np.asfortranarray(arrays[f"R_{j}"]) for j in joints),
            tuple(arrays[f"columns_{j}"] for j in joints),
            rows,
            tuple(arrays["names"].tolist()),
        )
        return cls(factors, arrays["squares"], int(arrays["samples"]))


class Piece(ABC):
    """A stretch of a log that is reduced by itself. Pieces can be pickled, and are small."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What messages call it, as ``run3.parquet rows 0-16384``."""

    @property
    @abstractmethod
    def samples(self) -> int:
        """About how many samples it has, for progress."""

    @abstractmethod
    def reduce(self, *, threads: int | None = None) -> Reduction:
        """Read the piece and reduce it to the factors of its base problem.

        Args:
            threads: As of ``compress``; they do not change the result.

        Returns:
            The reduction; one of no samples if no sample of the piece is left.

        Raises:
            DataError: If a row cannot be used.
        """


def join(reductions: Sequence[Reduction]) -> Reduction:
    """Return what all the rows of several reductions come down to.

    Neighbours are joined, then their neighbours, and so on: the order never depends on timing.

    Args:
        reductions: At least one; all with the same columns and joints.

    Returns:
        The reduction.

    Raises:
        DataError: If there is none, or their columns or joints differ.
    """
    if not reductions:
        raise DataError("no reduction was given; at least one log is needed")
    level = list(reductions)
    while len(level) > 1:
        level = [_join_neighbours(level[k : k + 2]) for k in range(0, len(level), 2)]
    return level[0]


def _join_neighbours(reductions: Sequence[Reduction]) -> Reduction:
    """Return what one or two reductions come down to."""
    if len(reductions) == 1:
        return reductions[0]
    return Reduction(
        merge([r.factors for r in reductions]),
        np.sum([r.squares for r in reductions], axis=0),
        sum(r.samples for r in reductions),
    )


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
