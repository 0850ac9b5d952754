"""Scale check of a result: known masses, payloads, and the URDF's gravity and masses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
import scipy.special

from robotid.base.findings import listed
from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.diagnosis.catalogue import sentence_of
from robotid.diagnosis.decisions import AGREES, BETTER, BEYOND_NOISE, DIFFERS, ZERO
from robotid.dynamics.constraint_rows import loop_basis, without_forces
from robotid.dynamics.torque import joint_torque_regressor
from robotid.estimation.fitting.fitted import CLEARLY, Fit
from robotid.estimation.fitting.standard_errors import QUANTILE
from robotid.robot.parameters import pseudo_inertia
from robotid.robot.prior import assumed_masses

_POSES = 300  # at which gravity is compared
_ANOTHER = 0.25  # difference of gravity and total mass from which on they contradict the scale
_TOTAL = "total mass"


class KnownMass(ABC):
    """A mass that the user knows, against the one that torque alone determines."""

    kind: ClassVar[str]

    @property
    @abstractmethod
    def status(self) -> str:
        """Whether it "verifies" or "contradicts" the scale, or is "open" or "undetermined"."""

    @property
    def verifies(self) -> bool:
        """Whether torque determines the mass within 5 %, and confirms it within 5 %."""
        return self.status == "verifies"

    @property
    def contradicts(self) -> bool:
        """Whether the mass that torque determines is another one."""
        return self.status == "contradicts"

    @property
    @abstractmethod
    def message(self) -> str:
        """Both masses, and what follows for the scale of the torques."""

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as result.json has them, and what they mean."""
        figures = {key: list(x) if isinstance(x, tuple) else x for key, x in vars(self).items()}
        return figures | {"message": self.message}

    @classmethod
    def from_dict(cls, stated: Mapping[str, Any]) -> Self:
        """Return the figures that a result.json has."""
        figures = {key: tuple(x) if isinstance(x, list) else x for key, x in stated.items()}
        figures.pop("message", None)
        return cls(**figures)


@dataclass(frozen=True)
class StatedMass(KnownMass):
    """Masses that the user states, and what torque alone determines of them."""

    names: tuple[str, ...]  # "total_mass", or "mass of" a link
    ratio: float | None = None  # mass that torque alone determines, over the stated one [-]
    half_width: float = 0.0  # of its 95 % interval, plus that of the stated range [-]
    absorbed_by: tuple[str, ...] = ()  # links that take up the mass while no torque changes
    kind: ClassVar[str] = "given mass"

    @property
    def status(self) -> str:
        """It contradicts if the whole 95 % interval differs by more than 5 %."""
        if self.ratio is None:
            return "undetermined"
        if abs(self.ratio - 1.0) - self.half_width > AGREES:
            return "contradicts"
        is_near = abs(self.ratio - 1.0) <= AGREES and self.half_width <= AGREES
        return "verifies" if is_near else "open"

    @property
    def message(self) -> str:
        """What the statement verifies, or why it does not."""
        return sentence_of(
            "scale:stated", what=self.status, names=listed(self.names) if self.names else "mass",
            absorbed=bool(self.absorbed_by), links=listed(self.absorbed_by, 4),
            ratio=self.ratio or 0.0, half_width=self.half_width, limit=AGREES,
        )  # fmt: skip


@dataclass(frozen=True)
class PayloadCheck(KnownMass):
    """The known mass of a payload, and its mass as torque alone determines it."""

    link: str  # the link that carries it
    known: float  # its known mass [kg]
    identified: float | None = None  # without this knowledge [kg]; None: not determined
    std_error: float = 0.0  # of that [kg]
    interval: tuple[float, float] = (0.0, 0.0)  # 95 %, of it [kg]
    log: str = ""  # the log with the payload; "" if it is not a file
    sha256: str = ""  # of the log
    kind: ClassVar[str] = "payload of known mass"

    @property
    def ratio(self) -> float | None:
        """Identified over known mass, the scale of the torques [-]."""
        return None if self.identified is None else self.identified / self.known

    @property
    def status(self) -> str:
        """It contradicts if the masses differ by more than 5 %, and the interval excludes it."""
        if self.ratio is None:
            return "undetermined"
        low, high = self.interval
        if abs(self.ratio - 1.0) > AGREES:
            return "open" if low <= self.known <= high else "contradicts"
        return "verifies" if 0.5 * (high - low) <= AGREES * self.known else "open"

    @property
    def message(self) -> str:
        """Both masses, their difference, and what follows for the scale of the torques."""
        mass, ratio = self.identified or 0.0, self.ratio or 1.0
        low, high = self.interval
        errors = abs(mass - self.known) / self.std_error if self.std_error > 0 else 0.0
        return sentence_of(
            "scale:payload", what=self.status, known=self.known, link=self.link, mass=mass,
            low=low, high=high, excess=ratio - 1.0, far=self.std_error > 0, errors=errors,
            limit=AGREES, large=ratio > 1.0, ratio=ratio,
        )  # fmt: skip


