"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from robotid.estimation.estimators.batch import OLS, TLS, WLS
from robotid.estimation.estimators.consistent_fit import Consistent, Constraints
from robotid.estimation.estimators.estimator import BatchEstimator, Estimate, Estimator
from robotid.estimation.estimators.output_error import OutputError
from robotid.estimation.estimators.recursive import (
    PRX,
    RLS,
    DescentState,
    Kalman,
    KalmanState,
    NormalisedGradient,
    RecursiveEstimator,
    RLSState,
    fold,
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
]
