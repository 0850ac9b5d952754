"""Constraints on bodies beyond physical consistency: mass, centre of mass, extent, pinned links."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from robotid.base.exceptions import SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.estimation.estimators.consistent.cones import Cone, svec
from robotid.robot.parameters import ParameterLayout, pseudo_inertia, pseudo_inertia_basis

#: Lower bound of drive terms relative to their scale: rounding cannot make them negative.
SIGN_MARGIN = 1e-9
_OPEN = (0.0, np.inf)  # [kg]
_ROUNDING = 1e-9  # [kg], [m]: tolerance for a pinned body outside its bounds


@dataclass(frozen=True, eq=False)
class Constraints:
    """Bounds in addition to physical consistency, by name of the body that a joint moves.

    Attributes:
        mass: Smallest and largest mass of a body [kg].
        total_mass: Smallest and largest mass of all bodies together [kg], or None.
        com: Half-spaces A c <= b that contain the centre of mass c of a body in its own frame, by
            name: A of shape (k, 3), unit rows, and b of shape (k,) [m].
        pinned: Bodies that keep the prior's values.
        extent: Box that contains all mass of a body, by name: lower and upper corner in its own
            frame, shape (2, 3) [m]; see ``slabs``.
        relaxed: Bodies whose extent was removed because the data contradict it.
    """

    mass: dict[str, tuple[float, float]] = field(default_factory=dict)
    total_mass: tuple[float, float] | None = None
    com: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    pinned: tuple[str, ...] = ()
    extent: dict[str, Array] = field(default_factory=dict)
    relaxed: tuple[str, ...] = ()

    def without_extent(self, bodies: Iterable[str]) -> "Constraints":
        """Return the same constraints without the extents of some bodies.

        Args:
            bodies: Names of the bodies.
        """
        relaxed = tuple(body for body in self.extent if body in set(bodies))
        others = {body: box for body, box in self.extent.items() if body not in relaxed}
        return replace(self, extent=others, relaxed=(*self.relaxed, *relaxed))

    def check(self, layout: ParameterLayout, prior: Array, held: Array) -> None:
        """Check that the bounds do not contradict each other, before a solver is called.

        Args:
            layout: The standard parameters.
            prior: Their prior values, shape (p,).
            held: Known part of each body, shape (10 bodies,).

        Raises:
            SettingsError: If a body is unknown, bounds contradict each other, or a pinned body is
                outside its bounds or not physically consistent.
        """
        known = {*self.mass, *self.com, *self.extent, *self.pinned}
        unknown = sorted(known - set(layout.bodies))
        if unknown:
            raise SettingsError(
                f"constraints name {unknown}, which are not bodies of the model, wanted names of "
                f"{listed(layout.bodies)}; links connected by fixed joints are part of the body "
                "that a joint moves"
            )
        values = prior[: layout.n_inertial].reshape(-1, 10)
        parts = held.reshape(-1, 10)
        for body, (low, high) in self.mass.items():
            i = layout.bodies.index(body)
            _check_range(f"mass of {body}", low, high)
            if high < parts[i, 0]:
                raise SettingsError(
                    f"mass of {body} is at most {high:g} kg by its bound, but its links on locked "
                    f"joints alone have {parts[i, 0]:g} kg; increase the bound"
                )
        for body in self.pinned:
            i = layout.bodies.index(body)
            self._check_pinned(body, values[i], parts[i])
        if self.total_mass is not None:
            self._check_total(layout, values)

    def cone(
        self, layout: ParameterLayout, scale: Array, held: Array, shrink: Array, margin: float
    ) -> Cone:
        """Return the cone of consistent parameters x = pi / scale, without pinned bodies.

        Args:
            layout: The standard parameters.
            scale: Unit of each parameter, shape (p,).
            held: Known part of each body, shape (10 bodies,).
            shrink: Matrices T^-1/2 that make pseudo-inertias dimensionless, shape (bodies, 4, 4).
            margin: Smallest eigenvalue of T^-1/2 J T^-1/2 of a body without its known part [-].
        """
        p = len(layout.names)
        signs = np.flatnonzero(layout.is_nonnegative())
        G, h = [np.eye(p)[signs]], [np.full(len(signs), -SIGN_MARGIN)]
        labels = [f"drive_signs {layout.names[i]}" for i in signs]
        C, c, named = self._bounds(layout)
        C = C * scale
        norms = np.linalg.norm(C, axis=1)
        G.append(C / norms[:, None])
        h.append(c / norms)
        labels += named
        basis = pseudo_inertia_basis()
        S, s = [np.zeros((0, p))], [np.zeros(0)]
        for i, J_held in enumerate(pseudo_inertia(held)):
            if layout.bodies[i] in self.pinned:
                continue
            part = slice(10 * i, 10 * i + 10)
            block = np.zeros((10, p))
            block[:, part] = svec(shrink[i] @ basis @ shrink[i]).T * scale[part]
            S.append(block)
            s.append(-svec(shrink[i] @ J_held @ shrink[i] + margin * np.eye(4)))
            labels.append(f"pseudo_inertia {layout.bodies[i]}")
        return Cone(np.vstack(G), np.concatenate(h), np.vstack(S), np.concatenate(s), tuple(labels))

    def equalities(self, layout: ParameterLayout, prior: Array) -> tuple[Array, Array]:
        """Return the equalities E pi = e: pinned bodies, and masses given as one value.

        Args:
            layout: The standard parameters.
            prior: Their prior values, shape (p,).

        Returns:
            E, shape (k, p), and e, shape (k,).
        """
        p = len(layout.names)
        pinned = [i for i, body in enumerate(layout.bodies) if body in self.pinned]
        fixed = [10 * i + k for i in pinned for k in range(10)]
        E, e = [np.eye(p)[fixed]], [prior[fixed]]
        for body, (low, high) in self.mass.items():
            i = layout.bodies.index(body)
            if low == high and i not in pinned:
                E.append(np.eye(p)[[10 * i]])
                e.append(np.array([low]))
        if self.total_mass is not None and np.ptp(self.total_mass) == 0:
            E.append(_all_masses(layout)[None])
            e.append(np.array([self.total_mass[0]]))
        return np.vstack(E), np.concatenate(e)

    def _bounds(self, layout: ParameterLayout) -> tuple[Array, Array, list[str]]:
        """Return C, c and labels of the rows C pi + c >= 0 of bounds that are ranges."""
        p = len(layout.names)
        rows: list[Array] = []
        constants: list[float] = []
        labels: list[str] = []

        def add(row: Array, low: float, high: float, label: str) -> None:
            if low == high:
                return
            for sign, bound in ((1.0, low), (-1.0, high)):
                if np.isfinite(bound):
                    rows.append(sign * row)
                    constants.append(-sign * bound)
                    labels.append(label)

        for body, (low, high) in self.mass.items():
            if body not in self.pinned:
                add(np.eye(p)[10 * layout.bodies.index(body)], low, high, f"mass {body}")
        if self.total_mass is not None:
            add(_all_masses(layout), *self.total_mass, "total_mass all")
        for body, (A, b) in self.com.items():
            if body in self.pinned:
                continue
            i = layout.bodies.index(body)
            for normal, distance in zip(A, b, strict=True):
                row = np.zeros(p)
                row[10 * i] = distance
                row[10 * i + 1 : 10 * i + 4] = -normal
                rows.append(row)
                constants.append(0.0)
                labels.append(f"centre_of_mass {body}")
        for body, box in self.extent.items():
            if body in self.pinned:
                continue
            i = layout.bodies.index(body)
            for Q in slabs(box):
                row = np.zeros(p)
                row[10 * i : 10 * i + 10] = np.einsum("kij,ij->k", pseudo_inertia_basis(), Q)
                rows.append(row)
                constants.append(0.0)
                labels.append(f"extent {body}")
        return np.array(rows).reshape(-1, p), np.array(constants), labels

    def _check_pinned(self, body: str, values: Array, held: Array) -> None:
        (J,) = pseudo_inertia(values - held)
        if np.linalg.eigvalsh(J)[0] <= 0:
            raise SettingsError(
                f"{body} is pinned, but its inertial in the URDF is not physically consistent; "
                "correct it, or remove the link from 'pinned'"
            )
        low, high = self.mass.get(body, _OPEN)
        if not low - _ROUNDING <= values[0] <= high + _ROUNDING:
            raise SettingsError(
                f"{body} is pinned at the URDF's {values[0]:g} kg, outside its bounds "
                f"[{low:g}, {high:g}] kg; remove the link from 'pinned' or from 'mass'"
            )
        if body in self.com:
            A, b = self.com[body]
            centre = values[1:4] / values[0]
            beyond = float((A @ centre - b).max())
            if beyond > _ROUNDING:
                raise SettingsError(
                    f"{body} is pinned, but the URDF's centre of mass "
                    f"{np.round(centre, 4).tolist()} m is {1e3 * beyond:.1f} mm outside its "
                    "bounds; remove the link from 'pinned' or widen the bounds"
                )

    def _check_total(self, layout: ParameterLayout, values: Array) -> None:
        low, high = self.total_mass or _OPEN
        _check_range("total_mass", low, high)
        bounds = np.array(
            [
                [values[i, 0]] * 2 if body in self.pinned else self.mass.get(body, _OPEN)
                for i, body in enumerate(layout.bodies)
            ]
        )
        least, most = bounds.sum(axis=0)
        if high < least - _ROUNDING or low > most + _ROUNDING:
            raise SettingsError(
                f"total_mass is bounded by [{low:g}, {high:g}] kg, but the bounds of the bodies "
                f"and pinned masses allow [{least:g}, {most:g}] kg; correct the bounds"
            )


def slabs(box: Array) -> Array:
    """Return the matrices Q_k, shape (3, 4, 4), with tr(J Q_k) >= 0 for all mass inside a box.

    Every mass element with x_k between the corners l and u has (x_k - l_k) (u_k - x_k) >= 0; the
    integral over the body is tr(J Q_k). Together with J >= 0 it bounds the centre of mass and the
    radii of gyration by the box.

    References:
        Wensing, Kim, Slotine (2018), Linear Matrix Inequalities for Physically Consistent Inertial
        Parameter Identification, (12), with an ellipsoid that is a slab.

    box (2, 3) [m].
    """
    Q = np.zeros((3, 4, 4))
    for k, (low, high) in enumerate(box.T.tolist()):
        Q[k, k, k] = -1.0
        Q[k, k, 3] = Q[k, 3, k] = 0.5 * (low + high)
        Q[k, 3, 3] = -low * high
    return Q


def _all_masses(layout: ParameterLayout) -> Array:
    row = np.zeros(len(layout.names))
    row[: layout.n_inertial : 10] = 1.0
    return row


def _check_range(what: str, low: float, high: float) -> None:
    if not low <= high:
        raise SettingsError(
            f"{what} is bounded by [{low:g}, {high:g}] kg: the first value is larger than the "
            "second; write the smaller one first"
        )
    if high <= 0:
        raise SettingsError(f"{what} is bounded by {high:g} kg, wanted a positive bound")
