"""What the drive model lacks: the residual of a fit against terms that drives may have.

For each joint, columns Z of a candidate term join the regressor, and theta is refitted without one
stretch of the logs after the other, base parameters and all:

    r = W delta + Z theta + e,    theta = (Z^T M Z)^-1 Z^T M r,    M = 1 - W (W^T W + C^-1)^-1 W^T,

so that what base parameters can explain does not count (Frisch, Waugh 1933); C is their covariance
before the data. What a term explains of the stretches left out, it explains beyond chance.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtr

from robotid._typing import Array
from robotid.findings import Finding, listed, toml_key
from robotid.identification.candidates import (
    CANDIDATES,
    Candidate,
    JointMotion,
    couplings,
    ripples,
)
from robotid.identification.evaluation import Evaluation, Recording
from robotid.logs.data import Trajectory
from robotid.regressor.columns import friction_directions
from robotid.regressor.torque import trajectory_regressor
from robotid.regressor.used_rows import independent_share
from robotid.robot.drives import COUNTERBALANCE, DriveTerm, drive_line, has_turned, spring_family
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.identification.pipeline import Identification

__all__ = [
    "Misfit",
    "Sample",
    "Trial",
    "chance",
    "counterbalanced",
    "find_misfits",
    "joint_motions",
    "misfit_findings",
    "setting_of",
    "settled",
    "take_sample",
    "trials",
    "with_entries",
    "with_known_springs",
]

_ROWS = 3000  # of all fitted logs, and of all kept ones, that are read
_NUMBERS = 2**24  # of the regressor in them
_PER_INDEPENDENT = 2.0  # rows for each that is independent behind the filter
_STRETCHES = 16  # left out in turn
_SHORTEST = 10  # independent rows in a stretch
_FEWEST = 6  # stretches to judge by
_TERMS = 3  # found of one joint, at most
_CHANCE = 3e-4  # that a term is named which is not there, each time that one is tried
_NOTHING = 1e-300
_LEAST = 0.1  # share of the squared residual from which a term is named
_MOST = 0.25  # ... and from which it is a warning
_ONE_SIDED = 0.6  # share from which a coupling is named that the other joint does not show
_SEEN = 0.005  # of the torque: a term smaller than this is not named
_MATTERS = 0.02  # ... and than this is no warning
_MAIN = 50.0  # [%] of the squared residual: a term that explains more outranks a guess
_OF_POSITION = ("position_periodic", "spring", "position_offset")
_OF_MASSES = ("counterbalance", "current_for_torque", "urdf_mismatch")
_SPRINGS = ("ripple", "spring")  # parts of the torque that follow the position
_DIGITS = "0123456789"
_NEAR = 0.5  # periods of the filter's cut-off
_OUTLIER = 12.0  # usual residuals from which a row is left out
_ALIKE = 0.02  # of the squared residual, within which two terms explain alike
_RIDGE = 1e-4  # share of a column that the regressor must leave of it
_FREE = 1e3  # residuals that a column beside the base parameters may explain before the data
_CONFIRMED = 0.25  # of the share, that a validation must show of it for a warning


@dataclass(frozen=True)
class Misfit:
    """A term that the model of a joint's drive lacks.

    Attributes:
        joint: The joint.
        term: The term.
        share: Share of the joint's squared residual that it explains in stretches that were left
            out of the fit, beyond the terms found before it [-].
        chance: How likely that is without such a term [-].
        confirmed: The same share of the validation recordings; None without one.
        size: Its parameter, or the root mean square of its torque, as the term's units say.
        std_error: Standard error of the size.
        unit: Unit of the size.
        error: Residual that base parameters leave without the term, over the torque [-].
        shift: By how much it would move base parameters over their spread, shape (b,).
        theta: The parameters of its columns, shape (c,).
        scale: The motion that scales its columns.
        entries: What a job's [drives] says of the joint to add it; none if nothing does.
    """

    joint: str
    term: Candidate
    share: float
    chance: float
    confirmed: float | None
    size: float
    std_error: float
    unit: str
    error: float
    shift: Array
    theta: Array
    scale: JointMotion
    entries: tuple[str | DriveTerm, ...] = ()

    def torque(self, motion: JointMotion) -> Array:
        """Return the torque of the term along a motion of the joint, shape (N,) [N m or N].

        Args:
            motion: The motion, N rows.
        """
        torque: Array = self.term.columns(replace(motion, scale=self.scale)) @ self.theta
        return torque

    @property
    def matters(self) -> bool:
        """Whether it is a warning."""
        explained = np.sqrt(self.share) * self.error
        is_denied = self.confirmed is not None and self.confirmed < _CONFIRMED * self.share
        is_doubted = is_denied or self.term.is_imitated
        return bool(self.share >= _MOST and explained >= _MATTERS and not is_doubted)


def misfit_findings(identification: "Identification") -> list[Finding]:
    """Return a finding for each term that the model of a drive lacks.

    Args:
        identification: What was found.
    """
    return [_finding(misfit, identification) for misfit in identification.misfits]


def setting_of(misfit: Misfit, identification: "Identification") -> str:
    """Return what to write into a job file to add a term to the model; empty if nothing does.

    A line of [drives], which has what the joint's drive has already, or a table [[coupling]].

    Args:
        misfit: The term.
        identification: What was found without it.
    """
    joint, other = misfit.joint, misfit.term.coupled
    if other:
        ratios = f"{toml_key(joint)} = 1.0, {toml_key(other)} = {misfit.term.ratio}"
        return f"[[coupling]]\nname = {json.dumps(f'{joint}_{other}')}\nratios = {{ {ratios} }}"
    if not misfit.entries:
        return ""
    return f"[drives]\n{with_entries(identification, joint, misfit.entries)}"


def with_entries(
    identification: "Identification", joint: str, entries: Sequence[str | DriveTerm]
) -> str:
    """Return the line of a job's [drives] that adds entries to what a joint's drive has.

    Args:
        identification: What was found without them.
        joint: The joint.
        entries: Names of families, or terms.
    """
    (families, chosen), *_ = [
        *((c.families, c.terms) for c in identification.drives if c.joint == joint),
        ((), ()),
    ]
    stated = [t for t in identification.model.layout.own.get(joint, ()) if t not in chosen]
    kinds = {entry.rstrip(_DIGITS) for entry in entries if isinstance(entry, str)}
    others = [name for name in families if name.rstrip(_DIGITS) not in kinds]
    return drive_line(joint, *stated, *others, *entries)


def find_misfits(sample: "Sample | None") -> tuple[Misfit, ...]:
    """Return the terms that would explain a part of what the fit leaves, the largest first.

    Args:
        sample: Rows of the recordings; None if they are too few to judge by.
    """
    if sample is None:
        return ()
    found = [misfit for j in range(len(sample.joints)) for misfit in _of_joint(sample, j)]
    coupled = [(m.joint, m.term.coupled) for m in found]
    # a drive that turns with two joints loads both
    return tuple(
        m for m in found
        if not m.term.coupled or m.share > _ONE_SIDED or (m.term.coupled, m.joint) in coupled
    )  # fmt: skip


def counterbalanced(found: Sequence[Finding], logs: Sequence[str]) -> dict[str, str]:
    """Return the family of the counterbalance of each joint that the fitted logs show one of.

    Args:
        found: What was found before the fit.
        logs: Names of the fitted logs.
    """
    joints = {}
    for finding in found:
        log, _, joint = finding.where.rpartition(": ")
        if finding.code == "counterbalance" and log in logs:
            joints[joint] = spring_family(finding.evidence["turned"], COUNTERBALANCE)
    return joints


def with_known_springs(found: Sequence[Finding], fit: "Identification") -> list[Finding]:
    """Return what was found before a fit, a counterbalance that its model has as a note.

    Args:
        found: What was found before the fit.
        fit: The fit, whose drives have their terms.
    """
    own = fit.model.layout.own
    springs = {joint for joint, terms in own.items() if any(t.part in _SPRINGS for t in terms)}

    def as_known(finding: Finding) -> Finding:
        joint = finding.where.rpartition(": ")[2]
        if finding.code != "counterbalance" or joint not in springs:
            return finding
        names = listed(term.name for term in own[joint] if term.part in _SPRINGS)
        message = f"{finding.message.partition('. Add')[0]}. The model has it: {names} of {joint}"
        return replace(finding, severity="note", message=message)

    return [as_known(finding) for finding in found]


def settled(found: Sequence[Finding], of_fit: Sequence[Finding]) -> list[Finding]:
    """Return what was found before the fit and of the fit, without guesses that a term explains.

    The doctor knows no springs: a joint whose torque follows its position weighs wrong for him, or
    its torque fits nothing. The term that explains it is a warning then, however little is left.

    Args:
        found: What was found before the fit.
        of_fit: What was found of the fit.
    """
    kept, terms = list(found), []
    for term in of_fit:
        guesses = [f for f in kept if _explains(term, f)]
        kept = [f for f in kept if f not in guesses]
        if guesses:
            codes = listed(dict.fromkeys(f.code for f in guesses))
            message = f"{term.message}. It explains {codes}, and may have gone into masses in part"
            evidence = {**term.evidence, "replaces": float(len(guesses))}
            term = replace(term, severity="warning", message=message, evidence=evidence)
        terms.append(term)
    return kept + terms


def _explains(term: Finding, guess: Finding) -> bool:
    """Return whether a term that the fit found explains what was found before the fit."""
    if term.evidence.get("share_pct", 0.0) < _MAIN:
        return False
    if guess.code == "unexplained_torque":
        return guess.where.rpartition(": ")[2] == term.where
    return guess.code in _OF_MASSES and term.code in _OF_POSITION


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


def take_sample(identification: "Identification", *, is_steady: bool = True) -> Sample | None:
    """Return rows spread over the recordings; None if there are too few, or static ones.

    Args:
        identification: What was found.
        is_steady: Whether rows near reversals are left out, where a drive that sticks is smeared.
    """
    model, mapping = identification.model, identification.mapping
    if model.is_static:
        return None
    kept = [e for e in identification.validation if not e.is_refitted]
    rows, independent = _spread_rows(model, identification.fitted, kept)
    own = sum(map(len, rows[: len(identification.fitted)]))
    stretches = _stretches(own, sum(map(len, rows)) - own, independent)
    number = sum(part.stop <= own for part in stretches)
    if model.free_flyer or number < _FEWEST:
        return None
    parts = list(zip([*identification.fitted, *kept], rows, strict=True))
    motion = [e.recording.trajectory.at(k) for e, k in parts]
    Y = np.concatenate([_regressor(model, m) for m in motion])  # (N, n, p)
    tau = np.concatenate([m.tau for m in motion])
    r = tau - np.concatenate([e.torques["estimate"][k] for e, k in parts])
    used = np.concatenate([e.recording.mask[k] for e, k in parts])
    if is_steady:
        used &= np.concatenate([_is_steady(e.recording)[k] for e, k in parts])
    used = used & (np.abs(r) <= _OUTLIER * _usual_size(r[:own], used[:own]))
    squares = np.sum(r[:own] ** 2, axis=0, where=used[:own])
    scale = np.sqrt(squares / np.maximum(used[:own].sum(axis=0), 1))
    weight = used * np.sqrt(independent) / np.where(scale > 0, scale, np.inf)
    size = model.layout.n_inertial
    load = Y[:, :, :size] @ identification.standard[:size]
    # over their spread before the data, C = U^T U, base parameters are of size 1
    U = np.asarray(np.linalg.qr((mapping.K * identification.prior_std).T, mode="r"))
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


def _regressor(model: RobotModel, motion: Trajectory) -> Array:
    """Return the regressor of the standard parameters, shape (N, n, p)."""
    return trajectory_regressor(model, motion).reshape(len(motion.t), model.n_rows, -1)


def _usual_size(r: Array, used: Array) -> Array:
    """Return the median size of each joint's residual over the rows used, shape (n,)."""
    columns = zip(r.T, used.T, strict=True)
    return np.array([np.median(np.abs(x[k])) if k.any() else np.inf for x, k in columns])


