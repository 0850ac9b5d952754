"""A motion that moves only what is needed to tell what hangs on a link.

The payload's ten parameters x add K_link T x to the base parameters. A log with it and one without,
of the same motion, share the robot's inertias: their difference, with twice the noise, tells x and
what changed of the drives. Joints that rest tell nothing, for friction holds them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid._typing import Array
from robotid.estimators.determination import Determination, determine
from robotid.exceptions import NotConvergedError, SettingsError
from robotid.excitation.basis import DesignedMotion
from robotid.excitation.design import Design, Designer
from robotid.excitation.information import Aim
from robotid.excitation.limits import LIMITS
from robotid.findings import listed
from robotid.robot.bodies import link_transfer
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS
from robotid.robot.prior import payload_spread
from robotid.simulation.closed_loop import carried
from robotid.simulation.settings import Payload

__all__ = ["PayloadDesign", "design_payload"]

_PARAMETERS = len(INERTIAL_TERMS)
_RUNS = 2.0  # of the same noise: with the payload and without it
_CHANGE = 10.0  # spreads by which friction and offsets may change from one run to the other
_TRIED = 10  # random motions, of which the best says what joints can tell
_OVER = 1.001  # share of a limit that is beyond it
_RATE = 200.0  # [Hz] at which motions are looked at


@dataclass(frozen=True, eq=False)
class PayloadDesign:
    """A motion for a payload and what it is good for.

    Attributes:
        design: The motion.
        designer: What it was designed for, with the payload.
        payload: What hangs on the robot; a mass of 0 where none is stated.
        moving: The joints that move.
        std_error: Standard errors of its ten parameters in the link's frame that are to be expected
            of ``robotid payload``, shape (10,), SI units.
        determination: What it tells of them.
        fewer: What the best of ten random motions of fewer joints would, by the joints.
    """

    design: Design
    designer: Designer
    payload: Payload
    moving: tuple[str, ...]
    std_error: Array
    determination: Determination
    fewer: dict[tuple[str, ...], Determination]

    def described(self) -> list[str]:
        """Return what the motion is expected to tell, in sentences."""
        joints = self.designer.information.model.joints
        resting = [joint for joint in joints if joint not in self.moving]
        error, link = self.std_error, self.payload.link
        still = f"; {listed(resting)} rest{'s' * (len(resting) == 1)}" if resting else ""
        said = [
            f"For what hangs on {link}, {listed(self.moving)} "
            f"move{'s' * (len(self.moving) == 1)}{still}. Record it once with the payload and once "
            "without."
        ]
        if self.determination.rank == len(error):
            said.append(
                f"Standard errors to be expected: mass {error[0]:.2g} kg, mass times centre of "
                f"mass {error[1:4].max():.2g} kg m, inertia about {link} {error[4:].max():.2g} "
                "kg m^2 at most."
            )
        else:
            said.append(f"It leaves open: {self.determination.described()}. Move more joints.")
        for fewer, told in self.fewer.items():
            said.append(f"With {listed(fewer)} alone, {told.described()}.")
        if not self.payload.mass:
            said.append("Limits are kept without a load; state its mass to keep them with it.")
        return said

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, as ``robotid excite --json`` prints them."""
        model = self.designer.information.model
        start = self.design.motion.evaluate(np.zeros(1))[0][0].tolist()
        places = dict(zip(model.joints, start, strict=True))
        return {
            "link": self.payload.link,
            "mass": self.payload.mass,
            "moving": list(self.moving),
            "resting": {j: x for j, x in places.items() if j not in self.moving},
            "std_error": dict(zip(INERTIAL_TERMS, self.std_error.tolist(), strict=True)),
            "undetermined": self.determination.to_list(),
            "fewer": [
                {"moving": list(joints), "undetermined": told.to_list()}
                for joints, told in self.fewer.items()
            ],
            "words": self.described(),
        }


