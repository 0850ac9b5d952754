"""Readings of the torques of a log: another meaning of its channels that explains them, if any.

A reading changes channels of the log or numbers of the URDF: a sign, an order, a zero, an axis, a
clock, a gain, gravity. The torques of a few hundred instants are predicted under each reading by
bodies near the URDF's and by drives, and readings are compared by

    misfit = sum over joints of log(squared residual / squared variation of the torque),

minus twice the logarithm of the likelihood per instant if the noise of each joint is unknown. The
bodies may differ from the URDF's by ten times their size: no error of masses is another reading.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np

from robotid.base.typing import Array
from robotid.diagnosis.decisions import BETTER, EXACT, TENFOLD, ZERO
from robotid.diagnosis.logs.probe import Probe, drive_columns
from robotid.dynamics.constraint_rows import constraint_jacobian, force_basis, without_forces
from robotid.dynamics.rows import inertial_rows, joint_constants
from robotid.robot.model import GRAVITY, RobotModel
from robotid.robot.prior import prior_spread

CERTAIN = 2.0  # decrease of the misfit from which another reading is certain
_ALIKE = 1.0  # difference of misfits below which two readings explain a log equally well
EXPLAINED = 0.1  # unexplained share of a torque below which a reading explains it
_POOR = 0.0005  # unexplained share of a torque from which other readings are tried ...
_GROSS = 0.05  # ... and from which other directions of the axes are tried
_LOOSE = 10.0  # prior deviation of the bodies, in sizes of the URDF's
_FEW = 24  # instants with which the readings are chosen that are tried with all
_SEGMENTS = 8  # of the log that are held out in turn
_BODIES = 20  # of a limb, at most
_TRIED = 10  # readings that are tried with all instants
_TILT = 0.35  # tangent of the angle of a base that is not level
OFFSET = 0.4  # [rad] of a zero position
QUARTERS = (0.0, np.pi / 2, -np.pi / 2, np.pi)  # around which zero positions are searched
_DRIVE = 4  # columns of a drive: offset, armature, viscous and Coulomb friction


def limbs(model: RobotModel) -> list[tuple[Array, bool]]:
    """Return groups of joints that are explained together, and whether other readings are tried."""
    # Those that carry few bodies, connected by these bodies or by contacts; last those with more.
    joints = np.arange(model.n_rows - len(model.joints), model.n_rows)
    carries = model.support[:, : model.layout.n_inertial : 10]
    if model.constraints:
        return [(joints, carries.shape[1] <= _BODIES)]
    is_few = carries[joints].sum(axis=1) <= _BODIES
    groups = [(branch, True) for branch in _branches(model, joints[is_few])]
    return groups + ([] if is_few.all() else [(joints[~is_few], False)])


def _branches(model: RobotModel, joints: Array) -> list[Array]:
    """Return groups of joints that carry a body together, as of each leg."""
    from scipy.sparse.csgraph import connected_components

    carries = model.support[joints, : model.layout.n_inertial : 10]
    count, label = connected_components(carries @ carries.T)
    return [joints[label == k] for k in range(count)]


@dataclass(frozen=True, eq=False)
class _Motion:
    """N instants of a motion and torque columns, and what a robot predicts of a limb's joints."""

    model: RobotModel
    q: Array  # (N, n) [rad or m]; of a floating base (N, 1 + n), with n rows, 6 of them of the base
    v: Array  # (N, n)
    a: Array  # (N, n)
    tau: Array  # (N, n) [N m or N], columns as logged
    size: Array  # (n,), squared variation of each of them, 0 if constant
    rows: Array  # (m,), the limb's joints
    contacts: Array  # (N, k), those that may touch the ground
    spread: Array  # (p,), prior deviations of the bodies
    gravity: Array  # (n,), factor of the torque of gravity on each joint
    inertia: Array  # (n,), factor of the torque of inertia on each joint
    clock: float = 1.0  # speed of the time stamps
    segments: int = _SEGMENTS  # of the instants

    @cached_property
    def products(self) -> Array:
        """P^T P of each segment and joint: P = [bodies, drive, URDF's torque, columns of tau]."""
        # Rows without unknown forces of contacts contain the drives of all joints.
        X, pi = self.inertial(), self.model.standard_parameters()[self.moved]
        reach, rows, (N, n) = self.reach, self.rows, self.tau.shape
        if (self.gravity != 1.0).any() or (self.inertia != 1.0).any():
            weight = replace(self, clock=0.0).inertial()
            gravity, inertia = (x[reach, None] for x in (self.gravity, self.inertia))
            X = inertia * (X - weight) + gravity * weight
        k = len(self.model.joints)
        every = drive_columns(self.model, self.q, self.v[:, -k:], self.a[:, -k:])
        level = np.sqrt(np.mean(self.tau**2, axis=0).max())
        every *= level / (np.sqrt(np.mean(every**2, axis=0)) + EXACT)
        drive = np.zeros((N, n, every.shape[2]))
        drive[:, n - k :] = every
        coupled, drive = drive[:, reach, _DRIVE:], drive[:, rows, :_DRIVE]
        bodies = (X * self.spread[self.moved])[..., self.spread[self.moved] > 0.0]
        logged = np.repeat(self.tau[:, None], len(rows), axis=1)
        if self.basis is not None:
            drive = np.einsum("kjd,ji->kidj", drive, np.eye(n)[rows]).reshape(N, n, -1)
            logged = self.tau[:, None] * np.eye(n)
        P = np.concatenate([bodies, coupled, drive, (X @ pi)[..., None], logged], axis=2)
        P = (P if self.basis is None else without_forces(self.basis, P)[:, rows]).swapaxes(0, 1)
        edges = [i * N // self.segments for i in range(self.segments + 1)]
        parts = [P[:, i:k] for i, k in pairwise(edges)]
        return np.array([part.swapaxes(1, 2) @ part for part in parts])  # (K, m, c, c)

    @cached_property
    def basis(self) -> Array | None:
        """Basis of the torques of forces of contacts, measured or not; None without contacts."""
        if not self.model.constraints:
            return None
        J = constraint_jacobian(self.model, self.q, self.contacts)
        return force_basis(J, np.ones(self.v.shape, dtype=bool))

    @property
    def variation(self) -> Array:
        """Squared variation of each torque, without unknown forces, (n,); 0 if constant."""
        tau = self.tau if self.basis is None else without_forces(self.basis, self.tau)
        squares = np.sum((tau - tau.mean(axis=0)) ** 2, axis=0)
        return np.where(squares > EXACT**2 * np.sum(self.tau**2, axis=0), squares, 0.0)

    @cached_property
    def reach(self) -> Array:
        """The limb's joints, or all rows if forces of contacts connect them."""
        return np.arange(self.tau.shape[1]) if self.model.constraints else self.rows

    @cached_property
    def moved(self) -> Array:
        """Places of the parameters of bodies that the limb moves."""
        moves = self.model.support[self.reach, : len(self.spread)]
        return np.flatnonzero(moves.any(axis=0))

    def inertial(self) -> Array:
        """Return the columns of the limb's bodies, shape (N, m, p)."""
        every = inertial_rows(self.model, self.q, self.clock * self.v, self.clock**2 * self.a)
        X = np.zeros((len(self.q), len(self.reach), len(self.spread)))
        for k, j in enumerate(self.reach):
            X[:, k, every.columns[j]] = every.values[every.first[j] : every.first[j + 1]].T
        return X[..., self.moved]


@dataclass(frozen=True, eq=False)
class Samples:
    """A motion, and the columns that are read as the torques of its joints."""

    motion: _Motion
    order: Array  # (n,), torque column of each joint
    sign: Array  # (n,), of the torque of each joint
    gain: Array  # (n,), torque as logged over the torque of the joint

    @classmethod
    def of(cls, probe: Probe, rows: Array, moves: Array) -> "Samples":
        """Return the samples of a log as it is; torques of joints that do not move count as 0."""
        one, model = np.ones(probe.tau.shape[1]), probe.model
        spread = prior_spread(model, np.ones((3, model.n_rows)), 1)[: model.layout.n_inertial]
        at = probe.q, probe.v, probe.a, probe.tau, one
        motion = _Motion(model, *at, rows, probe.contacts, _LOOSE * spread, one, one)
        motion = replace(motion, size=moves * motion.variation)
        return cls(motion, np.arange(len(one)), one, one)

    def few(self, count: int = _FEW) -> "Samples":
        """Return some of the instants, in one segment, with bodies nearer the URDF's."""
        step = max(1, len(self.motion.q) // count)
        some = {x: getattr(self.motion, x)[::step] for x in ("q", "v", "a", "tau", "contacts")}
        few = self.changed(segments=1, spread=self.motion.spread / _LOOSE, **some)
        few = few.changed(size=(self.motion.size > 0.0) * few.motion.variation)
        # so few that bodies explain a torque that they do not explain in all instants
        is_explained = (self.share > _GROSS) & (few.share < BETTER * self.share)
        return self.few(2 * count) if is_explained.any() and step > 1 else few

    def changed(self, **values: Any) -> "Samples":  # noqa: ANN401
        """Return the samples with other values of the motion or of the robot."""
        return replace(self, motion=replace(self.motion, **values))

    @property
    def unsigned(self) -> tuple[int, ...]:
        """The joints of the limb with torques that vary and are never negative."""
        m = self.motion
        low, high = m.tau.min(axis=0), m.tau.max(axis=0)
        is_unsigned = (m.size > 0.0) & (low >= -ZERO * high) & (m.basis is None)  # standing legs
        return tuple(j for j in m.rows.tolist() if is_unsigned[self.order[j]])

    @cached_property
    def _problem(self) -> tuple[Array, Array]:
        """Products of columns and torque of each segment and joint, and the variation (m,)."""
        m, rows = self.motion, self.motion.rows
        G, k = m.products, len(rows)
        c = G.shape[-1] - m.tau.shape[1] - 1  # place of the URDF's torque
        gain = self.gain[rows]
        one = np.repeat(gain[:, None], _DRIVE, axis=1)
        drives, on = (one, np.eye(k)) if m.basis is None else (np.tile(gain, (k, _DRIVE)), 1.0)
        scale = np.ones((k, c))
        scale[:, c - drives.shape[1] :] /= drives
        read = np.full((k, m.tau.shape[1] + 1), -1.0)  # factors of it and of torque columns
        read[:, 1:] = 0.0
        read[:, 1 + self.order[rows]] = on * self.sign[rows] / gain
        b = G[..., c:] @ read[..., None]  # (K, m, C, 1)
        made = np.empty((*G.shape[:2], c + 1, c + 1))
        made[..., :c, :c] = G[..., :c, :c]
        if (gain != 1.0).any():
            made[..., :c, :c] *= scale[:, :, None] * scale[:, None]
        made[..., :c, c] = made[..., c, :c] = scale * b[..., :c, 0]
        made[..., c, c] = (read[:, None] @ b[..., c:, :])[..., 0, 0]
        return made, m.size[self.order[rows]] / gain**2

    @cached_property
    def share(self) -> Array:
        """Unexplained share of each torque of the limb, fitted to all instants, (m,)."""
        products, size = self._problem
        whole = products.sum(axis=0) if len(products) > 1 else products[0]
        return _over(_left(whole, _fitted(self.motion, whole, size)), size)

    @cached_property
    def held_out(self) -> Array:
        """Unexplained share of each torque of the limb in segments that are held out, (m,)."""
        products, size = self._problem
        whole, left = products.sum(axis=0), np.zeros(len(size))
        for segment in products:
            left += _left(segment, _fitted(self.motion, whole - segment, size))
        return _over(left, size)

    @property
    def urdf_size(self) -> Array:
        """Sum of squares of the torque of the URDF's bodies on each joint, (m,)."""
        c = -self.motion.tau.shape[1] - 1
        return np.asarray(self.motion.products[..., c, c].sum(axis=0))

    @property
    def is_possible(self) -> bool:
        """Whether no torque is in a scale that only bodies almost without mass explain."""
        rows, gain = self.motion.rows, self.gain[self.motion.rows]
        size = np.sum(self.motion.tau**2, axis=0)[self.order[rows]] / gain**2
        return not ((gain != 1.0) & (TENFOLD**2 * size < self.urdf_size)).any()

    @property
    def unexplained(self) -> Array:
        """The same share of torques with their signs, at most 1, (m,)."""
        m, own = self.motion, self.order[self.motion.rows]
        return np.minimum(_over(self.held_out * m.size[own], m.variation[own]), 1.0)


def misfit(share: Array) -> float:
    """Return the sum of the logarithms of unexplained shares: lower is better."""
    return float(np.sum(np.log(np.minimum(share, 1.0) + EXACT)))


def _over(left: Array, size: Array) -> Array:
    return np.divide(left, size, out=np.zeros_like(left), where=size > 0.0)


def _left(products: Array, x: Array) -> Array:
    """Return the squared residual of each joint: products (m, c + 1, c + 1), x (m, c)."""
    x = np.concatenate([x, -np.ones((len(x), 1))], axis=1)[:, None]
    return np.asarray(np.maximum((x @ products @ x.swapaxes(1, 2))[:, 0, 0], 0.0))


def _fitted(motion: _Motion, products: Array, size: Array) -> Array:
    """Return parameters of the bodies, near 0, and of the drives, none negative, shape (m, c)."""
    # The noise of each joint in the second fit is the residual of the first.
    from scipy.linalg.lapack import dpotrf, dtrtrs
    from scipy.optimize import nnls

    m, c = len(products), products.shape[1] - 1
    is_projected = motion.basis is not None  # each row has the drives of all joints
    p = c - _DRIVE * (m if is_projected else 1)
    offset, first = p + np.arange(m), p + m
    friction = first + np.arange((_DRIVE - 1) * m).reshape(m, -1)
    own = np.column_stack([offset, friction])  # (m, 4)
    every = np.tile(np.arange(c), (m, 1))  # places of the columns of each row
    every = every if is_projected else np.column_stack([every[:, :p], own])
    noise, x = EXPLAINED * size, np.zeros((m, c))
    A, b = np.zeros((p + _DRIVE * m,) * 2), np.zeros(p + _DRIVE * m)
    for _ in range(2):
        weight = len(motion.q) / np.where(size > 0.0, noise + EXACT * size, np.inf)
        total = np.tensordot(weight, products, axes=1)  # of the bodies, which the joints share
        if is_projected:
            A[:], b[:] = total[:c, :c], total[:c, c]
        else:
            drives = weight[:, None, None] * products[:, p:c]
            A[:p, :p], b[:p] = total[:p, :p], total[:p, c]
            A[own, :p], b[own] = drives[..., :p], drives[..., c]
            A[own[:, :, None], own[:, None]] = drives[..., p:c]
        np.fill_diagonal(A, (1.0 + EXACT**2) * np.diagonal(A) + 1.0)
        L = dpotrf(A, lower=True)[0]
        y = dtrtrs(L, b, lower=True)[0]
        d = nnls(L[first:, first:].T, y[first:])[0]
        rest = y[:first] - d @ L[first:, :first]
        z = dtrtrs(L[:first, :first], rest, lower=True, trans=1)[0]
        x = np.append(z, d)[every]
        noise = _left(products, x)
    return x


@dataclass(frozen=True)
class Reading:
    """Another meaning of channels or of numbers of the URDF."""

    code: str  # of its finding
    joints: tuple[int, ...]  # concerned; (): all of them
    apply: Callable[..., Samples]  # the samples so read, from samples and values
    values: tuple[float, ...] = ()  # sizes that the torques determine, as a start
    step: float = 0.0  # of the search for them

    def of(self, samples: Samples) -> Samples:
        """Return samples so read."""
        return self.apply(samples, *self.values)

    def started(self, samples: Samples) -> Iterator["Reading"]:
        """Yield the reading of one value at which parabolas through three shares are low."""
        low, high = (self.apply(samples, x).share for x in (-self.step, self.step))
        before, slope = samples.share, 0.5 * (high - low)
        curvature, weight = 0.5 * (high + low) - before, 1.0 / (before + EXACT)
        least = weight @ curvature
        x = float(-0.5 * (weight @ slope) / least if least > 0.0 else -np.sign(weight @ slope))
        x = float(np.clip(x, -TENFOLD, TENFOLD))  # a parabola holds near its three points
        lowest = np.maximum(before + slope * x + curvature * x**2, 0.0)
        if misfit(before) - misfit(lowest) > _ALIKE:
            yield replace(self, values=(self.step * x,))

    def refined(self, samples: Samples, most: int) -> "Reading":
        """Return the reading with the values that explain the torques best."""
        from scipy.optimize import minimize

        if not self.step:
            return self
        x = np.array(self.values)
        best = minimize(
            lambda x: misfit(self.apply(samples, *x).share), x, method="Nelder-Mead",
            options={
                "initial_simplex": np.vstack([x, x + self.step * np.eye(len(x))]),
                "xatol": 0.01 * self.step, "fatol": 0.01, "maxfev": most * len(x),
            },
        )  # fmt: skip
        return replace(self, values=tuple(best.x.tolist()))


def readings(samples: Samples, is_gross: bool) -> Iterator[Reading]:
    """Yield the readings that are tried, general ones before special ones."""
    m, model = samples.motion, samples.motion.model
    n, rows, every = model.n_rows, m.rows.tolist(), tuple[int, ...]()
    turning = [j for j in rows if model.row_names[j] not in model.layout.prismatic]
    one, place = np.eye(n), np.eye(m.q.shape[1])[-n:]  # of a row, and of its position
    g = np.array(model.pin_model.gravity.linear)
    up = -g / (float(np.linalg.norm(g)) or 1.0)
    yield Reading("torque_sign", every, partial(_negated, on=np.ones(n)))
    axes = [sign * axis for axis in np.eye(3) for sign in (1, -1)]
    tilted = [_TILT * axis - up for axis in axes if abs(axis @ up) < 0.5 and g.any()]
    for start in (*axes, *tilted):
        if not np.allclose(start, -up):
            yield Reading("gravity", every, _falling, tuple(start.tolist()), 0.1)
    if g.any():
        yield Reading("gravity_compensated", every, partial(_weightless, on=np.ones(n)))
        yield Reading("static_torque", every, lambda s: s.changed(inertia=np.zeros(n)))
        for j in rows:
            yield Reading("gravity_compensated", (j,), partial(_weightless, on=one[j]))
    timed = Reading("time_scale", every, lambda s, x: s.changed(clock=m.clock * np.exp(x)), (), 0.3)
    yield from (replace(timed, values=(float(np.log(x)),)) for x in (0.1, 0.5, 2.0, 10.0))
    branches, singles = [tuple(x.tolist()) for x in _branches(model, m.rows)], [(j,) for j in rows]
    legs = branches if len(branches) > 1 else []
    for i, k in combinations((legs if is_gross else ()) if legs else singles, 2):
        if len(i) == len(k):
            moved = np.arange(n)
            moved[[*i, *k]] = *k, *i
            order = tuple(moved.tolist())
            yield Reading("torque_order", i + k, partial(_reordered, order=order))
            yield Reading("position_order", i + k, partial(_exchanged, order=order))
            yield Reading("joint_order", i + k, lambda s, o=order: _reordered(_exchanged(s, o), o))
    for group in [*singles, *legs]:
        yield Reading("torque_sign", group, partial(_negated, on=one[list(group)].sum(axis=0)))
    for j in rows if is_gross or not legs else ():
        yield Reading(
            "joint_axis", (j,), lambda s, j=j: _negated(_multiplied(s, -2.0, (j,)), one[j])
        )
        if j in turning:
            yield Reading("position_sign", (j,), partial(_multiplied, more=-2.0, joints=(j,)))
    for group in (samples.unsigned, *zip(samples.unsigned, strict=True)):
        yield Reading("unsigned_torque", group, partial(_signed, joints=group))
    wrists = [tuple(rows[first:]) for first in range(1, len(rows) - 1)]
    alike = zip(*legs, strict=True) if len({len(x) for x in legs}) == 1 else ()  # as all knees
    for group in [tuple(rows), *alike, *singles, *(legs or wrists)]:
        named, on = group if len(group) < len(rows) else every, one[list(group)].sum(axis=0)
        scaled = Reading("current_for_torque", named, partial(_scaled, on=on), (), 0.3)
        yield from scaled.started(samples)
        at = np.isin(rows, group)
        if m.basis is None and samples.urdf_size[at].any():  # by the ratio to the URDF's torques
            ratio = np.sum(m.tau[:, m.rows[at]] ** 2) / samples.urdf_size[at].sum()
            yield replace(scaled, values=(0.5 * float(np.log(ratio + EXACT)),))
    for group in [(every, turning)] if m.basis is None else [((j,), (j,)) for j in turning]:
        wide = partial(_multiplied, joints=tuple(group[1]))
        yield from Reading("angle_scale", group[0], wide, (), 0.1).started(samples)
    for j in turning:
        shifted = Reading("position_offset", (j,), partial(_shifted, on=place[j]), (), 0.1)
        zeros = (replace(shifted, values=(x,)) for x in (*QUARTERS[1:], OFFSET, -OFFSET))
        yield from zeros if m.basis is None else shifted.started(samples)
    for j in turning if is_gross else ():
        for turned in _quarters(model, j):
            yield Reading("axis_direction", (j,), lambda s, x=turned: s.changed(model=x))


def _negated(samples: Samples, on: Array) -> Samples:
    return replace(samples, sign=samples.sign * (1.0 - 2.0 * on))


def _falling(samples: Samples, *direction: float) -> Samples:
    """Return the samples with gravity in another direction."""
    model, g = samples.motion.model, np.array(direction)
    size = np.linalg.norm(model.pin_model.gravity.linear) or np.linalg.norm(GRAVITY)
    return samples.changed(model=model.with_gravity(size * g / np.linalg.norm(g)))


def _weightless(samples: Samples, on: Array) -> Samples:
    return samples.changed(gravity=samples.motion.gravity * (1.0 - on))


def _scaled(samples: Samples, log_gain: float, on: Array) -> Samples:
    return replace(samples, gain=samples.gain * np.exp(log_gain * on))


def _shifted(samples: Samples, offset: float, on: Array) -> Samples:
    return samples.changed(q=samples.motion.q - offset * on)


def _reordered(samples: Samples, order: tuple[int, ...]) -> Samples:
    if samples.motion.basis is not None:  # columns of all joints enter each row
        return samples.changed(tau=samples.motion.tau[:, order])
    return replace(samples, order=samples.order[list(order)], sign=samples.sign[list(order)])


@lru_cache(maxsize=1)  # for two readings
def _exchanged(samples: Samples, order: tuple[int, ...]) -> Samples:
    """Return the samples with the positions of joints in another order."""
    return _moved(samples, lambda x: x[:, order])


@lru_cache(maxsize=1)  # for two readings
def _multiplied(samples: Samples, more: float, joints: tuple[int, ...]) -> Samples:
    """Return the samples with the motion of joints multiplied by 1 + more."""
    factor = 1.0 + more * np.isin(np.arange(samples.motion.v.shape[1]), joints)
    return _moved(samples, lambda x: factor * x)


def _moved(samples: Samples, change: Callable[[Array], Array]) -> Samples:
    """Return the samples with another motion of the joints: positions as the rows are numbered."""
    m = samples.motion
    extra = m.q.shape[1] - m.v.shape[1]  # of the pose of a floating base
    q = np.hstack([m.q[:, :extra], change(m.q[:, extra:])])
    return samples.changed(q=q, v=change(m.v), a=change(m.a))


def _quarters(model: RobotModel, j: int) -> Iterator[RobotModel]:
    """Yield robots with the axis of a joint turned by a quarter, alone or with what it carries."""
    axis = joint_constants(model.pin_model, model.pin_model.getJointId(model.row_names[j]))[-3:]
    for about, quarter, is_carried in product(np.eye(3), (1, -1), (False, True)):
        if abs(about @ axis) < 0.5:
            rotation = np.outer(about, about) + quarter * np.cross(about, np.eye(3))
            yield model.with_turned_axis(model.row_names[j], rotation, is_carried)


def _signed(samples: Samples, joints: tuple[int, ...]) -> Samples:
    """Return the samples with the signs of torques that bodies and drives of the URDF predict."""
    tau = samples.motion.tau.copy()
    for j in joints:
        tau[:, samples.order[j]] = _with_sign(samples, j)
    return samples.changed(tau=tau)


def _with_sign(samples: Samples, j: int) -> Array:
    """Return the torque of a joint with the signs that bodies and drives of the URDF predict."""
    # They are iterated from the signs of the bodies' torque, of v and of a.
    from scipy.optimize import nnls

    m, column = samples.motion, samples.order[j]
    own, size = replace(m, rows=np.array([j])), np.abs(m.tau[:, column])
    bodies = own.inertial()[:, 0] @ m.model.standard_parameters()[own.moved]
    X = np.column_stack([bodies, drive_columns(m.model, m.q, m.v, m.a)[:, j]])
    X /= np.linalg.norm(X, axis=0) + EXACT
    tried = []
    for sign in (np.sign(bodies), np.sign(m.v[:, j]), np.sign(m.a[:, j])):
        for _ in range(_TRIED):
            x, left = nnls(X, sign * size)
            sign = np.where(X @ x < 0.0, -1.0, 1.0)
        tried.append((left, sign))
    return np.asarray(size * min(tried, key=lambda x: x[0])[1])


@dataclass(frozen=True, eq=False)
class Best:
    """A reading that explains the torques of a limb, together with those before it."""

    reading: Reading
    alike: tuple[Reading, ...]  # others that explain them about as well
    samples: Samples  # so read
    gain: float  # decrease of the misfit by it
    before: Array  # (m,), unexplained shares without it
    after: Array  # (m,), and with it


def best_readings(samples: Samples) -> Iterator[Best]:
    """Yield the readings that explain the torques of a limb, each the best after those before."""
    while (best := _best(samples)) is not None:
        yield best
        samples = best.samples


def _best(samples: Samples) -> Best | None:
    """Return the reading that explains the torques of a limb best, None if none does certainly."""
    few = samples.few()
    if few.share.max() < _POOR:
        return None
    spread = np.where(np.arange(len(few.motion.spread)) % 10 < 4, few.motion.spread, 0.0)
    fewer = few.changed(spread=spread)  # parameters: masses and first moments
    every = enumerate(readings(fewer, bool(few.share.max() > _GROSS)))
    gains = [(misfit(fewer.share) - misfit(r.of(fewer).share), i, r) for i, r in every]
    starts = {(r.code, r.joints): (gain, i, r) for gain, i, r in sorted(gains, key=lambda x: x[0])}
    tried = sorted((x for x in starts.values() if x[0] > _ALIKE), key=lambda x: -x[0])[:_TRIED]
    refined = [(r, r.of(samples), i) for _, i, x in tried for r in [x.refined(few, 8)]]
    left = {r: (misfit(x.share), i) for r, x, i in refined if x.is_possible}
    if not left:
        return None
    close = [r for r in left if left[r][0] < min(left.values())[0] + _ALIKE]
    # the simplest first; of one kind, that which needs bodies nearest the URDF's
    near = few.changed(spread=few.motion.spread / _LOOSE)
    kind = {r.code: left[r][1] for r in sorted(close, key=lambda r: left[r][1], reverse=True)}
    by_bodies = {r: misfit(r.of(near).share) for r in close}
    alike = sorted(close, key=lambda r: (len(r.joints), kind[r.code], by_bodies[r]))
    best = alike[0].refined(few, 20)
    read = best.of(samples)
    gain = misfit(samples.held_out) - misfit(read.held_out)
    if min(gain, misfit(samples.share) - misfit(read.share)) < CERTAIN or not read.is_possible:
        return None
    return Best(best, tuple(alike[1:]), read, gain, samples.unexplained, read.unexplained)
