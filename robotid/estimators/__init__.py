"""Estimators: Problem or Factors -> Estimate. No physics engine below this folder."""

from robotid.estimators.estimator import Estimate, Estimator
from robotid.estimators.least_squares import OLS, WLS
from robotid.estimators.physical import Consistent

__all__ = ["OLS", "WLS", "Consistent", "Estimate", "Estimator"]
