"""The paper's procedure, and its simulation: a robot follows a program while it is identified.

One iteration is one run of the program motion. At each of its updates the control (21) is computed
from the estimate, the plant moves, and the estimate is updated by the deviation (24). R runs are
computed together, one row each. In shapes "..." stands for () or (R,). Numbers in parentheses are
equations of Tzvetkova, Extracting Inertial Parameters from Robotic Manipulators Dynamics.

The paper does not state where the robot starts. With a start exactly on the program, the samples of
a run are so near one curve that the error after 100 iterations is 2 %; with a start one degree off
it, the error is 1e-5. The simulation starts one degree off, and reports both.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from robotid.base.exceptions import RankDeficientError, SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.dynamics.simulation.motions import ProgramMotion
from robotid.paper.planar_2r import (
    PAPER_LINKS,
    PAPER_PARAMETERS,
    PARAMETER_NAMES,
    Form,
    parameters,
    printed_velocity_coefficient,
    regressor,
)

_DIVERGED = 1e3  # [rad or m; per s] deviation from the program beyond which a run is stopped

#: Accelerations of R robots, from their q, v and torques u, each of shape (R, n).
Plant: TypeAlias = Callable[[Array, Array, Array], Array]


@dataclass(frozen=True)
class LinearDynamics:
    """A model D(q, P) a + C(q, v, P) = G(q, v, a) P = u that is linear in P, (11)-(13)."""

    names: tuple[str, ...]  # of the c parameters
    regressor: Callable[[Array, Array, Array], Array]  # G, q, v, a (R, n) -> (R, n, c)

    def torque(self, q: Array, v: Array, a: Array, P: Array) -> Array:
        """Return u = G(q, v, a) P (13): q, v, a (R, n), P (c,) or (R, c) -> (R, n)."""
        G = self.regressor(q, v, a)  # (R, n, c)
        u: Array = np.einsum("rnc,rc->rn", G, np.broadcast_to(P, (len(q), G.shape[-1])))
        return u

    def mass_matrix(self, q: Array, P: Array) -> Array:
        """Return D(q, P) from the base parameters alone: q (R, n) -> (R, n, n)."""
        return self._mass_and_bias(q, np.zeros_like(q), P)[0]

    def acceleration(self, q: Array, v: Array, u: Array, P: Array) -> Array:
        """Return a = D(q, P)^-1 (u - C(q, v, P)) (11), shape (R, n): not only of rigid bodies."""
        D, C = self._mass_and_bias(q, v, P)
        a: Array = np.linalg.solve(D, (u - C)[..., None])[..., 0]
        return a

    def _mass_and_bias(self, q: Array, v: Array, P: Array) -> tuple[Array, Array]:
        """Return D(q, P), shape (R, n, n), and C(q, v, P), shape (R, n).

        Column j of D is (G(q, 0, e_j) - G(q, 0, 0)) P: without gravity and constant offsets.
        """
        R, n = q.shape
        unit = np.concatenate([np.eye(n), np.zeros((2, n))])  # accelerations e_1 .. e_n, 0, 0
        a = np.repeat(unit, R, axis=0)  # ((n + 2) R, n)
        speeds = np.zeros_like(a)
        speeds[-R:] = v
        G = self.regressor(np.tile(q, (n + 2, 1)), speeds, a)
        parameters = np.broadcast_to(P, (R, G.shape[-1]))
        u = np.einsum("krnc,rc->krn", G.reshape(n + 2, R, n, -1), parameters)
        return (u[:n] - u[n]).transpose(1, 2, 0), u[n + 1]


def reference_acceleration(
    q: Array, v: Array, program: tuple[Array, Array, Array], alpha: Array, beta: Array
) -> Array:
    """Return q_* = a_pr - alpha (v - v_pr) - beta (q - q_pr) (15), shape (..., n)."""
    q_pr, v_pr, a_pr = program
    q_star: Array = a_pr - alpha * (v - v_pr) - beta * (q - q_pr)
    return q_star


def proximity(Psi: Array, P: Array, u: Array) -> Array:
    """Return PRX = Psi^T Psi P - Psi^T u (23), printed with a plus, shape (..., c).

    It is the gradient (4) of the criterion (3), J = |u - Psi P|^2 / 2, and zero at the true
    parameters. Psi (..., n, c), P (..., c), u (..., n) [N m or N].
    """
    residual = np.einsum("...nc,...c->...n", Psi, P) - u
    gradient: Array = np.einsum("...nc,...n->...c", Psi, residual)
    return gradient


def recursive_update(
    P: Array, Psi: Array, eta: Array, sigma: Array, is_open: Array, *, eps2: float | Array = 1e-12
) -> Array:
    """Return P - sigma_D / |Psi|^2 Psi^T eta (24), shape (..., c), with |Psi|^2 = Sp(Psi Psi^T).

    Psi (..., n, c), eta (..., n), sigma (...), is_open (...).
    """
    size = np.einsum("...nc,...nc->...", Psi, Psi)
    moves = is_open & (size > eps2) & (sigma > 0.0)
    gamma = np.where(moves, sigma, 0.0) / np.where(moves, size, 1.0)
    updated: Array = P - gamma[..., None] * np.einsum("...nc,...n->...c", Psi, eta)
    return updated


def one_shot(G: Array, G_star: Array, P: Array, names: Sequence[str]) -> Array:
    """Return the parameters from one recorded motion, P = G^+ G_* P^ (16)-(19), shape (c,).

    The torque is G P, with the measured acceleration, and G_* P^, with the reference acceleration
    (15) from which it was computed. G (N n, c), G_star (N n, c).
    """
    U, s, Vt = np.linalg.svd(G, full_matrices=False)
    rank = int(np.sum(s > s[0] * 1e-10)) if s[0] > 0 else 0
    if rank < G.shape[1]:
        is_open = np.sum(Vt[:rank] ** 2, axis=0) < 0.99
        raise RankDeficientError(rank, np.array(list(names))[is_open].tolist(), G.shape[1])
    solved: Array = Vt.T @ ((U.T @ (G_star @ P)) / s)
    return solved


def smallest_eigenvalue(D: Array) -> Array:
    """Return sigma_D of (24), the smallest eigenvalue of each matrix: D (R, n, n) -> (R,)."""
    smallest: Array = np.linalg.eigvalsh((D + D.swapaxes(-1, -2)) / 2)[..., 0]
    return smallest


def rk4(
    acceleration: Callable[[Array, Array], Array],
    q: Array,
    v: Array,
    h: float | Array,
    a: Array | None = None,
) -> tuple[Array, Array]:
    """Return positions and velocities one step later, by the Runge-Kutta method of order 4."""
    a1 = acceleration(q, v) if a is None else a
    v2 = v + h / 2 * a1
    a2 = acceleration(q + h / 2 * v, v2)
    v3 = v + h / 2 * a2
    a3 = acceleration(q + h / 2 * v2, v3)
    v4 = v + h * a3
    a4 = acceleration(q + h * v3, v4)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


@dataclass(frozen=True)
class LoopSettings:
    """Settings of the procedure; alpha, beta and eps2 may differ from run to run, shape (R,)."""

    alpha: float | Array = 20.0  # gain of the velocity in (15) [1/s]
    beta: float | Array = 100.0  # gain of the position in (15) [1/s^2]
    iterations: int = 100  # largest number of runs of the motion
    updates: int = 100  # updates per run; the torque is constant between them (zero-order hold)
    # ``"recursive"``, (24) at each update, or ``"one_shot"``, (18) after each run
    method: Literal["recursive", "one_shot"] = "recursive"
    eps1: float = 1e-9  # if no entry of PRX is larger, it counts as zero [N m / s^2]
    eps2: float | Array = 1e-12  # if |Psi|^2 is not above it, there is no update [1/s^4]


@dataclass(frozen=True)
class Influences:
    """Disturbance of the plant and noise of its sensors."""

    # v(t) of (11) from times (R,) and control (R, n), constant between updates; None for none
    torque: Callable[[Array, Array], Array] | None = None
    # standard deviations of white noise, each a number or an array that broadcasts to (R, n)
    q: float | Array = 0.0  # [rad or m]
    v: float | Array = 0.0  # [rad/s or m/s]
    a: float | Array = 0.0  # [rad/s^2 or m/s^2]
    rng: np.random.Generator | None = None  # of the noise; None for sensors without noise

    def sensed(self, value: Array, level: float | Array) -> Array:
        """Return a measured value, with white noise of a standard deviation."""
        if self.rng is None or not np.any(np.asarray(level) != 0):
            return value
        noisy: Array = value + level * self.rng.standard_normal(value.shape)
        return noisy


@dataclass(frozen=True)
class History:
    """The course of R runs over L iterations."""

    estimates: Array  # (L + 1, R, c), P^ before the first iteration and after each
    prx: Array  # (L, R), largest entry of PRX (23) during each iteration [N m / s^2]
    tracking: Array  # (L, R), largest distance from the program in each iteration [rad or m]
    # (R,), the first iteration in which PRX was zero throughout (25), after which the estimate is
    # constant; 0 if there was none
    NA: NDArray[np.int_]
    # (R,), the iteration in which the robot diverged from its program, after which the estimate is
    # constant; 0 if it did not
    diverged: NDArray[np.int_]
    skipped: NDArray[np.int_]  # (R,), updates omitted since D(q, P^) was not positive definite
    torques: Array  # (L, updates, n), control u (21) of the first run [N m or N]

    def relative_error(self, P: Array) -> Array:
        """Return |P^ - P| / |P| before the first iteration and after each: P (c,) -> (L + 1, R)."""
        error: Array = np.linalg.norm(self.estimates - P, axis=-1) / np.linalg.norm(P)
        return error


def run_procedure(
    dynamics: LinearDynamics,
    plant: Plant,
    motion: ProgramMotion,
    P0: Array,
    *,
    settings: LoopSettings | None = None,
    offset: Array | float = 0.0,
    influences: Influences | None = None,
    progress: Callable[[int], None] | None = None,
) -> History:
    """Run the closed-loop procedure (14)-(25) from initial values P0 (R, c).

    Each iteration starts at rest at the start of the program, or at an offset from it, (n,).
    """
    chosen = settings or LoopSettings()
    loop = _Loop(dynamics, plant, motion, chosen, influences or Influences(), P0, offset)
    for number in range(1, chosen.iterations + 1):
        loop.iterate(number)
        if progress is not None:
            progress(number)
        if not loop.active.any():
            break
    estimates, prx, tracking, torques = map(np.stack, loop.courses)
    return History(estimates, prx, tracking, loop.NA, loop.diverged, loop.skipped, torques)


@dataclass
class _Loop:
    """The state and the course of all runs."""

    dynamics: LinearDynamics
    plant: Plant
    motion: ProgramMotion
    settings: LoopSettings
    influences: Influences
    P: Array  # (R, c), the estimates
    offset: Array | float

    def __post_init__(self) -> None:
        R, settings, motion = len(self.P), self.settings, self.motion
        self.alpha, self.beta = (np.reshape(x, (-1, 1)) for x in (settings.alpha, settings.beta))
        self.dt = np.broadcast_to(np.asarray(motion.duration) / settings.updates, (R,))  # [s]
        self.start = motion.evaluate(np.zeros(R))[0] + self.offset  # (R, n)
        self.active = np.ones(R, dtype=bool)
        self.NA, self.diverged, self.skipped = (np.zeros(R, dtype=int) for _ in range(3))
        #: Estimates, PRX, distances and torques, by iteration.
        self.courses: tuple[list[Array], ...] = ([self.P], [], [], [])

    def iterate(self, number: int) -> None:
        """Run the motion once, with its updates."""
        settings, influences, h = self.settings, self.influences, self.dt[:, None]
        q, v = self.start, np.zeros_like(self.start)
        largest, distance = np.zeros(len(q)), np.zeros(len(q))
        torques, samples = [], []
        for k in range(settings.updates):
            t = k * self.dt
            q_pr = self.motion.evaluate(t)
            q, v = self._reset_diverged(number, q, v, q_pr)
            distance = np.maximum(distance, np.abs(q - q_pr[0]).max(axis=1))
            q_seen = influences.sensed(q, influences.q)
            v_seen = influences.sensed(v, influences.v)
            q_star = reference_acceleration(q_seen, v_seen, q_pr, self.alpha, self.beta)  # (15)
            Psi = self.dynamics.regressor(q_seen, v_seen, q_star)  # (R, n, c), (22)
            u = np.einsum("rnc,rc->rn", Psi, self.P)  # (21)
            applied = u if influences.torque is None else u + influences.torque(t, u)
            a = self.plant(q, v, applied)
            a_seen = influences.sensed(a, influences.a)
            G = self.dynamics.regressor(q_seen, v_seen, a_seen)  # (12)
            prx = np.abs(proximity(G, self.P, u)).max(axis=1)  # (23)
            largest = np.maximum(largest, prx)
            if settings.method == "recursive":
                eta = a_seen - q_star  # (20), the deviation of the real from the program motion
                self._update(q_seen, Psi, eta, prx > settings.eps1)
            else:
                samples.append((G, Psi))
            torques.append(u[0])
            q, v = rk4(lambda q, v, u=applied: self.plant(q, v, u), q, v, h, a)  # type: ignore[misc]
        if samples:
            self._update_once(samples)
        is_zero = self.active & (largest <= settings.eps1)
        self.NA = np.where(is_zero, number, self.NA)  # (25)
        self.active = self.active & ~is_zero
        course = (self.P, largest, distance, np.stack(torques))
        for values, value in zip(self.courses, course, strict=True):
            values.append(value)

    def _update(self, q: Array, Psi: Array, eta: Array, is_open: NDArray[np.bool_]) -> None:
        sigma = smallest_eigenvalue(self.dynamics.mass_matrix(q, self.P))
        self.skipped = self.skipped + (self.active & (sigma <= 0.0))
        is_open = is_open & self.active
        eps2 = self.settings.eps2
        self.P = recursive_update(self.P, Psi, eta, sigma, is_open, eps2=eps2)  # (24)

    def _update_once(self, samples: list[tuple[Array, Array]]) -> None:
        G, G_star = (np.concatenate(part, axis=1) for part in zip(*samples, strict=True))
        P = self.P.copy()
        for r in np.flatnonzero(self.active):
            P[r] = one_shot(G[r], G_star[r], self.P[r], self.dynamics.names)  # (18)
        self.P = P

    def _reset_diverged(
        self, number: int, q: Array, v: Array, program: tuple[Array, Array, Array]
    ) -> tuple[Array, Array]:
        deviation = np.maximum(np.abs(q - program[0]), np.abs(v - program[1])).max(axis=1)
        diverges = ~(deviation < _DIVERGED)  # also with NaN
        self.diverged = np.where(diverges & self.active, number, self.diverged)
        self.active = self.active & ~diverges
        reset = (diverges | (self.diverged > 0))[:, None]
        return np.where(reset, program[0], q), np.where(reset, program[1], v)


#: The three models and the form of the regressor of each.
MODELS: dict[str, Form] = {
    "printed": "printed", "corrected": "corrected_five", "physical": "corrected",
}  # fmt: skip
AMPLITUDE = (1.0, 1.5)  # [rad] of the program motion
DURATION = 2.0  # [s]
PROGRAM = ProgramMotion(np.array(AMPLITUDE), DURATION)
_START = (np.pi / 180, 0.0)  # [rad] start of the robot relative to its program
#: Relative error at which a run has converged; a smaller decrease over ten iterations is none [-].
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Case:
    """The conditions of a simulation."""

    title: str  # Description
    offset: tuple[float, float] = _START  # start of the robot relative to its program [rad]
    torque: float = 0.0  # disturbance as a share of the control [-]
    noise: bool = False  # whether the sensors are noisy
    eps2: float = 1e-12  # largest |Psi|^2 of samples that are not used [1/s^4]


#: Noise of the sensors: positions [rad], velocities [rad/s], accelerations [rad/s^2].
_NOISE = {"q": 1e-5, "v": 1e-4, "a": 1e-2}
CASES = {
    "clean": Case("no disturbance, start 1° off the program"),
    "on_program": Case("no disturbance, start on the program", offset=(0.0, 0.0)),
    "disturbed": Case("torque disturbed by up to ±10 % at random", torque=0.1),
    "noisy": Case("noise of 1e-5 rad, 1e-4 rad/s, 0.01 rad/s²", noise=True),
    "noisy_dead_zone": Case("the same noise, no update where |Ψ|² ≤ 1 s⁻⁴", noise=True, eps2=1.0),
}


@dataclass(frozen=True)
class PaperSettings:
    """Numbers of iterations and runs."""

    iterations: int = 100  # runs of the motion in the simulation of the figures
    longest: int = 500  # largest number of iterations until PRX is zero
    runs: int = 120  # random motions per model
    patience: int = 300  # largest number of iterations for each random motion
    seed: int = 0  # seed of the random numbers

    def __post_init__(self) -> None:
        for name in ("iterations", "longest", "runs", "patience"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} is {getattr(self, name)}, expected 1 or more")


@dataclass(frozen=True)
class ModelStudy:
    """The results of the simulation of one model."""

    name: str  # its name in ``MODELS``
    dynamics: LinearDynamics  # its regressor
    P: Array  # (c,), its true parameters [kg m^2]
    history: History  # one run per case, in the order of ``CASES``
    NA: int | None  # first iteration in which PRX was zero without disturbance, or None
    one_shot_error: float  # relative error of (18) after one run of the motion

    def errors(self, case: str = "clean") -> Array:
        """Return the relative error before the first iteration and after each, (L + 1,)."""
        column: Array = self.history.relative_error(self.P)[:, list(CASES).index(case)]
        return column

    def program_control(self, points: int) -> tuple[Array, Array]:
        """Return times (N,) and the control of the program motion (14), (N, 2) [N m]."""
        t = np.linspace(0.0, DURATION, points)
        return t, self.dynamics.torque(*PROGRAM.evaluate(t), self.P)


def planar_dynamics(form: Form = "corrected") -> LinearDynamics:
    """Return the paper's arm in closed form."""
    return LinearDynamics(PARAMETER_NAMES[form], partial(regressor, form=form))


