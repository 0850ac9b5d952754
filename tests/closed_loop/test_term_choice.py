"""What a term gains in windows that it was not fitted to, beside fits by least squares."""

import numpy as np
import pytest
from helpers.crane import identified_crane

from robotid.closed_loop import term_choice
from robotid.closed_loop.term_choice import _Fold, _folds, _gains
from robotid.estimators.output_error import OutputError, linearised


def test_gains_are_those_of_fits_to_the_other_folds(rng):
    parts = [(rng.standard_normal((rows, 5)), rng.standard_normal(rows)) for rows in (12, 9, 15)]
    folds = [_Fold(A.T @ A, A.T @ b, len(b)) for A, b in parts]
    sets = {7: [1], 9: [4, 3]}
    found = _gains(folds, [0, 2], sets)
    for k, (A, b) in enumerate(parts):
        others = [part for i, part in enumerate(parts) if i != k]
        A_f, b_f = (np.concatenate(x) for x in zip(*others, strict=True))

        def left(columns, A=A, b=b, A_f=A_f, b_f=b_f):
            fitted = np.linalg.lstsq(A_f[:, columns], b_f, rcond=None)[0]
            return np.sum((A[:, columns] @ fitted - b) ** 2)

        for s, own in sets.items():
            assert found[s][k] == pytest.approx(left([0, 2]) - left([0, 2, *own]), rel=1e-9)


def test_folds_share_windows_in_turn_and_count_the_prior_once(tmp_path, monkeypatch):
    monkeypatch.setattr(term_choice, "_FOLDS", 3)
    found = identified_crane(tmp_path)
    simulator, theta = found.fit.simulator, found.estimate.theta + 0.01
    estimator = OutputError()
    folds = _folds(simulator, theta, estimator)
    parts = list(linearised(simulator, estimator.weights(simulator, theta), theta))
    assert len(parts) == len(simulator.windows) > 3
    for k, fold in enumerate(folds):
        H = np.diag(simulator.prior_std**-2.0) / 3
        g = (simulator.prior - theta) / simulator.prior_std**2 / 3
        rows = 0
        for A, b, columns in parts[k::3]:
            wide = np.zeros((len(b), len(theta)))
            wide[:, columns] = A
            H, g, rows = H + wide.T @ wide, g + wide.T @ b, rows + len(b)
        np.testing.assert_allclose(fold.H, H, rtol=1e-9, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(fold.g, g, rtol=1e-9, atol=1e-9 * np.abs(g).max())
        assert fold.rows == rows // 2  # of one joint of two
