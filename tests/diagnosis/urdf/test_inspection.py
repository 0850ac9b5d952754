import json
import math
import re

import numpy as np
import pytest
from helpers.findings import Figures
from helpers.synthetic import exact_log, truth

from robotid.base.exceptions import ModelError
from robotid.base.findings import Finding
from robotid.cli.doctor import doctor
from robotid.diagnosis.urdf.inertials import (
    audit_bodies,
    audit_links,
    explained_by_assumed,
    impossible_inertials,
)
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.torque import random_regressor
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
    # the armature of the first joint acts like an inertia of its link: 6 + 8 - 1 = 13
    sizes = [structure[key] for key in ("standard", "base_inertial", "base", "rank")]
    assert sizes == [20, 6, 13, 13]
    assert 1 <= structure["condition"] < 1e3
    assert len(content["base_groups"]) == 6
    assert "upper.mcy" in structure["undetermined"]
    assert "lower.Iyy" not in structure["undetermined"]


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
        "the URDF has no <inertial> with a mass: lower. robotid assumes the masses of"
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
    ('"1"/>', '"0"/>', "zero_mass", "link lower", "warning", "has the mass 0 kg, expected more"),
    ("</robot>", TOOL.format(inertial=INERTIAL.format(m=0)), "zero_mass", "link tool", "note", ""),
    ('"2"/>', '"-2"/>', "negative_mass", "link upper", "error", "mass -2 kg, expected more than 0"),
    ('izz="0.11"', 'izz="0.23"', "not_positive_definite", "link upper", "error",
     "the sum of the two smaller ones is 0.22, expected more than 0.23"),
    ('ixy="0"', 'ixy="0.2"', "not_positive_definite", "link upper", "error",
     "are not all positive, expected > 0 (-0.09"),
    ('izz="0.11"', 'izz="0.22"', "not_positive_definite", "link upper", "note", "flat or thin"),
    (LIMIT, "", "no_limits", "joint shoulder", "warning", "lower missing, upper missing, expecte"),
    ('lower="-1" upper="1"', 'lower="1" upper="-1"', "no_limits", "joint shoulder", "warning",
     "lower 1.0, upper -1.0, expected lower < upper"),
    (LIMIT, LIMIT.replace('"9"', '"0"').replace('"2"', '"0.0"'), "no_limits", "joint shoulder",
     "warning", "velocity 0 and effort 0, expected more than 0"),
    ('damping="0.5"', 'damping="-0.5"', "negative_damping", "joint shoulder", "warning",
     "has damping -0.5, expected 0 or more"),
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
    ('xyz="0.5 0 0"', 'xyz="${l} 0 0"', "not_a_number", "joint elbow", "error", "'${l} 0 0'"),
    ('lower="-1"', 'lower=""', "not_a_number", "joint shoulder", "error", "limit lower is ''"),
    ('damping="0.5"', 'damping="nan"', "not_a_number", "joint shoulder", "error", "damping"),
    ('xyz="0.5 0 0"', 'xyz="500 0 0"', "origin_units", "joint elbow", "error", "'elbow' is 500 m"),
    ('xyz="0.2 0 0"', 'xyz="200 0 0"', "inertial_units", "link lower", "warning", "m: lower."),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "code", "where", "severity", "part"), FAULTS)
def test_a_fault_of_the_file_is_named(tmp_path, old, new, code, where, severity, part):
    inspection = inspected(tmp_path, (old, new))
    (finding,) = [f for f in inspection.findings if f.code == code]
    is_one = code == "not_a_number"  # neither reader repeats it
    assert not is_one or len(inspection.findings) == 1
    assert (finding.where, finding.severity) == (where, severity)
    assert part in finding.message
    json.dumps(inspection.to_dict(), allow_nan=False)


def test_point_masses_are_no_lengths_in_another_unit(tmp_path):
    text = re.sub('(i..)="0.[0-9]+"', r'\1="1e-6"', CLEAN)
    for old, new in (("0.2 0", "0.4 0"), ("0.1 0", "0 0"), ('"2"', '"0.01"'), ("0.5 0", "0.9 0")):
        text = text.replace(old, new)
    (tmp_path / "points.urdf").write_text(text)
    assert {x.code for x in inspect_urdf(tmp_path / "points.urdf").findings} == {"default_inertial"}


def test_a_fit_is_warned_of_impossible_inertias_only(tmp_path):
    inspected(tmp_path, ('izz="0.11"', 'izz="0.23"'), ('izz="0.035"', 'izz="0.05"'))
    (finding,) = impossible_inertials(RobotModel.from_urdf(tmp_path / "two.urdf"))
    assert (finding.where, finding.severity) == ("link upper", "warning")
    assert finding.message.endswith("a consistent fit uses the nearest possible body instead")