def paper_arm(name: str) -> tuple[LinearDynamics, Array]:
    """Return one of the three models and its true parameters, (c,) [kg m^2]."""
    if name not in MODELS:
        raise SettingsError(f"model is {name!r}, expected one of {listed(MODELS)}")
    P = parameters(PAPER_LINKS) if name == "physical" else PAPER_PARAMETERS
    return planar_dynamics(MODELS[name]), P


def study_model(
    name: str, settings: PaperSettings, *, progress: Callable[[int], None] | None = None
) -> ModelStudy:
    """Run the paper's simulation (section VI) of one model, in every case."""
    dynamics, P = paper_arm(name)
    plant, cases = partial(dynamics.acceleration, P=P), list(CASES.values())
    eps2 = np.array([case.eps2 for case in cases])
    history = run_procedure(
        dynamics,
        plant,
        PROGRAM,
        np.tile(P / 2, (len(cases), 1)),
        settings=LoopSettings(iterations=settings.iterations, eps2=eps2),
        offset=np.array([case.offset for case in cases]),
        influences=_influences(cases, np.random.default_rng(settings.seed)),
        progress=progress,
    )
    endless = LoopSettings(iterations=settings.longest)
    once = LoopSettings(iterations=1, method="one_shot")
    further, single = (
        run_procedure(dynamics, plant, PROGRAM, P[None] / 2, settings=s, offset=np.array(_START))
        for s in (endless, once)
    )
    first, error = int(further.NA[0]) or None, float(single.relative_error(P)[-1, 0])
    return ModelStudy(name, dynamics, P, history, first, error)


