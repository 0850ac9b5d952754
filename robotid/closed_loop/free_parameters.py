"""What is unknown of drives, loops and bodies, and the simulator that an estimator asks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robotid._typing import Array
from robotid.closed_loop.drive_torques import drive_torques
from robotid.estimators.output_error import Residual
from robotid.exceptions import NotConvergedError
from robotid.logs.data import Trajectory
from robotid.regressor.memory import remember
from robotid.regressor.prediction import predict
from robotid.robot.drives import DriveTerm
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia
from robotid.simulation.loops import ClosedLoopRobot, Column, Loops, RollOut, Window

__all__ = ["FreeParameter", "LoopSimulator", "TorqueRows", "free_body_parameters", "with_terms"]

_STARTS = 2  # steps towards better starts of windows ...
_SHARES = (1.0, 0.3, 0.1)  # ... of which these are tried
_NEAR = 3.0  # errors of position, that a start may be from where it was measured
_POSSIBLE = 1e-9  # smallest eigenvalue of a pseudo-inertia, relative, from which a body can change
#: Entries of the triangle that a body changes by: the logarithm of its mass' root, and its centre.
_ENTRIES = ((3, 3), (0, 3), (1, 3), (2, 3))


@dataclass(frozen=True, eq=False)
class FreeParameter:
    """One number that is to be found, of one joint or of several that share it.

    Attributes:
        name: As ``"elbow.armature"``; of several joints, ``"calf.armature"``.
        what: "armature", "kp", "kd", "limit", "delay", "zero", "term", or "body": a coordinate of
            how a body differs from the URDF's.
        joints: Rows of the joints.
        prior: What it is before any data.
        spread: How far from that it may plausibly be; inf where nothing is known.
        lowest: Smallest value that it may have.
        term: The term of friction.
        coordinate: Number of a body's coordinate, 0 to 3.
    """

    name: str
    what: str
    joints: tuple[int, ...]
    prior: float
    spread: float
    lowest: float = -np.inf
    term: DriveTerm | None = None
    coordinate: int = 0


def free_body_parameters(robot: ClosedLoopRobot, spread: float) -> list[FreeParameter]:
    """Return how bodies may differ from the URDF's, four coordinates each, 0 before any data.

    J' = U T T' U' with U U' the URDF's pseudo-inertia and T the unit matrix but for its last
    column, (c, exp m): mass and centre of mass change, and the moments with them, the shape about
    the centre stays. Every value is a body that can be.

    Args:
        robot: The robot.
        spread: Plausible size of each coordinate [-]; 0.1 is some 20 % of the mass, and a centre
            of mass off by a tenth of the radius of gyration.

    References:
        Rucker, Wensing (2022), Smooth parameterization of rigid-body inertia, (12)-(14).
    """
    model = robot.model
    J = pseudo_inertia(model.standard_parameters()[: model.layout.n_inertial])
    values = np.linalg.eigvalsh(J)
    found = []
    for body, joint in enumerate(robot.joint_of_body):
        if values[body, 0] <= _POSSIBLE * values[body, -1]:
            continue  # a massless frame, or a body that the URDF makes impossible: it stays
        name = model.layout.bodies[body]
        found += [
            FreeParameter(f"{name}.{what}", "body", (joint,), 0.0, spread, coordinate=k)
            for k, what in enumerate(("mass", "cx", "cy", "cz"))
        ]
    return found


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """What logs of torques come down to: R [K pi, 1] is their residual, weighted to unit noise.

    Attributes:
        model: The robot, whose standard parameters pi are.
        R: Triangular factor, shape (b + 1, b + 1).
        K: Base parameters of standard ones, shape (b, p).
    """

    model: RobotModel
    R: Array
    K: Array


@dataclass(frozen=True, eq=False)
class LoopSimulator:
    """A looped robot with unknowns, beside windows of logs: what an estimator asks.

    Attributes:
        robot: The robot.
        windows: Windows of its logs.
        base: All that is known; unknowns stand over it.
        free_parameters: What is to be found.
        torque: Rows of measured torques along what was measured, if they weigh.
        velocities: Whether measured velocities are compared beside the positions.
        error: What is compared: "output", positions, and torques of the drives if they are to be;
            "input", these torques alone; "direct", the same, whose derivatives neglect that the
            motion changes.
        behind: How many rows the command that a torque follows is behind it, shape (n,), as of
            ``drive_torques``; None if no torques of roll-outs are compared.
        fine: The robot at smaller steps, whose roll-outs are compared; derivatives stay those of
            ``robot``. None: its own are.
    """

    robot: ClosedLoopRobot
    windows: tuple[Window, ...]
    base: Loops
    free_parameters: tuple[FreeParameter, ...]
    torque: "TorqueRows | None" = None
    velocities: bool = False
    error: str = "output"
    behind: Array | None = None
    fine: ClosedLoopRobot | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(unknown.name for unknown in self.free_parameters)

    @cached_property
    def prior(self) -> Array:
        return np.array([unknown.prior for unknown in self.free_parameters])

    @cached_property
    def prior_std(self) -> Array:
        return np.array([unknown.spread for unknown in self.free_parameters])

    @cached_property
    def lowest(self) -> Array:
        return np.array([unknown.lowest for unknown in self.free_parameters])

    def loops(self, theta: Array) -> Loops:
        """Return bodies, drives and loops with the unknowns at some values.

        Args:
            theta: Their values, shape (c,).
        """
        base = self.base
        changed = {
            name: getattr(base, name).copy()
            for name in ("armature", "kp", "kd", "limit", "delay", "zero", "values")
        }
        for unknown, value in zip(self.free_parameters, theta, strict=True):
            if unknown.term is not None:
                places = [base.place(j, unknown.term) for j in unknown.joints]
                changed["values"][places] = value
            elif unknown.what != "body":
                changed[unknown.what][list(unknown.joints)] = value
        return replace(base, bodies=self._bodies(theta)[0], **changed)

    def roll_out(self, theta: Array, windows: Sequence[Window] | None = None) -> list[RollOut]:
        """Return what windows come out as.

        Args:
            theta: Values of the unknowns, shape (c,).
            windows: Which windows; all if None.

        Raises:
            NotConvergedError: If a step has no solution.
        """
        return self.robot.roll_out(self.loops(theta), self.windows if windows is None else windows)

    def with_better_start(self, theta: Array) -> "LoopSimulator":
        """Return the same with windows whose starts fit best: measured ones have noise.

        Friction may hold for long what is wrong at the start, so that a lead is not enough.

        Args:
            theta: Values of the unknowns, shape (c,).

        Raises:
            NotConvergedError: If a step has no solution.
        """
        n, loops, columns = len(self.base.kp), self.loops(theta), self._starts()
        windows = [replace(window, first=window.begin) for window in self.windows]
        for _ in range(_STARTS):
            outs = self.robot.roll_out(loops, windows, columns)
            errors = np.concatenate([_error(out) for out in outs])
            sigma = np.maximum(np.sqrt(np.mean(errors**2, axis=0)), 1e-12)
            best = [float(np.sum((_error(out) / sigma) ** 2)) for out in outs]
            changes = [_better_start(out, sigma) for out in outs]
            initialised = list(zip(windows, changes, strict=True))
            tries = [[w.start + share * x for w, x in initialised] for share in _SHARES]
            tries.append([np.stack([w.around, np.zeros(n)]) for w in windows])  # at rest
            for starts in tries:
                tried = [replace(w, given=x) for w, x in zip(windows, starts, strict=True)]
                try:
                    outs = (self.fine or self.robot).roll_out(loops, tried)
                except NotConvergedError:
                    continue  # these starts cannot be simulated; others can
                for k, out in enumerate(outs):
                    cost = float(np.sum((_error(out) / sigma) ** 2))
                    if cost < best[k]:
                        best[k], windows[k] = cost, tried[k]
        kept = zip(self.windows, windows, strict=True)
        return replace(self, windows=tuple(replace(w, given=new.start) for w, new in kept))

    def rows(self, theta: Array) -> tuple[Array, Array]:
        """Return what measured torques leave, and what lowers it; see ``Simulator``.

        Args:
            theta: Values of the unknowns, shape (c,).
        """
        if self.torque is None:
            return np.zeros((0, len(theta))), np.zeros(0)
        R, K = self.torque.R, self.torque.K
        pi, slopes = self.standard(self.torque.model, theta)
        return R[:, :-1] @ (K @ slopes), R[:, -1] - R[:, :-1] @ (K @ pi)

    def torque_mismatch(self, theta: Array) -> Array:
        """Return how much of the torques roll-outs miss, root mean squares, shape (n,) [-].

        It is measured by the logged torque or by that of the roll-outs, whichever is larger.

        Args:
            theta: Values of the unknowns, shape (c,).

        Raises:
            NotConvergedError: If a step has no solution.
        """
        torques = replace(self, error="input").residuals(theta, with_slopes=False)
        missed = np.concatenate([part.e for part in torques])
        logged = np.concatenate([w.log.tau[w.counted] for w in self.windows])
        size = np.maximum(np.mean(logged**2, axis=0), np.mean((logged - missed) ** 2, axis=0))
        share: Array = np.sqrt(np.mean(missed**2, axis=0) / np.maximum(size, 1e-300))
        return share

    def standard(self, model: RobotModel, theta: Array) -> tuple[Array, Array]:
        """Return a robot's standard parameters, shape (p,), and their derivatives, shape (p, c).

        Args:
            model: The robot, with the terms of the loops; 0 of those that they lack.
            theta: Values of the unknowns, shape (c,).
        """
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
        body_of = {joint: body for body, joint in enumerate(self.robot.joint_of_body)}
        for k, unknown in enumerate(self.free_parameters):
            if unknown.what == "body":
                first = 10 * body_of[unknown.joints[0]]
                slopes[first : first + 10, k] = next(changes)
                continue
            for j in unknown.joints:
                row = place.get((j, unknown.term or unknown.what))
                if row is not None:
                    slopes[row, k] = 1.0
        return pi, slopes

    def residuals(
        self, theta: Array, *, with_slopes: bool, with_starts: bool = False
    ) -> list[Residual]:
        """Return what is measured less what comes out, window by window; see ``Simulator``.

        Of ``error`` "direct", derivatives are those of inverse dynamics along the roll-out.

        Args:
            theta: Values of the unknowns, shape (c,).
            with_slopes: Whether derivatives are wanted.
            with_starts: Whether those by the starts of windows are.

        Raises:
            NotConvergedError: If a step has no solution.

        References:
            Gautier, Janot, Vandanjon (2013), A new closed-loop output error method for parameter
            identification of robot dynamics, IEEE TCST 21(2): DIDIM.
        """
        loops, (_, directions) = self.loops(theta), self._bodies(theta)
        columns = self._columns(loops) if with_slopes else []
        if with_starts:
            columns += [(len(theta) + k, column) for k, column in enumerate(self._starts())]
        rolls = (with_slopes or with_starts) and self.error != "direct"
        if not rolls or self.fine is not None:
            outs = (self.fine or self.robot).roll_out(loops, self.windows)
        if rolls:
            ways = self.robot.roll_out(
                loops,
                self.windows,
                [column for _, column in columns],
                directions,
                owners=[owner for owner, _ in columns],
                with_speeds=self.velocities or self.behind is not None,
            )
            errors = [self._error(out, loops) for out in (ways if self.fine is None else outs)]
            return [
                part
                for out, error in zip(ways, errors, strict=True)
                for part in self._parts(out, error, loops, columns)
            ]
        everything, none = np.arange(self._outputs), np.array([], dtype=int)
        if not with_slopes:
            return [Residual(self._error(out, loops), None, everything, none) for out in outs]
        slopes, own = self._inverse_dynamics(outs, theta), np.arange(len(theta))
        return [
            Residual(self._error(out, loops)[:, joints], Y[:, joints], joints, own)
            for out, Y in zip(outs, slopes, strict=True)
            for joints in self.robot.parts
        ]

    @property
    def exact(self) -> "LoopSimulator | None":
        """The same with exact derivatives, if its own neglect that the motion changes."""
        return replace(self, error="input") if self.error == "direct" else None

    @property
    def knows_torques(self) -> bool:
        """Whether measured torques weigh, along what was measured or along roll-outs."""
        return self.torque is not None or self.behind is not None

    @property
    def _outputs(self) -> int:
        """How many outputs are compared: positions, speeds beside them, torques, in this order."""
        beside = self.velocities + (self.behind is not None) if self.error == "output" else 0
        return len(self.base.kp) * (1 + beside)

    def _error(self, out: RollOut, loops: Loops) -> Array:
        """Return what is measured less what comes out, shape (N, outputs)."""
        counted, parts = out.window.counted, []
        if self.error == "output":
            parts.append(_error(out))
            if self.velocities:
                parts.append(out.window.log.v[counted] - out.v)  # type: ignore[index]
        if self.behind is not None:
            given = drive_torques(out, loops, self.behind).given
            parts.append(out.window.log.tau[counted] - given)
        error: Array = np.hstack(parts)
        return error

    def _parts(
        self, out: RollOut, error: Array, loops: Loops, columns: list[tuple[int, Column]]
    ) -> Iterator[Residual]:
        """Yield the errors of a roll-out's parts, with all that they change with."""
        n, free_parameters = len(loops.kp), len(self.free_parameters)
        torques = None if self.behind is None else drive_torques(out, loops, self.behind)
        for joints, places, slopes in out.slopes:
            k = len(joints)
            parts = [slopes[:, :k]] if self.error == "output" else []
            parts += [slopes[:, k:]] if self.velocities else []
            if torques is not None:
                place = {int(owner): c for c, owner in enumerate(places)}
                by = [(place[owner], own) for owner, own in columns if owner in place]
                parts.append(torques.slopes(joints, by, slopes, self.robot.kinds))
            slopes = np.concatenate(parts, axis=1)
            outputs = np.concatenate([joints + n * i for i in range(len(parts))])
            own = places[places < free_parameters]  # and behind them starts
            by_start = slopes[:, :, len(own) :]
            yield Residual(error[:, outputs], slopes[:, :, : len(own)], outputs, own, by_start)

    def _inverse_dynamics(self, outs: Sequence[RollOut], theta: Array) -> list[Array]:
        """Return Y(q, v, a) d pi along roll-outs, window by window, shape (N, n, c)."""
        model, (_, slopes) = self._described, self.standard(self._described, theta)
        found = []
        for out in outs:
            t = out.window.log.t[out.window.counted]
            a, none = np.gradient(out.v, t, axis=0), np.zeros_like(out.q)
            segment = np.zeros(len(t), dtype=int)
            motion = Trajectory(t, out.q, out.v, a, none, model.joints, None, segment)
            torques = predict(model, list(slopes.T), remember(model, motion))
            found.append(np.stack(torques, axis=-1))
        return found

    @cached_property
    def _described(self) -> RobotModel:
        """The robot with the terms of its loops."""
        return with_terms(self.robot.model, self.base)

    def _starts(self) -> list[Column]:
        """Return the columns of positions and speeds where windows begin."""
        kinds, n = self.robot.kinds, len(self.base.kp)
        return [(kinds[what], j, 0) for what in ("start", "speed") for j in range(n)]

    def _columns(self, loops: Loops) -> list[tuple[int, Column]]:
        """Return what to differentiate by, each column with the number of its unknown."""
        kinds, columns, body = self.robot.kinds, [], 0
        for k, unknown in enumerate(self.free_parameters):
            for j in unknown.joints:
                index = 0
                if unknown.term is not None:
                    index = loops.place(j, unknown.term)
                elif unknown.what == "body":
                    index, body = body, body + 1
                columns.append((k, (kinds[unknown.what], j, index)))
        return columns

    @cached_property
    def _roots(self) -> Array:
        """A root U of each body's pseudo-inertia that is unknown, an upper triangle, (n, 4, 4)."""
        roots = np.zeros((len(self.base.bodies), 4, 4))
        J = pseudo_inertia(self.base.bodies.reshape(-1))
        body_of = {joint: body for body, joint in enumerate(self.robot.joint_of_body)}
        for body in {body_of[u.joints[0]] for u in self.free_parameters if u.what == "body"}:
            roots[body] = np.linalg.cholesky(J[body, ::-1, ::-1])[::-1, ::-1]
        return roots

    def _bodies(self, theta: Array) -> tuple[Array, Array]:
        """Return the bodies, (n, 10), and how each coordinate changes its body, (D, 10)."""
        bodies, directions = self.base.bodies.copy(), []
        body_of = {joint: body for body, joint in enumerate(self.robot.joint_of_body)}
        by_body: dict[int, list[int]] = {}
        for k, unknown in enumerate(self.free_parameters):
            if unknown.what == "body":
                by_body.setdefault(body_of[unknown.joints[0]], []).append(k)
        for body, places in by_body.items():
            U, T = self._roots[body], np.eye(4)
            for k in places:
                row, column = _ENTRIES[self.free_parameters[k].coordinate]
                T[row, column] = np.exp(theta[k]) if row == column else theta[k]
            bodies[body] = inertial_from_pseudo_inertia(U @ T @ T.T @ U.T)
            for k in places:
                row, column = _ENTRIES[self.free_parameters[k].coordinate]
                change = np.zeros((4, 4))
                change[row, column] = T[row, column] if row == column else 1.0
                half = U @ change @ T.T @ U.T
                directions.append(inertial_from_pseudo_inertia(half + half.T))
        return bodies, np.array(directions).reshape(-1, 10)


