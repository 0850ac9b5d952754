"""Base parameters: the combinations of the standard parameters that affect the torque.

By QR with column pivoting of the regressor at random states, W P = Q [R1 R2]: W pi = W_1 beta with
beta = K pi = pi_1 + R1^-1 R2 pi_2 (Gautier 1991).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError
from robotid.base.tolerances import LEAST_DIVISOR, REMAINDER, SINGULAR, TINY
from robotid.base.typing import Array
from robotid.dynamics.factors import Problem, triangle_of
from robotid.dynamics.torque import random_regressor
from robotid.robot.model import RobotModel

#: Pivots below this share of the largest count as 0. Over example-robot-data, every pivot is above
#: 1e-3 or below 1e-12, except with rounded angles in a URDF (3.1416): 1e-5 to 1e-6.
RANK_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class BaseMapping:
    """The linear map from standard to base parameters and back."""

    K: Array  # map with beta = K pi and W pi = W[:, independent] beta, shape (b, p)
    independent: Array  # independent columns of W, shape (b,), ascending
    names: tuple[str, ...]  # names of the p standard parameters
    pivots: Array  # absolute values of all p pivots, descending, relative to the first, shape (p,)

    @property
    def base_names(self) -> tuple[str, ...]:
        """Name of each base parameter: that of its independent column."""
        return tuple(self.names[i] for i in self.independent)

    @cached_property
    def expressions(self) -> tuple[str, ...]:
        """Each base parameter as a sum, for example ``link_2.Izz + 0.5 link_3.m``."""
        return tuple(
            _expression(row, self.names, int(first))
            for row, first in zip(self.K, self.independent, strict=True)
        )

    @cached_property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of the standard parameters that affect no torque in any motion."""
        return tuple(self.names[i] for i in np.flatnonzero(~self.K.any(axis=0)))

    def to_base(self, pi: Array) -> Array:
        """Return the base parameters beta = K pi, shape (b,): pi (p,)."""
        if pi.shape != (self.K.shape[1],):
            raise DataError(f"pi has shape {pi.shape}, expected ({self.K.shape[1]},)")
        return self.K @ pi

    def to_standard(self, beta: Array, prior: Array, spread: Array | None = None) -> Array:
        """Return pi = prior + G (beta - K prior), the nearest to a prior in units of the spread."""
        if beta.shape != (len(self.K),):
            raise DataError(f"beta has shape {beta.shape}, expected ({len(self.K)},)")
        return np.asarray(prior + self.gain(spread) @ (beta - self.to_base(prior)))

    def gain(self, spread: Array | None = None) -> Array:
        """Return G = S^2 K^T (K S^2 K^T)^-1, shape (p, b), S = diag(spread): d pi / d beta."""
        s = np.ones(self.K.shape[1]) if spread is None else spread
        # K S = (Q R)^T, so that S (K S)^+ = S Q R^-T has no loss of digits
        Q, R = scipy.linalg.qr((self.K * s).T, mode="economic")
        return np.asarray(s[:, None] * scipy.linalg.solve_triangular(R, Q.T).T)

    def reduce(self, problem: Problem) -> Problem:
        """Return the problem in the b base parameters, W_b beta = tau."""
        if problem.names != self.names:
            raise DataError(
                f"the problem has {len(problem.names)} columns, expected the {len(self.names)} of "
                "the mapping; build both from one model"
            )
        return problem.select(self.independent)