def joint_motions(
    recordings: Sequence[Recording], rows: Sequence[Array], load: Array, model: RobotModel
) -> tuple[JointMotion, ...]:
    """Return how each joint moves in some rows of recordings, with its neighbours.

    Args:
        recordings: The recordings.
        rows: Which rows of each, N in all.
        load: Torque of the bodies there, shape (N, n) [N m or N].
        model: The robot.
    """
    motions = [recording.trajectory for recording in recordings]
    passes = max(recording.signals.cutoff or np.inf for recording in recordings)
    longest = max(float(np.ptp(m.t)) for m in motions)

    def joined(of: Callable[[Trajectory], Array]) -> Array:
        return np.concatenate([of(m)[k] for m, k in zip(motions, rows, strict=True)])

    q, v, a = (joined(attrgetter(name)) for name in "qva")
    signs = joined(partial(_directions, model))
    way = joined(_travelled)
    time = joined(lambda m: (m.t - m.t[0]) / (longest or 1.0))
    alone = [
        JointMotion(q[:, j], v[:, j], a[:, j], signs[:, j], load[:, j], way[:, j], time, passes)
        for j in range(len(model.joints))
    ]
    beside = [[k for k in (j - 1, j + 1) if 0 <= k < len(alone)] for j in range(len(alone))]
    return tuple(
        replace(motion, others={model.joints[k]: alone[k] for k in near})
        for motion, near in zip(alone, beside, strict=True)
    )


