"""Checks of how well the model explains each torque, as stated and under other hypotheses.

They use the motion of a log at a few hundred instants, with separate parts of the model's torque.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations

import numpy as np

from robotid.base.tolerances import TINY
from robotid.base.typing import Array
from robotid.data.log import Log, Trajectory
from robotid.data.signal_settings import SignalSettings
from robotid.data.signals import process, resolve, unwrap
from robotid.data.units import AT_REST
from robotid.diagnosis.logs.channels import ZERO
from robotid.dynamics.rows import drive_values, friction_directions, friction_speeds, inertial_rows
from robotid.robot.model import GRAVITY, RobotModel

HINT = 0.7  # Decrease of the misfit from which another gravity is reported
#: Ratio of unexplained shares from which another reading is certain; as decrease of the misfit.
MUCH_BETTER = 12.0
CERTAIN = float(np.log(MUCH_BETTER))
FLOOR = 1e-3  # An unexplained share below this is negligible
_MARGIN = 0.15  # [s] rows closer to the end of a segment are not used: the filter has not settled
_SLOW = 0.05  # largest speed of the unknown sign of friction of a slow joint, over its largest
_POOR = 0.08  # unexplained share from which other readings of the positions are tested
_ROWS, _QUARTER = 200, 4  # rows of these tests, and the divisor of their number in a first pass
_OFFSETS = (0.4, -0.4, np.pi / 2, -np.pi / 2, np.pi)  # [rad] errors of a zero position
# Iterations of signs and fit; ratio of unexplained shares up to which a torque is an absolute value
_ITERATIONS, _FOLDED = 8, 0.4


@dataclass(frozen=True, eq=False)
class Probe:
    """The parts of the model's torque at N instants, linear in masses and gravity."""

    # Parts are computed at first use: whole regressors have 0.3 MB per instant for 60 joints.

    model: RobotModel
    motion: Trajectory  # The smooth motion that contains the instants
    rows: Array  # (N,), the instants as rows of the motion
    q: Array  # (N, n), joint positions [rad or m]
    v: Array  # (N, n), velocities
    a: Array  # (N, n), accelerations
    tau: Array  # (N, n), torques [N m or N]

    @classmethod
    def of(cls, model: RobotModel, motion: Trajectory, rows: Array) -> "Probe":
        """Return the probe at rows of a motion."""
        at = (x[rows] for x in (motion.q, motion.v, motion.a, motion.tau))
        return cls(model, motion, rows, *at)

    @property
    def gravity(self) -> Array:
        """Gravity of the model, shape (3,) [m/s^2]."""
        return np.array(self.model.pin_model.gravity.linear)

    @cached_property
    def _places(self) -> tuple[Array, Array]:
        """Rows and bodies of the carried columns, one entry for ten columns."""
        rows, bodies = np.nonzero(self.model.support[:, : self.model.layout.n_inertial : 10])
        return rows, bodies

    @cached_property
    def _ten(self) -> Array:
        """Columns of the ten parameters of each carried body, shape (N, bodies carried, 10)."""
        columns = inertial_rows(self.model, self.q, self.v, self.a).values.T
        return columns.reshape(len(columns), -1, 10)

    def _by_link(self, ten: Array) -> Array:
        pi = self.model.standard_parameters()[: self.model.layout.n_inertial].reshape(-1, 10)
        rows, bodies = self._places
        loads = np.zeros((*self.v.shape, len(pi)))
        loads[:, rows, bodies] = np.einsum("kbi,bi->kb", ten, pi[bodies])
        return loads

    @cached_property
    def gravity_loads(self) -> Array:
        """Torques of links at rest, per m/s^2 of gravity in x, y, z, (3, N, n, bodies)."""
        rest = np.zeros_like(self.v)
        models = [self.model.with_gravity(axis) for axis in np.eye(3)]
        columns = (inertial_rows(model, self.q, rest, rest).values.T for model in models)
        return np.array([self._by_link(x.reshape(len(x), -1, 10)) for x in columns])

    @cached_property
    def last_body(self) -> Array:
        """Columns of mass and first moments of the last body, shape (N, n, 4)."""
        rows, bodies = self._places
        is_last = bodies == self.model.layout.n_inertial // 10 - 1
        last = np.zeros((*self.v.shape, 4))
        last[:, rows[is_last]] = self._ten[:, is_last, :4]
        return last

    def loads(self, gravity: Array | None = None) -> Array:
        """Return the torque of each link by the URDF, shape (N, n, bodies): gravity (3,)."""
        if gravity is None:
            return self._links
        more = np.tensordot(gravity - self.gravity, self.gravity_loads, axes=1)
        return np.asarray(self._links + more)

    @cached_property
    def _links(self) -> Array:
        return self._by_link(self._ten)

    @cached_property
    def drives(self) -> Array:
        """Columns of the drives: a, v, sign v, 1, -1, and of coupled drives, (N, n, 5 + k)."""
        v, one = self.v, np.ones_like(self.v)
        least = AT_REST * self.model.layout.drive_speeds[: v.shape[1]]
        still = np.minimum(least, _SLOW * np.abs(v).max(axis=0))
        own = [self.a, v, np.tanh(v / np.where(still > 0, still, least)), one, -one]
        coupled = coupled_columns(self.model, self.q, v, self.a)
        return np.concatenate([np.stack(own, axis=2), coupled], axis=2)


