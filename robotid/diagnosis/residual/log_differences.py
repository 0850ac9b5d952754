"""Which log contradicts the others: its residual, with the fit to the others as the prior.

    r = tau - Y pi_others = W delta + e,    delta ~ N(0, C),    C^-1 = C_0^-1 + sum of W_o^T W_o,

with a sum over the other logs. Friction and offsets of the log are free: they may have changed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from scipy.linalg import solve_triangular

from robotid.base.typing import Array
from robotid.diagnosis.decisions import BETTER, EXACT, MISFIT_MATTERS, NOTHING
from robotid.diagnosis.residual.term_trials import Normal, Sample, cut_segments


def unlike_log(sample: Sample, *, friction: bool = False) -> "tuple[OtherLogs, Array] | None":
    """Return the fit to all logs but the one that contradicts them, the later of two, and how."""
    paths = [x.log.path or str(k) for k, x in enumerate(sample.recordings)]  # "": in memory
    logs, log_of = list(dict.fromkeys(paths)), np.repeat(paths, [len(k) for k in sample.taken])
    if len(logs) < 2:
        return None
    each = [_Products.of(sample, log_of == log) for log in logs]
    total, rows = sum(x.all for x in each), sum(x.rows for x in each)
    others = [
        OtherLogs.of([path == log for path in paths], total - x.all, rows - x.rows, sample.share)
        for log, x in zip(logs, each, strict=True)
    ]
    of, least = (OtherLogs.friction, MISFIT_MATTERS) if friction else (OtherLogs.excess, BETTER**-2)
    sizes = np.array([of(fit, own) for fit, own in zip(others, each, strict=True)])
    k = 1 if len(logs) == 2 else int(np.argmax(np.log(sizes + NOTHING).sum(axis=1)))
    return (others[k], sizes[k]) if sizes[k].max() > least else None


def _friction(sample: Sample, rows: Array) -> Array:
    """Return columns of Coulomb and viscous friction and an offset of each joint, (n, N, 3)."""
    motions = [motion.at(rows) for motion in sample.motions]
    return np.stack([np.column_stack([m.direction, m.v, np.ones_like(m.v)]) for m in motions])


def _squares(products: Array, x: Array) -> Array:
    """Return the squared residual of each joint: products (n, b + 1, b + 1), x (b,) -> (n,)."""
    x = np.append(-x, 1.0)
    return np.asarray(np.maximum(x @ products @ x, 0.0))


@dataclass(frozen=True, eq=False)
class _Products:
    """Products X^T X of the rows X = [W, r] of each joint."""

    all: Array  # (n, b + 1, b + 1)
    free: Array  # (n, b + 1, b + 1), of rows orthogonal to friction and offset
    rows: Array  # (n,), number of rows
    torque: Array  # (n,), their squared torque

    @classmethod
    def of(cls, sample: Sample, rows: Array) -> "_Products":
        """Return the products of some samples."""
        X = np.concatenate([sample.W[rows], sample.r[rows, :, None]], axis=2).swapaxes(0, 1)
        weight = sample.weight[rows].T
        Q = np.linalg.qr(weight[..., None] * _friction(sample, rows))[0]  # (n, N, 3)
        P, S = X.swapaxes(1, 2) @ X, Q.swapaxes(1, 2) @ X
        torque = weight * np.concatenate([motion.tau for motion in sample.at])[rows].T
        count = np.count_nonzero(weight, axis=1)
        return cls(P, P - S.swapaxes(1, 2) @ S, count, np.sum(torque**2, axis=1))


@dataclass(frozen=True, eq=False)
class OtherLogs:
    """The fit to all logs but one."""

    is_out: Sequence[bool]  # whether a recording is of the log left out
    change: Array  # (b,), of the base parameters over their prior spread
    L: Array  # (b, b), lower factor of their precision
    scale: Array  # (n,), one over the noise of each joint; 0 without rows
    share: float  # of independent samples

    @classmethod
    def of(cls, is_out: Sequence[bool], products: Array, rows: Array, share: float) -> "OtherLogs":
        """Return the fit to products (n, b + 1, b + 1) of the other logs' rows (n,)."""
        change = np.zeros(products.shape[-1] - 1)
        for _ in range(2):  # the noise of each joint is its residual in the fit before
            noise = np.sqrt(_squares(products, change) / np.maximum(rows * share, 1.0))
            scale = np.divide(1.0, noise, out=np.zeros_like(noise), where=noise > 0.0)
            P = np.tensordot(scale**2, products, axes=1)
            prior = np.diag(1.0 + EXACT**2 * np.diagonal(P)[:-1])  # beyond the products' rounding
            L = np.linalg.cholesky(P[:-1, :-1] + prior)
            change = np.linalg.solve(L.T, np.linalg.solve(L, P[:-1, -1]))
        return cls(is_out, change, L, scale, share)

    def excess(self, own: _Products) -> Array:
        """Return the mean square of a log's residual with other friction, in variances, (n,)."""
        P = np.tensordot(self.scale**2, own.free, axes=1)
        A = self.L @ self.L.T
        x = np.linalg.solve(P[:-1, :-1] + A, P[:-1, -1] + A @ self.change)
        squares = self.scale**2 * _squares(own.free, x)
        return np.asarray(squares / np.maximum(own.rows * self.share, 1.0))

    def friction(self, own: _Products) -> Array:
        """Return the change of a log's friction over its torque, RMS, (n,); 0 if not clear."""
        before, left = (_squares(products, self.change) for products in (own.all, own.free))
        share = np.sqrt((before - left) / np.maximum(own.torque, NOTHING))
        return np.where(left < BETTER**2 * before, share, 0.0)

    def left_out(self, sample: Sample) -> tuple[Sample, Array]:
        """Return samples of the log left out, with this fit as the prior, and which they are."""
        rows = np.repeat(self.is_out, [len(k) for k in sample.taken])
        W, weight = self.scale[:, None] * sample.W[rows], self.scale * sample.weight[rows]
        r = self.scale * sample.r[rows] - W @ self.change
        W = W @ np.linalg.inv(self.L).T
        standard = sample.standard.copy()
        standard[sample.independent] += sample.U.T @ self.change
        at, segments = tuple(compress(sample.at, self.is_out)), cut_segments([len(r)], self.share)
        tau = np.concatenate([motion.tau for motion in at])
        own = replace(
            sample, motions=tuple(motion.at(rows) for motion in sample.motions),
            recordings=tuple(compress(sample.recordings, self.is_out)), at=at, weight=weight,
            taken=tuple(compress(sample.taken, self.is_out)), segments=segments,
            torque=np.sum((weight * tau) ** 2, axis=0), rows=len(r), W=W, r=r, standard=standard,
            U=solve_triangular(self.L, sample.U, lower=True),
            normal=Normal.of(W, r, segments, len(segments)),
        )  # fmt: skip
        friction = np.einsum("jkc,ji->kijc", _friction(sample, rows), np.eye(len(weight.T)))
        return own.with_columns(friction.reshape(*r.shape, -1)), rows
