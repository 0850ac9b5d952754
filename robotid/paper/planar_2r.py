"""The paper's planar two-joint arm in closed form, as printed and corrected by mechanics.

Its axes are vertical, so gravity does no work; at q = 0 it is extended along x. The form
``"printed"`` has three errata of the paper (Tzvetkova), the other forms correct them:

1. (26) gives C122 = C211 = h and no C112, where h = L1 s2 (L2 m2 + m2 xbar2) + L1 c2 m2 ybar2;
   mechanics gives C122 = -h, C211 = h, C112 = -2 h.
2. Column 4 of G has its rows swapped: [s2 v1^2, -s2 v2^2] instead of [-s2 v2^2, s2 v1^2].
3. (27) gives p4 = L1 (m2 ybar2) + L1 L2 m2, but column 4 needs L1 (m2 xbar2) + L1 L2 m2 = p3.
   Columns 3 and 4 then act as their sum: the arm has four base parameters, not five.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from robotid.base.typing import Array

#: As printed; errata 1 to 3 corrected, with separate p3 and p4; with columns 3 and 4 added.
Form: TypeAlias = Literal["printed", "corrected_five", "corrected"]
#: Names of the c parameters of each form.
PARAMETER_NAMES: dict[Form, tuple[str, ...]] = {
    "printed": ("p1", "p2", "p3", "p4", "p5"),
    "corrected_five": ("p1", "p2", "p3", "p4", "p5"),
    "corrected": ("p1", "p2", "p3", "p5"),
}

#: The paper's steady state (figure 5) [kg m^2]; as p3 != p4, no five-column G conserves energy.
PAPER_PARAMETERS: Array = np.array([22.0, 5.0, 3.0, 2.0, 0.1])
PAPER_PARAMETERS.setflags(write=False)

_BODY = """\
  <joint name="joint_{i}" type="revolute">
    <parent link="{parent}"/> <child link="link_{i}"/>
    <origin xyz="{length!r} 0 0" rpy="0 0 0"/>
    <axis xyz="0 0 1"/>
    <limit lower="-3.0" upper="3.0" velocity="5.0" effort="500.0"/>
  </joint>
  <link name="link_{i}">
    <inertial>
      <origin xyz="{x!r} {y!r} 0" rpy="0 0 0"/>
      <mass value="{m!r}"/>
      <inertia ixx="{Ixx!r}" ixy="0" ixz="0" iyy="{Iyy!r}" iyz="0" izz="{Izz!r}"/>
    </inertial>
  </link>
"""


@dataclass(frozen=True)
class PlanarLinks:
    """The two links; frame O_i sits at the distal end of link i: xbar < 0 is between its ends."""

    L1: float  # length [m]
    L2: float
    m1: float  # mass [kg]
    xbar1: float  # centre of mass from O_i along the link [m]
    ybar1: float  # ... and across it
    Izz1: float  # inertia about the vertical axis through O_i, not the centre of mass [kg m^2]
    m2: float
    xbar2: float
    ybar2: float
    Izz2: float

    @property
    def central(self) -> tuple[float, float]:
        """Inertia of each link about the vertical axis through its centre of mass [kg m^2]."""
        Izz1 = self.Izz1 - self.m1 * (self.xbar1**2 + self.ybar1**2)
        Izz2 = self.Izz2 - self.m2 * (self.xbar2**2 + self.ybar2**2)
        return Izz1, Izz2


#: A physically consistent arm for which (27) as printed gives exactly ``PAPER_PARAMETERS``.
PAPER_LINKS = PlanarLinks(1.0, 1.0, 10.0, -0.5, 0.0, 20.1, 1.9, 1.1 / 1.9, 0.1 / 1.9, 0.9)


def parameters(links: PlanarLinks, *, form: Form = "corrected") -> Array:
    """Return the parameters P of an arm (27), shape (c,) [kg m^2]."""
    L1, L2, m1, m2 = links.L1, links.L2, links.m1, links.m2
    m1x, m2x, m2y = m1 * links.xbar1, m2 * links.xbar2, m2 * links.ybar2  # [kg m]
    p1 = links.Izz1 + 2 * L1 * m1x + L1**2 * m1 + L1**2 * m2
    p2 = links.Izz2 + 2 * L2 * m2x + L2**2 * m2
    p3 = L1 * m2x + L1 * L2 * m2
    p4 = L1 * m2y + L1 * L2 * m2 if form == "printed" else p3  # erratum 3
    p5 = L1 * m2y
    return np.array([p1, p2, p3, p5] if form == "corrected" else [p1, p2, p3, p4, p5])


def regressor(q: Array, v: Array, a: Array, *, form: Form = "corrected") -> Array:
    """Return the matrix G before (27), with which G(q, v, a) P = u (13), shape (..., 2, c) [1/s^2].

    q (..., 2) [rad], v (..., 2) [rad/s], a (..., 2) [rad/s^2].
    """
    (_, q2), (v1, v2), (a1, a2) = ((x[..., 0], x[..., 1]) for x in (q, v, a))
    c2, s2, a12, v12 = np.cos(q2), np.sin(q2), 2 * a1 + a2, v2**2 + 2 * v1 * v2
    row1 = [a1, a1 + a2, c2 * a12 - 2 * s2 * v1 * v2, -s2 * v2**2, -s2 * a12 - c2 * v12]
    row2 = [0.0, a1 + a2, c2 * a1, s2 * v1**2, -s2 * a1 + c2 * v1**2]
    if form == "printed":
        row1[3], row2[3] = row2[3], row1[3]  # erratum 2
    if form == "corrected":
        row1[2:4], row2[2:4] = [row1[2] + row1[3]], [row2[2] + row2[3]]
    G = np.empty((*np.shape(row1[2]), 2, len(row1)))
    for column, pair in enumerate(zip(row1, row2, strict=True)):
        G[..., 0, column], G[..., 1, column] = pair
    return G


def printed_velocity_coefficient(q: Array, links: PlanarLinks) -> Array:
    """Return h of erratum 1, printed in (26) for both C122 and C211: q (..., 2) -> (...)."""
    q2 = q[..., 1]
    along, across = links.L2 * links.m2 + links.m2 * links.xbar2, links.m2 * links.ybar2  # [kg m]
    h: Array = links.L1 * (np.sin(q2) * along + np.cos(q2) * across)
    return h


def urdf_text(links: PlanarLinks = PAPER_LINKS) -> str:
    """Return the arm as URDF with all digits, in the frames of the joints (proximal), not (9)."""
    text = '<?xml version="1.0"?>\n<!-- Generated by robotid.paper.planar_2r.urdf_text(). -->\n'
    text += '<robot name="planar_2r">\n  <link name="base_link"/>\n'
    bodies = (
        ("base_link", 0.0, links.L1 + links.xbar1, links.ybar1, links.m1),
        ("link_1", links.L1, links.L2 + links.xbar2, links.ybar2, links.m2),
    )
    for i, (body, Izz) in enumerate(zip(bodies, links.central, strict=True), start=1):
        facts = dict(zip(("parent", "length", "x", "y", "m"), body, strict=True))
        # thin, but consistent: second moments 0.9 Izz along, 0.1 Izz across, 0.01 Izz normal to it
        text += _BODY.format(i=i, **facts, Ixx=0.11 * Izz, Iyy=0.91 * Izz, Izz=Izz)
    return text + "</robot>\n"