def base_mapping(
    W: Array,
    names: tuple[str, ...],
    *,
    scales: Array | None = None,
    preference: Array | None = None,
    rtol: float = RANK_TOLERANCE,
) -> BaseMapping:
    """Return the base parameters of a regressor at random states; scales: physical magnitudes."""
    magnitude = np.ones(len(names)) if scales is None else scales
    R = triangle_of(W) * magnitude  # normalised, a column of rounding errors would count
    order, pivots = _pivot(R)
    rank = int(np.sum(pivots > rtol * pivots[0]))
    order = order if preference is None else _pivot(R * preference)[0]
    own, others = np.sort(order[:rank]), np.sort(order[rank:])
    triangle = triangle_of(R[:, np.append(own, others)])[:rank]
    X = scipy.linalg.solve_triangular(triangle[:, :rank], triangle[:, rank:])  # scaled
    X[np.abs(X) < REMAINDER] = 0.0
    K = np.zeros((rank, len(names)))
    K[np.arange(rank), own] = 1.0
    K[:, others] = X * magnitude[own][:, None] / magnitude[others]
    return BaseMapping(K, own, names, pivots / pivots[0])


def _pivot(R: Array) -> tuple[Array, Array]:
    """Return the order in which columns are chosen, by norm, and the pivot of each, descending."""
    shortened = R * (1.0 - TINY * np.arange(R.shape[1]))  # the first of equal ones is chosen
    triangle, order = scipy.linalg.qr(shortened, mode="r", pivoting=True)
    return order, np.abs(np.diag(triangle))


def _expression(row: Array, names: tuple[str, ...], first: int) -> str:
    text = names[first]
    for i in np.flatnonzero(np.abs(row) > TINY):
        if i != first:
            size = f"{abs(row[i]):.6g} ".removeprefix("1 ")
            text += f" {'-' if row[i] < 0 else '+'} {size}{names[i]}"
    return text


def structural_mapping(
    model: RobotModel, *, inertial_only: bool = False, plain: BaseMapping | None = None
) -> BaseMapping:
    """Return the structural base parameters of a robot; further terms only add to those without."""
    columns = model.layout.n_inertial if inertial_only else len(model.layout.names)
    if model.layout.own and not inertial_only:
        return _with_own_terms(model, plain or structural_mapping(model.with_terms({})))
    samples = 2 * columns // model.n_rows + 20
    W = random_regressor(model, samples, np.random.default_rng(0))
    return base_mapping(
        W[:, :columns],
        model.layout.names[:columns],
        scales=model.layout.scales(model.length)[:columns],
        preference=model.layout.preference()[:columns],
        # small motions of closed chains have pivots down to 1e-6
        rtol=SINGULAR if model.loops else RANK_TOLERANCE,
    )


def _with_own_terms(model: RobotModel, plain: BaseMapping) -> BaseMapping:
    """Return the mapping of a robot with further drive terms, from that without them."""
    names = model.layout.names
    place = [names.index(name) for name in plain.names]
    own = np.setdiff1d(np.arange(len(names)), place)
    base = np.array(place)[plain.independent]
    W = random_regressor(model, 2 * len(names) // model.n_rows + 20, np.random.default_rng(0))
    Q, R = scipy.linalg.qr(W[:, base], mode="economic")
    size = np.maximum(np.linalg.norm(W[:, own], axis=0), LEAST_DIVISOR)
    T = Q.T @ W[:, own] / size
    S, order = scipy.linalg.qr(W[:, own] / size - Q @ T, mode="r", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(S)) > RANK_TOLERANCE))
    first, rest = order[:rank], order[rank:]
    # W_rest = W_base A + W_first B
    B = scipy.linalg.solve_triangular(S[:rank, :rank], S[:rank, rank:])
    A = scipy.linalg.solve_triangular(R, T[:, rest] - T[:, first] @ B)
    K = np.zeros((len(base) + rank, len(names)))
    K[: len(base), place] = plain.K
    K[len(base) + np.arange(rank), own[first]] = 1.0
    K[: len(base), own[rest]] = np.where(np.abs(A) < REMAINDER, 0.0, A) * size[rest]
    K[len(base) :, own[rest]] = B * size[rest] / size[first][:, None]
    independent = np.concatenate([base, own[first]])
    ascending = np.argsort(independent)
    pivots = np.append(plain.pivots, np.abs(np.diag(S)))
    return BaseMapping(K[ascending], independent[ascending], names, pivots)
