import json
import math
import re

import numpy as np
import pytest
from helpers.findings import Figures
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import ModelError
from robotid.base.findings import Finding
from robotid.diagnosis.logs.check_logs import check_logs
from robotid.diagnosis.urdf.inertials import (
    explained_by_assumed,
    impossible_inertials,
    rounded_robot,
)
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import random_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials
from robotid.robot.urdf_text import read_with_yourdfpy

CLEAN = """<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><mass value="2"/><origin xyz="0.1 0 0"/>
    <inertia ixx="0.1" iyy="0.12" izz="0.11" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><mass value="1"/><origin xyz="0.2 0 0"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.035" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin rpy="0 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="2"/>
    <dynamics damping="0.5" friction="0.25"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 1 0"/></joint>
</robot>"""

LONG = """<link name="l{0}"><inertial><origin xyz="0.1 0.02 0.03"/><mass value="1"/>
  <inertia ixx="1" iyy="1" izz="1.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j{0}" type="continuous"><parent link="l{1}"/><child link="l{0}"/>
  <origin xyz="0.5 0 0.1" rpy="{2!r} 0 0.3"/><axis xyz="0 0 1"/></joint>"""

TOOL = """<link name="tool">{inertial}</link><joint name="hold" type="fixed">
  <parent link="lower"/><child link="tool"/></joint></robot>"""
INERTIAL = """<inertial><mass value="{m}"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>"""


def inspected(tmp_path, *changes, **options):
    text = CLEAN
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = tmp_path / "two.urdf"
    path.write_text(text)
    return inspect_urdf(path, **options)


def found(inspection, code):
    return [f for f in inspection.to_dict()["findings"] if f["code"] == code]


def test_a_clean_robot_has_no_finding(tmp_path):
    content = inspected(tmp_path).to_dict()
    assert content["findings"] == []
    assert content["robot"] == "two"
    assert content["joints"] == ["shoulder", "elbow"]
    structure = content["structure"]
    # a planar arm in the vertical plane: 2 x (m c_x, m c_z, I) with the second mass grouped
    assert {key: structure[key] for key in ("standard", "base_inertial", "base", "rank")} == {
        "standard": 20,
        "base_inertial": 6,
        "base": 6 + 8 - 1,  # the armature of the first joint acts like an inertia of its link
        "rank": 13,
    }
    assert 1 <= structure["condition"] < 1e3
    assert len(content["base_groups"]) == 6
    assert "upper.mcy" in structure["undetermined"]
    assert "lower.Iyy" not in structure["undetermined"]


def test_the_numbers_are_those_of_a_known_robot():
    inspection = inspect_urdf(example_urdf("ur5_robot.urdf"))
    structure = inspection.structure
    assert structure.standard == 60
    assert structure.base_inertial == 36
    assert structure.base == structure.rank
    assert structure.condition == pytest.approx(inspection.to_dict()["structure"]["condition"])
    assert inspection == inspect_urdf(example_urdf("ur5_robot.urdf"))  # always the same


def test_a_floating_base_adds_its_body(tmp_path):
    fixed, floating = inspected(tmp_path), inspected(tmp_path, free_flyer=True)
    assert floating.structure.standard == fixed.structure.standard + 10
    (finding,) = found(floating, "missing_inertial")
    assert (finding["link"], finding["severity"]) == ("base", "warning")


def test_a_moving_link_without_inertial_is_named(tmp_path):
    massless = inspected(tmp_path, ('<link name="lower">', '<link name="lower"/><link name="x">'),
                         ("</robot>", '<joint name="j" type="fixed"><parent link="base"/>'
                          '<child link="x"/></joint></robot>'))  # fmt: skip
    (finding,) = found(massless, "missing_inertial")
    assert (finding["link"], finding["severity"]) == ("lower", "warning")
    assert (
        "the URDF has no <inertial> with a mass: lower. Assumed: the masses of"
        in (finding["message"])
    )
    # a box of 0.2 of the robot's length, 0.5 m, with the density of the other body
    volume = (0.5 + 0.1) * 0.1**2  # [m^3], of the upper one
    assert finding["evidence"]["mass"] == pytest.approx(2.0 / volume * 0.1**3)
    frame = inspected(tmp_path, ("</robot>", TOOL.format(inertial="")))
    (finding,) = found(frame, "missing_inertial")
    assert (finding["link"], finding["severity"]) == ("tool", "note")
    assert "The mass of its body is in lower" in finding["message"]