def _influences(cases: list[Case], rng: np.random.Generator) -> Influences:
    share = np.array([[case.torque] for case in cases])
    is_noisy = np.array([[float(case.noise)] for case in cases])
    noise = {key: level * is_noisy for key, level in _NOISE.items()}
    # v(t) of (2), (11): uniform within a share of the control, drawn at each update
    return Influences(lambda t, u: share * u * rng.uniform(-1.0, 1.0, u.shape), rng=rng, **noise)


@dataclass(frozen=True)
class RandomRuns:
    """R random motions, and the course of the estimate on each."""

    #: Of each run, R rows each: amplitude [rad] and duration [s] of the motion (28), bandwidth w of
    #: the control, alpha = 2 w and beta = w^2, as gain [1/s], initial values as guess, and offset,
    #: the start of the robot relative to its program [rad].
    drawn: dict[str, Array]
    errors: Array  # (L + 1, R), relative error before the first iteration and after each
    history: History  # the course of the runs

    def to_dict(self) -> dict[str, Any]:
        """Return the part of paper.json."""
        reached = self.errors < TOLERANCE  # (L + 1, R)
        has_converged = np.asarray(reached.any(axis=0))
        return {
            "runs": len(has_converged),
            "converged": int(has_converged.sum()),
            "tolerance": TOLERANCE,
            "most_iterations": len(self.errors) - 1,
            "iterations": reached.argmax(axis=0)[has_converged].tolist(),
            "failures": [
                {
                    "run": r,
                    "reason": self._reason(r),
                    "relative_error": float(self.errors[-1, r]),
                    **{key: values[r].tolist() for key, values in self.drawn.items()},
                }
                for r in np.flatnonzero(~has_converged).tolist()
            ],
        }

    def _reason(self, r: int) -> str:
        if self.history.diverged[r]:
            return f"the robot diverged from its program in iteration {self.history.diverged[r]}"
        reason = _course(self.errors[:, r])
        if skipped := self.history.skipped[r]:
            reason += f"; {skipped} updates were omitted, since D(q, P^) was not positive definite"
        return reason


