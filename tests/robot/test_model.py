"""A robot from its URDF: joints, parameters, faults; as a model of Pinocchio, drives included."""

import math
import os
import re
import warnings
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
import pytest
from helpers.hostile_urdfs import FILES, MESHES, HostileUrdf, run_urdf, urdf_inputs
from helpers.robots import ROBOTS, motion, possible_parameters
from hypothesis import HealthCheck, given, settings

from robotid.base.exceptions import DataError, ModelError, SettingsError
from robotid.diagnosis.urdf.inspection import inspect_urdf
from robotid.dynamics.torque import joint_torque_regressor, predict_instants
from robotid.robot.bodies import find_mesh, read_surfaces
from robotid.robot.constraints import Contact
from robotid.robot.drives import Cubic, LoadFriction
from robotid.robot.examples import example_urdf, example_urdfs
from robotid.robot.model import RobotModel, pinocchio_model
from robotid.robot.parameters import Coupling
from robotid.robot.tree import exact_angle, numbers, parse_urdf, read_tree

TWO_JOINTS = """<robot name="two">
  <link name="base"/>
  <link name="upper"><inertial><mass value="2"/><origin xyz="0.1 0 0"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><mass value="1"/><origin xyz="0.2 0 0"/>
    <inertia ixx="0.05" iyy="0.05" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="10" velocity="2"/></joint>
  <joint name="elbow" type="{kind}"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.5 0 0"/><axis xyz="{axis}"/>{more}</joint>
</robot>"""


def write(tmp_path, kind="revolute", axis="0 1 0", more="", change=lambda text: text):
    path = tmp_path / "two.urdf"
    path.write_text(change(TWO_JOINTS.format(kind=kind, axis=axis, more=more)))
    return path


def test_every_example_robot_with_a_joint_opens_and_the_others_are_refused():
    refused = {}
    for path in example_urdfs():
        try:
            RobotModel.from_urdf(path)
            RobotModel.from_urdf(path, free_flyer=True)
        except ModelError as error:
            refused[path.name] = str(error)
    assert len(example_urdfs()) - len(refused) == 66
    assert set(refused) == {"ur3.urdf", "quadrotor_base.urdf", "iris_simple.urdf"}
    assert "<robot> has no name" in refused["ur3.urdf"]
    assert "has no movable joint" in refused["iris_simple.urdf"]
    with pytest.raises(ModelError, match="joint 'ee_fixed_joint' is fixed in ur5"):
        RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), joints=["ee_fixed_joint"])


def test_standard_parameters_are_pinocchios_inertias(ur5):
    reference = pin.buildModelFromUrdf(ur5.tree.path)
    expected = np.concatenate([i.toDynamicParameters() for i in list(reference.inertias)[1:]])
    np.testing.assert_array_equal(ur5.standard_parameters()[:60], expected)


@pytest.mark.parametrize(
    ("kind", "axis"),
    [("revolute", "0 1 0"), ("continuous", "0 0 1"), ("prismatic", "1 2 3"), ("revolute", "1 2 3"),
     ("continuous", "1 1 0")],
)  # fmt: skip
def test_every_kind_of_joint_has_one_coordinate(tmp_path, kind, axis):
    model = RobotModel.from_urdf(write(tmp_path, kind, axis))
    q = np.array([[0.3, 0.7], [0.1, -2.0]])
    configurations = model.configurations(q)
    assert configurations.shape == (2, model.pin_model.nq)
    neutral = pin.neutral(model.pin_model)
    for row, configuration in zip(q, configurations, strict=True):
        wanted = pin.integrate(model.pin_model, neutral, row)
        np.testing.assert_allclose(configuration, wanted, atol=1e-15)


def test_joints_come_in_the_order_asked_for(tmp_path):
    path = write(tmp_path, more='<limit lower="-2" upper="3" effort="1" velocity="1"/>')
    forward = RobotModel.from_urdf(path)
    backward = RobotModel.from_urdf(path, joints=["elbow", "shoulder"])
    assert backward.joints == ("elbow", "shoulder")
    assert [limit.upper for limit in backward.limits] == [3, 1]
    q = np.array([[0.3, 0.7]])
    np.testing.assert_array_equal(forward.configurations(q), backward.configurations(q[:, ::-1]))