def test_masses_of_zero_and_less_are_named(tmp_path):
    (finding,) = found(inspected(tmp_path, ('"1"/>', '"0"/>')), "zero_mass")
    assert (finding["link"], finding["severity"]) == ("lower", "warning")
    assert "has the mass 0 kg, wanted more than 0" in finding["message"]
    tool = TOOL.format(inertial=INERTIAL.format(m=0))
    (finding,) = found(inspected(tmp_path, ("</robot>", tool)), "zero_mass")
    assert (finding["link"], finding["severity"]) == ("tool", "note")
    (finding,) = found(inspected(tmp_path, ('"2"/>', '"-2"/>')), "negative_mass")
    assert (finding["link"], finding["severity"]) == ("upper", "error")
    assert "has the mass -2 kg, wanted more than 0; correct the sign" in finding["message"]
    assert finding["evidence"] == {"mass": -2.0}


def test_an_impossible_inertia_is_named_with_what_it_breaks(tmp_path):
    (finding,) = found(inspected(tmp_path, ('izz="0.11"', 'izz="0.23"')), "not_positive_definite")
    assert (finding["link"], finding["severity"]) == ("upper", "error")
    assert "violate the triangle inequality" in finding["message"]
    assert "the sum of the two smaller ones is 0.22, wanted more than 0.23" in finding["message"]
    assert finding["evidence"]["triangle"] == pytest.approx(-0.01)
    (finding,) = found(inspected(tmp_path, ('ixy="0"', 'ixy="0.2"')), "not_positive_definite")
    assert "are not all positive, wanted > 0 (-0.09" in finding["message"]
    (finding,) = found(inspected(tmp_path, ('izz="0.11"', 'izz="0.22"')), "not_positive_definite")
    assert finding["severity"] == "note"
    assert "flat or thin" in finding["message"]
    # a fit is warned of the impossible ones only
    both = (('izz="0.11"', 'izz="0.23"'), ('izz="0.035"', 'izz="0.05"'))
    inspected(tmp_path, *both)
    (finding,) = impossible_inertials(RobotModel.from_urdf(tmp_path / "two.urdf"))
    assert (finding.where, finding.severity) == ("link upper", "warning")
    assert finding.message.endswith("a consistent fit uses the nearest possible body instead")


def test_the_inertia_may_be_stated_in_a_turned_frame(tmp_path):
    turned = inspected(tmp_path, ('<origin xyz="0.1 0 0"/>', '<origin xyz="0 0 0" rpy="1 2 3"/>'))
    assert turned.to_dict()["findings"] == []


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("", "lower None, upper None"),
        ('<limit effort="1" velocity="1"/>', "lower None, upper None"),
        ('<limit lower="0" upper="0" effort="1" velocity="1"/>', "lower 0.0, upper 0.0"),
        ('<limit lower="1" upper="-1" effort="1" velocity="1"/>', "lower 1.0, upper -1.0"),
    ],
)
def test_a_joint_without_a_range_is_named(tmp_path, limit, said):
    stated = '<limit lower="-1" upper="1" effort="9" velocity="2"/>'
    (finding,) = found(inspected(tmp_path, (stated, limit)), "no_limits")
    assert (finding["joint"], finding["severity"]) == ("shoulder", "warning")
    assert f"limits are {said}, wanted lower < upper" in finding["message"]
    half = inspected(tmp_path, ('lower="-1" ', ""))  # a missing bound is 0
    assert found(half, "no_limits") == []


def test_limits_of_zero_are_named_with_what_states_them(tmp_path):
    stated = '<limit lower="-1" upper="1" effort="9" velocity="2"/>'
    (finding,) = found(
        inspected(tmp_path, (stated, stated.replace('"9"', '"0"').replace('"2"', '"0.0"'))),
        "no_limits",
    )
    assert (finding["joint"], finding["severity"]) == ("shoulder", "warning")
    assert "has limits velocity 0 and effort 0, wanted more than 0" in finding["message"]
    assert finding["message"].endswith("--max-velocity shoulder=X --max-torque shoulder=X")


