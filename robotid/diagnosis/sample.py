"""Rows of the recordings to test terms on, and what columns beside the regressor explain of them.

Columns Z of a candidate term join the regressor, and theta is refitted without one stretch of the
logs after the other, base parameters and all:

    r = W delta + Z theta + e,    theta = (Z^T M Z)^-1 Z^T M r,    M = 1 - W (W^T W + C^-1)^-1 W^T,

so that what base parameters can explain does not count (Frisch, Waugh 1933); C is their covariance
before the data. What a term explains of the stretches left out, it explains beyond chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from robotid._typing import Array
from robotid.fitting.evaluation import Evaluation, Recording
from robotid.fitting.joint_motion import JointMotion, joint_motions, travelled
from robotid.fitting.result import Solution
from robotid.logs.data import Trajectory
from robotid.regressor.torque import trajectory_regressor
from robotid.regressor.used_rows import independent_share
from robotid.robot.model import RobotModel

__all__ = ["Sample", "Trial", "along", "take_sample", "trials"]

_ROWS = 3000  # of all fitted logs, and of all kept ones, that are read
_NUMBERS = 2**24  # of the regressor in them
_PER_INDEPENDENT = 2.0  # rows for each that is independent behind the filter
_STRETCHES = 16  # left out in turn
_SHORTEST = 10  # independent rows in a stretch
_FEWEST = 6  # stretches to judge by
_NEAR = 0.5  # periods of the filter's cut-off
_OUTLIER = 12.0  # usual residuals from which a row is left out
_RIDGE = 1e-4  # share of a column that the regressor must leave of it
_FREE = 1e3  # residuals that a column beside the base parameters may explain before the data


@dataclass(frozen=True, eq=False)
class Sample:
    """Rows of the recordings, each joint's over its usual residual, 0 where they are not used.

    Attributes:
        joints: Names of the n joints.
        slides: Which of them slide, shape (n,), bool.
        motions: How each joint moves in the N rows.
        at: The motions of the recordings, those rows alone.
        taken: Which rows of the recordings these are, of fitted ones and then of those kept.
        weight: What torques of the rows are multiplied by, shape (N, n) [1/(N m), 1/N].
        torque: Sum of the squared torques of fitted rows, likewise weighted, shape (n,).
        stretches: Which rows each of the K stretches has, those of the logs kept apart last.
        fitted: How many of the stretches are of fitted logs.
        rows: How many of the rows are.
        W: Regressor of the base parameters over their spread before the data, shape (N, n, b), and
            columns that are refitted beside them.
        r: Residual of the estimate, shape (N, n).
        independent: Which columns of the regressor are those of base parameters, shape (b,), int.
        U: Factor of the covariance of base parameters before the data, C = U^T U, shape (b, b).
        A: W^T W of each stretch, all joints together, shape (K, b, b).
        B: W^T r likewise, shape (K, b).
    """

    joints: tuple[str, ...]
    slides: Array
    motions: tuple[JointMotion, ...]
    at: tuple[Trajectory, ...]
    taken: tuple[Array, ...]
    weight: Array
    torque: Array
    stretches: tuple[slice, ...]
    fitted: int
    rows: int
    W: Array
    r: Array
    independent: Array
    U: Array
    A: Array
    B: Array

    def beside(self, Z: Array) -> "Sample":
        """Return the same rows with more columns that are refitted as base parameters are.

        Args:
            Z: What sizes of 1 add to the torques, shape (N, n, c) [N m or N].
        """
        columns = self.weight[:, :, None] * Z
        size = np.linalg.norm(columns, axis=(0, 1))
        spread = _FREE * np.linalg.norm(self.r) / np.where(size > 0, size, np.inf)
        W = np.concatenate([self.W, columns * spread], axis=2)
        A, B = _products(W, self.r, self.stretches)
        return replace(self, W=W, A=A, B=B)

    @cached_property
    def is_fitted(self) -> Array:
        """Which of the stretches are of fitted logs, shape (K,), bool."""
        return np.arange(len(self.stretches)) < self.fitted

    @cached_property
    def apart(self) -> tuple[Array, Array]:
        """What row k of stretches is fitted to that judges it not, (K, K), and its inverses."""
        used = (self.is_fitted & ~np.eye(len(self.stretches), dtype=bool)).astype(float)
        return used, self._inverse(used)

    @cached_property
    def whole(self) -> tuple[Array, Array]:
        """All stretches of fitted logs, shape (K,), and the inverse (A + 1)^-1 of their sum."""
        used = self.is_fitted.astype(float)
        return used, self._inverse(used)

    def _inverse(self, used: Array) -> Array:
        A: Array = np.tensordot(used, self.A, axes=1)
        return np.asarray(np.linalg.inv(A + np.eye(A.shape[-1])))


def take_sample(fit: Solution, *, is_steady: bool = True) -> Sample | None:
    """Return rows spread over the recordings; None if there are too few, or static ones.

    Args:
        fit: What was found.
        is_steady: Whether rows near reversals are left out, where a drive that sticks is smeared.
    """
    model, mapping = fit.model, fit.mapping
    if model.is_static:
        return None
    kept = [e for e in fit.validation if not e.is_refitted]
    rows, independent = _spread_rows(model, fit.fitted, kept)
    own = sum(map(len, rows[: len(fit.fitted)]))
    stretches = _stretches(own, sum(map(len, rows)) - own, independent)
    number = sum(part.stop <= own for part in stretches)
    if model.free_flyer or number < _FEWEST:
        return None
    parts = list(zip([*fit.fitted, *kept], rows, strict=True))
    motion = [e.recording.trajectory.at(k) for e, k in parts]
    Y = np.concatenate([_regressor(model, e.recording.trajectory, k) for e, k in parts])
    tau = np.concatenate([m.tau for m in motion])
    r = tau - Y @ fit.standard
    used = np.concatenate([e.recording.mask[k] for e, k in parts])
    if is_steady:
        used &= np.concatenate([_is_steady(e.recording)[k] for e, k in parts])
    used = used & (np.abs(r) <= _OUTLIER * _usual_size(r[:own], used[:own]))
    squares = np.sum(r[:own] ** 2, axis=0, where=used[:own])
    scale = np.sqrt(squares / np.maximum(used[:own].sum(axis=0), 1))
    weight = used * np.sqrt(independent) / np.where(scale > 0, scale, np.inf)
    size = model.layout.n_inertial
    load = Y[:, :, :size] @ fit.standard[:size]
    # over their spread before the data, C = U^T U, base parameters are of size 1
    U = np.asarray(np.linalg.qr((mapping.K * fit.prior_std).T, mode="r"))
    W = weight[:, :, None] * (Y[:, :, mapping.independent] @ U.T)
    r = weight * r
    A, B = _products(W, r, stretches)
    return Sample(
        joints=model.joints,
        slides=np.isin(model.joints, list(model.layout.prismatic)),
        motions=joint_motions([e.recording for e, _ in parts], rows, load, model),
        at=tuple(motion),
        taken=tuple(rows),
        weight=weight,
        torque=np.sum((weight * tau)[:own] ** 2, axis=0),
        stretches=stretches,
        fitted=number,
        rows=own,
        W=W,
        r=r,
        independent=mapping.independent,
        U=U,
        A=A,
        B=B,
    )


def along(sample: Sample, model: RobotModel, at: Sequence[Trajectory], tau: Array) -> Sample:
    """Return the same rows of another robot, or with other positions than the recordings have.

    Args:
        sample: The rows.
        model: The robot, of the same parameters.
        at: The motions, as of ``Sample.at``.
        tau: Torques of the estimate along them, shape (N, n) [N m or N].
    """
    known = sample.independent
    Y = np.concatenate([_regressor(model, motion)[:, :, known] for motion in at])
    W = sample.weight[:, :, None] * (Y @ sample.U.T)
    W = np.concatenate([W, sample.W[:, :, W.shape[2] :]], axis=2)
    r = sample.weight * (np.concatenate([motion.tau for motion in at]) - tau)
    A, B = _products(W, r, sample.stretches)
    return replace(sample, at=tuple(at), W=W, r=r, A=A, B=B)


def _products(W: Array, r: Array, stretches: Sequence[slice]) -> tuple[Array, Array]:
    """Return W^T W and W^T r of each stretch, all joints together."""
    pairs = [(W[k].reshape(-1, W.shape[2]), r[k].ravel()) for k in stretches]
    return np.array([W_k.T @ W_k for W_k, _ in pairs]), np.array(
        [W_k.T @ r_k for W_k, r_k in pairs]
    )


def _spread_rows(
    model: RobotModel, fitted: Sequence[Evaluation], kept: Sequence[Evaluation]
) -> tuple[list[Array], float]:
    """Return which rows of each recording are read, and the share of them that is independent."""
    most = min(_ROWS, _NUMBERS // (model.n_rows * len(model.layout.names)))
    rows, shares = [], []
    for evaluations in (fitted, kept):
        least = -(-sum(len(e.recording.trajectory.t) for e in evaluations) // most)
        for e in evaluations:
            share = independent_share(e.recording.signals)
            step = max(least, int(1.0 / (_PER_INDEPENDENT * share)), 1)
            rows.append(np.arange(0, len(e.recording.trajectory.t), step))
            shares.append(min(1.0, share * step))
    return rows, min(shares)


def _stretches(fitted: int, kept: int, independent: float) -> tuple[slice, ...]:
    """Return how the rows of fitted and kept recordings are cut into stretches."""
    edges = [0]
    for rows in (fitted, kept):
        count = min(_STRETCHES, max(1, int(rows * independent / _SHORTEST))) if rows else 0
        first = edges[-1]
        edges += [first + rows * (i + 1) // count for i in range(count)]
    return tuple(slice(*pair) for pair in pairwise(edges))


def _regressor(model: RobotModel, motion: Trajectory, samples: Array | None = None) -> Array:
    """Return the regressor of the standard parameters at some samples, shape (N, n, p)."""
    Y = trajectory_regressor(model, motion, samples)
    return Y.reshape(-1, model.n_rows, Y.shape[1])


def _usual_size(r: Array, used: Array) -> Array:
    """Return the median size of each joint's residual over the rows used, shape (n,)."""
    columns = zip(r.T, used.T, strict=True)
    return np.array([np.median(np.abs(x[k])) if k.any() else np.inf for x, k in columns])


