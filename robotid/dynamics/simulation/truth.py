"""The true parameters of a simulated robot: near its URDF's, physically consistent."""

import numpy as np

from robotid.base.exceptions import ModelError, SettingsError
from robotid.base.findings import listed, suggestion
from robotid.base.typing import Array
from robotid.dynamics.simulation.simulation_settings import Truth
from robotid.robot.drive_term import MemorylessTerm
from robotid.robot.model import RobotModel
from robotid.robot.parameters import inertial_from_pseudo_inertia, pseudo_inertia

_TYPICAL_EFFORT = 50.0  # effort limit of a drive with typical parameters [N m or N]
_IMPOSSIBLE = -1e-9  # smallest eigenvalue of a body's pseudo-inertia over the largest


def draw_parameters(model: RobotModel, settings: Truth, rng: np.random.Generator) -> Array:
    """Return the true standard parameters of a robot near the model, shape (p,)."""
    layout = model.layout
    pi = model.standard_parameters()
    pi[: layout.n_inertial] = perturbed_bodies(model, settings.inertials, rng)
    has_drives = settings.drives == "usual"
    effort = {joint.name: joint.effort for joint in model.limits}
    for i, (d, term) in enumerate(layout.drive_parameters, start=layout.n_inertial):
        drawn = rng.uniform(*term.typical)
        shares = [x / _TYPICAL_EFFORT for j, _ in layout.drives[d].ratios if (x := effort[j]) > 0]
        is_share = isinstance(term, MemorylessTerm) and term.is_loaded
        size = 1.0 if is_share or term.is_measured else min([1.0, *shares])
        pi[i] = has_drives * size * drawn
    for name, value in settings.values.items():
        if name not in layout.names:
            raise SettingsError(
                f"truth: values: {name!r} is not a parameter of {model.name}"
                f"{suggestion(name, layout.names)} Known: {listed(layout.names, 12)}"
            )
        pi[layout.names.index(name)] = value
    _check(model, pi)
    return pi


def perturbed_bodies(model: RobotModel, size: float, rng: np.random.Generator) -> Array:
    """Return inertial parameters of bodies near the model's, shape (10 bodies,).

    J' = J^1/2 exp(S) J^1/2 of each body; S is symmetric, with ten independent normal coordinates in
    the metric d^2 = 1/2 tr(log(J^-1 J')^2) (Wensing, Kim, Slotine 2018; Lee, Park 2018, (13)).
    """
    bodies = model.standard_parameters()[: model.layout.n_inertial]
    if size == 0.0:
        return bodies
    perturbed = []
    for name, J in zip(model.layout.bodies, pseudo_inertia(bodies), strict=True):
        values, axes = np.linalg.eigh(J)
        if values[0] < _IMPOSSIBLE * max(values[-1], 0.0) or values[-1] < 0:
            raise ModelError(
                f"body {name!r} of the URDF is physically inconsistent: the smallest eigenvalue of "
                f"its pseudo-inertia is {values[0]:.3g}, wanted 0 or more. Correct its inertial "
                "(robotid inspect), or state inertials = 0 in [truth]"
            )
        root = axes * np.sqrt(np.maximum(values, 0.0)) @ axes.T
        S = np.zeros((4, 4))
        S[np.triu_indices(4, 1)] = rng.standard_normal(6)
        S = S + S.T + np.diag(np.sqrt(2.0) * rng.standard_normal(4))  # 1/2 tr(S^2): ten squares
        values, axes = np.linalg.eigh(size * S)
        factor = axes * np.exp(values) @ axes.T  # exp(size S)
        perturbed.append(inertial_from_pseudo_inertia(root @ factor @ root))
    return np.concatenate(perturbed)


def another_robot(model: RobotModel, rng: np.random.Generator) -> Array:
    """Return parameters (p,) of a robot with other masses (10 to 30 %), a tool, and friction."""
    size = model.layout.n_inertial
    pi = model.standard_parameters()
    by_body = pi[:size].reshape(-1, 10)
    change = rng.uniform(0.1, 0.3, len(by_body)) * rng.choice([-1, 1], len(by_body))
    by_body *= 1 + change[:, None]
    mass, arm = 1.2, 0.1  # [kg], [m]
    tool = [mass, 0.0, mass * arm, 0.0, mass * arm**2, 0.0, 0.0, 0.0, 0.0, mass * arm**2]
    by_body[-1] += tool
    by_body[-1] += [0, 0, 0, 0, 1e-3, 0, 1e-3, 0, 0, 1e-3]  # a tool has an extent
    for i, (_, term) in enumerate(model.layout.drive_parameters, start=size):
        pi[i] = rng.uniform(*term.typical)
    return pi


def _check(model: RobotModel, pi: Array) -> None:
    """Refuse physically inconsistent parameters of bodies and drives."""
    layout = model.layout
    bodies = pseudo_inertia(pi[: layout.n_inertial])
    for name, J in zip(layout.bodies, bodies, strict=True):
        values = np.linalg.eigvalsh(J)
        if values[0] < _IMPOSSIBLE * max(values[-1], 0.0):
            raise SettingsError(
                f"truth: body {name!r} is physically inconsistent: the smallest eigenvalue of its "
                f"pseudo-inertia is {values[0]:.3g}, wanted 0 or more. State other values, or "
                "inertials = 0.1 to draw consistent ones"
            )
    for i in np.flatnonzero(layout.is_nonnegative() & (pi < 0)):
        raise SettingsError(
            f"truth: {layout.names[i]} is {pi[i]:g} {layout.units[i]}, wanted 0 or more"
        )
