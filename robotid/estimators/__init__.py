"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from robotid.estimators.batch import OLS, TLS, WLS
from robotid.estimators.consistent.constraints import Constraints
from robotid.estimators.consistent.fit import Consistent
from robotid.estimators.consistent.log_cholesky import LogCholesky
from robotid.estimators.estimator import BatchEstimator, Estimate, Estimator
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
