"""Closed-loop simulation of windows of logs, with sensitivities.

Parts of a robot that only its fixed base joins, such as legs, are simulated independently. The
lanes of the compiled code simulate several windows in parallel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, groupby, islice, pairwise
from types import ModuleType
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

import numpy as np

from robotid.base.cores import in_order
from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.data.log import Log
from robotid.dynamics.rows import Tree, flatten, why_not
from robotid.robot.drive_term import BRISTLES, DIRECTED, DriveTerm, MemorylessTerm
from robotid.robot.drives import Bristles
from robotid.robot.mass_matrix import rigid_mass_matrices
from robotid.robot.model import RobotModel

if TYPE_CHECKING:
    from robotid.dynamics.simulation.loop_lanes import Course, Terms

#: Kind, joint and index of a parameter of the sensitivities; see ``loop_lanes``.
Column: TypeAlias = tuple[int, int, int]

_KINDS = ("armature", "kp", "kd", "limit", "term", "delay", "zero", "body", "start", "speed")
LOOP_GAP = 3.0  # step in time above which a segment ends [median steps]
_AROUND = 0.03  # half-width of the fit for the initial speed [s]
_FEWEST = 2  # smallest number of samples on each side of that fit
_SHORT = 0.5  # smallest last window; a shorter one is part of the previous one [windows]
_SAME = 1e-3  # largest difference of a tick from the row at the same time [ticks]
_FASTEST = 1e6  # speed above which a closed loop is unstable [rad/s or m/s]


@dataclass(frozen=True, eq=False)
class Loops:
    """Parameters of bodies, drives and the drives' control loops.

    torque = kp (q_ref - q) + kd (v_ref - v) + tau_ref, at most ``limit``, of delayed commands;
    position 0 of an encoder is position ``zero`` of the URDF. With a ``rate``, the controller
    samples at its ticks, counted from the first row of a log, with a zero-order hold. A command at
    a tick is averaged over the row after it: a delay of part of a row interpolates between rows.
    """

    bodies: Array  # ten inertial parameters of each body, shape (n, 10), in the order of the layout
    armature: Array  # shape (n,) [kg m^2 or kg]
    kp: Array  # shape (n,) [N m/rad or N/m]
    kd: Array  # shape (n,) [N m s/rad or N s/m]
    limit: Array  # largest torque, shape (n,) [N m or N]; infinite without one
    delay: Array  # shape (n,) [s]
    zero: Array  # shape (n,) [rad or m]
    terms: tuple[tuple[DriveTerm, ...], ...]  # friction and offset of each joint
    values: Array  # their parameters, joint by joint, shape (T,)
    rate: float | None = None  # sampling rate of the controller [Hz]; None: continuous time

    def place(self, joint: int, term: DriveTerm) -> int:
        """Return the index of the parameter of a joint's term in ``values``."""
        return sum(map(len, self.terms[:joint])) + self.terms[joint].index(term)

    def of(self, log: Log) -> "Loops":
        """Return the loops with the gains of a log."""
        kp, kd = log.gain_factors * np.stack([self.kp, self.kd])
        return replace(self, kp=kp, kd=kd)


