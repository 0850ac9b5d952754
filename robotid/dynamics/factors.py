"""The linear problem W theta = tau as a stream of row blocks, and one triangular factor per joint.

W is never in memory as a whole. Fits need only the triangular factor R_j of each joint's rows, with
R_j^T R_j = [W_j tau_j]^T [W_j tau_j]; those of two logs merge. Rows are folded in place by LAPACK's
dtpqrt, the QR of [R; rows] without the zeros of R, through the address of SciPy's own LAPACK: it
copies nothing and releases the interpreter's lock. Without it, SciPy's wrapper is used.
"""

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import chain, pairwise
from typing import TypeAlias

import numpy as np
import scipy.linalg.cython_lapack
import scipy.linalg.lapack

from robotid.base.cores import in_order
from robotid.base.exceptions import DataError
from robotid.base.typing import Array

_PART = 16384  # samples per part: merging costs little, and there are enough parts for threads
PANEL = 8  # columns eliminated at a time: measured fastest for 20 to 70 columns ...
_WIDE, _WIDE_PANEL = 200, 24  # ... and from so many columns on, which exceed a cache
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

        names = tuple(self.names[i] for i in columns)
        sources = tuple(source.select(columns) for source in self.sources)
        return replace(
            self, stream=stream, names=names, support=self.support[:, columns], sources=sources
        )


def concatenate(problems: Sequence[Problem]) -> Problem:
    """Return one problem with the rows of several in order, for several logs of one robot."""
    if not problems:
        raise DataError("there is no problem, expected at least one log")
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


@dataclass(frozen=True, eq=False)
class Factors:
    """Triangular factors of [W_j tau_j], joint by joint, each with its own columns."""

    triangles: tuple[Array, ...]  # upper triangular factors, n arrays of shape (c_j + 1, c_j + 1)
    columns: tuple[Array, ...]  # the columns of joint j, n arrays of shape (c_j,), ascending
    rows: Array  # number of rows folded in per joint, shape (n,), int
    names: tuple[str, ...]  # names of the c columns
    is_projected: bool = False  # without constraint forces: rows are mixed, with one noise level

    @property
    def R(self) -> Array:
        """The factors over all c columns, shape (n, c + 1, c + 1), 0 for columns not of a joint."""
        size = len(self.names) + 1
        dense = np.zeros((len(self.triangles), size, size))
        for R, (triangle, columns) in zip(dense, self._joints(), strict=True):
            places = np.append(columns, size - 1)
            R[np.ix_(places, places)] = triangle
        return dense

    def select(self, columns: Array) -> "Factors":
        """Return the factors of the same rows with fewer columns: columns (b,)."""
        columns = np.asarray(columns, dtype=int)
        triangles, remaining = [], []
        for triangle, of_joint in self._joints():
            remaining.append(np.flatnonzero(np.isin(columns, of_joint)))
            places = np.append(np.searchsorted(of_joint, columns[remaining[-1]]), len(of_joint))
            triangles.append(triangle_of(triangle[:, places]))
        names = tuple(self.names[i] for i in columns)
        return replace(self, triangles=tuple(triangles), columns=tuple(remaining), names=names)

    def weighted(self, sigma: Array) -> Array:
        """Return one factor, shape (c + 1, c + 1), of all joints' rows [W_j tau_j] / sigma_j."""
        total = Triangle(len(self.names) + 1)
        for (triangle, columns), level in zip(self._joints(), sigma, strict=True):
            total.fold_triangle(triangle / level, np.append(columns, len(self.names)))
        return total.R

    def weighted_rows(self, theta: Array, sigma: Array) -> tuple[Array, Array]:
        """Return rows W_j / sigma_j and (tau_j - W_j theta) / sigma_j that have these factors."""
        ends = np.cumsum([len(R) for R in self.triangles])
        W, residual = np.zeros((ends[-1], len(self.names))), np.empty(ends[-1])
        for (R, columns), level, end in zip(self._joints(), sigma, ends, strict=True):
            rows = slice(end - len(R), end)
            W[rows, columns] = R[:, :-1] / level
            residual[rows] = R[:, -1] / level - W[rows, columns] @ theta[columns]
        return W, residual

    def residual_squares(self, theta: Array) -> Array:
        """Return |tau_j - W_j theta|^2 of each joint, shape (n,) [(N m)^2 or N^2]: theta (c,)."""
        return np.array([residual @ residual for residual in self._residuals(theta)])

    def score(self, theta: Array, weights: Array) -> Array:
        """Return sum_j weight_j W_j^T (tau_j - W_j theta), shape (c,): theta (c,), weights (n,)."""
        total = np.zeros(len(self.names))
        parts = zip(self._joints(), self._residuals(theta), weights, strict=True)
        for (R, columns), residual, weight in parts:
            total[columns] += weight * (R[:, :-1].T @ residual)
        return total

    def without(self, theta: Array) -> "Factors":
        """Return the factors of the same rows with the torque tau_j - W_j theta: theta (c,)."""
        triangles = tuple(R.copy(order="K") for R in self.triangles)
        for triangle, residual in zip(triangles, self._residuals(theta), strict=True):
            triangle[:, -1] = residual
        return replace(self, triangles=triangles)

    def noise_levels(self, theta: Array, freedom: Array) -> Array:
        """Return the standard deviation of each joint's residual, with its freedom, shape (n,)."""
        squares = self.residual_squares(theta)
        if self.is_projected:
            squares, freedom = (np.full(len(x), x.sum()) for x in (squares, freedom))
        return np.asarray(np.sqrt(squares / freedom))

    def torque_squares(self) -> Array:
        """Return the sum of squared torques |tau_j|^2, shape (n,) [(N m)^2 or N^2]."""
        return np.array([R[:, -1] @ R[:, -1] for R in self.triangles])

    def information(self, weights: Array) -> Array:
        """Return sum_j weight_j W_j^T W_j, shape (c, c): weights (n,)."""
        total = np.zeros((len(self.names), len(self.names)))
        for (R, columns), weight in zip(self._joints(), weights, strict=True):
            total[np.ix_(columns, columns)] += weight * (R[:, :-1].T @ R[:, :-1])
        return total

    def leverages(self, covariance: Array) -> Array:
        """Return the trace of W_j C W_j^T for each joint, shape (n,): covariance (c, c)."""
        pairs = [(R[:, :-1], covariance[np.ix_(columns, columns)]) for R, columns in self._joints()]
        return np.array([np.vdot(A @ C, A) for A, C in pairs])

    def _joints(self) -> Iterator[tuple[Array, Array]]:
        """Yield factor and columns of each joint."""
        return zip(self.triangles, self.columns, strict=True)

    def _residuals(self, theta: Array) -> Iterator[Array]:
        """Yield tau_j - W_j theta of the rows of each factor."""
        return (R[:, -1] - R[:, :-1] @ theta[columns] for R, columns in self._joints())


