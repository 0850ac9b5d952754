"""What the gradient methods share: state, column scaling, passes in random order, estimate.

They work in scaled parameters x = scale theta, where every column has unit norm; their residual is
e = Psi P^ - tau, the paper's sign.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from robotid._typing import Array
from robotid.estimators.estimator import Estimate, require_rows
from robotid.estimators.recursive.base import scaled_rows
from robotid.exceptions import DataError
from robotid.regressor.problem import Problem, Sample, shuffled

__all__ = [
    "DescentState",
    "Rows",
    "advance",
    "column_scale",
    "descent_estimate",
    "is_zero",
    "run_passes",
    "start_state",
]

#: Rows of a sample: all, or the indices of those of positive weight.
Rows: TypeAlias = slice | Array
#: Change of x from Psi (k, c), e (k,) and the rows, all in units of their noise.
Step: TypeAlias = Callable[[Array, Array, Rows], Array]

_AVERAGE = 3.0  # weight of the newest iterate: 3 / (k + 2), so that the start fades as k^-3
_MEMORY = 1000.0  # [samples] over which PRX and the residuals are averaged
_SILENT = 1e-9  # columns smaller than this share of the largest are not scaled up
_GAIN = 0.01  # a pass that makes the squared residual smaller by less brings nothing more
_ZERO = 2.0  # a mean PRX below this many of its standard errors is 0


@dataclass(frozen=True, eq=False)
class DescentState:
    """What a gradient method knows.

    Attributes:
        x: Scaled parameters, shape (c,).
        mean: Average of the iterates, shape (c,).
        prx: Recent mean of PRX (23) at the estimate, shape (c,), in scaled parameters.
        prx_square: Recent mean of its squared norm.
        squares: Recent mean of the squared residual per joint, shape (n,) [(N m)^2 or N^2].
        steps: Number of samples seen.
        skipped: Number of samples without information, |Psi|^2 <= eps2.
        rows: Number of rows taken.
    """

    x: Array
    mean: Array
    prx: Array
    prx_square: float
    squares: Array
    steps: int
    skipped: int
    rows: int


def column_scale(problem: Problem, sigma: Array) -> Array:
    """Return the root mean square of each column, rows in units of their noise.

    Scaled by it, all columns have the same norm. A column without data keeps 1.

    Args:
        problem: The rows.
        sigma: Noise level of each joint, shape (n,) [N m or N].

    Returns:
        Scaled parameters per parameter, shape (c,), positive.

    Raises:
        DataError: If a row is not finite.
    """
    n, c = problem.n_joints, len(problem.names)
    squares, count = np.zeros(c), 0
    for W, _, weight in problem.blocks():
        row_weight = (weight.reshape(-1, n) / sigma**2).reshape(-1)
        squares += row_weight @ np.where(row_weight[:, None] > 0, W, 0.0) ** 2
        count += len(W) // n
    if not np.isfinite(squares).all():
        raise DataError("the problem holds a row that is not finite; check the trajectory")
    rms = np.sqrt(squares / max(count, 1))
    return np.where(rms > _SILENT * rms.max(initial=0.0), rms, 1.0)


def start_state(c: int, n: int, prior: Array | None, scale: Array | None) -> DescentState:
    """Return the state before any sample.

    Args:
        c: Number of parameters.
        n: Rows per sample.
        prior: Parameters to start from, shape (c,); 0 if None.
        scale: Scaled parameters per parameter, shape (c,); 1 if None.

    Returns:
        The state.
    """
    x = np.zeros(c) if prior is None else prior * (1.0 if scale is None else scale)
    return DescentState(x, x, np.zeros(c), 0.0, np.zeros(n), 0, 0, 0)


def advance(
    state: DescentState,
    sample: Sample,
    sigma: Array,
    scale: Array | None,
    step: Step,
    *,
    average: bool,
    eps2: float,
) -> DescentState:
    """Return the state after one more sample.

    Args:
        state: The state before.
        sample: One instant; rows of weight 0 are skipped.
        sigma: Noise level of each joint, shape (n,) [N m or N].
        scale: Scaled parameters per parameter, shape (c,); 1 if None.
        step: Change of x from (Psi (k, c), e (k,), rows (k,)): rows in units of their noise.
        average: Whether the estimate is the average of the iterates.
        eps2: A sample with |Psi|^2 <= eps2 is skipped.

    Returns:
        The state after.

    Raises:
        DataError: If the sample is not finite or of another shape.
    """
    c = len(state.x)
    rows = scaled_rows(sample, sigma, c)  # (k, c + 1)
    Psi, tau = rows[:, :c], rows[:, c]
    if scale is not None:
        Psi = Psi / scale
    steps = state.steps + 1
    if np.vdot(Psi, Psi) <= eps2:
        return replace(state, steps=steps, skipped=state.skipped + 1)
    # all rows at once is the usual case, and a slice is cheap
    used = slice(None) if len(rows) == len(sigma) else np.flatnonzero(sample.weight)
    x = state.x - step(Psi, Psi @ state.x - tau, used)
    mean = state.mean + (x - state.mean) * (_AVERAGE / (steps + _AVERAGE - 1)) if average else x
    # how good the estimate was for this sample, before the sample changed it
    e = Psi @ state.mean - tau
    prx = e @ Psi  # (23), (4): Psi^T (Psi P^ - u)
    share = 1.0 / min(steps, _MEMORY)
    squares = state.squares.copy()
    squares[used] += share * (e**2 * sigma[used] ** 2 / sample.weight[used] - squares[used])
    return DescentState(
        x,
        mean,
        state.prx + share * (prx - state.prx),
        state.prx_square + share * (float(prx @ prx) - state.prx_square),
        squares,
        steps,
        state.skipped,
        state.rows + len(rows),
    )


def is_zero(state: DescentState, eps1: float) -> bool:
    """Return whether PRX = 0: within eps1, or within what its own scatter leaves open.

    Args:
        state: The state.
        eps1: Bound on the norm of PRX in scaled parameters, rows in units of their noise.

    Returns:
        Whether the recent mean of PRX is 0, (25).
    """
    if state.steps < _MEMORY:
        return False
    norm = float(np.linalg.norm(state.prx))
    standard_error = np.sqrt(state.prx_square / (2 * _MEMORY))
    return norm <= eps1 or norm <= _ZERO * standard_error


def run_passes(
    update: Callable[[DescentState, Sample], DescentState],
    state: DescentState,
    problem: Problem,
    sigma: Array,
    *,
    passes: int,
    rng: np.random.Generator | None,
    eps1: float,
) -> tuple[DescentState, bool]:
    """Return the state after several passes over a problem, or once PRX = 0.

    What scatters about 0 only counts as 0 if the last pass has not made the residual any smaller.

    Args:
        update: One step.
        state: The state before.
        problem: The samples.
        sigma: Noise level of each joint, shape (n,) [N m or N].
        passes: Largest number of passes.
        rng: Source of the random order; in the order of time if None.
        eps1: Bound for PRX = 0.

    Returns:
        The state after, and whether PRX = 0 there.

    Raises:
        DataError: If there are fewer rows than parameters, or a sample is not finite.
    """
    for _ in range(passes):
        before = float(np.sum(state.squares / sigma**2))
        samples = problem.samples() if rng is None else shuffled(problem.samples(), rng)
        for sample in samples:
            state = update(state, sample)
        require_rows(state.rows, len(problem.names), problem.n_joints)
        gain = 1.0 - float(np.sum(state.squares / sigma**2)) / before if before > 0 else 1.0
        is_small = float(np.linalg.norm(state.prx)) <= eps1
        if is_small or (is_zero(state, eps1) and gain < _GAIN):
            return state, True
    return state, False


def descent_estimate(
    state: DescentState, scale: Array | None, names: tuple[str, ...], eps1: float
) -> Estimate:
    """Return the estimate of a gradient method.

    Args:
        state: The state.
        scale: Scaled parameters per parameter, shape (c,); 1 if None.
        names: Names of the c parameters.
        eps1: Bound for PRX = 0.

    Returns:
        The estimate. A gradient method does not learn how uncertain it is: its covariance is
        infinite, and its rank and condition number are unknown.
    """
    c = len(names)
    prx = float(np.linalg.norm(state.prx))
    return Estimate(
        theta=state.mean / (1.0 if scale is None else scale),
        covariance=np.full((c, c), np.inf),
        names=names,
        sigma=np.sqrt(state.squares),
        rank=c,
        condition=float("inf"),
        undetermined=(),
        converged=is_zero(state, eps1),
        n_iter=state.steps,
        message=f"{state.steps} steps, {state.skipped} without information, |PRX| = {prx:.3g}; "
        "a gradient method does not know its covariance, so it is stated as infinite",
    )