def open_loops(model: RobotModel, pi: Array) -> Loops:
    """Return bodies and drives of standard parameters without control: no gain, no delay."""
    layout, n = model.layout, len(model.joints)
    armature, none = np.zeros(n), np.zeros(n)
    drives: list[list[tuple[DriveTerm, float]]] = [[] for _ in range(n)]
    for (d, term), value in zip(layout.drive_parameters, pi[layout.n_inertial :], strict=True):
        if term.is_inertia:
            armature[d] = value
        else:
            drives[d].append((term, value))
    return Loops(
        bodies=pi[: layout.n_inertial].reshape(-1, 10), armature=armature, kp=none, kd=none,
        limit=np.full(n, np.inf), delay=none, zero=none,
        terms=tuple(tuple(term for term, _ in drive) for drive in drives),
        values=np.array([value for drive in drives for _, value in drive]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Window:
    """A segment of a log of commands that is simulated from its measured initial state."""

    log: Log  # the log, with commands
    start_row: int  # first simulated sample
    first: int  # first counted sample; before it, the error of the initial state decays
    stop: int  # sample after the last one
    given: Array | None = None  # initial position and speed, (2, n); None: the measured ones

    @property
    def counted(self) -> slice:
        """The counted samples."""
        return slice(self.first, self.stop)

    @property
    def around(self) -> Array:
        """Mean position about the first sample, shape (n,): that of a joint at rest."""
        return np.asarray(self.log.q[self._near].mean(axis=0))

    @property
    def _near(self) -> slice:
        """The samples about the first one."""
        wide = max(_FEWEST, round(_AROUND / self.dt))
        return slice(max(self.start_row - wide, 0), self.start_row + wide + 1)

    @cached_property
    def dt(self) -> float:
        """Median step of the log [s]."""
        return float(np.median(np.diff(self.log.t)))

    @cached_property
    def start(self) -> Array:
        """Initial position and speed, shape (2, n)."""
        if self.given is not None:
            return self.given
        t, q, k, near = self.log.t, self.log.q, self.start_row, self._near
        order = min(2, len(t[near]) - 1)
        fit = np.polynomial.polynomial.polyfit(t[near] - t[k], q[near], order)
        return np.stack([q[k], fit[1]])


def cut_windows(log: Log, length: float, lead: float) -> tuple[Window, ...]:
    """Return the windows of a log, segment by segment between its gaps."""
    steps = np.diff(log.t)
    dt = float(np.median(steps))
    edges = [0, *(np.flatnonzero(steps > LOOP_GAP * dt) + 1), len(log.t)]
    ahead = round(lead / dt)
    windows = []
    for start, stop in pairwise(edges):
        size = stop - start if math.isinf(length) else max(2, round(length / dt))
        firsts = list(range(start, stop, size))
        if len(firsts) > 1 and stop - firsts[-1] < max(_SHORT * size, 2):
            firsts.pop()
        ends = [*firsts[1:], stop]
        windows += [
            Window(log, max(start, first - ahead), first, end)
            for first, end in zip(firsts, ends, strict=True)
            if end - first > 1
        ]
    return tuple(windows)


@dataclass(frozen=True, eq=False)
class RollOut:
    """The simulated motion of a window."""

    window: Window  # the window
    q: Array  # positions of the counted samples, shape (N, n) [rad or m]
    v: Array  # speeds of the counted samples, shape (N, n) [rad/s or m/s]
    # of each part: its joints (k,), indices of its sensitivities (c,), and derivatives of its
    # positions (N, k, c), or of its positions and speeds (N, 2k, c)
    slopes: tuple[tuple[Array, Array, Array], ...] = ()


class _Part(NamedTuple):
    """A part of the robot that only the base joins to others, for the compiled code."""

    joints: Array  # indices of its joints in the model, (k,)
    bodies: Array  # indices of their bodies in the layout, (k,)
    tree: Tree


class ClosedLoopRobot:
    """Simulator of a robot with closed-loop drives."""

    #: Numbers of the kinds of sensitivities, by name, as of ``loop_lanes``.
    kinds: ClassVar[dict[str, int]] = {name: k for k, name in enumerate(_KINDS)}

    def __init__(self, model: RobotModel, *, step: float = 2e-3, corrects: bool = False) -> None:
        """Flatten a robot."""
        model.require_fixed("the estimator 'simulation', which simulates the controlled joints,")
        if model.layout.couplings or model.mimic == "coupled":
            raise SettingsError(
                f"{model.name}: drives that couple several joints and coupled mimic joints cannot "
                "be simulated. Leave out [[coupling]], and set mimic = 'independent'"
            )
        if (why := why_not(model)) is not None:
            raise SettingsError(f"{model.name} cannot be simulated: {why}")
        self.model, self.step, self.corrects = model, step, corrects
        self._parts = _parts(flatten(model))

    @property
    def joint_of_body(self) -> tuple[int, ...]:
        """The joint that moves each body of the layout."""
        bodies, joints = (np.concatenate([part[k] for part in self._parts]) for k in (1, 0))
        return tuple(joints[np.argsort(bodies)].tolist())

    def roll_out(
        self,
        loops: Loops,
        windows: Sequence[Window],
        columns: Sequence[Column] = (),
        directions: Array | None = None,
        *,
        owners: Sequence[int] | None = None,
        with_speeds: bool = False,
    ) -> list[RollOut]:
        """Return the motion of windows, with their gains; columns of one owner are added."""
        kinds = np.array(columns, dtype=np.int64).reshape(-1, 3)
        numbers = np.arange(len(kinds)) if owners is None else np.array(owners, dtype=np.int64)
        wanted = np.column_stack([kinds, numbers])[np.argsort(numbers, kind="stable")]
        along = np.zeros((0, 10)) if directions is None else np.array(directions, order="C")
        size, outputs = _lanes().LANES, 2 if with_speeds else 1
        groups = groupby(windows, key=lambda window: window.log.gain_factors.tobytes())
        equal = [list(group) for _, group in groups]  # consecutive windows of equal gains
        blocks = [some[k : k + size] for some in equal for k in range(0, len(some), size)]
        pieces = [(part, block) for block in blocks for part in self._parts]
        done = in_order(lambda p: self._block(p[0], p[1], loops, wanted, along, outputs), pieces)
        rolled: list[RollOut] = []
        for block in blocks:
            parts = list(zip(self._parts, islice(done, len(self._parts)), strict=True))
            for lane, window in enumerate(block):
                counted = slice(window.first - window.start_row, window.stop - window.start_row)
                q, v = np.empty((2, window.stop - window.first, len(self.model.joints)))
                slopes = []
                for part, (numbers_of, q_part, v_part, S) in parts:
                    q[:, part.joints] = q_part[counted, :, lane]
                    v[:, part.joints] = v_part[counted, :, lane]
                    slopes.append((part.joints, numbers_of, S[counted, :, :, lane]))
                rolled.append(RollOut(window, q, v, tuple(slopes) if len(wanted) else ()))
        return rolled

    def _block(
        self,
        part: _Part,
        windows: Sequence[Window],
        loops: Loops,
        wanted: Array,
        along: Array,
        outputs: int,
    ) -> tuple[Array, Array, Array, Array]:
        """Return numbers, positions, speeds and derivatives; wanted: kind, joint, index, number."""
        lanes, own, n = _lanes(), part.joints, len(part.joints)
        columns = wanted[np.isin(wanted[:, 1], own)]
        numbers, first = np.unique(columns[:, 3], return_index=True)
        sums = np.append(first, len(columns)).astype(np.int64)
        log, factors = windows[0].log, np.ones((len(_KINDS), len(loops.kp)))
        factors[[self.kinds["kp"], self.kinds["kd"]]] = log.gain_factors
        loops, factors = loops.of(log), factors[columns[:, 0], columns[:, 1]]
        columns = np.ascontiguousarray(columns[:, :3])
        columns[:, 1] = [np.flatnonzero(own == j)[0] for j in columns[:, 1]]
        places, terms, affine = _arranged(loops, own)
        is_term = columns[:, 0] == self.kinds["term"]
        columns[is_term, 2] = [np.flatnonzero(places == k)[0] for k in columns[is_term, 2]]
        gains = [x[own] for x in (loops.armature, loops.kp, loops.kd, loops.limit)]
        drives = np.column_stack([*gains, affine])
        robot = lanes.Robot(part.tree, loops.zero[own], loops.bodies[part.bodies], drives, terms)
        course = self._course(part, windows, loops)
        samples = len(course.steps) // course.every + 1
        q, v = np.zeros((2, samples, n, lanes.LANES))
        S = np.zeros((samples, outputs * n, len(numbers), lanes.LANES))
        q[0], v[0] = course.start
        is_held = loops.rate is not None
        at, work = lanes.places_of(n, len(numbers), len(terms.bristles), is_held)
        kinds, motion = lanes.Columns(columns, sums, along, factors), lanes.Motion(q, v, S)
        failed = lanes.roll_out(robot, kinds, course, motion, work, at, self.corrects)
        if failed >= 0 or not (np.abs(v) < _FASTEST).all():
            rows = work.reshape(-1, lanes.LANES)
            last = (rows[at.q : at.q + n], rows[at.G : at.G + n]) if failed >= 0 else None
            row, lane, i, angles = _failed_at(failed // course.every, last, q, v)
            window = windows[lane]
            time = float(window.log.t[min(window.start_row + row, window.stop - 1)])
            why = why_no_solution(self.model, loops, own, angles, i, self.step)
            raise NotConvergedError(why, f"{window.log.name} at {time:.4g} s")
        return numbers, q, v, S

    def _course(self, part: _Part, windows: Sequence[Window], loops: Loops) -> "Course":
        """Return the commands of a part's joints in a block of windows."""
        lanes = _lanes()
        samples = max(window.stop - window.start_row for window in windows)
        grids = [_Grid.of(window, samples, loops.rate) for window in windows]
        every = max(grid.least_steps(self.step, loops.rate) for grid in grids)
        size, n = (samples - 1) * every, len(part.joints)
        command = np.zeros((size, n, 6, lanes.LANES))
        steps, start = np.empty((size, lanes.LANES)), np.empty((2, n, lanes.LANES))
        ticks = np.zeros((0 if loops.rate is None else size, lanes.LANES))
        for lane, window in enumerate(windows):
            log, (times, is_tick) = window.log, grids[lane].divided(every)
            is_last = lane == len(windows) - 1
            own = slice(lane, None if is_last else lane + 1)  # unused lanes copy the last one
            steps[:, own] = np.diff(times)[:, None]
            start[..., own] = window.start[:, part.joints, None]
            edges = times
            of_step: Array | slice = slice(None)
            if loops.rate is not None:
                ticks[:, own], of_step = is_tick[:, None], 2 * (np.cumsum(is_tick) - 1)
                edges = grids[lane].sampled(times[:-1][is_tick])
            mean, change = np.empty((2, len(edges) - 1))
            for values, k, by_delay in ((log.q_ref, 0, 1), (log.v_ref, 2, 4), (log.tau_ref, 3, 5)):
                if values is None:
                    continue
                for i, j in enumerate(part.joints):
                    x = values[:, j].copy()  # contiguous and writable: else Numba compiles again
                    lanes.average_command(log.t, x, edges, loops.delay[j], mean, change)
                    command[:, i, k, own] = mean[of_step, None]
                    command[:, i, by_delay, own] = change[of_step, None]
        course: Course = lanes.Course(command, steps, ticks, every, start)
        return course


@dataclass(frozen=True, eq=False)
class _Grid:
    """Rows and controller ticks of a window, which the integration steps divide."""

    stamps: Array  # of its rows, continued to the number of rows of the longest window, (N,) [s]
    ticks: Array  # of the controller after the first row, to the first one after the last row [s]
    dt: float  # median step of the log [s]

    @classmethod
    def of(cls, window: Window, samples: int, rate: float | None) -> "_Grid":
        """Return the grid of a window, continued with the log's median step."""
        t, dt = window.log.t[window.start_row : window.stop], window.dt
        stamps = np.concatenate([t, t[-1] + dt * np.arange(1, samples - len(t) + 1)])
        if rate is None:
            return cls(stamps, np.zeros(0), dt)
        count = rate * (stamps[[0, -1]] - window.log.t[0])
        ticks = window.log.t[0] + np.arange(np.floor(count[0]), count[1] + 2) / rate
        after = np.clip(np.searchsorted(stamps, ticks), 1, len(stamps) - 1)
        for row in (after - 1, after):
            ticks = np.where(np.abs(ticks - stamps[row]) < _SAME / rate, stamps[row], ticks)
        return cls(stamps, ticks[ticks > stamps[0]], dt)

    def sampled(self, ticks: Array) -> Array:
        """Return start and end of the command average of ticks: one row, but at most one tick."""
        after = self.ticks[np.searchsorted(self.ticks, self.stamps[-1])]
        ends = ticks + np.minimum(self.dt, np.diff(ticks, append=after))
        return np.stack([ticks, ends], axis=1).reshape(-1)

    def least_steps(self, step: float, rate: float | None) -> int:
        """Return the number of steps of a row, so that steps divide ticks and end at each."""
        if rate is None:
            return max(1, math.ceil(self.dt / step - 1e-9))
        longest = 1.0 / rate / math.ceil(1.0 / rate / step - 1e-9)
        typical = math.ceil(self.dt / longest - 1e-9)
        inside = np.diff(np.searchsorted(self.ticks, self.stamps))
        at_rows = np.isin(self.stamps[:-1], self.ticks)
        return max(1, typical, int((inside - at_rows).max()) + 1)

    def divided(self, every: int) -> tuple[Array, Array]:
        """Return the ends of all steps, and which steps start with a tick."""
        size = (len(self.stamps) - 1) * every
        times, is_tick = np.empty(size + 1), np.empty(size, dtype=bool)
        spare = np.empty(every + 1), np.empty(every, dtype=np.int64)  # edges and shares of a row
        _lanes().divide_rows(self.stamps, self.ticks, times, is_tick, *spare)
        return times, is_tick


def _parts(tree: Tree) -> list[_Part]:
    """Return the parts of a robot that only the world joins."""
    root: list[int] = []
    for i, parent in enumerate(tree.parents):
        root.append(i if parent < 0 else root[parent])
    bodies = [np.flatnonzero(np.array(root) == r) for r in sorted(set(root))]
    return [_Part(tree.leaders[own], own, tree.part(own)) for own in bodies]


def _arranged(loops: Loops, joints: Array) -> tuple[Array, "Terms", Array]:
    """Return indices in ``loops.values`` of joints' terms, these, sums of affine ones (n, 3)."""
    lanes, first = _lanes(), np.cumsum([0, *map(len, loops.terms)])
    places, spans, affine = list[int](), [], np.zeros((len(joints), 3))
    for i, j in enumerate(joints):
        others, rest = list[int](), list[int]()
        for k, term in enumerate(loops.terms[j], start=first[j]):
            if isinstance(term, MemorylessTerm) and term.affine is not None:
                affine[i, term.affine] += loops.values[k]
                rest.append(k)
            else:
                (rest if isinstance(term, Bristles) else others).append(k)
        spans.append([len(places), len(places) + len(others)])
        places += [*others, *rest]
    terms = list(chain.from_iterable(loops.terms))
    coded = [lanes.coded_term(terms[k]) for k in places]
    codes = np.array([code for code, _ in coded], dtype=np.int64).reshape(-1, 5)
    shapes = np.array([numbers for _, numbers in coded]).reshape(-1, 11)
    states = np.flatnonzero(codes[:, 2] == BRISTLES)
    of_joint = np.searchsorted([start for start, _ in spans], states, side="right") - 1
    order, edges = np.array(places, dtype=int), np.array(spans, dtype=np.int64)
    bristles = np.column_stack([states, of_joint])
    return order, lanes.Terms(codes, shapes, loops.values[order], edges, bristles), affine


def _lanes() -> ModuleType:
    """Return the compiled code of roll-outs, which imports Numba."""
    from robotid.dynamics.simulation import loop_lanes

    return loop_lanes


def _failed_at(
    row: int, last: tuple[Array, Array] | None, q: Array, v: Array
) -> tuple[int, int, int, Array]:
    """Return row, lane and joint of a failed roll-out, and positions (n,); unstable: initial."""
    if last is None:
        is_fast = ~(np.abs(v) < _FASTEST)
        row, i, lane = (int(k) for k in np.unravel_index(np.argmax(is_fast), v.shape))
        return row, lane, i, q[0, :, lane]
    before, change = last
    size = np.nan_to_num(np.abs(change), nan=np.inf, posinf=np.inf)
    i, lane = (int(k) for k in np.unravel_index(np.argmax(size), size.shape))
    return row, lane, i, np.clip(np.nan_to_num(before[:, lane]), -_FASTEST, _FASTEST)


def why_no_solution(
    model: RobotModel, loops: Loops, joints: Array, q: Array, last: int, step: float
) -> str:
    """Return why the joints (k,) of a part have no roll-out beyond their positions q (k,)."""
    M = _mass_matrix(model, loops, joints, q)
    if loops.rate is not None:
        return _slow_rate(loops, loops.rate, [model.joints[j] for j in joints], joints, M)
    for j, angle in zip(joints, q, strict=True):
        if why := _wrong_friction(model, loops, j, angle):
            return (
                f"the simulation of {model.joints[j]} has no solution: {why}. Set other friction "
                f"terms of {model.joints[j]} in [drives]"
            )
    name, kp, inertia = model.joints[joints[last]], float(loops.kp[joints[last]]), M[last, last]
    return (
        f"the simulation of {name} has no solution in steps of {step:g} s: its gain kp is {kp:.3g} "
        f"and its inertia {inertia:.3g}, expected kp below {inertia / step**2:.3g} (inertia / "
        "step^2) and friction that opposes motion. Set gains in [controller] that are closer to "
        "the drive's, or a smaller step in [estimator]"
    )


def _wrong_friction(model: RobotModel, loops: Loops, j: int, angle: float) -> str:
    """Return which friction of a joint makes its motion impossible or ambiguous; else ""."""
    for term in loops.terms[j]:
        value = float(loops.values[loops.place(j, term)])
        is_negative = term.is_nonnegative and value < 0.0
        if is_negative or value > term.highest:
            wanted = "0 or more" if is_negative else f"at most {term.highest:g}"
            return f"{model.joints[j]}.{term.name} is {value:.3g}, expected {wanted}"
    return negative_friction(model, loops, j, np.array([angle]))


def negative_friction(model: RobotModel, loops: Loops, j: int, q: Array) -> str:
    """Return where friction would start the motion of an unloaded joint, else "": q (N,)."""
    friction = np.zeros(len(q))
    for term in loops.terms[j]:
        if isinstance(term, MemorylessTerm) and term.kind == DIRECTED:
            friction += loops.values[loops.place(j, term)] * term.amplitude(q, np.zeros(len(q)))
    if not (least := float(friction.min())) < 0.0:
        return ""
    unit, force = ("m", "N") if model.limits[j].type == "prismatic" else ("rad", "N m")
    stated = f"{least:.3g} {force} at {q[np.argmin(friction)]:.3g} {unit}"
    return f"its Coulomb friction is {stated}, expected 0 or more"


def _slow_rate(loops: Loops, rate: float, names: list[str], joints: Array, M: Array) -> str:
    """Return the least rate of a discrete-time controller with inertias M, shape (k, k)."""
    kp, kd = loops.kp[joints], loops.kd[joints]
    least = 0.5 * np.linalg.eigvals(np.linalg.solve(M, np.diag(kd))).real.max()
    least = max([least, *(0.5 * kp[kd > 0] / kd[kd > 0])])
    return (
        f"the simulation of {listed(names)} is unstable: the controller's rate is {rate:g} Hz, "
        f"expected about {least:.3g} Hz with kp {listed(f'{x:.3g}' for x in kp)} and kd "
        f"{listed(f'{x:.3g}' for x in kd)}. Correct rate in [controller], or leave it out"
    )


def _mass_matrix(model: RobotModel, loops: Loops, joints: Array, q: Array) -> Array:
    """Return the mass matrix of joints at their positions, with armature, shape (k, k)."""
    pi = model.standard_parameters()
    pi[: model.layout.n_inertial] = loops.bodies.reshape(-1)
    bodies, every = model.with_parameters(pi), loops.zero.copy()
    every[joints] += q
    (M,) = rigid_mass_matrices(bodies, bodies.configurations(every[None]))
    return np.asarray((M + np.diag(loops.armature))[np.ix_(joints, joints)])
