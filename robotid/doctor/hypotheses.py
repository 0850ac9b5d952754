"""How well physics explains each torque, as stated and if something were otherwise.

A joint's torque must be a sum, with factors >= 0, of what each link it carries would load it with
by the URDF, of the inertia and the frictions of its drive, and of a constant. Masses may be wrong
by any factor; signs, columns, gravity and positions may not.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from robotid._typing import Array
from robotid.doctor.sample import Probe

__all__ = ["Explanation", "compensated", "explanations", "own_share", "unexplained"]

_FLOOR = 1e-3  # an unexplained share below this is as good as none
_POOR = 0.08  # a share above this lets other readings of the positions be tried
_CLEARLY = 2.0  # gain in misfit, a factor 7, over what needs no other position
_OFFSETS = (0.4, -0.4, np.pi / 2, -np.pi / 2, np.pi)  # [rad] that a zero position may be off
_EARTH = 9.81  # [m/s^2]
_RINGING = 0.05  # of its top, that the filter makes a torque of one sign pass 0
_TURNS = 8  # of signs and fit
_FOLDED = 0.4  # share of what is unexplained that may be left to take a torque for a size
_CONSTANT = 1e-9  # of its size: a torque that varies less does not, but for rounding


@dataclass(frozen=True)
class Explanation:
    """What would have to be otherwise, and how well the torques are explained then.

    Attributes:
        kind: "stated", "payload", "torque_sign", "unsigned_torque", "torque_order", "gravity",
            "joint_order", "joint_axis", "position_order", "position_sign" or "position_offset".
        share: Unexplained share of each torque's variance, shape (n,).
        joints: Indices of the joints concerned.
        values: "torque_order": which joint each torque column belongs to; "gravity": the vector
            [m/s^2]; "position_offset": the offset [rad].
    """

    kind: str
    share: Array
    joints: tuple[int, ...] = ()
    values: tuple[float, ...] = ()

    @property
    def misfit(self) -> float:
        """The sum of the logarithms of the unexplained shares: lower is better."""
        return float(np.sum(np.log(self.share + _FLOOR)))


def compensated(probe: Probe) -> tuple[Probe, Array]:
    """Return a motion with the URDF's gravity added to its torques, and what stays unexplained.

    Args:
        probe: The motion.

    Returns:
        The motion, and what no physics explains as shares of the variance of the torques as logged,
        shape (n,).
    """
    weight = probe.loads() - probe.loads(np.zeros(3))
    whole = replace(probe, tau=probe.tau + weight.sum(axis=2))
    size, logged = _variation(whole), _variation(probe)
    share = own_share(whole) * np.divide(size, logged, out=np.zeros_like(size), where=logged > 0)
    return whole, np.minimum(share, 1.0)


def unexplained(probe: Probe) -> Array:
    """Return which share of each torque column no physics of each joint explains.

    Args:
        probe: The motion.

    Returns:
        Shares of variance, shape (n, n, 2): torque column i, physics of joint k, with the column's
        sign as it is and reversed. 0 for a constant column.
    """
    n = len(probe.model.joints)
    own = {k: [(i, sign) for i in range(n) for sign in (1.0, -1.0)] for k in range(n)}
    return np.stack(
        [_shares(probe, k, columns).reshape(n, 2) for k, columns in own.items()], axis=1
    )


def _shares(probe: Probe, k: int, columns: Sequence[tuple[int, float]]) -> Array:
    """Return which share of torque columns, of a sign each, the physics of a joint leaves."""
    size = _variation(probe)
    R, T = _compressed(np.hstack([probe.loads()[:, k], probe.drive(k)]), probe.tau)
    left = [
        _nonnegative_misfit(R, sign * T[:, i]) / size[i] if size[i] > 0 else 0.0
        for i, sign in columns
    ]
    return np.minimum(left, 1.0)


def explanations(probe: Probe) -> tuple[Explanation, Explanation, list[Explanation]]:
    """Return how the torques are explained as stated, and by each reading that is tried.

    Args:
        probe: The motion.

    Returns:
        The reading as stated; the same with any load on the last link; and others.
    """
    share = unexplained(probe)
    own = np.diagonal(share).T  # (n, 2)
    stated = Explanation("stated", own[:, 0])
    others = [_signs(own), _unsigned(probe, own), _order(share), _gravity(probe)]
    loaded = Explanation("payload", np.minimum(own_share(probe, any_load=True), stated.share))
    if stated.share.max() > _POOR:
        # more readings are tried, and with fewer rows: one of them must be clearly better
        bound = min(e.misfit for e in [stated, *others]) - _CLEARLY
        others += [e for e in _positions(probe) if e.misfit < bound]
    return stated, loaded, others


def _signs(own: Array) -> Explanation:
    turned = np.flatnonzero(own[:, 1] < own[:, 0])
    return Explanation("torque_sign", own.min(axis=1), tuple(turned.tolist()))


def _unsigned(probe: Probe, own: Array) -> Explanation:
    """Return the torques that are never negative as sizes of torques of either sign.

    The signs are those of what physics makes of the signed torque, in turn, from those of the
    URDF's torque, of the velocity or of the acceleration on. They must explain how the size varies,
    for a constant one turned with the speed would be all friction; the share that is left counts of
    the signed torque, for the size of one that is mostly friction hardly varies.
    """
    share, joints = own[:, 0].copy(), []
    loads = probe.loads()
    for j, tau in enumerate(probe.tau.T):
        if tau.min() < -_RINGING * tau.max() or share[j] < _POOR:
            continue
        X = np.hstack([loads[:, j], probe.drive(j)])
        starts = (loads[:, j].sum(axis=1), probe.v[:, j], probe.a[:, j])
        of_size, signed = min(_folded_misfit(X, tau, np.sign(start)) for start in starts)
        if of_size < _FOLDED * own[j].min():
            share[j] = signed
            joints.append(j)
    return Explanation("unsigned_torque", share, tuple(joints))


def _folded_misfit(X: Array, tau: Array, sign: Array) -> tuple[float, float]:
    """Return what is unexplained of a torque whose signs are found in turn from a first guess.

    Returns:
        The share of the variance of the torque as logged, and of that with signs.
    """
    for _ in range(_TURNS):
        sign = np.where(_nonnegative_prediction(X, sign * tau) < 0, -1.0, 1.0)
    signed = sign * tau
    R, T = _compressed(X, signed[:, None])
    left = _nonnegative_misfit(R, T[:, 0])
    of_size, of_signed = (float(np.sum((x - x.mean()) ** 2)) for x in (tau, signed))
    return (left / of_size, left / max(of_signed, left)) if of_size > 0 else (1.0, 1.0)


def _order(share: Array) -> Explanation:
    """Return the best assignment of torque columns to joints."""
    from scipy.optimize import linear_sum_assignment

    columns, joints = linear_sum_assignment(np.log(share[:, :, 0] + _FLOOR))
    moved = tuple(np.flatnonzero(columns != joints).tolist())
    found = share[columns, joints, 0]
    return Explanation("torque_order", found, moved, tuple(joints.astype(float).tolist()))


def _gravity(probe: Probe) -> Explanation:
    """Return the direction of gravity that explains the torques best."""
    from scipy.optimize import minimize

    size = float(np.linalg.norm(probe.gravity)) or _EARTH
    n = len(probe.model.joints)

    share_in = _shares_by_gravity(probe)

    def explained(g: Array) -> Explanation:
        share = share_in(g)
        return Explanation("gravity", share, tuple(range(n)), tuple(g.tolist()))

    axes = [sign * size * axis for axis in np.eye(3) for sign in (1, -1)]
    best = min(map(explained, [probe.gravity, *axes, np.zeros(3)]), key=lambda e: e.misfit)
    start = np.array(best.values)
    if not start.any():
        return best
    # two directions across the start, on which the tangent of the tilt is measured
    _, _, frame = np.linalg.svd(start.reshape(1, 3))
    across = frame[1:]

    def tilted(x: Array) -> Explanation:
        g = start + size * x @ across
        return explained(size * g / np.linalg.norm(g))

    simplex = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]
    options = {"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-2, "maxfev": 60}
    found = minimize(lambda x: tilted(x).misfit, np.zeros(2), method="Nelder-Mead", options=options)
    return tilted(found.x)


def _shares_by_gravity(probe: Probe) -> Callable[[Array], Array]:
    """Return a function of gravity (3,): the share that own physics leaves of each torque, (n,).

    Loads are linear in gravity, so that one triangle of each joint serves for all of them.
    """
    size, links, pulls = _variation(probe), probe.loads(), probe.parts.pulls
    triangles = {}
    for j in np.flatnonzero(size > 0).tolist():
        X = [links[:, j], *pulls[:, :, j], probe.drive(j), probe.tau[:, [j]]]
        triangles[j] = np.asarray(np.linalg.qr(np.hstack(X), mode="r"))
    bodies = links.shape[2]

    def shares(g: Array) -> Array:
        share, more = np.zeros(len(size)), g - probe.gravity
        for j, R in triangles.items():
            parts = R[:, : 4 * bodies].reshape(-1, 4, bodies)
            loads = parts[:, 0] + np.tensordot(more, parts[:, 1:], axes=(0, 1))
            A, b = _compressed(np.hstack([loads, R[:, 4 * bodies : -1]]), R[:, -1:])
            share[j] = min(_nonnegative_misfit(A, b[:, 0]) / size[j], 1.0)
        return share

    return shares


def _positions(probe: Probe) -> Iterator[Explanation]:
    """Yield readings in which a position column means something else."""
    every = max(1, len(probe.rows) // 200)
    small = probe.at(probe.rows[::every])
    n = len(probe.model.joints)
    for pair in combinations(range(n), 2):
        order = [pair[1] if j == pair[0] else pair[0] if j == pair[1] else j for j in range(n)]
        state = small.q[:, order], small.v[:, order], small.a[:, order]
        moved = small.with_motion(state)
        # of joint k its own torque, and that of the joint whose position it has
        share = np.array([_shares(moved, k, [(k, 1.0), (order[k], 1.0)]) for k in range(n)])
        yield Explanation("position_order", share[:, 0], pair)
        yield Explanation("joint_order", share[order, 1], pair)
    turning = [j for j in range(n) if probe.model.joints[j] not in probe.model.layout.prismatic]
    for j in turning:
        share = own_share(small.with_motion(_moved(small, j, -1.0, 0.0)))
        yield Explanation("position_sign", share, (j,))
    for j in range(n):
        turned = small.with_motion(_moved(small, j, -1.0, 0.0))
        sign = np.where(np.arange(n) == j, -1.0, 1.0)
        yield Explanation("joint_axis", own_share(replace(turned, tau=sign * small.tau)), (j,))
    offsets = [_offset(small, j, offset) for j in turning for offset in _OFFSETS]
    if offsets:
        yield _refined(small, min(offsets, key=lambda e: e.misfit))


def _offset(probe: Probe, j: int, offset: float) -> Explanation:
    share = own_share(probe.with_motion(_moved(probe, j, 1.0, -offset)))
    return Explanation("position_offset", share, (j,), (offset,))


def _refined(probe: Probe, rough: Explanation) -> Explanation:
    """Return the offset near a rough one that explains the torques best."""
    from scipy.optimize import minimize_scalar

    j, centre = rough.joints[0], rough.values[0]
    found = minimize_scalar(
        lambda offset: _offset(probe, j, float(offset)).misfit,
        bounds=(centre - 0.4, centre + 0.4), method="bounded",
        options={"xatol": 5e-3, "maxiter": 15},
    )  # fmt: skip
    return min(rough, _offset(probe, j, float(found.x)), key=lambda e: e.misfit)


def _moved(probe: Probe, j: int, sign: float, offset: float) -> tuple[Array, Array, Array]:
    q, v, a = probe.q.copy(), probe.v.copy(), probe.a.copy()
    q[:, j] = sign * q[:, j] + offset
    v[:, j] *= sign
    a[:, j] *= sign
    return q, v, a


def own_share(probe: Probe, gravity: Array | None = None, any_load: bool = False) -> Array:
    """Return the share that each joint's own physics leaves of its torque, shape (n,).

    Args:
        probe: The motion.
        gravity: Gravity, shape (3,) [m/s^2]; the model's if None.
        any_load: Whether the last link may also have any mass more, and any centre of it, in the
            model's gravity.
    """
    loads = probe.loads(gravity)
    if any_load:
        last = probe.last_body
        loads = np.concatenate([loads, last, -last[:, :, 1:]], axis=2)
    size = _variation(probe)
    share = np.zeros(len(size))
    for j in np.flatnonzero(size > 0).tolist():
        R, T = _compressed(np.hstack([loads[:, j], probe.drive(j)]), probe.tau[:, [j]])
        share[j] = min(_nonnegative_misfit(R, T[:, 0]) / size[j], 1.0)
    return share


def _variation(probe: Probe) -> Array:
    """Return the sum of squares of each torque about its mean, 0 of a constant one, shape (n,)."""
    centred = probe.tau - probe.tau.mean(axis=0)
    is_constant = np.ptp(probe.tau, axis=0) <= _CONSTANT * np.abs(probe.tau).max(axis=0)
    size: Array = np.where(is_constant, 0.0, np.einsum("kn,kn->n", centred, centred))
    return size


def _compressed(X: Array, tau: Array) -> tuple[Array, Array]:
    """Return the triangular factor of the columns, of length 1 each, and the torques beside it."""
    size = np.linalg.norm(X, axis=0)
    used = size > 1e-9 * size.max(initial=1e-300)
    R = np.asarray(np.linalg.qr(np.hstack([X[:, used] / size[used], tau]), mode="r"))
    return R[:, : used.sum()], R[:, used.sum() :]


def _nonnegative_prediction(X: Array, tau: Array) -> Array:
    """Return what columns with factors >= 0 make of a torque, shape (N,)."""
    from scipy.optimize import nnls

    size = np.linalg.norm(X, axis=0)
    columns = X / np.where(size > 0, size, 1.0)
    predicted: Array = columns @ nnls(columns, tau)[0]
    return predicted


def _nonnegative_misfit(R: Array, tau: Array) -> float:
    from scipy.optimize import nnls

    return float(nnls(R, tau)[1] ** 2)
