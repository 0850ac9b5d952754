"""The estimators' settings, one table for each."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.settings import Range, Settings, require_kind, setting
from robotid.robot.tree import LARGEST

_NOT_NEGATIVE = Range("x >= 0", lambda x: x >= 0)
_WINDOW = Range("0.05 s or more", lambda x: 0.05 <= x < math.inf)
_FINITE = Range("a positive, finite number", lambda x: 0 < x < math.inf)


@dataclass(frozen=True)
class ConstraintSettings(Settings):
    """Bounds in addition to physical consistency, by name of the link that a joint moves."""

    mass: Mapping[str, Any] = setting(
        {}, "mass, or smallest and largest mass, of a link with all links fixed to it [kg]"
    )
    total_mass: float | Sequence[float] | None = setting(
        None,
        "mass, or smallest and largest mass, of all moving links [kg]",
        reads=(int, float, list),
    )
    com: Mapping[str, Any] = setting(
        {},
        "lower and upper corner [[x, y, z], [x, y, z]] of a box in the link's frame that contains "
        "the centre of mass [m]",
    )
    extent: str = setting(
        "box",
        "constraint on the mass distribution of a link: all mass inside the box of its geometry in "
        "the URDF, or of its frames if it has no geometry, unless the data contradict it; or none",
        among=("box", "none"),
    )
    pinned: Sequence[str] = setting((), "links that keep the URDF's inertial values")

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.masses, self.total, self.boxes

    @property
    def masses(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest mass by link [kg]."""
        return {name: _interval(value, f"mass of {name}") for name, value in self.mass.items()}

    @property
    def total(self) -> tuple[float, float] | None:
        """Smallest and largest mass of all moving links together [kg]."""
        return None if self.total_mass is None else _interval(self.total_mass, "total_mass")

    @property
    def boxes(self) -> dict[str, tuple[list[float], list[float]]]:
        """Lower and upper corner of the box of the centre of mass, by link [m]."""
        return {name: _corners(value, name) for name, value in self.com.items()}


def _interval(value: object, what: str) -> tuple[float, float]:
    """Return the bounds given by a number or by a pair of numbers."""
    pair = [value, value] if _is_number(value) else value
    if not (isinstance(pair, Sequence) and len(pair) == 2 and all(map(_is_number, pair))):
        raise SettingsError(f"{what} is {value!r}, expected a number or [smallest, largest] [kg]")
    low, high = (math.inf if abs(x) > LARGEST else float(x) for x in pair)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SettingsError(
            f"{what} is {value!r}, expected finite numbers of at most {LARGEST:g} kg; write "
            f"{LARGEST:g} for no upper bound"
        )
    if not low <= high:
        raise SettingsError(
            f"{what} is [{low:g}, {high:g}] kg: the first value is larger than the second; write "
            "the smaller one first"
        )
    return low, high


def _corners(value: Any, name: str) -> tuple[list[float], list[float]]:  # noqa: ANN401
    """Return the two corners of a box."""
    try:
        corners = [[float(x) for x in corner] for corner in value]
    except (TypeError, ValueError, OverflowError):
        corners = []
    is_box = [len(corner) for corner in corners] == [3, 3]
    if not is_box or not all(abs(x) <= LARGEST for corner in corners for x in corner):
        raise SettingsError(
            f"com of {name} is {value!r}, expected [[x, y, z], [x, y, z]] [m], each value at most "
            f"{LARGEST:g}"
        )
    low, high = corners
    if any(a > b for a, b in zip(low, high, strict=True)):
        raise SettingsError(
            f"com of {name} is {value!r}: a coordinate of the first corner is larger than of the "
            "second corner; write the corner with the smaller coordinates first"
        )
    return low, high


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


@dataclass(frozen=True, init=False)
class EstimatorSettings(Settings):
    """The estimator and its settings, as ``EstimatorSettings("wls", robust="huber")``.

    The call returns the settings class of that estimator. A setting of another estimator is an
    error.
    """

    name: str = setting("consistent", "name of the estimator")

    def __new__(cls, name: str = "consistent", **options: object) -> "EstimatorSettings":
        require_kind(name, str, "estimator", f"one of {listed(ESTIMATORS)}")
        kind = ESTIMATORS.get(name)
        if cls is not EstimatorSettings:
            return super().__new__(cls)
        if kind is None:
            raise SettingsError(f"estimator is {name!r}, expected one of {listed(ESTIMATORS)}")
        keys = [f.name for f in fields(kind) if f.name != "name"]
        keys.sort(key=lambda key: key not in kind.__annotations__)
        for key in options:
            if key not in keys:
                had = listed(keys)
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

    @property
    def words(self) -> str:
        """Description of the estimator."""
        return self.paths()["name"].text

    @property
    def loss(self) -> str:
        """The robust loss; "none" for squared residuals."""
        return str(getattr(self, "robust", "none"))

    @property
    def is_robust(self) -> bool:
        """Whether rows with large residuals are downweighted."""
        return self.loss != "none"

    @property
    def bounds(self) -> ConstraintSettings:
        """The bounds in addition to physical consistency."""
        return ConstraintSettings(**getattr(self, "constraints", {}))


def _called(name: str, words: str) -> Any:  # noqa: ANN401
    return setting(name, words, among=(name,))


@dataclass(frozen=True, init=False)
class RobustSettings(EstimatorSettings):
    """Settings of estimators that can downweight rows with large residuals."""

    robust: str = setting(
        "none", "loss that downweights rows with large residuals", among=("none", "huber", "tukey")
    )


