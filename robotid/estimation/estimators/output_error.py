"""Output error method: parameters for which simulated outputs agree with measured ones.

The closed loop is simulated over windows; torque and acceleration need not be measured. The
residual is whitened by joint, e_t - rho e_(t-1): slow drift would mask fast effects such as a
delay.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Protocol

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, NotConvergedError
from robotid.base.tolerances import ROUNDING, TINY
from robotid.base.typing import Array, ProgressCallback, ignore_progress
from robotid.dynamics.factors import Factors, triangle_of
from robotid.estimation.estimators.estimator import (
    FEWEST_SEGMENTS,
    SEGMENTS,
    Estimate,
    Estimator,
    at_least,
    sandwich,
    scatter,
)

_CAUTIOUS = 1e-3  # damping of a step: parameters that are not identifiable do not move
_NEARLY_FREE = 1e-6  # damping of the last step, near the minimum
_SETTLED = 2e-2  # relative change of whitening and noise levels at which a fit has converged
_ROUGH, _CLOSE = 1e-3, 1e-5  # relative decrease that ends the first round, and the others
_TOO_STIFF = 1e10  # damping at which no step reduces the cost any more
_NO_TRACE = 1e-3  # effect of an initial state in noise levels below which it is neglected


@dataclass(frozen=True, eq=False)
class Residual:
    """Measured minus simulated output over one window, for k joints simulated together."""

    e: Array  # (N, k) [rad or m]
    slopes: Array | None  # (N, k, c'), derivatives of the simulated output by the parameters
    joints: Array  # (k,), indices
    columns: Array  # (c',), indices of the parameters
    by_start: Array | None = None  # (N, k, s), derivatives by the initial state of the window


class Simulator(Protocol):
    """Interface of a simulator whose outputs are compared with measured ones."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the c parameters."""

    @property
    def prior(self) -> Array:
        """Prior values, shape (c,)."""

    @property
    def prior_std(self) -> Array:
        """Prior standard deviations, shape (c,); infinite without prior knowledge."""

    @property
    def bounds(self) -> Array:
        """Lower and upper bounds, shape (2, c); infinite without a bound."""

    def residuals(
        self, theta: Array, *, with_slopes: bool, with_starts: bool = False
    ) -> Sequence[Residual]:
        """Return measured minus simulated outputs, window by window: theta (c,)."""

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return additional linearised residuals of unit weight: theta (c,) -> (m, c), (m,)."""


@dataclass(frozen=True, eq=False)
class _Weights:
    """Whitening and noise level of the residuals, by joint."""

    rho: Array  # correlation of one sample with the next [-]
    sigma: Array  # noise level of the whitened residual

    def whiten(self, x: Array, joints: Array) -> Array:
        rho, sigma = self.rho[joints], self.sigma[joints]
        if x.ndim == 3:
            rho, sigma = rho[:, None], sigma[:, None]
        return np.asarray((x[1:] - rho * x[:-1]) / sigma)


@dataclass(frozen=True, eq=False)
class OutputError(Estimator[Simulator]):
    """Least squares of a simulator's whitened residuals, with priors and bounds.

    A damped Gauss-Newton method (Levenberg, Marquardt) in rounds: the weights from the residuals,
    then the parameters, until both have converged. Ljung (1999), System identification, 4.3 and
    10.2.
    """

    reads: ClassVar[Literal["simulator"]] = "simulator"

    whitens: bool = True  # whether the residual is whitened by its estimated correlation
    #: Largest correlation of successive samples that is used, of all joints or (n,). Whitening
    #: with more than that of the loop removes the information, of offsets and gains first.
    most: Array | float = 0.95
    steps: int = 25  # largest number in a round
    rounds: int = 5  # largest number
    #: Factor of the residuals' variance for the correlation that remains after whitening. It
    #: determines the weight relative to additional rows.
    inflation: float = 1.0
    #: Whether the initial states of windows are fitted together with the parameters, to first
    #: order, in each step; needed if the loop does not correct a wrong initial state.
    frees: bool = False
    progress: ProgressCallback = field(default=ignore_progress)

    def fit(self, data: Simulator, start: Array | None = None) -> Estimate:
        """Estimate the parameters from initial values (c,), the prior if None."""
        weights, theta, how = self._minimised(data, start)
        residuals = data.residuals(theta, with_slopes=True, with_starts=True)
        return self._estimate(data, weights, theta, residuals, how)

    def minimise(self, data: Simulator, start: Array | None = None) -> Array:
        """Return the parameters of ``fit`` alone, shape (c,), without their standard errors."""
        return self._minimised(data, start)[1]

    def _minimised(
        self, simulator: Simulator, start: Array | None
    ) -> tuple[_Weights, Array, dict[str, Any]]:
        """Return the last weights, the parameters, and how they were found."""
        initial = simulator.prior if start is None else start
        theta = np.clip(np.array(initial, dtype=float), *simulator.bounds)
        residuals = self._residuals(simulator, theta)
        weights, rounds, count, converged = self._weigh(residuals, self.frees), 0, 0, False
        for rounds in range(1, self.rounds + 1):
            close = _ROUGH if rounds == 1 else _CLOSE
            theta, residuals, steps, converged = self._descend(
                simulator, weights, theta, residuals, close
            )
            count += steps
            before, weights = weights, self._weigh(residuals, self.frees)
            changes = weights.sigma / before.sigma - 1.0, weights.rho - before.rho
            if rounds > 1 and converged and np.abs(changes).max() < _SETTLED:
                break
            converged = False
        state = "converged" if converged else "not converged"
        message = f"output error, {count} steps in {rounds} rounds, {state}"
        how = {"converged": converged, "n_iter": count, "message": message}
        return weights, theta, how

    def weights(self, simulator: Simulator, theta: Array) -> "_Weights":
        """Return correlation and noise level of the residuals at parameters (c,)."""
        return self._weigh(self._residuals(simulator, theta), self.frees)

    def _residuals(self, simulator: Simulator, theta: Array) -> Sequence[Residual]:
        """Return residuals; with derivatives by the initial states only if these are free."""
        return simulator.residuals(theta, with_slopes=False, with_starts=self.frees)

    def _weigh(self, residuals: Sequence[Residual], frees: bool) -> "_Weights":
        """Return correlation and noise level of residuals, with fitted initial states if free."""
        if frees:
            residuals = [replace(r, e=_freed(r)) for r in residuals]
        n = 1 + max(int(r.joints.max()) for r in residuals)
        rho, sigma = np.zeros(n), np.ones(n)
        most = np.broadcast_to(self.most, max(n, np.size(self.most)))
        for j in range(n):
            errors = [r.e[:, k] for r in residuals for k in np.flatnonzero(r.joints == j)]
            if self.whitens:
                along = sum(float(x[1:] @ x[:-1]) for x in errors)
                rho[j] = np.clip(along / max(_squares(x[:-1] for x in errors), 1e-300), 0, most[j])
            size = sum(len(x) - 1 for x in errors)
            level = np.sqrt(_squares(x[1:] - rho[j] * x[:-1] for x in errors) / max(size, 1))
            sigma[j] = max(level, ROUNDING) * np.sqrt(self.inflation)
        return _Weights(rho, sigma)

    def _cost(
        self, simulator: Simulator, weights: _Weights, theta: Array, residuals: Sequence[Residual]
    ) -> float:
        """Return the cost of parameters with these residuals."""
        cost = 0.0
        for r in residuals:
            b = weights.whiten(r.e, r.joints).reshape(-1)
            U = _by_start(r, weights) if self.frees else np.zeros((len(b), 0))
            cost += float(b @ b) - float(np.sum((U.T @ b) ** 2))
        cost += float(np.sum(((theta - simulator.prior) / simulator.prior_std) ** 2))
        cost += float(np.sum(simulator.rows(theta)[1] ** 2))
        return cost if np.isfinite(cost) else np.inf

    def joint_step(self, simulator: Simulator, theta: Array) -> Array:
        """Return theta (c,) after a step with the initial states, or as it was if that fails."""
        H, g = self.normal(simulator, self.weights(simulator, theta), theta, frees=True)
        moved = _bounded_step(H, g, theta, simulator.bounds, _CAUTIOUS)
        try:
            self._residuals(simulator, moved)
        except NotConvergedError:
            return theta
        return moved

    def settle(self, simulator: Simulator, estimate: Estimate) -> Estimate:
        """Return the estimate after a step of it together with the windows' initial states."""
        # with initial states fixed at those of earlier parameters the fit is biased
        residuals = simulator.residuals(estimate.theta, with_slopes=True, with_starts=True)
        weights, theta = self._weigh(residuals, frees=True), estimate.theta
        how = {key: getattr(estimate, key) for key in ("converged", "n_iter", "message")}
        settled = self._estimate(simulator, weights, theta, residuals, how, moves=True)
        self._residuals(simulator, settled.theta)  # raises NotConvergedError if it fails
        return settled

    def moved(self, simulator: Simulator, other: Simulator, theta: Array) -> tuple[Array, Array]:
        """Return the first-order change of an estimate for other residuals and its errors, (c,)."""
        weights = self.weights(other, theta)
        (H, g), (_, changed) = (
            self.normal(s, weights, theta, frees=True) for s in (simulator, other)
        )
        free = ~is_at_bound(simulator, theta)
        scale = 1.0 / np.sqrt(np.diag(H)[free])
        inverse = scipy.linalg.pinvh(H[np.ix_(free, free)] * np.outer(scale, scale))
        change, error = np.zeros_like(theta), np.zeros_like(theta)
        change[free] = scale * (inverse @ (scale * (changed - g)[free]))
        error[free] = scale * np.sqrt(np.diag(inverse))
        return change, error

    def normal(
        self, simulator: Simulator, weights: _Weights, theta: Array, *, frees: bool = False
    ) -> tuple[Array, Array]:
        """Return H = A'A and A'b at theta (c,) with the prior; ``frees``: any initial states."""
        return _summed(simulator, theta, linearised(simulator, weights, theta, frees=frees))

    def _descend(
        self, simulator: Simulator, weights: _Weights, theta: Array, residuals: Sequence[Residual],
        close: float,
    ) -> tuple[Array, Sequence[Residual], int, bool]:  # fmt: skip
        """Return the minimum with fixed weights, its residuals, steps, and if it converged."""
        damping, cost = _CAUTIOUS, self._cost(simulator, weights, theta, residuals)
        if not np.isfinite(cost):
            raise NotConvergedError(
                "the simulation of the closed loop with the initial values diverges; set gains "
                "in [controller] that are closer to the drive's",
                "no start",
            )
        for step in range(1, self.steps + 1):
            self.progress("fitting loops", step, self.steps, "steps")
            H, g = self.normal(simulator, weights, theta, frees=self.frees)
            while True:
                trial = _bounded_step(H, g, theta, simulator.bounds, damping)
                left, new = residuals, np.inf
                try:
                    left = self._residuals(simulator, trial)
                    new = self._cost(simulator, weights, trial, left)
                except NotConvergedError:
                    pass  # the step is too long
                if new < cost or damping > _TOO_STIFF:
                    break
                if float(g @ (trial - theta)) < close * cost:
                    break  # the predicted decrease is negligible
                damping *= 6.0
            if not new < cost:
                return theta, residuals, step, True  # no step reduces the cost noticeably
            decrease, theta, residuals, cost = (cost - new) / cost, trial, left, new
            damping = max(damping / 6.0, 1e-9)
            if decrease < close:
                return theta, residuals, step, True
        return theta, residuals, self.steps, False

    def _estimate(
        self, simulator: Simulator, weights: _Weights, theta: Array, residuals: Sequence[Residual],
        how: Mapping[str, Any], *, moves: bool = False,
    ) -> Estimate:  # fmt: skip
        """Return the estimate, after a step if it ``moves``; errors are from scores of segments."""
        parts = list(_whitened(residuals, weights, frees=True))
        rows = sum(r.e.size for r in residuals)
        if rows < len(theta):
            raise DataError(
                f"{rows} samples of position for {len(theta)} parameters, expected at least as "
                "many samples as parameters; record a longer motion"
            )
        H, g = _summed(simulator, theta, parts)
        change = np.zeros_like(theta)
        if moves:
            change = _bounded_step(H, g, theta, simulator.bounds, _NEARLY_FREE) - theta
        precision = 1.0 / simulator.prior_std**2
        scale = 1.0 / np.sqrt(np.diag(H))
        values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
        bread = (vectors / np.maximum(values, 1e-13)) @ vectors.T * np.outer(scale, scale)
        segments = _segments(parts, len(theta), are_windows=self.frees)
        meat, inflation, freedom = H - np.diag(precision), 1.0, np.full(len(theta), np.inf)
        if len(segments) >= FEWEST_SEGMENTS:
            scores = scatter(segments, change, np.ones(1), bread)
            inflation, freedom = scores.inflation, scores.freedom()
            further = simulator.rows(theta)[0]
            meat = scores.meat + further.T @ further
        # standard errors are at least those for independent rows
        independent = np.diag(bread @ H @ bread.T)
        gained = 1.0 - independent * precision  # relative reduction of each prior variance
        names, theta = np.array(simulator.names), theta + change
        undetermined = tuple(names[gained < TINY].tolist())
        at_bound = tuple(names[is_at_bound(simulator, theta)].tolist())
        return Estimate(
            theta=theta,
            covariance=at_least(sandwich(bread, meat + np.diag(precision)), independent),
            names=simulator.names,
            sigma=weights.sigma / np.sqrt(self.inflation),
            rank=len(theta) - len(undetermined),
            condition=float(np.sqrt(values[-1] / max(values[0], 1e-300))),
            undetermined=undetermined,
            prior_std=simulator.prior_std,
            details={
                "correlation": weights.rho, "inflation": inflation * self.inflation,
                "freedom": freedom, "at_bound": at_bound,
            },
            **how,
        )  # fmt: skip


