"""How an online identification runs."""

from dataclasses import dataclass

from robotid.exceptions import SettingsError

__all__ = ["OnlineSettings"]


@dataclass(frozen=True)
class OnlineSettings:
    """How an online identification runs.

    Attributes:
        rate: Rate of the samples, about [Hz].
        cutoff: Cut-off of the causal filter [Hz].
        order: Order of the filter, even.
        min_velocity: Speed below which a joint's row is left out while Coulomb friction is
            identified [rad/s or m/s].
        warmup: Time of motion that scales the drive terms before the first estimate [s].
        walk: Random walk of the parameters, as a share of their prior spread per square root of a
            second [s^-1/2].
        noise_memory: Time over which the noise level of each joint is averaged [s].
        threshold: Evidence at which a change is flagged; see :class:`ChangeDetector`.
        drift: Squared innovation, in variances, that is no evidence of a change [-].
        model_error: Share of each joint's torque that the model may miss without a change [-].
    """

    rate: float = 200.0
    cutoff: float = 8.0
    order: int = 4
    min_velocity: float = 0.02
    warmup: float = 1.0
    walk: float = 1e-4
    noise_memory: float = 5.0
    threshold: float = 40.0
    drift: float = 4.0
    model_error: float = 0.05

    def __post_init__(self) -> None:
        for key in ("rate", "cutoff", "warmup", "noise_memory", "threshold", "drift"):
            if not getattr(self, key) > 0:
                raise SettingsError(f"{key} is {getattr(self, key)}, wanted a positive number")
        for key in ("min_velocity", "walk", "model_error"):
            if not getattr(self, key) >= 0:
                raise SettingsError(f"{key} is {getattr(self, key)}, wanted 0 or more")
