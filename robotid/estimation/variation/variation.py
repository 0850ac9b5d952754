"""Variation of parameters between runs: spreads, the next run, runs that are unlike the others."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.special

from robotid.base.typing import Array
from robotid.estimation.variation.groups import FEWEST_RUNS, RunsOf
from robotid.estimation.variation.spread import (
    Compared,
    Mixture,
    Prediction,
    Runs,
    SpreadModel,
    covariance_of,
)

SCORES = np.linspace(-3.5, 3.5, 15)  # of the quantiles in result.json
FALSE_ALARMS = 0.02  # probability that one of alike runs or units is named
_LEAST_SHRUNK = 1e-3  # smallest share of the shrinkage: the correlation has an inverse
PLAUSIBLE = 0.1  # standard deviation between units or logs over the value, before the data
_SPREADS = 32  # standard deviations between units over which a test is integrated
_RANGE = 0.05, 30.0  # their range, over the smallest standard error, over the scatter


@dataclass(frozen=True, eq=False)
class VaryingParameter:
    """A parameter of a drive in several runs."""

    name: str  # its name, for example "elbow.coulomb"
    unit: str  # its unit
    prediction: Prediction  # of the next run, or of the next unit if there are several
    values: Array  # (k,), in each run: the run's own and the mean, weighted by their information
    std_errors: Array  # (k,), their standard errors

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        p = self.prediction
        return {
            "unit": self.unit,
            "mean": p.mean,
            "std_error": p.std_error,
            "spread": p.spread,
            "spread_interval": p.spread_ends.tolist(),
            **({} if p.within is None else {"spread_within_units": p.within}),
            "next_interval": p.ends.tolist(),
            "next_quantiles": p.mixture.quantiles(scipy.special.ndtr(SCORES)).tolist(),
            "one_more": {"std_error": p.after[0], "interval_width": p.after[1]},
            "by_log": self.values.tolist(),
            "std_error_by_log": self.std_errors.tolist(),
        }


@dataclass(frozen=True, eq=False)
class UnlikeRun:
    """A run, or a unit, that differs from what the others predict."""

    run: int  # index of the run, or of the unit
    kind: str  # "drive", "gain", "payload" or "zero"
    where: str  # drive, joint or link
    name: str  # the parameter that differs most
    unit: str  # its unit
    value: float  # its value in this run; of a payload and a zero, more than in the other runs
    std_error: float  # its standard error
    ends: Array  # (2,), 95 % prediction interval from the other runs
    probability: float  # probability of such a deviation, before the number of tests is counted

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        return asdict(self) | {"run": names[self.run], "ends": self.ends.tolist()}


@dataclass(frozen=True, eq=False)
class Variation:
    """Variation of the drives' parameters between runs."""

    runs: tuple[str, ...]  # names of the k runs
    units: int  # number of units (robots)
    parameters: tuple[VaryingParameter, ...]  # the parameters of the drives, m items
    unlike: tuple[UnlikeRun, ...]  # runs that differ from the others, at most one cause for each
    unit_names: tuple[str, ...] = ()  # names of the units, in the order of their indices
    unlike_units: tuple[UnlikeRun, ...] = ()  # one cause for each; their runs are not in ``unlike``
    of_runs: tuple[int, ...] = ()  # index of the unit of each run, k items

    @cached_property
    def correlation(self) -> Array:
        """Correlation of the parameters between runs, or units if there are several, (m, m)."""
        values = np.array([x.values for x in self.parameters]).reshape(-1, len(self.runs))
        if self.units > 1:
            unit = np.array(self.of_runs)
            values = np.stack([values[:, unit == u].mean(axis=1) for u in range(self.units)], 1)
        return shrunk_correlation(values.T)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        content: dict[str, Any] = {
            "logs": list(self.runs),
            "units": self.units,
            "parameters": {x.name: x.to_dict() for x in self.parameters},
            "correlation": self.correlation.tolist(),
            "unlike": [run.to_dict(self.runs) for run in self.unlike],
        }
        if self.units > 1:
            content["unlike_units"] = [x.to_dict(self.unit_names) for x in self.unlike_units]
        return content