@dataclass(frozen=True)
class ScaleCheck:
    """The identified gravity and masses against the URDF's."""

    #: Identified over URDF's gravity torque, by joint that gravity loads [-], and standard errors.
    gravity: Mapping[str, float] = field(default_factory=dict)
    gravity_error: Mapping[str, float] = field(default_factory=dict)
    scale: float | None = None  # over all joints, fitted with a payload [-]; None: no gravity
    factor: float = 1.0  # over all joints together, without a payload [-]
    #: Share of the identified gravity torque that one factor, and a payload, leave unexplained [-].
    unexplained: tuple[float, float] = (0.0, 0.0)
    #: Total mass of the URDF, identified total mass, mass of that payload [kg].
    masses: tuple[float, float, float] = (0.0, 0.0, 0.0)
    stated: StatedMass | None = None
    payloads: tuple[PayloadCheck, ...] = ()  # that with the narrowest interval first
    is_total_determined: bool = (
        False  # within 5 % by torque alone: a measured one verifies the scale
    )
    follows: bool = True  # the data, about as well as WLS, and not the prior
    #: Factor common to the joints' ratios and its 95 % half-width [-]; None with fewer than two.
    common: tuple[float, float] | None = None
    mass_error: float = 0.0  # standard error of the identified total mass [kg]
    assumed: int = 0  # number of links with assumed inertials: the URDF is no evidence

    @property
    def agrees(self) -> bool:
        """Whether known masses, or else gravity and total mass of the URDF, confirm the scale."""
        if self._decisive:
            return all(check.verifies for check in self._decisive)
        return self.scale is not None and self._off() <= AGREES and self.follows

    @property
    def contradicts(self) -> bool:
        """Whether a known mass, or else gravity and total mass of the URDF, contradict it."""
        # Errors of the URDF's links may explain it, or the interval of a total mass contain it.
        if self._decisive:
            return any(check.contradicts for check in self._decisive)
        if self.has_one_factor:
            return True
        before, after, payload = self.masses
        has_mass = abs(after - before) > QUANTILE * self.mass_error
        if self._is_urdf:  # gravity is no evidence, a total mass that is determined is
            least = min(abs(after - before), abs(after - payload - before))
            return has_mass and not self._is_total_open and least > _ANOTHER * before
        is_any = self._ratios_whole if has_mass else self.scale is not None
        return bool(is_any) and self._off(has_mass=has_mass) > _ANOTHER

    @property
    def is_far(self) -> bool:
        """Whether the scale is contradicted, or far from the URDF's without a known mass."""
        is_open = self.scale is not None and not (self._decisive or self.assumed)
        return self.contradicts or (is_open and self._off() > _ANOTHER)

    @property
    def _is_urdf(self) -> bool:
        """Whether the spread of the joints' ratios explains a common factor other than 1."""
        return self.common is not None and abs(self.common[0] - 1.0) <= self.common[1]

    @property
    def _known(self) -> tuple[KnownMass, ...]:
        return (*self.payloads, *(() if self.stated is None else (self.stated,)))

    @property
    def _decisive(self) -> list[KnownMass]:
        """The known masses that verify or contradict the scale."""
        return [mass for mass in self._known if mass.verifies or mass.contradicts]

    @property
    def has_one_factor(self) -> bool:
        """Whether one common factor explains gravity: the scale is wrong, not single masses."""
        by_factor, by_payload = self.unexplained
        return (
            abs(self.factor - 1.0) > max(DIFFERS, BEYOND_NOISE * by_factor)
            and by_factor < BETTER * by_payload
            and not self._is_urdf
        )

    @property
    def figures(self) -> str:
        """Gravity torque and total mass against the URDF's, as text."""
        before, after, _ = self.masses
        usual = "unloaded" if self.scale is None else "loaded"
        return sentence_of(
            "scale:figures", what="assumed" if self.assumed else usual, several=self.assumed > 1,
            assumed=self.assumed, factor=self.factor, before=before, after=after,
        )  # fmt: skip

    @property
    def message(self) -> str:
        """What was verified, or the figure that exceeds its limit, its cause and the remedy."""
        decisive = sorted(self._decisive, key=lambda mass: mass.verifies)
        beside = [mass.message for mass in reversed(self._known) if mass not in decisive]
        stated = [
            sentence_of("scale:known", done=x.verifies, kind=x.kind, text=x.message)
            for x in decisive
        ]
        if not decisive:
            stated = [self._agreement if self.agrees else self._doubt]
        text = ". ".join([stated[0], *(f"{x[0].upper()}{x[1:]}" for x in stated[1:] + beside)])
        if decisive or self.agrees or self.payloads:
            return text
        return text + sentence_of("scale:remedy", what=self.is_total_determined)

    @property
    def _agreement(self) -> str:
        """How gravity and total mass confirm the scale."""
        before, after, payload = self.masses
        return sentence_of(
            "scale:agrees", what=self._is_total_open, load=self._off_whole() > AGREES,
            payload=payload, scale=self.scale or 0.0, rest=after - payload, before=before,
            figures=self.figures,
        )  # fmt: skip

    @property
    def _doubt(self) -> str:
        """Which figures exceed which limit, and the probable cause."""
        limit = _ANOTHER if self._off() > _ANOTHER else AGREES
        beyond = [x for x, ratio in self._ratios_whole.items() if abs(ratio - 1.0) > limit]
        compared = {} if self.assumed else self.gravity
        single = [f"{j} {x:.2f}" for j, x in compared.items() if abs(x - 1.0) > _ANOTHER]
        by_factor, by_payload = self.unexplained
        is_like = self.scale is not None and abs(self.scale - 1.0) <= AGREES
        causes = {
            "factor": self.has_one_factor,
            "load": is_like and self.masses[2] > 0 and by_payload < BETTER * by_factor,
            "single": bool(single),
            "prior": not self.follows,
            "masses": bool(beyond),
            "none": True,
        }
        common, half = self.common or (1.0, 0.0)
        return sentence_of(
            "scale:doubt", figures=self.figures, beyond=("none", "one", "two")[len(beyond)],
            names=" and ".join(beyond), limit=limit, held=not self.follows,
            spread=self._is_urdf and limit > AGREES, common=common, half=half,
            cause=next(cause for cause, holds in causes.items() if holds), factor=self.factor,
            state=self.contradicts, load=self.masses[2], ratios=listed(single),
        )  # fmt: skip

    @property
    def _is_total_open(self) -> bool:
        """Whether the total mass is given, and not by torque: it does not count as identified."""
        stated = self.stated
        return stated is not None and stated.ratio is None and "total_mass" in stated.names

    @property
    def _ratios_whole(self) -> dict[str, float]:
        """Identified over URDF's gravity torque and total mass, without a payload [-]."""
        before, after, _ = self.masses
        is_open = self._is_total_open or self.assumed > 0
        mass = {} if is_open else {_TOTAL: after / before if before > 0 else np.inf}
        return ({} if self.scale is None else {"gravity torque": self.factor}) | mass

    def _off(self, *, has_mass: bool = True) -> float:
        """Return the difference of gravity and total mass, less a payload if it explains it [-]."""
        # A payload without mass is ignored: it does not determine the scale.
        before, after, payload = self.masses
        whole = self._off_whole(has_mass=has_mass)
        if not (before > 0 and payload > 0):
            return whole
        with_load = abs((self.scale or 1.0) - 1.0)
        if has_mass and not self._is_total_open:
            with_load = max(with_load, abs((after - payload) / before - 1.0))
        return min(with_load, whole)

    def _off_whole(self, *, has_mass: bool = True) -> float:
        """Return the relative difference of gravity and total mass without a payload [-]."""
        ratios = (x for key, x in self._ratios_whole.items() if has_mass or key != _TOTAL)
        return max((abs(ratio - 1.0) for ratio in ratios), default=np.inf)

    def to_dict(self) -> dict[str, Any]:
        """Return the figures as result.json has them."""
        figures = {k: list(x) if isinstance(x, tuple) else x for k, x in vars(self).items()}
        figures["stated"] = self.stated and self.stated.to_dict()
        figures["payloads"] = [x.to_dict() for x in self.payloads]
        optional = ("common", "stated", "payloads")
        figures = {key: x for key, x in figures.items() if x or key not in optional}
        return figures | {
            "is_stated": bool(self.stated), "agrees": self.agrees, "message": self.message,
        }  # fmt: skip


