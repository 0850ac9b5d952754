"""Samples of the recordings for tests of terms, and trials of columns added to the regressor.

Columns Z are added to the regressor. Their parameters theta are refitted with the base parameters,
with one segment of the logs held out after the other:

    r = W delta + Z theta + e,    theta = (Z^T M Z)^-1 Z^T M r,    M = 1 - W (W^T W + C^-1)^-1 W^T,

so that what base parameters, with prior covariance C, can explain does not count (Frisch, Waugh
1933). A term that is not in the data does not reduce the residual of held-out segments.
``Trials.accepted`` is the one comparison of all readings: of the drives' terms (``misfit``) and of
recordings and the URDF (``discrepancies``).

With constraint forces eliminated, the torque z of joint j is P e_j z in all rows, along the unit
vector u = P e_j / sqrt(P_jj). The equation of the joint alone is that along u: row j of the
projected rows over sqrt(P_jj), where the column is sqrt(P_jj) z.
"""

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Generic

import numpy as np

from robotid.base.tolerances import REMAINDER
from robotid.base.typing import Array
from robotid.data.log import Trajectory
from robotid.diagnosis import decisions
from robotid.diagnosis.decisions import Option, Round, Rule, p_value, select
from robotid.diagnosis.logs.channels import distance
from robotid.diagnosis.logs.torque_delay import NEAR
from robotid.dynamics.constraint_rows import without_forces
from robotid.dynamics.prepared_logs import independent_share
from robotid.dynamics.torque import trajectory_regressor
from robotid.estimation.fitting.drive_terms import JointMotion, joint_motions, travelled
from robotid.estimation.fitting.evaluation import Evaluation, Recording
from robotid.estimation.fitting.fitted import Solution
from robotid.robot.model import RobotModel

