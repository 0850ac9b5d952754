"""Variation of parameters between runs: spreads, the next run, runs that are unlike the others."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.variation.groups import FEWEST_RUNS, RunsOf
from robotid.variation.mixed_effects import UNKNOWN, MixedEffects, Prediction, Runs

__all__ = ["UnlikeRun", "Variation", "VaryingParameter", "changes", "vary"]

_CHANGE = 0.05  # plausible standard deviation of a parameter between results, over its size
_FALSE_ALARMS = 0.02  # probability that one of alike runs is named


@dataclass(frozen=True, eq=False)
class VaryingParameter:
    """A parameter of a drive in several runs.

    Attributes:
        name: Its name, for example "elbow.coulomb".
        unit: Its unit.
        prediction: Mean, spread between runs, and prediction interval of the next run; between
            units and of the next unit, if there are several.
        within: Most probable spread between runs of one unit, if there are several units.
        values: Its value in each run, shape (k,): the run's own and the mean, weighted by their
            information.
        std_errors: Their standard errors, shape (k,).
    """

    name: str
    unit: str
    prediction: Prediction
    values: Array
    std_errors: Array
    within: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        found = self.prediction
        return {
            "unit": self.unit,
            "mean": found.mean,
            "std_error": found.std_error,
            "spread": found.spread,
            "spread_interval": found.spread_ends.tolist(),
            **({} if self.within is None else {"spread_within_units": self.within}),
            "next_interval": found.ends.tolist(),
            "by_log": self.values.tolist(),
            "std_error_by_log": self.std_errors.tolist(),
        }


@dataclass(frozen=True, eq=False)
class UnlikeRun:
    """A run that differs from what the others predict.

    Attributes:
        run: Index of the run.
        kind: "drive", "gain" or "payload".
        where: Drive, joint or link.
        name: The parameter that differs most.
        unit: Its unit.
        value: Its value in this run; of a payload, more than in the other runs.
        std_error: Its standard error.
        ends: 95 % prediction interval from the other runs, shape (2,).
        probability: Probability of such a deviation, before the number of tests is counted.
    """

    run: int
    kind: str
    where: str
    name: str
    unit: str
    value: float
    std_error: float
    ends: Array
    probability: float


@dataclass(frozen=True, eq=False)
class Variation:
    """Variation of the drives' parameters between runs.

    Attributes:
        runs: Names of the k runs.
        units: Number of units (robots).
        parameters: The parameters of the drives.
        unlike: Runs that differ from the others, at most one cause for each.
    """

    runs: tuple[str, ...]
    units: int
    parameters: tuple[VaryingParameter, ...]
    unlike: tuple[UnlikeRun, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        return {
            "logs": list(self.runs),
            "units": self.units,
            "parameters": {each.name: each.to_dict() for each in self.parameters},
            "unlike": [
                asdict(each) | {"run": self.runs[each.run], "ends": each.ends.tolist()}
                for each in self.unlike
            ],
        }


def vary(names: Sequence[str], groups: Sequence[RunsOf]) -> Variation | None:
    """Return the variation between runs, or None for fewer than three runs.

    A run is compared with the prediction of the other runs, group by group. Of the groups that
    differ, the cause named is the one that explains most of the run's residual.

    Args:
        names: Names of the k runs.
        groups: Information of the runs on each group of parameters.
    """
    if len(names) < FEWEST_RUNS or not groups:
        return None
    parameters: list[VaryingParameter] = []
    for group in groups:
        if group.group.kind == "drive":
            parameters += _parameters(group)
    n_tests = sum(group.runs.h.size for group in groups)
    unlike = []
    for run in range(len(names)) if len(names) > FEWEST_RUNS else ():
        found = [each for group in groups for each in _compared(group, run, n_tests)]
        if found:
            unlike.append(max(found, key=lambda each: each[0])[1])
    units = int(groups[0].runs.unit.max()) + 1
    return Variation(tuple(names), units, tuple(parameters), tuple(unlike))


def changes(values: Array, std_errors: Array) -> list[tuple[int, int, Prediction]]:
    """Return the parameters that differ from what earlier results predict.

    From the fourth result on, each is compared with all before it. The probability that one of
    results without any change is named is 2 %.

    Args:
        values: Parameters of k results in order of time, shape (k, q).
        std_errors: Their standard errors, shape (k, q), positive.

    Returns:
        Index of the result, index of the parameter, and its prediction, the least probable first.
    """
    typical = np.abs(np.median(values, axis=0))
    scale = np.maximum(_CHANGE * typical, np.median(std_errors, axis=0))
    n_tests, found = max(len(values) - FEWEST_RUNS, 0) * values.shape[1], []
    for k in range(FEWEST_RUNS, len(values)):
        for p in range(values.shape[1]):
            H = std_errors[:k, p, None, None] ** -2.0
            h = H[:, 0] * values[:k, p, None]
            runs = Runs(H, h, np.zeros(k, dtype=int), scale[p : p + 1])
            (expected,) = MixedEffects(runs).predict(
                std_errors[k, p : p + 1] ** 2, values[k, p : p + 1]
            )
            if expected.probability * n_tests < _FALSE_ALARMS:
                found.append((k, p, expected))
    return sorted(found, key=lambda each: each[2].probability)


def _covariance(H: Array, scale: Array) -> Array:
    """Return the covariance of parameters (q, q) of their information, and almost no prior."""
    covariance: Array = np.linalg.inv(H + np.diag((UNKNOWN * scale) ** -2.0))
    return covariance


def _parameters(group: RunsOf) -> Iterator[VaryingParameter]:
    """Yield the parameters of a group on which the runs have information."""
    model = MixedEffects(group.runs)
    values, errors = model.values
    known = np.einsum("kpp->p", group.runs.H) > 0.0
    for p, prediction in enumerate(model.predict()):
        if known[p]:
            centre = float(group.centre[p])
            yield VaryingParameter(
                group.group.parameters[p],
                group.group.units[p],
                prediction.shifted(centre),
                centre + values[:, p],
                errors[:, p],
                float(model.deviation[0, p]) if model.n_levels == 2 else None,
            )


def _compared(group: RunsOf, run: int, n_tests: int) -> Iterator[tuple[float, UnlikeRun]]:
    """Yield the difference of a run from the others, if there is one, and what it explains.

    A payload is compared only if the run determines it: a run in which the last joints are at rest
    has a large moment and a wrong mass in place of any other effect.
    """
    runs = group.runs
    covariance = _covariance(runs.H[run], runs.scale)
    x, variance = covariance @ runs.h[run], np.diag(covariance)
    if group.group.kind == "payload":
        together = np.diag(_covariance(runs.H.sum(axis=0), runs.scale))
        plausible = runs.scale**2  # what all runs do not determine, no motion does
        if np.any((variance > plausible) & (together <= plausible)):
            return
    expected = MixedEffects(runs.without(run)).predict(variance, x)
    p = int(np.argmin([each.probability for each in expected]))
    if expected[p].probability * n_tests >= _FALSE_ALARMS:
        return
    differs = x - np.array([each.mean for each in expected])
    explained = group.inflation * float(differs @ runs.H[run] @ differs)
    centre = float(group.centre[p])
    if group.group.kind == "payload":  # relative to the other runs
        centre = -expected[p].mean
    yield explained, UnlikeRun(
        run, group.group.kind, group.group.name, group.group.parameters[p], group.group.units[p],
        centre + float(x[p]), float(np.sqrt(variance[p])), centre + expected[p].ends,
        expected[p].probability,
    )  # fmt: skip
