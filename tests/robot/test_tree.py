"""Values that are read from a URDF, and what becomes of them in the model."""

import math
import re

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import ModelError
from robotid.robot.model import RobotModel
from robotid.robot.tree import exact_angle, numbers, parse_urdf, read_tree

LINK = """<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="{1}"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>
  <origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>{4}</joint>"""
LIMIT = '<limit lower="{}" upper="{}" velocity="2" effort="9"/>'


@pytest.fixture
def chain(tmp_path):
    """Return what writes a chain of joints, each given as its type and what is in it."""

    def write(*joints):
        links = "".join(LINK.format(f"l{k + 1}", k + 1) for k in range(len(joints)))
        rows = [JOINT.format(f"j{k + 1}", kind, f"l{k}", f"l{k + 1}", more)
                for k, (kind, more) in enumerate(joints)]  # fmt: skip
        path = tmp_path / "chain.urdf"
        path.write_text(f'<robot name="chain"><link name="l0"/>{links}{"".join(rows)}</robot>')
        return path

    return write


def test_only_joints_with_a_degree_of_freedom_move(chain):
    tree = read_tree(chain(("revolute", LIMIT.format(-1, 2)), ("fixed", ""), ("prismatic", "")))
    assert [joint.name for joint in tree.movable] == ["j1", "j3"]
    assert [joint.name for joint in tree.joints] == ["j1", "j2", "j3"]


def test_limits_are_those_stated_and_a_continuous_joint_has_no_range(chain):
    limit = LIMIT.format(-1, 2)
    turn, endless, point = read_tree(
        chain(("revolute", limit), ("continuous", limit), ("revolute", LIMIT.format(0, 0)))
    ).joints
    assert (turn.lower, turn.upper, turn.velocity, turn.effort) == (-1, 2, 2, 9)
    assert (endless.lower, endless.upper, endless.velocity) == (-math.inf, math.inf, 2)
    assert [joint.has_limits for joint in (turn, endless, point)] == [True, False, False]
    assert [joint.turns_freely for joint in (turn, endless, point)] == [False, True, True]


def test_limits_that_no_joint_has_are_none(chain):
    wide = read_tree(chain(("revolute", LIMIT.format(-10000, 10000)))).movable[0]
    wound = read_tree(chain(("revolute", LIMIT.format(-12.6, 12.6)))).movable[0]
    assert [joint.turns_freely for joint in (wide, wound)] == [True, False]
    assert [joint.has_limits for joint in (wide, wound)] == [False, True]


def test_what_mimic_leaves_out_is_one_and_zero(chain):
    tree = read_tree(chain(("revolute", ""), ("revolute", '<mimic joint="j1"/>')))
    assert tree.joints[1].mimic == ("j1", 1.0, 0.0)


def test_a_mimic_of_a_mimic_follows_the_first_with_both_ratios_and_offsets(chain):
    path = chain(
        ("revolute", ""),
        ("revolute", '<mimic joint="j1" multiplier="2" offset="0.1"/>'),
        ("revolute", '<mimic joint="j2" multiplier="-3" offset="0.5"/>'),
    )
    model = RobotModel.from_urdf(path, mimic="coupled")
    # j3 = -3 (2 j1 + 0.1) + 0.5
    np.testing.assert_allclose(model.configurations(np.array([[0.2]])), [[0.2, 0.5, -1.0]])
    np.testing.assert_allclose(model.velocity_map[:, 0], [1, 2, -6])


def test_a_mimic_joint_stands_where_its_locked_leader_puts_it(chain):
    path = chain(
        ("revolute", ""), ("revolute", ""),
        ("revolute", '<mimic joint="j2" multiplier="2" offset="0.25"/>'),
    )  # fmt: skip
    model = RobotModel.from_urdf(path, mimic="coupled", locked={"j2": 0.5})
    assert model.joints == ("j1",)
    assert dict(model.locked) == {"j2": 0.5, "j3": 1.25}


@pytest.mark.parametrize("kind", ["revolute", "continuous"])
def test_a_locked_joint_is_lumped_at_its_angle(chain, kind):
    model = RobotModel.from_urdf(chain(("revolute", ""), (kind, "")), locked={"j2": 0.3})
    m, mcx, mcy = model.standard_parameters()[:3]
    assert m == pytest.approx(3.0)
    assert mcx == pytest.approx(1 * 0.1 + 2 * (0.5 + 0.1 * np.cos(0.3)))
    assert mcy == pytest.approx(2 * 0.1 * np.sin(0.3))


