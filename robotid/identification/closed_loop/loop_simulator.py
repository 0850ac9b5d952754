"""Free parameters of drives, loops and bodies, their simulator, and further ones to first order.

The residual is linear in a candidate: one roll-out with the sensitivities of all candidates gives
the residual of held-out windows after a fit to the other windows (cross-validation), and the scale
of the gains that bodies and torques indicate.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.linalg

from robotid.base.exceptions import NotConvergedError
from robotid.base.tolerances import SLACK
from robotid.base.typing import Array
from robotid.data.signals import local_polynomial
from robotid.diagnosis.decisions import AGREES, BEYOND_NOISE, SIMULATED_FAMILY, Round
from robotid.dynamics.simulation.loops import (
    ClosedLoopRobot,
    Column,
    Loops,
    RollOut,
    Window,
    negative_friction,
)
from robotid.estimation.estimators.estimator import Estimate
from robotid.estimation.estimators.output_error import (
    OutputError,
    Residual,
    is_at_bound,
    linearised,
)
from robotid.estimation.fitting.fit import FOLDS
from robotid.robot.drive_term import ANYWHERE, DriveTerm
from robotid.robot.drives import FAMILIES, LoadFriction, PositionCoulomb
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.robot.prior import with_assumed_inertials

#: Largest delay that is tried [s].
LONGEST_DELAY = 0.1
POSITIVE = ("kp", "limit")  # parameters whose lower bound is more than 0

_WHOLE = 0.15  # distance from a whole lag below which the lag is whole [samples]
_SMOOTH = 0.02  # half-width of the differentiating filter [s]
_FREE = 0.95  # torque relative to the limit, below which the drive is not saturated
_STARTS = 2  # steps of the initial states of windows
_SHARES = (1.0, 0.3, 0.1)  # step lengths that are tried
_NEAR = 3.0  # prior of an initial position about the measured one [RMS position errors]
#: Entries of a body's triangle: the logarithm of the root of its mass, and its centre.
_ENTRIES = ((3, 3), (0, 3), (1, 3), (2, 3))
_OFFERED = ("stribeck", "load", "position")  # candidate families of friction terms
_SLOW = 0.3  # Stribeck speed of candidates, over the typical speed of the joint
_WIDE = 0.05  # smallest half-range of a position-dependent candidate [rad or m]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class DriveTorques:
    """Torques of drives at the counted samples of a roll-out; arrays of shape (N, n)."""

    unlimited: Array  # kp position_error + kd speed_error + tau_ref [N m or N]
    position_error: Array  # q_ref - q, times the log's factor of kp [rad or m]
    speed_error: Array  # v_ref - v, times the log's factor of kd [rad/s or m/s]
    loops: Loops  # the loops with the gains of the log, and the torque limits

    @property
    def limited(self) -> Array:
        """The torque within the limits of the drives [N m or N]."""
        return np.asarray(np.clip(self.unlimited, -self.loops.limit, self.loops.limit))

    def slopes(
        self,
        joints: Array,
        columns: Sequence[tuple[int, Column]],
        motion: Array,
        kinds: Mapping[str, int],
    ) -> Array:
        """Return derivatives of torques, (N, k, c); delays only change the motion, (N, 2k, c)."""
        k, kp, kd = len(joints), self.loops.kp[joints, None], self.loops.kd[joints, None]
        change: Array = -kp * motion[:, :k] - kd * motion[:, k:]
        at_limit = np.abs(self.unlimited) >= self.loops.limit
        by_kind = {
            kinds["kp"]: self.position_error * ~at_limit,
            kinds["kd"]: self.speed_error * ~at_limit,
            kinds["limit"]: np.sign(self.unlimited) * at_limit,
        }
        change[at_limit[:, joints]] = 0.0
        for c, (kind, joint, _) in columns:
            if kind in by_kind:
                change[:, joints == joint, c] += by_kind[kind][:, [joint]]
        return change


def drive_torques(out: RollOut, loops: Loops, lag: Array) -> DriveTorques:
    """Return the torques of the drives along a roll-out: lag (n,) [samples]."""
    log, rows = out.window.log, np.arange(out.window.first, out.window.stop)
    sent = rows[:, None] - np.ceil(lag).astype(int)  # before the log: its first command
    later = np.ceil(lag) - lag
    q_ref, v_ref, tau_ref = (
        np.zeros(out.q.shape)
        if x is None
        else sum(
            share * np.take_along_axis(x, np.clip(row, 0, len(x) - 1), axis=0)
            for share, row in ((1.0 - later, sent), (later, sent + 1))
        )
        for x in (log.q_ref, log.v_ref, log.tau_ref)
    )
    error, speed_error = log.gain_factors[:, None] * np.stack([q_ref - out.q, v_ref - out.v])
    unlimited = loops.kp * error + loops.kd * speed_error + tau_ref
    return DriveTorques(unlimited, error, speed_error, loops.of(log))


def measured_motion(window: Window) -> RollOut:
    """Return a window's measured motion in the form of a roll-out."""
    q, t = (x[window.counted] for x in (window.log.q, window.log.t))
    dt = float(np.median(np.diff(t)))
    wide = min(2 * max(2, round(_SMOOTH / dt)) + 1, len(t) - 1 + len(t) % 2)
    v = local_polynomial(q, wide, min(2, wide - 1), derivative=1, step=dt)
    return RollOut(window, q, v)