def test_the_inertia_may_be_stated_in_a_turned_frame(tmp_path):
    turned = inspected(tmp_path, ('<origin xyz="0.1 0 0"/>', '<origin xyz="0 0 0" rpy="1 2 3"/>'))
    assert turned.to_dict()["findings"] == []


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
    said = finding["message"]
    assert "limits, damping, friction and mimic of its joints were not checked" in said
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
    head, _, rest = CLEAN.partition("</inertial>")
    (tmp_path / "held.urdf").write_text(head.partition("<inertial>")[0] + rest)
    with_lower, alone = (  # of the upper arm, whose locked lower arm keeps its inertial
        with_assumed_inertials(RobotModel.from_urdf(tmp_path / name, locked={"elbow": 0.0}))
        for name in ("held.urdf", "none.urdf")
    )
    held = with_lower.standard_parameters() - alone.standard_parameters()
    np.testing.assert_allclose(held[[0, 1, 6]], [1, 0.7, 0.03 + 0.7**2])
    same = re.sub(r"<inertial>.*?</inertial>", INERTIAL.format(m=1), CLEAN, flags=re.S)
    (tmp_path / "same.urdf").write_text(same)  # of placeholders without <origin>, two are enough
    assert len(with_assumed_inertials(RobotModel.from_urdf(tmp_path / "same.urdf")).assumed) == 2


# --- inertials against the geometry ---------------------------------------------------------------
ARM = """<robot name="arm">
  <link name="base"/>
  <joint name="j1" type="continuous"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/></joint>
  <link name="upper">
    <inertial><origin xyz="{com}"/><mass value="{mass}"/>
      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.1 0.1"/></geometry></collision>
  </link>
  <joint name="j2" type="continuous"><parent link="upper"/><child link="fore"/>
    <origin xyz="0.4 0 0"/><axis xyz="0 1 0"/></joint>
  <link name="fore">
    <inertial><origin xyz="0.1 0 0"/><mass value="2.1"/>
      <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.02"/></inertial>
    <collision><origin xyz="0.1 0 0"/><geometry>{shape}</geometry></collision>
  </link>
</robot>"""
GOOD = {
    "com": "0.2 0 0", "mass": "4.0", "ixx": "0.0067", "iyy": "0.0567", "izz": "0.0567",
    "shape": '<box size="0.2 0.08 0.08"/>',
}  # fmt: skip


def audit(tmp_path, **changed):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(**(GOOD | changed)))
    return list(audit_links(RobotModel.from_urdf(path)))


@pytest.mark.parametrize(
    ("changed", "code", "evidence"),
    [
        ({"com": "0.2 0 0.3"}, "com_outside", {"outside": 0.25}),
        ({"mass": "400"}, "density", {"density": 100_000.0}),
        ({"mass": "0.02", "ixx": "3e-5", "iyy": "3e-4", "izz": "3e-4"}, "density",
         {"density": 5.0}),
        # the second moments add up to half the trace of the inertia
        ({"iyy": "0.56", "izz": "0.56"}, "gyration",
         {"gyration": np.sqrt(0.5 * (0.0067 + 1.12) / 4.0), "farthest": np.hypot(0.2, 0.005**0.5)}),
    ],
)  # fmt: skip
def test_what_the_geometry_does_not_allow_is_named_with_its_figure(
    tmp_path, changed, code, evidence
):
    found = audit(tmp_path, **changed)
    assert [finding.code for finding in found] == [code]
    assert found[0].where == "link upper"
    assert {key: found[0].evidence[key] for key in evidence} == pytest.approx(evidence)


@pytest.mark.parametrize(
    ("shape", "severities"),
    [
        ('<box size="0.9 0.9 0.9"/>', []), ('<box size="0.1 0.1 0.1"/>', ["warning"]),
        ('<mesh filename="package://arm/missing.stl"/>', ["note"]),
    ],
)  # fmt: skip
def test_a_collision_stand_in_is_judged_with_the_visual(tmp_path, shape, severities):
    visual = f"<visual><geometry>{shape}</geometry></visual>"
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(**(GOOD | {"com": "0.2 0 0.3"})).replace(
        '<collision><origin xyz="0.2 0 0"/>', f'{visual}<collision><origin xyz="0.2 0 0"/>'
    ))  # fmt: skip
    found = audit_links(RobotModel.from_urdf(path))
    assert [f.severity for f in found if f.code == "com_outside"] == severities