@pytest.mark.parametrize("axis", ["0 1 0", "1 2 3"])
@pytest.mark.parametrize(("kind", "nq"), [("continuous", 3), ("revolute", 2)])
def test_a_locked_joint_gives_the_torque_at_its_angle(tmp_path, rng, axis, kind, nq):
    limit = '<limit lower="-9" upper="9" effort="1" velocity="1"/>'
    path = write(tmp_path, kind, axis, limit)
    model = RobotModel.from_urdf(path, joints=["shoulder"], locked={"elbow": 2.3})
    whole = pin.buildModelFromUrdf(model.tree.path)
    assert whole.nq == nq  # a continuous elbow as cosine and sine
    data, neutral = whole.createData(), pin.neutral(whole)
    for q, v, a in rng.uniform(-1, 1, (5, 3)):
        at = pin.integrate(whole, neutral, np.array([q, 2.3]))
        expected = pin.rnea(whole, data, at, np.array([v, 0.0]), np.array([a, 0.0]))[0]
        Y = joint_torque_regressor(model, *np.array([q, v, a]).reshape(3, 1, 1))
        assert (Y @ model.standard_parameters())[0] == pytest.approx(expected, rel=1e-12)


def test_a_mimic_joint_moves_with_its_leader_when_coupled(tmp_path):
    path = write(tmp_path, more='<mimic joint="shoulder" multiplier="-2" offset="0.5"/>')
    independent = RobotModel.from_urdf(path)
    coupled = RobotModel.from_urdf(path, mimic="coupled")
    assert coupled.joints == ("shoulder",)
    np.testing.assert_allclose(
        coupled.configurations(np.array([[0.3]])),
        independent.configurations(np.array([[0.3, -0.1]])),
    )
    with pytest.raises(ModelError, match="joint 'elbow' mimics another joint and moves with it"):
        RobotModel.from_urdf(path, mimic="coupled", joints=["elbow"])
    with pytest.raises(ModelError, match="but only one of them is locked"):
        RobotModel.from_urdf(path, joints=["shoulder"])


def test_joints_that_are_not_named_are_locked_together_and_mimics_follow():
    path, arm = example_urdf("panda.urdf"), [f"panda_joint{i}" for i in (1, 2, 4)]
    model = RobotModel.from_urdf(path, joints=arm, locked={"panda_joint5": 0.3, "*": 0.02})
    others = [f"panda_joint{i}" for i in (3, 5, 6, 7)]
    assert model.joints == tuple(arm)
    assert model.locked["panda_joint5"] == 0.3
    assert {model.locked[j] for j in others if j != "panda_joint5"} == {0.02}
    apart = RobotModel.from_urdf(path, joints=arm, locked={"panda_finger_joint1": 0.03})
    assert apart.locked["panda_finger_joint2"] == 0.03
    assert apart.locked["panda_joint3"] == 0.0


def test_a_floating_base_comes_first(tmp_path):
    model = RobotModel.from_urdf(write(tmp_path), free_flyer=True)
    assert model.n_rows == 8
    assert model.row_names[:6] == tuple(f"base.{c}" for c in ("fx", "fy", "fz", "mx", "my", "mz"))
    assert model.layout.bodies == ("base", "upper", "lower")
    assert model.row_units == ("N",) * 3 + ("N m",) * 5


def test_another_gravity_turns_what_holds_the_robot(ur5, rng):
    q, still = rng.uniform(-3, 3, (2, 6)), np.zeros((2, 6))
    pi = ur5.standard_parameters()
    along = [
        joint_torque_regressor(ur5.with_gravity(g), q, still, still) @ pi for g in -9.81 * np.eye(3)
    ]
    np.testing.assert_allclose(along[2], joint_torque_regressor(ur5, q, still, still) @ pi)
    mixed = ur5.with_gravity(np.array([1.0, -2.0, 3.0]))
    wanted = np.array([1.0, -2.0, 3.0]) @ along / -9.81
    np.testing.assert_allclose(joint_torque_regressor(mixed, q, still, still) @ pi, wanted)


def test_changed_parameters_stay_out_of_the_original(ur5):
    before = ur5.standard_parameters()
    other = ur5.with_parameters(before * 1.5)
    np.testing.assert_array_equal(ur5.standard_parameters(), before)
    np.testing.assert_allclose(other.standard_parameters()[:60], 1.5 * before[:60])