def find_gains(
    outs: Sequence[RollOut], loops: Loops, is_free: Array, *, knows_delay: bool, is_whole: bool
) -> tuple[Array, Loops]:
    """Return the lag of measured torques, (n,) [samples], and the loops with fitted gains."""
    # A fractional lag, as of torques averaged over a row, needs a significant improvement: commands
    # are constant over a row, and the torque of a stiff loop jumps between rows.
    dt = float(np.median(np.diff(outs[0].window.log.t)))
    delayed = np.ceil(loops.delay / dt - 1e-6)
    # a known delay is that of a row at most one row away
    around = (
        range(-1, 2) if knows_delay else range(-int(delayed.min()), 1 + round(LONGEST_DELAY / dt))
    )
    tries = np.array([np.maximum(delayed + rows, 0.0) for rows in around])
    costs = np.array([_fit_gains(outs, loops, is_free, lag)[0] for lag in tries])
    lag, least = tries[np.argmin(costs, axis=0), np.arange(len(delayed))], costs.min(axis=0)
    rows, whole = sum(len(out.q) for out in outs), lag.copy()
    for side in () if is_whole else (-1.0, 1.0):  # the cost is a parabola towards the next row
        half, next_ = (
            _fit_gains(outs, loops, is_free, np.maximum(whole + side * x, 0.0))[0]
            for x in (0.5, 1.0)
        )
        bend, slope = 2 * (least + next_ - 2 * half), 4 * half - 3 * least - next_
        share = np.clip(-slope / np.maximum(2 * bend, 1e-300), 0.0, 1.0)
        gain = -(slope + bend * share) * share
        is_between = (gain > BEYOND_NOISE**2 * least / rows) & (share > _WHOLE)
        lag = np.where(is_between, whole + side * share, lag)
    gains = _fit_gains(outs, loops, is_free, lag)[1]
    kp, kd = np.where(gains > 0, gains, [loops.kp, loops.kd])
    return lag, replace(loops, kp=kp, kd=kd)


def _fit_gains(
    outs: Sequence[RollOut], loops: Loops, is_free: Array, lag: Array
) -> tuple[Array, Array]:
    """Return the squared torque residuals, (n,), and the gains of least squares, (2, n)."""
    torques = [drive_torques(out, loops, lag) for out in outs]
    unlimited, error, speed_error = (
        np.concatenate([getattr(torque, name) for torque in torques])
        for name in ("unlimited", "position_error", "speed_error")
    )
    tau = np.concatenate([out.window.log.tau[out.window.counted] for out in outs])
    squares, gains = np.zeros(len(lag)), np.stack([loops.kp, loops.kd])
    for j, is_fitted in enumerate(is_free.T):
        free = np.abs(tau[:, j]) < _FREE * loops.limit[j]
        A = np.column_stack([error[free, j], speed_error[free, j]])[:, is_fitted]
        b = (tau - unlimited)[free, j]
        more = np.linalg.lstsq(A, b, rcond=None)[0] if is_fitted.any() else np.zeros(0)
        gains[is_fitted, j] += more
        squares[j] = np.sum((b - A @ more) ** 2)
    return squares, gains