def random_runs(
    dynamics: LinearDynamics,
    P: Array,
    runs: int,
    iterations: int,
    rng: np.random.Generator,
    *,
    largest_offset: float = 0.05,
    progress: Callable[[int], None] | None = None,
) -> RandomRuns:
    """Run the procedure with random motions, initial values, gains and starts.

    Each joint moves by 0.5 to 2 rad in either direction in 1 to 3 s. The initial value of each
    parameter is 0.3 to 1.7 times its true value, P (c,). The bandwidth is 5 to 20 1/s.
    """
    n = len(AMPLITUDE)
    amplitude = rng.uniform(0.5, 2.0, (runs, n)) * rng.choice([-1.0, 1.0], (runs, n))
    duration, gain = rng.uniform(1.0, 3.0, runs), rng.uniform(5.0, 20.0, runs)
    guess = P * rng.uniform(0.3, 1.7, (runs, len(P)))
    offset = largest_offset * rng.uniform(-1.0, 1.0, (runs, n))
    history = run_procedure(
        dynamics,
        partial(dynamics.acceleration, P=P),
        ProgramMotion(amplitude, duration),
        guess,
        settings=LoopSettings(alpha=2 * gain, beta=gain**2, iterations=iterations),
        offset=offset,
        progress=progress,
    )
    drawn = {"amplitude": amplitude, "duration": duration, "gain": gain}
    drawn |= {"guess": guess, "offset": offset}
    return RandomRuns(drawn, history.relative_error(P), history)


