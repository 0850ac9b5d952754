"""Errors of contacts, an IMU and the motion of the base that do not average out.

A force f that acts x beside the stated point adds D x = J_w^T (x x f) to the torque, with the
Jacobian J_w of the link's rotation. Feet that deform, or are not balls, cause such errors in every
step, so that the scatter of the residual does not contain them. With offsets x ~ N(0, s^2) the
score W^T tau has the covariance s^2 W^T D D^T W beside that of its noise. If s is not given, it has
the largest evidence (Bishop 2006, Pattern Recognition and Machine Learning, section 3.5), and in
place of s^2 I all points have the mean over points of E[x x^T], given the rows. Without torques of
joints an offset is like a displaced centre of mass: s then is 2 cm.

A bias of the accelerometers acts as a change of gravity with the axes of the base; D then has the
torque per acceleration of the base. The bias is estimated together with the parameters, where the
base turns, and subtracted; the covariance D Cov(b) D^T is left in the score. Its prior size: a
robot hardly moves away, so its mean acceleration in the world is that of the bias.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from robotid.base.tolerances import CONVERGED
from robotid.base.typing import Array
from robotid.data.base_motion import in_base
from robotid.data.log import Trajectory
from robotid.dynamics.constraint_rows import constraint_forces, contact_links, without_forces
from robotid.dynamics.factors import Triangle, join, triangle_of
from robotid.dynamics.prepared_logs import base_problem
from robotid.dynamics.torque import predict
from robotid.estimation.estimators import WLS
from robotid.estimation.fitting.recorded import Recordings, RepeatedErrors, Rows
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

_LEAST, _MOST, _TRIED = 1e-6, 0.02, 40  # [m] bounds of s, values that are compared first
_WIDER = 1e3  # factor of the prior standard deviations: wrong masses of a URDF are no offsets
_STEPS = 20  # of noise level and s


def with_repeated_errors(recordings: Recordings) -> Recordings:
    """Return recordings with the score's covariance due to contacts and accelerometers."""
    # surfaces have no errors of their points: their moments are measured, or unknown
    model, mapping = recordings.model, recordings.mapping
    points = [k for k, x in enumerate(model.contacts) if x.kind == "point" and x.uncertainty != 0.0]
    bases = [log.head.base for log in recordings.fitted]
    frames = [None if base is None or base.imu is None else base.imu.frame for base in bases]
    biases = [x.offset if x.offset is not None else np.zeros(3) for x in frames if x is not None]
    if not (points or biases):
        return recordings
    whole, prior = join(recordings.reduce(is_cut=False)), model.standard_parameters()
    spread = prior_spread(model, whole.squares, whole.samples)
    mean, b = mapping.to_base(prior), len(mapping.base_names)
    start = WLS(mean, recordings.share).fit(whole.factors).theta
    pi = mapping.to_standard(start, prior, spread)
    c, d = 3 * len(points), 3 * bool(biases)
    total, drifts = Triangle(b + c + d + 1), []
    step = max(1, int(0.5 / recordings.share))  # filtered rows in between add nothing
    for log, frame in zip(recordings.fitted, frames, strict=True):
        pushed, segments = list[Array](), list[Array]()
        for piece in log.pieces:
            rows = piece.read()
            rows = replace(rows, trajectory=rows.trajectory.every(step), mask=rows.mask[::step])
            D, first = _slopes(model, rows, pi, points), 0
            if d:
                of_bias = (frame is not None) * _slopes_of_bias(model, rows, pi)
                D = np.column_stack([D, of_bias])
            if frame is not None:
                pushed.append(_world_acceleration(rows.trajectory, biases[0]))
                segments.append(rows.trajectory.segment)
            problem = base_problem(model, mapping, rows.trajectory, rows.mask)
            for W, tau, weight in problem.blocks():
                both = np.column_stack([W, -D[first : first + len(W)], tau])
                total.fold(np.asfortranarray(both * np.sqrt(step * weight)[:, None]))
                first += len(W)
        drifts += [mean_drift(np.concatenate(pushed), np.concatenate(segments))] if pushed else []
    stated = [model.contacts[k].uncertainty for k in points]
    if not whole.factors.rows[6 * model.free_flyer :].any():
        stated = [_MOST if each is None else each for each in stated]
    size = float(np.sqrt(np.mean(np.square(drifts)))) if drifts else 0.0
    before = np.concatenate([np.zeros(c), *(-x for x in biases[:1])])
    sizes = np.append(np.repeat(np.array(stated, dtype=float), 3), np.full(d, size))
    count = int(whole.factors.rows.sum())
    L = np.linalg.cholesky((mapping.K * spread**2) @ mapping.K.T)
    fit = estimated_errors(total.R, L, mean, recordings.share, count, sizes, before)
    roots = _roots(fit, sizes, c)
    rest = np.sum((total.R[b:-1, b:-1] @ roots) ** 2)  # of D, what W cannot explain
    largest = float(np.where(np.isnan(sizes), fit.size, sizes)[:c].max(initial=0.0))
    root = total.R[:b, :b].T @ total.R[:b, b:-1] @ roots  # -W^T D
    errors = RepeatedErrors(root, float(rest) / count, largest)
    if not d:
        return replace(recordings, repeated=errors)
    bias, variance = biases[0] + fit.known[c:], np.mean(np.diag(fit.covariance)[c:])
    errors = replace(errors, bias=bias, bias_error=float(np.sqrt(variance)))
    fitted, held_out = (
        [log.with_accelerometer_bias(bias) for log in logs]
        for logs in (recordings.fitted, recordings.validation)
    )
    return replace(recordings, repeated=errors, fitted=fitted, validation=held_out)