@dataclass(frozen=True, eq=False)
class FreeParameter:
    """A free parameter of one joint, or of several joints that share it."""

    name: str  # such as ``"elbow.armature"``; of several joints, ``"calf.armature"``
    #: "armature", "kp", "kd", "limit", "delay", "zero", "term", or "body": a coordinate of
    #: the difference between a body and the URDF's.
    what: str
    joints: tuple[int, ...]  # their indices
    prior: float
    spread: float  # prior standard deviation; inf without a prior
    lowest: float = -np.inf
    highest: float = np.inf
    term: DriveTerm | None = None  # the friction term
    coordinate: int = 0  # number of a body's coordinate, 0 to 3

    @classmethod
    def of_term(
        cls, owner: str, term: DriveTerm, joints: tuple[int, ...], prior: float, spread: float
    ) -> "FreeParameter":
        """Return the parameter of a friction term, with the bounds of the term."""
        lowest = 0.0 if term.is_nonnegative else -np.inf
        name = f"{owner}.{term.name}"
        return cls(name, "term", joints, prior, spread, lowest, term.highest, term)


def free_body_parameters(robot: ClosedLoopRobot, spread: float) -> list[FreeParameter]:
    """Return free parameters of bodies relative to the URDF, four each, with prior 0.

    J' = U T T' U' with U U' the URDF's pseudo-inertia, and T the unit matrix except its last
    column, (c, exp m). Every value is a physically consistent body with the same distribution about
    its centre (Rucker, Wensing 2022, Smooth parameterization of rigid-body inertia, (12)-(14)).
    """
    layout = robot.model.layout
    J = pseudo_inertia(robot.model.standard_parameters()[: layout.n_inertial])
    # a body may change if it is possible and is not at the limit of it
    is_possible = [low > SLACK * high for low, *_, high in np.linalg.eigvalsh(J)]
    bodies = zip(layout.bodies, robot.joint_of_body, is_possible, strict=True)
    return [
        FreeParameter(f"{name}.{what}", "body", (joint,), 0.0, spread, coordinate=k)
        for name, joint, is_free in bodies
        if is_free  # a massless frame or an inconsistent body of the URDF stays fixed
        for k, what in enumerate(("mass", "cx", "cy", "cz"))
    ]


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """Torque rows of logs, reduced: R [K pi, 1] is their residual, weighted to unit noise."""

    model: RobotModel  # the robot with the standard parameters pi
    R: Array  # triangular factor, shape (b + 1, b + 1)
    K: Array  # base parameters of standard ones, shape (b, p)


