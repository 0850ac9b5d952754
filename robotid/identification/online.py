"""Online identification: samples as input, an estimate at any time as output.

Position and torque pass the same Bessel filter, with the same delay at all frequencies of the pass
band, so that they remain synchronous. Velocity and acceleration are central differences of the
filtered position, with a delay of one step. Innovations show noise, convergence and changes.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
import scipy.linalg

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.findings import listed
from robotid.base.settings import NOT_NEGATIVE, POSITIVE, Settings, is_number, require_kind, setting
from robotid.base.typing import Array, real_numbers
from robotid.data.base_motion import GAP_STEPS
from robotid.data.log import Log, Trajectory
from robotid.data.signals import GAP_CYCLES
from robotid.diagnosis.decisions import BEYOND_NOISE
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import Sample
from robotid.dynamics.rows import sure_rows
from robotid.dynamics.torque import InstantRegressor
from robotid.estimation.estimators import Estimate, Kalman, KalmanState
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

#: One instant of smooth motion: t [s], then q, v, a, tau, each of shape (n,).
Instant = tuple[float, Array, Array, Array, Array]

_ORDER = 4  # of the causal filter, even
_SLOWEST = 1e-5  # smallest cut-off over the rate
_SETTLE = 4.0  # time after a start or a gap before the first instant [delays]


class LiveSignals:
    """Converts samples of q and tau online into instants of q, v, a, tau."""

    def __init__(self, n: int, rate: float, cutoff: float, is_continuous: Array) -> None:
        if not 0 < cutoff < rate / 2:
            raise SettingsError(
                f"cutoff {cutoff:g} Hz is not between 0 and half the rate {rate:g} Hz"
            )
        if cutoff < _SLOWEST * rate:
            raise SettingsError(
                f"cutoff {cutoff:g} Hz is less than {_SLOWEST:g} of the rate {rate:g} Hz, which is "
                "too low for an exact filter. Set a larger cutoff, or correct the time stamps"
            )
        self._step, self._n = 1.0 / rate, n
        self._is_continuous = np.asarray(is_continuous, dtype=bool)
        self._gap = max(GAP_CYCLES / cutoff, GAP_STEPS / rate)
        self._M = _bessel(_ORDER, cutoff, rate)  # [x; y]_k+1 = M [x; u]_k
        A, B, C = self._M[:-1, :-1], self._M[:-1, -1:], self._M[-1:, :-1]
        inverse = np.linalg.inv(np.eye(_ORDER) - A)
        self._rest = (inverse @ B)[:, 0]  # state at a constant input of 1
        # of the instants after the samples [s]
        self.delay = (float((C @ inverse @ inverse @ B)[0, 0]) + 1.0) * self._step
        self._warm = int(np.ceil(_SETTLE * self.delay / self._step))
        self._last: tuple[float, Array] | None = None
        self._x = np.zeros((_ORDER, 2 * n))
        self._recent: list[Array] = []
        self._next, self._count = 0.0, 0

    def push(self, t: float, q: Array, tau: Array) -> list[Instant]:
        """Process a sample and return the delayed instants that it completes; typically one."""
        u, last = np.concatenate([q, tau]), self._last
        if last is not None:
            jump = np.where(self._is_continuous, u[: self._n] - last[1][: self._n], 0.0)
            u[: self._n] -= 2 * np.pi * np.round(jump / (2 * np.pi))
        self._last = (t, u)
        if last is None or t - last[0] > self._gap:
            self._x = np.outer(self._rest, u)
            self._recent, self._count, self._next = [], 0, t + self._step
            return []
        done = []
        while self._next <= t + 1e-9 * self._step:
            share = (self._next - last[0]) / (t - last[0])
            stacked = np.vstack([self._x, last[1] + share * (u - last[1])])
            moved = self._M @ stacked
            self._x = moved[:-1]
            self._recent = [*self._recent[-2:], moved[-1]]
            self._count += 1
            if self._count > self._warm:
                done.append(self._instant(self._next))
            self._next += self._step
        return done

    def _instant(self, t: float) -> Instant:
        n, h = self._n, self._step
        before, here, after = self._recent
        q = here[:n]
        v = (after[:n] - before[:n]) / (2 * h)
        a = (after[:n] - 2 * q + before[:n]) / h**2
        return t - self.delay, q, v, a, here[n:]


def _bessel(order: int, cutoff: float, rate: float) -> Array:
    """Return [A B; C D] of a Bessel low-pass, from sections in series for numerical accuracy."""
    from scipy.signal import bessel

    sections = bessel(order, cutoff, fs=rate, norm="mag", output="sos")
    M = np.eye(1)  # [A B; C D] without a state: y = u
    for b0, b1, b2, _, a1, a2 in sections:
        A = np.array([[-a1, 1.0], [-a2, 0.0]])
        B = np.array([[b1 - a1 * b0], [b2 - a2 * b0]])
        C, D = np.array([[1.0, 0.0]]), b0
        # in series: u of this section is y of the previous ones
        k = len(M) - 1
        A1, B1, C1, D1 = M[:k, :k], M[:k, k:], M[k:, :k], M[k:, k:]
        M = np.block([[A1, np.zeros((k, 2)), B1], [B @ C1, A, B @ D1], [D * C1, C, D * D1]])
    return M


_LARGEST = 25.0  # largest squared innovation in the evidence [variances]
_DRIFT = 4.0  # mean squared innovation without a change [variances]
_MEMORY = 5.0  # time over which the noise level of each joint is averaged [s]
_FIRST_NOISE = 0.1  # initial noise level, relative to the RMS torque of each row
_SMALLEST_NOISE = 1e-4  # smallest noise level, relative to the RMS torque of each row
_PSEUDO = 20.0  # weight of the initial noise level [samples]
_CLIP = BEYOND_NOISE**2  # largest squared innovation in the noise level [variances]
_CONVERGED = 0.25  # variance of the prediction over that of the noise, below which it has converged


@dataclass(frozen=True, eq=False)
class Payload:
    """A payload on the last body."""

    parameters: Array  # its ten inertial parameters in the body's frame, shape (10,)
    std_error: Array  # their standard errors, shape (10,)

    @property
    def mass(self) -> float:
        """Its mass [kg]."""
        return float(self.parameters[0])

    @property
    def mass_std_error(self) -> float:
        """Standard error of its mass [kg]."""
        return float(self.std_error[0])


class ChangeDetector:
    """CUSUM on squared innovations, row by row (Page 1954, Continuous Inspection Schemes).

    With the squared innovation d_j^2 in units of its variance, the evidence is
    g_j <- max(0, g_j + share (min(d_j^2, 25) - 4)), and a change is flagged when one g_j
    reaches the threshold. The onset of the change is the time at which that g_j last left 0.
    """

    def __init__(self, n: int, threshold: float) -> None:
        self.threshold = threshold
        self.evidence = np.zeros(n)
        self._onset = np.full(n, np.nan)

    def push(self, t: float, squares: Array, share: float) -> float | None:
        """Return the onset of a change that the squares (n,) of a sample flag [s], else None."""
        evidence = self.evidence + share * (np.minimum(squares, _LARGEST) - _DRIFT)
        evidence[squares == 0.0] = self.evidence[squares == 0.0]
        starts = (self.evidence <= 0.0) & (evidence > 0.0)
        self._onset[starts] = t
        self.evidence = np.maximum(evidence, 0.0)
        j = int(np.argmax(self.evidence))
        if self.evidence[j] < self.threshold:
            return None
        self.evidence = np.zeros(len(evidence))
        return float(self._onset[j])


class Innovations:
    """Noise level of each row, and convergence and change relative to it.

    The mean of innovation times residual is the variance of the noise, at any uncertainty of the
    parameters. For the detection of changes, ``model_error`` times each row's torque is added to
    its noise, since no model is exact.
    """

    def __init__(self, rms: Array, dt: float, model_error: float, detector: ChangeDetector) -> None:
        # rms (n,) [N m or N]
        self._floor = (_SMALLEST_NOISE * np.maximum(rms, 1e-3 * rms.max())) ** 2 + 1e-300
        # noise variance of each row, (n,) [(N m)^2 or N^2]
        self.variance = np.maximum((_FIRST_NOISE * rms) ** 2, self._floor)
        # mean variance of the prediction, by the parameters' uncertainty, over that of the noise
        self.ratio = np.full(len(rms), np.inf)
        self._torque = rms**2
        self._dt, self._memory, self._model_error = dt, _MEMORY / dt, model_error
        self._samples = np.full(len(rms), _PSEUDO)
        self._detector = detector

    @property
    def is_converged(self) -> bool:
        """Whether the parameters' uncertainty adds less than half a noise level to each row."""
        return bool((self.ratio < _CONVERGED).all())

    def push(
        self, t: float, tau: Array, e: Array, residual: Array, uncertainty: Array, used: Array,
        share: float,
    ) -> float | None:  # fmt: skip
        """Process one sample; return the onset of a change flagged now [s], else None."""
        # tau, innovation e and residual (n,) [N m or N], uncertainty (n,) their squares, used (n,)
        expected = uncertainty + self.variance + self._model_error**2 * self._torque
        # before convergence, innovations do not indicate a change
        evidence = np.where(used & (self.ratio < _CONVERGED), e**2 / expected, 0.0)
        # noise and torque are averaged over the memory, and the variance ratio over one second
        bounded = np.clip(e * residual, 0.0, _CLIP * (uncertainty + self.variance))
        ratio = uncertainty / self.variance
        self._samples = np.minimum(self._samples + used, self._memory)
        gain = used / self._samples
        self._torque = self._torque + gain * (tau**2 - self._torque)
        self.variance = np.maximum(self.variance + gain * (bounded - self.variance), self._floor)
        known = np.isfinite(self.ratio)
        averaged = np.where(known, self.ratio, ratio)
        averaged += min(1.0, self._dt) * (ratio - averaged)
        self.ratio = np.where(used, averaged, self.ratio)
        return self._detector.push(t, evidence, share)

    def forget_convergence(self) -> None:
        """Reset the convergence, after the covariance was increased."""
        self.ratio = np.full(len(self.ratio), np.inf)


