"""Changes of parameters over results in order of time: a sequential test, and its findings.

A step of a parameter after result c is tested by the model

    x_k = mu + delta [k > c] + u_k + e_k,    u_k ~ N(0, s^2),  e_k ~ N(0, std_error_k^2),

the mixed-effects model of runs of one robot with a step. mu and delta have flat priors, log s, too:
without errors e_k this is the t-test, whose level holds for any spread s. At every new result,
steps are tested before the last 1, 2, 4, ... results, parameter by parameter. The j-th tested
result has the share 1 / (j (j + 1)) of the probability of a false alarm. These add up to one: the
probability holds for a history of any length, and a finding never depends on later results.
"""

from dataclasses import dataclass

import numpy as np
import scipy.special

from robotid._typing import Array
from robotid.variation.groups import FEWEST_RUNS
from robotid.variation.mixed_effects import MixedEffects, Prediction, Runs

__all__ = ["FALSE_ALARMS", "Change", "Steps", "changes", "steps_of"]

#: Probability that a history without a change has a finding.
FALSE_ALARMS = 0.02
_CHANGE = 0.05  # plausible standard deviation of a parameter between results, over its size
_GRID = 32  # standard deviations s over which it is integrated
_LEAST, _MOST = 0.05, 30.0  # their range, over the smallest standard error, over the scatter


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps of q parameters at each of the c = k - 1 places between k results.

    Attributes:
        before: Mean of the results before the step, shape (q, c).
        change: Mean of those after it minus ``before``, shape (q, c).
        std_error: Standard error of the change, the spread between results included, shape (q, c).
        probability: Two-sided probability of such a change without a step, shape (q, c).
        evidence: Log likelihood of the step, up to a constant of each parameter, shape (q, c).
    """

    before: Array
    change: Array
    std_error: Array
    probability: Array
    evidence: Array


@dataclass(frozen=True)
class Change:
    """A finding: a parameter has changed.

    Attributes:
        result: Index of the result that raises the finding.
        start: Index of the first result that it is compared with.
        first: Index of the first result after the change, the most likely one.
        parameter: Index of the parameter.
        probability: Probability of such a change without a step, before the tests are counted.
        expected: Prediction of the result ``result`` from ``start`` to those before ``first``.
    """

    result: int
    start: int
    first: int
    parameter: int
    probability: float
    expected: Prediction


def changes(
    values: Array, std_errors: Array, *, false_alarms: float = FALSE_ALARMS
) -> list[Change]:
    """Return the findings of a history; after one, the parameter is compared with its new level.

    Args:
        values: Parameters of k results in order of time, shape (k, q).
        std_errors: Their standard errors, shape (k, q), positive.
        false_alarms: Probability that a history without any change has a finding.

    Returns:
        The findings in the order of time, those of one result with the least probable first.

    References:
        Lai (1995), Sequential changepoint detection in quality control and dynamical systems
        (likelihood ratios in windows). Hawkins, Qiu, Kang (2003), The changepoint model for
        statistical process control (unknown levels and variance).
    """
    q, found = values.shape[1], []
    starts = np.zeros(q, dtype=int)
    for k in range(FEWEST_RUNS, len(values)):
        tested = k + 1 - FEWEST_RUNS
        for start in {int(x) for x in starts if x <= k - FEWEST_RUNS}:
            own = np.flatnonzero(starts == start)
            steps = steps_of(values[start : k + 1, own], std_errors[start : k + 1, own])
            most = k - start - FEWEST_RUNS  # place of the last results, if FEWEST_RUNS are before
            places = [k - start - 2**n for n in range(most.bit_length() + 1) if 2**n <= most + 1]
            level = false_alarms / (tested * (tested + 1) * q * len(places))
            least = steps.probability[:, places].min(axis=1)
            for p in np.flatnonzero(least < level):
                first = start + FEWEST_RUNS + int(steps.evidence[p, FEWEST_RUNS - 1 :].argmax())
                x, errors = (each[:, own[p]] for each in (values, std_errors))
                expected = _expected(x, errors, slice(start, first), k)
                found.append(Change(k, start, first, int(own[p]), float(least[p]), expected))
                starts[own[p]] = first
    return sorted(found, key=lambda each: (each.result, each.probability))


def steps_of(values: Array, std_errors: Array) -> Steps:
    """Return the steps of parameters at every place between their results.

    Args:
        values: The parameters in k results, shape (k, q).
        std_errors: Their standard errors, shape (k, q).
    """
    centre = np.median(values, axis=0)
    x, variance = (values - centre).T[:, None], std_errors.T[:, None] ** 2  # (q, 1, k)
    error = std_errors.min(axis=0)
    low, high = _LEAST * error, _MOST * np.maximum(np.std(values, axis=0), error)
    s = np.exp(np.linspace(np.log(low), np.log(high), _GRID, axis=1))[:, :, None]  # (q, grid, 1)
    w = 1.0 / (s**2 + variance)
    terms = w, w * x, w * x**2
    parts = [  # sums over the results before and after each place; no differences of large numbers
        [np.cumsum(each, axis=2)[:, :, :-1] for each in terms],
        [np.cumsum(each[:, :, ::-1], axis=2)[:, :, -2::-1] for each in terms],
    ]
    means = [S1 / S0 for S0, S1, _ in parts]
    misfit = sum(S2 - S1**2 / S0 for S0, S1, S2 in parts)
    density = 0.5 * (np.log(w).sum(axis=2, keepdims=True) - misfit)
    density = density - 0.5 * sum(np.log(S0) for S0, _, _ in parts)  # (q, grid, c)
    top = density.max(axis=1, keepdims=True)
    weight = np.exp(density - top)
    evidence = top[:, 0] + np.log(weight.sum(axis=1))
    weight /= weight.sum(axis=1, keepdims=True)
    difference, spread = means[1] - means[0], sum(1.0 / S0 for S0, _, _ in parts)
    change = (weight * difference).sum(axis=1)
    return Steps(
        before=centre[:, None] + (weight * means[0]).sum(axis=1),
        change=change,
        std_error=np.sqrt((weight * (spread + (difference - change[:, None]) ** 2)).sum(axis=1)),
        probability=(weight * 2.0 * scipy.special.ndtr(-np.abs(difference) / np.sqrt(spread))).sum(
            axis=1
        ),
        evidence=evidence,
    )


def _expected(x: Array, std_errors: Array, before: slice, k: int) -> Prediction:
    """Return the prediction of a result from those before the change."""
    own, errors = x[before], std_errors[before]
    scale = max(_CHANGE * abs(float(np.median(own))), float(errors.min()))
    H = errors[:, None, None] ** -2.0
    runs = Runs(H, H[:, 0] * own[:, None], np.zeros(len(own), dtype=int), np.array([scale]))
    (expected,) = MixedEffects(runs).predict(std_errors[k : k + 1] ** 2, x[k : k + 1])
    return expected
