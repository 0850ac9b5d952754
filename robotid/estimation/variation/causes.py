"""What makes a run or a unit differ from the others: a drive, a gain, or a payload.

A changed gain looks like changed friction, and the friction of a robot varies anyway. All groups of
parameters x are therefore compared together, with the information of the runs on all of them. Drive
terms vary between runs and units as those of the others do:

    x_own = mu + delta + u,    u ~ N(0, D),

with delta = 0 except in one group, which explains 2 (log likelihood) = s^T I^-1 s of the residual,
where V is the covariance of the estimate x_own - mu, s = V^-1 (x_own - mu) and I = V^-1, both
restricted to the group.
"""

from collections.abc import Sequence

import numpy as np

from robotid.base.typing import Array
from robotid.estimation.variation.groups import RunsOf
from robotid.estimation.variation.mixed_effects import covariance_of

_PENALTY = 2.0  # evidence that each parameter of a group must add (Akaike)
_RANK = 1e-9  # eigenvalue over the largest below which a direction is not determined


def evidence_by_group(
    groups: Sequence[RunsOf], deviations: Sequence[Array], is_own: Array, *, is_unit: bool
) -> list[float]:
    """Return what a difference of each group explains of the residual of a run or unit.

    References:
        Akaike (1974), A new look at the statistical model identification.

    deviations (levels, q), is_own (k,).
    """
    H, h, scale, places = _together(groups)
    S = np.hstack([x * (group.group.kind == "drive")
                   for group, x in zip(groups, deviations, strict=True)])  # fmt: skip
    unit, is_other = groups[0].runs.unit, ~is_own
    W, w = _lifted(H, h, np.diag(S[0] ** 2))
    others, of_others = W[is_other], w[is_other]
    if len(S) > 1:
        member = 1.0 * (np.unique(unit[is_other])[:, None] == unit[is_other])
        others, of_others = _lifted(
            np.einsum("uk,kij->uij", member, others), member @ of_others, np.diag(S[-1] ** 2)
        )
    C = covariance_of(others.sum(axis=0), scale)
    mean = C @ of_others.sum(axis=0)
    own, score = (W, w) if is_unit else (H, h)
    levels = S[1:] if is_unit else S
    own, score = own[is_own].sum(axis=0), score[is_own].sum(axis=0)
    V, s = _lifted(own, score - own @ mean, C + np.diag((levels**2).sum(axis=0)))
    return [_explained(V[place, place], s[place], scale[place]) for place in places]


def _together(groups: Sequence[RunsOf]) -> tuple[Array, Array, Array, list[slice]]:
    """Return the information of the runs on all groups, their scales, and the groups' places.

    Noise is that of a typical group.
    """
    sizes = [len(group.runs.scale) for group in groups]
    places = [slice(end - n, end) for n, end in zip(sizes, np.cumsum(sizes), strict=True)]
    inflation = float(np.median([group.inflation for group in groups]))
    count, total = len(groups[0].runs.h), sum(sizes)
    H, h = np.zeros((count, total, total)), np.zeros((count, total))
    for group, place in zip(groups, places, strict=True):
        runs = group.runs
        if group.across is None:
            H[:, place, place] = runs.H * group.inflation / inflation
        else:
            H[:, place] = group.across / inflation
        h[:, place] = runs.h * group.inflation / inflation
    return H, h, np.concatenate([group.runs.scale for group in groups]), places


def _lifted(H: Array, h: Array, D: Array) -> tuple[Array, Array]:
    """Return (H^-1 + D)^-1 and its product with x, of H and h = H x, for singular H, too."""
    G = np.linalg.inv(np.eye(len(D)) + H @ D)
    return G @ H, np.einsum("...ij,...j->...i", G, h)


def _explained(information: Array, score: Array, scale: Array) -> float:
    """Return s^T I^-1 s less 2 for each determined direction."""
    w, V = np.linalg.eigh(0.5 * scale[:, None] * (information + information.T) * scale)
    known = w > _RANK * max(float(w[-1]), 0.0)
    z = V.T @ (scale * score)
    return float((z[known] ** 2 / w[known]).sum()) - _PENALTY * int(known.sum())
