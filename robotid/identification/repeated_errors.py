"""Errors of points of contact and of an IMU that repeat, which are errors of the parameters.

A force f that acts x beside the stated point adds J_w^T (x x f) to the torque, with the Jacobian
J_w of the link's rotation. Links of other lengths, feet that are deformed, or are not balls, cause
such errors. They repeat in every step: the scatter of the residual does not contain them. With the
rows D of the torque per offset along each axis, and offsets x ~ N(0, s^2) of all contacts,

    W pi = tau + J^T f + D x,

the score W^T tau has the covariance s^2 W^T D D^T W beside that of its noise. If s is not stated,
it is the one with the largest evidence. Without torques of joints an offset is like a displaced
centre of mass: s then is 2 cm, its bound.

A bias of the accelerometers acts as a change of gravity with the axes of the base. D then has the
torque per acceleration of the base. Over a log the robot hardly moves away, so its mean
acceleration in the world is that of the bias, or of a tilted orientation: it is their size, but
not which of the two.

References:
    Bishop (2006), Pattern Recognition and Machine Learning, section 9.3.4 (EM for s).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg

from robotid._typing import Array
from robotid.estimators import WLS
from robotid.fitting.recordings import Recordings, RepeatedErrors
from robotid.fitting.survey import Rows
from robotid.logs.base import in_base
from robotid.logs.data import Trajectory
from robotid.regressor.constraints import constraint_forces, contact_links, without_forces
from robotid.regressor.factors import join, triangle_of
from robotid.regressor.lapack import Triangle
from robotid.regressor.prediction import predict
from robotid.regressor.used_rows import base_problem
from robotid.robot.constraints import Contact
from robotid.robot.model import RobotModel
from robotid.robot.prior import prior_spread

__all__ = ["with_repeated_errors"]

_FIRST, _MOST = 3e-3, 0.02  # [m] initial value of s, and its bound
_WIDER = 1e3  # factor of the prior standard deviations: wrong masses of a URDF are no offsets
_STEPS, _SETTLED = 100, 1e-3  # steps of the maximisation, relative change of s at its end


def with_repeated_errors(recordings: Recordings) -> Recordings:
    """Return recordings with the covariance of the score due to contacts and accelerometers.

    Surfaces have no such errors: their moments are measured, or unknown.

    Args:
        recordings: The recordings.

    Raises:
        DataError: If a row of a log cannot be used.
    """
    model, mapping = recordings.model, recordings.mapping
    points = [k for k, x in enumerate(model.contacts) if x.kind == "point"]
    points = [k for k in points if model.contacts[k].uncertainty != 0.0]
    bases = [log.head.base for log in recordings.fitted]
    with_imu = [base is not None and base.imu is not None for base in bases]
    if not points and not any(with_imu):
        return recordings
    whole, prior = join(recordings.reduce(is_cut=False)), model.standard_parameters()
    spread = prior_spread(model, whole.squares, whole.samples)
    mean, b = mapping.to_base(prior), len(mapping.base_names)
    start = WLS(mean, recordings.share).fit(whole.factors).theta
    pi = mapping.to_standard(start, prior, spread)
    c, d = 3 * len(points), 3 * any(with_imu)
    total, drifts = Triangle(b + c + d + 1), []
    step = max(1, int(0.5 / recordings.share))  # filtered rows in between add nothing
    for log, has_imu in zip(recordings.fitted, with_imu, strict=True):
        pushed: list[Array] = []
        for piece in log.pieces:
            rows = piece.read()
            rows = replace(rows, trajectory=rows.trajectory.every(step), mask=rows.mask[::step])
            D, first = _slopes(model, rows, pi, points), 0
            if d:
                D = np.column_stack([D, has_imu * _slopes_of_bias(model, rows, pi)])
            if has_imu:
                pushed.append(_world_acceleration(rows.trajectory))
            problem = base_problem(model, mapping, rows.trajectory, rows.mask)
            for W, tau, weight in problem.blocks():
                both = np.column_stack([W, -D[first : first + len(W)], tau])
                total.fold(np.asfortranarray(both * np.sqrt(step * weight)[:, None]))
                first += len(W)
        drifts += [np.linalg.norm(np.concatenate(pushed).mean(axis=0))] if pushed else []
    stated = [model.contacts[k].uncertainty for k in points]
    count = int(whole.factors.rows.sum())
    if not whole.factors.rows[6 * model.free_flyer :].any():
        stated = [_MOST if x is None else x for x in stated]
    if None in stated:
        L = np.linalg.cholesky((mapping.K * spread**2) @ mapping.K.T)
        own = triangle_of(total.R[:, [*range(b + c), -1]])
        s = estimated_uncertainty(own, L, mean, recordings.share, count)
        stated = [s if x is None else x for x in stated]
    bias = float(np.sqrt(np.mean(np.square(drifts)))) if drifts else 0.0
    sizes = np.concatenate([np.repeat(np.array(stated, dtype=float), 3), np.full(d, bias)])
    cross = total.R[:b, :b].T @ total.R[:b, b:-1]  # -W^T D
    rest = total.R[b:-1, b:-1] * sizes  # of D, what W cannot explain
    variance = float(np.sum(rest**2)) / count
    errors = RepeatedErrors(cross * sizes, variance, float(sizes[:c].max(initial=0.0)), bias)
    return replace(recordings, repeated=errors)


def estimated_uncertainty(R: Array, L: Array, mean: Array, share: float, rows: int) -> float:
    """Return the standard deviation s of offsets with the largest evidence [m].

    The evidence is that of a much wider prior: with the stated one, parameters outside it would be
    explained by offsets.

    Args:
        R: Triangular factor of the rows [W -D tau], shape (b + d + 1, b + d + 1).
        L: Lower triangle, L L^T the prior covariance of the base parameters, shape (b, b).
        mean: Their prior values, shape (b,).
        share: Share of independent rows [-].
        rows: Number of rows.
    """
    b, d = len(mean), len(R) - 1 - len(mean)
    prior = np.zeros((b + d, b + d + 1))
    prior[:b, :b] = scipy.linalg.solve_triangular(_WIDER * L, np.eye(b), lower=True)
    prior[:b, -1] = prior[:b, :b] @ mean
    s, sigma = _FIRST, float(np.linalg.norm(R[:, -1]) / np.sqrt(rows))
    for _ in range(_STEPS):
        prior[b:, b:-1] = np.eye(d) / s
        T = triangle_of(np.vstack([R * (np.sqrt(share) / sigma), prior]))
        found = scipy.linalg.solve_triangular(T[:-1, :-1], T[:-1, -1])
        inverse = scipy.linalg.solve_triangular(T[b:-1, b:-1], np.eye(d))
        sigma = float(np.linalg.norm(R[:, -1] - R[:, :-1] @ found) / np.sqrt(max(rows - b, 1)))
        before, s = s, float(np.sqrt(np.mean(found[b:] ** 2 + np.sum(inverse**2, axis=1))))
        s = min(s, _MOST)
        if abs(s - before) < _SETTLED * before:
            break
    return s


def _slopes(model: RobotModel, rows: Rows, pi: Array, points: Sequence[int]) -> Array:
    """Return D, the rows' torque per offset of a contact, shape (N n_rows, 3 len(points)) [N].

    Args:
        model: The robot.
        rows: Its motion, and the rows used.
        pi: Standard parameters that determine the forces, shape (p,).
        points: Numbers of the contacts; their offsets have the axes of the links.
    """
    motion = rows.trajectory
    (torque,) = predict(model, [pi], replace(motion, basis=None))
    f = constraint_forces(model, motion, torque, rows.mask)
    rotation, turning = contact_links(model, motion.q)
    edges = np.cumsum([0, *(x.sizes[x.kind] for x in model.constraints)])
    first = [k for k, x in zip(edges, model.constraints, strict=False) if isinstance(x, Contact)]
    D = np.zeros((*torque.shape, 3 * len(points)))
    for i, k in enumerate(points):
        own = f[:, None, first[k] : first[k] + 3]
        if model.contacts[k].axes == "link":
            own = own @ rotation[:, k].swapaxes(1, 2)  # with the axes of the world
        moments = np.cross(rotation[:, k].swapaxes(1, 2), own)  # (N, 3, 3), one per axis
        D[:, :, 3 * i : 3 * i + 3] = turning[:, k].swapaxes(1, 2) @ moments.swapaxes(1, 2)
    if motion.basis is not None:
        D = without_forces(motion.basis, D)
    return D.reshape(torque.size, D.shape[2])  # without points there are no columns


def _slopes_of_bias(model: RobotModel, rows: Rows, pi: Array) -> Array:
    """Return the rows' torque per acceleration of the base, shape (N n_rows, 3) [N s^2/m].

    Args:
        model: The robot.
        rows: Its motion.
        pi: Standard parameters, shape (p,).
    """
    motion = replace(rows.trajectory, basis=None)
    (torque,) = predict(model, [pi], motion)
    pushed = [replace(motion, a=motion.a + np.eye(1, model.n_rows, k)) for k in range(3)]
    D = np.stack([predict(model, [pi], x)[0] - torque for x in pushed], axis=2)
    if rows.trajectory.basis is not None:
        D = without_forces(rows.trajectory.basis, D)
    return D.reshape(-1, 3)


def _world_acceleration(motion: Trajectory) -> Array:
    """Return the acceleration of the base with the axes of the world, shape (N, 3) [m/s^2]."""
    v, back = motion.v, motion.q[:, 3:7] * np.array([-1.0, -1.0, -1.0, 1.0])
    return in_base(back, motion.a[:, :3] + np.cross(v[:, 3:6], v[:, :3]))
