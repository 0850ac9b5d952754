"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from robotid.estimators.constraints import Constraints
from robotid.estimators.descent import DescentState
from robotid.estimators.estimator import Estimate, Estimator
from robotid.estimators.gradient import NormalisedGradient
from robotid.estimators.kalman import Kalman, KalmanState
from robotid.estimators.least_squares import OLS, WLS
from robotid.estimators.log_cholesky import LogCholesky
from robotid.estimators.physical import Consistent
from robotid.estimators.prx import PRX
from robotid.estimators.recursive import RecursiveEstimator, fold, load_state, save_state
from robotid.estimators.rls import RLS, RLSState
from robotid.estimators.total_least_squares import TLS

__all__ = [
    "OLS",
    "PRX",
    "RLS",
    "TLS",
    "WLS",
    "Consistent",
    "Constraints",
    "DescentState",
    "Estimate",
    "Estimator",
    "Kalman",
    "KalmanState",
    "LogCholesky",
    "NormalisedGradient",
    "RLSState",
    "RecursiveEstimator",
    "fold",
    "load_state",
    "save_state",
]
