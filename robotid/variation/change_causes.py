"""The cause of a change of base parameters: friction, offset, gain of a torque, or a payload."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from robotid._typing import Array

__all__ = ["Cause", "cause_of"]

_TERM = re.compile(r"(?:(?P<sign>[+-]) )?(?:(?P<size>[0-9.e+-]+) )?(?P<name>\S+\.\S+)")
_EXPLAINED = 0.5  # smallest share of a change that its cause explains
_WEIGHT = 2.0  # evidence that each parameter of a cause must add (Akaike)
_UNSCALED = "offset"  # drive term that is not of friction; a gain leaves it, for it may be a zero
_INERTIA = "armature"  # ... that never changes by itself
_MASS = ("m", "mcx", "mcy", "mcz")


@dataclass(frozen=True)
class Cause:
    """The cause of a change.

    Attributes:
        kind: "friction", "offset", "gain", "payload", or "other" if none of them explains it.
        where: Joint or link; "" if other.
        size: Change of friction and gain over the value before; of a payload, its mass [kg]; of an
            offset, in its unit; 0 if other.
        std_error: Its standard error.
    """

    kind: str
    where: str
    size: float
    std_error: float


def cause_of(
    parameters: Mapping[str, str],
    drives: Sequence[str],
    last_link: str,
    before: Array,
    change: Array,
    std_errors: Array,
) -> Cause:
    """Return the cause that explains most of a change.

    Each cause is a linear subspace of changes: those of the friction terms of a drive; of its
    offset; the drive's terms times a common factor, and likewise all inertial parameters, whose
    torque other joints measure, too; those by mass and first moments of the last link. The
    explained part of chi^2 less 2 for each dimension is compared.

    Args:
        parameters: Expression of each of the q base parameters by its name.
        drives: Names of the drives.
        last_link: The body that carries a payload.
        before: Values before the change, shape (q,).
        change: Their change, shape (q,).
        std_errors: Its standard errors, shape (q,).
    """
    names, d = list(parameters), change / std_errors
    found = []
    for kind, where, columns in _causes(
        names, list(parameters.values()), drives, last_link, before
    ):
        A = columns / std_errors[:, None]
        A = A[:, A.any(axis=0)]
        if not A.shape[1]:
            continue
        x = np.linalg.pinv(A) @ d
        explained, rank = float(d @ (A @ x)), np.linalg.matrix_rank(A)
        found.append((explained - _WEIGHT * rank, explained, kind, where, columns))
    other = Cause("other", "", 0.0, 0.0)
    if not found:
        return other
    _, explained, kind, where, columns = max(found, key=lambda each: each[0])
    # a change of everything by noise alone is not the cause's to explain
    noise = float(scipy.stats.chi2.ppf(0.5, len(d)))
    if explained < _EXPLAINED * max(float(d @ d) - noise, explained):
        return other
    return Cause(kind, where, *_size(kind, columns, before, change, std_errors))


def _causes(
    names: Sequence[str],
    expressions: Sequence[str],
    drives: Sequence[str],
    last_link: str,
    before: Array,
) -> Iterator[tuple[str, str, Array]]:
    """Yield kind, joint or link, and columns of each cause in the q parameters, shape (q, r)."""
    eye, owners = np.eye(len(names)), [name.rpartition(".")[0] for name in names]
    terms = [name.rpartition(".")[2] for name in names]
    inertial = np.array([owner not in drives for owner in owners])
    for drive in drives:
        own = np.array([owner == drive for owner in owners])
        offset = own & np.array([term == _UNSCALED for term in terms])
        armature = own & np.array([term == _INERTIA for term in terms])
        yield "friction", drive, eye[:, own & ~offset & ~armature]
        yield "offset", drive, eye[:, offset]
        scaled = own & ~offset
        if scaled.sum() > 1:
            yield "gain", drive, np.column_stack([before * scaled, before * inertial])
    K = np.array([[_coefficient(text, f"{last_link}.{t}") for t in _MASS] for text in expressions])
    yield "payload", last_link, K


def _coefficient(expression: str, name: str) -> float:
    """Return the coefficient of a standard parameter in the expression of a base parameter."""
    for term in _TERM.finditer(expression):
        if term["name"] == name:
            return (-1.0 if term["sign"] == "-" else 1.0) * float(term["size"] or 1.0)
    return 0.0


def _size(
    kind: str, columns: Array, before: Array, change: Array, std_errors: Array
) -> tuple[float, float]:
    """Return the size of a cause with its standard error."""
    A = columns / std_errors[:, None]
    if kind == "friction":  # weighted mean of the relative changes
        own = columns.any(axis=1)
        A = (before * own / std_errors)[:, None]
    C = np.linalg.pinv(A.T @ A)
    x = C @ (A.T @ (change / std_errors))
    return float(x[0]), float(np.sqrt(C[0, 0]))
