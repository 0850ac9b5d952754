"""A motion for payload identification that moves only the joints that are needed.

The payload's ten parameters x add K_link T x to the base parameters. A log with the payload and one
without, of the same motion, have the robot's inertias in common: their difference, with twice the
noise, determines x and the changes of the drives. Joints at rest contribute no information, since
static friction may carry any load.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from robotid.base.exceptions import NotConvergedError, SettingsError
from robotid.base.findings import listed
from robotid.base.typing import Array
from robotid.design.basis import DesignedMotion
from robotid.design.design import STARTED, Design, Designer
from robotid.design.information import Aim
from robotid.design.limits import LIMITS
from robotid.dynamics.simulation.simulation_settings import Payload
from robotid.dynamics.simulation.simulator import carried
from robotid.estimation.estimators.determination import Determination, determine
from robotid.robot.bodies import link_transfer
from robotid.robot.model import RobotModel
from robotid.robot.parameters import INERTIAL_TERMS
from robotid.robot.prior import payload_spread

_PARAMETERS = len(INERTIAL_TERMS)
_RUNS = 2.0  # of the same noise: with the payload and without it
_CHANGE = 10.0  # prior deviations by which friction and offsets may change between the runs
_OVER = 1.001  # share of a limit above which it is exceeded
_RATE = 200.0  # [Hz] of the samples at which motions are evaluated


@dataclass(frozen=True, eq=False)
class PayloadDesign:
    """A motion for payload identification and its expected standard errors."""

    design: Design  # the motion
    designer: Designer  # what it was designed for, with the payload
    payload: Payload  # the payload; a mass of 0 where none is stated
    moving: tuple[str, ...]  # the joints that move
    #: Expected standard errors of its ten parameters in the link's frame by ``robotid
    #: payload``, shape (10,), SI units.
    std_error: Array
    determination: Determination  # which of them the motion determines
    #: Which the best of ten random motions of fewer joints would determine, by the joints.
    fewer: dict[tuple[str, ...], Determination]

    def described(self) -> list[str]:
        """Return the moving joints and the expected standard errors, in sentences."""
        joints = self.designer.information.model.joints
        resting = [joint for joint in joints if joint not in self.moving]
        error, link = self.std_error, self.payload.link
        still = f"; {listed(resting)} rest{'s' * (len(resting) == 1)}" if resting else ""
        sentences = [
            f"For a payload on {link}, {listed(self.moving)} "
            f"move{'s' * (len(self.moving) == 1)}{still}. Record the motion twice: with the "
            "payload and without it."
        ]
        if self.determination.rank == len(error):
            sentences.append(
                f"Expected standard errors: mass {error[0]:.2g} kg; mass times centre of mass at "
                f"most {error[1:4].max():.2g} kg m; inertia about {link} at most "
                f"{error[4:].max():.2g} kg m^2."
            )
        else:
            undetermined = self.determination.described()
            sentences.append(f"Not determined completely: {undetermined}. Move more joints.")
        for fewer, determination in self.fewer.items():
            sentences.append(f"With {listed(fewer)} alone: {determination.described()}.")
        if not self.payload.mass:
            sentences.append(
                "The limits were checked without a payload. State its mass to check them with it."
            )
        return sentences

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
                {"moving": list(joints), "undetermined": determination.to_list()}
                for joints, determination in self.fewer.items()
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
    """Return a motion of the few joints next to a link that determines the payload on the link."""
    model = designer.information.model
    payload = replace(payload, link=payload.link or model.layout.bodies[-1])
    chain = _joints_before(model, payload.link)
    if wrong := [joint for joint in moving if joint not in chain]:
        raise SettingsError(
            f"{listed(wrong)} cannot move {payload.link}, wanted joints that do: {listed(chain)}"
        )
    sought, aim = _sought(designer, payload)
    fewer: dict[tuple[str, ...], Determination] = {}
    for joints in [tuple(moving)] if moving else [chain[-k - 1 :] for k in range(len(chain))]:
        limited = replace(sought, moving=np.isin(model.joints, joints))
        found = _determined(model, payload.link, aim, _best_of_some(limited, rng))[1]
        if found.rank == len(found.names):
            break
        fewer[joints] = found
    fewer.pop(joints, None)
    design = limited.design(rng, starts=starts, seconds=seconds, progress=progress)
    _check_bare(replace(limited, information=designer.information), design)
    _, information = limited.used_and_informed(design.motion, design.duration, _RATE)
    error, found = _determined(model, payload.link, aim, information)
    return PayloadDesign(design, limited, payload, joints, error, found, fewer)


def _best_of_some(designer: Designer, rng: np.random.Generator) -> Array:
    """Return the information of the best of ten random motions, shape (b, b)."""
    motions = [DesignedMotion(designer.basis, designer.random(rng)) for _ in range(STARTED)]
    length = designer.basis.duration
    information = [designer.used_and_informed(motion, length, _RATE)[1] for motion in motions]
    return min(information, key=lambda F: designer.judged(F)[0])


def _check_bare(designer: Designer, design: Design) -> None:
    """Refuse a motion that exceeds a limit without the payload."""
    used, _ = designer.used_and_informed(design.motion, design.duration, _RATE)
    most = np.abs(used).max(axis=1)
    kind, joint = np.unravel_index(int(np.argmax(most)), most.shape)
    if most[kind, joint] > _OVER:
        raise NotConvergedError(
            f"without the payload {designer.information.model.joints[joint]} needs "
            f"{100 * most[kind, joint]:.1f} % of its {LIMITS[kind]} limit, wanted 100 % at most; "
            "lower the share",
            "max_iterations",
        )


def _joints_before(model: RobotModel, link: str) -> tuple[str, ...]:
    """Return the joints that move a link, from the root."""
    body, _ = link_transfer(model, link)
    if body < 0:
        raise SettingsError(f"{link} does not move: no torque depends on a payload on it")
    tree, G = model.pin_model, model.velocity_map
    rows = [tree.idx_vs[i] for i in list(tree.supports[body + 1])[1:]]
    order = dict.fromkeys(int(j) for row in rows for j in np.flatnonzero(G[row]))
    return tuple(model.joints[j] for j in order)


def _sought(designer: Designer, payload: Payload) -> tuple[Designer, Aim]:
    """Return a designer whose aim is a payload and whose torques include it; and that aim."""
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


def _determined(model: RobotModel, link: str, aim: Aim, F: Array) -> tuple[Array, Determination]:
    """Return standard errors of the ten parameters, shape (10,), and what is determined."""
    size, names = payload_spread(model), [f"{link}.{term}" for term in INERTIAL_TERMS]
    own, _ = aim.information(F)
    values, vectors = np.linalg.eigh(own - np.eye(_PARAMETERS))
    rows = np.sqrt(values.clip(min=0.0))[:, None] * vectors.T / size
    return size * np.sqrt(np.diag(np.linalg.inv(own))), determine(names, rows, size)
