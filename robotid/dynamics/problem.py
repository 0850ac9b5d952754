"""The linear problem W theta = tau as a stream of row blocks; W is never in memory as a whole."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeAlias

import numpy as np

from robotid.base.exceptions import DataError
from robotid.base.typing import Array

_SHUFFLED = 8192  # samples in the buffer of the shuffle: all of a short log, 30 MB of a long one

#: Rows of k samples: W (k n, c), tau (k n,), weight (k n,); row of sample k, joint j: k n + j.
Block: TypeAlias = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample, for recursive estimators."""

    Y: Array  # regressor, shape (n, c)
    tau: Array  # measured torque, shape (n,) [N m or N]
    weight: Array  # row weights, shape (n,); 0 excludes a row


class RowSource(ABC):
    """A problem's rows joint by joint, without columns that are zero or not selected."""

    @property
    @abstractmethod
    def samples(self) -> int:
        """Number N of samples."""

    @property
    @abstractmethod
    def is_parallel(self) -> bool:
        """Whether several threads are faster than one."""

    @property
    @abstractmethod
    def columns(self) -> tuple[Array, ...]:
        """The columns of row j, n arrays of shape (c_j,), ascending."""

    @abstractmethod
    def rows(self, start: int, stop: int) -> Array:
        """Return the number of rows with a positive weight per joint, shape (n,), int."""

    @abstractmethod
    def blocks(self, start: int, stop: int, segment: int | None = None) -> Iterator[list[Array]]:
        """Yield the rows (k, c_j + 1) of samples start to stop, a few hundred samples at a time."""

    @abstractmethod
    def select(self, columns: Array) -> "RowSource":
        """Return the same rows with fewer columns, column k being ``columns[k]`` of this one."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The rows of W theta = tau, which can be read in blocks repeatedly."""

    stream: Callable[[], Iterator[Block]]  # starts a new pass and yields the blocks in order
    names: tuple[str, ...]  # names of the c columns
    n_joints: int  # number n of rows per sample
    support: Array  # shape (n, c), bool: False where row j is zero for every motion
    sources: tuple[RowSource, ...] = ()  # the same rows joint by joint; empty: only blocks
    is_projected: bool = False  # whether constraint forces were eliminated, as of ``Factors``

    def __post_init__(self) -> None:
        wanted = (self.n_joints, len(self.names))
        if self.support.shape != wanted:
            raise DataError(f"support has shape {self.support.shape}, wanted {wanted}")

    def blocks(self) -> Iterator[Block]:
        """Yield the blocks (W (k n, c), tau (k n,), weight (k n,)) from the first one on."""
        return self.stream()

    def samples(self) -> Iterator[Sample]:
        """Yield the problem sample by sample, for recursive estimators."""
        n, c = self.n_joints, len(self.names)
        for W, tau, weight in self.blocks():
            yield from map(Sample, W.reshape(-1, n, c), tau.reshape(-1, n), weight.reshape(-1, n))

    def select(self, columns: Array) -> "Problem":
        """Return the same rows with only the given columns: columns (b,)."""

        def stream() -> Iterator[Block]:
            for W, tau, weight in self.blocks():
                yield W[:, columns], tau, weight

        names, sources = tuple(self.names[i] for i in columns), self.sources
        return replace(
            self,
            stream=stream,
            names=names,
            support=self.support[:, columns],
            sources=tuple(source.select(columns) for source in sources),
        )


def concatenate(problems: Sequence[Problem]) -> Problem:
    """Return one problem with the rows of several in order, for several logs of one robot."""
    if not problems:
        raise DataError("there is no problem, wanted that of at least one log")
    first = problems[0]
    for other in problems[1:]:
        if other.names != first.names or other.n_joints != first.n_joints:
            raise DataError(
                f"problems differ in their columns: {len(first.names)} of {first.n_joints} "
                f"joints and {len(other.names)} of {other.n_joints} joints"
            )
    has_sources = all(p.sources for p in problems)
    return replace(
        first,
        stream=lambda: chain.from_iterable(problem.blocks() for problem in problems),
        support=np.any([problem.support for problem in problems], axis=0),
        sources=tuple(source for p in problems for source in p.sources if has_sources),
    )


def shuffled(samples: Iterable[Sample], rng: np.random.Generator) -> Iterator[Sample]:
    """Yield samples in random order; those of a long stream are drawn from a buffer of 8192."""
    buffer: list[Sample] = []
    for sample in samples:
        buffer.append(sample)
        if len(buffer) > _SHUFFLED:
            k = int(rng.integers(len(buffer)))
            buffer[k], buffer[-1] = buffer[-1], buffer[k]
            yield buffer.pop()
    yield from (buffer[k] for k in rng.permutation(len(buffer)))
