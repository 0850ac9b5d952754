"""Where links sit, whom they follow and what is not stated, of odd axes, ratios and offsets."""

import math
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from robotid.output.files.commanded import CommandedDrive, limit_of
from robotid.output.files.links import _pose, unstated_terms
from robotid.output.files.mjcf import _Servos, write_mjcf
from robotid.output.files.sdf import _add_geometry, write_sdf
from robotid.robot.geometry import Shape
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling
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


def test_terms_of_either_sign_that_have_no_place_are_named_and_those_of_none_are_not(tmp_path):
    model = hand(tmp_path, couplings=(Coupling("motor", (("ja", 1.0), ("jb", 2.0))),))
    pi = np.zeros(len(model.layout.names))
    names = list(model.layout.names)
    stated = {"ja.offset": -0.5, "jb.offset": 0.5, "jb.viscous": 2.0, "motor.viscous": 3.0}
    for name, value in stated.items():
        pi[names.index(name)] = value
    said = "X cannot state {}; the drive parameters file of the URDF has them"
    missing = "ja.offset, jb.offset, motor.viscous"
    assert unstated_terms(model, pi, "X", ("viscous",)) == [said.format(missing)]
    found = unstated_terms(model, pi, "X", ("viscous",), has_couplings=True)
    assert found == [said.format("ja.offset, jb.offset")]
    assert unstated_terms(model, pi, "X", ("viscous", "offset"), has_couplings=True) == []


def drive(**others):
    values = dict(
        joint="ja", kp=50.0, kd=2.0, delay=0.0, zero=0.0, armature=0.0, viscous=0.0, coulomb=0.0,
        offset=0.0, effort_limit=math.inf,
    )  # fmt: skip
    return CommandedDrive(**values | others)


@pytest.mark.parametrize(
    ("own", "urdf", "wanted"),
    [(5.0, 7.0, 5.0), (9.0, 7.0, 9.0), (5.0, 0.0, 5.0), (math.inf, 0.0, math.inf),
     (math.inf, 7.0, 7.0)],
)  # fmt: skip
def test_a_drive_has_its_own_limit_or_that_of_the_urdf(own, urdf, wanted):
    assert limit_of(drive(effort_limit=own), Joint("ja", "revolute", "a", "b", effort=urdf)) == (
        wanted
    )


def test_an_actuator_is_pd_about_its_offset_within_its_limit_and_late():
    joint = Joint("ja", "revolute", "a", "b", effort=7.0)

    def stated(delay, how="history", step=0.002):
        one = drive(delay=delay, effort_limit=6.0)
        at = _Servos({"ja": one}, step, how).actuator(joint, 0.75)
        return {key: x.split() if " " in x else x for key, x in at.items()}

    def figures(words):
        return [float(word) for word in words]

    at = stated(0.0)
    assert figures(at["gainprm"]) == [50.0, 0.0, 0.0]
    assert figures(at["biasprm"]) == [-0.75, -50.0, -2.0]
    assert figures(at["forcerange"]) == [-6.75, 5.25]
    assert "delay" not in at
    for delay, late, samples in ((0.007, 0.008, 4), (0.0004, 0.002, 1), (0.0072, 0.0082, 5)):
        at = stated(delay)
        assert (float(at["delay"]), int(at["nsample"])) == (pytest.approx(late), samples)
        assert at["interp"] == "linear"
    at = stated(0.007, "filter")
    assert (at["dyntype"], figures(at["dynprm"])) == ("filterexact", [0.007, 0.0, 0.0])


def test_an_encoder_that_reads_less_has_its_range_shifted(tmp_path):
    model = hand(tmp_path)
    drives = [drive(joint=name, zero=0.1 * (k + 1)) for k, name in enumerate(model.joints)]
    write_mjcf(model, model.standard_parameters(), tmp_path / "hand.xml", commanded=drives)
    joints = {
        at.get("name"): [float(x) for x in at.get("range").split()]
        for at in ET.parse(tmp_path / "hand.xml").getroot().iter("joint")
        if at.get("range")
    }
    for k, limits in enumerate(model.limits):
        zero = 0.1 * (k + 1)
        assert joints[limits.name] == pytest.approx([limits.lower - zero, limits.upper - zero])


def test_shapes_of_sdf_have_their_sizes_by_name():
    for kind, size, wanted in (
        ("box", (0.1, 0.2, 0.3), {"size": "0.1 0.2 0.3"}),
        ("sphere", (0.4,), {"radius": "0.4"}),
        ("cylinder", (0.5, 0.6), {"radius": "0.5", "length": "0.6"}),
    ):
        element = ET.Element("visual")
        shape = {"link": "a", "placement": np.eye(4), "kind": kind, "size": size}
        shape |= {"file": "", "rgba": None}
        _add_geometry(element, Shape(**shape), None)
        (found,) = element.find("geometry")
        assert (found.tag, {child.tag: child.text for child in found}) == (kind, wanted)
