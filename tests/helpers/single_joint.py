"""A robot of one joint, whose motion has a closed form."""

from dataclasses import dataclass

import numpy as np

from robotid.robot.model import RobotModel

URDF = """<robot name="one"><link name="base"/><link name="body"><inertial>
<origin xyz="{com}"/><mass value="{mass}"/>
<inertia ixx="{I}" iyy="{I}" izz="{I}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="{kind}"><parent link="base"/><child link="body"/><axis xyz="{axis}"/>
<limit lower="-9" upper="9" effort="{effort}" velocity="9"/></joint></robot>"""
FREE = {"j": 1e-9}  # a limit that leaves the plant to itself [N m]


def one_joint(
    folder, kind="revolute", axis="0 1 0", *, mass=2.0, com="0 0 -0.5", inertia=0.1, effort=7.0,
    gravity=(0.0, 0.0, -9.81), **options,
):  # fmt: skip
    """Return the robot; by default a pendulum that hangs at q = 0."""
    text = URDF.format(com=com, mass=mass, I=inertia, kind=kind, axis=axis, effort=effort)
    (folder / "one.urdf").write_text(text)
    return RobotModel.from_urdf(folder / "one.urdf", gravity=gravity, **options)


def slider(folder, **options):
    """Return a body on a horizontal rail."""
    return one_joint(folder, "prismatic", "1 0 0", com="0 0 0", **options)


def parameters(model, **drive):
    """Return the URDF's parameters with those of the drive by term."""
    pi = model.standard_parameters()
    for term, value in drive.items():
        pi[model.layout.names.index(f"j.{term}")] = value
    return pi


@dataclass(frozen=True)
class Ask:
    """A motion that asks for one position, at no speed, after a start."""

    at: tuple
    first: tuple | None = None  # where the robot begins
    speed: float = 0.0  # at which it begins
    rise: float = 0.0  # acceleration that it asks for

    def evaluate(self, t):
        t = np.asarray(t)
        q = np.tile(np.array(self.at, dtype=float), (len(t), 1))
        v = np.zeros_like(q)
        if self.first is not None:
            q[t == 0.0] = self.first
        v[t == 0.0] = self.speed
        return q, v, np.full_like(q, self.rise)
