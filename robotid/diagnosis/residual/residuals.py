"""Spectrum of a residual, and friction against speed."""

import itertools

import numpy as np
from numpy.typing import NDArray

from robotid.base.typing import Array
from robotid.estimation.fitting.evaluation import Evaluation, predict
from robotid.robot.model import RobotModel


def spectrum(
    x: Array, used: NDArray[np.bool_], segment: Array, dt: float, *, length: float = 5.0
) -> tuple[Array, Array]:
    """Return the power spectral density of a signal with gaps and excluded samples.

    Welch's mean over half-overlapping Hann windows w, none of them across a gap. Excluded samples
    count as zero, and a window is normalised by its used samples:
    S(f) = 2 dt sum |FFT(w m x)|^2 / sum w^2 m, with m = 1 where a sample is used.

    References:
    Welch (1967), The use of fast Fourier transform for the estimation of power spectra.
    Parzen (1963), On spectral analysis with missing observations.
    """
    bounds = np.flatnonzero(np.r_[True, np.diff(segment) != 0, True])
    size = min(max(round(length / dt), 8), int(np.diff(bounds).max()))
    window = np.hanning(size + 2)[1:-1]  # without the zeros at its ends
    power, weight = np.zeros(size // 2 + 1), 0.0
    for start, end in itertools.pairwise(bounds):
        for first in range(int(start), int(end) - size + 1, max(size // 2, 1)):
            masked = window * used[first : first + size]
            power += np.abs(np.fft.rfft(masked * x[first : first + size])) ** 2
            weight += float(np.sum(masked**2))
    if weight == 0.0:
        return np.empty(0), np.empty(0)
    density = 2.0 * dt * power / weight
    density[0] /= 2.0
    if size % 2 == 0:
        density[-1] /= 2.0
    return np.fft.rfftfreq(size, dt), density


def friction_split(model: RobotModel, evaluation: Evaluation, pi: Array) -> tuple[Array, Array]:
    """Return the measured torque without rigid-body torques, and the identified friction.

    The first is tau - Y pi with pi without friction and offset, the second their torque.
    """
    layout = model.layout
    inertial = [True] * layout.n_inertial
    stiff = np.array(inertial + [term.is_inertia for _, term in layout.drive_parameters])
    trajectory = evaluation.recording.trajectory
    moved, whole = predict(model, [np.where(stiff, pi, 0.0), pi], trajectory)
    return trajectory.tau - moved, whole - moved


def _lagged(x: Array, y: Array, lags: int) -> Array:
    """Return sum_i x(i) y(i + k) for k = 0 to lags, by FFT; zero beyond the signals' length."""
    size = len(x) + lags
    transformed = np.fft.rfft(x, n=size).conj() * np.fft.rfft(y, n=size)
    products: Array = np.fft.irfft(transformed, n=size)[: lags + 1]
    return products