def _summed(
    simulator: Simulator, theta: Array, parts: Iterable[tuple[Array, Array, Array]]
) -> tuple[Array, Array]:
    """Return H = A'A and A'b of linearised rows, additional rows and the prior included."""
    precision = 1.0 / simulator.prior_std**2
    H, g = np.diag(precision), precision * (simulator.prior - theta)
    for A, b, columns in parts:
        H[np.ix_(columns, columns)] += A.T @ A
        g[columns] += A.T @ b
    A, b = simulator.rows(theta)
    return H + A.T @ A, g + A.T @ b


def _squares(arrays: Iterable[Array]) -> float:
    return float(sum((x * x).sum() for x in arrays))


def linearised(
    simulator: Simulator, weights: _Weights, theta: Array, *, frees: bool = False
) -> Iterable[tuple[Array, Array, Array]]:
    """Yield whitened rows A, b and the indices of their columns, window by window: theta (c,)."""
    residuals = simulator.residuals(theta, with_slopes=True, with_starts=frees)
    yield from _whitened(residuals, weights, frees=frees)


def segment_scores(simulator: Simulator, estimate: Estimate) -> tuple[Array, Array]:
    """Return A'A (s, c, c) and A'b (s, c) of whitened residuals by window, initial states free."""
    weights = _Weights(estimate.details["correlation"], estimate.sigma)
    parts = list(linearised(simulator, weights, estimate.theta, frees=True))
    H = np.zeros((len(parts), len(estimate.theta), len(estimate.theta)))
    g = np.zeros(H.shape[:2])
    for k, (A, b, columns) in enumerate(parts):
        H[k][np.ix_(columns, columns)] = A.T @ A
        g[k, columns] = A.T @ b
    return H, g


