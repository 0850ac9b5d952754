"""Uncertainty bands of predicted torques and friction, from the covariance of the parameters."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robotid.base.arguments import real_numbers
from robotid.base.exceptions import DataError
from robotid.base.findings import listed
from robotid.base.settings import is_number, require_kind
from robotid.base.typing import Array
from robotid.data.log import Trajectory, suggestion
from robotid.dynamics.base_parameters import BaseMapping
from robotid.dynamics.friction_projection import DriveMoments, drive_moments
from robotid.dynamics.prediction import drive_motion_along
from robotid.dynamics.torque import trajectory_regressor
from robotid.estimation.fitting.joint_motion import JointMotion
from robotid.estimation.fitting.open_terms import open_torques
from robotid.robot.drives import DriveMotion
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.estimation.fitting.evaluation import Evaluation
    from robotid.estimation.fitting.fitted import Fit

#: Half-width of a 95 % band in standard deviations.
QUANTILE = 1.96
_COVERAGE = 0.95
_ROUNDING = 1e-9  # relative tolerance for a row on the edge of the band
_SPEEDS = 20  # points of a friction curve in each direction
_MOST = 500  # largest number of samples at which a band is computed


@dataclass(frozen=True, eq=False)
class TorqueBand:
    """Standard deviations of predicted torques at some samples of a trajectory.

    Attributes:
        samples: Indices of these samples, shape (k,), int.
        parameters: Part due to the uncertainty of the parameters, shape (k, n_rows) [N m, N].
        noise: Part due to the residual of the model, shape (n_rows,) [N m, N].
    """

    samples: Array
    parameters: Array
    noise: Array

    @property
    def total(self) -> Array:
        """Standard deviation of measured torque minus prediction, shape (k, n_rows) [N m, N]."""
        return np.asarray(np.hypot(self.parameters, self.noise))

    def coverage(self, tau: Array, prediction: Array, mask: Array) -> Array:
        """Return the share of each joint's torques in the 95 % band, shape (n_rows,) [-].

        tau (N, n_rows) [N m, N], prediction (N, n_rows) [N m, N], mask (N, n_rows).
        """
        used = mask[self.samples]
        error = np.abs(tau[self.samples] - prediction[self.samples])
        # a row that determines the band may lie on its edge
        is_inside = (error <= (1.0 + _ROUNDING) * QUANTILE * self.total) & used
        count = used.sum(axis=0)
        return np.where(count > 0, is_inside.sum(axis=0) / np.maximum(count, 1), np.nan)


def torque_band(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    covariance: Array,
    noise: Array,
    errors: Callable[[Array], Sequence[tuple[Array, Array]]] = lambda rows: (),
) -> TorqueBand:
    """Return the band of predicted torques, at up to 500 samples.

    Its variance is diag(W C W^T) + sum (W x + z)^2. Each pair (x, z) is an error that changes the
    base parameters by x and, together with them, the torque by z.

    covariance (b, b), noise (n_rows,) [N m, N], errors (b,).
    """
    count = len(trajectory.t)
    samples = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    W = trajectory_regressor(model, trajectory, samples)[:, mapping.independent]
    variance = np.einsum("ij,ij->i", W @ covariance, W)
    for x, z in errors(samples):
        variance += (W @ x + z.ravel()) ** 2
    std = np.sqrt(np.maximum(variance, 0.0)).reshape(len(samples), -1)
    return TorqueBand(samples, std, np.asarray(noise))


def expected_band(
    found: "Fit", evaluation: "Evaluation", between: Array | None = None
) -> TorqueBand:
    """Return the torque band of a recording by the fit's noise level, not by its own residual.

    between (p, p).
    """
    K, motion = found.mapping.K, evaluation.recording.trajectory
    moves = np.array([term.moves for term in found.open_terms]).reshape(-1, K.shape[1])
    C = found.standard_covariance - moves.T @ moves
    covariance = K @ (C if between is None else C + between) @ K.T

    def errors(rows: Array) -> list[tuple[Array, Array]]:
        return list(zip(moves @ K.T, open_torques(found, evaluation, rows), strict=True))

    sigma = found.estimate.sigma
    return torque_band(found.model, found.mapping, motion, covariance, sigma, errors)


def next_errors(found: "Fit") -> Array:
    """Return the expected RMS torque error of the next log, shape (n_rows,) [N m, N].

    Its motion is like that of the fitted logs, and its drives vary like theirs.
    """
    bands = [expected_band(found, evaluation, found.between) for evaluation in found.fitted]
    return rms_error(bands)


def rms_error(bands: Sequence[TorqueBand]) -> Array:
    """Return the expected RMS error of predicted torques, shape (n_rows,) [N m, N]."""
    return np.asarray(np.sqrt(np.mean(np.vstack([b.total for b in bands]) ** 2, axis=0)))


def recording_bands(found: "Fit") -> tuple[TorqueBand, ...]:
    """Return the torque band of each recording from its residuals, fitted recordings first.

    The noise part is chosen so that the bands contain 95 % of the torques of all recordings of the
    same kind, fitted or validation. For validation recordings it is the prediction error on new
    motion, and the band covers further motions as it covers these (split conformal prediction, Lei
    et al. 2018, doi:10.1080/01621459.2017.1307116, with the parameters' part as the lower bound).
    """
    evaluations = (*found.fitted, *found.validation)
    is_fitted = [k < len(found.fitted) or e.is_refitted for k, e in enumerate(evaluations)]
    bands = [
        expected_band(found, evaluation, None if is_own else found.between)
        for evaluation, is_own in zip(evaluations, is_fitted, strict=True)
    ]
    own: dict[bool, list[tuple[TorqueBand, Evaluation]]] = {True: [], False: []}
    for kind, band, evaluation in zip(is_fitted, bands, evaluations, strict=True):
        own[kind].append((band, evaluation))
    noise = {kind: _residual_noise(pairs) for kind, pairs in own.items() if pairs}
    pairs = zip(bands, is_fitted, strict=True)
    return tuple(replace(band, noise=noise[kind]) for band, kind in pairs)


def _residual_noise(own: Sequence[tuple[TorqueBand, "Evaluation"]]) -> Array:
    """Return the noise with which bands contain 95 % of the torques, shape (n_rows,) [N m, N]."""
    noise = own[0][0].noise.copy()
    rows = []
    for band, e in own:
        residual = e.recording.trajectory.tau - e.torques["estimate"]
        rows.append((band.parameters, residual[band.samples], e.recording.mask[band.samples]))
    std, residual, mask = (np.concatenate(part) for part in zip(*rows, strict=True))
    needed = (residual / QUANTILE) ** 2 - std**2
    for j, used in enumerate(mask.T.astype(bool)):
        if used.any():
            noise[j] = np.sqrt(max(np.quantile(needed[used, j], _COVERAGE), 0.0))
    return noise


@dataclass(frozen=True, eq=False)
class FrictionCurve:
    """Friction and offset of a drive at constant speed.

    Attributes:
        v: Speeds, shape (k,) [rad/s or m/s].
        torque: Friction plus offset, shape (k,) [N m or N].
        std: Standard deviation due to the uncertainty of the parameters, shape (k,) [N m or N].
        load: Joint load torque at which the friction is evaluated [N m or N].
    """

    v: Array
    torque: Array
    std: Array
    load: float

    def __str__(self) -> str:
        rows = zip(self.v.tolist(), self.torque.tolist(), self.half_width.tolist(), strict=True)
        return "\n".join(
            [
                f"friction and offset against speed, joint load torque {self.load:.3g}",
                f"{'speed':>10} {'torque':>10} {'95 %':>9}",
                *(f"{v:10.4g} {torque:10.4g} +-{half:7.2g}" for v, torque, half in rows),
            ]
        )

    def __repr__(self) -> str:
        if not len(self.v):
            return "<FrictionCurve: no speeds>"
        return f"<FrictionCurve: {len(self.v)} speeds, {self.v.min():.4g} to {self.v.max():.4g}>"

    @property
    def half_width(self) -> Array:
        """Half-width of the 95 % band, shape (k,) [N m or N]."""
        return QUANTILE * self.std

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as ``curve`` of a joint's friction in result.json has them."""
        return {
            "v": self.v.tolist(),
            "torque": self.torque.tolist(),
            "std_error": self.std.tolist(),
            "load": self.load,
        }


def typical_friction(
    found: "Fit",
    joint: str,
    v: ArrayLike | None = None,
    *,
    q: float | None = None,
    load: float | None = None,
) -> FrictionCurve:
    """Return friction and offset of a drive under the conditions of the fitted logs.

    See ``friction_curve``.

    v (k,) [rad/s or m/s].
    """
    layout, d = found.model.layout, _drive_number(found, joint)
    ratios, first = layout.drive_ratios[d], found.model.n_rows - len(found.model.joints)
    rows = [e.recording.mask[:, first:][:, ratios != 0.0].all(axis=1) for e in found.fitted]
    motions = [e.recording.trajectory for e in found.fitted]
    for name, value in (("q", q), ("load", load)):
        if not (value is None or is_number(value)):
            raise DataError(f"{name} is {str(value)[:60]!r}, wanted a finite number or None")
    if v is None:
        used = zip(motions, rows, strict=True)
        speeds = np.concatenate([np.abs(m.v[is_used, first:] @ ratios) for m, is_used in used])
        if not speeds.any():
            raise DataError(
                f"{joint} was at rest in the fitted logs, so the range of speeds is not known; "
                "state the speeds: friction(joint, v)"
            )
        side = np.linspace(speeds.min(), speeds.max(), _SPEEDS)
        v = np.append(-side[::-1], side)
    if q is None:
        angles = [m.q[:, m.q.shape[1] - len(ratios) :] for m in motions]  # without the base's pose
        positions = [x[is_used] @ ratios for x, is_used in zip(angles, rows, strict=True)]
        q = float(np.median(np.concatenate(positions))) if np.any(np.concatenate(rows)) else 0.0
    if load is None:
        load = 0.0
        if any(term.name == "load" for term in layout.own.get(joint, ())):
            loads = [drive_motion_along(found.model, m).load[d] for m in motions]
            load = float(np.sqrt(np.mean(np.concatenate(loads)[np.concatenate(rows)] ** 2)))
    speeds = real_numbers(v, "v")
    if speeds.ndim != 1 or not np.isfinite(speeds).all():
        raise DataError(f"v has shape {speeds.shape}, wanted finite speeds, shape (k,)")
    return friction_curve(found, joint, speeds, q=q, load=load)


def fitted_moments(found: "Fit") -> dict[str, DriveMoments]:
    """Return the moments that project drive friction on simpler terms, from the fitted rows."""
    rows = ((e.recording.trajectory, e.recording.mask) for e in found.fitted)
    return drive_moments(found.model, rows)


def friction_curve(
    found: "Fit", joint: str, v: Array, *, q: float = 0.0, load: float = 0.0
) -> FrictionCurve:
    """Return friction and offset of a drive against its speed, with the band of its parameters.

    Friction terms with an internal state have their value after long motion in one direction.

    v (k,) [rad/s or m/s].
    """
    layout, d = found.model.layout, _drive_number(found, joint)
    none = np.zeros_like(v)
    motion = DriveMotion(q + none, v, none, np.sign(v), load + none, none)
    own = [
        (k, term)
        for k, (drive, term) in enumerate(layout.drive_parameters, start=layout.n_inertial)
        if drive == d and not term.is_inertia
    ]
    X = np.column_stack([none, *(term.column(motion) for _, term in own)])[:, 1:]
    k = [k for k, _ in own]
    moves = np.array([term.moves[k] for term in found.open_terms]).reshape(-1, len(k))
    C = found.standard_covariance[np.ix_(k, k)] - moves.T @ moves
    variance = np.einsum("ij,jk,ik->i", X, C, X)
    for term, moved in zip(found.open_terms, moves @ X.T, strict=True):
        if term.joint == joint:  # the term's own torque adds to the change of the parameters
            moved = moved + term.torque(motion, JointMotion.steady(motion))
        variance += moved**2
    return FrictionCurve(v, X @ found.standard[k], np.sqrt(np.maximum(variance, 0.0)), load)


def _drive_number(found: "Fit", joint: str) -> int:
    require_kind(joint, str, "joint", "the name of a joint or of a coupling")
    names = [drive.name for drive in found.model.layout.drives]
    if joint not in names:
        raise DataError(
            f"{joint!r} is no drive of {found.model.name}; drives: {listed(names)}"
            f"{suggestion(joint, names)}"
        )
    return names.index(joint)
