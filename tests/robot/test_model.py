"""A robot from its URDF: joints, parameters, faults; as a model of Pinocchio, drives included."""

import warnings

import numpy as np
import pinocchio as pin
import pytest
from helpers.robots import ROBOTS, motion, possible_parameters

from robotid.base.exceptions import DataError, ModelError
from robotid.dynamics.prediction import predict_instants
from robotid.dynamics.torque import joint_torque_regressor
from robotid.robot.constraints import Contact
from robotid.robot.drives import Cubic, LoadFriction
from robotid.robot.examples import example_urdf, example_urdfs
from robotid.robot.model import RobotModel, pinocchio_model
from robotid.robot.parameters import Coupling

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
        np.testing.assert_allclose(
            configuration, pin.integrate(model.pin_model, neutral, row), atol=1e-15
        )


def test_joints_come_in_the_order_asked_for(tmp_path):
    path = write(tmp_path, more='<limit lower="-2" upper="3" effort="1" velocity="1"/>')
    forward = RobotModel.from_urdf(path)
    backward = RobotModel.from_urdf(path, joints=["elbow", "shoulder"])
    assert backward.joints == ("elbow", "shoulder")
    assert [limit.upper for limit in backward.limits] == [3, 1]
    q = np.array([[0.3, 0.7]])
    np.testing.assert_array_equal(forward.configurations(q), backward.configurations(q[:, ::-1]))


@pytest.mark.parametrize("axis", ["0 1 0", "1 2 3"])
def test_a_locked_continuous_joint_gives_the_torque_at_its_angle(tmp_path, rng, axis):
    model = RobotModel.from_urdf(
        write(tmp_path, "continuous", axis), joints=["shoulder"], locked={"elbow": 2.3}
    )
    whole = pin.buildModelFromUrdf(model.tree.path)
    assert whole.nq == 3  # the elbow as cosine and sine
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
    "unknown mimic mode": (dict(mimic="yes"), "mimic is 'yes', wanted one of independent, coupled"),
    "gravity of two numbers": (dict(gravity=(0, 9.81)), "wanted three finite numbers"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_a_wrong_request_names_what_is_wrong(tmp_path, options, message):
    with pytest.raises(ModelError) as caught:
        RobotModel.from_urdf(write(tmp_path), **options)
    assert message in str(caught.value)


FAULTS = {
    "NaN mass": ('value="2"', 'value="nan"', "link 'upper': inertial mass value is 'nan'"),
    "negative mass": ('value="2"', 'value="-2"', "link 'upper': inertial mass is -2 kg, wanted"),
    "text for a number": ('ixx="0.1"', 'ixx="0,1"', "link 'upper': inertial inertia ixx is '0,1'"),
    "two numbers in xyz": ('"0.5 0 0"', '"0.5 0"', "joint 'elbow': origin xyz is '0.5 0'"),
    "no axis": ('axis xyz="0 1 0"', 'axis xyz="0 0 0"', "axis xyz is zero"),
    "planar joint": ('type="revolute"', 'type="planar"', "has type 'planar'"),
    "unknown link": ('parent link="upper"', 'parent link="uper"', "has the parent link 'uper'"),
    "two roots": (
        '<link name="base"/>',
        '<link name="base"/><link name="x"/>',
        "wanted exactly one",
    ),
    "twice the same link": ('name="upper"', 'name="lower"', "two links are named 'lower'"),
    "no mass": ('<mass value="2"/>', "", "needs both <mass> and <inertia>"),
    "no XML": ("</robot>", "", "is not well-formed XML"),
    "unknown encoding": ("<robot", '<?xml version="1.0" encoding="klingon"?><robot', "well-formed"),
    "not a robot": ("robot", "sdf", "the top element is <sdf>, wanted <robot>"),
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