def vary(
    names: Sequence[str], groups: Sequence[RunsOf], units: Sequence[str] = ()
) -> Variation | None:
    """Return the variation between runs, or None for fewer than three runs.

    A run is compared with the prediction of the other runs, a unit with that of the other units,
    group by group. The cause named is the group that differs most.
    """
    if len(names) < FEWEST_RUNS or not groups:
        return None
    pairs = [(group, SpreadModel(group.runs)) for group in groups]
    unit = groups[0].runs.unit
    n_units, n_runs = int(unit.max()) + 1, len(names)
    units_tested = np.arange(n_units if n_units > FEWEST_RUNS else 0)
    runs_tested = np.arange(n_runs if n_runs > FEWEST_RUNS else 0)
    size = sum(len(group.runs.scale) for group in groups)
    n_tests = size * (len(units_tested) + len(runs_tested))
    unlike_units = _unlike(pairs, units_tested, n_tests, is_unit=True)
    is_alike = ~np.isin(unit[runs_tested], [odd.run for odd in unlike_units])
    drives = [pair for pair in pairs if pair[0].group.kind == "drive"]
    return Variation(
        runs=tuple(names), units=n_units, of_runs=tuple(unit.tolist()),
        parameters=tuple(x for group, model in drives for x in _parameters(group, model)),
        unlike=tuple(_unlike(pairs, runs_tested[is_alike], n_tests, is_unit=False)),
        unit_names=tuple(units) or tuple(map(str, range(n_units))),
        unlike_units=tuple(unlike_units),
    )  # fmt: skip


def between_covariance(variation: Mapping[str, Any], names: Sequence[str]) -> Array:
    """Return what the next run adds to the covariance (p, p), by medians of the spreads."""
    covariance = np.zeros((len(names), len(names)))
    known = [(k, name) for k, name in enumerate(variation["parameters"]) if name in names]
    varying, places = [k for k, _ in known], [list(names).index(name) for _, name in known]
    spreads = [variation["parameters"][name] for _, name in known]
    std = np.array([np.hypot(x["spread"], x.get("spread_within_units", 0.0)) for x in spreads])
    R = np.array(variation["correlation"])[np.ix_(varying, varying)]
    covariance[np.ix_(places, places)] = std[:, None] * R * std
    return covariance


def shrunk_correlation(values: Array) -> Array:
    """Return the correlation of parameters (k, m), shrunk to 0 by its own uncertainty.

    r*_ij = a_i a_j r_ij with a_i^2 = 1 - sum Var(r_ij) / sum r_ij^2 over j != i, within [0, 1], is
    positive definite (Schur). Var(r) is that of normal values, (1 - r^2)^2 / (k - 1) (Hotelling,
    1953), times (k^2 - 1) / (k^2 - 2 k): its mean is right for independent parameters. Two runs
    determine none. Schaefer, Strimmer (2005), A shrinkage approach to large-scale covariance matrix
    estimation, doi:10.2202/1544-6115.1175, section 2.4 (target D), there with one factor.
    """
    k, m = values.shape
    if k < FEWEST_RUNS:
        return np.eye(m)
    std = values.std(axis=0, ddof=1)
    varies = std > 0.0
    z = (values - values.mean(axis=0)) / np.where(varies, std, 1.0)
    r = z.T @ z / (k - 1)
    off = ~np.eye(m, dtype=bool)
    size = np.sum(r**2, axis=1, where=off & varies)
    variance = np.sum((1.0 - r**2) ** 2, axis=1, where=off & varies) * (k + 1) / (k * (k - 2))
    share = np.divide(variance, size, out=np.ones(m), where=size > 0.0)
    left = np.sqrt(1.0 - np.clip(share, _LEAST_SHRUNK, 1.0))
    return np.where(off, left[:, None] * r * left, 1.0)


def between_units(
    values: Array, std_errors: Array, level: float
) -> tuple[Prediction, tuple[tuple[int, float], ...]] | None:
    """Return spread and prediction of the next unit, and the units that differ from the others.

    The unit farthest from the others (u,) is tested against them; if it differs, it is left out,
    and the next one is tested. Units that differ come with the two-sided probability of that.
    """
    left, unlike = np.arange(len(values)), list[tuple[int, float]]()
    while len(left) > FEWEST_RUNS:
        away = np.abs(values[left] - np.median(values[left]))
        k = int(np.argmax(away / np.hypot(std_errors[left], np.median(away))))
        order = [*np.delete(left, k), left[k]]
        probability = _probability_of_last(values[order], std_errors[order])
        if probability >= level:
            break
        unlike.append((int(left[k]), probability))
        left = np.delete(left, k)
    if len(left) < FEWEST_RUNS:
        return None
    x, errors = values[left], std_errors[left]
    scale = max(PLAUSIBLE * abs(np.median(x)), np.median(errors), np.std(x, ddof=1))
    H = errors[:, None, None] ** -2.0
    one = np.zeros(len(left), dtype=int)  # a unit has one estimate here: it is the lowest level
    model = SpreadModel(Runs(H, H[:, 0] * x[:, None], one, np.array([scale])))
    return next(model.predict()), tuple(sorted(unlike, key=lambda pair: pair[1]))


