"""Identification while the robot moves: sample in, estimate at any moment out."""

from collections import deque
from dataclasses import replace
from typing import overload

import numpy as np

from robotid._settings import is_number, require_kind
from robotid._typing import Array
from robotid.estimators import Estimate, Kalman, KalmanState
from robotid.exceptions import DataError
from robotid.logs.data import Trajectory, real_numbers
from robotid.online.change_detection import (
    ChangeDetector,
    Innovations,
    Payload,
    load_spread,
    payload_of,
)
from robotid.online.settings import Change, OnlineSettings, Reading
from robotid.online.signals import Instant, LiveSignals
from robotid.regressor.base_parameters import structural_mapping
from robotid.regressor.columns import sure_rows
from robotid.regressor.problem import Sample
from robotid.regressor.torque import InstantRegressor
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

__all__ = ["OnlineIdentifier"]

_TAKEN = {1: ("q", "tau"), 3: ("q", "v", "a", "tau")}  # arrays, by how many follow t and q
_OVERSAMPLED = 12.0  # filtered samples per period of the cut-off that reach the estimator
_KEPT_EVERY = 0.1  # [s] between the states that a change may go back to
_KEPT = 30  # ... and how many of them there are
_REOPENED = 0.1  # share of its prior spread that everything may have changed by


