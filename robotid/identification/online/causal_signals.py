"""Online signal processing with a known delay: uniform grid, causal filter, differentiation.

Position and torque pass the same Bessel filter, with the same delay at all frequencies of the pass
band, so that they remain synchronous. Velocity and acceleration are central differences of the
filtered position, with a delay of one step.
"""

from collections.abc import Iterator

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array

#: One instant of smooth motion: t [s], then q, v, a, tau, each of shape (n,).
Instant = tuple[float, Array, Array, Array, Array]

_SLOWEST = 1e-5  # smallest cut-off over the rate
_GAP_CYCLES = 0.25  # longest pause without a gap [periods of the cut-off]
_SETTLE = 4.0  # time after a start or a gap before the first instant [delays]


class LiveSignals:
    """Converts samples of q and tau online into instants of q, v, a, tau.

    Attributes:
        delay: Delay of the instants after the samples [s].

    is_continuous (n,).
    """

    def __init__(
        self, n: int, rate: float, cutoff: float, order: int, is_continuous: Array
    ) -> None:
        if not 0 < cutoff < rate / 2:
            raise SettingsError(
                f"cutoff {cutoff:g} Hz is not between 0 and half the rate {rate:g} Hz"
            )
        if cutoff < _SLOWEST * rate:
            raise SettingsError(
                f"cutoff {cutoff:g} Hz is less than {_SLOWEST:g} of the rate {rate:g} Hz, which is "
                "too low for an exact filter. Set a larger cutoff, or correct the time stamps"
            )
        if order < 2 or order % 2:
            raise SettingsError(f"order is {order}, wanted an even number")
        self._step, self._n = 1.0 / rate, n
        self._is_continuous = np.asarray(is_continuous, dtype=bool)
        self._gap = max(_GAP_CYCLES / cutoff, 2.5 / rate)
        self._M = _bessel(order, cutoff, rate)  # [x; y]_k+1 = M [x; u]_k
        A, B, C = self._M[:-1, :-1], self._M[:-1, -1:], self._M[-1:, :-1]
        inverse = np.linalg.inv(np.eye(order) - A)
        self._rest = (inverse @ B)[:, 0]  # state at a constant input of 1
        self.delay = (float((C @ inverse @ inverse @ B)[0, 0]) + 1.0) * self._step
        self._warm = int(np.ceil(_SETTLE * self.delay / self._step))
        self._last: tuple[float, Array] | None = None
        self._x = np.zeros((order, 2 * n))
        self._recent: list[Array] = []
        self._next, self._count = 0.0, 0

    def push(self, t: float, q: Array, tau: Array) -> Iterator[Instant]:
        """Process a sample and return the delayed instants that it completes; typically one."""
        # q (n,) [rad or m], tau (n,) [N m or N]
        if q.shape != (self._n,) or tau.shape != (self._n,):
            raise DataError(f"q has shape {q.shape} and tau {tau.shape}, wanted ({self._n},) each")
        u = np.concatenate([q, tau])
        if not (np.isfinite(t) and np.isfinite(u.sum())):
            raise DataError(f"the sample at t = {t:g} s is not finite, so it was refused")
        last = self._last
        if last is not None:
            if t <= last[0]:
                raise DataError(f"t must increase, but {t:.15g} s follows {last[0]:.15g} s")
            jump = np.where(self._is_continuous, u[: self._n] - last[1][: self._n], 0.0)
            u[: self._n] -= 2 * np.pi * np.round(jump / (2 * np.pi))
        self._last = (t, u)
        if last is None or t - last[0] > self._gap:
            self._restart(t, u)
            return iter(())
        return iter(self._advance(last, t, u))

    def _restart(self, t: float, u: Array) -> None:
        self._x = np.outer(self._rest, u)
        self._recent, self._count, self._next = [], 0, t + self._step

    def _advance(self, last: tuple[float, Array], t: float, u: Array) -> list[Instant]:
        """Return the instants at the grid times up to t."""
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