def with_terms(model: RobotModel, loops: Loops) -> RobotModel:
    """Return the model with the terms of loops that it has not yet.

    Args:
        model: The robot.
        loops: Its loops.
    """
    own = {
        joint: [
            *model.layout.own.get(joint, ()),
            *(t for t in terms if t not in _has(model, joint)),
        ]
        for joint, terms in zip(model.joints, loops.terms, strict=True)
    }
    return RobotModel.from_urdf(
        model.tree, **{**model.options, "own_terms": {k: v for k, v in own.items() if v}}
    )


def _has(model: RobotModel, joint: str) -> list[object]:
    """Return the terms that the model has of a joint."""
    layout = model.layout
    return [term for d, term in layout.drive_parameters if layout.drives[d].name == joint]


def _better_start(out: RollOut, sigma: Array) -> Array:
    """Return by how much position and speed at the start are off, to first order, shape (2, n).

    They are near what was measured: within some errors of position, and the typical speed.
    """
    log = out.window.log
    speed = np.sqrt(np.mean((np.diff(log.q, axis=0) / np.diff(log.t)[:, None]) ** 2, axis=0))
    usual = np.maximum(np.concatenate([_NEAR * sigma, speed]), 1e-9)
    change = np.zeros(2 * len(sigma))
    for joints, places, slopes in out.slopes:
        b = (_error(out)[:, joints] / sigma[joints]).reshape(-1)
        A = (slopes / sigma[joints, None]).reshape(b.size, -1) * usual[places]
        A, b = np.vstack([A, np.eye(len(places))]), np.concatenate([b, np.zeros(len(places))])
        change[places] = usual[places] * np.linalg.lstsq(A, b, rcond=None)[0]
    return change.reshape(2, -1)


def _error(out: RollOut) -> Array:
    error: Array = out.window.log.q[out.window.counted] - out.q
    return error
