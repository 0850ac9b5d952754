"""Variation of a parameter between many units (robots), from the estimate of each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.variation.groups import FEWEST_RUNS
from robotid.variation.history import steps_of
from robotid.variation.mixed_effects import MixedEffects, Prediction, Runs

__all__ = ["UnlikeUnit", "between_units"]

_SCALE = 0.1  # smallest plausible standard deviation between units, over the parameter's size


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

    Args:
        values: The parameter of each unit, shape (u,).
        std_errors: Its standard errors, shape (u,), positive.
        level: Probability of a difference without a cause, for each unit, below which it is unlike.

    Returns:
        The prediction, and the units that are unlike, the most unlikely first; None for fewer than
        three units.
    """
    left, unlike = list(range(len(values))), list[UnlikeUnit]()
    while len(left) > FEWEST_RUNS:
        k = _farthest(values[left], std_errors[left])
        order = [*left[:k], *left[k + 1 :], left[k]]
        steps = steps_of(values[order, None], std_errors[order, None])
        probability = float(steps.probability[0, -1])
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


def _farthest(values: Array, std_errors: Array) -> int:
    """Return the index of the unit that is farthest from the median, errors counted."""
    away = np.abs(values - np.median(values))
    spread = float(np.median(away))
    return int(np.argmax(away / np.hypot(std_errors, spread)))


def _sorted(unlike: Sequence[UnlikeUnit]) -> tuple[UnlikeUnit, ...]:
    return tuple(sorted(unlike, key=lambda each: each.probability))