def _is_steady(recording: Recording) -> Array:
    """Return where no reversal of a joint, nor its standing still, is near, shape (N, n), bool.

    A drive that sticks there is smeared by the filter, and no friction.
    """
    motion, signals = recording.trajectory, recording.signals
    if signals.cutoff is None:
        return np.ones(motion.v.shape, dtype=bool)
    slow = (np.abs(motion.v) < signals.min_velocity) | (travelled(motion) == 0.0)
    steady = np.empty(slow.shape, dtype=bool)
    for j, at in enumerate(slow.T):
        times = np.concatenate([[-np.inf], motion.t[at], [np.inf]])
        after = np.searchsorted(times, motion.t, side="right")
        near = np.minimum(motion.t - times[after - 1], times[after] - motion.t)
        steady[:, j] = near > _NEAR / signals.cutoff
    return steady


@dataclass(frozen=True, eq=False)
class Trial:
    """What columns Z of a joint, beside the base parameters, leave of its residual.

    Attributes:
        S: [Z r]^T M [Z r] of the rows fitted, shape (..., c + 1, c + 1).
        H: What [Z r] leaves of each stretch after the regressor's fit, shape (K, c + 1, c + 1).
        T: What of the columns of W imitates [Z r], shape (..., b, c + 1).
    """

    S: Array
    H: Array
    T: Array

    def parameters(self, which: Sequence[int]) -> Array:
        """Return the parameters of some columns, shape (..., k).

        Args:
            which: The k columns.
        """
        square = self.S[..., which, :][..., which]
        theta: Array = np.linalg.solve(square, self.S[..., which, -1:])[..., 0]
        return theta

    def estimate(self, which: Sequence[int], fitted: int) -> tuple[Array, Array]:
        """Return the parameters of some columns and their covariance, shapes (k,) and (k, k).

        Of a fit to all rows; from scores that scatter from stretch to stretch, as noise of any
        colour does.

        Args:
            which: The k columns.
            fitted: How many of the stretches are of fitted logs.
        """
        theta, S = self.parameters(which), self.S[which][:, which]
        H = self.H[:fitted, which]
        scores = H[:, :, -1] - H[:, :, which] @ theta  # (K, k)
        inverse, few = np.linalg.inv(S), len(scores) / (len(scores) - 1)
        covariance: Array = few * (inverse @ (scores.T @ scores) @ inverse)
        return theta, covariance

    def left(self, which: Sequence[int]) -> Array:
        """Return the squared residual of each stretch with some columns fitted, shape (K,).

        Args:
            which: The columns.
        """
        if not which:
            alone: Array = self.H[:, -1, -1]
            return alone
        theta = np.broadcast_to(self.parameters(which), (len(self.H), len(which)))
        x = np.hstack([-theta, np.ones((len(theta), 1))])
        square = self.H[:, [*which, -1], :][:, :, [*which, -1]]
        left: Array = np.einsum("ki,kij,kj->k", x, square, x)
        return left


