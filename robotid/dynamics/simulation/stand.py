"""A robot on the ground: joints that keep its feet in place, and the forces of its contacts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from robotid.base.exceptions import DataError, SettingsError
from robotid.base.typing import Array
from robotid.data.base_motion import BaseMotion
from robotid.dynamics.constraint_rows import constraint_jacobian, logged_base
from robotid.dynamics.simulation.motions import FloatingMotion
from robotid.dynamics.simulation.simulation_settings import Sensors
from robotid.robot.model import RobotModel

_LEFT = 1e-6  # largest part of the wrench on the base that contacts cannot cause [-]
_RANK = 1e-8  # singular values below this share of the largest are of dependent forces
_CLOSED = 1e-10  # [m, rad] largest motion of a foot on the ground
_MOST = 30  # iterations of Newton's method


@dataclass(frozen=True, eq=False)
class Stand:
    """Base and contacts of a robot along its motion."""

    pose: Array  # pose of the base, shape (N, 7) [m, -]
    twist: Array  # twist with the axes of the base, shape (N, 6) [m/s, rad/s]
    acceleration: Array  # its time derivative, shape (N, 6)
    # whether links touch the ground, by link; only of those that may leave it
    contacts: Mapping[str, Array]
    # measured components of wrenches, by name as "fz l_sole", each (N,) [N or N m]
    wrenches: Mapping[str, Array]

    def logged(self, sensors: Sensors, rows: Array) -> dict[str, Any]:
        """Return base, contacts and wrenches of a log: rows (N,)."""
        return {
            "base": BaseMotion(
                self.pose[rows],
                self.twist[rows] if sensors.velocity else None,
                self.acceleration[rows] if sensors.acceleration else None,
            ),
            "contacts": {link: flags[rows] for link, flags in self.contacts.items()},
            "wrenches": {name: values[rows] for name, values in self.wrenches.items()},
        }


def contact_forces(J: Array, wrench: Array) -> tuple[Array, Array]:
    """Return the smallest forces with J^T f = w, shape (N, m), and what they leave, (N, 6).

    J (N, m, 6), wrench (N, 6) [N, N m].
    """
    f = np.einsum("kmi,ki->km", np.linalg.pinv(J.swapaxes(1, 2), rcond=_RANK), wrench)
    return f, wrench - np.einsum("kmi,km->ki", J, f)


def supported(
    model: RobotModel,
    motion: FloatingMotion,
    t: Array,
    state: tuple[Array, Array, Array],
    torque: Array,
) -> tuple[Array, Stand]:
    """Return the torques of the joints, shape (N, n), and the stand of a robot along a motion.

    The forces of the ground f are the smallest ones that cause the motion of the base: of W pi =
    tau + J^T f the first six rows, where tau is 0. The other rows give tau.

    t (N,) [s], torque (N, 6 + n) [N m, N].
    """
    if model.loops or not model.contacts:
        found = "loops" if model.loops else "no contacts"
        raise SettingsError(
            f"{model.name} has {found}: a floating base is simulated with contacts and without "
            "loops; state [[contact]] in the job file"
        )
    q, v, a = state
    flags = motion.touching(t)
    J = constraint_jacobian(model, q, flags)
    f, left = contact_forces(J[:, :, :6], torque[:, :6])
    sizes = np.linalg.norm(left, axis=1)
    k = int(sizes.argmax())
    if sizes[k] > _LEFT * (1.0 + np.linalg.norm(torque[k, :6])):
        raise DataError(
            f"forces at the contacts cannot cause the motion of the base at t = {t[k]:.3f} s: "
            f"{sizes[k]:.3g} N of the wrench remain, with {int(flags[k].sum())} links on the "
            "ground. Three feet on the ground can support any motion"
        )
    tau = torque[:, 6:] - np.einsum("kmj,km->kj", J[:, :, 6:], f)
    wanted, names = logged_base(model), [c.frame for c in model.contacts]
    parts = [
        f"{part} {c.frame}" for c in model.contacts for part in c.components[: c.sizes[c.kind]]
    ]
    contacts = {link: flags[:, names.index(link)] for link in wanted.contacts}
    wrenches = {name: f[:, parts.index(name)] for name in wanted.wrenches}
    return tau, Stand(q[:, :7], v[:, :6], a[:, :6], contacts, wrenches)
