"""Scale check of a result, independent of the torque sensors: the URDF's gravity and masses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.findings import listed
from robotid.fitting.result import Fit
from robotid.regressor.constraints import loop_basis, without_forces
from robotid.regressor.prediction import predict
from robotid.regressor.torque import joint_torque_regressor

__all__ = ["ScaleCheck", "check_scale"]

_POSES = 300  # at which gravity is compared
_LOADED = 0.02  # share of the largest gravity torque above which a joint is compared
_KNOWN = 0.1  # standard error of a ratio below which it is used
_AGREES = 0.05  # farther from 1 than this, gravity and total mass do not confirm the scale
_HELD_BACK = 1.5  # residual over that of WLS beyond which the prior determines the result
_ANOTHER = 0.35  # ... and farther than this, they contradict it
_OFF = 0.1  # a common factor of all torques is reported if it is at least so far from 1,
_CLEARLY = 4.0  # ... if that distance is so many times the unexplained share of gravity
_BETTER = 0.5  # ... and that share is less than this times the one with a payload


@dataclass(frozen=True)
class ScaleCheck:
    """The identified gravity and masses against the URDF's.

    Attributes:
        gravity: Identified over URDF's gravity torque, by joint that gravity loads [-].
        gravity_error: Standard errors of these ratios [-].
        scale: Ratio over all joints together, fitted with a payload; None if gravity loads none.
        factor: Ratio over all joints together, without a payload [-].
        unexplained: Share of the identified gravity torque that remains unexplained by one factor,
            and by a payload [-].
        masses: Total mass of the URDF, identified total mass, mass of that payload [kg].
        is_stated: Whether a mass is stated, which sets the scale by itself.
        friction: Share of viscous and Coulomb friction in each joint's torque [-].
        follows: Whether the result fits the data about as well as WLS. A result that its prior
            determines agrees with the URDF whatever the sensors measured.
    """

    gravity: Mapping[str, float] = field(default_factory=dict)
    gravity_error: Mapping[str, float] = field(default_factory=dict)
    scale: float | None = None
    factor: float = 1.0
    unexplained: tuple[float, float] = (0.0, 0.0)
    masses: tuple[float, float, float] = (0.0, 0.0, 0.0)
    is_stated: bool = False
    friction: Mapping[str, float] = field(default_factory=dict)
    follows: bool = True

    @property
    def agrees(self) -> bool:
        """Whether gravity and total mass confirm the scale, or a mass is stated."""
        is_near = self.scale is not None and self._off <= _AGREES
        return self.is_stated or (is_near and self.follows)

    @property
    def contradicts(self) -> bool:
        """Whether gravity and total mass contradict the scale."""
        return not self.is_stated and (self._off > _ANOTHER or self.has_one_factor)

    @property
    def has_one_factor(self) -> bool:
        """Whether one common factor explains gravity: the scale is wrong, not single masses."""
        by_factor, by_payload = self.unexplained
        return abs(self.factor - 1.0) > max(_OFF, _CLEARLY * by_factor) and (
            by_factor < _BETTER * by_payload
        )

    @property
    def figures(self) -> str:
        """Gravity torque and total mass against the URDF's, as text."""
        before, after, _ = self.masses
        mass = f"total mass {after:.4g} kg against the URDF's {before:.4g} kg"
        if self.scale is None:
            return f"gravity loads no joint, {mass}"
        return f"gravity torque {self.factor:.2f} x the URDF's, {mass}"

    @property
    def message(self) -> str:
        """What was verified, or what could not be verified and the remedy."""
        if self.is_stated:
            return f"absolute scale set by the stated mass: {self.figures}"
        if self.agrees:
            agrees = "absolute scale: gravity and total mass agree with the URDF's within 5 %"
            if self._off_whole <= _AGREES:
                return f"{agrees}: {self.figures}"
            before, after, payload = self.masses
            return (
                f"{agrees} only if a load of {payload:+.3g} kg is added to the last link, "
                "which the URDF does not have. Without the load: gravity torque "
                f"{self.scale:.2f} x the URDF's, total mass {after - payload:.4g} kg against the "
                f"URDF's {before:.4g} kg. With it: {self.figures}. If no such load was mounted, "
                "check the gains of the torques"
            )
        hint = ""
        if self.has_one_factor:
            hint = (
                f" The same factor {self.factor:.2f} fits all joints: check the gains of the "
                "torques."
            )
        elif outside := [
            f"{j} {x:.2f}" for j, x in self.gravity.items() if abs(x - 1.0) > _ANOTHER
        ]:
            hint = f" Gravity torque over the URDF's, by joint: {listed(outside)}."
        return f"absolute scale not verified: {self.figures}.{hint} State a known mass (total_mass)"

    @property
    def _off(self) -> float:
        """Relative difference of gravity and total mass, less a payload if it explains them [-].

        A payload without mass is ignored: it does not determine the scale.
        """
        before, after, payload = self.masses
        if not (before > 0 and payload > 0):
            return self._off_whole
        with_load = max(abs((after - payload) / before - 1.0), abs((self.scale or 1.0) - 1.0))
        return min(with_load, self._off_whole)

    @property
    def _off_whole(self) -> float:
        """Relative difference of gravity and total mass without a payload [-]."""
        before, after, _ = self.masses
        if not before > 0:
            return np.inf
        return max(abs(after / before - 1.0), abs(self.factor - 1.0))

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as result.json has them."""
        lists = {"unexplained": list(self.unexplained), "masses": list(self.masses)}
        return asdict(self) | lists | {"agrees": self.agrees, "message": self.message}


def check_scale(found: Fit) -> ScaleCheck:
    """Compare gravity and masses of a result with the URDF's.

    With g_u and g the gravity torques of the URDF and of the result over the fitted poses, a
    joint's ratio is g_u . g / g_u . g_u. It is linear in the base parameters: the covariance of the
    result gives its standard error.

    Args:
        found: The identification.
    """
    model, size = found.model, found.model.layout.n_inertial
    bounds = found.estimator.bounds
    is_stated = bounds.total is not None or any(np.ptp(m) == 0 for m in bounds.masses.values())
    before, after = (float(pi[:size:10].sum()) for pi in (found.prior, found.standard))
    friction = _friction(found)
    errors = [found.metrics(name).per_joint for name in ("estimate", "wls")]
    follows = all(errors[0][j].rmse <= _HELD_BACK * free.rmse for j, free in errors[1].items())
    plain = ScaleCheck(
        masses=(before, after, 0.0), is_stated=is_stated, friction=friction, follows=follows
    )
    q = np.vstack([e.recording.trajectory.q for e in found.fitted])
    if model.free_flyer:  # gravity loads its base with the whole mass
        ratio = after / before if before > 0 else 1.0
        return replace(plain, scale=ratio, factor=ratio)
    q = q[:: -(-len(q) // _POSES)]
    still = np.zeros_like(q)
    G = joint_torque_regressor(model, q, still, still).reshape(len(q), model.n_rows, -1)
    if model.loops:
        G = without_forces(loop_basis(model, q), G)
    last = G[:, :, size - 10 : size - 6]  # m, mcx, mcy, mcz of the last body
    G = G[:, :, found.mapping.independent]
    at_rest = np.arange(len(found.prior)) < size
    of_urdf, of_result = (
        G @ found.mapping.to_base(np.where(at_rest, pi, 0.0))
        for pi in (found.prior, found.standard)
    )  # (N, n)
    load = np.sum(of_urdf**2, axis=0)
    if not load.any():
        return plain
    K = found.mapping.K * at_rest
    covariance = K @ found.standard_covariance @ K.T
    gravity, error = {}, {}
    for j in np.flatnonzero(load > _LOADED**2 * load.max()).tolist():
        w = of_urdf[:, j] @ G[:, j] / load[j]  # (b,), ratio = w beta
        spread = float(np.sqrt(max(w @ covariance @ w, 0.0)))
        if spread < _KNOWN:
            gravity[model.row_names[j]] = float(of_urdf[:, j] @ of_result[:, j] / load[j])
            error[model.row_names[j]] = spread
    factor = float(np.sum(of_urdf * of_result) / load.sum())
    scale, payload, left = _with_payload(of_urdf, of_result, last)
    rest = float(np.linalg.norm(of_result - factor * of_urdf) / np.linalg.norm(of_result))
    return replace(
        plain, gravity=gravity, gravity_error=error, scale=scale, factor=factor,
        unexplained=(rest, left), masses=(before, after, payload),
    )  # fmt: skip


def _friction(found: Fit) -> dict[str, float]:
    """Return the share of friction in the RMS torque of each joint [-]."""
    layout = found.model.layout
    is_friction = [name.endswith((".viscous", ".coulomb")) for name in layout.names]
    pi = np.where(is_friction, found.standard, 0.0)
    motions = [e.recording.trajectory for e in found.fitted]
    torque = np.vstack([predict(found.model, [pi], motion)[0] for motion in motions])
    measured = np.vstack([motion.tau for motion in motions])
    share = np.linalg.norm(torque, axis=0) / np.maximum(np.linalg.norm(measured, axis=0), 1e-300)
    return dict(zip(found.model.row_names, share.tolist(), strict=True))


def _with_payload(of_urdf: Array, of_result: Array, last: Array) -> tuple[float, float, float]:
    """Return scale and mass of a payload, and the share that a payload alone leaves unexplained.

    Args:
        of_urdf: Gravity torque of the URDF, shape (N, n).
        of_result: The same as identified.
        last: Gravity torque of m, mcx, mcy and mcz of the last body, shape (N, n, 4).
    """
    P, u, g = last.reshape(-1, 4), of_urdf.reshape(-1), of_result.reshape(-1)
    alone = np.linalg.lstsq(P, g - u)[0]
    left = float(np.linalg.norm(g - u - P @ alone) / np.linalg.norm(g))
    both = np.linalg.lstsq(np.column_stack([u, P]), g)[0]
    return float(both[0]), max(float(both[1]), 0.0), left