@dataclass(frozen=True, eq=False)
class EstimatedErrors:
    """Errors that repeat, as the rows of a log determine them."""

    size: float  # standard deviation s of the offsets whose size is unknown [m]; NaN if none is
    known: Array  # (d,), estimated errors of known size; the prior means of others
    covariance: Array  # (d, d), of errors of known size; 0 for others
    squares: Array  # (k, k), E[x x^T | rows] of the k offsets x whose size is unknown [m^2]


def _roots(fit: EstimatedErrors, sizes: Array, c: int) -> Array:
    """Return a root of the covariance of all errors, (d, d); unknown offsets are alike by axis."""
    roots, is_open = np.diag(sizes), np.isnan(sizes)
    if is_open.any():
        squares = fit.squares.reshape(is_open.sum() // 3, 3, -1, 3)  # of each pair of points
        V = np.einsum("ijik->jk", squares) / len(squares)
        roots[np.ix_(is_open, is_open)] = np.kron(np.eye(len(squares)), np.linalg.cholesky(V))
    roots[c:, c:] = np.linalg.cholesky(fit.covariance[c:, c:])
    return roots


def estimated_errors(
    R: Array, L: Array, mean: Array, share: float, rows: int, sizes: Array, before: Array
) -> EstimatedErrors:
    """Return the size s of offsets with the largest evidence, their squares, errors of known size.

    The evidence is that of a much wider prior: with the stated one, parameters outside it would be
    explained by offsets. With the noise level sigma of the rows, their triangle without parameters
    and errors of known size has the singular values z and the torque u along their directions:
    -2 log(evidence) is the sum of log(1 + s^2 z^2) + u^2 / (1 + s^2 z^2).
    """
    # R (b + d + 1, b + d + 1), L (b, b), prior mean of errors of known size before (d,)
    b, is_open = len(mean), np.isnan(sizes)
    some = np.flatnonzero(sizes > 0.0)
    k = b + len(some)
    R = triangle_of(R[:, [*range(b), *(b + some), *(b + np.flatnonzero(is_open)), -1]])
    prior = np.zeros((len(R) - 1, len(R)))
    prior[:b, :b] = scipy.linalg.solve_triangular(_WIDER * L, np.eye(b), lower=True)
    prior[:b, -1] = prior[:b, :b] @ mean
    prior[range(b, k), range(b, k)] = 1.0 / sizes[some]
    prior[b:k, -1] = before[some] / sizes[some]
    s, sigma = np.nan, float(np.linalg.norm(R[:, -1]) / np.sqrt(rows))
    for _ in range(_STEPS):
        last = sigma
        if is_open.any():
            T = triangle_of(np.vstack([R * (np.sqrt(share) / sigma), prior[:k]]))
            U, z, _ = np.linalg.svd(T[k:-1, k:-1])
            s = _largest(z**2, (U.T @ T[k:-1, -1]) ** 2)
            prior[range(k, len(prior)), range(k, len(prior))] = 1.0 / s
        T = triangle_of(np.vstack([R * (np.sqrt(share) / sigma), prior]))
        found = scipy.linalg.solve_triangular(T[:-1, :-1], T[:-1, -1])
        sigma = float(np.linalg.norm(R[:, -1] - R[:, :-1] @ found) / np.sqrt(max(rows - b, 1)))
        if abs(sigma - last) < CONVERGED * last:
            break
    known, covariance = before.copy(), np.zeros((len(sizes), len(sizes)))
    inverse = scipy.linalg.solve_triangular(T[b:-1, b:-1], np.eye(len(R) - 1 - b))
    known[some] = found[b:k]
    covariance[np.ix_(some, some)] = inverse[: k - b] @ inverse[: k - b].T
    squares = inverse[k - b :] @ inverse[k - b :].T + np.outer(found[k:], found[k:])
    return EstimatedErrors(s, known, covariance, squares)


def _largest(z2: Array, u2: Array) -> float:
    """Return s with the smallest sum of log(1 + s^2 z^2) + u^2 / (1 + s^2 z^2)."""
    from scipy.optimize import minimize_scalar  # takes long to import

    def loss(x: float) -> float:
        grown = 1.0 + np.exp(2.0 * x) * z2
        return float(np.sum(np.log(grown) + u2 / grown))

    grid = np.linspace(np.log(_LEAST), np.log(_MOST), _TRIED)  # more than one minimum is possible
    k = int(np.argmin([loss(x) for x in grid]))
    near = grid[max(k - 1, 0)], grid[min(k + 1, _TRIED - 1)]
    return float(np.exp(minimize_scalar(loss, bounds=near, options={"xatol": 0.1 * CONVERGED}).x))


def _slopes(model: RobotModel, rows: Rows, pi: Array, points: Sequence[int]) -> Array:
    """Return D, the rows' torque per offset of a contact, shape (N n_rows, 3 len(points)) [N]."""
    motion = rows.trajectory
    (torque,) = predict(model, [pi], replace(motion, basis=None))
    f = constraint_forces(model, motion, torque, rows.mask)
    rotation, turning = contact_links(model, motion.q)
    edges = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)])
    first = [k for k, x in zip(edges, model.constraints, strict=False) if isinstance(x, Contact)]
    D = np.zeros((*torque.shape, 3 * len(points)))
    for i, k in enumerate(points):
        force = f[:, None, first[k] : first[k] + 3]
        if model.contacts[k].axes == "link":
            force = force @ rotation[:, k].swapaxes(1, 2)  # with the axes of the world
        moments = np.cross(rotation[:, k].swapaxes(1, 2), force)  # (N, 3, 3), one per axis
        D[:, :, 3 * i : 3 * i + 3] = turning[:, k].swapaxes(1, 2) @ moments.swapaxes(1, 2)
    if motion.basis is not None:
        D = without_forces(motion.basis, D)
    return D.reshape(torque.size, D.shape[2])  # without points there are no columns


