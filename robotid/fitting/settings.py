"""Which estimator is wanted, with its own settings: one table of settings per estimator."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from robotid._settings import Range, Settings, require_kind, setting
from robotid.exceptions import SettingsError
from robotid.findings import listed

if TYPE_CHECKING:
    from robotid.estimators import BatchEstimator, RecursiveEstimator
    from robotid.fitting.estimators import Known

__all__ = [
    "ESTIMATORS",
    "BoundedSettings",
    "ConsistentSettings",
    "ConstraintSettings",
    "DescentSettings",
    "EstimatorSettings",
    "GradientSettings",
    "KalmanSettings",
    "LogCholeskySettings",
    "OLSSettings",
    "PRXSettings",
    "RLSSettings",
    "RecursiveSettings",
    "SimulationSettings",
    "TLSSettings",
    "WLSSettings",
]

_NOT_NEGATIVE = Range("x >= 0", lambda x: x >= 0)
_COUNT = Range("1 to 10000", lambda x: 1 <= x <= 10_000)
_LARGEST = 1e9  # [kg] or [m] of bounds, as of numbers in a URDF
_WINDOW = Range("0.05 s or more", lambda x: 0.05 <= x < math.inf)
_FINITE = Range("a positive, finite number", lambda x: 0 < x < math.inf)


@dataclass(frozen=True)
class ConstraintSettings(Settings):
    """Bounds beside physical consistency, by name of the link that a joint moves."""

    mass: Mapping[str, Any] = setting(
        {}, "mass, or smallest and largest mass, of a link with all that is fixed to it [kg]"
    )
    total_mass: float | Sequence[float] | None = setting(
        None, "mass, or bounds of it, of all links that move [kg]", reads=(int, float, list)
    )
    com: Mapping[str, Any] = setting(
        {},
        "corners [[x, y, z], [x, y, z]] of a box in the link's frame that holds the centre of mass "
        "[m]",
    )
    com_within: str = setting(
        "none",
        "where the other centres of mass are kept: box or hull of the link's own geometry in the "
        "URDF, where it has one and its meshes are found; or none",
        among=("none", "box", "hull"),
    )
    extent: str = setting(
        "box",
        "where all mass of a link is kept: box of its geometry in the URDF, or of its frames if it "
        "has none, as far as the data do not clearly contradict it; or none",
        among=("box", "none"),
    )
    pinned: Sequence[str] = setting((), "links that keep the URDF's values")

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.masses, self.total, self.boxes

    @property
    def masses(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest mass by link [kg]."""
        return {name: _interval(value, f"mass of {name}") for name, value in self.mass.items()}

    @property
    def total(self) -> tuple[float, float] | None:
        """Smallest and largest mass of all links that move [kg]."""
        return None if self.total_mass is None else _interval(self.total_mass, "total_mass")

    @property
    def boxes(self) -> dict[str, tuple[list[float], list[float]]]:
        """Lower and upper corner of the box of the centre of mass by link [m]."""
        return {name: _corners(value, name) for name, value in self.com.items()}


def _interval(value: object, what: str) -> tuple[float, float]:
    """Return the bounds that a number, or a pair of them, states."""
    pair = [value, value] if _is_number(value) else value
    if not (isinstance(pair, Sequence) and len(pair) == 2 and all(map(_is_number, pair))):
        raise SettingsError(f"{what} is {value!r}, wanted a number or [smallest, largest] [kg]")
    low, high = (math.inf if abs(x) > _LARGEST else float(x) for x in pair)
    found = f"{what} is [{low:g}, {high:g}] kg"
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SettingsError(
            f"{what} is {value!r}, wanted finite numbers of at most {_LARGEST:g} kg; write "
            f"{_LARGEST:g} for no upper bound"
        )
    if not low <= high:
        raise SettingsError(f"{found}: the first is above the second; write the smaller one first")
    return low, high


