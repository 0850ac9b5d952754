"""What a stream of innovations says: the noise, whether a filter has converged, a step change."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from robotid._typing import Array

__all__ = ["ChangeDetector", "Innovations", "Payload", "load_spread", "payload_of"]

_LARGEST = 25.0  # a single innovation counts for no more than five standard deviations
_FIRST_NOISE = 0.1  # noise before any is measured, as a share of each row's torque
_SMALLEST_NOISE = 1e-4  # ... and the least it may become
_PSEUDO = 20.0  # samples that the first noise counts for
_CLIP = 9.0  # squared innovation, in variances, from which it does not add to the noise
_SURE = 0.25  # variance of the prediction over the noise's below which the filter has converged


@dataclass(frozen=True, eq=False)
class Payload:
    """A load on the last body.

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
    reaches the threshold. A change began when that g_j last left 0.

    Args:
        n: Number of rows.
        threshold: Evidence at which a change is flagged [-].
        drift: Mean of d_j^2 that is no evidence; 1 is that of noise alone [-].

    References:
        Page (1954), Continuous Inspection Schemes.
    """

    def __init__(self, n: int, threshold: float, drift: float) -> None:
        self.threshold, self.drift = threshold, drift
        self.evidence = np.zeros(n)
        self._began = np.full(n, np.nan)

    def push(self, t: float, squares: Array, share: float) -> float | None:
        """Take one sample; return when the change began if one is flagged now [s], else None.

        Args:
            t: Its time [s].
            squares: Squared innovations in variances, shape (n,); 0 for rows that say nothing.
            share: How much of an independent sample it is [-].
        """
        evidence = self.evidence + share * (np.minimum(squares, _LARGEST) - self.drift)
        evidence[squares == 0.0] = self.evidence[squares == 0.0]
        starts = (self.evidence <= 0.0) & (evidence > 0.0)
        self._began[starts] = t
        self.evidence = np.maximum(evidence, 0.0)
        j = int(np.argmax(self.evidence))
        if self.evidence[j] < self.threshold:
            return None
        self.evidence = np.zeros(len(evidence))
        return float(self._began[j])


class Innovations:
    """Learns the noise of each row, and judges convergence and change by it.

    The mean of innovation times residual is the variance of the noise, however uncertain the
    parameters are. No model is exact: for the detection of changes, ``model_error`` of each row's
    torque is added to its noise.

    Args:
        rms: Root mean square torque of each row, shape (n,) [N m or N].
        dt: Time between two samples [s].
        memory: Time over which noise and torque are averaged [s].
        model_error: Share of the torque that the model may miss without a change [-].
        detector: What flags changes.

    Attributes:
        variance: Noise variance of each row, shape (n,) [(N m)^2 or N^2].
        doubt: Recent variance of the prediction, from the parameters' uncertainty, over that of
            the noise, shape (n,); inf before any.
    """

    def __init__(
        self, rms: Array, dt: float, memory: float, model_error: float, detector: ChangeDetector
    ) -> None:
        self._floor = (_SMALLEST_NOISE * np.maximum(rms, 1e-3 * rms.max())) ** 2 + 1e-300
        self.variance = np.maximum((_FIRST_NOISE * rms) ** 2, self._floor)
        self.doubt = np.full(len(rms), np.inf)
        self._torque = rms**2
        self._dt, self._memory, self._model_error = dt, memory / dt, model_error
        self._seen = np.full(len(rms), _PSEUDO)
        self._detector = detector

    @property
    def is_converged(self) -> bool:
        """Whether the parameters' uncertainty adds less than half a noise level to each row."""
        return bool((self.doubt < _SURE).all())

    def push(
        self,
        t: float,
        tau: Array,
        e: Array,
        residual: Array,
        doubt: Array,
        used: Array,
        share: float,
    ) -> float | None:
        """Take one sample; return when a change began if one is flagged now [s], else None.

        Args:
            t: Its time [s].
            tau: Torque, shape (n,) [N m or N].
            e: Innovation tau - Y theta before the update, shape (n,) [N m or N].
            residual: The same after the update, shape (n,) [N m or N].
            doubt: Variance of the prediction from the parameters, shape (n,) [(N m)^2 or N^2].
            used: Which rows count, shape (n,), bool.
            share: How much of an independent sample it is [-].
        """
        expected = doubt + self.variance + self._model_error**2 * self._torque
        # before it has converged, an innovation says nothing about change
        evidence = np.where(used & (self.doubt < _SURE), e**2 / expected, 0.0)
        self._learn(tau, e * residual, doubt, used)
        return self._detector.push(t, evidence, share)

    def forget_convergence(self) -> None:
        """Start judging convergence anew, after the covariance was re-opened."""
        self.doubt = np.full(len(self.doubt), np.inf)

    def _learn(self, tau: Array, product: Array, doubt: Array, used: Array) -> None:
        """Average noise and torque over the memory, the doubt over a second."""
        bounded = np.clip(product, 0.0, _CLIP * (doubt + self.variance))
        ratio = doubt / self.variance
        self._seen = np.minimum(self._seen + used, self._memory)
        pace = used / self._seen
        self._torque = self._torque + pace * (tau**2 - self._torque)
        self.variance = np.maximum(self.variance + pace * (bounded - self.variance), self._floor)
        known = np.isfinite(self.doubt)
        averaged = np.where(known, self.doubt, ratio)
        averaged += min(1.0, self._dt) * (ratio - averaged)
        self.doubt = np.where(used, averaged, self.doubt)


def payload_of(difference: Array, covariance: Array, columns: Array, spread: Array) -> Payload:
    """Return the load that explains a difference of the base parameters.

    Minimises (d - K_L phi)^T C^-1 (d - K_L phi) + |phi / spread|^2.

    Args:
        difference: Change d of the base parameters, shape (b,).
        covariance: Its covariance C, shape (b, b).
        columns: Columns K_L of the base mapping that belong to the body, shape (b, 10).
        spread: How large each parameter of a load may be, shape (10,).
    """
    scale = np.sqrt(np.diag(covariance))
    L = scale[:, None] * np.linalg.cholesky(covariance / np.outer(scale, scale))
    A = scipy.linalg.solve_triangular(L, columns * spread, lower=True)
    d = scipy.linalg.solve_triangular(L, difference, lower=True)
    R = scipy.linalg.qr(np.vstack([A, np.eye(10)]), mode="r")[0][:10]
    phi = scipy.linalg.cho_solve((R, False), A.T @ d)
    inverse = scipy.linalg.solve_triangular(R, np.eye(10))
    return Payload(spread * phi, spread * np.sqrt(np.einsum("ij,ij->i", inverse, inverse)))


def load_spread(spread: Array) -> Array:
    """Return how large each parameter of a load may be, (10,): a mean link's mass, twice its size.

    Args:
        spread: How far the inertial parameters of all bodies may be wrong, shape (10 bodies,).
    """
    by_body = spread.reshape(-1, 10)
    mass = max(float(by_body[:, 0].mean()), float(by_body[-1, 0]))
    radius = 2.0 * float(np.max(by_body[-1, 1:4]) / by_body[-1, 0])
    return mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])
