"""Identified payloads: mass, centre of mass and inertia with their errors, and gains."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.verdict.payload_check import PayloadCheck
from robotid.estimation.estimators.segments import quantile
from robotid.robot.model import RobotModel

_SIGNIFICANT = 3.0  # standard errors from which a mass differs from 0
_COM = 0.05  # ... of a determined centre of mass, as a share of the robot's length
_INERTIA = 0.3  # ... of a determined inertia about it, as a share of the mean principal moment


@dataclass(frozen=True, eq=False)
class Payload:
    """Payload of a link, in the frame of the link.

    Attributes:
        link: The link.
        mass: Mass [kg].
        mass_std_error: Its standard error [kg]; 0 if the mass was stated.
        mass_interval: 95 % interval of it, shape (2,) [kg].
        com: Centre of mass, shape (3,) [m].
        com_std_error: Its standard errors, shape (3,) [m].
        inertia: Inertia about the centre of mass, axes of the link, shape (3, 3) [kg m^2].
        inertia_std_error: Its standard errors, shape (3, 3) [kg m^2].
        reasons: Why some of "com" and "inertia" are not determined, by name.
    """

    link: str
    mass: float
    mass_std_error: float
    mass_interval: Array
    com: Array
    com_std_error: Array
    inertia: Array
    inertia_std_error: Array
    reasons: Mapping[str, str]

    @property
    def determined(self) -> tuple[str, ...]:
        """Those of "mass", "com" and "inertia" that the motion determines."""
        return tuple(name for name in ("mass", "com", "inertia") if name not in self.reasons)

    @property
    def inertia_at_link(self) -> Array:
        """Inertia about the origin of the link's frame, shape (3, 3) [kg m^2]."""
        c = self.com
        inertia: Array = self.inertia + self.mass * (c @ c * np.eye(3) - np.outer(c, c))
        return inertia

    @property
    def parameters(self) -> Array:
        """The ten inertial parameters in the link's frame, shape (10,)."""
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = self.inertia_at_link.tolist()
        return np.array([self.mass, *(self.mass * self.com), xx, xy, yy, xz, yz, zz])

    def lines(self) -> list[str]:
        """Return mass, centre of mass and inertia as text, or why they are not determined."""
        low, high = self.mass_interval.tolist()
        known = "known" if self.mass_std_error == 0 else f"95 %: [{low:.4g}, {high:.4g}]"
        lines = [f"{self.link}: {self.mass:.4g} +- {self.mass_std_error:.2g} kg, {known}"]
        shown = (
            ("com", "centre of mass", "m", self.com, self.com_std_error),
            ("inertia", "inertia about it, diagonal", "kg m^2",
             np.diag(self.inertia), np.diag(self.inertia_std_error)),
        )  # fmt: skip
        for key, words, unit, values, errors in shown:
            pairs = zip(values.tolist(), errors.tolist(), strict=True)
            figures = ", ".join(f"{x:.3g} +- {error:.2g}" for x, error in pairs)
            why = self.reasons.get(key)
            lines.append(f"  {words}: {f'{figures} {unit}' if why is None else why}")
        return lines

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, None for what is not determined."""
        values = {
            "mass": self.mass,
            "mass_std_error": self.mass_std_error,
            "mass_interval": self.mass_interval.tolist(),
        }
        for name in ("com", "inertia"):
            for key in (name, f"{name}_std_error"):
                values[key] = getattr(self, key).tolist() if name in self.determined else None
        if "inertia" in self.determined:
            values["inertia_at_link"] = self.inertia_at_link.tolist()
        return {
            "link": self.link,
            **values,
            "determined": list(self.determined),
            "reasons": dict(self.reasons),
        }


@dataclass(frozen=True)
class Gain:
    """Torque per current of a joint.

    Attributes:
        value: The gain [N m/A or N/A].
        std_error: Its standard error [same].
        interval: 95 % interval [same].
    """

    value: float
    std_error: float
    interval: tuple[float, float]


@dataclass(frozen=True, eq=False)
class PayloadFit:
    """Identified payloads, and gains identified from a known payload.

    Attributes:
        model: The robot.
        payloads: One per link.
        gains: Identified gains, by joint.
        names: Names of the base parameters of the robot without payloads.
        base: Base parameters, shape (b,), SI units.
        base_error: Their standard errors, shape (b,), including the uncertainty of the gains.
        unexplained: Relative torque error of each joint, shape (n,) [-].
        checks: Known masses against those that torque alone determines, by link.
    """

    model: RobotModel
    payloads: tuple[Payload, ...]
    gains: Mapping[str, Gain]
    names: tuple[str, ...]
    base: Array
    base_error: Array
    unexplained: Array
    checks: Mapping[str, PayloadCheck] = field(default_factory=dict)

    def __str__(self) -> str:
        every = [line for payload in self.payloads for line in payload.lines()]
        every += [check.message for check in self.checks.values()]
        every += [
            f"gain of {joint}: {gain.value:.4g} +- {gain.std_error:.2g} "
            f"[{gain.interval[0]:.4g}, {gain.interval[1]:.4g}]"
            for joint, gain in self.gains.items()
        ]
        left = zip(self.model.row_names, 100 * self.unexplained, strict=True)
        every.append(f"torque error [%]: {', '.join(f'{j} {x:.1f}' for j, x in left)}")
        return "\n".join(every)

    def __repr__(self) -> str:
        every = (f"{p.link} {p.mass:.4g} +- {p.mass_std_error:.2g} kg" for p in self.payloads)
        return f"<PayloadFit of {self.model.name}: {', '.join(every)}>"

    def __getitem__(self, link: str) -> Payload:
        return next(payload for payload in self.payloads if payload.link == link)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as ``robotid payload --json`` prints them."""
        content: dict[str, Any] = {
            "robot": self.model.name,
            "payloads": [payload.to_dict() for payload in self.payloads],
            "mass_checks": [check.to_dict() for check in self.checks.values()],
            "relative_error_pct": dict(
                zip(self.model.row_names, (100 * self.unexplained).tolist(), strict=True)
            ),
        }
        if self.gains:
            rows = zip(self.names, self.base.tolist(), self.base_error.tolist(), strict=True)
            content["gains"] = {
                j: {"gain": g.value, "std_error": g.std_error, "interval": list(g.interval)}
                for j, g in self.gains.items()
            }
            content["base_parameters"] = [
                {"name": name, "value": value, "std_error": error} for name, value, error in rows
            ]
        return content


