"""The paper's simulation: three models of its arm, each found from half of its parameters.

The paper leaves open where the robot starts. On the program exactly, the samples of a run stay so
near one curve that 100 iterations leave 2 % of error; one degree beside it, the same procedure
reaches 1e-5. The simulation starts one degree off, and tells both.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from robotid._typing import Array
from robotid.exceptions import SettingsError
from robotid.paper.dynamics import LinearPlant, PlanarDynamics, torque
from robotid.paper.planar_2r import PAPER_LINKS, PAPER_PARAMETERS, Form, parameters
from robotid.paper.procedure import History, Influences, LoopSettings, random_torque, run_procedure
from robotid.simulation.motions import ProgramMotion

__all__ = [
    "AMPLITUDE",
    "CASES",
    "DURATION",
    "MODELS",
    "Case",
    "ModelStudy",
    "PaperSettings",
    "paper_arm",
    "study_model",
]

#: The three models and the form of the regressor of each.
MODELS: dict[str, Form] = {
    "printed": "printed",
    "corrected": "corrected_five",
    "physical": "corrected",
}
AMPLITUDE = (1.0, 1.5)  # [rad] of the program motion
DURATION = 2.0  # [s]
_START = (np.pi / 180, 0.0)  # [rad] where the robot starts, from its program
_EPS1 = 1e-9  # [N m / s^2] PRX below it is zero


@dataclass(frozen=True)
class Case:
    """Under which conditions the simulation runs.

    Attributes:
        title: What is special, in words.
        offset: Where the robot starts, from its program [rad].
        torque: Disturbance as a share of the control [-].
        noise: Whether the sensors are noisy.
        eps2: |Psi|^2 up to which samples are not used [1/s^4].
    """

    title: str
    offset: tuple[float, float] = _START
    torque: float = 0.0
    noise: bool = False
    eps2: float = 1e-12


#: Noise of the sensors: positions [rad], velocities [rad/s], accelerations [rad/s^2].
_NOISE = {"q": 1e-5, "v": 1e-4, "a": 1e-2}
CASES = {
    "clean": Case("no disturbance, start 1° beside the program"),
    "on_program": Case("no disturbance, start on the program", offset=(0.0, 0.0)),
    "disturbed": Case("torque disturbed by up to ±10 % at random", torque=0.1),
    "noisy": Case("noise of 1e-5 rad, 1e-4 rad/s, 0.01 rad/s²", noise=True),
    "noisy_dead_zone": Case("the same noise, no update where |Ψ|² ≤ 1 s⁻⁴", noise=True, eps2=1.0),
}


@dataclass(frozen=True)
class PaperSettings:
    """How much is simulated.

    Attributes:
        iterations: Runs of the motion in the simulation of the figures.
        longest: Most iterations until PRX is zero.
        runs: Random motions per model.
        patience: Most iterations along each random motion.
        seed: Of the random numbers.
    """

    iterations: int = 100
    longest: int = 500
    runs: int = 120
    patience: int = 300
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("iterations", "longest", "runs", "patience"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} is {getattr(self, name)}, wanted 1 or more")


@dataclass(frozen=True)
class ModelStudy:
    """What the simulation of one model gave.

    Attributes:
        name: Its name in ``MODELS``.
        dynamics: Its regressor.
        P: Its true parameters, shape (c,) [kg m^2].
        history: One run per case, in the order of ``CASES``.
        NA: Iteration in which PRX was zero for the first time without disturbance, or None.
        one_shot_error: Relative error that (18) leaves after one run of the motion.
    """

    name: str
    dynamics: PlanarDynamics
    P: Array
    history: History
    NA: int | None
    one_shot_error: float

    def errors(self, case: str = "clean") -> Array:
        """Return the relative error before the first iteration and after each.

        Args:
            case: Name in ``CASES``.

        Returns:
            Errors, shape (L + 1,).
        """
        column: Array = self.history.relative_error(self.P)[:, list(CASES).index(case)]
        return column

    def program_control(self, points: int) -> tuple[Array, Array]:
        """Return the control that the program motion needs, G(q_pr, v_pr, a_pr) P.

        Args:
            points: Number N of instants.

        Returns:
            Times, shape (N,) [s], and torques, shape (N, 2) [N m].

        References:
            Tzvetkova, (14); figure 4.
        """
        t = np.linspace(0.0, DURATION, points)
        return t, torque(self.dynamics, *_program().evaluate(t), self.P)


def paper_arm(name: str) -> tuple[PlanarDynamics, Array]:
    """Return one of the three models and its true parameters.

    Args:
        name: ``"printed"``, ``"corrected"`` (five columns) or ``"physical"`` (four parameters).

    Returns:
        Regressor and parameters, shape (c,) [kg m^2]. The five are the paper's steady state; the
        physical arm has p4 = p3.

    Raises:
        SettingsError: If there is no such model.
    """
    if name not in MODELS:
        raise SettingsError(f"model is {name!r}, wanted one of {list(MODELS)}")
    P = parameters(PAPER_LINKS) if name == "physical" else PAPER_PARAMETERS
    return PlanarDynamics(MODELS[name]), P


def study_model(
    name: str, settings: PaperSettings, *, progress: Callable[[int], None] | None = None
) -> ModelStudy:
    """Run the paper's simulation of one model, in every case.

    Args:
        name: Name in ``MODELS``.
        settings: How much is simulated.
        progress: Called with the number of each iteration that is done.

    References:
        Tzvetkova, section VI.
    """
    dynamics, P = paper_arm(name)
    plant = LinearPlant(dynamics, P)
    cases = list(CASES.values())
    history = run_procedure(
        dynamics,
        plant,
        _program(),
        np.tile(P / 2, (len(cases), 1)),
        settings=LoopSettings(
            iterations=settings.iterations, eps1=_EPS1, eps2=np.array([c.eps2 for c in cases])
        ),
        offset=np.array([case.offset for case in cases]),
        influences=_influences(cases, np.random.default_rng(settings.seed)),
        keep_torques=True,
        progress=progress,
    )
    endless = LoopSettings(iterations=settings.longest, eps1=_EPS1)
    once = LoopSettings(iterations=1, method="one_shot")
    further, single = (
        run_procedure(dynamics, plant, _program(), P[None] / 2, settings=s, offset=np.array(_START))
        for s in (endless, once)
    )
    return ModelStudy(
        name=name,
        dynamics=dynamics,
        P=P,
        history=history,
        NA=int(further.NA[0]) or None,
        one_shot_error=float(single.relative_error(P)[-1, 0]),
    )


def _program() -> ProgramMotion:
    return ProgramMotion(np.array(AMPLITUDE), DURATION)


def _influences(cases: list[Case], rng: np.random.Generator) -> Influences:
    share = np.array([[case.torque] for case in cases])
    is_noisy = np.array([[float(case.noise)] for case in cases])
    noise = {key: level * is_noisy for key, level in _NOISE.items()}
    return Influences(random_torque(share, rng), rng=rng, **noise)
