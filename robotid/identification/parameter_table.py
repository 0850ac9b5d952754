"""Parameters of a result as tables: with correlations, and about the centres of mass."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid.base.files import finite
from robotid.base.typing import Array
from robotid.diagnosis.verdict.fit_findings import correlated_parameters
from robotid.estimation.fitting.fitted import Fit, Identified

#: Columns of a row; low and high are the ends of the 95 % interval, source what determined it.
HEADERS = ("part", "parameter", "urdf", "value", "std_error", "low", "high", "source", "unit")
_NUMBERS = HEADERS[2:7]
#: Mass [kg], centre of mass [m], inertia about it [kg m^2], in the axes of the joint frame.
CENTRAL_TERMS = ("m", "cx", "cy", "cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
_PINOCCHIO = ("m", "cx", "cy", "cz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
_ORDER = [_PINOCCHIO.index(term) for term in CENTRAL_TERMS]


def parameter_entries(fit: Identified) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the parameters of the bodies and of the drives, as in result.json."""
    layout, sources, at_bound = fit.model.layout, fit.sources, fit.at_bound
    errors, ends, quantile = fit.standard_error, fit.standard_interval, fit.standard_quantile
    entries: list[dict[str, Any]] = [
        {
            "name": name,
            "value": float(fit.standard[i]),
            "std_error": finite(errors[i]),
            "quantile": float(quantile[i]) if math.isfinite(errors[i]) else None,
            "interval_95": [finite(end) for end in ends[i]],
            "unit": layout.units[i],
            "prior": float(fit.prior[i]),
            "source": sources[i],
            "at_bound": bool(at_bound[i]),
        }
        for i, name in enumerate(layout.names)
    ]
    for i, (k, r) in correlated_parameters(fit).items():
        entries[i] |= {"correlated_with": layout.names[k], "correlation": r}
    return entries[: layout.n_inertial], entries[layout.n_inertial :]


def parameter_table(
    bodies: Iterable[Mapping[str, Any]], drives: Iterable[Mapping[str, Any]]
) -> Any:  # noqa: ANN401
    """Return the parameters of a result as a table, links first, then drives."""
    entries = [*bodies, *({**entry, "prior": None} for entry in drives)]
    rows = []
    for entry in entries:
        low, high = entry.get("interval_95", (None, None))  # of results without intervals
        values = [entry.get("prior"), entry["value"], entry.get("std_error"), low, high]
        part, _, parameter = entry["name"].rpartition(".")
        rows.append((part, parameter, *values, entry.get("source", ""), entry["unit"]))
    try:
        import pandas
    except ImportError:
        return [dict(zip(HEADERS, row, strict=True)) for row in rows]
    return pandas.DataFrame(rows, columns=list(HEADERS)).astype(dict.fromkeys(_NUMBERS, float))


@dataclass(frozen=True, eq=False)
class CentralParameters:
    """Parameters of the n bodies in the order of ``CENTRAL_TERMS``, SI units."""

    urdf: Array  # Values of the URDF, shape (n, 10); NaN for the centre and inertia without mass
    values: Array  # Identified values, likewise
    half: Array  # Half-widths of their 95 % intervals, shape (n, 10); inf if there is none


def central_parameters(fit: Fit) -> CentralParameters:
    """Return the parameters of each body about its centre of mass."""
    n, size = len(fit.model.layout.bodies), fit.model.layout.n_inertial
    pi, before = (x[:size].reshape(n, 10) for x in (fit.standard, fit.prior))
    error = fit.standard_error[:size]
    quantile = fit.standard_quantile[:size].reshape(n, 10).max(axis=1)
    urdf, values, half = (np.full((n, 10), np.nan) for _ in range(3))
    for i in range(n):
        urdf[i], _ = about_com(before[i])
        values[i], G = about_com(pi[i])
        own = slice(10 * i, 10 * i + 10)
        C = fit.standard_covariance[own, own]
        std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", G, C, G), 0.0))
        half[i] = np.where(np.isfinite(error[own]).all(), quantile[i] * std, np.inf)
    return CentralParameters(*(x[:, _ORDER] for x in (urdf, values, half)))


def about_com(pi: Array) -> tuple[Array, Array]:
    """Return m, c and I_c in Pinocchio's order, shape (10,), and their derivatives, (10, 10)."""
    # c = h / m and I_c = I - m (c c 1 - c c'), with the first moments h.
    m, G = float(pi[0]), np.eye(10)
    if not m > 0:
        return np.append(m, np.full(9, np.nan)), G
    c, values = pi[1:4] / m, np.array(pi)
    G[1:4, 0], G[1:4, 1:4] = -c / m, np.eye(3) / m
    steiner = c @ c * np.eye(3) - np.outer(c, c)  # (3, 3) [m^2]
    for row, (i, j) in enumerate(zip(*np.tril_indices(3), strict=True), 4):
        values[row] -= m * steiner[i, j]
        G[row, 0] = steiner[i, j]
        for k in range(3):
            G[row, 1 + k] = (i == k) * c[j] + (j == k) * c[i] - 2 * (i == j) * c[k]
    values[1:4] = c
    return values, G
