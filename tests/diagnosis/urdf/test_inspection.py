import json
import math
import re

import numpy as np
import pytest
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import ModelError
from robotid.base.findings import Finding
from robotid.cli.doctor import doctor
from robotid.diagnosis.urdf.inertials import explained_by_assumed, impossible_inertials
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import random_regressor
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.prior import with_assumed_inertials
from robotid.robot.tree import read_with_yourdfpy

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


LIMIT = '<limit lower="-1" upper="1" effort="9" velocity="2"/>'
END = "</joint>\n</robot>"
MIMIC = '<mimic joint="shoulder" multiplier="-2"/></joint>\n</robot>'
ORIGIN, TURNED = '<origin xyz="0.5 0 0"/>', '<origin xyz="0.5 0 0" rpy="3.1416 0 0"/>'
#: What is changed, and the finding: code, subject, severity, a part of its sentence.
FAULTS = [
    ('"1"/>', '"0"/>', "zero_mass", "link lower", "warning", "has the mass 0 kg, wanted more"),
    ("</robot>", TOOL.format(inertial=INERTIAL.format(m=0)), "zero_mass", "link tool", "note", ""),
    ('"2"/>', '"-2"/>', "negative_mass", "link upper", "error", "mass -2 kg, wanted more than 0"),
    ('izz="0.11"', 'izz="0.23"', "not_positive_definite", "link upper", "error",
     "the sum of the two smaller ones is 0.22, wanted more than 0.23"),
    ('ixy="0"', 'ixy="0.2"', "not_positive_definite", "link upper", "error",
     "are not all positive, wanted > 0 (-0.09"),
    ('izz="0.11"', 'izz="0.22"', "not_positive_definite", "link upper", "note", "flat or thin"),
    (LIMIT, "", "no_limits", "joint shoulder", "warning", "lower None, upper None, wanted lower <"),
    ('lower="-1" upper="1"', 'lower="1" upper="-1"', "no_limits", "joint shoulder", "warning",
     "lower 1.0, upper -1.0, wanted lower < upper"),
    (LIMIT, LIMIT.replace('"9"', '"0"').replace('"2"', '"0.0"'), "no_limits", "joint shoulder",
     "warning", "has limits velocity 0 and effort 0, wanted more than 0"),
    ('damping="0.5"', 'damping="-0.5"', "negative_damping", "joint shoulder", "warning",
     "has damping -0.5, wanted 0 or more"),
    ('friction="0.25"', 'friction="-0.25"', "negative_friction", "joint shoulder", "warning",
     "Pinocchio rejects"),
    ('rpy="0 0 0"', 'rpy="0 -3.1416 0.1"', "rounded_rpy", "joint shoulder", "note",
     f"write {-math.pi!r} for -3.1416. The identifiable"),
    (ORIGIN, TURNED, "rounded_rpy", "joint elbow", "note", "more parameters seem identifiable"),
    (END, MIMIC, "mimic_joint", "joint elbow", "note", "'shoulder' (multiplier -2, offset 0)"),
    (END, MIMIC.replace("shoulder", "nobody"), "mimic_joint", "joint elbow", "warning",
     "mimics 'nobody', which is not another movable joint"),
    ("</robot>", TOOL.format(inertial=INERTIAL.format(m=0.3)), "fixed_lumped", "link lower", "note",
     "is one body with tool, attached by fixed joints"),
    ('value="2"', 'value="nan"', "not_a_number", "link upper", "error", "mass value is 'nan'"),
    ('xyz="0.1 0 0"', 'xyz="0,1 0 0"', "not_a_number", "link upper", "error", "xyz is '0,1 0 0'"),
    ('xyz="0.5 0 0"', 'xyz="${l} 0 0"', "not_a_number", "joint elbow", "error", "'${l} 0 0'"),
    ('lower="-1"', 'lower=""', "not_a_number", "joint shoulder", "error", "limit lower is ''"),
    ('damping="0.5"', 'damping="nan"', "not_a_number", "joint shoulder", "error", "damping"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "code", "where", "severity", "part"), FAULTS)
def test_a_fault_of_the_file_is_named(tmp_path, old, new, code, where, severity, part):
    inspection = inspected(tmp_path, (old, new))
    (finding,) = [f for f in inspection.findings if f.code == code]
    assert (finding.where, finding.severity) == (where, severity)
    assert part in finding.message
    json.dumps(inspection.to_dict(), allow_nan=False)


def test_a_fit_is_warned_of_impossible_inertias_only(tmp_path):
    inspected(tmp_path, ('izz="0.11"', 'izz="0.23"'), ('izz="0.035"', 'izz="0.05"'))
    (finding,) = impossible_inertials(RobotModel.from_urdf(tmp_path / "two.urdf"))
    assert (finding.where, finding.severity) == ("link upper", "warning")
    assert finding.message.endswith("a consistent fit uses the nearest possible body instead")


def test_the_inertia_may_be_stated_in_a_turned_frame(tmp_path):
    turned = inspected(tmp_path, ('<origin xyz="0.1 0 0"/>', '<origin xyz="0 0 0" rpy="1 2 3"/>'))
    assert turned.to_dict()["findings"] == []


def test_angles_that_are_exact_or_meant_are_not_named(tmp_path):
    for angle in (math.pi, -math.pi / 2, 1.5707963, 3.13, 0.0005, 0.0):
        inspection = inspected(tmp_path, ('rpy="0 0 0"', f'rpy="0 {angle!r} 0"'))
        assert found(inspection, "rounded_rpy") == [], angle


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
        findings = [f for f in doctor(model, [log]) if f.code == "rounded_rpy"]
        assert len(findings) == expected, angle
        if findings:
            severity = {"3.14": "warning", "3.1416": "note"}[angle]
            assert (findings[0].severity, findings[0].where) == (severity, "joint elbow")
            assert "joint 'elbow' has rounded angles in rpy" in findings[0].message
        snapped = RobotModel.from_urdf(tmp_path / "two.urdf", snap_angles=True)
        assert not [f for f in doctor(snapped, [log]) if f.code == "rounded_rpy"]


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
    upper, lower = none.standard_parameters()[:20].reshape(2, 10)  # boxes of 1000 kg/m^3
    np.testing.assert_allclose(lower, [1, 0, 0, 0, *0.02 / 12 * np.array([1, 0, 1, 0, 0, 1])])
    np.testing.assert_allclose(upper[[0, 1, 6]], [6, 1.5, 6 * (0.37 / 12 + 0.25**2)])
