"""Rows of the zeros of the positions: the information of a log about an encoder that slips."""

import numpy as np

from robotid.base.typing import Array
from robotid.dynamics.prediction import body_slopes_by_position
from robotid.estimation.fitting.recorded import Recordings
from robotid.estimation.variation.groups import RunSums, columns_of, groups_at, with_zeros


def sums_with_zeros(
    sums: RunSums, recordings: Recordings, standard: Array, shift: Array
) -> RunSums:
    """Return the sums of logs with those over the rows of the zeros of the positions.

    The torque of a log whose positions are x too large is tau(q - x) = tau(q) - d tau / dq x. Logs
    in files, and robots with a floating base or constraints, have no such rows.

    standard (p,), shift (b,).
    """
    model, mapping = recordings.model, recordings.mapping
    groups = [group for group, _ in groups_at(model, mapping, standard)]
    z = sum(group.kind == "zero" for group in groups)
    if not (z and recordings.is_in_memory):
        return sums
    B, acts = (x[:, :-z] for x in columns_of(groups, model.n_rows))
    theta, runs = mapping.to_base(standard) + shift, []
    for k, log in enumerate(recordings.fitted):
        motion = log.whole.trajectory
        slopes = body_slopes_by_position(model, standard, motion).reshape(-1, z)
        parts, size = [], recordings.segment_length(k) * model.n_rows
        A, start = np.empty((len(slopes), B.shape[1])), 0
        r, scale = np.empty((2, len(slopes)))
        for W, tau, weight in recordings.problem_of(k, motion).blocks():
            rows = slice(start, start + len(tau))
            scale[rows] = np.sqrt(weight) / np.resize(sums.sigma, len(tau))
            A[rows] = scale[rows, None] * (W @ B) * np.resize(acts, (len(tau), acts.shape[1]))
            r[rows] = scale[rows] * (tau - W @ theta)
            start += len(tau)
        for first in range(0, start, size):
            rows = slice(first, first + size)
            parts.append((A[rows], -scale[rows, None] * slopes[rows], r[rows]))
        runs.append(parts)
    return with_zeros(sums, groups, runs)
