"""How a log becomes a trajectory: the settings, checked."""

from dataclasses import dataclass

from robotid.exceptions import SettingsError

__all__ = ["SignalSettings"]


@dataclass(frozen=True)
class SignalSettings:
    """How a log becomes a trajectory.

    Attributes:
        rate: Rate of the uniform grid [Hz]; None takes the log's median rate (and, without a
            filter, the rows as they are).
        cutoff: Cut-off of the zero-phase Butterworth filter [Hz]; None for no filter.
        order: Order of the filter, which runs once forward and once backward.
        velocity: "measured", "differentiated" (from the position), or "auto": measured if the log
            has it and it lags the position by less than 20 ms.
        acceleration: "measured", "differentiated" (from the velocity used), or "auto": measured if
            the log has it and its velocity is used.
        trim: Time cut at each end of each uninterrupted stretch [s].
        min_velocity: Joint speed below which its rows are left out while Coulomb friction is
            identified [rad/s or m/s], and within which a drive may stick; 0 keeps all rows.
        friction_band: Speed from which Coulomb friction has its full size [rad/s or m/s]: it
            changes linearly between that speed and its negative; 0: at once, as Coulomb has it.
        max_gap: A longer step between two rows is a gap [s]; None: 2.5 median steps, or a quarter
            of the filter's period if that is longer.
        torque_delay: How late the log has the torque against the position [s]; it is moved back.
        velocity_delay: The same of the measured velocity [s].
    """

    rate: float | None = None
    cutoff: float | None = 8.0
    order: int = 4
    velocity: str = "auto"
    acceleration: str = "auto"
    trim: float = 0.2
    min_velocity: float = 0.02
    friction_band: float = 0.0
    max_gap: float | None = None
    torque_delay: float = 0.0
    velocity_delay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration"):
            value = getattr(self, name)
            if value not in ("auto", "measured", "differentiated"):
                raise SettingsError(
                    f"{name} is {value!r}, wanted 'auto', 'measured' or 'differentiated'"
                )
        for name in ("rate", "cutoff", "max_gap"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise SettingsError(f"{name} is {value}, wanted a positive number")
        for name in ("trim", "min_velocity", "friction_band"):
            value = getattr(self, name)
            if not value >= 0:
                raise SettingsError(f"{name} is {value}, wanted 0 or a positive number")
        for name in ("torque_delay", "velocity_delay"):
            value = getattr(self, name)
            if not abs(value) <= 1:
                raise SettingsError(f"{name} is {value}, wanted seconds between -1 and 1")
        if not 1 <= self.order <= 10:
            raise SettingsError(f"order is {self.order}, wanted 1 to 10")
