"""Transmissions: conversion of motor columns of a log to joint columns."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import Settings, setting
from robotid.base.typing import Array
from robotid.data.log import repeated

_SINGULAR = 1e-9  # smallest singular value over the largest, for rows of length 1


def _load_matrix(value: Any) -> Any:  # noqa: ANN401
    rows = (tuple(row) if isinstance(row, list) else row for row in value)
    return value if isinstance(value, str) else tuple(rows)


def _dump_matrix(value: Any) -> Any:  # noqa: ANN401
    rows = (list(row) if isinstance(row, tuple) else row for row in value)
    return value if isinstance(value, str) else list(rows)


@dataclass(frozen=True)
class Transmission(Settings):
    """Motors and the joints that they drive.

    With the matrix T, w = T v, q = T^-1 q_m + offset and tau = T^T (efficiency tau_m).
    """

    _table: ClassVar[str] = "transmission"

    joints: tuple[str, ...] = setting(MISSING, "the joints that the motors drive, by name")
    matrix: Any = setting(
        MISSING,
        "angle of each motor per angle of each joint [-, or rad/m], a row per motor; or a list of "
        "gear ratios, if each motor drives one joint; or urdf: the joints' mechanicalReduction",
        reads=(list, str),
        load=_load_matrix,
        dump=_dump_matrix,
    )
    motors: tuple[str, ...] = setting(
        (), "names of the motors in the columns, one per joint; names of the joints if not stated"
    )
    efficiency: tuple[float, ...] = setting(
        (), "efficiency of each motor's gear [-], 1 if not stated"
    )
    offset: tuple[float, ...] = setting(
        (), "positions of the joints at motor position 0 [rad or m]; 0 if not stated"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        count = len(self.joints)
        if not count:
            raise SettingsError("transmission: joints is empty, wanted the names of driven joints")
        for noun in ("joints", "motors"):
            if twice := repeated(getattr(self, noun)):
                raise SettingsError(
                    f"transmission: {noun} contains {listed(twice)} twice; name each once"
                )
        for key in ("motors", "efficiency", "offset"):
            if (given := len(getattr(self, key))) not in (0, count):
                raise SettingsError(
                    f"transmission of {listed(self.joints)}: {key} has {given} entries, wanted "
                    f"{count}, one per joint"
                )
        for motor, share in zip(self.names, self.efficiency, strict=False):
            if not 0 < share <= 1:
                raise SettingsError(
                    f"transmission: efficiency of {motor!r} is {share:g}, wanted more than 0 and "
                    "at most 1"
                )
        if not isinstance(self.matrix, str):
            self._check_matrix()
        elif self.matrix != "urdf":
            raise SettingsError(
                f"transmission: matrix is {self.matrix!r}, wanted rows of numbers, a list of gear "
                "ratios, or 'urdf'"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the motors."""
        return self.motors or self.joints

    @property
    def T(self) -> Array:
        """Speeds of the motors over those of the joints, shape (n, n) [-, or rad/m]."""
        T = np.asarray(self.matrix, dtype=float)
        return np.diag(T) if T.ndim == 1 else T

    @property
    def to_torque(self) -> Array:
        """Matrix from motor torques to joint torques, T^T diag(efficiency), shape (n, n)."""
        matrix: Array = self.T.T * (self.efficiency or 1.0)
        return matrix

    @property
    def shared(self) -> dict[str, tuple[tuple[str, float], ...]]:
        """Ratios of the motors that several joints move, over the largest ratio of the motor.

        The key is the joint whose drive parameters are those of the motor; the value is pairs of
        joint and ratio.
        """
        is_coupled = np.abs(self.T) > 0
        alone = is_coupled.sum(axis=1) == 1
        has_own = is_coupled[alone].any(axis=0)  # joints with a motor of their own
        places = [joint for joint, is_own in zip(self.joints, has_own, strict=True) if not is_own]
        shared = np.flatnonzero(~alone).tolist()
        return {
            place: tuple(
                (self.joints[j], float(self.T[i, j] / self._ratio(i)))
                for j in np.flatnonzero(is_coupled[i])
            )
            for i, place in zip(shared, places, strict=True)
        }

    @property
    def gears(self) -> dict[str, float]:
        """Gear ratio of each joint's drive, its largest ratio [-, or rad/m], by the joint."""
        places = iter(self.shared)
        alone = np.count_nonzero(self.T, axis=1) == 1
        return {
            self.joints[int(np.argmax(np.abs(row)))] if is_own else next(places): self._ratio(i)
            for i, (row, is_own) in enumerate(zip(self.T, alone, strict=True))
        }

    def _ratio(self, i: int) -> float:
        """Return the largest ratio of a motor [-, or rad/m]."""
        return float(self.T[i, np.argmax(np.abs(self.T[i]))])

    def stated(self, reductions: Mapping[str, float]) -> "Transmission":
        """Return the transmission with the gear ratios of the URDF, if its matrix is "urdf"."""
        if self.matrix != "urdf":
            return self
        if missing := [joint for joint in self.joints if joint not in reductions]:
            raise SettingsError(
                f"transmission: matrix is 'urdf', but the URDF has no <transmission> with a "
                f"<mechanicalReduction> only for {listed(missing)}; it has one for "
                f"{listed(reductions) or 'no joint'}. State the gear ratios: matrix = [...]"
            )
        return replace(self, matrix=tuple(reductions[joint] for joint in self.joints))

    def _check_matrix(self) -> None:
        count, shown = len(self.joints), _dump_matrix(self.matrix)
        try:
            T = np.asarray(self.matrix, dtype=float)
        except (TypeError, ValueError):
            T = np.empty(0)
        if T.shape not in ((count,), (count, count)) or not (np.abs(T) <= 1e30).all():
            raise SettingsError(
                f"transmission of {listed(self.joints)}: matrix is {shown}, wanted {count} rows of "
                f"{count} numbers, one row per motor, or {count} gear ratios"
            )
        size = np.linalg.norm(self.T, axis=1, keepdims=True)
        sizes = np.linalg.svd(self.T / np.where(size > 0, size, 1.0), compute_uv=False)
        if not sizes[-1] > _SINGULAR * sizes[0]:
            raise SettingsError(
                f"transmission of {listed(self.joints)}: matrix {shown} is singular, so the motor "
                "positions do not determine the joint positions. Each row is a motor, as "
                "[0, 32, 32] for a motor with a ratio of 32 to each of the last two joints; no row "
                "may be a linear combination of others"
            )


def check_transmissions(
    transmissions: Sequence[Transmission], joints: Sequence[str] | None = None
) -> None:
    """Reject joints and motors that are in several transmissions, and joints that are not read."""
    driven = [joint for gear in transmissions for joint in gear.joints]
    motors = [motor for gear in transmissions for motor in gear.names]
    for noun, names in (("joints", driven), ("motors", motors)):
        if twice := repeated(names):
            raise SettingsError(
                f"several transmissions contain the {noun} {listed(twice)}; write coupled joints "
                "in one transmission, with a row of the matrix per motor"
            )
    if joints is not None and (others := [joint for joint in driven if joint not in joints]):
        raise SettingsError(
            f"transmission: {listed(others)} are not among the joints identified: "
            f"{listed(joints)}. Leave them and their motors out, or identify them"
        )