def trials(sample: Sample, joints: slice, Z: Array, ridge: float = _RIDGE) -> tuple[Trial, Trial]:
    """Return trials of columns: fitted without the stretch that judges, and to all.

    Args:
        sample: The rows.
        joints: Which m joints are looked at.
        Z: What sizes of 1 add to their torques, shape (N, m, c).
        ridge: Share of a column that the regressor must leave of it.
    """
    X = np.concatenate([sample.weight[:, joints, None] * Z, sample.r[:, joints, None]], axis=2)
    every_X = [X[k].reshape(-1, X.shape[2]) for k in sample.stretches]
    every_W = [
        sample.W[k, joints].reshape(len(x), -1)
        for k, x in zip(sample.stretches, every_X, strict=True)
    ]
    D = np.array([x.T @ x for x in every_X])  # (K, c + 1, c + 1)
    B = np.array([w.T @ x for w, x in zip(every_W, every_X, strict=True)])  # (K, b, c + 1)
    B[:, :, -1] = sample.B  # other joints know of the base parameters, too

    def trial(used: Array, inverse: Array) -> Trial:
        D_fit, B_fit = (np.tensordot(used, x, axes=1) for x in (D, B))
        T = inverse @ B_fit  # (..., b, c + 1)
        S = D_fit - B_fit.swapaxes(-1, -2) @ T
        c = np.arange(S.shape[-1] - 1)
        still = D_fit[..., c, c] == 0  # a column of a joint that does not move
        S[..., c, c] += np.where(still, 1.0, ridge * D_fit[..., c, c])
        E = [
            x - w @ T_k
            for x, w, T_k in zip(every_X, every_W, np.broadcast_to(T, B.shape), strict=True)
        ]
        return Trial(S, np.array([E_k.T @ E_k for E_k in E]), T)

    return trial(*sample.apart), trial(*sample.whole)