BAD = {
    "no joint of that name": (
        dict(joints=["elbow2"]),
        "joint 'elbow2' is not in two.urdf; joints: shoulder, elbow. Did you mean 'elbow'?",
    ),
    "all others locked, but of none": (dict(locked={"*": 0.0}), "list the joints to identify in"),
    "identified and locked": (
        dict(joints=["elbow"], locked={"elbow": 0.0}),
        "joints elbow are in both joints and locked",
    ),
    "unknown mimic mode": (dict(mimic="yes"), "'yes', expected one of independent, coupled"),
    "gravity of two numbers": (dict(gravity=(0, 9.81)), "expected three finite numbers"),
    "locked at nan": (dict(locked={"elbow": float("nan")}), "locked at nan, expected a number"),
    "locked at inf": (dict(locked={"elbow": float("inf")}), "locked at inf, expected a number"),
    "locked too far": (dict(locked={"elbow": 1e308}), "locked at 1e+308, expected a number"),
    "locked at text": (dict(locked={"elbow": "x"}), "locked at 'x', expected a number"),
    "gravity 1e308": (dict(gravity=(0, 0, 1e308)), "gravity is 0, 0, 1e+308, expected three"),
    "gravity nan": (dict(gravity=(0, float("nan"), 0)), "gravity is 0, nan, 0, expected three"),
    "gravity in mm": (dict(gravity=(0, 0, -9810)), "three finite numbers within +-100 [m/s^2]"),
    "gravity of text": (dict(gravity=("a", "b", "c")), "gravity is a, b, c, expected three finite"),
    "no gravity": (dict(gravity=None), "gravity is None, expected three finite"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_a_wrong_request_names_what_is_wrong(tmp_path, options, message):
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(write(tmp_path), **options)
    assert message in str(caught.value)


FAULTS = {
    "negative mass": ('value="2"', 'value="-2"', "link 'upper': inertial mass is -2 kg, expected"),
    "two numbers in xyz": ('"0.5 0 0"', '"0.5 0"', "joint 'elbow': origin xyz is '0.5 0'"),
    "no axis": ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', "axis xyz is zero"),
    "planar joint": ('type="revolute"', 'type="planar"', "has type 'planar'"),
    "unknown link": ('parent link="upper"', 'parent link="uper"', "has the parent link 'uper'"),
    "two roots": (
        '<link name="base"/>',
        '<link name="base"/><link name="x"/>',
        "expected exactly one",
    ),
    "twice the same link": ('name="upper"', 'name="lower"', "two links are named 'lower'"),
    "no mass": ('<mass value="2"/>', "", "needs both <mass> and <inertia>"),
    "no XML": ("</robot>", "", "is not well-formed XML"),
    "unknown encoding": ("<robot", '<?xml version="1.0" encoding="klingon"?><robot', "well-formed"),
    "not a robot": ("robot", "sdf", "<sdf>, expected <robot>; convert it to URDF"),
}


@pytest.mark.parametrize(("old", "new", "message"), FAULTS.values(), ids=FAULTS)
def test_a_faulty_urdf_names_its_fault(tmp_path, old, new, message):
    path = write(tmp_path, change=lambda text: text.replace(old, new))
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(path)
    assert message in str(caught.value)


def test_what_the_dynamics_do_not_use_cannot_stop_a_model(tmp_path):
    def spoil(text):
        more = '<dynamics friction="-1" damping="-2"/><visual><geometry><mesh filename="no"/>'
        return text.replace("</joint>", more + "</geometry></visual></joint>", 1)

    assert RobotModel.from_urdf(write(tmp_path, change=spoil)).joints == ("shoulder", "elbow")


def test_what_needs_a_fixed_base_is_refused_for_other_robots(tmp_path):
    urdf = example_urdf("solo12.urdf")
    RobotModel.from_urdf(urdf).require_fixed("a preview")
    for options, found in (
        ({"free_flyer": True}, "the base floats"),
        ({"constraints": [Contact("FL_FOOT")]}, "the robot has contacts or loops"),
    ):
        model = RobotModel.from_urdf(urdf, **options)
        message = f"solo: {found}; a preview needs a robot with a fixed base"
        with pytest.raises(DataError, match=message.replace("solo", model.name)):
            model.require_fixed("a preview")


OWN = Coupling("bearing", (("elbow_joint", -2.0),))
GEARED = Coupling("elbow_joint", (("elbow_joint", -0.5),), replaces=True)
ONE_JOINT = {
    "bearings beside a drive": ("ur5_robot.urdf", {"couplings": (OWN,)}),
    "a drive that turns the other way": ("ur5_robot.urdf", {"couplings": (GEARED,)}),
    "no friction": ("ur5_robot.urdf", {"terms": ("armature",)}),
}


def torque_of(made, model, q, v, a):
    """Return rnea plus damping and dry friction, as pinocchio_model documents it."""
    data, G = made.createData(), model.velocity_map
    torque = np.empty_like(v)
    for out, q_k, v_k, a_k in zip(torque, model.configurations(q), v @ G.T, a @ G.T, strict=True):
        dry = np.where(v_k > 0, made.lowerDryFrictionLimit, made.upperDryFrictionLimit)
        out[:] = G.T @ (pin.rnea(made, data, q_k, v_k, a_k) + made.damping * v_k - dry)
    return torque


@pytest.mark.parametrize("case", [*ROBOTS, *ONE_JOINT])
def test_its_rnea_plus_friction_is_the_prediction(case, rng):
    path, options = {**ROBOTS, **ONE_JOINT}[case]
    model = RobotModel.from_urdf(example_urdf(path), **options)
    pi, m = possible_parameters(model, rng), motion(model, rng, 20)
    shared = [f"motor.{term}" for term in ("armature", "viscous", "coulomb")]
    if case != "coupled drives":
        shared = []
        made = pinocchio_model(model, pi)
    else:
        words = "has no field for motor.armature, motor.viscous, motor.coulomb: its torques"
        with pytest.warns(UserWarning, match=words):
            made = pinocchio_model(model, pi)
    expressed = np.where(np.isin(model.layout.names, shared), 0.0, pi)
    predicted = predict_instants(model, expressed, m.q, m.v, m.a)
    scale = np.abs(predicted).max()
    np.testing.assert_allclose(
        torque_of(made, model, m.q, m.v, m.a), predicted, rtol=0, atol=1e-12 * scale
    )
    bare = model.with_parameters(pi).pin_model  # whose RNEA alone was all there was
    still = np.zeros(model.pin_model.nv)
    off = pin.rnea(made, made.createData(), pin.neutral(made), still, still + 1.0)
    off -= pin.rnea(bare, bare.createData(), pin.neutral(bare), still, still + 1.0)
    np.testing.assert_allclose(off, made.armature, atol=1e-9)
    assert made.armature.any()


def test_what_it_has_no_place_for_is_named_if_it_is_not_zero(ur5):
    own = {"elbow_joint": (Cubic(),), "wrist_1_joint": (LoadFriction(),)}
    model = ur5.with_terms(own)
    pi = model.standard_parameters()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pinocchio_model(model, pi)
    pi[list(model.layout.names).index("wrist_1_joint.load")] = 0.05
    with pytest.warns(UserWarning, match=r"no field for wrist_1_joint\.load: its torques"):
        pinocchio_model(model, pi)


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


def test_limits_are_those_stated_and_a_continuous_joint_has_no_range(chain):
    limit = LIMIT.format(-1, 2)
    joints = ("revolute", limit), ("continuous", limit), ("revolute", LIMIT.format(0, 0))
    tree = read_tree(chain(*joints))
    turn, endless, point = tree.joints
    assert tree.carriers == {"j1": [], "j2": ["j1"], "j3": ["j2", "j1"]}
    assert (turn.lower, turn.upper, turn.velocity, turn.effort) == (-1, 2, 2, 9)
    assert (endless.lower, endless.upper, endless.velocity) == (-math.inf, math.inf, 2)
    assert [joint.has_limits for joint in (turn, endless, point)] == [True, False, False]
    assert [joint.turns_freely for joint in (turn, endless, point)] == [False, True, True]


def test_limits_that_no_joint_has_are_none(chain):
    wide = read_tree(chain(("revolute", LIMIT.format(-10000, 10000)))).movable[0]
    wound = read_tree(chain(("revolute", LIMIT.format(-12.6, 12.6)))).movable[0]
    assert [joint.turns_freely for joint in (wide, wound)] == [True, False]
    assert [joint.has_limits for joint in (wide, wound)] == [False, True]


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


def test_a_mass_that_nothing_can_be_divided_by_is_refused(chain):
    path = chain(("revolute", ""))
    path.write_text(path.read_text().replace('mass value="1"', 'mass value="5e-324"'))
    with pytest.raises(ModelError, match=r"mass is 4\.94066e-324 kg, expected 0 or at least 1e-15"):
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
    words = "^r.urdf: the mechanicalReduction of joint 'last' is 'half', expected a number$"
    with pytest.raises(ModelError, match=words):
        _ = read_tree(path).reductions


URDF = """<robot name="two"><link name="base"/>
<link name="arm"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/>
<origin xyz="0.5 0 0" rpy="0 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="2" effort="9"/><mimic joint="k"/></joint></robot>"""
NO_NUMBERS = (
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


@pytest.mark.parametrize("text", NO_NUMBERS)
@pytest.mark.parametrize(("old", "new", "said"), PLACES)
def test_what_urdfdom_drops_is_refused_by_name(tmp_path, text, old, new, said):
    path = written(tmp_path, old, new.format(text.replace("\t", "&#9;")))
    if text == "1.2e9" and "limit" in said:  # limits do not reach the dynamics
        read_tree(path)
        return
    with pytest.raises(ModelError, match=re.escape(f"two.urdf: {said}'")) as caught:
        RobotModel.from_urdf(path)
    assert "written like 0.25 or 2.5e-1" in str(caught.value)


@pytest.mark.parametrize(
    "text", [*NO_NUMBERS, "2", " 2", "+2", "2.", ".5", "2e0", "2E-1", "5e-324"]
)
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
    with pytest.raises(ModelError, match="inertial inertia ixz is missing, expected one number"):
        read_tree(written(tmp_path, 'ixz="0" '))
    with pytest.raises(ModelError, match="axis xyz is missing, expected 3 numbers"):
        read_tree(written(tmp_path, 'axis xyz="0 0 1"', "axis"))
    with pytest.raises(ModelError, match="origin has quat_xyzw, expected rpy"):
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
    with pytest.raises(ModelError, match="elements are nested 41 levels deep, expected at most 40"):
        read_tree(nested)
    long = written(tmp_path, 'name="arm"', f'name="{"x" * 10_000_000}"')
    with pytest.raises(ModelError, match=r"<link>: name has 10000000 characters.*'xxx") as caught:
        read_tree(long)
    assert len(str(caught.value)) < 300
    huge = tmp_path / "huge.urdf"
    with huge.open("wb") as stream:
        stream.truncate(2**33)
    with pytest.raises(ModelError, match=r"huge.urdf has 8192 MiB, expected a URDF of at most 64"):
        parse_urdf(huge)
    with pytest.raises(ModelError, match="is a folder, expected a URDF file"):
        parse_urdf(tmp_path)
    with pytest.raises(ModelError, match="cannot be read: File name too long"):
        parse_urdf(tmp_path / ("x" * 300))


CHAIN = """<link name="l{0}"/>
<joint name="j{0}" type="{2}"><parent link="l{1}"/><child link="l{0}"/></joint>"""
FEW = int(os.environ.get("ROBOTID_FUZZ", "25"))  # inputs; benchmarks/bench_fuzz.py tries thousands


@settings(max_examples=FEW, derandomize=True, database=None, deadline=None,
          suppress_health_check=list(HealthCheck))  # fmt: skip
@given(urdf_inputs())
def test_nothing_but_its_own_words_comes_of_a_hostile_urdf(tmp_path_factory, case):
    run_urdf(case, tmp_path_factory.mktemp("hostile"))


@pytest.mark.parametrize("mesh", MESHES, ids=range(len(MESHES)))
def test_no_path_of_a_mesh_breaks_anything(tmp_path, mesh):
    path, scale = quoteattr(mesh), "0 0 0" if mesh == "good.stl" else "1 1 1"
    shape = f"<geometry><mesh filename={path} scale='{scale}'/></geometry>"
    text = f"<robot name='r'><link name='l0'/>{CHAIN.format(1, 0, 'revolute')}</robot>"
    shapes = f"<visual>{shape}</visual><collision>{shape}</collision>"
    content = text.replace('<link name="l1"/>', f'<link name="l1">{shapes}</link>')
    run_urdf(HostileUrdf(content.encode(), dict(FILES)), tmp_path)


@pytest.mark.parametrize("ratio", [float("nan"), float("-inf"), 1e300])
def test_ratios_of_couplings_are_checked(ratio):
    coupling = Coupling("motor", (("elbow_joint", ratio), ("wrist_1_joint", 1.0)))
    with pytest.raises(SettingsError, match="'motor': the ratio of joint 'elbow_joint' is"):
        RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), couplings=[coupling])


@pytest.mark.parametrize("ratios", [(), (("elbow_joint", 0.0), ("wrist_1_joint", -0.0))])
def test_a_coupling_turns_with_some_joint(ratios):
    couplings = [Coupling("good", (("elbow_joint", 0.0), ("wrist_1_joint", 1.0)))]
    path = example_urdf("ur5_robot.urdf")
    assert "good.armature" in RobotModel.from_urdf(path, couplings=couplings).layout.names
    with pytest.raises(SettingsError, match=r"'motor' moves no joint: its ratios are \{"):
        RobotModel.from_urdf(path, couplings=[*couplings, Coupling("motor", ratios)])
    with pytest.raises(SettingsError, match="passive has elbow_joint, expected joints that"):
        RobotModel.from_urdf(path, couplings=[GEARED], passive=["elbow_joint"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('value="4.0"', 'value="4_0"', "lacks none, and has 16.99.* kg, expected 20.99"),
        ('link name="wrist_3_link"', 'link name="wrist"', "cannot read it: "),
    ],
)
def test_what_pinocchio_omits_is_an_error(monkeypatch, old, new, message):
    path = example_urdf("ur5_robot.urdf")
    text = path.read_text().replace(old, new)
    monkeypatch.setattr("robotid.robot.tree.Tree.xml", property(lambda self: text))
    with pytest.raises(ModelError, match=message):
        RobotModel.from_urdf(path)


def long_chain(tmp_path, count, kind="revolute", more=""):
    links = "".join(CHAIN.format(k, k - 1, kind) for k in range(1, count + 1))
    path = tmp_path / "chain.urdf"
    path.write_text(f'<robot name="chain"><link name="l0"/>{links}{more}</robot>')
    return path


def test_trees_that_are_none_or_too_deep_are_refused(tmp_path):
    circle = CHAIN.format("a", "b", "fixed") + CHAIN.format("b", "a", "revolute")
    with pytest.raises(ModelError, match="links la, lb form a closed loop that is not connected"):
        RobotModel.from_urdf(long_chain(tmp_path, 2, more=circle))
    with pytest.raises(ModelError, match="a chain has more than 500 joints"):
        RobotModel.from_urdf(long_chain(tmp_path, 20_000, "fixed"))
    with pytest.raises(ModelError, match="400 joints move, expected at most 300; list"):
        RobotModel.from_urdf(long_chain(tmp_path, 400))
    assert len(RobotModel.from_urdf(long_chain(tmp_path, 400), joints=["j1", "j9"]).joints) == 2


@pytest.mark.parametrize("name", ["universe", "root_joint"])
def test_names_that_pinocchio_has_taken_are_refused(tmp_path, name):
    path = long_chain(tmp_path, 2)
    path.write_text(path.read_text().replace('name="j2"', f'name="{name}"'))
    with pytest.raises(
        ModelError, match=f"a joint is named '{name}', which is reserved by Pinocchio"
    ):
        RobotModel.from_urdf(path, free_flyer=True)


def test_a_pipe_is_no_urdf(tmp_path):
    os.mkfifo(tmp_path / "pipe.urdf")
    (finding,) = inspect_urdf(tmp_path / "pipe.urdf").findings
    assert (finding.code, "is a pipe or a device, expected a URDF" in finding.message) == (
        "unusable",
        True,
    )


def test_only_files_of_meshes_inside_their_package_are_read(tmp_path):
    urdf = tmp_path / "p" / "urdf" / "r.urdf"
    urdf.parent.mkdir(parents=True)
    (tmp_path / "secret.stl").write_bytes(b"solid")
    os.mkfifo(urdf.parent / "pipe.stl")
    (urdf.parent / "folder.stl").mkdir()
    outside, endless = "package://p/../secret.stl", "package://p/" + "x/" * 3000
    nowhere = ("file:///dev/zero", "/dev/zero", "x" * 300)
    for name in (outside, endless, "pipe.stl", "folder.stl", *nowhere):
        assert find_mesh(name, urdf) is None, name
    for name in ("r.urdf", "passwd"):
        with pytest.raises(ValueError, match=r"is not a mesh, expected .stl, .dae"):
            read_surfaces(urdf.parent / name)
    with (tmp_path / "huge.stl").open("wb") as stream:
        stream.truncate(2**40)
    with pytest.raises(
        ValueError, match=r"huge.stl cannot be read: the file has more than 256 MiB"
    ):
        read_surfaces(tmp_path / "huge.stl")


def test_motions_that_are_no_numbers_are_refused():
    model = RobotModel.from_urdf(example_urdf("ur5_robot.urdf"), free_flyer=True)
    q, v = np.zeros((3, 13)), np.zeros((3, 12))
    with pytest.raises(DataError, match=r"q\[0, 3:7\], the quaternion of the base, has length 0"):
        joint_torque_regressor(model, q, v, v)
    q[:, 6] = 1.0
    for bad, where in (((q, 2, 8), r"q\[2, 8\]"), ((v, 1, 7), r"v\[1\] of shoulder_lift_joint")):
        values, row, column = bad
        values[row, column] = np.nan
        with pytest.raises(DataError, match=f"{where} is nan, expected"):
            joint_torque_regressor(model, q, v, np.zeros((3, 12)))
        values[row, column] = 0.0
    pi = model.standard_parameters()
    pi[12] = np.inf
    with pytest.raises(DataError, match=r"shoulder_link.mcy is inf kg m, expected a finite number"):
        model.with_parameters(pi)


ARM = """<robot name="arm">{first}<link name="l1"><inertial><origin xyz="0 0.4 0"/>
<mass value="0.7"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.01"/></inertial>
</link><joint name="{name}" type="{kind}"><origin xyz="{origin}"/><parent link="{parent}"/>
<child link="l1"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="3" effort="9"/></joint>
<link name="l2"><inertial><origin xyz="0 0.4 0"/><mass value="0.7"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.004" iyz="0" izz="0.01"/></inertial></link>
<joint name="j" type="revolute"><origin xyz="{origin}"/><parent link="l1"/><child link="l2"/>
<axis xyz="1 0 0"/><limit lower="-1" upper="1" velocity="3" effort="9"/></joint>{last}</robot>"""
USUAL = {
    "first": '<link name="base"/>', "name": "i", "kind": "revolute", "origin": "0 0 0.3",
    "parent": "base", "last": "",
}  # fmt: skip


@pytest.mark.parametrize(
    "odd",
    [
        {"name": "root_joint"},
        {"name": "root_joint", "kind": "fixed"},
        {"first": "", "parent": "world"},
        {"last": '<gazebo reference="l1"><sensor:camera name="c" sensor:rate="3"/></gazebo>'},
        {"origin": "0 \n\t 0  0.3\n"},
    ],
)
def test_what_other_readers_load_is_loaded_with_the_same_dynamics(tmp_path, odd):
    models = []
    for changes in (odd, {k: v for k, v in odd.items() if k == "kind"}):
        path = tmp_path / "arm.urdf"
        path.write_text(ARM.format(**USUAL | changes))
        models.append(RobotModel.from_urdf(path))
        assert not [f for f in inspect_urdf(path).findings if f.severity == "error"]
    odd_one, plain = models
    np.testing.assert_array_equal(odd_one.standard_parameters(), plain.standard_parameters())
    placements = [[p.homogeneous for p in m.pin_model.jointPlacements] for m in models]
    np.testing.assert_array_equal(*placements)


@pytest.mark.parametrize("origin", ["0 0 0", "-0.0005 0 0"])
def test_friction_is_identifiable_at_a_joint_beside_the_origin(tmp_path, origin):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.format(**USUAL | {"kind": "fixed", "origin": origin}))
    inspection = inspect_urdf(path)
    assert (inspection.structure.base_inertial, inspection.structure.base) == (3, 6)
