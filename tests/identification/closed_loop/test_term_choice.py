"""Terms that are offered, and what they gain in windows that they were not fitted to."""

import numpy as np
import pytest

from robotid.identification.closed_loop.further_parameters import _Fold, _gains


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
