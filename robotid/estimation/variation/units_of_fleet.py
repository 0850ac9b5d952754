"""Variation of a parameter between many units (robots), from the estimate of each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special

from robotid.base.typing import Array
from robotid.estimation.variation.groups import FEWEST_RUNS
from robotid.estimation.variation.mixed_effects import MixedEffects, Prediction, Runs

#: Probability that one of all alike units is named.
FALSE_ALARMS = 0.02
_SCALE = 0.1  # smallest plausible standard deviation between units, over the parameter's size
_GRID = 32  # standard deviations between units over which a test is integrated
_LEAST, _MOST = 0.05, 30.0  # their range, over the smallest standard error, over the scatter


@dataclass(frozen=True)
class UnlikeUnit:
    """A unit that differs from the others.

    Attributes:
        unit: Its index.
        probability: Two-sided probability of such a difference, before the tests are counted.
    """

    unit: int
    probability: float


def between_units(
    values: Array, std_errors: Array, level: float
) -> tuple[Prediction, tuple[UnlikeUnit, ...]] | None:
    """Return spread and prediction of the next unit, and the units that differ from the others.

    The unit farthest from the others is tested against them; if it differs, it is left out, and the
    next one is tested. Prediction and spread are of the units that are alike.

    values (u,), std_errors (u,).
    """
    left, unlike = list(range(len(values))), list[UnlikeUnit]()
    while len(left) > FEWEST_RUNS:
        k = _farthest(values[left], std_errors[left])
        order = [*left[:k], *left[k + 1 :], left[k]]
        probability = _probability(values[order], std_errors[order])
        if probability >= level:
            break
        unlike.append(UnlikeUnit(left.pop(k), probability))
    if len(left) < FEWEST_RUNS:
        return None
    own, errors = values[left], std_errors[left]
    scale = max(
        _SCALE * abs(float(np.median(own))), float(np.median(errors)), float(np.std(own, ddof=1))
    )
    H = errors[:, None, None] ** -2.0
    one = np.zeros(len(left), dtype=int)  # a unit has one estimate here: it is the lowest level
    model = MixedEffects(Runs(H, H[:, 0] * own[:, None], one, np.array([scale])))
    return model.predict()[0], _sorted(unlike)


def _probability(values: Array, std_errors: Array) -> float:
    """Return the two-sided probability of the last value without a difference from the others.

    The means of both, and the logarithm of the spread, have flat priors: without standard errors
    this is the t-test, whose level holds for any spread.
    """
    x, error = values - np.median(values), float(std_errors.min())
    low, high = _LEAST * error, _MOST * max(float(np.std(values)), error)
    s = np.exp(np.linspace(np.log(low), np.log(high), _GRID))[:, None]
    w = 1.0 / (s**2 + std_errors**2)  # (grid, u)
    others, own = w[:, :-1], w[:, -1]
    total = others.sum(axis=1)
    mean = others @ x[:-1] / total
    misfit = (others * (x[:-1] - mean[:, None]) ** 2).sum(axis=1)
    density = 0.5 * (np.log(w).sum(axis=1) - misfit - np.log(total) - np.log(own))
    weight = np.exp(density - density.max())
    beyond = 2.0 * scipy.special.ndtr(-np.abs(x[-1] - mean) / np.sqrt(1.0 / total + 1.0 / own))
    return float(weight @ beyond / weight.sum())


def _farthest(values: Array, std_errors: Array) -> int:
    """Return the index of the unit that is farthest from the median, errors counted."""
    away = np.abs(values - np.median(values))
    spread = float(np.median(away))
    return int(np.argmax(away / np.hypot(std_errors, spread)))


def _sorted(unlike: Sequence[UnlikeUnit]) -> tuple[UnlikeUnit, ...]:
    return tuple(sorted(unlike, key=lambda each: each.probability))