def _is_steady(recording: Recording) -> Array:
    """Return where no reversal of a joint, nor its standing still, is near, shape (N, n), bool.

    A drive that sticks there is smeared by the filter, and no friction.
    """
    motion, signals = recording.trajectory, recording.signals
    if signals.cutoff is None:
        return np.ones(motion.v.shape, dtype=bool)
    slow = (np.abs(motion.v) < signals.min_velocity) | (_travelled(motion) == 0.0)
    steady = np.empty(slow.shape, dtype=bool)
    for j, at in enumerate(slow.T):
        times = np.concatenate([[-np.inf], motion.t[at], [np.inf]])
        after = np.searchsorted(times, motion.t, side="right")
        near = np.minimum(motion.t - times[after - 1], times[after] - motion.t)
        steady[:, j] = near > _NEAR / signals.cutoff
    return steady


def _directions(model: RobotModel, motion: Trajectory) -> Array:
    """Return which way the friction of each joint's own drive acts, shape (N, n)."""
    signs = friction_directions(model.layout, motion.v, motion.direction)[:, : len(model.joints)]
    return signs if signs.shape[1] else np.sign(motion.v)


def _travelled(motion: Trajectory) -> Array:
    """Return how far each joint went since it last turned round, shape (N, n) [rad or m]."""
    begins = np.diff(motion.segment, prepend=motion.segment[0] - 1) != 0
    turns = (np.diff(np.sign(motion.v), axis=0, prepend=0.0) != 0) | begins[:, None]
    last = np.maximum.accumulate(np.where(turns, np.arange(len(turns))[:, None], 0), axis=0)
    way: Array = np.abs(motion.q - np.take_along_axis(motion.q, last, axis=0))
    return way


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


