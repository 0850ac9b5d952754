"""Effects of temperature and time on drive parameters, taken by their evidence.

Errors of the terms of a drive correlate: an effect on viscous friction that is left out, for its
own evidence is too weak, looks like one on Coulomb friction. A parameter with an effect therefore
has its own model, in which the covariate has effects of any plausible size on the other terms of
the drive; their error is part of that of the effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.exceptions import DataError
from robotid.robot.parameters import Coupling
from robotid.variation.groups import Covariate, RunsOf
from robotid.variation.mixed_effects import MixedEffects, Runs, Slope
from robotid.variation.restricted_likelihood import UNKNOWN

__all__ = [
    "Effect",
    "at_temperature",
    "drive_temperatures",
    "effects_of",
    "model_of",
    "with_effects",
]

_FALSE_EFFECTS = 0.02  # probability that one of all effects is taken where there is none
_FEWEST = 4  # runs: a mean, a slope, and a spread
_POINTS = 9  # covariates at which the interval of the next run is stated
_BEYOND = 0.5  # of their range, beyond each end of it
_OTHERS = 3.0  # standard deviation of an effect on another term of a drive, in plausible sizes


@dataclass(frozen=True, eq=False)
class Effect:
    """A linear effect of a covariate of the runs on a parameter.

    Attributes:
        covariate: The covariate, with its value in each run.
        slope: Change of the parameter per unit of the covariate.
        std_error: Its standard error.
        probability: Two-sided p-value of a slope of 0, before the tests are counted.
        is_used: Whether it is in the model of the parameter.
        intervals: 95 % prediction interval of the next run or unit by covariate: covariate, low and
            high, shape (3, g); none if the effect is not used.
    """

    covariate: Covariate
    slope: float
    std_error: float
    probability: float
    is_used: bool
    intervals: Array

    def interval(self, value: float) -> Array:
        """Return the 95 % prediction interval of the next run, or unit, at a covariate, shape (2,).

        Other covariates have their means.

        Args:
            value: The covariate, in its unit.

        Raises:
            DataError: If the effect is not used, or the value is far outside those of the runs.
        """
        if not self.is_used:
            raise DataError(f"the {self.covariate.name} has no effect on this parameter")
        return _interval(self.covariate.name, self.covariate.unit, self.intervals, value)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        own = self.covariate.values
        found = {
            "unit": self.covariate.unit,
            "slope": self.slope,
            "std_error": self.std_error,
            "p_value": self.probability,
            "is_used": self.is_used,
            "mean": float(own.mean()),
            "by_log": own.tolist(),
        }
        if self.is_used:
            keys = "at", "low", "high"
            rows = zip(keys, self.intervals.tolist(), strict=True)
            found["next_interval_at"] = dict(rows)
        return found


def with_effects(groups: Sequence[RunsOf]) -> list[RunsOf]:
    """Return groups whose drive terms have the effects that the runs support.

    The most significant effect of a drive is added to its model, then the next one is tested.

    Args:
        groups: Information of the runs on each group of parameters.
    """
    n_tests = sum(len(_candidates(group)) for group in groups)
    return [_with_effects(group, _FALSE_EFFECTS / n_tests) if n_tests else group
            for group in groups]  # fmt: skip


def model_of(group: RunsOf, model: MixedEffects, p: int) -> MixedEffects:
    """Return the model of a parameter: that of its group, or one of its own if it has an effect.

    Args:
        group: The group of the parameter, as of ``with_effects``.
        model: Its model, with the effects that are used.
        p: Index of the parameter.
    """
    slopes = group.runs.slopes
    if all(slope.parameter != p for slope in slopes):
        return model
    return MixedEffects(_beside(group, slopes, p), model.deviation)


def effects_of(group: RunsOf, model: MixedEffects, p: int) -> tuple[Effect, ...]:
    """Return the effects on a parameter, used or not.

    Args:
        group: The group of the parameter, as of ``with_effects``.
        model: The model of the parameter, see ``model_of``.
        p: Index of the parameter.
    """
    used, found = group.runs.slopes, []
    for covariate, slope in _candidates(group):
        if slope.parameter != p:
            continue
        places = [s for s, each in enumerate(used) if _is_same(each, slope)]
        if places:
            values = model.slope(places[0])
            intervals = _intervals(model, places[0], covariate, float(group.centre[p]))
        else:
            values = MixedEffects(_beside(group, [*used, slope], p)).slope(len(used))
            intervals = np.zeros((3, 0))
        found.append(Effect(covariate, *values, bool(places), intervals))
    return tuple(found)


def drive_temperatures(
    drives: Sequence[Coupling], temperature: Mapping[str, float]
) -> dict[str, float]:
    """Return the temperature of each drive, the mean of its joints [degC]; none if not known.

    Args:
        drives: The drives.
        temperature: Temperature of the drives of joints, by joint [degC].
    """
    own = {
        drive.name: [temperature[joint] for joint, _ in drive.ratios if joint in temperature]
        for drive in drives
    }
    return {name: float(np.mean(warm)) for name, warm in own.items() if warm}


def at_temperature(
    variation: Mapping[str, Any], temperature: float | Mapping[str, float]
) -> dict[str, Any]:
    """Return the variation of a result.json, its predictions at a temperature.

    Args:
        variation: As in result.json.
        temperature: The temperature [degC], of all drives or by drive. Drives that are left out
            have any temperature of the logs.

    Raises:
        DataError: If it is far outside that of the logs, or temperature has no effect and one of
            all drives is stated.
    """
    moved = dict(variation.get("parameters", {}))
    for name, entry in moved.items():
        own = entry.get("effects", {}).get("temperature", {"is_used": False})
        if not own["is_used"]:
            continue
        if isinstance(temperature, Mapping):
            there = temperature.get(name.rpartition(".")[0])
        else:
            there = temperature
        if there is None:
            continue
        table = own["next_interval_at"]
        intervals = np.array([table[key] for key in ("at", "low", "high")])
        ends = _interval("temperature", own["unit"], intervals, there)
        at_mean = np.array(entry["next_interval"])
        wider = float(np.ptp(ends) / np.ptp(at_mean))
        quantiles = ends.mean() + wider * (np.array(entry["next_quantiles"]) - at_mean.mean())
        change = own["slope"] * (there - own["mean"])
        others = {key: x for key, x in entry["effects"].items() if key != "temperature"}
        moved[name] = entry | {
            "mean": entry["mean"] + change,
            "change": [change, own["std_error"] * abs(there - own["mean"])],
            "next_interval": ends.tolist(),
            "next_quantiles": quantiles.tolist(),
            "effects": others,
        }
        if "seen_interval" in entry:
            room = np.array(entry["seen_interval"]) - _hull(intervals, own["by_log"])
            moved[name]["seen_interval"] = (ends + room).tolist()
    before = variation.get("parameters", {})
    if not isinstance(temperature, Mapping) and all(moved[n] is x for n, x in before.items()):
        raise DataError(
            "temperature has no effect on a drive parameter of this result; leave it out, or "
            "identify from logs at more temperatures, with temperature in [[identification]]"
        )
    return {**variation, "parameters": moved}


def _interval(name: str, unit: str, intervals: Array, value: float) -> Array:
    """Return the interval at a covariate from those in a table, shape (2,)."""
    at, *ends = intervals
    if not at[0] <= value <= at[-1]:
        raise DataError(
            f"{name} is {value:g} {unit}, wanted {at[0]:.4g} to {at[-1]:.4g} {unit}: the range of "
            "the logs, and half of it beyond each end"
        )
    return np.array([np.interp(value, at, end) for end in ends])


def _hull(intervals: Array, values: Sequence[float]) -> Array:
    """Return the ends of the intervals at any of some covariates, shape (2,)."""
    at, low, high = intervals
    return np.array([np.interp(values, at, low).min(), np.interp(values, at, high).max()])


def _candidates(group: RunsOf) -> list[tuple[Covariate, Slope]]:
    """Return the effects that are tested: of covariates that vary, on determined parameters."""
    runs = group.runs
    if len(runs.h) < _FEWEST:
        return []
    known = np.flatnonzero(np.einsum("kpp->p", runs.H[:, : runs.n_varying, : runs.n_varying]) > 0)
    varying = [each for each in group.covariates if np.ptp(each.values) > 0.0]
    return [
        (each, Slope(p, own := each.values - each.values.mean(),
                     float(runs.scale[p]) / float(np.std(own))))
        for p, each in product(known.tolist(), varying)
    ]  # fmt: skip


def _with_effects(group: RunsOf, level: float) -> RunsOf:
    """Return a group with the effects whose p-value is below the level."""
    runs, left = group.runs, [slope for _, slope in _candidates(group)]
    while left:
        used = runs.slopes
        tried = [_beside(group, [*used, slope], slope.parameter) for slope in left]
        p_values = [MixedEffects(each).slope(len(used))[2] for each in tried]
        best = int(np.argmin(p_values))
        if p_values[best] >= level:
            break
        runs = runs.with_slopes([*used, left.pop(best)])
    model = MixedEffects(runs)
    sizes = [model.slope(s)[0] for s in range(len(runs.slopes))]
    return replace(group, runs=runs, slopes=tuple(sizes))


def _beside(group: RunsOf, slopes: Sequence[Slope], p: int) -> Runs:
    """Return the runs of a group with slopes, and those that a parameter is estimated beside.

    Each covariate of the parameter's slopes has slopes of plausible size on the other parameters.

    Args:
        group: The group.
        slopes: The first slopes, without a prior.
        p: Index of the parameter.
    """
    own = [slope.covariate for slope in slopes if slope.parameter == p]
    others = [
        replace(slope, scale=_OTHERS * slope.scale / UNKNOWN) for _, slope in _candidates(group)
        if slope.parameter != p and any(np.array_equal(slope.covariate, c) for c in own)
        and not any(_is_same(slope, each) for each in slopes)
    ]  # fmt: skip
    return group.runs.with_slopes([*slopes, *others])


def _is_same(one: Slope, other: Slope) -> bool:
    """Return whether two slopes are those of one covariate on one parameter."""
    return one.parameter == other.parameter and np.array_equal(one.covariate, other.covariate)


def _intervals(model: MixedEffects, s: int, covariate: Covariate, centre: float) -> Array:
    """Return the prediction interval of the next run by a covariate, shape (3, g)."""
    own = covariate.values
    room = _BEYOND * np.ptp(own)
    at = np.linspace(own.min() - room, own.max() + room, _POINTS)
    slopes, found = model.runs.slopes, []
    for c in at - own.mean():
        values = [c * (k == s) for k in range(len(slopes))]
        found.append(centre + model.predict(at=values)[slopes[s].parameter].ends)
    return np.array([at, *np.transpose(found)])