def payload_of(difference: Array, covariance: Array, columns: Array, spread: Array) -> Payload:
    """Return the payload with the least (d - K_L phi)^T C^-1 (d - K_L phi) + |phi / spread|^2."""
    # difference (b,), covariance (b, b), columns (b, 10), spread (10,)
    scale = np.sqrt(np.diag(covariance))
    L = scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))
    A = scipy.linalg.solve_triangular(L, columns * spread, lower=True)
    d = scipy.linalg.solve_triangular(L, difference, lower=True)
    R = scipy.linalg.qr(np.vstack([A, np.eye(10)]), mode="r")[0][:10]
    phi = scipy.linalg.cho_solve((R, False), A.T @ d)
    inverse = scipy.linalg.solve_triangular(R, np.eye(10))
    return Payload(spread * phi, spread * np.sqrt(np.einsum("ij,ij->i", inverse, inverse)))


def load_spread(spread: Array) -> Array:
    """Return prior deviations (10,) of a payload, a mean link of twice its size: spread (10 k,)."""
    by_body = spread.reshape(-1, 10)
    mass = max(float(by_body[:, 0].mean()), float(by_body[-1, 0]))
    radius = 2.0 * float(np.max(by_body[-1, 1:4]) / by_body[-1, 0])
    return mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])