def _of_joint(sample: Sample, j: int) -> Iterator[Misfit]:
    """Yield the terms that a joint's drive lacks, one after the other."""
    motion = sample.motions[j]
    if not sample.weight[: sample.rows, j].any():
        return
    fitted = slice(sample.rows)
    periodic = ripples(motion.at(fitted), sample.weight[fitted, j], sample.r[fitted, j])
    every = (*CANDIDATES, *couplings(motion), *periodic)
    own = [c for c in every if not (c.turns and sample.slides[j])]
    columns = [candidate.columns(motion) for candidate in own]
    ends = np.cumsum([x.shape[1] for x in columns]).tolist()
    place = {
        candidate: list(range(end - x.shape[1], end))
        for candidate, x, end in zip(own, columns, ends, strict=True)
    }
    apart, whole = trials(sample, slice(j, j + 1), np.hstack(columns)[:, None])
    chosen: list[int] = []
    total = before = apart.left([])
    error = float(np.sqrt(total[: sample.fitted].sum() / sample.torque[j]))
    for _ in range(_TERMS):
        left = {c: apart.left([*chosen, *place[c]]) for c in own}
        best = _best(left, before, place, total, sample.fitted)
        if best is None:
            return
        gain = (before - left[best])[: sample.fitted]
        share = float(gain.sum() / total[: sample.fitted].sum())
        size, std_error, unit = _size(sample, j, best, whole, chosen, place[best])
        theta = whole.parameters([*chosen, *place[best]])[len(chosen) :]
        kept = [
            whole.left(which)[sample.fitted :].sum()
            for which in ([], chosen, [*chosen, *place[best]])
        ]
        if np.sqrt(share) * error >= _SEEN:
            yield Misfit(
                joint=sample.joints[j],
                term=best,
                share=share,
                chance=chance(before, left[best], sample.fitted),
                confirmed=float((kept[1] - kept[2]) / kept[0]) if kept[0] > 0 else None,
                size=size,
                std_error=std_error,
                unit=unit,
                error=error,
                shift=-whole.T[: len(sample.U), place[best]] @ theta,
                theta=theta,
                scale=motion,
                entries=_entries(sample, j, best),
            )
        chosen += place[best]
        before, own = left[best], [c for c in own if c.code != best.code]


