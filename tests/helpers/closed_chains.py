"""Closed chains: four-bar, ankle, differential as URDFs, and their simulation by Pinocchio."""

import numpy as np
import pinocchio as pin

from robotid.robot.constraints import Loop
from robotid.robot.model import RobotModel


def _link(name, body=""):
    return f'<link name="{name}">{body}</link>'


def _inertial(mass, com, xx, yy, zz):
    return (
        f'<inertial><origin xyz="{com}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )


def _joint(name, kind, parent, child, xyz, axis="0 0 1", rpy="0 0 0"):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        '<limit lower="-9" upper="9" effort="50" velocity="20"/></joint>'
    )


FOUR_BAR = "<robot name='four_bar'>" + "".join(
    [
        _link("base"),
        _link("crank", _inertial(1.2, "0.06 0.01 0", 0.002, 0.004, 0.005)),
        _link("coupler", _inertial(0.9, "0.21 0.03 0", 0.003, 0.02, 0.022)),
        _link("rocker", _inertial(1.6, "0.12 -0.02 0", 0.003, 0.012, 0.014)),
        _link("coupler_end"), _link("rocker_end"),
        _joint("drive", "revolute", "base", "crank", "0 0 0"),
        _joint("elbow", "revolute", "crank", "coupler", "0.15 0 0"),
        _joint("pivot", "revolute", "base", "rocker", "0.35 0 0", rpy="0 0 1.2"),
        _joint("coupler_tip", "fixed", "coupler", "coupler_end", "0.38 0 0"),
        _joint("rocker_tip", "fixed", "rocker", "rocker_end", "0.3 0 0"),
    ]
) + "</robot>"  # fmt: skip
PARALLELOGRAM = (  # crank and rocker at 0.5 rad
    FOUR_BAR.replace('rpy="0 0 1.2"', 'rpy="0 0 0.5"')
    .replace('"0 0 0" rpy="0 0 0"', '"0 0 0" rpy="0 0 0.5"', 1)
    .replace('"0.15 0 0" rpy="0 0 0"', '"0.15 0 0" rpy="0 0 -0.5"')
    .replace('"0.38 0 0"', '"0.35 0 0"')
    .replace('"0.3 0 0"', '"0.15 0 0"')
)
FOUR_BAR_LOOP = Loop(("coupler_end", "rocker_end"))

ANKLE = "<robot name='ankle'>" + "".join(
    [
        _link("shank"),
        _link("cross", _inertial(0.1, "0 0 0", 1e-4, 1e-4, 1e-4)),
        _link("foot", _inertial(1.1, "0.04 0.005 -0.04", 0.002, 0.005, 0.006)),
        _joint("pitch", "revolute", "shank", "cross", "0 0 0", axis="0 1 0"),
        _joint("roll", "revolute", "cross", "foot", "0 0 0", axis="1 0 0"),
    ]
    + [
        text
        for side, y in (("left", 0.05), ("right", -0.04))
        for text in (
            _link(f"{side}_crank", _inertial(0.25, "-0.02 0 0.003", 2e-4, 3e-4, 3e-4)),
            _link(f"{side}_cross", _inertial(0.02, "0 0 0", 1e-5, 1e-5, 1e-5)),
            _link(f"{side}_rod", _inertial(0.2, "0.002 0 -0.1", 8e-4, 8e-4, 1e-4)),
            _link(f"{side}_rod_end"), _link(f"{side}_heel"),
            _joint(f"{side}_motor", "revolute", "shank", f"{side}_crank", f"0 {y} 0.2", "0 1 0"),
            _joint(f"{side}_u", "revolute", f"{side}_crank", f"{side}_cross", "-0.05 0 0", "0 1 0"),
            _joint(f"{side}_w", "revolute", f"{side}_cross", f"{side}_rod", "0 0 0", "1 0 0"),
            _joint(f"{side}_tip", "fixed", f"{side}_rod", f"{side}_rod_end", "0 0 -0.21"),
            _joint(f"{side}_mount", "fixed", "foot", f"{side}_heel", f"-0.055 {y} -0.005"),
        )
    ]
) + "</robot>"  # fmt: skip
ANKLE_LOOPS = tuple(
    Loop((f"{side}_rod_end", f"{side}_heel"), "point") for side in ("left", "right")
)
ANKLE_PASSIVE = ("pitch", "roll", *(f"{side}_{x}" for side in ("left", "right") for x in "uw"))


def four_bar(folder, **options):
    """Return the four-bar in a vertical plane; only its crank has a drive."""
    return _model(
        folder / "four_bar.urdf", FOUR_BAR, gravity=(0.0, -9.81, 0.0),
        **{"constraints": [FOUR_BAR_LOOP], "passive": ("elbow", "pivot"), **options},
    )  # fmt: skip


def ankle(folder, **options):
    """Return an ankle that two motors move by rods with ball joints."""
    defaults = {"constraints": ANKLE_LOOPS, "passive": ANKLE_PASSIVE}
    return _model(folder / "ankle.urdf", ANKLE, **{**defaults, **options})


def _model(path, text, **options):
    path.write_text(text)
    return RobotModel.from_urdf(path, **options)


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
        for loop in model.loops:
            one, two = (self.robot.frames[self.robot.getFrameId(x)] for x in loop.frames)
            self.loops.append(
                pin.RigidConstraintModel(
                    pin.ContactType.CONTACT_3D, self.robot, one.parentJoint, one.placement,
                    two.parentJoint, two.placement, pin.ReferenceFrame.LOCAL,
                )
            )  # fmt: skip
        for foot in feet:
            frame = self.robot.frames[self.robot.getFrameId(foot)]
            self.loops.append(
                pin.RigidConstraintModel(
                    pin.ContactType.CONTACT_3D, self.robot, frame.parentJoint, frame.placement,
                    pin.ReferenceFrame.LOCAL,
                )
            )  # fmt: skip
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
        """Return t, q, v and tau of a motion, integrated by Runge and Kutta's method.

        Args:
            q: Position at the start, at which the loops close.
            command: Torques at the joints from t, q, v.
            duration: Duration [s].
            step: Step [s].
        """
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