@dataclass(frozen=True, eq=False)
class LoopSimulator:
    """A robot in closed loop with free parameters and windows of logs, for an estimator."""

    robot: ClosedLoopRobot
    windows: tuple[Window, ...]
    base: Loops  # values of the loops; the free parameters replace theirs
    free_parameters: tuple[FreeParameter, ...]
    torque: TorqueRows | None = None  # of measured torques along the measured motion
    velocities: bool = False  # whether measured velocities are compared in addition to positions
    #: Lag of each torque after its command, shape (n,) [samples], as in ``drive_torques``;
    #: None if torques of roll-outs are not compared.
    lag: Array | None = None
    #: The robot with smaller steps, whose roll-outs are compared; derivatives are those of
    #: ``robot``. None: ``robot`` itself.
    fine: ClosedLoopRobot | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(free.name for free in self.free_parameters)

    @cached_property
    def body_of(self) -> dict[int, int]:
        """The index of the body of each joint."""
        return {joint: body for body, joint in enumerate(self.robot.joint_of_body)}

    @cached_property
    def prior(self) -> Array:
        return np.array([free.prior for free in self.free_parameters])

    @cached_property
    def prior_std(self) -> Array:
        return np.array([free.spread for free in self.free_parameters])

    @cached_property
    def bounds(self) -> Array:
        bounds = [(free.lowest, free.highest) for free in self.free_parameters]
        return np.array(bounds).reshape(-1, 2).T

    def loops(self, theta: Array) -> Loops:
        """Return bodies, drives and loops at given values of the free parameters: theta (c,)."""
        base, changed = self.base, dict[str, Any]()
        for free, value in zip(self.free_parameters, theta, strict=True):
            if free.what == "body":
                continue
            name, places = free.what, list(free.joints)
            if free.term is not None:
                name, places = "values", [base.place(j, free.term) for j in free.joints]
            changed.setdefault(name, getattr(base, name).copy())[places] = value
        return replace(base, bodies=self._bodies(theta)[0], **changed)

    def with_better_start(self, theta: Array) -> "LoopSimulator":
        """Return the simulator with fitted initial states: with friction, their errors last."""
        n, loops, columns = len(self.base.kp), self.loops(theta), self._starts()
        windows = [replace(window, first=window.start_row) for window in self.windows]
        for _ in range(_STARTS):
            outs = self.robot.roll_out(loops, windows, columns)
            errors = np.concatenate([_error(out) for out in outs])
            sigma = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), 1e-12)
            best = [float(np.sum((_error(out) / sigma) ** 2)) for out in outs]
            changes = [_better_start(out, sigma) for out in outs]
            at_rest = [np.stack([w.around, np.zeros(n)]) for w in windows]
            corrected = list(zip([w.start for w in windows], changes, strict=True))
            tries = [at_rest, *([q + share * x for q, x in corrected] for share in _SHARES)]
            left = list(range(len(windows)))  # without a corrected start that is better
            for starts in tries:
                tried = {k: replace(windows[k], given=starts[k]) for k in left}
                try:
                    outs = (self.fine or self.robot).roll_out(loops, list(tried.values()))
                except NotConvergedError:
                    continue  # these starts cannot be simulated; others can
                for k, out in zip(tried, outs, strict=True):
                    cost = float(np.sum((_error(out) / sigma) ** 2))
                    if cost < best[k]:
                        best[k], windows[k] = cost, tried[k]
                if starts is not at_rest:
                    left = [k for k in left if windows[k] is not tried[k]]
        both = zip(self.windows, windows, strict=True)
        return replace(self, windows=tuple(replace(w, given=new.start) for w, new in both))

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return the derivatives and residuals of the torque rows; see ``Simulator``."""
        if self.torque is None:
            return np.zeros((0, len(theta))), np.zeros(0)
        R, K = self.torque.R, self.torque.K
        pi, slopes = self.standard(self.torque.model, theta)
        return R[:, :-1] @ (K @ slopes), R[:, -1] - R[:, :-1] @ (K @ pi)

    def torque_mismatch(self, theta: Array) -> Array:
        """Return the RMS torque error of roll-outs over the larger torque, logged or not, (n,)."""
        if self.lag is None:
            return np.zeros(len(self.base.kp))
        loops = self.loops(theta)
        logged = np.concatenate([w.log.tau[w.counted] for w in self.windows])
        outs = (self.fine or self.robot).roll_out(loops, self.windows)
        error = logged - np.concatenate([drive_torques(o, loops, self.lag).limited for o in outs])
        size = np.maximum(np.mean(logged**2, axis=0), np.mean((logged - error) ** 2, axis=0))
        return np.asarray(np.sqrt(np.mean(error**2, axis=0) / np.maximum(size, 1e-300)))

    def standard(self, model: RobotModel, theta: Array) -> tuple[Array, Array]:
        """Return a robot's standard parameters, shape (p,), and their derivatives, shape (p, c)."""
        layout, loops = model.layout, self.loops(theta)
        place, pi = {}, np.zeros(len(layout.names))
        pi[: layout.n_inertial] = loops.bodies.reshape(-1)
        for i, (d, term) in enumerate(layout.drive_parameters, start=layout.n_inertial):
            j = model.joints.index(layout.drives[d].name)
            place[j, "armature" if term.is_inertia else term] = i
            if term.is_inertia:
                pi[i] = loops.armature[j]
            elif term in loops.terms[j]:
                pi[i] = loops.values[loops.place(j, term)]
        slopes = np.zeros((len(pi), len(theta)))
        changes = iter(self._bodies(theta)[1])
        for k, free in enumerate(self.free_parameters):
            if free.what == "body":
                first = 10 * self.body_of[free.joints[0]]
                slopes[first : first + 10, k] = next(changes)
                continue
            for j in free.joints:
                row = place.get((j, free.term or free.what))
                if row is not None:
                    slopes[row, k] = 1.0
        return pi, slopes

    def residuals(
        self, theta: Array, *, with_slopes: bool, with_starts: bool = False
    ) -> list[Residual]:
        """Return measured minus simulated outputs, window by window; see ``Simulator``."""
        loops, (_, directions) = self.loops(theta), self._bodies(theta)
        columns = self._columns(loops) if with_slopes else []
        if with_starts:
            columns += [(len(theta) + k, column) for k, column in enumerate(self._starts())]
        rolls = with_slopes or with_starts
        if not rolls or self.fine is not None:
            outs = (self.fine or self.robot).roll_out(loops, self.windows)
        if not rolls:
            errors, none = [self._error(out, loops) for out in outs], np.array([], dtype=int)
            return [Residual(e, None, np.arange(e.shape[1]), none) for e in errors]
        coarse = self.robot.roll_out(
            loops, self.windows, [column for _, column in columns], directions,
            owners=[owner for owner, _ in columns],
            with_speeds=self.velocities or self.lag is not None,
        )  # fmt: skip
        errors = [self._error(out, loops) for out in (coarse if self.fine is None else outs)]
        return [
            part
            for out, error in zip(coarse, errors, strict=True)
            for part in self._parts(out, error, loops, columns)
        ]

    @property
    def knows_torques(self) -> bool:
        """Whether measured torques are fitted, along the measured motion or along roll-outs."""
        return self.torque is not None or self.lag is not None

    def _error(self, out: RollOut, loops: Loops) -> Array:
        """Return measured minus simulated positions, speeds, torques, shape (N, outputs)."""
        counted, parts = out.window.counted, [_error(out)]
        if self.velocities:
            parts.append(out.window.log.v[counted] - out.v)  # type: ignore[index]
        if self.lag is not None:
            simulated = drive_torques(out, loops, self.lag).limited
            parts.append(out.window.log.tau[counted] - simulated)
        return np.asarray(np.hstack(parts))

    def _parts(
        self, out: RollOut, error: Array, loops: Loops, columns: list[tuple[int, Column]]
    ) -> Iterator[Residual]:
        """Yield the residuals of a roll-out's parts with their derivatives."""
        n, free_parameters = len(loops.kp), len(self.free_parameters)
        torques = None if self.lag is None else drive_torques(out, loops, self.lag)
        for joints, places, slopes in out.slopes:
            k = len(joints)
            parts = [slopes[:, :k], *([slopes[:, k:]] if self.velocities else [])]
            if torques is not None:
                place = {int(owner): c for c, owner in enumerate(places)}
                by = [(place[owner], column) for owner, column in columns if owner in place]
                parts.append(torques.slopes(joints, by, slopes, self.robot.kinds))
            slopes = np.concatenate(parts, axis=1)
            outputs = np.concatenate([joints + n * i for i in range(len(parts))])
            free = places[places < free_parameters]  # initial states follow
            by_start = slopes[:, :, len(free) :]
            yield Residual(error[:, outputs], slopes[:, :, : len(free)], outputs, free, by_start)

    def _starts(self) -> list[Column]:
        """Return the columns of the initial positions and speeds of windows."""
        kinds, n = self.robot.kinds, len(self.base.kp)
        return [(kinds[what], j, 0) for what in ("start", "speed") for j in range(n)]

    def _columns(self, loops: Loops) -> list[tuple[int, Column]]:
        """Return the columns of the sensitivities, each with the index of its free parameter."""
        kinds, columns, body = self.robot.kinds, [], 0
        for k, free in enumerate(self.free_parameters):
            for j in free.joints:
                index = 0
                if free.term is not None:
                    index = loops.place(j, free.term)
                elif free.what == "body":
                    index, body = body, body + 1
                columns.append((k, (kinds[free.what], j, index)))
        return columns

    @cached_property
    def _roots(self) -> Array:
        """Upper triangular root U of the pseudo-inertia of each free body, shape (n, 4, 4)."""
        roots = np.zeros((len(self.base.bodies), 4, 4))
        J = pseudo_inertia(self.base.bodies.reshape(-1))
        for body in {self.body_of[u.joints[0]] for u in self.free_parameters if u.what == "body"}:
            roots[body] = np.linalg.cholesky(J[body, ::-1, ::-1])[::-1, ::-1]
        return roots

    def _bodies(self, theta: Array) -> tuple[Array, Array]:
        """Return the bodies, (n, 10), and their derivatives by each coordinate, (D, 10)."""
        bodies, directions = self.base.bodies.copy(), []
        by_body: dict[int, list[tuple[tuple[int, int], float]]] = {}
        for free, value in zip(self.free_parameters, theta, strict=True):
            if free.what == "body":
                entries = by_body.setdefault(self.body_of[free.joints[0]], [])
                entries.append((_ENTRIES[free.coordinate], float(value)))
        for body, entries in by_body.items():
            U, T = self._roots[body], np.eye(4)
            for (row, column), value in entries:
                T[row, column] = np.exp(value) if row == column else value
            bodies[body] = inertial_from_pseudo_inertia(U @ T @ T.T @ U.T)
            for (row, column), _ in entries:
                change = np.zeros((4, 4))
                change[row, column] = T[row, column] if row == column else 1.0
                half = U @ change @ T.T @ U.T
                directions.append(inertial_from_pseudo_inertia(half + half.T))
        return bodies, np.array(directions).reshape(-1, 10)