RIDGE = 1e-4  # Smallest share of a column that the regressor must not explain
_NUMBERS = 2**24  # elements of the regressor of all fitted logs together, and of validation logs
_PER_INDEPENDENT = 2.0  # samples per independent one behind the filter
_FREE = 1e3  # prior spread of an added column, in residuals


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations of the base parameters in K segments, all joints together."""

    A: Array  # W^T W of each segment, shape (K, b, b)
    B: Array  # W^T r of each segment, shape (K, b)
    fitted: int  # Number of segments of fitted logs, which come first

    @classmethod
    def of(cls, W: Array, r: Array, segments: Sequence[slice], fitted: int) -> "Normal":
        """Return the normal equations of samples: W (N, n, b), r (N, n)."""
        rows = [(W[k].reshape(-1, W.shape[2]), r[k].ravel()) for k in segments]
        A, B = (np.array(x) for x in zip(*[(w.T @ w, w.T @ e) for w, e in rows], strict=True))
        return cls(A, B, fitted)

    @cached_property
    def is_fitted(self) -> Array:
        """Which of the segments are of fitted logs, shape (K,), bool."""
        return np.arange(len(self.A)) < self.fitted

    @cached_property
    def held_out(self) -> tuple[Array, Array]:
        """Segments fitted while segment k is held out, row k of (K, K), and the inverses."""
        K, fitted = len(self.A), self.fitted
        used = (self.is_fitted & ~np.eye(K, dtype=bool)).astype(float)
        own, whole = self._inverse(used[:fitted]), self.whole[1]
        return used, np.concatenate([own, np.broadcast_to(whole, (K - fitted, *whole.shape))])

    @cached_property
    def whole(self) -> tuple[Array, Array]:
        """All segments of fitted logs, shape (K,), and the inverse (A + 1)^-1 of their sum."""
        used = self.is_fitted.astype(float)
        return used, self._inverse(used)

    def _inverse(self, used: Array) -> Array:
        A: Array = np.tensordot(used, self.A, axes=1)
        return np.asarray(np.linalg.inv(A + np.eye(A.shape[-1])))


@dataclass(frozen=True, eq=False)
class Sample:
    """Samples of the recordings, weighted for each joint by its RMS residual, 0 where not used."""

    # Rows of a floating base precede those of the n joints.

    joints: tuple[str, ...]
    is_prismatic: Array  # (n,), bool
    motions: tuple[JointMotion, ...]  # of each joint in the N samples
    recordings: tuple[Recording, ...]  # the fitted ones, then those of validation, if used
    at: tuple[Trajectory, ...]  # their motions at these samples
    taken: tuple[Array, ...]  # indices of these samples in each recording
    # (N, n_rows), of torques [1/(N m), 1/N]; alike if constraint forces are eliminated
    weight: Array
    torque: Array  # (n_rows,), weighted sum of the squared torques of fitted samples
    segments: tuple[slice, ...]  # samples of each of the K segments, of validation logs last
    rows: int  # number of samples of fitted logs
    W: Array  # (N, n_rows, b), regressor of base parameters over their spread, and more columns
    r: Array  # (N, n_rows), residual of the estimate
    independent: Array  # (b,), columns of the regressor that belong to base parameters
    U: Array  # (b, b), factor of the prior covariance of base parameters, C = U^T U
    normal: Normal  # of the segments, all joints together
    standard: Array  # (p,), standard parameters of the estimate
    basis: Array | None = None  # as of ``Trajectory.basis``, at these samples
    share: float = 1.0  # of independent samples

    @property
    def fitted(self) -> int:
        """Number of segments of fitted logs."""
        return self.normal.fitted

    def with_columns(self, Z: Array) -> "Sample":
        """Return the same samples with more columns that are refitted with the base parameters."""
        left = Z if self.basis is None else without_forces(self.basis, Z)
        columns = self.weight[:, :, None] * left
        size = np.linalg.norm(columns, axis=(0, 1))
        spread = _FREE * np.linalg.norm(self.r) / np.where(size > 0, size, np.inf)
        W = np.concatenate([self.W, columns * spread], axis=2)
        return replace(self, W=W, normal=Normal.of(W, self.r, self.segments, self.fitted))

    def in_blocks(self, rows: int, length: int) -> tuple["Sample", Array]:
        """Return the first samples in folds of interleaved blocks, and their order."""
        fold = np.arange(rows) // length % decisions.SEGMENTS
        order, edges = np.argsort(fold, kind="stable"), np.cumsum([0, *np.bincount(fold)]).tolist()
        segments = tuple(slice(*pair) for pair in pairwise(edges))
        W, r, weight = self.W[order], self.r[order], self.weight[order]
        normal = Normal.of(W, r, segments, len(segments))
        return replace(self, W=W, r=r, weight=weight, segments=segments, normal=normal), order

    def of_joint(self, j: int) -> "Sample":
        """Return the samples of one joint; other joints count only in the normal equations."""
        row = self.weight.shape[1] - len(self.joints) + j
        own, joint = slice(row, row + 1), slice(j, j + 1)
        alone = replace(
            self, joints=self.joints[joint], is_prismatic=self.is_prismatic[joint],
            motions=self.motions[joint], weight=self.weight[:, own], torque=self.torque[own],
            W=np.ascontiguousarray(self.W[:, own]), r=self.r[:, own], basis=None,
        )  # fmt: skip
        if self.basis is None:
            return alone
        u = _lengths(self.basis)[:, own]
        tau = np.concatenate([motion.tau[:, own] for motion in self.at])
        torque = np.sum((alone.weight * tau / u)[: self.rows] ** 2, axis=0)
        weight, W, r = u * alone.weight, alone.W / u[..., None], alone.r / u
        return replace(alone, weight=weight, torque=torque, W=W, r=r)

    @cached_property
    def own(self) -> Normal:
        """Normal equations of its own samples, those of one joint."""
        return Normal.of(self.W, self.r, self.segments, self.fitted)

    def reweighted(self, factor: float) -> "Sample":
        """Return the samples of one joint with other weights."""
        more = factor**2 - 1.0
        A, B = self.normal.A + more * self.own.A, self.normal.B + more * self.own.B
        return replace(
            self, weight=factor * self.weight, torque=factor**2 * self.torque, W=factor * self.W,
            r=factor * self.r, normal=replace(self.normal, A=A, B=B),
        )  # fmt: skip

    def joined(self) -> "Sample":
        """Return the samples of fitted logs as one segment, for a fit to all of them."""
        rows, normal = slice(self.rows), self.normal
        A, B = (x[: self.fitted].sum(axis=0, keepdims=True) for x in (normal.A, normal.B))
        weight, W, r = self.weight[rows], self.W[rows], self.r[rows]
        return replace(self, weight=weight, segments=(rows,), W=W, r=r, normal=Normal(A, B, 1))


def take_sample(fit: Solution, *, for_drives: bool = False, is_free: bool = False) -> Sample | None:
    """Return samples spread over the recordings; None if there are too few, or static ones."""
    model, mapping = fit.model, fit.mapping
    if model.is_static:
        return None
    validation = [e for e in fit.validation if not e.is_refitted]
    rows, independent = _spread_rows(model, fit.fitted, validation)
    parts = list(zip([*fit.fitted, *validation], rows, strict=True))
    if for_drives:
        del parts[len(fit.fitted) :]
    rows = [k for _, k in parts]
    own = sum(map(len, rows[: len(fit.fitted)]))
    segments = cut_segments([own, sum(map(len, rows)) - own], independent)
    number = sum(part.stop <= own for part in segments)
    if number < decisions.FEWEST:
        return None
    motion = [e.recording.trajectory.at(k) for e, k in parts]
    Y = np.concatenate([regressor(model, e.recording.trajectory, k) for e, k in parts])
    tau = np.concatenate([m.tau for m in motion])
    size, first = model.layout.n_inertial, model.n_rows - len(model.joints)
    load = Y[:, first:, :size] @ fit.standard[:size]
    bases = [m.basis for m in motion if m.basis is not None]
    basis = np.concatenate(bases) if bases else None
    r = tau - Y @ fit.standard
    used = np.concatenate([e.recording.mask[k] for e, k in parts])
    if basis is None and not for_drives:
        used &= np.concatenate([_is_steady(e.recording)[k] for e, k in parts])
    # C = U^T U: base parameters over their prior spread are of size 1
    U = np.asarray(np.linalg.qr((mapping.K * fit.prior_std).T, mode="r"))
    used, scale = _noise_level(r, used, own, basis)
    weight = used * np.sqrt(independent) / np.where(scale > 0, scale, np.inf)
    W = _in_units(Y, mapping.independent, U)
    W *= weight[:, :, None]
    recordings = tuple(e.recording for e, _ in parts)
    sample = Sample(
        joints=model.joints, is_prismatic=np.isin(model.joints, list(model.layout.prismatic)),
        motions=joint_motions(recordings, rows, load, model), recordings=recordings,
        at=tuple(motion), taken=tuple(rows), weight=weight,
        torque=np.sum((weight * tau)[:own] ** 2, axis=0), segments=segments, rows=own, W=W,
        r=weight * r, independent=mapping.independent, U=U,
        share=independent, normal=Normal.of(W, weight * r, segments, number),
        standard=fit.standard, basis=basis,
    )  # fmt: skip
    return _free(sample, Y[..., mapping.independent]) if is_free else sample


def _free(sample: Sample, X: Array) -> Sample:
    """Return the samples with the bodies of least squares, if these predict held-out segments."""
    # A prior that is wrong binds the bodies, and its error looks like friction.
    W = sample.weight[..., None] * X
    size = np.linalg.norm(W[: sample.rows], axis=(0, 1))
    spread = _FREE * np.linalg.norm(sample.r) / np.where(size > 0, size, np.inf)
    W *= spread
    normal = Normal.of(W, sample.r, sample.segments, sample.fitted)
    free = replace(sample, W=W, U=np.diag(spread), normal=normal)
    none = np.empty((*sample.r.shape, 0))
    before, after = (Trials(x, none).held_out.left([]) for x in (sample, free))
    if p_value(before, after, sample.fitted) >= decisions.FAMILY_P_VALUE:
        return sample
    change = normal.whole[1] @ normal.B[: sample.fitted].sum(axis=0)
    standard = sample.standard.copy()
    standard[sample.independent] += spread * change
    r = sample.r - W @ change
    # rows that were projected together have one noise level
    old, new = (np.sum(x[: sample.rows] ** 2, axis=0) for x in (sample.r, r))
    if sample.basis is not None:
        old, new = (np.full(len(x), x.sum()) for x in (old, new))
    factor = np.sqrt(old / np.where(new > 0, new, np.inf))
    weight, W, r = factor * sample.weight, factor[:, None] * W, factor * r
    return replace(
        free, weight=weight, W=W, r=r, torque=factor**2 * sample.torque, standard=standard,
        normal=Normal.of(W, r, sample.segments, sample.fitted),
    )  # fmt: skip


def along(sample: Sample, model: RobotModel, at: Sequence[Trajectory], tau: Array) -> Sample:
    """Return the same samples for another robot, or with changed positions."""
    Y = np.concatenate([regressor(model, motion) for motion in at])
    W = sample.weight[:, :, None] * _in_units(Y, sample.independent, sample.U)
    W = np.concatenate([W, sample.W[:, :, W.shape[2] :]], axis=2)
    r = sample.weight * (np.concatenate([motion.tau for motion in at]) - tau)
    normal = Normal.of(W, r, sample.segments, sample.fitted)
    return replace(sample, at=tuple(at), W=W, r=r, normal=normal)


def _spread_rows(
    model: RobotModel, fitted: Sequence[Evaluation], validation: Sequence[Evaluation]
) -> tuple[list[Array], float]:
    """Return the samples used of each recording, and the share of them that is independent."""
    most = min(decisions.ROWS, _NUMBERS // (model.n_rows * len(model.layout.names)))
    rows, shares = [], []
    for evaluations in (fitted, validation):
        least = -(-sum(len(e.recording.trajectory.t) for e in evaluations) // most)
        for e in evaluations:
            share = independent_share(e.recording.signals)
            step = max(least, int(1.0 / (_PER_INDEPENDENT * share)), 1)
            rows.append(np.arange(0, len(e.recording.trajectory.t), step))
            shares.append(min(1.0, share * step))
    return rows, min(shares)


def cut_segments(sizes: Sequence[int], independent: float) -> tuple[slice, ...]:
    """Return the segments of the samples of several groups of recordings."""
    edges = [0]
    for rows in sizes:
        enough = max(1, int(rows * independent / decisions.SHORTEST))
        count = min(decisions.SEGMENTS, enough) if rows else 0
        edges += [edges[-1] + rows * (i + 1) // count for i in range(count)]
    return tuple(slice(*pair) for pair in pairwise(edges))


def regressor(model: RobotModel, motion: Trajectory, rows: Array | slice = slice(None)) -> Array:
    """Return the regressor of the standard parameters at some samples, shape (N, n, p)."""
    Y = trajectory_regressor(model, motion, rows)
    return Y.reshape(-1, model.n_rows, Y.shape[1])


def _in_units(Y: Array, independent: Array, U: Array) -> Array:
    """Return the independent columns of regressors (N, n, p) times U^T, shape (N, n, b)."""
    units = np.zeros((Y.shape[2], len(U)))
    units[independent] = U.T  # one product of all rows, without a copy of these columns
    return (Y.reshape(-1, len(units)) @ units).reshape(*Y.shape[:2], len(U))


def _lengths(basis: Array) -> Array:
    """Return sqrt(P_jj), the length of P e_j, of each row, shape (N, n_rows)."""
    squares = 1.0 - np.sum(basis**2, axis=2)
    return np.asarray(np.sqrt(np.maximum(squares, REMAINDER)))


def _noise_level(r: Array, used: Array, own: int, basis: Array | None) -> tuple[Array, Array]:
    """Return the used rows without outliers, and the RMS residual of each row, (n_rows,)."""
    # Rows that were projected together have one noise level, and an outlier excludes its sample.
    u = np.ones(r.shape) if basis is None else _lengths(basis)
    size = np.abs(r) / u
    typical = np.zeros((2, r.shape[1]))  # of fitted and of validation logs, whose error is no jump
    for k, rows in enumerate((slice(own), slice(own, None))):
        columns = zip(size[rows].T, used[rows].T, strict=True)
        typical[k] = [np.median(x[at]) if at.any() else np.inf for x, at in columns]
    largest = np.repeat([typical[0], typical.max(axis=0)], [own, len(r) - own], axis=0)
    usual: Array = size <= decisions.OUTLIER * largest
    if basis is not None:
        usual = np.all(usual | ~used, axis=1, keepdims=True)
    used = used & usual
    squares = np.sum(r[:own] ** 2, axis=0, where=used[:own])
    freedom = np.sum(u[:own] ** 2, axis=0, where=used[:own])
    if basis is not None:
        squares, freedom = (np.full(len(x), x.sum()) for x in (squares, freedom))
    return used, np.sqrt(squares / np.maximum(freedom, 1))


def _is_steady(recording: Recording) -> Array:
    """Return the samples that are far from reversals and rest of each joint, shape (N, n), bool."""
    # Near these the filter smears stiction, which then does not look like friction.
    motion, signals = recording.trajectory, recording.signals
    if signals.cutoff is None:
        return np.ones(motion.v.shape, dtype=bool)
    slow = (np.abs(motion.v) < signals.min_velocity) | (travelled(motion) == 0.0)
    t, near = motion.t, NEAR / signals.cutoff
    return np.column_stack([distance(t, t[at]) > near for at in slow.T])


@dataclass(frozen=True, eq=False)
class Trial:
    """Fit of columns Z, together with the base parameters, to a residual."""

    S: Array  # [Z r]^T M [Z r] of the fitted samples, shape (..., c + 1, c + 1)
    T: Array  # Fit of the columns of W to [Z r], shape (..., b, c + 1)
    #: W and [Z r] of each of K segments, shapes (N_k, b) and (N_k, c + 1)
    rows: Sequence[tuple[Array, Array]]

    @cached_property
    def H(self) -> Array:
        """Products of [Z r] less its fit by the regressor in each segment, (K, c + 1, c + 1)."""
        every_T = np.broadcast_to(self.T, (len(self.rows), *self.T.shape[-2:]))
        left = [X - W @ T for (W, X), T in zip(self.rows, every_T, strict=True)]
        return np.array([E.T @ E for E in left])

    def parameters(self, which: Sequence[int] | Array) -> Array:
        """Return the parameters of some columns, shape (..., k): which (m, k)."""
        S, k = self.S, np.asarray(which, dtype=int)
        products = S[..., k[..., :, None], k[..., None, :]]
        return np.asarray(np.linalg.solve(products, S[..., k, -1][..., None])[..., 0])

    def estimate(self, which: Sequence[int], fitted: int) -> tuple[Array, Array]:
        """Return the parameters of some columns and their covariance, shapes (k,) and (k, k)."""
        # From the scatter of the scores between segments: valid for noise of any colour.
        theta, S = self.parameters(which), self.S[which][:, which]
        own = [*which, -1]  # all columns together are many
        rows = [(W, X[:, own]) for W, X in self.rows[:fitted]]
        H = replace(self, T=self.T[:, own], rows=rows).H[:, :-1]
        scores = H[:, :, -1] - H[:, :, :-1] @ theta  # (K, k)
        inverse, few = np.linalg.inv(S), len(scores) / (len(scores) - 1)
        covariance: Array = few * (inverse @ (scores.T @ scores) @ inverse)
        return theta, covariance

    def left(self, which: Sequence[int] | Array) -> Array:
        """Return the squared residual of each segment with some columns fitted, shape (K,)."""
        k = np.asarray(which, dtype=int)
        theta = self.parameters(k)
        with_r = np.concatenate([k, np.full((*k.shape[:-1], 1), -1)], axis=-1)
        x = np.concatenate([-theta, np.ones((*theta.shape[:-1], 1))], axis=-1)
        square = self.H[:, with_r[..., :, None], with_r[..., None, :]]
        return np.asarray((x[..., None, :] @ square @ x[..., :, None])[..., 0, 0])

    def left_each(self, choices: Mapping[Option, Sequence[int]]) -> dict[Option, Array]:
        """Return the squared residual of each segment with columns of each option, shapes (K,)."""
        return _each(choices, lambda which: self.left(which).T)

    def parameters_each(self, choices: Mapping[Option, Sequence[int]]) -> dict[Option, Array]:
        """Return the parameters of columns of each option, shapes (k,), of a fit to all samples."""
        return _each(choices, self.parameters)


def _each(
    choices: Mapping[Option, Sequence[int]], of: Callable[[Array], Array]
) -> dict[Option, Array]:
    """Evaluate a function of the columns of each option, all options of one size together."""
    results: dict[Option, Array] = {}
    for size in {len(which) for which in choices.values()}:
        alike = {x: which for x, which in choices.items() if len(which) == size}
        results.update(zip(alike, of(np.array([*alike.values()])), strict=True))
    return {x: results[x] for x in choices}


@dataclass(frozen=True, eq=False)
class Accepted(Generic[Option]):
    """An option that was selected, fitted together with those selected before."""

    option: Option
    others: list[Option]  # that explain about the same
    share: float  # of the squared residual of fitted logs that it removes [-]
    p_value: float  # of that share [-]
    confirmed: float | None  # the same share on validation logs; None without one
    columns: list[int]  # of all selected options, its own c last
    theta: Array  # (c,), its parameters
    covariance: Array  # (c, c), of them


@dataclass(frozen=True, eq=False)
class Trials:
    """Trials of columns."""

    sample: Sample
    Z: Array  # (N, n, c), torques of parameters of 1
    ridge: float = RIDGE

    @classmethod
    def of(
        cls, sample: Sample, columns: Mapping[Option, Array]
    ) -> tuple["Trials", dict[Option, list[int]]]:
        """Return the trials of the columns (N, n, c) of options, and the place of each."""
        ends = np.cumsum([Z.shape[2] for Z in columns.values()]).tolist()
        each = zip(columns.items(), ends, strict=True)
        place = {option: list(range(end - Z.shape[2], end)) for (option, Z), end in each}
        none = np.empty((*sample.r.shape, 0))  # there may be no options
        return cls(sample, np.concatenate([none, *columns.values()], axis=2)), place

    @cached_property
    def held_out(self) -> Trial:
        """Fitted without the segment that is evaluated."""
        return self._trial(*self.sample.normal.held_out)

    @cached_property
    def whole(self) -> Trial:
        """Fitted to all segments of fitted logs."""
        return self._trial(*self.sample.normal.whole)

    def accepted(
        self,
        offered: Mapping[Option, Sequence[int]],
        rule: Rule,
        cost: Callable[[Option], Any],
        tried: Callable[[Option], int] = lambda option: 1,
        excludes: Callable[[Option, Option], bool] = operator.eq,
    ) -> Iterator[Accepted[Option]]:
        """Yield the options that explain the residual, one after the other, by their columns."""
        held_out, fitted, columns = self.held_out, self.sample.fitted, list[int]()
        alone = before = held_out.left([])
        of_fitted, of_validation = (float(x.sum()) for x in np.split(alone, [fitted]))

        def compared() -> Round[Option]:
            left = held_out.left_each({x: [*columns, *own] for x, own in offered.items()})
            return Round(before, left, fitted, of_fitted)

        for trial, best in select(compared, rule, cost, tried):
            if best is None:
                return
            columns += offered[best]
            theta, covariance = self.whole.estimate(columns, fitted)
            new, confirmed = slice(-len(offered[best]), None), None
            if len(alone) > fitted:
                gain = float((before - trial.left[best])[fitted:].sum())
                confirmed = gain / max(of_validation, decisions.NOTHING)
            others = [x for x in trial.alike(rule, tried) if x != best]
            share, chance = trial.share(best), trial.p_value(best)
            parameters = columns.copy(), theta[new], covariance[new, new]
            yield Accepted(best, others, share, chance, confirmed, *parameters)
            before = trial.left[best]
            offered = {x: own for x, own in offered.items() if not excludes(x, best)}

    @cached_property
    def _rows(self) -> list[tuple[Array, Array]]:
        """W and X = [Z r] of each segment."""
        W, r, weight = self.sample.W, self.sample.r[..., None], self.sample.weight[..., None]
        rows = []
        for k in self.sample.segments:  # one by one: all together need twice the memory
            X = np.concatenate([weight[k] * self.Z[k], r[k]], axis=2)
            rows.append((W[k].reshape(-1, W.shape[2]), X.reshape(-1, X.shape[2])))
        return rows

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        """X^T X and W^T X of each segment, shapes (K, c + 1, c + 1) and (K, b, c + 1)."""
        D = np.array([X.T @ X for _, X in self._rows])
        B = np.array([W.T @ X for W, X in self._rows])
        B[:, :, -1] = self.sample.normal.B  # other joints determine the base parameters, too
        return D, B

    def _trial(self, used: Array, inverse: Array) -> Trial:
        D, B = (np.tensordot(used, x, axes=1) for x in self._products)
        T = inverse @ B  # (..., b, c + 1)
        S = D - B.swapaxes(-1, -2) @ T
        c = np.arange(S.shape[-1] - 1)
        is_zero = D[..., c, c] == 0  # a column of a joint that does not move
        S[..., c, c] += np.where(is_zero, 1.0, self.ridge * D[..., c, c])
        return Trial(S, T, self._rows)