@dataclass(frozen=True, init=False)
class BoundedSettings(EstimatorSettings):
    """Settings of fits whose result is physically consistent."""

    prior_weight: float | str = setting(
        "auto",
        "weight of the URDF's values [-], or the method that chooses it from the fitted logs: cv "
        "(cross-validation), evidence (marginal likelihood), or auto (cv; 1 if the logs are too "
        "short for cv)",
        among=("auto", "cv", "evidence"),
        within=_FINITE,
    )
    constraints: Mapping[str, Any] = setting(
        {}, "bounds in addition to physical consistency", reads=ConstraintSettings
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        require_kind(self.constraints, Mapping, "constraints", "a table of bounds")
        known = [f.name for f in fields(ConstraintSettings)]
        if strange := [key for key in self.constraints if key not in known]:
            raise SettingsError(
                f"constraints has the key {strange[0]!r}, expected keys of {listed(known)}"
            )
        _ = self.bounds


@dataclass(frozen=True, init=False)
class RecursiveSettings(BoundedSettings):
    """Settings of estimators that read the samples one by one."""

    physical: bool = setting(
        False, "whether the last estimate is projected onto physically consistent parameters"
    )


@dataclass(frozen=True)
class OLSSettings(EstimatorSettings):
    """Settings of ordinary least squares: none, all rows have equal weights."""

    name: str = _called("ols", "ordinary least squares")


@dataclass(frozen=True)
class WLSSettings(RobustSettings):
    """Settings of weighted least squares."""

    name: str = _called("wls", "weighted least squares, rows weighted by the noise of their joint")


@dataclass(frozen=True)
class TLSSettings(EstimatorSettings):
    """Settings of total least squares."""

    name: str = _called("tls", "total least squares, which also models noise of the regressor")
    regressor_noise: float | None = setting(
        None,
        "RMS noise of each regressor column, relative to the RMS of the column [-]; default: "
        "0.01, at most half of the residual's variance",
        within=Range("x > 0", lambda x: x > 0),
    )


@dataclass(frozen=True)
class ConsistentSettings(RobustSettings, BoundedSettings):
    """Settings of the physically consistent fit."""

    name: str = _called(
        "consistent",
        "weighted least squares with physically consistent bodies and the URDF's values as prior",
    )


@dataclass(frozen=True)
class RLSSettings(RecursiveSettings):
    """Settings of recursive least squares."""

    name: str = _called("rls", "recursive least squares, sample by sample")
    forgetting: float = setting(
        1.0,
        "forgetting factor: weight of a sample relative to the next one [-]",
        within=Range("0 < x <= 1", lambda x: 0 < x <= 1),
    )


@dataclass(frozen=True)
class KalmanSettings(RecursiveSettings):
    """Settings of the Kalman filter."""

    name: str = _called("kalman", "a Kalman filter over the samples")
    walk: float = setting(
        0.0,
        "standard deviation of the parameters' random walk per sample, over the prior's [-]",
        within=_NOT_NEGATIVE,
    )
    gate: float | bool = setting(
        1 - 1e-7,
        "innovation gate: probability that a row without a fault passes; false: no gate",
        within=Range(
            "0.5 <= x < 1, or false", lambda x: x is False or (x is not True and 0.5 <= x < 1)
        ),
    )


@dataclass(frozen=True)
class PRXSettings(RecursiveSettings):
    """Settings of the paper's update law."""

    name: str = _called("prx", "gradient steps along PRX (the paper's update), sample by sample")


@dataclass(frozen=True)
class GradientSettings(RecursiveSettings):
    """Settings of normalised gradient steps."""

    name: str = _called("gradient", "normalised gradient steps, sample by sample")


@dataclass(frozen=True)
class SimulationSettings(EstimatorSettings):
    """Settings of closed-loop output error: simulated from commands, fitted to positions."""

    name: str = _called(
        "simulation",
        "closed-loop output error: simulates the controlled robot on the logged commands and "
        "fits it to the logged positions; [controller] has its known parameters",
    )
    window: float | None = setting(
        None, "length of the simulated windows [s]; default 2.5, or 0.5 if the logged torque "
        "drives the robot", within=_WINDOW,
    )  # fmt: skip
    lead: float | None = setting(
        None, "time by which the simulation starts before each window [s]; default 0.6, or 0 if "
        "the logged torque drives the robot", within=_NOT_NEGATIVE,
    )  # fmt: skip
    step: float = setting(
        2e-3,
        "largest step of the integration [s]",
        within=Range("2e-5 to 0.1", lambda x: 2e-5 <= x <= 0.1),
    )
    bodies: float = setting(
        0.1,
        "plausible relative error of the URDF's inertial parameters; 0: they are fixed",
        within=_NOT_NEGATIVE,
    )
    velocities: bool = setting(
        False,
        "whether logged velocities are fitted in addition to the positions; velocities that a "
        "drive computes from its encoder add no information",
    )
    torques: bool = setting(
        True, "whether torques are fitted in addition to the positions, if all logs have them"
    )


ESTIMATORS: Mapping[str, type[EstimatorSettings]] = {  # by name
    kind.name: kind
    for kind in (
        OLSSettings,
        WLSSettings,
        TLSSettings,
        ConsistentSettings,
        RLSSettings,
        KalmanSettings,
        PRXSettings,
        GradientSettings,
        SimulationSettings,
    )
}
