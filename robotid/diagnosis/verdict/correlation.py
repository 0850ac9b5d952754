"""Strongly correlated parameters: their sum is far better determined than each one."""

from collections.abc import Sequence

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.fitting.fitted import Identified

#: Size of the correlation from which two parameters are strongly correlated: if one were known,
#: the error of the other would be less than a third of what it is, sqrt(1 - r^2) = 0.31.
CORRELATED = 0.95


def _correlations(C: Array, own: Sequence[int]) -> Array:
    """Return the correlations of parameters with each other, 0 of each with itself."""
    error = np.sqrt(np.diag(C)[own])
    R: Array = C[np.ix_(own, own)] / np.outer(error, error) - np.eye(len(own))
    return R


def correlated_sets(C: Array, own: Sequence[int]) -> list[list[int]]:
    """Return the sets of parameters that strong correlations connect: C (p, p)."""
    sets: list[set[int]] = []
    for pair in np.argwhere(np.triu(np.abs(_correlations(C, own)) > CORRELATED, 1)).tolist():
        joined = [s for s in sets if s.intersection(pair)]
        sets = [s for s in sets if s not in joined] + [set(pair).union(*joined)]
    return [[own[k] for k in sorted(s)] for s in sets]


def correlated_parameters(found: Identified) -> dict[int, tuple[int, float]]:
    """Return drive parameters strongly correlated with another parameter of the same drive."""
    layout, C, at_bound = found.model.layout, found.standard_covariance, found.at_bound
    pairs = {}
    for drive in range(len(layout.drives)):
        own = [
            k
            for k, (d, _) in enumerate(layout.drive_parameters, start=layout.n_inertial)
            if d == drive and C[k, k] > 0 and not at_bound[k]
        ]
        for i, row in zip(own, _correlations(C, own), strict=True):
            k = int(np.argmax(np.abs(row)))
            if abs(row[k]) > CORRELATED:
                pairs[i] = own[k], float(row[k])
    return pairs
