"""Variation of parameters between runs: spreads, the next run, runs that are unlike the others."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.variation.causes import evidence_by_group
from robotid.estimation.variation.groups import FEWEST_RUNS, RunsOf
from robotid.estimation.variation.mixed_effects import MixedEffects, Prediction, covariance_of

#: Standard normal scores at which result.json has the quantiles of the predictive distribution.
SCORES = np.linspace(-3.5, 3.5, 15)
_FALSE_ALARMS = 0.02  # probability that one of alike runs or units is named
_LEAST_SHRUNK = 1e-3  # smallest share of the shrinkage: the correlation has an inverse


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
            "next_quantiles": found.quantiles(SCORES).tolist(),
            "one_more": {
                "std_error": found.after[0],
                "interval_width": found.after[1],
            },
            "by_log": self.values.tolist(),
            "std_error_by_log": self.std_errors.tolist(),
        }


@dataclass(frozen=True, eq=False)
class UnlikeRun:
    """A run, or a unit, that differs from what the others predict.

    Attributes:
        run: Index of the run, or of the unit.
        kind: "drive", "gain", "payload" or "zero".
        where: Drive, joint or link.
        name: The parameter that differs most.
        unit: Its unit.
        value: Its value in this run; of a payload and a zero, more than in the other runs.
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
        parameters: The parameters of the drives, m items.
        unlike: Runs that differ from the others, at most one cause for each.
        unit_names: Names of the units, in the order of their indices.
        unlike_units: Units that differ from the others, at most one cause for each; their runs
            are not in ``unlike``.
        of_runs: Index of the unit of each run, k items.
    """

    runs: tuple[str, ...]
    units: int
    parameters: tuple[VaryingParameter, ...]
    unlike: tuple[UnlikeRun, ...]
    unit_names: tuple[str, ...] = ()
    unlike_units: tuple[UnlikeRun, ...] = ()
    of_runs: tuple[int, ...] = ()

    @cached_property
    def correlation(self) -> Array:
        """Correlation of the parameters between runs, or between units if there are several.

        It is that of the values in the runs or units, shrunk to 0 by its own uncertainty; shape
        (m, m).
        """
        values = np.array([each.values for each in self.parameters]).reshape(-1, len(self.runs))
        if self.units > 1:
            unit = np.array(self.of_runs)
            values = np.stack([values[:, unit == u].mean(axis=1) for u in range(self.units)], 1)
        return shrunk_correlation(values.T)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as result.json has them."""
        return {
            "logs": list(self.runs),
            "units": self.units,
            "parameters": {each.name: each.to_dict() for each in self.parameters},
            "correlation": self.correlation.tolist(),
            "unlike": [
                asdict(each) | {"run": self.runs[each.run], "ends": each.ends.tolist()}
                for each in self.unlike
            ],
            **({"unlike_units": [
                asdict(each) | {"run": self.unit_names[each.run], "ends": each.ends.tolist()}
                for each in self.unlike_units
            ]} if self.units > 1 else {}),
        }  # fmt: skip


def vary(
    names: Sequence[str], groups: Sequence[RunsOf], units: Sequence[str] = ()
) -> Variation | None:
    """Return the variation between runs, or None for fewer than three runs.

    A run is compared with the prediction of the other runs, and a unit with that of the other
    units, group by group. If a group differs, the cause named is the one that explains most of the
    residual, see ``evidence_by_group``.
    """
    if len(names) < FEWEST_RUNS or not groups:
        return None
    parameters: list[VaryingParameter] = []
    models = [MixedEffects(group.runs) for group in groups]
    for group, model in zip(groups, models, strict=True):
        if group.group.kind == "drive":
            parameters += _parameters(group, model)
    pairs = list(zip(groups, models, strict=True))
    unit = groups[0].runs.unit
    n_units = int(unit.max()) + 1
    compared_units = np.arange(n_units if n_units > FEWEST_RUNS else 0)
    compared_runs = np.arange(len(names) if len(names) > FEWEST_RUNS else 0)
    size = sum(len(group.runs.scale) for group in groups)
    n_tests = size * (len(compared_units) + len(compared_runs))
    unlike_units = _unlike(pairs, compared_units, n_tests, is_unit=True)
    different = [each.run for each in unlike_units]
    alike = compared_runs[~np.isin(unit[: len(compared_runs)], different)]
    unlike = _unlike(pairs, alike, n_tests, is_unit=False)
    return Variation(
        tuple(names), n_units, tuple(parameters), tuple(unlike),
        tuple(units) or tuple(map(str, range(n_units))), tuple(unlike_units), tuple(unit.tolist()),
    )  # fmt: skip