def _whitened(
    residuals: Iterable[Residual], weights: _Weights, *, frees: bool
) -> Iterable[tuple[Array, Array, Array]]:
    """Yield the whitened rows of residuals; see ``linearised``."""
    for r in residuals:
        b = weights.whiten(r.e, r.joints)
        if r.slopes is None:
            raise DataError("the simulator returned no derivatives, expected with_slopes=True")
        A = weights.whiten(r.slopes, r.joints).reshape(b.size, -1)
        b = b.reshape(-1)
        if frees:
            U = _by_start(r, weights)
            A, b = A - U @ (U.T @ A), b - U @ (U.T @ b)
        yield A, b, r.columns


def _by_start(r: Residual, weights: _Weights) -> Array:
    """Return an orthonormal basis of the effect of a window's initial state on whitened rows."""
    if r.by_start is None:
        return np.zeros((r.e[1:].size, 0))
    G = weights.whiten(r.by_start, r.joints).reshape(r.e[1:].size, -1)
    U, sizes, _ = np.linalg.svd(G, full_matrices=False)
    return np.asarray(U[:, sizes > _NO_TRACE])


def _freed(r: Residual) -> Array:
    """Return a residual after a fit of the initial state, joints weighted by their RMS residual."""
    if r.by_start is None:
        return r.e
    size = np.maximum(np.sqrt(np.mean(r.e**2, axis=0)), 1e-12)
    G = (r.by_start / size[:, None]).reshape(r.e.size, -1)
    moved = G @ np.linalg.lstsq(G, (r.e / size).reshape(-1), rcond=None)[0]
    return np.asarray(r.e - size * moved.reshape(r.e.shape))