def coupled_columns(model: RobotModel, q: Array, v: Array, a: Array) -> Array:
    """Return the regressor's columns of coupled drives, shape (N, n, k)."""
    layout, coupled = model.layout, np.flatnonzero(model.layout.is_coupled)
    if not len(coupled):
        return np.empty((*v.shape, 0))
    values = drive_values(layout, q, v, a, friction_directions(layout, v, None))
    return np.asarray(layout.drive_loads[:, coupled] * values[coupled].T[:, None])


def smooth_motion(model: RobotModel, log: Log, settings: SignalSettings) -> Trajectory:
    """Return the motion of a log with velocities and accelerations derived from its positions."""
    log = unwrap(log, np.array([joint.turns_freely for joint in model.limits]))
    settings = replace(settings, velocity="differentiated", acceleration="differentiated")
    return process(log, resolve(log, settings), friction_speeds(model.layout))


def take_probe(model: RobotModel, motion: Trajectory, *, samples: int = 500) -> Probe | None:
    """Return a probe of a motion, None if the motion is too small for any check."""
    parts = np.split(motion.t, np.flatnonzero(np.diff(motion.segment)) + 1)
    inner = np.concatenate([(t >= t[0] + _MARGIN) & (t <= t[-1] - _MARGIN) for t in parts])
    slow = AT_REST * model.layout.drive_speeds[: len(model.joints)]
    rows = np.flatnonzero((np.abs(motion.v) > slow).any(axis=1) & inner)
    if len(rows) < 50:
        return None
    chosen = np.unique(np.linspace(0, len(rows) - 1, samples).astype(int))
    return Probe.of(model, motion, rows[chosen])


@dataclass(frozen=True)
class Explanation:
    """A hypothesis on the log, and how well the torques are explained under it."""

    kind: str  # "stated", "payload", or the code of its finding
    share: Array  # (n,), unexplained share of each torque's variance
    joints: tuple[int, ...] = ()  # Indices of the joints concerned
    values: tuple[float, ...] = ()  # joint of each torque column, gravity [m/s^2], or offset [rad]

    @property
    def misfit(self) -> float:
        """The sum of the logarithms of the unexplained shares: lower is better."""
        return float(np.sum(np.log(self.share + FLOOR)))


def compensated(probe: Probe) -> tuple[Probe, Array]:
    """Return a motion with the URDF's gravity added to its torques, and its unexplained shares."""
    gravity = probe.loads() - probe.loads(np.zeros(3))
    whole = replace(probe, tau=probe.tau + gravity.sum(axis=2))
    size, logged = _variation(whole.tau), _variation(probe.tau)
    return whole, _over(own_share(whole) * size, logged)


