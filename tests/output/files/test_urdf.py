import hashlib
import json
import re

import numpy as np
import pytest
from helpers.robots import possible_parameters

from robotid.base.exceptions import ModelError
from robotid.dynamics.torque import random_regressor
from robotid.output.files.urdf import load_identified, write_urdf
from robotid.output.files.xml_splice import (
    Edit,
    apply,
    insert,
    parse,
    remove,
    replace,
    set_attributes,
)
from robotid.robot.model import RobotModel
from robotid.robot.parameters import Coupling, pseudo_inertia
from robotid.robot.tree import read_tree, read_with_yourdfpy

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
    units = json.loads(sidecar.read_text())["units"]
    assert (
        units.items()
        >= dict(
            zip(
                model.layout.drive_names, model.layout.units[model.layout.n_inertial :], strict=True
            )
        ).items()
    )
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
        f"pseudo-inertia is {smallest:.3g}, expected > 0; identify with the estimator "
        "'consistent', whose bodies and drives are possible"
    )
    assert listing(tmp_path) == before


@pytest.mark.parametrize("term", ["armature", "viscous", "coulomb"])
def test_a_drive_that_gives_energy_is_refused(source, tmp_path, rng, term):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    pi[model.layout.names.index(f"elbow.{term}")] = -0.25
    with pytest.raises(ModelError, match=rf"{term} is -0.25 .*, expected 0 or more; .*consist"):
        write_urdf(model, pi, tmp_path / "new.urdf")
    pi[model.layout.names.index(f"elbow.{term}")] = 0.0
    pi[model.layout.names.index("elbow.offset")] = -0.25
    write_urdf(model, pi, tmp_path / "new.urdf")


def test_a_target_that_cannot_be_is_refused(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    pi = possible_parameters(model, rng)
    (tmp_path / "link.urdf").symlink_to(source)
    (tmp_path / "folder.urdf").mkdir()
    for name in ("arm.urdf", "link.urdf"):
        with pytest.raises(ModelError, match="is the original URDF; choose another name"):
            write_urdf(model, pi, tmp_path / name)
    with pytest.raises(ModelError, match="is a folder, expected a file"):
        write_urdf(model, pi, tmp_path / "folder.urdf")
    with pytest.raises(ModelError, match=r"the folder '.*none' does not exist; create it"):
        write_urdf(model, pi, tmp_path / "none" / "new.urdf")
    assert source.read_bytes().decode() == RICH
    source.unlink()
    with pytest.raises(ModelError, match=r"the model's URDF '.*arm.urdf' no longer exists"):
        write_urdf(model, pi, tmp_path / "new.urdf")


def test_a_source_that_changed_since_is_noticed(source, tmp_path, rng):
    model = RobotModel.from_urdf(source)
    source.write_bytes(RICH.replace('xyz="0.5 0 0"', 'xyz="0.6 0 0"').encode())
    before = listing(tmp_path)
    with pytest.raises(ModelError, match=r"another torque at shoulder.* If .*arm.urdf has changed"):
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
        f"with {found[:12]}, expected {digest[:12]}; restore the file, or write both again"
    )
    new.unlink()
    with pytest.raises(ModelError, match=r"there is no URDF file '.*new.urdf'"):
        load_identified(new, sidecar)


LINES = ["<new>", "<a/>", "</new>"]


def edited(data, change, where="x.urdf"):
    document = parse(data, where)
    edits = change(document)
    return apply(document, edits if isinstance(edits, list) else [edits])


def first(document, *tags):
    element = document.root
    for tag in tags:
        element = element.find_all(tag)[0]
    return element


@pytest.mark.parametrize("data", [
    b"<r/>", b'<?xml version="1.0"?>\r\n<!-- > -->\r\n<r a=">" b=\'"\' >\r\n<c/></r>',
    b'\xef\xbb\xbf<r xmlns:x="u"><x:c><![CDATA[<d>]]></x:c><?p <d>?></r>\n\n',
    '<?xml version="1.0" encoding="ISO-8859-1"?><r n="é"/>'.encode("latin-1"),
    '\ufeff<r n="é">\n</r>'.encode("utf-16-le"), '\ufeff<r n="é">\n</r>'.encode("utf-16-be"),
])  # fmt: skip
def test_a_file_without_changes_comes_back_byte_for_byte(data):
    assert edited(data, lambda document: []) == data


def test_a_replaced_element_is_indented_like_the_file():
    data = b"<r>\r\n\t<l>\r\n\t\t<old/>\r\n\t</l>\r\n</r>"
    new = edited(data, lambda d: replace(d, first(d, "l", "old"), LINES))
    assert new == (b"<r>\r\n\t<l>\r\n\t\t<new>\r\n\t\t\t<a/>\r\n\t\t</new>\r\n\t</l>\r\n</r>")


def test_a_self_closing_element_is_opened():
    data = b'<r>\n    <l n="a" />\n</r>'
    wanted = b'<r>\n    <l n="a" >\n        <new>\n            <a/>\n        </new>\n    </l>\n</r>'
    assert edited(data, lambda d: insert(d, first(d, "l"), LINES)) == wanted


def test_a_removed_element_takes_its_lines_along_only_if_it_has_them_alone():
    alone = b"<r>\n  <l>\n    <old>\n    </old>  \n    <k/>\n  </l>\n</r>"
    wanted = b"<r>\n  <l>\n    <k/>\n  </l>\n</r>"
    assert edited(alone, lambda d: remove(d, first(d, "l", "old"))) == wanted
    shared = b"<r>\n  <l>\n    <old/> <!-- kept -->\n  </l>\n</r>"
    wanted = b"<r>\n  <l>\n     <!-- kept -->\n  </l>\n</r>"
    assert edited(shared, lambda d: remove(d, first(d, "l", "old"))) == wanted


def test_attributes_are_changed_in_place_and_missing_ones_added():
    data = b"<r><d a='1' note=\"damping='3'\"  damping = '2' /></r>"
    new = edited(
        data, lambda d: set_attributes(d, first(d, "d"), {"damping": "5", "friction": "6"})
    )
    assert new == b"<r><d a='1' note=\"damping='3'\"  damping = '5' friction=\"6\" /></r>"


def test_what_cannot_be_edited_is_refused():
    with pytest.raises(ModelError, match=r"x.urdf is not well-formed XML: mismatched tag"):
        parse(b"<r><l></r>", "x.urdf")
    with pytest.raises(ModelError, match=r"x.urdf declares utf-8, but has other bytes"):
        parse(b'<r n="\xe9"/>', "x.urdf")
    entity = b'<!DOCTYPE r [<!ENTITY e "<l/>">]><r>&e;</r>'
    with pytest.raises(ModelError, match=r"<l> near byte \d+ is inside an entity"):
        parse(entity, "x.urdf")
    with pytest.raises(ModelError, match=r"x.urdf: unknown encoding: klingon"):
        parse(b'<?xml version="1.0" encoding="klingon"?><r/>', "x.urdf")
    document = parse(b"<r><l/></r>", "x.urdf")
    with pytest.raises(ModelError, match="two edits of the XML overlap at byte 4"):
        apply(document, [Edit(3, 7, b""), Edit(4, 5, b"")])
