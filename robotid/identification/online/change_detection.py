"""Noise level, convergence and change detection from innovations."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from robotid.base.typing import Array

_LARGEST = 25.0  # largest squared innovation in the evidence [variances]
_FIRST_NOISE = 0.1  # initial noise level, relative to the RMS torque of each row
_SMALLEST_NOISE = 1e-4  # smallest noise level, relative to the RMS torque of each row
_PSEUDO = 20.0  # weight of the initial noise level [samples]
_CLIP = 9.0  # largest squared innovation in the noise level [variances]
_CONVERGED = 0.25  # variance of the prediction over that of the noise, below which it has converged


@dataclass(frozen=True, eq=False)
class Payload:
    """A payload on the last body.

    Attributes:
        parameters: Its ten inertial parameters in the body's frame, shape (10,).
        std_error: Their standard errors, shape (10,).
    """

    parameters: Array
    std_error: Array

    @property
    def mass(self) -> float:
        """Its mass [kg]."""
        return float(self.parameters[0])

    @property
    def mass_std_error(self) -> float:
        """Standard error of its mass [kg]."""
        return float(self.std_error[0])


class ChangeDetector:
    """CUSUM on squared innovations, row by row.

    With the squared innovation d_j^2 in units of its variance, the evidence is
    g_j <- max(0, g_j + share (min(d_j^2, 25) - drift)), and a change is flagged when one g_j
    reaches the threshold. The onset of the change is the time at which that g_j last left 0.

    References:
        Page (1954), Continuous Inspection Schemes.
    """

    def __init__(self, n: int, threshold: float, drift: float) -> None:
        self.threshold, self.drift = threshold, drift
        self.evidence = np.zeros(n)
        self._onset = np.full(n, np.nan)

    def push(self, t: float, squares: Array, share: float) -> float | None:
        """Process one sample; return the onset of a change flagged now [s], else None."""
        # squares (n,)
        evidence = self.evidence + share * (np.minimum(squares, _LARGEST) - self.drift)
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

    Attributes:
        variance: Noise variance of each row, shape (n,) [(N m)^2 or N^2].
        ratio: Mean variance of the prediction, from the parameters' uncertainty, over that of the
            noise, shape (n,); inf before the first sample.

    rms (n,) [N m or N].
    """

    def __init__(
        self, rms: Array, dt: float, memory: float, model_error: float, detector: ChangeDetector
    ) -> None:
        self._floor = (_SMALLEST_NOISE * np.maximum(rms, 1e-3 * rms.max())) ** 2 + 1e-300
        self.variance = np.maximum((_FIRST_NOISE * rms) ** 2, self._floor)
        self.ratio = np.full(len(rms), np.inf)
        self._torque = rms**2
        self._dt, self._memory, self._model_error = dt, memory / dt, model_error
        self._samples = np.full(len(rms), _PSEUDO)
        self._detector = detector

    @property
    def is_converged(self) -> bool:
        """Whether the parameters' uncertainty adds less than half a noise level to each row."""
        return bool((self.ratio < _CONVERGED).all())

    def push(
        self,
        t: float,
        tau: Array,
        e: Array,
        residual: Array,
        uncertainty: Array,
        used: Array,
        share: float,
    ) -> float | None:
        """Process one sample; return the onset of a change flagged now [s], else None.

        tau (n,) [N m or N], e (n,) [N m or N], residual (n,) [N m or N], uncertainty (n,)
        [(N m)^2 or N^2], used (n,).
        """
        expected = uncertainty + self.variance + self._model_error**2 * self._torque
        # before convergence, innovations do not indicate a change
        evidence = np.where(used & (self.ratio < _CONVERGED), e**2 / expected, 0.0)
        self._update_noise(tau, e * residual, uncertainty, used)
        return self._detector.push(t, evidence, share)

    def forget_convergence(self) -> None:
        """Reset the convergence, after the covariance was increased."""
        self.ratio = np.full(len(self.ratio), np.inf)

    def _update_noise(self, tau: Array, product: Array, uncertainty: Array, used: Array) -> None:
        """Average noise and torque over the memory, and the variance ratio over one second."""
        bounded = np.clip(product, 0.0, _CLIP * (uncertainty + self.variance))
        ratio = uncertainty / self.variance
        self._samples = np.minimum(self._samples + used, self._memory)
        gain = used / self._samples
        self._torque = self._torque + gain * (tau**2 - self._torque)
        self.variance = np.maximum(self.variance + gain * (bounded - self.variance), self._floor)
        known = np.isfinite(self.ratio)
        averaged = np.where(known, self.ratio, ratio)
        averaged += min(1.0, self._dt) * (ratio - averaged)
        self.ratio = np.where(used, averaged, self.ratio)


def payload_of(difference: Array, covariance: Array, columns: Array, spread: Array) -> Payload:
    """Return the payload that explains a difference of the base parameters.

    Minimises (d - K_L phi)^T C^-1 (d - K_L phi) + |phi / spread|^2.
    """
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
    """Return the prior standard deviations of a payload, (10,): of a mean link, twice its size."""
    # spread (10 bodies,)
    by_body = spread.reshape(-1, 10)
    mass = max(float(by_body[:, 0].mean()), float(by_body[-1, 0]))
    radius = 2.0 * float(np.max(by_body[-1, 1:4]) / by_body[-1, 0])
    return mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])
