"""Physically consistent fit: a convex programme on the triangular factors, any data and weight."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, NotConvergedError, SettingsError
from robotid.base.findings import listed
from robotid.base.tolerances import NOISE_FREE, SLACK
from robotid.base.typing import Array
from robotid.dynamics.factors import Factors, Triangle, merge
from robotid.estimation.estimators.batch import WLS, solve_factor
from robotid.estimation.estimators.determination import base_spread, determine
from robotid.estimation.estimators.estimator import (
    ALIKE,
    LEAST_FREEDOM,
    MOST_EXPLAINED,
    BatchEstimator,
    Estimate,
)
from robotid.estimation.estimators.interior_point import (
    Bounds,
    Entropic,
    Minimum,
    Programme,
    Subspace,
)
from robotid.robot.parameters import ParameterLayout, pseudo_inertia, pseudo_inertia_basis

_ACTIVE = 1e-5  # slack below which a constraint is active, dimensionless
_OPEN = (0.0, np.inf)  # [kg]

_SMALLEST, _LARGEST = -4.0, 2.0  # decades of the weights tried
_USUAL = -1.0  # at smaller entropic weights bodies become thin, and fits converge slowly
_PATIENCE = 2  # decades without a better score after which the search ends
_MOST_LOSS = 1.02  # largest ratio of the held-out errors of a larger weight, mean over joints
_MOST_JOINT_LOSS = 1.05  # ... and of any one joint
AS_GOOD = 1.1  # largest ratio of the held-out error of a joint to that of least squares
_BEYOND = 4.0  # standard errors by which a body must be outside its box
_REESTIMATED = 8  # largest number of steps of the plausible weight
_EXPECTED = (0.5, 1.02)  # distances from the prior over the expected one at which they end
_STEP = 0.5  # decades between the best weight and the refined ones


@dataclass(frozen=True, eq=False)
class Constraints:
    """Bounds in addition to consistency, by name of the body that a joint moves, in its frame."""

    mass: dict[str, tuple[float, float]] = field(default_factory=dict)  # smallest, largest [kg]
    total_mass: tuple[float, float] | None = None  # of all bodies together [kg]
    com: dict[str, tuple[Array, Array]] = field(default_factory=dict)  # A c <= b, (k, 3), (k,) [m]
    pinned: tuple[str, ...] = ()  # bodies that keep the prior's values
    extent: dict[str, Array] = field(default_factory=dict)  # box of all mass, (2, 3) [m]
    relaxed: tuple[str, ...] = ()  # bodies whose extent was removed: the data contradict it

    def check(self, layout: ParameterLayout, prior: Array, held: Array) -> None:
        """Refuse unknown bodies and bounds that contradict each other, before the solver runs."""
        known = {*self.mass, *self.com, *self.extent, *self.pinned}
        unknown = sorted(known - set(layout.bodies))
        if unknown:
            raise SettingsError(
                f"constraints name {unknown}, which are not bodies of the model, expected names of "
                f"{listed(layout.bodies)}; links connected by fixed joints are part of the body "
                "that a joint moves"
            )
        values = prior[: layout.n_inertial].reshape(-1, 10)
        parts = held.reshape(-1, 10)
        for body, bounds in self.mass.items():
            _check_range(f"mass of {body}", *bounds)
            part = parts[layout.bodies.index(body), 0]
            if bounds[1] < part:
                raise SettingsError(
                    f"mass of {body} is at most {bounds[1]:g} kg by its bound, but its links on "
                    f"locked joints alone have {part:g} kg; increase the bound"
                )
        for i in map(layout.bodies.index, self.pinned):
            self._check_pinned(layout.bodies[i], values[i], parts[i])
        if self.total_mass is not None:
            self._check_total(self.total_mass, dict(zip(layout.bodies, values[:, 0], strict=True)))

    def bounds(self, layout: ParameterLayout, scale: Array) -> Bounds:
        """Return signs of drives and ranges as rows of x = pi / scale, without pinned bodies."""
        p = len(layout.names)
        signs = np.flatnonzero(layout.is_nonnegative())
        labels = [f"drive_signs {layout.names[i]}" for i in signs]
        G, h = [np.eye(p)[signs]], [np.full(len(signs), -SLACK)]
        for row, constant, label in self._ranges(layout):
            norm = np.linalg.norm(row * scale)
            G.append((row * scale / norm)[None])
            h.append(np.array([constant / norm]))
            labels.append(label)
        return Bounds(np.vstack(G), np.concatenate(h), tuple(labels))

    def equalities(self, layout: ParameterLayout, prior: Array) -> tuple[Array, Array]:
        """Return the equalities E pi = e (k,): pinned bodies, and masses given as one value."""
        p = len(layout.names)
        pinned = np.flatnonzero(np.repeat(np.isin(layout.bodies, self.pinned), 10))
        E, e = [np.eye(p)[pinned]], [prior[pinned]]
        for row, (low, high), _ in self._masses(layout):
            if low == high:
                E.append(row[None])
                e.append(np.array([low]))
        return np.vstack(E), np.concatenate(e)

    def _masses(self, layout: ParameterLayout) -> Iterator[tuple[Array, tuple[float, float], str]]:
        """Yield the rows of masses, (p,), with their bounds and labels."""
        for body, bounds in self.mass.items():
            if body not in self.pinned:
                yield _row(layout, body, np.eye(10)[0]), bounds, f"mass {body}"
        if self.total_mass is not None:
            row = np.zeros(len(layout.names))
            row[: layout.n_inertial : 10] = 1.0
            yield row, self.total_mass, "total_mass all"

    def _ranges(self, layout: ParameterLayout) -> Iterator[tuple[Array, float, str]]:
        """Yield c (p,), c0 and label of each row c pi + c0 >= 0 of a bound that is a range."""
        for row, (low, high), label in self._masses(layout):
            for sign, bound in ((1.0, low), (-1.0, high)):
                if low != high and np.isfinite(bound):
                    yield sign * row, -sign * bound, label
        for body, (A, b) in self.com.items():
            for normal, distance in zip(A, b, strict=True):
                if body not in self.pinned:
                    c = np.concatenate([[distance], -normal, np.zeros(6)])
                    yield _row(layout, body, c), 0.0, f"centre_of_mass {body}"
        for body, box in self.extent.items():
            if body not in self.pinned:
                for c in np.einsum("kij,mij->mk", pseudo_inertia_basis(), slabs(box)):
                    yield _row(layout, body, c), 0.0, f"extent {body}"

    def _check_pinned(self, body: str, values: Array, held: Array) -> None:
        (J,) = pseudo_inertia(values - held)
        if np.linalg.eigvalsh(J)[0] <= 0:
            raise SettingsError(
                f"{body} is pinned, but its inertial in the URDF is not physically consistent; "
                "correct it, or remove the link from 'pinned'"
            )
        low, high = self.mass.get(body, _OPEN)
        if not low - SLACK <= values[0] <= high + SLACK:
            raise SettingsError(
                f"{body} is pinned at the URDF's {values[0]:g} kg, outside its bounds "
                f"[{low:g}, {high:g}] kg; remove the link from 'pinned' or from 'mass'"
            )
        if body in self.com:
            A, b = self.com[body]
            centre = values[1:4] / values[0]
            beyond = float((A @ centre - b).max())
            if beyond > SLACK:
                raise SettingsError(
                    f"{body} is pinned, but the URDF's centre of mass "
                    f"{np.round(centre, 4).tolist()} m is {1e3 * beyond:.1f} mm outside its "
                    "bounds; remove the link from 'pinned' or widen the bounds"
                )

    def _check_total(self, total: tuple[float, float], masses: dict[str, float]) -> None:
        low, high = total
        _check_range("total_mass", low, high)
        bounds = [
            (mass, mass) if body in self.pinned else self.mass.get(body, _OPEN)
            for body, mass in masses.items()
        ]
        least, most = np.sum(bounds, axis=0)
        if high < least - SLACK or low > most + SLACK:
            raise SettingsError(
                f"total_mass is bounded by [{low:g}, {high:g}] kg, but the bounds of the bodies "
                f"and pinned masses allow [{least:g}, {most:g}] kg; correct the bounds"
            )


@dataclass(frozen=True)
class WeightChoice:
    """How the weight of the prior was chosen."""

    weight: float
    how: str  # "cv" or "evidence"
    curve: tuple[tuple[float, float], ...]  # ascending weights, scores
    plausible: float  # weight with the largest log evidence
    loss: float = 0.0  # largest ratio of the held-out error of a joint to that of least squares


@dataclass(frozen=True, eq=False)
class Consistent(BatchEstimator):
    """Fit of physically consistent standard parameters pi, regularised by a prior.

    Minimises

        sum_j |tau_j - W_b,j K pi|^2 / sigma_j^2 + prior_weight penalty(pi)

    subject to armature, viscous and Coulomb coefficients >= 0, and the other constraints. The
    penalty, twice the Bregman divergence of -log det from the prior's pseudo-inertias, is infinite
    unless each J(pi_i) - J(held_i) is positive definite; for the drives it is quadratic. The noise
    levels sigma_j are those of weighted least squares. The covariance is that without the
    inequalities (see ``Programme.redrawn``); rank, condition number and undetermined names refer to
    the base parameters. Sousa, Cortesao (2014), Physical feasibility of robot base inertial
    parameter identification: a linear matrix inequality approach; Wensing, Kim, Slotine (2018),
    Linear Matrix Inequalities for Physically Consistent Inertial Parameter Identification, (8).
    """

    layout: ParameterLayout
    K: Array  # (b, p), map to the base parameters
    prior: Array  # (p,), prior values, as the URDF's
    prior_std: Array  # (p,), prior standard deviations, positive
    held: Array | None = None  # (10 bodies,), known part of each, as on locked joints; or none
    prior_weight: float = 1.0
    plausible_weight: float = 1.0  # at which the prior has the spread of the true parameters
    independent_share: float = 1.0  # 2 cutoff / rate
    constraints: Constraints = field(default_factory=Constraints)
    wls_noise: Array | None = None  # (n,), noise levels of WLS [N m or N]; None: computed
    choice: WeightChoice | None = None  # of ``prior_weight``; None: it was given

    def __post_init__(self) -> None:
        p = len(self.layout.names)
        for name, shape in (("prior", (p,)), ("prior_std", (p,)), ("K", (len(self.K), p))):
            if getattr(self, name).shape != shape:
                raise DataError(f"{name} has shape {getattr(self, name).shape}, expected {shape}")
        if not (np.isfinite(self.prior_std) & (self.prior_std > 0)).all():
            raise DataError("prior_std must be positive and finite for every parameter")
        if not np.isfinite(self.prior).all() or not np.isfinite(self._held).all():
            raise DataError("prior and held must be finite for every parameter")
        if not self.prior_weight > 0:
            raise DataError(f"prior_weight is {self.prior_weight}, expected a positive number")
        self.constraints.check(self.layout, self.prior, self._held)

    def _fit(self, factors: Factors) -> Estimate:
        sigma = self.noise(factors)
        wls = solve_factor(factors, sigma, self.K @ self.prior)
        least_squares = wls.estimate(factors.names, wls.covariance, sigma, 0, "")
        return self._minimised(self.rows(factors, sigma), least_squares)

    def without_extent(self, bodies: Iterable[str]) -> "Consistent":
        """Return the same fit without the extents of some bodies."""
        bounds, bodies = self.constraints, set(bodies)
        relaxed = tuple(body for body in bounds.extent if body in bodies)
        others = {body: box for body, box in bounds.extent.items() if body not in bodies}
        bounds = replace(bounds, extent=others, relaxed=(*bounds.relaxed, *relaxed))
        return replace(self, constraints=bounds)

    def project(self, estimate: Estimate) -> Estimate:
        """Return the physically consistent standard parameters nearest to an estimate.

        Minimises (K pi - beta)^T C^-1 (K pi - beta) + prior_weight penalty(pi) under the
        constraints of ``fit``, C the covariance. Parameters with infinite variance are not used.
        """
        known = np.flatnonzero(np.isfinite(np.diag(estimate.covariance)))
        if not len(known):
            raise DataError(
                "the estimate has no covariance and cannot be projected; use 'rls' or "
                "'kalman', which have one"
            )
        projected = self._minimised(_information_rows(estimate, known), estimate)
        words = f"{estimate.message}; projected onto physically consistent parameters"
        return replace(projected, message=f"{words}, {projected.message}")

    def _minimised(self, rows: Array, base: Estimate) -> Estimate:
        """Return the minimum of rows (k, b + 1), from an estimate of the base parameters."""
        minimum = self.programme.minimise(rows, self.prior_weight)
        known = self.layout.owned_by(self.constraints.pinned)
        spread = base_spread(self.K, self.prior_std, known)
        return replace(
            base, theta=minimum.x, names=self.layout.names, message=minimum.message,
            covariance=self.programme.covariance(self.prior_weight, rows, minimum.x),
            undetermined=determine(base.names, rows[:, :-1], spread).undetermined,
            n_iter=base.n_iter + minimum.n_iter, prior_std=self.spread_before,
            details=self._details(minimum.x),
        )  # fmt: skip

    def noise(self, factors: Factors) -> Array:
        """Return the noise levels of weighted least squares without a prior, shape (n,) [N m or N].

        The parameters use as many independent rows as the trace of their leverage.
        """
        sigma, prior = self.wls_noise, self.K @ self.prior
        if sigma is None:
            sigma = WLS(prior, self.independent_share).fit(factors).sigma
        rows = np.maximum(factors.rows, 1)
        used = factors.leverages(solve_factor(factors, sigma, prior).covariance) / sigma**2
        freedom = np.maximum(rows - used / self.independent_share, LEAST_FREEDOM * rows)
        torque = np.sqrt(factors.torque_squares() / rows)
        least = NOISE_FREE * np.where(torque > 0, torque, 1.0)
        level = sigma * np.sqrt(np.maximum(rows - used, 1.0) / freedom)
        return np.asarray(np.maximum(level, least))

    def rows(self, factors: Factors, sigma: Array) -> Array:
        """Return rows [R d], (b + 1, b + 1), of the weighted cost |R K pi - d|^2: sigma (n,)."""
        return factors.weighted(sigma / np.sqrt(self.independent_share))

    @cached_property
    def programme(self) -> Programme:
        """The convex programme, for any data and weight."""
        E, e = self.constraints.equalities(self.layout, self.prior)
        return Programme(
            self.K,
            self.prior_std,
            Entropic.of(self.layout, self.prior, self.prior_std, self._held),
            self.constraints.bounds(self.layout, self.prior_std),
            Subspace.of(E * self.prior_std, e),
        )

    @property
    def weight_ratio(self) -> float:
        """Weight of the prior over its plausible weight, by which errors are given, at least 1."""
        return max(self.prior_weight / self.plausible_weight, 1.0)

    @property
    def spread_before(self) -> Array:
        """Plausible standard deviation of each parameter before the data, shape (p,)."""
        covariance = self.programme.covariance(self.prior_weight / self.weight_ratio)
        return np.asarray(np.sqrt(np.diag(covariance)))

    @property
    def _held(self) -> Array:
        """The known part of each body, shape (10 bodies,); 0 without one."""
        return np.zeros(self.layout.n_inertial) if self.held is None else self.held

    def _details(self, pi: Array) -> dict[str, Any]:
        """Return the settings of the fit and its active constraints, as plain values."""
        programme, pinned = self.programme, self.constraints.pinned
        families = [label.split(" ", 1)[0] for label in programme.bounds.labels]
        if set(self.layout.bodies) - set(pinned):
            families.append("pseudo_inertia")
        if programme.space.basis.shape[1] < len(pi):
            families.append("equalities")
        prior: dict[str, Any] = {
            "metric": "entropic",
            "weight": self.prior_weight,
            "plausible_weight": self.prior_weight / self.weight_ratio,
        }
        if self.choice is not None:
            prior["chosen_by"] = self.choice.how
            prior["curve"] = [list(pair) for pair in self.choice.curve]
        return {
            "prior": prior,
            "solver": "interior point",
            "constraints": list(dict.fromkeys(families)),
            "active": sorted(set(programme.bounds.active(pi / self.prior_std, _ACTIVE))),
            "pinned": list(pinned),
            "relaxed": list(self.constraints.relaxed),
        }


def slabs(box: Array) -> Array:
    """Return matrices Q_k, (3, 4, 4), with tr(J Q_k) >= 0 for all mass inside a box (slabs).

    It is the integral of (x_k - l_k) (u_k - x_k) over the body, u and l the corners (Wensing, Kim,
    Slotine, 2018, see ``Consistent``, (12), its ellipsoid being a slab).
    """
    Q = np.zeros((3, 4, 4))
    for k, (low, high) in enumerate(box.T.tolist()):
        Q[k, k, k] = -1.0
        Q[k, k, 3] = Q[k, 3, k] = 0.5 * (low + high)
        Q[k, 3, 3] = -low * high
    return Q


def _row(layout: ParameterLayout, body: str, c: Array) -> Array:
    """Return coefficients of all parameters, (p,), from those of one body, (10,)."""
    row = np.zeros(len(layout.names))
    first = 10 * layout.bodies.index(body)
    row[first : first + 10] = c
    return row


def _check_range(what: str, low: float, high: float) -> None:
    if not low <= high:
        raise SettingsError(
            f"{what} is bounded by [{low:g}, {high:g}] kg: the first value is larger than the "
            "second; write the smaller one first"
        )
    if high <= 0:
        raise SettingsError(f"{what} is bounded by {high:g} kg, expected a positive bound")


def _information_rows(estimate: Estimate, known: Array) -> Array:
    """Return rows [L^-1 (beta -> known), L^-1 beta], L L^T the covariance of known parameters."""
    C = estimate.covariance[np.ix_(known, known)]
    scale = np.sqrt(np.diag(C))
    try:
        L = scale[:, None] * np.linalg.cholesky(C / np.outer(scale, scale))
    except np.linalg.LinAlgError as error:
        raise DataError(
            "the covariance of the estimate is not positive definite, so it cannot be projected; "
            "use more samples or a prior"
        ) from error
    chosen = np.zeros((len(known), len(estimate.theta) + 1))
    chosen[np.arange(len(known)), known] = 1.0
    chosen[:, -1] = estimate.theta[known]
    return np.asarray(scipy.linalg.solve_triangular(L, chosen, lower=True))


@dataclass(frozen=True, eq=False)
class Segments:
    """Contiguous segments of the fitted data: the folds of a cross-validation."""

    folds: tuple[Factors, ...]
    sigma: Array  # (n,), noise level per joint [N m or N]
    rows: Array  # (b + 1, b + 1), rows of all segments, from ``Consistent.rows``
    share: float  # of independent rows [-]

    @classmethod
    def of(cls, fit: Consistent, segments: Sequence[Factors]) -> "Segments":
        """Return segments with the noise level of a fit to all of them."""
        factors = merge(segments)
        sigma = fit.noise(factors)
        return cls(tuple(segments), sigma, fit.rows(factors, sigma), fit.independent_share)

    @cached_property
    def others(self) -> Array:
        """Rows of all segments except one, for each segment, shape (K, b + 1, b + 1)."""
        triangles = [factors.weighted(self.sigma / np.sqrt(self.share)) for factors in self.folds]
        totals = [Triangle(len(self.rows)) for _ in triangles]
        for k, total in enumerate(totals):
            for R in (*triangles[:k], *triangles[k + 1 :]):
                total.fold_triangle(R, np.arange(len(R)))
        return np.array([total.R for total in totals])

    @cached_property
    def least_squares_errors(self) -> Array:
        """Prediction errors of each segment by least squares of all others, (segments, n)."""
        errors = []
        for fold, rows in zip(self.folds, self.others, strict=True):
            size = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), 1e-300)
            scaled = np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=1e-7)[0]
            errors.append(fold.residual_squares(scaled / size))
        return self.errors(np.array(errors))

    def errors(self, squares: Array) -> Array:
        """Return squared errors (segments, n) over the squared noise level and number of rows."""
        squares = squares / self.sigma**2
        rows = np.sum([fold.rows for fold in self.folds], axis=0)  # (n,)
        if self.folds[0].is_projected:
            squares, rows = squares.sum(axis=1, keepdims=True), rows.sum(keepdims=True)
        return np.asarray(squares / np.maximum(rows, 1))


def choose_weight(
    fit: Consistent, segments: Segments, how: str, repeated: float = 0.0
) -> WeightChoice:
    """Return the weight of the prior, chosen from the fitted data.

    * "cv": the largest weight with the same prediction error on held-out segments as the best one,
      see ``_is_accepted``. A repeated error has no scatter between segments. The error of no joint
      may be more than 10 % above that of least squares, as where the prior is a placeholder.
    * "evidence": the weight with the largest ``log_evidence``.

    Weights are tried from 100 down to 0.1, and to 1e-4 where least squares is better, in decades,
    until two in a row are worse than those before, and then around the best one. A weight at which
    the fit does not converge, because bodies shrink to points, has an infinite error.
    """
    evidence = log_evidence(fit, segments.rows)
    by_evidence = _search(lambda w: (-evidence(w), np.zeros(0)), "evidence", 0.0)
    plausible = plausible_weight(fit, segments.rows, by_evidence.plausible)
    if how == "evidence":
        return replace(by_evidence, plausible=plausible)

    fits: dict[float, list[Minimum]] = {}  # by weight, one without each segment
    least = np.sqrt(_by_joint(segments.least_squares_errors))  # (n,)

    def score(weight: float) -> tuple[float, Array]:
        starts = next(reversed(fits.values()), None)
        try:
            errors, fits[weight] = held_out_errors(fit, segments, weight, starts)
        except NotConvergedError:
            return float("inf"), np.full((len(segments.folds), len(least)), np.inf)
        return float(np.exp(0.5 * np.log(_by_joint(errors)).mean())), errors

    # a residual without the repeated error is smaller by this log ratio
    excess = -0.5 * np.log1p(-min(repeated, MOST_EXPLAINED))
    choice = replace(_search(score, how, excess, least, _USUAL), plausible=plausible)
    larger = [weight for weight, _ in choice.curve if weight >= choice.weight]
    for weight in larger[:-1]:  # the first one at which the fit to all rows converges
        near = next(iter(fits.get(weight, ())), None)
        try:
            fit.programme.minimise(segments.rows, weight, start=near)
        except NotConvergedError:
            continue
        return replace(choice, weight=weight)
    return replace(choice, weight=larger[-1])


def loss_of(fit: Consistent, segments: Segments, weight: float) -> float:
    """Return the largest ratio of the held-out error of a joint to that of least squares [-]."""
    try:
        errors, _ = held_out_errors(fit, segments, weight)
    except NotConvergedError:
        return float("inf")
    return float(np.sqrt(_by_joint(errors) / _by_joint(segments.least_squares_errors)).max())


def plausible_weight(fit: Consistent, rows: Array, weight: float) -> float:
    """Return the weight at which the distance from the prior is as expected, or the given one.

    At the minimum with a weight w that agrees with the data, w times the penalty is the number of
    parameters that the data determine, g = d - trace(w H C / 2) of d free ones (MacKay, 1992,
    Bayesian interpolation, section 4). If it is more, or less than half, as far from the centre the
    penalty is not quadratic, the next weight is g over the penalty. It is at least half a decade
    below the given one (a larger disagreement is due to errors of the model), and one at which the
    fit converges.
    """
    programme, solution, plausible = fit.programme, None, weight
    least = weight * 10.0**-_STEP
    for _ in range(_REESTIMATED):
        try:
            solution = programme.minimise(rows, weight, is_exact=False, start=solution)
        except NotConvergedError:  # bodies shrink to points
            break
        plausible = weight
        H, C = programme.penalty.hessian(solution.x), programme.covariance(weight, rows, solution.x)
        determined = programme.space.basis.shape[1] - 0.5 * weight * float(np.sum(H * C))
        distance = weight * programme.penalty.value(solution.x)
        low, high = np.multiply(_EXPECTED, determined)
        is_least = distance > high and weight == least
        if low <= distance <= high or is_least or distance == 0.0:
            break
        weight = max(least, weight * determined / distance)
    return plausible


def contradicted_extents(fit: Consistent, segments: Segments) -> tuple[str, ...]:
    """Return the bodies whose extent is contradicted by the data.

    In a fit without extents at a weight of 1 they are outside their box by more than four standard
    errors, and it predicts held-out segments better than the fit with extents, by more than two
    standard errors and 2 % of the mean square error.
    """
    bounds, rows, count = fit.programme.bounds, segments.rows, len(segments.folds)
    free = fit.without_extent(fit.constraints.extent)
    try:
        solution = free.programme.minimise(rows, 1.0, is_exact=False)
    except NotConvergedError:  # bodies diverge: this contradicts no extent
        return ()
    G, covariance = bounds.G / fit.prior_std, free.programme.covariance(1.0, rows, solution.x)
    error = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", G, covariance, G), 0.0))
    beyond = G @ solution.x + bounds.h < -_BEYOND * error
    outside = [label for label, is_out in zip(bounds.labels, beyond, strict=True) if is_out]
    bodies = tuple(body for body in fit.layout.bodies if f"extent {body}" in outside)
    if not bodies or count < 2:
        return bodies
    try:
        unbound = held_out_errors(free, segments, 1.0, [solution] * count)[0].sum(axis=1)
    except NotConvergedError:
        return ()
    try:
        excess = held_out_errors(fit, segments, 1.0)[0].sum(axis=1) - unbound
    except NotConvergedError:  # noise-free data that contradict the extents
        return bodies
    error = np.sqrt(len(excess)) * excess.std(ddof=1)  # of the sum, paired
    least = max((_MOST_LOSS - 1.0) * unbound.sum(), ALIKE * error)
    return bodies if excess.sum() > least else ()


def held_out_errors(
    fit: Consistent, segments: Segments, weight: float, starts: Sequence[Minimum] | None = None
) -> tuple[Array, list[Minimum]]:
    """Return the errors of each segment, (segments, n) [-], by the consistent fit to all others."""
    if len(segments.folds) < 2:
        raise DataError(
            f"prior_weight = 'cv' needs at least 2 segments, found {len(segments.folds)}; fit "
            "longer logs, or set prior_weight = 'evidence'"
        )
    fits = fit.programme.minimise_each(segments.others, weight, is_exact=False, starts=starts)
    pairs = zip(segments.folds, fits, strict=True)
    squares = np.array([fold.residual_squares(fit.K @ x.x) for fold, x in pairs])
    return segments.errors(squares), fits


def log_evidence(fit: Consistent, rows: Array) -> Callable[[float], float]:
    """Return the log marginal likelihood of the data as a function of the prior's weight.

    With the prior x = L (pi - centre) ~ N(0, 1 / weight), r = A x + noise of unit variance is N(0,
    I + A A^T / weight). The penalty is expanded at its centre, without inequalities.
    """
    A, r = fit.programme.whitened(rows)
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    along = U.T @ r

    def likelihood(weight: float) -> float:
        spread = 1.0 + s**2 / weight
        # |r|^2 outside the range of A is constant
        return float(-0.5 * ((along**2 / spread).sum() + np.log(spread).sum()))

    return likelihood


def _search(
    score: Callable[[float], tuple[float, Array]], how: str, allowed: float,
    least: Array | None = None, usual: float = _SMALLEST,
) -> WeightChoice:  # fmt: skip
    """Return the largest weight that ``_is_accepted`` in comparison with that of smallest score."""
    # ``score`` returns the score and its parts by segment and joint, or none. Below the usual
    # smallest weight, others are tried while the largest ratio of a joint's error to that of least
    # squares (n,) is too large and decreases.
    tried: dict[float, float] = {}
    parts: dict[float, Array] = {}
    loss: dict[float, float] = {}

    def attempt(decade: float) -> None:
        tried[decade], parts[decade] = score(10.0**decade)
        ratio = 0.0 if least is None else np.sqrt(_by_joint(parts[decade])) / least
        loss[decade] = float(np.max(ratio))

    decade = _LARGEST
    while decade >= _SMALLEST and (
        (decade >= usual and _is_promising(tried.values()))
        or (min(loss.values()) > AS_GOOD and _is_promising(loss.values(), _MOST_LOSS))
    ):
        attempt(decade)
        decade -= 1.0
    best = min(tried, key=lambda k: tried[k])
    for k in (best - _STEP, best + _STEP):
        if _SMALLEST <= k <= _LARGEST:
            attempt(k)
    finite = [k for k in sorted(tried) if np.isfinite(tried[k])]
    if not finite:
        raise NotConvergedError(
            f"the fit converges at no prior_weight from {10.0**_SMALLEST:g} to {10.0**_LARGEST:g}; "
            "record a richer motion, or correct the inertials of the URDF",
            "max_iterations",
        )
    allowed_loss = max(AS_GOOD, _MOST_LOSS * min(loss.values()))
    within = [k for k in finite if loss[k] <= allowed_loss]
    best = min(within, key=lambda k: tried[k])
    chosen = max([best, *(k for k in within if _is_accepted(parts[k], parts[best], allowed))])
    curve = tuple((float(10.0**k), tried[k]) for k in finite)
    return WeightChoice(float(10.0**chosen), how, curve, float(10.0**best), loss[chosen])


def _is_accepted(parts: Array, best: Array, allowed: float) -> bool:
    """Return whether errors are about as small as the best ones, both of shape (segments, n)."""
    # The RMS error, its geometric mean over joints, is at most 2 % larger, and that of any joint
    # 5 %. The mean log ratio by segment is at most the allowed one, or two standard errors.
    if not parts.size:
        return False
    ratio = np.sqrt(_by_joint(parts) / _by_joint(best))  # (n,)
    if np.exp(np.log(ratio).mean()) > _MOST_LOSS or ratio.max() > _MOST_JOINT_LOSS:
        return False
    both = (parts > 0) & (best > 0)  # a joint at rest has no rows in a segment
    logs = 0.5 * np.log(np.where(both, parts, 1.0) / np.where(both, best, 1.0))
    excess = logs.sum(axis=1) / np.maximum(both.sum(axis=1), 1)  # (segments,)
    error = excess.std(ddof=1) / np.sqrt(len(excess))
    return bool(excess.mean() <= max(allowed, ALIKE * error))


def _by_joint(parts: Array) -> Array:
    """Return the mean squares of the joints with rows, shape (n,), from errors by segment."""
    squares = parts.sum(axis=0)
    return np.asarray(squares[squares > 0])


def _is_promising(values: Iterable[float], factor: float = 1.0) -> bool:
    """Return whether one of the last two values is the smallest, clearly by a factor."""
    scores = list(values)
    if len(scores) <= _PATIENCE or not np.isfinite(scores).any():
        return True
    return factor * min(scores[-_PATIENCE:]) < min(scores[:-_PATIENCE])