def with_terms(model: RobotModel, loops: Loops) -> RobotModel:
    """Return the model extended by the terms of loops that it lacks."""
    own = dict(model.layout.own)
    for joint, terms in zip(model.joints, loops.terms, strict=True):
        if more := [term for term in terms if term not in terms_of(model, joint)]:
            own[joint] = (*own.get(joint, ()), *more)
    extended = RobotModel.from_urdf(model.tree, **{**model.options, "own_terms": own})
    return with_assumed_inertials(extended)


def terms_of(model: RobotModel, joint: str) -> list[DriveTerm]:
    """Return the drive terms that the model has of a joint."""
    layout = model.layout
    return [term for d, term in layout.drive_parameters if layout.drives[d].name == joint]


def _better_start(out: RollOut, sigma: Array) -> Array:
    """Return the first-order correction of the initial position and speed, shape (2, n)."""
    # the prior is the measured state, within some position errors and the typical speed
    log = out.window.log
    speed = np.sqrt(np.mean((np.diff(log.q, axis=0) / np.diff(log.t)[:, None]) ** 2, axis=0))
    spread = np.maximum(np.concatenate([_NEAR * sigma, speed]), 1e-9)
    change = np.zeros(2 * len(sigma))
    for joints, places, slopes in out.slopes:
        b = (_error(out)[:, joints] / sigma[joints]).reshape(-1)
        A = (slopes / sigma[joints, None]).reshape(b.size, -1) * spread[places]
        A, b = np.vstack([A, np.eye(len(places))]), np.concatenate([b, np.zeros(len(places))])
        change[places] = spread[places] * np.linalg.lstsq(A, b, rcond=None)[0]
    return change.reshape(2, -1)