def check_scale(fit: Fit) -> ScaleCheck:
    """Compare gravity and masses of a result with the URDF's."""
    # A joint's ratio is g_u . g / g_u . g_u, with gravity torques g_u of the URDF, g of the result.
    model, size = fit.model, fit.model.layout.n_inertial
    before, after = (float(pi[:size:10].sum()) for pi in (fit.prior, fit.standard))
    errors = [fit.metrics(name).per_joint for name in ("estimate", "wls")]
    follows = all(
        errors[0][j].rmse <= CLEARLY * free.rmse or j in fit.overfitted
        for j, free in errors[1].items()
    )
    plain = ScaleCheck(
        masses=(before, after, 0.0), stated=stated_mass(fit), follows=follows,
        is_total_determined=determines_total_mass(fit),
    )  # fmt: skip
    if model.free_flyer:  # gravity loads its base with the whole mass
        ratio = after / before if before > 0 else 1.0
        return replace(plain, scale=ratio, factor=ratio, is_total_determined=True)
    q = np.vstack([e.recording.trajectory.q for e in fit.fitted])
    q = q[:: -(-len(q) // _POSES)]
    still = np.zeros_like(q)
    G = joint_torque_regressor(model, q, still, still).reshape(len(q), model.n_rows, -1)
    if model.loops:
        G = without_forces(loop_basis(model, q), G)
    G[:, np.isin(model.row_names, model.passive)] = 0.0  # a torque that is 0 has no scale
    last = G[:, :, size - 10 : size - 6]  # m, mcx, mcy, mcz of the last body
    by_body, G = G[:, :, :size], G[:, :, fit.mapping.independent]
    at_rest = np.arange(len(fit.prior)) < size
    of_urdf, of_result = (
        G @ fit.mapping.to_base(np.where(at_rest, pi, 0.0)) for pi in (fit.prior, fit.standard)
    )  # (N, n)
    load = np.sum(of_urdf**2, axis=0)
    if not load.any():
        return plain
    covariance = (K := fit.mapping.K * at_rest) @ fit.standard_covariance @ K.T
    gravity, error, known = {}, {}, []
    for j in np.flatnonzero(load > ZERO**2 * load.max()).tolist():
        w = of_urdf[:, j] @ G[:, j] / load[j]  # (b,), ratio = w beta
        spread = float(np.sqrt(max(w @ covariance @ w, 0.0)))
        if spread < DIFFERS:
            gravity[model.row_names[j]] = float(of_urdf[:, j] @ of_result[:, j] / load[j])
            error[model.row_names[j]] = spread
            known.append(j)
    plain = replace(plain, gravity=gravity, gravity_error=error)
    of_assumed = fit.prior[:size:10][np.isin(model.layout.bodies, assumed_masses(model))]
    if of_assumed.sum() > AGREES * before:
        return replace(plain, assumed=len(of_assumed))
    common = None
    if len(known) > 1:
        A = np.einsum("nj,njk->jk", of_urdf[:, known], by_body[:, known]) / load[known, None]
        common = common_factor(np.array([*gravity.values()]), A, fit.prior[:size])
    factor = float(np.sum(of_urdf * of_result) / load.sum())
    P, u, g = last.reshape(-1, 4), of_urdf.reshape(-1), of_result.reshape(-1)
    alone = np.linalg.lstsq(P, g - u)[0]  # (4,), a payload
    rest = [
        float(np.linalg.norm(x) / np.linalg.norm(g)) for x in (g - factor * u, g - u - P @ alone)
    ]
    scale, payload, *_ = np.linalg.lstsq(np.column_stack([u, P]), g)[0].tolist()
    return replace(
        plain, scale=scale, factor=factor, unexplained=(rest[0], rest[1]), common=common,
        masses=(before, after, max(payload, 0.0)),
        mass_error=float(np.sqrt(max(fit.standard_covariance[:size:10, :size:10].sum(), 0.0))),
    )  # fmt: skip


def common_factor(ratios: Array, sensitivity: Array, inertial: Array) -> tuple[float, float]:
    """Return the factor common to the gravity torques of joints, and its 95 % half-width [-]."""
    # Ratios r = s (1 + E e), with independent errors e of mass and of the centre of mass over the
    # radius of gyration, of one unknown deviation: generalised least squares with E E^T, Student's
    # t with one degree of freedom less than joints. Errors of the data spread the ratios, too.
    A, pi = sensitivity.reshape(len(ratios), -1, 10), inertial.reshape(-1, 10)
    second = np.trace(pseudo_inertia(inertial)[:, :3, :3], axis1=1, axis2=2)
    # mass times radius of gyration
    moment = np.sqrt(np.maximum(pi[:, 0] * second - np.sum(pi[:, 1:4] ** 2, axis=1), 0.0))
    E = np.column_stack([np.einsum("kbp,bp->kb", A, pi), *(A[:, :, i] * moment for i in (1, 2, 3))])
    L = np.linalg.cholesky(E @ E.T + TINY * np.eye(len(ratios)))
    one, r = np.linalg.solve(L, np.column_stack([np.ones(len(ratios)), ratios])).T
    factor = float(one @ r / (one @ one))
    free = len(ratios) - 1
    spread = np.linalg.norm(r - factor * one) / np.sqrt(free)
    return factor, float(scipy.special.stdtrit(free, 0.975) * spread / np.linalg.norm(one))


def stated_mass(fit: Fit) -> StatedMass | None:
    """Return the check of the masses that the user states; None without one."""
    # A range wider than +- 5 % is a bound, not a statement. So is the mass of a pinned link.
    layout, bounds = fit.model.layout, fit.estimator.bounds
    stated = {f"mass of {link}": (link, pair) for link, pair in bounds.masses.items()}
    stated |= {} if bounds.total is None else {"total_mass": ("", bounds.total)}
    names, rows, widths = [], [], []
    for name, (link, (low, high)) in stated.items():
        centre, width = 0.5 * (low + high), 0.5 * (high - low)
        if link not in bounds.pinned and centre > 0 and width <= AGREES * centre:
            masses = layout.owned_by([link]) if link else np.ones(len(layout.names), dtype=bool)
            names.append(name)
            rows.append(_are_masses(fit) * masses / centre)
            widths.append(width / centre)
    return _checked(fit, names, np.array(rows), np.array(widths)) if names else None


def determines_total_mass(fit: Fit) -> bool:
    """Return whether torque alone determines the total mass within 5 %."""
    masses = _are_masses(fit).astype(float)
    total = float(masses @ fit.standard)
    if not total > 0:
        return False
    check = _checked(fit, ["total_mass"], masses[None] / total, np.zeros(1))
    return check.ratio is not None and check.half_width <= AGREES


def _are_masses(fit: Fit) -> Array:
    """Return which standard parameters are masses, shape (p,), bool."""
    return np.array([name.endswith(".m") for name in fit.model.layout.names])


def _checked(fit: Fit, names: Sequence[str], C: Array, widths: Array) -> StatedMass:
    """Return what torque alone determines of the ratio r in C pi = r 1."""
    # Torque determines K pi = beta. Sums Z^T C of the claims that are sums M K have no free part;
    # with o = Z^T 1, r = o . M beta / o . o. In units of the spread.
    model, wls = fit.model, fit.wls
    is_pinned = model.layout.owned_by(fit.estimator.bounds.pinned)
    spread = np.where(fit.prior_std > 0, fit.prior_std, model.layout.scales(model.length))
    spread = np.where(is_pinned, 0.0, spread)  # a stated mass is not known here
    is_known = np.isfinite(np.diag(wls.covariance))
    K = fit.mapping.K[is_known]
    inverse = np.linalg.pinv(K * spread)  # (p, b)
    claims = C * spread  # (k, p)
    free = claims - claims @ inverse @ (K * spread)  # (k, p), changes no torque
    U, size, _ = np.linalg.svd(free)
    size = np.append(size, np.zeros(len(U) - len(size)))
    Z = U[:, size <= TINY * np.linalg.norm(claims)]  # (k, d)
    o = Z.sum(axis=0)
    if not np.linalg.norm(o) > TINY:
        change = np.abs(free.sum(axis=0) * spread)[: model.layout.n_inertial : 10]
        shares = change / change.sum()
        links = [x for x, part in zip(model.layout.bodies, shares, strict=True) if part > DIFFERS]
        return StatedMass(tuple(names), absorbed_by=tuple(links))
    sums = Z @ o / (o @ o)  # (k,), of the claims
    M = sums @ claims @ inverse  # (b,)
    pinned = np.where(is_pinned, fit.prior, 0.0)
    ratio = float(M @ (wls.theta[is_known] - K @ pinned) + sums @ C @ pinned)
    error = float(np.sqrt(max(M @ wls.covariance[np.ix_(is_known, is_known)] @ M, 0.0)))
    width = QUANTILE * error + float(np.abs(sums) @ widths)
    return StatedMass(tuple(names), ratio, width)
