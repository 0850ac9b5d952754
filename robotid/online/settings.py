"""How an online identification runs, and what it tells."""

from dataclasses import dataclass

from robotid._settings import NOT_NEGATIVE, POSITIVE, Settings, setting
from robotid._typing import Array

__all__ = ["Change", "OnlineSettings", "Reading"]


@dataclass(frozen=True)
class OnlineSettings(Settings):
    """How an online identification runs."""

    rate: float = setting(200.0, "rate of the samples, about [Hz]", within=POSITIVE)
    cutoff: float = setting(8.0, "cut-off of the causal filter [Hz]", within=POSITIVE)
    order: int = setting(4, "order of the filter, even")
    min_velocity: float = setting(
        0.02,
        "speed below which a joint's row is left out while Coulomb friction is identified "
        "[rad/s]; of a prismatic joint as of ``SignalSettings``",
        within=NOT_NEGATIVE,
    )
    warmup: float = setting(
        1.0,
        "time of motion that scales the drive terms before the first estimate [s]",
        within=POSITIVE,
    )
    walk: float = setting(
        1e-4,
        "random walk of the parameters, as a share of their prior spread per square root of a "
        "second [s^-1/2]",
        within=NOT_NEGATIVE,
    )
    noise_memory: float = setting(
        5.0, "time over which the noise level of each joint is averaged [s]", within=POSITIVE
    )
    threshold: float = setting(
        40.0, "evidence at which a change is flagged; see ``ChangeDetector``", within=POSITIVE
    )
    drift: float = setting(
        4.0,
        "squared innovation, in variances, that is no evidence of a change [-]",
        within=POSITIVE,
    )
    model_error: float = setting(
        0.05,
        "share of each joint's torque that the model may miss without a change [-]",
        within=NOT_NEGATIVE,
    )


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