def test_a_mass_that_nothing_can_be_divided_by_is_refused(chain):
    path = chain(("revolute", ""))
    path.write_text(path.read_text().replace('mass value="1"', 'mass value="5e-324"'))
    with pytest.raises(ModelError, match=r"mass is 4\.94066e-324 kg, wanted 0 or at least 1e-15"):
        read_tree(path)


def test_pinocchio_gets_the_tree_alone_and_the_whole_file_is_kept(chain):
    path = chain(("revolute", LIMIT.format(-1, 2)), ("fixed", ""))
    shown = '<visual><geometry><box size="1 2 3"/></geometry></visual></link>'
    path.write_text(path.read_text().replace("</link>", shown, 1))
    tree = read_tree(path)
    assert "visual" not in tree.xml
    assert next(tree.robot.iter("box")).get("size") == "1 2 3"
    assert parse_urdf(path).get("name") == "chain"
    lean, full = pin.buildModelFromXML(tree.xml), pin.buildModelFromUrdf(str(path))
    assert [i.mass for i in lean.inertias] == [i.mass for i in full.inertias]


def test_gear_ratios_are_of_transmissions_with_one_joint_one_actuator_and_one_ratio(tmp_path):
    gear = "<mechanicalReduction>{}</mechanicalReduction>"
    gears = (
        ("first", 1, f"<actuator name='m1'>{gear.format(' -80 ')}</actuator>"),
        ("none", 1, "<actuator name='m2'/>"),
        ("wrist", 2, f"<actuator name='m3'>{gear.format(3)}</actuator>"),
        ("pair", 1, f"<actuator name='m4'/><actuator name='m5'>{gear.format(4)}</actuator>"),
        ("both", 1, f"<actuator name='m6'>{gear.format(5)}{gear.format(6)}</actuator>"),
        ("last", 1, f"<actuator name='m7'>{gear.format('0.5')}</actuator>"),
    )
    text = "".join(
        f"<transmission name='t'>{f'<joint name={name!r}/>' * count}{rest}</transmission>"
        for name, count, rest in gears
    )
    path = tmp_path / "r.urdf"
    path.write_text(f"<robot name='r'><link name='base'/>{text}</robot>")
    assert read_tree(path).reductions == {"first": -80.0, "last": 0.5}
    path.write_text(path.read_text().replace("0.5<", "half<"))
    words = "^r.urdf: the mechanicalReduction of joint 'last' is 'half', wanted a number$"
    with pytest.raises(ModelError, match=words):
        _ = read_tree(path).reductions


URDF = """<robot name="two"><link name="base"/>
<link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0.5 0 0" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="2" effort="9"/><mimic joint="k"/></joint></robot>"""
BAD = (
    "1_0", "1e400", "-1e400", " ", "", "0x10", "1,5", "nan", "inf", "Infinity", "1e", "--1",
    "１２", "1d3", "2\u00a0", "1 2", "1.2e9",
)  # fmt: skip


def written(tmp_path, old="", new=""):
    path = tmp_path / "two.urdf"
    path.write_text(URDF.replace(old, new, 1), encoding="utf-8")
    return path


PLACES = [
    ('value="2"', 'value="{}"', "link 'arm': inertial mass value is "),
    ('iyy="1"', 'iyy="{}"', "link 'arm': inertial inertia iyy is "),
    ('"0.1 0 0"', '"0 0 {}"', "link 'arm': inertial origin xyz is "),
    ('rpy="0 0 0"', 'rpy="0 0 {}"', "joint 'j': origin rpy is "),
    ('lower="-1"', 'lower="{}"', "joint 'j': limit lower is "),
    ('joint="k"', 'joint="k" offset="{}"', "joint 'j': mimic offset is "),
]


@pytest.mark.parametrize("text", BAD)
@pytest.mark.parametrize(("old", "new", "said"), PLACES)
def test_what_urdfdom_drops_is_refused_by_name(tmp_path, text, old, new, said):
    path = written(tmp_path, old, new.format(text.replace("\t", "&#9;")))
    if text == "1.2e9" and "limit" in said:  # limits do not reach the dynamics
        read_tree(path)
        return
    with pytest.raises(ModelError, match=re.escape(f"two.urdf: {said}'")) as caught:
        RobotModel.from_urdf(path)
    assert "written like 0.25 or 2.5e-1" in str(caught.value)