def _probability_of_last(values: Array, std_errors: Array) -> float:
    """Return the two-sided probability of the last value without a difference from the others.

    Means and the logarithm of the spread have flat priors: without standard errors, the t-test.
    """
    x, error = values - np.median(values), float(std_errors.min())
    low, high = (k * max(size, error) for k, size in zip(_RANGE, (0.0, np.std(x)), strict=True))
    s = np.geomspace(low, high, _SPREADS)[:, None]
    w = 1.0 / (s**2 + std_errors**2)  # (grid, u)
    others, last = w[:, :-1], w[:, -1]
    total = others.sum(axis=1)
    mean = others @ x[:-1] / total
    misfit = (others * (x[:-1] - mean[:, None]) ** 2).sum(axis=1)
    density = 0.5 * (np.log(w).sum(axis=1) - misfit - np.log(total) - np.log(last))
    weight = np.exp(density - density.max())
    mixture = Mixture(weight / weight.sum(), mean, np.sqrt(1.0 / total + 1.0 / last))
    return float(mixture.weight @ (2.0 * scipy.special.ndtr(-np.abs(x[-1] - mean) / mixture.std)))


def _parameters(group: RunsOf, model: SpreadModel) -> Iterator[VaryingParameter]:
    """Yield the parameters of a group on which the runs have information."""
    is_known, (values, errors) = np.einsum("kpp->p", group.runs.H) > 0.0, model.values
    names, units, centres = group.group.parameters, group.group.units, group.centre.tolist()
    for p, prediction in enumerate(model.predict()):
        if is_known[p]:
            moved, x = prediction.shifted(centres[p]), centres[p] + values[:, p]
            yield VaryingParameter(names[p], units[p], moved, x, errors[:, p])


def _unlike(
    pairs: Sequence[tuple[RunsOf, SpreadModel]], which: Array, n_tests: int, *, is_unit: bool
) -> list[UnlikeRun]:
    """Return the runs or units that differ from the others, in order."""
    if not len(which):
        return []
    groups = [group for group, _ in pairs]
    compared = [model.against_others(which, is_unit=is_unit) for _, model in pairs]
    p_values = [  # (m, q) of each group
        np.where(_is_compared(group, which, is_unit=is_unit)[:, None],
                 c.mixture.beyond(c.values), np.inf)
        for group, c in zip(groups, compared, strict=True)
    ]  # fmt: skip
    probability = np.array([p.min(axis=1) for p in p_values])  # (groups, m)
    noise = float(np.median([group.inflation for group in groups]))  # of a typical group
    unlike = []
    for k in np.flatnonzero(probability.min(axis=0) * n_tests < FALSE_ALARMS).tolist():
        evidence = [
            _explained(c, k, noise / group.inflation, is_drive=group.group.kind == "drive")
            if p[k] * n_tests < FALSE_ALARMS
            else -np.inf
            for group, c, p in zip(groups, compared, probability, strict=True)
        ]
        best = int(np.argmax(evidence))
        group, c = groups[best].group, compared[best]
        p = int(np.argmin(p_values[best][k]))
        prediction = c.mixture.at((k, p))
        centre = float(groups[best].centre[p])
        if group.kind in ("payload", "zero"):  # relative to the other runs
            centre = -float(prediction.moments[0])
        unlike.append(UnlikeRun(
            int(which[k]), group.kind, group.name, group.parameters[p], group.units[p],
            centre + float(c.values[k, p]), float(np.sqrt(c.covariance[k, p, p])),
            centre + prediction.ends, float(probability[:, k].min()),
        ))  # fmt: skip
    return unlike


def _explained(compared: Compared, k: int, noise: float, *, is_drive: bool) -> float:
    """Return what a difference of a group explains of a run or unit: chi^2 less 2 each (Akaike)."""
    mean, std = compared.mixture.at(k).moments
    C = compared.covariance[k]
    V = noise * C
    if is_drive:  # other parameters do not vary between alike runs
        V = V + np.diag(np.maximum(std**2 - np.diag(C), 0.0))
    away = compared.values[k] - mean
    return float(away @ np.linalg.solve(V, away)) - 2.0 * len(away)


def _is_compared(group: RunsOf, which: Array, *, is_unit: bool) -> Array:
    """Return which runs or units can be compared in a group, (m,): payloads that they determine.

    A run in which the last joints are at rest has a large moment and a wrong mass in place of any
    other effect. What all runs together do not determine, no motion does.
    """
    runs = group.runs
    if group.group.kind != "payload":
        return np.ones(len(which), dtype=bool)
    H = np.array([runs.H[runs.unit == u].sum(axis=0) for u in which]) if is_unit else runs.H[which]
    is_open, is_open_in_all = (
        np.diagonal(covariance_of(x, runs.scale), axis1=-2, axis2=-1) > runs.scale**2
        for x in (H, runs.H.sum(axis=0))
    )
    return np.asarray(~np.any(is_open & ~is_open_in_all, axis=1))
