"""How far predicted torques can be trusted: their bands from the covariance of the parameters."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from robotid._settings import is_number, require_kind
from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.findings import listed
from robotid.fitting.joint_motion import JointMotion
from robotid.fitting.open_terms import open_torques
from robotid.logs.data import Trajectory, real_numbers, suggestion
from robotid.regressor.base_parameters import BaseMapping
from robotid.regressor.friction_projection import DriveMoments, drive_moments
from robotid.regressor.memory import drive_motion_along
from robotid.regressor.torque import trajectory_regressor
from robotid.robot.drives import DriveMotion
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.fitting.evaluation import Evaluation
    from robotid.fitting.result import Fit

__all__ = [
    "QUANTILE",
    "FrictionCurve",
    "TorqueBand",
    "expected_band",
    "fitted_moments",
    "friction_curve",
    "recording_bands",
    "torque_band",
    "typical_friction",
]

#: Standard deviations that a 95 % band reaches.
QUANTILE = 1.96
_HELD = 0.95
_ROUNDING = 1e-9  # of a band, by which a row on its edge may lie beyond it
_SPEEDS = 20  # of a friction curve, either way
_MOST = 500  # samples that a band is computed at, spread over the trajectory


@dataclass(frozen=True, eq=False)
class TorqueBand:
    """Standard deviations of predicted torques at some samples of a trajectory.

    Attributes:
        samples: Numbers of these samples, shape (k,), int.
        parameters: From the uncertainty of the parameters, shape (k, n_rows) [N m, N].
        noise: From what the model leaves of the torque beside it, shape (n_rows,) [N m, N].
    """

    samples: Array
    parameters: Array
    noise: Array

    @property
    def total(self) -> Array:
        """Standard deviation of a measured torque about its prediction, shape (k, n_rows)."""
        return np.asarray(np.hypot(self.parameters, self.noise))

    def held(self, tau: Array, prediction: Array, mask: Array) -> Array:
        """Return which share of each joint's torques lies in the 95 % band; NaN without a row.

        Args:
            tau: Measured torques of the whole trajectory, shape (N, n_rows) [N m, N].
            prediction: Predicted ones, shape (N, n_rows) [N m, N].
            mask: Rows used, shape (N, n_rows), bool.
        """
        used = mask[self.samples]
        miss = np.abs(tau[self.samples] - prediction[self.samples])
        # one of the rows that set the band may lie on its edge
        is_held = (miss <= (1.0 + _ROUNDING) * QUANTILE * self.total) & used
        count = used.sum(axis=0)
        return np.where(count > 0, is_held.sum(axis=0) / np.maximum(count, 1), np.nan)


def torque_band(
    model: RobotModel,
    mapping: BaseMapping,
    trajectory: Trajectory,
    covariance: Array,
    noise: Array,
    errors: Callable[[Array], Sequence[tuple[Array, Array]]] = lambda rows: (),
) -> TorqueBand:
    """Return the band of predicted torques, at up to 500 samples.

    Its variance is diag(W C W^T) + sum (W x + z)^2 for what errs at once in base parameters, by x,
    and in torque, by z.

    Args:
        model: The robot.
        mapping: Standard to base parameters.
        trajectory: N samples.
        covariance: Of the base parameters, shape (b, b), finite.
        noise: Standard deviation of the torque's residual, shape (n_rows,) [N m, N].
        errors: Pairs x, shape (b,), and z, shape (k, n_rows), at k samples of the trajectory.
    """
    count = len(trajectory.t)
    samples = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    W = trajectory_regressor(model, trajectory, samples)[:, mapping.independent]
    variance = np.einsum("ij,ij->i", W @ covariance, W)
    for x, z in errors(samples):
        variance += (W @ x + z.ravel()) ** 2
    std = np.sqrt(np.maximum(variance, 0.0)).reshape(len(samples), -1)
    return TorqueBand(samples, std, np.asarray(noise))


def expected_band(found: "Fit", evaluation: "Evaluation") -> TorqueBand:
    """Return the band of a recording's torque by the noise of the fit, without its residual.

    Args:
        found: The fit.
        evaluation: The recording.
    """
    K, motion = found.mapping.K, evaluation.recording.trajectory
    moves = np.array([term.moves for term in found.open_terms]).reshape(-1, K.shape[1])
    covariance = K @ (found.standard_covariance - moves.T @ moves) @ K.T

    def errors(rows: Array) -> list[tuple[Array, Array]]:
        return list(zip(moves @ K.T, open_torques(found, evaluation, rows), strict=True))

    sigma = found.estimate.sigma
    return torque_band(found.model, found.mapping, motion, covariance, sigma, errors)


def recording_bands(found: "Fit") -> tuple[TorqueBand, ...]:
    """Return the band of each recording, fitted ones first, as their residuals show them.

    Beside the parameters' part a band has the noise with which it holds 95 % of the torques of all
    recordings of its kind, fitted or kept: of kept ones that is what the model misses of motion it
    has not seen, and a new motion is held as these are (split conformal prediction, Lei et al.
    2018, doi:10.1080/01621459.2017.1307116, with the parameters' part as the lower end).

    Args:
        found: The fit.
    """
    evaluations = (*found.fitted, *found.validation)
    bands = [expected_band(found, evaluation) for evaluation in evaluations]
    is_fitted = [k < len(found.fitted) or e.is_refitted for k, e in enumerate(evaluations)]
    own: dict[bool, list[tuple[TorqueBand, Evaluation]]] = {True: [], False: []}
    for kind, band, evaluation in zip(is_fitted, bands, evaluations, strict=True):
        own[kind].append((band, evaluation))
    noise = {kind: _residual_noise(pairs) for kind, pairs in own.items() if pairs}
    pairs = zip(bands, is_fitted, strict=True)
    return tuple(replace(band, noise=noise[kind]) for band, kind in pairs)


def _residual_noise(own: Sequence[tuple[TorqueBand, "Evaluation"]]) -> Array:
    """Return the noise with which bands hold 95 % of what they predict, shape (n_rows,)."""
    noise = own[0][0].noise.copy()
    rows = []
    for band, e in own:
        residual = e.recording.trajectory.tau - e.torques["estimate"]
        rows.append((band.parameters, residual[band.samples], e.recording.mask[band.samples]))
    std, residual, mask = (np.concatenate(part) for part in zip(*rows, strict=True))
    needed = (residual / QUANTILE) ** 2 - std**2
    for j, used in enumerate(mask.T.astype(bool)):
        if used.any():
            noise[j] = np.sqrt(max(np.quantile(needed[used, j], _HELD), 0.0))
    return noise


@dataclass(frozen=True, eq=False)
class FrictionCurve:
    """Friction and offset of a drive while it moves steadily.

    Attributes:
        v: Speeds, shape (k,) [rad/s or m/s].
        torque: Friction and offset there, shape (k,) [N m or N].
        std: Its standard deviation from the uncertainty of the parameters, shape (k,).
        load: Torque of the bodies that the gear carries meanwhile [N m or N].
    """

    v: Array
    torque: Array
    std: Array
    load: float

    def __str__(self) -> str:
        rows = zip(self.v.tolist(), self.torque.tolist(), self.half_width.tolist(), strict=True)
        return "\n".join(
            [
                f"friction and offset against speed, gear loaded by {self.load:.3g}",
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
        """Half the width of the 95 % band about the torque, shape (k,) [N m or N]."""
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
    """Return friction and offset of a drive as it was in the fitted logs; see ``friction_curve``.

    Args:
        found: The fit.
        joint: The joint that the drive turns, or the name of a coupling.
        v: Speeds, shape (k,) [rad/s or m/s]; None: 20 either way, from the slowest to the fastest.
        q: Position [rad or m]; None: the median.
        load: Torque of the bodies that the gear carries [N m or N]; None: its root mean square if
            the friction grows with it, else 0.

    Raises:
        DataError: If there is no such drive; or without speeds, if it was at rest.
    """
    layout, d = found.model.layout, _drive_number(found, joint)
    ratios, first = layout.drive_ratios[d], found.model.n_rows - len(found.model.joints)
    rows = [e.recording.mask[:, first:][:, ratios != 0.0].all(axis=1) for e in found.fitted]
    motions = [e.recording.trajectory for e in found.fitted]
    for name, value in (("q", q), ("load", load)):
        if not (value is None or is_number(value)):
            raise DataError(f"{name} is {str(value)[:60]!r}, wanted a finite number, or none")
    if v is None:
        used = zip(motions, rows, strict=True)
        speeds = np.concatenate([np.abs(m.v[kept, first:] @ ratios) for m, kept in used])
        if not speeds.any():
            raise DataError(
                f"{joint} was at rest in the fitted logs, so no speeds are known to show its "
                "friction at; state them, friction(joint, v)"
            )
        side = np.linspace(speeds.min(), speeds.max(), _SPEEDS)
        v = np.append(-side[::-1], side)
    if q is None:
        places = [m.q[kept] @ ratios for m, kept in zip(motions, rows, strict=True)]
        q = float(np.median(np.concatenate(places))) if np.any(np.concatenate(rows)) else 0.0
    if load is None:
        load = 0.0
        if any(term.name == "load" for term in layout.own.get(joint, ())):
            carried = [drive_motion_along(found.model, m).load[d] for m in motions]
            load = float(np.sqrt(np.mean(np.concatenate(carried)[np.concatenate(rows)] ** 2)))
    speeds = real_numbers(v, "v")
    if speeds.ndim != 1 or not np.isfinite(speeds).all():
        raise DataError(f"v has shape {speeds.shape}, wanted finite speeds, shape (k,)")
    return friction_curve(found, joint, speeds, q=q, load=load)


def fitted_moments(found: "Fit") -> dict[str, DriveMoments]:
    """Return what projects the friction of drives on simpler terms, from the fitted rows.

    Args:
        found: The fit.
    """
    rows = ((e.recording.trajectory, e.recording.mask) for e in found.fitted)
    return drive_moments(found.model, rows)


def friction_curve(
    found: "Fit", joint: str, v: Array, *, q: float = 0.0, load: float = 0.0
) -> FrictionCurve:
    """Return friction and offset of a drive against its speed, with the band of its parameters.

    Friction that depends on the past is that of a drive which has moved one way for long.

    Args:
        found: The fit.
        joint: The joint that the drive turns, or the name of a coupling.
        v: Speeds, shape (k,) [rad/s or m/s].
        q: Position, of which some friction depends [rad or m].
        load: Torque of the bodies that the gear carries [N m or N].

    Raises:
        DataError: If there is no such drive.
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
        if term.joint == joint:  # its own torque adds to what it moves
            moved = moved + term.torque(motion, JointMotion.steady(motion))
        variance += moved**2
    return FrictionCurve(v, X @ found.standard[k], np.sqrt(np.maximum(variance, 0.0)), load)


def _drive_number(found: "Fit", joint: str) -> int:
    require_kind(joint, str, "joint", "the name of a joint, or of a coupling")
    names = [drive.name for drive in found.model.layout.drives]
    if joint not in names:
        raise DataError(
            f"{joint!r} is no drive of {found.model.name}; drives: {listed(names)}"
            f"{suggestion(joint, names)}"
        )
    return names.index(joint)