@pytest.mark.parametrize(("key", "old"), [("damping", "0.5"), ("friction", "0.25")])
def test_negative_friction_is_named(tmp_path, key, old):
    (finding,) = found(
        inspected(tmp_path, (f'{key}="{old}"', f'{key}="-{old}"')), f"negative_{key}"
    )
    assert (finding["joint"], finding["severity"]) == ("shoulder", "warning")
    assert f"has {key} -{old}, wanted 0 or more" in finding["message"]
    assert ("Pinocchio rejects" in finding["message"]) == (key == "friction")


def test_a_rounded_angle_is_named_with_its_exact_value(tmp_path):
    # the axes stay parallel: the number of parameters does not suffer
    (finding,) = found(inspected(tmp_path, ('rpy="0 0 0"', 'rpy="0 -3.1416 0.1"')), "rounded_rpy")
    assert (finding["joint"], finding["severity"]) == ("shoulder", "note")
    assert f"write {-math.pi!r} for -3.1416. The identifiable" in finding["message"]


def test_a_rounded_angle_that_robotid_can_leave_out_is_a_note(tmp_path):
    tilted = ('<origin xyz="0.5 0 0"/>', '<origin xyz="0.5 0 0" rpy="3.1416 0 0"/>')
    rounded = inspected(tmp_path, tilted)
    (finding,) = found(rounded, "rounded_rpy")
    assert (finding["joint"], finding["severity"]) == ("elbow", "note")
    assert found(rounded, "weak_parameters") == []  # they are the same parameters
    exact = inspected(tmp_path, (tilted[0], tilted[1].replace("3.1416", repr(math.pi))))
    assert found(exact, "rounded_rpy") == []
    assert rounded.structure.base == exact.structure.base
    assert "more parameters seem identifiable" in finding["message"]


def test_angles_that_are_exact_or_meant_are_not_named(tmp_path):
    for angle in (math.pi, -math.pi / 2, 1.5707963, 3.13, 0.0005, 0.0):
        inspection = inspected(tmp_path, ('rpy="0 0 0"', f'rpy="0 {angle!r} 0"'))
        assert found(inspection, "rounded_rpy") == [], angle


def test_a_rounded_angle_of_a_frame_is_a_note(tmp_path):
    frame = TOOL.format(inertial="").replace("<child", '<origin rpy="0 1.5708 0"/><child')
    tilted = ('<origin xyz="0.5 0 0"/>', '<origin xyz="0.5 0 0" rpy="3.1416 0 0"/>')
    inspection = inspected(tmp_path, ("</robot>", frame), tilted)
    severity = {f["joint"]: f["severity"] for f in found(inspection, "rounded_rpy")}
    assert severity == {"hold": "note", "elbow": "note"}
    model = RobotModel.from_urdf(tmp_path / "two.urdf")
    (finding,) = rounded_robot(model, structural_mapping(model))  # of those that move or carry
    assert finding.message.startswith("two.urdf rounds angles of the joints elbow. ")
    assert Figures(finding) == {"joints": 1.0}


def test_rounded_angles_of_several_joints_are_one_note():
    inspection = inspect_urdf(example_urdf("xarm7.urdf"))
    (finding,) = found(inspection, "rounded_rpy")
    assert finding["severity"] == "note"
    joints = ", ".join(f"joint{k}" for k in range(2, 8))
    assert f"the joints {joints} have rounded angles in rpy; write " in finding["message"]
    quarter = math.pi / 2
    assert f"write {-quarter!r} for -1.5708, {quarter!r} for 1.5708. " in finding["message"]


COARSE = ('<origin xyz="0.5 0 0"/>', '<origin xyz="0.5 0 0" rpy="3.14 0 0"/>')


def test_a_coarsely_rounded_angle_changes_the_base_and_snapping_mends_it(tmp_path):
    rounded = inspected(tmp_path, COARSE)
    (finding,) = found(rounded, "rounded_rpy")
    exact = inspected(tmp_path, (COARSE[0], COARSE[1].replace("3.14", repr(math.pi))))
    more = rounded.structure.base, exact.structure.base
    assert (finding["joint"], finding["severity"]) == ("elbow", "warning")
    assert more[0] > more[1]
    counts = f"there are {more[0]} base parameters instead of {more[1]}, and noise determines"
    assert counts in finding["message"]
    assert "snap_angles = true (--snap-angles) takes the exact angles" in finding["message"]
    inspected(tmp_path, COARSE)
    snapped = RobotModel.from_urdf(tmp_path / "two.urdf", snap_angles=True)
    assert len(structural_mapping(snapped).K) == more[1]
    assert snapped.tree.joints[1].rpy == (math.pi, 0.0, 0.0)


