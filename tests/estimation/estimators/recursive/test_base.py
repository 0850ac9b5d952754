import numpy as np
import pytest

from robotid.base.exceptions import DataError
from robotid.estimation.estimators import (
    RLS,
    KalmanState,
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
