"""Closed chains: a four-bar and an ankle, and their simulation by Pinocchio."""

from pathlib import Path

import numpy as np
import pinocchio as pin

from robotid.robot.constraints import Loop
from robotid.robot.model import RobotModel

FOUR_BAR, ANKLE = (Path(__file__).with_name(f"{x}.urdf").read_text() for x in ("four_bar", "ankle"))
PARALLELOGRAM = (  # crank and rocker at 0.5 rad
    FOUR_BAR.replace('rpy="0 0 1.2"', 'rpy="0 0 0.5"')
    .replace('"0 0 0" rpy="0 0 0"', '"0 0 0" rpy="0 0 0.5"', 1)
    .replace('"0.15 0 0" rpy="0 0 0"', '"0.15 0 0" rpy="0 0 -0.5"')
    .replace('"0.38 0 0"', '"0.35 0 0"')
    .replace('"0.3 0 0"', '"0.15 0 0"')
)
FOUR_BAR_LOOP = Loop(("coupler_end", "rocker_end"))

ANKLE_LOOPS = tuple(
    Loop((f"{side}_rod_end", f"{side}_heel"), "point") for side in ("left", "right")
)
ANKLE_PASSIVE = ("pitch", "roll", *(f"{side}_{x}" for side in ("left", "right") for x in "uw"))


def four_bar(folder, **options):
    """Return the four-bar in a vertical plane; only its crank has a drive."""
    usual = {"constraints": [FOUR_BAR_LOOP], "passive": ("elbow", "pivot")}
    (folder / "four_bar.urdf").write_text(FOUR_BAR)
    gravity = (0.0, -9.81, 0.0)
    return RobotModel.from_urdf(folder / "four_bar.urdf", gravity=gravity, **usual | options)


def ankle(folder, **options):
    """Return an ankle that two motors move by rods with ball joints."""
    usual = {"constraints": ANKLE_LOOPS, "passive": ANKLE_PASSIVE}
    (folder / "ankle.urdf").write_text(ANKLE)
    return RobotModel.from_urdf(folder / "ankle.urdf", **usual | options)


class Oracle:
    """Pinocchio's constraint dynamics of a robot with loops of ball joints, on point feet or none.

    Origins of the links ``feet`` do not accelerate.
    """

    def __init__(self, model, pi, feet=()):
        self.model, self.layout = model, model.layout
        self.pi = dict(zip(model.layout.names, pi, strict=True))
        self.robot = pin.Model(model.with_parameters(pi).pin_model)
        self.robot.armature = model.velocity_map @ self._drive("armature")
        self.data = self.robot.createData()
        self.loops = pin.StdVec_RigidConstraintModel()
        for links in [*(loop.frames for loop in model.loops), *((foot,) for foot in feet)]:
            frames = [self.robot.frames[self.robot.getFrameId(link)] for link in links]
            places = [x for frame in frames for x in (frame.parentJoint, frame.placement)]
            point, axes = pin.ContactType.CONTACT_3D, pin.ReferenceFrame.LOCAL
            self.loops.append(pin.RigidConstraintModel(point, self.robot, *places, axes))
        self.of_loops = pin.StdVec_RigidConstraintData()
        self.of_loops.extend([loop.createData() for loop in self.loops])
        pin.initConstraintDynamics(self.robot, self.data, self.loops, self.of_loops)
        self.settings = pin.ProximalSettings(1e-13, 1e-13, 1e-8, 50)

    def _drive(self, term):
        return np.array([self.pi.get(f"{row}.{term}", 0.0) for row in self.model.row_names])

    def acceleration(self, q, v, tau):
        """Return the accelerations of all rows under torques of the drives, at the joints."""
        friction = self._drive("viscous") * v + self._drive("coulomb") * np.tanh(v / 5e-3)
        torque = tau - friction - self._drive("offset") - self._drive("spring") * q[-len(v) :]
        G, (configuration,) = self.model.velocity_map, self.model.configurations(q[None])
        return G.T @ pin.constraintDynamics(
            self.robot, self.data, configuration, G @ v, G @ torque, self.loops, self.of_loops,
            self.settings,
        )  # fmt: skip

    def force(self):
        """Return the force of each loop on the second link, with the axes of the first one."""
        return [data.contact_force.linear for data in self.of_loops]

    def simulate(self, q, command, duration, step=5e-4):
        """Return t, q, v and tau of a motion, integrated by Runge and Kutta's method."""
        # It starts at rest at q, where the loops close; command(t, q, v) are torques at the joints.
        n, x, rows = len(q), np.append(q, np.zeros(len(q))), []

        def rate(t, x):
            q, v = x[:n], x[n:]
            return np.append(v, self.acceleration(q, v, command(t, q, v)))

        for t in np.arange(int(duration / step)) * step:
            rows.append([t, *x, *command(t, x[:n], x[n:])])
            one = rate(t, x)
            two = rate(t + 0.5 * step, x + 0.5 * step * one)
            three = rate(t + 0.5 * step, x + 0.5 * step * two)
            four = rate(t + step, x + step * three)
            x = x + step / 6 * (one + 2 * two + 2 * three + four)
        found = np.array(rows)
        return found[:, 0], found[:, 1 : 1 + n], found[:, 1 + n : 1 + 2 * n], found[:, 1 + 2 * n :]
