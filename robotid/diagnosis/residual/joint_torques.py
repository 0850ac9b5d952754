"""Torque of each joint, and what its residual depends on: quantities, frequency, lag.

The dependence of the residual is cross-validated: neighbouring samples are correlated, so whole
segments are held out in turn, and the means of the bins in the other segments predict each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robotid.base.tolerances import REMAINDER
from robotid.base.typing import Array
from robotid.diagnosis import decisions
from robotid.diagnosis.catalogue import sentence_of
from robotid.dynamics.prepared_logs import independent_share
from robotid.dynamics.torque_split import split_torque
from robotid.estimation.fitting.evaluation import Evaluation
from robotid.estimation.fitting.fitted import Fit

_QUARTERS = 4  # parts of a recording for the test of a drift, and pieces of each part
_BINS = 10  # of a quantity, with equal numbers of samples


@dataclass(frozen=True, eq=False)
class Rows:
    """Samples of recordings, one after the other."""

    recordings: tuple[str, ...]  # names
    t: Array  # (N,), time stamps [s]
    recording: Array  # (N,), recording of each sample
    segment: Array  # (N,), uninterrupted segment of it
    segments: Array | None  # (N,), held out in turn; None: too short for six of them

    @property
    def time(self) -> Array:
        """Time of the log; for several recordings, from the start of the first, without breaks."""
        starts = np.flatnonzero(np.diff(self.recording, prepend=-1))
        if len(starts) == 1:
            return self.t
        lengths = [np.ptp(part) for part in np.split(self.t, starts[1:])]
        shift = np.cumsum([0.0, *lengths[:-1]]) - self.t[starts]
        return np.asarray(self.t + shift[self.recording])

    @cached_property
    def pieces(self) -> Array:
        """Piece of each sample, 16 per recording, numbered on, shape (N,), int."""
        rows, count = np.bincount(self.recording), _QUARTERS**2
        place = np.arange(len(self.t)) - np.repeat(np.cumsum(rows) - rows, rows)
        return np.asarray(count * self.recording + place * count // np.repeat(rows, rows))


@dataclass(frozen=True, eq=False)
class JointTorque:
    """Torque of one row of the equations, its parts, and what its residual depends on."""

    joint: str  # name of the row
    unit: str  # of its torque
    rows: Rows
    used: Array  # (N,), whether each sample is used
    tau: Array  # (N,), measured torque
    parts: Mapping[str, Array]  # of the predicted torque, by name, each of shape (N,)
    terms: Mapping[str, Mapping[str, Array]]  # (N,) of each drive parameter, by part and name
    #: Quantities that the residual may depend on: unit and values, (N,), by name.
    quantities: Mapping[str, tuple[str, Array]]
    #: Share of the squared residual above the filter's cut-off, or white; None if not available.
    broadband: float | None
    #: Share of the squared residual above a frequency [Hz] where the torque has half of it at most.
    beyond: float = 0.0
    frequency: float = np.inf

    @cached_property
    def residual(self) -> Array:
        """Measured minus predicted torque, shape (N,)."""
        return np.asarray(self.tau - sum(self.parts.values()))

    @cached_property
    def present(self) -> tuple[str, ...]:
        """Names of the parts that are more than rounding in any row."""
        least = REMAINDER * float(np.abs(self.tau).max())
        return tuple(name for name, x in self.parts.items() if np.abs(x).max() > least)

    @property
    def rms(self) -> dict[str, float]:
        """RMS value of each part, of "residual" and of "measured" over the used samples."""
        every = {**self.parts, "residual": self.residual, "measured": self.tau}
        return {name: self.size(x) for name, x in every.items()}

    def size(self, x: Array) -> float:
        """Return the RMS value of a signal over the used samples; NaN without one: x (N,)."""
        return float(np.sqrt(np.mean(x[self.used] ** 2))) if self.used.any() else float("nan")

    @cached_property
    def follows(self) -> tuple[Dependence, ...]:
        """Dependence of the residual on a constant, on each quantity, and on time."""
        # A quantity is tested together with a constant, time on the residual after the best other.
        r = self.residual
        if not self.used.any():
            return ()
        used = self.used & (np.abs(r) <= decisions.OUTLIER * np.median(np.abs(r[self.used])))
        everywhere, piece = np.zeros(int(used.sum()), dtype=int), self.rows.pieces[used]
        segments = None if self.rows.segments is None else self.rows.segments[used]
        tested = [follow("constant", self.unit, r[used], r[used], everywhere, segments)]
        tested += [
            follow(name, unit, x[used], r[used], even_bins(x[used]), segments)
            for name, (unit, x) in self.quantities.items()
            if np.ptp(x[used]) > 0
        ]
        left = self._less_best(tested)[0]
        quarter = np.unique(piece // _QUARTERS, return_inverse=True)[1]
        time = follow("time", "s", self.rows.time[used], left[used], quarter, piece)
        return (*tested, time)

    @cached_property
    def against_time(self) -> tuple[Array, str]:
        """The residual that is tested against time, shape (N,), and the subtracted quantity."""
        return self._less_best(self.follows[:-1])

    def _less_best(self, tested: Sequence[Dependence]) -> tuple[Array, str]:
        """Return the residual after the best quantity, and its name."""
        best = self._best(tested)
        if best is None or best.name not in self.quantities:
            return self.residual, ""
        means = np.interp(self.quantities[best.name][1], best.centres, best.means)
        return self.residual - means, best.name

    @staticmethod
    def _best(follows: Sequence[Dependence]) -> Dependence | None:
        significant = [d for d in follows if d.is_significant]
        return max(significant, key=lambda d: d.share or 0.0, default=None)

    @property
    def sentence(self) -> str:
        """The cause of the residual and what to do, as text."""
        return ". ".join(filter(None, self.cause))

    @property
    def cause(self) -> tuple[str, str]:
        """The cause of the residual, and what to do."""
        rms, best = self.rms, self._best(self.follows)
        name, where = ("", 0.0) if best is None else (best.name, best.where)
        sizes = [0.0] if best is None else np.abs(best.centres)
        is_slow = name == "speed" and abs(where) < float(np.median(sizes))
        quick = self.broadband or 0.0
        kinds = {
            "unused": bool(np.isnan(rms["measured"])),
            "zero": rms["measured"] == 0,
            "constant": name == "constant",
            "quantity": best is not None,
            "short": self.broadband is None or self.rows.segments is None,
            "beyond": self.beyond >= decisions.MISFIT_WARNS,
            "noise": quick >= 1.0 - quick,
            "slow": True,
        }
        kind = next(kind for kind, holds in kinds.items() if holds)
        shares = {"beyond": self.beyond, "noise": quick, "slow": 1.0 - quick}
        share = shares.get(kind, (best and best.share) or 0.0)
        cause = sentence_of(
            "residual:cause", what=kind, left=_percent(rms["residual"] / (rms["measured"] or 1.0)),
            share=_percent(share), name=name, unit=self.unit if best is None else best.unit,
            size=0.0 if best is None else best.means[0], low=is_slow, where=where,
            frequency=self.frequency,
            names=", ".join(d.name for d in self.follows if d.name != "constant"),
        )  # fmt: skip
        return cause, sentence_of("residual:advice", what=name or kind, frequency=self.frequency)


def joint_torques(fit: Fit) -> tuple[JointTorque, ...]:
    """Return the torque of each row, its parts, and what its residual depends on."""
    # At most 2000 samples, of the validation recordings, or of the fitted ones if there are none.
    validation = [e for e in fit.validation if not e.is_refitted]
    return _torques_of(fit, validation or fit.fitted)


def _torques_of(fit: Fit, evaluations: Sequence[Evaluation]) -> tuple[JointTorque, ...]:
    """Return the torque of each row in some recordings."""
    model, most = fit.model, decisions.ROWS // len(evaluations)
    chosen = [(e, spread_rows(len(e.recording.trajectory.t), most)) for e in evaluations]
    motions = [e.recording.trajectory.at(k) for e, k in chosen]
    splits = [
        split_torque(model, fit.standard, m.q, m.v, m.a, m.direction, m.memory) for m in motions
    ]
    used = np.concatenate([e.recording.mask[k] for e, k in chosen])
    q, v, a, tau = (
        np.concatenate([getattr(m, x) for m in motions]) for x in ("q", "v", "a", "tau")
    )
    load = np.concatenate([s.load for s in splits])
    rows, broadband = _rows(chosen), _broadband_shares(evaluations)
    frequency, beyond = _beyond_torque(evaluations)
    judged = []
    for j, joint in enumerate(model.row_names):
        terms = [split.terms_of(j) for split in splits]  # equal in all
        angle = "m" if joint in model.layout.prismatic else "rad"
        quantities = {
            "position": (angle, q[:, j]),
            "speed": (f"{angle}/s", v[:, j]),
            "acceleration": (f"{angle}/s^2", a[:, j]),
            "load": (model.row_units[j], load[:, j]),
        }
        if model.is_static:  # its samples are means of segments, without speeds
            quantities = {name: quantities[name] for name in ("position", "load")}
        parts = {x: np.concatenate([s.parts[x][:, j] for s in splits]) for x in splits[0].parts}
        by_part = {
            part: {x: np.concatenate([split[part][x] for split in terms]) for x in own}
            for part, own in terms[0].items()
        }
        judged.append(
            JointTorque(
                joint, model.row_units[j], rows, used[:, j], tau[:, j], parts, by_part, quantities,
                broadband[j], float(beyond[j]), frequency,
            )
        )  # fmt: skip
    return tuple(judged)


def spread_rows(count: int, most: int) -> Array:
    """Return the indices of selected samples, spread evenly over all."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _rows(chosen: Sequence[tuple[Evaluation, Array]]) -> Rows:
    """Return samples of recordings, cut into segments long enough to be held out in turn."""
    counts = [len(k) for _, k in chosen]
    independent = sum(
        min(len(k), independent_share(e.recording.signals) * len(e.recording.trajectory.t))
        for e, k in chosen
    )
    many, total = min(decisions.SEGMENTS, int(independent / decisions.SHORTEST)), sum(counts)
    return Rows(
        recordings=tuple(e.recording.name for e, _ in chosen),
        t=np.concatenate([e.recording.trajectory.t[k] for e, k in chosen]),
        recording=np.repeat(np.arange(len(chosen)), counts),
        segment=np.concatenate([e.recording.trajectory.segment[k] for e, k in chosen]),
        segments=np.arange(total) * many // total if many >= decisions.FEWEST else None,
    )