def _error(out: RollOut) -> Array:
    return np.asarray(out.window.log.q[out.window.counted] - out.q)


@dataclass(frozen=True)
class Tried:
    """A candidate of a joint that was tried."""

    joint: str
    terms: tuple[str, ...]  # names of its terms
    gain: float  # reduction of the joint's squared residual in held-out windows [-]
    is_chosen: bool  # whether it is chosen
    dropped: str = ""  # why it was dropped after a fit with it, else empty


def candidates(simulator: LoopSimulator, torque: Array) -> list[tuple[FreeParameter, ...]]:
    """Return the candidate friction terms of each joint: torque (n,) [N m or N]."""
    model = simulator.robot.model
    measured = [w.log.q[w.counted] for w in simulator.windows]
    dt = float(np.median(np.diff(simulator.windows[0].log.t)))
    q, v = (np.concatenate(x) for x in (measured, [np.gradient(x, dt, axis=0) for x in measured]))
    sets = []
    for j, joint in enumerate(model.joints):
        low, high, speed = q[:, j].min(), q[:, j].max(), float(np.sqrt(np.mean(v[:, j] ** 2)))
        if speed <= 0.0:
            continue
        data_range, half = {"q": (float(low), float(high)), "v": ANYWHERE}, (high - low) / 2
        for family in map(FAMILIES.__getitem__, _OFFERED):
            terms = family.make(data_range, *[_SLOW * speed for _ in family.shapes])
            if half <= _WIDE and any(term.guards == "q" for term in terms):
                continue
            free_parameters = []
            for term in terms:
                size = half**term.order if isinstance(term, PositionCoulomb) else 1.0
                spread = 1.0 if isinstance(term, LoadFriction) else torque[j] / size
                free_parameters.append(FreeParameter.of_term(joint, term, (j,), 0.0, spread))
            sets.append(tuple(free_parameters))
    return sets


