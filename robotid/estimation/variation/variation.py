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

#: Standard normal scores at which result.json has the quantiles of the predictive distribution.
SCORES = np.linspace(-3.5, 3.5, 15)
#: Probability that one of alike runs or units is named.
FALSE_ALARMS = 0.02
_PENALTY = 2.0  # evidence that each parameter of a group must add (Akaike)
_LEAST_SHRUNK = 1e-3  # smallest share of the shrinkage: the correlation has an inverse
_SCALE = 0.1  # smallest plausible standard deviation between units, over the parameter's size
_SPREADS = 32  # standard deviations between units over which a test is integrated
_RANGE = 0.05, 30.0  # their range, over the smallest standard error, over the scatter


@dataclass(frozen=True, eq=False)
class VaryingParameter:
    """A parameter of a drive in several runs."""

    name: str  # its name, for example "elbow.coulomb"
    unit: str  # its unit
    #: Mean, spread between runs, and prediction interval of the next run; between units and of the
    #: next unit, if there are several.
    prediction: Prediction
    #: (k,), its value in each run: the run's own and the mean, weighted by their information.
    values: Array
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
    #: Units that differ from the others, at most one cause for each; their runs are not in
    #: ``unlike``.
    unlike_units: tuple[UnlikeRun, ...] = ()
    of_runs: tuple[int, ...] = ()  # index of the unit of each run, k items

    @cached_property
    def correlation(self) -> Array:
        """Correlation of the parameters between runs, or between units if there are several.

        It is that of the values in the runs or units, shrunk to 0 by its own uncertainty; shape
        (m, m).
        """
        values = np.array([x.values for x in self.parameters]).reshape(-1, len(self.runs))
        if self.units > 1:
            unit = np.array(self.of_runs)
            values = np.stack([values[:, unit == u].mean(axis=1) for u in range(self.units)], 1)
        return shrunk_correlation(values.T)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        return {
            "logs": list(self.runs),
            "units": self.units,
            "parameters": {x.name: x.to_dict() for x in self.parameters},
            "correlation": self.correlation.tolist(),
            "unlike": [run.to_dict(self.runs) for run in self.unlike],
            **(
                {"unlike_units": [unit.to_dict(self.unit_names) for unit in self.unlike_units]}
                if self.units > 1
                else {}
            ),
        }


def vary(
    names: Sequence[str], groups: Sequence[RunsOf], units: Sequence[str] = ()
) -> Variation | None:
    """Return the variation between runs, or None for fewer than three runs.

    A run is compared with the prediction of the other runs, and a unit with that of the other
    units, group by group. If a group differs, the cause named is the group that differs most.
    """
    if len(names) < FEWEST_RUNS or not groups:
        return None
    models = [SpreadModel(group.runs) for group in groups]
    pairs = list(zip(groups, models, strict=True))
    unit = groups[0].runs.unit
    n_units = int(unit.max()) + 1
    compared_units = np.arange(n_units if n_units > FEWEST_RUNS else 0)
    compared_runs = np.arange(len(names) if len(names) > FEWEST_RUNS else 0)
    size = sum(len(group.runs.scale) for group in groups)
    n_tests = size * (len(compared_units) + len(compared_runs))
    unlike_units = _unlike(pairs, compared_units, n_tests, is_unit=True)
    different = [odd.run for odd in unlike_units]
    alike = compared_runs[~np.isin(unit[: len(compared_runs)], different)]
    return Variation(
        runs=tuple(names),
        units=n_units,
        parameters=tuple(
            parameter
            for group, model in pairs
            if group.group.kind == "drive"
            for parameter in _parameters(group, model)
        ),
        unlike=tuple(_unlike(pairs, alike, n_tests, is_unit=False)),
        unit_names=tuple(units) or tuple(map(str, range(n_units))),
        unlike_units=tuple(unlike_units),
        of_runs=tuple(unit.tolist()),
    )


def between_covariance(variation: Mapping[str, Any], names: Sequence[str]) -> Array:
    """Return the covariance of parameters in the next run that the fit to all runs lacks.

    Standard deviations are the medians of the spreads: between runs, or between units and between
    the runs of a unit.
    """
    at = {name: k for k, name in enumerate(names)}
    known = [(k, *x) for k, x in enumerate(variation["parameters"].items()) if x[0] in at]
    varying, places = [k for k, *_ in known], [at[name] for _, name, _ in known]
    std = np.array([np.hypot(x["spread"], x.get("spread_within_units", 0.0)) for *_, x in known])
    covariance = np.zeros((len(names), len(names)))
    R = np.array(variation["correlation"])[np.ix_(varying, varying)]
    covariance[np.ix_(places, places)] = std[:, None] * R * std
    return covariance


def shrunk_correlation(values: Array) -> Array:
    """Return the correlation of parameters, shrunk to 0 by its own uncertainty.

    r*_ij = a_i a_j r_ij with a_i^2 = 1 - sum Var(r_ij) / sum r_ij^2 over j != i, within [0, 1]: a
    parameter that hardly varies, and correlates by noise alone, leaves the others as they are. The
    matrix is positive definite, as a product of positive semidefinite matrices by elements (Schur).
    Var(r) is that of normal values, (1 - r^2)^2 / (k - 1), times (k^2 - 1) / (k^2 - 2 k): its mean
    is then 1 / (k - 1), as it is, for independent parameters. Two runs determine no correlation.

    References:
        Schaefer, Strimmer (2005), A shrinkage approach to large-scale covariance matrix
        estimation, doi:10.2202/1544-6115.1175, section 2.4 (target D), there with one factor for
        all parameters. Hotelling (1953), New light on the correlation coefficient and its
        transforms (variance of r).

    values (k, m).
    """
    k, m = values.shape
    if k < FEWEST_RUNS:
        return np.eye(m)
    centred = values - values.mean(axis=0)
    std = np.sqrt((centred**2).sum(axis=0) / (k - 1))
    z = centred / np.where(std > 0.0, std, 1.0)
    r = z.T @ z / (k - 1)
    off = ~np.eye(m, dtype=bool)
    others = off & (std > 0.0)
    size = (r**2 * others).sum(axis=1)
    variance = (1.0 - r**2) ** 2 * (k + 1) / (k * (k - 2))
    share = (variance * others).sum(axis=1) / np.where(size > 0.0, size, 1.0)
    left = np.sqrt(1.0 - np.clip(np.where(size > 0.0, share, 1.0), _LEAST_SHRUNK, 1.0))
    return np.where(off, left[:, None] * r * left, 1.0)