def test_the_doctor_names_rounded_angles_that_matter_once(tmp_path, rng):
    for angle, expected in (("3.14", 1), ("3.1416", 1), (repr(math.pi), 0), ("3.13", 0)):
        inspected(tmp_path, (COARSE[0], COARSE[1].replace("3.14", angle)))
        model = RobotModel.from_urdf(tmp_path / "two.urdf")
        log = exact_log(model, truth(model), rng)
        findings = [f for f in check_logs(model, [log]) if f.code == "rounded_rpy"]
        assert len(findings) == expected, angle
        if findings:
            severity = {"3.14": "warning", "3.1416": "note"}[angle]
            assert (findings[0].severity, findings[0].where) == (severity, "two.urdf")
            assert "rounds angles of the joints elbow. With the rounding" in findings[0].message
        snapped = RobotModel.from_urdf(tmp_path / "two.urdf", snap_angles=True)
        assert not [f for f in check_logs(snapped, [log]) if f.code == "rounded_rpy"]


def test_a_mimic_joint_is_named(tmp_path):
    mimic = '<mimic joint="shoulder" multiplier="-2"/></joint>\n</robot>'
    (finding,) = found(inspected(tmp_path, ("</joint>\n</robot>", mimic)), "mimic_joint")
    assert (finding["joint"], finding["severity"]) == ("elbow", "note")
    assert "mimics 'shoulder' (multiplier -2, offset 0)" in finding["message"]
    assert "use mimic = 'coupled'" in finding["message"]
    lost = mimic.replace("shoulder", "nobody")
    (finding,) = found(inspected(tmp_path, ("</joint>\n</robot>", lost)), "mimic_joint")
    assert finding["severity"] == "warning"
    assert "mimics 'nobody', which is not another movable joint" in finding["message"]


def test_lumped_links_are_named(tmp_path):
    tool = TOOL.format(inertial=INERTIAL.format(m=0.3))
    (finding,) = found(inspected(tmp_path, ("</robot>", tool)), "fixed_lumped")
    assert (finding["link"], finding["severity"]) == ("lower", "note")
    assert "is one body with tool, attached by fixed joints" in finding["message"]
    to_world = ("</robot>", tool.replace('parent link="lower"', 'parent link="base"'))
    assert found(inspected(tmp_path, to_world), "fixed_lumped") == []


NOT_NUMBERS = {
    "mass": ('value="2"', 'value="nan"', "link", "upper", "inertial mass value is 'nan'"),
    "inertia": ('ixx="0.1"', 'ixx="inf"', "link", "upper", "inertial inertia ixx is 'inf'"),
    "com": ('xyz="0.1 0 0"', 'xyz="0,1 0 0"', "link", "upper", "inertial origin xyz is '0,1 0 0'"),
    "origin": ('xyz="0.5 0 0"', 'xyz="${l} 0 0"', "joint", "elbow", "origin xyz is '${l} 0 0'"),
    "limit": ('lower="-1"', 'lower=""', "joint", "shoulder", "limit lower is ''"),
}


@pytest.mark.parametrize(
    ("old", "new", "kind", "name", "said"), NOT_NUMBERS.values(), ids=NOT_NUMBERS
)
def test_what_is_no_number_is_named(tmp_path, old, new, kind, name, said):
    inspection = inspected(tmp_path, (old, new))
    (finding,) = found(inspection, "not_a_number")
    assert (finding[kind], finding["severity"]) == (name, "error")
    assert f"{kind} {name!r}: {said}, wanted " in finding["message"]
    content = inspection.to_dict()
    assert content["structure"] is None
    assert content["base_groups"] == []
    assert content["joints"] == ["shoulder", "elbow"]
    json.dumps(content, allow_nan=False)


def test_every_bad_number_is_named_at_once(tmp_path):
    inspection = inspected(tmp_path, ('"2"/>', '"nan"/>'), ('"1"/>', '"1e999"/>'))
    assert [f["link"] for f in found(inspection, "not_a_number")] == ["upper", "lower"]


def test_a_number_that_the_dynamics_do_not_use_does_not_stop_them(tmp_path):
    inspection = inspected(tmp_path, ('damping="0.5"', 'damping="nan"'))
    (finding,) = found(inspection, "not_a_number")
    assert finding["joint"] == "shoulder"
    assert inspection.structure is not None