def between_covariance(variation: Mapping[str, Any], names: Sequence[str]) -> Array:
    """Return the covariance of parameters in the next run that the fit to all runs lacks.

    Standard deviations are the medians of the spreads: between runs, or between units and between
    the runs of a unit.
    """
    at = {name: k for k, name in enumerate(names)}
    parameters = variation["parameters"]
    own = [k for k, name in enumerate(parameters) if name in at]
    places = [at[name] for name in parameters if name in at]
    entries = [entry for name, entry in parameters.items() if name in at]
    spreads = [(entry["spread"], entry.get("spread_within_units", 0.0)) for entry in entries]
    std = np.hypot(*np.array(spreads).reshape(-1, 2).T)
    found = np.zeros((len(names), len(names)))
    R = np.array(variation["correlation"])[np.ix_(own, own)]
    found[np.ix_(places, places)] = std[:, None] * R * std
    return found


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


def _parameters(group: RunsOf, model: MixedEffects) -> Iterator[VaryingParameter]:
    """Yield the parameters of a group on which the runs have information."""
    known, (values, errors) = np.einsum("kpp->p", group.runs.H) > 0.0, model.values
    for p, prediction in enumerate(model.with_one_more()):
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


def _unlike(
    pairs: Sequence[tuple[RunsOf, MixedEffects]], which: Array, n_tests: int, *, is_unit: bool
) -> list[UnlikeRun]:
    """Return the runs or units that differ from the others, in order.

    The cause named is the group that explains most of the residual, the others as they vary.
    """
    groups, unit, unlike = [group for group, _ in pairs], pairs[0][0].runs.unit, []
    found = [_probability(group, every, which, is_unit=is_unit) for group, every in pairs]
    least = np.min(found, axis=0, initial=1.0)
    for k in np.flatnonzero(least * n_tests < _FALSE_ALARMS):
        at = int(which[k])
        is_own = unit == at if is_unit else np.arange(len(unit)) == at
        others = [
            MixedEffects(
                group.runs.without_unit(at) if is_unit else group.runs.without(at), every.deviation
            )
            for group, every in pairs
        ]
        evidence = evidence_by_group(
            groups, [each.deviation for each in others], is_own, is_unit=is_unit
        )
        known = [g for g, probability in enumerate(found) if np.isfinite(probability[k])]
        best = max(known, key=lambda g: evidence[g])
        own = pairs[best][1].against_others(which[k : k + 1], is_unit=is_unit)
        x, variance = own.values[0], np.diag(own.covariance[0])
        expected = others[best].predict(variance, x, is_unit=is_unit)
        p, group = int(np.argmin([each.probability for each in expected])), groups[best]
        centre = float(group.centre[p])
        if group.group.kind in ("payload", "zero"):  # relative to the other runs
            centre = -expected[p].mean
        unlike.append(UnlikeRun(
            at, group.group.kind, group.group.name, group.group.parameters[p],
            group.group.units[p], centre + float(x[p]), float(np.sqrt(variance[p])),
            centre + expected[p].ends, float(least[k]),
        ))  # fmt: skip
    return unlike


def _probability(group: RunsOf, every: MixedEffects, which: Array, *, is_unit: bool) -> Array:
    """Return the smallest probability of the deviations of runs or units from the others, (m,).

    A payload is compared only if the run determines it, else its probability is infinite: a run in
    which the last joints are at rest has a large moment and a wrong mass in place of any other
    effect.
    """
    runs, found = group.runs, np.full(len(which), np.inf)
    is_compared = np.ones(len(which), dtype=bool)
    if group.group.kind == "payload" and len(which):
        own = np.array([runs.of_unit(u).H.sum(axis=0) for u in which] if is_unit else runs.H[which])
        alone, together = (
            np.diagonal(covariance_of(H, runs.scale), axis1=-2, axis2=-1)
            for H in (own, runs.H.sum(axis=0))
        )
        plausible = runs.scale**2  # what all runs do not determine, no motion does
        is_compared = ~np.any((alone > plausible) & (together <= plausible), axis=1)
    if is_compared.any():
        compared = every.against_others(which[is_compared], is_unit=is_unit)
        found[is_compared] = compared.probability.min(axis=1)
    return found