def _corners(value: Any, name: str) -> tuple[list[float], list[float]]:  # noqa: ANN401
    """Return the two corners of a box."""
    try:
        corners = [[float(x) for x in corner] for corner in value]
    except (TypeError, ValueError, OverflowError):
        corners = []
    is_box = [len(corner) for corner in corners] == [3, 3]
    if not is_box or not all(abs(x) <= _LARGEST for corner in corners for x in corner):
        raise SettingsError(
            f"com of {name} is {value!r}, wanted [[x, y, z], [x, y, z]] [m], at most "
            f"{_LARGEST:g} each"
        )
    low, high = corners
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise SettingsError(
            f"com of {name} is {value!r}: the first corner is above the second; write the smaller "
            "coordinates first"
        )
    return low, high


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, init=False)
class EstimatorSettings(Settings):
    """Which estimator, and its own settings, as ``EstimatorSettings("wls", robust="huber")``.

    It makes the settings of that estimator; a setting of another one is refused.

    Attributes:
        weighs_alike: Whether rows weigh alike, whatever the noise of their joints is.
        allows_for_noise: Whether it allows for the noise of the regressor by itself.
    """

    weighs_alike: ClassVar[bool] = False
    allows_for_noise: ClassVar[bool] = False

    name: str = setting("consistent", "which estimator")

    def __new__(cls, name: str = "consistent", **options: object) -> "EstimatorSettings":
        require_kind(name, str, "estimator", f"one of {listed(ESTIMATORS)}")
        kind = ESTIMATORS.get(name)
        if cls is not EstimatorSettings:
            return super().__new__(cls)
        if kind is None:
            raise SettingsError(f"estimator is {name!r}, wanted one of {listed(ESTIMATORS)}")
        own = [f.name for f in fields(kind) if f.name != "name"]
        own.sort(key=lambda key: key not in kind.__annotations__)
        for key in options:
            if key not in own:
                had = listed(own)
                raise SettingsError(f"estimator {name!r} has no setting {key!r}; it has {had}")
        return super().__new__(kind)

    @classmethod
    def schema(cls) -> dict[str, Any]:
        kinds = ESTIMATORS.values() if cls is EstimatorSettings else [cls]
        schemas = [super(EstimatorSettings, kind).schema() for kind in kinds]
        return {key: value for schema in schemas for key, value in schema.items()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Self:
        return cls(**table)

    def make(self, known: "Known") -> "BatchEstimator | RecursiveEstimator[Any]":
        """Return the estimator that reads rows or samples.

        Args:
            known: The robot, and what is known of it before the data.

        Raises:
            SettingsError: If constraints contradict each other or do not fit the robot, or the
                estimator reads a simulator.
        """
        raise SettingsError(f"{self!r} describes no estimator; take EstimatorSettings(name)")

    @property
    def words(self) -> str:
        """What the estimator is."""
        return self.paths()["name"].text

    @property
    def loss(self) -> str:
        """The loss of rows that fit badly, "none" if they count as the others."""
        return str(getattr(self, "robust", "none"))

    @property
    def is_robust(self) -> bool:
        """Whether rows that fit badly count less."""
        return self.loss != "none"

    @property
    def bounds(self) -> ConstraintSettings:
        """The bounds beside physical consistency."""
        return ConstraintSettings(**getattr(self, "constraints", {}))


def _called(name: str, words: str) -> Any:  # noqa: ANN401
    return setting(name, words, among=(name,))


@dataclass(frozen=True, init=False)
class RobustSettings(EstimatorSettings):
    """Settings of estimators that can count rows less that fit badly."""

    robust: str = setting("none", "loss of rows that fit badly", among=("none", "huber", "tukey"))


@dataclass(frozen=True, init=False)
class BoundedSettings(EstimatorSettings):
    """Settings of fits that are kept, or made, physically possible."""

    margin: float = setting(
        1e-4,
        "smallest eigenvalue of a body's pseudo-inertia relative to its prior size [-]",
        within=_FINITE,
    )
    prior: str = setting(
        "entropic",
        "metric of the distance from the URDF's values",
        among=("entropic", "euclidean", "riemannian"),
    )
    prior_weight: float | str = setting(
        "auto",
        "weight of the URDF's values [-], or how it is chosen from the fitted logs: cv "
        "(segments held out in turn), evidence, or auto (cv, or 1 for a log too short to be cut)",
        among=("auto", "cv", "evidence"),
        within=_FINITE,
    )
    solver: str = setting(
        "clarabel", "cone solver, of priors that are not entropic", among=("clarabel", "scs")
    )
    check: bool = setting(False, "whether the other solver solves it, too")
    draws: int = setting(
        64,
        "fits to redrawn data and prior that tell the standard errors where bounds bind; 0 leaves "
        "the bounds out of them",
        within=Range("0, or 10 to 10000", lambda x: x == 0 or 10 <= x <= 10_000),
    )
    constraints: Mapping[str, Any] = setting(
        {}, "bounds beside physical consistency", reads=ConstraintSettings
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind(self.constraints, Mapping, "constraints", "a table of bounds")
        known = [each.name for each in fields(ConstraintSettings)]
        if strange := [key for key in self.constraints if key not in known]:
            raise SettingsError(f"constraints has {strange[0]!r}, wanted some of {listed(known)}")
        _ = self.bounds


@dataclass(frozen=True, init=False)
class RecursiveSettings(BoundedSettings):
    """Settings of estimators that take the samples one by one."""

    physical: bool = setting(False, "whether the last estimate is made physically possible")


@dataclass(frozen=True, init=False)
class DescentSettings(RecursiveSettings):
    """Settings of estimators that step along a gradient, and end beside least squares."""

    average: bool = setting(True, "whether the iterates are averaged")
    passes: int = setting(4, "largest number of passes over the logs", within=_COUNT)
    seed: int = setting(0, "seed of the order of the samples; negative: that of time")

    @property
    def _common(self) -> dict[str, Any]:
        """Return the arguments that these estimators share."""
        rng = np.random.default_rng(self.seed) if self.seed >= 0 else None
        return {"average": self.average, "passes": self.passes, "rng": rng}


@dataclass(frozen=True)
class OLSSettings(EstimatorSettings):
    """Nothing but least squares."""

    weighs_alike: ClassVar[bool] = True

    name: str = _called("ols", "ordinary least squares")

    def make(self, known: "Known") -> "BatchEstimator":
        from robotid.estimators import OLS

        return OLS(independent_share=known.share)


@dataclass(frozen=True)
class WLSSettings(RobustSettings):
    """Settings of weighted least squares."""

    name: str = _called("wls", "weighted least squares, rows weighted by the noise of their joint")

    def make(self, known: "Known") -> "BatchEstimator":
        from robotid.estimators import WLS

        return WLS(independent_share=known.share)


@dataclass(frozen=True)
class TLSSettings(EstimatorSettings):
    """Settings of total least squares."""

    allows_for_noise: ClassVar[bool] = True

    name: str = _called("tls", "total least squares, which allows for noise of the regressor, too")
    regressor_noise: float = setting(
        0.01,
        "noise of the regressor's columns over their root mean square [-]",
        within=Range("x > 0", lambda x: x > 0),
    )

    def make(self, known: "Known") -> "BatchEstimator":
        from robotid.estimators import TLS

        return TLS(self.regressor_noise, independent_share=known.share)


@dataclass(frozen=True)
class ConsistentSettings(RobustSettings, BoundedSettings):
    """Settings of the physically consistent fit."""

    name: str = _called(
        "consistent",
        "weighted least squares that keeps every body physically possible and leaves the URDF's "
        "value where the data say nothing",
    )

    def make(self, known: "Known") -> "BatchEstimator":
        from robotid.fitting.estimators import consistent_fit

        return consistent_fit(self, known)


@dataclass(frozen=True)
class LogCholeskySettings(ConsistentSettings):
    """Settings of the same fit in smooth coordinates."""

    name: str = _called(
        "log_cholesky", "the consistent fit without a cone, in log-Cholesky parameters"
    )
    starts: int = setting(
        0,
        "random starts beside the one from the cone programme",
        within=Range("0 to 1000", lambda x: 0 <= x <= 1000),
    )
    seed: int = setting(0, "seed of the random starts", within=_NOT_NEGATIVE)

    def make(self, known: "Known") -> "BatchEstimator":
        from robotid.estimators import LogCholesky
        from robotid.fitting.estimators import consistent_fit

        rng = np.random.default_rng(self.seed)
        return LogCholesky(consistent_fit(self, known), starts=self.starts, rng=rng)


@dataclass(frozen=True)
class RLSSettings(RecursiveSettings):
    """Settings of recursive least squares."""

    name: str = _called("rls", "recursive least squares, sample by sample")
    forgetting: float = setting(
        1.0,
        "weight of a sample relative to the next one [-]",
        within=Range("0 < x <= 1", lambda x: 0 < x <= 1),
    )

    def make(self, known: "Known") -> "RecursiveEstimator[Any]":
        from robotid.estimators import RLS

        # without forgetting nothing of the prior enters: batch least squares
        std = np.sqrt(np.diag(known.covariance)) if self.forgetting < 1 else None
        return RLS(known.sigma, self.forgetting, known.beta, std, known.share)


@dataclass(frozen=True)
class KalmanSettings(RecursiveSettings):
    """Settings of the Kalman filter."""

    name: str = _called("kalman", "a Kalman filter over the samples")
    walk: float = setting(
        0.0, "random walk per sample, as a share of the prior's spread [-]", within=_NOT_NEGATIVE
    )
    gate: float | bool = setting(
        1 - 1e-7,
        "probability with which a good row passes; false for no gate",
        within=Range(
            "0.5 <= x < 1, or false", lambda x: x is False or (x is not True and 0.5 <= x < 1)
        ),
    )

    def make(self, known: "Known") -> "RecursiveEstimator[Any]":
        from robotid.estimators import Kalman

        gate = None if self.gate is False else float(self.gate)
        return Kalman(known.sigma, known.beta, known.covariance, self.walk, gate, known.share)


@dataclass(frozen=True)
class PRXSettings(DescentSettings):
    """Settings of the paper's update."""

    name: str = _called("prx", "steps along the gradient PRX, sample by sample")
    step: str = setting("exact", "length of the step", among=("exact", "printed"))
    metric: str = setting(
        "noise", "what measures the residual of the exact step", among=("noise", "mass", "rows")
    )

    def make(self, known: "Known") -> "RecursiveEstimator[Any]":
        from robotid.estimators import PRX

        own = {"step": self.step, "metric": self.metric, **self._common}
        return PRX(known.sigma, known.beta, **own)


@dataclass(frozen=True)
class GradientSettings(DescentSettings):
    """Settings of normalised gradient steps."""

    name: str = _called("gradient", "normalised gradient steps, sample by sample")
    step_size: float = setting(
        1.0, "relaxation [-]", within=Range("0 < x < 2", lambda x: 0 < x < 2)
    )

    def make(self, known: "Known") -> "RecursiveEstimator[Any]":
        from robotid.estimators import NormalisedGradient

        own = {"step_size": self.step_size, **self._common}
        return NormalisedGradient(known.sigma, known.beta, **own)


@dataclass(frozen=True)
class SimulationSettings(EstimatorSettings):
    """Output error: closed loops are simulated on the commands, and fitted to the positions."""

    name: str = _called(
        "simulation",
        "closed loops simulated on the commands of logs and fitted to their positions; "
        "[controller] says what is known of the loops",
    )
    window: float | None = setting(
        None, "length of the windows that are simulated [s]; if not stated 2.5, or 0.5 where the "
        "logged torque drives the robot", within=_WINDOW,
    )  # fmt: skip
    lead: float | None = setting(
        None, "how long before each window its roll-out begins [s]; if not stated 0.6, or 0 where "
        "the logged torque drives the robot", within=_NOT_NEGATIVE,
    )  # fmt: skip
    step: float = setting(
        2e-3,
        "longest step of the integration [s]",
        within=Range("2e-5 to 0.1", lambda x: 2e-5 <= x <= 0.1),
    )
    bodies: float = setting(
        0.1,
        "plausible relative error of the URDF's bodies, by which they may change; 0: they stay",
        within=_NOT_NEGATIVE,
    )
    error: str = setting(
        "output",
        "what is compared: output, the positions (closed-loop output error, CLOE); input, the "
        "torques of the loops, simulated, with those logged (closed-loop input error, CLIE); "
        "direct, the same with derivatives that neglect that the motion changes, which are those "
        "of inverse dynamics (DIDIM; gains and delay must be stated)",
        among=("output", "input", "direct"),
    )
    velocities: bool = setting(
        False,
        "whether logged velocities weigh beside the positions; those that a drive differentiates "
        "from its encoder tell nothing more",
    )
    torques: bool = setting(
        True, "whether torques weigh beside the positions, where all logs have them"
    )
    whiten: bool = setting(
        True, "whether the correlation of the residuals is estimated and taken out"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.error == "output":
            return
        compared = f"estimator: error = {self.error!r} compares torques"
        if not self.torques:
            raise SettingsError(
                f"{compared}, but torques is false; leave it out, or set error = 'output'"
            )
        if self.velocities:
            raise SettingsError(
                f"{compared}, but velocities is true; leave it out, or set error = 'output'"
            )


#: The settings of each estimator, by its name.
ESTIMATORS: Mapping[str, type[EstimatorSettings]] = {
    kind.name: kind
    for kind in (
        OLSSettings,
        WLSSettings,
        TLSSettings,
        ConsistentSettings,
        LogCholeskySettings,
        RLSSettings,
        KalmanSettings,
        PRXSettings,
        GradientSettings,
        SimulationSettings,
    )
}