def choose(
    simulator: LoopSimulator,
    theta: Array,
    offered: Sequence[tuple[FreeParameter, ...]],
    estimator: OutputError,
) -> list[Tried]:
    """Return which candidates lower the residual of held-out windows, greedily by joint."""
    joints = simulator.robot.model.joints
    if len(simulator.windows) == 1:
        _log.warning(
            "further friction terms are not tried: the logs have 1 window to fit, and "
            "cross-validation needs at least 2. Record a longer log, or set a shorter window in "
            "[estimator]"
        )
    place = {name: k for k, name in enumerate(simulator.names)}
    sets = [[place[free.name] for free in free_parameters] for free_parameters in offered]
    (H, g, rows), least = _folds(simulator, theta, estimator), simulator.bounds[0] - theta
    columns = sorted({*range(len(theta))}.difference(*sets))
    remaining, chosen = set(range(len(sets))), set[int]()
    gains: dict[int, float] = {}
    while remaining:
        left: dict[int, dict[int, Array]] = {}  # by joint, of each of its candidates
        for s, removed in _gains(H, g, columns, {s: sets[s] for s in remaining}, least).items():
            left.setdefault(offered[s][0].joints[0], {})[s] = -removed
        rounds = [Round(np.zeros(len(H)), of_joint, len(H), rows) for of_joint in left.values()]
        gains |= {s: round_.share(s) for round_ in rounds for s in round_.left}
        best = [s for s in (round_.best(SIMULATED_FAMILY) for round_ in rounds) if s is not None]
        if not best:
            break
        for s in sorted(best, key=lambda s: -gains[s]):
            columns += sets[s]
        chosen |= set(best)
        remaining -= chosen
    return [
        Tried(
            joints[free_parameters[0].joints[0]],
            tuple(free.term.name for free in free_parameters if free.term is not None),
            gains[s],
            s in chosen,
        )
        for s, free_parameters in enumerate(offered)
    ]


def impossible(simulator: LoopSimulator, theta: Array, tried: Sequence[Tried]) -> dict[Tried, str]:
    """Return the weakest chosen term of each joint whose friction is negative, and the figures."""
    # such friction would drive the joint: no simulation that comes to rest there has a solution
    model, loops, why = simulator.robot.model, simulator.loops(theta), {}
    weakest = {t.joint: t for t in sorted(tried, key=lambda t: -t.gain) if t.is_chosen}
    for t in weakest.values():
        j = model.joints.index(t.joint)
        q = np.concatenate([w.log.q[w.counted, j] for w in simulator.windows])
        if negative := negative_friction(model, loops, j, q):
            why[t] = negative
    return why