def _slopes_of_bias(model: RobotModel, rows: Rows, pi: Array) -> Array:
    """Return the rows' torque per acceleration of the base, shape (N n_rows, 3) [N s^2/m]."""
    motion = rows.trajectory
    (torque,) = predict(model, [pi], motion)
    pushed = [replace(motion, a=motion.a + np.eye(1, model.n_rows, k)) for k in range(3)]
    D = np.stack([predict(model, [pi], x)[0] - torque for x in pushed], axis=2)
    return D.reshape(-1, 3)


def _world_acceleration(motion: Trajectory, bias: Array) -> Array:
    """Return the acceleration of the base with the axes of the world, shape (N, 3) [m/s^2]."""
    v, back = motion.v, motion.q[:, 3:7] * np.array([-1.0, -1.0, -1.0, 1.0])
    return in_base(back, motion.a[:, :3] + np.cross(v[:, 3:6], v[:, :3]) + bias)


def mean_drift(a: Array, segment: Array) -> float:
    """Return the mean of an acceleration, root mean square of its three components [m/s^2].

    The mean has the weight w(t) = sin^2(pi t / T) in each segment of duration T: the speeds at its
    ends have no effect. The plain mean is their change over T, 0.05 m/s^2 for a robot that sways.
    """
    counts = np.unique(segment, return_counts=True)[1]
    w = np.concatenate([np.hanning(count + 2)[1:-1] for count in counts])
    return float(np.linalg.norm(w @ a / w.sum()) / np.sqrt(3.0))