def explanations(probe: Probe) -> tuple[Explanation, Explanation, list[Explanation]]:
    """Return how well the torques are explained as stated, and under each other hypothesis."""
    N, n = probe.tau.shape
    every = np.broadcast_to(np.hstack([probe.tau, -probe.tau]), (n, N, 2 * n))
    share = _shares(probe, every).reshape(n, 2, n).transpose(2, 0, 1)  # (column, joint, sign)
    own = np.diagonal(share).T  # (n, 2)
    stated = Explanation("stated", own[:, 0])
    negated = tuple(np.flatnonzero(own[:, 1] < own[:, 0]).tolist())
    signs = Explanation("torque_sign", own.min(axis=1), negated)
    others = [signs, _unsigned(probe, own), _order(share), _gravity(probe, stated)]
    loaded = Explanation("payload", np.minimum(own_share(probe, any_load=True), stated.share))
    if stated.share.max() > _POOR:
        others += _positions(probe, min(e.misfit for e in [stated, *others]))
    return stated, loaded, others


def _unsigned(probe: Probe, own: Array) -> Explanation:
    """Return the hypothesis that torques that are never negative are absolute values."""
    # The signs are those of the predicted torque, iterated from those of the URDF's torque, of v or
    # a. The variation of |tau| must be explained: a constant with the sign of the speed looks like
    # friction. The share refers to the signed torque: |tau| that is mostly friction hardly varies.
    share, joints = own[:, 0].copy(), []
    loads = probe.loads()
    for j, tau in enumerate(probe.tau.T):
        if tau.min() < -ZERO * tau.max() or share[j] < _POOR:
            continue
        X = np.hstack([loads[:, j], probe.drives[:, j]])
        starts = (loads[:, j].sum(axis=1), probe.v[:, j], probe.a[:, j])
        of_size, signed = min(_folded_misfit(X, tau, np.sign(start)) for start in starts)
        if of_size < _FOLDED * own[j].min():
            share[j] = signed
            joints.append(j)
    return Explanation("unsigned_torque", share, tuple(joints))


def _folded_misfit(X: Array, tau: Array, sign: Array) -> tuple[float, float]:
    """Return the unexplained shares of a torque whose signs are iterated from initial ones."""
    from scipy.optimize import nnls

    size = np.linalg.norm(X, axis=0)
    columns = X / np.where(size > 0, size, 1.0)
    for _ in range(_ITERATIONS):
        sign = np.where(columns @ nnls(columns, sign * tau)[0] < 0, -1.0, 1.0)
    signed = sign * tau
    left = float(_misfits(X[None], signed[None, :, None])[0, 0])
    of_size, of_signed = (float(np.sum((x - x.mean()) ** 2)) for x in (tau, signed))
    return (left / of_size, left / max(of_signed, left)) if of_size > 0 else (1.0, 1.0)


def _order(share: Array) -> Explanation:
    """Return the best assignment of torque columns to joints."""
    from scipy.optimize import linear_sum_assignment

    columns, joints = linear_sum_assignment(np.log(share[:, :, 0] + FLOOR))
    moved = tuple(np.flatnonzero(columns != joints).tolist())
    return Explanation("torque_order", share[columns, joints, 0], moved, tuple(joints.tolist()))


