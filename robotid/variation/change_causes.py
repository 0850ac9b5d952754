"""The cause of a change of base parameters: friction, offset, gain of a torque, or a payload."""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array

__all__ = ["Cause", "cause_of"]

_TERM = re.compile(r"(?:(?P<sign>[+-]) )?(?:(?P<size>[0-9.e+-]+) )?(?P<name>\S+\.\S+)")
_EXPLAINED = 0.5  # smallest share of a change that its cause explains
_WEIGHT = 2.0  # evidence that each parameter of a cause must add (Akaike)
_FAR = 3.0  # standard errors beyond which a relative change differs
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
    offset; a common factor of the drive's terms and of a body, whose parameters this joint measures
    best; those by mass and first moments of the last link. The explained part of chi^2 less 2 for
    each dimension is compared. Without a body that changes likewise, a drive's change is friction.

    Args:
        parameters: Expression of each of the q base parameters by its name.
        drives: Names of the drives.
        last_link: The body that carries a payload.
        before: Values before the change, shape (q,).
        change: Their change, shape (q,).
        std_errors: Its standard errors, shape (q,).
    """
    names, found = list(parameters), []
    expressions = list(parameters.values())
    every = _causes(names, expressions, drives, last_link, before, change, std_errors)
    for kind, where, columns in every:
        if columns.any():
            *_, explained = _fitted(columns, change, std_errors)
            rank = int(np.linalg.matrix_rank(columns / std_errors[:, None]))
            found.append((explained - _WEIGHT * rank, explained, kind, where, columns))
    other = Cause("other", "", 0.0, 0.0)
    if not found:
        return other
    _, explained, kind, where, columns = max(found, key=lambda each: each[0])
    total = float(((change / std_errors) ** 2).sum()) - len(change)  # without that of noise
    if explained < _EXPLAINED * total:
        return other
    return Cause(kind, where, *_size(kind, columns, before, change, std_errors))


def _causes(
    names: Sequence[str],
    expressions: Sequence[str],
    drives: Sequence[str],
    last_link: str,
    before: Array,
    change: Array,
    std_errors: Array,
) -> Iterator[tuple[str, str, Array]]:
    """Yield kind, joint or link, and columns of each cause in the q parameters, shape (q, r)."""

    def factor(own: Array) -> tuple[float, float]:
        """Return the common relative change of some parameters, and its standard error."""
        x, error, _ = _fitted((before * own)[:, None], change, std_errors)
        return x, error

    eye, owners = np.eye(len(names)), [name.rpartition(".")[0] for name in names]
    terms = [name.rpartition(".")[2] for name in names]
    bodies = dict.fromkeys(owner for owner in owners if owner not in drives)
    for drive in drives:
        own = np.array([owner == drive for owner in owners])
        offset = own & np.array([term == _UNSCALED for term in terms])
        armature = own & np.array([term == _INERTIA for term in terms])
        yield "friction", drive, eye[:, own & ~offset & ~armature]
        yield "offset", drive, eye[:, offset]
        scaled = own & ~offset
        for body in bodies if scaled.any() else ():
            moved = np.array([owner == body for owner in owners])
            (x, x_error), (y, y_error) = factor(scaled), factor(moved)
            is_alike = abs(x - y) < _FAR * np.hypot(x_error, y_error)
            if is_alike and abs(y) > _FAR * y_error > 0.0:
                yield "gain", drive, (before * (scaled | moved))[:, None]
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
    if kind == "friction":  # weighted mean of the relative changes
        columns = (before * columns.any(axis=1))[:, None]
    x, error, _ = _fitted(columns, change, std_errors)
    return x, error


def _fitted(columns: Array, change: Array, std_errors: Array) -> tuple[float, float, float]:
    """Return the first coefficient of a change, its standard error, and the explained chi^2."""
    A, d = columns / std_errors[:, None], change / std_errors
    C = np.linalg.pinv(A.T @ A)
    x = C @ (A.T @ d)
    return float(x[0]), float(np.sqrt(C[0, 0])), float(d @ A @ x)
