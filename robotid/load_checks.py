"""Does the torque fit the URDF's masses: scale of each torque, payload, mismatch.

One linear model of all joints with priors: each link as the URDF has it times 1 +- 0.3, a payload
of any size in the last link, drives of any size, and torques known to 5 %.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.probe import Probe
from robotid.verdict import Finding

__all__ = ["LoadModel", "check_loads", "load_model"]

_SPREAD = 0.3  # of a link's mass about the URDF's
_PRECISION = 0.05  # of a torque, model errors included
_INDEPENDENT = 20.0  # instants of a log that are independent of each other
_MASS, _MOMENT = 20.0, 10.0  # [kg], [kg m] of a payload, wide
_GAIN = 20.0  # drop of the misfit that makes another torque scale believable
_OTHER_SCALE = 3.0  # a torque scale farther from 1 than this is no error of masses
_SCALES = np.logspace(-3, 3, 61)
_HEAVY = 0.08  # payload over the arm's mass that is surely more than the links' errors
_MISMATCH = 7.5  # sum of squares of the links' errors, in standard deviations, that is too much


@dataclass(frozen=True, eq=False)
class LoadModel:
    """Normal equations of the torques of each joint, whitened.

    Attributes:
        probe: The motion.
        H: Information of each joint, shape (n, c, c).
        h: Its right-hand side, shape (n, c).
        squares: Its sum of squared torques, shape (n,).
        mean: Prior mean of the c unknowns: links, payload, drives.
        spread: Prior standard deviation, shape (c,).
    """

    probe: Probe
    H: Array
    h: Array
    squares: Array
    mean: Array
    spread: Array

    def fit(self, scale: Array) -> tuple[float, Array, Array]:
        """Fit with the torque columns multiplied by a scale.

        Args:
            scale: Factor of each torque column, shape (n,).

        Returns:
            The misfit (chi-square, prior included), the unknowns and their standard deviations.
        """
        prior = 1 / self.spread**2
        H = np.tensordot(1 / scale**2, self.H, axes=1) + np.diag(prior)
        h = (1 / scale) @ self.h + prior * self.mean
        # both sides scaled to the prior, so that H has a sound condition
        inverse = np.linalg.inv(H * np.outer(self.spread, self.spread))
        theta = self.spread * (inverse @ (self.spread * h))
        chi = float(self.squares.sum() + self.mean @ (prior * self.mean) - h @ theta)
        return chi, theta, self.spread * np.sqrt(np.diag(inverse))


def load_model(probe: Probe, share: Array) -> LoadModel:
    """Return the normal equations of a motion.

    Args:
        probe: The motion.
        share: Share of each torque's variance that no physics explains, shape (n,).

    Returns:
        The load model; joints whose torque is constant have no say.
    """
    N, n = probe.tau.shape
    pi = probe.model.standard_parameters()[: probe.model.layout.n_inertial].reshape(-1, 10)
    bodies = len(pi)
    Y = probe.regressor().reshape(N, n, bodies, 10)
    drives = [np.delete(probe.drive(j), 4, axis=1) for j in range(n)]
    width = drives[0].shape[1]
    X = np.zeros((N, n, bodies + 4 + n * width))
    X[:, :, :bodies] = np.einsum("knbi,bi->knb", Y, pi)
    X[:, :, bodies : bodies + 4] = Y[:, :, -1, :4]
    for j, columns in enumerate(drives):
        X[:, j, bodies + 4 + width * j : bodies + 4 + width * (j + 1)] = columns
    level = probe.tau.std(axis=0)
    sigma = np.sqrt(_PRECISION**2 + share) * level
    weight = np.sqrt(_INDEPENDENT / N) / np.where(level > 0, sigma, np.inf)
    A, b = X * weight[:, None], probe.tau * weight
    drive_size = 100 * float(np.abs(probe.tau).max()) + 1.0
    mean = np.concatenate([np.ones(bodies), np.zeros(4 + n * width)])
    payload = [_MASS, *[_MOMENT] * 3]
    spread = np.concatenate([np.full(bodies, _SPREAD), payload, np.full(n * width, drive_size)])
    return LoadModel(
        probe, np.einsum("kjc,kjd->jcd", A, A), np.einsum("kjc,kj->jc", A, b),
        np.einsum("kj,kj->j", b, b), mean, spread,
    )  # fmt: skip


def check_loads(probe: Probe, share: Array, name: str) -> Iterator[Finding]:
    """Yield torques in another scale, a payload, a URDF of another robot.

    Args:
        probe: The motion; signs, order and gravity must be right.
        share: Share of each torque's variance that no physics explains, shape (n,).
        name: What the log is called.

    Yields:
        "current_for_torque" per joint, or else "urdf_mismatch", or else "payload".
    """
    model = load_model(probe, share)
    scale = _torque_scales(model)
    other = np.flatnonzero(np.abs(np.log(scale)) > np.log(_OTHER_SCALE))
    for j in other:
        joint = probe.model.joints[j]
        message = (
            f"{name}: the torque of {joint} fits the URDF far better times {scale[j]:.3g}: it may "
            f"be a current, or have another unit or gain; give it as current_{joint} with "
            f"[torque] gains (--gain {joint}=...), or correct the gain"
        )
        evidence = {"factor": float(scale[j])}
        yield Finding("current_for_torque", "warning", f"{name}: {joint}", message, evidence)
    if len(other) == 0:
        _, theta, error = model.fit(np.ones(len(scale)))
        bodies = len(probe.model.layout.bodies)
        mismatch = list(_mismatch(probe, theta[:bodies], name))
        yield from mismatch or _payload(
            probe, theta[bodies : bodies + 4], float(error[bodies]), name
        )


def _torque_scales(model: LoadModel) -> Array:
    """Return the factors of the torque columns that the data insist on, 1 elsewhere."""
    n = len(model.squares)
    start = [np.full(n, k) for k in _SCALES]
    common = min(start, key=lambda scale: model.fit(scale)[0])
    base = model.fit(np.ones(n))[0]
    far = abs(np.log(common[0])) > np.log(_OTHER_SCALE)
    scale = common if far and base - model.fit(common)[0] > _GAIN else np.ones(n)
    for _ in range(n):
        now = model.fit(scale)[0]
        trials = [_with(scale, j, k) for j in range(n) for k in _SCALES]
        best = min(trials, key=lambda trial: model.fit(trial)[0])
        if now - model.fit(best)[0] < _GAIN:
            break
        scale = best
    return scale


def _with(scale: Array, j: int, k: float) -> Array:
    changed = scale.copy()
    changed[j] = k
    return changed


def _mismatch(probe: Probe, factors: Array, name: str) -> Iterator[Finding]:
    if np.sum(((factors - 1.0) / _SPREAD) ** 2) < _MISMATCH:
        return
    links = probe.model.layout.bodies
    shown = ", ".join(f"{link} {factor:.2g}" for link, factor in zip(links, factors, strict=True))
    message = (
        f"{name}: to explain the torques, the URDF's links would have to weigh {shown} times what "
        "it says: the URDF may be of another robot or lack a load; check the model, and use the "
        "URDF's values as prior with care"
    )
    evidence = dict(zip(links, factors.tolist(), strict=True))
    yield Finding("urdf_mismatch", "warning", name, message, evidence)


def _payload(probe: Probe, load: Array, error: float, name: str) -> Iterator[Finding]:
    mass = float(load[0])
    arm = float(probe.model.standard_parameters()[: probe.model.layout.n_inertial : 10].sum())
    if abs(mass) < 3 * error:
        return
    link = probe.model.layout.bodies[-1]
    verb = "more" if mass > 0 else "less"
    message = (
        f"{name}: {link} carries about {abs(mass):.2g} +- {error:.2g} kg {verb} than the URDF "
        "says; if a tool or payload is mounted, add it to the URDF or expect it in the last link"
    )
    evidence = {"mass": mass, "std_error": error, "mcx": float(load[1]), "mcy": float(load[2]),
                "mcz": float(load[3])}  # fmt: skip
    severity = "warning" if abs(mass) - 2 * error > _HEAVY * arm else "note"
    yield Finding("payload", severity, f"{name}: {link}", message, evidence)
