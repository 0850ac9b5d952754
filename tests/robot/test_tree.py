"""Values that are read from a URDF, and what becomes of them in the model."""

import math

import numpy as np
import pinocchio as pin
import pytest

from robotid.base.exceptions import ModelError
from robotid.robot.model import RobotModel
from robotid.robot.tree import read_tree
from robotid.robot.urdf_text import parse_urdf

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
