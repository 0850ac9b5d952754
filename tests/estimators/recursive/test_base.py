import numpy as np
import pytest

from robotid.estimators import RLS, KalmanState, RLSState, load_state, save_state
from robotid.exceptions import DataError


def test_a_file_that_is_no_state_is_refused(tmp_path):
    with pytest.raises(DataError, match="there is no state"):
        load_state(tmp_path / "none.npz", RLSState)
    (tmp_path / "text.npz").write_text("not a state")
    with pytest.raises(DataError, match=r"text.npz is not a state"):
        load_state(tmp_path / "text.npz", RLSState)
    save_state(RLS(np.ones(2)).init(3), tmp_path / "rls.npz")
    with pytest.raises(DataError, match="holds a state 'RLSState', wanted 'KalmanState'"):
        load_state(tmp_path / "rls.npz", KalmanState)
