"""The effect of the paper's errata: torque differences, and energy gained by the printed arm."""

from dataclasses import dataclass

import numpy as np

from robotid.base.typing import Array
from robotid.paper.equations import LinearPlant, PlanarDynamics, mass_matrix, rk4, torque
from robotid.paper.planar_2r import (
    PAPER_LINKS,
    PAPER_PARAMETERS,
    parameters,
    printed_velocity_coefficient,
    regressor,
)
from robotid.paper.study import DURATION, MODELS, PROGRAM, paper_arm

_STATES = 2000
_RANGE = (np.pi, 10.0, 20.0)  # [rad], [rad/s], [rad/s^2] of the random states
_FREE = (np.array([[0.0, 1.0]]), np.array([[1.0, 2.0]]))  # [rad], [rad/s] start of free motion


@dataclass(frozen=True)
class Erratum:
    """One error of the printed text."""

    where: str  # the equation
    printed: str  # the printed text
    corrected: str  # the corrected text
    # the largest over random states [N m]; for (23) that of the residual with the gradient PRX
    max_torque_difference: float
    max_torque_difference_on_program: float  # the largest along the program motion [N m]


@dataclass(frozen=True)
class EnergyDrift:
    """Kinetic energy of the arm without torque."""

    t: Array  # times, shape (N,) [s]
    # per model, the energy gained since the start over the initial energy, shape (N,)
    gained: dict[str, Array]


def errata(rng: np.random.Generator) -> list[Erratum]:
    """Return the errata that change a torque, each with its largest torque difference.

    The last one is that of (22) in (23). Proof: u of (21) is C(q, v, P^) + D(q, P^) q_*, linear in
    P^, so u = Psi P^ with its gradient Psi (22), and PRX = Psi^T (Psi P^ - u) = 0 for every P^.

    References:
        Tzvetkova, (21)-(27).
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
    return [Erratum(*text, *sizes) for text, *sizes in zip(texts, *largest, strict=True)]


def energy_drift(*, duration: float = 10.0, dt: float = 4e-3) -> EnergyDrift:
    """Return the energy of each model in free motion; that of a rigid arm is constant."""
    t = dt * np.arange(round(duration / dt) + 1)
    energy = {name: _free_energy(name, len(t), dt) for name in MODELS}
    return EnergyDrift(t, {name: E / E[0] - 1.0 for name, E in energy.items()})


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
    return [missing, swapped, p4, residual, _omitted_residual(q, v, a, P)]


def _omitted_residual(q: Array, v: Array, q_star: Array, P: Array) -> Array:
    """Return the residual of P^ = P / 2 that (22) omits, G P^ - Psi P^, shape (N, 2)."""
    arm, P_hat = PlanarDynamics("corrected"), P / 2
    u = torque(arm, q, v, q_star, P_hat)  # (21), Psi P^
    a = LinearPlant(arm, P).acceleration(q, v, u)
    return torque(arm, q, v, a, P_hat) - u


def _free_energy(name: str, steps: int, h: float) -> Array:
    dynamics, P = paper_arm(name)
    plant, (q, v), nothing = LinearPlant(dynamics, P), _FREE, np.zeros((1, 2))
    states = []
    for _ in range(steps):
        states.append((q[0], v[0]))
        q, v = rk4(lambda q, v, _: plant.acceleration(q, v, nothing), q, v, h)
    angles, speeds = (np.array(part) for part in zip(*states, strict=True))
    D = mass_matrix(dynamics, angles, P)
    energy: Array = np.einsum("ki,kij,kj->k", speeds, D, speeds) / 2
    return energy