UNUSABLE = {
    "missing": (None, "there is no URDF file"),
    "no XML": ("<robot", "is not well-formed XML"),
    "other XML": ("<sdf/>", "the top element is <sdf>, wanted <robot>"),
    "no name": ("<robot/>", "<robot> has no name"),
    "no joint": ('<robot name="r"><link name="l"/></robot>', "has no movable joint"),
}


@pytest.mark.parametrize(("text", "message"), UNUSABLE.values(), ids=UNUSABLE)
def test_a_file_that_is_no_model_is_a_finding(tmp_path, text, message):
    if text is not None:
        (tmp_path / "bad.urdf").write_text(text)
    inspection = inspect_urdf(tmp_path / "bad.urdf")
    (finding,) = inspection.to_dict()["findings"]
    assert (finding["code"], finding["severity"]) == ("unusable", "error")
    assert message in finding["message"]
    assert "link" not in finding
    assert "joint" not in finding
    assert inspection.structure is None


def test_what_yourdfpy_cannot_read_is_a_finding(tmp_path):
    visual = (
        '<visual><material name="m"><color rgba="1,2"/></material>'
        '<geometry><box size="1 1 1"/></geometry></visual>'
    )
    inspection = inspected(tmp_path, ('<link name="base"/>', f'<link name="base">{visual}</link>'))
    (finding,) = found(inspection, "yourdfpy_refuses")
    assert finding["severity"] == "warning"
    assert "ValueError" in finding["message"]
    assert (
        "limits, damping, friction and mimic of its joints were not checked" in finding["message"]
    )
    assert inspection.structure is not None
    with pytest.raises(ModelError, match=r"yourdfpy cannot read two.urdf"):
        read_with_yourdfpy(tmp_path / "two.urdf")


def test_arms_on_one_base_have_the_condition_number_of_the_whole_regressor(tmp_path):
    """A light lift beside the arm: the extreme singular values belong to different chains."""
    lift = """<link name="cart"><inertial><mass value="0.3"/><inertia ixx="1" iyy="1" izz="1"
      ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="lift" type="prismatic"><axis
      xyz="0 0 1"/><parent link="base"/><child link="cart"/><limit lower="0" upper="1" effort="9"
      velocity="2"/></joint></robot>"""
    path = tmp_path / "both.urdf"
    path.write_text(CLEAN.replace("</robot>", lift))
    model = RobotModel.from_urdf(path)
    mapping = structural_mapping(model)
    samples = 2 * len(mapping.names) // 3 + 20
    W = random_regressor(model, samples, np.random.default_rng(0))[:, mapping.independent]
    sizes = np.linalg.svd(W / np.linalg.norm(W, axis=0), compute_uv=False)
    assert inspect_urdf(path).structure.condition == pytest.approx(sizes[0] / sizes[-1], rel=1e-6)


def test_a_chain_whose_last_joints_are_hardly_felt_is_named(tmp_path):
    links = "".join(LONG.format(k, k - 1, math.pi / 2 * (k % 2)) for k in range(1, 61))
    (tmp_path / "long.urdf").write_text(f'<robot name="long"><link name="l0"/>{links}</robot>')
    inspection = inspect_urdf(tmp_path / "long.urdf")
    (finding,) = found(inspection, "weak_parameters")
    assert inspection.structure.base_inertial == 7 * 60 - 8
    weak, base = finding["evidence"]["faint"], inspection.structure.base
    assert weak > 0
    assert f"{weak:.0f} parameters have less than 1e-4 of the effect" in finding["message"]
    assert f"left out of the {base} base parameters" in finding["message"]


def test_only_findings_that_take_assumed_masses_as_evidence_are_explained(tmp_path):
    (tmp_path / "clean.urdf").write_text(CLEAN)
    (tmp_path / "none.urdf").write_text(re.sub(r"<inertial>.*?</inertial>", "", CLEAN, flags=re.S))
    clean, none = (
        with_assumed_inertials(RobotModel.from_urdf(tmp_path / f"{x}.urdf"))
        for x in ("clean", "none")
    )
    scale, spikes = (
        Finding(code, "warning", "a.csv: elbow", "") for code in ("torque_scale", "spikes")
    )
    assert explained_by_assumed(none, scale)
    assert not explained_by_assumed(none, spikes)
    assert not explained_by_assumed(clean, scale)
