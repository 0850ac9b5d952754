import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.dynamics.factors import Factors
from robotid.estimation.estimators import (
    PRX,
    RLS,
    Kalman,
    KalmanState,
    NormalisedGradient,
    RLSState,
    load_state,
    save_state,
)


def test_a_file_that_is_no_state_is_refused(tmp_path):
    with pytest.raises(DataError, match="of the state does not exist"):
        load_state(tmp_path / "none.npz", RLSState)
    (tmp_path / "text.npz").write_text("not a state")
    with pytest.raises(DataError, match=r"text.npz is not a file of a state"):
        load_state(tmp_path / "text.npz", RLSState)
    save_state(RLS(np.ones(2)).init(3), tmp_path / "rls.npz")
    with pytest.raises(DataError, match="contains a state 'RLSState', wanted 'KalmanState'"):
        load_state(tmp_path / "rls.npz", KalmanState)


@pytest.mark.parametrize("estimator", [RLS, Kalman, PRX, NormalisedGradient])
def test_factors_hold_no_samples_and_are_refused(estimator):
    factors = Factors(np.zeros((2, 4, 4)), np.array([9, 9]), np.zeros(2), ("a", "b", "c"))
    sigma, zero = np.ones(2), np.zeros(3)
    fitted = estimator(sigma, zero, np.eye(3)) if estimator is Kalman else estimator(sigma)
    with pytest.raises(DataError, match="factors have none; call fit with the problem"):
        fitted.fit(factors)
