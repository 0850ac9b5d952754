import re

import numpy as np
import pytest
from helpers.findings import Figures

from robotid.diagnosis.urdf.inertials import audit_bodies, audit_links
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel

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


def test_inertials_that_fit_their_geometry_are_not_mentioned(tmp_path):
    assert audit(tmp_path) == []


@pytest.mark.parametrize(
    ("changed", "code", "evidence"),
    [
        ({"com": "0.2 0 0.3"}, "com_outside", {"outside": 0.25}),
        ({"mass": "400"}, "density", {"density": 100_000.0}),
        (
            {"mass": "0.02", "ixx": "3e-5", "iyy": "3e-4", "izz": "3e-4"},
            "density",
            {"density": 5.0},
        ),
        ({"iyy": "0.56", "izz": "0.56"}, "gyration", None),
    ],
)
def test_what_the_geometry_does_not_allow_is_named_with_its_figure(
    tmp_path, changed, code, evidence
):
    found = audit(tmp_path, **changed)
    assert [finding.code for finding in found] == [code]
    assert found[0].where == "link upper"
    if evidence is not None:
        assert {key: found[0].evidence[key] for key in evidence} == pytest.approx(evidence)


def test_what_hardly_weighs_hardly_matters(tmp_path):
    light = {"mass": "1e-3", "ixx": "0", "iyy": "0", "izz": "0", "com": "0.2 0 0.3"}
    found = audit(tmp_path, **light)
    assert {(f.code, f.severity) for f in found} == {("com_outside", "note"), ("density", "note")}
    for mass, severity in (("2.1015e-3", "note"), ("2.1030e-3", "warning")):  # of all: 2.1021 kg
        (first, *_) = audit(tmp_path, **light | {"mass": mass})
        assert (first.code, first.severity) == ("com_outside", severity)


def test_the_radius_of_gyration_is_that_of_the_inertia(tmp_path):
    (found,) = audit(tmp_path, iyy="0.56", izz="0.56")
    # the second moments add up to half the trace of the inertia
    assert found.evidence["gyration"] == pytest.approx(np.sqrt(0.5 * (0.0067 + 1.12) / 4.0))
    assert found.evidence["farthest"] == pytest.approx(np.linalg.norm([0.2, 0.05, 0.05]))


def test_an_ellipsoid_longer_than_its_box_allows_is_a_note_with_both_lengths(tmp_path):
    (found,) = audit(tmp_path, ixx="0.04", izz="0.09")
    assert (found.code, found.severity, found.where) == ("ellipsoid", "note", "link upper")
    length = 2 * np.sqrt(5 * (0.04 + 0.09 - 0.0567) / 2 / 4.0)  # along y
    assert Figures(found) == pytest.approx({"length": length, "side": 0.1})
    assert (
        f"is {length:.3g} m long in y, the box of its geometry 0.1 m; wanted: at most 0.224 m"
        in (found.message)
    )
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
    assert "is 1.03 m long, its joints allow a length of about 0.45 m" in finding.message
    assert "(wanted: at most 0.72 m)" in finding.message
    (finding,) = slender(tmp_path, 0.3, com=-0.5)
    assert (finding.code, finding.severity) == ("com_outside", "warning")
    assert Figures(finding) == pytest.approx({"outside": 0.05})
    assert slender(tmp_path, 0.3, com=-0.44) == []
    assert [f.code for f in slender(tmp_path, 2.3, com=-0.5)] == ["com_outside"]  # only the cause
    # the last body ends beyond its joint: a note
    assert [(f.where, f.severity) for f in slender(tmp_path, 0.1, com=0, offset=0)] == [
        ("link fore", "note")
    ]


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


def test_the_panda_of_the_examples_has_an_inertia_that_its_shape_cannot_have():
    codes = {(f.code, f.where) for f in inspect_urdf(example_urdf("panda.urdf")).findings}
    assert ("gyration", "link panda_link1") in codes
