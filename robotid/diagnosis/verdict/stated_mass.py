"""A stated mass as a check of the torque scale: how well torque alone determines that mass."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.estimation.fitting.fitted import Fit
from robotid.estimation.fitting.standard_errors import QUANTILE

#: Relative difference up to which a mass or a gravity torque confirms the torque scale [-].
AGREES = 0.05
_SAME = 1e-6  # share of a claim that changes no torque, below which it is rounding
_ABSORBS = 0.1  # share of a change of a stated mass that a link takes up to be named
_LISTS = ("names", "absorbed_by")
_NAMED = 4  # links that a sentence names


@dataclass(frozen=True)
class StatedMass:
    """Masses that the user states, and what torque alone determines of them.

    Attributes:
        names: What is stated: "total_mass", or "mass of" a link.
        ratio: Mass that torque alone determines, without this statement and without the URDF's
            masses, over the stated mass [-]; None if torque does not determine it.
        half_width: Half-width of its 95 % interval, plus that of the stated range [-].
        absorbed_by: Links whose masses change with the stated one while no torque changes.
    """

    names: tuple[str, ...]
    ratio: float | None = None
    half_width: float = 0.0
    absorbed_by: tuple[str, ...] = ()

    @property
    def verifies(self) -> bool:
        """Whether torque determines the stated mass within 5 %, and confirms it within 5 %."""
        is_near = self.ratio is not None and abs(self.ratio - 1.0) <= AGREES
        return is_near and self.half_width <= AGREES

    @property
    def contradicts(self) -> bool:
        """Whether the whole 95 % interval differs from the stated mass by more than 5 %."""
        return self.ratio is not None and abs(self.ratio - 1.0) - self.half_width > AGREES

    @property
    def message(self) -> str:
        """What the statement verifies, or why it does not."""
        stated = f"the stated {listed(self.names)}" if self.names else "the stated mass"
        if self.ratio is None:
            links = listed(self.absorbed_by, _NAMED)
            why = f" (the mass of {links} changes with it at equal torque)"
            return (
                f"{stated} does not verify the scale: torque does not determine it"
                f"{why if self.absorbed_by else ''}"
            )
        found = (
            f"torque alone determines {self.ratio:.3g} +- {self.half_width:.2g} x {stated} "
            f"(limit: 1 +- {AGREES:g})"
        )
        if self.verifies:
            return found
        if self.contradicts:
            return f"{found}; probable cause: the gains of the torques, or the stated mass"
        return f"{found}; this does not verify the scale"

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as result.json has them."""
        return asdict(self) | {key: list(getattr(self, key)) for key in _LISTS}

    @classmethod
    def from_dict(cls, stated: Mapping[str, Any]) -> StatedMass:
        """Return the figures that a result.json has."""
        return cls(**(dict(stated) | {key: tuple(stated[key]) for key in _LISTS}))


def stated_mass(found: Fit) -> StatedMass | None:
    """Return the check of the masses that the user states; None without one.

    A range wider than +- 5 % is a bound, not a statement. So is the mass of a pinned link.
    """
    layout, bounds = found.model.layout, found.estimator.bounds
    stated = {f"mass of {link}": (link, pair) for link, pair in bounds.masses.items()}
    if bounds.total is not None:
        stated["total_mass"] = ("", bounds.total)
    names, rows, widths = [], [], []
    for name, (link, (low, high)) in stated.items():
        centre, width = 0.5 * (low + high), 0.5 * (high - low)
        if link not in bounds.pinned and centre > 0 and width <= AGREES * centre:
            masses = layout.owned_by([link]) if link else np.ones(len(layout.names), dtype=bool)
            names.append(name)
            rows.append(_are_masses(found) * masses / centre)
            widths.append(width / centre)
    return _checked(found, names, np.array(rows), np.array(widths)) if names else None


def determines_total_mass(found: Fit) -> bool:
    """Return whether torque alone determines the total mass within 5 %."""
    masses = _are_masses(found).astype(float)
    if not masses @ found.standard > 0:
        return False
    check = _checked(found, ["total_mass"], masses[None] / (masses @ found.standard), np.zeros(1))
    return check.ratio is not None and check.half_width <= AGREES


def _are_masses(found: Fit) -> Array:
    """Return which standard parameters are masses, shape (p,), bool."""
    return np.array([name.endswith(".m") for name in found.model.layout.names])


def _checked(found: Fit, names: Sequence[str], C: Array, widths: Array) -> StatedMass:
    """Return what torque alone determines of the ratio r in C pi = r 1.

    Torque alone determines K pi = beta. Sums Z^T C of the claims that are sums M K of base
    parameters have no free part; with o = Z^T 1, r = o . M beta / o . o. In units of the spread.
    """
    model, wls = found.model, found.wls
    is_pinned = model.layout.owned_by(found.estimator.bounds.pinned)
    spread = np.where(found.prior_std > 0, found.prior_std, model.layout.scales(model.length))
    spread = np.where(is_pinned, 0.0, spread)  # a stated mass is not known here
    is_known = np.isfinite(np.diag(wls.covariance))
    K = found.mapping.K[is_known]
    inverse = np.linalg.pinv(K * spread)  # (p, b)
    claims = C * spread  # (k, p)
    free = claims - claims @ inverse @ (K * spread)  # (k, p), changes no torque
    U, size, _ = np.linalg.svd(free)
    size = np.append(size, np.zeros(len(U) - len(size)))
    Z = U[:, size <= _SAME * np.linalg.norm(claims)]  # (k, d)
    o = Z.sum(axis=0)
    if not np.linalg.norm(o) > _SAME:
        change = np.abs(free.sum(axis=0) * spread)[: model.layout.n_inertial : 10]
        shares = change / change.sum()
        links = [x for x, part in zip(model.layout.bodies, shares, strict=True) if part > _ABSORBS]
        return StatedMass(tuple(names), absorbed_by=tuple(links))
    sums = Z @ o / (o @ o)  # (k,), of the claims
    M = sums @ claims @ inverse  # (b,)
    pinned = np.where(is_pinned, found.prior, 0.0)
    ratio = float(M @ (wls.theta[is_known] - K @ pinned) + sums @ C @ pinned)
    error = float(np.sqrt(max(M @ wls.covariance[np.ix_(is_known, is_known)] @ M, 0.0)))
    width = QUANTILE * error + float(np.abs(sums) @ widths)
    return StatedMass(tuple(names), ratio, width)