def is_at_bound(simulator: Simulator, theta: Array) -> Array:
    """Return which parameters are at a bound, shape (c,), bool: theta (c,)."""
    lowest, highest = simulator.bounds
    return np.asarray((theta <= lowest) | (theta >= highest))


def _bounded_step(H: Array, g: Array, theta: Array, bounds: Array, damping: float) -> Array:
    """Return the parameters after a damped step, limited to their bounds."""
    lowest, highest = bounds
    scale = 1.0 / np.sqrt(np.diag(H))
    H = H * np.outer(scale, scale) + damping * np.eye(len(H))  # its condition, not that of units
    free = ((theta > lowest) | (g > 0)) & ((theta < highest) | (g < 0))
    trial = theta.copy()
    while free.any():
        step = scipy.linalg.solve(H[np.ix_(free, free)], (scale * g)[free], assume_a="pos")
        trial[free] = theta[free] + scale[free] * step
        outside = free & ((trial < lowest) | (trial > highest))
        if not outside.any():
            break
        trial[outside] = np.clip(trial, lowest, highest)[outside]
        g = g - H[:, outside] @ ((trial - theta) / scale)[outside] / scale
        free = free & ~outside
    return trial


def _segments(
    parts: Sequence[tuple[Array, Array, Array]], c: int, *, are_windows: bool
) -> list[Factors]:
    """Return the factors of the whitened rows of c parameters, segment by segment."""
    # about one for each window if ``are_windows``: without feedback an error persists to its end
    total, names = sum(len(b) for _, b, _ in parts), tuple(map(str, range(c)))
    segments: list[Factors] = []
    for A, b, columns in parts:
        cuts = max(1, round(SEGMENTS * len(b) / total))
        if are_windows:
            cuts = math.ceil(FEWEST_SEGMENTS / len(parts))
        for rows in np.array_split(np.arange(len(b)), cuts):
            triangle = triangle_of(np.column_stack([A[rows], b[rows]]))
            segments.append(Factors((triangle,), (columns,), np.array([len(rows)]), names))
    return segments