@pytest.mark.parametrize("text", [*BAD, "2", " 2", "+2", "2.", ".5", "2e0", "2E-1", "5e-324"])
def test_a_number_is_what_pinocchio_reads(tmp_path, text, capfd):
    """urdfdom itself is the oracle: it drops an inertial whose mass is no number to it."""
    xml = written(tmp_path, 'value="2"', f'value="{text}"').read_text(encoding="utf-8")
    mass = pin.buildModelFromXML(xml.replace("\t", "&#9;")).inertias[1].mass
    printed = capfd.readouterr().err
    assert bool(numbers(text, 1, math.inf)) == ("is not a float" not in printed)
    if numbers(text, 1, math.inf):
        assert numbers(text, 1, math.inf) == (mass,)


@pytest.mark.parametrize("text", ["2 ", " 2", "2\n   ", "&#9;2&#10;"])
@pytest.mark.parametrize(("old", "new", "said"), PLACES)
def test_blanks_around_numbers_are_read(tmp_path, text, old, new, said):
    tree = read_tree(written(tmp_path, old, new.format(text)))
    assert tree.joints == read_tree(written(tmp_path, old, new.format("2"))).joints
    assert pin.buildModelFromXML(tree.xml).inertias[1].mass == 2.0


def test_what_is_missing_is_no_zero(tmp_path):
    with pytest.raises(ModelError, match="inertial inertia ixz is missing, wanted one number"):
        read_tree(written(tmp_path, 'ixz="0" '))
    with pytest.raises(ModelError, match="axis xyz is missing, wanted 3 numbers"):
        read_tree(written(tmp_path, 'axis xyz="0 0 1"', "axis"))
    with pytest.raises(ModelError, match="origin has quat_xyzw, wanted rpy"):
        read_tree(written(tmp_path, 'rpy="0 0 0"', 'quat_xyzw="0 0 0 1"'))


def test_pinocchio_gets_the_bits_that_were_read(tmp_path):
    path = written(tmp_path, '"0.1 0 0"', '" 0.1000000000000000055511151231257827  1e-300 -.1"')
    model = RobotModel.from_urdf(path)
    assert model.tree.inertials["arm"].com == (0.1, 1e-300, -0.1)
    assert model.pin_model.inertias[1].lever.tolist() == [0.1, 1e-300, -0.1]


@pytest.mark.parametrize("limit", ["1.7976931348623157e+308", "-1e300", "2e9"])
def test_a_limit_beyond_all_motion_is_none(tmp_path, limit):
    (joint,) = read_tree(written(tmp_path, 'lower="-1"', f'lower="{limit}"')).joints
    assert not joint.has_limits


def test_rounded_angles_are_those_that_round_a_multiple_of_15_degrees():
    pi = math.pi
    rounded = {
        "3.14": pi, "3.1416": pi, "3.1415": pi, "-3.14159": -pi, "3.14158": pi, "4.7124": 1.5 * pi,
        "1.57": pi / 2, "1.5708": pi / 2, "-1.571": -pi / 2, "157.08e-2": pi / 2, "1.570": pi / 2,
        "6.2832": 2 * pi, "0.7854": pi / 4, "0.5236": pi / 6, "0.2618": pi / 12, " 1.57": pi / 2,
    }  # fmt: skip
    assert {word: exact_angle(word) for word in rounded} == pytest.approx(rounded, abs=1e-15)
    meant = ("0", "1e-3", "3.1", "3.13", "3.15", "1.6", "0.785", "0.26", "1.5711",
             "1.570912", "1.570001", repr(pi), repr(pi / 2), "3.14159265", "1e8", "x")  # fmt: skip
    assert {word: exact_angle(word) for word in meant} == dict.fromkeys(meant)


def test_files_without_end_or_bottom_are_refused_at_once(tmp_path):
    nested = written(tmp_path, "</link>", "<a>" * 1000 + "</a>" * 1000 + "</link>")
    with pytest.raises(ModelError, match="elements are nested 41 levels deep, wanted at most 40"):
        read_tree(nested)
    long = written(tmp_path, 'name="arm"', f'name="{"x" * 10_000_000}"')
    with pytest.raises(ModelError, match=r"<link>: name has 10000000 characters.*'xxx") as caught:
        read_tree(long)
    assert len(str(caught.value)) < 300
    huge = tmp_path / "huge.urdf"
    with huge.open("wb") as stream:
        stream.truncate(2**33)
    with pytest.raises(ModelError, match=r"huge.urdf has 8192 MiB, wanted a URDF of at most 64"):
        parse_urdf(huge)
    with pytest.raises(ModelError, match="is a folder, wanted a URDF file"):
        parse_urdf(tmp_path)
    with pytest.raises(ModelError, match="cannot be read: File name too long"):
        parse_urdf(tmp_path / ("x" * 300))
