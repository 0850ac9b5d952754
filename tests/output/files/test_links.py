"""Where links sit, whom they follow and what is not stated, of odd axes, ratios and offsets."""

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from robotid.output.files.links import _pose
from robotid.output.files.mjcf import write_mjcf
from robotid.output.files.sdf import write_sdf
from robotid.robot.model import RobotModel
from robotid.robot.tree import Joint

BODY = """<inertial><origin xyz=".1 .2 0"/><mass value="2"/>
<inertia ixx=".4" iyy=".5" izz=".6" ixy="0" ixz="0" iyz="0"/></inertial>"""
URDF = f"""<robot name="hand"><link name="base"/><link name="a">{BODY}</link>
<link name="b">{BODY}</link><link name="c">{BODY}</link>
<joint name="ja" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="2" effort="7" velocity="1"/></joint>
<joint name="jb" type="revolute"><parent link="base"/><child link="b"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="2.5" effort="8" velocity="2"/></joint>
<joint name="jc" type="revolute"><parent link="b"/><child link="c"/><origin xyz=".3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="3"/>
<mimic joint="jb" multiplier="-1.5" offset="0.25"/></joint></robot>"""


def hand(folder, **options):
    (folder / "hand.urdf").write_text(URDF)
    return RobotModel.from_urdf(folder / "hand.urdf", **options)


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_the_pose_of_a_locked_joint_has_an_axis_of_any_length(kind):
    xyz, rpy, axis, at = (0.1, -0.2, 0.3), (0.4, -0.5, 0.6), (1.0, 4.0, -8.0), 0.7
    unit = np.array(axis) / 9.0
    found = _pose(Joint("j", kind, "a", "b", xyz=xyz, rpy=rpy, axis=axis), at)
    way = pin.SE3(np.eye(3), at * unit)
    if kind == "revolute":
        way = pin.SE3(pin.exp3(at * unit), np.zeros(3))
    wanted = pin.SE3(pin.rpy.rpyToMatrix(*rpy), np.array(xyz)) * way
    np.testing.assert_allclose(pin.XYZQUATToSE3(found).homogeneous, wanted.homogeneous, atol=1e-12)


def test_a_joint_follows_its_leader_by_ratio_and_offset(tmp_path):
    model = hand(tmp_path, mimic="coupled")
    pi = model.standard_parameters()
    write_mjcf(model, pi, tmp_path / "hand.xml")
    (held,) = ET.parse(tmp_path / "hand.xml").getroot().findall("equality/joint")
    assert (held.get("joint1"), held.get("joint2")) == ("jc", "jb")
    figures = [float(x) for x in held.get("polycoef").split()]
    assert figures == pytest.approx([0.25, -1.5, 0.0, 0.0, 0.0])
    write_sdf(model, pi, tmp_path / "hand.sdf")
    (mimic,) = ET.parse(tmp_path / "hand.sdf").getroot().iter("mimic")
    assert mimic.get("joint") == "jb"
    stated = {tag: float(mimic.findtext(tag)) for tag in ("multiplier", "offset", "reference")}
    assert stated == pytest.approx({"multiplier": -1.5, "offset": 0.25, "reference": 0.0})
    for name, end in (("hand.xml", "</mujoco>\n"), ("hand.sdf", "</sdf>\n")):
        assert (tmp_path / name).read_text().endswith(end)