def payload_of(model: RobotModel, link: str, x: Array, C: Array, freedom: Array) -> Payload:
    """Return a payload from its ten parameters; first-order errors of derived quantities.

    x (10,), C (10, 10), freedom (10,).
    """
    step = 1e-20  # complex-step derivative: exact
    shown = _about_com(x)
    J = np.column_stack([_about_com(x + 1j * step * e).imag / step for e in np.eye(10)])
    errors = np.sqrt(np.maximum(np.diag(J @ C @ J.T), 0.0))
    mass, error, t = float(x[0]), float(np.sqrt(C[0, 0])), float(quantile(freedom[:1])[0])
    com, com_error = shown[:3], errors[:3]
    inertia, inertia_error = _matrix(shown[3:]), _matrix(errors[3:])
    moment, largest = float(np.trace(inertia)) / 3, float(inertia_error.max())
    reasons = {}
    if com_error.max() > _COM * model.length:
        reasons["com"] = (
            f"its standard error of {com_error.max():.2g} m is too large; record poses of {link} "
            "about all axes"
        )
    if largest > _INERTIA * moment:
        reasons["inertia"] = (
            f"{link} rotates too little: an inertia about the centre of mass of about "
            f"{moment:.2g} kg m^2 would have a standard error of {largest:.2g}; record fast motion "
            "of the joints next to it, about all axes"
        )
    if error > 0 and mass < _SIGNIFICANT * error:
        words = f"the payload on {link} does not differ significantly from 0 kg"
        reasons = dict.fromkeys(("com", "inertia"), words)
    return Payload(
        link,
        mass,
        error,
        np.array([mass - t * error, mass + t * error]),
        com.real,
        com_error,
        inertia,
        inertia_error,
        reasons,
    )


def _about_com(x: Array) -> Array:
    """Return centre of mass and inertia about it, xx xy yy xz yz zz, of ten parameters, (9,)."""
    m, mc = x[0], x[1:4]
    steiner = (mc @ mc * np.eye(3) - np.outer(mc, mc)) / m
    i, j = (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)
    return np.concatenate([mc / m, x[4:] - steiner[i, j]])


def _matrix(entries: Array) -> Array:
    """Return the symmetric matrix of xx xy yy xz yz zz, shape (3, 3)."""
    xx, xy, yy, xz, yz, zz = entries.tolist()
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