class OnlineIdentifier:
    """Identifies a robot sample by sample, and follows a step change.

    A Kalman filter with parameters that walk slowly sees the regressor of each filtered instant.
    The noise level of each joint is the running mean of innovation times residual. When the
    innovations of a joint stay too large (CUSUM), a change is flagged and the covariance re-opened:
    for what a load on the last body may add, and a little for everything else.

    Args:
        model: The robot, with a fixed base.
        settings: The settings; the defaults if None.

    Attributes:
        delay: How far the estimate lies behind the newest sample if ``update(t, q, tau)`` is
            used [s]; 0 with ``update(t, q, v, a, tau)``.
        changes: The changes flagged so far.
        names: Names of the base parameters.

    Raises:
        DataError: If the base floats or the model is static; later, by ``reading``, ``compared``
            and ``estimate``, until the robot has moved enough for a first estimate.
        SettingsError: If the cut-off is not below half the rate.
    """

    def __init__(self, model: RobotModel, settings: OnlineSettings | None = None) -> None:
        require_kind(model, RobotModel, "model", "a robotid.RobotModel")
        require_kind(settings, (OnlineSettings, type(None)), "settings", "an OnlineSettings")
        if model.is_static:
            raise DataError("an online identification needs a model with dynamics = 'full'")
        self.model, self.settings = model, settings or OnlineSettings()
        s = self.settings
        self.mapping = structural_mapping(model)
        self.names = self.mapping.base_names
        self.changes: tuple[Change, ...] = ()
        n = len(model.joints)
        turns = np.array([joint.turns_freely for joint in model.limits])
        self._signals = LiveSignals(n, s.rate, s.cutoff, s.order, turns)
        self.delay = self._signals.delay
        self._every = max(1, int(s.rate / (_OVERSAMPLED * s.cutoff)))
        self._pace()
        self._regressor = InstantRegressor(model, self.mapping.independent)
        self._skipped, self._t, self._now = 0, -np.inf, -np.inf
        self._early: list[Instant] = []
        self._kalman: Kalman | None = None
        self._recent: deque[tuple[float, KalmanState]] = deque(maxlen=_KEPT)

    @overload
    def update(self, t: float, q: Array, tau: Array, /) -> None: ...

    @overload
    def update(self, t: float, q: Array, v: Array, a: Array, tau: Array, /) -> None: ...

    def update(self, t: float, q: Array, *rest: Array) -> None:
        """Take one sample: ``update(t, q, tau)``, or ``update(t, q, v, a, tau)`` if smooth.

        Args:
            t: Time stamp [s].
            q: Joint positions, shape (n,) [rad or m].
            rest: tau, or v, a, tau: velocities, accelerations, torques, shape (n,) each.

        Raises:
            DataError: If a number is not finite, a shape is wrong or time does not increase; the
                sample is then as if it had never been given.
        """
        names = _TAKEN.get(len(rest))
        if names is None:
            raise DataError(
                f"update takes (t, q, tau) or (t, q, v, a, tau), found {2 + len(rest)} values"
            )
        if not is_number(t):
            raise DataError(f"the sample at t = {str(t)[:60]} s is not finite, so it was refused")
        arrays = [real_numbers(x, name) for name, x in zip(names, (q, *rest), strict=True)]
        if len(rest) == 1:
            for instant in self._signals.push(t, *arrays):
                self._skipped += 1
                if self._skipped % self._every == 0:
                    self._take(instant, t)
        else:
            self._check(t, *arrays)
            if self.delay:  # nothing is filtered here, and nothing left out
                self.delay, self._every = 0.0, 1
                self._pace()
            q, v, a, tau = arrays
            self._take((t, q, v, a, tau), t)
        self._now = t

    @property
    def is_ready(self) -> bool:
        """Whether there is an estimate: the warm-up has seen enough motion."""
        return self._kalman is not None

    @property
    def reading(self) -> Reading:
        """What is known now."""
        self._require_ready()
        variance = np.maximum(np.diag(self._state.P), 0.0)
        left = np.minimum(variance / self._prior_variance, 1.0)
        return Reading(
            t=self._t,
            theta=self._state.theta,
            std_error=np.sqrt(variance),
            sigma=np.sqrt(self._innovations.variance),
            excitation=float(1.0 - left.mean()),
            converged=self._innovations.is_converged,
        )

    @property
    def compared(self) -> tuple[Array, Array]:
        """Torque at the reading's moment and what the estimate makes of it, shape (n,) each.

        The latter is NaN where a joint is at rest: its friction has no sign.
        """
        self._require_ready()
        return self._compared

    @property
    def estimate(self) -> Estimate:
        """The estimate as the batch estimators return it."""
        kalman = self._require_ready()
        told, sigma = self._innovations.is_converged, np.sqrt(self._innovations.variance)
        estimate = kalman.estimate(self._state, self.names)
        return replace(estimate, converged=told, sigma=sigma)

    def payload(self, index: int = -1) -> Payload:
        """Return the load on the last body that explains what a change has changed by now.

        Args:
            index: Which of ``changes``.

        Raises:
            DataError: If there has been no such change.
        """
        if not -len(self.changes) <= index < len(self.changes):
            raise DataError(f"there is no change {index}: {len(self.changes)} were flagged")
        change = self.changes[index]
        return payload_of(
            self._state.theta - change.theta,
            self._state.P + change.covariance,
            self._load_columns,
            self._load_spread,
        )

    def _require_ready(self) -> Kalman:
        if self._kalman is None:
            raise DataError(
                f"no estimate yet: the robot has moved for {len(self._early) * self._dt:.2f} s of "
                f"the {self.settings.warmup:g} s of the warm-up"
            )
        return self._kalman

    def _pace(self) -> None:
        self._dt = self._every / self.settings.rate  # [s] between two steps of the estimator
        # rows behind a filter are not independent
        self._share = min(1.0, 2.0 * self.settings.cutoff * self._dt)

    def _check(self, t: float, *arrays: Array) -> None:
        n = len(self.model.joints)
        if any(np.shape(x) != (n,) for x in arrays):
            raise DataError(f"q, v, a, tau: {[np.shape(x) for x in arrays]}, wanted ({n},) each")
        if not (np.isfinite(t) and all(np.isfinite(x).all() for x in arrays)):
            raise DataError(f"the sample at t = {t:g} s is not finite, so it was refused")
        if t <= self._now:
            raise DataError(f"t must increase, but {t:.6g} s follows {self._now:.6g} s")

    def _take(self, instant: Instant, now: float) -> None:
        """Give one instant to the estimator; before the warm-up is over, keep it."""
        if self._kalman is not None:
            self._step(instant, now)
            return
        v = instant[2]
        speeds = self.model.layout.drive_speeds[: len(v)]
        if (np.abs(v) >= self.settings.min_velocity * speeds).any():
            self._early.append(instant)
        if len(self._early) * self._dt >= self.settings.warmup:
            self._start()

    def _start(self) -> None:
        """Set the filter up from what has been seen so far, and let it see that."""
        t, q, v, a, tau = (np.array(x) for x in zip(*self._early, strict=True))
        joints, segment = self.model.joints, np.zeros(len(t), dtype=int)
        seen = Trajectory(t, q, v, a, tau, joints, 1.0 / self._dt, segment)
        spread = prior_spread(self.model, seen.squares, len(seen.t))
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
        detector = ChangeDetector(len(joints), s.threshold, s.drift)
        self._innovations = Innovations(rms, self._dt, s.noise_memory, s.model_error, detector)
        walk = s.walk * np.sqrt(self._dt)
        # noise levels change as they are learnt, so they come with the weights of the rows
        self._kalman = Kalman(np.ones(len(joints)), beta, C, walk, None, self._share)
        self._state: KalmanState = self._kalman.init(len(beta))
        early, self._early = self._early, []
        for instant in early:
            self._step(instant, instant[0] + self.delay)

    def _step(self, instant: Instant, now: float) -> None:
        t, q, v, a, tau = instant
        kalman = self._require_ready()
        used = sure_rows(self.model.layout, v[None], self.settings.min_velocity)[0]
        Y = self._regressor(q, v, a)
        e = tau - Y @ self._state.theta
        doubt = np.einsum("ij,ij->i", Y @ self._state.P, Y)  # variance of the prediction
        state = kalman.update(self._state, Sample(Y, tau, used / self._innovations.variance))
        self._remember(t)
        self._state, self._t = state, t
        residual = tau - Y @ state.theta
        self._compared = tau, np.where(used, tau - residual, np.nan)
        onset = self._innovations.push(t, tau, e, residual, doubt, used, self._share)
        if onset is not None:
            self._reopen(now, onset)

    def _reopen(self, now: float, onset: float) -> None:
        """Go back to what was known before the change, and make the covariance wide again."""
        # the filter smears a step over its delay, and what it let in has bent the estimate
        start = onset - self.delay
        clean = [state for t, state in self._recent if t <= start]
        before = clean[-1] if clean else self._recent[0][1]
        self.changes = (*self.changes, Change(float(now), onset, before.theta, before.P))
        self._state = replace(self._state, theta=before.theta, P=before.P + self._reopening)
        self._recent.clear()
        self._innovations.forget_convergence()

    def _remember(self, t: float) -> None:
        """Keep a state of every tenth of a second, to go back to."""
        if not self._recent or t >= self._recent[-1][0] + _KEPT_EVERY:
            self._recent.append((t, self._state))
