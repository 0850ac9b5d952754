import hashlib
import json
import os
import re
import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest
from helpers.closed_chains import four_bar
from helpers.robots import motion, possible_parameters

from robotid.base.exceptions import DataError, ModelError
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.base_parameters import structural_mapping
from robotid.dynamics.factors import compress
from robotid.dynamics.torque import build_problem, random_regressor
from robotid.estimation.estimators import OLS
from robotid.output.files import urdf
from robotid.output.files.urdf import load_identified, read_sidecar, urdf_changes, write_urdf
from robotid.robot.bodies import link_places
from robotid.robot.examples import example_urdf
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia
from robotid.robot.tree import read_tree
from robotid.robot.urdf_text import read_with_yourdfpy

# three joints; a tool on a fixed joint, a frame without inertial, and much that is no dynamics
RICH = """\ufeff<?xml version="1.0" encoding="utf-8"?>
<!-- Roboter für Prüfstände: <inertial> in a comment -->
<robot name='arm' xmlns:xacro="http://www.ros.org/wiki/xacro" xmlns:my="urn:x">
    <link name="world_frame"/>
    <link  name="base" >
        <inertial><mass value="9.000"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    </link>
    <my:link name="upper"><inertial>not ours</inertial></my:link>
    <link name="upper">
        <visual><geometry><mesh filename="package://none/ü.stl"/></geometry></visual>
        <inertial>
            <origin rpy="0.1 0.2 0.3" xyz="0.1 0.02 0.03"/>
            <mass value="2"/>
            <inertia ixx="0.1" ixy="0.01" ixz="0.02" iyy="0.12" iyz="0.005" izz="0.09"/>
        </inertial>   <!-- from CAD -->
        <my:note><inertial><mass value="7"/></inertial></my:note>
    </link>
    <link name="lower"/>
    <link name="hand"><inertial><origin xyz="0 0 0.1"/><mass value="0.5"/>
        <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
    <link name="tool">
        <inertial>
            <mass value="0.3"/>
            <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.004"/>
        </inertial>
    </link>
    <joint name="to_world" type="fixed"><parent link="world_frame"/><child link="base"/></joint>
    <joint name="shoulder" type="revolute">
        <parent link="base"/> <child link="upper"/>
        <axis xyz="0 1 0"/> <limit lower="-1" upper="1" effort="10" velocity="2"/>
        <dynamics  friction='9' spring="a>b"/>
    </joint>
    <joint name="elbow" type="continuous">
        <parent link="upper"/> <child link="lower"/> <origin xyz="0.5 0 0" rpy="0.3 0 0"/>
        <axis xyz="0 0 1"/>
    </joint>
    <joint name="slide" type="prismatic"><parent link="lower"/><child link="hand"/><origin xyz="0.1 0 0.4"/><axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="1" velocity="1"/></joint>
    <joint name="grasp" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0 0.2 0"/></joint>
    <gazebo reference="upper"><inertial><mass value="3"/></inertial><link name="upper"/></gazebo>
    <ros2_control name="system" type="system"><joint name="elbow"><dynamics damping="4"/></joint></ros2_control>
    <transmission name="t"><joint name="elbow"/><actuator name="m"/></transmission>
</robot>
""".replace("\n", "\r\n")  # noqa: E501


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_bytes(RICH.encode())
    return path


def assert_same_torque(model, pi, loaded, read_back):
    assert loaded.layout == model.layout
    np.testing.assert_array_equal(loaded.pin_model.gravity.linear, model.pin_model.gravity.linear)
    expected, found = (
        (random_regressor(robot, 60, np.random.default_rng(7)) @ x).reshape(60, -1)
        for robot, x in ((model, pi), (loaded, read_back))
    )
    difference = np.linalg.norm(found - expected, axis=0)
    assert (difference <= 1e-9 * np.linalg.norm(expected, axis=0)).all()


