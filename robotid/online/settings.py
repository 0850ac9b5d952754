"""How an online identification runs, and what it tells."""

from dataclasses import dataclass

from robotid._typing import Array
from robotid.exceptions import SettingsError

__all__ = ["Change", "OnlineSettings", "Reading"]


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
        threshold: Evidence at which a change is flagged; see ``ChangeDetector``.
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


@dataclass(frozen=True, eq=False)
class Reading:
    """What is known at one moment.

    Attributes:
        t: The moment that it refers to: the newest sample's, less the delay [s].
        theta: Base parameters, shape (b,).
        std_error: Their standard errors, shape (b,).
        sigma: Noise level of each joint, shape (n,) [N m or N].
        excitation: Share of the parameters' prior variance that the motion so far has removed, mean
            over the parameters, 0 to 1.
        converged: Whether the parameters' uncertainty adds less than half a noise level to the
            torque that they predict.
    """

    t: float
    theta: Array
    std_error: Array
    sigma: Array
    excitation: float
    converged: bool


@dataclass(frozen=True, eq=False)
class Change:
    """A step change of the parameters.

    Attributes:
        flagged: When it was flagged, on the clock of the samples [s].
        onset: When it happened, by the evidence [s].
        theta: Base parameters before it, shape (b,).
        covariance: Their covariance, shape (b, b).
    """

    flagged: float
    onset: float
    theta: Array
    covariance: Array