def _folds(
    simulator: LoopSimulator, theta: Array, estimator: OutputError
) -> tuple[Array, Array, int]:
    """Return A'A, (K, c, c), and A'b, (K, c), of K folds with equal priors, and rows per joint."""
    count, rows = min(FOLDS, len(simulator.windows)), 0
    known = 1.0 / simulator.prior_std**2 / count
    H = np.tile(np.diag(known), (count, 1, 1))
    g = np.tile(known * (simulator.prior - theta), (count, 1))
    parts = list(linearised(simulator, estimator.weights(simulator, theta), theta))
    of_window = len(parts) // len(simulator.windows)  # parts of the robot
    for k, (A, b, columns) in enumerate(parts):
        fold = (k // of_window) % count
        H[fold][np.ix_(columns, columns)] += A.T @ A
        g[fold][columns] += A.T @ b
        rows += len(b)
    return H, g, rows // len(simulator.robot.model.joints)


def _gains(
    H: Array, g: Array, columns: list[int], sets: dict[int, list[int]], least: Array
) -> dict[int, Array]:
    """Return by how much each set of further columns lowers the squares of each held-out fold."""
    # 0 for a step below ``least``, (c,); all 0 if the other folds do not determine a parameter
    gains = {s: np.zeros(len(H)) for s in sets}
    base = np.array(columns)
    for k, (H_k, g_k) in enumerate(zip(H, g, strict=True)):
        H_f, g_f = H.sum(axis=0) - H_k, g.sum(axis=0) - g_k  # of the others
        try:
            factor = scipy.linalg.cho_factor(H_f[np.ix_(base, base)])
        except scipy.linalg.LinAlgError:  # not positive definite
            return {s: np.zeros(len(H)) for s in sets}
        move = scipy.linalg.cho_solve(factor, g_f[base])
        before = move @ H_k[np.ix_(base, base)] @ move - 2 * g_k[base] @ move
        for s, places in sets.items():
            further = np.array(places)
            B = H_f[np.ix_(base, further)]
            X = scipy.linalg.cho_solve(factor, B)
            S = H_f[np.ix_(further, further)] - B.T @ X
            y = np.linalg.lstsq(S, g_f[further] - B.T @ move, rcond=None)[0]
            if (y < least[further]).any():
                continue
            both, step = np.append(base, further), np.concatenate([move - X @ y, y])
            gains[s][k] = before - step @ H_k[np.ix_(both, both)] @ step + 2 * g_k[both] @ step
    return gains


@dataclass(frozen=True, eq=False)
class GainScale:
    """Relative change of the gains that makes them consistent with bodies and torques [-]."""

    change: Array  # of each joint's gains, shape (n,)
    error: Array  # its standard errors, shape (n,); inf where it is not identifiable
    common: float  # of all gains by one factor
    common_error: float  # its standard error

    @property
    def is_wrong(self) -> bool:
        """Whether the common factor of all gains is not 1, and each joint is consistent with it."""
        error = np.hypot(self.error, self.common_error)
        agree = np.abs(self.change - self.common) <= BEYOND_NOISE * error
        # missing friction terms cause smaller differences
        is_other = abs(self.common) > max(BEYOND_NOISE * self.common_error, AGREES)
        return bool(is_other and self.common > -1.0 and agree.all())  # no gain is negative


def gain_scale(simulator: LoopSimulator, estimator: OutputError, estimate: Estimate) -> GainScale:
    """Return the scale of the stated gains that bodies, and fitted torques, indicate."""
    # one Gauss-Newton step: drive parameters scale with the gains, weight and inertia do not
    n, c, gains = len(simulator.base.kp), len(estimate.theta), []
    for what in ("kp", "kd"):
        if any(free.what == what for free in simulator.free_parameters):
            continue  # it is fitted, so that it scales with the other one
        for j, value in enumerate(getattr(simulator.base, what).tolist()):
            gains.append(FreeParameter(f"{what} of {j} as given", what, (j,), value, np.inf))
    wide = replace(simulator, free_parameters=(*simulator.free_parameters, *gains))
    theta = np.concatenate([estimate.theta, [gain.prior for gain in gains]])
    H, g = estimator.normal(wide, estimator.weights(wide, theta), theta, frees=True)
    T = np.zeros((len(theta), c + n))  # from free parameters and joint scales to all parameters
    T[:c, :c] = np.eye(c)
    for k, gain in enumerate(gains, start=c):
        T[k, c + gain.joints[0]] = gain.prior
    free = np.concatenate([~is_at_bound(simulator, estimate.theta), np.ones(n, dtype=bool)])
    T = T[:, free]
    inflation = max(float(estimate.details["inflation"]), 1.0)
    change, error = _last(T.T @ H @ T, T.T @ g, n)
    together = np.column_stack([T[:, :-n], T[:, -n:].sum(axis=1)])
    [common], [common_error] = _last(together.T @ H @ together, together.T @ g, 1)
    spread = np.sqrt(inflation)
    return GainScale(change, spread * error, float(common), float(spread * common_error))


def _last(H: Array, g: Array, n: int) -> tuple[Array, Array]:
    """Return the last n entries of x, H x = g, and their errors; inf where H is singular."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, V = scipy.linalg.eigh(H * np.outer(scale, scale))
    regular = values > 1e-12 * values[-1]
    inverse = (V[:, regular] / values[regular]) @ V[:, regular].T
    x, variance = scale * (inverse @ (scale * g)), np.diag(inverse) * scale**2
    is_singular = (V[:, ~regular] ** 2).sum(axis=1) > 1e-6
    return x[-n:], np.where(is_singular, np.inf, np.sqrt(variance))[-n:]