@dataclass(frozen=True, eq=False)
class Reduction:
    """The reduction of the rows of one piece of a log, or of several."""

    factors: Factors
    squares: Array  # sums of tau^2, v^2 and a^2 over all samples, used or not, shape (3, n_rows)
    samples: int  # number of these samples


def compress(problem: Problem, *, threads: int | None = None) -> Factors:
    """Fold a problem into factors, in parts of one size (Demmel, Grigori, Hoemmen, Langou 2012)."""
    columns = [np.flatnonzero(row) for row in problem.support]
    triangles = [Triangle(len(joint_columns) + 1) for joint_columns in columns]
    for source in problem.sources:
        places = _places(source, columns)
        for part in _folded(source, _PART, _PART, threads):
            for triangle, place, R_j in zip(triangles, places, part, strict=True):
                triangle.fold_triangle(R_j, place)
    if problem.sources:
        rows = np.sum([source.rows(0, source.samples) for source in problem.sources], axis=0)
    else:
        rows = _fold_blocks(triangles, columns, problem)
    return _factors_of([triangle.R for triangle in triangles], columns, rows, problem)


def _factors_of(
    triangles: Sequence[Array], columns: Sequence[Array], rows: Array, problem: Problem
) -> Factors:
    """Return the factors of some rows of a problem; R is not finite if a row is not."""
    if not all(np.isfinite(R).all() for R in triangles):
        raise DataError("the problem has a row that is not finite; check the trajectory")
    return Factors(tuple(triangles), tuple(columns), rows, problem.names, problem.is_projected)


