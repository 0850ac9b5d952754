"""The equations of the paper: dynamics linear in their parameters, control, proximity, update.

The formulas accept leading axes for several runs together: "..." stands for () or (R,).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from robotid.base.exceptions import DataError, RankDeficientError, SettingsError
from robotid.base.typing import Array
from robotid.paper import planar_2r

#: Sign of the second term of (23): with minus it is a gradient, plus is printed in the paper.
Sign: TypeAlias = Literal["corrected", "printed"]


@dataclass(frozen=True)
class Bounds:
    """The bounded set Omega of the parameters: a box.

    Attributes:
        lower: Smallest value of each parameter, shape (c,); -inf for none.
        upper: Largest value of each parameter, shape (c,); inf for none.

    References:
        Tzvetkova, (8).
    """

    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        if lower.shape != upper.shape or lower.ndim != 1:
            raise DataError(f"bounds have shapes {lower.shape} and {upper.shape}, wanted one (c,)")
        if not (lower <= upper).all():  # NaN is refused too
            i = int(np.flatnonzero(~(lower <= upper))[0])
            raise DataError(
                f"bounds of parameter {i} are {lower[i]} to {upper[i]}, wanted lower <= upper"
            )

    def project(self, P: Array) -> Array:
        """Return the nearest parameters of the set: P (..., c) -> (..., c)."""
        return np.clip(P, self.lower, self.upper)


def reference_acceleration(
    q: Array, v: Array, program: tuple[Array, Array, Array], alpha: Array, beta: Array
) -> Array:
    """Return q_* = a_pr - alpha (v - v_pr) - beta (q - q_pr).

    References:
        Tzvetkova, (15).

    q (..., n) [rad or m], v (..., n) [rad/s or m/s], program (..., n), alpha () [1/s], beta ()
    [1/s^2] -> (..., n).
    """
    q_pr, v_pr, a_pr = program
    q_star: Array = a_pr - alpha * (v - v_pr) - beta * (q - q_pr)
    return q_star


def proximity(Psi: Array, P: Array, u: Array, *, sign: Sign = "corrected") -> Array:
    """Return PRX = Psi^T Psi P - Psi^T u, or with a plus, as printed in the paper.

    With the minus it is the gradient (4) of the criterion (3), J = |u - Psi P|^2 / 2, and zero at
    the true parameters. With the plus it is 2 Psi^T u there.

    References:
        Tzvetkova, (23).

    Psi (..., n, c), P (..., c), u (..., n) [N m or N] -> (..., c).
    """
    if sign not in ("corrected", "printed"):
        raise SettingsError(f"sign is {sign!r}, wanted 'corrected' or 'printed'")
    predicted = np.einsum("...nc,...c->...n", Psi, P)
    residual = predicted - u if sign == "corrected" else predicted + u
    gradient: Array = np.einsum("...nc,...n->...c", Psi, residual)
    return gradient


def recursive_update(
    P: Array, Psi: Array, eta: Array, sigma: Array, is_open: Array, *, eps2: float | Array = 1e-12
) -> Array:
    """Return P - lambda sigma_D / |Psi|^2 Psi^T eta, with |Psi|^2 = Sp(Psi Psi^T).

    References:
        Tzvetkova, (24).

    P (..., c), Psi (..., n, c), eta (..., n), sigma (...), is_open (...) -> (..., c).
    """
    size = np.einsum("...nc,...nc->...", Psi, Psi)
    moves = is_open & (size > eps2) & (sigma > 0.0)
    gamma = np.where(moves, sigma, 0.0) / np.where(moves, size, 1.0)
    updated: Array = P - gamma[..., None] * np.einsum("...nc,...n->...c", Psi, eta)
    return updated


def one_shot(G: Array, G_star: Array, P: Array, names: Sequence[str]) -> Array:
    """Return the parameters from one recorded motion, P = G^+ G_* P^.

    The torque is G P, with the measured acceleration, and G_* P^, with the reference acceleration
    (15) from which it was computed.

    References:
        Tzvetkova, (16)-(19).

    G (N n, c), G_star (N n, c), P (c,) -> (c,).
    """
    U, s, Vt = np.linalg.svd(G, full_matrices=False)
    rank = int(np.sum(s > s[0] * 1e-10)) if s[0] > 0 else 0
    if rank < G.shape[1]:
        open_share = 1.0 - np.sum(Vt[:rank] ** 2, axis=0)
        undetermined = [
            name for name, is_open in zip(names, open_share > 0.01, strict=True) if is_open
        ]
        raise RankDeficientError(rank, undetermined, G.shape[1])
    solved: Array = Vt.T @ ((U.T @ (G_star @ P)) / s)
    return solved


class LinearDynamics(Protocol):
    """A model D(q, P) a + C(q, v, P) = u that is linear in P, (11)-(13)."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the c parameters."""

    @property
    def n_joints(self) -> int:
        """Number n of joints."""

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the regressor of R states.

        q (R, n) [rad or m], v (R, n) [rad/s or m/s], a (R, n) [rad/s^2 or m/s^2] -> (R, n,
        c).
        """


class Plant(Protocol):
    """A robot that is simulated."""

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        """Return the accelerations of R robots.

        q (R, n) [rad or m], v (R, n) [rad/s or m/s], u (R, n) [N m or N] -> (R, n) [rad/s^2
        or m/s^2].
        """


@dataclass(frozen=True)
class PlanarDynamics(LinearDynamics):
    """The paper's arm in closed form."""

    # its regressor: ``"printed"``, ``"corrected_five"`` or ``"corrected"``
    form: planar_2r.Form = "corrected"

    @property
    def names(self) -> tuple[str, ...]:
        return planar_2r.PARAMETER_NAMES[self.form]

    @property
    def n_joints(self) -> int:
        return 2

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        return planar_2r.regressor(q, v, a, form=self.form)