def _broadband_shares(evaluations: Sequence[Evaluation]) -> list[float | None]:
    """Return the broadband share of each row's squared residual, as of filtered noise."""
    # It is 1 - r(L) / r(0) with r the autocovariance and L a period of the filter's cut-off.
    rows = evaluations[0].recording.mask.shape[1]
    squares, products = np.zeros(rows), np.zeros(rows)
    for e in evaluations:
        motion, signals = e.recording.trajectory, e.recording.signals
        r = np.where(e.recording.mask, motion.tau - e.torques["estimate"], 0.0)
        lag = 1
        if signals.cutoff is not None and motion.rate is not None:
            lag = max(1, round(motion.rate / signals.cutoff))
        same_segment = (motion.segment[lag:] == motion.segment[:-lag])[:, None]
        both = same_segment & e.recording.mask[lag:] & e.recording.mask[:-lag]
        products += np.sum(r[lag:] * r[:-lag], axis=0, where=both)
        squares += np.sum(0.5 * (r[lag:] ** 2 + r[:-lag] ** 2), axis=0, where=both)
    return [
        min(1.0, 1.0 - product / square) if square > 0 else None
        for product, square in zip(products.tolist(), squares.tolist(), strict=True)
    ]


def _beyond_torque(evaluations: Sequence[Evaluation]) -> tuple[float, Array]:
    """Return a frequency [Hz] above which a residual has clearly more power than its torque."""
    # It is the highest one of all rows; with it the share of each row's squared residual from there
    # to the filter's cut-off, which is 0 if the torque is not that small. Of the longest segment.
    _, e, k = max(
        ((np.ptp(motion.t[k]), e, k)
         for e in evaluations for motion in [e.recording.trajectory]
         for k in np.split(np.arange(len(motion.t)), np.flatnonzero(np.diff(motion.segment)) + 1)),
        key=lambda part: part[0],
    )  # fmt: skip
    motion, cutoff = e.recording.trajectory, e.recording.signals.cutoff
    if cutoff is None or motion.rate is None:
        return np.inf, np.zeros(motion.tau.shape[1])
    r = np.where(e.recording.mask, motion.tau - e.torques["estimate"], 0.0)
    both = np.stack([motion.tau, r])[:, k]
    both = (both - both.mean(axis=1, keepdims=True)) * np.hanning(len(k))[:, None]
    powers, f = np.abs(np.fft.rfft(both, axis=1)) ** 2, np.fft.rfftfreq(len(k), 1 / motion.rate)
    above = np.cumsum(powers[:, f < cutoff][:, ::-1], axis=1)[:, ::-1]  # each frequency
    excess = above[1] - above[0] / decisions.BETTER
    is_quick = (excess > 0) & (excess[0] <= 0)  # below it, the prediction is better than none
    share = np.where(is_quick, above[1] / np.maximum(above[1, 0], decisions.NOTHING), 0.0)
    best = np.argmax(excess, axis=0)
    counts = np.take_along_axis(share, best[None], 0)[0] >= decisions.MISFIT_WARNS
    first = int(best[counts].max(initial=0))
    return float(f[first]), share[first]


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.1 else f"{100 * share:.0f} %"


