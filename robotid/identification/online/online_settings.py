"""Settings and results of an online identification."""

from dataclasses import dataclass

from robotid.base.settings import NOT_NEGATIVE, POSITIVE, Settings, setting
from robotid.base.typing import Array


@dataclass(frozen=True)
class OnlineSettings(Settings):
    """Settings of an online identification."""

    rate: float = setting(200.0, "approximate rate of the samples [Hz]", within=POSITIVE)
    cutoff: float = setting(8.0, "cut-off of the causal filter [Hz]", within=POSITIVE)
    order: int = setting(4, "order of the filter, even")
    min_velocity: float = setting(
        0.02,
        "speed below which a joint's row is not used if Coulomb friction is identified [rad/s]; "
        "for prismatic joints as in ``SignalSettings``",
        within=NOT_NEGATIVE,
    )
    warmup: float = setting(
        1.0,
        "time of motion before the first estimate, which scales the drive terms [s]",
        within=POSITIVE,
    )
    walk: float = setting(
        1e-4,
        "random walk of the parameters, relative to their prior spread, per square root of a "
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
        4.0, "mean squared innovation without a change, in variances [-]", within=POSITIVE
    )
    model_error: float = setting(
        0.05,
        "error of the model without a change, relative to each joint's torque [-]",
        within=NOT_NEGATIVE,
    )


@dataclass(frozen=True, eq=False)
class Reading:
    """The estimate at one time.

    Attributes:
        t: The time of the estimate: that of the newest sample minus the delay [s].
        theta: Base parameters, shape (b,).
        std_error: Their standard errors, shape (b,).
        sigma: Noise level of each joint, shape (n,) [N m or N].
        excitation: Reduction of the parameters' prior variance by the motion so far, mean over the
            parameters, 0 to 1.
        converged: Whether the parameters' uncertainty adds less than half a noise level to the
            predicted torque.
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
        flagged: Time at which it was flagged, on the clock of the samples [s].
        onset: Estimated time of the change [s].
        theta: Base parameters before it, shape (b,).
        covariance: Their covariance, shape (b, b).
    """

    flagged: float
    onset: float
    theta: Array
    covariance: Array