@dataclass(frozen=True)
class LinearPlant(Plant):
    """A plant whose dynamics are linear in its parameters; it need not be a rigid body."""

    dynamics: LinearDynamics  # its regressor
    P: Array  # its true parameters, shape (c,)

    def acceleration(self, q: Array, v: Array, u: Array) -> Array:
        # a = D(q, P)^-1 (u - C(q, v, P)), (11)
        D, C = _mass_and_bias(self.dynamics, q, v, self.P)
        a: Array = np.linalg.solve(D, (u - C)[..., None])[..., 0]
        return a


def torque(dynamics: LinearDynamics, q: Array, v: Array, a: Array, P: Array) -> Array:
    """Return u = G(q, v, a) P.

    References:
        Tzvetkova, (13).

    q (R, n) [rad or m], v (R, n) [rad/s or m/s], a (R, n) [rad/s^2 or m/s^2], P (c,) -> (R, n)
    [N m or N].
    """
    G = dynamics.regressor(q, v, a)  # (R, n, c)
    u: Array = np.einsum("rnc,rc->rn", G, np.broadcast_to(P, (len(q), G.shape[-1])))
    return u


def mass_matrix(dynamics: LinearDynamics, q: Array, P: Array) -> Array:
    """Return D(q, P) from the base parameters.

    Column j is (G(q, 0, e_j) - G(q, 0, 0)) P: the torque of a unit acceleration without that of
    gravity and constant offsets.

    References:
        Tzvetkova, (11); sigma_D of (24) needs it.

    q (R, n) [rad or m], P (c,) -> (R, n, n).
    """
    return _mass_and_bias(dynamics, q, np.zeros_like(q), P)[0]


def smallest_eigenvalue(D: Array) -> Array:
    """Return sigma_D, the smallest eigenvalue of each matrix.

    References:
        Tzvetkova, (24).

    D (R, n, n) -> (R,).
    """
    smallest: Array = np.linalg.eigvalsh((D + D.swapaxes(-1, -2)) / 2)[..., 0]
    return smallest


def _mass_and_bias(dynamics: LinearDynamics, q: Array, v: Array, P: Array) -> tuple[Array, Array]:
    """Return D(q, P), shape (R, n, n), and C(q, v, P), shape (R, n), from one call."""
    R, n = q.shape
    unit = np.concatenate([np.eye(n), np.zeros((2, n))])  # accelerations e_1 .. e_n, 0, 0
    a = np.repeat(unit, R, axis=0)  # ((n + 2) R, n)
    speeds = np.zeros_like(a)
    speeds[-R:] = v
    G = dynamics.regressor(np.tile(q, (n + 2, 1)), speeds, a)
    parameters = np.broadcast_to(P, (R, G.shape[-1]))
    u = np.einsum("krnc,rc->krn", G.reshape(n + 2, R, n, -1), parameters)
    return (u[:n] - u[n]).transpose(1, 2, 0), u[n + 1]


def rk4(
    acceleration: Callable[[Array, Array, float], Array],
    q: Array,
    v: Array,
    h: float | Array,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """Return positions and velocities one step later, by the Runge-Kutta method of order 4."""
    a1 = acceleration(q, v, 0.0) if a is None else a
    v2 = v + h / 2 * a1
    a2 = acceleration(q + h / 2 * v, v2, 0.5)
    v3 = v + h / 2 * a2
    a3 = acceleration(q + h / 2 * v2, v3, 0.5)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4, 1.0)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