@dataclass(frozen=True, eq=False)
class Dependence:
    """Dependence of the residual of a joint on a quantity."""

    name: str  # "constant", "position", "speed", "acceleration", "load" or "time"
    unit: str  # of the quantity
    centres: Array  # (B,), mean of the quantity in each bin
    means: Array  # (B,), mean residual in each bin [N m or N]
    errors: Array  # (B,), standard errors of the means between segments; NaN for fewer than three
    #: Share of the variance that the means of other segments explain; None with too few segments.
    share: float | None
    p_value: float  # p-value of that share [-]

    @property
    def is_significant(self) -> bool:
        """Whether the dependence is significant, and large enough to matter."""
        return (
            self.share is not None
            and self.share >= decisions.LEAST_SHARE
            and self.p_value < decisions.P_VALUE
        )

    @property
    def where(self) -> float:
        """The value of the quantity where the mean residual differs from 0 most significantly."""
        significance = np.abs(self.means) / np.where(self.errors > 0, self.errors, np.inf)
        return float(self.centres[int(np.argmax(significance))])

    def at(self, x: Array) -> tuple[Array, Array]:
        """Return the mean residual and its standard error, linear between bins, shape (N,) each."""
        mean, error = (
            np.interp(x, self.centres, y, np.nan, np.nan) for y in (self.means, self.errors)
        )
        return mean, error


