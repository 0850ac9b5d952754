"""Sets of parameters whose errors are strongly correlated."""

import numpy as np

from robotid.diagnosis.verdict.parameter_table import correlated_sets


def test_sets_are_joined_by_correlations_of_either_sign_and_hold_numbers_of_all_parameters():
    """Of nine parameters 7, 1 and 4 hang together, in two steps, and 2 and 8; 0 is left out."""
    R = np.eye(9)
    for i, k, r in ((7, 1, 0.97), (1, 4, -0.96), (7, 4, -0.94), (2, 8, -0.951), (0, 3, 0.99),
                    (5, 6, 0.949)):  # fmt: skip
        R[i, k] = R[k, i] = r
    size = np.array([1.0, 3.0, 0.2, 10.0, 0.5, 2.0, 7.0, 0.01, 5.0])
    C = R * np.outer(size, size)
    assert correlated_sets(C, [1, 2, 4, 5, 6, 7, 8]) == [[1, 4, 7], [2, 8]]
    assert correlated_sets(C, [8, 7, 4, 2]) == [[8, 2]]
    assert correlated_sets(C, [3, 0, 5]) == [[3, 0]]
    assert correlated_sets(C, [5, 6]) == []


def test_a_parameter_that_joins_two_sets_makes_them_one():
    R = np.eye(5)
    for i, k in ((0, 1), (2, 3), (1, 3)):
        R[i, k] = R[k, i] = 0.96
    assert correlated_sets(R, range(5)) == [[0, 1, 2, 3]]