def compress_segments(problem: Problem, length: int) -> tuple[Factors, ...]:
    """Fold each segment of a problem into its own factors, for held-out segments."""
    if not problem.sources:
        raise DataError("the problem has blocks only, expected row sources to cut into segments")
    columns = tuple(np.flatnonzero(row) for row in problem.support)
    part = -(-_PART // length) * length  # whole segments
    segments = []
    for source in problem.sources:
        places, starts = _places(source, columns), range(0, source.samples, length)
        for start, triangles in zip(starts, _folded(source, part, length, None), strict=True):
            rows = source.rows(start, min(start + length, source.samples))
            placed = []
            for R, place, wanted in zip(triangles, places, columns, strict=True):
                total = Triangle(len(wanted) + 1)
                total.fold_triangle(R, place)
                placed.append(total.R)
            segments.append(_factors_of(placed, columns, rows, problem))
    return tuple(segments)


def merge(factors: Sequence[Factors]) -> Factors:
    """Return the factors of all rows of several logs."""
    if not factors:
        raise DataError("there are no factors, expected at least one log")
    first = factors[0]
    for other in factors[1:]:
        if other.names != first.names or len(other.rows) != len(first.rows):
            sizes = (f"{len(x.rows)} joints x {len(x.names)} columns" for x in (first, other))
            raise DataError(f"factors differ: {' and '.join(sizes)}")
    triangles, columns = [], []
    for j in range(len(first.rows)):
        union = np.unique(np.concatenate([f.columns[j] for f in factors]))
        total = Triangle(len(union) + 1)
        for f in factors:
            places = np.append(np.searchsorted(union, f.columns[j]), len(union))
            total.fold_triangle(f.triangles[j], places)
        triangles.append(total.R)
        columns.append(union)
    rows = np.sum([f.rows for f in factors], axis=0)
    return replace(first, triangles=tuple(triangles), columns=tuple(columns), rows=rows)


def gather(segments: Sequence[Factors], count: int) -> tuple[Factors, ...]:
    """Return fewer, longer segments: neighbours are merged, for held-out segments."""
    edges = np.linspace(0, len(segments), min(count, len(segments)) + 1).round().astype(int)
    return tuple(merge(segments[i:j]) for i, j in pairwise(edges))


def join(reductions: Sequence[Reduction]) -> Reduction:
    """Return the reduction of all rows of several reductions."""
    return Reduction(
        merge([r.factors for r in reductions]),
        np.sum([r.squares for r in reductions], axis=0),
        sum(r.samples for r in reductions),
    )


def join_segments(reductions: Iterable[Reduction], count: int, most: int) -> list[Reduction]:
    """Return reductions of at most so many segments, joined one by one to limit the memory."""
    length = -(-count // most)
    segments: list[Reduction] = []
    for k, reduction in enumerate(reductions):
        if k % length:
            segments[-1] = join([segments[-1], reduction])
        else:
            segments.append(reduction)
    return segments


class Triangle:
    """A triangular factor into which rows are folded, in place: it is the innermost loop."""

    def __init__(self, columns: int) -> None:
        """Initialise for rows of so many columns."""
        self.R = np.zeros((columns, columns), order="F")  # of all rows so far; read only
        self._is_empty = True
        self._panel = PANEL if columns < _WIDE else _WIDE_PANEL
        # 8 sizes of C's int: m, n, l, nb, lda, ldb, ldt, info; then T and work
        self._scratch = np.empty(4 + 2 * self._panel * columns)
        self._sizes = self._scratch[:4].view(np.intc)
        self._sizes[[4, 6]] = columns, self._panel

    def fold_triangle(self, other: Array, places: Array) -> None:
        """Replace R by the triangular factor of [R; other], with places of its columns."""
        if len(places) == len(self.R):
            if self._is_empty:
                self.R[:], self._is_empty = other, False
            else:
                self.fold(other.copy(order="F"), 0, len(other))
            return
        first = int(places[0])
        rows = np.zeros((len(places), len(self.R) - first), order="F")
        rows[:, places - first] = other
        self.fold(rows, first, len(rows))

    def fold(self, rows: Array, first: int = 0, triangular: int = 0) -> None:
        """Replace R by the factor of [R; rows] from a column on (Golub, Van Loan 2013, 6.5.3)."""
        if len(rows) == 0:
            return
        self._is_empty = False
        call, width, panel = _dtpqrt(), rows.shape[1], min(self._panel, rows.shape[1])
        if call is None:
            corner = self.R[first:, first:]
            corner[:] = scipy.linalg.lapack.dtpqrt(triangular, panel, corner, rows)[0]
            return
        self._sizes[:4] = len(rows), width, triangular, panel
        self._sizes[5] = max(len(rows), rows.strides[1] // rows.itemsize)
        addresses = self._addresses.copy()
        addresses[4] += first * (len(self.R) + 1) * self.R.itemsize
        addresses[6] = rows.ctypes.data
        call(*addresses)

    @cached_property
    def _addresses(self) -> list[int]:
        """Addresses of m, n, l, nb, A, lda, B, ldb, T, ldt, work and info."""
        R, sizes = self.R.ctypes.data, self._scratch.ctypes.data
        T, end = sizes + self._sizes.nbytes, sizes + self._scratch.nbytes
        m, n, pentagon, nb, lda, ldb, ldt, info = range(sizes, T, self._sizes.itemsize)
        return [m, n, pentagon, nb, R, lda, 0, ldb, T, ldt, (T + end) // 2, info]


@cache
def _dtpqrt() -> Callable[..., None] | None:
    """Return LAPACK's dtpqrt, or None if the integers of SciPy's LAPACK are not C's int."""
    capsule = scipy.linalg.cython_lapack.__pyx_capi__.get("dtpqrt")
    if capsule is None:
        return None
    name_of, pointer_of = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name_of.restype, name_of.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer_of.restype, pointer_of.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = name_of(capsule)
    if signature is None or not signature.startswith(b"void (int *, int *, int *, int *,"):
        return None
    prototype = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 12)
    return prototype(pointer_of(capsule, signature))


def _fold_blocks(
    triangles: Sequence[Triangle], columns: Sequence[Array], problem: Problem
) -> Array:
    """Fold whole blocks into the factors; return the number of rows per joint."""
    n, rows = problem.n_joints, np.zeros(problem.n_joints, dtype=int)
    for W, tau, weight in problem.blocks():
        by_joint, torque = W.reshape(-1, n, W.shape[1]), tau.reshape(-1, n)
        root = np.sqrt(weight).reshape(-1, n)
        rows += (root > 0).sum(axis=0)
        for j, joint_columns in enumerate(columns):
            used = np.flatnonzero(root[:, j] != 0)  # NaN counts as used: it appears in R
            scaled = np.empty((len(used), len(joint_columns) + 1), order="F")
            scaled[:, :-1] = by_joint[used, j][:, joint_columns]
            scaled[:, -1] = torque[used, j]
            scaled *= root[used, j, None]
            triangles[j].fold(scaled)
    return rows


def _places(source: RowSource, columns: Sequence[Array]) -> list[Array]:
    """Return the places of each row's columns, and of its torque, among the wanted columns."""
    return [
        np.append(np.searchsorted(wanted, present), len(wanted))
        for wanted, present in zip(columns, source.columns, strict=True)
    ]


def _folded(
    source: RowSource, length: int, segment: int, threads: int | None
) -> Iterator[list[Array]]:
    """Yield the factors of each segment of a source, computed in parts of so many samples."""
    starts, fold = range(0, source.samples, length), partial(_fold_part, source, length, segment)
    parts = in_order(fold, starts, is_parallel=source.is_parallel, threads=threads)
    return chain.from_iterable(parts)


def _fold_part(source: RowSource, length: int, segment: int, start: int) -> list[list[Array]]:
    """Return the factors of each segment of a part of so many samples, joint by joint."""
    folded, done = list[list[Triangle]](), 0
    for block in source.blocks(start, min(start + length, source.samples), segment):
        if done % segment == 0:
            folded.append([Triangle(len(columns) + 1) for columns in source.columns])
        done += len(block[0])
        for triangle, rows in zip(folded[-1], block, strict=True):
            triangle.fold(rows)
    return [[triangle.R for triangle in triangles] for triangles in folded]


def triangle_of(rows: Array) -> Array:
    """Return the square upper triangular factor R of rows (m, k), with zeros below if m < k."""
    k, filled = rows.shape[1], min(rows.shape)
    R = np.zeros((k, k))
    if len(rows):
        packed = scipy.linalg.lapack.dgeqrf(np.asfortranarray(rows), overwrite_a=True)[0]
        R[:filled] = np.triu(packed[:filled])
    return R