def follow(
    name: str, unit: str, x: Array, r: Array, bins: Array, segments: Array | None
) -> Dependence:
    """Return the dependence of a residual on a quantity."""
    # m_b = sum_k S_kb / n_b for N_kb samples with the sum S_kb in segment k and bin b; its variance
    # is sum_k (S_kb - N_kb m_b)^2 / n_b^2, for independent clusters (Liang, Zeger 1986). Each
    # segment is predicted by the means of the others and by their common mean; a single bin by them
    # and by 0.
    n = np.bincount(bins).astype(float)
    centres, means = np.bincount(bins, x) / n, np.bincount(bins, r) / n
    if segments is None:
        return Dependence(name, unit, centres, means, np.full(len(n), np.nan), None, 1.0)
    segment = np.unique(segments, return_inverse=True)[1]
    K, B = int(segment.max()) + 1, len(n)
    cell = segment * B + bins
    N = np.bincount(cell, minlength=K * B).reshape(K, B).astype(float)  # samples of segment and bin
    S = np.bincount(cell, r, K * B).reshape(K, B)  # sums of their residuals
    Q = np.bincount(segment, r**2)
    present = (N > 0).sum(axis=0)
    scatter = np.sum((S - N * means) ** 2, axis=0) * present / np.maximum(present - 1, 1)
    errors = np.where(present >= decisions.SCATTERED, np.sqrt(scatter) / n, np.nan)
    if K < decisions.FEWEST:
        return Dependence(name, unit, centres, means, errors, None, 1.0)
    N_other, S_other = n - N, S.sum(axis=0) - S  # of all segments but one
    plain = (S_other.sum(axis=1) / N_other.sum(axis=1))[:, None] * (B > 1)  # with a constant
    mean = np.where(N_other > 0, S_other / np.maximum(N_other, 1.0), plain)  # (K, B)
    before, after = (
        Q - 2 * np.sum(m * S, axis=1) + np.sum(m**2 * N, axis=1) for m in (plain, mean)
    )
    whole = float(before.sum())
    share = 1.0 - float(after.sum()) / whole if whole > 0 else 0.0  # 0 for a residual of 0
    return Dependence(
        name, unit, centres, means, errors, share, decisions.p_value(before, after, K)
    )


def even_bins(x: Array) -> Array:
    """Return the bin of each value: ten bins with equal numbers of samples, also split at 0."""
    edges = np.unique(np.append(np.quantile(x, np.arange(1, _BINS) / _BINS), 0.0))
    return np.unique(np.searchsorted(edges, x, side="right"), return_inverse=True)[1]