def _gravity(probe: Probe, stated: Explanation) -> Explanation:
    """Return the direction of gravity that explains the torques best."""
    # The stated one, unless any masses and gravity explain the torques better by ``HINT``.
    from scipy.optimize import minimize

    size = float(np.linalg.norm(probe.gravity) or np.linalg.norm(GRAVITY))
    joints = tuple(range(len(probe.model.joints)))
    is_stated = replace(stated, kind="gravity", joints=joints, values=tuple(probe.gravity.tolist()))
    is_poor = stated.share.max() > _POOR
    if not is_poor and stated.misfit - len(joints) * np.log(FLOOR) < HINT:
        return is_stated
    share_in, least = _shares_by_gravity(probe)
    if not is_poor and stated.misfit - Explanation("", least).misfit < HINT:
        return is_stated

    def explained(g: Array) -> Explanation:
        return Explanation("gravity", share_in(g), joints, tuple(g.tolist()))

    axes = [sign * size * axis for axis in np.eye(3) for sign in (1, -1)]
    best = min(map(explained, [probe.gravity, *axes, np.zeros(3)]), key=lambda e: e.misfit)
    start = np.array(best.values)
    if not start.any():
        return best
    # two directions orthogonal to the start; x are tangents of the tilt in these directions
    _, _, frame = np.linalg.svd(start.reshape(1, 3))
    orthogonal = frame[1:]

    def tilted(x: Array) -> Explanation:
        g = start + size * x @ orthogonal
        return explained(size * g / np.linalg.norm(g))

    simplex = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]
    options = {"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-2, "maxfev": 60}
    best_x = minimize(
        lambda x: tilted(x).misfit, np.zeros(2), method="Nelder-Mead", options=options
    ).x
    return tilted(best_x)


def _shares_by_gravity(probe: Probe) -> tuple[Callable[[Array], Array], Array]:
    """Return a function of gravity (3,): the unexplained share of each torque, (n,)."""
    # Loads are linear in gravity: one triangular factor per joint. Second, the shares that no
    # gravity and no masses of any sign reduce, (n,).
    links, size = probe.loads(), _variation(probe.tau)
    X = [links, *probe.gravity_loads, probe.drives, probe.tau[:, :, None]]
    rows = np.concatenate(X, axis=2).swapaxes(0, 1)
    R = np.asarray(np.linalg.qr(rows, mode="r"))  # (n, c, c)
    bodies = links.shape[2]
    parts = R[:, :, : 4 * bodies].reshape(*R.shape[:2], 4, bodies)

    def shares(g: Array) -> Array:
        more = g - probe.gravity
        loads = parts[:, :, 0] + np.tensordot(more, parts[:, :, 1:], axes=(0, 2))
        columns = np.concatenate([loads, R[:, :, 4 * bodies : -1]], axis=2)
        return _over(_misfits(columns, R[:, :, -1:])[:, 0], size)

    left = R[:, -1, -1] ** 2 if R.shape[1] == R.shape[2] else np.zeros(len(R))
    return shares, _over(left, size)


def _positions(probe: Probe, best: float) -> Iterator[Explanation]:
    """Yield readings with another position column, sign or zero, if one is clearly better."""
    # First with a quarter of the rows, where half of the required decrease must be reached.
    every = max(1, len(probe.rows) // _ROWS)
    some, few = (
        Probe.of(probe.model, probe.motion, probe.rows[::k]) for k in (every, _QUARTER * every)
    )
    joints = range(len(probe.model.joints))
    enough, likely = best - CERTAIN, best - 0.5 * CERTAIN
    readings: list[Callable[[Probe], list[Explanation]]] = [
        *(partial(_exchanged, pair=pair) for pair in combinations(joints, 2)),
        *(partial(_reversed, j=j) for j in joints),
    ]
    for read in readings:
        if any(e.misfit < likely for e in read(few)):
            yield from (e for e in read(some) if e.misfit < enough)
    offsets = [_offset(few, j, offset) for j in _revolute(few) for offset in _OFFSETS]
    first = min(offsets, key=lambda e: e.misfit, default=None)
    if first is not None and _refined(few, first).misfit < likely:
        near = [e for e in offsets if e.misfit < first.misfit + 0.5 * CERTAIN]
        tried = [_offset(some, e.joints[0], e.values[0]) for e in near]
        refined = _refined(some, min(tried, key=lambda e: e.misfit))
        yield from [refined] if refined.misfit < enough else []


def _revolute(probe: Probe) -> list[int]:
    """Return the revolute joints."""
    names = probe.model.joints
    return [j for j in range(len(names)) if names[j] not in probe.model.layout.prismatic]


def _exchanged(probe: Probe, pair: tuple[int, int]) -> list[Explanation]:
    """Return the readings that the positions, or all columns, of two joints are exchanged."""
    order = np.arange(len(probe.model.joints))
    order[list(pair)] = pair[::-1]
    moved = replace(probe, q=probe.q[:, order], v=probe.v[:, order], a=probe.a[:, order])
    share = _shares(moved, np.stack([probe.tau.T, probe.tau.T[order]], axis=2))
    return [
        Explanation("position_order", share[:, 0], pair),
        Explanation("joint_order", share[order, 1], pair),
    ]


def _reversed(probe: Probe, j: int) -> list[Explanation]:
    """Return the readings that the position of a joint is reversed, and its torque as well."""
    share = _shares(_moved(probe, j, -1.0, 0.0), np.stack([probe.tau.T, -probe.tau.T], axis=2))
    is_j = np.arange(len(share)) == j
    axis = Explanation("joint_axis", np.where(is_j, share[:, 1], share[:, 0]), (j,))
    sign = Explanation("position_sign", share[:, 0], (j,))
    return [sign, axis] if j in _revolute(probe) else [axis]


def _offset(probe: Probe, j: int, offset: float) -> Explanation:
    share = own_share(_moved(probe, j, 1.0, -offset))
    return Explanation("position_offset", share, (j,), (offset,))


def _refined(probe: Probe, rough: Explanation) -> Explanation:
    """Return the reading with the offset near a rough one that explains the torques best."""
    from scipy.optimize import minimize_scalar

    j, centre = rough.joints[0], rough.values[0]
    best = minimize_scalar(
        lambda offset: _offset(probe, j, float(offset)).misfit,
        bounds=(centre - 0.4, centre + 0.4), method="bounded",
        options={"xatol": 5e-3, "maxiter": 15},
    )  # fmt: skip
    return min(rough, _offset(probe, j, float(best.x)), key=lambda e: e.misfit)


def _moved(probe: Probe, j: int, sign: float, offset: float) -> Probe:
    """Return the probe with another position of a joint and the same torques."""
    only = np.arange(len(probe.model.joints)) == j
    signs = np.where(only, sign, 1.0)
    q, v, a = (signs * x for x in (probe.q, probe.v, probe.a))
    return replace(probe, q=q + offset * only, v=v, a=a)


def own_share(probe: Probe, gravity: Array | None = None, any_load: bool = False) -> Array:
    """Return the unexplained share of each joint's torque, shape (n,): gravity (3,) [m/s^2]."""
    return _shares(probe, probe.tau.T[:, :, None], gravity, any_load)[:, 0]


def _shares(
    probe: Probe, torques: Array, gravity: Array | None = None, any_load: bool = False
) -> Array:
    """Return the unexplained shares of k torques per joint, (n, N, k), shape (n, k)."""
    loads = probe.loads(gravity)
    if any_load:
        last = probe.last_body
        loads = np.concatenate([loads, last, -last[:, :, 1:]], axis=2)
    X = np.concatenate([loads, probe.drives], axis=2).swapaxes(0, 1)  # (n, N, c)
    return _over(_misfits(X, torques), _variation(torques.swapaxes(0, 1)))


def _over(left: Array, size: Array) -> Array:
    """Return sums of squares over a size, at most 1; 0 if the size is 0."""
    share = np.divide(left, size, out=np.zeros_like(size), where=size > 0)
    return np.minimum(share, 1.0)


def _variation(tau: Array) -> Array:
    """Return the sum of squares of torques (N, ...) about their mean, 0 if constant."""
    centred = tau - tau.mean(axis=0)
    is_constant = np.ptp(tau, axis=0) <= TINY * np.abs(tau).max(axis=0)
    return np.where(is_constant, 0.0, np.sum(centred**2, axis=0))


def _misfits(X: Array, torques: Array) -> Array:
    """Return the residual squares of torques, (n, N, k), by columns, (n, N, c), factors >= 0."""
    from scipy.optimize import nnls

    size = np.linalg.norm(X, axis=1, keepdims=True)
    used = size > 1e-9 * size.max(axis=2, keepdims=True, initial=1e-300)
    unit = np.divide(X, size, out=np.zeros_like(X), where=used)
    rows, c = np.concatenate([unit, torques], axis=2), X.shape[2]
    R = np.asarray(np.linalg.qr(rows, mode="r"))
    left = [[nnls(R_j[:, :c], tau)[1] for tau in R_j[:, c:].T] for R_j in R]
    return np.square(left)
