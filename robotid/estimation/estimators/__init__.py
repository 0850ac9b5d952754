"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from robotid.estimation.estimators.batch import OLS, TLS, WLS
from robotid.estimation.estimators.consistent.body_constraints import Constraints
from robotid.estimation.estimators.consistent.consistent_fit import Consistent
from robotid.estimation.estimators.estimator import BatchEstimator, Estimate, Estimator

if TYPE_CHECKING:
    from robotid.estimation.estimators.output_error import OutputError
    from robotid.estimation.estimators.recursive.descent import (
        PRX,
        DescentState,
        NormalisedGradient,
    )
    from robotid.estimation.estimators.recursive.filters import RLS, Kalman, KalmanState, RLSState
    from robotid.estimation.estimators.recursive.recursive import (
        RecursiveEstimator,
        fold,
        load_state,
        save_state,
    )

__all__ = [
    "OLS",
    "PRX",
    "RLS",
    "TLS",
    "WLS",
    "BatchEstimator",
    "Consistent",
    "Constraints",
    "DescentState",
    "Estimate",
    "Estimator",
    "Kalman",
    "KalmanState",
    "NormalisedGradient",
    "OutputError",
    "RLSState",
    "RecursiveEstimator",
    "fold",
    "load_state",
    "save_state",
]

_MODULES = {
    "output_error": ["OutputError"],
    "recursive.recursive": ["RecursiveEstimator", "fold", "load_state", "save_state"],
    "recursive.descent": ["PRX", "DescentState", "NormalisedGradient"],
    "recursive.filters": ["RLS", "Kalman", "KalmanState", "RLSState"],
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a rarely used estimator at its first use."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"robotid.estimation.estimators.{module}"), name)
    raise AttributeError(f"module 'robotid.estimation.estimators' has no attribute {name!r}")