OPTIONS = {
    "all joints": {},
    "one locked": dict(joints=["shoulder", "elbow"], locked={"slide": 0.05}),
    "two locked, order changed": dict(joints=["slide", "shoulder"], locked={"elbow": 0.7}),
    "floating": dict(free_flyer=True),
    "floating, locked": dict(free_flyer=True, locked={"elbow": -0.4}),
    "few terms, tilted": dict(terms=["viscous"], gravity=(1.0, -2.0, -9.0)),
    "coupled": dict(couplings=[Coupling("motor", (("shoulder", 1.0), ("elbow", -0.5)))]),
    "transmission": dict(
        couplings=[Coupling("elbow", (("shoulder", 1.0), ("elbow", -0.5)), replaces=True)]
    ),
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_written_files_give_the_torque_of_the_parameters(source, tmp_path, rng, options):
    model = RobotModel.from_urdf(source, **options)
    pi = possible_parameters(model, rng)
    sidecar = write_urdf(model, pi, tmp_path / "new.urdf")
    assert sidecar == tmp_path / "new.drive.json"
    loaded, read_back = load_identified(tmp_path / "new.urdf", sidecar)
    assert_same_torque(model, pi, loaded, read_back)
    np.testing.assert_array_equal(
        read_back[model.layout.n_inertial :], pi[model.layout.n_inertial :]
    )


def test_mimic_joints_come_back_as_they_were(source, tmp_path, rng):
    mimic = b'<mimic joint="shoulder" multiplier="-2" offset="0.5"/></joint>'
    at = RICH.encode().index(b"</joint>", RICH.encode().index(b'name="elbow"'))
    source.write_bytes(RICH.encode()[:at] + mimic + RICH.encode()[at + len(b"</joint>") :])
    for options in ({}, dict(mimic="coupled"), dict(mimic="coupled", joints=["slide"])):
        model = RobotModel.from_urdf(source, **options)
        pi = possible_parameters(model, rng)
        loaded, read_back = load_identified(
            tmp_path / "new.urdf", write_urdf(model, pi, tmp_path / "new.urdf")
        )
        assert loaded.mimic == model.mimic
        assert dict(loaded.locked) == dict(model.locked)
        assert_same_torque(model, pi, loaded, read_back)


def without_own_inertials(data):
    """Blank what write_urdf may change: the inertials directly inside the links that move."""
    for link in ("upper", "lower", "hand", "tool"):
        pattern = rf'(?s)<link name="{link}"(?:/>|>(?:(?!</link>).)*</link>)'
        (element,) = re.findall(pattern, data.replace('<link name="upper"/></gazebo>', ""))
        bare = re.sub(r"(?s)\s*<inertial>(?:(?!</inertial>).)*</inertial>", "", element, count=1)
        bare = re.sub(r"<link name=\"(\w+)\">\s*</link>", r'<link name="\1"/>', bare)
        data = data.replace(element, bare, 1)
    return data


def test_every_byte_outside_the_inertials_stays(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    write_urdf(model, possible_parameters(model, rng), tmp_path / "new.urdf")
    new = (tmp_path / "new.urdf").read_bytes().decode()
    assert new != RICH
    assert new.count("\n") == new.count("\r\n")
    assert without_own_inertials(new) == without_own_inertials(RICH)
    kept = ["<!-- from CAD -->", '<mass value="9.000"/>', "<inertial>not ours</inertial>"]
    kept += ['<mass value="7"/>', '<mass value="3"/>', "friction='9'"]
    assert all(text in new for text in kept)
    assert source.read_bytes().decode() == RICH


def test_new_inertials_are_indented_like_the_file(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    sidecar = write_urdf(model, pi, tmp_path / "new.urdf")
    new = (tmp_path / "new.urdf").read_bytes().decode().replace("\r\n", "\n")
    number = r"-?\d[^ \"]*"
    inertial = (
        rf'        <inertial>\n            <origin xyz="{number} {number} {number}" rpy="0 0 0"/>\n'
        rf'            <mass value="{number}"/>\n            <inertia ixx="{number}" [^>]*/>\n'
        r"        </inertial>"
    )
    assert re.search(rf'    <link name="lower">\n{inertial}\n    </link>\n', new)
    assert re.search(rf"\n{inertial}   <!-- from CAD -->\n", new)
    assert re.search(r'<link name="hand"><inertial><origin [^\n]*</inertial></link>\n', new)
    assert '    <link name="tool">\n    </link>\n' in new
    assert read_sidecar(sidecar)["lumped"] == {"lower": ["tool"]}
    tree = read_tree(tmp_path / "new.urdf")
    assert tree.inertials["upper"].mass == pi[0]  # repr keeps every digit
    assert "tool" not in tree.inertials


def test_of_a_floating_base_the_root_link_holds_the_sum(source, tmp_path, rng):
    model = RobotModel.from_urdf(source, free_flyer=True)
    pi = possible_parameters(model, rng)
    sidecar = write_urdf(model, pi, tmp_path / "new.urdf")
    tree = read_tree(tmp_path / "new.urdf")
    assert set(tree.inertials) == {"world_frame", "upper", "lower", "hand"}
    assert tree.inertials["world_frame"].mass == pi[0]
    assert read_sidecar(sidecar)["lumped"] == {"world_frame": ["base"], "lower": ["tool"]}


def test_links_behind_locked_joints_keep_their_inertials(source, tmp_path, rng):
    model = RobotModel.from_urdf(source, joints=["shoulder"], locked={"elbow": 0.3, "slide": 0.1})
    pi = possible_parameters(model, rng)
    write_urdf(model, pi, tmp_path / "new.urdf")
    before, after = read_tree(source).inertials, read_tree(tmp_path / "new.urdf").inertials
    assert after["hand"] == before["hand"]
    assert after["tool"] == before["tool"]
    assert after["upper"].mass == pytest.approx(pi[0] - 0.5 - 0.3)


def test_friction_goes_into_dynamics_only_when_asked(source, tmp_path, rng):
    # a coupling may have the name of a joint that is not identified
    coupling = Coupling("slide", (("elbow", 1.0),))
    model = RobotModel.from_urdf(source, joints=["shoulder", "elbow"], couplings=[coupling])
    pi = possible_parameters(model, rng)
    write_urdf(model, pi, tmp_path / "plain.urdf")
    write_urdf(model, pi, tmp_path / "new.urdf", dynamics=True)
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    joints = {joint.name: joint for joint in read_with_yourdfpy(tmp_path / "new.urdf").joints}
    for name in ("shoulder", "elbow"):
        assert float(joints[name].dynamics.damping) == values[f"{name}.viscous"]
        assert float(joints[name].dynamics.friction) == values[f"{name}.coulomb"]
    assert joints["slide"].dynamics is None  # not identified
    new, plain = ((tmp_path / f).read_bytes().decode() for f in ("new.urdf", "plain.urdf"))
    friction, damping = (values[f"shoulder.{term}"] for term in ("coulomb", "viscous"))
    changed = f'<dynamics  friction=\'{friction!r}\' spring="a>b" damping="{damping!r}"/>'
    assert plain.count("<dynamics") == 2
    assert new.replace(changed, "<dynamics  friction='9' spring=\"a>b\"/>") == plain.replace(
        '<axis xyz="0 0 1"/>\r\n',
        '<axis xyz="0 0 1"/>\r\n        '
        f'<dynamics damping="{values["elbow.viscous"]!r}" '
        f'friction="{values["elbow.coulomb"]!r}"/>\r\n',
    )


def test_friction_of_a_drive_that_turns_several_joints_is_in_no_dynamics(source, tmp_path, rng):
    shared = Coupling("elbow", (("shoulder", 1.0), ("elbow", -0.5)), replaces=True)
    model = RobotModel.from_urdf(source, couplings=[shared])
    pi = possible_parameters(model, rng)
    write_urdf(model, pi, tmp_path / "new.urdf", dynamics=True)
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    root = ET.parse(tmp_path / "new.urdf").getroot()
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    assert joints["elbow"].find("dynamics") is None
    for name in ("shoulder", "slide"):
        found = joints[name].find("dynamics")
        assert float(found.get("damping")) == values[f"{name}.viscous"]
        assert float(found.get("friction")) == values[f"{name}.coulomb"]


def test_the_sidecar_says_what_a_urdf_cannot(source, tmp_path, rng):
    coupling = Coupling("motor", (("shoulder", 1.0), ("elbow", -0.5)))
    model = RobotModel.from_urdf(
        source, joints=["elbow", "shoulder"], locked={"slide": 0.05}, couplings=[coupling]
    )
    pi = possible_parameters(model, rng)
    content = read_sidecar(write_urdf(model, pi, tmp_path / "new.urdf"))
    values = dict(zip(model.layout.names, pi.tolist(), strict=True))
    digests = {
        key: hashlib.sha256(path.read_bytes()).hexdigest()
        for key, path in {"new": tmp_path / "new.urdf", "old": source}.items()
    }
    assert content["schema_version"] == 1
    assert content["robot"] == "arm"
    assert (content["urdf"], content["urdf_sha256"]) == ("new.urdf", digests["new"])
    assert content["source"] == {"urdf": "arm.urdf", "sha256": digests["old"]}
    assert content["joints"] == ["elbow", "shoulder"]
    assert content["locked"] == {"slide": 0.05}
    assert content["gravity"] == [0.0, 0.0, -9.81]
    assert (content["free_flyer"], content["mimic"]) == (False, "independent")
    terms = ("armature", "viscous", "coulomb", "offset")
    assert content["drives"] == {
        joint: {term: values[f"{joint}.{term}"] for term in terms} for joint in model.joints
    }
    assert content["couplings"] == [
        {
            "name": "motor",
            "ratios": {"shoulder": 1.0, "elbow": -0.5},
            **{term: values[f"motor.{term}"] for term in terms[:3]},
        }
    ]
    assert content["units"]["elbow.viscous"] == "N m s/rad"


def test_only_the_terms_of_the_model_are_in_the_sidecar(source, tmp_path, rng):
    model = RobotModel.from_urdf(source, joints=["slide"], terms=["viscous", "offset"])
    pi = possible_parameters(model, rng)
    content = read_sidecar(write_urdf(model, pi, tmp_path / "new.urdf"))
    assert content["drives"] == {"slide": {"viscous": pi[-2], "offset": pi[-1]}}
    assert content["units"]["slide.viscous"] == "N s/m"


def listing(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_impossible_link_is_refused_and_named(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    pi[10 + 4] = -0.5  # lower.Ixx
    smallest = np.linalg.eigvalsh(pseudo_inertia(pi[10:20])[0])[0]
    before = listing(tmp_path)
    with pytest.raises(ModelError) as caught:
        write_urdf(model, pi, tmp_path / "new.urdf")
    assert str(caught.value) == (
        "link 'lower' would be physically impossible: the smallest eigenvalue of its "
        f"pseudo-inertia is {smallest:.3g}, wanted > 0; identify with the estimator 'consistent', "
        "whose bodies and drives are possible"
    )
    assert listing(tmp_path) == before


def test_a_body_lighter_than_what_it_holds_is_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source, joints=["shoulder"], locked={"elbow": 0.3})
    pi = possible_parameters(model, rng)
    pi[:10] *= 0.2  # possible as a whole, but lighter than hand and tool, which are held
    assert np.linalg.eigvalsh(pseudo_inertia(pi[:10])[0])[0] > 0
    with pytest.raises(ModelError, match=r"link 'upper', without links beyond elbow, sl") as e:
        write_urdf(model, pi, tmp_path / "new.urdf")
    # hand and tool, 0.5 + 0.3 kg: no estimator helps, their masses do
    advice = f"keep the URDF's inertials, 0.8 kg of {pi[0]:.3g} kg; correct these, or identify the"
    assert advice in str(e.value)
    assert "consistent" not in str(e.value)


def test_a_link_that_the_urdf_states_impossible_is_corrected_there(source, tmp_path):
    thin = 'iyz="0" izz="0.01"/></inertial></link>'
    source.write_text(source.read_text().replace(thin, thin.replace("0.01", "0.03")))
    model = RobotModel.from_urdf(source)  # 0.03 > 0.01 + 0.01
    with pytest.raises(ModelError, match="link 'hand' would be") as caught:
        write_urdf(model, model.standard_parameters(), tmp_path / "new.urdf")
    advice = "wanted > 0; the URDF's own is impossible, too: correct it (robotid inspect)"
    assert str(caught.value).endswith(advice)


@pytest.mark.parametrize("term", ["armature", "viscous", "coulomb"])
def test_a_drive_that_gives_energy_is_refused(source, tmp_path, rng, term):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    pi[model.layout.names.index(f"elbow.{term}")] = -0.25
    with pytest.raises(ModelError, match=rf"elbow.{term} is -0.25 .*, wanted 0 or more; .*consist"):
        write_urdf(model, pi, tmp_path / "new.urdf")
    pi[model.layout.names.index(f"elbow.{term}")] = 0.0
    pi[model.layout.names.index("elbow.offset")] = -0.25
    write_urdf(model, pi, tmp_path / "new.urdf")


def test_parameters_that_are_no_parameters_are_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    with pytest.raises(DataError, match=r"pi has shape \(3,\), wanted \(42,\)"):
        write_urdf(model, pi[:3], tmp_path / "new.urdf")
    pi[11] = np.nan
    with pytest.raises(DataError, match=r"lower.mcx is nan, wanted a finite number"):
        write_urdf(model, pi, tmp_path / "new.urdf")


def test_a_target_that_cannot_be_is_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    (tmp_path / "link.urdf").symlink_to(source)
    (tmp_path / "folder.urdf").mkdir()
    for name in ("arm.urdf", "link.urdf"):
        with pytest.raises(ModelError, match="is the original URDF; choose another name"):
            write_urdf(model, pi, tmp_path / name)
    with pytest.raises(ModelError, match="is a folder, wanted a file"):
        write_urdf(model, pi, tmp_path / "folder.urdf")
    with pytest.raises(ModelError, match=r"the folder '.*none' does not exist; create it"):
        write_urdf(model, pi, tmp_path / "none" / "new.urdf")
    assert source.read_bytes().decode() == RICH
    source.unlink()
    with pytest.raises(ModelError, match=r"the model's URDF '.*arm.urdf' no longer exists"):
        write_urdf(model, pi, tmp_path / "new.urdf")


def test_a_failure_while_writing_leaves_the_folder_as_it_was(source, tmp_path, rng, monkeypatch):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    write_urdf(model, pi, tmp_path / "new.urdf")
    before = listing(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(urdf, "numbers_text", lambda x: " ".join(f"{v:.4g}" for v in x))
        with pytest.raises(
            ModelError, match=r"new.urdf is not written: in the test reading, its torque"
        ):
            write_urdf(model, pi * 1.01, tmp_path / "new.urdf")
    other = RobotModel.from_urdf(source, joints=model.joints[:1])
    with monkeypatch.context() as patch:
        patch.setattr(urdf, "load_identified", lambda *_: (other, other.standard_parameters()))
        words = "^new.urdf is not written: in the test reading, it has other bodies or joints$"
        with pytest.raises(ModelError, match=words):
            write_urdf(model, pi * 1.01, tmp_path / "new.urdf")
    assert listing(tmp_path) == before
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
        with pytest.raises(OSError, match="disk full"):
            write_urdf(model, pi * 1.01, tmp_path / "new.urdf")
    assert listing(tmp_path) == before


def test_a_source_that_changed_since_is_noticed(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    source.write_bytes(RICH.replace('xyz="0.5 0 0"', 'xyz="0.6 0 0"').encode())
    before = listing(tmp_path)
    with pytest.raises(
        ModelError, match=r"its torque differs .* at shoulder.* If .*arm.urdf has changed"
    ):
        write_urdf(model, possible_parameters(model, rng), tmp_path / "new.urdf")
    assert listing(tmp_path) == before


def test_another_reader_finds_the_same_inertials(source, tmp_path, rng):
    """yourdfpy shares no line with this package, nor with Pinocchio."""
    model = RobotModel.from_urdf(source)
    write_urdf(model, possible_parameters(model, rng), tmp_path / "new.urdf")
    inertials = read_tree(tmp_path / "new.urdf").inertials
    assert len(inertials) > 2
    for link in read_with_yourdfpy(tmp_path / "new.urdf").links:
        if link.name in inertials:
            own = inertials[link.name]
            assert link.inertial.mass == own.mass
            origin = link.inertial.origin
            com = np.zeros(3) if origin is None else origin[:3, 3]
            np.testing.assert_allclose(com, own.com, atol=1e-15)
        else:
            assert link.inertial is None


def test_a_pair_that_does_not_belong_together_is_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    new = tmp_path / "new.urdf"
    sidecar = write_urdf(model, possible_parameters(model, rng), new)
    digest = hashlib.sha256(new.read_bytes()).hexdigest()
    new.write_bytes(new.read_bytes() + b"\n")
    with pytest.raises(ModelError) as caught:
        load_identified(new, sidecar)
    found = hashlib.sha256(new.read_bytes()).hexdigest()
    assert str(caught.value) == (
        f"new.urdf has changed since new.drive.json was written: its SHA-256 starts "
        f"with {found[:12]}, wanted {digest[:12]}; restore the file, or write both again"
    )
    new.unlink()
    with pytest.raises(ModelError, match=r"there is no URDF file '.*new.urdf'"):
        load_identified(new, sidecar)


SIDECAR_FAULTS = {
    "missing": (None, "there is no drive parameters file '.*new.drive.json'"),
    "no JSON": ("{", "new.drive.json is not JSON: "),
    "a list": ("[]", "has schema_version None, wanted 1"),
    "other schema": ('{"schema_version": 2}', "has schema_version 2, wanted 1"),
    "entries": (
        '{"schema_version": 1, "joints": 3}',
        "new.drive.json has no entry 'urdf_sha256': the file is incomplete",
    ),
}


@pytest.mark.parametrize(("text", "message"), SIDECAR_FAULTS.values(), ids=SIDECAR_FAULTS)
def test_a_faulty_sidecar_names_its_fault(tmp_path, text, message):
    if text is not None:
        (tmp_path / "new.drive.json").write_text(text)
    with pytest.raises(DataError, match=message):
        read_sidecar(tmp_path / "new.drive.json")


def test_a_sidecar_with_a_missing_drive_is_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source, couplings=[Coupling("motor", (("elbow", 2.0),))])
    sidecar = write_urdf(model, possible_parameters(model, rng), tmp_path / "new.urdf")
    content = json.loads(sidecar.read_text())
    del content["drives"]["elbow"]["viscous"]
    sidecar.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"new.drive.json: elbow.viscous is None, wanted a finite"):
        load_identified(tmp_path / "new.urdf", sidecar)
    del content["couplings"][0]["ratios"]
    sidecar.write_text(json.dumps(content))
    with pytest.raises(DataError, match=r"couplings\[0\] has no entry 'ratios'"):
        load_identified(tmp_path / "new.urdf", sidecar)


def test_every_kind_of_robot_survives_the_round_trip(ur5, panda, tmp_path, rng):
    for model in (ur5, panda):
        pi = possible_parameters(model, rng)
        sidecar = write_urdf(model, pi, tmp_path / "new.urdf", dynamics=True)
        assert_same_torque(model, pi, *load_identified(tmp_path / "new.urdf", sidecar))


def test_a_real_robot_with_locked_joints_survives_the_round_trip(recordings, tmp_path, rng):
    arm = [f"arm_{i}_joint" for i in range(1, 8)]
    path = recordings / "tiago" / "robot_hey5.urdf"
    model = RobotModel.from_urdf(path, joints=arm, locked={"torso_lift_joint": 0.2})
    pi = possible_parameters(model, rng)
    sidecar = write_urdf(model, pi, tmp_path / "tiago.urdf")
    assert_same_torque(model, pi, *load_identified(tmp_path / "tiago.urdf", sidecar))
    held = {place.link for place in link_places(model) if place.role == "held"}
    before, after = read_tree(path).inertials, read_tree(tmp_path / "tiago.urdf").inertials
    assert {link: after[link] for link in held & set(before)} == {
        link: before[link] for link in held & set(before)
    }


@pytest.mark.parametrize("name", ["iris_simple.urdf", "quadrotor_base.urdf"])
def test_a_body_that_flies_is_ten_parameters_that_its_motion_shows(tmp_path, rng, name):
    model = RobotModel.from_urdf(example_urdf(name), free_flyer=True)
    assert repr(model).endswith("0 joints, none; 10 standard parameters>")
    structure = inspect_urdf(model.tree.path, free_flyer=True).structure
    assert (structure.standard, structure.base, structure.undetermined) == (10, 10, ())
    truth = model.standard_parameters() * 1.3
    heavy = model.with_parameters(truth).pin_model
    flight, data = motion(model, rng, 40), heavy.createData()
    instants = zip(flight.q, flight.v, flight.a, strict=True)
    flight.tau = np.array([pin.rnea(heavy, data, *instant) for instant in instants])
    mapping = structural_mapping(model)
    estimate = OLS().fit(compress(mapping.reduce(build_problem(model, flight))))
    np.testing.assert_allclose(estimate.theta, mapping.to_base(truth), rtol=1e-9, atol=1e-12)
    sidecar = write_urdf(model, truth, tmp_path / "new.urdf")
    _, read_back = load_identified(tmp_path / "new.urdf", sidecar)
    np.testing.assert_allclose(read_back, truth, rtol=1e-12, atol=1e-15)


def test_snapped_angles_are_written_and_nothing_else_of_the_joints(tmp_path, rng):
    source = tmp_path / "xarm.urdf"
    source.write_bytes(example_urdf("xarm7.urdf").read_bytes())
    model = RobotModel.from_urdf(source, snap_angles=True)
    pi = possible_parameters(model, rng)
    sidecar = write_urdf(model, pi, tmp_path / "new.urdf")
    loaded, read_back = load_identified(tmp_path / "new.urdf", sidecar)  # without snapping
    assert_same_torque(model, pi, loaded, read_back)
    rpy = {joint.name: joint.rpy for joint in loaded.tree.joints}
    assert rpy["joint2"] == (-np.pi / 2, 0.0, 0.0)
    kept = re.compile(rb"<inertial.*?</inertial>|rpy=\"[^\"]*\"", re.DOTALL)
    before, after = (kept.sub(b"", f.read_bytes()) for f in (source, tmp_path / "new.urdf"))
    assert before.split() == after.split()
    plain = RobotModel.from_urdf(source)
    write_urdf(plain, pi, tmp_path / "plain.urdf")
    assert read_tree(tmp_path / "plain.urdf").joints == plain.tree.joints


def test_a_link_that_did_not_change_keeps_its_text_and_rounding_is_0(ur5, tmp_path):
    pi = ur5.standard_parameters()
    pi[1] += 1e-13 * pi[0]  # rounding of the first link's mcx
    forearm = 10 * ur5.layout.bodies.index("forearm_link")
    pi[forearm] *= 1.1
    pi[forearm + 3] = 1e-60  # its centre of mass in z, of which rounding is left
    lines = urdf_changes(ur5, pi)
    owners = {line.rsplit(" ", 1)[-1] for line in lines if line.startswith("@@")}
    assert owners == {"forearm_link", "ee_link", "tool0"}  # the last two are in wrist_3_link
    (origin,) = [line for line in lines if line.startswith("+") and "<origin" in line]
    assert origin.split('xyz="')[1].split('"')[0].split()[2] == "0.0"
    write_urdf(ur5, pi, tmp_path / "new.urdf")
    assert "e-6" not in (tmp_path / "new.urdf").read_text()


def test_a_change_is_of_the_link_in_its_line_and_not_of_the_next_line(tmp_path):
    body = (
        '<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="2"/><inertia ixx="1" '
        'iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )
    joint = (
        '<joint name="{0}" type="continuous"><parent link="{1}"/><child link="{2}"/>'
        '<axis xyz="0 0 1"/></joint>'
    )
    lines = [body.format("base"), body.format("upper"), joint.format("first", "base", "upper"),
             body.format("lower"), joint.format("second", "upper", "lower")]  # fmt: skip
    (tmp_path / "r.urdf").write_text("\n".join(["<robot name='r'>", *lines, "</robot>"]))
    model = RobotModel.from_urdf(tmp_path / "r.urdf", terms=())
    pi = model.standard_parameters()
    pi[[0, 10]] = 2.5, 3.5
    changes = [line for line in urdf_changes(model, pi) if line.startswith("@@")]
    assert changes == ["@@ -3 +3 @@ upper", "@@ -5 +5 @@ lower"]


def test_a_sidecar_states_the_loops(tmp_path):
    model = four_bar(tmp_path)
    sidecar = write_urdf(model, model.standard_parameters(), tmp_path / "written.urdf")
    loaded, _ = load_identified(tmp_path / "written.urdf", sidecar)
    assert loaded.loops == model.loops
    assert loaded.passive == model.passive
    assert json.loads(sidecar.read_text())["loops"] == [
        {"frames": ["coupler_end", "rocker_end"], "kind": "hinge", "axis": [0.0, 0.0, 1.0]}
    ]