def design_payload(
    designer: Designer,
    rng: np.random.Generator,
    payload: Payload,
    *,
    moving: Sequence[str] = (),
    starts: int = 3,
    seconds: float = np.inf,
    progress: Callable[[int, float], None] | None = None,
) -> PayloadDesign:
    """Return a motion of the few joints next to a link that tells what hangs on it.

    Args:
        designer: What the robot may do.
        rng: Source of the starts.
        payload: The link, the last moving one if it is empty; and what hangs on it, as far as it is
            known: limits are kept with it and without it.
        moving: Joints that move; if none, the fewest before the link that determine all ten.
        starts: As of ``Designer.design``.
        seconds: As of ``Designer.design``.
        progress: As of ``Designer.design``.

    Raises:
        NotConvergedError: If the motion is beyond a limit without the payload.
        SettingsError: If the link does not move, or a joint does not move it.
    """
    model = designer.information.model
    payload = replace(payload, link=payload.link or model.layout.bodies[-1])
    chain = _joints_before(model, payload.link)
    if wrong := [joint for joint in moving if joint not in chain]:
        raise SettingsError(
            f"{listed(wrong)} cannot move {payload.link}; joints that do: {listed(chain)}"
        )
    sought, aim = _sought(designer, payload)
    fewer: dict[tuple[str, ...], Determination] = {}
    for joints in [tuple(moving)] if moving else [chain[-k - 1 :] for k in range(len(chain))]:
        limited = replace(sought, moving=np.isin(model.joints, joints))
        told = _told(model, payload.link, aim, _best_of_some(limited, rng))[1]
        if told.rank == len(told.names):
            break
        fewer[joints] = told
    fewer.pop(joints, None)
    design = limited.design(rng, starts=starts, seconds=seconds, progress=progress)
    _check_bare(replace(limited, information=designer.information), design)
    _, information = limited.used_and_told(design.motion, design.duration, _RATE)
    error, told = _told(model, payload.link, aim, information)
    return PayloadDesign(design, limited, payload, joints, error, told, fewer)


def _best_of_some(designer: Designer, rng: np.random.Generator) -> Array:
    """Return the information of the best of ten random motions, shape (b, b)."""
    motions = [DesignedMotion(designer.basis, designer.random(rng)) for _ in range(_TRIED)]
    length = designer.basis.duration
    told = [designer.used_and_told(motion, length, _RATE)[1] for motion in motions]
    return min(told, key=lambda F: designer.judged(F)[0])


def _check_bare(designer: Designer, design: Design) -> None:
    """Refuse a motion that is beyond a limit without the payload.

    Raises:
        NotConvergedError: If it is.
    """
    used, _ = designer.used_and_told(design.motion, design.duration, _RATE)
    most = np.abs(used).max(axis=1)
    kind, joint = np.unravel_index(int(np.argmax(most)), most.shape)
    if most[kind, joint] > _OVER:
        raise NotConvergedError(
            f"without the payload {designer.information.model.joints[joint]} needs "
            f"{100 * most[kind, joint]:.1f} % of its {LIMITS[kind]} limit, which it keeps with it; "
            "lower the share",
            "max_iterations",
        )


def _joints_before(model: RobotModel, link: str) -> tuple[str, ...]:
    """Return the joints that move a link, from the root.

    Raises:
        SettingsError: If none does.
    """
    body, _ = link_transfer(model, link)
    if body < 0:
        raise SettingsError(f"{link} does not move: no torque shows what hangs on it")
    tree, G = model.pin_model, model.velocity_map
    rows = [tree.idx_vs[i] for i in list(tree.supports[body + 1])[1:]]
    order = dict.fromkeys(int(j) for row in rows for j in np.flatnonzero(G[row]))
    return tuple(model.joints[j] for j in order)


def _sought(designer: Designer, payload: Payload) -> tuple[Designer, Aim]:
    """Return a designer that asks for a payload, and reckons torques with it; and what it asks."""
    information = designer.information
    model, K = information.model, information.mapping.K
    body, transfer = link_transfer(model, payload.link)
    layout = model.layout
    changing = [not term.is_inertia for _, term in layout.drive_parameters]
    drives = layout.n_inertial + np.flatnonzero(changing)
    own = K[:, 10 * body : 10 * body + 10] @ transfer * payload_spread(model)
    changes = K[:, drives] * (_CHANGE * designer.standard_spread[drives])
    aim = Aim(np.hstack([changes, own]) / designer.spread[:, None], _PARAMETERS)
    loaded = carried(model, np.zeros(K.shape[1]), payload)
    information = replace(information, beta=information.beta + K @ loaded)
    noise = _RUNS * designer.noise
    return replace(designer, information=information, noise=noise, given=None, aim=aim), aim


def _told(model: RobotModel, link: str, aim: Aim, F: Array) -> tuple[Array, Determination]:
    """Return standard errors of the ten parameters, shape (10,), and what is determined."""
    size, names = payload_spread(model), [f"{link}.{term}" for term in INERTIAL_TERMS]
    own, _ = aim.information(F)
    values, vectors = np.linalg.eigh(own - np.eye(_PARAMETERS))
    rows = np.sqrt(values.clip(min=0.0))[:, None] * vectors.T / size
    return size * np.sqrt(np.diag(np.linalg.inv(own))), determine(names, rows, size)