def test_what_hardly_weighs_hardly_matters(tmp_path):
    light = {"mass": "1e-3", "ixx": "0", "iyy": "0", "izz": "0", "com": "0.2 0 0.3"}
    found = audit(tmp_path, **light)
    assert {(f.code, f.severity) for f in found} == {("com_outside", "note"), ("density", "note")}
    for mass, severity in (("2.1015e-3", "note"), ("2.1030e-3", "warning")):  # of all: 2.1021 kg
        (first, *_) = audit(tmp_path, **light | {"mass": mass})
        assert (first.code, first.severity) == ("com_outside", severity)


def test_an_ellipsoid_longer_than_its_box_allows_is_a_note_with_both_lengths(tmp_path):
    (found,) = audit(tmp_path, ixx="0.04", izz="0.09")
    assert (found.code, found.severity, found.where) == ("ellipsoid", "note", "link upper")
    length = 2 * np.sqrt(5 * (0.04 + 0.09 - 0.0567) / 2 / 4.0)  # along y
    assert Figures(found) == pytest.approx({"length": length, "side": 0.1})
    box = "the box of its geometry has 0.1 m; expected: at most 0.224 m"
    assert f"is {length:.3g} m long in y, but {box}" in found.message
    limit = 0.1**2 / 4  # variance of two halves on two sides
    for factor, count in ((0.98, 0), (1.02, 1)):
        izz = f"{0.0567 - 0.0067 + 8 * factor * limit}"
        assert len(audit(tmp_path, izz=izz)) == count


def slender(tmp_path, length, *, com=0.2, offset=0.4):
    """Audit the arm without geometry; the ellipsoid of its upper link has this length."""
    path = tmp_path / "arm.urdf"
    axis = 4.0 * (length / 2) ** 2 / 5.0
    text = ARM.format(**(GOOD | {"com": f"{com} 0 0", "iyy": axis, "izz": axis, "ixx": "1e-3"}))
    text = re.sub("<collision>.*?</collision>", "", text).replace("0.4 0 0", f"{offset} 0 0")
    path.write_text(text)
    model = RobotModel.from_urdf(path)
    return list(audit_bodies(model, model.standard_parameters(), {}))


def test_a_link_without_geometry_is_compared_with_the_distance_of_its_joints(tmp_path):
    reference = 0.4 + 0.1 * (0.1 + 0.4)  # between its joints, and housings
    for factor, severities in ((1.55, []), (1.65, ["note"]), (2.2, ["note"]), (2.3, ["warning"])):
        found = slender(tmp_path, factor * reference)
        assert [finding.severity for finding in found] == severities, factor
    (finding,) = found
    assert (finding.code, finding.where) == ("ellipsoid", "link upper")
    # the second moment along x is half of iyy + izz - ixx
    length = np.sqrt((2.3 * reference) ** 2 - 4 * 5 / 4.0 * 1e-3 / 2)
    assert Figures(finding) == pytest.approx({"length": length, "side": reference})
    assert "is 1.03 m long, but its joints allow a length of about 0.45 m" in finding.message
    assert "(expected: at most 0.72 m)" in finding.message
    (finding,) = slender(tmp_path, 0.3, com=-0.5)
    assert (finding.code, finding.severity) == ("com_outside", "warning")
    assert Figures(finding) == pytest.approx({"outside": 0.05})
    assert slender(tmp_path, 0.3, com=-0.44) == []
    assert [f.code for f in slender(tmp_path, 2.3, com=-0.5)] == ["com_outside"]  # only the cause
    # the last body ends beyond its joint; it may be as wide as the longest of all bodies
    (finding,) = slender(tmp_path, 0.05, com=0.1, offset=0.05)
    assert (finding.code, finding.where, finding.severity) == ("ellipsoid", "link fore", "note")


def test_a_copied_inertial_is_told_by_the_other_size(tmp_path):
    copy = {"com": "0.1 0 0", "mass": "2.1", "ixx": "0.004", "iyy": "0.02", "izz": "0.02"}
    (found,) = audit(tmp_path, **copy)
    assert found.code == "copied_inertial"
    assert "upper, fore" in found.message
    same = '<box size="0.4 0.1 0.1"/>'
    assert [f.code for f in audit(tmp_path, **copy, shape=same)] == []


def test_numbers_of_templates_are_named(tmp_path):
    numbers = {"com": "0 0 0", "mass": "1.0", "ixx": "0.001", "iyy": "0.001", "izz": "0.001"}
    (found,) = audit(tmp_path, **numbers)
    assert found.code == "default_inertial"
    assert "1 kg and 0.001 kg m^2 about every axis" in found.message
    assert Figures(found) == {"mass": 1.0, "moment": 0.001}
    # a moment may be round by chance: of a stated mass, about a stated centre
    assert not any(
        f.code == "default_inertial"
        for f in audit(tmp_path, **numbers | {"mass": "1.3", "com": "0.2 0 0"})
    )