_ARRAYS = {1: ("q", "tau"), 3: ("q", "v", "a", "tau")}  # by the number of arrays after t and q
_OVERSAMPLED = 12.0  # estimator updates per period of the cut-off
_STORED_EVERY = 0.1  # time between stored states, for the reset after a change [s]
_REOPENED = 0.1  # change of every parameter after a change, relative to its prior spread
_ROWS = 20.0  # rate of the rows of the history [Hz]


@dataclass(frozen=True)
class OnlineSettings(Settings):
    """Settings of an online identification."""

    rate: float = setting(200.0, "approximate rate of the samples [Hz]", within=POSITIVE)
    cutoff: float = setting(8.0, "cut-off of the causal filter [Hz]", within=POSITIVE)
    min_velocity: float = setting(0.02, "as of ``SignalSettings`` [rad/s]", within=NOT_NEGATIVE)
    warmup: float = setting(
        1.0, "time of motion before the first estimate, which scales the drive terms [s]",
        within=POSITIVE,
    )  # fmt: skip
    walk: float = setting(
        1e-4, "random walk of the parameters, relative to their prior spread, per square root of a "
        "second [s^-1/2]", within=NOT_NEGATIVE,
    )  # fmt: skip
    threshold: float = setting(
        40.0, "evidence at which a change is flagged; see ``ChangeDetector``", within=POSITIVE
    )
    model_error: float = setting(
        0.05, "error of the model without a change, relative to each joint's torque [-]",
        within=NOT_NEGATIVE,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Reading:
    """The estimate at one time."""

    t: float  # the time of the estimate: that of the newest sample minus the delay [s]
    theta: Array  # base parameters, shape (b,)
    std_error: Array  # their standard errors, shape (b,)
    sigma: Array  # noise level of each joint, shape (n,) [N m or N]
    excitation: float  # mean reduction of the parameters' prior variance by the motion, 0 to 1
    #: Whether the parameters' uncertainty adds less than half a noise level to the torque.
    converged: bool


@dataclass(frozen=True, eq=False)
class Change:
    """A step change of the parameters."""

    flagged: float  # time at which it was flagged, on the clock of the samples [s]
    onset: float  # estimated time of the change [s]
    theta: Array  # base parameters before it, shape (b,)
    covariance: Array  # their covariance, shape (b, b)


class OnlineIdentifier:
    """Identifies a robot sample by sample, with detection of step changes.

    A Kalman filter with a slow random walk of the parameters processes the regressor of each
    filtered instant. The noise level of each joint is the running mean of innovation times
    residual. When the innovations of a joint remain too large (CUSUM), a change is flagged and the
    covariance is increased: by that of a payload on the last body, and slightly for all parameters.

    Args:
        model: The robot, with a fixed base.
        settings: The settings; the defaults if None.

    Attributes:
        delay: Delay of the estimate after the newest sample [s] with ``update(t, q, tau)``; 0 with
            ``update(t, q, v, a, tau)``.
        changes: The changes flagged so far.
        names: Names of the base parameters.

    Raises:
        DataError: If the base floats or the model is static; from ``reading`` and
            ``estimate``, before the end of the warm-up.
        SettingsError: If the cut-off is not below half the rate.
    """

    def __init__(self, model: RobotModel, settings: OnlineSettings | None = None) -> None:
        require_kind(model, RobotModel, "model", "a robotid.RobotModel")
        require_kind(settings, (OnlineSettings, type(None)), "settings", "an OnlineSettings")
        model.require_fixed("an online identification")
        if model.is_static:
            raise DataError("the model is static. An online identification needs dynamics = 'full'")
        self.model, self.settings = model, settings or OnlineSettings()
        s = self.settings
        self.mapping = structural_mapping(model)
        self.names = self.mapping.base_names
        self.changes: tuple[Change, ...] = ()
        n = len(model.joints)
        is_continuous = np.array([joint.turns_freely for joint in model.limits])
        self._signals = LiveSignals(n, s.rate, s.cutoff, is_continuous)
        self.delay = self._signals.delay
        self._every = max(1, int(s.rate / (_OVERSAMPLED * s.cutoff)))
        self._pace()
        self._regressor = InstantRegressor(model, self.mapping.independent)
        self._skipped, self._t, self._now = 0, -np.inf, -np.inf
        self._warmup: list[Instant] = []
        self._kalman: Kalman | None = None
        self._recent: deque[tuple[float, KalmanState]] = deque(
            maxlen=round(_MEMORY / _STORED_EVERY)
        )

    @overload
    def update(self, t: float, q: Array, tau: Array, /) -> None: ...

    @overload
    def update(self, t: float, q: Array, v: Array, a: Array, tau: Array, /) -> None: ...

    def update(self, t: float, q: Array, *rest: Array) -> None:
        """Process one sample: ``update(t, q, tau)``, or ``update(t, q, v, a, tau)`` if smooth.

        Args:
            t: Time stamp [s].
            q: Joint positions, shape (n,) [rad or m].
            rest: tau, or v, a, tau: velocities, accelerations, torques, shape (n,) each.

        Raises:
            DataError: If a number is not finite, a shape is wrong or time does not increase; the
                state does not change then.
        """
        names = _ARRAYS.get(len(rest))
        if names is None:
            raise DataError(
                f"update takes (t, q, tau) or (t, q, v, a, tau), found {2 + len(rest)} values"
            )
        if not is_number(t):
            raise DataError(f"the sample at t = {str(t)[:60]} s is not finite; leave it out")
        arrays = [real_numbers(x, name) for name, x in zip(names, (q, *rest), strict=True)]
        n, shapes = len(self.model.joints), [np.shape(x) for x in arrays]
        if any(shape != (n,) for shape in shapes):
            raise DataError(f"{listed(names)} have shapes {listed(shapes)}, expected ({n},) each")
        if not (np.isfinite(t) and all(np.isfinite(x).all() for x in arrays)):
            raise DataError(f"the sample at t = {t:g} s is not finite; leave it out")
        if t <= self._now:
            raise DataError(f"t must increase, but {t:.15g} s follows {self._now:.15g} s")
        if len(rest) == 1:
            for instant in self._signals.push(t, *arrays):
                self._skipped += 1
                if self._skipped % self._every == 0:
                    self._take(instant, t)
        else:
            if self.delay:  # no filter, and every sample is used
                self.delay, self._every = 0.0, 1
                self._pace()
            q, v, a, tau = arrays
            self._take((t, q, v, a, tau), t)
        self._now = t

    @property
    def is_ready(self) -> bool:
        """Whether there is an estimate: the warm-up is over."""
        return self._kalman is not None

    @property
    def reading(self) -> Reading:
        """The current estimate with its uncertainty."""
        self._require_ready()
        variance = np.maximum(np.diag(self._state.P), 0.0)
        left = np.minimum(variance / self._prior_variance, 1.0)
        sigma, is_converged = np.sqrt(self._innovations.variance), self._innovations.is_converged
        excitation = float(1.0 - left.mean())
        theta = self._state.theta
        return Reading(self._t, theta, np.sqrt(variance), sigma, excitation, is_converged)

    @property
    def estimate(self) -> Estimate:
        """The estimate in the form of the batch estimators."""
        kalman = self._require_ready()
        sigma = np.sqrt(self._innovations.variance)
        estimate = kalman.estimate(self._state, self.names)
        return replace(estimate, converged=self._innovations.is_converged, sigma=sigma)

    def payload(self, index: int = -1) -> Payload:
        """Return the payload on the last body that explains a change of the parameters.

        Args:
            index: Index of the change in ``changes``.

        Raises:
            DataError: If there is no such change.
        """
        if not -len(self.changes) <= index < len(self.changes):
            raise DataError(f"there is no change {index}: {len(self.changes)} were flagged")
        change = self.changes[index]
        difference, C = self._state.theta - change.theta, self._state.P + change.covariance
        return payload_of(difference, C, self._load_columns, self._load_spread)

    def _require_ready(self) -> Kalman:
        if self._kalman is None:
            raise DataError(
                f"no estimate yet: the robot has moved for {len(self._warmup) * self._dt:.2f} s, "
                f"and the warm-up needs {self.settings.warmup:g} s of motion"
            )
        return self._kalman

    def _pace(self) -> None:
        self._dt = self._every / self.settings.rate  # time between updates of the estimator [s]
        # filtered rows are correlated
        self._share = min(1.0, 2.0 * self.settings.cutoff * self._dt)

    def _take(self, instant: Instant, now: float) -> None:
        """Process one instant; store it before the end of the warm-up."""
        if self._kalman is not None:
            self._step(instant, now)
            return
        v, speeds = instant[2], self.model.layout.drive_speeds[: len(instant[2])]
        if (np.abs(v) >= self.settings.min_velocity * speeds).any():
            self._warmup.append(instant)
        if len(self._warmup) * self._dt >= self.settings.warmup:
            self._start()

    def _start(self) -> None:
        """Initialise the filter from the instants of the warm-up, then process these."""
        t, q, v, a, tau = (np.array(x) for x in zip(*self._warmup, strict=True))
        joints, segment = self.model.joints, np.zeros(len(t), dtype=int)
        motion = Trajectory(t, q, v, a, tau, joints, 1.0 / self._dt, segment)
        spread = prior_spread(self.model, motion.squares, len(motion.t))
        beta = self.mapping.to_base(self.model.standard_parameters())
        KS = self.mapping.K * spread
        C = KS @ KS.T
        size = self.model.layout.n_inertial
        self._load_columns = self.mapping.K[:, size - 10 : size]  # of the last body
        self._load_spread = load_spread(spread[:size])
        KL = self._load_columns * self._load_spread
        self._reopening = KL @ KL.T + _REOPENED**2 * C
        self._prior_variance = np.diag(C)
        rms = np.sqrt(np.mean(tau**2, axis=0))
        s = self.settings
        detector = ChangeDetector(len(joints), s.threshold)
        self._innovations = Innovations(rms, self._dt, s.model_error, detector)
        walk = s.walk * np.sqrt(self._dt)
        # noise levels are estimated online, so the weights of the rows include them
        self._kalman = Kalman(np.ones(len(joints)), beta, C, walk, None, self._share)
        self._state: KalmanState = self._kalman.init(len(beta))
        early, self._warmup = self._warmup, []
        for instant in early:
            self._step(instant, instant[0] + self.delay)

    def _step(self, instant: Instant, now: float) -> None:
        t, q, v, a, tau = instant
        kalman = self._require_ready()
        used = sure_rows(self.model.layout, v[None], self.settings.min_velocity)[0]
        Y = self._regressor(q, v, a)
        e = tau - Y @ self._state.theta
        uncertainty = np.einsum("ij,ij->i", Y @ self._state.P, Y)  # variance of the prediction
        state = kalman.update(self._state, Sample(Y, tau, used / self._innovations.variance))
        if not self._recent or t >= self._recent[-1][0] + _STORED_EVERY:
            self._recent.append((t, self._state))
        self._state, self._t = state, t
        residual = tau - Y @ state.theta
        onset = self._innovations.push(t, tau, e, residual, uncertainty, used, self._share)
        if onset is not None:
            self._reopen(now, onset)

    def _reopen(self, now: float, onset: float) -> None:
        """Restore the state before the change, and increase the covariance."""
        # the filter spreads a step over its delay, which biases the estimate before the onset
        start = onset - self.delay
        clean = [state for t, state in self._recent if t <= start]
        before = clean[-1] if clean else self._recent[0][1]
        self.changes = (*self.changes, Change(float(now), onset, before.theta, before.P))
        self._state = replace(self._state, theta=before.theta, P=before.P + self._reopening)
        self._recent.clear()
        self._innovations.forget_convergence()


@dataclass(frozen=True, eq=False)
class Track:
    """The history of an online identification."""

    identifier: OnlineIdentifier  # the identifier after the last sample
    t: Array  # times of the newest sample, shape (N,) [s]
    readings: tuple[Reading, ...]  # the estimates then

    def columns(self) -> dict[str, Array]:
        """Return the columns of the history, (N,) each: time, base parameters, standard errors."""
        table = {"time": self.t}
        for i, name in enumerate(self.identifier.names):
            table[name] = np.array([x.theta[i] for x in self.readings])
            table[f"{name}.std_error"] = np.array([x.std_error[i] for x in self.readings])
        for key in ("excitation", "converged"):
            table[key] = np.array([float(getattr(x, key)) for x in self.readings])
        return table


def track(model: RobotModel, log: Log, settings: OnlineSettings) -> Track:
    """Run an online identification over a log, sample by sample."""
    identifier = OnlineIdentifier(model, settings)
    times: list[float] = []
    readings: list[Reading] = []
    for k, t in enumerate(log.t.tolist()):
        identifier.update(t, log.q[k], log.tau[k])
        is_due = not times or t > times[-1] + 0.999 / _ROWS
        if identifier.is_ready and (is_due or k == len(log.t) - 1):
            times.append(t)
            readings.append(identifier.reading)
    if not readings:
        raise DataError(
            f"{log.path or 'log'}: the robot moves for less than the warm-up of "
            f"{settings.warmup:g} s, so there is no estimate. Use a longer log with motion"
        )
    return Track(identifier, np.array(times), tuple(readings))