def between_units(
    values: Array, std_errors: Array, level: float
) -> tuple[Prediction, tuple[tuple[int, float], ...]] | None:
    """Return spread and prediction of the next unit, and the units that differ from the others.

    The unit farthest from the others is tested against them; if it differs, it is left out, and the
    next one is tested. Prediction and spread are of the units that are alike. Units that differ
    come with the two-sided probability of such a difference.

    values (u,), std_errors (u,).
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
    scale = max(_SCALE * abs(np.median(x)), np.median(errors), np.std(x, ddof=1))
    H = errors[:, None, None] ** -2.0
    one = np.zeros(len(left), dtype=int)  # a unit has one estimate here: it is the lowest level
    model = SpreadModel(Runs(H, H[:, 0] * x[:, None], one, np.array([scale])))
    return next(model.predict()), tuple(sorted(unlike, key=lambda pair: pair[1]))


def _probability_of_last(values: Array, std_errors: Array) -> float:
    """Return the two-sided probability of the last value without a difference from the others.

    The means of both, and the logarithm of the spread, have flat priors: without standard errors
    this is the t-test, whose level holds for any spread.
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
    known, (values, errors) = np.einsum("kpp->p", group.runs.H) > 0.0, model.values
    for p, prediction in enumerate(model.predict()):
        if known[p]:
            centre = float(group.centre[p])
            yield VaryingParameter(
                group.group.parameters[p],
                group.group.units[p],
                prediction.shifted(centre),
                centre + values[:, p],
                errors[:, p],
            )


def _unlike(
    pairs: Sequence[tuple[RunsOf, SpreadModel]], which: Array, n_tests: int, *, is_unit: bool
) -> list[UnlikeRun]:
    """Return the runs or units that differ from the others, in order."""
    if not len(which):
        return []
    compared = [model.against_others(which, is_unit=is_unit) for _, model in pairs]
    probability = np.array([
        np.where(_is_compared(group, which, is_unit=is_unit)[:, None],
                 c.mixture.beyond(c.values), np.inf).min(axis=1)
        for (group, _), c in zip(pairs, compared, strict=True)
    ])  # fmt: skip
    noise = float(np.median([group.inflation for group, _ in pairs]))  # of a typical group
    unlike = []
    for k in np.flatnonzero(probability.min(axis=0) * n_tests < FALSE_ALARMS).tolist():
        evidence = [
            _explained(c, k, noise / group.inflation, is_drive=group.group.kind == "drive")
            if p[k] * n_tests < FALSE_ALARMS
            else -np.inf
            for (group, _), c, p in zip(pairs, compared, probability, strict=True)
        ]
        best = int(np.argmax(evidence))
        (group, _), c = pairs[best], compared[best]
        p = int(np.argmin(c.mixture.beyond(c.values)[k]))
        prediction = c.mixture.at((k, p))
        centre = float(group.centre[p])
        if group.group.kind in ("payload", "zero"):  # relative to the other runs
            centre = -float(prediction.moments[0])
        unlike.append(UnlikeRun(
            int(which[k]), group.group.kind, group.group.name, group.group.parameters[p],
            group.group.units[p], centre + float(c.values[k, p]),
            float(np.sqrt(c.covariance[k, p, p])), centre + prediction.ends,
            float(probability[:, k].min()),
        ))  # fmt: skip
    return unlike


def _explained(compared: Compared, k: int, noise: float, *, is_drive: bool) -> float:
    """Return what a difference of a group explains of a run or unit: chi^2 less 2 for each.

    The run's own errors are those of a common noise. Only drive terms vary between alike runs:
    gains, payloads and zeros need a cause.
    """
    mean, std = compared.mixture.at(k).moments
    C = compared.covariance[k]
    V = noise * C
    if is_drive:
        V = V + np.diag(np.maximum(std**2 - np.diag(C), 0.0))
    away = compared.values[k] - mean
    return float(away @ np.linalg.solve(V, away)) - _PENALTY * len(away)


def _is_compared(group: RunsOf, which: Array, *, is_unit: bool) -> Array:
    """Return which runs or units can be compared in a group, (m,).

    A payload is compared only if the run determines it: a run in which the last joints are at rest
    has a large moment and a wrong mass in place of any other effect.
    """
    runs = group.runs
    if group.group.kind != "payload":
        return np.ones(len(which), dtype=bool)
    H = np.array([runs.H[runs.unit == u].sum(axis=0) for u in which]) if is_unit else runs.H[which]
    alone, together = (
        np.diagonal(covariance_of(x, runs.scale), axis1=-2, axis2=-1)
        for x in (H, runs.H.sum(axis=0))
    )
    plausible = runs.scale**2  # what all runs do not determine, no motion does
    return np.asarray(~np.any((alone > plausible) & (together <= plausible), axis=1))