def _entries(sample: Sample, j: int, term: Candidate) -> tuple[str | DriveTerm, ...]:
    """Return what a job's [drives] says of a joint to add a term to it; none if nothing does."""
    turned = 0.0 if sample.slides[j] else float(np.ptp(sample.motions[j].q[: sample.rows]))
    families = [name for name in term.families if has_turned(name, turned)]
    return tuple(families[:1]) or term.terms


def _best(
    left: Mapping[Candidate, Array],
    before: Array,
    place: Mapping[Candidate, Sequence[int]],
    total: Array,
    fitted: int,
) -> Candidate | None:
    """Return the simplest of the terms that explain as much as the best does; None without one."""
    whole = float(total[:fitted].sum())
    gains = {c: float((before - after)[:fitted].sum()) / whole for c, after in left.items()}
    sure = {
        candidate: gain
        for candidate, gain in gains.items()
        if gain > _LEAST and candidate.tried * chance(before, left[candidate], fitted) < _CHANCE
    }
    alike = [c for c, gain in sure.items() if gain > max(sure.values()) - _ALIKE]
    return min(alike, key=lambda c: (len(place[c]), -sure[c]), default=None)


def chance(before: Array, after: Array, fitted: int) -> float:
    """Return how likely stretches gain that much, in the mean of their shares, by chance [-].

    By Student's test of the shares, each between -1 and 1, of the fitted logs' stretches or of all,
    whichever is surer.

    Args:
        before: Squared residual of each stretch, shape (K,).
        after: The same with the term.
        fitted: How many of the stretches are of fitted logs.
    """
    gain = (before - after) / np.maximum(np.maximum(before, after), _NOTHING)
    chances = [
        stdtr(len(x) - 1, -x.mean() / max(np.std(x, ddof=1) / np.sqrt(len(x)), _NOTHING))
        for x in (gain, gain[:fitted])
    ]
    return float(min(chances))


def _size(
    sample: Sample, j: int, term: Candidate, whole: Trial, before: list[int], new: list[int]
) -> tuple[float, float, str]:
    """Return the size of a term beside those found before, its standard error and unit."""
    theta, covariance = whole.estimate([*before, *new], sample.fitted)
    own = slice(len(before), None)
    theta, covariance, S = theta[own], covariance[own, own], whole.S[new][:, new]
    if term.units is not None:
        error = float(np.sqrt(covariance[0, 0]))
        return float(theta[0]), error, term.units[int(sample.slides[j])]
    # root mean square of the torque that base parameters cannot explain: size^2 = theta^T S theta
    S = S / np.sum(sample.weight[: sample.rows, j] ** 2)
    size, slope = float(np.sqrt(theta @ S @ theta)), S @ theta
    error = float(np.sqrt(slope @ covariance @ slope)) / size
    return size, error, ("N m rms", "N rms")[int(sample.slides[j])]


def _advice(term: Candidate, setting: str) -> str:
    """Return in words what the user can do about a term that the model lacks."""
    if not setting:
        return term.advice
    table, *lines = setting.split("\n")
    if term.coupled:
        size = "the size of the second from the data sheet"
        return f"Add {table} to the job with {' and '.join(lines)}, {size}"
    added = f"state {lines[0]} in {table} to add it to the model"
    return f"{term.advice}, or {added}" if term.advice else f"{added[0].upper()}{added[1:]}"


def _finding(misfit: Misfit, found: "Identification") -> Finding:
    term, kept = misfit.term, misfit.confirmed
    wide = [name for name in found.on_misfit if name.startswith(f"{misfit.joint}.")]
    stands = f"; {listed(wide)} stand on this misfit, and their intervals count it" if wide else ""
    confirmed = "" if kept is None else f" ({100 * max(kept, 0.0):.0f} % on the validation logs)"
    done = _advice(term, setting_of(misfit, found))
    message = (
        f"{misfit.joint}: {term.meaning}: {misfit.size:.3g} +- {misfit.std_error:.2g} "
        f"{misfit.unit}. It would explain {100 * misfit.share:.0f} % of the squared residual"
        f"{confirmed}; the residual is {100 * misfit.error:.1f} % of the torque. "
        f"{done or 'No term of the model is like it'}{stands}"
    )
    evidence = {
        "share_pct": 100 * misfit.share,
        "error_pct": 100 * misfit.error,
        "size": misfit.size,
        "std_error": misfit.std_error,
        "chance": misfit.chance,
    }
    if kept is not None:
        evidence["validation_share_pct"] = 100 * kept
    severity = "warning" if misfit.matters else "note"
    return Finding(term.code, severity, misfit.joint, message, evidence)