def _course(error: Array) -> str:
    """Return why an error, shape (L + 1,), is not small at its end."""
    count = len(error) - 1
    last = min(count, 10)
    decrease = 1.0 - error[-1] / error[count - last]
    if error[-1] > error[0]:
        return f"the error increased: from {error[0]:.2g} to {error[-1]:.2g}"
    if decrease < TOLERANCE:
        return f"stalled: the motion excites too little; the error is {error[-1]:.2g}"
    return (
        f"slow: the error is {error[-1]:.2g} after {count} iterations, with a decrease of "
        f"{100 * decrease:.2g} % in the last {last}"
    )


_STATES = 2000
_RANGE = (np.pi, 10.0, 20.0)  # [rad], [rad/s], [rad/s^2] of the random states
_FREE = (np.array([[0.0, 1.0]]), np.array([[1.0, 2.0]]))  # [rad], [rad/s] start of free motion


def errata(rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return the errata that change a torque, with its largest difference at random states.

    The last one is that of (22) in (23). Proof: u of (21) is C(q, v, P^) + D(q, P^) q_*, linear in
    P^, so u = Psi P^ with its gradient Psi (22), and PRX = Psi^T (Psi P^ - u) = 0 for every P^.
    """
    somewhere = tuple(size * rng.uniform(-1, 1, (_STATES, 2)) for size in _RANGE)
    program = PROGRAM.evaluate(np.linspace(0, DURATION, 401))
    largest = [
        [float(np.abs(difference).max()) for difference in _differences(*states)]
        for states in (somewhere, program)
    ]
    texts = [
        ("(26)", "C122 = C211 = h, C112 undefined", "C122 = −h, C211 = h, C112 = −2h"),
        ("G, column 4", "[s₂ q̇₁²; −s₂ q̇₂²]", "[−s₂ q̇₂²; s₂ q̇₁²]"),
        ("(27), p4", "p4 = L₁ m₂ȳ₂ + L₁ L₂ m₂", "p4 = L₁ m₂x̄₂ + L₁ L₂ m₂ = p3"),
        ("(23), read as a torque residual at P̂ = P", "ΨᵀΨP̂ + Ψᵀu", "ΨᵀΨP̂ − Ψᵀu"),
        ("(23) with Ψ of (22), residual at P̂ = P / 2", "Ψ = G(q, q̇, q_*)", "Ψ = G(q, q̇, q̈)"),
    ]
    keys = ("where", "printed", "corrected", "max_torque_difference",
            "max_torque_difference_on_program")  # fmt: skip
    rows = zip(texts, *largest, strict=True)
    return [dict(zip(keys, (*text, *sizes), strict=True)) for text, *sizes in rows]


def energy_drift(*, duration: float = 10.0, dt: float = 4e-3) -> tuple[Array, dict[str, Array]]:
    """Return times and the kinetic energy that each model gains without torque, over its first.

    That of a rigid arm is constant. Shapes (N,) [s] and (N,) [-].
    """
    t = dt * np.arange(round(duration / dt) + 1)
    energy = {name: _free_energy(name, len(t), dt) for name in MODELS}
    return t, {name: E / E[0] - 1.0 for name, E in energy.items()}


def _differences(q: Array, v: Array, a: Array) -> list[Array]:
    """Return the torque difference of each erratum at N states, each shape (N, 2)."""
    P = parameters(PAPER_LINKS)
    five = parameters(PAPER_LINKS, form="corrected_five")
    h = printed_velocity_coefficient(q, PAPER_LINKS)
    v1, v2 = v.T
    missing = np.stack([2 * h * v2 * (v1 + v2), np.zeros(len(q))], axis=1)  # printed - corrected
    G, G_printed = (regressor(q, v, a, form=form) for form in ("corrected_five", "printed"))
    swapped = (G_printed - G) @ five
    p4 = G_printed @ (PAPER_PARAMETERS - five)
    residual = 2 * (regressor(q, v, a) @ P)  # Psi P + u instead of Psi P - u = 0
    arm, P_hat = planar_dynamics(), P / 2
    u = arm.torque(q, v, a, P_hat)  # (21), Psi P^ with q_* = a
    omitted = arm.torque(q, v, arm.acceleration(q, v, u, P), P_hat) - u  # by (22): G P^ - Psi P^
    return [missing, swapped, p4, residual, omitted]


def _free_energy(name: str, steps: int, h: float) -> Array:
    (dynamics, P), (q, v) = paper_arm(name), _FREE
    free = partial(dynamics.acceleration, u=np.zeros((1, 2)), P=P)
    states = []
    for _ in range(steps):
        states.append((q[0], v[0]))
        q, v = rk4(free, q, v, h)
    angles, speeds = (np.array(part) for part in zip(*states, strict=True))
    D = dynamics.mass_matrix(angles, P)
    energy: Array = np.einsum("ki,kij,kj->k", speeds, D, speeds) / 2
    return energy
