"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from robotid.estimators.batch import OLS, TLS, WLS
from robotid.estimators.consistent.constraints import Constraints
from robotid.estimators.consistent.fit import Consistent
from robotid.estimators.estimator import BatchEstimator, Estimate, Estimator

if TYPE_CHECKING:
    from robotid.estimators.consistent.log_cholesky import LogCholesky
    from robotid.estimators.output_error import OutputError
    from robotid.estimators.recursive.base import RecursiveEstimator, fold, load_state, save_state
    from robotid.estimators.recursive.descent import PRX, DescentState, NormalisedGradient
    from robotid.estimators.recursive.filters import RLS, Kalman, KalmanState, RLSState

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
    "LogCholesky",
    "NormalisedGradient",
    "OutputError",
    "RLSState",
    "RecursiveEstimator",
    "fold",
    "load_state",
    "save_state",
]

_MODULES = {
    "consistent.log_cholesky": ["LogCholesky"],
    "output_error": ["OutputError"],
    "recursive.base": ["RecursiveEstimator", "fold", "load_state", "save_state"],
    "recursive.descent": ["PRX", "DescentState", "NormalisedGradient"],
    "recursive.filters": ["RLS", "Kalman", "KalmanState", "RLSState"],
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a rarely used estimator at its first use."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"robotid.estimators.{module}"), name)
    raise AttributeError(f"module 'robotid.estimators' has no attribute {name!r}")
